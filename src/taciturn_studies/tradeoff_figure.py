"""Figure of a trade-off: cost against rate; for several links, cost against traffic above the links' shares, if these
change over the points.

The axis of costs has percentages above the cost of sending every sample. It holds the policy, sending every sample,
and at each rate periodic control, the guarantee and the certificate; if these are far from the policy, the axis bends
(``Above``). Below the lower bounds of all points, max_i (c_i + λ_i (r_i − r)) over rates r, lies the region that no
schedule reaches; it is drawn if all points have one controller. A ring surrounds the point of the title.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from taciturn.extend import (
    Above,
    Band,
    Curve,
    Level,
    Panel,
    Series,
    Thing,
    link_names,
    per_unit,
    percent,
    policy_looks,
    symbol,
)
from taciturn.study.evaluation import Evaluation, cost_text, packets_text
from taciturn.study.periodic import UNSTABLE
from taciturn.study.sentences import more_text
from taciturn_studies.periodic_links import CLOCKS

if TYPE_CHECKING:
    from taciturn_studies.tradeoff import Point, Tradeoff

LINE = 200  # points of the boundary of the region that no schedule reaches
BELOW, UNDER, ABOVE = 0.15, 0.08, 0.04  # room below costs with and without a region there, and above them
WIDE = 30.0  # ratio of the largest and the smallest rate above which the axis of rates is logarithmic
LITTLE = 0.05  # extra cost, relative to that of sending every sample, of the point in the title
STRIP = 1.0  # height of the shares of the links, in inches
EQUAL = 10.0  # change of the share of a link over the points, in percent, up to which the shares are not shown


def panels_of(found: Tradeoff) -> list[Panel]:
    """Return the panel of costs and, for several links, the panel of each link's share of the packets."""
    answers = [point.evaluation for point in found.points]
    links = list(dict.fromkeys(link for one in answers for link in one.rates))
    rates = [_traffic(one) for one in answers]
    pace = _pace(answers[0]) if found.base is not None else None
    limits = _limits([*rates, *([] if pace is None else [pace])])
    wide = min(rates) > 0 and max(rates) > WIDE * min(rates)
    shared: dict[str, Any] = {"xlog": wide, "xlim": None if wide else limits}
    label = _label(found, links)
    parts = _parts(answers, links)
    own = list(zip(*parts[: len(answers)], strict=True))  # of each link, at the points alone
    if all(max(one) - min(one) <= EQUAL for one in own):
        return [_costs(found, label, shared)]
    return [_costs(found, "", shared), _shares(answers, parts, links, label, shared)]


def _traffic(one: Evaluation) -> float:
    """Return the rate of the only link, or the traffic of all links."""
    if len(one.rates) == 1:
        return next(iter(one.rates.values())).value
    return 0.0 if one.traffic is None else one.traffic.value


def _pace(one: Evaluation) -> float | None:
    """Return the rate or the traffic of sending every sample, or None if sends may occur at any time."""
    if one.base_rate is None:
        return None
    return one.base_rate * (1.0 if len(one.rates) == 1 else sum(one.prices.get(link, 1.0) for link in one.rates))


def _limits(rates: Sequence[float]) -> tuple[float, float]:
    low, high = min(rates), max(rates)
    wide = (high - low) or high or 1.0
    return max(low - 0.07 * wide, 0.0), high + 0.03 * wide


def _label(found: Tradeoff, links: Sequence[str]) -> str:
    prices = found.points[0].evaluation.prices
    if len(links) == 1:
        return f"sends per {found.rate_unit}"
    priced = any(prices.get(link, 1.0) != 1 for link in links)
    return f"traffic per {found.rate_unit}: {'price × sends' if priced else 'sends'} on all links"


def _costs(found: Tradeoff, label: str, shared: dict[str, Any]) -> Panel:
    """Return the panel of the costs."""
    answers = [point.evaluation for point in found.points]
    base = None if found.base is None else found.base.value
    every, pace = [] if base is None else [base], _pace(answers[0])
    told = _told(found)
    series = [*_policies(found, told), *_periodic(found), *_bounds(found)]
    series += [Series([pace], every, "", "points", thing="every sample")] if pace is not None and every else []
    here = [] if told is None else [(_traffic(told.evaluation), told.evaluation.cost.value)]
    series += [Series([x], [y], "", "ring", thing="delivered") for x, y in here]
    near = [one.cost.value for one in answers]
    timed = [point.same_traffic or point.evaluation.periodic for point in found.points]
    clocks = [one.value for one in timed if one is not None]
    proved = [y for one in series if one.thing in ("guarantee", "certificate") for y in one.y]
    above = Above.of(base, near, [*clocks, *proved]) if base is not None and base > 0 else None
    bands = [*_unreachable(found), *_unstable(found)]
    low, high = min([*near, *clocks, *proved, *every]), max([*near, *clocks, *proved, *every])
    per = f"cost {per_unit(found.unit)}"
    return Panel(
        series,
        label,
        per if above is None else above.label("cost", per_unit(found.unit)),
        _headline(found, told),
        levels=[Level(cost, "every sample") for cost in every],
        bands=bands,
        yabove=above,
        ylim=_room(low, high, above, BELOW if any(band.text for band in bands) else UNDER),
        **shared,
    )


