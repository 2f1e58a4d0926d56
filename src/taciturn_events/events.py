"""Simulation of an error with Poisson jumps, from one send to the next, with exact times of jumps and sends.

Between jumps ė = A e, so that the trigger function is a power series of time, which ends if A is nilpotent. On a short
piece of time it is a polynomial, to rounding (``TaylorMotion``). In the Bernstein basis, Σ m_k x^k = Σ b_j B_j(x) for
0 ≤ x ≤ 1. Its values lie between the least and the largest b_j. The number of its roots in (0, 1) is at most the number
of sign changes of the b_j, and has the same parity.

One step of the program is one attempt at one piece, on each path:

1. All coefficients are negative: no send on the piece. The path advances over it, and jumps where it ended at a jump.
2. The coefficients change sign once: one crossing. Newton's method finds it, and the cycle ends there. If the sign does
   not change within 1e-12 around the result, the path advances to the lower end of the bracket instead.
3. Otherwise the next step tries the left half of the piece, so that the first crossing is found.

If a piece of the shortest length is still undecided, its sign is a matter of rounding, and the trigger fires. So a
trigger function that touches its threshold from below fires if its value is not negative, to rounding.

Only jumps consume random numbers. Therefore the k-th jump of a path has the same time and size under every trigger,
which makes comparisons of triggers precise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import comb, factorial, inf

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import Array, Displayed, array, balancing, instance, number, semidefinite, square, symmetrised
from taciturn.model.plant import Jumps
from taciturn.program.draws import GENERATOR, NORMAL, UNIFORM, draw_numbers, minus_two_log, seed_generators
from taciturn.program.ir import Builder, Program
from taciturn.program.ops import Entry, Name, State
from taciturn.program.signals import jump_size

Monomials = Sequence[int | None]  # operations that give m_0, m_1, …; None: zero

NEWTON_STEPS = 5
ROOT_WIDTH = 1e-12  # half-width of the interval in which the sign must change, as a fraction of the piece
_LONGEST = 0.25  # ‖A‖·Δ of the longest piece
_WAITS = 4.0  # longest piece in mean waits for an infinite series: it determines the order, and few waits are longer
_ORDER_ERROR = 1e-14  # size of the first omitted term of the Taylor series


class TaylorMotion:
    """Prediction of an error with ė = A e over short times by a Taylor series, which is exact if A is nilpotent."""

    def __init__(self, A: Array, wait: float, most: float) -> None:
        """Choose the longest piece and the orders of the series."""
        n = len(A)
        self.A, self.longest = A, most * wait
        chains = [m for m in range(1, n + 1) if not np.linalg.matrix_power(np.abs(A), m).any()]
        if chains:  # nilpotent by its zero pattern: the series end
            self.order, self.form_order = chains[0] - 1, 2 * (chains[0] - 1)
            return
        scale = balancing(A)
        norm = float(np.linalg.norm(A / scale[:, None] * scale, 2))
        self.longest = min(_WAITS * wait, _LONGEST / norm)
        self.order, self.form_order = _order(norm * self.longest), _order(2 * norm * self.longest)

    def forms(self, S: Array) -> list[Array]:
        """Return matrices T_k with e(s)'Se(s) = Σ_k s^k e'T_k e, where e(s) is the error s seconds after e."""
        found = [S]
        for k in range(self.form_order):
            found.append(symmetrised(self.A.T @ found[-1] + found[-1] @ self.A) / (k + 1))
        while len(found) > 1 and not found[-1].any():
            found.pop()
        return found

    def form(self, b: Builder, S: Array, e: Sequence[int], length: int) -> list[int | None]:
        """Return the coefficients of the cost rate e'Se as a polynomial in the fraction x of a time interval."""
        values = [b.quadratic([[float(c) for c in row] for row in T], e) for T in self.forms(S)]
        result, power = values[:1], length
        for value in values[1:]:
            result.append(None if value is None else b.emit("mul", value, power))
            power = b.emit("mul", power, length)
        return result

    def advance(self, b: Builder, e: Sequence[int], time: int) -> list[int]:
        """Return the error after a time t, by Horner's rule for its Taylor series: e + t/1 A(e + t/2 A(e + …))."""
        moved = list(e)
        for k in range(self.order, 0, -1):
            steps = [b.combine([float(a) / k for a in row], moved) for row in self.A]
            moved = [
                v if step is None else b.emit("add", b.emit("mul", step, time), v)
                for v, step in zip(e, steps, strict=True)
            ]
        return moved


