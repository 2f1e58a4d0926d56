"""The laws of bursty losses, one per file: a class derived from ``LossLaw`` and, at the end, its name ``LAW``.

A problem file names the law with the key ``law``: the name of the file, with hyphens in place of underscores. A package
of one's own registers a law by an entry point of the group ``taciturn.bursts``. A new law needs no other entry.
"""

from __future__ import annotations

import json
import pkgutil
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any, cast

from taciturn._plugins import find_plugins, load_entry
from taciturn.errors import ProblemError
from taciturn.model.losses import LossLaw

GROUP = "taciturn.bursts"
USUAL = "gilbert-elliott"


def law_names() -> list[str]:
    """Return the names of all laws: those of this folder, and those of installed packages."""
    own = sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules([str(Path(__file__).parent)]))
    return [*own, *(name for name in find_plugins(GROUP) if name not in own)]


@cache
def find_law(name: str) -> type[LossLaw]:
    """Return the class of a law.

    Raises:
        ProblemError: there is no such law, or its class cannot be imported.
    """
    from importlib.metadata import EntryPoint

    if name not in law_names():
        raise ProblemError(f"law is {name!r}; expected one of {', '.join(law_names())}")
    own = EntryPoint(name, f"taciturn.model.bursts.{name.replace('-', '_')}:LAW", GROUP)
    found = load_entry(find_plugins(GROUP).get(name, (own,))[0], f"the law {name} of losses")
    if not (isinstance(found, type) and issubclass(found, LossLaw)):
        raise ProblemError(f"the law {name} of losses is {found!r}; expected a class derived from LossLaw")
    return found


def _is_of(law: LossLaw, name: str) -> bool:
    """Return whether a name is that of a law; that of a broken package is not."""
    try:
        return find_law(name) is type(law)
    except ProblemError:
        return False


def law_text(law: LossLaw) -> str:
    """Return a law in one word, as the option ``--burst`` of a relay reads it.

    Example:
        >>> from taciturn import Burst
        >>> law_text(Burst(0.05, 0.3, 0.01, 0.7))
        'gilbert-elliott:0.05,0.3,0.01,0.7'
    """
    name = next((name for name in law_names() if _is_of(law, name)), None)
    if name is None:
        raise ProblemError(
            f"losses follow {type(law).__name__}, which other processes cannot find; expected a law with a name: "
            f"register the class by an entry point of the group {GROUP}"
        )
    values = [getattr(law, field.name) for field in fields(cast("Any", law))]
    return f"{name}:{json.dumps(values, separators=(',', ':'))[1:-1]}"


def read_law(name: str, text: str) -> LossLaw:
    """Return the law that a text describes: its values in their order, after the name of a law and a colon, if given.

    Args:
        name: name of the option, for messages.
        text: such as ``0.05,0.3,0.01,0.7``.

    Raises:
        ProblemError: there is no such law, or the values are not those of the law.
    """
    stated, colon, values = text.rpartition(":")
    law_name, known = stated if colon else USUAL, law_names()
    try:
        given = cast("list[Any]", json.loads(f"[{values}]") if law_name in known else [])
    except json.JSONDecodeError:
        given = []
    if given and len(given) == len(_keys(law_name)):
        try:
            return find_law(law_name)(*given)
        except ProblemError as error:
            raise ProblemError(f"{name} is {text!r}; {error}") from None
    forms = [f"{one}:{','.join(_keys(one))}" for one in ([stated] if stated in known else known)]
    raise ProblemError(
        f"{name} is {text!r}; expected {' or '.join(forms)}, with a number or a list of numbers in place of each name"
    )


def _keys(law_name: str) -> list[str]:
    return [field.name for field in fields(cast("Any", find_law(law_name)))]
