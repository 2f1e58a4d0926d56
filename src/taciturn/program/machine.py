"""Compiles printed programs through llvmlite, keeps the object code, and runs it on threads.

Object code is kept in memory and on disk (``$XDG_CACHE_HOME/taciturn``), by the text of the program, the processor and
the version of llvmlite. This is the one typed door to llvmlite.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import tempfile
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn.program.ir import Program
from taciturn.program.llvm import Build, constants_of, print_llvm
from taciturn.program.numpy import Run

_SIGNATURE = ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * 3, *[ctypes.c_void_p] * 5)


class Kernel:
    """Machine code of a program, for any program of the same structure.

    Args:
        program: the program.
        build: ``"fast"`` or ``"parity"``.
    """

    def __init__(self, program: Program, build: Build = "fast") -> None:
        self.lanes = vector_lanes()
        self._code = _load(print_llvm(program, self.lanes, build))

    def run(
        self, program: Program, states: Array, ticks: int, inputs: Array | None = None, threads: int | None = None
    ) -> Run:
        """Run ``ticks`` ticks on every path; arguments and result as in ``taciturn.program.numpy.run``.

        Any number of paths and threads gives the same bits: a path sees nothing of its neighbours.
        """
        paths, lanes = states.shape[1], self.lanes
        blocks = -(-paths // lanes)
        state = _into_blocks(states, lanes)
        sums = np.zeros((blocks, len(program.sums), lanes))
        supplied = np.zeros((1,)) if inputs is None else _ticks_into_blocks(inputs, lanes)
        outputs = np.empty((blocks, ticks, len(program.outputs), lanes))
        constants = np.array(constants_of(program))
        arrays = (state, sums, constants, supplied, outputs)

        def work(part: tuple[int, int]) -> None:
            if part[0] < part[1] and ticks > 0:
                self._code.function(part[0], part[1], ticks, *(a.ctypes.data for a in arrays))

        workers = min(threads or available_processors(), blocks)
        cuts = [blocks * i // workers for i in range(workers + 1)]
        parts = list(zip(cuts[:-1], cuts[1:], strict=True))
        if workers == 1:
            work(parts[0])
        else:
            with ThreadPoolExecutor(workers) as pool:  # ctypes releases the interpreter lock
                list(pool.map(work, parts))
        width = blocks * lanes
        by_sum = sums.transpose(1, 0, 2).reshape(len(program.sums), width)[:, :paths]
        by_output = outputs.transpose(2, 1, 0, 3).reshape(len(program.outputs), ticks, width)[:, :, :paths]
        final = state.transpose(1, 0, 2).reshape(len(program.states), width)[:, :paths]
        return Run(
            np.ascontiguousarray(final),
            dict(zip(program.sums, by_sum, strict=True)),
            dict(zip(program.outputs, by_output, strict=True)),
        )


@cache
def available() -> bool:
    """Tell whether llvmlite can be imported; say so once where it cannot."""
    try:
        import llvmlite.binding  # noqa: F401  # asked for its presence only
    except ImportError as error:
        warnings.warn(f"llvmlite is missing ({error}): loops run in NumPy, ten times slower", stacklevel=2)
        return False
    return True


def available_processors() -> int:
    """Return the number of processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def vector_lanes() -> int:
    """Return the paths per block that suit this processor: the widest vector of doubles."""
    features = _host()[1]
    return 8 if "+avx512f" in features else 4 if "+avx2" in features else 2


class _Code:
    """A compiled module; it must outlive its function."""

    def __init__(self, engine: Any) -> None:
        self._engine = engine
        self.function = _SIGNATURE(engine.get_function_address("run"))


@cache
def _host() -> tuple[str, str]:
    """Return name and features of this processor."""
    import llvmlite.binding as llvm  # pyright: ignore[reportMissingTypeStubs]

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


@cache
def _load(text: str) -> _Code:
    """Return the machine code of a module, from the disk where it is there."""
    import llvmlite
    import llvmlite.binding as llvm

    cpu, features = _host()
    key = hashlib.sha256("\n".join([text, cpu, features, llvmlite.__version__]).encode()).hexdigest()
    kept = _cache_folder() / f"{key}.o"
    stored = _read_object(kept)
    target = llvm.Target.from_default_triple().create_target_machine(cpu=cpu, features=features, opt=3, jit=True)
    if stored is None:
        module = llvm.parse_assembly(f'target triple = "{llvm.get_process_triple()}"\n{text}')
        module.data_layout = str(target.target_data)  # without it, vectors are spilled unaligned
        module.verify()
        passes = llvm.create_pass_builder(target, llvm.create_pipeline_tuning_options(speed_level=3))
        passes.getModulePassManager().run(module, passes)
        stored = target.emit_object(module)
        _write_object(kept, stored)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target)
    engine.add_object_file(llvm.ObjectFileRef.from_data(stored))
    engine.finalize_object()
    return _Code(engine)


def _cache_folder() -> Path:
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "taciturn"


def _read_object(path: Path) -> bytes | None:
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, code = content[:32], content[32:]
    if hashlib.sha256(code).digest() != digest:
        warnings.warn(f"the kept machine code {path} is damaged; it is compiled again", stacklevel=2)
        return None
    return code


def _write_object(path: Path, code: bytes) -> None:
    """Keep the code if the disk lets us; a name is only ever given to a whole file."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as part:
            part.write(hashlib.sha256(code).digest() + code)
        os.replace(part.name, path)
    except OSError:
        return  # a read-only home costs time, nothing else


def _into_blocks(rows: Array, lanes: int) -> Array:
    """(rows, paths) → (blocks, rows, lanes), the last block filled with copies of the first path."""
    missing = -rows.shape[1] % lanes
    padded = np.concatenate([rows, np.repeat(rows[:, :1], missing, axis=1)], axis=1)
    return np.ascontiguousarray(padded.reshape(rows.shape[0], -1, lanes).transpose(1, 0, 2))


def _ticks_into_blocks(inputs: Array, lanes: int) -> Array:
    """(ticks, inputs, paths) → (blocks, ticks, inputs, lanes)."""
    ticks, count, _ = inputs.shape
    return _into_blocks(inputs.reshape(ticks * count, -1), lanes).reshape(-1, ticks, count, lanes)
