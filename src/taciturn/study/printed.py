"""The results of studies as text in 80 columns, as the commands print them; ``lines`` has those of one evaluation."""

from __future__ import annotations

from typing import TYPE_CHECKING

from taciturn._text import pairs_text, per_unit, percent, table_text, wrapped_text
from taciturn.model.estimate import Estimate
from taciturn.study.evaluation import Evaluation, bound_at_rate, least_cost, periodic_cost
from taciturn.study.lines import bound_text, percent_above, rounded, shares_text

if TYPE_CHECKING:
    import xarray

    from taciturn.study.bench import Bench
    from taciturn.study.certify import Certificates
    from taciturn.study.channel.share import Sharing
    from taciturn.study.compare import Comparison
    from taciturn.study.testbed.network import NetworkRun
    from taciturn.study.testbed.worlds import WorldRun
    from taciturn.study.tradeoff import Tradeoff
    from taciturn.study.tuning.periods import TunedPeriod


def network_text(found: NetworkRun) -> str:
    """Return the cost and the packets of a network run."""
    policy = found.loop.policy
    cost = "-" if found.cost is None else f"{found.cost} {per_unit(found.unit)}"
    lines = [("policy", policy.kind), ("steps", f"{len(found.costs)} in {found.seconds:.1f} s"), ("cost", cost)]
    lines += [(f"rate, {link}", f"{rate} per {found.rate_unit}") for link, rate in found.rates.items()]
    if found.nominal:
        lines.append(("every sample", f"{policy.cost_all_time:.6g}"))
    for link, counted in found.datagrams.items():
        told = (f"{count} {'sent again' if name == 'again' else name}" for name, count in counted.items())
        lines.append((f"link, {link}", ", ".join(told)))
    for name, report in found.reports.items():
        if report.get("degraded"):
            lines.append(("degraded", f"{name}: " + ", ".join(f"{n} {why}" for why, n in report["degraded"].items())))
        if report.get("lateness_ms"):
            shown = ", ".join(f"{share} {value:g}" for share, value in report["lateness_ms"].items())
            lines.append(("lateness, ms", f"{name}: {shown}"))
    return pairs_text([*lines, *(("note", note) for note in found.notes)])


def world_text(found: WorldRun) -> str:
    """Return the faults, the counters and the recovery of a world."""
    lines = [("world", f"{found.seed}, {found.steps} steps, {found.ticks} steps of nodes in {found.seconds:.2f} s")]
    lines.append(("nodes in C", ", ".join(found.devices) or "none"))
    lines.append(("keys", "one for each link" if found.keyed else "none"))
    lines += [("fault", fault.text()) for fault in found.faults]
    for name, counted in found.counters.items():
        shown = ", ".join(f"{number} {what}" for what, number in counted.items() if number)
        lines.append((name, shown or "no packets"))
    if found.recovery is not None:
        lines.append(
            ("recovery", f"{found.recovery} steps after the last fault; at most {found.promised} are promised")
        )
    return pairs_text([*lines, ("broken", found.broken or "no invariant"), *(("note", note) for note in found.notes)])


def tradeoff_text(found: Tradeoff) -> str:
    """Return the table of ``taciturn tradeoff``: rates, cost, guarantee and periodic control at each point."""
    names = list(found.points[0].values)
    first = found.points[0].evaluation
    of = {link: f", {link}" if len(first.rates) > 1 else "" for link in first.rates}
    cost = f"cost {per_unit(found.unit)}"
    header = [*names, *(f"sends per {first.rate_unit}{text}" for text in of.values())]
    sharp = all(point.evaluation.cost_bound_at_rate is not None for point in found.points)
    header += [cost, "extra cost", "guarantee, this rate" if sharp else "guarantee", "periodic, same rate"]
    bounded = any(point.evaluation.lower_bound is not None for point in found.points)
    header += ["no schedule below"] if bounded else []
    windows = {one.evaluation.violations.window for one in found.points if one.evaluation.violations is not None}
    header += [name for window in windows for name in ("violation per step", f"within {window}")]
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
                *(_violation(e) if windows else []),
            ]
        )
    parts = [table_text(header, rows, len(names))]
    if first.cost_all_time is not None and len({p.evaluation.cost_all_time for p in found.points}) == 1:
        pace = "" if first.base_rate is None else f" at {first.base_rate:.4g} sends per {first.rate_unit}"
        lines = [("every sample", f"{first.cost_all_time:.6g}{pace}")]
        parts.append(pairs_text(lines + ([("guarantee", found.guarantee)] if found.guarantee else [])))
    for note in dict.fromkeys(note for point in found.points for note in point.evaluation.notes):
        at = [point.values for point in found.points if note in point.evaluation.notes]
        settings = [", ".join(f"{name} = {value}" for name, value in values.items()) for values in at]
        parts.append(wrapped_text(note if len(at) == len(found.points) else f"{'; '.join(settings)}: {note}"))
    if bounded and not found.one_controller:
        parts.append(wrapped_text("a figure shows no lower bounds: they belong to controllers with different costs"))
    return "\n".join(parts)


