"""The policy kind ``integral``: the sensor sends when the prediction cost since the last send reaches a limit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from taciturn.base.filter import SEND
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.design.prediction import ERROR, predicted_steps, refuse_what_is_not_predicted
from taciturn.errors import ProblemError
from taciturn.extend import check_time, crossing, number
from taciturn.lqg.discrete import discretise
from taciturn.lqg.prediction import PredictionCost, prediction_cost
from taciturn.model.cost import Cost
from taciturn.model.coverage import THEORY
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant, JumpNoise, Plant, Prediction
from taciturn.model.policy import Policy
from taciturn.model.steps import Evaluate, Location
from taciturn.model.theory import Guarantee, Identity, Theory
from taciturn.model.trigger import Form, Scheduled, Trigger
from taciturn_events.cycles import PERIOD_TOLERANCE, CycleEstimate, SampledProcess, estimate_cycles
from taciturn_events.events import IntegralTrigger, JumpProcess
from taciturn_events.policy import EventPolicy

MARGIN, SINCE = "margin", "since"
MOST_PLACES = 20_000  # largest number of checks after a send that a node can count
NEVER = 1e30  # much larger than any cost
FIRST_CYCLES, CYCLES = 20_000, 2_000_000  # simulated intervals in the search for the fixed point, and in its last steps
ROUNDS = 20
LONGEST = 2000  # largest α that is tried, relative to the first α
RESOLVED = 3e-5  # relative tolerance of the fixed point, far below its standard error
LOOKS = 6  # iterations of the search for a period
COARSE, FINE = 50, 200  # checks per mean interval
PRINTED = 1e-6  # relative tolerance for a slope that equals its limit as printed
SURE = 4.0  # number of standard errors
STATEMENT = (
    "J ≤ tr(PW) + alpha·slope·min(1, saturation/mean interval), and no more than periodic control at this mean interval"
)


def integral(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    slope: float,
    saturation: float = np.inf,
    alpha: float | None = None,
    h_min: float = 0.0,
    h_max: float = np.inf,
    period: float | None = None,
) -> Policy | EventPolicy:
    """Design the policy that sends when the integrated cost of the prediction error reaches a limit.

    Sensor and actuator run dx̂/dt = (A + BL)x̂, and a send sets x̂ to x. With e = x − x̂, the state is sent β seconds
    after the last send, at the first time in (h_min, h_max] at which

        (1/α) ∫_0^β e'L'RLe ds ≥ f(β),  f(β) = C min(β, ε),

    and at h_max at the latest. Let L(α) be the resulting mean interval. If α ≤ L(α), and f is below the cost g of
    periodic control beyond tr(PW), the policy costs no more than periodic control at its own mean interval. The policy
    depends on α and C only through c = αC; for a given slope, α* = L(α*) is the largest admissible value.

    With a period, the error is checked only every τ seconds. The integral is then replaced by its expectation given
    the checked errors, η ← η + e'Γ(τ)e + τ g(τ), and the state is sent before η exceeds the allowed value: iff
    η + e'Γe + τ g(τ) > α f(β + τ). The same bounds hold. Under Wiener noise the error is always checked periodically.

    Args:
        plant: continuous-time plant with measured full state; jumps or Wiener noise.
        cost: the average cost.
        slope: slope C > 0 of f, cost per second squared.
        saturation: time ε > 0 in seconds after which f is constant; default infinite.
        alpha: α > 0 in seconds; if omitted, the fixed point α*, computed by simulation.
        h_min: shortest interval in seconds.
        h_max: longest interval in seconds; may be infinite.
        period: time τ in seconds between checks. If omitted, the error is checked continuously under jumps, and 200
            times per mean interval under Wiener noise, with a note on the effect of checking twice as often.

    Returns:
        With periodic checks, a policy of nodes and packets; otherwise a policy that is analysed as a renewal process.
        With h_min = 0: J ≤ tr(PW) + alpha·slope·min(1, saturation/mean interval), and J ≤ J_per of the mean interval.

    Raises:
        ProblemError: if the plant is discrete in time or has C or V, a parameter is out of range, the slope violates
            f < g, α > L(α), or the period is too long for the allowed value.
        UnstableError: if no stabilising gain exists, or an interval does not end.

    Source: khashooei2017

    Example:
        >>> from taciturn import Jumps
        >>> plant = ContinuousPlant([[0.0]], [[1.0]], jumps=Jumps(2.0, [[0.5]]))
        >>> policy = integral(plant, Cost([[1.0]], [[1.0]]), slope=0.4, alpha=1.0, h_max=5.0)
        >>> policy.cost_all_time, policy.bound()
        (1.0, 1.4)
    """
    plant = refuse_what_is_not_predicted("integral", plant, cost)
    price = _price(plant, cost)
    slope, trigger = number("slope", slope, 0.0), IntegralTrigger(1.0, saturation, h_min, h_max)
    largest = _largest_slope(price, trigger)
    if largest <= 0:
        raise ProblemError(
            "no slope is admissible: the threshold f increases without bound, but the cost of periodic control is "
            "bounded or "
            "increases too slowly at first; expected a finite h_max or saturation, or h_min > 0"
        )

    notes: list[str] = []

    def found(process: JumpProcess | SampledProcess) -> tuple[Estimate, IntegralTrigger]:
        search = _Search(process, trigger, slope, largest, period)
        value = search.fixed_point() if alpha is None else search.given(number("alpha", alpha, 0.0))
        if alpha is None:
            notes.append(f"alpha = {value} s is the fixed point L(alpha) = alpha")
        return value, replace(trigger, c=value.value * slope)

    statement = None if h_min > 0 else STATEMENT
    if period is None and plant.jumps is not None:
        process = JumpProcess(plant.A, plant.jumps, price.S)
        value, rule = found(process)
        return EventPolicy(
            "integral", plant, cost, process, rule, price.base, value, statement, "khashooei2017", tuple(notes)
        )
    if period is not None:
        process = sampled_error(plant, price, number("period", period, 0.0))
        return _looking(plant, cost, price, process, found(process)[1], statement, notes)
    length = 1.0
    for _ in range(LOOKS):  # the period depends on the interval, which hardly depends on the period
        check_time()
        process = sampled_error(plant, price, length / COARSE)
        reached = replace(trigger, c=slope * (length if alpha is None else alpha))
        length = estimate_cycles(process, reached, cycles=FIRST_CYCLES).interval.value
    process = sampled_error(plant, price, length / FINE)
    _, rule = found(process)
    return _looking(plant, cost, price, process, rule, statement, [*notes, _resolution(plant, price, process, rule)])


def _price(plant: ContinuousPlant, cost: Cost) -> PredictionCost:
    price = prediction_cost(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W)
    if price.growth(1.0) <= 0:
        raise ProblemError(
            "the noise causes no error with a cost, so the policy would never send; expected noise on states to "
            "which L'RL gives weight, directly or through the dynamics"
        )
    return price


def _largest_slope(price: PredictionCost, trigger: IntegralTrigger) -> float:
    """Return the largest slope C for which C min(h, ε) is below g(h) on (h_min, h_max)."""
    if trigger.saturation <= trigger.h_min:
        return price.growth(trigger.h_min) / trigger.saturation
    return price.least_ratio(trigger.h_min, min(trigger.saturation, trigger.h_max))[0]


def sampled_error(plant: ContinuousPlant, price: PredictionCost, period: float) -> SampledProcess:
    """Return the model of the prediction error from one periodic check of the trigger to the next."""
    noise = price.spread(period) if plant.jumps is None else JumpNoise(plant.A, plant.jumps, period)
    return SampledProcess(price.flow(period), noise, price.weight(period), period * price.growth(period), period)


def _resolution(
    plant: ContinuousPlant, price: PredictionCost, process: SampledProcess, trigger: IntegralTrigger
) -> str:
    """Return a sentence on the effect of checking the error twice as often."""
    finer = sampled_error(plant, price, process.period / 2)
    one, other = (estimate_cycles(p, trigger, cycles=CYCLES // 10) for p in (process, finer))
    changes: list[str] = []
    for name, before, after in (("mean interval", one.interval, other.interval), ("cost", one.cost, other.cost)):
        change = after.value - before.value
        error = float(np.hypot(before.standard_error, after.standard_error))
        changes.append(f"the {name} by {Estimate(change, error, 'simulation')}")
    return (
        f"the error is checked every {process.period:.4g} s; checking twice as often changes {' and '.join(changes)}, "
        "and checking continuously changes them about twice as much"
    )


def _looking(
    plant: ContinuousPlant,
    cost: Cost,
    price: PredictionCost,
    process: SampledProcess,
    trigger: IntegralTrigger,
    statement: str | None,
    notes: list[str],
) -> Policy:
    """Return the policy that checks the error every period.

    The sensor stores in ``margin`` how far the cost since the last send exceeds the allowed value, and counts the
    checks since the last send by a location, up to the number after which the allowed value no longer changes.
    """
    period = process.period
    if period > trigger.h_max * PERIOD_TOLERANCE:
        raise ProblemError(f"period is {period:g} and h_max is {trigger.h_max:g}; expected period ≤ h_max")
    places = _places(trigger, period)
    if places > MOST_PLACES:
        raise ProblemError(
            f"h_min, h_max or the saturation is {places} periods of {period:g} s; expected at most {MOST_PLACES} "
            "periods: use a smaller or an infinite limit, or a longer period"
        )
    prediction = Prediction.of(plant, price.L)
    problem = discretise(plant, cost, period, prediction)
    allowed = trigger.c * np.minimum(period * np.arange(places + 2), trigger.saturation)
    if process.running > allowed[1] * PERIOD_TOLERANCE:
        raise ProblemError(
            f"period is {period:g}, and the noise alone adds a cost of {process.running:.4g} in one period, but only "
            f"{allowed[1]:.4g} is allowed; expected a shorter period, or a larger slope or alpha"
        )
    more = process.running - np.diff(allowed)  # growth of the margin per check in addition to e'Γe
    looks = np.arange(1, len(more))
    gate = np.where((looks + 1) * period > trigger.h_max * PERIOD_TOLERANCE, NEVER, 0.0)
    gate[looks * period * PERIOD_TOLERANCE < trigger.h_min] = -NEVER
    closed, Gamma = problem.plant.A + problem.plant.B, process.Gamma
    location = Location(SINCE, np.stack([np.minimum(looks, len(looks) - 1), 0 * looks], axis=1), "sensor", SEND)
    ahead = Form((ERROR,), Gamma, Scheduled(SINCE, more[1:]), {MARGIN: 1.0})
    afresh = Form(constant=float(more[0]))
    rule = Trigger({"silent": Form((ERROR,), Gamma, Scheduled(SINCE, more[1:] + gate), {MARGIN: 1.0}), SEND: Form()})
    base, bound = price.periodic(period), price.base + trigger.c
    return Policy(
        kind="integral",
        steps=(
            *predicted_steps(closed, rule),
            Evaluate("sensor", MARGIN, (ahead, afresh), SEND),
        ),
        model=problem.plant,
        theory=Theory(
            cost=cost,
            cost_all_time=base,
            noise_cost=problem.noise_cost,
            settling=1 / (1 - problem.slowest(closed)),
            guarantee=None if statement is None else Guarantee(bound, statement, "khashooei2017", bound),
            identity=Identity(base, (Form((ERROR,), Gamma / period), Form()), SEND),
            covers=THEORY,
        ),
        sites=(frozenset({"controller", "actuator"}),),
        locations=(location,),
        initial={"prediction": plant.mean, "forecast": plant.mean, MARGIN: more[:1]},
        tick=problem.tick,
        prediction=prediction,
        notes=tuple(notes),
    )


def _places(trigger: IntegralTrigger, period: float) -> int:
    """Return the number of checks after a send from which the trigger no longer changes."""
    limits = [t for t in (trigger.h_min, trigger.saturation, trigger.h_max) if np.isfinite(t)]
    return max(1, int(np.ceil(max(limits) / period)))


@dataclass(frozen=True, eq=False)
class _Search:
    """The search for a consistent α, with α ≤ L(α)."""

    process: JumpProcess | SampledProcess  # process of the error between sends
    trigger: IntegralTrigger  # the trigger, except for its factor c
    slope: float  # slope C of f
    largest: float  # largest slope with f < g
    period: float | None  # seconds between checks, if given by the user

    def given(self, alpha: float) -> Estimate:
        """Return the given α; raise an error if it exceeds the resulting mean interval between sends L(α)."""
        interval = self.after(alpha, CYCLES).interval
        if alpha > interval.value + SURE * interval.standard_error:
            raise ProblemError(
                f"alpha is {alpha:g}, but the resulting mean interval L(alpha) is {interval}; "
                "expected alpha ≤ L(alpha): use a smaller alpha, or omit alpha for the fixed point alpha = L(alpha)"
            )
        allowed = self.largest * (interval.value + SURE * interval.standard_error)
        if alpha * self.slope > allowed * (1 + PRINTED):
            raise ProblemError(
                f"slope is {self.slope:g}, but with alpha = {alpha:g} the threshold f is below the cost of periodic "
                f"control only up to a slope of {allowed / alpha:.6g}; expected 0 < slope ≤ {allowed / alpha:.6g} with "
                "this alpha"
            )
        return Estimate(alpha, 0.0, "exact")

    def fixed_point(self) -> Estimate:
        """Find the largest α with α = L(α) by simulation; L(α) is the mean interval between sends for a given α."""
        if self.slope > self.largest * (1 + PRINTED):
            raise ProblemError(
                f"slope is {self.slope:g}, but the threshold f is below the cost of periodic control only up to a "
                f"slope of {self.largest:.6g}; expected 0 < slope ≤ {self.largest:.6g}"
            )
        low, high = self._bracket()
        below, above = (self.after(alpha, FIRST_CYCLES).interval.value for alpha in (low, high))
        gain = min(max(0.0, (above - below) / (high - low)), 0.95)  # slope of L(α)

        @cache
        def interval(alpha: float) -> Estimate:
            return self.after(alpha, CYCLES).interval

        def excess(alpha: float) -> float:
            return alpha - interval(alpha).value

        for _ in range(ROUNDS):  # with more cycles, a root near an end of the bracket may leave it
            check_time()
            low, high = (low if excess(low) <= 0 else 0.99 * low), (high if excess(high) > 0 else 1.01 * high)
            if excess(low) <= 0 < excess(high):
                alpha = crossing(excess, low, high, RESOLVED * low)
                return Estimate(alpha, interval(alpha).standard_error / (1 - gain), "simulation")
        raise ProblemError(
            f"no solution of alpha = L(alpha) was found near {low:g}; expected another slope, or a given alpha"
        )

    def _bracket(self) -> tuple[float, float]:
        """Return values of α below and above L(α) that differ by a factor of two."""
        least = 8 * self.process.period if isinstance(self.process, SampledProcess) else 0.0
        low = high = max(self.trigger.h_min, self._first())
        while self.after(high, FIRST_CYCLES).interval.value >= high:
            check_time()
            low, high = high, 2 * high
            if high > LONGEST * self._first():
                raise ProblemError(
                    f"the mean interval L(alpha) is above every alpha up to {high:g}; "
                    "expected a smaller slope, a finite h_max, or a given alpha"
                )
        while self.after(low, FIRST_CYCLES).interval.value < low:
            check_time()
            low, high = low / 2, low
            if low < least:
                shorter = "" if self.period is None else f", or a period below {self.period:g}"
                raise ProblemError(
                    f"slope is {self.slope:g}, but no alpha is below its resulting mean interval L(alpha); "
                    f"expected a slope closer to {self.largest:.6g}, the largest for which the threshold f is below "
                    "the cost of "
                    f"periodic control{shorter}"
                )
        return low, high

    def _first(self) -> float:
        """Return a time in seconds that is at most one interval."""
        return 1 / self.process.jumps.rate if isinstance(self.process, JumpProcess) else 4 * self.process.period

    def after(self, alpha: float, cycles: int) -> CycleEstimate:
        """Estimate, by simulation, the mean interval between sends and the cost for a given α."""
        return estimate_cycles(self.process, replace(self.trigger, c=alpha * self.slope), cycles=cycles)


KIND = Kind(
    name="integral",
    design=integral,
    goal="a cost that never exceeds that of periodic control, for rare disturbances (Poisson jumps)",
    tuning=(TradeoffParameter("slope"),),
    example={"slope": 5.0, "h_max": 2.0, "alpha": 0.5, "period": 0.05},
    built_in="double-integrator",
    nodes="S, C+A",
    plants=("continuous", "jumps"),
    follows=(),
    proved=r"$V\le V_p(r)$ at its mean interval",
    relative_to="periodic control",
    refused=(
        "a slope for which f < g does not hold; α > L(α); a period in which the noise alone costs more than "
        "the allowed cost"
    ),
    data=(
        "the data of `consistent`, and an `Evaluate` memory `margin` of the cost beyond the allowed cost; "
        "the location `since` counts the checks since the last send (h_min, ε, h_max). Without a period an "
        "`EventPolicy`: process and trigger of `renewal/`"
    ),
    order=(
        "operations of `consistent`, then the margin on the decision. Without a period the trigger is "
        "monitored continuously between jumps, and `close` refuses a loop of nodes"
    ),
    check=partial(refuse_what_is_not_predicted, "integral"),
)
