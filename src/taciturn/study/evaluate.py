"""Evaluation of one problem: the cost, the send rates and the cost bounds of its policy.

``measure`` computes cost and rates: in closed form, by a quadrature of renewal equations, by conditional sampling or by
simulation, whichever is predicted to need the least work. At the measured rate r, the cost is then compared with

* fair periodic control at this rate (``periodic``),
* the same loop that sends every sample (``baseline``), and better ones where silence costs less than sending,
* the guarantee, a proven upper bound, for all rates and at this one (``model.theory``),
* if a confidence level is given, a lower bound on the cost of every schedule of this controller (the plugin
  ``schedules``). It is evaluated at the upper confidence limit of r, since the bound falls with the rate, and the rate
  itself is certified to lie between two bounds, as far as its events depend only on the error that a send resets.

Further loops are simulated where they apply: with a constant disturbance, without the limits of the inputs, and on the
plant as written. The last one exists if a given controller integrates and its file states no disturbance. Then each
input of the plant gets a slow disturbance with usual values, since silence costs more under a load than without one,
and cost, rates and guarantee are those of the plant with this disturbance, which the user has not written. If limits
of the states are given, the probabilities of their violation are simulated too.

A time limit is shared between these parts. Cost and rates come first; a part for which the rest is too short is left
out, and a note says so. Values that were given but have no effect on the result are named in a note as well.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from math import sqrt
from typing import Literal, cast, get_args

from taciturn._arrays import number
from taciturn._plugins import load_plugin
from taciturn._progress import OutOfTime, Progress, Stages, answered_within, in_notebook, late_text, part_of_time
from taciturn._text import magnitude
from taciturn.analyse.renewal import bound_rate, resets
from taciturn.design.at_fixed_steps import send_at_fixed_steps
from taciturn.design.silence import WATCH
from taciturn.errors import ProblemError, TaciturnError
from taciturn.loop import Loop
from taciturn.model.controller import PID, AnyController, ContinuousController, Controller, PIDLoops
from taciturn.model.disturbance import Disturbance
from taciturn.model.estimate import Estimate
from taciturn.model.limits import Limits
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.silence import certificate_of
from taciturn.model.theory import LEVEL, Guarantee, Linearisation, LowerBound
from taciturn.problem import Problem
from taciturn.problem.without_file import BareKind, Studied, as_problem
from taciturn.program.ops import Precision
from taciturn.renewal.without_steps import PolicyWithoutSteps, nodes_of
from taciturn.simulation.average import base_rate, check_effort
from taciturn.simulation.late_packets import LatePackets, late_packets
from taciturn.simulation.sampling import Averages
from taciturn.study.baseline import baseline_of, better_baselines, costs_less, excess_over
from taciturn.study.evaluation import Consistency, Evaluation, TimeUnit, cost_unit, rate_unit
from taciturn.study.further_loops import (
    AsWritten,
    averages_after_step,
    averages_on,
    compare_without_limits,
    precisely,
)
from taciturn.study.measure import CONDITIONAL, Request, measure_beside
from taciturn.study.periodic import ClockMix, periodic_at
from taciturn.study.sentences import WITHDRAWN
from taciturn.study.set_point_steps import rates_around_steps

Asked = Literal["auto", "simulation", "exact", "conditional sampling"]
METHODS: tuple[Asked, ...] = get_args(Asked)
CONTRADICTION = 3.0  # standard errors by which a rate that is outside its certified bounds deserves a note
SAME = 1e-9  # relative difference of two rates that is a rounding error
SURE = 4.0  # standard errors by which a cost is verified to be at most that of periodic control
AFTER_STEP = 0.3  # share of the progress for the averages after a step
MEASURED = 0.8  # share of the time for the cost, of that which no other part of the answer needs
COMPARED = 0.4  # share of the time that is left for periodic control, if other parts follow
LIMITED = 0.3  # share of the time for the loop without limits of its inputs
VIOLATIONS = 0.5  # share of the progress for the violations of limits


def evaluate(
    problem: Studied,
    *,
    seed: int = 0,
    standard_error: float | None = None,
    steps: int | None = None,
    method: Asked = "auto",
    precision: Precision = "float64",
    confidence: float | None = None,
    time_limit: float | None = None,
    after_step: bool = True,
    progress: Progress | None = None,
) -> Evaluation:
    """Evaluate a problem: compute the cost, the send rates and the cost bounds of its policy.

    If the policy ignores the state, its cost has a closed form. Otherwise the work of every applicable method is
    predicted for the requested error, and the method with the least work is chosen. Quadrature of renewal equations and
    conditional sampling apply if every send resets the error on which the send decision depends. Simulation always
    applies; it averages completed squares or, if these are not valid for the simulated plant, the stage cost. Work is
    counted in operations, so the choice is the same on every machine.

    Args:
        problem: from ``load`` or ``Problem``.
        seed: seed of the random draws, at least 0. Two evaluations with the same seed use common draws, so their errors
            are correlated.
        standard_error: absolute standard error of the cost; default: 1e-4 of the cost.
        steps: total number of steps to simulate over all paths, instead of a standard error; every policy without a
            closed form is then simulated. A note reports if ``steps`` or ``precision`` had no effect.
        method: ``"exact"`` uses a closed form or a quadrature and never simulates; ``"conditional sampling"`` and
            ``"simulation"`` use only the named method.
        precision: floating-point precision of a simulation: ``"float64"``, or ``"float32"``, which is 1.8 times as
            fast.
        confidence: confidence of a lower bound on the cost of all schedules with this rate (see ``bound_below``). If it
            is omitted, neither this bound nor ``rate_bounds`` is computed, since both take seconds.
        time_limit: time limit in seconds, with the design of the policy; default: none. When most of it has passed, the
            best cost so far is returned, with its actual error and ``reached`` False. Other parts of the answer, such
            as periodic control and a lower bound, are omitted with a note if the remaining time is too short.
        after_step: whether to simulate also a step of the slow disturbance that the policy assumes, if it assumes one,
            and the send rates around changes of the set-points, if they change.
        progress: callback that receives the fraction done.

    If the problem states limits of the states, the probabilities of their violation are simulated, whatever the method,
    up to a relative standard error of 5 %; ``steps`` limits the steps of this simulation. If they cannot be simulated,
    a note gives the reason.

    Returns:
        The evaluation, with rates per second for a continuous plant. ``reached`` is False if the budget was used up
        before the requested standard error was reached.

    Raises:
        ProblemError: the data are inconsistent, the confidence is outside (0, 1), no exact method applies, a lower
            bound was requested and does not exist, or the time limit passed before any answer was found.
        UnstableError: the loop diverges.

    Example:
        >>> from taciturn import load
        >>> evaluate(load("two-mass"), steps=100_000).policy
        'excess'
    """
    problem = as_problem("problem", problem)
    check_effort(seed, standard_error, steps)
    if method not in METHODS:
        raise ProblemError(
            f"method is {method!r}; expected one of the methods {', '.join(map(repr, METHODS[:-1]))} or {METHODS[-1]!r}"
        )
    if method == CONDITIONAL and steps is not None:
        raise ProblemError(
            f"method is {method!r} and steps is {steps}; expected method 'auto' or 'simulation' with a number of "
            "steps, or no steps"
        )
    if confidence is not None:
        number("confidence", confidence, 0.0, 1.0)
    began = time.perf_counter()
    told = Stages(in_notebook(progress))
    share = 1.0 if problem.limits is None else 1.0 - VIOLATIONS
    with answered_within(time_limit, early=True):
        request = Request(seed, standard_error, steps, method)
        found = _evaluated(problem, request, precision, confidence, after_step, told.stage(0.0, share))
        if after_step:
            found = with_written(problem, request, found, told.stage(share, share))
        if problem.limits is not None:
            found = with_violations(problem, problem.limits, request, found, told.stage(share, 1.0))
        power, life = _energy(problem, found)
        prices = {link: problem.network.links[link].price for link in found.rates if link in problem.network.links}
        return replace(found, power=power, life=life, prices=prices, seconds=time.perf_counter() - began)


def _evaluated(
    problem: Problem,
    request: Request,
    precision: Precision,
    confidence: float | None,
    after_step: bool,
    told: Stages,
) -> Evaluation:
    """Return the evaluation; the caller adds the time that it took."""
    policy = problem.designed()
    optimum = isinstance(policy, PolicyWithoutSteps)
    if optimum and policy.looked_at is None:
        if confidence is not None:
            expect_bound(problem)
        if precision != "float64":
            raise ProblemError(
                f"precision is {precision!r}; expected 'float64' for the policy {policy.kind} without a period"
            )
        return _evaluated_without_steps(problem, policy, request, told)
    share = AFTER_STEP if after_step and isinstance(policy, Policy) and policy.disturbance is not None else 0.0
    spare = LIMITED if (problem.actual or problem.plant).saturation is not None else 0.0
    share += spare
    most = 1.0 - share if confidence is None else 0.5
    first, certified, lower, stepped, without = told.stage(0.0, most), None, None, None, None
    with part_of_time(most * MEASURED):
        if isinstance(policy, PolicyWithoutSteps):
            loop = problem.close(cast("Policy", policy.looked_at))
            measured, base = policy.measure(loop, request, first), baseline_of(problem, loop)
        else:
            loop = replace(problem.close(policy), precision=precision)
            base = baseline_of(problem, loop)
            measured = measure_beside(loop, base.simulated, request, first)
    asked = {"steps": request.steps, "precision": None if precision == "float64" else precision}
    notes = [*measured.notes, *without_effect(asked, measured.method), *forgotten_start(problem)]
    notes += [f"no cost of every sample: {base.why}"] if base.why else []
    found, policy, unit = measured.averages, loop.deviations.policy, cost_unit(problem)
    every, excess = base.compared(found)
    notes += alarmed(loop, found)
    better = dict[str, Estimate]()
    if every is not None and costs_less(excess):
        with _part("better baseline", notes):
            better = better_baselines(problem, loop, every, request.seed)
    per_tick, pace = found.rates[policy.scheduled[0]], base_rate(loop)
    with part_of_time(1.0 if most == 1.0 else COMPARED):
        fair, no_clock = periodic_at(problem, policy, per_tick.scaled(1 / policy.tick))
    if confidence is not None:
        resets(loop)
        with _part("lower bound", notes, ProblemError):
            certified = None if optimum else bound_rate(loop)
            lower = _lower_bound(loop, per_tick, confidence, request.seed, told.stage(0.5, 1.0 - share))
    guarantee = policy.guarantee if loop.nominal else None
    if certified is not None:
        certified = (pace * certified[0], pace * certified[1])
        notes += contradicted(per_tick.scaled(pace), certified, rate_unit(unit))
    sharper = None if guarantee is None else guarantee.at_rates(found.rates, policy.scheduled[0])
    if share > spare:
        with _part("averages after a step", notes):
            stepped = averages_after_step(problem, policy, request, told.stage(1.0 - share, 1.0 - spare))
    with _part("cost without limits", notes):
        without = compare_without_limits(problem, loop, request, pace, told.stage(1.0 - spare, 1.0))
    late = dict[str, LatePackets]()
    with _part("late packets", notes):
        late = late_packets(loop, request.seed)
    around = None
    if after_step and policy.theory.closed_form is None:  # it sends at fixed steps
        with _part("send rates around changes of the set-points", notes):
            around = rates_around_steps(loop, request.seed, pace)
    # the reason why there is no periodic control is no evidence if it is a lack of time
    known = guarantee is not None or fair is not None or no_clock != late_text()
    compared = loop.nominal and per_tick.value > 0 and _predicts(policy) and known
    promised = None
    if problem.nonlinear and problem.actual is None:
        promised = Linearisation(policy.cost_all_time, None if policy.guarantee is None else policy.guarantee.cost)
    return Evaluation(
        policy=policy.kind,
        unit=unit,
        base_rate=pace,
        cost=found.cost,
        cost_all_time=policy.theory.cost_all_time if loop.nominal else None,
        statement=None if guarantee is None else guarantee.statement,
        cost_bound=None if guarantee is None else guarantee.cost,
        cost_bound_at_rate=None if sharper is None else sharper.value,
        rates={link: rate.scaled(pace) for link, rate in found.rates.items()},
        seed=request.seed,
        seconds=0.0,
        steps=found.steps,
        reached=found.reached,
        schedule=policy.schedule,
        clock=fair,
        no_clock=no_clock,
        mean_interval=_interval(per_tick, policy.tick) if _predicts(policy) else None,
        lower_bound=lower,
        rate_bounds=certified,
        consistency=_consistency(found.cost, fair, guarantee is not None) if compared else None,
        notes=(
            *dict.fromkeys((*loop.problem.remarks, *notes)),
            *(f"{text}{WITHDRAWN}" for text in loop.violated_assumptions),
        ),
        withdrawn=loop.violated_assumptions,
        doubts=tuple(note for note in found.notes if note not in loop.problem.remarks),
        by_default=_added_by_default(problem, policy) is not None,
        linearisation=promised,
        estimator=found.estimator,
        settled=found.settled,
        trusted=found.trusted,
        bound_error=0.0 if sharper is None else sharper.standard_error,
        method=measured.method,
        reason=measured.reason,
        after_step=stepped,
        set_point_steps=around,
        without_limits=without,
        cost_lqg=policy.theory.cost_lqg if loop.nominal else None,
        proved=guarantee is not None and guarantee.proved,
        silence={" and ".join(links): one for links, one in found.silence.items()} if loop.nominal else {},
        certificate=_certificate(loop, found),
        guarantee_shares={} if guarantee is None else _guarantee_shares(loop, guarantee, found),
        cost_all_time_error=policy.theory.cost_all_time_error if loop.nominal else None,
        baseline=None if base.loop is None else every,  # or the theory states it
        paired=None if base.loop is None else excess,
        better=better,
        late=late,
    )


def alarmed(loop: Loop, found: Averages) -> list[str]:
    """Return a note if a load, or another plant, keeps the alarm on innovations on, so that every sample is sent."""
    other = loop.problem.loads is not None or not loop.nominal
    always = all(1 - rate.value <= SAME for rate in found.rates.values())
    if WATCH not in loop.policy.decisions or not other or not always:
        return []
    return [
        "the node sends every sample while measurements differ from what its filter expects, as with a load or a plant "
        "that the design does not know; expected a disturbance of this size in the design: controller.disturbance = "
        "{time_constant, deviation}, or for LQG a [[disturbance]] with wander"
    ]


def _certificate(loop: Loop, found: Averages) -> Estimate | None:
    """Return the bound that the nodes measure themselves, or None."""
    if not found.silence or not loop.nominal:
        return None
    factors = {links: one.factor**2 for links, one in loop.policy.theory.silence.items()}
    silence = [one.scaled(factors[links]) for links, one in found.silence.items()]
    return certificate_of(loop.policy.cost_all_time, loop.problem.per_unit(0.0), silence)


def _guarantee_shares(loop: Loop, guarantee: Guarantee, found: Averages) -> dict[str, float]:
    """Return the share of each node in the sum of the roots of the allowed or actual costs of silence, by its links."""
    factors = {links: one.factor**2 for links, one in loop.policy.theory.silence.items()}
    added = guarantee.deciders or {links: factors[links] * one.value for links, one in found.silence.items()}
    roots = {" and ".join(links): sqrt(max(one, 0.0)) for links, one in added.items()}
    total = sum(roots.values())
    return {links: root / total for links, root in roots.items()} if total > 0 and len(roots) > 1 else {}


def _evaluated_without_steps(
    problem: Problem, policy: PolicyWithoutSteps, request: Request, progress: Progress
) -> Evaluation:
    """Return the evaluation of a policy without sampling steps."""
    found = policy.measure(None, request, progress).averages
    rate = found.rates["sensor"]
    interval = _interval(rate, 1.0)
    assert interval is not None
    fair, no_clock = periodic_at(problem, policy, rate)
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
        no_clock=no_clock,
        mean_interval=interval,
        lower_bound=None,
        rate_bounds=None,
        consistency=_consistency(found.cost, fair, policy.statement is not None),
        notes=policy.notes,
        bound_error=policy.bound_error(interval),
    )


@contextmanager
def _part(name: str, notes: list[str], *refused: type[TaciturnError]) -> Generator[None]:
    """Leave a part of the answer out, with a note, if the time limit passes first, or if it is refused."""
    try:
        yield
    except refused as error:
        notes.append(f"no {name}: {error}")
    except OutOfTime:  # only the parts that a user requests, which may be refused, are worth a longer limit
        notes.append(f"no {name}: {late_text()}{'; expected a longer one' * bool(refused)}")


def without_effect(asked: Mapping[str, object], method: str) -> tuple[str, ...]:
    """Write a note if the user has set options of a simulation, but no simulation computed the answer."""
    given = [f"{name} = {value}" for name, value in asked.items() if value is not None]
    if not given or method == "simulation":
        return ()
    return (f"{' and '.join(given)} had no effect: no loop was simulated",)


def forgotten_start(problem: Problem) -> tuple[str, ...]:
    """Write a note if the user has given an initial state, which does not affect an average cost."""
    plant = problem.plant if problem.actual is None else problem.actual
    given = [name for name, value in (("mean", plant.mean), ("covariance", plant.covariance)) if value.any()]
    if not given or problem.cost.horizon is not None or problem.cost.discount < 1:
        return ()
    return (f"{' and '.join(f'initial.{name}' for name in given)} had no effect: the cost is an average over all time",)


def choose_confidence(problem: Problem, asked: float | None) -> float | None:
    """Return the confidence level of a lower bound: the user's or the default; None if there is no bound to compute."""
    if asked is not None:
        return asked or None
    try:
        expect_bound(problem)
    except ProblemError:
        return None
    return LEVEL


