"""Commands that run the twin of a robot, and its camera."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from taciturn.cli.frame import File, Json, Plot, Seed, app, print_json, progress_bar
from taciturn.cli.network import Bind, Key, Loops, RealTime, TickLength, check_counts, ended_as_interrupted, tick_length

if TYPE_CHECKING:
    from collections.abc import Mapping

    from taciturn.twin.run import TwinRun
    from taciturn.twin.trial import Setup

Robot = Annotated[str, typer.Argument(metavar="rover|omni", help="Which robot.")]
Faults = Annotated[
    list[str] | None,
    typer.Option(
        "--fault",
        metavar="NAME@START+SECONDS=SIZE",
        help="What goes wrong, and when: camera, cover, light, actuator, kidnap, push, gain, controller.",
    ),
]


@app.command(epilog="Example: taciturn twin rover --seed 1")
def twin(
    robot: Robot,
    file: Annotated[
        str | None,
        typer.Argument(metavar="[FILE]", help="Its policy is run. Default: the thesis's, for a model identified here."),
    ] = None,
    seed: Seed = 0,
    runs: Annotated[int, typer.Option(help="Missions to run at once, with seeds one after the other.")] = 1,
    price: Annotated[float | None, typer.Option(help="Of a send of the omni, of a question of the rover.")] = None,
    theta: Annotated[float | None, typer.Option(help="Of the rover's policy.")] = None,
    real_time: RealTime = False,
    tick: TickLength = None,
    namespaces: Annotated[
        bool, typer.Option("--namespaces", help="In network namespaces, where the kernel loses packets; as root.")
    ] = False,
    fault: Faults = None,
    wheels: Annotated[str | None, typer.Option(help="capsule or, of the omni, rollers: how they are modelled.")] = None,
    key: Key = None,
    record: Annotated[Path | None, typer.Option(metavar="OUT.nc", help="All that happened, as NetCDF.")] = None,
    video: Annotated[Path | None, typer.Option(metavar="OUT.webp", help="What the camera sees of the first.")] = None,
    plot: Plot = None,
    live: Annotated[bool, typer.Option("--live", help="Serve a page to watch, round after round.")] = False,
    bind: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="With --live: where the page is. Default: 127.0.0.1:8000.")
    ] = None,
    token: Annotated[
        str | None, typer.Option(help="With --live: what others must know; needed where they can reach the page.")
    ] = None,
    speed: Annotated[
        float | None, typer.Option(help="With --live, in virtual time: how fast; 0: as fast as may be. Default: 1.")
    ] = None,
    rounds: Annotated[int | None, typer.Option(help="With --live: how many. Default: until interrupted.")] = None,
    as_json: Json = False,
) -> None:
    """Run a robot's twin: rigid bodies, a camera that is asked, image processing, and packets between processes."""
    from taciturn import _print
    from taciturn._arrays import number
    from taciturn._figure import check_format, save
    from taciturn.runtime.packet import read_key
    from taciturn.twin.catalogue import find_robot
    from taciturn.twin.faults import parse_fault
    from taciturn.twin.record import check_record, check_video, write_record, write_video
    from taciturn.twin.report import lines_of
    from taciturn.twin.run import run_twin
    from taciturn.twin.trial import Setup

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
    for wanted, check in ((plot, check_format), (record, check_record), (video, check_video)):
        if wanted is not None:
            check(wanted)
    setup = Setup(runs, seed, length, namespaces, faults, read_key(key), wheels)
    if live:
        done = _live(robot, setup, file, parameters, page=(bind or "127.0.0.1:8000", token), speed=speed, rounds=rounds)
    else:
        with progress_bar("driving") as progress, ended_as_interrupted():
            done = run_twin(robot, setup, file=file, parameters=parameters, progress=progress)
    if as_json:
        print_json(done.document())
    else:
        _print.pairs(lines_of(done))
    if record is not None:
        write_record(done, record)
    if video is not None:
        write_video(done, video)
    if plot is not None:
        save(done.plot(), plot)


def _check_options(options: Mapping[str, object], live: bool, real_time: bool) -> None:
    """Refuse options of the page where there is none, and a pace where the clock sets it."""
    from taciturn.errors import ProblemError

    given = [name for name, value in options.items() if value is not None]
    if given and not live:
        raise ProblemError(f"{given[0]} is given without --live; expected both, or neither")
    if "--speed" in given and real_time:
        raise ProblemError("--speed is given with --real-time, which goes by the clock; expected one of them")


def _live(
    robot: str,
    setup: Setup,
    file: str | None,
    parameters: Mapping[str, float],
    *,
    page: tuple[str, str | None],
    speed: float | None,
    rounds: int | None,
) -> TwinRun:
    """Serve the page of a twin until it is interrupted, and return the last mission that was whole."""
    from taciturn._arrays import number
    from taciturn.errors import ProblemError
    from taciturn.runtime.service import until_stopped
    from taciturn.runtime.udp import parse_address
    from taciturn.twin.catalogue import find_robot
    from taciturn.twin.live import watch_twin
    from taciturn.twin.page import Page
    from taciturn.twin.prepared import prepare
    from taciturn.twin.run import check_run

    if file is not None or setup.runs > 1:
        option = "a problem file" if file is not None else f"--runs {setup.runs}"
        raise ProblemError(f"{option} is given with --live, which runs the thesis's mission; expected neither of them")
    pace = 1.0 if speed is None else number("--speed", speed, 0.0, closed=True)
    check_run(find_robot(robot), setup, parameters)
    bind, token = page
    with Page(parse_address("--bind", bind), token) as shown, until_stopped() as stopped:
        typer.echo(f"taciturn: the page is {shown.url}", err=True)
        found = watch_twin(
            prepare(robot, setup.seed), shown, setup, parameters=parameters, speed=pace, rounds=rounds, stopped=stopped
        )
    if found is None:
        raise ProblemError("no mission has come to its end; expected at least one: let it run for longer")
    return found


@app.command(epilog="Example: taciturn camera rover rover --peer :9001")
def camera(
    robot: Robot,
    file: File,
    peer: Annotated[str, typer.Option(metavar="HOST:PORT", help="Who gets the pictures.")],
    bind: Bind = "127.0.0.1:0",
    fault: Faults = None,
    key: Key = None,
    loops: Loops = 1,
    seed: Seed = 0,
) -> None:
    """Render what a robot's camera sees, when it is asked, for a control unit that runs elsewhere."""
    import taciturn
    from taciturn.runtime.packet import read_key
    from taciturn.runtime.service import say_where, until_stopped
    from taciturn.runtime.udp import Endpoint, parse_address
    from taciturn.twin.camera import Camera
    from taciturn.twin.catalogue import find_robot
    from taciturn.twin.faults import parse_fault
    from taciturn.twin.mission import check_mission
    from taciturn.twin.serve import CameraServer
    from taciturn.twin.wire import CameraWire

    check_counts({"--loops": loops})
    found, problem = find_robot(robot), taciturn.load(file)
    wire = CameraWire(check_mission(found, problem, file), found.seen, problem.network, read_key(key))
    to, faults = parse_address("--peer", peer), [parse_fault(text) for text in fault or []]
    taken = Camera(found, seed)
    with until_stopped() as stopped, Endpoint(parse_address("--bind", bind)) as endpoint:
        server = CameraServer(taken, wire, endpoint, to, tick=found.tick, loops=loops, faults=faults)
        say_where("camera", endpoint.address)
        typer.echo(json.dumps(server.run(stopped)))
    taken.close()
