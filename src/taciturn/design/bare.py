"""The plant, cost and network of a policy that is studied without a problem: those that it was designed for."""

from __future__ import annotations

from taciturn.errors import ProblemError
from taciturn.model.cost import Cost
from taciturn.model.network import Network
from taciturn.model.plant import Plant
from taciturn.model.policy import Policy


def own_problem(policy: Policy) -> tuple[Plant, Cost, Network]:
    """Return the plant, the cost and the network that a policy was designed for.

    Raises:
        ProblemError: if the policy has no cost, or it was designed for a continuous plant, of which it holds only the
            sampled matrices.
    """
    if policy.cost is None:
        raise ProblemError(
            f"{policy.kind} has no cost; expected the cost that it was designed for: theory=Theory(cost=…)"
        )
    if policy.tick != 1.0 or policy.theory.noise_cost or policy.prediction is not None:
        raise ProblemError(
            f"{policy.kind} has steps of {policy.tick:g} s, so its cost refers to a continuous plant, which a policy "
            "does not hold; expected a Problem with this plant and a policy kind"
        )
    return policy.model.alone or policy.model, policy.cost, policy.network
