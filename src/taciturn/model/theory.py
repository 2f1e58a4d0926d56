"""The theory of a policy: the cost of its design, and the bounds, identities and closed forms that hold."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from math import sqrt
from typing import cast

import numpy as np

from taciturn._arrays import Array, quoted
from taciturn._display import Displayed
from taciturn._modes import ROUNDOFF
from taciturn.errors import ProblemError
from taciturn.model.cost import Cost
from taciturn.model.coverage import GAUSSIAN_THEORY
from taciturn.model.estimate import Estimate
from taciturn.model.silence import SilenceCost
from taciturn.model.steps import Terms
from taciturn.model.trigger import Form

OPERATIONS = 16 * ROUNDOFF  # relative rounding error of sixteen operations
INNOVATION = "innovation"  # name of the signal y − (prediction of y) in the filters of the designs


@dataclass(frozen=True, repr=False)
class Guarantee(Displayed):
    """A proven upper bound on the cost.

    Args:
        cost: the bound, in the units of the cost.
        statement: the theorem in one line.
        source: key of the reference in ``docs/sources.bib``.
        base: value at rate 1 of a bound that depends on the rate; if omitted, there is no such bound.
        per_silence: coefficient of (1 − rate) in the bound that depends on the rate.
        deciders: the largest cost δ of silence by group of links that are decided together, in a bound
            base + (Σ√(δ(1 − r)))² with the rate r at which all links of a group send.
        weights: share of each link in the rate of a bound that depends on one rate; default: one link has it all.
        pull: γ of set-points that change at known times, with which an error of the input is correlated: if S is what
            silence adds to the base, the bound is base + S + 2γ√S; 0 for other set-points.
        proved: whether the bound is proved for the gains as they are stored, and rounded upwards; otherwise it is that
            of the theorem for exact gains, computed in doubles.
        more_sends: whether the bound also holds if packets are sent in further steps, since it limits the cost of each
            silent step and a packet ends silence.
        every_path: whether the bound holds on every path, with the cost of sending every sample on that path.
    """

    cost: float
    statement: str
    source: str
    base: float | None = None
    per_silence: float = 0.0
    deciders: Mapping[tuple[str, ...], float] = field(hash=False, default_factory=lambda: {})
    weights: Mapping[str, float] = field(hash=False, default_factory=lambda: {})
    more_sends: bool = False
    pull: float = 0.0
    proved: bool = False
    every_path: bool = False

    def upwards(self) -> Guarantee:
        """Round all numbers of the bound up, because their computation has rounding errors."""
        return replace(
            self,
            cost=rounded_up(self.cost),
            base=None if self.base is None else rounded_up(self.base),
            per_silence=rounded_up(self.per_silence),
            deciders={group: rounded_up(delta) for group, delta in self.deciders.items()},
        )

    def at_rates(self, rates: Mapping[str, Estimate], link: str) -> Estimate | None:
        """Return the bound for given send rates, with a standard error that follows from those of the rates.

        Args:
            rates: sends per step, by link.
            link: the link whose rate the bound depends on if it depends on one rate, such as ``policy.scheduled[0]``;
                for bounds that depend on the rates of several links, any of these links.

        Raises:
            ProblemError: the rate of a link is missing or is no ``Estimate``.
        """
        if self.base is None:
            return None
        needed = {link, *self.weights, *chain.from_iterable(self.deciders)}
        given = cast("Mapping[str, object]", rates if isinstance(cast("object", rates), Mapping) else {})
        if any(not isinstance(given.get(name), Estimate) for name in needed):
            raise ProblemError(
                f"rates is {quoted(rates)}; expected an Estimate for each of the links {', '.join(sorted(needed))}, as "
                "in the rates of an evaluation"
            )
        values = {name: rate.value - rate.error for name, rate in rates.items()}  # the bound falls with the rate
        if not self.deciders:
            shares = self.weights or {link: 1.0}
            rate = sum(share * values[name] for name, share in shares.items())
            error = sum(share * rates[name].standard_error for name, share in shares.items())
            bound = self._with_silence(self.per_silence * (1 - rate))
            later = self._with_silence(self.per_silence * (1 - rate + error))
            return Estimate(bound, abs(later - bound), rates[link].method)
        bound = self._of(values)
        less = {name: values[name] - rate.standard_error for name, rate in rates.items()}
        moved = [self._of({**values, name: lower}) - bound for name, lower in less.items()]
        return Estimate(bound, float(np.linalg.norm(moved)), rates[link].method)

    def _with_silence(self, added: float) -> float:
        """Return the bound for the cost that silence adds, rounded upwards if it is proved."""
        assert self.base is not None, "only such a bound depends on the rate"
        bound = with_silence(self.base, added, self.pull)
        return rounded_up(bound) if self.proved else bound

    def _of(self, rates: Mapping[str, float]) -> float:
        """Return the bound with S = (Σ√(δ(1 − r)))², where the silence of a group is at most the sum over its links."""
        assert self.base is not None
        silent = {group: min(1.0, sum(1 - rates[link] for link in group)) for group in self.deciders}
        added = sum(sqrt(delta * max(silent[group], 0.0)) for group, delta in self.deciders.items()) ** 2
        return self._with_silence(added)

    def at_rate(self, rate: float) -> float | None:
        """Return the bound base + per_silence·(1 − rate), for a rate in sends per step.

        The result is None if there is no such bound, or if it depends on the rates of several links (``at_rates``).
        """
        if self.base is None or self.deciders:
            return None
        return self._with_silence(self.per_silence * (1 - rate))


def with_silence(base: float, added: float, pull: float) -> float:
    """Return the bound base + S + 2γ√S with S = ``added`` and γ = ``pull``, the attribute of ``Guarantee``."""
    return base + added + 2 * pull * sqrt(max(added, 0.0))


def rounded_up(value: float) -> float:
    """Round a computed sum or product of at most sixteen nonnegative numbers up, to a proven upper bound.

    The bound is 0 if the sum or product is 0.
    """
    return value + abs(value) * OPERATIONS


@dataclass(frozen=True, repr=False)
class ErrorGain(Displayed):
    """Effect on the cost of a link that does not send, because the receiver's value then has an error.

    On every path, the root of the cost per step is at most that of sending every sample plus a sum over all links:
    ``gain`` times the root mean square of the error.

    Args:
        gain: the largest gain from the error to the root of the stage cost (H∞ norm), with every sample sent.
        largest: the largest length of the error.
    """

    gain: float
    largest: float


@dataclass(frozen=True, eq=False, repr=False)
class Identity(Displayed):
    """The exact identity cost = constant + E[form], by completion of squares. Simulations estimate the cost with it.

    Args:
        constant: part of the cost that no decision changes, in the units of the cost.
        forms: one form, or one for each outcome of ``on``, evaluated at the end of a step.
        on: the decision that selects the form.
    """

    constant: float
    forms: tuple[Form, ...]
    on: str | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Innovations(Displayed):
    """White innovations of a policy's filter. With them, the loop can be simulated without its plant.

    Args:
        signal: name of the innovations signal, which is white; None if no node computes the innovations.
        covariance: covariance S of the innovations, (p, p).
        estimate: name of the state estimate, whose error is independent of all signals of the policy.
        error_covariance: covariance Σ of the estimation error, (n, n).
        predicted: without ``signal``, the prediction of the measurement as a sum of signals of the previous step.
    """

    signal: str | None
    covariance: Array
    estimate: str
    error_covariance: Array
    predicted: Terms = field(default_factory=lambda: {})


@dataclass(frozen=True, eq=False, repr=False)
class Reset(Displayed):
    """An error e⁺ = A e (1−σ) + w that a send (σ = 1) resets. A is the matrix of the model, and w is white noise.

    Args:
        covariance: covariance of w, (n, n); for a plant with jumps, w is the effect of the jumps.
        signals: matrices M of the signals that equal M e at the decision, by name, (entries, n); the first is e itself.
        weight: weight in e'(weight)e, the cost per step of silence beyond sending every sample, (n, n).
    """

    covariance: Array
    signals: Mapping[str, Array]
    weight: Array

    @property
    def error(self) -> str:
        """Name of the signal of the policy that is the error e."""
        return next(iter(self.signals))

    @property
    def square(self) -> Array:
        """The attribute ``weight`` under its former name."""
        return self.weight


@dataclass(frozen=True, repr=False)
class ClosedForm(Displayed):
    """The exact cost of a policy, and its exact send rates per step, in closed form.

    They are known, for example, for a policy whose actions do not depend on the state.
    """

    cost: float
    rates: Mapping[str, float] = field(hash=False)


@dataclass(frozen=True, repr=False)
class Linearisation(Displayed):
    """Costs of the linearisation of a nonlinear plant. They do not bound the cost of the nonlinear plant.

    Args:
        cost_all_time: cost of the linear plant if every sample is sent.
        cost_bound: proven bound on the cost of the linear plant, or None.
    """

    cost_all_time: float
    cost_bound: float | None


@dataclass(frozen=True, eq=False, repr=False)
class Theory(Displayed):
    """Known properties of a policy. They hold in a loop with the plant, the network and the cost of its design.

    Every argument may be omitted. A policy without theory is simulated, run and exported like any other; a study needs
    at least its cost.

    Args:
        cost: the cost for which the policy was designed; required with an identity, a guarantee or a closed form.
        cost_all_time: cost of sending every sample, in the units of the cost, or None if it is unknown.
        cost_all_time_error: proved bound on the error of ``cost_all_time``, which is then the cost of the gains as they
            are stored; None if the error is only estimated.
        cost_lqg: cost of LQG with the same weights, sending every sample, for a policy that keeps a given controller.
        noise_cost: inter-sample noise cost per step of a continuous plant, which no policy can change.
        settling: time constant in steps of the loop that sends every sample, 1/(1 − |slowest eigenvalue|).
        recovery: the same without the slow disturbances of the plant, which a fault of a node does not change; default:
            ``settling``.
        guarantee: proven upper bound on the cost, or None.
        errors: gain and largest error of each link, for a certificate that assumes nothing about the noise.
        silence: signals in which each node stores the cost of its own silence, by the links that it decides together.
        identity: exact identity for the cost, or None.
        innovations: white innovations of the policy's filter, or None.
        sums: signals that no node computes, as sums of signals of several nodes at the end of a step; identity and
            innovations may refer to them.
        closed_form: exact cost and rates, or None.
        reset: the error that every send sets to zero, or None.
        fixed_rates: rates by link that the design fixes, in sends per step.
        covers: names of the properties that the theory takes into account (``taciturn.model.coverage``); any other
            property that is given makes the theory inapplicable; default: a linear loop with Gaussian noise.
        functions: signals that the policy computes by a function and that the theory takes into account.
        fourth: growth per step of the fourth moments with a packet at every q-th step, q = ``every``; at 1 or more, the
            variance of the cost is infinite, and no guarantee is stated. With a discount α, of α² times these moments.
            None: not computed by the design.
        periodic: function of the steps between packets that returns the exact cost of the same control at periodic
            sends, per step and without ``noise_cost``; it raises an error if this is unstable. None: LQG is compared.
        every: q, steps between packets of the base, the loop to which identity and guarantee refer.
    """

    cost: Cost | None = None
    cost_all_time: float | None = None
    noise_cost: float = 0.0
    settling: float = 0.0
    guarantee: Guarantee | None = None
    identity: Identity | None = None
    innovations: Innovations | None = None
    closed_form: ClosedForm | None = None
    reset: Reset | None = None
    fixed_rates: Mapping[str, float] = field(default_factory=lambda: {})
    covers: frozenset[str] = GAUSSIAN_THEORY
    functions: frozenset[str] = frozenset()
    periodic: Callable[[int], float] | None = None
    errors: Mapping[str, ErrorGain] = field(default_factory=lambda: {})
    silence: Mapping[tuple[str, ...], SilenceCost] = field(default_factory=lambda: {})
    fourth: float | None = None
    sums: Mapping[str, Terms] = field(default_factory=lambda: {})
    recovery: float | None = None
    cost_lqg: float | None = None
    every: int = 1
    cost_all_time_error: float | None = None

    @property
    def recovers(self) -> float:
        """Time constant, in steps, with which the loop recovers from a fault of a node."""
        return self.settling if self.recovery is None else self.recovery

    def check(self, kind: str, computed: Sequence[str]) -> None:
        """Check that the numbers in this theory are valid for a policy of the given kind.

        Args:
            kind: name of the policy kind.
            computed: the signals that the policy computes by functions.

        Raises:
            ProblemError: a cost is not finite, the cost of the design is missing, or the policy is not linear.
        """
        costs = {
            "cost of sending every sample": self.cost_all_time,
            "inter-sample noise cost": self.noise_cost,
            "guaranteed cost": self.guarantee and self.guarantee.cost,
            "cost": self.closed_form and self.closed_form.cost,
        }
        for name, value in costs.items():
            if value is not None and not np.isfinite(value):
                raise ProblemError(
                    f"the {name} of the policy {kind} is {value:g}; expected a finite number: scale the problem, or "
                    "send more often"
                )
        if self.cost is None and (self.identity or self.guarantee or self.closed_form):
            raise ProblemError(
                f"the theory of the policy {kind} has an identity, a guarantee or a closed form, but no cost; expected "
                "the cost to which they refer"
            )
        names = ("innovations", "identity", "reset", "closed_form", "guarantee")
        claims = [name for name in names if getattr(self, name) is not None]
        others = [name for name in computed if name not in self.functions]
        if claims and others:
            raise ProblemError(
                f"the policy {kind} computes {others[0]} with a Python function, but its theory states {claims[0]}, "
                f"which holds for linear steps only; expected no {claims[0]}"
            )


@dataclass(frozen=True, repr=False)
class LowerBound(Displayed):
    """A lower bound on the cost of a controller that holds for every schedule with a given send rate.

    Args:
        cost: the bound, in units of the cost.
        confidence: one-sided confidence of the bound.
        rate: sends per step.
        price: price of a send for which the bound is computed, in units of the cost times steps; at another rate r per
            step the bound is cost + price·(rate − r).
    """

    cost: float
    confidence: float
    rate: float
    price: float

    def at_rate(self, rate: float) -> float:
        """Return the lower bound for another send rate, per step, at the same price of a send."""
        return self.cost + self.price * (self.rate - rate)


LEVEL = 0.999  # default confidence level of a bound
