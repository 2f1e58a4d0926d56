"""The manual: every code cell is executed, an error stops the build, nothing is fetched.

A page is executed again if it changes, or anything that it may run: the library, the data and the modules beside it.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
from html import unescape
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from jupyter_cache import get_cache

sys.path.insert(0, str(Path(__file__).parent))  # where this manual's own directives are

if TYPE_CHECKING:
    from sphinx.application import Sphinx

DOCS = Path(__file__).parent


def _digest() -> str:
    """Return a digest of all that the cells of a page may run or read, besides the page."""
    found = hashlib.sha256(sys.version.encode())
    beside = (path for path in DOCS.iterdir() if path.suffix in (".py", ".json", ".c", ".toml"))
    for path in sorted([*(DOCS.parent / "src").rglob("*"), *(DOCS.parent / "examples").glob("*.py"), *beside]):
        if path.is_file() and "__pycache__" not in path.parts:
            found.update(str(path.relative_to(DOCS.parent)).encode() + b"\0" + path.read_bytes() + b"\0")
    return found.hexdigest()[:16]


os.environ["TACITURN_PROGRESS"] = "0"  # no bars below the cells

project = "Taciturn"
author = "The Taciturn authors"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "directives"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "Taciturn"
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["manual.css"]
html_math_renderer = "mathml"  # the browser's own; the usual one loads a script from elsewhere
myst_enable_extensions = ["amsmath", "attrs_inline", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "cache"
nb_execution_cache_path = str(DOCS / "_build" / "executed" / _digest())
get_cache(nb_execution_cache_path).list_cache_records()  # makes its tables, before processes side by side would
nb_execution_raise_on_error = True
nb_execution_in_temp = False  # beside the data that a page shows; none writes a file
nb_execution_timeout = 1200
nb_merge_streams = True
nb_code_prompt_show, nb_code_prompt_hide = "Show the code", "Hide the code"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_type_aliases = {name: name for name in ("Array", "ArrayLike", "Matrix", "Progress", "Term", "Terms")}
python_maximum_signature_line_length = 90
python_use_unqualified_type_names = True


MATHML = "http://www.w3.org/1998/Math/MathML"
ElementTree.register_namespace("", MATHML)


def setup(app: Sphinx) -> None:
    """Render formulas as MathML; one that docutils cannot read stops the build."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(_rendered(tex2mathml(node.astext())))
    raise nodes.SkipNode


def _block(translator: Any, node: nodes.math_block) -> None:
    translator.body.append(f'<div class="math">{_rendered(tex2mathml(node.astext(), as_block=True))}</div>')
    raise nodes.SkipNode


def _rendered(formula: str) -> str:
    """Put the index of an accented letter beside it; docutils puts it below, as that of a sum."""
    tree = ElementTree.fromstring(re.sub(r"&(?!lt;|gt;|amp;)\w+;", lambda found: unescape(found[0]), formula))
    for both in list(tree.iter(f"{{{MATHML}}}munderover")):
        letter, index, accent = both
        if accent.tag == f"{{{MATHML}}}mo" and accent.get("stretchy") == "false":
            both.clear()
            both.tag = f"{{{MATHML}}}msub"
            over = ElementTree.SubElement(both, f"{{{MATHML}}}mover", accent="true")
            over.extend((letter, accent))
            both.append(index)
    return ElementTree.tostring(tree, encoding="unicode")
