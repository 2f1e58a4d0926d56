"""Nodes, plants, links and networks at the command line: what they answer, and what a user can get wrong."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from counts import few

from taciturn import Plant, load
from taciturn_udp.endpoint import Endpoint, free_addresses
from taciturn_udp.processes import Process
from taciturn_worlds.invariants import RECOVERY, BrokenError

if TYPE_CHECKING:
    from conftest import Run, Write

PAGE = Path(__file__).parent.parent.parent / "docs" / "network.md"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (
            ["node", "pilot", "two-mass"],
            "the node is 'pilot', which is not a role; expected one of the nodes controller, actuator",
        ),
        (["node", "sensor", "two-mass-lqg"], "at the site of the controller in lqg"),
        (["node", "controller", "two-mass"], "--plant is missing, but node controller exchanges packets"),
        (["node", "controller", "two-mass", "--plant", ":9000"], "--peer is missing"),
        (
            ["node", "actuator", "two-mass", "--plant", ":9", "--peer", ":9"],
            "--peer is given, but node actuator sends packets on no link; expected no --peer",
        ),
        (
            ["node", "actuator", "two-mass", "--plant", ":9", "--peer", "actuator=:9"],
            "--peer is given, but node actuator sends packets on no link",
        ),
        (
            ["node", "controller", "lossy-double-integrator", "--peer", ":9", "--plant", ":9"],
            "--plant is given, but node controller neither measures nor applies inputs; expected no --plant",
        ),
        (["node", "actuator", "two-mass", "--plant", "9000"], "--plant is '9000'; expected HOST:PORT"),
        (["node", "actuator", "two-mass", "--plant", ":99999"], "a port from 1 to 65535"),
        (["node", "actuator", "two-mass", "--bind", ":" + "9" * 5000], "a port from 0 to 65535"),
        (["relay", "--bind", ":0", "--peer", "127.0.0.1:１２"], "a port from 1 to 65535"),
        (["relay", "--bind", ":0", "--peer", "localhost:0"], "a port from 1 to 65535"),
        (["relay", "--bind", ":0", "--peer", "[::1]:9001"], "IPv6 is not supported"),
        (["relay", "--bind", "::1", "--peer", ":9001"], "IPv6 is not supported"),
        (["relay", "--bind", ":0", "--peer", "a" * 64 + ":9001"], "is unknown"),
        (
            ["node", "actuator", "two-mass", "--plant", "no.such.host.invalid:9"],
            "'no.such.host.invalid' is unknown",
        ),
        (["node", "actuator", "two-mass", "--plant", ":9", "--bind", "192.0.2.1:9"], "192.0.2.1:9 cannot be bound"),
        (
            ["node", "actuator", "two-mass", "--plant", ":9", "--safe", "banana"],
            "--safe is 'banana'; expected hold",
        ),
        (["node", "actuator", "two-mass", "--plant", ":9", "--safe", "1,2"], "the safe input is (1.0, 2.0)"),
        (
            ["node", "controller", "two-mass", "--watchdog", "3"],
            "which receives no packets",
        ),
        (["node", "actuator", "two-mass", "--heartbeat", "3"], "--heartbeat is given without --real-time"),
        (["node", "actuator", "two-mass", "--wait", "3"], "--wait is 3"),
        (["node", "actuator", "two-mass", "--steps", "0"], "--steps is 0; expected a whole number of at least 1"),
        (["node", "actuator", "two-mass", "--tick", "0.1"], "--tick is given without --real-time"),
        (["node", "actuator", "two-mass", "--state", "s", "--loops", "2"], "--state is given with --loops 2"),
        (["node", "actuator", "two-mass", "--key", "no-such-file"], "the key file no-such-file cannot be read"),
        (["network", "two-mass", "--tick", "0.1"], "--tick is given without --real-time"),
        (
            ["network", "wiener-double-integrator", "--steps", "0"],
            "--steps is 0; expected a whole number of at least 1",
        ),
        (["node", "controller", "two-mass", "--loops", "70000"], "--loops is 70000"),
        (["plant", "two-mass", "--peer", "nowhere"], "--peer is 'nowhere'; expected HOST:PORT"),
        (["relay", "--peer", ":9", "--loss", "1.5"], "loss is 1.5; expected 0 ≤"),
        (["relay", "--peer", ":9", "--loss", "20%"], "--loss is '20%'; expected a number from 0 to 1, such as 0.2"),
        (["relay", "--peer", ":9", "--corrupt", "x"], "--corrupt is 'x'; expected a number from 0 to 1"),
        (["network", "two-mass", "--loss", "20%"], "--loss is '20%'; expected a number from 0 to 1, such as 0.2"),
        (
            ["network", "two-mass-lqg", "--loss", "sensor=0.2"],
            "--loss names the link 'sensor'; expected one of the links of the policy lqg: actuator",
        ),
        (["network", "two-mass-lqg", "--loss", "0.2", "--loss", "0.3"], "--loss is given twice for all links"),
        (["network", "two-mass-lqg", "--loss", "0.2", "--namespaces"], "--loss is given with --namespaces"),
        (
            ["network", "two-mass", "--world", "1", "--loss", "0.2"],
            "--world is given with --loss, which it does not use",
        ),
        (["network", "two-mass", "--world", "-1"], "seed is -1"),
        (["network", "lossy-double-integrator", "--world", "1"], "is for a horizon of 100 steps"),
        (
            ["relay", "--peer", ":9", "--burst", "0.1"],
            "--burst is '0.1'; expected a text of the form chain:drops,moves or gilbert-elliott:to_bad,to_good",
        ),
        (["relay", "--peer", ":9", "--burst", "0.1,0.1,0,1", "--loss", "0.1"], "--loss and --burst are both given"),
    ],
)
def test_what_cannot_run_is_refused_in_a_sentence(run: Run, arguments: list[str], told: str) -> None:
    """Roles, addresses, keys, times and links: one sentence, exit code 2."""
    assert told in run(*arguments).sentence


def test_a_policy_without_nodes_is_refused(run: Run, write: Write) -> None:
    """What is for analysis, and what is triggered between steps, has no nodes."""
    optimal = write(policy='[policy]\nkind = "optimal"\nprice = 0.1\n')
    for command in (["network", optimal], ["node", "controller", optimal], ["plant", optimal, "--peer", ":9"]):
        assert "decides by a boundary that nodes cannot evaluate" in run(*command).sentence


def test_keys_that_are_none_are_refused(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Too short, and no hexadecimal digits, in a file and in the environment."""
    key = tmp_path / "key"
    key.write_text("abcd")
    key.chmod(0o600)
    assert "has 2 bytes; expected 16 to 32" in run("network", "two-mass-lqg", "--key", str(key)).sentence
    monkeypatch.setenv("TACITURN_KEY", "secret")
    assert (
        "TACITURN_KEY contains characters that are not hexadecimal digits; expected 32 to 64"
        in run("network", "two-mass-lqg").sentence
    )


