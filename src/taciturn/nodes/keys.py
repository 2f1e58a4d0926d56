"""Secret keys that authenticate the packets of each link. They are read from a file or from the environment.

A file contains one line ``LINK: KEY`` for each link that a process uses, with hexadecimal digits, or one line ``KEY``
for all links. A line may contain several keys: the first authenticates the packets that the process sends, and the
process accepts packets of all of them. A process reads the file again when it changes, so keys
change without a stop.
"""

from __future__ import annotations

import ipaddress
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from taciturn._files import read_text, why_unreadable
from taciturn._text import number_of
from taciturn.errors import ProblemError

KEY, _LEAST_KEY, MOST_KEY = "TACITURN_KEY", 16, 32  # environment variable; shortest and longest BLAKE2s key in bytes
_LARGEST = 2**20  # bytes of a key file
_LOOKED = 1.0  # seconds between checks whether a key file has changed
_EVERY = ""  # name under which a key for all links is stored


class Keys:
    """The secret keys of each link, which authenticate its packets.

    Args:
        links: keys by link; the first of a link authenticates the packets that are sent. The keys of ``plant`` are also
            those of the links ``plant/NODE``.
        source: origin of the keys, for messages.

    Raises:
        ProblemError: a key is too short or too long.

    Example:
        >>> keys = Keys.parse("sensor: " + "01" * 16 + "\\nactuator: " + "02" * 16 + " " + "03" * 16)
        >>> [len(keys.of(link)) for link in ("sensor", "actuator", "plant")]
        [1, 2, 0]
    """

    def __init__(self, links: Mapping[str, Iterable[bytes]], source: str = "the key") -> None:
        """Check the lengths of the keys."""
        self._links = {link: tuple(keys) for link, keys in links.items()}
        self._source, self._used = source, dict[str, tuple[str, ...]]()
        for key in (key for keys in self._links.values() for key in keys):
            if not _LEAST_KEY <= len(key) <= MOST_KEY:
                raise ProblemError(
                    f"{source} has {number_of(len(key), 'byte')}; expected {_LEAST_KEY} to {MOST_KEY} bytes: use "
                    "`openssl rand -hex 32`"
                )

    @staticmethod
    def same(key: bytes) -> Keys:
        """Use the same key for all links."""
        return Keys({_EVERY: (key,)})

    @staticmethod
    def parse(text: str, source: str = "the text") -> Keys:
        """Read the keys of the links from text, such as the contents of a key file.

        Raises:
            ProblemError: a line has another form, or a key is too short or too long.
        """
        links: dict[str, tuple[bytes, ...]] = {}
        for line in (line.partition("#")[0].strip() for line in text.splitlines()):
            if not line:
                continue
            name, colon, digits = line.rpartition(":")
            link = name.strip() if colon else _EVERY
            if link in links:
                raise ProblemError(
                    f"{source} has two lines for {f'the {link} link' if link else 'all links'}; expected all keys of a "
                    "link on one line, separated by spaces"
                )
            if links and _EVERY in (link, *links):
                raise ProblemError(
                    f"{source} has both a key for all links and keys for single links; expected one line KEY, or a "
                    "line LINK: KEY for each link"
                )
            links[link] = tuple(_key(word, source) for word in digits.split())
        if not any(links.values()):
            raise ProblemError(f"{source} contains no key; expected hexadecimal digits: use `openssl rand -hex 32`")
        return Keys(links, source)

    def of(self, link: str) -> tuple[bytes, ...]:
        """Return the keys of a link. The tuple is empty if the link has none."""
        return next((self._links[one] for one in (link, link.partition("/")[0], _EVERY) if one in self._links), ())

    def expect(self, links: Sequence[str]) -> None:
        """Check that the links for which there are keys belong to the network.

        Raises:
            ProblemError: a key has the name of another link.
        """
        for link in self._links.keys() - {*links, _EVERY}:
            raise ProblemError(f"{self._source} names the link {link!r}; expected one of the links {', '.join(links)}")

    def check(self, role: str, links: Iterable[str]) -> None:
        """Check that there is a key for each link that a process uses. Each change of the keys repeats the check.

        Raises:
            ProblemError: a key is missing.
        """
        self._used[role] = tuple(links)
        for link in self._used[role]:
            if not self.of(link):
                raise ProblemError(
                    f"the {role} has no key for the {link} link, which it uses; expected a line '{link}: KEY' in the "
                    "key file"
                )

    def text(self) -> str:
        """Write the keys as text, which another process reads from its environment."""
        lines = {link: " ".join(key.hex() for key in keys) for link, keys in self._links.items()}
        return "\n".join(f"{link}: {digits}" if link else digits for link, digits in lines.items())

    def renew(self) -> str | None:
        """Read the keys again if their source has changed; return a message about the change, or None."""
        return None


