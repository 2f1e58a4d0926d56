"""The other interpreters of a problem: nodes, saved states, worlds of faults, C, co-simulation units, records.

What runs in steps has one path that is computed by the loop, and every interpreter must give the same bits on it.
"""

from __future__ import annotations

import pickle
import shutil
import subprocess
from collections.abc import Callable, Mapping
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
from everything.toml import text_of

import taciturn
from taciturn.errors import ProblemError, TaciturnError
from taciturn.model.policy import Policy
from taciturn.nodes.simulated_plant import SimulatedPlant
from taciturn.problem import Problem
from taciturn.program.manual import operation_of
from taciturn.study.evaluation import Evaluation
from taciturn.study.record import decode, encode
from taciturn_worlds.world import run_world, run_world_with_devices

TICKS = 80
RARE = 0.05  # sends per step below which a link may well be silent for the 300 steps after which a world gives up
SANITIZED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


class SkippedError(TaciturnError):
    """A check does not exist for a problem; the text says why."""


def stepping(problem: Problem) -> Policy:
    """Return the policy of a problem that runs in steps."""
    policy = problem.designed()
    if not isinstance(policy, Policy):
        raise SkippedError("a policy without steps")
    return policy


def or_refused_if_late(problem: Problem, use: Callable[[], object]) -> None:
    """Use a problem; if its links are late at random, a refusal must name their delays, and skips the check."""
    try:
        use()
    except ProblemError as error:
        if not problem.network.late:
            raise
        if "delay" not in str(error):
            raise AssertionError(f"a refusal of random delays that does not name them: {error}") from None
        raise SkippedError(str(error)) from None


def same_bits_of_nodes(problem: Problem, found: Evaluation, seed: int, folder: Path) -> str | None:
    """Separate nodes that exchange packets decide as the loop, in every bit."""
    from runtime import late
    from runtime.loops import differing_ticks, record

    policy = stepping(problem)
    loop = problem.close(policy)
    if policy.prediction is not None:
        raise SkippedError("an actuator that predicts between steps")
    if policy.model.outputs > policy.model.sensed:
        return _set_points_as_packets(problem, policy, seed)
    ticks = min(TICKS, loop.horizon or TICKS)
    if problem.network.late:
        wrong, _ = late.differing_steps(loop, late.record(loop, ticks, seed))
        return f"nodes differ from the loop, with its delays, in the steps {wrong[:10]}" if wrong else None
    wrong, _ = differing_ticks(loop, *record(loop, ticks, seed))
    return f"nodes differ from the loop in the steps {wrong[:10]}" if wrong else None


def _set_points_as_packets(problem: Problem, policy: Policy, seed: int) -> str | None:
    """All nodes in one process get the set-points as an argument, and twice the same bits."""
    runs = []
    for _ in range(2):
        nodes = taciturn.Nodes(policy, problem.network, seed % 1000)
        plant = SimulatedPlant(problem.close(policy), seed)
        sensed, inputs = policy.model.sensed, []
        for _ in range(TICKS):
            y = plant.measurement
            u = nodes.step(y[:sensed], reference=y[sensed:])
            inputs.append(u.tobytes())
            plant.move(tuple(u.ravel()))
        runs.append(inputs)
    return None if runs[0] == runs[1] else "two runs of the nodes differ"


def saved_state(problem: Problem, found: Evaluation, seed: int, folder: Path) -> str | None:
    """Nodes that are pickled in the middle of a run, policy and all, go on with the same bits."""
    policy = stepping(problem)
    nodes = taciturn.Nodes(policy, problem.network, seed % 1000)
    plant = SimulatedPlant(problem.close(policy), seed)
    sensed = policy.model.sensed
    changing, operable = policy.model.outputs > sensed, operation_of(policy.in_units) is not None
    horizon = problem.cost.horizon or TICKS
    for tick in range(min(30, horizon)):
        if tick == min(12, horizon - 1):
            other = pickle.loads(pickle.dumps(nodes))
        y = plant.measurement
        told: dict[str, Any] = {"reference": y[sensed:]} if changing else {}
        if operable and 9 <= tick < 15:  # by hand, also while the nodes are pickled
            told["manual"] = [0.1] * policy.model.inputs
        u = nodes.step(y[:sensed], **told)
        if tick >= min(12, horizon - 1) and other.step(y[:sensed], **told).tobytes() != u.tobytes():
            return f"pickled nodes differ in step {tick}"
        if not np.isfinite(u).all():
            return f"the input of step {tick} is {u}"
        plant.move(tuple(u.ravel()))
    return None


def certified(problem: Problem, found: Evaluation, seed: int, folder: Path) -> str | None:
    """No path of the nodes costs more than they certify, nor than was promised, next to one with every sample."""
    policy = stepping(problem)
    if not policy.theory.silence:
        raise SkippedError("nodes that do not measure the cost of their silence")
    if problem.nonlinear or not problem.close(policy).nominal:
        raise SkippedError("another plant than that of the design")
    every = problem_with_every_sample(problem, policy, folder)
    promise = promise_of(policy, problem)
    runs = [Run(one, seed) for one in (problem, every)]
    for k in range(1, 1 + min(2 * TICKS, problem.cost.horizon or 2 * TICKS)):
        left, right = (sqrt(max(one.step(), 0.0)) for one in runs)
        if any(one.total for one in runs[1].nodes.silence):
            return "a link that must send in every step is silent"
        raised = sum(sqrt(max(one.total, 0.0)) for one in runs[0].nodes.silence)
        room = 1e-6 * (left + right) + 1e-9
        if abs(left - right) > raised + room:
            return f"step {k}: √J {left:.8g}, with every sample {right:.8g}, and the certificate {raised:.8g}"
        if promise is not None and left > right + promise * sqrt(k) + room:
            return f"step {k}: √J {left:.8g}, with every sample {right:.8g}, and the promise {promise * sqrt(k):.8g}"
    return None


