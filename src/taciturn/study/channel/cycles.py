"""Exact cost of a schedule of a shared channel that repeats: a stretch of time division, repeated for ever.

Between two sends, k checks apart, a loop costs S(k) (``Clocked``). The times at which time division sends depend on no
error. So each stretch of T steps of it, repeated, is a periodic schedule. Its cost is the sum of S over the intervals
of all loops, divided by T. The interval around the end of the stretch, from the last send to the first one of the next
repetition, is one of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from taciturn._arrays import Array
from taciturn._progress import check_time
from taciturn.renewal.allocation import LoopClass
from taciturn.study.channel.access import Access, Places

INTERVALS = 24  # longest stretch, in the longest mean intervals between sends
SHORTEST, LONGEST = 256, 16_384  # steps of the longest stretch, if the checks of all loops repeat within them
WORK = 50_000_000  # most steps of all loops together


def best_stretch(sharers: Sequence[LoopClass], access: Access, rates: Array, cycle: int) -> float:
    """Return the least cost per step of a stretch of a schedule that is repeated, or infinity if there is none.

    Args:
        sharers: the classes of loops.
        access: the access rule, at its start; it must not depend on the errors.
        rates: mean sends per step of a loop of each class, (classes,); a loop with the rate 0 never sends.
        cycle: number of steps after which the checks of all loops repeat.
    """
    classes, phases, every = _places(sharers)
    loops = len(classes)
    longest = 1 / rates[rates > 0].min() if (rates > 0).any() else 0.0
    steps = int(np.clip(INTERVALS * longest, SHORTEST, min(LONGEST, WORK // loops)))
    steps = -(-steps // cycle) * cycle
    start = -(-int(min(2 * longest, steps)) // cycle) * cycle
    first, last, total = np.full(loops, -1), np.full(loops, -1), np.zeros(loops)
    never = np.array([sharer.error.forever / sharer.every for sharer in sharers])[classes]
    active = [np.flatnonzero(tick % every == phases) for tick in range(cycle)]
    silent, best = {cycle_place: np.zeros((1, len(at))) for cycle_place, at in enumerate(active)}, np.inf

    def between(places: Places, steps: Places) -> Array:
        """Return S of the intervals of some loops."""
        found = np.zeros(len(places))
        for number, sharer in enumerate(sharers):
            here = classes[places] == number
            found[here] = sharer.error.sums(steps[here] // sharer.every)
        return found

    for tick in range(start + steps):
        check_time()
        at = active[tick % cycle]
        if len(at):
            sent = at[access.grant(tick, at, silent[tick % cycle]).sent[0]]
            if tick >= start:
                again = sent[first[sent] >= 0]
                total[again] += between(again, tick - last[again])
                new = sent[first[sent] < 0]
                first[new] = tick
                last[sent] = tick
        passed = tick + 1 - start
        if passed > 0 and passed % cycle == 0 and passed > steps // 2:
            known = np.flatnonzero(first >= 0)
            costs = never.copy()
            costs[known] = (total[known] + between(known, first[known] + passed - last[known])) / passed
            best = min(best, float(costs.sum()))
    return best


def _places(sharers: Sequence[LoopClass]) -> tuple[Places, Places, Places]:
    """Return the class of each loop, and the phase and the interval of its checks, as ``SharedChannel`` orders them."""
    classes, phases, every = list[int](), list[int](), list[int]()
    for number, sharer in enumerate(sharers):
        for phase in range(min(sharer.every, sharer.count)):
            many = len(range(phase, sharer.count, sharer.every))
            classes += [number] * many
            phases += [phase] * many
            every += [sharer.every] * many
    return np.array(classes), np.array(phases), np.array(every)
