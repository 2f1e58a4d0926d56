"""The panels of an evaluation's figure: costs and bounds with their errors, and the send rates of the links.

The axis of costs has percentages above the cost of sending every sample, if it is known, and bends if a bound is far
(``Above``). Each rate is shown up to that of sending every sample. The title is the verdict.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from taciturn._figure import Above, Level, Panel, Series
from taciturn._style import Thing
from taciturn._text import link_names
from taciturn.model.estimate import Estimate, rounded
from taciturn.study.sentences import percent_above

THINGS: Mapping[str, Thing] = {
    "this policy": "policy", "periodic, same rate": "periodic control", "every sample": "every sample",
    "guarantee": "guarantee", "guarantee, this rate": "guarantee", "certificate of the nodes": "certificate",
    "lower bound, any schedule": "lower bound",
}  # fmt: skip
HOLLOW = "guarantee, this rate"  # which has the marker of the guarantee as an outline
Row = tuple[str, Estimate, int]  # name, cost, and the direction in which a bound is rounded


def cost_panel(listed: Sequence[Row], near: Sequence[float], base: float | None, per: str, title: str) -> Panel:
    """Make the panel of costs. Its axis keeps the costs ``near`` apart from ``base``, the cost of every sample."""
    rows = listed[::-1]  # the first is the uppermost
    values = [cost.value for _, cost, _ in rows]
    above = Above.of(base, near, values) if base is not None and base > 0 else None
    series = [
        Series([cost.value], [float(row)], "", "bars", [cost.standard_error], _thing(name), hollow=name == HOLLOW)
        for row, (name, cost, _) in enumerate(rows)
    ]
    notes = list[str]()
    for name, cost, up in rows:
        text = rounded(cost.value, 5, up) if up else f"{cost.value:.5g}"
        extra = "" if above is None or name == "every sample" else percent_above(cost, above.base, up)
        notes.append(f"{text}  {extra}".rstrip().replace("-", "−"))
    axis = f"cost {per}" if above is None else above.label("cost", per)
    levels = [] if above is None else [Level(above.base, axis="x")]
    whole = above is None and min(values) > 0
    return Panel(
        series,
        axis,
        title=title,
        names=[name for name, _, _ in rows],
        notes=notes,
        xlim=(0.0, 1.1 * max(values)) if whole else None,
        xabove=above,
        levels=levels,
    )


def _thing(name: str) -> Thing:
    return THINGS.get(name, "every sample")  # or that of a better controller


def rate_panel(rates: Mapping[str, Estimate], most: float | None, unit: str) -> Panel:
    """Make the panel of send rates. Its axis ends at the rate of sending every sample, if this exists."""
    rows, names = [*rates.items()][::-1], link_names(rates)
    values, errors = [rate.value for _, rate in rows], [rate.standard_error for _, rate in rows]
    top = max(values) if most is None else most
    return Panel(
        [Series(values, range(len(rows)), "", "stalks", errors, "policy")],
        f"sends per {unit}" + ("" if most is None else f" (every sample: {most:.4g})"),
        names=[names[link] for link, _ in rows],
        notes=[f"{value:.4g}" for value in values],
        xlim=(0.0, 1.03 * top or 1.0),
        levels=[] if most is None else [Level(most, axis="x")],
    )
