"""A node of a policy as a state machine: it receives packets, and returns the packets to send and the plant input.

The state machine uses no socket, no time and no thread. A step runs the program of the node's site
(``program.node``), in one or two parts:

    packets, measurement → part 0 → packets, plant input    …    packets of the step → part 1, when the next step begins

Packets may be late, duplicated, reordered or replayed; ``inbox`` defines how each case is handled. After an event that
violates an assumption of the policy's theory, the node is *degraded* until the loop no longer depends on the event,
seven time constants later. ``Node.reasons`` counts these events. A watchdog applies a safe input while all links are
silent.

A saved state has a digest, which shows that it is the state that was saved. It detects damage, such as a bad sector or
an edited file. It is no signature: whoever can write the file can also write its digest.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from math import isfinite
from typing import Any, Literal, NamedTuple, TypeAlias, cast

import numpy as np

from taciturn._arrays import ArrayLike, array, count, instance
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.model.network import Network
from taciturn.model.packets import fingerprint, place_of
from taciturn.model.policy import Policy, longest_silence
from taciturn.model.silence import Life, lives_of
from taciturn.model.wire import LARGEST, fits
from taciturn.nodes.inbox import USABLE, Handling, Inbox, streams_of
from taciturn.nodes.packet import Packet
from taciturn.program.draws import seed_generators
from taciturn.program.manual import not_operable
from taciturn.program.node import (
    Layout,
    NodeProgram,
    acts_at_once,
    first_inputs,
    lay_out,
    only_applies,
    translate_node,
)
from taciturn.program.ops import Option
from taciturn.program.python import CompiledStep, compile_python

_SEAL = "digest"
_CAUGHT_UP = 10_000  # largest number of missed steps that a node executes later
FORMAT = 6  # format version of a saved state
Values: TypeAlias = tuple[float, ...]
Measurement: TypeAlias = tuple[float | None, ...]  # None in place of an output whose sample is missing
Safe: TypeAlias = Literal["hold", "zero"] | Sequence[float]


def _within(name: str, value: object, size: int) -> int:
    """Return a whole number that a field of so many bytes in a packet can carry."""
    found = count(name, value, 0)
    if found >= 256**size:
        raise ProblemError(f"{name} is {found}; expected a whole number below 2^{8 * size}, which a packet can carry")
    return found


class Stepped(NamedTuple):
    """Output of a node in one step: the packets to send, and the plant input."""

    packets: tuple[Packet, ...]  # packets to send
    # plant input if the node contains the actuator, else None; if packets arrive within a period, one for each piece of
    # the period (``Node.pieces``), one after the other
    input: Values | None


class SetPoints(NamedTuple):
    """Set-points of a controller: those that it was given, and those in effect, within their range and ramp."""

    given: Values
    in_effect: Values


class Node:
    """A node of a policy: sensor, controller or actuator, or several of these at the same site.

    Args:
        policy: policy that contains the node.
        role: name of the node, such as ``"sensor"``; the controller's name for a node that shares its site.
        network: network between the nodes; default: the network of the design.
        epoch: number that must increase with every start of this node without its state, e.g. Unix time in seconds.
        seed: seed of the policy's random draws.
        loop: number of this loop among loops that share the network.
        watchdog: number of steps without data or a mark on a link after which this link is silent and the node is
            degraded, or ``max_interval`` of a link without losses, if it is smaller. If all links are silent, the
            node is silent, and an actuator applies the safe input. Default: no watchdog.
        safe: safe input: ``"hold"`` (the last input), ``"zero"``, or numbers; None: the input of the policy.

    Raises:
        ProblemError: the role is at the same site as the controller, the nodes cannot be separated, the node has a
            watchdog but receives no packets, or the safe input has the wrong size.

    Example:
        >>> from taciturn import load
        >>> policy = load("two-mass-lqg").design()
        >>> controller, actuator = Node(policy, "controller"), Node(policy, "actuator")
        >>> packets, _ = controller.step(0, measurement=[0.5, 0.5])
        >>> len(packets), actuator.step(0, packets=packets).input == packets[0].values
        (1, True)
    """

    def __init__(
        self,
        policy: Policy,
        role: str,
        *,
        network: Network | None = None,
        epoch: int = 0,
        seed: int = 0,
        loop: int = 0,
        watchdog: int | None = None,
        safe: Safe | None = "hold",
    ) -> None:
        """Compile the program of the node, and set the state before its first step."""
        instance("policy", policy, Policy)
        self.policy, self.role = policy, role
        self.network = policy.network if network is None else network
        self.loop, self.epoch = _within("loop", loop, 2), _within("epoch", epoch, 4)
        count("seed", seed, 0)
        compiled = _compile(policy, role, self.network)
        self.fingerprint, self.program, self._layout, self._parts, self._draw, self._tables = compiled
        program, layout = self.program, self._layout
        self.counters: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self._inputs = first_inputs(policy, layout)
        streams = streams_of(layout.arrivals)
        self.inbox = Inbox(streams, self.loop, self.network.protocol == "ideal", self.counters, self._degrade)
        # step k may begin when the sender on a link has finished step k minus this lag
        self.listens = {link: stream.lag for (_, link), stream in streams.items() if not stream.kept}
        self.watchdog = None if watchdog is None else count("watchdog", watchdog)
        if watchdog is not None and not program.hears:
            raise ProblemError(
                f"a watchdog is given for the {role}, which receives no packets; expected a node that receives packets"
            )
        self._applied = 0 if layout.applied is None else layout.applied.stop - layout.applied.start
        self._safe = None if safe is None else _safe_input(safe, self._applied // self.pieces, self.pieces)
        self._follows = safe is None  # the input of the policy, also while the node is silent
        self.acknowledges = tuple(one.link for one in layout.arrivals if one.acknowledged)
        self.tick = -1
        self._start: Sequence[Any] = [state.start for state in program.parts[0].states]
        self._memory = self._start
        self._generator: Sequence[Any] = seed_generators(seed, 1).view(np.uint64)[:, 0].tolist()
        self._places = [place.initial for place in program.clocks]
        self._sequences: Counter[str] = Counter()
        self._input: Values = (0.0,) * self._applied
        self._limited: Values | None = None  # the set-points within their limits, after a step
        self.limits: dict[str, int] = {}  # steps without a packet after which a link is silent
        if watchdog is not None:
            intervals = {link: longest_silence(self.network, link) for link in program.hears}
            self.limits = {link: min(watchdog, steps or watchdog) for link, steps in intervals.items()}
        self._heard_at = dict.fromkeys(program.hears, -1)
        self._degraded_until = -1
        self._unheard = False  # whether the watchdog has expired while no step begins
        self._sent_at: dict[str, int] = {}  # last step with a packet, by link
        self._told: set[tuple[str, int]] = set()  # link and step of packets that ``so_far`` has acknowledged
        self.options: dict[Option, float] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Return the contents of a pickle: all but the compiled functions."""
        return {name: value for name, value in vars(self).items() if name not in ("_parts", "_draw")}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        """Restore a pickle, and compile the functions."""
        vars(self).update(state)
        compiled = _compile(self.policy, self.role, self.network)
        self._parts, self._draw = compiled.parts, compiled.draw

    @property
    def measures(self) -> bool:
        """True if the node measures outputs, so that each step takes a measurement."""
        return self._layout.measured > 0

    @property
    def measured(self) -> int:
        """Number of outputs that the node measures."""
        return self._layout.measured

    @property
    def actuates(self) -> bool:
        """True if the node applies inputs, so that each step returns the plant input."""
        return self._layout.applied is not None

    @property
    def pieces(self) -> int:
        """Number of inputs of the plant that the node applies one after the other in a step, usually one."""
        return self.program.acting

    @property
    def memory(self) -> dict[str, list[float]]:
        """Values of the signals that the node stores from one step to the next, by the signal's name."""
        found: dict[str, list[float]] = {}
        for state, value in zip(self.program.parts[0].states, self._memory, strict=True):
            if not state.word:
                found.setdefault(state.name, []).append(value)
        return found

    @property
    def silence(self) -> tuple[Life, ...]:
        """Cost that the node has added by not sending, since the node was started; empty if its policy does not compute
        it.
        """
        return lives_of(self.policy.theory.silence, self.memory)

    @property
    def waiting(self) -> int:
        """Number of packets that have arrived early and wait for their step."""
        return self.inbox.waiting

    @property
    def readings(self) -> dict[tuple[str, str], Values | None]:
        """Payloads that the last step has read, by kind of packet and link; None if no packet arrived.

        On a link with random delays, it is that of the newest packet, and of acknowledgements the inputs of the step.
        """
        inputs, found = self._inputs, dict[tuple[str, str], Values | None]()
        for one in self._layout.arrivals:
            at = one.at + max(one.pieces - 1, 0) * (1 + one.size) if not one.ages else one.at
            come = (one.at + age * (1 + one.size) for age in range(one.every))
            at = next((place for place in come if inputs[place]), at)
            values = inputs[at : at + one.ages] or inputs[at + 1 : at + 1 + one.size]
            found[one.kind, one.link] = tuple(values) if inputs[at] or one.ages else None
        return found

    @property
    def set_points(self) -> SetPoints | None:
        """Set-points that the node was given, and those in effect in the last step; None if it is given none."""
        one = next((one for one in self._layout.arrivals if one.kind == "measurement"), None)
        if one is None:
            return None
        given = tuple(self._inputs[one.at + 1 : one.at + 1 + one.size])
        return SetPoints(given, given if self._limited is None else self._limited)

    @property
    def manual(self) -> Values | None:
        """Inputs of the plant, (m,), that a controller commands in place of its own while operation is manual; None if
        it is automatic.

        They are in the units of the plant, and remain until others are assigned or arrive. The filter and the integrals
        of the controller follow them. The node is degraded, because its decisions are not those of the theory.

        Raises:
            ProblemError: the node is no controller, the policy cannot be operated by hand, or the inputs are not m
                finite numbers.
        """
        at = self._layout.manual
        if at is None or self._inputs[at] <= 0.0:
            return None
        return tuple(self._inputs[at + 1 : at + 1 + self.policy.model.inputs])

    @manual.setter
    def manual(self, values: Sequence[float] | None) -> None:
        """Set the manual inputs, or None for automatic operation."""
        at = self._layout.manual
        if at is None and values is not None:
            if self.policy.network.controller not in self.program.site:
                raise ProblemError(
                    f"a manual input is given to the node {self.role}; expected the node of the controller, "
                    f"{self.policy.network.controller}"
                )
            raise not_operable(self.policy)
        if at is not None:
            self._inputs[at] = float(values is not None)
        if at is not None and values is not None:
            self._inputs[at + 1 : at + 1 + self.policy.model.inputs] = by_hand(self.policy, values)

    @property
    def operable(self) -> bool:
        """True if an operator may give the inputs in place of this node."""
        return self._layout.manual is not None

    @property
    def remembers(self) -> int:
        """Number of steps after which an event outside the theory has a negligible effect: seven time constants."""
        return self._layout.remembers

    @property
    def degraded(self) -> bool:
        """True if an event that violates an assumption of the theory still affects the loop."""
        return self.tick < self._degraded_until

    @property
    def silent_links(self) -> tuple[str, ...]:
        """Links whose watchdog has expired, because neither a packet nor a mark (heartbeat) arrived within the time
        limit.
        """
        return self._silent_in(self.tick)

    def _silent_in(self, tick: int) -> tuple[str, ...]:
        """Return the links that are silent in a step if no further packet arrives before it."""
        late = {link for link, limit in self.limits.items() if tick - self._heard_at[link] >= limit}
        return tuple(link for link in self._heard_at if self._unheard or link in late)

    @property
    def silent(self) -> bool:
        """True if the watchdogs of all links on which the node receives packets have expired."""
        return bool(self._heard_at) and len(self.silent_links) == len(self._heard_at)

    def step(
        self,
        tick: int,
        measurement: Sequence[float | None] | None = None,
        packets: Iterable[Packet] = (),
        draws: Sequence[float] | None = None,
    ) -> Stepped:
        """Execute one step of the policy with a measurement and packets; return the packets to send and the plant
        input.

        If the step is not later than the last one, the node does not execute it again. If steps were missed, a node
        without a sensor first executes them without packets, a node with a sensor skips them, and the node is degraded.

        Args:
            tick: number of the step, from 0.
            measurement: measurement y, (p,), if the node contains the sensor. None in place of an output, or of all,
                states that it is missing: the filter of the node then uses its prediction, and a node without a filter
                its last measurement. The step counts as ``missing``, and the node is degraded.
            packets: packets received since the last step, in any order.
            draws: uniform random numbers for the policy; default: numbers from the node's own generator.

        Returns:
            The packets to send, and the plant input if the node contains the actuator.

        Raises:
            ProblemError: the measurement has the wrong size, or is not finite; the number of the step is no whole
                number that a packet can carry, or ``packets`` contains something else.
        """
        tick = _within("tick", tick, 8)
        y, known = self._measured(measurement)
        for packet in packets:
            instance("packets", packet, Packet)
            self.sort_in(packet)
        for link, heard in self._heard_at.items():
            if heard > self.tick:  # packets that arrived after the last step count from this step on
                self._heard_at[link] = max(heard, tick)
        if tick <= self.tick:
            self.counters["repeated"] += 1
            return Stepped((), self._output())
        sent: list[Packet] = []
        missed = tick - self.tick - 1
        if missed:
            joins = self.tick < 0
            if joins:
                self._heard_at = dict.fromkeys(self._heard_at, tick - 1)
            else:
                self.counters["missed"] += missed
            if not joins and not self.measures:
                for behind in range(max(self.tick + 1, tick - _CAUGHT_UP), tick):
                    sent += self._advance(behind, y, None)
            self._degrade("joined" if joins else "missed", tick)
        if not all(known):
            self.counters["missing"] += 1
            self._degrade("missing", tick)
        sent += self._advance(tick, (*y, *map(float, known)), draws)
        return Stepped(tuple(sent), self._output())

    @property
    def acts_at_once(self) -> bool:
        """True if the node applies packets to the plant that a link may delay at random, also within a step."""
        return acts_at_once(self.program, self._layout)

    def check_acting(self) -> None:
        """Raise an error if the node cannot apply each packet when it arrives, as it does more in a step."""
        if not only_applies(self.program, self._layout):
            raise ProblemError(
                f"the {self.role} of this {self.policy.kind} policy does more than to apply packets over a link with "
                "random delays, so that it cannot apply each when it arrives; expected an actuator at a site of its "
                "own, or virtual time"
            )

    def so_far(self, tick: int) -> Stepped:
        """Return what a step does if no further packet arrives in it, so that a packet can act when it arrives.

        The step itself is executed after its end, with all its packets, and does not return the acknowledgements again.

        Args:
            tick: number of the step, the first one that has not been executed.

        Returns:
            The acknowledgements of the packets that have arrived since the last call, and the input in all pieces of
            the step, of which the last one is that of the newest packet.

        Raises:
            ProblemError: the node does not apply packets of a link with random delays, or it measures or draws too.
        """
        self.check_acting()
        layout, inputs = self._layout, list(self._inputs)
        for i, place in enumerate(self._places_in(tick)):
            inputs[layout.clocks + i] = float(place)
        come = self.inbox.so_far(0, tick, inputs)
        told = [one for one in come if one.link in self.acknowledges and (one.link, one.tick) not in self._told]
        self._told |= {(one.link, one.tick) for one in told}
        memory = self._memory
        if len(self._parts) > 1 and self.tick >= 0:  # the step before has read its packets, and is finished with them
            memory, _ = self._parts[1](memory, [self._inputs[i] for i in layout.wiring[1]])
        _, outputs = self._parts[0](memory, [inputs[i] for i in layout.wiring[0]])
        given = outputs[cast("slice", layout.applied)]
        silent = bool(self._heard_at) and len(self._silent_in(tick)) == len(self._heard_at)
        if not fits(given) or (silent and not self._follows):
            given = self._safe if silent and self._safe is not None else self._held
        packets = tuple(map(self._acknowledgement, told))
        self._sent_at |= {one.link: tick for one in told}
        return Stepped(packets, given)

    def mark(self, every: int = 0) -> tuple[Packet, ...]:
        """Create marks: packets that tell each receiver that this node is running and has finished the step.

        Args:
            every: number of steps without a packet on a link after which a mark is sent; 0: in every step.
        """
        links = (*(one.link for one in self._layout.departures), *self.acknowledges)
        due = [link for link in links if self.tick - self._sent_at.get(link, -every) >= every]
        return tuple(self._packet("mark", link, back=link in self.acknowledges) for link in due)

    def sort_in(self, packet: Packet) -> Handling:
        """Store a packet for a later step, and return how it was handled. ``step`` does this for its own packets."""
        handling = self.inbox.take(packet, self.tick)
        if handling in USABLE and packet.link in self._heard_at:
            self._heard_at[packet.link], self._unheard = self.tick + 1, False
        return handling

    def expire(self) -> Values | None:
        """Record that the watchdog expired between steps. Return the safe input, or None to hold the last input."""
        if not self._unheard:
            known, self._unheard = self.silent_links, True
            self._mind_silence(known)
        return self._safe if self.actuates else None

    def save(self) -> dict[str, Any]:
        """Return the complete state of the node and its digest, as values that JSON can represent, to save them."""
        return sealed({
            "format": FORMAT, "fingerprint": f"{self.fingerprint:016x}", "role": self.role, "loop": self.loop,
            "epoch": self.epoch, "tick": self.tick, "memory": list(self._memory), "generator": list(self._generator),
            "inputs": list(self._inputs), "places": list(self._places), "inbox": self.inbox.save(),
            "sequences": dict(self._sequences), "input": list(self._input), "heard_at": dict(self._heard_at),
            "degraded_until": self._degraded_until, "counters": dict(self.counters), "reasons": dict(self.reasons),
            "sent_at": dict(self._sent_at), "limited": None if self._limited is None else list(self._limited),
        })  # fmt: skip

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Restore a saved state of the node.

        Raises:
            ProblemError: this is not a saved state, it was changed, or it belongs to another release, policy, role or
                loop. The node then keeps its former state.
        """
        try:
            known = {"format": FORMAT, "role": self.role, "loop": self.loop, "fingerprint": f"{self.fingerprint:016x}"}
            for name, expected in known.items():
                if saved[name] != expected:
                    of = "this release: start the node without the state" if name == "format" else "this node"
                    raise ProblemError(
                        f"the entry {name} of the saved state is {saved[name]!r}; expected {expected!r}, as for {of}"
                    )
            check_seal(saved, "the given state")
            if len(saved["memory"]) != len(self._memory) or len(saved["inputs"]) != len(self._inputs):
                raise ValueError("wrong number of stored values")
            self.inbox.restore(saved["inbox"])
            self.epoch, self.tick = saved["epoch"], saved["tick"]
            self._memory, self._generator = saved["memory"], saved["generator"]
            self._inputs, self._places = list(saved["inputs"]), list(saved["places"])
            self._sequences, self._input = Counter(saved["sequences"]), tuple(saved["input"])
            self._heard_at, self._degraded_until = dict(saved["heard_at"]), saved["degraded_until"]
            self._sent_at, self._told = dict(saved["sent_at"]), set()
            self._limited = None if saved["limited"] is None else tuple(saved["limited"])
            for counter, kept in ((self.counters, saved["counters"]), (self.reasons, saved["reasons"])):
                counter.clear()
                counter.update(kept)
        except ProblemError:
            raise
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise ProblemError(
                f"the given data are not a saved state of a node ({error!r}); expected the result of Node.save"
            ) from None

    def _measured(self, measurement: Sequence[float | None] | None) -> tuple[Values, tuple[bool, ...]]:
        """Return the outputs, with 0 in place of those that are missing, and whether each is measured."""
        if not self.measures:
            return (), ()
        size = self._layout.measured
        try:
            listed = (None,) * size if measurement is None else tuple(measurement)
            found = tuple(0.0 if value is None else float(value) for value in listed)
        except (TypeError, ValueError, OverflowError):  # such as a text in place of a number
            listed = found = ()
        if isinstance(measurement, str | bytes | set) or any(isinstance(one, str | bytes) for one in listed):
            found = ()  # texts, or entries without an order
        if len(found) != size or not fits(found):
            raise ProblemError(
                f"the measurement of the {self.role} is {measurement}; expected {size} finite numbers of at most "
                f"{LARGEST:.2g} in magnitude, with None in place of an output that is missing"
            )
        return found, tuple(value is not None for value in listed)

    def _advance(self, tick: int, y: Values, draws: Sequence[float] | None) -> list[Packet]:
        """Finish the previous step, and execute this step up to its outputs."""
        inputs, layout, sent = self._inputs, self._layout, list[Packet]()
        if len(self._parts) > 1 and self.tick >= 0:
            sent += self._collect(1, self.tick + 1)
            self._execute(1)
        self._turn_clocks(tick)
        known, self.tick = self.silent_links, tick
        self._mind_silence(known)
        inputs[: len(y)] = y
        sent += self._collect(0, tick)
        if self.manual is not None:
            self._degrade("manual")
        if self._draw is not None:
            self._generator, drawn = self._draw(self._generator, ())
            inputs[layout.drawn] = drawn if draws is None else draws
        outputs = self._execute(0)
        if outputs is None:
            self._input = self._held
            return sent
        for link, at, size in layout.departures:
            if outputs[at]:
                sent.append(self._packet("data", link, outputs[at + 1 : at + 1 + size]))
        if layout.applied is not None:
            self._input = outputs[layout.applied] if self._follows or not self.silent else self._held
        self.options = {name: outputs[i] for name, i in layout.options.items()}
        self._limited = None if layout.limited is None else outputs[layout.limited]
        return sent

    @property
    def _held(self) -> Values:
        """The last input, in all pieces of a step."""
        return self._input[-(self._applied // self.pieces) :] * self.pieces if self._applied else ()

    def _execute(self, part: int) -> Values | None:
        """Execute a part of a step; return None if a result is too large for a payload.

        The memory then starts again, because it may stay too large, and a saved state would end every restart.
        """
        layout = self._layout
        memory, outputs = self._parts[part](self._memory, [self._inputs[i] for i in layout.wiring[part]])
        leaves = list[float]()
        if part == 0:
            leaves += () if layout.applied is None else outputs[layout.applied]
            for _, at, size in layout.departures:
                leaves += outputs[at + 1 : at + 1 + size] if outputs[at] else ()
        if not all(map(isfinite, memory)) or not fits(leaves):
            self._memory = self._start
            self.counters["overflowed"] += 1
            self._degrade("overflow")
            return None
        self._memory = memory
        return outputs

    def _mind_silence(self, known: Sequence[str]) -> None:
        """Record that links are silent; links that were silent before are not counted again."""
        for link in self.silent_links:
            self._degrade(f"silent {link}", counted=link not in known)

    def _collect(self, part: int, tick: int) -> list[Packet]:
        """Take the packets that a part of the step reads, and return their acknowledgements."""
        found = self.inbox.collect(part, tick, self._inputs)
        told = [packet for packet in found if packet.kind == "data" and packet.link in self.acknowledges]
        known, self._told = self._told, set()
        return [self._acknowledgement(one) for one in told if (one.link, one.tick) not in known]

    def _acknowledgement(self, one: Packet) -> Packet:
        """Return the acknowledgement of a packet, which states after what delay it has arrived if this is random."""
        late = (float(one.late),) if self.program.pieces.get(one.link) else ()
        return self._packet("acknowledgement", one.link, late, one.tick)

    def _turn_clocks(self, tick: int) -> None:
        """Set every periodic counter of the policy for this step."""
        self._places = self._places_in(tick)
        at = self._layout.clocks
        self._inputs[at : at + len(self._places)] = map(float, self._places)

    def _places_in(self, tick: int) -> list[int]:
        """Return the value of each periodic counter of the policy in a later step."""
        found = list[int]()
        for here, place, table in zip(self._places, self.program.clocks, self._tables, strict=True):
            turns = tick - max(self.tick, 0)
            if turns > len(table):  # the counter is periodic by then: skip whole periods
                turns = len(table) + (turns - len(table)) % place.period
            for _ in range(turns):
                here = table[here]
            found.append(here)
        return found

    def _packet(self, kind: Any, link: str, values: Values = (), tick: int | None = None, back: bool = False) -> Packet:
        name = f"{kind} {link}"
        if self._sequences[name] > 0xFFFFFFFF:
            self.epoch, self._sequences = self.epoch + 1, Counter()
        packet = Packet(
            kind, link, self.tick if tick is None else tick, self._sequences[name], values, self.epoch, self.loop, back
        )
        self._sequences[name] += 1
        self._sent_at[link] = self.tick
        self.counters[f"sent {name}"] += 1
        return packet

    def _output(self) -> Values | None:
        if self._layout.applied is None:
            return None
        return self._safe if self.silent and self._safe is not None else self._input

    def _degrade(self, reason: str, tick: int | None = None, counted: bool = True) -> None:
        """Record an event, counted once, whose effect on the loop lasts from a step on (default: the last step)."""
        self.reasons[reason] += counted
        self._degraded_until = max(
            self._degraded_until, (self.tick if tick is None else tick) + 1 + self._layout.remembers
        )


class _Compiled(NamedTuple):
    """Properties that all nodes of one role have in common."""

    fingerprint: int
    program: NodeProgram
    layout: Layout
    parts: Sequence[CompiledStep]
    draw: CompiledStep | None
    tables: tuple[tuple[int, ...], ...]


@lru_cache(maxsize=16)
def _compile(policy: Policy, role: str, network: Network) -> _Compiled:
    program = translate_node(policy, place_of(policy, role), network)
    return _Compiled(
        fingerprint(policy, network),
        program,
        lay_out(policy, program),
        tuple(compile_python(part) for part in program.parts),
        None if program.draws is None else compile_python(program.draws),
        tuple(tuple(place.table.tolist()) for place in program.clocks),
    )


def by_hand(policy: Policy, values: object) -> list[float]:
    """Return manual inputs as a list of numbers."""
    m = policy.model.inputs
    found = array("manual", cast("ArrayLike", values), (m,), "(inputs,)").tolist()
    if not fits(found):
        raise ProblemError(
            f"the manual input is {found}; expected {number_of(m, 'finite number')} of at most {LARGEST:.2g} in "
            "magnitude"
        )
    return found


def _safe_input(safe: Safe, inputs: int, pieces: int) -> Values | None:
    """Return the safe input in all pieces of a step, or None if the last input is held."""
    if safe == "hold":
        return None
    values = (0.0,) * inputs if safe == "zero" else safe
    if isinstance(values, str) or len(values) != inputs or not fits(values):
        raise ProblemError(f"the safe input is {safe!r}; expected 'hold', 'zero' or {inputs} finite numbers")
    return tuple(float(value) for value in values) * pieces


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """Add a digest to saved values, by which a later change is detected."""
    return {**content, _SEAL: _digest(content)}


def check_seal(saved: Mapping[str, Any], name: str) -> None:
    """Check with the digest that saved values have not been changed."""
    if saved.get(_SEAL) != _digest({key: value for key, value in saved.items() if key != _SEAL}):
        raise ProblemError(
            f"{name} is not a saved state of a node, or it was changed after it was saved (its digest differs); "
            "expected the unchanged result of Node.save: start the node without it"
        )


def _digest(content: Mapping[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True)
    return hashlib.blake2s(text.encode(), digest_size=16).hexdigest()
