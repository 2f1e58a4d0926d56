"""The application: common options, printing and saving of results, completion of words, and exit codes.

Every command is a function with the options as arguments. Options of several commands are types here, such as ``File``,
``Settings`` (--set), ``Json`` and ``Plot``; commands of other packages use them too. They are stated here and not taken
from the signatures of the functions that commands call, since these need numpy, and ``taciturn --help`` must answer at
once; so this module imports nothing heavy before a command runs. A test compares both lists.

A command ends by ``print_result``, ``save_picture``, and by ``refuse`` if a requested accuracy is not reached.

``usage`` reads the words of the command line, and has the sentences about mistakes in them.

A shell completes files, built-in problems, policy kinds and links; no kind is imported for this.
"""

from __future__ import annotations

import json
import logging
import os
import select
import sys
import time
import tomllib
import warnings
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, Protocol, TextIO

import typer
import typer.core

from taciturn._files import read_text
from taciturn._plugins import problem_folders
from taciturn._process import Interrupted, ends_on_signals, has_ended, prefer_one_thread
from taciturn._text import WIDEST, number_of, wrapped_text
from taciturn.cli.usage import EXAMPLE as EXAMPLE
from taciturn.cli.usage import name_options, no_command, parser_words, usage_text
from taciturn.errors import TaciturnError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from taciturn._progress import Progress
    from taciturn._style import StyleName
    from taciturn.problem import Problem

LARGEST = 2**24  # bytes of a problem file


def complete_file(incomplete: str) -> list[str]:
    """List the built-in problems and TOML files that begin with ``incomplete``. If there are none, folders are
    listed.
    """
    folder = incomplete[: incomplete.rfind("/") + 1]
    try:
        files = sorted(f"{folder}{path.name}" for path in Path(folder or ".").glob("*.toml"))
    except OSError:
        files = []
    names = [*files, *sorted(path.stem for folder in problem_folders() for path in folder.glob("*.toml"))]
    return [name for name in names if name.startswith(incomplete)]


def complete_from(*words: str) -> Callable[[str], list[str]]:
    """Create a function that lists those of the given words that begin with the typed letters."""

    def complete(incomplete: str) -> list[str]:
        return [word for word in words if word.startswith(incomplete)]

    return complete


def complete_kind(incomplete: str) -> list[str]:
    """List the policy kinds that begin with ``incomplete``, without importing any of them."""
    from taciturn.design.catalogue import CATALOGUE

    return complete_from(*CATALOGUE)(incomplete)


def complete_link(context: typer.Context, incomplete: str) -> list[str]:
    """List the links that begin with ``incomplete``, from the problem files earlier on the command line."""
    links = [link for word in context.args for link in _links(word)]
    return complete_from(*dict.fromkeys(links))(incomplete)


def _links(name: str) -> Iterable[str]:
    """Return the links of a problem file: one of each node that is not at the controller's place."""
    paths = (Path(name), *(folder / f"{name}.toml" for folder in problem_folders()))
    try:
        tables: dict[str, Any] = tomllib.loads(next(read_text(path, LARGEST) for path in paths if path.is_file()))
        nodes = tables.get("nodes", {"sensor": {}, "actuator": {}})
        (controller,) = (node for node, role in nodes.items() if role.get("controls")) if "nodes" in tables else ("",)
        return [node for node, role in nodes.items() if controller not in (node, role.get("site"))]
    except (
        StopIteration,
        OSError,
        ValueError,
        AttributeError,
        RecursionError,
    ):  # a file that is not a problem has no links
        return ()


