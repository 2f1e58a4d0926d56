"""Tracing: a function of NumPy arrays computes as a program what it computes on floats."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import pytest
from drawn import law
from hypothesis import strategies as st

from taciturn import ProblemError
from taciturn.program.ir import Builder, Program
from taciturn.program.machine import Kernel
from taciturn.program.numpy import run
from taciturn.program.tracing import trace

X = {"x": 4, "u": 2}
A = np.array([[1.0, 0.5, 0.0, -1.0], [0.0, 2.0, 0.25, 1.0], [0.0, 0.0, 0.0, 0.0], [0.1, 0.0, 0.0, 1.0]])


def traced(
    function: Callable[..., Any], results: Mapping[str, int] | None = None, sizes: Mapping[str, int] = X
) -> Program:
    """Return the program of a function of vectors x and u; of its one result, f, or of several."""
    builder = Builder()
    arguments = {name: [builder.input(f"{name} {i}") for i in range(size)] for name, size in sizes.items()}
    found = trace(builder, function, arguments, results or {"f": sizes["x"]})
    outputs = {f"{name} {i}": value for name, values in found.items() for i, value in enumerate(values)}
    return builder.finish([], {}, outputs)


def evaluate(program: Program, values: Mapping[str, np.ndarray], fast: bool = False) -> np.ndarray:
    """Return its outputs, (entries, paths), of vectors with a column for each path."""
    rows = {f"{name} {i}": row for name, rows in values.items() for i, row in enumerate(rows)}
    paths = next(iter(values.values())).shape[1]
    inputs = np.array([rows[name] for name in program.inputs]).reshape(1, len(program.inputs), paths)
    tick = Kernel(program, "fast").run if fast else run
    return np.array([row[0] for row in tick(program, np.zeros((0, paths)), 1, inputs).outputs.values()])


def by_floats(function: Callable[..., Any], values: Mapping[str, np.ndarray], several: bool = False) -> np.ndarray:
    """Return what the function makes of each path by itself."""
    paths = next(iter(values.values())).shape[1]
    columns = list[np.ndarray]()
    for path in range(paths):
        with np.errstate(all="ignore"):
            found = function(*(rows[:, path].copy() for rows in values.values()))
        columns.append(np.concatenate([np.ravel(one) for one in (found if several else (found,))]))
    return np.array(columns).T


def numbers(seed: int, paths: int = 7, low: float = -3.0, high: float = 3.0) -> dict[str, np.ndarray]:
    """Return vectors x and u for some paths."""
    draws = np.random.default_rng(seed)
    return {name: draws.uniform(low, high, (size, paths)) for name, size in X.items()}


# what rounds once, or not at all: a program has the bits of floats
UNARY: dict[str, Callable[[Any], Any]] = {
    "negative": lambda a: -a, "absolute": abs, "square": lambda a: a**2, "halved": lambda a: a / 2,
    "root": lambda a: np.sqrt(abs(a)), "sign": np.sign, "floor": np.floor, "rolled": lambda a: np.roll(a, 1),
    "turned": lambda a: a[::-1], "half": lambda a: np.concatenate([a[2:], a[:2]]),
    "filled": lambda a: _filled(a), "clipped": lambda a: np.clip(a, -0.75, 1.5), "most": lambda a: a - np.max(a),
    "first": lambda a: a[0] * np.ones(4), "stacked": lambda a: np.stack([a, a + 1]).T.ravel()[::2],
    "ranged": lambda a: np.r_[a[1], np.atleast_1d(a[0]), a[2:]], "spread": lambda a: a - np.reshape(a[0], (1,)),
    "rebuilt": lambda a: np.array([a[3], 0.5, a[1], a[0]]), "mixed": lambda a: np.where(a > 0.5, a, 2.0),
}  # fmt: skip
BINARY: dict[str, Callable[[Any, Any], Any]] = {
    "sum": lambda a, b: a + b, "difference": lambda a, b: a - b, "product": lambda a, b: a * b,
    "ratio": lambda a, b: a / (abs(b) + 0.5), "smaller": np.minimum, "larger": np.maximum,
    "chosen": lambda a, b: np.where((a > b) | (abs(a) <= 0.5) & (b != 1), a, b),
    "not chosen": lambda a, b: np.where(~(a >= b), a, -b), "flagged": lambda a, b: (a < b) * 2.0 + b,
}  # fmt: skip


def _filled(a: Any) -> Any:
    found = np.zeros(4)
    found[0], found[1:3] = a[1], 2 * a[:2]
    found[3] += a[3]
    found[0] *= np.float64(-2)
    found[1:] -= np.abs(a[0])
    return found


TREES = st.recursive(
    st.sampled_from(["x", "1.5", "0", "1", "ones"]),
    lambda inner: st.one_of(
        st.tuples(st.sampled_from(sorted(UNARY)), inner), st.tuples(st.sampled_from(sorted(BINARY)), inner, inner)
    ),
    max_leaves=12,
)


def value_of(tree: Any, x: Any) -> Any:
    """Return what a tree of operations makes of a vector."""
    if isinstance(tree, str):
        return {"x": x, "ones": np.ones(4)}.get(tree, np.zeros(4) + float(tree) if tree[0] in "01" else 0)
    name, *rest = tree
    return (UNARY | BINARY)[name](*(value_of(one, x) for one in rest))  # type: ignore[operator]


@law(25, 300, tree=TREES, seed=st.integers(0, 2**32 - 1))
def test_a_program_has_the_bits_of_floats(tree: Any, seed: int) -> None:
    """Arithmetic, roots, choices, slices, stacks and arrays that are filled, in any order."""
    x = {"x": np.round(numbers(seed)["x"], seed % 4)}  # numbers that agree, too
    program = traced(lambda x: value_of(tree, x), sizes={"x": 4})
    expected = by_floats(lambda x: value_of(tree, x), x)
    np.testing.assert_array_equal(evaluate(program, x), expected)


SMOOTH: dict[str, Callable[[Any], Any]] = {  # that change a relative error by less than eight, on positive numbers
    "sin": lambda a: np.sin(a) + 2, "cos": lambda a: np.cos(a) + 2, "tanh": np.tanh, "exp": lambda a: np.exp(-a / 8),
    "log": lambda a: np.log(a + 1.5), "arctan": np.arctan, "arctan2": lambda a: np.arctan2(a, a[::-1]),
    "hypot": lambda a: np.hypot(a, 1.0), "power": lambda a: (a + 0.5) ** 1.5, "inverse": lambda a: (a + 0.5) ** -3,
    "matrix": lambda a: abs(A) @ a + 0.1, "inner": lambda a: a * (a @ a) / (1 + a.sum() ** 2),
    "outer": lambda a: np.outer(a, a) @ a / (1 + a @ a), "norm": lambda a: a / (0.5 + np.linalg.norm(a)),
    "tan": lambda a: np.tan(np.arctan(a) / 2), "mean": lambda a: a + np.mean(a),
}  # fmt: skip


@law(16, 200, names=st.lists(st.sampled_from(sorted(SMOOTH)), min_size=1, max_size=5), seed=st.integers(0, 2**32 - 1))
def test_a_program_has_nearly_all_digits_of_floats(names: list[str], seed: int) -> None:
    """Each function errs by three units at most, and those before it by eight times what they did."""

    def function(x: Any) -> Any:
        for name in names:
            x = SMOOTH[name](x)
        return x

    x = {"x": np.abs(numbers(seed)["x"]) + 0.1}
    program = traced(function, sizes={"x": 4})
    expected = by_floats(function, x)
    for fast in (False, True):
        assert evaluate(program, x, fast) == pytest.approx(expected, rel=len(names) * 30 * 2.2e-16 * 8 ** len(names))


@law(4, 50, seed=st.integers(0, 2**32 - 1), size=st.integers(1, 4), columns=st.integers(0, 2))
def test_a_system_of_equations_is_solved(seed: int, size: int, columns: int) -> None:
    """Of matrices that need their rows exchanged, too; to the digits that their condition leaves."""
    draws = np.random.default_rng(seed)
    x = draws.normal(size=(size * size + size * max(columns, 1), 1))
    x[draws.integers(0, size * size)] = 0.0

    def function(x: Any) -> Any:
        matrix, rest = x[: size * size].reshape(size, size), x[size * size :]
        return np.linalg.solve(matrix, rest if columns == 0 else rest.reshape(size, columns)).ravel()

    condition = np.linalg.cond(x[: size * size, 0].reshape(size, size))
    if condition < 1e6:
        program = traced(function, {"f": size * max(columns, 1)}, {"x": len(x)})
        expected = by_floats(function, {"x": x})
        assert np.abs(evaluate(program, {"x": x}) - expected).max() <= 1e-14 * condition * (1 + np.abs(expected).max())


def cart(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the next state of a pendulum on a cart, written as a textbook would."""
    _, speed, angle, turning = x
    s, c = np.sin(angle), np.cos(angle)
    rates = np.zeros(4)
    rates[0], rates[2] = speed, turning
    rates[1] = (u[0] + 0.2 * s * (0.5 * turning**2 - 9.81 * c)) / (1.0 + 0.2 * s**2)
    rates[3] = (9.81 * s - c * rates[1]) / 0.5
    return x + 0.01 * rates