def _sure(found: Tradeoff) -> list[Point]:
    """Return the points whose costs are averages without a doubt."""
    return [point for point in found.points if point.evaluation.settled and not point.evaluation.doubts]


def _told(found: Tradeoff) -> Point | None:
    """Return the point with the least traffic that costs little more than sending every sample."""
    if found.base is None or found.base.value <= 0:
        return None
    near = [
        point
        for point in _sure(found)
        if (excess := point.evaluation.excess) is not None and -LITTLE <= excess.value <= LITTLE
    ]
    return min(near, key=lambda point: _traffic(point.evaluation), default=None)


def _headline(found: Tradeoff, told: Point | None) -> str:
    """Return packets and cost of a point as a sentence, or else of the points with the most and the fewest packets."""
    if told is None:
        listed = sorted((point.evaluation for point in _sure(found)), key=_traffic)
        ends = [f"{packets_text(one.rates, one)}, {cost_text(one, '')}" for one in (*listed[1:][-1:], *listed[:1])]
        return f"from {' to '.join(ends)}" if len(ends) > 1 else "".join(ends)
    one, base = told.evaluation, told.evaluation.base
    assert base is not None, "the point costs little more than every sample"
    text = f"{packets_text(one.rates, one)}, {cost_text(one, '')}"
    clock = told.same_traffic or one.periodic
    return text if clock is None else f"{text}; with periodic control {more_text(clock, base)}"


def _room(low: float, high: float, above: Above | None, below: float) -> tuple[float, float]:
    """Return the limits of the axis of costs."""
    if above is not None and above.bend is not None:
        ends = [float(np.arcsinh((end - above.base) / above.bend)) for end in (low, high)]
        wide = ends[1] - ends[0]
        first, last = (
            above.base + above.bend * float(np.sinh(end)) for end in (ends[0] - below * wide, ends[1] + ABOVE * wide)
        )
        return first, last
    spread = (high - low) or abs(high) or 1.0
    return low - below * spread, high + ABOVE * spread


def _families(found: Tradeoff) -> list[list[Point]]:
    """Return the points that one curve connects, along the first key with numerical values, by rate."""
    lead = _lead(found)
    families: dict[str, list[Point]] = {}
    for point in found.points:
        others = {key: value for key, value in point.values.items() if key != lead}
        families.setdefault(str(others), []).append(point)
    return [sorted(points, key=lambda point: _traffic(point.evaluation)) for points in families.values()]


def _connected(found: Tradeoff) -> Curve:
    """Return how the points are drawn: those of words, such as kinds of actuation, have no line between them."""
    lead = _lead(found)
    return "line" if all(isinstance(point.values[lead], int | float) for point in found.points) else "points"


def _lead(found: Tradeoff) -> str:
    cells = [point.values for point in found.points]
    names = list(cells[0])
    return next((name for name in names if all(isinstance(cell[name], int | float) for cell in cells)), names[0])


def _policies(found: Tradeoff, told: Point | None) -> Iterator[Series]:
    """Yield the costs of the policies, with the value of the parameter at each point.

    Several policies have it only at the point of the title, where it has the parameter's name too.
    """
    families, lead = _families(found), _lead(found)
    varied = [
        [
            value if isinstance(value, str) else f"{symbol(key)} = {value}"
            for key, value in points[0].values.items()
            if key != lead and any(str(point.values[key]) != str(value) for point in found.points)
        ]
        for points in families
    ]
    kinds = [points[0].evaluation.policy for points in families]
    looks = policy_looks(
        [["periodic control" if kind in CLOCKS else kind, *words] for kind, words in zip(kinds, varied, strict=True)]
    )
    for points, kind, words, look in zip(families, kinds, varied, looks, strict=True):
        yield Series(
            [_traffic(point.evaluation) for point in points],
            [point.evaluation.cost.value for point in points],
            f"this policy ({kind}), by {symbol(lead)}" if len(families) == 1 else ", ".join([kind, *words]),
            error=[point.evaluation.cost.standard_error for point in points],
            curve=_connected(found),
            thing=look,
            notes=[
                f"{symbol(lead)} = {point.values[lead]}"
                if point is told
                else str(point.values[lead]) * (len(families) == 1)
                for point in points
            ],
        )


