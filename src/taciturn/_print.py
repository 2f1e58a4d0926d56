"""Printing of results and tables by the commands, in 80 columns."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from taciturn._text import Lines, pairs_text, per_unit, percent, table_text, wrapped_text
from taciturn.model.estimate import Estimate
from taciturn.study.lines import bound_at_rate, bound_text, least_cost, percent_above, periodic_cost, rounded

if TYPE_CHECKING:
    from pathlib import Path

    import xarray

    from taciturn.simulation.trajectory import Trajectory
    from taciturn.study.bench import Bench
    from taciturn.study.certify import Certificates
    from taciturn.study.channel import Sharing
    from taciturn.study.compare import Comparison
    from taciturn.study.network import NetworkRun
    from taciturn.study.periods import TunedPeriod
    from taciturn.study.reproduction import Reproduction, Table
    from taciturn.study.tradeoff import Tradeoff
    from taciturn.study.worlds import WorldRun

COLUMNS, FIRST, LAST = 6, 20, 10  # of a printed path: columns next to the time, first and last steps
RATES = ("rate_actuator", "rate_sensor")


def network(found: NetworkRun) -> None:
    """Print the cost and the packets of a network run."""
    policy = found.loop.policy
    cost = "-" if found.cost is None else f"{found.cost} {per_unit(found.unit)}"
    lines = [("policy", policy.kind), ("steps", f"{len(found.costs)} in {found.seconds:.1f} s"), ("cost", cost)]
    lines += [(f"rate, {link}", f"{rate} per {found.rate_unit}") for link, rate in found.rates.items()]
    if found.nominal:
        lines.append(("every sample", f"{policy.cost_all_time:.6g}"))
    for link, counted in found.datagrams.items():
        lines.append((f"link, {link}", ", ".join(f"{count} {name}" for name, count in counted.items())))
    for name, report in found.reports.items():
        if report.get("degraded"):
            lines.append(("degraded", f"{name}: " + ", ".join(f"{n} {why}" for why, n in report["degraded"].items())))
        if report.get("lateness_ms"):
            shown = ", ".join(f"{share} {value:g}" for share, value in report["lateness_ms"].items())
            lines.append(("lateness, ms", f"{name}: {shown}"))
    lines += [("note", note) for note in found.notes]
    pairs(lines)


def world(found: WorldRun) -> None:
    """Print the faults, the counters and the recovery of a world."""
    lines = [("world", f"{found.seed}, {found.steps} steps, {found.ticks} steps of nodes in {found.seconds:.2f} s")]
    lines.append(("nodes in C", ", ".join(found.devices) or "none"))
    lines += [("fault", fault.text()) for fault in found.faults]
    for name, counted in found.counters.items():
        shown = ", ".join(f"{number} {what}" for what, number in counted.items() if number)
        lines.append((name, shown or "no packets"))
    if found.recovery is not None:
        lines.append(
            ("recovery", f"{found.recovery} steps after the last fault; at most {found.promised} are promised")
        )
    lines += [("broken", found.broken or "no invariant"), *(("note", note) for note in found.notes)]
    pairs(lines)


def trajectory(found: Trajectory) -> None:
    """Print a path step by step, with as many columns as fit, and the number of sends on each link."""
    named = [("x", found.state), ("u", found.input), *([("xhat", found.estimate)] if found.predicts else [])]
    columns = [(f"{name}{i + 1}", column) for name, values in named for i, column in enumerate(values.T)]
    left = max(0, len(columns) - (COLUMNS - len(found.sends)))
    shown = columns[: len(columns) - left]
    header = [f"time ({found.unit})", *(name for name, _ in shown), *found.sends]
    rows = [
        [
            f"{time:.6g}",
            *(f"{column[k] + 0.0:.4g}" for _, column in shown),  # -0.0 as 0
            *("sent" * bool(s[k]) for s in found.sends.values()),
        ]
        for k, time in enumerate(found.time)
    ]
    cut = len(rows) > FIRST + LAST
    _print_table(header, [*rows[:FIRST], ["…"] * len(header), *rows[-LAST:]] if cut else rows)
    if left or cut:
        typer.echo(f"some {'columns' if left else 'steps'} are omitted; --json and --table contain all of them")
    lines = [(f"sends, {link}", f"{int(sent.sum())} of {len(sent)} steps") for link, sent in found.sends.items()]
    if found.predicts:
        lines.append(("xhat", "prediction of x by the actuator's model, which gives the input u = L xhat"))
    pairs(lines)


def pairs(lines: Lines) -> None:
    """Print names and values, one pair per line."""
    typer.echo(pairs_text(lines))


def tradeoff(found: Tradeoff) -> None:
    """Print the cost against the rate."""
    names = list(found.points[0].values)
    first = found.points[0].evaluation
    of = {link: f", {link}" if len(first.rates) > 1 else "" for link in first.rates}
    cost = f"cost {per_unit(found.unit)}"
    header = [*names, *(f"sends per {first.rate_unit}{text}" for text in of.values())]
    sharp = all(point.evaluation.cost_bound_at_rate is not None for point in found.points)
    header += [cost, "extra cost", "guarantee, this rate" if sharp else "guarantee", "periodic, same rate"]
    bounded = any(point.evaluation.lower_bound is not None for point in found.points)
    header += ["no schedule below"] if bounded else []
    rows: list[list[str]] = []
    for point in found.points:
        e, least, periodic = point.evaluation, least_cost(point.evaluation), periodic_cost(point.evaluation)
        bound = bound_at_rate(e) if sharp else None
        rows.append(
            [
                *(str(value) for value in point.values.values()),
                *(str(rate) for rate in e.rates.values()),
                str(e.cost),
                percent_above(e.cost, e.cost_all_time) if e.cost_all_time else "",
                _proved(e.cost_bound) if bound is None else bound_text(bound, 1),
                "none" if periodic is None else str(periodic),
                *(["none" if least is None else f"{least:.6g}"] if bounded else []),
            ]
        )
    _print_table(header, rows, len(names))
    if first.cost_all_time is not None and len({p.evaluation.cost_all_time for p in found.points}) == 1:
        pace = "" if first.base_rate is None else f" at {first.base_rate:.4g} sends per {first.rate_unit}"
        lines = [("every sample", f"{first.cost_all_time:.6g}{pace}")]
        pairs(lines + ([("guarantee", found.guarantee)] if found.guarantee else []))
    for note in dict.fromkeys(note for point in found.points for note in point.evaluation.notes):
        at = [point.values for point in found.points if note in point.evaluation.notes]
        settings = [", ".join(f"{name} = {value}" for name, value in values.items()) for values in at]
        typer.echo(wrapped_text(note if len(at) == len(found.points) else f"{'; '.join(settings)}: {note}"))
    if bounded and not found.one_controller:
        typer.echo(wrapped_text("a figure shows no lower bounds: they belong to controllers with different costs"))


def _proved(bound: float | None) -> str:
    return "" if bound is None else rounded(bound, 6, 1)


def sweep(found: xarray.Dataset, path: Path | None) -> None:
    """Print the grid of a sweep, the cells with the least and the largest cost, and the file of the result if any."""
    grid = " × ".join(f"{name} ({size})" for name, size in found.sizes.items())
    answered = int((found.refusal == "").sum())
    typer.echo(f"{found.refusal.size} cells over {grid}, {answered} with an answer")
    for what, cell in (("least", found.cost.argmin(...)), ("most", found.cost.argmax(...))):
        at = found.isel(cell)
        where = ", ".join(f"{name} = {at[name].item()}" for name in found.sizes)
        cost = Estimate(at.cost.item(), at.cost_standard_error.item(), at.cost_method.item(), at.cost_error.item())
        rates = [f"{at[name].item():.4g} {at[name].units} ({name[5:]})" for name in RATES if name in found]
        typer.echo(wrapped_text(f"{what} cost {cost} at {where}; {', '.join(rates)}"))
    if path is not None:
        typer.echo(f"result: {path}")


def periods(found: TunedPeriod) -> None:
    """Print the periods that were tried at a given rate."""
    names = ["period", found.best.parameter.name, "cost", "consistent"]
    rows = [
        [
            f"{one.problem.parameters['period']:g}",
            one.parameter.beside(None),
            str(one.evaluation.cost),
            one.evaluation.consistency or "",
        ]
        for one in found.tried
    ]
    _print_table(names, rows)
    typer.echo(f"{'period':14s} {found.best.problem.parameters['period']:g}")


def comparison(found: Comparison) -> None:
    """Print a ranking."""
    header = ["", "policy", "parameter", f"cost {per_unit(found.unit)}", "extra cost", "above the first", "guarantee"]
    rows: list[list[str]] = []
    for one in found.ranking:
        rows.append(
            [
                one.name,
                one.policy,
                one.parameter,
                str(one.cost),
                percent_above(one.cost, found.cost_all_time) if found.cost_all_time else "",
                str(one.above) if one.above.value or one.above.standard_error else "",
                _proved(one.cost_bound) or "none",
            ]
        )
    _print_table(header, rows, 2)
    lines = [("rate", f"{found.rate:.6g} sends per {found.rate_unit}")]
    if found.cost_all_time is not None:
        lines.append(("every sample", f"{found.cost_all_time:.6g}"))
    pairs(lines)
    for one in found.ranking:
        share = percent(one.share, 1, error=one.share_error)
        shared = "" if one.share == 1 else f"the first value in {share} of the time, else the second; "
        notes = "; ".join(one.tuned.evaluation.notes)
        if shared or notes:
            typer.echo(wrapped_text(f"{one.name}: {(shared + notes).removesuffix('; ')}"))


def sharing(found: Sharing) -> None:
    """Print the cost of the loops on a shared channel."""
    base, bound = found.cost_all_time, found.lower_bound

    def above(cost: float) -> str:
        if not base:
            return ""
        share = cost / base
        return f"   ({percent(share - 1, 2, signed=True)})" if share < 10 else f"   ({share:.4g} times)"

    lines = [
        ("scheduler", found.scheduler),
        ("loops", f"{found.loops}, at most {found.capacity} sends per step"),
        ("sum of costs", f"{found.cost} per {found.unit}{above(found.cost.value)}"),
        ("every sample", f"{base:.6g}"),
    ]
    if bound is not None:
        sure = "by quadrature" if bound.confidence is None else percent(bound.confidence)
        text = f"{rounded(bound.cost, 6, -1)} by any scheduler ({sure}){above(bound.cost)}"
        lines.append(("no less than", text))
    lines += [
        ("best periodic", f"{found.cost_periodic:.6g}{above(found.cost_periodic)}"),
        ("consistent", {True: "yes", False: "no", None: "undecided within the standard errors"}[found.consistent]),
        ("load", f"{found.load} sends per step"),
    ]
    if found.load_expected is not None:
        lines.append(("expected load", f"{found.load_expected} if no loop had to wait"))
    if found.scheduler == "random-access":
        lines.append(("on the channel", f"{found.busy} packets per step, collisions included"))
    if found.price is not None and found.waiting is not None:
        lines += [("price", f"{found.price:.6g} per send"), ("waiting", f"{found.waiting} loops per step")]
    pairs([*lines, *(("note", note) for note in found.notes)])
    rows = [
        [
            one.name,
            f"{one.copies}",
            f"{one.cost}",
            f"{one.cost_all_time:.6g}",
            f"{one.rate}",
            f"{one.rate_periodic:.4g}",
        ]
        for one in found.shares
    ]
    _print_table(
        ["", "loops", f"cost per {found.unit}", "every sample", "sends per check", "best periodic: sends per check"],
        rows,
    )


def certificates(found: Certificates) -> None:
    """Print the certificates of a loop, next to those for sending every sample."""
    ends = "to 0" if found.limit == 0 else f"until the cost is at most {_shown(found.limit)} per {found.unit}"
    more = f", and {_shown(found.gain_residual)} per step" if found.gain_residual else ""
    table = [
        ("decay", found.decay, found.decay_all_time, f"factor per step without noise, {ends}"),
        ("gain", found.gain, found.gain_all_time, f"from noise to the square root of the stage cost{more}"),
        ("cost", found.cost_bound, found.cost_all_time, f"at most, per {found.unit}"),
        ("E|x|²", found.mean_square_bound, found.mean_square_all_time, "at most, at sampling instants"),
    ]
    pairs([("policy", f"{found.policy}, {found.states} states, actions {', '.join(found.actions)}")])
    rows = [[name, _shown(value), _shown(always)] for name, value, always, _ in table]
    _print_table(["", "proved", "every sample"], rows)
    pairs([(name, text) for name, value, _, text in table if value is not None])
    if found.notes:
        pairs([("note", note) for note in found.notes])


def _shown(value: float | None) -> str:
    return "none" if value is None else f"{value:.6g}"


def reproduction(found: Reproduction) -> None:
    """Print published numbers next to computed numbers."""
    for table in found.tables:
        typer.echo(f"\n{table.name}")
        _print_table(*_columns(table), len(table.rows[0].setting))
        for note in table.notes:
            typer.echo(wrapped_text(note, "  "))


def _columns(table: Table) -> tuple[list[str], list[list[str]]]:
    """Return header and rows, with each printed number next to the computed one."""
    columns = list(table.rows[0].computed)
    printed = [name for name in columns if any(name in row.printed for row in table.rows)]
    header = list(table.rows[0].setting)
    for name in columns:
        heading = table.headings.get(name, name)
        header += [f"{heading}, printed", "computed"] if name in printed else [heading]
    rows: list[list[str]] = []
    for row in table.rows:
        cells = [str(value) for value in row.setting.values()]
        for name in columns:
            if name in printed:
                cells.append(f"{row.printed[name]:g}" if name in row.printed else "")
            cells.append(str(row.computed[name]) if name in row.computed else "")
        rows.append(cells)
    return header, rows


def bench(found: Bench) -> None:
    """Print the simulation speed of this machine."""
    about = found.machine
    typer.echo(wrapped_text(f"two-mass loop, {about['processor']} ({about['vectors']}), one thread, medians"))
    rows = [[name, f"{speed / 1e6:.4g}"] for name, speed in found.speeds.items()]
    _print_table(["", "million steps/s"], rows)
    for name, ratio in found.ratios.items():
        typer.echo(f"{name.replace('_', ' '):28s} {ratio:.3g}")
    for name, seconds in found.compile_seconds.items():
        typer.echo(f"{f'machine code, {name}':28s} {1000 * seconds:.3g} ms")
    for name, ratio in found.variance_ratios.items():
        typer.echo(f"{f'variance, {name}'.replace('_', ' '):28s} {ratio:.3g} times less per step")


def _print_table(header: list[str], rows: list[list[str]], names: int = 1) -> None:
    typer.echo(table_text(header, rows, names))
