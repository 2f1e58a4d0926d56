"""The command line. Everything heavy is imported when a command runs, so that help is quick."""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from taciturn import _print

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from taciturn.simulation.sampling import Progress

app = typer.Typer(
    name="taciturn",
    help="Event-triggered control for linear systems, with guarantees on performance and on the transmission rate.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

File = Annotated[
    str, typer.Argument(metavar="FILE", help="A problem file, or the name of a built-in problem, as two-mass.")
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
Seed = Annotated[int, typer.Option(help="Seed of the draws.")]
Link = Annotated[str | None, typer.Option(help="sensor or actuator: whose rate, where a policy decides on both.")]
Plot = Annotated[Path | None, typer.Option(metavar="OUT", help="Picture: .svg, .png or .pdf.")]
Confidence = Annotated[
    float | None, typer.Option(help="Of the lower bound. Default: 0.999 where there is one; 0: seek none.")
]
StandardError = Annotated[float | None, typer.Option(help="Of the cost, absolute. Default: 1e-4 of the cost.")]


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context, version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False
) -> None:
    """Event-triggered control for linear systems, with guarantees on performance and on the transmission rate."""
    if version:
        from taciturn import __version__

        typer.echo(__version__)
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command()
def evaluate(
    file: File,
    as_json: Json = False,
    seed: Seed = 0,
    standard_error: StandardError = None,
    steps: Annotated[int | None, typer.Option(help="Run this many steps of all paths together instead.")] = None,
    method: Annotated[str, typer.Option(help="auto, simulation or exact.")] = "auto",
    precision: Annotated[str, typer.Option(help="Of what is simulated: float64 or float32.")] = "float64",
    confidence: Confidence = None,
) -> None:
    """Cost, rate and guarantee of one policy."""
    import taciturn
    from taciturn.study.evaluate import choose_confidence

    _check_effort(standard_error, steps)
    problem = taciturn.load(file)
    with _progress("computing") as progress:
        found = taciturn.evaluate(
            problem,
            seed=seed,
            standard_error=standard_error,
            steps=steps,
            method=cast("Any", method),
            precision=cast("Any", precision),
            confidence=choose_confidence(problem, confidence),
            progress=progress,
        )
    if as_json:
        _print_json(found.document())
    else:
        _print.evaluation(found)
    if not found.reached and steps is not None:
        _refuse(f"the loop has not settled within {found.steps} steps: ask for more --steps")
    if not found.reached and standard_error is not None and found.cost.standard_error <= standard_error:
        _refuse(
            f"the loop has not settled within {found.steps} steps: its time constants, or the intervals between sends, "
            "are too many ticks; take a longer period"
        )
    if not found.reached:
        wanted = "1e-4 of the cost" if standard_error is None else f"{standard_error:g}"
        _refuse(
            f"the standard error {wanted} was not reached within {found.steps} steps; "
            f"reached {found.cost.standard_error:.3g}: ask for a larger --standard-error"
        )


@app.command()
def tradeoff(
    file: File,
    over: Annotated[
        list[str], typer.Option(metavar="NAME=v1,v2,…", help="A key of [policy], or dotted; repeat for a grid.")
    ],
    as_json: Json = False,
    plot: Plot = None,
    seed: Seed = 0,
    standard_error: StandardError = None,
    confidence: Confidence = None,
) -> None:
    """Cost against rate over a parameter, beside optimal periodic control and the guarantee."""
    import taciturn
    from taciturn._figure import check_format, save
    from taciturn._grid import parse_grid
    from taciturn.study.evaluate import choose_confidence

    _check_effort(standard_error)
    values = parse_grid(over)
    if plot is not None:
        check_format(plot)
    problem = taciturn.load(file)
    with _progress("computing") as progress:
        found = taciturn.tradeoff(
            problem,
            values,
            seed=seed,
            standard_error=standard_error,
            confidence=choose_confidence(problem, confidence),
            progress=progress,
        )
    if as_json:
        _print_json(found.document())
    else:
        _print.tradeoff(found)
    if plot is not None:  # after the numbers, which a picture that cannot be written must not take away
        save(found.plot(), plot)
        if not as_json:
            typer.echo(f"picture: {plot}")
    missed = [point for point in found.points if not point.evaluation.reached]
    if missed:
        values_text = ", ".join(f"{k}={v}" for k, v in missed[0].values.items())
        _refuse(
            f"the standard error was not reached at {len(missed)} of {len(found.points)} points, "
            f"first at {values_text}: ask for a larger --standard-error"
        )


@app.command()
def tune(
    file: File,
    rate: Annotated[float | None, typer.Option(help="Sends per step or per second that are to be met.")] = None,
    cost: Annotated[float | None, typer.Option(help="Cost that is to be met.")] = None,
    link: Link = None,
    least_period: Annotated[
        float | None, typer.Option(help="Seek the period of the checks as well, down to so many seconds.")
    ] = None,
    as_json: Json = False,
    seed: Seed = 0,
    standard_error: StandardError = None,
) -> None:
    """The parameter of a policy that meets a rate or a cost."""
    import taciturn
    from taciturn.study.periods import TunedPeriod

    _check_effort(standard_error)
    problem, on = taciturn.load(file), cast("Any", link)
    with _progress("searching") as progress:
        if least_period is None:
            found = taciturn.tune(
                problem, rate=rate, cost=cost, link=on, seed=seed, standard_error=standard_error, progress=progress
            )
        else:
            if rate is None or cost is not None:
                raise taciturn.ProblemError("--least-period is given; expected --rate alone beside it, the budget")
            found = taciturn.tune_period(
                problem,
                rate=rate,
                least=least_period,
                link=on,
                seed=seed,
                standard_error=standard_error,
                progress=progress,
            )
    best = found.best if isinstance(found, TunedPeriod) else found
    if as_json:
        _print_json(found.document())
    else:
        if isinstance(found, TunedPeriod):
            _print.periods(found)
        _print.tuned(best)
    if not best.evaluation.reached:
        _refuse("the budget, or the standard error of the cost, was not reached: ask for a larger --standard-error")


@app.command()
def compare(
    files: Annotated[list[str], typer.Argument(metavar="FILE FILE…", help="Problems that differ in their policies.")],
    rate: Annotated[float, typer.Option(help="Sends per step or per second, the same for all.")],
    link: Link = None,
    as_json: Json = False,
    plot: Plot = None,
    seed: Seed = 0,
    standard_error: Annotated[float | None, typer.Option(help="Of each cost. Default: 3e-4 of all-time's.")] = None,
) -> None:
    """Several policies at the same rate, ranked, with the standard errors of their differences."""
    import taciturn
    from taciturn._figure import check_format, save

    _check_effort(standard_error)
    if plot is not None:
        check_format(plot)
    stems = [Path(file).stem for file in files]
    names = [stem if stems.count(stem) == 1 else f"{stem} ({i + 1})" for i, stem in enumerate(stems)]
    problems = {name: taciturn.load(file) for name, file in zip(names, files, strict=True)}
    with _progress("comparing") as progress:
        found = taciturn.compare(
            problems, rate, link=cast("Any", link), seed=seed, standard_error=standard_error, progress=progress
        )
    if as_json:
        _print_json(found.document())
    else:
        _print.comparison(found)
    if plot is not None:
        save(found.plot(), plot)
        if not as_json:
            typer.echo(f"picture: {plot}")
    missed = [one.name for one in found.ranking if not one.reached]
    if missed:
        _refuse(f"rate or standard error were not reached by {', '.join(missed)}: ask for a larger --standard-error")


@app.command()
def certify(file: File, as_json: Json = False) -> None:
    """Decay, gain and cost that are proved by matrix inequalities, beside sending always."""
    import taciturn

    with _progress("certifying"):
        found = taciturn.certify(taciturn.load(file))
    if as_json:
        _print_json(found.document())
    else:
        _print.certificates(found)


@app.command()
def reproduce(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME…]", help="chapter2 to chapter7, or all (the default)."),
    ] = None,
    as_json: Json = False,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the pictures. Default: here.")] = None,
    seed: Seed = 0,
) -> None:
    """The thesis's tables and figures, printed beside computed."""
    import taciturn
    from taciturn._figure import save
    from taciturn.errors import ProblemError
    from taciturn.study.reproduce import CHAPTERS

    chosen = list(CHAPTERS) if not names or "all" in names else names
    unknown = [name for name in chosen if name not in CHAPTERS]
    if unknown:
        raise ProblemError(
            f"there is nothing to reproduce by the name {unknown[0]!r}; expected one of {', '.join(CHAPTERS)}, or all"
        )
    folder = out or Path()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ProblemError(
            f"the folder {str(folder)!r} cannot be made ({error.strerror}); expected one that can be written to"
        ) from None
    documents: list[dict[str, Any]] = []
    pictures: dict[Path, Figure] = {}
    for name in chosen:
        with _progress(name) as progress:
            found = taciturn.reproduce(name, seed=seed, progress=progress)
        documents.append(found.document())
        pictures |= {folder / f"{file}.svg": picture for file, picture in found.pictures.items()}
        if not as_json:
            _print.reproduction(found)
    if as_json:
        _print_json(documents)
    for path, picture in pictures.items():  # after the numbers, which must not be lost with a picture
        if out is not None or not as_json:
            save(picture, path)
            if not as_json:
                typer.echo(f"picture: {path}")


