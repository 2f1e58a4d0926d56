"""What is known of a policy, which it carries: bounds, identities and closed forms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from taciturn._arrays import Array
from taciturn.model.trigger import Form


@dataclass(frozen=True)
class Guarantee:
    """A proved bound on the cost.

    Args:
        cost: number that the cost cannot exceed, in the units of the cost.
        statement: the theorem in one line.
        source: key in ``docs/sources.bib``.
        base: cost at which a bound that depends on the rate starts; omitted: no such bound.
        per_silence: what never sending adds to ``base`` at most; ticks in silence add their share of it.
    """

    cost: float
    statement: str
    source: str
    base: float | None = None
    per_silence: float = 0.0

    def at_rate(self, rate: float) -> float | None:
        """Return the bound at a rate in sends per tick, base + per_silence·(1 − rate), or None where none is proved."""
        return None if self.base is None else self.base + self.per_silence * (1 - rate)


@dataclass(frozen=True, eq=False)
class Identity:
    """The exact identity cost = constant + E[form]: completion of squares, used as the estimator.

    Args:
        constant: what no decision changes, in the units of the cost.
        forms: one form, or one for each outcome of ``on``, evaluated at the end of a tick.
        on: the decision that picks the form.
    """

    constant: float
    forms: tuple[Form, ...]
    on: str | None = None


@dataclass(frozen=True, eq=False)
class Innovations:
    """Where the policy's filter whitens the measurement: then the loop can be run without the plant.

    Args:
        signal: the signal that is white with this covariance.
        covariance: S, (p, p).
        estimate: the signal whose error is independent of everything the policy knows.
        error_covariance: Σ, (n, n).
    """

    signal: str
    covariance: Array
    estimate: str
    error_covariance: Array


@dataclass(frozen=True, eq=False)
class Reset:
    """The error e⁺ = A e (1−σ) + w that a send sets to zero, A that of the model, w independent from tick to tick.

    Args:
        covariance: of w, (n, n); where the plant is moved by jumps, w is theirs.
        signals: the signals that are M e when the decision is taken: M by name, (entries, n);
            e itself comes first.
        square: what silence costs beyond sending always is e'(square)e per tick, (n, n).
    """

    covariance: Array
    signals: Mapping[str, Array]
    square: Array

    @property
    def error(self) -> str:
        """Name of the signal that is e itself."""
        return next(iter(self.signals))


@dataclass(frozen=True)
class ClosedForm:
    """Cost and rates that are known exactly, in the units of the cost and per tick.

    Those of a policy whose actions ignore the state, for one.
    """

    cost: float
    rates: Mapping[str, float]
