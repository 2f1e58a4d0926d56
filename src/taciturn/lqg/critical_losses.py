"""Mean-square cost and growth of a loop over lossy links, and critical loss probabilities of a plant, with proofs.

**Under a given gain** L, the cost-to-go has a weight K of the state and a weight P of the estimation error. One step of
the loop is a linear map of the pairs (K, T), T = K + P:

    K ← M'KM + αᾱ L'YL,   T ← A'((1−β)K + βT)A,   M = A + ᾱBL,   Y = B'((1−φ)K + φT)B.

These are two Lyapunov equations, coupled only by the symmetric matrix Y, whose size is the number of inputs. So a loop
with sixty states needs only a few Lyapunov equations with sixty states, instead of one system of 7200 unknowns. The map
preserves the order of pairs. So if it maps a definite pair to a smaller one, the mean square is bounded.

**Among all linear gains**, only modes on or outside the unit circle matter. Their coordinates are rows V with
VA = A_u V: the rows of p(A), where p is the polynomial of the other modes, whose roots are known within balls. The
farthest losses that some gain survives are approached by the secant method, from the best gain for smaller losses.

*Survived losses:* some gain maps a definite pair of weights to a smaller one.

*Losses that no linear gain survives:* T before a step does not depend on the gain, and one gain minimises K for all
states. So the best step is a map of pairs, (K, T) ← G(K, T), which preserves their order and is below the step of every
gain. If G(K, T) ⪰ (K, T) for some semidefinite pair, then the weights vanish under no gain. Such a pair may be zero on
some modes, such as those of an axis that survives more losses than another one. It is sought on the smallest set of
modes that does not survive, where it is definite. With T alone, the growth is β|λ|².

Source: schenato2007
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Generic, Literal, NamedTuple, TypeAlias

import numpy as np
from flint import acb, acb_poly

from taciturn import _scipy
from taciturn._arrays import NO_VARIANCE, Array, Bits, symmetrised
from taciturn._display import Displayed
from taciturn._modes import balancing, closure, growth, summed
from taciturn._progress import check_time
from taciturn._rational import Limit, leading, precision, rational, roots_of, unmoved
from taciturn.errors import UnstableError
from taciturn.lqg.enclosures import PRECISIONS, UNIT, Balls, E, UnprovedError, block
from taciturn.lqg.equation import relative
from taciturn.lqg.quadratic import price
from taciturn.lqg.riccati import regulate

_SINGULAR = 1e-12  # least eigenvalue of a price of unit diagonal to which the proof is adapted
_TURNS = 200  # places that are tried on a path
_POLICIES = 8  # improvements of a gain at a place
_ENOUGH = 1e-4  # part of the costs by which another improvement must lower them
_CLOSE = 1e-11  # relative distance to the farthest place at which the search ends
_STEP = 0.9  # part of a step of the secant method that is made, since it may be too long
_FASTER = 1.1  # first growth, relative to that without inputs
_SLOW = 0.99  # modulus above which a gain moves a mode that decays
_FLAT = 1e-12  # least share of a direction in the cost-to-go of a regulator
_NILPOTENT = 1e-6  # a growth below this counts as none
_SAME = 1e-7  # relative difference of losses that count as equal
_POWERS = 100  # steps towards the pair of weights that grows fastest
_WIDE = 1e-6  # relative distance of the ends of a proof from which on both are named
_SHARP = 4 * UNIT  # radius of coordinates, with the rounding to doubles, relative to the largest
_MARGINS = (1e-9, 1e-7, 1e-5, 1e-3, 1e-2, 1e-1)  # distances of a loss from its critical value at which a proof is tried
Link: TypeAlias = Literal["actuator", "sensor"]


@dataclass(frozen=True, repr=False)
class Channel(Displayed):
    """The properties of lossy links that determine the optimal gains: loss probabilities, acknowledgements and delay.

    Args:
        actuator_loss: α, loss probability of the actuator link, in [0, 1].
        sensor_loss: β, loss probability of the sensor link, in [0, 1].
        acknowledged: whether the actuator acknowledges packets (TCP-like) or not (UDP-like).
        delayed: whether the controller uses the measurement of step k only at step k + 1.
        keys: names of the two losses in messages.
    """

    actuator_loss: float
    sensor_loss: float
    acknowledged: bool
    delayed: bool
    keys: tuple[str, str] = field(default=("network.actuator_loss", "network.sensor_loss"), compare=False)

    def at(self, link: Literal["actuator", "sensor"], loss: float) -> Channel:
        """Return the same properties with another loss probability of the link ``link``."""
        return replace(self, actuator_loss=loss) if link == "actuator" else replace(self, sensor_loss=loss)

    @property
    def exposure(self) -> float:
        """Probability φ that the controller's next input depends on an estimation error: the sensor loss, or 1 with a
        delay.
        """
        return 1.0 if self.delayed else self.sensor_loss

    @property
    def reach(self) -> float:
        """Probability that the estimation error due to an unacknowledged input persists until the next input."""
        return 0.0 if self.acknowledged else self.exposure

    @property
    def coupling(self) -> float:
        """Factor αφ with which an unacknowledged input adds to the estimation error; 0 with acknowledgements."""
        return self.actuator_loss * self.reach


class MeanSquare:
    """One backward step of the weights (K, T) of a loop over lossy links with a given gain, divided by ``level``."""

    def __init__(self, A: Array, B: Array, L: Array, channel: Channel, level: float = 1.0) -> None:
        """Store the loop."""
        self.A, self.B, self.L, self.channel, self.level = A, B, L, channel, level
        self.alpha, self.beta = channel.actuator_loss, channel.sensor_loss
        self.moved = A + (1 - self.alpha) * (B @ L)  # M: the mean of A + BL and A over the losses
        self.spread = self.alpha * (1 - self.alpha)  # variance of the loss

    def step(self, K: Array, T: Array) -> tuple[Array, Array]:
        """Compute the weights before a step from the weights (K, T) after it."""
        own = self.moved.T @ K @ self.moved + self.spread * self.L.T @ self._seen(K, T) @ self.L
        both = self.A.T @ ((1 - self.beta) * K + self.beta * T) @ self.A
        return symmetrised(own) / self.level, symmetrised(both) / self.level

    def growth(self) -> float:
        """Compute the factor by which the mean square of the loop without noise grows per step."""
        return growth(lambda pair: np.stack(self.step(*pair)), np.stack([np.eye(len(self.A))] * 2))

    def weights(self) -> tuple[Array, Array] | None:
        """Compute K and T for unit costs; return None if the mean square grows by the factor ``level`` or more per
        step.
        """
        # It does if and only if both are definite, and each step leaves the unit of both.
        one = np.eye(len(self.A))
        try:
            with np.errstate(all="ignore"):
                pair = self.solve(one, one)
        except np.linalg.LinAlgError:
            return None
        left = (part - after for part, after in zip(pair, self.step(*pair), strict=True))
        least = [float(np.linalg.eigvalsh(part)[0]) for part in (*pair, *(self.level * part for part in left))]
        return pair if min(least) > 1e-3 else None

    def solve(self, first: Array, second: Array) -> tuple[Array, Array]:
        """Solve the two coupled Lyapunov equations of the loop for the weights K and T."""
        # K and T are the sums over all steps of terms that are added in each step.
        K, T = self._apart(first, second)
        if self.spread:  # solved without coupling; then for the coupling Y = Y_0 + turn·Y
            upper = np.triu_indices(len(self.L))
            answers = [self._apart(self._pushed(i, j), np.zeros_like(self.A)) for i, j in np.transpose(upper).tolist()]
            turn = np.stack([self._seen(*pair)[upper] for pair in answers], axis=1)
            y = np.linalg.solve(np.eye(len(turn)) - turn, self._seen(K, T)[upper])
            for share, (one, two) in zip(y.tolist(), answers, strict=True):
                K, T = K + share * one, T + share * two
        if not all(np.isfinite(part).all() for part in (K, T)):
            raise np.linalg.LinAlgError
        return symmetrised(K), symmetrised(T)

    def _pushed(self, i: int, j: int) -> Array:
        """Return the term of K from an entry of Y and its mirror image."""
        one = self.spread * np.outer(self.L[i], self.L[j])
        return one if i == j else one + one.T

    def _seen(self, K: Array, T: Array) -> Array:
        return symmetrised(self.B.T @ (K + self.channel.reach * (T - K)) @ self.B)

    def _apart(self, first: Array, second: Array) -> tuple[Array, Array]:
        root = np.sqrt(self.level)
        with np.errstate(over="ignore", invalid="ignore"):  # callers check for overflow
            K = summed((self.moved / root).T, symmetrised(first)) / self.level
            second = second + (1 - self.beta) * self.A.T @ K @ self.A
            T = summed((np.sqrt(self.beta) / root * self.A).T, symmetrised(second)) / self.level
        return K, T


class LossyStep(NamedTuple, Generic[E]):
    """Enclosures of the matrices with which the weights (K, T) over lossy links are computed one step backwards."""

    A: E
    B: E
    Q: E
    R: E
    L: E
    channel: Channel

    def linear(self, K: E, T: E) -> tuple[E, E]:
        """Compute the weights before a step without stage cost, from the weights (K, T) after it."""
        A, L = self.A, self.L
        moved = L.T @ self.B.T @ K @ A
        first = A.T @ K @ A + self.arriving(moved + moved.T + L.T @ self.felt(K, T) @ L)
        second = A.T @ (K + (T - K).times(self.channel.sensor_loss)) @ A
        return first.symmetric(), second.symmetric()

    def felt(self, K: E, T: E) -> E:
        """Return the weight B'(K + αφP)B of an input: its effect on the state, and on the estimation error if it is
        lost.
        """
        direct = self.B.T @ K @ self.B
        if self.channel.coupling:
            wrong = self.B.T @ (T - K) @ self.B
            direct = direct + wrong.times(self.channel.actuator_loss).times(self.channel.reach)
        return direct.symmetric()

    def arriving(self, form: E) -> E:
        """Multiply a form by the probability 1 − α that a packet to the actuator arrives."""
        return form - form.times(self.channel.actuator_loss)

    def missed(self, K: E, T: E) -> tuple[E, E]:
        """Compute the residuals of the two Lyapunov equations at the weights (K, T)."""
        first, second = self.linear(K, T)
        spent = self.arriving(self.L.T @ self.R @ self.L)
        return (first + self.Q + spent - K).symmetric(), (second + self.Q - T).symmetric()

    def falls(self, X: E, Z: E) -> tuple[E, E]:
        """Compute by how much weights decrease in a step without cost. A proven decrease bounds the mean square."""
        after = self.linear(X, Z)
        falls = (X - after[0]).symmetric(), (Z - after[1]).symmetric()
        if not all(form.definite() for form in (X, Z, *falls)):
            raise UnprovedError("the mean square of the state could not be proved to be bounded")
        return falls

    def proved(self, K: E, T: E, X: E, Z: E, sizes: Sequence[Array]) -> float:
        """Return ε such that (K, T) ± ε(X, Z) enclose both the optimal weights and the weights of the given gain."""
        falls, missed = self.falls(X, Z), self.missed(K, T)
        price, pushed = self.R + self.felt(K, T), self.felt(X, Z)
        off, turned = price @ self.L + self.B.T @ K @ self.A, pushed @ self.L + self.B.T @ X @ self.A
        cost = np.sqrt(np.maximum(np.diag(price.middle), NO_VARIANCE))
        parts = [relative(form, size) for form, size in zip(missed, sizes, strict=True)]
        least = max(float(np.linalg.eigvalsh(price.middle / cost / cost[:, None]).min(initial=1.0)), _SINGULAR)
        slack = 4 * max(*parts, float(((off.most / cost[:, None]) ** 2 / sizes[0]).sum()) / least)
        off, price = (self.arriving(one - more.times(slack)) for one, more in ((off, turned), (price, pushed)))
        lower = falls[0].times(slack) + missed[0]
        if self.channel.actuator_loss < 1:
            lower = block([[lower, off.T], [off, price.symmetric()]])
        above = ((falls[i].times(slack) - missed[i]).definite() for i in (0, 1))
        if not (lower.definite() and (falls[1].times(slack) + missed[1]).definite() and all(above)):
            raise UnprovedError("no bound on the error of the cost-to-go could be proved")
        return slack


class Critical(NamedTuple):
    """Proven lower and upper bounds on the critical loss probability of a link."""

    survived: float  # some linear gain keeps the mean square bounded at this loss, and at smaller ones
    lost: float  # no linear gain does at this loss, and at larger ones

    def __str__(self) -> str:
        """Return the limit of the losses as text."""
        if self.lost - self.survived <= _WIDE * self.lost:
            return f"below {self.survived:.6g}"
        return f"up to {self.survived:.6g} and below {self.lost:.6g} (more is not proved)"


class Rough(NamedTuple):
    """Some modes of a plant in double precision: A, B, coordinates V x, W with VW = I, and a gain without losses."""

    A: Array
    B: Array
    V: Array
    W: Array
    L: Array


class Lasting:
    """The non-decaying modes of a plant, which determine at which loss probabilities some gain stabilises the plant."""

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

    def rough(self, modes: Sequence[int] | None = None) -> Rough:
        """Return some modes of the plant in double precision; by default, all modes that do not decay."""
        modes = self.modes if modes is None else modes
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
            scale = np.sqrt(np.maximum(sizes, _FLAT))[:, None] * turn.T * unit
            W = V.T @ np.linalg.inv(scale)
            V = scale @ V
            self._known[key] = Rough(V @ self.A @ W, V @ self.B, V, W, best.L @ np.linalg.inv(scale))
        return self._known[key]

    def reached(self, channel: Channel, link: Link, modes: Sequence[int] | None = None) -> Reached | None:
        """Find the largest loss probability at which some gain stabilises the modes; return None if none was found."""
        A, B, _, _, L = self.rough(modes)
        if link == "sensor":
            start = self.reached(replace(channel, sensor_loss=0.0), "actuator", modes)
            if start is None or start.place < channel.actuator_loss:
                return None
            L, end = start.L, min(channel.sensor_loss, (1 - _MARGINS[0] / 2) / self.size**2)
            if channel.acknowledged:
                return start._replace(place=end)
        elif channel.sensor_loss * self.size**2 < 1:
            end = channel.actuator_loss
        else:
            return None
        return _follow(lambda loss, L: _loop(A, B, L, channel.at(link, loss)), L, end)

    def gain(self, channel: Channel) -> Array | None:
        """Find a state-feedback gain that keeps the mean square bounded; return None if none was found."""
        slow = [k for k, one in enumerate(self.roots) if abs(complex(one.root)) > _SLOW and not one.root.imag < 0]
        for modes in (slow, self.modes):  # also those that hardly decay, whose costs would be too large
            for path in (channel, channel.at("actuator", 1.0)):  # or a gain for larger losses
                found = self.reached(path, "actuator", modes)
                if found is not None and found.place >= channel.actuator_loss:
                    return self.of_states(found.L, modes)
        return None

    def of_states(self, L: Array, modes: Sequence[int] | None = None) -> Array:
        """Convert a gain for the coordinates of some modes to a gain for the plant's state."""
        found = np.zeros((self.every, len(self.A)))
        found[self.inputs] = L @ self.rough(modes).V / self.scale
        return found

    def slowest(self, channel: Channel) -> tuple[float, Array]:
        """Compute the least growth factor of the mean square under any gain, and a state-feedback gain that
        attains it.
        """
        if not self.modes:
            return 0.0, self.of_states(np.zeros((self.B.shape[1], 0)))
        A, B, *_ = self.rough()
        first = _FASTER * self.size**2
        last = max(_NILPOTENT, channel.sensor_loss * self.size**2)  # of the error alone
        found = _follow(
            lambda fall, L: _loop(A, B, L, channel, first * (1 - fall)), np.zeros(B.T.shape), 1 - last / first
        )
        assert found is not None, "without inputs, the mean square grows like the modes"
        return first * (1 - found.place), self.of_states(found.L)

    def critical(self, channel: Channel, link: Link) -> Critical:
        """Compute proven bounds on the critical loss probability of one link, for a loss probability of the other."""
        if not self.grows:  # a small gain keeps marginal modes bounded at any loss below 1
            fine = not self.modes or (channel.sensor_loss if link == "actuator" else channel.actuator_loss) < 1
            return Critical(1.0, 1.0) if fine else Critical(0.0, 0.0)
        channel = channel.at(link, 1.0)
        found = self.reached(channel, link)
        if found is None:
            return Critical(0.0, 0.0 if self.exceeded(channel.at(link, 0.0)) else 1.0)
        return Critical(self._survived(channel, link, found), self._lost(channel, link, found))

    def exceeded(self, channel: Channel) -> bool:
        """Return whether it is proved that every linear gain makes the mean square unbounded."""
        if self._doubts(channel):
            return True
        every = channel.at("actuator", 1.0)  # the same path as that of the critical loss, which it must not contradict
        found = self.reached(every, "actuator")
        return found is not None and self._lost(every, "actuator", found) <= channel.actuator_loss

    def _survived(self, channel: Channel, link: Link, found: Reached) -> float:
        """Return the largest loss of a link that is proved to be survived."""
        A, B, *_ = self.rough()
        for margin in _MARGINS:
            there = channel.at(link, found.place * (1 - margin))
            if self._survives(A, B, found.L, there):
                return found.place * (1 - margin)
            near = self.reached(there, link)  # the last gains are not accurate
            if near is not None and self._survives(A, B, near.L, there):
                return found.place * (1 - margin)
        return 0.0

    def _lost(self, channel: Channel, link: Link, found: Reached) -> float:
        """Return the least loss of a link from which on it is proved that no linear gain survives it; 1 if none is."""
        modes, found = self._smallest(channel, link, found.place * (1 + _SAME), found)
        for margin in _MARGINS:
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
            for _ in range(_POWERS):  # towards a pair that a step under the best gain multiplies
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
        """Return enclosures of A and B of some modes, in nearly the same coordinates as in double precision."""
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
                if all((part.radius <= _SHARP * np.abs(part.middle).max()).all() for part in found):
                    return found
        raise UnprovedError("the computation of the modes needs more than 1,024 bits")

    def _moving(self, roots: Sequence[acb]) -> Bits:
        """Return a mask of the inputs without those that leave some modes unaffected, as the zeros of A and B prove."""
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
    """A gain that keeps the mean square bounded at a point of a path of loss probabilities, and its weights."""

    place: float
    L: Array
    K: Array
    T: Array


