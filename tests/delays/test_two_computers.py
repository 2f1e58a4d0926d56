"""Offset and drift of the times of two computers, against a linear programme and against synthetic measurements."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from delays.samples import START, capture
from drawn import over
from hypothesis import strategies as st
from scipy.optimize import linprog

from taciturn.errors import ProblemError
from taciturn_delays.delays import read_delays
from taciturn_delays.envelope import lower_line

OFFSET, DRIFT, LEAST = -3.75, 42e-6, 0.004  # seconds, and 42 ppm


def measured(seed: int, packets: int = 2000, wrap: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    """Return times of sending, delays (infinite if lost), times of reception, and identities that repeat."""
    draws = np.random.default_rng(seed)
    sent = 0.05 * np.arange(packets) + draws.uniform(0, 0.01, packets)
    delay = LEAST + draws.exponential(0.01, packets)
    delay[draws.random(packets) < 0.05] = np.inf
    received = sent + delay
    return sent, delay, received + OFFSET + DRIFT * received, [f"0x{k % wrap:04x}" for k in range(packets)]


def written(tmp_path: Path, seed: int, shuffle: bool = True) -> tuple[Path, Path, np.ndarray]:
    """Write captures of both computers, the receiver's in the order of reception and with a copy of a packet."""
    sent, delay, received, names = measured(seed)
    there = np.flatnonzero(np.isfinite(delay))
    order = there[np.argsort(received[there])] if shuffle else there
    times, keys = [*received[order].tolist(), received[order[-1]] + 1e-3], [names[i] for i in [*order, order[-1]]]
    for name, text in (("a.csv", capture(sent.tolist(), names)), ("b.csv", capture(times, keys))):
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path / "a.csv", tmp_path / "b.csv", delay


def test_offset_drift_and_delays_are_recovered(tmp_path: Path) -> None:
    """The error of the drift is at most that which the smallest delays allow; the constant part is as stated."""
    first, second, delay = written(tmp_path, 1)
    found = read_delays(first, second, least=LEAST)
    lost = ~np.isfinite(delay)
    assert (np.isinf(found.delay) == lost).all()
    # of 475 delays in a quarter of 25 s, the smallest exceeds the least by 0.3 ms with a probability of 1e-6
    assert found.drift == pytest.approx(DRIFT, abs=0.3e-3 / 50)
    np.testing.assert_allclose(found.delay[~lost], delay[~lost], atol=1e-3)
    assert found.offset == pytest.approx(OFFSET, abs=1e-3)
    assert (found.duplicates, found.lost) == (1, lost.mean())
    assert "two computers" in found.assumption
    assert any("cannot be known" in note for note in found.notes)
    assert found.smallest == pytest.approx(LEAST, abs=1e-12)
    assert read_delays(first, second).smallest == pytest.approx(0, abs=1e-12)


@st.composite
def points(draw: st.DrawFn) -> tuple[list[float], list[float]]:
    """Return times, two of them different, and differences of times."""
    size = draw(st.integers(2, 12))
    grid = st.integers(0, 40)
    times = sorted(draw(st.lists(grid, min_size=size, max_size=size).filter(lambda one: len(set(one)) > 1)))
    return [t / 4 for t in times], [v / 8 for v in draw(st.lists(st.integers(-40, 40), min_size=size, max_size=size))]


def best_below(given: tuple[list[float], list[float]]) -> None:
    """The line is below all points, and its value at the mean time is that of the linear programme."""
    times, values = map(np.array, given)
    line = lower_line(times, values)
    assert (values - line.at(times) >= -1e-9).all()
    middle = times.mean()
    limits = np.column_stack([np.ones(len(times)), times])
    program = linprog([-1, -middle], A_ub=limits, b_ub=values, bounds=[(None, None)] * 2)
    assert line.offset + line.drift * middle == pytest.approx(-program.fun, abs=1e-7)


def test_the_line_solves_the_linear_programme() -> None:
    """Computed by scipy without a hull."""
    over(best_below, 25, given=points())


