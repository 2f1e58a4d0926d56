"""Export a setting of the page as a problem file, as Python code, or as a command that prints the same numbers.

A problem file is written from the tables of the changed problem. Numbers are written such that they are read back bit
for bit, so a saved file gives the digits that the page shows.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

from taciturn.extend import Displayed
from taciturn.problem import Problem
from taciturn.problem.write import tables_text
from taciturn_explore.setting import FACTOR, Setting

SAVED = "saved.toml"  # name of the file that is taken away


@dataclass(frozen=True, repr=False)
class Effort(Displayed):
    """The accuracy of an evaluation: a number of steps or a standard error of the cost; else the usual one."""

    steps: int | None = None
    standard_error: float | None = None

    @property
    def option(self) -> str:
        """Command-line option that requests this accuracy."""
        if self.steps:
            return f"--steps {self.steps}"
        return f"--standard-error {self.standard_error!r}" if self.standard_error else ""

    @property
    def argument(self) -> str:
        """The argument in Python."""
        if self.steps:
            return f"steps={self.steps:_}"
        return f"standard_error={self.standard_error!r}" if self.standard_error else ""


def problem_file(setting: Setting, problem: Problem) -> str:
    """Return the text of the problem file for a setting."""
    begun = setting.name or "a problem file"
    changed = ", ".join(f"{name} = {value}" for name, value in setting.changes)
    lines = [f"# Written by taciturn explore, from {begun}{f' with {changed}' if changed else ''}.", ""]
    tables = problem.source or {}
    last = {name: table for name, table in tables.items() if name != "policy"}
    return "\n".join([*lines, tables_text({**last, "policy": tables.get("policy", {})})])


def python_lines(setting: Setting, effort: Effort) -> str:
    """Return lines of Python code that evaluate a setting and print the result."""
    changes = {name.removeprefix("policy."): value for name, value in setting.changes}
    opened = f'taciturn.load("{setting.name}")'
    if _needs_file(setting):
        opened = f'taciturn.load("{SAVED}")'
    elif changes:
        opened += f".changed({{{', '.join(f'{json.dumps(name)}: {value!r}' for name, value in changes.items())}}})"
    return (
        "import taciturn\n\n"
        f"problem = {opened}\n"
        f"found = taciturn.evaluate({', '.join(filter(None, ('problem', effort.argument, f'seed={setting.seed}')))})\n"
        "print(found)\n"
    )


def command(setting: Setting, effort: Effort) -> str:
    """Return the ``taciturn`` command that evaluates a setting and prints the result."""
    file = SAVED if _needs_file(setting) else setting.name
    changes = (
        ""
        if _needs_file(setting)
        else "".join(
            f" --set {name.removeprefix('policy.')}={value!r}".replace("'", "") for name, value in setting.changes
        )
    )
    return " ".join(filter(None, (f"taciturn evaluate {file}{changes}", effort.option, f"--seed {setting.seed}")))


def _needs_file(setting: Setting) -> bool:
    """Return whether the changes are more than keys of a built-in problem, which the command line can state."""
    return not setting.name or setting.kind is not None or any(name.startswith(FACTOR) for name, _ in setting.changes)
