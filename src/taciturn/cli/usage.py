"""Reading of the words on the command line, and error messages for mistakes in them.

Before the parser reads the words of a command, ``parser_words`` replaces names of options of earlier versions, and
writes whole numbers as digits: 1e6 and 1_000_000 are accepted for every option of a command whose argument is an
``int``.

A mistake in the command line is one sentence: what is wrong, what was given, what is expected, and a remedy. The parser
has texts without remedies (``usage_text``), and the library names arguments and not options (``name_options``). Words
that are meant in another way, such as a problem in place of a command, or a parameter as an option, have a sentence
that states how to write them.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping
from decimal import Decimal, InvalidOperation
from typing import Any, get_args, get_type_hints

from taciturn.errors import TaciturnError

EXAMPLE = "\b\nExample:\n  "  # start of the last paragraph of the help of a command, which is not wrapped
ALIKE = 0.65  # least similarity of a suggested command or option, from 0 to 1
SUBJECT = re.compile(r"(\w+)(?: and (\w+))? (?:is|are|has) ")
EARLIER = {"--ticks": "--steps"}  # names of options in earlier versions, and their present names
LONGEST = 40  # digits of a whole number that is written out; longer ones are refused as they are typed
KINDS = ("kind", "policy")  # options that are tried for the policy kind
# words that are tried as commands, by what they are meant for
MEANT = {
    "run": "run", "start": "run",
    "plot": "plot", "draw": "plot", "figure": "plot",
    "list": "problems", "ls": "problems", "problems": "problems", "examples": "problems",
    "kinds": "kinds", "policies": "kinds",
}  # fmt: skip


def parser_words(command: Any, words: Iterable[str]) -> list[str]:
    """Convert the words after a command's name to the form that its parser expects."""
    options = {name: one for one in command.params for name in one.opts if name.startswith("-")}
    whole, found, waiting, ended = _whole_options(command), list[str](), "", False
    for word in words:
        if waiting or ended:  # the value of the option before, or a word after --
            found.append(whole_number(word) if waiting in whole else word)
            waiting = ""
            continue
        ended = word == "--"
        name, sign, value = word.partition("=")
        name = name if name in options else EARLIER.get(name, name)
        one = options.get(name)
        if one is not None and sign:
            found.append(f"{name}={whole_number(value) if one.name in whole else value}")
        else:
            found.append(word if one is None else name)
            waiting = "" if one is None or one.is_flag else str(one.name)
    return found


def whole_number(text: str) -> str:
    """Write a whole number such as 1e6 in digits. Return any other text unchanged."""
    try:
        value = Decimal(text)
    except InvalidOperation:
        return text
    if not value.is_finite() or value.adjusted() >= LONGEST or value != value.to_integral_value():
        return text
    return str(int(value))


def _whole_options(command: Any) -> set[str]:
    """Return the names of the arguments of a command that are whole numbers."""
    hints = get_type_hints(command.callback)
    return {name for name, hint in hints.items() if int in (hint, *get_args(hint))}


def usage_text(error: Any) -> str:
    """Write an error of the command line's parser as a sentence that also suggests a remedy."""
    context = getattr(error, "ctx", None)
    if context is None:
        sentence = error.format_message().removeprefix("Option ").replace(" requires an argument.", " has no value")
        return f"{sentence.replace(chr(39), '')}; expected a value after it; see taciturn --help"
    see = f"see {context.command_path} --help"
    options = _options(context.command)
    if hasattr(error, "possibilities"):
        return _no_option(context, error.option_name, options)
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
        return no_command(unknown[1], context.command.commands)
    extra = re.search(r"unexpected extra arguments?(?:\(s\))? \((.*)\)", error.message)
    if extra is not None:
        return _extra(extra[1], context, options)
    return f"{error.format_message().rstrip('.')}; {see}"


def name_options(error: TaciturnError, command: Any) -> TaciturnError:
    """Replace argument names in an error message of the library by the options that the user typed."""
    sentence, options = str(error), _options(command)
    typed = {EARLIER.get(name, name) for name in (word.partition("=")[0] for word in sys.argv)}  # not answers to `new`
    subject = SUBJECT.match(sentence)
    if subject is None:
        return error
    start, rest = subject[0], sentence[subject.end() :]
    for name in filter(None, subject.groups()):
        if options.get(name) in typed:
            start = re.sub(rf"(?<!-)\b{name}\b", options[name], start)
            rest = re.sub(rf"(?<=[<≤] ){name}\b|\b{name}(?= [<≤])", options[name], rest)  # of the bounds of a number
    return type(error)(start + rest)


