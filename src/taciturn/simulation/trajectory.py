"""A simulated path of a closed loop with all its signals, its figure, and means over many paths at each step.

``simulate`` records states, estimates, inputs, measurements, the packets of each link and which of them it drops, and
the two values that a decision compares: the least value of an option without the packet, and the least value of one
with it. It uses the bit-exact build, so nodes with the recorded measurements compute the recorded inputs bit for bit.
If the actuator predicts, the recorded estimate is its prediction, and the input u = L x̂ is that at the beginning of the
step. Another loop (``versus``) has the same noise: both programs draw the numbers that either of them needs.

The figure of a path shows over time, from top to bottom:

* the outputs y = C x without the noise of their measurement, with their estimates, their set-points, and the limits of
  the states that the problem states; in one panel if they are of one size, else in one panel each,
* the disturbances, and the inputs that the plant gets, with their limits,
* a lane for each link: a stroke for a packet that is delivered, a cross for one that the link drops, and an open circle
  for one that arrives no earlier than a newer one, so that the receiver does not use it,
* each trigger as the ratio of the value of silence to its threshold, on a logarithmic axis: a packet is sent above 1.
  Scalar signals that allow silence, such as the content of a bank, are part of the threshold. If the threshold may be
  zero or negative, the trigger is the difference, and a packet is sent above 0.

``course`` averages stage cost and sends at each step over independent paths. For an average cost it divides by the
period, so that the course converges to the average; for a finite horizon or a discount, the stages and the final cost
add up to the total. The cost of the noise between samples, which no control changes, is added.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from taciturn._arrays import Array, Bits, choice, count, instance
from taciturn._display import Displayed
from taciturn._figure import Band, Curve, Lane, Level, Panel, Series, Side, Size, StyleName, draw
from taciturn._style import Thing, find_style, policy_looks
from taciturn._text import link_names, number_of, percent, symbol, table_text, width
from taciturn.errors import ProblemError
from taciturn.loop import COST, Loop, close
from taciturn.lqg.registers import registers_of
from taciturn.model.estimate import Estimate
from taciturn.model.names import Names, Role, common_unit, unit_of
from taciturn.model.policy import Policy, own_problem
from taciturn.model.result import FIRST, LAST, VERDICT, Column, Columns, Field, Result, Tabular, plain_fields
from taciturn.model.signals import Exosystem
from taciturn.model.steps import Received, Send
from taciturn.model.trigger import Trigger
from taciturn.program.draws import NORMAL, UNIFORM, draws_of
from taciturn.program.engine import prepare
from taciturn.program.ir import Program
from taciturn.program.missing import SAMPLED
from taciturn.program.numpy import Run
from taciturn.program.ops import Arrived, Name, Option, Scalar, Sent, is_entry
from taciturn.simulation.late_packets import LatePackets, cuts_of, fates_of, late_links, of_records
from taciturn.simulation.same_packets import periodic_control
from taciturn.simulation.sampling import expect_numbers, find_loss, sends
from taciturn.simulation.statistics import mean

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ADDRESSES = 2**47  # bytes that a process can address, of which NumPy refuses more in other ways
_COLUMNS, _COLUMN = 6, 12  # columns next to the time that the text has at least, and width of one in a wider line
_PATHS = 4096
TOGETHER, ALIKE = 4, 6.0  # most curves in a panel, and largest ratio of their ranges
NEAR = 1.0  # distance of a limit that is shown from the values, relative to their range
ROOM = 0.06  # of an axis above and below its values, relative to their range
LEAST = 0.1  # least ratio of a trigger to its threshold that is shown
MOST = 0.9  # share of the steps in which a threshold that is never negative must be positive for ratios to it
LEAST_DIFFERENCE = 0.005  # of the costs of two paths, relative to the first, that is written
NARROW, ROWS = 4.0, 2  # width in inches of a figure that leaves out curves, and its largest number of triggers
TALL, LOW, FLAT = 1.7, 0.95, 0.55  # heights in inches of panels: of all outputs, of one signal, of one of many triggers
SAME = 1e-9  # relative difference of numbers that are equal but for rounding
PREDICTED = "prediction of x by the actuator's model, which gives the input u = L xhat"


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Tabular):
    """Signals and packets of a simulated path of a loop, at every step.

    Args:
        time: time of each step, (steps,).
        unit: unit of the time: ``"s"``, or ``"steps"`` if the plant has no ``dt``.
        state: state of the plant, (steps, n).
        estimate: estimate x̂, (steps, n); empty if the policy has none. If the actuator predicts, it is the prediction.
        input: input applied to the plant, (steps, m); if the actuator predicts, the input at the beginning of the step.
        triggers: value of silence in the decision on each link, (steps,), if the decision depends on signals; for a
            policy that plans its sends in advance, it indicates whether or when a send is due.
        thresholds: least value of sending in this decision; nothing is sent while the trigger is at most the threshold,
            unless a limit of the intervals between sends demands or forbids a packet.
        allowances: by how much scalar signals, such as the content of a bank, reduce the values of options, by link, if
            they do; in a figure, a trigger is (trigger + allowance)/(threshold + allowance).
        sends: whether a packet was sent at each step, by link, (steps,).
        delivered: whether a packet was sent and the link delivered it, perhaps later, by link, (steps,).
        overtaken: whether a packet was sent that a newer one has overtaken, by link with random delays, (steps,).
        late: how late the packets are and how old the data that the receiver uses, by link with random delays.
        measurement: measurement y, (steps, p); where it is missing, the value that its node uses in its place.
        missing: whether each output is missing at each step, (steps, p); empty if none can be missing.
        reference: target of the state by a stored reference, (steps, n); empty without a reference.
        cost: cost of this path: per step or second, or over a horizon the cost so far; a single path may differ much
            from the mean, which ``evaluate`` computes.
        loop: the loop, in the units of the plant.
        predicts: whether the actuator integrates the model dx̂/dt = (A + BL) x̂ between steps, and applies u = L x̂.
        name: name of the control in a figure.
        versus: path of another loop with the same noise, or None.
    """

    FIELDS: ClassVar[tuple[Field[Trajectory], ...]] = (
        VERDICT,
        Field("ticks", lambda found: len(found.time)),
        *plain_fields("time", "unit", "state", "estimate", "input", "predicts"),
        Field("measurement", lambda found: found.measured),
        *plain_fields("trigger_value", "threshold", "sends", "delivered", "triggers", "thresholds"),
        *plain_fields("allowances", "cost"),
        Field("overtaken", optional=True),
        Field("late", key="late_packets", optional=True, say="late packets, {}", text="{}"),
        Field("names", lambda found: (found.loop.names or Names()).document(), optional=True),
        Field("registers", optional=True),
        Field("predicted", key="", say="xhat", text=lambda found: PREDICTED if found.predicts else ""),
        Field("omitted", key="", say="note"),
        Field("versus", json=lambda path: {"name": path.name, **path.document()}, optional=True),
    )
    index: ClassVar[str] = "time"
    heading: ClassVar[tuple[str, ...]] = ("unit",)

    time: Array
    unit: str
    state: Array
    estimate: Array
    input: Array
    triggers: Mapping[str, Array]
    thresholds: Mapping[str, Array]
    allowances: Mapping[str, Array]
    sends: Mapping[str, Bits]
    delivered: Mapping[str, Bits]
    overtaken: Mapping[str, Bits]
    late: Mapping[str, LatePackets]
    measurement: Array
    missing: Bits
    reference: Array
    cost: float
    loop: Loop
    predicts: bool = False
    name: str = ""
    versus: Trajectory | None = None

    @property
    def measured(self) -> Sequence[Sequence[float | None]]:
        """The measurements of each step, with None in place of those that are missing."""
        rows: list[list[float | None]] = self.measurement.tolist()
        for k, i in np.argwhere(self.missing).tolist():
            rows[k][i] = None
        return rows

    @property
    def trigger_value(self) -> Array:
        """Values of the trigger on the first link that has one; empty if no link has one."""
        return next(iter(self.triggers.values()), np.empty(0))

    @property
    def threshold(self) -> Array:
        """Thresholds of the trigger on the first link that has one; empty if no link has one."""
        return next(iter(self.thresholds.values()), np.empty(0))

    @property
    def step(self) -> float:
        """Duration of a step in the unit of the field ``time``."""
        return self.loop.problem.plant.dt or 1.0

    def packets(self, link: str, unit: str = "") -> str:
        """Write in how many steps a link sent a packet, and how many of its packets were dropped or overtaken."""
        sent = self.sends[link]
        counts = {"dropped": int((sent & ~self.delivered[link]).sum())}
        counts |= {"overtaken": int(self.overtaken[link].sum())} if link in self.overtaken else {}
        told = "".join(f", {count} {what}" for what, count in counts.items() if count)
        return f"{int(sent.sum())} of {len(sent)}{unit}{told}"

    @property
    def registers(self) -> dict[str, str]:
        """Contents of the states that delays of links add to a plant, by the symbol of the state."""
        return {f"x{i + 1}": name for i, name in self._registers().items()}

    def _registers(self) -> dict[int, str]:
        """Return what registers hold, by the number of the state from 0."""
        problem, source = self.loop.problem, self.loop.problem.source
        if source is None or not problem.registers.any():
            return {}
        names = self.loop.names or Names()
        held = registers_of(source, problem.tick).names(
            names.numbered("inputs", source.inputs), names.numbered("outputs", len(source.C))
        )
        return dict(enumerate(held, start=source.states))

    def summary(self) -> Mapping[str, object]:
        """Return the values to display: number of steps, packets of each link, and numbers of signals."""
        packets = {link: self.packets(link) for link in self.sends}
        last = f"0 to {self.time[-1]:.6g} {self.unit}"
        return {"steps": len(self.time), "time": last, "sends": packets, "state": self.state, "input": self.input}

    def plot(self, ax: Any = None, figsize: Size | None = None, style: StyleName = "light") -> Figure:
        """Draw outputs, inputs, the packets of each link, and triggers. A second path is drawn next to the first.

        The figure of two paths shows the triggers that both paths have; periodic control has none.

        For a column of a journal (``style="paper"``), the figure omits the estimates of several outputs and, of more
        than two triggers, all but the first and the last; it then says how many it shows.
        """
        paths = [self] if self.versus is None else [self, self.versus]
        brief = find_style(style).width < NARROW
        return draw([Side(_panels(path, paths, brief)) for path in paths], ax, figsize, style)

    @property
    def verdict(self) -> tuple[str, ...]:
        """How many packets were sent, on each link and in total, in words."""
        steps, counts = len(self.time), {link: int(sent.sum()) for link, sent in self.sends.items()}
        lasted = "" if self.unit == "steps" or steps < 2 else f" ({steps * self.step:.6g} s)"
        total = sum(counts.values())
        share = "" if not counts else f", {percent(total / (steps * len(counts)), 1)} of the packets"
        each = f": {', '.join(f'{link} {self.packets(link)}' for link in counts)}" if len(counts) > 1 else ""
        gone = {"dropped": sum(int((sent & ~self.delivered[link]).sum()) for link, sent in self.sends.items())}
        gone["overtaken"] = sum(int(overtaken.sum()) for overtaken in self.overtaken.values())
        told = " and ".join(f"{n} {'was' if n == 1 else 'were'} {what}" for what, n in gone.items() if n)
        lost = f", of which {told}" if told and len(counts) == 1 else ""
        own = f"{number_of(total, 'packet')} in {number_of(steps, 'step')}{lasted}{share}{lost}{each}"
        if self.versus is None:
            return (own,)
        others = sum(int(sent.sum()) for sent in self.versus.sends.values())
        return (
            f"{own}; cost {self.cost:.4g} on this path",
            f"{self.versus.name} with the same noise: {number_of(others, 'packet')}, cost {self.versus.cost:.4g}",
        )

    def _shown(self) -> tuple[list[tuple[str, Array]], bool, bool]:
        """Return the columns that fit into a line, and whether columns and steps are left out."""
        named = [("x", self.state), ("u", self.input), *([("xhat", self.estimate)] if self.predicts else [])]
        names, columns = self.loop.names or Names(), list[tuple[str, Array]]()
        roles: Mapping[str, Role] = {"x": "states", "u": "inputs"}
        held = self._registers()
        for name, values in named:
            usual = [held.get(i, f"x{i + 1}") if name == "x" else f"{name}{i + 1}" for i in range(values.shape[1])]
            columns += zip(names.labels(roles[name], usual) if name in roles else usual, values.T, strict=True)
        longest = max([_COLUMN, *(len(name) + 2 for name, _ in columns)])
        room = max(_COLUMNS, width() // longest - 1)
        left = max(0, len(columns) - (room - len(self.sends)))
        return columns[: len(columns) - left], left > 0, len(self.time) > FIRST + LAST

    @property
    def omitted(self) -> str:
        """Sentence that states which columns and steps the printed table omits; empty if it is complete."""
        _, columns, steps = self._shown()
        what = " and ".join(["columns"] * columns + ["steps"] * steps)
        return f"some {what} are omitted; --json, --table and to_pandas() contain all of them" if what else ""

    def table_texts(self) -> Sequence[str]:
        """Return the table of the path with as many steps and columns as the terminal can show."""
        shown, _, cut = self._shown()
        header = [f"time ({self.unit})", *(name for name, _ in shown), *self.sends]
        rows = [
            [
                f"{time:.6g}",
                *(f"{column[k]:z.4g}" for _, column in shown),
                *("sent" * bool(s[k]) for s in self.sends.values()),
            ]
            for k, time in enumerate(self.time)
        ]
        return (table_text(header, [*rows[:FIRST], ["…"] * len(header), *rows[-LAST:]] if cut else rows, 1),)

    def columns(self) -> Columns:
        """Return a table with one row per step: states, estimates, inputs, measurements, triggers and sends."""
        columns: dict[str, Column] = {"time": self.time}
        for name, values in (("x", self.state), ("xhat", self.estimate), ("u", self.input), ("y", self.measurement)):
            columns |= {f"{name}{i + 1}": column for i, column in enumerate(values.T)}
        columns |= {f"missing{i + 1}": column for i, column in enumerate(self.missing.T)}
        if self.trigger_value.size:
            columns |= {"trigger": self.trigger_value, "threshold": self.threshold}
        if len(self.triggers) > 1:
            for link, value in self.triggers.items():
                columns |= {f"trigger_{link}": value, f"threshold_{link}": self.thresholds[link]}
        columns |= {f"allowance_{link}": allowance for link, allowance in self.allowances.items()}
        columns |= {f"sent_{link}": sent for link, sent in self.sends.items()}
        columns |= {f"delivered_{link}": delivered for link, delivered in self.delivered.items()}
        columns |= {f"overtaken_{link}": overtaken for link, overtaken in self.overtaken.items()}
        if self.versus is not None:
            columns |= {f"versus_{name}": column for name, column in self.versus.columns().items() if name != "time"}
        return columns


@dataclass(frozen=True, eq=False)
class _Shown:
    """A signal over time in a figure, with the values to which it is compared."""

    name: str
    values: Array  # (steps,)
    estimate: Array | None = None
    target: Array | None = None  # what it is to be
    low: float = -np.inf
    high: float = np.inf
    held: bool = False  # whether it only changes in steps

    @property
    def curves(self) -> list[Array]:
        """All curves of a panel: values, estimates and targets, as far as the path has them."""
        return [one for one in (self.values, self.estimate, self.target) if one is not None]


def _panels(path: Trajectory, paths: Sequence[Trajectory], brief: bool) -> list[Panel]:
    """Return the panels of one of several paths, with equal axes and the triggers that all paths have."""
    found, first = list[Panel](), paths[0]
    own = _looks(paths)[0 if path is first else 1]
    thing = None if len(paths) == 1 else own  # in whose colour all signals are
    for what, shown in (("output", _outputs), ("disturbance", _disturbances), ("input", _inputs)):
        rows = [list(shown(one)) for one in paths]
        if brief and what == "output" and len(rows[0]) > 1:
            rows = [[replace(one, estimate=None) for one in row] for row in rows]
        mine = next(row for row, one in zip(rows, paths, strict=True) if one is path)
        for group in _groups(rows):
            word = "state" if what == "output" and mine[0].name.startswith("$x") else what
            unit = common_unit([mine[i].name for i in group])
            plain = mine[group[0]].name
            alone = plain if len(mine) > 1 or "$" not in plain else word
            title = alone if len(group) == 1 else f"{word}s ({unit})" if unit else f"{word}s"
            everywhere = [row[i] for row in rows for i in group]
            found.append(_panel(path, [mine[i] for i in group], everywhere, what, title, thing))
    names = link_names(path.delivered)
    lanes = [
        Lane(
            names[link],
            path.time[delivered & ~path.overtaken.get(link, np.zeros_like(delivered))].tolist(),
            path.time[path.sends[link] & ~delivered].tolist(),
            path.time[path.overtaken[link]].tolist() if link in path.overtaken else (),
            path.packets(link),
        )
        for link, delivered in path.delivered.items()
    ]
    links = [link for link in first.triggers if all(link in one.triggers for one in paths)]
    kept = [links[0], links[-1]] if brief and len(links) > ROWS else links
    triggers = [_trigger(path, link, kept, own) for link in kept]
    if len(kept) < len(links):
        triggers[0] = replace(triggers[0], note=f"{len(kept)} of {number_of(len(links), 'trigger')}")
    found += [Panel(lanes=lanes, step=path.step), *triggers]
    packets = number_of(sum(int(sent.sum()) for sent in path.sends.values()), "packet")
    above = path.cost / first.cost - 1 if first.cost > 0 else 0.0
    more = f" ({percent(above, 0, signed=True)})" if abs(above) >= LEAST_DIFFERENCE else ""
    note = f"{packets}, cost {path.cost:.4g} on this path{more.replace('-', '−')}"
    found[0] = replace(found[0], title=symbol(path.name), note=note, thing=own)
    found[-1] = replace(found[-1], xlabel=f"time ({path.unit})")
    return found


def _looks(paths: Sequence[Trajectory]) -> list[Thing | int]:
    """Return the look of each path; those of a held input and of a prediction are known where the paths differ so."""
    differ = len({path.predicts for path in paths}) > 1 and all(path.triggers for path in paths)
    words = [["model" if path.predicts else "hold"] if differ else list[str]() for path in paths]
    return policy_looks(
        [
            words[0],
            *(own if path.triggers else ["periodic control"] for own, path in zip(words[1:], paths[1:], strict=True)),
        ]
    )


def _groups(rows: Sequence[Sequence[_Shown]]) -> list[list[int]]:
    """Return the signals that share a panel, by their numbers: a few with one unit, of one size, with equal limits."""
    found = list[list[int]]()
    ranges = [max(float(np.ptp(curve)) for one in each for curve in one.curves) for each in zip(*rows, strict=False)]

    def alike(first: int, other: int) -> bool:
        one, two = rows[0][first], rows[0][other]
        low, high = sorted((ranges[first], ranges[other]))
        units = {unit_of(each.name)[1] for each in (one, two)}
        return len(units) == 1 and (one.low, one.high) == (two.low, two.high) and (high <= ALIKE * low or low == 0)

    for i in range(len(ranges)):
        group = next((each for each in found if len(each) < TOGETHER and all(alike(i, k) for k in each)), None)
        if group is None:
            found.append([i])
        else:
            group.append(i)
    return found


def _panel(
    path: Trajectory,
    own: Sequence[_Shown],
    all_of: Sequence[_Shown],
    what: str,
    ylabel: str,
    of: Thing | int | None,
) -> Panel:
    """Return the panel of some signals of a path, whose y axis also holds those of the other paths.

    The signals have colours of their own, or tones of the colour of the thing ``of``.
    """
    time, series, targets = path.time.tolist(), list[Series](), dict[bytes, Array]()
    held: Curve = "steps" if what == "input" and not path.predicts else "line"
    guess = "prediction of the actuator" if path.predicts else "estimate" if len(own) == 1 else "estimates"
    guesses = list[Series]()
    for i, one in enumerate(own):
        thing: Thing | int = "disturbance" if what == "disturbance" and len(own) == 1 else i if of is None else of
        tone = i if thing == of else None
        if one.estimate is not None:
            label = guess if i == 0 else ""
            guesses.append(Series(time, one.estimate.tolist(), label, "dotted", None, thing, faint=True, signal=tone))
        name = unit_of(one.name)[0] if ylabel.endswith(")") else one.name
        label = name if len(own) > 1 or one.estimate is not None or one.target is not None else ""
        curve: Curve = "steps" if one.held else held
        series.append(Series(time, one.values.tolist(), label, curve, None, thing, signal=tone))
        if one.target is not None:
            targets[one.target.tobytes()] = one.target
    point = "operating point" if path.loop.problem.rest is not None and _signals(path) is None else "set-point"
    series += guesses
    for i, target in enumerate(targets.values()):
        label = f"{point}{'s' * (len(targets) > 1)}" if i == 0 else ""
        series.append(Series(time, target.tolist(), label, "steps", None, "set-point"))
    ylim, bands = _axis(all_of)
    height = TALL if what == "output" and len(own) == path.loop.problem.plant.sensed else LOW
    return Panel(series, ylabel=ylabel, ylim=ylim, bands=bands, height=height)


def _axis(signals: Sequence[_Shown]) -> tuple[tuple[float, float], list[Band]]:
    """Return the ends of an axis, and what is beyond the limits, to which it extends if the values come near them."""
    values = np.concatenate([curve for one in signals for curve in one.curves])
    low, high = float(values.min()), float(values.max())
    size = high - low or abs(high) or 1.0
    bottom, top = signals[0].low, signals[0].high
    shown = low - bottom <= NEAR * size, top - high <= NEAR * size
    ends = (
        min(low - ROOM * size, bottom - ROOM * size if shown[0] else low),
        max(high + ROOM * size, top + ROOM * size if shown[1] else high),
    )
    bands = [Band(None, bottom, thing="limits")] * shown[0] + [Band(top, None, thing="limits")] * shown[1]
    stated = [f"{limit:.4g}".replace("-", "−") for limit in (bottom, top) if np.isfinite(limit)]
    words = f"outside the limit{'s' * (len(stated) > 1)} {' to '.join(stated)}"
    if stated and not bands:  # the limits are outside of the axis
        bands, words = [Band(ends[1] + size, ends[1] + size, thing="limits")], f"{words}, not reached"
    return ends, [replace(band, label=words if i == 0 else "") for i, band in enumerate(bands)]


def _trigger(path: Trajectory, link: str, links: Sequence[str], own: Thing | int) -> Panel:
    """Return the panel of the trigger of a link of a path, which has the colour of the thing ``own``."""
    alone = len(links) == 1
    plain = Panel(ylabel="trigger" if alone else f"trigger {link}", height=LOW if alone else FLAT, step=path.step)
    weighed = Weighed(path.triggers[link], path.thresholds[link], path.allowances.get(link))
    ratio = weighed.ratio
    positive = ratio is not None
    shown, limit = (weighed.silent - weighed.sending, 0.0) if ratio is None else (ratio, 1.0)
    plain = replace(plain, ylabel="trigger /\nthreshold" if positive else "trigger −\nthreshold") if alone else plain
    ends = None
    if positive:
        most = float(np.nanmax(shown))
        ends = LEAST * min(1.0, most) if most > 0 else LEAST, max(3.0, 1.3 * most)
    sent = shown > limit
    marks: dict[Thing | int, Bits] = {"trigger": ~sent & (shown > (ends or (-np.inf,))[0]), own: sent}
    series = [
        Series(path.time[here].tolist(), shown[here].tolist(), "", "stems", None, thing)
        for thing, here in marks.items()
    ]
    words = (
        f"sends above {limit:g}"
        if alone
        else f"trigger {'ratio' if positive else 'difference'},\nsends above {limit:g}"
    )
    level = Level(limit, words if link == links[0] else "", "threshold")
    return replace(plain, series=series, levels=[level], ylog=positive, ylim=ends)


def _outputs(path: Trajectory) -> Iterator[_Shown]:
    """Yield the outputs that sensors measure, and other combinations of the states with a set-point or a limit."""
    plant, limits = path.loop.problem.plant, path.loop.limits
    measured = plant.C[: plant.sensed]
    names = _names(
        path.loop.policy.measured, plant.sensed, "x" if plant.alone is None and plant.full_state else "y", path
    )
    aims = list(_targets(path))
    bounds, told = list[tuple[Array, float, float]](), dict[bytes, str]()
    if limits is not None:
        ends = limits.low.tolist(), limits.high.tolist()
        bounds += zip(_padded(limits.outputs, plant.states), *ends, strict=True)
        told |= {row.tobytes(): name for (row, _, _), name in zip(bounds, limits.quantities, strict=False)}
    rows = [*measured]
    for row in (*(row for row, _ in aims), *(row for row, _, _ in bounds)):
        if not any(np.array_equal(row, other) for other in rows):
            rows.append(row)
            names.append(told.get(row.tobytes(), f"$z_{{{len(rows) - plant.sensed}}}$"))
    seen = path.estimate if path.estimate.shape[1] == plant.states else None
    for name, row in zip(names, rows, strict=True):
        values = path.state @ row
        estimate = None if seen is None else seen @ row
        if estimate is not None and np.abs(estimate - values).max() <= SAME * np.abs(values).max():
            estimate = None  # the state is measured without noise
        target = next((one for other, one in aims if np.array_equal(row, other)), None)
        low, high = next(((a, b) for other, a, b in bounds if np.array_equal(row, other)), (-np.inf, np.inf))
        yield _Shown(name, values, estimate, target, low, high)


def _signals(path: Trajectory) -> Exosystem | None:
    """Return the disturbances and set-points of the plant."""
    source = path.loop.problem.source
    return None if source is None else source.exosystem


def _targets(path: Trajectory) -> Iterator[tuple[Array, Array]]:
    """Yield combinations of the states, (n,), with their wanted values in each step, (steps,)."""
    problem, signals = path.loop.problem, _signals(path)
    measured = problem.plant.C[: problem.plant.sensed]
    if path.reference.size:
        yield from ((row, path.reference @ row) for row in measured)
    elif signals is not None and signals.F.any():  # z = C_z x + F d is to be zero
        d = path.state[:, -len(signals.S) :]
        yield from zip(_padded(signals.outputs, problem.plant.states), -signals.F @ d.T, strict=True)
    elif problem.rest is not None:
        yield from ((row, np.full(len(path.time), float(problem.rest.x @ row))) for row in measured)


def _disturbances(path: Trajectory) -> Iterator[_Shown]:
    """Yield the signals that act on the plant or on the measurements; at last, loads that the design does not know."""
    signals, states = _signals(path), path.loop.problem.plant.states
    acting = [] if signals is None else np.flatnonzero(np.vstack([signals.E, signals.G]).any(axis=0)).tolist()
    for number, i in enumerate(acting):
        column = states - len(signals.S) + i if signals is not None else i
        known = column >= states - path.loop.problem.plant.set_points
        estimate = path.estimate[:, column] if path.estimate.shape[1] == states and not known else None
        yield _Shown(f"$d_{{{number + 1}}}$", path.state[:, column], estimate, held=known)
    problem = path.loop.problem
    loads = () if problem.source is None else (one for one in problem.source.loads if one.signal is None)
    for number, one in enumerate(loads, start=len(acting) + 1):
        yield _Shown(f"$d_{{{number}}}$", one.at_steps(problem.tick, len(path.time)), held=True)


def _inputs(path: Trajectory) -> Iterator[_Shown]:
    """Yield the inputs that the plant gets, with their limits."""
    size = path.input.shape[1]
    limits = None if path.predicts else path.loop.problem.plant.saturation
    ends = [(-np.inf, np.inf)] * size if limits is None else zip(limits.low.tolist(), limits.high.tolist(), strict=True)
    names = _names({} if path.predicts else path.loop.policy.applied, size, "u", path)
    for name, values, (low, high) in zip(names, path.input.T, ends, strict=True):
        yield _Shown(name, values, None, None, low, high)


def _names(at: Mapping[str, tuple[str, tuple[int, ...]]], size: int, letter: str, path: Trajectory) -> list[str]:
    """Return the names of signals: that of a node with a single one, or else a letter and a number."""
    names = [f"${letter}_{{{i + 1}}}$" for i in range(size)]
    for node, entries in at.values():
        if path.loop.policy.network.own_nodes and len(entries) == 1 and entries[0] < size:
            names[entries[0]] = node
    return (path.loop.names or Names()).labels("inputs" if letter == "u" else "outputs", names)


def _padded(rows: Array, states: int) -> Array:
    """Return combinations of the states of a plant as those of its states and signals."""
    return np.pad(rows, ((0, 0), (0, states - rows.shape[1])))


def simulate(
    loop: Loop | Policy, steps: int, *, seed: int = 0, versus: Loop | Policy | Literal["periodic"] | None = None
) -> Trajectory:
    """Simulate a path of a loop, from a random initial state, and record all signals.

    The numbers are those of the bit-exact build: nodes that get the recorded measurements compute the recorded inputs
    bit for bit. Averages over many paths (``evaluate``, ``average``) use the fast build, which may differ in the last
    bits of a step.

    Args:
        loop: the closed loop, or a policy, which is closed with the plant, cost and network that it was designed for.
        steps: number of steps, at least 1, and not beyond the end of a finite-horizon run.
        seed: seed of the random draws.
        versus: another loop or policy for the same plant, which is simulated with the same noise and shown next to the
            first one. ``"periodic"``: periodic control, which sends as many packets on each link as the loop has sent
            on this path, in even intervals, with the best gains that the nodes allow.

    Returns:
        The trajectory.

    Raises:
        ProblemError: steps or seed are out of range, or the two loops have different plants.
        UnstableError: the function of a nonlinear plant gives a non-finite number.

    Example:
        >>> from taciturn import Cost, Plant, close, design
        >>> plant, cost = Plant([[1.2]], [[1.0]], [[0.01]]), Cost([[1.0]], [[1.0]])
        >>> loop = close(plant, design.lqg(plant, cost, theta=0.5), cost=cost)
        >>> path = simulate(loop, 50, versus="periodic")
        >>> path.state.shape, path.packets("actuator") == path.versus.packets("actuator")
        ((50, 1), True)
    """
    loop = _closed("loop", loop)
    steps = loop.checked_steps(steps)
    count("seed", seed, 0)
    alone = _path(loop, steps, seed)
    if versus is None:
        return alone
    if isinstance(versus, str):
        choice("versus", versus, ("periodic",))
        other, name = periodic_control(loop, alone.sends)
    else:
        other = _closed("versus", versus)
        name = ""
    plants = loop.problem.plant, other.problem.plant
    for what, values in {
        "states": [plant.states for plant in plants],
        "inputs": [plant.inputs for plant in plants],
        "outputs": [plant.outputs for plant in plants],
        "steps per second": [1 / (plant.dt or 1.0) for plant in plants],
        "normal numbers per step": [len(draws_of(one.whole_program(), NORMAL)) for one in (loop, other)],
    }.items():
        if values[0] != values[1]:
            raise ProblemError(
                f"the loop given as versus has {values[1]:g} {what}, but this loop has {values[0]:g}; expected two "
                "loops with the same plant and the same noise"
            )
    most = max(len(draws_of(one.in_units.whole_program(), UNIFORM)) for one in (loop, other))
    first, second = (_path(one, one.checked_steps(steps), seed, most) for one in (loop, other))
    titles = (first.name, name or second.name)
    if titles[0] == titles[1]:
        titles = _apart(first.name, loop.settings, other.settings)
    return replace(first, name=titles[0], versus=replace(second, name=titles[1]))


def _apart(name: str, first: Mapping[str, str], second: Mapping[str, str]) -> tuple[str, str]:
    """Return titles of two controls of one name: with the parameters that differ, or their files, or in order."""
    differ = [key for key in {**first, **second} if first.get(key, "") != second.get(key, "")]
    shown = [key for key in differ if key != "file"]
    if not differ:
        return f"{name}, first", f"{name}, second"
    if not shown:
        return f"{name}, {first['file']}", f"{name}, {second['file']}"
    told = [", ".join(f"{key} = {one.get(key, 'default')}" for key in shown) for one in (first, second)]
    return f"{name}, {told[0]}", f"{name}, {told[1]}"


def _closed(name: str, given: Loop | Policy) -> Loop:
    """Return a loop, or that of a policy with the plant, cost and network of its design."""
    if isinstance(given, Policy):
        plant, cost, network = own_problem(given)
        return close(plant, given, network, cost)
    instance(name, given, Loop)
    return given


def _path(loop: Loop, steps: int, seed: int, uniforms: int = 0) -> Trajectory:
    """Return a path of a loop, whose program draws at least so many uniform numbers in each step."""
    point, loop = loop.problem.plant.operating_point, loop.in_units
    program = loop.program(uniforms)
    program = program.keep({COST}, set(program.outputs), {"x"})
    size = 8 * steps * len(program.outputs)
    try:
        if size > _ADDRESSES:
            raise MemoryError
        found = prepare(program, exact=True)(loop.start(program, 1, seed), steps, 1)
    except MemoryError:
        raise ProblemError(
            f"steps is {steps}, and a record of so many steps needs {size / 1e9:.3g} GB, more than the memory of this "
            "machine; expected fewer steps, or an evaluation, which does not record the steps"
        ) from None
    records = {key: values[:, 0] for key, values in found.outputs.items()}

    def stacked(signal: str) -> Array:
        rows = [values for key, values in records.items() if is_entry(key, signal)]
        return np.array(rows).T if rows else np.empty((steps, 0))

    states = stacked("x")
    expect_numbers(loop, states)
    dt = loop.problem.plant.dt
    estimate, applied, measured = map(stacked, ("estimate", "applied", "y"))
    model = loop.policy.prediction
    if model is not None:  # the sampled plant takes the state of the actuator's model as its input
        estimate, applied = applied, (applied if point is None else applied - point.x) @ model.L.T
        own = None if loop.problem.source is None else loop.problem.source.operating_point
        applied = applied if own is None else applied + own.u
    weighed = weigh_options(loop.policy, records)
    sent = {key.link: values > 0 for key, values in records.items() if isinstance(key, Sent)}
    delivered = {key.link: values > 0 for key, values in records.items() if isinstance(key, Received)}
    overtaken, late = dict[str, Bits](), dict[str, LatePackets]()
    for link in late_links(loop):
        own, codes = sent[link][:, None], records[Arrived(link, 0)][:, None]
        fates = fates_of(own, codes, len(cuts_of(loop)))
        delivered[link] = (own & ~fates.lost)[:, 0]
        overtaken[link] = fates.overtaken[:, 0]
        late[link] = of_records(loop, link, own, codes)
    return Trajectory(
        time=np.arange(steps, dtype=np.float64) * (dt or 1.0),
        unit="steps" if dt is None else "s",
        state=states,
        estimate=estimate,
        input=applied,
        triggers={link: one.silent for link, one in weighed.items()},
        thresholds={link: one.sending for link, one in weighed.items()},
        allowances={link: one.allowed for link, one in weighed.items() if one.allowed is not None},
        sends=sent,
        delivered=delivered,
        overtaken=overtaken,
        late=late,
        measurement=measured,
        missing=stacked(SAMPLED) == 0.0,
        reference=stacked(loop.policy.targets.get("x", "")),
        cost=_cost_of(loop, program, found, steps),
        loop=loop,
        predicts=model is not None,
        name=f"event-triggered control ({loop.policy.kind})" if weighed else loop.policy.kind,
    )


def _cost_of(loop: Loop, program: Program, found: Run, steps: int) -> float:
    """Return the cost of a path, per unit of time, or so far over a horizon or with a discount."""
    problem, total = loop.problem, float(found.sums[COST][0])
    if loop.horizon is None:
        return problem.per_unit(total / steps)
    final = loop.final_cost(program, found.states) if steps == problem.cost.horizon else None
    noise = problem.noise_cost * float(np.sum(np.power(problem.cost.discount, np.arange(float(steps)))))
    return total + noise + (0.0 if final is None else float(final[0]))


@dataclass(frozen=True, eq=False, repr=False)
class Weighed(Displayed):
    """The least values of the options without and with a packet, (steps,), and what scalar signals allow."""

    silent: Array
    sending: Array
    allowed: Array | None  # None if no scalar signal reduces the value of an option

    @property
    def ratio(self) -> Array | None:
        """The value of silence divided by its threshold, or None if many thresholds are not positive."""
        allowed = 0.0 if self.allowed is None else self.allowed
        value, threshold = self.silent + allowed, self.sending + allowed
        if (threshold < 0).any() or (threshold > 0).mean() <= MOST:
            return None
        return np.divide(value, threshold, out=np.full(value.shape, np.nan), where=threshold > 0)


def weigh_options(policy: Policy, records: Mapping[Name, Array]) -> dict[str, Weighed]:
    """Return what the decision on each link compares, from the records of a path; none for a schedule."""
    found = dict[str, Weighed]()
    for step in policy.steps:
        if isinstance(step, Send) and step.on is not None and policy.decisions[step.on].reads:
            trigger = policy.decisions[step.on]
            sending = step.sending(trigger.labels)
            values = {label: records[Option(step.on, label)] for label in trigger.labels}
            silent = [value for label, value in values.items() if label not in sending]
            if silent:
                others = [values[label] for label in sending]
                limit = trigger.limit  # silence is chosen up to it
                least = np.min(others, axis=0) if limit is None else np.full(others[0].shape, limit)
                found[step.link] = Weighed(np.min(silent, axis=0), least, _allowed(step.on, trigger, records))
    return found


def _allowed(decision: str, trigger: Trigger, records: Mapping[Name, Array]) -> Array | None:
    """Return by how much scalar signals of negative weight reduce the value of an option at most."""
    less = [
        np.sum([-weight * records[Scalar(decision, name)] for name, weight in form.plus.items() if weight < 0], axis=0)
        for form in trigger.options.values()
        if any(weight < 0 for weight in form.plus.values())
    ]
    return np.max(less, axis=0) if less else None


@dataclass(frozen=True, eq=False, repr=False)
class Course(Result):
    """Mean stage cost of a loop at each step, and share of the paths on which it sends, with standard errors."""

    # For an average cost, the stage cost is per unit of time, so that it converges to the average. For a finite horizon
    # or a discount, it is the weighted cost of each step, so that the stage costs and the final cost add up to the
    # total.

    time: Array  # time in seconds, or in steps if the plant has no ``dt``, (steps,)
    cost: Array  # mean of x'Qx + û'Rû + 2x'Nû, (steps,)
    standard_error: Array  # standard error of the cost, (steps,)
    sends: Mapping[str, Array]  # fraction of the paths that send, by link, (steps,)
    sends_standard_error: Mapping[str, Array]  # standard error of these fractions, (steps,); 0 if all paths agree
    final: Estimate | None  # mean cost of the final state
    paths: int  # number of paths


def course(loop: Loop, steps: int, *, paths: int = _PATHS, seed: int = 0) -> Course:
    """Simulate independent paths of a loop from random initial states; average cost and sends at each step."""
    instance("loop", loop, Loop)
    steps, paths, seed = loop.checked_steps(steps), count("paths", paths, 2), count("seed", seed, 0)
    names = sends(loop)
    program = loop.program().keep({COST}, {*names}, {"x"})
    run, states = prepare(program), loop.start(program, paths, seed)
    state = [i for i, one in enumerate(program.states) if one.name == "x"]
    cost, sent = list[Estimate](), list[list[Estimate]]()
    for _ in range(steps):
        found = run(states, 1, None)
        if not np.isfinite(found.states[state]).all():
            find_loss(loop, program, run, states, 1)
        states = found.states
        cost.append(mean(found.sums[COST]))
        sent.append([mean(found.outputs[name][0]) for name in names])
    final = loop.final_cost(program, states) if steps == loop.problem.cost.horizon else None
    problem, unit = loop.problem, 1.0 if loop.horizon is not None else loop.problem.tick
    noise: Array = problem.noise_cost * np.power(problem.cost.discount, np.arange(float(steps)))
    return Course(
        np.arange(steps, dtype=np.float64) * (problem.plant.dt or 1.0),
        (np.array([stage.value for stage in cost]) + noise) / unit,
        np.array([stage.standard_error for stage in cost]) / unit,
        {link: np.array([tick[i].value for tick in sent]) for i, link in enumerate(loop.policy.scheduled)},
        {link: np.array([tick[i].standard_error for tick in sent]) for i, link in enumerate(loop.policy.scheduled)},
        None if final is None else mean(final),
        paths,
    )
