"""Probabilities of packets on their way, which their sender computes as functions of policy steps.

* ``LateBelief``: delays and losses come in bursts, and nobody knows the state of the link. The probabilities b of the
  modes follow from the arrivals that are acknowledged, b⁺_J ∝ Σ_I b_I Σ_o q_o over the outcomes o of a step that lead
  from mode I to J and that the arrivals do not exclude.
* ``Histories``: acknowledgements come one step late. At a decision, the controller knows the mode I and the inputs û at
  the beginning of the step before, but not its outcome o. Each outcome predicts another state,

      x̂⁻_o = A x̂ + Σ_i B_i u_i^o,   x̂_o = x̂⁻_o + G (y − C x̂⁻_o),   w_o ∝ q_o exp(−½ (y − C x̂⁻_o)'S⁻¹(y − C x̂⁻_o)),

  and silence costs Σ_o w_o (ẑ_o'Ψ_{I_o} ẑ_o + ψ_{I_o}). Without the likelihood of the measurement, this mean is biased.

Source: nilsson1998, costa2005
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.base.late import LateValue

FAR = 1e300  # a squared error above all


@dataclass(frozen=True, eq=False, repr=False)
class LateBelief(Displayed):
    """Updates the controller's probabilities of the modes by the arrivals of a step, and predicts the next modes.

    After arrivals that the law excludes, such as a lost acknowledgement, it begins again at ``start``.
    """

    ways: tuple[tuple[int, tuple[bool, ...], tuple[int, ...], int, float], ...]
    """Mode, for each receiver whether a packet is sent, the piece in which each packet arrives or −1, by receiver and
    age, next mode and probability."""
    ages: tuple[int, ...]  # number of the ages of packets to each receiver
    start: Array

    @staticmethod
    def of(found: LateValue, cuts: tuple[float, ...], start: Array, ages: Mapping[int, int]) -> LateBelief:
        """Return the update for the outcomes of a chain; ``ages`` counts those of some receivers, by their place."""
        chain, ways = found.chain, dict[tuple[int, tuple[bool, ...], tuple[int, ...], int], float]()
        for sent, steps in chain.outcomes.items():
            for mode, outcomes in enumerate(steps):
                for outcome in outcomes:
                    pieces = list[int]()
                    for place, count in ages.items():
                        own = [-1] * count
                        for fraction, age in outcome.path[place]:
                            own[age] = int(np.abs(np.array(cuts) - fraction).argmin())
                        pieces += own
                    key = mode, tuple(sent[place] for place in ages), tuple(pieces), outcome.after
                    # decisions that differ only at other receivers have the same outcomes
                    if all(goes for place, goes in enumerate(sent) if place not in ages):
                        ways[key] = ways.get(key, 0.0) + outcome.chance
        return LateBelief(tuple((*key, chance) for key, chance in ways.items()), tuple(ages.values()), start)

    def __call__(self, belief: Any, *told: Any) -> Any:
        """Return the distribution at the next step, by whether packets were sent and the pieces of their arrivals."""
        tried, arrivals = told[: len(self.ages)], iter(told[len(self.ages) :])
        acted: list[Any] = []  # an arrival that finds a newer packet changes nothing
        for count in self.ages:
            own = [next(arrivals)[0] for _ in range(count)]
            for age, found in enumerate(own):
                here = found
                for newer in own[:age]:
                    here = np.where(newer < -0.5, here, np.where(newer <= here, -1.0, here))
                acted.append(here)
        seen = dict[tuple[tuple[bool, ...], tuple[int, ...]], Any]()
        for _, sent, pieces, _, _ in self.ways:
            if (sent, pieces) not in seen:
                likely: Any = 1.0
                for flag, goes in zip(tried, sent, strict=True):
                    likely = (flag[0] if goes else 1.0 - flag[0]) * likely
                for here, piece in zip(acted, pieces, strict=True):
                    likely = likely * np.where(np.abs(here - piece) < 0.5, 1.0, 0.0)
                seen[sent, pieces] = likely
        weights: list[Any] = [0.0] * len(self.start)
        for mode, sent, pieces, after, chance in self.ways:
            weights[after] = weights[after] + chance * seen[sent, pieces] * belief[mode]
        # packets may arrive that no history explains, as in real time: then the belief begins anew
        total = sum(weights)
        share = np.where(total > 0.0, total, 1.0)
        pairs = zip(weights, self.start.tolist(), strict=True)
        known: list[Any] = [np.where(total > 0.0, weight / share, start) for weight, start in pairs]
        return np.array(known)


class Way(NamedTuple):
    """An outcome of a step, by what the controller knows: packets in flight, links on which it sent, commands."""

    flight: tuple[bool, ...]  # which packets were in flight before it
    tried: tuple[bool, ...]  # on which links packets were sent
    chance: float
    moved: Array  # what (last commands, applied input, command) add to the state, (n, known)
    kept: Array  # these after the step, without the command, as functions of themselves, (z − s, known)
    Psi: Array  # costs of silence in the next mode, one for each set of links, (sets, z, z)
    psi: Array  # (sets,)


@dataclass(frozen=True, eq=False, repr=False)
class Histories(Displayed):
    """Computes the expected cost of silence, for each set of links, if the last step has not been acknowledged yet."""

    ways: tuple[Way, ...]
    A: Array
    C: Array
    gain: Array  # of the filter
    precision: Array  # inverse of the covariance of the measurement's error
    known: int  # number of signals that are the last commands, the applied input and the command
    otherwise: float  # cost of silence if the law excludes all outcomes, as after the loss of an acknowledgement

    def __call__(self, estimate: Any, measured: Any, *told: Any) -> Any:
        """Return the costs; ``told`` are the controller's state, if any, commands, and flags of links and packets."""
        links, packets = len(self.ways[0].tried), len(self.ways[0].flight)
        first = len(told) - links - packets
        commands = np.concatenate(told[first - self.known : first])
        register = told[: first - self.known]
        tried, flight = told[first : first + links], told[first + links :]
        found = dict[bytes, tuple[Any, Any]]()  # state and squared error of the measurement, by what moves the state
        active: list[Any] = []
        errors: list[Any] = []
        for way in self.ways:
            if way.moved.tobytes() not in found:
                prior = self.A @ estimate + way.moved @ commands
                gap: Any = measured - self.C @ prior
                found[way.moved.tobytes()] = prior + self.gain @ gap, gap @ (self.precision @ gap)
            flag: Any = 1.0
            for signal, wanted in zip((*tried, *flight), (*way.tried, *way.flight), strict=True):
                flag = flag * (signal[0] if wanted else 1.0 - signal[0])
            active.append(flag > 0.5)
            errors.append(found[way.moved.tobytes()][1])
        least: Any = FAR
        for i, flag in enumerate(active):
            least = cast("Any", np.where(flag, np.minimum(least, errors[i]), least))
        total: Any = 0.0
        costs: list[Any] = [0.0] * len(self.ways[0].psi)
        for k, way in enumerate(self.ways):
            # relative to the best history, so that some weight is not zero
            further = np.where(active[k], errors[k] - least, 0.0)
            weight = np.where(active[k], way.chance * np.exp(-0.5 * further), 0.0)
            z = np.concatenate([found[way.moved.tobytes()][0], measured, *register, way.kept @ commands])
            total = total + weight
            for i, (Psi, psi) in enumerate(zip(way.Psi, way.psi.tolist(), strict=True)):
                costs[i] = costs[i] + weight * (z @ (Psi @ z) + psi)
        share = np.where(total > 0.0, total, 1.0)
        return np.array([np.where(total > 0.0, cost / share, self.otherwise) for cost in costs])
