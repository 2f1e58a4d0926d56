"""Drawn numbers: the generator word for word, the polynomials' errors, and the law of what is drawn."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from scipy import stats

from taciturn.program.draws import GENERATOR, seed_generators, with_draws
from taciturn.program.ir import Builder, Program
from taciturn.program.machine import Kernel
from taciturn.program.numpy import run
from taciturn.program.ops import Entry, State

WORD = (1 << 64) - 1
PATHS, TICKS = 4096, 25_000  # 1e8 steps
UNLIKELY = 1e-5  # probability below which a test of a law fails; the seeds are fixed


def drawing(*names: Entry) -> Program:
    """Return a program that records these draws."""
    b = Builder()
    return with_draws(b.finish([], {}, {name: b.input(name) for name in names}))


def rotate(x: int, k: int) -> int:
    """Rotate a word of 64 bits to the left."""
    return (x << k | x >> 64 - k) & WORD


def xoshiro(words: list[int]) -> Iterator[tuple[int, list[int]]]:
    """Yield output and state of xoshiro256++ as Blackman and Vigna write it, in Python's integers."""
    s = list(words)
    while True:
        result = (rotate((s[0] + s[3]) & WORD, 23) + s[0]) & WORD
        t = (s[1] << 17) & WORD
        s[2] ^= s[0]
        s[3] ^= s[1]
        s[1] ^= s[2]
        s[0] ^= s[3]
        s[2] ^= t
        s[3] = rotate(s[3], 45)
        yield result, list(s)


def split_mix(state: int) -> Iterator[int]:
    """Yield the outputs of SplitMix64, in Python's integers."""
    while True:
        state = (state + 0x9E3779B97F4A7C15) & WORD
        z = ((state ^ state >> 30) * 0xBF58476D1CE4E5B9) & WORD
        z = ((z ^ z >> 27) * 0x94D049BB133111EB) & WORD
        yield z ^ z >> 31


def words_of(bits: np.ndarray) -> list[int]:
    """Return the words behind the bits of doubles."""
    return [int(word) for word in np.ascontiguousarray(bits).view(np.uint64)]


def test_the_generator_is_xoshiro_word_for_word() -> None:
    """A thousand words on each of four paths, and the uniform made of each."""
    start = seed_generators(7, 4)
    program = drawing(Entry("uniform", 0))
    assert [(state.name, state.index) for state in program.states] == [(GENERATOR, i) for i in range(4)]
    result = run(program, start, 1000)
    for path in range(4):
        expected = xoshiro(words_of(start[:, path]))
        for tick in range(1000):
            word, state = next(expected)
            assert result.outputs[Entry("uniform", 0)][tick, path] == math.ldexp(2 * (word >> 12) + 1, -53)
        assert words_of(result.states[:, path]) == state


def test_the_generators_start_from_split_mix() -> None:
    """The four words of a path are successive outputs from a counter of its own."""
    words = seed_generators(3, 5)
    key = int(np.random.SeedSequence(3).generate_state(1, np.uint64)[0])
    for path in range(5):
        counter = next(split_mix((path * 0xD1342543DE82EF95 + key - 0x9E3779B97F4A7C15) & WORD))
        expected = split_mix(counter)
        assert words_of(words[:, path]) == [next(expected) for _ in range(4)]


def test_a_path_of_a_seed_does_not_depend_on_how_many_are_run() -> None:
    """Nor on where the counting starts."""
    many = seed_generators(5, 1000).view(np.uint64)
    assert (seed_generators(5, 7).view(np.uint64) == many[:, :7]).all()
    assert (seed_generators(5, 10, first=990).view(np.uint64) == many[:, 990:]).all()


@pytest.mark.evidence
def test_no_two_of_a_million_paths_and_seeds_start_alike() -> None:
    """64-bit starts of a thousand seeds by a thousand paths are distinct."""
    first = np.concatenate([seed_generators(seed, 1000)[0] for seed in range(1000)]).view(np.uint64)
    assert len(np.unique(first)) == len(first)


def draw_from(words: np.ndarray, *names: str) -> list[np.ndarray]:
    """Return what is drawn from given 64-bit words: with s0 = 0 the output is the rotated s3."""
    states = np.zeros((4, len(words)), dtype=np.uint64)
    states[3] = (words >> np.uint64(23)) | (words << np.uint64(41))
    outputs = run(drawing(*names), states.view(np.float64), 1).outputs
    return [outputs[name][0] for name in names]


