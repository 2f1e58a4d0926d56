"""Test bed in which the Linux kernel drops packets: each node has its own network namespace, joined by veth pairs.

The plant has a namespace too, and every two namespaces are connected. At the receiver of a link, nftables drops data
packets by a hash of the sequence number, so that drops can be predicted (``predict_drops``). Marks, acknowledgements
and packets between plant and nodes are not dropped. Nothing is changed outside these namespaces.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import combinations
from itertools import count as counting
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taciturn.errors import ProblemError
from taciturn.extend import Displayed, count
from taciturn.model.network import Network
from taciturn.model.packets import receiver_of, roles, wire_links
from taciturn.model.policy import Policy
from taciturn.model.wire import HEADER, KINDS
from taciturn_udp.relay import losses

NETWORK, PORT = "10.77.0", 9000  # network and port of every node, invisible to other machines
NEEDED = (
    "expected the rights of root, the programs ip and nft, and nft_hash in the kernel: "
    "run as root, and install the Debian packages iproute2 and nftables"
)
_FOLDER = Path("/var/run/netns")  # folder in which ip lists the namespaces
_CLONE_NEWNET = 0x40000000
_UDP_HEADER = 8  # bytes
_numbers = counting()


@dataclass(frozen=True, repr=False)
class KernelLoss(Displayed):
    """The random packet loss on a link that the kernel simulates.

    Args:
        seed: seed of the hash, 32 bits.
        permille: packets dropped per thousand, 0 to 1000.

    Raises:
        ProblemError: a number is out of range.
    """

    seed: int = 0
    permille: int = 0

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name, most in (("seed", 0xFFFFFFFF), ("permille", 1000)):
            if count(name, getattr(self, name), 0) > most:
                raise ProblemError(f"{name} is {getattr(self, name)}; expected a value of at most {most}")


def kernel_losses(network: Network, seed: int) -> dict[str, KernelLoss]:
    """Return the packet losses that the kernel simulates on each link of a network.

    Raises:
        ProblemError: losses come in bursts, or are not an integer number of permille.
    """
    found: dict[str, KernelLoss] = {}
    for link, fate in losses(network, seed).items():
        if fate.burst is not None:
            raise ProblemError(
                f"{network.key(link, 'burst')} is given, but the kernel cannot drop packets in bursts; expected "
                f"{network.key(link, 'loss')} instead"
            )
        permille = round(1000 * fate.loss)
        if abs(permille - 1000 * fate.loss) > 1e-9:
            raise ProblemError(
                f"{network.key(link, 'loss')} is {fate.loss:g}; expected a multiple of 0.001, the kernel's resolution"
            )
        found[link] = KernelLoss(fate.seed & 0xFFFFFFFF, permille)  # of 32 bits
    return found


class Counted(NamedTuple):
    """Packets on a link as counted by the firewall nftables; a packet that is sent twice counts twice."""

    seen: int  # data packets received
    dropped: int  # number of them that the kernel dropped


def predict_drops(seed: int, permille: int, sequences: Sequence[int] | NDArray[np.integer]) -> NDArray[np.bool_]:
    """Predict which packets the kernel drops: those with ⌊1000·jhash(sequence, seed)/2³²⌋ < permille.

    The hash is the Linux function jhash (``include/linux/jhash.h``) of the four bytes of the sequence number in the
    datagram, as in the nftables expression ``jhash … mod 1000 seed …``.

    Args:
        seed: seed of the hash, 32 bits.
        permille: packets dropped per thousand, 0 to 1000.
        sequences: sequence numbers of packets, 0 to 2³²−1, (k,).

    Returns:
        Whether each packet is dropped, (k,).

    Raises:
        ProblemError: a number is out of range.

    Example:
        >>> predict_drops(seed=1, permille=250, sequences=range(12)).nonzero()[0]
        array([3, 6, 9])
    """
    KernelLoss(seed, permille)
    numbers = np.asarray(sequences, dtype=np.int64).reshape(-1)
    if numbers.size and not 0 <= numbers.min() <= numbers.max() <= 0xFFFFFFFF:
        raise ProblemError(
            f"'sequences' has numbers from {numbers.min()} to {numbers.max()}; expected numbers from 0 to {0xFFFFFFFF}"
        )
    b = np.full(numbers.shape, (0xDEADBEEF + 4 + seed) & 0xFFFFFFFF, dtype=np.uint32)
    a = b + numbers.astype(np.uint32).byteswap()  # the hash reads the big-endian word in little-endian order
    c = -_rotated(b, 14)  # jhash starts with c = b, so that c ^= b is 0
    a = (a ^ c) - _rotated(c, 11)
    b = (b ^ a) - _rotated(a, 25)
    c = (c ^ b) - _rotated(b, 16)
    a = (a ^ c) - _rotated(c, 4)
    b = (b ^ a) - _rotated(a, 14)
    c = (c ^ b) - _rotated(b, 24)
    return (c.astype(np.uint64) * 1000 >> 32) < permille


class Namespaces:
    """Network namespaces for a policy's nodes and their plant, which exist until the ``with`` block ends.

    The names of the namespaces contain the process id. On entry, namespaces of killed processes are removed, and
    processes that still run in them are ended.
    """

    def __init__(self, policy: Policy, losses: Mapping[str, KernelLoss], places: Sequence[str] = ()) -> None:
        """Choose the name and address of each namespace."""
        self.policy, self.losses = policy, losses
        owner = f"taciturn-{os.getpid()}-{_born(os.getpid())}-{next(_numbers)}"
        self.names = {place: f"{owner}-{place}" for place in (*roles(policy), *places, "plant")}
        self.addresses = {place: f"{NETWORK}.{i}:{PORT}" for i, place in enumerate(self.names, start=1)}

    def __enter__(self) -> Namespaces:
        """Create the namespaces; after an error, remove those already created."""
        for program in ("ip", "nft"):
            if shutil.which(program) is None:
                raise ProblemError(f"the program {program} is missing; {NEEDED}")
        for path in _FOLDER.glob("taciturn-*"):
            found = re.match(r"taciturn-(\d+)-(\d+)-", path.name)
            if found and _born(int(found[1])) != found[2]:
                _remove(path.name)
        try:
            self._make()
        except BaseException:
            with suppress(ProblemError):  # the first error is the one to report
                self._clear()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Remove the namespaces."""
        self._clear()

    def before(self, place: str) -> list[str]:
        """Return the start of a command line that runs a command in the network namespace of a node or the plant."""
        return ["ip", "netns", "exec", self.names[place]]

    @contextmanager
    def visit(self, place: str) -> Generator[None]:
        """Move this thread to the network namespace of a node or the plant; sockets opened meanwhile belong to it."""
        with open("/proc/thread-self/ns/net", "rb") as home, open(_FOLDER / self.names[place], "rb") as there:
            _enter(there.fileno())
            try:
                yield
            finally:
                _enter(home.fileno())

    def counted(self, link: str) -> Counted:
        """Return the kernel's packet counters of a link."""
        found = json.loads(_run(*self.before(receiver_of(self.policy, link)), "nft", "-j", "list", "counters"))[
            "nftables"
        ]
        packets = {entry["counter"]["name"]: entry["counter"]["packets"] for entry in found if "counter" in entry}
        return Counted(packets[f"{link}_seen"], packets[f"{link}_dropped"])

    def _make(self) -> None:
        for name in self.names.values():
            _run("ip", "netns", "add", name)
        devices = {place: f"to{i}" for i, place in enumerate(self.names)}  # Linux limits their names to 15 characters
        wires = [
            f"link add {devices[b]} netns {self.names[a]} type veth peer name {devices[a]} netns {self.names[b]}"
            for a, b in combinations(self.names, 2)
        ]
        _run("ip", "-batch", "-", given="\n".join(wires))
        hosts = {place: address.partition(":")[0] for place, address in self.addresses.items()}
        for place, name in self.names.items():
            lines = ["link set lo up"]
            for other in self.names.keys() - {place}:
                lines += [f"addr add {hosts[place]} peer {hosts[other]} dev {devices[other]}"]
                lines += [f"link set {devices[other]} up"]
            _run("ip", "-n", name, "-batch", "-", given="\n".join(lines))
        for link, loss in self.losses.items():
            _run(*self.before(receiver_of(self.policy, link)), "nft", "-f", "-", given=self._rules(link, loss))

    def _rules(self, link: str, loss: KernelLoss) -> str:
        """Return an nftables table that counts the data packets of a link and drops some of them."""
        chosen = {"kind": KINDS.index("data"), "link": wire_links(self.policy).index(link)}
        data = " ".join(f"{_field(name)} {value}" for name, value in chosen.items())
        share = f"jhash {_field('sequence')} mod 1000 seed {loss.seed} < {loss.permille}"
        share = "" if loss.permille == 1000 else share  # nftables rejects a condition that is always true
        drop = f"{share} counter name {link}_dropped drop" if loss.permille else ""
        return f"""table inet taciturn_{link} {{
            counter {link}_seen {{ }}
            counter {link}_dropped {{ }}
            chain arriving {{
                type filter hook input priority filter;
                udp dport {PORT} {data} counter name {link}_seen {drop}
            }}
        }}"""

    def _clear(self) -> None:
        for name in self.names.values():
            if (_FOLDER / name).exists():
                _remove(name)


