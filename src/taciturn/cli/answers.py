"""Commands for one problem."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, cast

import typer

from taciturn.cli.frame import (
    EXAMPLE,
    Confidence,
    File,
    GivenSeed,
    Json,
    NoFunctions,
    Plot,
    Seed,
    Settings,
    StandardError,
    Steps,
    TimeLimit,
    app,
    can_print,
    load_changed,
    print_json,
    print_result,
    progress_bar,
    refuse,
    save_picture,
)

SPENT = 0.2  # share of the time limit after which it is the reason why a standard error was not reached


@app.command(epilog=EXAMPLE + "taciturn evaluate two-mass --standard-error 1e-3")
def evaluate(
    file: File,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    as_json: Json = False,
    seed: GivenSeed = None,
    standard_error: StandardError = None,
    steps: Steps = None,
    method: Annotated[str, typer.Option(help="Method: auto, exact, 'conditional sampling' or simulation.")] = "auto",
    precision: Annotated[str, typer.Option(help="Precision of simulations: float64 or float32.")] = "float64",
    confidence: Confidence = None,
    time: TimeLimit = None,
) -> None:
    """Compute cost, rate and guarantee of one policy, and compare with periodic control at the same rate.

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
    print_result(found, as_json, problem, unused=None if found.drawn else seed)
    if not found.reached and steps is not None:
        unless = ", unless a note states why there is no average" if found.notes else ""
        refuse(f"the loop has not settled within {found.steps} steps; give more --steps{unless}")
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
            f"the loop has not settled within {found.steps} steps: {why}its time constants, or the intervals between "
            f"sends, take too many steps{given}"
        )
    if not found.reached:
        wanted = "1e-4 of the cost" if standard_error is None else f"{standard_error:g}"
        refuse(
            f"the standard error {wanted} was not reached within {found.steps} steps; "
            f"reached {found.cost.standard_error:.3g}; give a larger --standard-error"
        )


@app.command(epilog=EXAMPLE + "taciturn show two-mass")
def show(
    file: File,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    as_json: Json = False,
    plot: Plot = None,
    wire: Annotated[
        bool, typer.Option("--wire", help="Print packets and computations of the nodes as JSON, for other programs.")
    ] = False,
    time: TimeLimit = None,
) -> None:
    """Show plant, gains, guarantee, triggers and node diagram of a problem, without a simulation."""
    import taciturn
    from taciturn._progress import answered_within
    from taciturn.study.describe import describe
    from taciturn.study.record import origin

    with answered_within(time):
        found = describe(load_changed(file, settings, no_functions))
    drawn = found.diagram
    if wire:
        if plot is not None:
            raise taciturn.ProblemError("--wire and --plot are both given; expected one of them")
        from taciturn.nodes.description import describe_wire

        print_json(describe_wire(found.problem.design(), found.problem.network), origin(found.problem))
        return
    if plot is not None and drawn is None:
        raise taciturn.ProblemError(
            f"{found.problem.kind} without a period has no nodes to draw; expected policy.period, or no --plot"
        )
    if as_json:
        print_json(found.document(), origin(found.problem))
    else:
        typer.echo(found)
        if drawn is not None:
            typer.echo(f"\n{drawn.text(plain=not can_print('┌▶┄'))}")
    if drawn is not None:
        save_picture(drawn, plot, as_json, found.problem)


@app.command(epilog=EXAMPLE + "taciturn simulate two-mass --ticks 200 --plot path.svg")
def simulate(
    file: File,
    ticks: Annotated[int, typer.Option(help="Number of steps.")] = 100,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    as_json: Json = False,
    plot: Plot = None,
    table: Annotated[
        Path | None, typer.Option(metavar="OUT", help="Write every step as a table: .csv or .parquet.")
    ] = None,
    seed: Seed = 0,
    time: TimeLimit = None,
) -> None:
    """Simulate one path of the closed loop: states, inputs and the instants of packets."""
    import taciturn
    from taciturn._progress import answered_within
    from taciturn.model.result import check_table, save_table
    from taciturn.study.record import origin

    if table is not None:
        check_table(table)
    with answered_within(time):
        problem = load_changed(file, settings, no_functions)
        policy = problem.design()
        found = taciturn.simulate(problem.close(policy), ticks, seed=seed)
    if as_json:
        print_json({"policy": policy.kind} | found.document(), origin(problem, seed, "simulation"))
    else:
        typer.echo(found)
    if table is not None:
        save_table(found.to_pandas().reset_index(), table, origin(problem, seed, "simulation"))
        if not as_json:
            typer.echo(f"table: {table}")
    save_picture(found, plot, as_json, problem, seed, "simulation")
