"""No first crossing is missed: not two that coincide, nor one next to a jump, nor the first of several."""

from __future__ import annotations

import numpy as np
import pytest
from counts import few
from numpy.polynomial import Polynomial
from renewal.crossings import SlowPath, critical_points, error_polynomials, first_crossing, form, jumps, size

from taciturn._arrays import Array
from taciturn.model.plant import Jumps
from taciturn.program.ir import Program
from taciturn.program.machine import Kernel
from taciturn_events.cycles import sample_cycles
from taciturn_events.events import (
    DURATION,
    ENDED,
    ERROR,
    INTEGRAL,
    TIME,
    WAIT,
    CycleTrigger,
    IntegralTrigger,
    JumpProcess,
    LevelTrigger,
    cycle_program,
    start_cycles,
)

CHAINS = (2, 3, 4)  # integrators in a row
TOUCHES = (-1e-4, -1e-8, 0.0, 1e-8, 1e-4)  # by how much a hump passes the threshold, relative to its terms
BESIDE = (-1e-9, 1e-9)  # seconds from the crossing to the jump
BLUR = 1e-12  # relative to its terms, of the value of a polynomial


def chain(n: int) -> Array:
    """Return the dynamics of n integrators in a row."""
    return np.eye(n, k=1)


def process_of(A: Array, S: Array, rate: float = 1.0) -> JumpProcess:
    """Return a process whose jumps move every state."""
    return JumpProcess(A, Jumps(rate, np.eye(len(A)), "two-point"), S)


def first_ends(process: JumpProcess, trigger: CycleTrigger, values: dict[str, Array], build: str = "fast") -> Array:
    """Return when the first cycle ends of paths that start anywhere; not a number where it does not in time."""
    program: Program = cycle_program(process, trigger).keep(outputs={ENDED, DURATION})
    states = start_cycles(process, program, values[TIME].shape[-1], 0)
    for row, state in zip(states, program.states, strict=True):
        if state.name in values:
            row[:] = np.atleast_2d(values[state.name])[state.index]
    result = Kernel(program, build).run(program, states, 300)  # type: ignore[arg-type]
    ended = result.outputs[ENDED] > 0
    first = ended.argmax(axis=0)
    return np.where(ended.any(axis=0), result.outputs[DURATION][first, np.arange(states.shape[1])], np.nan)


def assert_found(f: Polynomial, time: float, wait: float, end: float) -> None:
    """Compare an end with that of the slow way; a crossing that rounding hides from either may be seen or not."""
    blur = BLUR * size(f, wait)
    surely, perhaps = first_crossing(f - blur, 0.0, wait), first_crossing(f + blur, 0.0, wait)
    if surely is None and perhaps is None:
        assert not end < time + wait - 1e-10
    else:
        assert perhaps is not None
        latest = time + (wait if surely is None else surely)
        assert end >= time + perhaps - 1e-10
        assert end <= latest + 1e-10 or surely is None


def humped(f: Polynomial, wait: float) -> float | None:
    """Return the first interior maximum."""
    second = f.deriv(2)
    humps = [s for s in critical_points(f, 0.02 * wait, wait) if second(s) < 0]
    return humps[0] if humps else None


@pytest.mark.parametrize("n", few(CHAINS, quick=1, start=1))
@pytest.mark.parametrize("kind", few(["integral", "level"], quick=1))
def test_crossings_of_wild_errors_are_those_of_the_slow_way(n: int, kind: str) -> None:
    """Random starts: many turn, many cross several times."""
    random = np.random.default_rng([n, len(kind)])
    G = random.normal(size=(n, n))
    S = G @ G.T if kind == "integral" else np.diag([1.0, *[0.0] * (n - 1)])
    process, paths = process_of(chain(n), S), 300
    e = random.normal(size=(n, paths)) * np.array([4.0 * 3.0**k for k in range(n)])[:, None]
    wait, time = random.uniform(0.1, 3.0, paths), random.uniform(0.1, 2.0, paths)
    c = 30.0
    trigger = IntegralTrigger(c) if kind == "integral" else LevelTrigger(S, 9.0)
    shift = c * time - random.uniform(0.0, 60.0, paths)
    ends = first_ends(process, trigger, {ERROR: e, WAIT: wait, TIME: time, INTEGRAL: shift})
    for i in range(paths):
        assert_found(threshold(process, trigger, e[:, i], shift[i], time[i]), time[i], wait[i], ends[i])


