"""Bundle the page's scripts into one script, because a saved page or a notebook cell cannot load modules.

The scripts are ES modules that import names from each other at their beginning, and export declarations by name. Each
module becomes a function that returns its exports, in an order in which a module follows those that it imports.
"""

from __future__ import annotations

import re
from importlib.resources import files

FOLDER = files("taciturn_explore") / "web"
IMPORT = re.compile(r'^import \{ ([^}]*) \} from "\./([\w-]+)\.js";\n', re.MULTILINE)
EXPORT = re.compile(r"^export (?:async )?(?:function\*?|const|let|class) ([\w$]+)", re.MULTILINE)


def read(name: str) -> str:
    """Read a text file that belongs to the page."""
    return (FOLDER / name).read_text(encoding="utf-8")


def bundle(entry: str) -> str:
    """Join a module and the modules that it imports to one script, whose variable ``entry`` holds its exports."""
    order = list[str]()

    def visit(name: str) -> None:
        if name in order:
            return
        for _, other in IMPORT.findall(read(f"{name}.js")):
            visit(other)
        order.append(name)

    visit(entry)
    return "".join(map(_as_function, order))


def _as_function(name: str) -> str:
    text = read(f"{name}.js")
    exports = ", ".join(EXPORT.findall(text))
    text = IMPORT.sub(lambda found: f"const {{ {found[1]} }} = {variable(found[2])};\n", text)
    body = EXPORT.sub(lambda found: found[0].removeprefix("export "), text)
    return f"const {variable(name)} = (() => {{\n{body}\nreturn {{ {exports} }};\n}})();\n"


def variable(name: str) -> str:
    """Return the name of the JavaScript variable that holds a module in the bundle."""
    return f"{name.replace('-', '_')}_module"


def styles(root: str = ":root") -> str:
    """Join the page's style sheets to one; the CSS selector ``root`` selects the element that defines the colours."""
    theme = (files("taciturn_web") / "assets" / "theme.css").read_text(encoding="utf-8")
    return (theme + read("explore.css")).replace(":root", root)
