"""The application: options that commands share, how they print and save results, mistakes, completion and exit codes.

Every command is a function with the options as arguments. Options of several commands are types here, such as ``File``,
``Settings`` (--set), ``Json`` and ``Plot``; commands of other packages use them too. They are stated here and not taken
from the signatures of the functions that commands call, since these need numpy, and ``taciturn --help`` must answer at
once; so this module imports nothing heavy before a command runs. A test compares both lists.

A command ends by ``print_result``, ``save_picture``, and by ``refuse`` if a requested accuracy is not reached.

A mistake in the command line is one sentence: what is wrong, what was given, what is expected, and a remedy. The parser
has texts without remedies (``usage_text``), and the library names arguments and not options (``name_options``).

A shell completes files, built-in problems, policy kinds and links; no kind is imported for this.
"""

from __future__ import annotations

import json
import logging
import os
import re
import select
import sys
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
from taciturn._text import wrapped_text
from taciturn.errors import TaciturnError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from taciturn._progress import Progress
    from taciturn.problem import Problem

EXAMPLE = "\b\nExample:\n  "  # start of the last paragraph of the help of a command, which is not wrapped
ALIKE = 0.65  # least similarity of a suggested command or option, from 0 to 1
SUBJECT = re.compile(r"(\w+)(?: and (\w+))? (?:is|are|has) ")


def usage_text(error: Any) -> str:
    """Return the sentence for an error of the command line's parser, whose texts have no remedy."""
    context = getattr(error, "ctx", None)
    if context is None:
        sentence = error.format_message().removeprefix("Option ").replace(" requires an argument.", " has no value")
        return f"{sentence.replace(chr(39), '')}; expected a value after it; see taciturn --help"
    path, see = context.command_path, f"see {context.command_path} --help"
    options = _options(context.command)
    if hasattr(error, "possibilities"):
        return _no_option(path, error.option_name, options)
    param = getattr(error, "param", None)
    if hasattr(error, "param_type"):
        example = (context.command.epilog or "").removeprefix(EXAMPLE)
        return f"{_shown(param)} is missing; expected, for example, {example}; {see}"
    if param is not None:
        from taciturn._arrays import quoted
        from taciturn.problem.schema import ours

        expected = ours(error.message).partition(",")[0].replace("greater than or equal to", "at least")
        expected = expected if expected.startswith("expected") else "expected a number of fewer digits"
        return f"{_shown(param)} is {quoted(_typed(param))}; {expected}; {see}"
    unknown = re.match(r"No such command '(.*?)'", error.message)
    if unknown is not None:
        from taciturn.problem.schema import suggest

        names = list(context.command.commands)
        return f"there is no command {unknown[1]!r}; {see}, which lists the commands{suggest(unknown[1], names, ALIKE)}"
    extra = re.search(r"unexpected extra arguments?(?:\(s\))? \((.*)\)", error.message)
    if extra is not None:
        usage = " ".join([path, *context.command.collect_usage_pieces(context)])
        return f"{extra[1]!r} is one argument too many; expected {usage}; {see}"
    return f"{error.format_message().rstrip('.')}; {see}"


def name_options(error: TaciturnError, command: Any) -> TaciturnError:
    """Return an error of the library with the options that the user typed in place of the names of arguments."""
    sentence, options = str(error), _options(command)
    typed = {word.partition("=")[0] for word in sys.argv}  # not the answers to the questions of `new`
    subject = SUBJECT.match(sentence)
    if subject is None:
        return error
    start, rest = subject[0], sentence[subject.end() :]
    for name in filter(None, subject.groups()):
        if options.get(name) in typed:
            start = re.sub(rf"(?<!-)\b{name}\b", options[name], start)
            rest = re.sub(rf"(?<=[<≤] ){name}\b|\b{name}(?= [<≤])", options[name], rest)  # of the bounds of a number
    return type(error)(start + rest)


def _options(command: Any) -> dict[str, str]:
    """Return the options of a command by the names that the library gives to their values."""
    found = {str(one.name): max(one.opts, key=len) for one in command.params if one.opts[0].startswith("--")}
    aliases = {"time": "time_limit", "least_period": "least"}
    return {aliases.get(name, name): option for name, option in found.items()}


def _no_option(path: str, typed: str, options: dict[str, str]) -> str:
    from taciturn.problem.schema import suggest

    names = [*options.values(), "--help"]
    near = suggest(typed, [name for name in names if name != "--set"], ALIKE)
    if near or "--set" not in names:
        return f"{path} has no option {typed}; see {path} --help{near}"
    values = "; taciturn tradeoff FILE --over NAME=v1,v2,… compares several values" if typed == "--over" else ""
    return f"{path} has no option {typed}; see {path} --help; --set NAME=VALUE changes a parameter{values}"


