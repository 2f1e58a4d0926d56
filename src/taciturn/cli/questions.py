"""Questions that are asked one by one, on a terminal or from a pipe, and checked at once."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeVar

import typer

if TYPE_CHECKING:
    from taciturn.errors import TaciturnError

Answer = TypeVar("Answer")


class Questions:
    """Asks until an answer fits; from a pipe the first that does not is refused.

    Args:
        yes: ask nothing, and take what is suggested.
    """

    def __init__(self, yes: bool = False) -> None:
        """See who answers."""
        self.yes, self.patient = yes, sys.stdin.isatty()

    def ask(self, name: str, text: str, read: Callable[[str], Answer], default: str | None = None) -> Answer:
        """Return an answer, read.

        Args:
            name: of what is asked for, in messages.
            text: the question.
            read: what makes a value of the answer, and refuses what does not fit.
            default: taken where nothing is answered; omitted: an answer is needed.

        Raises:
            ProblemError: the answers have ended, or, where nobody sits at a terminal, one does not fit.
        """
        from taciturn.errors import ProblemError, TaciturnError

        while True:
            given = self._answer(name, text, default)  # whose end is not asked for again
            try:
                if not given:
                    raise ProblemError(f"{name} is missing; expected an answer, as there is no usual value")
                return read(given)
            except TaciturnError as error:
                self.tell(error)

    def choose(self, name: str, text: str, words: Sequence[str], default: str) -> str:
        """Return one of some words, which may be answered by its first letters.

        Raises:
            ProblemError: as ``ask``, or none of the words.
        """
        from taciturn.errors import ProblemError

        def read(answer: str) -> str:
            meant = [word for word in words if answer and word.startswith(answer.lower())]
            if len(meant) != 1:
                raise ProblemError(f"{name} is {answer!r}; expected one of {', '.join(words)}")
            return meant[0]

        return self.ask(name, f"{text} ({', '.join(words)})", read, default)

    def tell(self, error: TaciturnError) -> None:
        """Tell what does not fit, so that it is asked for again; from a pipe, or where nothing is asked, end."""
        from taciturn.errors import ProblemError

        if self.yes:
            raise error
        if not self.patient:
            remedy = "nothing is written: for scripts, give matrices with --from, or write the file itself"
            raise ProblemError(f"{error}; {remedy}") from error
        self.say(str(error))

    def say(self, text: str) -> None:
        """Tell whoever answers something."""
        if not self.yes:
            typer.echo(f"  {text}")

    def _answer(self, name: str, text: str, default: str | None) -> str:
        """Return what was answered; a matrix may go on over several lines until its brackets are closed."""
        from taciturn.errors import ProblemError

        if self.yes:
            if default is None:
                raise ProblemError(f"{name} has no usual value; expected an answer: leave --yes away")
            return default
        given = self._line(name, f"{text} [{default}]: " if default is not None else f"{text}: ")
        while given.count("[") > given.count("]"):
            given += "\n" + self._line(name, "  … ")
        return given or default or ""

    def _line(self, name: str, prompt: str) -> str:
        from taciturn.errors import ProblemError

        try:
            given = input(prompt).strip()
        except EOFError:
            typer.echo()
            raise ProblemError(f"the answers end before {name}; expected one more; nothing is written") from None
        except UnicodeDecodeError as error:
            raise ProblemError(f"the answer to {name} is no text in UTF-8 ({error.reason}); expected text") from None
        if not self.patient:
            typer.echo(given)  # as a terminal shows it
        return given
