"""Plants that are not linear: x⁺ = f(x, u, w), the linearisation that policies are designed on, and motion in time."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cache, cached_property, partial
from types import ModuleType
from typing import Any, TypeAlias, cast

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, count, frozen, number, quoted
from taciturn.errors import ProblemError

Map: TypeAlias = Callable[[Any, Any, Any], Any]
"""x, u, w → x⁺: plain NumPy code, which is called with arrays of floats, and with arrays whose operations are noted."""

LARGEST_STEP, STEPS = 0.05, 24  # of a difference; how many times it is halved
SETTLED = 1e-12  # relative, between two extrapolations
TOLERANCE = 1e-6  # relative to the largest entry, of a matrix that is given
AT_REST = 1e-9  # of an equilibrium


@dataclass(frozen=True, eq=False)
class Dynamics:
    """A plant's function x⁺ = f(x, u, w), with white w ~ N(0, W) drawn at every tick.

    It goes to other processes as the text of its file, or by its name, where a module that they can import has it.

    Args:
        function: f.
        text: of the file that it was read from, if it was.
        path: of that file, for messages.
        name: of the function in that file.
    """

    function: Map
    text: str | None = None
    path: str = ""
    name: str = ""

    def __call__(self, x: ArrayLike, u: ArrayLike, w: ArrayLike) -> Array:
        """Return the state after a tick, (n,).

        Args:
            x: state, (n,).
            u: input, (m,).
            w: noise, (n,).

        Raises:
            ProblemError: the function fails, or gives something else than n numbers.
        """
        given = [np.array(value, dtype=np.float64) for value in (x, u, w)]
        found = _called("function", self.function, given)
        try:
            result = np.asarray("nothing" if found is None else found, dtype=np.float64)  # None would be NaN
        except (TypeError, ValueError) as error:
            raise ProblemError(
                f"function gives {quoted(found)}, which are no numbers ({error}); expected the next state"
            ) from None
        if result.shape != given[0].shape:
            raise ProblemError(
                f"function gives an array of the shape {result.shape}; expected {given[0].shape}, the next state"
            )
        return result

    def check(self, A: Array, B: Array, W: Array) -> None:
        """Refuse a function whose linearisation at 0 is another than the one that is given.

        The noise must act as it does in A x + B u + w: where W is not zero, the derivative by w is the identity.

        Raises:
            ProblemError: the function fails, 0 is no equilibrium, or a derivative is another.
        """
        n, m = B.shape
        rest = self(np.zeros(n), np.zeros(m), np.zeros(n))
        _expect_finite(rest, "function", "at x = 0, u = 0, w = 0")
        if np.abs(rest).max() > AT_REST:
            i = int(np.abs(rest).argmax())
            raise ProblemError(
                f"function gives {rest[i]:.6g} as state {i + 1} at x = 0, u = 0, w = 0; expected 0, the equilibrium "
                "about which A and B are its linearisation: count states and inputs from there"
            )
        derivatives = self.derivatives(n, m)
        remedy = f"; A, B = taciturn.linearise(function, {n}, {m}) gives them"
        for name, by, found, stated in (("A", "x", derivatives[0], A), ("B", "u", derivatives[1], B)):
            wrong = _first_apart(found, stated)
            if wrong is not None:
                i, j = wrong
                raise ProblemError(
                    f"{name} has {stated[i, j]:.10g} in row {i + 1}, column {j + 1}, and the derivative of function by "
                    f"{by} at 0 has {found[i, j]:.10g} there; expected the linearisation of the function{remedy}"
                )
        wrong = _first_apart(derivatives[2] @ W, W)
        if wrong is not None:
            i = wrong[0]
            row = ", ".join(f"{value:.6g}" for value in derivatives[2][i])
            raise ProblemError(
                f"the derivative of function by w at 0 has the row [{row}] for state {i + 1}; expected the identity "
                "wherever W is not 0, as in A x + B u + w: let W be the covariance of what is added to the next state"
            )
        probe = np.full(n, 1e-3), np.full(m, 1e-3), np.zeros(n)
        if not np.array_equal(self(*probe), self(*probe), equal_nan=True):
            raise ProblemError(
                "function gives two results for the same x, u and w; expected one that draws nothing: noise comes as w"
            )

    def derivatives(self, states: int, inputs: int) -> tuple[Array, Array, Array]:
        """Return the derivatives by x, u and w at 0, found once: (n, n), (n, m), (n, n)."""
        sizes = (states, inputs, states)
        if sizes not in self._derivatives:
            self._derivatives[sizes] = _derivatives(self, [np.zeros(size) for size in sizes])
        A, B, G = self._derivatives[sizes]
        return A, B, G

    @cached_property
    def _derivatives(self) -> dict[tuple[int, ...], list[Array]]:
        return {}

    def __reduce__(self) -> tuple[Callable[..., Dynamics], tuple[Any, ...]]:
        """Return what makes it anew in another process.

        Raises:
            ProblemError: a function that has no name there.
        """
        if self.text is not None:
            return dynamics_of, (self.text, self.path, self.name)
        try:
            pickle.dumps(self.function)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise ProblemError(
                f"function is {quoted(self.function)}, which no other process can be told ({error}); expected a "
                "function of a module, or of the file that a problem file names"
            ) from None
        return Dynamics, (self.function,)


@cache
def dynamics_of(text: str, path: str, name: str) -> Dynamics:
    """Return the function of a name in the text of a Python file, which is run, alone, once in a process.

    Args:
        text: of the file.
        path: of the file, for messages.
        name: of the function.

    Raises:
        ProblemError: the text is no Python, fails when it is run, or has no such function.
    """
    module = ModuleType("plant_function")
    module.__file__ = path
    try:
        exec(compile(text, path, "exec"), module.__dict__)
    except SyntaxError as error:
        raise ProblemError(
            f"{path!r} has a mistake in line {error.lineno} ({error.msg}); expected a Python file with the function "
            f"{name}"
        ) from None
    except (Exception, SystemExit) as error:
        raise ProblemError(
            f"{path!r} fails when it is read ({_told(error)}); expected a Python file with the function {name}, which "
            "needs no other of its folder"
        ) from None
    found = getattr(module, name, None)
    if not callable(found):
        names = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        got = f"has no {name!r}" if found is None else f"has {name!r}, which is {quoted(found)}"
        listed = f" (it has {', '.join(names)})" if names else ""
        raise ProblemError(f"{path!r} {got}; expected a function x, u, w → x⁺ of that name{listed}")
    return Dynamics(found, text, path, name)


def linearise(
    function: Map, states: int, inputs: int, at: tuple[ArrayLike, ArrayLike] | None = None
) -> tuple[Array, Array]:
    """Return the derivatives A and B of x⁺ = f(x, u, w) by x and u, where w = 0.

    Differences over ever shorter steps are extrapolated to none, until they agree to about twelve digits.

    Args:
        function: f(x, u, w), of arrays (n,), (m,), (n,), with n numbers as its value.
        states: n.
        inputs: m.
        at: x and u, (n,) and (m,); omitted: 0.

    Returns:
        A, (n, n), and B, (n, m).

    Raises:
        ProblemError: the function fails, gives other shapes, or numbers that are not finite.

    Source: ridders1982

    Example:
        >>> import numpy as np
        >>> A, B = linearise(lambda x, u, w: np.sin(x) + 2.0 * u + w, states=1, inputs=1)
        >>> round(A.item(), 10), round(B.item(), 10)
        (1.0, 2.0)
    """
    n, m = count("states", states), count("inputs", inputs)
    if not callable(function):
        raise ProblemError(f"function is {quoted(function)}; expected a function x, u, w → x⁺")
    x, u = (np.zeros(n), np.zeros(m)) if at is None else at
    point = [array("at[0]", x, (n,), "(states,)"), array("at[1]", u, (m,), "(inputs,)"), np.zeros(n)]
    A, B = _derivatives(Dynamics(function), point, 2)
    return A, B


def integrate(ode: Callable[[Any, Any], Any], dt: float, steps: int = 1) -> Map:
    """Return x⁺ = f(x, u, w) of a differential equation dx/dt = g(x, u), its input held for dt seconds.

    The classical Runge–Kutta rule of fourth order, with steps of dt/steps seconds; w is added to the state that they
    end in.

    Args:
        ode: g(x, u), of arrays (n,) and (m,), with n numbers as its value.
        dt: seconds of a tick, positive.
        steps: of the rule within a tick, at least 1.

    Returns:
        The function, for ``Plant(..., function=...)`` and :func:`linearise`.

    Raises:
        ProblemError: dt or steps out of range.

    Source: hairer1993

    Example:
        >>> fall = integrate(lambda x, u: [x[1], u[0] - 9.81], dt=0.1)
        >>> fall([0.0, 0.0], [9.81], [0.0, 0.5]).tolist()
        [0.0, 0.5]
    """
    if not callable(ode):
        raise ProblemError(f"ode is {quoted(ode)}; expected a function x, u → dx/dt")
    rule = partial(_follow, ode, number("dt", dt, 0.0), count("steps", steps))
    rule.__dict__["__name__"] = getattr(ode, "__name__", type(ode).__name__)  # by which it is told
    return rule


def _follow(ode: Callable[[Any, Any], Any], dt: float, steps: int, x: Any, u: Any, w: Any) -> Any:
    """Return the state after a tick of a differential equation, by the classical rule of Runge and Kutta."""
    h, x = dt / steps, _as_array(x)
    for _ in range(steps):
        first = _slope(ode, x, u)
        second = _slope(ode, x + h / 2 * first, u)
        third = _slope(ode, x + h / 2 * second, u)
        fourth = _slope(ode, x + h * third, u)
        x = x + h / 6 * (first + 2.0 * (second + third) + fourth)
    return x + _as_array(w)


def _slope(ode: Callable[[Any, Any], Any], x: Any, u: Any) -> Any:
    found = _as_array(ode(x, u))
    if found.shape != x.shape:
        raise ProblemError(f"ode gives an array of the shape {found.shape}; expected {x.shape}, as the state")
    return found


def _as_array(values: Any) -> Any:
    """Return a list as an array, and an array as it is, whose operations may be noted."""
    return cast("Any", values) if isinstance(values, np.ndarray) else np.array(values)


def _derivatives(f: Dynamics, point: Sequence[Array], many: int = 3) -> list[Array]:
    """Return the derivatives by the first so many arguments."""
    found: list[Array] = []
    for k, value in enumerate(point[:many]):
        columns: list[Array] = []
        for j in range(len(value)):

            def along(h: float, k: int = k, j: int = j) -> Array:
                moved = [one.copy() for one in point]
                moved[k][j] += h
                return f(*moved)

            size = max(1.0, abs(float(value[j])))
            columns.append(_derivative(along, LARGEST_STEP * size, f"{'xuw'[k]}{j + 1}"))
        found.append(frozen(np.array(columns).T))
    return found


def _derivative(f: Callable[[float], Array], step: float, name: str) -> Array:
    """Return f'(0): central differences, extrapolated to no step; the value on which two extrapolations agree best."""
    best, least = None, np.inf
    before: list[Array] = []
    for _ in range(STEPS):
        row = [(f(step) - f(-step)) / (2 * step)]
        step /= 2
        if not np.isfinite(row[0]).all():
            before = []
            continue
        for j, earlier in enumerate(before):
            row.append(row[j] + (row[j] - earlier) / (4.0 ** (j + 1) - 1))
        if before:
            apart = max(float(np.abs(row[-1] - other).max()) for other in (row[-2], before[-1]))
            if apart < least:
                best, least = row[-1], apart
            if apart <= SETTLED * max(float(np.abs(row[-1]).max()), 1e-300):
                break
        before = row
    if best is None:
        raise ProblemError(
            f"function gives no finite numbers where {name} is near its value, within {step:.1g}; expected one that "
            "has derivatives there"
        )
    return best


