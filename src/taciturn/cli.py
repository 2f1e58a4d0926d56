"""The command line. Everything heavy is imported when a command runs, so that help is quick."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from taciturn.simulation.average import Progress
    from taciturn.study.evaluate import Evaluation
    from taciturn.study.reproduce import Reproduction, Table
    from taciturn.study.tradeoff import Tradeoff

app = typer.Typer(
    name="taciturn",
    help="Event-triggered control for linear systems, with guarantees on performance and on the transmission rate.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

File = Annotated[str, typer.Argument(metavar="FILE", help="A problem file, or the name of a built-in problem (two-mass).")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
Seed = Annotated[int, typer.Option(help="Seed of the draws.")]
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
) -> None:
    """Cost, rate and guarantee of one policy."""
    from typing import cast

    import taciturn

    problem = taciturn.load(file)
    with _progress("simulating") as progress:
        found = taciturn.evaluate(
            problem, seed=seed, standard_error=standard_error, steps=steps, method=cast("Any", method), progress=progress
        )
    if as_json:
        typer.echo(json.dumps(found.document(), indent=1))
    else:
        _print_evaluation(found)
    if not found.reached:
        wanted = "1e-4 of the cost" if standard_error is None else f"{standard_error:g}"
        _refuse(f"the standard error {wanted} was not reached within {found.steps} steps; reached {found.cost.standard_error:.3g}: "
                "ask for a larger --standard-error")  # fmt: skip


@app.command()
def tradeoff(
    file: File,
    over: Annotated[list[str], typer.Option(metavar="NAME=v1,v2,…", help="A key of [policy], or dotted; repeat for a grid.")],
    as_json: Json = False,
    plot: Annotated[Path | None, typer.Option(metavar="OUT", help="Picture: .svg, .png or .pdf.")] = None,
    seed: Seed = 0,
    standard_error: StandardError = None,
) -> None:
    """Cost against rate over a parameter, beside optimal periodic control and the guarantee."""
    import taciturn
    from taciturn._figure import check_format, save

    values = dict(_parse_over(item) for item in over)
    if plot is not None:
        check_format(plot)
    problem = taciturn.load(file)
    with _progress("simulating") as progress:
        found = taciturn.tradeoff(problem, values, seed=seed, standard_error=standard_error, progress=progress)
    if plot is not None:
        save(found.plot(), plot)
    if as_json:
        typer.echo(json.dumps(found.document(), indent=1))
    else:
        _print_tradeoff(found)
        if plot is not None:
            typer.echo(f"picture: {plot}")
    missed = [point for point in found.points if not point.evaluation.reached]
    if missed:
        values_text = ", ".join(f"{k}={v}" for k, v in missed[0].values.items())
        _refuse(f"the standard error was not reached at {len(missed)} points, first at {values_text}: ask for a larger --standard-error")


@app.command()
def reproduce(
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME…]", help="chapter2, or all (the default).")] = None,
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
        raise ProblemError(f"there is nothing to reproduce by the name {unknown[0]!r}; expected one of {', '.join(CHAPTERS)}, or all")
    folder = out or Path()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ProblemError(f"the folder {str(folder)!r} cannot be made ({error}); expected one that can be written to") from None
    documents: list[dict[str, Any]] = []
    for name in chosen:
        with _progress(name) as progress:
            found = taciturn.reproduce(name, seed=seed, progress=progress)
        picture = folder / f"{name}.svg"
        if found.picture is not None and (out is not None or not as_json):
            save(found.picture, picture)
        documents.append(found.document())
        if not as_json:
            _print_reproduction(found)
            if found.picture is not None:
                typer.echo(f"picture: {picture}")
    if as_json:
        typer.echo(json.dumps(documents, indent=1))


def main() -> None:
    """Run the command line: exit code 0, or 2 with one sentence on standard error."""
    from taciturn.errors import TaciturnError

    try:
        code: object = app(standalone_mode=False)
    except TaciturnError as error:
        _refuse(str(error))
    except typer.TyperException as error:
        _refuse(error.format_message())
    except (typer.Abort, KeyboardInterrupt):
        sys.exit(130)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(1)
    else:
        sys.exit(code if isinstance(code, int) else 0)


def _refuse(sentence: str) -> None:
    sys.stdout.flush()
    print(f"taciturn: {' '.join(sentence.split())}", file=sys.stderr)
    sys.exit(2)


@contextmanager
def _progress(what: str) -> Iterator[Progress]:
    """A bar on standard error with the time left, on a terminal only, once a run takes long enough to be seen."""
    if not sys.stderr.isatty():
        yield lambda fraction: None
        return
    from rich.console import Console
    from rich.progress import Progress as Bar

    with Bar(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda fraction: bar.update(task, completed=fraction)


def _parse_over(item: str) -> tuple[str, list[object]]:
    from taciturn.errors import ProblemError

    name, separator, listed = item.partition("=")
    parts = [part.strip() for part in listed.split(",")]
    if not separator or not name.strip() or not all(parts):
        raise ProblemError(f"--over {item!r} is not understood; expected NAME=v1,v2,…, as theta=0.1,1")
    return name.strip(), [_parse_value(part) for part in parts]


def _parse_value(text: str) -> object:
    for convert in (int, float):
        try:
            return convert(text)
        except ValueError:
            continue
    return text


def _print_evaluation(found: Evaluation) -> None:
    lines = [("policy", found.policy), ("cost", f"{found.cost}   ({found.cost.method})")]
    lines += [(f"rate, {link}", str(rate)) for link, rate in found.rates.items()]
    if found.cost_all_time is not None:
        above = 100 * (found.cost.value / found.cost_all_time - 1) if found.cost_all_time else 0.0
        lines.append(("all-time cost", f"{found.cost_all_time:.6g}   (this policy: {above:+.2f} %)"))
    if found.cost_bound is not None:
        lines.append(("guaranteed", f"at most {found.cost_bound:.6g}"))
    lines += [("note", note) for note in found.notes]
    for name, text in lines:
        typer.echo(f"{name:14s} {text}")


def _print_tradeoff(found: Tradeoff) -> None:
    names = list(found.points[0].values)
    header = [*names, f"rate per {found.unit}", "saved %", f"cost per {found.unit}", "above all-time %", "guaranteed ≤", "periodic, same rate"]
    rows: list[list[str]] = []
    for point in found.points:
        e = point.evaluation
        rate = next(iter(e.rates.values()))
        above = "" if not e.cost_all_time else f"{100 * (e.cost.value / e.cost_all_time - 1):.2f}"
        rows.append([
            *(str(value) for value in point.values.values()),
            f"{rate.value:.4f} ± {rate.standard_error:.4f}",
            f"{100 * (1 - rate.value / found.base_rate):.1f}",
            str(e.cost),
            above,
            "" if e.cost_bound is None else f"{e.cost_bound:.4f}",
            "unstable" if point.cost_periodic_same_rate is None else f"{point.cost_periodic_same_rate:.5f}",
        ])  # fmt: skip
    _print_table(header, rows)
    first = found.points[0].evaluation
    if first.cost_all_time is not None:
        typer.echo(f"all-time cost {first.cost_all_time:.6g}" + (f"; guarantee: {found.guarantee}" if found.guarantee else ""))
    for note in first.notes:
        typer.echo(note)


def _print_reproduction(found: Reproduction) -> None:
    for table in found.tables:
        typer.echo(f"\n{table.name}")
        _print_table(*_beside(table))
        for note in table.notes:
            typer.echo(f"  {note}")


def _beside(table: Table) -> tuple[list[str], list[list[str]]]:
    """Printed beside computed, column by column."""
    columns = list(table.rows[0].computed)
    printed = [name for name in columns if any(name in row.printed for row in table.rows)]
    header = list(table.rows[0].setting)
    for name in columns:
        header += [f"{name}, printed", "computed"] if name in printed else [name]
    rows: list[list[str]] = []
    for row in table.rows:
        cells = [str(value) for value in row.setting.values()]
        for name in columns:
            if name in printed:
                cells.append(f"{row.printed[name]:g}" if name in row.printed else "")
            cells.append(str(row.computed[name]) if name in row.computed else "")
        rows.append(cells)
    return header, rows


def _print_table(header: list[str], rows: list[list[str]]) -> None:
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    for row in [header, *rows]:
        typer.echo("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


if __name__ == "__main__":
    main()
