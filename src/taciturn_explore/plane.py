"""The page's plot of cost against traffic (sends times prices): the point of a setting, and curves for comparison.

The point is an evaluation: ``point``, with cost, rates, guarantee, and periodic control at its rate. A curve is a list
of evaluations at the values of a trade-off parameter that ``curves`` chooses.

Every number comes with the text that the page shows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, Stages, number_of, percent
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate, bound_text
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn.renewal.without_steps import PolicyWithoutSteps
from taciturn.simulation.average import difference
from taciturn.study.evaluate import choose_confidence, evaluate, with_written
from taciturn.study.evaluation import Evaluation, clock_text, percent_above, percent_text
from taciturn.study.measure import Request
from taciturn.study.periodic import clock_of
from taciturn_explore.controls import tuned
from taciturn_explore.files import Effort, command, python_lines
from taciturn_explore.setting import Setting
from taciturn_studies.periodic_links import NoLinkClocksError, at_traffic, clocks_or_reason

COARSE = Effort(steps=400_000)  # mostly some 0.3 % of the cost and of the rate
LESS_COARSE = Effort(steps=4_000_000)  # if the coarse answer has a larger error than ROUGH
CLEAR = 0.002  # standard error of a point of a curve, relative to the cost, above which it gets more steps
ROUGH = 0.01  # largest standard error of a first answer, relative to the cost
OF_CURVE = Effort(steps=100_000)
MOST_STEPS = 200_000_000  # of a refined answer
FINE = 1e-3  # standard error of a refined cost, relative to the cost of sending every sample
SLOWEST = 1 / 40  # least rate of the curve of periodic control, relative to that of every sample
BOUND = 200_000  # steps of the evaluation with a lower bound
UNITS = ("W", "mW", "µW", "nW")
SHARES = (0.5, 0.7, 0.35, 0.9, 0.25)  # of the traffic of every sample, at which several links are timed


def every_sample(problem: Problem, found: Evaluation) -> float | None:
    """Return the traffic (sends times prices) if every sample is sent; None if the policy can send at any time."""
    if found.base_rate is None:
        return None
    return found.base_rate * sum(found.prices.get(link, 1.0) for link in found.rates)


def fine(found: Evaluation) -> Effort:
    """Return the accuracy of a refined evaluation: a standard error or, if that takes too long, a number of steps."""
    wanted = FINE * abs(found.base or found.cost.value)
    if found.steps * (found.cost.standard_error / wanted) ** 2 > MOST_STEPS:
        return Effort(steps=MOST_STEPS)
    return Effort(standard_error=float(f"{wanted:.2g}"))


def measured(setting: Setting, problem: Problem, effort: Effort, further: bool = False) -> Evaluation:
    """Evaluate a setting as ``taciturn evaluate`` does, without averages after a step, which the page does not show.

    With ``further``, also evaluate the loop on the plant as written.
    """
    found = evaluate(
        problem, seed=setting.seed, steps=effort.steps, standard_error=effort.standard_error, after_step=False
    )
    request = Request(setting.seed, effort.standard_error, effort.steps, "auto")
    return with_written(problem, request, found, Stages(None)) if further else found


def point(setting: Setting, problem: Problem, found: Evaluation, effort: Effort) -> dict[str, Any]:
    """Return the cost and the traffic of a setting, and the other numbers that the page shows next to its plot."""
    base, whole, main = found.base, every_sample(problem, found), tuned(problem)
    traffic, periodic = found.traffic, found.periodic
    bound = found.guarantee_at_rate or (None if found.cost_bound is None else _known(found.cost_bound))
    return {
        "cost": shown(found.cost, base) | ({} if found.excess is None else {"above": percent_text(found.excess)}),
        "traffic": None if traffic is None else _traffic(traffic, whole),
        "rates": [_rate(link, rate, found) for link, rate in found.rates.items()],
        "whole": whole,
        "every": None
        if base is None or whole is None
        else {"cost": base, "traffic": whole, "text": str(found.cost_every_sample)},
        "every_text": None if whole is None else f"{whole:.4g}",
        "guarantee": None if bound is None else shown(bound, found.highest_all_time, 1),
        "periodic": None if periodic is None else shown(periodic, base),
        "beside": periodic is None and len(found.rates) > 1 and whole is not None,
        "how_periodic": found.no_clock if found.clock is None else clock_text(found.clock),
        "tuning": None if main is None else {"name": main.name, "value": problem.parameters.get(main.name)},
        "written": _written(found),
        "by_default": found.by_default,
        "load": _load(found),
        "unit": found.per,
        "rate_unit": found.rate_unit,
        "traffic_unit": f"sends per {found.rate_unit}" if plain(found) else f"traffic per {found.rate_unit}",
        "verdict": list(found.verdict),
        "notes": list(found.remarks),
        "method": found.method,
        "settled": found.settled,
        "effort": effort.option,
        "command": command(setting, effort),
        "python": python_lines(setting, effort),
    }


def plain(found: Evaluation) -> bool:
    """Return whether the price of a packet is 1 on all links."""
    return all(found.prices.get(link, 1.0) == 1.0 for link in found.rates)


def shown(cost: Estimate, base: float | None, up: int = 0) -> dict[str, Any]:
    """Return a cost as a number and as text, and how many percent it exceeds the cost of sending every sample."""
    text = bound_text(cost, up) if up else str(cost)
    above = None if not base else percent_above(cost, base, up)
    return {"value": cost.value, "error": cost.standard_error + cost.error, "text": text, "above": above}


def _known(value: float) -> Estimate:
    return Estimate(value, 0.0, "bound")


def _traffic(traffic: Estimate, whole: float | None) -> dict[str, Any]:
    share = None if not whole else traffic.scaled(1 / whole)
    return {
        "value": traffic.value,
        "error": traffic.standard_error,
        "text": str(traffic),
        "share": None if share is None else percent(share.value, 1),
    }


def _rate(link: str, rate: Estimate, found: Evaluation) -> dict[str, Any]:
    price, life = found.prices.get(link, 1.0), found.life.get(link)
    power = found.power.get(link)
    return {
        "link": link,
        "value": rate.value,
        "error": rate.standard_error,
        "text": str(rate),
        "share": None if not found.base_rate else rate.value / found.base_rate,
        "share_text": None if not found.base_rate else percent(rate.value / found.base_rate, 1),
        "apart": _apart(rate, found),
        "price": price,
        "power": None if power is None else _watts(power),
        "life": None if life is None else f"{life.scaled(1 / 86400)} days",
    }


def _apart(rate: Estimate, found: Evaluation) -> str | None:
    """Return the mean number of steps from a packet to the next one: that of the rate."""
    return None if not found.base_rate or rate.value <= 0 else f"{found.base_rate / rate.value:.3g}"


def _written(found: Evaluation) -> dict[str, float] | None:
    """Return traffic and cost on the plant as written, whose excess over every sample is that on the axis."""
    written, base = found.as_written, found.base
    if written is None or not written.settled or written.excess is None or not base:
        return None
    traffic = sum(found.prices.get(link, 1.0) * rate.value for link, rate in written.rates.items())
    return {"traffic": traffic, "cost": base * (1 + written.excess.value)}


def _watts(power: Estimate) -> str:
    """Return a power with a unit in which it has at most three digits before the point."""
    steps = 0 if power.value <= 0 else max(0, min(len(UNITS) - 1, -math.floor(math.log10(power.value) / 3)))
    return f"{power.scaled(1000.0**steps)} {UNITS[steps]}"


def _load(found: Evaluation) -> str | None:
    """Return the packets of all links together, the load of a bus that they share; None for a single link."""
    if len(found.rates) < 2:
        return None
    total = sum(rate.value for rate in found.rates.values())
    most = found.base_rate and f", of {found.base_rate * len(found.rates):.4g} with every sample"
    return f"all links: {number_of(f'{total:.4g}', 'packet')} per {found.rate_unit}{most or ''}"


def on_curve(setting: Setting, problem: Problem) -> Evaluation:
    """Evaluate a setting for a point of a curve; simulate more steps if the first result is too inaccurate."""
    found = measured(setting, problem, OF_CURVE)
    clear = found.settled and found.cost.standard_error <= CLEAR * abs(found.cost.value)
    return found if clear else measured(setting, problem, LESS_COARSE)


def curve_point(problem: Problem, found: Evaluation) -> dict[str, Any]:
    """Return the data of a point of a curve; its share is None, so it is not drawn, if the loop has not settled."""
    traffic, main = found.traffic, tuned(problem)
    whole = every_sample(problem, found)
    return {
        "parameter": None if main is None else problem.parameters.get(main.name),
        "traffic": None if traffic is None else traffic.value,
        "share": None if traffic is None or not whole or not found.settled else traffic.value / whole,
        "cost": found.cost.value,
        "error": found.cost.standard_error,
        "guarantee": found.cost_bound_at_rate or found.cost_bound,
    }


def fair(problem: Problem, found: Evaluation) -> dict[str, Any]:
    """Return cost against traffic for fair periodic control, or shares of traffic to compute, or why there is none."""
    clock = clock_of(problem, problem.designed())
    if clock is not None and found.base_rate is not None:
        price = next((found.prices.get(link, 1.0) for link in found.rates), 1.0)
        corners = clock.curve(found.base_rate, SLOWEST * found.base_rate)
        return {"points": [{"traffic": price * one.rate, "cost": one.cost} for one in corners], "shares": []}
    if len(found.rates) > 1 and every_sample(problem, found):
        return {"points": [], "shares": SHARES}
    return {"points": [], "shares": [], "reason": found.no_clock}


def timed(problem: Problem, found: Evaluation, share: float) -> dict[str, Any]:
    """Compute the cost of fair periodic control over several links, at a share of the traffic of every sample."""
    traffic = share * (every_sample(problem, found) or 0.0)
    clocks = clocks_or_reason([problem], traffic)
    if isinstance(clocks, str):
        raise ProblemError(clocks)
    return {"traffic": traffic, "cost": clocks.cost}


def beside(problem: Problem, found: Evaluation) -> dict[str, Any]:
    """Compute the cost of periodic control over several links, at the traffic of a given evaluation."""
    assert found.traffic is not None, "there are links"
    try:
        cost = at_traffic(problem, found.traffic)
    except NoLinkClocksError as error:
        raise ProblemError(str(error)) from None
    return {"periodic": shown(cost, found.base)}


def bound(setting: Setting, problem: Problem) -> dict[str, Any]:
    """Compute a lower bound on the controller's cost, valid for every send schedule with the measured traffic."""
    sure = choose_confidence(problem, None)
    if sure is None:
        return {"cost": None, "reason": "no lower bound is known for this policy"}
    found = evaluate(problem, seed=setting.seed, steps=BOUND, confidence=sure, after_step=False)
    lower = found.lower_bound
    if lower is None:
        return {"cost": None, "reason": "no lower bound was found"}
    pace = found.base_rate or 1.0
    price = next((found.prices.get(link, 1.0) for link in found.rates), 1.0)
    return {
        "cost": lower.cost,
        "traffic": pace * price * lower.rate,
        "slope": -lower.price / price,
        "sure": percent(lower.confidence),
        "text": bound_text(_known(lower.cost), -1),
        "reason": "",
    }


@dataclass(frozen=True, eq=False, repr=False)
class Designed(Displayed):
    """A problem, its designed policy and the closed loop."""

    problem: Problem
    policy: Policy
    loop: Loop


def designed(problem: Problem) -> Designed:
    """Design the policy of a problem, and return it with the closed loop."""
    policy = problem.designed()
    if isinstance(policy, PolicyWithoutSteps):
        raise ProblemError(policy.why_it_cannot_run)
    return Designed(problem, policy, problem.close(policy))


def differences(first: Designed, second: Designed, seed: int) -> dict[str, Any]:
    """Estimate how cost and rates differ between two settings (second minus first), with the same random numbers."""
    base = first.policy.theory.cost_all_time
    error = None if not base else FINE * abs(base)
    found = difference(second.loop, first.loop, seed=seed, standard_error=error)
    rates: Mapping[str, Estimate] = found.rates
    share = None if not base else found.cost.scaled(100 / base)
    return {
        "cost": str(found.cost),
        "percent": None if share is None else f"{share} % of the cost of every sample",
        "rates": [{"link": link, "text": str(rate)} for link, rate in rates.items()],
    }
