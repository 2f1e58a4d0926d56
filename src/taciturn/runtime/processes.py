"""Nodes and links as processes of this machine: started, killed, started again, and asked for their counters."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from taciturn.errors import ProblemError
from taciturn.model.places import place_of, role_at, roles
from taciturn.model.policy import ENDS, LinkName, NodeName, Policy, Send
from taciturn.runtime.launch import Fork
from taciturn.runtime.namespaces import Namespaces
from taciturn.runtime.relay import Fate
from taciturn.runtime.service import LISTENS
from taciturn.runtime.udp import free_addresses

PATIENCE = 60.0  # seconds until a process that starts must listen


class Process:
    """One process of the command line.

    Args:
        arguments: of ``taciturn``.
        name: that it goes by in sentences.
        environment: variables beside those of this process.
        namespace: file of the network namespace in which it runs; omitted: that of this process.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        name: str = "a process",
        environment: Mapping[str, str] | None = None,
        namespace: Path | None = None,
    ) -> None:
        """Start it."""
        self._name = name
        self._errors: list[str] = []
        self._listens = threading.Event()
        self._process = Fork(arguments, {**os.environ, **(environment or {})}, namespace)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        """Its number."""
        return self._process.pid

    def expect(self) -> None:
        """Wait until it listens.

        Raises:
            ProblemError: it has ended, with its own sentence, or does not listen in time.
        """
        end = time.monotonic() + PATIENCE
        while not self._listens.wait(0.05):
            if not self.alive:
                raise ProblemError(self.sentence())
            if time.monotonic() > end:
                raise ProblemError(f"{self._name} does not listen after {PATIENCE:g} s; expected it to be faster")

    def sentence(self) -> str:
        """Return what it said when it ended."""
        if not self.alive:
            self._reader.join(1.0)
        said = [line.removeprefix("taciturn: ") for line in self._errors if LISTENS not in line]
        return said[-1] if said else f"{self._name} has ended with code {self._process.poll()}; expected it to run"

    def kill(self) -> None:
        """End it without a chance to do anything (SIGKILL)."""
        self._process.send(signal.SIGKILL)
        self._process.wait()
        self._close()

    def pause(self, seconds: float) -> None:
        """Stop it for a while, so that its clock jumps."""
        self._process.send(signal.SIGSTOP)
        time.sleep(seconds)
        self._process.send(signal.SIGCONT)

    def stop(self) -> dict[str, Any]:
        """Ask it to end, and return its report.

        Raises:
            ProblemError: it gives none, or does not end in time.
        """
        self._process.send(signal.SIGTERM)
        if self._process.wait(PATIENCE) is None:
            self.kill()
            raise ProblemError(f"{self._name} has not ended after {PATIENCE:g} s; expected it to be faster")
        try:
            return json.loads(self._process.stdout.read().splitlines()[-1])  # one line, which a pipe holds
        except (ValueError, IndexError):
            raise ProblemError(self.sentence()) from None
        finally:
            self.kill()

    def _close(self) -> None:
        self._reader.join()
        self._process.close()

    def _read(self) -> None:
        for line in self._process.stderr:
            self._errors.append(line.rstrip("\n"))
            if LISTENS in line:
                self._listens.set()


