"""Dead bands: each node sends a value that has changed by more than Δ since it was sent, with any linear controller.

The receiver holds the last value. So in silence it uses the true value plus an error of at most Δ in each entry, of the
length Δ√p for p entries. The loop is linear: its cost output is that of sending every sample plus the effects of the
errors of all links. With the H∞ norm γ_l from the error of link l to the root of the stage cost (``lqg/gain``), the
norms add up at most,

    √J ≤ √J_b + Σ_l γ_l Δ_l,   J_b the cost of the same controller with every sample,

for any noise, and for errors of any cause within Δ. So the certificate is conservative.

``DeadBands`` makes the steps of the sensors, and of a controller that sends to actuators. The control between them is
LQG with a filtered estimate (``FilteredSteps``) or a given controller (``Given``).

Source: miskowicz2006
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import sqrt
from typing import Protocol

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.base.filter import ESTIMATE, HELD, SEND
from taciturn.base.given_controller import GivenLoop, SameControl
from taciturn.base.route import nonempty
from taciturn.base.value import Base, advantage
from taciturn.design.bounds import bound_by_errors, shares_of
from taciturn.errors import ProblemError
from taciturn.lqg.gain import largest_gain
from taciturn.model.controller import AnyController, Controller
from taciturn.model.cost import Cost
from taciturn.model.coverage import THEORY
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import Assign, Decide, Received, Send, Step
from taciturn.model.theory import ErrorGain, Theory
from taciturn.model.trigger import Form, Trigger

LAST, HEARD, REGISTER = "last", "heard", "register"


def given_at_nodes(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    kept: AnyController,
    delta: float,
    shares: Mapping[str, float],
    network: Network,
) -> Policy:
    """Return the policy of a given controller in a network of one's own, with a dead band on each link."""
    loop = GivenLoop.of(plant, cost, period, kept)
    plant = loop.problem.plant
    if plant.saturation is not None or loop.point.moved:
        limit = "input_rate" if plant.input_limit is None else "input_limit"
        got = "the controller has a set-point" if plant.saturation is None else f"plant.{limit} is given"
        raise ProblemError(
            f"{got}, and packets are sent on {len(network.links)} links; expected inputs without limits and a "
            "controller without set-point and start, or one link"
        )
    bands, control = DeadBands(network, plant, delta, shares), GivenSteps(loop.controller)
    initial, base = bands.begun(plant.C @ plant.mean), loop.every_sample()
    policy = policy_of_loop(kind, loop, base, bands.steps(control), bands.sites, initial, network, bands.errors(base))
    return replace(policy, theory=replace(policy.theory, covers=policy.theory.covers | THEORY, periodic=None))


def policy_of_loop(
    kind: str,
    loop: GivenLoop,
    base: Base,
    steps: tuple[Step, ...],
    sites: tuple[frozenset[str], ...],
    initial: dict[str, Array],
    network: Network | None = None,
    errors: Mapping[str, ErrorGain] | None = None,
    functions: frozenset[str] = frozenset(),
) -> Policy:
    """Return a policy without a proven bound, or with the certificate that follows from the errors of its links."""
    found, problem = advantage(base, loop.remedy), loop.problem
    claims = Theory(
        cost_lqg=loop.cost_lqg,
        guarantee=bound_by_errors(problem, found.cost, errors) if errors else None,
        errors=errors or {},
        functions=functions,
        periodic=SameControl(problem, loop.kept, base),
    )
    return loop.nominal(found.cost, found.settling, base).policy(
        kind,
        steps,
        loop.point.begun(steps, initial),
        claims,
        sites=sites,
        network=network,
        notes=(*loop.beside_lqg(found.cost), *loop.notes),
    )


