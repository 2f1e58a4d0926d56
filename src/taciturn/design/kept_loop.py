"""The loop of a given controller at the step of a policy, with disturbance and set-point, and its unproven policies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.design.anti_windup import within_limits
from taciturn.design.base import Base, advantage
from taciturn.design.bounds import bound_by_errors
from taciturn.design.certainty import design_certainty
from taciturn.design.kept import disturbed, note_disturbance, note_ringing, recovery, remedy_of
from taciturn.design.routes import actuator_base
from taciturn.design.same_control import SameControl
from taciturn.design.set_point import Rest, rest_of
from taciturn.errors import ProblemError, TaciturnError
from taciturn.lqg.discrete import Discrete
from taciturn.model.controller import Controller
from taciturn.model.cost import Cost
from taciturn.model.disturbance import Disturbance
from taciturn.model.kept import Kept, relative_to
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy, Step
from taciturn.model.theory import ErrorGain, Theory

MORE_PACKETS = "send more packets, or let a model predict the input between them (actuation)"


@dataclass(frozen=True, eq=False, repr=False)
class KeptLoop(Displayed):
    """A given controller and its plant in deviations from the point at which they rest.

    Args:
        kept: the controller, which may depend on the step, its set-points relative to the plant's operating point.
        controller: the controller at the step.
        problem: the discrete-time problem of the deviations, with the slow disturbance.
        point: the point at which the loop rests.
        disturbance: the slow disturbance, or None.
        lqg: whether the controller is LQG with the weights of the cost, and not one that a user has; its observer then
            starts with the mean of the plant's initial state.
    """

    kept: Kept
    controller: Controller
    problem: Discrete
    point: Rest
    disturbance: Disturbance | None
    lqg: bool = False

    @staticmethod
    def of(plant: Plant | ContinuousPlant, cost: Cost, period: float | None, kept: Kept, lqg: bool = False) -> KeptLoop:
        """Return the loop of a controller, for a plant without the slow disturbance that the controller compensates."""
        if plant.exosystem is not None:
            ideal = "link = 'actuator', actuation 'hold' or 'model', every = 1 and ideal links"
            who, expected = (
                ("LQG with these options", f"the kind excess with {ideal}")
                if lqg
                else ("a given controller", f"its keys setpoint and disturbance, or LQG: the kind excess with {ideal}")
            )
            raise ProblemError(
                f"the plant has disturbances or set-points, which {who} does not use; expected {expected}"
            )
        kept = relative_to(kept, plant)
        problem, controller, disturbance = disturbed(plant, cost, period, kept)
        point = rest_of(problem, controller)
        if lqg and len(controller.A):  # its state predicts that of the plant
            point = replace(point, start=problem.plant.mean)
        return KeptLoop(kept, controller, point.deviations(problem), point, disturbance, lqg)

    def carried_out(self, policy: Policy) -> Policy:
        """Return a policy with the start of the controller and with the limits of the inputs."""
        return within_limits(self.point.begun(policy))

    @cached_property
    def remedy(self) -> str:
        """The remedy if the loop is unstable."""
        return MORE_PACKETS if self.lqg else remedy_of(self.problem, self.controller)

    def every_sample(self) -> Base:
        """Return the loop that sends every sample.

        Raises:
            UnstableError: it is unstable.
        """
        base = actuator_base(self.problem, self.controller)
        advantage(base, self.remedy)
        return base

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the slow disturbance, and on modes of the controller that are too fast for the step."""
        return note_disturbance(self.controller, self.disturbance) + note_ringing(self.kept, self.problem.tick)

    @cached_property
    def cost_lqg(self) -> float | None:
        """The cost of LQG with the same weights and every sample, or None if LQG does not exist for these weights."""
        try:
            return self.problem.per_unit(design_certainty("LQG", self.problem).cost_all_time)
        except TaciturnError:  # LQG needs more of the weights than a given controller
            return None

    def beside_lqg(self, all_time: float) -> list[str]:
        """Return a remark on the cost of LQG, given that of the controller per step, both with every sample."""
        if self.cost_lqg is None or self.lqg:
            return []
        cost, noise = self.problem.per_unit(all_time), self.problem.per_unit(0.0)
        if abs(self.cost_lqg - cost) <= 1e-9 * cost:
            return []
        share = (self.cost_lqg - noise) / (cost - noise)
        return [f"LQG with these weights and every sample costs {share:.3f} times as much as this controller"]

    def policy(
        self,
        kind: str,
        base: Base,
        steps: tuple[Step, ...],
        sites: tuple[frozenset[str], ...],
        initial: dict[str, Array],
        network: Network | None = None,
        errors: Mapping[str, ErrorGain] | None = None,
        functions: frozenset[str] = frozenset(),
    ) -> Policy:
        """Return a policy without a proven bound, or with the certificate that follows from the errors of its links.

        Args:
            kind: name of the policy kind.
            base: the loop that sends every sample.
            steps: the policy steps, for the deviations.
            sites: groups of nodes at the same site.
            initial: initial values of the memories.
            network: the network of the policy; default: ideal links of a sensor, a controller and an actuator.
            errors: gain and largest error of each link, in a loop without limits of the inputs; default: unknown.
            functions: signals that a function computes and that the errors take into account.

        Raises:
            UnstableError: the loop that sends every sample is unstable.
        """
        found, problem = advantage(base, self.remedy), self.problem
        theory = Theory(
            cost=problem.cost,
            cost_all_time=problem.per_unit(found.cost),
            cost_lqg=self.cost_lqg,
            noise_cost=problem.noise_cost,
            settling=found.settling,
            guarantee=bound_by_errors(problem, found.cost, errors) if errors else None,
            errors=errors or {},
            functions=functions,
            recovery=recovery(base, problem.plant, self.disturbance),
            periodic=SameControl(problem, self.kept, base),
        )
        return self.carried_out(
            Policy(
                kind=kind,
                steps=steps,
                model=problem.plant,
                theory=theory,
                sites=sites,
                initial=initial,
                tick=problem.tick,
                notes=(*self.beside_lqg(found.cost), *self.notes),
                disturbance=self.disturbance,
                network=Network() if network is None else network,
            )
        )
