"""A folder that keeps one file for each cell of a sweep, so that nothing that was computed is lost."""

from __future__ import annotations

import logging
import time
import warnings
from contextlib import suppress
from pathlib import Path

from taciturn._files import PART, write_whole
from taciturn.errors import ProblemError
from taciturn.study.record import decode, digest, encode

LABEL = "store.json"
TOLD = logging.getLogger(__name__)
FORGOTTEN = 3600.0  # seconds after which a file that never became whole is nobody's


class Store:
    """Answers on disk, each under the digest of everything that it depends on.

    A file holds the digest of its text and the text, and has its name only once it is whole: whatever dies at whatever
    moment, the store holds answers that are complete. What was kept for another problem or version stays, unused.

    Args:
        folder: empty, missing, or a store.
        label: what the answers belong to, as words for people.

    Raises:
        ProblemError: the folder cannot be made or written to, or holds other files.
    """

    def __init__(self, folder: str | Path, label: dict[str, str]) -> None:
        """Open the folder, and see whether it was filled by another problem or version."""
        self.folder, self._filled_by = Path(folder), ""
        try:
            self._open(label)
        except OSError as error:
            raise ProblemError(
                f"the store {str(folder)!r} cannot be used ({error.strerror}); expected a folder that can be written to"
            ) from None

    def count(self) -> int:
        """Return how many answers are kept, whatever they belong to."""
        return sum(path.suffix != PART for path in self.folder.glob("cells/*/*"))

    def holds(self, key: str) -> bool:
        """Tell whether an answer is kept under a key, damaged or not."""
        return self._path(key).is_file()

    def tell(self, found: int, asked: int) -> None:
        """Say how many of the answers that are asked for are found, and how many others there are.

        Warns where none is found in a store that another problem or version filled.
        """
        others = self.count() - found
        if self._filled_by and not found:
            warnings.warn(
                f"the store {str(self.folder)!r} was filled by another {self._filled_by}: what it holds for that "
                "stays, and is not used here",
                stacklevel=2,
            )
        elif found or others:
            rest = (
                f"; {others} more that it holds have other values, another precision, seed, problem or version: "
                "they stay, unused"
            )
            TOLD.info("%d of %d cells are read from %s%s", found, asked, self.folder, rest if others else "")

    def read(self, key: str) -> object | None:
        """Return the answer that is kept under a key, or None; a damaged file is warned of and taken away."""
        path = self._path(key)
        try:
            content = path.read_bytes()
        except OSError:
            return None
        try:
            kept, _, text = content.decode().partition("\n")
            if digest(text) == kept:
                return decode(text)
        except ValueError:
            pass
        warnings.warn(f"the file {str(path)!r} of the store is damaged; its cell is computed again", stacklevel=2)
        with suppress(OSError):
            path.unlink()
        return None

    def write(self, key: str, answer: object) -> None:
        """Keep an answer.

        Raises:
            ProblemError: the disk does not take it; what was kept before stays.
        """
        text = encode(answer)
        try:
            write_whole(self._path(key), f"{digest(text)}\n{text}".encode())
        except OSError as error:
            raise ProblemError(
                f"the store {str(self.folder)!r} cannot be written to ({error.strerror}); what it holds is whole: "
                "make room, or mend what is wrong, and run again to go on"
            ) from None

    def _path(self, key: str) -> Path:
        return self.folder / "cells" / key[:2] / key[2:]

    def _open(self, label: dict[str, str]) -> None:
        if self.folder.is_file():
            raise ProblemError(f"the store {str(self.folder)!r} is a file; expected a folder, or a name that is free")
        sign, cells = self.folder / LABEL, self.folder / "cells"
        self.folder.mkdir(parents=True, exist_ok=True)
        others = sorted(found.name for found in self.folder.iterdir() if found.suffix != PART)
        if others and LABEL not in others and "cells" not in others:
            raise ProblemError(
                f"the folder {str(self.folder)!r} is no store and holds other files, as {others[0]!r}; expected an "
                "empty folder, one that is not there yet, or a store"
            )
        text = encode(label)
        before = sign.read_text(encoding="utf-8", errors="replace") if LABEL in others else text
        if before != text:
            self._filled_by = self._differences(before, label)
        if before != text or LABEL not in others:  # a store that is complete may be read only
            write_whole(sign, text.encode())
        for part in (*self.folder.glob(f"*{PART}"), *cells.glob(f"*/*{PART}")):
            with suppress(OSError):
                if time.time() - part.stat().st_mtime > FORGOTTEN:
                    part.unlink()

    def _differences(self, before: str, label: dict[str, str]) -> str:
        """Return in what the problem or version that filled the store differs from those of the label."""
        try:
            kept = dict(decode(before))
        except (ValueError, TypeError):
            warnings.warn(f"{LABEL} of the store {str(self.folder)!r} is damaged; it is written again", stacklevel=4)
            return ""
        return "; ".join(
            f"{name} {kept.get(name)!s:.12}, now {now:.12}" for name, now in label.items() if kept.get(name) != now
        )