def filtered(x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an estimate and what its covariance is, by matrices."""
    P = np.outer(x, x) + np.eye(4)
    S = P[:2, :2] + np.diag([0.5, 1.0])
    K = P[:, :2] @ np.linalg.inv(S)
    return x + K @ (u - x[:2]), ((np.eye(4) - K @ np.eye(2, 4)) @ P).reshape(16)


@pytest.mark.parametrize(("function", "results"), [(cart, {"f": 4}), (filtered, {"x": 4, "P": 16})])
def test_a_textbook_s_function_is_traced_as_it_stands(function: Callable[..., Any], results: dict[str, int]) -> None:
    """With unpacking, arrays that are filled, matrices and their inverses."""
    values = numbers(3)
    expected = by_floats(function, values, several=len(results) > 1)
    for fast in (False, True):
        found = evaluate(traced(function, results), values, fast)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)


def picks(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Use what is known as NumPy would: as places, as masks, in loops and conditions."""
    order, mask = np.array([2, 0, 3, 1]), np.array([0.5, 2.0, -1.0, 3.0]) > 0.75
    found = np.array([0.0, 0.0, 0.0, 0.0])
    found[mask] = x[order][mask]
    found[np.argsort([3.0, 1.0, 2.0, 0.0])[0]] += np.split(x, 2)[1][0]
    for i in np.concatenate([[0], [2]]):
        if np.linalg.det(np.diag([2.0, 1.0 + i])) > 3.0:
            found[i] = np.where(np.any(x > u[0]) & ~np.all(u > 0.0), np.minimum(np.split(x, 2)[0], 1.0).sum(), 7.0)
    weights = np.array([[1.0, 2.0], [3.0, 4.0]])
    weights[0] *= 2.0
    assert weights.sum() == 13.0
    assert (weights > 1.0).all()
    return found + np.full(4, 0.5) @ np.diag(np.arange(4)) + weights.ravel() * np.full(4, u[1])


def test_what_is_known_is_as_of_numpy() -> None:
    """Whole numbers stay whole, truth values true or false."""
    values = numbers(5)
    expected = by_floats(picks, values)
    for fast in (False, True):
        np.testing.assert_allclose(evaluate(traced(picks), values, fast), expected, rtol=1e-14)


def products(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Use each of NumPy's products of vectors and matrices, and bounds by either name."""
    square = np.reshape(x, (2, 2))
    known = np.identity(2, float) + np.array([[0.0, 2.0], [3.0, 0.0]])
    found = np.inner(square, known) + np.dot(square, known) - np.inner(square, square) @ np.outer(u, u)
    bounded = np.clip(x, a_min=-0.5, a_max=None) + np.clip(x, min=None, max=0.25)
    return found.ravel() * np.vdot(square, known) + bounded * np.inner(u, u)


@pytest.mark.skipif(not hasattr(np, "vecdot"), reason="this NumPy has clip without min and max")
def test_products_are_those_of_numpy() -> None:
    """Over the last axes, over all entries, or of rows and columns."""
    values = numbers(6)
    np.testing.assert_allclose(evaluate(traced(products), values), by_floats(products, values), rtol=1e-12)


class Scaled:
    """A function that is an object."""

    def __call__(self, x: Any, u: Any) -> Any:
        """Return the vector, filled in."""
        return helper(x) * u[0]

    def method(self, x: Any, u: Any) -> Any:
        """Return the same."""
        return u[0] * helper(x)


def helper(x: Any) -> Any:
    """Fill an array."""
    found = np.empty(4)
    found[:] = x
    return found


def outer(scale: float) -> Callable[..., Any]:
    """Return a function that calls itself, and knows a number."""

    def inner(x: Any, u: Any, times: int = 2) -> Any:
        return scale * helper(x) if times == 0 else inner(x, u, times - 1) + u[1]

    return inner


def same_array(x: Any, u: Any) -> Any:
    """Write through np.asarray, and not through np.array; dtypes by every name; an array of one number."""
    found, copied = np.zeros(4), np.array(x, np.double)
    np.asarray(found, dtype="d")[:] = np.asarray(x)
    np.array(found, order="C", ndmin=2)[:] = copied[0] = 5.0
    return np.sin(np.asarray(found)) + np.exp(np.asarray(x[1])) + copied + np.cos(np.array(0.5))


class Methods:
    """A function whose methods NumPy's own arrays reach."""

    def __call__(self, x: Any, u: Any) -> Any:
        """Return what they make."""
        return self.plain(x, u) + self.stacked(x, u)

    def plain(self, x: Any, u: Any) -> Any:
        """Compute with arrays that are not recorded."""
        return np.sin(np.asarray(x)) * np.arctan2(np.array(x), u[0]) + np.sqrt(np.array([x[0] ** 2, u[1] ** 2])).sum()

    def stacked(self, x: Any, u: Any) -> Any:
        """Compute with arrays that are."""
        return np.maximum(np.copy(x), np.exp(np.stack([x[0], 1.0, u[0], 2.0])))

    def mixed(self, x: Any, u: Any) -> Any:
        """Call a method that puts a number among symbols."""
        return self.mix(x)

    def mix(self, x: Any) -> Any:
        """Return what NumPy cannot compute."""
        return np.exp(np.array([x[0], 1.0, x[2], x[3]]))

    def solved(self, x: Any, u: Any) -> Any:
        """Call a method that solves."""
        return self.solve(x)

    def solve(self, x: Any) -> Any:
        """Return what NumPy cannot solve."""
        return np.linalg.solve(A, np.asarray(x))


@pytest.mark.parametrize("function", [same_array, Methods()])
def test_arrays_of_symbols_are_those_of_numpy(function: Callable[..., Any]) -> None:
    """What shares memory does so when it is traced; a plain array of symbols computes entry by entry."""
    values = numbers(7)
    np.testing.assert_allclose(evaluate(traced(function), values), by_floats(function, values), rtol=1e-12)


@pytest.mark.parametrize(
    "function", [Scaled(), Scaled().method, outer(1.5), partial(outer(0.5), times=1), lambda x, u: helper(x) + u[0]]
)
def test_functions_of_every_kind_are_traced(function: Callable[..., Any]) -> None:
    """Objects, methods, closures, partial ones and lambdas; arrays are filled in what they call, too."""
    values = numbers(4)
    np.testing.assert_allclose(evaluate(traced(function), values), by_floats(function, values), rtol=1e-14)


def test_a_function_is_called_once_and_always_traced_alike() -> None:
    """Two programs of a function are equal, and another one's is not."""
    calls = list[int]()

    def function(x: Any, u: Any) -> Any:
        calls.append(1)
        return cart(x, u)

    one, other = traced(function), traced(function)
    assert len(calls) == 2
    assert one == other
    assert one != traced(lambda x, u: cart(x, 2 * u))


def test_zeros_and_ones_leave_no_operations() -> None:
    """A matrix of zeros and ones costs what it selects; what is known is computed at once; equal parts are shared."""
    assert traced(lambda x, u: np.eye(4) @ x * 1.0 + 0.0 * np.exp(x)).operations == 0
    assert traced(lambda x, u: x + (math.sin(2.0) + np.log(np.array([2.0, 3.0, 4.0, 5.0])))).operations == 4
    once, twice = (traced(lambda x, u, n=n: sum(np.sin(x) for _ in range(n))) for n in (1, 2))
    assert twice.operations == once.operations + 4


def test_a_large_known_matrix_is_one_operation() -> None:
    """As in steps that are linear."""
    M = np.random.default_rng(1).normal(size=(20, 20))
    program = traced(lambda x: M @ x, sizes={"x": 20})
    assert [op.name for op in program.ops].count("product") == 1
    x = {"x": np.random.default_rng(2).normal(size=(20, 3))}
    np.testing.assert_allclose(evaluate(program, x), M @ x["x"], rtol=1e-12, atol=1e-12)


def branches(x: Any, u: Any) -> Any:
    """Choose as a traced function cannot."""
    return x if x[0] > 0 else -x


BAD: dict[str, tuple[Callable[..., Any], str]] = {
    "branch": (branches, "branches needs the truth value of a condition .*; expected np.where"),
    "builtin max": (lambda x, u: x * max(x[0], 1.0), "needs the truth value of a condition \\(for if, and, or, max\\)"),
    "sine of floats": (lambda x, u: x * math.sin(x[0]), "number to a float \\(as math.sin.* np.stack"),
    "float": (lambda x, u: x * float(x[0]), "converts a traced number to a float"),
    "range": (lambda x, u: x * len(range(x[0])), "converts a traced number to an integer"),
    "transform": (
        lambda x, u: np.fft.fft(x),
        "uses np.fft, which cannot be traced; expected one of absolute",
    ),
    "cube root": (
        lambda x, u: np.cbrt(x),
        "uses np.cbrt, which cannot be traced; expected one of absolute",
    ),
    "accumulate": (lambda x, u: np.add.accumulate(x), "uses np.add.accumulate, which cannot be traced"),
    "masked": (
        lambda x, u: np.add(x, 1.0, where=[True, False, True, False]),
        "uses np.add with one of the arguments where, initial and",
    ),
    "begun": (
        lambda x, u: x * x.sum(initial=2.0),
        "uses np.add with one of the arguments where, initial and dtype, which cannot be traced",
    ),
    "order": (lambda x, u: x * np.linalg.norm(x, 1), "np.linalg.norm of order 1 cannot be traced; expected the Eucl"),
    "exponent": (lambda x, u: x**2.3, "the exponent of a traced number is 2.3; expected a constant integer or"),
    "traced exponent": (lambda x, u: 2.0**x, "the exponent of a traced number is a traced number; expected"),
    "short": (lambda x, u: x[:2], r"returns f of shape \(2,\); expected the shape \(4,\), one number for each entry"),
    "matrix": (lambda x, u: np.outer(x, x), r"returns f of shape \(4, 4\); expected the shape \(4,\)"),
    "nothing": (lambda x, u: None, r"returns nothing; expected the vector f"),
    "no number": (lambda x, u: np.append(x[:3], np.nan), "returns nan as entry 3 of f for .* expected a finite number"),
    "infinite": (lambda x, u: np.append(x[:3], np.inf), "returns inf as entry 3 of f for all"),
    "computed": (lambda x, u: x * np.nan, r"computes with a constant NaN; expected finite"),
    "text": (lambda x, u: x + np.array(["a"] * 4, dtype=object), "computes with 'a'; expected numbers"),
    "shapes": (lambda x, u: x + u, "fails when it is traced: ValueError: .*; expected a function of the vectors x, u"),
    "products": (lambda x, u: A @ u, r"@ have the shapes \(4, 4\) and \(2,\); expected vectors or matrices"),
    "parameters": (lambda x: x, "fails when it is traced: TypeError: .* expected a function of the vectors x, u"),
    "raises": (lambda x, u: [][0], "fails when it is traced: IndexError: list index out of range; expected"),
    "system": (lambda x, u: np.linalg.solve(A, u), r"np.linalg.solve have the shapes \(4, 4\) and \(2,\); expected a"),
    "number among symbols": (
        Methods().mixed,
        "computes with traced numbers in a plain array of objects.*; expected .* np.stack",
    ),
    "system of a method": (Methods().solved, "computes with traced numbers in a plain array of objects"),
    "filled": (lambda x, u: np.zeros(4, dtype=int).__setitem__(0, x[0]), "converts a traced number to an integer"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_traced_is_said_in_one_sentence(name: str) -> None:
    """What, got, expected, and what to write instead; whatever the function does."""
    function, message = BAD[name]
    with pytest.raises(ProblemError, match=message) as told:
        traced(function)
    assert "\n" not in str(told.value)


def test_several_results_are_a_tuple() -> None:
    """Of as many, and of their sizes."""
    assert list(traced(lambda x, u: (x, u[0]), {"f": 4, "g": 1}).outputs) == ["f 0", "f 1", "f 2", "f 3", "g 0"]
    with pytest.raises(ProblemError, match="returns 3 values; expected a tuple of 2 vectors: f, g"):
        traced(lambda x, u: (x, u, x), {"f": 4, "g": 2})
    with pytest.raises(ProblemError, match="returns one vector; expected a tuple of 2 vectors: f, g"):
        traced(lambda x, u: x, {"f": 4, "g": 2})
    with pytest.raises(ProblemError, match=r"returns g of shape \(2,\); expected the shape \(1,\)"):
        traced(lambda x, u: (x, u), {"f": 4, "g": 1})
