"""Compiles nodes in C for this machine, and speaks with them."""

from __future__ import annotations

import ctypes as c
import shutil
import struct
import subprocess
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import NamedTuple
from unittest.mock import patch

import pytest

import taciturn_export
from taciturn.model.network import Network
from taciturn.model.packets import inputs_at, outputs_at, packet_shapes, wire_links
from taciturn.model.policy import Policy
from taciturn.model.wire import KINDS
from taciturn.nodes.inbox import Handling, Inbox, Stream
from taciturn.nodes.node import Node
from taciturn.nodes.packet import REFUSALS, Packet
from taciturn.program.ops import Precision
from taciturn_export.folder import CORE_SOURCES
from taciturn_export.node import CoreSizes, core_links, print_node
from taciturn_worlds.devices import ACCESS, COUNTERS, Key

CORE = Path(taciturn_export.__file__).parent / "core"
HERE = Path(__file__).parent
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Wshadow", "-Wstrict-prototypes", "-Werror"]
WAITING = 4  # steps that a packet may be early
WIDTH = 64  # of the window of a device


def key_of(secret: bytes | None) -> Key:
    """Return a secret as C has it."""
    return Key(secret, 0 if secret is None else len(secret))


def needs_compiler() -> str:
    """Return the C compiler of this machine, or skip the test."""
    found = shutil.which("cc")
    if found is None:
        pytest.skip("NOT SHOWN: what is C needs a compiler, and there is no `cc`")
    return found


def write_sizes(folder: Path, entries: int, precision: Precision = "float64", links: int = 2) -> None:
    """Write the header with the sizes of the largest packet."""
    sizes = CoreSizes(links, max(1, entries), 60 + 8 * entries, WAITING, precision == "float32")
    (folder / "taciturn_config.h").write_text(sizes.text("", named=False), encoding="ascii")


class Library(NamedTuple):
    """A node of a policy, compiled.

    Args:
        code: its functions.
        number: the type of its numbers.
        packet: the type of its packets.
        sizes: entries of measurement, input and memory.
        links: the names of the links by their number.
    """

    code: c.CDLL
    number: type[c.c_double] | type[c.c_float]
    packet: type[c.Structure]
    sizes: tuple[int, int, int]
    links: tuple[str, ...]


@cache
def compile_core(entries: int, precision: Precision, links: int) -> Path:
    """Return a folder with what all nodes have in common, compiled once for packets of so many entries."""
    folder = Path(mkdtemp())
    write_sizes(folder, entries, precision, links)
    sources = [CORE / name for name in CORE_SOURCES]
    options = [*STRICT, "-O1", "-fPIC", f"-I{CORE}", f"-I{folder}", "-c"]
    subprocess.run([needs_compiler(), *options, *map(str, sources)], cwd=folder, check=True)
    return folder


def compile_core_for(policy: Policy, network: Network, precision: Precision) -> Path:
    """Return the folder of ``compile_core`` with the sizes that a policy needs."""
    return compile_core(_entries(policy, network), precision, core_links(policy))


def _entries(policy: Policy, network: Network) -> int:
    return max(8, *(entries for _, entries in packet_shapes(policy, network).values()))


def compile_node(
    policy: Policy,
    role: str,
    network: Network,
    folder: Path,
    precision: Precision = "float64",
    seed: int = 0,
) -> Library:
    """Return a node of a policy as a library that is loaded."""
    found = print_node(policy, role, network, "device", precision=precision, seed=seed)
    core = compile_core_for(policy, network, precision)
    (folder / "device.h").write_text(found.header, encoding="ascii")
    (folder / "device.c").write_text(found.source, encoding="ascii")
    (folder / "access.c").write_text(ACCESS, encoding="ascii")
    options = [*STRICT, "-O1", "-shared", "-fPIC", f"-I{CORE}", f"-I{core}", "-o", str(folder / "device.so")]
    sources = [HERE / "shim.c", folder / "access.c", folder / "device.c", *core.glob("*.o")]
    subprocess.run([needs_compiler(), *options, f"-I{folder}", *map(str, sources)], check=True)
    code, number = c.CDLL(str(folder / "device.so")), c.c_float if precision == "float32" else c.c_double
    for name in ("device_start", "tac_input", "shim_wire", "shim_counters", "shim_memory", "shim_inputs"):
        getattr(code, name).restype = c.c_void_p
    code.tac_heard.restype = code.tac_behind.restype = c.c_uint64
    for name in ("shim_size", "tac_encode", "tac_send", "tac_save"):
        getattr(code, name).restype = c.c_size_t
    for name in ("tac_receive_in", "tac_act", "tac_step", "tac_degraded", "tac_silent", "tac_restore"):
        getattr(code, name).restype = c.c_bool
    memory = found.header.split("tac_real memory[")[1].split("]")[0]
    sizes = len(outputs_at(policy, role)), len(inputs_at(policy, role)), int(memory)
    return Library(code, number, _packet(number, _entries(policy, network)), sizes, wire_links(policy))


