"""Simulated paths: dropped packets, the trigger of every link, a second control on the same noise, and the figure."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from counts import few
from runtime.silent import build

import taciturn
from taciturn._style import STYLES
from taciturn.design.at_fixed_steps import same_nodes
from taciturn.lqg.discrete import discretise
from taciturn.model.disturbance import follow
from taciturn.model.limits import Limits
from taciturn.model.names import Names
from taciturn.model.signals import ExternalDisturbance, Timetable
from taciturn.problem import parse
from taciturn.simulation.same_packets import even_steps
from taciturn.simulation.trajectory import Trajectory, Weighed

TANKS = "quadruple-tank"


@cache
def path(name: str, steps: int = 200, versus: bool = False) -> Trajectory:
    """Return a path of a built-in problem, perhaps compared with periodic control."""
    problem = taciturn.load(name)
    return taciturn.simulate(problem.close(problem.design()), steps, seed=1, versus="periodic" if versus else None)


def labels(axis: Any) -> list[str]:
    """Return the names in the key of a panel."""
    return [] if axis.get_legend() is None else [text.get_text() for text in axis.get_legend().get_texts()]


def marks(axis: Any, marker: str) -> int:
    """Return the number of marks of a kind in a panel of lanes."""
    return sum(len(line.get_xdata()) for line in axis.get_lines() if line.get_marker() == marker)


@pytest.mark.evidence
def test_a_path_tells_which_packets_the_links_dropped() -> None:
    """A link delivers only what was sent, and drops its share; text, document, table and figure say so."""
    found = path("lossy-double-integrator", 100)
    for link, loss in (("sensor", 0.6), ("actuator", 0.3)):
        sent, delivered = found.sends[link], found.delivered[link]
        assert not (delivered & ~sent).any()
        dropped = int((sent & ~delivered).sum())
        assert abs(dropped / sent.sum() - loss) < 4 * np.sqrt(loss * (1 - loss) / sent.sum())
        assert f"{link} {int(sent.sum())} of 100, {dropped} dropped" in " ".join(str(found).split())
        assert found.document()["delivered"][link] == delivered.tolist()
        assert (found.to_pandas()[f"delivered_{link}"] == delivered).all()
    (lanes,) = [
        axis for axis in found.plot().axes if "link sensor" in [one.get_text() for one in axis.get_yticklabels()]
    ]
    assert marks(lanes, "x") == sum(int((found.sends[link] & ~found.delivered[link]).sum()) for link in found.sends)
    assert all(sent is delivered or (sent == delivered).all() for sent, delivered in zip(
        path("two-mass").sends.values(), path("two-mass").delivered.values(), strict=True
    ))  # fmt: skip


def test_a_path_counts_one_packet_in_one_step() -> None:
    """Without a plural."""
    problem = taciturn.load("two-mass").changed({"theta": 0.0})
    loop = problem.close(problem.design())
    assert taciturn.simulate(loop, 1).verdict[0].startswith("1 packet in 1 step, ")
    assert taciturn.simulate(loop, 2).verdict[0].partition(", ")[0].endswith("in 2 steps (0.2 s)")


def test_every_link_with_a_decision_has_its_trigger() -> None:
    """Four links: a packet is sent where the trigger exceeds its threshold; the first is that of a path with one."""
    found = path(TANKS)
    assert list(found.triggers) == list(found.sends) == ["level-1", "level-2", "pump-1", "pump-2"]
    for link, sent in found.sends.items():
        assert (sent == (found.triggers[link] > found.thresholds[link])).all()
        assert 20 < sent.sum() < 180
    assert found.trigger_value is found.triggers["level-1"]
    table = found.to_pandas()
    assert (table["trigger_pump-2"] == found.triggers["pump-2"]).all()
    assert (table["trigger"] == table["trigger_level-1"]).all()


@pytest.mark.evidence
def test_the_content_of_a_bank_is_part_of_the_threshold_in_a_figure() -> None:
    """So each trigger is a ratio, above 1 where a packet is sent, except for the first packet."""
    found = taciturn.simulate(build("two valves"), 100)
    for link, sent in found.sends.items():
        compared = Weighed(found.triggers[link], found.thresholds[link], found.allowances[link])
        assert compared.ratio is not None
        assert ((compared.ratio > 1) == sent)[1:].all()
    rows = [axis for axis in found.plot().axes if axis.get_ylabel().startswith("trigger")]
    assert [axis.get_yscale() for axis in rows] == ["log"] * 4
    assert "allowances" in found.document()
    assert not path("two-mass").allowances


def test_two_controls_of_one_kind_are_told_apart_by_what_differs() -> None:
    """By parameters, by files, or by their order."""
    one = taciturn.load("two-mass")
    same = (Path(__file__).parents[2] / "src/taciturn/problems/two-mass.toml").read_text(encoding="utf-8")
    others = [one.changed({"theta": 1.0}), parse(tomllib.loads(same), "mine.toml"), one]
    found = [taciturn.simulate(p.close(p.design()), 2, versus=one.close(one.design())) for p in others]
    assert [(each.name, each.versus.name) for each in found if each.versus is not None] == [
        ("event-triggered control (excess), theta = 1.0", "event-triggered control (excess), theta = 0.052"),
        ("event-triggered control (excess), mine.toml", "event-triggered control (excess), two-mass"),
        ("event-triggered control (excess), first", "event-triggered control (excess), second"),
    ]


def noises(found: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return process and measurement noise of a path of a linear plant."""
    plant = found.loop.problem.plant
    moved = found.state[:-1] @ plant.A.T + found.input[:-1] @ plant.B.T
    return found.state[1:] - moved, found.measurement - found.state @ plant.C.T


