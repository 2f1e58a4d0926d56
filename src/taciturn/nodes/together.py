"""All nodes of a policy and their links as one pure function, for a plant simulated or measured elsewhere.

The program of all nodes (``program.all_nodes``) is compiled to a Python function of the memory and the inputs: the
measurement, set-points, and what becomes of each packet. The random draws of a step depend only on the seed and the
number of the step, so that any step can be repeated. The results are those of separate nodes, bit for bit.

A loop may take over without a jump: from a given input before the first step, inputs that are held start with it, and
the estimates of constant disturbances are those for which the first command is this input. The command depends on them
linearly but for the packets of sensors, so a linear equation, solved a few times, gives them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Protocol, cast, runtime_checkable

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, count, flag, instance, quoted
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.delay import WHOLE
from taciturn.model.expected import predicted_outputs, sensed_by
from taciturn.model.information import check_network
from taciturn.model.network import REFERENCE, Network
from taciturn.model.policy import Policy, with_intervals
from taciturn.model.set_points import IN_EFFECT
from taciturn.model.silence import Life, lives_of
from taciturn.model.steps import ONE, Received, Send
from taciturn.model.wire import LARGEST, fits
from taciturn.nodes.node import Values, by_hand
from taciturn.program.all_nodes import (
    ACTING,
    HELD,
    TOLD,
    Informed,
    change_of,
    copies_of_inputs,
    fate_of,
    translate_command,
    translate_policy,
)
from taciturn.program.draws import UNIFORM, draw_uniforms, seed_generators
from taciturn.program.ir import Program
from taciturn.program.late import NEVER, codes_of, is_clocked, place_of
from taciturn.program.manual import BY_HAND, MANUAL, not_operable, operation_of
from taciturn.program.missing import known_of
from taciturn.program.ops import Arrived, Entry, Name, Sent, is_entry
from taciturn.program.python import compile_python
from taciturn.program.translation import APPLIED, link_state

_NEAR = 1e-9  # relative difference of two inputs
_TRIES = 4
_BLOCK = 256  # steps whose generators are seeded together, which takes little longer than seeding one


@runtime_checkable
class Closable(Protocol):
    """A problem that can design a policy, and close the loop of this policy with its plant, network and cost."""

    def design(self) -> Policy:
        """Design the policy of the problem, and return it."""
        ...

    def close(self, policy: Policy) -> Loop:
        """Close the loop of a policy with the plant, the network and the cost of the problem."""
        ...


class Nodes:
    """All nodes of a policy and their links in one object. Each step takes the measurement y and returns the input u.

    The results are bit-identical to those of separate nodes, and to the paths that ``simulate`` records.

    Args:
        policy: policy of the nodes, or its loop or problem. A policy has the network of its design, which for many
            kinds is ideal; a loop and a problem have their own, with its losses and its rounded payloads.
        network: network between the nodes, only with a policy; default: the network of the design.
        seed: seed of packet drops and of the policy's random draws; the draws of a step depend only on seed and step.
        estimate: estimate of the state before the first measurement, with disturbances and set-points, (n,); default:
            the mean of the problem, at which predictions of other nodes start in any case.
        start_input: input before the first step, (m,), from which the loop takes over without a jump: inputs that are
            held start with it, and if the model has constant disturbances, their estimate is that for which the first
            command is this input, if the first measurement is as predicted. If not, ``notes`` states this.

    Attributes:
        cuts: parts of a period at which packets may arrive and change the input; (0.0,) if it changes at steps alone.
        delays: after the last step, by link with random delays, the delay in steps of the packet of this step, or None
            if none was sent or it never arrives.
        set_points: set-points in effect in the last step, (z,), within their range and ramp.
        silence: what the silence of each node that decides has cost since the start (``Life``), if the policy has a
            bound on every path. It contains neither the effect of applied inputs that differ from the commands, nor
            that of manual inputs and of outputs that were not measured.

    Raises:
        InformationError: a node uses a value that is not available to it over the network.
        ProblemError: ``policy`` is not a policy, or the network has another delay than the design, or the policy has no
            estimate that could start at the given one.

    Example:
        >>> from taciturn import load
        >>> nodes = Nodes(load("two-mass"))
        >>> u = nodes.step([0.5, 0.4])
        >>> u.shape, nodes.sent, nodes.tick
        ((1,), {'actuator': True}, 1)
    """

    def __init__(
        self,
        policy: Policy | Loop | Closable,
        network: Network | None = None,
        seed: int = 0,
        *,
        estimate: ArrayLike | None = None,
        start_input: ArrayLike | None = None,
    ) -> None:
        """Set the state before the first step."""
        if not isinstance(policy, Policy) and isinstance(policy, Closable):
            policy = policy.close(policy.design())
        if isinstance(policy, Loop):
            if network is not None:
                raise ProblemError(
                    "the argument 'network' is given with a problem or a loop, which has its own network; expected "
                    "this argument only with a policy"
                )
            policy, network = policy.policy, policy.network
        instance("policy", policy, Policy)
        self.network = policy.network if network is None else network
        instance("network", self.network, Network)
        self.policy = with_intervals(policy, self.network).in_units
        check_network(self.policy, self.network)
        begun, self.notes = _started(self.policy, self.network, estimate, start_input)
        self.links = tuple(step.link for step in policy.steps if isinstance(step, Send))
        model, sensed = self.policy.model, sensed_by(self.policy)
        self.cuts = self.network.cuts(self.policy.tick) or (0.0,)
        laws = {link: self.network.random_delay(link, self.policy.tick) for link in self.links}
        self._codes = {
            link: tuple(zip(codes_of(law, self.cuts, is_clocked(self.network, link)), law.waits, strict=True))
            for link, law in laws.items() if law is not None
        }  # fmt: skip
        self._waits = {link: dict(codes) for link, codes in self._codes.items()}
        self._order = [index for _, outputs in sensed.values() for index in outputs]  # of the flags of the outputs
        self._copies = copies_of_inputs(self.policy)
        taken = {"y": model.sensed, REFERENCE: model.set_points, **dict.fromkeys(map(fate_of, self.links), 1)}
        taken |= {known_of(signal): len(outputs) for signal, (_, outputs) in sensed.items()}
        self._changed = {copy.signal: len(copy.effect) for copy in self._copies}
        told = {TOLD: 1} if self._changed else {}
        taken |= told | {change_of(signal): size for signal, size in self._changed.items()}
        self._operable = operation_of(self.policy) is not None
        taken |= {MANUAL: 1, BY_HAND: model.inputs} if self._operable else {}
        self.turns = StepFunction(translate_policy(begun, self.network, Informed), taken, self.network, seed)
        self.reset()

    def reset(self) -> None:
        """Return to the state before the first step. The random numbers are then the same as before."""
        self.tick = 0
        self.sent: dict[str, bool] = {}
        self.arrived: dict[str, bool] = {}
        self.delays: dict[str, float | None] = {}
        self.reference: list[float] = self.policy.model.given.tolist()
        self.set_points: list[float] = self.reference
        self._memory = self.turns.start
        self._held: dict[str, Array] = {}
        self.silence: tuple[Life, ...] = lives_of(self.policy.theory.silence, {})

    def step(
        self,
        measurement: ArrayLike | Sequence[float | None] | None,
        *,
        reference: ArrayLike | None = None,
        applied: ArrayLike | None = None,
        fates: Mapping[str, bool | float] | None = None,
        manual: ArrayLike | None = None,
    ) -> Array:
        """Execute one step. The dictionaries ``sent`` and ``arrived`` then show which links sent and which packets
        arrived.

        Args:
            measurement: measurement y, (p,). None in place of an output, or of all, states that it is missing: a filter
                at its node then uses its prediction, and another node its last measurement.
            reference: set-points from this step on, (z,), if they may change (``[reference] steps`` or ``file``);
                default: those of the step before.
            applied: input that the actuators really applied in the step before, (m,), if limits that the model of the
                plant does not contain changed it. The filter, and a given controller that uses its input, take it in
                place of their copy; default: the input that was returned.
            fates: whether the packet of this step arrives, by link, if one is sent; packets of other links are dropped
                at random, as the network states. On a link with random delays, False or the delay of the packet of
                this step in steps, one of those of the link.
            manual: input that the controller commands in this step in place of its own, (m,), in the units of the
                plant and within its limits; None: automatic. A packet is sent if the actuator holds another input. The
                filter follows the input, and so do the integrals of a given controller: for an unchanged error, its
                next command is this input.

        Returns:
            Plant input u, (m,); if packets to actuators arrive within a period, the inputs from each of its parts
            ``cuts`` on, (parts, m). If the actuator predicts, the predicted state x̂, (n,), from which the actuator
            integrates its model until the next step, and applies u = L x̂ (``policy.prediction``).

        Raises:
            ProblemError: an argument has the wrong size, or is not finite or beyond 3.4e38; or the results of the step
                are, and the nodes are then as before the step; set-points are given to a policy for constant ones; an
                applied input is given in the first step, or for a policy whose nodes do not use it; or a fate is that
                of another link.
        """
        y, known = self._completed(measurement)
        points = self.reference if reference is None else self._followed(reference)
        changes = self._changes(None if applied is None else _checked("applied", applied, self.policy.model.inputs))
        inputs = [*y, *points, *self._told(fates or {}), *(known[index] for index in self._order), *changes]
        inputs += self._by_hand(manual)
        memory, values = self.turns.turn(self.tick, self._memory, inputs)
        if not (np.isfinite(memory).all() and fits(_values(values, self.turns.outputs.items(), APPLIED))):
            raise ProblemError(
                f"in step {self.tick}, the measurement {y} leads to numbers that are not finite or exceed "
                f"{LARGEST:.2g}; expected measurements in the range for which the policy was designed. The nodes are "
                "in the same state as before the step: hold the last input, or reset the nodes"
            )
        self._memory, self.reference = memory, points
        self.tick += 1
        places = self.turns.outputs.items()
        self.sent = {name.link: values[i] > 0 for name, i in places if isinstance(name, Sent)}
        self.arrived = {name.link: values[i] > 0 for name, i in places if isinstance(name, Received)}
        self._held = {copy.held: _values(values, places, copy.held) for copy in self._copies}
        limited = _values(values, places, IN_EFFECT).tolist()
        self.set_points = limited or points
        silence = self.policy.theory.silence
        kept = {name for one in silence.values() for name in (one.total, one.lasted)}
        self.silence = lives_of(silence, {name: _values(values, places, name).tolist() for name in kept})
        self.delays = {
            name.link: None if values[i] >= NEVER else self._waits[name.link][values[i]]
            for name, i in places if isinstance(name, Arrived)
        }  # fmt: skip
        acting = _values(values, places, ACTING)
        return acting.reshape(len(self.cuts), -1) if len(acting) else _values(values, places, APPLIED)

    def _changes(self, applied: Array | None) -> list[float]:
        """Return the change of the controller's copies of the last input to the applied input, if it is given.

        That is 1, and the changes of all signals into which copies have entered; or 0 and no changes.
        """
        changes = {signal: np.zeros(size) for signal, size in self._changed.items()}
        if applied is not None and not (changes and self.tick):
            got = f"and no filter of {self.policy.kind} has a copy of the input"
            raise ProblemError(
                f"the argument 'applied' is given, {'in the first step' if changes else got}; expected no such argument"
            )
        if applied is not None:
            for copy in self._copies:
                changes[copy.signal] += copy.effect @ (applied[list(copy.inputs)] - self._held[copy.held])
        told = [] if not changes else [float(applied is not None)]
        return told + [one for change in changes.values() for one in change.tolist()]

    def _by_hand(self, manual: ArrayLike | None) -> list[float]:
        """Return 1 and the manual input, or zeros if the step is automatic."""
        if manual is None:
            return [0.0] * (1 + self.policy.model.inputs) if self._operable else []
        if not self._operable:
            raise not_operable(self.policy)
        return [1.0, *by_hand(self.policy, manual)]

    def _completed(self, measurement: object) -> tuple[list[float], list[float]]:
        """Return the outputs, with 0 in place of those that are not measured, and 1 for each that is measured, or 0."""
        p = self.policy.model.sensed
        listed = [None] * p if measurement is None else measurement
        entries = list[object](cast("Sequence[object]", listed)) if isinstance(listed, list | tuple) else []
        missing = [value is None for value in entries] or [False] * p
        given: object = [0.0 if value is None else value for value in entries] or measurement
        y = _checked("measurement", cast("ArrayLike", given), p)
        return y.tolist(), [float(not absent) for absent in missing]

    def _told(self, fates: Mapping[str, bool | float]) -> list[float]:
        """Return for each link −1 if its packet is dropped, 0 if its fate is drawn, and else 1 plus its delay."""
        instance("fates", fates, Mapping)
        for link in (link for link in fates if link not in self.links):
            raise ProblemError(
                f"the argument 'fates' names the link {quoted(link)}; expected links on which this {self.policy.kind} "
                f"policy sends: {', '.join(self.links)}"
            )
        arrives = {link: self._fate(link, fate) for link, fate in fates.items()}
        return [arrives.get(link, 0.0) for link in self.links]

    def _fate(self, link: str, fate: bool | float) -> float:
        """Return the input of the program for the fate of a packet: −1, or 1 plus its delay in pieces of a period."""
        name, waits = f"fates[{link!r}]", self._waits.get(link)
        if waits is None:
            return 1.0 if flag(name, fate) else -1.0
        if fate is False:
            return -1.0
        near = [code for code, wait in self._codes[link] if abs(wait - float(fate)) <= WHOLE]
        if fate is True or not near:
            raise ProblemError(
                f"{name} is {fate}, and the {link} link delays packets at random; expected False, or the delay in "
                f"steps: {', '.join(f'{wait:g}' for _, wait in self._codes[link])}"
            )
        return 1.0 + near[0]

    def _followed(self, reference: ArrayLike) -> list[float]:
        """Return the set-points."""
        if not self.reference:
            raise ProblemError(
                f"the argument 'reference' is given, but the set-points of this {self.policy.kind} policy are "
                "constant; expected [reference] with the key 'steps' or 'file', which states how the set-points "
                "change"
            )
        return _checked("reference", reference, len(self.reference)).tolist()


def _checked(name: str, given: ArrayLike, size: int) -> Array:
    """Return an argument of a step as an array."""
    axes = {"measurement": "(outputs,)", "reference": "(set-points,)", "applied": "(inputs,)"}
    found = array(name, given, (size,), axes[name])
    if not fits(found):
        raise ProblemError(
            f"{name} is {found.tolist()}; expected numbers of at most {LARGEST:.2g} in magnitude, the largest that "
            "packets carry"
        )
    return found


def _values(values: Values, places: Iterable[tuple[Name, int]], signal: str) -> Array:
    return np.array([values[i] for name, i in places if is_entry(name, signal)])


class StepFunction:
    """One step of a program as a pure function: its arguments are step number, memory and inputs."""

    def __init__(self, program: Program, taken: Mapping[str, int], network: Network, seed: int) -> None:
        """Compile the program, and draw its initial memory."""
        self._made_of = program, dict(taken), network, seed
        self._seed = count("seed", seed, 0)
        self._turn = compile_python(program)
        draws = np.random.default_rng(seed)
        drawn: dict[str, float] = {}
        for link in network.links:
            burst, chance = network.burst(link), draws.random(1)
            drawn[link_state(link)] = 0.0 if burst is None else float(burst.pick(chance)[0])
            law = network.links[link].played().delay
            if law is not None and law.sequence:
                drawn[place_of(link)] = float(draws.integers(len(law.sequence)))
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

    def __reduce__(self) -> tuple[type[StepFunction], tuple[Program, dict[str, int], Network, int]]:
        """Return the contents of a pickle: the program, as compiled functions cannot be stored."""
        return type(self), self._made_of

    def drawn(self, tick: int) -> Values:
        """Draw the random numbers of a step, uniform in (0, 1)."""
        if self._draw is None:
            return ()
        block, place = divmod(tick, _BLOCK)
        known, words = self._block
        if known != block:
            words = seed_generators(self._seed, _BLOCK, block * _BLOCK).view(np.uint64).T.tolist()
            self._block = block, words
        return self._draw(words[place], ())[1]

    def turn(self, tick: int, memory: Sequence[float], inputs: Sequence[float]) -> tuple[Values, Values]:
        """Compute the memory after a step and the outputs of the step."""
        supplied = [*inputs, *self.drawn(tick)]
        return self._turn(memory, [supplied[place] for place in self._read])


def _started(
    policy: Policy, network: Network, estimate: ArrayLike | None, start_input: ArrayLike | None
) -> tuple[Policy, tuple[str, ...]]:
    """Return a policy whose nodes start from an estimate of the state, or from an input, and remarks on this start."""
    if estimate is not None:
        n = policy.model.states
        wanted = array("estimate", estimate, (n,), "(states,), those of disturbances and set-points included")
        policy = _from_estimate(policy, network, wanted)
    if start_input is None:
        return policy, ()
    u, limit = array("start_input", start_input, (policy.model.inputs,), "(inputs,)"), policy.model.input_limit
    if limit is not None and ((u < limit[:, 0]) | (u > limit[:, 1])).any():
        raise ProblemError(
            f"start_input is {u.tolist()}, beyond the input_limit {limit.tolist()}; expected an input within the limits"
        )
    return _from_input(policy, network, u)


def _from_estimate(policy: Policy, network: Network, estimate: Array) -> Policy:
    prior, n = _prior(policy), policy.model.states
    before = _command(policy, network, measured=True)
    if prior and before is not None:
        moved = np.sqrt(2.0 + np.arange(n)) - policy.model.mean  # a direction in which no gain vanishes by chance
        after = _command(_shifted(policy, prior, moved), network, measured=True)
        if after is not None and not np.array_equal(before, after):
            return _shifted(policy, prior, estimate - policy.model.mean)
    raise ProblemError(
        f"estimate is given, but this {policy.kind} policy does not compute its commands from a filter's estimate; "
        "expected a policy whose controller filters measurements with noise, or no estimate"
    )


def _from_input(policy: Policy, network: Network, u: Array) -> tuple[Policy, tuple[str, ...]]:
    """Return the policy that starts with an input, with the constant disturbances for which this is the command."""
    model, memories = policy.model, dict(policy.initial)
    if policy.targets or policy.disturbance is not None:
        raise ProblemError(
            f"start_input is given, but this {policy.kind} policy uses a given controller or follows a stored "
            "reference; expected the controller's own start_input ([controller] pid), or no start_input"
        )
    for signal, (node, rows) in policy.applied.items():
        copies = dict.fromkeys((signal, f"{HELD}_{node}"))  # in one order: fingerprints contain the start values
        memories |= {name: u[[*rows]] for name in copies if name in policy.sizes}
    if HELD in policy.sizes:
        memories[HELD] = u
    policy, prior = replace(policy, initial=memories), _prior(policy)
    unknown, scale = _constants(policy) if prior else [], _NEAR * max(1.0, float(np.abs(u).max()))
    found = _command(policy, network)
    for _ in range(_TRIES if unknown else 0):  # one suffices, unless the packets of sensors change
        if found is None or np.abs(found - u).max() <= scale:
            break
        units = [_command(_shifted(policy, prior, unit), network) for unit in np.eye(model.states)[unknown]]
        effect = np.array([found if one is None else one - found for one in units]).T
        moved = np.zeros(model.states)
        moved[unknown] = np.linalg.lstsq(effect, u - found, rcond=None)[0]
        policy = _shifted(policy, prior, moved)
        found = _command(policy, network)
    if found is not None and np.abs(found - u).max() <= scale:
        return policy, ()
    got = "depends on the first measurement" if found is None else f"is {found.round(6).tolist()}"
    return policy, (
        f"the model has no constant disturbances that account for start_input, so the first command {got}; only "
        "inputs that are held start at start_input",
    )


def _prior(policy: Policy) -> str:
    """Return the name of the predicted state in the filter of a policy, or an empty name."""
    predicted, C = predicted_outputs(policy) or {}, policy.model.C
    found = [name for name, weight in predicted.items() if name != ONE and np.array_equal(np.asarray(weight), C)]
    return found[0] if found else ""


def _constants(policy: Policy) -> list[int]:
    """Return the indices of the states that are unknown constants, as neither inputs nor other states affect them."""
    # A state that moves another state of this kind is no constant disturbance, but for example the slope of a ramp.
    A, B, W = policy.model.A, policy.model.B, policy.model.W
    apart = ~B.any(axis=1)
    while (moved := apart & A[:, ~apart].any(axis=1)).any():  # by a state that inputs move
        apart &= ~moved
    unit = np.eye(len(A))
    return [
        int(i)
        for i in np.flatnonzero(apart)
        if np.array_equal(A[i], unit[i]) and np.array_equal(A[apart, i], unit[apart, i]) and W[i, i]
    ]


def _shifted(policy: Policy, prior: str, moved: Array) -> Policy:
    """Return the policy whose first prediction of the state is changed by a vector."""
    start = policy.initial.get(prior, np.zeros(policy.model.states))
    return replace(policy, initial={**policy.initial, prior: start + moved})


def _command(policy: Policy, network: Network, measured: bool = False) -> Array | None:
    """Return the first command if all outputs are as predicted or are measured as 0, or None if this is not known."""
    # Packets arrive, and the draws of the policy do not matter to a command.
    program = None if predicted_outputs(policy) is None else translate_command(policy, network)
    if program is None:
        return None
    given: dict[Name, float] = {Entry(fate_of(link), 0): 1.0 for link in network.links}
    given |= {Entry(TOLD, 0): 0.0, Entry(MANUAL, 0): 0.0}
    outputs = range(policy.model.sensed)
    given |= {Entry(REFERENCE, i): value for i, value in enumerate(policy.model.given.tolist())}
    given |= {Entry("y", i): 0.0 for i in outputs}
    given |= {Entry(known_of(name), i): float(measured) for name in sensed_by(policy) for i in outputs}
    start: list[float] = [0.0 if isinstance(state.start, tuple) else state.start for state in program.states]
    values = compile_python(program)(start, [given.get(name, 0.5) for name in program.inputs])[1]
    return np.array(values) + 0.0
