"""Workers of a sweep that are gone, and what is no executor."""

from __future__ import annotations

import logging
import threading
import time
from concurrent.futures import Executor, Future
from typing import Any

import pytest

from taciturn import ProblemError, load, sweep
from taciturn_studies import points
from taciturn_studies.workers import deserted
from taciturn_sweep.cluster import dask_workers


@pytest.mark.evidence
def test_a_dask_client_is_no_executor_and_its_workers_may_go() -> None:
    """Of a scheduler without workers its address is known; the client's own messages are silenced."""
    distributed: Any = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL
        ) as cluster,
        dask_workers(cluster.scheduler_address) as executor,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        assert not logging.getLogger("distributed.client").isEnabledFor(logging.ERROR)
        assert deserted(executor) is None
        with pytest.raises(
            ProblemError,
            match=r"executor is a Client; expected an Executor, such as the one that its method get_executor",
        ):
            sweep(load("two-mass-lqg"), {"theta": [0.1]}, executor=client, steps=2000)
        cluster.scale(0)
        last = time.monotonic() + 30
        while client.nthreads() and time.monotonic() < last:
            time.sleep(0.05)
        assert deserted(executor) == cluster.scheduler_address


class Late(Executor):
    """Gives its answers back after a while."""

    def submit(self, fn: Any, /, *args: Any, **_: Any) -> Future[Any]:
        """Answer half a second later."""
        future: Future[Any] = Future()
        threading.Timer(0.5, lambda: future.set_result(fn(*args))).start()
        return future


def test_workers_that_are_gone_are_told_of_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """However long that lasts; the sweep continues when there is one again."""
    monkeypatch.setattr(points, "PATIENCE", 0.05)
    monkeypatch.setattr(points, "deserted", lambda executor: "tcp://there:1")
    assert sweep(load("two-mass-lqg"), {"theta": [0.1]}, executor=Late(), steps=2000).cost.size == 1
    assert caplog.messages == ["no workers at tcp://there:1: waiting for one"]
