"""Plants, costs and networks refuse data that do not fit, in sentences that say what, got and expected."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from taciturn import Burst, ContinuousPlant, Cost, Jumps, Network, Plant, ProblemError
from taciturn.model.saturation import limit_entries

GOOD: dict[str, Any] = {
    "A": [[1.0, 0.1], [0.0, 1.0]],
    "B": [[0.005], [0.1]],
    "W": [[0.01, 0.0], [0.0, 0.01]],
    "C": [[1.0, 0.0]],
    "V": [[0.01]],
}
GROWING: dict[str, Any] = {"A": [[1.1, 0.1], [0.0, 1.1]]}
CONTINUOUS: dict[str, Any] = {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "W": [[0, 0], [0, 2.5]]}
WEIGHTS: dict[str, Any] = {"Q": np.eye(2), "R": [[1.0]]}


FORM = "such as [[0.9, 0.1], [0.0, 0.8]]"


def refusal(make: Callable[..., object], data: dict[str, Any]) -> str:
    """Return the sentence with which data are refused."""
    with pytest.raises(ProblemError) as found:
        make(**data)
    return str(found.value)


def test_a_number_is_a_matrix_or_vector_with_one_entry() -> None:
    """In Python as in files, and for NumPy's numbers."""
    plant = Plant(1.2, 1, np.float64(0.01), 2, 0.1, mean=1.0, covariance=np.array(0.5), input_limit=3.0, D=0.2)
    same = Plant([[1.2]], [[1]], [[0.01]], [[2]], [[0.1]], mean=[1.0], covariance=[[0.5]], input_limit=[3.0], D=[[0.2]])
    assert repr(plant) == repr(same)
    assert np.array_equal(plant.mean, same.mean)
    assert np.array_equal(ContinuousPlant(1.2, 1, 0.01).A, [[1.2]])
    assert np.array_equal(ContinuousPlant(1.2, 1, jumps=Jumps(1.0, 0.5)).W, [[0.5]])
    assert np.array_equal(Cost(1, 2, 0.5).N, [[0.5]])


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"A": [[1.0, 2.0]]}, "A has shape (1, 2); expected a square matrix with at least one state"),
    ({"A": [1.0, 2.0]}, "A has shape (2,); expected the shape (any, any) = (states, states), such as [[1, 0], [0, 2]]"),
    (
        {"A": [1.0, 2.0, 3.0, 4.0]},
        "A has shape (4,); expected the shape (any, any) = (states, states), such as [[1, 2], [3, 4]]",
    ),
    ({"A": np.zeros((0, 0))}, "A has shape (0, 0); expected a square matrix with at least one state"),
    (
        {"A": [[1.0], [2.0, 3.0]]},
        "A has rows of different lengths: row 2 has 2 entries, and row 1 has 1 entry; expected rows of equal leng",
    ),
    (
        {"A": [[1, 0], [0, 1], 2]},
        "A has rows of different lengths: row 3 is 2, and row 1 has 2 entries; expected rows of equal length, suc",
    ),
    (
        {"A": [[[1], 2], [3, 4]]},
        "A has rows of different lengths: lists within its rows differ in length; expected rows of equal length",
    ),
    (
        {"A": [["1.0"]]},
        "A is not an array of numbers (it contains str values); expected an array of the shape (any, any)",
    ),
    ({"A": np.array([[1j]])}, "A is not an array of numbers (it contains complex128 values); expected an array"),
    ({"A": [[10**400]]}, "A is not an array of numbers (int too large to convert to float); expected an array"),
    ({"A": [[{}]]}, "A is not an array of numbers ("),
    (
        {"A": [[1.0, np.nan], [0.0, 1.0]]},
        "A contains the number nan at index (0, 1); expected an array of finite numbers",
    ),
    (
        {"A": [[1.0, 0.0], [-np.inf, 1.0]]},
        "A contains the number -inf at index (1, 0); expected an array of finite numbers",
    ),
    (
        {"B": [[0.0, 0.1]]},
        "B has shape (1, 2); expected the shape (2, any) = (states, inputs). Did you pass its transpose?",
    ),
    ({"B": [0.005, 0.1]}, "B has shape (2,); expected the shape (2, any) = (states, inputs), such as [[0.005], [0.1]]"),
    (
        {"B": [1, 2, 3]},
        "B has shape (3,); expected the shape (2, any) = (states, inputs), such as [[0.9, 0.1], [0.0, 0.8]]",
    ),
    ({"B": 0.1}, "B is 0.1; expected the shape (2, any) = (states, inputs), such as [[0.9, 0.1], [0.0, 0.8]]"),
    ({"C": [1, 0]}, "C has shape (2,); expected the shape (any, 2) = (outputs, states), such as [[1, 0]]"),
    ({"W": 0.01}, "W is 0.01; expected the shape (2, 2) = (states, states), such as [[0.01, 0], [0, 0.01]]"),
    ({"W": [1, 2]}, "W has shape (2,); expected the shape (2, 2) = (states, states), such as [[1, 0], [0, 2]]"),
    ({"mean": 1.0}, "initial.mean is 1; expected the shape (2,) = (states,), such as [1, 1]"),
    ({"B": [[0.0], [1.0], [2.0]]}, "B has shape (3, 1); expected the shape (2, any) = (states, inputs)"),
    ({"B": np.zeros((2, 0))}, "B has no columns; expected at least one input"),
    (
        {"C": [[1.0], [0.0]]},
        "C has shape (2, 1); expected the shape (any, 2) = (outputs, states). Did you pass its transpose?",
    ),
    (
        {"C": np.zeros((0, 2))},
        "C has no rows; expected at least one measured output (omit C to measure the full state)",
    ),
    ({"W": [[1.0]]}, "W has shape (1, 1); expected the shape (2, 2) = (states, states)"),
    (
        {"W": [[1, 0.5], [0.2, 1]]},
        "W is not symmetric: entry (0, 1) is 0.5 and (1, 0) is 0.2; expected a symmetric matrix",
    ),
    ({"W": [[1, 2], [2, 1]]}, "W has the eigenvalue -1; expected a positive semidefinite matrix (all eigenvalues ≥ 0)"),
    ({"V": [[-0.1]]}, "V has the eigenvalue -0.1; expected a positive semidefinite matrix (all eigenvalues ≥ 0)"),
    ({"V": np.eye(2)}, "V has shape (2, 2); expected the shape (1, 1) = (outputs, outputs)"),
    ({"mean": [1.0]}, "initial.mean has shape (1,); expected the shape (2,) = (states,)"),
    ({"mean": [[1.0], [0.0]]}, "initial.mean has shape (2, 1); expected the shape (2,) = (states,), such as [1, 0]"),
    ({"covariance": [[1.0]]}, "initial.covariance has shape (1, 1); expected the shape (2, 2) = (states, states)"),
    ({"covariance": -np.eye(2)}, "initial.covariance has the eigenvalue -1; expected a positive semidefinite matrix"),
    ({"input_limit": [1.0, 1.0]}, "input_limit has shape (2,), but the plant has one input; expected the shape (1,)"),
    ({"input_limit": [0.0]}, "input_limit is 0; expected positive numbers (omit this key if there is no limit)"),
    ({"input_limit": [[0.0, 1.0], 2.0]}, "input_limit has 2 entries; expected 1 entry, one for each input"),
    (
        {"input_limit": [[1.0, 1.0]]},
        "input_limit[0] is [1.0, 1.0]; expected a positive number, or [low, high] with low < high",
    ),
    ({"input_limit": [[1.0, 2.0, 3.0]]}, "input_limit[0] is [1.0, 2.0, 3.0]; expected a positive number, or [low"),
    ({"input_limit": [[np.inf, np.inf]]}, "input_limit[0] is [inf, inf]; expected a positive number, or [low, high]"),
    ({"input_limit": [[np.nan, 1.0]]}, "input_limit[0] is [nan, 1.0]; expected a positive number, or [low, high]"),
    ({"input_rate": [0.0]}, "input_rate is 0; expected positive numbers (omit this key if there is no limit)"),
    ({"input_rate": [1.0, 1.0]}, "input_rate has shape (2,); expected the shape (1,) = (inputs,)"),
    (
        {**GROWING, "B": [[1.0], [0.0]]},
        "(A, B) is not stabilisable: no input affects the growing mode with the eigenvalue 1.1; expected a",
    ),
    ({**GROWING, "B": [[0.0], [0.0]]}, "expected a stabilisable plant: add an actuator, or remove the mode"),
    (
        {**GROWING, "C": [[0.0, 1.0]]},
        "(A, C) is not detectable: no measurement shows the growing mode with the eigenvalue 1.1; expected a",
    ),
    ({**GROWING, "C": [[0.0, 0.0]]}, "expected a detectable plant: add a sensor, or remove the mode"),
]


