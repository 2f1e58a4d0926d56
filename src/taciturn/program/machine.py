"""Compilation of LLVM IR with llvmlite, a cache of object code on disk, and execution on several threads.

Only this module calls llvmlite. ``Kernel`` is the machine code of all programs of one structure. It runs blocks of
paths, which do not interact, on as many threads as are worth starting. Programs use the widest vectors of the
processor, or those that the environment variable ``TACITURN_VECTORS`` selects: ``avx512``, ``avx2``, or ``baseline``
(present in every processor of the architecture). Results of the bit-exact build do not depend on the choice.

Object code is cached in memory and on disk, in a folder with one file per program, some hundred files. The key consists
of the text of the program, which includes the processor, and the version of llvmlite. A cached file is executed, so it
is used only if no other user can have written it: file and folder belong to this user or to root, and neither the group
nor others may write to them.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib
import os
import stat
import sys
import warnings
from collections.abc import Callable, Generator, Hashable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn._files import open_regular, write_whole
from taciturn.program.ir import Program
from taciturn.program.llvm import VECTORS, Build, Target, constants_of, print_llvm
from taciturn.program.numpy import Run

_SPARE = 8  # files are deleted when the limit is exceeded by 1/8, since deletion reads the age of each file
_LARGEST = 2**28  # bytes of a compiled program
_PRIVATE = 0o700  # mode of the folder
_LAYOUT = "digest of key and code, code"  # of a file; part of its key
_PASSES = "combine"  # the compiler passes, which are part of the cache key
MOST_KEPT = 512  # most compiled programs on disk, some 10 kB each; the least recently used are deleted
_MOST_PRINTED = 256  # most texts of programs in memory
_WORTH_A_THREAD = 2_000_000  # operations per thread, which take about 0.5 ms; starting a thread takes 0.1 ms
_ALONE = ContextVar("alone", default=False)
_SIGNATURE = ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * 3, *[ctypes.c_void_p] * 5)


class Kernel:
    """Machine code of all programs that differ only in their constants."""

    def __init__(self, program: Program, build: Build = "fast", own: bool = False, lanes: int | None = None) -> None:
        """Compile the program, or read its object code from the cache."""
        self.own = own
        self.lanes = lanes or host().lanes * (2 if program.precision == "float32" else 1)
        self._sizes = _sizes(program)
        self._code = _load(_print(_Printable(program.structure, program), host(), self.lanes, build, own))

    def pack(self, programs: Sequence[Program], paths: Sequence[int] | int = 1) -> Array:
        """Arrange the constants of several programs as the machine code reads them: (blocks, constants, lanes)."""
        known = np.array([constants_of(program) for program in programs])
        return _into_blocks(np.repeat(known, paths, axis=0).T, self.lanes)

    def known(self, program: Program, constants: Array | None) -> Array:
        """Arrange constants as the machine code reads them: given ones for each path, or the same for all paths."""
        assert self.own == (constants is not None), (
            "constants per path are supplied to a kernel with shared constants, or are missing"
        )
        return np.array(constants_of(program), dtype=program.precision) if constants is None else constants

    def run(
        self,
        program: Program,
        states: Array,
        ticks: int,
        inputs: Array | None = None,
        threads: int | None = None,
        constants: Array | None = None,
    ) -> Run:
        """Run a program for ``ticks`` steps of every path, like :func:`taciturn.program.numpy.run`."""
        # if each path has its own ``constants`` (``pack``), the sums exclude the factors and offsets of the totals
        paths, lanes = states.shape[1], self.lanes
        blocks = -(-paths // lanes)
        assert _sizes(program) == self._sizes, "the structure of the program differs from that of the kernel"
        assert len(states) == len(program.states), "the number of states differs from that of the program"
        if program.inputs:
            assert inputs is not None, "the program has inputs, but none are supplied"
            assert inputs.shape == (ticks, len(program.inputs), paths), (
                "the shape of the inputs does not fit the program"
            )
        state = _into_blocks(states, lanes)
        sums = np.zeros((blocks, len(program.sums), lanes))
        supplied = np.zeros(1)
        if inputs is not None and program.inputs:  # (steps, inputs, paths) as (blocks, steps, inputs, lanes)
            supplied = _into_blocks(inputs.reshape(ticks * len(program.inputs), paths), lanes)
        outputs = np.empty((blocks, ticks, len(program.outputs), lanes))
        arrays = (state, sums, self.known(program, constants), supplied, outputs)

        def work(part: tuple[int, int]) -> None:
            self.call(*part, ticks, arrays)

        worthwhile = program.operations * ticks * paths // _WORTH_A_THREAD
        workers = max(1, min(threads or min(available_processors(), worthwhile), blocks))
        cuts = [blocks * i // workers for i in range(workers + 1)]
        parts = list(pairwise(cuts))
        if workers == 1:
            work(parts[0])
        else:
            from concurrent.futures import ThreadPoolExecutor  # which short runs do not need

            with ThreadPoolExecutor(workers) as pool:  # ctypes releases the interpreter lock
                list(pool.map(work, parts))
        by_output = outputs.transpose(2, 1, 0, 3).reshape(len(program.outputs), ticks, blocks * lanes)[:, :, :paths]
        return Run(
            np.ascontiguousarray(_from_blocks(state, paths)),
            {
                name: row if self.own else total.of(row, ticks)
                for (name, total), row in zip(program.totals.items(), _from_blocks(sums, paths), strict=True)
            },
            dict(zip(program.outputs, by_output, strict=True)),
        )

    def call(self, first: int, end: int, ticks: int, arrays: Sequence[Array]) -> None:
        """Run the machine code on some blocks of paths. ``arrays`` are states, sums, constants, inputs and outputs."""
        if first < end and ticks > 0:
            self._code.function(first, end, ticks, *(a.ctypes.data for a in arrays))


class Resident:
    """Runs all paths of a compiled program, step by step, with new inputs in each step."""

    def __init__(self, kernel: Kernel, program: Program, states: Array, constants: Array | None = None) -> None:
        """Arrange the states in blocks."""
        self._kernel, self._paths = kernel, states.shape[1]
        state = _into_blocks(states, kernel.lanes)
        self._sums, self._inputs, self._outputs = (
            np.zeros((len(state), len(part), kernel.lanes)) for part in (program.sums, program.inputs, program.outputs)
        )
        self._arrays = state, self._sums, kernel.known(program, constants), self._inputs, self._outputs

    def tick(self, inputs: Array) -> Array:
        """Run one step of all paths with the given inputs (inputs × paths). Return the outputs (outputs × paths)."""
        self._inputs[:] = _into_blocks(inputs, self._kernel.lanes)
        self._kernel.call(0, len(self._inputs), 1, self._arrays)
        return _from_blocks(self._outputs, self._paths).copy()

    def take_sums(self) -> Array:
        """Return the sums over the steps since the last call (sums × paths). Factors and offsets are not yet
        applied.
        """
        taken = _from_blocks(self._sums, self._paths).copy()
        self._sums[:] = 0.0
        return taken


def forget() -> None:
    """Remove all compiled programs from memory, but not from the cache on disk."""
    _load.cache_clear()


@cache
def available() -> bool:
    """Check whether llvmlite, the compiler, can be imported. If not, print a warning once."""
    try:
        _llvm()
    except ImportError as error:
        warnings.warn(f"llvmlite is missing ({error}): loops run in NumPy, about 40 times slower", stacklevel=2)
        return False
    return True


@contextlib.contextmanager
def one_thread() -> Generator[None]:
    """While the block runs, run programs on the calling thread only. Used if several processes simulate."""
    before = _ALONE.set(True)
    try:
        yield
    finally:
        _ALONE.reset(before)


def available_processors() -> int:
    """Return how many processors this process may use. The number is 1 inside ``one_thread``."""
    if _ALONE.get():
        return 1
    affinity: Callable[[int], set[int]] | None = getattr(os, "sched_getaffinity", None)  # exists on Linux only
    return os.cpu_count() or 1 if affinity is None else len(affinity(0))


@cache
def host() -> Target:
    """Describe this processor for LLVM. The environment variable ``TACITURN_VECTORS`` limits its vector
    instructions.
    """
    llvm = _llvm()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    if sys.platform == "win32":  # functions with large stack frames call __chkstk, which LLVM may not find
        llvm.add_symbol("__chkstk", ctypes.cast(ctypes.windll.ntdll.__chkstk, ctypes.c_void_p).value)
    features: str = llvm.get_host_cpu_features().flatten()
    whole = Target(llvm.get_process_triple(), llvm.get_host_cpu_name(), features)
    return whole.limited(os.environ.get(VECTORS, ""))


@dataclass(frozen=True)
class _Printable:
    """A program as a cache key: all programs of equal structure compare equal."""

    structure: Hashable
    program: Program = field(compare=False)


@lru_cache(maxsize=_MOST_PRINTED)
def _print(printable: _Printable, target: Target, lanes: int, build: Build, own: bool) -> str:
    """Return the LLVM IR of a module, which is the same for all programs of equal structure."""
    return print_llvm(printable.program, target, lanes, build, own)


def _sizes(program: Program) -> tuple[int, ...]:
    """Return the sizes of a kernel's arrays; with other sizes, the kernel would read beyond their ends."""
    parts = (program.ops, program.states, constants_of(program), program.inputs, program.sums, program.outputs)
    return tuple(len(part) for part in parts)