@app.command()
def bench(
    as_json: Json = False,
    rounds: Annotated[int, typer.Option(help="Of which medians are taken.")] = 5,
) -> None:
    """How fast this machine simulates, beside NumPy."""
    from taciturn.study.bench import bench as measure

    with _progress("measuring") as progress:
        found = measure(rounds, progress)
    if as_json:
        _print_json(found.document())
    else:
        _print.bench(found)


def main() -> None:
    """Run the command line: exit code 0, or 2 with one sentence on standard error."""
    from taciturn.errors import TaciturnError

    reconfigure = getattr(sys.stdout, "reconfigure", None)
    if reconfigure is not None:  # a terminal that has no ≤ gets \u2264, not an error
        reconfigure(errors="backslashreplace")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # what overflows is refused in a sentence, where it matters
            warnings.formatwarning = _as_sentence
            code: object = app(standalone_mode=False)
        print(end="", flush=True)
    except TaciturnError as error:
        _refuse(str(error))
    except typer.TyperException as error:
        _refuse(error.format_message())
    except (typer.Abort, KeyboardInterrupt):
        sys.exit(130)
    except BrokenPipeError:
        _drop_output()
        sys.exit(1)
    except OSError as error:
        _drop_output()
        _refuse(f"reading or writing failed ({error}); expected files that can be opened and a disk with room")
    except (ArithmeticError, MemoryError) as error:
        _refuse(
            f"a number of this problem is out of range ({error.args[-1] if error.args else type(error).__name__}); "
            "expected sizes nearer to 1: scale the problem"
        )
    else:
        sys.exit(code if isinstance(code, int) else 0)


