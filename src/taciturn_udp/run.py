"""Run of the nodes of a problem as processes on this machine, with measured cost and packets.

Cost of recorded steps: a mean with its standard error, or the total of one run with a horizon or a discount.

Logs of the nodes of a run, which are read and deleted in parts while the nodes run.

Nodes that run: as processes over UDP, or in one process with faults.

``network`` runs the nodes of a problem as processes, reads their ``logs``, and measures the cost of the recorded steps
(``ticks``). ``worlds`` runs them under faults that a seed chooses: one ``world``, the keys of its nodes (``keyring``),
nodes in C (``devices``), and what must hold (``invariants``).
"""

from __future__ import annotations

import json
import threading
import time
from array import array
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import (
    Array,
    Panel,
    Progress,
    Series,
    Size,
    count,
    draw,
    in_notebook,
    instance,
    per_unit,
    temporary_folder,
)
from taciturn.loop import Loop
from taciturn.model.coverage import INTERVALS, NETWORKS, Coverage
from taciturn.model.estimate import Estimate
from taciturn.model.network import Network
from taciturn.model.policy import Policy
from taciturn.model.result import Column, Columns, Field, Tabular, plain_fields, seconds
from taciturn.model.signals import RandomSteps, SampledChanges
from taciturn.model.steps import Send
from taciturn.nodes.keys import Keys, read_keys
from taciturn.nodes.packet import Wire
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.problem import Problem, load
from taciturn.problem.bare import PASSED, as_problem, pass_problem
from taciturn.problem.matrices import parse_settings
from taciturn.simulation.average import base_rate
from taciturn.simulation.reliability import comes_never_to_rest, doubt_errors
from taciturn.simulation.statistics import BATCHES, batch_means
from taciturn.study.evaluation import TimeUnit, Unit, cost_unit, rate_unit
from taciturn_udp.endpoint import Endpoint, parse_address
from taciturn_udp.namespaces import Counted, KernelLoss, Namespaces, predict_drops
from taciturn_udp.plant import PlantServer
from taciturn_udp.processes import Processes
from taciturn_udp.relay import Fate
from taciturn_udp.service import name_of_part

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SETTLED = 5.0  # time constants at the start that an average omits
FEWEST = 10  # least steps of a batch
APART = 3.0  # least length of a batch in time constants of the loop, or six of the cost, which is a square


def settled(loop: Loop) -> int:
    """Return the number of steps at the start that an average omits."""
    return 0 if loop.horizon is not None else int(np.ceil(SETTLED * loop.policy.theory.settling))


def piece_of(loop: Loop) -> tuple[float, float, str]:
    """Return the least number of steps of a batch for a valid standard error, and what it contains, with its steps.

    Batches are independent only if each lasts several time constants of the loop. If changes of set-points or jumps are
    rare, they decide the cost. A record of a few of them contains as few independent pieces, however many steps it has.
    """
    changes, settling = loop.problem.plant.changes, loop.policy.theory.settling
    found = [(float(FEWEST), 1.0, "steps"), (APART * settling, settling, "time constants of the loop")]
    if isinstance(changes, RandomSteps):
        found.append((1 / changes.rate, 1 / changes.rate, "changes of set-points"))
    if isinstance(changes, SampledChanges):
        table = float(len(changes.table))
        found.append((table, table, "repetitions of the timetable"))
    if loop.problem.jumps is not None:
        jumps = 1 / (loop.problem.jumps.jumps.rate * loop.problem.jumps.period)
        found.append((jumps, jumps, "jumps"))
    return max(found)


def least_steps(loop: Loop) -> int:
    """Return the number of steps after the first ones, which are omitted, from which on a mean has an error."""
    return int(np.ceil(piece_of(loop)[0])) * BATCHES


