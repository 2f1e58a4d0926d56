"""Numbers at the ends of their ranges: an answer, or one sentence."""

from __future__ import annotations

import json
from itertools import product
from typing import TYPE_CHECKING

import pytest
from cli.test_commands import ALL_TIME, PERIODIC, PLANT
from counts import few

if TYPE_CHECKING:
    from conftest import Run, Write

EDGES = {
    "W = 0": PLANT.replace("0.01", "0.0"),
    "A = 0": PLANT.replace("1.2", "0.0"),
    "B = 0": PLANT.replace("1.2", "0.5").replace("B = [[1.0]]", "B = [[0.0]]"),
    "dt tiny": PLANT.replace("dt = 1.0", "dt = 1e-300"),
    "W huge": PLANT.replace("0.01", "1e100"),
    "W tiny": PLANT.replace("0.01", "1e-100"),
}
EVALUATED = {"lqg": '[policy]\nkind = "lqg"\ntheta = 0.5', "all": ALL_TIME, "two": PERIODIC}


@pytest.mark.parametrize("of", few(product(EVALUATED, EDGES), 3), ids=" ".join)
def test_the_edges_of_what_is_legal_give_numbers(run: Run, write: Write, of: tuple[str, str]) -> None:
    """Finite costs within the guarantee, and lines that fit a screen."""
    policy, plant = EVALUATED[of[0]], EDGES[of[1]]
    path = write(plant=plant, policy=policy)
    document = json.loads(run("evaluate", path, "--json", "--steps", "20000").out, parse_constant=pytest.fail)
    if document["cost_bound"] is not None:
        assert document["cost"]["value"] <= document["cost_bound"]
    shown = run("evaluate", path, "--steps", "20000")
    assert (shown.code, shown.err) == (0, "")
    assert max(map(len, shown.out.splitlines())) <= 80


ENDS = ("1e300", "1e160", "-1e300", "99999999999999999999999999", "1e-300", "5e-324", "1e-160")


@pytest.mark.parametrize("of", few(product("ABWVQR", ENDS), 14) + few(product(["mean", "dt"], ENDS), 4), ids=" ".join)
def test_numbers_at_the_ends_of_the_range_are_answered_or_refused(run: Run, write: Write, of: tuple[str, str]) -> None:
    """Never a traceback, a NaN or a warning: a number, or one sentence."""
    key, value = of
    data = {
        "A": "1.2",
        "B": "1.0",
        "W": "0.01",
        "V": "0.1",
        "Q": "1.0",
        "R": "2.0",
        "mean": "0.0",
        "dt": "1.0",
        key: value,
    }
    plant = "[plant]\n" + "\n".join(f"{name} = [[{data[name]}]]" for name in "ABWV") + f"\ndt = {data['dt']}\n"
    plant += f"C = [[1.0]]\n[plant.initial]\nmean = [{data['mean']}]\n"
    cost = f"[cost]\nQ = [[{data['Q']}]]\nR = [[{data['R']}]]\n"
    answer = run("evaluate", write(plant=plant, cost=cost), "--json", "--steps", "2000")
    assert answer.err.count("\n") == (answer.code == 2)
    if answer.out:
        json.loads(answer.out, parse_constant=pytest.fail)


SAMPLED = ('"lqg"\ntheta = 0.1', '"periodic"', '"periodic"\nactuation = "model"', '"all-time"')


@pytest.mark.parametrize("of", few(product(SAMPLED, ["1e-12", "1e-300", "1e3", "1e300", "1e-3"]), 8), ids=" ".join)
def test_periods_at_the_ends_of_the_range_are_answered_or_refused(run: Run, write: Write, of: tuple[str, str]) -> None:
    """Sampling a billionth of a second or an age apart."""
    policy, period = of
    plant = "[plant]\nA = [[0, 1], [0, 0]]\nB = [[0], [1]]\nW = [[0, 0], [0, 2.5]]\n"
    cost = "[cost]\nQ = [[1, 0], [0, 1]]\nR = [[1]]\n"
    path = write(plant=plant, cost=cost, policy=f"[policy]\nkind = {policy}\nperiod = {period}\n")
    answer = run("evaluate", path, "--json", "--steps", "2000")
    assert answer.err.count("\n") == (answer.code == 2)
    if answer.out:
        json.loads(answer.out, parse_constant=pytest.fail)
