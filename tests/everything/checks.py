"""What must hold for a problem: everything that reads it agrees, and what is refused is refused with one sentence.

``examine`` returns the faults of one problem as ``Fault``s, and what was compared with what. A number that was
estimated is first compared at ``DOUBT`` standard errors; a disagreement is repeated with a new seed and ``LONGER``
times the steps, and is a fault only beyond ``SURE`` standard errors there.
"""

from __future__ import annotations

import json
import math
import pickle
import re
import signal
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from everything import plain
from everything.commands import run
from everything.every_path import every_path_policy, promised
from everything.interpreters import CHEAP, COSTLY, SkippedError
from everything.late_paths import same_queues
from everything.laws import nodes_of
from everything.lower import bounded_below
from everything.mutated import like_python
from everything.nodes import on_every_path
from everything.policies import policy_of, resolved
from everything.random_delays import random_inputs, simulate_late, with_delay
from everything.routes import ALSO, ROUTES, CommandError, accepted_alone, command, is_sentence
from everything.toml import text_of

import taciturn
from taciturn.errors import TaciturnError
from taciturn.problem import Problem, parse
from taciturn.study.evaluation import Evaluation
from taciturn_limits.optimal_kind import OptimalPolicy

Tables = Mapping[str, Any]
DOUBT, SURE, LONGER = 4.0, 5.0, 16
STEPS, PATHS, OWN_STEPS, SETTLE = 200_000, 250, 420, 150  # 420: whole cycles of most lengths
LONGEST_SETTLING = 4000
SECONDS = 300.0  # after which a check hangs; longer than the whole run of a day, whose machine may be slow


@dataclass(frozen=True)
class Fault:
    """Something that does not hold.

    Args:
        check: the name of the check, which a smaller problem must fail too.
        text: what was found.
    """

    check: str
    text: str


@dataclass
class Report:
    """What became of a problem.

    Args:
        refused: the sentence with which it is refused, or None.
        faults: what does not hold.
        compared: the names of the checks that were made.
        skipped: the checks that do not exist for it, with their reasons.
    """

    refused: str | None = None
    faults: list[Fault] = field(default_factory=list)
    compared: list[str] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)


