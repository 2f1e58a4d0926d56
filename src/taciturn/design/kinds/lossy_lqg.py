"""Event-triggered LQG control and tracking over links that drop packets, with or without acknowledgements.

The actuator applies zero if no packet arrives. So an attempt to send Lx̂ saves x̂'Γx̂ on average compared with silence,
Γ = (1−α) A'KB M⁻¹ B'KA, whatever happened before, and J = J_all + E Σ (1−σ)x̂'Γx̂ with the cost J_all of an attempt in
every step. The trigger sends iff x̂'Γx̂ exceeds the price λ of an attempt; hence J ≤ J_all + λN(1 − rate) over N steps.

The gains are in ``lqg/lossy``. Without acknowledgement the estimator does not know whether the input was applied: it
predicts with the mean, and the gains weigh the error of this.

Measurements may be late at random. The controller then moves the newest state to the present, with the gains and the
cost of ``lqg/late_samples``, for which the same theorem holds. With noisy outputs, a filter fuses all measurements
(``design/late_filter``), if it knows the inputs. The mean of its covariance has no closed form, so there is no J_all
unless all measurements arrive at once: then, J_all = tr(KW) + tr(ΓΣ) with the covariance Σ of the steady filter.

Source: khashooei2017, schenato2007
"""

from __future__ import annotations

import numpy as np

from taciturn._arrays import instance, number
from taciturn.base.anti_windup import within_limits
from taciturn.base.filter import CLOCK, ESTIMATE, HELD, SEND, by_clock, count_ticks
from taciturn.design.kind import Kind, TradeoffParameter, on_any_network
from taciturn.design.late_filter import FUSED, begin_late, fuse_late, keep_effects, rolled_forward
from taciturn.errors import PlacementError, ProblemError
from taciturn.lqg.critical_losses import Channel, MeanSquare
from taciturn.lqg.discrete import discretise
from taciturn.lqg.late_samples import LateSamples, regulate_late, regulate_late_finite
from taciturn.lqg.lossy import (
    LossyRegulator,
    loss_sentence,
    no_gain_survives,
    regulate_lossy,
    regulate_lossy_finite,
)
from taciturn.lqg.quadratic import Quadratic, worth_of
from taciturn.lqg.riccati import refuse_uncertain
from taciturn.model.cost import Cost
from taciturn.model.coverage import GAUSSIAN_THEORY, LATE
from taciturn.model.delay import DelayLaw
from taciturn.model.disturbance import Reference, Tracking
from taciturn.model.network import IDEAL, Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.steps import ONE, Acknowledged, Assign, Condition, Decide, Received, Send, Step, Terms
from taciturn.model.theory import Guarantee, Identity, Theory
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger

CLOSEST = 1 - 1e-9  # largest growth of the mean square of a stabilising gain
REFERENCE, FEEDFORWARD, OFF_REFERENCE = "reference", "feedforward", "deviation"


