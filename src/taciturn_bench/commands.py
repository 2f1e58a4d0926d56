"""The command ``taciturn bench``."""

from __future__ import annotations

from typing import Annotated

import typer

from taciturn.cli.frame import EXAMPLE, Json, app, print_result, progress_bar


@app.command(epilog=EXAMPLE + "taciturn bench --rounds 3")
def bench(
    as_json: Json = False,
    rounds: Annotated[int, typer.Option(help="Number of measurement rounds, of which the medians are printed.")] = 5,
) -> None:
    """Measure the simulation speed on this machine, compared with NumPy."""
    from taciturn_bench.bench import bench as measure

    with progress_bar("measuring") as progress:
        found = measure(rounds, progress)
    print_result(found, as_json)
