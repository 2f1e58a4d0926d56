"""Reproduction of chapter 4 of the thesis: the dynamic trigger, and a threshold that is worse than periodic control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from taciturn.extend import Panel, Progress, Series, draw
from taciturn.lqg.prediction import PredictionCost, prediction_cost
from taciturn.model.cost import Cost
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant, Jumps
from taciturn.problem import load
from taciturn_events.cycles import estimate_cycles, sample_cycles, sweep_thresholds
from taciturn_events.events import IntegralTrigger, JumpProcess
from taciturn_events.integral import integral
from taciturn_events.losing_thresholds import Losses, find_losses
from taciturn_events.policy import EventPolicy
from taciturn_thesis.chapter5 import price_of
from taciturn_thesis.reproduction import Reproduction, Row, Table

PRINTED_SLOPE = 9.1557
PRINTED: Mapping[str, float] = {
    "tr(PλW)": 21.3959, "g'(0)": 9.1557, "α*": 1.50, "g_ETC": 8.6393, "J": 30.0352,
}  # fmt: skip
SLOPES = (1, 2, 3, 4, 5, 6, 7, 8, 9)
ALPHAS = (0.5, 1.0, 1.25, 1.4, 1.5, 1.75, 2.0)  # values of α in Figure 4.4
H_MAX = 2.0
CYCLES = 1_000_000
COUNTER_SLOPES, COUNTER_ALPHA, COUNTER_H_MAX = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0), 0.2, 10.0
THRESHOLDS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 6.5)  # thresholds Y


def chapter4(seed: int, progress: Progress) -> Reproduction:
    """Compute the numbers of section 4.5 and Figures 4.4 to 4.6, with exact event times between Poisson jumps.

    Source: khashooei2017
    """
    problem = load("double-integrator")
    assert isinstance(problem.plant, ContinuousPlant)
    price = price_of(problem)
    rows: list[Row] = []
    for slope in (*SLOPES, PRINTED_SLOPE):
        policy = integral(problem.plant, problem.cost, slope=slope, h_max=H_MAX)
        assert isinstance(policy, EventPolicy)
        rows.append(_row(slope, policy, price, seed))
        progress(0.6 * len(rows) / (len(SLOPES) + 1))
    *rows, printed = rows
    printed = Row({"C": PRINTED_SLOPE}, PRINTED, {**_known(price), **printed.computed})
    assert problem.plant.jumps is not None
    process = JumpProcess(problem.plant.A, problem.plant.jumps, price.S)
    limits = IntegralTrigger(1.0, h_max=H_MAX)
    means = sweep_thresholds(
        process, [alpha * PRINTED_SLOPE for alpha in ALPHAS], trigger=limits, cycles=CYCLES, seed=seed
    )
    lengths = [Row({"α": a}, {}, {"L(α)": found.interval}) for a, found in zip(ALPHAS, means, strict=True)]
    progress(0.7)
    counter, dynamic, losses = _counter_example(seed)
    progress(0.95)
    tables = (
        Table(
            "Section 4.5.1, C = 9.1557, h_max = 2",
            (printed,),
            (
                "the printed α = 1.50 is not admissible: L(1.5) = "
                f"{means[ALPHAS.index(1.5)].interval} is smaller; the fixed point is α*, with a lower cost",
                "a time grid of 0.02 s would make the mean interval 1.5 % too long; the event times here are exact",
            ),
        ),
        Table("Figure 4.4 (a): L(α) at C = 9.1557", tuple(lengths), ("values with α ≤ L(α) are admissible",)),
        Table("Figure 4.5: fixed point at each slope", tuple(rows), ("the thesis prints a figure without numbers",)),
        Table("Figure 4.6: counter-example 4.5.2, α = 0.2", tuple(dynamic), _notes(counter)),
        Table("Figure 4.6: Euclidean threshold |e| ≥ Y", tuple(_lost(losses, counter)), _where(losses)),
    )
    picture = draw([_figure_4_4(lengths), *_figures(rows, price, counter, dynamic, losses)])
    sample = _figure_4_4_b(process, replace(limits, c=printed.computed["α*"].value * PRINTED_SLOPE), seed)
    progress(1.0)
    return Reproduction(
        "chapter4", tables, {"chapter4": picture, "chapter4-intervals": draw([sample])}, {"double-integrator": problem}
    )


def _row(slope: float, policy: EventPolicy, price: PredictionCost, seed: int) -> Row:
    found = estimate_cycles(policy.process, policy.trigger, cycles=CYCLES, seed=seed + 1)
    same = price.periodic(found.interval.value)
    computed = {
        "α*": policy.alpha,
        "g_ETC": found.cost,
        "J": found.cost.scaled(1.0, policy.cost_all_time),
        "periodic, same interval": Estimate(same, 0.0, "exact"),
    }
    return Row({"C": slope}, {}, computed)


def _known(price: PredictionCost) -> dict[str, Estimate]:
    return {
        "tr(PλW)": Estimate(price.base, 0.0, "exact"),
        "g'(0)": Estimate(price.initial_slope, 0.0, "exact"),
    }


def _counter_example(seed: int) -> tuple[PredictionCost, list[Row], Losses]:
    """Return periodic control, the dynamic trigger and the Euclidean threshold of section 4.5.2."""
    plant = ContinuousPlant([[1.0, 0.01], [0.0, 1.0]], np.eye(2), jumps=Jumps(50.0, np.diag([0.001, 0.4])))
    cost = Cost(np.diag([10.0, 0.001]), np.diag([10.0, 0.001]))
    losses = find_losses(plant, cost, levels=[Y**2 for Y in THRESHOLDS], h_max=COUNTER_H_MAX, seed=seed)
    price = prediction_cost(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W)
    assert plant.jumps is not None
    limits = IntegralTrigger(1.0, h_max=COUNTER_H_MAX)
    means = sweep_thresholds(
        JumpProcess(plant.A, plant.jumps, price.S),
        [COUNTER_ALPHA * slope for slope in COUNTER_SLOPES],
        trigger=limits,
        cycles=CYCLES // 10,
        seed=seed,
    )
    rows = [
        Row(
            {"C (α = 0.2)": slope},
            {},
            {
                "E[θ]": found.interval,
                "g": found.cost,
                "g periodic": Estimate(price.growth(found.interval.value), 0.0, "exact"),
            },
        )
        for slope, found in zip(COUNTER_SLOPES, means, strict=True)
    ]
    return price, rows, losses


def _lost(losses: Losses, counter: PredictionCost) -> list[Row]:
    return [
        Row(
            {"Y": float(np.sqrt(point.level))},
            {},
            {
                "E[θ]": point.rate.inverse(),
                "g": point.cost.scaled(1.0, -counter.base),
                "g periodic": Estimate(point.cost_periodic - counter.base, 0.0, "exact"),
            },
        )
        for point in losses.points
    ]


def _notes(counter: PredictionCost) -> tuple[str, ...]:
    return (
        f"g'(0): printed 1.4274, computed {counter.initial_slope:.6f}; the effective slope αC/E[θ] is below g'(0) "
        "everywhere here; for E[θ] < 0.2 the printed α = 0.2 is above L(α), and the same policy has a smaller α",
    )


def _where(losses: Losses) -> tuple[str, ...]:
    ranges = " and ".join(f"from {low:.3g} to {high:.3g}" for low, high in losses.rates)
    return (f"the threshold costs more than periodic control at the rates {ranges} per second",)


def _figure_4_4(lengths: Sequence[Row]) -> Panel:
    alphas = [float(row.setting["α"]) for row in lengths]
    found = [row.computed["L(α)"].value for row in lengths]
    series = [Series(alphas, found, "L(α)"), Series(alphas, alphas, "α", "dashed", thing=7)]
    return Panel(series, "α (s)", "mean interval (s)", "Figure 4.4 (a)")


def _figure_4_4_b(process: JumpProcess, trigger: IntegralTrigger, seed: int) -> Panel:
    """Return the distribution of the intervals; Figure 4.4 (b) shows five of them."""
    durations = np.sort(sample_cycles(process, trigger, cycles=20_000, seed=seed).durations)
    shares = (np.arange(len(durations)) + 0.5) / len(durations)
    shown = slice(None, None, 20)
    series = [Series(durations[shown].tolist(), shares[shown].tolist(), "P(θ ≤ t)")]
    return Panel(series, "interval (s)", "share", "Figure 4.4 (b): distribution of the intervals")


def _figures(
    rows: Sequence[Row], price: PredictionCost, counter: PredictionCost, dynamic: Sequence[Row], losses: Losses
) -> list[Panel]:
    slopes, alphas = [float(row.setting["C"]) for row in rows], [row.computed["α*"].value for row in rows]
    costs = [row.computed["J"].value for row in rows]
    lengths = np.linspace(0.05, max(alphas), 40).tolist()
    periodic = Series(lengths, [price.periodic(h) for h in lengths], "periodic control", thing="periodic control")
    intervals = np.linspace(0.02, 1.0, 40).tolist()
    clock = Series(intervals, [counter.growth(h) for h in intervals], "periodic control", thing="periodic control")
    proposed = Series(
        [r.computed["E[θ]"].value for r in dynamic], [r.computed["g"].value for r in dynamic], "dynamic", thing="policy"
    )
    threshold = [(1 / p.rate.value, p.cost.value - counter.base) for p in losses.points]
    euclidean = Series([x for x, _ in threshold], [y for _, y in threshold], "Euclidean threshold", thing=3)
    return [
        Panel(
            [Series(slopes, alphas, "α*")],
            "slope C (cost/s²)",
            "mean interval (s)",
            "Figure 4.5, top left",
        ),
        Panel(
            [Series(slopes, costs, "J")],
            "slope C (cost/s²)",
            "cost per second",
            "Figure 4.5, top right",
        ),
        Panel(
            [Series(alphas, costs, "dynamic", thing="policy"), periodic],
            "mean interval (s)",
            "cost per second",
            "Figure 4.5, bottom",
        ),
        Panel([proposed, euclidean, clock], "mean interval (s)", "cost per second beyond tr(PλW)", "Figure 4.6"),
    ]
