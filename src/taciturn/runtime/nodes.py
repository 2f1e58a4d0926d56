"""All nodes of a policy together, one sample at a time: measurement in, input out.

``taciturn.runtime.node`` is one place, which packets reach as they may. Here all places and the links between them are
one program of a tick. Its draws are made of seed and number of the tick alone, so that a tick is a pure function: gone
through again, or in another order, it gives the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, count, instance
from taciturn.model.information import check_network
from taciturn.model.network import Network
from taciturn.model.policy import ENDS, Policy
from taciturn.program.controller import is_bad, lower_policy
from taciturn.program.draws import UNIFORM, draw_uniforms, seed_generators
from taciturn.program.ir import Program
from taciturn.program.python import compile_python

BLOCK = 256  # ticks whose generators are seeded at once, which takes hardly longer than one
Values: TypeAlias = tuple[float, ...]


class Turns:
    """The ticks of a program as a pure function of (number of the tick, memory, inputs).

    Args:
        program: of one tick, whose uniform numbers are inputs.
        network: that says how often a link is bad when it starts.
        seed: of the draws.
    """

    def __init__(self, program: Program, network: Network, seed: int) -> None:
        """Compile it, and draw how it starts."""
        self._seed = count("seed", seed, 0)
        self._turn = compile_python(program)
        draws = np.random.default_rng(seed)
        drawn: dict[str, float] = {}
        for link in ENDS:
            burst, chance = network.burst(link), draws.random()
            drawn[is_bad(link)] = float(burst is not None and chance < burst.share_bad)
        self.states = tuple(f"{state.name}[{state.index}]" for state in program.states)
        self.start: Values = tuple(  # a number, or the name of what is drawn; the state of a plant is given
            drawn.get(state.start[0], 0.0) if isinstance(state.start, tuple) else state.start
            for state in program.states
        )
        self.outputs = {name: i for i, name in enumerate(program.outputs)}
        self._inputs = program.inputs
        numbers = [int(name.split()[1]) for name in program.inputs if name.startswith(f"{UNIFORM} ")]
        number = max(numbers, default=-1) + 1  # also of those that nothing reads: a draw does not depend on that
        self._draw = compile_python(draw_uniforms(number)) if number else None
        self._block: tuple[int, list[list[int]]] = -1, []

    def drawn(self, tick: int) -> Values:
        """Return the uniform numbers of a tick, in (0, 1)."""
        if self._draw is None:
            return ()
        block, place = divmod(tick, BLOCK)
        known, words = self._block
        if known != block:
            words = seed_generators(self._seed, BLOCK, block * BLOCK).view(np.uint64).T.tolist()
            self._block = block, words
        return self._draw(words[place], ())[1]

    def turn(self, tick: int, memory: Sequence[float], inputs: Mapping[str, float]) -> tuple[Values, Values]:
        """Return the memory after a tick, and what the tick puts out."""
        supplied = {**inputs, **{f"{UNIFORM} {i}": value for i, value in enumerate(self.drawn(tick))}}
        return self._turn(memory, [supplied[name] for name in self._inputs])


class Nodes:
    """All nodes of a policy with the links between them, in memory: y in, u out, one sample at a time.

    They decide as nodes that run apart do, and as the closed loop does, bit for bit.

    Args:
        policy: whose nodes these are.
        network: between them; omitted: that of the design.
        seed: of what is lost and of the policy's draws: those of a tick depend on it and the tick alone.

    Raises:
        InformationError: a node uses what it cannot know.
        ProblemError: no policy, or a network with another delay.

    Example:
        >>> from taciturn import load
        >>> nodes = Nodes(load("two-mass").design())
        >>> u = nodes.step([0.5, 0.4])
        >>> u.shape, nodes.sent, nodes.tick
        ((1,), {'actuator': True}, 1)
    """

    def __init__(self, policy: Policy, network: Network | None = None, seed: int = 0) -> None:
        """Start before the first tick."""
        instance("policy", policy, Policy)
        self.policy, self.network = policy, policy.network if network is None else network
        check_network(policy, self.network)
        self.turns = Turns(lower_policy(policy, self.network), self.network, seed)
        self.tick = 0
        self.sent: dict[str, bool] = {}
        self.arrived: dict[str, bool] = {}
        self._memory = self.turns.start

    def step(self, measurement: ArrayLike) -> Array:
        """Go through one tick.

        Args:
            measurement: y, (p,).

        Returns:
            u, (m,); ``sent`` and ``arrived`` then tell of each link what happened on it.

        Raises:
            ProblemError: the measurement has another size, or is not finite.
        """
        y = array("measurement", measurement, (self.policy.model.outputs,), "(outputs,)")
        supplied = {f"y {i}": value for i, value in enumerate(y.tolist())}
        self._memory, values = self.turns.turn(self.tick, self._memory, supplied)
        self.tick += 1
        found = {name: values[i] for name, i in self.turns.outputs.items()}
        self.sent, self.arrived = (
            {link: found[f"{what} {link}"] > 0 for link in ENDS if f"{what} {link}" in found}
            for what in ("sent", "arrived")
        )
        return np.array([found[f"applied {i}"] for i in range(self.policy.model.inputs)])
