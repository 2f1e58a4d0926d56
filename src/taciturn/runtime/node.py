"""A node of a policy as a state machine: packets in, packets and the plant's input out; no socket, no clock, no thread.

Packets may be late, doubled, reordered or replayed: ``taciturn.runtime.inbox`` says what becomes of each. Where
something happens that the theory of the policy does not know, the node is *degraded* for as long as the loop takes to
forget it; ``Node.reasons`` counts what it was.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from math import isfinite
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from taciturn._arrays import count, instance
from taciturn.errors import ProblemError
from taciturn.model.network import Network
from taciturn.model.packets import fingerprint
from taciturn.model.places import place_of
from taciturn.model.policy import NodeName, Policy
from taciturn.program.draws import seed_generators
from taciturn.program.layout import lay_out
from taciturn.program.node import lower_node
from taciturn.program.python import compile_python
from taciturn.runtime.inbox import Inbox, Stream
from taciturn.runtime.packet import Packet

CAUGHT_UP = 10_000  # ticks that a node which has slept makes up for
FORMAT = 1  # of a saved state
Values: TypeAlias = tuple[float, ...]
Safe: TypeAlias = Literal["hold", "zero"] | Sequence[float]


class Stepped(NamedTuple):
    """What a node does in a tick.

    Args:
        packets: to be sent.
        input: of the plant, where the node has the actuator; else None.
    """

    packets: tuple[Packet, ...]
    input: Values | None


class Node:
    """One place of a policy: sensor, controller or actuator, or those of them that share it.

    Args:
        policy: whose node this is.
        role: ``"sensor"``, ``"controller"`` or ``"actuator"``; a place that the controller shares is the controller's.
        network: omitted: that of the design.
        epoch: larger than at any earlier start of this node without its state, as the seconds of a clock.
        seed: of the policy's draws.
        loop: which of many loops.
        watchdog: ticks without a packet or a mark after which the input is the safe one; omitted: never.
        safe: the safe input: ``"hold"`` (the last one), ``"zero"``, or numbers.

    Raises:
        ProblemError: a role that shares the controller's place, nodes that cannot be separated, a watchdog where
            nothing arrives or no input leaves, or a safe input of another size.

    Example:
        >>> from taciturn import load
        >>> policy = load("two-mass").design()
        >>> controller, actuator = Node(policy, "controller"), Node(policy, "actuator")
        >>> packets, _ = controller.step(0, measurement=[0.5, 0.5])
        >>> len(packets), actuator.step(0, packets=packets).input == packets[0].values
        (1, True)
    """

    def __init__(
        self,
        policy: Policy,
        role: NodeName,
        *,
        network: Network | None = None,
        epoch: int = 0,
        seed: int = 0,
        loop: int = 0,
        watchdog: int | None = None,
        safe: Safe = "hold",
    ) -> None:
        """Lower the node and start before its first tick."""
        instance("policy", policy, Policy)
        self.policy, self.role = policy, role
        self.network = policy.network if network is None else network
        self.loop, self.epoch = count("loop", loop, 0), count("epoch", epoch, 0)
        count("seed", seed, 0)
        self.fingerprint = fingerprint(policy, self.network)
        self.program = program = lower_node(policy, place_of(policy, role), self.network)
        self._parts = [compile_python(part) for part in program.parts]
        self._draw = None if program.draws is None else compile_python(program.draws)
        self._tables = [tuple(place.table.tolist()) for place in program.clocks]
        self.counters: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self._layout = layout = lay_out(policy, program)
        self._inputs = [0.0] * len(layout.inputs)
        streams = {(one.kind, one.link): Stream(one.lag, one.at, one.size, one.part) for one in layout.arrivals}
        self.inbox = Inbox(streams, self.loop, self.network.protocol == "ideal", self.counters, self._degrade)
        # of each link, which tick its sender must have finished before tick k may begin: k less this
        self.listens: dict[str, int] = {link: stream.lag for (_, link), stream in self.inbox.streams.items()}
        self._watchdog = None if watchdog is None else count("watchdog", watchdog)
        if watchdog is not None and (layout.applied is None or not program.hears):
            raise ProblemError(
                f"a watchdog is given for the {role}, which "
                f"{'has no input to make safe' if layout.applied is None else 'listens to no link'}; "
                "expected it at an actuator that packets reach"
            )
        self._safe = _safe_input(safe, policy.model.inputs)
        self.acknowledges = tuple(one.link for one in layout.arrivals if one.acknowledged)
        self.tick = -1
        self._memory: Sequence[Any] = [state.start for state in program.parts[0].states]
        self._generator: Sequence[Any] = seed_generators(seed, 1).view(np.uint64)[:, 0].tolist()
        self._places = [place.initial for place in program.clocks]
        self._sequences: Counter[str] = Counter()
        self._input: Values = (0.0,) * policy.model.inputs
        self._heard_at, self._degraded_until = -1, -1
        self.options: dict[str, float] = {}

    @property
    def measures(self) -> bool:
        """Whether the node has the sensor, and a step wants a measurement."""
        return "sensor" in self.program.site

    @property
    def actuates(self) -> bool:
        """Whether the node has the actuator, and a step gives the input of the plant."""
        return self._layout.applied is not None

    @property
    def memory(self) -> dict[str, list[float]]:
        """What the node remembers, by the names that the policy's steps give it."""
        found: dict[str, list[float]] = {}
        for state, value in zip(self.program.parts[0].states, self._memory, strict=True):
            if not state.word:
                found.setdefault(state.name, []).append(value)
        return found

    @property
    def degraded(self) -> bool:
        """Whether something has happened that the theory of the policy does not know, and is not forgotten yet."""
        return self.tick < self._degraded_until

    @property
    def silent(self) -> bool:
        """Whether nothing has been heard for so long that the input is the safe one."""
        return self._watchdog is not None and self.tick - self._heard_at >= self._watchdog

    def step(
        self,
        tick: int,
        measurement: Sequence[float] | None = None,
        packets: Iterable[Packet] = (),
        draws: Sequence[float] | None = None,
    ) -> Stepped:
        """Go through one tick.

        A tick that is not later than the last one is not gone through again. Ticks that were left out are made up for
        without packets and input, and by a node that measures left out: then the node is degraded.

        Args:
            tick: its number, from 0.
            measurement: y, (p,), where the node has the sensor.
            packets: that have come since the last step, in any order.
            draws: uniform numbers for the draws of the policy; omitted: the node's own.

        Returns:
            The packets to send, and the input where the node has the actuator.

        Raises:
            ProblemError: a measurement is missing, has another size, or is no finite number.
        """
        y = self._measured(measurement)
        if self.sort_in(packets):
            self._heard_at = max(tick, self.tick)
        if tick <= self.tick:
            self.counters["repeated"] += 1
            return Stepped((), self._output())
        sent: list[Packet] = []
        missed = tick - self.tick - 1
        if missed:
            joins = self.tick < 0
            if joins:
                self._heard_at = tick - 1
            else:
                self.counters["missed"] += missed
            if not joins and not self.measures:
                for behind in range(max(self.tick + 1, tick - CAUGHT_UP), tick):
                    sent += self._advance(behind, y, None)
            self._degrade("joined" if joins else "missed", tick)
        sent += self._advance(tick, y, draws)
        return Stepped(tuple(sent), self._output())

    @property
    def talks(self) -> bool:
        """Whether the node sends packets."""
        return bool(self._layout.departures or self.acknowledges)

    def mark(self) -> tuple[Packet, ...]:
        """Return the packets that tell those who listen that this node lives and has finished the tick."""
        links = (*(one.link for one in self._layout.departures), *self.acknowledges)
        return tuple(self._packet("mark", link) for link in links)

    def sort_in(self, packets: Iterable[Packet]) -> bool:
        """Take packets for the ticks to come, and tell whether any is new; ``step`` does so with its own."""
        news = [self.inbox.take(packet, self.tick) for packet in packets]
        if any(news):
            self._heard_at = self.tick + 1
        return any(news)

    def save(self) -> dict[str, Any]:
        """Return all that the node remembers, as JSON holds it."""
        return {
            "format": FORMAT, "fingerprint": f"{self.fingerprint:016x}", "role": self.role, "loop": self.loop,
            "epoch": self.epoch, "tick": self.tick, "memory": list(self._memory), "generator": list(self._generator),
            "inputs": list(self._inputs), "places": list(self._places), "inbox": self.inbox.save(),
            "sequences": dict(self._sequences), "input": list(self._input), "heard_at": self._heard_at,
            "degraded_until": self._degraded_until, "counters": dict(self.counters), "reasons": dict(self.reasons),
        }  # fmt: skip

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Go on from what was saved.

        Raises:
            ProblemError: it is no saved state, or that of another policy, role or loop.
        """
        try:
            known = {"role": self.role, "loop": self.loop, "fingerprint": f"{self.fingerprint:016x}", "format": FORMAT}
            for name, expected in known.items():
                if saved[name] != expected:
                    raise ProblemError(
                        f"the saved state has the {name} {saved[name]!r}; expected {expected!r}: that of this node"
                    )
            if len(saved["memory"]) != len(self._memory) or len(saved["inputs"]) != len(self._inputs):
                raise ValueError("it remembers another number of things")
            self.inbox.restore(saved["inbox"])
            self.epoch, self.tick = saved["epoch"], saved["tick"]
            self._memory, self._generator = saved["memory"], saved["generator"]
            self._inputs, self._places = list(saved["inputs"]), list(saved["places"])
            self._sequences, self._input = Counter(saved["sequences"]), tuple(saved["input"])
            self._heard_at, self._degraded_until = saved["heard_at"], saved["degraded_until"]
            for counter, kept in ((self.counters, saved["counters"]), (self.reasons, saved["reasons"])):
                counter.clear()
                counter.update(kept)
        except ProblemError:
            raise
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ProblemError(f"this is no saved state of a node ({error!r}); expected what Node.save gave") from None

    def _measured(self, measurement: Sequence[float] | None) -> Values:
        if not self.measures:
            return ()
        found = () if measurement is None else tuple(map(float, measurement))
        if len(found) != self.policy.model.outputs or not all(map(isfinite, found)):
            raise ProblemError(
                f"the measurement of the {self.role} is {measurement}; "
                f"expected {self.policy.model.outputs} finite numbers at each tick"
            )
        return found

    def _advance(self, tick: int, y: Values, draws: Sequence[float] | None) -> list[Packet]:
        """Finish the tick before and go through this one as far as its outputs."""
        inputs, layout, sent = self._inputs, self._layout, list[Packet]()
        if len(self._parts) > 1 and self.tick >= 0:
            sent += self._collect(1, self.tick + 1)
            self._memory, _ = self._parts[1](self._memory, [inputs[i] for i in layout.wiring[1]])
        self._turn_clocks(tick)
        self.tick = tick
        inputs[: len(y)] = y
        sent += self._collect(0, tick)
        if self._draw is not None:
            self._generator, drawn = self._draw(self._generator, ())
            inputs[layout.drawn] = drawn if draws is None else draws
        self._memory, outputs = self._parts[0](self._memory, [inputs[i] for i in layout.wiring[0]])
        for link, at, size in layout.departures:
            if outputs[at]:
                sent.append(self._packet("data", link, outputs[at + 1 : at + 1 + size]))
        if layout.applied is not None and not self.silent:
            self._input = outputs[layout.applied]
        self.options = {name: outputs[i] for name, i in layout.options.items()}
        return sent

    def _collect(self, part: int, tick: int) -> list[Packet]:
        """Take the packets that a part wants, and return the acknowledgements."""
        found = self.inbox.collect(part, tick, self._inputs)
        told = [packet for packet in found if packet.kind == "data" and packet.link in self.acknowledges]
        return [self._packet("acknowledgement", packet.link, tick=packet.tick) for packet in told]

    def _turn_clocks(self, tick: int) -> None:
        """Set every clock by the number of the tick."""
        for i, (place, table) in enumerate(zip(self.program.clocks, self._tables, strict=True)):
            here, turns = self._places[i], tick - max(self.tick, 0)
            if turns > len(table):  # where it repeats, whole rounds change nothing
                turns = len(table) + (turns - len(table)) % place.period
            for _ in range(turns):
                here = table[here]
            self._places[i] = here
            self._inputs[self._layout.clocks + i] = float(here)

    def _packet(self, kind: Any, link: str, values: Values = (), tick: int | None = None) -> Packet:
        name = f"{kind} {link}"
        if self._sequences[name] > 0xFFFFFFFF:
            self.epoch, self._sequences = self.epoch + 1, Counter()
        packet = Packet(
            kind, link, self.tick if tick is None else tick, self._sequences[name], values, self.epoch, self.loop
        )
        self._sequences[name] += 1
        self.counters[f"sent {name}"] += 1
        return packet

    def _output(self) -> Values | None:
        if self._layout.applied is None:
            return None
        return self._safe if self.silent and self._safe is not None else self._input

    def _degrade(self, reason: str, tick: int | None = None) -> None:
        self.reasons[reason] += 1
        self._degraded_until = max(
            self._degraded_until, (self.tick if tick is None else tick) + 1 + self._layout.remembers
        )


def _safe_input(safe: Safe, inputs: int) -> Values | None:
    """Return the safe input, or None for the last one."""
    if safe == "hold":
        return None
    values = (0.0,) * inputs if safe == "zero" else safe
    if isinstance(values, str) or len(values) != inputs or not all(isfinite(value) for value in values):
        raise ProblemError(f"the safe input is {safe!r}; expected 'hold', 'zero' or {inputs} finite numbers")
    return tuple(float(value) for value in values)
