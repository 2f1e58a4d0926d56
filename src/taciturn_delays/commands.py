"""The command ``taciturn delays``, which reads measured delays of packets and writes traces for problem files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, cast

import typer

from taciturn.cli.frame import EXAMPLE, GROUPS, Json, Verbose, app, complete_from, print_result

GROUPS["Measure and prove"].append("delays")


@app.command(epilog=EXAMPLE + "taciturn delays ping.txt --out trace.csv")
def delays(
    measured: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Output of ping, log of messages (MQTT), export of captured packets by tshark, packets.csv of a run, "
            "trace, or histogram.",
        ),
    ],
    receiver: Annotated[
        Path | None,
        typer.Argument(metavar="[RECEIVER]", help="Export by tshark at the receiver; FILE is the sender's."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="OUT.csv", help="Write a trace: the columns sent and delay in seconds.")
    ] = None,
    histogram: Annotated[
        Path | None,
        typer.Option(metavar="OUT.csv", help="Write a histogram: the columns milliseconds and probability."),
    ] = None,
    round_trip: Annotated[
        str,
        typer.Option(
            metavar="PART",
            help="For requests and answers: half the round trip, or the whole as the delay of both together.",
            autocompletion=complete_from("half", "whole"),
        ),
    ] = "half",
    synchronised: Annotated[
        bool,
        typer.Option("--synchronised", help="The times of sender and receiver are the same: take their difference."),
    ] = False,
    least: Annotated[
        float,
        typer.Option(
            metavar="SECONDS", help="Smallest delay, which cannot be measured with the times of two computers."
        ),
    ] = 0.0,
    link: Annotated[str | None, typer.Option(help="Link whose packets are read from packets.csv.")] = None,
    interval: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Time between the packets of ping, if its output has no times."),
    ] = None,
    sent: Annotated[
        str | None, typer.Option(metavar="NAME", help="Column or key of the time of sending of a message.")
    ] = None,
    received: Annotated[
        str | None, typer.Option(metavar="NAME", help="Column or key of the time of reception of a message.")
    ] = None,
    identity: Annotated[
        str | None,
        typer.Option("--id", metavar="NAME", help="Column, key or field that identifies a message or captured packet."),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(
            metavar="UNIT",
            help="Unit of the times of sending of messages, if they do not count from 1970: s, ms, us or ns.",
            autocompletion=complete_from("s", "ms", "us", "ns"),
        ),
    ] = None,
    kind: Annotated[
        str | None,
        typer.Option(
            metavar="FORM",
            help="Form of the file, if it is not recognised: ping, messages, captures, packets, trace or histogram.",
            autocompletion=complete_from("ping", "messages", "captures", "packets", "trace", "histogram"),
        ),
    ] = None,
    as_json: Json = False,
    verbose: Verbose = False,
) -> None:
    """Read measured delays of packets, print their statistics, and write a trace for problem files.

    A round trip is not a one-way delay, and the times of two computers do not give one: the command prints which
    assumption it makes. In a problem file, a link has the delays of a trace by [links.NAME] delay = {trace =
    "trace.csv"}.
    """
    from taciturn.errors import ProblemError
    from taciturn.extend import check_format
    from taciturn_delays.delays import read_delays

    for path, what in ((out, "trace"), (histogram, "histogram")):
        if path is not None:
            check_format(path, (".csv",), what)
            if path.resolve() in {one.resolve() for one in (measured, receiver) if one is not None}:
                raise ProblemError(
                    f"the {what} {str(path)!r} would replace the file that is read; expected another file name"
                )
    if out is not None and histogram is not None and out.resolve() == histogram.resolve():
        raise ProblemError(f"--out and --histogram are both {str(out)!r}; expected different file names")
    found = read_delays(
        measured, receiver, kind=cast("Any", kind), round_trip=cast("Any", round_trip), synchronised=synchronised,
        least=least, interval=interval, link=link, sent=sent, received=received, identity=identity,
        unit=cast("Any", unit),
    )  # fmt: skip
    if out is not None:
        found.save_trace(out)
    if histogram is not None:
        found.save_histogram(histogram)
    print_result(found, as_json, verbose)
    if not as_json:
        for path, key in ((out, "trace"), (histogram, "histogram")):
            if path is not None:
                typer.echo(f'written: {path}; in a problem file, [links.NAME] delay = {{{key} = "{path.as_posix()}"}}')
