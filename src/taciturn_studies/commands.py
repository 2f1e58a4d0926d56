"""Commands that evaluate a problem many times: ``tradeoff``, ``compare`` and ``tune``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from taciturn.cli.frame import (
    EXAMPLE,
    OVER,
    Confidence,
    File,
    GivenSeed,
    Json,
    Link,
    NoFunctions,
    PictureStyle,
    Plot,
    Settings,
    StandardError,
    TimeLimit,
    Verbose,
    Workers,
    app,
    complete_file,
    load_all,
    load_changed,
    print_result,
    progress_bar,
    refuse,
    save_picture,
)

if TYPE_CHECKING:
    from taciturn_studies.buffers import TunedBuffer
    from taciturn_studies.tune import Tuned


@app.command(epilog=EXAMPLE + "taciturn tradeoff two-mass --over theta=0.1,1,10 --plot costs.svg")
def tradeoff(
    file: File,
    over: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=v1,v2,…", help=f"{OVER} Default: the parameter of the policy, around its value."),
    ] = None,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    as_json: Json = False,
    verbose: Verbose = False,
    plot: Plot = None,
    style: PictureStyle = None,
    seed: GivenSeed = None,
    standard_error: StandardError = None,
    confidence: Confidence = None,
    store: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder in which results are stored, so that an interrupted run can continue."
        ),
    ] = None,
    workers: Workers = 1,
    time: TimeLimit = None,
) -> None:
    """Compute cost and rate of a policy for several parameter values, with periodic control and the guarantee."""
    import taciturn
    from taciturn.extend import answered_within, number_of
    from taciturn.problem.settings import parse_grid
    from taciturn.study.evaluate import choose_confidence
    from taciturn_studies.workers import processes

    values = parse_grid(over) if over else None
    with answered_within(time):
        problem = load_changed(file, settings, no_functions)
        with progress_bar("computing") as progress, processes(workers) as executor:
            found = taciturn.tradeoff(
                problem,
                values,
                seed=seed or 0,
                standard_error=standard_error,
                confidence=choose_confidence(problem, confidence),
                executor=executor,
                store=store,
                progress=progress,
            )
    drawn = any(point.evaluation.drawn for point in found.points)
    print_result(found, as_json, verbose, problem, seed or 0, unused=None if drawn else seed)
    save_picture(found, plot, style, as_json, problem, seed or 0, found.method)
    missed = [point for point in found.points if not point.evaluation.reached]
    if missed:
        values_text = ", ".join(f"{k}={v}" for k, v in missed[0].values.items())
        refuse(
            f"the standard error was not reached at {len(missed)} of {number_of(len(found.points), 'point')}, "
            f"first at {values_text}; give a larger --standard-error"
        )


@app.command(epilog=EXAMPLE + "taciturn compare two-mass two-mass-lqg --rate 0.3")
def compare(
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE FILE…", help="Problem files with the policies to compare.", autocompletion=complete_file
        ),
    ],
    rate: Annotated[
        float | None,
        typer.Option(
            help="Rate at which the policies are compared, in packets per step or per second. Default: the rate of "
            "the first policy."
        ),
    ] = None,
    traffic: Annotated[
        float | None,
        typer.Option(
            help="Traffic at which the policies are compared, in place of --rate: the sum of the rates of all "
            "links, each multiplied by the price of a packet."
        ),
    ] = None,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    link: Link = None,
    as_json: Json = False,
    verbose: Verbose = False,
    plot: Plot = None,
    style: PictureStyle = None,
    seed: GivenSeed = None,
    standard_error: Annotated[
        float | None,
        typer.Option(help="Requested standard error of each cost. Default: 3e-4 of the cost of sending every sample."),
    ] = None,
    time: TimeLimit = None,
) -> None:
    """Rank several policies at the same rate, with the standard errors of their cost differences."""
    import taciturn
    from taciturn.extend import answered_within

    with answered_within(time):
        problems = load_all(files, settings, no_functions)
        with progress_bar("comparing") as progress:
            found = taciturn.compare(
                problems, rate, traffic=traffic, link=cast("Any", link), seed=seed or 0, standard_error=standard_error,
                progress=progress,
            )  # fmt: skip
    drawn = any(one.tuned.evaluation.drawn for one in found.ranking)
    print_result(found, as_json, verbose, problems, seed or 0, unused=None if drawn else seed)
    save_picture(found, plot, style, as_json, problems, seed or 0, found.method)
    missed = [one.name for one in found.ranking if not one.reached]
    if missed:
        refuse(f"rate or standard error were not reached by {', '.join(missed)}; give a larger --standard-error")


@app.command(epilog=EXAMPLE + "taciturn tune two-mass --rate 0.3")
def tune(
    file: File,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    rate: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[LINK=]X|P%",
            help="Budget on the rate: packets per step or per second (0.5), or a percentage of all samples (50%). "
            "LINK= sets the budget of one link.",
        ),
    ] = None,
    traffic: Annotated[
        str | None,
        typer.Option(
            metavar="X|P%",
            help="Budget on the traffic: the sum of the rates of all links, each multiplied by the price of a packet.",
        ),
    ] = None,
    cost: Annotated[
        str | None,
        typer.Option(
            metavar="X|+P%",
            help="Budget on the cost: a number, or a percentage above the cost of sending every sample, e.g. +5%.",
        ),
    ] = None,
    violation: Annotated[
        float | None,
        typer.Option(
            help="Budget on violations: the share of the steps in which the states violate their limits, such as 1e-3."
        ),
    ] = None,
    link: Link = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="OUT.toml", help="Problem file to write, with the tuned parameter. It must not exist."),
    ] = None,
    least_period: Annotated[
        float | None, typer.Option(help="Also tune the sampling period; its smallest value is this number of seconds.")
    ] = None,
    buffer: Annotated[
        str | None,
        typer.Option(
            metavar="LINK",
            help="Find the buffer of this link with the least cost among its possible delays; without a budget, that "
            "of sending every sample.",
        ),
    ] = None,
    as_json: Json = False,
    verbose: Verbose = False,
    plot: Plot = None,
    style: PictureStyle = None,
    seed: GivenSeed = None,
    standard_error: StandardError = None,
    time: TimeLimit = None,
) -> None:
    """Tune a policy to meet a budget on its rate, its cost, or the violations of limits, or a receiver's buffer."""
    import taciturn
    from taciturn.extend import answered_within
    from taciturn_studies.buffers import tune_buffer
    from taciturn_studies.tune import TunedPeriod, tune_period

    allowed, spent, paid = _rates(rate), _budget("cost", cost), _budget("traffic", traffic)
    if out is not None:
        _expect_new(out)
    with answered_within(time):
        problem, on = load_changed(file, settings, no_functions), cast("Any", link)
        with progress_bar("searching") as progress:
            if buffer is not None:
                if least_period is not None:
                    raise taciturn.ProblemError(
                        "--buffer and --least-period are both given; expected one of them: the best buffer depends on "
                        "the period"
                    )
                found = tune_buffer(
                    problem,
                    buffer,
                    rate=allowed,
                    cost=spent,
                    traffic=paid,
                    violation=violation,
                    link=on,
                    seed=seed or 0,
                    standard_error=standard_error,
                    progress=progress,
                )
            elif least_period is None:
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
    print_result(found, as_json, verbose, best.problem, unused=None if best.drawn else seed)
    save_picture(found, plot, style, as_json, best.problem, seed or 0, best.method)
    if out is not None:
        _write(best, file, out)
        if not as_json:
            typer.echo(f"written: {out}")
    if not best.reached:
        refuse("the budget, or the standard error of the cost, was not reached; give a larger --standard-error")


def _expect_new(out: Path) -> None:
    """Raise an error unless a problem file with this name can be written."""
    from taciturn.errors import ProblemError
    from taciturn.extend import check_format

    check_format(out, (".toml",), "problem file")
    if out.exists():
        raise ProblemError(f"the file {out} already exists; expected the name of a new file: files are not overwritten")


def _write(found: Tuned | TunedBuffer, file: str, out: Path) -> None:
    """Write the problem file with what was tuned."""
    from taciturn.extend import write_whole
    from taciturn.problem.write import tables_text

    tables = {**(found.problem.source or {})}
    policy = tables.pop("policy", {})
    line = f"# Written by taciturn tune, from {file}: {found.aim}."
    write_whole(out, f"{line}\n\n{tables_text({**tables, 'policy': policy})}".encode())


def _rates(texts: Sequence[str] | None) -> float | str | dict[str, float | str] | None:
    """Return the budget of --rate, or the budgets by link."""
    from taciturn.errors import ProblemError
    from taciturn_studies.goal import parse_budget

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
    from taciturn_studies.goal import parse_budget

    return None if text is None else parse_budget(name, text)
