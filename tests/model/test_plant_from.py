"""Plants made of the objects of scipy and python-control, which the library never imports itself."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from taciturn import ContinuousPlant, Plant, ProblemError, controller_from, plant_from

A, B, C, D = np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]), np.zeros((1, 1))
W, V = 0.01 * np.eye(2), np.array([[0.1]])


def test_scipy_systems_without_dt_are_continuous() -> None:
    """scipy's ``dt=None`` means continuous."""
    signal = pytest.importorskip("scipy.signal")
    for system in (signal.StateSpace(A, B, C, D), signal.lti(A, B, C, D)):
        plant = plant_from(system, W, V)
        assert isinstance(plant, ContinuousPlant)
        np.testing.assert_array_equal(plant.A, A)


def test_scipy_systems_with_dt_are_discrete() -> None:
    """Whether a StateSpace or a dlti, and whether the step is named or not."""
    signal = pytest.importorskip("scipy.signal")
    for system in (signal.StateSpace(A, B, C, D, dt=0.1), signal.dlti(A, B, C, D, dt=0.1)):
        plant = plant_from(system, W, V)
        assert isinstance(plant, Plant)
        assert plant.dt == 0.1
    unnamed = plant_from(signal.dlti(A, B, C, D), W, V)
    assert isinstance(unnamed, Plant)
    assert unnamed.dt is None


def test_scipy_transfer_functions_are_realised() -> None:
    """A transfer function or zeros, poles and gain become a state space on the way in."""
    signal = pytest.importorskip("scipy.signal")
    for system in (signal.TransferFunction([1.0], [1.0, 3.0, 2.0], dt=0.5), signal.dlti([], [-1.0, -2.0], 1.0, dt=0.5)):
        plant = plant_from(system, np.eye(2), V)
        assert isinstance(plant, Plant)
        assert plant.dt == 0.5
        np.testing.assert_allclose(sorted(np.linalg.eigvals(plant.A)), [-2, -1])
    assert isinstance(plant_from(signal.TransferFunction([1.0], [1.0, 3.0]), [[1.0]]), ContinuousPlant)


def test_a_scipy_subclass_is_still_scipys() -> None:
    """``dt=None`` keeps its meaning in a class that a user derives."""
    signal = pytest.importorskip("scipy.signal")
    own = type("Own", (type(signal.StateSpace(A, B, C, D)),), {"__module__": "mine"})
    assert isinstance(plant_from(own(A, B, C, D), W, V), ContinuousPlant)


@pytest.mark.parametrize(("dt", "kind", "step"), [(0, ContinuousPlant, None), (True, Plant, None), (0.1, Plant, 0.1)])
def test_python_control_systems_say_what_time_they_live_in(dt: Any, kind: type, step: float | None) -> None:
    """0 is continuous, True discrete with an unnamed step, a number its seconds."""
    control = pytest.importorskip("control")
    plant = plant_from(control.ss(A, B, C, D, dt=dt), W, V)
    assert isinstance(plant, kind)
    assert getattr(plant, "dt", None) == step


def test_an_unspecified_time_base_of_python_control_is_refused() -> None:
    """python-control's ``dt=None`` means that nobody has said."""
    control = pytest.importorskip("control")
    with pytest.raises(ProblemError) as found:
        plant_from(control.StateSpace(A, B, C, D, dt=None), W, V)
    assert str(found.value) == (
        "the sampling period dt of the system is None, so it is unspecified; expected 0 (continuous) or the seconds "
        "per step: create the system again with dt=0 or dt=…"
    )


def test_a_transfer_function_of_python_control_is_realised() -> None:
    """As one of scipy is, with the same care about its time base."""
    control = pytest.importorskip("control")
    np.testing.assert_allclose(plant_from(control.tf([1.0], [1.0, 3.0], dt=0), [[1.0]]).A, [[-3.0]])
    with pytest.raises(ProblemError, match="so it is unspecified"):
        plant_from(control.tf([1.0], [1.0, 3.0], dt=None), [[1.0]])


def test_what_has_no_state_space_is_refused() -> None:
    """A derivative, and a table of frequencies."""
    control, signal = pytest.importorskip("control"), pytest.importorskip("scipy.signal")
    for system in (signal.TransferFunction([1.0, 0.0, 0.0], [1.0, 1.0]), control.frd([1.0], [1.0])):
        with pytest.raises(
            ProblemError, match=r"without a state-space form \(.*; expected an object with A, B, C, D, or"
        ):
            plant_from(system, [[1.0]])


@pytest.mark.parametrize("system", [A, None, 1.0, "ss", SimpleNamespace(A=A, B=B)])
def test_what_is_no_system_is_refused(system: object) -> None:
    """The sentence names the type that was got."""
    with pytest.raises(ProblemError, match=f"system is a {type(system).__name__}; expected a state-space object"):
        plant_from(system, W)


def test_a_feedthrough_is_that_of_the_input_of_the_step_before() -> None:
    """With C; a measurement never sees the input of its own step."""
    plant = plant_from(SimpleNamespace(A=A, B=B, C=C, D=[[0.5]], dt=0.1), W)
    assert plant.D is not None
    assert plant.D.tolist() == [[0.5]]
    with pytest.raises(ProblemError, match="D has shape"):
        plant_from(SimpleNamespace(A=A, B=B, C=C, D=[[0.5, 0.5]], dt=0.1), W)


def test_the_checks_of_a_plant_hold_for_a_converted_one() -> None:
    """A mode that nothing moves is refused wherever it comes from."""
    with pytest.raises(ProblemError, match="not stabilisable"):
        plant_from(SimpleNamespace(A=2 * np.eye(2), B=B, C=np.eye(2), D=0, dt=1.0), W)


def test_neither_python_control_nor_scipy_signal_is_imported() -> None:
    """Both are recognised by what they have, so neither need be there."""
    code = (
        "import sys, taciturn; taciturn.Plant, taciturn.plant_from; print({'control', 'scipy.signal'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"InputDelay": [2.0]}, r"system has InputDelay \[2.0\]; expected a system without delays"),
        ({"OutputDelay": 0.3}, "system has OutputDelay"),
        ({"input_delay": np.array([1])}, "system has input_delay"),
    ],
)
def test_a_delay_is_not_dropped(more: dict[str, Any], words: str) -> None:
    """By plants and by controllers; an identity E and delays of zero change nothing."""
    system = SimpleNamespace(A=A, B=B, C=C, D=D, dt=0.1)
    with pytest.raises(ProblemError, match=words):
        plant_from(SimpleNamespace(**vars(system), **more), W, V)
    with pytest.raises(ProblemError, match=words.replace("system", "controller", 1)):
        controller_from(SimpleNamespace(**vars(system), **more))
    nothing = SimpleNamespace(**vars(system), E=np.eye(2), InputDelay=[0.0], OutputDelay=None)
    np.testing.assert_array_equal(plant_from(nothing, W, V).A, A)


def test_a_descriptor_matrix_is_solved_for_plants_and_refused_for_controllers() -> None:
    """W is the covariance of the noise in the equation of E."""
    system = SimpleNamespace(A=A, B=B, C=C, D=D, dt=0.1, E=np.diag([0.5, 1.0]))
    found, inverse = plant_from(system, W, V), np.diag([2.0, 1.0])
    for name, expected in (("A", inverse @ A), ("B", inverse @ B), ("W", inverse @ W @ inverse), ("C", np.asarray(C))):
        np.testing.assert_array_equal(getattr(found, name), expected)
    with pytest.raises(ProblemError, match="controller has a descriptor matrix E, E x⁺ = A x \\+ B u; expected a sys"):
        controller_from(system)
