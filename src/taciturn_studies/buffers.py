"""The buffer of a receiver with the least cost: each possible delay of its link is tried.

A receiver with a buffer uses each packet exactly so long after it was sent, and drops later ones. If the law of the
delays is discrete, a buffer between two possible delays drops the same packets as the lower one, and uses the others
later. So only the possible delays themselves are candidates; a buffer of 0 is none.

Without a budget, buffers are compared by the cost of sending every sample, which is exact if a theorem or the second
moments of the loop give it (``study.baseline``), and else is simulated on the same random numbers for all buffers. With
a budget (``tune``), the parameter of the policy is tuned for each buffer, and the least cost counts or, if the budget
limits the cost, the least traffic.

If there are many candidates, as in measured delays, every k-th one is tried first, and then those next to the best one.
This finds the best buffer if the cost falls and then rises; a note states how many were tried.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any, ClassVar

from taciturn.errors import ProblemError, TaciturnError
from taciturn.extend import (
    Displayed,
    Panel,
    Progress,
    Series,
    Size,
    Stages,
    StyleName,
    answered_within,
    draw,
    in_notebook,
    per_unit,
    percent,
    symbol,
)
from taciturn.model.delay import Wait
from taciturn.model.estimate import Estimate
from taciturn.model.result import SPLICED, VERDICT, Field, Part, Tabular
from taciturn.problem import CHANGED, Problem
from taciturn.problem.without_file import Studied, as_problem
from taciturn.renewal.without_steps import nodes_of
from taciturn.simulation.average import average, check_effort
from taciturn.study.baseline import baseline_of
from taciturn.study.evaluation import cost_unit
from taciturn_studies.tune import Tuned, tune

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST = 24  # candidates that are tried at once
SURE = 2.0  # standard errors within which two costs are not distinguished


def tune_buffer(
    problem: Studied,
    buffer: str,
    *,
    rate: float | str | Mapping[str, float | str] | None = None,
    cost: float | str | None = None,
    traffic: float | str | None = None,
    violation: float | None = None,
    link: str | None = None,
    seed: int = 0,
    standard_error: float | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> TunedBuffer:
    """Find the buffer of a link's receiver with the least cost, among the possible delays of the link.

    Without a budget, the cost is that of sending every sample. With a budget, the policy is tuned for each buffer, as
    by ``tune``. Buffers for which the design is refused, such as those that drop too many packets, have a reason in
    place of a cost.

    Args:
        problem: a problem with a random or measured delay of the link; a buffer that it states is replaced.
        buffer: the link.
        rate: largest rate, as in ``tune``.
        cost: largest cost, a number; the best buffer then has the least traffic.
        traffic: largest traffic, as in ``tune``.
        violation: largest share of the steps in which limits are violated, as in ``tune``.
        link: link whose rate is meant, as in ``tune``.
        seed: seed of the random draws, which are the same for all buffers.
        standard_error: absolute standard error of each simulated cost; default: 1e-4 of the cost.
        time_limit: time limit in seconds; default: none. Without a result in time, an error is raised.
        progress: callback that receives the fraction done.

    Returns:
        The best buffer, and for each buffer that was tried its cost, and the share of packets late or dropped.

    Raises:
        ProblemError: the link has no random delay, a cost is given in percent, or no buffer can be used.
        UnstableError: every buffer drops so many packets that the loop is unstable.

    Example:
        >>> from taciturn import load
        >>> late = {"network.protocol": "tcp", "network.actuator_delay": [0.2, 0.5, 0.25, 0.05]}
        >>> found = tune_buffer(load("inverted-pendulum").changed({"kind": "excess", **late}), "actuator")
        >>> found.buffer.text(), [one.buffer.steps for one in found.tried]
        ('1 step', [1, 2, 3])
    """
    with answered_within(time_limit):
        problem = as_problem("problem", problem)
        check_effort(seed, standard_error, None)
        candidates = _candidates(problem, buffer)
        if isinstance(cost, str):
            raise ProblemError(
                f"cost is {cost!r}, a percentage above the cost of sending every sample, which depends on the buffer; "
                "expected a number"
            )

        def one(changed: Problem, wait: Wait, part: Progress) -> TriedBuffer:
            """Return the cost with a buffer."""
            if (rate, cost, traffic, violation) == (None, None, None, None):
                return _every_sample(changed, buffer, wait, seed, standard_error, part)
            tuned = tune(
                changed, rate=rate, cost=cost, traffic=traffic, violation=violation, link=link, seed=seed,
                standard_error=standard_error, progress=part,
            )  # fmt: skip
            return TriedBuffer(wait, _late(changed, buffer), tuned.evaluation.cost, tuned.problem, tuned)

        found = _searched(problem, buffer, candidates, one, Stages(in_notebook(progress)))
        tried = tuple(found[place] for place in sorted(found))
        usable = [each for each in tried if each.cost is not None]
        if not usable:
            raise next(each.error for each in reversed(tried) if each.error is not None)
        return TunedBuffer(
            buffer, problem.network.key(buffer, "buffer"), min(usable, key=_objective), tried, len(candidates)
        )


def _searched(
    problem: Problem,
    link: str,
    candidates: Sequence[Wait],
    one: Callable[[Problem, Wait, Progress], TriedBuffer],
    bar: Stages,
) -> dict[int, TriedBuffer]:
    """Return the candidates that are tried, by their places: from afar, and then next to the best one."""
    found, todo = dict[int, TriedBuffer](), _coarse(0, len(candidates) - 1)
    while todo:
        whole = len(found) + len(todo)
        for place in todo:
            wait, done = candidates[place], len(found)
            changed = problem.changed({problem.network.key(link, "buffer"): _stated(wait)})
            try:
                found[place] = one(changed, wait, bar.stage(done / whole, (done + 1) / whole))
            except TaciturnError as error:
                found[place] = TriedBuffer(wait, _late(changed, link), None, changed, None, error)
        todo = _next_to_best(found, len(candidates))
    return found


def _candidates(problem: Problem, link: str) -> list[Wait]:
    """Return the possible delays of a link, in increasing order, without 0."""
    links = problem.network.links
    if link not in links:
        raise ProblemError(f"buffer is {link!r}, which is no link of the network; expected {' or '.join(links)}")
    law, key = links[link].delay, problem.network.key(link, "delay")
    if law is None or len(law.waits) < 2:
        got = "no delay" if law is None else f"the delay {law.text()}"
        raise ProblemError(
            f"{key} states {got}, so there is no buffer to tune; expected random or measured delays, such as {key} = "
            "[0.2, 0.5, 0.3]"
        )
    return [law.wait(place) for place, wait in enumerate(law.waits) if wait > 0.0]


def _stated(wait: Wait) -> object:
    """Return a delay as a problem file states it."""
    return {"seconds": wait.seconds} if wait.seconds else wait.steps


def _coarse(first: int, last: int) -> list[int]:
    """Return at most ``MOST`` places from the first to the last one, at nearly equal distances."""
    count = min(MOST, last - first + 1)
    return sorted({first + round(i * (last - first) / max(count - 1, 1)) for i in range(count)})


def _next_to_best(found: Mapping[int, TriedBuffer], count: int) -> list[int]:
    """Return further places around the best one, up to the nearest ones that have been tried on either side."""
    usable = {place: one for place, one in found.items() if one.cost is not None}
    if not usable:
        return []
    best = min(usable, key=lambda place: _objective(usable[place]))
    low = max((place for place in found if place < best), default=best)
    high = min((place for place in found if place > best), default=min(best, count - 1))
    return [place for place in _coarse(low, high) if place not in found]


def _late(problem: Problem, link: str) -> float:
    """Return the share of the packets of a link that are late or lost."""
    return problem.network.links[link].played().mean_loss


def _every_sample(
    problem: Problem, link: str, wait: Wait, seed: int, standard_error: float | None, progress: Progress
) -> TriedBuffer:
    """Return the cost of sending every sample with a buffer."""
    nodes = nodes_of(problem.designed())
    if nodes is None:
        raise ProblemError(
            f"the policy {problem.kind} has no sampling steps, so no buffer counts in them; expected a policy with a "
            "period"
        )
    loop = problem.close(nodes)
    base, late = baseline_of(problem, loop), _late(problem, link)
    if base.cost is not None:
        return TriedBuffer(wait, late, base.cost, problem)
    if base.loop is None:
        raise ProblemError(f"the cost of sending every sample is unknown ({base.why}); expected a budget, such as rate")
    found = average(base.loop, seed=seed, standard_error=standard_error, progress=progress)
    if not found.settled:
        raise ProblemError("the loop has not settled, so the simulated cost is not an average; expected another buffer")
    return TriedBuffer(wait, late, found.cost, problem, enough=found.reached)


@dataclass(frozen=True, eq=False, repr=False)
class TriedBuffer(Displayed):
    """A buffer that was tried.

    Args:
        buffer: steps, or seconds, after which the receiver uses each packet.
        late: share of the packets that are late or lost.
        cost: cost of every sample, or of the tuned policy; None if the buffer is refused.
        problem: the problem with this buffer.
        tuned: the tuned policy, or None without a budget.
        error: the error that is the reason why there is no cost.
        enough: whether a simulation without a budget has reached the requested standard error.
    """

    buffer: Wait
    late: float
    cost: Estimate | None
    problem: Problem
    tuned: Tuned | None = None
    error: TaciturnError | None = None
    enough: bool = True

    @property
    def refused(self) -> str:
        """Why there is no cost."""
        return "" if self.error is None else str(self.error).removeprefix(f"{CHANGED}: ")

    @property
    def reached(self) -> bool:
        """Whether the requested standard error was reached."""
        return self.enough if self.tuned is None else self.tuned.reached

    @property
    def use(self) -> Estimate | None:
        """The rate of the tuned policy or, of several links, its traffic."""
        if self.tuned is None:
            return None
        rates = self.tuned.evaluation.rates
        return next(iter(rates.values())) if len(rates) == 1 else self.tuned.evaluation.traffic

    @property
    def counted(self) -> Estimate | None:
        """The estimate by which buffers are compared: the cost or, if the budget limits the cost, the traffic."""
        return self.use if self.tuned is not None and self.tuned.goal.limits_cost else self.cost

    def short(self) -> str:
        """Write buffer and cost."""
        return f"{self.buffer.text()}: cost {self.cost}"


def _refusals(tried: Sequence[TriedBuffer]) -> list[tuple[str, str]]:
    """Return a line for each row of refused buffers, with the reason of the largest one."""
    found = list[tuple[str, str]]()
    for refused, each in groupby(tried, lambda one: bool(one.refused)):
        row = list(each)
        low, high = row[0].buffer.text(), row[-1].buffer.text()
        if refused:
            found.append(("refused", f"{low if len(row) == 1 else f'{low} to {high}'}: {row[-1].refused}"))
    return found


def _objective(one: TriedBuffer) -> float:
    found = one.counted
    assert found is not None, "refused buffers are left out"
    return found.value


@dataclass(frozen=True, eq=False, repr=False)
class TunedBuffer(Tabular):
    """The buffer of a receiver with the least cost, and all buffers that were tried.

    Args:
        link: the link of the receiver.
        key: key of problem files that states the buffer.
        best: the buffer with the least cost.
        tried: all buffers that were tried, in increasing order.
        candidates: number of possible delays.
    """

    FIELDS: ClassVar[tuple[Field[TunedBuffer], ...]] = (
        Field("key"),
        Field("buffer", json=lambda wait: _stated(wait)),
        Field("late", "best.late", key="share_late_or_lost"),
        Field("cost", "best.cost"),
        Field("best", "best.tuned", key=SPLICED, optional=True),
        VERDICT,
        Field("buffers", lambda found: found.row_documents()),
        Field("notes", optional=True, say="note"),
    )

    link: str
    key: str
    best: TriedBuffer
    tried: tuple[TriedBuffer, ...]
    candidates: int

    @property
    def buffer(self) -> Wait:
        """The best buffer."""
        return self.best.buffer

    @property
    def problem(self) -> Problem:
        """The problem with the best buffer and, with a budget, the tuned parameter."""
        return self.best.problem

    @property
    def aim(self) -> str:
        """Aim of the search, in words."""
        what = "least cost of every sample" if self.best.tuned is None else self.best.tuned.aim
        return f"{self.key} = {self.buffer.text()}, {what}"

    @property
    def method(self) -> str:
        """The method that gave the costs."""
        return "simulation" if self.drawn else "exact"

    @property
    def drawn(self) -> bool:
        """Whether a cost is simulated, and so depends on the seed."""
        return any(one.cost is not None and one.cost.method == "simulation" for one in self.tried)

    @property
    def reached(self) -> bool:
        """Whether all requested standard errors were reached."""
        return all(one.reached for one in self.tried)

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence with the best buffer, and the verdict of the tuned policy."""
        per = per_unit(cost_unit(self.problem))
        told = f"{self.key} = {self.buffer.text()}: {percent(self.best.late, 1)} of the packets late or lost"
        if self.best.tuned is None:
            return (f"{told}, cost of every sample {self.best.cost} {per}",)
        return (told, *self.best.tuned.verdict)

    @property
    def notes(self) -> tuple[str, ...]:
        """Buffers that the errors do not distinguish from the best one, and how many candidates were tried."""
        found, best = list[str](), self.best.counted
        assert best is not None, "the best buffer has a cost"
        near = [
            one.buffer.text()
            for one in self.tried
            if one is not self.best
            and (other := one.counted) is not None
            and other.value - best.value <= SURE * (other.standard_error**2 + best.standard_error**2) ** 0.5
        ]
        if near:
            found.append(f"within the errors, {' and '.join(near)} {'is' if len(near) == 1 else 'are'} as good")
        if len(self.tried) < self.candidates:
            found.append(
                f"{len(self.tried)} of {self.candidates} possible delays were tried, which finds the best buffer if "
                "the cost falls and then rises"
            )
        return tuple(found)

    def summary(self) -> Mapping[str, object]:
        """Return the values to display."""
        return {"key": self.key, "buffer": self.buffer, "late": self.best.late, "cost": self.best.cost}

    def table_rows(self) -> Sequence[TriedBuffer]:
        """Return the buffers."""
        return self.tried

    def row_fields(self) -> tuple[Field[TriedBuffer], ...]:
        """Return the columns of the table: buffer, share of packets that are late or dropped, cost, parameter."""
        tuned = next((one.tuned for one in self.tried if one.tuned is not None), None)
        name = "" if tuned is None else tuned.parameter.name
        what = "cost of every sample" if tuned is None else "cost"
        more: tuple[Field[TriedBuffer], ...] = ()
        if tuned is not None:
            more = (
                Field("rate", "use", column="rate", say="sends", none=""),
                Field(name, lambda one: None if one.tuned is None else one.tuned.parameter.beside(None), key="",
                      column=name, say=name),
                Field(name, "tuned.parameter.value"),
            )  # fmt: skip
        return (
            Field("buffer", lambda one: one.buffer.text(), key="", column="buffer", say="buffer"),
            Field("buffer", json=_stated),
            Field("late", column="late", say="late or lost", text=lambda one: percent(one.late, 1)),
            Field("cost", column="cost", say=what),
            *more,
            Field("refused", optional=True, say="", text=lambda one: "refused" if one.refused else ""),
        )

    def table_texts(self) -> Sequence[str]:
        """Return the table of buffers, and the tables of the tuned policy."""
        return (self.table(), *(() if self.best.tuned is None else self.best.tuned.table_texts()))

    def lines(self, part: Part = "details") -> list[tuple[str, str]]:
        """Return the lines of one part of the text, then those of the tuned policy."""
        own = super().lines(part)
        if part == "details":
            own = [*_refusals(self.tried), *own]
        return own + ([] if part == "verdict" or self.best.tuned is None else self.best.tuned.lines(part))

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Plot the cost over the buffer, with the share of the packets that are late or lost.

        Args:
            ax: existing axes to draw in instead of a new figure.
            figsize: width and height of a new figure, in inches.
            style: ``"light"``, ``"dark"``, ``"paper"`` or ``"paper-wide"``.
        """
        usable = [(one, found) for one in self.tried if (found := one.counted) is not None]
        seconds = any(one.buffer.seconds for one, _ in usable)
        x = [1e3 * one.buffer.seconds if seconds else float(one.buffer.steps) for one, _ in usable]
        tuned = self.best.tuned
        what = "cost of every sample" if tuned is None else "traffic" if tuned.goal.limits_cost else "cost"
        series = Series(
            x, [found.value for _, found in usable], "", error=[found.standard_error for _, found in usable],
            thing="every sample" if tuned is None else "policy", notes=[percent(one.late, 0) for one, _ in usable],
        )  # fmt: skip
        title = f"{symbol(self.key)} = {self.buffer.text()}, with the share late or lost"
        label = f"{what} {per_unit(cost_unit(self.problem))}" if what.startswith("cost") else what
        return draw([Panel([series], f"buffer ({'ms' if seconds else 'steps'})", label, title)], ax, figsize, style)
