"""The roles of the nodes in a network: to measure outputs of the plant, to apply inputs, or to control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Literal, cast

import numpy as np

from taciturn._arrays import flag, quoted
from taciturn._display import Displayed
from taciturn.errors import ProblemError

RoleName = Literal["measures", "applies"]
Entries = bool | tuple[int, ...]
ENTRIES: Mapping[str, str] = {"measures": "outputs", "applies": "inputs"}


@dataclass(frozen=True, repr=False)
class NodeRole(Displayed):
    """The role of a node: it measures outputs of the plant, applies inputs, or controls.

    Args:
        measures: indices of the outputs that the node measures; True for all outputs, False for none.
        applies: indices of the inputs that the node applies; True for all inputs, False for none.
        controls: whether the node is the controller, which all other nodes send to or receive from.
        site: name of a node at the same place, with which the node needs no link; None if the node has its own place.

    Raises:
        ProblemError: an index is negative or repeated, or the node has no role.
    """

    measures: Entries = False
    applies: Entries = False
    controls: bool = False
    site: str | None = None

    def __post_init__(self) -> None:
        """Check the indices."""
        for name in ("measures", "applies"):
            value: object = getattr(self, name)
            if isinstance(value, bool):
                continue
            whole = _whole_numbers(value)
            if whole is None:
                raise ProblemError(
                    f"{name} is {quoted(value)}; expected a list of whole numbers, the indices of {ENTRIES[name]} from "
                    "0 on, or true for all"
                )
            if min(whole, default=0) < 0:
                raise ProblemError(
                    f"{name} contains the index {min(whole)}; expected indices of {ENTRIES[name]} from 0 on"
                )
            listed = tuple(whole)
            if len(set(listed)) < len(listed):
                raise ProblemError(f"{name} is {list(listed)}; expected each index once")
            object.__setattr__(self, name, listed or False)
        object.__setattr__(self, "controls", flag("controls", self.controls))
        if self.site is not None and not isinstance(cast("object", self.site), str):
            raise ProblemError(f"site is {quoted(self.site)}; expected the name of a node")
        if not (self.measures or self.applies or self.controls):
            raise ProblemError("it neither measures, applies nor controls; expected measures, applies or controls")

    def entries(self, role: RoleName, size: int) -> tuple[int, ...]:
        """Return the indices of the outputs or inputs, of which the plant has ``size``."""
        given: Entries = getattr(self, role)
        return (tuple(range(size)) if given else ()) if isinstance(given, bool) else given

    def text(self, outputs: int, inputs: int) -> str:
        """Return the role with the indices of outputs and inputs, of a plant that has so many of them."""
        parts = ["controls"] if self.controls else []
        both: tuple[tuple[RoleName, int], ...] = (("measures", outputs), ("applies", inputs))
        for role, size in both:
            found = self.entries(role, size)
            noun = ENTRIES[role].removesuffix("s") if len(found) == 1 else ENTRIES[role]
            parts += [f"{role} {noun} {', '.join(map(str, found))}"] if found else []
        return "; ".join(parts) + ("" if self.site is None else f"; at the place of {self.site}")

    def short(self) -> str:
        """Return the role in a few words."""
        return ", ".join(name for name in ("measures", "controls", "applies") if getattr(self, name))


def _whole_numbers(value: object) -> list[int] | None:
    """Return a list of whole numbers, or None if the value is something else."""
    if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray):
        return None
    given = [*cast("Sequence[object]", value)]
    whole = [int(index) for index in given if not isinstance(index, bool) and isinstance(index, Integral)]
    return whole if len(whole) == len(given) else None


TRIANGLE: Mapping[str, NodeRole] = {
    "sensor": NodeRole(measures=True),
    "controller": NodeRole(controls=True),
    "actuator": NodeRole(applies=True),
}
"""The nodes of a network that states none; a policy kind decides which of them share a place."""