class _Code:
    """A compiled module, which must exist as long as its function is used."""

    def __init__(self, engine: Any) -> None:
        self._engine = engine
        self.function = _SIGNATURE(engine.get_function_address("run"))


@cache
def _load(text: str) -> _Code:
    """Return the machine code of a module for this processor, from the cache on disk if possible."""
    llvm = _llvm()
    release: str = importlib.import_module("llvmlite").__version__
    key = hashlib.sha256("\n".join([text, release, _PASSES, _LAYOUT]).encode()).hexdigest()
    folder = cache_folder()
    stored = None if folder is None else read_code(folder, key)
    if stored is None:
        stored = compile_object(text, host())
        if folder is not None:
            write_code(folder, key, stored, MOST_KEPT)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine(host()))
    engine.add_object_file(llvm.ObjectFileRef.from_data(stored))
    engine.finalize_object()
    return _Code(engine)


def compile_object(text: str, target: Target) -> bytes:
    """Compile LLVM IR to object code for the processor that the IR names."""
    carried = text.startswith(target.heading) and target.attributes in text
    assert carried, f"the text is for a processor other than {target}: LLVM would terminate the process"
    llvm, machine = _llvm(), _machine(target)
    module = llvm.parse_assembly(text)
    module.data_layout = str(machine.target_data)  # without this layout, vectors are spilled to unaligned addresses
    module.verify()
    passes = llvm.create_new_module_pass_manager()
    # one pass suffices, as the builder has simplified the program; all passes of -O3 take three times as long
    passes.add_instruction_combine_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    return machine.emit_object(module)


