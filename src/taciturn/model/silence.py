"""The cost of not sending, as running nodes measure it, and the bound on the loop's cost that follows from it.

A node that follows the response of the loop to its own silence adds up what each silence adds to the cost of this
response, now and later (``base/response``). Over a time T, on every path and whatever the noise is,

    |√J − √J_b| ≤ s,   s = Σ √(sum/T) over the lives of all nodes that decide,

with the cost J of the path per unit of time and the cost J_b of sending every sample on the same path. A node that has
lost its state begins another life, with a sum of its own: the sum of the old life contains all that its silence still
costs. If J is measured, it exceeds J_b by the factor 1/(1 − s/√J)² at most; if J_b is known, J is at most (√J_b + s)².
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any

from taciturn._display import Displayed
from taciturn._figure import Panel, Series
from taciturn._text import number_of, percent, table_text
from taciturn.model.estimate import Estimate, bound_text, rounded


@dataclass(frozen=True, repr=False)
class SilenceCost(Displayed):
    """Names of the signals in which a node stores the cost of not sending on its own links."""

    at: str  # the node
    added: str  # the cost that this step has added
    total: str  # its sum since the node has started
    lasted: str  # the steps since its first packet arrived
    response: str  # the response of the loop, or empty if it has no state
    # by how much the effect of silence on the loop may exceed the computed one, as the plant is not known exactly
    factor: float = 1.0


@dataclass(frozen=True, repr=False)
class Life(Displayed):
    """Cost of the packets that a node has not sent, from its start on."""

    links: tuple[str, ...]  # the links that the node decides together
    # the cost that silence has added to its own response, now and later, in the unit of the cost times that of the
    # time: a cost per second times seconds, a cost per step times steps, or a total
    total: float
    steps: int  # steps since the first packet of this life arrived
    factor: float = 1.0  # by how much the effect of silence may exceed the computed one

    @property
    def name(self) -> str:
        """Names of the node's links, as text."""
        return " and ".join(self.links)

    def root(self, duration: float) -> float:
        """Bound from above how much the node has raised √J by not sending, over a duration."""
        return self.factor * sqrt(max(self.total, 0.0) / duration) if duration > 0 else 0.0

    def document(self) -> dict[str, Any]:
        """Write the cost and its duration as a dictionary for JSON."""
        return {"links": list(self.links), "total": self.total, "steps": self.steps, "factor": self.factor}


@dataclass(frozen=True, repr=False)
class Certificate(Displayed):
    """A bound on the cost of not sending in one run, computed from the costs that its nodes have measured."""

    lives: tuple[Life, ...]  # the lives of all nodes that decide
    duration: float  # the time of the path in the unit of the cost; 1 if the cost is a total
    cost: float | None = None  # the measured cost of the path; None if it is not known

    @property
    def root(self) -> float:
        """Upper bound on how much not sending has changed √J."""
        return sum(life.root(self.duration) for life in self.lives)

    @property
    def at_most(self) -> float | None:
        """Upper bound on this run's cost relative to sending every sample; None if the cost of the run is not known."""
        whole = sqrt(max(self.cost or 0.0, 0.0))
        return None if whole <= self.root else 1 / (1 - self.root / whole) ** 2

    def relative_to(self, base: float) -> float:
        """Bound the cost of the run divided by ``base``, the cost of sending every sample."""
        return (1 + self.root / sqrt(base)) ** 2

    def document(self) -> dict[str, Any]:
        """Write the certificate as a dictionary for JSON."""
        lives = [life.document() | {"root": life.root(self.duration)} for life in self.lives]
        return {"root": self.root, "at_most": self.at_most, "silence": lives}

    def panel(self) -> Panel:
        """Return a panel of a figure: the bound on the change of √J for each node, and the sum of these bounds."""
        found = [(life.name, life.root(self.duration), number_of(life.steps, "step")) for life in self.lives]
        found += [("all silence", self.root, "")]
        most = "" if self.at_most is None else f": at most {rounded(self.at_most, 4, 1)} times the cost of every sample"
        rows = found[::-1]  # the first is the uppermost
        roots = [root for _, root, _ in rows]
        series = [
            Series(roots[1:], range(1, len(rows)), "", "stalks", thing="policy"),
            Series(roots[:1], [0], "", "stalks", thing="certificate"),
        ]
        return Panel(
            series,
            "change of √J by silence, at most",
            title=f"certificate of this run{most}",
            names=[name for name, _, _ in rows],
            notes=[f"{rounded(root, 3, 1)}  {note}".rstrip() for _, root, note in rows],
            xlim=(0.0, None),
        )

    def verdict(self) -> str:
        """Write the bound in words: relative to sending every sample or, if that is not known, on √J."""
        if self.at_most is None:
            return self.line()
        above = percent(self.at_most - 1, 1, up=1)
        return f"at most {above} more cost than every sample in this run, certified by the nodes"

    def line(self) -> str:
        """Write the bound on the change of √J as a sentence."""
        return f"all silence changed √J by at most {_up(self.root)}"

    def table(self) -> str:
        """Return a table of the bounds on the change of √J. Each start of a node has one row."""
        rows = [[life.name, _up(life.root(self.duration)), str(life.steps)] for life in self.lives]
        return table_text(["silence of", "changed √J by at most", "steps"], rows, 1)


def _up(value: float) -> str:
    return bound_text(Estimate(value, 0.0, "bound"), 1)


def certificate_of(all_time: float, noise: float, silence: Iterable[Estimate]) -> Estimate:
    """Bound the mean cost of a run, from the cost of sending every sample and the measured cost of not sending."""
    found = [*silence]
    whole = sqrt(max(all_time - noise, 0.0)) + sum(sqrt(max(one.value, 0.0)) for one in found)
    # at most, if the errors of all nodes go together
    error = sum(whole * one.standard_error / sqrt(one.value) for one in found if one.value > 0)
    return Estimate(whole**2 + noise, error, found[0].method if found else "exact")


def lives_of(silence: Mapping[tuple[str, ...], SilenceCost], memory: Mapping[str, Sequence[float]]) -> tuple[Life, ...]:
    """Read from a node's memory the cost of not sending, for those signals that belong to this node."""
    known = [(links, one) for links, one in silence.items() if one.total in memory]
    return tuple(Life(links, memory[one.total][0], int(memory[one.lasted][0]), one.factor) for links, one in known)
