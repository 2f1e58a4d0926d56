"""The value of a base loop whose packets arrive late, and from it the cost of not sending.

In each step a packet with the inputs is sent. It arrives after a random delay of d periods and a fraction r of one, or
never. A receiver uses the newest packet that it has, drops older ones, and holds its inputs otherwise. The delay has a
fixed law, or that of the state of the link in which the packet was sent; this state moves once per step, as a Markov
chain. With several receivers, the delays of a packet to each of them have a joint law.

**State.** z = (s, u_{k−1}, …, u_{k−D}, û): s contains all that noise enters, û the inputs that act at the beginning of
the period, and the registers the last commands, for the largest number D of whole periods. In a step without a packet,
the register of the last command keeps it: silence repeats the last command.

**Modes.** A packet in flight that is newer than what acts is known by its age and by the law of its fate, given that it
has not arrived. All of these, with the state of the link, are the mode I. With one receiver and one state of the link
it is a set of ages. In a step, a packet of age j arrives at the fraction r with the hazard p_(j,r)/(1 − Σ_{d<j} p_d).
The arrivals in the order of their fractions, without those that find a newer packet, are the *path* of the inputs. The
path determines s⁺ = F (s, u_0, …, u_q) + noise and the stage cost, where u_i acts from the i-th change on. So each
outcome o has a probability q_o, matrices F_o and M_o for the command K_I z, and a next mode I_o.

**Value.** For the loop that sends every packet, z'P_I z with the least P_I ⪰ 0 that satisfies

    P_I = X_I(P),   X_I^a(P) = Σ_o q_o^a (M_o + F_o'P_{I_o} F_o),   Ψ_I^a = X_I^a(P) − X_I(P),

where a states which packets are sent. The modes that occur while all are sent form a closed system, whose value is
computed by doubling the horizon; D steps from all others lead there. The cost per step is Σ_I π_I tr(P_I·noise), plus
what depends on no input. For every policy that only decides when to send, its cost exceeds that of the base by the mean
of z'Ψ_I^a z + ψ_I^a. If the gain K_I depends on the mode, a change of mode has a cost of its own,

    ψ_I^a = Σ_o (q_o^a − q_o)(t_{I_o} + g_{I_o}),   t_I = tr(P_I·noise),   g_I + Σ π t = Σ_o q_o (t_{I_o} + g_{I_o}).

With one gain it is zero: if inputs in flight and at the receivers are zero, they remain so until a new packet arrives,
so P_I on (s, s) depends on the state of the link alone, and the noise enters s.

A decider that is informed of the arrivals of a period before the next decision knows I and û. If acknowledgements
come later, it weighs all ``histories`` since then by their probability and the likelihood of the measurements.

Source: costa2005, nilsson1998, vanloan1978, antunes2014rollout
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from taciturn import _arrays
from taciturn._arrays import Array, ArrayLike, symmetrised
from taciturn._display import Displayed
from taciturn._modes import growth, normal_moments
from taciturn._progress import check_time
from taciturn._text import number_of
from taciturn.base.periods import Periods
from taciturn.base.value import CONVERGED, DOUBLINGS, LARGEST, MOST_UNKNOWNS, SEEN, without_hidden
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.quadratic import Quadratic
from taciturn.model.losses import SUMS, stationary

Fate: TypeAlias = tuple[int, float] | None
"""Whole periods and fraction of a period after which a packet arrives at a receiver; None: it never arrives."""
Law: TypeAlias = tuple[tuple[tuple[Fate, ...], float], ...]
"""Fates of a packet, one for each receiver that waits for it, with their probabilities."""
Path: TypeAlias = tuple[tuple[tuple[float, int], ...], ...]
"""For each receiver, the fractions of a period at which its inputs change, and the ages of the packets that act."""
Sent: TypeAlias = tuple[bool, ...]
"""For each receiver, whether a packet is sent to it in a step."""
Flight: TypeAlias = "tuple[Packet, ...]"
"""Packets in flight, the newest first."""
Fates: TypeAlias = list[tuple[tuple[Fate, ...], float]]
"""Fates of a packet at all receivers, with their probabilities."""
MOST_MODES = 512  # of one receiver and one state of the link: delays of up to 9 periods
MOST_OUTCOMES = 30_000  # of steps in all modes
MOST_ENTRIES = 2_000_000  # of all P_I
MOST_MOMENTS = 150_000  # fourth moments of all modes
MOST_STEPS = 20_000  # of a horizon until the best gains repeat
SETTLED = 1e-12  # relative change of the value within a step, of gains that repeat
_WHOLE = 1e-9  # distance to a whole number of periods that counts as rounding
_DIGITS = 10  # digits in which two equal laws agree
_UNSEEN_GROWTH = 1e-5  # growth per step that rounding gives to moments that neither grow nor affect the cost


@dataclass(frozen=True, eq=False, repr=False)
class Delays(Displayed):
    """The law of the delays of packets: the fates of a packet, with probabilities that depend on the link's state."""

    fates: tuple[tuple[Fate, ...], ...]  # the fate of a packet at each receiver
    chances: Array  # probability of each fate of a packet that is sent in a state of the link, (s, fates)
    turns: Array  # transition probabilities of the state of the link, (s, s)

    @staticmethod
    def of(delays: ArrayLike, chances: ArrayLike, period: float = 1.0, turns: ArrayLike | None = None) -> Delays:
        """Make a law from delays, (f,) or for several receivers (f, r), where inf means that a packet never arrives.

        ``chances`` are their probabilities, (f,), or one row for each state of the link, (s, f); with the rest of the
        probability the packet arrives at no receiver. ``period`` is that of the loop in the unit of the delays.
        """
        times = np.array(delays, dtype=np.float64)
        times = times.reshape(len(times), -1) if times.ndim else times.reshape(1, 1)
        h = _arrays.number("period", period, 0.0)
        p = np.atleast_2d(np.array(chances, dtype=np.float64))
        T = np.eye(len(p)) if turns is None else _arrays.array("turns", turns, (len(p), len(p)), "states × states")
        if p.shape[1:] != times.shape[:1]:
            raise ProblemError(
                f"the probabilities of the delays have the shape {p.shape}; expected one for each of the "
                f"{number_of(len(times), 'delay')}"
            )
        if not (times >= 0).all():
            raise ProblemError(f"the delays are {times.tolist()}; expected numbers of at least 0, or inf for a loss")
        if not ((p >= 0).all() and (p.sum(axis=1) <= 1 + SUMS).all()):
            raise ProblemError(
                f"the probabilities of the delays are {p.tolist()}; expected numbers of at least 0 with a sum of at "
                "most 1: the rest is the probability that the packet is dropped"
            )
        if (
            not (T >= 0).all()
            or np.abs(T.sum(axis=1) - 1).max() > SUMS
            or np.linalg.matrix_rank(T - np.eye(len(T))) < (len(T) - 1)
        ):
            raise ProblemError(
                f"the transition probabilities of the link are {T.tolist()}; expected rows with the sum 1, and one "
                "group of states that the link never leaves"
            )
        lost = 1 - p.sum(axis=1)
        lost[lost <= SUMS] = 0.0
        p = np.column_stack([p, lost])
        fates = [*(tuple(_fate(one / h) for one in row) for row in times), (None,) * times.shape[1]]
        possible = [i for i, column in enumerate(p.T) if column.any()]
        return Delays(tuple(fates[i] for i in possible), p[:, possible] / p.sum(axis=1, keepdims=True), T)

    @staticmethod
    def together(laws: Sequence[Delays]) -> Delays:
        """Return the joint law of the delays over independent links, whose receivers follow each other."""
        fates: list[tuple[Fate, ...]] = [()]
        chances: Array = np.ones((1, 1))
        turns: Array = np.ones((1, 1))
        for law in laws:
            fates = [(*before, *own) for before in fates for own in law.fates]
            chances = np.asarray(np.kron(chances, law.chances), dtype=np.float64)
            turns = np.asarray(np.kron(turns, law.turns), dtype=np.float64)
        return Delays(tuple(fates), chances, turns)

    @property
    def depth(self) -> int:
        """Largest number D of whole periods after which a packet may arrive."""
        return max((one[0] for fate in self.fates for one in fate if one is not None), default=0)

    @property
    def receivers(self) -> int:
        """Number of receivers of a packet."""
        return len(self.fates[0])


