"""Statements of the manual that a change of the code could make false are bound to the code."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import pytest

import taciturn
from taciturn import load
from taciturn.design.catalogue import CATALOGUE, own_kinds

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS))
BURST = {"to_bad": 0.05, "to_good": 0.3, "loss_good": 0.01, "loss_bad": 0.7}


def page(name: str) -> str:
    """Return the text of a page without its line breaks."""
    return " ".join((DOCS / f"{name}.md").read_text(encoding="utf-8").split())


def test_the_kinds_that_other_tools_are_compared_with_are_counted() -> None:
    """All of the catalogue, by what decides when they send."""
    text = page("comparison")
    found = re.search(
        r"has (\d+) kinds: these (\d+), the (\d+) of the next line, and (\d+) time-triggered ones \(([^)]*)\)", text
    )
    assert found is not None
    timed, early = (
        re.findall(r"`([a-z-]+)`", found[5]),
        re.findall(r"`([a-z-]+)`", text.split("| self-triggered, early sends |")[1].split("[^t-kinds]")[0]),
    )
    assert {*timed, *early} <= set(own_kinds())
    events = len(own_kinds()) - len(timed) - len(early)
    assert [int(found[i]) for i in range(1, 5)] == [len(own_kinds()), events, len(early), len(timed)]
    assert f"| event triggers | {events} kinds[^t-kinds] |" in text


def test_the_tables_of_the_kinds_name_all_of_them_and_no_other() -> None:
    """In each table that lists them; a limit is listed only if a kind has it."""
    from kind_tables import TABLES, kind_table

    for name in TABLES:
        text = kind_table(name)
        named = {word for word in re.findall(r"`([a-z-]+)`", text) if word in CATALOGUE}
        if name != "sizes":
            assert named == set(own_kinds()), name
        assert "| |" not in text
    assert "100,000" in kind_table("sizes")


def test_the_tables_of_json_keys_describe_each_key_that_is_printed() -> None:
    """Of the documents of evaluate, also with a given controller and limits, and of certify."""
    from result_tables import meanings

    from taciturn.study.evaluation import Evaluation
    from taciturn_certify.certify import Certificates

    told = meanings(Evaluation)
    assert all(len(text) > 8 for text in [*told.values(), *meanings(Certificates).values()])
    for problem in (load("pid-tank"), load("two-mass").changed({"plant.input_limit": [1.0]})):
        assert set(taciturn.evaluate(problem, steps=4096).document()) <= set(told)
    assert "absent if no input has a limit" in told["without_limits"]


def test_the_table_of_built_in_problems_says_what_each_is() -> None:
    """With its kind; a file without a comment at its head would have an empty cell."""
    from kind_tables import problem_table

    _, _, *rows = problem_table().splitlines()
    cells = [[cell.strip(" `") for cell in row.strip("|").split("|")] for row in rows]
    assert ["pid-tank", "excess"] in [[name, kind] for name, _, kind in cells]
    assert all(len(said.split()) > 4 for _, said, _ in cells)


def test_limits_of_the_kinds_are_stated_only_by_their_records() -> None:
    """The page itself names hardly any kind before the proofs, so that nothing there can be out of date."""
    prose = re.sub(r"```.*?```", "", (DOCS / "limits.md").read_text(encoding="utf-8"), flags=re.DOTALL)
    prose, proofs, _ = prose.partition("## Proofs of errors")
    assert proofs
    assert {word for word in re.findall(r"`([a-z-]+)`", prose) if word in CATALOGUE} == {"lossy-lqg"}


def test_losses_that_are_acknowledged_are_covered_as_the_pages_say() -> None:
    """The bound of excess, with independent losses and with bursts; not without acknowledgement."""
    problem = load("two-mass")
    for changes, bound in (
        ({"network.actuator_loss": 0.2}, 0.7755), ({"network.actuator_burst": BURST}, 0.7764),
    ):  # fmt: skip
        lossy = problem.changed({"network.protocol": "tcp", **changes})
        assert lossy.designed().guarantee.cost == pytest.approx(bound, abs=5e-5)  # type: ignore[union-attr]
        assert lossy.close(lossy.designed()).nominal
    unheard = problem.changed({"network.protocol": "udp", "network.actuator_loss": 0.2})
    assert not unheard.close(unheard.designed()).nominal


def test_the_readme_states_what_the_problem_gives() -> None:
    """Packets and costs of its table, as evaluate gives them, and the packets of the run in its picture."""
    text = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    problem = load("pid-tank").changed({"theta": 0.8})
    found, run = taciturn.evaluate(problem), taciturn.simulate(problem.close(problem.design()), 300, versus="periodic")
    base = found.cost_all_time
    assert base is not None
    assert found.clock is not None
    assert found.cost_bound_at_rate is not None
    assert run.versus is not None
    rate, more = f"{100 * found.rates['actuator'].value:.1f} %", f"+{100 * (found.cost.value / base - 1):.2f} %"
    proven = f"+{100 * (found.cost_bound_at_rate / base - 1):.1f} %"
    assert f"**Taciturn** | **{rate}** | **{more}** (proven: at most {proven})" in text
    assert f"best fixed steps | {rate} | +{100 * (found.clock.cost / base - 1):.1f} %" in text
    assert {int(one.sends["actuator"].sum()) for one in (run, run.versus)} == {64}
    assert "In 300 samples, the controller sends 64 packets to the valve" in text
    assert "taciturn simulate pid-tank --set theta=0.8 --steps 300 --versus periodic" in text.replace("\\ ", "")


def test_a_benchmark_runs_the_command_that_it_names() -> None:
    """The row of the table of starts, and what is measured for it."""
    source = ast.parse((ROOT / "benchmarks" / "start.py").read_text(encoding="utf-8"))
    (command,) = (
        ast.literal_eval(node.value)
        for node in source.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "COMMAND"
    )
    assert f"taciturn {' '.join(command)}" in (DOCS / "start.json").read_text(encoding="utf-8")
    assert f"`{command[1]}`" in page("performance")


def test_an_input_that_is_clipped_is_the_reason_for_no_periodic_control() -> None:
    """The plant of the file is that of the design, so nothing says that they differ."""
    problem = load("two-mass-lqg").changed({"plant.input_limit": [0.3]})
    found = taciturn.evaluate(problem, steps=4096)
    assert found.clock is None
    assert found.no_clock.endswith("and here inputs are clipped (input_limit)")
    assert "differs" not in found.no_clock
