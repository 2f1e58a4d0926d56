"""What the commands print for people: answers and tables as text."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from taciturn.model.estimate import Estimate
from taciturn.study.lines import Lines, above_all_time, rounded, text_of

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

COLUMNS, FIRST, LAST = 6, 20, 10  # of a path that are printed beside the time; its first and its last steps
RATES = ("rate_actuator", "rate_sensor")


def network(found: NetworkRun) -> None:
    """Print what nodes over a network cost and sent."""
    policy = found.loop.policy
    cost = "-" if found.cost is None else f"{found.cost} per {found.unit}"
    lines = [("policy", policy.kind), ("ticks", f"{len(found.costs)} in {found.seconds:.1f} s"), ("cost", cost)]
    lines += [(f"rate, {link}", f"{rate} per {found.rate_unit}") for link, rate in found.rates.items()]
    if found.nominal:
        lines.append(("all-time cost", f"{policy.cost_all_time:.6g}"))
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


def trajectory(found: Trajectory) -> None:
    """Print a path step by step, as many columns as 80 letters hold, and how often each link sent."""
    named = [("x", found.state), ("u", found.input)]
    columns = [(f"{name}{i + 1}", column) for name, values in named for i, column in enumerate(values.T)]
    left = max(0, len(columns) - (COLUMNS - len(found.sends)))
    shown = columns[: len(columns) - left]
    header = [f"time ({found.unit})", *(name for name, _ in shown), *found.sends]
    rows = [
        [
            f"{time:.6g}",
            *(f"{column[k]:.4g}" for _, column in shown),
            *("sent" * bool(s[k]) for s in found.sends.values()),
        ]
        for k, time in enumerate(found.time)
    ]
    cut = len(rows) > FIRST + LAST
    _print_table(header, [*rows[:FIRST], ["…"] * len(header), *rows[-LAST:]] if cut else rows)
    if left or cut:
        typer.echo(f"{'columns' if left else 'steps'} are left out; --json and --table have all of them")
    pairs([(f"sends, {link}", f"{int(sent.sum())} of {len(sent)} steps") for link, sent in found.sends.items()])


def pairs(lines: Lines) -> None:
    """Print names and what stands behind them, one under the other."""
    typer.echo(text_of(lines))


def tradeoff(found: Tradeoff) -> None:
    """Print cost against rate."""
    names = list(found.points[0].values)
    first = found.points[0].evaluation
    of = {link: f", {link}" if len(first.rates) > 1 else "" for link in first.rates}
    header = [*names, *(f"rate per {first.rate_unit}{text}" for text in of.values()), "saved %"]
    header += [f"cost per {found.unit}", "above all-time %", "guaranteed ≤", "fair clock"]
    rows: list[list[str]] = []
    for point in found.points:
        e = point.evaluation
        rates = list(e.rates.values())
        rows.append(
            [
                *(str(value) for value in point.values.values()),
                *(f"{rate.value:.4f} ± {rate.standard_error:.4f}" for rate in rates),
                " / ".join(f"{100 * (1 - rate.value / e.base_rate):.1f}" for rate in rates) if e.base_rate else "",
                str(e.cost),
                above_all_time(e) if e.cost_all_time else "",
                "" if e.cost_bound is None else f"{e.cost_bound:.6g}",
                "none" if point.cost_periodic_same_rate is None else f"{point.cost_periodic_same_rate:.6g}",
            ]
        )
    _print_table(header, rows)
    if first.cost_all_time is not None and len({p.evaluation.cost_all_time for p in found.points}) == 1:
        guarantee = f"; guarantee: {found.guarantee}" if found.guarantee else ""
        typer.echo(f"all-time cost {first.cost_all_time:.6g}{guarantee}")
    for note in dict.fromkeys(note for point in found.points for note in point.evaluation.notes):
        at = [point.values for point in found.points if note in point.evaluation.notes]
        settings = [", ".join(f"{name} = {value}" for name, value in values.items()) for values in at]
        typer.echo(note if len(at) == len(found.points) else f"{'; '.join(settings)}: {note}")


def sweep(found: xarray.Dataset, path: Path) -> None:
    """Print what a sweep holds, where its costs are least and most, and where it is."""
    grid = " × ".join(f"{name} ({size})" for name, size in found.sizes.items())
    answered = int((found.refusal == "").sum())
    typer.echo(f"{found.refusal.size} cells over {grid}, {answered} with an answer")
    for what, cell in (("least", found.cost.argmin(...)), ("most", found.cost.argmax(...))):
        at = found.isel(cell)
        where = ", ".join(f"{name} = {at[name].item()}" for name in found.sizes)
        cost = Estimate(at.cost.item(), at.cost_standard_error.item(), at.cost_method.item(), at.cost_error.item())
        rates = [f"{at[name].item():.4g} {at[name].units} ({name[5:]})" for name in RATES if name in found]
        typer.echo(f"{what} cost {cost} at {where}; {', '.join(rates)}")
    typer.echo(f"result: {path}")


def periods(found: TunedPeriod) -> None:
    """Print what was tried at one rate, period by period."""
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
    header = [
        "",
        "policy",
        "parameter",
        f"cost per {found.unit}",
        "above all-time %",
        "above the first",
        "guaranteed ≤",
    ]
    rows: list[list[str]] = []
    for one in found.ranking:
        percent = 100 * (one.cost.value / found.cost_all_time - 1) if found.cost_all_time else None
        rows.append(
            [
                one.name,
                one.policy,
                one.parameter,
                str(one.cost),
                "" if percent is None else f"{percent:+.2f}",
                str(one.above) if one.above.value or one.above.standard_error else "",
                "none" if one.cost_bound is None else f"{one.cost_bound:.6g}",
            ]
        )
    _print_table(header, rows)
    all_time = "" if found.cost_all_time is None else f"; all-time cost {found.cost_all_time:.6g}"
    typer.echo(f"{found.rate:.6g} sends per {found.rate_unit}{all_time}")
    for one in found.ranking:
        shared = "" if one.share == 1 else f"{100 * one.share:.1f} % of the time the first, else the second; "
        notes = "; ".join(one.tuned.evaluation.notes)
        if shared or notes:
            typer.echo(f"{one.name}: {(shared + notes).removesuffix('; ')}")


def sharing(found: Sharing) -> None:
    """Print what loops on a channel cost."""
    base, bound = found.cost_all_time, found.lower_bound

    def above(cost: float) -> str:
        if not base:
            return ""
        return f"   ({100 * (cost / base - 1):+.2f} %)" if cost < 10 * base else f"   ({cost / base:.4g} times)"

    lines = [
        ("scheduler", found.scheduler),
        ("loops", f"{found.loops}, at most {found.capacity} sends per tick"),
        ("sum of costs", f"{found.cost} per {found.unit}{above(found.cost.value)}"),
        ("all-time cost", f"{base:.6g}"),
    ]
    if bound is not None:
        sure = "by quadrature" if bound.confidence is None else f"{100 * bound.confidence:g} %"
        text = f"{rounded(bound.cost, 6, -1)} by any scheduler ({sure}){above(bound.cost)}"
        lines.append(("no less than", text))
    lines += [
        ("best clock", f"{found.cost_periodic:.6g}{above(found.cost_periodic)}"),
        ("consistent", {True: "yes", False: "no", None: "not to be told apart"}[found.consistent]),
        ("load", f"{found.load} sends per tick"),
    ]
    if found.load_expected is not None:
        lines.append(("expected load", f"{found.load_expected} if none had to wait"))
    if found.scheduler == "random-access":
        lines.append(("on the channel", f"{found.busy} packets per tick, with those that collide"))
    if found.price is not None and found.waiting is not None:
        lines += [("price", f"{found.price:.6g} per send"), ("waiting", f"{found.waiting} loops per tick")]
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
    _print_table(["", "loops", f"cost per {found.unit}", "all-time", "sends per look", "of the best clock"], rows)


def certificates(found: Certificates) -> None:
    """Print what is proved of a loop, beside sending always."""
    typer.echo(f"{'policy':14s} {found.policy}, {found.states} states, actions {', '.join(found.actions)}")
    ends = "to nothing" if found.limit == 0 else f"until the cost is at most {_shown(found.limit)} per {found.unit}"
    beside = f", and {_shown(found.gain_residual)} per tick" if found.gain_residual else ""
    lines = [
        ("decay", found.decay, found.decay_all_time, f"per tick without noise, {ends}"),
        ("gain", found.gain, found.gain_all_time, f"from noise to the root of the cost of a tick{beside}"),
        ("cost, at most", found.cost_bound, found.cost_all_time, f"per {found.unit}"),
        ("E|x|², at most", found.mean_square_bound, found.mean_square_all_time, "at ticks"),
    ]
    rows = [[name, _shown(value), _shown(always)] for name, value, always, _ in lines]
    texts = ["", *(text if value is not None else "" for _, value, _, text in lines)]
    for row, text in zip([["", "proved", "sending always"], *rows], texts, strict=True):
        typer.echo(f"{row[0]:14s} {row[1]:>11s}  {row[2]:>14s}  {text}".rstrip())
    for note in found.notes:
        typer.echo(f"{'note':14s} {note}")


def _shown(value: float | None) -> str:
    return "none" if value is None else f"{value:.6g}"


def reproduction(found: Reproduction) -> None:
    """Print what is printed elsewhere beside what is computed."""
    for table in found.tables:
        typer.echo(f"\n{table.name}")
        _print_table(*_beside(table))
        for note in table.notes:
            typer.echo(f"  {note}")


def _beside(table: Table) -> tuple[list[str], list[list[str]]]:
    """Printed beside computed, column by column."""
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
    """Print how fast this machine simulates."""
    about = found.machine
    typer.echo(f"two-mass loop, {about['processor']} ({about['vectors']}), one thread, medians")
    rows = [[name, f"{speed / 1e6:.4g}"] for name, speed in found.speeds.items()]
    _print_table(["", "million steps/s"], rows)
    for name, ratio in found.ratios.items():
        typer.echo(f"{name.replace('_', ' '):28s} {ratio:.3g}")
    for name, seconds in found.compile_seconds.items():
        typer.echo(f"{f'machine code, {name}':28s} {1000 * seconds:.3g} ms")
    for name, ratio in found.variance_ratios.items():
        typer.echo(f"{f'variance, {name}'.replace('_', ' '):28s} {ratio:.3g} times less per step")


def _print_table(header: list[str], rows: list[list[str]]) -> None:
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    for row in [header, *rows]:
        typer.echo("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
