"""A test bed in which the kernel loses packets: nodes in network namespaces of their own, joined by veth pairs.

Every node and the plant have a namespace each, and a wire to every other. Where a link ends, nftables drops its data by
a hash of their sequence number, so that what arrives can be told before (``predict_drops``). Marks, acknowledgements
and what plant and nodes tell each other pass. Nothing is changed outside these namespaces.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import signal
import struct
import subprocess
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

from taciturn._arrays import count
from taciturn.errors import ProblemError
from taciturn.model.places import role_at, roles
from taciturn.model.policy import ENDS, LinkName, Policy
from taciturn.model.wire import HEADER, KINDS, LINKS

NETWORK, PORT = "10.77.0", 9000  # of every node; no other machine sees them
NEEDED = (
    "expected the rights of root, the programs ip and nft, and nft_hash in the kernel: "
    "become root, and install Debian's packages iproute2 and nftables"
)
_FOLDER = Path("/var/run/netns")  # where ip keeps the names of namespaces
_CLONE_NEWNET = 0x40000000
_UDP_HEADER = 8  # bytes
_numbers = counting()


@dataclass(frozen=True)
class KernelLoss:
    """Which packets of a link the kernel drops.

    Args:
        seed: of the hash, 32 bits.
        permille: so many of a thousand, 0 to 1000.

    Raises:
        ProblemError: a number out of its range.
    """

    seed: int = 0
    permille: int = 0

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name, most in (("seed", 0xFFFFFFFF), ("permille", 1000)):
            if count(name, getattr(self, name), 0) > most:
                raise ProblemError(f"{name} is {getattr(self, name)}; expected at most {most}")


class Counted(NamedTuple):
    """What nftables has counted on a link; a packet that is sent again counts again.

    Args:
        seen: data that came.
        dropped: of them.
    """

    seen: int
    dropped: int


def predict_drops(seed: int, permille: int, sequences: Sequence[int] | NDArray[np.integer]) -> NDArray[np.bool_]:
    """Tell which packets the kernel drops: those with ⌊1000·jhash(sequence, seed)/2³²⌋ < permille.

    The hash is that of Linux (``include/linux/jhash.h``) over the four bytes of the sequence as they stand in the
    datagram, as nftables takes it in ``jhash … mod 1000 seed …``.

    Args:
        seed: of the hash, 32 bits.
        permille: so many of a thousand, 0 to 1000.
        sequences: numbers of packets, 0 to 2³²−1, (k,).

    Returns:
        Whether each is dropped, (k,).

    Raises:
        ProblemError: a number out of its range.

    Example:
        >>> predict_drops(seed=1, permille=250, sequences=range(12)).nonzero()[0]
        array([3, 6, 9])
    """
    KernelLoss(seed, permille)
    numbers = np.asarray(sequences, dtype=np.int64).reshape(-1)
    if numbers.size and not 0 <= numbers.min() <= numbers.max() <= 0xFFFFFFFF:
        raise ProblemError(f"sequences go from {numbers.min()} to {numbers.max()}; expected 0 to {0xFFFFFFFF}")
    b = np.full(numbers.shape, (0xDEADBEEF + 4 + seed) & 0xFFFFFFFF, dtype=np.uint32)
    a = b + numbers.astype(np.uint32).byteswap()  # the hash reads the big-endian word as a little-endian one
    c = -_rotated(b, 14)  # c ^= b gives 0, for both are the seed's
    a = (a ^ c) - _rotated(c, 11)
    b = (b ^ a) - _rotated(a, 25)
    c = (c ^ b) - _rotated(b, 16)
    a = (a ^ c) - _rotated(c, 4)
    b = (b ^ a) - _rotated(a, 14)
    c = (c ^ b) - _rotated(b, 24)
    return (c.astype(np.uint64) * 1000 >> 32) < permille


class Namespaces:
    """Namespaces for the nodes of a policy and its plant, there as long as the ``with`` block runs.

    They are named after this process; those of processes that were killed are removed, with what still runs in them.

    Args:
        policy: whose nodes they are for.
        losses: of each link; omitted links lose nothing.
        places: further ones, beside the nodes and the plant.

    Raises:
        ProblemError: when entered: rights, a program or a part of the kernel are missing.
    """

    def __init__(self, policy: Policy, losses: Mapping[LinkName, KernelLoss], places: Sequence[str] = ()) -> None:
        """Give everybody a name and an address."""
        self.policy, self.losses = policy, losses
        owner = f"taciturn-{os.getpid()}-{_born(os.getpid())}-{next(_numbers)}"
        self.names = {place: f"{owner}-{place}" for place in (*roles(policy), *places, "plant")}
        self.addresses = {place: f"{NETWORK}.{i}:{PORT}" for i, place in enumerate(self.names, start=1)}

    def __enter__(self) -> Namespaces:
        """Make them, or leave nothing behind."""
        for path in _FOLDER.glob("taciturn-*"):
            found = re.match(r"taciturn-(\d+)-(\d+)-", path.name)
            if found and _born(int(found[1])) != found[2]:
                _remove(path.name)
        try:
            self._make()
        except BaseException:
            with suppress(ProblemError):  # the first failure is the one to tell
                self._clear()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Remove them."""
        self._clear()

    def before(self, place: str) -> list[str]:
        """Return the command that runs another one at a place."""
        return ["ip", "netns", "exec", self.names[place]]

    @contextmanager
    def visit(self, place: str) -> Generator[None]:
        """Let this thread open sockets at a place; they stay there.

        Raises:
            ProblemError: it may not be entered.
        """
        with open("/proc/thread-self/ns/net", "rb") as home:
            enter(self.file(place))
            try:
                yield
            finally:
                _enter(home.fileno())

    def file(self, place: str) -> Path:
        """Return the file of a place's namespace, for ``enter``."""
        return _FOLDER / self.names[place]

    def counted(self, link: LinkName) -> Counted:
        """Return what the kernel has counted on a link."""
        found = json.loads(_run(*self.before(role_at(self.policy, ENDS[link])), "nft", "-j", "list", "counters"))[
            "nftables"
        ]
        packets = {entry["counter"]["name"]: entry["counter"]["packets"] for entry in found if "counter" in entry}
        return Counted(packets[f"{link}_seen"], packets[f"{link}_dropped"])

    def _make(self) -> None:
        for name in self.names.values():
            _run("ip", "netns", "add", name)
        wires = [
            f"link add {b} netns {self.names[a]} type veth peer name {a} netns {self.names[b]}"
            for a, b in combinations(self.names, 2)
        ]
        _run("ip", "-batch", "-", given="\n".join(wires))
        hosts = {place: address.partition(":")[0] for place, address in self.addresses.items()}
        for place, name in self.names.items():
            lines = ["link set lo up"]
            for other in self.names.keys() - {place}:
                lines += [f"addr add {hosts[place]} peer {hosts[other]} dev {other}", f"link set {other} up"]
            _run("ip", "-n", name, "-batch", "-", given="\n".join(lines))
        for link, loss in self.losses.items():
            _run(*self.before(role_at(self.policy, ENDS[link])), "nft", "-f", "-", given=_rules(link, loss))

    def _clear(self) -> None:
        for name in self.names.values():
            if (_FOLDER / name).exists():
                _remove(name)


