"""Certificates of one loop from matrix inequalities: decay rate, l2 gain and cost, compared with every sample sent."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from taciturn.analyse.switched import Switched, switched, switched_innovations
from taciturn.errors import ProblemError
from taciturn.extend import (
    Displayed,
    Level,
    Panel,
    Series,
    Size,
    StyleName,
    answered_within,
    draw,
    link_names,
    number_of,
    radius,
    table_text,
)
from taciturn.loop import Loop
from taciturn.lqg.equation import accumulate
from taciturn.model.estimate import Estimate, rounded
from taciturn.model.result import VERDICT, Field, Tabular, plain_fields, seconds
from taciturn.model.theory import ErrorGain
from taciturn.problem import Problem
from taciturn.problem.without_file import Studied, as_problem
from taciturn.program.draws import GENERATOR
from taciturn.study.evaluation import TimeUnit, time_unit
from taciturn.study.sentences import THAN, percent_above
from taciturn_certify.certificates import NoCertificateError, bound_cost, bound_state, find_decay, find_gain
from taciturn_certify.inequalities import expect_solver

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDE = 10.0  # ratio of the largest and the smallest number above which their axis is logarithmic
Found = TypeVar("Found")


@dataclass(frozen=True, repr=False)
class _Row(Displayed):
    """A certificate, and the number for sending every sample."""

    name: str
    value: float | None
    every_sample: float | None
    meaning: str

    @property
    def label(self) -> str:
        return "E|x|²" if self.name == "mean square" else self.name


def _verdict(found: Certificates) -> str:
    """Return what is proved about the cost, and the decay."""
    told, base = list[str](), found.cost_all_time
    bound = found.errors_bound if found.cost_bound is None else found.cost_bound
    noise = " for any noise" if found.cost_bound is None else ""
    if bound is not None and base:
        above = percent_above(Estimate(bound, 0.0, "bound"), base, 1, signed=False)
        told.append(f"at most {above} more cost{THAN}{noise}")
    elif bound is not None:
        told.append(f"cost at most {_most(bound)} per {found.unit}{noise}")
    else:
        told.append("no bound on the cost")
    if found.decay is not None:
        every = "" if found.decay_all_time is None else f" (every sample: {found.decay_all_time:.4g})"
        told.append(f"without noise, decay by {rounded(found.decay, 4, 1)} per step{every}")
    return f"proven: {'; '.join(told)}"


def _any_noise(found: Certificates) -> str:
    """Return the bound on the cost that follows from the gains from errors of links."""
    if not found.errors:
        return ""
    return f"at most {_most(found.errors_bound)} per {found.unit}, for any noise: conservative, not an estimate"


def _policy(found: Certificates) -> str:
    return f"{found.policy}, {number_of(found.states, 'state')}, actions {', '.join(found.actions)}"


def _meanings(found: Certificates) -> list[tuple[str, str]]:
    return [(row.label, row.meaning) for row in found.table_rows() if row.value is not None]


@dataclass(frozen=True, repr=False)
class Certificates(Tabular):
    """Certificates of a loop, next to the same quantities of the loop that sends every sample.

    A number that could not be proven is None, and a note gives the reason. The numbers for sending every sample are
    None if no action of the trigger sends on every link that the policy decides on, or if this loop is unstable.

    Args:
        policy: kind of the policy.
        unit: unit of time that the cost refers to.
        states: number of entries of the state z of the closed loop.
        actions: labels of the trigger.
        decay: factor per step by which the state shrinks without noise, until the limit is reached.
        limit: bound below which the cost without noise ends; 0 if the state converges to 0.
        overshoot: factor in |z_k| ≤ overshoot · decay^k |z_0| if the limit is 0; else None.
        decay_all_time: exact decay factor of sending every sample.
        gain: gain in Σ stage cost ≤ gain² Σ|w|² + residual · steps, where w is the noise of a step in units of its
            standard deviation.
        gain_residual: residual per step; 0 if the trigger has no constants.
        gain_all_time: gain of sending every sample.
        cost_bound: upper bound on the average cost under white noise.
        cost_all_time: exact cost of sending every sample.
        mean_square_bound: upper bound on the average of |x|² under white noise.
        mean_square_all_time: exact average of |x|² for sending every sample.
        errors: for each link with a dead band, the largest gain from the error that silence causes to the root of the
            stage cost, and the largest error; empty for other policies.
        errors_bound: upper bound on the average cost under any noise, from these gains and errors; or None.
        seconds: wall time.
        notes: warnings and remarks for the reader.
    """

    FIELDS: ClassVar[tuple[Field[Certificates], ...]] = (
        VERDICT,
        Field("policy", say="policy", text=_policy, after="certificates"),
        Field("unit"),
        Field("method", say="method", part="method"),
        *plain_fields("states", "actions", "decay", "limit", "overshoot", "decay_all_time"),
        *plain_fields("gain", "gain_residual", "gain_all_time", "cost_bound", "cost_all_time"),
        *plain_fields("mean_square_bound", "mean_square_all_time"),
        Field("errors", lambda found: {link: vars(one) for link, one in found.errors.items()}),
        Field("errors_bound", say="cost", text=_any_noise, after="policy"),
        Field("seconds", json=seconds, say="time", text="{:.3g} s", part="method"),
        Field("certificates", key="", say="", text=_meanings),
        Field("notes", optional=True, say="note", after="errors_bound"),
    )
    heading: ClassVar[tuple[str, ...]] = ("policy", "unit", "method", "states", "notes")
    method: ClassVar[str] = "matrix inequalities"

    policy: str
    unit: TimeUnit
    states: int
    actions: tuple[str, ...]
    decay: float | None
    limit: float | None
    overshoot: float | None
    decay_all_time: float | None
    gain: float | None
    gain_residual: float | None
    gain_all_time: float | None
    cost_bound: float | None
    cost_all_time: float | None
    mean_square_bound: float | None
    mean_square_all_time: float | None
    errors: Mapping[str, ErrorGain] = field(hash=False)
    errors_bound: float | None
    seconds: float
    notes: tuple[str, ...]

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence that states the proven bounds on the cost and on the decay rate."""
        return (_verdict(self),)

    def table_rows(self) -> Sequence[_Row]:
        """Return the certificates."""
        ends = "to 0" if self.limit == 0 else f"until the cost is at most {_shown(self.limit)} per {self.unit}"
        more = f", and {_shown(self.gain_residual)} per step" if self.gain_residual else ""
        return (
            _Row("decay", self.decay, self.decay_all_time, f"factor per step without noise, {ends}"),
            _Row("gain", self.gain, self.gain_all_time, f"from noise to the square root of the stage cost{more}"),
            _Row("cost", self.cost_bound, self.cost_all_time, f"at most, per {self.unit}"),
            _Row("mean square", self.mean_square_bound, self.mean_square_all_time, "at most, at sampling instants"),
        )

    def row_fields(self) -> tuple[Field[_Row], ...]:
        """Return the columns of the table: each proven number, and the same number with every sample sent."""
        return (
            Field("name", column="name", say="", text=lambda row: row.label),
            Field("value", lambda row: row.value, column="proved", say="proved", none="none", up=1),
            Field("every_sample", column="every_sample", say="every sample", text="{:.6g}", none="none"),
        )

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Plot each proven number relative to sending every sample, and the gains from each link's error to the cost.

        Two decay factors are compared by the ratio of their time constants.

        Args:
            ax: existing axes to draw in instead of a new figure, one for each panel.
            figsize: width and height of a new figure, in inches.
            style: ``"light"``, ``"dark"``, ``"paper"`` or ``"paper-wide"``.

        Raises:
            ProblemError: no number can be compared with that of every sample, and no error of a link is bounded.
        """
        panels = [*_ratios(self), *_link_errors(self)]
        panels[:1] = [replace(one, title=_verdict(self)) for one in panels[:1]]
        if not panels:
            raise ProblemError(
                "the certificates contain no number that can be compared with sending every sample; expected at "
                "least one such number"
            )
        return draw(panels, ax, figsize, style)

    def table(self) -> str:
        """Return the certificates as a table; its text is empty if nothing could be proven."""
        return super().table() if any(row.value is not None for row in self.table_rows()) else ""

    def table_texts(self) -> Sequence[str]:
        """Return a table of the certificates, and a table of the gains from errors of links with dead bands."""
        links = [[link, _shown(one.gain), _shown(one.largest)] for link, one in self.errors.items()]
        return (self.table(), table_text(["link", "gain from its error", "largest error"], links, 1) if links else "")


def _ratios(found: Certificates) -> list[Panel]:
    """Return the panel of the proved numbers, relative to those of sending every sample."""
    rows = list[tuple[str, float, str]]()
    for row in found.table_rows():
        value, every = row.value, row.every_sample
        if value is None or every is None or not 0 < every < np.inf:
            continue
        ratio = value / every
        if row.label == "decay":
            if not 0 < value < 1 or not every < 1:
                continue
            ratio = float(np.log(every) / np.log(value))
        rows.append(("time constant" if row.label == "decay" else row.label, ratio, f"{_shown(value)}, {every:.4g}"))
    rows = rows[::-1]  # the first is the uppermost
    if not rows:
        return []
    places, ratios = [float(row) for row in range(len(rows))], [ratio for _, ratio, _ in rows]
    return [
        Panel(
            [Series(ratios, places, "", "bars", thing="guarantee")],
            "proved, as a multiple of every sample",
            names=[name for name, _, _ in rows],
            notes=[note for _, _, note in rows],
            noted="proved, every sample",
            levels=[Level(1.0, "every sample", axis="x")],
            xlog=max(ratios) > WIDE * min(ratios),
        )
    ]


def _link_errors(found: Certificates) -> list[Panel]:
    """Return the panel of what the error of each link adds to the root of the cost."""
    rows = [(link, one.gain * one.largest) for link, one in found.errors.items()][::-1]
    if not rows:
        return []
    series = [Series([added for _, added in rows], range(len(rows)), "", "stalks", thing="guarantee")]
    names, notes = [*link_names(found.errors).values()][::-1], [_shown(added) for _, added in rows]
    label = "gain × largest error of a link: √cost, at most"
    return [Panel(series, label, names=names, notes=notes, xlim=(0.0, None))]


def certify(problem: Studied, *, time_limit: float | None = None) -> Certificates:
    """Compute certificates of decay rate, l2 gain and cost for a problem's loop, from quadratic Lyapunov functions.

    Every number follows from matrix inequalities whose solution was verified, with a bound on rounding errors, before
    it is returned. For dead bands, the gains from errors of links to the cost are added (``Theory.errors``); they also
    certify loops with several decisions, for which the matrix inequalities are not available.

    Args:
        problem: from ``load`` or ``Problem``; the simulated plant may differ from the plant of the design.
        time_limit: time limit in seconds; default: none. Without a result in time, an error is raised.

    Returns:
        The certificates.

    Raises:
        ProblemError: the loop is not a switched linear system with one quadratic trigger, nothing could be proved, or
            cvxpy and clarabel are not installed.

    Source: heemels2013, rump2006

    Example:
        >>> from taciturn import load
        >>> found = certify(load("two-mass-lqg"))
        >>> round(found.decay, 2), round(found.cost_bound, 2)  # J_all = 0.7335, guaranteed 0.8068
        (0.97, 0.8)
    """
    with answered_within(time_limit):
        began = time.perf_counter()
        problem = as_problem("problem", problem)
        policy = problem.design()
        loop = problem.close(policy)
        errors: Mapping[str, ErrorGain] = policy.theory.errors if loop.nominal else {}
        try:
            matrices = switched(loop)
        except ProblemError as error:
            if not errors:
                raise
            return _of_errors(problem, loop, errors, str(error), began)
        expect_solver()
        law = switched_innovations(loop) if loop.reducible else matrices
        notes: list[str] = []
        decay, gain = _attempt(find_decay, matrices, notes), _attempt(find_gain, matrices, notes)
        cost, square = _attempt(bound_cost, law, notes), _attempt(bound_state, law, notes)
        if decay is None and gain is None and cost is None and square is None and not errors:
            raise ProblemError(f"nothing could be proved for this loop: {notes[0]}")
        always = _always(loop, matrices)
        tick = policy.tick
        return Certificates(
            policy=policy.kind,
            unit=time_unit(problem),
            states=matrices.states,
            actions=matrices.labels,
            decay=None if decay is None else decay.rate,
            limit=None if decay is None else decay.limit / tick,
            overshoot=None if decay is None else decay.overshoot,
            decay_all_time=always.decay,
            gain=None if gain is None else gain.value,
            gain_residual=None if gain is None else gain.residual,
            gain_all_time=always.gain,
            cost_bound=None if cost is None else loop.problem.per_unit(cost.value),
            cost_all_time=always.cost,
            mean_square_bound=None if square is None else square.value,
            mean_square_all_time=always.mean_square,
            errors=errors,
            errors_bound=_bound(loop, errors),
            seconds=time.perf_counter() - began,
            notes=(*notes, *(f"proved for the simulated plant: {text}" for text in loop.violated_assumptions)),
        )


def _of_errors(
    problem: Problem, loop: Loop, errors: Mapping[str, ErrorGain], reason: str, began: float
) -> Certificates:
    """Return the certificates of a loop that has gains from errors, and no matrix inequalities."""
    policy = loop.policy
    return Certificates(
        policy=policy.kind,
        unit=time_unit(problem),
        states=sum(state.name != GENERATOR for state in loop.program().states),
        actions=tuple(policy.decisions),
        decay=None, limit=None, overshoot=None, decay_all_time=None, gain=None, gain_residual=None, gain_all_time=None,
        cost_bound=None, cost_all_time=None, mean_square_bound=None, mean_square_all_time=None,
        errors=errors,
        errors_bound=_bound(loop, errors),
        seconds=time.perf_counter() - began,
        notes=(f"only the gains from errors are available: {reason}",),
    )  # fmt: skip


def _bound(loop: Loop, errors: Mapping[str, ErrorGain]) -> float | None:
    guarantee = loop.policy.theory.guarantee
    return None if guarantee is None or not errors else guarantee.cost


@dataclass(frozen=True)
class _Always:
    """Numbers of the loop that sends every sample."""

    decay: float | None = None
    gain: float | None = None
    cost: float | None = None
    mean_square: float | None = None


def _always(loop: Loop, matrices: Switched) -> _Always:
    """Return the numbers of sending every sample, which are exact except for the gain."""
    if matrices.sends is None:
        return _Always()
    alone = matrices.under(matrices.sends)
    F, G, slowest = alone.F[0], alone.G, radius(alone.F[0])
    if slowest >= 1:
        return _Always(slowest)
    covariance = accumulate(F, G @ G.T)
    return _Always(
        slowest,
        None if (gain := _attempt(find_gain, alone, [])) is None else gain.value,
        loop.problem.per_unit(float(np.trace(alone.M[0] @ covariance)) + alone.constant),
        float(np.trace(alone.X @ covariance @ alone.X.T)) + alone.hidden,
    )


def _attempt(find: Callable[[Switched], Found], matrices: Switched, notes: list[str]) -> Found | None:
    """Return a certificate, or None after adding a note with the reason."""
    try:
        return find(matrices)
    except NoCertificateError as error:
        if str(error) not in notes:
            notes.append(str(error))
        return None


def _shown(value: float | None) -> str:
    return "none" if value is None else f"{value:.6g}"


def _most(value: float | None) -> str:
    """Return an upper bound, rounded up."""
    return "none" if value is None else "0" if value == 0 else rounded(value, 6, 1)