def cost_of_ticks(loop: Loop, costs: Array, final: float) -> tuple[Estimate | None, tuple[str, ...]]:
    """Return the mean cost of the steps in the units of the problem, or the total of a run with horizon or discount."""
    if loop.horizon is not None:
        discount = loop.problem.cost.discount
        total = float(costs @ discount ** np.arange(len(costs))) + (final if len(costs) == loop.horizon else 0.0)
        run = "finite-horizon run" if discount == 1.0 else "run with discounted costs"
        return Estimate(total, 0.0, "exact"), (f"one {run}: its cost is one realisation, not a mean",)
    skipped = settled(loop)
    kept = costs[skipped:]
    _, once, why = piece_of(loop)
    needed = skipped + least_steps(loop)
    short = f"{len(costs)} steps are too few for a mean cost with its error; expected at least {needed}"
    if len(kept) < FEWEST * BATCHES:
        return None, (short,)
    if len(kept) < least_steps(loop):
        mean = _in_units(loop, Estimate(float(kept.mean()), 0.0, "exact"))
        return mean, (f"{short}: the cost is that of this run, with about {len(kept) / once:.2g} {why}",)
    found = batch_means(kept)
    notes = loop.problem.remarks
    notes += (f"means omit the first {skipped} steps, in which the loop settles",) if skipped else ()
    cost = _in_units(loop, found)
    return cost, notes + doubt_errors(cost, len(kept))


def rate_of_ticks(loop: Loop, sends: Array) -> Estimate:
    """Return the share of steps with a send, without an error if the run has a finite horizon or is too short.

    Sends of successive steps are correlated, so only batch means have a valid standard error. It is at least one send
    in all these steps.
    """
    kept = sends[settled(loop) :]
    if loop.horizon is not None or len(kept) < least_steps(loop):
        return Estimate(float(sends.mean()), 0.0, "exact")
    found = batch_means(kept)
    return Estimate(found.value, max(found.standard_error, 1 / len(kept)), found.method)


def remark_on_rates(loop: Loop, rates: Iterable[Estimate], steps: int) -> tuple[str, ...]:
    """Return a remark if rates were measured only once."""
    if all(rate.method != "exact" for rate in rates):
        return ()
    counted = ", and later sends are not discounted" if loop.problem.cost.discount < 1 else ""
    return (f"the rates are those of this run of {steps} steps, without standard errors{counted}",)


def _in_units(loop: Loop, found: Estimate) -> Estimate:
    """Return a mean cost per step in the units of the problem."""
    return found.scaled(1 / loop.problem.tick, loop.problem.noise_cost / loop.problem.tick)


def plant_cost(problem: Problem, loop: Loop, costs: Sequence[Sequence[float]], final: float) -> dict[str, Any]:
    """Return a plant's report on its cost, from the costs of all steps, (loops, steps), and of the final state."""
    per_tick = np.mean(costs, axis=0)
    if not per_tick.size:
        return {"cost": None, "unit": cost_unit(problem), "notes": []}
    cost, notes = cost_of_ticks(loop, per_tick, final)
    cost = cost or _in_units(loop, Estimate(float(per_tick.mean()), 0.0, "exact"))
    return {"cost": measured(cost), "unit": cost_unit(problem), "notes": list(notes)}


def measured(estimate: Estimate) -> dict[str, Any]:
    """Return the JSON document of a measured number, without a standard error if it was measured only once."""
    once = {"standard_error": None} if estimate.method == "exact" else {}
    return estimate.document() | once | {"method": "simulation"}


PART = 2**20  # bytes of a part of a log, of which a node has at most two
PAUSE = 0.2  # seconds between two searches for complete parts


def logged_lines(log: Path) -> list[dict[str, Any]]:
    """Return the entries of a node's log."""
    lines: list[dict[str, Any]] = []
    for text in log.read_text(encoding="utf-8").splitlines():
        with suppress(ValueError):  # the last line of a process that was killed
            lines.append(json.loads(text))
    return lines


