"""From a problem to files for a device: its nodes as C99, after a look at what single precision does to the loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import hypot
from pathlib import Path

from taciturn._arrays import choice, count
from taciturn.errors import ProblemError, UnstableError
from taciturn.export.folder import CFolder, print_folder
from taciturn.export.node import identifier
from taciturn.loop import Loop
from taciturn.model.policy import NodeName
from taciturn.problem import Problem
from taciturn.program.ops import Precision
from taciturn.simulation.average import average, plain_average
from taciturn.simulation.sampling import Progress

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
    choice("precision", precision, ("float64", "float32"))
    count("seed", seed, 0)
    loop = problem.close(problem.design())
    if precision == "float32":
        loop = bear_single(loop, seed, progress)
    found = print_folder(loop, identifier(name), nodes=nodes, seed=seed)
    found.write(Path(folder))
    return found


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
    told = progress or (lambda fraction: None)
    double = average(loop, plain_average(loop), seed=seed, steps=STEPS, progress=lambda done: told(done / 2)).cost
    try:
        found = average(
            single, plain_average(single), seed=seed, steps=STEPS, progress=lambda done: told(0.5 + done / 2)
        ).cost
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
