"""Self-triggered LQ control: at each send, the policy chooses the time of the next one, as late as its bound allows.

For each M, the cost of M steps with the best held input and of βx̂_M'Kx̂_M afterwards is a form x̂'P_Mx̂ plus that of
noise. The largest M is taken for which it is at most βx̂'Kx̂ + βM J_all. The sum of these inequalities over all sends
telescopes to J ≤ βJ_all. M = 1 satisfies it, since K is the cost-to-go of sending in every step and β ≥ 1.

Source: gommans2014
"""

from __future__ import annotations

import numpy as np

from taciturn._arrays import count, number, symmetrised
from taciturn._progress import check_time
from taciturn.base.certainty import certainty_policy, control_steps, design_certainty, measure_excess
from taciturn.base.filter import ESTIMATE, SEND
from taciturn.design.bounds import LARGEST_PARAMETER, less_noise
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.periodic import step_back
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import Assign, Decide, Evaluate, Step
from taciturn.model.theory import Guarantee
from taciturn.model.trigger import Form, Trigger

SLEEP, LEFT = "sleep", "left"
LONGEST = 100


def self_triggered(
    plant: Plant | ContinuousPlant, cost: Cost, *, beta: float, max_interval: int, period: float | None = None
) -> Policy:
    """Design LQG control in which each send determines the time of the next send.

    With the estimate x̂ at a send, the input is held for the largest M ≤ ``max_interval`` steps with

        min_u E[cost of M steps + β x̂_M'Kx̂_M] ≤ β x̂'Kx̂ + β M J_all,

    and the input is the minimising u. The left side is x̂'P_Mx̂ plus the cost of noise. M = 1 always satisfies the
    inequality. The sum over the sends gives J ≤ β J_all.

    Args:
        plant: the plant.
        cost: the average cost.
        beta: factor β ≥ 1 on the cost of sending every sample that bounds the cost.
        max_interval: largest number of steps between sends, 1 to 100.
        period: seconds between steps; only with a continuous plant.

    Returns:
        The policy, with J ≤ β J_all − (β−1)c and mean-square stability; c is the inter-sample noise cost, which no
        control changes and which is 0 for a discrete plant.

    Raises:
        ProblemError: if β < 1, max_interval is out of range, or period is missing or not applicable.
        UnstableError: if no stabilising gain or filter exists.

    Source: gommans2014

    Example:
        >>> plant, cost = Plant([[1.1]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> policy = self_triggered(plant, cost, beta=1.2, max_interval=5)
        >>> round(policy.guarantee.cost / policy.cost_all_time, 9)
        1.2
    """
    beta, max_interval = number("beta", beta, 1.0, LARGEST_PARAMETER, closed=True), count("max_interval", max_interval)
    if max_interval > LONGEST:
        raise ProblemError(f"max_interval is {max_interval}; expected at most {LONGEST} steps")
    problem = discretise(plant, cost, period)
    certainty = design_certainty("self-triggered", problem)
    K, all_time, m = certainty.regulator.K, certainty.cost_all_time, problem.plant.inputs
    stretches, keep = certainty.held, np.eye(m)
    choose: list[Step] = [Evaluate("controller", SLEEP, (Form(constant=1.0),))]
    first = step_back(stretches.lifted(1), beta * K)[1]
    for ticks in range(2, max_interval + 1):
        check_time()
        held = stretches.lifted(ticks)
        P, L = step_back(held, beta * K)
        noise = ticks * certainty.estimation_cost + held.noise_cost + beta * float(np.sum(K * held.W))
        worse = Form((ESTIMATE,), symmetrised(P - beta * K), noise - beta * ticks * all_time)
        asked = f"{SLEEP} {ticks}"
        choose += [
            Decide("controller", asked, Trigger({"shorter": Form(), "allowed": worse})),
            Evaluate("controller", SLEEP, (Form(plus={SLEEP: 1.0}), Form(constant=float(ticks))), asked),
            Assign("controller", "command", ({"command": keep}, {ESTIMATE: L}), asked),
        ]
    due = Trigger({"silent": Form(plus={LEFT: -1.0}), SEND: Form(constant=-0.5)})
    counted = (Form(plus={LEFT: 1.0}, constant=-1.0), Form(plus={SLEEP: 1.0}, constant=-1.0))
    measured, identity = measure_excess(certainty)
    steps, initial = control_steps(
        problem.plant,
        certainty.estimation,
        first,
        "hold",
        due,
        before=tuple(choose),
        after=(Evaluate("controller", LEFT, counted, SEND), measured),
    )
    return certainty_policy(
        "self-triggered",
        certainty,
        steps,
        initial,
        identity=identity,
        guarantee=Guarantee(
            problem.per_unit(beta * certainty.cost_all_time),
            f"J ≤ β J_all{less_noise(problem, '(β−1)')}, {certainty.stability}",
            "gommans2014",
        ),
        slower=max_interval,
    )


KIND = Kind(
    name="self-triggered",
    design=self_triggered,
    goal="a next send whose time is known at the previous one",
    tuning=(TradeoffParameter("beta", least=1.0),),
    example={"beta": 1.1, "max_interval": 10},
    proved=r"$J\le\beta J_{all}$",
    relative_to="LQG with every sample",
    data="a decision and a gain per sleeping time; `Evaluate` memories `sleep` and `left`",
    order="filter, evaluate every sleeping time, send when no step is left, count",
    usual={"beta": 1.2, "max_interval": 5},
)
