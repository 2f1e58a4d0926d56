"""Nodes and links as processes on this machine, which a caller can start, kill, restart, and ask for reports."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from taciturn.errors import ProblemError
from taciturn.extend import ENDED, GRACE, LIFELINE, at_once
from taciturn.model.losses import law_text
from taciturn.model.packets import peers_of, plant_link, plant_links, receiver_of, roles, sender_of
from taciturn.model.policy import Policy
from taciturn.model.steps import Send
from taciturn.nodes.keys import KEY, Keys
from taciturn_udp.endpoint import free_addresses
from taciturn_udp.namespaces import Namespaces
from taciturn_udp.relay import Fate
from taciturn_udp.service import LISTENS

ASK = getattr(signal, "CTRL_BREAK_EVENT", signal.SIGTERM)  # on Windows SIGTERM acts like SIGKILL
PATIENCE = 60.0  # seconds in which a process must start to listen, and in which it must end


class Process:
    """A process that runs a ``taciturn`` command."""

    def __init__(
        self,
        arguments: Sequence[str],
        name: str = "a process",
        key: bytes | Keys | None = None,
        before: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Start the process."""
        command = [*before, sys.executable, "-m", "taciturn", *arguments]
        self._name = name
        known = {variable: value for variable, value in os.environ.items() if variable != KEY}
        secret = {} if key is None else {KEY: key.hex() if isinstance(key, bytes) else key.text()}
        self._errors: list[str] = []
        self._listens = threading.Event()
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,  # ends with this process, even if this process is killed
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            env=known | {"PYTHONIOENCODING": "utf-8"} | _ends_with_parent() | dict(environment or {}) | secret,
            process_group=0,  # Ctrl-C must reach only the parent process, which ends the others (POSIX)
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),  # the same for Windows
        )
        self._ended = ExitStack()
        self._ended.enter_context(at_once(self._process.kill))
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def alive(self) -> bool:
        """Whether the process is running."""
        return self._process.poll() is None

    def expect(self) -> None:
        """Wait until the process can receive datagrams at its address."""
        end = time.monotonic() + PATIENCE
        while not self._listens.wait(0.05):
            if not self.alive:
                raise ProblemError(self.sentence())
            if time.monotonic() > end:
                raise ProblemError(
                    f"{self._name} has not started within {PATIENCE:g} s; reduce the load on this machine, and run "
                    "again"
                )

    def sentence(self) -> str:
        """Return the last message that the process has printed to standard error."""
        if not self.alive:
            self._reader.join(1.0)
        said = [line.removeprefix("taciturn: ") for line in self._errors if LISTENS not in line and ENDED not in line]
        return (
            said[-1]
            if said
            else f"{self._name} has ended with code {self._process.poll()}; expected it to keep running"
        )

    def kill(self) -> None:
        """End the process immediately (SIGKILL)."""
        self._process.kill()
        self._process.wait()
        self._close()

    def pause(self, seconds: float) -> None:
        """Suspend the process, so that its clock seems to jump when it continues; not available on Windows."""
        if sys.platform == "win32":
            raise ProblemError(f"{self._name} cannot be suspended on Windows; expected Linux or macOS")
        self._process.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        self._process.send_signal(signal.SIGCONT)

    def stop(self) -> dict[str, Any]:
        """Ask the process to end, and return its report."""
        self._process.send_signal(ASK)
        assert self._process.stdout is not None
        try:
            self._process.wait(PATIENCE)
            return json.loads(self._process.stdout.read().splitlines()[-1])  # one line, which fits a pipe's buffer
        except subprocess.TimeoutExpired:
            self._process.kill()
            raise ProblemError(
                f"{self._name} has not ended within {PATIENCE:g} s and was killed; reduce the load on this machine, "
                "and run again"
            ) from None
        except (ValueError, IndexError):
            raise ProblemError(self.sentence()) from None
        finally:
            self._process.wait()
            self._close()

    def _close(self) -> None:
        self._ended.close()
        self._reader.join()
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            assert pipe is not None
            pipe.close()

    def _read(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self._errors.append(line.rstrip("\n"))
            if LISTENS in line:
                self._listens.set()


class Processes:
    """Processes of a policy's nodes: connected by relays on this machine, or in network namespaces."""

    def __init__(
        self,
        file: str,
        policy: Policy,
        fates: Mapping[str, Fate],
        *,
        tick: float | None = None,
        folder: Path | None = None,
        keeps: bool = False,
        options: Sequence[str] = (),
        key: bytes | Keys | None = None,
        namespaces: Namespaces | None = None,
        through: Mapping[str, str] | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Choose all addresses, and form the commands of nodes and relays."""
        self.file, self.policy, self.folder = file, policy, folder or Path()
        through = through or {}
        self._key, self._namespaces, self._environment = key, namespaces, environment
        self.links: list[str] = [step.link for step in policy.steps if isinstance(step, Send)]
        self.roles = roles(policy)
        relayed = self.links if namespaces is None else []
        names = [*self.roles, *(f"relay {link}" for link in relayed), *through.values(), "plant"]
        if namespaces is None:
            found = (f"{host}:{port}" for host, port in free_addresses(len(names)))
            self.addresses = dict(zip(names, found, strict=True))
        else:
            self.addresses = namespaces.addresses
        pace = [] if tick is None else ["--real-time", "--tick", repr(tick)]
        self.commands: dict[str, list[str]] = {}
        for link in relayed:
            self.commands[f"relay {link}"] = [
                "relay", "--bind", self.addresses[f"relay {link}"], "--peer", self.addresses[self.receiver(link)],
                *_options(fates[link]),
            ]  # fmt: skip
        for role in self.roles:
            arguments = ["node", role, file, "--bind", self.addresses[role], *pace, *options]
            for link, peer in self.peers(role).items():
                arguments += ["--peer", f"{link}={self.addresses[through.get(role, peer)]}"]
            arguments += ["--plant", self.addresses["plant"]] if plant_link(policy, role) else []
            if folder is not None:
                arguments += ["--log", str(folder / f"{role}.jsonl")]
                arguments += ["--state", str(folder / f"{role}.json")] if keeps else []
            self.commands[role] = arguments
        self.running: dict[str, Process] = {}
        flow: list[str] = []
        for role in self.roles:  # in the order of a step: every process before the receivers of its packets
            sent = [link for link in self.links if self.sender(link) == role]
            flow += [role, *([through[role]] if role in through else []), *(f"relay {link}" for link in sent)]
        self._flow = [name for name in flow if name in names]

    @property
    def measuring(self) -> dict[str, str]:
        """Address of the node that receives the measurements, for each link from the plant."""
        ends = plant_links(self.policy).items()
        return {link: self.addresses[one.measures] for link, one in ends if one.measures is not None}

    def start(self, *names: str) -> None:
        """Start the named processes, or all of them, and wait until they can receive datagrams at their addresses."""
        chosen = names or tuple(self.commands)
        for name in chosen:
            before = () if self._namespaces is None else self._namespaces.before(name)
            self.running[name] = Process(self.commands[name], f"the {name}", self._key, before, self._environment)
        for name in chosen:
            self.running[name].expect()

    def restart(self, name: str) -> None:
        """Kill a process and start it again; another thread may call this method."""
        self.running.pop(name).kill()
        self.start(name)

    def ended(self) -> bool:
        """Return whether a process has ended although it was not stopped."""
        return any(not process.alive for process in list(self.running.values()))

    def sentence(self) -> str:
        """Return the last message of a process that has ended although it was not stopped."""
        return next(process.sentence() for process in list(self.running.values()) if not process.alive)

    def stop(self) -> dict[str, dict[str, Any]]:
        """End all processes, and each receiver after its senders; return their reports by name."""
        return {name: self.running.pop(name).stop() for name in self._flow if name in self.running}

    def kill(self) -> None:
        """End all processes immediately."""
        for process in list(self.running.values()):
            process.kill()
        self.running.clear()

    def sender(self, link: str) -> str:
        """Return the role of the node that sends on a link."""
        return sender_of(self.policy, link)

    def receiver(self, link: str) -> str:
        """Return the role of the node that receives on a link."""
        return receiver_of(self.policy, link)

    def peers(self, role: str) -> dict[str, str]:
        """Return the partner of a node on each link: a relay, or the sender whose packets the node acknowledges."""
        relayed = self._namespaces is None
        return {
            link: f"relay {link}" if relayed and self.sender(link) == role else other
            for link, other in peers_of(self.policy, role).items()
        }


def _ends_with_parent() -> dict[str, str]:
    """Return the environment variables of a process that ends with its parent, which waits for its report."""
    return {LIFELINE: "1", GRACE: str(PATIENCE)}


def _options(fate: Fate) -> list[str]:
    """Return link impairments as options of ``taciturn relay``."""
    options = ["--seed", str(fate.seed)]
    for name in ("loss", "delay", "jitter", "hold", "duplicate", "reorder", "corrupt"):
        if getattr(fate, name):
            options += [f"--{name}", repr(getattr(fate, name))]
    if fate.outage is not None:
        options += ["--outage", "{},{}".format(*fate.outage)]
    if fate.burst is not None:
        options += ["--burst", law_text(fate.burst)]
    options += [] if fate.late is None else ["--late", fate.late.text()]
    return options