Path = Callable[[float, Array], MeanSquare]  # the loop at a place of the path, under a gain


def _loop(A: Array, B: Array, L: Array, channel: Channel, level: float = 1.0) -> MeanSquare:
    """Return a loop; with acknowledgements, losses of the sensor link only let the error grow by β|λ|²."""
    return MeanSquare(A, B, L, channel.at("sensor", 0.0) if channel.acknowledged else channel, level)


def _follow(path: Path, L: Array, end: float) -> Reached | None:
    """Return the farthest place at which some gain keeps the mean square bounded, in double precision; None if none."""
    # Near this place, the inverse of the weights of unit costs decreases to zero, and the secant method approaches it.
    # The best gain of one place keeps the mean square bounded at the next one, if this is near enough.
    found, before = _improved(path, L, 0.0), None
    if found is None:
        return None
    step = end / 8
    for _ in range(_TURNS):
        check_time()
        after = _improved(path, found.L, min(found.place + step, end))
        if after is None:
            step /= 4
        else:
            before, found = found, after
            fall = _margin(before) - _margin(found)
            left = _margin(found) * (found.place - before.place) / fall if fall > 0 else np.inf
            step = min(_STEP * left, 8 * step)
        if found.place >= end or step <= _CLOSE * max(found.place, _CLOSE):
            break
    return found


def _margin(found: Reached) -> float:
    return 1 / float(max(np.linalg.eigvalsh(part)[-1] for part in (found.K, found.T)))


def _improved(path: Path, L: Array, place: float) -> Reached | None:
    """Return the best gain for unit costs from a gain that keeps the mean square bounded; None if this does not."""
    found: Reached | None = None
    for _ in range(_POLICIES):
        loop = path(place, L)
        weights = loop.weights()
        if weights is None or (found is not None and np.trace(weights[0]) > (1 - _ENOUGH) * np.trace(found.K)):
            break
        found = Reached(place, L, *weights)
        L = _best(loop.A, loop.B, *weights, loop.channel)
    return found


def _best(A: Array, B: Array, K: Array, T: Array, channel: Channel) -> Array:
    """Return the best gain for the weights after a step, if inputs cost nothing."""
    return -price(B, K + channel.coupling * (T - K), np.zeros((B.shape[1],) * 2))[1] @ B.T @ K @ A
