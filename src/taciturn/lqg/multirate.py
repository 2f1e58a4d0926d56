"""Optimal control over several links that send at fixed steps, each with a period and a phase of its own.

A packet of a sensor contains all its measurements so far. So the error covariance of the estimate at a step depends
only on the age of the last packet of each sensor: it is that of the Kalman filter of all sensors at the oldest of these
packets, continued with the measurements of the sensors whose packets are newer. A packet to an actuator contains an
input that the actuator holds, or the inputs of all steps until the next packet. Both are states of a periodic linear
quadratic problem. Since the information of the controller does not depend on its inputs, the optimal gains are those of
a known state, and the error of the estimate adds tr(L'HL P).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import lcm
from typing import NamedTuple

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._display import Displayed
from taciturn.errors import UnstableError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.quadratic import Quadratic
from taciturn.lqg.queries import Predictor
from taciturn.model.network import Network

SETTLED = 1e-11  # relative change of the cost-to-go over a cycle at which it is stationary
LARGEST = 1e12  # growth of the cost-to-go at which a cycle counts as unstable
MOST_STEPS = 20_000  # steps of the backward iteration


class Timing(NamedTuple):
    """The steps at which a link sends: ``phase``, ``phase + period``, …

    Args:
        period: steps from one packet to the next.
        phase: first step, less than the period.
    """

    period: int
    phase: int = 0

    def age(self, step: int) -> int:
        """Return the number of steps since the last packet."""
        return (step - self.phase) % self.period


@dataclass(frozen=True, eq=False, repr=False)
class MultirateControl(Displayed):
    """The least cost of control over links that send at fixed steps.

    Args:
        problem: the discrete-time problem, with an average cost.
        network: the nodes and links, which deliver every packet; a node without a link sends in every step.
        plans: whether a packet to an actuator contains the inputs until the next packet, or one input that is held.

    Example:
        >>> from taciturn.lqg.discrete import discretise
        >>> from taciturn.model.cost import Cost
        >>> from taciturn.model.plant import Plant
        >>> found = discretise(Plant([[2.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), None)
        >>> control = MultirateControl(found, Network(), plans=False)
        >>> round(control.cost({"sensor": Timing(1), "actuator": Timing(2)}), 6)
        12.788306
    """

    problem: Discrete
    network: Network
    plans: bool

    def cost(self, timings: Mapping[str, Timing]) -> float:
        """Return the least cost, in the units of the problem, of links with given timings.

        Raises:
            UnstableError: the plant cannot be stabilised with these timings, as far as the iteration shows.
        """
        inputs = tuple(timings[link] for link in self._linked)
        sensors = tuple(timings[link] for link in self._heard)
        if inputs not in self._known:
            self._known[inputs] = self._regulated(inputs)
        values, squares = self._known[inputs]
        total = sum(float(np.sum(value * self.problem.plant.W)) for value in values) / len(values)
        steps = lcm(len(squares), *(one.period for one in sensors))
        errors = [self._error(tuple(one.age(step) for one in sensors)) for step in range(steps)]
        total += sum(float(np.sum(squares[k % len(squares)] * error)) for k, error in enumerate(errors)) / steps
        return self.problem.per_unit(total)

    @cached_property
    def _known(self) -> dict[tuple[Timing, ...], tuple[list[Array], list[Array]]]:
        return {}

    @cached_property
    def _covariances(self) -> dict[tuple[int, ...], Array]:
        return {}

    @cached_property
    def _measured(self) -> Mapping[str, list[int]]:
        """The outputs that each node measures."""
        plant = self.problem.plant
        measured = self.network.measurements(plant.sensed, plant.set_points)
        return {node: [*held] for node, held in measured.values()}

    @cached_property
    def _applied(self) -> Mapping[str, list[int]]:
        """The inputs that each node applies."""
        return {node: [*held] for node, held in self.network.applications(self.problem.plant.inputs).values()}

    @cached_property
    def _heard(self) -> list[str]:
        return [node for node in self._measured if node in self.network.links]

    @cached_property
    def _linked(self) -> list[str]:
        return [node for node in self._applied if node in self.network.links]

    def _error(self, ages: tuple[int, ...]) -> Array:
        """Return the error covariance of the estimate, given the age of the last packet of each sensor."""
        if ages not in self._covariances:
            plant, oldest = self.problem.plant, max(ages, default=0)
            known = dict(zip(self._heard, ages, strict=True))
            found = steady_filter(plant.A, plant.C, plant.W, plant.V).posterior
            for step in range(1, oldest + 1):
                found = plant.A @ found @ plant.A.T + plant.W
                newer = [node for node in self._measured if known.get(node, 0) <= oldest - step]
                seen = [i for node in newer for i in self._measured[node]]
                if seen:
                    found = symmetrised(found - Predictor(plant, seen).correction(found) @ plant.C[seen] @ found)
            self._covariances[ages] = found
        return self._covariances[ages]

    def _regulated(self, timings: tuple[Timing, ...]) -> tuple[list[Array], list[Array]]:
        """Return, for each step of a cycle, the cost-to-go of the state after it, and L'HL of the step.

        Raises:
            UnstableError: the cost-to-go does not become stationary.
        """
        cycle, n = lcm(1, *(one.period for one in timings)), self.problem.plant.states
        steps = [self._step(timings, step) for step in range(cycle)]
        K, size = np.zeros(steps[0].A.shape), 1.0
        values, squares = [K] * cycle, [K] * cycle
        for _ in range(max(2, MOST_STEPS // cycle)):
            before = K
            for step in reversed(range(cycle)):
                values[step] = K[:n, :n]
                K, saved = steps[step].back(K)
                squares[step] = saved[:n, :n]
            size = float(np.abs(K).max())
            if not np.isfinite(size) or size > LARGEST * max(1.0, float(np.abs(self.problem.Q).max())):
                break
            if float(np.abs(K - before).max()) <= SETTLED * size:
                return values, squares
        named = ", ".join(f"{link} every {one.period} steps" for link, one in zip(self._linked, timings, strict=True))
        raise UnstableError(f"the plant is not stabilised by packets {named}; expected shorter periods")

    def _step(self, timings: tuple[Timing, ...], step: int) -> Quadratic:
        """Return the transition, inputs and weights of a step, over the state x and the inputs of later steps."""
        plant, A, B = self.problem.plant, self.problem.plant.A, self.problem.plant.B
        n, m = plant.states, plant.inputs
        kept = [one.period - 1 if self.plans else min(one.period - 1, 1) for one in timings]
        sizes = [len(self._applied[node]) * count for node, count in zip(self._linked, kept, strict=True)]
        states, at = n + sum(sizes), n
        from_state, columns = np.zeros((m, states)), list[tuple[Array, Array]]()  # of u, and of the kept inputs
        stays = np.zeros((states, states))
        for node in (node for node in self._applied if node not in self._linked):
            columns.append((np.eye(m)[:, self._applied[node]], np.zeros((states, len(self._applied[node])))))
        for node, timing, size in zip(self._linked, timings, sizes, strict=True):
            held, width = np.eye(m)[:, self._applied[node]], len(self._applied[node])
            place = slice(at, at + size)
            if timing.age(step) == 0:
                count = 1 + size // width if self.plans else 1
                chosen = np.zeros((m, count * width))
                chosen[:, :width] = held
                later = np.zeros((states, count * width))
                later[place] = np.eye(size, count * width, k=width) if self.plans else np.eye(size, width)
                columns.append((chosen, later))
            else:
                from_state[:, at : at + width] = held
                stays[place, place] = np.eye(size, k=width) if self.plans else np.eye(size)
            at += size
        given = np.hstack([one for one, _ in columns]) if columns else np.zeros((m, 0))
        stored = np.hstack([one for _, one in columns]) if columns else np.zeros((states, 0))
        F, G = stays.copy(), stored.copy()
        F[:n, :n] = A
        F[:n] += B @ from_state
        G[:n] += B @ given
        M = np.block([[self.problem.Q, self.problem.N], [self.problem.N.T, self.problem.R]])
        whole = np.block([
            [np.eye(n, states), np.zeros((n, given.shape[1]))],
            [from_state, given],
        ])  # fmt: skip
        M = symmetrised(whole.T @ M @ whole)
        x, v = slice(states), slice(states, None)
        return Quadratic(F, G, M[x, x], M[v, v], M[x, v])