def enter(namespace: Path) -> None:
    """Let this thread go on in a network namespace, by its file; what it starts and opens from now on is there.

    Raises:
        ProblemError: it may not be entered.
    """
    with open(namespace, "rb") as there:
        _enter(there.fileno())


def _rules(link: LinkName, loss: KernelLoss) -> str:
    """Return a table of nftables that counts the data of a link and drops some."""
    chosen = {"kind": KINDS.index("data"), "link": LINKS.index(link)}
    data = " ".join(f"{_field(name)} {value}" for name, value in chosen.items())
    share = f"jhash {_field('sequence')} mod 1000 seed {loss.seed} < {loss.permille}"
    share = "" if loss.permille == 1000 else share  # nftables refuses what is always true
    drop = f"{share} counter name {link}_dropped drop" if loss.permille else ""
    return f"""table inet taciturn_{link} {{
        counter {link}_seen {{ }}
        counter {link}_dropped {{ }}
        chain arriving {{
            type filter hook input priority filter;
            udp dport {PORT} {data} counter name {link}_seen {drop}
        }}
    }}"""


def _field(name: str) -> str:
    """Return where a field of the header stands, in bits after the beginning of UDP's own, as nftables says it."""
    names = [field.name for field in HEADER]
    before = struct.calcsize("!" + "".join(field.code for field in HEADER[: names.index(name)]))
    return f"@th,{8 * (_UDP_HEADER + before)},{8 * struct.calcsize(HEADER[names.index(name)].code)}"


def _rotated(word: NDArray[np.uint32], bits: int) -> NDArray[np.uint32]:
    return (word << np.uint32(bits)) | (word >> np.uint32(32 - bits))


def _born(pid: int) -> str | None:
    """Return when a process began, in ticks since the machine did: with its number, its name for good."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[19]
    return None


def _enter(descriptor: int) -> None:
    if ctypes.CDLL(None, use_errno=True).setns(descriptor, _CLONE_NEWNET):
        raise ProblemError(f"a network namespace cannot be entered ({os.strerror(ctypes.get_errno())}); {NEEDED}")


def _remove(name: str) -> None:
    """Remove a namespace, and end what still runs in it; another process may be removing it, too."""
    try:
        for pid in map(int, _run("ip", "netns", "pids", name).split()):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        _run("ip", "netns", "delete", name)
    except ProblemError:
        if (_FOLDER / name).exists():
            raise


def _run(*command: str, given: str = "") -> str:
    try:
        return subprocess.run(command, input=given, capture_output=True, text=True, check=True).stdout
    except FileNotFoundError:
        raise ProblemError(f"the program {command[0]} is missing; {NEEDED}") from None
    except subprocess.CalledProcessError as error:
        said = (error.stderr.strip().splitlines() or ["no reason given"])[0]
        raise ProblemError(f"`{' '.join(command)}` has failed ({said}); {NEEDED}") from None
