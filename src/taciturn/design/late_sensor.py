"""The rule "send when not sending costs more" over a sensor's link whose packets arrive after random delays.

The base sends every measurement. The controller hears packets at the beginning of its steps, uses the newest one that
it has, and holds it: u = C x_c + D ŷ. Each packet is acknowledged with the step that uses it, so that at its
next decision the sensor knows ŷ, and with it the state of the controller and the input. So the theory of late inputs
(``base/late``) holds with the measurement in place of the input: z = (x, x_c, y, y_{k−1}, …, y_{k−D}, ŷ), and a packet
is sent iff E[z'Ψ_I z] exceeds the price δ. The sensor's filter knows the inputs, so its estimate gives this mean.

Without a given controller, the controller is LQG with an observer that takes each ŷ for the present measurement.

Source: nilsson1998, antunes2014rollout
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.base.filter import ESTIMATE, HELD, SEND, estimate_state
from taciturn.base.given_controller import GivenLoop
from taciturn.base.late import Chain, chain_of, fourth_growth, late_value, periodic_cost
from taciturn.base.nominal import Nominal
from taciturn.base.periods import discrete_periods
from taciturn.base.route import MEASURED, NEXT, REGISTER, nonempty, sensor_base
from taciturn.design.bounds import bound_by_attempts
from taciturn.design.late_base import Receiver, Receivers, delays_of
from taciturn.design.late_flight import BELIEF, FlightSteps
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.discrete import Discrete
from taciturn.model.controller import AnyController
from taciturn.model.cost import Cost
from taciturn.model.coverage import BURSTS, GAUSSIAN_THEORY, LATE
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import Assign, Received, Send, Step
from taciturn.model.theory import INNOVATION, Identity, Theory
from taciturn.model.trigger import Form

LINK, KNOWN, USED = "sensor", "known", "used"


def tells_sensor(network: Network) -> bool:
    """Return whether packets of the sensor have random delays, and acknowledgements state the step that uses them."""
    return LINK in network.late and network.acknowledges(LINK)


def late_measurements(
    kind: str,
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    kept: AnyController,
    of_lqg: bool,
    price_at: Callable[[float], float],
    network: Network,
) -> Policy:
    """Return the policy of a sensor that sends iff silence costs more than the price, over a late link."""
    law, loop = network.links[LINK], GivenLoop.of(plant, cost, period, kept, of_lqg)
    refused = {
        "the cost has a horizon or a discount; expected an average cost": cost.mission,
        "plant.D is given; expected outputs without a direct feedthrough": plant.D is not None,
        "the set-points change; expected constant ones": loop.problem.plant.set_points > 0,
        "another link has a constant delay; expected no other delay": plant.transport is not None,
        "acknowledgements come one step late; expected them before the next step": law.acknowledgement_delay > 0,
    }
    for got in (got for got, holds in refused.items() if holds):
        raise ProblemError(
            f"{network.lateness(LINK)}, with acknowledgements, and {got}, or a link without acknowledgements"
        )
    problem, controller = loop.problem, loop.controller
    base, drawn = sensor_base(problem, controller), network.random_delay(LINK, problem.tick)
    assert drawn is not None, "the link delays packets at random"
    heard = drawn.at_steps()  # the controller runs once per step, so a part of a period is a whole one
    delays = delays_of(heard, network, LINK)
    n, q = base.Gamma.shape
    stage = np.split(base.stage, [n])
    (Q, N), (_, R) = (np.split(rows, [n], axis=1) for rows in stage)
    # the measurement that the controller holds is to this loop what the held input is to that over an actuator's link
    held = discrete_periods(base.Phi, base.Gamma, Q, R, N, base.noise)
    found = late_value(chain_of(held, np.hstack([base.K, np.zeros((q, q))]), delays), loop.remedy)
    price, fourth = price_at(found.cost), fourth_growth(found)
    only = Receiver(LINK, USED, [*range(q)], True, heard, delays)
    state = (ESTIMATE, *((REGISTER,) if len(controller.A) else ()), MEASURED)
    made = _SensorSteps(LINK, Receivers(network, (only,)), found, (0.0,), price, state, KNOWN, problem, loop)
    steps, initial = made.steps()
    claims = Theory(
        cost_lqg=loop.cost_lqg,
        guarantee=bound_by_attempts(problem, found.cost, price, 1, True, of_lqg) if fourth < 1 else None,
        identity=Identity(problem.per_unit(found.cost), (Form(plus={made.cost(()): 1.0 / problem.unit}), Form()), SEND),
        covers=GAUSSIAN_THEORY | LATE | BURSTS,
        functions=frozenset({BELIEF}),
        fourth=fourth,
        periodic=PeriodicMeasurements(found.chain),
    )
    settling = max(1 / (1 - found.growth), 1 / (1 - problem.filter().slowest))
    nominal = Nominal(problem, found.cost, settling, disturbance=loop.disturbance)
    sites = (frozenset({"controller", "actuator"}),)
    begun = loop.point.begun(steps, initial)
    policy = nominal.policy(kind, steps, begun, claims, sites=sites, network=network)
    return replace(policy, notes=(*policy.notes, *loop.notes))


@dataclass(frozen=True, eq=False, repr=False)
class PeriodicMeasurements(Displayed):
    """Computes the cost per step of packets at every q-th step, with the same delays, losses and controller."""

    chain: Chain

    def __call__(self, steps: int) -> float:
        """Return the cost."""
        cost = periodic_cost(self.chain, steps)
        if cost is None:
            raise UnstableError(f"periodic control is unstable with one packet in {number_of(steps, 'step')}")
        return cost


@dataclass(frozen=True, eq=False, repr=False)
class _SensorSteps(FlightSteps):
    """The policy steps of the sensor and of the controller. The sensor follows the controller by the packets heard."""

    problem: Discrete
    given: GivenLoop

    def steps(self) -> tuple[tuple[Step, ...], dict[str, Array]]:
        """Return the policy steps, and the initial values of their memories."""
        plant, c, at = self.problem.plant, self.given.controller, self.at
        k, unit, own = len(c.A), np.eye(plant.outputs), np.eye(len(c.A))
        estimation = estimate_state(plant, self.problem.filter(), at)
        measured = {ESTIMATE: plant.C} if plant.full_state else {"prior": plant.C, INNOVATION: unit}
        before: list[Step] = [*estimation.correct, Assign(at, MEASURED, measured)]
        if k:
            before.append(Assign(at, REGISTER, {NEXT: own}))
        before += self.in_flight_decisions()
        watched = self.watched()
        first = plant.C @ plant.mean  # what the controller uses until it hears a packet
        initial = {**estimation.initial, **watched.initial, KNOWN: first, USED: first}
        if k:
            initial |= dict.fromkeys((NEXT, "state"), self.given.point.start)
        (acting,) = self.pieced
        rest = [*self.acting(MEASURED), *self.tried(), *watched.after]
        rest += self.aged(MEASURED)
        rest.append(Assign(at, HELD, nonempty({REGISTER: c.C, acting: c.D})))
        if k:
            rest.append(Assign(at, NEXT, {REGISTER: c.A, acting: c.B, HELD: c.E}))
        rest += [*estimation.predict, Assign(at, KNOWN, {acting: unit})]
        return (*before, *watched.before, self.decision(), *self._used(), *rest), initial

    def _used(self) -> list[Step]:
        """Return the packet, and what the controller does with it."""
        plant, c = self.problem.plant, self.given.controller
        unit = np.eye(plant.outputs)
        found: list[Step] = [
            Send(self.at, LINK, (MEASURED,), SEND),
            Assign("controller", USED, ({USED: unit}, {MEASURED: unit}), Received(LINK)),
            Assign("controller", "command", nonempty({"state": c.C, USED: c.D})),
            Assign("actuator", "input", {"command": np.eye(plant.inputs)}),
        ]
        if len(c.A):
            found.append(Assign("controller", "state", {"state": c.A, USED: c.B, "command": c.E}))
        return found
