"""The figure of the page *Architecture*: the parts of the library on their layers, and what each imports."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

import taciturn


def layers_of(page: Path) -> dict[str, int]:
    """Return the layer of each part, from the table of the page."""
    rows = re.findall(r"^\| (\d+) \| (.*?) \|", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {part: int(number) for number, parts in rows for part in re.findall(r"`(\w+)/?`", parts)}


def imports_of(layer: dict[str, int]) -> dict[str, set[str]]:
    """Return the parts above the lowest layer that each part imports."""
    uses: dict[str, set[str]] = {part: set() for part in layer}
    home = Path(taciturn.__file__).parent
    for path in home.rglob("*.py"):
        part = path.relative_to(home).with_suffix("").parts[0]
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            whole = isinstance(node, ast.ImportFrom) and node.module == "taciturn"
            module = node.module or "" if isinstance(node, ast.ImportFrom) else ""
            named = [alias.name for alias in node.names] if isinstance(node, ast.ImportFrom) and whole else []
            found = named or re.findall(r"^taciturn\.(\w+)", module)
            if part in layer:
                uses[part].update(other for other in found if layer.get(other, 0) and other != part)
    return uses


def draw(page: Path) -> Figure:
    """Return the figure; an arrow points to what a part imports, unless other arrows lead there."""
    layer = layers_of(page)
    uses = imports_of(layer)

    def reached(part: str) -> set[str]:
        return uses[part].union(*map(reached, uses[part]))

    figure, axis = plt.subplots(figsize=(8, 7.5))
    look: dict[str, Any] = {"ha": "center", "va": "center", "family": "monospace"}
    look["bbox"] = {"boxstyle": "round,pad=0.5", "facecolor": "white", "edgecolor": "C0"}
    boxes: dict[str, Any] = {}
    for height in sorted(set(layer.values()) - {0}):
        row = [part for part in layer if layer[part] == height]
        boxes |= {part: axis.text((k + 0.5) / len(row), height, part, **look) for k, part in enumerate(row)}
    for part, others in uses.items():
        for other in others - set().union(*map(reached, others)):
            ends = {"patchA": boxes[part].get_bbox_patch(), "patchB": boxes[other].get_bbox_patch()}
            style = {"arrowstyle": "-|>", "color": "0.5", "connectionstyle": "arc3,rad=-0.1", **ends}
            axis.annotate("", boxes[other].get_position(), boxes[part].get_position(), arrowprops=style, zorder=1)
    ground = [part for part in layer if not layer[part]]
    middle = len(ground) // 2
    axis.text(0.5, 0, "  ".join(ground[:middle]) + "\n" + "  ".join(ground[middle:]), fontsize="small", **look)
    axis.set(xlim=(0, 1), ylim=(-0.5, 10.5), xticks=[], yticks=range(11), ylabel="layer")
    axis.spines[:].set_visible(False)
    figure.tight_layout()
    return figure