def _fate(periods: float) -> Fate:
    """Return the fate of a packet that takes so many periods."""
    if not np.isfinite(periods):
        return None
    whole = int(np.floor(periods + _WHOLE))
    return whole, max(0.0, periods - whole) if periods - whole > _WHOLE else 0.0


class Packet(NamedTuple):
    """A packet in flight: its age, the receivers for which it is newer than what acts, and the law of its fate."""

    age: int
    receivers: tuple[int, ...]
    law: Law


class Mode(NamedTuple):
    """State of the link, and the packets in flight that may still act, the newest first, before a decision."""

    link: int
    flight: Flight

    @property
    def ages(self) -> tuple[int, ...]:
        """Ages of the packets in flight; with one receiver and one state of the link, they determine the mode."""
        return tuple(packet.age for packet in self.flight)


class Motion(NamedTuple):
    """The matrices of a path: z⁺ and stage cost with the command u as a free input, and the inputs that act."""

    fractions: tuple[float, ...]
    inputs: Array  # the inputs u_0, …, u_q as functions of (z, u), (q + 1, m, z + m)
    problem: Quadratic


class Outcome(NamedTuple):
    """A step with its probability, its path, the index of the next mode, and its matrices for the command K_I z."""

    chance: float
    path: Path
    after: int
    motion: Motion
    F: Array  # (z, z)
    M: Array  # (z, z)