def integrate_polynomial(b: Builder, form: Monomials, length: int) -> list[int | None]:
    """Integrate a polynomial in the fraction x of a time interval from 0 to x, in seconds."""
    result: list[int | None] = [None]
    for k, value in enumerate(form):
        result.append(None if value is None else b.emit("mul", b.scale(1 / (k + 1), value), length))
    return result


def evaluate_polynomial(b: Builder, monomials: Monomials, x: int) -> int:
    """Evaluate a polynomial, given by its coefficients, at x."""
    return _horner(b, monomials, x)[0]


def bernstein(b: Builder, monomials: Monomials) -> list[int]:
    """Convert a polynomial Σ m_k x^k on [0, 1] to its Bernstein coefficients b_j = Σ_{k≤j} C(j,k)/C(N,k) m_k."""
    N = len(monomials) - 1
    there = [(k, m) for k, m in enumerate(monomials) if m is not None]
    rows: list[int] = []
    for j in range(N + 1):
        total = b.combine([comb(j, k) / comb(N, k) for k, _ in there], [m for _, m in there])
        rows.append(b.constant(0.0) if total is None else total)
    return rows


def only_root(b: Builder, monomials: Monomials, first: int, last: int, there: int) -> tuple[int, int, int, int]:
    """Find the only root in [0, 1] of a polynomial that rises from negative to positive, by bracketed Newton steps."""
    zero, one = b.constant(0.0), b.constant(1.0)
    low, high = zero, one
    # start where the straight line from the first to the last value is 0
    x = b.emit("div", b.emit("sub", zero, first), b.emit("select", there, b.emit("sub", last, first), one))
    for _ in range(NEWTON_STEPS):
        value, slope = _horner(b, monomials, x)
        low, high = _narrowed(b, low, high, x, value)
        rising = b.emit("greater", slope, zero)
        step = b.emit("div", value, b.emit("select", rising, slope, one))
        newton = b.emit("sub", x, step)
        inside = b.emit("and", b.emit("less_equal", low, newton), b.emit("less_equal", newton, high))
        middle = b.emit("mul", b.constant(0.5), b.emit("add", low, high))
        x = b.emit("select", b.emit("and", rising, inside), newton, middle)
    width = b.constant(ROOT_WIDTH)
    below, above = b.emit("sub", x, width), b.emit("add", x, width)
    values = [evaluate_polynomial(b, monomials, point) for point in (below, above)]
    found = b.emit("and", b.emit("greater", zero, values[0]), b.emit("less_equal", zero, values[1]))
    for point, value in zip((below, above), values, strict=True):
        low, high = _narrowed(b, low, high, point, value)
    return x, found, low, high


def _narrowed(b: Builder, low: int, high: int, x: int, value: int) -> tuple[int, int]:
    """Return the bracket, with one end moved to x by the sign of the value there, if x lies inside."""
    zero = b.constant(0.0)
    inside = b.emit("and", b.emit("greater", x, low), b.emit("greater", high, x))
    under = b.emit("greater", zero, value)
    lower = b.emit("and", inside, under)
    upper = b.emit("and", inside, b.emit("not", under))
    return b.emit("select", lower, x, low), b.emit("select", upper, x, high)


def _horner(b: Builder, monomials: Monomials, x: int) -> tuple[int, int]:
    """Return value and slope at x."""
    total: int | None = None
    slope: int | None = None
    for monomial in reversed(monomials):
        slope = b.add(None if slope is None else b.emit("mul", slope, x), total)
        total = b.add(None if total is None else b.emit("mul", total, x), monomial)
    zero = b.constant(0.0)
    return zero if total is None else total, zero if slope is None else slope


