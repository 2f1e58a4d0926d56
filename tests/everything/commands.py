"""The command line in this process: a command, and what it prints and with which code it ends."""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from typing import NamedTuple
from unittest.mock import patch

import typer.main

from taciturn import cli

PREFIX = "taciturn: "
command_of = cache(typer.main.get_command)  # built for each call it would be a quarter of the time of a problem


class Answer(NamedTuple):
    """What a command did."""

    code: int
    out: str
    err: str

    @property
    def refusal(self) -> str | None:
        """The sentence with which it refuses, or None."""
        return None if self.code == 0 else self.err.strip().removeprefix(PREFIX)


def run(*words: str) -> Answer:
    """Run ``taciturn`` with arguments; a crash is raised again, and a refusal is an answer."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        patch.object(typer.main, "get_command", command_of),
        patch.object(sys, "argv", ["taciturn", *words]),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            cli.main()
        except SystemExit as ended:
            code = int(ended.code or 0)
    return Answer(code, out.getvalue(), err.getvalue())
