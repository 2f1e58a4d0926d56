"""What this manual makes of the package: its names in the reference, and the figures of all pages in the gallery."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from html import escape
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from docutils import nodes
from kind_tables import kind_table, problem_table
from names import listing, mend, shorten, told
from pygments.lexers import TOMLLexer
from pygments.token import Comment
from result_tables import key_table
from sphinx.util.docutils import SphinxDirective

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pygments.token import _TokenType
    from sphinx.application import Sphinx
    from sphinx.environment import BuildEnvironment


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the directives, and what makes docstrings and signatures fit; pages may be read by several processes."""
    app.add_lexer("toml", ProblemFile)
    app.add_directive("names", Names)
    app.add_directive("figures", Figures)
    app.add_directive("cards", Cards)
    app.add_directive("explorer", Explorer)
    app.add_directive("kinds", Kinds)
    app.add_directive("keys", Keys)
    app.add_directive("problems", Problems)
    app.connect("env-updated", lambda app, env: ["gallery", "index"])  # they show what the other pages are
    app.connect("doctree-read", _describe)
    app.connect("doctree-read", _find_plain)
    app.connect("doctree-resolved", _collect)
    app.connect("doctree-resolved", _picture_cards)
    app.connect("build-finished", _save_explorers)
    app.connect("autodoc-process-docstring", _plain, priority=600)  # after napoleon
    app.connect("autodoc-process-signature", _short)
    app.connect("autodoc-skip-member", _is_field)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


class ProblemFile(TOMLLexer):
    """TOML in which a key behind a number sign, ``#key``, is a key that is left out, and ``# text`` a comment."""

    def get_tokens_unprocessed(self, text: str, *rest: Any) -> Iterator[tuple[int, _TokenType, str]]:
        """Mark the keys that are left out."""
        for place, token, value in super().get_tokens_unprocessed(text, *rest):
            yield place, Comment.Preproc if token is Comment.Single and value[1:2].strip() else token, value


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


class Cards(SphinxDirective):
    """A card for each line ``page: Title. Sentence.``, with the first figure of the page."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Leave a place for the figures, until those pages are read."""
        cards = nodes.container(classes=["cards"])
        for line in self.content:
            page, _, text = line.partition(": ")
            title, _, sentence = text.partition(". ")
            cards += nodes.container(
                "", nodes.paragraph("", "", nodes.strong("", title)), nodes.paragraph("", sentence), page=page
            )
        return [cards]


_FIT = """<script>
addEventListener("message", ({ source, data }) => {
  for (const frame of document.querySelectorAll("iframe.explorer"))
    if (frame.contentWindow === source && data.height > 0) frame.style.height = `${data.height + 2}px`;
});
</script>"""  # a frame is as high as the page in it says


class Explorer(SphinxDirective):
    """The page of ``taciturn explore`` for a problem with changed parameters, saved without a server."""

    required_arguments = 1
    optional_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Show the page in a frame; it is saved when the manual is written."""
        problem, *changes = " ".join(self.arguments).split()
        name = f"explore-{'-'.join((problem, *changes)).replace('=', '-')}.html"
        self.env.metadata[self.env.docname].setdefault("explorers", {})[name] = (problem, *changes)
        page = escape(name)
        label = escape(f"Explore {problem}: cost against traffic, with a point that moves along its curve")
        frame = f'<iframe class="explorer" src="{page}?plane" title="{label}" loading="lazy"></iframe>'
        return [nodes.raw("", frame + _FIT, format="html")]


class Kinds(SphinxDirective):
    """A table of the policy kinds, from their records."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Parse the table."""
        return self.parse_text_to_nodes(kind_table(self.arguments[0]))


class Problems(SphinxDirective):
    """A table of the built-in problems, from their files."""

    def run(self) -> list[nodes.Node]:
        """Parse the table."""
        return self.parse_text_to_nodes(problem_table())


class Keys(SphinxDirective):
    """A table of the keys of a JSON document, from the fields of its result."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Parse the table."""
        return self.parse_text_to_nodes(key_table(self.arguments[0]))