def _order(size: float) -> int:
    """Return the order after which the terms size^k/k! are below rounding."""
    order = 1
    while size ** (order + 1) / factorial(order + 1) > _ORDER_ERROR:
        order += 1
    return order


ENDED, CYCLES, DURATION, COST = "ended", "cycles", "duration", "cost"
UNDISTURBED = "undisturbed"  # counted cycles that ended before h_max without a jump since the last send
ERROR, INTEGRAL, TIME, WAIT, PIECE = "error", "integral", "time", "wait", "piece"  # states
JUMPED = "jumped"  # state: whether a jump has occurred since the last send
OPEN, CLOSING = "open", "closing"  # states: whether cycles count, and whether the next end is the last that counts
SHORTEST = 1e-13  # shortest piece, relative to the time since the last send plus the mean time between jumps
LONGEST_WAIT = 64.0  # bound on a drawn time between jumps, in mean times: a uniform number has 53 bits


@dataclass(frozen=True, eq=False, repr=False)
class JumpProcess(Displayed):
    """Error with ė = A e between Poisson jumps; it costs e'Se per second, and a send resets it to 0.

    Args:
        A: dynamics per second, (n, n).
        jumps: rate, covariance and distribution of the jumps.
        S: weight of the cost, (n, n), semidefinite.

    Raises:
        ProblemError: wrong shapes, or S indefinite.
    """

    A: Array
    jumps: Jumps
    S: Array

    def __post_init__(self) -> None:
        """Check and freeze."""
        object.__setattr__(self, "A", square("A", self.A, "(states, states)"))
        n = len(self.A)
        object.__setattr__(self, "S", semidefinite("S", self.S, n, "(states, states)"))
        instance("jumps", self.jumps, Jumps)
        array("jumps.covariance", self.jumps.covariance, (n, n), "(states, states)")


@dataclass(frozen=True, repr=False)
class IntegralTrigger(Displayed):
    """Trigger that sends when the cost since the last send, β seconds ago, reaches the threshold c·min(β, ε).

    The threshold stays constant after the saturation time ε.

    Args:
        c: cost per second, positive.
        saturation: ε > 0, the time after which the threshold stays constant.
        h_min: shortest interval, h_min ≥ 0; the trigger is evaluated from then on, at h_min too.
        h_max: longest interval, h_max > h_min.

    Raises:
        ProblemError: a value outside these ranges.

    Source: khashooei2017
    """

    c: float
    saturation: float = inf
    h_min: float = 0.0
    h_max: float = inf

    def __post_init__(self) -> None:
        """Check."""
        number("c", self.c, 0.0)
        number("h_min", self.h_min, 0.0, closed=True)
        _time("saturation", self.saturation, 0.0)
        _time("h_max", self.h_max, self.h_min)


@dataclass(frozen=True, eq=False, repr=False)
class LevelTrigger(Displayed):
    """Trigger that sends when the weighted square e'Ψe of the error e reaches the level Y².

    Args:
        Psi: Ψ, (n, n), semidefinite.
        level: Y², positive.
        h_max: longest interval, positive.

    Raises:
        ProblemError: a value outside these ranges.
    """

    Psi: Array
    level: float
    h_max: float = inf

    def __post_init__(self) -> None:
        """Check and freeze."""
        n = array("Psi", self.Psi, (None, None), "(states, states)").shape[0]
        object.__setattr__(self, "Psi", semidefinite("Psi", self.Psi, n))
        number("level", self.level, 0.0)
        _time("h_max", self.h_max, 0.0)


CycleTrigger = IntegralTrigger | LevelTrigger


def cycle_program(process: JumpProcess, trigger: CycleTrigger) -> Program:
    """Return the program that simulates an error over a short time interval, or to its next send if that is earlier."""
    if isinstance(trigger, LevelTrigger):
        array("Psi", trigger.Psi, process.A.shape, "(states, states)")
    return _Attempt(process, trigger).program()


