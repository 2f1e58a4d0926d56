"""Program operations on polynomials in time: proof that a polynomial has no root, or search for a root.

A polynomial Σ m_k x^k on [0, 1] is Σ b_j B_j(x) in the Bernstein basis. Its values lie between the least and the
largest b_j. The number of roots in (0, 1) is at most the number of sign changes of the b_j, and has the same parity.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb, factorial

import numpy as np

from taciturn._arrays import Array, symmetrised
from taciturn._modes import balancing
from taciturn.program.ir import Builder

Monomials = Sequence[int | None]  # operations that give m_0, m_1, …; None: zero

NEWTON_STEPS = 5
ROOT_WIDTH = 1e-12  # half-width of the interval in which the sign must change, as a fraction of the piece
_LONGEST = 0.25  # ‖A‖·Δ of the longest piece
_WAITS = 4.0  # longest piece in mean waits for an infinite series: it determines the order, and few waits are longer
_ORDER_ERROR = 1e-14  # size of the first omitted term of the Taylor series


class TaylorMotion:
    """Prediction of an error ė = A e over short pieces of time, by a Taylor series that is exact if A is nilpotent.

    Args:
        A: dynamics per second, (n, n).
        wait: mean time between jumps, seconds.
        most: longest piece, as a multiple of ``wait``.
    """

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
        """Return the matrices T_k with e(s)'Se(s) = Σ_k s^k e'T_k e, where e(s) is the error s seconds after e."""
        found = [S]
        for k in range(self.form_order):
            found.append(symmetrised(self.A.T @ found[-1] + found[-1] @ self.A) / (k + 1))
        while len(found) > 1 and not found[-1].any():
            found.pop()
        return found

    def form(self, b: Builder, S: Array, e: Sequence[int], length: int) -> list[int | None]:
        """Return the coefficients of the polynomial e(x·length)'Se(x·length) in the fraction x of a piece of time."""
        values = [b.quadratic([[float(c) for c in row] for row in T], e) for T in self.forms(S)]
        result, power = values[:1], length
        for value in values[1:]:
            result.append(None if value is None else b.emit("mul", value, power))
            power = b.emit("mul", power, length)
        return result

    def advance(self, b: Builder, e: Sequence[int], time: int) -> list[int]:
        """Return the error after a time t, by Horner's rule e + t/1 A(e + t/2 A(e + …)) for its Taylor series."""
        moved = list(e)
        for k in range(self.order, 0, -1):
            steps = [b.combine([float(a) / k for a in row], moved) for row in self.A]
            moved = [
                v if step is None else b.emit("add", b.emit("mul", step, time), v)
                for v, step in zip(e, steps, strict=True)
            ]
        return moved


def integrate_polynomial(b: Builder, form: Monomials, length: int) -> list[int | None]:
    """Return the coefficients of the integral of a polynomial from 0 to x, times the length of the piece of time."""
    result: list[int | None] = [None]
    for k, value in enumerate(form):
        result.append(None if value is None else b.emit("mul", b.scale(1 / (k + 1), value), length))
    return result


def evaluate_polynomial(b: Builder, monomials: Monomials, x: int) -> int:
    """Return the value at x of a polynomial that is given by its coefficients."""
    return _horner(b, monomials, x)[0]


def bernstein(b: Builder, monomials: Monomials) -> list[int]:
    """Return the Bernstein coefficients b_j = Σ_{k≤j} C(j,k)/C(N,k) m_k of a polynomial Σ m_k x^k on [0, 1]."""
    N = len(monomials) - 1
    there = [(k, m) for k, m in enumerate(monomials) if m is not None]
    rows: list[int] = []
    for j in range(N + 1):
        total = b.combine([comb(j, k) / comb(N, k) for k, _ in there], [m for _, m in there])
        rows.append(b.constant(0.0) if total is None else total)
    return rows


def only_root(b: Builder, monomials: Monomials, first: int, last: int, there: int) -> tuple[int, int, int, int]:
    """Find the only root in [0, 1] of a polynomial that changes from negative to positive, by bracketed Newton steps.

    Args:
        b: collects the operations.
        monomials: coefficients of the polynomial.
        first: its value at 0, which must be negative.
        last: its value at 1, which must not be negative.
        there: truth value, whether these conditions hold; if not, the results have no meaning.

    Returns:
        The root, whether it is accurate to ``ROOT_WIDTH``, and the ends of the remaining bracket. The polynomial is
        negative at the lower end of the bracket, and not negative at the upper end.
    """
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
