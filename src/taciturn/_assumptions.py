"""Assumptions of a policy's theory that a loop violates: the differences between the loop and the design."""

from __future__ import annotations

from collections.abc import Sequence

from taciturn.errors import ProblemError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.kalman import resting_states
from taciturn.model.coverage import BURSTS, DRIFT, FUNCTION, JUMPS, LIMIT, ROUNDING
from taciturn.model.information import unheard_acknowledgements
from taciturn.model.network import Network
from taciturn.model.policy import Policy


def check_plants(problem: Discrete, policy: Policy) -> None:
    """Reject properties of the design's plant that only affect a simulation but differ in the simulated plant.

    Raises:
        ProblemError: such a property is an input limit, a function, or the initial covariance for an average cost.
    """
    plant, model = problem.plant, policy.model
    begun = policy.cost is not None and policy.cost.mission
    ignored = {
        "input_limit": model.input_limit is not None and not plant.agrees("input_limit", model),
        "input_rate": model.input_rate is not None and not plant.agrees("input_rate", model),
        "function": model.function is not None and plant.function is None,
        "initial.covariance": model.covariance.any() and not begun and not plant.agrees("covariance", model),
    }
    for name in (name for name, unused in ignored.items() if unused):
        raise ProblemError(
            f"plant.{name} is given, but the simulated plant, plant.actual, has a different {name} or none; expected "
            f"plant.actual.{name} with the same value, or no plant.{name}, which the design does not use"
        )


def list_violations(problem: Discrete, policy: Policy, network: Network, missing: Sequence[str]) -> tuple[str, ...]:
    """Return the properties ``missing`` in the theory's coverage, and the differences from the design, as text."""
    plant, model, cost = problem.plant, policy.model, problem.cost
    started = not (plant.agrees("mean", model) and plant.agrees("covariance", model))
    exact, designed = network.delivery, policy.network.delivery
    alike = (designed,) if policy.theory.covers >= BURSTS else (designed, designed.without_bursts())

    def lacks(names: frozenset[str]) -> bool:
        return not names.isdisjoint(missing)

    found = {
        "the plant is not linear (A and B are its linearisation)": lacks(FUNCTION),
        "the plant is not the one of the design": not plant.same_as(model) and not lacks(DRIFT),
        "the plant does not rest at the operating point of the design": lacks(DRIFT),
        # set-points count from the operating point, so another one starts them elsewhere
        "the initial state is not the one of the design": started
        and (cost.mission or (resting_states(plant).any() and not lacks(DRIFT))),
        "inputs are clipped (input_limit)": "plant.input_limit" in missing,
        "the changes of the inputs are limited (input_rate)": "plant.input_rate" in missing,
        "the noise has jumps, but the filter's theory assumes Gaussian noise": lacks(JUMPS),
        "losses come in bursts, but the design uses only their mean": lacks(BURSTS),
        "the network is not the one of the design": not lacks(BURSTS) and exact not in alike,
        "no node uses the acknowledgements of protocol 'tcp'": unheard_acknowledgements(policy, network),
        f"packets contain rounded numbers ({network.payload})": lacks(ROUNDING),
        "the cost is not the one of the design": policy.cost is None or not cost.same_as(policy.cost),
    }
    others = [name for name in missing if name not in FUNCTION | LIMIT | JUMPS | BURSTS | ROUNDING | DRIFT]
    return (*(text for text, departs in found.items() if departs), *map("the theory does not cover {}".format, others))
