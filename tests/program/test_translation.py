"""Translation: the program of a loop does what its steps say, told again here step by step for one path at a time."""

from __future__ import annotations

import numpy as np
import pytest
from catalogue import POLICIES, closed
from drawn import law
from hypothesis import strategies as st
from parity.loops import every_feature, with_functions
from systems import System, systems

from taciturn import Trigger
from taciturn._modes import factor
from taciturn.errors import TaciturnError
from taciturn.loop import Loop
from taciturn.model.steps import ONE, Apply, Assign, Condition, Decide, Draw, Evaluate, Received, Send, Step
from taciturn.model.trigger import Form, Scheduled
from taciturn.program.ir import Builder, Program
from taciturn.program.numpy import run
from taciturn.program.ops import Entry, Sent
from taciturn.program.translation import TimeStep

SEEDS = st.integers(0, 2**32 - 1)


class Told:
    """A path of a loop as its steps are read aloud: matrices times vectors, one step after the other."""

    def __init__(self, loop: Loop) -> None:
        """Start before the first step."""
        self.loop, self.policy = loop, loop.policy
        self.signals = {name: np.zeros(size) for name, size in self.policy.sizes.items()} | dict(self.policy.initial)
        self.signals |= {"x": loop.problem.plant.mean, ONE: np.ones(1)}
        self.locations = {location.name: location.initial for location in self.policy.locations}
        self.outcome: dict[str, int] = {}
        self.sent: dict[str, bool] = {}
        self.arrived: dict[str, bool] = {}

    def tick(self, v: np.ndarray, uniforms: np.ndarray, w: np.ndarray) -> float:
        """Take one step with these normals and uniforms; return its stage cost."""
        problem, plant = self.loop.problem, self.loop.problem.plant
        self.uniforms = iter(uniforms)
        x = self.signals["x"]
        self.signals["y"] = plant.C @ x + factor(plant.V) @ v
        for step in self.policy.steps:
            self.take(step)
        u = self.signals["input"]
        self.signals["x"] = plant.A @ x + plant.B @ u + factor(plant.W) @ w
        moves = {
            location.name: location.table[self.locations[location.name]]
            if location.on is None
            else location.table[self.locations[location.name], self.which(location.on)]
            for location in self.policy.locations
        }
        self.locations = {name: int(index) for name, index in moves.items()}
        return float(x @ problem.Q @ x + 2 * x @ problem.N @ u + u @ problem.R @ u)

    def take(self, step: Step) -> None:
        """Take one step."""
        if isinstance(step, Assign):
            terms = step.branches[self.which(step.on)]
            self.signals[step.signal] = sum(self.read(matrix) @ self.signals[name] for name, matrix in terms.items())
        elif isinstance(step, Evaluate):
            self.signals[step.signal] = np.array([self.value(step.forms[self.which(step.on)])])
        elif isinstance(step, Apply):
            found = step.function(*(self.signals[name] for name in step.reads))
            values = found if len(step.signals) > 1 else (found,)
            self.signals |= {name: np.ravel(value) for name, value in zip(step.signals, values, strict=True)}  # type: ignore[call-overload]
        elif isinstance(step, Draw):
            self.signals[step.signal] = np.array([-np.log(next(self.uniforms))])  # exponential, by inversion
        elif isinstance(step, Decide):
            self.outcome[step.decision] = int(np.argmin([self.value(form) for form in step.trigger.options.values()]))
        else:
            labels = self.policy.decisions[step.on].labels if step.on else ()
            self.sent[step.link] = not step.on or labels[self.outcome[step.on]] in (step.labels or labels[1:])
            loss = self.loop.network.loss(step.link)
            self.arrived[step.link] = (loss == 0 or next(self.uniforms) > loss) and self.sent[step.link]

    def which(self, condition: Condition | None) -> int:
        """Return the index of the outcome."""
        if condition is None:
            return 0
        return self.outcome[condition] if isinstance(condition, str) else int(self.arrived[condition.link])

    def read(self, value: object) -> np.ndarray:
        """Return a matrix, or the entry of a table at the location now."""
        return value.values[self.locations[value.by]] if isinstance(value, Scheduled) else np.asarray(value)

    def value(self, form: Form) -> float:
        """Return the value of a form."""
        stacked = np.concatenate([self.signals[name] for name in form.signals]) if form.signals else np.zeros(0)
        square = 0.0 if form.Psi is None else stacked @ self.read(form.Psi) @ stacked
        added = sum(weight * self.signals[name][0] for name, weight in form.plus.items())
        bell = 0.0 if form.bell is None else form.bell.height * np.exp(-0.5 * stacked @ form.bell.Pi @ stacked)
        return float(square + bell + added + self.read(form.constant))


