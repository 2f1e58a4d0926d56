"""The best offline pattern: so many sends within so many ticks, again and again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import comb

import numpy as np

from taciturn._arrays import Array, block_diagonal, count, symmetrised
from taciturn.design.certainty import CLOCK, SEND, Certainty, control_steps, design_certainty
from taciturn.design.periodic import by_the_clock
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.periodic import lift
from taciturn.lqg.riccati import regulate
from taciturn.lqg.sampling import Sampled
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.trigger import Form, Scheduled, Trigger

MOST_PATTERNS = 2000
LONGEST = 1000  # ticks of a pattern


def periodic_schedule(
    plant: Plant | ContinuousPlant, cost: Cost, *, length: int, sends: int, period: float | None = None
) -> Policy:
    """Design the best controller that sends at fixed places of a pattern that repeats.

    Every pattern of ``length`` ticks with ``sends`` sends is tried, up to rotation. Between sends the input is held;
    each has the optimal gains of its periodic Riccati equation and its exact cost.

    Args:
        plant: the plant.
        cost: the average cost.
        length: ticks of the pattern.
        sends: of these, at least 1 and at most ``length``.
        period: seconds between ticks; only with a continuous plant.

    Returns:
        The policy, with its exact cost.

    Raises:
        ProblemError: more sends than ticks, more than 1,000 ticks or 2,000 patterns, period missing or out of place.
        UnstableError: no pattern has a stabilising gain.

    Source: bengaid2006

    Example:
        >>> plant, cost = Plant([[1.1]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> periodic_schedule(plant, cost, length=5, sends=2).closed_form.rates
        {'actuator': 0.4}
    """
    length, sends = count("length", length), count("sends", sends)
    if length > LONGEST:
        raise ProblemError(f"length is {length}; expected at most {LONGEST} ticks")
    if sends > length:
        raise ProblemError(f"sends is {sends} and length is {length}; expected at most as many sends as ticks")
    if comb(length - 1, sends - 1) > MOST_PATTERNS * sends:
        raise ProblemError(
            f"length is {length} and sends is {sends}, which is some {comb(length, sends) // length} patterns; "
            f"expected at most {MOST_PATTERNS}: a shorter pattern, or fewer sends"
        )
    problem = discretise(plant, cost, period)
    certainty = design_certainty("periodic-schedule", problem)
    stretches = Stretches(certainty)
    found: Pattern | None = None
    for intervals in necklaces(length, sends):
        try:
            tried = stretches.solve(intervals)
        except UnstableError:
            continue
        found = tried if found is None or tried.cost < found.cost else found
    if found is None:
        raise UnstableError(
            f"no pattern of {sends} sends in {length} ticks can be stabilised: held so long, the input loses a mode; "
            "expected another length, or more sends"
        )
    places, gains = found.unrolled()
    turn = Scheduled(CLOCK, np.where(places, -1.0, 1.0))
    trigger = Trigger({"silent": Form(), SEND: Form(constant=turn)})
    steps, initial = control_steps(problem.plant, certainty.estimation, Scheduled(CLOCK, gains), "hold", trigger)
    return by_the_clock("periodic-schedule", certainty, steps, initial, found.cost, sends / length, length)


@dataclass(frozen=True, eq=False)
class Pattern:
    """Sends that come these ticks after one another, again and again.

    Args:
        intervals: from one send to the next, in ticks.
        gains: of each send, (sends, m, n).
        values: cost-to-go x̂'Kx̂ at each send, (sends, n, n).
        cost: average per tick, without the inter-sample noise cost.
    """

    intervals: tuple[int, ...]
    gains: Array
    values: Array
    cost: float

    def unrolled(self) -> tuple[Array, Array]:
        """Return whether each tick sends, and its gain: that of the last send."""
        places = np.zeros(sum(self.intervals), dtype=bool)
        places[np.cumsum((0, *self.intervals[:-1]))] = True
        return places, np.repeat(self.gains, self.intervals, axis=0)


class Stretches:
    """The problem between two sends, for every number of ticks that is asked.

    Args:
        certainty: filter and regulator.
    """

    def __init__(self, certainty: Certainty) -> None:
        """Nothing is computed before it is asked."""
        self.certainty, self._known = certainty, dict[int, Sampled]()

    def hold(self, ticks: int) -> Sampled:
        """Return the problem of holding the input for so many ticks."""
        if ticks not in self._known:
            p, noise = self.certainty.problem, self.certainty.corrections
            self._known[ticks] = lift(p.plant.A, p.plant.B, p.Q, p.R, p.N, noise, ticks)
        return self._known[ticks]

    def solve(self, intervals: tuple[int, ...]) -> Pattern:
        """Return the optimal gains of a pattern and its cost.

        Raises:
            UnstableError: the plant cannot be stabilised so.
        """
        held = [self.hold(ticks) for ticks in intervals]
        values = [self._start(held)]
        gains: list[Array] = []
        average = 0.0
        for stretch in reversed(held):
            average += float(np.sum(values[0] * stretch.W)) + stretch.noise_cost
            K, L = step_back(stretch, values[0])
            gains.insert(0, L)
            values.insert(0, K)
        cost = self.certainty.unseen + average / sum(intervals)
        return Pattern(intervals, np.array(gains), np.array(values[:-1]), cost)

    def _start(self, held: list[Sampled]) -> Array:
        """Return K at the first send: the pattern as one problem, whose input is that of all its sends."""
        plant = self.certainty.problem.plant
        n, m = plant.states, plant.inputs
        A, B = np.eye(n), np.zeros((n, 0))
        M = np.zeros((n, n))
        for stretch in held:
            reach = np.hstack([A, B])  # the state at this send, of the first one and the inputs so far
            weight = block_diagonal(reach, np.eye(m))
            M = np.pad(M, ((0, m), (0, m)))
            M = M + weight.T @ np.block([[stretch.Q, stretch.N], [stretch.N.T, stretch.R]]) @ weight
            A, B = stretch.A @ A, np.hstack([stretch.A @ B, stretch.B])
        return regulate(A, B, symmetrised(M[:n, :n]), symmetrised(M[n:, n:]), M[:n, n:]).K


def step_back(stretch: Sampled, K: Array) -> tuple[Array, Array]:
    """Return the cost-to-go and the gain at the start of a stretch, from the cost-to-go at its end."""
    H = symmetrised(stretch.R + stretch.B.T @ K @ stretch.B)
    L: Array = -np.linalg.solve(H, stretch.B.T @ K @ stretch.A + stretch.N.T).astype(np.float64)
    return symmetrised(stretch.Q + stretch.A.T @ K @ stretch.A - L.T @ H @ L), L


def necklaces(length: int, sends: int) -> Iterator[tuple[int, ...]]:
    """Return the ways to write ``length`` as a sum of so many intervals, one of all rotations: the largest."""

    def extend(head: tuple[int, ...], left: int) -> Iterator[tuple[int, ...]]:
        missing = sends - len(head)
        if missing == 0:
            if left == 0 and all(head >= head[i:] + head[:i] for i in range(1, sends)):
                yield head
            return
        for interval in range(min(head[0] if head else left, left - missing + 1), 0, -1):
            yield from extend((*head, interval), left - interval)

    yield from extend((), length)
