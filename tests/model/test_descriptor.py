"""Descriptor plants E x⁺ = A x + B u + w: an ordinary plant with the doubles nearest to E⁻¹A, E⁻¹B and E⁻¹WE'⁻¹."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn import law
from hypothesis import strategies as st

from taciturn import ContinuousPlant, Cost, Jumps, Plant, ProblemError, design, load
from taciturn._arrays import Array
from taciturn.model.disturbance import follow
from taciturn.model.plant import explicit
from taciturn.model.signals import Exosystem, ExternalDisturbance

FILE = """
[plant]
E = [[2.0, 0.0], [0.5, 0.25]]
A = [[1.8, 0.4], [0.0, 0.2]]
B = [[0.0], [0.5]]
C = [[1.0, 0.0]]
W = [[0.04, 0.0], [0.0, 0.01]]
V = [[0.1]]
dt = 1.0
[[disturbance]]
enters = [0.0, 0.5]
wander = 0.001
[cost]
Q = [[1.0, 0.0], [0.0, 1.0]]
R = [[0.0]]
[policy]
kind = "excess"
theta = 0.3
"""


def exactly(rows: Array) -> list[list[Fraction]]:
    """Return the fractions that doubles are."""
    return [[Fraction(value) for value in row] for row in rows.tolist()]


def divided(E: list[list[Fraction]], right: list[list[Fraction]]) -> list[list[Fraction]]:
    """Return E⁻¹ times a matrix by elimination in fractions."""
    rows = [[*left, *more] for left, more in zip(E, right, strict=True)]
    for k in range(len(rows)):
        place = next(i for i in range(k, len(rows)) if rows[i][k])
        rows[k], rows[place] = rows[place], rows[k]
        rows[k] = [value / rows[k][k] for value in rows[k]]
        for i, row in enumerate(rows):
            if i != k and row[k]:
                rows[i] = [value - row[k] * below for value, below in zip(row, rows[k], strict=True)]
    return [row[len(E) :] for row in rows]


def turned(rows: list[list[Fraction]]) -> list[list[Fraction]]:
    """Return the transpose."""
    return [list(column) for column in zip(*rows, strict=True)]


def nearest(rows: list[list[Fraction]]) -> list[list[float]]:
    """Return the nearest doubles."""
    return [[float(value) for value in row] for row in rows]


def test_masses_are_divided_by() -> None:
    """Newton's law M dv/dt = −d v + F + w: a force of covariance W on a mass of 4 kg has W/16 of its acceleration."""
    plant = ContinuousPlant(E=np.diag([1.0, 4.0]), A=[[0, 1], [0, -2]], B=[[0], [1]], W=np.diag([0, 0.16]), C=[[1, 0]])
    assert plant.A.tolist() == [[0, 1], [0, -0.5]]
    assert plant.B.tolist() == [[0], [0.25]]
    assert plant.W.tolist() == [[0, 0], [0, 0.16 / 16]]
    assert plant.C.tolist() == [[1, 0]]


@law(10, 300, seed=st.integers(0, 2**32 - 1))
def test_every_entry_is_the_nearest_double(seed: int) -> None:
    """Whatever orders of magnitude, and also where E is singular but for its last digit."""
    draws = np.random.default_rng(seed)
    n, m = int(draws.integers(1, 6)), int(draws.integers(1, 3))
    E = draws.normal(size=(n, n)) * 10.0 ** draws.uniform(-20, 20, (n, n))
    if n > 1 and draws.random() < 0.5:
        E[-1] = E[0]
        E[-1, -1] = np.nextafter(E[-1, -1], np.inf)
    A, B = -E.copy() / 2, draws.normal(size=(n, m))
    A[0] += draws.normal(size=n)
    G = draws.normal(size=(n, n))
    W = G @ G.T + np.eye(n)
    W = (W + W.T) / 2
    inverse, free, moved = explicit(E, A, B)
    left = exactly(E)
    assert free.tolist() == nearest(divided(left, exactly(A)))
    assert moved.tolist() == nearest(divided(left, exactly(B)))
    assert inverse.covariance("W", W).tolist() == nearest(divided(left, turned(divided(left, exactly(W)))))


def test_zeros_stay_zeros() -> None:
    """A register and a state that nothing moves are still seen in the matrices, if E mixes the equations."""
    A, B = np.array([[1.1, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    E = np.array([[0.1, 0.3], [0.7, -0.9]])
    W = np.array([[0.2, 0.0], [0.0, 0.0]])
    found = Plant(A, B, E @ W @ E.T, E=E)  # the products are rounded, W only nearly of low rank
    assert np.abs(found.W - np.linalg.inv(E) @ E @ W @ E.T @ np.linalg.inv(E).T).max() < 1e-14
    whole = np.array([[1.0, 3.0], [7.0, -9.0]])
    plain = Plant(whole @ np.round(A), whole @ B, whole @ W @ whole.T, E=whole)
    assert plain.A.tolist() == np.round(A).tolist()
    assert plain.B.tolist() == B.tolist()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"E": [[1, 2], [2, 4]]}, "E is singular: its rank is 1 for 2 states, so some equations are algebraic"),
        ({"E": [[0.1, 0.2], [0.3, 0.6]]}, "E is singular"),
        ({"E": np.zeros((2, 2))}, "E is singular: its rank is 0 for 2 states"),
        ({"E": [[1.0]]}, r"E has shape \(1, 1\); expected the shape \(2, 2\) = \(states, states\)"),
        ({"E": [[1, np.nan], [0, 1]]}, "E contains the number nan"),
        ({"E": np.diag([1e-200, 1])}, "E⁻¹A contains .* expected an array of numbers with finite squares"),
        ({"W": np.diag([1, -1])}, "W has the eigenvalue -1"),
        (
            {"function": lambda x, u, w: x},
            "E is given together with a function, which returns the next state; expected no E",
        ),
    ],
)
def test_what_is_no_plant_is_refused(change: dict[str, Any], words: str) -> None:
    """A singular E exactly, without a tolerance, and each other mistake by its name."""
    given: dict[str, Any] = {"E": np.eye(2), "A": np.eye(2) / 2, "B": np.eye(2), "W": np.eye(2)}
    with pytest.raises(ProblemError, match=words):
        Plant(**given | change)


