"""Cost and rates of one loop, computed by the method that needs the least work for the requested accuracy.

The methods are a closed form, which needs no time, quadrature of the renewal equations, conditional sampling of the
intervals between sends, and simulation. Each is a ``Candidate`` with a lower bound on its work, which is known before
anything is computed, and with a prediction for the requested error. ``rank`` predicts the cheaper candidates first, and
no candidate whose lower bound exceeds a prediction. If the first one fails or misses the requested error, the next one
follows, and the best answer is returned. Work is counted in operations, not in seconds, so that every machine chooses
the same method and computes the same numbers. A method without a preliminary answer gets only a share of the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache

from taciturn._display import Displayed
from taciturn._progress import OutOfTime, Progress, part_of_time, seconds_left
from taciturn.analyse.renewal import ConditionalSampling, RenewalQuadrature, decides_alone, expect_affordable
from taciturn.errors import ProblemError, UnstableError
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.renewal.chain import NoQuadratureError
from taciturn.simulation.average import Averaging, least_work
from taciturn.simulation.sampling import USUAL_RELATIVE_ERROR, Averages

FINEST, COARSEST = 1e-8, 1e-3  # finest and coarsest relative accuracy requested of a quadrature
ROUNDED = 1e-15  # relative accuracy that double precision can represent
SPEED = 1e9  # operations counted as one second, so that the choice of the method is the same on every machine
CONDITIONAL = "conditional sampling"
SHARE = 0.5  # share of the time limit for a method that has no answer before its end


@dataclass(frozen=True, repr=False)
class Candidate(Displayed):
    """A method that can compute cost and rates, and the number of operations that it is predicted to need."""

    name: str  # name of the method
    least: float  # lower bound on the work, known in advance
    predict: Callable[[float], float]  # function that predicts the remaining work for the requested error
    run: Callable[[Progress | None], Averages]  # function that computes the answer
    gradual: bool  # whether the method has a preliminary answer long before its end


@dataclass(frozen=True, repr=False)
class Request(Displayed):
    """The accuracy that the user requests for cost and rates, and the method and seed."""

    seed: int  # seed of the random draws
    standard_error: float | None  # absolute standard error of the cost; None for 1e-4 of the cost
    steps: int | None  # total number of steps to simulate over all paths, instead of a standard error; or None
    method: str  # ``"auto"``, ``"simulation"``, ``"exact"`` or ``"conditional sampling"``


@dataclass(frozen=True, repr=False)
class Measured(Displayed):
    """Cost and send rates of a loop, and the method that has computed them."""

    averages: Averages  # cost and rates
    method: str  # ``"exact"``, ``"quadrature"``, ``"conditional sampling"`` or ``"simulation"``
    reason: str  # why this method was chosen
    notes: tuple[str, ...] = ()  # warnings and remarks for the reader


def measure_beside(loop: Loop, baseline: Loop | None, request: Request, progress: Progress | None) -> Measured:
    """Compute cost and rates, and simulate a baseline on the same random numbers, if there is one and it is stable."""
    try:
        return measure(loop, request, progress, baseline)
    except UnstableError as error:
        if baseline is None:
            raise
        found = measure(loop, request, progress)  # unless the loop itself diverges
        return replace(found, notes=(*found.notes, f"no cost of every sample: if every sample is sent, {error}"))


def measure(loop: Loop, request: Request, progress: Progress | None, baseline: Loop | None = None) -> Measured:
    """Compute cost and rates: in closed form if there is one, or by the method with the least predicted work.

    A simulation also contains the ``baseline``.
    """
    policy, method = loop.policy, request.method
    if method in ("auto", "exact") and loop.nominal and policy.theory.closed_form is not None:
        form = policy.theory.closed_form
        rates = {link: Estimate(rate, 0.0, "exact") for link, rate in form.rates.items()}
        averages = Averages(Estimate(form.cost, 0.0, "exact"), rates, 0, 0, True)
        return Measured(averages, "exact", "a closed form, which needs no computing time", policy.notes)
    asked, finest = request.standard_error, ROUNDED * abs(policy.theory.cost_all_time or 0.0)
    if asked is not None and asked < finest:
        raise ProblemError(
            f"standard_error is {asked:g}, but double precision resolves a cost of {policy.theory.cost_all_time:g} "
            f"only to {finest:.2g}; expected at least {finest:.2g}"
        )
    candidates, refused = candidates_of(loop, request, progress, baseline)
    if not candidates:
        raise ProblemError(f"method is {method!r}, but {refused}") from None
    if len(candidates) == 1:
        reason = "no other method applies" if method == "auto" and request.steps is None else "requested"
        return _measured(loop, _run(candidates[0], progress, alone=True), candidates[0].name, reason, refused)
    reasons, best = list[str](), None
    while candidates and (best is None or not best.averages.reached):
        ordered, reason = rank(candidates)
        candidate, candidates = ordered[0], ordered[1:]
        reasons.append(reason)
        try:
            found = _run(candidate, progress, alone=not candidates)
        except (NoQuadratureError, OutOfTime) as error:
            if not candidates and best is None:
                raise
            refused = error if isinstance(error, NoQuadratureError) else refused
            reasons.append(f"{candidate.name} {'failed' if error is refused else 'ran out of time'}")
            continue
        if best is None or found.reached or _off(found) < _off(best.averages):
            best = _measured(loop, found, candidate.name, "; ".join(reasons), refused)
        reasons.append(f"{candidate.name} missed the requested error")
    assert best is not None  # the last candidate answers or raises
    return best


def _measured(loop: Loop, found: Averages, method: str, reason: str, refused: NoQuadratureError | None) -> Measured:
    """Return the result with its notes: of the policy, why a simulation was needed, and reasons to doubt the result."""
    told = refused is not None and method == "simulation" and decides_alone(loop.policy)
    why = (f"simulated, because {refused.reason}",) if told and refused is not None else ()
    return Measured(found, method, reason, loop.policy.notes + why + found.notes)


def rank(candidates: list[Candidate]) -> tuple[list[Candidate], str]:
    """Sort methods by their predicted work, least first, and write the predictions as a sentence.

    A candidate whose least work exceeds the work of another candidate is not predicted more closely. A method that has
    begun counts only its remaining work. A candidate comes last if it has no preliminary answer and is predicted to
    need more than its share of the time limit, or if its prediction runs out of time.
    """
    work, known, left = dict[str, float](), dict[str, str](), seconds_left()
    for candidate in sorted(candidates, key=lambda one: one.least):
        others = min(work.values(), default=float("inf"))
        seen = others > candidate.least
        try:
            work[candidate.name] = candidate.predict(others) if seen else candidate.least
            known[candidate.name] = f"{'' if seen else 'at least '}{_seconds(work[candidate.name])}"
        except OutOfTime:
            work[candidate.name], known[candidate.name] = float("inf"), "not predicted in time"

    def late(candidate: Candidate) -> bool:
        return not candidate.gradual and left < math.inf and work[candidate.name] > SHARE * SPEED * left

    ordered = sorted(candidates, key=lambda one: (late(one), work[one.name]))
    first, others = ordered[0], ordered[1:]
    parts = [f"{first.name} {known[first.name]}{' estimated' * (work[first.name] < float('inf'))}"]
    parts += [f"{one.name} {known[one.name]}{', too much for the time limit' * late(one)}" for one in others]
    return ordered, f"{', '.join(parts)}"


def candidates_of(
    loop: Loop, request: Request, progress: Progress | None, baseline: Loop | None = None
) -> tuple[list[Candidate], NoQuadratureError | None]:
    """List those of the requested methods that apply to a loop, and the reason if quadrature does not."""
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
        found.append(_simulation(loop, request, progress, baseline))
    return found, refused


def _quadrature(loop: Loop, request: Request) -> Candidate:
    identity, link = loop.policy.theory.identity, loop.policy.scheduled
    if request.method != "exact":
        expect_affordable(loop)
    quadrature = RenewalQuadrature(loop)
    assert identity is not None

    error = request.standard_error
    accuracy = quadrature.usual if error is None else clipped_accuracy(quadrature.accuracy(error))

    def run(progress: Progress | None) -> Averages:
        renewal = quadrature.solve(accuracy, progress)
        if error is not None and renewal.excess_error > error and loop.problem.jumps is None:
            with suppress(OutOfTime):
                renewal = quadrature.solve(clipped_accuracy(error / renewal.excess), progress)
        rounding = ROUNDED * (renewal.excess + abs(identity.constant))
        cost = Estimate(renewal.excess, 0.0, "quadrature", renewal.excess_error + rounding)
        cost = cost.scaled(1.0, identity.constant)
        rate = Estimate(renewal.rate, 0.0, "quadrature", renewal.rate_error + ROUNDED * renewal.rate)
        reached = cost.error <= wanted_error(cost, request.standard_error)
        return Averages(cost, {link[0]: rate}, 0, 0, reached)

    return Candidate("quadrature", quadrature.least, lambda _: quadrature.predict(accuracy), run, False)


def _conditional(loop: Loop, request: Request, progress: Progress | None) -> Candidate:
    sampling = ConditionalSampling(loop, request.seed, progress)
    identity, link = loop.policy.theory.identity, loop.policy.scheduled
    assert identity is not None

    asked = _asked(loop, request.standard_error)

    def run(_: Progress | None) -> Averages:
        found = sampling.run(asked)
        cost = found.excess.scaled(1.0, identity.constant)
        reached = cost.standard_error <= wanted_error(cost, request.standard_error)
        rates = {link[0]: found.rate}
        return Averages(cost, rates, found.steps, 0, reached, estimator="conditional sampling")

    return Candidate(CONDITIONAL, sampling.least, lambda others: sampling.predict(asked, others), run, True)


def _simulation(loop: Loop, request: Request, progress: Progress | None, baseline: Loop | None) -> Candidate:
    @cache
    def averaging() -> Averaging:
        return Averaging(
            loop,
            seed=request.seed,
            standard_error=request.standard_error,
            steps=request.steps,
            progress=progress,
            baseline=baseline,
        )

    def predict(_: float) -> float:
        return averaging().predict(_asked(loop, request.standard_error))

    def run(_: Progress | None) -> Averages:
        return _clocked(loop, averaging().finish())

    return Candidate("simulation", least_work(loop), predict, run, True)


def _run(candidate: Candidate, progress: Progress | None, alone: bool) -> Averages:
    """Run a candidate; a method without a preliminary answer is stopped early enough to leave time for the others."""
    with part_of_time(1.0 if candidate.gradual or alone else SHARE):
        return candidate.run(progress)


def _asked(loop: Loop, standard_error: float | None) -> float:
    """Return the requested error before the cost is known; it is at most ``wanted_error`` for the cost."""
    identity = loop.policy.theory.identity
    constant = (loop.policy.theory.cost_all_time or 0.0) if identity is None else identity.constant
    return wanted_error(Estimate(constant, 0.0, "exact"), standard_error)


def wanted_error(cost: Estimate, standard_error: float | None) -> float:
    """Return the standard error that is requested for a cost: the user's, or a default fraction of the cost."""
    return USUAL_RELATIVE_ERROR * abs(cost.value) if standard_error is None else standard_error


def _off(found: Averages) -> float:
    return found.cost.standard_error + found.cost.error


def clipped_accuracy(accuracy: float) -> float:
    """Limit a requested accuracy to the range that quadratures can achieve."""
    return min(max(accuracy, FINEST), COARSEST)


def _seconds(work: float) -> str:
    return "too many nodes" if work == float("inf") else f"{work / SPEED:.2g} s"


def _clocked(loop: Loop, found: Averages) -> Averages:
    """Return simulated averages in which known rates replace the estimates."""
    policy = loop.policy
    known: dict[str, float] = {**policy.theory.fixed_rates}
    if loop.nominal and policy.theory.closed_form is not None:
        known |= policy.theory.closed_form.rates
    return replace(found, rates={**found.rates, **{link: Estimate(rate, 0.0, "exact") for link, rate in known.items()}})
