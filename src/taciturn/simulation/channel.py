"""Many loops on one channel: at each tick a rule says whose error is sent, and the others keep theirs."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from taciturn._arrays import Array, Bits
from taciturn._modes import factor
from taciturn.model.trigger import Form
from taciturn.program.draws import NORMAL, seed_generators, with_draws
from taciturn.program.engine import Resident, prepare
from taciturn.program.ir import Builder, Program
from taciturn.program.lower import Tick
from taciturn.simulation.access import Access, Places

ERROR = "error"  # what a rule's forms weigh
KEPT, EXCESS, SENT, URGENCY, GRANTED = "kept", "excess", "sent", "urgency", "granted"


@dataclass(frozen=True, eq=False)
class Group:
    """Loops of one kind: before a look e⁺ = F e + w; what is not sent then costs e'Γe, and what is sent is 0.

    Args:
        F: (n, n).
        noise: covariance of w ~ N(0, ·), (n, n).
        Gamma: Γ, (n, n).
        urgency: over ``error``; above 0 a loop wants to send.
        count: loops.
        every: ticks of the channel between two looks; the loops take turns.
    """

    F: Array
    noise: Array
    Gamma: Array
    urgency: Form
    count: int
    every: int = 1


@dataclass(frozen=True, eq=False)
class Stretch:
    """Means over some ticks, on each of some independent channels.

    Args:
        cost: per tick, summed over the loops of each group, (channels, groups).
        sends: per tick, of each group, (channels, groups).
        busy: sends and collisions per tick, (channels,).
        waiting: loops per tick that want to send and do not get through, (channels,).
    """

    cost: Array
    sends: Array
    busy: Array
    waiting: Array


class SharedChannel:
    """Loops that share channels, tick by tick; the costs beyond sending always are exact by completion of squares.

    Memory and time grow linearly with the loops. Groups whose programs differ in their numbers alone, and that look at
    the same ticks, run together; loop i of channel k has the draws of path i·channels + k of the seed, whatever the
    groups.

    Args:
        groups: the loops.
        access: who may send.
        channels: independent ones, each with all the loops.
        seed: of the draws.
    """

    def __init__(self, groups: Sequence[Group], access: Access, channels: int = 1, seed: int = 0) -> None:
        """Begin with errors of 0."""
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
        """Run on for some ticks, a multiple of the ticks between two looks of every group."""
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
    """Loops of a group that look at the same ticks."""

    group: int
    program: Program
    places: Places


class Cohort:
    """Loops of groups that look at the same ticks and run together; paths are ordered by loop, then by channel."""

    def __init__(self, turns: Sequence[_Turn], every: int, phase: int, channels: int, seed: int) -> None:
        """Begin with errors of 0, of which none wants to be sent."""
        self.every, self.phase, self._turns, self._channels = every, phase, turns, channels
        self.places = np.concatenate([turn.places for turn in turns])
        states = [start(turn.program, len(turn.places) * channels, seed, turn.places[0] * channels) for turn in turns]
        paths = [len(turn.places) * channels for turn in turns]
        self._errors = Resident([turn.program for turn in turns], paths, np.concatenate(states, axis=1))
        self._sent = np.zeros((channels, len(self.places)))
        self.urgency = np.full((channels, len(self.places)), -1.0)

    def look(self, sent: Bits) -> None:
        """Take a look at all errors, of which some are sent, (channels, loops)."""
        self._sent += sent
        told = sent.T.astype(np.float64).reshape(1, -1)
        self.urgency = np.ascontiguousarray(self._errors.tick(told).reshape(-1, self._channels).T)

    def take(self) -> Iterator[tuple[int, Array, Array]]:
        """Yield each turn's group, cost and sends since this was last asked, (channels,) each."""
        added = self._errors.take_sums()[EXCESS].reshape(-1, self._channels)
        end = 0
        for turn in self._turns:
            part = slice(end, end := end + len(turn.places))
            yield turn.group, added[part].sum(axis=0), self._sent[:, part].sum(axis=1)
        self._sent[:] = 0.0


def contend(group: Group) -> Program:
    """Return one look of a loop that is told whether it sends: the error's cost is summed, its next urgency put out."""
    tick = _look(group)
    told = tick.builder.emit("greater", tick.builder.input(GRANTED), tick.builder.constant(0.0))
    excess = _decide(tick, group, told)
    return with_draws(tick.finish({EXCESS: excess}, {URGENCY: tick.form(group.urgency)}))


def send_freely(group: Group) -> Program:
    """Return one look of a loop that sends whenever it wants to: the error's cost and its sends are summed."""
    tick = _look(group)
    wants = tick.builder.emit("greater", tick.form(group.urgency), tick.builder.constant(0.0))
    excess = _decide(tick, group, wants)
    return with_draws(tick.finish({EXCESS: excess, SENT: tick.as_number(wants)}))


def measure_freely(group: Group, looks: int, seed: int) -> tuple[Array, Array]:
    """Return sends and cost per look of each loop of a group on its own, after as many looks that are dropped."""
    program = send_freely(group)
    run, states = prepare(program), start(program, group.count, seed)
    found = run(run(states, looks, None).states, looks, None)
    return found.sums[SENT] / looks, found.sums[EXCESS] / looks


def _look(group: Group) -> Tick:
    return Tick(Builder(), {ERROR: len(group.F)}, {}, ())


def _decide(tick: Tick, group: Group, sends: int) -> int:
    """Reset the error where it is sent, move it on, and return what was kept costs."""
    builder, spread = tick.builder, factor(group.noise)
    zero = builder.constant(0.0)
    tick.signals[KEPT] = [tick.choose(sends, zero, value) for value in tick.recall(ERROR)]
    excess = tick.form(Form((KEPT,), group.Gamma))
    tick.signals[NORMAL] = [builder.input(f"{NORMAL} {i}") for i in range(spread.shape[1])]
    tick.signals[ERROR] = tick.combine({KEPT: group.F, NORMAL: spread}, len(group.F))
    return excess


def start(program: Program, paths: int, seed: int, first: int = 0) -> Array:
    """Return the states of errors of 0, (states, paths)."""
    drawn = seed_generators(seed, paths, first)
    starts = [state.start for state in program.states]
    rows = [drawn[start[1]] if isinstance(start, tuple) else np.full(paths, start) for start in starts]
    return np.array(rows).reshape(len(rows), paths)
