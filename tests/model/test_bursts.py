"""Laws of bursty losses: any chain behaves alike in loops, nodes, relays and analyses, and one file adds a law."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from counts import few
from drawn import law
from hypothesis import strategies as st
from model.fading import FADING, JAMMER
from parity.loops import assert_parity

import taciturn
from taciturn import Burst, Cost, Nodes, Plant, ProblemError, close, design
from taciturn.analyse.switched import outcomes
from taciturn.model import losses
from taciturn.model.link import LinkLaw
from taciturn.model.losses import Chain, LossLaw, law_text, read_law
from taciturn.model.network import Network
from taciturn.simulation.average import plain_average
from taciturn_udp.relay import Fate

PLANT = Plant([[0.9, 0.1], [0.0, 0.7]], [[0.0], [1.0]], np.diag([0.1, 0.2]), mean=[1.0, 0.0])
COST = Cost(np.diag([1.0, 0.5]), [[3.0]])
SHARES = st.floats(0.01, 0.99)


@law(5, 40, to_bad=SHARES, to_good=SHARES, good=SHARES, bad=SHARES, seed=st.integers(0, 99))
def test_a_chain_of_two_states_is_a_burst(to_bad: float, to_good: float, good: float, bad: float, seed: int) -> None:
    """The same losses of a relay and of a loop, bit for bit, and the same mean."""
    burst = Burst(to_bad, to_good, good, bad)
    chain = Chain((good, bad), ((1 - to_bad, to_bad), (to_good, 1 - to_good)))
    assert chain.loss == pytest.approx(burst.loss, rel=1e-12)
    assert read_law("burst", law_text(chain)) == chain
    assert read_law("burst", law_text(burst)) == burst
    fates = [Fate(seed, burst=one) for one in (burst, chain)]
    assert [[fate.lost(k, k) for k in range(60)] for fate in fates[:1]] == [[fates[1].lost(k, k) for k in range(60)]]


@pytest.mark.parametrize("burst", few([JAMMER, FADING, Burst(0.1, 0.3, 0.05, 0.8)], 1))
def test_a_relay_loses_as_the_chain_says_in_any_order(burst: LossLaw) -> None:
    """Frequencies of losses and of two losses at a distance; a packet that is asked about later has the same fate."""
    ticks, seeds, distance = 120, 200, 2
    gone = np.array([[Fate(seed, burst=burst).lost(k, k) for k in range(ticks)] for seed in range(2)])
    fate = Fate(1, burst=burst)
    assert [fate.lost(k, k) for k in reversed(range(ticks))] == gone[1, ::-1].tolist()
    gone = np.array([[fate.lost(k, k) for k in range(30)] for fate in (Fate(s, burst=burst) for s in range(seeds))])
    both = (burst.start * burst.losses) @ np.linalg.matrix_power(burst.turns, distance) @ burst.losses
    for found, expected in ((gone.mean(axis=1), burst.loss), ((gone[:, 2:] & gone[:, :-2]).mean(axis=1), both)):
        assert abs(found.mean() - expected) <= 4 * found.std(ddof=1) / np.sqrt(seeds) + 1e-12


@pytest.mark.parametrize("burst", [JAMMER, FADING], ids=["jammer", "own"])
def test_any_chain_in_loops_nodes_and_exact_analyses(burst: LossLaw) -> None:
    """The interpreters agree bit for bit; the exact cost of every sample is the simulated one, and nodes lose alike."""
    network = Network("tcp", actuator_burst=burst)
    policy = design.excess(PLANT, COST, theta=0.1, network=network)
    loop = close(PLANT, policy)
    assert_parity(loop, loop.program(), 3)
    every = close(PLANT, design.all_time(PLANT, COST), network)
    simulated = taciturn.average(every, plain_average(every), steps=2_000_000, seed=3).cost
    assert abs(simulated.value - policy.cost_all_time) <= 4 * simulated.standard_error
    found = outcomes(every)
    assert found is not None
    assert found.growth(2) < 1
    nodes = Nodes(every.policy, network, seed=4)
    arrived: list[bool] = []
    for _ in range(60):
        nodes.step(np.ones(PLANT.outputs))
        arrived.append(nodes.arrived["actuator"])
    assert 0 < sum(arrived) < 60
    if burst is JAMMER:
        assert any(not any(arrived[phase::3]) for phase in range(3))


@law(3, 12, theta=st.floats(0.05, 2.0), seed=st.integers(0, 1000))
def test_silence_is_priced_by_the_belief_about_any_chain(theta: float, seed: int) -> None:
    """The identity holds over chains with two to four states, also periodic ones; the cost is below its bound."""
    for burst in (JAMMER, FADING, Burst(1.0, 1.0, 0.0, 1.0)):
        policy = design.excess(PLANT, COST, theta=theta, network=Network("tcp", actuator_burst=burst))
        loop = close(PLANT, policy)
        exact = taciturn.average(loop, steps=300_000, seed=seed)
        plain = taciturn.average(loop, plain_average(loop), steps=300_000, seed=seed)
        error = np.hypot(exact.cost.standard_error, plain.cost.standard_error)
        assert abs(exact.cost.value - plain.cost.value) <= 4.5 * error
        assert exact.cost.value <= policy.guarantee.at_rate(exact.rates["actuator"].value) + 4 * error


LINK = """
[plant]
A = [[0.9]]
B = [[1.0]]
W = [[1.0]]
[cost]
Q = [[1.0]]
R = [[1.0]]
[policy]
kind = "excess"
theta = 0.1
[network]
protocol = "tcp"
actuator_burst = {}
"""


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register a law of another package."""
    entry = EntryPoint("fading", "model.fading:LAW", losses.GROUP)
    monkeypatch.setattr(losses, "find_plugins", lambda group: {"fading": (entry,)} if group == losses.GROUP else {})


