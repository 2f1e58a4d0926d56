"""Compare send thresholds on a weighted prediction error with periodic control at the same send rate.

A threshold sends when e'Ψe exceeds the level Y². Its cost can exceed that of periodic control at the same rate, for
example if Ψ weighs other directions of the error than the cost does. For each level, rate and cost of the threshold are
computed, and the exact cost of periodic control at this rate: by simulated cycles for jumps (``cycles``), whose event
times are exact, and by quadrature for Wiener noise, which is checked once per period. The threshold loses if the
difference is beyond four standard errors and the error of the quadrature.

Source: khashooei2017
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from taciturn.design.prediction import refuse_what_is_not_predicted
from taciturn.errors import ProblemError
from taciturn.extend import Array, ArrayLike, Displayed, Panel, Series, Size, StyleName, draw, number, semidefinite
from taciturn.lqg.prediction import PredictionCost, prediction_cost
from taciturn.model.cost import Cost
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant
from taciturn.model.result import Field, Tabular
from taciturn.renewal.chain import Chain
from taciturn.renewal.gaussian import solve_gaussian
from taciturn_events.cycles import estimate_cycles
from taciturn_events.events import JumpProcess, LevelTrigger

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CYCLES = 400_000
LEVELS = 16
SURE = 4.0  # standard errors


@dataclass(frozen=True, repr=False)
class ThresholdPoint(Displayed):
    """Results for one threshold of a trigger, and for periodic control at the same send rate.

    Args:
        level: threshold Y²; the state is sent when e'Ψe exceeds it.
        rate: sends per second.
        cost: cost per second.
        cost_periodic: exact cost of periodic control at this rate.
    """

    level: float
    rate: Estimate
    cost: Estimate
    cost_periodic: float

    @property
    def loses(self) -> bool:
        """Whether the threshold costs more than periodic control, beyond the statistical and quadrature errors."""
        return self.cost.value - SURE * self.cost.standard_error - self.cost.error > self.cost_periodic


@dataclass(frozen=True, repr=False)
class Losses(Tabular):
    """Results of triggers e'Ψe > Y² with the same weight Ψ and ascending thresholds Y².

    Args:
        points: one point for each level.
    """

    FIELDS: ClassVar[tuple[Field[Losses], ...]] = (
        Field("points", lambda found: found.row_documents()),
        Field("rates"),
    )

    points: tuple[ThresholdPoint, ...]

    def table_rows(self) -> Sequence[ThresholdPoint]:
        """Return the thresholds."""
        return self.points

    def row_fields(self) -> tuple[Field[ThresholdPoint], ...]:
        """Return the columns of the table: send rate and cost of each threshold, and cost of fair periodic control."""
        return (
            Field("level", column="level"),
            Field("rate", json=lambda rate: rate.value, column="rate"),
            Field("cost", json=lambda cost: cost.value, column="cost"),
            Field("cost_standard_error", "cost.standard_error"),
            Field("method", "cost.method"),
            Field("cost_periodic", column="cost_periodic"),
            Field("loses"),
        )

    @property
    def rates(self) -> tuple[tuple[float, float], ...]:
        """Ranges of send rates, in ascending order, where every tested threshold costs more than periodic control."""
        ranges: list[tuple[float, float]] = []
        before = False
        for point in sorted(self.points, key=lambda point: point.rate.value):
            if point.loses:
                low = ranges.pop()[0] if before else point.rate.value
                ranges.append((low, point.rate.value))
            before = point.loses
        return tuple(ranges)

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Plot cost against send rate for the thresholds and for periodic control."""
        points = sorted(self.points, key=lambda point: point.rate.value)
        rates = [p.rate.value for p in points]
        series = [
            Series(
                rates,
                [p.cost.value for p in points],
                "threshold",
                error=[p.cost.standard_error for p in points],
                thing="policy",
            ),
            Series(rates, [p.cost_periodic for p in points], "periodic control", thing="periodic control"),
        ]
        lost = [f"{low:.3g} … {high:.3g}" for low, high in self.rates]
        title = f"costs more at the rates {', '.join(lost)}" if lost else "never costs more than periodic control here"
        return draw([Panel(series, "sends per second", "cost per second", title)], ax, figsize, style)


