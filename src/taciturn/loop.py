"""Closes a loop: plant, policy and network together, after checking that no node uses what it cannot know."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array
from taciturn._modes import factor
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete, discretise
from taciturn.model.cost import Cost
from taciturn.model.information import check_information
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import ENDS, Assign, Policy
from taciturn.model.trigger import Form
from taciturn.program.draws import GENERATOR, NORMAL, seed_generators, with_draws
from taciturn.program.ir import Builder, Coefficient, Program
from taciturn.program.lower import Tick

COST, EXCESS, SENT = "cost", "excess", "sent"
WEIGHT = "weight"  # of a tick in a discounted sum
NEGLIGIBLE = 1e-12  # weight of a tick after which a discounted sum ends


@dataclass(frozen=True, eq=False)
class Loop:
    """A closed loop z⁺ = F z + G w with a trigger, as a program of one tick.

    Args:
        problem: the plant from tick to tick, with its weights.
        policy: the policy.
        network: the network.
        nominal: whether plant, network and cost are those the policy was designed for, so that its theory holds.
    """

    problem: Discrete
    policy: Policy
    network: Network
    nominal: bool

    @property
    def horizon(self) -> int | None:
        """Ticks of a mission: the cost's horizon, or where a discount has made what follows negligible."""
        cost = self.problem.cost
        if cost.discount < 1:
            return int(np.ceil(np.log(NEGLIGIBLE) / np.log(cost.discount)))
        return cost.horizon

    @property
    def reducible(self) -> bool:
        """Whether the loop has the law of one driven by the filter's innovations."""
        return self.nominal and self.policy.innovations is not None and self.horizon is None

    def program(self) -> Program:
        """Return one tick of the loop with the plant in it.

        Sums: ``cost`` (stage cost), ``excess`` (completed square, where the policy has an identity that holds),
        ``sent LINK`` (packets). Outputs: what ``taciturn.simulation`` records.
        """
        plant = self.problem.plant
        tick = self._tick({"x": plant.states})
        tick.signals["y"] = tick.combine({"x": plant.C}, plant.outputs)
        if plant.V.any():
            noise = _noise(tick, factor(plant.V), 0)
            tick.signals["y"] = [tick.builder.emit("add", y, v) for y, v in zip(tick.signals["y"], noise, strict=True)]
        for step in self.policy.steps:
            tick.take(step, self._losses())
        tick.signals["applied"] = self._clip(tick)
        stage = tick.form(self._stage("x"))
        outputs = self._outputs(tick, ("x",))
        moved = tick.combine({"x": plant.A, "applied": plant.B}, plant.states)
        if plant.W.any():
            noise = _noise(tick, factor(plant.W), len(tick.builder.inputs))
            moved = [tick.builder.emit("add", v, w) for v, w in zip(moved, noise, strict=True)]
        tick.signals["x"] = moved
        return with_draws(tick.finish(self._sums(tick, stage), outputs))

    def reduced_program(self) -> Program:
        """Return one tick of the loop as its filter sees it: driven by innovations, without the plant.

        Equal in law to ``program`` with a steady filter and Gaussian noise; the stage cost is that of the estimate
        plus tr(QΣ).

        Raises:
            ProblemError: the reduction does not hold for this loop.

        Source: khashooei2017
        """
        innovations = self.policy.innovations
        if not self.reducible or innovations is None:
            raise ProblemError(
                "the loop has no innovations form: its plant, network or horizon is not that of the design"
            )
        tick = self._tick({})
        for step in self.policy.steps:
            if isinstance(step, Assign) and step.signal == innovations.signal:
                tick.signals[step.signal] = _noise(tick, factor(innovations.covariance), 0)
            else:
                tick.take(step, self._losses())
        tick.signals["applied"] = tick.signals["input"]
        error = float(np.trace(self.problem.Q @ innovations.error_covariance))
        stage = tick.form(self._stage(innovations.estimate, error))
        return with_draws(tick.finish(self._sums(tick, stage), self._outputs(tick, ())))

    def start(self, program: Program, paths: int, seed: int, first: int = 0) -> Array:
        """Return the first value of each state of a program for the paths from ``first`` on, (states, paths)."""
        plant = self.problem.plant
        draws = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(first,)))
        spread = factor(plant.covariance)
        x = plant.mean[:, None] + spread @ draws.standard_normal((paths, spread.shape[1])).T
        drawn = {"x": x, GENERATOR: seed_generators(seed, paths, first)}
        rows: list[Array] = []
        for state in program.states:
            if isinstance(state.start, tuple):
                name, index = state.start
                rows.append(drawn[name][index])
            else:
                rows.append(np.full(paths, state.start))
        return np.array(rows).reshape(len(rows), paths)

    def _tick(self, extra: Mapping[str, int]) -> Tick:
        policy, plant = self.policy, self.problem.plant
        sizes = {**policy.sizes, **extra, "applied": plant.inputs, WEIGHT: 1}
        return Tick(Builder(), sizes, {**policy.initial, "x": "x", WEIGHT: np.ones(1)}, policy.locations)

    def _losses(self) -> dict[str, Coefficient]:
        return {link: self.network.loss(link) for link in ENDS}

    def _clip(self, tick: Tick) -> list[int]:
        limit = self.problem.plant.input_limit
        values = tick.signals["input"]
        if limit is None:
            return values
        clipped: list[int] = []
        for value, bound in zip(values, limit, strict=True):
            high, low = tick.builder.constant(bound), tick.builder.constant(-bound)
            below = tick.choose(tick.builder.emit("greater", value, high), high, value)
            clipped.append(tick.choose(tick.builder.emit("greater", low, below), low, below))
        return clipped

    def _stage(self, state: str, constant: float = 0.0) -> Form:
        p = self.problem
        return Form((state, "applied"), np.block([[p.Q, p.N], [p.N.T, p.R]]), constant)

    def _sums(self, tick: Tick, stage: int) -> dict[str, int]:
        discount = self.problem.cost.discount
        if discount < 1:
            (weight,) = tick.read(WEIGHT)
            tick.signals[WEIGHT] = [tick.builder.scale(discount, weight)]
            stage = tick.builder.emit("mul", weight, stage)
        sums = {COST: stage}
        identity = self.policy.identity
        if identity is not None and self.nominal:
            sums[EXCESS] = tick.pick(identity.on, [tick.form(form) for form in identity.forms])
        return sums | {f"{SENT} {link}": tick.as_number(tick.sent[link]) for link in self.policy.scheduled}

    def _outputs(self, tick: Tick, more: tuple[str, ...]) -> dict[str, int]:
        shown = [*more, *(name for name in ("y", "estimate", "applied") if name in tick.signals)]
        outputs = {f"{name} {i}": value for name in shown for i, value in enumerate(tick.signals[name])}
        for decision, options in tick.options.items():
            outputs |= {f"option {decision} {label}": value for label, value in options.items()}
        outputs |= {f"{SENT} {link}": tick.as_number(truth) for link, truth in tick.sent.items()}
        return outputs | {f"arrived {link}": tick.as_number(truth) for link, truth in tick.arrived.items()}


