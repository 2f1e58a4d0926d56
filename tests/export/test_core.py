"""The core in C is what its page promises: strict C99 for several compilers, without data, allocation or libraries."""

from __future__ import annotations

import shutil
import subprocess
from itertools import product
from pathlib import Path

import pytest
from counts import few
from export.devices import CORE, STRICT, write_sizes

from taciturn_export.folder import CORE as FILES
from taciturn_export.folder import CORE_SOURCES

COMPILERS = {"gcc": [], "clang": [], "arm-none-eabi-gcc": ["-mcpu=cortex-m3", "-mthumb"]}
TOOLS = {"gcc": "", "clang": "", "arm-none-eabi-gcc": "arm-none-eabi-"}


@pytest.mark.parametrize("way", few(product(COMPILERS, ["float64", "float32"], ["-O2", "-O0", "-Os"]), 1), ids=str)
def test_the_core_is_strict_c99_and_holds_no_data(tmp_path: Path, way: tuple[str, str, str]) -> None:
    """No warning, no byte of mutable data, and of libraries memcpy and memset and the compiler's own arithmetic."""
    compiler, precision, level = way
    if shutil.which(compiler) is None:
        pytest.skip(f"NOT SHOWN: there is no {compiler}")
    write_sizes(tmp_path, 4, precision)  # type: ignore[arg-type]
    header = "".join((CORE / name).read_text(encoding="ascii") for name in FILES if name.endswith(".h"))
    for name in CORE_SOURCES:
        made = tmp_path / f"{name}.o"
        options = [*COMPILERS[compiler], *STRICT, level, f"-I{CORE}", f"-I{tmp_path}"]
        subprocess.run([compiler, *options, "-c", str(CORE / name), "-o", str(made)], check=True)
        listed = _output(f"{TOOLS[compiler]}nm", str(made)).splitlines()
        kinds = {line.split()[-1]: line.split()[-2] for line in listed}
        needed = {symbol for symbol, kind in kinds.items() if kind == "U"}
        known = {"memcpy", "memset", *(symbol for symbol in needed if f" {symbol}(" in header)}
        assert {symbol for symbol in needed - known if not symbol.startswith(("__aeabi_", "__gnu_thumb"))} == set()
        assert not {symbol for symbol, kind in kinds.items() if kind in "dDbBcC"}
        shown = {symbol for symbol, kind in kinds.items() if kind == "T"}
        assert shown == {symbol for symbol in shown if f"{symbol}(" in header} != set()


def test_lines_are_no_longer_than_120_characters_and_end_where_they_end() -> None:
    """As in Python."""
    for path in (*CORE.iterdir(), *Path(__file__).parent.glob("*.c")):
        for line in path.read_text(encoding="ascii").splitlines():
            assert len(line) <= 120, f"{path.name}: {line}"
            assert line == line.rstrip(), f"{path.name}: {line}"
            assert "\t" not in line, f"{path.name}: {line}"


def _output(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout
