"""Policies for several sensors and actuators, with separate decisions on each link and one bound on the cost.

**In the mean**, for LQG and Gaussian noise. The Kalman filter of all measurements is linear, so its estimate is a sum
of contributions of single sensors. A sensor that is silent, or an actuator that holds, leaves an error in the input of
the loop. Let e = Σ_l e_l be its sum over the links l, each of which is silent only if e_l'He_l ≤ δ_l. By completion of
squares, and by Minkowski's inequality for the norm √E[e'He],

    J = J_all + E[e'He] ≤ J_all + (Σ_l √(δ_l(1 − r_l)))²,   r_l the rate of link l.

No link needs to know the errors of others. With dropouts, the identity holds if packets are acknowledged, but no bound.

**On every path**, for any linear controller and any noise (``design/every_path``). Sensors send their outputs, and the
controller its commands. Each node keeps the cost of its own silence within what is allowed, and

    √J ≤ √J_b + Σ_l √g_l

on every path and at every time, with the cost J_b of sending every sample on that path.

Source: khashooei2017
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from math import sqrt
from typing import Literal, TypeAlias

from taciturn._arrays import choice, flag
from taciturn.analyse.switched import MOST_LAWS, outcomes
from taciturn.base.certainty import AT_INSTANTS, Actuation, CertaintyEquivalentDesign, design_certainty
from taciturn.base.filter import ESTIMATE
from taciturn.base.nominal import Nominal
from taciturn.design.bounds import PULLED, threshold_of
from taciturn.design.every_path import RULES, Asked, RuleName, design_on_every_path, expect_few, weights_of
from taciturn.design.kind import Kind, TradeoffParameter, on_any_network
from taciturn.design.several_nodes import ContributionSteps, InputSteps
from taciturn.errors import ProblemError
from taciturn.loop import close
from taciturn.lqg.discrete import discretise
from taciturn.lqg.stored import Allowance
from taciturn.model.controller import controller_from
from taciturn.model.cost import Cost
from taciturn.model.coverage import BURSTS, GAUSSIAN_THEORY
from taciturn.model.network import IDEAL, Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.theory import Guarantee, Identity, Theory, rounded_up, with_silence
from taciturn.model.transport import promptly
from taciturn.model.trigger import Form

EXCESS = "input error"
MODES: tuple[Actuation, ...] = ("hold", "model")
ACKNOWLEDGED = "links drop packets: the cost identity holds, but no guarantee"
UNHEARD = (
    "links drop packets without acknowledgement, and senders assume that packets arrive: neither the identity nor a "
    "guarantee holds"
)
ATTEMPTS = "J_all is the cost of an attempt on every link in every step"
TOO_MANY = f"J_all is the cost without losses, because more than {MOST_LAWS} links drop packets"


Claim: TypeAlias = Literal["average", "every path"]
CLAIMS: tuple[Claim, ...] = ("average", "every path")


@on_any_network
def distributed(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    delta: float | None = None,
    theta: float | None = None,
    kappa: float | None = None,
    shares: dict[str, float] | None = None,
    period: float | None = None,
    prediction: Actuation = "hold",
    actuation: Actuation = "hold",
    joint: bool | None = None,
    guarantee: Claim | None = None,
    rule: RuleName | None = None,
    spend: float | None = None,
    gain_range: list[float] | None = None,
    plants: Sequence[Plant | ContinuousPlant] = (),
    controller: object = None,
    network: Network | None = None,
) -> Policy:
    """Design a policy for several sensors and actuators, with a separate decision on each link.

    By default, for LQG with a bound on the ``"average"``: the Kalman filter of all measurements is a sum of
    contributions, one from each sensor and one from the inputs. Each sensor computes its contribution, sends it if the
    controller's copy of it has become too inexact, and is silent otherwise. The controller adds its copies to an
    estimate of the state, and sends an input to an actuator if the input that the actuator applies has become too
    inexact. A link l is silent if its error costs at most δ_l per step.

    With a ``controller`` to keep, or with ``guarantee = "every path"``, sensors send their outputs and the controller
    its commands. Each node follows the response q of the loop to its own silence. With d the value that is used in
    silence minus the one that a packet would carry, this silence adds a = d'S d + 2 d'Y q to the cost, now and later.
    The ``rule`` limits a, and the bound holds on every path, for any noise and any load.

    Args:
        plant: the plant.
        cost: the cost, an average; with a controller to keep, also a total over a horizon.
        delta: threshold δ ≥ 0 of all links together, δ = (Σ√δ_l)², a cost per step (for a continuous plant, cost per
            second times seconds); on every path, the δ_l are the incomes or the thresholds of the nodes; or
        theta: share θ ≥ 0 by which the bound exceeds the cost of sending every sample, without the inter-sample noise
            cost c, which no control changes and which is 0 for a discrete plant; or
        kappa: share 0 ≤ κ < 1 for the rule ``"relative"``, κ² = Σκ_l².
        shares: relative share of each link in the sum of the √δ_l, or in the κ_l; default 1 for each link that is not
            listed.
        period: seconds between steps; only with a continuous plant.
        prediction: what the controller uses for a silent sensor: ``"hold"``, no further measurement, or on every path
            the last outputs; ``"model"``, what a model of the loop predicts from the sensor's last packet.
        actuation: what a silent actuator applies: ``"hold"``, its last input; ``"model"``, the input of a simulation
            of the loop from the last packet.
        joint: whether the controller chooses a set of packets to actuators. For the average it sends the cheapest set,
            by the prices of their links, that leaves a total error of at most δ_A, √δ_A the sum of their √δ_l;
            default: each link for itself. On every path it sends the set for which the cost of silence minus the price
            of the packets that are saved is least; default: jointly, if the links to actuators are ideal and at most 4.
        guarantee: ``"average"``, a bound in the mean for Gaussian noise; or ``"every path"``; default: every path with
            a controller, and the average without.
        rule: on every path, ``"bank"``: a node saves g_l in every step, and a silence may spend the share ``spend`` of
            what it has saved; ``"relative"``: it saves κ_l² times the part of the stage cost that it has measured
            itself, so no number for the noise is needed; ``"threshold"``: a silence may add δ_l; default: ``"bank"``,
            or ``"relative"`` with kappa.
        spend: share 0 < η ≤ 1 of the bank that one silence may spend; default 0.1.
        gain_range: least and largest factor of the input gains of the plant for which the bound is to hold on every
            path, such as [0.8, 1.2]; default: the bound is for this plant.
        plants: further plants for which the bound is to hold on every path, such as draws of a fitted model, with as
            many states, inputs and outputs.
        controller: a linear controller to keep, or an object that ``controller_from`` converts; default: LQG.
        network: the nodes and links; default: a sensor, a controller and an actuator at different places. Losses must
            be acknowledged for the identity of the cost, or for the certificate of every path, and exclude the bound.

    Returns:
        The policy. In the mean, J ≤ J_all + (Σ√(δ_l(1 − r_l)))² ≤ J_all + (Σ√δ_l)² for links that deliver every packet.
        On every path, √J ≤ √J_b + Σ√g_l with a bank, √J ≤ √J_b/(1 − κ) with a relative one, and √J ≤ √J_b +
        Σ√(δ_l(1 − r_l)) with a threshold, J_b the cost of sending every sample on that path.

    Raises:
        ProblemError: unless exactly one of δ, θ and κ is given, if a share is given for another link or all are 0, if
            no link of the network decides, if the cost has a discount, or without a controller to keep a horizon, or
            if an argument belongs to the other guarantee.
        UnstableError: if no stabilising gain or filter exists, or the loop of the given controller is unstable.

    Source: khashooei2017

    Example:
        >>> plant = Plant([[1.1]], [[1.0]], [[0.1]], C=[[1.0]], V=[[0.1]])
        >>> policy = distributed(plant, Cost([[1.0]], [[1.0]]), theta=0.2)
        >>> policy.scheduled, round(policy.guarantee.cost / policy.cost_all_time, 9)
        (('sensor', 'actuator'), 1.2)
        >>> kept = distributed(plant, Cost([[1.0]], [[1.0]]), theta=0.2, controller=[[0.5]])
        >>> kept.guarantee.every_path, round(kept.guarantee.cost / kept.cost_all_time, 9)
        (True, 1.2)
    """
    network = network or IDEAL
    own = controller is not None
    claim = choice("guarantee", ("every path" if own else "average") if guarantee is None else guarantee, CLAIMS)
    if claim == "every path":
        own_rule = choice("rule", rule or ("bank" if kappa is None else "relative"), RULES)
        sensing, acting = choice("prediction", prediction, MODES), choice("actuation", actuation, MODES)
        asked = Asked(own_rule, delta, theta, kappa, shares, spend, joint, sensing, acting, gain_range, tuple(plants))
        kept = controller_from(controller) if own else None
        return design_on_every_path(KIND.name, plant, cost, period, kept, network, asked)
    stated = {"controller": controller, "kappa": kappa, "rule": rule, "spend": spend, "gain_range": gain_range}
    stated["plants"] = plants or None
    for name in (name for name, one in stated.items() if one is not None):
        raise ProblemError(
            f"the parameter {name} is given, but the guarantee is a bound on the average; expected guarantee = 'every "
            f"path', or no {name}"
        )
    joint = False if joint is None else joint
    network = network or IDEAL
    given = network, choice("prediction", prediction, MODES), choice("actuation", actuation, MODES)
    if actuation == "model":  # the actuators make up for random delays themselves
        plant = promptly(plant, network)
    certainty = design_certainty("distributed", discretise(plant, cost, period))
    all_time, lossy = certainty.cost_all_time, _lossy(network)
    if plant.exosystem is not None:
        _expect_no_growing_effect(network, lossy, prediction)
    if 0 < len(lossy) <= MOST_LAWS:  # the second moments need a law for each set of links that deliver
        all_time = _with_every_attempt(plant, cost, period, network.unlimited, *given[1:])
    thresholds = _thresholds(network, threshold_of(all_time, delta, theta), shares, flag("joint", joint))
    return _policy(certainty, *given, thresholds, all_time)


@lru_cache(maxsize=8)  # every trial of a search for a threshold needs it
def _with_every_attempt(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    period: float | None,
    network: Network,
    prediction: Actuation,
    actuation: Actuation,
) -> float:
    """Return the cost per step of an attempt on every link in every step of the linear loop, with exact packets."""
    plant = plant.linear
    network = network.changed({link: {"delay": None} for link in network.late})  # of which the plant shows the mean
    certainty = design_certainty("distributed", discretise(plant, cost, period))
    thresholds = _thresholds(network, 0.0, None, False)
    policy = _policy(certainty, network, prediction, actuation, thresholds, certainty.cost_all_time)
    found = outcomes(close(plant, policy, network.delivery))
    assert found is not None  # the loop is a jump linear map
    return found.cost()


def _policy(
    certainty: CertaintyEquivalentDesign,
    network: Network,
    prediction: Actuation,
    actuation: Actuation,
    thresholds: Mapping[tuple[str, ...], float],
    all_time: float,
) -> Policy:
    """Return the policy, given the threshold of each group of links and the cost per step of sending every sample."""
    problem, lossless = certainty.problem, certainty.problem.per_unit(certainty.cost_all_time)
    sensors = ContributionSteps(certainty, network, prediction, thresholds)
    inputs = InputSteps(certainty, network, actuation, thresholds)
    lossy = _lossy(network)
    told = all(network.acknowledges(link) for link in lossy)
    square = Identity(lossless, (Form((EXCESS,), certainty.regulator.H / problem.tick),))
    sums = {ESTIMATE: sensors.estimate, EXCESS: {**inputs.held, ESTIMATE: -certainty.regulator.L}}
    allowed = None if lossy else certainty.allowance_of(sensors.apart)
    nominal = Nominal(
        problem,
        all_time,
        certainty.settling,
        _error(certainty, allowed) if all_time == certainty.cost_all_time else None,
        certainty.recovery,
        sensors.innovations() if told else None,
    )
    return nominal.policy(
        "distributed",
        (*sensors.measure(), *sensors.add(), *inputs.decide(), *sensors.predict(inputs.held)),
        sensors.initial,
        Theory(
            guarantee=None if lossy else _guarantee(certainty, thresholds, allowed),
            identity=square if told and not certainty.timed else None,
            sums=sums if told else {},
            covers=GAUSSIAN_THEORY | BURSTS if lossy and told else GAUSSIAN_THEORY,
        ),
        # nodes at another place do not use each other's signals, so each of them runs by itself
        sites=network.sites_of_controller,
        network=network,
        notes=(f"{ACKNOWLEDGED if told else UNHEARD}; {ATTEMPTS if len(lossy) <= MOST_LAWS else TOO_MANY}",)
        if lossy
        else (),
        unsure=any(network.nodes[link].applies and not network.acknowledges(link) for link in lossy),
    )


def _expect_no_growing_effect(network: Network, lossy: list[str], prediction: Actuation) -> None:
    """Raise an error if the effect of late or dropped packets grows with disturbances or set-points."""
    for link in network.links:
        law = network.links[link].delay if link in network.late else None
        held = law is not None and bool(network.nodes[link].measures) and prediction == "hold"
        drops = link in lossy or (law is not None and law.loses)
        if not (drops or held):
            continue
        got = f"{network.lost(link)} is given" if law is None else network.lateness(link)
        remedy = "" if drops else ", prediction = 'model'"
        raise ProblemError(
            f"{got}, together with disturbances or set-points, and the effect of a packet that is lost, or late with "
            f"prediction = 'hold', grows with them; expected links that deliver every packet{remedy}, or neither "
            "disturbances nor set-points"
        )


def _lossy(network: Network) -> list[str]:
    return [link for link in network.links if network.loss(link) > 0]


def _thresholds(
    network: Network, whole: float, shares: Mapping[str, float] | None, joint: bool
) -> dict[tuple[str, ...], float]:
    """Return the threshold of each group of links that are decided together."""
    links = list(network.links)
    together = tuple(link for link in links if network.nodes[link].applies)
    if joint:
        expect_few(list(together))
    apart = [(link,) for link in links if not joint or link not in together]
    groups = [*apart, together] if joint and together else apart
    return {group: whole * weight**2 for group, weight in weights_of(network, groups, shares).items()}


def _error(certainty: CertaintyEquivalentDesign, allowed: Allowance | None) -> float | None:
    """Return the proved error of J_all, also for the sum of the contributions, in the user's units; or None."""
    if certainty.error is None or allowed is None:
        return None
    return rounded_up(certainty.error + allowed.fixed**2 / certainty.problem.unit)