class Logs:
    """The packets of a run: the steps in which they were sent, and the sequence numbers of those that arrived."""

    def __init__(self, processes: Processes) -> None:
        """Start before the first line."""
        self._logs = {role: processes.folder / f"{role}.jsonl" for role in processes.roles}
        self._ends = {link: (processes.sender(link), processes.receiver(link)) for link in processes.links}
        self._sent = {link: array("q") for link in processes.links}
        self._arrived = {link: array("q") for link in processes.links}

    @contextmanager
    def followed(self) -> Generator[None]:
        """Read and delete complete parts of the logs while the block runs, and the rest of the logs at its end."""
        ended = threading.Event()

        def follow() -> None:
            while not ended.wait(PAUSE):
                self._take_parts()

        reader = threading.Thread(target=follow, name="logs", daemon=True)
        reader.start()
        try:
            yield
        finally:
            ended.set()
            reader.join()
        self._take_parts()
        for role, log in self._logs.items():
            self._take(role, logged_lines(log))

    def sends(self, link: str, ticks: int) -> Array:
        """Return whether a packet was sent at each step, according to the log of the sender, (steps,)."""
        sent = np.zeros(ticks)
        steps = np.array(self._sent[link], dtype=np.int64)
        sent[steps[steps < ticks]] = 1.0
        return sent

    def arrived(self, link: str) -> tuple[int, ...]:
        """Return the sequence numbers of the packets that arrived, according to the log of the receiver."""
        return tuple(self._arrived[link])

    def _take_parts(self) -> None:
        for role, log in self._logs.items():
            part = name_of_part(log)
            if part.exists():
                self._take(role, logged_lines(part))
                part.unlink()

    def _take(self, role: str, lines: Iterable[dict[str, Any]]) -> None:
        sends = [link for link, (sender, _) in self._ends.items() if sender == role]
        hears = [link for link, (_, receiver) in self._ends.items() if receiver == role]
        for line in lines:
            for link in sends:
                if line[f"sent_{link}"]:
                    self._sent[link].append(line["tick"])
            for link in hears:
                # a node does not listen to a sensor that is never queried
                self._arrived[link].extend(line.get(f"arrived_{link}", ()))


EMULATED = Coverage(NETWORKS | INTERVALS, "running links do not emulate")
USUAL = 5000  # default number of steps


def _bound(found: NetworkRun) -> float | None:
    guarantee = found.loop.policy.guarantee if found.nominal else None
    return None if guarantee is None else guarantee.cost


def _rates(rates: Mapping[str, Estimate]) -> dict[str, Any]:
    return {link: measured(rate) for link, rate in rates.items()}


def _link_lines(found: NetworkRun) -> Iterator[tuple[str, str]]:
    for link, counted in found.datagrams.items():
        told = (f"{count} {'sent again' if name == 'again' else name}" for name, count in counted.items())
        yield f"link, {link}", ", ".join(told)


def _degraded(found: NetworkRun) -> dict[str, Any]:
    return {name: report["degraded"] for name, report in found.reports.items() if "degraded" in report}


def _reports(found: NetworkRun) -> Iterator[tuple[str, str]]:
    for name, report in found.reports.items():
        if report.get("degraded"):
            yield "degraded", f"{name}: " + ", ".join(f"{n} {why}" for why, n in report["degraded"].items())
        if report.get("lateness_ms"):
            shown = ", ".join(f"{share} {value:g}" for share, value in report["lateness_ms"].items())
            yield "lateness, ms", f"{name}: {shown}"


@dataclass(frozen=True, eq=False, repr=False)
class NetworkRun(Tabular):
    """Cost and packets of a run of the nodes of a problem.

    Args:
        loop: the loop that was run.
        unit: unit of time or run that the cost refers to.
        cost: mean over the steps, with its standard error by batch means, or the total of a finite-horizon run; None if
            the run was too short for a mean.
        rates: sends per step or per second, by scheduled link (in a finite-horizon run, the share of steps with a
            send); without standard errors in a finite-horizon run, or if the run was too short for batch means.
        datagrams: numbers of packets sent, delivered and lost, and of marks sent, by link; ``again``: packets that a
            node repeated, which the link delivers or drops once more. In namespaces, also the
            number of ``predicted`` losses and the counters of nftables, which count every retransmission
            (``nft_seen``, ``nft_dropped``).
        reports: report of each process, by name.
        costs: cost of each step, (steps,).
        sends: whether a packet was sent at each step, by link, (steps,).
        arrived: sequence numbers of the packets that arrived, by link, in the order in which the receiver logged them.
        seed: seed of the plant and the links.
        nominal: whether the loop and the links are those of the design; if not, no guarantee holds.
        seconds: wall time.
        notes: warnings and remarks for the reader.
    """

    FIELDS: ClassVar[tuple[Field[NetworkRun], ...]] = (
        Field("policy", "loop.policy.kind", say="policy"),
        Field("unit"),
        Field("base_rate", lambda found: base_rate(found.loop)),
        Field("cost", json=measured, say="cost", text="{} {of.per}", none="-"),
        Field(
            "cost_all_time",
            lambda found: found.loop.policy.cost_all_time if found.nominal else None,
            say="every sample",
            text="{:.6g}",
        ),
        Field("cost_bound", _bound),
        Field("rates", json=_rates, say="rate, {}", text="{} per {of.rate_unit}", after="cost"),
        Field("datagrams", say="", text=_link_lines),
        *plain_fields("seed", "method"),
        Field("seconds", json=seconds),
        Field("ticks", lambda found: len(found.costs), say="steps", text="{} in {of.seconds:.1f} s", after="policy"),
        Field("degraded", _degraded),
        Field("reports", key="processes", say="", text=_reports),
        Field("notes", say="note"),
    )
    index: ClassVar[str] = "tick"
    heading: ClassVar[tuple[str, ...]] = ("cost", "rates", "unit", "rate_unit", "method", "seed", "notes")
    method: ClassVar[str] = "simulation"

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
        """Unit of time of the rates."""
        return rate_unit(self.unit)

    @property
    def per(self) -> str:
        """Unit of the cost as text."""
        return per_unit(self.unit)

    def columns(self) -> Columns:
        """Return one row per step: its cost, and whether a packet was sent on each link."""
        columns: dict[str, Column] = {"tick": range(len(self.costs)), "cost": self.costs}
        columns |= {f"sent_{link}": sent > 0 for link, sent in self.sends.items()}
        return columns

    def plot(self, ax: Any = None, figsize: Size | None = None) -> Figure:
        """Return a figure with the cost of each step, and every send."""
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
        costs = Panel([Series(ticks, self.costs.tolist(), "cost of a step")], ylabel="cost", beside=True)
        return draw([costs, Panel(marks, "step", "sends", names=("", "sent"), beside=True)], ax, figsize)


