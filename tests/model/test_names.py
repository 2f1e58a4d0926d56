"""Names and units of states, inputs and outputs: in text, figures, messages, C and FMI, and never in a number."""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np
import pytest

import taciturn
from taciturn import Cost, Network, Plant, Problem, ProblemError
from taciturn.model.limits import Limits
from taciturn.model.names import Names
from taciturn.model.operating_point import OperatingPoint
from taciturn.problem import parse
from taciturn.study.describe import describe
from taciturn_export.fmu import Version, print_fmu
from taciturn_export.folder import print_folder

KEYS: dict[str, Any] = {
    "state_names": ["position", "speed"], "input_names": ["force"], "output_names": ["position"],
    "units": {"states": ["m", "m/s"], "inputs": ["N"], "outputs": ["m"]},
}  # fmt: skip
PLANT: dict[str, Any] = {
    "A": [[1.0, 0.1], [0.0, 0.95]], "B": [[0.005], [0.1]], "C": [[1.0, 0.0]], "W": [[0.0, 0.0], [0.0, 0.01]],
    "V": [[0.01]], "dt": 0.1,
}  # fmt: skip
OTHERS: dict[str, Any] = {
    "cost": {"Q": [[1.0, 0.0], [0.0, 1.0]], "R": [[1.0]]},
    "limits": {"outputs": [[1.0, 0.0], [0.0, -1.0], [1.0, -2.0]], "low": [-1.0, -2.0, -9.0], "high": [1.0, 3.0, 9.0]},
    "policy": {"kind": "excess", "theta": 0.1},
}
LABELS = Names(states=("position (m)", "speed (m/s)"), inputs=("force (N)",), outputs=("position (m)",))


def problem(**keys: Any) -> Problem:
    """Return a problem with further keys of [plant]."""
    return parse({"plant": {**PLANT, **keys}, **OTHERS}, "")


NAMED, PLAIN = problem(**KEYS), problem()


@pytest.mark.evidence
def test_names_are_those_of_the_plant_and_change_no_number() -> None:
    """The older table [names] states them too."""
    assert NAMED.names == NAMED.plant.names == LABELS
    assert PLAIN.names is None
    older = parse({"plant": PLANT, **OTHERS, "names": {"inputs": ["force (N)"], "outputs": ["position (m)"]}}, "")
    assert older.plant.names == replace(LABELS, states=())
    first, second = (taciturn.evaluate(one, steps=20_000, seed=3) for one in (NAMED, PLAIN))
    assert first.cost == second.cost
    assert first.rates == second.rates
    paths = [taciturn.simulate(one.close(one.design()), 20).document() for one in (NAMED, PLAIN)]
    assert paths[0].pop("names")["states"] == {"names": ["position", "speed"], "units": ["m", "m/s"]}
    assert paths[0] == paths[1]


@pytest.mark.evidence
def test_text_tables_and_limits_use_the_names() -> None:
    """Columns of tables for programs keep their names x1, y1, u1."""
    shown = describe(NAMED)
    assert "states         x1 position (m), x2 speed (m/s)" in shown.text()
    assert "outputs        y position (m)" in shown.text()
    assert shown.document()["plant"]["names"]["inputs"] == {"names": ["force"], "units": ["N"]}
    limits = ["-1 m ≤ position ≤ 1 m", "-2 m/s ≤ −speed ≤ 3 m/s", "-9 ≤ position − 2 speed ≤ 9"]
    assert shown.document()["limits"] == limits
    assert PLAIN.limits is not None
    assert PLAIN.limits.names == ("-1 ≤ x1 ≤ 1", "-2 ≤ −x2 ≤ 3", "-9 ≤ x1 − 2 x2 ≤ 9")
    path = taciturn.simulate(NAMED.close(NAMED.design()), 5)
    assert path.text().splitlines()[2].split("  ") == [
        "time (s)",
        "position (m)",
        "speed (m/s)",
        "force (N)",
        "actuator",
    ]
    assert {"x1", "x2", "u1", "y1"} <= path.columns().keys()
    assert [axis.get_ylabel() for axis in path.plot().axes[:4]] == [
        "position (m)", "−speed (m/s)", "position − 2 speed", "force (N)",
    ]  # fmt: skip


