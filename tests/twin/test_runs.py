"""Short runs of both twins in lockstep: processes, datagrams, rendered pictures, image processing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from twin.crews import short_mission, stand_in

from taciturn._arrays import Array
from taciturn.problem import load
from taciturn_twins.faults import parse_fault
from taciturn_twins.outcome import Trial
from taciturn_twins.record import write_record
from taciturn_twins.run import TwinRun, run_twin
from taciturn_twins.trial import Setup
from taciturn_udp.namespaces import kernel_losses, predict_drops
from taciturn_udp.relay import losses

TICKS = {"rover": 20, "omni": 15}


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory) -> TwinRun:
    """Return a run of the rover in which nothing goes wrong."""
    file = short_mission("rover", TICKS["rover"], tmp_path_factory.mktemp("quiet"))
    return run_twin(stand_in("rover"), Setup(seed=3), file=file, compare=False)


def accounted(trial: Trial) -> None:
    """Check that every datagram is: what is sent is delivered or lost, and no socket knows of others."""
    assert trial.datagrams["unaccounted"] == 0
    for name in ("questions", "sensor", "actuator"):
        counted = trial.datagrams[name]
        assert counted["sent"] == counted["delivered"] + counted["lost"]
    for link, sent in trial.sent.items():
        arrived = trial.arrived[link]
        assert arrived.sum() == trial.datagrams[link]["delivered"]
        assert (arrived <= sent).all()
    unanswered = trial.datagrams["questions"]["unanswered"]
    assert trial.datagrams["questions"]["delivered"] - unanswered == trial.datagrams["sensor"]["sent"]


def bits(trial: Trial) -> tuple[bytes, ...]:
    """Return all numbers of a trial, bit for bit."""
    parts: tuple[Array, ...] = (trial.poses, trial.inputs, trial.costs, trial.estimates, trial.seen, trial.lights)
    return tuple(part.tobytes() for part in (*parts, *trial.sent.values(), *trial.arrived.values()))


@pytest.mark.evidence
def test_the_rover_is_driven_by_pictures_that_are_asked_for(tmp_path: Path, quiet: TwinRun) -> None:
    """It asks by the schedule of its policy, sees within millimetres, and repeats bit for bit, also next to another."""
    file = short_mission("rover", TICKS["rover"], tmp_path)
    run = run_twin(stand_in("rover"), Setup(runs=2, seed=3), file=file, compare=False)
    accounted(run.trial)
    schedule = run.policy.schedule
    assert schedule is not None
    assert (run.trial.sent["sensor"] == schedule.queries).all()
    assert run.trial.poses[:, -1, 0].max() < 0.5
    assert abs(run.trial.vision).max() < 5e-3
    assert bits(quiet.trial) == bits(_first(run.trial))
    assert not np.array_equal(run.trial.poses[0], run.trial.poses[1])
    _written(run, tmp_path)


def _first(trial: Trial) -> Trial:
    from dataclasses import replace

    names = ("poses", "inputs", "costs", "estimates", "seen", "lights")
    marks = {name: {link: one[:1] for link, one in getattr(trial, name).items()} for name in ("sent", "arrived")}
    return replace(trial, **{name: getattr(trial, name)[:1] for name in names}, **marks)


def _written(run: Any, folder: Path) -> None:
    """Check the record and the document of a run."""
    import xarray

    write_record(run, folder / "run.nc")
    with xarray.open_dataset(folder / "run.nc", engine="h5netcdf") as kept:
        xarray.testing.assert_identical(kept.drop_attrs(), run.to_dataset().drop_attrs())
        document = json.loads(kept.attrs["document"])
    assert document == json.loads(json.dumps(run.document(), allow_nan=False))
    expected = {"rates", "cost", "cost_all_time", "cost_bound", "vision", "datagrams", "seconds"}
    assert expected <= document.keys()
    assert document["rates"].keys() == {"sensor", "actuator"}
    assert len(run.plot().axes) == 3


@pytest.mark.evidence
def test_the_omni_follows_its_path_over_links_that_lose_what_is_foretold(tmp_path: Path) -> None:
    """Relays lose the packets that the seed says, of each robot its own; the robot stays near its path all the same."""
    prepared, file = stand_in("omni"), short_mission("omni", TICKS["omni"], tmp_path)
    run = run_twin(prepared, Setup(runs=2, seed=5), file=file, compare=False)
    trial = run.trial
    accounted(trial)
    fates = losses(load(file).network, 5)
    for link, sent in trial.sent.items():
        for loop, row in enumerate(sent):
            ticks = np.flatnonzero(row)
            foretold = [number for number, tick in enumerate(ticks) if not fates[link].lost(number, tick, loop)]
            assert list(trial.sequences[link][loop]) == foretold
    assert trial.datagrams["sensor"]["lost"] > 0
    assert trial.problem.reference is not None
    assert np.hypot(*(trial.poses - trial.problem.reference.states)[..., :2].T).max() < 0.3


@pytest.mark.evidence
@pytest.mark.usefixtures("kernel")
def test_what_nftables_lose_is_foretold_packet_for_packet(tmp_path: Path) -> None:
    """Pictures of many fragments and commands of a few bytes: what comes is what the rule's hash lets through."""
    prepared, file = stand_in("omni"), short_mission("omni", TICKS["omni"], tmp_path, price=0.0)
    trial = run_twin(prepared, Setup(seed=1, namespaces=True), file=file, compare=False).trial
    accounted(trial)
    for link, loss in kernel_losses(load(file).network, 1).items():
        dropped = predict_drops(loss.seed, loss.permille, range(int(trial.sent[link].sum())))
        assert list(trial.sequences[link][0]) == np.flatnonzero(~dropped).tolist()
        assert trial.datagrams[link]["as_predicted"]
        assert dropped.any()


@pytest.mark.evidence
def test_what_goes_wrong_does_and_is_told(tmp_path: Path, quiet: TwinRun) -> None:
    """A dead camera, a covered marker, a dead link, a kidnap, a node that is killed: none of them ends the run."""
    prepared, file = stand_in("rover"), short_mission("rover", TICKS["rover"], tmp_path)
    asked = np.flatnonzero(quiet.trial.sent["sensor"][0])
    dead, covered = 0.3 * asked[:2]
    texts = (f"camera@{dead}+0.3", f"cover@{covered}+0.3", "actuator@0+0.3", "kidnap@4.2=0.1", "controller@3")
    run = run_twin(prepared, Setup(seed=3, faults=tuple(map(parse_fault, texts))), file=file, compare=False)
    trial = run.trial
    assert (asked == np.flatnonzero(trial.sent["sensor"][0])).all()
    assert trial.datagrams["questions"]["unanswered"] == 1
    assert trial.datagrams["sensor"]["unseen"] == 1
    assert not np.isfinite(trial.seen[0, asked[:2]]).any()
    assert np.isfinite(trial.seen[0, asked[2:]]).all()
    assert any("no marker" in note for note in trial.notes)
    assert trial.arrived["actuator"][0, 0] == 0 < trial.sent["actuator"][0, 0]
    assert trial.inputs[0, 0, 0] == 0.0  # the robot stands until the next packet comes
    step = np.diff(trial.poses[0, :, 0])
    assert step[13] - step[12] == pytest.approx(0.1, abs=0.05)  # pushed aside within a step
    assert run.cost_bound is None
    assert quiet.cost_bound is not None
