"""The commands ``evaluate``, ``show`` and ``simulate``, each for one problem."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, cast

import typer

from taciturn._text import number_of
from taciturn.cli.frame import (
    EXAMPLE,
    Confidence,
    File,
    GivenSeed,
    Json,
    Loads,
    NoFunctions,
    PictureStyle,
    Plot,
    Seed,
    Settings,
    StandardError,
    Steps,
    TimeLimit,
    Verbose,
    app,
    can_print,
    complete_file,
    complete_from,
    load_changed,
    print_json,
    print_result,
    progress_bar,
    refuse,
    save_picture,
)

PERIODIC: Literal["periodic"] = "periodic"  # the other control of --versus that is no file
SPENT = 0.2  # share of the time limit after which it is the reason why a standard error was not reached


@app.command(epilog=EXAMPLE + "taciturn evaluate two-mass --standard-error 1e-3")
def evaluate(
    file: File,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    as_json: Json = False,
    plot: Plot = None,
    style: PictureStyle = None,
    verbose: Verbose = False,
    seed: GivenSeed = None,
    standard_error: StandardError = None,
    steps: Steps = None,
    method: Annotated[
        str, typer.Option(help="Method of the computation: auto, exact, 'conditional sampling' or simulation.")
    ] = "auto",
    precision: Annotated[str, typer.Option(help="Precision of simulations: float64 or float32.")] = "float64",
    confidence: Confidence = None,
    time: TimeLimit = None,
) -> None:
    """Compute cost, rate and guarantee of a policy, and compare it with periodic control at the same rate.

    Change a parameter with --set theta=0.2. Compare several values with taciturn tradeoff FILE --over NAME=v1,v2,…
    """
    import taciturn
    from taciturn._progress import answered_within
    from taciturn.simulation.sampling import MOST_OPERATIONS
    from taciturn.study.evaluate import choose_confidence

    with answered_within(time, early=True):
        problem = load_changed(file, settings, no_functions)
        with progress_bar("computing") as progress:
            found = taciturn.evaluate(
                problem,
                seed=seed or 0,
                standard_error=standard_error,
                steps=steps,
                method=cast("Any", method),
                precision=cast("Any", precision),
                confidence=choose_confidence(problem, confidence),
                progress=progress,
            )
    print_result(found, as_json, verbose, problem, unused=None if found.drawn else seed)
    save_picture(found, plot, style, as_json, problem, seed or 0, found.method)
    if not found.reached and steps is not None:
        unless = ", unless a note states why there is no average" if found.notes else ""
        refuse(f"the loop has not settled within {number_of(found.steps, 'step')}; give more --steps{unless}")
    if not found.reached and time is not None and found.seconds > SPENT * time:
        refuse(
            f"the standard error was not reached within --time {time:g} s; reached "
            f"{found.cost.standard_error + found.cost.error:.3g}; give a longer --time or a larger --standard-error"
        )
    if not found.settled:
        why = "a note states why there is no average, or " if found.notes else ""
        remedies = [] if found.steps >= MOST_OPERATIONS else ["more --steps"]
        if found.unit == "second":  # else the plant has no period
            remedies.append("a longer period")
        given = f"; give {' or '.join(remedies)}" if remedies else ""
        refuse(
            f"the loop has not settled within {number_of(found.steps, 'step')}: {why}its time constants, or the "
            f"intervals between sends, take too many steps{given}"
        )
    if not found.reached:
        wanted = "1e-4 of the cost" if standard_error is None else f"{standard_error:g}"
        refuse(
            f"the standard error {wanted} was not reached within {number_of(found.steps, 'step')}; "
            f"reached {found.cost.standard_error:.3g}; give a larger --standard-error"
        )


@app.command(epilog=EXAMPLE + "taciturn show two-mass")
def show(
    file: File,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    as_json: Json = False,
    verbose: Verbose = False,
    plot: Plot = None,
    style: PictureStyle = None,
    wire: Annotated[
        bool,
        typer.Option(
            "--wire", help="Print the packets and the computations of the nodes as JSON, for nodes in other languages."
        ),
    ] = False,
    record: Annotated[
        list[Path] | None,
        typer.Option(
            "--record",
            metavar="LOG",
            help="Show the cost that a node added by not sending in a recorded run, from its log (`taciturn node "
            "--log LOG`). Repeat the option for each node.",
        ),
    ] = None,
    time: TimeLimit = None,
) -> None:
    """Show plant, gains, guarantee, triggers and node diagram of a problem, without a simulation.

    With the logs of its nodes (--record), show instead what their silence has cost on the recorded path.
    """
    import taciturn
    from taciturn._progress import answered_within
    from taciturn.study.describe import describe
    from taciturn.study.record import origin

    if record:
        if wire:
            raise taciturn.ProblemError("--record and --wire are both given; expected only one of these options")
        from taciturn.study.recorded import recorded_silence

        with answered_within(time):
            problem = load_changed(file, settings, no_functions)
            told = recorded_silence(problem, record)
        print_result(told, as_json, verbose, problem)
        save_picture(told, plot, style, as_json, problem)
        return
    with answered_within(time):
        found = describe(load_changed(file, settings, no_functions))
    drawn = found.diagram
    if wire:
        if plot is not None:
            raise taciturn.ProblemError("--wire and --plot are both given; expected only one of these options")
        from taciturn.nodes.description import describe_wire

        print_json(describe_wire(found.problem.design(), found.problem.network), origin(found.problem))
        return
    if plot is not None and drawn is None:
        raise taciturn.ProblemError(
            f"the policy kind {found.problem.kind} without policy.period has no nodes that --plot could draw; expected "
            "policy.period, or no --plot"
        )
    if as_json:
        print_json(found.document(), origin(found.problem))
    else:
        typer.echo(found.text(verbose))
        if drawn is not None:
            typer.echo(f"\n{drawn.text(plain=not can_print('┌▶┄Ψ'), legend=False)}")
    if drawn is not None:
        save_picture(drawn, plot, style, as_json, found.problem)


def complete_versus(incomplete: str) -> list[str]:
    """Complete an option with the word for periodic control or with a problem file."""
    return [*complete_from(PERIODIC)(incomplete), *complete_file(incomplete)]


@app.command(epilog=EXAMPLE + "taciturn simulate two-mass --steps 200 --versus periodic --plot path.svg")
def simulate(
    file: File,
    steps: Annotated[int, typer.Option(help="Number of steps.")] = 100,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    as_json: Json = False,
    versus: Annotated[
        str | None,
        typer.Option(
            metavar="periodic|FILE",
            help="Simulate a second control with the same noise: the policy of another file, or `periodic`, which "
            "is periodic control with the same number of packets.",
            autocompletion=complete_versus,
        ),
    ] = None,
    verbose: Verbose = False,
    plot: Plot = None,
    style: PictureStyle = None,
    table: Annotated[
        Path | None, typer.Option(metavar="OUT", help="Write every step as a table: .csv or .parquet.")
    ] = None,
    seed: Seed = 0,
    loads: Loads = None,
    time: TimeLimit = None,
) -> None:
    """Simulate one path of the closed loop: states, inputs and the instants of packets.

    With --versus, the figure shows two controls side by side on the same noise.
    """
    import taciturn
    from taciturn._progress import answered_within
    from taciturn.model.result import check_table, save_table
    from taciturn.study.record import origin

    if table is not None:
        check_table(table)
    with answered_within(time):
        problem = load_changed(file, settings, no_functions, loads)
        policy = problem.design()
        other = None
        if versus is not None and versus != PERIODIC:
            compared = load_changed(versus, None, no_functions, loads)
            other = compared.close(compared.design())
        found = taciturn.simulate(
            problem.close(policy), steps, seed=seed, versus=PERIODIC if versus == PERIODIC else other
        )
    if as_json:
        print_json({"policy": policy.kind} | found.document(), origin(problem, seed, "simulation"))
    else:
        typer.echo(found.text(verbose))
    if table is not None:
        save_table(found.to_pandas().reset_index(), table, origin(problem, seed, "simulation"))
        if not as_json:
            typer.echo(f"table: {table}")
    save_picture(found, plot, style, as_json, problem, seed, "simulation")
