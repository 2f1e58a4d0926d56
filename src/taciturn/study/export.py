"""From a problem to files for other machines and programs, after a look at what single precision does to the loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import hypot
from pathlib import Path

from taciturn._arrays import choice, count
from taciturn._progress import Progress
from taciturn.errors import ProblemError, UnstableError
from taciturn.export.description import Version
from taciturn.export.fmu import Fmu, check_name, print_fmu
from taciturn.export.folder import CFolder, print_folder
from taciturn.export.node import identifier
from taciturn.loop import Loop
from taciturn.model.policy import NodeName
from taciturn.problem import Problem, expect_problem
from taciturn.program.ops import Precision
from taciturn.simulation.average import average, plain_average

STEPS = 1_000_000  # of the loop in each precision
WORSE = 0.01  # share of the cost that single precision may cost


def export_c(
    problem: Problem,
    folder: str | Path,
    *,
    name: str = "policy",
    nodes: Sequence[NodeName] = (),
    precision: Precision = "float64",
    seed: int = 0,
    progress: Progress | None = None,
) -> CFolder:
    """Write the nodes of a problem's policy as C99: what they compute has the bits of the design.

    Args:
        problem: from ``load`` or ``Problem``.
        folder: where; it is made where it is not there, and what an earlier export left is replaced.
        name: with which the names in C begin.
        nodes: ``"sensor"``, ``"controller"``, ``"actuator"``; omitted: all.
        precision: of their numbers: ``"float64"``, or ``"float32"``, after a simulation has shown that it is enough.
        seed: of the draws of the policy and of the self-check.
        progress: called with the fraction done.

    Returns:
        What was written.

    Raises:
        ProblemError: the policy has no tick or no nodes, is too large for a device, does not bear single precision, or
            the folder cannot be written to.

    Example:
        >>> import tempfile
        >>> from taciturn import load
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     written = export_c(load("two-mass"), folder, name="two-mass")
        >>> [node.name for node in written.nodes]
        ['two_mass_controller', 'two_mass_actuator']
    """
    loop = _prepared(problem, precision, seed, progress)
    found = print_folder(loop, identifier(name), nodes=nodes, seed=seed)
    found.write(Path(folder))
    return found


def export_fmu(
    problem: Problem,
    path: str | Path,
    *,
    name: str = "policy",
    version: Version = "3.0",
    precision: Precision = "float64",
    seed: int = 0,
    progress: Progress | None = None,
) -> Fmu:
    """Write a problem's policy as a functional mock-up unit, for co-simulation in other programs.

    A step is one tick of all nodes: inputs are the measurements ``y[i]`` and, where packets may be lost, ``lost_LINK``;
    outputs ``u[i]``, ``sent_LINK``, ``sends_LINK`` and ``degraded``.

    Args:
        problem: from ``load`` or ``Problem``.
        path: ends in ``.fmu``.
        name: of the model.
        version: of FMI: ``"3.0"`` or ``"2.0"``.
        precision: of the numbers: ``"float64"``, or ``"float32"``, after a simulation has shown that it is enough.
        seed: of the draws of the policy.
        progress: called with the fraction done.

    Returns:
        What was written; its notes tell where it has no binary, as this machine has no compiler.

    Raises:
        ProblemError: the policy has no tick or no nodes, is too large for a device, does not bear single precision, or
            the file cannot be written.

    Example:
        >>> import tempfile
        >>> from taciturn import load
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     unit = export_fmu(load("two-mass"), f"{folder}/two-mass.fmu", name="two-mass")
        >>> unit.name, [node.role for node in unit.nodes]
        ('two_mass', ['controller', 'actuator'])
    """
    check_name(Path(path))  # before anything is compiled
    found = print_fmu(_prepared(problem, precision, seed, progress), identifier(name), version=version, seed=seed)
    found.write(Path(path))
    return found


def _prepared(problem: Problem, precision: Precision, seed: int, progress: Progress | None) -> Loop:
    expect_problem("problem", problem)
    choice("precision", precision, ("float64", "float32"))
    count("seed", seed, 0)
    loop = problem.close(problem.design())
    return loop if precision == "float64" else bear_single(loop, seed, progress)


def bear_single(loop: Loop, seed: int = 0, progress: Progress | None = None) -> Loop:
    """Return a loop in single precision, once a simulation has shown that it costs what it does in double.

    Args:
        loop: in double precision.
        seed: of the draws, which are the same in both.
        progress: called with the fraction done.

    Raises:
        ProblemError: it costs more, or is unstable.
    """
    single = replace(loop, precision="float32")

    def told(begin: float) -> Progress:
        return lambda fraction: None if progress is None else progress(begin + fraction / 2)

    double = average(loop, plain_average(loop), seed=seed, steps=STEPS, progress=told(0.0)).cost
    try:
        found = average(single, plain_average(single), seed=seed, steps=STEPS, progress=told(0.5)).cost
    except UnstableError:
        raise ProblemError(
            "precision is 'float32', in which the loop is unstable; expected 'float64', or a problem that is scaled"
        ) from None
    error = hypot(double.standard_error, found.standard_error)
    if abs(found.value - double.value) > 4 * error + WORSE * abs(double.value):
        raise ProblemError(
            f"precision is 'float32', in which the loop costs {found}, and {double} in 'float64'; "
            "expected 'float64', or a problem that is scaled"
        )
    return single