def test_a_smaller_quarter_of_delays_is_noted(tmp_path: Path) -> None:
    """After a step of the time of the receiver by 0.2 s, no line fits."""
    sent, _, received, names = measured(2)
    received = np.where(np.isfinite(received), received, sent + 0.02) + 0.2 * (sent > 60)
    for name, times in (("a.csv", sent), ("b.csv", received)):
        (tmp_path / name).write_text(capture(times.tolist(), [f"{k}{one}" for k, one in enumerate(names)]))
    found = read_delays(tmp_path / "a.csv", tmp_path / "b.csv")
    assert any("was adjusted" in note for note in found.notes)
    quiet = read_delays(*written(tmp_path, 3)[:2])
    assert not any("was adjusted" in note or "is more than that of computers" in note for note in quiet.notes)


def test_identities_that_name_no_packet_are_refused(tmp_path: Path) -> None:
    """As ip.id of systems that set it to 0, or one that repeats within the variation of the delays."""
    sent = [0.01 * k for k in range(200)]
    (tmp_path / "a.csv").write_text(capture(sent, ["0x0000"] * 200))
    (tmp_path / "b.csv").write_text(capture([one + 0.02 for one in sent], ["0x0000"] * 200))
    with pytest.raises(ProblemError, match="have only 1 value"):
        read_delays(tmp_path / "a.csv", tmp_path / "b.csv")
    names = [str(k % 20) for k in range(200)]
    late = [one + (0.02 if k % 2 else 0.15) for k, one in enumerate(sent)]
    (tmp_path / "a.csv").write_text(capture(sent, names))
    (tmp_path / "b.csv").write_text(capture(late, names))
    with pytest.raises(ProblemError, match=r"repeat after 0\.2 s"):
        read_delays(tmp_path / "a.csv", tmp_path / "b.csv")
    (tmp_path / "b.csv").write_text(capture(late, [f"x{one}" for one in names]))
    with pytest.raises(ProblemError, match=r"has the same ip\.id"):
        read_delays(tmp_path / "a.csv", tmp_path / "b.csv")
    (tmp_path / "b.csv").write_text(capture(late, names, "rtp.seq"))
    with pytest.raises(ProblemError, match="no common field"):
        read_delays(tmp_path / "a.csv", tmp_path / "b.csv")


def test_one_capture_pairs_requests_with_answers(tmp_path: Path) -> None:
    """By the same number from another address; a request without an answer is lost."""
    rows = ["0.000;7;a", "0.008;7;b", "0.100;8;a", "0.200;9;a", "0.230;9;b", "0.231;9;b", "0.300;7;a", "0.304;7;b"]
    text = "\r\n".join(["frame.time_epoch;coap.mid;ip.src", *(f"17000{START % 100:05d}{one[1:]}" for one in rows)])
    path = tmp_path / "one.csv"
    path.write_text("\ufeff" + text, encoding="utf-8")
    found = read_delays(path)
    np.testing.assert_allclose(found.delay, [0.004, np.inf, 0.015, 0.002], atol=1e-9)
    np.testing.assert_allclose(found.sent, [0, 0.1, 0.2, 0.3], atol=1e-9)
    assert (found.duplicates, found.assumption) == (1, "assumed symmetric: half the round trip")
    with pytest.raises(ProblemError, match="in common"):
        read_delays(path.with_name(Path(capture_without_number(tmp_path)).name))


def capture_without_number(tmp_path: Path) -> Path:
    """Write a capture whose only field differs between a request and its answer."""
    path = tmp_path / "without.csv"
    path.write_text(capture([0.0, 0.1], ["0x1", "0x2"]))
    return path