@pytest.mark.parametrize(("change", "sentence"), WRONG, ids=lambda value: str(value)[:40])
def test_a_plant_that_does_not_fit_is_refused(change: dict[str, Any], sentence: str) -> None:
    """Each mistake is told with what was got and what was expected, with a hint where a transpose would fit."""
    told = refusal(Plant, GOOD | change)
    assert told.startswith(sentence) or told.endswith(sentence)
    assert ("transpose" in told) == ("transpose" in sentence)


@pytest.mark.parametrize(
    ("dt", "sentence"),
    [
        (0, "dt is 0; expected 0 < dt"),
        (-0.1, "dt is -0.1; expected 0 < dt"),
        (np.nan, "dt is nan; expected a finite number"),
        (np.inf, "dt is inf; expected a finite number"),
        (True, "dt is True; expected a finite number"),
        ("1", "dt is '1'; expected a finite number"),
        (1j, "dt is 1j; expected a finite number"),
    ],
)
def test_a_step_is_a_positive_number_of_seconds(dt: Any, sentence: str) -> None:
    """Zero, negative, infinite and what is no number are refused."""
    assert refusal(Plant, GOOD | {"dt": dt}) == sentence


def test_a_number_too_long_to_hold_is_refused_in_a_short_sentence() -> None:
    """A whole number beyond the largest float is not finite, and is not printed digit by digit."""
    for digits in (400, 5000):
        told = refusal(Plant, GOOD | {"dt": 10**digits})
        assert told.endswith("; expected a finite number")
        assert len(told) < 120


