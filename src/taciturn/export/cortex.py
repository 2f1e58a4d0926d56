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
from taciturn.export.folder import CORE, FLAGS, CFolder
from taciturn.export.node import CNode
from taciturn.export.vector import Vector

Level = Literal["-O2", "-Os"]
PACKAGES = {  # of Debian
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "arm-none-eabi-size": "binutils-arm-none-eabi",
    "arm-none-eabi-nm": "binutils-arm-none-eabi",
    "qemu-system-arm": "qemu-system-arm",
    "cc": "gcc libc6-dev",
    "size": "binutils",
    "nm": "binutils",
}
COUNTING = ("-icount", "shift=7")  # board.h tells why
PATIENCE = 60.0  # seconds that a run may take
LONGEST = 500  # characters of what a tool has said


class Board(NamedTuple):
    """A board that QEMU emulates.

    Args:
        processor: its name.
        machine: what QEMU calls the board.
        flags: of the compiler.
        prefix: of the names of its tools.
    """

    processor: str
    machine: str
    flags: tuple[str, ...]
    prefix: str = "arm-none-eabi-"

    @property
    def compiler(self) -> str:
        """Name of the compiler."""
        return f"{self.prefix}gcc" if self.prefix else "cc"


M3 = Board("Cortex-M3", "mps2-an385", ("-mcpu=cortex-m3", "-mthumb"))
M4F = Board(
    "Cortex-M4F", "mps2-an386", ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
)  # whose floating-point unit knows single precision alone
HOST = Board(platform.machine(), "", (), "")  # this machine, which no emulator runs


class Main(NamedTuple):
    """What is to run on a board.

    Args:
        files: of the folder of C, and those of the board, by name.
        flags: of the compiler and the linker.
        own: further sources, by name: their texts.
    """

    files: tuple[str, ...]
    flags: tuple[str, ...] = ()
    own: Mapping[str, str] = {}


_WRAPPED = ("tac_receive", "tac_step", "tac_send")


def self_check(folder: CFolder) -> Main:
    """Return the folder's self-check as a program for a board."""
    return Main(tuple(name for name in folder.files if name.endswith(".c")))


def measurement(folder: CFolder) -> Main:
    """Return the self-check that counts instructions as well; it runs where QEMU counts them."""
    wrapped = tuple(f"-Wl,--wrap={name}" for name in ("main", *(f"{one}_{folder.sizes}" for one in _WRAPPED)))
    return Main((*self_check(folder).files, "measure.c"), wrapped)


def in_the_loop(node: CNode) -> Main:
    """Return one node, whose ticks a host asks for over the UART: the frames stand in ``loop.c``."""
    names = {"LOOP_HEADER": f'"{node.name}.h"', "LOOP_NODE": node.name, "LOOP_START": f"{node.name}_start"}
    sources = (*(name for name in CORE if name.endswith(".c")), f"{node.name}.c", "loop.c")
    return Main(sources, tuple(f"-D{name}={value}" for name, value in names.items()))


def compile_for(board: Board, folder: CFolder, main: Main, into: Path, level: Level = "-O2") -> Path:
    """Compile exported nodes for a board; warnings are errors.

    Args:
        board: whose processor it is for.
        folder: the nodes.
        main: what is to run: ``self_check(folder)``, ``measurement(folder)`` or ``in_the_loop(node)``.
        into: folder for sources and objects.
        level: of optimisation.

    Returns:
        The program, an ELF file in ``into``.

    Raises:
        ProblemError: no compiler, or it refuses.
    """
    objects = _compile(board, folder, (*main.files, "startup.c"), into, level, main)
    program = into / "program.elf"
    linked = ["-nostartfiles", "--specs=rdimon.specs", "-T", "board.ld", "-o", program.name]
    _call(board.compiler, [*board.flags, level, *main.flags, *linked, *objects, "-lm"], into)
    return program


def _compile(
    board: Board, folder: CFolder, sources: Sequence[str], into: Path, level: Level, main: Main | None = None
) -> list[str]:
    """Write all sources and compile some of them, and those that a program brings; return the names of the objects."""
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
    """What a part of a program takes, in bytes; numbers that stand between instructions are code.

    Args:
        code: instructions.
        constants: in read-only memory.
        memory: variables.
    """

    code: int
    constants: int
    memory: int


def measure_sizes(board: Board, folder: CFolder, level: Level = "-O2") -> dict[str, Sizes]:
    """Return what each node takes, and ``"core"``, what they share: libraries (arithmetic in software) not counted.

    Args:
        board: whose processor it is for.
        folder: the nodes.
        level: of optimisation.

    Raises:
        ProblemError: no compiler.
    """
    with TemporaryDirectory() as name:
        into = Path(name)
        _compile(board, folder, [name for name in self_check(folder).files if name != "selfcheck.c"], into, level)
        symbols = _call(f"{board.prefix}nm", ["-S", "selfcheck_data.o"], into).splitlines()
        known = {words[3]: int(words[1], 16) for words in map(str.split, symbols) if len(words) == 4}
        found = {
            node.role: _sections(board, into, [node.name])._replace(memory=known[node.role]) for node in folder.nodes
        }
        return {**found, "core": _sections(board, into, [Path(name).stem for name in CORE if name.endswith(".c")])}


