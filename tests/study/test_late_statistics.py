"""Statistics of late packets: closed forms of ages and of overtaken packets, and packets that are followed singly."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import taciturn
from taciturn import Loop, evaluate, load, simulate
from taciturn.design.at_fixed_steps import sending_always
from taciturn.model.estimate import Estimate
from taciturn.simulation.late_packets import LatePackets, count_packets, late_packets

if TYPE_CHECKING:
    from collections.abc import Callable

STEPS = [0.2, 0.3, 0.4]  # and 0.1 lost
PARTS = {"seconds": [0.004, 0.013, 0.02, 0.047], "probability": [0.4, 0.3, 0.2, 0.05]}  # periods are 0.02 s
NEVER = 1e6


def pendulum(delay: Any, loss: float = 0.1, protocol: str = "tcp", **policy: Any) -> Loop:
    """Return the inverted pendulum whose actuator link delays packets at random."""
    network = {"network.protocol": protocol, "network.actuator_loss": loss, "network.actuator_delay": delay}
    problem = load("inverted-pendulum").changed({"kind": "excess", **network, **policy})
    return problem.close(problem.design())


def agrees(found: Estimate | None, value: float) -> bool:
    """Return whether an estimate with an error of its own agrees with a number."""
    assert found is not None
    assert 0.0 < found.standard_error < 0.02 * max(value, 0.5)
    return abs(found.value - value) < 5 * found.standard_error


def arrived_by(waits: list[float], chances: list[float]) -> Callable[[float], float]:
    """Return the probability that a packet has arrived some periods after it was sent."""
    return lambda time: sum(p for wait, p in zip(waits, chances, strict=True) if wait <= time + 1e-9)


def closed_forms(waits: list[float], chances: list[float]) -> tuple[float, float, dict[int, float], float, float]:
    """Return lost, late, late by steps, overtaken, and the mean age of data in periods, if every step sends.

    Data are at least j periods old at the part r of a period if none of the j newest packets has arrived:
    P = Π_{i<j} (1 − F(i + r)). A packet that takes the time t is not overtaken if none of the next ones, sent i periods
    later, arrives within t − i.
    """
    F, total = arrived_by(waits, chances), sum(chances)
    cuts = sorted({0.0, *(round(wait % 1.0, 9) for wait in waits)})
    age = 0.0
    for r, end in zip(cuts, [*cuts[1:], 1.0], strict=True):
        at_least = np.cumprod([1 - F(i + r) for i in range(400)])
        age += (end - r) * float(at_least.sum())
    used = sum(
        p * np.prod([1 - F(wait - i) for i in range(1, int(wait) + 1)]) for wait, p in zip(waits, chances, strict=True)
    )
    late = {int(d): 0.0 for d in waits}
    for wait, p in zip(waits, chances, strict=True):
        late[int(wait)] += p / total if wait > 0 else 0.0
    return 1 - total, sum(late.values()), late, 1 - used / total, age


@pytest.mark.parametrize(
    ("delay", "waits", "chances"),
    [(STEPS, [0.0, 1.0, 2.0], STEPS), (PARTS, [0.2, 0.65, 1.0, 2.35], PARTS["probability"])],
    ids=["steps", "parts of a period"],
)
def test_ages_of_a_loop_that_always_sends_have_closed_forms(
    delay: Any, waits: list[float], chances: list[float]
) -> None:
    """For independent delays and losses, in whole steps and in parts of a period."""
    loop = pendulum(delay)
    step = loop.policy.tick
    always = replace(loop, policy=sending_always(loop.policy))
    found = late_packets(always, seed=3)["actuator"]
    lost, late, by_steps, overtaken, age = closed_forms(waits, [0.9 * p for p in chances])
    assert agrees(found.lost, lost)
    assert agrees(found.late, late) if late < 1 else found.late.value == pytest.approx(1.0)
    assert agrees(found.overtaken, overtaken)
    assert agrees(found.age, age * step)
    assert all(agrees(share, by_steps[d]) for d, share in found.steps.items())
    assert set(found.steps) == {d for d, share in by_steps.items() if share > 0}
    assert found.packets > 100_000
    assert found.unit == "s"


def followed(sent: list[bool], codes: list[float], cuts: list[float], first: int) -> tuple[list[int], list[float]]:
    """Return counts and ages of a path whose packets are followed one by one, through a list of those on their way."""
    q, way, newest = len(cuts), list[tuple[int, int]](), -1
    lost = late = overtaken = arrived = 0
    ages, weights = list[float](), list[float]()
    for k, (packet, code) in enumerate(zip(sent, codes, strict=True)):
        if packet and code >= NEVER:
            lost += k >= first
        elif packet:
            way.append((k * q + int(code), k))
        for piece in range(q):
            here = [k_sent for at, k_sent in way if at == k * q + piece]
            way = [one for one in way if one[1] not in here]
            for one in here:
                arrived += one >= first
                late += one >= first and (k, piece) != (one, 0)
                overtaken += one >= first and (one < newest or one != max(here))
            newest = max([newest, *here])
            if newest >= 0 and k >= first:
                ages.append(k - newest)
                weights.append([*cuts, 1.0][piece + 1] - cuts[piece])
    return [lost, arrived, late, overtaken], [float(np.average(ages, weights=weights)), max(ages)]


@pytest.mark.parametrize("cuts", [[0.0], [0.0, 0.2, 0.65]])
def test_counts_are_those_of_packets_that_are_followed_one_by_one(cuts: list[float]) -> None:
    """Packets are sent now and then, with delays of which many overtake each other."""
    draws, steps, q = np.random.default_rng(len(cuts)), 300, len(cuts)
    sent = draws.random((steps, 1)) < 0.6
    codes = np.where(draws.random((steps, 1)) < 0.1, NEVER, draws.integers(0, 5 * q, (steps, 1)).astype(float))
    found = count_packets(sent, np.where(sent, codes, NEVER), cuts, range(40, steps))
    (lost, arrived, late, overtaken), (mean, most) = followed(sent[:, 0].tolist(), codes[:, 0].tolist(), cuts, 40)
    assert found.packets == lost + arrived
    assert found.lost.value == pytest.approx(lost / (lost + arrived))
    assert (found.late.value, found.overtaken.value) == (late / arrived, overtaken / arrived)
    assert found.age is not None
    assert (found.age.value, found.largest) == (pytest.approx(mean), most)
    assert found.overtaken.value > 0.2
    assert sum(share.value for share in found.steps.values()) == pytest.approx(found.late.value)


@pytest.mark.parametrize("delay", [STEPS, PARTS], ids=["steps", "parts of a period"])
def test_a_path_counts_what_its_own_packets_did(delay: Any) -> None:
    """Dropped, overtaken and other packets add up; text and JSON have the same numbers."""
    loop = pendulum(delay)
    path = simulate(loop, 400, seed=5)
    sent, delivered, overtaken = path.sends["actuator"], path.delivered["actuator"], path.overtaken["actuator"]
    assert not (delivered & ~sent).any()
    assert not (overtaken & ~delivered).any()
    late = path.late["actuator"]
    lost, unused = int((sent & ~delivered).sum()), int(overtaken.sum())
    assert 0 < lost < 0.3 * sent.sum()
    assert unused > 2
    on_the_way = int(sent.sum()) - late.packets
    assert 0 <= on_the_way <= 3
    assert late.lost.value == pytest.approx(lost / late.packets)
    assert late.overtaken.value == pytest.approx(unused / (late.packets - lost))
    assert f"of which {lost} were dropped and {unused} were overtaken" in path.verdict[0]
    assert path.packets("actuator").endswith(f"{lost} dropped, {unused} overtaken")
    document = json.loads(json.dumps(path.document()))
    assert document["late_packets"]["actuator"]["overtaken"]["value"] == late.overtaken.value
    assert document["overtaken"]["actuator"] == overtaken.tolist()
    assert set(path.columns()) >= {"sent_actuator", "delivered_actuator", "overtaken_actuator"}


def test_an_overtaken_packet_does_not_change_the_input() -> None:
    """With whole steps and an input that is held: it changes only where a packet arrives that is not overtaken."""
    path = simulate(pendulum(STEPS), 300, seed=2)
    late = path.late["actuator"]
    changes = int((np.diff(path.input[:, 0]) != 0).sum())
    used = late.packets * (1 - late.lost.value) * (1 - late.overtaken.value)
    assert abs(changes - round(used)) <= 2  # the first packet, and that of the last step


@pytest.mark.evidence
def test_an_evaluation_has_the_numbers_in_its_document_and_its_details() -> None:
    """A loop without random delays has none, nor one with a buffer."""
    problem = load("inverted-pendulum").changed({"kind": "excess", "network.protocol": "tcp",
                                                 "network.actuator_delay": [0.5, 0.5]})  # fmt: skip
    found = evaluate(problem, steps=10_000)
    late = found.document()["late_packets"]["actuator"]
    assert late["lost"]["value"] == 0.0
    assert abs(late["late"]["value"] - 0.5) < 5 * late["late"]["standard_error"]
    assert "late packets" in found.text(verbose=True)
    assert "late packets" not in found.text()
    buffered = evaluate(problem.changed({"network.actuator_buffer": 1}), steps=10_000)
    assert "late_packets" not in buffered.document()


def test_many_delays_are_summed_in_the_text() -> None:
    """The first five are listed."""
    share = Estimate(0.1, 0.0, "exact")
    found = LatePackets("s", 10, share, Estimate(0.8, 0.0, "exact"), dict.fromkeys(range(8), share), share, share, 0.3)
    assert "10.0 % by less than a step, 10.0 % by 1 step" in found.text()
    assert found.text().count(" by ") == 6
    assert "30.0 % by more, up to 7)" in found.text()


def test_registers_of_constant_delays_have_names() -> None:
    """By the input or output, and how many steps ago it was commanded or measured."""
    path = simulate(_loop("two-mass", {"network.actuator_delay": 2}), 20)
    assert list(path.registers.values()) == ["force, 1 step ago", "force, 2 steps ago"]
    (first, second) = (int(name[1:]) - 1 for name in path.registers)
    assert np.array_equal(path.state[1:, first], path.input[:-1, 0])
    assert np.array_equal(path.state[1:, second], path.state[:-1, first])
    assert path.input.any()
    assert path.document()["registers"] == path.registers
    assert "registers" not in simulate(_loop("two-mass", {}), 5).document()


def _loop(name: str, changes: dict[str, Any]) -> taciturn.Loop:
    problem = load(name).changed(changes)
    return problem.close(problem.design())
