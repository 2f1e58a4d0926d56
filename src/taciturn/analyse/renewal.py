"""Loops whose sends reset an error: rate, cost and intervals without simulation."""

from __future__ import annotations

from taciturn._arrays import Array, instance
from taciturn.loop import Loop
from taciturn.model.policy import Policy
from taciturn.model.trigger import Form, Scheduled
from taciturn.renewal.chain import Chain, NoQuadratureError, Renewal

ACCURACY_OF_JUMPS = 1e-5  # relative, that is aimed at


def solve_renewal(loop: Loop, accuracy: float | None = None) -> Renewal:
    """Return the sends per tick and the cost beyond sending always, by quadrature of the renewal equations.

    With the error e of the prediction after a decision, E = {e: e'Ψe ≤ δ} and k the density of the next error,

        T(e) = 1 + ∫_E k T,  C(e) = e'Γe + ∫_E k C;  rate 1/T_0,  excess C_0/T_0,

    T_0 and C_0 from an error that has just been reset.

    Args:
        loop: closed with the plant and network of the design.
        accuracy: relative, that is aimed at; omitted: 1e-8 under Gaussian noise (1e-6 in three dimensions), 1e-5 under
            jumps.

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
    chain = chain_of(loop)
    from taciturn.renewal.gaussian import solve_gaussian  # these take a while to import, and few loops reset an error
    from taciturn.renewal.jumps import solve_jumps

    if loop.problem.jumps is None:
        return solve_gaussian(chain, accuracy)
    return solve_jumps(chain, ACCURACY_OF_JUMPS if accuracy is None else accuracy)


def expect_affordable(loop: Loop) -> None:
    """Refuse what is solved much more slowly than it is simulated.

    Raises:
        NoQuadratureError: jumps in more than one dimension.
    """
    if loop.problem.jumps is not None and loop.problem.plant.states > 1:
        raise NoQuadratureError(
            "the equations of jumps in more than one dimension take up to minutes; method 'exact' solves those in two"
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
    noise = problem.plant.W if problem.jumps is None else problem.jumps
    return Chain(problem.plant.A, noise, Psi, delta, Gamma)


def _weights(policy: Policy) -> tuple[Array, float, Array] | None:
    """Return Ψ, δ and Γ, or None where the decision or the identity looks at anything but the error."""
    identity, decisions = policy.identity, policy.decisions
    if policy.reset is None or identity is None or identity.on is None or list(decisions) != [identity.on]:
        return None
    forms = [*decisions[identity.on].options.values(), *identity.forms]
    parts = [_parts(form, policy.reset) for form in forms]
    if len(parts) != 4 or None in parts:
        return None
    (Psi, offset), (sent, delta), (Gamma, kept), (resent, none) = (part for part in parts if part is not None)
    if Psi is None or Gamma is None or sent is not None or resent is not None or kept or none:
        return None
    return Psi, delta - offset, Gamma


def _parts(form: Form, signal: str) -> tuple[Array | None, float] | None:
    """Return the weight of the signal and the constant, or None where the form looks at anything else."""
    if form.plus or form.signals not in ((), (signal,)):
        return None
    if isinstance(form.Psi, Scheduled) or isinstance(form.constant, Scheduled):
        return None
    return form.Psi, form.constant
