"""What all commands share: the application, its options, and how it ends."""

from __future__ import annotations

import json
import logging
import os
import sys
import warnings
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core

from taciturn._blas import prefer_one_thread
from taciturn.cli.words import complete_file, complete_from, complete_kind

if TYPE_CHECKING:
    from taciturn._progress import Progress
    from taciturn.problem import Problem

GROUPS = {
    "Design and look": ("new", "show", "tune"),
    "Measure and prove": ("evaluate", "simulate", "certify", "bench"),
    "Compare": ("tradeoff", "compare", "sweep", "channel"),
    "Run": ("network", "node", "plant", "relay", "twin", "camera"),
    "Export": ("export",),
    "Reproduce the thesis": ("reproduce",),
}
"""The commands by what one wants, as --help lists them."""
HELP = """Event-triggered control for linear systems, with guarantees on performance and on the transmission rate.

\b
First a built-in problem, then one of your own:
  taciturn evaluate two-mass    what a policy costs, how often it sends, what is proved
  taciturn new mine.toml        a problem file for your plant, by answering questions
  taciturn tradeoff mine.toml --over theta=0.1,1,10 --plot mine.svg
"""
READ_ON = """\b
Every command has an example in its own --help. FILE is a problem file, or a
built-in problem: a shell completes them after taciturn --install-completion.
Read on: docs/first-hour, docs/command-line, docs/problem-file (all keys).
Exit code 0, or 2 with one sentence on standard error.
"""


class Groups(typer.core.TyperGroup):
    """Lists commands by what one wants, each with its whole sentence."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section for each group."""
        for title, names in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(name, (self.commands[name].help or "").partition("\n")[0]) for name in names])


