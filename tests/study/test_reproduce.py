"""The chapters as reproduced, against the exact numbers; and the running cost of their figures."""

from __future__ import annotations

import json
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import taciturn
from taciturn.simulation.trajectory import course
from taciturn_thesis import chapter2, chapter7
from taciturn_thesis.chapter7 import two_circles
from taciturn_thesis.reproduce import CHAPTERS, reproduce

if TYPE_CHECKING:
    from taciturn_thesis.reproduction import Reproduction, Row

# chapter → for each row its setting, and what its columns must be: to half a unit of the last digit, or ± an error
EXPECTED: dict[str, list[tuple[dict[str, object], dict[str, str]]]] = {
    "chapter3": [
        (
            {"ζ": 1.65},
            {"J_all": "0.481486", "J": "1.25325", "sensor %": "50", "actuator %": "93.565", "bound": "2.558"},
        ),
        ({"ζ": 1.5}, {"J_all": "0.481486", "J": "0.97771", "sensor %": "66.667", "actuator %": "90.937"}),
        ({"ζ": 0.5}, {"J_all": "0.45755", "J": "0.70594", "sensor %": "14.286", "actuator %": "35.0"}),
    ],
    "chapter4": [
        ({"C": 9.1557}, {"tr(PλW)": "21.3959", "g'(0)": "9.1557", "periodic, same interval": "40.36 ± 0.02"}),
        ({"C": 9.1557}, {"α*": "1.46812 ± 0.00014", "g_ETC": "8.5418 ± 0.003", "J": "29.9377 ± 0.003"}),
        *(
            ({"C": slope}, {"α*": alpha, "J": f"{cost} ± 0.002"})
            for slope, alpha, cost in (
                *((1, "0.330", 21.723), (2, "0.463", 22.296), (3, "0.640", 23.179), (4, "0.839", 24.308)),
                *((5, "1.020", 25.511), (6, "1.168", 26.681), (7, "1.286", 27.783), (8, "1.380", 28.817)),
            )
        ),
        ({"α": 1.5}, {"L(α)": "1.47742 ± 0.0002"}),
        ({"C (α = 0.2)": 6.0}, {"E[θ]": "0.971", "g": "1.2", "g periodic": "3.06 ± 0.01"}),
        ({"Y": 2.0}, {"E[θ]": "0.256", "g": "0.858", "g periodic": "0.439 ± 0.001"}),
    ],
    "chapter5": [
        ({}, {"V_p: 1": "21.3959", "1/r": "9.1557", "1/r²": "2.2553", "1/r³": "0.2083"}),
        ({"checks per second": 0.5}, {"δ": "82.708", "r": "0.2768078", "V": "56.249621"}),
        ({"checks per second": 4.0}, {"δ": "0.6451512", "r (Wiener)": "2.03778693", "V (Wiener)": "24.2270133"}),
        ({"checks per second": 20.0}, {"δ": "0.0234570", "r": "3.3206635", "V": "21.897809"}),
    ],
    "chapter6": [
        ({"x_0": 0.6322}, {"J_all": "103.65", "J": "112.63", "sensor %": "18.333", "actuator %": "7.5"}),
        ({"x_0": 0.7}, {"J_all": "126.73", "J": "137.74", "sensor %": "18.333"}),
    ],
    "chapter7": [
        ({"links": "udp", "λ": 0.0}, {"J_all": "63.7760", "J": "63.7760", "R_t": "1", "J_all + λN": "63.7760"}),
        ({"links": "tcp", "λ": 0.0}, {"J_all": "63.4150", "J": "63.4150", "R_t": "1"}),
        ({"links": "ideal", "λ": 0.0}, {"J_all": "49.9359", "J": "49.9359", "R_t": "1"}),
        ({"links": "udp", "λ": 0.1}, {"J": "65.520 ± 0.004", "R_t": "0.502", "J_all + λN": "73.7760"}),
        ({"links": "tcp", "λ": 0.1}, {"J": "65.187 ± 0.004", "R_t": "0.494"}),
        ({"links": "ideal", "λ": 0.1}, {"J": "51.553 ± 0.004", "R_t": "0.466"}),
        ({"links": "udp", "λ": 1.0}, {"J": "95.03 ± 0.03", "R_t": "0.1474 ± 0.0002", "J_all + λN": "163.7760"}),
        ({"links": "tcp", "λ": 1.0}, {"J": "94.29 ± 0.03", "R_t": "0.1452 ± 0.0002"}),
        ({"links": "ideal", "λ": 1.0}, {"J": "78.15 ± 0.03", "R_t": "0.1340 ± 0.0002"}),
        ({"λ": 0.0}, {"J": "0.9058", "R_t": "0.991", "J_all + λN": "0.906"}),
        ({"λ": 0.001}, {"J": "0.9541", "R_t": "0.655", "J_all + λN": "1.156"}),
        ({"λ": 0.002}, {"J": "1.0565", "R_t": "0.460", "J_all + λN": "1.406"}),
        ({"λ": 0.01}, {"J": "2.0549 ± 0.0001", "R_t": "0.124", "J_all + λN": "3.406"}),
    ],
}


