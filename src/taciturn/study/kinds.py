"""The loops that share a channel: their controllers, and the tick that they have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import gcd, lcm

from taciturn._arrays import Array, count, instance
from taciturn.analyse.limits import resets
from taciturn.design.near_optimal import modelled
from taciturn.errors import ProblemError, TaciturnError
from taciturn.loop import close
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant
from taciturn.model.trigger import Form
from taciturn.problem import Problem, expect_problem
from taciturn.renewal.allocation import Clocked
from taciturn.study.units import time_unit

FINEST = 1_000_000  # parts of a second that periods are told apart by
EQUAL = 1e-9  # relative, by which a period may be off such a part
LONGEST = 10_000  # ticks after which the looks of all loops repeat


@dataclass(frozen=True, eq=False)
class Kind:
    """Loops of one problem: its plant, its cost and the certainty-equivalent controller, whose actuator predicts.

    A look at the error e⁺ = F e (1−σ) + w costs e'Γe beyond sending always where it is kept, in the units of the cost
    times ticks: a loop that looks at every other tick has twice the weight.

    Args:
        name: of the problem.
        count: loops.
        every: ticks of the channel between two looks.
        F: (n, n).
        noise: covariance of w, (n, n).
        Gamma: Γ, (n, n).
        L: what the error is of the input, (inputs, n).
        cost_all_time: of one loop that sends at every look.
        clocked: what intervals between sends cost.
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
        """Looks per tick of all its loops."""
        return self.count / self.every


def gather(problems: Mapping[str, Problem], copies: Sequence[int]) -> tuple[Kind, ...]:
    """Return the loops of some problems, so many of each.

    Raises:
        ProblemError: no problems, other units of cost, no common tick, a problem that no send resets the error of.
    """
    instance("problems", problems, Mapping)
    if not problems:
        raise ProblemError("problems is empty; expected at least one, whose loops share the channel")
    if len(copies) not in (1, len(problems)):
        raise ProblemError(
            f"copies has {len(copies)} numbers for {len(problems)} problems; expected one for each, or one for all"
        )
    copies = [count("copies", number) for number in copies] * (1 if len(copies) > 1 else len(problems))
    for name, problem in problems.items():
        expect_problem(f"problems[{name!r}]", problem)
    units = {name: time_unit(problem) for name, problem in problems.items()}
    for name, unit in units.items():
        first = next(iter(units))
        if unit != units[first]:
            raise ProblemError(
                f"the cost of {first} counts per {units[first]} and that of {name} per {unit}; expected one unit, to "
                "add them up: give all plants in continuous time with policy.period, or all with plant.dt"
            )
    every = _common_ticks(
        {name: _period(name, problem) for name, problem in problems.items()}, units[next(iter(units))]
    )
    return tuple(
        _kind(name, problem, number, step)
        for (name, problem), number, step in zip(problems.items(), copies, every, strict=True)
    )


def _kind(name: str, problem: Problem, number: int, every: int) -> Kind:
    try:
        if problem.network != Network():
            raise ProblemError("[network] is given, and the channel is the network; expected none: remove it")
        if problem.nonlinear:
            raise ProblemError("the plant is not linear; loops that share a channel are linear plants, as their errors")
        period = problem.parameters.get("period")
        policy = modelled(
            "channel", problem.plant, problem.cost, period, lambda _, reset: Form((reset.error,), reset.square)
        )
        loop = close(problem.actual or problem.plant, policy)
        if loop.departures:
            raise ProblemError(f"{loop.departures[0]}; expected the plant and the cost of the design, on a channel")
        if loop.problem.jumps is not None:
            raise ProblemError("plant.jumps is given; expected Gaussian noise (plant.W) in loops that share a channel")
        reset = resets(loop)
    except TaciturnError as error:
        raise type(error)(f"{name}: {error}") from None
    F = loop.problem.plant.A
    Gamma, noise, seen = every * reset.square, reset.covariance, list(reset.signals.values())
    return Kind(name, number, every, F, noise, Gamma, seen[-1], policy.cost_all_time, Clocked(F, noise, Gamma))


def _period(name: str, problem: Problem) -> float | None:
    """Return the seconds between two looks of a problem's loop, or None where time is counted in steps.

    Raises:
        ProblemError: a continuous plant, and no period.
    """
    if not isinstance(problem.plant, ContinuousPlant):
        return problem.plant.dt
    period = problem.parameters.get("period")
    if period is None:
        raise ProblemError(
            f"{name}: the plant is continuous in time and policy.period is missing; expected the seconds between looks "
            "(give plant.dt if A and B are those of a step)"
        )
    return float(period)


def _common_ticks(periods: Mapping[str, float | None], unit: str) -> list[int]:
    """Return how many ticks of the channel each period is.

    Raises:
        ProblemError: there is no tick of which all periods are multiples.
    """
    seconds = [period for period in periods.values() if period is not None]
    if not seconds:
        return [1] * len(periods)
    if len(seconds) < len(periods):
        without = next(name for name, period in periods.items() if period is None)
        other = next(name for name, period in periods.items() if period is not None)
        raise ProblemError(
            f"{without} has no plant.dt and {other} looks every {periods[other]:g} s; expected plant.dt in all, for a "
            "common tick"
        )
    if len(set(seconds)) > 1 and unit == "step":
        listed = ", ".join(f"{name} {period:g} s" for name, period in periods.items())
        raise ProblemError(
            f"costs count per step, and the steps have different lengths ({listed}); expected one plant.dt, to add "
            "them up, or plants in continuous time with policy.period"
        )
    exact = [Fraction(period).limit_denominator(FINEST) for period in seconds]
    whole = lcm(*(part.denominator for part in exact))
    steps = [int(part * whole) for part in exact]
    every = [step // gcd(*steps) for step in steps]
    off = any(abs(part / Fraction(period) - 1) > EQUAL for part, period in zip(exact, seconds, strict=True))
    if off or lcm(*every) > LONGEST:
        listed = ", ".join(f"{name} every {period:g} s" for name, period in periods.items())
        raise ProblemError(
            f"the loops look at different times ({listed}), and their looks do not repeat within {LONGEST} common "
            "ticks; expected periods that are multiples of a common tick"
        )
    return every
