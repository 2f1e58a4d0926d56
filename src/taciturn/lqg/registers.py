"""Registers: states that hold earlier inputs and outputs, for late inputs, old outputs, and outputs that show inputs.

An input that acts d + r periods after it was commanded, with a whole number d and 0 ≤ r < 1, acts from kh + rh on until
the next one does. Within a period, the input before it acts first,

    u_{k−d−1} in [0, r),   u_{k−d} in [r, 1)   (in periods).

The parts r of all inputs cut a period into pieces, for which ``sample`` integrates plant and cost exactly, as a problem
whose inputs are those of each piece, a = (a_0, a_1, …). Chains of registers hold the commands, z₁⁺ = u, z₂⁺ = z₁, …, so
a = G_z z + G_u u, and the problem in (x, z) and u has

    x⁺ = A x + B (G_z z + G_u u) + w,   stage [x; G_z z + G_u u]' M [x; G_z z + G_u u],

in general with a cross term between z and u. If packets arrive at random times, another input u_i may act in each piece
(``Pieces``). A sensor takes its sample before the input changes, so

    y_k = C x_k + D û_{k−1} + v_k

shows the input that acts just then, which is in a register as well (with r = 0: z_{d+1}).

An output that is o steps older than others has registers of its own, of the measurement and not of Cx: the noise v is
in them, so ζ₁⁺ = C x + v, ζ₂⁺ = ζ₁, …, and y = ζ_o is read exactly. If V correlates outputs of different age, their
noise ν⁺ ~ N(0, V) is a state, so that no noise moves the state and shows at once.

With an exosystem d, the input Ud that costs nothing must act when d is d_k, so a command needs U Sᵈ d, and register z_j
of this input U Sᵈ⁻ʲ d. In deviations from these values, the registers have the same dynamics. Registers stand after
the states x and before the signals d. Filters, regulators and programs treat them as all states.

Source: astrom1997computer
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, NoReturn

import numpy as np

from taciturn._arrays import Array, frozen
from taciturn._display import Displayed
from taciturn._modes import closure
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.lqg.enclosures import E, block
from taciturn.lqg.followed import Followed
from taciturn.lqg.quadratic import Quadratic, placed
from taciturn.lqg.sampling import Exact, Step
from taciturn.model.delay import WHOLE
from taciturn.model.dynamics import Dynamics
from taciturn.model.operating_point import MovedDynamics, OperatingPoint
from taciturn.model.plant import ContinuousPlant, Plant, altered, counted_from, derived_plant

MOST = 200  # registers of a plant


class Registers(NamedTuple):
    """Registers of a plant with m inputs and p outputs, for q pieces of a period: a = G_z z + G_u u, z⁺ = S z + P u."""

    S: Array  # (r, r)
    P: Array  # (r, m)
    Gz: Array  # inputs that act in each piece, of the registers, (qm, r)
    Gu: Array  # inputs that act in each piece, of the command, (qm, m)
    shown: Array  # outputs of the registers, (p, r)
    old: tuple[tuple[int, int], ...]  # outputs that are old, each with the register that takes it up
    V: Array  # noise of the outputs that remains, (p, p)
    W: Array  # noise of the registers, (r, r)
    inputs: tuple[int, ...]  # input that each of the first registers holds
    outputs: tuple[int, ...]  # output that each of the next registers holds
    noises: tuple[int, ...]  # output whose noise each of the last registers holds
    ages: tuple[int, ...]  # steps since the command, of each of the first registers
    late: tuple[int, ...]  # whole periods after which each input acts

    def names(self, inputs: Sequence[str], outputs: Sequence[str]) -> list[str]:
        """Write what each register holds, from the labels of inputs and outputs, such as "u1, 2 steps ago"."""
        held = [f"{inputs[i]}, {number_of(age, 'step')} ago" for i, age in zip(self.inputs, self.ages, strict=True)]
        for place, j in enumerate(self.outputs):
            held.append(f"{outputs[j]}, {number_of(place - self.outputs.index(j) + 1, 'step')} ago")
        return [*held, *(f"noise of {outputs[j]}" for j in self.noises)]

    def taking(self, C: Array) -> Array:
        """Return how the registers take up outputs C x, as a matrix that multiplies the states, (r, n)."""
        found = np.zeros((len(self.S), C.shape[1]))
        for output, place in self.old:
            found[place] = C[output]
        return found


def fed_inputs(plant: Plant | ContinuousPlant) -> list[int]:
    """Return the indices of the inputs with a direct feedthrough to an output, whose columns of D are not zero."""
    return [] if plant.D is None else np.flatnonzero(plant.D.any(axis=0)).tolist()


def cuts_of(plant: Plant | ContinuousPlant, period: float, cuts: Sequence[float] = ()) -> tuple[float, ...]:
    """Return the parts of a period from which on another input may act: those of late inputs, and further ones."""
    acts = np.zeros(0) if plant.transport is None else plant.transport.periods(period)[0]
    parts = sorted({0.0, *cuts, *(acts - np.floor(acts)).tolist()})
    return tuple(part for i, part in enumerate(parts) if i == 0 or part - parts[i - 1] > WHOLE)


def registers_of(source: Plant | ContinuousPlant, period: float, cuts: Sequence[float] = ()) -> Registers:
    """Return the registers that delays and a direct feedthrough of a plant need."""
    m, p, fed = source.inputs, len(source.C), fed_inputs(source)
    acts, older = (np.zeros(m), (0,) * p) if source.transport is None else source.transport.periods(period)
    if acts.max(initial=0.0) + max(older, default=0) > MOST:  # before the numbers become those of registers
        _refuse(f"more than {MOST}")
    whole, parts = np.floor(acts).astype(int), acts - np.floor(acts)
    depths = [int(d) + int(part > 0 or i in fed) for i, (d, part) in enumerate(zip(whole, parts, strict=True))]
    noises = _correlated(source.V, older)
    inputs = tuple(i for i, depth in enumerate(depths) for _ in range(depth))
    ages = tuple(age for depth in depths for age in range(1, depth + 1))
    outputs = tuple(j for j, age in enumerate(older) for _ in range(age))
    first = np.cumsum([0, *depths])  # place of the newest register of each input
    begins = len(inputs) + np.cumsum([0, *older])  # and of each output
    noisy = len(inputs) + len(outputs)  # place of the first noise that is a state
    r = noisy + len(noises)
    if r > MOST:
        _refuse(str(r))
    S, P, ahead, before = np.zeros((r, r)), np.zeros((r, m)), np.zeros((m, r)), np.zeros((m, r))
    direct = np.diag((whole == 0).astype(np.float64))
    for i, depth in enumerate(depths):
        place = int(first[i])
        if depth:
            P[place, i] = 1.0
            S[range(place + 1, place + depth), range(place, place + depth - 1)] = 1.0
        if whole[i]:
            ahead[i, place + whole[i] - 1] = 1.0
        if depth > whole[i]:
            before[i, place + whole[i]] = 1.0
    waits = [(parts > cut + WHOLE)[:, None] for cut in cuts_of(source, period, cuts)]  # by piece, for the last command
    Gz = np.vstack([np.where(wait, before, ahead) for wait in waits])
    Gu = np.vstack([np.where(wait, 0.0, direct) for wait in waits])
    shown, V, W = np.zeros((p, r)), source.V.copy(), np.zeros((r, r))
    if source.D is not None:
        shown += source.D @ before
    for place, j in enumerate(noises, start=noisy):
        shown[j, place] = 1.0
    W[noisy:, noisy:] = source.V[np.ix_(noises, noises)]
    V[noises], V[:, noises] = 0.0, 0.0
    old = [j for j, age in enumerate(older) if age]
    for j in old:  # the first register takes up C x, the D û and the noise that are states, and the noise that is not
        S[begins[j]] = shown[j]
        S[range(begins[j] + 1, begins[j + 1]), range(begins[j], begins[j + 1] - 1)] = 1.0
        shown[j] = np.eye(r)[begins[j + 1] - 1]
    W[np.ix_(begins[old], begins[old])] = V[np.ix_(old, old)]
    V[old], V[:, old] = 0.0, 0.0
    took = tuple((j, int(begins[j])) for j in old)
    late = tuple(int(d) for d in whole)
    return Registers(S, P, Gz, Gu, shown, took, V, W, inputs, outputs, tuple(noises), ages, late)


def _refuse(registers: str) -> NoReturn:
    raise ProblemError(
        f"the delays of the links need {registers} registers for earlier inputs and outputs; expected at most {MOST}: "
        "shorter delays, or a longer period"
    )


def _correlated(V: Array, older: Sequence[int]) -> list[int]:
    """Return the outputs whose noise is correlated with that of an output of another age, directly or by others."""
    ages = np.array(older)
    joint = np.asarray(V != 0, dtype=np.bool_)
    apart = np.asarray((joint & (ages[:, None] != ages)).any(axis=1), dtype=np.bool_)
    return np.flatnonzero(closure(apart, joint)).tolist() if apart.any() else []


@dataclass(frozen=True, eq=False, repr=False)
class Pieces(Displayed):
    """A problem whose input may be another one in each piece of a period: u_0, u_1, …, one after the other."""

    cuts: tuple[float, ...]  # the parts of a period at which the pieces begin
    B: Array  # (n, qm)
    N: Array  # weights of the step, with Q of the problem: (n, qm) and (qm, qm)
    R: Array


def in_deviations(own: Followed, n: int, found: Registers, A: Array, inputs: int, takes: Array) -> Followed:
    """Extend a problem in deviations. A register of an input deviates from the value that the signals then need."""
    kept, new = placed(len(own.T), n, len(found.S))
    d = own.states
    needed, S = own.U[-inputs:, d], A[np.ix_(d, d)]  # by the signals, of the inputs that act
    later = [np.linalg.matrix_power(S, late) for late in range(max(found.late, default=0) + 1)]
    offsets = np.zeros((len(found.S), len(S)))
    for place, (i, age) in enumerate(zip(found.inputs, found.ages, strict=True)):
        if age <= found.late[i]:
            offsets[place] = needed[i] @ later[found.late[i] - age]
        elif len(found.Gz) > inputs:  # the input that still acts at the beginning of a period
            offsets[place] = needed[i]
    U = np.zeros((inputs, len(own.T)))
    U[:, d] = [needed[i] @ later[late] for i, late in enumerate(found.late)]
    return replace(
        own,
        states=np.insert(d, [n] * len(found.S), np.zeros(len(found.S), dtype=np.bool_)),
        T=kept @ own.T @ kept.T + new @ new.T - new @ offsets @ kept[:, d].T,
        U=U @ kept.T,
        problem=extend(own.problem, n, found, takes),
        exact=own.exact and Exact(Extended(own.exact, n, found, takes)),
    )


def extend(given: Quadratic, place: int, by: Registers, takes: Array) -> Quadratic:
    """Extend a regulator problem, whose inputs are those that act, by registers from the state ``place`` on."""
    kept, new = placed(len(given.A), place, len(by.S))
    A, B, Q, R, N = given
    z = new @ by.Gz.T
    return Quadratic(
        kept @ A @ kept.T + kept @ B @ z.T + new @ by.S @ new.T + new @ takes @ kept.T,
        kept @ B @ by.Gu + new @ by.P,
        kept @ Q @ kept.T + kept @ N @ z.T + z @ N.T @ kept.T + z @ R @ z.T,
        by.Gu.T @ R @ by.Gu,
        kept @ N @ by.Gu + z @ R @ by.Gu,
    )


@dataclass(frozen=True, eq=False, repr=False)
class Extended(Displayed):
    """The problem of ``extend`` in any arithmetic, with the noise of the registers."""

    exact: Exact
    place: int
    by: Registers
    takes: Array

    def __call__(self, arithmetic: type[E], /) -> Step[E]:
        """Return enclosures of the problem."""
        step, by, exact = self.exact(arithmetic), self.by, arithmetic.exact
        before, after, every = slice(self.place), slice(self.place, None), slice(None)

        def rows(matrix: E, between: E) -> E:
            parts = [matrix.part(before, every), between, matrix.part(after, every)]
            return block([[part] for part in parts if part.shape[0]])

        def columns(matrix: E, between: E) -> E:
            return rows(matrix.T, between.T).T

        Gz, Gu, none = exact(by.Gz), exact(by.Gu), exact(np.zeros(self.takes.shape))
        cross = step.N @ Gz
        A = rows(columns(step.A, step.B @ Gz), columns(exact(self.takes), exact(by.S)))
        Q = rows(columns(step.Q, cross), columns(cross.T, (Gz.T @ step.R @ Gz).symmetric()))
        W = rows(columns(step.W, none.T), columns(none, exact(by.W)))
        B, N = rows(step.B @ Gu, exact(by.P)), rows(step.N @ Gu, Gz.T @ step.R @ Gu)
        return Step(A, B, Q, (Gu.T @ step.R @ Gu).symmetric(), N, W, step.c)


def registered(plant: Plant, source: Plant | ContinuousPlant, found: Registers) -> Plant:
    """Extend a sampled plant, whose inputs are those that act, by registers."""
    n, given = source.states, plant.outputs - len(source.C)  # set-points that are outputs
    kept, new = placed(plant.states, n, len(found.S))
    z, takes = new @ found.Gz.T, found.taking(plant.C)
    A = kept @ plant.A @ kept.T + kept @ plant.B @ z.T + new @ found.S @ new.T + new @ takes @ kept.T
    W, mean = kept @ plant.W @ kept.T + new @ found.W @ new.T, kept @ plant.mean + new @ takes @ plant.mean
    C, noises = plant.C.copy(), new[:, len(found.S) - len(found.noises) :]
    C[[output for output, _ in found.old]] = 0.0
    covariance = kept @ plant.covariance @ kept.T
    covariance += noises @ source.V[np.ix_(found.noises, found.noises)] @ noises.T
    rate = source.input_rate
    if rate is not None and plant.dt is not None and not isinstance(source, Plant):
        rate = plant.dt * rate
    result = derived_plant(
        A, kept @ plant.B @ found.Gu + new @ found.P, W, C @ kept.T + np.pad(found.shown, ((0, given), (0, 0))) @ new.T,
        np.pad(found.V, (0, given)), plant.dt, mean, covariance, source.input_limit,
        plant.function and RegisteredDynamics.of(plant.function, n, found, source), input_rate=rate,
    )  # fmt: skip
    more: dict[str, object] = {"changes": plant.changes, "registers": found.inputs}
    more |= {"stored": (*found.outputs, *found.noises), "alone": source if isinstance(source, Plant) else None}
    return counted_from(altered(result, more), plant, lambda at: rest_with(at, n, found, source))


def rest_with(at: OperatingPoint, n: int, found: Registers, source: Plant | ContinuousPlant) -> OperatingPoint:
    """Return an operating point with the values of the registers at rest."""
    return OperatingPoint(np.insert(at.x, [n] * len(found.S), resting(at, n, found, source)), at.u)


def resting(at: OperatingPoint, n: int, found: Registers, source: Plant | ContinuousPlant) -> Array:
    """Return the values of the registers at an operating point, (r,)."""
    outputs = source.C @ at.x[:n] + (0.0 if source.D is None else source.D @ at.u)
    return np.concatenate([at.u[[*found.inputs]], outputs[[*found.outputs]], np.zeros(len(found.noises))])


def with_inputs_before(plant: Plant, place: int, before: Array) -> Plant:
    """Set the initial values of a plant's registers, which begin at state ``place``, to the given inputs, (m,)."""
    mean = plant.mean.copy()
    mean[place : place + len(plant.registers)] = before[[*plant.registers]]
    return altered(plant, {"mean": frozen(mean)})


