"""The ways in which a problem is used. All refuse what one of them refuses; ALONE lists exceptions.

A refusal is one sentence, and a command that refuses ends with exit code 2 and prints nothing else. ``evaluate``
refuses a problem at one of three stages. A file that cannot be read, and a policy that cannot be designed, are refused
by every route with the same sentence. The study of a policy that exists may refuse alone: ``ALONE`` tells why.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from everything.commands import run

import taciturn
from taciturn.errors import TaciturnError
from taciturn.nodes.simulated_plant import SimulatedPlant

STEPS_OF_NODES = 5


def is_sentence(text: str) -> bool:
    """Tell whether a refusal is one clause that says what is wrong, without what Python prints of objects."""
    wrong = ("Traceback", "object at 0x", "array(", "np.float64", "nan", "NaN", "\n\n")
    return bool(text.strip()) and "\n" not in text.strip() and not any(one in text for one in wrong)


class CommandError(AssertionError):
    """A command neither answers nor refuses with one sentence and exit code 2."""


def command(*words: str) -> Callable[[Path, int], str | None]:
    """Return the route of a command, whose first words are these and whose file follows."""

    def go(folder: Path, seed: int) -> str | None:
        answer = run(words[0], str(folder / "problem.toml"), *words[1:])
        if answer.code == 0:
            return None
        lines = answer.err.strip().splitlines()
        if answer.code != 2 or len(lines) != 1 or not lines[0].startswith("taciturn: "):
            raise CommandError(f"exit code {answer.code}, and on standard error: {answer.err}")
        if answer.out:
            raise CommandError(f"{answer.out[:300]} and then the refusal {lines[0]}")
        return answer.refusal

    return go


def call(work: Callable[[taciturn.Problem, Path, int], object]) -> Callable[[Path, int], str | None]:
    """Return the route of a function of the package."""

    def go(folder: Path, seed: int) -> str | None:
        try:
            work(taciturn.load(folder / "problem.toml"), folder, seed)
        except TaciturnError as error:
            return str(error)
        return None

    return go


def run_nodes(problem: taciturn.Problem, folder: Path, seed: int) -> None:
    """Run all nodes for a few steps."""
    policy = problem.design()
    nodes = taciturn.Nodes(policy, problem.network, seed % 1000)
    plant, sensed = SimulatedPlant(problem.close(policy), seed), policy.model.sensed
    for _ in range(min(STEPS_OF_NODES, problem.cost.horizon or STEPS_OF_NODES)):
        y = plant.measurement
        u = nodes.step(y[:sensed], reference=y[sensed:]) if policy.model.outputs > sensed else nodes.step(y)
        assert np.isfinite(u).all(), u
        plant.move(tuple(u.ravel()))


ROUTES: dict[str, Callable[[Path, int], str | None]] = {
    "evaluate": command("evaluate", "--steps", "2000", "--confidence", "0"),
    "show": command("show"),
    "show --json": command("show", "--json"),
    "show --wire": command("show", "--wire"),
    "simulate": command("simulate", "--steps", "5", "--json"),
    "nodes": call(run_nodes),
    "export --c": call(lambda problem, folder, seed: taciturn.export_c(problem, folder / "exported")),
    "export --fmu": call(lambda problem, folder, seed: taciturn.export_fmu(problem, folder / "exported.fmu")),
}


ALSO = ("show --wire", "simulate")
"""Routes that each accepted problem takes beside the interpreters that have checks of their own."""


class Alone(NamedTuple):
    """A refusal that some routes do not share.

    Args:
        words: of its sentence.
        routes: that may accept the problem.
        reason: why they do.
    """

    words: str
    routes: tuple[str, ...]
    reason: str


OTHERS = tuple(route for route in ROUTES if route != "evaluate")
ALONE: tuple[Alone, ...] = (
    Alone(" diverges: ", OTHERS, "nodes and paths of the loop exist, and only its averages do not, as a study finds"),
    Alone("in the loop of ", OTHERS, "a function of a loop that diverges gives no number, but later than others run"),
    Alone("the quadrature", ("show", "show --json"), "the gains of an optimal schedule exist without its boundary"),
)


def accepted_alone(sentence: str, route: str) -> str | None:
    """Return why a route may accept what ``evaluate`` refuses with a sentence, or None."""
    return next((one.reason for one in ALONE if one.words in sentence and route in one.routes), None)
