"""What goes wrong on purpose: datagrams that somebody else sends while nodes run."""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import taciturn
from taciturn import Network
from taciturn.nodes.node import Node
from taciturn.nodes.packet import Wire
from taciturn_udp.processes import Processes

CHAPTER_7 = """
[plant]
A = [[1, 0.1], [0, 1]]
B = [[0.005], [0.1]]
W = [[0.01, 0], [0, 0.01]]
dt = 0.01
[cost]
Q = [[1, 0], [0, 1]]
R = [[1]]
[network]
protocol = "udp"
actuator_loss = 0.1
sensor_loss = 0.25
[policy]
kind = "lossy-lqg"
price = 0.1
"""
KEY = bytes(range(16, 48))


def chapter_7(folder: Path) -> str:
    """Write the loop of chapter 7, α = .1 and β = .25, and return its path."""
    path = folder / "chapter7.toml"
    path.write_text(CHAPTER_7, encoding="utf-8")
    return str(path)


def throw(datagrams: Sequence[bytes], to: str, rate: float) -> int:
    """Send datagrams to HOST:PORT at so many a second, in bursts of a hundredth of one; return how many."""
    host, port = to.split(":")
    each, begin = max(1, int(rate / 100)), time.monotonic()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for first in range(0, len(datagrams), each):
            time.sleep(max(0.0, begin + first / rate - time.monotonic()))
            for datagram in datagrams[first : first + each]:
                sender.sendto(datagram, (host, int(port)))
    return len(datagrams)


def noise(count: int, seed: int) -> list[bytes]:
    """Return random datagrams."""
    draws = np.random.default_rng(seed)
    return [draws.bytes(int(size)) for size in draws.integers(0, 80, count)]


def capture(file: str, ticks: int, key: bytes | None, epoch: int = 1, **changes: object) -> list[bytes]:
    """Return what a sensor of a problem sent in an earlier run, or one of a changed problem."""
    problem = taciturn.load(file).changed(changes)
    policy = problem.design()
    network: Network = problem.network
    node, wire = Node(policy, "sensor", network=network, epoch=epoch), Wire(policy, network, key)
    packets = [
        packet for k in range(ticks) for packet in (*node.step(k, [50.0, 50.0]).packets, *node.mark())
    ]  # fmt: skip
    return [wire.encode(packet) for packet in packets]


def await_ticks(processes: Processes, role: str, ticks: int) -> None:
    """Wait until a node has logged so many steps, at most half a minute."""
    log, latest = processes.folder / f"{role}.jsonl", time.monotonic() + 30
    while not log.exists() or log.read_bytes().count(b"\n") < ticks:
        assert time.monotonic() < latest, f"the {role} did not log {ticks} steps"
        time.sleep(0.01)