@on_any_network
def lossy_lqg(
    plant: Plant | ContinuousPlant,
    cost: Cost,
    *,
    price: float,
    network: Network | None = None,
    reference: Reference | None = None,
) -> Policy:
    """Design LQG control over lossy links that sends an input when silence would cost more than the price of a send.

    The sensor sends y at every step, the controller sends u = L x̂ iff x̂'Γx̂ > λ, and the actuator applies 0
    if no packet arrives. Silence costs exactly x̂'Γx̂, so J = J_all + E Σ (1−σ) x̂'Γx̂. Let α and β be the loss
    probabilities of actuator and sensor link, and M = R + B'(K + αβP)B for UDP-like links (αP instead of αβP with a
    delay; no P for TCP-like links). Then

        L = −M^{-1}B'KA,  Γ = (1−α) A'KB M^{-1} B'KA,  K ← Q + A'KA − Γ,  P ← Γ + βA'PA,

    backwards over the horizon, or at the fixed point. If the measurement arrives, x̂ = x; otherwise x̂ is predicted by
    A x̂ + (1−α) B σu (UDP-like) or A x̂ + B û (TCP-like). With ``network.delay`` = 1 the measurement of step k is
    available to the control of step k + 1. Bursty losses are treated in the design as independent losses.

    If measurements of the state arrive late at random, x̂ is the newest one, moved to the present, and the cost and the
    bounds take their delays into account. With C and V, x̂ is the mean given all measurements that have arrived, each
    fused at its own step; then no bound is claimed if measurements are late or lost.

    With a reference, the deviation from the reference is controlled: controller and actuator store r and f, and only
    the feedback is sent.

    Args:
        plant: discrete-time plant with measured full state, or with noisy outputs if the applied inputs are known.
        cost: cost without cross term, with a finite horizon or as an average.
        price: λ ≥ 0, the price of a send.
        network: the network; default ideal links.
        reference: reference to track, only with a horizon; the cost then weighs the deviation from the reference.

    Returns:
        The policy, with J ≤ J_all + λN and the sharper J ≤ J_all + λN(1 − rate) at a rate per step (average: λ and
        λ(1 − rate)).

    Raises:
        ProblemError: if the plant is continuous in time, or has C or V and inputs may be lost unnoticed, a link has a
            constant delay, the cost has N or a discount, the delay is above 1, or the reference does not fit.
        UnstableError: if the losses are too frequent for mean-square stability, with an average cost.

    Source: khashooei2017, schenato2007

    Example:
        >>> plant, cost = Plant([[1.2]], [[1.0]], [[0.01]]), Cost([[1.0]], [[1.0]])
        >>> policy = lossy_lqg(plant, cost, price=0.1, network=Network("udp", actuator_loss=0.3, sensor_loss=0.6))
        >>> round(policy.guarantee.cost - policy.cost_all_time, 12)
        0.1
    """
    price = number("price", price, 0.0, closed=True)
    instance("plant", plant, Plant, ContinuousPlant)
    if reference is not None:
        instance("reference", reference, Reference)
    links = network or IDEAL
    plant = refuse_what_is_not_covered(plant, cost, links)
    reference = None if reference is None else reference.relative_to(plant)
    if reference is not None and cost.horizon is None:
        raise ProblemError(
            "a reference trajectory is given without cost.horizon; expected cost.horizon as well, because the "
            "trajectory is finite"
        )
    network = links.without_bursts()  # the gains are for independent losses; bursts withdraw the claim, not the design
    channel = Channel(
        network.loss("actuator"),
        network.loss("sensor"),
        network.acknowledges("actuator"),
        network.delay == 1,
        (network.key("actuator", "loss"), network.key("sensor", "loss")),
    )
    late = network.random_delay("sensor", 1.0)
    samples = None if late is None else LateSamples.of(channel, _arriving(late))
    channel = channel if samples is None else samples.channel
    notes: tuple[str, ...] = ()
    settling, times = 0.0, "" if cost.horizon is None else f"·{cost.horizon}"
    # a state that costs nothing may grow without making the loop unstable
    seen = worth_of(Quadratic(plant.A, plant.B, cost.Q, cost.R, cost.N)).states
    A, B = plant.A[np.ix_(seen, seen)], plant.B[seen]
    if cost.horizon is None:
        given = plant.A, plant.B, cost.Q, cost.R
        gains = regulate_lossy(*given, channel) if samples is None else regulate_late(*given, samples)
        step = MeanSquare(A, B, gains.L[:, seen], channel)
        rate = step.growth() if samples is None else samples.growth(A, B, gains.L[:, seen])
        # the gain is proved to be stabilising, also if the computed rate is 1
        rate = min(rate, CLOSEST)
        settling = 1 / (1 - np.sqrt(rate))
        ticks = 1
    else:
        assert cost.terminal is not None
        mission = plant.A, plant.B, cost.Q, cost.R, cost.terminal, cost.horizon
        gains = regulate_lossy_finite(*mission, channel) if samples is None else regulate_late_finite(*mission, samples)
        if reference is not None:
            reference.check(plant, cost.horizon)
        if samples is None and no_gain_survives(A, B, channel):
            notes = (f"{loss_sentence(A, B, channel)}: over longer horizons the cost grows without bound",)
        ticks = cost.horizon
    cost_all_time, guarantee, steady = None, None, None
    if not plant.full_state and cost.horizon is None:
        steady = discretise(plant, cost, None).filter()
        settling = max(settling, 1 / (1 - steady.slowest))
    if plant.full_state:
        cost_all_time = _cost_all_time(plant, gains, channel, reference)
    elif steady is not None and channel.sensor_loss == 0.0:
        cost_all_time = float(np.sum(gains.K * plant.W) + np.sum(gains.Gamma * steady.posterior))
    if cost_all_time is not None:
        refuse_uncertain(cost_all_time, float(np.sum(gains.error * plant.W)))
        guarantee = Guarantee(
            cost_all_time + price * ticks,
            f"J ≤ J_all + λ{times}, and J ≤ J_all + λ{times}(1 − rate)",
            "khashooei2017",
            cost_all_time,
            price * ticks,
            more_sends=True,
        )
    silent = Form((ESTIMATE if reference is None else OFF_REFERENCE,), by_clock(gains.Gamma))
    trigger = Trigger({"silent": silent, SEND: Form(constant=price)})
    policy = Policy(
        kind="lossy-lqg",
        steps=_steps(plant, network, by_clock(gains.L), trigger, reference),
        model=plant,
        theory=Theory(
            cost=cost,
            cost_all_time=cost_all_time,
            settling=float(settling),
            guarantee=guarantee,
            identity=None if cost_all_time is None else Identity(cost_all_time, (silent, Form()), SEND),
            functions=frozenset() if plant.full_state else FUSED,
            covers=GAUSSIAN_THEORY | LATE if network.late == ("sensor",) else GAUSSIAN_THEORY,
        ),
        locations=() if cost.horizon is None else (count_ticks(ticks, None),),
        initial={"prior": plant.mean} if plant.full_state else begin_late(plant),
        network=links,
        tracking=None if reference is None else Tracking(REFERENCE, FEEDFORWARD, reference.states[-1]),
        notes=notes,
    )
    return within_limits(policy)


