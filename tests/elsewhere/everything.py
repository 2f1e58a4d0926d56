"""What a user does first, with a problem file that is given: run by tests/test_elsewhere.py as a process of its own."""

from __future__ import annotations

import importlib
import os
import pkgutil
import signal
import sys
import threading
import warnings
from pathlib import Path

import pytest

import taciturn
from taciturn._process import ENDING
from taciturn.cli.frame import main
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn_studies.workers import processes
from taciturn_udp.endpoint import Endpoint
from taciturn_udp.nodes import NodeServer
from taciturn_udp.plant import PlantServer

TICKS = 100


def import_all() -> int:
    """Import every module of the package; return how many there are."""
    found = pkgutil.walk_packages(taciturn.__path__, "taciturn.")
    return len([importlib.import_module(one.name) for one in found if not one.name.endswith("__main__")])


def command(*arguments: str) -> None:
    """Run a command as a shell does."""
    sys.argv = ["taciturn", *arguments]
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 0, arguments


def through_sockets(problem: taciturn.Problem) -> list[float]:
    """Return what every step costs where both nodes serve over UDP, in threads of this process."""
    policy = problem.design()
    done = threading.Event()
    with Endpoint(("127.0.0.1", 0)) as at_plant, Endpoint(("127.0.0.1", 0)) as a, Endpoint(("127.0.0.1", 0)) as b:
        wire = Wire(policy, problem.network)
        servers = [
            NodeServer([Node(policy, "controller")], wire, a, peer=b.address, plant=at_plant.address),
            NodeServer([Node(policy, "actuator")], wire, b, plant=at_plant.address),
        ]
        threads = [threading.Thread(target=server.run, args=(None, done.is_set)) for server in servers]
        for thread in threads:
            thread.start()
        plant = PlantServer([SimulatedPlant(problem.close(policy), 1)], wire, at_plant, a.address)
        plant.run(TICKS, done.is_set)
        done.set()
        for thread in threads:
            thread.join()
    return plant.costs[0]


def without_sockets(problem: taciturn.Problem) -> list[float]:
    """Return the same costs of nodes that are called one after the other."""
    policy = problem.design()
    controller, actuator = Node(policy, "controller"), Node(policy, "actuator")
    plant, costs = SimulatedPlant(problem.close(policy), 1), list[float]()
    for tick in range(TICKS):
        for packet in controller.step(tick, plant.measurement).packets:
            actuator.sort_in(packet)
        given = actuator.step(tick).input
        assert given is not None
        costs.append(plant.move(given))
    return costs


def begin(file: Path) -> None:
    """Import all, evaluate, and run nodes over sockets."""
    assert not hasattr(os, "fork")
    assert not hasattr(signal, "SIGHUP")
    assert set(ENDING) == {signal.SIGINT, signal.SIGTERM}
    print("modules", import_all())
    problem = taciturn.load(file)
    print("cost", taciturn.evaluate(problem, steps=20_000).cost.value)
    assert through_sockets(problem) == without_sockets(problem)


def go_on(file: Path) -> None:
    """Sweep with two workers and without, draw, and export: each writes files."""
    problem, found = taciturn.load(file), []
    print("tradeoff", len(taciturn.tradeoff(problem, {"theta": [0.1, 1.0]}, standard_error=0.1).points))
    for workers in (1, 2):
        with processes(workers) as pool:
            store = file.with_name(f"runs of {workers}")
            found.append(taciturn.sweep(problem, {"theta": [0.1, 0.5, 1.0]}, executor=pool, store=store, steps=20_000))
    assert found[0].identical(found[1])
    found[0].to_netcdf(file.with_name("the sweep.nc"))
    command("show", str(file), "--plot", str(file.with_name("the nodes.svg")))
    command("export", str(file), "--c", str(file.with_name("for C")))
    command("export", str(file), "--fmu", str(file.with_name("the unit.fmu")))


if __name__ == "__main__":
    warnings.filterwarnings("error", category=EncodingWarning, module="taciturn")  # a text file without an encoding
    {"begin": begin, "go on": go_on}[sys.argv[1]](Path(sys.argv[2]))