def threshold(process: JumpProcess, trigger: CycleTrigger, e: Array, gone: float, time: float) -> Polynomial:
    """Return what is negative until the trigger fires."""
    entries = error_polynomials(process.A, e)
    if isinstance(trigger, LevelTrigger):
        return form(trigger.Psi, entries) - trigger.level
    return gone + form(process.S, entries).integ() - trigger.c * Polynomial([time, 1.0])


@pytest.mark.parametrize("n", [3, 4])
@pytest.mark.parametrize("touch", TOUCHES)
@pytest.mark.evidence
def test_humps_that_touch_the_threshold_are_seen(n: int, touch: float) -> None:
    """Double roots: a hump below passes, one that reaches the threshold does not."""
    random = np.random.default_rng([n, 7])
    Psi = np.diag([1.0, *[0.0] * (n - 1)])
    process, trigger, wait = process_of(chain(n), Psi), LevelTrigger(Psi, 1.0), 3.0
    starts: list[Array] = []
    while len(starts) < 100:
        e = random.normal(size=n) * np.array([1.0, 2.0, 3.0, 4.0])[:n]
        f = form(Psi, error_polynomials(process.A, e))
        top = humped(f, wait)
        if top is not None and f(0.0) < 0.9 * f(top):
            starts.append(e * np.sqrt((1 + touch) / f(top)))
    e, full = np.array(starts).T, np.full(len(starts), 1.0)
    ends = first_ends(process, trigger, {ERROR: e, WAIT: wait * full, TIME: full})
    for i, end in enumerate(ends):
        f = threshold(process, trigger, e[:, i], 0.0, 1.0)
        assert_found(f, 1.0, wait, end)
        if touch > 0:
            assert end < 1.0 + wait


@pytest.mark.parametrize("beside", BESIDE)
@pytest.mark.parametrize("n", few(CHAINS, quick=1))
def test_a_crossing_beside_a_jump_is_on_its_own_side(n: int, beside: float) -> None:
    """A jump 1e-9 s after the crossing comes too late, one 1e-9 s before it comes first."""
    random = np.random.default_rng([n, 3])
    process, trigger = process_of(chain(n), np.eye(n)), IntegralTrigger(5.0)
    e = random.normal(size=(n, 300)) * 3
    polynomials = [threshold(process, trigger, x, 0.0, 1.0) for x in e.T]
    found = np.array([first_crossing(f, 0.0, 20.0) for f in polynomials], dtype=np.float64)
    kept = np.isfinite(found) & (found > 0.01)
    assert kept.sum() > 200
    wait = found[kept] + beside
    full = np.ones(kept.sum())
    ends = first_ends(process, trigger, {ERROR: e[:, kept], WAIT: wait, TIME: full, INTEGRAL: 0 * full})
    if beside > 0:
        np.testing.assert_allclose(ends - 1, found[kept], rtol=0, atol=1e-10)
    else:
        assert (ends > 1 + wait - 1e-12).all()


