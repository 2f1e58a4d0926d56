"""Send-on-delta: the sensor sends when an output differs by more than a threshold from the value last sent.

A silent output is known within ±Δ. LQG control treats this as additional measurement noise of the variance Δ²/3, as of
a uniform distribution, and filters the last value in every step. A given controller uses the last value. Both loops are
those of sending every sample, with a bounded error in the measurement, so √J ≤ √J_b + Σγ_lΔ_l (``design/dead_bands``).

Source: miskowicz2006, suh2007
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from taciturn._arrays import Array, Bits, number
from taciturn.base.certainty import (
    CertaintyEquivalentDesign,
    design_certainty,
    expect_average,
    expect_constant_set_points,
)
from taciturn.base.filter import SEND
from taciturn.base.given_controller import GivenLoop, lqg_observer
from taciturn.base.nominal import Nominal
from taciturn.base.route import actuator_base, route_over
from taciturn.base.value import least_value
from taciturn.design.around_controller import FilteredSteps
from taciturn.design.bounds import LARGEST_PARAMETER, bound_by_errors
from taciturn.design.dead_bands import DeadBands, errors_of_one, given_at_nodes, policy_of_loop
from taciturn.design.kind import Kind, TradeoffParameter, on_any_network
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.kalman import resting_states, steady_filter
from taciturn.model.controller import AnyController, controller_from
from taciturn.model.cost import Cost
from taciturn.model.coverage import THEORY
from taciturn.model.network import IDEAL, Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import Decide, Evaluate
from taciturn.model.theory import Theory
from taciturn.model.trigger import Form, Trigger

WHICH = "changed"


@on_any_network
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

    In a network with named nodes, each sensor with a link sends its outputs if one of them has changed by more
    than Δ times the share of its link, and the controller likewise sends its command to each actuator with a link,
    which holds its input. This also holds for a given ``controller``, which then uses the last outputs received.

    Args:
        plant: the plant.
        cost: the average cost.
        delta: threshold Δ ≥ 0, in the units of the outputs, or of the inputs.
        period: seconds between steps; only with a continuous plant.
        controller: a linear controller to keep, or an object that ``controller_from`` converts; default: LQG.
        link: ``"sensor"``: measurements are sent; ``"actuator"``: commands of a controller at the sensor's site.
        shares: factor of Δ for each link of a network with named nodes; default 1 for each that is not listed.
        network: the nodes; default: a sensor, and a controller at the place of the actuator. Links must be ideal.

    Returns:
        The policy, with a certificate √J ≤ √J_b + Σγ_lΔ_l for any noise: J_b is the cost of the same controller with
        every sample, γ_l the gain from the error of link l to the cost, and Δ_l the largest error.

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
    network = network or IDEAL
    chosen = network.beside("actuator" if link == "sensor" else "sensor")
    own = chosen is network  # of the usual nodes, only the one that ``link`` names has a link
    shares, links = shares or {}, list(chosen.links)
    if own and link != "sensor":
        raise ProblemError(
            f"link = {link!r} is given for a network with named nodes; expected no link, because each link of such a "
            "network has a dead band"
        )
    if controller is None and link == "sensor":
        return _filter(plant, cost, period, delta, shares, network)
    expect_average("send-on-delta", cost)
    kept = None if controller is None else controller_from(controller)
    # the sensor does not know set-points that change, so it compares outputs alone, as each of several nodes does
    apart = link == "sensor" and plant.exosystem is not None and not shares
    if kept is not None and (len(links) > 1 or apart):
        return given_at_nodes("send-on-delta", plant, cost, period, kept, delta, shares, network)
    if shares:
        raise ProblemError(
            "shares is given with a controller and one link; expected shares with several links"
            if own
            else "shares is given with a controller or a link; expected shares with LQG, or with nodes"
        )
    if own:
        link = "actuator" if any(network.nodes[one].applies for one in links) else "sensor"
    return _keep(plant, cost, period, kept, delta, link)


def _filter(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    delta: float,
    shares: Mapping[str, float],
    network: Network,
) -> Policy:
    """Return LQG control of the values that were sent last."""
    problem = discretise(plant, cost, period)
    expect_constant_set_points("send-on-delta", problem.plant)
    certainty, plant = design_certainty("send-on-delta", problem), problem.plant
    bands = DeadBands(network, plant, delta, shares)
    steady = steady_filter(plant.A, plant.C, plant.W, plant.V + np.diag(bands.of_outputs**2 / 3))
    filtered = FilteredSteps(plant, steady.gain, certainty.regulator.L)
    unknown = ~resting_states(plant)  # without set-points, which have no errors
    alone = FilteredSteps(problem.among(unknown).plant, steady.gain[unknown], certainty.regulator.L[:, unknown])
    base = actuator_base(problem.among(unknown), alone.controller)
    errors = bands.errors(base)
    settling = 1 / (1 - max(certainty.regulator.slowest, steady.slowest))
    return Nominal(problem, certainty.cost_all_time, settling, certainty.error).policy(
        "send-on-delta",
        bands.around.steps(filtered),
        {"prior": plant.mean},
        Theory(
            guarantee=bound_by_errors(problem, _with_every_sample(certainty, steady.gain, unknown), errors),
            errors=errors,
            covers=THEORY,
        ),
        sites=bands.around.sites,
        network=network,
    )


def _with_every_sample(certainty: CertaintyEquivalentDesign, gain: Array, unknown: Bits) -> float:
    """Return the cost per step with every sample of LQG whose filter has another gain, tr(KW) + E[e'L'HLe]."""
    # only the estimation error e is computed, whose modes decay; disturbances and set-points need not
    plant, place = certainty.problem.plant, np.ix_(unknown, unknown)
    A, C, G, square = plant.A[place], plant.C[:, unknown], gain[unknown], certainty.square[place]
    corrected, seen = np.eye(len(A)) - G @ C, G @ plant.V @ G.T
    prior, _ = least_value((A @ corrected).T, plant.W[place] + A @ seen @ A.T)
    after = corrected @ prior @ corrected.T + seen
    return float(np.sum(certainty.regulator.K * plant.W) + np.sum(square * after))


def _keep(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    controller: AnyController | None,
    delta: float,
    link: str,
) -> Policy:
    """Return the policy that sends when the value that a given controller needs, or its command, has changed by Δ."""
    kind = "send-on-delta"
    expect_average(kind, cost)
    kept = lqg_observer(kind, discretise(plant, cost, period)) if controller is None else controller
    loop = GivenLoop.of(plant, cost, period, kept, controller is None)
    route = route_over(link, loop.problem, loop.controller, "hold", False, start=loop.point.start, follows=False)
    size = len(route.base.K)
    moved = {f"entry {i}": Form(("error",), -np.diag(row), delta**2) for i, row in enumerate(np.eye(size))}
    decide = (
        Decide(route.node, WHICH, Trigger({"none": Form(), **moved})),
        Evaluate(route.node, "any", tuple(Form(constant=float(i > 0)) for i in range(size + 1)), WHICH),
        Decide(route.node, SEND, Trigger({"silent": Form(plus={"any": 1.0}), SEND: Form(constant=0.5)})),
    )
    steps = route.steps(decide)
    return policy_of_loop(
        kind, loop, route.base, steps, route.sites, route.initial, errors=errors_of_one(loop, link, delta)
    )


KIND = Kind(
    name="send-on-delta",
    design=send_on_delta,
    goal="a simple sensor that sends when an output has changed by Δ",
    tuning=(TradeoffParameter("delta"),),
    example={"delta": 0.2},
    follows=("constant",),
    proved=r"$\sqrt J\le\sqrt{J_b}+\sum_l\gamma_l\Delta_l$, a conservative certificate",
    relative_to="the same controller with every sample",
    nodes="S, C+A",
    data="memories `last` at S and `heard` at C; one label per output",
    order="compare y with the last sent value, decide, send y, filter, input",
    offered=6,
    keeps_controller=True,
    several_nodes=True,
    ideal_links=True,
    shares="shares",
)
