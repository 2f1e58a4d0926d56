"""Commands that run a policy as nodes over a network."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from taciturn import _print
from taciturn.cli.frame import File, Json, Seed, app, print_json, progress_bar
from taciturn.cli.links import read_burst, read_fates, read_outage, read_probability

if TYPE_CHECKING:
    from taciturn.model.network import Network
    from taciturn.model.policy import Policy
    from taciturn.runtime.packet import Wire
    from taciturn.runtime.serve import NodeServer

Bind = Annotated[str, typer.Option(metavar="HOST:PORT", help="Where to listen; port 0: any free one.")]
Peer = Annotated[str | None, typer.Option(metavar="HOST:PORT", help="Who gets the packets.")]
Ticks = Annotated[int | None, typer.Option(help="Ticks to run. Default: until interrupted.")]
RealTime = Annotated[bool, typer.Option("--real-time", help="Go by the clock instead of virtual time.")]
TickLength = Annotated[
    float | None, typer.Option("--tick", help="Real seconds per tick. Default: those of the problem.")
]
Key = Annotated[
    Path | None,
    typer.Option(metavar="PATH", help="Hexadecimal key of 16 to 32 bytes. Default: $TACITURN_KEY, or none."),
]
Log = Annotated[
    str | None,
    typer.Option(metavar="OUT", help="A JSON line per tick: to a file, - for standard output, or udp://HOST:PORT."),
]
Loops = Annotated[int, typer.Option(help="How many such loops this process serves.")]


WAIT = {"controller": 0.3, "actuator": 0.55}  # the actuator waits for what the controller sends at its own deadline


@app.command(epilog="Example: taciturn network two-mass --ticks 1000 --loss 0.2")
def network(
    file: File,
    ticks: Annotated[int | None, typer.Option(help="Default: the mission, or 5000.")] = None,
    real_time: RealTime = False,
    tick: TickLength = None,
    seed: Seed = 0,
    key: Key = None,
    loss: Annotated[
        list[str] | None,
        typer.Option("--loss", metavar="[LINK=]P", help="Lose a packet with probability P, on a link or on each."),
    ] = None,
    namespaces: Annotated[
        bool, typer.Option("--namespaces", help="In network namespaces, where the kernel loses packets; as root.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Run the nodes of a problem as processes on this machine, with a relay on each link or in network namespaces."""
    import taciturn
    from taciturn.runtime.packet import read_key
    from taciturn.study.network import run_network

    check_counts({"--ticks": ticks})
    problem = taciturn.load(file)
    policy = problem.design()
    length = tick_length(policy.model.dt, real_time, tick)
    if loss is not None and namespaces:
        raise taciturn.ProblemError("--loss is given with --namespaces, where no relay runs; expected one of them")
    fates = None if loss is None else read_fates(loss, policy, problem.network, seed)
    with progress_bar("running") as progress, ended_as_interrupted():
        found = run_network(
            file, ticks=ticks, tick=length, seed=seed, key=read_key(key), fates=fates, namespaces=namespaces,
            progress=progress,
        )  # fmt: skip
    if as_json:
        print_json(found.document())
    else:
        _print.network(found)