def run_network(
    file: str | Path | Problem | Policy,
    *,
    settings: Sequence[str] = (),
    ticks: int | None = None,
    tick: float | None = None,
    seed: int = 0,
    key: bytes | Keys | None = None,
    fates: Mapping[str, Fate] | None = None,
    namespaces: bool = False,
    functions: bool = True,
    progress: Progress | None = None,
    meanwhile: Callable[[Processes], None] | None = None,
) -> NetworkRun:
    """Run a plant and its nodes as processes on this machine, and return their cost and packets.

    The processes use the loopback interface with a relay on each link, or network namespaces in which the kernel drops
    packets.

    Args:
        file: problem file, the name of a built-in problem, a problem, or a policy.
        settings: changes of the keys, each of the form NAME=VALUE as in ``--set``.
        ticks: number of steps; default: the horizon of a finite-horizon run, or 5000.
        tick: real seconds per step; default: virtual time, in which no packet is late and a run is reproducible for a
            given seed.
        seed: seed of the plant, the random draws and the losses.
        key: key that authenticates the packets; default: the key in the environment, or no key.
        fates: impairments of the packets on each link, applied by relays; default: the losses of ``[network]``.
        namespaces: whether each node runs in its own network namespace, in which the kernel drops packets with the
            losses of ``[network]``.
        functions: whether the file may name functions, which are executed.
        progress: callback that receives the fraction done.
        meanwhile: function that is called in a separate thread when all processes run, to disturb them.

    Raises:
        ProblemError: the data are inconsistent, the nodes cannot be separated, or a process has ended; with namespaces,
            also if fates are given, losses are in bursts or not in permille, or rights or programs are missing.
    """
    read = isinstance(file, str | Path)  # whether the processes read the file, or the problem is passed to them
    problem = load(file, functions=functions) if read else as_problem("file", file)
    changes = parse_settings(list(settings))
    problem = problem.changed(changes) if changes else problem
    policy = problem.design()
    loop = problem.close(policy)
    count("seed", seed, 0)
    ticks = loop.ticks(ticks if ticks is not None else problem.cost.horizon or USUAL)
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
    chosen = fates if fates is not None else losses(problem.network, seed)
    began = time.monotonic()
    with (
        temporary_folder() as folder,
        Namespaces(policy, drops) if namespaces else nullcontext() as spaces,
    ):
        changed = [part for text in settings for part in ("--set", text)] if read else []
        changed += [] if functions else ["--no-functions"]
        passed = {} if read else pass_problem(problem, folder)
        given = str(file) if read else passed[PASSED]
        processes = Processes(
            given, policy, {**losses(Network(), seed), **chosen}, tick=tick, folder=folder,
            keeps=meanwhile is not None, options=["--seed", str(seed), "--log-part", str(PART), *changed],
            key=key, namespaces=spaces, environment=passed,
        )  # fmt: skip
        logs = Logs(processes)
        with nullcontext() if spaces is None else spaces.visit("plant"):
            plant = Endpoint(parse_address("the plant", processes.addresses["plant"]))
        try:
            processes.start()
            sensors = {link: parse_address("a node", at) for link, at in processes.measuring.items()}
            simulated = SimulatedPlant(loop, seed)
            bar = in_notebook(progress)
            shown = None if bar is None else _shown(bar, ticks)
            server = PlantServer([simulated], wire, plant, sensors, tick=tick, told=shown)
            with logs.followed():
                if meanwhile is None:
                    server.run(ticks, processes.ended)
                else:
                    _disturbed(server, ticks, processes, meanwhile)
                if processes.ended():
                    raise ProblemError(processes.sentence())
                reports = {**processes.stop(), "plant": server.report()}
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
    differences = loop.violated_assumptions + _other_links(chosen, losses(problem.network, seed))
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
        seed=seed,
        nominal=not differences,
        seconds=time.monotonic() - began,
        notes=notes
        + remark_on_rates(loop, rates.values(), len(costs))
        + _unheard(loop, datagrams)
        + _unforeseen(datagrams)
        + tuple(f"{text}: no guarantee holds" for text in differences),
    )