@pytest.mark.parametrize("dt", [1, 0.5, np.float32(0.5), np.int64(2), Fraction(1, 2)])
def test_every_kind_of_real_number_is_a_step(dt: Any) -> None:
    """Python's and NumPy's numbers are taken alike."""
    assert Plant(**GOOD, dt=dt).dt == float(dt)


def test_an_oscillation_is_named_by_both_its_parts() -> None:
    """A complex mode that nothing moves is shown with its imaginary part."""
    A = np.zeros((3, 3))
    A[:2, :2], A[2, 2] = [[0, 2], [-2, 0]], 0.5
    told = refusal(Plant, {"A": A, "B": [[0], [0], [1]], "W": np.eye(3)})
    assert "the growing mode with the eigenvalue " in told
    assert "2i; expected a" in told


def test_a_mode_that_decays_may_be_unmoved_and_unseen() -> None:
    """Stabilisable and detectable are enough."""
    plant = Plant([[1.2, 0], [0, 0.5]], [[1], [0]], np.eye(2), [[1, 0]], [[1]])
    assert (plant.states, plant.inputs, plant.outputs) == (2, 1, 1)
    assert ContinuousPlant([[1, 0], [0, -0.5]], [[1], [0]], np.eye(2)).states == 2


def test_a_mode_that_neither_grows_nor_decays_may_be_unmoved_and_unseen() -> None:
    """A constant disturbance, a clock: whether cost and noise leave them alone is for the design to find out."""
    assert Plant(**GOOD | {"B": [[1.0], [0.0]], "C": [[0.0, 1.0]]}).states == 2
    assert ContinuousPlant(**CONTINUOUS | {"B": [[1], [0]], "C": [[0, 1]]}).states == 2
    assert Plant(np.roll(np.eye(30), 1, axis=0), np.zeros((30, 1)), np.zeros((30, 30))).states == 30


