"""Commands that take a policy to devices and other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, cast

import typer

from taciturn import _print
from taciturn.cli.frame import File, Json, Seed, app, print_json, progress_bar


@app.command()
def export(
    file: File,
    c: Annotated[Path | None, typer.Option("--c", metavar="DIR", help="Write C99 sources here.")] = None,
    fmu: Annotated[Path | None, typer.Option("--fmu", metavar="OUT.fmu", help="Write a co-simulation unit.")] = None,
    nodes: Annotated[
        list[str] | None,
        typer.Option("--node", metavar="sensor|controller|actuator", help="With --c: this node alone. Default: all."),
    ] = None,
    precision: Annotated[str, typer.Option(help="Of their numbers: float64 or float32.")] = "float64",
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Write a policy as C99 for a device, or as a unit for other simulators: with the same decisions, bit for bit."""
    import taciturn
    from taciturn.errors import ProblemError
    from taciturn.study.export import export_c

    if c is None:
        raise ProblemError("neither --c nor --fmu is given; expected where to write to")
    problem = taciturn.load(file)
    with progress_bar("comparing precisions") as progress:
        found = export_c(
            problem, c, name=Path(file).stem, nodes=cast("Any", nodes or ()), precision=cast("Any", precision),
            seed=seed, progress=progress,
        )  # fmt: skip
    if as_json:
        print_json(found.document())
    else:
        _print.pairs(found.lines())