@pytest.mark.parametrize("name", few(["two-mass", "two-mass-lqg", "pid-tank", TANKS, "lossy-double-integrator"], 2))
def test_periodic_control_has_the_noise_of_a_policy_and_as_many_packets(name: str) -> None:
    """In even intervals; the path of the policy is the one that it has alone."""
    alone, found = path(name, 100), path(name, 100, versus=True)
    other = found.versus
    assert other is not None
    assert (alone.state == found.state).all()
    for one, two in zip(noises(found), noises(other), strict=True):
        assert one == pytest.approx(two, abs=1e-9)
        assert name == "lossy-double-integrator" or one.any()
    assert not (found.input == other.input).all()
    for link in found.triggers:
        assert other.sends[link].sum() == found.sends[link].sum()
        assert np.ptp(np.diff(np.flatnonzero(other.sends[link]))) <= 1
    assert not other.triggers
    assert found.document()["versus"]["state"] == other.state.tolist()
    assert f"{other.name} with the same noise: " in " ".join(str(found).split())


def test_a_held_input_has_the_gains_that_are_best_for_its_intervals() -> None:
    """And an actuator that predicts, or a given controller, the nodes of the policy."""
    names = {name: path(name, 100, versus=True).versus for name in ("two-mass-lqg", "two-mass", "pid-tank")}
    assert [one.name for one in names.values() if one is not None] == [
        "periodic control (optimal gains)", "periodic control (same nodes)", "periodic control (same nodes)",
    ]  # fmt: skip


def test_the_same_nodes_at_fixed_steps_are_periodic_control() -> None:
    """The kind of periodic control with a predicting actuator, which is designed independently: equal states."""
    problem = taciturn.load("two-mass")
    timed = same_nodes(problem.design(), {"actuator": np.arange(200) % 4 == 0})
    designed = taciturn.design.periodic(problem.plant, problem.cost, every=4, actuation="model")
    paths = [taciturn.simulate(problem.close(policy), 200, seed=3) for policy in (timed, designed)]
    assert paths[0].sends["actuator"].sum() == 50
    assert paths[0].state == pytest.approx(paths[1].state, abs=1e-9)


def test_a_schedule_keeps_its_steps() -> None:
    """The gains of a filter may be those of the steps in which the sensor is read."""
    found = path("rover", 60, versus=True)
    assert found.versus is not None
    assert (found.versus.sends["sensor"] == found.sends["sensor"]).all()
    assert found.versus.sends["actuator"].sum() == found.sends["actuator"].sum()