def measure_somewhere(folder: CFolder) -> tuple[str, dict[str, Sizes]] | None:
    """Return what each node takes on a Cortex-M, or on this machine where that has no compiler; None: neither has.

    Args:
        folder: the nodes; optimised for size.

    Returns:
        The processor and the sizes of each node, and of the ``"core"``.

    Raises:
        ProblemError: the compiler refuses.
    """
    boards = (M4F if folder.single else M3, HOST)
    board = next((board for board in boards if shutil.which(board.compiler)), None)
    return None if board is None else (board.processor, measure_sizes(board, folder, "-Os"))


def _sections(board: Board, into: Path, stems: Sequence[str]) -> Sizes:
    sizes = [0, 0, 0]
    for line in _call(f"{board.prefix}size", ["-A", *(f"{stem}.o" for stem in stems)], into).splitlines():
        for kind, begins in enumerate(((".text",), (".rodata",), (".data", ".bss"))):
            if line.startswith(begins):
                sizes[kind] += int(line.split()[1])
    return Sizes(*sizes)


def run_on(
    board: Board, program: Path, vector: Vector | None = None, *, single: bool = False, counting: bool = False,
    patience: float = PATIENCE,
) -> str:  # fmt: skip
    """Run a program on a board, and return what it says.

    Args:
        board: the board.
        program: from ``compile_for``.
        vector: what the self-check compares; omitted: what is compiled in.
        single: whether its numbers are to have single precision.
        counting: whether the board's timer is to count instructions.
        patience: seconds that it may take.

    Raises:
        ProblemError: no emulator, the program ends with another code than 0, or not in time.
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
    board: Board, folder: CFolder, vector: Vector | None = None, level: Level = "-O2", patience: float = PATIENCE
) -> str:
    """Run the self-check on a board, and return the sentence with which it passes.

    Args:
        board: the board.
        folder: the nodes.
        vector: what it compares; omitted: what is compiled in.
        level: of optimisation.
        patience: seconds that it may take.

    Raises:
        ProblemError: no compiler or no emulator, or a bit differs: in which tick.
    """
    with TemporaryDirectory() as name:
        program = compile_for(board, folder, self_check(folder), Path(name), level)
        return run_on(board, program, vector, single=folder.single, patience=patience).strip()


def emulate(board: Board, program: Path, options: Sequence[str]) -> list[str]:
    """Return the command that runs a program on a board.

    Raises:
        ProblemError: no emulator.
    """
    plain = ["-M", board.machine, "-display", "none", "-monitor", "none"]
    return [find_tool("qemu-system-arm"), *plain, *options, "-kernel", str(program.absolute())]


class Count(NamedTuple):
    """Instructions of a tick.

    Args:
        mean: over the ticks.
        longest: of a tick.
        ticks: that were counted.
    """

    mean: float
    longest: int
    ticks: int


class Counts(NamedTuple):
    """Instructions of a node's ticks.

    Args:
        step: of what is generated for its policy, alone; exact.
        tick: of ``tac_step``, give or take the five with which it is called.
        all: packets that come, ``tac_step``, and packets that go; each call give or take five.
    """

    step: Count
    tick: Count
    all: Count


def count_instructions(
    board: Board, folder: CFolder, vector: Vector | None = None, level: Level = "-O2", patience: float = PATIENCE
) -> dict[str, Counts]:
    """Return how many instructions the ticks of each node take, while the self-check passes.

    Instructions are no cycles: a processor takes one or more for each.

    Args:
        board: the board.
        folder: the nodes.
        vector: what the self-check compares; omitted: what is compiled in.
        level: of optimisation.
        patience: seconds that it may take.

    Raises:
        ProblemError: no compiler or no emulator, or the self-check fails.
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
        ProblemError: it is missing; with the packages that bring it.
    """
    found = shutil.which(name)
    if found is None:
        raise ProblemError(f"{name} is missing; expected on the path, as after: apt install {PACKAGES[name]}")
    return found


def _call(tool: str, arguments: Sequence[str], folder: Path, patience: float = PATIENCE) -> str:
    """Run a tool in a folder, and return what it says."""
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
        raise ProblemError(f"{tool} has not ended after {patience:g} s; expected it to be faster") from None
    if done.returncode != 0:
        said = " ".join((done.stdout + done.stderr).split()) or f"code {done.returncode}"
        if "will not fit in region" in said:
            raise ProblemError("the program is larger than the board's 4 MiB; expected fewer rows to check")
        if "rdimon.specs" in said:
            said = f"the C library is missing, apt install {PACKAGES['arm-none-eabi-gcc']}: {said}"
        raise ProblemError(f"{tool} fails ({said[:LONGEST]}); expected it to succeed")
    return done.stdout
