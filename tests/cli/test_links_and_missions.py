"""What a user can get wrong about links, finite-horizon runs, schedules and references, and what the answers show."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from taciturn.problem import parse

if TYPE_CHECKING:
    from conftest import Answer, Run

PLANT = "[plant]\nA = [[1.1]]\nB = [[1.0]]\nW = [[0.1]]\ndt = 0.1\n"
COST = "[cost]\nQ = [[1.0]]\nR = [[1.0]]\n"
UDP = '[network]\nprotocol = "udp"\nactuator_loss = 0.1\nsensor_loss = 0.2\n'
LOSSY = '[policy]\nkind = "lossy-lqg"\nprice = 0.1\n'
REMOTE = '[policy]\nkind = "remote-lqg"\ntheta = 0.1\nzeta = 0.1\n'
BURST = "[network.actuator_burst]\nto_bad = 0.1\nto_good = 0.5\nloss_good = 0.0\nloss_bad = 1.0\n"
REFERENCE = "[reference]\nstates = [[1.0], [1.0], [1.0]]\ninputs = [[-0.1], [-0.1]]\n"


@pytest.fixture
def ask(run: Run, tmp_path: Path) -> Run:
    """Return what evaluates the text of a problem file."""

    def ask(text: str, *options: str) -> Answer:
        path = tmp_path / "problem.toml"
        path.write_text(text, encoding="utf-8")
        return run("evaluate", str(path), *options)

    return ask


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (PLANT + COST + UDP.replace("0.1", "1.5") + LOSSY, "network.actuator_loss is 1.5; expected 0 ≤"),
        (PLANT + COST + UDP.replace("0.2", "-0.1") + LOSSY, "network.sensor_loss is -0.1; expected 0 ≤"),
        (PLANT + COST + UDP.replace("0.1", "nan") + LOSSY, "network.actuator_loss is nan; expected a finite number"),
        (PLANT + COST + UDP.replace("udp", "ideal") + LOSSY, "network.actuator_loss is given for an ideal network"),
        (PLANT + COST + UDP + BURST + LOSSY, "network.actuator_loss and network.actuator_burst are both given"),
        (PLANT + COST + BURST.replace("0.5", "2") + LOSSY, "network.actuator_burst: to_good is 2; expected 0 ≤"),
        (PLANT + COST + UDP + "delay = 2\n" + LOSSY, "network.delay is 2; expected a delay of 0 or 1 steps"),
        (PLANT + COST + UDP + REMOTE, "network.protocol is given, which the policy kind remote-lqg does not use"),
        (
            PLANT + COST + UDP + '[policy]\nkind = "lqg"\ntheta = 0.1\n',
            "network.protocol is given, which the policy kind lqg does not",
        ),
        (PLANT + COST + "horizon = 0\n" + REMOTE, "horizon is 0; expected a whole number of at least 1"),
        (PLANT + COST + "horizon = 5\nterminal = [[-1.0]]\n" + REMOTE, "terminal has the eigenvalue -1; expected"),
        (PLANT + COST + "terminal = [[1.0]]\n" + REMOTE, "terminal is given without horizon"),
        (PLANT + COST + "horizon = 5\ndiscount = 0.9\n" + REMOTE, "discount and horizon are both given"),
        (PLANT + COST + "discount = 1.1\n" + REMOTE, "discount is 1.1; expected 0 ≤ discount ≤ 1"),
        (
            PLANT + COST + "discount = 0.9\n" + UDP + LOSSY,
            "cost.discount is 0.9, which the policy kind lossy-lqg does not use",
        ),
        (PLANT + COST + REMOTE.replace("zeta = 0.1", "zeta = -1"), "zeta is -1; expected 0 ≤ zeta"),
        (PLANT + COST + REMOTE.replace("theta = 0.1", "theta = -1"), "theta is -1; expected 0 ≤ theta"),
        (PLANT + COST + REMOTE.replace("zeta = 0.1\n", ""), "zeta is missing; expected a number of at least 0"),
        (PLANT + COST + REMOTE + 'controller = "actuator"\n', "theta is given with controller = 'actuator'"),
        (PLANT + COST + REMOTE + 'controller = "sensor"\n', "zeta is given with controller = 'sensor'"),
        (PLANT + COST + UDP + LOSSY.replace("0.1", "-0.1"), "price is -0.1; expected 0 ≤ price"),
        (
            PLANT + COST + "N = [[0.1]]\n" + UDP + LOSSY,
            "cost.N is not zero, which the policy kind lossy-lqg does not support",
        ),
        (
            PLANT + "C = [[1.0]]\nV = [[0.1]]\n" + COST + UDP + LOSSY,
            "C or V is given, but the policy kind lossy-lqg measures",
        ),
        (PLANT.replace("1.1", "2.0") + COST + UDP.replace("0.1", "0.6") + LOSSY, "losses below 0.0769231 at this"),
        (PLANT + COST + UDP + REFERENCE + LOSSY, "a reference trajectory is given without cost.horizon"),
        (
            PLANT + COST + "horizon = 3\n" + UDP + REFERENCE + LOSSY,
            "reference.inputs has shape (2, 1); expected the shape (3",
        ),
        (
            PLANT + COST + "horizon = 2\n" + UDP + REFERENCE.replace("[1.0], [1.0]]", "[1.0], [3.0]]") + LOSSY,
            "reference.states differs by 2 at step 2 from A r + B f of step 1",
        ),
        (PLANT + COST + REFERENCE + REMOTE, "[reference] is given, which the policy kind remote-lqg does not use"),
        (PLANT.replace("[[0.1]]", "[[0.0]]") + COST + REMOTE, "the sensor is never queried, and the plant is unstable"),
    ],
    ids=lambda value: value[:40] if isinstance(value, str) and not value.startswith("[") else "",
)
def test_what_does_not_fit_is_refused(ask: Run, text: str, told: str) -> None:
    """Exit code 2 and one sentence that says what, got and expected."""
    answer = ask(text, "--steps", "20000")
    assert answer.code == 2
    assert answer.out == ""
    assert told in answer.err
    assert "Traceback" not in answer.err
    assert answer.err.count("\n") == 1


def test_a_dt_makes_the_plant_discrete_and_a_continuous_one_is_refused(ask: Run) -> None:
    """Sampling makes a cross weight that the lossy recursions do not know."""
    continuous = PLANT.replace("dt = 0.1\n", "")
    assert "the plant is continuous in time" in ask(continuous + COST + UDP + LOSSY).err
    assert ask(PLANT + COST + UDP + LOSSY, "--steps", "20000").code == 0


def test_both_bounds_are_reported(ask: Run) -> None:
    """The thesis's, and the sharper one at the measured rate, for people and for scripts."""
    found = json.loads(ask(PLANT + COST + UDP + LOSSY, "--json").out)
    price, rate = 0.1, found["rates"]["actuator"]["value"]
    assert found["cost_bound"] == pytest.approx(found["cost_all_time"] + price, rel=1e-12)
    assert found["cost_bound_at_rate"] == pytest.approx(found["cost_all_time"] + price * (1 - rate), rel=1e-12)
    assert found["cost_all_time"] < found["cost"]["value"] < found["cost_bound_at_rate"] < found["cost_bound"]
    text = ask(PLANT + COST + UDP + LOSSY, "--steps", "20000").out
    assert "\nguarantee " in text
    assert "\nguarantee, this rate " in text