def _violation(found: Evaluation) -> list[str]:
    """Return the probabilities that a limit is violated, per step and within the window."""
    if found.violations is None:
        return ["none", "none"]
    return [str(found.violations.total.per_step), str(found.violations.total.within)]


def _proved(bound: float | None) -> str:
    return "" if bound is None else rounded(bound, 6, 1)


def sweep_text(found: xarray.Dataset) -> str:
    """Return the grid of a sweep, and the cells with the smallest and the largest cost."""
    grid = " × ".join(f"{name} ({size})" for name, size in found.sizes.items())
    refused = int((found.refusal != "").sum())
    parts = [f"{found.refusal.size} cells over {grid}: {found.refusal.size - refused} evaluated, {refused} refused"]
    ends = () if refused == found.refusal.size else (("smallest", found.cost.argmin), ("largest", found.cost.argmax))
    for name, find in ends:
        at = found.isel(find(...))
        where = ", ".join(f"{key} = {at[key].item()}" for key in found.sizes)
        cost = Estimate(at.cost.item(), at.cost_standard_error.item(), at.cost_method.item(), at.cost_error.item())
        rates = [
            f"{at[key].item():.4g} {at[key].units} ({key[5:]})"
            for key in map(str, found.data_vars)
            if key.startswith("rate_") and f"{key}_standard_error" in found
        ]
        parts.append(f"{name} cost {cost} at {where}; {', '.join(rates)}")
    return "\n".join(map(wrapped_text, parts))


def periods_text(found: TunedPeriod) -> str:
    """Return the periods that were tried at a given rate, and the best of them."""
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
    period = pairs_text([("period", f"{found.best.problem.parameters['period']:g}")])
    return "\n".join([table_text(names, rows, 1), period, str(found.best)])


def comparison_text(found: Comparison) -> str:
    """Return the table of ``taciturn compare``: the ranking, the common rate and the notes."""
    header = ["", "policy", "parameter", f"cost {per_unit(found.unit)}", "extra cost", "above the first", "guarantee"]
    limited = any(one.violation is not None for one in found.ranking)
    header += ["violation per step"] if limited else []
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
                *([str(one.violation or "none")] if limited else []),
            ]
        )
    lines = [(found.of, f"{found.rate:.6g}{' sends' * (found.of == 'rate')} per {found.rate_unit}")]
    measured = [f"{' and '.join(map(str, one.rates))} ({one.name})" for one in found.ranking]
    lines.append(("measured", f"{', '.join(measured)}; each cost is corrected for the difference"))
    if found.cost_all_time is not None:
        lines.append(("every sample", f"{found.cost_all_time:.6g}"))
    if isinstance(found.clocks, str):
        lines.append(("periodic", f"none at this traffic: {found.clocks}"))
    elif found.clocks is not None:
        lines.append(("periodic", f"{found.clocks.cost:.6g}, the least found, in steps: {found.clocks.short()}"))
    parts = [table_text(header, rows, 2), pairs_text(lines)]
    for one in found.ranking:
        share = percent(one.share, 1, error=one.share_error)
        shared = "" if one.share == 1 else f"the first value in {share} of the time, else the second; "
        shared += "" if one.tuned.shares is None else f"shares {shares_text(one.tuned.shares)}; "
        notes = "; ".join(one.tuned.evaluation.notes)
        if shared or notes:
            parts.append(wrapped_text(f"{one.name}: {(shared + notes).removesuffix('; ')}"))
    return "\n".join(parts)


