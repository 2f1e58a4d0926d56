"""The workers of the page: what is no longer wanted stops, and a worker that dies is replaced."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from taciturn.errors import ProblemError
from taciturn.extend import Array, watched
from taciturn.lqg.quadratic import Quadratic
from taciturn_explore.answers import Answers
from taciturn_explore.session import Sessions
from taciturn_explore.work import AT_ONCE, LATER, Pool, Stopped

LONG = "problem=two-mass&policy.theta=0.0521"  # its lower bound takes most of a second
UNSTABLE = "problem=two-mass-continuous&policy.period=1000"  # rounding hides the modes of the plant
PATIENCE = 60.0


@pytest.fixture(scope="module")
def pool() -> Iterator[Pool]:
    """Return two workers."""
    pool = Pool()
    yield pool
    pool.close()


def processes() -> set[int]:
    """Return the processes that this one has started."""
    import multiprocessing

    return {process.pid for process in multiprocessing.active_children() if process.pid is not None}


@pytest.mark.evidence
def test_a_job_that_is_no_longer_wanted_stops(pool: Pool) -> None:
    """It stops when the library next checks the time, and its worker answers another job."""
    pool.submit("a", "settle", "problem=two-mass", {}, {}).result(PATIENCE)
    running = pool.submit("a", "point", "problem=pid-tank&policy.theta=0.1234", True)
    while not running.running():
        time.sleep(0.002)
    running.drop()
    with pytest.raises(Stopped):
        running.result(PATIENCE)
    assert pool.submit("b", "settle", "problem=two-mass", {}, {}).result(PATIENCE)["name"] == "two-mass"
    assert pool.restarts == 0


def test_periodic_control_over_several_links_stops_within_a_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between two checks of the time, its Riccati equation takes at most the steps of one cycle."""
    steps, seen, back = 0, list[int](), Quadratic.back

    def counted(self: Quadratic, K: Array) -> tuple[Array, Array]:
        nonlocal steps
        steps += 1
        return back(self, K)

    def stop() -> None:
        seen.append(steps)
        if steps > 500:
            raise Stopped

    monkeypatch.setattr(Quadratic, "back", counted)
    with pytest.raises(Stopped), watched(stop):
        Answers().timed("problem=quadruple-tank", 0.5)
    assert max(np.diff(seen)) < 50


@pytest.mark.evidence
def test_a_worker_that_dies_is_replaced_and_its_job_says_so(pool: Pool) -> None:
    """All workers are killed; the jobs that follow are answered by new ones, also that of an idle worker."""
    job = pool.submit("a", "bound", LONG)
    while not job.running():
        time.sleep(0.002)
    before = processes()
    for process in before:
        os.kill(process, signal.SIGKILL)
    while before & processes():  # a kill takes effect a little later
        time.sleep(0.002)
    with pytest.raises(ProblemError, match="has ended"):
        job.result(PATIENCE)
    for rank in (AT_ONCE, LATER):  # of jobs of the worker that was idle, and of the other one
        assert pool.submit("a", "settle", "problem=two-mass", {}, {}, rank=rank).result(PATIENCE)["controls"]
    assert not before & processes()


def test_an_infeasible_setting_has_the_sentence_of_the_library(pool: Pool) -> None:
    """It reaches the caller as an error of the library."""
    with pytest.raises(ProblemError, match=r"policy\.theta is -1; expected 0 ≤ theta"):
        pool.submit("a", "point", "problem=two-mass&policy.theta=-1.0", False).result(PATIENCE)


def test_a_loop_that_is_unstable_is_told_from_bad_input(pool: Pool) -> None:
    """The page shows the one as a setting without numbers, and refuses the other."""

    async def refused(text: str) -> dict[str, Any]:
        return [one async for one in Sessions(pool).answers({"client": "c", "text": text})][-1]

    for text, unstable in (("problem=two-mass&policy.theta=-1", False), (UNSTABLE, True)):
        found = asyncio.run(refused(text))
        assert (found["answer"], found["unstable"]) == ("refused", unstable)
        assert found["sentence"]


@pytest.mark.evidence
def test_a_new_setting_ends_the_answers_of_the_former_one(pool: Pool) -> None:
    """Each answer names its setting, and the first stream ends when the second one of the client begins."""

    async def run() -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        sessions, first, second = Sessions(pool), list[dict[str, Any]](), list[dict[str, Any]]()
        former = sessions.answers({"client": "a", "text": "problem=two-mass"})
        async for one in former:
            first.append(one)
            if one["answer"] == "network":
                break

        async def rest() -> None:
            async for one in former:
                first.append(one)

        waiting = asyncio.ensure_future(rest())
        await asyncio.sleep(0)
        async for one in sessions.answers(
            {"client": "a", "text": "problem=two-mass", "changes": {"policy.theta": 0.3}}
        ):
            second.append(one)
            if one["answer"] == "kinds":
                break
        await asyncio.wait_for(waiting, PATIENCE)
        return first, second

    first, second = asyncio.run(run())
    assert [one["answer"] for one in first] == ["setting", "point", "response", "network"]
    assert {one["setting"] for one in first} == {"problem=two-mass"}
    assert {one["setting"] for one in second} == {"problem=two-mass&policy.theta=0.3"}
    names = [one["answer"] for one in second]
    assert names[:4] == ["setting", "point", "response", "network"]
    assert {"curve", "fair"} <= set(names)
    curve = next(one for one in reversed(second) if one["answer"] == "curve")
    shares = [one["share"] for one in curve["points"]]
    assert shares == sorted(shares)
    assert shares[0] < 0.05
    assert shares[-1] > 0.95
