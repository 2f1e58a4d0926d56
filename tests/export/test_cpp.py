"""Exported C is also C++11: its files, its numbers and the order of its data."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from counts import few
from export.devices import STRICT
from export.test_folders import AGREES, large, run_check, two_mass, write
from hypothesis import given
from hypothesis import strategies as st
from parity.loops import with_functions
from systems import make_system

import taciturn
from taciturn.program.c import c_literal
from taciturn.program.ops import Precision
from taciturn_export.folder import print_folder


@pytest.mark.evidence
@pytest.mark.parametrize("way", few(product(["g++", "clang++"], ["float64", "float32"]), 1, 1), ids=str)
@pytest.mark.parametrize("name", few(["lossy", "functions", "large"], 1))
def test_every_file_is_also_cpp(name: str, way: tuple[str, Precision], tmp_path: Path) -> None:
    """As C++11 without a warning of a pedantic compiler, with the same bits; no number is hexadecimal."""
    compiler, precision = way
    if shutil.which(compiler) is None:
        pytest.skip(f"NOT SHOWN: there is no {compiler}")
    problem = taciturn.load("lossy-double-integrator")
    loops = {
        "lossy": lambda: problem.close(problem.design()),
        "functions": lambda: with_functions(make_system(5, 3, 2, 2, False), 1),
        "large": lambda: large(20),
    }
    found = print_folder(replace(loops[name](), precision=precision), "policy", rows=100)
    folder = write(tmp_path, found)
    flags = [flag for flag in STRICT if flag not in ("-std=c99", "-Wstrict-prototypes")]
    sources = ["-x", "c++", "-std=c++11", *flags, "-ffp-contract=off", *map(str, sorted(folder.glob("*.c")))]
    subprocess.run([compiler, *sources, "-o", str(folder / "selfcheck")], check=True)
    assert run_check(folder / "selfcheck") == (0, f"policy: 100 {AGREES}")
    assert not [name for name, text in found.files.items() if re.search(r"\b0x[0-9a-f.]+p[+-]?\d", text)]


@given(st.floats(allow_nan=False), st.sampled_from(("float64", "float32")))
def test_literals_are_exact_and_decimal(value: float, precision: Precision) -> None:
    """Read again, a literal is the number: to the bit, also where the number is the smallest."""
    with np.errstate(over="ignore"):
        kept = float(np.dtype(precision).type(value))
        text = c_literal(value, precision)
    if np.isinf(kept):
        assert text == f"{'-' if kept < 0 else ''}(tac_real)INFINITY"
    else:
        assert re.fullmatch(r"-?\d+(\.\d+)?(e[+-]\d+)?f?", text)
        assert np.dtype(precision).type(text.rstrip("f")).tobytes() == np.dtype(precision).type(kept).tobytes()


def test_the_data_of_a_node_are_in_the_order_of_their_type() -> None:
    """C++11 has no names in initializers; comments have them, and they are those of the header, one by one."""
    found = print_folder(two_mass(), "two_mass", rows=1).files
    body = found["taciturn.h"].split("typedef struct {")
    fields = next(part for part in body if "} tac_node_data;" in part).partition("}")[0]
    fields = re.sub(r"/\*.*?\*/", "", fields)
    names = re.findall(r"(?:\(\*)?\b(\w+)(?:\)\([^)]*\))?(?:\[\d\])?;", fields)
    data = found["two_mass_controller.c"].partition("tac_node_data data = {")[2].partition("};")[0]
    assert re.findall(r"/\* (\w+) \*/", data) == names
    assert len(names) > 20