def close(
    plant: Plant | ContinuousPlant, policy: Policy, network: Network | None = None, cost: Cost | None = None
) -> Loop:
    """Close the loop of a plant, a policy and a network.

    Args:
        plant: the plant that is controlled, the one of the design or another.
        policy: from ``taciturn.design`` or hand-made.
        network: omitted: ideal links.
        cost: the cost that is measured; omitted: the one the policy was designed for.

    Returns:
        The loop.

    Raises:
        InformationError: a node uses what it cannot know.
        ProblemError: sizes of plant, policy and cost differ, or the plant's noise cannot be sampled.

    Source: khashooei2017
    """
    cost = policy.cost if cost is None else cost
    if cost is None:
        raise ProblemError(f"cost is missing, and {policy.kind} was designed for none; expected the cost to measure")
    network = network or Network()
    if isinstance(plant, ContinuousPlant) and plant.jumps is not None:
        raise ProblemError(
            f"the plant has Poisson jumps, which {policy.kind} does not sample; expected Wiener noise: "
            "give W, the intensity per second, instead of jumps"
        )
    period = policy.tick if isinstance(plant, ContinuousPlant) else None
    problem = discretise(plant, cost, period, policy.prediction_gain)
    for name in ("states", "inputs", "outputs"):
        got, expected = getattr(problem.plant, name), getattr(policy.model, name)
        if got != expected:
            raise ProblemError(f"the plant has {got} {name}; expected {expected}, as in the policy's model")
    check_information(policy, network)
    as_designed = (
        problem.plant.same_as(policy.model),
        problem.plant.input_limit is None,
        network == policy.network,
        policy.cost is not None and cost.same_as(policy.cost),
    )
    return Loop(problem, policy, network, all(as_designed))


def _noise(tick: Tick, spread: Array, first: int) -> list[int]:
    """Return G·normals, drawn under names that count from ``first``."""
    drawn = [tick.builder.input(f"{NORMAL} {first + i}") for i in range(spread.shape[1])]
    return [tick.value(tick.builder.combine([float(g) for g in row], drawn)) for row in spread]
