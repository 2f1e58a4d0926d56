"""Commands that run a policy as nodes over a network, with the help texts of their options."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from taciturn.cli.frame import (
    EXAMPLE,
    File,
    Json,
    Loads,
    NoFunctions,
    Seed,
    Settings,
    Verbose,
    app,
    load_changed,
    print_result,
    progress_bar,
)

if TYPE_CHECKING:
    from taciturn.model.losses import LossLaw
    from taciturn.model.network import Network
    from taciturn.model.policy import Policy
    from taciturn.nodes.keys import Keys
    from taciturn.nodes.packet import Wire
    from taciturn_udp.nodes import NodeServer
    from taciturn_udp.relay import Fate


def read_probability(name: str, text: str) -> float:
    """Convert the value of a command-line option to a probability."""
    from taciturn.errors import ProblemError
    from taciturn.extend import number

    try:
        found = float(text)
    except ValueError:
        raise ProblemError(f"{name} is {text!r}; expected a number from 0 to 1, such as 0.2") from None
    return number(name, found, 0.0, 1.0, closed=True)


def read_fates(
    given: Sequence[str], policy: Policy, network: Network, seed: int, tick: float | None = None
) -> dict[str, Fate]:
    """Return the impairments of each link; ``--loss`` replaces the losses of the problem's network.

    In real time, ``tick`` is the duration of a step.
    """
    from taciturn.errors import ProblemError
    from taciturn.model.steps import Send
    from taciturn_udp.relay import losses

    stated = losses(network, seed, period=policy.tick, tick=tick)
    fates: dict[str, Fate] = {step.link: stated[step.link] for step in policy.steps if isinstance(step, Send)}
    seen: set[str] = set()
    for text in given:
        link, named, chance = text.rpartition("=")
        if link in seen:
            raise ProblemError(f"--loss is given twice for {link or 'all links'}; expected one value for each link")
        seen.add(link)
        if named and link not in fates:
            raise ProblemError(
                f"--loss names the link {link!r}; expected one of the links of the policy {policy.kind}: "
                f"{', '.join(fates)}"
            )
        for one, fate in fates.items():
            if not named or one == link:
                fates[one] = replace(fate, loss=read_probability("--loss", chance), burst=None)
    return fates


def read_burst(text: str | None) -> LossLaw | None:
    """Convert the option ``--burst`` to a model of bursty packet losses; return None if the option is not given."""
    from taciturn.model.losses import read_law

    return None if text is None else read_law("--burst", text)


def read_outage(text: str | None) -> tuple[int, int] | None:
    """Return the first step of the outage in ``--outage`` and the first step after it; None if it is not given."""
    from taciturn.cli.usage import whole_number
    from taciturn.errors import ProblemError

    if text is None:
        return None
    try:
        first, end = (int(whole_number(part)) for part in text.split(","))
    except ValueError:
        raise ProblemError(f"--outage is {text!r}; expected two steps, such as 20,40") from None
    return first, end


def check_counts(counts: Mapping[str, int | None]) -> None:
    """Raise an error if a count is below 1, or if there are more loops than the field of a packet can number."""
    from taciturn.extend import count, number

    for name, value in counts.items():
        if value is not None:
            count(name, value)
    number("--loops", counts.get("--loops") or 1, high=65535, closed=True)


def tick_length(of_problem: float | None, real_time: bool, asked: float | None) -> float | None:
    """Return the sampling period in seconds for a run in real time; None for a run in virtual time."""
    from taciturn.errors import ProblemError
    from taciturn.extend import number

    if asked is not None and not real_time:
        raise ProblemError("--tick is given without --real-time; expected both options, or neither of them")
    if not real_time:
        return None
    return of_problem or 1.0 if asked is None else number("--tick", asked, 1e-4, 3600.0, closed=True)


Bind = Annotated[str, typer.Option(metavar="HOST:PORT", help="Address to listen on; port 0 selects a free port.")]
Peer = Annotated[
    list[str] | None,
    typer.Option(
        metavar="[LINK=]HOST:PORT",
        help="Address to which the node sends its packets. LINK= selects the link if the node sends on several links.",
    ),
]
NodeSteps = Annotated[int | None, typer.Option(help="Number of steps. Default: until interrupted.")]
RealTime = Annotated[bool, typer.Option("--real-time", help="Run in real time instead of virtual time.")]
TickLength = Annotated[
    float | None,
    typer.Option(
        "--tick", help="Duration of a step in real time, in seconds. Default: the sampling period of the problem."
    ),
]
Key = Annotated[
    Path | None,
    typer.Option(
        metavar="PATH",
        help="File with the keys of the packets, each 16 to 32 bytes in hexadecimal digits: one line KEY for "
        "all links, or a line LINK: KEY for each link. The process reads the file again when it changes. Default: "
        "the key in $TACITURN_KEY, or no key.",
    ),
]
Log = Annotated[
    str | None,
    typer.Option(
        metavar="OUT",
        help="For each step, write a JSON line to a file, to standard output (-), or to udp://HOST:PORT.",
    ),
]
Loops = Annotated[int, typer.Option(help="Number of identical loops that this process runs.")]
WIRES = "taciturn.wires"  # entry points of encoders and decoders
WATCHED = 100  # steps without a usable packet after which a node in real time is degraded by default
BEATS = 3  # marks that a silent sender sends within this limit


@app.command(epilog=EXAMPLE + "taciturn network two-mass --steps 1000 --loss 0.2")
def network(
    file: File,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    steps: Annotated[
        int | None,
        typer.Option(help="Number of steps. Default: the horizon of the cost; if the cost has no horizon, 5000."),
    ] = None,
    real_time: RealTime = False,
    tick: TickLength = None,
    seed: Seed = 0,
    key: Key = None,
    loss: Annotated[
        list[str] | None,
        typer.Option(
            "--loss", metavar="[LINK=]P", help="Drop each packet with probability P, on one link or on all links."
        ),
    ] = None,
    namespaces: Annotated[
        bool,
        typer.Option(
            "--namespaces",
            help="Run each node in its own network namespace, in which the Linux kernel drops the packets. "
            "Requires root.",
        ),
    ] = False,
    world: Annotated[
        int | None,
        typer.Option(
            "--world",
            metavar="SEED",
            help="Instead of processes, run a world of faults: a test of the nodes under random faults that this "
            "seed selects.",
        ),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Record all packets and signals of the run in FOLDER/packets.csv and FOLDER/signals.csv.",
        ),
    ] = None,
    loads: Loads = None,
    as_json: Json = False,
    verbose: Verbose = False,
) -> None:
    """Run the nodes of a problem as processes on this machine, connected over UDP."""
    import taciturn
    from taciturn.nodes.keys import read_keys
    from taciturn_udp.run import run_network

    check_counts({"--steps": steps})
    problem = load_changed(file, settings, no_functions)
    if world is not None:
        others = {"--steps": steps, "--real-time": real_time, "--tick": tick, "--loss": loss}
        others |= {"--namespaces": namespaces, "--seed": seed, "--key": key, "--load": loads, "--record": record}
        from taciturn.extend import load_plugin

        run_world = load_plugin("taciturn.worlds", "faults", "--world")
        run_world(problem, world, [name for name, value in others.items() if value], as_json, verbose)
        return
    policy = problem.design()
    length = tick_length(policy.model.dt, real_time, tick)
    if loss is not None and namespaces:
        raise taciturn.ProblemError(
            "--loss is given with --namespaces, but only relays apply --loss, and namespaces have no relays; expected "
            "only one of the two options"
        )
    fates = None if loss is None else read_fates(loss, policy, problem.network, seed, length)
    with progress_bar("running") as progress:
        found = run_network(
            file, settings=settings or (), steps=steps, tick=length, seed=seed, key=read_keys(key), fates=fates,
            namespaces=namespaces, progress=progress, functions=not no_functions, loads=loads or (), record=record,
        )  # fmt: skip
    print_result(found, as_json, verbose, problem)


@app.command(epilog=EXAMPLE + "taciturn node controller two-mass --bind :9102 --peer :9103 --plant :9100")
def node(
    role: Annotated[
        str,
        typer.Argument(
            metavar="NODE", help="Name of the node: sensor, controller, actuator, or a name in [nodes] of the file."
        ),
    ],
    file: File,
    settings: Settings = None,
    no_functions: NoFunctions = False,
    bind: Bind = "127.0.0.1:0",
    peer: Peer = None,
    plant: Annotated[str | None, typer.Option(metavar="HOST:PORT", help="Address of the plant.")] = None,
    steps: NodeSteps = None,
    real_time: RealTime = False,
    tick: TickLength = None,
    wait: Annotated[
        float | None,
        typer.Option(
            help="In real time: longest time that the node waits for a packet, as a fraction of a step. Default: "
            "0.3 for the controller, 0.55 for other nodes."
        ),
    ] = None,
    heartbeat: Annotated[
        int | None,
        typer.Option(
            help="In real time: send a mark (a packet without data) when the node has sent no packet on a link for "
            "this number of steps. Default: a third of --watchdog."
        ),
    ] = None,
    watchdog: Annotated[
        int | None,
        typer.Option(
            help="Number of steps without a packet or mark after which the node is degraded, and an actuator "
            f"applies the safe input. Default in real time: {WATCHED}; with neither --watchdog nor --safe, a "
            "degraded actuator continues to apply the policy's input."
        ),
    ] = None,
    safe: Annotated[
        str | None,
        typer.Option(
            help="Input that an actuator applies when its watchdog has expired: hold (default with --watchdog), "
            "zero, or numbers such as 0.5,-1."
        ),
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="After every step, save the state of the node to this file, from which a restarted node continues.",
        ),
    ] = None,
    key: Key = None,
    log: Log = None,
    log_part: Annotated[
        int | None,
        typer.Option(
            metavar="BYTES",
            help="With --log OUT: when the log reaches this size and no OUT.1 exists, rename it to OUT.1.",
        ),
    ] = None,
    loops: Loops = 1,
    seed: Seed = 0,
    questions: Annotated[
        bool,
        typer.Option(
            "--questions", help="Only if the sensor is a camera: request pictures instead of sending measurements."
        ),
    ] = False,
    play_out: Annotated[
        bool,
        typer.Option(
            "--play-out",
            help="With --real-time: use each packet the buffer of its link after it was sent, as a real plant "
            "requires. A simulated plant shows the delay itself.",
        ),
    ] = False,
    eye: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="Calibration file of the camera, with which the node measures positions in the pictures that it "
            "receives.",
        ),
    ] = None,
    seen: Annotated[
        str | None,
        typer.Option(
            metavar="OUT",
            help="With --eye: for each picture, write a JSON line to a file, to standard output (-), or to "
            "udp://HOST:PORT.",
        ),
    ] = None,
    watch: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH", help="With --eye: save the newest picture, with the detected markers, to this file."
        ),
    ] = None,
) -> None:
    """Run one node of a problem over UDP until it is interrupted, then print its counters."""
    import taciturn
    from taciturn.extend import number, until_stopped
    from taciturn.model.packets import links_to
    from taciturn.nodes.keys import read_keys
    from taciturn.nodes.node import Node
    from taciturn_udp.endpoint import LARGEST, LARGEST_OF_ALL, Endpoint, hosts_of, parse_address, parse_peers
    from taciturn_udp.logs import logged
    from taciturn_udp.nodes import NodeServer
    from taciturn_udp.service import FileStorage, say, say_where, usual_wait

    check_counts(
        {"--steps": steps, "--heartbeat": heartbeat, "--watchdog": watchdog, "--log-part": log_part, "--loops": loops}
    )
    problem = load_changed(file, settings, no_functions)
    policy = problem.design()
    length = tick_length(policy.model.dt, real_time, tick)
    if heartbeat is not None and length is None:
        raise taciturn.ProblemError(
            "--heartbeat is given without --real-time, but in virtual time a node sends a mark (a packet without "
            "data) after every step; "
            "expected --real-time"
        )
    if state is not None and loops > 1:
        raise taciturn.ProblemError(f"--state is given with --loops {loops}; expected one loop: --loops 1")
    share = usual_wait(policy, role) if wait is None else number("--wait", wait, 0.0, 1.0, closed=True)
    # in real time, the watchdog of a node that only sends sets its heartbeat
    limit = watchdog or (None if length is None else WATCHED)
    nodes = [
        Node(
            policy, cast("Any", role), network=problem.network, epoch=int(time.time()), seed=seed, loop=loop,
            watchdog=None if length is not None and not links_to(policy, cast("Any", role)) else limit,
            safe=None if watchdog is None and safe is None else _safe(safe or "hold"),
        )
        for loop in range(loops)
    ]  # fmt: skip
    here = parse_address("--bind", bind, own=True)
    to = parse_peers("--peer", peer)
    world = None if plant is None else parse_address("--plant", plant)
    secret = read_keys(key, hosts_of(here, to, world))
    largest = LARGEST if eye is None else LARGEST_OF_ALL
    with (
        _wire(role, policy, problem.network, secret, questions, eye, seen, watch) as wire,
        logged(log, log_part) as told,
        until_stopped() as stopped,
        Endpoint(here, largest) as endpoint,
    ):
        server = NodeServer(
            nodes, wire, endpoint, peer=to, plant=world, tick=length, wait=share,
            heartbeat=heartbeat or max(1, (limit or 1) // BEATS),
            keep=None if state is None else FileStorage(state), told=told, say=say, play_out=play_out,
        )  # fmt: skip
        say_where(role, server.endpoint.address)
        with _counters(server) as shown:
            server.run(steps, lambda: shown() or stopped())
        typer.echo(json.dumps(server.finish(lambda: True if steps else stopped())))


@app.command(epilog=EXAMPLE + "taciturn plant two-mass --bind :9100 --peer :9102 --steps 200")
def plant(
    file: File,
    peer: Annotated[
        list[str],
        typer.Option(
            metavar="[LINK=]HOST:PORT",
            help="Address of a node to which the plant sends measurements. LINK is plant/NODE.",
        ),
    ],
    settings: Settings = None,
    no_functions: NoFunctions = False,
    bind: Bind = "127.0.0.1:0",
    steps: Annotated[int, typer.Option(help="Number of steps.")] = 1000,
    real_time: RealTime = False,
    tick: TickLength = None,
    key: Key = None,
    log: Log = None,
    loops: Loops = 1,
    seed: Seed = 0,
    loads: Loads = None,
) -> None:
    """Simulate the plant of a problem for nodes that run as other processes."""
    from taciturn.extend import until_stopped
    from taciturn.nodes.keys import read_keys
    from taciturn.nodes.packet import Wire
    from taciturn.nodes.simulated_plant import SimulatedPlant
    from taciturn_udp.averages import plant_cost
    from taciturn_udp.endpoint import Endpoint, hosts_of, parse_address, parse_peers
    from taciturn_udp.logs import logged
    from taciturn_udp.plant import PlantServer
    from taciturn_udp.service import say, say_where

    check_counts({"--steps": steps, "--loops": loops})
    problem = load_changed(file, settings, no_functions, loads)
    loop = problem.close(problem.design())
    length = tick_length(loop.policy.model.dt, real_time, tick)
    plants = [SimulatedPlant(loop, seed + i) for i in range(loops)]
    here, to = parse_address("--bind", bind, own=True), parse_peers("--peer", peer)
    wire = Wire(loop.policy, problem.network, read_keys(key, hosts_of(here, to)))
    with logged(log) as told, until_stopped() as stopped, Endpoint(here) as endpoint:
        server = PlantServer(plants, wire, endpoint, to, tick=length, told=told, say=say)
        say_where("plant", endpoint.address)
        report = server.run(loop.checked_steps(steps), stopped)
        final = sum(one.final_cost() for one in plants) / loops
        typer.echo(json.dumps(report | plant_cost(problem, loop, server.costs, final)))


@app.command(epilog=EXAMPLE + "taciturn setpoint :9102 --value 1.5")
def setpoint(
    address: Annotated[str, typer.Argument(metavar="HOST:PORT", help="Address of the running controller.")],
    value: Annotated[
        str | None,
        typer.Option(
            metavar="R[,…]",
            help="Set-points, one number for each. Default: read them from lines of the standard input.",
        ),
    ] = None,
    manual: Annotated[
        str | None,
        typer.Option(
            metavar="U[,…]",
            help="Inputs of the plant in place of those of the controller, one number for each, until --automatic.",
        ),
    ] = None,
    automatic: Annotated[bool, typer.Option("--automatic", help="Return from manual to automatic operation.")] = False,
    key: Key = None,
    epoch: Annotated[
        int | None,
        typer.Option(help="Epoch of the set-points, which increases with each call. Default: the system time."),
    ] = None,
    wait: Annotated[float, typer.Option(help="Longest time to wait for the controller, in seconds.")] = 10.0,
    as_json: Json = False,
) -> None:
    """Give a running controller set-points or manual inputs, and print what is in effect.

    Without an option, lines of the standard input are set-points, "manual U[,…]" or "automatic".
    """
    from taciturn.errors import ProblemError
    from taciturn.extend import count, number
    from taciturn.nodes.keys import read_keys
    from taciturn_udp.endpoint import Endpoint, hosts_of, parse_address
    from taciturn_udp.operator import InEffect, Operator
    from taciturn_udp.service import say

    to = parse_address("HOST:PORT", address)
    secret = read_keys(key, hosts_of(to))
    given = None if value is None else _numbers("--value", value)
    by_hand = None if manual is None else _numbers("--manual", manual)
    if (value is not None) + (manual is not None) + automatic > 1:
        raise ProblemError("several of --value, --manual and --automatic are given; expected one of them, or none")
    if epoch is not None:
        number("--epoch", count("--epoch", epoch), high=0xFFFFFFFF, closed=True)

    def show(found: InEffect) -> None:
        typer.echo(json.dumps(found._asdict()) if as_json else found.sentence())

    with Endpoint(("0.0.0.0", 0)) as endpoint:
        operator = Operator(endpoint, to, secret, epoch, number("--wait", wait, 0.0, 86400.0, closed=True))
        if by_hand is not None or automatic:
            show(operator.operate(by_hand))
            return
        show(operator.ask() if given is None else operator.give(given))
        for line in sys.stdin if given is None else ():
            if line.strip():
                word, _, rest = line.strip().partition(" ")
                try:
                    if word == "automatic":
                        show(operator.operate(None))
                    elif word == "manual":
                        show(operator.operate(_numbers("the line", rest)))
                    else:
                        show(operator.give(_numbers("the line", line)))
                except ProblemError as error:
                    say(str(error))


@app.command(epilog=EXAMPLE + "taciturn relay --bind :9012 --peer :9002 --loss 0.6")
def relay(
    peer: Annotated[str, typer.Option(metavar="HOST:PORT", help="Address to which the relay forwards packets.")],
    bind: Bind = "127.0.0.1:0",
    loss: Annotated[str, typer.Option(metavar="P", help="Probability that a packet is dropped.")] = "0",
    burst: Annotated[
        str | None,
        typer.Option(
            metavar="TO_BAD,TO_GOOD,LOSS_GOOD,LOSS_BAD",
            help="Drop packets in bursts, by the Gilbert-Elliott model. LAW:VALUES selects another loss model.",
        ),
    ] = None,
    delay: Annotated[float, typer.Option(help="Delay of every packet in seconds.")] = 0.0,
    jitter: Annotated[float, typer.Option(help="Largest additional random delay in seconds.")] = 0.0,
    hold: Annotated[int, typer.Option(help="In virtual time: delay of every packet in steps.")] = 0,
    late: Annotated[
        str | None,
        typer.Option(
            metavar="LAW",
            help="Law of random delays as JSON, such as "
            '`{"delays": [0, 1], "odds": [[0.8, 0.2]]}`, in pieces of a period ("pieces"), for virtual time. With '
            '"pieces": 0, delays are in seconds, for real time.',
        ),
    ] = None,
    duplicate: Annotated[str, typer.Option(metavar="P", help="Probability that a packet arrives twice.")] = "0",
    reorder: Annotated[
        str, typer.Option(metavar="P", help="Probability that a packet arrives after the next packet.")
    ] = "0",
    corrupt: Annotated[str, typer.Option(metavar="P", help="Probability that bits of a packet are flipped.")] = "0",
    outage: Annotated[
        str | None,
        typer.Option(metavar="FIRST,END", help="Drop every packet in the steps from FIRST to END - 1."),
    ] = None,
    seed: Seed = 0,
) -> None:
    """Emulate a link that drops, delays, duplicates, reorders or corrupts packets, reproducibly for a given seed."""
    from taciturn.extend import until_stopped
    from taciturn_udp.endpoint import LARGEST_OF_ALL, Endpoint, parse_address
    from taciturn_udp.late import read_lateness
    from taciturn_udp.relay import EmulatedLink, Fate
    from taciturn_udp.relay import relay as carry
    from taciturn_udp.service import say_where

    chances = {"loss": loss, "duplicate": duplicate, "reorder": reorder, "corrupt": corrupt}
    fate = Fate(
        seed, burst=read_burst(burst), delay=delay, jitter=jitter, hold=hold, outage=read_outage(outage),
        late=read_lateness("--late", late),
        **{name: read_probability(f"--{name}", text) for name, text in chances.items()},
    )  # fmt: skip
    to = parse_address("--peer", peer)
    with until_stopped() as stopped, Endpoint(parse_address("--bind", bind, own=True), LARGEST_OF_ALL) as endpoint:
        say_where("relay", endpoint.address)
        typer.echo(json.dumps(carry(EmulatedLink(fate), endpoint, to, stopped)))


@contextmanager
def _wire(
    role: str,
    policy: Policy,
    network: Network,
    key: bytes | Keys | None,
    questions: bool,
    eye: Path | None,
    seen: str | None,
    watch: Path | None,
) -> Generator[Wire]:
    """Yield the wire format of a node; if the sensor is a camera, the format includes requests and pictures."""
    from taciturn.errors import ProblemError
    from taciturn.extend import load_plugin
    from taciturn.nodes.packet import Wire

    if (questions and role != "sensor") or (eye is not None and role != "controller"):
        option, where = ("--questions", "sensor") if questions else ("--eye", "controller")
        raise ProblemError(f"the option {option} is given for the {role}; expected this option for the {where} only")
    if eye is None and (seen is not None or watch is not None):
        raise ProblemError(
            "--seen or --watch is given without --eye; expected --eye with the calibration file of a camera"
        )
    if questions:
        yield load_plugin(WIRES, "questions", "--questions")(policy, network, key)
    elif eye is not None:
        with load_plugin(WIRES, "pictures", "--eye")(policy, network, key, eye, seen=seen, watch=watch) as wire:
            yield wire
    else:
        yield Wire(policy, network, key)


def _safe(text: str) -> Any:
    return text if text in ("hold", "zero") else _numbers("--safe", text, "hold, zero, or ")


def _numbers(name: str, text: str, others: str = "") -> tuple[float, ...]:
    """Return the finite numbers in a text, separated by commas."""
    from taciturn.errors import ProblemError

    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = (nan,)
    if not all(map(isfinite, found)):
        raise ProblemError(f"{name} is {text.strip()!r}; expected {others}numbers such as 0.5,-1")
    return found


@contextmanager
def _counters(server: NodeServer) -> Generator[Callable[[], bool]]:
    """Yield a function that shows the counters of a node on a terminal, at most twice a second."""
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
        return Text(f"step {report['tick']} · {counted or 'no packets yet'} · {refused} refused{degraded}")

    with Live(line(), console=Console(stderr=True), transient=True, auto_refresh=False) as live:
        next_at = time.monotonic()

        def show() -> bool:
            nonlocal next_at
            if time.monotonic() >= next_at:
                next_at = time.monotonic() + 0.5
                live.update(line(), refresh=True)
            return False

        yield show