HELPING = "Help"  # the group that --help lists last
GROUPS: dict[str, list[str]] = {
    "Design and inspect": ["new", "show", "tune"],
    "Measure and prove": ["evaluate", "simulate", "certify", "bench"],
    "Compare": ["tradeoff", "compare", "sweep", "channel"],
    "Run": ["network", "node", "plant", "setpoint", "relay"],
    "Export": ["export"],
    HELPING: ["help", "version"],
}
"""The commands by purpose, as --help lists them; another package appends its commands."""
HELP = """Event-triggered control for linear systems, with guarantees on performance and on the transmission rate.

\b
Start with a built-in problem, then describe your own:
  taciturn evaluate two-mass    cost, rate, guarantee, periodic control
  taciturn new mine.toml        a problem file for your plant
  taciturn tradeoff mine.toml --over theta=0.01,0.1,1 --plot mine.svg
"""
READ_ON = """\b
Each command shows an example in its own --help. FILE is a problem file or
the name of a built-in problem, which a shell completes after
taciturn --install-completion. See docs/first-hour, docs/command-line (all
commands) and docs/problem-file (all keys).
Exit code: 0, or 2 with one sentence on standard error; after Ctrl-C 130,
SIGTERM 143, SIGHUP 129.
"""


class Groups(typer.core.TyperGroup):
    """Group of commands, whose help sorts them by purpose and whose errors name the options that the user typed."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Find the command that the user typed, and convert the words after it to the form that the parser expects."""
        name, command, words = super().resolve_command(ctx, args)
        return name, command, words if command is None else parser_words(command, words)

    def invoke(self, ctx: Any) -> Any:
        """Run the command. If it raises an error, its message names the options that the user typed, not arguments."""

        try:
            return super().invoke(ctx)
        except TaciturnError as error:
            chosen = self.commands.get(ctx.invoked_subcommand or "")
            raise error if chosen is None else name_options(error, chosen) from None

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the help section by section, with one section for each group of commands."""
        for title, names in sorted(GROUPS.items(), key=lambda group: group[0] == HELPING):
            with formatter.section(title):
                formatter.write_dl([(name, (self.commands[name].help or "").partition("\n")[0]) for name in names])


app = typer.Typer(
    name="taciturn",
    cls=Groups,
    rich_markup_mode=None,
    context_settings={"max_content_width": WIDEST, "help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)

File = Annotated[
    str,
    typer.Argument(
        metavar="FILE",
        help="Problem file, or the name of a built-in problem, e.g. two-mass.",
        autocompletion=complete_file,
    ),
]
Kind = Annotated[
    str | None,
    typer.Option(
        metavar="KIND", help="Policy kind, e.g. lqg. Default: `taciturn new` asks for it.", autocompletion=complete_kind
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as one JSON document.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Also print the methods, seeds and computing times.")]
Seed = Annotated[int, typer.Option(help="Seed of the random numbers.")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Set a key of the problem: a key of [policy], or a dotted key such as cost.R. The value none "
        "removes the key.",
    ),
]
NoFunctions = Annotated[
    bool,
    typer.Option(
        "--no-functions", help="Refuse problem files that name Python functions, whose code would be executed."
    ),
]
GivenSeed = Annotated[int | None, typer.Option("--seed", help="Seed of the random numbers. Default: 0.")]
Link = Annotated[
    str | None,
    typer.Option(
        help="Link whose rate is meant if the policy decides on several links.",
        autocompletion=complete_link,
    ),
]


def _checked_picture(path: Path | None) -> Path | None:
    """Refuse a picture that cannot be written before anything is computed."""
    from taciturn._figure import check_format

    return None if path is None else check_format(path)


Plot = Annotated[
    Path | None,
    typer.Option(  # it is eager, so that the check of --style knows it
        metavar="OUT", help="Save a figure as .svg, .png or .pdf.", callback=_checked_picture, is_eager=True
    ),
]


def _checked_style(context: typer.Context, style: str | None) -> str | None:
    """Refuse an unknown style, or one without a figure, before anything is computed."""
    from taciturn._style import find_style
    from taciturn.errors import ProblemError

    if style is not None and context.params.get("plot") is None:
        raise ProblemError(
            "--style is given without --plot; expected both options: add --plot OUT, where OUT is the file of the "
            "figure"
        )
    return None if style is None else find_style(style).name


PictureStyle = Annotated[
    str | None,
    typer.Option(
        "--style",
        metavar="STYLE",
        help="Style of the figure that --plot saves: light (default), dark, paper (3.5 inches wide) or paper-wide "
        "(7.16 inches wide).",
        callback=_checked_style,
        autocompletion=complete_from("light", "dark", "paper", "paper-wide"),
    ),
]
Confidence = Annotated[
    float | None,
    typer.Option(
        help="Confidence level of the lower bound on the cost; 0 computes no bound. Default: 0.999 if a bound exists."
    ),
]
Steps = Annotated[int | None, typer.Option(help="Total number of simulated steps, in place of --standard-error.")]
TimeLimit = Annotated[
    float | None,
    typer.Option(
        "--time",
        metavar="SECONDS",
        help="Time limit in seconds, including the design of the policy. Default: no limit.",
    ),
]
StandardError = Annotated[
    float | None,
    typer.Option(help="Requested standard error of the cost, in the unit of the cost. Default: 1e-4 of the cost."),
]


@app.callback(invoke_without_command=True, help=HELP, epilog=READ_ON)
def _root(
    context: typer.Context, version: Annotated[bool, typer.Option("--version", "-V", help="Print the version.")] = False
) -> None:
    """Event-triggered control for linear systems, with guarantees on performance and on the transmission rate."""
    if version:
        print_version()
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


def complete_command(context: typer.Context, incomplete: str) -> list[str]:
    """List the commands that begin with ``incomplete``."""
    return complete_from(*_commands(context))(incomplete)


@app.command("help", epilog=EXAMPLE + "taciturn help evaluate")
def print_help(
    context: typer.Context,
    command: Annotated[
        str | None, typer.Argument(metavar="[COMMAND]", help="Command.", autocompletion=complete_command)
    ] = None,
) -> None:
    """Print the help of a command, or the list of all commands."""
    commands, root = _commands(context), context.find_root()
    if command is None:
        typer.echo(root.get_help())
    elif command in commands:
        typer.echo(commands[command].make_context(command, ["--help"], root, resilient_parsing=True).get_help())
    else:
        refuse(no_command(command, commands))


@app.command("version", epilog=EXAMPLE + "taciturn version")
def print_version() -> None:
    """Print the version."""
    from taciturn import __version__

    typer.echo(__version__)


def _commands(context: typer.Context) -> dict[str, Any]:
    group: Any = context.find_root().command
    return group.commands


def add_commands() -> None:
    """Import the commands of other packages. Print a message if an import fails or a command's name exists already."""
    from taciturn._plugins import find_plugins, load_plugin, package_of
    from taciturn.errors import ProblemError

    _replace_closed_streams()

    def names() -> list[str | None]:
        return [one.name or getattr(one.callback, "__name__", None) for one in app.registered_commands]

    for name, entries in find_plugins("taciturn.commands").items():
        known = names()
        try:
            load_plugin("taciturn.commands", name, "the command line")
        except ProblemError as error:
            print(_message(str(error)), file=sys.stderr)
        twice = [one for one in names()[len(known) :] if one in known]
        if twice:
            del app.registered_commands[len(known) :]
            sentence = (
                f"the commands of {package_of(entries[0])} are not used, since the command {twice[0]} exists already; "
                "expected another name: rename the command, or remove the package"
            )
            print(_message(sentence), file=sys.stderr)