def test_a_nearly_singular_matrix_is_none() -> None:
    """One digit decides: [[1, 1], [1, 1 + 2⁻⁵²]] has the inverse 2⁵²·[[1 + 2⁻⁵², −1], [−1, 1]]."""
    E = [[1.0, 1.0], [1.0, 1.0 + 2.0**-52]]
    plant = ContinuousPlant(E=E, A=-np.eye(2), B=np.eye(2), W=np.zeros((2, 2)))
    assert plant.B.tolist() == [[2.0**52 + 1, -(2.0**52)], [-(2.0**52), 2.0**52]]


def test_a_matrix_that_is_hardly_regular_hides_the_noise_of_slow_states() -> None:
    """A mode of −5e11 per second: the message names it, and not the noise of the file."""
    E = np.eye(4)
    E[2:, 2:] = [[0.1, 0.3], [0.2, 0.6000000001]]
    A = [[0, 0, 1, 0], [0, 0, 0, 1], [-900, 880, -6, 2], [880, -930, 2, -3]]
    plant = ContinuousPlant(A, [[0], [0], [1], [0.1]], np.diag([0.0, 0, 4, 2]), E=E)
    with pytest.raises(ProblemError, match="an E that is less close to singular"):
        design.all_time(plant, Cost(np.eye(4), [[1e-3]]), period=1e-3)


def test_jumps_and_disturbances_act_on_the_equation() -> None:
    """As the noise does; jumps that are not normal would have another distribution, and are refused."""
    E, given = np.diag([2.0, 4.0]), {"A": -np.eye(2), "B": np.eye(2)}
    assert ContinuousPlant(**given, jumps=Jumps(1.0, np.eye(2)), E=E).W.tolist() == [[0.25, 0], [0, 0.0625]]
    with pytest.raises(ProblemError, match=r"jumps\.distribution is 'uniform', but E is given"):
        ContinuousPlant(**given, jumps=Jumps(1.0, np.eye(2), "uniform"), E=E)
    plain = follow(Plant(np.eye(2) / 2, np.eye(2), np.eye(2), np.eye(2), np.eye(2)), disturbances=[
        ExternalDisturbance([1.0, 1.0], 0.1)
    ])  # fmt: skip
    exosystem = plain.exosystem
    assert isinstance(exosystem, Exosystem)
    moved = Plant(E / 2, E, E @ E, np.eye(2), np.eye(2), exosystem=exosystem, E=E)
    assert moved.exosystem is not None
    assert moved.exosystem.E.tolist() == [[0.5], [0.25]]
    assert moved.same_as(plain)


def test_a_file_states_the_same_plant(tmp_path: Path) -> None:
    """Its disturbance and its policy are those of the file without E; the key is changed like others."""
    (tmp_path / "e.toml").write_text(FILE, encoding="utf-8")
    found = load(tmp_path / "e.toml")
    plain = FILE.replace("E = [[2.0, 0.0], [0.5, 0.25]]\n", "")
    for before, after in (
        ("A = [[1.8, 0.4], [0.0, 0.2]]", "A = [[0.9, 0.2], [-1.8, 0.4]]"),
        ("B = [[0.0], [0.5]]", "B = [[0.0], [2.0]]"),
        ("W = [[0.04, 0.0], [0.0, 0.01]]", "W = [[0.01, -0.02], [-0.02, 0.2]]"),
        ("enters = [0.0, 0.5]", "enters = [0.0, 2.0]"),
    ):
        plain = plain.replace(before, after)
    (tmp_path / "plain.toml").write_text(plain, encoding="utf-8")
    other = load(tmp_path / "plain.toml")
    for name in "ABCWV":
        assert getattr(found.plant, name) == pytest.approx(getattr(other.plant, name), rel=1e-15)
    assert found.plant.exosystem is not None
    assert found.plant.exosystem.E.tolist() == [[0.0], [2.0]]
    assert found.design().cost_all_time == pytest.approx(other.design().cost_all_time, rel=1e-12)
    halved = found.changed({"plant.E": [[1.0, 0.0], [0.25, 0.125]]})
    assert pytest.approx(2 * found.plant.A) == halved.plant.A


def test_free_inputs_of_a_descriptor_plant_cost_what_they_should() -> None:
    """E = 4, A = 8, B = 2, W = 16: x⁺ = 2x + u/2 + w with Var w = 1; with R = 0 each step costs Q·Var w = 3."""
    policy = design.all_time(Plant(E=[[4.0]], A=[[8.0]], B=[[2.0]], W=[[16.0]]), Cost([[3.0]], [[0.0]]))
    assert policy.cost_all_time == pytest.approx(3.0, rel=1e-12)
