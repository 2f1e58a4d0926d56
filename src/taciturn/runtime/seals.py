"""Digests of saved states, which show that a state is the one that was saved.

A digest detects damage, such as a bad sector or an edited file. It is no signature: whoever can write the file can also
write its digest.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from taciturn.errors import ProblemError

SEAL = "digest"


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return values that JSON can represent, with their digest.

    Example:
        >>> saved = sealed({"tick": 3})
        >>> check_seal(saved, "the saved state")
        >>> saved["digest"] == sealed({"tick": 4})["digest"]
        False
    """
    return {**content, SEAL: _digest(content)}


def check_seal(saved: Mapping[str, Any], name: str) -> None:
    """Check the digest of saved values.

    Raises:
        ProblemError: the values differ from those that were saved.
    """
    if saved.get(SEAL) != _digest({key: value for key, value in saved.items() if key != SEAL}):
        raise ProblemError(
            f"{name} is not a saved state of a node, or it was changed after it was saved (its digest differs); "
            "expected the unchanged result of Node.save: start the node without it"
        )


def _digest(content: Mapping[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True)
    return hashlib.blake2s(text.encode(), digest_size=16).hexdigest()
