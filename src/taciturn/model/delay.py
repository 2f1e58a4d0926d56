"""Delays of packets: the law of a link, which may be constant, random or measured.

A packet that is sent at step k arrives after a delay τ_i with probability p_i, and never with the rest 1 − Σ p_i. The
delays are whole numbers of steps, or seconds, which count in parts of a period τ/h = d + r with 0 ≤ r < 1. A law is

* constant: one delay, of every packet;
* a list of delays with their probabilities, drawn for each packet by itself;
* one such list for each state of a link with bursts (``states``), so that delays come in bursts as losses do;
* measured: a histogram, or a trace of packets, of which simulations replay random pieces (block bootstrap).

A receiver with a *buffer* uses each packet exactly so long after it was sent. A packet that arrives later is lost. So
with a buffer, or a constant delay, the delay of a link is a number, and the rest of its law is a loss probability
(``LinkLaw.played``): everything that holds for constant delays and losses holds for the link.

A constant delay is a property of the plant that a design sees (``model.transport``). All other laws stay properties of
the link.

Source: astrom1997computer, politis1994
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite
from numbers import Integral
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from taciturn._arrays import Array, number, quoted
from taciturn._display import Displayed
from taciturn._files import read_text, why_unreadable
from taciturn._text import backslash_text, number_of, percent
from taciturn.errors import ProblemError
from taciturn.model.losses import Burst, Chain, LossLaw

LONGEST = 1000  # steps of a delay
MOST_BYTES = 2**24  # of a file of delays
MOST_PACKETS = 100_000  # of a trace
SUMS = 1e-9  # largest excess over 1 of a sum of probabilities
MOST_PIECES = 16  # parts of a period that random delays distinguish; those between are rounded
MANY = 1e9  # periods of a delay, more than any loop may have
WHOLE = 1e-9  # part of a period below which a delay is a whole number of periods
KEYS = ("seconds", "probability", "histogram", "trace", "states")
HEADERS: Mapping[str, tuple[str, str]] = {"histogram": ("milliseconds", "probability"), "trace": ("sent", "delay")}
WAIT = "a whole number of steps, or a table {seconds = x}"
FORMS = (
    "a whole number of steps, a list of probabilities of 0, 1, 2, … steps, or a table such as {seconds = 0.004}, "
    "{seconds = [0.001, 0.004], probability = [0.8, 0.2]}, {histogram = 'file.csv'}, {trace = 'file.csv'} or "
    "{states = [law, law]}"
)


class Wait(NamedTuple):
    """A constant delay: whole steps plus seconds."""

    steps: int = 0
    seconds: float = 0.0

    def periods(self, period: float) -> float:
        """Return the delay in periods. Delays that differ from a whole number by rounding are whole."""
        exact = min(self.steps + self.seconds / period, MANY)
        return float(round(exact)) if abs(exact - round(exact)) <= WHOLE else exact

    def after(self, other: Wait) -> Wait:
        """Return the sum of two delays."""
        return Wait(self.steps + other.steps, self.seconds + other.seconds)

    def text(self) -> str:
        """Write the delay as text, such as "2 steps" or "4 ms"."""
        parts = [number_of(self.steps, "step")] if self.steps else []
        parts += [f"{self.seconds * 1e3:.6g} ms"] if self.seconds else []
        return " and ".join(parts) or "0"


@dataclass(frozen=True, repr=False)
class DelayLaw(Displayed):
    """The law of the delay of the packets on a link.

    ``delay_from`` makes it of the forms in which a problem file states it.
    """

    waits: tuple[float, ...]  # the possible delays, increasing
    odds: tuple[tuple[float, ...], ...]  # their probabilities, one row for each state of the link
    in_seconds: bool = False  # whether delays are in seconds, or in whole steps
    sequence: tuple[int, ...] = ()  # of a trace: the delay of each packet as an index of ``waits``; their number: lost
    block: float = 1.0  # mean number of packets of a trace that are replayed in turn

    @property
    def constant(self) -> Wait | None:
        """The delay of every packet, if it is always the same and no packet is lost; otherwise None."""
        if len(self.waits) != 1 or any(row[0] < 1.0 - SUMS for row in self.odds) or self.lost_in(0):
            return None
        return self.wait(0)

    def wait(self, place: int) -> Wait:
        """Return one of the possible delays."""
        found = self.waits[place]
        return Wait(0, found) if self.in_seconds else Wait(int(found))

    def lost_in(self, state: int) -> bool:
        """Return whether some packets never arrive in a state of the link."""
        return sum(self.odds[state]) < 1.0 - SUMS

    @property
    def loses(self) -> bool:
        """Whether some packets never arrive."""
        return any(self.lost_in(state) for state in range(len(self.odds)))

    def later_than(self, buffer: Wait) -> tuple[float, ...]:
        """Return the probability, in each state of the link, that a packet is lost or arrives after the buffer."""
        most = (buffer.seconds if self.in_seconds else float(buffer.steps)) * (1 + WHOLE)
        found: list[float] = []
        for row in self.odds:
            here = 1.0 - sum(p for wait, p in zip(self.waits, row, strict=True) if wait <= most)
            found.append(0.0 if here <= SUMS else min(here, 1.0))
        return tuple(found)

    def losses(self, buffer: Wait, loss: float, burst: LossLaw | None) -> float | LossLaw:
        """Return the losses of a link whose receiver plays packets out after ``buffer``, with its own losses.

        The packets of a trace that are lost or late form a Gilbert–Elliott chain that is fitted to the trace: its
        probabilities are the shares of these packets after one that came, and of those that came after one of these.
        """
        late = self.later_than(buffer)
        if self.sequence and any(late) and burst is None:
            most = (buffer.seconds if self.in_seconds else float(buffer.steps)) * (1 + WHOLE)
            gone = np.array([wait == len(self.waits) or self.waits[wait] > most for wait in self.sequence])
            if not gone.all():
                # after the last packet comes the first, as in a replay: so an outage at either end is one burst, and
                # the chain loses the share that the trace loses
                begins = int((gone & ~np.roll(gone, 1)).sum())
                return Burst(begins / int((~gone).sum()), begins / int(gone.sum()), loss, 1.0)
        if burst is None and len(set(late)) == 1:
            return 1.0 - (1.0 - loss) * (1.0 - late[0])
        if burst is None:
            raise ProblemError("states are given without bursts; expected a burst with as many states")
        own = burst.losses
        drops = 1.0 - (1.0 - own) * (1.0 - np.array(late if len(late) == len(own) else late * len(own)))
        return Chain(drops.tolist(), burst.turns.tolist()) if any(late) else burst

    @property
    def most(self) -> Wait:
        """The largest delay of a packet that arrives."""
        return self.wait(-1)

    def arriving(self, shares: Sequence[float] = ()) -> Array:
        """Return the probability of each delay, for the shares of the states of the link; default: equal ones."""
        return np.average(np.array(self.odds), axis=0, weights=shares if len(shares) == len(self.odds) else None)

    def mean_by(self, shares: Sequence[float] = ()) -> float:
        """Return the mean delay of packets that arrive, for the shares of the states of the link; default: equal."""
        weights = self.arriving(shares)
        return float(np.dot(self.waits, weights) / weights.sum())

    def expected(self, shares: Sequence[float]) -> Wait:
        """Return the mean delay of the packets that arrive, as a constant delay, for the shares of the link's states.

        It is in seconds, or the nearest number of steps.
        """
        mean = self.mean_by(shares)
        return Wait(0, mean) if self.in_seconds else Wait(round(mean))

    def later(self, by: float) -> DelayLaw:
        """Return the law of packets that take longer, by steps or seconds; if ``by`` is negative, no less than 0."""
        return self._with(np.maximum(np.array(self.waits) + by, 0.0))

    def _with(self, waits: Array) -> DelayLaw:
        """Return the law with other delays, one for each; those that are equal become one."""
        found, places = np.unique(waits.round(12), return_inverse=True)
        odds = np.zeros((len(self.odds), len(found)))
        for column, place in enumerate(places.ravel().tolist()):
            odds[:, place] += np.array(self.odds)[:, column]
        renamed = [*places.ravel().tolist(), len(found)]
        rows = tuple(tuple(row) for row in odds.tolist())
        sequence = tuple(renamed[one] for one in self.sequence)
        return replace(self, waits=tuple(found.tolist()), odds=rows, sequence=sequence)

    def at_steps(self) -> DelayLaw:
        """Return the law, in periods, of the steps in which a node that works once per step takes up packets."""
        return self._with(np.ceil(np.array(self.waits) - WHOLE))

    def in_periods(self, period: float) -> DelayLaw:
        """Return the law with delays in periods, of which at most ``MOST_PIECES`` parts of a period differ."""
        waits = np.array(self.waits) / (period if self.in_seconds else 1.0)
        whole = np.round(waits)
        waits = np.where(np.abs(waits - whole) <= WHOLE, whole, waits)
        parts = waits - np.floor(waits)
        if len(np.unique(parts.round(9))) > MOST_PIECES:
            waits = np.floor(waits) + np.round(parts * MOST_PIECES) / MOST_PIECES
        return replace(self._with(waits), in_seconds=False)

    def text(self, shares: Sequence[float] = ()) -> str:
        """Describe the law in a few words, for the shares of the states of the link; default: equal ones."""
        constant = self.constant
        if constant is not None:
            return constant.text()
        low, high = self.wait(0).text(), self.most.text()
        missing = 1.0 - float(self.arriving(shares).sum())
        lost = f", {percent(missing)} lost" if self.loses else ""
        if len(self.waits) == 1:
            return f"{low}{lost}"
        how = "measured" if self.sequence else "by the state of the link" if len(self.odds) > 1 else "random"
        average = self.mean_by(shares)
        mean = f"{average * 1e3:.4g} ms" if self.in_seconds else f"{average:.4g} steps"
        return f"{how}, {low} to {high}, mean {mean}{lost}"

    def short(self) -> str:
        """Describe the law in a few words, for the display of a link."""
        return self.text()

    def mixed(self, weights: Array) -> DelayLaw:
        """Return the law of a packet that is delayed in one of the states of the link, with given weights."""
        if len(self.odds) == 1:
            return self
        row = weights @ np.array(self.odds) / weights.sum()
        return replace(self, odds=(tuple(row.tolist()),))

    def of_states(self, states: int) -> DelayLaw:
        """Return the law with a row for each of ``states`` states of the link."""
        if len(self.odds) == states:
            return self
        return replace(self, odds=self.odds * states)


def delay_from(name: str, given: object) -> DelayLaw:
    """Make a law of delay from one of the forms in which problem files state it.

    Raises:
        ProblemError: the form is unknown, a number is out of range, or a file cannot be read.
    """
    if isinstance(given, DelayLaw):
        return given
    if isinstance(given, Mapping):
        return _of_table(name, cast("Mapping[str, object]", given))
    listed = isinstance(given, list | tuple) or (isinstance(given, np.ndarray) and cast("Array", given).ndim > 0)
    given = cast("object", given)
    if listed:
        chances = cast("Sequence[object]", given)
        return _of_lists(name, range(len(chances)), chances, False)
    return _of_lists(name, [_steps(name, given, FORMS)], [1.0], False)


def wait_from(name: str, given: object) -> Wait:
    """Make a constant delay from a whole number of steps, or from a table {seconds = x}."""
    if isinstance(given, Wait):
        return given
    if isinstance(given, Mapping):
        table = cast("Mapping[str, object]", given)
        if set(table) != {"seconds"}:
            raise ProblemError(f"{name} is {quoted(table)}; expected {WAIT}")
        return Wait(0, number(f"{name}.seconds", table["seconds"], 0.0, closed=True))
    return Wait(_steps(name, given, WAIT))


def _steps(name: str, given: object, expected: str) -> int:
    whole = isinstance(given, Integral) or (isinstance(given, float) and given.is_integer())
    if isinstance(given, bool) or not whole or cast("Any", given) < 0:
        shown = f"{given:g}" if isinstance(given, float) else quoted(given)
        raise ProblemError(f"{name} is {shown}; expected {expected}")
    steps = int(cast("Any", given))
    if steps > LONGEST:
        raise ProblemError(f"{name} is {quoted(given)} steps; expected at most {LONGEST}")
    return steps


def _of_table(name: str, table: Mapping[str, object]) -> DelayLaw:
    """Return the law of a table of a problem file."""
    for key in (key for key in table if key not in KEYS):
        raise ProblemError(f"{name}.{key} is not a known key; expected one of {', '.join(KEYS)}")
    stated = [key for key in KEYS if key in table and key != "probability"]
    if len(stated) != 1:
        raise ProblemError(f"{name} has {_keys_text(table)}; expected {FORMS}")
    form, value = stated[0], table[stated[0]]
    if "probability" in table and not (form == "seconds" and isinstance(value, list | tuple)):
        raise ProblemError(
            f"{name}.probability is given without a list of delays; expected {name}.seconds with as many delays"
        )
    if form == "states":
        return _of_states(name, cast("object", value))
    if form in ("histogram", "trace"):
        if not isinstance(value, str):
            raise ProblemError(f"{name}.{form} is {quoted(table[form])}; expected the name of a file in quotes")
        rows = _numbers(f"{name}.{form}", value, form)
        named = f"{name}.{form} {value!r}"
        return _of_histogram(named, rows) if form == "histogram" else _of_trace(named, rows)
    if isinstance(value, list | tuple):
        waits, chances = cast("Sequence[object]", value), _listed(table.get("probability"))
        if not chances:
            raise ProblemError(
                f"{name}.seconds is a list, and {name}.probability is "
                f"{quoted(table['probability']) if 'probability' in table else 'missing'}; expected a list of as many "
                "probabilities"
            )
        return _of_lists(name, waits, chances, True)
    return _of_lists(name, [value], [1.0], True)


def _keys_text(table: Mapping[str, object]) -> str:
    """Write the keys of a table as text."""
    return f"the key{'s' * (len(table) > 1)} {' and '.join(table)}" if table else "no keys"


def _listed(given: object) -> Sequence[object]:
    """Return the entries of a list; of anything else, none."""
    return cast("Sequence[object]", given) if isinstance(given, list | tuple) else ()


def _of_states(name: str, given: object) -> DelayLaw:
    """Return the law of a link whose states have a law each."""
    listed = _listed(given)
    if len(listed) < 2:
        raise ProblemError(f"{name}.states is {quoted(given)}; expected a list with a law for each state of the bursts")
    laws = [delay_from(f"{name}.states[{i}]", one) for i, one in enumerate(listed)]
    for i, law in enumerate(laws):
        if len(law.odds) > 1 or law.sequence:
            raise ProblemError(f"{name}.states[{i}] has states or a trace of its own; expected a law without them")
        if law.in_seconds != laws[0].in_seconds:
            raise ProblemError(f"{name}.states has laws in seconds and in steps; expected the same unit in all of them")
    waits = sorted({wait for law in laws for wait in law.waits})
    rows = [dict(zip(law.waits, law.odds[0], strict=True)) for law in laws]
    odds = tuple(tuple(row.get(wait, 0.0) for wait in waits) for row in rows)
    return DelayLaw(tuple(waits), odds, laws[0].in_seconds)


def _of_lists(name: str, waits: Sequence[object], chances: Sequence[object], seconds: bool) -> DelayLaw:
    """Return the law of a list of delays and of their probabilities; the rest is lost."""
    if len(waits) != len(chances):
        raise ProblemError(
            f"{name} has {number_of(len(waits), 'delay')}, and {name}.probability has "
            f"{number_of(len(chances), 'entry')}; expected a probability for each delay"
        )
    most = inf if seconds else float(LONGEST)
    given = [number(f"{name}.seconds" if seconds else f"the delay of {name}", one, 0.0, most, closed=True)
             for one in waits]  # fmt: skip
    share = [number(f"{name}.probability" if seconds else f"{name}[{i}]", one, 0.0, 1.0, closed=True)
             for i, one in enumerate(chances)]  # fmt: skip
    return _of_shares(name, given, share, seconds)


def _of_shares(name: str, waits: Sequence[float], chances: Sequence[float], seconds: bool) -> DelayLaw:
    """Return the law of delays with their probabilities, which are in range."""
    together: dict[float, float] = {}
    for wait, p in zip(waits, chances, strict=True):
        if p > 0.0:
            together[wait] = together.get(wait, 0.0) + p
    total = sum(together.values())
    if total > 1.0 + SUMS or not together:
        remedy = ": divide each by the sum, if they are rounded or counted" if total > 1.0 else ""
        raise ProblemError(
            f"{name} has probabilities with the sum {total:.10g}; expected a sum above 0 and at most 1{remedy}"
        )
    possible = sorted(together)
    row = tuple(together[wait] / max(total, 1.0) for wait in possible)
    return DelayLaw(tuple(possible), ((1.0,) if len(row) == 1 and row[0] > 1.0 - SUMS else row,), seconds)


def _of_histogram(name: str, rows: Array) -> DelayLaw:
    """Return the law of a histogram: rows of milliseconds and probability."""
    waits, chances = rows[:, 0], rows[:, 1]
    if (waits < 0.0).any():
        raise ProblemError(f"{name} has the delay {waits.min():g} ms; expected delays of at least 0")
    if (chances < 0.0).any() or (chances > 1.0).any():
        worst = chances[np.argmax(np.abs(chances - 0.5))]
        raise ProblemError(f"{name} has the probability {worst:g}; expected probabilities from 0 to 1")
    return _of_shares(name, (waits / 1e3).tolist(), chances.tolist(), True)


def _of_trace(name: str, rows: Array) -> DelayLaw:
    """Return the law of a trace: rows of the time of sending and the delay, in seconds, empty if lost."""
    order = np.argsort(rows[:, 0], kind="stable")
    delays = rows[order, 1]
    came = ~np.isnan(delays)
    if not came.any():
        raise ProblemError(f"{name} has no packet that arrived; expected a delay in at least one row")
    if (delays[came] < 0.0).any():
        worst = float(delays[came].min())
        raise ProblemError(f"{name} has the delay {worst:g} s; expected delays of at least 0: correct the offset of "
                           "the two computers (`taciturn delays` estimates it)")  # fmt: skip
    waits: Array = np.unique(delays[came])
    found: Array = np.where(came, delays, 0.0)
    places = np.where(came, np.searchsorted(waits, found), len(waits))
    counts = np.bincount(places, minlength=len(waits) + 1)[:-1] / len(places)
    block = max(1.0, round(len(places) ** (1 / 3)))  # the order at which bias and variance of a mean balance
    return DelayLaw(tuple(waits.tolist()), (tuple(counts.tolist()),), True, tuple(places.tolist()), block)


def _numbers(name: str, path: str, form: str) -> Array:
    """Return the two columns of a file of delays, with NaN for an empty entry of a trace."""
    header = HEADERS[form]
    empty = ", in seconds, and no delay of a packet that is lost" if form == "trace" else ""
    try:
        return _columns(read_text(Path(path), MOST_BYTES), form)
    except (OSError, ValueError, csv.Error) as error:
        raise ProblemError(
            f"{name} {path!r} cannot be read ({why_unreadable(error)}); expected the columns {' and '.join(header)}, "
            f"separated by commas{empty}{backslash_text(path)}"
        ) from None


def _columns(text: str, form: str) -> Array:
    """Return the columns of a text with commas that its header names, or its first two columns without a header."""
    found, places = list[list[float]](), (0, 1)
    for line, entries in enumerate(csv.reader(io.StringIO(text)), start=1):
        cells = [entry.strip() for entry in entries]
        if not any(cells) or cells[0].startswith("#"):
            continue
        if not found and not any(map(_is_number, cells)):
            places = _places(cells, form, line)
            continue
        if len(found) >= MOST_PACKETS:
            raise ValueError(f"it has more than {MOST_PACKETS:,} rows")
        row: list[float] = []
        for column in places:
            cell = cells[column] if column < len(cells) else ""
            if form == "trace" and column == places[1] and not cell and len(cells) > 1:
                row.append(np.nan)
                continue
            if not _is_number(cell):
                raise ValueError(f"column {column + 1} of line {line} is {quoted(cell)}, which is not a finite number")
            row.append(float(cell))
        found.append(row)
    if not found:
        raise ValueError("it has no rows of numbers")
    return np.array(found)


def _places(cells: Sequence[str], form: str, line: int) -> tuple[int, int]:
    """Return the places of the two columns by a header. A header with none of their names means the first two."""
    named = {cell.lower(): i for i, cell in enumerate(cells)}
    held = [name for name in HEADERS[form] if name in named]
    others = [name for one in HEADERS.values() for name in one if name in named and name not in HEADERS[form]]
    if len(cells) < 2 or len(held) == 1 or (others and not held):
        raise ValueError(f"line {line} is {quoted(','.join(cells))}")
    first, second = (named[name] for name in HEADERS[form]) if held else (0, 1)
    return first, second


def _is_number(cell: str) -> bool:
    try:
        return isfinite(float(cell.replace("_", "?")))
    except ValueError:
        return False


@dataclass(frozen=True, repr=False)
class Transport(Displayed):
    """The constant delays after which each input of a plant acts, and with which each output is read."""

    inputs: tuple[Wait, ...]
    outputs: tuple[Wait, ...]
    certain: Transport | None = None  # the delays that are constant, if others are the mean of random ones

    @staticmethod
    def of(inputs: Sequence[Wait], outputs: Sequence[Wait]) -> Transport | None:
        """Return the delays, or None if all are 0."""
        return Transport(tuple(inputs), tuple(outputs)) if any(map(any, (*inputs, *outputs))) else None

    def periods(self, period: float) -> tuple[Array, tuple[int, ...]]:
        """Return after how many periods each input acts, (m,), and by how many steps each output is older than the
        newest.
        """
        read = [wait.periods(period) for wait in self.outputs]
        part = max((wait % 1.0 for wait in read), default=0.0)
        steps = [int(wait // 1) for wait in read]
        least = min(steps, default=0)
        acts = np.array([wait.periods(period) for wait in self.inputs]) + (least + part)
        whole = np.round(acts)
        return np.where(np.abs(acts - whole) <= WHOLE, whole, acts), tuple(one - least for one in steps)

    def text(self) -> str:
        """Describe the delays in a few words."""
        named = {"input": self.inputs, "output": self.outputs}
        found = [(name, i, wait) for name, waits in named.items() for i, wait in enumerate(waits, start=1) if any(wait)]
        return ", ".join(f"{name} {i} {wait.text()} late" for name, i, wait in found)

    def short(self) -> str:
        """Describe the delays in a few words."""
        return self.text()


def check_delay(law: Any, name: str = "delay") -> DelayLaw | None:
    """Return the law of delay of a link, or None if it is constant and 0."""
    if law is None:
        return None
    found = delay_from(name, law)
    constant = found.constant
    return None if constant is not None and not any(constant) else found