def test_a_schedule_is_in_the_answer(ask: Run) -> None:
    """As text, and in JSON with the value of each query."""
    text = PLANT + COST + "horizon = 6\n" + REMOTE.replace("zeta = 0.1", "zeta = 0.3")
    found = json.loads(ask(text, "--json").out)
    schedule = found["schedule"]
    assert found["unit"] == "mission"
    assert schedule["length"] == 6
    assert schedule["repeats_from"] is None
    assert schedule["queries"] == [k for k, value in enumerate(schedule["value"]) if value > 0.3]
    assert found["rates"]["sensor"] == {"value": schedule["rate"], "standard_error": 0.0}
    assert "sensor queries" in ask(text).out


def test_too_many_losses_over_a_horizon_are_told_with_the_critical_value(ask: Run) -> None:
    """A finite finite-horizon run is evaluated; the note says what mean-square stability would allow."""
    text = PLANT.replace("1.1", "2.0") + COST + "horizon = 12\n" + UDP.replace("0.1", "0.6") + LOSSY
    found = json.loads(ask(text, "--json").out)
    assert any("losses below 0.0769231" in note and "grows without bound" in note for note in found["notes"])
    assert found["cost_bound"] is not None


@pytest.mark.evidence
def test_bursts_show_no_bound_and_say_why(ask: Run) -> None:
    """The design knows their mean only."""
    network = '[network]\nprotocol = "udp"\n' + BURST
    found = json.loads(ask(PLANT.replace("1.1", "0.9") + COST + network + LOSSY, "--json").out)
    assert found["cost_bound"] is found["cost_bound_at_rate"] is found["cost_all_time"] is None
    assert found["notes"] == ["losses come in bursts, but the design uses only their mean: no guarantee holds"]


def test_a_clipped_unstable_plant_that_runs_away_is_told(ask: Run) -> None:
    """A few lost paths make no mean."""
    answer = ask(PLANT + "input_limit = [0.3]\n" + COST + UDP + LOSSY, "--steps", "200000")
    assert answer.code == 2
    assert "diverges" in answer.err


def test_none_takes_a_key_away() -> None:
    """A loss makes way for bursts."""
    tables = {
        "plant": {"A": [[0.9]], "B": [[1.0]], "W": [[0.1]], "dt": 0.1},
        "cost": {"Q": [[1.0]], "R": [[1.0]]},
        "network": {"protocol": "udp", "actuator_loss": 0.1},
        "policy": {"kind": "lossy-lqg", "price": 0.1},
    }
    burst = {"to_bad": 0.1, "to_good": 0.5, "loss_good": 0.0, "loss_bad": 1.0}
    problem = parse(tables, "here").changed({"network.actuator_loss": None, "network.actuator_burst": burst})
    assert problem.network.loss("actuator") == pytest.approx(1 / 6)


@pytest.mark.evidence
def test_a_tradeoff_has_a_clock_of_the_same_actuation(run: Run) -> None:
    """Also where the actuator predicts and outputs are measured, of a continuous plant and of a discrete one."""
    rough = ("--standard-error", "1e-2", "--confidence", "0")
    for name, actuation in (
        ("two-mass-continuous", "model"),
        ("two-mass-continuous", "hold"),
        ("two-mass-lqg", "model"),
    ):
        document = json.loads(
            run("tradeoff", name, "--over", "theta=1", "--over", f"actuation={actuation}", *rough, "--json").out
        )
        (point,) = document["points"]
        assert point["clock"]["kind"] == actuation
        assert point["clock"]["cost"] == point["cost_periodic_same_rate"] > point["cost"]["value"]
        assert list(document["periodic"]) == [actuation]