def delayed_problem(plant: Periods, delay: float) -> Quadratic:
    """Return z⁺ = Az + Bu and its cost if each packet takes the same number of periods; z has D = ⌊delay⌋ registers."""
    fate = _fate(delay)
    assert fate is not None, "a constant delay is finite"
    return _motion(plant, fate[0], (tuple(range(plant.inputs)),), (((fate[1], fate[0]),),), (True,)).problem


def _motion(
    plant: Periods, depth: int, receivers: Sequence[tuple[int, ...]], path: Path, sent: Sequence[bool]
) -> Motion:
    """Return the matrices of a step with this path."""
    n, m = len(plant.noise), plant.inputs
    size = n + m * (depth + 1)
    whole = np.eye(size + m)
    s, registers, held, command = np.split(whole, [n, n + depth * m, size])
    inputs, fractions = [held], tuple(sorted({fraction for way in path for fraction, _ in way}))
    for at in fractions:
        acting = inputs[-1].copy()
        for rows, way in zip(receivers, path, strict=True):
            for fraction, age in way:
                if fraction == at:
                    acting[[*rows]] = (registers[(age - 1) * m : age * m] if age else command)[[*rows]]
        inputs.append(acting)
    T, (F, M) = np.vstack([s, *inputs]), plant.move(fractions)
    packet = (registers[:m] if depth else held).copy()
    for rows, goes in zip(receivers, sent, strict=True):
        if goes:
            packet[[*rows]] = command[[*rows]]
    moved = np.vstack([F @ T, np.vstack([packet, registers])[: depth * m], inputs[-1]])
    stage, z, u = symmetrised(T.T @ M @ T), slice(size), slice(size, None)
    problem = Quadratic(moved[:, z], moved[:, u], stage[z, z], stage[u, u], stage[z, u])
    return Motion(fractions, np.array(inputs), problem)


@dataclass(frozen=True, eq=False, repr=False)
class Chain(Displayed):
    """A base loop with late packets as a linear system that jumps from mode to mode."""

    plant: Periods
    delays: Delays
    modes: tuple[Mode, ...]  # all that sends and silent steps lead to; the first are those with no packet in flight
    outcomes: Mapping[Sent, tuple[tuple[Outcome, ...], ...]]  # of a step in each mode, by the packets that are sent
    closed: tuple[int, ...]  # indices of the modes that occur while all packets are sent
    gains: Array  # K_I of the command u = K_I z, (modes, m, z)
    varies: bool  # whether the gain depends on the mode

    @property
    def every(self) -> Sent:
        """The decision of the base, which sends to each receiver."""
        return (True,) * self.delays.receivers


def chain_of(
    plant: Periods,
    K: Array | Callable[[Mode], Array],
    delays: Delays,
    receivers: Sequence[tuple[int, ...]] | None = None,
) -> Chain:
    """Return the jump system of the base with the command u = K z over links with these delays.

    K has the columns of (s, û), with zeros at the registers, or those of z. ``receivers`` states which inputs each
    receiver applies; omitted: one receiver applies all.
    """
    m, depth = plant.inputs, delays.depth
    groups = (tuple(range(m)),) if receivers is None else tuple(receivers)
    if sorted(one for rows in groups for one in rows) != [*range(m)] or len(groups) != delays.receivers:
        raise ProblemError(
            f"the receivers apply the inputs {[*map(list, groups)]}, and the delays are those of "
            f"{number_of(delays.receivers, 'receiver')}; expected each of the {number_of(m, 'input')} at one receiver, "
            "with a delay for each receiver"
        )
    flights, actions = _Flights(delays), [*product((False, True), repeat=len(groups))]
    modes = [Mode(link, ()) for link in range(len(delays.turns))]
    places = {mode: i for i, mode in enumerate(modes)}
    ways: dict[Sent, list[list[tuple[float, Path, int]]]] = {sent: [] for sent in actions}
    count = 0  # of outcomes
    for mode in modes:  # which grows
        check_time()
        for sent in actions:
            found = flights.step(mode, sent)
            for _, _, after in found:
                if after not in places:
                    places[after] = len(modes)
                    modes.append(after)
            ways[sent].append([(chance, path, places[after]) for chance, path, after in found])
            count += len(found)
            _expect_few_outcomes(count, depth)
        _expect_few(modes, len(plant.noise) + m * (depth + 1), depth)
    motions, kept = dict[tuple[Sent, Path], Motion](), dict[tuple[Sent, Path, int], tuple[Array, Array]]()
    outcomes: dict[Sent, tuple[tuple[Outcome, ...], ...]] = {}
    gains = [_gain(K(mode) if callable(K) else K, plant, depth) for mode in modes]
    for sent, steps in ways.items():
        rows: list[tuple[Outcome, ...]] = []
        for i, step in enumerate(steps):
            made: list[Outcome] = []
            for chance, path, after in step:
                if (sent, path) not in motions:
                    motions[sent, path] = _motion(plant, depth, groups, path, sent)
                motion, key = motions[sent, path], (sent, path, i if callable(K) else 0)
                if key not in kept:
                    kept[key] = motion.problem.under(gains[i])
                made.append(Outcome(chance, path, after, motion, *kept[key]))
            rows.append(tuple(made))
        outcomes[sent] = tuple(rows)
    found, every = list(range(len(delays.turns))), outcomes[actions[-1]]
    for i in found:  # which grows
        found += {outcome.after for outcome in every[i]}.difference(found)
    return Chain(plant, delays, tuple(modes), outcomes, tuple(found), np.array(gains), callable(K))


