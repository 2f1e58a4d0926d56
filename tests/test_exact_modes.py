"""Modes that no input moves, and on which side of the stability limit they lie, decided without a tolerance."""

import numpy as np
import pytest
from flint import fmpq_mat

from taciturn import ContinuousPlant, Cost, Plant, ProblemError, UnstableError, close, design
from taciturn._rational import Limit, Lost, above, modes_of, rational, reaches_all, unmoved, unmoved_and_seen
from taciturn.lqg.discrete import discretise
from taciturn.lqg.equation import accumulate
from taciturn.lqg.kalman import steady_filter
from taciturn.lqg.quadratic import Quadratic, unpaid
from taciturn.lqg.riccati import regulate
from taciturn.simulation.reliability import comes_never_to_rest

CIRCLE, AXIS = Limit(False), Limit(True)
TINY = 2.0**-50  # of 1, far below the scatter of computed eigenvalues


def split(found: Lost) -> list[list[complex]]:
    """The modes outside, on and inside the limit, rounded."""
    return [np.round(part, 9).tolist() for part in found]


def no_input(A: list[list[float]], limit: Limit) -> list[list[complex]]:
    """The modes of a matrix on which no input acts."""
    return split(unmoved(np.array(A, dtype=np.float64), np.zeros((len(A), 1)), limit))


