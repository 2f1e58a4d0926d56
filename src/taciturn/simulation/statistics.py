"""Means with standard errors, from independent paths or from one record of dependent values.

Independent values: the standard error of their mean, merged in batches (``Moments``), reduced by control variates of
mean 0 (the intercept of a least-squares fit), and doubted if the largest values follow a power law (Hill's estimate).

One record: means of long batches, which are nearly independent, or cycles between renewals, which are independent, so
that the mean is a ratio of means, with the standard error of a ratio.

Source: law2015
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, count
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate

_TAIL = 64  # the tail is the largest 1/64 of the values, and must contain at least 64 values
BATCHES = 32
_CYCLES = 30  # least number of cycles for a standard error


class Moments:
    """Mean and variance of values that are added in batches, with constant memory."""

    def __init__(self) -> None:
        """Start without values."""
        self.count, self.center, self.squares = 0, 0.0, 0.0

    def add(self, values: Array) -> None:
        """Add a batch of values by Chan's formula."""
        count, center = len(values), float(values.mean())
        total, shift = self.count + count, center - self.center
        self.squares += float(((values - center) ** 2).sum()) + shift**2 * self.count * count / total
        self.center += shift * count / total
        self.count = total

    def mean(self) -> Estimate:
        """Return the mean of all values added so far, with its standard error."""
        return Estimate(self.center, float(np.sqrt(self.squares / (self.count - 1) / self.count)), "simulation")


def mean(values: Array) -> Estimate:
    """Compute the mean of a quantity over independent paths, and its standard error."""
    moments = Moments()
    moments.add(values)
    return moments.mean()


def controlled_mean(values: Array, controls: Array) -> Estimate:
    """Compute the mean over independent paths. Control variates with mean 0 reduce its variance."""
    # The mean is the intercept of a least-squares fit on the control variates, with the standard error of the
    # intercept.
    spread = controls.std(axis=1)
    fitted = np.column_stack([np.ones(len(values)), (controls[spread > 0] / spread[spread > 0, None]).T])
    _, sizes, directions = np.linalg.svd(fitted, full_matrices=False)
    large = sizes > 1e-9 * sizes[0]  # for two equal loops, every control occurs twice
    inverse = (directions[large].T / sizes[large] ** 2) @ directions[large]
    weights = inverse @ (fitted.T @ values)
    rest = values - fitted @ weights
    variance = float(rest @ rest) / (len(values) - int(large.sum()))
    return Estimate(float(weights[0]), float(np.sqrt(variance * inverse[0, 0])), "simulation")


def tail_index(values: Array) -> float:
    """Estimate the power-law index of the largest values, relative to the median, by Hill's method."""
    # If P(X > x) falls as x^−α, log(X/x_0) of the values above x_0 is exponential with mean 1/α.
    largest = len(values) // _TAIL
    if largest < _TAIL:
        return float(np.inf)
    above = np.sort(values - np.median(values))[-largest - 1 :]
    if not above[0] > 0:
        return float(np.inf)
    spread = float(np.log(above[1:] / above[0]).mean())
    return 1 / spread if spread > 0 else float(np.inf)


def rate_of(values: Array, seen: int, end: float = 0.0) -> Estimate:
    """Compute the mean of observed send rates. Its standard error is at least one event in all observed steps."""
    found = mean(values)
    return Estimate(found.value, float(np.hypot(max(found.standard_error, 1 / seen), end)), found.method)


def batch_means(record: ArrayLike, batches: int = BATCHES) -> Estimate:
    """Compute the mean of one long record. Its standard error takes the correlation of the values into account.

    The record is divided into batches of equal length. The means of the batches are nearly independent if a batch is
    much longer than the correlation time of the record. Values at the start that do not fill a batch are dropped.
    Remove the burn-in before the call.

    Args:
        record: values at successive steps, (steps,), such as the stage cost of a trajectory or of an experiment.
        batches: number of batches, at least 10.

    Returns:
        The mean.

    Raises:
        ProblemError: there are fewer than ten values per batch, or a value is not finite or too large.

    Source: law2015

    Example:
        >>> import numpy as np
        >>> noise = np.random.default_rng(0).normal(size=100_000)
        >>> slow = np.convolve(noise, np.full(50, 1 / 50), "valid")
        >>> bool(batch_means(slow).standard_error > 5 * slow.std() / len(slow) ** 0.5)
        True
    """
    values, batches = array("record", record, (None,), "(ticks,)"), count("batches", batches, 10)
    length = len(values) // batches
    if length < 10:
        raise ProblemError(
            f"record has {number_of(len(values), 'value')} for {batches} batches; expected at least "
            f"{number_of(10 * batches, 'value')}"
        )
    return _in_range(lambda: mean(values[-length * batches :].reshape(batches, length).mean(axis=1)), values)


def regenerative(record: ArrayLike, renewals: ArrayLike) -> Estimate:
    """Compute the mean of one record of a process that restarts at renewals, from the cycles between these.

    The mean is (value per cycle)/(steps per cycle). The cycles are independent, so the standard error is that of a
    ratio. The steps before the first renewal and after the last one are dropped, so no burn-in is needed.

    Args:
        record: values at successive steps, (steps,).
        renewals: 1 or True at the steps where a cycle begins, such as the first step after a send that resets the
            error.

    Returns:
        The mean.

    Raises:
        ProblemError: the sizes differ, renewals contains other numbers than 0 and 1, or there are fewer than 30 cycles.

    Source: law2015

    Example:
        >>> from taciturn import ContinuousPlant, Cost, close, design, simulate
        >>> plant = ContinuousPlant([[0.0]], [[1.0]], [[1.0]])
        >>> path = simulate(close(plant, design.consistent(plant, Cost([[1.0]], [[1.0]]), period=0.5)), 4000)
        >>> found = regenerative(path.sends["sensor"], path.sends["sensor"])
        >>> 0 < found.standard_error < 0.02
        True
    """
    values, begins = array("record", record, (None,), "(ticks,)"), array("renewals", renewals, (None,), "(ticks,)")
    if values.shape != begins.shape:
        raise ProblemError(
            f"record has {number_of(len(values), 'step')} and renewals has {len(begins)}; expected equal lengths"
        )
    if not np.isin(begins, (0, 1)).all():
        raise ProblemError("renewals has entries other than 0 and 1; expected 1 at the start of a cycle, else 0")
    at = np.flatnonzero(begins)
    if len(at) <= _CYCLES:
        raise ProblemError(
            f"record has {max(len(at) - 1, 0)} complete cycles; expected at least {_CYCLES} cycles: use a longer record"
        )

    def found() -> Estimate:
        # to first order, the error of the ratio r of the means of sums and lengths is the mean of sum − r·length over
        # the mean length
        lengths, sums = np.diff(at), np.add.reduceat(values, at)[:-1]
        ratio = float(sums.sum() / lengths.sum())
        rest = sums - ratio * lengths
        error = np.sqrt(float(rest @ rest) / (len(lengths) - 1) / len(lengths)) / float(lengths.mean())
        return Estimate(ratio, float(error), "simulation")

    return _in_range(found, values)


def _in_range(find: Callable[[], Estimate], values: Array) -> Estimate:
    """Return the estimate for a record, if the squares of its values are finite."""
    with np.errstate(all="ignore"), suppress(OverflowError):
        found = find()
        if np.isfinite([found.value, found.standard_error]).all():
            return found
    raise ProblemError(
        f"record contains {np.abs(values).max():.3g}; expected numbers with finite squares: use larger units"
    )