@app.command(epilog="Example: taciturn node controller two-mass --bind :9102 --peer :9103 --plant :9100")
def node(
    role: Annotated[str, typer.Argument(metavar="sensor|controller|actuator")],
    file: File,
    bind: Bind = "127.0.0.1:0",
    peer: Peer = None,
    plant: Annotated[str | None, typer.Option(metavar="HOST:PORT", help="Who measures and acts.")] = None,
    ticks: Ticks = None,
    real_time: RealTime = False,
    tick: TickLength = None,
    wait: Annotated[
        float | None,
        typer.Option(help="Share of a tick that a packet is waited for, in real time. Default: .3, actuator .55."),
    ] = None,
    heartbeat: Annotated[int | None, typer.Option(help="Ticks between marks. Default: one second.")] = None,
    watchdog: Annotated[int | None, typer.Option(help="Ticks of silence until the input is safe.")] = None,
    safe: Annotated[str, typer.Option(help="The safe input: hold, zero, or numbers as 0.5,-1.")] = "hold",
    state: Annotated[Path | None, typer.Option(metavar="PATH", help="Keeps the state after every tick.")] = None,
    key: Key = None,
    log: Log = None,
    loops: Loops = 1,
    seed: Seed = 0,
    questions: Annotated[
        bool, typer.Option("--questions", help="The sensor is a camera: ask it, where a measurement would be sent.")
    ] = False,
    eye: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="The calibration of a camera: read its pictures as measurements."),
    ] = None,
    seen: Annotated[
        str | None, typer.Option(metavar="OUT", help="With --eye: a JSON line per picture, as --log.")
    ] = None,
    watch: Annotated[
        Path | None, typer.Option(metavar="PATH", help="With --eye: keeps the newest picture, with what is seen in it.")
    ] = None,
) -> None:
    """Run one node of a problem: it meets its peers over UDP until it is interrupted, and prints what it counted."""
    import taciturn
    from taciturn._arrays import number
    from taciturn.runtime.node import Node
    from taciturn.runtime.packet import read_key
    from taciturn.runtime.serve import NodeServer
    from taciturn.runtime.service import logged, say, say_where, until_stopped
    from taciturn.runtime.udp import LARGEST, LARGEST_OF_ALL, Endpoint, parse_address

    check_counts({"--ticks": ticks, "--heartbeat": heartbeat, "--watchdog": watchdog, "--loops": loops})
    problem = taciturn.load(file)
    policy = problem.design()
    length = tick_length(policy.model.dt, real_time, tick)
    if state is not None and loops > 1:
        raise taciturn.ProblemError(f"--state is given with --loops {loops}; expected it with one loop")
    share = WAIT.get(role, 0.0) if wait is None else number("--wait", wait, 0.0, 1.0, closed=True)
    nodes = [
        Node(
            policy, cast("Any", role), network=problem.network, epoch=int(time.time()), seed=seed, loop=loop,
            watchdog=watchdog, safe=_safe(safe),
        )
        for loop in range(loops)
    ]  # fmt: skip
    to = None if peer is None else parse_address("--peer", peer)
    world = None if plant is None else parse_address("--plant", plant)
    largest = LARGEST if eye is None else LARGEST_OF_ALL
    with (
        _wire(role, policy, problem.network, read_key(key), questions, eye, seen, watch) as wire,
        logged(log) as told,
        until_stopped() as stopped,
        Endpoint(parse_address("--bind", bind), largest) as endpoint,
    ):
        server = NodeServer(
            nodes, wire, endpoint, peer=to, plant=world, tick=length, wait=share,
            heartbeat=heartbeat or max(1, round(1 / (length or 1.0))), keep=state, told=told, say=say,
        )  # fmt: skip
        say_where(role, server.endpoint.address)
        with _counters(server) as shown:
            server.run(ticks, lambda: shown() or stopped())
        typer.echo(json.dumps(server.finish(lambda: True if ticks else stopped())))


@app.command(epilog="Example: taciturn plant two-mass --bind :9100 --peer :9102 --ticks 200")
def plant(
    file: File,
    peer: Annotated[str, typer.Option(metavar="HOST:PORT", help="The node that measures.")],
    bind: Bind = "127.0.0.1:0",
    ticks: Annotated[int, typer.Option(help="Ticks to run.")] = 1000,
    real_time: RealTime = False,
    tick: TickLength = None,
    key: Key = None,
    log: Log = None,
    loops: Loops = 1,
    seed: Seed = 0,
) -> None:
    """Simulate the plant of a problem for nodes that run elsewhere."""
    import taciturn
    from taciturn.runtime.packet import Wire, read_key
    from taciturn.runtime.plant import SimulatedPlant
    from taciturn.runtime.service import logged, say, say_where, until_stopped
    from taciturn.runtime.udp import Endpoint, parse_address
    from taciturn.runtime.world import PlantServer
    from taciturn.study.ticks import plant_cost

    check_counts({"--ticks": ticks, "--loops": loops})
    problem = taciturn.load(file)
    loop = problem.close(problem.design())
    length = tick_length(loop.policy.model.dt, real_time, tick)
    plants = [SimulatedPlant(loop, seed + i) for i in range(loops)]
    wire = Wire(loop.policy, problem.network, read_key(key))
    with logged(log) as told, until_stopped() as stopped, Endpoint(parse_address("--bind", bind)) as endpoint:
        server = PlantServer(plants, wire, endpoint, parse_address("--peer", peer), tick=length, told=told, say=say)
        say_where("plant", endpoint.address)
        report = server.run(loop.ticks(ticks), stopped)
        final = sum(one.final_cost() for one in plants) / loops
        typer.echo(json.dumps(report | plant_cost(problem, loop, server.costs, final)))