@pytest.mark.usefixtures("registered")
def test_a_problem_file_names_a_law(tmp_path: Path) -> None:
    """Also that of another package; the relays of a network run get it as one option."""
    path = tmp_path / "problem.toml"
    for table, expected in (
        ('{law = "fading", levels = 4, speed = 0.5}', FADING),
        ('{law = "chain", drops = [1, 0, 0.2], moves = [[0, 1, 0], [0, 0, 1], [1, 0, 0]]}', JAMMER),
        ("{to_bad = 0.1, to_good = 0.2, loss_good = 0, loss_bad = 1}", Burst(0.1, 0.2, 0.0, 1.0)),
    ):
        path.write_text(LINK.format(table).replace("= 0,", "= 0.0,").replace("[1, 0, 0.2]", "[1.0, 0.0, 0.2]"))
        problem = taciturn.load(path)
        assert problem.network.burst("actuator") == expected
        found = problem.network.burst("actuator")
        assert found is not None
        assert read_law("burst", law_text(found)) == expected


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ("{law = 3}", "network.actuator_burst.law is 3; expected the name of a law in quotes"),
        (
            '{law = "fadin"}',
            "network.actuator_burst.law is 'fadin'; expected one of the loss laws chain, gilbert-elliott",
        ),
        ('{law = "chain", drops = [0.5]}', "the key network.actuator_burst.moves is missing"),
        ("{to_bad = 1.5, to_good = 0.1, loss_good = 0.0, loss_bad = 1.0}", "network.actuator_burst: to_bad is 1.5"),
        (
            '{law = "chain", drops = [0.5, 1.0], moves = [[0.5, 0.4], [0.0, 1.0]]}',
            "network.actuator_burst: Chain has the transition probabilities [[0.5, 0.4], [0.0, 1.0]]; expected rows",
        ),
        (
            '{law = "chain", drops = [0.5, 0.9], moves = [[1.0, 0.0], [0.0, 1.0]]}',
            "network.actuator_burst: Chain has several groups of states that the link never leaves",
        ),
        ('{law = "chain", drops = [0.5, 0.5], moves = [[1.0]]}', "network.actuator_burst: Chain has transition"),
        (
            '{law = "chain", drops = [0.5, 0.5], moves = [[1.0], [0.5, 0.5]]}',
            "network.actuator_burst: the rows of 'moves' have",
        ),
    ],
)
def test_mistakes_in_a_law_are_located(tmp_path: Path, table: str, sentence: str) -> None:
    """One sentence, with the key."""
    path = tmp_path / "problem.toml"
    path.write_text(LINK.format(table))
    with pytest.raises(ProblemError) as found:
        taciturn.load(path)
    assert sentence in str(found.value)


def test_a_law_without_a_name_stays_in_this_process() -> None:
    """Processes of a network run cannot find the class; a law that is none is refused at once."""
    with pytest.raises(ProblemError, match="losses follow the law Fading, which other processes cannot find"):
        law_text(FADING)
    with pytest.raises(ProblemError, match=r"burst is 0\.5"):
        LinkLaw(burst=0.5)  # type: ignore[arg-type]
    for text in ("chain:0.5", "0.5,0.5", "chain:[0.5],[[1.0]", "x:1"):
        with pytest.raises(ProblemError, match="expected"):
            read_law("burst", text)


OF_THE_FORM = "a text of the form "


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("rayleigh", f"{OF_THE_FORM}chain:drops,moves or gilbert-elliott:to_bad,to_good,loss_good,loss_bad, with a "),
        ("valve=chain", f"{OF_THE_FORM}chain:drops,moves or gilbert-elliott:"),
        ("foo:1,2", f"{OF_THE_FORM}chain:drops,moves or gilbert-elliott:"),
        ("chain:1", f"{OF_THE_FORM}chain:drops,moves, with a number"),
        ("chain:[0.5,2],[[0,1],[1,0]]", "0 ≤ drops ≤ 1"),
    ],
)
def test_a_mistake_in_a_law_names_the_laws_or_the_form_of_the_stated_law(text: str, expected: str) -> None:
    """And no example of another law."""
    with pytest.raises(ProblemError) as found:
        read_law("--burst", text)
    assert str(found.value).startswith(f"--burst is {text!r}; ")
    assert f"; expected {expected}" in str(found.value)
