"""Run the nodes of a problem as processes on this machine, and measure cost and packets.

The nodes run as they would on different machines: each is a process with a socket. On the loopback interface, a relay
on each link drops packets; in network namespaces, the kernel does. This process serves the plant. It computes the cost
of the recorded steps (``averages``) and reads the ``logs`` of the nodes for the packets that they sent and received.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Progress, count, in_notebook, instance, number_of, temporary_folder
from taciturn.loop import Loop
from taciturn.model.network import Network
from taciturn.model.policy import Policy
from taciturn.model.steps import Send
from taciturn.nodes.inbox import LATE_ANSWER
from taciturn.nodes.keys import Keys, read_keys
from taciturn.nodes.packet import Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.problem import Problem, load
from taciturn.problem.loads import with_added_loads
from taciturn.problem.settings import parse_settings
from taciturn.problem.without_file import PASSED, as_problem, pass_problem
from taciturn.simulation.average import base_rate
from taciturn.simulation.reliability import comes_never_to_rest
from taciturn.study.evaluation import cost_unit
from taciturn.study.sentences import WITHDRAWN
from taciturn_udp.averages import cost_of_ticks, rate_of_ticks, remark_on_rates
from taciturn_udp.endpoint import Endpoint, parse_address
from taciturn_udp.late import Lateness
from taciturn_udp.logs import PART, Logs
from taciturn_udp.namespaces import Counted, KernelLoss, Namespaces, kernel_losses, predict_drops
from taciturn_udp.plant import PlantServer
from taciturn_udp.processes import Processes
from taciturn_udp.record import Drawn, Lost, Record
from taciturn_udp.relay import Fate, losses
from taciturn_udp.result import NetworkRun, uncertified
from taciturn_udp.service import Told

USUAL = 5000  # default number of steps


def run_network(
    file: str | Path | Problem | Policy,
    *,
    settings: Sequence[str] = (),
    steps: int | None = None,
    tick: float | None = None,
    seed: int = 0,
    key: bytes | Keys | None = None,
    fates: Mapping[str, Fate] | None = None,
    namespaces: bool = False,
    functions: bool = True,
    loads: Sequence[str] = (),
    record: str | Path | None = None,
    progress: Progress | None = None,
    meanwhile: Callable[[Processes], None] | None = None,
) -> NetworkRun:
    """Run a plant and its nodes as processes on this machine, and return the measured cost and packets.

    The processes use the loopback interface with a relay on each link, or network namespaces in which the kernel drops
    packets.

    Args:
        file: problem file, the name of a built-in problem, a problem, or a policy.
        settings: changes of the keys, each of the form NAME=VALUE as in ``--set``.
        steps: number of steps; default: the horizon of a finite-horizon run, or 5000.
        tick: real seconds per step; default: virtual time, in which no packet is late and a run is reproducible for a
            given seed.
        seed: seed of the plant, the random draws and the losses.
        key: key that authenticates the packets; default: the key in the environment, or no key.
        fates: impairments of the packets on each link, applied by relays; default: the losses of ``[network]``.
        namespaces: whether each node runs in its own network namespace, in which the kernel drops packets with the
            losses of ``[network]``.
        functions: whether the file may name functions, which are executed.
        loads: loads that are added to the simulated plant, each of the form VALUE@SECONDS as in ``--load``.
        record: folder in which all packets and signals are recorded, as ``packets.csv`` and ``signals.csv``.
        progress: callback that receives the fraction done.
        meanwhile: function that is called in a separate thread when all processes run, to disturb them.

    Raises:
        ProblemError: the data are inconsistent, the nodes cannot be separated, a process has ended, or there is a
            record in the folder already; with namespaces, also if fates are given, losses are in bursts or not in
            permille, or rights or programs are missing.
    """
    read = isinstance(file, str | Path)  # whether the processes read the file, or the problem is passed to them
    problem = load(file, functions=functions) if read else as_problem("file", file)
    changes = parse_settings(list(settings))
    problem = problem.changed(changes) if changes else problem
    policy = problem.design()
    loop = with_added_loads(problem, loads).close(policy)
    count("seed", seed, 0)
    steps = loop.checked_steps(steps if steps is not None else problem.cost.horizon or USUAL)
    key = read_keys() if key is None else key
    wire = Wire(policy, problem.network, key)
    if namespaces and fates is not None:
        raise ProblemError(
            "fates and namespaces are both given, but only relays apply fates, and namespaces have no relays; "
            "expected one of them"
        )
    if fates is not None:
        _check_fates(fates, policy)
    drops = kernel_losses(problem.network, seed) if namespaces else {}
    stated = losses(problem.network, seed, period=None if namespaces else policy.tick, tick=tick)
    chosen = fates if fates is not None else stated
    relayed = {**losses(Network(), seed), **chosen}
    lost = {link: _dropped(one) for link, one in drops.items()} if namespaces else _foreseen(relayed)
    drawn = {} if tick is not None or namespaces else drawn_delays(problem.network, policy, relayed)
    began = time.monotonic()
    with (
        temporary_folder() as folder,
        Namespaces(policy, drops) if namespaces else nullcontext() as spaces,
        nullcontext() if record is None else closing(Record(Path(record), loop, wire, tick, lost, drawn)) as written,
    ):
        changed = [part for text in settings for part in ("--set", text)] if read else []
        changed += [] if functions else ["--no-functions"]
        passed = {} if read else pass_problem(problem, folder)
        given = str(file) if read else passed[PASSED]
        processes = Processes(
            given, policy, relayed, tick=tick, folder=folder,
            keeps=meanwhile is not None, options=["--seed", str(seed), "--log-part", str(PART), *changed],
            key=key, namespaces=spaces, environment=passed,
        )  # fmt: skip
        with nullcontext() if spaces is None else spaces.visit("plant"):
            plant = Endpoint(parse_address("the plant", processes.addresses["plant"]))
        try:
            processes.start()
            sensors = {link: parse_address("a node", at) for link, at in processes.measuring.items()}
            simulated = SimulatedPlant(loop, seed)
            bar = in_notebook(progress)
            shown: Told | None = None if bar is None else lambda line: bar((line["tick"] + 1) / steps)
            watched = simulated if written is None else written.watch(simulated)
            server = PlantServer([watched], wire, plant, sensors, tick=tick, told=shown)
            logs = Logs(processes, server.begins, tick, written)
            with logs.followed():
                if meanwhile is None:
                    server.run(steps, processes.ended)
                else:
                    _disturbed(server, steps, processes, meanwhile)
                if processes.ended():
                    raise ProblemError(processes.sentence())
                reports = {**processes.stop(), "plant": server.report()}
            for report in reports.values():  # a node cannot see a delay that all packets have
                report |= {"late_packets": _known_lateness(report, logs)} if "arrived" in report else {}
            unwritten = () if written is None else written.finish(_pending(reports))
            seen: dict[str, Counted] = {}
            if spaces is not None:
                seen = {link: spaces.counted(link) for link in processes.links}
        finally:
            processes.kill()
            plant.close()
        costs = np.array(server.costs[0])
    sends = {link: logs.sends(link, len(costs)) for link in processes.links}
    datagrams = {link: _datagrams(link, reports) for link in processes.links}
    for link, counts in seen.items():
        found = predict_drops(drops[link].seed, drops[link].permille, range(datagrams[link]["sent"]))
        datagrams[link] |= {"predicted": int(found.sum()), "nft_seen": counts.seen, "nft_dropped": counts.dropped}
    cost, notes = cost_of_ticks(loop, costs, simulated.final_cost())
    pace = base_rate(loop)
    rates = {link: rate_of_ticks(loop, sends[link]).scaled(pace) for link in policy.scheduled if link in sends}
    differences = loop.violated_assumptions + _other_links(chosen, stated) + late_acknowledgements(reports)
    return NetworkRun(
        loop=loop,
        unit=cost_unit(problem),
        cost=cost,
        rates=rates,
        datagrams=datagrams,
        reports=reports,
        costs=costs,
        sends=sends,
        arrived={link: logs.arrived(link) for link in processes.links},
        lateness={**logs.lateness, **server.lateness},
        real_time=tick is not None,
        seed=seed,
        nominal=not differences,
        seconds=time.monotonic() - began,
        notes=notes
        + remark_on_rates(loop, rates.values(), len(costs))
        + _unheard(loop, datagrams)
        + _unforeseen(datagrams)
        + uncertified(loop, reports)
        + unwritten
        + tuple(f"{text}{WITHDRAWN}" for text in differences),
    )


def _check_fates(fates: Mapping[str, Fate], policy: Policy) -> None:
    """Reject fates for links that the policy does not have, and values of another type."""
    instance("fates", fates, Mapping)
    links = [step.link for step in policy.steps if isinstance(step, Send)]
    for link, fate in fates.items():
        if link not in links:
            raise ProblemError(
                f"fates names the link {link!r}; expected links of the policy {policy.kind}: {', '.join(links)}"
            )
        instance(f"fates[{link!r}]", fate, Fate)


def _other_links(fates: Mapping[str, Fate], stated: Mapping[str, Fate]) -> tuple[str, ...]:
    """Return the links whose losses, delays or changes of packets differ from those of the network."""
    other = [link for link, fate in fates.items() if replace(fate, seed=stated[link].seed) != stated[link]]
    return tuple(f"the {link} link treats packets differently from the network of the design" for link in other)


def late_acknowledgements(reports: Mapping[str, Mapping[str, Any]]) -> tuple[str, ...]:
    """Return a sentence for each node that has received acknowledgements after the steps whose decisions need them."""
    counted = {role: report.get("degraded", {}).get(LATE_ANSWER, 0) for role, report in reports.items()}
    return tuple(
        f"{number_of(number, 'acknowledgement')} came to the {role} after its next step had begun"
        for role, number in counted.items()
        if number
    )


def _foreseen(fates: Mapping[str, Fate]) -> dict[str, Lost]:
    """Return for each link whether its relay drops a packet."""
    return {link: fate.lost for link, fate in fates.items()}


def drawn_delays(network: Network, policy: Policy, fates: Mapping[str, Fate]) -> dict[str, Drawn]:
    """Return for each link that delays packets by the law of the network the delay of a packet in seconds."""
    found = dict[str, Drawn]()
    for link in network.late:
        fate = fates.get(link)
        if fate is not None and fate.late == Lateness.of(network, link, policy.tick):
            late = Lateness.of(network, link, policy.tick, policy.model.dt or 1.0)
            found[link] = replace(fate, late=late).late_by
    return found


def _dropped(loss: KernelLoss) -> Lost:
    """Return whether the kernel drops a packet of a link."""
    return lambda sequence, step: bool(loss.permille and predict_drops(loss.seed, loss.permille, [sequence])[0])


def _known_lateness(report: Mapping[str, Any], logs: Logs) -> dict[str, Any]:
    """Return how late the packets of a node were by the steps of the plant, in place of its own estimate."""
    return {link: logs.lateness[link].document() for link in report["late_packets"]}


def _pending(reports: Mapping[str, Mapping[str, Any]]) -> dict[str, int]:
    """Return the numbers of packets that are still on the way, by link."""
    return {name.partition(" ")[2]: report["pending"] for name, report in reports.items() if "pending" in report}


def _disturbed(server: PlantServer, steps: int, processes: Processes, meanwhile: Callable[[Processes], None]) -> None:
    """Run the plant while a function disturbs the nodes in a thread; an exception in this thread ends the run."""
    with ThreadPoolExecutor(1) as pool:
        disturbance = pool.submit(meanwhile, processes)
        server.run(steps, lambda: disturbance.done() and (disturbance.exception() is not None or processes.ended()))
        disturbance.result()


def _unheard(loop: Loop, datagrams: Mapping[str, Mapping[str, int]]) -> tuple[str, ...]:
    """Return a warning for each link on which no packet arrived, if the plant does not come to rest without packets."""
    return tuple(
        f"no packet arrived on the {link} link, and the plant does not come to rest by itself: the cost depends on the "
        "length of the run and is not an average"
        for link, counted in datagrams.items()
        if counted["delivered"] == 0 and loop.horizon is None and comes_never_to_rest(loop)
    )


def _unforeseen(datagrams: Mapping[str, Mapping[str, int]]) -> tuple[str, ...]:
    """Return a warning for each link on which the number of dropped packets differs from the prediction."""
    return tuple(
        f"the {link} link dropped {number_of(counted['lost'], 'packet')} instead of {counted['predicted']} as predicted"
        for link, counted in datagrams.items()
        if counted.get("predicted", counted["lost"]) != counted["lost"]
    )


def _datagrams(link: str, reports: Mapping[str, Mapping[str, Any]]) -> dict[str, int]:
    """Return the numbers of packets of a link that were sent, sent again, delivered and lost."""
    sent, again, marks = (
        sum(report["counters"].get(f"sent {kind} {link}", 0) for report in reports.values() if "counters" in report)
        for kind in ("data", "again data", "mark")
    )
    repeated = {"again": again} if again else {}
    if f"relay {link}" not in reports:
        delivered = sum(report["arrived"].get(link, 0) for report in reports.values() if "arrived" in report)
        return {"sent": sent, "delivered": delivered, "lost": sent - delivered, "marks": marks, **repeated}
    counted = reports[f"relay {link}"]["counters"]
    return {
        "sent": sent,
        "delivered": counted.get("delivered", 0),
        "lost": counted.get("lost", 0),
        "marks": marks,
        **repeated,
        **{name: counted[name] for name in ("duplicated", "reordered", "corrupted") if name in counted},
        **({"pending": reports[f"relay {link}"]["pending"]} if reports[f"relay {link}"]["pending"] else {}),
    }
