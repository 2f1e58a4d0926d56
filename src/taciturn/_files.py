"""Files that are whole or not there."""

from __future__ import annotations

import secrets
from pathlib import Path

PART = ".part"  # ends the name of what is not whole yet


def write_whole(path: Path, content: bytes) -> None:
    """Write a file under a name of its own, and give it its name once it is whole; a crash leaves the old one, or none.

    Raises:
        OSError: it cannot be written; nothing is left of it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{secrets.token_hex(8)}{PART}")
    try:
        with part.open("xb") as file:
            file.write(content)
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
