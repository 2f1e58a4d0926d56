"""Traces, histograms and recorded packets; statistics; and the command as a user runs it."""

from __future__ import annotations

import json
import math
import os
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from cli.conftest import Run, command_of, run
from counts import few
from delays import samples
from drawn import over
from hypothesis import strategies as st
from study.test_pictures import overlapping

from taciturn.errors import ProblemError
from taciturn_delays.delays import MeasuredDelays, read_delays
from taciturn_delays.reading import LARGEST
from taciturn_delays.statistics import chance_of_runs, reordered

__all__ = ["command_of", "run"]
RECORDED = """\
time,step,link,event,delay,bytes,trigger
0.00,0,sensor,sent,,24,1.5
0.03,0,sensor,delivered,0.03,24,
0.10,1,sensor,sent,,24,1.2
0.10,1,sensor,lost,,24,
0.20,2,sensor,sent,,24,1.9
0.20,2,actuator,sent,,24,1.9
0.35,2,sensor,late,0.15,24,
0.22,2,actuator,delivered,0.02,24,
"""


def written(tmp_path: Path, text: str | bytes, name: str = "file.csv") -> Path:
    """Write a file."""
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.fixture
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for all examples of a law."""
    return tmp_path_factory.mktemp("law")


def test_a_written_trace_is_read_as_it_was(folder: Path) -> None:
    """With all digits, for any times of sending that begin at zero and any delays."""
    number = st.floats(0, 1e6, allow_nan=False)
    rows = st.lists(st.tuples(number, st.one_of(number, st.just(math.inf))), min_size=1, max_size=20)

    def same(rows: list[tuple[float, float]]) -> None:
        rows = [(0.0, 0.25), *sorted(rows, key=lambda row: row[0])]
        lines = (f"{sent!r},{'' if delay == math.inf else repr(delay)}" for sent, delay in rows)
        first = read_delays(written(folder, "\n".join(["sent,delay", *lines])))
        first.save_trace(folder / "again.csv")
        second = read_delays(folder / "again.csv")
        for found in (first, second):
            assert list(zip(found.sent.tolist(), found.delay.tolist(), strict=True)) == rows
        first.save_histogram(folder / "histogram.csv")
        rough = read_delays(folder / "histogram.csv")
        assert rough.lost == pytest.approx(first.lost, abs=1e-12)
        assert first.mean * (1 - 1e-9) <= rough.mean <= first.mean * 1.0101 + 1e-300

    over(same, 20, rows=rows)


def test_packets_of_a_run_are_those_of_one_link(tmp_path: Path) -> None:
    """Sent at the row of their step; a late packet has a delay. Outcomes alone give the same."""
    path = written(tmp_path, RECORDED)
    found = read_delays(path, link="sensor")
    np.testing.assert_allclose(found.sent, [0, 0.1, 0.2], atol=1e-12)
    np.testing.assert_allclose(found.delay, [0.03, np.inf, 0.15], atol=1e-12)
    assert found.assumption == "delays as the file states them"
    alone = "\n".join(line for line in RECORDED.splitlines() if ",sent," not in line)
    np.testing.assert_allclose(read_delays(written(tmp_path, alone), link="sensor").sent, found.sent, atol=1e-12)
    with pytest.raises(ProblemError, match="links sensor, actuator; expected one of them"):
        read_delays(written(tmp_path, RECORDED))
    with pytest.raises(ProblemError, match="the link 'level' has no packets"):
        read_delays(path, link="level")
    only = "\n".join(line for line in RECORDED.splitlines() if ",sent," in line or "time" in line)
    with pytest.raises(ProblemError, match="has only rows sent"):
        read_delays(written(tmp_path, only), link="sensor")
    with pytest.raises(ProblemError, match="event in line 3"):
        read_delays(written(tmp_path, RECORDED.replace("delivered", "arrived")), link="sensor")


def gilbert(packets: int, seed: int, bursty: bool) -> str:
    """Return a trace whose delays are correlated and whose losses are bursty, or neither."""
    draws = np.random.default_rng(seed)
    lost, level, rows = False, 0.0, ["sent,delay"]
    for k in range(packets):
        chance = (0.7 if lost else 0.02) if bursty else 0.0625  # stationary: 0.02/0.32
        lost = bool(draws.random() < chance)
        level = (0.9 if bursty else 0.0) * level + draws.standard_normal()
        rows.append(f"{0.1 * k:.1f}," + ("" if lost else f"{0.02 * math.exp(0.2 * level):.6f}"))
    return "\n".join(rows)


def test_dependence_between_packets_is_found(tmp_path: Path) -> None:
    """Correlation, share lost after a loss, and the exact test of runs; a note says that a histogram leaves it out."""
    found = read_delays(written(tmp_path, gilbert(4000, 1, True)))
    assert found.bursty
    assert found.loss_after_loss == pytest.approx(0.7, abs=0.1)
    assert found.loss_correlation == pytest.approx(0.68, abs=0.1)
    assert found.correlation == pytest.approx(0.9, abs=0.1)
    assert any("a trace keeps this" in note for note in found.notes)
    free = read_delays(written(tmp_path, gilbert(4000, 2, False)))
    assert free.bursty is False
    assert free.correlation == pytest.approx(0, abs=0.08)
    assert free.notes == ()


def test_the_test_of_runs_counts_all_places_of_the_losses() -> None:
    """By enumeration."""
    for packets, losses in ((7, 3), (8, 2), (6, 5), (9, 4)):
        counts = [
            1 + sum(b > a + 1 for a, b in zip(places[:-1], places[1:], strict=True))  # noqa: RUF007
            for places in combinations(range(packets), losses)
        ]
        for seen in range(1, losses + 1):
            share = sum(one <= seen for one in counts) / len(counts)
            assert chance_of_runs(packets, losses, seen) == pytest.approx(share, rel=1e-9)


def test_statistics_are_those_of_a_plain_computation(tmp_path: Path) -> None:
    """Quantiles are delays that occurred; those that need more packets are unknown."""
    draws = np.random.default_rng(5)
    delay = draws.exponential(0.03, 500)
    path = written(
        tmp_path, "\n".join(["sent,delay", *(f"{0.01 * k!r},{one!r}" for k, one in enumerate(delay.tolist()))])
    )
    found = read_delays(path)
    assert found.mean == pytest.approx(delay.mean())
    assert found.median == np.quantile(delay, 0.5, method="inverted_cdf")
    assert found.quantile_90 == np.quantile(delay, 0.9, method="inverted_cdf")
    assert found.quantile_99 == np.quantile(delay, 0.99, method="inverted_cdf")
    assert found.quantile_999 is None
    assert "unknown, since fewer than 1,000 packets" in str(found)
    arrival = 0.01 * np.arange(500) + delay
    overtaken = [any(arrival[k + 1 :] < arrival[k] - 1e-9) for k in range(500)]
    assert found.reordered == pytest.approx(np.mean(overtaken))
    assert reordered(np.array([3.0, np.inf, 2.0, 2.5])) == 1


def test_a_histogram_has_shares_and_no_order(tmp_path: Path) -> None:
    """The rest is lost; a trace cannot be made of it."""
    found = read_delays(written(tmp_path, "milliseconds;probability\n5;0,5\n20;0,25\n"))
    assert (found.lost, found.packets, found.bursty, found.correlation) == (0.25, None, None, None)
    assert (found.mean, found.median, found.quantile_99) == (pytest.approx(0.010), 0.005, 0.020)
    with pytest.raises(ProblemError, match="order of packets"):
        found.save_trace(tmp_path / "trace.csv")
    with pytest.raises(ProblemError, match=r"have the sum 1\.5"):
        read_delays(written(tmp_path, "milliseconds,probability\n5,1.5\n"))


def test_delays_of_a_histogram_are_rounded_up_to_three_digits(tmp_path: Path) -> None:
    """So no delay becomes smaller, and a second time changes nothing."""
    found = read_delays(written(tmp_path, "sent,delay\n0,0.0123401\n1,0.0124\n2,0\n3,0.0998999999\n4,0.001\n"))
    found.save_histogram(tmp_path / "h.csv")
    assert (tmp_path / "h.csv").read_text().split() == [
        "milliseconds,probability", "0.0,0.2", "1.0,0.2", "12.4,0.4", "99.9,0.2",
    ]  # fmt: skip
    read_delays(tmp_path / "h.csv").save_histogram(tmp_path / "again.csv")
    assert (tmp_path / "again.csv").read_text() == (tmp_path / "h.csv").read_text()


def test_the_command_prints_and_writes(run: Run, tmp_path: Path) -> None:
    """The assumption is in the verdict; JSON has every number."""
    path, out = written(tmp_path, samples.LINUX, "ping.txt"), tmp_path / "trace.csv"
    answer = run("delays", str(path), "--out", str(out), "--histogram", str(tmp_path / "h.csv"))
    assert answer.code == 0
    assert "assumed symmetric: half the round trip" in " ".join(answer.out.partition("\n\n")[0].split())
    assert 'delay = {trace = "' in answer.out
    rows = out.read_text(encoding="utf-8").splitlines()
    assert rows[:4] == ["sent,delay", "0.0,0.002105", "1.0,0.00251", "2.0,"]
    document = json.loads(run("delays", str(path), "--json", "--round-trip", "whole").out)
    assert (document["packets"], document["quantile_90"], document["duplicates"]) == (7, None, 1)
    assert document["largest"] == pytest.approx(0.00502)
    assert "offset" not in document
    assert json.loads(run("delays", str(out), "--json").out)["lost"] == pytest.approx(3 / 7)


@pytest.mark.parametrize(
    "text", few([samples.MAC, gilbert(2500, 3, True), "milliseconds,probability\n5,0.5\n20,0.25\n"], 1)
)
def test_the_figure_is_legible(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    """Shares of delays, and delays over time if they have an order."""
    found = read_delays(written(tmp_path, text))
    figure = found.plot()
    assert overlapping(figure, monkeypatch) == []
    assert len(figure.axes) == (1 if found.packets is None else 2)


REFUSED = {  # text of the file, options, words
    "empty": ("", [], "is empty"),
    "blank": (" \n\n", [], "is empty"),
    "another": ("[plant]\nA = [[1.0]]\n", [], "its form is not recognised"),
    "picture": (b"\x89PNG\r\n\x1a\n\0\0", [], "is binary"),
    "pcap": (b"\xd4\xc3\xb2\xa1\2\0\4\0", [], "export them by tshark"),
    "gzip": (b"\x1f\x8b\x08\0", [], "is compressed"),
    "letters": ("sent,delay\n0,0.1 s\n".encode("latin-1") + b"\xe9", [], "not UTF-8 text"),
    "no rows": ("sent,delay\n", [], "has a heading and no rows"),
    "nan": ("sent,delay\n0,0.1\n1,nan\n", [], "delay in line 3"),
    "inf": ("sent,delay\n0,inf\n", [], "empty cell for a dropped packet"),
    "negative": ("sent,delay\n0,-0.1\n", [], "expected a number from 0 to 1e+12"),
    "huge": ("sent,delay\n0,1e999\n", [], "is '1e999'"),
    "digits": ("sent,delay\n0,١\n", [], "expected a number from"),
    "unit": ("sent,delay\n0,12 ms\n", [], "is '12 ms'"),
    "comma": ("sent,delay\n0,0,1\n", [], "with decimal commas separate the columns by semicolons"),
    "quote": ('sent,delay\n0,"0.1\n', [], "is no row"),
    "twice": ("sent,delay,delay\n0,1,1\n", [], "has a name twice"),
    "all lost": ("sent,delay\n0,\n1,\n", [], "are lost; expected at least one"),
    "kind": ("sent,delay\n0,1\n", ["--kind", "pong"], "--kind is 'pong'"),
    "wrong kind": ("a,b\n0,1\n", ["--kind", "trace"], "does not have the column 'sent'"),
    "part": (samples.MAC, ["--round-trip", "third"], "expected one of the words 'half', 'whole'"),
    "least": (samples.MAC, ["--least", "0.01"], "two computers"),
    "link": (samples.MAC, ["--link", "sensor"], "--link is 'sensor'"),
    "interval": (samples.MAC, ["--interval", "-1"], "expected 0 < --interval"),
    "trace of a histogram": ("milliseconds,probability\n1,1\n", ["--out", "t.csv"], "order of packets"),
    "ending": (samples.MAC, ["--out", "trace.txt"], "for the trace ends in '.txt'"),
    "itself": ("sent,delay\n0,1\n", ["--out", "file.csv"], "would replace the file that is read"),
    "same": (samples.MAC, ["--out", "t.csv", "--histogram", "t.csv"], "different file names"),
    "two files": (samples.MAC, [], "captures"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_bad_file_is_one_sentence(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """With exit code 2, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    text, options, words = REFUSED[name]
    path = written(tmp_path, text)
    before = set(tmp_path.iterdir())
    answer = run("delays", str(path.name), *(["file.csv"] if name == "two files" else []), *options)
    assert any(one in answer.sentence for one in words.split("|"))
    assert "; expected" in answer.sentence or "expected" in answer.sentence
    assert set(tmp_path.iterdir()) == before


def test_what_is_no_file_is_refused(run: Run, tmp_path: Path) -> None:
    """A folder, a pipe, a missing file, and one that is too large."""
    paths = [tmp_path, tmp_path / "missing"]
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        paths.append(tmp_path / "pipe")
    with (tmp_path / "large").open("wb") as file:
        file.truncate(LARGEST + 1)
    for path in (*paths, tmp_path / "large"):
        assert "cannot be read" in run("delays", str(path)).sentence


def test_times_out_of_order_are_sorted_and_noted(tmp_path: Path) -> None:
    """And the first time of sending is zero."""
    found = read_delays(written(tmp_path, "Sent\tDelay\textra\n5.5\t0.1\tx\n4.5\t0.2\t\n4.75\t\t\n"))
    assert isinstance(found, MeasuredDelays)
    assert found.sent.tolist() == [0, 0.25, 1]
    assert found.delay.tolist() == [0.2, math.inf, 0.1]
    assert any("before that of the line above" in note for note in found.notes)
