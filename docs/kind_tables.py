"""The tables of the policy kinds, from the records of the kinds; needs no Sphinx."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from inspect import Parameter

from taciturn.design.catalogue import CATALOGUE, own_kinds
from taciturn.design.kind import Kind

COSTS = {"average": "average", "horizon": "`horizon`", "discount": "`discount`"}
PLANTS = {"outputs": "outputs with noise", "jumps": "Poisson jumps"}


def kind_table(name: str) -> str:
    """Return a table in Markdown: ``parameters``, ``problems``, ``nodes``, ``goals`` or ``steps``."""
    return TABLES[name]([CATALOGUE[kind] for kind in own_kinds()])


def parameters(kinds: Sequence[Kind]) -> str:
    """Return the parameters of each kind with their defaults and their descriptions."""
    rows = [
        (f"`{kind.name}`" * (not index), f"`{name}`", _default(one), kind.notes[name].removesuffix("; or"))
        for kind in kinds
        for index, (name, one) in enumerate(kind.parameters.items())
    ]
    return _table(("`kind`", "parameter", "default", "description"), rows)


def problems(kinds: Sequence[Kind]) -> str:
    """Return the plants, costs, links and references that the kinds support; kinds that agree share a row."""
    return _grouped(
        ("`kind`", "plant", "`[cost]`", "`[network]`", "`[reference]`", "also refused"),
        kinds,
        lambda kind: (
            plants(kind),
            ", ".join(COSTS[word] for word in kind.costs),
            "yes" if _drops(kind) else "no",
            "yes" if "reference" in kind.arguments else "no",
            kind.refused,
        ),
    )


def nodes(kinds: Sequence[Kind]) -> str:
    """Return the nodes, plants and links of the kinds; kinds that agree share a row."""
    return _grouped(
        ("nodes", "plant", "links", "kinds"),
        kinds,
        lambda kind: (kind.nodes, plants(kind), "drop packets" if _drops(kind) else "ideal"),
        last=True,
    )


def goals(kinds: Sequence[Kind]) -> str:
    """Return the goal and the proved result of each kind; first those that ``taciturn new`` offers."""
    ordered = sorted(kinds, key=lambda kind: (kind.offered is None, kind.offered or 0, kind.name))
    rows = [
        (kind.goal, f"`{kind.name}`", kind.proved, kind.relative_to, ", ".join(f"`{key}`" for key in kind.sources))
        for kind in ordered
    ]
    return _table(("goal", "kind", "proved result", "relative to", "[sources](sources.md)"), rows)


def steps(kinds: Sequence[Kind]) -> str:
    """Return the nodes, the data and the order of the operations of the kinds; kinds that agree share a row."""
    heading = ("kind", "nodes", "data beyond the matrices", "order of operations within a step")
    return _grouped(heading, kinds, lambda kind: (kind.nodes, kind.data, kind.order))


def plants(kind: Kind) -> str:
    """Return the plants that a kind supports in words."""
    times = [word for word in ("discrete", "continuous") if word in kind.plants]
    measured = "" if "outputs" in kind.plants else "state measured"
    return "; ".join(
        filter(None, (" or ".join(times), measured, *(PLANTS[one] for one in PLANTS if one in kind.plants)))
    )


def _drops(kind: Kind) -> bool:
    """Return whether a kind is designed for links that drop or delay packets."""
    return "network" in kind.tables and not kind.ideal_links


def _grouped(
    heading: Sequence[str], kinds: Iterable[Kind], told: Callable[[Kind], tuple[str, ...]], last: bool = False
) -> str:
    groups: dict[tuple[str, ...], list[str]] = {}
    for kind in kinds:
        groups.setdefault(told(kind), []).append(f"`{kind.name}`")
    rows = [(*row, ", ".join(names)) if last else (", ".join(names), *row) for row, names in groups.items()]
    return _table(heading, rows)


def _table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heading, ["---"] * len(heading), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def _default(one: Parameter) -> str:
    if one.default is one.empty:
        return "required"
    return "—" if one.default is None else "`{}`".format(repr(one.default).replace("'", '"'))


TABLES = {"parameters": parameters, "problems": problems, "nodes": nodes, "goals": goals, "steps": steps}