MESSAGES = [  # times of sending and of reception in seconds, and numbers; 3 is missing, and 4 arrives twice
    (0.0, 0.05, 1), (1.0, 1.06, 2), (3.0, 3.05, 4), (3.0, 3.25, 4), (4.0, 4.09, 5), (5.0, 5.05, 6),
]  # fmt: skip
FORMS = {
    "number before": '{end:.9f} {{"sent": {begin:.6f}, "seq": {k}}}',
    "topic, milliseconds": '{end:.9f} plant/y {{"y": 1.5, "ts": {milliseconds}, "seq": {k}}}',
    "in the message": '{{"tst": "{date}", "topic": "y", "qos": 0, "payload": {{"sent": {begin:.6f}, "seq": {k}}}}}',
    "in quotes": '{{"tst": "{date}", "qos": 0, "payload": "{{\\"sent\\": {begin:.6f}, \\"seq\\": {k}}}"}}',
    "table": "{begin:.6f},{end:.6f},{k}",
    "decimal commas": "{commas};{k}",
}


def message(form: str, begin: float, end: float, k: int) -> str:
    """Write one message."""
    date = f"2023-11-14T22:13:{20 + int(end):02d}.{round(end % 1 * 1e6):06d}Z+0000"
    begin, end = START + begin, START + end
    commas = f"{begin:.6f};{end:.6f}".replace(".", ",")
    return FORMS[form].format(begin=begin, end=end, milliseconds=round(1000 * begin), date=date, k=k, commas=commas)


@pytest.mark.parametrize("form", FORMS)
def test_messages_are_read_in_every_form(tmp_path: Path, form: str) -> None:
    """The missing number is lost, and the second copy a duplicate; units and notations do not matter."""
    head = {"table": ["sent,received,seq"], "decimal commas": ["sent;received;seq"]}.get(form, [])
    path = tmp_path / "log.txt"
    path.write_text("\n".join([*head, *(message(form, *one) for one in MESSAGES)]), encoding="utf-8")
    found = read_delays(path, synchronised=True)
    np.testing.assert_allclose(found.delay, [0.05, 0.06, np.inf, 0.05, 0.09, 0.05], atol=2e-6)
    np.testing.assert_allclose(found.sent, range(6), atol=2e-6)
    assert found.duplicates == 1
    compared = read_delays(path, least=0.05)
    np.testing.assert_allclose(compared.delay, found.delay, atol=4e-6)
    assert compared.offset == pytest.approx(0, abs=4e-6) and abs(compared.drift or 0) < 1e-5  # noqa: PT018


def test_times_since_the_start_of_a_device_need_a_unit(tmp_path: Path) -> None:
    """Its milliseconds are refused as seconds, and accepted as what they are; a dotted name finds them."""
    path = tmp_path / "log.txt"
    lines = [
        json.dumps({"tst": START + end + 0.25, "payload": {"t": 9e4 + 1000 * begin}}) for begin, end, _ in MESSAGES
    ]
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(ProblemError, match="does not have the time of sending"):
        read_delays(path)
    with pytest.raises(ProblemError, match="the unit of the times of sending"):
        read_delays(path, sent="payload.t")
    found = read_delays(path, sent="payload.t", unit="ms")
    assert found.largest == pytest.approx(0.2, abs=0.01)
    assert any("have no number" in note for note in found.notes)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('1700000000.5 {"sent": NaN}', "is no message in JSON"),
        ('1700000000.5 {"sent": 1700000000.2', "is no message in JSON|form is not recognised"),
        ('soon {"sent": 1700000000.2}', "expected a time"),
        ('{"sent": 1700000000.2}', "does not have the time of reception"),
        ('1700000000.5 {"sent": 1700000000.2, "seq": "a"}', "expected a whole number"),
        ("\n".join(f'{START + k} {{"sent": {START + k}.5}}' for k in range(6)), "are whole seconds"),
        ("\n".join(f'{START + k}.5 {{"sent": {START + k}.1, "seq": {10**17 * k}}}' for k in range(3)), "consecutive"),
    ],
)
def test_messages_without_times_are_refused(tmp_path: Path, text: str, words: str) -> None:
    """In one sentence."""
    path = tmp_path / "log.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ProblemError, match=words):
        read_delays(path)


def test_negative_differences_contradict_synchronised_times(tmp_path: Path) -> None:
    """Both times of two computers with an offset."""
    first, second, _ = written(tmp_path, 4)
    with pytest.raises(ProblemError, match="expected at least 0 with synchronised times"):
        read_delays(first, second, synchronised=True)
