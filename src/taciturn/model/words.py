"""Words and symbols for a policy's signals, which follow from the policy steps that compute these signals.

A policy computes with signals whose names are its own, such as ``part_level-1``. Readers of a diagram, or of the rule
by which a node sends, see words instead. They come from, in this order:

* the **plant**: a measured or applied signal has the numbers of its outputs or inputs, y1 or u2;
* the **steps**: a signal that is assigned the difference of two others is called by both, as in "input without a packet
  minus computed input", and has the symbol Δ if the other is the value of an earlier step;
* the **vocabulary**: the meaning of the names that the designs share. The name of a node at the end of a name is left
  out, since the reader sees the node;
* the **name** itself, with spaces. A kind of another package may therefore name its signals by words.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from taciturn._text import number_of
from taciturn.model.network import REFERENCE, Network, entry_numbers, symbols_text
from taciturn.model.plant import Plant, Prediction
from taciturn.model.steps import ONE, Assign, Draw, Location, Step, assigned
from taciturn.model.trigger import Matrix, Trigger

VOCABULARY: Mapping[str, tuple[str, str]] = {  # symbol and words by name, without the name of a node
    "estimate": ("x̂", "state estimate"),
    "state": ("x̂", "state estimate"),
    "prediction": ("x̃", "receiver's prediction of the state"),
    "forecast": ("x̃", "prediction of the state"),
    "sent": ("x̄", "last sent state estimate"),
    "command": ("u", "computed input"),
    "plan": ("ū", "inputs of the next steps"),
    "candidate": ("û", "input without a packet"),
    "silent": ("û", "input without a packet"),
    "held": ("û", "applied input"),
    "last": ("ȳ", "last sent value"),
    "level": ("ȳ", "level of the output"),
    "copy": ("ŷ", "receiver's prediction"),
    "moved": ("e", "error of the receiver's prediction without a packet"),
    "error": ("e", "error of the receiver's values without a packet"),
    "deviation": ("d", "error of the receiver's state estimate without a packet"),
    "gap": ("g", "error of the computed input without a packet"),
    "off reference": ("d", "state estimate minus reference"),
    "part": ("x̂", "part of the estimate"),
    "local": ("x̂", "local estimate"),
    "measured": ("y", "filtered measurement"),
    "register": ("z", "controller state"),
    "innovation": ("ν", "innovation of the filter"),
    "response": ("q", "state of the loop's response to silence"),
    "belief": ("p", "probabilities of the link's states"),
    "cost if good": ("a", "cost of silence in the good state"),
    "cost if bad": ("b", "cost of silence in the bad state"),
    "beyond limits": ("b", "distance of the input from its limits"),
    "cost": ("", "cost of silence"),
    "cost of silence": ("", "cost of silence"),
    "credit": ("", "credit"),
    "margin": ("", "margin"),
    "bank": ("", "bank"),
    "surprise": ("", "surprise"),
    "coming set-points": ("h", "effect of the coming set-points"),
}
EARLIER = ("last", "level", "held")  # signals with a value of an earlier step
DRAWN = ("ξ", "exponential random number of mean 1, drawn in each step")


class PolicyData(Protocol):
    """The parts of a policy that determine the words and symbols of its signals."""

    @property
    def steps(self) -> tuple[Step, ...]:
        """The policy steps."""
        ...

    @property
    def model(self) -> Plant:
        """The plant of the design."""
        ...

    @property
    def locations(self) -> tuple[Location, ...]:
        """The discrete states of the policy."""
        ...

    @property
    def network(self) -> Network:
        """Network for which the policy was designed."""
        ...

    @property
    def tick(self) -> float:
        """The seconds per step."""
        ...

    @property
    def prediction(self) -> Prediction | None:
        """Model with which an actuator predicts between steps; None if no actuator does."""
        ...

    @property
    def sizes(self) -> Mapping[str, int]:
        """Number of entries of each signal, by the signal's name."""
        ...

    @property
    def decisions(self) -> Mapping[str, Trigger]:
        """Trigger of each decision, by the decision's name."""
        ...

    @property
    def measured(self) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        """Each measured signal, with its node and the indices of its outputs."""
        ...

    @property
    def applied(self) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        """Each applied signal, with its node and the indices of its inputs."""
        ...

    def site(self, node: str) -> frozenset[str]:
        """Return all nodes at the site of the given node."""
        ...


