"""Cache of compiled programs on disk: a folder that only this user can write, with one file per program.

A cached file is executed, so it is used only if no other user can have written it: file and folder belong to this user
or to root, and neither the group nor others may write to them.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
import sys
import warnings
from pathlib import Path

from taciturn._files import open_regular, write_whole

SPARE = 8  # files are deleted when the limit is exceeded by 1/8, since deletion reads the age of each file
LARGEST = 2**28  # bytes of a compiled program
PRIVATE = 0o700  # mode of the folder
LAYOUT = "digest of key and code, code"  # of a file; part of its key


def cache_folder() -> Path | None:
    """Return the folder of the cache, created with mode 0700 if needed, or None if no folder can be trusted."""
    folder = _place()
    if folder is None:
        return None
    try:
        folder.mkdir(PRIVATE, parents=True, exist_ok=True)
        found = folder.stat()
        if _is_ours(found) and stat.S_IMODE(found.st_mode) & ~PRIVATE:
            folder.chmod(PRIVATE)
            if _why_not(found) is not None:  # others could have written the files, too
                _warn(f"other users could write to the cache folder {folder}; its compiled programs were deleted")
                for path in folder.glob("*.o"):
                    path.unlink(missing_ok=True)
            found = folder.stat()
    except OSError:
        return None
    if (reason := _why_not(found)) is not None:
        _warn(
            f"the cache folder {folder} {reason}, so it is not used and every process compiles its programs; expected "
            "a folder of this user in XDG_CACHE_HOME"
        )
        return None
    return folder


def read_code(folder: Path, key: str) -> bytes | None:
    """Return the cached object code of a program, or None if no complete and trusted file exists."""
    path = folder / f"{key}.o"
    try:
        with open_regular(path) as file:
            found = os.fstat(file.fileno())
            reason = "is larger than any program" if found.st_size > LARGEST else _why_not(found)
            content = file.read() if reason is None else b""
    except OSError:
        return None
    with contextlib.suppress(OSError):  # the time of use cannot be recorded in a read-only folder
        os.utime(path)
    digest, code = content[:32], content[32:]
    if reason is None and (not code or _digest(key, code) != digest):
        reason = "is damaged"
    if reason is not None:
        _warn(f"the cached machine code {path} {reason}; the program is compiled again")
        return None
    return code


def write_code(folder: Path, key: str, code: bytes, most: int) -> None:
    """Store object code in the cache atomically; delete the least recently used files beyond ``most``."""
    with contextlib.suppress(OSError):  # without a writable folder, every process compiles its programs
        write_whole(folder / f"{key}.o", _digest(key, code) + code, private=True)
        if len(os.listdir(folder)) > most + most // SPARE:
            kept = sorted(folder.glob("*.o"), key=lambda file: file.stat().st_mtime)
            for oldest in kept[:-most]:
                oldest.unlink()


def _place() -> Path | None:
    """Return the path of the folder: in XDG_CACHE_HOME if this path is absolute, or else that of the platform."""
    import platformdirs  # imported only when a program is compiled

    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if given.is_absolute():
        return given / "taciturn"
    try:
        if sys.platform == "win32":
            found = platformdirs.user_cache_path("taciturn", appauthor=False)
        else:  # platformdirs would use a relative XDG_CACHE_HOME
            found = Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "taciturn"
    except RuntimeError:
        return None  # no home folder: compile each time, since other users could write to a shared folder
    return found if found.is_absolute() else None


def _digest(key: str, code: bytes) -> bytes:
    """Return the digest of a file, which differs for the same code under another name."""
    return hashlib.sha256(key.encode() + code).digest()


def _is_ours(found: os.stat_result) -> bool:
    """Return whether a file belongs to this user; False on Windows, which has no user numbers."""
    user = getattr(os, "geteuid", None)
    return user is not None and found.st_uid == user()


def _why_not(found: os.stat_result) -> str | None:
    """Return why another user may have written a file or folder, or None; on Windows, the profile folder is private."""
    if not hasattr(os, "geteuid"):
        return None
    if not _is_ours(found) and found.st_uid != 0:
        return "belongs to another user"
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return "can be written by other users"
    return None


def _warn(sentence: str) -> None:
    warnings.warn(sentence, stacklevel=3)
