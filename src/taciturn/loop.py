"""Closed loops of plant, policy and network: the assumptions of their theory, and the program of one step.

``close`` samples the plant, checks that every node uses only signals that are available to it, and compares the loop
with the design. The theory of a policy, such as a bound on its cost, applies only to loops that violate none of its
assumptions (``list_violations``).

A step of the loop is a program (``taciturn.program``). In this order, it

1. draws which packets are lost, and the measurement y = C x + v,
2. carries out the policy steps of all nodes, and limits the input û that the actuators apply,
3. adds up the stage cost x'Qx + 2x'Nû + û'Rû of deviations from the targets, the completed square if the theory has an
   identity for the cost, and the packets sent; with a discount α, each is multiplied by the weight α^k of the step,
4. moves the plant: x⁺ = A x + B û + w, or a function of x, û and w.

If plant and network are those of the design and the filter is steady, the loop has the same distribution as a loop
without the plant, driven by the innovations of the filter: white noise of covariance S. Its estimate x̂ takes the place
of x, and its stage cost adds tr(QΣ) to that of the estimate, where Σ is the covariance of the estimation error.

Source: khashooei2017
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import gcd

import numpy as np

from taciturn._arrays import Array, count, instance
from taciturn._display import Displayed
from taciturn._modes import factor
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete, discretise, point_with, with_same_start
from taciturn.lqg.kalman import resting_states
from taciturn.lqg.loaded import with_loads
from taciturn.model.cost import Cost
from taciturn.model.coverage import (
    BURSTS,
    DRIFT,
    FUNCTION,
    JUMPS,
    LATE,
    LIMIT,
    LOADS,
    ROUNDING,
    SAMPLES,
    SET_POINT_LIMITS,
    SIMULATED,
    uncovered,
)
from taciturn.model.delay import WHOLE
from taciturn.model.disturbance import padded
from taciturn.model.expected import sensed_by
from taciturn.model.information import check_network, unheard_acknowledgements
from taciturn.model.limits import Limits
from taciturn.model.losses import LossLaw
from taciturn.model.names import Names
from taciturn.model.network import REFERENCE, Network
from taciturn.model.plant import ContinuousPlant, Plant, about
from taciturn.model.policy import Policy, with_intervals
from taciturn.model.signals import SampledChanges
from taciturn.model.steps import ONE, assigned
from taciturn.model.theory import Identity
from taciturn.model.transport import delayed_by, transport_of
from taciturn.model.trigger import Form, shape_of
from taciturn.program.all_nodes import (
    ACTING,
    Begin,
    add_values,
    begin_time_step,
    carry_out,
    deviation,
    measure,
    replaced,
)
from taciturn.program.draws import GENERATOR, NORMAL, seed_generators, with_controls, with_draws
from taciturn.program.ir import Program, Truth
from taciturn.program.late import place_of
from taciturn.program.missing import SAMPLED
from taciturn.program.ops import Name, Precision, Sent, Silence, named
from taciturn.program.ranges import ranges_of_sums
from taciturn.program.signals import LOADED, TIMETABLE, add_changes, add_jumps, draw_noise, read_loads
from taciturn.program.tracing import trace
from taciturn.program.translation import APPLIED, TimeStep, first_input, link_state, sample_state


def check_plants(problem: Discrete, policy: Policy) -> None:
    """Raise an error if design plant and simulated plant differ in a property that only simulations use."""
    plant, model = problem.plant, policy.model
    begun = policy.cost is not None and policy.cost.mission
    ignored = {
        "input_limit": model.input_limit is not None and not plant.agrees("input_limit", model),
        "input_rate": model.input_rate is not None and not plant.agrees("input_rate", model),
        "function": model.function is not None and plant.function is None,
        "initial.covariance": model.covariance.any() and not begun and not plant.agrees("covariance", model),
    }
    for name in (name for name, unused in ignored.items() if unused):
        raise ProblemError(
            f"plant.{name} is given, but the simulated plant, plant.actual, has a different {name} or none; expected "
            f"plant.actual.{name} with the same value, or no plant.{name}, since the design does not use it"
        )


def list_violations(problem: Discrete, policy: Policy, network: Network, missing: Sequence[str]) -> tuple[str, ...]:
    """List, as texts, the assumptions of the policy's theory that do not hold in a loop."""
    plant, model, cost = problem.plant, policy.model, problem.cost
    started = not (plant.agrees("mean", model) and plant.agrees("covariance", model))
    exact, designed = network.delivery, policy.network.played().delivery
    source = problem.source
    late = source is not None and source.transport != transport_of(source, policy.network)
    delays = ", or a delay of its links," if late else ""
    alike = (designed,) if policy.theory.covers >= BURSTS else (designed, designed.without_bursts())

    def lacks(names: frozenset[str]) -> bool:
        return not names.isdisjoint(missing)

    # for the design, the plant shows the mean of random delays
    meant = lacks(LATE) and bool(model.registers) and not plant.registers

    found = {
        "the plant is not linear (A and B are its linearisation)": lacks(FUNCTION),
        f"the plant{delays} is not the one of the design": not (plant.same_as(model) or lacks(DRIFT) or meant),
        "the plant does not rest at the operating point of the design": lacks(DRIFT),
        # set-points count from the operating point, so another one starts them elsewhere
        "the initial state is not the one of the design": started
        and (cost.mission or (resting_states(plant).any() and not lacks(DRIFT))),
        "inputs are clipped (input_limit)": "plant.input_limit" in missing,
        "the changes of the inputs are limited (input_rate)": "plant.input_rate" in missing,
        "a load acts on the plant that the design does not know ([[disturbance]] with wander = 0)": lacks(LOADS),
        "the set-points change faster than their limit (reference.ramp)": lacks(SET_POINT_LIMITS),
        "the noise has jumps, but the filter's theory assumes Gaussian noise": lacks(JUMPS),
        "losses come in bursts, but the design uses only their mean": lacks(BURSTS),
        "the network is not the one of the design": not lacks(BURSTS) and exact not in alike,
        "no node uses the acknowledgements of protocol 'tcp'": unheard_acknowledgements(policy, network),
        f"packets contain rounded numbers ({network.payload})": lacks(ROUNDING),
        "samples are missing at random": lacks(SAMPLES),
        "packets are delayed at random, and their delays are not acknowledged": lacks(LATE) and not meant,
        "packets are delayed at random, but the design assumes their mean delay": meant,
        "the filter has the gain for missing samples, but none is missing": bool(
            policy.network.missing and not network.missing
        ),
        "the cost is not the one of the design": policy.cost is None or not cost.same_as(policy.cost),
    }
    others = [name for name in missing if name not in NAMED]
    return (*(text for text, departs in found.items() if departs), *map("the theory does not cover {}".format, others))


