"""Send-on-delta: the sensor sends when an output has changed by more than a threshold since the last send."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from taciturn._arrays import Array, instance, number
from taciturn.design.bounds import LARGEST_PARAMETER
from taciturn.design.certainty import SEND, design_certainty, expect_average
from taciturn.design.contributions import decision
from taciturn.design.estimation import ESTIMATE, HELD
from taciturn.design.kept import lqg_observer
from taciturn.design.kept_loop import KeptLoop
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.design.routes import route_over
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import steady_filter
from taciturn.model.cost import Cost
from taciturn.model.coverage import GAUSSIAN_THEORY, THEORY
from taciturn.model.kept import controller_from
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Assign, Decide, Evaluate, Policy, Received, Send, Step
from taciturn.model.theory import Theory
from taciturn.model.trigger import Form, Trigger

LAST, HEARD, WHICH = "last", "heard", "changed"


def send_on_delta(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    delta: float,
    period: float | None = None,
    controller: object = None,
    link: str = "sensor",
    shares: dict[str, float] | None = None,
    network: Network | None = None,
) -> Policy:
    """Design LQG control whose sensor sends if and only if an output has changed by more than Δ since the last send.

    The controller, at the actuator, filters the last outputs sent as if they were measured at the current step. The
    filter models the change since the send as an additional error, uniform in ±Δ: it is the steady-state Kalman filter
    for the measurement noise V + (Δ²/3) I [suh2007]. A given ``controller`` uses the last outputs sent. With ``link =
    "actuator"``, the controller sends its command when an input has changed by more than Δ.

    In a network with nodes of one's own, each sensor with a link sends its outputs if one of them has changed by more
    than Δ times the share of its link, and the controller likewise sends its command to each actuator with a link,
    which holds its input.

    Args:
        plant: the plant.
        cost: the average cost.
        delta: threshold Δ ≥ 0, in the units of the outputs, or of the inputs.
        period: seconds between steps; only with a continuous plant.
        controller: a linear controller to keep, or an object that ``controller_from`` converts; default: LQG.
        link: ``"sensor"``: measurements are sent; ``"actuator"``: commands of a controller at the sensor's site.
        shares: factor of Δ for each link of a network with nodes of one's own; default 1 for each that is not listed.
        network: the nodes; default: a sensor, and a controller at the place of the actuator. Links must be ideal.

    Returns:
        The policy; no bound on its cost is known.

    Raises:
        ProblemError: if Δ < 0, period is missing or not applicable, a share is given for another link, or links drop
            or delay packets.
        UnstableError: if no stabilising gain or filter exists.

    Source: miskowicz2006, suh2007

    Example:
        >>> plant, cost = Plant([[0.9]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
        >>> send_on_delta(plant, cost, delta=1.0).scheduled
        ('sensor',)
    """
    delta = number("delta", delta, 0.0, LARGEST_PARAMETER, closed=True)
    network = Network() if network is None else network
    instance("network", network, Network)
    if network.unusual:
        raise ProblemError(
            f"{network.unusual[0]} is given, which send-on-delta does not use; expected ideal links: remove it"
        )
    if controller is not None or link != "sensor":
        if shares:
            raise ProblemError("shares is given with a controller or a link; expected shares with LQG only")
        return _keep("send-on-delta", plant, cost, period, controller, delta, link)
    problem = discretise(plant, cost, period)
    certainty, plant = design_certainty("send-on-delta", problem), problem.plant
    bands = DeadBands(network, plant, delta, shares or {})
    steady = steady_filter(plant.A, plant.C, plant.W, plant.V + np.diag(bands.of_outputs**2 / 3))
    return Policy(
        kind="send-on-delta",
        steps=bands.steps(steady.gain, certainty.regulator.L),
        model=plant,
        theory=Theory(
            cost=problem.cost,
            cost_all_time=problem.per_unit(certainty.cost_all_time),
            noise_cost=problem.noise_cost,
            settling=1 / (1 - max(certainty.regulator.slowest, steady.slowest)),
            covers=THEORY if plant.full_state else GAUSSIAN_THEORY,
        ),
        sites=bands.sites,
        initial={"prior": plant.mean},
        tick=problem.tick,
        network=Network(nodes=network.nodes),
    )


def _keep(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    controller: object,
    delta: float,
    link: str,
) -> Policy:
    """Return the policy that sends when the value that a given controller needs, or its command, has changed by Δ."""
    expect_average(kind, cost)
    kept = lqg_observer(kind, discretise(plant, cost, period)) if controller is None else controller_from(controller)
    loop = KeptLoop.of(plant, cost, period, kept)
    route = route_over(link, loop.problem, loop.controller, "hold", False, start=loop.point.start)
    size = len(route.base.K)
    moved = {f"entry {i}": Form(("error",), -np.diag(row), delta**2) for i, row in enumerate(np.eye(size))}
    decide = (
        Decide(route.node, WHICH, Trigger({"none": Form(), **moved})),
        Evaluate(route.node, "any", tuple(Form(constant=float(i > 0)) for i in range(size + 1)), WHICH),
        Decide(route.node, SEND, Trigger({"silent": Form(plus={"any": 1.0}), SEND: Form(constant=0.5)})),
    )
    steps = route.steps({"y": np.eye(loop.problem.plant.outputs)}, decide, ())
    return loop.policy(kind, route.base, steps, route.sites, route.initial)


class DeadBands:
    """The policy steps of sensors and of a controller, each of which sends a value that has changed by more than Δ.

    Args:
        network: the nodes. In the network of three nodes, the controller is at the place of the actuator.
        plant: the plant from step to step.
        delta: Δ.
        shares: factor of Δ by link.

    Raises:
        ProblemError: a share is given for another link.
    """

    def __init__(self, network: Network, plant: Plant, delta: float, shares: Mapping[str, float]) -> None:
        """Find what each node measures and applies."""
        self._network, self._plant = network, plant
        wired = set(network.actuators) if network.triangle else set[str]()
        self._links = [link for link in network.links if link not in wired]
        for link in shares.keys() - {*self._links}:
            raise ProblemError(f"shares has the link {link!r}; expected links that send: {', '.join(self._links)}")
        self._bands = {
            link: delta * number(f"shares.{link}", shares.get(link, 1.0), 0.0, LARGEST_PARAMETER, closed=True)
            for link in self._links
        }
        self._measured = network.measurements(plant.outputs).items()
        self._applied = network.applications(plant.inputs).items()
        at = network.controller
        self.sites = (frozenset({at, *wired}),) if network.triangle else network.sites_of_controller

    @property
    def of_outputs(self) -> Array:
        """Δ of each output; 0 for those that are measured at the controller's place."""
        found = np.zeros(self._plant.outputs)
        for _, (node, outputs) in self._measured:
            found[[*outputs]] = self._bands.get(node, 0.0)
        return found

    def steps(self, gain: Array, L: Array) -> tuple[Step, ...]:
        """Return all policy steps for the gains of the filter and of the regulator."""
        at, plant = self._network.controller, self._plant
        used = {self._used(signal, node): np.eye(plant.outputs)[:, [*held]] for signal, (node, held) in self._measured}
        inputs = np.eye(plant.inputs)
        held = {self._named(HELD, node): inputs[:, [*rows]] for _, (node, rows) in self._applied}
        return (
            *(step for signal, (node, held) in self._measured for step in self._sensor(signal, node, len(held))),
            Assign(at, "innovation", {**used, "prior": -plant.C}),
            Assign(at, ESTIMATE, {"prior": np.eye(plant.states), "innovation": gain}),
            *(step for signal, (node, rows) in self._applied for step in self._actuator(signal, node, L[[*rows]])),
            Assign(at, "prior", {ESTIMATE: plant.A, **{name: plant.B @ columns for name, columns in held.items()}}),
        )

    def _sensor(self, signal: str, node: str, size: int) -> tuple[Step, ...]:
        if node not in self._bands:
            return ()
        heard, unit = self._used(signal, node), np.eye(size)
        receives = Assign(self._network.controller, heard, ({heard: unit}, {signal: unit}), Received(node))
        return (*self._decide(node, node, signal, "output", size), receives)

    def _actuator(self, signal: str, node: str, L: Array) -> tuple[Step, ...]:
        at, unit = self._network.controller, np.eye(len(L))
        command, held = self._named("command", node), self._named(HELD, node)
        if node not in self._bands:
            return (
                Assign(at, command, {ESTIMATE: L}),
                Assign(node, signal, {command: unit}),
                Assign(at, held, {command: unit}),
            )
        return (
            Assign(at, command, {ESTIMATE: L}),
            *self._decide(at, node, command, "input", len(L), held),
            Assign(node, signal, ({signal: unit}, {command: unit}), Received(node)),
        )

    def _decide(
        self, at: str, link: str, signal: str, entry: str, size: int, last: str | None = None
    ) -> tuple[Step, ...]:
        """Return the steps that send a signal if one of its entries has changed by more than Δ since the last send."""
        unit, last = np.eye(size), self._named(LAST, link) if last is None else last
        moved, on = self._named("moved", link), SEND if self._network.triangle else decision((link,))
        options = {f"{entry} {i}": Form((moved,), -np.diag(row), self._bands[link] ** 2) for i, row in enumerate(unit)}
        return (
            Assign(at, moved, {signal: unit, last: -unit}),
            Decide(at, on, Trigger({"silent": Form(), **options})),
            Send(at, link, (signal,), on),
            Assign(at, last, ({last: unit}, *([{signal: unit}] * size)), on),
        )

    def _used(self, signal: str, node: str) -> str:
        """Return the signal that the controller uses as a measurement."""
        return self._named(HEARD, node) if node in self._bands else signal

    def _named(self, name: str, node: str) -> str:
        return name if self._network.triangle else f"{name}_{node}"


KIND = Kind(
    name="send-on-delta",
    design=send_on_delta,
    goal="a simple sensor that sends when an output has changed by Δ",
    tuning=(TradeoffParameter("delta"),),
    example={"delta": 0.2},
    nodes="S, C+A",
    data="memories `last` at S and `heard` at C; one label per output",
    order="compare y with the last sent value, decide, send y, filter, input",
    offered=6,
    keeps_controller=True,
    several_nodes=True,
    ideal_links=True,
    shares="shares",
)