def test_without_names_the_document_is_as_before() -> None:
    """Units alone are written after the usual names."""
    assert "names" not in describe(PLAIN).document()["plant"]
    assert "names" not in taciturn.simulate(PLAIN.close(PLAIN.design()), 2).document()
    found = problem(units={"states": ["m", ""], "inputs": ["N"]})
    assert found.names is not None
    assert found.names.numbered("states", 3) == ["x1 (m)", "x2", "x3"]
    assert "states         x1 (m), x2" in describe(found).text()
    assert found.limits is not None
    assert found.limits.names[0] == "-1 m ≤ x1 ≤ 1 m"


def test_a_plant_in_python_has_names_and_a_measured_state_those_of_its_states() -> None:
    """A problem takes them from its plant, or gives them to it."""
    plant = Plant(PLANT["A"], PLANT["B"], PLANT["W"], names=Names(states=("a", "b")))
    cost = Cost(np.eye(2), [[1.0]])
    found = Problem(plant, cost, Network(), "all-time", limits=Limits([[0.0, 1.0]], high=[2.0]))
    assert found.names is plant.names
    assert plant.names is not None
    assert plant.names.outputs == ("a", "b")
    assert found.limits is not None
    assert found.limits.names == ("b ≤ 2",)
    assert found.close(found.design()).names is plant.names
    with pytest.raises(ProblemError, match="names are given, and the plant has other names"):
        replace(found, names=Names(inputs=("u",)))
    with pytest.raises(ProblemError, match=r"names.states has 1 entry; expected 2 entries, one for each of the states"):
        Plant(PLANT["A"], PLANT["B"], PLANT["W"], names=Names(states=("a",)))


def test_messages_tell_the_name_after_the_number() -> None:
    """Also when a file is read."""
    with pytest.raises(ProblemError, match=r"operating_point.u is 5 for input 1 \(force\), beyond its input_limit"):
        problem(**KEYS, operating_point={"x": [0.0, 0.0], "u": [5.0]}, input_limit=[1.0])

    def moving(x: Any, u: Any, w: Any) -> Any:
        return [x[0] + w[0], 0.5 * x[1] + u[0] + w[1] + 1.0]

    with pytest.raises(ProblemError, match=r"returns 1 as state 2 \(speed\) at x = 0"):
        Plant(np.diag([1.0, 0.5]), [[0.0], [1.0]], np.eye(2), function=moving, names=Names(states=("way", "speed")))
    point = OperatingPoint([0.0, 0.0], [5.0])
    with pytest.raises(ProblemError, match="for input 1, beyond"):
        Plant(PLANT["A"], PLANT["B"], PLANT["W"], input_limit=[1.0], operating_point=point)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"plant.state_names": ["a"]}, "plant.state_names has 1 entry; expected 2 entries, one for each of the states"),
        ({"plant.units": {"outputs": []}}, "plant.units.outputs has 0 entries; expected 1 entry, one for each of the"),
        (
            {"plant.state_names": ["a", "a"]},
            r"plant.state_names.1. is 'a', as plant.state_names.0.; expected different",
        ),
        ({"plant.state_names": ["a", "b\n"]}, r"plant.state_names.1. is 'b.n'; expected 1 to 40 characters"),
        ({"plant.input_names": ["force (N)"]}, "expected a unit in one of the two: remove it from the name"),
        ({"plant.units.outputs": [" "]}, r"plant.units.outputs.0. is ' '; expected 1 to 40 characters, such as 'cm'"),
        ({"plant.units.loads": ["m"]}, "plant.units.loads is not a known key; expected one of states, inputs, outputs"),
        (
            {"names": {"inputs": ["force"]}},
            r".names. and plant.state_names are both given; expected the names and unit",
        ),
        ({"plant.actual": {**PLANT, "input_names": ["else"]}}, "expected those of .plant., or no input_names in"),
    ],
)
def test_names_that_do_not_fit_are_refused(changes: dict[str, Any], message: str) -> None:
    """By their key."""
    with pytest.raises(ProblemError, match=message):
        NAMED.changed(changes)


