"""The tables of the page on comparisons are what the library computes."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import taciturn

ROOT = Path(__file__).parents[2]
TABLES: list[dict[str, Any]] = json.loads((ROOT / "docs" / "comparison.json").read_text(encoding="utf-8"))


def name_of(table: dict[str, Any]) -> str:
    """Return plant and share."""
    return f"{table['plant']} {table['share']:.0%}"


def test_there_is_a_table_for_each_plant_and_rate() -> None:
    """Three plants, three rates; ranked; every policy is in it or says why it is not."""
    script = runpy.run_path(str(ROOT / "benchmarks" / "comparison.py"))
    assert [(t["plant"], t["share"]) for t in TABLES] == [(p, s) for p in script["PLANTS"] for s in script["SHARES"]]
    for table in TABLES:
        above = [place["above_best"]["value"] for place in table["ranking"]]
        assert above == sorted(above)
        assert above[0] == 0
        told = {place["name"] for place in table["ranking"]} | set(table["left_out"])
        assert told >= set(script["POLICIES"]) - {"consistent"}
        for place in table["ranking"]:
            bound, cost = place["cost_bound"], place["cost"]
            assert bound is None or cost["value"] - 5 * cost["standard_error"] <= bound * (1 + 1e-9), place["name"]


@pytest.mark.evidence
@pytest.mark.parametrize("table", [t for t in TABLES if t["share"] == 0.5], ids=name_of)
def test_the_costs_of_a_table_are_found_again(table: dict[str, Any]) -> None:
    """Evaluated anew at the parameters that the table names, with another seed."""
    script = runpy.run_path(str(ROOT / "benchmarks" / "comparison.py"))
    base = taciturn.load(table["plant"])
    for place in table["ranking"]:
        parameter, policy = place["parameter"], script["POLICIES"][place["name"]]
        problem = script["problem_with"](base, policy)
        sides = [(parameter["value"], parameter["share"]), (parameter["beyond"], 1 - parameter["share"])]
        value = variance = 0.0
        for at, share in sides:
            if at is None:
                continue
            changed = problem.changed({parameter["name"]: at})
            found = taciturn.evaluate(changed, seed=99, standard_error=2e-3 * table["cost_all_time"]).cost
            value += share * found.value
            variance += (share * found.standard_error) ** 2
        # the parameter is known to its standard error, and the cost above every sample grows about as it does
        excess = max(value - table["cost_all_time"], 0.0)
        shifted = excess * (parameter["standard_error"] or 0.0) / (parameter["value"] or np.inf)
        error = np.sqrt(variance + place["cost"]["standard_error"] ** 2 + shifted**2)
        # what the rate misses the budget by, three standard errors at most, was corrected
        assert abs(value - place["cost"]["value"]) <= 8 * error + 1e-6 * value, place["name"]
