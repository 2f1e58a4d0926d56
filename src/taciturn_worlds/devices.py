"""Nodes in exported C code, compiled for this machine, with the interface of the nodes in Python.

The C code reads the datagrams of other nodes itself: it checks them, challenges their senders, and answers challenges.
Its server exchanges packets with the plant, and keeps the time of the steps.
"""

from __future__ import annotations

import base64
import ctypes as c
import shutil
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache, partial
from math import nan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import taciturn_export
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.network import Network
from taciturn.model.packets import roles
from taciturn.model.policy import Policy
from taciturn.model.wire import OFFSETS
from taciturn.nodes.inbox import Inbox
from taciturn.nodes.keys import Keys
from taciturn.nodes.node import Node, Safe, Stepped, Values
from taciturn.nodes.packet import REFUSALS, Packet, Wire
from taciturn_export.folder import CORE
from taciturn_export.node import CoreSizes, print_node
from taciturn_udp.endpoint import Address
from taciturn_udp.nodes import NodeServer

FOLDER = Path(taciturn_export.__file__).parent / "core"
OPTIONS = ("-std=c99", "-O1", "-shared", "-fPIC", "-ffp-contract=off")
WAITING = 64  # steps that a packet may be early
NO_MARKS = 0xFFFFFFFF
COUNTERS = (
    "received", "used", "late", "ahead", "duplicate", "replayed", "misdirected", "superseded", "marks",
    *REFUSALS, "unproven", "proofs", "unsent", "missed", "repeated", "missing", "overflowed", "overruled",
)  # fmt: skip
DROPPED = ("misdirected", "duplicate", "replayed", "superseded", "ahead", "unproven", "proofs", *REFUSALS)
ACCESS = """
#include "device.h"
size_t shim_size(void) { return sizeof(device); }
const tac_counters *shim_counters(const tac_node *node) { return &node->counters; }
const tac_real *shim_memory(const tac_node *node) { return node->memory; }
const tac_real *shim_inputs(const tac_node *node) { return node->inputs; }
unsigned shim_waiting(const tac_node *node) {
  unsigned count = 0U;
  for (unsigned i = 0U; i < node->data->channel_count; i++) {
    for (unsigned place = 0U; place < (unsigned)TAC_WAITING; place++) {
      count += node->channels[i].waits[place] ? 1U : 0U;
    }
  }
  return count;
}
bool shim_settled(const tac_node *node, uint8_t link, uint64_t number) {
  bool found = false;
  for (unsigned i = 0U; i < node->data->channel_count; i++) {
    const tac_channel *channel = &node->channels[i];
    bool data = node->data->channels[i].link == link && node->data->channels[i].kind == (uint8_t)TAC_DATA;
    unsigned place = (unsigned)(number % (uint64_t)TAC_WAITING);
    bool waits = channel->waits[place] && channel->waiting[place].tick == number;
    found = found || (data && (waits || channel->marked > number));
  }
  return found;
}
"""  # what a server reads of a node, and a program on a device does not need


class NoCompilerError(ProblemError):
    """Error raised if this machine has no C compiler."""


class Key(c.Structure):
    """C structure of a node's key."""

    _fields_ = [("bytes", c.c_char_p), ("size", c.c_uint8)]


