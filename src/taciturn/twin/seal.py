"""Pictures that tell whether they are whole: a JPEG that carries a checksum of itself in a comment.

A decoder makes a picture of a damaged JPEG as well, in which everything behind the damage may have moved.
"""

from __future__ import annotations

import zlib

_START = b"\xff\xd8"  # of every JPEG
_COMMENT = b"\xff\xfe\x00\x0e" + b"CRC-32: "  # a segment of 14 bytes, its length included


def seal(picture: bytes) -> bytes:
    """Return a JPEG with its checksum.

    Example:
        >>> whole = seal(bytes.fromhex("ffd8ffd9"))
        >>> is_whole(whole), is_whole(whole[:-1])
        (True, False)
    """
    rest = picture[len(_START) :]
    return _START + _COMMENT + zlib.crc32(rest).to_bytes(4, "big") + rest


def is_whole(picture: bytes) -> bool:
    """Tell whether a picture is a JPEG that was sealed, and has not changed since."""
    head = _START + _COMMENT
    if not picture.startswith(head):
        return False
    rest = picture[len(head) + 4 :]
    return picture[len(head) : len(head) + 4] == zlib.crc32(rest).to_bytes(4, "big")