def main() -> None:
    """Run the command line. The exit code is 0, or 2 after an error message, or 128 + signal number after a signal."""
    with ends_on_signals():
        _run()


def _run() -> None:

    prefer_one_thread()
    _replace_closed_streams()
    reconfigure = getattr(sys.stdout, "reconfigure", None)
    if reconfigure is not None:  # a terminal without ≤ shows \u2264 instead of an error
        reconfigure(errors="backslashreplace")
    try:
        with _messages(), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # an overflow that matters raises an error
            warnings.formatwarning = _as_sentence
            code: object = app(prog_name="taciturn", standalone_mode=False)
        print(end="", flush=True)
    except TaciturnError as error:
        refuse(str(error))
    except typer.TyperException as error:
        refuse(usage_text(error))
    except (typer.Abort, KeyboardInterrupt):
        sys.exit(130)
    except SystemExit as error:
        if isinstance(error.__context__, BrokenPipeError):  # typer exits with 1 and no message
            _end_broken(error.__context__)
        raise
    except OSError as error:
        _end_broken(error)
    except MemoryError:
        refuse("the computation needs more memory than there is; expected fewer steps, runs or states")
    except (ArithmeticError, ValueError) as error:
        if isinstance(error, ValueError) and type(error).__name__ != "LinAlgError":  # numpy may not be imported
            raise
        refuse(
            f"a number of this problem is out of range ({error.args[-1] if error.args else type(error).__name__}); "
            "expected numbers closer to 1: scale the problem"
        )
    else:
        sys.exit(code if isinstance(code, int) else 0)


