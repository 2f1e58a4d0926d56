"""Outputs of ping as Linux, macOS, BusyBox and Windows print them, also in other languages and encodings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from delays import samples

from taciturn.errors import ProblemError
from taciturn_delays.delays import MeasuredDelays, read_delays

LOST = np.inf
REPLIES = {  # round trips in milliseconds
    "LINUX": [4.21, 5.02, LOST, 3.98, 4.05, LOST, LOST],
    "GERMAN_LINUX": [1.5, LOST, 1234, 2.5],
    "MAC": [11.915, 1103.207, 98.2, LOST, 12.377],
    "APPLE_TIME": [20, 30],
    "BUSYBOX": [10.126, LOST, 9.874],
    "WINDOWS": [12, LOST, 1, LOST, 3],
    "GERMAN_WINDOWS": [12, LOST, 14],
    "FRENCH_WINDOWS": [2, LOST, 1],
}


def read(tmp_path: Path, text: str | bytes, **options: object) -> MeasuredDelays:
    """Read an output of ping."""
    path = tmp_path / "ping.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_delays(path, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", REPLIES)
def test_a_packet_is_lost_if_no_reply_has_its_number(tmp_path: Path, name: str) -> None:
    """Halves of the round trips, in the order of sending; the whole ones on request."""
    text = getattr(samples, name)
    found = read(tmp_path, text)
    np.testing.assert_allclose(found.delay, np.array(REPLIES[name]) / 2000, rtol=1e-12)
    assert found.assumption == "assumed symmetric: half the round trip"
    whole = read(tmp_path, text, round_trip="whole")
    np.testing.assert_allclose(whole.delay, np.array(REPLIES[name]) / 1000, rtol=1e-12)
    assert "whole" in whole.assumption


@pytest.mark.parametrize("encoding", ["cp1252", "cp850", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_the_encoding_of_a_console_does_not_matter(tmp_path: Path, encoding: str, ending: str) -> None:
    """PowerShell writes UTF-16 with a mark, and a German console its own letters."""
    found = read(tmp_path, samples.GERMAN_WINDOWS.replace("\n", ending).encode(encoding))
    assert found.delay.tolist() == [0.006, LOST, 0.007]


def test_times_of_sending_are_those_of_replies_minus_the_round_trip(tmp_path: Path) -> None:
    """With -D; those of packets without a reply are between their neighbours, or follow at the usual distance."""
    found = read(tmp_path, samples.LINUX)
    np.testing.assert_allclose(found.sent, np.arange(7.0), atol=1e-12)
    assert found.duplicates == 1
    over_midnight = read(tmp_path, samples.APPLE_TIME)
    np.testing.assert_allclose(over_midnight.sent, [0, 1], atol=1e-12)


def test_times_of_sending_without_stamps_are_stated_measured_or_assumed(tmp_path: Path) -> None:
    """And a note says which."""
    for text, interval, step, words in (
        (samples.GERMAN_LINUX, None, 0.202, "from the total time of ping"),
        (samples.MAC, None, 1.0, "is assumed"),
        (samples.MAC, 0.25, 0.25, "as stated"),
        (samples.WINDOWS, 0.5, 0.5, "as stated"),
    ):
        found = read(tmp_path, text, interval=interval)
        np.testing.assert_allclose(np.diff(found.sent), step, rtol=1e-12)
        assert any(words in note for note in found.notes)


def test_a_late_reply_that_is_overtaken_is_reordered(tmp_path: Path) -> None:
    """On macOS, the reply to number 1 comes 3 ms after that to number 2."""
    assert read(tmp_path, samples.MAC).reordered == 1 / 4


def test_sequence_numbers_begin_again_after_16_bits(tmp_path: Path) -> None:
    """They count on, forwards and backwards."""
    numbers = [65533, 65535, 0, 65534, 2]
    lines = [f"64 bytes from 10.0.0.7: icmp_seq={one} ttl=64 time={k + 1} ms" for k, one in enumerate(numbers)]
    found = read(tmp_path, "\n".join(lines))
    assert (2000 * found.delay).tolist() == [1, 4, 2, 3, LOST, 5]


def test_losses_at_the_end_are_those_that_ping_has_counted(tmp_path: Path) -> None:
    """Without its last lines, they are unknown, and a note says so."""
    cut = samples.LINUX.partition("\nFrom")[0]
    assert len(read(tmp_path, cut).sent) == 5
    assert any("losses at the end are unknown" in note for note in read(tmp_path, cut).notes)
    assert any("2 or" in note or "2 packets at the end" in note for note in read(tmp_path, samples.LINUX).notes)


def test_the_share_lost_in_one_direction_is_noted(tmp_path: Path) -> None:
    """1 − √(1 − 0.2) if both directions lose equally."""
    assert any("one direction loses 10.6 %" in note for note in read(tmp_path, samples.MAC).notes)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (samples.MAC + samples.MAC, "2 runs of ping"),
        ("PING 10.0.0.7 (10.0.0.7): 56 data bytes\nRequest timeout for icmp_seq 0\n", "has no reply"),
        ("Pinging 10.0.0.7 with 32 bytes of data:\nRequest timed out.\n", "has no reply"),
        (samples.MAC.replace("98.200", "-98.200"), "expected at least 0"),
    ],
)
def test_outputs_without_delays_are_refused(tmp_path: Path, text: str, words: str) -> None:
    """In one sentence."""
    with pytest.raises(ProblemError, match=words):
        read(tmp_path, text)