def _describe(app: Sphinx, tree: nodes.document) -> None:
    """Give every figure of a code cell a text for readers who cannot see it: its section and the next text to it.

    This is the last paragraph before the figure; in a section that begins with the figure, the first one after it.
    """
    for image in tree.findall(nodes.image):
        if image.get("alt"):
            continue
        section = image
        while section.parent is not None and not isinstance(section, nodes.section):
            section = section.parent
        titles = [title.astext() for title in section.findall(nodes.title)][:1]
        texts = [text for text in section.findall(nodes.paragraph) if text.line]
        before = [text for text in texts if (text.line or 0) <= _line(image)]
        nearest = before[-1:] or texts[:1]
        image["alt"] = " ".join(["Figure:", *titles, *(f"— {text.astext()}" for text in nearest)])[:300]


def _find_plain(app: Sphinx, tree: nodes.document) -> None:
    """Mark the figures of code cells whose colours do not follow those of the page."""
    for image in tree.findall(nodes.image):
        form, path = image.parent.get("mime_type"), Path(app.srcdir, image["uri"])
        fixed = form == "image/svg+xml" and "prefers-color-scheme" not in path.read_text(encoding="utf-8")
        if fixed or form == "image/png":
            image["classes"].append("plain")


def _line(node: nodes.Node) -> int:
    """Return the line of a node, or of the next one around it that has one."""
    around: nodes.Node | None = node
    while around is not None and not around.line:
        around = around.parent
    return 0 if around is None or around.line is None else around.line


def _collect(app: Sphinx, tree: nodes.document, name: str) -> None:
    for place in [node for node in tree.findall(nodes.container) if node["classes"] == ["gallery"]]:
        for page in _in_order(app.env, app.config.root_doc, name):
            for image in filter(_is_shown, app.env.get_doctree(page).findall(nodes.image)):
                place += _figure(image, app.builder.get_relative_uri(name, page), app.env.titles[page].astext())


def _in_order(env: BuildEnvironment, top: str, without: str) -> Iterator[str]:
    """Return the pages below a page in the order of the menu, without one of them."""
    for page in env.toctree_includes.get(top, []):
        if page != without:
            yield page
        yield from _in_order(env, page, without)


def _is_shown(image: nodes.image) -> bool:
    """Tell whether a page shows an image; it leaves out the PNG of a picture that a cell also gives as an SVG."""
    form = image.parent
    return form.get("mime_type") != "image/png" or all(
        other.get("mime_type") != "image/svg+xml" for other in form.parent
    )


def _picture_cards(app: Sphinx, tree: nodes.document, name: str) -> None:
    """Put the first figure of its page into each card, and make the card a link."""
    for cards in [node for node in tree.findall(nodes.container) if node["classes"] == ["cards"]]:
        for card in list(cards.children):
            assert isinstance(card, nodes.container)
            page = card["page"]
            image = next(filter(_is_shown, app.env.get_doctree(page).findall(nodes.image)), None)
            if image is None:
                raise ValueError(f"the page {page} has no figure for its card")
            title, sentence = card.children
            picture = image.deepcopy()
            picture["alt"] = ""  # the title below it says it
            link = {"refuri": app.builder.get_relative_uri(name, page), "internal": True}
            card.clear()
            card += nodes.reference("", "", picture, **link)
            card += nodes.paragraph("", "", nodes.reference("", "", *title.children, **link))
            card += sentence


def _save_explorers(app: Sphinx, error: Exception | None) -> None:
    """Save the pages of the explorer that the manual shows; one that is there is of the same library."""
    if error is not None or app.builder.format != "html":
        return
    for page in app.env.found_docs:
        for name, (problem, *changes) in app.env.metadata[page].get("explorers", {}).items():
            kept = Path(app.config.nb_execution_cache_path) / name
            if not kept.exists():
                settings = [word for change in changes for word in ("--set", change)]
                command = [sys.executable, "-m", "taciturn", "explore", problem, *settings, "--save", str(kept)]
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            shutil.copyfile(kept, Path(app.outdir) / name)


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
    only = [word for word in image["classes"] if word.startswith("only-")]  # a picture for one colour scheme
    return nodes.container("", nodes.reference("", "", image.deepcopy(), **link), caption, classes=only)


def _plain(app: Sphinx, what: str, name: str, value: object, options: object, lines: list[str]) -> None:
    mend(lines)


def _short(
    app: Sphinx, what: str, name: str, value: object, options: object, arguments: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    return arguments and shorten(arguments), returns and shorten(returns)


def _is_field(app: Sphinx, what: str, name: str, value: object, skip: bool, options: object) -> bool | None:
    return True if type(value).__name__ == "_tuplegetter" else None  # told under Args