def start_cycles(process: JumpProcess, program: Program, paths: int, seed: int) -> Array:
    """Return the initial states of simulated paths that each start immediately after a send.

    For a given seed, path i does not depend on the number of paths.
    """
    words = seed_generators(seed + (1 << 64), paths)[0].view(np.uint64) >> np.uint64(11)
    values = {
        GENERATOR: seed_generators(seed, paths),
        WAIT: -np.log((words + 0.5) * 2.0**-53)[None] / process.jumps.rate,
        PIECE: np.full((1, paths), _motion(process).longest),
        OPEN: np.ones((1, paths)),
    }
    return filled_states(program, paths, values)


def filled_states(program: Program, paths: int, values: Mapping[str, Array]) -> Array:
    """Return the initial states of a program, shape (states, paths): given values by name, and 0 for the others."""
    states = np.zeros((len(program.states), paths))
    for row, state in zip(states, program.states, strict=True):
        if state.name in values:
            row[:] = values[state.name][state.index]
    return states


def count_cycle(
    b: Builder, ended: int, duration: int, cost: int, opened: int, closing: int
) -> tuple[int, dict[Name, int], dict[Name, int]]:
    """Build the operations at a send: the sums over intervals, the outputs, and whether the next interval counts."""
    zero, half = b.constant(0.0), b.constant(0.5)
    last = b.emit("and", ended, b.emit("greater", closing, half))
    counted = b.emit("and", ended, b.emit("greater", opened, half))
    found: dict[Name, int] = {CYCLES: b.constant(1.0), DURATION: duration, COST: cost}
    sums = {name: b.emit("select", counted, value, zero) for name, value in found.items()}
    outputs = {name: b.emit("select", ended, value, zero) for name, value in found.items()}
    outputs[ENDED] = outputs.pop(CYCLES)
    return b.emit("select", last, zero, opened), sums, outputs


def _time(name: str, value: object, low: float) -> None:
    """Reject a time that is not above ``low``; infinity is accepted."""
    if value != value:
        raise ProblemError(f"{name} is {value}; expected a number above {low:g}, or inf")
    if value != inf:
        number(name, value, low)


def _motion(process: JumpProcess) -> TaylorMotion:
    return TaylorMotion(process.A, 1 / process.jumps.rate, LONGEST_WAIT)


@dataclass(frozen=True)
class _Verdict:
    """The result of an attempt, as operations: truth values, the fraction of the piece to advance, the next length."""

    safe: int
    crossed: int
    share: int
    next_piece: int