@dataclass(frozen=True, eq=False, repr=False)
class RegisteredDynamics(Displayed):
    """A step function extended by registers. The other states follow f((x, d), input that acts, (w, w_d))."""

    dynamics: Dynamics  # f
    place: int  # number of states before the registers
    registers: Registers
    takes: Array  # outputs that registers take up, of the states before them, (r, n)

    def __call__(self, x: Any, u: Any, w: Any) -> Any:
        """Return the next states of the plant, with the registers among them."""
        found, n = self.registers, self.place
        end = n + len(found.S)
        own, z = np.array([*range(n), *range(end, len(x))]), x[n:end]
        acting = [_sum((row, z), (direct, u)) for row, direct in zip(found.Gz, found.Gu, strict=True)]
        moved: list[Any] = list(self.dynamics.function(x[own], np.array(acting), w[own]))
        noisy = np.diag(np.diag(found.W) > 0.0).astype(np.float64)
        rows = zip(found.S, self.takes, found.P, noisy, strict=True)
        stored = [_sum((S, z), (taken, x), (P, u), (noise, w[n:end])) for S, taken, P, noise in rows]
        return np.array([*moved[:n], *stored, *moved[n:]])

    @staticmethod
    def of(function: Dynamics, place: int, found: Registers, source: Plant | ContinuousPlant) -> Dynamics:
        """Extend a plant's step function by registers, and shift it to the same operating point as before."""
        moved, takes = function.function, found.taking(source.C)
        if not isinstance(moved, MovedDynamics):
            return Dynamics(RegisteredDynamics(function, place, found, takes))
        values = resting(OperatingPoint(moved.x, moved.u), place, found, source)
        x, to = (np.insert(one, [place] * len(values), values) for one in (moved.x, moved.rest))
        inner = RegisteredDynamics(moved.dynamics, place, found, takes)
        return Dynamics(MovedDynamics(Dynamics(inner), x, moved.u, to))


def _sum(*terms: tuple[Array, Any]) -> Any:
    """Return the sum of products of the nonzero numbers of rows with entries of vectors that a program computes."""
    found: Any = None
    for row, values in terms:
        for factor, value in zip(row.tolist(), values, strict=False):
            if factor:
                one = value if factor == 1.0 else factor * value
                found = one if found is None else found + one
    return 0.0 if found is None else found
