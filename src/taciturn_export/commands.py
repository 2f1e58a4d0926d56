"""Commands that export a policy, as C code for devices or as an FMU for other simulators."""

from __future__ import annotations

import textwrap
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from taciturn.cli.frame import (
    EXAMPLE,
    File,
    Json,
    NoFunctions,
    Seed,
    Settings,
    Verbose,
    app,
    load_changed,
    print_json,
    progress_bar,
)

if TYPE_CHECKING:
    from taciturn_export.sizes import Sizes

INDENT = " " * 15  # of the values behind the names


@app.command(epilog=EXAMPLE + "taciturn export two-mass --c out")
def export(
    file: File,
    c: Annotated[str | None, typer.Option("--c", metavar="DIR", help="Write C99 sources to this folder.")] = None,
    fmu: Annotated[
        Path | None, typer.Option("--fmu", metavar="OUT.fmu", help="Write a co-simulation FMU to this file.")
    ] = None,
    nodes: Annotated[
        list[str] | None,
        typer.Option(
            "--node",
            metavar="NODE",
            help="Export only this node (with --c). `controller` also selects the nodes at the "
            "controller's site, such as the sensor of lqg. Default: all nodes.",
        ),
    ] = None,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    precision: Annotated[str, typer.Option(help="Number format: float64 or float32.")] = "float64",
    fmi: Annotated[
        str | None, typer.Option(metavar="3.0|2.0", help="With --fmu: version of FMI. Default: 3.0.")
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
    verbose: Verbose = False,
) -> None:
    """Export a policy as C99 for devices, or as an FMU for other simulators; its decisions remain bit-identical."""
    import taciturn
    from taciturn.errors import ProblemError
    from taciturn.extend import pairs_text, width
    from taciturn.study.record import origin
    from taciturn_export.folder import CFolder
    from taciturn_export.sizes import measure_somewhere

    if c == "":
        raise ProblemError("--c is empty; expected the name of a folder")
    if (c is None) == (fmu is None):
        given = "neither --c nor --fmu is" if c is None else "--c and --fmu are both"
        raise ProblemError(
            f"an export needs --c or --fmu, but {given} given; expected one of the two options, with the path to write "
            "to"
        )
    for option, value, needed, missing in (("--node", nodes, "--c", c is None), ("--fmi", fmi, "--fmu", fmu is None)):
        if value and missing:
            raise ProblemError(f"{option} is given without {needed}; expected both options, or neither of them")
    problem, name, exact = load_changed(file, settings, no_functions), Path(file).stem, cast("Any", precision)
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
    document, lines = found.document(), list[tuple[str, str]]()
    command, sized = "", list[tuple[str, str]]()
    if isinstance(found, CFolder):
        measured = measure_somewhere(found)
        sizes = {} if measured is None else {name: one._asdict() for name, one in measured[1].items()}
        document["sizes"] = None if measured is None else {"processor": measured[0], **sizes}
        if not found.single:
            lines.append(("precision", "a Cortex-M computes float64 in software; --precision float32 is native to M4F"))
        command = f"cc {' '.join(found.sources)} -lm -o selfcheck && ./selfcheck"
        sized = _lines(measured)
    if as_json:
        print_json(document, origin(problem, seed))
    else:
        typer.echo("\n".join(filter(None, (found.text(verbose), pairs_text(lines)))))
        if command:  # its lines end in a backslash, so that it can be copied
            parts = textwrap.wrap(command, width() - len(INDENT) - 2, break_long_words=False, break_on_hyphens=False)
            typer.echo(f"{'next':14s} " + f" \\\n{INDENT}".join([f"cd {quote(str(c))} &&", *parts]))
            typer.echo(pairs_text(sized))


def _lines(measured: tuple[str, dict[str, Sizes]] | None) -> list[tuple[str, str]]:
    """Return the lines to print about the sizes of nodes."""
    if measured is None:
        return [("sizes", "not measured, because no compiler is installed: apt install gcc-arm-none-eabi, or gcc")]
    processor, sizes = measured
    return [
        (
            f"size, {name}",
            f"{one.code} bytes of code, {one.constants} of constants, {one.memory} of memory ({processor})",
        )
        for name, one in sizes.items()
    ]
