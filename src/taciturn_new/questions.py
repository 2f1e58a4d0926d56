"""Questions and answers on a terminal, through a pipe, or from a file of earlier answers.

A question has a text, and it may have an example, a default and an explanation, which the answer ``?`` prints. Each
answer is checked before the next question. On a terminal, a wrong answer is explained and asked again; from a pipe it
is an error, since the answers after it would be read for other questions. The end of the input is an error in both
cases.

Every accepted answer is kept as it was typed, so the same questions can be answered again without typing: ``back``
leaves out the last answer, and a file of answers (``--answers``) continues where Ctrl-C ended an earlier run.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

import typer

from taciturn.errors import ProblemError, TaciturnError
from taciturn.extend import wrapped_text

Answer = TypeVar("Answer")
BACK, WHY = "back", "?"  # answers that are none


class Back(Exception):  # noqa: N818
    """Exception that leads back to the previous question, because the user wants to change the last answer."""


class Questions:
    """Questions to the user; a terminal repeats a question after an invalid answer, a pipe ends with an error."""

    def __init__(self, answers: Sequence[str] = (), yes: bool = False) -> None:
        """Read earlier answers first, or take each default (``yes``); check whether standard input is a terminal."""
        self.yes, self.patient = yes, sys.stdin.isatty()
        self.given: list[list[str]] = []  # lines of each accepted answer
        self._kept = list(answers)  # lines of answers that are read first
        self._lines: list[str] = []  # of the present answer

    def ask(
        self,
        name: str,
        text: str,
        read: Callable[[str], Answer],
        default: str | None = None,
        *,
        example: str = "",
        why: str = "",
    ) -> Answer:
        """Ask a question until the answer is valid, and return the answer as a value."""
        shown = f"{text}, such as {example}" if example else text
        while True:
            typed = self._answer(name, shown, default)  # outside try: the end of the input is not asked again
            if typed == WHY and self.patient:
                self.say(why or f"{name} has no more explanation; {BACK} returns to the last question")
                continue
            try:
                if typed == BACK and self.patient and self.given:
                    raise Back
                if not typed:
                    raise ProblemError(f"{name} is missing; expected an answer, because there is no default")
                found = read(typed)
            except TaciturnError as error:
                self._kept.clear()  # answers after a wrong one may be those to other questions
                self.tell(error)
                continue
            self.given.append(self._lines)
            return found

    def choose(
        self, name: str, text: str, words: Sequence[str], default: str, *, example: str = "", why: str = ""
    ) -> str:
        """Ask the user for one of several words, and return that word; its first letters are enough as an answer.

        Raises:
            ProblemError: as for ``ask``, or the answer is not one of the words.
        """

        def read(answer: str) -> str:
            meant = [word for word in words if answer and word.startswith(answer.lower())]
            if len(meant) != 1:
                raise ProblemError(f"{name} is {answer!r}; expected one of the answers {', '.join(words)}")
            return meant[0]

        return self.ask(name, f"{text} ({', '.join(words)})", read, default, example=example, why=why)

    def tell(self, error: TaciturnError) -> None:
        """Print the error of an invalid answer before the question is repeated; raise it if no user can answer."""
        if self.yes:
            raise error
        if not self.patient:
            remedy = "no file was written; in scripts, give matrices with --from, or write the file yourself"
            raise ProblemError(f"{error}; {remedy}") from error
        self.say(str(error))

    def say(self, text: str, start: str = "") -> None:
        """Print an indented message for the user; print nothing if the answers come from a file."""
        if not self.yes and not self._kept:
            typer.echo(wrapped_text(text, f"  {start}"))

    def begin(self, title: str) -> None:
        """Print the title of the questions that follow, if the user is at a terminal."""
        if self.patient and not self._kept:
            typer.echo(f"\n{title}")

    def again(self) -> Questions:
        """Return these questions with all answers except the last one, so that the user can change the last one."""
        found = Questions([line for lines in self.given[:-1] for line in lines], self.yes)
        found.patient = self.patient
        return found

    def lines(self) -> list[str]:
        """Return all accepted answers, as lines of text."""
        return [line for lines in self.given for line in lines]

    def _answer(self, name: str, text: str, default: str | None) -> str:
        """Return the answer; a matrix may take several lines until its brackets are closed."""
        if self.yes:
            if default is None:
                raise ProblemError(f"{name} has no default; expected an answer: run the command without --yes")
            return default
        self._lines = []
        prompt = f"{text} [{default}]: " if default is not None else f"{text}: "
        typed = self._line(name, f"{wrapped_text(prompt)} " if self.patient else prompt)
        while typed.count("[") > typed.count("]"):
            typed += "\n" + self._line(name, "  … ")
        return typed or default or ""

    def _line(self, name: str, prompt: str) -> str:
        if self._kept:
            self._lines.append(self._kept.pop(0))
            return self._lines[-1].strip()
        try:
            typed = input(prompt).strip()
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
            typer.echo(typed)  # a terminal shows the answer itself
        self._lines.append(typed)
        return typed