def telling_words() -> np.ndarray:
    """Return a million random words and those at every edge of the fields."""
    uppers = [0, 1, 2, 2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1, *(int(2**32 * math.sqrt(0.5)) + i for i in (-1, 0, 1))]
    lowers = [0, 1, 2**29 - 1, 2**29, 2**30 - 1, 2**30, 2**31, 2**32 - 1]
    edges = np.array([upper << 32 | lower for upper in uppers for lower in lowers], dtype=np.uint64)
    return np.concatenate([edges, np.random.default_rng(0).integers(0, 2**64, 1_000_000, dtype=np.uint64)])


def test_a_uniform_lies_strictly_between_zero_and_one() -> None:
    """The words of all zeros and of all ones give the ends."""
    (drawn,) = draw_from(telling_words(), Entry("uniform", 0))
    assert drawn.min() > 0
    assert drawn.max() < 1
    ends = draw_from(np.array([0, WORD], dtype=np.uint64), Entry("uniform", 0))[0]
    assert list(ends) == [2.0**-53, 1 - 2.0**-53]


@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="needs more digits than a double's")
@pytest.mark.evidence
def test_the_normals_are_box_muller_to_the_claimed_errors() -> None:
    """Against logarithm, cosine and sine in extended precision, at random words and at the edges of every field."""
    words = telling_words()
    x, y = (value.astype(np.longdouble) for value in draw_from(words, Entry("normal", 0), Entry("normal", 1)))
    u = ((words >> np.uint64(32)).astype(np.longdouble) + 0.5) / 2**32
    square = -2 * np.log(u)
    pi = np.longdouble(4) * np.arctan(np.longdouble(1))
    angle = pi / 2 * ((words & np.uint64(2**30 - 1)).astype(np.longdouble) / 2**30 - 0.5)
    sign = np.where(words & np.uint64(2**31), -1, 1)
    swap = (words & np.uint64(2**30)) != 0
    along, across = np.where(swap, y, x) * sign, np.where(swap, x, y) * sign
    radius = np.sqrt(square)
    logarithm, cosine, sine = 2.4e-11, 4.8e-11, 3.4e-12
    slack = logarithm / np.maximum(radius, 0.05) + 1e-15 * radius  # √(r² + 2ε) − r, and rounding
    far = radius > 0.05
    assert (np.abs(along - radius * np.cos(angle)) <= cosine * radius + slack)[far].all()
    assert (np.abs(across - radius * np.sin(angle)) <= sine * radius + slack)[far].all()
    assert (np.abs(along**2 + across**2 - square) <= 2 * logarithm + 2 * cosine * square).all()
    assert np.isfinite(x).all()
    assert np.hypot(x, y).max() <= math.sqrt(66 * math.log(2)) + 1e-9


def summing(*powers: tuple[int, int, int, int]) -> Program:
    """Return a program that sums a^i b^j c^k d^l over the steps; a and b a pair, c and d that of the step before."""
    b = Builder()
    pair = [b.input(Entry("normal", 0)), b.input(Entry("normal", 1))]
    before = [b.state(State("before", i)) for i in range(2)]
    sums: dict[str, int] = {}
    for exponents in powers:
        value: int | None = None
        for factor, exponent in zip((*pair, *before), exponents, strict=True):
            for _ in range(exponent):
                value = factor if value is None else b.emit("mul", value, factor)
        assert value is not None
        sums[f"{exponents}"] = value
    for threshold in (4.0, 5.0):
        for i, value in enumerate(pair):
            beyond = b.emit("greater", b.emit("mul", value, value), b.constant(threshold**2))
            sums[f"{i} beyond {threshold}"] = b.emit("select", beyond, b.constant(1.0), b.constant(0.0))
    return with_draws(b.finish(pair, sums))


def moment(power: int) -> float:
    """Return E n^power of a standard normal."""
    return 0.0 if power % 2 else float(math.prod(range(power - 1, 0, -2)))


@pytest.fixture(scope="module")
def totals() -> dict[str, float]:
    """Return the sums of powers and products over 1e8 pairs."""
    alone = [tuple(power if i == which else 0 for i in range(4)) for which in (0, 1) for power in range(1, 9)]
    mixed = [(i, j, 0, 0) for i in (1, 2, 3) for j in (1, 2, 3)]
    crossed = ((0, 2), (0, 3), (1, 2), (1, 3))
    later = [tuple(n if k in places else 0 for k in range(4)) for n in (1, 2) for places in crossed]
    program = summing(*alone, *mixed, *later)
    states = np.zeros((len(program.states), PATHS))
    words = [i for i, state in enumerate(program.states) if state.word]
    states[words] = seed_generators(2024, PATHS)
    result = Kernel(program, "parity").run(program, states, TICKS)
    return {name: math.fsum(values) for name, values in result.sums.items()}


