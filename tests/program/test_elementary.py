"""Functions of numbers made of a program's operations: all digits but the last, and the same bits in every print."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from counts import few
from drawn import law
from hypothesis import strategies as st
from parity.loops import same
from program.printed import by_c, by_machine, by_numpy, by_python, program_of

from taciturn.program.functions import (
    NUMBERS,
    arctangent,
    cosine,
    direction,
    exponential_less_one,
    exponential_of,
    hyperbolic_tangent,
    logarithm,
    sine,
    tangent,
)
from taciturn.program.ops import Precision

PRECISIONS: list[Precision] = ["float64", "float32"]
EXTENDED = np.finfo(np.longdouble).nmant > 60


class Case(NamedTuple):
    """A function, where it is good, and by how many units in the last place it may err.

    Args:
        rule: of the program's operations.
        meaning: of NumPy.
        units: in the last place.
        reach: largest argument, in double and in single precision.
        positive: whether arguments are.
    """

    rule: Callable[..., int]
    meaning: Callable[..., np.ndarray]
    units: float
    reach: tuple[float, float]
    positive: bool = False


CASES = {
    "exp": Case(exponential_of, np.exp, 1.5, (708.0, 87.0)),
    "expm1": Case(exponential_less_one, np.expm1, 2.25, (708.0, 87.0)),
    "log": Case(logarithm, np.log, 1.0, (1.7e308, 3.4e38), positive=True),
    "tanh": Case(hyperbolic_tangent, np.tanh, 2.75, (1e300, 1e38)),
    "sin": Case(sine, np.sin, 1.0, (5e7, 1e5)),
    "cos": Case(cosine, np.cos, 1.0, (5e7, 1e5)),
    "tan": Case(tangent, np.tan, 2.75, (5e7, 1e5)),
    "arctan": Case(arctangent, np.arctan, 1.5, (1e300, 1e38)),
    "arctan2": Case(direction, np.arctan2, 2.0, (1e300, 1e36)),
}
NEAR_ZERO = {"float64": 1e-25, "float32": 1e-12}  # what remains of an angle that is nearly a multiple of π/2


def in_reach(case: Case, precision: Precision, seed: int, count: int) -> list[np.ndarray]:
    """Return arguments of every size, and most of them of a usual one."""
    draws, arguments = np.random.default_rng(seed), list[np.ndarray]()
    most = case.reach[PRECISIONS.index(precision)]
    for _ in range(1 + (case.meaning is np.arctan2)):
        small = -300 if precision == "float64" else -36
        sizes = 10.0 ** draws.uniform(small, np.log10(most) - 1e-3, count)
        usual = draws.uniform(0, min(most, 10.0), count)
        large = draws.uniform(0, min(most, 1e6), count)
        values = np.concatenate([sizes, usual, large])
        signs = 1.0 if case.positive else draws.choice([-1.0, 1.0], len(values))
        arguments.append((signs * values).astype(precision).astype(np.float64))
    return arguments


def units_off(case: Case, precision: Precision, found: np.ndarray, arguments: list[np.ndarray]) -> float:
    """Return by how many units in the last place results are off."""
    exact = case.meaning(*(one.astype(np.longdouble) for one in arguments))
    unit = np.spacing(np.abs(exact.astype(precision))).astype(np.longdouble)
    off = np.maximum(np.abs(found.astype(np.longdouble) - exact) - NEAR_ZERO[precision], 0)
    return float((off / unit).max())


@pytest.mark.skipif(not EXTENDED, reason="NOT SHOWN: needs numbers longer than doubles to compare with")
@pytest.mark.parametrize("precision", few(PRECISIONS, quick=1))
@pytest.mark.parametrize("name", CASES)
def test_functions_have_all_digits_but_the_last(name: str, precision: Precision) -> None:
    """Of arguments of every size, in their meaning, in the bit-exact build and in the fast one."""
    case = CASES[name]
    arguments = in_reach(case, precision, 1, 20_000)
    program = program_of(case.rule, len(arguments), precision)
    found = by_numpy(program, *arguments)
    assert units_off(case, precision, found, arguments) <= case.units
    assert same(found, by_machine(program, "parity", *arguments))
    assert units_off(case, precision, by_machine(program, "fast", *arguments), arguments) <= case.units


@pytest.mark.skipif(not EXTENDED, reason="NOT SHOWN: needs numbers longer than doubles to compare with")
@law(16, 200, name=st.sampled_from(sorted(CASES)), precision=st.sampled_from(PRECISIONS), data=st.data())
def test_functions_have_all_digits_but_the_last_anywhere(name: str, precision: Precision, data: st.DataObject) -> None:
    """Wherever a search looks for a place where they have not: whole numbers, powers of two, the ends of the range."""
    case = CASES[name]
    most = float(np.nextafter(np.float32(case.reach[1]), 0)) if precision == "float32" else case.reach[0]
    numbers = st.floats(0.0 if case.positive else -most, most, width=64 if precision == "float64" else 32)
    numbers = numbers.filter(lambda x: x > 0) if case.positive else numbers
    count = 1 + (case.meaning is np.arctan2)
    rows = data.draw(st.lists(st.tuples(*[numbers] * count), min_size=1, max_size=20))
    arguments = [np.array(column) for column in zip(*rows, strict=True)]
    program = program_of(case.rule, count, precision)
    assert units_off(case, precision, by_numpy(program, *arguments), arguments) <= case.units


@pytest.mark.skipif(not EXTENDED, reason="NOT SHOWN: needs numbers longer than doubles to compare with")
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", ["sin", "cos", "tan"])
def test_angles_next_to_a_quarter_turn_keep_their_digits(name: str, precision: Precision) -> None:
    """Up to 1e5: there an angle loses its leading digits with the multiple of π/2, and has others behind them."""
    case = CASES[name]
    multiples = np.arange(0, int(1e5 / (np.pi / 2)), 3 if precision == "float64" else 1)
    x = (multiples * (np.pi / 2)).astype(precision).astype(np.float64)
    exact = case.meaning(x.astype(np.longdouble))
    found = by_numpy(program_of(case.rule, 1, precision), x)
    remains = (NEAR_ZERO[precision] + 2e-19 * x) * np.maximum(1, np.abs(exact) ** 2)  # of either's π
    unit = case.units * np.spacing(np.abs(exact.astype(precision))).astype(np.longdouble)
    assert (np.abs(found - exact) <= unit + remains).all()


@pytest.mark.parametrize("name", CASES)
def test_functions_have_the_same_bits_in_every_print(name: str, tmp_path: Path) -> None:
    """NumPy, machine code, Python and C; C in single precision, too; of what is no usual number as well."""
    case = CASES[name]
    odd = np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, 5e-324, 1e-310, 1e308, -1e308, 2.0**-1022, np.pi / 2])
    columns = in_reach(case, "float64", 2, 300)
    extra = [one.ravel() for one in np.meshgrid(*[odd] * len(columns))]
    arguments = [np.concatenate(pair) for pair in zip(columns, extra, strict=True)]
    program = program_of(case.rule, len(arguments))
    meaning = by_numpy(program, *arguments)
    for found in (by_machine(program, "parity", *arguments), by_python(program, *arguments)):
        assert_same_numbers(found, meaning)
    assert_same_numbers(by_c(program, tmp_path, *arguments), meaning)
    (tmp_path / "single").mkdir()
    single = program_of(case.rule, len(arguments), "float32")
    with np.errstate(over="ignore"):
        arguments = [one.astype(np.float32).astype(np.float64) for one in arguments]
    meaning = by_numpy(single, *arguments)
    assert_same_numbers(by_machine(single, "parity", *arguments), meaning)
    assert_same_numbers(by_c(single, tmp_path / "single", *arguments), meaning)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_roots_in_c_are_rounded_to_the_nearest(precision: Precision, tmp_path: Path) -> None:
    """Of any bits: small and large numbers, whole ones and their squares, zeros, and what has no root."""
    draws, kind = np.random.default_rng(7), np.dtype(precision)
    bits = draws.integers(0, 2 ** (8 * kind.itemsize - 1), 20_000, dtype=f"u{kind.itemsize}")
    odd = [0.0, -0.0, np.inf, np.nan, -1.0, -np.inf, 1e-310, 1e-40, 2.0]
    x = np.concatenate([bits.view(kind), np.array(odd, kind), np.arange(1, 2000, dtype=kind) ** 2])
    with np.errstate(all="ignore"):
        expected = np.sqrt(x).astype(np.float64)
        x = x.astype(np.float64)
    assert_same_numbers(by_c(program_of(lambda b, value: b.emit("sqrt", value), 1, precision), tmp_path, x), expected)


def test_a_number_known_now_has_bits_in_every_print(tmp_path: Path) -> None:
    """The angle over a base of one."""
    program = program_of(lambda b, y: direction(b, y, b.constant(1.0)), 1)
    y = np.random.default_rng(6).normal(size=50)
    for found in (by_machine(program, "parity", y), by_python(program, y), by_c(program, tmp_path, y)):
        assert same(found, by_numpy(program, y))


def assert_same_numbers(found: np.ndarray, meaning: np.ndarray) -> None:
    """Check that the bits are the same; of what is no number, that it is none."""
    nothing = np.isnan(meaning)
    assert (np.isnan(found) == nothing).all()
    assert same(found[~nothing], meaning[~nothing])


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", CASES)
def test_what_is_no_usual_number_comes_out_as_of_numpy(name: str, precision: Precision) -> None:
    """Zeros of either sign, infinities and what is no number; an exponential saturates, and so do the sides of a
    triangle.
    """
    case = CASES[name]
    odd = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, -1.0, 1.0])
    arguments = [one.ravel() for one in np.meshgrid(*[odd] * (1 + (case.meaning is np.arctan2)))]
    found = by_numpy(program_of(case.rule, len(arguments), precision), *arguments)
    with np.errstate(all="ignore"):
        expected = case.meaning(*arguments)
    ends = {"exp": (-708.0, 709.0), "expm1": (-708.0, 709.0)} if precision == "float64" else {}
    ends |= {"exp": (-87.0, 88.0), "expm1": (-87.0, 88.0)} if precision == "float32" else {}
    if name in ends:
        expected = case.meaning(np.clip(arguments[0], *ends[name]))
    digits = 1e-15 if precision == "float64" else 2e-7
    np.testing.assert_allclose(found, expected, rtol=digits, atol=1e-37 if name == "arctan2" else 0.0, equal_nan=True)
    zero = expected == 0
    assert (np.signbit(found[zero]) == np.signbit(expected[zero])).all() or name == "expm1"


@pytest.mark.parametrize("precision", PRECISIONS)
def test_an_angle_without_digits_is_no_number(precision: Precision) -> None:
    """Beyond 5e7, or 1e5 in single precision, and not a number that looks like a sine."""
    beyond = np.array([1.0001, 3.0, 1e10, 1e30]) * CASES["sin"].reach[PRECISIONS.index(precision)]
    for rule in (sine, cosine, tangent):
        assert np.isnan(by_numpy(program_of(rule, 1, precision), beyond)).all()


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(
    "name", ["absolute", "sign", "floor", "ceil", "rint", "square", "sqrt", "reciprocal", "negative"]
)
def test_what_is_exact_is_exact(name: str, precision: Precision) -> None:
    """One rounding or none: the bits of NumPy, zeros and infinities included; of zero the size."""
    draws = np.random.default_rng(4)
    x = np.concatenate([draws.normal(size=999) * 10.0 ** draws.integers(-5, 20, 999), [0.5, 1.5, -2.5, 3, 0, np.inf]])
    x = np.abs(x) if name == "sqrt" else x
    x = x.astype(precision)
    program = program_of(lambda b, value: b.value(NUMBERS[name](b, value)), 1, precision)
    with np.errstate(all="ignore"):
        expected = getattr(np, name)(x).astype(np.float64)
    np.testing.assert_array_equal(by_numpy(program, x.astype(np.float64)), expected)
    np.testing.assert_array_equal(by_machine(program, "fast", x.astype(np.float64)), expected)


@pytest.mark.parametrize("name", ["minimum", "maximum"])
def test_the_smaller_of_what_is_no_number_is_none(name: str) -> None:
    """On either side, and next to a number known now."""
    odd = np.array([1.0, -2.0, np.nan, np.inf, -np.inf])
    x, y = (one.ravel() for one in np.meshgrid(odd, odd))
    both = program_of(lambda b, one, other: b.value(NUMBERS[name](b, one, other)), 2)
    np.testing.assert_array_equal(by_numpy(both, x, y), getattr(np, name)(x, y))
    for known in (
        program_of(lambda b, one: b.value(NUMBERS[name](b, one, 0.5)), 1),
        program_of(lambda b, one: b.value(NUMBERS[name](b, 0.5, one)), 1),
    ):
        np.testing.assert_array_equal(by_numpy(known, odd), getattr(np, name)(odd, 0.5))


@pytest.mark.parametrize(("name", "low", "high"), [
    ("arcsin", -1.0, 1.0), ("arccos", -1.0, 1.0), ("sinh", -700.0, 700.0), ("cosh", -700.0, 700.0),
])  # fmt: skip
def test_what_is_made_of_them_has_nearly_all_digits(name: str, low: float, high: float) -> None:
    """Within four units in the last place, near zero too."""
    draws = np.random.default_rng(5)
    x = np.concatenate(
        [draws.uniform(low, high, 5000), draws.uniform(-1, 1, 5000) * 10.0 ** draws.uniform(-9, 0, 5000)]
    )
    found = by_numpy(program_of(lambda b, value: b.value(NUMBERS[name](b, value)), 1), x)
    expected = getattr(np, name)(x.astype(np.longdouble))
    assert float((np.abs(found - expected) / np.spacing(np.abs(expected.astype(float)))).max()) <= 4


@law(25, 300, x=st.floats(-1e6, 1e6), y=st.floats(1e-3, 1e3))
def test_a_remainder_lies_beside_its_divisor(x: float, y: float) -> None:
    """x mod y is off by what rounding x/y and its product takes, on a circle of length y."""
    program = program_of(lambda b, one, other: b.value(NUMBERS["remainder"](b, one, other)), 2)
    found = float(by_numpy(program, np.array([x]), np.array([y]))[0])
    off = abs(found - np.mod(x, y))
    assert min(off, abs(y - off)) <= 2 * np.spacing(abs(x)) + np.spacing(y)
