"""Fair periodic control over several links: the periods and phases with the least cost found at a given traffic.

Every node measures at every step, and a packet of a sensor contains all that it has measured. A packet to an actuator
contains an input that is held, or the inputs until the next packet, with the optimal gains for the timing of all links.
The search changes one or two links at a time. Long phases of two timings share the time, so the least cost found at a
traffic is on the lower convex hull of all timings that were tried.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import permutations
from typing import Any, ClassVar

from taciturn.errors import UnstableError
from taciturn.extend import Progress, Stages, percent
from taciturn.lqg.discrete import discretise
from taciturn.lqg.periodic import MultirateControl, Timing
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Policy
from taciturn.model.result import Field, Result, plain_fields
from taciturn.problem import Problem
from taciturn.study.periodic import OF_A_DESIGN, ClockPoint, beside, lower_hull

PERIODS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64)
AROUND = (1.0, 1.25, 0.8)  # traffics, relative to the requested one, at which timings are sought
SAME = 1e-9  # relative
ROUNDS = 40  # of a search
Timings = tuple[Timing, ...]


@dataclass(frozen=True, repr=False)
class LinkClocks(Result):
    """Periodic control over several links at a traffic: the timing of each link, or two timings that share the time."""

    FIELDS: ClassVar[tuple[Field[LinkClocks], ...]] = (
        Field("kind", lambda found: "model" if found.plans else "hold"),
        *plain_fields("cost", "timings", "shares", "tried"),
    )

    cost: float  # cost at the traffic, exact for the timings that were found
    # period and phase of each link in steps, for one or two timings
    timings: tuple[Mapping[str, Timing], ...] = field(hash=False)
    shares: tuple[float, ...]  # share of the time of each timing
    plans: bool  # whether a packet to an actuator contains the inputs until the next packet, or one input that is held
    tried: int  # number of timings that were tried

    def short(self) -> str:
        """Return the periods and phases of the links in steps as text."""
        texts = [
            ", ".join(
                f"{link} every {one.period}{f' from {one.phase}' if one.phase else ''}" for link, one in timing.items()
            )
            for timing in self.timings
        ]
        both = [f"{percent(share, 3)} of the time {text}" for share, text in zip(self.shares, texts, strict=True)]
        return "; ".join(both) if len(both) > 1 else texts[0]


class NoLinkClocksError(Exception):
    """No periodic control of each link can be compared with a policy; the message gives the reason."""


@dataclass(eq=False)
class _Search:
    """The search for the timing of each link."""

    control: MultirateControl  # the cost of a timing
    prices: Mapping[str, float]  # price of a packet by link
    tick: float  # seconds per step
    progress: Stages  # receives the fraction done
    found: dict[Timings, float] = field(default_factory=lambda: {})  # cost of each timing that was tried

    @cached_property
    def links(self) -> list[str]:
        return list(self.prices)

    @cached_property
    def sensors(self) -> set[str]:
        return {*self.links}.intersection(self.control.network.sensors)

    def traffic(self, timings: Timings) -> float:
        prices = self.prices.values()
        return sum(price / (one.period * self.tick) for price, one in zip(prices, timings, strict=True))

    def cost(self, timings: Timings) -> float:
        if timings not in self.found:
            try:
                self.found[timings] = self.control.cost(dict(zip(self.links, timings, strict=True)))
            except UnstableError:
                self.found[timings] = float("inf")
            self.progress.tick()
        return self.found[timings]

    def descend(self, traffic: float) -> None:
        """Try timings with at most a traffic, each time the best of the neighbours of the last one."""
        equal = [tuple(Timing(period) for _ in self.links) for period in PERIODS]
        for begin in ([one for one in equal if self._allows(one, traffic)][:1], list(self._pairs(traffic))):
            if begin:
                self._descend_from(min(begin, key=self.cost), traffic)

    def _descend_from(self, here: Timings, traffic: float) -> None:
        for _ in range(ROUNDS):
            best = min((one for one in self._near(here) if self._allows(one, traffic)), key=self.cost, default=here)
            if self.cost(best) >= self.cost(here) * (1 - SAME):
                return
            here = best

    def _allows(self, timings: Timings, traffic: float) -> bool:
        return self.traffic(timings) <= traffic * (1 + SAME)

    def _pairs(self, traffic: float) -> Iterator[Timings]:
        """Yield timings with one period for all sensors and the shortest allowed period for all actuators."""
        for period in PERIODS:
            for other in PERIODS:
                timings = tuple(Timing(period) if link in self.sensors else Timing(other) for link in self.links)
                if self._allows(timings, traffic):
                    yield timings
                    break

    def _near(self, timings: Timings) -> Iterator[Timings]:
        """Yield timings with another period of one link, or of two in opposite directions, or with another phase."""
        places = range(len(timings))
        for place in places:
            for by in (-1, 1):
                yield from self._moved(timings, {place: by})
        for one, other in permutations(places, 2):
            yield from self._moved(timings, {one: -1, other: 1})
        for place in places:
            period = timings[place].period
            for phase in {0, period // 3, period // 2, 2 * period // 3}:
                yield _replaced(timings, place, Timing(period, phase))

    def _moved(self, timings: Timings, moves: Mapping[int, int]) -> Iterator[Timings]:
        for place, by in moves.items():
            index = PERIODS.index(timings[place].period) + by
            if not 0 <= index < len(PERIODS):
                return
            timings = _replaced(timings, place, Timing(PERIODS[index], timings[place].phase % PERIODS[index]))
        yield timings


def _replaced(timings: Timings, place: int, timing: Timing) -> Timings:
    return (*timings[:place], timing, *timings[place + 1 :])


def clocks_of_links(problem: Problem, traffic: float, progress: Progress | None = None) -> LinkClocks:
    """Return the periodic control over the links of a problem with the least cost found at a traffic."""
    network, policy = problem.network, problem.designed()
    if not isinstance(policy, Policy):
        raise NoLinkClocksError("the policy has no sampling steps")
    if set(policy.scheduled) != set(network.links):
        raise NoLinkClocksError("the policy does not decide on every link")
    plans = problem.parameters.get("actuation") == "model"
    if problem.cost.mission:
        raise NoLinkClocksError("periodic control is computed for average costs only")
    if not network.ideal or network.delay:
        raise NoLinkClocksError("periodic control is computed for links that deliver every packet in its step")
    differences = problem.close(policy).violated_assumptions
    if differences:
        raise NoLinkClocksError(f"{OF_A_DESIGN} {differences[0]}")
    period = policy.tick if isinstance(problem.plant, ContinuousPlant) else None
    discrete = discretise(problem.plant, problem.cost, period)
    prices = {link: law.price for link, law in network.links.items()}
    search = _Search(MultirateControl(discrete, network, plans), prices, discrete.tick, Stages(progress))
    for part, around in enumerate(AROUND):
        search.progress = Stages(progress, part / len(AROUND), (part + 1) / len(AROUND))
        search.descend(around * traffic)
        search.progress(1.0)
    at = {ClockPoint(search.traffic(one), cost): one for one, cost in search.found.items() if cost < float("inf")}
    corners = beside(lower_hull(at), traffic)
    if not corners:
        raise NoLinkClocksError("no periods with this traffic were found that stabilise the plant")
    low, high = corners
    share = (traffic - low.rate) / (high.rate - low.rate) if high.rate > low.rate else 0.0
    mixed = [(part, point) for part, point in ((1 - share, low), (share, high)) if part > SAME]
    return LinkClocks(
        sum(part * point.cost for part, point in mixed),
        tuple(dict(zip(prices, at[point], strict=True)) for _, point in mixed),
        tuple(part for part, _ in mixed),
        plans,
        len(search.found),
    )


def clocks_or_reason(problems: Sequence[Problem], traffic: float) -> LinkClocks | str:
    """Return periodic control for policies of one problem, or the reason why there is none.

    If one of the policies predicts at the actuators, a packet of periodic control contains the inputs of several steps.
    """
    predicting = [problem for problem in problems if problem.parameters.get("actuation") == "model"]
    try:
        return clocks_of_links((predicting or problems)[0], traffic)
    except NoLinkClocksError as error:
        return str(error)


def clocks_document(clocks: LinkClocks | str) -> dict[str, Any]:
    """Return a JSON document of periodic control, or of the reason why there is none."""
    return {"reason": clocks} if isinstance(clocks, str) else clocks.document()
