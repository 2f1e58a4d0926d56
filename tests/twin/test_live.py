"""Rounds for the live page: steps joined from logs, and the loop that sends every sample next to them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from twin.crews import crew

from taciturn.model.network import Network
from taciturn.problem import parse
from taciturn_twins.live import watch_twin
from taciturn_twins.mission import all_time
from taciturn_twins.page import Page
from taciturn_twins.steps import Steps
from taciturn_twins.trial import Setup, run_trial
from taciturn_udp.relay import losses

STEPS = 12


def write(folder: Path, name: str, lines: list[dict[str, Any]]) -> None:
    """Write the log of a process."""
    (folder / f"{name}.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def joined(folder: Path, network: Network, missing: int) -> tuple[list[dict[str, Any]], list[str]]:
    """Return rows and events of a loop that sends at each step, from logs without one picture that the link passes on.

    Commands arrive one step later than they are sent, as with a delay of one step.
    """
    fates, steps = losses(network, 4), range(STEPS)
    passed = {link: [k for k in steps if not fate.lost(k, k)] for link, fate in fates.items()}
    write(folder, "sensor", [{"tick": k, "sent_sensor": 1} for k in steps])
    write(folder, "controller", [{"tick": k, "sent_actuator": 1, "memory": {}, "degraded": 0} for k in steps])
    write(folder, "actuator", [{"tick": k, "arrived_actuator": [j for j in passed["actuator"] if j == k - 1]}
                               for k in range(STEPS + 1)])  # fmt: skip
    write(folder, "seen", [{"tick": k, "sequence": k, "seen": [0.0] if k != passed["sensor"][0] else None}
                           for k in passed["sensor"] if k != missing])  # fmt: skip
    rows: list[dict[str, Any]] = []
    events: list[str] = []

    def show(row: dict[str, Any], found: list[str]) -> None:
        rows.append(row)
        events.extend(f"{row['tick']}: {event}" for event in found)

    joins = Steps(network, Setup(seed=4), 0.1, show)
    joins.start(folder)
    for k in steps:
        joins.add({"tick": k, "from": [0.0], "u": [0.0], "cost": 0.5})
    assert len(rows) == STEPS - 2
    joins.finish()
    return rows, events


def test_designed_drops_are_counted_and_others_are_events(tmp_path: Path) -> None:
    """The links' model tells them apart; a missing marker is an event; packets are matched by number, not by step."""
    network = Network("udp", actuator_loss=0.3, sensor_loss=0.3, delay=1)
    fates = losses(network, 4)
    expected = {link: [fate.lost(k, k) for k in range(STEPS)] for link, fate in fates.items()}
    missing = max(k for k in range(STEPS) if not expected["sensor"][k])
    rows, events = joined(tmp_path, network, missing)
    assert [row["packets"] for row in rows] == [{"sensor": k + 1, "actuator": k + 1} for k in range(STEPS)]
    for link, lost in expected.items():
        assert sum(lost) > 0
        assert [row["drops"][link] for row in rows] == np.cumsum(lost).tolist()
    assert [row["arrived"]["actuator"] for row in rows] == [int(not lost) for lost in expected["actuator"]]
    assert [row["cost"] for row in rows] == [0.5 * (k + 1) for k in range(STEPS)]
    first = expected["sensor"].index(False)
    assert events == [
        f"{first}: the picture shows no marker, so the estimator has no measurement",
        f"{missing}: a packet on the sensor link did not arrive in time, which is not a loss by design",
    ]


class AnyController(Page):
    """A page that keeps what it shows."""

    def __init__(self) -> None:
        """Start to serve."""
        self.rows: list[Any] = []
        self.others: list[Any] = []
        self.notes: list[str] = []
        super().__init__(("127.0.0.1", 0))

    def put(self, row: Any) -> None:
        """Keep a step."""
        super().put(row)
        self.rows.append(row)

    def compare(self, row: Any) -> None:
        """Keep a step of the other loop."""
        super().compare(row)
        self.others.append(row)

    def note(self, text: str, step: int | None = None) -> None:
        """Keep an event."""
        super().note(text, step)
        self.notes.append(text)


@pytest.mark.evidence
def test_a_round_and_the_loop_that_sends_every_sample_are_those_of_a_run() -> None:
    """Each shown step is that of the finished trial, and the other loop is bit-identical to it alone."""
    prepared, setup = crew("omni"), Setup(seed=2)
    with AnyController() as page:
        run = watch_twin(prepared, page, setup, speed=0.0, rounds=1)
    assert run is not None
    assert run.always is not None
    alone = run_trial(prepared, setup, all_time(parse(prepared.tables({}), "the mission")))
    assert run.always.poses.tobytes() == alone.poses.tobytes()
    assert run.always.costs.tobytes() == alone.costs.tobytes()
    for shown, trial in ((page.rows, run.trial), (page.others, run.always)):
        assert [row["state"] for row in shown] == trial.poses[0, :-1].tolist()
        np.testing.assert_allclose([row["cost"] for row in shown], np.cumsum(trial.costs[0]), rtol=1e-12)
        for link, sent in trial.sent.items():
            assert [row["packets"][link] for row in shown] == np.cumsum(sent[0]).tolist()
    for link, arrived in run.trial.arrived.items():
        assert [row["arrived"][link] for row in page.rows] == arrived[0].tolist()
        assert page.rows[-1]["drops"][link] == (run.trial.sent[link] - arrived).sum()
    assert page.notes == []
