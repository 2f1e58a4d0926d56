"""The rule by which a link sends packets, written as a sentence that follows from the steps of a policy.

A decision compares forms (``model/trigger``). A packet is sent if a label that sends has a smaller form than silence:
V_silent − V_send > 0. This sum is written as an inequality, with its constant on the right side:

* **Quadratic terms.** The blocks of Ψ that no entry connects are separate terms. An entry of a signal and a multiple of
  the identity are written as |e|, with the threshold in the unit of the signal. Other blocks are e'Ψe, or η'Ψη with
  stacked signals η. Each matrix has its letter.
* **Scalar signals** are followed to their meaning: a random number gives a probability; a count of the steps since the
  last packet gives a limit of the intervals, as do the exclusions of a decision; a value that an earlier decision
  selects gives an alternative, "or surprise > 2.1". Any other scalar signal has its words, and how it is computed.
* **Tables.** States of a location in which silence always wins are steps at which nothing is compared: "at every 2nd
  step, when …". A packet whose decision compares only constants of a step counter is sent by a timetable.
* **Sets of packets.** A decision for several links chooses the set of packets with the least value, or the first whose
  value is at most a limit.

Only the data of the policy is read, so a sentence is also made for a rule that none of the designs has written.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._text import number_of, number_text, ordinal
from taciturn.model.steps import (
    ONE,
    Acknowledged,
    Assign,
    Decide,
    Evaluate,
    Location,
    Send,
    Terms,
    option_at,
    placed,
    walk,
)
from taciturn.model.trigger import Form, GaussianTerm, Matrix, Scheduled, Trigger
from taciturn.model.words import PolicyData, Words

DIGITS = 3  # of the numbers in a sentence
LISTED = 8  # steps of a timetable, and values of a decision, that are listed one by one
FORCED = 1e25  # a constant from here on decides whatever the signals are
STACKED, NEVER, LIKELY = "η", "never", "with probability"
LETTERS, EXPONENTS = "ΨΘΦΛΞΩ", "ΠΓΣ"  # of the matrices of a rule, and of those in exponents
ROUNDED = 1e-12  # eigenvalues up to here, relative to the largest, are zero but for rounding
SYMBOL = 4  # largest number of letters of a symbol
FIRST_STEP, FIRST_ARRIVAL = "and at its first step", "and until a packet has arrived"
NONE = "its packet would change no input"
FLAGS: Mapping[str, str] = {  # scalar signals that are 0 or 1, as clauses
    "due": "a packet is due in the plan that it has chosen",
    "missing": "its last packet was not acknowledged",
}


@dataclass(frozen=True, eq=False, repr=False)
class Rule(Displayed):
    """The rule that determines when a link sends packets, in words."""

    when: str  # the clause after "sends"
    limits: tuple[str, ...] = ()  # clauses on the time between packets, and on the steps at which the node compares
    symbols: Mapping[str, str] = field(default_factory=lambda: {})  # meaning of symbols and quantities of the clauses
    matrices: Mapping[str, Matrix] = field(default_factory=lambda: {})  # matrices of the clauses by their letter
    together: tuple[str, ...] = ()  # the other links that are decided together with this link
    follows: frozenset[str] = frozenset()  # earlier decisions of the node that the clauses contain

    @property
    def sentence(self) -> str:
        """The rule as a sentence that begins with its verb and has no full stop."""
        told = f"; decided together with {listed(self.together)}" if self.together else ""
        first = "never sends" if self.when == NEVER else f"sends {self.when}"
        return f"{', '.join((first, *self.limits))}{told}"

    @property
    def explained(self) -> tuple[str, ...]:
        """Meanings of the symbols, such as "e: error". Symbols with the same meaning share one entry."""
        names: dict[str, list[str]] = {}
        for name, told in self.symbols.items():
            names.setdefault(told, []).append(name)
        return tuple(f"{', '.join(listed)}: {told}" for told, listed in names.items())


def rule_of(policy: PolicyData, send: Send) -> Rule:
    """Describe in words when a policy sends packets on a link."""
    if send.on is None:
        return Rule("at every step")
    decide = next(step for step in policy.steps if isinstance(step, Decide) and step.decision == send.on)
    turning = timetable(policy, decide.trigger, send.sending(decide.trigger.labels))
    return _Reader(policy, decide).rule(send) if turning is None else Rule(_at(pattern_text(*turning)))


def choice_of(policy: PolicyData, decide: Decide) -> Rule:
    """Describe a decision that sends no packet, such as a choice between gains, in ``when`` of the returned rule."""
    labels = decide.trigger.labels
    turning = timetable(policy, decide.trigger, labels[1:])
    if turning is not None and len(labels) == 2:
        return Rule(f"{Words(policy).plain(labels[1])} {_at(pattern_text(*turning))}")
    return _Reader(policy, decide).choice()


def timetable(policy: PolicyData, trigger: Trigger, sending: Sequence[str]) -> tuple[tuple[bool, ...], int] | None:
    """Return at which steps a trigger selects one of the labels, and from where this repeats; None if data decide."""
    weights = [weight for form in trigger.forms for weight in (form.Psi, form.constant)]
    read_by = {weight.by for weight in weights if isinstance(weight, Scheduled)}
    tables = [location for location in policy.locations if location.name in read_by]
    if trigger.reads or trigger.limit is not None or any(location.on is not None for location in tables):
        return None
    visited, start = walk(tables, policy.decisions) or ([], 0)
    return tuple(trigger.labels[option_at(trigger, placed(tables, here))] in sending for here in visited), start


def pattern_text(pattern: Sequence[bool], start: int) -> str:
    """Describe at which steps a timetable sends, given its pattern and the first step of the part that repeats."""
    if all(pattern) or not any(pattern):
        return "every step" if any(pattern) else NEVER
    later = _turn_text(pattern[start:])
    if start == 0:
        return later
    ticks = [k for k, sends in enumerate(pattern[:start]) if sends]
    gaps = {after - before for before, after in pairwise(ticks)}
    if len(ticks) > 2 and len(gaps) == 1:
        every = ordinal(gaps.pop()).removeprefix("1st")
        return f"every {f'{every} step' if every else 'step'} from {ticks[0]} to {ticks[-1]}, then {later}"
    shown = ", ".join(map(str, ticks[:LISTED])) + (", …" if len(ticks) > LISTED else "")
    first = f"{len(ticks)} of the first {number_of(start, 'step')}" + (f" ({shown})" if ticks else "")
    return f"{first}, then {later}"


def step_seconds(policy: PolicyData) -> float | None:
    """Return the seconds per step; None if the plant states no unit of time."""
    return policy.model.dt if policy.tick == 1 else policy.tick


def listed(words: Sequence[str], joint: str = "and") -> str:
    """Join words into a list with commas and a last ``joint``, such as "and"."""
    return "".join(words) if len(words) < 2 else f"{', '.join(words[:-1])} {joint} {words[-1]}"


def _turn_text(turn: Sequence[bool]) -> str:
    """Return the steps at which a timetable sends that repeats from the start on."""
    ticks = [k for k, sends in enumerate(turn) if sends]
    if len(ticks) in (0, len(turn)):
        return "every step" if ticks else NEVER
    gaps = {(after - before - 1) % len(turn) + 1 for before, after in zip(ticks, [*ticks[1:], ticks[0]], strict=True)}
    if len(gaps) == 1:
        return f"every {ordinal(gaps.pop())} step"
    if len(ticks) > LISTED:
        return f"{len(ticks)} of {number_of(len(turn), 'step')}"
    return f"steps {listed([*map(str, ticks)])} of every {len(turn)}"


def _at(pattern: str) -> str:
    return pattern if pattern == NEVER else f"at {pattern}"


@dataclass(frozen=True, eq=False)
class _Sum:
    """A sum of quadratic terms, Gaussian terms, scalar signals and constants, which a decision compares with zero."""

    squares: tuple[tuple[tuple[str, ...], Matrix], ...] = ()
    bells: tuple[tuple[tuple[str, ...], GaussianTerm], ...] = ()
    plus: Mapping[str, float] = field(default_factory=lambda: {})
    constant: float = 0.0
    tables: tuple[Scheduled, ...] = ()

    @staticmethod
    def of(form: Form, sign: float = 1.0) -> _Sum:
        """Multiply a form by a sign. A table whose entries are all equal becomes one matrix or number."""
        Psi = None if form.Psi is None else _settled(form.Psi)
        if Psi is not None:
            Psi = Scheduled(Psi.by, sign * Psi.values) if isinstance(Psi, Scheduled) else sign * Psi
        bell = None if form.bell is None else GaussianTerm(sign * form.bell.height, form.bell.Pi)
        table = form.constant if isinstance(form.constant, Scheduled) else None
        same = table is not None and bool((table.values == table.values[0]).all())
        constant = form.constant if not isinstance(form.constant, Scheduled) else float(form.constant.values[0])
        return _Sum(
            () if Psi is None else ((form.signals, Psi),),
            () if bell is None else ((form.signals, bell),),
            {name: sign * weight for name, weight in form.plus.items() if weight},
            sign * constant if table is None or same else 0.0,
            () if table is None or same else (Scheduled(table.by, sign * table.values),),
        )

    def __add__(self, other: _Sum) -> _Sum:
        """Return the sum of two sums."""
        plus = {name: self.plus.get(name, 0.0) + other.plus.get(name, 0.0) for name in {**self.plus, **other.plus}}
        return _Sum(
            (*self.squares, *other.squares),
            (*self.bells, *other.bells),
            {name: weight for name, weight in plus.items() if weight},
            self.constant + other.constant,
            (*self.tables, *other.tables),
        )

    @property
    def fixed(self) -> bool:
        """True if the value of the sum does not change from step to step."""
        return not (self.squares or self.bells or self.plus or self.tables)

    @property
    def never(self) -> bool:
        """True if constants alone show that the sum is never positive."""
        return not self.tables and (self.constant <= -FORCED or (self.fixed and self.constant <= 0))

    @property
    def key(self) -> tuple[object, ...]:
        """The parts of the sum as a tuple, by which sums are compared."""
        squares = [(names, Psi.by if isinstance(Psi, Scheduled) else Psi.tobytes()) for names, Psi in self.squares]
        bells = [(names, bell.height, bell.Pi.tobytes()) for names, bell in self.bells]
        tables = [(table.by, table.values.tobytes()) for table in self.tables]
        return (*squares, *bells, *sorted(self.plus.items()), self.constant, *tables)

    @property
    def selected_by(self) -> list[str]:
        """Names of the discrete states that select the entries of the tables in the sum."""
        found = [Psi.by for _, Psi in self.squares if isinstance(Psi, Scheduled)]
        return list(dict.fromkeys([*found, *(table.by for table in self.tables)]))

    def at(self, location: str, place: int) -> _Sum:
        """Return the sum for one value of a discrete state."""
        squares = [
            (names, Psi.values[place] if isinstance(Psi, Scheduled) and Psi.by == location else Psi)
            for names, Psi in self.squares
        ]
        here = [float(table.values[place]) for table in self.tables if table.by == location]
        return replace(
            self,
            squares=tuple((names, Psi) for names, Psi in squares if isinstance(Psi, Scheduled) or Psi.any()),
            constant=self.constant + sum(here),
            tables=tuple(table for table in self.tables if table.by != location),
        )


@dataclass(frozen=True)
class _Term:
    """A term of an inequality: a weight times a text."""

    text: str
    weight: float = 1.0
    root: str = ""  # the length whose square the text is
    entry: str = ""  # the symbol of a scalar whose square the text is
    letter: str = ""  # of its matrix
    drawn: bool = False  # whether it is a random number
    words: bool = False  # whether the text is words

    @property
    def whole(self) -> str:
        """The term as text. Its weight is written without its sign."""
        size = _number(abs(self.weight))
        return self.text if size == "1" else f"{size} {'× ' * self.words}{self.text}"


class _Reader:
    """The decision of one node in words; it collects the symbols and matrices of its clauses."""

    def __init__(self, policy: PolicyData, decide: Decide) -> None:
        """Store the decision and the steps before it."""
        self._policy, self._decide, self._words = policy, decide, Words(policy)
        self._before = policy.steps[: policy.steps.index(decide)]
        self._symbols: dict[str, str] = {}
        self._matrices: dict[str, Matrix] = {}
        self._taken: dict[str, str] = {}
        self._follows: set[str] = set()
        self._brief = False  # whether scalar signals are not explained, as they differ from value to value
        names = dict.fromkeys(name for form in decide.trigger.forms for name in form.signals)
        base = [self._base(name) for name in names]
        self._several = {symbol for symbol in base if base.count(symbol) > 1}

    def rule(self, send: Send) -> Rule:
        """Describe in words when this decision sends packets on a link."""
        trigger, others = self._decide.trigger, [one for one in self._sends() if one.link != send.link]
        sending = send.sending(trigger.labels)
        silent = [label for label in trigger.labels if label not in sending]
        if trigger.limit is None and len(silent) == 1:
            when, more = self._when(silent[0], sending)
        else:
            when, more = self._of_sets(sending, bool(others)), ()
        return self._rule(when, (*more, *self._limits(sending, silent)), tuple(one.link for one in others))

    def choice(self) -> Rule:
        """Describe in words which label a decision without sends selects."""
        trigger, plain = self._decide.trigger, self._words.plain
        first, *others = trigger.labels
        clauses = self._clauses(_difference(trigger, first, others[0])) if len(others) == 1 else []
        if trigger.limit is None and clauses:
            return self._rule(f"{plain(others[0])} when {listed(clauses, 'or')}, otherwise {plain(first)}")
        least = "the least" if trigger.limit is None else f"the first of at most {_number(trigger.limit)}"
        return self._rule(f"{least} of {number_of(len(trigger.labels), 'value')} decides")

    def _rule(self, when: str, limits: tuple[str, ...] = (), together: tuple[str, ...] = ()) -> Rule:
        return Rule(when, limits, self._symbols, self._matrices, together, frozenset(self._follows))

    def _sends(self) -> list[Send]:
        return [one for one in self._policy.steps if isinstance(one, Send) and one.on == self._decide.decision]

    def _when(self, silent: str, sending: Sequence[str]) -> tuple[str, tuple[str, ...]]:
        """Return the clause of a decision between silence and labels that all send, and when it compares."""
        differences = [_difference(self._decide.trigger, silent, label) for label in sending]
        by = list(dict.fromkeys(name for one in differences for name in one.selected_by))
        opened, more = ("", ()) if len(by) != 1 else self._open(by[0], differences)
        compared = [self._only(one, by) for one in differences if self._counted(one) is None]
        clauses = list(dict.fromkeys(clause for one in compared for clause in self._clauses(one)))
        if not clauses:
            return NEVER, ()
        if "" in clauses:
            return opened or "at every step", more
        clause = listed(clauses, "or") if clauses[0].startswith(LIKELY) else f"when {' or '.join(clauses)}"
        return f"{opened}, {clause}" if opened else clause, more

    def _open(self, by: str, sums: Sequence[_Sum]) -> tuple[str, tuple[str, ...]]:
        """Return the steps at which a decision compares, if silence always wins in some states of a location."""
        location = self._location(by)
        opened = [any(not one.at(by, i).never for one in sums) for i in range(len(location.table))]
        if all(opened):
            return "", ()
        if location.on is None:
            visited, start = walk([location], self._policy.decisions) or ([], 0)
            return _at(pattern_text([opened[here[0]] for here in visited], start)), ()
        if location.on != self._decide.decision or self._since(location) is not None:
            return "", ()
        first, *others = (
            {_wait(location, opened, i, column) for i, compares in enumerate(opened) if compares}
            for column in range(location.table.shape[1])
        )
        packet = set[int].union(*others)
        if len(first) != 1 or len(packet) != 1 or 0 in first | packet:
            return "", ()
        (silence,), (sent,) = first, packet
        every = "every step" if silence == 1 else f"every {ordinal(silence)} step"
        return "", (f"compared at {every} of silence and {number_of(sent, 'step')} after a packet",)

    def _only(self, one: _Sum, by: Sequence[str]) -> _Sum:
        """Return a sum as it is in all states of locations in which it may be positive, if it is equal in them."""
        for name in by:
            states = range(len(self._location(name).table))
            found = [here for here in (one.at(name, i) for i in states) if not here.never]
            if len({here.key for here in found}) == 1:
                one = found[0]
        return one

    def _clauses(self, one: _Sum) -> list[str]:
        """Return clauses of which one holds if a sum is positive: none if it never is, an empty one if it always is."""
        if one.fixed:
            return [""] if one.constant > 0 else []
        if len(one.plus) == 1 and not (one.squares or one.bells or one.tables):
            found = self._followed(one, *next(iter(one.plus.items())))
            if found is not None:
                return found
        return [self._inequality(one)]

    def _followed(self, one: _Sum, name: str, weight: float) -> list[str] | None:
        """Return the clauses of a comparison of one scalar signal with a constant, from the steps that compute it."""
        kept = self._words.made(name)
        if len(kept) == 1 and isinstance(kept[0], Evaluate):
            if (clause := self._counted_down(kept[0], name, one.constant, weight)) is not None:
                return [clause]
            if _latched(kept[0], name) and weight < 0 < one.constant <= -weight:
                return [FIRST_ARRIVAL if isinstance(kept[0].on, Acknowledged) else FIRST_STEP]
        if self._words.plain(name) == "changed inputs" and weight < 0 < one.constant < -weight:
            return [NONE]
        flag = FLAGS.get(self._words.plain(name))
        if flag is not None and 0 < -one.constant / weight < 1:
            return [flag]
        earlier = [step for step in self._before if isinstance(step, Evaluate) and step.signal == name]
        if not earlier or not isinstance(earlier[-1].on, str):
            return None
        found = [_Sum.of(form, weight) + _Sum(constant=one.constant) for form in earlier[-1].forms]
        trigger = self._policy.decisions[earlier[-1].on]
        if any(name in one.plus for one in found) or trigger.limit is not None or trigger.excluded:
            return None
        if not all(one.fixed and one.constant > 0 for one in found[1:]):
            return None
        self._follows.add(earlier[-1].on)
        usual = [self._inequality(one)] if found[0].squares else self._clauses(found[0])
        first, *others = trigger.labels
        return [*usual, *(clause for label in others for clause in self._clauses(_difference(trigger, first, label)))]

    def _counted_down(self, step: Evaluate, name: str, constant: float, weight: float) -> str | None:
        """Return the clause of a number of steps that was chosen at the last packet and is counted down."""
        first, *others = step.forms
        if step.on != self._decide.decision or weight > 0 or constant <= 0 or any(len(one.plus) != 1 for one in others):
            return None
        if first.signals or dict(first.plus) != {name: 1.0} or first.constant != -1:
            return None
        chosen = {signal for form in others for signal in form.plus}
        made = [one for one in self._before if isinstance(one, Evaluate) and one.signal in chosen]
        values = [form.constant for one in made for form in one.forms if not form.reads]
        numbers = [value for value in values if not isinstance(value, Scheduled)]
        span = f" of {min(numbers):g} to {max(numbers):g} steps" if numbers else ""
        return f"the wait{span} that it chose at its last packet is over"

    def _inequality(self, one: _Sum) -> str:
        """Return a sum that is positive as an inequality."""
        terms = [*self._squares(one), *self._scalars(one)]
        left = [term for term in terms if term.weight > 0]
        right = [term for term in terms if term.weight < 0]
        threshold = self._threshold(one) if one.tables else -one.constant
        limit = threshold if isinstance(threshold, float) else 0.0
        right += [_Term(threshold, -1.0)] if isinstance(threshold, str) else []
        if len(left) == len(right) == 1 and right[0].drawn and not limit and right[0].weight == -1:
            self._symbols.pop(right[0].text, None)
            return f"{LIKELY} 1 − exp(−{left[0].whole})"
        squares = [*left, *right] if len(left) == 1 and len(right) + (limit > 0) <= 1 and limit >= 0 else []
        if squares and all(term.root for term in squares):
            return self._compared(left[0], right, limit)
        if limit < 0 and right and not left:  # −a > −c as a < c
            return f"{_added(right)} < {_number(-limit)}"
        if limit < 0:
            return f"{_added(left, _number(-limit))} > {_added(right) or '0'}"
        return f"{_added(left) or '0'} > {_added(right, _number(limit) if limit or not right else '')}"

    def _compared(self, left: _Term, right: Sequence[_Term], limit: float) -> str:
        """Return an inequality of squares as one of lengths."""
        if right:
            ratio = _number(math.sqrt(-right[0].weight / left.weight))
            return f"{left.root} > {right[0].root if ratio == '1' else f'{ratio} {right[0].root}'}"
        length = f"{left.root} > {_number(math.sqrt(limit / left.weight))}"
        if not left.entry or left.weight == 1 or limit == 0:
            return length
        letter = self._letter(np.array([[left.weight]]))
        return f"{left.entry}'{letter}{left.entry} > {_number(limit)} ({length})"

    def _squares(self, one: _Sum) -> list[_Term]:
        """Return the quadratic terms of a sum, and its Gaussian terms."""
        found, others = list[_Term](), list[tuple[tuple[str, ...], Matrix]]()
        for names, Psi in one.squares:
            parts = [(names, Psi)] if isinstance(Psi, Scheduled) else self._blocks(names, Psi)
            for block, part in parts:
                term = None if isinstance(part, Scheduled) else self._simple(block, part)
                found += [] if term is None else [term]
                others += [(block, part)] if term is None else []
        found += [self._general(names, Psi) for names, Psi in others]
        for names, bell in one.bells:
            stacked, letter = self._stacked(names), self._letter(bell.Pi, EXPONENTS)
            found.append(_Term(f"exp(−½ {stacked}'{letter}{stacked})", bell.height))
        return found

    def _general(self, names: Sequence[str], Psi: Matrix) -> _Term:
        """Return the term of signals that a matrix weighs; a negative semidefinite matrix has the weight −1."""
        modes = np.linalg.eigvalsh(_entries(Psi))
        sign = 1.0 if float(modes.max()) > ROUNDED * float(np.abs(modes).max()) else -1.0
        weight = _opposite(Psi) if sign < 0 else Psi
        stacked, letter = self._stacked(names), self._letter(weight)
        if isinstance(Psi, Scheduled):
            self._symbols[letter] = f"matrix that {self._changes(Psi.by)}"
        return _Term(f"{stacked}'{letter}{stacked}", sign, letter=letter)

    def _letter(self, matrix: Matrix, letters: str = LETTERS) -> str:
        """Return the letter of a matrix; equal matrices have one letter."""
        for letter, other in self._matrices.items():
            if (
                letter[0] in letters
                and type(other) is type(matrix)
                and np.array_equal(_entries(other), _entries(matrix))
            ):
                return letter
        free = [letter for letter in letters if letter not in self._matrices]
        letter = free[0] if free else f"{letters[0]}{len(self._matrices)}"
        self._matrices[letter] = matrix
        return letter

    def _simple(self, names: Sequence[str], Psi: Array) -> _Term | None:
        """Return the term of one entry of a signal, or of its length, or None."""
        if len(names) > 1:
            return None
        (rows, columns), size = np.nonzero(Psi), Psi.shape[0]
        if size > 1 and rows.size == 1 and rows[0] == columns[0]:
            i = int(rows[0])
            entry = f"{self._symbol(names[0])}{i + 1}"
            return _Term(f"{entry}²", float(Psi[i, i]), f"|{entry}|", entry)
        if not np.array_equal(Psi, Psi[0, 0] * np.eye(size)):
            return None
        symbol, weight = self._symbol(names[0]), float(Psi[0, 0])
        if size == 1:
            return _Term(f"{symbol}²", weight, f"|{symbol}|", symbol)
        return _Term(f"|{symbol}|²", weight, f"|{symbol}|")

    def _blocks(self, names: Sequence[str], Psi: Array) -> list[tuple[tuple[str, ...], Array]]:
        """Return the signals that entries of Ψ connect, with their part of it; parts that are zero are left out."""
        ends = np.cumsum([0, *(self._policy.sizes[name] for name in names)])
        rows = [np.arange(ends[i], ends[i + 1], dtype=np.intp) for i in range(len(names))]
        groups = [{i} for i in range(len(names))]
        for i in range(len(names)):
            for j in range(i):
                if Psi[np.ix_(rows[i], rows[j])].any():
                    joined = [group for group in groups if i in group or j in group]
                    groups = [group for group in groups if group not in joined] + [set[int]().union(*joined)]
        found = list[tuple[tuple[str, ...], Array]]()
        for group in sorted(map(sorted, groups)):
            entries = np.concatenate([rows[i] for i in group])
            part = Psi[np.ix_(entries, entries)]
            found += [(tuple(names[i] for i in group), part)] if part.any() else []
        return found

    def _scalars(self, one: _Sum) -> list[_Term]:
        found = [(self._scalar(name), weight, self._words.drawn(name)) for name, weight in one.plus.items()]
        return [_Term(text, weight, drawn=drawn, words=not drawn) for text, weight, drawn in found]

    def _scalar(self, name: str) -> str:
        """Return the words of a scalar signal, and note how it is computed."""
        words = self._words
        if words.drawn(name):
            self._symbols[words.symbol(name)] = words.meaning(name)
            return words.symbol(name)
        said = words.meaning(name)
        steps = [step for step in words.made(name) if isinstance(step, Evaluate)]
        if said in self._symbols or self._brief or not steps:
            return said
        self._symbols[said] = ""  # its place is before the symbols that it is computed from
        told = [text for step in steps for text in self._computed(step, name)]
        self._symbols[said] = "; ".join(dict.fromkeys(told)) or "memory of the node"
        return said

    def _computed(self, step: Evaluate, name: str) -> list[str]:
        """Return how a policy step computes a scalar signal."""
        if step.on is None:
            return self._added_up(step.forms[0], name, "in each step")
        if isinstance(step.on, str) and name not in {other for form in step.forms for other in form.plus}:
            return [self._value(step.forms[0])]  # the other values are clauses of the rule
        if step.on != self._decide.decision or len(step.forms) != 2:
            return []
        silent, sent = step.forms
        return [*self._added_up(silent, name, "in silence"), *self._added_up(sent, name, "after a packet")]

    def _added_up(self, form: Form, name: str, when: str) -> list[str]:
        """Return how a form changes a scalar signal in a step."""
        kept = form.plus.get(name, 0.0)
        others = {other: weight for other, weight in form.plus.items() if other != name}
        pays = kept == 1 and any(weight < 0 for weight in others.values())
        rest = Form(form.signals, form.Psi, form.constant, {} if pays else others, form.bell)
        given = bool(rest.reads) or isinstance(rest.constant, Scheduled) or rest.constant != 0
        value = self._value(rest) if given else ""
        if kept == 1:
            grows = [f"gains {value} {when}"] if value else []
            return [*grows, "pays the cost of each silence"] if pays else grows
        when = "" if when == "in each step" else f" {when}"
        if not kept:
            return [f"{value or '0'}{when}"]
        return [f"{_number(kept)} times its last value{f' + {value}' if value else ''}{when}"]

    def _value(self, form: Form) -> str:
        """Return a form as a sum."""
        one = _Sum.of(form)
        terms = [*self._squares(one), *self._scalars(one)]
        threshold = self._threshold(one) if one.tables else -one.constant
        constant = -threshold if isinstance(threshold, float) else 0.0
        terms += [_Term(threshold, -1.0)] if isinstance(threshold, str) else []
        plus = [term.whole for term in terms if term.weight > 0] + ([_number(constant)] if constant > 0 else [])
        minus = [term.whole for term in terms if term.weight < 0] + ([_number(-constant)] if constant < 0 else [])
        if not plus and minus:
            return " − ".join((f"−{minus[0]}", *minus[1:]))
        return " − ".join((" + ".join(plus), *minus)) or "0"

    def _threshold(self, one: _Sum) -> str | float:
        """Return the threshold that a location selects: a number if all are equal, or its symbol."""
        by = one.tables[0].by
        values = -one.constant - np.sum([table.values for table in one.tables if table.by == by], axis=0)
        shown = values[np.abs(values) < FORCED]
        low, high = (float(shown.min()), float(shown.max())) if len(shown) else (0.0, 0.0)
        if _number(low) == _number(high):
            return high
        self._symbols["c"] = f"{_number(low)} to {_number(high)}, {self._changes(by)}"
        return "c"

    def _changes(self, by: str) -> str:
        """Return how a table changes that a location selects."""
        location = self._location(by)
        if location.on is None:
            return "changes with the step"
        if self._since(location) is not None:
            return "changes with the steps since the last packet"
        return f"changes with the {self._words.plain(by)} of the node"

    def _location(self, name: str) -> Location:
        return next(one for one in self._policy.locations if one.name == name)

    def _since(self, location: Location) -> int | None:
        """Return the state of a location at the step after a packet, if it counts the steps since the last packet."""
        if location.on != self._decide.decision or location.table.shape[1] != 2:
            return None
        counts, resets = location.table[:, 0], location.table[:, 1]
        following = np.minimum(np.arange(len(counts)) + 1, len(counts) - 1)
        return int(resets[0]) if np.array_equal(counts, following) and (resets == resets[0]).all() else None

    def _symbol(self, name: str) -> str:
        """Return the symbol of a vector signal, and note its meaning; equal symbols of several signals are numbered."""
        for symbol, other in self._taken.items():
            if other == name:
                return symbol
        base = self._base(name)
        symbol, i = f"{base}1" if base in self._several else base, 1
        while symbol in self._taken:
            i += 1
            symbol = f"{base}{i}"
        self._taken[symbol] = name
        self._symbols[symbol] = self._words.meaning(name)
        return symbol

    def _base(self, name: str) -> str:
        symbol = self._words.symbol(name)
        return "s" if len(symbol) > SYMBOL or " " in symbol else symbol

    def _stacked(self, names: Sequence[str]) -> str:
        """Return the symbol of signals below each other."""
        if len(names) == 1:
            return self._symbol(names[0])
        before = dict(self._symbols)
        below = f"({', '.join(self._symbol(name) for name in names)})"
        symbol = STACKED
        while before.get(symbol, below) != below:
            symbol += "′"
        self._symbols = {**before, symbol: below, **self._symbols}
        return symbol

    def _limits(self, sending: Sequence[str], silent: Sequence[str]) -> tuple[str, ...]:
        """Return the limits of the intervals between packets, and other exclusions of labels."""
        earliest, latest, more = list[int](), list[int](), list[str]()
        for one in self._excluding(sending):
            if (steps := self._counted(one)) is not None:
                earliest.append(steps)
            elif clauses := self._clauses(one):
                more.append(f"but not when {' or '.join(clauses)}")
        trigger, forcing = self._decide.trigger, self._excluding(silent)
        if trigger.limit is None and len(silent) == 1:
            forcing += [_difference(trigger, silent[0], label) for label in sending]
        for one in forcing:
            if (steps := self._counted(one)) is not None:
                latest.append(steps)
        for one in self._excluding(silent):
            clauses = self._clauses(one) if self._counted(one) is None else []
            more += [one if one in (FIRST_STEP, FIRST_ARRIVAL) else f"and when {one}" for one in clauses]
        if trigger.limit is None and len(silent) == len(sending) == 1:
            for location in self._policy.locations:
                early, late = self._limits_of(location, _difference(trigger, silent[0], sending[0]))
                earliest, latest = [*earliest, *early], [*latest, *late]
        found = [f"at the earliest {self._time(max(earliest))}"] if earliest else []
        found += [f"at the latest {self._time(min(latest))}"] if latest else []
        limits = [f"{' and '.join(found)} after the last packet"] if found else []
        return tuple(dict.fromkeys((*limits, *more)))

    def _excluding(self, labels: Sequence[str]) -> list[_Sum]:
        """Return the sums that exclude all of these labels while they are positive."""
        first, *others = ([_Sum.of(form) for form in self._decide.trigger.excluded.get(one, ())] for one in labels)
        return [one for one in first if all(one.key in {other.key for other in excluded} for excluded in others)]

    def _limits_of(self, location: Location, one: _Sum) -> tuple[list[int], list[int]]:
        """Return the limits of intervals that a location keeps by constants that decide whatever the signals are."""
        start = self._since(location)
        if start is None:
            return [], []
        values = [one.at(location.name, i).constant for i in range(start, len(location.table))]
        early = next((i for i, value in enumerate(values) if value > -FORCED), None)
        late = next((i for i, value in enumerate(values) if value >= FORCED), None)
        return [early + 1] if early else [], [] if late is None else [late + 1]

    def _counted(self, one: _Sum) -> int | None:
        """Return the steps after the last packet from which, or until which, a sum is positive, if it counts them."""
        if one.squares or one.bells or one.tables or len(one.plus) != 1:
            return None
        name, weight = next(iter(one.plus.items()))
        steps = self._words.made(name)
        if len(steps) != 1 or not isinstance(steps[0], Evaluate | Assign) or steps[0].on != self._decide.decision:
            return None
        parts = [_weights(branch) for branch in _branches(steps[0])]
        if any(part not in ({name: 1.0, ONE: 1.0}, {ONE: 1.0}) for part in parts) or {ONE: 1.0} not in parts:
            return None
        return math.ceil(-one.constant / weight)

    def _time(self, steps: int) -> str:
        """Return a number of steps, with its seconds if a step has a duration."""
        seconds = step_seconds(self._policy)
        return number_of(steps, "step") + ("" if seconds is None else f" ({_number(steps * seconds)} s)")

    def _of_sets(self, sending: Sequence[str], several: bool) -> str:
        """Return the clause of a decision for sets of packets, or for one of several labels that send or are silent."""
        trigger, self._brief = self._decide.trigger, True
        carried = [(one.link, one.sending(trigger.labels)) for one in self._sends()]
        values = dict[str, str]()
        for label, form in list(trigger.options.items())[:LISTED]:
            links = [link for link, labels in carried if label in labels]
            said = (listed(links) or "no packet") if several else self._words.plain(label)
            values[f"value of {said}"] = self._value(form)
        self._symbols |= values
        best = "the least value" if trigger.limit is None else f"the first value of at most {_number(trigger.limit)}"
        if several:
            return f"when its packet is in the set with {best}"
        return f"when {listed([self._words.plain(label) for label in sending], 'or')} has {best}"


def _difference(trigger: Trigger, silent: str, sending: str) -> _Sum:
    return _Sum.of(trigger.options[silent]) + _Sum.of(trigger.options[sending], -1.0)


def _settled(Psi: Matrix) -> Matrix:
    """Return a matrix, or the matrix of a table whose entries are all equal."""
    return Psi.values[0] if isinstance(Psi, Scheduled) and bool((Psi.values == Psi.values[0]).all()) else Psi


def _opposite(matrix: Matrix) -> Matrix:
    return Scheduled(matrix.by, -matrix.values) if isinstance(matrix, Scheduled) else -matrix


def _entries(matrix: Matrix) -> Array:
    return matrix.values if isinstance(matrix, Scheduled) else matrix


def _wait(location: Location, opened: Sequence[bool], place: int, column: int) -> int:
    """Return the steps from one comparison to the next after an outcome; 0 if there is no further one."""
    here, steps = int(location.table[place, column]), 1
    while not opened[here]:
        here, steps = int(location.table[here, 0]), steps + 1
        if steps > len(opened) + 1:
            return 0
    return steps


def _branches(step: Evaluate | Assign) -> Sequence[Form | Terms]:
    return step.forms if isinstance(step, Evaluate) else step.branches


def _weights(branch: Form | Terms) -> Mapping[str, float] | None:
    """Return the weights of a branch that is a sum of scalars, with that of the constant 1; None for another branch."""
    if not isinstance(branch, Form):
        found = {name: weight for name, weight in branch.items() if isinstance(weight, np.ndarray) and weight.size == 1}
        return {name: float(weight[0, 0]) for name, weight in found.items()} if len(found) == len(branch) else None
    if branch.signals or isinstance(branch.constant, Scheduled):
        return None
    return {**branch.plus, **({ONE: branch.constant} if branch.constant else {})}


def _latched(step: Evaluate, name: str) -> bool:
    """Return whether a step keeps a signal until an outcome sets it to 1."""
    return all(_weights(form) in ({name: 1.0}, {ONE: 1.0}) for form in step.forms)


def _number(value: float) -> str:
    return number_text(value, DIGITS).replace("-", "−", 1) if value < 0 else number_text(value, DIGITS)


def _added(terms: Sequence[_Term], more: str = "") -> str:
    return " + ".join([*(term.whole for term in terms), *([more] if more else [])])
