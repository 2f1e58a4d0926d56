"""The manual: every code cell is executed at build time, an error stops the build, nothing is fetched."""

from __future__ import annotations

import re
import sys
from html import unescape
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util.docutils import SphinxDirective

sys.path.insert(0, str(Path(__file__).parent))
from names import listing, mend, shorten, told

if TYPE_CHECKING:
    from sphinx.application import Sphinx

project = "Taciturn"
author = "The Taciturn authors"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "Taciturn"
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["manual.css"]
html_math_renderer = "mathml"  # the browser's own; the usual one loads a script from elsewhere
myst_enable_extensions = ["amsmath", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_in_temp = False  # beside the data that a page shows; none writes a file
nb_execution_timeout = 300
nb_merge_streams = True
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
    app.add_directive("names", Names)
    app.add_directive("figures", Figures)
    app.connect("env-updated", lambda app, env: ["gallery"])  # it shows what the other pages are
    app.connect("doctree-resolved", _collect)
    app.connect("autodoc-process-docstring", _plain, priority=600)  # after napoleon
    app.connect("autodoc-process-signature", _short)
    app.connect("autodoc-skip-member", _is_field)


class Names(SphinxDirective):
    """Everything that a module offers; modules that are listed one a line get a section each."""

    optional_arguments = 1
    has_content = True

    def run(self) -> list[nodes.Node]:
        """Parse what the package says of itself."""
        if self.arguments:
            return self.parse_text_to_nodes(listing(self.arguments[0]))
        return [self._section(module) for module in self.content]

    def _section(self, module: str) -> nodes.section:
        section = nodes.section("", nodes.title(module, module), names=[nodes.fully_normalize_name(module)])
        self.state.document.note_implicit_target(section)
        section += self.parse_text_to_nodes(f"{told(import_module(module))}\n\n{listing(module)}")
        return section


class Figures(SphinxDirective):
    """The figures of all other pages, each with the page it is from."""

    def run(self) -> list[nodes.Node]:
        """Leave a place for them, until those pages are read."""
        return [nodes.container(classes=["gallery"])]


def _collect(app: Sphinx, tree: nodes.document, name: str) -> None:
    for place in [node for node in tree.findall(nodes.container) if node["classes"] == ["gallery"]]:
        for page in sorted(app.env.found_docs - {name}):
            for image in app.env.get_doctree(page).findall(nodes.image):
                place += _figure(image, app.builder.get_relative_uri(name, page), app.env.titles[page].astext())


def _figure(image: nodes.image, uri: str, title: str) -> nodes.container:
    """Return an image of another page with the section it is from and the sentence that stands before it."""
    part: nodes.Node = image
    while not isinstance(part.parent, nodes.section):
        part = part.parent
    section = part.parent
    heading = section.next_node(nodes.title).astext()
    link = {"refuri": f"{uri}#{section['ids'][0]}", "internal": True}
    caption = nodes.paragraph("", "", nodes.reference("", f"{title}: {heading}".removesuffix(f": {title}"), **link))
    before = [node for node in section[: section.index(part)] if isinstance(node, nodes.paragraph)]
    if before:
        caption += nodes.Text(". " + before[-1].astext().split(". ")[0].rstrip(".:") + ".")
    return nodes.container("", nodes.reference("", "", image.deepcopy(), **link), caption)


def _plain(app: Sphinx, what: str, name: str, value: object, options: object, lines: list[str]) -> None:
    mend(lines)


def _short(
    app: Sphinx, what: str, name: str, value: object, options: object, arguments: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    return arguments and shorten(arguments), returns and shorten(returns)


def _is_field(app: Sphinx, what: str, name: str, value: object, skip: bool, options: object) -> bool | None:
    return True if type(value).__name__ == "_tuplegetter" else None  # told under Args


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
