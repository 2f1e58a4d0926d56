"""The loop that sends every sample: its cost and its settling time. Policies are compared with this loop.

Every design computes such a loop first. Its policy keeps the plant, the cost and the control of the loop, but sends
less. ``Nominal.policy`` adds to the claims of the design (guarantee, identity, closed form, reset) what the loop fixes:
J_all and its proved error, the noise between samples, and the time constants.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.base.anti_windup import within_limits
from taciturn.base.filter import COLLOCATED
from taciturn.lqg.discrete import Discrete
from taciturn.model.coverage import THEORY
from taciturn.model.disturbance import Disturbance
from taciturn.model.network import Network
from taciturn.model.policy import Policy
from taciturn.model.schedule import Schedule
from taciturn.model.steps import Location, Step
from taciturn.model.theory import Innovations, Theory


@dataclass(frozen=True, eq=False, repr=False)
class Nominal(Displayed):
    """A loop that sends every sample, or every q-th sample, with which a policy is compared."""

    problem: Discrete  # the discrete-time problem
    cost: float  # its cost without that of the noise between samples: per step, or in total
    settling: float  # time constant in steps, 1/(1 − |slowest eigenvalue|); 0 for a total
    error: float | None = None  # proved bound on the error of the cost in the user's units
    recovery: float | None = None  # time constant in steps without slow disturbances; None if there are none
    innovations: Innovations | None = None  # white innovations of the filter
    disturbance: Disturbance | None = None  # the slow disturbance that a given controller compensates

    def policy(
        self,
        kind: str,
        steps: tuple[Step, ...],
        initial: Mapping[str, Array],
        claims: Theory,
        *,
        sites: tuple[frozenset[str], ...] = COLLOCATED,
        locations: tuple[Location, ...] = (),
        network: Network | None = None,
        schedule: Schedule | None = None,
        notes: tuple[str, ...] = (),
        unsure: bool = False,
    ) -> Policy:
        """Make a policy from its steps and its theory, and add the costs of this loop and the plant's input limits.

        ``unsure``: the link drops packets without acknowledgement.
        """
        problem = self.problem
        theory = replace(
            claims,
            cost=problem.cost,
            cost_all_time=problem.per_unit(self.cost),
            cost_all_time_error=self.error,
            noise_cost=problem.noise_cost,
            settling=self.settling,
            recovery=self.recovery,
            innovations=self.innovations,
            # with a measured state, no estimate depends on the distribution of the noise
            covers=claims.covers | THEORY if problem.plant.full_state else claims.covers,
        )
        return within_limits(
            Policy(
                kind=kind,
                steps=steps,
                model=problem.plant,
                theory=theory,
                sites=sites,
                locations=locations,
                initial=initial,
                network=Network() if network is None else network,
                tick=problem.tick,
                schedule=schedule,
                notes=notes,
                disturbance=self.disturbance,
            ),
            unsure,
        )