def undrawn(loop: Loop) -> Program:
    """Return the program of a loop whose draws are inputs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("taciturn.loop.with_draws", lambda program, uniforms: program)
        return loop.program()


def assert_told(loop: Loop, seed: int, ticks: int = 30, paths: int = 4) -> None:
    """Check that program and steps agree on cost, sends and inputs, to rounding."""
    program, plant, policy = undrawn(loop), loop.problem.plant, loop.policy
    lossy = (loop.network.loss(step.link) > 0 for step in policy.steps if isinstance(step, Send))
    uniforms = sum(isinstance(step, Draw) for step in policy.steps) + sum(lossy)
    before, after = (factor(covariance).shape[1] for covariance in (plant.V, plant.W))
    names = [Entry("normal", i) for i in range(before)] + [Entry("uniform", i) for i in range(uniforms)]
    names += [Entry("normal", len(names) + i) for i in range(after)]  # names count what was drawn before
    draws = np.random.default_rng(seed)
    drawn = {"uniform": draws.random, "normal": draws.standard_normal}
    values = np.array([drawn[name.signal]((ticks, paths)) for name in names])
    values = values.reshape(len(names), ticks, paths).swapaxes(0, 1)
    means = [plant.mean[state.index] if state.name == "x" else state.start for state in program.states]
    states = np.repeat(np.array(means).reshape(-1, 1), paths, axis=1)
    result = run(program, states, ticks, values[:, [names.index(name) for name in program.inputs]])
    for path in range(paths):
        told, total = Told(loop), 0.0
        for tick in range(ticks):
            v, drawn, w = np.split(values[tick, :, path], [before, before + uniforms])
            total += loop.problem.cost.discount**tick * told.tick(v, drawn, w)
            for link, sent in told.sent.items():
                assert result.outputs[Sent(link)][tick, path] == sent
            for i, value in enumerate(told.signals["input"]):
                assert result.outputs[Entry("applied", i)][tick, path] == pytest.approx(value, rel=1e-6, abs=1e-8)
        assert result.sums["cost"][path] == pytest.approx(total, rel=1e-6)


@law(3, 40, system=systems(), seed=SEEDS)
def test_losses_schedules_memories_draws_and_three_labels_mean_what_they_say(system: System, seed: int) -> None:
    """The policy with every feature, on random systems."""
    assert_told(every_feature(system, seed), seed)


@law(2, 25, system=systems(states=4), seed=SEEDS)
def test_steps_that_are_functions_mean_what_they_say(system: System, seed: int) -> None:
    """What NumPy makes of floats, call by call."""
    assert_told(with_functions(system, seed), seed)


@law(3, 40, system=systems(), name=st.sampled_from(sorted(POLICIES)), seed=SEEDS)
def test_the_policies_of_the_catalogue_mean_what_they_say(system: System, name: str, seed: int) -> None:
    """Hold and model, by the clock and by the trigger, remote and lossy, averages and finite-horizon runs."""
    try:
        loop = closed(POLICIES[name](system))
    except TaciturnError:
        return
    assert_told(loop, seed)


@law(8, 100, seed=SEEDS, labels=st.integers(2, 5))
def test_the_first_of_the_cheapest_labels_is_picked(seed: int, labels: int) -> None:
    """Among up to five labels, with ties."""
    values = np.random.default_rng(seed).integers(0, 3, (20, labels)).astype(float)
    b = Builder()
    tick = TimeStep(b, {}, {}, ())
    for i in range(labels):
        tick.signals[f"v {i}"] = [b.input(f"in {i}")]
    trigger = Trigger({f"label {i}": Form(plus={f"v {i}": 1.0}) for i in range(labels)})
    tick.take(Decide("controller", "choice", trigger))
    program = tick.finish({}, {"picked": tick.pick("choice", [b.constant(float(i)) for i in range(labels)])})
    picked = run(program, np.zeros((0, 1)), 20, values[:, :, None]).outputs["picked"][:, 0]
    assert list(picked) == list(values.argmin(axis=1))


def test_a_signal_read_before_it_is_assigned_is_that_of_the_tick_before() -> None:
    """A delay is an order of events; so is the arrival of a packet."""
    b = Builder()
    tick = TimeStep(b, {"old": 1, "new": 1}, {"new": np.array([7.0])}, ())
    tick.take(Assign("controller", "old", {"new": [[1.0]]}))
    tick.signals["new"] = [b.input("in 0")]
    program = tick.finish({}, {"old": tick.signals["old"][0]})
    supplied = np.arange(4.0).reshape(4, 1, 1)
    start = np.array([[state.start] for state in program.states])
    assert list(run(program, start, 4, supplied).outputs["old"][:, 0]) == [7, 0, 1, 2]


def test_what_arrived_is_remembered_until_the_next_packet() -> None:
    """Read before this step's sending, it is what the step before brought."""
    b = Builder()
    tick = TimeStep(b, {}, {}, ())
    before = tick.as_number(tick.builder.negated(tick.happened(Received("actuator"))[0]))
    tick.signals["v"] = [b.input("in 0")]
    tick.take(Decide("controller", "send", Trigger({"silent": Form(plus={"v": 1.0}), "send": Form()})))
    tick.losses = {"actuator": 0.0}
    tick.take(Send("controller", "actuator", ("v",), "send"))
    program = tick.finish({}, {"before": before})
    supplied = np.array([1.0, -1, 1, 1, -1]).reshape(5, 1, 1)
    start = np.array([[state.start] for state in program.states])
    assert list(run(program, start, 5, supplied).outputs["before"][:, 0]) == [0, 1, 0, 1, 1]
