"""Rollout: in each window of steps, the controller selects the cheapest schedule with as many sends as periodic
control.

A schedule of a window, followed by periodic control for ever, has optimal gains and a cost-to-go that is a quadratic
form of the estimate and the held input (``_Future``). The cheapest one costs no more than the periodic one, which is
among them, in every window. The sum over all windows telescopes: J ≤ J_periodic, at exactly the same rate.

A state of the policy stores only the sends that are left in the window. Schedules with the same remaining sends share a
state (``_WindowStates``).

Source: antunes2014rollout
"""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

from taciturn._arrays import Array, count, symmetrised
from taciturn._progress import check_time
from taciturn.base.certainty import (
    CertaintyEquivalentDesign,
    certainty_policy,
    control_steps,
    design_certainty,
    measure_excess,
)
from taciturn.base.filter import CLOCK, ESTIMATE, SEND, count_ticks
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import Assign, Decide, Evaluate, Location
from taciturn.model.theory import Guarantee
from taciturn.model.trigger import Form, Scheduled, Trigger

FUTURE, BEGIN, PLACE, DUE = "future", "begin", "place", "due"
MOST_FUTURES = 256


def rollout(
    plant: Plant | ContinuousPlant, cost: Cost, *, horizon: int, every: int, period: float | None = None
) -> Policy:
    """Design the policy that moves the sends of periodic control within a window to reduce the cost.

    The window consists of as many whole periods as fit into ``horizon``, but at least one. At the start of the window,
    the controller compares all schedules that have as many sends as periodic control. The cost of each schedule, with
    its optimal gains and followed by periodic control, is a quadratic form of the estimate and the held input. The
    controller selects the cheapest schedule. Since periodic control is one of the schedules,

        rate = 1/every exactly,  J ≤ J_periodic(every).

    Args:
        plant: the plant.
        cost: the average cost.
        horizon: steps of the window, rounded down to whole periods, at least one period.
        every: steps between sends of the periodic controller, at least 2.
        period: seconds between steps; only with a continuous plant.

    Returns:
        The policy, with its guarantee.

    Raises:
        ProblemError: if ``every`` is below 2, there are more than 256 schedules, or period is missing or not
            applicable.
        UnstableError: if no stabilising periodic controller exists.

    Source: antunes2014rollout

    Example:
        >>> plant, cost = Plant([[1.1]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> len(rollout(plant, cost, horizon=4, every=2).decisions["future"].labels)
        6
    """
    horizon, every = count("horizon", horizon), count("every", every, 2)
    periods = max(1, horizon // every)
    horizon = periods * every
    if horizon > MOST_FUTURES or comb(horizon, periods) > MOST_FUTURES:
        raise ProblemError(
            f"horizon = {horizon} and every = {every}, which gives more than {MOST_FUTURES} schedules; expected at "
            f"most {MOST_FUTURES} schedules: use a shorter horizon"
        )
    problem = discretise(plant, cost, period)
    certainty, unit = design_certainty("rollout", problem), np.eye(problem.plant.inputs)
    base = certainty.held.solve((every,))
    usual = tuple(range(0, horizon, every))
    others = (sends for sends in combinations(range(horizon), periods) if sends != usual)
    # periodic control is first, so it is selected at equal costs
    futures = [_Future(certainty, base.values[0], sends, horizon) for sends in (usual, *others)]
    window = _WindowStates(futures, horizon)
    turn = Scheduled(CLOCK, [-1.0] + [1.0] * (horizon - 1))
    later = Form(constant=Scheduled(PLACE, window.due))
    before = (
        Decide("controller", FUTURE, Trigger({f"future {i}": future.form for i, future in enumerate(futures)})),
        Decide("controller", BEGIN, Trigger({"go on": Form(), BEGIN: Form(constant=turn)})),
        Evaluate("controller", "at once", tuple(Form(constant=float(0 in future.gains)) for future in futures), FUTURE),
        Evaluate("controller", DUE, (later, Form(plus={"at once": 1.0})), BEGIN),
        Assign("controller", "first", tuple({ESTIMATE: future.gain(0)} for future in futures), FUTURE),
        Assign("controller", "command", ({"command": unit}, {"first": unit}), BEGIN),
    )
    measured, identity = measure_excess(certainty)
    steps, initial = control_steps(
        problem.plant,
        certainty.estimation,
        Scheduled(PLACE, window.gains),
        "hold",
        Trigger({"silent": Form(plus={DUE: 1.0}), SEND: Form(constant=0.5)}),
        before=before,
        after=(measured,),
    )
    statement = "J ≤ cost of optimal periodic control at the same rate; rate 1/every exactly"
    return certainty_policy(
        "rollout",
        certainty,
        steps,
        initial,
        identity=identity,
        locations=(
            count_ticks(horizon, 0),
            Location(PLACE, window.following, "controller", FUTURE),
        ),
        guarantee=Guarantee(problem.per_unit(certainty.estimation_cost + base.cost), statement, "antunes2014rollout"),
        fixed_rates={"actuator": 1 / every},
        slower=horizon,
    )


class _Future:
    """A schedule of the window followed by periodic control, with optimal gains and its cost-to-go from [x̂; û]."""

    def __init__(self, certainty: CertaintyEquivalentDesign, K: Array, sends: tuple[int, ...], horizon: int) -> None:
        """Compute the cost-to-go backwards; a send chooses the input, and silence holds the input."""
        p, n = certainty.problem, len(K)
        F = np.block([[p.plant.A, p.plant.B], [np.zeros((p.plant.inputs, n)), np.eye(p.plant.inputs)]])
        stage = np.block([[p.Q, p.N], [p.N.T, p.R]])
        V, noise = np.pad(K, ((0, p.plant.inputs),) * 2), 0.0
        self.sends, self.gains = sends, dict[int, Array]()
        for tick in reversed(range(horizon)):
            noise += float(np.sum(V[:n, :n] * certainty.corrections))
            V = symmetrised(stage + F.T @ V @ F)
            if tick in sends:
                L: Array = -np.linalg.solve(V[n:, n:], V[n:, :n]).astype(np.float64)
                self.gains[tick] = L
                V = np.pad(symmetrised(V[:n, :n] + V[:n, n:] @ L), ((0, p.plant.inputs),) * 2)
        self.form = Form((ESTIMATE, "candidate"), V, noise)

    def gain(self, tick: int) -> Array:
        """Return the feedback gain of this schedule at a step; the returned value is meaningful only at steps with a
        send.
        """
        return self.gains.get(tick, next(iter(self.gains.values())))


class _WindowStates:
    """The discrete states of a window: its start, and for each later step the remaining sends."""

    def __init__(self, futures: list[_Future], horizon: int) -> None:
        """Number the states; schedules with the same remaining sends share a state."""
        numbers: dict[tuple[int, tuple[int, ...]], int] = {}
        owners: list[tuple[int, _Future]] = [(0, futures[0])]
        for future in futures:
            for tick in range(1, horizon):
                check_time()
                rest = _rest(future, tick)
                if (tick, rest) not in numbers:
                    numbers[tick, rest] = len(owners)
                    owners.append((tick, future))

        def after(tick: int, future: _Future) -> int:
            return numbers[tick + 1, _rest(future, tick + 1)] if tick + 1 < horizon else 0

        self.due = np.array([float(tick in future.gains) for tick, future in owners])
        self.gains = np.array([future.gain(tick) for tick, future in owners])
        self.following = np.array(
            [[after(0, future) for future in futures]]
            + [[after(tick, future)] * len(futures) for tick, future in owners[1:]]
        )


def _rest(future: _Future, tick: int) -> tuple[int, ...]:
    return tuple(sent for sent in future.sends if sent >= tick)


KIND = Kind(
    name="rollout",
    design=rollout,
    goal="a fixed rate, with a cost that never exceeds that of periodic control",
    tuning=(TradeoffParameter("every", least=2, whole=True),),
    example={"horizon": 6, "every": 3},
    proved=r"$J\le J_{per}$, the rate is 1/`every`",
    relative_to="periodic control at every $q$-th step",
    data=(
        "one label with one form per schedule of the window; the step counter `clock` starts the windows; "
        "the location `place` stores the remaining sends"
    ),
    order=(
        "filter, compare the schedules, select the best schedule at the start of a window, send when the "
        "selected schedule sends"
    ),
    usual={"every": 2, "horizon": 4},
)