def _packet(number: type, entries: int) -> type[c.Structure]:
    fields = [
        ("tick", c.c_uint64), ("nonce", c.c_uint64), ("sequence", c.c_uint32), ("epoch", c.c_uint32),
        ("loop", c.c_uint16), ("kind", c.c_uint8), ("link", c.c_uint8), ("entries", c.c_uint8), ("back", c.c_bool),
        ("values", number * entries),
    ]  # fmt: skip
    return type("CPacket", (c.Structure,), {"_fields_": fields})


class Device:
    """A node in C that runs.

    Args:
        library: of which node.
        secret: of its packets.
        epoch: of its start.
        loop: which of many.
    """

    def __init__(self, library: Library, secret: bytes | None = None, epoch: int = 0, loop: int = 0) -> None:
        """Start before the first step."""
        self.library, self.code, self.key = library, library.code, key_of(secret)
        self._self = c.create_string_buffer(b"\xa5" * self.code.shim_size())  # what memory holds that nobody cleared
        self.node = c.c_void_p(self.code.device_start(self._self, c.c_uint32(epoch), c.c_uint16(loop), self.key))
        self.wire = c.c_void_p(self.code.shim_wire(self.node))
        self._datagram = c.create_string_buffer(4096)

    def watch(self, ticks: int, safe: Sequence[float] | None = None) -> None:
        """Make the input safe after so many steps of silence."""
        self._safe = safe and (self.library.number * len(safe))(*safe)  # which the node points to
        self.code.tac_watch(self.node, c.c_uint32(ticks), self._safe)

    def mark_after(self, ticks: int) -> None:
        """Send a mark after so many steps without a packet on a link."""
        self.code.tac_mark_after(self.node, c.c_uint32(ticks))

    def set_keys(self, link: str, key: bytes | None, other: bytes | None = None) -> None:
        """Set the key of a link, and one more that is accepted."""
        self._keys = key, other  # to which the node points
        self.code.tac_set_keys(self.node, c.c_uint8(self.library.links.index(link)), key_of(key), key_of(other))

    def encode(self, packet: Packet) -> bytes:
        """Return a packet as a datagram; empty: there is no such packet."""
        given = self.library.packet()
        given.tick, given.sequence, given.epoch, given.loop = packet.tick, packet.sequence, packet.epoch, packet.loop
        given.kind, given.link = KINDS.index(packet.kind), self.library.links.index(packet.link)
        given.entries, given.back, given.nonce = len(packet.values), packet.back, packet.nonce
        given.values[: len(packet.values)] = packet.values
        size = self.code.tac_encode(self.wire, self.key, c.byref(given), self._datagram)
        return self._datagram.raw[:size]

    def decode(self, datagram: bytes) -> Packet | str:
        """Return the packet of a datagram, or why it is none."""
        found = self.library.packet()
        # memory of just its size, so that a checker of addresses sees what is read behind it
        given = (c.c_uint8 * len(datagram)).from_buffer_copy(datagram)
        verdict = self.code.tac_decode(self.wire, self.key, given, c.c_size_t(len(datagram)), c.byref(found))
        if verdict:
            return REFUSALS[verdict - 1]
        values = tuple(found.values[: found.entries])
        kind, link = KINDS[found.kind], self.library.links[found.link]
        return Packet(kind, link, found.tick, found.sequence, values, found.epoch, found.loop, found.back, found.nonce)

    def receive(self, datagram: bytes, piece: int = 0) -> bool:
        """Take a datagram, which has arrived in a piece of the next step."""
        return self.code.tac_receive_in(self.node, datagram, c.c_size_t(len(datagram)), c.c_uint8(piece))

    def act(self) -> bool:
        """Act with the packets that have arrived."""
        return self.code.tac_act(self.node)

    def step(self, tick: int, measurement: Sequence[float] | None = None) -> bool:
        """Go through a step, in as many calls as missed steps take."""
        while not (done := self.step_once(tick, measurement)) and self.behind(tick):
            pass
        return done

    def step_once(self, tick: int, measurement: Sequence[float] | None = None) -> bool:
        """Call for a step once."""
        given = None if measurement is None else (self.library.number * len(measurement))(*measurement)
        return self.code.tac_step(self.node, c.c_uint64(tick), given, None)

    def save(self, size: int | None = None) -> bytes:
        """Return its state; empty: there is no room."""
        room = self.code.shim_size() if size is None else size
        found = (c.c_uint8 * room)()
        written = self.code.tac_save(self.node, found, c.c_size_t(room))
        return bytes(found[:written])

    def restore(self, saved: bytes) -> bool:
        """Continue from a state."""
        given = (c.c_uint8 * len(saved)).from_buffer_copy(saved)  # memory of just its size
        return self.code.tac_restore(self.node, given, c.c_size_t(len(saved)))

    def behind(self, tick: int) -> int:
        """How many missed steps are left before a step."""
        return self.code.tac_behind(self.node, c.c_uint64(tick))

    @property
    def silent(self) -> bool:
        """Whether its watchdog has expired."""
        return self.code.tac_silent(self.node)

    def expire(self) -> None:
        """Let its watchdog expire while no step begins."""
        self.code.tac_expire(self.node)

    def send(self) -> list[bytes]:
        """Return the datagrams that are to be sent."""
        found = list[bytes]()
        while size := self.code.tac_send(self.node, self._datagram):
            found.append(self._datagram.raw[:size])
        return found

    @property
    def input(self) -> tuple[float, ...] | None:
        """Input of the plant."""
        found = self.code.tac_input(self.node)
        return found and tuple((self.library.number * self.library.sizes[1]).from_address(found))

    @property
    def heard(self) -> int:
        """One more than the step of the newest packet."""
        return self.code.tac_heard(self.node)

    @property
    def memory(self) -> list[float]:
        """All that it remembers."""
        return list((self.library.number * self.library.sizes[2]).from_address(self.code.shim_memory(self.node)))

    def inputs(self, count: int) -> list[float]:
        """The first inputs of its last step."""
        return list((self.library.number * count).from_address(self.code.shim_inputs(self.node)))

    @property
    def degraded(self) -> bool:
        """Whether something has happened that its theory does not know."""
        return self.code.tac_degraded(self.node)

    @property
    def waiting(self) -> int:
        """Packets that wait for their step."""
        return self.code.shim_waiting(self.node)

    @property
    def counters(self) -> dict[str, int]:
        """What it has counted, without what it has not met."""
        found = (c.c_uint32 * len(COUNTERS)).from_address(self.code.shim_counters(self.node))
        return {name: count for name, count in zip(COUNTERS, found, strict=True) if count}


