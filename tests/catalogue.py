"""Every policy once: what is listed here is enrolled in every law that applies to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np
from systems import System

from taciturn import Cost, Loop, Network, Plant, Policy, close, design
from taciturn.lqg.critical_losses import Channel, Lasting
from taciturn.lqg.riccati import regulate
from taciturn.program.numpy import run

Build = Callable[[System], Policy]


def closed(policy: Policy) -> Loop:
    """Close the loop of a design with its own plant, network and cost."""
    return close(policy.model, policy)


def started(plant: Plant, seed: int) -> Plant:
    """Return the plant with an initial distribution."""
    draws = np.random.default_rng(seed)
    spread = 0.5 * draws.standard_normal((plant.states, plant.states))
    C, V = (None, None) if plant.full_state else (plant.C, plant.V)
    return Plant(
        plant.A, plant.B, plant.W, C, V, mean=draws.standard_normal(plant.states), covariance=spread @ spread.T,
        input_limit=plant.input_limit, input_rate=plant.input_rate,
    )  # fmt: skip


def remote(
    controller: Literal["remote", "actuator", "sensor"], horizon: int | None = None, discount: float = 1.0
) -> Build:
    """Return the design with a controller at a place, θ = 0.3, ζ a fifth of the all-time average."""

    def build(system: System) -> Policy:
        weights = system.cost
        cost = Cost(weights.Q, weights.R, weights.N, horizon=horizon, discount=discount)
        zeta = 0.2 * design.all_time(system.plant, weights).cost_all_time
        parameters = {"remote": {"theta": 0.3, "zeta": zeta}, "actuator": {"zeta": zeta}, "sensor": {"theta": 0.3}}
        mission = horizon is not None or discount < 1
        plant = started(system.plant, system.seed) if mission else system.plant
        return design.remote_lqg(plant, cost, controller=controller, **parameters[controller])

    return build


def bearable(plant: Plant, network: Network) -> Network:
    """Return the network with its losses halved until the mean square can shrink by a fifth per step."""
    actuator, sensor = network.loss("actuator"), network.loss("sensor")
    while True:
        channel = Channel(actuator, sensor, network.protocol == "tcp", network.delay == 1)
        if Lasting(plant.A, plant.B).slowest(channel)[0] < 0.8:
            return Network(network.protocol, actuator, sensor, network.delay)
        actuator, sensor = actuator / 2, sensor / 2


def lossy(protocol: Literal["udp", "tcp"], delay: int, horizon: int | None = None) -> Build:
    """Return the design over links that lose 30 % and 60 %, or less, at a fifth of the all-time average per send."""

    def build(system: System) -> Policy:
        plant, given = Plant(system.plant.A, system.plant.B, system.plant.W), system.plant
        plant = Plant(plant.A, plant.B, plant.W, input_limit=given.input_limit, input_rate=given.input_rate)
        plant = plant if horizon is None else started(plant, system.seed)
        cost = Cost(system.cost.Q, system.cost.R, horizon=horizon)
        price = 0.2 * design.all_time(plant, Cost(system.cost.Q, system.cost.R)).cost_all_time
        network = bearable(plant, Network(protocol, 0.3, 0.6, delay))
        return design.lossy_lqg(plant, cost, price=price, network=network)

    return build


def size_of(system: System) -> float:
    """Return √J_all: a threshold of moderate size, in the units of the cost's root."""
    return float(np.sqrt(design.all_time(system.plant, system.cost).cost_all_time))


def dear(system: System) -> float:
    """Return three times what the first step of silence costs on average: a price at which sends are worth a while."""
    reset = design.excess(system.plant, system.cost, delta=0.0, actuation="model").theory.reset
    assert reset is not None
    return 3 * float(np.trace(reset.weight @ reset.covariance))


def steep(system: System) -> float:
    """Return half of the largest σ for which a relative threshold has a bound."""
    plant, cost = system.plant, system.cost
    found = regulate(plant.A, plant.B, cost.Q, cost.R, cost.N)
    mu = np.linalg.eigvalsh(found.L.T @ found.H @ found.L)[-1]
    least = np.linalg.eigvalsh(cost.Q - cost.N @ np.linalg.solve(cost.R, cost.N.T))[0]
    return float(0.5 * np.sqrt(least / mu))