def test_two_policies_are_simulated_with_the_same_noise() -> None:
    """Also if only one of them draws thresholds; loops of other plants are refused, and periodic control of a clock."""
    problem = taciturn.load("two-mass-lqg")
    drawn = problem.changed({"kind": "stochastic", "theta": None, "scale": 0.5})
    found = taciturn.simulate(problem.close(problem.design()), 50, versus=drawn.close(drawn.design()))
    assert found.versus is not None
    for one, two in zip(noises(found), noises(found.versus), strict=True):
        assert one == pytest.approx(two, abs=1e-9)
    other = taciturn.load("pid-tank").design()
    with pytest.raises(
        taciturn.ProblemError,
        match="the loop given as versus has 3 states, but this loop has 4; expected two loops with the same",
    ):
        taciturn.simulate(problem.close(problem.design()), 50, versus=other)
    clock = problem.changed({"kind": "periodic", "theta": None, "every": 3})
    with pytest.raises(
        taciturn.ProblemError, match="the policy periodic itself sends at fixed steps; expected a policy that"
    ):
        taciturn.simulate(clock.close(clock.design()), 50, versus="periodic")
    with pytest.raises(taciturn.ProblemError, match="versus is 'clock'; expected one of the words 'periodic'"):
        taciturn.simulate(clock.design(), 50, versus="clock")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("packets", "steps"), [(0, 5), (1, 5), (5, 5), (3, 10), (7, 19)])
def test_even_steps_are_as_many_as_wanted(packets: int, steps: int) -> None:
    """Intervals differ by at most one step, also from the last packet to the end."""
    sent = even_steps(packets, steps)
    assert sent.sum() == packets
    gaps = np.diff([*np.flatnonzero(sent), steps])
    assert packets == 0 or (sent[0] and np.ptp(gaps) <= 1)


def test_the_cost_of_a_path_is_that_of_its_steps() -> None:
    """Over a part of a horizon exactly, over all of it with the final state; over many steps near the average."""
    found = path("lossy-double-integrator", 99)
    assert found.cost == pytest.approx(float((found.state**2).sum() + (found.input**2).sum()), rel=1e-9)
    whole = path("lossy-double-integrator", 100)
    last = whole.state[-1] @ whole.state[-1] + whole.input[-1] @ whole.input[-1]
    assert whole.cost > found.cost + last
    long = path("two-mass", 20_000)
    average = taciturn.average(long.loop, steps=1_000_000)
    assert long.cost == pytest.approx(average.cost.value, rel=0.1)


@pytest.mark.evidence
def test_the_figure_has_a_panel_for_each_of_what_a_path_has() -> None:
    """Outputs and estimates, inputs, lanes, and triggers as ratios on logarithmic axes."""
    axes = path(TANKS).plot().axes
    links = ["level-1", "level-2", "pump-1", "pump-2"]
    triggers = [f"trigger\n{link}" for link in links]
    assert [axis.get_ylabel() for axis in axes] == ["outputs (cm)", "inputs (V)", "", *triggers]
    assert labels(axes[0]) == ["level 1", "level 2", "estimates"]
    assert labels(axes[1]) == ["pump 1", "pump 2"]
    assert [label.get_text() for label in axes[2].get_yticklabels()] == [f"link {link}" for link in links]
    assert {axis.get_yscale() for axis in axes[3:]} == {"log"}
    assert axes[0].get_title() == "event-triggered control (distributed)"


@pytest.mark.evidence
def test_curves_of_two_paths_have_the_colours_of_their_controls() -> None:
    """Those of periodic control are amber, several signals in tones; each column has a key; no triggers are shown."""
    both, style = path(TANKS, 100, versus=True).plot().axes, STYLES["light"]
    assert [axis.get_ylabel() for axis in both] == ["outputs (cm)", "", "inputs (V)", "", "", ""]
    assert both[1].get_title() == "periodic control (same nodes)"
    assert both[0].get_ylim() == both[1].get_ylim()
    for axis, thing in ((both[2], "policy"), (both[3], "periodic control")):
        assert [line.get_color() for line in axis.get_lines()] == [style.color(thing, tone) for tone in (0, 1)]
        assert labels(axis) == ["pump 1", "pump 2"]


@pytest.mark.evidence
def test_a_figure_for_a_column_of_a_journal_omits_estimates_and_triggers() -> None:
    """The estimates of several outputs, and triggers between the first and the last."""
    axes = path(TANKS, 100).plot(style="paper").axes
    assert labels(axes[0]) == ["level 1", "level 2"]
    assert [axis.get_ylabel().split("\n")[-1] for axis in axes[3:]] == ["level-1", "pump-2"]
    assert "2 of 4 triggers" in [text.get_text() for text in axes[3].texts]
    assert "estimate" in labels(path("pid-tank", 100).plot(style="paper").axes[0])


