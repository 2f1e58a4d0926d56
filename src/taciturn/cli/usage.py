"""Mistakes in the command line as one sentence: what is wrong, what was given, what is expected, and a remedy."""

from __future__ import annotations

import re
import sys
from typing import Any

from taciturn.errors import TaciturnError

EXAMPLE = "\b\nExample:\n  "  # start of the last paragraph of the help of a command, which is not wrapped
ALIKE = 0.65  # least similarity of a suggested command or option, from 0 to 1
SUBJECT = re.compile(r"(\w+)(?: and (\w+))? (?:is|are|has) ")


def usage_text(error: Any) -> str:
    """Return the sentence for an error of the command line's parser, whose texts have no remedy.

    Args:
        error: the error; its classes are private, so that it is recognised by its attributes.
    """
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
        from taciturn.problem.tables import ours

        expected = ours(error.message).partition(",")[0].replace("greater than or equal to", "at least")
        expected = expected if expected.startswith("expected") else "expected a number of fewer digits"
        return f"{_shown(param)} is {quoted(_typed(param))}; {expected}; {see}"
    unknown = re.match(r"No such command '(.*?)'", error.message)
    if unknown is not None:
        from taciturn.problem.tables import suggest

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
    from taciturn.problem.tables import suggest

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
