"""Commands for one problem."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from taciturn.cli.frame import (
    EXAMPLE,
    Confidence,
    File,
    GivenSeed,
    Json,
    Link,
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


@app.command(epilog=EXAMPLE + "taciturn tune two-mass --rate 0.3")
def tune(
    file: File,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    rate: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[LINK=]X|P%",
            help="Largest rate: sends per step or second (0.5), or percent of all samples (50%); of one link or each.",
        ),
    ] = None,
    traffic: Annotated[
        str | None,
        typer.Option(metavar="X|P%", help="Largest sum of all rates, each times the price of a packet on its link."),
    ] = None,
    cost: Annotated[
        str | None,
        typer.Option(
            metavar="X|+P%", help="Largest cost: a number, or e.g. +5% above the cost of sending every sample."
        ),
    ] = None,
    violation: Annotated[
        float | None,
        typer.Option(help="Largest share of the steps that violate the limits of the states, such as 1e-3."),
    ] = None,
    link: Link = None,
    least_period: Annotated[
        float | None, typer.Option(help="Also tune the sampling period, down to this many seconds.")
    ] = None,
    as_json: Json = False,
    seed: GivenSeed = None,
    standard_error: StandardError = None,
    time: TimeLimit = None,
) -> None:
    """Tune the parameter of a policy to meet a budget on its rate, its cost, or the violation of limits."""
    import taciturn
    from taciturn._progress import answered_within
    from taciturn.study.tune import TunedPeriod, tune_period

    allowed, spent, paid = _rates(rate), _budget("cost", cost), _budget("traffic", traffic)
    with answered_within(time):
        problem, on = load_changed(file, settings, no_functions), cast("Any", link)
        with progress_bar("searching") as progress:
            if least_period is None:
                found = taciturn.tune(
                    problem,
                    rate=allowed,
                    cost=spent,
                    traffic=paid,
                    violation=violation,
                    link=on,
                    seed=seed or 0,
                    standard_error=standard_error,
                    progress=progress,
                )
            else:
                if not isinstance(allowed, float) or (spent, paid, violation) != (None, None, None):
                    raise taciturn.ProblemError(
                        "--least-period is given without a number for --rate, or with another budget; expected --rate "
                        "with a number, and no --cost, --traffic or --violation"
                    )
                found = tune_period(
                    problem,
                    rate=allowed,
                    least=least_period,
                    link=on,
                    seed=seed or 0,
                    standard_error=standard_error,
                    progress=progress,
                )
    best = found.best if isinstance(found, TunedPeriod) else found
    print_result(found, as_json, best.problem, unused=None if best.evaluation.drawn else seed)
    if not best.evaluation.reached:
        refuse("the budget, or the standard error of the cost, was not reached; give a larger --standard-error")


def _rates(texts: Sequence[str] | None) -> float | str | dict[str, float | str] | None:
    """Return the budget of --rate, or the budgets by link."""
    from taciturn.errors import ProblemError
    from taciturn.study.goal import parse_budget

    if not texts:
        return None
    pairs = [text.rpartition("=") for text in texts]
    if len(pairs) == 1 and not pairs[0][0]:
        return parse_budget("rate", texts[0])
    if not all(link for link, _, _ in pairs) or len({link for link, _, _ in pairs}) < len(pairs):
        raise ProblemError(f"--rate is {' and '.join(texts)}; expected one LINK=RATE for each link")
    return {link: parse_budget("rate", text) for link, _, text in pairs}


def _budget(name: str, text: str | None) -> float | str | None:
    """Return the budget of --cost or --traffic."""
    from taciturn.study.goal import parse_budget

    return None if text is None else parse_budget(name, text)
