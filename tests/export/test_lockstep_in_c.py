"""A node in C takes part in a loop in virtual time: over UDP, with nodes on a host and a plant."""

from __future__ import annotations

import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from export.devices import HERE, needs_compiler
from export.test_folders import write
from runtime.loops import by_hand

import taciturn
from taciturn.model.packets import roles
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn_export.folder import CORE_SOURCES, print_folder
from taciturn_udp.endpoint import Endpoint
from taciturn_udp.nodes import NodeServer
from taciturn_udp.plant import PlantServer

STEPS, SEED = 60, 3
OPTIONS = ("-std=gnu99", "-O1", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off")


class NothingIsLost:
    """What becomes of packets on a link without relay."""

    late = None

    def lost(self, sequence: int, tick: int) -> bool:
        """Whether a packet is lost."""
        return False


def compile_lockstep(file: str, role: str, into: Path) -> Path:
    """Return the program of a node of a problem."""
    problem = taciturn.load(file)
    folder = write(into, print_folder(problem.close(problem.design()), "policy", rows=1, seed=SEED))
    names = {"NODE_HEADER": f'"policy_{role}.h"', "NODE": f"policy_{role}", "NODE_START": f"policy_{role}_start"}
    sources = [HERE / "lockstep.c", *(folder / name for name in (*CORE_SOURCES, f"policy_{role}.c"))]
    defined = [f"-D{name}={value}" for name, value in names.items()]
    made = into / "lockstep"
    command = [needs_compiler(), *OPTIONS, *defined, f"-I{folder}", *map(str, sources), "-o", str(made)]
    subprocess.run(command, check=True)
    return made


@pytest.mark.parametrize(
    ("file", "in_c"),
    [
        pytest.param("two-mass-lqg", "controller", marks=pytest.mark.evidence),
        ("lossy-double-integrator", "controller"),
        pytest.param("two-mass-lqg", "actuator", marks=pytest.mark.evidence),
        pytest.param("lossy-double-integrator", "sensor", marks=pytest.mark.evidence),
        pytest.param("lossy-double-integrator", "actuator", marks=pytest.mark.evidence),
    ],
)
@pytest.mark.parametrize("late", [False, True], ids=["first", "last"])
def test_a_node_in_c_does_not_stop_a_loop_in_virtual_time(
    file: str, in_c: str, late: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It starts before the others, or after the plant has already measured: all steps, and the costs of one process."""
    program = compile_lockstep(file, in_c, tmp_path)
    problem = taciturn.load(file)
    policy = problem.design()
    monkeypatch.setattr("runtime.loops.losses", lambda *_, **__: dict.fromkeys(("sensor", "actuator"), NothingIsLost()))
    expected = by_hand(file, STEPS, SEED)
    wire, here = Wire(policy, problem.network), roles(policy)
    ends = {name: Endpoint(("127.0.0.1", 0)) for name in ("plant", *(role for role in here if role != in_c))}
    process = subprocess.Popen([str(program), str(STEPS)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None
    assert process.stdout is not None
    places = {name: end.address for name, end in ends.items()} | {in_c: ("127.0.0.1", int(process.stdout.readline()))}
    nodes = {role: Node(policy, role, network=problem.network, seed=SEED, epoch=1) for role in here}  # type: ignore[arg-type]
    to = {role: peer(role, nodes) for role in here}

    def begin() -> None:
        assert process.stdin is not None
        ports = places[to[in_c]][1] if to[in_c] else 0, places["plant"][1]
        process.stdin.write("{} {}\n".format(*ports))
        process.stdin.flush()

    physical = {role: places["plant"] for role, node in nodes.items() if node.measures or node.actuates}
    servers = {
        role: NodeServer([nodes[role]], wire, ends[role], peer=places.get(to[role]), plant=physical.get(role))
        for role in here
        if role != in_c
    }
    measuring = next(role for role in here if nodes[role].measures)
    plant = SimulatedPlant(problem.close(policy), SEED)
    world = PlantServer([plant], wire, ends["plant"], places[measuring])
    until = time.monotonic() + 30.0
    try:
        with ThreadPoolExecutor() as threads:
            if not late:
                begin()
            running = [threads.submit(world.run, STEPS, lambda: time.monotonic() > until)]
            ended = running[0].done
            running += [
                threads.submit(server.run, STEPS, lambda: time.monotonic() > until or ended())
                for server in servers.values()
            ]
            if late:
                time.sleep(0.1)
                begin()
            reports = [one.result() for one in running]
    finally:
        process.kill()
        process.communicate()
        for end in ends.values():
            end.close()
    assert len(world.costs[0]) == STEPS
    assert world.costs[0] == expected.tolist()
    assert not any(report.get("degraded") for report in reports)


def peer(role: str, nodes: dict[str, Node]) -> str:
    """Return the node that a node sends its packets to: the receiver of its data, or the sender of what it tells of."""
    own = nodes[role]
    for other, node in nodes.items():
        if set(own.program.sends) & set(node.program.hears) or set(own.acknowledges) & set(node.program.sends):
            return other
    return ""