def test_a_port_in_use_and_a_foreign_state_are_refused(run: Run, tmp_path: Path) -> None:
    """Somebody listens there already; the state is that of another role, or none."""
    endpoint = Endpoint(("127.0.0.1", 0))
    taken = f"127.0.0.1:{endpoint.address[1]}"
    told = run("node", "actuator", "two-mass-lqg", "--plant", ":9", "--bind", taken).sentence
    assert "cannot be bound (Address already in use)" in told
    endpoint.close()
    state = tmp_path / "state.json"
    for text in ("{", "[]", '{"node": {}, "outbox": []}'):
        state.write_text(text)
        assert "state" in run("node", "actuator", "two-mass-lqg", "--plant", ":9", "--state", str(state)).sentence


@pytest.mark.evidence
def test_the_network_answers_as_evaluate_does(run: Run) -> None:
    """One JSON document with the keys of ``evaluate`` and the datagrams; for people, a table."""
    answer = run("network", "lossy-double-integrator", "--seed", "1", "--json")
    document = json.loads(answer.out)
    assert answer.code == 0
    assert document["unit"] == "mission"
    assert document["cost"]["standard_error"] is None
    assert document["datagrams"]["sensor"]["sent"] == document["ticks"] == 100
    assert 0 < document["datagrams"]["sensor"]["lost"] < 100
    text = run("network", "lossy-double-integrator", "--seed", "1").out
    assert re.search(rf"^sensor .*\b{document['datagrams']['sensor']['lost']}\b", text, re.MULTILINE)
    assert "one finite-horizon run" in text


