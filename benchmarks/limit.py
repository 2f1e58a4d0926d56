"""Builds ``limit.cpp``, the two-mass loop written by hand, for this processor, and runs it."""

from __future__ import annotations

import ctypes
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from taciturn.loop import Loop
from taciturn.model.steps import Assign
from taciturn.program.llvm import VECTORS

SOURCE = Path(__file__).with_name("limit.cpp")
FLAGS = ["-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-std=c++17", "-shared", "-fPIC"]

PROCESSORS = {"avx2": "haswell", "baseline": "x86-64"}  # where the environment asks for narrower vectors


class Limit:
    """The functions of ``limit.cpp`` for a loop of two masses.

    Args:
        loop: the built-in problem, closed.
        compiler: of C++.
    """

    def __init__(self, loop: Loop, compiler: str = "g++") -> None:
        """Write the numbers, compile, load."""
        self.folder = tempfile.TemporaryDirectory(prefix="taciturn-limit-")
        folder = Path(self.folder.name)
        (folder / "numbers.h").write_text(numbers(loop))
        target = folder / "limit.so"
        asked = PROCESSORS.get(os.environ.get(VECTORS, ""), "native")
        subprocess.run([compiler, *FLAGS, f"-march={asked}", f"-I{folder}", "-o", str(target), str(SOURCE)], check=True)
        self.code = ctypes.CDLL(str(target))
        self.sums = (ctypes.c_double * 3)()

    def run(self, form: str, seed: int, paths: int, ticks: int) -> tuple[float, float, float]:
        """Return cost, sends and completed squares of a form, as means per step."""
        getattr(self.code, form)(
            ctypes.c_uint64(seed), ctypes.c_long(paths), ctypes.c_long(ticks), ctypes.byref(self.sums)
        )
        cost, sent, excess = (float(value) / (paths * ticks) for value in self.sums)
        return cost, sent, excess


def numbers(loop: Loop) -> str:
    """Return the constants of the loop as a header."""
    problem, plant, policy = loop.problem, loop.problem.plant, loop.policy
    steps = {step.signal: step.branches[0] for step in policy.steps if isinstance(step, Assign)}
    gain, L = (np.asarray(steps[a][b]) for a, b in (("estimate", "innovation"), ("command", "estimate")))
    silent, send = policy.decisions["send"].options.values()
    Psi = np.asarray(silent.Psi)
    assert policy.theory.innovations is not None
    assert policy.theory.identity is not None
    driven = gain @ np.linalg.cholesky(policy.theory.innovations.covariance)
    q = float(problem.Q[0, 0])
    singles = {
        "Q": q,
        "THETA": -float(Psi[0, 0]) / q,
        "ERROR_WEIGHT": float(Psi[-1, -1]),
        "EXCESS_WEIGHT": float(np.asarray(policy.theory.identity.forms[0].Psi)[-1, -1]),
        "GAMMA": float(send.constant),
        "W_ROOT": float(np.sqrt(plant.W[0, 0])),
        "V_ROOT": float(np.sqrt(plant.V[0, 0])),
    }
    lines = [f"static constexpr double {name} = {value!r};" for name, value in singles.items()]
    law = loop.network.links["actuator"].delay  # of a loop with random delays of 0, 1 or 2 steps
    delays = np.cumsum([0.6, 0.25, 0.1] if law is None else law.odds[0])
    arrays = {"DELAYS": delays} | {"A": plant.A, "B": plant.B[:, 0], "KALMAN": gain, "L": L[0], "DRIVEN": driven}
    for name, array in arrays.items():
        size = "".join(f"[{n}]" for n in array.shape)
        text = str(array.tolist()).replace("[", "{").replace("]", "}")
        lines.append(f"static constexpr double {name}{size} = {text};")
    return "\n".join(lines) + "\n"
