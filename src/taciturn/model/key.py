"""Metadata that state how the keys of a problem file correspond to the fields of a model class.

``problem.schema`` reads a table by the fields of its class: each field is a key with its type, which must be given if
its argument has no default. So a new property of a link is one field of ``LinkLaw`` and one line of its docstring.
Ranges are checked by the class itself, since an instance may also be made without a file.

Only what a file states in another way needs metadata: an array, which is a list there, or a table of its own. A note
is the comment above the key in a file that ``taciturn new`` writes, with ``{per}`` for the time base of the plant.
"""

from __future__ import annotations

from typing import Annotated, Any

Rows = list[list[float]]  # a matrix
NO_KEY = {"kind": None}  # of a field that the table does not state


def stated_as(kind: Any, name: str | None = None, note: str = "") -> dict[str, Any]:
    """Return metadata for a field whose key in problem files has another type or name, or needs a note.

    A key whose type contains None may be omitted.
    """
    return {"kind": kind, "name": name, "note": note}


def table_of(*classes: type) -> Any:
    """Return the type of a table in problem files whose keys are the fields of the given classes."""
    return Annotated[(dict[str, Any], *classes)]
