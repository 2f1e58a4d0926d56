"""Simulation of an error that an integral trigger checks every τ seconds, with jumps or Wiener noise.

The cost of an interval is its conditional expectation given the errors at the checks: e'Γ(τ)e for a period that begins
with the error e, plus the mean cost of the noise of a period. So E[cost]/E[θ] equals the value of the loop exactly. At
each check the expected cost of the next period is available, and the state is sent before the cost exceeds the allowed
value: at the first time t with cost + e'Γe + noise > c min(t + τ, ε), never before h_min, and no later than the last
check before h_max.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._modes import factor
from taciturn.model.plant import JumpNoise
from taciturn.program.draws import GENERATOR, NORMAL, seed_generators, with_draws
from taciturn.program.ir import Builder, Program
from taciturn.program.jumps import add_jumps
from taciturn.program.lower import TimeStep
from taciturn.program.ops import State
from taciturn.renewal.events import CLOSING, ERROR, INTEGRAL, OPEN, TIME, IntegralTrigger, count_cycle, filled_states

PERIOD_TOLERANCE = 1 + 1e-12  # tolerance for limits that are a whole number of periods


@dataclass(frozen=True, eq=False, repr=False)
class SampledProcess(Displayed):
    """An error that obeys e⁺ = F e + w from one periodic check to the next, with its cost per period.

    Args:
        F: map of the error from one check to the next, (n, n).
        noise: covariance of w, (n, n), or jumps.
        Gamma: Γ(τ), weight of the cost of a period, (n, n).
        running: mean cost of the noise of one period, τ g(τ).
        period: τ, seconds between checks.
    """

    F: Array
    noise: Array | JumpNoise
    Gamma: Array
    running: float
    period: float


def sampled_program(process: SampledProcess, trigger: IntegralTrigger) -> Program:
    """Return the program that simulates an error over one period, including the trigger check at its end.

    Its sums and outputs are those of ``cycle_program``.
    """
    n = len(process.F)
    tick = TimeStep(Builder(), {}, {}, ())
    b = tick.builder
    zero, period = b.constant(0.0), b.constant(process.period)
    state = {name: b.state(State(name, 0, start=(name, 0))) for name in (INTEGRAL, TIME, OPEN, CLOSING)}
    error = [b.state(State(ERROR, i, start=(ERROR, i))) for i in range(n)]

    def ahead(e: list[int]) -> int:
        square = b.quadratic([[float(entry) for entry in row] for row in process.Gamma], e)
        return tick.value(b.add(square, b.constant(process.running)))

    moved = [tick.value(b.combine([float(entry) for entry in row], error)) for row in process.F]
    moved = [b.emit("add", x, w) for x, w in zip(moved, _noise(tick, process.noise), strict=True)]
    spent, time = b.emit("add", state[INTEGRAL], ahead(error)), b.emit("add", state[TIME], period)
    # the threshold c min(t + τ, ε) is that of the end of the next period, whose expected cost is ``ahead``
    after = b.emit("add", time, period)
    allowed = after
    if np.isfinite(trigger.saturation):
        flat = b.constant(trigger.saturation)
        allowed = b.emit("select", b.emit("greater", after, flat), flat, after)
    allowed = b.emit("mul", b.constant(trigger.c), allowed)
    ended = b.emit("greater", b.emit("add", spent, ahead(moved)), allowed)
    if trigger.h_min > 0:
        ended = b.emit(
            "and", ended, b.emit("not", b.emit("greater", b.constant(trigger.h_min / PERIOD_TOLERANCE), time))
        )
    if np.isfinite(trigger.h_max):
        late = b.emit("greater", after, b.constant(trigger.h_max * PERIOD_TOLERANCE))
        ended = b.emit("not", b.emit("and", b.emit("not", ended), b.emit("not", late)))
    opened, sums, outputs = count_cycle(b, ended, time, spent, state[OPEN], state[CLOSING])
    following = [
        *(b.emit("select", ended, zero, value) for value in (spent, time)),
        opened,
        state[CLOSING],
        *(b.emit("select", ended, zero, value) for value in moved),
    ]
    return with_draws(b.finish(following, sums, outputs))


def sampled_start(program: Program, paths: int, seed: int) -> Array:
    """Return the initial program states of simulated paths, just after a send."""
    return filled_states(program, paths, {GENERATOR: seed_generators(seed, paths), OPEN: np.ones((1, paths))})


def _noise(tick: TimeStep, noise: Array | JumpNoise) -> list[int]:
    if isinstance(noise, JumpNoise):
        return add_jumps(tick, noise)
    spread = factor(noise)
    drawn = tick.supplied(NORMAL, spread.shape[1])
    return [tick.value(tick.builder.combine([float(g) for g in row], drawn)) for row in spread]
