"""Compiles printed programs through llvmlite, keeps the object code, and runs it on threads.

Object code is kept in memory and on disk (where the platform keeps caches, the latest few hundred), by the text of
the program, which names the processor, and the version of llvmlite. This is the one typed door to llvmlite.

The widest vectors of the processor are used, or those that the environment asks for: ``TACITURN_VECTORS`` is
``avx512``, ``avx2``, or ``baseline`` (what every processor of its kind has). The parity build gives the same bits with
all of them.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib
import os
import sys
import warnings
from collections.abc import Callable, Generator, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn._files import write_whole
from taciturn.program._llvm_body import Build, constants_of
from taciturn.program.ir import Program
from taciturn.program.llvm import print_llvm
from taciturn.program.numpy import Run
from taciturn.program.target import VECTORS, Target

PASSES = "combine"  # how programs are compiled, in the key of what is kept
MOST_KEPT = 512  # compiled programs on disk, some 10 kB each; those not used for longest go
SPARE = 8  # an eighth more may be there before they go: that asks for the age of each
MOST_PRINTED = 256  # texts in memory
WORTH_A_THREAD = 2_000_000  # operations, half a millisecond of them: to start a thread takes a fifth of that
_ALONE = ContextVar("alone", default=False)
_SIGNATURE = ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * 3, *[ctypes.c_void_p] * 5)


class Kernel:
    """Machine code of a program, for any program of the same structure.

    Args:
        program: the program.
        build: ``"fast"`` or ``"parity"``.
        own: whether each path runs a program of its own, that differ in their constants.
        lanes: paths that run side by side, a power of two; by default as many as fit the processor's vectors.
    """

    def __init__(self, program: Program, build: Build = "fast", own: bool = False, lanes: int | None = None) -> None:
        """Compile, or fetch what was compiled before."""
        self.own = own
        self.lanes = lanes or host().lanes * (2 if program.precision == "float32" else 1)
        self._sizes = _sizes(program)
        self._code = _load(_print(_Printable(program.structure, program), host(), self.lanes, build, own))

    def pack(self, programs: Sequence[Program], paths: Sequence[int] | int = 1) -> Array:
        """Return the constants of programs that run side by side, so many paths of each, (blocks, constants, lanes)."""
        known = np.array([constants_of(program) for program in programs])
        return _into_blocks(np.repeat(known, paths, axis=0).T, self.lanes)

    def known(self, program: Program, constants: Array | None) -> Array:
        """Return the constants that the machine reads: those of each path (``pack``), or else the program's for all."""
        assert self.own == (constants is not None), "constants are supplied to a kernel that has none, or are missing"
        return shared_constants(program) if constants is None else constants

    def run(
        self,
        program: Program,
        states: Array,
        ticks: int,
        inputs: Array | None = None,
        threads: int | None = None,
        constants: Array | None = None,
    ) -> Run:
        """Run ``ticks`` ticks on every path; arguments and result as in ``taciturn.program.numpy.run``.

        Any number of paths and threads gives the same bits: a path sees nothing of its neighbours. Where each has
        ``constants`` of its own (``pack``), the sums are those of ``Program.totals`` before their factors.
        """
        paths, lanes = states.shape[1], self.lanes
        blocks = -(-paths // lanes)
        assert _sizes(program) == self._sizes, "the program has another structure than the kernel's"
        assert len(states) == len(program.states), "the states are not those of the program"
        if program.inputs:
            assert inputs is not None, "the program has inputs, and none are supplied"
            assert inputs.shape == (ticks, len(program.inputs), paths), "the inputs do not fit the program"
        state = _into_blocks(states, lanes)
        sums = np.zeros((blocks, len(program.sums), lanes))
        supplied = _ticks_into_blocks(inputs, lanes) if inputs is not None and program.inputs else np.zeros(1)
        outputs = np.empty((blocks, ticks, len(program.outputs), lanes))
        arrays = (state, sums, self.known(program, constants), supplied, outputs)

        def work(part: tuple[int, int]) -> None:
            self.call(*part, ticks, arrays)

        worthwhile = program.operations * ticks * paths // WORTH_A_THREAD
        workers = max(1, min(threads or min(available_processors(), worthwhile), blocks))
        cuts = [blocks * i // workers for i in range(workers + 1)]
        parts = list(pairwise(cuts))
        if workers == 1:
            work(parts[0])
        else:
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
        """Run blocks of paths on: their states, sums, constants, inputs and outputs, as ``taciturn.program.llvm``."""
        if first < end and ticks > 0:
            self._code.function(first, end, ticks, *(a.ctypes.data for a in arrays))


class Resident:
    """Paths of a program that stay where they are while they are run tick by tick, with inputs from outside.

    Args:
        kernel: of the program.
        program: the program.
        states: (states, paths).
        constants: of each path, where the kernel has them (``Kernel.pack``).
    """

    def __init__(self, kernel: Kernel, program: Program, states: Array, constants: Array | None = None) -> None:
        """Bring the states into the order of the machine."""
        self._kernel, self._paths = kernel, states.shape[1]
        state = _into_blocks(states, kernel.lanes)
        self._sums, self._inputs, self._outputs = (
            np.zeros((len(state), len(part), kernel.lanes)) for part in (program.sums, program.inputs, program.outputs)
        )
        self._arrays = state, self._sums, kernel.known(program, constants), self._inputs, self._outputs

    def tick(self, inputs: Array) -> Array:
        """Run one tick: (inputs, paths) to (outputs, paths)."""
        self._inputs[:] = _into_blocks(inputs, self._kernel.lanes)
        self._kernel.call(0, len(self._inputs), 1, self._arrays)
        return _from_blocks(self._outputs, self._paths).copy()

    def take_sums(self) -> Array:
        """Return what was added up since this was last asked, (sums, paths), before the factors of their totals."""
        taken = _from_blocks(self._sums, self._paths).copy()
        self._sums[:] = 0.0
        return taken


def forget() -> None:
    """Forget the machine code in memory; that on the disk stays."""
    _load.cache_clear()


@cache
def available() -> bool:
    """Tell whether llvmlite can be imported; say so once where it cannot."""
    try:
        _llvm()
    except ImportError as error:
        warnings.warn(f"llvmlite is missing ({error}): loops run in NumPy, forty times slower", stacklevel=2)
        return False
    return True


@contextlib.contextmanager
def one_thread() -> Generator[None]:
    """Run programs on the calling thread alone, where others have work for the other processors."""
    before = _ALONE.set(True)
    try:
        yield
    finally:
        _ALONE.reset(before)


def available_processors() -> int:
    """Return the number of processors that programs may run on."""
    if _ALONE.get():
        return 1
    affinity: Callable[[int], set[int]] | None = getattr(os, "sched_getaffinity", None)  # Linux alone has it
    return os.cpu_count() or 1 if affinity is None else len(affinity(0))


@cache
def host() -> Target:
    """Return this processor, or the lesser one that the environment asks for."""
    llvm = _llvm()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    if sys.platform == "win32":  # what large frames ask for their pages; the system has it, LLVM might not look there
        llvm.add_symbol("__chkstk", ctypes.cast(ctypes.windll.ntdll.__chkstk, ctypes.c_void_p).value)
    features: str = llvm.get_host_cpu_features().flatten()
    whole = Target(llvm.get_process_triple(), llvm.get_host_cpu_name(), features)
    return whole.limited(os.environ.get(VECTORS, ""))


def shared_constants(program: Program) -> Array:
    """Return the constants of a program that is the same for every path, as the machine reads them."""
    return np.array(constants_of(program), dtype=program.precision)


@dataclass(frozen=True)
class _Printable:
    """A program, equal to any of its structure."""

    structure: Hashable
    program: Program = field(compare=False)


@lru_cache(maxsize=MOST_PRINTED)
def _print(printable: _Printable, target: Target, lanes: int, build: Build, own: bool) -> str:
    """Return the text of a module, which is the same for all programs of a structure."""
    return print_llvm(printable.program, target, lanes, build, own)


def _sizes(program: Program) -> tuple[int, ...]:
    """What a kernel must find in memory: a program of other sizes would make it read what is not there."""
    parts = (program.ops, program.states, constants_of(program), program.inputs, program.sums, program.outputs)
    return tuple(len(part) for part in parts)


class _Code:
    """A compiled module; it must outlive its function."""

    def __init__(self, engine: Any) -> None:
        self._engine = engine
        self.function = _SIGNATURE(engine.get_function_address("run"))


def _llvm() -> Any:
    """Return llvmlite's binding, imported when it is first needed: that takes 20 ms; it has no types."""
    return importlib.import_module("llvmlite.binding")


@cache
def _load(text: str) -> _Code:
    """Return the machine code of a module that was printed for this processor, from the disk where it is there."""
    llvm = _llvm()
    release: str = importlib.import_module("llvmlite").__version__
    key = hashlib.sha256("\n".join([text, release, PASSES]).encode()).hexdigest()
    folder = _cache_folder()
    kept = None if folder is None else folder / f"{key}.o"
    stored = None if kept is None else _read_object(kept)
    if stored is None:
        stored = compile_object(text, host())
        if kept is not None:
            _write_object(kept, stored)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine(host()))
    engine.add_object_file(llvm.ObjectFileRef.from_data(stored))
    engine.finalize_object()
    return _Code(engine)


def _machine(target: Target) -> Any:
    """Return LLVM's own record of a target; those of other architectures must have been initialised."""
    made = _llvm().Target.from_triple(target.triple)
    return made.create_target_machine(cpu=target.cpu, features=target.features, opt=3, jit=True)


def compile_object(text: str, target: Target) -> bytes:
    """Return the object code of a printed program for the processor that it was printed for, this one or another."""
    carried = text.startswith(target.heading) and target.attributes in text
    assert carried, f"the text was printed for another processor than {target}: LLVM would end the process"
    llvm, machine = _llvm(), _machine(target)
    module = llvm.parse_assembly(text)
    module.data_layout = str(machine.target_data)  # without it, vectors are spilled unaligned
    module.verify()
    passes = llvm.create_new_module_pass_manager()
    passes.add_instruction_combine_pass()  # programs are pruned and shared already: all of -O3 takes thrice as long
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    return machine.emit_object(module)


def _cache_folder() -> Path | None:
    """Return where the platform keeps caches, or where XDG_CACHE_HOME says on any platform; None: nowhere."""
    import platformdirs  # when a program is compiled

    try:
        root = os.environ.get("XDG_CACHE_HOME")
        found = Path(root) / "taciturn" if root else platformdirs.user_cache_path("taciturn", appauthor=False)
    except RuntimeError:
        return None  # no home: compile each time rather than trust a folder that others can write
    return found if root or found.is_absolute() else None


def _read_object(path: Path) -> bytes | None:
    try:
        content = path.read_bytes()
    except OSError:
        return None
    with contextlib.suppress(OSError):  # a read-only home forgets when it was used
        os.utime(path)
    digest, code = content[:32], content[32:]
    if not code or hashlib.sha256(code).digest() != digest:
        warnings.warn(f"the kept machine code {path} is damaged; it is compiled again", stacklevel=2)
        return None
    return code


def _write_object(path: Path, code: bytes) -> None:
    """Keep the code if the disk lets us; a name is only ever given to a whole file."""
    with contextlib.suppress(OSError):  # a read-only home costs time, nothing else
        write_whole(path, hashlib.sha256(code).digest() + code)
        if len(os.listdir(path.parent)) > MOST_KEPT + MOST_KEPT // SPARE:
            kept = sorted(path.parent.glob("*.o"), key=lambda file: file.stat().st_mtime)
            for oldest in kept[:-MOST_KEPT]:
                oldest.unlink()


def _into_blocks(rows: Array, lanes: int) -> Array:
    """(rows, paths) → (blocks, rows, lanes), the last block filled with copies of the first path."""
    count, paths = rows.shape
    missing = -paths % lanes
    padded = np.concatenate([rows, np.repeat(rows[:, :1], missing, axis=1)], axis=1)
    return np.ascontiguousarray(padded.reshape(count, (paths + missing) // lanes, lanes).transpose(1, 0, 2))


def _from_blocks(blocks: Array, paths: int) -> Array:
    """(blocks, rows, lanes) → (rows, paths)."""
    count, rows, lanes = blocks.shape
    return blocks.transpose(1, 0, 2).reshape(rows, count * lanes)[:, :paths]


def _ticks_into_blocks(inputs: Array, lanes: int) -> Array:
    """(ticks, inputs, paths) → (blocks, ticks, inputs, lanes)."""
    ticks, count, paths = inputs.shape
    return _into_blocks(inputs.reshape(ticks * count, paths), lanes)
