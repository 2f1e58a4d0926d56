"""Loops that share a channel: their controllers, and their common step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import gcd, lcm

from taciturn._arrays import Array, count, instance
from taciturn._display import Displayed
from taciturn.analyse.limits import resets
from taciturn.design.modelled import modelled
from taciturn.errors import ProblemError, TaciturnError
from taciturn.loop import close
from taciturn.model.coverage import LINEAR_LOOP, Coverage
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant
from taciturn.model.trigger import Form
from taciturn.problem import Problem
from taciturn.problem.bare import as_problem
from taciturn.renewal.allocation import Clocked
from taciturn.study.units import Unit, cost_unit, rate_unit

CHANNELS = Coverage(LINEAR_LOOP, "loops that share a channel do not support")
FINEST = 1_000_000  # periods are approximated by fractions of a second with at most this denominator
EQUAL = 1e-9  # largest relative error of this approximation
LONGEST = 10_000  # largest number of steps after which the checks of all loops repeat


@dataclass(frozen=True, eq=False, repr=False)
class Kind(Displayed):
    """The loops of one problem, with plant, cost, and a certainty-equivalent controller that predicts at the actuator.

    The error is e⁺ = F e (1−σ) + w. A check without a send costs e'Γe beyond sending every sample, in the units of the
    cost times steps; so a loop that checks at every other step has twice the weight.

    Args:
        name: name of the problem.
        count: number of loops.
        every: steps of the channel between two checks.
        F: error dynamics, (n, n).
        noise: covariance of w, (n, n).
        Gamma: weight Γ, (n, n).
        L: matrix from the error of the state to the error of the input, (inputs, n).
        cost_all_time: cost of one loop that sends at every check.
        clocked: cost of periodic control as a function of the send interval.
    """

    name: str
    count: int
    every: int
    F: Array
    noise: Array
    Gamma: Array
    L: Array
    cost_all_time: float
    clocked: Clocked

    @property
    def looks(self) -> float:
        """Number of checks per step of all loops that share the channel."""
        return self.count / self.every


def gather(problems: Mapping[str, Problem], copies: Sequence[int]) -> tuple[Kind, ...]:
    """Return the loops of some problems, with the given number of copies of each.

    Raises:
        ProblemError: there are no problems, the units of cost differ, there is no common step, or no send resets the
            error of a problem.
    """
    instance("problems", problems, Mapping)
    if not problems:
        raise ProblemError("problems is empty; expected at least one problem, whose loops share the channel")
    if len(copies) not in (1, len(problems)):
        raise ProblemError(
            f"copies has {len(copies)} numbers for {len(problems)} problems; expected one number for each problem, or "
            "one number for all"
        )
    copies = [count("copies", number) for number in copies] * (1 if len(copies) > 1 else len(problems))
    problems = {name: as_problem(f"problems[{name!r}]", problem) for name, problem in problems.items()}
    units: dict[str, Unit] = {name: cost_unit(problem) for name, problem in problems.items()}
    for name, unit in units.items():
        first = next(iter(units))
        if unit != units[first]:
            raise ProblemError(
                f"the cost of {first} is per {units[first]}, but the cost of {name} is per {unit}; expected one unit: "
                "define all plants in continuous time with policy.period, or all with plant.dt"
            )
    every = _common_ticks(
        {name: _period(name, problem) for name, problem in problems.items()}, rate_unit(units[next(iter(units))])
    )
    return tuple(
        _kind(name, problem, number, step)
        for (name, problem), number, step in zip(problems.items(), copies, every, strict=True)
    )


def _kind(name: str, problem: Problem, number: int, every: int) -> Kind:
    try:
        if problem.network != Network():
            given = "[network]" if problem.network.triangle else "[nodes]"
            raise ProblemError(
                f"{given} is given, but the shared channel replaces the network; expected a problem without {given}"
            )
        if problem.controller is not None:
            raise ProblemError(
                "[controller] is given, but the loops of a shared channel have LQG control; expected no [controller]"
            )
        if problem.nonlinear:
            raise ProblemError("the plant is nonlinear; expected a linear plant in loops that share a channel")
        period = problem.parameters.get("period")
        policy = modelled(
            "channel", problem.plant, problem.cost, period, lambda _, reset: Form((reset.error,), reset.weight)
        )
        loop = close(problem.actual or problem.plant, policy)
        if loop.violated_assumptions:
            raise ProblemError(
                f"{loop.violated_assumptions[0]}; expected the plant and cost of the design for loops on a shared "
                "channel"
            )
        if loop.problem.jumps is not None:
            raise ProblemError("plant.jumps is given; expected Gaussian noise (plant.W) in loops that share a channel")
        CHANNELS.check(loop.parts)
        reset = resets(loop)
    except TaciturnError as error:
        raise type(error)(f"{name}: {error}") from None
    F = loop.problem.plant.A
    Gamma, noise, seen = every * reset.weight, reset.covariance, list(reset.signals.values())
    return Kind(name, number, every, F, noise, Gamma, seen[-1], policy.cost_all_time, Clocked(F, noise, Gamma))


def _period(name: str, problem: Problem) -> float | None:
    """Return the seconds between two checks of a problem's loop, or None if time is counted in steps.

    Raises:
        ProblemError: the plant is continuous and no period is given.
    """
    if not isinstance(problem.plant, ContinuousPlant):
        return problem.plant.dt
    period = problem.parameters.get("period")
    if period is None:
        raise ProblemError(
            f"{name}: the plant is continuous in time, but policy.period is missing; expected the seconds between "
            "checks (set plant.dt if A and B are discrete-time matrices)"
        )
    return float(period)


def _common_ticks(periods: Mapping[str, float | None], unit: str) -> list[int]:
    """Return the number of steps of the channel in each period.

    Raises:
        ProblemError: the periods are not multiples of a common step.
    """
    seconds = [period for period in periods.values() if period is not None]
    if not seconds:
        return [1] * len(periods)
    if len(seconds) < len(periods):
        without = next(name for name, period in periods.items() if period is None)
        other = next(name for name, period in periods.items() if period is not None)
        raise ProblemError(
            f"{without} has no plant.dt, but {other} checks every {periods[other]:g} s; expected plant.dt in all "
            "problems, for a common step"
        )
    if len(set(seconds)) > 1 and unit == "step":
        listed = ", ".join(f"{name} {period:g} s" for name, period in periods.items())
        raise ProblemError(
            f"costs are per step, but the steps have different lengths ({listed}); expected the same plant.dt in all "
            "problems, or plants in continuous time with policy.period"
        )
    exact = [Fraction(period).limit_denominator(FINEST) for period in seconds]
    whole = lcm(*(part.denominator for part in exact))
    steps = [int(part * whole) for part in exact]
    every = [step // gcd(*steps) for step in steps]
    off = any(abs(part / Fraction(period) - 1) > EQUAL for part, period in zip(exact, seconds, strict=True))
    if off or lcm(*every) > LONGEST:
        listed = ", ".join(f"{name} every {period:g} s" for name, period in periods.items())
        raise ProblemError(
            f"the loops check at different times ({listed}), and the pattern does not repeat within {LONGEST} common "
            "steps; expected periods that are multiples of a common step"
        )
    return every
