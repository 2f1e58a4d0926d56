"""Simulate one path of a loop under events: load disturbances, set-point steps and dropped packets.

The program of a step is that of ``simulate``, with more memories: a load on each input and a mark on each link, which
stay as they are. The path is run from event to event; in between, the memories are set, so that the noise is the same
with and without events, and for any policy of the same plant. A path without events is that of ``simulate`` bit for
bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from taciturn.errors import ProblemError, UnstableError
from taciturn.extend import Array, Displayed
from taciturn.loop import Loop
from taciturn.model.saturation import Saturation
from taciturn.model.steps import Received
from taciturn.program.draws import with_draws
from taciturn.program.engine import Runner, prepare
from taciturn.program.ir import Program, Truth
from taciturn.program.ops import Name, Sent, is_entry
from taciturn.program.translation import APPLIED, Operands, TimeStep
from taciturn.simulation.trajectory import weigh_options
from taciturn_explore.setting import Event

LOAD, DROPPED = "load at the inputs", "dropped on"
APART = 2.0**-30  # distance of the values with which loads and marks begin
HIGHEST = 1e12  # of a number of a path that is shown


@dataclass(frozen=True, eq=False, repr=False)
class Path(Displayed):
    """The signals of one simulated path at every step."""

    time: Array  # time of each step, (steps,)
    unit: str  # unit of the time, ``"s"`` or ``"steps"``
    outputs: Array  # outputs of the plant without measurement noise, (steps, p)
    references: Array  # set-points, (steps, z)
    inputs: Array  # inputs that the actuators apply, (steps, m)
    sent: Mapping[str, npt.NDArray[np.bool_]] = field(hash=False)  # whether a packet was sent, by link, (steps,)
    arrived: Mapping[str, npt.NDArray[np.bool_]] = field(hash=False)  # whether it arrived, by link, (steps,)
    # value of silence over its threshold, by decision, (steps,); only where the threshold is positive
    ratios: Mapping[str, Array] = field(hash=False)


class DisturbedStep(TimeStep):
    """One time step of a simulation that adds load disturbances to the plant's inputs and drops packets on request."""

    def __init__(self, inputs: int, links: Sequence[str], builder: Any, sizes: Any, initial: Any, *more: Any) -> None:
        """Add the memories."""
        marks = {f"{DROPPED} {link}": 1 for link in links}
        # memories that begin alike and never change would become one memory, so each of these begins elsewhere
        self._rest = {LOAD: [APART * (1 + i) for i in range(inputs)]}
        self._rest |= {mark: [APART * (1 + inputs + i)] for i, mark in enumerate(marks)}
        begun = {name: np.array(values) for name, values in self._rest.items()}
        super().__init__(builder, {**sizes, LOAD: inputs, **marks}, {**initial, **begun}, *more)

    def limited(self, values: Operands, limits: Saturation | None, memory: str) -> Operands:
        """Return the plant's input after its limits, with the load disturbance added."""
        found = super().limited(values, limits, memory)
        if memory == APPLIED:
            rest = [self.builder.constant(value) for value in self._rest[LOAD]]
            loads = [self.builder.emit("sub", *both) for both in zip(self.recall(LOAD), rest, strict=True)]
            found = [self.builder.emit("add", one, load) for one, load in zip(found, loads, strict=True)]
            self.signals[memory] = found
        return found

    def arrives(self, link: str, sent: Truth) -> Truth:
        """Return whether a packet is sent and arrives; it does not arrive if an event drops it."""
        name = f"{DROPPED} {link}"
        (mark,) = self.recall(name)
        return self.builder.both(super().arrives(link, sent), self.builder.less_equal(mark, self._rest[name][0]))


@lru_cache(maxsize=16)
def _prepared(loop: Loop) -> tuple[Program, Runner]:
    begin = partial(DisturbedStep, loop.problem.plant.inputs, tuple(loop.network.links))
    whole = with_draws(loop.whole_program(begin=begin))
    program = whole.keep(outputs=set(whole.outputs))
    return program, prepare(program, exact=True)


