"""One simulated path of a closed loop with all signals at every step, and the mean course of many paths.

``simulate`` records states, estimates, inputs, measurements, sends, and the two values that a send decision compares:
the least value of an option without the packet, and the least value of one with it. It uses the bit-exact build, so
nodes with the recorded measurements compute the recorded inputs bit for bit. If the actuator predicts, the recorded
estimate is its prediction, and the input u = L x̂ is that at the beginning of the step.

``course`` averages stage cost and sends at each step over independent paths. For an average cost it divides by the
period, so that the course converges to the average; for a finite horizon or a discount, the stages and the final cost
add up to the total. The cost of the noise between samples, which no control changes, is added.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, count, instance
from taciturn._figure import Panel, Series, Size, Style, draw
from taciturn._text import pairs_text, table_text, wrapped_text
from taciturn.errors import ProblemError
from taciturn.loop import COST, Loop, close
from taciturn.model.estimate import Estimate
from taciturn.model.policy import Policy, own_problem
from taciturn.model.result import FIRST, LAST, Column, Columns, Field, Result, Tabular, plain_fields
from taciturn.model.steps import Send
from taciturn.program.engine import prepare
from taciturn.program.ops import Name, Option, Sent, is_entry
from taciturn.simulation.sampling import expect_numbers, find_loss, sends
from taciturn.simulation.statistics import mean

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ADDRESSES = 2**47  # bytes that a process can address, of which NumPy refuses more in other ways
_COLUMNS = 6  # columns next to the time that ``str`` prints
_PATHS = 4096


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Tabular):
    """Signals and sends of one simulated path of a loop at every step.

    Args:
        time: time of each step, (steps,).
        unit: unit of the time: ``"s"``, or ``"steps"`` if the plant has no ``dt``.
        state: state of the plant, (steps, n).
        estimate: estimate x̂, (steps, n); empty if the policy has none. If the actuator predicts, it is the prediction.
        input: input applied to the plant, (steps, m); if the actuator predicts, the input at the beginning of the step.
        trigger_value: value of silence in the send decision, (steps,); for a policy that plans its sends in advance, it
            indicates whether or when a send is due. It is empty if no send decision depends on signals; if several do,
            the first one is recorded.
        threshold: least value of sending in this decision; nothing is sent while trigger_value ≤ threshold.
        sends: whether a packet was sent at each step, by link, (steps,).
        measurement: measurement y, (steps, p).
        predicts: whether the actuator integrates the model dx̂/dt = (A + BL) x̂ between steps, and applies u = L x̂.
    """

    FIELDS: ClassVar[tuple[Field[Trajectory], ...]] = (
        Field("ticks", lambda found: len(found.time)),
        *plain_fields("time", "unit", "state", "estimate", "input", "predicts", "measurement"),
        *plain_fields("trigger_value", "threshold", "sends"),
    )
    index: ClassVar[str] = "time"
    heading: ClassVar[tuple[str, ...]] = ("unit",)

    time: Array
    unit: str
    state: Array
    estimate: Array
    input: Array
    trigger_value: Array
    threshold: Array
    sends: dict[str, npt.NDArray[np.bool_]]
    measurement: Array
    predicts: bool = False

    def summary(self) -> Mapping[str, object]:
        """Return the number of steps, the sends on each link, and the sizes of the signals by name."""
        sends = {link: f"{int(sent.sum())} of {len(sent)}" for link, sent in self.sends.items()}
        last = f"0 to {self.time[-1]:.6g} {self.unit}"
        return {"steps": len(self.time), "time": last, "sends": sends, "state": self.state, "input": self.input}

    def plot(self, ax: Any = None, figsize: Size | None = None) -> Figure:
        """Return a figure of states, estimates or predictions (dotted), inputs, sends, and trigger with threshold."""
        time = self.time.tolist()
        states = [Series(time, x.tolist(), f"$x_{{{i + 1}}}$", color=i) for i, x in enumerate(self.state.T)]
        names = [f"prediction of $x_{{{i + 1}}}$" if self.predicts else "" for i in range(self.estimate.shape[1])]
        states += [Series(time, x.tolist(), names[i], "dotted", color=i) for i, x in enumerate(self.estimate.T)]
        style: Style = "line" if self.predicts else "steps"  # an input that is predicted changes between steps
        inputs = [Series(time, u.tolist(), f"$u_{{{i + 1}}}$", style) for i, u in enumerate(self.input.T)]
        panels = [Panel(states, ylabel="state", beside=True), Panel(inputs, ylabel="input", beside=True)]
        if self.trigger_value.size:
            crossed = [
                Series(time, self.trigger_value.tolist(), "trigger", "line"),
                Series(time, self.threshold.tolist(), "threshold", "dashed"),
            ]
            panels.append(Panel(crossed, ylabel="trigger", beside=True))
        marks = [
            Series(
                self.time[sent].tolist(),
                [1.0] * int(sent.sum()),
                f"{link}: {int(sent.sum())} of {len(sent)}",
                "stems",
                color=i,
            )
            for i, (link, sent) in enumerate(self.sends.items())
        ]
        panels.append(Panel(marks, f"time ({self.unit})", "sends", names=("", "sent"), beside=True))
        return draw(panels, ax, figsize, height=1.9 * len(panels))

    def __str__(self) -> str:
        """Return the text that ``taciturn simulate`` prints: the path, as far as it fits, and the number of sends."""
        named = [("x", self.state), ("u", self.input), *([("xhat", self.estimate)] if self.predicts else [])]
        columns = [(f"{name}{i + 1}", column) for name, values in named for i, column in enumerate(values.T)]
        left = max(0, len(columns) - (_COLUMNS - len(self.sends)))
        shown = columns[: len(columns) - left]
        header = [f"time ({self.unit})", *(name for name, _ in shown), *self.sends]
        rows = [
            [
                f"{time:.6g}",
                *(f"{column[k]:z.4g}" for _, column in shown),
                *("sent" * bool(s[k]) for s in self.sends.values()),
            ]
            for k, time in enumerate(self.time)
        ]
        cut = len(rows) > FIRST + LAST
        parts = [table_text(header, [*rows[:FIRST], ["…"] * len(header), *rows[-LAST:]] if cut else rows, 1)]
        if left or cut:
            what = " and ".join(["columns"] * bool(left) + ["steps"] * cut)
            parts.append(wrapped_text(f"some {what} are omitted; --json, --table and to_pandas() contain all of them"))
        counts = [(f"sends, {link}", f"{int(sent.sum())} of {len(sent)} steps") for link, sent in self.sends.items()]
        if self.predicts:
            counts.append(("xhat", "prediction of x by the actuator's model, which gives the input u = L xhat"))
        return "\n".join([*parts, pairs_text(counts)])

    def columns(self) -> Columns:
        """Return a table with one row per step: states, estimates, inputs, measurements, trigger and sends."""
        columns: dict[str, Column] = {"time": self.time}
        for name, values in (("x", self.state), ("xhat", self.estimate), ("u", self.input), ("y", self.measurement)):
            columns |= {f"{name}{i + 1}": column for i, column in enumerate(values.T)}
        if self.trigger_value.size:
            columns |= {"trigger": self.trigger_value, "threshold": self.threshold}
        columns |= {f"sent_{link}": sent for link, sent in self.sends.items()}
        return columns


def simulate(loop: Loop | Policy, ticks: int, *, seed: int = 0) -> Trajectory:
    """Simulate one path of a loop from its initial distribution, and record all signals.

    The numbers are those of the bit-exact build: nodes that get the recorded measurements compute the recorded inputs
    bit for bit. Averages over many paths (``evaluate``, ``average``) use the fast build, which may differ in the last
    bits of a step.

    Args:
        loop: the closed loop, or a policy, which is closed with the plant, cost and network that it was designed for.
        ticks: number of steps, at least 1, and not beyond the end of a finite-horizon run.
        seed: seed of the random draws.

    Returns:
        The trajectory.

    Raises:
        ProblemError: steps or seed are out of range.
        UnstableError: the function of a nonlinear plant gives a non-finite number.

    Example:
        >>> from taciturn import Cost, Plant, close, design
        >>> plant, cost = Plant([[1.2]], [[1.0]], [[0.01]]), Cost([[1.0]], [[1.0]])
        >>> simulate(close(plant, design.lqg(plant, cost, theta=0.5), cost=cost), 50).state.shape
        (50, 1)
    """
    if isinstance(loop, Policy):
        plant, cost, network = own_problem(loop)
        loop = close(plant, loop, network, cost)
    instance("loop", loop, Loop)
    point, loop = loop.problem.plant.operating_point, loop.in_units
    ticks = loop.ticks(ticks)
    count("seed", seed, 0)
    program = loop.program()
    program = program.keep(outputs=set(program.outputs))
    size = 8 * ticks * len(program.outputs)
    try:
        if size > _ADDRESSES:
            raise MemoryError
        outputs = prepare(program, exact=True)(loop.start(program, 1, seed), ticks, 1).outputs
    except MemoryError:
        raise ProblemError(
            f"ticks is {ticks}, and a record of so many steps needs {size / 1e9:.3g} GB, more memory than there is; "
            "expected fewer steps, or an evaluation, which records none"
        ) from None
    records = {name: values[:, 0] for name, values in outputs.items()}

    def stacked(name: str) -> Array:
        rows = [values for key, values in records.items() if is_entry(key, name)]
        return np.array(rows).T if rows else np.empty((ticks, 0))

    states = stacked("x")
    expect_numbers(loop, states)
    silent, others = _weighed(loop.policy, records)
    sends = {name.link: values > 0 for name, values in records.items() if isinstance(name, Sent)}
    dt = loop.problem.plant.dt
    time, unit = np.arange(ticks, dtype=np.float64) * (dt or 1.0), "steps" if dt is None else "s"
    estimate, applied, measured = map(stacked, ("estimate", "applied", "y"))
    model = loop.policy.prediction
    if model is not None:  # the sampled plant takes the state of the actuator's model as its input
        estimate, applied = applied, (applied if point is None else applied - point.x) @ model.L.T
        own = None if loop.problem.source is None else loop.problem.source.operating_point
        applied = applied if own is None else applied + own.u
    return Trajectory(time, unit, states, estimate, applied, silent, others, sends, measured, model is not None)


def _weighed(policy: Policy, records: Mapping[Name, Array]) -> tuple[Array, Array]:
    """Return the least values of the options without and with the packet; they are empty for a schedule."""
    for step in policy.steps:
        if isinstance(step, Send) and step.on is not None and policy.decisions[step.on].reads:
            labels = policy.decisions[step.on].labels
            sending = step.sending(labels)
            values = {label: records[Option(step.on, label)] for label in labels}
            silent = [value for label, value in values.items() if label not in sending]
            if silent:
                return np.min(silent, axis=0), np.min([values[label] for label in sending], axis=0)
    return np.empty(0), np.empty(0)


@dataclass(frozen=True, eq=False, repr=False)
class Course(Result):
    """Mean stage cost and sends of a loop over time, with standard errors."""

    # For an average cost, the stage cost is per unit of time, so that it converges to the average. For a finite horizon
    # or a discount, it is the weighted cost of each step, so that the stage costs and the final cost add up to the
    # total.

    time: Array  # time in seconds, or in steps if the plant has no ``dt``, (steps,)
    cost: Array  # mean of x'Qx + û'Rû + 2x'Nû, (steps,)
    standard_error: Array  # standard error of the cost, (steps,)
    sends: Mapping[str, Array]  # fraction of the paths that send, by link, (steps,)
    sends_standard_error: Mapping[str, Array]  # standard error of these fractions, (steps,); 0 if all paths agree
    final: Estimate | None  # mean cost of the final state
    paths: int  # number of paths


def course(loop: Loop, ticks: int, *, paths: int = _PATHS, seed: int = 0) -> Course:
    """Simulate independent paths of a loop from its initial distribution, and average cost and sends at each step."""
    instance("loop", loop, Loop)
    ticks, paths, seed = loop.ticks(ticks), count("paths", paths, 2), count("seed", seed, 0)
    names = sends(loop)
    program = loop.program().keep({COST}, {*names}, {"x"})
    run, states = prepare(program), loop.start(program, paths, seed)
    state = [i for i, one in enumerate(program.states) if one.name == "x"]
    cost, sent = list[Estimate](), list[list[Estimate]]()
    for _ in range(ticks):
        found = run(states, 1, None)
        if not np.isfinite(found.states[state]).all():
            find_loss(loop, program, run, states, 1)
        states = found.states
        cost.append(mean(found.sums[COST]))
        sent.append([mean(found.outputs[name][0]) for name in names])
    final = loop.final_cost(program, states) if ticks == loop.problem.cost.horizon else None
    problem, unit = loop.problem, 1.0 if loop.horizon is not None else loop.problem.tick
    noise: Array = problem.noise_cost * np.power(problem.cost.discount, np.arange(float(ticks)))
    return Course(
        np.arange(ticks, dtype=np.float64) * (problem.plant.dt or 1.0),
        (np.array([stage.value for stage in cost]) + noise) / unit,
        np.array([stage.standard_error for stage in cost]) / unit,
        {link: np.array([tick[i].value for tick in sent]) for i, link in enumerate(loop.policy.scheduled)},
        {link: np.array([tick[i].standard_error for tick in sent]) for i, link in enumerate(loop.policy.scheduled)},
        None if final is None else mean(final),
        paths,
    )