class _Sentences(logging.Handler):
    """Prints log records to the current standard error stream."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a log record to standard error."""
        print(_message(record.getMessage()), file=sys.stderr)


@contextmanager
def _messages() -> Generator[None]:
    """Print the log of the library while a command runs."""
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
    """Return the text of a warning without its location in the source."""
    return f"{_message(str(message))}\n"


def _message(sentence: str) -> str:
    """Return a sentence for standard error: wrapped in a terminal, and on one line in a file."""
    text = f"taciturn: {sentence}"
    return wrapped_text(text) if sys.stderr.isatty() else text


def refuse(sentence: str) -> NoReturn:
    """Print an error message and exit with code 2. If a signal stopped the command, raise ``Interrupted`` instead."""
    if has_ended():
        raise Interrupted
    try:
        print(end="", flush=True)  # the results so far come before the error
    except OSError:  # a full disk
        drop_output()
    shown = "".join(letter if letter.isprintable() else " " for letter in sentence)
    try:
        print(_message(" ".join(shown.split())), file=sys.stderr, flush=True)
    except OSError:
        drop_output()
    sys.exit(2)


def drop_output() -> None:
    """Discard the buffered output of closed or full streams, so that Python prints no error about them at exit."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
            broken = _has_no_reader(stream)
        except OSError:
            broken = True
        if broken:
            with suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _end_broken(error: OSError) -> NoReturn:
    """End after an error of reading or writing; a reader of the output that left early, as ``head -1``, is none."""
    left = not hasattr(select, "poll") or any(map(_has_no_reader, (sys.stdout, sys.stderr)))
    if isinstance(error, BrokenPipeError) and left:
        drop_output()
        sys.exit(0)
    refuse(f"reading or writing failed ({error}); expected files that can be opened, and enough disk space")


def _has_no_reader(stream: TextIO) -> bool:
    """Return whether a stream is a pipe whose reader has closed it; False if this is unknown."""
    if sys.platform == "win32":  # which has no poll
        return False
    try:
        poll = select.poll()
        poll.register(stream.fileno(), select.POLLOUT)
    except (OSError, ValueError, AttributeError):  # a stream without a descriptor, or no poll
        return False
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def _replace_closed_streams() -> None:
    """Discard the output to streams that were closed when this process began, for which Python has None."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode, encoding="utf-8"))


def print_json(document: dict[str, Any], origin: Mapping[str, Any]) -> None:
    """Print a JSON document with the data that reproduce it. If both contain a key, the document's value is printed."""
    told = {name: value for name, value in origin.items() if name not in document}
    typer.echo(json.dumps(document | told, indent=1, allow_nan=False))


class Result(Protocol):
    """A result of a study that can be printed as text and as a JSON document."""

    def document(self) -> dict[str, Any]:
        """Return the JSON document."""
        ...

    def text(self, verbose: bool = False) -> str:
        """Return the text."""
        ...


class Drawn(Protocol):
    """A result that can draw itself as a figure."""

    def plot(self, *, style: StyleName) -> Figure:
        """Draw the figure in a style."""
        ...


def print_result(
    found: Result,
    as_json: bool,
    verbose: bool,
    problem: Problem | Mapping[str, Problem] | None = None,
    seed: int | None = None,
    *,
    unused: int | None = None,
) -> None:
    """Print a result as text, or as JSON with the data that reproduce it. Print a note if the seed has no effect."""
    from taciturn.study.record import origin

    if as_json:
        print_json(found.document(), origin(problem, seed))
    else:
        typer.echo(found.text(verbose))
        note_seed(unused, drawn=False)