class Words:
    """Finds words and symbols for the signals of a policy."""

    def __init__(self, policy: PolicyData) -> None:
        """Store where the signals are computed."""
        self._policy = policy
        self._made: dict[str, list[Step]] = {}
        for step in policy.steps:
            for name in assigned(step):
                self._made.setdefault(name, []).append(step)
        nodes = "|".join(re.escape(node) for node in sorted(policy.network.nodes, key=len, reverse=True))
        self._node = re.compile(rf"[_ ]({nodes})(?=$|[_ ])")

    def made(self, name: str) -> Sequence[Step]:
        """Return the policy steps that assign a signal."""
        return self._made.get(name, ())

    def drawn(self, name: str) -> bool:
        """Return whether the value of a signal is a random number."""
        return any(isinstance(step, Draw) for step in self.made(name))

    def plain(self, name: str) -> str:
        """Write the name of a signal or decision in words, without the name of the node at its end."""
        return re.sub(r" (if|to)$", "", self._node.split(name, maxsplit=1)[0].replace("_", " ").strip())

    def symbol(self, name: str) -> str:
        """Return the symbol of a signal in formulas or, if it has none, its words."""
        if self.drawn(name):
            return DRAWN[0]
        if (entries := self.entries(name)) is not None:
            letter, numbers = entries
            return symbols_text(letter, numbers) if len(numbers) == 1 else letter
        changed = self._changed(name)
        return self._known(name)[0] or self.meaning(name) if changed is None else f"Δ{self.symbol(changed)}"

    def meaning(self, name: str) -> str:
        """Return the words that diagrams and rules show for a signal."""
        if self.drawn(name):
            return DRAWN[1]
        if (told := self._told(name)) is not None:
            return VOCABULARY["command"][1] if self._stem(name) == "command" else told
        if (changed := self._changed(name)) is not None:
            return f"change of {symbols_text(*self.entries(changed) or ('', ()))} since the last packet"
        if (
            (left := re.search(" if (.+)", name)) is not None
            and self._known(name)[0]
            and self.plain(name) == self._stem(name)
        ):
            whole = self._known(name)[1].removesuffix(" without a packet")
            return f"{whole} that a packet on {left[1]} leaves"
        apart = self.difference(name)
        if apart is None or not all(self._told(one) or self._known(one)[1] for one in apart) or self._copied(apart):
            return self._known(name)[1] or self.plain(name)
        return " minus ".join(map(self.meaning, apart))

    def numbered(self, name: str) -> str:
        """Return the symbols of the entries of a measured or applied signal, such as y1, y2."""
        return symbols_text(*(self.entries(name) or (self.symbol(name), (0,))))

    def packet(self, payload: Sequence[str]) -> str:
        """Describe in words which signals a packet contains, with the number of their entries."""
        told = [self._told(name) for name in payload]
        numbers = sum(self._policy.sizes[name] for name in payload)
        if all(one is not None for one in told):
            return " and ".join(one for one in told if one is not None)
        parts = [one or self.meaning(name) for name, one in zip(payload, told, strict=True)]
        listed = f"{', '.join(parts[:-1])} and {parts[-1]}" if len(parts) > 1 else parts[0]
        return f"{listed}, {number_of(numbers, 'number')}"

    def difference(self, name: str) -> tuple[str, str] | None:
        """Return the names of the signals a and b if a policy step computes a signal as a − b; otherwise None."""
        steps = [step for step in self.made(name) if isinstance(step, Assign)]
        if len(steps) != 1 or len(steps[0].branches) != 1 or len(steps[0].branches[0]) != 2:
            return None
        (first, one), (second, other) = steps[0].branches[0].items()
        if ONE in (first, second):
            return None
        if is_identity(one, 1.0) and is_identity(other, -1.0):
            return first, second
        return (second, first) if is_identity(one, -1.0) and is_identity(other, 1.0) else None

    def _told(self, name: str) -> str | None:
        """Return the outputs, inputs or set-points in a signal, or None for another signal."""
        found = self.entries(name)
        if found is None:
            return None
        letter, numbers = found
        noun = {"y": "measurement", "u": "input", "r": "set-point"}[letter]
        return f"{noun}{'s' * (len(numbers) > 1)} {symbols_text(letter, numbers)}"

    def entries(self, name: str) -> tuple[str, Sequence[int]] | None:
        """Return letter and numbers of the outputs, inputs or set-points in a signal; None for other signals."""
        policy = self._policy
        if name in policy.measured:
            entries, sensed = policy.measured[name][1], policy.model.sensed
            if name == REFERENCE:
                return "r", entry_numbers([i - sensed for i in entries], policy.model.set_points)
            return "y", entry_numbers(entries, sensed)
        if name in policy.applied:
            return "u", entry_numbers(policy.applied[name][1], policy.model.inputs)
        if self._stem(name) != "command":
            return None
        own = [entries for node, entries in policy.applied.values() if name == f"command_{node}"]
        entries = own[0] if own else tuple(range(policy.model.inputs))
        return ("u", entry_numbers(entries, policy.model.inputs)) if len(entries) == policy.sizes[name] else None

    def _changed(self, name: str) -> str | None:
        """Return the measured or applied signal whose change since the last packet this signal is, or None."""
        apart = self.difference(name)
        if apart is None or self._stem(apart[1]) not in EARLIER or self.entries(apart[0]) is None:
            return None
        return apart[0]

    def _copied(self, apart: tuple[str, str]) -> bool:
        """Return whether a difference is that from a copy of the receiver's model, which the vocabulary explains."""
        return self._stem(apart[1]) == "copy"

    def _known(self, name: str) -> tuple[str, str]:
        """Return symbol and words of the vocabulary; they are empty for other names."""
        return VOCABULARY.get(self.plain(name), VOCABULARY.get(self._stem(name), ("", "")))

    def _stem(self, name: str) -> str:
        return re.sub(r" if .*", "", self.plain(name))


def is_identity(matrix: Matrix, factor: float) -> bool:
    """Return whether a matrix equals the identity times ``factor``."""
    return isinstance(matrix, np.ndarray) and np.array_equal(matrix, factor * np.eye(*matrix.shape))
