"""Each key of a problem file is one field of one class, and the page of keys shows it."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import pytest

from taciturn.model.link import LinkLaw
from taciturn.problem import schema


def tables() -> dict[str, Any]:
    """Return the tables of a problem file by their paths, such as ``plant.jumps``, with their schemas."""
    found, left = dict[str, Any](), [("", schema.File)]
    while left:
        path, table = left.pop()
        found[path] = table
        for name, key in schema.keys_of(table).items():
            inner = schema._table_of(key.kind)  # type: ignore[attr-defined]
            inner = get_args(inner)[1] if get_origin(inner) is dict else inner
            if inner is not object and inner is not Any:
                left.append((f"{path}.{name}".removeprefix("."), inner))
    return found


def test_the_page_of_keys_has_every_key() -> None:
    """A key is one field of a class; the page shows it, and a class of the model describes it among its arguments."""
    page = (Path(__file__).parents[2] / "docs" / "problem-file.md").read_text(encoding="utf-8")
    found = tables()
    assert {"links", "nodes", "plant.actual.jumps", "controller.pid", "reference.steps"} <= found.keys()
    for path, table in found.items():
        classes = get_args(table)[1:] if get_origin(table) is Annotated else ()
        for name, key in schema.keys_of(table).items():
            assert re.search(rf"\b{name}\b", page), f"{path}.{name}"
            homes = [one for one in classes if key.argument in [part.name for part in fields(one)]]
            described = homes[0].__doc__ if homes else ""
            # indented by eight spaces, or by four since Python 3.13
            told = re.search(rf"^ {{4,}}{key.argument}: ", described, re.M)
            assert "Args:" not in described or told, f"{path}.{name}"


def test_a_new_field_of_a_class_is_a_key() -> None:
    """A class of the model is the schema of its table."""

    @dataclass(frozen=True)
    class Law(LinkLaw):
        jitter: float = 0.0

    keys = schema.keys_of(Annotated[dict[str, Any], Law])
    assert keys["jitter"] == (float, False, "jitter", "")
    assert schema.validate(Annotated[dict[str, Any], Law], {"jitter": 1}) == {"jitter": 1.0}
    with pytest.raises(schema.ValidationError, match="valid number"):
        schema.validate(Annotated[dict[str, Any], Law], {"jitter": "1"})