QUICK = ("chapter3", "chapter6")  # the others take many seconds
CHECKED = [name if name in QUICK else pytest.param(name, marks=pytest.mark.evidence) for name in EXPECTED]


@cache
def chapter(name: str) -> Reproduction:
    """Compute each chapter once, Figure 7.2 from fewer draws."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chapter7, "PRECISION", 0.02)
        return reproduce(name, progress=lambda fraction: None)


@pytest.mark.evidence
@pytest.mark.parametrize("name", CHECKED)
def test_a_chapter_agrees_with_the_exact_numbers(name: str) -> None:
    """All tables but one from as many draws as a user takes."""
    agrees(chapter(name))


@pytest.mark.evidence
def test_chapter_7_in_full_agrees_with_the_exact_numbers() -> None:
    """From as many draws as a user takes."""
    agrees(reproduce("chapter7"))


def agrees(found: Reproduction) -> None:
    """Check within 4 standard errors and half a digit; costs lie between the all-time cost and the guarantee."""
    rows: list[Row] = [row for table in found.tables for row in table.rows]
    for setting, expected in EXPECTED[found.name]:
        (row,) = (row for row in rows if dict(row.setting) == setting)
        for column, text in expected.items():
            number, _, error = text.partition(" ± ")
            one, half = row.computed[column], 0.5 * 10.0 ** -len(number.partition(".")[2])
            allowed = 4 * np.hypot(one.standard_error, float(error or 0.0)) + half
            assert abs(one.value - float(number)) <= allowed, f"{setting} {column}: {one}, expected {text}"
    for row in rows:
        if "J_all" not in row.computed or "J" not in row.computed:
            continue
        cost = row.computed["J"]
        assert row.computed["J_all"].value - 4 * cost.standard_error - 1e-9 <= cost.value
        bounds = [e.value for e in row.computed.values() if e.method == "bound"]
        assert len(bounds) == len(set(row.computed) & {"bound", "J_all + λN", "J_all + λN(1−R_t)"})
        assert all(cost.value <= bound + 4 * cost.standard_error + 1e-9 for bound in bounds)


@pytest.mark.evidence
@pytest.mark.parametrize("name", CHECKED)
def test_a_chapter_is_a_document_with_a_report_of_its_progress(name: str) -> None:
    """JSON without NaN, with every printed number next to a computed one, and a fraction that ends at 1."""
    document = json.loads(json.dumps(chapter(name).document(), allow_nan=False))
    assert document["name"] == name
    for table in document["tables"]:
        assert table["notes"]
        for row in table["rows"]:
            assert set(row["printed"]) <= set(row["computed"])
            assert all(set(e) == {"value", "standard_error", "method"} for e in row["computed"].values())
    listed = ", ".join(f"chapter{i}" for i in range(2, 8))
    with pytest.raises(taciturn.ProblemError, match=f"expected one of {listed}, or all"):
        reproduce("chapter8")
    assert set(EXPECTED) | {"chapter2"} == set(CHAPTERS)


@pytest.mark.evidence
def test_chapter_2_names_its_triggers_and_the_epsilon_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """One row of each table: what is printed says ε, which is no default; the keys of the document are as ever."""
    for name in ("TABLE_2_1", "TABLE_2_2"):
        monkeypatch.setattr(chapter2, name, dict(list(getattr(chapter2, name).items())[:1]))
    monkeypatch.setattr(chapter2, "FIGURE_2_2", (0.1,))
    monkeypatch.setattr(chapter2, "PRECISION", 1e-2)
    found = reproduce("chapter2")
    told = " ".join(str(found).split())
    for table in found.tables[:2]:
        assert {
            f"{what}, {trigger}" for what in ("cost", "rate") for trigger in ("separate (2.12)", "joint (2.13)")
        } <= {heading.removesuffix(" %").removesuffix(",") for heading in table.headings.values()}
        assert "--over trigger=separate --over epsilon=0.009 (by default, ε is half its limit, here 0.05)" in told
    assert {"cost (2.12)", "rate (2.13) %"} <= set(found.document()["tables"][0]["rows"][0]["computed"])
    separate = taciturn.load("two-mass-lqg").changed({"trigger": "separate"})
    forms = [
        one.design().decisions["send"].options["silent"].Psi
        for one in (separate, separate.changed({"epsilon": 0.05}), separate.changed(dict(chapter2.TRIGGERS[0])))
    ]
    assert np.allclose(forms[0], forms[1], rtol=1e-9)
    assert not np.allclose(forms[0], forms[2], rtol=0.1)


@pytest.mark.evidence
def test_progress_only_grows_and_ends_at_one() -> None:
    """Of the quickest chapter."""
    seen: list[float] = []
    reproduce("chapter6", seed=1, progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


PANELS = {
    "chapter3": {"chapter3": ["Figure 3.4", "Figure 3.5", "Figure 3.6"]},
    "chapter6": {"chapter6": ["Figure 6.5", "Figure 6.6", "", "Figure 6.7"]},
    "chapter7": {"chapter7": ["Figure 7.2"] * 3, "chapter7-path": ["Figure 7.5"], "chapter7-cost": ["Figure 7.6"]},
}


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.evidence) for name in PANELS]
)
def test_the_pictures_have_the_panels_of_the_figures(name: str) -> None:
    """Figures over one axis share a picture; each panel is titled by its figure."""

    def panels(name: str) -> dict[str, list[str]]:
        return {key: [a.get_title().partition(":")[0] for a in f.axes] for key, f in chapter(name).pictures.items()}

    assert panels(name) == PANELS[name]
    if name not in QUICK:
        return
    sizes = [len(a.lines) for f in (chapter("chapter3"), chapter("chapter6")) for a in f.pictures[f.name].axes]
    assert sizes == [5, 5, 2, 2, 2, 1, 3]


def test_the_notes_of_chapter_3_are_true() -> None:
    """Which ζ share the printed rate of 66 %, that 1.63 and 1.65 query alike, and the printed bound."""
    problem = taciturn.load("remote-scalar")

    def rate(zeta: float) -> float:
        schedule = problem.changed({"zeta": zeta}).design().schedule
        assert schedule is not None
        return schedule.rate

    assert [round(rate(zeta), 6) for zeta in (1.4755, 1.5, 1.53979)] == [round(2 / 3, 6)] * 3
    assert rate(1.4754) > 0.67 > 2 / 3 > 0.61 > rate(1.5398)
    assert rate(1.63) == rate(1.65) == 0.5
    assert any("2.53 = 1.2 (J_all + 1.63)" in note for table in chapter("chapter3").tables for note in table.notes)


def test_the_camera_of_chapter_6_is_asked_when_it_pays() -> None:
    """Figure 6.7: the steps of the queries, each worth more than its price; and the largest input of the notes."""
    table = chapter("chapter6").tables[1]
    assert [row.setting["k"] for row in table.rows] == [*range(5, 50, 5), 51, 58]
    assert all(row.computed["h"].value > 0.004 for row in table.rows)
    assert any(note.startswith("|u| reaches 36 ") for note in chapter("chapter6").tables[0].notes)


@pytest.mark.parametrize("name", ["remote-double-integrator", "rover"])
def test_both_cases_of_one_realisation_have_the_same_noise(name: str) -> None:
    """Figures 3.6 and 6.6: the disturbances are the same, step by step."""
    problem = taciturn.load(name)
    plant: Any = problem.plant
    noises: list[np.ndarray] = []
    for case in (problem, problem.changed({"theta": 0.0, "zeta": 0.0})):
        path = taciturn.simulate(case.close(case.design()), 40, seed=4)
        noises.append(path.state[1:] - path.state[:-1] @ plant.A.T - path.input[:-1] @ plant.B.T)
    np.testing.assert_allclose(noises[0], noises[1], rtol=0, atol=1e-12)
    assert np.abs(noises[0]).max() > 0


@pytest.mark.evidence
def test_tracking_without_a_price_is_silent_until_the_first_measurement_that_tells() -> None:
    """R_t at λ = 0: two steps that cannot know of any deviation, and a third of a step of lost measurements."""
    rows = [row for table in chapter("chapter7").tables for row in table.rows]
    (row,) = (row for row in rows if dict(row.setting) == {"λ": 0.0})
    rate = row.computed["R_t"]
    assert abs(rate.value - (1 - (2 + 1 / 3) / 250)) <= 4 * rate.standard_error


def test_the_reference_is_two_tangent_circles() -> None:
    """Of 1 m radius around (±1, 0), met at the origin, once around, at one speed."""
    states = two_circles().states
    circles = np.minimum(*(np.abs(np.hypot(states[:, 0] - centre, states[:, 1]) - 1) for centre in (-1, 1)))
    assert circles.max() < 1e-12
    np.testing.assert_allclose(states[[0, 125, 250]], 0.0, atol=1e-12)
    steps = np.linalg.norm(np.diff(states, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
    assert (states[:, 0].min(), states[:, 0].max()) == pytest.approx((-2, 2), abs=1e-3)


def test_the_course_of_all_time_control_is_its_exact_transient() -> None:
    """E[x'Qx + û'Rû] by propagating the moments of state and predicted estimate, at every step."""
    start = {"plant.initial.mean": [3.0, -1.0], "theta": 0.0, "zeta": 0.0}
    problem = taciturn.load("remote-double-integrator").changed(start)
    found = course(problem.close(problem.design()), 40, paths=20_000, seed=3)
    p, cost = problem.plant, problem.cost
    K = solve_discrete_are(p.A, p.B, cost.Q, cost.R)
    L = -np.linalg.solve(cost.R + p.B.T @ K @ p.B, p.B.T @ K @ p.A)
    Sigma = solve_discrete_are(p.A.T, p.C.T, p.W, p.V)
    G = p.A @ Sigma @ p.C.T @ np.linalg.inv(p.C @ Sigma @ p.C.T + p.V)
    F = np.block([[p.A, p.B @ L], [G @ p.C, p.A + p.B @ L - G @ p.C]])
    noise = np.block([[p.W, np.zeros((2, 2))], [np.zeros((2, 2)), G @ p.V @ G.T]])
    z = np.concatenate([p.mean, p.mean])
    moment, exact = np.outer(z, z), []
    for _ in range(40):
        exact.append(np.sum(cost.Q * moment[:2, :2]) + np.sum(L.T @ cost.R @ L * moment[2:, 2:]))
        moment = F @ moment @ F.T + noise
    assert (np.abs(found.cost - exact) <= 4 * found.standard_error + 1e-9).all()
    assert (found.standard_error[5:] > 0).all()
    assert found.time[-1] == pytest.approx(3.9)
    assert all((found.sends[link] == 1).all() for link in ("actuator", "sensor"))


def test_the_course_of_a_mission_sums_to_its_cost() -> None:
    """The final state's included; the sends average to the rates, the queries are the schedule's; no step follows."""
    problem = taciturn.load("rover")
    policy = problem.design()
    dear = taciturn.Cost(problem.cost.Q, problem.cost.R, horizon=60, terminal=[[20_000.0]])
    loop = taciturn.close(problem.plant, policy, cost=dear)
    whole = taciturn.average(loop, seed=1, steps=60 * 40_000)
    found = course(loop, 60, paths=20_000, seed=2)
    assert found.final is not None
    error = float(found.standard_error.sum()) + found.final.standard_error  # at most: the steps are correlated
    assert abs(found.cost.sum() + found.final.value - whole.cost.value) <= 3 * error + 4 * whole.cost.standard_error
    assert 10 * error < found.final.value < whole.cost.value
    assert policy.schedule is not None
    assert (found.sends["sensor"] == policy.schedule.queries).all()
    assert found.sends["actuator"].mean() == pytest.approx(whole.rates["actuator"].value, abs=5e-4)
    assert course(loop, 59, paths=2).final is None
    for run in (course, taciturn.simulate):
        with pytest.raises(taciturn.ProblemError, match=r"steps is 61, but the horizon is 60; .*at most 60"):
            run(loop, 61)


def test_the_course_of_a_discount_carries_its_weights() -> None:
    """Sending everything, it sums to the discounted cost; a send counts as one, however late."""
    plant = taciturn.Plant([[1.1]], [[1.0]], [[0.1]], [[1.0]], [[0.2]], mean=[2.0])
    cost = taciturn.Cost([[1.0]], [[1.0]], discount=0.8)
    loop = taciturn.close(plant, taciturn.design.remote_lqg(plant, cost, theta=0.0, zeta=0.0))
    found = course(loop, 120, paths=20_000, seed=1)
    error = float(found.standard_error.sum())  # at most: the steps of a path are correlated
    assert abs(found.cost.sum() - loop.policy.cost_all_time) <= 3 * error
    assert error < 0.02 * loop.policy.cost_all_time
    assert (found.sends["actuator"] == 1).all()


def test_the_course_of_a_sampled_plant_settles_at_its_cost_per_second() -> None:
    """Noise between the samples included."""
    plant = taciturn.ContinuousPlant([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.eye(2))
    cost = taciturn.Cost(np.eye(2), [[0.1]])
    policy = taciturn.design.periodic(plant, cost, period=0.5)
    found = course(taciturn.close(plant, policy), 60, paths=20_000, seed=2)
    assert (found.sends["actuator"] == 1).all()
    assert policy.theory.closed_form is not None
    assert (np.abs(found.cost[40:] - policy.theory.closed_form.cost) <= 4.5 * found.standard_error[40:]).all()


def test_a_course_is_what_its_seed_says_and_refuses_nonsense() -> None:
    """The same bits again; other draws from another seed; a clock's sends exactly."""
    problem = taciturn.load("two-mass-lqg")
    clocked = taciturn.Problem(problem.plant, problem.cost, problem.network, "periodic", {"every": 3})
    loop = clocked.close(clocked.design())
    one, again, other = (course(loop, 7, paths=16, seed=seed) for seed in (5, 5, 6))
    assert (one.cost == again.cost).all()
    assert (one.cost[1:] != other.cost[1:]).any()
    assert one.sends["actuator"].tolist() == [1, 0, 0, 1, 0, 0, 1]
    for wrong in ({"steps": 0}, {"paths": 1}, {"seed": -1}):
        with pytest.raises(taciturn.ProblemError, match=f"{next(iter(wrong))} is "):
            course(loop, **{"steps": 7, **wrong})
