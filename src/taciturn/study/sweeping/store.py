"""A folder with one file per cell of a sweep, so that an interrupted sweep can continue, and the file of the result."""

from __future__ import annotations

import errno
import hashlib
import logging
import time
import warnings
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taciturn._files import PART, read_bytes, why_unreadable, write_whole
from taciturn.errors import ProblemError
from taciturn.study.record import decode, digest, encode

if TYPE_CHECKING:
    import xarray

LABEL = "store.json"
TOLD = logging.getLogger(__name__)
_READ_ONLY = errno.EROFS, errno.EACCES, errno.EPERM
LARGEST = 2**30  # bytes of a file of a store
FORGOTTEN = 3600.0  # seconds after which an incomplete file is deleted


class Store:
    """Answers on disk, each under the digest of all data that it depends on.

    A file contains a digest of its key and its text, then the text, and is renamed to its final name only when it is
    complete. So all stored answers are complete, even after a crash, and a file under the name of another answer is
    detected. Answers for another problem or version stay in the store but are not used. A store on a read-only disk can
    be read.

    Args:
        folder: an empty folder, a new folder, or a store.
        label: problem and version of the answers, as readable text.

    Raises:
        ProblemError: the folder cannot be created, is new and cannot be written to, or contains other files.
    """

    def __init__(self, folder: str | Path, label: dict[str, str]) -> None:
        """Open the folder, and check whether another problem or version filled it."""
        self.folder, self._filled_by = Path(folder), ""
        try:
            self._open(label)
        except OSError as error:
            raise ProblemError(
                f"the store {str(folder)!r} cannot be used ({why_unreadable(error)}); expected a folder that can be "
                "written to"
            ) from None

    def count(self) -> int:
        """Return the number of stored answers, for all problems and versions."""
        return sum(path.suffix != PART for path in self.folder.glob("cells/*/*"))

    def holds(self, key: str) -> bool:
        """Return whether an answer, possibly damaged, is stored under a key."""
        return self._path(key).is_file()

    def tell(self, found: int, asked: int) -> None:
        """Log the number of requested answers that are stored, and the number of other answers.

        Warn if no requested answer is found in a store that another problem or version filled.
        """
        others = self.count() - found
        if self._filled_by and not found:
            warnings.warn(
                f"the store {str(self.folder)!r} was filled by another {self._filled_by}: its answers stay in the "
                "store and are not used here",
                stacklevel=2,
            )
        elif found or others:
            rest = (
                f"; {others} other answers in it are for other values, or for another precision, seed, problem or "
                "version: they stay in the store, unused"
            )
            TOLD.info("%d of %d cells are read from %s%s", found, asked, self.folder, rest if others else "")

    def read(self, key: str) -> object | None:
        """Return the answer that is stored under a key, or None.

        A file that is damaged, or that is the file of another key under this name, is deleted with a warning.
        """
        path = self._path(key)
        try:
            kept, _, text = read_bytes(path, LARGEST).decode().partition("\n")
            if _digest_under(key, text) == kept:
                return decode(text)
        except FileNotFoundError:
            return None
        except (OSError, ValueError):
            pass
        warnings.warn(
            f"the file {str(path)!r} of the store is damaged, or is the file of another cell under this name; the cell "
            "is computed again",
            stacklevel=2,
        )
        with suppress(OSError):
            path.unlink()
        return None

    def write(self, key: str, answer: object) -> None:
        """Store an answer.

        Raises:
            ProblemError: the answer cannot be written; the answers stored before remain.
        """
        text = encode(answer)
        try:
            write_whole(self._path(key), f"{_digest_under(key, text)}\n{text}".encode())
        except OSError as error:
            raise ProblemError(
                f"the store {str(self.folder)!r} cannot be written to ({error.strerror}); its answers are intact: "
                "free disk space, or correct the cause, and run again to continue"
            ) from None

    def _path(self, key: str) -> Path:
        return self.folder / "cells" / key[:2] / key[2:]

    def _open(self, label: dict[str, str]) -> None:
        if self.folder.is_file():
            raise ProblemError(f"the store {str(self.folder)!r} is a file; expected a folder or an unused name")
        sign, cells = self.folder / LABEL, self.folder / "cells"
        self.folder.mkdir(parents=True, exist_ok=True)
        others = sorted(found.name for found in self.folder.iterdir() if found.suffix != PART)
        if others and LABEL not in others and "cells" not in others:
            raise ProblemError(
                f"the folder {str(self.folder)!r} is not a store and contains other files, such as {others[0]!r}; "
                "expected an empty folder, a new folder, or a store"
            )
        text = encode(label)
        before = read_bytes(sign, LARGEST).decode(errors="replace") if LABEL in others else text
        if before != text:
            self._filled_by = self._differences(before, label)
        if before != text or LABEL not in others:
            try:
                write_whole(sign, text.encode())
            except OSError:
                if "cells" not in others:  # otherwise the answers can be read
                    raise
        for part in (*self.folder.glob(f"*{PART}"), *cells.glob(f"*/*{PART}")):
            with suppress(OSError):
                if time.time() - part.stat().st_mtime > FORGOTTEN:
                    part.unlink()

    def _differences(self, before: str, label: dict[str, str]) -> str:
        """Return the differences between the label of the store and the given label."""
        try:
            kept = dict(decode(before))
        except (ValueError, TypeError):
            warnings.warn(f"{LABEL} of the store {str(self.folder)!r} is damaged and is written again", stacklevel=4)
            return ""
        return "; ".join(
            f"{name} {kept.get(name)!s:.12}, now {now:.12}" for name, now in label.items() if kept.get(name) != now
        )


def _digest_under(key: str, text: str) -> str:
    """Return the digest of an answer's text under its key."""
    return digest(f"{key}\n{text}")


def save_whole(result: xarray.Dataset, path: Path) -> tuple[bool, str]:
    """Write a result as netCDF atomically; another result of the same name is renamed, an equal one is left as it is.

    Returns:
        Whether the file contains the result, which is not the case on a read-only disk; and a note, or "".

    Raises:
        ProblemError: a file cannot be written although the disk is not read-only.
    """
    whole: Any = result  # xarray's types are incomplete
    content = bytes(whole.to_netcdf(None, engine="h5netcdf"))  # in memory, as HDF5 aborts the process on a full disk
    note = ""
    try:
        before = read_bytes(path, max(LARGEST, len(content))) if path.exists() else None
        if before == content:
            return True, ""
        if before is not None:
            aside = path.with_stem(f"{path.stem}-{hashlib.sha256(before).hexdigest()[:12]}")
            write_whole(aside, before)
            note = f"{path} contained another result, which was renamed to {aside.name}"
        write_whole(path, content)
        return True, note
    except OSError as error:
        if error.errno in _READ_ONLY:
            return False, f"{path} is not written ({error.strerror}); --table writes the results to another folder"
        raise ProblemError(
            f"{str(path)!r} cannot be written ({why_unreadable(error)}); the results are in the store: free disk "
            "space, or correct the cause, and run again"
        ) from None