def test_a_changed_plant_loses_the_names_that_do_not_fit() -> None:
    """The others stay, in its tables too."""
    found = NAMED.changed({"plant.C": [[1.0, 0.0], [0.0, 1.0]], "plant.V": [[0.1, 0.0], [0.0, 0.1]]})
    assert found.names == replace(LABELS, outputs=())
    assert found.source is not None
    assert "output_names" not in found.source["plant"]
    assert found.changed({"plant.output_names": ["a", "b"]}).names == replace(LABELS, outputs=("a", "b"))


def test_labels_of_python_control_are_names_both_ways() -> None:
    """Its usual labels, and those of a realisation, are none."""
    control = pytest.importorskip("control")
    A, B, C = [[0.0, 1.0], [0.0, -1.0]], [[0.0], [1.0]], [[1.0, 0.0]]
    system = control.ss(A, B, C, 0, states=["angle", "speed"], inputs="torque", outputs="angle")
    plant = taciturn.from_control(system, W=np.eye(2))
    assert plant.names == Names(states=("angle", "speed"), inputs=("torque",), outputs=("angle",))
    assert taciturn.from_control(control.ss(A, B, C, 0), W=np.eye(2)).names is None
    tf = control.tf([1.0], [1.0, 1.0], inputs="torque", outputs=50 * "a")
    assert taciturn.from_control(tf, W=[[1.0]]).names == Names(inputs=("torque",))
    back = taciturn.to_control(plant, names=plant.names)
    assert (back.state_labels, back.input_labels, back.output_labels) == (["angle", "speed"], ["torque"], ["angle"])
    assert taciturn.to_control(plant).state_labels == ["x[0]", "x[1]"]
    block = taciturn.to_control(NAMED.design(), names=NAMED.names)
    assert (block.input_labels, block.output_labels) == (["position"], ["force", "sent_actuator"])


@pytest.mark.parametrize("version", ["3.0", "2.0"])
def test_a_unit_of_co_simulation_states_names_and_units(version: Version) -> None:
    """Variables keep their names."""
    text = print_fmu(NAMED.close(NAMED.design()), "a", version=version, compiler=None).files["modelDescription.xml"]
    root = Xml.fromstring(text)
    assert [one.attrib["name"] for one in root.iter("Unit")] == ["m", "N"]
    (y,) = (one for one in root.iter() if one.get("name") == "y[1]")
    assert y.attrib["description"] == "Measurement 1 of the plant: position"
    assert (y if version == "3.0" else y[0]).attrib["unit"] == "m"
    plain = print_fmu(PLAIN.close(PLAIN.design()), "a", version=version, compiler=None).files["modelDescription.xml"]
    assert b"nit " not in plain


def test_headers_in_c_have_constants_for_named_signals() -> None:
    """By the place in the arrays of a node, without text that would end a comment."""
    files = print_folder(NAMED.close(NAMED.design()), "a").files
    assert "#define A_CONTROLLER_Y_POSITION 0u /* y[0]: position (m) */" in files["a_controller.h"]
    assert "#define A_ACTUATOR_U_FORCE 0u /* u[0]: force (N) */" in files["a_actuator.h"]
    odd = replace(NAMED.close(NAMED.design()), names=Names(inputs=("a */ b\\",)))
    assert "#define A_ACTUATOR_U_A_B 0u /* u[0]: a - b- */" in print_folder(odd, "a").files["a_actuator.h"]
    assert "#define A_" not in print_folder(PLAIN.close(PLAIN.design()), "a").files["a_actuator.h"].replace(
        "A_ACTUATOR_H", ""
    )
