"""Atomic writing of files, and reading of files with a limited size."""

from __future__ import annotations

import errno
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from taciturn._ending import at_once

PART = ".part"  # ending of the name of an incomplete file


def write_whole(path: Path, content: bytes, *, private: bool = False) -> None:
    """Write a file atomically: write a temporary file, then rename it, so that a crash leaves no incomplete file.

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
    """Delete the incomplete files that killed processes have left next to a file that one process alone writes."""
    written = re.compile(rf"{re.escape(path.name)}\.[0-9a-f]{{16}}{re.escape(PART)}")
    with suppress(OSError):
        for part in [one for one in path.parent.iterdir() if written.fullmatch(one.name)]:
            part.unlink()


@contextmanager
def temporary_folder() -> Generator[Path]:
    """Provide a folder that is removed after the block, even if the process must end immediately."""
    folder = tempfile.TemporaryDirectory(prefix="taciturn-")
    with folder as name, at_once(lambda: shutil.rmtree(folder.name, ignore_errors=True)):
        yield Path(name)


def check_regular(path: Path) -> None:
    """Raise an ``OSError`` if a path is a device, a pipe or a folder, from which reading may block or never end."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))


def read_whole(path: Path, most: int) -> bytes:
    """Return the content of a regular file with at most ``most`` bytes.

    Raises:
        OSError: the file is not regular, cannot be read, or is larger.
    """
    check_regular(path)
    return _limited(path, most)


def read_text(path: Path, most: int) -> str:
    """Return the UTF-8 text of a file with at most ``most`` bytes; a byte-order mark is accepted.

    Raises:
        OSError: the file cannot be read, or is larger.
        UnicodeDecodeError: the file is not UTF-8 text.
    """
    return _limited(path, most).decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")


def _limited(path: Path, most: int) -> bytes:
    with path.open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"it has more than {most:,} bytes", str(path))
    return content
