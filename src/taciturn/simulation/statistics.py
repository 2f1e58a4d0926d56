"""Means and their standard errors: over independent paths, and along one record whose values depend on each other."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, count
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate

TAIL = 64  # values of a tail, and one of so many is of it
BATCHES = 32
CYCLES = 30  # fewer give no standard error


class Moments:
    """Mean and spread of values that come in batches, in constant memory."""

    def __init__(self) -> None:
        """Start with none."""
        self.count, self.center, self.squares = 0, 0.0, 0.0

    def add(self, values: Array) -> None:
        """Merge a batch (Chan's formula)."""
        count, center = len(values), float(values.mean())
        total, shift = self.count + count, center - self.center
        self.squares += float(((values - center) ** 2).sum()) + shift**2 * self.count * count / total
        self.center += shift * count / total
        self.count = total

    def mean(self) -> Estimate:
        """Return the mean of all values with its standard error."""
        return Estimate(self.center, float(np.sqrt(self.squares / (self.count - 1) / self.count)), "simulation")


def mean(values: Array) -> Estimate:
    """Return the mean over independent paths, with its standard error."""
    moments = Moments()
    moments.add(values)
    return moments.mean()


def controlled_mean(values: Array, controls: Array) -> Estimate:
    """Return the mean over independent paths of values, with what controls of mean 0 explain of them taken out.

    It is the intercept of a least-squares fit, and so is its standard error.

    Args:
        values: one per path, (paths,).
        controls: (controls, paths).
    """
    spread = controls.std(axis=1)
    fitted = np.column_stack([np.ones(len(values)), (controls[spread > 0] / spread[spread > 0, None]).T])
    _, sizes, directions = np.linalg.svd(fitted, full_matrices=False)
    large = sizes > 1e-9 * sizes[0]  # of two loops that are one, each control stands there twice
    inverse = (directions[large].T / sizes[large] ** 2) @ directions[large]
    weights = inverse @ (fitted.T @ values)
    rest = values - fitted @ weights
    variance = float(rest @ rest) / (len(values) - int(large.sum()))
    return Estimate(float(weights[0]), float(np.sqrt(variance * inverse[0, 0])), "simulation")


def tail_index(values: Array) -> float:
    """Return Hill's estimate of the index of the power law by which the largest values fall off, above their median.

    Args:
        values: independent, (values,); fewer than 4,096 are too few to tell, and have an infinite index.

    Source: hill1975
    """
    largest = len(values) // TAIL
    if largest < TAIL:
        return float(np.inf)
    above = np.sort(values - np.median(values))[-largest - 1 :]
    if not above[0] > 0:
        return float(np.inf)
    spread = float(np.log(above[1:] / above[0]).mean())
    return 1 / spread if spread > 0 else float(np.inf)


def rate_of(values: Array, seen: int) -> Estimate:
    """Return a mean rate; a send that never or always came in so many steps may still be as rare as one in them."""
    found = mean(values)
    return Estimate(found.value, max(found.standard_error, 1 / seen), found.method)


def batch_means(record: ArrayLike, batches: int = BATCHES) -> Estimate:
    """Return the mean of one long record, with a standard error that allows for correlation along it.

    The record is cut into batches of equal length; their means are nearly independent if a batch is long beside the
    time over which the record forgets. The first values that do not fill them are dropped; so should be the burn-in.

    Args:
        record: values at successive ticks, (ticks,), as the stage cost of a trajectory or of an experiment.
        batches: at least 10.

    Returns:
        The mean.

    Raises:
        ProblemError: fewer than ten values per batch, or values that are not finite, or nearly not.

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
        raise ProblemError(f"record has {len(values)} values for {batches} batches; expected at least {10 * batches}")
    return _in_range(lambda: mean(values[-length * batches :].reshape(batches, length).mean(axis=1)), values)


def regenerative(record: ArrayLike, renewals: ArrayLike) -> Estimate:
    """Return the mean of one record of a process that begins anew at known ticks, by its cycles between them.

    A mean is (value per cycle)/(ticks per cycle); cycles are independent, so its standard error is that of a ratio.
    What precedes the first renewal and follows the last is dropped, so no burn-in is needed.

    Args:
        record: values at successive ticks, (ticks,).
        renewals: 1 or True at the ticks where a cycle begins, as the first tick after a send that resets the error.

    Returns:
        The mean.

    Raises:
        ProblemError: sizes differ, other numbers than 0 and 1, or fewer than 30 cycles.

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
        raise ProblemError(f"record has {len(values)} ticks and renewals has {len(begins)}; expected the same")
    if not np.isin(begins, (0, 1)).all():
        raise ProblemError("renewals has numbers other than 0 and 1; expected 1 where a cycle begins, else 0")
    at = np.flatnonzero(begins)
    if len(at) <= CYCLES:
        raise ProblemError(
            f"record has {max(len(at) - 1, 0)} whole cycles; expected at least {CYCLES}, a longer record"
        )

    def found() -> Estimate:
        lengths, sums = np.diff(at), np.add.reduceat(values, at)[:-1]
        ratio = float(sums.sum() / lengths.sum())
        rest = sums - ratio * lengths
        error = np.sqrt(float(rest @ rest) / (len(lengths) - 1) / len(lengths)) / float(lengths.mean())
        return Estimate(ratio, float(error), "simulation")

    return _in_range(found, values)


def _in_range(find: Callable[[], Estimate], values: Array) -> Estimate:
    """Return what is found of a record, if its squares are numbers."""
    with np.errstate(all="ignore"), suppress(OverflowError):
        found = find()
        if np.isfinite([found.value, found.standard_error]).all():
            return found
    raise ProblemError(
        f"record holds {np.abs(values).max():.3g}, whose square is out of range; expected smaller numbers"
    )