@pytest.mark.evidence
def test_the_figure_shows_set_points_limits_and_disturbances() -> None:
    """Set-points that change, limits of inputs and states that the path comes near, and a limit that is far away."""
    tank = taciturn.load(TANKS)
    leak = ExternalDisturbance([-0.1, 0.0, 0.0, 0.0], wander=1e-3)
    table = Timetable([0, 50, 100], [[0.0, 0.0], [2.0, 1.0], [0.0, 0.0]])
    rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]
    base = discretise(tank.plant, tank.cost, 2.0).plant
    plant = taciturn.Plant(base.A, base.B, base.W, base.C, base.V, 2.0, input_limit=[3.0, 500.0])
    problem = taciturn.Problem(
        follow(plant, rows, None, [leak], table), tank.cost, tank.network, "distributed",
        {name: value for name, value in tank.parameters.items() if name != "period"},
        limits=Limits([rows[0]], high=[2.5]),
    )  # fmt: skip
    found = taciturn.simulate(problem.close(problem.design()), 100, seed=1)
    axes = found.plot().axes
    assert [axis.get_ylabel() for axis in axes[:5]] == ["level-1", "level-2", "disturbance", "pump-1", "pump-2"]
    assert labels(axes[0]) == ["level-1", "estimate", "set-point", "outside the limit 2.5"]
    (steps,) = [line.get_ydata() for line in axes[0].get_lines() if line.get_label() == "set-point"]
    assert set(np.round(steps, 9)) == {0.0, 2.0}
    assert labels(axes[3]) == ["outside the limits −3 to 3"]
    assert axes[3].get_ylim()[1] > 3
    assert labels(axes[4]) == ["outside the limits −500 to 500, not reached"]
    assert axes[4].get_ylim()[1] < 100


@pytest.mark.evidence
def test_a_stored_reference_is_what_the_outputs_follow() -> None:
    """The figure shows it as the set-point; the path has it in each step."""
    reference = taciturn.Reference(np.linspace(0.0, 1.0, 21)[:, None], np.full((20, 1), 0.05))
    plant, cost = taciturn.Plant([[1.0]], [[1.0]], [[1e-4]]), taciturn.Cost([[1.0]], [[1.0]], horizon=20)
    network = taciturn.Network("udp", actuator_loss=0.1)
    policy = taciturn.design.lossy_lqg(plant, cost, price=1e-3, network=network, reference=reference)
    found = taciturn.simulate(policy, 20)
    assert found.reference[:, 0] == pytest.approx(np.linspace(0.0, 0.95, 20))
    assert "set-point" in labels(found.plot().axes[0])


UNNAMED = {"plant.input_names": None, "plant.output_names": None, "plant.units": None}


@pytest.mark.evidence
def test_names_of_signals_have_their_units_in_the_figure() -> None:
    """Signals of different units have panels of their own; without names, those of the nodes, or letters."""
    pendulum = taciturn.load("pendulum-by-encoders")
    found = taciturn.simulate(pendulum.close(pendulum.design()), 20, versus="periodic")
    assert [axis.get_ylabel() for axis in found.plot().axes[::2]] == [
        "position (m)", "angle (rad)", "force (N)", "",
    ]  # fmt: skip
    tanks = taciturn.load(TANKS).changed(UNNAMED)
    assert labels(taciturn.simulate(tanks.close(tanks.design()), 20).plot().axes[0])[:2] == ["level-1", "level-2"]
    plain = pendulum.changed(UNNAMED)
    shown = taciturn.simulate(plain.close(plain.design()), 20).plot().axes
    assert labels(shown[0])[0] == "$y_{1}$"


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"outputs": ["level"]}, "names.outputs has 1 entry; expected 2 entries, one for each of the outputs"),
        ({"inputs": ["", "pump"]}, "names.inputs.0. is ''; expected 1 to 40 characters, such as 'level .cm.'"),
        ({"states": ["level"]}, "names.states is not a known key; expected one of outputs, inputs"),
    ],
)
def test_names_that_do_not_fit_are_refused(names: dict[str, list[str]], message: str) -> None:
    """In one sentence, when the file is read; the table is the older form of the keys of [plant]."""
    plain = taciturn.load(TANKS).changed(UNNAMED)
    with pytest.raises(taciturn.ProblemError, match=message):
        plain.changed({"names": names})
    assert plain.changed({"names": {"outputs": ["a", "b"]}}).plant.names == Names(outputs=("a", "b"))