def expect_bound(problem: Problem) -> None:
    """Raise an error if no lower bound on the cost of all schedules can be computed for the problem."""
    policy = problem.designed()
    nodes = nodes_of(policy)
    if nodes is None:
        raise ProblemError(
            f"a confidence level requests a lower bound, but none is available for the policy {policy.kind} without a "
            "period; expected no confidence level"
        )
    resets(problem.close(nodes))


def _lower_bound(loop: Loop, rate: Estimate, confidence: float, seed: int, progress: Progress) -> LowerBound:
    """Return the lower bound at a measured rate, evaluated at the upper confidence limit of this rate."""
    if rate.value == 0:
        raise ProblemError("nothing is sent")
    from statistics import NormalDist  # which most evaluations do not need

    bound_below = load_plugin("taciturn.bounds", "schedules", "a lower bound")
    lower = bound_below(loop, min(rate.value, 1.0), confidence, seed, progress)
    margin = NormalDist().inv_cdf(confidence) * rate.standard_error + rate.error
    return replace(lower, cost=max(lower.at_rate(rate.value + max(margin, 0.0)), loop.policy.cost_all_time))


def contradicted(rate: Estimate, certified: tuple[float, float], unit: TimeUnit) -> tuple[str, ...]:
    """Write a warning if a simulated rate is three or more standard errors outside its certified bounds."""
    nearest = min(max(rate.value, certified[0]), certified[1])
    gap, error = abs(rate.value - nearest), rate.standard_error
    if rate.method != "simulation" or gap < CONTRADICTION * error or gap <= SAME * nearest:
        return ()
    decimals = max(0, 1 - magnitude(gap), 1 - magnitude(error) if error else 0)
    low, high = (f"{bound:.{decimals}f}" for bound in certified)
    off = f"{gap / error:.2g} standard errors " if error else ""
    shown = rate if error else f"{rate.value:.{decimals}f}"
    return (
        f"the simulated rate {shown} per {unit} is {off}outside its certified bounds {low} to {high}; the bounds are "
        "correct: the send intervals are so regular that the initial transient does not decay within the run",
    )