def _machine(target: Target) -> Any:
    """Return the target machine of LLVM; an architecture other than the host's must be initialised before."""
    made = _llvm().Target.from_triple(target.triple)
    return made.create_target_machine(cpu=target.cpu, features=target.features, opt=3, jit=True)


def _llvm() -> Any:
    """Return llvmlite's binding, imported on first use because the import takes 20 ms; it has no type information."""
    return importlib.import_module("llvmlite.binding")


def _into_blocks(rows: Array, lanes: int) -> Array:
    """Return (rows, paths) as (blocks, rows, lanes); copies of the first path fill the last block."""
    count, paths = rows.shape
    missing = -paths % lanes
    padded = np.concatenate([rows, np.repeat(rows[:, :1], missing, axis=1)], axis=1)
    return np.ascontiguousarray(padded.reshape(count, (paths + missing) // lanes, lanes).transpose(1, 0, 2))


def _from_blocks(blocks: Array, paths: int) -> Array:
    """Return (blocks, rows, lanes) as (rows, paths)."""
    count, rows, lanes = blocks.shape
    return blocks.transpose(1, 0, 2).reshape(rows, count * lanes)[:, :paths]


def cache_folder() -> Path | None:
    """Create the cache folder, with mode 0700, if it is missing. Return None if no folder is safe from other users."""
    folder = _place()
    if folder is None:
        return None
    try:
        folder.mkdir(_PRIVATE, parents=True, exist_ok=True)
        found = folder.stat()
        if _is_ours(found) and stat.S_IMODE(found.st_mode) & ~_PRIVATE:
            folder.chmod(_PRIVATE)
            if _why_not(found) is not None:  # others could have written the files, too
                _warn(f"other users could write to the cache folder {folder}; its compiled programs were deleted")
                for path in folder.glob("*.o"):
                    path.unlink(missing_ok=True)
            found = folder.stat()
    except OSError:
        return None
    if (reason := _why_not(found)) is not None:
        _warn(
            f"the cache folder {folder} {reason}, so it is not used and every process compiles its programs; expected "
            "a folder of this user in XDG_CACHE_HOME"
        )
        return None
    return folder


def read_code(folder: Path, key: str) -> bytes | None:
    """Read the object code of a program from the cache. Return None unless the file is complete and safe from other
    users.
    """
    path = folder / f"{key}.o"
    try:
        with open_regular(path) as file:
            found = os.fstat(file.fileno())
            reason = "is larger than any program" if found.st_size > _LARGEST else _why_not(found)
            content = file.read() if reason is None else b""
    except OSError:
        return None
    with contextlib.suppress(OSError):  # the time of use cannot be recorded in a read-only folder
        os.utime(path)
    digest, code = content[:32], content[32:]
    if reason is None and (not code or _digest(key, code) != digest):
        reason = "is damaged"
    if reason is not None:
        _warn(f"the cached machine code {path} {reason}; the program is compiled again")
        return None
    return code


def write_code(folder: Path, key: str, code: bytes, most: int) -> None:
    """Write object code to the cache atomically. Keep at most ``most`` files: delete the least recently used ones."""
    with contextlib.suppress(OSError):  # without a writable folder, every process compiles its programs
        write_whole(folder / f"{key}.o", _digest(key, code) + code, private=True)
        if len(os.listdir(folder)) > most + most // _SPARE:
            kept = sorted(folder.glob("*.o"), key=lambda file: file.stat().st_mtime)
            for oldest in kept[:-most]:
                oldest.unlink()


def _place() -> Path | None:
    """Return the path of the folder: in XDG_CACHE_HOME if this path is absolute, or else that of the platform."""
    import platformdirs  # imported only when a program is compiled

    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if given.is_absolute():
        return given / "taciturn"
    try:
        if sys.platform == "win32":
            found = platformdirs.user_cache_path("taciturn", appauthor=False)
        else:  # platformdirs would use a relative XDG_CACHE_HOME
            found = Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "taciturn"
    except RuntimeError:
        return None  # no home folder: compile each time, since other users could write to a shared folder
    return found if found.is_absolute() else None


def _digest(key: str, code: bytes) -> bytes:
    """Return the digest of a file, which differs for the same code under another name."""
    return hashlib.sha256(key.encode() + code).digest()


def _is_ours(found: os.stat_result) -> bool:
    """Return whether a file belongs to this user; False on Windows, which has no user numbers."""
    user = getattr(os, "geteuid", None)
    return user is not None and found.st_uid == user()


def _why_not(found: os.stat_result) -> str | None:
    """Return why another user may have written a file or folder, or None; on Windows, the profile folder is private."""
    if not hasattr(os, "geteuid"):
        return None
    if not _is_ours(found) and found.st_uid != 0:
        return "belongs to another user"
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return "can be written by other users"
    return None


def _warn(sentence: str) -> None:
    warnings.warn(sentence, stacklevel=3)
