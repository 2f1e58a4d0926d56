"""The command that computes the tables and figures of the thesis."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from taciturn.cli.frame import EXAMPLE, GROUPS, Json, Seed, Verbose, app, complete_from, progress_bar

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from taciturn_thesis.reproduction import Reproduction

GROUPS["Reproduce the thesis"] = ["reproduce"]


@app.command(epilog=EXAMPLE + "taciturn reproduce chapter2 --out pictures")
def reproduce(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME…]",
            help="Chapters: chapter2 to chapter7, or all (the default).",
            autocompletion=complete_from("all", *(f"chapter{i}" for i in range(2, 8))),
        ),
    ] = None,
    as_json: Json = False,
    verbose: Verbose = False,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for the figures. Default: the current folder.")
    ] = None,
    seed: Seed = 0,
    twin: Annotated[
        bool, typer.Option("--twin", help="Run the experiments of chapters 6 and 7 with digital twins.")
    ] = False,
) -> None:
    """Compute the tables and figures of the thesis, and compare them with the numbers in the thesis.

    For other parameters use taciturn tradeoff FILE --over NAME=v1,v2,…
    """
    from taciturn.errors import ProblemError
    from taciturn.extend import save
    from taciturn.study.record import origin
    from taciturn_thesis.reproduce import CHAPTERS, experiments, no_chapter, repeat_experiment
    from taciturn_thesis.reproduce import reproduce as compute

    known, make = (experiments(), repeat_experiment) if twin else (list(CHAPTERS), compute)
    chosen = known if not names or "all" in names else names
    unknown = [name for name in chosen if name not in known]
    if unknown:
        raise no_chapter(unknown[0], known)
    folder = out or Path()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ProblemError(
            f"the folder {str(folder)!r} cannot be created ({error.strerror}); expected a writable folder"
        ) from None
    documents: list[dict[str, Any]] = []
    pictures: dict[Path, tuple[Figure, Reproduction]] = {}
    for name in chosen:
        with progress_bar(name) as progress:
            found = make(name, seed=seed, progress=progress)
        documents.append(found.document() | origin(found.problems, seed))
        pictures |= {folder / f"{file}.svg": (picture, found) for file, picture in found.pictures.items()}
        if not as_json:
            typer.echo(f"\n{found.text(verbose)}")
    if as_json:
        typer.echo(json.dumps(documents, indent=1, allow_nan=False))
    for path, (picture, found) in pictures.items():  # after the numbers, which must be printed even if a figure fails
        if out is not None or not as_json:
            save(picture, path, origin(found.problems, seed))
            if not as_json:
                typer.echo(f"picture: {path}")
