"""One problem, one answer: cost, rates, bound."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

from taciturn._arrays import number
from taciturn._progress import OutOfTime, Progress, Stages, limited
from taciturn.analyse.limits import LowerBound, resets
from taciturn.analyse.renewal import bound_rate
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
from taciturn.model.policy import Policy
from taciturn.model.schedule import Schedule
from taciturn.problem import Problem, expect_problem
from taciturn.program.ops import Precision
from taciturn.renewal.policy import EventPolicy, OptimalPolicy
from taciturn.simulation.average import check_effort
from taciturn.simulation.events import average_events
from taciturn.study.clock import ClockMix
from taciturn.study.fair import clock_of
from taciturn.study.lines import evaluation_lines, text_of
from taciturn.study.lower import bounded, contradicted, expect_bound
from taciturn.study.measure import CONDITIONAL, Request, measure, measure_optimum
from taciturn.study.units import TimeUnit, Unit, base_rate, cost_unit, rate_unit

Consistency = Literal["guaranteed", "verified", "not verified"]
Asked = Literal["auto", "simulation", "exact", "conditional sampling"]
METHODS: tuple[Asked, ...] = get_args(Asked)
SURE = 4.0  # standard errors


@dataclass(frozen=True)
class Linearisation:
    """What the theory says of the linearisation of a plant; of the plant itself nothing of it is claimed.

    Args:
        cost_all_time: of the linear plant, at every tick sent.
        cost_bound: proved of the linear plant, or None.
    """

    cost_all_time: float
    cost_bound: float | None


@dataclass(frozen=True)
class Evaluation:
    """What a policy costs, how often it sends, and what is proved of it.

    Args:
        policy: its kind.
        unit: what the cost counts per: ``"step"`` or ``"second"``, or ``"mission"`` for a finite horizon or a discount.
        base_rate: rate of sending at every tick; None where sends may come at any time.
        cost: per step or per second, or the total of a finite horizon.
        cost_all_time: exact cost of sending at every tick; None where the simulated plant is not the design's.
        statement: the theorem behind the bounds, or None.
        cost_bound: proved bound, or None.
        cost_bound_at_rate: the sharper bound at the measured rate, or None.
        rates: sends per step or per second, by scheduled link; of a mission the mean fraction of its steps,
            those of a discounted sum weighed as their costs.
        seed: of the draws.
        seconds: wall time.
        steps: simulated steps; 0 where nothing was simulated.
        reached: whether the asked standard error was met.
        schedule: of sensor queries, computed offline, or None.
        clock: the fair clock at the rate found, time-triggered control with the measurements and the actuation of the
            policy; None where there is none, or none that is stable.
        mean_interval: seconds from one send to the next, of policies that send on the error of a prediction.
        lower_bound: of any scheduling of this controller at the rate found, where it was asked for.
        rate_bounds: certified bounds of the rate, where a lower bound was asked for and the error that a send resets
            decides alone; or None.
        consistency: whether the policy costs no more than the fair clock: ``"guaranteed"`` by its theorem,
            ``"verified"`` by these numbers and their errors (4 standard errors), or ``"not verified"``; None where it
            is not asked for.
        notes: what the reader must know.
        linearisation: where the plant of the design is not linear, what its linearisation would cost; else None.
        estimator: of a simulation, what was averaged (as ``Averages``).
        settled: whether a simulated loop had time to forget its start.
        method: that gave cost and rates: ``"exact"``, ``"quadrature"``, ``"conditional sampling"`` or
            ``"simulation"``.
        reason: why that one.
    """

    policy: str
    unit: Unit
    base_rate: float | None
    cost: Estimate
    cost_all_time: float | None
    statement: str | None
    cost_bound: float | None
    cost_bound_at_rate: float | None
    rates: Mapping[str, Estimate]
    seed: int
    seconds: float
    steps: int
    reached: bool
    schedule: Schedule | None
    clock: ClockMix | None
    mean_interval: Estimate | None
    lower_bound: LowerBound | None
    rate_bounds: tuple[float, float] | None
    consistency: Consistency | None
    notes: tuple[str, ...]
    linearisation: Linearisation | None = None
    estimator: str = ""
    settled: bool = True
    method: str = "simulation"
    reason: str = "no other method applies"

    @property
    def rate_unit(self) -> TimeUnit:
        """What a rate counts per."""
        return rate_unit(self.unit)

    @property
    def drawn(self) -> bool:
        """Whether a seed decides any number of it."""
        return self.method in ("simulation", CONDITIONAL) or self.lower_bound is not None

    @property
    def cost_periodic_same_rate(self) -> float | None:
        """Exact cost of the fair clock at the rate found; None where there is none."""
        return None if self.clock is None else self.clock.cost

    def __str__(self) -> str:
        """Return what ``taciturn evaluate`` prints."""
        return text_of(evaluation_lines(self))

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn evaluate --json``."""
        result: dict[str, Any] = {
            "policy": self.policy,
            "unit": self.unit,
            "base_rate": self.base_rate,
            "cost": _estimate(self.cost),
            "cost_all_time": self.cost_all_time,
            "cost_bound": self.cost_bound,
            "cost_bound_at_rate": self.cost_bound_at_rate,
            "rates": {link: rate.document("value", "standard_error") for link, rate in self.rates.items()},
            "seed": self.seed,
            "seconds": round(self.seconds, 4),
            "steps": self.steps,
            "reached": self.reached,
            "method": self.method,
            "method_reason": self.reason,
        }
        if self.lower_bound is not None:
            result["cost_lower_bound"] = self.lower_bound.cost
            result["cost_lower_bound_confidence"] = self.lower_bound.confidence
        if self.rate_bounds is not None:
            result["rate_bounds"] = list(self.rate_bounds)
        if self.consistency is not None:
            result["consistency"] = self.consistency
        result["cost_periodic_same_rate"] = self.cost_periodic_same_rate
        result["clock"] = None if self.clock is None else self.clock.document()
        if self.mean_interval is not None:
            result["mean_interval"] = _estimate(self.mean_interval)
        if self.linearisation is not None:
            result["linearisation"] = {
                "cost_all_time": self.linearisation.cost_all_time,
                "cost_bound": self.linearisation.cost_bound,
            }
        if self.schedule is not None:
            result["schedule"] = self.schedule.document()
        return result | ({"notes": list(self.notes)} if self.notes else {})


