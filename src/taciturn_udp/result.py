"""The result of a run of the nodes of a problem: cost, rates and packets, as text, JSON, table and figure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from taciturn.extend import Array, Panel, Series, Size, draw, per_unit
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.model.result import Column, Columns, Field, Tabular, plain_fields, seconds
from taciturn.simulation.average import base_rate
from taciturn.study.evaluation import TimeUnit, Unit, rate_unit
from taciturn_udp.averages import measured

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _bound(found: NetworkRun) -> float | None:
    guarantee = found.loop.policy.guarantee if found.nominal else None
    return None if guarantee is None else guarantee.cost


def _rates(rates: Mapping[str, Estimate]) -> dict[str, Any]:
    return {link: measured(rate) for link, rate in rates.items()}


def _link_lines(found: NetworkRun) -> Iterator[tuple[str, str]]:
    for link, counted in found.datagrams.items():
        told = (f"{count} {'sent again' if name == 'again' else name}" for name, count in counted.items())
        yield f"link, {link}", ", ".join(told)


def _degraded(found: NetworkRun) -> dict[str, Any]:
    return {name: report["degraded"] for name, report in found.reports.items() if "degraded" in report}


def _reports(found: NetworkRun) -> Iterator[tuple[str, str]]:
    for name, report in found.reports.items():
        if report.get("degraded"):
            yield "degraded", f"{name}: " + ", ".join(f"{n} {why}" for why, n in report["degraded"].items())
        if report.get("lateness_ms"):
            shown = ", ".join(f"{share} {value:g}" for share, value in report["lateness_ms"].items())
            yield "lateness, ms", f"{name}: {shown}"


@dataclass(frozen=True, eq=False, repr=False)
class NetworkRun(Tabular):
    """Cost and packets of a run of the nodes of a problem.

    Args:
        loop: the loop that was run.
        unit: unit of time or run that the cost refers to.
        cost: mean over the steps, with its standard error by batch means, or the total of a finite-horizon run; None if
            the run was too short for a mean.
        rates: sends per step or per second, by scheduled link (in a finite-horizon run, the share of steps with a
            send); without standard errors in a finite-horizon run, or if the run was too short for batch means.
        datagrams: numbers of packets sent, delivered and lost, and of marks sent, by link; ``again``: packets that a
            node repeated, which the link delivers or drops once more. In namespaces, also the
            number of ``predicted`` losses and the counters of nftables, which count every retransmission
            (``nft_seen``, ``nft_dropped``).
        reports: report of each process, by name.
        costs: cost of each step, (steps,).
        sends: whether a packet was sent at each step, by link, (steps,).
        arrived: sequence numbers of the packets that arrived, by link, in the order in which the receiver logged them.
        seed: seed of the plant and the links.
        nominal: whether the loop and the links are those of the design; if not, no guarantee holds.
        seconds: wall time.
        notes: warnings and remarks for the reader.
    """

    FIELDS: ClassVar[tuple[Field[NetworkRun], ...]] = (
        Field("policy", "loop.policy.kind", say="policy"),
        Field("unit"),
        Field("base_rate", lambda found: base_rate(found.loop)),
        Field("cost", json=measured, say="cost", text="{} {of.per}", none="-"),
        Field(
            "cost_all_time",
            lambda found: found.loop.policy.cost_all_time if found.nominal else None,
            say="every sample",
            text="{:.6g}",
        ),
        Field("cost_bound", _bound),
        Field("rates", json=_rates, say="rate, {}", text="{} per {of.rate_unit}", after="cost"),
        Field("datagrams", say="", text=_link_lines),
        *plain_fields("seed", "method"),
        Field("seconds", json=seconds),
        Field("ticks", lambda found: len(found.costs), say="steps", text="{} in {of.seconds:.1f} s", after="policy"),
        Field("degraded", _degraded),
        Field("reports", key="processes", say="", text=_reports),
        Field("notes", say="note"),
    )
    index: ClassVar[str] = "tick"
    heading: ClassVar[tuple[str, ...]] = ("cost", "rates", "unit", "rate_unit", "method", "seed", "notes")
    method: ClassVar[str] = "simulation"

    loop: Loop
    unit: Unit
    cost: Estimate | None
    rates: Mapping[str, Estimate]
    datagrams: Mapping[str, Mapping[str, int]]
    reports: Mapping[str, Mapping[str, Any]]
    costs: Array
    sends: Mapping[str, Array]
    arrived: Mapping[str, tuple[int, ...]]
    seed: int
    nominal: bool
    seconds: float
    notes: tuple[str, ...]

    @property
    def rate_unit(self) -> TimeUnit:
        """Unit of time of the rates."""
        return rate_unit(self.unit)

    @property
    def per(self) -> str:
        """Unit of the cost as text."""
        return per_unit(self.unit)

    def columns(self) -> Columns:
        """Return one row per step: its cost, and whether a packet was sent on each link."""
        columns: dict[str, Column] = {"tick": range(len(self.costs)), "cost": self.costs}
        columns |= {f"sent_{link}": sent > 0 for link, sent in self.sends.items()}
        return columns

    def plot(self, ax: Any = None, figsize: Size | None = None) -> Figure:
        """Return a figure with the cost of each step, and every send."""
        ticks = [float(tick) for tick in range(len(self.costs))]
        marks = [
            Series(
                np.flatnonzero(sent).astype(float).tolist(),
                [1.0] * int(sent.sum()),
                f"{link}: {int(sent.sum())} of {len(sent)}",
                "stems",
                color=i,
            )
            for i, (link, sent) in enumerate(self.sends.items())
        ]
        costs = Panel([Series(ticks, self.costs.tolist(), "cost of a step")], ylabel="cost", beside=True)
        return draw([costs, Panel(marks, "step", "sends", names=("", "sent"), beside=True)], ax, figsize)
