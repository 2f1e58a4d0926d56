"""Result of a network run: cost, rates and packets, as text, JSON, table and figure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from taciturn.extend import HEIGHT, Array, Lane, Panel, Series, Size, StyleName, draw, number_of, per_unit, table_text
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.model.result import VERDICT, Column, Columns, Field, Tabular, seconds
from taciturn.model.silence import Certificate, Life
from taciturn.nodes.lateness import Lateness, total_of
from taciturn.simulation.average import base_rate
from taciturn.study.evaluation import TimeUnit, Unit, rate_unit
from taciturn.study.sentences import WITHDRAWN, compared_text, share_of, share_text
from taciturn_udp.averages import measured

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _bound(found: NetworkRun) -> float | None:
    guarantee = found.loop.policy.guarantee if found.nominal else None
    return None if guarantee is None else guarantee.cost


def _rates(rates: Mapping[str, Estimate]) -> dict[str, Any]:
    return {link: measured(rate) for link, rate in rates.items()}


def _verdict(found: NetworkRun) -> Iterator[str]:
    """Yield packets, cost and losses, the certificate of the nodes, and faults of the run."""
    policy, packets = found.loop.policy, found.rates
    sent, lost = (sum(counted.get(name, 0) for counted in found.datagrams.values()) for name in ("sent", "lost"))
    told = [number_of(len(found.costs), "step")]
    share = share_of(packets, base_rate(found.loop))
    told += [] if share is None else [f"{share_text(share)} of the packets"]
    if found.cost is None:
        told.append("too few steps for a mean cost")
    elif found.nominal and policy.theory.cost is not None and (policy.theory.cost_all_time or 0.0) > 0:
        told.append(compared_text(found.cost, policy.cost_all_time))
    else:
        told.append(f"cost {found.cost} {found.per}")
    told.append(f"{lost} of {number_of(sent, 'packet')} dropped")
    late, inputs = (
        total_of(one for link, one in found.lateness.items() if (link in found.datagrams) is packet)
        for packet in (True, False)
    )
    told += [f"{late.late} of {late.arrived} late"] if found.real_time or late.late else []
    told += [f"{inputs.late} of {number_of(inputs.arrived, 'input')} late"] if inputs.late else []
    yield ", ".join(told)
    if found.certificate is not None:
        yield found.certificate.verdict()
    degraded = {name: sum(events.values()) for name, events in _degraded(found).items() if events}
    if degraded:
        yield f"degraded by events that no theory covers: {', '.join(f'{name} ({n})' for name, n in degraded.items())}"
    reasons = [note.removesuffix(WITHDRAWN) for note in found.notes if note.endswith(WITHDRAWN)]
    if reasons:
        yield f"no guarantee holds: {'; '.join(reasons)}"


def _links(found: NetworkRun) -> str:
    """Return the table of the links, with a column for each number that any of them counts."""
    names = list(dict.fromkeys(name for counted in found.datagrams.values() for name in counted))
    rows = list[list[str]]()
    for link, counted in found.datagrams.items():
        rate, share = found.rates.get(link), None
        if rate is not None:
            share = share_of({link: rate}, base_rate(found.loop))
        cells = ["" if rate is None else str(rate), "" if share is None else share_text(share)]
        rows.append([link, *cells, *(str(counted.get(name, "")) for name in names)])
    words = {"again": "sent again", "lost": "dropped"}
    told = [words.get(name, name.replace("_", " ")) for name in names]
    return table_text(["", f"sends per {found.rate_unit}", "of the packets", *told], rows, 1) if rows else ""


def _lateness(found: NetworkRun) -> Iterator[str]:
    """Yield how many packets of each link were late; in virtual time, only of links with late packets."""
    for link, counted in found.lateness.items():
        if counted.late or (found.real_time and counted.arrived):
            noun = "packet" if link in found.datagrams else "input"
            yield f"{link}: {counted.text(noun)}"


def _degraded(found: NetworkRun) -> dict[str, Any]:
    return {name: report["degraded"] for name, report in found.reports.items() if "degraded" in report}


def _reports(found: NetworkRun) -> Iterator[tuple[str, str]]:
    for name, report in found.reports.items():
        if report.get("degraded"):
            yield "degraded", f"{name}: " + ", ".join(f"{n} {why}" for why, n in report["degraded"].items())
        if report.get("lateness_ms"):
            shown = ", ".join(f"{share} {value:g}" for share, value in report["lateness_ms"].items())
            yield "lateness, ms", f"{name}: {shown}"


def uncertified(loop: Loop, reports: Mapping[str, Mapping[str, Any]]) -> tuple[str, ...]:
    """Return the reasons why the nodes' measurement of the cost of not sending is incomplete."""
    if not loop.policy.theory.silence:
        return ()
    return tuple(
        f"no certificate: the {name} reports events that no theory covers: "
        + ", ".join(f"{why} ({n})" for why, n in report["degraded"].items())
        for name, report in reports.items()
        if report.get("degraded")
    )


