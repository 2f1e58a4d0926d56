"""The option of ``taciturn network`` that runs a world of faults."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import typer

from taciturn.cli.frame import print_result

if TYPE_CHECKING:
    from taciturn.problem import Problem


def run_world(problem: Problem, seed: int, others: Sequence[str], as_json: bool) -> None:
    """Run a world of faults and print it; if an invariant is broken, say so and end with exit code 1."""
    from taciturn.errors import ProblemError
    from taciturn_worlds.world import run_world_with_devices

    if others:
        raise ProblemError(f"--world is given with {others[0]}, which it does not use; expected --world alone")
    found = run_world_with_devices(problem, seed)
    print_result(found, as_json, problem)
    if found.broken is not None:
        typer.echo(f"world {seed} breaks an invariant at {found.broken}; expected none: please report it", err=True)
        raise typer.Exit(1)