def _as_sentence(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """Return a warning without the place in the source that it came from."""
    return f"taciturn: {message}\n"


def _refuse(sentence: str) -> None:
    print(end="", flush=True)  # what was found stands before what is wrong with it
    shown = "".join(letter if letter.isprintable() else " " for letter in sentence)
    print(f"taciturn: {' '.join(shown.split())}", file=sys.stderr)
    sys.exit(2)


def _drop_output() -> None:
    """Let what is still buffered go nowhere, so that Python does not complain of it when it ends."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _print_json(document: object) -> None:
    typer.echo(json.dumps(document, indent=1, allow_nan=False))


def _check_effort(standard_error: float | None, steps: int | None = None) -> None:
    """Refuse what no simulation can do, whether or not this problem is simulated."""
    from taciturn._arrays import count, number

    if standard_error is not None:
        number("--standard-error", standard_error, 0.0)
    if steps is not None:
        count("--steps", steps)
        number("--steps", steps, high=1e13)  # hours


@contextmanager
def _progress(what: str) -> Generator[Progress]:
    """A bar on standard error with the time left, on a terminal only, once a run takes long enough to be seen."""
    if not sys.stderr.isatty():
        yield lambda fraction: None
        return
    from rich.console import Console
    from rich.progress import Progress as Bar

    with Bar(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)  # it moves to and fro until a fraction is known
        yield lambda fraction: bar.update(task, total=1.0, completed=fraction)


if __name__ == "__main__":
    main()