@pytest.mark.evidence
def test_moments_up_to_the_eighth_are_those_of_the_normal_law(totals: dict[str, float]) -> None:
    """Of both outputs, and the mixed moments of the pair and of successive pairs, to 4.5 standard errors."""
    ticks = PATHS * TICKS
    for name, total in totals.items():
        if not name.startswith("("):
            continue
        powers = [int(power) for power in name.strip("()").split(",")]
        mean = math.prod(moment(power) for power in powers)
        spread = math.sqrt(math.prod(moment(2 * power) for power in powers) - mean**2)
        assert abs(total / ticks - mean) < 4.5 * spread / math.sqrt(ticks), name


@pytest.mark.parametrize("threshold", [4.0, 5.0])
@pytest.mark.evidence
def test_the_tails_hold_what_those_of_the_normal_law_hold(totals: dict[str, float], threshold: float) -> None:
    """The number of draws beyond 4 and 5 in 1e8."""
    expected = PATHS * TICKS * 2 * stats.norm.sf(threshold)
    for i in (0, 1):
        assert abs(totals[f"{i} beyond {threshold}"] - expected) < 4.5 * math.sqrt(expected)


@pytest.fixture(scope="module")
def recorded() -> tuple[np.ndarray, np.ndarray]:
    """Return both normals of 1000 paths by 1500 steps."""
    outputs = run(drawing(Entry("normal", 0), Entry("normal", 1)), seed_generators(11, 1000), 1500).outputs
    return outputs[Entry("normal", 0)], outputs[Entry("normal", 1)]


def test_the_distribution_is_normal(recorded: tuple[np.ndarray, np.ndarray]) -> None:
    """Kolmogorov and Smirnov see nothing in 1.5 million draws."""
    for values in recorded:
        assert stats.kstest(values.ravel(), "norm").pvalue > UNLIKELY


def test_the_uniform_distribution_is_uniform() -> None:
    """Kolmogorov and Smirnov see nothing in a million draws."""
    drawn = run(drawing(Entry("uniform", 0)), seed_generators(12, 1000), 1000).outputs[Entry("uniform", 0)]
    assert stats.kstest(drawn.ravel(), "uniform").pvalue > UNLIKELY


def dependence(one: np.ndarray, other: np.ndarray, bins: int = 16) -> float:
    """Return the probability of a table of equally likely cells as uneven as this one."""
    cells = [np.minimum((stats.norm.cdf(values.ravel()) * bins).astype(int), bins - 1) for values in (one, other)]
    counts = np.bincount(cells[0] * bins + cells[1], minlength=bins**2)
    return float(stats.chisquare(counts).pvalue)


def test_the_two_outputs_of_a_pair_are_independent(recorded: tuple[np.ndarray, np.ndarray]) -> None:
    """All 256 cells of the plane are equally likely."""
    assert dependence(*recorded) > UNLIKELY


def test_successive_draws_are_independent(recorded: tuple[np.ndarray, np.ndarray]) -> None:
    """Of one output, and from one output to the other."""
    a, b = recorded
    assert min(dependence(a[1:], a[:-1]), dependence(a[1:], b[:-1]), dependence(b[2:], a[:-2])) > UNLIKELY


def test_neighbouring_paths_are_independent(recorded: tuple[np.ndarray, np.ndarray]) -> None:
    """Side by side, eight apart, and with a delay of one step."""
    a, b = recorded
    pairs = [(a[:, 1:], a[:, :-1]), (a[:, 8:], b[:, :-8]), (a[1:, 1:], a[:-1, :-1])]
    assert min(dependence(*pair) for pair in pairs) > UNLIKELY


@pytest.mark.evidence
def test_neighbouring_seeds_are_independent() -> None:
    """The same paths of seeds 0 and 1, and one path of a thousand seeds."""
    program = drawing(Entry("normal", 0), Entry("normal", 1))
    one, other = (run(program, seed_generators(seed, 1000), 500).outputs[Entry("normal", 0)] for seed in (0, 1))
    assert dependence(one, other) > UNLIKELY
    starts = np.concatenate([seed_generators(seed, 1) for seed in range(1000)], axis=1)
    values = run(program, starts, 500).outputs[Entry("normal", 0)]
    assert dependence(values[:, 1:], values[:, :-1]) > UNLIKELY
    assert stats.kstest(values[0], "norm").pvalue > UNLIKELY