def _called(name: str, function: Callable[..., Any], given: Sequence[Array]) -> Any:
    """Call a function of the user's, and tell in one sentence if it fails."""
    try:
        with np.errstate(all="ignore"), redirect_stdout(sys.stderr):  # what is not finite is told where it matters
            return cast("Any", function)(*given)
    except ProblemError:
        raise
    except (Exception, SystemExit) as error:
        at = ", ".join(
            f"{letter} = {quoted([float(f'{v:.6g}') for v in value])}"
            for letter, value in zip("xuw", given, strict=False)
        )
        raise ProblemError(
            f"{name} fails at {at} ({_told(error)}); expected a function of x, u and w that gives the next state"
        ) from None


def _told(error: BaseException) -> str:
    """Return what an exception says, in one line."""
    return " ".join(filter(None, (f"{type(error).__name__}:", *str(error).split()))).removesuffix(":")


def _expect_finite(values: Array, name: str, where: str) -> None:
    lost = np.flatnonzero(~np.isfinite(values))
    if lost.size:
        raise ProblemError(
            f"{name} gives {values[lost[0]]} as state {int(lost[0]) + 1} {where}; expected finite numbers"
        )


def _first_apart(found: Array, stated: Array) -> tuple[int, int] | None:
    """Return where two matrices differ most, if they do by more than their digits explain."""
    apart = np.abs(found - stated)
    if apart.max() <= TOLERANCE * max(float(np.abs(stated).max()), float(np.abs(found).max())):
        return None
    i, j = (int(k) for k in np.unravel_index(int(apart.argmax()), apart.shape))
    return i, j
