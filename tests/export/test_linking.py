"""Exported C of one precision and sizes does not link with that of others, whoever calls whom."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from export.devices import needs_compiler
from export.test_folders import two_mass, write

from taciturn_export.folder import CORE_SOURCES, print_folder


@pytest.fixture(scope="module")
def precisions(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return a folder in each precision."""
    into, loop = tmp_path_factory.mktemp("precisions"), two_mass()
    return {
        one: write(into / one, print_folder(replace(loop, precision=one), "two_mass", rows=1))
        for one in ("float64", "float32")
    }


@pytest.mark.evidence
@pytest.mark.parametrize(("one", "other"), [("float64", "float32"), ("float32", "float64")])
def test_files_of_other_sizes_are_not_linked(one: str, other: str, precisions: dict[str, Path], tmp_path: Path) -> None:
    """Nodes in one precision with a core in the other: the linker says so."""
    mixed = [precisions[one] / f"two_mass_{role}.c" for role in ("controller", "actuator")]
    others = [path for path in precisions[other].glob("*.c") if path.name not in {file.name for file in mixed}]
    code, said = link([*mixed, *others], tmp_path)
    assert code != 0
    assert f"tac_start_{one}" in said


@pytest.mark.evidence
@pytest.mark.parametrize(("one", "other"), [("float64", "float32"), ("float32", "float64")])
def test_a_program_of_other_sizes_is_not_linked(
    one: str, other: str, precisions: dict[str, Path], tmp_path: Path
) -> None:
    """A user's program with the headers in one precision, and all sources in the other: no function is found."""
    calls = ["tac_watch(node, 3, NULL)", "tac_receive(node, datagram, 1)", "tac_step(node, 0, NULL, NULL)"]
    calls += ["tac_heard(node)", "tac_send(node, datagram)", "tac_input(node)", "tac_degraded(node)"]
    main = tmp_path / "main.c"
    main.write_text(
        '#include "two_mass_actuator.h"\n'
        "static two_mass_actuator memory;\n"
        "static uint8_t datagram[TAC_DATAGRAM];\n"
        "int main(void) {\n"
        "  const tac_key none = {NULL, 0};\n"
        "  tac_node *node = two_mass_actuator_start(&memory, 1, 0, none);\n"
        + "".join(f"  (void)({call});\n" if "watch" not in call else f"  {call};\n" for call in calls)
        + "  return 0;\n}\n"
    )
    called = {"two_mass_actuator_start", *(call.partition("(")[0] for call in calls)}
    for precision, refused in ((one, set[str]()), (other, called)):
        sources = [path for path in precisions[precision].glob("*.c") if not path.name.startswith("selfcheck")]
        code, said = link([main, *sources], tmp_path, f"-I{precisions[one]}")
        assert (code != 0) == bool(refused)
        assert {name for name in called if f"{name}_{one}" in said} == refused


def link(sources: Sequence[Path], into: Path, *options: str) -> tuple[int, str]:
    """Return how the compiler ends with these sources, and what it says."""
    command = [needs_compiler(), "-std=c99", *options, *map(str, sources), "-o", str(into / "linked")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


def test_every_function_of_the_core_has_the_sizes_in_its_name(precisions: dict[str, Path], tmp_path: Path) -> None:
    """As the linker knows it; a new one too."""
    names = [*(name.removesuffix(".c") for name in CORE_SOURCES), "two_mass_controller"]
    sources = [f"{name}.c" for name in names]
    subprocess.run([needs_compiler(), "-c", *sources], cwd=precisions["float64"], check=True)
    listed = subprocess.run(
        ["nm", *(f"{name}.o" for name in names)], cwd=precisions["float64"], check=True, capture_output=True, text=True
    ).stdout.splitlines()
    shown = [line.split()[-1] for line in listed if " T " in line]
    headers = [path.read_text() for path in precisions["float64"].glob("*.h")]
    defined = {name for text in headers for name in re.findall(r"#define (\w+) TAC_SIZED", text)}
    assert {name.partition("_float64")[0] for name in shown} == defined - {"two_mass_actuator_start"}
    assert all(re.search(r"_float64_\d+_\d+_\d+_4$", name) for name in shown), shown
