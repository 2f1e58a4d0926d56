"""The command ``taciturn bench``."""

from __future__ import annotations

from typing import Annotated

import typer

from taciturn.cli.frame import EXAMPLE, Json, Verbose, app, print_result, progress_bar


@app.command(epilog=EXAMPLE + "taciturn bench --rounds 3")
def bench(
    as_json: Json = False,
    verbose: Verbose = False,
    rounds: Annotated[
        int, typer.Option(help="Number of rounds of measurements; the printed numbers are medians over all rounds.")
    ] = 5,
) -> None:
    """Measure how fast Taciturn simulates on this machine, compared with a NumPy program of the same loop."""
    from taciturn_bench.bench import bench as measure

    with progress_bar("measuring") as progress:
        found = measure(rounds, progress)
    print_result(found, as_json, verbose)
