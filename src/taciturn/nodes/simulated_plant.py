"""A simulated plant for tests of nodes, which advances by one step at a time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import isfinite
from typing import Any

import numpy as np

from taciturn._arrays import Array, count, instance
from taciturn._modes import factor
from taciturn._text import number_of
from taciturn.errors import ProblemError, UnstableError
from taciturn.loop import COST, Loop
from taciturn.model.coverage import LATE, LOOPS, Coverage
from taciturn.model.expected import sensed_by
from taciturn.model.losses import LossLaw
from taciturn.model.network import REFERENCE
from taciturn.model.wire import fits
from taciturn.nodes.node import Measurement
from taciturn.program.ir import Program
from taciturn.program.missing import SAMPLED
from taciturn.program.ops import is_entry
from taciturn.program.python import CompiledStep, compile_python
from taciturn.program.translation import sample_state

PLANT_SERVER = Coverage(LOOPS | LATE, "the simulated plant of a running loop does not model")


class SimulatedPlant:
    """Simulation of the plant of a loop, with its noise and its cost.

    Args:
        loop: loop that contains the plant; its input limits and references apply.
        seed: seed of the initial state and the noise.

    Attributes:
        state: state of the plant, (n,).
        measurement: measurement of the present step; None in place of an output whose sample is missing.

    Example:
        >>> import taciturn
        >>> problem = taciturn.load("two-mass")
        >>> plant = SimulatedPlant(problem.close(problem.design()), seed=1)
        >>> cost = plant.move([0.0])
        >>> plant.tick, cost >= 0.0
        (1, True)
    """

    def __init__(self, loop: Loop, seed: int = 0) -> None:
        """Draw the initial state from its distribution."""
        instance("loop", loop, Loop)
        PLANT_SERVER.check(loop.parts)
        loop = loop.in_units
        self.loop, self.tick = loop, 0
        count("seed", seed, 0)
        program, self._turn = _compile(loop)
        start = loop.start(program, 1, seed)[:, 0]
        states: list[Any] = [
            int(value.view(np.uint64)) if state.word else float(value)
            for value, state in zip(start, program.states, strict=True)
        ]
        self._states: Sequence[Any] = states
        self._start = {i: self._states[i] for i, state in enumerate(program.states) if state.name == "x"}
        outputs = list(program.outputs)
        self._cost = outputs.index(COST)
        self._y = [i for i, name in enumerate(outputs) if is_entry(name, "y", REFERENCE)]
        self._known = {self._y[name.index]: i for i, name in enumerate(outputs) if is_entry(name, SAMPLED)}
        self._x = [i for i, name in enumerate(outputs) if is_entry(name, "x")]
        self.state: Array = loop.start_of_plant(1, seed)[0][:, 0]
        plant = loop.problem.plant
        self._nonlinear = plant.function is not None
        spread: Array = factor(plant.V)
        draws = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
        noise: Array = spread @ draws.standard_normal((spread.shape[1],))
        loads = loop.problem.loads
        shown = 0.0 if loads is None else loads.shown @ loads.table[0]
        y: list[float] = (plant.C @ self.state + shown + noise).tolist()
        known = self._first_samples(program, states, draws)
        self.measurement: Measurement = tuple(y[i] if i not in known or known[i] else None for i in range(len(y)))
        self._began = self.state, self.measurement

    @property
    def inputs(self) -> int:
        """Number of inputs of the plant."""
        return self.loop.problem.plant.inputs

    @property
    def pieces(self) -> int:
        """Number of inputs that act one after the other in a step, if packets arrive within periods; usually one."""
        return max(1, len(self.loop.network.cuts(self.loop.policy.tick)))

    @property
    def tick_length(self) -> float:
        """Seconds per step; 1 if the problem states no sampling period."""
        return self.loop.problem.plant.dt or 1.0

    def move(self, inputs: Sequence[float]) -> float:
        """Advance the plant by one step with the given input, update ``measurement``, and return the cost of the step.

        Args:
            inputs: input u, (m,); if packets arrive within periods, that of each piece of the period, one after the
                other.

        Raises:
            ProblemError: the number of inputs is wrong.
            UnstableError: the state exceeds the range of floating-point numbers, or that of the plant's function.
        """
        if len(inputs) != self.inputs * self.pieces:
            each = "" if self.pieces == 1 else f" in each of {self.pieces} pieces of a period"
            raise ProblemError(
                f"the input has {number_of(len(inputs), 'entry')}; expected "
                f"{number_of(self.inputs * self.pieces, 'entry')}, one for each input of the plant{each}"
            )
        before, u = self.state.tolist(), [float(value) for value in inputs]
        self._states, outputs = self._turn(self._states, u)
        self.state = np.array([outputs[i] for i in self._x])
        y = tuple(outputs[i] for i in self._y)
        known = self._known
        self.measurement = tuple(outputs[i] if i not in known or outputs[known[i]] else None for i in self._y)
        self.tick += 1
        lost = [i for i, number in enumerate(self.state) if not isfinite(number)] if self._nonlinear else []
        if lost and all(map(isfinite, u)):
            raise UnstableError(
                "the loop drives the plant to a point where the plant's function returns no finite number as state "
                f"{lost[0] + 1} at step {self.tick}, from x = {[round(value, 6) for value in before]}, u = {u}; "
                "expected finite numbers: send more often, limit the inputs (input_limit), or correct the function"
            )
        if not (isfinite(outputs[self._cost]) and fits(y)):
            raise UnstableError(
                f"the state of the plant exceeds the range of double precision at step {self.tick}: the loop is "
                "unstable; expected a policy that stabilises the plant over this network"
            )
        return outputs[self._cost]

    def _first_samples(self, program: Program, states: list[Any], draws: np.random.Generator) -> dict[int, bool]:
        """Draw which outputs are measured in the first step, by output, for nodes whose samples may be missing."""
        network, known = self.loop.network, dict[int, bool]()
        places = {state.name: i for i, state in enumerate(program.states)}
        for node, rows in sensed_by(self.loop.policy).values():
            law = network.missing.get(node)
            if law is None:
                continue
            chance, turn = draws.random(2)
            loss, place = law.loss if isinstance(law, LossLaw) else law, places.get(sample_state(node))
            if isinstance(law, LossLaw) and place is not None:
                state = int(states[place])
                loss, states[place] = float(law.losses[state]), float(law.move(turn)[state])
            known |= dict.fromkeys(rows, bool(chance > loss))
        return known

    def restart(self) -> None:
        """Set the plant to its initial state, as after an emergency stop. The step number and the noise continue."""
        self._states = [self._start.get(i, value) for i, value in enumerate(self._states)]
        self.state, self.measurement = self._began

    def final_cost(self) -> float:
        """Compute the cost of the final state; it is 0 if the cost does not weight this state."""
        terminal = self.loop.problem.terminal
        if terminal is None:
            return 0.0
        off = self.loop.from_final_target(self.state)
        return float(off @ terminal @ off)


@lru_cache(maxsize=4)
def _compile(loop: Loop) -> tuple[Program, CompiledStep]:
    program = loop.plant_program()
    return program, compile_python(program)
