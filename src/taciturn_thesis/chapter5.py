"""Reproduction of chapter 5 of the thesis: consistent periodic event-triggered control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from taciturn.extend import Panel, Progress, Series, draw
from taciturn.lqg.prediction import PredictionCost, prediction_cost
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant
from taciturn.problem import Problem, load
from taciturn.study.evaluate import evaluate
from taciturn_thesis.reproduction import Reproduction, Row, Table

CHECKS = (0.5, 1.0, 2.0, 4.0, 10.0, 20.0)  # checks per second in Figure 5.4; the thesis does not print its values
PRINTED: Mapping[str, float] = {  # section 5.5, (5.45) and its derivative
    "L1": 0.3162, "L2": 0.8558, "V_p: 1": 21.3959, "1/r": 9.1557, "1/r²": 2.2553, "1/r³": 0.2083,
    "−dV_p/dr: 1/r²": 9.1557, "1/r³ ": 4.5106, "1/r⁴": 0.6249,
}  # fmt: skip


def chapter5(seed: int, progress: Progress) -> Reproduction:
    """Compute the numbers of section 5.5 and Figure 5.4: thresholds that cost less than periodic control.

    Source: khashooei2017
    """
    jumps = load("double-integrator")
    price = price_of(jumps)
    rows: list[Row] = []
    for checks in CHECKS:
        problem = jumps.changed({"period": 1 / checks})
        rows.append(_point(checks, problem, price, seed))
        progress(len(rows) / len(CHECKS))
    tables = (
        Table(
            "Section 5.5",
            (Row({}, PRINTED, _coefficients(price)),),
            ("the thesis prints L without its sign: u = Lx̂ has L = −[0.3162, 0.8558]",),
        ),
        Table(
            "Figure 5.4",
            tuple(rows),
            (
                "the thesis prints a figure without numbers and without the rates of its checks; δ has its largest "
                "consistent value, and costs are per second",
                "the last columns are for Wiener noise of the same intensity",
            ),
        ),
    )
    return Reproduction("chapter5", tables, {"chapter5": draw([_panel(rows, price)])}, {"double-integrator": jumps})


def price_of(problem: Problem) -> PredictionCost:
    """Return the cost of control that predicts the state between sends."""
    plant, cost = problem.plant, problem.cost
    return prediction_cost(plant.A, plant.B, cost.Q, cost.R, cost.N, plant.W)


def _coefficients(price: PredictionCost) -> dict[str, Estimate]:
    """Return L and the coefficients of the polynomial g(h), which has degree three because A² = 0."""
    lengths = np.array([0.5, 1.0, 2.0])
    powers = np.vander(lengths, 4, increasing=True)[:, 1:]
    first, second, third = np.linalg.solve(powers, [price.growth(h) for h in lengths])
    values = [*-price.L[0], price.base, first, second, third, first, 2 * second, 3 * third]
    return {name: Estimate(float(value), 0.0, "exact") for name, value in zip(PRINTED, values, strict=True)}


def _point(checks: float, problem: Problem, price: PredictionCost, seed: int) -> Row:
    plant = problem.plant
    wiener = Problem(
        ContinuousPlant(plant.A, plant.B, plant.W), problem.cost, problem.network, problem.kind, problem.parameters
    )
    computed = {
        "δ": Estimate(price.slope_in_rate(1 / checks), 0.0, "exact"),
        "V_p": Estimate(price.periodic(1 / checks), 0.0, "exact"),
    }
    for name, case in (("", problem), (" (Wiener)", wiener)):
        found = evaluate(case, seed=seed)
        computed[f"r{name}"], computed[f"V{name}"] = found.rates["sensor"], found.cost
    return Row({"checks per second": checks}, {}, computed)


def _panel(rows: Sequence[Row], price: PredictionCost) -> Panel:
    def column(name: str) -> list[float]:
        return [row.computed[name].value for row in rows]

    rates = np.geomspace(min(column("r")), max(CHECKS), 80).tolist()
    series = [
        Series(rates, [price.periodic(1 / r) for r in rates], "periodic control", thing="periodic control"),
        Series(list(CHECKS), column("V_p"), "base policies", "points", thing=4),
        Series(column("r"), column("V"), "consistent, jumps", "points", thing=3),
        Series(column("r (Wiener)"), column("V (Wiener)"), "consistent, Wiener noise", "points", thing="policy"),
    ]
    return Panel(series, "sends per second", "cost per second", "Figure 5.4: double integrator")
