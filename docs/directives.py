"""What this manual makes of the package: its names in the reference, and the figures of all pages in the gallery."""

from __future__ import annotations

import re
from importlib import import_module
from typing import TYPE_CHECKING

from docutils import nodes
from kind_tables import kind_table
from names import listing, mend, shorten, told
from sphinx.util.docutils import SphinxDirective

if TYPE_CHECKING:
    from sphinx.application import Sphinx


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the directives, and what makes docstrings and signatures fit; pages may be read by several processes."""
    app.add_directive("names", Names)
    app.add_directive("figures", Figures)
    app.add_directive("kinds", Kinds)
    app.connect("env-updated", lambda app, env: ["gallery"])  # it shows what the other pages are
    app.connect("doctree-read", _describe)
    app.connect("doctree-resolved", _collect)
    app.connect("autodoc-process-docstring", _plain, priority=600)  # after napoleon
    app.connect("autodoc-process-signature", _short)
    app.connect("autodoc-skip-member", _is_field)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


class Names(SphinxDirective):
    """What a module publishes; modules that are listed one a line get a section each."""

    optional_arguments = 1
    has_content = True

    def run(self) -> list[nodes.Node]:
        """Parse what the package says of itself."""
        if self.arguments:
            return self.parse_text_to_nodes(listing(self.arguments[0]))
        return [self._section(entry) for entry in self.content]

    def _section(self, entry: str) -> nodes.section:
        module = entry.partition(":")[0]
        section = nodes.section("", nodes.title(module, module), names=[nodes.fully_normalize_name(module)])
        self.state.document.note_implicit_target(section)
        section += self.parse_text_to_nodes(f"{told(import_module(module))}\n\n{listing(entry)}")
        return section


class Figures(SphinxDirective):
    """The figures of all other pages, each with the page it is from."""

    def run(self) -> list[nodes.Node]:
        """Leave a place for them, until those pages are read."""
        return [nodes.container(classes=["gallery"])]


class Kinds(SphinxDirective):
    """A table of the policy kinds, from their records."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Parse the table."""
        return self.parse_text_to_nodes(kind_table(self.arguments[0]))


def _describe(app: Sphinx, tree: nodes.document) -> None:
    """Give every figure of a code cell a text for readers who cannot see it: its section and the sentence before."""
    for image in tree.findall(nodes.image):
        if image.get("alt"):
            continue
        section = image
        while section.parent is not None and not isinstance(section, nodes.section):
            section = section.parent
        titles = [title.astext() for title in section.findall(nodes.title)][:1]
        before = [text.astext() for text in section.findall(nodes.paragraph) if text.line and text.line <= _line(image)]
        image["alt"] = " ".join(["Figure:", *titles, *(f"— {text}" for text in before[-1:])])[:300]


def _line(node: nodes.Node) -> int:
    """Return the line of a node, or of the next one around it that has one."""
    around: nodes.Node | None = node
    while around is not None and not around.line:
        around = around.parent
    return 0 if around is None or around.line is None else around.line


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
        caption += nodes.Text(". " + re.split(r"\.\s", before[-1].astext())[0].rstrip(".:") + ".")
    return nodes.container("", nodes.reference("", "", image.deepcopy(), **link), caption)


def _plain(app: Sphinx, what: str, name: str, value: object, options: object, lines: list[str]) -> None:
    mend(lines)


def _short(
    app: Sphinx, what: str, name: str, value: object, options: object, arguments: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    return arguments and shorten(arguments), returns and shorten(returns)


def _is_field(app: Sphinx, what: str, name: str, value: object, skip: bool, options: object) -> bool | None:
    return True if type(value).__name__ == "_tuplegetter" else None  # told under Args