def _shown(param: Any) -> str:
    """Return an option, or the name of an argument, as the help shows it."""
    return max(param.opts, key=len) if param.opts[0].startswith("-") else str(param.metavar or param.name)


def _typed(param: Any) -> str:
    """Return the value that was typed after an option."""
    words = sys.argv
    for word, following in zip(words, [*words[1:], ""], strict=True):
        if word in param.opts:
            return following
        if word.partition("=")[0] in param.opts:
            return word.partition("=")[2]
    return ""


LARGEST = 2**24  # bytes of a problem file


def complete_file(incomplete: str) -> list[str]:
    """Return the built-in problems and TOML files with this prefix; if there are none, the shell completes folders."""
    folder = incomplete[: incomplete.rfind("/") + 1]
    try:
        files = sorted(f"{folder}{path.name}" for path in Path(folder or ".").glob("*.toml"))
    except OSError:
        files = []
    names = [*files, *sorted(path.stem for folder in problem_folders() for path in folder.glob("*.toml"))]
    return [name for name in names if name.startswith(incomplete)]


def complete_from(*words: str) -> Callable[[str], list[str]]:
    """Return a completion function for these words."""

    def complete(incomplete: str) -> list[str]:
        return [word for word in words if word.startswith(incomplete)]

    return complete


def complete_kind(incomplete: str) -> list[str]:
    """Return the policy kinds with this prefix; no kind is imported."""
    from taciturn.design.catalogue import CATALOGUE

    return complete_from(*CATALOGUE)(incomplete)


def complete_link(context: typer.Context, incomplete: str) -> list[str]:
    """Return the links with this prefix of the problem files among the words typed before."""
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


GROUPS: dict[str, list[str]] = {
    "Design and inspect": ["new", "show", "tune"],
    "Measure and prove": ["evaluate", "simulate", "certify", "bench"],
    "Compare": ["tradeoff", "compare", "sweep", "channel"],
    "Run": ["network", "node", "plant", "relay"],
    "Export": ["export"],
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


WIDEST = 160  # largest width of help texts in columns; on narrower terminals they use the terminal's width


class Groups(typer.core.TyperGroup):
    """Group of commands whose help lists them by purpose, and whose errors name the options that were typed."""

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command."""
        from taciturn.errors import TaciturnError

        try:
            return super().invoke(ctx)
        except TaciturnError as error:
            chosen = self.commands.get(ctx.invoked_subcommand or "")
            raise error if chosen is None else name_options(error, chosen) from None

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section of the help for each group of commands."""
        for title, names in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(name, (self.commands[name].help or "").partition("\n")[0]) for name in names])


app = typer.Typer(
    name="taciturn",
    cls=Groups,
    rich_markup_mode=None,
    context_settings={"max_content_width": WIDEST},
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
    typer.Option(metavar="KIND", help="Policy kind, e.g. lqg. Prompted for if omitted.", autocompletion=complete_kind),
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as one JSON document.")]
Seed = Annotated[int, typer.Option(help="Seed of the random numbers.")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Set a key of [policy], or a dotted key such as cost.R; the value none removes the key.",
    ),
]
NoFunctions = Annotated[
    bool,
    typer.Option("--no-functions", help="Refuse problem files that name Python functions, which would be executed."),
]
GivenSeed = Annotated[int | None, typer.Option("--seed", help="Seed of the random numbers. Default: 0.")]
Link = Annotated[
    str | None,
    typer.Option(
        help="Link to which the rate refers if the policy decides on several links.",
        autocompletion=complete_link,
    ),
]


def _checked_picture(path: Path | None) -> Path | None:
    """Refuse a picture that cannot be written before anything is computed."""
    from taciturn._figure import check_format

    return None if path is None else check_format(path)


Plot = Annotated[
    Path | None,
    typer.Option(metavar="OUT", help="Save a figure as .svg, .png or .pdf.", callback=_checked_picture),
]
Confidence = Annotated[
    float | None,
    typer.Option(
        help="Confidence level of the lower bound on the cost. Default: 0.999 if a bound exists; 0: no bound."
    ),
]
Steps = Annotated[int | None, typer.Option(help="Fixed total number of simulated steps (instead of a standard error).")]
TimeLimit = Annotated[
    float | None,
    typer.Option("--time", metavar="SECONDS", help="Time limit, with the design of the policy. Default: none."),
]
StandardError = Annotated[
    float | None, typer.Option(help="Absolute standard error of the cost. Default: 1e-4 of the cost.")
]


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