def _arriving(law: DelayLaw) -> list[float]:
    """Return the probabilities that a packet has a delay of 0, 1, … whole steps."""
    found = np.zeros(int(law.waits[-1]) + 1)
    found[np.array(law.waits, dtype=int)] = law.arriving()
    return found.tolist()


def refuse_what_is_not_covered(plant: Plant | ContinuousPlant, cost: Cost, network: Network = IDEAL) -> Plant:
    """Raise an error if the design for lossy links does not support plant, cost or network; return the plant."""
    instance("cost", cost, Cost)
    if isinstance(plant, ContinuousPlant):
        raise ProblemError(
            "the plant is continuous in time, and its sampling gives a cross weight that the policy kind lossy-lqg "
            "does not support; expected a discrete plant: give plant.dt and the matrices of one step"
        )
    if plant.transport is not None:  # it shows the mean of random delays too
        random = (network.lateness(link) for link in network.late if link != "sensor")
        raise PlacementError(
            f"{next(random, 'a link has a constant delay')}, with which the policy kind lossy-lqg would not know the "
            "inputs on their way; expected links without delay and buffer: remove them (network.delay = 1 delays "
            "measurements by one step)"
        )
    if plant.exosystem is not None or plant.changes is not None:
        raise ProblemError(
            "set-points or disturbances are given, which the policy kind lossy-lqg does not compensate; expected "
            "neither: remove them, or use another policy kind, such as excess"
        )
    _expect_steps(network)
    if not plant.full_state:
        _expect_known_inputs(plant, network)
    if cost.N.any():
        raise ProblemError(
            "cost.N is not zero, which the policy kind lossy-lqg does not support; expected no cross weight: remove it"
        )
    if cost.discount < 1:
        raise ProblemError(
            f"cost.discount is {cost.discount:g}, which the policy kind lossy-lqg does not use; expected an average "
            "cost or a finite horizon"
        )
    return discretise(plant, cost, None).plant


