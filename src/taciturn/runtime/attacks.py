"""Faults of nodes with keys as plain data: recordings, forged packets and changes of keys; their choice for a seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taciturn.runtime.faults import Crash, Fault, Path

READ = 14  # steps within which every process has read changed keys
FAR = 1_000_000  # steps by which a recording of a long session is ahead


@dataclass(frozen=True, repr=False)
class Recording(Fault):
    """An attacker sends a recording: everything that was sent on a path before, in the order of the recording.

    Args:
        path: sender and receiver.
        epochs: difference of the epoch of the recorded session from the present one, or 0 for the present session.
        ahead: steps by which the steps of the recording are ahead of those of the present session.
    """

    path: Path
    epochs: int = 0
    ahead: int = 0

    def what(self) -> str:
        """Return what happens, in words."""
        session = "this session" if not self.epochs else f"a session with an epoch {self.epochs:+d}"
        return f"a recording of {session}, {self.ahead} steps ahead, is sent from {self.path[0]} to {self.path[1]}"


@dataclass(frozen=True, repr=False)
class Forgery(Fault):
    """An attacker sends packets with other numbers than those of the last step, and with a tag of a wrong key.

    Args:
        path: sender and receiver.
        former: whether the key is a former key of this link, if there is one, or the key of another link.
    """

    path: Path
    former: bool

    def what(self) -> str:
        """Return what happens, in words."""
        key = "a former key or that of another link" if self.former else "an unknown key"
        return f"packets from {self.path[0]} to {self.path[1]} are forged with {key}"


@dataclass(frozen=True, repr=False)
class KeyChange(Fault):
    """The key of a link is changed in three writings of the key files: the new key is added, used, and left alone.

    Args:
        link: the link.
    """

    link: str

    @property
    def end(self) -> float:
        """Step from which on it has no direct effect."""
        return self.first + self.steps + READ

    def what(self) -> str:
        """Return what happens, in words."""
        return f"the key of the {self.link} link is changed"


def draw_attacks(
    seed: int, paths: Sequence[Path], links: Sequence[str], within: int, faults: Sequence[Fault]
) -> tuple[Fault, ...]:
    """Return one to three random faults of nodes with keys; some recordings begin when a process starts again.

    Args:
        seed: seed of the choice.
        paths: senders and receivers of datagrams.
        links: links with a key.
        within: number of steps in which faults begin.
        faults: the other faults.
    """
    draws = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(6,)))
    crash = next((fault for fault in faults if isinstance(fault, Crash)), None)
    found: list[Fault] = []
    for _ in range(draws.integers(1, 4)):
        first, steps = int(draws.integers(10, within)), 1 + int(draws.geometric(0.1))
        path = paths[int(draws.integers(len(paths)))]
        choice = int(draws.integers(4))
        if choice == 0 and not any(isinstance(fault, KeyChange) for fault in found):
            found.append(KeyChange(first, 3 * int(draws.choice([2, READ, 20])), str(draws.choice(links))))
        elif choice == 1:
            found.append(Forgery(first, steps, path, bool(draws.integers(2))))
        else:
            if crash is not None and draws.integers(2):  # the attacker is faster than the true sender
                path = next(path for path in paths if crash.role in path)
                first = crash.first + crash.steps - 1
            epochs = int(draws.choice([0, 500, -500]))
            ahead = int(draws.choice([0, 5, FAR])) if epochs else 0
            found.append(Recording(first, steps, path, epochs, ahead))
    return tuple(found)