class Processes:
    """The nodes of a policy, with a relay on each of its links on the loopback, or in namespaces, without relays.

    Args:
        file: problem file, or the name of a built-in problem.
        policy: its policy.
        fates: what befalls the packets of each link, where there are relays.
        tick: real seconds per tick; omitted: lockstep.
        folder: where each node logs its ticks (``ROLE.jsonl``) and keeps its state (``ROLE.json``).
        options: further options of every node.
        environment: variables of every process.
        namespaces: where the nodes run; omitted: on the loopback.
        through: a further process that the packets of a node go to first; whoever names it gives its command.
    """

    def __init__(
        self,
        file: str,
        policy: Policy,
        fates: Mapping[LinkName, Fate],
        *,
        tick: float | None = None,
        folder: Path | None = None,
        keeps: bool = False,
        options: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
        namespaces: Namespaces | None = None,
        through: Mapping[NodeName, str] | None = None,
    ) -> None:
        """Give everybody an address."""
        self.file, self.policy, self.folder = file, policy, folder or Path()
        through = through or {}
        self._environment, self._namespaces = environment, namespaces
        self.links: list[LinkName] = [step.link for step in policy.steps if isinstance(step, Send)]
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
            peer = through.get(role, self.peer(role))
            arguments += ["--peer", self.addresses[peer]] if peer else []
            site = place_of(policy, role)
            arguments += ["--plant", self.addresses["plant"]] if {"sensor", "actuator"} & site else []
            if folder is not None:
                arguments += ["--log", str(folder / f"{role}.jsonl")]
                arguments += ["--state", str(folder / f"{role}.json")] if keeps else []
            self.commands[role] = arguments
        self.running: dict[str, Process] = {}
        flow = ["sensor", through.get("sensor"), "relay sensor", "controller", "relay actuator", "actuator"]
        self._flow = [name for name in flow if name in names]

    @property
    def measuring(self) -> NodeName:
        """The node that the plant tells its measurements."""
        return role_at(self.policy, "sensor")

    def start(self, *names: str) -> None:
        """Start processes by name (omitted: all), and wait until they listen.

        Raises:
            ProblemError: one has ended.
        """
        chosen = names or tuple(self.commands)
        for name in chosen:
            file = None if self._namespaces is None else self._namespaces.file(name)
            self.running[name] = Process(self.commands[name], f"the {name}", self._environment, file)
        for name in chosen:
            self.running[name].expect()

    def restart(self, name: str) -> None:
        """Kill a process, and start it again; it may be called in a thread of its own."""
        self.running.pop(name).kill()
        self.start(name)

    def ended(self) -> bool:
        """Tell whether a process has ended by itself."""
        return any(not process.alive for process in list(self.running.values()))

    def sentence(self) -> str:
        """Return what a process said that has ended by itself."""
        return next(process.sentence() for process in list(self.running.values()) if not process.alive)

    def stop(self) -> dict[str, dict[str, Any]]:
        """End all, each after those that send to it, and return their reports by name."""
        return {name: self.running.pop(name).stop() for name in self._flow if name in self.running}

    def kill(self) -> None:
        """End all at once."""
        for process in list(self.running.values()):
            process.kill()
        self.running.clear()

    def sender(self, link: LinkName) -> NodeName:
        """Return the node that sends on a link."""
        at = next(step.at for step in self.policy.steps if isinstance(step, Send) and step.link == link)
        return role_at(self.policy, at)

    def receiver(self, link: LinkName) -> NodeName:
        """Return the node where a link ends."""
        return role_at(self.policy, ENDS[link])

    def peer(self, role: NodeName) -> str | None:
        """Return who gets what a node sends: a relay, the next node, or the sender where it only acknowledges."""
        site = place_of(self.policy, role)
        for step in self.policy.steps:
            if isinstance(step, Send) and step.at in site:
                return f"relay {step.link}" if self._namespaces is None else self.receiver(step.link)
        heard = [step for step in self.policy.steps if isinstance(step, Send) and ENDS[step.link] in site]
        return role_at(self.policy, heard[0].at) if heard else None


def _options(fate: Fate) -> list[str]:
    """Return a fate as options of ``taciturn relay``."""
    burst = fate.burst
    options = ["--seed", str(fate.seed)]
    for name in ("loss", "delay", "jitter", "hold", "duplicate", "reorder", "corrupt"):
        if getattr(fate, name):
            options += [f"--{name}", repr(getattr(fate, name))]
    if fate.outage is not None:
        options += ["--outage", "{},{}".format(*fate.outage)]
    if burst is not None:
        options += ["--burst", f"{burst.to_bad!r},{burst.to_good!r},{burst.loss_good!r},{burst.loss_bad!r}"]
    return options
