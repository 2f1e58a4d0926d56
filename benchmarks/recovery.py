"""How long nodes over UDP take to recover from faults, in real time, with another version for comparison.

    python benchmarks/recovery.py [--before FOLDER] [--runs 5] [--long 2] [--jobs 1] [--json docs/recovery.json]

A sensor, a controller and an actuator run as three processes with a key. This process simulates the plant, and forwards
the packets of both links, so it can cut a link and knows the step of every packet. A step is *good* if all three nodes
execute it and none is silent, if every data packet of this step arrives at its receiver before the receiver executes
the step, and if the plant receives the input of this step before the step ends.

The recovery time lasts from the end of the fault to the first good step that begins 50 steps of which at least 40 are
good, and in which the controller sends data. (Other programs on a shared machine delay single steps.) A fault ends when
the restarted process listens, the suspended one continues, the link carries packets again, or the step number has
jumped. A run of more than a minute counts as not recovered. For wall clocks of different rates, and without a fault,
the table counts the steps of one minute that are not good. Each run has fresh processes. ``--before`` names the source
folder of another version; ``--long`` is the number of runs that take a minute. Run this with a higher priority and, as
one case saves a state in every step, with TMPDIR on a RAM disk.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

SOURCE = Path(__file__).resolve().parent.parent / "src"
KEY = bytes(range(16, 48))
FIRST = 10_000  # number of the first step: the loop seems to have run for this many steps
NODES = ("controller", "actuator", "sensor")
GOOD, ENOUGH = 50, 40  # steps, and those of them that must be good after the recovery
LIMIT = 60.0  # seconds in which a loop must recover
SETTLED = 0.15  # seconds after which the log lines of a step are complete
HEARTBEAT, WATCHDOG = 20, 60  # steps
WAIT = {"sensor": 0.0, "controller": 0.5, "actuator": 0.7}  # fractions of a step
GONE = 1.5  # seconds from the end of a process to its next start
SAVED = "SIGKILL of the actuator, restarted from its saved state"
PROBLEM = """
plant = {A = [[1, 0.1], [0, 1]], B = [[0.005], [0.1]], W = [[0.01, 0], [0, 0.01]], dt = 0.01}
cost = {Q = [[1, 0], [0, 1]], R = [[1]]}
network = {protocol = "udp", actuator_loss = 0.1, sensor_loss = 0.25}
policy = {kind = "lossy-lqg", price = 0.1}
"""


class Link(threading.Thread):
    """A link that forwards datagrams in both directions, unless it is cut, and notes the steps of the data packets."""

    def __init__(self, bind: tuple[str, int], peer: tuple[str, int]) -> None:
        """Listen, without having forwarded anything."""
        super().__init__(daemon=True)
        self.peer, self.cut = peer, False
        self.sent: dict[int, list[int]] = {}  # sequence numbers of the data packets, by step
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(bind)

    def run(self) -> None:
        """Forward datagrams until the process ends."""
        from taciturn.model.wire import KINDS, read_place

        client = None
        while True:
            try:
                datagram, sender = self.socket.recvfrom(4096)
            except ConnectionRefusedError:  # the receiver is not running
                continue
            client, to = (client, client) if sender == self.peer else (sender, self.peer)
            sequence, kind, _, tick = read_place(datagram)
            if KINDS[kind] == "data":
                self.sent.setdefault(tick, []).append(sequence)
            if not self.cut and to is not None:
                self.socket.sendto(datagram, to)


class Log:
    """The log of a node: whether it was silent, by step, and the step at which each data packet had arrived."""

    def __init__(self, path: Path, link: str | None) -> None:
        """Begin with an empty log."""
        self.path, self._link, self._offset = path, link, 0
        self.silent, self.arrived = dict[int, bool](), dict[int, int]()

    def read(self) -> None:
        """Read the new lines."""
        if not self.path.exists():
            return
        with self.path.open("rb") as file:
            file.seek(self._offset)
            text = file.read()
        end = text.rfind(b"\n") + 1
        self._offset += end
        for part in text[:end].splitlines():
            try:
                line = json.loads(part)
            except ValueError:  # the process was killed while it wrote the line
                continue
            self.silent[line["tick"]] = bool(line["silent"])
            for sequence in line.get(f"arrived_{self._link}", ()):
                self.arrived[sequence] = line["tick"]


class Rig:
    """A plant in this process, its three nodes in other processes, and the links between them."""

    def __init__(self, folder: Path, tick: float, fast: float, seed: int, keeps: bool) -> None:
        """Write the problem and the key, and form the commands; ``fast`` is the rate of the nodes' wall clocks."""
        import taciturn
        from taciturn.nodes.packet import Wire
        from taciturn_udp.endpoint import free_addresses

        class Numbered(Wire):
            """A wire format that adds a number to the steps of the plant."""

            offset = FIRST

            def encode(self, packet: Any) -> bytes:
                shifted = 0 if packet.kind == "challenge" else self.offset
                return super().encode(packet._replace(tick=packet.tick + shifted))

            def decode(self, datagram: bytes) -> Any:
                packet = super().decode(datagram)
                return packet if isinstance(packet, str) else packet._replace(tick=max(0, packet.tick - self.offset))

        file, key = folder / "loop.toml", folder / "key"
        file.write_text(PROBLEM, encoding="utf-8")
        key.write_text(KEY.hex(), encoding="ascii")
        key.chmod(0o600)
        self.problem, self.tick, self.seed = taciturn.load(str(file)), tick, seed
        self.policy = self.problem.design()
        self.wire = Numbered(self.policy, self.problem.network, KEY)
        names = ("plant", "sensor", "controller", "actuator", "to controller", "to actuator")
        self.at = dict(zip(names, free_addresses(len(names)), strict=True))
        text = {name: f"{host}:{port}" for name, (host, port) in self.at.items()}
        peers = {"sensor": "to controller", "controller": "to actuator"}
        self.commands: dict[str, list[str]] = {}
        for role in NODES:
            command = ["node", role, str(file), "--bind", text[role], "--real-time", "--tick", repr(tick / fast)]
            command += ["--key", str(key), "--log", str(folder / f"{role}.jsonl"), "--heartbeat", str(HEARTBEAT)]
            command += ["--wait", str(WAIT[role])]
            command += ["--peer", text[peers[role]]] if role in peers else ["--watchdog", str(WATCHDOG)]
            command += [] if role == "controller" else ["--plant", text["plant"]]
            command += ["--state", str(folder / f"{role}.json")] if keeps and role == "actuator" else []
            self.commands[role] = command
        self.links = {
            "sensor": Link(self.at["to controller"], self.at["controller"]),
            "actuator": Link(self.at["to actuator"], self.at["actuator"]),
        }
        hears = {"controller": "sensor", "actuator": "actuator"}
        self.logs = {role: Log(folder / f"{role}.jsonl", hears.get(role)) for role in NODES}
        self.processes: dict[str, Any] = {}
        self.steps: list[tuple[float, int, bool]] = []  # begin, number, and whether no new input arrived
        self.servers, self.replaced = list[Any](), threading.Event()
        self._judged, self._next = list[tuple[float, bool, bool]](), 0

    def start(self, *roles: str) -> None:
        """Start nodes, and wait until they listen."""
        from taciturn_udp.processes import Process

        for role in roles:
            self.processes[role] = Process(self.commands[role], f"the {role}")
        for role in roles:
            self.processes[role].expect()

    def serve(self, ended: Callable[[], bool]) -> None:
        """Simulate the plant until the end; if it is replaced, another one begins at step 0 later."""
        self._serve(lambda: ended() or self.replaced.is_set())
        while not ended():
            time.sleep(GONE)
            self.wire.offset = 0
            self._serve(ended)

    def _serve(self, ended: Callable[[], bool]) -> None:
        from taciturn.nodes.simulated_plant import SimulatedPlant
        from taciturn_udp.endpoint import Endpoint
        from taciturn_udp.plant import PlantServer

        plant, begin, held = SimulatedPlant(self.problem.close(self.policy), self.seed), time.monotonic(), 0

        def note(line: Any) -> None:
            nonlocal begin, held
            self.steps.append((begin, line["tick"] + self.wire.offset, server.held > held))
            begin, held = time.monotonic(), server.held

        with Endpoint(self.at["plant"]) as endpoint:
            server = PlantServer([plant], self.wire, endpoint, self.at["sensor"], tick=self.tick, told=note)
            self.servers.append(server)
            server.run(10**9, ended)

    def judge(self) -> None:
        """Judge the steps that are complete: when they began, whether they were good, and whether data was sent."""
        for log in self.logs.values():
            log.read()
        latest, receivers = time.monotonic() - SETTLED, {"sensor": "controller", "actuator": "actuator"}
        while self._next < len(self.steps) and self.steps[self._next][0] < latest:
            begin, number, held = self.steps[self._next]
            good = not held and not any(log.silent.get(number, True) for log in self.logs.values())
            for link, role in receivers.items():
                arrived = self.logs[role].arrived
                good &= all(arrived.get(one, number + 1) <= number for one in self.links[link].sent.get(number, ()))
            self._judged.append((begin, good, number in self.links["actuator"].sent))
            self._next += 1

    def recovered(self, end: float, limit: float = LIMIT) -> float | None:
        """Return the seconds from the end of a fault to the first of so many good steps, or None."""
        first = 0
        while time.monotonic() < end + limit + 2 * GOOD * self.tick:
            self.judge()
            while first + GOOD <= len(self._judged):
                begin, good, _ = self._judged[first]
                part = self._judged[first : first + GOOD]
                enough = good and sum(one[1] for one in part) >= ENOUGH and any(one[2] for one in part)
                if enough and begin + self.tick > end:
                    return max(0.0, begin - end) if begin - end <= limit else None
                first += 1
            time.sleep(0.1)
        return None

    def bad(self, seconds: float) -> int:
        """Return the number of steps that are not good in the seconds to come."""
        begin = time.monotonic()
        while time.monotonic() < begin + seconds + 2 * SETTLED:
            self.judge()
            time.sleep(0.1)
        return sum(not good for at, good, _ in self._judged if begin <= at < begin + seconds)


