"""LQG control over a horizon or with a discount, which sends when silence would add more than δ to the total cost."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from taciturn.design.anti_windup import within_limits
from taciturn.design.bounds import bound_by_attempts
from taciturn.design.certainty import Actuation, completed_square, control_steps
from taciturn.design.estimation import COLLOCATED, SEND, by_clock, estimate_state
from taciturn.design.prices import price_control
from taciturn.design.step_counter import StepCounter
from taciturn.lqg.discrete import Discrete
from taciturn.model.coverage import GAUSSIAN_THEORY, THEORY
from taciturn.model.policy import Policy
from taciturn.model.theory import Theory
from taciturn.model.trigger import Form, Trigger


def total_excess(kind: str, problem: Discrete, actuation: Actuation, price_at: Callable[[float], float]) -> Policy:
    """Return the policy that sends an input iff e'He > δ, with the gains and weights of each step.

    Args:
        kind: name of the policy kind.
        problem: the discrete-time problem, with a horizon or a discount.
        actuation: in silence, the actuator keeps the last input, or predicts it.
        price_at: function that returns δ per step, given the cost of every sample per step.
    """
    prices, counter, plant = price_control(problem), StepCounter.of(problem, 1), problem.plant
    found = counter.filter
    errors, start = (np.zeros((1, *plant.W.shape)), None if problem.cost.horizon else 0)
    if found is not None:
        errors, start = found.posterior, found.start
    cost = prices.total(errors, start)
    price = price_at(cost / problem.ticks)
    estimation = estimate_state(plant, None, gain=counter.gains)
    rule = Trigger({"silent": Form(("error",), by_clock(prices.H)), SEND: Form(constant=price)})
    steps, initial = control_steps(plant, estimation, by_clock(prices.L), actuation, rule)
    policy = Policy(
        kind=kind,
        steps=steps,
        model=plant,
        theory=Theory(
            cost=problem.cost,
            cost_all_time=problem.per_unit(cost),
            noise_cost=problem.noise_cost,
            guarantee=bound_by_attempts(problem, cost, price, 1, False),
            identity=completed_square(problem.per_unit(cost), prices.square()),
            covers=THEORY if plant.full_state else GAUSSIAN_THEORY,
        ),
        sites=COLLOCATED,
        locations=counter.locations,
        initial=initial,
        tick=problem.tick,
    )
    return within_limits(policy)
