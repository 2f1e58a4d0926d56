"""The tables of the JSON documents, from the fields of the results and their docstrings; needs no Sphinx."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from names import marked

from taciturn._display import Displayed
from taciturn.model.result import SPLICED, Field, Result


def key_table(entry: str) -> str:
    """Return the keys of the document of a result, such as ``taciturn.study.evaluation:Evaluation``, in Markdown."""
    module, _, name = entry.partition(":")
    result = getattr(import_module(module), name)
    rows = [f"| `{key}` | {text} |" for key, text in meanings(result).items()]
    return "\n".join(["| key | meaning |", "|---|---|", *rows])


def meanings(result: type[Result]) -> dict[str, str]:
    """Return what each key of the document of a result means, in Markdown."""
    arguments, found = _described(result), dict[str, str]()
    for owner, field, condition in _fields(result):
        text = _meaning(owner, field, arguments if owner is result else _described(owner)).rstrip(".")
        if field.optional:
            text, _, condition = re.sub(r"[;,]? (?:or|else) None$", "", text).partition("; None if ")
        absent = f"; absent if {condition or 'there is none'}" if field.optional or condition else ""
        text = re.sub(r"\bNone\b", "null", f"{text[:1].lower()}{text[1:]}{absent}")
        inner = ", ".join(f"`{key.key or key.name}`" for _, key, _ in _fields(_part(_held(owner, field.name))))
        found[field.key or field.name] = marked(re.sub("^lQG", "LQG", text)) + (f" (keys: {inner})" if inner else "")
    return found


def _fields(result: Any, condition: str = "") -> Iterator[tuple[Any, Field[Any], str]]:
    """Return the fields of a document with their classes; those of a part that is spliced in, with when it is not."""
    for field in getattr(result, "FIELDS", ()):
        if field.key == SPLICED:
            without = _described(result).get(field.name, "").partition("None if ")[2].rstrip(".")
            yield from _fields(_part(_held(result, field.name)), without)
        elif field.key != "":
            yield result, field, condition


def _described(result: type[Any]) -> dict[str, str]:
    """Return the descriptions of the arguments of a class by name."""
    told = (inspect.getdoc(result) or "").partition("Args:\n")[2].partition("\n\n")[0]
    found = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", told, re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in found}


def _meaning(result: type[Result], field: Field[Any], arguments: dict[str, str]) -> str:
    """Return the text of an argument, a property, a function, a constant, or a part of an argument."""
    if field.name in arguments:
        return arguments[field.name]
    own = getattr(result, field.name, None) or (field.value if callable(field.value) else None)
    if isinstance(own, str):
        return f"``{own}``"
    if isinstance(own, property) or callable(own):
        text = inspect.getdoc(own) or inspect.getdoc(result) or ""
        return " ".join(text.split("\n\n")[0].split()).removeprefix("Return ")
    argument, _, attribute = str(field.value).partition(".")
    return f"{arguments[argument].rstrip('.')}: {_described(_part(_held(result, argument)))[attribute]}"


def _held(result: Any, name: str) -> Any:
    return get_type_hints(result).get(name)


def _part(kind: Any) -> Any:
    """Return the class of an attribute that is described in itself, such as another result, or None."""
    options = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    return next((one for one in options if inspect.isclass(one) and issubclass(one, Displayed)), None)