def save_picture(
    found: Drawn,
    path: Path | None,
    style: str | None,
    as_json: bool,
    problem: Problem | Mapping[str, Problem],
    seed: int | None = None,
    method: str | None = None,
) -> None:
    """Save the figure of a result if a path is given. The numbers are printed first, so that a failure does not lose
    them.
    """
    from taciturn._figure import save
    from taciturn._style import find_style
    from taciturn.study.record import origin

    if path is not None:
        save(found.plot(style=find_style(style or "light").name), path, origin(problem, seed, method))
        if not as_json:
            typer.echo(f"picture: {path}")


def can_print(letters: str) -> bool:
    """Check whether the encoding of standard output contains these characters."""
    try:
        letters.encode(sys.stdout.encoding or "ascii")
    except UnicodeError:
        return False
    return True


SOON, LONG = 2.0, 100.0  # seconds before the remaining time is estimated, and from which it is in minutes


@contextmanager
def progress_bar(what: str, cells: int | None = None) -> Generator[Progress]:
    """While the block runs, show a progress bar with the remaining time, if standard error is a terminal."""
    if not sys.stderr.isatty():
        yield lambda fraction: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TextColumn("{task.fields[left]}")
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None, left="")  # indeterminate until a fraction is known
        began = time.monotonic()

        def move(fraction: float) -> None:
            counted = "" if cells is None else f" {int(fraction * cells + 1e-6)}/{number_of(cells, 'cell')}"
            left = left_text(time.monotonic() - began, fraction)
            bar.update(task, total=1.0, completed=fraction, description=what + counted, left=left)

        yield move


def left_text(elapsed: float, fraction: float) -> str:
    """Write how long a computation still takes, from the seconds that a fraction of it has taken."""
    if elapsed < SOON or fraction <= 0:
        return ""
    left = elapsed * (1 / fraction - 1)
    return f"about {max(1, round(left))} s left" if left < LONG else f"about {round(left / 60)} min left"


Loads = Annotated[
    list[str] | None,
    typer.Option(
        "--load",
        metavar="VALUE@SECONDS",
        help="From this time on (in steps if the plant has no dt), add a load to the simulated plant: to the first "
        "[[disturbance]] of the problem, or else to the inputs, with a value for each input, such as 0.3,0@20.",
    ),
]


def load_changed(file: str, settings: list[str] | None, no_functions: bool, loads: list[str] | None = None) -> Problem:
    """Load a problem, change the keys that the user has set with ``--set``, and add the loads of ``--load``."""
    from taciturn import load
    from taciturn.problem.settings import parse_settings
    from taciturn.problem.without_file import passed_problem

    problem, changes = passed_problem(file) or load(file, functions=not no_functions), parse_settings(settings or [])
    problem = problem.changed(changes) if changes else problem
    if not loads:
        return problem
    from taciturn.problem.loads import with_added_loads

    return with_added_loads(problem, loads)


def note_seed(seed: int | None, drawn: bool) -> None:
    """Print a note if the user gave a seed but the computation used no random numbers."""
    if seed is not None and not drawn:
        typer.echo(f"note: --seed {seed} had no effect: nothing was drawn")


OVER = "Key to vary: a key of [policy], or a dotted path such as plant.dt. Repeat the option for a grid."


Over = Annotated[list[str], typer.Option(metavar="NAME=v1,v2,…", help=OVER)]


Workers = Annotated[int, typer.Option(min=1, help="Number of processes. Default: 1 (this process).")]


def load_all(files: list[str], settings: list[str] | None, no_functions: bool) -> dict[str, Problem]:
    """Load the problems of several files; return them by name."""
    return dict(zip(names_of(files), [load_changed(file, settings, no_functions) for file in files], strict=True))


def names_of(files: list[str]) -> list[str]:
    """Return names for problems: their file names, each followed by a number if several files have the same name."""
    stems = [Path(file).stem for file in files]
    return [stem if stems.count(stem) == 1 else f"{stem} ({i + 1})" for i, stem in enumerate(stems)]
