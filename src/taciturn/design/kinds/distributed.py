"""Several sensors and actuators, each of whose links decides for itself, with one bound on the cost of all together.

The Kalman filter of all measurements is linear, so its estimate is a sum of contributions of single sensors. A sensor
that is silent, or an actuator that holds, leaves an error in the input of the loop. Let e = Σ_l e_l be its sum over the
links l, each of which is silent only if e_l'He_l ≤ δ_l. By completion of squares, and by Minkowski's inequality for the
norm √E[e'He],

    J = J_all + E[e'He] ≤ J_all + (Σ_l √(δ_l(1 − r_l)))²,   r_l the rate of link l.

No link needs to know the errors of others. With dropouts, the identity holds if packets are acknowledged, but no bound.

Source: khashooei2017
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from math import sqrt

from taciturn._arrays import choice, flag
from taciturn.analyse.switched import MOST_LINKS, outcomes
from taciturn.base.certainty import AT_INSTANTS, Actuation, CertaintyEquivalentDesign, design_certainty
from taciturn.base.filter import ESTIMATE
from taciturn.base.nominal import Nominal
from taciturn.design.bounds import PULLED, shares_of, threshold_of
from taciturn.design.kind import Kind, TradeoffParameter, on_any_network
from taciturn.design.several_nodes import ContributionSteps, InputSteps
from taciturn.errors import ProblemError
from taciturn.loop import close
from taciturn.lqg.discrete import discretise
from taciturn.lqg.stored import Allowance
from taciturn.model.cost import Cost
from taciturn.model.coverage import BURSTS, GAUSSIAN_THEORY
from taciturn.model.network import IDEAL, Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.theory import Guarantee, Identity, Theory, rounded_up, with_silence
from taciturn.model.trigger import Form

MOST_SETS = 4  # actuator links of which the controller compares all sets
EXCESS = "input error"
MODES: tuple[Actuation, ...] = ("hold", "model")
ACKNOWLEDGED = "links drop packets: the cost identity holds, but no bound"
UNHEARD = (
    "links drop packets without acknowledgement, and senders assume that packets arrive: neither the identity nor a "
    "bound holds"
)
ATTEMPTS = "J_all is the cost of an attempt on every link in every step"
TOO_MANY = f"J_all is the cost without losses, because more than {MOST_LINKS} links drop packets"


@on_any_network
def distributed(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    delta: float | None = None,
    theta: float | None = None,
    shares: dict[str, float] | None = None,
    period: float | None = None,
    prediction: Actuation = "hold",
    actuation: Actuation = "hold",
    joint: bool = False,
    network: Network | None = None,
) -> Policy:
    """Design a policy for a network of several sensors and actuators, in which each link decides for itself.

    The Kalman filter of all measurements is a sum of contributions, one from each sensor and one from the inputs. Each
    sensor computes its contribution, sends it if the controller's copy of it has become too inexact, and is silent
    otherwise. The controller adds its copies to an estimate of the state, and sends an input to an actuator if the
    input that the actuator applies has become too inexact. A link l is silent if its error costs at most δ_l per step.

    Args:
        plant: the plant.
        cost: the cost, an average.
        delta: threshold δ ≥ 0 of all links together, δ = (Σ√δ_l)², a cost per step (for a continuous plant, cost per
            second times seconds); or
        theta: share θ ≥ 0, for δ = θ(J_all − c) per step, with the inter-sample noise cost c, which no control changes
            and which is 0 for a discrete plant.
        shares: relative share of each link in the sum of the √δ_l; default 1 for each link that is not listed.
        period: seconds between steps; only with a continuous plant.
        prediction: what the controller assumes of a silent sensor's contribution: ``"hold"``, no further measurement;
            ``"model"``, the measurements that a model of the plant predicts from the sensor's last packet.
        actuation: what a silent actuator applies: ``"hold"``, its last input; ``"model"``, the input of a simulation
            x̃⁺ = (A + BL) x̃ from the last packet.
        joint: whether the controller sends the cheapest set of packets to actuators, by the prices of their links, that
            leaves a total error of at most δ_A, √δ_A the sum of their √δ_l; default: each link for itself.
        network: the nodes and links; default: a sensor, a controller and an actuator at different places. Losses must
            be acknowledged for the identity of the cost, and exclude the bound.

    Returns:
        The policy, with J ≤ J_all + (Σ√(δ_l(1 − r_l)))² ≤ J_all + (Σ√δ_l)² for links that deliver every packet.

    Raises:
        ProblemError: unless exactly one of δ and θ is given, if a share is given for another link or all are 0, if no
            link of the network decides, or if the cost has a horizon or a discount.
        UnstableError: if no stabilising gain or filter exists.

    Source: khashooei2017

    Example:
        >>> plant = Plant([[1.1]], [[1.0]], [[0.1]], C=[[1.0]], V=[[0.1]])
        >>> policy = distributed(plant, Cost([[1.0]], [[1.0]]), theta=0.2)
        >>> policy.scheduled, round(policy.guarantee.cost / policy.cost_all_time, 9)
        (('sensor', 'actuator'), 1.2)
    """
    network = network or IDEAL
    given = network, choice("prediction", prediction, MODES), choice("actuation", actuation, MODES)
    certainty = design_certainty("distributed", discretise(plant, cost, period))
    all_time, lossy = certainty.cost_all_time, _lossy(network)
    if lossy and plant.exosystem is not None:
        raise ProblemError(
            f"{network.lost(lossy[0])} is given, and disturbances or set-points too, with whose size the effect of a "
            "dropout grows; expected links that deliver every packet, or no disturbances and set-points"
        )
    if 0 < len(lossy) <= MOST_LINKS:
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
        notes=(f"{ACKNOWLEDGED if told else UNHEARD}; {ATTEMPTS if len(lossy) <= MOST_LINKS else TOO_MANY}",)
        if lossy
        else (),
    )


def _lossy(network: Network) -> list[str]:
    return [link for link in network.links if network.loss(link) > 0]


def _thresholds(
    network: Network, whole: float, shares: Mapping[str, float] | None, joint: bool
) -> dict[tuple[str, ...], float]:
    """Return the threshold of each group of links that are decided together."""
    links = list(network.links)
    if not links:
        raise ProblemError("all nodes are at the controller's place, so no link decides; expected a node with a link")
    given = shares_of(shares, links)
    total = sum(given.values())
    if total == 0:
        raise ProblemError("shares is 0 for all links; expected a positive share of at least one link")
    together = tuple(link for link in links if network.nodes[link].applies)
    if joint and len(together) > MOST_SETS:
        raise ProblemError(
            f"joint is true for {len(together)} actuator links, which have {2 ** len(together)} sets; expected at most "
            f"{MOST_SETS} links, or joint = false"
        )
    apart = [(link,) for link in links if not joint or link not in together]
    groups = [*apart, together] if joint and together else apart
    return {group: whole * (sum(given[link] for link in group) / total) ** 2 for group in groups}


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
    goal="several sensors and actuators, each of whose links decides for itself, with one bound on the cost",
    tuning=(TradeoffParameter("delta"), TradeoffParameter("theta")),
    example={"theta": 0.1},
    nodes="any",
    proved=r"$J\le J_{all}+(\sum_l\sqrt{\delta_l(1-r_l)})^2$, rates $r_l$ in sends per step",
    relative_to="LQG with every sample of every node",
    refused="losses exclude the bound",
    data="trigger e'He of each link against its δ_l",
    order="sensors: contribution, decision, packet; controller: sum, inputs, decisions, packets; actuators: input",
    usual={"theta": 0.1, "prediction": "model"},
    asked=("theta",),
    several_nodes=True,
    shares="shares",
)
