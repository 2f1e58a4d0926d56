"""Fair periodic control over several links: the least cost of all tested periods and phases at a given traffic.

Without a controller to keep, every node measures at every step, and a packet of a sensor contains all that it has
measured. A packet to an actuator contains an input that is held, or the inputs until the next packet, with the optimal
gains for the timing of all links. With a given controller, all nodes do what they do under the policy, only at fixed
steps (``study/timed_links``); the policies that are compared may hold or predict, and the cheapest of these counts.

The search changes one or two links at a time. Long phases of two timings share the time, so the least cost found at a
traffic is on the lower convex hull of all timings that were tried.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import permutations
from typing import Any, ClassVar, Protocol

from taciturn.errors import UnstableError
from taciturn.extend import Progress, Stages, percent
from taciturn.lqg.discrete import discretise
from taciturn.lqg.periodic import MultirateControl, Timing
from taciturn.model.estimate import Estimate
from taciturn.model.link import LinkLaw
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Policy
from taciturn.model.result import Field, Result, plain_fields
from taciturn.model.steps import Apply
from taciturn.problem import Problem
from taciturn.study.evaluation import Evaluation
from taciturn.study.periodic import OF_A_DESIGN, ClockPoint, beside, lower_hull
from taciturn.study.timed_links import TimedLinks, modes_of

PERIODS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64)
EQUAL = 16  # common periods of all links that are tried, up to so many steps
AROUND = (1.0, 1.25, 0.8, 1.6, 0.6)  # traffics, relative to the requested one, at which timings are sought
SAME = 1e-9  # relative
ROUNDS = 40  # of a search
Timings = tuple[Timing, ...]


@dataclass(frozen=True, repr=False)
class LinkClocks(Result):
    """Periodic control over several links at a given traffic: fixed periods and phases, or two such timings in turn."""

    FIELDS: ClassVar[tuple[Field[LinkClocks], ...]] = (
        Field("kind", lambda found: "model" if found.plans else "hold"),
        Field("gains", lambda found: "given" if found.given else "optimal"),
        *plain_fields("cost", "timings", "shares", "tried"),
    )

    cost: float  # cost at the traffic, exact for the timings that were found
    # period and phase of each link in steps, for one or two timings
    timings: tuple[Mapping[str, Timing], ...] = field(hash=False)
    shares: tuple[float, ...]  # share of the time of each timing
    # whether a packet to an actuator contains the inputs until the next packet, or one input that is held; with a given
    # controller, whether a silent value is predicted
    plans: bool
    tried: int  # number of timings that were tried
    given: bool = False  # whether it is a given controller, or one with the optimal gains for the timings

    @property
    def whose(self) -> str:
        """The control as text."""
        return "the same controller" if self.given else "optimal gains"

    def short(self) -> str:
        """Return the period and the phase of each link, in steps, as text."""
        texts = [
            ", ".join(
                f"{link} every {one.period}{f' from {one.phase}' if one.phase else ''}" for link, one in timing.items()
            )
            for timing in self.timings
        ]
        both = [f"{percent(share, 3)} of the time {text}" for share, text in zip(self.shares, texts, strict=True)]
        return "; ".join(both) if len(both) > 1 else texts[0]


class NoLinkClocksError(Exception):
    """Error raised if no periodic control over several links can be compared with a policy; its text says why."""


class Control(Protocol):
    """Interface for control over links that send at fixed steps; it computes the cost of periods and phases."""

    def cost(self, timings: Mapping[str, Timing]) -> float:
        """Compute the cost of links with given periods and phases; raise ``UnstableError`` if the loop is unstable."""
        ...


@dataclass(eq=False)
class _Costs:
    """Costs of timings, infinite if unstable, that searches share whose loops are alike at fixed steps."""

    control: Control | None = None  # that of the first of these loops
    known: dict[Timings, float] = field(default_factory=lambda: {})


@lru_cache(maxsize=8)
def _costs_of(*alike: Hashable) -> _Costs:
    """Return the costs that are known for loops with this plant, cost, network, controller and behaviour in silence."""
    return _Costs()


@dataclass(eq=False)
class _Search:
    """The search for the timing of each link."""

    control: Control  # the cost of a timing
    known: dict[Timings, float]  # costs that any search has computed
    sensors: frozenset[str]
    laws: Mapping[str, LinkLaw]
    tick: float  # seconds per step
    progress: Stages  # receives the fraction done
    found: dict[Timings, float] = field(default_factory=lambda: {})  # cost of each timing that this search tried

    @cached_property
    def links(self) -> list[str]:
        return list(self.laws)

    def traffic(self, timings: Timings) -> float:
        laws = self.laws.values()
        return sum(law.price / (one.period * self.tick) for law, one in zip(laws, timings, strict=True))

    def cost(self, timings: Timings) -> float:
        if timings not in self.found:
            if timings not in self.known:
                self.known[timings] = self._computed(timings)
            self.found[timings] = self.known[timings]
            self.progress.tick()
        return self.found[timings]

    def _computed(self, timings: Timings) -> float:
        named = dict(zip(self.links, timings, strict=True))
        try:
            return self.control.cost(named) if self._keeps(named) else float("inf")
        except UnstableError:
            return float("inf")

    def _keeps(self, timings: Mapping[str, Timing]) -> bool:
        """Return whether timings keep the limits of the intervals between sends."""
        laws = self.laws.items()
        return all(
            law.min_interval <= timings[link].period <= (law.max_interval or timings[link].period) for link, law in laws
        )

    def begin(self) -> None:
        """Compute the cost of each period that all links can share; the result may alternate between two of these."""
        for period in range(1, EQUAL + 1):
            self.cost(tuple(Timing(period) for _ in self.links))

    def descend(self, traffic: float) -> None:
        """Search for cheaper periods and phases within a given traffic; each iteration moves to the best neighbour."""
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
    """Search for the periodic control over a problem's links with the least cost at a given traffic."""
    network, policy = problem.network, problem.designed()
    if not isinstance(policy, Policy):
        raise NoLinkClocksError(
            "periodic control of links requires sampling steps, but the policy works in continuous time"
        )
    if set(policy.scheduled) != set(network.links):
        raise NoLinkClocksError("periodic control of links requires a policy with send decisions on every link")
    if problem.controller is not None and _by_function(policy):
        raise NoLinkClocksError(
            f"the policy {policy.kind} computes with Python functions, so its steps are not linear even without "
            "decisions"
        )
    if problem.cost.mission:
        raise NoLinkClocksError(
            "the cost has a horizon or a discount, but periodic control is computed for average costs only"
        )
    if not network.ideal or network.delay:
        raise NoLinkClocksError(
            "periodic control of links is computed only for ideal links, which deliver every packet in the step of its "
            "send"
        )
    differences = problem.close(policy).violated_assumptions
    if differences:
        raise NoLinkClocksError(f"{OF_A_DESIGN} {differences[0]}")
    costs = _costs_of(problem.plant, problem.cost, network, problem.reference, policy.tick, *_timed_alike(problem))
    if costs.control is None:
        costs.control = _optimal(problem, policy) if problem.controller is None else TimedLinks.of(problem, policy)
    search = _Search(
        costs.control, costs.known, frozenset(network.sensors), network.links, policy.tick, Stages(progress)
    )
    search.begin()
    for part, around in enumerate(AROUND):
        search.progress = Stages(progress, part / len(AROUND), (part + 1) / len(AROUND))
        search.descend(around * traffic)
        search.progress(1.0)
    at = dict[ClockPoint, Timings]()
    for one, cost in search.found.items():
        if cost < float("inf"):  # rounded, so that of timings that differ in nothing but their start the first counts
            at.setdefault(ClockPoint(search.traffic(one), float(f"{cost:.12g}")), one)
    corners = beside(lower_hull(at), traffic)
    if not corners:
        raise NoLinkClocksError("no allowed periods were found that have this traffic and stabilise the plant")
    low, high = corners
    share = (traffic - low.rate) / (high.rate - low.rate) if high.rate > low.rate else 0.0
    mixed = [(part, point) for part, point in ((1 - share, low), (share, high)) if part > SAME]
    return LinkClocks(
        sum(part * point.cost for part, point in mixed),
        tuple(dict(zip(search.links, at[point], strict=True)) for _, point in mixed),
        tuple(part for part, _ in mixed),
        _plans(problem) if problem.controller is None else "model" in modes_of(problem),
        len(search.found),
        problem.controller is not None,
    )