def find_losses(
    plant: ContinuousPlant,
    cost: Cost,
    weight: ArrayLike | None = None,
    *,
    levels: Sequence[float] | None = None,
    period: float | None = None,
    h_max: float = np.inf,
    seed: int = 0,
    cycles: int = CYCLES,
) -> Losses:
    """Compare triggers e'Ψe > Y² on the prediction error with periodic control at the same send rate.

    For jump noise, the error is monitored continuously, with exact event times. For Wiener noise, the error is checked
    once per period, and the cost is computed by quadrature.

    Args:
        plant: continuous-time plant with full state measurement.
        cost: an average cost.
        weight: Ψ, (n, n), semidefinite; default: the identity, that is, the Euclidean norm.
        levels: thresholds Y² > 0; default: means of e'Ψe after intervals from 0.01 to 10 times the shortest time
            constant (at most 1 s) or, with a period, after one to six checks.
        period: seconds between checks; required for Wiener noise, and only for it.
        h_max: longest interval in seconds, for jump noise.
        seed: seed of the random draws.
        cycles: least number of intervals drawn for each threshold.

    Returns:
        Rate and cost of each threshold, and the ranges of rates at which it costs more than periodic control.

    Raises:
        ProblemError: the data are inconsistent, or period is missing or does not apply.
        NoQuadratureError: the dimension is too high for the quadrature.

    Source: khashooei2017

    Example:
        >>> from taciturn import Jumps
        >>> plant = ContinuousPlant([[0.0]], [[1.0]], jumps=Jumps(2.0, [[0.5]]))
        >>> find_losses(plant, Cost([[1.0]], [[1.0]]), levels=[1.0], cycles=10_000).rates  # of one state: none
        ()
    """
    plant = refuse_what_is_not_predicted("find_losses", plant, cost)
    price = prediction_cost(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W)
    Psi = np.eye(plant.states) if weight is None else semidefinite("weight", weight, plant.states, "(states, states)")
    if not np.sum(Psi * price.spread(1.0)) > 0:
        raise ProblemError(
            "weight = 0 for every error that the noise causes, so the policy would never send; expected noise that "
            "causes an error with a positive weight"
        )
    listed = [levels] if isinstance(levels, int | float) else levels
    tried = _levels(price, Psi, period) if listed is None else [number("level", level, 0.0) for level in listed]
    points: list[ThresholdPoint] = []
    for level in tried:
        if plant.jumps is None:
            if np.isfinite(h_max):
                raise ProblemError(
                    "h_max is given with Wiener noise, for which intervals are not limited; expected no h_max"
                )
            rate, excess = _looked_at(price, Psi, level, period)
        else:
            if period is not None:
                raise ProblemError(
                    "period is given, but with jump noise the trigger is checked continuously; expected no period"
                )
            process = JumpProcess(plant.A, plant.jumps, price.S)
            found = estimate_cycles(process, LevelTrigger(Psi, level, h_max), cycles=cycles, seed=seed)
            rate, excess = found.interval.inverse(), found.cost
        points.append(ThresholdPoint(level, rate, excess.scaled(1.0, price.base), price.periodic(1 / rate.value)))
    return Losses(tuple(points))


def _looked_at(price: PredictionCost, Psi: Array, level: float, period: float | None) -> tuple[Estimate, Estimate]:
    """Return rate and cost beyond tr(PW) of a threshold that is checked once per period, for Wiener noise."""
    if period is None:
        raise ProblemError("period is missing; expected the seconds between checks, which Wiener noise requires")
    chain = Chain(price.flow(period), price.spread(period), Psi, level, price.weight(period) / period)
    found = solve_gaussian(chain)
    rate = Estimate(found.rate, 0.0, "quadrature", found.rate_error).scaled(1 / period)
    return rate, Estimate(found.excess, 0.0, "quadrature", found.excess_error).scaled(1.0, price.growth(period))


def _levels(price: PredictionCost, Psi: Array, period: float | None) -> list[float]:
    """Return the means of e'Ψe after intervals of one to six periods, or around the shortest time constant."""
    slowest = 1 / max(float(np.abs(np.linalg.eigvals(price.A)).max(initial=0.0)), 1.0)
    lengths = (
        slowest * np.geomspace(1e-2, 10.0, LEVELS) if period is None else period * np.geomspace(1.0, 6.0, LEVELS // 2)
    )
    return [float(np.sum(Psi * price.spread(h))) for h in lengths]
