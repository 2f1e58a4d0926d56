"""Atomic writing of files, and reading of the files that a user names, which must be regular and not too large."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from taciturn._process import at_once

PART = ".part"  # ending of the name of an incomplete file


def write_whole(path: Path, content: bytes, *, private: bool = False) -> None:
    """Write a file atomically: write a temporary file and rename it, so that a crash leaves no incomplete file.

    Args:
        path: the file; missing folders are created.
        content: the content.
        private: whether only this user may read and write the file (POSIX).

    Raises:
        OSError: the file cannot be written; the temporary file is deleted.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{secrets.token_hex(8)}{PART}")
    try:
        with part.open("xb") as file:
            if private:
                part.chmod(0o600)
            file.write(content)
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def delete_parts(path: Path) -> None:
    """Delete incomplete files that earlier processes left next to ``path``. No other process may write ``path``."""
    written = re.compile(rf"{re.escape(path.name)}\.[0-9a-f]{{16}}{re.escape(PART)}")
    with suppress(OSError):
        for part in [one for one in path.parent.iterdir() if written.fullmatch(one.name)]:
            part.unlink()


@contextmanager
def temporary_folder() -> Generator[Path]:
    """Create a temporary folder for the block, and delete it afterwards, also if a signal ends the process at once."""
    folder = tempfile.TemporaryDirectory(prefix="taciturn-")
    with folder as name, at_once(lambda: shutil.rmtree(folder.name, ignore_errors=True)):
        yield Path(name)


def check_regular(path: Path) -> None:
    """Raise ``OSError`` unless the path is a regular file, because reading a device or a pipe may never end."""
    _check_mode(path.stat().st_mode, path)


@contextmanager
def open_regular(path: Path) -> Generator[BinaryIO]:
    """Open a file that the user has named, for reading. Raise ``OSError`` for a pipe, a device or a folder."""
    # Every file that a user names is opened here, or checked by ``check_regular`` if a library opens it by its name.
    check_regular(path)  # before it is opened, since opening a device may have effects
    with open(path, "rb", opener=_open_at_once) as file:
        _check_mode(os.fstat(file.fileno()).st_mode, path)  # another file may have taken its place
        yield file


def read_bytes(path: Path, most: int) -> bytes:
    """Read a regular file. Raise an error if the file is larger than ``most`` bytes.

    Raises:
        OSError: the file cannot be read, is not regular, or is larger.
    """
    with open_regular(path) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"it has more than {most:,} bytes", str(path))
    return content


def read_text(path: Path, most: int) -> str:
    """Read a regular file of at most ``most`` bytes as UTF-8 text. A byte-order mark at its beginning is ignored.

    Raises:
        OSError: the file cannot be read, is not regular, or is larger.
        UnicodeDecodeError: the file is not UTF-8 text.
    """
    return read_bytes(path, most).decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")


def why_unreadable(error: Exception) -> str:
    """Write, for an error message, why ``read_bytes`` or ``read_text`` has raised the exception ``error``."""
    if isinstance(error, UnicodeDecodeError):
        return f"it is not UTF-8 text: {error.reason}"
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def _open_at_once(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0))


def _check_mode(mode: int, path: Path) -> None:
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
