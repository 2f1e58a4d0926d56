"""Runs the nodes of a problem as processes on this machine, and measures what they cost and send."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn._arrays import Array, count, instance
from taciturn._figure import Panel, Series, draw
from taciturn._progress import Progress
from taciturn._table import data_frame
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.model.network import Network
from taciturn.model.policy import LinkName, Policy, Send
from taciturn.problem import load
from taciturn.runtime.namespaces import Counted, KernelLoss, Namespaces, predict_drops
from taciturn.runtime.packet import KEY, Wire, read_key
from taciturn.runtime.plant import SimulatedPlant
from taciturn.runtime.processes import Processes
from taciturn.runtime.relay import Fate
from taciturn.runtime.udp import Endpoint, parse_address
from taciturn.runtime.world import PlantServer
from taciturn.simulation.doubts import comes_never_to_rest
from taciturn.simulation.statistics import BATCHES, batch_means
from taciturn.study.ticks import cost_of_ticks, measured, settled
from taciturn.study.units import TimeUnit, Unit, base_rate, cost_unit, rate_unit

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

USUAL = 5000  # ticks


@dataclass(frozen=True, eq=False)
class NetworkRun:
    """What the nodes of a problem cost and sent.

    Args:
        loop: the loop that was run.
        unit: what the cost counts per.
        cost: a mean over the ticks with its standard error by batch means, or the total of a mission; None where the
            run was too short for a mean.
        rates: sends per step or per second by scheduled link (of a mission, the share of its steps).
        datagrams: sent, delivered and lost, by link; in namespaces also how many losses were ``predicted``, and what
            nftables counted, where a packet that is sent again counts again (``nft_seen``, ``nft_dropped``).
        reports: of each process, by name.
        costs: of each tick, (ticks,).
        sends: whether a packet was sent, by link, (ticks,).
        arrived: sequence numbers of the packets that came, by link, in order, as their receiver has logged.
        seed: of plant and links.
        nominal: whether loop and links are those of the design; else nothing is guaranteed.
        seconds: wall time.
        notes: what the reader must know.
    """

    loop: Loop
    unit: Unit
    cost: Estimate | None
    rates: Mapping[str, Estimate]
    datagrams: Mapping[str, Mapping[str, int]]
    reports: Mapping[str, Mapping[str, Any]]
    costs: Array
    sends: Mapping[str, Array]
    arrived: Mapping[str, tuple[int, ...]]
    seed: int
    nominal: bool
    seconds: float
    notes: tuple[str, ...]

    @property
    def rate_unit(self) -> TimeUnit:
        """What rates count per."""
        return rate_unit(self.unit)

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table with one row per tick: what it cost, and whether a packet was sent, by link.

        Raises:
            ProblemError: pandas is not installed.
        """
        columns: dict[str, object] = {"cost": self.costs}
        columns |= {f"sent_{link}": sent > 0 for link, sent in self.sends.items()}
        return data_frame(columns, "tick", range(len(self.costs)))

    def plot(self) -> Figure:
        """Return a figure: what each tick cost, and every send."""
        ticks = [float(tick) for tick in range(len(self.costs))]
        marks = [
            Series(
                np.flatnonzero(sent).astype(float).tolist(),
                [1.0] * int(sent.sum()),
                f"{link}: {int(sent.sum())} of {len(sent)}",
                "stems",
                color=i,
            )
            for i, (link, sent) in enumerate(self.sends.items())
        ]
        costs = Panel([Series(ticks, self.costs.tolist(), "cost of a tick")], ylabel="cost")
        return draw([costs, Panel(marks, xlabel="tick", ylabel="sends")])

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn network --json``."""
        policy, loop = self.loop.policy, self.loop
        guarantee = policy.guarantee if self.nominal else None
        return {
            "policy": policy.kind,
            "unit": self.unit,
            "base_rate": base_rate(loop),
            "cost": None if self.cost is None else measured(self.cost),
            "cost_all_time": policy.cost_all_time if self.nominal else None,
            "cost_bound": None if guarantee is None else guarantee.cost,
            "rates": {link: measured(rate) for link, rate in self.rates.items()},
            "datagrams": {link: dict(found) for link, found in self.datagrams.items()},
            "seed": self.seed,
            "seconds": round(self.seconds, 4),
            "ticks": len(self.costs),
            "degraded": {name: report["degraded"] for name, report in self.reports.items() if "degraded" in report},
            "processes": {name: dict(report) for name, report in self.reports.items()},
            "notes": list(self.notes),
        }


def run_network(
    file: str | Path,
    *,
    ticks: int | None = None,
    tick: float | None = None,
    seed: int = 0,
    key: bytes | None = None,
    fates: Mapping[LinkName, Fate] | None = None,
    namespaces: bool = False,
    progress: Progress | None = None,
    meanwhile: Callable[[Processes], None] | None = None,
) -> NetworkRun:
    """Run a plant and its nodes as processes of this machine, and return what they cost.

    They run on the loopback with a relay on each link, or in network namespaces where the kernel loses packets.

    Args:
        file: problem file, or the name of a built-in problem.
        ticks: to run; omitted: the mission, or 5000.
        tick: real seconds per tick; omitted: virtual time, in which nothing is late and a seed gives the same run.
        seed: of the plant, the draws and the losses.
        key: that authenticates the packets; omitted: of the environment, or none.
        fates: what befalls the packets of each link, by relays; omitted: the losses of ``[network]``.
        namespaces: run each node in a namespace of its own, and let the kernel lose what ``[network]`` loses.
        progress: called with the fraction done.
        meanwhile: called in a thread of its own once everything runs, to disturb it.

    Raises:
        ProblemError: data that do not fit, nodes that cannot be separated, a process that has ended; with namespaces,
            fates, losses in bursts or not in permille, or missing rights or programs.
    """
    instance("file, which the processes read,", file, str, Path)
    problem = load(file)
    policy = problem.design()
    loop = problem.close(policy)
    count("seed", seed, 0)
    ticks = loop.ticks(ticks if ticks is not None else problem.cost.horizon or USUAL)
    key = read_key() if key is None else key
    wire = Wire(policy, problem.network, key)
    if namespaces and fates is not None:
        raise ProblemError("fates are given with namespaces, where no relay runs; expected one of them")
    if fates is not None:
        _check_fates(fates, policy)
    drops = kernel_losses(problem.network, seed) if namespaces else {}
    chosen = fates if fates is not None else losses(problem.network, seed)
    began = time.monotonic()
    with (
        tempfile.TemporaryDirectory(prefix="taciturn-") as name,
        Namespaces(policy, drops) if namespaces else nullcontext() as spaces,
    ):
        folder = Path(name)
        processes = Processes(
            str(file), policy, {**losses(Network(), seed), **chosen}, tick=tick, folder=folder,
            keeps=meanwhile is not None, options=["--seed", str(seed)],
            environment={KEY: "" if key is None else key.hex()}, namespaces=spaces,
        )  # fmt: skip
        with nullcontext() if spaces is None else spaces.visit("plant"):
            plant = Endpoint(parse_address("the plant", processes.addresses["plant"]))
        try:
            processes.start()
            sensor = parse_address("the sensor", processes.addresses[processes.measuring])
            simulated = SimulatedPlant(loop, seed)
            shown = None if progress is None else _shown(progress, ticks)
            server = PlantServer([simulated], wire, plant, sensor, tick=tick, told=shown)
            if meanwhile is None:
                server.run(ticks, processes.ended)
            else:
                _disturbed(server, ticks, processes, meanwhile)
            if processes.ended():
                raise ProblemError(processes.sentence())
            reports = {**processes.stop(), "plant": server.report()}
            seen: dict[LinkName, Counted] = {}
            if spaces is not None:
                seen = {link: spaces.counted(link) for link in processes.links}
        finally:
            processes.kill()
            plant.close()
        costs = np.array(server.costs[0])
        logs = {role: logged_lines(folder / f"{role}.jsonl") for role in processes.roles}
    sends = {link: _sends(logs[processes.sender(link)], link, len(costs)) for link in processes.links}
    datagrams = {link: _datagrams(link, reports) for link in processes.links}
    for link, counts in seen.items():
        found = predict_drops(drops[link].seed, drops[link].permille, range(datagrams[link]["sent"]))
        datagrams[link] |= {"predicted": int(found.sum()), "nft_seen": counts.seen, "nft_dropped": counts.dropped}
    cost, notes = cost_of_ticks(loop, costs, simulated.final_cost())
    pace = base_rate(loop)
    skipped = settled(loop)
    departures = loop.departures + _other_links(chosen, losses(problem.network, seed))
    return NetworkRun(
        loop=loop,
        unit=cost_unit(problem),
        cost=cost,
        rates={link: _rate(sends[link], skipped).scaled(pace) for link in policy.scheduled if link in sends},
        datagrams=datagrams,
        reports=reports,
        costs=costs,
        sends=sends,
        arrived={link: _arrived(logs[processes.receiver(link)], link) for link in processes.links},
        seed=seed,
        nominal=not departures,
        seconds=time.monotonic() - began,
        notes=notes
        + _unheard(loop, datagrams)
        + _unforeseen(datagrams)
        + tuple(f"{text}: no guarantee holds" for text in departures),
    )


def losses(
    network: Network, seed: int, outages: Mapping[LinkName, tuple[int, int] | None] | None = None
) -> dict[LinkName, Fate]:
    """Return the links of a network as what befalls their packets; in an outage they are dead."""
    links: tuple[LinkName, ...] = ("actuator", "sensor")
    return {
        link: Fate(
            seed=2 * seed + i,
            loss=0.0 if network.burst(link) else network.loss(link),
            burst=network.burst(link),
            outage=(outages or {}).get(link),
        )
        for i, link in enumerate(links)
    }


def _check_fates(fates: Mapping[LinkName, Fate], policy: Policy) -> None:
    """Refuse fates of links that a policy does not have, and what is no fate."""
    instance("fates", fates, Mapping)
    links = [step.link for step in policy.steps if isinstance(step, Send)]
    for link, fate in fates.items():
        if link not in links:
            raise ProblemError(f"fates has the link {link!r}; expected of {policy.kind}: {', '.join(links)}")
        instance(f"fates[{link!r}]", fate, Fate)


def _other_links(fates: Mapping[LinkName, Fate], stated: Mapping[LinkName, Fate]) -> tuple[str, ...]:
    """Say which links lose, delay or change packets otherwise than the network says."""
    other = [link for link, fate in fates.items() if replace(fate, seed=stated[link].seed) != stated[link]]
    return tuple(f"the {link} link treats packets otherwise than the network of the design" for link in other)


def kernel_losses(network: Network, seed: int) -> dict[LinkName, KernelLoss]:
    """Return the links of a network as what the kernel drops there.

    Raises:
        ProblemError: losses in bursts, or no whole number of permille.
    """
    found: dict[LinkName, KernelLoss] = {}
    for link, fate in losses(network, seed).items():
        if fate.burst is not None:
            raise ProblemError(f"{link}_burst is given; expected {link}_loss: the kernel loses no packets in bursts")
        permille = round(1000 * fate.loss)
        if abs(permille - 1000 * fate.loss) > 1e-9:
            raise ProblemError(f"{link}_loss is {fate.loss:g}; expected a multiple of 0.001, as the kernel takes it")
        found[link] = KernelLoss(fate.seed & 0xFFFFFFFF, permille)  # of 32 bits
    return found


def _disturbed(server: PlantServer, ticks: int, processes: Processes, meanwhile: Callable[[Processes], None]) -> None:
    """Run the plant while somebody disturbs the nodes in a thread; what goes wrong there ends the run."""
    with ThreadPoolExecutor(1) as pool:
        disturbance = pool.submit(meanwhile, processes)
        server.run(ticks, lambda: disturbance.done() and (disturbance.exception() is not None or processes.ended()))
        disturbance.result()


def _rate(sends: Array, skipped: int) -> Estimate:
    """Return the share of ticks with a send; where none or all have one, it may still be as rare as one in them."""
    kept = sends[skipped:]
    if len(kept) < 10 * BATCHES:
        return Estimate(float(sends.mean()), float(sends.std() / np.sqrt(max(len(sends) - 1, 1))), "simulation")
    found = batch_means(kept)
    return Estimate(found.value, max(found.standard_error, 1 / len(kept)), found.method)


def logged_lines(log: Path) -> list[dict[str, Any]]:
    """Return what a node has logged."""
    lines: list[dict[str, Any]] = []
    for text in log.read_text(encoding="utf-8").splitlines():
        with suppress(ValueError):  # the last line of a process that was killed
            lines.append(json.loads(text))
    return lines


def _sends(lines: Iterable[Mapping[str, Any]], link: LinkName, ticks: int) -> Array:
    """Return whether a packet was sent at each tick, as its sender has logged."""
    sent = np.zeros(ticks)
    for line in lines:
        if line["tick"] < ticks and line[f"sent_{link}"]:
            sent[line["tick"]] = 1.0
    return sent


def _arrived(lines: Iterable[Mapping[str, Any]], link: LinkName) -> tuple[int, ...]:
    """Return the sequence numbers of the packets that came, as their receiver has logged."""
    return tuple(sequence for line in lines for sequence in line[f"arrived_{link}"])


def _unheard(loop: Loop, datagrams: Mapping[str, Mapping[str, int]]) -> tuple[str, ...]:
    """Return on which links nothing has arrived, of a plant that needs it."""
    return tuple(
        f"nothing has arrived on the {link} link, and the plant does not come to rest by itself: the cost is how far "
        "it got, not an average"
        for link, counted in datagrams.items()
        if counted["delivered"] == 0 and loop.horizon is None and comes_never_to_rest(loop)
    )


def _unforeseen(datagrams: Mapping[str, Mapping[str, int]]) -> tuple[str, ...]:
    """Return on which links the kernel has lost something else than it was asked to."""
    return tuple(
        f"the {link} link has lost {counted['lost']} packets, and not the {counted['predicted']} of its rule"
        for link, counted in datagrams.items()
        if counted.get("predicted", counted["lost"]) != counted["lost"]
    )


def _datagrams(link: LinkName, reports: Mapping[str, Mapping[str, Any]]) -> dict[str, int]:
    """Return what became of the packets of a link."""
    sent = sum(report["counters"].get(f"sent data {link}", 0) for report in reports.values() if "counters" in report)
    if f"relay {link}" not in reports:
        delivered = sum(report["arrived"].get(link, 0) for report in reports.values() if "arrived" in report)
        return {"sent": sent, "delivered": delivered, "lost": sent - delivered}
    counted = reports[f"relay {link}"]["counters"]
    return {
        "sent": sent,
        "delivered": counted.get("delivered", 0),
        "lost": counted.get("lost", 0),
        **{name: counted[name] for name in ("duplicated", "reordered", "corrupted") if name in counted},
        **({"pending": reports[f"relay {link}"]["pending"]} if reports[f"relay {link}"]["pending"] else {}),
    }


def _shown(progress: Progress, ticks: int) -> Callable[[Mapping[str, Any]], None]:
    return lambda line: progress((line["tick"] + 1) / ticks)
