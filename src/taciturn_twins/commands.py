"""Commands that run the digital twin of a robot, or only its camera."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from taciturn.cli.frame import (
    EXAMPLE,
    GROUPS,
    File,
    Json,
    NoFunctions,
    PictureStyle,
    Plot,
    Seed,
    Verbose,
    app,
    print_json,
    progress_bar,
)
from taciturn_udp.commands import Bind, Key, Loops, RealTime, TickLength, check_counts, tick_length

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from taciturn_twins.run import TwinRun
    from taciturn_twins.trial import Setup

GROUPS["Run"] += ["twin", "camera"]
Robot = Annotated[str, typer.Argument(metavar="rover|omni", help="The robot: rover or omni.")]
Faults = Annotated[
    list[str] | None,
    typer.Option(
        "--fault",
        metavar="NAME@START+SECONDS=SIZE",
        help="Inject a fault into the run. NAME: camera, cover, light, actuator, kidnap, push, gain or controller.",
    ),
]


@app.command(epilog=EXAMPLE + "taciturn twin rover --seed 1")
def twin(
    robot: Robot,
    file: Annotated[
        str | None,
        typer.Argument(
            metavar="[FILE]",
            help="Problem file with the policy. Default: the policy of the thesis, designed for an identified "
            "model of the robot.",
        ),
    ] = None,
    seed: Seed = 0,
    runs: Annotated[int, typer.Option(help="Number of runs at the same time, with consecutive seeds.")] = 1,
    price: Annotated[
        float | None,
        typer.Option(help="Price of a packet (robot omni) or of a picture (robot rover)."),
    ] = None,
    theta: Annotated[float | None, typer.Option(help="Parameter theta of the rover's policy.")] = None,
    real_time: RealTime = False,
    tick: TickLength = None,
    namespaces: Annotated[
        bool,
        typer.Option(
            "--namespaces",
            help="Run each node in its own network namespace, in which the Linux kernel drops the packets. "
            "Requires root.",
        ),
    ] = False,
    no_functions: NoFunctions = False,
    fault: Faults = None,
    wheels: Annotated[
        str | None, typer.Option(help="Wheel model: capsule, or for the robot omni also rollers.")
    ] = None,
    key: Key = None,
    record: Annotated[
        Path | None, typer.Option(metavar="OUT.nc", help="Write all signals and events to a NetCDF file.")
    ] = None,
    video: Annotated[
        Path | None, typer.Option(metavar="OUT.webp", help="Write the camera pictures of the first run to this file.")
    ] = None,
    plot: Plot = None,
    style: PictureStyle = None,
    live: Annotated[bool, typer.Option("--live", help="Serve a live page that shows one run after another.")] = False,
    bind: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="With --live: address of the page. Default: 127.0.0.1:8000.")
    ] = None,
    token: Annotated[
        str | None,
        typer.Option(
            help="With --live: token that gives access to the page. Default: a random token, which the printed "
            "address contains."
        ),
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(
            help="With --live, in virtual time: speed of the page relative to real time; 0: as fast as possible. "
            "Default: 1."
        ),
    ] = None,
    rounds: Annotated[int | None, typer.Option(help="With --live: number of runs. Default: until interrupted.")] = None,
    as_json: Json = False,
    verbose: Verbose = False,
) -> None:
    """Run the digital twin of a robot: rigid bodies, camera, image processing, and packets over UDP."""
    from taciturn.extend import find_style, number, save
    from taciturn.nodes.keys import read_keys
    from taciturn_twins.catalogue import find_robot
    from taciturn_twins.faults import parse_fault
    from taciturn_twins.record import check_record, check_video, write_record, write_video
    from taciturn_twins.run import run_twin
    from taciturn_twins.trial import Setup

    found = find_robot(robot)
    check_counts({"--runs": runs, "--rounds": rounds})
    number("--runs", runs, high=65535, closed=True)
    for option, value in (("--price", price), ("--theta", theta)):
        if value is not None:
            number(option, value, 0.0, closed=True)
    _check_options({"--bind": bind, "--token": token, "--speed": speed, "--rounds": rounds}, live, real_time)
    given = {"zeta" if robot == "rover" else "price": price, "theta": theta}
    parameters = {name: value for name, value in given.items() if value is not None}
    length, faults = tick_length(found.tick, real_time, tick), tuple(parse_fault(text) for text in fault or [])
    for wanted, check in ((record, check_record), (video, check_video)):
        if wanted is not None:
            check(wanted)
    setup = Setup(runs, seed, length, namespaces, faults, read_keys(key), wheels)

    def keep(run: TwinRun) -> None:
        if record is not None:
            write_record(run, record)
        if video is not None:
            write_video(run, video)
        if plot is not None:
            save(run.plot(style=find_style(style or "light").name), plot, run.origin())

    if live:
        page = (bind or "127.0.0.1:8000", token)
        done = _live(robot, setup, file, parameters, page=page, speed=speed, rounds=rounds, keep=keep)
    else:
        with progress_bar("driving") as progress:
            done = run_twin(
                robot, setup, file=file, functions=not no_functions, parameters=parameters, progress=progress
            )
    if as_json:
        print_json(done.document(), done.origin())
    else:
        typer.echo(done.text(verbose))
    if not live:
        keep(done)


def _check_options(options: Mapping[str, object], live: bool, real_time: bool) -> None:
    """Raise an error if options of the live page are given without --live, or a speed in real time."""
    from taciturn.errors import ProblemError

    given = [name for name, value in options.items() if value is not None]
    if given and not live:
        raise ProblemError(f"{given[0]} is given without --live; expected both options, or neither of them")
    if "--speed" in given and real_time:
        raise ProblemError("--speed is given with --real-time, which always runs at speed 1; expected one of them")


def _live(
    robot: str,
    setup: Setup,
    file: str | None,
    parameters: Mapping[str, float],
    *,
    page: tuple[str, str | None],
    speed: float | None,
    rounds: int | None,
    keep: Callable[[TwinRun], object],
) -> TwinRun:
    """Serve the live page of a twin until it is interrupted, keep each complete run, and return the last complete run.

    Raises:
        KeyboardInterrupt: the page was interrupted before a run was complete.
    """
    from taciturn.errors import ProblemError
    from taciturn.extend import number
    from taciturn_twins.catalogue import find_robot
    from taciturn_twins.live import watch_twin
    from taciturn_twins.page import Page
    from taciturn_twins.prepared import prepare
    from taciturn_twins.run import check_run
    from taciturn_udp.endpoint import parse_address

    if file is not None or setup.runs > 1:
        option = "a problem file" if file is not None else f"--runs {setup.runs}"
        raise ProblemError(
            f"{option} is given with --live, which runs only the experiment of the thesis, one run at a time; "
            "expected only one of the two options"
        )
    pace = 1.0 if speed is None else number("--speed", speed, 0.0, closed=True)
    check_run(find_robot(robot), setup, parameters)
    bind, token = page
    done: list[TwinRun] = []

    def complete(run: TwinRun) -> None:
        done[:] = [run]
        keep(run)

    try:
        with Page(parse_address("--bind", bind, own=True), token) as shown:
            typer.echo(f"taciturn: the page is at {shown.url}", err=True)
            shown.wait("calibrating the camera and identifying the model of the robot")
            prepared = prepare(robot, setup.seed)
            watch_twin(prepared, shown, setup, parameters=parameters, speed=pace, rounds=rounds, ended=complete)
    except KeyboardInterrupt:
        if not done:
            raise
    if not done:
        raise ProblemError(
            "no run has ended; expected at least one complete run: wait longer before you stop the command"
        )
    return done[0]


@app.command(epilog=EXAMPLE + "taciturn camera rover rover --peer :9001")
def camera(
    robot: Robot,
    file: File,
    peer: Annotated[str, typer.Option(metavar="HOST:PORT", help="Address to which the camera sends the pictures.")],
    bind: Bind = "127.0.0.1:0",
    no_functions: NoFunctions = False,
    fault: Faults = None,
    key: Key = None,
    loops: Loops = 1,
    seed: Seed = 0,
) -> None:
    """Render the pictures that a robot's sensor requests, and send them to a controller in another process."""
    import taciturn
    from taciturn.extend import until_stopped
    from taciturn.nodes.keys import read_keys
    from taciturn_twins.camera import Camera
    from taciturn_twins.catalogue import find_robot
    from taciturn_twins.faults import parse_fault
    from taciturn_twins.mission import check_mission
    from taciturn_twins.serve import CameraServer
    from taciturn_twins.wire import CameraWire
    from taciturn_udp.endpoint import Endpoint, parse_address
    from taciturn_udp.service import say_where

    check_counts({"--loops": loops})
    found, problem = find_robot(robot), taciturn.load(file, functions=not no_functions)
    here, to = parse_address("--bind", bind, own=True), parse_address("--peer", peer)
    faults = [parse_fault(text) for text in fault or []]
    secret = read_keys(key, (here[0], to[0]))
    wire = CameraWire(check_mission(found, problem, file), found.seen, problem.network, secret)
    taken = Camera(found, seed)
    with until_stopped() as stopped, Endpoint(here) as endpoint:
        server = CameraServer(taken, wire, endpoint, to, tick=found.tick, loops=loops, faults=faults)
        say_where("camera", endpoint.address)
        typer.echo(json.dumps(server.run(stopped)))
    taken.close()