class Control(Protocol):
    """The policy steps of a controller, in terms of the measurements that it uses and the inputs that are applied."""

    def before(self, at: str, used: Mapping[str, Array]) -> tuple[Step, ...]:
        """Return the steps before the command, at a node."""
        ...

    def command(self, rows: list[int], used: Mapping[str, Array]) -> Mapping[str, Array]:
        """Return some entries of the command as a sum of signals."""
        ...

    def after(self, at: str, used: Mapping[str, Array], held: Mapping[str, Array]) -> tuple[Step, ...]:
        """Return the steps after the packets to the actuators, at a node."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class FilteredSteps(Displayed):
    """Feedback of a filtered estimate."""

    plant: Plant  # the plant from step to step
    gain: Array  # gain of the filter, (n, p)
    L: Array  # gain of the regulator, (m, n)

    @property
    def controller(self) -> Controller:
        """The same feedback in state space; the state is the predicted estimate."""
        left = np.eye(self.plant.states) - self.gain @ self.plant.C
        A, B, L = self.plant.A, self.plant.B, self.L
        return Controller(A @ left, A @ self.gain, L @ left, L @ self.gain, B, self.plant.dt)

    def before(self, at: str, used: Mapping[str, Array]) -> tuple[Step, ...]:
        """Correct the prediction by the measurements."""
        return (
            Assign(at, "innovation", {**used, "prior": -self.plant.C}),
            Assign(at, ESTIMATE, {"prior": np.eye(self.plant.states), "innovation": self.gain}),
        )

    def command(self, rows: list[int], used: Mapping[str, Array]) -> Mapping[str, Array]:
        """Return L x̂."""
        return {ESTIMATE: self.L[rows]}

    def after(self, at: str, used: Mapping[str, Array], held: Mapping[str, Array]) -> tuple[Step, ...]:
        """Predict the state at the next step."""
        moved = {name: self.plant.B @ columns for name, columns in held.items()}
        return (Assign(at, "prior", {ESTIMATE: self.plant.A, **moved}),)


@dataclass(frozen=True, eq=False, repr=False)
class GivenSteps(Displayed):
    """A given controller."""

    controller: Controller  # the controller at the step of the policy

    def before(self, at: str, used: Mapping[str, Array]) -> tuple[Step, ...]:
        """Compute nothing before the command."""
        return ()

    def command(self, rows: list[int], used: Mapping[str, Array]) -> Mapping[str, Array]:
        """Return C z + D y."""
        c = self.controller
        return nonempty({REGISTER: c.C[rows], **{name: c.D[rows] @ columns for name, columns in used.items()}})

    def after(self, at: str, used: Mapping[str, Array], held: Mapping[str, Array]) -> tuple[Step, ...]:
        """Move the state of the controller."""
        c = self.controller
        if not len(c.A):
            return ()
        moved = {name: c.B @ columns for name, columns in used.items()}
        moved |= {name: c.E @ columns for name, columns in held.items()}
        return (Assign(at, REGISTER, {REGISTER: c.A, **moved}),)


class ErrorGains:
    """The H∞ norms from errors of measurements and of inputs to the root of the stage cost, with every sample sent."""

    def __init__(self, base: Base) -> None:
        """Close the loop."""
        self._base = base
        values, vectors = np.linalg.eigh(base.stage)
        root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
        size = len(base.Phi)
        self._closed, self._output = base.Phi + base.Gamma @ base.K, root[:, :size] + root[:, size:] @ base.K
        self._chosen = root[:, size:]

    def of_measurement(self, outputs: int, at: Sequence[int]) -> float:
        """Return the gain from errors of some of the outputs that the controller uses."""
        rows = [len(self._closed) - outputs + i for i in at]
        return largest_gain(self._closed, self._closed[:, rows], self._output, self._output[:, rows])

    def of_choice(self, at: Sequence[int]) -> float:
        """Return the gain from errors of some of the inputs."""
        columns = [*at]
        return largest_gain(self._closed, self._base.Gamma[:, columns], self._output, self._chosen[:, columns])


def errors_of_one(loop: GivenLoop, link: str, delta: float) -> dict[str, ErrorGain]:
    """Return gain and largest error of the one link of a given controller; none if its inputs have limits."""
    plant = loop.problem.plant
    if plant.saturation is not None:  # the loop is not linear
        return {}
    size = plant.outputs if link == "sensor" else plant.inputs
    gains = ErrorGains(loop.every_sample())
    gain = gains.of_measurement(size, range(size)) if link == "sensor" else gains.of_choice(range(size))
    return {link: ErrorGain(gain, delta * sqrt(size))}


class DeadBands:
    """The policy steps of sensors and of a controller, each of which sends a value that has changed by more than Δ."""

    def __init__(self, network: Network, plant: Plant, delta: float, shares: Mapping[str, float]) -> None:
        """Find what each node measures and applies; of the usual nodes, the actuator is at the controller's place."""
        self._network, self._plant = network.beside("actuator"), plant
        self._suffixed = self._network is network  # signals of the usual nodes have names without the node's
        links = [*self._network.links]
        self._bands = {link: delta * share for link, share in shares_of(shares, links).items()}
        self._measured = network.measurements(plant.outputs).items()
        self._applied = network.applications(plant.inputs).items()
        self.sites = self._network.sites_of_controller

    @property
    def of_outputs(self) -> Array:
        """Δ of each output; 0 for those that are measured at the controller's place."""
        found = np.zeros(self._plant.outputs)
        for _, (node, outputs) in self._measured:
            found[[*outputs]] = self._bands.get(node, 0.0)
        return found

    def steps(self, control: Control) -> tuple[Step, ...]:
        """Return all policy steps, with those of the controller."""
        at, plant = self._network.controller, self._plant
        used = {self._used(signal, node): np.eye(plant.outputs)[:, [*held]] for signal, (node, held) in self._measured}
        inputs = np.eye(plant.inputs)
        held = {self._named(HELD, node): inputs[:, [*rows]] for _, (node, rows) in self._applied}
        return (
            *(step for signal, (node, held) in self._measured for step in self._sensor(signal, node, len(held))),
            *control.before(at, used),
            *(
                step
                for signal, (node, rows) in self._applied
                for step in self._actuator(signal, node, control.command([*rows], used), len(rows))
            ),
            *control.after(at, used, held),
        )

    def begun(self, measurement: Array) -> dict[str, Array]:
        """Return the initial values of all memories of measurements, for the one that is expected first."""
        return {
            name: measurement[[*held]]
            for signal, (node, held) in self._measured
            if node in self._bands
            for name in (self._named(LAST, node), self._used(signal, node))
        }

    def errors(self, base: Base) -> dict[str, ErrorGain]:
        """Return the gain and the largest error of each link, for the loop that sends every sample."""
        gains, found = ErrorGains(base), dict[str, ErrorGain]()
        for _, (node, outputs) in self._measured:
            if node in self._bands:
                found[node] = ErrorGain(
                    gains.of_measurement(self._plant.outputs, outputs), self._longest(node, outputs)
                )
        for _, (node, inputs) in self._applied:
            if node in self._bands:
                found[node] = ErrorGain(gains.of_choice(inputs), self._longest(node, inputs))
        return found

    def _longest(self, link: str, entries: Sequence[int]) -> float:
        """Return the largest length of an error whose entries are at most Δ."""
        return self._bands[link] * sqrt(len(entries))

    def _sensor(self, signal: str, node: str, size: int) -> tuple[Step, ...]:
        if node not in self._bands:
            return ()
        heard, unit = self._used(signal, node), np.eye(size)
        receives = Assign(self._network.controller, heard, ({heard: unit}, {signal: unit}), Received(node))
        return (*self._decide(node, node, signal, "output", size), receives)

    def _actuator(self, signal: str, node: str, terms: Mapping[str, Array], size: int) -> tuple[Step, ...]:
        at, unit = self._network.controller, np.eye(size)
        command, held = self._named("command", node), self._named(HELD, node)
        if node not in self._bands:
            return (
                Assign(at, command, terms),
                Assign(node, signal, {command: unit}),
                Assign(at, held, {command: unit}),
            )
        return (
            Assign(at, command, terms),
            *self._decide(at, node, command, "input", size, held),
            Assign(node, signal, ({signal: unit}, {command: unit}), Received(node)),
        )

    def _decide(
        self, at: str, link: str, signal: str, entry: str, size: int, last: str | None = None
    ) -> tuple[Step, ...]:
        """Return the steps that send a signal if one of its entries has changed by more than Δ since the last send."""
        unit, last = np.eye(size), self._named(LAST, link) if last is None else last
        moved, on = self._named("moved", link), self._named(SEND, link)
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
        return f"{name}_{node}" if self._suffixed else name
