"""Values that compare equal by their fields have a hash, so that they can be members of sets and keys."""

from __future__ import annotations

import pkgutil
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from importlib import import_module

import taciturn
from taciturn import evaluate, load

UNHASHABLE = re.compile(r"\b(Mapping|dict|list|set|Array|ndarray|NDArray)\b")
TABLES = "taciturn.problem.schema"  # of pydantic's, which are read once


def values() -> Iterator[type]:
    """Yield the classes of this package whose instances are equal if their fields are, and cannot be changed."""
    for module in pkgutil.walk_packages(taciturn.__path__, "taciturn."):
        if not module.name.endswith("__main__"):
            for one in vars(import_module(module.name)).values():
                if isinstance(one, type) and is_dataclass(one) and one.__module__ == module.name != TABLES:
                    given = one.__dataclass_params__  # type: ignore[attr-defined]
                    if given.frozen and given.eq and one.__hash__.__code__.co_filename == "<string>":
                        yield one


def test_no_value_has_a_hash_of_a_field_that_has_none() -> None:
    """A mapping is compared, and is no part of the hash; arrays have no truth value, so they are not compared."""
    wrong: list[str] = []
    for one in values():
        for field in fields(one):
            if UNHASHABLE.match(str(field.type)) and (field.hash is not False or "Array" in str(field.type)):
                wrong.append(f"{one.__module__}.{one.__name__}.{field.name}")
    assert wrong == []


def test_results_and_diagrams_are_members_of_sets() -> None:
    """Two equal ones are one member."""
    found = evaluate(load("two-mass"), steps=2048)
    assert len({found, replace(found), replace(found, seed=1)}) == 2
    diagram = load("two-mass").design().diagram()
    assert {diagram, replace(diagram)} == {diagram}
    assert len({found.cost, *found.rates.values(), found.clock}) >= 2