def evaluate(
    problem: Problem,
    *,
    seed: int = 0,
    standard_error: float | None = None,
    steps: int | None = None,
    method: Asked = "auto",
    precision: Precision = "float64",
    confidence: float | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Return cost, rates and bound of a problem's policy.

    A closed form is taken where the policy ignores the state. Else the work of every method that applies is predicted
    for the asked error, in counted operations, and the least is taken: quadrature of renewal equations or conditional
    sampling where every send resets the error that decides, and simulation, which always applies: completed squares,
    or the plain average with the simulated plant. So the choice is the same on every machine.

    Args:
        problem: from ``load`` or ``Problem``.
        seed: of the draws, at least 0. Two evaluations with one seed have common draws, and correlated errors.
        standard_error: absolute, of the cost; omitted: 1e-4 of the cost.
        steps: run this many steps of all paths together instead; what has no closed form is then simulated. A note
            says where this, or a precision, had no effect.
        method: ``"exact"`` takes a closed form or a quadrature and never simulates, ``"conditional sampling"`` and
            ``"simulation"`` take nothing else.
        precision: of what is simulated: ``"float64"``, or ``"float32"``, 1.8 times as fast.
        confidence: with which a lower bound is to hold of the cost of any scheduling at this rate (``bound_below``);
            omitted: neither that nor ``rate_bounds`` is sought, as they take seconds.
        time_limit: seconds, omitted: none. When they have passed, the best answer so far is returned, with its honest
            error and ``reached`` False; a lower bound that is not yet found is left out, and a note says so.
        progress: called with the fraction done.

    Returns:
        The evaluation, with rates per second of a continuous plant; ``reached`` is False where the budget ended before
        the asked standard error.

    Raises:
        ProblemError: data that do not fit, a confidence outside (0, 1), no exact method, a lower bound is asked for
            and there is none, or the time limit passed before anything was found.
        UnstableError: the loop diverges.

    Example:
        >>> from taciturn import load
        >>> evaluate(load("two-mass"), steps=100_000).policy
        'lqg'
    """
    expect_problem("problem", problem)
    check_effort(seed, standard_error, steps)
    if method not in METHODS:
        raise ProblemError(f"method is {method!r}; expected {', '.join(map(repr, METHODS[:-1]))} or {METHODS[-1]!r}")
    if method == CONDITIONAL and steps is not None:
        raise ProblemError(f"method is {method!r}, and steps is {steps}; expected 'auto', 'simulation', or no steps")
    if confidence is not None:
        number("confidence", confidence, 0.0, 1.0)
    began = time.perf_counter()
    told = Stages(limited(progress, time_limit))
    try:
        return replace(
            _evaluated(problem, Request(seed, standard_error, steps, method, time_limit), precision, confidence, told),
            seconds=time.perf_counter() - began,
        )
    except OutOfTime:
        raise ProblemError(
            f"time_limit is {time_limit:g}, and nothing was found within so many seconds; expected a longer one"
        ) from None


def _evaluated(
    problem: Problem, request: Request, precision: Precision, confidence: float | None, told: Stages
) -> Evaluation:
    """Return the evaluation; whoever asked knows the time it took.

    Raises:
        OutOfTime: before there was any answer.
    """
    policy = problem.designed()
    if isinstance(policy, EventPolicy):
        if confidence is not None:
            expect_bound(problem)
        if precision != "float64":
            raise ProblemError(f"precision is {precision!r}, and {policy.kind} without a period runs in 'float64' only")
        return _events(problem, policy, request, told)
    first = told if confidence is None else told.stage(0.0, 0.5)
    if isinstance(policy, OptimalPolicy):
        loop = problem.close(policy.looked_at)
        measured, certified = measure_optimum(loop, policy.price, request, first), None
    else:
        loop = replace(problem.close(policy), precision=precision)
        measured = measure(loop, request, first)
        certified = None if confidence is None else bound_rate(loop)
    asked = {"steps": request.steps, "precision": None if precision == "float64" else precision}
    found, notes = measured.averages, measured.notes + without_effect(asked, measured.method)
    policy, lower = loop.policy, None
    if confidence is not None:
        resets(loop)
        try:
            lower = bounded(loop, found.rates[policy.scheduled[0]], confidence, request.seed, told.stage(0.5, 1.0))
        except ProblemError as error:
            notes += (f"no lower bound: {error}",)
        except OutOfTime:
            notes += (f"no lower bound: the time limit of {request.time_limit:g} s passed; expected a longer one",)
        notes += contradicted(found.rates[policy.scheduled[0]], certified)
    guarantee = policy.guarantee if loop.nominal else None
    per_tick = found.rates[policy.scheduled[0]].value
    pace = base_rate(loop)
    clock = clock_of(problem, policy)
    fair = None if clock is None else clock.at(per_tick / policy.tick)
    compared = loop.nominal and per_tick > 0 and _predicts(policy)
    return Evaluation(
        policy=policy.kind,
        unit=cost_unit(problem),
        base_rate=pace,
        cost=found.cost,
        cost_all_time=policy.cost_all_time if loop.nominal else None,
        statement=None if guarantee is None else guarantee.statement,
        cost_bound=None if guarantee is None else guarantee.cost,
        cost_bound_at_rate=None if guarantee is None else guarantee.at_rate(per_tick),
        rates={link: rate.scaled(pace) for link, rate in found.rates.items()},
        seed=request.seed,
        seconds=0.0,
        steps=found.steps,
        reached=found.reached,
        schedule=policy.schedule,
        clock=fair,
        mean_interval=_interval(found.rates[policy.scheduled[0]], policy.tick) if _predicts(policy) else None,
        lower_bound=lower,
        rate_bounds=None if certified is None else (pace * certified[0], pace * certified[1]),
        consistency=_consistency(found.cost, fair, guarantee is not None) if compared else None,
        notes=notes + tuple(f"{text}: no guarantee holds" for text in loop.departures),
        linearisation=_linearisation(policy) if problem.nonlinear and problem.actual is None else None,
        estimator=found.estimator,
        settled=found.settled,
        method=measured.method,
        reason=measured.reason,
    )


def _events(problem: Problem, policy: EventPolicy, request: Request, progress: Progress) -> Evaluation:
    """Return the evaluation of a policy without ticks."""
    if request.method not in ("auto", "simulation"):
        raise ProblemError(f"method is {request.method!r}; expected 'auto' or 'simulation', all that {policy.kind} has")
    found = average_events(
        policy, seed=request.seed, standard_error=request.standard_error, steps=request.steps, progress=progress
    )
    rate = found.rates["sensor"]
    interval = _interval(rate, 1.0)
    assert interval is not None
    clock = clock_of(problem, policy)
    fair = None if clock is None else clock.at(rate.value)
    return Evaluation(
        policy=policy.kind,
        unit="second",
        base_rate=None,
        cost=found.cost,
        cost_all_time=policy.cost_all_time,
        statement=policy.statement,
        cost_bound=policy.bound(),
        cost_bound_at_rate=policy.bound(interval.value),
        rates=found.rates,
        seed=request.seed,
        seconds=0.0,
        steps=found.steps,
        reached=found.reached,
        schedule=None,
        clock=fair,
        mean_interval=interval,
        lower_bound=None,
        rate_bounds=None,
        consistency=_consistency(found.cost, fair, policy.statement is not None),
        notes=policy.notes,
    )


def without_effect(asked: Mapping[str, object], method: str) -> tuple[str, ...]:
    """Return a note on options of a simulation that were given, where another method gave the answer."""
    given = [f"{name} = {value}" for name, value in asked.items() if value is not None]
    if not given or method == "simulation":
        return ()
    return (f"{' and '.join(given)} had no effect: no loop was simulated",)


def _linearisation(policy: Policy) -> Linearisation:
    return Linearisation(policy.cost_all_time, None if policy.guarantee is None else policy.guarantee.cost)


def _predicts(policy: Policy) -> bool:
    """Whether both ends predict in continuous time, and events decide when the prediction is corrected."""
    return policy.prediction is not None and policy.closed_form is None


def _consistency(cost: Estimate, clock: ClockMix | None, proved: bool) -> Consistency:
    """Return whether a cost is at most that of a clock at its rate; an unstable one's is infinite."""
    if proved:
        return "guaranteed"
    margin = SURE * cost.standard_error + cost.error
    return "verified" if clock is None or cost.value + margin <= clock.cost else "not verified"


def _interval(rate: Estimate, tick: float) -> Estimate | None:
    """Return the mean seconds between sends, or None where nothing is sent."""
    return rate.inverse(tick) if rate.value > 0 else None


def _estimate(estimate: Estimate) -> dict[str, Any]:
    return estimate.document() | (estimate.document("error") if estimate.method == "quadrature" else {})