def with_violations(
    problem: Problem, limits: Limits, request: Request, found: Evaluation, progress: Progress
) -> Evaluation:
    """Add the probabilities that limits of states are violated, or a note on why they are missing."""
    policy, notes = problem.designed(), list(found.notes)
    with _part("probability of violation", notes, TaciturnError):
        if not isinstance(policy, Policy):
            raise ProblemError(
                f"state limits are given, but the policy {policy.kind} works in continuous time without sampling "
                "steps, so violations cannot be simulated; expected a policy with a sampling period, such as "
                "near-optimal"
            )
        violations = load_plugin("taciturn.violations", "limits", "a probability of violation")
        seen = violations(problem.close(policy), limits, seed=request.seed, steps=request.steps, progress=progress)
        found = replace(found, violations=seen)
    return replace(found, notes=tuple(notes))


def with_written(problem: Problem, request: Request, found: Evaluation, progress: Progress) -> Evaluation:
    """Add results for the plant as the user wrote it, if Taciturn has added a slow disturbance to the plant by
    default.
    """
    if problem.controller is None:  # defaults add to the plants of given controllers only
        return found
    notes = list(found.notes)
    with _part("averages for the plant as written", notes):
        found = replace(found, as_written=_plant_as_written(problem, problem.designed(), request, progress))
    return replace(found, notes=tuple(notes))


