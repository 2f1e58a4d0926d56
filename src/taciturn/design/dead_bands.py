"""Dead bands for any linear controller: a node sends a value if it differs by more than Δ from the value last sent.

The receiver holds the last value. So in silence it uses the true value plus an error of at most Δ in each entry, of the
length Δ√p for p entries. The loop is linear: its cost output is that of sending every sample plus the effects of the
errors of all links. With the H∞ norm γ_l from the error of link l to the root of the stage cost (``lqg/gain``), the
norms add up at most,

    √J ≤ √J_b + Σ_l γ_l Δ_l,   J_b the cost of the same controller with every sample,

for any noise, and for errors of any cause within Δ. So the certificate is conservative.

``DeadBands`` is the rule of the links of ``around_controller``. The control between them is LQG with a filtered
estimate or a given controller.

Source: miskowicz2006
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import sqrt

import numpy as np

from taciturn._arrays import Array
from taciturn._text import number_of
from taciturn.base.filter import SEND
from taciturn.base.given_controller import GivenLoop, SameControl
from taciturn.base.value import Base
from taciturn.design.around_controller import Around, GivenSteps, Silenced
from taciturn.design.bounds import bound_by_errors, shares_of
from taciturn.errors import ProblemError
from taciturn.lqg.gain import largest_gain
from taciturn.model.controller import AnyController
from taciturn.model.cost import Cost
from taciturn.model.coverage import THEORY
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import Condition, Decide, Step
from taciturn.model.theory import ErrorGain, Theory
from taciturn.model.trigger import Form, Trigger


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
    """Return the policy of a given controller in a network of user-defined nodes, with a dead band on each link."""
    loop = GivenLoop.of(plant, cost, period, kept)
    plant = loop.problem.plant
    if plant.saturation is not None or loop.point.moved:
        limit = "input_rate" if plant.input_limit is None else "input_limit"
        got = "the controller has a set-point" if plant.saturation is None else f"plant.{limit} is given"
        raise ProblemError(
            f"the policy sends packets on {number_of(len(network.links), 'link')}, but {got}; expected inputs "
            "without limits and a controller without set-point and start_input, or a network with one link"
        )
    bands, control = DeadBands(network, plant, delta, shares), GivenSteps(loop.controller, plant)
    around, base = bands.around, loop.every_sample()
    initial, steps = around.begun(plant.C @ plant.mean), around.steps(control)
    policy = policy_of_loop(kind, loop, base, steps, around.sites, initial, network, bands.errors(base))
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
    """Return the policy of a loop with a given controller. If the errors of its links are bounded, so is its cost."""
    (found, whole), problem = loop.value(base), loop.problem
    claims = Theory(
        cost_lqg=loop.cost_lqg,
        guarantee=bound_by_errors(problem, whole, errors) if errors else None,
        errors=errors or {},
        functions=functions,
        periodic=SameControl(loop, base),
    )
    return loop.nominal(whole, found.settling, base).policy(
        kind,
        steps,
        loop.point.begun(steps, initial),
        claims,
        sites=sites,
        network=network,
        notes=(*loop.beside_lqg(whole), *loop.notes),
    )


class ErrorGains:
    """Computes H∞ norms from errors of measurements or inputs to the root of the stage cost, if all samples are
    sent.
    """

    def __init__(self, base: Base) -> None:
        """Close the loop."""
        self._base = base
        values, vectors = np.linalg.eigh(base.stage)
        root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
        size = len(base.Phi)
        self._closed, self._output = base.Phi + base.Gamma @ base.K, root[:, :size] + root[:, size:] @ base.K
        self._chosen = root[:, size:]

    def of_measurement(self, outputs: int, at: Sequence[int]) -> float:
        """Return the H∞ norm from errors of the outputs ``at`` to the root of the stage cost."""
        rows = [len(self._closed) - outputs + i for i in at]
        return largest_gain(self._closed, self._closed[:, rows], self._output, self._output[:, rows])

    def of_choice(self, at: Sequence[int]) -> float:
        """Return the H∞ norm from errors of the inputs ``at`` to the root of the stage cost."""
        columns = [*at]
        return largest_gain(self._closed, self._base.Gamma[:, columns], self._output, self._chosen[:, columns])


def errors_of_one(loop: GivenLoop, link: str, delta: float) -> dict[str, ErrorGain]:
    """Return H∞ norm and largest error of the loop's only link, by its name; empty if the inputs have limits."""
    plant = loop.problem.plant
    if plant.saturation is not None:  # the loop is not linear
        return {}
    size = plant.sensed if link == "sensor" else plant.inputs
    gains = ErrorGains(loop.every_sample())
    gain = gains.of_measurement(plant.outputs, range(size)) if link == "sensor" else gains.of_choice(range(size))
    return {link: ErrorGain(gain, delta * sqrt(size))}