def no_command(word: str, commands: Mapping[str, Any]) -> str:
    """Write the error message for a word that is no command, such as a problem, a synonym or a misspelling."""
    from taciturn._plugins import problem_folders
    from taciturn.problem.schema import suggest

    problems = sorted(path.stem for folder in problem_folders() for path in folder.glob("*.toml"))
    if word in problems or word.endswith(".toml"):
        return f"{word!r} is a problem; expected a command before it, such as taciturn evaluate {word}"
    start, meant = f"there is no command {word!r}", MEANT.get(word.lower())
    if meant == "plot":
        able = [name for name, one in commands.items() if "--plot" in _options(one).values()]
        return f"{start}; expected the option --plot OUT.svg of {', '.join(able)}"
    if meant == "run":
        return (
            f"{start}; expected taciturn evaluate FILE for cost and rate, taciturn simulate FILE for one path, or "
            "taciturn network FILE for nodes as processes"
        )
    if meant == "problems":
        return f"{start}; expected a command and a problem, such as taciturn show two-mass; built-in problems: " + (
            ", ".join(problems)
        )
    if meant == "kinds":
        from taciturn.design.catalogue import CATALOGUE

        return f"{start}; taciturn new lists the policy kinds that suit a plant; all kinds: {', '.join(CATALOGUE)}"
    near = suggest(word, list(commands), ALIKE)
    return f"{start}; see taciturn --help, which lists the commands{near}"


def _options(command: Any) -> dict[str, str]:
    """Return the options of a command by the names that the library gives to their values."""
    found = {str(one.name): max(one.opts, key=len) for one in command.params if one.opts[0].startswith("--")}
    aliases = {"time": "time_limit", "least_period": "least"}
    return {aliases.get(name, name): option for name, option in found.items()}


def _no_option(context: Any, typed: str, options: Mapping[str, str]) -> str:
    """Return the sentence about an option that a command does not have."""
    from taciturn.problem.schema import suggest

    path, names = context.command_path, [*options.values(), "--help"]
    start = f"{path} has no option {typed}; see {path} --help"
    near = (
        "" if typed == "--over" else suggest(typed, [name for name in names if name not in ("--set", "--over")], ALIKE)
    )
    if near or context.parent is None or not typed.startswith("--"):
        return start + near
    key, value = typed.removeprefix("--").replace("-", "_"), _after(typed)
    key = "kind" if key in KINDS else key
    if "--set" in names and _is_parameter(key):
        if "--over" in names and "," in value:
            return f"{start}; expected the values of a parameter as --over {key}={value}"
        return f"{start}; expected a parameter as --set {key}={value or 'VALUE'}"
    able = [name for name, one in context.parent.command.commands.items() if typed in _options(one).values()]
    return f"{start}; commands with this option: {', '.join(able)}" if able else start


def _is_parameter(key: str) -> bool:
    """Return whether a name is a key of ``[policy]``."""
    from taciturn.design.catalogue import CATALOGUE, own_kinds

    return key == "kind" or any(key in CATALOGUE[name].parameters for name in own_kinds())


def _extra(words: str, context: Any, options: Mapping[str, str]) -> str:
    """Return the sentence about words that a command does not take."""
    from taciturn._plugins import problem_folders

    path, first = context.command_path, words.split()[0]
    usage = " ".join([path, *context.command.collect_usage_pieces(context)])
    before = sys.argv[sys.argv.index(first) - 1] if first in sys.argv[1:] else ""
    names, expected = options.values(), f"expected {usage}"
    setting = next((name for name in ("--over", "--set") if name in names and _after(name) == before), None)
    if setting is not None and before.isidentifier():
        expected = f"expected {setting} {before}={first}"
    elif re.match(r"[\w.]+=", first) and "--set" in names:
        expected = f"expected {'--over' if '--over' in names and ',' in first else '--set'} {first}"
    elif "--steps" in names and whole_number(first).isdecimal():
        expected = f"expected --steps {first}"
    elif first.endswith(".toml") or any((folder / f"{first}.toml").is_file() for folder in problem_folders()):
        expected = f"expected {usage}, with one problem; taciturn compare FILE FILE … compares several"
    return f"{words!r} is one argument too many; {expected}; see {path} --help"


def _shown(param: Any) -> str:
    """Return an option, or the name of an argument, as the help shows it."""
    return max(param.opts, key=len) if param.opts[0].startswith("-") else str(param.metavar or param.name)


def _typed(param: Any) -> str:
    """Return the value that was typed after an option."""
    names = (*param.opts, *(earlier for earlier, name in EARLIER.items() if name in param.opts))
    return next((value for value in map(_after, names) if value), "")


def _after(option: str) -> str:
    """Return the value that was typed after an option, or an empty text."""
    typed = sys.argv
    for word, following in zip(typed, [*typed[1:], ""], strict=True):
        if word == option:
            return "" if following.startswith("--") else following
        if word.partition("=")[0] == option:
            return word.partition("=")[2]
    return ""