def _periodic(found: Tradeoff) -> Iterator[Series]:
    """Yield the costs of periodic control: its curve or, for several links, those at the traffic of the points."""
    for kind, curve in found.periodic.items():
        x, y = [one.rate for one in curve], [one.cost for one in curve]
        one, hold = len(found.periodic) == 1, kind == "hold"
        name = "periodic control" if one else f"periodic control, {kind}"
        yield Series(x, y, name, "dashed" if one or hold else "dotted", thing="periodic control")
    timed = [(_traffic(point.evaluation), point.same_traffic.value) for point in found.points if point.same_traffic]
    if timed:
        x, y = zip(*sorted(timed), strict=True)
        yield Series(x, y, "periodic control, same traffic", _joined(timed, "dashed"), thing="periodic control")


def _bounds(found: Tradeoff) -> Iterator[Series]:
    """Yield the guarantee and the certificate of each policy, named once."""
    named: set[str] = set()
    for points in _families(found):
        answers = [point.evaluation for point in points]
        proved = [one.cost_bound if one.cost_bound_at_rate is None else one.cost_bound_at_rate for one in answers]
        measured = [None if one.certificate is None else one.certificate.value for one in answers]
        kinds: tuple[tuple[str, Thing, list[float | None]], ...] = (
            ("guarantee", "guarantee", proved),
            ("certificate of the nodes", "certificate", measured),
        )
        for label, thing, values in kinds:
            known = [(_traffic(one), value) for one, value in zip(answers, values, strict=True) if value is not None]
            if known:
                x, y = zip(*known, strict=True)
                yield Series(x, y, "" if label in named else label, _joined(known, _connected(found)), thing=thing)
                named.add(label)


def _joined(points: Sequence[object], curve: Curve) -> Curve:
    """Return how points are drawn: a single one has a mark."""
    return curve if len(points) > 1 else "points"


def _unreachable(found: Tradeoff) -> list[Band]:
    """Return the region that no schedule reaches: below the lines of the lower bounds of all points."""
    answers = [point.evaluation for point in found.points]
    bounds = [one.lower_bound for one in answers if one.lower_bound is not None]
    pace, base = answers[0].base_rate, answers[0].cost_all_time
    if not bounds or not found.one_controller or pace is None or base is None:
        return []
    rates = [float(rate) for rate in np.linspace(min(one.rate for one in bounds), 1.0, LINE)]
    lowest = [max(base, *(one.at_rate(rate) for one in bounds)) for rate in rates]
    sure = percent(min(one.confidence for one in bounds))
    text = f"no schedule of this controller ({sure} confidence)"
    return [Band(None, lowest, [pace * rate for rate in rates], text=text)]


def _unstable(found: Tradeoff) -> list[Band]:
    """Return the region of the rates at which periodic control is unstable, up to the largest rate of such a point."""
    rates = [_traffic(point.evaluation) for point in found.points if point.evaluation.no_clock == UNSTABLE]
    return [Band(None, None, [0.0, max(rates)], "periodic control is unstable", "periodic control")] if rates else []


def _parts(answers: Sequence[Evaluation], links: Sequence[str]) -> list[list[float]]:
    """Return the share of each link in the traffic in percent, by traffic, at last those of sending every sample."""
    paid = [
        {link: rate.value * one.prices.get(link, 1.0) for link, rate in one.rates.items()}
        for one in sorted(answers, key=_traffic)
    ]
    first = answers[0]
    paid += [] if _pace(first) is None else [{link: first.prices.get(link, 1.0) for link in first.rates}]
    return [[100 * one.get(link, 0.0) / (sum(one.values()) or 1.0) for link in links] for one in paid]


def _shares(
    answers: Sequence[Evaluation],
    parts: Sequence[Sequence[float]],
    links: Sequence[str],
    label: str,
    shared: dict[str, Any],
) -> Panel:
    """Return the panel of the links' shares in the traffic, one above the other, up to that of sending every sample."""
    pace, names = _pace(answers[0]), link_names(links)
    x = [*sorted(map(_traffic, answers)), *([] if pace is None else [pace])]
    low, bands = [0.0] * len(x), list[Band]()
    for index, (link, own) in enumerate(zip(links, zip(*parts, strict=True), strict=True)):
        high = [below + part for below, part in zip(low, own, strict=True)]
        bands.append(Band(low, high, x, names[link], 7 if index % 2 else "policy"))
        low = high
    return Panel((), label, "share (%)", ylim=(0.0, 100.0), bands=bands, ends=True, height=STRIP, **shared)