class DeadBands:
    """Dead-band rule: a link sends if an entry of its signal differs by more than Δ from the value last sent."""

    def __init__(self, network: Network, plant: Plant, delta: float, shares: Mapping[str, float]) -> None:
        """Find the dead band of each link."""
        self._measured = network.measurements(plant.sensed, plant.set_points).values()
        self._applied = network.applications(plant.inputs).values()
        self._suffixed = network.own_nodes  # signals of the usual nodes have names without the node's
        self._outputs = plant.outputs
        # of the usual nodes, the actuator is at the controller's place
        nodes = network.beside("actuator")
        self.bands = {link: delta * share for link, share in shares_of(shares, [*nodes.links]).items()}
        self.around = Around(nodes, plant, self, suffixed=self._suffixed)

    @property
    def of_outputs(self) -> Array:
        """Threshold Δ of each output. It is 0 for an output that is measured at the controller's site."""
        found = np.zeros(self._outputs)
        for node, outputs in self._measured:
            found[[*outputs]] = self.bands.get(node, 0.0)
        return found

    def errors(self, base: Base) -> dict[str, ErrorGain]:
        """Return, for each link, its largest error and the H∞ norm from this error, in the loop that sends every
        sample.
        """
        gains, found = ErrorGains(base), dict[str, ErrorGain]()
        for node, outputs in self._measured:
            if node in self.bands:
                gain = gains.of_measurement(self._outputs, outputs)
                found[node] = ErrorGain(gain, self._longest(node, outputs))
        for node, inputs in self._applied:
            if node in self.bands:
                found[node] = ErrorGain(gains.of_choice(inputs), self._longest(node, inputs))
        return found

    def _longest(self, link: str, entries: Sequence[int]) -> float:
        """Return the largest length of an error whose entries are at most Δ."""
        return self.bands[link] * sqrt(len(entries))

    def decision(self, links: Sequence[Silenced]) -> str:
        """Return the name of the decision whether to send on a link."""
        return f"{SEND}_{links[0].link}" if self._suffixed else SEND

    def decide(self, at: str, links: Sequence[Silenced]) -> tuple[Step, ...]:
        """Return the decision whether to send: yes if an entry of the signal differs by more than Δ from the value last
        sent.
        """
        (one,) = links
        square = self.bands[one.link] ** 2
        options = {
            f"{one.entry} {i}": Form((one.moved,), -np.diag(row), square) for i, row in enumerate(np.eye(one.size))
        }
        return (Decide(at, self.decision(links), Trigger({"silent": Form(), **options})),)

    def sends(self, links: Sequence[Silenced]) -> Sequence[tuple[str, frozenset[str]]]:
        """Return the labels of the decision: one for not sending, and one for each entry whose change causes a send."""
        (one,) = links
        sent = frozenset({one.link})
        return (("silent", frozenset()), *((f"{one.entry} {i}", sent) for i in range(one.size)))

    def after(self, at: str, links: Sequence[Silenced], told: Condition) -> tuple[Step, ...]:
        """Return no policy steps, because this rule stores nothing except the value last sent."""
        return ()