def _guarantee(
    certainty: CertaintyEquivalentDesign, thresholds: Mapping[tuple[str, ...], float], allowed: Allowance | None
) -> Guarantee:
    """Return J ≤ J_all + (Σ√δ_l)² and, at the rates, J ≤ J_all + (Σ√(δ_l(1 − r_l)))², by Minkowski's inequality."""
    problem, pull = certainty.problem, certainty.pull
    added = sum(sqrt(delta) for delta in thresholds.values()) ** 2
    all_time, factor = certainty.raised(added, allowed)
    found = Guarantee(
        problem.per_unit(with_silence(all_time, factor * added, pull)),
        f"J ≤ J_all + (Σ√(δ_l(1 − r_l)))²{PULLED if pull else ''}, δ_l the most that the error of link l can cost, r_l "
        f"its rate; {certainty.stability}{f'; {AT_INSTANTS}' if problem.instants else ''}",
        "khashooei2017",
        problem.per_unit(all_time),
        deciders={group: factor * delta / problem.tick for group, delta in thresholds.items()},
        more_sends=True,
        pull=pull / sqrt(problem.tick),
        proved=allowed is not None,
    )
    return found.upwards() if found.proved else found


KIND = Kind(
    name="distributed",
    design=distributed,
    goal="several sensors and actuators, each of whose links decides for itself, with one guarantee for the cost",
    tuning=(TradeoffParameter("delta"), TradeoffParameter("theta"), TradeoffParameter("kappa")),
    example={"theta": 0.1},
    nodes="any",
    proved=r"$J\le J_{all}+(\sum_l\sqrt{\delta_l(1-r_l)})^2$, rates $r_l$ in sends per step",
    relative_to="LQG with every sample of every node",
    refused="losses exclude the guarantee",
    data="trigger e'He of each link against its δ_l",
    order="sensors: contribution, decision, packet; controller: sum, inputs, decisions, packets; actuators: input",
    usual={"theta": 0.1, "prediction": "model"},
    asked=("theta",),
    offered=1,
    several_nodes=True,
    shares="shares",
    keeps_controller=True,
)
