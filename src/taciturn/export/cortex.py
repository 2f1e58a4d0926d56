"""Compiles exported nodes for Cortex-M, runs them on boards that QEMU emulates, and counts their instructions."""

from __future__ import annotations

import platform
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

from taciturn._files import write_whole
from taciturn.errors import ProblemError
from taciturn.export.folder import CORE_SOURCES, FLAGS, CFolder
from taciturn.export.node import CNode
from taciturn.export.vector import RecordedRun

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
COUNTING = ("-icount", "shift=7")  # see board.h for the reason
PATIENCE = 60.0  # time limit of a run in seconds
LONGEST = 500  # characters of a tool's output that an error message quotes


class EmulatedBoard(NamedTuple):
    """A board that QEMU emulates.

    Args:
        processor: name of the processor.
        machine: name of the board in QEMU.
        flags: compiler flags.
        prefix: prefix of the names of its tools.
    """

    processor: str
    machine: str
    flags: tuple[str, ...]
    prefix: str = "arm-none-eabi-"

    @property
    def compiler(self) -> str:
        """Name of the compiler."""
        return f"{self.prefix}gcc" if self.prefix else "cc"


M3 = EmulatedBoard("Cortex-M3", "mps2-an385", ("-mcpu=cortex-m3", "-mthumb"))
M4F = EmulatedBoard(
    "Cortex-M4F", "mps2-an386", ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
)  # its floating-point unit supports single precision only
HOST = EmulatedBoard(platform.machine(), "", (), "")  # this machine, without an emulator


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
    """Return the self-check of exported nodes as a program for a board."""
    return Main(folder.sources)


def measurement(folder: CFolder) -> Main:
    """Return the self-check of exported nodes as a program that counts instructions on QEMU."""
    wrapped = tuple(f"-Wl,--wrap={name}" for name in ("main", *(f"{one}_{folder.sizes}" for one in _WRAPPED)))
    return Main((*self_check(folder).files, "measure.c"), wrapped)


def in_the_loop(node: CNode) -> Main:
    """Return a program with one node, whose steps a host requests over the UART; ``loop.c`` defines the frames."""
    names = {"LOOP_HEADER": f'"{node.name}.h"', "LOOP_NODE": node.name, "LOOP_START": f"{node.name}_start"}
    sources = (*CORE_SOURCES, f"{node.name}.c", "loop.c")
    return Main(sources, tuple(f"-D{name}={value}" for name, value in names.items()))