# differences that have sentences of their own
NAMED = FUNCTION | LIMIT | SET_POINT_LIMITS | JUMPS | BURSTS | ROUNDING | DRIFT | LOADS | SAMPLES | LATE
COST, EXCESS = "cost", "excess"
INNOVATION_DRAWS = "drawn"  # normal draws from which an innovation is computed
WEIGHT = "weight"  # weight of a step in a discounted sum
LOAD = "load"  # signal with the loads of a step
LEAST = {"float32": 1e-30, "float64": 1e-120}  # least cost of a step, and inverse of the largest: no square overflows
_SETTING_UP = 4  # steps at the start whose packets are not part of an average
NEGLIGIBLE = 1e-12  # weight of a step after which a discounted sum ends


@dataclass(frozen=True, eq=False, repr=False)
class Loop(Displayed):
    """A closed loop of a plant, a policy and a network: z⁺ = F z + G w, and a trigger that decides when to send.

    Args:
        problem: the discrete-time plant with its weights.
        policy: the policy.
        network: the network.
        violated_assumptions: differences between the loop and its design; the policy's theory applies only if there are
            none.
        precision: precision of the simulation: ``"float64"``, or ``"float32"``, which is 1.8 times as fast.
        counted: the same loop in deviations from the operating point, if this loop is in the units of the plant.
        limits: limits of the states, for figures; they do not affect the loop.
        names: names of states, inputs and outputs, for tables and figures.
        settings: parameters of the policy and the ``file`` of the problem as text, by which a title tells two loops
            apart.

    Raises:
        ProblemError: the precision is unknown, or cannot represent this cost.
    """

    problem: Discrete
    policy: Policy
    network: Network
    violated_assumptions: tuple[str, ...]
    precision: Precision = "float64"
    counted: Loop | None = None
    limits: Limits | None = None
    names: Names | None = None
    settings: Mapping[str, str] = field(default_factory=lambda: {})

    def __post_init__(self) -> None:
        """Check the precision."""
        if self.precision not in ("float64", "float32"):
            raise ProblemError(f"precision is {self.precision!r}; expected 'float64' or 'float32'")
        size = abs(self.policy.theory.cost_all_time or 0.0) * self.policy.tick
        if size and not LEAST[self.precision] < size < 1 / LEAST[self.precision]:
            remedy = ", or precision 'float64'" if self.precision == "float32" else ""
            raise ProblemError(
                f"precision is {self.precision!r}, but the cost of a step is about {size:.1g}, outside the range of "
                f"this format; expected a rescaled problem, for example with other units of Q and R, or of W{remedy}"
            )
        if self.precision == "float32" and self.problem.cost.discount < 1:
            raise ProblemError(
                f"precision is 'float32', but with the discount {self.problem.cost.discount:g}, rounding errors "
                "accumulate in the weights; expected precision 'float64', or a cost without discount"
            )

    def summary(self) -> Mapping[str, object]:
        """Return the values to display: policy, cost of sending every sample, plant, network and number format."""
        shown = {"policy": self.policy.kind, "cost_all_time": self.policy.theory.cost_all_time, "nominal": self.nominal}
        return {**shown, "plant": self.problem.short(), "network": self.network.short(), "precision": self.precision}

    @property
    def nominal(self) -> bool:
        """True if the loop has the plant, the network and the cost of the policy's design, so that the theory holds."""
        return not self.violated_assumptions

    @cached_property
    def in_units(self) -> Loop:
        """The loop in the plant's own units, as nodes run it, instead of in deviations from the operating point."""
        if self.problem.plant.operating_point is None:
            return self
        told = self.violated_assumptions or ("states and inputs are in the units of the plant",)
        problem, policy = self.problem.in_units, self.policy.in_units
        return replace(self, problem=problem, policy=policy, violated_assumptions=told, counted=self)

    @property
    def deviations(self) -> Loop:
        """The loop in deviations from the operating point. The cost weights these deviations."""
        return self.counted or self

    @property
    def departures(self) -> tuple[str, ...]:
        """The former name of ``violated_assumptions``."""
        return self.violated_assumptions

    @property
    def parts(self) -> tuple[object, ...]:
        """Parts of the loop, such as plant and network. A simulation or analysis must support the properties of all
        parts.
        """
        problem = self.problem
        return problem.source, problem.plant, problem.cost, self.network, self.policy.parts

    @property
    def identity(self) -> Identity | None:
        """The theory's formula for the cost of the loop; None if an assumption of the theory does not hold."""
        return self.policy.theory.identity if self.nominal else None

    @property
    def horizon(self) -> int | None:
        """Number of steps of one run: the horizon of the cost, or the steps until the discount is negligible; else
        None.
        """
        cost = self.problem.cost
        if cost.discount < 1:
            return int(np.ceil(np.log(NEGLIGIBLE) / np.log(cost.discount)))
        return cost.horizon

    @property
    def reducible(self) -> bool:
        """True if a simulation without the plant, driven by the innovations, has the same distribution."""
        gaussian = self.problem.gaussian and self.policy.theory.innovations is not None
        gaussian = gaussian and not self.network.late  # packets in flight are no part of the estimate
        return self.nominal and gaussian and self.horizon is None

    @cached_property
    def mute(self) -> frozenset[str]:
        """The links that never send, whatever the noise is: in no state do their decisions ask for a packet.

        Without a horizon, packets of the first steps, which set a receiver up, do not count.
        """
        plant = self.problem.plant
        program = self.whole_program().keep(sums={Sent(link) for link in self.policy.scheduled})
        begun = {("x", i): float(mean) for i, mean in enumerate(plant.mean) if not plant.covariance[i].any()}
        if isinstance(plant.changes, SampledChanges) or self.problem.loads is not None:  # starts later than step 0
            begun.clear()
        starts = [begun.get(state.start) if isinstance(state.start, tuple) else state.start for state in program.states]
        ranges = ranges_of_sums(program, starts, _SETTING_UP if self.horizon is None else 0)
        return frozenset(link for link in self.policy.scheduled if ranges[Sent(link)].high == 0)

    def program(self, uniforms: int = 0) -> Program:
        """Return the program that computes one step of the loop, including the plant and the random numbers.

        In each step, the program draws at least ``uniforms`` uniform numbers.

        Sums: COST of the stage, EXCESS (completed square, if an identity applies), packets sent on each link, and
        control variates. Outputs: the signals that ``taciturn.simulation`` records.
        """
        return with_draws(with_controls(self.whole_program()), uniforms)

    def open_program(self) -> Program:
        """Return the program that computes one step of the loop from given noise.

        Inputs: process noise ``w``, measurement noise ``v``, and uniform numbers. Outputs: those of ``program``, and
        ``drawn``, the uniform numbers that the policy draws; if packets arrive within a period, also the inputs of its
        pieces. The states ``x`` come first.
        """
        whole = self.whole_program(supplied=True)
        return whole.keep(outputs=set(whole.outputs))

    def plant_program(self) -> Program:
        """Return the program that computes stage cost, state and output of the plant alone in one step, from
        the input; if packets arrive within a period, from the inputs of its pieces, one after the other.
        """
        # a state that affects neither cost nor measurement of a later step, such as a register that is measured, is an
        # output alone
        plant, targets = self.problem.plant, self.policy.targets.values()
        tick = self._tick({"x": plant.states})
        for step in (step for step in self.policy.steps if not assigned(step).keys().isdisjoint(targets)):
            tick.take(step)
        cuts, pieces, acting = self.network.cuts(self.policy.tick), self.problem.pieces, list[int]()
        for cut in (0.0,) if pieces is None else pieces.cuts:  # inputs that act one after the other
            piece = sum(begun <= cut + WHOLE for begun in cuts[1:])
            tick.signals["input"] = tick.supplied("input", plant.inputs, piece * plant.inputs)
            acting += tick.limited(tick.signals["input"], plant.saturation, APPLIED)
        tick.signals |= {} if pieces is None else {ACTING: acting}
        self._load(tick)
        outputs: dict[Name, int] = {COST: tick.form(self._stage(*self._deviate(tick)))}
        tick.signals["x"] = self._moved(tick)
        self._load(tick, ahead=True)
        measured = self._measured(tick)
        outputs |= named("y", measured[: plant.sensed]) | named(REFERENCE, measured[plant.sensed :])
        outputs |= self._sampled(tick, tick.draw_samples(self.network))
        return with_draws(tick.finish({}, outputs | named("x", tick.signals["x"])))

    def reduced_program(self) -> Program:
        """Return the program that computes one step of the loop without the plant, driven by the filter's innovations.

        It has the same distribution as ``program`` with a steady filter. Its stage cost is that of the estimate plus
        tr(QΣ).

        Raises:
            ProblemError: the loop has no innovations form.

        Source: khashooei2017
        """
        return with_draws(with_controls(self.innovations_program()))

    def innovations_program(self, begin: Begin = TimeStep) -> Program:
        """Return the program of one step of the loop, driven by the innovations. Its random numbers are inputs."""
        innovations = self.policy.theory.innovations
        if not self.reducible or innovations is None:
            raise ProblemError(
                "the loop has no innovations form; expected the plant, network and horizon of the design"
            )
        spread = factor(innovations.covariance)
        tick = self._tick({INNOVATION_DRAWS: spread.shape[1]}, begin)
        tick.signals[INNOVATION_DRAWS] = tick.supplied(NORMAL, spread.shape[1])
        tick.draw_losses(self.policy, self.network)
        steps = self.policy.steps
        if innovations.signal is None:
            expected = tick.combine(innovations.predicted, len(spread))
            tick.signals["y"] = add_values(tick, expected, tick.combine({INNOVATION_DRAWS: spread}, len(spread)))
            measure(tick, self.policy, tick.signals["y"])
        else:
            steps = tuple(replaced(step, innovations.signal, INNOVATION_DRAWS, spread) for step in steps)
        carry_out(tick, self.policy, steps, None)
        self._add_sums(tick)
        error = float(np.trace(self.problem.Q @ innovations.error_covariance))
        stage = tick.form(self._stage(innovations.estimate, "applied", error))
        return tick.finish(self._sums(tick, stage), self._outputs(tick, ()))

    def start(self, program: Program, paths: int, seed: int, first: int = 0, stationary: bool = False) -> Array:
        """Draw the initial states of a program, (states, paths), for the simulated paths ``first``, ``first`` + 1, …

        A ``stationary`` start begins after the last change of the loads, and at a random step of a timetable of
        set-points. If the policy also repeats a
        schedule, only steps at which the schedule starts are drawn, so that schedule and timetable keep their offset.
        """
        plant, network = self.problem.plant, self.network
        x, draws = self.start_of_plant(paths, seed, first)
        drawn = {"x": x, GENERATOR: seed_generators(seed, paths, first)}
        laws = {link_state(link): network.burst(link) for link in network.links}
        laws |= {sample_state(node): law for node, law in network.missing.items() if isinstance(law, LossLaw)}
        for link in self.network.late:
            law = self.network.random_delay(link, self.policy.tick)
            if law is not None and law.sequence:
                drawn[place_of(link)] = draws.integers(len(law.sequence), size=paths).astype(np.float64)[None]
        for name, burst in laws.items():
            if burst is not None:
                drawn[name] = burst.pick(draws.random(paths)).astype(np.float64)[None]
        changes = plant.changes
        if stationary and isinstance(changes, SampledChanges):
            rows = len(changes.table)
            phase = gcd(self.policy.cycle, rows)
            place = phase * draws.integers(rows // phase, size=paths)
            x[-changes.size :] += (np.cumsum(changes.table, axis=0) - changes.table)[place].T
            drawn[TIMETABLE] = place.astype(np.float64)[None]
        begun: dict[str, tuple[str, int] | float] = {TIMETABLE: (TIMETABLE, 0)} if TIMETABLE in drawn else {}
        if stationary and self.problem.loads is not None:
            begun[LOADED] = float(len(self.problem.loads.table) - 1)
        starts = [begun.get(state.name, state.start) for state in program.states]
        rows = [drawn[at[0]][at[1]] if isinstance(at, tuple) else np.full(paths, at) for at in starts]
        return np.array(rows).reshape(len(rows), paths)

    def start_of_plant(self, paths: int, seed: int, first: int = 0) -> tuple[Array, np.random.Generator]:
        """Draw the initial states of the plant, (n, paths). Also return the random number generator, for more draws."""
        plant, loads = self.problem.plant, self.problem.loads
        draws = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(first,)))
        spread = factor(plant.covariance)
        mean = plant.mean if loads is None else plant.mean + loads.start
        return mean[:, None] + spread @ draws.standard_normal((paths, spread.shape[1])).T, draws

    def final_cost(self, program: Program, states: Array, name: str = "x") -> Array | None:
        """Compute the terminal cost of each path, (paths,); return None if the cost does not weight the final state.

        Args:
            program: a program with the state ``x``.
            states: its states after the last step, (states, paths).
            name: name of the state of the plant in the program.
        """
        terminal = self.problem.terminal
        if terminal is None:
            return None
        rows = {(state.name, state.index): row for state, row in zip(program.states, states, strict=True)}
        # a state of a baseline that equals the state of the loop at every step was merged with it
        x = np.array([rows.get((name, i), rows.get(("x", i))) for i in range(self.problem.plant.states)])
        x = self.from_final_target(x.T).T
        return np.einsum("ip,ij,jp->p", x, terminal, x)

    def from_final_target(self, x: Array) -> Array:
        """Return the final states minus their target, which may be a set-point, an operating point, or their sum."""
        tracking, rest = self.policy.tracking, self.problem.rest
        x = x if tracking is None else x - tracking.final
        return x if rest is None else x - rest.x

    def checked_steps(self, steps: object) -> int:
        """Check that a number of steps is at least 1 and at most the horizon of the cost, and return it.

        Raises:
            ProblemError: the number is invalid.
        """
        wanted, horizon = count("steps", steps), self.problem.cost.horizon
        if horizon is not None and wanted > horizon:
            raise ProblemError(f"steps is {wanted}, but the horizon is {horizon}; expected at most {horizon}")
        return wanted

    def _tick(self, extra: Mapping[str, int], begin: Begin = TimeStep) -> TimeStep:
        plant = self.problem.plant
        sizes = {**extra, APPLIED: plant.inputs, WEIGHT: 1}
        initial = {"x": "x", WEIGHT: np.ones(1), APPLIED: first_input(self.policy, plant)}
        return begin_time_step(self.policy, self.network, sizes, initial, self.precision, begin)

    def whole_program(self, supplied: bool = False, begin: Begin = TimeStep) -> Program:
        """Return the program that computes one step of the loop, including the plant. Its random numbers are inputs."""
        # These are normal numbers, or with ``supplied`` the noise ``w`` and ``v``. ``begin`` is the class of the step.
        tick, pieces = self._tick({"x": self.problem.plant.states}, begin), self.problem.pieces
        if supplied:
            tick.recall("x")  # so that x is the first state
        tick.draw_losses(self.policy, self.network, (0.0,) if pieces is None else pieces.cuts)
        self._load(tick)
        known, sensed = tick.draw_samples(self.network), sensed_by(self.policy)
        absent = {signal: [known[node]] * len(rows) for signal, (node, rows) in sensed.items() if node in known}
        measured = measure(tick, self.policy, self._measured(tick, supplied), absent)
        tick.signals["y"] = measured[: self.problem.plant.sensed]
        tick.signals[REFERENCE] = measured[self.problem.plant.sensed :]
        carry_out(tick, self.policy, self.policy.steps, self.problem.plant.saturation)
        self._add_sums(tick)
        stage = tick.form(self._stage(*self._deviate(tick)))
        outputs = self._outputs(tick, ("x",))
        outputs |= self._sampled(tick, known) | named("drawn", tick.thresholds if supplied else ())
        outputs |= tick.delays() | (named(ACTING, tick.signals.get(ACTING, ())) if supplied else {})
        tick.signals["x"] = self._moved(tick, supplied)
        return tick.finish(self._sums(tick, stage), outputs)

    def _measured(self, tick: TimeStep, supplied: bool = False) -> list[int]:
        plant, loads = self.problem.plant, self.problem.loads
        shown = {} if loads is None or not loads.shown.any() else {LOAD: loads.shown}
        y = tick.combine({"x": plant.C, **shown}, plant.outputs)
        if supplied:
            return add_values(tick, y, tick.supplied("v", plant.outputs))
        return add_values(tick, y, draw_noise(tick, factor(plant.V))) if plant.V.any() else y

    def _load(self, tick: TimeStep, ahead: bool = False) -> None:
        """Set the signal with the loads of the step, or of the next one."""
        if self.problem.loads is not None:
            tick.signals[LOAD] = read_loads(tick, self.problem.loads, ahead)

    def _sampled(self, tick: TimeStep, known: Mapping[str, Truth]) -> dict[Name, int]:
        """Return for each output 1 if it is measured in this step, and 0 if not; nothing if no sample is missing."""
        found = [tick.builder.constant(1.0)] * self.problem.plant.sensed
        for node, rows in sensed_by(self.policy).values():
            for row in rows if node in known else ():
                found[row] = tick.as_number(known[node])
        return named(SAMPLED, found) if known else {}

    def _moved(self, tick: TimeStep, supplied: bool = False) -> list[int]:
        plant, loads = self.problem.plant, self.problem.loads
        pushed = {} if loads is None else {LOAD: loads.moves}
        if plant.function is not None:
            noise = self._disturbance(tick, supplied) or [tick.builder.constant(0.0)] * plant.states
            given = {"x": tick.read("x"), "u": tick.read("applied"), "w": noise}
            moved = trace(tick.builder, plant.function.function, given, {"x": plant.states})["x"]
            return add_values(tick, moved, tick.combine(pushed, plant.states)) if pushed else moved
        drift = {} if plant.drift is None else {ONE: plant.drift[:, None]}
        pieces = self.problem.pieces
        effect = {"applied": plant.B} if pieces is None or ACTING not in tick.signals else {ACTING: pieces.B}
        moved = tick.combine({"x": plant.A, **effect, **drift, **pushed}, plant.states)
        noise = self._disturbance(tick, supplied)
        return add_values(tick, moved, noise) if noise else moved

    def _disturbance(self, tick: TimeStep, supplied: bool) -> list[int]:
        """Return the process noise w, as an input or drawn; an empty list if it is 0."""
        plant, jumps = self.problem.plant, self.problem.jumps
        if supplied:
            return tick.supplied("w", plant.states)
        if not plant.W.any():
            return []
        if plant.changes is not None:
            return add_changes(tick, plant.W, plant.changes)
        return draw_noise(tick, factor(plant.W)) if jumps is None else add_jumps(tick, jumps)

    def _deviate(self, tick: TimeStep) -> tuple[str, str]:
        """Return the signals that the cost weights: state and input, or their deviations from their targets."""
        rest, targets, pieces = self.problem.rest, self.policy.targets, self.problem.pieces
        state = deviation(tick, "x", targets.get("x"), rest and rest.x)
        if pieces is not None and ACTING in tick.signals:
            if targets.get("applied"):
                raise ProblemError(
                    "the reference states inputs at each step, and packets arrive at random within a period; expected "
                    "delays of whole periods, a buffer, or no [reference]"
                )
            return state, deviation(tick, ACTING, None, rest and np.tile(rest.u, len(pieces.cuts)))
        return state, deviation(tick, "applied", targets.get("applied"), rest and rest.u)

    def _stage(self, state: str, applied: str, constant: float = 0.0) -> Form:
        p, loads = self.problem, self.problem.loads
        acts = p if p.pieces is None or not applied.startswith(ACTING) else p.pieces
        M = np.block([[p.Q, acts.N], [acts.N.T, acts.R]])
        if loads is None or not loads.weights.any() or constant:  # of an estimate without the plant, there is none
            return Form((state, applied), M, constant)
        return Form((state, applied, LOAD), np.hstack([np.vstack([M, loads.weights[: len(M)].T]), loads.weights]))

    def _add_sums(self, tick: TimeStep) -> None:
        """Set the signals that the theory computes from those of several nodes."""
        for name, terms in self.policy.theory.sums.items():
            tick.signals[name] = tick.combine(terms, shape_of(next(iter(terms.values())))[0])

    def _sums(self, tick: TimeStep, stage: int) -> dict[Name, int]:
        sums: dict[Name, int] = {COST: stage}
        if self.identity is not None:
            sums[EXCESS] = tick.pick(self.identity.on, [tick.form(form) for form in self.identity.forms])
        sums |= {Sent(link): tick.as_number(tick.sent[link]) for link in self.policy.scheduled}
        sums |= {Silence(links): tick.read(one.added)[0] for links, one in self.policy.theory.silence.items()}
        discount = self.problem.cost.discount
        if discount < 1:
            (weight,) = tick.read(WEIGHT)
            tick.signals[WEIGHT] = [tick.builder.scale(discount, weight)]
            sums = {name: tick.builder.emit("mul", weight, value) for name, value in sums.items()}
        return sums

    def _outputs(self, tick: TimeStep, more: tuple[str, ...]) -> dict[Name, int]:
        names = ("y", REFERENCE, "estimate", "applied", *self.policy.targets.values())
        shown = [*more, *(name for name in names if name in tick.signals)]
        outputs: dict[Name, int] = {}
        for signal in shown:
            outputs |= named(signal, tick.signals[signal])
        return outputs | tick.option_values() | tick.scalars | tick.packets()