class HungError(Exception):
    """A check took too long."""


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raise ``HungError`` if the block takes longer."""

    def ring(*_: object) -> None:
        raise HungError(f"nothing after {seconds:g} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def attempt(report: Report, check: str, work: Callable[[], Any]) -> Any:
    """Return what the work returns; a crash, a hang or a refusal that is no sentence is a fault, and returns None.

    Raises:
        TaciturnError: the library refuses, with a sentence.
    """
    try:
        with within(SECONDS), np.errstate(all="ignore"):
            return work()
    except TaciturnError as error:
        if not is_sentence(str(error)):
            report.faults.append(Fault(f"{check}: sentence", str(error)))
        raise
    except HungError as error:
        report.faults.append(Fault(f"{check}: hangs", str(error)))
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{type(error).__name__} in {Path(last.filename).name} {last.name}"
        report.faults.append(Fault(f"{check}: {where}", "".join(traceback.format_exception(error)[-6:])))
    return None


def examine(tables: Tables, folder: Path, seed: int, more: tuple[str, ...] = ()) -> Report:
    """Check a problem, whose file is ``problem.toml`` in the folder.

    Args:
        tables: its tables.
        folder: with the files that it names.
        seed: of all that is drawn.
        more: names of expensive checks, of which the first that exists for the problem is made too.
    """
    report, stage = Report(), "load"
    try:
        problem = attempt(report, "load", lambda: taciturn.load(folder / "problem.toml"))
        if problem is None:
            return report
        stage = "design"
        policy = attempt(report, "design", problem.designed)
        if policy is None:
            return report
        stage = "evaluate"
        found = attempt(report, "evaluate", lambda: evaluated(problem, seed))
    except TaciturnError as error:
        report.refused = str(error)
        _refused_by_all(report, stage, folder, seed)
        return report
    if found is None:
        return report
    expensive = False
    for name in (*(name for name in CHECKS if name not in EXPENSIVE), *more):
        check = CHECKS[name]
        if expensive:
            break
        try:
            attempt(report, name, lambda check=check: check(report, problem, found, tables, folder, seed))
            report.compared.append(name)
            expensive = name in EXPENSIVE
        except SkippedError as error:
            report.skipped[name] = str(error)
        except TaciturnError as error:
            report.faults.append(Fault(f"{name}: refused", f"evaluate accepts it, but: {error}"))
    return report


def evaluated(problem: Problem, seed: int, longer: int = 1, confidence: float | None = None) -> Evaluation:
    """Return the answer of ``evaluate`` with a fixed number of steps, unless the policy is solved."""
    steps = None if isinstance(problem.designed(), OptimalPolicy) else longer * STEPS
    return taciturn.evaluate(problem, steps=steps, seed=seed, after_step=False, confidence=confidence)


def _refused_by_all(report: Report, stage: str, folder: Path, seed: int) -> None:
    """Check that nothing computes with a problem that cannot be evaluated, but for a reason that is known.

    Args:
        report: with the refusal.
        stage: "load", "design" or "evaluate", which refuses.
        folder: of the problem.
        seed: of what is drawn.
    """
    for route, use in ROUTES.items():
        if route == stage:
            continue
        try:
            other = attempt(report, f"{route} of a refused problem", lambda use=use: use(folder, seed))
        except CommandError as error:
            report.faults.append(Fault(f"{route} of a refused problem: no refusal", str(error)))
            continue
        if report.faults and report.faults[-1].check.startswith(f"{route} of a refused problem"):
            continue  # it crashed
        if other is None:
            if stage != "evaluate" or accepted_alone(str(report.refused), route) is None:
                text = f"{stage} refuses: {report.refused}"
                report.faults.append(Fault(f"accepted by {route}", text))
        elif not is_sentence(other):
            report.faults.append(Fault(f"{route} of a refused problem: sentence", other))
        elif stage != "evaluate" and other != report.refused:
            report.faults.append(
                Fault(f"{route} of a refused problem: another sentence", f"{report.refused} | {other}")
            )


# -- cheap checks

Check = Callable[[Report, Problem, Evaluation, Tables, Path, int], None]


def finite(report: Report, problem: Problem, found: Evaluation, tables: Tables, folder: Path, seed: int) -> None:
    """No number of an answer is NaN or infinite, and its document is JSON."""
    text = json.dumps(found.document(), allow_nan=True)
    for word in ("NaN", "Infinity"):
        if word in text:
            report.faults.append(Fault(f"finite: {word}", text[:2000]))
    json.loads(text)
    str(found)


def ordered(report: Report, problem: Problem, found: Evaluation, tables: Tables, folder: Path, seed: int) -> None:
    """J ≤ its bounds, up to standard errors; no periodic policy costs less than the best that is found at its rate."""
    cost, error = found.cost.value, found.cost.standard_error + found.cost.error
    slack = DOUBT * error + 1e-9 * abs(cost)
    for name, bound in (("bound", found.cost_bound), ("bound at the rate", found.cost_bound_at_rate)):
        if bound is None or cost - slack - DOUBT * found.bound_error <= bound:
            continue
        again = evaluated(problem, seed + 1, LONGER)
        other = again.cost_bound if name == "bound" else again.cost_bound_at_rate
        assert other is not None
        over = again.cost.value - SURE * (again.cost.standard_error + again.bound_error + again.cost.error) - other
        if over > 1e-9 * abs(other):
            report.faults.append(Fault(f"ordered: {name}", f"cost {again.cost}, {name} {other:.8g}"))
    if (
        found.certificate is not None
        and cost - slack - DOUBT * found.certificate.standard_error > found.certificate.value
    ):
        again = evaluated(problem, seed + 1, LONGER)
        assert again.certificate is not None
        spread = SURE * (again.cost.standard_error + again.cost.error + again.certificate.standard_error)
        if again.cost.value - spread > again.certificate.value:
            report.faults.append(Fault("ordered: certificate", f"cost {again.cost}, certificate {again.certificate}"))
    best = found.cost_periodic_same_rate
    if best is not None and problem.kind in ("periodic", "periodic-schedule") and best > (1 + 1e-6) * cost + slack:
        report.faults.append(Fault("ordered: periodic", f"cost {found.cost}, periodic at the same rate {best:.8g}"))
    for link, rate in found.rates.items():
        top = (found.base_rate or math.inf) * (1 + 1e-9)
        if not -1e-12 <= rate.value <= top:
            report.faults.append(Fault("ordered: rate", f"{link}: {rate}, at most {top:g}"))


NO_AVERAGE = ("no average", "not an average", "not averages", "depend on the simulated time")


def simulated(report: Report, problem: Problem, found: Evaluation, tables: Tables, folder: Path, seed: int) -> None:
    """Cost and rates are those of a plain simulation, unless evaluate says itself that they are no averages."""
    if (
        problem.kind == "distributed"
        and on_every_path(tables)
        and any(words in note for note in found.notes for words in NO_AVERAGE[1:3])
    ):
        try:
            found = evaluated(problem, seed, LONGER)  # a bank may take long to fill
        except TaciturnError:
            raise SkippedError("a loop that diverges in a longer run") from None
    if any(words in note for note in found.notes for words in NO_AVERAGE):
        raise SkippedError("no average")
    try:
        differences = compare(problem, found, tables, folder, seed, 1)
    except plain.NotModelledError as error:
        raise SkippedError(f"not modelled: {error}") from None
    if any("depend on the simulated time" in note or "no average" in note for note in found.notes):
        raise SkippedError("cost or rates have no average, and a note says so")
    doubtful = [name for name, (_, _, z) in differences.items() if z > DOUBT]
    if not doubtful:
        return
    again = evaluated(problem, seed + 1, LONGER)
    differences = compare(problem, again, tables, folder, seed + 1, LONGER)
    for name, (own, theirs, z) in differences.items():
        if z > SURE and name in doubtful:
            notes = "; ".join(found.notes)
            text = f"plain simulation {own}, evaluate {theirs}, {z:.1f} standard errors apart; notes: {notes}"
            report.faults.append(Fault(f"simulated: {name.partition(' ')[0]}", f"{name}: {text}"))


def kept_on_every_path(
    report: Report, problem: Problem, found: Evaluation, tables: Tables, folder: Path, seed: int
) -> None:
    """By its rules alone, no path of this simulation costs more than its certificate, or than its promise."""
    if problem.kind != "distributed" or not on_every_path(tables) or problem.nonlinear:
        raise SkippedError("no bound on every path")
    try:
        tables = plain.in_plain_form(tables)
        model = resolved(tables, plain.model_of(tables, folder), folder)
        nodes = nodes_of(tables, len(model.C), model.m)
        text = promised(model, *every_path_policy(tables, model, nodes, found.cost_all_time), seed)
    except plain.NotModelledError as error:
        raise SkippedError(f"not modelled: {error}") from None
    if text:
        report.faults.append(Fault("kept on every path", text))


def compare(
    problem: Problem, found: Evaluation, tables: Tables, folder: Path, seed: int, longer: int
) -> dict[str, tuple[str, str, float]]:
    """Return cost and rates by this simulation and by the library, and how far apart they are."""
    tables = plain.in_plain_form(tables)
    late = random_inputs(tables, folder)
    given = tables if late is None else with_delay(tables, late, late.mean)
    model = resolved(given, plain.model_of(given, folder), folder)
    policy, twin = policy_of(given, model, found.cost_all_time)
    world = plain.with_actual(model, tables, folder)
    other = world is not model or (world.loads is not None and (world.loads.values.size or not world.average))
    if other and twin is not None:
        twin.exact = None
    paths, steps = PATHS * (4 if longer > 1 else 1), OWN_STEPS * (4 if longer > 1 else 1)
    if not model.average:
        paths, steps = paths * 8, OWN_STEPS
    if world.function is not None:
        paths, steps = paths // 5, steps
    settle = max(SETTLE, settling(model, getattr(policy, "radius", 0.5)))
    if longer > 1:  # dead bands may hold an input for thousands of steps
        settle = max(settle, min(LONGER * settle, LONGEST_SETTLING))
    if late is None:
        own = plain.simulate(world, policy, twin, seed=seed, paths=paths, steps=steps, settle=settle)
    else:
        own = simulate_late(tables, late, policy, folder, seed, 4 * paths, steps, settle)
    result: dict[str, tuple[str, str, float]] = {}

    def add(name: str, mine: tuple[float, float], value: float, error: float) -> None:
        if not math.isfinite(mine[0]):
            raise plain.NotModelledError("a loop that diverges")
        spread = math.hypot(mine[1], error) + 1e-7 * abs(value) + 1e-12
        text = f"{mine[0]:.6g} ± {mine[1]:.2g}"
        result[name] = (text, f"{value:.6g} ± {error:.2g}", abs(mine[0] - value) / spread)

    tolerance = 2e-3 if getattr(policy, "approximate", False) else 1e-6
    spread = tolerance * abs(own.cost[0]) if tolerance > 1e-6 else 0.0
    add("cost", own.cost, found.cost.value, found.cost.standard_error + found.cost.error + spread)
    if own.base is not None:
        assert own.base_found is not None
        add("base of this simulation itself", own.base_found, own.base, 0.0)
        if found.cost_all_time is not None:
            add("cost_all_time", (own.base, 0.0), found.cost_all_time, tolerance * abs(own.base))
    # where their theory does not hold, the library compares these kinds with their own gains and every packet, and the
    # twin is LQG
    own_gains = tables["policy"]["kind"] in ("rollout", "self-triggered") and found.cost_bound is None
    alike = getattr(twin, "alike", True) and not own_gains
    if own.excess is not None and found.excess is not None and alike:  # exact, or simulated on the same noise too
        theirs = found.excess.value
        add(
            "excess", own.excess, theirs, found.excess.standard_error + found.excess.error + tolerance * abs(1 + theirs)
        )
    for link, rate in found.rates.items():
        if link in own.rates:
            value, error = own.rates[link]
            pace = (found.base_rate or 1.0) * model.seconds if model.continuous else 1.0
            count = steps * (pace if model.average else 1.0)  # times the rate: the sends of a path
            if (spread := error * math.sqrt(paths) * count) < 1 and spread**2 < 0.5 * value * count:
                least = 1.0 / count  # paths send in phase: all begin and end within the same interval
            else:
                least = 0.1 / paths / count
            add(f"rate of {link}", (value * (pace if not model.average else 1.0), error + least), rate.value,
                rate.standard_error + rate.error)  # fmt: skip
    return result


def settling(model: plain.Model, radius: float) -> int:
    """Return steps after which the start of a loop is forgotten; modes that do not decay do not matter."""
    values = [*np.abs(np.linalg.eigvals(model.A[: model.n, : model.n])), radius]
    slow = max([value for value in values if value < 1 - 1e-6], default=0.5)
    steps = 12 / -math.log(max(slow, 1e-3))
    if steps > LONGEST_SETTLING:
        raise plain.NotModelledError("a loop that settles slowly")
    return int(steps)


def written_again(report: Report, problem: Problem, found: Evaluation, tables: Tables, folder: Path, seed: int) -> None:
    """The tables of the problem, written and read again, are the same problem; so is its pickle."""
    assert problem.source is not None
    text = text_of(problem.source)
    (folder / "again.toml").write_text(text, encoding="utf-8")
    again = taciturn.load(folder / "again.toml")
    if summary_of(again) != summary_of(problem):
        report.faults.append(Fault("written again", f"{summary_of(problem)}\n{summary_of(again)}"))
    changed = problem.changed({})
    if summary_of(changed) != summary_of(problem):
        report.faults.append(Fault("changed by nothing", f"{summary_of(problem)}\n{summary_of(changed)}"))
    parse(tables, "tables") if "function" not in problem.source["plant"] and ".csv" not in text else None


def summary_of(problem: Problem) -> str:
    """Return what identifies the policy of a problem: the fingerprint of its nodes, or its costs."""
    policy = problem.designed()
    if not isinstance(policy, taciturn.Policy):
        return f"{policy.kind} {policy.cost_all_time!r}"
    from taciturn.model.packets import fingerprint

    return f"{policy.kind} {fingerprint(policy, problem.network):016x} {policy.cost_all_time!r}"


def pickled(report: Report, problem: Problem, found: Evaluation, tables: Tables, folder: Path, seed: int) -> None:
    """Problem, policy and answer survive pickling."""
    if problem.nonlinear:
        raise SkippedError("a function of the user")
    again = pickle.loads(pickle.dumps(problem))
    if summary_of(again) != summary_of(problem):
        report.faults.append(Fault("pickled: problem", summary_of(again)))
    other = pickle.loads(pickle.dumps(found))
    if other.document() != found.document():
        report.faults.append(Fault("pickled: evaluation", ""))
    pickle.dumps(problem.designed())


def shown(report: Report, problem: Problem, found: Evaluation, tables: Tables, folder: Path, seed: int) -> None:
    """``show``, also as JSON, prints the problem; its JSON is strict."""
    for words in (("show",), ("show", "--json")):
        answer = run(words[0], str(folder / "problem.toml"), *words[1:])
        if answer.code:
            report.faults.append(Fault("shown: exit", f"{answer.code}: {answer.err}"))
        elif "--json" in words:
            json.loads(answer.out, parse_constant=lambda word: _refuse(report, word))
        elif re.search(r"\bnan\b|object at 0x", answer.out):
            report.faults.append(Fault("shown: text", answer.out))


def used(report: Report, problem: Problem, found: Evaluation, tables: Tables, folder: Path, seed: int) -> None:
    """Every other route accepts the problem, or refuses it by name with one sentence."""
    for route in ALSO:
        refusal = ROUTES[route](folder, seed)
        if refusal is not None and not is_sentence(refusal):
            report.faults.append(Fault(f"{route}: sentence", refusal))
        if refusal is not None:
            report.skipped[route] = refusal


def through_network(
    report: Report, problem: Problem, found: Evaluation, tables: Tables, folder: Path, seed: int
) -> None:
    """The nodes run as processes that exchange datagrams, or are refused by name with one sentence."""
    refusal = command("network", "--steps", "12", "--json")(folder, seed)
    if refusal is None:
        return
    if not is_sentence(refusal):
        report.faults.append(Fault("network: sentence", refusal))
    raise SkippedError(refusal)


def _refuse(report: Report, word: str) -> float:
    report.faults.append(Fault("shown: JSON", word))
    return 0.0


def by(work: Callable[[Problem, Evaluation, int, Path], str | None], name: str) -> Check:
    """Return the check of another interpreter."""

    def check(report: Report, problem: Problem, found: Evaluation, tables: Tables, folder: Path, seed: int) -> None:
        text = work(problem, found, seed, folder)
        if text is not None:
            report.faults.append(Fault(name, text))

    return check


CHECKS: dict[str, Check] = {
    "finite": finite,
    "ordered": ordered,
    "simulated": simulated,
    "kept on every path": kept_on_every_path,
    "written again": written_again,
    "pickled": pickled,
    "shown": shown,
    "used": used,
    **{name: by(work, name) for table in (CHEAP, COSTLY) for name, work in table.items()},
    "queues": by(same_queues, "queues"),
    "mutated": by(lambda problem, found, seed, folder: like_python(problem, seed, folder), "mutated"),
    "network": through_network,
    "lower bound": by(lambda problem, found, seed, folder: bounded_below(problem, seed, evaluated), "lower bound"),
}
EXPENSIVE: tuple[str, ...] = (*COSTLY, "mutated", "network", "lower bound")