def sharing_text(found: Sharing) -> str:
    """Return the cost of the loops on a shared channel."""
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
    label, attained = "best periodic" if found.clock_attained else "periodic, bound", found.cost_periodic_attained
    lines += [
        (label, f"{found.cost_periodic:.6g}{above(found.cost_periodic)}"),
        *([] if found.clock_attained else [("periodic, found", f"{attained:.6g}{above(attained)}")]),
        ("consistent", {True: "yes", False: "no", None: "undecided within the standard errors"}[found.consistent]),
        ("load", f"{found.load} sends per step"),
    ]
    if found.load_expected is not None:
        lines.append(("expected load", f"{found.load_expected} if no loop had to wait"))
    if found.scheduler == "random-access":
        lines.append(("on the channel", f"{found.busy} packets per step, collisions included"))
    if found.price is not None and found.waiting is not None:
        lines += [("price", f"{found.price:.6g} per send"), ("waiting", f"{found.waiting} loops per step")]
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
    per = "sends per check"
    header = ["", "loops", f"cost per {found.unit}", "every sample", per, f"{label}: {per}"]
    return "\n".join([pairs_text([*lines, *(("note", note) for note in found.notes)]), table_text(header, rows, 1)])


def certificates_text(found: Certificates) -> str:
    """Return the certificates of a loop, next to those for sending every sample."""
    ends = "to 0" if found.limit == 0 else f"until the cost is at most {_shown(found.limit)} per {found.unit}"
    more = f", and {_shown(found.gain_residual)} per step" if found.gain_residual else ""
    table = [
        ("decay", found.decay, found.decay_all_time, f"factor per step without noise, {ends}"),
        ("gain", found.gain, found.gain_all_time, f"from noise to the square root of the stage cost{more}"),
        ("cost", found.cost_bound, found.cost_all_time, f"at most, per {found.unit}"),
        ("E|x|²", found.mean_square_bound, found.mean_square_all_time, "at most, at sampling instants"),
    ]
    policy = f"{found.policy}, {found.states} states, actions {', '.join(found.actions)}"
    rows = [[name, _most(value), _shown(always)] for name, value, always, _ in table]
    parts = [pairs_text([("policy", policy)])]
    if any(value is not None for _, value, *_ in table):
        parts.append(table_text(["", "proved", "every sample"], rows, 1))
    parts.append(pairs_text([(name, text) for name, value, _, text in table if value is not None]))
    if found.errors:
        links = [[link, _shown(one.gain), _shown(one.largest)] for link, one in found.errors.items()]
        parts.append(table_text(["link", "gain from its error", "largest error"], links, 1))
        bound = f"at most {_most(found.errors_bound)} per {found.unit}, for any noise: conservative, not an estimate"
        parts.append(pairs_text([("cost", bound)]))
    return "\n".join(filter(None, [*parts, pairs_text([("note", note) for note in found.notes])]))


def _shown(value: float | None) -> str:
    return "none" if value is None else f"{value:.6g}"


def _most(value: float | None) -> str:
    """Return an upper bound, rounded up."""
    return "none" if value is None else "0" if value == 0 else rounded(value, 6, 1)


def bench_text(found: Bench) -> str:
    """Return the simulation speed of this machine."""
    about = found.machine
    title = wrapped_text(f"two-mass loop, {about['processor']} ({about['vectors']}), one thread, medians")
    rows = [[name, f"{speed / 1e6:.4g}"] for name, speed in found.speeds.items()]
    lines = [(name.replace("_", " "), f"{ratio:.3g}") for name, ratio in found.ratios.items()]
    lines += [(f"machine code, {name}", f"{1000 * seconds:.3g} ms") for name, seconds in found.compile_seconds.items()]
    for name, ratio in found.variance_ratios.items():
        lines.append((f"variance, {name}".replace("_", " "), f"{ratio:.3g} times less per step"))
    return "\n".join([title, table_text(["", "million steps/s"], rows, 1), pairs_text(lines)])