def run_path(loop: Loop, steps: int, seed: int, events: Sequence[Event] = ()) -> Path:
    """Simulate one path of a loop under given events."""
    loop = loop.in_units
    steps = min(steps, loop.horizon or steps)
    check_events(loop, events)
    program, run = _prepared(loop)
    places = {(state.name, state.index): row for row, state in enumerate(program.states)}
    states, parts, now = loop.start(program, 1, seed), list[Mapping[Name, Array]](), 0
    marks = {row: float(states[row, 0]) for (name, _), row in places.items() if name.startswith(DROPPED)}
    drops = {one.step for one in events if one.kind == "drop"}
    for following in sorted({one.step for one in events} | {step + 1 for step in drops} | {steps}):
        ahead = min(following, steps) - now
        if ahead > 0:
            found = run(states, ahead, 1)
            states, now = found.states, now + ahead
            parts.append(found.outputs)
        states = _changed(loop, states, places, marks, [one for one in events if one.step == now])
    records = {name: np.concatenate([part[name][:, 0] for part in parts]) for name in parts[0]}
    return _path(loop, records, steps, [one for one in events if one.kind == "load"])


def check_events(loop: Loop, events: Sequence[Event]) -> None:
    """Raise an error if an event names a link, an input or a set-point that the loop does not have."""
    plant, links = loop.problem.plant, loop.policy.scheduled
    numbers = {"load": 0 if loop.policy.prediction is not None else plant.inputs, "step": plant.set_points}
    for one in events:
        known = links if one.kind == "drop" else tuple(map(str, range(numbers[one.kind])))
        if one.where not in known:
            noun = {"drop": "link", "load": "input", "step": "set-point"}[one.kind]
            expected = f"one of {', '.join(known)}" if known else "no such event: this loop has none"
            raise ProblemError(f"the event {one.kind!r} names the {noun} {one.where}; expected {expected}")


def _changed(
    loop: Loop,
    states: Array,
    places: Mapping[tuple[str, int], int],
    marks: Mapping[int, float],
    events: Sequence[Event],
) -> Array:
    """Return the states after the events of a step; before, every mark of a link is where it began."""
    states, plant = states.copy(), loop.problem.plant
    for row, begun in marks.items():
        states[row] = begun
    for one in events:
        if one.kind == "load" and (LOAD, int(one.where)) in places:
            states[places[LOAD, int(one.where)]] += one.size
        elif one.kind == "drop" and (f"{DROPPED} {one.where}", 0) in places:
            states[places[f"{DROPPED} {one.where}", 0]] += 1.0
        elif one.kind == "step":
            unit = np.eye(plant.set_points)[int(one.where)]
            moved = np.linalg.pinv(plant.C[plant.sensed :]) @ unit * one.size
            for i, change in enumerate(moved.tolist()):
                if ("x", i) in places:
                    states[places["x", i]] += change
    return states


def _path(loop: Loop, records: Mapping[Name, Array], steps: int, loads: Sequence[Event]) -> Path:
    def stacked(name: str) -> Array:
        rows = [values for key, values in records.items() if is_entry(key, name)]
        return np.array(rows).T if rows else np.empty((steps, 0))

    plant, states, applied = loop.problem.plant, stacked("x"), stacked("applied")
    if not np.isfinite(states).all() or np.abs(states).max(initial=0.0) > HIGHEST:
        raise UnstableError(
            f"the simulated path of the policy {loop.policy.kind} leaves the range of double precision within {steps} "
            "steps; expected a stable loop: send more often"
        )
    seen = states @ plant.C.T
    model = loop.policy.prediction
    if model is not None:  # the sampled plant takes the state of the actuator's model as its input
        point = plant.operating_point
        own = None if loop.problem.source is None else loop.problem.source.operating_point
        applied = (applied if point is None else applied - point.x) @ model.L.T + (0.0 if own is None else own.u)
    for one in loads:
        applied[one.step :, int(one.where)] -= one.size
    links = loop.policy.scheduled
    sent = {link: records[Sent(link)] > 0 for link in links}
    arrived = {link: records[Received(link)] > 0 if Received(link) in records else sent[link] for link in links}
    ratios = {link: one.ratio for link, one in weigh_options(loop.policy, records).items()}
    dt = plant.dt
    return Path(
        np.arange(steps, dtype=np.float64) * (dt or 1.0),
        "steps" if dt is None else "s",
        seen[:, : plant.sensed],
        seen[:, plant.sensed :],
        applied,
        sent,
        arrived,
        {link: one for link, one in ratios.items() if one is not None and np.isfinite(one).all()},
    )