class DeviceCode:
    """A node's C code, compiled and loaded, with the memory of one device."""

    def __init__(self, policy: Policy, role: str, network: Network, core: Mapping[str, str] | None = None) -> None:
        """Compile and load the code."""
        compiler = shutil.which("cc")
        if compiler is None:
            raise NoCompilerError("no C compiler `cc` was found; expected a C compiler, which nodes in C require")
        found = print_node(policy, role, network, "device")
        texts = {name: (FOLDER / name).read_text(encoding="ascii") for name in CORE}
        for old, new in (core or {}).items():
            assert any(old in text for text in texts.values()), old
            texts = {name: text.replace(old, new) for name, text in texts.items()}
        texts["taciturn_config.h"] = CoreSizes.of(policy, network, WAITING, "float64").text("", named=False)
        texts |= {"device.h": found.header, "device.c": found.source, "access.c": ACCESS}
        with TemporaryDirectory() as folder:
            for name, text in texts.items():
                (Path(folder) / name).write_text(text, encoding="ascii")
            sources = [name for name in texts if name.endswith(".c")]
            command = [compiler, *OPTIONS, "-o", "device.so", *sources]
            done = subprocess.run(command, cwd=folder, capture_output=True, encoding="utf-8", check=False)
            if done.returncode:
                raise ProblemError(
                    f"the C compiler cannot compile the {role}: {done.stderr.strip()}; expected a compiler for C99"
                )
            self.code: Any = c.CDLL(str(Path(folder) / "device.so"))
        for name in ("device_start", "tac_input", "shim_counters", "shim_memory", "shim_inputs"):
            getattr(self.code, name).restype = c.c_void_p
        for name in ("shim_size", "tac_send", "tac_save"):
            getattr(self.code, name).restype = c.c_size_t
        self.code.tac_behind.restype = c.c_uint64
        for name in (
            "tac_receive_in",
            "tac_act",
            "tac_step",
            "tac_degraded",
            "tac_silent",
            "tac_silent_on",
            "tac_restore",
            "tac_manual",
            "shim_settled",
        ):
            getattr(self.code, name).restype = c.c_bool
        self.role, self.policy, self.network = role, policy, network
        self.datagram = c.create_string_buffer(4096)
        self.memory = c.create_string_buffer(self.code.shim_size())

    def start(self, epoch: int, loop: int) -> Any:
        """Start the node without keys, and return the memory address of its state."""
        return c.c_void_p(self.code.device_start(self.memory, c.c_uint32(epoch), c.c_uint16(loop), Key(None, 0)))


class _Channels(Inbox):
    """The inbox of a node in C, as its server reads it."""

    node: DeviceNode

    def settled(self, link: str, tick: int) -> bool:
        """Return whether a step's packet on a link has arrived, or is known not to be sent."""
        return self.node.settled(link, tick)


