"""What Poisson jumps have added to a state by the end of a tick, drawn as operations of the program."""

from __future__ import annotations

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array
from taciturn._modes import factor
from taciturn.errors import ProblemError
from taciturn.model.plant import JumpDistribution, JumpNoise
from taciturn.program.draws import NORMAL, minus_two_log
from taciturn.program.ir import Builder
from taciturn.program.lower import Tick, Vector

MISSED = 1e-14  # probability of more jumps in a tick than are drawn
MOST = 100  # jumps that are drawn at most
ROUNDING = 1e-16


def add_jumps(tick: Tick, noise: JumpNoise) -> Vector:
    """Return Σ_i e^{A(τ−t_i)} G ξ_i over the jumps of one tick, GG' their covariance.

    Waiting times are drawn until they pass the tick, in as many steps as all but 1e-14 of the ticks need. The flow from
    a jump to the end of the tick is a power series about the middle of the tick, to rounding; that of a nilpotent A
    ends by itself.

    Args:
        tick: what is written down.
        noise: the jumps.

    Returns:
        One operation per state.

    Raises:
        ProblemError: more jumps per tick than are drawn.
    """
    b, n = tick.builder, len(noise.A)
    half, spread = noise.period / 2, factor(noise.jumps.covariance)
    law = noise.jumps.distribution
    pause, end, zero = b.constant(0.5 / noise.jumps.rate), b.constant(noise.period), b.constant(0.0)
    time, total = zero, [zero] * n
    for _ in range(_drawn(noise)):
        time = b.emit("add", time, b.emit("mul", pause, minus_two_log(b, tick.uniform())))
        inside = b.emit("greater", end, time)
        size = [jump_size(b, law, _draw(tick, law)) for _ in range(spread.shape[1])]
        jump = [tick.value(b.combine([float(g) for g in row], size)) for row in spread]
        moved = _flow(b, noise.A, half, jump, b.emit("sub", b.constant(half), time))
        total = [b.emit("add", old, tick.choose(inside, new, zero)) for old, new in zip(total, moved, strict=True)]
    middle = _scipy.exponential(noise.A * half)
    return [tick.value(b.combine([float(entry) for entry in row], total)) for row in middle]


def _flow(b: Builder, A: Array, reach: float, start: Vector, time: int) -> Vector:
    """Return e^{As} start for a time |s| ≤ reach by Horner's rule."""
    result = start
    for k in range(_terms(A, reach), 0, -1):
        pushed = [b.combine([float(entry) for entry in row], result) for row in A / k]
        result = [
            value if push is None else b.emit("add", value, b.emit("mul", time, push))
            for value, push in zip(start, pushed, strict=True)
        ]
    return result


def _terms(A: Array, reach: float) -> int:
    """Return the power after which the series of e^{As}, |s| ≤ reach, is below rounding."""
    power, k = np.abs(A) * reach, 1
    term = power
    while term.any() and (term.max() > ROUNDING or k < term.max()):
        k += 1
        term = term @ power / k
    return k - 1 if not term.any() else k


def _drawn(noise: JumpNoise) -> int:
    """Return how many jumps all but a share MISSED of the ticks have at most."""
    mean = noise.jumps.rate * noise.period
    chance, count = np.exp(-mean), 0
    seen = chance
    while seen < 1 - MISSED:
        count += 1
        chance *= mean / count
        seen += chance
        if count > MOST:
            raise ProblemError(
                f"a tick of {noise.period:g} s sees {mean:.3g} jumps on average, too many to draw one by one; "
                "expected shorter ticks, or Wiener noise W = rate · covariance, which they come close to"
            )
    return count


def jump_size(b: Builder, distribution: JumpDistribution, drawn: int) -> int:
    """Return one component of mean 0 and variance 1 of a jump, from a normal draw, or for other laws a uniform one."""
    if distribution == "normal":
        return drawn
    centred = b.emit("sub", drawn, b.constant(0.5))
    if distribution == "uniform":
        return b.emit("mul", b.constant(float(np.sqrt(12.0))), centred)
    return b.emit("select", b.emit("greater", centred, b.constant(0.0)), b.constant(1.0), b.constant(-1.0))


def _draw(tick: Tick, distribution: JumpDistribution) -> int:
    b = tick.builder
    return b.input(f"{NORMAL} {len(b.inputs)}") if distribution == "normal" else tick.uniform()
