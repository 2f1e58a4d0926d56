"""Theoretical results about a policy: bounds, identities and closed forms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.model.trigger import Form


@dataclass(frozen=True, repr=False)
class Guarantee(Displayed):
    """A proven upper bound on the cost.

    Args:
        cost: the bound, in the units of the cost.
        statement: the theorem in one line.
        source: key of the reference in ``docs/sources.bib``.
        base: value at rate 1 of a bound that depends on the rate; if omitted, there is no such bound.
        per_silence: coefficient of (1 − rate) in the bound that depends on the rate.
    """

    cost: float
    statement: str
    source: str
    base: float | None = None
    per_silence: float = 0.0

    def at_rate(self, rate: float) -> float | None:
        """Return the bound base + per_silence·(1 − rate) at a rate in sends per step, or None if it does not exist."""
        return None if self.base is None else self.base + self.per_silence * (1 - rate)


@dataclass(frozen=True, eq=False, repr=False)
class Identity(Displayed):
    """The exact identity cost = constant + E[form] from completion of squares, used to estimate the cost.

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
    """The white innovations of a policy's filter, which allow the loop to be simulated without the plant.

    Args:
        signal: name of the innovations signal, which is white.
        covariance: covariance S of the innovations, (p, p).
        estimate: name of the state estimate, whose error is independent of all signals of the policy.
        error_covariance: covariance Σ of the estimation error, (n, n).
    """

    signal: str
    covariance: Array
    estimate: str
    error_covariance: Array


@dataclass(frozen=True, eq=False, repr=False)
class Reset(Displayed):
    """An error e⁺ = A e (1−σ) + w that a send (σ = 1) resets, with A of the model and white noise w.

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
        """Name of the signal of the policy that equals the error e."""
        return next(iter(self.signals))

    @property
    def square(self) -> Array:
        """Former name of ``weight``."""
        return self.weight


@dataclass(frozen=True, repr=False)
class ClosedForm(Displayed):
    """The exact cost and the exact rates per step of a policy, in closed form.

    They are known, for example, for a policy whose actions do not depend on the state.
    """

    cost: float
    rates: Mapping[str, float]


@dataclass(frozen=True, repr=False)
class Linearisation(Displayed):
    """Theoretical costs of the linearisation of a plant, which do not bound the cost of the nonlinear plant.

    Args:
        cost_all_time: cost of the linear plant if every sample is sent.
        cost_bound: proven bound on the cost of the linear plant, or None.
    """

    cost_all_time: float
    cost_bound: float | None