BASELINES: Mapping[str, Build] = {
    "all-time": lambda s: design.all_time(s.plant, s.cost),
    "periodic hold": lambda s: design.periodic(s.plant, s.cost, every=2),
    "periodic model": lambda s: design.periodic(s.plant, s.cost, every=3, actuation="model"),
    "cycle hold": lambda s: design.periodic(s.plant, s.cost, every=(3, 1)),
    "cycle model": lambda s: design.periodic(s.plant, s.cost, every=[1, 3, 2], actuation="model"),
    "pattern": lambda s: design.periodic_schedule(s.plant, s.cost, length=5, sends=3),
    "variance": lambda s: design.variance(s.plant, s.cost, threshold=1.5 * np.abs(s.plant.V).max() + 0.2),
}
STATIONARY: Mapping[str, Build] = {
    "lqg joint hold": lambda s: design.lqg(s.plant, s.cost, theta=0.3),
    "lqg joint model": lambda s: design.lqg(s.plant, s.cost, theta=0.3, actuation="model"),
    "lqg separate hold": lambda s: design.lqg(s.plant, s.cost, theta=0.3, trigger="separate"),
    "lqg separate model": lambda s: design.lqg(s.plant, s.cost, theta=0.3, trigger="separate", actuation="model"),
    "excess hold": lambda s: design.excess(s.plant, s.cost, delta=0.05 * size_of(s) ** 2),
    "excess model": lambda s: design.excess(s.plant, s.cost, theta=0.1, actuation="model"),
    "absolute": lambda s: design.absolute(
        s.plant, s.cost, threshold=0.3 * size_of(s), weight=2 * np.eye(s.plant.inputs)
    ),
    "absolute state model": lambda s: design.absolute(
        s.plant, s.cost, threshold=0.3 * size_of(s), error="state", actuation="model"
    ),
    "relative": lambda s: design.relative(s.plant, s.cost, sigma=steep(s)),
    "mixed model": lambda s: design.mixed(
        s.plant, s.cost, sigma=steep(s), threshold=0.3 * size_of(s), actuation="model"
    ),
    "dynamic": lambda s: design.dynamic(s.plant, s.cost, sigma=steep(s), rho=0.8, gain=1.5),
    "stochastic": lambda s: design.stochastic(s.plant, s.cost, scale=3 / size_of(s) ** 2),
    "stochastic model": lambda s: design.stochastic(s.plant, s.cost, scale=1 / size_of(s) ** 2, actuation="model"),
    "self-triggered": lambda s: design.self_triggered(s.plant, s.cost, beta=1.3, max_interval=4),
    "rollout": lambda s: design.rollout(s.plant, s.cost, horizon=4, every=2),
    "remote": remote("remote"),
    "remote, at the actuator": remote("actuator"),
    "remote, at the sensor": remote("sensor"),
    "distributed": lambda s: design.distributed(s.plant, s.cost, theta=0.3),
    "distributed model": lambda s: design.distributed(
        s.plant, s.cost, theta=0.3, prediction="model", actuation="model"
    ),
    "lossy udp": lossy("udp", 0),
    "lossy tcp": lossy("tcp", 0),
    "lossy udp, delayed": lossy("udp", 1),
    "lossy tcp, delayed": lossy("tcp", 1),
}
UNPROVED: Mapping[str, Build] = {
    "downsampled": lambda s: design.downsampled(s.plant, s.cost, fast=1, slow=2, threshold=0.3 * size_of(s)),
    "send-on-delta": lambda s: design.send_on_delta(s.plant, s.cost, delta=0.3 * size_of(s)),
    "near-optimal": lambda s: design.near_optimal(s.plant, s.cost, price=dear(s)),
}
MISSIONS: Mapping[str, Build] = {
    "remote, 30 steps": remote("remote", horizon=30),
    "remote at the actuator, 30 steps": remote("actuator", horizon=30),
    "remote at the sensor, 30 steps": remote("sensor", horizon=30),
    "remote, discounted": remote("remote", discount=0.9),
    "remote at the actuator, discounted": remote("actuator", discount=0.9),
    "remote at the sensor, discounted": remote("sensor", discount=0.9),
    "lossy udp, 30 steps": lossy("udp", 0, horizon=30),
    "lossy tcp, 30 steps": lossy("tcp", 0, horizon=30),
    "lossy udp, delayed, 30 steps": lossy("udp", 1, horizon=30),
    "lossy tcp, delayed, 30 steps": lossy("tcp", 1, horizon=30),
}
BURSTS = {"to_bad": 0.05, "to_good": 0.3, "loss_good": 0.02, "loss_bad": 0.8}
KEEPING: Mapping[str, Mapping[str, object]] = {
    "kept": {},
    "kept, predicted from the sensor": {"link": "sensor", "actuation": "model"},
    "kept, every second step": {"every": 2},
    "kept over bursts": {"network.protocol": "tcp", "network.actuator_burst": BURSTS, "retry": True},
    "kept, predicted over losses": {
        "network.protocol": "tcp", "network.sensor_loss": 0.2, "link": "sensor", "actuation": "model",
    },
    "kept, limited at a set-point": {
        "controller.pid.setpoint": 2.0, "controller.pid.tracking_time": 2.0, "plant.input_limit": [0.8],
    },
    "kept by send-on-delta": {"kind": "send-on-delta", "theta": None, "delta": 0.1, "link": "actuator"},
    "event-pid": {"kind": "event-pid", "theta": None, "delta": 0.05, "longest": 3.0},
    "event-pid-saturated": {"kind": "event-pid-saturated", "theta": None, "delta": 0.05},
    "symmetric-send-on-delta": {"kind": "symmetric-send-on-delta", "theta": None, "delta": 0.05},
}  # fmt: skip
"""Changes of the built-in problem ``pid-tank``, whose controller every policy keeps."""
POLICIES: Mapping[str, Build] = {**BASELINES, **STATIONARY, **UNPROVED, **MISSIONS}
GUARANTEED = (*STATIONARY, *MISSIONS)
CLOSED_FORM = (*BASELINES, "stochastic model", *(name for name in GUARANTEED if "at the actuator" in name))
IDENTITY = (
    "downsampled",
    "near-optimal",
    "stochastic model",
    *(name for name in GUARANTEED if name not in CLOSED_FORM),
)
FIELD = tuple(
    name for name in STATIONARY if not name.startswith(("lqg", "remote", "lossy"))
)  # whose bounds hold over 300 systems, from which it follows that the mean square stays
SHRINKING = ("remote, at the sensor", "relative", "dynamic", "self-triggered", "rollout")
VANISHING = tuple(name for name in STATIONARY if name.startswith("lqg") or name in SHRINKING)
"""Whose trigger is relative: without noise the state vanishes."""


def outputs(policy: Policy, seed: int, paths: int = 4, ticks: int = 60) -> dict[str, np.ndarray]:
    """Return what a loop shows, (steps, paths) of each output."""
    loop = closed(policy)
    program = loop.program()
    return dict(run(program, loop.start(program, paths, seed), ticks).outputs)
