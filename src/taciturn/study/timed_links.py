"""The exact cost of a given controller whose links send at fixed steps, each with its own period and phase.

All nodes do what they do under a policy, but a timetable replaces its decisions: they measure and compute in every
step, and in silence they keep the last value or predict it, as the policy does. With the set s of links that send, a
step of the loop is linear, z⁺ = F_s z + G w, and its stage cost is z'M_s z. The program of the loop gives these
matrices (``analyse.switched``). Over a cycle of L steps, the least common multiple of all periods, the value obeys

    P_k = M_k + F_k' P_{k+1} F_k,   P_L = P_0,   and   J = (1/L) Σ_k tr(G' P_{k+1} G) + c,

with the cost c of the noise between samples. P_0 is the least solution of the equation of the whole cycle, so a mode
that the cost does not see does not count. A timing is unstable if P_0 is infinite.

A continuous controller can also be discretised for q steps. So if all links have the period q, the nodes may also
measure and compute at every q-th step only, and the cheaper of the two counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from math import lcm

import numpy as np

from taciturn._arrays import Array, Bits, symmetrised
from taciturn._display import Displayed
from taciturn._modes import closure, factor, radius
from taciturn._progress import check_time
from taciturn._text import number_of
from taciturn.analyse.switched import BoundedStep, Case
from taciturn.base.given_controller import GivenLoop, SameControl
from taciturn.base.value import GROWTH, least_value
from taciturn.errors import UnstableError
from taciturn.loop import COST, Loop
from taciturn.lqg.periodic import Timing
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Policy
from taciturn.model.steps import Send
from taciturn.problem import Problem
from taciturn.program.ops import Entry, Name
from taciturn.program.quadratic import as_form, read_polynomials


def modes_of(problem: Problem) -> tuple[object, object]:
    """Return how receivers of measurements and of inputs behave without a packet: they hold the last value, or
    predict.
    """
    return tuple(problem.parameters.get(name, "hold") for name in ("prediction", "actuation"))


@dataclass(frozen=True, eq=False, repr=False)
class TimedLinks(Displayed):
    """Loop of a given controller in which a timetable, and not the policy's decisions, determines the sends."""

    loop: Loop  # the loop of the policy, with a plant, a network and a cost for which a step is linear
    slower: SameControl | None  # the cost of the controller at its discretisation for several steps

    @staticmethod
    def of(problem: Problem, policy: Policy) -> TimedLinks:
        """Close the loop of a problem with a given controller, so that timetables can replace the send decisions."""
        slower = None
        if problem.controller is not None:
            period = policy.tick if isinstance(problem.plant, ContinuousPlant) else None
            given = GivenLoop.of(problem.plant, problem.cost, period, problem.controller)
            slower = SameControl(given, given.every_sample())
        return TimedLinks(problem.close(policy).deviations, slower)

    def cost(self, timings: Mapping[str, Timing]) -> float:
        """Compute the exact cost, in the problem's units, for given periods and phases of the links.

        Raises:
            UnstableError: the loop is unstable with these timings.
        """
        found = [one for one in (self._at_its_step(timings), self._discretised(timings)) if one is not None]
        if not found:
            named = ", ".join(f"{link} every {number_of(one.period, 'step')}" for link, one in timings.items())
            raise UnstableError(
                f"the loop of the controller is unstable with periodic packets on the links ({named}); expected "
                "shorter periods"
            )
        return self.loop.problem.per_unit(min(found))

    def _discretised(self, timings: Mapping[str, Timing]) -> float | None:
        """Return the cost per step of the controller at its discretisation for the common period; None without one."""
        periods = {one.period for one in timings.values()}
        return self.slower.discretised(periods.pop()) if self.slower is not None and len(periods) == 1 else None

    def _at_its_step(self, timings: Mapping[str, Timing]) -> float | None:
        """Return the cost per step of the controller that computes in every step; None if the loop is unstable."""
        length = lcm(*(one.period for one in timings.values()))
        sets = [frozenset(link for link, one in timings.items() if one.age(k) == 0) for k in range(length)]
        check_time()
        seen = self._affecting(frozenset(sets))
        place = np.ix_(seen, seen)
        parts = {sent: (F[place], M[place]) for sent, (F, M) in ((sent, self._map(sent)) for sent in {*sets})}
        steps, W = [parts[sent] for sent in reversed(sets)], self._noise[place]
        whole, cycle = np.zeros(W.shape), np.eye(len(W))
        with np.errstate(over="ignore", invalid="ignore"):
            for F, M in steps:
                whole, cycle = M + F.T @ whole @ F, cycle @ F
        if not (np.isfinite(cycle).all() and np.isfinite(whole).all()) or radius(cycle) > 1 + GROWTH:
            return None
        P, slowest = least_value(cycle, symmetrised(whole))
        if slowest >= 1:
            return None
        total = 0.0
        for F, M in steps:
            total += float(np.sum(P * W))
            P = symmetrised(M + F.T @ P @ F)
        return total / length

    @cached_property
    def _links(self) -> Sequence[tuple[str, Sequence[frozenset[str]]]]:
        """Each decision of the policy, with the links that send under each of its options."""
        policy, found = self.loop.policy, list[tuple[str, list[frozenset[str]]]]()
        for name, trigger in policy.decisions.items():
            sends = [step for step in policy.steps if isinstance(step, Send) and step.on == name]
            options = [
                frozenset(step.link for step in sends if label in step.sending(trigger.labels))
                for label in trigger.labels
            ]
            found.append((name, options))
        return found

    @cached_property
    def _known(self) -> dict[frozenset[str], tuple[Array, Array]]:
        return {}

    @cached_property
    def _closed(self) -> dict[frozenset[frozenset[str]], Bits]:
        return {}

    def _affecting(self, sets: frozenset[frozenset[str]]) -> Bits:
        """Return the states that affect the cost, now or later, by the zeros of the matrices alone."""
        if sets not in self._closed:
            maps = [self._map(sent) for sent in sets]
            weighed = np.any([M.any(axis=0) for _, M in maps], axis=0)
            leads = np.any([F.T != 0 for F, _ in maps], axis=0)
            self._closed[sets] = closure(np.asarray(weighed), np.asarray(leads))
        return self._closed[sets]

    @cached_property
    def _noise(self) -> Array:
        """Covariance of the noise of z in a step: the plant's noise, and the noise of the next measurement."""
        plant, size = self.loop.problem.plant, len(self._map(frozenset())[0])
        found, last = np.zeros((size, size)), size - _spread(plant.V).shape[1]
        found[: plant.states, : plant.states] = plant.W
        found[last:, last:] = np.eye(size - last)
        return found

    def _map(self, sent: frozenset[str]) -> tuple[Array, Array]:
        """Return the dynamics and the weight of a step in which some links send, over the states and the noise of y."""
        if sent not in self._known:
            self._known[sent] = self._read(sent)
        return self._known[sent]

    def _read(self, sent: frozenset[str]) -> tuple[Array, Array]:
        loop, taken = self.loop, dict[str, int]()
        for name, options in self._links:
            taken[name] = options.index(sent.intersection(*[frozenset[str]().union(*options)]))
        case = Case(" and ".join(sorted(sent)), taken)
        program = loop.whole_program(supplied=True, begin=partial(BoundedStep, loop.policy.kind, case))
        states, read = len(program.states), _spread(loop.problem.plant.V)
        size = states + read.shape[1]
        unit = np.eye(size + 1)
        inputs: dict[Name, Array] = {Entry("v", i): row @ unit[states:size] for i, row in enumerate(read)}
        inputs |= {Entry("w", i): np.zeros(size + 1) for i in range(loop.problem.plant.states)}
        values = read_polynomials(program, size, inputs)
        F = np.zeros((size, size))
        F[:states] = [values[op][:size] for op in program.following]
        return F, symmetrised(as_form(values[program.sums[COST]])[:size, :size])


def _spread(covariance: Array) -> Array:
    return factor(covariance) if covariance.any() else np.zeros((len(covariance), 0))