def _gain(K: Array, plant: Periods, depth: int) -> Array:
    """Return the gain on z, with zeros at the registers if it is one on (s, û)."""
    n, m = len(plant.noise), plant.inputs
    if K.shape == (m, n + m * (depth + 1)):
        return K
    if K.shape == (m, n + m):
        return np.hstack([K[:, :n], np.zeros((m, m * depth)), K[:, n:]])
    raise ProblemError(
        f"the gain has the shape {K.shape}; expected ({m}, {n + m}) for the state and the held inputs, or "
        f"({m}, {n + m * (depth + 1)}) with the commands of the last {number_of(depth, 'step')}"
    )


def _expect_few_outcomes(found: int, depth: int) -> None:
    """Raise an error if the packets in flight may arrive in too many different ways."""
    if found > MOST_OUTCOMES:
        raise ProblemError(
            f"packets that arrive up to {number_of(depth, 'period')} late may arrive in more than {MOST_OUTCOMES} ways "
            "within a period; expected fewer different delays (such as whole periods, or a histogram with few rows), a "
            "longer period, or a buffer"
        )


def _expect_few(modes: Sequence[Mode], size: int, depth: int) -> None:
    """Raise an error if there are too many modes, or too many entries of their values."""
    if len(modes) > MOST_MODES or len(modes) * size * size > MOST_ENTRIES:
        most = min(MOST_MODES, MOST_ENTRIES // size**2)
        raise ProblemError(
            f"packets that arrive up to {number_of(depth, 'period')} late are in flight in more than {most} different "
            f"sets, with a value function of {number_of(size, 'state')} for each; expected delays of fewer periods: "
            "a shorter buffer, count later packets as dropped, which a receiver may do too, or choose a longer period"
        )


@dataclass(frozen=True, eq=False, repr=False)
class _Flights(Displayed):
    """Computes which packets are in flight after a step. Laws that agree but for rounding are the same."""

    delays: Delays
    _kept: dict[object, Packet] = field(default_factory=dict[object, Packet])

    def packet(self, age: int, receivers: Sequence[int], law: Iterable[tuple[Sequence[Fate], float]]) -> Packet | None:
        """Return a packet for the given receivers, whose fates include further ones; None if it never arrives there."""
        law = [*law]
        waiting = tuple(one for one in receivers if any(fates[one] is not None for fates, _ in law))
        if not waiting:
            return None
        merged, total = defaultdict[tuple[Fate, ...], float](float), sum(chance for _, chance in law)
        for fates, chance in law:
            merged[tuple(fates[one] for one in waiting)] += chance / total
        ordered = sorted(merged.items(), key=lambda one: repr(one[0]))
        key = (age, waiting, tuple((fates, round(chance, _DIGITS)) for fates, chance in ordered))
        return self._kept.setdefault(key, Packet(age, waiting, tuple(ordered)))

    def step(self, mode: Mode, sent: Sent) -> list[tuple[float, Path, Mode]]:
        """Return the outcomes of a step: probability, path and next mode."""
        none: Path = ((),) * self.delays.receivers
        partial: dict[tuple[Path, Flight], float] = {(none, ()): 1.0}
        row = self.delays.chances[mode.link]
        law = [(fates, float(chance)) for fates, chance in zip(self.delays.fates, row, strict=True) if chance > 0]
        new = self.packet(0, [one for one, goes in enumerate(sent) if goes], law)
        for packet in (new, *mode.flight) if new else mode.flight:  # the newest first
            before, partial = partial, defaultdict[tuple[Path, Flight], float](float)
            for arrived, chance, left in self._events(packet):
                for (path, flight), before_it in before.items():
                    used, waiting = list(path), [one for one in packet.receivers if not path[one]]
                    for receiver, fraction in arrived.items():
                        if not path[receiver] or fraction < path[receiver][0][0]:
                            used[receiver] = ((fraction, packet.age), *path[receiver])
                    rest = self.packet(packet.age + 1, [one for one in waiting if one not in arrived], left)
                    partial[tuple(used), (*flight, rest) if rest else flight] += before_it * chance
        return [
            (chance * float(turn), path, Mode(link, flight))
            for (path, flight), chance in partial.items()
            for link, turn in enumerate(self.delays.turns[mode.link])
            if chance * turn > 0
        ]

    def _events(self, packet: Packet) -> Iterable[tuple[dict[int, float], float, Fates]]:
        """Return where a packet may arrive in this step and at which fraction, the probability, and the fates left."""
        groups = defaultdict[tuple[tuple[int, float], ...], Fates](list)
        for fates, chance in packet.law:
            whole: list[Fate] = [None] * self.delays.receivers
            for receiver, fate in zip(packet.receivers, fates, strict=True):
                whole[receiver] = fate
            arrived = tuple((i, fate[1]) for i, fate in enumerate(whole) if fate and fate[0] == packet.age)
            groups[arrived].append((tuple(whole), chance))
        for arrived, left in groups.items():
            yield dict(arrived), sum(chance for _, chance in left), left


@dataclass(frozen=True, eq=False, repr=False)
class LateValue(Displayed):
    """Value function of a base loop with late packets, and the cost of not sending, in each mode of the chain."""

    chain: Chain
    P: Array  # value z'P_I z before the decision, (modes, z, z)
    Psi: Mapping[Sent, Array]  # cost z'Ψ_I z of sending only these packets, relative to all, (modes, z, z)
    psi: Mapping[Sent, Array]  # what it costs for the change of the mode, (modes,); 0 if the gain does not depend on it
    cost: float  # of the base, per step
    growth: float  # factor per step of the second moments of the base, as far as the cost depends on them

    @property
    def silent(self) -> tuple[Array, Array]:
        """Cost z'Ψ_I z + ψ_I of a step in which no packet is sent, (modes, z, z) and (modes,)."""
        none = (False,) * self.chain.delays.receivers
        return self.Psi[none], self.psi[none]


def late_value(chain: Chain, remedy: str) -> LateValue:
    """Compute the value function of a base loop whose packets arrive late, and the cost of not sending."""
    every, size = chain.outcomes[chain.every], len(chain.outcomes[chain.every][0][0].F)
    P, grows = _closed_value(chain, remedy)
    others = [i for i in range(len(chain.modes)) if i not in set(chain.closed)]
    for _ in range(chain.delays.depth + 1):
        for i in others:
            P[i] = _expected(every[i], P)
    t = np.einsum("mij,ij->m", P, np.pad(chain.plant.noise, (0, size - len(chain.plant.noise))))
    T = np.zeros((len(P), len(P)))
    for i, row in enumerate(every):
        for outcome in row:
            T[i, outcome.after] += outcome.chance
    within = np.ix_(chain.closed, chain.closed)
    shares = stationary(T[within])
    mean = float(shares @ t[[*chain.closed]])
    later = t.copy()  # t + g
    if chain.varies:
        c = len(shares)
        equations = np.vstack([np.eye(c) - T[within], shares])
        missed = np.append(T[within] @ t[[*chain.closed]] - mean, 0.0)
        later[[*chain.closed]] += np.linalg.lstsq(equations, missed, rcond=None)[0]
        for _ in range(chain.delays.depth + 1):
            later[others] = t[others] + T[others] @ later - mean
    Psi, psi = dict[Sent, Array](), dict[Sent, Array]()
    for sent, steps in chain.outcomes.items():
        check_time()
        Psi[sent] = np.array(
            [_expected(step, P) - _expected(whole, P) for step, whole in zip(steps, every, strict=True)]
        )
        psi[sent] = np.zeros(len(P))
        if chain.varies and sent != chain.every:
            ahead = [sum(one.chance * later[one.after] for one in step) for step in steps]
            psi[sent] = np.array(ahead) - T @ later
    return LateValue(chain, P, Psi, psi, mean + chain.plant.unseen, grows)


def _expected(step: Iterable[Outcome], P: Array) -> Array:
    """Return X_I(P), the expectation of stage cost and value."""
    total: Array = np.zeros(P.shape[1:])
    for outcome in step:
        total = total + outcome.chance * (outcome.M + outcome.F.T @ P[outcome.after] @ outcome.F)
    return symmetrised(total)


def _closed_value(chain: Chain, remedy: str) -> tuple[Array, float]:
    """Return the values of the modes that occur while all packets are sent, and zeros for the others, and the growth of
    the second moments.
    """
    place, depth = {mode: i for i, mode in enumerate(chain.closed)}, chain.delays.depth
    taken = [(place[i], one) for i in chain.closed for one in chain.outcomes[chain.every][i]]
    # the hidden modes are found among those of the step that uses the newest packets
    taken.sort(key=lambda step: sum(way[-1][1] if way else depth + 1 for way in step[1].path))
    shown, kept = without_hidden([[[(one.chance, one.F, one.M) for _, one in taken]]])
    c, size = len(place), kept.shape[1]
    jumps = [(i, place[one.after], p, F) for (i, one), (p, F, _) in zip(taken, shown[0][0], strict=True)]
    grows = _growth(jumps, [np.eye(size)] * c)
    whole = [(i, place[one.after], one.chance, one.F) for i, one in taken]
    hidden = _growth(whole, [np.eye(len(kept))] * c) if size < len(kept) else grows
    if not grows < 1 or hidden > 1 + _UNSEEN_GROWTH:
        raise _unstable(chain, max(grows, hidden), remedy)
    step, value = _operator([(*jump, M) for jump, (_, _, M) in zip(jumps, shown[0][0], strict=True)], c, size, depth)
    value = _summed(step, value)
    if value is None:
        raise _unstable(chain, grows, remedy)
    P = np.zeros((len(chain.modes), len(kept), len(kept)))
    for mode, half in zip(chain.closed, _matrices(value, c, size), strict=True):
        P[mode] = kept @ half @ kept.T
    return P, grows


def periodic_cost(chain: Chain, every: int) -> float | None:
    """Compute the cost per step if a packet is sent at every q-th step only; None if it is not finite.

    One cycle is X^send(X^silent(… X^silent(P))), a linear map of the values of all modes.
    """
    modes, silent = len(chain.modes), (False,) * chain.delays.receivers
    both = [[(i, one) for i in range(modes) for one in chain.outcomes[sent][i]] for sent in (chain.every, silent)]
    taken = [one for listed in both for one in listed]
    shown, kept = without_hidden([[[(one.chance, one.F, one.M) for _, one in taken]]])
    size, small = kept.shape[1], iter(shown[0][0])
    operators, turns = list[tuple[Array, Array]](), list[Array]()
    for listed in both:
        jumps = [(i, one.after, *next(small)) for i, one in listed]
        operators.append(_operator(jumps, modes, size, chain.delays.depth))
        T = np.zeros((modes, modes))
        for i, one in listed:
            T[i, one.after] += one.chance
        turns.append(T)
    send, wait = operators
    step, value = send
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(every - 1):  # X^send after k silent steps is step·P + value
            check_time()
            step, value = step @ wait[0], value + step @ wait[1]
        found = _summed(step, value) if np.isfinite(step).all() and np.isfinite(value).all() else None
    if found is None:
        return None
    noise = chain.plant.noise
    shares = stationary(turns[0] @ np.linalg.matrix_power(turns[1], every - 1))
    total, values = 0.0, found  # of the modes after each step, the last one first
    for k in range(every):
        at = shares if k == 0 else shares @ turns[0] @ np.linalg.matrix_power(turns[1], every - 1 - k)
        P = [kept @ half @ kept.T for half in _matrices(values, modes, size)]
        entered = [float(np.sum(one[: len(noise), : len(noise)] * noise)) for one in P]
        total += float(at @ entered)
        values = wait[0] @ values + wait[1]
    return total / every + chain.plant.unseen


def _operator(
    jumps: Sequence[tuple[int, int, float, Array, Array]], modes: int, size: int, depth: int
) -> tuple[Array, Array]:
    """Return the map P_I → Σ p (M + F'P_J F) over jumps (I, J, p, F, M): a matrix and a vector of upper triangles."""
    rows, columns = np.triu_indices(size)
    d = len(rows)
    if modes * d > MOST_UNKNOWNS:
        raise ProblemError(
            f"the plant, the controller and the packets of up to {number_of(depth, 'period')} have "
            f"{number_of(size, 'state')} together, in {number_of(modes, 'mode')}, too many to compute the cost-to-go "
            f"with {MOST_UNKNOWNS} unknowns; expected fewer states of the plant or the link, or delays of fewer periods"
        )
    step, value = np.zeros((modes * d, modes * d)), np.zeros(modes * d)
    for i, j, p, F, M in jumps:
        one, other = (
            F[np.ix_(rows, rows)] * F[np.ix_(columns, columns)],
            F[np.ix_(columns, rows)] * F[np.ix_(rows, columns)],
        )
        step[i * d : (i + 1) * d, j * d : (j + 1) * d] += p * (one + np.where(rows == columns, 0.0, other.T).T).T
        value[i * d : (i + 1) * d] += p * M[rows, columns]
    return step, value


def _summed(step: Array, value: Array) -> Array | None:
    """Return the least solution of P = step P + value, by doubling the horizon; None if it is not finite."""
    for _ in range(DOUBLINGS):
        check_time()
        added = step @ value
        value = value + added
        largest = float(np.abs(value).max(initial=0.0))
        if not largest <= LARGEST:
            return None
        if np.abs(added).max(initial=0.0) <= CONVERGED * largest:
            return value
        step = step @ step
    return None


def _matrices(value: Array, modes: int, size: int) -> list[Array]:
    """Return the symmetric matrices of which a vector has the upper triangles."""
    rows, columns = np.triu_indices(size)
    found = list[Array]()
    for part in np.split(value, modes):
        half = np.zeros((size, size))
        half[rows, columns] = part
        found.append(half + np.triu(half, 1).T)
    return found


class _Stacked(NamedTuple):
    """All outcomes of a step in all modes, one after the other."""

    mode: npt.NDArray[np.int64]  # in which each begins
    after: npt.NDArray[np.int64]  # index of the next mode
    chances: Array
    problem: Quadratic  # of three-dimensional arrays

    def sums(self, values: Array, modes: int) -> Array:
        """Return the expectation of a matrix of each outcome, in each mode."""
        total = np.zeros((modes, *values.shape[1:]))
        np.add.at(total, self.mode, self.chances[:, None, None] * values)
        return total


def _stacked(steps: Sequence[Sequence[Outcome]]) -> _Stacked:
    """Collect the outcomes of a step in all modes."""
    found = [(i, one) for i, step in enumerate(steps) for one in step]
    parts = zip(*(one.motion.problem for _, one in found), strict=True)
    return _Stacked(
        np.array([i for i, _ in found]),
        np.array([one.after for _, one in found]),
        np.array([one.chance for _, one in found]),
        Quadratic(*(np.array(part) for part in parts)),
    )


def best_gains(
    plant: Periods, delays: Delays, receivers: Sequence[tuple[int, ...]] | None = None, every: int = 1
) -> dict[Mode, Array]:
    """Compute the gains K_I of the command with the least cost, by the mode, if a packet is sent at every q-th step.

    They minimise u ↦ Σ_o q_o (stage_o + (A_o z + B_o u)'P_{I_o}(A_o z + B_o u)) in every mode, where the values P
    follow from them (a jump linear quadratic regulator). The controller knows the mode, and s is its estimate of the
    state, so no control with the same measurements and acknowledgements costs less.

    Raises:
        UnstableError: the mean square grows with all gains.
    """
    n, m = len(plant.noise), plant.inputs
    chain = chain_of(plant, np.zeros((m, n + m)), delays, receivers)
    size, count = n + m * (delays.depth + 1), len(chain.modes)
    send, silent = (_stacked(chain.outcomes[sent]) for sent in (chain.every, (False,) * delays.receivers))
    P = np.zeros((count, size, size))
    A, B, Q, R, N = send.problem
    for _ in range(MOST_STEPS):
        check_time()
        ahead = P
        for _ in range(every - 1):  # the silent steps that follow a packet
            V = ahead[silent.after]
            F = silent.problem.A
            ahead = silent.sums(silent.problem.Q + F.swapaxes(1, 2) @ V @ F, count)
        V = ahead[send.after]
        VA, VB = V @ A, V @ B
        H = send.sums(R + B.swapaxes(1, 2) @ VB, count)
        G = send.sums(N.swapaxes(1, 2) + B.swapaxes(1, 2) @ VA, count)
        gains = -np.linalg.pinv(H, hermitian=True) @ G
        whole = send.sums(Q + A.swapaxes(1, 2) @ VA, count) + G.swapaxes(1, 2) @ gains
        after = (whole + whole.swapaxes(1, 2)) / 2
        change, largest = float(np.abs(after - P).max()), float(np.abs(after).max(initial=0.0))
        P = after
        if not largest <= LARGEST:
            break
        if change <= SETTLED * largest:
            return dict(zip(chain.modes, gains, strict=True))
    often = "every sample" if every == 1 else f"one packet in {every} steps"
    raise UnstableError(
        f"the mean square of the loop that sends {often} grows with all gains, with packets that arrive up to "
        f"{number_of(delays.depth, 'period')} late or never; expected shorter delays, or fewer dropped packets"
    )


def _unstable(chain: Chain, grows: float, remedy: str) -> UnstableError:
    """Return the error that the mean square of the loop grows."""
    latest = max((d + (part > 0) for fate in chain.delays.fates for d, part in filter(None, fate)), default=0)
    return UnstableError(
        f"the mean square of the loop that sends every sample grows by a factor of {grows:.4g} per step, with packets "
        f"that arrive up to {number_of(latest, 'period')} late or never; expected a factor below 1: "
        f"shorter delays, fewer dropped packets, or {remedy}"
    )


def _growth(jumps: Sequence[tuple[int, int, float, Array]], starts: Sequence[Array]) -> float:
    """Return the growth factor per step of second moments, for jumps (from, to, probability, F)."""
    sizes = [len(start) for start in starts]
    ends = np.cumsum([size**2 for size in sizes])
    begins = ends - [size**2 for size in sizes]
    if not ends[-1]:  # the cost depends on no state
        return 0.0
    pairs = defaultdict[tuple[int, int], list[tuple[float, Array]]](list)
    for i, j, chance, F in jumps:
        pairs[i, j].append((chance, F))
    stacked = {pair: (np.array([p for p, _ in one]), np.array([F for _, F in one])) for pair, one in pairs.items()}

    def moved(moments: Array) -> Array:
        check_time()
        after = np.zeros(moments.shape)
        for (i, j), (chances, F) in stacked.items():
            own = moments[begins[i] : ends[i]].reshape(sizes[i], sizes[i])
            after[begins[j] : ends[j]] += np.tensordot(chances, F @ own @ F.swapaxes(1, 2), 1).ravel()
        return after

    return growth(moved, np.concatenate([start.ravel() for start in starts]))


def _squared(F: Array) -> Array:
    """Return the matrix that maps the products x_a x_b, a ≤ b, to those of F x."""
    (a, b), (c, d) = np.triu_indices(F.shape[0]), np.triu_indices(F.shape[1])
    one, other = F[a][:, c] * F[b][:, d], F[a][:, d] * F[b][:, c]
    return one + np.where(c == d, 0.0, other)


def fourth_growth(value: LateValue) -> float:
    """Compute the growth factor per step of the fourth moments of the base, as far as its cost depends on them.

    At 1 or more, the variance of the cost is infinite.
    """
    chain, bases = value.chain, list[Array]()
    largest = max(float(np.abs(P).max(initial=0.0)) for P in value.P)
    for i in chain.closed:
        sizes, vectors = np.linalg.eigh(value.P[i])
        bases.append(vectors[:, sizes > SEEN * largest])
    dimensions = [basis.shape[1] for basis in bases]
    count = sum((size * (size + 1) // 2) ** 2 for size in dimensions)
    if count > MOST_MOMENTS:
        raise ProblemError(
            f"the loop has {count} fourth moments, with packets of up to {number_of(chain.delays.depth, 'period')}; "
            f"expected at most {MOST_MOMENTS}: fewer states, or delays of fewer periods"
        )
    place = {mode: i for i, mode in enumerate(chain.closed)}
    jumps = [
        (place[i], place[one.after], one.chance, _squared(bases[place[one.after]].T @ one.F @ bases[place[i]]))
        for i in chain.closed
        for one in chain.outcomes[chain.every][i]
    ]
    # the fourth moments of x are the second ones of its products
    starts = list[Array]()
    for size in dimensions:
        a, b = np.triu_indices(size)
        moments = normal_moments(size, 4).reshape([size] * 4)
        starts.append(moments[a[:, None], b[:, None], a, b])
    return _growth(jumps, starts)


class History(NamedTuple):
    """An outcome of a step that the decider has not been informed of, as functions of z at its beginning."""

    chance: float
    after: int  # index of the next mode
    path: Path
    fractions: tuple[float, ...]  # of the period, at which the inputs change
    inputs: Array  # the inputs that act from the beginning and after each change, (q + 1, m, z)
    F: Array  # z⁺ = F z + noise, (z, z)


def histories(chain: Chain, mode: int, sent: Sent) -> tuple[History, ...]:
    """Return all histories of a step in a mode with the given decision; the next step of each begins in its mode.

    If acknowledgements come one step late, the decider knows the mode and z of the step before. It weighs the cost of
    silence of each history by its probability times the likelihood of the measurement after it. If the state of the
    link is not known, its belief over the modes follows in the same way from the paths that are acknowledged.
    """
    found: list[History] = []
    for outcome in chain.outcomes[sent][mode]:
        inputs, n = outcome.motion.inputs, len(outcome.F)
        acting = inputs[:, :, :n] + inputs[:, :, n:] @ chain.gains[mode]
        found.append(History(outcome.chance, outcome.after, outcome.path, outcome.motion.fractions, acting, outcome.F))
    return tuple(found)
