"""Simulation of many loops on a shared channel, in which an access rule decides at each step which loops send.

Each loop has the error e⁺ = F e + w; a send resets it to 0, and an unsent error costs e'Γe, by completion of squares
(``Group``). It requests a send if its urgency is above 0. One class for each access rule decides which loops send:
those with the highest urgency, in turn, each at its own rate, or at random with collisions.

Memory and time grow linearly with the number of loops. Groups run together if they check at the same steps and their
programs differ only in their constants (``Cohort``). Loop i of channel k has the draws of path i·channels + k of the
seed, for any grouping.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from taciturn.extend import Array, Bits, Displayed, factor
from taciturn.model.trigger import Form
from taciturn.program.draws import NORMAL, seed_generators, with_draws
from taciturn.program.engine import StepwiseRunner, prepare
from taciturn.program.ir import Builder, Program
from taciturn.program.translation import TimeStep

Places: TypeAlias = npt.NDArray[np.int64]
ARRIVALS = float(np.exp(-1))  # new packets per slot at the largest throughput of random access
COLLISION = 1 / (np.e - 2)  # mean number of additional packets in a collision


@dataclass(frozen=True, eq=False, repr=False)
class Grant(Displayed):
    """The decision of an access rule in one step: which loops send successfully, and how many packets were sent."""

    sent: Bits  # whether each loop sent successfully, (channels, loops)
    busy: Array  # number of packets on the channel, including collisions, (channels,)


class Access(Protocol):
    """Access rule of a shared channel; it may have an internal state, so each simulation needs its own object."""

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Return which loops send."""
        ...


class MostUrgent:
    """Access rule that lets the loops with the highest urgency send, even if they request no send."""

    def __init__(self, capacity: int) -> None:
        """Store the capacity."""
        self.capacity = capacity

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Let the loops with the highest urgency send in the slots of this step."""
        sent = _lowest(-urgency, self.capacity)
        return Grant(sent, sent.sum(axis=1).astype(np.float64))


class RoundRobin:
    """Access rule that lets the loops send in turn, in a fixed order."""

    def __init__(self, capacity: int, loops: int) -> None:
        """Start with the first loop."""
        self.capacity, self.loops = capacity, loops
        self.turns = np.arange(loops, dtype=np.float64)

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Give the slots of this step to the loops whose turn it is in the fixed order."""
        sent = _lowest(self.turns[None, at], self.capacity)
        self.turns[at[sent[0]]] += self.loops
        return _alike(sent, len(urgency))


class TimeDivision:
    """Access rule that lets every loop send periodically, at a send rate of its own.

    If too many sends are due, loops whose next send is earlier have priority.
    """

    def __init__(self, capacity: int, rates: Array, phases: Array) -> None:
        """Plan the first sends."""
        self.capacity = capacity
        with np.errstate(divide="ignore"):
            self.interval = 1 / rates
        self.due = phases * np.where(rates > 0, self.interval, 0.0) + np.where(rates > 0, 0.0, np.inf)

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Let the loops whose periodic sends are due send in the slots of this step."""
        due = self.due[at]
        ready = np.flatnonzero(due <= tick)
        if len(ready) > self.capacity:
            again = due[ready] + self.interval[at[ready]]
            ready = ready[np.argsort(again, kind="stable")[: self.capacity]]
        self.due[at[ready]] += self.interval[at[ready]]
        sent = np.zeros((1, len(at)), dtype=np.bool_)
        sent[0, ready] = True
        return _alike(sent, len(urgency))


class RandomAccess:
    """Access rule in which each loop with positive urgency picks a random slot; packets in the same slot collide.

    All loops observe which slots were empty, used or collided. They use it to estimate the backlog n of a channel, and
    send with the probability min(1, slots/n) (pseudo-Bayesian control of slotted ALOHA).
    """

    def __init__(self, slots: int, seed: int) -> None:
        """Start with an empty channel."""
        self.slots, self.draws, self.backlog = slots, np.random.default_rng(seed), np.zeros(1)

    def grant(self, tick: int, at: Places, urgency: Array) -> Grant:
        """Give a random slot to each loop that tries to send; a packet that is alone in its slot arrives."""
        channels = len(urgency)
        backlog = np.broadcast_to(self.backlog, channels)
        tries = (urgency > 0) & (
            self.draws.random(urgency.shape) * np.maximum(backlog, self.slots)[:, None] < self.slots
        )
        channel, loop = np.nonzero(tries)
        slot = channel * self.slots + self.draws.integers(self.slots, size=len(channel))
        used = np.bincount(slot, minlength=channels * self.slots)
        alone = used[slot] == 1
        sent = np.zeros(urgency.shape, dtype=np.bool_)
        sent[channel[alone], loop[alone]] = True
        collided = (used.reshape(channels, self.slots) > 1).sum(axis=1)
        told = collided * COLLISION - (self.slots - collided)
        self.backlog = self.slots * ARRIVALS + np.maximum(backlog + told, 0.0)
        return Grant(sent, tries.sum(axis=1).astype(np.float64))


def _lowest(values: Array, most: int) -> Bits:
    """Return a mask of the lowest values in each row, at most ``most`` of them."""
    if values.shape[1] <= most:
        return np.ones(values.shape, dtype=np.bool_)
    chosen = np.zeros(values.shape, dtype=np.bool_)
    np.put_along_axis(chosen, np.argpartition(values, most - 1, axis=1)[:, :most], True, axis=1)
    return chosen


def _alike(sent: Bits, channels: int) -> Grant:
    """Return the same grant on all channels."""
    return Grant(np.broadcast_to(sent, (channels, sent.shape[1])), np.full(channels, float(sent.sum())))


RULE_ERROR = "error"  # signal in the forms of a rule
KEPT, EXCESS, SENT, URGENCY, GRANTED = "kept", "excess", "sent", "urgency", "granted"


@dataclass(frozen=True, eq=False, repr=False)
class Group(Displayed):
    """Identical loops with error e⁺ = F e + w; a send resets the error to 0, and a check without a send costs e'Γe."""

    F: Array  # error dynamics, (n, n)
    noise: Array  # covariance of w ~ N(0, ·), (n, n)
    Gamma: Array  # weight Γ, (n, n)
    urgency: Form  # function of ``error``; a loop requests a send if it is above 0
    count: int  # number of loops
    every: int = 1  # steps of the channel between two checks of a loop; the loops check in turn