@pytest.mark.parametrize("seed", few(range(12), quick=2))
def test_crossings_under_dynamics_without_end_are_those_of_exponentials(seed: int) -> None:
    """Taylor's pieces lose nothing: spirals, decay and growth against sums of exponentials on a fine grid."""
    random = np.random.default_rng(seed)
    n, paths = 2 + seed % 3, 40
    A = random.normal(size=(n, n)) * random.choice([0.3, 1.0, 4.0])
    G = random.normal(size=(n, n))
    process = process_of(A, G @ G.T, rate=random.choice([0.2, 3.0]))
    values, vectors = np.linalg.eig(A)
    e, wait, time = random.normal(size=(n, paths)), np.full(paths, 3.0), np.full(paths, 0.5)
    z = np.linalg.solve(vectors, e.astype(complex))  # e(s) = V exp(Λs) z
    grid = np.linspace(0.0, 3.0, 6001)
    for trigger in (IntegralTrigger(2.0 * n), LevelTrigger(process.S, 6.0 * n)):
        ends = first_ends(process, trigger, {ERROR: e, WAIT: wait, TIME: time, INTEGRAL: 0 * time})
        for i in range(paths):
            value = exponentials(values, vectors, z[:, i], process, trigger, 0.5)
            sampled = value(grid)
            over = np.flatnonzero(sampled >= 0)
            if not over.size:
                assert not ends[i] < 3.5 - 1e-3 or sampled.max() > -1e-4 * np.abs(sampled).max()
                continue
            low, high = grid[max(over[0] - 1, 0)], grid[over[0]]
            for _ in range(60):
                middle = (low + high) / 2
                low, high = (low, middle) if value(np.array([middle]))[0] >= 0 else (middle, high)
            assert abs(ends[i] - 0.5 - high) < 1e-10 or earlier_hump(value, ends[i] - 0.5, high)


def exponentials(values, vectors, z, process, trigger, time):  # type: ignore[no-untyped-def]
    """Return what is negative until the trigger fires, as a function of an array of times."""
    weight = process.S if isinstance(trigger, IntegralTrigger) else trigger.Psi
    M = (vectors.T @ weight @ vectors) * np.outer(z, z)
    rates = (values[:, None] + values[None, :])[..., None]
    if isinstance(trigger, LevelTrigger):
        return lambda s: (M[..., None] * np.exp(rates * s)).sum(axis=(0, 1)).real - trigger.level
    return lambda s: (M[..., None] * np.expm1(rates * s) / rates).sum(axis=(0, 1)).real - trigger.c * (time + s)


def earlier_hump(value, end: float, found: float) -> bool:  # type: ignore[no-untyped-def]
    """Tell whether the grid missed a hump that the program saw."""
    return bool(end < found and abs(value(np.array([end]))[0]) < 1e-9)


@pytest.mark.parametrize(
    ("law", "trigger"),
    [
        ("normal", IntegralTrigger(6.0)),
        ("uniform", IntegralTrigger(6.0, h_max=0.9)),
        ("two-point", IntegralTrigger(6.0, h_min=0.3, h_max=1.5)),
        ("normal", IntegralTrigger(6.0, saturation=0.4)),
        ("uniform", IntegralTrigger(6.0, saturation=0.5, h_min=0.2, h_max=2.0)),
        ("two-point", IntegralTrigger(6.0, saturation=0.2, h_min=0.5, h_max=2.0)),
        ("normal", LevelTrigger(np.diag([2.0, 1.0]), 1.5)),
        ("uniform", LevelTrigger(np.diag([2.0, 1.0]), 1.5, h_max=0.5)),
    ],
    ids=["linear", "longest", "shortest", "saturating", "all", "saturated-at-first", "level", "level-longest"],
)
@pytest.mark.evidence
def test_whole_cycles_are_those_of_the_slow_way(law: str, trigger: CycleTrigger) -> None:
    """Every duration and every cost, cycle by cycle, from the same jumps."""
    S, W = np.array([[1.0, 2.7], [2.7, 7.4]]), np.array([[0.2, 0.1], [0.1, 0.5]])
    process = JumpProcess(chain(2), Jumps(5.0, W, law), S)  # type: ignore[arg-type]
    paths, each, compared = 12, 12, 0
    waits, sizes = jumps(process, paths, 80, seed=5)
    sample = sample_cycles(process, trigger, cycles=paths * each, paths=paths, seed=5)
    for i in range(paths):
        slow = np.array(SlowPath(process, trigger).cycles(waits[:, i], sizes[:, :, i])[:each])
        here = slice(i * each, i * each + len(slow))
        np.testing.assert_allclose(sample.durations[here], slow[:, 0], rtol=0, atol=1e-10)
        np.testing.assert_allclose(sample.costs[here], slow[:, 1], rtol=1e-9, atol=1e-10)
        compared += len(slow)
    assert compared > 50