def close(
    plant: Plant | ContinuousPlant, policy: Policy, network: Network | None = None, cost: Cost | None = None
) -> Loop:
    """Close the loop of a plant, a policy and a network.

    Args:
        plant: the controlled plant, which may differ from the plant of the design. If the policy assumes a slow
            disturbance that the plant lacks, it is added.
        policy: a policy from ``taciturn.design``, or a user-defined one.
        network: the network; default: the network of the design.
        cost: the cost to measure; default: the cost that the policy was designed for.

    Returns:
        The loop.

    Raises:
        InformationError: a node uses a signal that is not available to it.
        ProblemError: the sizes of plant, policy and cost differ, the policy does not support a property of the network,
            or the plant of the design has a property that only a simulated plant can have.

    Source: khashooei2017
    """
    instance("policy", policy, Policy)
    cost = policy.cost if cost is None else cost
    if cost is None:
        raise ProblemError(
            f"cost is missing, and the policy {policy.kind} was designed without a cost; expected a cost for the loop"
        )
    network = policy.network if network is None else network
    instance("plant", plant, Plant, ContinuousPlant)
    instance("network", network, Network)
    plant, network = delayed_by(plant, network), network.played()
    assumed, stated = policy.disturbance, plant.names
    # the states without this disturbance and without set-points, with which no other external signals are used
    without = policy.model.stated - policy.model.set_points - policy.model.inputs
    if assumed is not None and plant.states == without:
        plant = assumed.added_to(plant, cost.mission)
    if assumed is not None and len(cost.Q) == without:
        cost = padded(cost, policy.model.inputs)
    period, model = policy.tick if isinstance(plant, ContinuousPlant) else None, policy.model
    problem = discretise(plant, cost, period, policy.prediction, network.cuts(policy.tick))
    for name, size in (("state", "stated"), ("input", "inputs"), ("output", "outputs")):
        got, expected = getattr(problem.plant, size), getattr(model, size)
        if got != expected:
            raise ProblemError(
                f"the plant of the loop has {number_of(got, name)}; expected {number_of(expected, name)}, as in the "
                "plant of the policy's design"
            )
    problem = replace(problem, plant=about(problem.plant, point_with(problem, model)))
    problem = with_same_start(problem, model) if model.registers and problem.plant.registers else problem
    problem = with_loads(problem, plant)
    SIMULATED.check(network, policy.parts, policy.designed_for)
    policy = with_intervals(policy, network)
    check_network(policy, network)
    check_plants(problem, policy)
    if policy.tracking is not None and policy.cost is not None and cost.horizon != policy.cost.horizon:
        raise ProblemError(
            f"cost.horizon is {cost.horizon}, but the reference has {number_of(policy.cost.horizon, 'step')}; "
            "expected a horizon as long as the reference"
        )
    # the changes of a disturbance that the design estimates or knows are a transient, which an average does not see
    passing = not cost.mission and all(one.signal is not None for one in plant.loads)
    covers = policy.theory.covers | (LOADS if passing else frozenset[str]())
    missing = uncovered(covers, plant, problem.plant, cost, network, policy.parts)
    loop = Loop(problem, policy, network, list_violations(problem, policy, network, missing), names=stated)
    return loop.in_units if network.rounded else loop  # the rounding depends on the units
