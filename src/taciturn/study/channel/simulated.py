"""Simulation of many loops on a shared channel, where an access rule selects the loops that send at each step."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, Bits
from taciturn._display import Displayed
from taciturn._modes import factor
from taciturn.model.trigger import Form
from taciturn.program.draws import NORMAL, seed_generators, with_draws
from taciturn.program.engine import StepwiseRunner, prepare
from taciturn.program.ir import Builder, Program
from taciturn.program.lower import TimeStep
from taciturn.study.channel.access import Access, Places

RULE_ERROR = "error"  # signal in the forms of a rule
KEPT, EXCESS, SENT, URGENCY, GRANTED = "kept", "excess", "sent", "urgency", "granted"


@dataclass(frozen=True, eq=False, repr=False)
class Group(Displayed):
    """A group of identical loops with the error e⁺ = F e + w; a send resets it to 0, and an unsent error costs e'Γe.

    Args:
        F: error dynamics, (n, n).
        noise: covariance of w ~ N(0, ·), (n, n).
        Gamma: weight Γ, (n, n).
        urgency: function of ``error``; a loop requests a send if it is above 0.
        count: number of loops.
        every: steps of the channel between two checks of a loop; the loops check in turn.
    """

    F: Array
    noise: Array
    Gamma: Array
    urgency: Form
    count: int
    every: int = 1


@dataclass(frozen=True, eq=False, repr=False)
class Stretch(Displayed):
    """Mean cost, sends and collisions over a number of simulated steps, for each of several independent channels.

    Args:
        cost: cost per step, summed over the loops of each group, (channels, groups).
        sends: sends per step of each group, (channels, groups).
        busy: sends and collisions per step, (channels,).
        waiting: loops per step that request a send and do not get one, (channels,).
    """

    cost: Array
    sends: Array
    busy: Array
    waiting: Array


class SharedChannel:
    """Step-by-step simulation of loops that share channels.

    The cost beyond that of sending every sample comes from completed squares.

    Memory and time grow linearly with the number of loops. Groups run together if they check at the same steps and
    their programs differ only in their constants. Loop i of channel k has the draws of path i·channels + k of the seed,
    for any grouping.

    Args:
        groups: the loops.
        access: access rule of the channel.
        channels: number of independent channels, each with all the loops.
        seed: seed of the random draws.
    """

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

    def run(self, ticks: int) -> Stretch:
        """Continue the simulation for a number of steps that is a multiple of every group's check interval."""
        channels = self._channels
        busy, waiting = np.zeros(channels), np.zeros(channels)
        active: dict[tuple[bool, ...], tuple[list[Cohort], Places]] = {}
        for tick in range(self._tick, self._tick + ticks):
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
        self._tick += ticks
        cost, sends = np.zeros((channels, len(self._groups))), np.zeros((channels, len(self._groups)))
        for cohort in self.cohorts:
            for group, added, sent in cohort.take():
                cost[:, group] += added / ticks
                sends[:, group] += sent / ticks
        return Stretch(cost, sends, busy / ticks, waiting / ticks)


@dataclass(frozen=True, eq=False)
class _Turn:
    """Loops of a group that check at the same steps."""

    group: int
    program: Program
    places: Places


class Cohort:
    """Loops of several groups that check their errors at the same steps and are simulated together.

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
        """Advance the errors of these loops to their next check, after the sends of the loops in the mask ``sent``."""
        self._sent += sent
        told = sent.T.astype(np.float64).reshape(1, -1)
        self.urgency = np.ascontiguousarray(self._errors.tick(told).reshape(-1, self._channels).T)

    def take(self) -> Iterator[tuple[int, Array, Array]]:
        """Yield each group of these loops with its cost and sends since the last call, (channels,) each."""
        added = self._errors.take_sums()[EXCESS].reshape(-1, self._channels)
        end = 0
        for turn in self._turns:
            part = slice(end, end := end + len(turn.places))
            yield turn.group, added[part].sum(axis=0), self._sent[:, part].sum(axis=1)
        self._sent[:] = 0.0


def contend(group: Group) -> Program:
    """Return the program of one check of a loop on a shared channel, with the access rule's decision as an input.

    It sums the cost and outputs the urgency.
    """
    tick = _look(group)
    told = tick.builder.emit("greater", tick.builder.input(GRANTED), tick.builder.constant(0.0))
    excess = _decide(tick, group, told)
    return with_draws(tick.finish({EXCESS: excess}, {URGENCY: tick.form(group.urgency)}))


def send_freely(group: Group) -> Program:
    """Return the program of one check of a loop on its own channel; it sums the cost and the sends."""
    tick = _look(group)
    wants = tick.builder.emit("greater", tick.form(group.urgency), tick.builder.constant(0.0))
    excess = _decide(tick, group, wants)
    return with_draws(tick.finish({EXCESS: excess, SENT: tick.as_number(wants)}))


def measure_freely(group: Group, looks: int, seed: int) -> tuple[Array, Array]:
    """Return simulated sends and cost per check of loops that share no channel.

    An equally long burn-in is dropped.
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
    tick.signals[KEPT] = [tick.choose(sends, zero, value) for value in tick.recall(RULE_ERROR)]
    excess = tick.form(Form((KEPT,), group.Gamma))
    tick.signals[NORMAL] = tick.supplied(NORMAL, spread.shape[1])
    tick.signals[RULE_ERROR] = tick.combine({KEPT: group.F, NORMAL: spread}, len(group.F))
    return excess


def start_loops(program: Program, paths: int, seed: int, first: int = 0) -> Array:
    """Return the initial program states of simulated loops with errors of 0, (states, paths)."""
    drawn = seed_generators(seed, paths, first)
    starts = [state.start for state in program.states]
    rows = [drawn[start[1]] if isinstance(start, tuple) else np.full(paths, start) for start in starts]
    return np.array(rows).reshape(len(rows), paths)