def test_a_noiseless_plant_is_legal() -> None:
    """W = 0 is a deterministic loop."""
    assert not Plant(GOOD["A"], GOOD["B"], np.zeros((2, 2))).W.any()


JUMPS = {"rate": 5.0, "covariance": [[0.0, 0.0], [0.0, 0.5]]}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"A": [[0, 1]]}, "A has shape (1, 2); expected a square matrix with at least one state"),
        (
            {"B": [[0, 1]]},
            "B has shape (1, 2); expected the shape (2, any) = (states, inputs). Did you pass its transpose?",
        ),
        (
            {"W": None},
            "W is missing; expected the noise intensity per second (zeros for none), or jumps, or noise.input",
        ),
        ({"W": -np.eye(2)}, "W has the eigenvalue -1; expected a positive semidefinite matrix (all eigenvalues ≥ 0)"),
        (
            {"W": [[1], [1, 2]]},
            "W has rows of different lengths: row 2 has 2 entries, and row 1 has 1 entry; expected rows of equal "
            "length, " + FORM,
        ),
        ({"jumps": Jumps(**JUMPS)}, "W and jumps are both given; expected one kind of noise: remove one"),
        ({"W": None, "jumps": (1.0, 2.0)}, "jumps is (1.0, 2.0); expected a Jumps"),
        (
            {"W": None, "jumps": Jumps(1.0, np.eye(3))},
            "jumps.covariance has shape (3, 3); expected the shape (2, 2) = (states, states)",
        ),
        (
            {"A": [[2, 1], [0, 2]], "B": [[1], [0]]},
            "(A, B) is not stabilisable: no input affects the growing mode with the eigenvalue 2; "
            "expected a stabilisable plant: add an actuator, or remove the mode",
        ),
        (
            {"A": [[2, 1], [0, 2]], "C": [[0, 1]]},
            "(A, C) is not detectable: no measurement shows the growing mode with the eigenvalue 2; "
            "expected a detectable plant: add a sensor, or remove the mode",
        ),
    ],
    ids=lambda value: str(value)[:30],
)
def test_a_continuous_plant_that_does_not_fit_is_refused(change: dict[str, Any], sentence: str) -> None:
    """The same checks, with the half-plane instead of the disc, and exactly one kind of noise."""
    assert refusal(ContinuousPlant, CONTINUOUS | change) == sentence