def add_commands() -> None:
    """Import the modules with the commands of other packages; print a message about one that fails or is not new."""
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
    """Run the command line: exit code 0, 2 with one sentence on standard error, or 128 + signal."""
    with ends_on_signals():
        _run()


def _run() -> None:
    from taciturn.errors import TaciturnError

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
            "expected numbers nearer to 1: scale the problem"
        )
    else:
        sys.exit(code if isinstance(code, int) else 0)


class _Sentences(logging.Handler):
    """Prints log records to the current standard error stream."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one record."""
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
    """Print an error message and exit with code 2; if a signal has stopped the command, raise Interrupted instead."""
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
    """Discard the buffered output of a stream that cannot be written to, so that Python reports no error at its end."""
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
    """Print a JSON document with the data needed to reproduce it; keys of the document take precedence."""
    told = {name: value for name, value in origin.items() if name not in document}
    typer.echo(json.dumps(document | told, indent=1, allow_nan=False))


class Result(Protocol):
    """A result of a study, which also has a text."""

    def document(self) -> dict[str, Any]:
        """Return the JSON document."""
        ...


class Drawn(Protocol):
    """A result that draws itself."""

    def plot(self) -> Figure:
        """Return the figure."""
        ...


def print_result(
    found: Result,
    as_json: bool,
    problem: Problem | Mapping[str, Problem] | None = None,
    seed: int | None = None,
    *,
    unused: int | None = None,
) -> None:
    """Print a result as text, with a note on an unused seed, or as a JSON document with what reproduces it."""
    from taciturn.study.record import origin

    if as_json:
        print_json(found.document(), origin(problem, seed))
    else:
        typer.echo(found)
        note_seed(unused, drawn=False)


def save_picture(
    found: Drawn,
    path: Path | None,
    as_json: bool,
    problem: Problem | Mapping[str, Problem],
    seed: int | None = None,
    method: str | None = None,
) -> None:
    """Save a figure, if a path is given; after the numbers, which are printed even if this fails."""
    from taciturn._figure import save
    from taciturn.study.record import origin

    if path is not None:
        save(found.plot(), path, origin(problem, seed, method))
        if not as_json:
            typer.echo(f"picture: {path}")


def can_print(letters: str) -> bool:
    """Return whether standard output can encode these characters."""
    try:
        letters.encode(sys.stdout.encoding or "ascii")
    except UnicodeError:
        return False
    return True


@contextmanager
def progress_bar(what: str, cells: int | None = None) -> Generator[Progress]:
    """Show a progress bar with the remaining time on standard error, if it is a terminal."""
    if not sys.stderr.isatty():
        yield lambda fraction: None
        return
    from rich.console import Console
    from rich.progress import Progress as Bar

    with Bar(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)  # indeterminate until a fraction is known

        def move(fraction: float) -> None:
            counted = "" if cells is None else f" {int(fraction * cells + 1e-6)}/{cells} cells"
            bar.update(task, total=1.0, completed=fraction, description=what + counted)

        yield move


def load_changed(file: str, settings: list[str] | None, no_functions: bool) -> Problem:
    """Load a problem and change the keys that --set names."""
    from taciturn import load
    from taciturn.problem.settings import parse_settings
    from taciturn.problem.without_file import passed_problem

    problem, changes = passed_problem(file) or load(file, functions=not no_functions), parse_settings(settings or [])
    return problem.changed(changes) if changes else problem


def note_seed(seed: int | None, drawn: bool) -> None:
    """Print a note if a seed is given but no random numbers were drawn."""
    if seed is not None and not drawn:
        typer.echo(f"note: --seed {seed} had no effect: nothing was drawn")


OVER = "Key to vary: a key of [policy], or a dotted path such as plant.dt. Repeat the option for a grid."


Over = Annotated[list[str], typer.Option(metavar="NAME=v1,v2,…", help=OVER)]


Workers = Annotated[int, typer.Option(min=1, help="Number of processes. Default: 1 (this process).")]


def load_all(files: list[str], settings: list[str] | None, no_functions: bool) -> dict[str, Problem]:
    """Return the problems by name."""
    return dict(zip(names_of(files), [load_changed(file, settings, no_functions) for file in files], strict=True))


def names_of(files: list[str]) -> list[str]:
    """Return the names of problems: their file names, with numbers if some names are equal."""
    stems = [Path(file).stem for file in files]
    return [stem if stems.count(stem) == 1 else f"{stem} ({i + 1})" for i, stem in enumerate(stems)]
