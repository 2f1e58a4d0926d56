"""Nodes in C check their constant data when they start, and start from no others."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from counts import few
from export.devices import CORE, Device, compile_core_for, compile_node, needs_compiler
from export.test_folders import compile_check, run_check, two_mass, write
from export.test_nodes_in_c import LOOPS, places

from taciturn_export.folder import print_folder
from taciturn_export.node import FORMAT, print_node

FLIP = """
#include "device.c"
#include <stdio.h>
/* Change each bit of an array once, and count the changes that a check does not find. */
static unsigned long flip(unsigned char *bytes, size_t size) {
  unsigned long unseen = 0;
  for (size_t i = 0; i < 8U * size; i++) {
    bytes[i / 8] = (unsigned char)(bytes[i / 8] ^ (1U << (i %% 8)));
    unseen += tac_check(&data) ? 1U : 0U;
    bytes[i / 8] = (unsigned char)(bytes[i / 8] ^ (1U << (i %% 8)));
  }
  return unseen;
}
int main(void) {
  static device memory;
  tac_key none = {NULL, 0};
  unsigned long unseen = 0;
  if (device_start(&memory, 0, 0, none) == NULL) return 2;
  %s
  printf("%%lu\\n", unseen);
  return device_start(&memory, 0, 0, none) == NULL ? 3 : 0;
}
"""
SCALARS = (
    "format", "crc", "wire.fingerprint", "generator", "remembers", "input_count", "memory_count", "output_count",
    "clocks_at", "drawn_at", "drawn_count", "applied", "limited", "measurement_count", "applied_count", "channel_count",
    "send_count", "clock_count", "constant_count",
)  # fmt: skip
UNREAD = ("memory_count", "constant_count", "channel_count", "send_count", "clock_count")  # more is read past the end


@pytest.mark.evidence
@pytest.mark.parametrize("of", few([("int16", "controller"), ("told", "actuator"), ("functions", "controller")], 1))
@pytest.mark.parametrize("precision", few(["float64", "float32"], 1))
def test_every_changed_bit_of_the_data_is_found(of: tuple[str, str], precision: str, tmp_path: Path) -> None:
    """Constants, start values, steps of integers, counters and sizes: a node with one wrong bit is not started."""
    name, role = of
    loop = LOOPS[name]()
    found = print_node(loop.policy, role, loop.network, "device", precision=precision)  # type: ignore[arg-type]
    arrays = re.findall(r"^static const (?:tac_real|uint16_t) (\w+)\[\]", found.source, re.MULTILINE)
    assert {"constants", "start"} <= set(arrays)
    flips = [f"unseen += flip((unsigned char *){one}, sizeof {one});" for one in arrays]
    flips += [
        f"unseen += flip((unsigned char *)&data.{one}, sizeof data.{one});" for one in SCALARS if one not in UNREAD
    ]
    (tmp_path / "device.h").write_text(found.header)
    (tmp_path / "device.c").write_text(found.source)
    (tmp_path / "flip.c").write_text(FLIP % "\n  ".join(flips))
    core = compile_core_for(loop.policy, loop.network, precision)  # type: ignore[arg-type]
    includes = [f"-I{CORE}", f"-I{core}", f"-I{tmp_path}"]
    options = ["-std=c99", "-O1", "-include", "stdio.h", "-include", "string.h", "-include", "math.h", *includes]
    program = [str(tmp_path / "flip.c"), *map(str, core.glob("*.o")), "-o", str(tmp_path / "flip")]
    subprocess.run([needs_compiler(), *options, "-Dconst=", *program], check=True)
    done = subprocess.run([str(tmp_path / "flip")], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "0\n")


@pytest.mark.evidence
def test_a_node_with_another_constant_is_not_started(tmp_path: Path) -> None:
    """The self-check says which; so does a node alone, by the pointer that it does not return."""
    folder = write(tmp_path, print_folder(two_mass(), "two_mass", rows=10))
    source = folder / "two_mass_controller.c"
    text = source.read_text()
    assert run_check(compile_check(folder))[0] == 0
    gain = re.findall(r"-?\d\.\d{16}", text)[0]
    for old, new in (
        (gain, gain[:-1] + ("1" if gain[-1] != "1" else "9")),
        (f"{FORMAT}u, /* format */", "1u, /* format */"),
    ):
        assert text.count(old) >= 1
        source.write_text(text.replace(old, new, 1))
        code, line = run_check(compile_check(folder))
        assert (code, line[:37]) == (1, "the data of the controller are damage")


def test_the_check_covers_all_numbers_of_the_code() -> None:
    """In the step of a node stand 0 and 1 alone, and places in arrays."""
    for name, role in places():
        loop = LOOPS[name]()
        source = print_node(loop.policy, role, loop.network, "device").source
        steps = re.findall(r"^static void (?:first|second)\(.*?^}", source, re.MULTILINE | re.DOTALL)
        assert steps
        numbers = {number for step in steps for number in re.findall(r"\d+\.\d+(?:e[+-]?\d+)?", step)}
        assert numbers <= {"0.0", "1.0"}, (name, role, numbers)


@pytest.mark.evidence
def test_every_node_starts(tmp_path: Path) -> None:
    """In both precisions and with every encoding: the host and the core compute the same CRC."""
    for name, role in places()[::3]:
        loop = LOOPS[name]()
        library = compile_node(loop.policy, role, loop.network, tmp_path, "float32")
        assert Device(library).node.value is not None
        tmp_path = tmp_path / "next"
        tmp_path.mkdir()