def mixed(A: np.ndarray, draws: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return T A T⁻¹ and T for a random matrix T of whole numbers whose inverse has whole numbers too."""
    n = len(A)
    lower, upper = (np.tril(draws.integers(-2, 3, (n, n)), -1).astype(float) + np.eye(n) for _ in range(2))
    T, inverse = lower @ upper.T, np.round(np.linalg.inv(lower @ upper.T))
    assert np.array_equal(T @ inverse, np.eye(n))
    return T @ A @ inverse, T


def test_by_hand():
    """Diagonal and triangular matrices, and an oscillator."""
    assert no_input([[2, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]], CIRCLE) == [[2], [1], [0.5, 0]]
    assert no_input([[0, 1], [-1, 0]], AXIS) == [[], [1j, -1j], []]
    assert no_input([[0.75, 1], [0, 2]], Limit(False, 0.25)) == [[], [2], [0.75]]
    # the line at −ln(0.9)/(2·0.5) = 0.10536
    assert no_input([[0.11, 1], [0, 0.1]], Limit(True, 0.9, 0.5)) == [[0.11], [], [0.1]]


def test_hardly_inside_and_hardly_outside():
    """Double modes at a distance at which computed eigenvalues scatter a million times farther."""
    at = [1 + TINY, 1.0, 1 - TINY]
    for one, side in zip(at, range(3), strict=True):
        found = unmoved(np.array([[one, 1.0], [0.0, one]]), np.zeros((2, 1)), CIRCLE)  # a Jordan block: √ of rounding
        assert [len(part) for part in found] == [2 * (k == side) for k in range(3)]
    for rate, side in ((TINY, 0), (0.0, 1), (-TINY, 2)):
        found = unmoved(np.array([[rate, 1.0], [0.0, rate]]), np.zeros((2, 1)), AXIS)
        assert [len(part) for part in found] == [2 * (k == side) for k in range(3)]


def test_a_polynomial_without_factors_on_both_sides():
    """Modes on the circle and off it may be roots of one irreducible polynomial."""
    # z⁴ − z³ − z² − z + 1 (of Salem) has two roots on the circle, and 1.7221 and its inverse; it does not factor
    found = no_input([[0, 0, 0, -1], [1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]], CIRCLE)
    assert [len(part) for part in found] == [1, 2, 1]
    assert found[0][0] == pytest.approx(1.722083806)
    assert found[2][0] == pytest.approx(1 / 1.722083806)


@pytest.mark.parametrize("continuous", [False, True])
def test_in_any_coordinates(continuous: bool):
    """Oscillators on known sides of the limit, with states that the input moves, in whole-number coordinates."""
    draws = np.random.default_rng(5)
    for _ in range(40):
        count = draws.integers(0, 3, 3)
        sides = np.repeat([1, 0, -1], count)
        parts = list[np.ndarray]()
        for side in sides:  # oscillators: λ² − 2cλ + d, with |λ|² = d or Re λ = c
            c = draws.integers(-7, 8) / 8
            c, d = (side * abs(c) + side / 8, 4.0) if continuous else (c, 1 + side * 2.0 ** -draws.integers(3, 25))
            parts.append(np.array([[0.0, -d], [1.0, 2 * c]]))
        n, moved = 2 * len(parts), int(draws.integers(1, 3))
        A = np.zeros((n + moved, n + moved))
        for k, part in enumerate(parts):
            A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = part
        A[n:] = draws.integers(-3, 4, (moved, n + moved)) / 2  # what the input moves depends on the others
        A[n:, n:] += np.diag(np.arange(moved))
        B = np.zeros((n + moved, moved))
        B[n:] = np.eye(moved)
        turned, T = mixed(A, draws)
        found = unmoved(turned, T @ B, AXIS if continuous else CIRCLE)
        assert [len(part) for part in found] == (2 * count).tolist()


def test_zeros_are_those_of_the_transfer_function():
    """The input moves y = Cx as (z − 1)(z − 0.5)/(…): it keeps the state moving along 1 and 0.5 at no cost."""
    A = np.array([[0.0, 1, 0], [0, 0, 1], [0.25, 0.5, -0.75]])
    B, C = np.array([[0.0], [0], [1]]), np.array([[0.5, -1.5, 1.0]])
    given = Quadratic(A, B, C.T @ C, np.zeros((1, 1)), np.zeros((3, 1)))
    assert split(unpaid(given, CIRCLE)) == [[], [1], [0.5]]
    definite = Quadratic(A, B, C.T @ C, np.eye(1), np.zeros((3, 1)))
    assert split(unpaid(definite, CIRCLE)) == split(modes_of(fmpq_mat(0, 0), CIRCLE)) == [[], [], []]


def test_the_plant_before_it_was_sampled_gives_the_reason():
    """An oscillator, a drift of a state that no input moves: e^{Ah} in doubles has its modes beside the circle."""
    A, B = np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([[0.0], [1.0]])
    with pytest.raises(UnstableError, match=r"the mode 0\+1i on the imaginary axis does not affect the cost"):
        design.all_time(ContinuousPlant(A, B, np.eye(2)), Cost(np.zeros((2, 2)), [[1.0]]), period=0.3)
    both = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    with pytest.raises(UnstableError, match=r"A has the eigenvalue 0\+1i, which is uncontrollable.*imaginary axis"):
        design.all_time(ContinuousPlant(both, [[0.0], [0.0], [1.0]], np.eye(3)), Cost(np.eye(3), [[1.0]]), period=0.3)


UNTOUCHED = [(1 + 2.0**-26, "refused"), (1.0, 0.5), (1 - 2.0**-26, 1 - 2.0**-26), (1 - 2.0**-46, 1 - 2.0**-46)]


@pytest.mark.parametrize(("mode", "slowest"), UNTOUCHED)
def test_a_block_that_nothing_touches_is_left_out_unless_it_grows(mode: float, slowest: float | str):
    """Next to a state with an input and a cost, in whole-number coordinates; so is the dual of the filter."""
    U, inverse = np.array([[2.0, 1.0], [1.0, 1.0]]), np.array([[1.0, -1.0], [-1.0, 2.0]])
    A = np.diag([0.0, 0.0, 1.2])
    A[:2, :2] = U @ np.diag([mode, 0.5]) @ inverse
    B = np.array([[0.0], [0.0], [1.0]])
    given = A, B, np.diag([0.0, 0.0, 1.0]), np.eye(1), np.zeros((3, 1))
    if slowest == "refused":
        with pytest.raises(UnstableError, match="uncontrollable through B; expected"):
            regulate(*given)
        with pytest.raises(UnstableError, match="which C does not observe; expected"):
            steady_filter(A.T, B.T, given[2], given[3])
        return
    found = regulate(*given)
    assert not found.L[0, :2].any()
    assert found.slowest == pytest.approx(slowest, abs=1e-15)


@pytest.mark.parametrize("discount", [1.0, 0.25])
@pytest.mark.parametrize("seen", [False, True])
def test_the_message_says_whether_a_marginal_mode_affects_the_cost(seen: bool, discount: float):
    """The mode on the limit and one of 0.5 in whole-number coordinates: the cost, or noise, shows both or only 0.5."""
    U, inverse = np.array([[2.0, 1.0], [1.0, 1.0]]), np.array([[1.0, -1.0], [-1.0, 2.0]])
    A, Q = np.diag([0.0, 0.0, 1.2]), np.eye(3)
    A[:2, :2] = U @ np.diag([discount**-0.5, 0.5]) @ inverse
    if not seen:
        Q[:2, :2] = np.outer(inverse[1], inverse[1])
    B, R, N = np.array([[0.0], [0.0], [1.0]]), np.eye(1), np.zeros((3, 1))
    with pytest.raises(UnstableError, match="and affects the cost" if seen else "does not affect the cost, and is a"):
        regulate(A, B, Q, R, N, discount)
    if discount == 1:
        said = "noise W reaches it; expected" if seen else "noise W does not affect it, and it is a combination"
        with pytest.raises(UnstableError, match=said):
            steady_filter(A.T, B.T, Q, R)


def test_of_two_marginal_modes_the_message_names_the_one_that_affects_the_cost():
    """A mode 1 that no cost depends on and an oscillator that one depends on, mixed by whole numbers."""
    draws = np.random.default_rng(2)
    A, T = mixed(np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 0.5]]), draws)
    rows = np.round(np.linalg.inv(T))
    B, unmoved_rows = T[:, 3:], rows[1:]
    with pytest.raises(UnstableError, match=r"eigenvalue 0\+1i, .* and affects the cost"):
        regulate(A, B, unmoved_rows.T @ unmoved_rows, np.eye(1), np.zeros((4, 1)))
    found = unmoved_and_seen(A, B, unmoved_rows, CIRCLE)
    assert split(found) == [[], [1j, -1j], []]
    assert split(unmoved_and_seen(A, B, np.eye(4), CIRCLE)) == split(unmoved(A, B, CIRCLE))
    assert split(unmoved_and_seen(A, B, rows[3:], CIRCLE)) == [[], [], []]


def test_a_mode_is_named_with_the_digits_that_tell_it_from_the_limit():
    """Modes near the circle, the axis and the circle of a discount; a mode on the limit has the usual digits."""
    inner = 1 / 0.81**0.5
    for limit, mode, text in (
        (CIRCLE, 1 + 1.6e-8, "1.00000002"),
        (CIRCLE, 1 - 1.2e-8, "0.99999999"),
        (CIRCLE, -1 - 1e-12, "-1.000000000001"),
        (CIRCLE, 2.0, "2"),
        (CIRCLE, complex(0.6, 0.8), "0.6+0.8i"),
        (AXIS, complex(1e-12, 1), "1e-12+1i"),
        (Limit(False, 0.81), inner + 2e-8, "1.11111113"),
        (Limit(False, 0.81), inner, "1.11111"),
    ):
        assert limit.named(mode) == text
    assert str(Limit(False, 0.81)).endswith("= 1.11111")
    with pytest.raises(UnstableError, match=r"eigenvalue 1\.1111111\d, .* 1/√discount = 1\.11111111 must be"):
        regulate(np.diag([inner + 1e-8, 2.0]), [[0], [1]], np.eye(2), np.eye(1), np.zeros((2, 1)), 0.81)
    with pytest.raises(ProblemError, match=r"the growing mode with the eigenvalue 1\.0000002"):
        Plant(np.diag([1 + 2e-7, 0.5]), [[0.0], [1.0]], np.eye(2))
    assert "unstable: 1.000002, 0.5" in str(Plant(np.diag([1 + 2e-6, 0.5]), [[1.0], [1.0]], np.eye(2)))


def test_states_measured_without_noise_need_a_gain_that_a_double_holds():
    """Two outputs that are nearly equal show two fast modes; the rounded inverse leaves a growing error."""
    with pytest.raises(UnstableError, match="more digits than a double holds"):
        steady_filter(np.diag([1e4, 3e4]), [[1, 1], [1, 1 + 1e-14]], np.eye(2), np.zeros((2, 2)))
    found = steady_filter(np.diag([2.0, 3.0]), [[1, 1], [1, 2]], np.eye(2), np.zeros((2, 2)))
    assert found.slowest < 1e-14


def test_a_sum_is_called_divergent_only_if_it_diverges():
    """A Jordan block in whole-number coordinates, whose computed eigenvalues scatter across the circle."""
    lower = np.tril(np.ones((6, 6)))
    U, inverse = lower @ lower.T, np.round(np.linalg.inv(lower @ lower.T))
    for distance, said in ((2.0**-8, "F is stable"), (-(2.0**-8), "so the sum .* diverges")):
        F = U @ (np.diag(np.full(6, 1 - distance)) + np.diag(np.ones(5), 1)) @ inverse
        with pytest.raises(UnstableError, match=said):
            accumulate(F, np.eye(6))


@pytest.mark.parametrize("seed", range(8))
def test_an_input_reaches_all_states_if_its_powers_have_full_rank(seed):
    """Sparse matrices of doubles from 1e-300 to 1e300: the rank of B, AB, A²B, … in rational numbers decides."""
    draws = np.random.default_rng(seed)
    answers = set()
    for _ in range(30):
        n, m = int(draws.integers(1, 7)), int(draws.integers(1, 4))
        A, B = (draws.normal(size=size) * 10.0 ** draws.integers(-300, 301, size) for size in ((n, n), (n, m)))
        A, B = A * (draws.random((n, n)) < 0.4), B * (draws.random((n, m)) < 0.5)
        exact, columns = rational(A), [rational(B)]
        for _ in range(n - 1):
            columns.append(exact * columns[-1])
        answers.add(reaches_all(A, B))
        assert reaches_all(A, B) == (above(*(column.transpose() for column in columns)).rank() == n)
    assert answers == {True, False}


@pytest.mark.parametrize("states", [3, 4, 5])
def test_sampling_a_chain_of_integrators_does_not_let_it_grow(states: int):
    """In whole-number coordinates, beside a state with an input: e^{Ah} in doubles has modes up to 1.0002."""
    lower = np.tril(np.ones((states, states)))
    U, inverse = lower @ lower.T, np.round(np.linalg.inv(lower @ lower.T))
    A, B, Q = np.zeros((states + 1, states + 1)), np.eye(states + 1)[:, -1:], np.zeros((states + 1, states + 1))
    A[:-1, :-1], A[-1, -1], Q[-1, -1] = U @ np.diag(np.ones(states - 1), 1) @ inverse, -1.0, 1.0
    sampled = discretise(ContinuousPlant(A, B, Q), Cost(Q, [[1.0]]), 0.3)
    assert not unmoved(A, B, AXIS).growing.size
    assert unmoved(sampled.plant.A, sampled.plant.B, CIRCLE).growing.size
    one = ContinuousPlant(A[-1:, -1:], B[-1:], Q[-1:, -1:])
    found, alone = sampled.regulator(), discretise(one, Cost([[1.0]], [[1.0]]), 0.3)
    assert not found.L[:, :-1].any()
    assert found.L[0, -1] == pytest.approx(alone.regulator().L[0, 0], rel=1e-12)
    assert sampled.lasting.tolist() == [True] * states + [False]


def test_a_rounded_rotation_stays_and_one_that_grows_is_refused():
    """Cosine and sine of a user, whose squares add to more than 1; the same times 1 + 1e-9."""
    c, s = np.cos(0.5), np.sin(0.5)
    turn, still = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 0.5]]), np.zeros((3, 3))
    B = np.array([[0.0], [0.0], [1.0]])
    assert unmoved(turn, B, CIRCLE).growing.size
    Plant(turn, B, still)
    with pytest.raises(
        ProblemError, match=r"no input affects the growing mode with the eigenvalue 0\.877583\+0\.479426i"
    ):
        Plant((1 + 1e-9) * turn, B, still)


def test_a_block_of_many_states_that_no_input_moves():
    """Ten states beyond forty that two inputs reach, with random doubles: their modes are those of their block."""
    draws = np.random.default_rng(3)
    A, B = draws.normal(size=(50, 50)) / 7, draws.normal(size=(50, 2))
    A[40:, :40], B[40:] = 0.0, 0.0
    found, expected = np.concatenate(unmoved(A, B, CIRCLE)), np.linalg.eigvals(A[40:, 40:])
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(expected))


@pytest.mark.parametrize(("A", "rests"), [(1 - 1e-14, True), (1.0, False)])
def test_a_plant_that_decays_slowly_comes_to_rest(A: float, rests: bool):
    """A hundred roundings from the circle."""
    policy = design.excess(Plant([[A]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), theta=0.1)
    assert comes_never_to_rest(close(policy.model, policy)) is not rests
