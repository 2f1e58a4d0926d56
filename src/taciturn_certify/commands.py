"""The command ``taciturn certify``."""

from __future__ import annotations

from taciturn.cli.frame import (
    EXAMPLE,
    File,
    Json,
    NoFunctions,
    PictureStyle,
    Plot,
    Settings,
    TimeLimit,
    Verbose,
    app,
    load_changed,
    print_result,
    progress_bar,
    save_picture,
)


@app.command(epilog=EXAMPLE + "taciturn certify two-mass")
def certify(
    file: File,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    as_json: Json = False,
    verbose: Verbose = False,
    plot: Plot = None,
    style: PictureStyle = None,
    time: TimeLimit = None,
) -> None:
    """Compute certificates of decay rate, l2 gain and cost from linear matrix inequalities."""
    import taciturn
    from taciturn.extend import answered_within

    with answered_within(time), progress_bar("certifying"):
        problem = load_changed(file, settings, no_functions)
        found = taciturn.certify(problem)
    print_result(found, as_json, verbose, problem)
    save_picture(found, plot, style, as_json, problem)