def losses(network: Network, seed: int, outages: Mapping[str, tuple[int, int] | None] | None = None) -> dict[str, Fate]:
    """Return the impairments of the packets on each link of a network; during an outage, a link drops every packet."""
    EMULATED.check(network)
    links = tuple(reversed(tuple(network.links)))
    return {
        link: Fate(
            seed=len(links) * seed + i,
            loss=0.0 if network.burst(link) else network.loss(link),
            burst=network.burst(link),
            outage=(outages or {}).get(link),
        )
        for i, link in enumerate(links)
    }


def _check_fates(fates: Mapping[str, Fate], policy: Policy) -> None:
    """Reject fates for links that the policy does not have, and values of another type."""
    instance("fates", fates, Mapping)
    links = [step.link for step in policy.steps if isinstance(step, Send)]
    for link, fate in fates.items():
        if link not in links:
            raise ProblemError(f"fates has the link {link!r}; expected links of {policy.kind}: {', '.join(links)}")
        instance(f"fates[{link!r}]", fate, Fate)


def _other_links(fates: Mapping[str, Fate], stated: Mapping[str, Fate]) -> tuple[str, ...]:
    """Return the links whose losses, delays or changes of packets differ from those of the network."""
    other = [link for link, fate in fates.items() if replace(fate, seed=stated[link].seed) != stated[link]]
    return tuple(f"the {link} link treats packets differently from the network of the design" for link in other)


def kernel_losses(network: Network, seed: int) -> dict[str, KernelLoss]:
    """Return the losses that the kernel applies on each link of a network.

    Raises:
        ProblemError: losses come in bursts, or are not an integer number of permille.
    """
    found: dict[str, KernelLoss] = {}
    for link, fate in losses(network, seed).items():
        if fate.burst is not None:
            raise ProblemError(
                f"{network.key(link, 'burst')} is given, but the kernel cannot drop packets in bursts; expected "
                f"{network.key(link, 'loss')}"
            )
        permille = round(1000 * fate.loss)
        if abs(permille - 1000 * fate.loss) > 1e-9:
            raise ProblemError(
                f"{network.key(link, 'loss')} is {fate.loss:g}; expected a multiple of 0.001, the kernel's resolution"
            )
        found[link] = KernelLoss(fate.seed & 0xFFFFFFFF, permille)  # of 32 bits
    return found


def _disturbed(server: PlantServer, ticks: int, processes: Processes, meanwhile: Callable[[Processes], None]) -> None:
    """Run the plant while a function disturbs the nodes in a thread; an exception in this thread ends the run."""
    with ThreadPoolExecutor(1) as pool:
        disturbance = pool.submit(meanwhile, processes)
        server.run(ticks, lambda: disturbance.done() and (disturbance.exception() is not None or processes.ended()))
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
        f"the {link} link dropped {counted['lost']} packets, but {counted['predicted']} were predicted"
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


def _shown(progress: Progress, ticks: int) -> Callable[[Mapping[str, Any]], None]:
    return lambda line: progress((line["tick"] + 1) / ticks)