class RenewedKeys(Keys, ABC):
    """Keys from a source that may change. ``renew`` reads the keys again if the source has changed."""

    def __init__(self, clock: Callable[[], float]) -> None:
        """Read the source."""
        self._clock, self._looked = clock, clock()
        self._stamp = self._stamped()
        super().__init__(self._read())

    @abstractmethod
    def _stamped(self) -> object:
        """Return a value that differs after a change of the source."""

    @abstractmethod
    def _read(self) -> Mapping[str, tuple[bytes, ...]]:
        """Return the keys in the source, by link."""

    def renew(self) -> str | None:
        """Read the keys again if their source has changed. The old keys stay in use if the new ones are invalid."""
        if 0.0 <= self._clock() - self._looked < _LOOKED:
            return None
        self._looked = self._clock()
        stamp = self._stamped()
        if stamp == self._stamp:
            return None
        self._stamp = stamp
        try:
            links = self._read()
            former = [link for link, keys in self._links.items() if keys and link != _EVERY]
            for role, used in {"process": former, **self._used}.items():
                Keys(links).check(role, used)
        except ProblemError as error:
            return f"{error}; the former keys remain in use"
        if dict(links) == self._links:
            return None
        self._links = dict(links)
        return f"the keys of {self} have changed; the new keys are in use"


class KeyFile(RenewedKeys):
    """Keys from a file. ``renew`` reads the keys again if the file has changed."""

    def __init__(self, path: str | Path) -> None:
        """Read the file."""
        self._path = Path(path)
        super().__init__(time.monotonic)
        self._source = f"the key file {path}"

    def __str__(self) -> str:
        """Return the name of the file."""
        return str(self._path)

    def _stamped(self) -> tuple[int, ...]:
        """Return numbers that differ after a change of the file."""
        try:
            found = self._path.stat()
        except OSError:
            return ()
        return found.st_mtime_ns, found.st_size, found.st_ino, found.st_mode

    def _read(self) -> dict[str, tuple[bytes, ...]]:
        source = f"the key file {self._path}"
        try:
            text, mode = read_text(self._path, _LARGEST), self._path.stat().st_mode & 0o777
        except (OSError, UnicodeDecodeError) as error:
            raise ProblemError(
                f"{source} cannot be read ({why_unreadable(error)}); expected a file with hexadecimal digits"
            ) from None
        if os.name == "posix" and mode & 0o077:
            raise ProblemError(
                f"{source} has the mode {mode:04o}, with which other users can read it; expected 0600: use "
                f"`chmod 600 {self._path}`, and a new key if another user may have read this one"
            )
        return Keys.parse(text, source)._links


def read_keys(path: str | Path | None = None, hosts: Iterable[str] = ()) -> Keys | None:
    """Read the keys from a file, or from the environment variable ``TACITURN_KEY``; return None if there are none."""
    if path is not None:
        return KeyFile(path)
    text, source = os.environ.get(KEY, ""), f"the environment variable {KEY}"
    other = next((host for host in hosts if not is_loopback(host)), None)
    if not text and KEY in os.environ and other is not None:
        raise ProblemError(
            f"{source} is empty, so packets from and to {other} would not be authenticated; expected "
            f"{2 * _LEAST_KEY} to {2 * MOST_KEY} hexadecimal digits: use `openssl rand -hex 32`, or unset the "
            "variable to run without a key"
        )
    return Keys.parse(text, source) if text else None


def _key(digits: str, source: str) -> bytes:
    """Return a key from hexadecimal digits."""
    try:
        return bytes.fromhex(digits)
    except ValueError:
        raise ProblemError(
            f"{source} contains characters that are not hexadecimal digits; expected {2 * _LEAST_KEY} to "
            f"{2 * MOST_KEY} digits"
        ) from None


def is_loopback(host: str) -> bool:
    """Check whether a host name or an address is that of this machine."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