def compile_for(board: EmulatedBoard, folder: CFolder, main: Main, into: Path, level: Optimisation = "-O2") -> Path:
    """Compile exported nodes for a board; warnings are errors.

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
    objects = _compile(board, folder, (*main.files, "startup.c"), into, level, main)
    program = into / "program.elf"
    linked = ["-nostartfiles", "--specs=rdimon.specs", "-T", "board.ld", "-o", program.name]
    _call(board.compiler, [*board.flags, level, *main.flags, *linked, *objects, "-lm"], into)
    return program


def _compile(
    board: EmulatedBoard,
    folder: CFolder,
    sources: Sequence[str],
    into: Path,
    level: Optimisation,
    main: Main | None = None,
) -> list[str]:
    """Write all sources, compile the given ones and those of ``main``, and return the names of the objects."""
    main = main or Main(())
    folder.write(into)
    ours = files("taciturn.export") / "board"
    for name in ("board.h", "board.ld", "startup.c", "loop.c", "measure.c"):
        write_whole(into / name, (ours / name).read_bytes())
    for name, text in main.own.items():
        write_whole(into / name, text.encode())
    sources = [*sources, *(name for name in main.own if name.endswith(".c"))]
    warned = [flag for flag in FLAGS.split() if not flag.startswith("-O")]
    _call(board.compiler, [*warned, "-Werror", level, *board.flags, *main.flags, "-c", *sources], into)
    return [Path(name).with_suffix(".o").name for name in sources]


class Sizes(NamedTuple):
    """The size of a part of a program in bytes; constants between instructions count as code.

    Args:
        code: size of the instructions.
        constants: size of the constants in read-only memory.
        memory: size of the variables.
    """

    code: int
    constants: int
    memory: int


def measure_sizes(board: EmulatedBoard, folder: CFolder, level: Optimisation = "-O2") -> dict[str, Sizes]:
    """Return the size of each node and of their common ``"core"``, without libraries (such as software arithmetic).

    Args:
        board: target board.
        folder: folder with the nodes.
        level: optimisation level.

    Raises:
        ProblemError: the compiler is missing.
    """
    with TemporaryDirectory() as name:
        into = Path(name)
        _compile(board, folder, [name for name in self_check(folder).files if name != "selfcheck.c"], into, level)
        symbols = _call(f"{board.prefix}nm", ["-S", "selfcheck_data.o"], into).splitlines()
        known = {words[3]: int(words[1], 16) for words in map(str.split, symbols) if len(words) == 4}
        found = {
            node.role: _sections(board, into, [node.name])._replace(memory=known[node.role]) for node in folder.nodes
        }
        return {**found, "core": _sections(board, into, [Path(name).stem for name in CORE_SOURCES])}


def measure_somewhere(folder: CFolder) -> tuple[str, dict[str, Sizes]] | None:
    """Return the sizes of the nodes on a Cortex-M, or on this machine if it has no Cortex-M compiler, or None.

    Args:
        folder: folder with the nodes, which are compiled with optimisation for size.

    Returns:
        The processor and the sizes of each node and of the ``"core"``, or None if no compiler is installed.

    Raises:
        ProblemError: the compiler reports an error.
    """
    boards = (M4F if folder.single else M3, HOST)
    board = next((board for board in boards if shutil.which(board.compiler)), None)
    return None if board is None else (board.processor, measure_sizes(board, folder, "-Os"))


def _sections(board: EmulatedBoard, into: Path, stems: Sequence[str]) -> Sizes:
    sizes = [0, 0, 0]
    for line in _call(f"{board.prefix}size", ["-A", *(f"{stem}.o" for stem in stems)], into).splitlines():
        for kind, begins in enumerate(((".text",), (".rodata",), (".data", ".bss"))):
            if line.startswith(begins):
                sizes[kind] += int(line.split()[1])
    return Sizes(*sizes)


def run_on(
    board: EmulatedBoard,
    program: Path,
    vector: RecordedRun | None = None,
    *,
    single: bool = False,
    counting: bool = False,
    patience: float = PATIENCE,
) -> str:
    """Run a program on a board, and return its output.

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
        return _call("qemu-system-arm", emulate(board, program, options)[1:], Path(folder), patience)


def check_on(
    board: EmulatedBoard,
    folder: CFolder,
    vector: RecordedRun | None = None,
    level: Optimisation = "-O2",
    patience: float = PATIENCE,
) -> str:
    """Run the self-check on a board, and return the line that it prints if it passes.

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
    """Return the command that runs a program on a board.

    Raises:
        ProblemError: the emulator is missing.
    """
    plain = ["-M", board.machine, "-display", "none", "-monitor", "none"]
    return [find_tool("qemu-system-arm"), *plain, *options, "-kernel", str(program.absolute())]


class Count(NamedTuple):
    """The mean and the largest number of instructions per step.

    Args:
        mean: mean over the steps.
        longest: maximum over the steps.
        ticks: number of counted steps.
    """

    mean: float
    longest: int
    ticks: int


class Counts(NamedTuple):
    """The instruction counts of a node.

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
    """Run the self-check, and return the numbers of instructions of each node's steps.

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


def find_tool(name: str) -> str:
    """Return the path of a compiler or an emulator.

    Raises:
        ProblemError: the tool is missing; the message names the packages that contain it.
    """
    found = shutil.which(name)
    if found is None:
        raise ProblemError(
            f"{name} is missing; expected this program on the path; install it with: apt install {PACKAGES[name]}"
        )
    return found


def _call(tool: str, arguments: Sequence[str], folder: Path, patience: float = PATIENCE) -> str:
    """Run a tool in a folder, and return its output."""
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
            f"{tool} has not finished after {patience:g} s; use a self-check with fewer steps, or reduce the load on "
            "this machine"
        ) from None
    if done.returncode != 0:
        said = " ".join((done.stdout + done.stderr).split()) or f"code {done.returncode}"
        if "will not fit in region" in said:
            raise ProblemError("the program is larger than the board's 4 MiB; expected a self-check with fewer steps")
        if "rdimon.specs" in said:
            said = f"the C library is missing; install it with: apt install {PACKAGES['arm-none-eabi-gcc']}: {said}"
        raise ProblemError(f"{tool} fails ({said[:LONGEST]}); correct the reported cause, and run again")
    return done.stdout