def _silences(found: NetworkRun) -> str:
    return "" if found.certificate is None else found.certificate.line()


@dataclass(frozen=True, eq=False, repr=False)
class NetworkRun(Tabular):
    """Measured cost and packets of a run of a problem's nodes over a network.

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
        lateness: numbers of data packets and of inputs of the plant that arrived, and of those that were late, by the
            steps that they were late, by link.
        real_time: whether the run was in real time.
    """

    FIELDS: ClassVar[tuple[Field[NetworkRun], ...]] = (
        VERDICT,
        Field("policy", "loop.policy.kind", say="policy"),
        Field("unit"),
        Field("base_rate", lambda found: base_rate(found.loop)),
        Field("cost", json=measured, say="cost", text="{} {of.per}"),
        Field(
            "cost_all_time",
            lambda found: found.loop.policy.theory.cost_all_time if found.nominal else None,
            say="every sample",
            text="{:.6g}",
        ),
        Field("cost_bound", _bound),
        Field("rates", json=_rates),
        Field("datagrams"),
        Field(
            "lateness",
            lambda found: {link: one.document() for link, one in found.lateness.items()},
            key="late_packets",
            say="late",
            text=_lateness,
        ),
        Field("seed", say="seed", part="method"),
        Field("method"),
        Field("seconds", json=seconds, say="time", text="{:.3g} s", part="method"),
        Field("ticks", lambda found: len(found.costs)),
        Field("degraded", _degraded),
        Field("certificate", json=Certificate.document, optional=True, say="certificate", text=_silences),
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
    lateness: Mapping[str, Lateness] = field(default_factory=dict[str, Lateness])
    real_time: bool = False

    @property
    def rate_unit(self) -> TimeUnit:
        """Unit of time to which the rates refer."""
        return rate_unit(self.unit)

    @property
    def certificate(self) -> Certificate | None:
        """Bound on the cost of not sending, as the nodes measured it; None if there is no valid measurement.

        A node that was degraded, for example because it started again without its state, has not counted all of its
        silence.
        """
        told = [one for report in self.reports.values() for one in report.get("silence", ())]
        if not told or not self.nominal or any(_degraded(self).values()):
            return None
        lives = tuple(Life(tuple(one["links"]), one["total"], one["steps"], one["factor"]) for one in told)
        problem, network = self.loop.problem, self.loop.network
        # a node learns in the next step whether a packet was lost, so it has not counted the last step
        costs = self.costs[:-1] if any(network.loss(link) > 0 for link in network.links) else self.costs
        duration = 1.0 if problem.cost.mission else len(costs) * problem.tick
        # the stage costs of the samples alone: of them, too, the certificate holds on every path
        return Certificate(lives, duration, float(costs.sum()) / duration) if len(costs) else None

    @property
    def per(self) -> str:
        """Unit to which the cost refers, as text."""
        return per_unit(self.unit)

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentences about packets, cost and losses, the bound that the nodes certify, and faults of the run."""
        return tuple(_verdict(self))

    def table_texts(self) -> Sequence[str]:
        """Return a table of the links and, if the nodes measure it, a table of each link's cost of not sending."""
        return (_links(self), "" if self.certificate is None else self.certificate.table())

    def columns(self) -> Columns:
        """Return columns with one row per step: the cost, and for each link whether a packet was sent."""
        columns: dict[str, Column] = {"tick": range(len(self.costs)), "cost": self.costs}
        columns |= {f"sent_{link}": sent > 0 for link, sent in self.sends.items()}
        return columns

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Plot the cost of each step, and mark every send."""
        ticks = [float(tick) for tick in range(len(self.costs))]
        costs = Panel([Series(ticks, self.costs.tolist(), "cost of a step", "steps")], ylabel="cost", height=HEIGHT / 2)
        lanes = [self._lane(link) for link in self.sends]
        return draw([costs, Panel(lanes=lanes, xlabel="step")], ax, figsize, style)

    def _lane(self, link: str) -> Lane:
        """Return the packets of a link: those that arrived, and the others."""
        sent = np.flatnonzero(self.sends[link]).astype(float).tolist()
        numbers = self.arrived.get(link, ())
        # a sender that starts again begins with the number 0: then the numbers do not tell which packets were dropped
        told = len(set(numbers)) == len(numbers) and max(numbers, default=0) < len(sent)
        dropped = [tick for number, tick in enumerate(sent) if told and number not in set(numbers)]
        delivered = [tick for tick in sent if tick not in set(dropped)]
        lost = f", {len(dropped)} dropped" if dropped else ""
        return Lane(link, delivered, dropped, note=f"{len(sent)} of {len(self.costs)}{lost}")
