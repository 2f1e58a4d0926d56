"""Sentences of the project drawn at random, for readers who judge whether they are clear.

``python tests/sentences.py SEED`` prints 80, each with the place where a reader finds it: the README, a page and its
heading, the changes, the name that a docstring describes, the module that raises a message, the command of an option.
"""

import ast
import random
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import prose

SHARES = {"README": 6, "pages": 28, "changes": 6, "docstrings": 18, "messages": 14, "help": 8}
FEWEST, MOST = 6, 60  # words
NAMES = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def written(path: Path) -> Iterator[str]:
    """Every whole sentence of a page's text, with its heading and links in brackets; no table, code or formula."""
    heading = path.stem
    for _, block in prose.blocks(path):
        if block.lstrip().startswith("#"):
            heading = block.strip("# \n")
        if block.lstrip().startswith(("#", "|", "$$", ":::", "![", "[^", "<", "(")):
            continue
        plain = re.sub(r"\[\^[^]]*\]|\{[\w:]+\}(?=`)", "", re.sub(r"\]\([^)]*\)", "]", block))
        plain = re.sub(r"^\s*[-*>]\s|\*\*?", "", " ".join(plain.split()))
        for sentence in re.split(r"(?<=[.!?])(?<!\b[A-Z]\.)\s+(?=[A-Z0-9`\"'])", plain):
            if re.match(r"[A-Z`\"']", sentence) and sentence.endswith((".", "?", "!")):
                yield f"[{path.name}, {heading}] {sentence}"


def documented(path: Path) -> Iterator[str]:
    """The first paragraph of every public docstring of a module."""
    module = ".".join(path.relative_to(prose.ROOT / "src").with_suffix("").parts)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, NAMES) and not (name := getattr(node, "name", "")).startswith("_"):
            text = " ".join((ast.get_docstring(node) or "").split("\n\n")[0].split())
            yield f"[docstring of {module} {name}] {text}"


def raised(path: Path) -> Iterator[str]:
    """Every message that a module raises, with … for what is filled in."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
            message = node.exc.args[0]
            parts = message.values if isinstance(message, ast.JoinedStr) else [message]
            said = "".join(str(part.value) if isinstance(part, ast.Constant) else "…" for part in parts)
            yield f"[error message, {path.relative_to(prose.ROOT / 'src')}] {said}"


def helped() -> Iterator[str]:
    """The help of every command, and of its options."""
    import typer

    from taciturn.cli.frame import app

    for name, command in typer.main.get_group(app).commands.items():
        yield f"[taciturn {name} --help] {command.help}".partition("\n")[0]
        for option in command.params:
            if text := getattr(option, "help", None):
                yield f"[taciturn {name} --help] {option.opts[0]}: {text}"


def sources() -> dict[str, list[str]]:
    """Every sentence, by where it is."""
    pages = [path for path in prose.texts() if path.is_relative_to(prose.ROOT / "docs")]
    modules = [path for path in prose.texts() if path.is_relative_to(prose.ROOT / "src")]
    found = {
        "README": [*written(prose.ROOT / "README.md")],
        "pages": [sentence for path in pages for sentence in written(path)],
        "changes": [*written(prose.ROOT / "CHANGELOG.md")],
        "docstrings": [sentence for path in modules for sentence in documented(path)],
        "messages": [sentence for path in modules for sentence in raised(path)],
        "help": [*helped()],
    }
    return {
        name: sorted({one for one in listed if FEWEST <= len(one.partition("] ")[2].split()) <= MOST})
        for name, listed in found.items()
    }


if __name__ == "__main__":
    chance = random.Random(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
    for where, listed in sources().items():
        for sentence in chance.sample(listed, SHARES[where]):
            print(sentence)
