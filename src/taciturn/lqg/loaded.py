"""The loads of a simulated plant from step to step: what they add to state, outputs and cost.

A load ℓ that the design does not know is held within a sampling period, as inputs are: a change between two samples
takes effect at the later one. So with an exosystem d (``discrete``), the deviations ξ = x − Xd and μ = u − Ud move by

    dξ = (Aξ + Bμ + Eℓ) dt,   dμ = −U S d dt,   dd = S d dt,   dℓ = 0,

and the cost of a period is a quadratic form in ξ, d, μ and ℓ at its beginning. If the cost is that at the samples, or
the plant is discrete, ℓ has no entry in it. The cost counts the state and the input as they are, not as deviations from
a point at which they would compensate the load: nobody knows it.

Where the design has a state for a disturbance, a load is the movement of this state, which is added to it when the
value changes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from taciturn._arrays import Array, block_diagonal
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete, moved_inputs
from taciturn.lqg.registers import cuts_of, registers_of
from taciturn.lqg.sampling import sample
from taciturn.model.load import SampledLoads
from taciturn.model.plant import ContinuousPlant, Plant


def with_loads(problem: Discrete, plant: Plant | ContinuousPlant) -> Discrete:
    """Return a problem with the loads of the plant of which it was made."""
    loads = plant.loads
    if not loads:
        return problem
    if problem.prediction is not None:
        raise ProblemError(
            "[[disturbance]] states a load, and the actuator predicts between sampling instants; expected a policy "
            "that holds its input, or no load"
        )
    if problem.pieces is not None:
        raise ProblemError(
            "[[disturbance]] states a load, and packets arrive at random within a period; expected delays of whole "
            "periods, a buffer, or no load"
        )
    n, m, p, period = problem.plant.states, problem.plant.inputs, problem.plant.outputs, problem.tick
    rows = 1 + int(max(one.steps(period)[-1] for one in loads))
    hidden = [one for one in loads if one.signal is None]
    joined = [(one, one.signal) for one in loads if one.signal is not None]
    table = [one.at_steps(period, rows) for one in hidden]
    table += [np.diff(one.at_steps(period, rows + 1)) for one, _ in joined]
    E = np.column_stack([*(one.E for one in hidden), np.zeros((len(plant.A), 0))])
    E, cost = _within_a_period(problem, plant, E)
    moves, shown, start = np.zeros((n, len(loads))), np.zeros((p, len(loads))), np.zeros(n)
    moves[: len(E), : len(hidden)] = E
    for i, one in enumerate(hidden):
        shown[: len(one.G), i] = one.G
    first = n - (0 if plant.exosystem is None else len(plant.exosystem.S))
    for i, (one, signal) in enumerate(joined, start=len(hidden)):
        moves[first + signal, i] = 1.0
        start[first + signal] += 0.0 if one.given else one.values[0]
    weights = np.zeros((n + m + len(loads), len(loads)))
    size = n + m + len(hidden)
    weights[:size, : len(hidden)] = cost
    return replace(problem, source=plant, loads=SampledLoads(np.column_stack(table), moves, shown, start, weights))


def _within_a_period(problem: Discrete, plant: Plant | ContinuousPlant, E: Array) -> tuple[Array, Array]:
    """Return the effect of loads on the next state, (n, r), and the entries of the cost for (x, u, ℓ) and ℓ."""
    total, m, r, n, period = problem.plant.states, problem.plant.inputs, E.shape[1], len(plant.A), problem.tick
    nothing = np.zeros((total + m + r, r))
    if isinstance(plant, Plant) or not r:
        return E, nothing
    e, cost, own = plant.exosystem, problem.cost, problem.deviations
    S = np.zeros((0, 0)) if e is None else e.S
    q = len(S)
    keep = ~problem.registers
    T, U = (np.eye(total), np.zeros((m, total))) if own is None else (own.T, own.U)
    drift = np.hstack([np.zeros((m, n)), -moved_inputs(U[:, total - q :], S), np.zeros((m, r))])
    A = block_diagonal(plant.A, S, np.zeros((r, r)))
    A[:n, n + q :] = E
    B, N = (np.vstack([part, np.zeros((q + r, m))]) for part in (plant.B, cost.N))
    Q, none = block_diagonal(cost.Q, np.zeros((q + r, q + r))), np.zeros((n + q + r + m * bool(q),) * 2)
    cuts, held = cuts_of(plant, period), registers_of(plant, period)
    found = sample(A, B, Q, cost.R, N, none, period, drift if q else None, cuts)
    moves = found.A[:n, n + q :]
    if problem.instants:
        return moves, nothing
    # the form in (ξ, d, ℓ, μ) as one in (x, u, ℓ)
    stage = np.block([[found.Q, found.N], [found.N.T, found.R]])
    turned = np.zeros((n + q + r + m * len(cuts), total + m + r))
    turned[: n + q, :total] = T[keep]
    turned[n + q : n + q + r, total + m :] = np.eye(r)
    turned[n + q + r :, :total], turned[n + q + r :, total : total + m] = -np.tile(U, (len(cuts), 1)), held.Gu
    turned[n + q + r :, n : n + len(held.S)] += held.Gz
    return moves, (turned.T @ stage @ turned)[:, total + m :]
