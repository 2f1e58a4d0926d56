"""Measure how many bytes exported nodes occupy when compiled for a Cortex-M or for this machine."""

from __future__ import annotations

import platform
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

from taciturn.errors import ProblemError
from taciturn_export.folder import CORE_SOURCES, FLAGS, CFolder

Optimisation = Literal["-O2", "-Os"]
PACKAGES = {  # Debian packages
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "arm-none-eabi-size": "binutils-arm-none-eabi",
    "arm-none-eabi-nm": "binutils-arm-none-eabi",
    "qemu-system-arm": "qemu-system-arm",
    "cc": "gcc libc6-dev",
    "size": "binutils",
    "nm": "binutils",
}
PATIENCE = 60.0  # time limit of a tool in seconds
LONGEST = 500  # characters of a tool's output that an error message quotes


class Target(NamedTuple):
    """A target processor, with its compiler tools."""

    processor: str  # name of the processor
    flags: tuple[str, ...]  # compiler flags
    prefix: str = "arm-none-eabi-"  # prefix of the names of its tools

    @property
    def compiler(self) -> str:
        """Name of the compiler."""
        return f"{self.prefix}gcc" if self.prefix else "cc"


CORTEX_M3 = Target("Cortex-M3", ("-mcpu=cortex-m3", "-mthumb"))
CORTEX_M4F = Target(
    "Cortex-M4F", ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
)  # its floating-point unit supports single precision only
HOST = Target(platform.machine(), (), "")  # this machine


class Sizes(NamedTuple):
    """Sizes of the parts of a program in bytes; constants between instructions count as code."""

    code: int  # size of the instructions
    constants: int  # size of the constants in read-only memory
    memory: int  # size of the variables


def measure_sizes(target: Target, folder: CFolder, level: Optimisation = "-O2") -> dict[str, Sizes]:
    """Measure the size of each node and of the common ``"core"``, without libraries such as software floating point."""
    with TemporaryDirectory() as name:
        into = Path(name)
        folder.write(into)
        compile_sources(target, [name for name in folder.sources if name != "selfcheck.c"], into, level)
        symbols = call_tool(f"{target.prefix}nm", ["-S", "selfcheck_data.o"], into).splitlines()
        known = {words[3]: int(words[1], 16) for words in map(str.split, symbols) if len(words) == 4}
        found = {
            node.role: _sections(target, into, [node.name])._replace(memory=known[f"memory_of_{node.name}"])
            for node in folder.nodes
        }
        return {**found, "core": _sections(target, into, [Path(name).stem for name in CORE_SOURCES])}


def measure_somewhere(folder: CFolder) -> tuple[str, dict[str, Sizes]] | None:
    """Measure the nodes for a Cortex-M or, without its compiler, for this machine; return None without any compiler."""
    targets = (CORTEX_M4F if folder.single else CORTEX_M3, HOST)
    target = next((target for target in targets if shutil.which(target.compiler)), None)
    return None if target is None else (target.processor, measure_sizes(target, folder, "-Os"))


def compile_sources(
    target: Target, sources: Sequence[str], into: Path, level: Optimisation, flags: Sequence[str] = ()
) -> list[str]:
    """Compile C files in a folder, with warnings as errors, and return the names of the resulting object files."""
    warned = [flag for flag in FLAGS.split() if not flag.startswith("-O")]
    call_tool(target.compiler, [*warned, "-Werror", level, *target.flags, *flags, "-c", *sources], into)
    return [Path(name).with_suffix(".o").name for name in sources]


def find_tool(name: str) -> str:
    """Return the path of a compiler or an emulator; raise an error if it is not installed."""
    found = shutil.which(name)
    if found is None:
        raise ProblemError(
            f"the program {name} is missing; expected this program on the path; install it with: apt install "
            f"{PACKAGES[name]}"
        )
    return found


def call_tool(tool: str, arguments: Sequence[str], folder: Path, patience: float = PATIENCE) -> str:
    """Run a compiler tool in a folder, and return its output."""
    command = [find_tool(tool), *arguments]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=patience,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired:
        raise ProblemError(
            f"the program {tool} has not finished after {patience:g} s; use a self-check with fewer steps, or reduce "
            "the load on this machine"
        ) from None
    if done.returncode != 0:
        said = " ".join((done.stdout + done.stderr).split()) or f"code {done.returncode}"
        if "will not fit in region" in said:
            raise ProblemError("the program is larger than the board's 4 MiB; expected a self-check with fewer steps")
        if "rdimon.specs" in said:
            said = f"the C library is missing; install it with: apt install {PACKAGES['arm-none-eabi-gcc']}: {said}"
        raise ProblemError(f"the program {tool} fails ({said[:LONGEST]}); correct the reported cause, and run again")
    return done.stdout


def _sections(target: Target, into: Path, stems: Sequence[str]) -> Sizes:
    sizes = [0, 0, 0]
    for line in call_tool(f"{target.prefix}size", ["-A", *(f"{stem}.o" for stem in stems)], into).splitlines():
        for kind, begins in enumerate(((".text",), (".rodata",), (".data", ".bss"))):
            if line.startswith(begins):
                sizes[kind] += int(line.split()[1])
    return Sizes(*sizes)
