"""Files that are whole or not there."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

PART = ".part"  # ends the name of what is not whole yet


def write_whole(path: Path, content: bytes) -> None:
    """Write a file under a name of its own, and give it its name once it is whole; a crash leaves the old one, or none.

    Raises:
        OSError: it cannot be written; nothing is left of it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, part = tempfile.mkstemp(dir=path.parent, suffix=PART)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
        os.replace(part, path)
    except BaseException:
        os.unlink(part)
        raise