app = typer.Typer(
    name="taciturn",
    cls=Groups,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

File = Annotated[
    str,
    typer.Argument(
        metavar="FILE",
        help="A problem file, or the name of a built-in problem, as two-mass.",
        autocompletion=complete_file,
    ),
]
Kind = Annotated[
    str | None,
    typer.Option(metavar="KIND", help="Of policy, as lqg. Default: asked for.", autocompletion=complete_kind),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
Seed = Annotated[int, typer.Option(help="Seed of the draws.")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE", help="Changes a key of [policy], or a dotted one, as cost.R; none removes it."
    ),
]
GivenSeed = Annotated[int | None, typer.Option("--seed", help="Seed of the draws. Default: 0.")]
Link = Annotated[
    str | None,
    typer.Option(
        help="sensor or actuator: whose rate, where a policy decides on both.",
        autocompletion=complete_from("sensor", "actuator"),
    ),
]
Plot = Annotated[Path | None, typer.Option(metavar="OUT", help="Picture: .svg, .png or .pdf.")]
Confidence = Annotated[
    float | None, typer.Option(help="Of the lower bound. Default: 0.999 where there is one; 0: seek none.")
]
Steps = Annotated[int | None, typer.Option(help="Run this many steps of all paths together instead.")]
TimeLimit = Annotated[
    float | None,
    typer.Option(
        "--time", metavar="SECONDS", help="At most so long: then the best answer so far. Default: until it is reached."
    ),
]
StandardError = Annotated[float | None, typer.Option(help="Of the cost, absolute. Default: 1e-4 of the cost.")]


@app.callback(invoke_without_command=True, help=HELP, epilog=READ_ON)
def _root(
    context: typer.Context, version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False
) -> None:
    """Event-triggered control for linear systems, with guarantees on performance and on the transmission rate."""
    if version:
        from taciturn import __version__

        typer.echo(__version__)
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


def main() -> None:
    """Run the command line: exit code 0, or 2 with one sentence on standard error."""
    from taciturn.errors import TaciturnError

    prefer_one_thread()
    reconfigure = getattr(sys.stdout, "reconfigure", None)
    if reconfigure is not None:  # a terminal that has no ≤ gets \u2264, not an error
        reconfigure(errors="backslashreplace")
    try:
        with _messages(), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # what overflows is refused in a sentence, where it matters
            warnings.formatwarning = _as_sentence
            code: object = app(prog_name="taciturn", standalone_mode=False)
        print(end="", flush=True)
    except TaciturnError as error:
        refuse(str(error))
    except typer.TyperException as error:
        refuse(error.format_message() + _elsewhere(error))
    except (typer.Abort, KeyboardInterrupt):
        sys.exit(130)
    except BrokenPipeError:
        drop_output()
        sys.exit(1)
    except OSError as error:
        drop_output()
        refuse(f"reading or writing failed ({error}); expected files that can be opened and a disk with room")
    except (ArithmeticError, MemoryError) as error:
        refuse(
            f"a number of this problem is out of range ({error.args[-1] if error.args else type(error).__name__}); "
            "expected sizes nearer to 1: scale the problem"
        )
    else:
        sys.exit(code if isinstance(code, int) else 0)


def _elsewhere(error: Exception) -> str:
    """Say where other values of a parameter are asked for, to whom typed them as options of these commands."""
    command = getattr(getattr(error, "ctx", None), "info_name", None)
    if not hasattr(error, "option_name") or command not in ("evaluate", "reproduce"):
        return ""
    return f"; {command} takes no parameters: taciturn tradeoff FILE --over NAME=v1,v2,… does"


class _Sentences(logging.Handler):
    """Says what is logged on standard error, whichever that is by then."""

    def emit(self, record: logging.LogRecord) -> None:
        """Say it."""
        print(f"taciturn: {record.getMessage()}", file=sys.stderr)


@contextmanager
def _messages() -> Generator[None]:
    """Say what the library logs while a command runs."""
    logger, handler = logging.getLogger("taciturn"), _Sentences()
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(logging.NOTSET)


def _as_sentence(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """Return a warning without the place in the source that it came from."""
    return f"taciturn: {message}\n"


def refuse(sentence: str) -> None:
    """End with a sentence on standard error and exit code 2."""
    print(end="", flush=True)  # what was found stands before what is wrong with it
    shown = "".join(letter if letter.isprintable() else " " for letter in sentence)
    print(f"taciturn: {' '.join(shown.split())}", file=sys.stderr)
    sys.exit(2)


def drop_output() -> None:
    """Let what is still buffered go nowhere, so that Python does not complain of it when it ends."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def print_json(document: object) -> None:
    """Print one JSON document."""
    typer.echo(json.dumps(document, indent=1, allow_nan=False))


def can_print(letters: str) -> bool:
    """Tell whether standard output can show these letters."""
    try:
        letters.encode(sys.stdout.encoding or "ascii")
    except UnicodeError:
        return False
    return True


def check_effort(standard_error: float | None, steps: int | None = None) -> None:
    """Refuse what no simulation can do, whether or not this problem is simulated."""
    from taciturn._arrays import count, number

    if standard_error is not None:
        number("--standard-error", standard_error, 0.0)
    if steps is not None:
        count("--steps", steps)
        number("--steps", steps, high=1e13)  # hours


@contextmanager
def progress_bar(what: str, cells: int | None = None) -> Generator[Progress]:
    """A bar on standard error with the time left, on a terminal only, once a run takes long enough to be seen.

    Args:
        what: is done.
        cells: are counted beside the bar, where there are so many.
    """
    if not sys.stderr.isatty():
        yield lambda fraction: None
        return
    from rich.console import Console
    from rich.progress import Progress as Bar

    with Bar(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)  # it moves to and fro until a fraction is known

        def move(fraction: float) -> None:
            counted = "" if cells is None else f" {int(fraction * cells + 1e-6)}/{cells} cells"
            bar.update(task, total=1.0, completed=fraction, description=what + counted)

        yield move


def load_changed(file: str, settings: list[str] | None) -> Problem:
    """Return the problem of a file with the keys that --set changes."""
    from taciturn import load
    from taciturn._grid import parse_settings

    problem, changes = load(file), parse_settings(settings or [])
    return problem.changed(changes) if changes else problem


def note_seed(seed: int | None, drawn: bool) -> None:
    """Print a note where a seed is given and nothing was drawn."""
    if seed is not None and not drawn:
        typer.echo(f"note: --seed {seed} had no effect: nothing was drawn")
