"""Prompts on a terminal, or answers from a pipe; each answer is checked before the next question."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeVar

import typer

if TYPE_CHECKING:
    from taciturn.errors import TaciturnError

Answer = TypeVar("Answer")


class Questions:
    """Prompts that are repeated until the answer is valid; from a pipe, an invalid answer raises an error.

    Args:
        yes: use the suggested values without prompts.
    """

    def __init__(self, yes: bool = False) -> None:
        """Check whether standard input is a terminal."""
        self.yes, self.patient = yes, sys.stdin.isatty()

    def ask(self, name: str, text: str, read: Callable[[str], Answer], default: str | None = None) -> Answer:
        """Ask a question, and return the answer as a value.

        Args:
            name: name of the value in messages.
            text: the question.
            read: function that converts an answer to a value, and raises an error if it is invalid.
            default: value for an empty answer; if omitted, an answer is required.

        Raises:
            ProblemError: the input ends, or an answer is invalid and the input is not a terminal.
        """
        from taciturn.errors import ProblemError, TaciturnError

        while True:
            given = self._answer(name, text, default)  # outside try: the end of the input is not asked again
            try:
                if not given:
                    raise ProblemError(f"{name} is missing; expected an answer, because there is no default")
                return read(given)
            except TaciturnError as error:
                self.tell(error)

    def choose(self, name: str, text: str, words: Sequence[str], default: str) -> str:
        """Ask for one of several words, and return it; the first letters are sufficient.

        Raises:
            ProblemError: as for ``ask``, or the answer is not one of the words.
        """
        from taciturn.errors import ProblemError

        def read(answer: str) -> str:
            meant = [word for word in words if answer and word.startswith(answer.lower())]
            if len(meant) != 1:
                raise ProblemError(f"{name} is {answer!r}; expected one of {', '.join(words)}")
            return meant[0]

        return self.ask(name, f"{text} ({', '.join(words)})", read, default)

    def tell(self, error: TaciturnError) -> None:
        """Print an error before the question is repeated; raise it if the input is a pipe or there are no prompts."""
        from taciturn.errors import ProblemError

        if self.yes:
            raise error
        if not self.patient:
            remedy = "no file was written; in scripts, give matrices with --from, or write the file yourself"
            raise ProblemError(f"{error}; {remedy}") from error
        self.say(str(error))

    def say(self, text: str) -> None:
        """Print an indented message for the user."""
        if not self.yes:
            typer.echo(f"  {text}")

    def _answer(self, name: str, text: str, default: str | None) -> str:
        """Return the answer; a matrix may take several lines until its brackets are closed."""
        from taciturn.errors import ProblemError

        if self.yes:
            if default is None:
                raise ProblemError(f"{name} has no default; expected an answer: run the command without --yes")
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
            raise ProblemError(
                f"the input ends before {name} is given; expected one more answer; no file was written"
            ) from None
        except UnicodeDecodeError as error:
            raise ProblemError(
                f"the answer to {name} is not UTF-8 text ({error.reason}); expected UTF-8 text"
            ) from None
        if not self.patient:
            typer.echo(given)  # a terminal shows the answer itself
        return given
