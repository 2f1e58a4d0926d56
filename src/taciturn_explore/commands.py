"""The command ``taciturn explore``: it serves a page that shows cost and traffic while a user changes settings."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from taciturn.cli.frame import EXAMPLE, GROUPS, File, NoFunctions, Settings, app, load_changed, progress_bar
from taciturn_udp.commands import Bind

GROUPS["Design and inspect"].append("explore")
PAUSE = 0.2  # seconds between two looks at whether the command shall end


@app.command(epilog=EXAMPLE + "taciturn explore two-mass")
def explore(
    file: File = "two-mass",
    settings: Settings = None,
    no_functions: NoFunctions = False,
    bind: Bind = "127.0.0.1:0",
    token: Annotated[
        str | None, typer.Option(help="Token that the address of the page contains. Default: a random token.")
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option(
            metavar="PAGE.html", help="Write the page to a file that needs no server, with precomputed results."
        ),
    ] = None,
    recording: Annotated[
        list[Path] | None,
        typer.Option(
            "--recording",
            metavar="RECORD",
            help="Show a recorded run from a file that `taciturn network`, `taciturn show` or `taciturn twin` "
            "wrote, from the folder of `taciturn network --record`, or from the logs of nodes. Repeat the option for "
            "each log.",
        ),
    ] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
) -> None:
    """Serve a page that shows cost and traffic of a problem while you change settings; stop the server with Ctrl-C.

    With --recording, the page shows the record of a run, with its faults.
    """
    import webbrowser

    from taciturn.extend import number_of, until_stopped
    from taciturn_explore.server import open_page, open_recording
    from taciturn_explore.setting import setting_for, settings_of
    from taciturn_udp.endpoint import parse_address

    address = parse_address("--bind", bind, own=True)
    if recording:
        from taciturn_explore.recording import read_recording

        problem = load_changed(file, settings, no_functions)
        found = read_recording(recording, problem)
        if save is not None:
            from taciturn_explore.saved import save_recording

            save_recording(found, save)
            typer.echo(f"page: {save}, with {number_of(len(recording), 'file')}")
            return
        opened = partial(open_recording, found, address, token)
    else:
        begin, trusted = setting_for(file, not no_functions)
        begin = settings_of(begin, settings or [], trusted)
        if save is not None:
            from taciturn_explore.saved import save_page

            with progress_bar("computing") as progress:
                many = save_page(begin, trusted, save, progress)
            typer.echo(f"page: {save}, with {number_of(many, 'setting')}")
            return
        opened = partial(open_page, begin, trusted, address, token)
    with until_stopped() as stopped, opened() as page:
        typer.echo(f"taciturn: the page is at {page.url}", err=True)
        if browser:
            webbrowser.open(page.url)
        while not stopped():
            time.sleep(PAUSE)
