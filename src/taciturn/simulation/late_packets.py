"""Packets of links with random delays in simulations: how late they are, which are overtaken or lost, and ages of data.

A packet that arrives d steps after the step in which it was sent is late by d steps; one that arrives within this step,
but after its beginning, is late by less than a step. A packet is overtaken if another one that was sent later arrives
no later: a receiver that uses the newest packet that it has never uses it, but a filter that fuses all packets does.
Shares of late and of overtaken packets are those of the packets that arrive. A packet that is lost never arrives.
Packets that are still on their way at the end of a path are not counted.

The age of the data that a receiver uses is the number of steps since the packet with them was sent, which is 0 in the
step of sending. It is an average over time, also over the parts of a period in which an input acts, from the first
arrival on. It grows while the sender is silent.

The record of a path has for each link the number c = dq + i of the delay, drawn for the packet of each step, where q is
the number of pieces of a period and i that in which the packet arrives (``program.late``). So packet k arrives at the
piece qk + c of the path, and the newest packet at a piece is a running maximum.

Averages over many paths have the standard error of a ratio of means over independent paths. Their first half is left
out, and so are the packets that are sent within the longest delay before the end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from taciturn._arrays import Array, Bits
from taciturn._display import Displayed
from taciturn._text import number_of, percent
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.model.steps import Send
from taciturn.program.engine import prepare
from taciturn.program.late import NEVER
from taciturn.program.ops import Arrived, Name, Sent

PATHS, STEPS = 256, 1000  # of averages
SHOWN = 6  # numbers of steps that a text lists


@dataclass(frozen=True, repr=False)
class LatePackets(Displayed):
    """How late the packets of a link are, and how old the data that its receiver uses."""

    unit: str  # of ages: s or steps
    packets: int  # that were sent and are counted
    lost: Estimate  # share of these packets
    late: Estimate  # share of the packets that arrive
    steps: Mapping[int, Estimate] = field(hash=False)  # shares of late packets, by the steps that they are late
    overtaken: Estimate  # share of the packets that arrive
    age: Estimate | None  # mean age of the data in use; None if no packet arrives
    largest: float | None  # largest age

    def document(self) -> dict[str, Any]:
        """Return the numbers as values that JSON can represent."""
        shares = {name: _plain(getattr(self, name)) for name in ("lost", "late", "overtaken")}
        by_steps = {str(late): _plain(share) for late, share in self.steps.items()}
        age = {} if self.age is None else {"mean": _plain(self.age), "largest": self.largest, "unit": self.unit}
        return {"packets": self.packets, **shares, "steps": by_steps, "age": age}

    def text(self) -> str:
        """Write the numbers as text."""
        told = [
            f"{_percentage(share)} by {number_of(late, 'step') if late else 'less than a step'}"
            for late, share in self.steps.items()
        ]
        if len(told) > SHOWN:
            beyond = sum(share.value for share in [*self.steps.values()][SHOWN - 1 :])
            told = [*told[: SHOWN - 1], f"{percent(beyond, 1)} by more, up to {max(self.steps)}"]
        listed = f" ({', '.join(told)})" if told else ""
        parts = [f"{_percentage(self.late)} late{listed}"]
        parts += [f"{_percentage(self.overtaken)} overtaken", f"{_percentage(self.lost)} lost"]
        if self.age is not None:
            mean = f"{self.age.value:.4g}" if self.age.method == "exact" else str(self.age)
            parts.append(f"age of the data {mean} {self.unit} on average, at most {self.largest:.4g} {self.unit}")
        return ", ".join(parts)

    def __str__(self) -> str:
        """Write the numbers as text."""
        return self.text()

    def short(self) -> str:
        """Write the numbers as text."""
        return self.text()


def _plain(found: Estimate) -> dict[str, Any]:
    return found.document("value", "standard_error")


def _percentage(found: Estimate) -> str:
    """Write a share as a percentage."""
    if not found.value or found.method == "exact":
        return percent(found.value, 1 if found.value else 0)
    return percent(found.value, error=found.standard_error)


def late_packets(loop: Loop, seed: int = 0) -> dict[str, LatePackets]:
    """Simulate paths of a loop; return the averages of each link with random delays."""
    links = late_links(loop)
    if not links:
        return {}
    loop = loop.in_units
    program = loop.program()
    names: list[Name] = [one for link in links for one in (Sent(link), Arrived(link, 0))]
    program = program.keep(set(), set(names), set())
    horizon = loop.problem.cost.horizon
    steps = STEPS if horizon is None else horizon
    outputs = prepare(program)(loop.start(program, PATHS, seed), steps, None).outputs
    first = 0 if horizon is not None else steps // 2
    return {link: of_records(loop, link, outputs[Sent(link)] > 0.0, outputs[Arrived(link, 0)], first) for link in links}


def late_links(loop: Loop) -> list[str]:
    """Return the links of a loop that delay packets at random and whose receivers have no buffer."""
    sending = {step.link for step in loop.policy.steps if isinstance(step, Send)}
    return [link for link in loop.network.late if link in sending]


def of_records(loop: Loop, link: str, sent: Bits, codes: Array, first: int = 0) -> LatePackets:
    """Return the numbers of a link, from the records of the packets of each step and path, (steps, paths)."""
    dt = loop.problem.plant.dt
    law = loop.network.random_delay(link, loop.policy.tick)
    assert law is not None, "a late link has a law of delay"
    last = len(sent) if sent.shape[1] == 1 else max(len(sent) - int(np.ceil(max(law.waits))), first + 1)
    unit = "steps" if dt is None else "s"
    return count_packets(sent, codes, cuts_of(loop), range(first, last), dt or 1.0, unit)


def cuts_of(loop: Loop) -> tuple[float, ...]:
    """Return the parts of a period at which the pieces begin in which packets arrive."""
    pieces = loop.problem.pieces
    return (0.0,) if pieces is None else pieces.cuts


def count_packets(
    sent: Bits, codes: Array, cuts: Sequence[float], counted: range, step: float = 1.0, unit: str = "steps"
) -> LatePackets:
    """Return the numbers of packets ``sent`` with the given delays in pieces, of those in the steps ``counted``."""
    steps, q = len(sent), len(cuts)
    fates = fates_of(sent, codes, q)
    within = np.zeros((steps, 1), dtype=np.bool_)
    within[counted.start : counted.stop] = True
    there, lost = fates.arrives & within, fates.lost & within
    arrived, of = there.sum(axis=0), (there | lost).sum(axis=0)
    late, by = there & (codes > 0.0), np.where(there, codes // q, -1.0)
    shares = {d: _share(late & (by == d), arrived) for d in sorted({int(d) for d in np.unique(by[late])})}
    pieces = np.arange(counted.start * q, counted.stop * q)
    newest = fates.newest[pieces]
    known = newest >= 0
    ages = (pieces // q)[:, None] - newest
    weights = np.tile(np.diff([*cuts, 1.0]), len(counted))[:, None] * known
    mean = _ratio((weights * ages).sum(axis=0), weights.sum(axis=0)).scaled(step) if known.any() else None
    return LatePackets(
        unit, int(of.sum()), _share(lost, of), _share(late, arrived), shares,
        _share(fates.overtaken & within, arrived), mean, step * float(ages[known].max()) if known.any() else None,
    )  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class Fates(Displayed):
    """The fate of the packet of each step of each path, (steps, paths); all are false if none is sent."""

    arrives: Bits  # before the end of the path
    lost: Bits  # never arrives
    overtaken: Bits  # arrives, but one that was sent later has come no later
    newest: Array  # step in which the newest packet was sent that has arrived, or −1, (steps · pieces, paths)


def fates_of(sent: Bits, codes: Array, pieces: int) -> Fates:
    """Return what becomes of packets with the given delays in pieces of a period."""
    steps, paths = sent.shape
    never = steps * pieces
    comes: Bits = np.logical_and(sent, codes < NEVER / 2)
    k: Array = np.arange(steps, dtype=np.float64)[:, None]
    came: Array = np.where(comes, k * pieces + codes, float(never))
    at = np.minimum(came, never).astype(np.int64)
    newest = np.full((never + 1, paths), -1, dtype=np.int64)
    for step, here in enumerate(at):
        newest[here, np.arange(paths)] = step  # a later packet replaces an earlier one that arrives in the same piece
    newest = np.maximum.accumulate(newest[:-1], axis=0)
    there = at < never
    after = np.take_along_axis(newest, np.minimum(at, never - 1), axis=0)
    overtaken: Bits = np.logical_and(there, after > k)
    return Fates(there, sent & ~comes, overtaken, newest)


def _share(events: Bits, of: Array) -> Estimate:
    """Return the share of events; its standard error is at least one event in all observed ones."""
    found, total = _ratio(events.sum(axis=0), of), float(of.sum())
    least = 1.0 / total if total and found.method == "simulation" else 0.0
    return replace(found, standard_error=max(found.standard_error, least))


def _ratio(parts: Array, of: Array) -> Estimate:
    """Return a sum over paths divided by another, with the standard error of a ratio; 0 if the other is 0."""
    total, paths = float(of.sum()), len(of)
    value = float(parts.sum()) / total if total else 0.0
    if paths == 1:
        return Estimate(value, 0.0, "exact")
    rest = parts - value * of
    error = float(np.sqrt((rest @ rest) / (paths * (paths - 1)))) * paths / total if total else 0.0
    return Estimate(value, error, "simulation")
