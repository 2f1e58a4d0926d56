"""The keys of a world of faults: secrets of each link, and the keys that every process has in its file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from taciturn.runtime.keys import MOST_KEY, Keys, RenewedKeys


class _FileKeys(RenewedKeys):
    """The keys of a process, from a file that is a dictionary."""

    def __init__(self, file: Mapping[str, tuple[bytes, ...]], clock: Callable[[], float]) -> None:
        self._file = file
        super().__init__(clock)

    def __str__(self) -> str:
        return "the file"

    def _stamped(self) -> object:
        return dict(self._file)

    def _read(self) -> Mapping[str, tuple[bytes, ...]]:
        return dict(self._file)


class KeyRing:
    """The keys of all processes of a world, its nonces, and what an attacker knows.

    Args:
        seed: seed of the keys, nonces and epochs.
        links: the links of the policy and its plant.
        uses: links that each process uses.
    """

    def __init__(self, seed: int, links: Sequence[str], uses: Mapping[str, Sequence[str]]) -> None:
        """Draw a key for each link."""
        self._draws = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(5,)))
        self._secrets = {link: self._draws.bytes(MOST_KEY) for link in links}
        self._former: dict[str, bytes] = {}
        self.files: dict[str, dict[str, tuple[bytes, ...]]] = {
            name: {link: (self._secrets[link],) for link in links} for name, links in uses.items()
        }

    def keys(self, name: str, clock: Callable[[], float]) -> Keys:
        """Return the keys of a process, which it reads again after a change."""
        return _FileKeys(self.files[name], clock)

    def nonce(self) -> int:
        """Return a new nonce."""
        return int(self._draws.integers(0, 1 << 64, dtype=np.uint64))

    def epoch(self) -> int:
        """Return a random epoch."""
        return int(self._draws.integers(1 << 31))

    def change(self, link: str) -> list[Callable[[], None]]:
        """Draw a new key of a link; return what adds it to the files, uses it, removes the old one, and reveals it."""
        old, new = self._secrets[link], self._draws.bytes(MOST_KEY)
        self._secrets[link] = new

        def write(keys: tuple[bytes, ...]) -> None:
            for file in self.files.values():
                if link in file:
                    file[link] = keys

        def reveal() -> None:
            self._former[link] = old

        return [lambda: write((old, new)), lambda: write((new, old)), lambda: write((new,)), reveal]

    @property
    def true(self) -> Keys:
        """The present keys."""
        return Keys({link: (key,) for link, key in self._secrets.items()})

    def wrong(self, link: str, former: bool) -> Keys:
        """Return a key that no process accepts on a link: a former one, that of another link, or an unknown one."""
        other = self._former.get(link, self._secrets[next(name for name in self._secrets if name != link)])
        return Keys.same(other if former else self._draws.bytes(MOST_KEY))
