"""Compile exported nodes for Cortex-M boards, run them in the emulator QEMU, and count processor instructions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from taciturn.extend import write_whole
from taciturn_export.folder import CORE_SOURCES, CFolder, RecordedRun
from taciturn_export.node import CNode
from taciturn_export.sizes import (
    CORTEX_M3,
    CORTEX_M4F,
    PATIENCE,
    Optimisation,
    Target,
    call_tool,
    compile_sources,
    find_tool,
)

COUNTING = ("-icount", "shift=7")  # see board.h for the reason


class EmulatedBoard(NamedTuple):
    """A board that QEMU emulates.

    Args:
        target: its processor.
        machine: name of the board in QEMU.
    """

    target: Target
    machine: str

    @property
    def processor(self) -> str:
        """Name of the processor."""
        return self.target.processor


M3, M4F = EmulatedBoard(CORTEX_M3, "mps2-an385"), EmulatedBoard(CORTEX_M4F, "mps2-an386")


class Main(NamedTuple):
    """A program for a board.

    Args:
        files: names of files from the folder of C sources and from the board's files.
        flags: flags of the compiler and the linker.
        own: texts of further sources, by name.
    """

    files: tuple[str, ...]
    flags: tuple[str, ...] = ()
    own: Mapping[str, str] = {}


_WRAPPED = ("tac_receive", "tac_step", "tac_send")


def self_check(folder: CFolder) -> Main:
    """Return the C program that runs the self-check of exported nodes on a board."""
    return Main(folder.sources)


def measurement(folder: CFolder) -> Main:
    """Return the C program that runs the self-check in QEMU and counts the instructions of each node's step."""
    wrapped = tuple(f"-Wl,--wrap={name}" for name in ("main", *(f"{one}_{folder.sizes}" for one in _WRAPPED)))
    return Main((*self_check(folder).files, "measure.c"), wrapped)


def in_the_loop(node: CNode) -> Main:
    """Return a C program with one node, which executes a step for each request on the UART (as in ``loop.c``)."""
    names = {"LOOP_HEADER": f'"{node.name}.h"', "LOOP_NODE": node.name, "LOOP_START": f"{node.name}_start"}
    sources = (*CORE_SOURCES, f"{node.name}.c", "loop.c")
    return Main(sources, tuple(f"-D{name}={value}" for name, value in names.items()))


def compile_for(board: EmulatedBoard, folder: CFolder, main: Main, into: Path, level: Optimisation = "-O2") -> Path:
    """Compile a C program with exported nodes for a board; every compiler warning counts as an error.

    Args:
        board: target board.
        folder: folder with the nodes.
        main: program to compile: ``self_check(folder)``, ``measurement(folder)`` or ``in_the_loop(node)``.
        into: folder for sources and objects.
        level: optimisation level.

    Returns:
        The path of the program, an ELF file in ``into``.

    Raises:
        ProblemError: the compiler is missing, or it reports an error.
    """
    folder.write(into)
    ours = files("taciturn_boards") / "board"
    for name in ("board.h", "board.ld", "startup.c", "loop.c", "measure.c"):
        write_whole(into / name, (ours / name).read_bytes())
    for name, text in main.own.items():
        write_whole(into / name, text.encode())
    sources = [*main.files, "startup.c", *(name for name in main.own if name.endswith(".c"))]
    objects = compile_sources(board.target, sources, into, level, main.flags)
    program, target = into / "program.elf", board.target
    linked = ["-nostartfiles", "--specs=rdimon.specs", "-T", "board.ld", "-o", program.name]
    call_tool(target.compiler, [*target.flags, level, *main.flags, *linked, *objects, "-lm"], into)
    return program


def run_on(
    board: EmulatedBoard,
    program: Path,
    vector: RecordedRun | None = None,
    *,
    single: bool = False,
    counting: bool = False,
    patience: float = PATIENCE,
) -> str:
    """Run a program on an emulated board, and return the text that it prints.

    Args:
        board: the board.
        program: program from ``compile_for``.
        vector: recording for the self-check; default: the recording that is compiled in.
        single: whether the numbers of the recording are passed in single precision.
        counting: whether the board's timer counts instructions.
        patience: time limit in seconds.

    Raises:
        ProblemError: the emulator is missing, or the program fails or exceeds the time limit.
    """
    with TemporaryDirectory() as folder:
        words = ["program"]
        if vector is not None:
            (Path(folder) / "rows").write_bytes(vector.rows.astype("<f4" if single else "<f8").tobytes())
            words.append("rows")
        given = ",".join(["enable=on", "target=native", *(f"arg={word}" for word in words)])
        options = ["-serial", "none", "-semihosting-config", given, *(COUNTING if counting else ())]
        return call_tool("qemu-system-arm", emulate(board, program, options)[1:], Path(folder), patience)


def check_on(
    board: EmulatedBoard,
    folder: CFolder,
    vector: RecordedRun | None = None,
    level: Optimisation = "-O2",
    patience: float = PATIENCE,
) -> str:
    """Run the self-check on an emulated board, and return the line that it prints when it passes.

    Args:
        board: the board.
        folder: folder with the nodes.
        vector: recording for the self-check; default: the recording that is compiled in.
        level: optimisation level.
        patience: time limit in seconds.

    Raises:
        ProblemError: the compiler or the emulator is missing, or a bit differs; the message gives the step.
    """
    with TemporaryDirectory() as name:
        program = compile_for(board, folder, self_check(folder), Path(name), level)
        return run_on(board, program, vector, single=folder.single, patience=patience).strip()


def emulate(board: EmulatedBoard, program: Path, options: Sequence[str]) -> list[str]:
    """Return the command that runs a program on an emulated board.

    Raises:
        ProblemError: the emulator is missing.
    """
    plain = ["-M", board.machine, "-display", "none", "-monitor", "none"]
    return [find_tool("qemu-system-arm"), *plain, *options, "-kernel", str(program.absolute())]


class Count(NamedTuple):
    """Mean and largest number of processor instructions per step of a node.

    Args:
        mean: mean over the steps.
        longest: maximum over the steps.
        ticks: number of counted steps.
    """

    mean: float
    longest: int
    ticks: int


class Counts(NamedTuple):
    """Numbers of processor instructions that an exported node executes.

    Args:
        step: instructions of the code generated for the policy; exact.
        tick: instructions of ``tac_step``, within the five of its call.
        all: instructions of received packets, ``tac_step`` and sent packets, within five per call.
    """

    step: Count
    tick: Count
    all: Count


def count_instructions(
    board: EmulatedBoard,
    folder: CFolder,
    vector: RecordedRun | None = None,
    level: Optimisation = "-O2",
    patience: float = PATIENCE,
) -> dict[str, Counts]:
    """Run the self-check on an emulated board, and count the processor instructions of each node's steps.

    An instruction takes one or more cycles of the processor.

    Args:
        board: the board.
        folder: folder with the nodes.
        vector: recording for the self-check; default: the recording that is compiled in.
        level: optimisation level.
        patience: time limit in seconds.

    Raises:
        ProblemError: the compiler or the emulator is missing, or the self-check fails.
    """
    with TemporaryDirectory() as name:
        program = compile_for(board, folder, measurement(folder), Path(name), level)
        said = run_on(board, program, vector, single=folder.single, counting=True, patience=patience)
    found: dict[str, dict[str, Count]] = {}
    for words in map(str.split, said.splitlines()[1:]):
        role, what, (total, longest, ticks) = words[0], words[1], map(int, words[2:])
        found.setdefault(role, {})[what] = Count(total / ticks, longest, ticks)
    return {role: Counts(**counts) for role, counts in found.items()}
