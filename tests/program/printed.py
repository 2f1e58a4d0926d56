"""Programs without memory under every printer, for tests of what they compute."""

from __future__ import annotations

import ctypes as c
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
from export.devices import STRICT, needs_compiler

from taciturn.program.c import c_literal, constant_array, print_c, print_root
from taciturn.program.ir import Builder, Program
from taciturn.program.machine import Kernel
from taciturn.program.numpy import run
from taciturn.program.ops import Precision
from taciturn.program.python import compile_python


def program_of(rule: Callable[..., int], inputs: int, precision: Precision = "float64") -> Program:
    """Return the program that computes one number of its inputs."""
    builder = Builder(precision)
    return builder.finish([], {}, {"found": rule(builder, *(builder.input(f"x {i}") for i in range(inputs)))})


def by_numpy(program: Program, *values: np.ndarray) -> np.ndarray:
    """Return what it computes by its meaning."""
    return run(program, np.zeros((0, len(values[0]))), 1, np.array(values)[None]).outputs["found"][0]


def by_machine(program: Program, build: str, *values: np.ndarray) -> np.ndarray:
    """Return what it computes in machine code."""
    kernel = Kernel(program, build)  # type: ignore[arg-type]
    return kernel.run(program, np.zeros((0, len(values[0]))), 1, np.array(values)[None]).outputs["found"][0]


def by_python(program: Program, *values: np.ndarray) -> np.ndarray:
    """Return what it computes as a function of Python."""
    tick = compile_python(program)
    return np.array([tick((), row)[1][0] for row in zip(*(one.tolist() for one in values), strict=True)])


def by_c(program: Program, folder: Path, *values: np.ndarray) -> np.ndarray:
    """Return what it computes in C."""
    number = "float" if program.precision == "float32" else "double"
    constants = list[float]()
    tick = print_c(program, "tick", range(len(program.inputs)), constants)
    stored = constant_array(
        "tac_real", "constants", [c_literal(value, program.precision) for value in [*constants, 0.0]]
    )
    text = (
        "#include <math.h>\n#include <stdbool.h>\n#include <stddef.h>\n#include <stdint.h>\n#include <string.h>\n"
        f"typedef {number} tac_real;\ntac_real used(tac_real x);\n"
        "void each(const tac_real *inputs, tac_real *outputs, size_t count, size_t width);\n"
        f"{print_root(program.precision)}{tick}{stored}"
        "tac_real used(tac_real x) { return tac_root(x); }\n"
        "void each(const tac_real *inputs, tac_real *outputs, size_t count, size_t width)\n"
        "{ for (size_t i = 0; i < count; ++i) tick(constants, inputs + i * width, NULL, outputs + i); }\n"
    )
    source, library = folder / "tick.c", folder / "tick.so"
    source.write_text(text, encoding="ascii")
    options = [*STRICT, "-ffp-contract=off", "-O1", "-shared", "-fPIC"]
    subprocess.run([needs_compiler(), *options, str(source), "-o", str(library)], check=True)
    given = np.ascontiguousarray(np.array(values, dtype=program.precision).T)
    found = np.empty(len(given), dtype=program.precision)
    pointers = given.ctypes.data_as(c.c_void_p), found.ctypes.data_as(c.c_void_p)
    c.CDLL(str(library)).each(*pointers, c.c_size_t(len(given)), c.c_size_t(len(values)))
    return found.astype(np.float64)