@pytest.mark.evidence
def test_a_world_is_replayed_from_its_seed(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Faults, counters and recovery, for people and as JSON; with a broken invariant also one sentence and code 1."""
    text = run("network", "remote-scalar", "--world", "2").out
    document = json.loads(run("network", "remote-scalar", "--world", "2", "--json").out)
    assert len(re.findall("^fault ", text, re.MULTILINE)) == len(document["faults"]) >= 1
    assert document["broken"] is None
    assert 0 <= document["recovery"] <= document["promised"]
    assert f"{document['recovery']} steps after the last fault" in re.sub(r"\s+", " ", text)
    assert all(document["invariants"].values())
    assert document["node_ticks"] == document["ticks"]
    broken = BrokenError(RECOVERY, 7, "a packet is missing")
    monkeypatch.setattr("taciturn_worlds.world.World.run", lambda world, copies: broken)
    answer = run("network", "remote-scalar", "--world", "2")
    assert answer.code == 1
    assert "world 2 breaks an invariant at step 7: a packet is missing" in answer.err
    assert "an invariant is broken: step 7: a packet is missing" in " ".join(answer.out.split())


@pytest.mark.evidence
def test_losses_are_those_of_the_command_line(run: Run) -> None:
    """A link that is named loses so much, and others what the file says; without a name each does."""
    lossy = ("network", "lossy-double-integrator", "--seed", "1", "--json", "--steps", "30")
    for given, lost in (
        (["--loss", "sensor=1"], {"sensor": 1.0}),
        (["--loss", "0", "--loss", "actuator=1"], {"sensor": 0.0, "actuator": 1.0}),
    ):
        document = json.loads(run(*lossy, *given).out)
        found = document["datagrams"]
        for link, share in lost.items():
            assert found[link]["lost"] == share * found[link]["sent"], given
        assert any("treats packets differently from the network" in note for note in document["notes"])
        if "actuator" not in lost:
            share = found["actuator"]["lost"] / found["actuator"]["sent"]
            assert 0 < share < 1


def terminals() -> list[list[list[str]]]:
    """Return the groups of commands that the page shows, a terminal each."""
    blocks = re.findall(r"```console\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    return [[line.removeprefix("$ taciturn ").split() for line in block.splitlines()] for block in blocks]


@pytest.mark.evidence
@pytest.mark.parametrize("typed", few(["four", "relayed", "three", "tank"], 1, 1))
def test_the_terminals_of_the_page_talk(tmp_path: Path, typed: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the page tells to type, on free ports: the plant ends after its steps, the nodes when they are told to."""
    monkeypatch.chdir(tmp_path)
    four, relay, three, tank = terminals()
    group = {"four": four, "relayed": [*relay, *four], "three": three, "tank": tank}[typed]
    ports = sorted({port for command in group for word in command for port in re.findall(r":\d+$", word)})
    free = dict(zip(ports, (f":{port}" for _, port in free_addresses(len(ports))), strict=True))
    commands = [[re.sub(r":\d+$", lambda found: free[found[0]], word) for word in command] for command in group]
    if typed == "relayed":
        sensor = next(command for command in commands if command[:2] == ["node", "sensor"])
        sensor[sensor.index("--peer") + 1] = free[":9012"]
    *others, plant = commands
    processes = [Process(command) for command in others]
    for process in processes:
        process.expect()
    command = [sys.executable, "-m", "taciturn", *plant]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == 0, done.stderr
    reports = [process.stop() for process in processes]
    ticks = int(plant[plant.index("--steps") + 1])
    report = json.loads(done.stdout)
    assert report["tick"] == ticks - 1
    assert report["cost"]["value"] > 0
    assert all(report["tick"] == ticks - 1 for report in reports if report["role"] != "relay")
    if "--log" in plant:
        lines = (tmp_path / "plant.jsonl").read_text().splitlines()
        assert len(lines) == ticks
        running = sum(json.loads(line)["cost"] for line in lines)
        assert report["unit"] == "mission"
        assert report["cost"]["value"] >= running > 0  # and what the last state costs


@pytest.mark.evidence
def test_ticks_are_logged_as_json_lines(tmp_path: Path) -> None:
    """A line per step to a file and to a UDP port, with the fields that the page names."""
    listener = Endpoint(("127.0.0.1", 0))
    here, there = (f"127.0.0.1:{port}" for _, port in free_addresses(2))
    log = f"udp://127.0.0.1:{listener.address[1]}"
    actuator = Process(
        ["node", "actuator", "two-mass-lqg", "--bind", there, "--plant", ":9", "--log", log, "--steps", "30"]
    )
    actuator.expect()
    plant = Endpoint(("127.0.0.1", 0))
    at = f"127.0.0.1:{plant.address[1]}"
    path = tmp_path / "log.jsonl"
    controller = Process(
        ["node", "controller", "two-mass-lqg", "--bind", here, "--peer", there, "--plant", at, "--log", str(path)]
    )
    controller.expect()
    import taciturn
    from taciturn.nodes.packet import Packet, Wire
    from taciturn_udp.endpoint import parse_address

    wire = Wire(taciturn.load("two-mass-lqg").design())
    for tick in range(30):
        plant.send(wire.encode(Packet("measurement", "plant", tick, tick, (0.5, -0.5))), parse_address("x", here))
    found: list[bytes] = []
    import time

    end = time.monotonic() + 20
    while len(found) < 30 and time.monotonic() < end:
        found += listener.receive(time.monotonic() + 1)
    controller.stop()
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    told = [json.loads(line) for line in found]
    assert [line["tick"] for line in lines] == [line["tick"] for line in told] == list(range(30))
    assert lines[0]["y"] == [0.5, -0.5]
    assert {"timestamp", "sent_actuator", "option_send_silent", "degraded"} <= set(lines[0])
    assert {"u", "arrived_actuator", "silent"} <= set(told[0])
    actuator.kill()
    plant.close()
    listener.close()


def test_a_plant_of_its_own_gets_a_load(run: Run, tmp_path: Path) -> None:
    """Without nodes, its state moves by the load from the given time on, beyond that of the same noise."""
    paths = list[np.ndarray]()
    for name, more in (("without", ()), ("with", ("--load", "0.3@2", "--load", "-0.3@4"))):
        log = tmp_path / f"{name}.jsonl"
        found = run(
            "plant", "two-mass", "--peer", "127.0.0.1:9", "--real-time", "--tick", "0.0002", "--steps", "60",
            "--log", str(log), *more,
        )  # fmt: skip
        assert found.code == 0, found.err
        paths.append(np.array([json.loads(line)["x"] for line in log.read_text().splitlines()]))
    plant = load("two-mass").plant
    assert isinstance(plant, Plant)
    assert plant.dt is not None
    x, steps = np.zeros(plant.states), 60
    for k in range(steps):
        x = plant.A @ x + plant.B[:, 0] * (0.3 if 2 <= k * plant.dt < 4 else 0.0)
        assert paths[1][k] - paths[0][k] == pytest.approx(x, abs=1e-9)
    assert np.abs(x).max() > 1e-3