class SmallInbox(Inbox):
    """The inbox of a device: few packets wait, each in the place of its step.

    Before the first step the newer of two keeps a place; then whichever is nearer.
    """

    def take(self, packet: Packet, past: int) -> Handling:
        """Take a packet in that a step wants which is not further ahead than places are."""
        stream = self.streams.get((packet.kind, packet.link))
        self.past = past
        with patch("taciturn.nodes.inbox.AHEAD", WAITING - (stream.lag if stream else 0)):
            return super().take(packet, past)

    def _wait(self, stream: Stream, packet: Packet) -> None:
        for tick in [t for t in stream.waiting if stream.pieces and t % WAITING == packet.tick % WAITING]:
            if tick != packet.tick:  # of two late packets, the newer keeps the place
                self.counters["superseded"] += 1
                if tick > packet.tick:
                    return None
                del stream.waiting[tick]
        for tick in [t for t in stream.waiting if t % WAITING == packet.tick % WAITING and t != packet.tick]:
            if self.past < 0 and tick > packet.tick:
                return self._miss(stream, packet)
            if self.past < 0:
                self._miss(stream, stream.waiting.pop(tick))
            elif tick > self.past:  # else it is late, and found to be so when it is looked for
                del stream.waiting[tick]
                self.counters["ahead"] += 1
        return super()._wait(stream, packet)


def with_small_inbox(node: Node) -> Node:
    """Return a node in Python with the inbox of a device; its window has a device's ``WIDTH`` if that is patched."""
    inbox = node.inbox
    lossless = node.network.protocol == "ideal"
    node.inbox = SmallInbox(inbox.streams, inbox.loop, lossless, node.counters, node._degrade)
    return node


def compile_checked(policy: Policy, role: str, network: Network, folder: Path) -> Path:
    """Return the program ``feed`` with a node, as the export gives it, whose every access and operation is checked.

    The sizes of the core are those of the exported folder.
    """
    found = print_node(policy, role, network, "device")
    (folder / "device.h").write_text(found.header, encoding="ascii")
    (folder / "device.c").write_text(found.source, encoding="ascii")
    sizes = CoreSizes.of(policy, network, WAITING, "float64")
    (folder / "taciturn_config.h").write_text(sizes.text("", named=False), encoding="ascii")
    checks = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g", "-O1"]
    sources = [*(CORE / name for name in CORE_SOURCES), HERE / "feed.c", folder / "device.c"]
    command = [needs_compiler(), *STRICT, *checks, f"-I{CORE}", f"-I{folder}", "-o", str(folder / "feed")]
    made = subprocess.run([*command, *map(str, sources)], capture_output=True, text=True, check=False)
    if "cannot find -lasan" in made.stderr or "libclang_rt" in made.stderr:
        pytest.skip("NOT SHOWN: the compiler has no checker of addresses")
    assert made.returncode == 0, made.stderr
    return folder / "feed"


def feed(program: Path, datagrams: Iterable[bytes], *options: str) -> list[str]:
    """Give datagrams to a node (an empty one is the next step), and return the lines that the program prints."""
    records = b"".join(struct.pack("!H", len(one)) + one for one in datagrams)
    done = subprocess.run([str(program), *options], input=records, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout.decode().splitlines()