def _added_by_default(problem: Problem, policy: object) -> Disturbance | None:
    """Return the disturbance that a default has added to the plant of a given controller; None if there is none."""
    kept = problem.controller
    if kept is None or not isinstance(policy, Policy) or isinstance(problem.own, BareKind):
        return None
    listed = kept.loops if isinstance(kept, PIDLoops) else (kept,)
    return None if any(one.disturbance is not None for one in listed) else policy.disturbance


def _plant_as_written(
    problem: Problem, policy: object, request: Request, progress: Progress | None = None
) -> AsWritten | None:
    """Return cost and rates of a policy on the plant as written, or None if no default has added anything."""
    kept, added = problem.controller, _added_by_default(problem, policy)
    if kept is None or added is None or not isinstance(policy, Policy):
        return None
    plain = Disturbance(added.time_constant, 0.0 * (0.0 if added.deviation is None else added.deviation))
    plant = plain.added_to(problem.actual or problem.plant)
    exact = _every_sample(problem, kept)
    found = averages_on(plant, problem, policy, precisely(request, policy), progress, exact is None)
    base, excess = found.baseline, found.excess
    if exact is not None:
        base = Estimate(exact, 0.0, "exact")
        excess = excess_over(found.cost, base)
    return AsWritten(added.text(), found.cost, exact, found.rates, found.settled, base, excess)


