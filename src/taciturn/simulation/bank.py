"""Simulation of many loops in parallel, with one path each: to vary a parameter, or to study a network.

Loops whose programs differ only in their constants share machine code, in which each lane has constants of its own. So
a parameter of a policy is varied without compiling again: 1000 thresholds are 1000 paths of one program. Loops of
another structure, such as one with another number of states, form a group of their own.

Path i has the draws of path i of the seed in any bank, so the result of a loop does not depend on the other loops. The
cost is the mean stage cost per unit of time, to which the cost of the noise between samples is added, which no control
changes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from taciturn._arrays import Array, count, instance, quoted
from taciturn._display import Displayed
from taciturn.errors import ProblemError, UnstableError
from taciturn.loop import COST, Loop
from taciturn.program.engine import Stepper, prepare
from taciturn.program.ir import Program
from taciturn.program.ops import Sent
from taciturn.simulation.sampling import find_loss, sends


@dataclass(frozen=True, eq=False, repr=False)
class Tally(Displayed):
    """Cost and send rates of each loop in a bank of loops that were simulated in parallel."""

    cost: Array  # mean stage cost of each loop per unit of time, as for an average cost, (loops,)
    sends: Mapping[str, Array]  # mean sends per step of each loop, by link, (loops,)


class Bank:
    """A bank of loops, simulated in parallel with one path each. Loops that differ in constants only share machine
    code.

    Loop i has the draws of path i of the seed. A bank may contain a loop several times, to average over paths.

    Args:
        loops: closed loops with any policies.
        seed: seed of the random draws.

    Raises:
        ProblemError: there are no loops, or the cost of a loop has a horizon or a discount.

    Example:
        >>> from taciturn import Cost, Plant, close, design
        >>> from taciturn.simulation.bank import Bank
        >>> plant, cost = Plant([[1.2]], [[1.0]], [[0.01]]), Cost([[1.0]], [[1.0]])
        >>> bank = Bank([close(plant, design.lqg(plant, cost, theta=theta)) for theta in (0.1, 0.2, 0.4)])
        >>> bank.structures, bank.run(1).cost.shape
        (1, (3,))
    """

    def __init__(self, loops: Iterable[Loop], seed: int = 0) -> None:
        """Group the loops by structure, and compile each structure once."""
        try:
            self.loops = tuple(loops)
        except TypeError:
            raise ProblemError(f"loops is {quoted(loops)}; expected a sequence of closed loops") from None
        seed = count("seed", seed, 0)
        if not self.loops:
            raise ProblemError("loops is empty; expected at least one closed loop")
        for loop in self.loops:
            instance("loops", loop, Loop)
            if loop.horizon is not None:
                cost = loop.problem.cost
                mission = f"discount {cost.discount:g}" if cost.discount < 1 else f"horizon {cost.horizon}"
                raise ProblemError(
                    f"a loop of the policy {loop.policy.kind} has a cost with {mission}; expected an average cost"
                )
        loops = self.loops
        self._ticks = np.array([loop.problem.tick for loop in loops])
        self._noise = np.array([loop.problem.noise_cost for loop in loops]) / self._ticks
        self._links = list(dict.fromkeys(link for loop in loops for link in loop.policy.scheduled))
        groups: dict[object, list[tuple[int, Program]]] = {}
        for index, loop in enumerate(loops):
            program = _lean(loop)
            groups.setdefault(program.structure, []).append((index, program))
        self._steppers: list[tuple[npt.NDArray[np.int64], Stepper]] = []
        self._states: list[Array] = []
        for members in groups.values():
            indices = np.array([index for index, _ in members])
            starts = [self.loops[index].start(program, 1, seed, index, stationary=True) for index, program in members]
            self._steppers.append((indices, Stepper([program for _, program in members])))
            self._states.append(np.concatenate(starts, axis=1))

    @property
    def structures(self) -> int:
        """Number of different programs that must be compiled for the loops of this bank."""
        return len(self._steppers)

    def run(self, steps: int = 1, threads: int | None = None) -> Tally:
        """Continue the simulation of all loops for a number of steps. Return their costs and their numbers of sends.

        Args:
            steps: number of steps, at least 1.
            threads: number of threads; default: all processors; the result does not depend on it.

        Returns:
            Cost and sends of each loop in these steps.

        Raises:
            UnstableError: a loop diverges, or the function of a nonlinear plant gives a non-finite number.
        """
        steps, many = count("steps", steps), len(self.loops)
        threads = None if threads is None else count("threads", threads)
        cost, sent = self._noise.copy(), {link: np.zeros(many) for link in self._links}
        for k, (indices, stepper) in enumerate(self._steppers):
            before = self._states[k]
            self._states[k], sums = stepper.run(before, steps, threads)
            for name, total in sums.items():
                if not np.isfinite(total).all():
                    place = int(np.flatnonzero(~np.isfinite(total))[0])
                    lost = int(indices[place])
                    program = _lean(self.loops[lost])
                    find_loss(self.loops[lost], program, prepare(program), before[:, [place]], steps)
                    raise UnstableError(
                        f"loop {lost} of the bank ({self.loops[lost].policy.kind}) diverges; expected stable loops"
                    )
                if name == COST:
                    cost[indices] += total / steps / self._ticks[indices]
                elif isinstance(name, Sent):
                    sent[name.link][indices] = total / steps
        return Tally(cost, sent)


def _lean(loop: Loop) -> Program:
    """Return the program of a loop that computes only cost and sends."""
    return loop.program().keep({COST, *sends(loop)})