@dataclass(frozen=True, eq=False, repr=False)
class Stretch(Displayed):
    """Mean cost, sends and collisions during some simulated steps, for each of several independent channels."""

    cost: Array  # cost per step, summed over the loops of each group, (channels, groups)
    sends: Array  # sends per step of each group, (channels, groups)
    busy: Array  # sends and collisions per step, (channels,)
    waiting: Array  # loops per step that request a send and do not get one, (channels,)


class SharedChannel:
    """Simulation of loops that share a channel, step by step, for several independent channels in parallel."""

    def __init__(self, groups: Sequence[Group], access: Access, channels: int = 1, seed: int = 0) -> None:
        """Start with errors of 0."""
        self._groups, self._access, self._channels, self._tick = groups, access, channels, 0
        alike: dict[tuple[Hashable, int, int], list[_Turn]] = {}
        first = 0
        for index, group in enumerate(groups):
            program = contend(group)
            for phase in range(min(group.every, group.count)):
                loops = len(range(phase, group.count, group.every))
                turn = _Turn(index, program, np.arange(first, first + loops))
                alike.setdefault((program.structure, group.every, phase), []).append(turn)
                first += loops
        self.cohorts = [Cohort(turns, every, phase, channels, seed) for (_, every, phase), turns in alike.items()]

    def run(self, steps: int) -> Stretch:
        """Continue the simulation for a number of steps, which must be a multiple of every group's check interval."""
        channels = self._channels
        busy, waiting = np.zeros(channels), np.zeros(channels)
        active: dict[tuple[bool, ...], tuple[list[Cohort], Places]] = {}
        for tick in range(self._tick, self._tick + steps):
            key = tuple(tick % cohort.every == cohort.phase for cohort in self.cohorts)
            if key not in active:
                looking = [cohort for cohort, looks in zip(self.cohorts, key, strict=True) if looks]
                places = np.concatenate([cohort.places for cohort in looking] or [np.arange(0)])
                active[key] = looking, places
            cohorts, places = active[key]
            if not cohorts:
                continue
            urgency = np.concatenate([cohort.urgency for cohort in cohorts], axis=1)
            grant = self._access.grant(tick, places, urgency)
            busy += grant.busy
            waiting += ((urgency > 0) & ~grant.sent).sum(axis=1)
            end = 0
            for cohort in cohorts:
                cohort.look(grant.sent[:, end : (end := end + len(cohort.places))])
        self._tick += steps
        cost, sends = np.zeros((channels, len(self._groups))), np.zeros((channels, len(self._groups)))
        for cohort in self.cohorts:
            for group, added, sent in cohort.take():
                cost[:, group] += added / steps
                sends[:, group] += sent / steps
        return Stretch(cost, sends, busy / steps, waiting / steps)


