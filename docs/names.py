"""The names that the reference lists, and what their docstrings are in the markup of the site; needs no Sphinx."""

from __future__ import annotations

import inspect
import re
from importlib import import_module

import taciturn

FRONT = {id(getattr(taciturn, name)) for name in taciturn.__all__}  # what the package itself offers
FRONT |= {id(getattr(taciturn.design, name)) for name in taciturn.design.__all__}
LITERAL = re.compile(r"(``.+?``|:\w+:`[^`]+`)")
SOURCE = re.compile("^Source:")
MARKUP = (":", "..", "* ", ">>>")  # what follows it may be indented and no formula
SHORTER = {r"TypeAliasForwardRef\('(\w+)'\)": r"\1", r"<factory>|<function .*?>+": "..."}


def public(entry: str) -> dict[str, object]:
    """Return the functions and classes that an entry of the reference lists, by name.

    An entry is a module and, after a colon, the names that are published; without them, all that the module offers.
    What ``taciturn`` or ``taciturn.design`` offers, or another module defines for its users, is listed there.
    """
    module, _, stated = entry.partition(":")
    home = import_module(module)
    if stated:
        return {name: getattr(home, name) for name in stated.split()}
    front = module in ("taciturn", "taciturn.design")
    found: dict[str, object] = {}
    for name in getattr(home, "__all__", vars(home)):
        value = getattr(home, name)
        if name.startswith("_") or not (inspect.isclass(value) or inspect.isfunction(value)):
            continue
        elsewhere = value.__module__ != module and (not hasattr(home, "__all__") or "._" not in value.__module__)
        if front or not (elsewhere or id(value) in FRONT):
            found[name] = value
    return found


def listing(entry: str) -> str:
    """Return what a page says of an entry, in Markdown: its names with their first sentences, then each in full."""
    names, module = public(entry), entry.partition(":")[0]
    rows = [f"| {{py:obj}}`{name} <{module}.{name}>` | {told(value)} |" for name, value in names.items()]
    blocks = [
        f".. auto{'class' if inspect.isclass(value) else 'function'}:: {module}.{name}\n"
        + ("   :members:\n" if inspect.isclass(value) else "")
        for name, value in names.items()
    ]
    return "\n".join(["| name | what it is |", "|---|---|", *rows, "", "```{eval-rst}", *blocks, "```"])


def told(value: object) -> str:
    """Return the first paragraph of the docstring of a value as Markdown."""
    return marked(" ".join((inspect.getdoc(value) or "").split("\n\n")[0].split()))


def marked(text: str) -> str:
    """Return a text of a docstring as Markdown."""
    parts = LITERAL.split(text)
    parts[::2] = [re.sub(r"[|*_<]", r"\\\g<0>", part) for part in parts[::2]]
    return "".join(parts)


def mend(lines: list[str]) -> None:
    """Make reStructuredText of a docstring: an indented paragraph is a formula; what is no markup is escaped."""
    found: list[str] = []
    before, verbatim = "", False  # the last line that is not indented; whether this one is of a formula or an example
    for line in lines:
        if line and not line.startswith(" "):
            example = before.startswith(">>>") and found[-1:] != [""]  # its answer goes on to the next empty line
            verbatim = line.startswith(">>>") or example
            before = before if example else line
        elif line and found[-1:] == [""] and not verbatim and not before.startswith(MARKUP):
            found += ["::", ""]
            verbatim = True
        found.append(line if verbatim else SOURCE.sub(":ref:`Source <sources>`:", _escaped(line)))
    lines[:] = found


def shorten(signature: str) -> str:
    """Return a signature that is Python: without what stands for a default or an alias that was not looked up."""
    for pattern, short in SHORTER.items():
        signature = re.sub(pattern, short, signature)
    return signature


def _escaped(line: str) -> str:
    parts = LITERAL.split(line)
    parts[::2] = [re.sub(r"\*(?! )|\||(?<=\w)_(?!\w)", r"\\\g<0>", part) for part in parts[::2]]
    return "".join(parts)
