"""Export a problem's policy as C99 sources for devices, or as a co-simulation unit (FMU).

The exported code consists of generated data and a handwritten core (``core/``), which is the same for every policy. The
core implements packets, their checks, the step of a node, and the exchange of packets between all nodes in one process.
It allocates no memory. The self-check, the FMU and the emulated boards run the same files. They compare every decision
and every bit of the input with a recording of the loop's bit-exact build.

Before an export in single precision, the loop is simulated in both precisions, and refused if the costs differ
(``bear_single``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import hypot
from pathlib import Path

from taciturn.errors import ProblemError, UnstableError
from taciturn.extend import Progress, choice, count
from taciturn.loop import Loop
from taciturn.problem.without_file import Studied, as_problem
from taciturn.program.ops import Precision
from taciturn.simulation.average import average, plain_average
from taciturn_export.fmu import Fmu, Version, check_name, print_fmu
from taciturn_export.folder import CFolder, print_folder
from taciturn_export.node import identifier

STEPS = 1_000_000  # simulated steps in each precision
WORSE = 0.01  # largest relative increase of the cost by single precision


def export_c(
    problem: Studied,
    folder: str | Path,
    *,
    name: str = "policy",
    nodes: Sequence[str] = (),
    precision: Precision = "float64",
    seed: int = 0,
    progress: Progress | None = None,
) -> CFolder:
    """Write the nodes of a problem's policy as C99 sources, whose decisions equal the design's decisions bit for bit.

    Args:
        problem: from ``load`` or ``Problem``.
        folder: target folder; it is created if necessary, and the files of an earlier export are replaced.
        name: prefix of the names in C.
        nodes: names of the nodes to export; default: all.
        precision: floating-point precision: ``"float64"``, or ``"float32"`` if a simulation shows that it is
            sufficient.
        seed: seed of the random draws of the policy and of the self-check.
        progress: callback that receives the fraction done.

    Returns:
        The written files.

    Raises:
        ProblemError: the policy has no sampling steps or no nodes, is too large for a device, or fails in single
            precision, or the folder cannot be written to.

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
    problem: Studied,
    path: str | Path,
    *,
    name: str = "policy",
    version: Version = "3.0",
    precision: Precision = "float64",
    seed: int = 0,
    progress: Progress | None = None,
) -> Fmu:
    """Write a problem's policy as a functional mock-up unit (FMU) for co-simulation in other programs.

    A step of the unit is one step of all nodes. The inputs of the unit are the measurements ``y[i]`` and, if links can
    drop packets, ``lost_LINK``. The outputs are ``u[i]``, ``sent_LINK``, ``sends_LINK`` and ``degraded``, and
    ``silence_LINKS`` if the nodes add up the cost of their silence.

    Args:
        problem: from ``load`` or ``Problem``.
        path: target file, which ends in ``.fmu``.
        name: name of the model.
        version: version of FMI: ``"3.0"`` or ``"2.0"``.
        precision: floating-point precision: ``"float64"``, or ``"float32"`` if a simulation shows that it is
            sufficient.
        seed: seed of the random draws of the policy.
        progress: callback that receives the fraction done.

    Returns:
        The written unit; a note reports if it contains no binary because this machine has no compiler.

    Raises:
        ProblemError: the policy has no sampling steps or no nodes, is too large for a device, or fails in single
            precision, or the file cannot be written.

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


def _prepared(problem: Studied, precision: Precision, seed: int, progress: Progress | None) -> Loop:
    problem = as_problem("problem", problem)
    choice("precision", precision, ("float64", "float32"))
    count("seed", seed, 0)
    loop = problem.close(problem.design())
    return loop if precision == "float64" else bear_single(loop, seed, progress)


def bear_single(loop: Loop, seed: int = 0, progress: Progress | None = None) -> Loop:
    """Return the loop in single precision; raise an error if single precision raises its cost."""
    single = replace(loop, precision="float32")

    def told(begin: float) -> Progress:
        return lambda fraction: None if progress is None else progress(begin + fraction / 2)

    double = average(loop, plain_average(loop), seed=seed, steps=STEPS, progress=told(0.0)).cost
    try:
        found = average(single, plain_average(single), seed=seed, steps=STEPS, progress=told(0.5)).cost
    except UnstableError:
        raise ProblemError(
            "precision is 'float32', with which the loop is unstable; expected 'float64', or a rescaled problem"
        ) from None
    error = hypot(double.standard_error, found.standard_error)
    if abs(found.value - double.value) > 4 * error + WORSE * abs(double.value):
        raise ProblemError(
            f"precision is 'float32', with which the cost of the loop is {found}, compared with {double} in "
            "'float64'; expected 'float64', or a rescaled problem"
        )
    return single
