"""The filter of a controller to which measurements come late, lost and in any order: each is fused at its own step.

A measurement y_{k−j} that arrives in step k tells of the state of step k − j. The controller keeps the last D + 1
steps, D the largest delay of a packet in steps: which of their measurements have come, these measurements, and what the
inputs added to the state. It also keeps the estimate x̂ of the step before them and its covariance P, in which all older
measurements that have come are included. In each step it goes back and rolls forward to the present:

    x̂⁻_i = A x̂_{i−1} + b_{i−1},   P⁻_i = A P_{i−1} A' + W,   b_i = B u_i,
    if y_i has come:  x̂_i = x̂⁻_i + P⁻_i C'(C P⁻_i C' + V)⁻¹ (y_i − C x̂⁻_i),   otherwise x̂_i = x̂⁻_i.

This is the filter that had waited: the estimate is E[x_k | all measurements that have arrived], with the gains of the
samples that it has had. The estimate of step k − D is then the one that is kept, as its measurement comes now or
never. The entries of a measurement are fused one after the other, T y with the T that makes their noise
independent, so that only scalars are divided.

The controller must know what its inputs add to the state: they are applied, or acknowledged. If the whole state is
measured, the newest measurement says all of the past, and x̂_k = A^j y_{k−j} + Σ_{i=1}^{j} A^{i−1} b_{k−i}; this holds
also with the mean b of inputs that are lost unnoticed.

Source: schenato2008, sinopoli2004
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._display import Displayed
from taciturn.base.filter import ESTIMATE
from taciturn.errors import ProblemError
from taciturn.model.plant import Plant
from taciturn.model.steps import ONE, Apply, Assign, Received, Step, Terms

MOST = 48  # entries of the states of all steps that a filter keeps; its code grows with their number times the states
EFFECT, EFFECTS = "effect", "past effects"  # what the input of this step, and of earlier ones, adds to the state
PAST, SPREAD, WINDOW = "past estimate", "past covariance", "measurements of past steps"
FUSED = frozenset({ESTIMATE, PAST, SPREAD, WINDOW})  # signals that the filter computes


def fuse_late(plant: Plant, link: str, random: bool, longest: int, key: str) -> tuple[Step, ...]:
    """Return the steps of a filter that fuses all ``y`` of a link, with ``random`` delays of up to ``longest`` steps.

    ``key`` is the key of the delay, for messages.
    """
    n, p, ages = plant.states, plant.outputs, range(longest + 1)
    if (longest + 1) * n > MOST:
        raise ProblemError(
            f"{key} is up to {longest} steps, and the plant has {n} states, so that the filter of late measurements "
            f"would keep {(longest + 1) * n} entries of states; expected at most {MOST}: a law that counts later "
            "packets as lost, or a plant with fewer states"
        )
    heard = list[Step]()
    for age in ages:
        # without random delays, each packet has the age 0
        on, none = Received(link, of_age=age if random else None), np.zeros((p, 1))
        heard += [
            Assign("controller", _sample(age), ({ONE: none}, {"y": np.eye(p)}), on),
            Assign("controller", _came(age), ({ONE: none[:1]}, {ONE: np.ones((1, 1))}), on),
        ]
    fused = LateFilter.of(plant, longest)
    results = {ESTIMATE: n, PAST: n, SPREAD: n * n, WINDOW: fused.kept}
    reads = (PAST, SPREAD, WINDOW, EFFECTS, *map(_sample, ages), *map(_came, ages))
    return (*heard, Apply("controller", results, fused, reads))


def begin_late(plant: Plant) -> dict[str, Array]:
    """Return the memories of the filter before the first step: mean and covariance of the initial state."""
    return {PAST: plant.mean, SPREAD: plant.covariance.ravel()}


def keep_effects(moved: Assign, start: str, count: int) -> tuple[Step, ...]:
    """Return the steps that keep what the inputs of the last steps added to the state, newest first.

    ``moved`` predicts the state from the signal ``start`` and the inputs.
    """
    n = moved.size
    added: list[Terms] = [
        {name: one for name, one in terms.items() if name != start} or {ONE: np.zeros((n, 1))}
        for terms in moved.branches
    ]
    whole = np.eye(count * n)
    effect = Assign(moved.at, EFFECT, added[0] if moved.on is None else tuple(added), moved.on)
    return (effect, Assign(moved.at, EFFECTS, {EFFECTS: np.eye(len(whole), k=-n), EFFECT: whole[:, :n]}))


def rolled_forward(A: Array, measured: str, longest: int) -> list[Mapping[str, Array]]:
    """Return the present state as a sum of the state in a packet and of the effects of inputs, by the packet's age."""
    n = len(A)
    found = list[Mapping[str, Array]]()
    for age in range(longest + 1):
        since = np.zeros((n, longest * n))
        for i in range(age):
            since[:, i * n : (i + 1) * n] = np.linalg.matrix_power(A, i)
        power = {measured: np.linalg.matrix_power(A, age)}
        found.append({**power, EFFECTS: since} if age else power)
    return found


