"""Regulator equations: the states and inputs for which an output does not react to disturbances and set-points.

The cost counts the deviations ξ = x − Xd and μ = u − Ud from them. Between the samples of a continuous plant, the
disturbance moves on and the input is held, so μ moves too:

    dξ = (Aξ + Bμ) dt + w − X w_d,   dμ = −U S d dt − U w_d,   dd = S d dt + w_d,

and the cost of a period is the integral of the stage cost over this path (``sample``). If a disturbance that
does not decay changes Ud between samples (U S d ≠ 0: a sinusoid, or a ramp that the input must follow), its ripple
costs d'(…)d, which grows without limit, so the integral has no average. The cost is then that of the deviations at the
sampling instants, Σ [ξ; μ]'M_d[ξ; μ], with X and U of the sampled plant and without noise between samples.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from taciturn._arrays import Array, block_diagonal, symmetrised
from taciturn._cycles import paths
from taciturn._exact_modes import Limit, unmoved
from taciturn._modes import SCATTER, balancing, eigenvalues, pace, reach
from taciturn._subspaces import invariant, unit_columns
from taciturn.errors import ProblemError
from taciturn.lqg._followed import Followed
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.intervals import Exact, Source
from taciturn.lqg.quadratic import Quadratic
from taciturn.lqg.sampling import Sampled, sample
from taciturn.model.cost import Cost
from taciturn.model.display import counted_from
from taciturn.model.disturbed import DisturbedDynamics
from taciturn.model.exosystem import Exosystem
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.plant import ContinuousPlant, Plant, derived_plant
from taciturn.model.saturation import limit_entries
from taciturn.model.set_points import Timetable

SOLVED = 1e-9  # relative residual of the equations
BEYOND = 1e-9  # rounding of an input at its limit
CRUMB = 1e-13  # entry of X or U, relative to the largest for the same state of d, that is a rounding error
FREE = 1e-10  # relative singular value below which a direction is free
STILL = 1e-9  # relative rate of change of an input that counts as zero


def regulator_equations(
    A: Array, B: Array, S: Array, E: Array, outputs: Array, F: Array, weight: Array, D: Array | None = None
) -> tuple[Array, Array]:
    """Return X and U with A X + B U + E = X S and C_z X + D_z U + F = 0, of least cost of x = X d and u = U d.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.
        S: (q, q) dynamics of the disturbances and set-points d.
        E: (n, q) effect of d on the state.
        outputs: C_z, (z, n).
        F: (z, q) effect of d on the output.
        weight: [[Q, N], [N', R]], (n + m, n + m), which decides if more than one solution exists.
        D: D_z, the effect of the input on the output, (z, m), or None for zero.

    Raises:
        ProblemError: no input keeps some output at zero.

    Source: francis1977
    """
    (n, m), q = B.shape, len(S)
    state, unit = reach(A, B)  # so that the result does not depend on the units
    units = np.concatenate([state, unit])
    A, B, E = A / state[:, None] * state, B / state[:, None] * unit, E / state[:, None]
    direct = np.zeros((len(outputs), m)) if D is None else D
    both: Array = np.hstack([outputs * state, direct * unit])
    sizes = np.maximum(np.abs(both).max(axis=1, initial=0.0), 1e-300)
    Cz: Array = both[:, :n] / sizes[:, None]
    Dz: Array = both[:, n:] / sizes[:, None]
    F = F / sizes[:, None]
    same: Array = np.eye(q)
    moves = np.hstack([np.kron(same, A) - np.kron(S.T, np.eye(n)), np.kron(same, B)])
    matrix, right = moves, -E.T.ravel()
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    for i in range(-1, len(Cz)):
        if i >= 0:
            row = np.hstack([np.kron(same, Cz[[i]]), np.kron(same, Dz[[i]])])
            matrix, right = np.vstack([matrix, row]), np.concatenate([right, -F[i]])
            found = np.linalg.lstsq(matrix, right, rcond=None)[0]
        if np.abs(matrix @ found - right).max(initial=0.0) > SOLVED * max(1.0, float(np.abs(found).max(initial=0.0))):
            more = "" if D is None else f" + {direct[i].tolist()} u"
            what = "the state" if i < 0 else f"output {i} of the reference, {outputs[i].tolist()} x{more},"
            more = "" if i < m else f" ({i + 1} outputs, {m} inputs)"
            raise ProblemError(
                f"no input keeps {what} free of the disturbances and at its set-point{more}; expected at most as many "
                "reference.outputs as inputs, of which an input affects each, and disturbances that inputs can cancel"
            )
    scaled = weight * np.outer(units, units)
    weights = np.block(
        [
            [np.kron(same, scaled[:n, :n]), np.kron(same, scaled[:n, n:])],
            [np.kron(same, scaled[n:, :n]), np.kron(same, scaled[n:, n:])],
        ]
    )
    _, values, turned = np.linalg.svd(matrix)
    free = np.asarray(turned[int((values > FREE * values.max(initial=1e-300)).sum()) :].T, dtype=np.float64)
    if free.shape[1]:
        found = found - free @ np.linalg.lstsq(free.T @ weights @ free, free.T @ weights @ found, rcond=None)[0]
    X, U = found[: n * q].reshape(q, n).T, found[n * q :].reshape(q, m).T
    solved = np.asarray(np.vstack([X, U]), dtype=np.float64)
    least = CRUMB * _sizes(solved, S)
    X, U = (np.where(np.abs(part) > least, part, 0.0) for part in (X, U))  # the cost has no weight on crumbs of d
    return X * state[:, None], U * unit[:, None]


def _sizes(found: Array, S: Array) -> Array:
    """Return the largest effect of the states of each disturbance, in the units of each of its states, (q,)."""
    unit = balancing(S)
    together = paths(np.asarray((S != 0) | (S.T != 0), dtype=np.bool_))
    largest = np.abs(found * unit).max(axis=0, initial=0.0)
    return np.where(together, largest, 0.0).max(axis=1, initial=0.0) / unit


def has_average(plant: Plant | ContinuousPlant, cost: Cost) -> bool:
    """Return whether the integral of the cost has an average, with an input that is held between samples.

    It has none if a disturbance that does not decay changes the input Ud that it needs between samples. The sums over
    the steps of a discrete plant always have one.

    Args:
        plant: the plant, with its disturbances and set-points.
        cost: the cost per second.
    """
    e = plant.exosystem
    if e is None or isinstance(plant, Plant):
        return True
    return _is_still(_equations(plant, e, cost)[1], e.S)


def _equations(plant: ContinuousPlant, e: Exosystem, cost: Cost) -> tuple[Array, Array]:
    """Return X and U of the plant in continuous time, which do not depend on the sampling period."""
    weights = np.block([[cost.Q, cost.N], [cost.N.T, cost.R]])
    return regulator_equations(plant.A, plant.B, e.S, e.E, e.outputs, e.F, weights, e.D)


def _is_still(U: Array, S: Array) -> bool:
    """Return whether the modes of d that do not decay leave Ud at rest, so that U S d is zero or decays."""
    seen = invariant(unit_columns(_moves(U, S).T), [S.T])
    rates = eigenvalues(seen.T @ S.T @ seen).real
    return not (rates > -SCATTER * pace(S)).any()


def _moves(U: Array, S: Array) -> Array:
    """Return U S, the movement of the input that d needs, without rounding errors of entries that are zero."""
    moved = U @ S
    return np.where(np.abs(moved) > STILL * (np.abs(U) @ np.abs(S)), moved, 0.0)


def joined(base: Discrete, source: Plant | ContinuousPlant, exosystem: Exosystem) -> Discrete:
    """Return the problem of a plant with its disturbances and set-points: its states are (x, d), its cost deviations.

    The cost of a discrete plant is (x − Xd)'Q(x − Xd) + (u − Ud)'R(u − Ud) + 2(x − Xd)'N(u − Ud), with X and U of the
    regulator equations; that of a continuous plant is the integral of these deviations over a period.

    Args:
        base: the problem without them.
        source: the plant before it was sampled.
        exosystem: the disturbances and set-points.
    """
    plant, e = base.plant, exosystem
    n, q, m = plant.states, len(e.S), plant.inputs
    A = before = np.block([[source.A, e.E], [np.zeros((q, n)), e.S]])
    W = np.block([[source.W, np.zeros((n, q))], [np.zeros((q, n)), e.W]])
    B, noise_cost, instants = np.vstack([source.B, np.zeros((q, m))]), base.noise_cost, False
    exact, own = None, None
    weights = np.block([[base.Q, base.N], [base.N.T, base.R]])
    stage = np.insert(np.insert(weights, [n] * q, 0.0, axis=0), [n] * q, 0.0, axis=1)  # of (ξ, d, μ)
    changes = None if e.changes is None else e.changes.sampled(base.tick)
    given = 0 if changes is None else changes.size  # the controller is given the last states
    if isinstance(source, ContinuousPlant):
        fastest = float(np.abs(eigenvalues(e.S).imag).max(initial=0.0))
        if fastest * base.tick >= np.pi:
            raise ProblemError(
                f"a disturbance has the frequency {fastest:g} radians per second, which the sampling period "
                f"{base.tick:g} cannot follow; expected a frequency below π/period = {np.pi / base.tick:.4g}, or a "
                "shorter period"
            )
        none = np.zeros((n + q, n + q))
        sampled = sample(A, B, none, np.zeros((m, m)), np.zeros((n + q, m)), W, base.tick)
        X, U = _equations(source, e, base.cost)
        instants = not _is_still(U, e.S)
        if instants:
            late, acting = sampled.A[n:, n:], sampled.A[:n, n:]
            X, U = regulator_equations(plant.A, plant.B, late, acting, e.outputs, e.F, weights, e.D)
            noise_cost = 0.0
        else:
            within = _within_a_period(source, e, base.cost, X, U, given, base.tick)
            own = Quadratic(within.A, within.B, within.Q, within.R, within.N), within.exact
            noise_cost = within.noise_cost
            stage = np.block([[within.Q, within.N], [within.N.T, within.R]])
        A, W, exact = sampled.A, sampled.W, sampled.exact
    else:
        X, U = regulator_equations(plant.A, plant.B, e.S, e.E, e.outputs, e.F, weights, e.D)
    _expect_reached(plant, U, e)
    seen = np.vstack([np.hstack([plant.C, e.G]), np.eye(n + q)[n + q - given :]])
    _expect_shown(before, seen, n, e, source.continuous)
    deviation = np.eye(n + q + m)
    deviation[:n, n : n + q], deviation[n + q :, n : n + q] = -X, -U
    whole = symmetrised(deviation.T @ stage @ deviation)
    if own is None:
        own = _apart(base, A[n:, n:], e.S)
    deviations = Followed(np.arange(n + q) >= n, deviation[: n + q, : n + q], np.pad(U, ((0, 0), (n, 0))), *own)
    mean, covariance = np.concatenate([plant.mean, e.start]), np.pad(plant.covariance, (0, q))
    point, at_rest = plant.operating_point, np.zeros(q)
    if point is not None:  # set-points are the states that act on nothing but z, in its units
        free = np.where(np.vstack([e.E, e.G]).any(axis=0), 0.0, e.F)
        z = e.outputs @ point.x + (0.0 if e.D is None else e.D @ point.u)
        at_rest += np.linalg.lstsq(free, -z, rcond=None)[0] if free.any() else 0.0
    function = plant.function and DisturbedDynamics.of(plant.function, e.E, e.S, at_rest)
    with_all = derived_plant(
        A, np.vstack([plant.B, np.zeros((q, m))]), W, seen, np.pad(plant.V, (0, given)), plant.dt, mean, covariance,
        plant.input_limit, function, input_rate=plant.input_rate,
    )  # fmt: skip
    object.__setattr__(with_all, "changes", changes)
    if point is not None:
        with_all = counted_from(with_all, OperatingPoint(np.concatenate([point.x, at_rest]), point.u), plant)
    if isinstance(source, Plant):
        object.__setattr__(with_all, "alone", source)
    return replace(
        base, plant=with_all, Q=whole[: n + q, : n + q], N=whole[: n + q, n + q :], noise_cost=noise_cost,
        source=source, instants=instants, exact=exact, deviations=deviations,
    )  # fmt: skip


def _apart(base: Discrete, S: Array, rates: Array) -> tuple[Quadratic, Exact | None]:
    """Return the problem of a plant next to states with dynamics S that cost nothing and move nothing else.

    Args:
        base: the problem of the plant.
        S: the dynamics from step to step.
        rates: the dynamics per second, if the plant was sampled.
    """
    n, none, exact = base.plant.states, np.zeros((len(S), base.plant.inputs)), base.exact
    given = base.quadratic.beside(n, S, none)
    if exact is None:
        return given, None
    before = exact.source
    source = before and Source(before.given.beside(n, rates, none), np.pad(before.W, (0, len(S))), base.tick)
    return given, exact.beside(n, S, none, source)


def _within_a_period(
    plant: ContinuousPlant, e: Exosystem, cost: Cost, X: Array, U: Array, given: int, period: float
) -> Sampled:
    """Return the problem of the deviations (ξ, d) with the input μ over a period; only its weights and cost are used.

    Args:
        plant: the plant.
        e: its disturbances and set-points.
        cost: the cost per second.
        X, U: the states and inputs from which the deviations count.
        given: number of set-points, the last states of d, that change; they do so at sampling instants only.
        period: seconds.
    """
    (n, m), q = plant.B.shape, len(e.S)
    rest = np.zeros((q, q))
    moves = np.where(np.arange(q) < q - given, e.W, 0.0)
    moves[q - given :] = 0.0
    noise = np.vstack([-X, np.eye(q), -U])
    W = symmetrised(noise @ moves @ noise.T + block_diagonal(plant.W, np.zeros((q + m, q + m))))
    D = np.hstack([np.zeros((m, n)), -_moves(U, e.S)])
    B, N = (np.vstack([part, np.zeros((q, m))]) for part in (plant.B, cost.N))
    A, Q = block_diagonal(plant.A, e.S), block_diagonal(cost.Q, rest)
    return sample(A, B, Q, cost.R, N, W, period, D)


def beyond_limits(plant: Plant | ContinuousPlant, needed: Array) -> ProblemError:
    """Return the error that a set-point needs an input beyond the limits of a plant, in the units of the plant.

    Args:
        plant: the plant, in deviations from its operating point.
        needed: the input, (m,).
    """
    assert plant.input_limit is not None, "only limits can be exceeded"
    rest = np.zeros(len(needed)) if plant.operating_point is None else plant.operating_point.u
    return ProblemError(
        f"the set-point needs the input {(needed + rest).round(4).tolist()}, beyond the input_limit "
        f"{limit_entries(plant.input_limit + rest[:, None])}; expected a set-point within the limits"
    )


def _expect_reached(plant: Plant, U: Array, exosystem: Exosystem) -> None:
    """Raise an error if a set-point, at the start or of a timetable, needs an input beyond its limits."""
    limit, changes, points = plant.input_limit, exosystem.changes, exosystem.start[None]
    if limit is None:
        return
    if isinstance(changes, Timetable):
        moved = changes.values - changes.values[0]
        points = points + np.pad(moved, ((0, 0), (points.shape[1] - changes.size, 0)))
    for needed in points @ U.T:
        if ((needed < limit[:, 0] - BEYOND) | (needed > limit[:, 1] + BEYOND)).any():
            raise beyond_limits(plant, needed)


def _expect_shown(A: Array, C: Array, states: int, exosystem: Exosystem, continuous: bool) -> None:
    """Raise an error if the outputs show all modes of a plant, but not those of its disturbances.

    Args:
        A: dynamics of (x, d), before they were sampled.
        C: outputs of (x, d).
        states: number of states x.
        exosystem: the disturbances, and set-points, which are known.
        continuous: whether A is continuous in time.
    """
    unknown = np.vstack([exosystem.E, exosystem.G, exosystem.W]).any(axis=0)
    keep = np.concatenate([np.ones(states, dtype=np.bool_), unknown])
    plant = np.arange(len(A)) < states
    hidden = (unmoved(A[np.ix_(some, some)].T, C[:, some].T, Limit(continuous), True).lasting for some in (plant, keep))
    if not next(hidden).size and next(hidden).size:
        raise ProblemError(
            f"the measured outputs ({len(exosystem.G)}) do not show every disturbance ({int(unknown.sum())} states); "
            "expected disturbances with different effects on the outputs, at most one constant for each output: remove "
            "a disturbance, or add a sensor"
        )
