"""Reproduction of chapter 7 of the thesis: lossy links, and a robot that tracks a reference over them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from taciturn.design.kinds.lossy_lqg import lossy_lqg
from taciturn.extend import Curve, Panel, Progress, Series, Thing, draw
from taciturn.loop import Loop, close
from taciturn.model.cost import Cost
from taciturn.model.disturbance import Reference
from taciturn.model.estimate import Estimate
from taciturn.model.network import Network
from taciturn.model.plant import Plant
from taciturn.problem import load
from taciturn.simulation.average import average
from taciturn.simulation.trajectory import simulate
from taciturn_studies.points import Cell, Effort, evaluate_cells
from taciturn_thesis.reproduction import Reproduction, Row, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PROTOCOLS: Mapping[str, Mapping[str, object]] = {
    "udp": {},
    "tcp": {"network.protocol": "tcp"},
    "ideal": {"network.protocol": "ideal", "network.sensor_loss": 0.0, "network.actuator_loss": 0.0},
}
PRICES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # λ of the points of Figure 7.2
PRECISION = 5e-3  # standard error of a cost of Figure 7.2
TRACKING_PRICES = (0.0, 0.001, 0.002, 0.01)  # λ of Figure 7.6
TRACKING_PRECISION = 1e-4  # standard error of its costs
SECONDS, STEPS = 0.1, 250  # seconds between steps, and steps of one round
NOISE = 0.01  # standard deviation per step


def chapter7(seed: int, progress: Progress) -> Reproduction:
    """Compute Figures 7.2, 7.5 and 7.6: control over lossy links, and tracking over them.

    Source: khashooei2017
    """
    problem, total = load("lossy-double-integrator"), len(PROTOCOLS) * len(PRICES) + len(TRACKING_PRICES)
    grid = [(protocol, price) for protocol in PROTOCOLS for price in PRICES]
    cells = [Cell({**PROTOCOLS[protocol], "price": price}, seed) for protocol, price in grid]
    answers = evaluate_cells(
        problem, cells, Effort(PRECISION), progress=lambda share: progress(share * len(cells) / total)
    )
    points = [
        _point(
            {"links": protocol, "λ": price},
            found.rates["actuator"],
            found.cost,
            (found.cost_all_time, found.cost_bound, found.cost_bound_at_rate),
        )
        for (protocol, price), found in zip(grid, answers, strict=True)
    ]
    rounds: list[Row] = []
    for price in TRACKING_PRICES:
        loop = tracking_loop(price)
        found = average(loop, seed=seed, standard_error=TRACKING_PRECISION)
        policy, rate = loop.policy, found.rates["actuator"]
        assert policy.guarantee is not None
        bounds = (policy.cost_all_time, policy.guarantee.cost, policy.guarantee.at_rate(rate.value))
        rounds.append(_point({"λ": price}, rate, found.cost, bounds))
        progress((len(points) + len(rounds)) / total)
    tables = (
        Table(
            "Figure 7.2, α = 0.3, β = 0.6",
            tuple(points),
            ("the thesis prints a figure without numbers and without the initial state: x_0 = [1, 0] is assumed",),
        ),
        Table(
            "Figure 7.6, α = 0.1, β = 0.25, one step of delay",
            tuple(rounds),
            (
                "the thesis prints a figure of an experiment with a robot, which a simulation cannot reproduce",
                f"assumed: noise of {NOISE:g} per step in each state, and one round of both circles in {STEPS} steps",
                "at λ = 0 the silent steps are those before the first measurement has arrived: until then x̂ equals "
                "the reference, so silence and a send cost the same, and a tie means silence",
                "Figure 7.5 is one simulated round",
            ),
        ),
    )
    pictures = {
        "chapter7": _figure_7_2(points),
        "chapter7-path": _figure_7_5(seed),
        "chapter7-cost": _figure_7_6(rounds),
    }
    return Reproduction("chapter7", tables, pictures, {"lossy-double-integrator": problem})


def two_circles() -> Reference:
    """Return the reference of section 7.5: two tangent circles of radius 1 m, which take ``STEPS`` steps together."""
    turn = np.linspace(0.0, 4 * np.pi, STEPS + 1)
    side = np.where(turn < 2 * np.pi, -1.0, 1.0)
    states = np.column_stack([side * (1 - np.cos(turn)), -np.sin(turn), np.zeros(STEPS + 1)])
    return Reference(states, np.diff(states, axis=0) / SECONDS)


def tracking_loop(price: float) -> Loop:
    """Return the closed loop of section 7.5 of the thesis for a given price per send."""
    unit, reference = np.eye(3), two_circles()
    plant = Plant(unit, SECONDS * unit, NOISE**2 * unit, dt=SECONDS, mean=reference.states[0])
    network = Network("udp", actuator_loss=0.1, sensor_loss=0.25, delay=1)
    policy = lossy_lqg(plant, Cost(unit, unit, horizon=STEPS), price=price, network=network, reference=reference)
    return close(plant, policy)


def _point(setting: Mapping[str, object], rate: Estimate, cost: Estimate, bounds: Sequence[float | None]) -> Row:
    computed = {"R_t": rate, "J": cost}
    for name, value in zip(("J_all", "J_all + λN", "J_all + λN(1−R_t)"), bounds, strict=True):
        assert value is not None
        computed[name] = Estimate(value, 0.0, "exact" if name == "J_all" else "bound")
    return Row(setting, {}, computed)


def _curves(rows: Sequence[Row], x: Sequence[float]) -> list[Series]:
    columns = {name: [row.computed[name] for row in rows] for name in rows[0].computed}
    costs = columns["J"]
    series = [Series(x, [e.value for e in costs], "J", error=[e.standard_error for e in costs], thing="policy")]
    lines: Sequence[tuple[str, Curve, Thing]] = (
        ("J_all + λN", "dotted", "guarantee"),
        ("J_all + λN(1−R_t)", "dashed", "guarantee"),
        ("J_all", "dashed", "every sample"),
    )
    series += [Series(x, [e.value for e in columns[name]], name, curve, thing=thing) for name, curve, thing in lines]
    return series


def _figure_7_2(points: Sequence[Row]) -> Figure:
    panels: list[Panel] = []
    for protocol in PROTOCOLS:
        rows = [row for row in points if row.setting["links"] == protocol]
        rates = [row.computed["R_t"].value for row in rows]
        panels.append(Panel(_curves(rows, rates), "sends per step, R_t", "total cost", f"Figure 7.2: {protocol}"))
    return draw(panels)


def _figure_7_5(seed: int) -> Figure:
    price, reference = TRACKING_PRICES[-1], two_circles().states
    path = simulate(tracking_loop(price), STEPS, seed=seed)
    sent = path.sends["actuator"]
    x, y = path.state[sent].T[:2].tolist()
    figure = draw(
        [
            Panel(
                [
                    Series(reference[:, 0].tolist(), reference[:, 1].tolist(), "reference", thing="set-point"),
                    Series(path.state[:, 0].tolist(), path.state[:, 1].tolist(), "path", thing="policy"),
                    Series(x, y, f"sends: {int(sent.sum())} of {STEPS}", "points", thing="delivered"),
                ],
                "x (m)",
                "y (m)",
                f"Figure 7.5: one round at λ = {price:g}",
            )
        ]
    )
    figure.axes[0].set_aspect("equal")
    return figure


def _figure_7_6(rounds: Sequence[Row]) -> Figure:
    return draw([Panel(_curves(rounds, TRACKING_PRICES), "price of a send, λ (cost)", "total cost", "Figure 7.6")])
