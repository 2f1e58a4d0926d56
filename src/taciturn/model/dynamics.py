"""Nonlinear plants x⁺ = f(x, u, w), their linearisation for the design, and their equilibria.

A function f of a user is plain NumPy. ``Dynamics`` calls it, turns its exceptions into messages, and sends it to other
processes as the text of its file. ``integrate`` makes one of a differential equation, by the Runge–Kutta method.

A plant states A and B in addition to f. ``Dynamics.check`` compares them with the derivatives of f at the operating
point, where f must rest, and expects noise that adds to the next state. A derivative is the limit of central
differences (f(h) − f(−h))/2h for h → 0. Their error is a series in h², so halving h and combining two of them removes
a term after the other (Ridders). The combination with the least doubt is kept: with short steps rounding errors grow.

``equilibrium`` solves f(x, u, 0) = x by Newton's method; its matrix is A − I, whose least-squares solution also serves
plants that integrate.
"""

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

from taciturn._arrays import Array, ArrayLike, array, count, expect_unmasked, frozen, number, quoted
from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.model.names import Names

Map: TypeAlias = Callable[[Any, Any, Any], Any]
"""A function x, u, w → x⁺ in plain NumPy; it is called with arrays of floats or with arrays that record operations."""

LARGEST_STEP, STEPS = 0.05, 24  # first step of a difference quotient; number of times that it is halved
SETTLED = 1e-12  # relative difference between two extrapolations at which the iteration stops
TOLERANCE = 1e-6  # of a given A or B, relative to its largest entry
AT_REST = 1e-9  # largest entry of f(x, u, 0) − x at an equilibrium, relative to x above 1