def _expect_steps(network: Network) -> None:
    """Raise an error unless the random delays of a network are whole steps, and the only ones."""
    for link in network.late:
        law = network.random_delay(link, 1.0)
        if law is not None and any(wait % 1.0 for wait in law.waits):
            raise ProblemError(
                f"{network.lateness(link)}, in parts of a step, but the plant is discrete in time; expected the "
                "probabilities of delays of 0, 1, 2, … steps"
            )
        if network.delay:
            raise ProblemError(
                f"network.delay is {network.delay}, and {network.lateness(link)}; expected network.delay = 0: add the "
                "step to the delays of the sensor link"
            )


def _expect_known_inputs(plant: Plant, network: Network) -> None:
    """Raise an error unless the controller may have a filter, which must know the applied inputs."""
    told = "C or V is given, but the policy kind lossy-lqg measures the full state"
    if network.loss("actuator") and not network.acknowledges("actuator"):
        raise ProblemError(
            f"{told} unless its filter knows which inputs were applied, and {network.lost('actuator')} is "
            f"{network.loss('actuator'):g} without acknowledgements; expected acknowledgements (protocol = 'tcp'), no "
            "losses of inputs, or neither C nor V"
        )
    if "actuator" in network.late:
        raise ProblemError(
            f"{told} unless its filter knows which inputs were applied, and {network.lateness('actuator')}; expected "
            f"{network.key('actuator', 'buffer')}, or neither C nor V"
        )
    for wrong, why in ((network.delay, "network.delay is 1"), (plant.saturation is not None, "inputs have limits")):
        if wrong:
            raise ProblemError(f"{told}, and {why}; expected no C and V, or a network without delay and no limits")


def _cost_all_time(plant: Plant, gains: LossyRegulator, channel: Channel, reference: Reference | None) -> float:
    """Return z_0'K_0z_0 + tr((K_0 + φP_0)Θ) + Σ tr((K_{i+1} + φP_{i+1})W) with mean z_0; or the average of the sum."""
    F = gains.K + channel.exposure * gains.P  # weight of a new estimation error
    if F.ndim == 2:
        return float(np.sum(F * plant.W))
    mean = plant.mean if reference is None else plant.mean - reference.states[0]
    start = mean @ gains.K[0] @ mean + np.sum(F[0] * plant.covariance)
    return float(start + np.sum(F[1:] * plant.W))


def _steps(
    plant: Plant, network: Network, L: Matrix, trigger: Trigger, reference: Reference | None
) -> tuple[Step, ...]:
    n, m, late = np.eye(plant.states), np.eye(plant.inputs), network.longest("sensor", 1.0)
    acknowledged = network.acknowledges("actuator")
    subject = ESTIMATE if reference is None else OFF_REFERENCE
    deviate: tuple[Step, ...] = ()
    supply: tuple[Step, ...] = (Assign("actuator", "input", ({"input": 0 * m}, {"command": m}), Received("actuator")),)
    silent, sent = {ESTIMATE: plant.A}, {ESTIMATE: plant.A, "command": (1 - network.loss("actuator")) * plant.B}
    if acknowledged:
        sent = {ESTIMATE: plant.A, "command": plant.B}
    if reference is not None:
        states, inputs = reference.states[:-1, :, None], reference.inputs[:, :, None]
        deviate = (
            Assign("controller", REFERENCE, {ONE: Scheduled(CLOCK, states)}),
            Assign("controller", "push", {ONE: Scheduled(CLOCK, plant.B @ inputs)}),
            Assign("controller", OFF_REFERENCE, {ESTIMATE: n, REFERENCE: -n}),
        )
        supply = (
            Assign("actuator", FEEDFORWARD, {ONE: Scheduled(CLOCK, inputs)}),
            Assign("actuator", "input", ({FEEDFORWARD: m}, {FEEDFORWARD: m, "command": m}), Received("actuator")),
        )
        silent, sent = {**silent, "push": n}, {**sent, "push": n}
    sample = Send("sensor", "sensor", ("y",))
    heard = Received("sensor", late if "sensor" in network.late else None)
    watch: tuple[Step, ...] = (
        sample,
        Assign("controller", "seen", ({"prior": n}, *rolled_forward(plant.A, "y", late)), heard),
    )
    act: tuple[Step, ...] = (
        *deviate,
        Assign("controller", "command", {subject: L}),
        Decide("controller", SEND, trigger),
        Send("controller", "actuator", ("command",), SEND),
        *supply,
    )
    # A measurement that is available only to the next control is equivalent to one that is taken after this control.
    if network.delay:
        order = (Assign("controller", ESTIMATE, {"prior": n}), *act, *watch)
        silent, sent = ({"seen" if name == ESTIMATE else name: w for name, w in t.items()} for t in (silent, sent))
    else:
        order = (*watch, Assign("controller", ESTIMATE, {"seen": n}), *act)
    known = Acknowledged("actuator") if acknowledged else SEND
    if plant.saturation is not None and late:
        raise ProblemError(
            f"{network.lateness('sensor')}, and the inputs have limits (input_limit, input_rate), so that the "
            f"controller would not know which inputs were applied; expected a constant delay, "
            f"{network.key('sensor', 'buffer')}, or inputs without limits"
        )
    if plant.saturation is not None:
        return (*order, *_limited(plant, network, reference, "seen" if network.delay else ESTIMATE, known))
    moved = Assign("controller", "prior", (silent, sent), known)
    if not plant.full_state:
        fused = fuse_late(plant, "sensor", "sensor" in network.late, late, network.key("sensor", "delay"))
        return (sample, *fused, *act, *keep_effects(moved, ESTIMATE, late + 1))
    return (*order, moved, *(keep_effects(moved, ESTIMATE, late) if late else ()))