def test_jumps_have_the_intensity_of_their_rate() -> None:
    """W = λ·covariance."""
    plant = ContinuousPlant([[0, 1], [0, 0]], [[0], [1]], jumps=Jumps(**JUMPS))
    np.testing.assert_array_equal(plant.W, [[0, 0], [0, 2.5]])


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"rate": 0.0}, "jumps.rate is 0; expected 0 < jumps.rate"),
        ({"rate": np.nan}, "jumps.rate is nan; expected a finite number"),
        ({"covariance": [[1, 2]]}, "jumps.covariance has shape (1, 2); expected the shape (1, 1)"),
        (
            {"covariance": [1.0]},
            "jumps.covariance has shape (1,); expected the shape (any, any) = (states, states), such as [[1]]",
        ),
        (
            {"covariance": [[1], [1, 2]]},
            "jumps.covariance has rows of different lengths: row 2 has 2 entries, and row 1 has 1 entry",
        ),
        ({"covariance": [[-1]]}, "jumps.covariance has the eigenvalue -1; expected a positive semidefinite matrix"),
        ({"distribution": "gauss"}, "jumps.distribution is 'gauss'; expected 'normal', 'uniform' or 'two-point'"),
    ],
)
def test_jumps_that_do_not_fit_are_refused(change: dict[str, Any], sentence: str) -> None:
    """Rate, covariance and distribution are checked when the jumps are made."""
    assert refusal(Jumps, JUMPS | change).startswith(sentence)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"Q": [[1.0, 0.0]]}, "Q has shape (1, 2); expected the shape (1, 1) = (states, states)"),
        ({"Q": [1.0]}, "Q has shape (1,); expected the shape (any, any) = (states, states), such as [[1]]"),
        ({"Q": np.diag([1.0, -1.0])}, "Q has the eigenvalue -1; expected a positive semidefinite matrix"),
        ({"Q": [[1, 1], [0, 1]]}, "Q is not symmetric: entry (0, 1) is 1 and (1, 0) is 0; expected a symmetric matrix"),
        ({"Q": [[np.nan]]}, "Q contains the number nan at index (0, 0); expected an array of finite numbers"),
        ({"R": [[-1.0]]}, "R has the eigenvalue -1; expected a positive semidefinite matrix (all eigenvalues ≥ 0)"),
        ({"R": [[1.0], [2.0]]}, "R has shape (2, 1); expected the shape (2, 2) = (inputs, inputs)"),
        (
            {"N": [[1.0, 0.0]]},
            "N has shape (1, 2); expected the shape (2, 1) = (states, inputs). Did you pass its transpose?",
        ),
        ({"N": [[2.0], [0.0]]}, "[[Q, N], [N', R]] has the eigenvalue -1; expected a positive semidefinite matrix"),
        ({"horizon": 0}, "horizon is 0; expected a whole number of at least 1"),
        ({"horizon": 1.5}, "horizon is 1.5; expected a whole number of at least 1"),
        ({"horizon": True}, "horizon is True; expected a whole number of at least 1"),
        (
            {"terminal": np.eye(2)},
            "terminal is given without horizon; expected both horizon and terminal, or neither of them",
        ),
        ({"horizon": 9, "terminal": [[1]]}, "terminal has shape (1, 1); expected the shape (2, 2) = (states, states)"),
        ({"horizon": 9, "terminal": -np.eye(2)}, "terminal has the eigenvalue -1; expected a positive semidefinite"),
        ({"discount": 0.0}, "discount is 0; expected 0 < discount ≤ 1"),
        ({"discount": 1.5}, "discount is 1.5; expected 0 ≤ discount ≤ 1"),
        ({"discount": np.nan}, "discount is nan; expected a finite number"),
        ({"discount": 0.9, "horizon": 9}, "discount and horizon are both given; expected one of them"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_a_cost_that_does_not_fit_is_refused(change: dict[str, Any], sentence: str) -> None:
    """Every weight, the weights together, and what horizon, terminal weight and discount exclude."""
    assert refusal(Cost, WEIGHTS | change).startswith(sentence)


def test_a_terminal_weight_is_that_of_the_state_unless_given() -> None:
    """With a horizon only."""
    np.testing.assert_array_equal(Cost(**WEIGHTS, horizon=3).terminal, np.eye(2))
    assert Cost(**WEIGHTS).terminal is None


BURST = {"to_bad": 0.05, "to_good": 0.3, "loss_good": 0.01, "loss_bad": 0.7}


@pytest.mark.parametrize("name", BURST)
@pytest.mark.parametrize("value", [-0.1, 1.1])
def test_a_burst_is_made_of_probabilities(name: str, value: float) -> None:
    """Each of the four lies in [0, 1]."""
    assert refusal(Burst, BURST | {name: value}) == f"{name} is {value:g}; expected 0 ≤ {name} ≤ 1"


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        ({"protocol": "utp"}, "network.protocol is 'utp'; expected 'udp', 'tcp' or 'ideal'"),
        (
            {"protocol": "udp", "actuator_loss": 1.1},
            "network.actuator_loss is 1.1; expected 0 ≤ network.actuator_loss ≤ 1",
        ),
        ({"protocol": "udp", "sensor_loss": np.nan}, "network.sensor_loss is nan; expected a finite number"),
        ({"protocol": "udp", "sensor_loss": True}, "network.sensor_loss is True; expected a finite number"),
        (
            {"actuator_loss": 0.1},
            "network.actuator_loss is given for an ideal network; expected protocol = 'udp' or 'tcp'",
        ),
        (
            {"sensor_burst": Burst(**BURST)},
            "network.sensor_burst is given for an ideal network; expected protocol = 'udp'",
        ),
        (
            {"protocol": "tcp", "sensor_loss": 0.1, "sensor_burst": Burst(**BURST)},
            "network.sensor_loss and network.sensor_burst are both given; expected one of them",
        ),
        ({"delay": -1}, "network.delay is -1; expected a whole number of at least 0"),
        ({"delay": 0.5}, "network.delay is 0.5; expected a whole number of at least 0"),
    ],
)
def test_a_network_that_does_not_fit_is_refused(data: dict[str, Any], sentence: str) -> None:
    """Probabilities, one model of loss for a link, and none on an ideal one."""
    assert refusal(Network, data).startswith(sentence)


