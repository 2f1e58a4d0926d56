"""Delays of packets from measurements, with the assumption under which they are one-way delays.

A round trip is not a one-way delay, and the times of two computers do not give one. So each result states its
assumption:

* A round trip is halved, which is correct if both directions are equally slow, or kept as the delay of request and
  answer together. Half the sum of two delays varies less than one of them if they are independent, and a loss may be
  that of the request or of the answer; a note states the share of one direction.
* Times of two computers are compared by the line that ``envelope`` finds, d = (r − s) − (a + b s) + least, where the
  smallest delay is set to a stated value. The constant part of all delays then has the error of this value.
* If the computers are stated to be synchronised, d = r − s, and a negative delay is refused.
* Delays of one computer, of a trace and of a histogram are as the file states them.

A result has the statistics of ``statistics``, and is written as a trace, with one row for each packet, or as a
histogram. The histogram rounds delays up to three significant digits, so its delays are at most 1 % larger and never
smaller. It draws each delay independently of the last one; a note says if measured delays or losses are not like that.

Source: moon1999, zhang2002
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import (
    Array,
    Bits,
    Panel,
    Series,
    Size,
    StyleName,
    check_format,
    choice,
    draw,
    frozen,
    number,
    number_of,
    write_whole,
)
from taciturn.model.result import VERDICT, Field, Result
from taciturn_delays.envelope import lower_line, uneven
from taciturn_delays.forms import FORMS, Form, Histogram, read
from taciturn_delays.instants import UNITS
from taciturn_delays.reading import Names, Reading
from taciturn_delays.statistics import RARE, chance_of_runs, correlation, quantile, reordered, runs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LEVELS = (0.9, 0.99, 0.999)
_LONGEST = 3600.0  # seconds of an interval or a smallest delay
_STEEP = 500e-6  # drift above which a computer's oscillator is not its cause
_OTHER_UNIT = 0.1  # drift above which the units of both times differ
_DEPENDENT = 4.0  # standard errors of a correlation of delays that is not by chance
_DRAWN = 1000  # points of a curve
_SLACK = 1e-9  # rounding of a share
_DIGITS = 3  # significant digits of delays in a histogram
_PPM = 1e6


def _milliseconds(value: float) -> str:
    """Write a duration in milliseconds."""
    return f"{1000 * value:.4g} ms"


def _percentage(share: float) -> str:
    """Write a share as a percentage."""
    return f"{100 * share:.3g} %"


def _quantile_lines(found: MeasuredDelays) -> list[tuple[str, str]]:
    """Return the lines of the quantiles."""
    few = "unknown, since fewer than {} packets were delivered"
    return [
        (
            f"{100 * level:.4g} % at most",
            few.format(f"{round(1 / (1 - level)):,}") if one is None else _milliseconds(one),
        )
        for level, one in zip(_LEVELS, (found.quantile_90, found.quantile_99, found.quantile_999), strict=True)
    ]


def _loss_text(found: MeasuredDelays) -> str:
    """Return how losses depend on each other."""
    if found.bursty is None:
        return ""
    after = "" if found.loss_after_loss is None else f", {_percentage(found.loss_after_loss)} after a dropped packet"
    kind = "bursty" if found.bursty else "as if independent of each other"
    return f"{kind}; correlation of consecutive packets {found.loss_correlation or 0.0:z.2f}{after}"


@dataclass(frozen=True, repr=False, eq=False)
class MeasuredDelays(Result):
    """Measured delays of packets with their statistics.

    Args:
        form: form of the file, in words.
        assumption: assumption under which the delays hold, in words.
        sent: times of sending in seconds from the first packet, shape (packets,); empty for a histogram.
        delay: delays in seconds, infinite for dropped packets, shape (packets,); for a histogram, its delays.
        weight: share of the packets with each delay, shape (packets,) or that of the histogram.
        reordered: share of the delivered packets that a later packet has overtaken; None for a histogram.
        duplicates: further copies of received packets.
        offset: estimated time of the receiver minus that of the sender at the first packet, in seconds, if the times of
            two computers were compared.
        drift: estimated relative difference between the rates of both times.
        notes: sentences about the file and the estimates.
    """

    FIELDS: ClassVar[tuple[Field[MeasuredDelays], ...]] = (
        VERDICT,
        Field("form", say="file"),
        Field("assumption", say="assumption"),
        Field("offset", optional=True, say="offset", text=lambda found: found.offset_text),
        Field("drift_ppm", optional=True, say="drift", text="{:z.4g} ppm (above 0: the receiver's time is faster)"),
        Field("packets", say="packets", text="{:,}", none="unknown: the file has shares"),
        Field("lost", say="lost", text=lambda found: _percentage(found.lost)),
        Field(
            "reordered",
            say="reordered",
            text=lambda found: "" if found.reordered is None else _percentage(found.reordered),
        ),
        Field("duplicates", say="duplicates"),
        Field("mean", say="mean delay", text=lambda found: _milliseconds(found.mean)),
        Field("median", say="median", text=lambda found: _milliseconds(found.median)),
        Field("quantile_90", say="", text=_quantile_lines),
        Field("quantile_99"),
        Field("quantile_999"),
        Field("smallest", say="smallest", text=lambda found: _milliseconds(found.smallest)),
        Field("largest", say="largest", text=lambda found: _milliseconds(found.largest)),
        Field("correlation", say="correlation", text="{:z.2f} between the delays of consecutive packets"),
        Field("bursty", say="losses", text=_loss_text),
        Field("loss_correlation"),
        Field("loss_after_loss"),
        Field("notes", say="note"),
    )
    shown: ClassVar[tuple[str, ...]] = ("packets", "lost", "mean", "largest", "assumption")

    form: str
    assumption: str
    sent: Array
    delay: Array
    weight: Array
    reordered: float | None = None
    duplicates: int = 0
    offset: float | None = None
    drift: float | None = None
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentence with losses, mean and the largest quantile that is known, and the assumption."""
        known = [
            f"{100 * level:.4g} % of the delivered packets take at most {_milliseconds(value)}"
            for level, value in zip(_LEVELS, (self.quantile_90, self.quantile_99, self.quantile_999), strict=True)
            if value is not None
        ]
        count = "histogram" if self.packets is None else number_of(f"{self.packets:,}", "packet")
        delay = known[-1] if known else f"the largest delay is {_milliseconds(self.largest)}"
        return (f"{count}: {_percentage(self.lost)} lost; {delay} ({self.assumption})",)

    @property
    def packets(self) -> int | None:
        """Number of packets; None for a histogram."""
        return len(self.sent) or None

    @property
    def lost(self) -> float:
        """Share of the packets that are lost."""
        return (
            max(0.0, 1 - float(self.weight[self.delivered].sum()))
            if self.packets is None
            else self._losses / len(self.sent)
        )

    @property
    def drift_ppm(self) -> float | None:
        """Estimated drift in parts per million."""
        return None if self.drift is None else _PPM * self.drift

    @property
    def offset_text(self) -> str:
        """Sentence with the estimated offset, and that its constant part is unknown; empty if none was estimated."""
        if self.offset is None:
            return ""
        return (
            f"{self.offset:z.6g} s, time of the receiver minus that of the sender, if the smallest delay is as stated"
        )

    @cached_property
    def delivered(self) -> Bits:
        """Whether each packet was delivered, shape (packets,)."""
        return np.isfinite(self.delay)

    @property
    def _losses(self) -> int:
        return int(len(self.delay) - self.delivered.sum())

    @property
    def mean(self) -> float:
        """Mean delay of the delivered packets in seconds."""
        weight = self.weight[self.delivered]
        return float(weight @ self.delay[self.delivered] / weight.sum())

    @property
    def median(self) -> float:
        """Median delay of the delivered packets in seconds."""
        return quantile(self.delay[self.delivered], self.weight[self.delivered], 0.5, None) or 0.0

    @cached_property
    def quantile_90(self) -> float | None:
        """Delay in seconds that 90 % of the delivered packets do not exceed; None with fewer than 10 packets."""
        return self._quantile(0.9)

    @cached_property
    def quantile_99(self) -> float | None:
        """Delay in seconds that 99 % of the delivered packets do not exceed; None with fewer than 100 packets."""
        return self._quantile(0.99)

    @cached_property
    def quantile_999(self) -> float | None:
        """Delay in seconds that 99.9 % of the delivered packets do not exceed; None with fewer than 1000 packets."""
        return self._quantile(0.999)

    def _quantile(self, level: float) -> float | None:
        count = None if self.packets is None else int(self.delivered.sum())
        return quantile(self.delay[self.delivered], self.weight[self.delivered], level, count)

    @property
    def smallest(self) -> float:
        """Smallest delay in seconds."""
        return float(self.delay.min())

    @property
    def largest(self) -> float:
        """Largest delay of a delivered packet in seconds."""
        return float(self.delay[self.delivered].max())

    @cached_property
    def correlation(self) -> float | None:
        """Correlation between the delays of consecutive packets; None if it is not defined."""
        return None if self.packets is None else correlation(self.delay, self.delivered)

    @cached_property
    def loss_correlation(self) -> float | None:
        """Correlation between the losses of consecutive packets; None if it is not defined."""
        lost = (~self.delivered).astype(np.float64)
        return None if self.packets is None else correlation(lost, np.ones(len(lost), dtype=np.bool_))

    @cached_property
    def loss_after_loss(self) -> float | None:
        """Share of dropped packets among those that follow a dropped packet; None if there is none."""
        lost = ~self.delivered
        if self.packets is None or not lost[:-1].any():
            return None
        return float(lost[1:][lost[:-1]].mean())

    @cached_property
    def bursty(self) -> bool | None:
        """Whether losses form fewer runs than independent ones, by an exact test; None with fewer than two losses."""
        if self.packets is None or self._losses < 2:
            return None
        return chance_of_runs(len(self.sent), self._losses, runs(~self.delivered)) < RARE

    @property
    def dependent(self) -> bool:
        """Whether delays or losses depend on those of the packet before, so that a histogram leaves something out."""
        pairs = int((self.delivered[1:] & self.delivered[:-1]).sum())
        return bool(self.bursty) or abs(self.correlation or 0.0) * math.sqrt(pairs) > _DEPENDENT

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Draw the share of the delivered packets whose delay is larger than a value, and the delays over time.

        Args:
            ax: existing axes to draw the shares in instead of a new figure.
            figsize: width and height of a new figure, in inches.
            style: ``"light"``, ``"dark"``, ``"paper"`` or ``"paper-wide"``.
        """
        delays, weight = self.delay[self.delivered], self.weight[self.delivered]
        order = np.argsort(delays, kind="stable")
        x, beyond = 1000 * delays[order], np.maximum(1 - np.cumsum(weight[order]) / weight.sum(), 0.0)
        from_end = np.geomspace(1, len(x), _DRAWN)  # close together where the shares are small
        kept = np.unique(len(x) - from_end.round().astype(np.int64))
        last = beyond > _SLACK
        kept = kept[last[kept]] if last.any() else kept[:0]
        shares = Panel(
            [Series([0.0, *x[kept].tolist()], [1.0, *beyond[kept].tolist()], curve="steps", thing="policy")],
            "delay (ms)", "share of packets with a larger delay", self.assumption, ylog=True,
        )  # fmt: skip
        if ax is not None or self.packets is None:
            return draw([shares], ax, figsize, style)
        size = -(-self.packets // _DRAWN)
        parts = [slice(k, k + size) for k in range(0, self.packets, size)]
        parts = [part for part in parts if self.delivered[part].any()]
        times = [float(self.sent[part][0]) for part in parts]
        largest = [1000 * float(self.delay[part][self.delivered[part]].max()) for part in parts]
        label = "delay (ms)" if size == 1 else f"largest of {size} delays (ms)"
        over_time = Panel([Series(times, largest, curve="points", thing="policy")], "time of sending (s)", label)
        return draw([shares, over_time], ax, figsize, style)

    def save_trace(self, path: str | Path) -> None:
        """Write the columns ``sent`` and ``delay`` in seconds; the delay of a dropped packet is empty.

        Args:
            path: CSV file; an existing file is replaced.

        Raises:
            ProblemError: the result is from a histogram, or the file cannot be written.
        """
        if self.packets is None:
            raise ProblemError(
                "a trace needs the order of packets, which a histogram does not have; expected measured packets: use "
                "the histogram itself in the problem file"
            )
        rows = zip(self.sent.tolist(), self.delay.tolist(), strict=True)
        lines = (f"{sent!r},{delay!r}" if math.isfinite(delay) else f"{sent!r}," for sent, delay in rows)
        _write(path, "trace", "sent,delay", lines)

    def save_histogram(self, path: str | Path) -> None:
        """Write the columns ``milliseconds`` and ``probability``; the rest of the probability is that of a loss.

        Delays are rounded up to three significant digits.

        Args:
            path: CSV file; an existing file is replaced.

        Raises:
            ProblemError: the file cannot be written.
        """
        shares = Counter[float]()
        for delay, weight in zip(self.delay.tolist(), self.weight.tolist(), strict=True):
            if math.isfinite(delay):
                shares[_rounded_up(1000 * delay)] += 1 if self.packets else weight
        total = len(self.sent) or 1
        lines = (f"{value!r},{share / total!r}" for value, share in sorted(shares.items()))
        _write(path, "histogram", "milliseconds,probability", lines)


def read_delays(
    path: str | Path,
    receiver: str | Path | None = None,
    *,
    kind: Form | None = None,
    round_trip: Literal["half", "whole"] = "half",
    synchronised: bool = False,
    least: float = 0.0,
    interval: float | None = None,
    link: str | None = None,
    sent: str | None = None,
    received: str | None = None,
    identity: str | None = None,
    unit: Literal["s", "ms", "us", "ns"] | None = None,
) -> MeasuredDelays:
    """Read measured delays of packets from a file, and state the assumption under which they hold.

    The file is the output of ping, a log of messages such as those of MQTT, an export of captured packets by tshark,
    ``packets.csv`` of a recorded run, a trace, or a histogram. Times of two computers are compared by a line below all
    differences,

        maximise  a + b s̄   subject to   a + b s ≤ r − s,   delay = (r − s) − (a + b s) + least,

    with the times s of sending and r of reception, their mean s̄, the offset a and the drift b.

    Args:
        path: file, or the capture at the sender.
        receiver: capture at the receiver.
        kind: form of the file, if it is not recognised.
        round_trip: for requests and answers, ``"half"`` the round trip, or the ``"whole"`` as the delay of both.
        synchronised: whether the times of sender and receiver are the same, so that their difference is the delay.
        least: smallest delay in seconds, which the times of two computers leave unknown.
        interval: seconds between the packets of ping, if its output has no times.
        link: link in ``packets.csv``.
        sent: column or key of the time of sending in a log of messages.
        received: column or key of the time of reception.
        identity: column, key or field that identifies a message or a captured packet.
        unit: unit of the times of sending, if they do not count from 1970.

    Returns:
        Times of sending, delays, their statistics, and the assumption.

    Raises:
        ProblemError: the file cannot be read, has another form, or contains no delivered packet.

    Source: moon1999, zhang2002

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "ping.txt"
        >>> replies = [f"64 bytes from 10.0.0.1: icmp_seq={k} ttl=64 time={4 + k}.0 ms" for k in (1, 2, 4)]
        >>> _ = path.write_text("\\n".join(replies), encoding="utf-8")
        >>> found = read_delays(path)
        >>> found.delay.tolist(), found.assumption
        ([0.0025, 0.003, inf, 0.004], 'assumed symmetric: half the round trip')
    """
    choice("round_trip", round_trip, ("half", "whole"))
    if kind is not None:
        choice("kind", kind, FORMS)
    number("least", least, 0.0, _LONGEST, closed=True)
    if interval is not None:
        number("interval", interval, 0.0, _LONGEST)
    if unit is not None:
        choice("unit", unit, tuple(UNITS))
    if synchronised and least:
        raise ProblemError(
            f"least is {least:g}, but synchronised times give the smallest delay; expected one of the two: leave "
            "out one"
        )
    names = Names(sent, received, identity, unit, link)
    found = read(Path(path), None if receiver is None else Path(receiver), kind, interval, names)
    if isinstance(found, Histogram):
        return MeasuredDelays(
            "histogram", "delays as the file states them", frozen(np.empty(0)), found.delays, found.probabilities
        )
    if not np.isfinite(found.elapsed).any():
        raise ProblemError(
            f"all packets in {str(path)!r} are lost; expected at least one delivered packet: check that the "
            "receiver runs"
        )
    if found.route != "round trip" and round_trip == "whole":
        raise ProblemError(
            f"round_trip is 'whole', but {str(path)!r} has no round trips; expected it only with requests and answers: "
            "leave it out"
        )
    if found.route != "two computers" and synchronised:
        raise ProblemError(
            f"synchronised times are stated, but {str(path)!r} does not compare the times of two computers; expected "
            "this only with such times: leave out --synchronised"
        )
    if found.route == "two computers" and not synchronised:
        return _compared(Path(path), found, least)
    if least:
        raise ProblemError(
            f"least is {least:g}, but {str(path)!r} does not compare the times of two computers; expected it only with "
            "such times: leave it out"
        )
    return _direct(Path(path), found, round_trip)


def _direct(path: Path, found: Reading, round_trip: Literal["half", "whole"]) -> MeasuredDelays:
    """Return the delays of a reading whose differences of times are delays, or round trips."""
    smallest = float(found.elapsed.min())
    if smallest < 0:
        raise ProblemError(
            f"the smallest difference between the times of reception and sending in {str(path)!r} is {smallest:g} s; "
            "expected at least 0 with synchronised times: leave out --synchronised"
        )
    if found.route == "round trip":
        half = round_trip == "half"
        assumption = "assumed symmetric: half the round trip" if half else "whole round trip: request and answer"
        lost = 1 - float(np.isfinite(found.elapsed).mean())
        if half and lost:
            one = _percentage(1 - math.sqrt(1 - lost))
            note = f"a request or its answer is lost; one direction loses {one} if both lose equally and independently"
            found = replace(found, notes=(*found.notes, note))
        return _result(found, found.elapsed / 2 if half else found.elapsed, assumption)
    same = found.route == "two computers"
    assumption = "both computers stated to be synchronised" if same else "delays as the file states them"
    return _result(found, found.elapsed, assumption)


def _compared(path: Path, found: Reading, least: float) -> MeasuredDelays:
    """Return the delays of a reading with the times of two computers."""
    there = np.isfinite(found.elapsed)
    times, differences = found.sent[there], found.elapsed[there]
    if times[0] == times[-1]:
        raise ProblemError(
            f"the file {str(path)!r} has delivered packets of one time of sending only; expected several, from which "
            "offset and drift are estimated: measure longer, or state synchronised times with --synchronised"
        )
    line = lower_line(times, differences)
    if abs(line.drift) > _OTHER_UNIT:
        raise ProblemError(
            f"the time of reception advances by {1 + line.drift:.4g} s for each second of the time of sending in "
            f"{str(path)!r}; expected about 1: state the unit of the times of sending, such as --unit ms"
        )
    rest = np.maximum(differences - line.at(times), 0.0)
    delay = np.full(len(found.elapsed), np.inf)
    delay[there] = rest + least
    notes = [
        *found.notes,
        "the constant part of the delays cannot be known from times of two computers: if the smallest delay is not "
        f"{_milliseconds(least)}, all delays differ by the same amount; state it with --least",
    ]
    if abs(line.drift) > _STEEP:
        notes.append(
            f"a drift above {_PPM * _STEEP:g} ppm is more than that of computers: the measurement is short, or the "
            "smallest delay changed"
        )
    spread = uneven(times, rest)
    if spread > 0.5 * float(np.median(rest)) > 0:
        notes.append(
            f"the smallest delay differs by {_milliseconds(spread)} between quarters of the measurement: the time of a "
            "computer was adjusted, or the route changed"
        )
    assumption = f"times of two computers, smallest delay set to {_milliseconds(least)}"
    return _result(
        replace(found, notes=tuple(notes)), delay, assumption, line.at(found.sent[:1])[0] - least, line.drift
    )


def _result(
    found: Reading, delay: Array, assumption: str, offset: float | None = None, drift: float | None = None
) -> MeasuredDelays:
    """Return the result of a reading."""
    sent = found.sent - found.sent[0]
    delivered = int(np.isfinite(delay).sum())
    overtaken = reordered(sent + found.elapsed) / delivered
    result = MeasuredDelays(
        found.form, assumption, frozen(sent), frozen(delay), frozen(np.full(len(sent), 1 / len(sent))), overtaken,
        found.duplicates, offset, drift, found.notes,
    )  # fmt: skip
    if not result.dependent:
        return result
    note = "delays or losses depend on those of the packet before: a trace keeps this, a histogram does not"
    return replace(result, notes=(*found.notes, note))


def _rounded_up(value: float) -> float:
    """Round a number up to a few significant digits."""
    if value == 0:
        return 0.0
    places = _DIGITS - 1 - math.floor(math.log10(value))
    nearest = round(value, places)
    return nearest if nearest >= value * (1 - 1e-12) else round(nearest + 10.0**-places, places)


def _write(path: str | Path, what: str, heading: str, lines: Iterable[str]) -> None:
    """Write a CSV file."""
    target = check_format(path, (".csv",), what)
    try:
        write_whole(target, "\n".join((heading, *lines, "")).encode())
    except OSError as error:
        raise ProblemError(
            f"the {what} {str(target)!r} cannot be written ({error.strerror or error}); expected a writable file"
        ) from None