@dataclass(frozen=True, eq=False)
class _Turn:
    """Loops of a group that check at the same steps."""

    group: int
    program: Program
    places: Places


class Cohort:
    """Loops of several groups that check their errors at the same steps; one program simulates all of them.

    Paths are ordered by loop, then by channel.
    """

    def __init__(self, turns: Sequence[_Turn], every: int, phase: int, channels: int, seed: int) -> None:
        """Start with errors of 0, of which none requests a send."""
        self.every, self.phase, self._turns, self._channels = every, phase, turns, channels
        self.places = np.concatenate([turn.places for turn in turns])
        states = [
            start_loops(turn.program, len(turn.places) * channels, seed, turn.places[0] * channels) for turn in turns
        ]
        paths = [len(turn.places) * channels for turn in turns]
        self._errors = StepwiseRunner([turn.program for turn in turns], paths, np.concatenate(states, axis=1))
        self._sent = np.zeros((channels, len(self.places)))
        self.urgency = np.full((channels, len(self.places)), -1.0)

    def look(self, sent: Bits) -> None:
        """Simulate these loops until their next check; the mask ``sent`` marks loops that send at the present check."""
        self._sent += sent
        told = sent.T.astype(np.float64).reshape(1, -1)
        self.urgency = np.ascontiguousarray(self._errors.tick(told).reshape(-1, self._channels).T)

    def take(self) -> Iterator[tuple[int, Array, Array]]:
        """Yield each group of loops with its cost and its sends since the last call, each of shape (channels,)."""
        added = self._errors.take_sums()[EXCESS].reshape(-1, self._channels)
        end = 0
        for turn in self._turns:
            part = slice(end, end := end + len(turn.places))
            yield turn.group, added[part].sum(axis=0), self._sent[:, part].sum(axis=1)
        self._sent[:] = 0.0


def contend(group: Group) -> Program:
    """Return the program of one check of a loop, with the decision of the channel's access rule as an input.

    The program sums up the cost and outputs the urgency.
    """
    tick = _look(group)
    told = tick.builder.emit("greater", tick.builder.input(GRANTED), tick.builder.constant(0.0))
    excess = _decide(tick, group, told)
    return with_draws(tick.finish({EXCESS: excess}, {URGENCY: tick.form(group.urgency)}))


def send_freely(group: Group) -> Program:
    """Return the program of one check of a loop that never waits for the channel; it sums up the cost and the sends."""
    tick = _look(group)
    wants = tick.builder.emit("greater", tick.form(group.urgency), tick.builder.constant(0.0))
    excess = _decide(tick, group, wants)
    return with_draws(tick.finish({EXCESS: excess, SENT: tick.as_number(wants)}))


def measure_freely(group: Group, looks: int, seed: int) -> tuple[Array, Array]:
    """Simulate loops that each have a channel of their own, and return the sends and the cost per check.

    An initial phase of the same length is discarded.
    """
    program = send_freely(group)
    run, states = prepare(program), start_loops(program, group.count, seed)
    found = run(run(states, looks, None).states, looks, None)
    return found.sums[SENT] / looks, found.sums[EXCESS] / looks


def _look(group: Group) -> TimeStep:
    return TimeStep(Builder(), {RULE_ERROR: len(group.F)}, {}, ())


def _decide(tick: TimeStep, group: Group, sends: int) -> int:
    """Reset the error if it is sent, advance it by a step, and return the cost of the error that was not sent."""
    builder, spread = tick.builder, factor(group.noise)
    zero = builder.constant(0.0)
    tick.signals[KEPT] = [tick.builder.choose(sends, zero, value) for value in tick.recall(RULE_ERROR)]
    excess = tick.form(Form((KEPT,), group.Gamma))
    tick.signals[NORMAL] = tick.supplied(NORMAL, spread.shape[1])
    tick.signals[RULE_ERROR] = tick.combine({KEPT: group.F, NORMAL: spread}, len(group.F))
    return excess


def start_loops(program: Program, paths: int, seed: int, first: int = 0) -> Array:
    """Return the initial states of a simulation in which all errors are 0, shape (states, paths)."""
    drawn = seed_generators(seed, paths, first)
    starts = [state.start for state in program.states]
    rows = [drawn[start[1]] if isinstance(start, tuple) else np.full(paths, start) for start in starts]
    return np.array(rows).reshape(len(rows), paths)
