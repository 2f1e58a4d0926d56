"""Cost and rates of one loop by the method that is predicted to reach the asked error with the least work."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache

from taciturn._progress import OutOfTime, Progress, limited
from taciturn.analyse.limits import solve_optimum
from taciturn.analyse.renewal import (
    ConditionalSampling,
    RenewalQuadrature,
    decides_alone,
    expect_affordable,
)
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.renewal.chain import NoQuadratureError
from taciturn.simulation.average import Averaging, least_work
from taciturn.simulation.sampling import RELATIVE_ERROR, Averages

FINEST, COARSEST = 1e-8, 1e-3  # relative accuracies that a quadrature is asked for
ROUNDED = 1e-15  # relative: no double is known better
SPEED = 1e9  # operations that count as a second: a choice by work is the same on every machine
CONDITIONAL = "conditional sampling"
SHARE = 0.5  # of the time limit for a method that answers at its end or not at all


@dataclass(frozen=True)
class Candidate:
    """A method that gives cost and rates, and what it would take; work is counted in operations.

    Args:
        name: of the method.
        least: work that it takes at least, known without trying.
        predict: the work that is left for the error that is asked for. What a simulation runs for this prediction, it
            continues from. Given the least work of other methods, beyond which any lower bound will do.
        run: gives the answer.
        gradual: whether it has an answer long before its end.
    """

    name: str
    least: float
    predict: Callable[[float], float]
    run: Callable[[Progress | None], Averages]
    gradual: bool


@dataclass(frozen=True)
class Request:
    """What is asked of a measurement, and what it may spend.

    Args:
        seed: of the draws.
        standard_error: absolute, of the cost; None for 1e-4 of it.
        steps: of all paths together, instead; or None.
        method: ``"auto"``, ``"simulation"``, ``"exact"`` or ``"conditional sampling"``.
        time_limit: seconds, or None.
    """

    seed: int
    standard_error: float | None
    steps: int | None
    method: str
    time_limit: float | None = None


@dataclass(frozen=True)
class Measured:
    """What a method found.

    Args:
        averages: cost and rates.
        method: ``"exact"``, ``"quadrature"``, ``"conditional sampling"`` or ``"simulation"``.
        reason: why that one, in a sentence.
        notes: what the reader must know.
    """

    averages: Averages
    method: str
    reason: str
    notes: tuple[str, ...] = ()


def measure(loop: Loop, request: Request, progress: Progress | None) -> Measured:
    """Return cost and rates: in closed form, else by the candidate that is predicted to take the least work.

    Raises:
        ProblemError: the method that is asked for does not apply.
        OutOfTime: the time limit passed before there was any answer.
    """
    policy, method = loop.policy, request.method
    if method in ("auto", "exact") and loop.nominal and policy.closed_form is not None:
        form = policy.closed_form
        rates = {link: Estimate(rate, 0.0, "exact") for link, rate in form.rates.items()}
        averages = Averages(Estimate(form.cost, 0.0, "exact"), rates, 0, 0, True)
        return Measured(averages, "exact", "a closed form, which takes no time", policy.notes)
    asked, finest = request.standard_error, ROUNDED * abs(policy.cost_all_time)
    if asked is not None and asked < finest:
        raise ProblemError(
            f"standard_error is {asked:g}, and double precision holds a cost of {policy.cost_all_time:g} "
            f"to {finest:.2g}; expected no less"
        )
    candidates, refused = candidates_of(loop, request, progress)
    if not candidates:
        raise ProblemError(f"method is {method!r}, and {refused}") from None
    if len(candidates) == 1:
        reason = "no other method applies" if method == "auto" and request.steps is None else "asked for"
        return _measured(loop, _run(candidates[0], request, progress, alone=True), candidates[0].name, reason, refused)
    reasons, best = list[str](), None
    while candidates and (best is None or not best.averages.reached):
        ordered, reason = rank(candidates, request.time_limit)
        candidate, candidates = ordered[0], ordered[1:]
        reasons.append(reason)
        try:
            found = _run(candidate, request, progress, alone=not candidates)
        except (NoQuadratureError, OutOfTime) as error:
            if not candidates and best is None:
                raise
            refused = error if isinstance(error, NoQuadratureError) else refused
            reasons.append(f"{candidate.name} {'failed' if error is refused else 'ran out of time'}")
            continue
        if best is None or found.reached or _off(found) < _off(best.averages):
            best = _measured(loop, found, candidate.name, "; ".join(reasons), refused)
        reasons.append(f"{candidate.name} missed the asked error")
    assert best is not None  # the last candidate answers or raises
    return best


def _measured(loop: Loop, found: Averages, method: str, reason: str, refused: NoQuadratureError | None) -> Measured:
    """Return what was found with its notes: those of the policy, why it was simulated, and what makes it doubtful."""
    told = refused is not None and method == "simulation" and decides_alone(loop.policy)
    why = (f"simulated, because {refused.reason}",) if told and refused is not None else ()
    return Measured(found, method, reason, loop.policy.notes + why + found.notes)


def rank(candidates: list[Candidate], time_limit: float | None) -> tuple[list[Candidate], str]:
    """Return candidates by the work they take, the least first, and a sentence that says so.

    One whose least work is more than another takes is not looked at more closely. Of one that has begun, only the work
    that is left counts. One that is all or nothing and is predicted to need more than its share of the time limit comes
    last, and so does one whose prediction runs out of time.

    Args:
        candidates: at least one.
        time_limit: seconds, or None.
    """
    work, known = dict[str, float](), dict[str, str]()
    for candidate in sorted(candidates, key=lambda one: one.least):
        others = min(work.values(), default=float("inf"))
        seen = others > candidate.least
        try:
            work[candidate.name] = candidate.predict(others) if seen else candidate.least
            known[candidate.name] = f"{'' if seen else 'at least '}{_seconds(work[candidate.name])}"
        except OutOfTime:
            work[candidate.name], known[candidate.name] = float("inf"), "not predicted in time"

    def late(candidate: Candidate) -> bool:
        return time_limit is not None and not candidate.gradual and work[candidate.name] > SHARE * SPEED * time_limit

    ordered = sorted(candidates, key=lambda one: (late(one), work[one.name]))
    first, others = ordered[0], ordered[1:]
    parts = [f"{first.name} {known[first.name]}{' estimated' * (work[first.name] < float('inf'))}"]
    parts += [f"{one.name} {known[one.name]}{', too much for the time limit' * late(one)}" for one in others]
    return ordered, f"{', '.join(parts)}"


def measure_optimum(loop: Loop, price: float, request: Request, progress: Progress | None) -> Measured:
    """Return cost and rate of the best schedule at a price per send."""
    if request.method not in ("auto", "exact") or request.steps is not None:
        raise ProblemError("optimal is solved and never simulated; expected near-optimal, or neither method nor steps")
    policy = loop.policy
    asked = _wanted(Estimate(policy.cost_all_time, 0.0, "exact"), request.standard_error)
    ceiling = price / policy.tick  # sending always: no best schedule has more excess
    best = solve_optimum(loop, price, _clipped(asked / ceiling), progress)
    if best.excess_error > asked:
        best = solve_optimum(loop, price, _clipped(asked / max(best.excess, 1e-300)), progress)
    cost = Estimate(best.excess, 0.0, "quadrature", best.excess_error).scaled(1.0, policy.cost_all_time)
    rate = Estimate(best.rate, 0.0, "quadrature", best.rate_error)
    found = Averages(cost, {policy.scheduled[0]: rate}, 0, 0, cost.error <= _wanted(cost, request.standard_error))
    return Measured(found, "quadrature", "the best schedule is solved, and never simulated")


def candidates_of(
    loop: Loop, request: Request, progress: Progress | None
) -> tuple[list[Candidate], NoQuadratureError | None]:
    """Return the methods that apply to a loop and are asked for, and why others do not."""
    found, refused = list[Candidate](), None
    if request.method == "exact" or (request.method == "auto" and request.steps is None):
        try:
            found.append(_quadrature(loop, request))
        except NoQuadratureError as error:
            refused = error
    if request.method == CONDITIONAL or (request.method == "auto" and request.steps is None):
        try:
            found.append(_conditional(loop, request, progress))
        except NoQuadratureError as error:
            refused = refused or error
    if request.method in ("auto", "simulation"):
        found.append(_simulation(loop, request, progress))
    return found, refused


def _quadrature(loop: Loop, request: Request) -> Candidate:
    identity, link = loop.policy.identity, loop.policy.scheduled
    if request.method != "exact":
        expect_affordable(loop)
    quadrature = RenewalQuadrature(loop)
    assert identity is not None

    error = request.standard_error
    accuracy = quadrature.usual if error is None else _clipped(quadrature.accuracy(error))

    def run(progress: Progress | None) -> Averages:
        renewal = quadrature.solve(accuracy, progress)
        if error is not None and renewal.excess_error > error and loop.problem.jumps is None:
            with suppress(OutOfTime):
                renewal = quadrature.solve(_clipped(error / renewal.excess), progress)
        rounding = ROUNDED * (renewal.excess + abs(identity.constant))
        cost = Estimate(renewal.excess, 0.0, "quadrature", renewal.excess_error + rounding)
        cost = cost.scaled(1.0, identity.constant)
        rate = Estimate(renewal.rate, 0.0, "quadrature", renewal.rate_error + ROUNDED * renewal.rate)
        reached = cost.error <= _wanted(cost, request.standard_error)
        return Averages(cost, {link[0]: rate}, 0, 0, reached)

    return Candidate("quadrature", quadrature.least, lambda _: quadrature.predict(accuracy), run, False)


def _conditional(loop: Loop, request: Request, progress: Progress | None) -> Candidate:
    sampling = ConditionalSampling(loop, request.seed, progress)
    identity, link = loop.policy.identity, loop.policy.scheduled
    assert identity is not None

    asked = _asked(loop, request.standard_error)

    def run(_: Progress | None) -> Averages:
        found = sampling.run(asked)
        cost = found.excess.scaled(1.0, identity.constant)
        reached = cost.standard_error <= _wanted(cost, request.standard_error)
        rates = {link[0]: found.rate}
        return Averages(cost, rates, found.steps, 0, reached, estimator="conditional sampling")

    return Candidate(CONDITIONAL, sampling.least, lambda others: sampling.predict(asked, others), run, True)


def _simulation(loop: Loop, request: Request, progress: Progress | None) -> Candidate:
    @cache
    def averaging() -> Averaging:
        return Averaging(
            loop, seed=request.seed, standard_error=request.standard_error, steps=request.steps, progress=progress
        )

    def predict(_: float) -> float:
        return averaging().predict(_asked(loop, request.standard_error))

    def run(_: Progress | None) -> Averages:
        return _clocked(loop, averaging().finish())

    return Candidate("simulation", least_work(loop), predict, run, True)


def _run(candidate: Candidate, request: Request, progress: Progress | None, alone: bool) -> Averages:
    """Return what a candidate finds; one that is all or nothing leaves time for the others."""
    if request.time_limit is not None and not candidate.gradual and not alone:
        progress = limited(progress, SHARE * request.time_limit)
    return candidate.run(progress)


def _asked(loop: Loop, standard_error: float | None) -> float:
    """Return the error that is asked for, before the cost is known: at most what ``_wanted`` says of the cost."""
    identity = loop.policy.identity
    constant = loop.policy.cost_all_time if identity is None else identity.constant
    return _wanted(Estimate(constant, 0.0, "exact"), standard_error)


def _wanted(cost: Estimate, standard_error: float | None) -> float:
    """Return the error that is asked for."""
    return RELATIVE_ERROR * abs(cost.value) if standard_error is None else standard_error


def _off(found: Averages) -> float:
    return found.cost.standard_error + found.cost.error


def _clipped(accuracy: float) -> float:
    return min(max(accuracy, FINEST), COARSEST)


def _seconds(work: float) -> str:
    return "too many nodes" if work == float("inf") else f"{work / SPEED:.2g} s"


def _clocked(loop: Loop, found: Averages) -> Averages:
    """Return simulated averages with the rates that need no estimate."""
    policy = loop.policy
    known: dict[str, float] = {**policy.fixed_rates}
    if loop.nominal and policy.closed_form is not None:
        known |= policy.closed_form.rates
    return replace(found, rates={**found.rates, **{link: Estimate(rate, 0.0, "exact") for link, rate in known.items()}})