def kill(rig: Rig) -> None:
    """Kill the actuator, and start it again later."""
    rig.processes["actuator"].kill()
    time.sleep(GONE)
    rig.start("actuator")


def pause(rig: Rig, role: str, seconds: float) -> None:
    """Suspend a node."""
    rig.processes[role].pause(seconds)


def jump(rig: Rig, steps: int) -> None:
    """Let the step number of the plant jump."""
    rig.wire.offset += steps


def replay(rig: Rig) -> None:
    """Kill the actuator, start it again, and send it a packet of an earlier run before it receives another one."""
    from taciturn.nodes.packet import Packet, Wire

    old = Packet("data", "actuator", 1_000_000, 700_000, (0.5,), epoch=int(time.time()) - 86_400)
    rig.links["actuator"].cut = True
    kill(rig)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as attacker:
        attacker.sendto(Wire(rig.policy, rig.problem.network, KEY).encode(old), rig.at["actuator"])
    time.sleep(0.1)
    rig.links["actuator"].cut = False


def cut(rig: Rig, seconds: float) -> None:
    """Cut the link of the actuator."""
    rig.links["actuator"].cut = True
    time.sleep(seconds)
    rig.links["actuator"].cut = False


def replace(rig: Rig) -> None:
    """End the plant, and start it again later."""
    rig.replaced.set()
    while len(rig.servers) < 2:
        time.sleep(0.001)