def _field(name: str) -> str:
    """Return the nftables expression for a packet field: its offset from the UDP header and its length in bits."""
    names = [field.name for field in HEADER]
    before = struct.calcsize("!" + "".join(field.code for field in HEADER[: names.index(name)]))
    return f"@th,{8 * (_UDP_HEADER + before)},{8 * struct.calcsize(HEADER[names.index(name)].code)}"


def _rotated(word: NDArray[np.uint32], bits: int) -> NDArray[np.uint32]:
    return (word << np.uint32(bits)) | (word >> np.uint32(32 - bits))


def _born(pid: int) -> str | None:
    """Return the start time of a process since boot; together with the process id it identifies the process."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19]
    return None


def _enter(descriptor: int) -> None:
    if ctypes.CDLL(None, use_errno=True).setns(descriptor, _CLONE_NEWNET):
        raise ProblemError(f"a network namespace cannot be entered ({os.strerror(ctypes.get_errno())}); {NEEDED}")


def _remove(name: str) -> None:
    """Remove a namespace and end its processes; another process may remove the namespace at the same time."""
    try:
        for pid in map(int, _run("ip", "netns", "pids", name).split()):
            assert sys.platform != "win32"  # the program ip exists on Linux only
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        _run("ip", "netns", "delete", name)
    except ProblemError:
        if (_FOLDER / name).exists():
            raise


def _run(*command: str, given: str = "") -> str:
    try:
        return subprocess.run(command, input=given, capture_output=True, encoding="utf-8", check=True).stdout
    except subprocess.CalledProcessError as error:
        said = (error.stderr.strip().splitlines() or ["no reason given"])[0]
        raise ProblemError(f"`{' '.join(command)}` has failed ({said}); {NEEDED}") from None
