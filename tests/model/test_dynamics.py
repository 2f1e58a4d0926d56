"""Plants that are not linear: their linearisation, their motion in time, and what no plant's function may do."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from drawn import law
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from taciturn import ContinuousPlant, Plant, ProblemError, integrate, linearise, load
from taciturn.model.dynamics import Dynamics, dynamics_of

BUILT_IN = ("pendulum-on-a-cart", "pendulum-by-encoders", "omni-heading")


def bent(x: Any, u: Any, w: Any) -> Any:
    """Return a step of one state that bends: its derivatives at 0 are 1.2 and 1."""
    return 1.2 * np.sin(x) + u + w


def plant_of(function: Callable[..., Any], A: float = 1.2, B: float = 1.0, W: float = 0.01) -> Plant:
    """Return a plant of one state."""
    return Plant([[A]], [[B]], [[W]], function=function)


@law(8, 100, seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-3, 1.0, 1e3]))
def test_a_linearisation_is_that_of_calculus(seed: int, scale: float) -> None:
    """Of sines, exponentials, products and quotients of random matrices, anywhere, to ten digits of the largest.

    The rounding errors of f are relative to its values, so that a small B next to a large A has fewer digits.
    """
    draws = np.random.default_rng(seed)
    n, m = int(draws.integers(1, 5)), int(draws.integers(1, 3))
    P, D = scale * draws.normal(size=(n, n)), draws.normal(size=(n, m))
    x, u = draws.normal(size=n), draws.normal(size=m)

    def f(x: Any, u: Any, w: Any) -> Any:
        return P @ np.sin(x) + np.exp(x / 4) * (D @ u) + scale * x[0] / (2.0 + np.cos(x)) + w

    A, B = linearise(f, n, m, at=(x, u))
    expected = P * np.cos(x) + np.diag(np.exp(x / 4) / 4 * (D @ u))
    expected += scale * np.diag(x[0] * np.sin(x) / (2.0 + np.cos(x)) ** 2)
    expected[:, 0] += scale / (2.0 + np.cos(x))
    size = float(np.abs(expected).max())
    np.testing.assert_allclose(A, expected, rtol=0, atol=1e-10 * size)
    largest = max(size, float(np.abs(D).max() * np.exp(1.0)))
    np.testing.assert_allclose(B, np.exp(x / 4)[:, None] * D, rtol=0, atol=1e-10 * largest)


def test_rounding_that_agrees_by_chance_is_no_derivative() -> None:
    """Next to a value of 300, the quotients of the shortest steps agree exactly, on digits that are rounding."""
    for slope in 0.3 + np.arange(40) / 7:
        _, B = linearise(lambda x, u, w, slope=slope: x + 300.0 + slope * u, 1, 1)
        assert abs(B.item() - slope) <= 1e-13 * 300.0


def test_a_linearisation_does_not_look_beyond_where_a_function_is_defined() -> None:
    """Steps become shorter until the numbers are finite, and until a clip is not seen any more."""
    A, _ = linearise(lambda x, u, w: np.log1p(1e4 * x) + u, 1, 1)
    assert A.item() == pytest.approx(1e4, rel=1e-9)
    A, _ = linearise(lambda x, u, w: np.clip(x, -1e-4, 1e-4) + u, 1, 1)
    assert A.item() == pytest.approx(1.0, rel=1e-9)
    with pytest.raises(ProblemError, match=r"^the function returns no finite values when x1 changes by"):
        linearise(lambda x, u, w: x / 0.0 + u, 1, 1)


@pytest.mark.parametrize(("steps", "order"), [(1, 4), (2, 4)])
def test_the_error_of_a_step_shrinks_as_runge_and_kutta_say(steps: int, order: int) -> None:
    """Sixteen times for twice the steps, against an adaptive rule of eighth order."""

    def ode(x: Any, u: Any) -> list[Any]:
        return [x[1], -np.sin(x[0]) - 0.2 * x[1] + u[0]]

    x, u, w = np.array([0.9, -0.4]), np.array([0.3]), np.array([0.1, -0.2])
    exact = solve_ivp(lambda t, x: ode(x, u), (0.0, 0.8), x, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    errors = [np.abs(integrate(ode, 0.8, k)(x, u, w) - w - exact).max() for k in (steps * 4, steps * 8)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.3)


def test_an_integrated_linear_equation_is_the_exponential_of_its_matrix() -> None:
    """To the fifth power of the step."""
    G = np.array([[0.0, 1.0], [-2.0, -0.3]])
    A, B = linearise(integrate(lambda x, u: G @ x + np.array([0.0, 1.0]) * u[0], dt=0.1, steps=4), 2, 1)
    whole = expm(0.1 * np.block([[G, np.array([[0.0], [1.0]])], [np.zeros((1, 3))]]))
    bound = 4 * (0.025 * 3.0) ** 5 / math.factorial(5)  # four steps, the norm of the matrix is below 3
    assert np.abs(np.hstack([A, B]) - whole[:2]).max() < bound


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_built_in_plant_has_the_linearisation_that_its_file_states(name: str) -> None:
    """To the digits that are written, which is tighter than what is demanded."""
    plant = load(name).plant
    assert isinstance(plant, Plant)
    assert plant.function is not None
    A, B = linearise(plant.function, plant.states, plant.inputs)
    np.testing.assert_allclose(A, plant.A, rtol=0, atol=1e-14)
    np.testing.assert_allclose(B, plant.B, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("function", "sentence"),
    [
        (3.0, "function is 3.0; expected a function x, u, w → x⁺"),
        (lambda x, u, w: x / 0.0, "function returns nan as state 1 at x = 0, u = 0, w = 0; expected finite numbers"),
        (lambda x, u, w: np.log(x), "function returns -inf as state 1 at x = 0, u = 0, w = 0; expected finite numbers"),
        (
            lambda x, u, w: x + 1.0,
            "the function returns 1 as state 1 at x = 0, u = 0, w = 0; expected 0, because A and B",
        ),
        (
            lambda x, u, w: np.zeros(2),
            "the function returns an array of the shape (2,); expected (1,), the shape of the next state",
        ),
        (
            lambda x, u, w: 0.0,
            "the function returns an array of the shape (); expected (1,), the shape of the next state",
        ),
        (lambda x, u, w: "here", "the function returns 'here', which is not an array of numbers"),
        (lambda x, u, w: None, "the function returns None, which is not an array of numbers"),
        (
            lambda x, u, w: x[1],
            "function fails at the point x = [0.0], u = [0.0], w = [0.0] (IndexError: index 1 is out of",
        ),
        (lambda x, u: x, "function fails at the point x = [0.0], u = [0.0], w = [0.0] (TypeError: "),
        (
            lambda x, u, w: 1.3 * x + u + w,
            "the matrix A has 1.2 in row 1, column 1, but the derivative of the function with respect to x at 0 has",
        ),
        (
            lambda x, u, w: 1.2 * x + w,
            "the matrix B has 1 in row 1, column 1, but the derivative of the function with respect to u at 0 has 0 ",
        ),
        (
            lambda x, u, w: 1.2 * x + u,
            "the derivative of the function with respect to w at 0 has the row [0] for state 1; expected the",
        ),
        (
            lambda x, u, w: bent(x, u, 2.0 * w),
            "the derivative of the function with respect to w at 0 has the row [2] for state 1",
        ),
    ],
)
def test_what_is_no_function_of_a_plant_is_refused_in_a_sentence(function: Any, sentence: str) -> None:
    """What, got, expected, remedy."""
    with pytest.raises(ProblemError) as refused:
        plant_of(function)
    assert str(refused.value).startswith(sentence)
    assert "\n" not in str(refused.value)


def test_a_function_that_draws_is_refused() -> None:
    """Recorded once, its draw would be the same at every step; the noise of a plant is w."""
    draws = np.random.default_rng(1)
    with pytest.raises(ProblemError, match="two different results for the same x, u and w"):
        Plant([[0.5]], [[1.0]], [[1.0]], function=lambda x, u, w: 0.5 * x + u + w + draws.normal() * x**2)


def test_noise_that_is_never_drawn_may_enter_as_it_likes() -> None:
    """The derivative by w matters where W is not 0."""
    assert plant_of(lambda x, u, w: 1.2 * np.sin(x) + u + 7.0 * w, W=0.0).function is not None
    W = np.diag([0.0, 0.1])
    turned = Plant(0.5 * np.eye(2), np.eye(2), W, function=lambda x, u, w: 0.5 * x + u + np.array([7.0, 1.0]) * w)
    assert turned.function is not None


def test_a_function_is_part_of_the_plant_and_only_of_a_discrete_one() -> None:
    """The plant says so by a type error in Python, as for any other argument that it has not."""
    assert Plant([[1.2]], [[1.0]], [[0.01]]).function is None
    assert plant_of(bent).function is not None
    with pytest.raises(TypeError):
        ContinuousPlant([[1.2]], [[1.0]], [[0.01]], function=bent)  # type: ignore[call-arg]


def test_a_function_goes_to_other_processes_if_they_can_find_it() -> None:
    """By its name in a module, or as the text of its file; a lambda is refused in a sentence."""
    again = pickle.loads(pickle.dumps(plant_of(bent)))
    assert again.function([0.3], [0.1], [0.0]) == plant_of(bent).function([0.3], [0.1], [0.0])
    read = dynamics_of("def f(x, u, w):\n    return 1.2 * x + u + w\n", "a file", "f")
    assert pickle.loads(pickle.dumps(read)) is read
    with pytest.raises(ProblemError, match=r"^function is <function .*, which other processes cannot import .*; expec"):
        pickle.dumps(plant_of(lambda x, u, w: bent(x, u, w)))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"dt": 0.0}, "dt is 0; expected 0 < dt"),
        ({"steps": 0}, "steps is 0; expected a whole number of at least 1"),
        ({"ode": 1}, "ode is 1; expected a function x, u → dx/dt"),
    ],
)
def test_what_no_rule_integrates_is_refused(arguments: dict[str, Any], sentence: str) -> None:
    """Before anything runs."""
    with pytest.raises(ProblemError) as refused:
        integrate(**{"ode": lambda x, u: x, "dt": 0.1, **arguments})
    assert str(refused.value) == sentence


def test_an_equation_of_another_size_is_refused() -> None:
    """Its value must be as long as the state; numpy would stretch it."""
    with pytest.raises(
        ProblemError,
        match=r"^ode returns an array of the shape \(1,\); expected \(2,\), the shape of the state$",
    ):
        linearise(integrate(lambda x, u: [x[0]], 0.1), 2, 1)


def test_derivatives_are_found_once() -> None:
    """Problems that are changed make plants anew, with the same function."""
    calls: list[int] = []

    def counted(x: Any, u: Any, w: Any) -> Any:
        calls.append(1)
        return bent(x, u, w)

    known = Dynamics(counted)
    plant_of(known)
    first = len(calls)
    plant_of(known, W=0.5)
    assert len(calls) == first + 3  # at rest, and twice near it
