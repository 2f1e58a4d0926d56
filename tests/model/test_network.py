"""Networks and bursts: what they refuse, what a bursty link does in a loop, and that both printers agree on it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from drawn import law
from hypothesis import strategies as st
from model.fading import FADING, JAMMER
from parity.loops import assert_parity, differences, same

from taciturn import Burst, Cost, Network, Plant, ProblemError, Reference, close, design
from taciturn.loop import Loop
from taciturn.model.losses import LossLaw
from taciturn.model.steps import Received
from taciturn.program import numpy as interpreter
from taciturn.program.machine import Kernel
from taciturn.program.ops import Sent

SHARES = st.floats(0, 1)
PLANT = Plant([[0.9]], [[1.0]], [[1.0]], mean=[1.0], covariance=[[1.0]])
COST = Cost([[1.0]], [[1.0]])
PATHS, TICKS = 4000, 60


def refusal(action: Callable[[], object]) -> str:
    """Return the sentence with which an action is refused."""
    with pytest.raises(ProblemError) as found:
        action()
    return str(found.value)


@law(5, 60, to_bad=SHARES, to_good=SHARES, good=SHARES, bad=SHARES)
def test_the_stationary_losses_are_those_of_the_chain(to_bad: float, to_good: float, good: float, bad: float) -> None:
    """The share of bad steps is the fixed point of the chain, and the loss is its mean."""
    burst = Burst(to_bad, to_good, good, bad)
    share = burst.share_bad
    assert 0 <= share <= 1
    assert share * (1 - to_good) + (1 - share) * to_bad == pytest.approx(share, rel=1e-12, abs=1e-300)
    assert burst.loss == pytest.approx(good + share * (bad - good), rel=1e-12, abs=1e-15)
    assert min(good, bad) - 1e-15 <= burst.loss <= max(good, bad) + 1e-15


def test_a_link_that_never_turns_is_good() -> None:
    """Without turns there is no stationary law: it starts good and stays so."""
    assert Burst(0, 0, 0.25, 1).share_bad == 0
    assert Burst(0, 0, 0.25, 1).loss == 0.25
    assert (Burst(0.5, 0, 0, 1).loss, Burst(0, 0.5, 0.125, 1).loss, Burst(1, 1, 0, 1).loss) == (1, 0.125, 0.5)


def test_a_network_without_bursts_loses_as_much() -> None:
    """Each link keeps its stationary loss, and protocol and delay stay as they are."""
    network = Network("tcp", 0.25, 0.0, 1, sensor_burst=Burst(0.1, 0.3, 0.0, 0.8))
    assert (network.loss("actuator"), network.loss("sensor")) == (0.25, pytest.approx(0.2))
    assert (network.burst("actuator"), network.burst("sensor")) == (None, Burst(0.1, 0.3, 0.0, 0.8))
    plain = network.without_bursts()
    assert plain == Network("tcp", 0.25, network.loss("sensor"), 1)
    assert plain.without_bursts() == plain
    assert Network().without_bursts() == Network()


OUTSIDE: list[tuple[Any, str]] = [
    (-0.1, "{0} is -0.1; expected 0 ≤ {0} ≤ 1"),
    (1.5, "{0} is 1.5; expected 0 ≤ {0} ≤ 1"),
    (float("nan"), "{0} is nan; expected a finite number"),
    (float("inf"), "{0} is inf; expected a finite number"),
    (True, "{0} is True; expected a finite number"),
    ("0.1", "{0} is '0.1'; expected a finite number"),
    (None, "{0} is None; expected a finite number"),
    (1j, "{0} is 1j; expected a finite number"),
]


@pytest.mark.parametrize(("value", "sentence"), OUTSIDE, ids=lambda value: str(value)[:12])
def test_what_is_no_probability_is_refused(value: Any, sentence: str) -> None:
    """Each of the four numbers of a burst and the two of a network, in one sentence that names it."""
    usual = dict.fromkeys(("to_bad", "to_good", "loss_good", "loss_bad"), 0.5)
    for name in usual:
        assert refusal(partial(Burst, **usual | {name: value})) == sentence.format(name)
    for name in ("actuator_loss", "sensor_loss"):
        assert refusal(partial(Network, "udp", **{name: value})) == sentence.format(f"network.{name}")


BURST = Burst(0.1, 0.2, 0.0, 1.0)
TAKE = "expected protocol = 'udp' or 'tcp' for a network with packet losses"


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        (
            lambda: Network("udp", actuator_loss=0.1, actuator_burst=BURST),
            "network.actuator_loss and network.actuator_burst are both given; expected one of them",
        ),
        (
            lambda: Network("tcp", sensor_loss=0.1, sensor_burst=BURST),
            "network.sensor_loss and network.sensor_burst are both given; expected one of them",
        ),
        (lambda: Network(sensor_loss=0.1), "network.sensor_loss is given for an ideal network; " + TAKE),
        (lambda: Network(actuator_burst=BURST), "network.actuator_burst is given for an ideal network; " + TAKE),
        (lambda: Network("sctp"), "network.protocol is 'sctp'; expected 'udp', 'tcp' or 'ideal'"),
        (lambda: Network(delay=-1), "network.delay is -1; expected a whole number of at least 0"),
        (lambda: Network(delay=0.5), "network.delay is 0.5; expected a whole number of at least 0"),
        (lambda: Network(delay=True), "network.delay is True; expected a whole number of at least 0"),
    ],
)
def test_a_network_that_contradicts_itself_is_refused(action: Callable[[], object], sentence: str) -> None:
    """Loss and burst on one link, losses on an ideal network, an unknown protocol, no delay."""
    assert refusal(action) == sentence


def bursty(protocol: str = "udp", **bursts: LossLaw) -> Loop:
    """Return a loop that sends on both links at every step, designed for the same losses without memory."""
    network = Network(protocol, **bursts)
    policy = design.lossy_lqg(PLANT, COST, price=0.0, network=network)
    assert policy.network == network
    return close(PLANT, policy, network)


def lost(loop: Loop, link: str, seed: int, paths: int = PATHS, ticks: int = TICKS) -> tuple[np.ndarray, np.ndarray]:
    """Return what was sent and what of it was lost, (steps, paths)."""
    program = loop.program()
    outputs = Kernel(program).run(program, loop.start(program, paths, seed), ticks).outputs
    sent, arrived = outputs[Sent(link)] > 0, outputs[Received(link)] > 0
    assert not (arrived & ~sent).any()
    return sent, sent & ~arrived


def ratio(numerator: np.ndarray, denominator: np.ndarray) -> tuple[float, float]:
    """Return Σ numerator / Σ denominator over independent paths, with its standard error."""
    value = numerator.sum() / denominator.sum()
    spread = (numerator - value * denominator).std(ddof=1) * np.sqrt(len(numerator)) / denominator.sum()
    return float(value), float(spread)


def agrees(found: tuple[float, float], expected: float) -> bool:
    """Tell whether an estimate is within four standard errors of what is expected."""
    return bool(abs(found[0] - expected) <= 4 * found[1])


CHAINS = [Burst(0.1, 0.25, 0.0, 1.0), Burst(0.02, 0.1, 0.05, 0.7), Burst(0.9, 0.8, 0.1, 0.6)]


@pytest.mark.parametrize("link", ["actuator", "sensor"])
@pytest.mark.parametrize(
    "burst", [*CHAINS, JAMMER, FADING], ids=["all or nothing", "slow", "restless", "jammer", "own"]
)
def test_a_bursty_link_loses_as_its_chain_says(burst: LossLaw, link: str) -> None:
    """Loss frequency, from the first step on, and that of two in a row: what a chain in its stationary law does."""
    sent, gone = lost(bursty(**{f"{link}_burst": burst}), link, seed=3)
    assert sent.all()
    everywhere = np.ones(PATHS)
    assert agrees(ratio(gone.mean(axis=0), everywhere), burst.loss)
    assert agrees(ratio(gone[0].astype(float), everywhere), burst.loss)
    chance = burst.losses
    for distance in (1, 2, 5):
        again = (burst.start * chance) @ np.linalg.matrix_power(burst.turns, distance) @ chance / burst.loss
        both = (gone[distance:] & gone[:-distance]).sum(axis=0)
        assert agrees(ratio(both.astype(float), gone[:-distance].sum(axis=0)), again), distance


@pytest.mark.parametrize("link", ["actuator", "sensor"])
def test_bursts_are_as_long_as_the_link_stays_bad(link: str) -> None:
    """Where a bad link loses everything and a good one nothing, runs of losses have the mean length 1/to_good."""
    _, gone = lost(bursty(**{f"{link}_burst": CHAINS[0]}), link, seed=4)
    beginnings = (gone[1:] & ~gone[:-1]).sum(axis=0)
    assert agrees(ratio(gone[1:].sum(axis=0).astype(float), beginnings.astype(float)), 1 / CHAINS[0].to_good)


def test_a_link_turns_at_every_tick_and_not_at_every_packet() -> None:
    """With a packet every third step, losses follow one another as three steps of the chain say."""
    policy = design.periodic(PLANT, COST, every=3)
    burst = CHAINS[0]
    sent, gone = lost(close(PLANT, policy, Network("udp", actuator_burst=burst)), "actuator", seed=5, ticks=61)
    assert np.array_equal(sent, np.tile(np.arange(61)[:, None] % 3 == 0, (1, PATHS)))
    gone = gone[::3]
    again = burst.share_bad + (1 - burst.share_bad) * (1 - burst.to_bad - burst.to_good) ** 3
    assert agrees(ratio((gone[1:] & gone[:-1]).sum(axis=0).astype(float), gone[:-1].sum(axis=0).astype(float)), again)


def test_the_bursts_of_two_links_are_independent() -> None:
    """Both lost at once as often as chance says."""
    loop = bursty(actuator_burst=CHAINS[0], sensor_burst=CHAINS[1])
    program = loop.program()
    outputs = interpreter.run(program, loop.start(program, PATHS, 6), TICKS).outputs
    assert outputs[Sent("actuator")].all()
    both = (outputs[Received("actuator")] == 0) & (outputs[Received("sensor")] == 0)
    assert agrees(ratio(both.mean(axis=0), np.ones(PATHS)), CHAINS[0].loss * CHAINS[1].loss)


def test_a_burst_that_does_not_burst_is_a_constant_loss() -> None:
    """A chain with equal losses in both states, and one that never turns, lose like a link without memory."""
    for burst in (Burst(0.3, 0.4, 0.35, 0.35), Burst(0.0, 0.0, 0.35, 1.0)):
        _, gone = lost(bursty(actuator_burst=burst), "actuator", seed=7)
        assert agrees(ratio(gone.mean(axis=0), np.ones(PATHS)), 0.35)
        both = (gone[1:] & gone[:-1]).sum(axis=0).astype(float)
        assert agrees(ratio(both, gone[:-1].sum(axis=0).astype(float)), 0.35)


@pytest.mark.parametrize("number", [int, float, np.float32, np.float64], ids=lambda kind: kind.__name__)
def test_a_loss_of_zero_or_one_means_so_whatever_its_type(number: Callable[[int], Any]) -> None:
    """Nothing is lost at 0 and everything at 1, as a whole number, a float or a number of NumPy."""
    for loss in (0, 1):
        for network, link in (
            (Network("udp", number(loss)), "actuator"),
            (Network("udp", 0.0, number(loss)), "sensor"),
        ):
            policy = design.periodic(PLANT, COST, every=1)
            if link == "sensor":
                policy = design.lossy_lqg(PLANT, COST, price=0.0, network=network)
            sent, gone = lost(close(PLANT, policy, network), link, seed=12, paths=16)
            assert sent.all()
            assert (gone == bool(loss)).all(), (link, loss)


def test_a_loop_with_bursts_is_not_the_one_of_the_design() -> None:
    """The design knows mean losses only: its theory does not hold, and the loop says why."""
    loop = bursty(actuator_burst=CHAINS[0])
    assert not loop.nominal
    assert loop.violated_assumptions == ("losses come in bursts, but the design uses only their mean",)
    assert loop.departures == loop.violated_assumptions  # the former name
    assert "excess" not in loop.program().sums
    assert close(PLANT, loop.policy, loop.network.without_bursts()).nominal
    other = close(PLANT, loop.policy, Network("udp", actuator_loss=0.5))
    assert other.violated_assumptions == ("the network is not the one of the design",)


def test_links_start_as_the_stationary_law_says_on_the_same_paths() -> None:
    """The first state of a path depends on seed and path alone, and its share of bad ones is the stationary share."""
    loop = bursty(actuator_burst=CHAINS[1], sensor_burst=CHAINS[2])
    program = loop.program()
    rows = [i for i, state in enumerate(program.states) if state.name.startswith("state of the ")]
    assert len(rows) == 2
    start = loop.start(program, 20_000, 8)
    assert same(start, loop.start(program, 20_000, 8))
    assert set(np.unique(start[rows])) == {0.0, 1.0}
    for row, burst in zip(rows, (CHAINS[1], CHAINS[2]), strict=True):
        link = program.states[row].name.split()[3]
        expected = {"actuator": CHAINS[1], "sensor": CHAINS[2]}[link].share_bad
        assert agrees(ratio(start[row], np.ones(20_000)), expected), (link, burst)


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("protocol", ["udp", "tcp"])
def test_the_builds_agree_bit_for_bit_on_bursts_and_a_reference(protocol: str, delay: int) -> None:
    """Bursts on both links, gains by the clock, a reference: NumPy and LLVM have the same bits."""
    draws = np.random.default_rng(9)
    A, B = np.array([[1.0, 0.1], [0.0, 1.1]]), np.array([[0.0, 0.1], [0.2, 0.0]])
    inputs, states = draws.normal(size=(40, 2)), [np.array([1.0, -1.0])]
    for push in inputs:
        states.append(A @ states[-1] + B @ push)
    plant = Plant(A, B, 0.1 * np.eye(2), mean=states[0], covariance=0.2 * np.eye(2))
    cost = Cost(np.eye(2), np.eye(2), horizon=40)
    network = Network(protocol, delay=delay, actuator_burst=CHAINS[1], sensor_burst=CHAINS[2])
    policy = design.lossy_lqg(plant, cost, price=0.5, network=network, reference=Reference(states, inputs))
    loop = close(plant, policy, network)
    program = loop.program()
    assert_parity(loop, program, seed=10, paths=37)
    first = loop.start(program, 16, 11)
    again = [Kernel(program, "parity").run(program, first, 40, threads=threads) for threads in (1, 2)]
    assert differences(*again) == []
    assert 0.05 < again[0].outputs[Sent("actuator")].mean() < 0.95


def test_a_design_for_bursts_is_closed_with_its_bursts() -> None:
    """Without a network the loop has the one that was given to the design; its mean losses alone would be nominal."""
    plant, cost = Plant([[1.1]], [[1.0]], [[0.01]]), Cost([[1.0]], [[1.0]])
    network = Network("udp", actuator_burst=Burst(0.05, 0.15, 0.0, 0.9))
    policy = design.lossy_lqg(plant, cost, price=0.1, network=network)
    bursty = close(plant, policy)
    assert bursty.network == network
    assert not bursty.nominal
    assert close(plant, policy, network.without_bursts()).nominal


def test_a_burst_whose_other_state_is_never_reached_is_a_constant_loss() -> None:
    """It starts in the state that it never leaves; outages are those of this state."""
    good = Network("tcp", actuator_burst=Burst(0.0, 0.2, 0.1, 1.0))
    bad = Network("tcp", actuator_burst=Burst(0.2, 0.0, 0.0, 0.4))
    turning = Network("tcp", actuator_burst=Burst(0.2, 0.2, 0.0, 0.4))
    assert (good.burst("actuator"), good.loss("actuator"), good.outage("actuator")) == (None, 0.1, 0.1)
    assert (bad.burst("actuator"), bad.loss("actuator"), bad.outage("actuator")) == (None, 0.4, 0.4)
    assert turning.burst("actuator") is not None