@dataclass(frozen=True, eq=False, repr=False)
class Dynamics(Displayed):
    """The step function x⁺ = f(x, u, w) of a nonlinear plant, with white noise w ~ N(0, W).

    The function is sent to other processes as the text of its file, or by name if it belongs to an importable module.

    Args:
        function: the function f.
        text: source of the file from which the function was read, or None.
        path: path of that file, for messages.
        name: name of the function in that file.
    """

    function: Map
    text: str | None = None
    path: str = ""
    name: str = ""

    def __call__(self, x: ArrayLike, u: ArrayLike, w: ArrayLike) -> Array:
        """Return the state after one step, (n,).

        Args:
            x: state, (n,).
            u: input, (m,).
            w: noise, (n,).

        Raises:
            ProblemError: if the function fails, or does not return n numbers.
        """
        given = [np.array(value, dtype=np.float64) for value in (x, u, w)]
        found = _called("function", self.function, given)
        expect_unmasked("the value of function", found)
        try:
            result = np.asarray("nothing" if found is None else found, dtype=np.float64)  # None would be NaN
        except (TypeError, ValueError) as error:
            raise ProblemError(
                f"the function returns {quoted(found)}, which is not an array of numbers ({error}); expected the next "
                "state"
            ) from None
        if result.shape != given[0].shape:
            raise ProblemError(
                f"the function returns an array of the shape {result.shape}; expected {given[0].shape}, the shape of "
                "the next state"
            )
        return result

    def check(
        self, A: Array, B: Array, W: Array, at: tuple[Array, Array] | None = None, names: Names | None = None
    ) -> None:
        """Raise an error unless the linearisation of the function at the operating point has the given A and B.

        The noise must enter as in A x + B u + w: wherever W is not zero, the derivative with respect to w must be the
        identity.

        Args:
            A: stated derivative with respect to x, (n, n).
            B: stated derivative with respect to u, (n, m).
            W: covariance of the noise, (n, n).
            at: the operating point (x, u); default 0.
            names: names of the states, for messages.

        Raises:
            ProblemError: if the function fails, the point is not an equilibrium, or a derivative differs from its given
                value.
        """
        n, m = B.shape
        told = partial((names or Names()).told, "states")
        x, u = (np.zeros(n), np.zeros(m)) if at is None else at
        point = "0" if at is None else "the operating point"
        rest = self(x, u, np.zeros(n))
        _expect_finite(rest, "function", f"at {'x = 0, u = 0' if at is None else point}, w = 0", told)
        _expect_rest(x, rest, at is not None, told)
        derivatives = self.derivatives(x, u)
        where = "" if at is None else ", at=(x, u)"
        remedy = f": use A, B = taciturn.linearise(function, {n}, {m}{where})"
        for name, by, found, stated in (("A", "x", derivatives[0], A), ("B", "u", derivatives[1], B)):
            wrong = _first_apart(found, stated)
            if wrong is not None:
                i, j = wrong
                raise ProblemError(
                    f"the matrix {name} has {stated[i, j]:.10g} in row {i + 1}, column {j + 1}, but the derivative of "
                    f"the function with respect to {by} at {point} has {found[i, j]:.10g} there; expected the "
                    f"linearisation of the function{remedy}"
                )
        wrong = _first_apart(derivatives[2] @ W, W)
        if wrong is not None:
            i = wrong[0]
            row = ", ".join(f"{value:.6g}" for value in derivatives[2][i])
            raise ProblemError(
                f"the derivative of the function with respect to w at {point} has the row [{row}] for state "
                f"{i + 1}{told(i)}; expected the identity wherever W is not 0, as in A x + B u + w: define W as the "
                "covariance of the noise that is added to the next state"
            )
        probe = x + 1e-3, u + 1e-3, np.zeros(n)
        if not np.array_equal(self(*probe), self(*probe), equal_nan=True):
            raise ProblemError(
                "the function returns two different results for the same x, u and w; expected a deterministic "
                "function, with noise from w only"
            )

    def derivatives(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return the derivatives of f with respect to x, u and w at a point: (n, n), (n, m) and (n, n)."""
        key = (x.tobytes(), u.tobytes())
        if key not in self._derivatives:
            self._derivatives[key] = _derivatives(self, [x, u, np.zeros(len(x))])
        A, B, G = self._derivatives[key]
        return A, B, G

    @cached_property
    def _derivatives(self) -> dict[tuple[bytes, bytes], list[Array]]:
        return {}

    def __reduce__(self) -> tuple[Callable[..., Dynamics], tuple[Any, ...]]:
        """Return the constructor and arguments that recreate the function in another process."""
        if self.text is not None:
            return dynamics_of, (self.text, self.path, self.name)
        try:
            pickle.dumps(self.function)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise ProblemError(
                f"function is {quoted(self.function)}, which other processes cannot import ({error}); expected a "
                "function that is defined in a module, or in the Python file that a problem file names"
            ) from None
        return Dynamics, (self.function,)


@cache
def dynamics_of(text: str, path: str, name: str) -> Dynamics:
    """Execute the text of a Python file once per process; return the step function ``name`` that it defines."""
    module = ModuleType("plant_function")
    module.__file__ = path
    try:
        exec(compile(text, path, "exec"), module.__dict__)
    except SyntaxError as error:
        raise ProblemError(
            f"the Python file {path!r} has a syntax error in line {error.lineno} ({error.msg}); expected a file that "
            f"defines the function {name}"
        ) from None
    except (Exception, SystemExit) as error:
        raise ProblemError(
            f"the Python file {path!r} fails when it is executed ({_told(error)}); expected a file that defines the "
            f"function {name} and imports no other file of its folder"
        ) from None
    found = getattr(module, name, None)
    if not callable(found):
        names = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        got = f"has no {name!r}" if found is None else f"has {name!r}, which is {quoted(found)}"
        listed = f" (it has {', '.join(names)})" if names else ""
        raise ProblemError(f"the Python file {path!r} {got}; expected a function x, u, w → x⁺ of that name{listed}")
    return Dynamics(found, text, path, name)


def linearise(
    function: Map, states: int, inputs: int, at: tuple[ArrayLike, ArrayLike] | None = None
) -> tuple[Array, Array]:
    """Compute A and B, the derivatives of x⁺ = f(x, u, w) with respect to x and u, at w = 0.

    Difference quotients with decreasing steps are extrapolated to step zero until they agree to about twelve digits.

    Args:
        function: f(x, u, w) of arrays (n,), (m,) and (n,), which returns n numbers.
        states: number of states n.
        inputs: number of inputs m.
        at: the point (x, u) of the linearisation, (n,) and (m,); default 0.

    Returns:
        A, (n, n), and B, (n, m).

    Raises:
        ProblemError: if the function fails, or returns an array of the wrong shape or values that are not finite.

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
    """Make the step function x⁺ = f(x, u, w) from dx/dt = g(x, u), for an input that is constant for ``dt`` seconds.

    The equation is integrated by the classical fourth-order Runge–Kutta method with steps of dt/steps seconds. The
    noise w is added to the final state.

    Args:
        ode: g(x, u) of arrays (n,) and (m,), which returns n numbers.
        dt: seconds per step of the plant, positive.
        steps: number of Runge–Kutta steps within dt, at least 1.

    Returns:
        The step function, for ``Plant(..., function=...)`` and :func:`linearise`.

    Raises:
        ProblemError: if dt or steps is out of range.

    Source: hairer1993

    Example:
        >>> fall = integrate(lambda x, u: [x[1], u[0] - 9.81], dt=0.1)
        >>> fall([0.0, 0.0], [9.81], [0.0, 0.5]).tolist()
        [0.0, 0.5]
    """
    if not callable(ode):
        raise ProblemError(f"ode is {quoted(ode)}; expected a function x, u → dx/dt")
    rule = partial(_follow, ode, number("dt", dt, 0.0), count("steps", steps))
    rule.__dict__["__name__"] = getattr(ode, "__name__", type(ode).__name__)  # the name shown in messages
    return rule


def _follow(ode: Callable[[Any, Any], Any], dt: float, steps: int, x: Any, u: Any, w: Any) -> Any:
    """Return the state after one step of a differential equation, by the classical Runge–Kutta method."""
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
        raise ProblemError(
            f"ode returns an array of the shape {found.shape}; expected {x.shape}, the shape of the state"
        )
    return found


def _as_array(values: Any) -> Any:
    """Return a list as an array; return an array unchanged, since its operations may be recorded."""
    return cast("Any", values) if isinstance(values, np.ndarray) else np.array(values)


def _derivatives(f: Dynamics, point: Sequence[Array], many: int = 3) -> list[Array]:
    """Return the derivatives with respect to the first ``many`` arguments."""
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
    """Return f'(0) by central differences extrapolated to step zero; the extrapolation with the least doubt is used.

    The doubt is the distance from other extrapolations plus the rounding error of the difference quotient. Without this
    rounding error, two extrapolations of short steps that agree by chance would have no doubt.
    """
    best, least = None, np.inf
    before: list[Array] = []
    for _ in range(STEPS):
        high, low = f(step), f(-step)
        row = [(high - low) / (2 * step)]
        rounding = float(np.finfo(float).eps * np.abs([high, low]).max()) / step
        step /= 2
        if not np.isfinite(row[0]).all():
            before = []
            continue
        for j, earlier in enumerate(before):
            row.append(row[j] + (row[j] - earlier) / (4.0 ** (j + 1) - 1))
        if before:
            apart = max(float(np.abs(row[-1] - other).max()) for other in (row[-2], before[-1]))
            doubt = apart + rounding
            if doubt < least:
                best, least = row[-1], doubt
            if apart <= SETTLED * max(float(np.abs(row[-1]).max()), 1e-300):
                break
        before = row
    if best is None:
        raise ProblemError(
            f"the function returns no finite values when {name} changes by {step:.1g}; expected a function that is "
            "differentiable at the given point"
        )
    return best


def _called(name: str, function: Callable[..., Any], given: Sequence[Array]) -> Any:
    """Call a user's function and convert its exceptions into a one-sentence ``ProblemError``."""
    try:
        with np.errstate(all="ignore"), redirect_stdout(sys.stderr):  # values that are not finite are reported later
            return cast("Any", function)(*given)
    except ProblemError:
        raise
    except (Exception, SystemExit) as error:
        at = ", ".join(
            f"{letter} = {quoted([float(f'{v:.6g}') for v in value])}"
            for letter, value in zip("xuw", given, strict=False)
        )
        raise ProblemError(
            f"{name} fails at the point {at} ({_told(error)}); expected a function of x, u and w that returns the next "
            "state"
        ) from None


def _told(error: BaseException) -> str:
    """Return the type and message of an exception in one line."""
    return " ".join(filter(None, (f"{type(error).__name__}:", *str(error).split()))).removesuffix(":")


def _expect_finite(values: Array, name: str, where: str, told: Callable[[int], str]) -> None:
    lost = np.flatnonzero(~np.isfinite(values))
    if lost.size:
        raise ProblemError(
            f"{name} returns {values[lost[0]]} as state {int(lost[0]) + 1}{told(int(lost[0]))} {where}; expected "
            "finite numbers for all states"
        )


def _expect_rest(x: Array, found: Array, located: bool, told: Callable[[int], str]) -> None:
    """Raise an error if a function does not rest at a point."""
    apart = np.abs(found - x)
    if apart.max() <= AT_REST * max(1.0, float(np.abs(x).max())):
        return
    i = int(apart.argmax())
    if not located:
        raise ProblemError(
            f"the function returns {found[i]:.6g} as state {i + 1}{told(i)} at x = 0, u = 0, w = 0; expected 0, "
            "because A and B are the linearisation about this equilibrium: give another equilibrium as "
            "plant.operating_point"
        )
    raise ProblemError(
        f"the function returns {found[i]:.12g} as state {i + 1}{told(i)} at the operating point with w = 0; "
        f"expected {x[i]:.12g}, the same state: use operating_point.x = taciturn.model.dynamics.equilibrium(function, "
        "x, u), with all digits"
    )


def _first_apart(found: Array, stated: Array) -> tuple[int, int] | None:
    """Return the indices at which two matrices differ most, or None if they agree within the tolerance."""
    apart = np.abs(found - stated)
    if apart.max() <= TOLERANCE * max(float(np.abs(stated).max()), float(np.abs(found).max())):
        return None
    i, j = (int(k) for k in np.unravel_index(int(apart.argmax()), apart.shape))
    return i, j


NEWTON, REST = 50, 1e-13  # most steps of Newton's method, and its largest residual relative to the first state


def equilibrium(function: Map, x: ArrayLike, u: ArrayLike) -> Array:
    """Compute the equilibrium x = f(x, u, 0) for a constant input u, by Newton's method.

    Args:
        function: f(x, u, w), as for :func:`linearise`.
        x: a state near the equilibrium, (n,), such as one with rounded digits.
        u: the input, (m,).

    Returns:
        The state, (n,), with f(x, u, 0) = x within rounding errors.

    Raises:
        ProblemError: the function fails, or no equilibrium is found.

    Example:
        >>> import numpy as np
        >>> from taciturn import integrate
        >>> tank = integrate(lambda x, u: [u[0] - 0.5 * np.sqrt(x[0])], dt=1.0)
        >>> equilibrium(tank, [15.0], [2.0]).round(9).tolist()
        [16.0]
    """
    if not callable(function):
        raise ProblemError(f"function is {quoted(function)}; expected a function x, u, w → x⁺")
    found, input = array("x", x, (None,), "(states,)"), array("u", u, (None,), "(inputs,)")
    f, n, size = Dynamics(function), len(found), max(1.0, float(np.abs(found).max()))
    for _ in range(NEWTON):
        off = f(found, input, np.zeros(n)) - found
        if not np.isfinite(off).all():
            break
        if np.abs(off).max() <= REST * size:
            return found
        slope = f.derivatives(found, input)[0] - np.eye(n)
        found = found - np.linalg.lstsq(slope, off, rcond=None)[0]
    raise ProblemError(
        f"no equilibrium of the function was found from x = {np.asarray(x).tolist()} with u = {input.tolist()}; "
        "expected a state near an equilibrium, and the input that keeps the plant there"
    )
