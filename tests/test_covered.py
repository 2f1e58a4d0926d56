"""No theory and no interpreter passes over a property that it does not know."""

from __future__ import annotations

import pytest
from covered import CASES, DESIGNS, IRRELEVANT, OTHERS, UNKNOWN, Case, answer, grown, learnt

from taciturn import Burst, Cost, Network, Plant, ProblemError
from taciturn.model.coverage import ENDING, NETWORKS, PLANTS, WEIGHTS, uncovered
from taciturn.simulation.average import average

NAMES = [f"{case.name} of {type(case.plant).__name__}" for case in CASES]


@pytest.mark.parametrize("case", CASES, ids=NAMES)
def test_nothing_designs_closes_or_simulates_what_nothing_knows(case: Case) -> None:
    """The message names the property."""
    assert {name: answer(case, interpret) for name, interpret in UNKNOWN.items()} == dict.fromkeys(UNKNOWN, "refused")


@pytest.mark.parametrize("case", CASES, ids=NAMES)
def test_nothing_claims_exports_draws_or_runs_what_only_the_simulation_knows(case: Case) -> None:
    """Each interpreter refuses, and the loop claims nothing, also if a theory covers the property."""
    with learnt(case.name):
        for name, interpret in OTHERS.items():
            if name not in IRRELEVANT or not IRRELEVANT[name](case):
                assert answer(case, interpret) in ("refused", "no claim"), name


@pytest.mark.parametrize("name", DESIGNS)
def test_designs_refuse_what_they_do_not_know(name: str) -> None:
    """A reference, a network, and plants and costs of designs in continuous time."""
    with pytest.raises(ProblemError, match=name):
        DESIGNS[name]()


def test_a_loop_with_a_property_beyond_the_theory_is_simulated_plainly_with_a_note() -> None:
    """The average is that of the stage cost, without innovations, identity and guarantee."""
    case = next(case for case in CASES if case.name == "network.jamming")
    with learnt(case.name):
        loop = case.loop()
        assert loop.violated_assumptions[-1] == "the theory does not cover network.jamming"
        assert not loop.nominal
        assert not loop.reducible
        assert loop.identity is None
        assert average(loop, steps=2000).cost.value > 0
    steps = next(case for case in CASES if case.name == "Assign.saturation").policy()
    assert steps.theory.guarantee is not None
    assert steps.guarantee is None


def test_only_values_that_are_not_neutral_count() -> None:
    """Of the known classes, and of a class with a further property, an attribute or another method."""
    known = PLANTS | WEIGHTS | NETWORKS | ENDING
    plant, network = Plant([[1.0]], [[1.0]], [[1.0]]), Network("udp", sensor_burst=Burst(0.0, 0.5, 0.1, 0.9))
    assert uncovered(known, plant, network, Cost([[1.0]], [[1.0]], discount=0.9)) == []
    assert uncovered(known - ENDING, Cost([[1.0]], [[1.0]])) == []
    assert uncovered(known - {"links.burst"}, network) == []  # it never leaves its state
    assert uncovered(known - {"links.loss"}, network) == ["links.loss"]
    assert uncovered(known, grown(plant, "dead_zone", 0.0)) == []
    assert uncovered(known, grown(plant, "dead_zone")) == ["plant.dead_zone"]

    class Late(Network):
        def outage(self, link: str) -> float:
            return 1.0

    assert uncovered(known, Late()) == ["network.outage"]
    object.__setattr__(network, "jitter", 0.1)
    assert uncovered(known, network) == ["network.jitter"]
