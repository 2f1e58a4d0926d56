"""The tables of the policy kinds from their records, and of the built-in problems from their files; needs no Sphinx."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from inspect import Parameter

from taciturn import problem
from taciturn.analyse import switched
from taciturn.design.catalogue import CATALOGUE, own_kinds
from taciturn.design.kind import Kind
from taciturn.design.several_nodes import MOST_LINKS as MOST_SETS
from taciturn.lqg import lossy
from taciturn.model import cost, link, signals
from taciturn.problem import matlab_and_numpy as matrices
from taciturn.problem import read
from taciturn.renewal.chain import MOST_STATES
from taciturn.simulation import sampling
from taciturn_limits.fitted import DIRECTIONS

COSTS = {"average": "average", "horizon": "`horizon`", "discount": "`discount`"}
PLANTS = {"outputs": "outputs with noise", "jumps": "Poisson jumps"}
FOLLOWS = {("constant", "changing"): "yes", ("constant",): "constant ones", ("changing",): "yes", (): "no"}


def kind_table(name: str) -> str:
    """Return a table in Markdown, by its name in ``TABLES``."""
    return TABLES[name]([CATALOGUE[kind] for kind in own_kinds()])


def problem_table() -> str:
    """Return the built-in problems with what their files say of themselves, and their kinds."""
    rows: list[tuple[str, str, str]] = []
    for path in sorted(
        (one for folder in problem.problem_folders() for one in folder.glob("*.toml")), key=lambda one: one.stem
    ):
        comment = re.match(r"(#.*\n)*", path.read_text(encoding="utf-8"))
        said = " ".join(line.strip("# ") for line in (comment[0] if comment else "").splitlines())
        rows.append((f"`{path.stem}`", re.split(r"[:.] ", said)[0].rstrip("."), f"`{problem.load(path.stem).kind}`"))
    return markdown_table(("name", "problem", "kind"), rows)


def parameters(kinds: Sequence[Kind]) -> str:
    """Return the parameters of each kind with their defaults and their descriptions."""
    rows = [
        (f"`{kind.name}`" * (not index), f"`{name}`", _default(one), kind.notes[name].removesuffix("; or"))
        for kind in kinds
        for index, (name, one) in enumerate(kind.parameters.items())
    ]
    return markdown_table(("`kind`", "parameter", "default", "description"), rows)


def problems(kinds: Sequence[Kind]) -> str:
    """Return the plants, costs, links and set-points that the kinds support; kinds that agree share a row."""
    return _grouped(
        ("`kind`", "plant", "`[cost]`", "losses", "trajectory", "set-points", "also refused"),
        kinds,
        lambda kind: (
            plants(kind),
            ", ".join(COSTS[word] for word in kind.costs),
            "yes" if kind.takes_losses else "no",
            "yes" if "reference" in kind.arguments else "no",
            _set_points(kind),
            kind.refused,
        ),
    )


def reference(kinds: Sequence[Kind]) -> str:
    """Return goal, sources, nodes, tuning and proved result of each kind; first those that ``taciturn new`` offers."""
    ordered = sorted(kinds, key=lambda kind: (kind.offered is None, kind.offered or 0, kind.name))
    rows = [
        (
            f"`{kind.name}`",
            f"{kind.goal} {', '.join(f'[{key}]' for key in kind.sources)}",
            kind.nodes,
            " or ".join(f"`{one.name}`" for one in kind.tuning) or "—",
            kind.proved + f"; relative to {kind.relative_to}" * (kind.relative_to != "—"),
        )
        for kind in ordered
    ]
    return markdown_table(("kind", "goal", "nodes", "tuned by", "proved result"), rows)


def steps(kinds: Sequence[Kind]) -> str:
    """Return the nodes, the data and the order of the operations of the kinds; kinds that agree share a row."""
    heading = ("kind", "nodes", "data beyond the matrices", "order of operations within a step")
    return _grouped(heading, kinds, lambda kind: (kind.nodes, kind.data, kind.order))


def limits(kinds: Sequence[Kind]) -> str:
    """Return the kinds with each limit."""
    told: dict[str, Callable[[Kind], bool]] = {
        "no proved bound on the cost": lambda kind: kind.proved.startswith("no guarantee"),
        "an exact measurement of the full state": lambda kind: "outputs" not in kind.plants,
        "a continuous plant": lambda kind: "discrete" not in kind.plants,
        "a discrete plant": lambda kind: "continuous" not in kind.plants,
        "no Poisson jumps": lambda kind: "jumps" not in kind.plants,
        "an average cost": lambda kind: kind.costs == ("average",),
        "no set-points and no disturbances of known shape": lambda kind: _set_points(kind) == "no",
        "no disturbances of known shape": lambda kind: kind.follows == ("changing",),
        "constant set-points": lambda kind: kind.follows == ("constant",),
        "links that deliver every packet, in the design": lambda kind: not kind.takes_losses,
        "one sensor and one actuator": lambda kind: not (kind.several_nodes or kind.joint_links),
        "one sensor": lambda kind: kind.joint_links and not kind.several_nodes,
    }
    rows = [(limit, ", ".join(f"`{kind.name}`" for kind in kinds if has(kind))) for limit, has in told.items()]
    return markdown_table(("limit", "kinds"), [row for row in rows if row[1]])


def sizes(_: Sequence[Kind]) -> str:
    """Return the largest sizes that the library computes with."""
    fourth = int((switched.MOST_MOMENTS / 2) ** 0.25)
    rows = {
        "steps of a finite horizon (`cost.horizon`)": cost.LONGEST,
        "sampling steps of a timetable of set-points": signals.LONGEST,
        "steps between two sends (`max_interval`)": link.LONGEST,
        "directions of the error for `optimal`, and for costs without simulation by quadrature": MOST_STATES,
        "directions of the error for `near-optimal`": DIRECTIONS,
        "actuator links whose sets `distributed` compares (`joint`)": MOST_SETS,
        "links that drop packets and nodes that miss samples, for the exact cost of every sample": switched.MOST_LAWS,
        "modes that do not decay, for critical losses": lossy.MOST_MODES,
        "states of a loop over one link with losses, for its fourth moments (else a statistical test)": fourth,
        "simulated steps of an evaluation": sampling.MOST_OPERATIONS,
        "bytes of a problem file, or of a file of set-points": problem.LARGEST,
        "bytes of a Python file with the function of a plant": read.LARGEST_CODE,
        "bytes of all variables of a matrix file": matrices.LARGEST,
    }
    return markdown_table(("size", "at most"), [(what, f"{most:,}") for what, most in rows.items()])


def plants(kind: Kind) -> str:
    """Return the plants that a kind supports in words."""
    times = [word for word in ("discrete", "continuous") if word in kind.plants]
    measured = "" if "outputs" in kind.plants else "state measured"
    return "; ".join(
        filter(None, (" or ".join(times), measured, *(PLANTS[one] for one in PLANTS if one in kind.plants)))
    )


def _set_points(kind: Kind) -> str:
    """Return which set-points a kind follows."""
    return FOLLOWS[kind.follows]


def _grouped(heading: Sequence[str], kinds: Iterable[Kind], told: Callable[[Kind], tuple[str, ...]]) -> str:
    groups: dict[tuple[str, ...], list[str]] = {}
    for kind in kinds:
        groups.setdefault(told(kind), []).append(f"`{kind.name}`")
    rows = [(", ".join(names), *row) for row, names in groups.items()]
    return markdown_table(heading, rows)


def markdown_table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [heading, ["---"] * len(heading), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def _default(one: Parameter) -> str:
    if one.default is one.empty:
        return "required"
    return "—" if one.default is None else "`{}`".format(repr(one.default).replace("'", '"'))


TABLES = {
    "parameters": parameters, "problems": problems, "reference": reference, "steps": steps, "limits": limits,
    "sizes": sizes,
}  # fmt: skip
