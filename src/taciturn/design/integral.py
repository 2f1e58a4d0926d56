"""The consistent dynamic trigger: send when the cost of predicting since the last send reaches what is allowed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from taciturn._arrays import number
from taciturn.design.consistent import refuse_what_is_not_predicted
from taciturn.errors import ProblemError
from taciturn.lqg.prediction import PredictionCost, prediction_cost
from taciturn.model.cost import Cost
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.renewal.cycles import CycleEstimate, estimate_cycles
from taciturn.renewal.events import IntegralTrigger, JumpProcess
from taciturn.renewal.policy import EventPolicy

FIRST_CYCLES, CYCLES = 20_000, 2_000_000  # of the search for the fixed point, and of its last steps
ROUNDS = 60
PRINTED = 1e-6  # relative: a slope given with as many digits as its limit is printed
SURE = 4.0  # standard errors


def integral(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    slope: float,
    saturation: float = np.inf,
    alpha: float | None = None,
    h_min: float = 0.0,
    h_max: float = np.inf,
) -> EventPolicy:
    """Design the policy that sends when the integrated cost of the prediction's error reaches what is allowed.

    Both ends run dx̂/dt = (A + BL)x̂, set to x at a send. With e = x − x̂ the state is sent β seconds after the last
    send, at the first time in (h_min, h_max] at which

        (1/α) ∫_0^β e'L'RLe ds ≥ f(β),  f(β) = C min(β, ε),

    and at h_max at the latest. With L(α) the mean interval that follows, α ≤ L(α), and f below what periodic control
    costs beyond tr(PλW), the policy costs no more than periodic control at its own mean interval. Only c = αC
    matters; α* = L(α*) makes the most of a slope.

    Args:
        plant: continuous in time, its full state measured, pushed by jumps.
        cost: an average.
        slope: C > 0, cost per second and second.
        saturation: ε > 0, seconds after which f rises no more; omitted: never.
        alpha: α > 0, seconds; omitted: the fixed point, by simulation.
        h_min: shortest interval, seconds.
        h_max: longest interval, seconds; may be infinite.

    Returns:
        The policy, analysed as a renewal process. With h_min = 0: J ≤ tr(PλW) + c min(1, ε/E[θ]), and J ≤ J_per(E[θ]).

    Raises:
        ProblemError: a discrete plant, no jumps, C or V, a parameter out of range, a slope for which f < g fails, or
            α > L(α).
        UnstableError: no stabilising gain, or an interval that does not end.

    Source: khashooei2017

    Example:
        >>> from taciturn import Jumps
        >>> plant = ContinuousPlant([[0.0]], [[1.0]], jumps=Jumps(2.0, [[0.5]]))
        >>> policy = integral(plant, Cost([[1.0]], [[1.0]]), slope=0.4, alpha=1.0, h_max=5.0)
        >>> policy.cost_all_time, policy.bound()
        (1.0, 1.4)
    """
    plant = refuse_what_is_not_predicted("integral", plant, cost)
    if plant.jumps is None:
        raise ProblemError("the plant has Wiener noise, and integral is triggered between jumps; expected plant.jumps")
    slope = number("slope", slope, 0.0)
    search = _Search(
        JumpProcess(plant.A, plant.jumps, (price := _price(plant, cost)).S),
        IntegralTrigger(1.0, saturation, h_min, h_max),
        slope,
        _largest_slope(price, saturation, h_min, h_max),
    )
    found = search.fixed_point() if alpha is None else search.given(number("alpha", alpha, 0.0))
    return EventPolicy(
        "integral",
        plant,
        cost,
        search.process,
        replace(search.trigger, c=found.value * slope),
        price.base,
        found,
        None if h_min > 0 else "J ≤ tr(PλW) + ξ f(E[θ]), and no more than periodic control at its mean interval",
        "khashooei2017",
    )


def _price(plant: ContinuousPlant, cost: Cost) -> PredictionCost:
    price = prediction_cost(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W)
    if price.growth(1.0) <= 0:
        raise ProblemError(
            "no noise reaches an error that costs anything, so that nothing would ever be sent; "
            "expected jumps of states that L'RL weighs, now or later"
        )
    return price


def _largest_slope(price: PredictionCost, saturation: float, h_min: float, h_max: float) -> float:
    """Return the slope up to which C min(h, ε) stays below g(h) on (h_min, h_max)."""
    if saturation <= h_min:
        return price.growth(h_min) / saturation
    return price.least_ratio(h_min, min(saturation, h_max))[0]


@dataclass(frozen=True, eq=False)
class _Search:
    """The search for an α that is consistent.

    Args:
        process: the error between sends.
        trigger: everything but c.
        slope: C.
        largest: slope up to which f < g.
    """

    process: JumpProcess
    trigger: IntegralTrigger
    slope: float
    largest: float

    def given(self, alpha: float) -> Estimate:
        """Return a given α, if it is consistent.

        Raises:
            ProblemError: α > L(α), or αC/L(α), the slope that counts, is too large.
        """
        interval = self.after(alpha, CYCLES).interval
        if alpha > interval.value + SURE * interval.standard_error:
            raise ProblemError(
                f"alpha is {alpha:g}, and the mean interval L(alpha) that follows is {interval}; "
                "expected alpha ≤ L(alpha): a smaller one, or none for the fixed point"
            )
        allowed = self.largest * (interval.value + SURE * interval.standard_error)
        if alpha * self.slope > allowed * (1 + PRINTED):
            raise ProblemError(
                f"slope is {self.slope:g}, and with alpha = {alpha:g} f stays below what periodic control costs up to "
                f"{allowed / alpha:.6g}; expected 0 < slope ≤ {allowed / alpha:.6g} with this alpha"
            )
        return Estimate(alpha, 0.0, "exact")

    def fixed_point(self) -> Estimate:
        """Return α* = L(α*), by a secant method on common random numbers.

        Raises:
            ProblemError: the slope is too large.
        """
        if self.slope > self.largest * (1 + PRINTED):
            raise ProblemError(
                f"slope is {self.slope:g}, and f stays below what periodic control costs up to {self.largest:.6g}; "
                f"expected 0 < slope ≤ {self.largest:.6g}"
            )
        alpha = max(self.trigger.h_min, 1 / self.process.jumps.rate)
        gain, before = 0.0, None
        for round in range(ROUNDS):
            found = self.after(alpha, min(CYCLES, FIRST_CYCLES * 2**round)).interval
            miss = found.value - alpha
            if before is not None and before[0] != alpha:
                gain = float(np.clip((found.value - before[1]) / (alpha - before[0]), 0.0, 0.9))
            error = found.standard_error / (1 - gain)
            if FIRST_CYCLES * 2**round >= CYCLES and abs(miss) <= 0.1 * found.standard_error:
                return Estimate(alpha, error, "simulation")
            before, alpha = (alpha, found.value), alpha + miss / (1 - gain)
        raise ProblemError(
            f"no alpha with alpha = L(alpha) was found within {ROUNDS} steps, the last being {alpha:g}; expected a "
            "smaller slope, or a given alpha"
        )

    def after(self, alpha: float, cycles: int) -> CycleEstimate:
        """Return what cycles under an α look like."""
        return estimate_cycles(self.process, replace(self.trigger, c=alpha * self.slope), cycles=cycles)
