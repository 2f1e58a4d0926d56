"""Loops whose sends reset an error: rate, cost and intervals without simulation."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING

from taciturn._arrays import Array, count, instance
from taciturn._progress import Progress
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.policy import Policy
from taciturn.model.trigger import Form, Scheduled
from taciturn.renewal.chain import Chain, NoQuadratureError, Renewal

if TYPE_CHECKING:
    from taciturn.renewal.paths import PathAnswer
    from taciturn.renewal.rates import WindowBound

LONGEST_WINDOW = 100_000  # ticks, whose sends take seconds to bound
ROUGH = 1e-2  # relative standard error of a pilot
ACCURACY_OF_JUMPS = 1e-5  # relative, that is aimed at
LEAST_OF_JUMPS = 1e8  # operations, on a line


def solve_renewal(loop: Loop, accuracy: float | None = None, progress: Progress | None = None) -> Renewal:
    """Return the sends per tick and the cost beyond sending always, by quadrature of the renewal equations.

    With the error e of the prediction after a decision, E = {e: e'Ψe ≤ δ} and k the density of the next error,

        T(e) = 1 + ∫_E k T,  C(e) = e'Γe + ∫_E k C;  rate 1/T_0,  excess C_0/T_0,

    T_0 and C_0 from an error that has just been reset.

    Args:
        loop: closed with the plant and network of the design.
        accuracy: relative, that is aimed at; omitted: 1e-8 under Gaussian noise (1e-6 in three dimensions), 1e-5 under
            jumps.
        progress: called with the fraction done.

    Returns:
        Rate per tick, excess in the units of the cost (the cost is the identity's constant plus it), the errors that
        are claimed, and the distribution of the intervals between sends, in ticks.

    Raises:
        NoQuadratureError: the loop has no such error, or more dimensions than the quadrature serves.

    Source: khashooei2017

    Example:
        >>> from taciturn import ContinuousPlant, Cost, close, design
        >>> plant = ContinuousPlant([[0.0]], [[1.0]], [[1.0]])
        >>> policy = design.consistent(plant, Cost([[1.0]], [[1.0]]), period=0.5)
        >>> found = solve_renewal(close(plant, policy))
        >>> round(found.intervals.mean * found.rate, 8)
        1.0
    """
    return RenewalQuadrature(loop).solve(accuracy, progress)


class RenewalQuadrature:
    """The renewal equations of a loop: what solving them would take, and their solution.

    Args:
        loop: closed with the plant and network of the design.

    Raises:
        NoQuadratureError: the loop has no such error, or more dimensions than the quadrature serves.

    Source: khashooei2017
    """

    def __init__(self, loop: Loop) -> None:
        """Solve nothing yet."""
        chain = chain_of(loop)
        from taciturn.renewal.gaussian import Quadrature  # these take a while to import, and few loops reset an error

        self.loop, self.chain = loop, chain
        self.gaussian = Quadrature(chain) if loop.problem.jumps is None else None

    @property
    def least(self) -> float:
        """Operations that it takes at least."""
        return LEAST_OF_JUMPS if self.gaussian is None else self.gaussian.least

    @property
    def usual(self) -> float:
        """The relative accuracy that is aimed at where none is asked for."""
        return ACCURACY_OF_JUMPS if self.gaussian is None else self.gaussian.usual

    def accuracy(self, error: float) -> float:
        """Return the relative accuracy that an absolute error of the excess asks for: about, as it is not yet known."""
        return ACCURACY_OF_JUMPS if self.gaussian is None else error / max(self.gaussian.rough_excess, 1e-300)

    def predict(self, accuracy: float) -> float:
        """Return about how many operations a relative accuracy takes, without solving anything."""
        return self.least if self.gaussian is None else self.gaussian.predict(accuracy)

    def solve(self, accuracy: float | None = None, progress: Progress | None = None) -> Renewal:
        """Return what ``solve_renewal`` does."""
        if self.gaussian is not None:
            return self.gaussian.solve(accuracy, progress)
        from taciturn.renewal.jumps import solve_jumps

        return solve_jumps(self.chain, self.usual if accuracy is None else accuracy, progress)


class ConditionalSampling:
    """Rate and excess of a loop by paths on which no check sends, weighed with the probability of that.

    Args:
        loop: closed with the plant and network of the design.
        seed: of the draws.
        progress: called with the fraction done.

    Raises:
        NoQuadratureError: more than one error decides, or the noise comes in jumps.

    Source: hajivassiliou1996
    """

    def __init__(self, loop: Loop, seed: int, progress: Progress | None = None) -> None:
        """Look at the intervals, and run nothing."""
        from taciturn.renewal.paths import least_work

        self.chain, self.seed, self.progress = chain_of(loop), seed, progress
        self.least = least_work(self.chain)

    @cached_property
    def pilot(self) -> PathAnswer:
        """What a few paths find."""
        return self._solved(ROUGH)

    def predict(self, standard_error: float, others: float) -> float:
        """Return about how many operations a standard error of the excess takes after a pilot, which is run.

        Where the pilot alone takes more than others do, it is not run, and its own work is returned.

        Args:
            standard_error: absolute, of the excess.
            others: operations that other methods take.

        Raises:
            OutOfTime: the time limit has passed.
        """
        from taciturn.renewal.paths import predict_fewest, predict_paths

        try:
            fewest = predict_fewest(self.chain)
            return fewest if fewest > others else predict_paths(self.chain, self.pilot, self._share(standard_error))
        except NoQuadratureError:  # hardly anything is sent
            return float("inf")

    def run(self, standard_error: float) -> PathAnswer:
        """Return rate per tick and excess, to a standard error of the excess."""
        if self.pilot.excess.standard_error <= standard_error:
            return self.pilot
        return self._solved(self._share(standard_error))

    def _share(self, standard_error: float) -> float:
        value = self.pilot.excess.value
        return min(standard_error / value, ROUGH) if value > 0 else ROUGH

    def _solved(self, standard_error: float) -> PathAnswer:
        from taciturn.renewal.paths import solve_paths

        return solve_paths(self.chain, standard_error=standard_error, seed=self.seed, progress=self.progress)


def bound_rate(loop: Loop) -> tuple[float, float] | None:
    """Return certified bounds of the sends per tick, where one error decides alone; None where none are known.

    Source: royen2014
    """
    instance("loop", loop, Loop)
    if loop.problem.jumps is not None:
        return None
    try:
        chain = chain_of(loop)
        from taciturn.renewal.rates import rate_bounds

        return rate_bounds(chain)
    except NoQuadratureError:
        return None


def bound_sends(loop: Loop, ticks: int, confidence: float = 0.999) -> WindowBound:
    """Return how many sends any window of so many ticks sees at most, in the mean and with a confidence.

    Args:
        loop: in which the error that a send resets decides alone.
        ticks: at most 100,000; of a longer window, the bounds of its parts add up.
        confidence: in (0, 1).

    Raises:
        ProblemError: ticks or confidence out of range.
        NoQuadratureError: more than one error decides, or the noise comes in jumps.

    Source: royen2014

    Example:
        >>> from taciturn import Cost, Plant, close, design
        >>> plant = Plant([[1.0]], [[1.0]], [[1.0]])
        >>> policy = design.excess(plant, Cost([[1.0]], [[1.0]]), delta=9.0, actuation="model")
        >>> found = bound_sends(close(plant, policy), 100)
        >>> found.mean < found.most < 100
        True
    """
    from taciturn.renewal.rates import sends_in_window

    count("ticks", ticks)
    if ticks > LONGEST_WINDOW:
        raise ProblemError(f"ticks is {ticks}; expected at most {LONGEST_WINDOW}: the bounds of shorter windows add up")
    return sends_in_window(chain_of(loop), ticks, confidence)


def expect_affordable(loop: Loop) -> None:
    """Refuse what is solved much more slowly than it is simulated.

    Raises:
        NoQuadratureError: jumps in more than one dimension.
    """
    if loop.problem.jumps is not None and loop.problem.plant.states > 1:
        raise NoQuadratureError(
            "the equations of jumps in more than one dimension take up to minutes, and method 'exact' solves those of "
            "two"
        )


def chain_of(loop: Loop) -> Chain:
    """Return the chain of a loop whose decision and whose cost look at one error alone.

    Raises:
        NoQuadratureError: the loop is none.
    """
    instance("loop", loop, Loop)
    policy, problem = loop.policy, loop.problem
    if loop.departures:
        raise NoQuadratureError(f"{loop.departures[0]}; expected the loop of the design, or 'auto' or 'simulation'")
    weights = _weights(policy)
    if weights is None or loop.horizon is not None:
        raise NoQuadratureError(
            f"{policy.kind} has no closed form here, and no error that alone decides until a send resets it; "
            "expected 'auto' or 'simulation'"
        )
    Psi, delta, Gamma = weights
    if delta <= 0:
        raise NoQuadratureError(f"the threshold is {delta:g}; expected one above 0, or 'simulation'")
    assert policy.reset is not None
    noise = policy.reset.covariance if problem.jumps is None else problem.jumps
    return Chain(problem.plant.A, noise, Psi, delta, Gamma)


def decides_alone(policy: object) -> bool:
    """Tell whether the error that a send resets is all that a policy decides by, once it is beyond a threshold."""
    return isinstance(policy, Policy) and _weights(policy) is not None


def _weights(policy: Policy) -> tuple[Array, float, Array] | None:
    """Return Ψ, δ and Γ, or None where the decision or the identity looks at anything but the error."""
    identity, decisions = policy.identity, policy.decisions
    if policy.reset is None or identity is None or identity.on is None or list(decisions) != [identity.on]:
        return None
    forms = [*decisions[identity.on].options.values(), *identity.forms]
    parts = [_parts(form, policy.reset.signals) for form in forms]
    if len(parts) != 4 or None in parts:
        return None
    (Psi, offset), (sent, delta), (Gamma, kept), (resent, none) = (part for part in parts if part is not None)
    if Psi is None or Gamma is None or sent is not None or resent is not None or kept or none:
        return None
    return Psi, delta - offset, Gamma


def _parts(form: Form, signals: Mapping[str, Array]) -> tuple[Array | None, float] | None:
    """Return the weight of the error and the constant, or None where the form is no quadratic of the error alone."""
    if form.plus or form.bell is not None or len(form.signals) > 1:
        return None
    if isinstance(form.Psi, Scheduled) or isinstance(form.constant, Scheduled):
        return None
    if form.Psi is None:
        return None, form.constant
    seen = [signals[name] for name in form.signals if name in signals]
    return (seen[0].T @ form.Psi @ seen[0], form.constant) if seen else None
