"""All that moves a plant besides Gaussian noise, as operations of a program: jumps, set-points that change, and loads.

**Jumps.** Between jumps the state follows dx/dt = A x. A jump at time t adds Gξ, where GG' is the covariance of a jump,
and ξ has independent entries of mean 0 and variance 1. At the end τ of the step its contribution is

    e^{A(τ − t)} G ξ = e^{Aτ/2} e^{A(τ/2 − t)} G ξ.

|τ/2 − t| ≤ τ/2 halves the argument of the power series, and e^{Aτ/2} is applied once, to the sum of all jumps. A
program has no loops, so a fixed number of jumps is drawn, and jumps after the end of the step are ignored. A step has
more jumps than this number with a probability below 1e-14.

**Set-points** are the last states of a plant. They move by a normal step with a certain probability in each time step,
or by the next row of a timetable, which a step counter selects.

**Loads** are rows of a table too. Its step counter stays at the last row.
"""

from __future__ import annotations

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array
from taciturn._modes import factor
from taciturn.errors import ProblemError
from taciturn.model.load import SampledLoads
from taciturn.model.plant import JumpDistribution, JumpNoise
from taciturn.model.signals import RandomSteps, SampledChanges
from taciturn.model.steps import Location
from taciturn.program.draws import NORMAL, minus_two_log
from taciturn.program.ir import Builder
from taciturn.program.ops import Entry
from taciturn.program.translation import Operands, TimeStep

_MISSED = 1e-14  # largest probability that a step has more jumps than are drawn
_MOST = 100  # most jumps drawn per step
_ROUNDING = 1e-16  # size below which a term of the power series has no effect
TIMETABLE = "timetable"  # step counter of set-points that change at known times
LOADED = "loaded"  # step counter of loads


def add_jumps(tick: TimeStep, noise: JumpNoise) -> Operands:
    """Compute Σ_i e^{A(τ−t_i)} G ξ_i, which the jumps ξ_i at times t_i in a step of length τ add to the state."""
    b, n = tick.builder, len(noise.A)
    half, spread = noise.period / 2, noise.jumps.spread
    law = noise.jumps.distribution
    # the waiting time between jumps is exponential with mean 1/rate: −log(u)/rate, from −2 log u
    pause, end, zero = b.constant(0.5 / noise.jumps.rate), b.constant(noise.period), b.constant(0.0)
    time, total = zero, [zero] * n
    for _ in range(_drawn(noise)):
        time = b.emit("add", time, b.emit("mul", pause, minus_two_log(b, tick.uniform())))
        inside = b.emit("greater", end, time)
        size = [jump_size(b, law, _draw(tick, law)) for _ in range(spread.shape[1])]
        jump = [b.value(b.combine([float(g) for g in row], size)) for row in spread]
        moved = _flow(b, noise.A, half, jump, b.emit("sub", b.constant(half), time))
        total = [b.emit("add", old, b.choose(inside, new, zero)) for old, new in zip(total, moved, strict=True)]
    middle = _scipy.matrix_exponential(noise.A * half)
    return [b.value(b.combine([float(entry) for entry in row], total)) for row in middle]


def _flow(b: Builder, A: Array, reach: float, start: Operands, time: int) -> Operands:
    """Return e^{As} start for a time |s| ≤ reach, by Horner's rule: start + sA(start + sA/2 (start + sA/3 (…)))."""
    result = start
    for k in range(_terms(A, reach), 0, -1):
        pushed = [b.combine([float(entry) for entry in row], result) for row in A / k]
        result = [
            value if push is None else b.emit("add", value, b.emit("mul", time, push))
            for value, push in zip(start, pushed, strict=True)
        ]
    return result


def _terms(A: Array, reach: float) -> int:
    """Return the last power of the series of e^{As}, |s| ≤ reach, after which its terms are below rounding."""
    # The terms are bounded entry by entry by (|A|·reach)^k/k!. The series of a nilpotent A is finite.
    power, k = np.abs(A) * reach, 1
    term = power
    # continue while a term is not negligible, or while terms may still grow
    while term.any() and (term.max() > _ROUNDING or k < term.max()):
        k += 1
        term = term @ power / k
    return k - 1 if not term.any() else k


def _drawn(noise: JumpNoise) -> int:
    """Return the number of jumps that a step exceeds with a probability of at most _MISSED (Poisson distribution)."""
    mean = noise.jumps.rate * noise.period
    chance, count = np.exp(-mean), 0
    seen = chance
    while seen < 1 - _MISSED:
        count += 1
        chance *= mean / count
        seen += chance
        if count > _MOST:
            raise ProblemError(
                f"a step of {noise.period:g} s has {mean:.3g} jumps on average, too many to draw one by one; "
                "expected shorter steps, or Wiener noise W = rate · covariance, which approximates the jumps"
            )
    return count


def jump_size(b: Builder, distribution: JumpDistribution, drawn: int) -> int:
    """Compute an entry of a jump ξ, with mean 0 and variance 1, from a normal or uniform random number."""
    if distribution == "normal":
        return drawn
    # u − ½ has variance 1/12; its sign is the two-point distribution ±1
    centred = b.emit("sub", drawn, b.constant(0.5))
    if distribution == "uniform":
        return b.emit("mul", b.constant(float(np.sqrt(12.0))), centred)
    return b.emit("select", b.emit("greater", centred, b.constant(0.0)), b.constant(1.0), b.constant(-1.0))


def _draw(tick: TimeStep, distribution: JumpDistribution) -> int:
    b = tick.builder
    return b.input(Entry(NORMAL, len(b.inputs))) if distribution == "normal" else tick.uniform()


def draw_noise(tick: TimeStep, spread: Array) -> Operands:
    """Multiply the matrix G by a vector of new standard normal numbers."""
    drawn = tick.supplied(NORMAL, spread.shape[1], len(tick.builder.inputs))
    return [tick.builder.value(value) for value in tick.builder.transform(spread.tolist(), drawn)]


def add_changes(tick: TimeStep, W: Array, changes: RandomSteps | SampledChanges) -> Operands:
    """Draw the process noise: Gaussian noise of the plant, and changes of the set-points, which are the last states."""
    b, others = tick.builder, W[: -changes.size, : -changes.size]
    noise = draw_noise(tick, factor(others)) if others.any() else [b.constant(0.0)] * len(others)
    if isinstance(changes, SampledChanges):
        rows = len(changes.table)
        tick.locations[TIMETABLE] = Location(TIMETABLE, (np.arange(rows) + 1) % rows)
        here = tick.place(TIMETABLE)
        return [*noise, *(b.value(b.lookup(column, here)) for column in changes.table.T.tolist())]
    steps, none = draw_noise(tick, factor(changes.covariance)), b.constant(0.0)
    happens = b.emit("greater", b.constant(changes.rate), tick.uniform())
    return [*noise, *(b.choose(happens, step, none) for step in steps)]


def read_loads(tick: TimeStep, loads: SampledLoads, ahead: bool = False) -> Operands:
    """Return the loads of a step, or ``ahead``, of the next step."""
    b, last = tick.builder, len(loads.table) - 1
    if not last:
        return [b.constant(value) for value in loads.table[0].tolist()]
    following = np.minimum(np.arange(last + 1) + 1, last)
    tick.locations[LOADED] = Location(LOADED, following)
    here, rows = tick.place(LOADED), loads.table[following] if ahead else loads.table
    return [b.value(b.lookup(column, here)) for column in rows.T.tolist()]
