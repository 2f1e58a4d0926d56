"""The records of the policy kinds say what their design functions do."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Mapping
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest

import taciturn
from taciturn import PID, ContinuousPlant, Cost, Jumps, Network, Plant, Problem
from taciturn.design.catalogue import CATALOGUE
from taciturn.design.kind import Kind
from taciturn.model.disturbance import follow
from taciturn.model.signals import ExternalDisturbance, RandomSteps, Timetable
from taciturn_new.draft import example_of

A, B, W, C, V = [[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]], np.eye(2), [[1.0, 0.0]], [[0.1]]
F, FW = [[0.0, 1.0], [0.0, 0.0]], np.diag([0.0, 2.5])
PLANTS: Mapping[tuple[str, ...], Plant | ContinuousPlant] = {
    ("discrete",): Plant(A, B, W, dt=1.0),
    ("continuous",): ContinuousPlant(F, B, FW),
    ("discrete", "outputs"): Plant(A, B, W, C, V, 1.0),
    ("continuous", "outputs"): ContinuousPlant(F, B, FW, C=C, V=V),
    ("continuous", "jumps"): ContinuousPlant(F, B, None, Jumps(5.0, FW / 5)),
}
SCALAR: Mapping[tuple[str, ...], Plant | ContinuousPlant] = {
    ("discrete",): Plant([[0.9]], [[1.0]], [[1.0]], dt=1.0),
    ("continuous",): ContinuousPlant([[-0.2]], [[1.0]], [[1.0]]),
    ("discrete", "outputs"): Plant([[0.9]], [[1.0]], [[1.0]], [[1.0]], [[0.1]], 1.0),
    ("continuous", "outputs"): ContinuousPlant([[-0.2]], [[1.0]], [[1.0]], C=[[1.0]], V=[[0.1]]),
    ("continuous", "jumps"): ContinuousPlant([[-0.2]], [[1.0]], None, Jumps(5.0, [[0.2]])),
}
SLOW = ("integral", "near-optimal")  # to design


def costs_of(states: int) -> Mapping[str, Cost]:
    """Return a cost of each class."""
    unit = np.eye(states), [[10.0]]
    return {"average": Cost(*unit), "horizon": Cost(*unit, horizon=5), "discount": Cost(*unit, discount=0.9)}


def accepted(kind: Kind, plant: Plant | ContinuousPlant, cost: Cost) -> bool:
    """Return whether the design function accepts plant and cost, with the example's parameters; a policy is pickled."""
    given: dict[str, Any] = {name: value for name, value in kind.example.items() if name != "period"}
    period = kind.parameters.get("period")
    if period is not None and (isinstance(plant, ContinuousPlant) or period.default is period.empty):
        given["period"] = 0.02
    if kind.keeps_controller and kind.arguments["controller"].default is kind.arguments["controller"].empty:
        given["controller"] = PID(0.01, 0.0 if plant.exosystem is None else 0.001)
    try:
        pickle.loads(pickle.dumps(kind.design(plant, cost, **given)))
        if kind.nodes == "none" and isinstance(plant, ContinuousPlant) and plant.jumps is not None:
            taciturn.evaluate(Problem(plant, cost, Network(), kind.name, given))
    except taciturn.ProblemError:
        return False
    return True


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.evidence) if name in SLOW else name for name in CATALOGUE]
)
def test_a_kind_accepts_the_plants_and_costs_of_its_record(name: str) -> None:
    """And refuses all others; a check that a kind has refuses the same."""
    kind = CATALOGUE[name]
    suitable, single = None, "several" in kind.refused  # inputs or outputs
    costs = costs_of(1 if single else 2)
    for words, plant in (SCALAR if single else PLANTS).items():
        expected = set(words) <= set(kind.plants)
        assert accepted(kind, plant, costs["average"]) == expected, (words, name)
        suitable = plant if expected and suitable is None else suitable
        if kind.check is not None:
            with pytest.raises(taciturn.ProblemError) if not expected else nullcontext():
                kind.check(plant, costs["average"])
    assert suitable is not None
    for word, cost in costs.items():
        assert accepted(kind, suitable, cost) == (word in kind.costs), (word, name)


FOLLOWED = {
    "constant": [{"value": [1.0]}, {"disturbances": 1e-3}],
    "changing": [
        {"changes": RandomSteps(0.02, [[1.0]])}, {"changes": Timetable([0, 5, 10], [[1.0], [2.0], [1.0]])},
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.evidence) if name in (*SLOW, "remote-lqg") else name for name in CATALOGUE],
)
@pytest.mark.parametrize("word", FOLLOWED)
def test_a_kind_follows_the_set_points_of_its_record(name: str, word: str) -> None:
    """And refuses others; with a measured state nothing is followed, and a given controller has its own."""
    kind = CATALOGUE[name]
    if "outputs" not in kind.plants:
        assert kind.follows == ()
        return
    plant = (SCALAR if "several" in kind.refused else PLANTS)["discrete", "outputs"]
    cost = costs_of(plant.states)["average"]
    for given in FOLLOWED[word]:
        wander, changes = given.get("disturbances"), given.get("changes")
        disturbances = () if wander is None else ExternalDisturbance([*[0.0] * (plant.states - 1), 0.5], wander)
        followed = follow(plant, plant.C, given.get("value"), disturbances, changes)
        assert accepted(kind, followed, cost) == (word in kind.follows), given


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_record_is_complete_and_its_example_can_be_designed(name: str) -> None:
    """Every parameter has a description; those that a record names exist; the policy has the kind's name."""
    kind = CATALOGUE[name]
    assert kind.name == name
    assert kind.sources
    assert kind.about
    assert kind.goal
    assert set(kind.parameters) <= set(kind.notes)
    named = {tuning.name for tuning in kind.tuning} | set(kind.usual) | set(kind.asked) | set(kind.example)
    assert named <= set(kind.parameters)
    assert example_of(kind).designed().kind == name


def test_a_design_imports_no_other_kind() -> None:
    """Names are listed without an import, and ``design.lqg`` imports the file of lqg alone."""
    code = (
        "import sys, taciturn.design as design\n"
        "names = list(design.CATALOGUE)\n"
        "assert 'numpy' not in sys.modules\n"
        "design.lqg\n"
        "print(sorted(name for name in sys.modules if name.startswith('taciturn.design.kinds.')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['taciturn.design.kinds.lqg']"
