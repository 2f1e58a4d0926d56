"""Laws of delay: every form of a problem file, the losses of a buffer, and one sentence for each mistake."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from runtime.late import sets

from taciturn import Burst, ProblemError, average
from taciturn.model.delay import DelayLaw, Wait, delay_from, wait_from
from taciturn.model.link import IDEAL_LINK, LinkLaw
from taciturn.model.losses import Chain
from taciturn.model.network import Network, NodeRole
from taciturn.model.transport import Transport
from taciturn.problem import load, parse
from taciturn.problem.write import tables_text

BURSTS = Burst(0.1, 0.4, 0.01, 0.5)
FORM = "expected a whole number of steps, a list of probabilities of 0, 1, 2, … steps, or a table such as"
NODES = {
    "level-1": {"measures": [0]}, "level-2": {"measures": [1]}, "plc": {"controls": True}, "pump": {"applies": True},
}  # fmt: skip
TABLES: dict[str, Any] = {
    "plant": {
        "A": [[0.9, 0.1], [0.0, 0.8]], "B": [[0.0], [1.0]], "W": [[1.0, 0.0], [0.0, 1.0]], "dt": 0.1,
        "C": [[1.0, 0.0], [0.0, 1.0]], "V": [[0.1, 0.0], [0.0, 0.1]],
    },
    "cost": {"Q": [[1.0, 0.0], [0.0, 1.0]], "R": [[1.0]]},
    "policy": {"kind": "distributed", "theta": 0.1},
    "nodes": NODES,
}  # fmt: skip
ONE_SENSOR: dict[str, Any] = {
    "policy": {"kind": "lqg", "theta": 0.1},
    "nodes": {"level": {"measures": True, "site": "plc"}, "plc": {"controls": True}, "pump": {"applies": True}},
}
CONTINUOUS = {
    **TABLES,
    "plant": {key: value for key, value in TABLES["plant"].items() if key != "dt"}
    | {"A": [[-0.5, 0.1], [0.0, -0.2]], "W": [[0.1, 0.0], [0.0, 0.1]]},
    "policy": {"kind": "distributed", "theta": 0.1, "period": 0.01},
}


@pytest.fixture
def file(tmp_path: Path) -> Any:
    """Return the function that writes a file of delays and returns its path."""

    def write(content: str | bytes, name: str = "delays.csv") -> str:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return str(path)

    return write


@pytest.mark.parametrize(
    ("given", "waits", "odds", "seconds"),
    [
        (2, (2.0,), ((1.0,),), False),
        (2.0, (2.0,), ((1.0,),), False),
        (np.int64(2), (2.0,), ((1.0,),), False),
        (1000, (1000.0,), ((1.0,),), False),
        ([0.7, 0.2, 0.1], (0.0, 1.0, 2.0), ((0.7, 0.2, 0.1),), False),
        ((0.7, 0.0, 0.1), (0.0, 2.0), ((0.7, 0.1),), False),
        (np.array([0.5, 0.5]), (0.0, 1.0), ((0.5, 0.5),), False),
        ([0.0, 1.0], (1.0,), ((1.0,),), False),
        ([0.1] * 10, tuple(map(float, range(10))), ((0.1,) * 10,), False),  # whose sum is not 1 in doubles
        ({"seconds": 0.004}, (0.004,), ((1.0,),), True),
        ({"seconds": [0.004, 0.001], "probability": [0.2, 0.7]}, (0.001, 0.004), ((0.7, 0.2),), True),
        ({"seconds": [0.001, 0.001], "probability": [0.2, 0.7]}, (0.001,), ((0.2 + 0.7,),), True),
        ({"states": [0, [0.0, 0.5, 0.5]]}, (0.0, 1.0, 2.0), ((1.0, 0.0, 0.0), (0.0, 0.5, 0.5)), False),
        ({"states": [{"seconds": 0.1}, {"seconds": 0.2}]}, (0.1, 0.2), ((1.0, 0.0), (0.0, 1.0)), True),
    ],
)
def test_every_form_of_a_law(given: Any, waits: tuple[float, ...], odds: Any, seconds: bool) -> None:
    """Delays increase, delays that never occur are left out, and equal ones are added."""
    law = delay_from("delay", given)
    assert (law.waits, law.in_seconds, law.sequence) == (waits, seconds, ())
    assert law.odds == pytest.approx(np.array(odds), abs=1e-15)
    assert delay_from("delay", law) is law


@pytest.mark.parametrize("given", [0, [1.0], {"seconds": 0}, {"seconds": [0.0], "probability": [1.0]}, None])
def test_a_delay_of_0_is_none(given: Any) -> None:
    """So it changes no network, and no digest of a problem."""
    assert LinkLaw(delay=given) == IDEAL_LINK
    assert LinkLaw(buffer=0) == IDEAL_LINK


@pytest.mark.parametrize(
    "content",
    [
        "1,0.5\n2,0.3\n",
        "milliseconds,probability\n1,0.5\n2,0.3\n",
        b"\xef\xbb\xbfMilliseconds, Probability\r\n1,0.5\r\n2,0.3\r\n",
        b"\xef\xbb\xbf1,0.5\r2,0.3\r",
        "# of a cell\n\n2,0.3\n , \n1,0.25\n1,0.25\n",
        "probability,site,milliseconds\n0.3,a,2\n0.5,b,1\n",
        "latency,share\n1,0.5\n2,0.3\n",
    ],
)
def test_a_histogram_is_read(file: Any, content: str | bytes) -> None:
    """With or without a header, a byte-order mark, and rows in any order."""
    law = delay_from("delay", {"histogram": file(content)})
    assert (law.waits, law.odds, law.in_seconds) == ((0.001, 0.002), ((0.5, 0.3),), True)
    assert law.text() == "random, 1 ms to 2 ms, mean 1.375 ms, 20 % lost"


@pytest.mark.parametrize(
    "content",
    [
        "0,0.01\n1,\n2,0.02\n3,0.01\n",
        "sent,delay\n0,0.01\n1,\n2,0.02\n3,0.01\n",
        "delay,sent\n0.01,3\n,1\n0.02,2\n0.01,0\n",
        b"\xef\xbb\xbfsent,delay\r\n3,0.01\r\n1,\r\n2,0.02\r\n0,0.01\r\n",
    ],
)
def test_a_trace_is_read_in_the_order_of_sending(file: Any, content: str | bytes) -> None:
    """An empty delay is that of a lost packet."""
    law = delay_from("delay", {"trace": file(content)})
    assert (law.waits, law.odds, law.sequence) == ((0.01, 0.02), ((0.5, 0.25),), (0, 2, 1, 0))
    assert law.text() == "measured, 10 ms to 20 ms, mean 13.33 ms, 25 % lost"
    assert law.mean_by() == pytest.approx(0.04 / 3)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (-1, f"delay is -1; {FORM}"),
        (1.5, f"delay is 1.5; {FORM}"),
        (math.nan, f"delay is nan; {FORM}"),
        (-math.inf, f"delay is -inf; {FORM}"),
        (True, f"delay is True; {FORM}"),
        ("2", f"delay is '2'; {FORM}"),
        ({}, f"delay has no keys; {FORM}"),
        ({"probability": [1.0]}, f"delay has the key probability; {FORM}"),
        ({"seconds": 0.1, "trace": "x"}, f"delay has the keys seconds and trace; {FORM}"),
        (1001, "delay is 1001 steps; expected at most 1000"),
        (10**400, "steps; expected at most 1000"),
        ([], "delay has probabilities with the sum 0; expected a sum above 0 and at most 1"),
        ([0.0, 0.0], "delay has probabilities with the sum 0; expected a sum above 0 and at most 1"),
        ([0.5, 0.6], "delay has probabilities with the sum 1.1; expected a sum above 0 and at most 1: divide each"),
        ([0.5, -0.1], r"delay\[1\] is -0.1; expected 0 ≤ delay\[1\] ≤ 1"),
        ([math.nan], r"delay\[0\] is nan; expected a finite number"),
        ([0.5, "x"], r"delay\[1\] is 'x'; expected a finite number"),
        ([True], r"delay\[0\] is True; expected a finite number"),
        ([[0.5], [0.5]], r"delay\[0\] is \[0.5\]; expected a finite number"),
        ({"second": 0.1}, "delay.second is not a known key; expected one of seconds, probability, histogram, trace"),
        ({"seconds": -0.1}, "delay.seconds is -0.1; expected 0 ≤ delay.seconds"),
        ({"seconds": math.inf}, "delay.seconds is inf; expected a finite number"),
        ({"seconds": True}, "delay.seconds is True; expected a finite number"),
        ({"seconds": "0.1"}, "delay.seconds is '0.1'; expected a finite number"),
        ({"seconds": [0.1, 0.2]}, "delay.seconds is a list, and delay.probability is missing; expected a list"),
        ({"seconds": [], "probability": []}, r"and delay.probability is \[\]; expected a list of as many"),
        ({"seconds": [0.1], "probability": 1.0}, "and delay.probability is 1.0; expected a list of as many"),
        ({"seconds": [0.1, 0.2], "probability": [1]}, "has 2 delays, and delay.probability has 1 entry; expected a"),
        ({"seconds": [-0.1], "probability": [1]}, "delay.seconds is -0.1; expected 0 ≤ delay.seconds"),
        ({"seconds": [0.1], "probability": [-1]}, "delay.probability is -1; expected 0 ≤ delay.probability ≤ 1"),
        ({"seconds": 0.1, "probability": [1]}, "delay.probability is given without a list of delays; expected delay.s"),
        ({"trace": 3}, "delay.trace is 3; expected the name of a file in quotes"),
        ({"states": 1}, "delay.states is 1; expected a list with a law for each state of the bursts"),
        ({"states": [1]}, r"delay.states is \[1\]; expected a list with a law for each state of the bursts"),
        ({"states": [1, -1]}, rf"delay.states\[1\] is -1; {FORM}"),
        ({"states": [1, {"seconds": 0.1}]}, "delay.states has laws in seconds and in steps; expected the same unit"),
        ({"states": [{"states": [1, 2]}, 1]}, r"delay.states\[0\] has states or a trace of its own; expected a law"),
        ({"states": [1, 2]}, "delay.states has 2 laws, and the link has no burst; expected a burst with as many"),
    ],
)
def test_a_wrong_law_is_one_sentence(given: Any, words: str) -> None:
    """With the value, the form that is expected, and no line break."""
    with pytest.raises(ProblemError, match=words) as raised:
        LinkLaw(delay=given)
    assert "\n" not in str(raised.value)
    with pytest.raises(ProblemError, match=words) as stated:
        parse({**TABLES, "links": {"pump": {"delay": given}}}, "tank.toml")
    assert str(stated.value).startswith("tank.toml: links.pump.delay")


@pytest.mark.parametrize(
    ("form", "content", "words"),
    [
        ("histogram", "", "it has no rows of numbers"),
        ("histogram", "milliseconds,probability\n", "it has no rows of numbers"),
        ("histogram", "1;0.5\n2;0.5\n", "line 1 is '1;0.5'"),
        ("histogram", "1,5;0,5\n2,5;0,5\n", "column 2 of line 1 is '5;0', which is not a finite number"),
        ("histogram", '"1,5","0,5"\n', "it has no rows of numbers"),
        ("histogram", "1\t0.5\n", r"line 1 is '1\\t0.5'"),
        ("histogram", "sent,delay\n1,0.5\n", "line 1 is 'sent,delay'"),
        ("histogram", "milliseconds,share\n1,0.5\n", "line 1 is 'milliseconds,share'"),
        ("histogram", "1,0.5\n2,\n", "column 2 of line 2 is '', which is not a finite number"),
        ("histogram", "1\n2\n", "column 2 of line 1 is '', which is not a finite number"),
        ("histogram", "1,nan\n", "column 2 of line 1 is 'nan', which is not a finite number"),
        ("histogram", "inf,1\n", "column 1 of line 1 is 'inf', which is not a finite number"),
        ("histogram", bytes(range(256)), "it is not UTF-8 text: invalid start byte"),
        ("histogram", "1,0.5\n".encode("utf-16"), "it is not UTF-8 text: invalid start byte"),
        ("histogram", '"' + "x" * 200_000 + '",1\n', "field larger than field limit"),
        ("trace", b"\0\1\2", "line 1 is"),
        ("trace", b"0,1\n" * (2**22 + 1), "it has more than 16,777,216 bytes"),
        ("trace", "0,1\n" * 100_001, "it has more than 100,000 rows"),
        ("trace", "0,lost\n", "column 2 of line 1 is 'lost', which is not a finite number"),
        ("trace", "0,inf\n", "column 2 of line 1 is 'inf', which is not a finite number"),
        ("trace", "0\n1\n", "column 2 of line 1 is '', which is not a finite number"),
        ("trace", ",0.1\n", "column 1 of line 1 is '', which is not a finite number"),
        ("trace", "milliseconds,probability\n1,0.5\n", "line 1 is 'milliseconds,probability'"),
        ("trace", "2026-01-01,0.1\n", "column 1 of line 1 is '2026-01-01', which is not a finite number"),
    ],
)
def test_a_file_that_is_no_file_of_delays_is_one_sentence(file: Any, form: str, content: Any, words: str) -> None:
    """With the line and the columns that are expected."""
    header = "milliseconds and probability" if form == "histogram" else "sent and delay"
    path = file(content)
    with pytest.raises(ProblemError, match=words) as raised:
        LinkLaw(delay={form: path})
    told = str(raised.value)
    assert told.startswith(f"delay.{form} {path!r} cannot be read (")
    assert f"expected the columns {header}, separated by commas" in told
    assert len(told) < 400
    assert "\n" not in told


@pytest.mark.parametrize(
    ("form", "content", "words"),
    [
        ("histogram", "-1,1\n", "has the delay -1 ms; expected delays of at least 0"),
        ("histogram", "1,-0.5\n", "has the probability -0.5; expected probabilities from 0 to 1"),
        ("histogram", "1,50\n2,50\n", "has the probability 50; expected probabilities from 0 to 1"),
        (
            "histogram",
            "1,0.5\n2,0.6\n",
            "has probabilities with the sum 1.1; expected a sum above 0 and at most 1: div",
        ),
        ("histogram", "1,0\n", "has probabilities with the sum 0; expected a sum above 0"),
        ("trace", "0,\n1,\n", "has no packet that arrived; expected a delay in at least one row"),
        ("trace", "0,0.1\n1,-0.1\n", "has the delay -0.1 s; expected delays of at least 0: correct the offset"),
    ],
)
def test_numbers_of_a_file_that_are_no_law_are_one_sentence(file: Any, form: str, content: str, words: str) -> None:
    """In the units of the file, with its name."""
    path = file(content)
    with pytest.raises(ProblemError, match=words) as raised:
        LinkLaw(delay={form: path})
    assert str(raised.value).startswith(f"delay.{form} {path!r} has ")


def test_what_is_no_regular_file_is_refused(tmp_path: Path) -> None:
    """A missing file, a folder, a pipe, an empty name and one with a null character; none of them blocks."""
    os.mkfifo(tmp_path / "pipe")
    named = {
        "missing.csv": "No such file or directory", str(tmp_path): "it is not a regular file",
        str(tmp_path / "pipe"): "it is not a regular file", "": "it is not a regular file", "a\0b": "null",
    }  # fmt: skip
    for path, words in named.items():
        for form in ("histogram", "trace"):
            with pytest.raises(ProblemError, match=rf"^delay\.{form} .* cannot be read \(.*{words}.*\); expected the"):
                LinkLaw(delay={form: path})


@pytest.mark.parametrize(
    ("delay", "buffer", "words"),
    [
        (None, -1, "buffer is -1; expected a whole number of steps, or a table {seconds = x}"),
        (None, 1.5, "buffer is 1.5; expected a whole number of steps, or a table {seconds = x}"),
        (None, math.nan, "buffer is nan; expected a whole number of steps"),
        (None, True, "buffer is True; expected a whole number of steps"),
        (None, "2", "buffer is '2'; expected a whole number of steps"),
        (None, [2], r"buffer is \[2\]; expected a whole number of steps"),
        (None, {}, r"buffer is {}; expected a whole number of steps"),
        (None, {"second": 1}, r"buffer is {'second': 1}; expected a whole number of steps"),
        (None, {"seconds": -1}, "buffer.seconds is -1; expected 0 ≤ buffer.seconds"),
        (None, {"seconds": math.nan}, "buffer.seconds is nan; expected a finite number"),
        (None, 1001, "buffer is 1001 steps; expected at most 1000"),
        (2, 1, "buffer is 1 step, and the least delay is 2 steps, so every packet is late; expected a larger buffer"),
        ([0, 0, 1], 1, "buffer is 1 step, and the least delay is 2 steps, so every packet is late"),
        (
            {"seconds": 0.1},
            {"seconds": 0.05},
            "buffer is 50 ms, and the least delay is 100 ms, so every packet is late",
        ),
        (2, 0, "buffer is 0, and packets are delayed; expected a buffer above 0, or no buffer"),
        ({"seconds": 0.1}, {"seconds": 0}, "buffer is 0, and packets are delayed; expected a buffer above 0"),
        ([0.5, 0.5], {"seconds": 0.1}, "buffer is 100 ms, and delay is random, 0 to 1 step, mean 0.5 steps; expected"),
        ({"seconds": 0.1}, 2, "buffer is 2 steps, and delay is 100 ms; expected both in steps or both in seconds"),
    ],
)
def test_a_wrong_buffer_is_one_sentence(delay: Any, buffer: Any, words: str) -> None:
    """Also in the words of the file, for a link of its own and for the usual ones."""
    with pytest.raises(ProblemError, match=words):
        LinkLaw(delay=delay, buffer=buffer)
    given = {key: value for key, value in (("delay", delay), ("buffer", buffer)) if value is not None}
    with pytest.raises(ProblemError, match=rf"^tank\.toml: links\.pump\.{words}"):
        parse({**TABLES, "links": {"pump": given}}, "tank.toml")
    usual = {name: table for name, table in TABLES.items() if name != "nodes"}
    with pytest.raises(ProblemError, match=rf"^tank\.toml: network\.actuator_{words}"):
        parse({**usual, "network": {f"actuator_{key}": value for key, value in given.items()}}, "tank.toml")


def test_a_number_of_states_that_differs_from_that_of_the_bursts_is_refused() -> None:
    """A law for each state of the burst, or one law for all of them."""
    with pytest.raises(ProblemError, match="has 3 laws, and the link has a burst with 2 states; expected a burst with"):
        LinkLaw(burst=BURSTS, delay={"states": [1, 2, 3]})
    assert LinkLaw(burst=BURSTS, delay={"states": [1, 2]}).delay == DelayLaw((1.0, 2.0), ((1.0, 0.0), (0.0, 1.0)))
    assert LinkLaw(burst=BURSTS, delay=2).wait == Wait(2)


def test_waits_in_periods_add_up() -> None:
    """Whole periods stay whole, although 0.3 is no multiple of 0.1 in doubles."""
    assert Wait(0, 0.3).periods(0.1) == 3.0
    assert Wait(2, 0.05).periods(0.1) == pytest.approx(2.5)
    assert Wait(2, 0.05).after(Wait(1, 0.01)) == (3, pytest.approx(0.06))
    assert [Wait().text(), Wait(2).text(), Wait(1, 0.004).text()] == ["0", "2 steps", "1 step and 4 ms"]
    assert (wait_from("buffer", {"seconds": 0.01}), wait_from("buffer", 3)) == (Wait(0, 0.01), Wait(3))


@pytest.mark.parametrize("loss", [0.0, 0.25])
def test_a_packet_that_is_later_than_the_buffer_is_lost(loss: float) -> None:
    """Next to the losses of the link and those of the law: a packet arrives in time if nothing of this happens."""
    link = LinkLaw(loss=loss, delay=[0.5, 0.3, 0.1], buffer=1)
    played = link.played()
    assert played.loss == pytest.approx(1 - (1 - loss) * (0.5 + 0.3))
    assert (played.delay, played.buffer, played.acknowledged, link.wait) == (None, None, False, Wait(1))
    assert link.late == pytest.approx(0.2)
    assert LinkLaw(loss=loss, delay=[0.5, 0.3, 0.1], buffer=2).played().loss == pytest.approx(1 - (1 - loss) * 0.9)
    whole = LinkLaw(loss=loss, delay=[0.5, 0.5], buffer=1)
    assert whole.played() == LinkLaw(loss=loss, acknowledged=False if loss else None)
    assert LinkLaw(loss=loss, delay=2).played() == LinkLaw(loss=loss, buffer=3).played() == LinkLaw(loss=loss)
    varying = LinkLaw(loss=loss, delay=[0.5, 0.5])
    assert varying.played() is varying


@pytest.mark.parametrize("delay", [[0.6, 0.3, 0.1], {"states": [0, [0.2, 0.3, 0.5]]}])
def test_bursts_and_late_packets_are_lost_by_the_state_of_the_link(delay: Any) -> None:
    """The share of lost packets is that of packets that are drawn one by one."""
    link = LinkLaw(burst=BURSTS, delay=delay, buffer=1)
    played = link.played().burst
    assert isinstance(played, Chain)
    late = (0.1, 0.1) if isinstance(delay, list) else (0.0, 0.5)
    assert played.losses == pytest.approx([1 - 0.99 * (1 - late[0]), 1 - 0.5 * (1 - late[1])])
    assert np.array_equal(played.turns, BURSTS.turns)
    draws, many = np.random.default_rng(1), 100_000
    state, gone = 0, np.zeros(many)
    for k, (move, lost, delayed) in enumerate(draws.random((many, 3))):
        state = int(move < BURSTS.turns[state, 1])
        gone[k] = lost < BURSTS.losses[state] or delayed < late[state]
    spread = gone.reshape(100, -1).mean(axis=1).std() / 10  # of means of blocks, since losses come in bursts
    assert gone.mean() == pytest.approx(played.loss, abs=5 * spread)
    assert LinkLaw(burst=BURSTS, delay=delay, buffer=2).played().burst == BURSTS


def test_lost_and_late_packets_of_a_trace_come_in_bursts_as_in_the_trace(file: Any) -> None:
    """The chain has the share of gone packets, and the probability that one follows another."""
    draws = np.random.default_rng(2)
    state, rows, gone = 0, list[str](), list[bool]()
    for k in range(20_000):
        state = int(draws.random() < (0.7 if state else 0.05))
        late = state and draws.random() < 0.5
        rows.append(f"{k},{'' if state and not late else 0.02 if late else 0.001}")
        gone.append(bool(state))
    link = LinkLaw(delay={"trace": file("\n".join(rows))}, buffer={"seconds": 0.01})
    burst = link.played().burst
    assert isinstance(burst, Burst)
    after = [one for before, one in pairwise(gone) if before]
    assert 1 - burst.to_good == pytest.approx(np.mean(after))
    assert burst.loss == pytest.approx(np.mean(gone), abs=2 / len(gone))  # its ends are no transitions
    assert (burst.loss_good, burst.loss_bad) == (0.0, 1.0)
    own = LinkLaw(loss=0.2, delay=link.delay, buffer={"seconds": 0.01}).played()
    assert own.mean_loss == pytest.approx(1 - 0.8 * (1 - burst.loss))
    assert link.late == pytest.approx(np.mean(gone))
    for listed, loss in (("0,0.001\n1,\n", 0.5), ("0,\n1,0.001\n", 0.5), ("0,0.001\n1,\n2,0.001\n3,\n", 0.5)):
        short = LinkLaw(delay={"trace": file(listed)}, buffer={"seconds": 0.01}).played()
        assert short.mean_loss == pytest.approx(loss), listed
    in_turn = LinkLaw(delay={"trace": file("0,0.001\n1,\n2,0.001\n3,\n")}, buffer={"seconds": 0.01}).played()
    assert in_turn.burst == Burst(1.0, 1.0, 0.0, 1.0)


def test_the_mean_is_that_of_the_states_of_the_link() -> None:
    """A state counts by its share of the steps."""
    link = LinkLaw(burst=BURSTS, delay={"states": [1, 3]})
    assert link.delay is not None
    assert link.delay.mean_by(link.states) == pytest.approx(1 * 0.8 + 3 * 0.2)
    assert link.lateness() == ("delay by the state of the link, 1 step to 3 steps, mean 1.4 steps",)
    buffered = replace(link, buffer=2)
    assert buffered.late == pytest.approx(0.2)
    assert buffered.lateness()[1] == "a packet is used 2 steps after it was sent, 20 % never arrive or arrive later"
    assert buffered.spending() == "; " + "; ".join(buffered.lateness())
    assert buffered.short().startswith("udp, drops 20.8 % in bursts; delay by the state")


def test_a_network_tells_its_delays() -> None:
    """Lost packets include the late ones; the messages name the buffer if only late packets are lost."""
    nodes = {name: NodeRole(**{**one, **{k: tuple(v) for k, v in one.items() if isinstance(v, list)}})
             for name, one in NODES.items()}  # fmt: skip
    links = {"pump": LinkLaw(delay=[0.5, 0.4], buffer=1), "level-1": LinkLaw(delay=2)}
    network = Network(nodes=nodes, links=links)
    assert network.short() == (
        "pump drops 10 % (no acknowledgement); level-1: delay 2 steps; pump: delay random, 0 to 1 step, mean 0.4444 "
        "steps, 10 % lost, a packet is used 1 step after it was sent, 10 % never arrive or arrive later"
    )
    assert network.played().lost("pump") == "the loss of packets later than links.pump.buffer"
    assert network.played().losing == "the loss of packets later than links.pump.buffer"
    assert network.loss("pump") == pytest.approx(0.1)
    assert network.played().delayed_as(network).links == network.links
    stated = parse({**TABLES, "links": {"level-1": {"delay": 2}, "pump": {"buffer": 1}}}, "x")
    assert stated.plant.transport == Transport((Wait(1),), (Wait(2), Wait(0)))
    assert stated.plant.transport.text() == "input 1 1 step late, output 1 2 steps late"


def test_seconds_that_are_whole_steps_are_steps_of_a_discrete_plant() -> None:
    """With plant.dt, so that a plant that is discrete in time can use measured delays; also buffers."""
    plant = TABLES["plant"]
    drawn = {"delay": {"seconds": [0.0, 0.2], "probability": [0.5, 0.4]}}
    made = parse({**TABLES, "plant": plant, "links": {"pump": drawn, "level-1": {"buffer": {"seconds": 0.3}}}}, "x")
    law = made.network.links["pump"].delay
    assert law is not None
    assert (law.waits, law.odds, law.in_seconds) == ((0.0, 2.0), ((0.5, 0.4),), False)
    assert made.network.links["level-1"].buffer == Wait(3)
    with pytest.raises(ProblemError, match=r"links.pump.delay is 150 ms, but .* or of the 0.1 s of plant.dt"):
        parse({**TABLES, "plant": plant, "links": {"pump": {"delay": {"seconds": 0.15}}}}, "x")


@pytest.mark.parametrize(
    ("tables", "links", "words"),
    [
        (TABLES, {"pump": {"delay": {"seconds": 0.15}}}, "links.pump.delay is 150 ms, but the plant is discrete"),
        (TABLES, {"level-1": {"buffer": {"seconds": 0.15}}}, "links.level-1.buffer is 150 ms, but the plant is"),
        (TABLES, {"pump": {"delay": 1000}}, "need more than 200 registers for earlier inputs and outputs; expected"),
        (TABLES, {"level-1": {"delay": 150}, "pump": {"delay": 60}}, "need more than 200 registers"),
        (CONTINUOUS, {"pump": {"delay": {"seconds": 1e9}}}, "need more than 200 registers .* a longer period"),
        (CONTINUOUS, {"pump": {"buffer": {"seconds": 1e300}}}, "need more than 200 registers"),
        (CONTINUOUS, {"level-1": {"delay": {"seconds": 1e300}}}, "need more than 200 registers"),
        (
            TABLES, {"level-1": {"delay": [0.5, 0.5], "acknowledged": True}},
            "links.level-1.delay is random, but the policy distributed needs to know .*; expected no delay",
        ),
    ],
)  # fmt: skip
def test_delays_that_no_design_supports_are_one_sentence(
    tables: Mapping[str, Any], links: Mapping[str, Any], words: str
) -> None:
    """Before numbers become those of registers, so that a message comes at once."""
    with pytest.raises(ProblemError, match=words):
        parse({**tables, "links": links}, "tank.toml").design()


def test_a_trace_loses_in_bursts_at_its_ends_too(tmp_path: Path) -> None:
    """The first packet follows the last one, as in a replay, so that the chain loses the share of the trace."""
    for gone in (range(900, 1000), range(100), range(400, 500), (*range(50), *range(950, 1000))):
        rows = [f"{5 * i},{'' if i in gone else 5}" for i in range(1000)]
        (tmp_path / "trace.csv").write_text("\n".join(("sent,delay", *rows, "")))
        played = delay_from("delay", {"trace": str(tmp_path / "trace.csv")}).losses(Wait(0, 10.0), 0.0, None)
        assert isinstance(played, Burst)
        assert (played.to_bad, played.to_good) == pytest.approx((1 / 900, 1 / 100))
        assert played.loss == pytest.approx(0.1)


def test_constant_delays_are_known_without_acknowledgements() -> None:
    """With them, the design of sets of links did not see the delay; next to losses they are refused by name."""
    problem = sets(**{"links.valve.delay": 2, "links.pump.loss": 0.0})
    told = "links.valve.acknowledged and links.pump.acknowledged: acknowledgements are given together with a constant"
    with pytest.raises(ProblemError, match=told):
        problem.design()
    quiet = problem.changed({f"links.{link}.acknowledged": None for link in ("valve", "pump")})
    assert quiet.close(quiet.design()).nominal
    with pytest.raises(
        ProblemError, match=r"links\.pump\.loss is given, with acknowledgements, and another link has a"
    ):
        sets(**{"links.valve.delay": 2}).design()


def test_a_law_that_only_loses_is_a_loss() -> None:
    """Where the receiver does more than to hold."""
    tanks = load("quadruple-tank")
    for link in ("level-1", "pump-1"):
        law, loss = tanks.changed({f"links.{link}.delay": [0.9]}), tanks.changed({f"links.{link}.loss": 0.1})
        found = [average(one.close(one.design()), steps=20_000, seed=3).cost for one in (law, loss)]
        error = np.hypot(found[0].standard_error, found[1].standard_error)
        assert abs(found[0].value - found[1].value) < 5 * error


def test_late_packets_with_set_points_need_a_model() -> None:
    """Held contributions would leave an offset that grows with the set-point."""
    tanks = load("quadruple-tank").changed({"reference.value": [1.0, 2.0], "links.level-1.delay": [0.5, 0.5]})
    assert tanks.close(tanks.design()).violated_assumptions
    for change, remedy in (
        ({"prediction": "hold"}, "every packet, prediction = 'model', or neither"),
        ({"links.level-1.delay": [0.5, 0.4]}, "every packet, or neither"),
        ({"links.level-1.delay": None, "links.pump-1.loss": 0.1}, "every packet, or neither"),
    ):
        with pytest.raises(ProblemError, match=rf"grows with them; expected links that deliver {remedy}"):
            tanks.changed(change).design()


def test_late_packets_are_refused_by_name() -> None:
    """By a kind without losses, on a link without packets, and where acknowledgements come too late."""
    problem = load("two-mass")
    late = {"network.actuator_delay": [0.5, 0.4], "network.actuator_buffer": 1}
    told = "the loss of packets later than network.actuator_buffer is given, which the policy kind lqg does not use; "
    with pytest.raises(ProblemError, match=told + "expected ideal links: a buffer that no delay exceeds"):
        load("two-mass-lqg").changed(late).design()
    unused = {"network.sensor_delay": [0.5, 0.4], "network.sensor_buffer": 1}
    with pytest.raises(ProblemError, match=r"on the sensor link; .*: remove network.sensor_buffer"):
        problem.changed(unused).design()
    acknowledged = {"network.protocol": "tcp", "network.actuator_loss": 0.1}
    words = "network.actuator_delay is 2 steps, and packets may be lost, with acknowledgements; expected link = "
    with pytest.raises(ProblemError, match=words):
        problem.changed({**acknowledged, "network.actuator_delay": 2}).design()
    with pytest.raises(ProblemError, match=r"network\.actuator_buffer is 1 step, and packets may be lost, with"):
        problem.changed({**acknowledged, "network.actuator_buffer": 1}).design()
    with pytest.raises(ProblemError, match="has a constant delay, with which the policy kind lossy-lqg would not know"):
        load("lossy-double-integrator").changed({"network.sensor_delay": 1}).design()


FORMS: Mapping[str, Any] = {
    "steps": {"delay": 2}, "list": {"delay": [0.7, 0.2, 0.1], "buffer": 2}, "seconds": {"delay": {"seconds": 0.004}},
    "drawn": {"delay": {"seconds": [0.001, 0.004], "probability": [0.8, 0.2]}, "buffer": {"seconds": 0.004}},
    "histogram": {"delay": {"histogram": "5g.csv"}, "buffer": {"seconds": 0.01}},
    "trace": {"delay": {"trace": "5g.csv"}, "buffer": {"seconds": 20.0}},
    "states": {"delay": {"states": [[0.5, 0.5], 1]}, "buffer": 1,
               "burst": {"to_bad": 0.1, "to_good": 0.4, "loss_good": 0, "loss_bad": 0}},
    "tables": {"delay": {"states": [{"seconds": 0.001}, {"histogram": "5g.csv"}]}, "buffer": {"seconds": 0.005},
               "burst": {"to_bad": 0.1, "to_good": 0.4, "loss_good": 0, "loss_bad": 0}},
    "buffer": {"buffer": 3},
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_a_written_file_is_read_back_to_the_same_problem(form: str, tmp_path: Path) -> None:
    """Files of delays are relative to the problem file, wherever the process runs and the written file is."""
    (tmp_path / "5g.csv").write_text("1,0.5\n5,0.5\n", encoding="utf-8")
    path = tmp_path / "tank.toml"
    path.write_text(tables_text({**CONTINUOUS, "links": {"pump": FORMS[form]}}), encoding="utf-8")
    problem = load(path)
    other = tmp_path / "elsewhere" / "tank.toml"
    other.parent.mkdir()
    other.write_text(tables_text(problem.source or {}), encoding="utf-8")
    assert load(other).network == problem.network == parse(problem.source or {}, "x").network
    assert hash(problem.network) == hash(load(other).network)
    usual = {name: table for name, table in CONTINUOUS.items() if name != "nodes"}
    short = {f"actuator_{key}": value for key, value in FORMS[form].items()}
    short |= {"protocol": "udp"} if "burst" in FORMS[form] else {}
    path.write_text(tables_text({**usual, "network": short}), encoding="utf-8")
    link, stated = load(path).network.links["actuator"], problem.network.links["pump"]
    assert (link.delay, link.buffer, link.burst) == (stated.delay, stated.buffer, stated.burst)


def test_single_keys_are_changed() -> None:
    """Of a link or of the usual nodes, a whole law or a number in it; None removes it."""
    problem = load("two-mass-continuous")
    changed = problem.changed({"network.actuator_delay": {"seconds": 0.004}})
    assert changed.network.links["actuator"].wait == Wait(0, 0.004)
    assert changed.changed({"network.actuator_delay.seconds": 0.02}).network.links["actuator"].wait == Wait(0, 0.02)
    assert changed.changed({"network.actuator_delay": None}).network == problem.network
    assert changed.changed({"network.actuator_delay": None}).plant.transport is None
    own = parse({**TABLES, "links": {"pump": {"delay": 1}}}, "tank.toml")
    assert own.changed({"links.pump.delay": 2}).network.links["pump"].wait == Wait(2)
    assert own.changed({"links.level-1.buffer": 3}).network.links["level-1"].wait == Wait(3)
    with pytest.raises(ProblemError, match=f"^the changed problem: links.pump.delay is 1.5; {FORM}"):
        own.changed({"links.pump.delay": 1.5})
    costs = [own.changed({"links.pump.delay": steps}).design().cost_all_time for steps in (0, 1, 2, 3)]
    assert costs == sorted(costs)
    assert len(set(costs)) == len(costs)


def test_problems_with_other_laws_have_other_digests() -> None:
    """So no result of another law is taken from a store; a problem without delays keeps the digest it had."""
    from taciturn.study.record import fingerprint

    problem = load("two-mass")
    laws: list[dict[str, object]] = [
        {}, {"network.actuator_delay": 1}, {"network.sensor_delay": 1}, {"network.actuator_buffer": 1},
        {"network.actuator_delay": [0.5, 0.5], "network.actuator_buffer": 1},
        {"network.actuator_delay": [0.5, 0.4], "network.actuator_buffer": 1},
        {"network.actuator_delay": [0.5, 0.3], "network.actuator_buffer": 1},
    ]  # fmt: skip
    found = [fingerprint(problem.changed(law)) for law in laws]
    assert len(set(found)) == len(found)
    assert found[0].startswith("f2ad2d9057dc9f49")
