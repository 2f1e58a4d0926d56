"""Least growth of the mean square over lossy links among all linear gains, and critical losses, with proofs.

Only modes on or outside the unit circle matter. Their coordinates are rows V with VA = A_u V: the rows of p(A), where p
is the polynomial of the other modes, whose roots are known within balls.

**Survived losses.** Some gain maps a definite pair of weights to a smaller one.

**Losses that no linear gain survives.** T before a step does not depend on the gain, and one gain minimises K for all
states. So the best step is a map of pairs, (K, T) ← G(K, T), which preserves their order and is below the step of every
gain. If G(K, T) ⪰ (K, T) for some semidefinite pair, then the weights vanish under no gain. Such a pair may be zero on
some modes, such as those of an axis that survives more losses than another one. It is sought on the smallest set of
modes that does not survive, where it is definite. With T alone, the growth is β|λ|².

Source: schenato2007
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from flint import acb, acb_poly

from taciturn import _scipy
from taciturn._arrays import Array, Bits
from taciturn._cycles import closure
from taciturn._exact_modes import Limit, roots_of, unmoved
from taciturn._modes import balancing
from taciturn._precision import precision
from taciturn._progress import check_time
from taciturn._rational import leading, rational
from taciturn.errors import UnstableError
from taciturn.lqg._mean_square import Channel, LossyStep, MeanSquare
from taciturn.lqg.enclosures import PRECISIONS, UNIT, Balls, UnprovedError, block
from taciturn.lqg.quadratic import price
from taciturn.lqg.riccati import regulate

TURNS = 200  # places that are tried on a path
POLICIES = 8  # improvements of a gain at a place
ENOUGH = 1e-4  # part of the costs by which another improvement must lower them
CLOSE = 1e-11  # relative distance to the farthest place at which the search ends
STEP = 0.9  # part of a step of the secant method that is made, since it may be too long
FASTER = 1.1  # first growth, relative to that without inputs
SLOW = 0.99  # modulus above which a gain moves a mode that decays
FLAT = 1e-12  # least share of a direction in the cost-to-go of a regulator
NILPOTENT = 1e-6  # a growth below this counts as none
SAME = 1e-7  # relative difference of losses that count as equal
POWERS = 100  # steps towards the pair of weights that grows fastest
WIDE = 1e-6  # relative distance of the ends of a proof from which on both are named
SHARP = 4 * UNIT  # radius of coordinates, with the rounding to doubles, relative to the largest
MARGINS = (1e-9, 1e-7, 1e-5, 1e-3, 1e-2, 1e-1)  # distances of a loss from its critical value at which a proof is tried


Link: TypeAlias = Literal["actuator", "sensor"]


class Critical(NamedTuple):
    """Loss probabilities of a link with a proof: losses up to one are survived, losses from the other one on are not.

    Args:
        survived: some linear gain keeps the mean square bounded at this loss, and at smaller ones.
        lost: no linear gain does at this loss, and at larger ones.
    """

    survived: float
    lost: float

    def __str__(self) -> str:
        """Return the limit of the losses as text."""
        if self.lost - self.survived <= WIDE * self.lost:
            return f"below {self.survived:.6g}"
        return f"up to {self.survived:.6g} and below {self.lost:.6g} (more is not proved)"


class Rough(NamedTuple):
    """Some modes in double precision: A and B, their coordinates V x, VW = I, and a gain for links without losses."""

    A: Array
    B: Array
    V: Array
    W: Array
    L: Array


class Lasting:
    """The modes of a plant on or outside the unit circle, and the losses that they survive.

    Args:
        A: (n, n) dynamics.
        B: (n, m) input matrix.

    Raises:
        UnstableError: no input moves such a mode.
    """

    def __init__(self, A: Array, B: Array) -> None:
        """Scale the states by powers of two, so that the results do not depend on their units."""
        lost = unmoved(A, B, Limit(False)).lasting
        if lost.size:
            mode = Limit(False).named(complex(lost[0]))
            raise UnstableError(f"A has the eigenvalue {mode}, which is uncontrollable through B")
        self.scale = balancing(A)
        inputs = leading(rational(B))[1]  # the others do nothing more
        self.every, self.inputs = B.shape[1], inputs
        self.A, self.B = A / self.scale[:, None] * self.scale, (B / self.scale[:, None])[:, inputs]
        self._known: dict[tuple[int, ...], Rough] = {}
        self.roots = roots_of(rational(self.A).charpoly(), Limit(False))
        self.modes = [k for k, one in enumerate(self.roots) if one.side >= 0 and not one.root.imag < 0]
        self.count = sum(one.many for one in self.roots if one.side >= 0)
        self.grows = any(one.side > 0 for one in self.roots)
        self.size = max((abs(complex(self.roots[k].root)) for k in self.modes), default=0.0)

    def rough(self, modes: Sequence[int]) -> Rough:
        """Return some modes in double precision.

        Raises:
            UnstableError: the regulator is not proved.
        """
        key = tuple(modes)
        if key not in self._known:
            every = np.array([complex(one.root) for one in self.roots])
            own = np.isin(every, [every[modes], every[modes].conj()])
            V = _scipy.part_of_modes(self.A, lambda mode: bool(own[np.argmin(np.abs(every - mode))]))
            A, B, one = V @ self.A @ V.T, V @ self.B, np.eye(len(V))
            best = regulate(A, B, one, np.eye(B.shape[1]), np.zeros_like(B))
            # in the coordinates V x, the cost-to-go of the regulator is about the unit
            unit = np.sqrt(np.diag(best.K))
            sizes, turn = np.linalg.eigh(best.K / unit / unit[:, None])
            scale = np.sqrt(np.maximum(sizes, FLAT))[:, None] * turn.T * unit
            W = V.T @ np.linalg.inv(scale)
            V = scale @ V
            self._known[key] = Rough(V @ self.A @ W, V @ self.B, V, W, best.L @ np.linalg.inv(scale))
        return self._known[key]

    def reached(self, channel: Channel, link: Link, modes: Sequence[int] | None = None) -> Reached | None:
        """Return the largest loss of a link, up to the given one, that some modes survive; None if none was found."""
        A, B, _, _, L = self.rough(self.modes if modes is None else modes)
        if link == "sensor":
            start = self.reached(replace(channel, sensor_loss=0.0), "actuator", modes)
            if start is None or start.place < channel.actuator_loss:
                return None
            L, end = start.L, min(channel.sensor_loss, (1 - MARGINS[0] / 2) / self.size**2)
            if channel.acknowledged:
                return start._replace(place=end)
        elif channel.sensor_loss * self.size**2 < 1:
            end = channel.actuator_loss
        else:
            return None
        return follow(lambda loss, L: _loop(A, B, L, channel.at(link, loss)), L, end)

    def gain(self, channel: Channel) -> Array | None:
        """Return a gain of the states that keeps the mean square bounded; None if none was found."""
        slow = [k for k, one in enumerate(self.roots) if abs(complex(one.root)) > SLOW and not one.root.imag < 0]
        for modes in (slow, self.modes):  # also those that hardly decay, whose costs would be too large
            for path in (channel, channel.at("actuator", 1.0)):  # or a gain for larger losses
                found = self.reached(path, "actuator", modes)
                if found is not None and found.place >= channel.actuator_loss:
                    return self.of_states(found.L, modes)
        return None

    def of_states(self, L: Array, modes: Sequence[int] | None = None) -> Array:
        """Return a gain of the states from one of the coordinates of some modes."""
        found = np.zeros((self.every, len(self.A)))
        found[self.inputs] = L @ self.rough(self.modes if modes is None else modes).V / self.scale
        return found

    def slowest(self, channel: Channel) -> tuple[float, Array]:
        """Return the least growth of the mean square, and a gain of the states with this growth."""
        if not self.modes:
            return 0.0, self.of_states(np.zeros((self.B.shape[1], 0)))
        A, B, *_ = self.rough(self.modes)
        first = FASTER * self.size**2
        last = max(NILPOTENT, channel.sensor_loss * self.size**2)  # of the error alone
        found = follow(
            lambda fall, L: _loop(A, B, L, channel, first * (1 - fall)), np.zeros(B.T.shape), 1 - last / first
        )
        assert found is not None, "without inputs, the mean square grows like the modes"
        return first * (1 - found.place), self.of_states(found.L)

    def critical(self, channel: Channel, link: Link) -> Critical:
        """Return proved limits of the losses of one link at the given loss of the other link."""
        if not self.grows:  # a small gain keeps marginal modes bounded at any loss below 1
            fine = not self.modes or (channel.sensor_loss if link == "actuator" else channel.actuator_loss) < 1
            return Critical(1.0, 1.0) if fine else Critical(0.0, 0.0)
        channel = channel.at(link, 1.0)
        found = self.reached(channel, link)
        if found is None:
            return Critical(0.0, 0.0 if self.exceeded(channel.at(link, 0.0)) else 1.0)
        return Critical(self._survived(channel, link, found), self._lost(channel, link, found))

    def exceeded(self, channel: Channel) -> bool:
        """Return whether no linear gain keeps the mean square bounded, as is proved."""
        if self._doubts(channel):
            return True
        every = channel.at("actuator", 1.0)  # the same path as that of the critical loss, which it must not contradict
        found = self.reached(every, "actuator")
        return found is not None and self._lost(every, "actuator", found) <= channel.actuator_loss

    def _survived(self, channel: Channel, link: Link, found: Reached) -> float:
        """Return the largest loss of a link that is proved to be survived."""
        A, B, *_ = self.rough(self.modes)
        for margin in MARGINS:
            there = channel.at(link, found.place * (1 - margin))
            if self._survives(A, B, found.L, there):
                return found.place * (1 - margin)
            near = self.reached(there, link)  # the last gains are not accurate
            if near is not None and self._survives(A, B, near.L, there):
                return found.place * (1 - margin)
        return 0.0

    def _lost(self, channel: Channel, link: Link, found: Reached) -> float:
        """Return the least loss of a link from which on it is proved that no linear gain survives it; 1 if none is."""
        modes, found = self._smallest(channel, link, found.place * (1 + SAME), found)
        for margin in MARGINS:
            there = channel.at(link, found.place * (1 + margin))
            if found.place * (1 + margin) < 1 and (self._doubts(there) or self._grows(modes, found, there)):
                return found.place * (1 + margin)
        return 1.0

    def _doubts(self, channel: Channel, side: int = 1) -> bool:
        """Return whether it is proved that losses of the sensor link alone let an error grow; or with side −1, none."""
        with precision(PRECISIONS[0]):
            sides = [Limit(False, channel.sensor_loss).side(self.roots[k].root) for k in self.modes]
        return 1 in sides if side > 0 else all(one < 0 for one in sides)

    def _smallest(self, channel: Channel, link: Link, limit: float, found: Reached) -> tuple[list[int], Reached]:
        """Return few modes that survive no losses above a limit, and the largest loss that they survive."""
        modes = self.modes
        for one in self.modes:
            fewer = [k for k in modes if k != one]
            other = self.reached(channel, link, fewer) if fewer else None
            if other is not None and other.place <= limit:
                modes, found = fewer, other
        return modes, found

    def _survives(self, A: Array, B: Array, L: Array, channel: Channel) -> bool:
        """Return whether a gain of the coordinates of the modes keeps the mean square bounded, as is proved."""
        loop = _loop(A, B, L, channel)
        weights = loop.weights()
        if weights is None or not self._doubts(channel, -1):
            return False
        with suppress(UnprovedError), precision(PRECISIONS[0]):
            none, (K, T) = Balls.exact(np.zeros((0, 0))), map(Balls.exact, weights)
            LossyStep(*self._exact(self.modes), none, none, Balls.exact(L), loop.channel).falls(K, T)
            return True
        return False

    def _grows(self, modes: Sequence[int], found: Reached, channel: Channel) -> bool:
        """Return whether a step under the best gain increases a pair of weights of some modes, as is proved."""
        with suppress(UnprovedError), precision(PRECISIONS[0]):
            A, B = self._exact(modes)
            B = B.part(slice(None), self._moving([self.roots[k].root for k in modes]))
            if B.shape[1] >= B.shape[0]:  # the best of so many inputs move the modes anywhere
                B = Balls.exact(np.eye(len(found.K)))
            K, T = found.K, found.T
            for _ in range(POWERS):  # towards a pair that a step under the best gain multiplies
                loop = _loop(A.middle, B.middle, _best(A.middle, B.middle, K, T, channel), channel)
                K, T = loop.step(K, T)
                if not np.trace(K) > 0:
                    return False
                K, T = K / np.trace(K), T / np.trace(K)
            none, own, both = Balls.exact(np.zeros(B.shape[::-1])), Balls.exact(K), Balls.exact(T)
            step = LossyStep(A, B, none, none, none, channel)
            moved, after = step.linear(own, both)
            grown, across = moved - own, step.arriving(B.T @ own @ A)
            if channel.actuator_loss < 1:
                grown = block([[grown, across.T], [across, step.arriving(step.felt(own, both))]])
            return grown.definite() and (not channel.coupling or (after - both).definite())
        return False

    def _exact(self, modes: Sequence[int]) -> tuple[Balls, Balls]:
        """Return enclosures of A and B of some modes, in nearly the same coordinates as in double precision.

        Raises:
            UnprovedError: more than the largest precision is needed.
        """
        polynomial, own = rational(self.A).charpoly(), [self.roots[k].root for k in modes]
        rough = self.rough(modes)
        for bits in PRECISIONS:
            check_time()
            others = roots_of(polynomial, Limit(False), bits)
            with precision(bits), suppress(UnprovedError):
                A, V, W = (Balls.exact(part) for part in (self.A, rough.V, rough.W))
                for root, many, _ in others:
                    if not (root.imag < 0 or any(root.overlaps(one) for one in own)):
                        for _ in range(many):
                            V = _without(V, A, root)
                V = (V @ W).solve(V)
                found = V @ A @ W, V @ Balls.exact(self.B)
                if all((part.radius <= SHARP * np.abs(part.middle).max()).all() for part in found):
                    return found
        raise UnprovedError("the modes need more than 1,024 bits")

    def _moving(self, roots: Sequence[acb]) -> Bits:
        """Return a mask of the inputs without those that do not move some modes, as the zeros of A and B prove."""
        leads, found = np.asarray(self.A != 0, dtype=np.bool_), np.ones(self.B.shape[1], dtype=np.bool_)
        for k in range(len(found)):
            moved = closure(self.B[:, k] != 0, leads)
            polynomial = acb_poly(rational(self.A[np.ix_(moved, moved)]).charpoly().coeffs())
            found[k] = any(polynomial(root).contains(0) for root in roots)
        return found


def _without(V: Balls, A: Balls, root: acb) -> Balls:
    """Return V p(A) for the factor p of a root, and of its conjugate."""
    moved = V @ A
    if root.imag == 0:
        return moved - V.times(root.real)
    return moved @ A - moved.times(2 * root.real) + V.times(root.real**2 + root.imag**2)


class Reached(NamedTuple):
    """A gain under which the mean square is bounded at some place of a path of loops, and the weights of unit costs."""

    place: float
    L: Array
    K: Array
    T: Array


Path = Callable[[float, Array], MeanSquare]  # the loop at a place of the path, under a gain


def _loop(A: Array, B: Array, L: Array, channel: Channel, level: float = 1.0) -> MeanSquare:
    """Return a loop; with acknowledgements, losses of the sensor link only let the error grow by β|λ|²."""
    return MeanSquare(A, B, L, channel.at("sensor", 0.0) if channel.acknowledged else channel, level)


def follow(path: Path, L: Array, end: float) -> Reached | None:
    """Return the farthest place at which some gain keeps the mean square bounded, in double precision; None if none.

    Near this place, the inverse of the weights of unit costs decreases to zero, and the secant method approaches it.
    The best gain of one place keeps the mean square bounded at the next one, if this is near enough.

    Args:
        path: the loops; the larger the place, the faster they grow.
        L: a gain that keeps the mean square bounded at 0.
        end: the last place, which is returned if the mean square is bounded there.
    """
    found, before = _improved(path, L, 0.0), None
    if found is None:
        return None
    step = end / 8
    for _ in range(TURNS):
        check_time()
        after = _improved(path, found.L, min(found.place + step, end))
        if after is None:
            step /= 4
        else:
            before, found = found, after
            fall = _margin(before) - _margin(found)
            left = _margin(found) * (found.place - before.place) / fall if fall > 0 else np.inf
            step = min(STEP * left, 8 * step)
        if found.place >= end or step <= CLOSE * max(found.place, CLOSE):
            break
    return found


def _margin(found: Reached) -> float:
    return 1 / float(max(np.linalg.eigvalsh(part)[-1] for part in (found.K, found.T)))


def _improved(path: Path, L: Array, place: float) -> Reached | None:
    """Return the best gain for unit costs from a gain that keeps the mean square bounded; None if this does not."""
    found: Reached | None = None
    for _ in range(POLICIES):
        loop = path(place, L)
        weights = loop.weights()
        if weights is None or (found is not None and np.trace(weights[0]) > (1 - ENOUGH) * np.trace(found.K)):
            break
        found = Reached(place, L, *weights)
        L = _best(loop.A, loop.B, *weights, loop.channel)
    return found


def _best(A: Array, B: Array, K: Array, T: Array, channel: Channel) -> Array:
    """Return the best gain for the weights after a step, if inputs cost nothing."""
    return -price(B, K + channel.coupling * (T - K), np.zeros((B.shape[1],) * 2))[1] @ B.T @ K @ A