def at_same_traffic(problem: Problem, evaluation: Evaluation) -> Estimate | None:
    """Return the cost of periodic control with a given controller over several links, at the policy's traffic."""
    traffic = evaluation.traffic
    if problem.controller is None or traffic is None or len(evaluation.rates) < 2 or traffic.value <= 0:
        return None
    try:
        return at_traffic(problem, traffic)
    except NoLinkClocksError:
        return None


def at_traffic(problem: Problem, traffic: Estimate) -> Estimate:
    """Return the least cost found for periodic control over several links at a measured traffic, with its error."""
    here, less = (clocks_of_links(problem, traffic.value - by).cost for by in (0.0, traffic.standard_error))
    return Estimate(here, abs(less - here), traffic.method)


def _optimal(problem: Problem, policy: Policy) -> MultirateControl:
    """Return control with the optimal gains for a timing."""
    period = policy.tick if isinstance(problem.plant, ContinuousPlant) else None
    return MultirateControl(discretise(problem.plant, problem.cost, period), problem.network, _plans(problem))


def _plans(problem: Problem) -> bool:
    """Return whether a packet to an actuator contains the inputs until the next packet."""
    return problem.parameters.get("actuation") == "model"


def _by_function(policy: Policy) -> bool:
    """Return whether the nodes compute something with functions."""
    return any(isinstance(step, Apply) for step in policy.steps)


def clocks_or_reason(problems: Sequence[Problem], traffic: float) -> LinkClocks | str:
    """Return the cheapest periodic control for policies of one plant and network, or a text that says why none exists.

    Without a given controller, a packet of periodic control contains the inputs of several steps if one of the policies
    predicts at the actuators. For a given controller, periodic control is tried with the behaviour of each policy
    between sends.
    """
    free = sorted((one for one in problems if one.controller is None), key=_plans)[-1:]
    kept = {_timed_alike(one): one for one in reversed(problems) if one.controller is not None}
    found, reasons = list[LinkClocks](), list[str]()
    for problem in (*free, *reversed(kept.values())):
        try:
            found.append(clocks_of_links(problem, traffic))
        except NoLinkClocksError as error:
            reasons.append(str(error))
    return min(found, key=lambda one: one.cost) if found else reasons[0]


def _timed_alike(problem: Problem) -> tuple[Hashable, ...]:
    """Return the data on which the cost at given times depends, for problems of one plant, cost and network."""
    policy = problem.designed()
    return problem.controller, modes_of(problem), isinstance(policy, Policy) and _by_function(policy)


def clocks_document(clocks: LinkClocks | str) -> dict[str, Any]:
    """Return the JSON document of periodic control, or of the text that says why none exists."""
    return {"reason": clocks} if isinstance(clocks, str) else clocks.document()