@app.command(epilog="Example: taciturn relay --bind :9012 --peer :9002 --loss 0.6")
def relay(
    peer: Annotated[str, typer.Option(metavar="HOST:PORT", help="Where the link ends.")],
    bind: Bind = "127.0.0.1:0",
    loss: Annotated[str, typer.Option(metavar="P", help="Probability that a packet is lost.")] = "0",
    burst: Annotated[
        str | None, typer.Option(metavar="TO_BAD,TO_GOOD,LOSS_GOOD,LOSS_BAD", help="Losses in bursts instead.")
    ] = None,
    delay: Annotated[float, typer.Option(help="Seconds that every packet takes.")] = 0.0,
    jitter: Annotated[float, typer.Option(help="Up to so many seconds more.")] = 0.0,
    hold: Annotated[int, typer.Option(help="Ticks that every packet waits, in virtual time.")] = 0,
    duplicate: Annotated[str, typer.Option(metavar="P", help="Probability that a packet comes twice.")] = "0",
    reorder: Annotated[str, typer.Option(metavar="P", help="Probability that a packet comes after the next.")] = "0",
    corrupt: Annotated[str, typer.Option(metavar="P", help="Probability that bits of a packet are turned.")] = "0",
    outage: Annotated[
        str | None, typer.Option(metavar="FIRST,END", help="Ticks in which every packet is lost.")
    ] = None,
    seed: Seed = 0,
) -> None:
    """Carry packets over a link that loses, delays, doubles, reorders or corrupts them, alike for the same seed."""
    from taciturn.runtime.relay import EmulatedLink, Fate
    from taciturn.runtime.service import say_where, until_stopped
    from taciturn.runtime.udp import LARGEST_OF_ALL, Endpoint, parse_address
    from taciturn.runtime.world import relay as carry

    chances = {"loss": loss, "duplicate": duplicate, "reorder": reorder, "corrupt": corrupt}
    fate = Fate(
        seed, burst=read_burst(burst), delay=delay, jitter=jitter, hold=hold, outage=read_outage(outage),
        **{name: read_probability(f"--{name}", text) for name, text in chances.items()},
    )  # fmt: skip
    to = parse_address("--peer", peer)
    with until_stopped() as stopped, Endpoint(parse_address("--bind", bind), LARGEST_OF_ALL) as endpoint:
        say_where("relay", endpoint.address)
        typer.echo(json.dumps(carry(EmulatedLink(fate), endpoint, to, stopped)))


@contextmanager
def _wire(
    role: str,
    policy: Policy,
    network: Network,
    key: bytes | None,
    questions: bool,
    eye: Path | None,
    seen: str | None,
    watch: Path | None,
) -> Generator[Wire]:
    """Give what writes and reads the packets of a node; where the sensor is a camera, questions and pictures too."""
    from taciturn.errors import ProblemError
    from taciturn.runtime.packet import Wire

    if (questions and role != "sensor") or (eye is not None and role != "controller"):
        option, where = ("--questions", "sensor") if questions else ("--eye", "controller")
        raise ProblemError(f"{option} is given for the {role}; expected it for the {where}")
    if eye is None and (seen is not None or watch is not None):
        raise ProblemError("--seen or --watch is given without --eye; expected it with the calibration of a camera")
    if questions:
        from taciturn.twin.wire import QuestionWire

        yield QuestionWire(policy, network, key)
    elif eye is not None:
        from taciturn.twin.control import picture_wire, read_eye

        with picture_wire(policy, network, key, read_eye(eye), seen=seen, watch=watch) as wire:
            yield wire
    else:
        yield Wire(policy, network, key)


def check_counts(counts: Mapping[str, int | None]) -> None:
    """Refuse options that count something and are not at least 1, or more loops than a packet can tell."""
    from taciturn._arrays import count, number

    for name, value in counts.items():
        if value is not None:
            count(name, value)
    number("--loops", counts.get("--loops") or 1, high=65535, closed=True)


def tick_length(of_problem: float | None, real_time: bool, asked: float | None) -> float | None:
    """Return the real seconds of a tick; None in virtual time."""
    from taciturn._arrays import number
    from taciturn.errors import ProblemError

    if asked is not None and not real_time:
        raise ProblemError("--tick is given without --real-time; expected both, or neither")
    if not real_time:
        return None
    return of_problem or 1.0 if asked is None else number("--tick", asked, 1e-4, 3600.0, closed=True)


def _safe(text: str) -> Any:
    from taciturn.errors import ProblemError

    if text in ("hold", "zero"):
        return text
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ProblemError(f"--safe is {text!r}; expected hold, zero, or numbers as 0.5,-1") from None


@contextmanager
def ended_as_interrupted() -> Generator[None]:
    """Let what asks a process to end do what Ctrl-C does, so that no process, namespace or folder is left behind."""
    from taciturn.runtime.service import ENDING

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in ENDING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _counters(server: NodeServer) -> Generator[Callable[[], bool]]:
    """Show the counters of a node on a terminal, twice a second, each time that what is given is called."""
    if not sys.stderr.isatty():
        yield lambda: False
        return
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    def line() -> Text:
        report = server.report()
        counted = ", ".join(f"{count} {name}" for name, count in sorted(report["counters"].items()))
        degraded = " · DEGRADED" if any(node.degraded for node in server.nodes) else ""
        refused = sum(report["refused"].values())
        return Text(f"tick {report['tick']} · {counted or 'nothing yet'} · {refused} refused{degraded}")

    with Live(line(), console=Console(stderr=True), transient=True, auto_refresh=False) as live:
        next_at = time.monotonic()

        def show() -> bool:
            nonlocal next_at
            if time.monotonic() >= next_at:
                next_at = time.monotonic() + 0.5
                live.update(line(), refresh=True)
            return False

        yield show