class _Attempt:
    """Builds the program of an attempt; every method appends operations."""

    def __init__(self, process: JumpProcess, trigger: CycleTrigger) -> None:
        self.process, self.trigger, self.motion = process, trigger, _motion(process)
        self.b = Builder()
        self.zero, self.one = self.b.constant(0.0), self.b.constant(1.0)
        self.error = [self._state(ERROR, i) for i in range(len(process.A))]
        names = (INTEGRAL, TIME, WAIT, PIECE, JUMPED)
        self.gone, self.time, self.wait, self.piece, self.jumped = [self._state(name) for name in names]
        self.longest = self.b.constant(self.motion.longest)
        self.spread, normal = process.jumps.spread, process.jumps.distribution == "normal"
        self.drawn = [Entry(NORMAL, i) if normal else Entry(UNIFORM, i + 1) for i in range(self.spread.shape[1])]

    def program(self) -> Program:
        """Return the whole attempt."""
        b = self.b
        length, limited = self._length()
        cost = integrate_polynomial(b, self.motion.form(b, self.process.S, self.error, length), length)
        verdict = self._verdict(self._polynomial(cost, length), length)
        limited = b.emit("and", verdict.safe, limited)
        ended = self._either(verdict.crossed, limited)
        advance = b.emit("mul", verdict.share, length)
        time, rest = b.emit("add", self.time, advance), b.emit("sub", self.wait, advance)
        gone = b.emit("add", self.gone, evaluate_polynomial(b, cost, verdict.share))
        # after a send the error stays 0 until the next jump, so the path skips to it, unless h_max comes first
        idles = b.emit("and", ended, b.emit("greater", b.constant(self.trigger.h_max), rest))
        jumped = b.emit("and", verdict.safe, b.emit("less_equal", self.wait, length))
        fresh = self._either(idles, b.emit("and", jumped, b.emit("not", ended)))
        whole = self._either(ended, jumped)
        following = self._moved(advance, ended, fresh, rest)
        following[INTEGRAL, 0] = b.emit("select", ended, self.zero, gone)
        following[TIME, 0] = b.emit("select", ended, b.emit("select", idles, rest, self.zero), time)
        following[PIECE, 0] = b.emit("select", whole, self.longest, verdict.next_piece)
        before = b.emit("greater", self.jumped, b.constant(0.5))
        kept = b.emit("and", before, b.emit("not", ended))
        following[JUMPED, 0] = b.emit("select", self._either(kept, fresh), self.one, self.zero)
        undisturbed = b.emit("and", ended, b.emit("not", self._either(before, limited)))
        duration = b.emit("select", limited, b.constant(min(self.trigger.h_max, 1e300)), time)
        return self._finish(following, ended, undisturbed, duration, gone)

    def _moved(self, advance: int, ended: int, fresh: int, rest: int) -> dict[tuple[str, int], int]:
        """Return the next error (with a jump if ``fresh``), the time to the next jump, and the generator's words."""
        b, following = self.b, dict[tuple[str, int], int]()
        supplied, words = self._draws()
        moved = self.motion.advance(b, self.error, advance)
        for i, (value, jump) in enumerate(zip(moved, self._jump(supplied), strict=True)):
            value = b.emit("select", ended, self.zero, value)
            if jump is not None:
                value = b.emit("select", fresh, b.emit("add", value, jump), value)
            following[ERROR, i] = value
        following[WAIT, 0] = b.emit("select", fresh, self._waited(supplied[Entry(UNIFORM, 0)]), rest)
        for i, word in enumerate(words):
            old = b.emit("number", self._state(GENERATOR, i, word=True))
            following[GENERATOR, i] = b.emit("bits", b.emit("select", fresh, b.emit("number", word), old))
        return following

    def _finish(
        self, following: dict[tuple[str, int], int], ended: int, undisturbed: int, duration: int, cost: int
    ) -> Program:
        opened, closing = self._state(OPEN), self._state(CLOSING)
        following[OPEN, 0], sums, outputs = count_cycle(self.b, ended, duration, cost, opened, closing)
        sums[UNDISTURBED] = self.b.emit("select", undisturbed, sums[CYCLES], self.zero)
        following[CLOSING, 0] = closing
        return self.b.finish([following[state.name, state.index] for state in self.b.states], sums, outputs)

    def _length(self) -> tuple[int, int]:
        """Return the length of the piece, which ends no later than the next event, and whether that event is h_max."""
        b, length = self.b, self._least(self.piece, self.wait)
        limit = b.emit("sub", b.constant(self.trigger.h_max), self.time)
        if isinstance(self.trigger, IntegralTrigger):
            for corner in (self.trigger.h_min, self.trigger.saturation):
                if 0 < corner < inf:
                    left = b.emit("sub", b.constant(corner), self.time)
                    left = b.emit("select", b.emit("greater", left, self.zero), left, self.longest)
                    length = self._least(length, left)
        length = self._least(length, limit)
        return length, b.emit("less_equal", limit, length)

    def _polynomial(self, cost: Sequence[int | None], length: int) -> list[int | None]:
        """Return the trigger function on the piece, as monomials; it is negative until the trigger fires."""
        b, trigger = self.b, self.trigger
        if isinstance(trigger, LevelTrigger):
            first, *others = self.motion.form(b, trigger.Psi, self.error, length)
            level = b.constant(trigger.level)
            return [b.emit("sub", self.zero if first is None else first, level), *others]
        c = b.constant(trigger.c)
        due = b.emit("mul", c, self._least(self.time, b.constant(trigger.saturation)))
        slope = b.emit("mul", c, length)
        if trigger.saturation < inf:
            flat = b.emit("less_equal", b.constant(trigger.saturation), self.time)
            slope = b.emit("select", flat, self.zero, slope)
        first = b.emit("sub", self.gone, due)
        second = b.emit("sub", self.zero if cost[1] is None else cost[1], slope)
        return [first, second, *cost[2:]]

    def _verdict(self, polynomial: Sequence[int | None], length: int) -> _Verdict:
        b = self.b
        rows = bernstein(b, polynomial)
        safe, single, now = self._signs(rows)
        root, found, low, high = only_root(b, polynomial, rows[0], rows[-1], single)
        rooted, bracketed = b.emit("and", single, found), b.emit("and", single, b.emit("not", found))
        scale = b.emit("add", self.time, b.constant(1 / self.process.jumps.rate))
        shortest = b.emit("less_equal", length, b.emit("mul", b.constant(SHORTEST), scale))
        lost = b.emit("and", shortest, b.emit("not", self._either(safe, rooted)))
        share = b.emit("select", rooted, root, b.emit("select", bracketed, low, self.zero))
        share = b.emit("select", self._either(now, lost), self.zero, b.emit("select", safe, self.one, share))
        half = b.emit("mul", b.constant(0.5), length)
        left = b.emit("mul", b.emit("sub", high, low), length)
        shorter = b.emit("select", bracketed, self._least(left, half), half)
        longer = self._least(b.emit("add", self.piece, self.piece), self.longest)
        crossed = self._either(self._either(rooted, now), lost)
        return _Verdict(safe, crossed, share, b.emit("select", safe, longer, shorter))

    def _signs(self, rows: Sequence[int]) -> tuple[int, int, int]:
        """Return whether the piece has no crossing, whether it has exactly one, and whether it starts with one."""
        b, trigger = self.b, self.trigger
        negative = [b.emit("greater", self.zero, row) for row in rows]
        if isinstance(trigger, IntegralTrigger):  # just after a send, cost and threshold are both 0
            negative[0] = self._either(negative[0], b.emit("less_equal", self.time, self.zero))
        falls = [b.emit("and", b.emit("not", x), y) for x, y in pairwise(negative)]
        once = self._all([negative[0], b.emit("not", negative[-1]), *(b.emit("not", fall) for fall in falls)])
        safe, now = self._all(negative), b.emit("not", negative[0])
        if isinstance(trigger, IntegralTrigger) and trigger.h_min > 0:  # the trigger is not evaluated before h_min
            early = b.emit("greater", b.constant(trigger.h_min), self.time)
            due = b.emit("not", early)
            return self._either(safe, early), b.emit("and", once, due), b.emit("and", now, due)
        return safe, once, now

    def _draws(self) -> tuple[dict[Name, int], list[int]]:
        """Return the random numbers of a jump and of the time after it, by name, and the generator's next words."""
        supplied: dict[Name, int] = {}
        return supplied, draw_numbers(self.b, [Entry(UNIFORM, 0), *self.drawn], supplied)

    def _jump(self, supplied: dict[Name, int]) -> list[int | None]:
        """Return G·ξ."""
        sizes = [jump_size(self.b, self.process.jumps.distribution, supplied[name]) for name in self.drawn]
        return [self.b.combine([float(g) for g in row], sizes) for row in self.spread]

    def _waited(self, uniform: int) -> int:
        """Return −log(u)/λ."""
        return self.b.emit("mul", self.b.constant(0.5 / self.process.jumps.rate), minus_two_log(self.b, uniform))

    def _state(self, name: str, index: int = 0, *, word: bool = False) -> int:
        """Return a state with a start key of its own, so that its initial value is free and it is never merged."""
        return self.b.state(State(name, index, start=(name, index), word=word))

    def _least(self, x: int, y: int) -> int:
        return self.b.emit("select", self.b.emit("greater", x, y), y, x)

    def _either(self, x: int, y: int) -> int:
        return self.b.emit("not", self.b.emit("and", self.b.emit("not", x), self.b.emit("not", y)))

    def _all(self, truths: Sequence[int]) -> int:
        total = truths[0]
        for truth in truths[1:]:
            total = self.b.emit("and", total, truth)
        return total


def check(process: object, trigger: object) -> None:
    """Raise an error if ``process`` is not a jump process or ``trigger`` is not a trigger."""
    instance("process", process, JumpProcess)
    if not isinstance(trigger, IntegralTrigger | LevelTrigger):
        raise ProblemError(f"trigger is a {type(trigger).__name__}; expected an IntegralTrigger or a LevelTrigger")