FAULTS: dict[str, Callable[[Rig], None]] = {
    SAVED: kill,
    "SIGKILL of the actuator, restarted without a state": kill,
    **{f"SIGSTOP of the {r}, {s:g} s": partial(pause, role=r, seconds=s) for r in NODES[:2] for s in (0.3, 1.5, 10)},
    "the plant's step number jumps by +100": partial(jump, steps=100),
    "the plant's step number jumps by −100": partial(jump, steps=-100),
    "replay of a packet of step 1,000,000 to an actuator without a state": replay,
    "cut of the actuator link, 2 s": partial(cut, seconds=2.0),
    "the plant starts again at step 0": replace,
}
RATES = {
    "no fault": 1.0,
    "wall clocks of the nodes 0.05 % fast": 1.0005,
    "wall clocks of the nodes 0.05 % slow": 1 / 1.0005,
}


def measure(name: str, tick: float, seed: int) -> float | int | None:
    """Return the recovery time of a fault, or the number of steps that are not good in a minute."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(1) as pool:
        rig = Rig(Path(folder), tick, RATES.get(name, 1.0), seed, name == SAVED)

        def disturb() -> float | int | None:
            if rig.recovered(time.monotonic(), 20.0) is None:
                raise RuntimeError("this machine does not hold the steps: choose a longer --tick, or reduce its load")
            time.sleep(0.3 + 0.003 * seed)
            if name in RATES:
                return rig.bad(LIMIT)
            FAULTS[name](rig)
            return rig.recovered(time.monotonic())

        for link in rig.links.values():
            link.start()
        try:
            rig.start(*rig.commands)
            found = pool.submit(disturb)
            rig.serve(found.done)
            return found.result()
        finally:
            for process in rig.processes.values():
                process.kill()


def run(sources: dict[str, Path], tick: float, runs: int, long: int, jobs: int, names: list[str]) -> list[Any]:
    """Measure every fault with every version, the versions in turn; return the rows of the table."""
    rows: list[dict[str, Any]] = [{"fault": name, "counts": name in RATES} | {v: [] for v in sources} for name in names]

    def fill(row: dict[str, Any]) -> None:
        for seed in range(runs):
            for version, source in sources.items():
                known: list[float | None] = row[version]
                if len(known) < (long if row["counts"] or None in known else runs):
                    known.append(in_process(row["fault"], tick, seed, source))
                    print(f"{row['fault']} | {version} | {known[-1]}", file=sys.stderr, flush=True)

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(fill, reversed(rows)))
    return rows


def in_process(name: str, tick: float, seed: int, source: Path) -> float | None:
    """Measure a fault in another process, with the library in a source folder."""
    command = [sys.executable, __file__, "--one", name, "--tick", repr(tick), "--seed", str(seed)]
    environment = {**os.environ, "PYTHONPATH": str(source), "PYTHONIOENCODING": "utf-8"}
    done = subprocess.run(command, capture_output=True, encoding="utf-8", env=environment, check=False)
    if done.returncode:
        raise RuntimeError(f"{name}: {done.stderr}")
    return json.loads(done.stdout)


def table(document: dict[str, Any]) -> list[str]:
    """Return the lines of the table of both versions: the median and the largest of the runs of each fault."""
    versions = [version for version in ("before", "after") if version in document["rows"][0]]
    lines = [f"| fault | {' | '.join(f'{version}: median | largest' for version in versions)} |"]
    lines.append("|---" + 2 * len(versions) * "|---:" + "|")
    for row in document["rows"]:
        cells = [row["fault"]]
        for version in versions:
            found = [float("inf") if one is None else one for one in row[version]]
            unit = f" of {round(LIMIT / document['step'])} steps" if row["counts"] else " s"
            for number in (statistics.median(found), max(found)):
                text = f"{number:.0f}" if row["counts"] else f"{number:.2f}" if number <= LIMIT else f">{LIMIT:.0f}"
                cells.append(text + unit)
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--before", type=Path)
    for name, usual in (("--tick", 0.02), ("--runs", 5), ("--long", 2), ("--jobs", 1), ("--seed", 0)):
        parser.add_argument(name, type=type(usual), default=usual)
    parser.add_argument("--only", default="", help="part of the names of the faults")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path)
    if (given := parser.parse_args()).one:
        sys.setswitchinterval(5e-4)  # the thread that reads logs must not delay the plant
        print(json.dumps(measure(given.one, given.tick, given.seed)))
        return
    sources = ({} if given.before is None else {"before": given.before.resolve()}) | {"after": SOURCE}
    names = [name for name in (*FAULTS, *RATES) if given.only in name]
    rows = run(sources, given.tick, given.runs, given.long, given.jobs, names)
    info = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*: (.*)", info.read_text(encoding="utf-8")) if info.exists() else []
    machine = {
        "processor": (*names, platform.machine())[0],
        "processors": os.cpu_count(),
        "python": platform.python_version(),
    }
    document = {"machine": machine, "step": given.tick, "loops at a time": given.jobs, "rows": rows}
    print("\n".join(table(document)))
    if given.json:
        given.json.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