@dataclass(frozen=True, eq=False, repr=False)
class LateFilter(Displayed):
    """Fuses the measurements that arrive in a step at their own steps, and returns the estimate of the present state.

    ``C`` and ``V`` are those of the entries T y, whose noise is independent with the variances ``V``.
    """

    A: Array
    C: Array
    W: Array
    V: Array
    T: Array
    longest: int

    @staticmethod
    def of(plant: Plant, longest: int) -> LateFilter:
        """Return the filter of a plant with outputs, all of which have noise."""
        variances, turn = np.linalg.eigh(symmetrised(plant.V))
        if not variances.min() > 1e-12 * max(float(variances.max()), float(np.abs(plant.W).max())):
            raise ProblemError(
                f"plant.V has the eigenvalue {variances.min():.3g}, and measurements come late or are lost; expected a "
                "positive definite V: a small noise of every output"
            )
        return LateFilter(plant.A, turn.T @ plant.C, plant.W, variances, turn.T, longest)

    @property
    def kept(self) -> int:
        """Number of entries that the filter keeps of past steps besides the estimate and its covariance."""
        return self.longest * (1 + len(self.C)) + self.longest + 1

    def __call__(self, past: Any, spread: Any, window: Any, effects: Any, *arrivals: Any) -> Any:
        """Return the estimate, and what the filter keeps of past steps, from the samples of all ages and their flags.

        The window contains for each age but the largest a flag and a sample, and then for each age whether there was a
        step so long ago.
        """
        n, p, ages = len(self.A), len(self.C), range(self.longest + 1)
        samples, flags = arrivals[: len(ages)], arrivals[len(ages) :]
        first = self.longest * (1 + p)
        known: list[Any] = [flags[0][0]]
        values: list[Any] = [samples[0]]
        begun: list[Any] = [1.0, *(window[first + age] for age in ages)]
        for age in ages[1:]:
            old = window[(age - 1) * (1 + p) : age * (1 + p)]
            known.append(_chosen(flags[age][0] > 0.5, 1.0, old[0]))
            values.append(_chosen(flags[age][0] > 0.5, samples[age], old[1:]))
        x: Any = past
        P: Any = np.reshape(spread, (n, n))
        base = x, P
        for age in reversed(ages):
            moved = self.A @ x + effects[age * n : (age + 1) * n]
            grown = self.A @ P @ self.A.T + self.W
            lived = begun[age + 1] > 0.5
            x, P = _chosen(lived, moved, x), _chosen(lived, (grown + grown.T) / 2, P)
            x, P = self._corrected(x, P, self.T @ values[age], known[age] > 0.5)
            if age == self.longest:
                base = x, P
        kept: list[Any] = []
        for age in ages[:-1]:
            kept += [known[age], *(values[age][i] for i in range(p))]
        return x, base[0], np.reshape(base[1], (n * n,)), np.stack([*kept, *begun[: len(ages)]])

    def _corrected(self, x: Any, P: Any, y: Any, known: Any) -> tuple[Any, Any]:
        """Return estimate and covariance after the entries of a measurement, if it is known."""
        for i, row in enumerate(self.C):
            seen: Any = P @ row
            share: Any = 1.0 / (row @ seen + self.V[i])
            x = _chosen(known, x + seen * (share * (y[i] - row @ x)), x)
            P = _chosen(known, P - share * np.outer(seen, seen), P)
        return x, P


def _chosen(known: Any, new: Any, old: Any) -> Any:
    return cast("Any", np.where(known, new, old))


def _sample(age: int) -> str:
    return f"sample of age {age}"


def _came(age: int) -> str:
    return f"a sample of age {age} has come"
