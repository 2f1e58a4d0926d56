"""Progress in notebooks: a bar that appears when a computation takes long, and only there."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from taciturn import _progress
from taciturn._progress import PATIENCE, in_notebook


class Cell:
    """A notebook's cell: the HTML below it, one text for each change."""

    def __init__(self) -> None:
        """Begin with nothing below."""
        self.shown: list[str] = []
        self.at_end: list[Callable[[], None]] = []
        self.kernel = "a kernel"
        self.events = SimpleNamespace(register=self.register, unregister=self.unregister)

    def register(self, event: str, call: Callable[[], None]) -> None:
        """Call a function when the cell ends."""
        assert event == "post_run_cell"
        self.at_end.append(call)

    def unregister(self, event: str, call: Callable[[], None]) -> None:
        """Forget it."""
        assert event == "post_run_cell"
        self.at_end.remove(call)

    def HTML(self, text: str) -> str:  # the name in IPython
        """Return the text as it is."""
        return text

    def display(self, text: str, display_id: bool) -> SimpleNamespace:
        """Show a text, and return what updates it."""
        assert display_id
        self.shown.append(text)
        return SimpleNamespace(update=self.shown.append)


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> Cell:
    """Let a notebook run, whose clock moves by half of the patience with every call."""
    shown, now = Cell(), iter(range(10**6))
    shell = SimpleNamespace(get_ipython=lambda: shown)
    monkeypatch.setitem(sys.modules, "IPython", shell)  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "IPython.display", shown)  # type: ignore[arg-type]
    monkeypatch.delenv("TACITURN_PROGRESS", raising=False)
    monkeypatch.setattr(_progress, "clock", lambda: 0.5 * PATIENCE * next(now))
    return shown


def test_a_bar_appears_after_a_second_and_disappears_at_the_end(cell: Cell) -> None:
    """It shows the fraction, in one place."""
    move = in_notebook(None)
    assert move is not None
    move(0.1)
    assert cell.shown == []
    move(0.25)
    move(0.5)
    move(1.0)
    assert [text.rpartition("> ")[2] for text in cell.shown] == ["25 %", "50 %", ""]


def test_a_bar_disappears_with_the_cell(cell: Cell) -> None:
    """After an error, or a search that ends before its estimate of the work, the last fraction does not stay."""
    move = in_notebook(None)
    assert move is not None
    for fraction in (0.1, 0.44):
        move(fraction)
    (leave,) = cell.at_end
    leave()
    assert [text.rpartition("> ")[2] for text in cell.shown] == ["44 %", ""]
    assert cell.at_end == []


def test_a_quick_computation_shows_no_bar(cell: Cell) -> None:
    """It ends before the patience does."""
    move = in_notebook(None)
    assert move is not None
    move(1.0)
    assert cell.shown == []


def test_a_progress_that_is_given_is_used(cell: Cell) -> None:
    """Nothing is shown beside it."""
    told: list[float] = []
    assert in_notebook(told.append) == told.append
    assert cell.shown == []


@pytest.mark.usefixtures("cell")
def test_a_variable_of_the_environment_stops_bars(monkeypatch: pytest.MonkeyPatch) -> None:
    """For manuals, whose pages hold results alone."""
    monkeypatch.setenv("TACITURN_PROGRESS", "0")
    assert in_notebook(None) is None


@pytest.mark.usefixtures("cell")
@pytest.mark.parametrize("shell", [None, SimpleNamespace()])
def test_scripts_and_terminals_are_quiet(monkeypatch: pytest.MonkeyPatch, shell: object) -> None:
    """Python without a shell, and IPython in a terminal, have no cell."""
    monkeypatch.setattr(sys.modules["IPython"], "get_ipython", lambda: shell)
    assert in_notebook(None) is None
    monkeypatch.delitem(sys.modules, "IPython")
    assert in_notebook(None) is None
