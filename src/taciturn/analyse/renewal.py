"""Send rate, cost and send intervals of loops in which each send resets an error, computed without simulation.

Some policies decide by an error e alone that a send resets: it moves as e⁺ = A e + w while nothing is sent, and a
packet is sent as soon as e'Ψe > δ. Steps between two sends are then independent of all others (a renewal process), and
the cost exceeds that of sending every sample by the mean of e'Γe. With the set of silence E = {e: e'Ψe ≤ δ} and the
density k of the next error, the expected steps T and the expected excess C until the next send satisfy

    T(e) = 1 + ∫_E k T,  C(e) = e'Γe + ∫_E k C;  rate 1/T_0,  excess C_0/T_0,

where T_0 and C_0 are the values directly after a reset. This module recognises such loops (``chain_of``), and chooses
the method: quadrature under Gaussian noise or under jumps (``RenewalQuadrature``), simulated paths that are conditioned
on no send, and weighted with its probability (``ConditionalSampling``), and certified bounds (``bound_rate``,
``bound_sends``). ``taciturn.renewal`` solves the equations.

Source: khashooei2017, royen2014
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING

from taciturn._arrays import Array, count, instance
from taciturn._plugins import load_plugin
from taciturn._progress import Progress
from taciturn.errors import ProblemError
from taciturn.loop import Loop
from taciturn.model.coverage import INTERVALS, JUMPS, LINEAR_LOOP, STEPS, Coverage, uncovered
from taciturn.model.policy import Policy
from taciturn.model.theory import Reset
from taciturn.model.trigger import Form, Scheduled
from taciturn.renewal.chain import Chain, NoQuadratureError, Renewal

if TYPE_CHECKING:
    from taciturn.renewal.paths import PathAnswer
    from taciturn.renewal.rates import WindowBound

RENEWED = Coverage(LINEAR_LOOP | JUMPS, "renewal equations do not support", "method 'auto' or 'simulation'")
LONGEST_WINDOW = 100_000  # steps; computing the bound takes seconds
ROUGH = 1e-2  # relative standard error of the pilot run
ACCURACY_OF_JUMPS = 1e-5  # default relative accuracy for jumps
LEAST_OF_JUMPS = 1e8  # operations for jumps in one dimension


def solve_renewal(loop: Loop, accuracy: float | None = None, progress: Progress | None = None) -> Renewal:
    """Compute sends per step, and cost in excess of sending every sample, by quadrature of the renewal equations.

    Let e be the error of the prediction after a decision, E = {e: e'Ψe ≤ δ}, and k the density of the next error. Then

        T(e) = 1 + ∫_E k T,  C(e) = e'Γe + ∫_E k C;  rate 1/T_0,  excess C_0/T_0,

    where T_0 and C_0 are the values directly after a reset.

    Args:
        loop: loop with the plant and network of the design.
        accuracy: target relative accuracy; default: 1e-8 under Gaussian noise (1e-6 in three dimensions), 1e-5 under
            jumps.
        progress: callback that receives the fraction done.

    Returns:
        Rate per step, excess in units of the cost (the cost is the constant of the cost identity plus the excess),
        error bounds of both, and the distribution of the intervals between sends, in steps.

    Raises:
        NoQuadratureError: the loop has no such error, or its dimension is too high for the quadrature.

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
    """Solver for a loop's send rate and excess cost, by quadrature. It also predicts its own computing effort."""

    def __init__(self, loop: Loop) -> None:
        """Set up the equations without solving them."""
        chain = chain_of(loop)
        from taciturn.renewal.gaussian import Quadrature  # imported here: the import is slow, and few loops need it

        self.loop, self.chain = loop, chain
        self.gaussian = Quadrature(chain) if loop.problem.jumps is None else None

    @property
    def least(self) -> float:
        """Least number of arithmetic operations with which the renewal equations can be solved."""
        return LEAST_OF_JUMPS if self.gaussian is None else self.gaussian.least

    @property
    def usual(self) -> float:
        """Default relative accuracy of the computed send rate and excess cost."""
        return ACCURACY_OF_JUMPS if self.gaussian is None else self.gaussian.usual

    def accuracy(self, error: float) -> float:
        """Convert an absolute error of the excess cost to a relative accuracy, with a rough estimate of this cost."""
        return ACCURACY_OF_JUMPS if self.gaussian is None else error / max(self.gaussian.rough_excess, 1e-300)

    def predict(self, accuracy: float) -> float:
        """Predict how many arithmetic operations a relative accuracy needs, without solving the equations."""
        return self.least if self.gaussian is None else self.gaussian.predict(accuracy)

    def solve(self, accuracy: float | None = None, progress: Progress | None = None) -> Renewal:
        """Solve the renewal equations of the loop, as the function ``solve_renewal`` does."""
        if self.gaussian is not None:
            return self.gaussian.solve(accuracy, progress)
        solve_jumps = load_plugin("taciturn.quadratures", "jumps", "a quadrature under jumps")

        return solve_jumps(self.chain, self.usual if accuracy is None else accuracy, progress)


class ConditionalSampling:
    """Estimates a loop's send rate and excess cost from simulated paths, each conditioned on the event that nothing is
    sent.
    """

    def __init__(self, loop: Loop, seed: int, progress: Progress | None = None) -> None:
        """Set up the chain without a simulation."""
        from taciturn.renewal.paths import fewest_operations

        self.chain, self.seed, self.progress = chain_of(loop), seed, progress
        self.least = fewest_operations(self.chain)

    @cached_property
    def pilot(self) -> PathAnswer:
        """Estimates of send rate and excess cost from a short run with few paths."""
        return self._solved(ROUGH)

    def predict(self, standard_error: float, others: float) -> float:
        """Predict from a short run how many operations a given standard error of the excess cost needs."""
        # if the pilot alone would take more operations than other methods, it is not run, and its number is returned
        from taciturn.renewal.paths import predict_fewest, predict_paths

        try:
            fewest = predict_fewest(self.chain)
            return fewest if fewest > others else predict_paths(self.chain, self.pilot, self._share(standard_error))
        except NoQuadratureError:  # sends are extremely rare
            return float("inf")

    def run(self, standard_error: float) -> PathAnswer:
        """Estimate sends per step and excess cost, until the excess cost has the given standard error."""
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
    """Compute certified lower and upper bounds on the sends per step of a loop; return None if there are none.

    Bounds are available if the send decision depends on a single error.

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


def bound_sends(loop: Loop, steps: int, confidence: float = 0.999) -> WindowBound:
    """Bound the number of sends in any window of ``steps`` steps from above: in the mean, and at a confidence level.

    Args:
        loop: loop whose decision depends only on the error that a send resets.
        steps: length of the window in steps, at most 100,000; for a longer window, add the bounds of its parts.
        confidence: confidence of the bound on the number, in (0, 1).

    Raises:
        ProblemError: steps or confidence are out of range.
        NoQuadratureError: the decision depends on more than one error, or the noise consists of jumps.

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

    count("steps", steps)
    if steps > LONGEST_WINDOW:
        raise ProblemError(
            f"steps is {steps}; expected at most {LONGEST_WINDOW} steps: for a longer window, add the bounds of "
            "shorter windows"
        )
    return sends_in_window(chain_of(loop), steps, confidence)


def expect_affordable(loop: Loop) -> None:
    """Raise an error if the renewal equations of a loop would take much longer to solve than a simulation."""
    if loop.problem.jumps is not None and loop.problem.plant.states > 1:
        raise NoQuadratureError(
            "the equations for jumps in more than one dimension can take minutes to solve, so they are not solved by "
            "default; method 'exact' solves them in two dimensions"
        )


def chain_of(loop: Loop) -> Chain:
    """Find the error process of a loop whose send decisions and cost depend only on one error."""
    instance("loop", loop, Loop)
    policy, problem = loop.policy, loop.problem
    if loop.violated_assumptions:
        raise NoQuadratureError(
            f"the loop is not that of the design: {loop.violated_assumptions[0]}; expected the plant, network and cost "
            "of the design, or method 'auto' or 'simulation'"
        )
    weights = _weights(policy)
    if weights is None or loop.horizon is not None:
        raise NoQuadratureError(
            f"the cost of {policy.kind} has no closed form in this problem, and its trigger depends on more than an "
            "error that a send resets; expected method 'auto' or 'simulation'"
        )
    Psi, delta, Gamma = weights
    if delta <= 0:
        raise NoQuadratureError(f"the threshold is {delta:g}; expected a threshold above 0, or method 'simulation'")
    for name in uncovered(RENEWED.names, loop.parts):
        raise NoQuadratureError(RENEWED.sentence(name))
    assert policy.theory.reset is not None
    noise = policy.theory.reset.covariance if problem.jumps is None else problem.jumps
    return Chain(problem.plant.A, noise, Psi, delta, Gamma)


def decides_alone(policy: object) -> bool:
    """Check whether a policy sends exactly when one error exceeds a threshold, and each send resets this error."""
    return isinstance(policy, Policy) and _weights(policy) is not None


def _weights(policy: Policy) -> tuple[Array, float, Array] | None:
    """Return Ψ, δ and Γ, or None if the decision or the cost identity depends on another signal than the error."""
    identity, decisions = policy.theory.identity, policy.decisions
    if policy.theory.reset is None or identity is None or identity.on is None or list(decisions) != [identity.on]:
        return None
    forms = [*decisions[identity.on].options.values(), *identity.forms]
    parts = [_parts(form, policy.theory.reset.signals) for form in forms]
    if len(parts) != 4 or None in parts:
        return None
    (Psi, offset), (sent, delta), (Gamma, kept), (resent, none) = (part for part in parts if part is not None)
    if Psi is None or Gamma is None or sent is not None or resent is not None or kept or none:
        return None
    return Psi, delta - offset, Gamma


def _parts(form: Form, signals: Mapping[str, Array]) -> tuple[Array | None, float] | None:
    """Return the weight of the error and the constant, or None if the form is not quadratic in the error alone."""
    if form.plus or form.bell is not None or len(form.signals) > 1:
        return None
    if isinstance(form.Psi, Scheduled) or isinstance(form.constant, Scheduled):
        return None
    if form.Psi is None:
        return None, form.constant
    seen = [signals[name] for name in form.signals if name in signals]
    return (seen[0].T @ form.Psi @ seen[0], form.constant) if seen else None


def resets(loop: Loop) -> Reset:
    """Find the error of a loop that each send resets to zero, and that between sends only Gaussian noise changes."""
    instance("loop", loop, Loop)
    if loop.violated_assumptions:
        raise ProblemError(
            f"the loop is not that of the design: {loop.violated_assumptions[0]}; expected the plant, network and cost "
            "of the design, which a lower bound requires"
        )
    if loop.problem.plant.changes is not None:
        raise ProblemError(
            "the set-points change (reference.steps or reference.file); expected constant set-points for optimal "
            "schedules and lower bounds"
        )
    if loop.policy.theory.reset is None or loop.horizon is not None:
        kind, links = loop.policy.kind, loop.policy.scheduled
        several = f"{kind} decides on several links ({', '.join(links)})"
        raise ProblemError(
            "a lower bound requires that a send resets the error that determines the cost, but "
            f"{several if len(links) > 1 else f'a send of {kind} does not reset it'}; expected the policy kind "
            "'excess' with LQG control, one link and actuation = 'model', or the kind 'consistent' or 'near-optimal'"
        )
    if loop.problem.jumps is not None:
        raise ProblemError(
            "the noise consists of jumps; expected Gaussian noise for optimal schedules and lower bounds"
        )
    BOUNDED.check(loop.parts)
    return loop.policy.theory.reset


BOUNDED = Coverage(LINEAR_LOOP | STEPS | INTERVALS, "lower bounds and optimal schedules do not support")