def _limited(
    plant: Plant, network: Network, reference: Reference | None, start: str, known: Condition
) -> tuple[Step, ...]:
    """Return the prediction from ``start`` if inputs have limits: it uses the input with and without the packet."""
    m, loss = np.eye(plant.inputs), 0.0 if network.acknowledges("actuator") else network.loss("actuator")
    if plant.input_rate is not None and loss:
        raise ProblemError(
            f"plant.input_rate is given, but {network.lost('actuator')} is {loss:g}, and no packet is acknowledged, so "
            "the controller does not know how far the input has changed; expected protocol = 'tcp', or no input_rate"
        )
    silent: Terms = {"command": 0.0 * m}
    sent: Terms = {"command": m}
    if reference is not None:
        silent = {ONE: Scheduled(CLOCK, reference.inputs[:, :, None])}
        sent = {**silent, **sent}
    told = {start: plant.A, HELD: plant.B}
    arrives = {start: plant.A, HELD: (1 - loss) * plant.B, "candidate": loss * plant.B}
    moved = Assign("controller", "prior", (told, arrives), known) if loss else Assign("controller", "prior", told)
    return (
        Assign("controller", "candidate", silent),
        Assign("controller", HELD, ({"candidate": m}, sent), known),
        moved,
    )


KIND = Kind(
    name="lossy-lqg",
    design=lossy_lqg,
    goal="a link that drops packets, with a price per packet",
    tuning=(TradeoffParameter("price"),),
    example={"price": 0.1},
    built_in="lossy-double-integrator",
    nodes="S, C, A; the sensor sends at every step",
    plants=("discrete", "outputs"),
    costs=("average", "horizon"),
    follows=(),
    proved=r"$J\le J_{all}+\lambda(1-\text{rate})$; critical losses",
    relative_to="an attempt at every step",
    refused=(
        "`cost.N`; `C` and `V` if inputs are lost unnoticed; an average cost with losses at or above the critical loss "
        "probabilities"
    ),
    data="the step counter `clock` of a finite horizon; gains, Γ and the reference are read by `clock`",
    order=(
        "send y, set the estimate on `Received`, command, decide, send, zero input (or the feedforward) "
        "unless `Received`, predict with the mean loss on the decision, or with the `Acknowledged` input "
        "under tcp. With a delay: estimate := prior first, and S sends after A. With late outputs: fuse the packets of "
        "all ages first"
    ),
    offered=7,
    for_dropouts=True,
    delay=1,
    requires="a discrete-time model, N = 0, and the full state as measurement or inputs that the controller knows",
    check=refuse_what_is_not_covered,
)