def _every_sample(problem: Problem, kept: AnyController) -> float | None:
    """Return the cost of the controller with every sample on the plant as written, or None if it is not known."""
    if problem.actual is not None or problem.nonlinear or problem.plant.saturation is not None or problem.plant.loads:
        return None
    network = problem.network
    if network.missing or network.late or any(map(network.loss, network.links)):
        return None
    period = problem.parameters.get("period") if isinstance(problem.plant, ContinuousPlant) else None
    try:
        plain = _without_disturbance(kept)
        return send_at_fixed_steps("this controller", problem.plant, problem.cost, period, plain).cost_all_time
    except TaciturnError:  # such as a loop whose cost is infinite
        return None


def _without_disturbance(kept: AnyController) -> AnyController:
    """Return a controller whose plant gets no slow disturbance."""
    none = Disturbance(deviation=0.0)
    if isinstance(kept, PIDLoops):
        first, *others = kept.loops
        return PIDLoops((replace(first, disturbance=none), *others))
    if isinstance(kept, PID | ContinuousController):
        return replace(kept, disturbance=none)
    return Controller(
        kept.A, kept.B, kept.C, kept.D, kept.E, kept.dt, none, kept.setpoint, kept.start_input, kept.F, kept.G
    )


def _energy(problem: Problem, found: Evaluation) -> tuple[dict[str, Estimate], dict[str, Estimate]]:
    """Return the power of the packets in watts, and the life of the batteries in seconds, by link."""
    power, life = dict[str, Estimate](), dict[str, Estimate]()
    plant = problem.plant
    seconds = plant.dt if isinstance(plant, Plant) else problem.parameters.get("period")
    per_second = 1.0 if found.rate_unit == "second" else 1 / float(seconds or 1.0)
    for link, law in problem.network.links.items():
        if law.energy is None:
            continue
        rate = found.rates[link].scaled(per_second)
        used, lasting = law.power(rate), law.life(rate)
        power |= {} if used is None else {link: used}
        life |= {} if lasting is None else {link: lasting}
    return power, life


def _predicts(policy: Policy) -> bool:
    """Return whether both nodes predict in continuous time and events decide when the prediction is corrected."""
    return policy.prediction is not None and policy.theory.closed_form is None


def _consistency(cost: Estimate, clock: ClockMix | None, proved: bool) -> Consistency:
    """Return whether a cost is at most that of periodic control at its rate, which is infinite if it is unstable."""
    if proved:
        return "guaranteed"
    if clock is None:
        return "verified"
    margin = SURE * (cost.standard_error + clock.standard_error) + cost.error
    return "verified" if cost.value + margin <= clock.cost else "not verified"


def _interval(rate: Estimate, tick: float) -> Estimate | None:
    """Return the mean seconds between sends, or None if nothing is sent."""
    return rate.inverse(tick) if rate.value > 0 else None
