"""The loop that sends every sample, on the random numbers of a loop that may be silent: its exact cost, and both costs.

Let every decision of a policy choose the option that sends, every packet arrive, and no input be limited. If the plant
is linear, this loop is a linear system z⁺ = F z + G ω with white noise ω of covariance Ω and the stage cost [z; ω]'M[z;
ω], so its average cost is known:

    J_every = tr(P GΩG') + tr(M_ωω Ω),   P = M_zz + F'P F.

Its steps are those of the policy, so its plant, its controller and its noise are those of the loop itself, whether or
not these are the ones of the design. Both loops in one program draw the same numbers, and nearly the same ones make
both expensive. Therefore the mean of the difference of their stage costs has a small variance, and

    J = J_every + E[difference of the stage costs]

without bias, whatever the loop does: J_every is exact for the very program that is subtracted (a control variate with
the coefficient 1). If a loop sends every sample, the difference is 0. In long runs, the coefficient is fitted, together
with those of other control variates (``program.draws``).

A third loop may run on these numbers: the same nodes, which send every sample over the links and through the limits of
the loop itself (``join``). Its cost has no formula, but the difference of the costs has the error of a pair.

The polynomials of the program (``program.quadratic``) give F, G and M. Memories that a packet in every step keeps at
their first value, such as the time since the last packet, are constants. There is no such system over a horizon, with
set-points that change at known times, with matrices that change with time, or if a function of the policy is not linear
although every sample is sent.

Source: henderson2002
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.analyse.switched import BoundedStep, Case, attempt_of
from taciturn.base.value import least_value
from taciturn.errors import ProblemError
from taciturn.loop import COST, Loop
from taciturn.model.network import Network
from taciturn.model.policy import Policy
from taciturn.model.saturation import Saturation
from taciturn.model.signals import SampledChanges
from taciturn.model.steps import Apply, Condition, Draw, Step
from taciturn.model.wire import Encoding
from taciturn.program.draws import with_controls, with_draws
from taciturn.program.ir import Builder, Program, Truth, joined
from taciturn.program.ops import Control, Entry, Name
from taciturn.program.quadratic import as_form, read_polynomials
from taciturn.program.translation import TimeStep

MORE = "more than every sample"  # the sum of the differences of the stage costs
EVERY = "{} with every sample"  # the names of the states of the loop that sends every sample
OVER = "more than the baseline"  # the sum of the differences of the stage costs of a loop and of its baseline
BASELINE = "{} of the baseline"  # the names of the states of the baseline
LESS = Control(-1, -1)  # control variate: the mean of the stage cost with every sample, minus this stage cost
EXACT = 1e-9  # largest relative effect of rounding on a cost that counts as exact
CANCELLED, ROUNDINGS = 4.0, 8.0  # ratio of terms to their sum from which on they cancel; rounding errors of such a sum
STABLE = 1 - 1e-9  # largest modulus of a mode on which the cost of a stable loop depends


@dataclass(frozen=True, eq=False, repr=False)
class WithEverySample(Displayed):
    """A loop and the loop that sends every sample, on the same random numbers."""

    program: Program  # a step of both loops, with the sum MORE and those of the loop
    cost: float  # exact cost per step of the loop that sends every sample
    settling: float  # its time constant in steps


def with_every_sample(loop: Loop, baseline: Loop | None = None) -> WithEverySample | None:
    """Return a loop and the loop that sends every sample, or None if the cost of that loop is not known.

    A ``baseline`` is a third loop in the program.
    """
    always = attempt_of(loop.policy)
    plant = loop.problem.plant
    known = loop.horizon is None and plant.function is None and loop.problem.loads is None and not loop.network.late
    known = known and not isinstance(plant.changes, SampledChanges)
    if always is None or not known or loop.precision != "float64":
        return None
    try:
        program = _program(loop, always, {}, supplied=True)
        kept = _kept(program)
        found = _cost(loop, _program(loop, always, kept, supplied=True) if kept else program)
    except ProblemError:  # a step is not linear
        return None
    if found is None:
        return None
    cost, slowest = found
    every = _program(loop, always, kept)
    sums: dict[Name, tuple[Name | None, Name, float]] = {MORE: (COST, COST, 0.0), LESS: (None, COST, cost)}
    own = with_controls(loop.whole_program())  # products of the states of the other loop would double the work
    whole = join(joined(own, _renamed(every, EVERY), sums), baseline)
    return WithEverySample(with_draws(whole), cost, 1 / (1 - slowest))


def join(program: Program, baseline: Loop | None, states: Set[str] = frozenset()) -> Program:
    """Add a baseline, if there is one, to the program of a loop, whose random numbers are inputs, with the sum OVER.

    The ``states`` of the baseline are kept, whether or not its cost depends on them.
    """
    if baseline is None:
        return program
    other = baseline.whole_program().keep({COST}, states=states)
    kept = {*states, *map(BASELINE.format, states)}
    return joined(program, _renamed(other, BASELINE), {OVER: (COST, COST, 0.0)}, kept)


def _renamed(program: Program, form: str) -> Program:
    """Return a program whose states have other names."""
    return replace(program, states=tuple(replace(state, name=form.format(state.name)) for state in program.states))


def _program(loop: Loop, case: Case, kept: Mapping[Entry, float], supplied: bool = False) -> Program:
    """Return the step of the loop that sends every sample, with its cost as the only sum."""
    begin = partial(_EverySample, loop.policy.kind, case, kept)
    return loop.whole_program(supplied, begin).keep({COST})


def _kept(program: Program) -> dict[Entry, float]:
    """Return the memories that keep their first value, with this value."""
    found = dict[Entry, float]()
    for i, (state, index) in enumerate(zip(program.states, program.following, strict=True)):
        (name, (first, *_)), start = program.ops[index], state.start
        same = name == "const" and program.constants[first] == start
        if not isinstance(start, tuple) and (same or (name == "state" and first == i)):
            found[Entry(state.name, state.index)] = start
    return found


def _cost(loop: Loop, program: Program) -> tuple[float, float] | None:
    """Return the cost per step of a linear loop, and the modulus of its slowest mode; None if it is not stable."""
    plant, states = loop.problem.plant, len(program.states)
    n, p = plant.states, plant.outputs
    unit = np.eye(states + n + p + 1)
    inputs: dict[Name, Array] = {Entry("w", i): unit[states + i] for i in range(n)}
    inputs |= {Entry("v", i): unit[states + n + i] for i in range(p)}
    z, w = slice(0, states), slice(states, states + n + p)
    Omega = np.zeros((n + p, n + p))
    Omega[:n, :n], Omega[n:, n:] = plant.W, plant.V

    def coefficients(sizes: bool) -> tuple[Array, Array]:
        values = read_polynomials(program, states + n + p, inputs, sizes)
        rows = np.array([values[op] for op in program.following]).reshape(states, len(unit))
        return rows, as_form(values[program.sums[COST]])

    def cost(rows: Array, M: Array) -> tuple[float, float]:
        P, slowest = least_value(rows[:, z], M[z, z])
        noise = rows[:, w] @ Omega @ rows[:, w].T
        return float(np.sum(P * noise) + np.sum(M[w, w] * Omega) + M[-1, -1]), slowest

    rows, M = coefficients(sizes=False)
    if rows[:, -1].any() or M[z, -1].any():  # a constant moves the loop
        return None
    found, slowest = cost(rows, M)
    if not slowest < STABLE:
        return None
    # a large D, or units of very different sizes: terms of the coefficients cancel, and their digits are lost
    moved = [value + _lost(value, size) for value, size in zip((rows, M), coefficients(sizes=True), strict=True)]
    other, other_slowest = cost(*moved)
    exact = other_slowest < STABLE and abs(other - found) <= EXACT * abs(found)
    return (found, slowest) if exact else None


def _lost(value: Array, size: Array) -> Array:
    """Return rounding errors of coefficients whose terms cancel, with alternating signs."""
    sign = np.where(np.indices(value.shape).sum(0) % 2, 1.0, -1.0)
    return np.where(size > CANCELLED * np.abs(value), ROUNDINGS * np.finfo(np.float64).eps * sign * size, 0.0)


class _EverySample(BoundedStep):
    """The step of a loop in which every node sends, every packet arrives, and no actuator has limits."""

    def __init__(self, kind: str, case: Case, kept: Mapping[Entry, float], builder: Builder, *rest: Any) -> None:
        """Keep the memories that are constants."""
        super().__init__(kind, case, builder, *rest)
        self._kept = kept

    def draw_losses(self, policy: Policy, network: Network, cuts: tuple[float, ...] = (0.0,)) -> None:
        """Draw the same numbers as the loop itself."""
        TimeStep.draw_losses(self, policy, network)

    def draw_samples(self, network: Network) -> dict[str, Truth]:
        """Take every sample as measured, after the same draws as in the loop itself."""
        TimeStep.draw_samples(self, network)
        return {}

    def take(self, step: Step) -> None:
        """Take limits as absent, and any other function as it is; its result may not be needed."""
        if isinstance(step, Draw):
            self.thresholds.append(self.uniform())
        if isinstance(step, Apply) and isinstance(step.function, Saturation):
            self.signals |= {name: self.read(step.reads[0]) for name in step.signals}
        elif isinstance(step, Apply):
            TimeStep.take(self, step)
        else:
            super().take(step)

    def limited(self, values: Sequence[int], limits: Saturation | None, memory: str) -> list[int]:
        """Apply the input without limits."""
        return super().limited([*values], None, memory)

    def arrives(self, link: str, sent: Truth) -> Truth:
        """Return that the packet arrives, after the same draw as in the loop itself."""
        TimeStep.arrives(self, link, sent)
        return True

    def rounded(self, values: list[int], encoding: Encoding) -> list[int]:
        """Return the numbers of a packet without rounding."""
        return values

    def happened(self, condition: Condition) -> list[Truth]:
        """Return the outcome of the case; a packet of the previous step has arrived."""
        if not isinstance(condition, str) and condition.link not in self.arrived:
            return [False]
        return super().happened(condition)

    def _remember(self, name: str, size: int) -> list[int]:
        """Return the memories of a signal, of which some are constants."""
        found = super()._remember(name, size)
        known = [self._kept.get(Entry(name, i)) for i in range(size)]
        return [op if value is None else self.builder.constant(value) for op, value in zip(found, known, strict=True)]
