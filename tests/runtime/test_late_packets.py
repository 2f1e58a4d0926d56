"""Nodes over links that delay packets at random: the bits of the simulated loop, and what the inbox does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from counts import few
from runtime.late import (
    STATES,
    WITHIN,
    delays,
    differing_steps,
    inputs_of,
    late_sensor,
    nodes_of,
    pendulum,
    record,
    sets,
    told_late,
)
from runtime.loops import column

import taciturn
from taciturn import Nodes, ProblemError
from taciturn.base.given_controller import lqg_observer
from taciturn.loop import Loop
from taciturn.lqg.discrete import discretise
from taciturn.model.network import Network
from taciturn.model.steps import Assign, Received
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Packet
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.program import numpy as interpreter
from taciturn.program.draws import NORMAL, UNIFORM
from taciturn.program.ops import is_entry

STEPS = 1000
DEAD_BANDS = {
    **{"kind": "send-on-delta", "theta": None, "prediction": None, "actuation": None},
    **{"delta": 0.4, "shares": {"level-1": 2.0}},
}
CONTRIBUTIONS: dict[str, dict[str, object]] = {
    "level-1": {"delay": [0.4, 0.2, 0.1, 0.2], "payload": "float32"},
    "level-2": {"delay": [0.3, 0.6]},
    "pump-1": {"delay": [0.5, 0.4]},
}
TRACED = {"sequence": (0, 0, 1, 3, 0, 2, 1, 3, 3, 0), "block": 4.0}


def loops() -> dict[str, Callable[[], Loop]]:
    """Return loops with delays of whole steps and parts of them, of packets to actuators and of those of sensors."""

    def held(policy: dict[str, object], law: object) -> Loop:
        problem = taciturn.load("inverted-pendulum").changed(policy)
        return taciturn.close(problem.plant, problem.design(), problem.network.changed({"actuator": {"delay": law}}))

    def tanks(laws: dict[str, dict[str, object]]) -> Loop:
        problem = taciturn.load("quadruple-tank").changed(DEAD_BANDS)
        return taciturn.close(problem.plant, problem.design(), problem.network.changed(laws))

    def acknowledged(**more: object) -> Loop:
        problem = pendulum({"delta": 0.05}, **more)
        return problem.close(problem.design())

    def closed(problem: taciturn.Problem) -> Loop:
        return problem.close(problem.design())

    burst = {"law": "gilbert-elliott", "to_bad": 0.1, "to_good": 0.3, "loss_good": 0.0, "loss_bad": 0.4}
    states = [[0.9, 0.1], [0.2, 0.6]]

    def unheard(policy: dict[str, object], given: bool = False, resting: bool = False, **link: Any) -> Loop:
        problem = pendulum({"delta": 0.05, **policy}, **{"acknowledged": False, **link})
        if resting:
            problem = problem.changed({"plant.operating_point": {"x": [1.0, 0.0, 0.0, 0.0], "u": [3.0]}})
        if not given:
            return problem.close(problem.design())
        kept = lqg_observer("excess", discretise(problem.plant, problem.cost, 0.02))
        design = taciturn.design.excess(
            problem.plant, problem.cost, delta=0.05, period=0.02, actuation="model", controller=kept,
            network=problem.network,
        )  # fmt: skip
        return taciturn.close(problem.plant, design, problem.network)

    def heard(changes: dict[str, object]) -> Loop:
        late = {"network.sensor_delay": [0.3, 0.1, 0.4, 0.1], "network.sensor_loss": 0.1, "network.protocol": "udp"}
        policy = {"kind": "excess", "link": "sensor", "actuation": "model", "theta": 0.3}
        problem = taciturn.load("inverted-pendulum").changed({**policy, **late, **changes})
        return problem.close(problem.design())

    def predicting(laws: dict[str, dict[str, object]]) -> Loop:
        changes = {f"links.{link}.{key}": one for link, law in laws.items() for key, one in law.items()}
        problem = taciturn.load("quadruple-tank").changed(changes)
        return problem.close(problem.design())

    def measured_late(**changes: object) -> Loop:
        return closed(late_sensor(**changes))

    early, late = {"delay": {"seconds": [0.5, 1.5], "probability": [0.5, 0.4]}}, {"seconds": 1.2}
    return {
        "acknowledged": acknowledged,
        "acknowledged, within periods": lambda: acknowledged(delay=WITHIN),
        "acknowledged, rounded": lambda: acknowledged(payload="float32"),
        "measurements": lambda: heard(
            {"actuation": "hold", "network.protocol": "tcp", "theta": 0.1, "network.sensor_delay": [0.5, 0.4]}
        ),
        "measurements at an operating point": lambda: heard({
            "actuation": "hold", "network.protocol": "tcp", "theta": 0.1, "network.sensor_delay": [0.5, 0.4],
            "network.payload": "float32",
            "plant.operating_point": {"x": [1.0, 0.0, 0.0, 0.0], "u": [3.0]},
        }),
        "best gains": lambda: closed(pendulum({"delta": 0.05, "gains": "loss-optimal"})),
        "best gains of sets": lambda: closed(sets(gains="loss-optimal")),
        "sets of actuators": lambda: closed(sets()),
        "sets of actuators, bursts": lambda: closed(sets(**{
            "links.valve.delay": {"states": states}, "links.valve.burst": burst
        })),
        "sets, told late": lambda: closed(told_late()),
        "one told late": lambda: closed(told_late(**{
            "links.valve.delay": None, "links.pump.delay": [0.6, 0.4]
        })),
        "periodic": lambda: held({"kind": "periodic", "theta": None, "every": 1}, WITHIN),
        "lqg": lambda: held({}, [0.5, 0.2, 0.3]),
        "predicted": lambda: unheard({"actuation": "model"}),
        "predicted, within periods and rounded": lambda: unheard(
            {"actuation": "model"}, delay=WITHIN, payload="float32"
        ),
        "predicted with a given controller": lambda: unheard({"actuation": "model"}, given=True),
        "predicted by a controller": lambda: heard({}),
        "predicted by a controller at an operating point": lambda: heard(
            {"plant.operating_point": {"x": [1.0, 0.0, 0.0, 0.0], "u": [3.0]}, "network.payload": "float32"}
        ),
        "contributions of sensors": lambda: predicting(CONTRIBUTIONS),
        "contributions of sensors that predict nothing": lambda: closed(taciturn.load("quadruple-tank").changed({
            "prediction": "hold", "links.level-1.delay": {"seconds": [0.5, 3], "probability": [0.6, 0.3]},
        })),
        "late states": lambda: measured_late(**STATES),
        "late states, inputs lost unnoticed": lambda: measured_late(**STATES, **{"network.protocol": "udp"}),
        "late measurements, fused": measured_late,
        "late measurements, fused and rounded": lambda: measured_late(**{"network.payload": "float32"}),
        "late measurements, fused at an operating point": lambda: measured_late(
            **{"plant.operating_point": {"x": [2.9, -1.0], "u": [-0.3]}}
        ),
        "two sensors at one place, fused": lambda: measured_late(
            **{"plant.C": [[1.0, 0.0], [0.5, 1.0]], "plant.V": [[0.1, 0.04], [0.04, 0.2]]}
        ),
        "plan": lambda: unheard({"plan": 3}, delay=[0.3, 0.1, 0.1, 0.1, 0.3]),
        "plan, within periods": lambda: unheard({"plan": 1}, delay=WITHIN),
        "plan at an operating point": lambda: unheard({"plan": 2}, resting=True),
        "predicted at an operating point": lambda: unheard({"actuation": "model"}, resting=True),
        "two actuators that predict": lambda: predicting({
            "pump-1": {"delay": {"seconds": [0.3, 2.5], "probability": [0.5, 0.4]}},
            "pump-2": {"delay": [0.5, 0.2, 0.2]},
        }),
        "sensors and actuators": lambda: tanks({
            "level-2": early, "pump-1": {"loss": 0.1, "delay": [0.3, 0.2, 0.1, 0.1]}, "level-1": {"delay": [0.5, 0.5]}
        }),
        "two actuators, within periods": lambda: tanks({
            "level-1": early, "pump-1": {"delay": {"seconds": [0.3, 2.5], "probability": [0.5, 0.4]}},
            "pump-2": {"delay": {"seconds": [1.1, 2.3], "probability": [0.5, 0.2]}},
        }),
        "one of two actuators": lambda: tanks({"pump-1": early}),
        "one random and one constant delay": lambda: tanks({"pump-1": early, "pump-2": {"delay": late}}),
    }  # fmt: skip


@pytest.mark.parametrize("name", few(loops(), 12))
def test_nodes_and_loop_agree_bit_for_bit(name: str) -> None:
    """Separate nodes, which go on from their saved states after half of the steps, and all nodes as one function."""
    loop = loops()[name]()
    records = record(loop, STEPS, 1)
    wrong, nodes = differing_steps(loop, records, kept=STEPS // 2)
    assert wrong == []
    assert not any(node.degraded for node in nodes.values())
    assert all(node.counters["late"] == 0 for node in nodes.values())
    together, after, y = Nodes(loop), delays(loop, records), column(records, "y")
    given = inputs_of(loop, records)
    waits = {link: together._waits[link] for link in loop.network.late}
    came = set[float | None]()
    for k in range(STEPS):
        codes = {link: float(d[k]) for link, d in after.items()}
        fates = {link: waits[link].get(code, False) if link in waits else code == 0 for link, code in codes.items()}
        u = together.step(y[k], fates=fates)
        assert u.tobytes() == given[k].tobytes()
        assert all(together.delays[link] == (fates[link] if fates[link] is not False else None) for link in waits)
        came |= set(together.delays.values())
    assert len(came) > 2


def test_older_packets_are_superseded_and_not_acknowledged() -> None:
    """A packet that arrives after a newer one acts no more; one that comes in the step of a newer one is told."""
    loop = pendulum().close(pendulum().design())
    actuator, data = Node(loop.policy, "actuator", network=loop.network), Packet("data", "actuator", 0, 0, (1.0,))
    assert actuator.step(0).input == (0.0,)
    sent = actuator.step(1, packets=[data._replace(tick=1, sequence=1, values=(2.0,)), data._replace(late=1)])
    assert sent.input == (2.0,)
    assert [(p.kind, p.tick, p.values) for p in sent.packets] == [
        ("acknowledgement", 1, (0.0,)), ("acknowledgement", 0, (1.0,))
    ]  # fmt: skip
    assert actuator.readings == {("data", "actuator"): (2.0,)}
    actuator.sort_in(data._replace(tick=2, sequence=2, values=(3.0,), late=2))  # heard in step 4
    assert actuator.step(2).input == (2.0,)
    late = data._replace(tick=3, sequence=3, values=(4.0,))
    assert actuator.step(3, packets=[late]).input == (4.0,)
    assert actuator.step(4) == ((), (4.0,))
    assert actuator.counters["superseded"] == 2


def test_a_filter_uses_all_packets_that_are_not_too_old() -> None:
    """Also those that newer ones have overtaken; a packet beyond the longest delay is late and does not count."""
    problem = late_sensor(**{"network.protocol": "ideal", "network.sensor_loss": 0.0, "network.actuator_loss": 0.0})
    loop = problem.close(problem.design())

    def after(packets: dict[int, list[Packet]]) -> tuple[Node, list[float]]:
        controller = Node(loop.policy, "controller", network=loop.network)
        sent = [controller.step(k, packets=packets.get(k, [])).packets for k in range(6)]
        return controller, [packet.values[0] for packets in sent for packet in packets if packet.kind == "data"]

    data = [Packet("data", "sensor", k, k, (1.0 + k,)) for k in range(6)]
    both, inputs = after({2: [data[2], data[1]._replace(late=1)], 3: [data[0]._replace(late=3)]})
    assert (both.counters["used"], both.counters["superseded"], both.counters["late"]) == (3, 0, 0)
    assert both.readings["data", "sensor"] is None
    newest, fewer = after({2: [data[2]]})
    assert newest.counters["used"] == 1
    assert fewer[0] != inputs[0]
    late, same = after({2: [data[2]], 5: [data[0]._replace(late=5)]})
    assert (late.counters["used"], late.counters["late"]) == (1, 1)
    assert same == fewer


def test_packets_of_each_age_are_for_receivers_that_work_once_per_step() -> None:
    """An actuator acts when a packet arrives; and no receiver takes the newest packet beside those of each age."""
    plant, policy = taciturn.load("inverted-pendulum").plant, taciturn.load("inverted-pendulum").design()

    def changed(*branches: Assign) -> taciturn.Policy:
        steps = [step for step in policy.steps if not (isinstance(step, Assign) and step.signal == "input")]
        return replace(policy, steps=(*steps, *branches))

    unit = np.eye(1)
    one = Assign("actuator", "input", ({"input": unit}, {"command": unit}), Received("actuator", of_age=1))
    for wrong in (
        [one],
        [one, Assign("actuator", "other", ({"input": unit}, {"command": unit}), Received("actuator"))],
    ):
        with pytest.raises(ProblemError, match=r"uses the packets of each age on the actuator link \(of_age\), but it"):
            taciturn.close(plant, changed(*wrong), policy.network.changed({"actuator": {"delay": [0.5, 0.5]}}))


def test_a_packet_without_a_time_of_arrival_is_heard_in_the_next_step() -> None:
    """In real time, a node learns only that it has come: its acknowledgement tells the step that hears it."""
    loop = pendulum(delay=WITHIN).close(pendulum(delay=WITHIN).design())
    actuator = Node(loop.policy, "actuator", network=loop.network)
    actuator.step(0)
    actuator.step(1)
    sent = actuator.step(2, packets=[Packet("data", "actuator", 0, 0, (1.0,))])
    assert sent.input == (1.0,) * actuator.pieces == (1.0,) * 4
    assert [packet.values for packet in sent.packets] == [(8.0,)]
    other = Node(loop.policy, "actuator", network=loop.network, safe=(0.5,), watchdog=2)
    assert [other.step(k).input for k in range(3)][-1] == (0.5,) * 4


def test_late_acknowledgements_degrade_the_controller() -> None:
    """It then expects a packet in flight that has arrived."""
    loop = pendulum().close(pendulum().design())
    controller = nodes_of(loop)["controller"]
    packets = [packet for k in range(3) for packet in controller.step(k, [0.3, 0.3]).packets]
    assert packets
    controller.step(3, [0.3, 0.3], [Packet("acknowledgement", "actuator", 0, 0, (0.0,))])
    assert controller.counters["late"] == 1
    assert controller.reasons["late acknowledgement"] == 1


@pytest.mark.parametrize("law", [ [0.5, 0.3, 0.1], WITHIN ], ids=["whole steps", "within periods"])  # fmt: skip
def test_drawn_delays_have_the_uniform_numbers_of_the_simulation(law: object) -> None:
    """The loop of a plant and all nodes: the simulation with the same noise and uniform numbers has the same bits."""
    problem = pendulum({"delta": 0.05}, delay=law)
    loop = problem.close(problem.design())
    program = loop.whole_program()
    program, nodes = program.keep(outputs=set(program.outputs)), Nodes(loop, seed=4)
    uniform = [name.index if is_entry(name, UNIFORM) else -1 for name in program.inputs]
    normal, steps = np.array([is_entry(name, NORMAL) for name in program.inputs]), 300
    inputs = np.random.default_rng(3).standard_normal((steps, len(program.inputs), 1)) * normal[:, None]
    for k in range(steps):
        drawn = nodes.turns.drawn(k)
        inputs[k, :, 0] += [drawn[i] if i >= 0 else 0.0 for i in uniform]
    found = interpreter.run(program, loop.start(program, 1, 5), steps, inputs).outputs
    y, applied = column(found, "y"), column(found, "applied")
    seen = set[float | None]()
    for measured, u in zip(y, applied, strict=True):
        assert nodes.step(measured)[-1:].tobytes() == u.tobytes()
        seen.add(nodes.delays["actuator"])
    assert len(seen) == 1 + len(loop.network.links["actuator"].delay.waits)  # type: ignore[union-attr]


def test_the_simulated_plant_applies_the_inputs_of_the_pieces() -> None:
    """The states of two plants with the same noise differ by the effect of their inputs; others are refused."""
    problem = pendulum(delay=WITHIN)
    loop = problem.close(problem.design())
    plant, other, inputs = SimulatedPlant(loop, 1), SimulatedPlant(loop, 1), [1.0, -2.0, 0.5, 3.0]
    plant.move(inputs)
    other.move([0.0] * 4)
    assert plant.pieces == 4
    assert loop.problem.pieces is not None
    assert np.allclose(plant.state - other.state, loop.problem.pieces.B @ inputs, rtol=0, atol=1e-12)
    with pytest.raises(ProblemError, match="4 entries, one for each input of the plant in each of 4 pieces"):
        plant.move([0.0])


def test_fates_of_late_links_are_delays() -> None:
    """Not whether the packet arrives."""
    loop = pendulum().close(pendulum().design())
    for wrong in (True, 3, 0.5):
        with pytest.raises(ProblemError, match="expected False, or the delay in steps: 0, 1, 2"):
            Nodes(loop).step([0.0, 0.0], fates={"actuator": wrong})


def test_a_policy_that_is_told_of_arrivals_needs_the_parts_of_the_period_of_its_design() -> None:
    """A link without random delays, or with other parts; shorter delays of the same parts are allowed."""
    plant, policy = taciturn.load("inverted-pendulum").plant, pendulum().design()
    acknowledged = {"actuator": {"acknowledged": True}}
    for network in (Network(), Network().changed(acknowledged), pendulum(delay=WITHIN).network):
        with pytest.raises(ProblemError, match=r"is not random|ends at the parts"):
            taciturn.close(plant, policy, network)
    loop = taciturn.close(plant, policy, pendulum(delay=[0.8, 0.2]).network)
    assert differing_steps(loop, record(loop, 200, 2))[0] == []