def test_limits_are_stored_as_pairs() -> None:
    """A number limits both sides, and an infinite side is open; the arrays of a plant make the same plant again."""
    B = np.ones((1, 3))
    plant = Plant([[0.5]], B, [[1.0]], input_limit=[2.0, [0.0, np.inf], np.inf], input_rate=[1.0, np.inf, 3.0])
    assert plant.input_limit is not None
    assert plant.input_limit.tolist() == [[-2.0, 2.0], [0.0, np.inf], [-np.inf, np.inf]]
    again = Plant([[0.5]], B, [[1.0]], input_limit=plant.input_limit, input_rate=plant.input_rate)
    assert plant.same_as(again)
    assert limit_entries(plant.input_limit) == [2.0, [0.0, np.inf], np.inf]
    assert plant.summary()["input limit"] == "±2, 0 to ∞, ±∞"
    assert plant.summary()["input rate"] == "at most 1, ∞, 3 per step"
    assert plant.saturation is not None
    assert plant.saturation(np.array([9.0, -9.0, 9.0]), np.array([0.0, 0.0, 1.0])).tolist() == [1.0, 0.0, 4.0]


@pytest.mark.parametrize("name", ["A", "B", "C", "W", "V", "mean", "covariance", "input_limit", "input_rate"])
def test_a_plant_is_frozen_and_its_own(name: str) -> None:
    """Nobody can write to a plant's arrays, nor change them through the array that was passed."""
    data: dict[str, Any] = GOOD | {
        "mean": np.zeros(2),
        "covariance": np.eye(2),
        "input_limit": np.ones(1),
        "input_rate": np.ones(1),
    }
    given = np.array(data[name], dtype=np.float64)
    for plant in (Plant(**data | {name: given}), ContinuousPlant(**data | {name: given})):
        kept: np.ndarray = getattr(plant, name)
        with pytest.raises(ValueError, match="read-only"):
            kept[...] = 7.0
        assert not np.shares_memory(kept, given)
        with pytest.raises(AttributeError):
            setattr(plant, name, given)


@pytest.mark.parametrize("name", ["Q", "R", "N", "terminal"])
def test_a_cost_is_frozen_and_its_own(name: str) -> None:
    """The same of the weights."""
    data: dict[str, Any] = WEIGHTS | {"N": np.zeros((2, 1)), "terminal": np.eye(2), "horizon": 4}
    given = np.array(data[name], dtype=np.float64)
    kept: np.ndarray = getattr(Cost(**data | {name: given}), name)
    with pytest.raises(ValueError, match="read-only"):
        kept[...] = 7.0
    assert not np.shares_memory(kept, given)


def test_rounding_does_not_make_a_singular_covariance_indefinite() -> None:
    """An eigenvalue of −1e-17 is an exact zero that was computed."""
    draws = np.random.default_rng(3)
    G = draws.standard_normal((6, 2))
    plant = Plant(0.5 * np.eye(6), np.eye(6), G @ G.T)
    np.testing.assert_array_equal(plant.W, plant.W.T)
