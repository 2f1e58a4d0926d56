"""The option ``--world`` of ``taciturn network``, which tests nodes under random faults (a world of faults)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import typer

from taciturn.cli.frame import print_result

if TYPE_CHECKING:
    from taciturn.problem import Problem


def run_world(problem: Problem, seed: int, others: Sequence[str], as_json: bool, verbose: bool) -> None:
    """Test the nodes under random faults and print the result; exit with code 1 if an invariant is violated."""
    from taciturn.errors import ProblemError
    from taciturn_worlds.world import run_world_with_devices

    if others:
        raise ProblemError(
            f"--world is given with {others[0]}, which it does not use; expected --world without {others[0]}"
        )
    found = run_world_with_devices(problem, seed)
    print_result(found, as_json, verbose, problem)
    if found.broken is not None:
        typer.echo(f"world {seed} breaks an invariant at {found.broken}; expected none: please report it", err=True)
        raise typer.Exit(1)
