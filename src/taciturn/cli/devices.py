"""Commands that take a policy to devices and other programs."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from taciturn import _print
from taciturn.cli.frame import File, Json, Seed, app, print_json, progress_bar

if TYPE_CHECKING:
    from taciturn.export.cortex import Sizes


@app.command(epilog="Example: taciturn export two-mass --c out")
def export(
    file: File,
    c: Annotated[str | None, typer.Option("--c", metavar="DIR", help="Write C99 sources here.")] = None,
    fmu: Annotated[Path | None, typer.Option("--fmu", metavar="OUT.fmu", help="Write a co-simulation unit.")] = None,
    nodes: Annotated[
        list[str] | None,
        typer.Option(
            "--node",
            metavar="sensor|controller|actuator",
            help="With --c: this node alone; a place that the controller shares, as the sensor's of `lqg`, is "
            "`controller`. Default: all.",
        ),
    ] = None,
    precision: Annotated[str, typer.Option(help="Of their numbers: float64 or float32.")] = "float64",
    fmi: Annotated[str | None, typer.Option(metavar="3.0|2.0", help="With --fmu: version. Default: 3.0.")] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Write a policy as C99 for a device, or as a unit for other simulators: with the same decisions, bit for bit."""
    import taciturn
    from taciturn.errors import ProblemError
    from taciturn.export.cortex import measure_somewhere
    from taciturn.export.folder import CFolder

    if c == "":
        raise ProblemError("--c is empty; expected the name of a folder")
    if (c is None) == (fmu is None):
        given = "neither --c nor --fmu is" if c is None else "--c and --fmu are both"
        raise ProblemError(f"{given} given; expected one of them: where to write to")
    for option, value, needed, missing in (("--node", nodes, "--c", c is None), ("--fmi", fmi, "--fmu", fmu is None)):
        if value and missing:
            raise ProblemError(f"{option} is given without {needed}; expected both, or neither")
    problem, name, exact = taciturn.load(file), Path(file).stem, cast("Any", precision)
    with progress_bar("comparing precisions") as progress:
        if c is not None:
            found = taciturn.export_c(
                problem, c, name=name, nodes=cast("Any", nodes or ()), precision=exact, seed=seed, progress=progress
            )
        else:
            assert fmu is not None
            version = cast("Any", fmi or "3.0")
            found = taciturn.export_fmu(
                problem, fmu, name=name, version=version, precision=exact, seed=seed, progress=progress
            )
    document, lines = found.document(), found.lines()
    if isinstance(found, CFolder):
        measured = measure_somewhere(found)
        sizes = {} if measured is None else {name: one._asdict() for name, one in measured[1].items()}
        document["sizes"] = None if measured is None else {"processor": measured[0], **sizes}
        if not found.single:
            lines.append(("precision", "a Cortex-M computes float64 in software; --precision float32 is native to M4F"))
        sources = " ".join(sorted(file for file in found.files if file.endswith(".c")))
        lines += [("next", f"cd {quote(str(c))} && cc {sources} -lm -o selfcheck && ./selfcheck"), *_lines(measured)]
    if as_json:
        print_json(document)
    else:
        _print.pairs(lines)


def _lines(measured: tuple[str, dict[str, Sizes]] | None) -> list[tuple[str, str]]:
    """Return what is printed of the sizes of nodes."""
    if measured is None:
        return [("sizes", "not measured, as there is no compiler: apt install gcc-arm-none-eabi, or gcc")]
    processor, sizes = measured
    return [
        (
            f"size, {name}",
            f"{one.code} bytes of code, {one.constants} of constants, {one.memory} of memory ({processor})",
        )
        for name, one in sizes.items()
    ]
