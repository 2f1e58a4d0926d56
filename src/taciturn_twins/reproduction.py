"""Experiments of chapters 6 and 7 of the thesis, repeated with digital twins and compared with the printed numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from taciturn.extend import Array, Panel, Progress, Series, Thing, draw
from taciturn.model.estimate import Estimate
from taciturn_thesis.chapter7 import TRACKING_PRICES
from taciturn_thesis.reproduction import Reproduction, Row, Table
from taciturn_twins.figures import inputs, path, positions, running_costs, sends
from taciturn_twins.outcome import mean
from taciturn_twins.prepared import prepare
from taciturn_twins.run import TwinRun, run_twin, scaled
from taciturn_twins.trial import Setup

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RUNS, ROUNDS = 10, 5  # number of experiments with the rover, and of rounds of the omni-directional robot
PRINTED = {  # numbers of section 6.6
    "all-time": {"J": 116.47, "sensor %": 100.0, "actuator %": 100.0},
    "event-triggered": {"J": 127.85, "sensor %": 20.0, "actuator %": 10.0},
}


def chapter6(seed: int, progress: Progress) -> Reproduction:
    """Repeat the experiments of chapter 6 with the twin of the rover, and compare them with the printed numbers.

    Source: khashooei2017
    """
    run = run_twin("rover", Setup(RUNS, seed), progress=progress)
    assert run.always is not None
    schedule = run.policy.schedule
    assert schedule is not None
    trials = {"event-triggered": run.trial, "all-time": run.always}
    rows = tuple(
        Row(
            {"policy": name},
            PRINTED[name],
            {
                "J": mean(trial.totals),
                "sensor %": _percent(trial.sent["sensor"]),
                "actuator %": _percent(trial.sent["actuator"]),
            },
        )
        for name, trial in trials.items()
    )
    ticks = [float(k) for k in range(len(schedule.queries))]
    values = [
        Series(ticks, schedule.value.tolist(), "value of a question, h"),
        Series([0.0, ticks[-1]], [schedule.price] * 2, "price, ζ", thing="limits"),
    ]
    figure = draw(
        [
            Panel(running_costs(trials), ylabel="cost per step", title=f"Figures 6.5 and 6.8: mean of {RUNS} runs"),
            Panel(inputs(trials), ylabel="input (%)", title="Figures 6.6 and 6.9: one run"),
            Panel(lanes=sends(run.trial)),
            Panel(values, ylabel="cost", title="Figure 6.7: requests to the camera"),
            Panel(positions(trials), "step", "x (m)", "Figure 6.10: position and estimate"),
        ]
    )
    notes = (
        f"{RUNS} runs from x_0 = 0.7 m with a model identified in the twin: the cost of sending every sample is "
        f"{run.policy.cost_all_time:.4g} in theory, and the guarantee {run.cost_bound:.5g}",
        "the thesis: 103.66 and 113.15 in simulation, with 80 % and 90 % fewer packets on the two links",
        *run.trial.notes,
    )
    return Reproduction(
        "chapter6-twin",
        (Table("Section 6.6: the experiment", rows, notes),),
        {"chapter6-twin": figure},
        {"rover": run.trial.problem},
    )


def chapter7(seed: int, progress: Progress) -> Reproduction:
    """Repeat the experiment of chapter 7 with the twin of the omni-directional robot, and compare it with the thesis.

    Source: khashooei2017
    """
    prepared = prepare("omni", seed)
    runs: dict[float, TwinRun] = {}
    for i, price in enumerate(TRACKING_PRICES):
        runs[price] = run_twin(
            prepared, Setup(ROUNDS, seed), parameters={"price": price}, compare=False,
            progress=scaled(progress, i / len(TRACKING_PRICES), (i + 1) / len(TRACKING_PRICES)),
        )  # fmt: skip
    rows: list[Row] = []
    for price, run in runs.items():
        guarantee = run.policy.guarantee
        assert guarantee is not None
        rate, exact = run.rates["actuator"], "bound"
        rows.append(
            Row(
                {"λ": price},
                {},
                {
                    "R_t": rate,
                    "J": run.cost,
                    "J_all": Estimate(run.policy.cost_all_time, 0.0, "exact"),
                    "J_all + λN": Estimate(guarantee.cost, 0.0, exact),
                    "J_all + λN(1−R_t)": Estimate(guarantee.at_rate(rate.value) or guarantee.cost, 0.0, exact),
                    "measured J_all + λN": Estimate(
                        runs[0.0].cost.value + guarantee.cost - run.policy.cost_all_time,
                        runs[0.0].cost.standard_error,
                        "simulation",
                    ),
                    "path off, mm": mean(1e3 * np.sqrt((run.trial.off**2).mean(axis=1))),
                },
            )
        )
    notes = (
        f"{ROUNDS} rounds per price; J_all is computed from a model identified in the twin",
        "the thesis gives only a plot of an experiment with a robot, without numbers",
        "measured J_all: the measured cost for λ = 0, as in the thesis; path off: RMS distance over a round",
        *(note for run in runs.values() for note in run.trial.notes[:1]),
    )
    problems = {f"omni, price {price:g}": run.trial.problem for price, run in runs.items()}
    pictures = {"chapter7-twin-path": _path(runs[0.01]), "chapter7-twin-cost": _costs(rows)}
    return Reproduction("chapter7-twin", (Table("Figure 7.6: the experiment", tuple(rows), notes),), pictures, problems)


def _path(run: TwinRun) -> Figure:
    panel = Panel(path({"twin": run.trial}), "x (m)", "y (m)", "Figure 7.5: one round at λ = 0.01")
    figure = draw([panel])
    figure.axes[0].set_aspect("equal")
    return figure


def _costs(rows: list[Row]) -> Figure:
    prices = [float(row.setting["λ"]) for row in rows]
    found = {name: [row.computed[name] for row in rows] for name in ("J", "J_all + λN", "J_all")}
    things: Mapping[str, Thing] = {"J": "policy", "J_all + λN": "guarantee", "J_all": "every sample"}
    series = [
        Series(prices, [e.value for e in column], name, error=[e.standard_error for e in column], thing=things[name])
        for name, column in found.items()
    ]
    return draw([Panel(series, "price of a send, λ (cost)", "cost per mission", "Figure 7.6")])


def _percent(sent: Array) -> Estimate:
    return mean(100 * sent.mean(axis=1))
