"""Robots that are ready to run, and short missions for them."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import pytest

from taciturn.errors import ProblemError
from taciturn.twin.mission import write_toml
from taciturn.twin.prepared import Prepared, prepare


@cache
def crew(name: str) -> Prepared:
    """Return a robot whose camera is calibrated and whose model is identified, or skip where nothing can be drawn."""
    try:
        return prepare(name)
    except ProblemError as error:
        if "OpenGL" in str(error):
            pytest.skip(f"NOT SHOWN: the twins of the robots; {error}")
        raise


def short_mission(name: str, ticks: int, folder: Path, **policy: float) -> str:
    """Return a problem file with the first ticks of a robot's mission."""
    tables: dict[str, Any] = crew(name).tables(policy)
    tables["cost"] = {**tables["cost"], "horizon": ticks}
    if "reference" in tables:
        whole = tables["reference"]
        tables["reference"] = {"states": whole["states"][: ticks + 1], "inputs": whole["inputs"][:ticks]}
    path = folder / f"{name}-{ticks}-{policy.get('price', policy.get('theta', ''))}.toml"
    path.write_text(write_toml(tables))
    return str(path)