class DeviceNode(Node):
    """A node whose steps and packets are computed by exported C code.

    The node starts when the object is created; an earlier node on the same device then no longer runs.
    """

    def __init__(
        self,
        device: DeviceCode,
        policy: Policy,
        role: str,
        *,
        network: Network,
        epoch: int,
        seed: int,
        watchdog: int | None,
        safe: Safe,
    ) -> None:
        """Start the code."""
        super().__init__(policy, role, network=network, epoch=epoch, seed=seed, watchdog=watchdog, safe=safe)
        self._device, self._code = device, device.code
        self.inbox = _Channels(self.inbox.streams, self.loop, False, self.counters, self._degrade)
        self.inbox.node = self
        self.wire = Wire(policy, network)
        self._keys: dict[str, tuple[bytes, ...]] = {}  # of which the device knows the addresses
        self._counted: list[int] = []
        self._self = device.start(self.epoch, self.loop)
        self._safe_numbers = None if self._safe is None else (c.c_double * len(self._safe))(*self._safe)
        if watchdog is not None:
            self._code.tac_watch(self._self, c.c_uint32(watchdog), self._safe_numbers)
        self._code.tac_mark_after(self._self, c.c_uint32(NO_MARKS))

    def set_keys(self, keys: Keys) -> None:
        """Give the device the keys of its links, if the keys have changed."""
        for code, link in enumerate(self.wire.links):
            found = () if link in self.wire.physical else keys.of(link)
            if found and found != self._keys.get(link):
                self._keys[link] = found
                first, other = [Key(key, len(key)) for key in found] + [Key(None, 0)] * (2 - len(found))
                self._code.tac_set_keys(self._self, c.c_uint8(code), first, other)

    @property
    def waiting(self) -> int:
        """Number of packets that arrived early and wait for their step."""
        return self._code.shim_waiting(self._self)

    @property
    def manual(self) -> Values | None:
        """Manual inputs of the device; None if its operation is automatic."""
        self._inputs = self._numbers("shim_inputs", len(self._inputs))
        return super().manual

    @manual.setter
    def manual(self, values: Sequence[float] | None) -> None:
        """Set the manual inputs of the device, or None for automatic operation."""
        given = None if values is None else (c.c_double * len(values))(*values)
        if not self._code.tac_manual(self._self, given) and values is not None:
            Node.manual.__set__(self, values)  # which says what is wrong

    @property
    def degraded(self) -> bool:
        """Whether the loop is still affected by an event that the policy's theory excludes."""
        return self._code.tac_degraded(self._self)

    @property
    def silent(self) -> bool:
        """Whether the watchdogs of all links of the device have expired."""
        return self._code.tac_silent(self._self)

    @property
    def silent_links(self) -> tuple[str, ...]:
        """The links whose watchdogs on the device have expired."""
        codes = {link: c.c_uint8(self.wire.links.index(link)) for link in self.limits}
        return tuple(link for link, code in codes.items() if self._code.tac_silent_on(self._self, code))

    def settled(self, link: str, tick: int) -> bool:
        """Return whether a step's packet on a link has arrived, or is known not to be sent."""
        return self._code.shim_settled(self._self, c.c_uint8(self.wire.links.index(link)), c.c_uint64(tick))

    def receive(self, datagram: bytes, piece: int = 0) -> str:
        """Pass a datagram to the device; return ``waiting`` if the device can use it, or the counter that counts it.

        It has arrived in a piece of the step after the last one.
        """
        before = [self.counters[name] for name in DROPPED]
        usable = self._code.tac_receive_in(self._self, datagram, c.c_size_t(len(datagram)), c.c_uint8(piece))
        self._count()
        if usable:
            self._unheard = False
            return "waiting"
        return next(name for name, number in zip(DROPPED, before, strict=True) if self.counters[name] > number)

    def step(
        self,
        tick: int,
        measurement: Sequence[float | None] | None = None,
        packets: Iterable[Packet] = (),
        draws: Sequence[float] | None = None,
    ) -> Stepped:
        """Execute one step on the device."""
        assert not packets, "a node in C receives datagrams"
        y, known = self._measured(measurement)
        entries = [value if there else nan for value, there in zip(y, known, strict=True)]
        given = (c.c_double * len(y))(*entries) if y else None
        number = c.c_uint64(tick)
        while not (done := self._code.tac_step(self._self, number, given, None)):
            if not self._code.tac_behind(self._self, number):
                break
        if done:
            self.tick = tick
            self._inputs = self._numbers("shim_inputs", len(self._inputs))
            self._memory = self._numbers("shim_memory", len(self._memory))
        self._count()
        return Stepped(self.sent(), self._output())

    def so_far(self, tick: int) -> Stepped:
        """Return what the device does in its next step with the packets that have arrived."""
        self.check_acting()
        self._code.tac_act(self._self)
        self._inputs = self._numbers("shim_inputs", len(self._inputs))
        return Stepped(self.sent(), self._output())

    def expire(self) -> Values | None:
        """Let the device's watchdog expire, although no step begins, and return the device's safe input."""
        given = super().expire()
        self._code.tac_expire(self._self)
        return None if given is None else self._output()

    def mark(self, every: int = 0) -> tuple[Packet, ...]:
        """Return the device's marks: messages that say that the device is running and has finished the step."""
        self._code.tac_mark_after(self._self, c.c_uint32(every))
        found = self.sent()
        self._code.tac_mark_after(self._self, c.c_uint32(NO_MARKS))
        return found

    def save(self) -> dict[str, Any]:
        """Return the state of the device as values that JSON can store."""
        room = c.create_string_buffer(len(self._device.memory))
        size = self._code.tac_save(self._self, room, c.c_size_t(len(room)))
        return {"state": base64.b64encode(room.raw[:size]).decode(), "tick": self.tick, "epoch": self.epoch}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Continue from a saved state."""
        state = base64.b64decode(saved["state"])
        if not self._code.tac_restore(self._self, state, c.c_size_t(len(state))):
            raise ProblemError(
                f"the {self.role} in C refuses its own saved state; expected a saved state that it accepts"
            )
        self.tick, self.epoch = saved["tick"], saved["epoch"]
        self._memory = self._numbers("shim_memory", len(self._memory))
        self._count()

    def _numbers(self, function: str, count: int) -> list[float]:
        return list((c.c_double * count).from_address(getattr(self._code, function)(self._self)))

    def sent(self) -> tuple[Packet, ...]:
        """Return the packets that the device sends in the present step."""
        found: list[Packet] = []
        while size := self._code.tac_send(self._self, self._device.datagram):
            packet = cast("Packet", self.wire.decode(self._device.datagram.raw[:size]))
            self.counters[f"sent {packet.kind} {packet.link}"] += 1
            found.append(packet)
        return tuple(found)

    def _output(self) -> Values | None:
        if not self.actuates:
            return None
        found = self._code.tac_input(self._self)
        return tuple((c.c_double * self._applied).from_address(found))

    def _count(self) -> None:
        found = (c.c_uint32 * len(COUNTERS)).from_address(self._code.shim_counters(self._self))[:]
        if found != self._counted:
            for name, number in zip(COUNTERS, found, strict=True):
                self.counters[name] = number
            self._counted = found


class DeviceServer(NodeServer):
    """Server of a node in C, with the same arguments as ``NodeServer``."""

    def _take(self, datagrams: Sequence[bytes]) -> set[int]:
        """Give the datagrams of other nodes to the device, and those of the plant to this server."""
        received = list(zip(datagrams, self.endpoint.senders, strict=True))
        touched = self._take_from(pair for pair in received if self._is_physical(pair[0]))
        node = self._device
        node.wire = self.wire
        if self.wire.keys is not None:
            node.set_keys(self.wire.keys)  # which may just have changed
        for datagram, sender in received:
            if not self._is_physical(datagram):
                self._give(datagram, sender)
        return touched

    @property
    def _device(self) -> DeviceNode:
        return cast("DeviceNode", self.nodes[0])

    def _give(self, datagram: bytes, sender: Address) -> None:
        """Give a datagram to the device, and send the challenges and answers that it returns."""
        packet = self.wire.decode(datagram)
        found = self._device.receive(datagram, self._piece_of(packet) if isinstance(packet, Packet) else 0)
        if found != packet if isinstance(packet, str) else found in REFUSALS:
            raise ProblemError(
                f"the {self._device.role} in C classifies a datagram as {found}, but a node in Python as {packet}"
            )
        if isinstance(packet, Packet):
            self._note(packet, found, self._clock(), repeated=False)
        for answer in self._device.sent():
            if answer.kind == "challenge":
                self.endpoint.send(self.wire.encode(answer), sender)
            else:
                self._outbox.send([answer])

    def _piece_of(self, packet: Packet) -> int:
        """Return in which piece of the step after the last one a packet has arrived."""
        node, now = self._device, self._clock()
        pieces = node.program.pieces.get(packet.link, 0)
        if not node.acts_at_once or not pieces or packet.kind != "data":
            return 0
        late = self._dated(packet, now).late
        due = packet.tick + late // pieces
        if due > node.tick + 1:  # the nearest piece is one of the next step, so the present step is over
            self._go_on(node, now + self.phase.tick / 2)
        return pieces - 1 if due > node.tick + 1 else late % pieces if due == node.tick + 1 else 0

    def _is_physical(self, datagram: bytes) -> bool:
        """Return whether a datagram is exchanged with the plant; the device itself takes set-points."""
        return datagram[OFFSETS["link"]] in {self.wire.links.index(link) for link in self.wire.physical}


@lru_cache(maxsize=8)
def compile_devices(loop: Loop) -> Mapping[str, Callable[..., DeviceNode]]:
    """Compile the nodes of a loop in C; return, for each role, a function that starts its node."""
    return {role: partial(DeviceNode, DeviceCode(loop.policy, role, loop.network)) for role in roles(loop.policy)}