def problem_with_every_sample(problem: Problem, policy: Policy, folder: Path) -> Problem:
    """Return the problem whose links must send in every step, and lose nothing; they are as late as before."""
    tables = {name: dict(table) if isinstance(table, Mapping) else table for name, table in problem.source.items()}
    waits = {link: problem.network.links[link].wait for link in policy.network.links}
    tables["links"] = {
        link: {"max_interval": 1, "delay": {"seconds": wait.seconds} if wait.seconds else wait.steps}
        for link, wait in waits.items()
    }
    tables.pop("network", None)
    tables["policy"] = {key: one for key, one in tables["policy"].items() if key != "joint"}
    (folder / "every.toml").write_text(text_of(tables), encoding="utf-8")
    return taciturn.load(folder / "every.toml")


def promise_of(policy: Policy, problem: Problem) -> float | None:
    """Return by how much √J may grow at most in each step by the promise of banks and thresholds, or None."""
    bound = policy.theory.guarantee
    if bound is None or problem.source["policy"].get("rule") == "relative" or "kappa" in problem.source["policy"]:
        return None
    whole, loop = policy.cost_all_time, problem.close(policy).problem
    off = loop.per_unit(0.0)
    raised = sqrt(bound.cost - off) - sqrt(whole - off)
    return raised * sqrt(loop.unit / loop.ticks)


class Run:
    """All nodes of a problem with a simulated plant, step by step."""

    def __init__(self, problem: Problem, seed: int) -> None:
        """Begin."""
        policy = problem.design()
        self.loop = problem.close(policy)
        self.nodes = taciturn.Nodes(policy, problem.network, seed % 1000)
        self.plant, self.sensed = SimulatedPlant(self.loop, seed), policy.model.sensed
        self.changing, self.cost = policy.model.outputs > self.sensed, 0.0

    def step(self) -> float:
        """Make a step, and return the cost up to now, without that of the noise between samples."""
        y = self.plant.measurement
        told: dict[str, Any] = {"reference": y[self.sensed :]} if self.changing else {}
        self.cost += self.plant.move(tuple(self.nodes.step(y[: self.sensed], **told).ravel()))
        return self.cost + self.plant.final_cost()


def recorded(problem: Problem, found: Evaluation, seed: int, folder: Path) -> str | None:
    """An answer that is written as text and read is the same answer."""
    again = decode(encode(found))
    return None if again.document() == found.document() else "the record of the answer differs"


def world_of_faults(problem: Problem, found: Evaluation, seed: int, folder: Path) -> str | None:
    """A world of faults in virtual time, some nodes in C: no invariant breaks."""
    stepping(problem)
    if problem.cost.mission:
        raise SkippedError("a horizon or a discount")
    if any(rate.value < RARE * (found.base_rate or 1.0) for rate in found.rates.values()):
        raise SkippedError("a link that may be silent for longer than a world waits")
    if problem.network.late:
        or_refused_if_late(problem, lambda: run_world(problem, seed % 10_000, []))
    run = run_world_with_devices(problem, seed % 10_000)
    if run.broken is None:
        return None
    if "no data packet was used" in run.broken:  # perhaps none was needed, as by a threshold that the start is far from
        free = run_world(problem, seed % 10_000, [])
        if free.broken is not None and "no data packet was used" in free.broken:
            raise SkippedError("a link that is silent for longer than a world waits, without faults too")
    return f"world {seed % 10_000}: {run.broken}; faults: {run.faults}"


def in_c(problem: Problem, found: Evaluation, seed: int, folder: Path) -> str | None:
    """The exported folder checks itself under the sanitizers of addresses and of undefined behaviour."""
    from export.devices import STRICT

    stepping(problem)
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        raise SkippedError("there is no C compiler")
    place = folder / "c"
    or_refused_if_late(problem, lambda: taciturn.export_c(problem, place))
    sources = sorted(map(str, place.glob("*.c")))
    options = [*STRICT, *SANITIZED, "-ffp-contract=off"]
    made = subprocess.run(
        [compiler, *options, *sources, "-lm", "-o", str(place / "check")], capture_output=True, text=True
    )
    if made.returncode:
        return f"the compiler refuses: {made.stderr[:2000]}"
    done = subprocess.run([str(place / "check")], capture_output=True, text=True, timeout=60)
    return f"exit code {done.returncode}: {(done.stdout + done.stderr)[-2000:]}" if done.returncode else None


def as_unit(problem: Problem, found: Evaluation, seed: int, folder: Path) -> str | None:
    """A co-simulation unit decides as the loop, in every bit."""
    try:
        from export.units import Instance, differing_ticks, make_unit, record
    except ImportError:
        raise SkippedError("FMPy is not installed") from None
    policy = stepping(problem)
    if shutil.which("cc") is None:
        raise SkippedError("there is no C compiler")
    loop = problem.close(policy)
    or_refused_if_late(problem, lambda: make_unit(loop, folder / "unit", seed=3))
    vector = record(loop, TICKS)
    instance = Instance(folder / "unit").start()
    wrong = differing_ticks(instance, loop, vector, range(len(vector.measured)))
    return f"the unit differs from the loop in the steps {wrong[:10]}" if wrong else None


CHEAP: Mapping[str, Callable[[Problem, Evaluation, int, Path], str | None]] = {
    "recorded": recorded,
    "nodes": same_bits_of_nodes,
    "saved state": saved_state,
    "certified": certified,
}
COSTLY: Mapping[str, Callable[[Problem, Evaluation, int, Path], str | None]] = {
    "world": world_of_faults,
    "C": in_c,
    "FMU": as_unit,
}
