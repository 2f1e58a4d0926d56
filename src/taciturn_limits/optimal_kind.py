"""The policy kind ``optimal``: the optimal send schedule for a price per send, if a send resets the error to 0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from taciturn.design.bounds import LARGEST_PARAMETER
from taciturn.design.kind import Kind, TradeoffParameter
from taciturn.design.prediction import modelled
from taciturn.errors import ProblemError
from taciturn.extend import Progress, number
from taciturn.loop import Loop
from taciturn.model.cost import Cost
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.model.trigger import Form
from taciturn.renewal.without_steps import PolicyWithoutSteps
from taciturn.simulation.sampling import Averages
from taciturn.study.measure import Measured, Request, clipped_accuracy, wanted_error
from taciturn_limits.bounds import solve_optimum


def optimal(plant: Plant | ContinuousPlant, cost: Cost, *, price: float, period: float | None = None) -> OptimalPolicy:
    """Design the send schedule that minimises J + λ·rate, where J is the cost and λ the price of a send.

    The rate is in sends per step or per second.

    The actuator runs a model. A send resets the prediction error e, and silence costs e'Γe beyond sending every sample.
    The optimal schedule sends iff e'Γe + V(e) > g, where V(e) = E min(0, e⁺'Γe⁺ + V(e⁺) − g) is the value of not
    sending and g is the least average cost. It is computed by policy iteration on the renewal equations, for at most
    three states (``optimal``). Nodes cannot run this schedule; ``near_optimal`` has a trigger for nodes.

    Args:
        plant: the plant; if it is continuous in time with measured full state, both ends predict in continuous time.
        cost: the average cost.
        price: price λ > 0 of a send, in cost per step (for a continuous plant, cost per second times seconds).
        period: seconds between checks; only with a continuous plant.

    Returns:
        The optimal stopping problem, which is solved when the policy is evaluated.

    Raises:
        ProblemError: if λ is not positive, the plant has jumps or a function, or period is missing or not applicable.
        UnstableError: if no stabilising gain or filter exists.

    Source: cogill2007

    Example:
        >>> optimal(Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), price=10.0).price
        10.0
    """
    price = number("price", price, 0.0, LARGEST_PARAMETER)
    if getattr(plant, "exosystem", None) is not None:
        raise ProblemError(
            "disturbances or set-points are given, which the policy kind 'optimal' does not support; expected the "
            "kind 'near-optimal', or neither disturbances nor set-points"
        )
    if getattr(plant, "jumps", None) is not None:
        raise ProblemError(
            "the noise consists of jumps; expected Gaussian noise for the policy kind 'optimal', or the kind "
            "'near-optimal'"
        )
    if getattr(plant, "function", None) is not None:
        raise ProblemError(
            "the plant is nonlinear (plant.function); expected a linear plant for the policy kind 'optimal', or the "
            "kind 'near-optimal'"
        )
    policy = modelled(
        "optimal",
        plant,
        cost,
        period,
        lambda problem, reset: Form((reset.error,), reset.weight, -price / problem.tick),
    )
    return OptimalPolicy("optimal", policy, price, "near-optimal")


KIND = Kind(
    name="optimal",
    design=optimal,
    goal="the possible remaining improvement, for analysis: nodes cannot run it",
    tuning=(TradeoffParameter("price"),),
    example={"price": 1.0, "period": 0.1},
    built_in="wiener-double-integrator",
    nodes="none",
    plants=("discrete", "continuous", "outputs"),
    follows=(),
    proved="the least cost of all schedules",
    refused=(
        "a price as for `near-optimal`; jumps; nonlinear plants; errors of more than three dimensions, or with a "
        "direction that the noise between two checks does not excite"
    ),
    data=(
        "an `OptimalPolicy`: a price, and a policy with the same nodes that defines the loop; its free "
        "boundary is not a quadratic form"
    ),
    order="`close` refuses a loop of nodes",
)


@dataclass(frozen=True, eq=False, repr=False)
class OptimalPolicy(PolicyWithoutSteps):
    """Policy with the optimal send schedule for a price per send; each send resets the error to 0.

    Its boundary is computed by quadrature and is not a quadratic form, so that no node can run it.

    Args:
        kind: name in the catalogue.
        looked_at: a policy with the same nodes and another trigger, which supplies the properties of the loop.
        price: λ, the price of a send, in units of the cost times units of time.
        instead: the policy kind that approximates this policy on nodes.

    Raises:
        ProblemError: the plant has data that only a simulation uses: limits of the input, or an initial state.
    """

    kind: str
    looked_at: Policy  # pyright: ignore[reportIncompatibleVariableOverride]  # frozen, so it cannot become None
    price: float
    instead: str
    cost_all_time: float = field(init=False)
    statement: str | None = field(init=False, default=None)
    source: str = field(init=False, default="")
    notes: tuple[str, ...] = field(init=False, default=())

    def __post_init__(self) -> None:
        """Check the plant."""
        object.__setattr__(self, "cost_all_time", self.looked_at.cost_all_time)
        self.refuse_what_is_only_simulated(self.looked_at.model)

    def summary(self) -> Mapping[str, object]:
        """Return the policy's kind, its price per send, its plant, and the cost of sending every sample, by name."""
        plant = self.looked_at.model.short()
        return {"kind": self.kind, "price": self.price, "cost_all_time": self.cost_all_time, "plant": plant}

    @property
    def sends_when(self) -> str:
        """Clause that says when the policy sends a packet."""
        return f"when a packet is expected to save its price of {self.price:.3g}"

    @property
    def why_it_cannot_run(self) -> str:
        """Reason, with a remedy, why nodes cannot run this policy; error messages quote it."""
        return (
            f"{self.kind} decides by a boundary that nodes cannot evaluate, so it can only be analysed; expected "
            f"{self.instead}"
        )

    def measure(self, loop: Loop, request: Request, progress: Progress | None) -> Measured:
        """Compute the cost and the rate of the optimal schedule at the policy's price per send."""
        if request.method not in ("auto", "exact") or request.steps is not None:
            raise ProblemError(
                "method or steps is given, but the policy 'optimal' is computed numerically, not simulated; expected "
                "neither of these options, or the policy 'near-optimal'"
            )
        policy, price = loop.policy, self.price
        asked = wanted_error(Estimate(policy.cost_all_time, 0.0, "exact"), request.standard_error)
        ceiling = price / policy.tick  # the excess cost of an optimal schedule is at most that of sending every sample
        best = solve_optimum(loop, price, clipped_accuracy(asked / ceiling), progress)
        if best.excess_error > asked:
            best = solve_optimum(loop, price, clipped_accuracy(asked / max(best.excess, 1e-300)), progress)
        cost = Estimate(best.excess, 0.0, "quadrature", best.excess_error).scaled(1.0, policy.cost_all_time)
        rate = Estimate(best.rate, 0.0, "quadrature", best.rate_error)
        found = Averages(
            cost, {policy.scheduled[0]: rate}, 0, 0, cost.error <= wanted_error(cost, request.standard_error)
        )
        return Measured(found, "quadrature", "the optimal schedule is solved and never simulated")
