"""All nodes of a policy in one process: each step takes a measurement and returns the plant input.

In ``taciturn.runtime.node``, each node is separate and packets arrive at arbitrary times. In this module, one program
computes a step of all nodes and links. Its random draws depend only on the seed and the number of the step. A step is
therefore a pure function: its result is the same if the step is repeated or executed in another order.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, count, instance
from taciturn.errors import ProblemError
from taciturn.model.information import check_network
from taciturn.model.network import Network
from taciturn.model.policy import Policy, Received
from taciturn.program.controller import copies_of_inputs, lower_policy
from taciturn.program.draws import UNIFORM, draw_uniforms, seed_generators
from taciturn.program.ir import Program
from taciturn.program.lower import APPLIED, link_state
from taciturn.program.names import Entry, Name, Sent, is_entry
from taciturn.program.python import compile_python
from taciturn.runtime.node import Values

BLOCK = 256  # steps whose generators are seeded together, which takes little longer than seeding one


class StepFunction:
    """The step of a program as a pure function of the step number, the memory and the inputs.

    Args:
        program: program of one step, with uniform random numbers among its inputs.
        taken: number of entries of each other signal among its inputs.
        network: network, which defines the distribution of the first state of each link.
        seed: seed of the random draws.
    """

    def __init__(self, program: Program, taken: Mapping[str, int], network: Network, seed: int) -> None:
        """Compile the program, and draw its initial memory."""
        self._seed = count("seed", seed, 0)
        self._turn = compile_python(program)
        draws = np.random.default_rng(seed)
        drawn: dict[str, float] = {}
        for link in network.links:
            burst, chance = network.burst(link), draws.random(1)
            drawn[link_state(link)] = 0.0 if burst is None else float(burst.pick(chance)[0])
        self.states = tuple(f"{state.name}[{state.index}]" for state in program.states)
        # a start value is a number, or the name of a link state drawn above; the caller sets the state of a plant
        self.start: Values = tuple(
            drawn.get(state.start[0], 0.0) if isinstance(state.start, tuple) else state.start
            for state in program.states
        )
        self.outputs = {name: i for i, name in enumerate(program.outputs)}
        numbers = [name.index for name in program.inputs if is_entry(name, UNIFORM)]
        number = max(numbers, default=-1) + 1  # count unread numbers too, so that draws do not depend on them
        supplied = [Entry(signal, i) for signal, size in {**taken, UNIFORM: number}.items() for i in range(size)]
        places: dict[Name, int] = {name: i for i, name in enumerate(supplied)}
        self._read = [places[name] for name in program.inputs]
        self._draw = compile_python(draw_uniforms(number)) if number else None
        self._block: tuple[int, list[list[int]]] = -1, []

    def drawn(self, tick: int) -> Values:
        """Return the uniform random numbers of a step, in (0, 1)."""
        if self._draw is None:
            return ()
        block, place = divmod(tick, BLOCK)
        known, words = self._block
        if known != block:
            words = seed_generators(self._seed, BLOCK, block * BLOCK).view(np.uint64).T.tolist()
            self._block = block, words
        return self._draw(words[place], ())[1]

    def turn(self, tick: int, memory: Sequence[float], inputs: Sequence[float]) -> tuple[Values, Values]:
        """Return the memory after a step, and the outputs of the step, given the entries of the signals ``taken``."""
        supplied = [*inputs, *self.drawn(tick)]
        return self._turn(memory, [supplied[place] for place in self._read])


class Nodes:
    """All nodes of a policy and their links, in memory: each step takes the measurement y and returns the input u.

    The results are bit-identical to those of separate nodes and of the closed loop.

    Args:
        policy: policy of the nodes.
        network: network between the nodes; default: the network of the design.
        seed: seed of packet drops and of the policy's random draws; the draws of a step depend only on seed and step.

    Raises:
        InformationError: a node uses a value that is not available to it over the network.
        ProblemError: ``policy`` is not a policy, or the network has another delay than the design.

    Example:
        >>> from taciturn import load
        >>> nodes = Nodes(load("two-mass").design())
        >>> u = nodes.step([0.5, 0.4])
        >>> u.shape, nodes.sent, nodes.tick
        ((1,), {'actuator': True}, 1)
    """

    def __init__(self, policy: Policy, network: Network | None = None, seed: int = 0) -> None:
        """Set the state before the first step."""
        instance("policy", policy, Policy)
        self.policy, self.network = policy, policy.network if network is None else network
        check_network(policy, self.network)
        self.turns = StepFunction(lower_policy(policy, self.network), {"y": policy.model.outputs}, self.network, seed)
        self.tick = 0
        self.sent: dict[str, bool] = {}
        self.arrived: dict[str, bool] = {}
        self._memory = self.turns.start
        self._copies = copies_of_inputs(policy)
        self._held: dict[str, Array] = {}

    def step(self, measurement: ArrayLike, applied: ArrayLike | None = None) -> Array:
        """Execute one step, and set ``sent`` and ``arrived``, which state for each link whether a packet was sent and
        arrived.

        Args:
            measurement: measurement y, (p,).
            applied: input that the actuators really applied in the step before, (m,), if limits that the plant does not
                state changed it. The filter, and a given controller that uses its input, take it in place of their
                copy; default: the input that was returned.

        Returns:
            Plant input u, (m,). If the actuator predicts, the predicted state x̂, (n,), from which the actuator
            integrates its model until the next step, and applies u = L x̂ (``policy.prediction``).

        Raises:
            ProblemError: the measurement or the applied input has the wrong size, or is not finite; or an applied input
                is given in the first step, or for a policy whose nodes do not use it.
        """
        y = array("measurement", measurement, (self.policy.model.outputs,), "(outputs,)")
        if applied is not None:
            self._tell(array("applied", applied, (self.policy.model.inputs,), "(inputs,)"))
        self._memory, values = self.turns.turn(self.tick, self._memory, y.tolist())
        self.tick += 1
        places = self.turns.outputs.items()
        self.sent = {name.link: values[i] > 0 for name, i in places if isinstance(name, Sent)}
        self.arrived = {name.link: values[i] > 0 for name, i in places if isinstance(name, Received)}
        self._held = {copy.held: _values(values, places, copy.held) for copy in self._copies}
        return _values(values, places, APPLIED)

    def _tell(self, applied: Array) -> None:
        """Replace the controller's copy of the last input by the input that was applied."""
        if not self._copies or not self.tick:
            got = f"and no filter of {self.policy.kind} has a copy of the input"
            raise ProblemError(f"applied is given, {'in the first step' if self._copies else got}; expected no applied")
        memory = dict(zip(self.turns.states, self._memory, strict=True))
        for copy in self._copies:
            change = copy.effect @ (applied[list(copy.inputs)] - self._held[copy.held])
            memory |= {f"{copy.signal}[{i}]": memory[f"{copy.signal}[{i}]"] + d for i, d in enumerate(change.tolist())}
        self._memory = tuple(memory.values())


def _values(values: Values, places: Iterable[tuple[Name, int]], signal: str) -> Array:
    return np.array([values[i] for name, i in places if is_entry(name, signal)])
