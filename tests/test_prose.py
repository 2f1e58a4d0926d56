"""The project's sentences avoid the terms and patterns of ``prose``."""

from __future__ import annotations

from pathlib import Path

import prose
import pytest


@pytest.mark.parametrize("path", prose.texts(), ids=lambda path: path.relative_to(prose.ROOT).as_posix())
def test_sentences_use_the_terms_of_the_field(path: Path) -> None:
    """README, pages, docstrings, messages: no image, no frame before the subject, no term of our own."""
    assert not list(prose.faults(path))


def test_no_line_is_lost_as_a_comment() -> None:
    """The manual takes a line that begins with a percent sign as a comment, also the second line of a sentence."""
    for path in (prose.ROOT / "README.md", *(prose.ROOT / "docs").glob("*.md")):
        assert not [line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("%")], path


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("The clock sends at every tick.", ["clock", "tick"]),
        ("What is lost is drawn. Of a plant nothing is told.", ["What", "Of a", "is told"]),
        ("The loop that `tick`s goes on beside sending always.", ["sending always", "goes on", "beside"]),
        ("What does it cost? Steps, and a wall clock, are fine: --ticks too.", []),
    ],
)
def test_the_search_can_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, words: list[str]) -> None:
    """A page and a docstring with the same sentences have the same faults."""
    monkeypatch.setattr(prose, "ROOT", tmp_path)
    (tmp_path / "page.md").write_text(f"# Title\n\n{text}\n\n```python\nclock = 'a tick here'\n```\n")
    (tmp_path / "module.py").write_text(f'"""{text}"""\n')
    for name in ("page.md", "module.py"):
        found = [fault.split("'")[1] for fault in prose.faults(tmp_path / name)]
        assert sorted(found) == sorted(words)


def test_every_exception_is_needed() -> None:
    """Without it, a file would have a fault."""
    kept = dict(prose.EXCEPT)
    for files, suggestion in kept:
        try:
            del prose.EXCEPT[files, suggestion]
            assert any(list(prose.faults(path)) for path in prose.ROOT.glob(files)), (files, suggestion)
        finally:
            prose.EXCEPT.clear()
            prose.EXCEPT.update(kept)
