"""Deviations of the C core from MISRA C:2012, as cppcheck finds them.

``python tests/export/misra.py`` writes the numbers of the installed cppcheck into ``docs/misra.json``. A rule without a
reason there gets an empty one, which the tests refuse.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))

from export.test_folders import two_mass

from taciturn_export.folder import CORE_SOURCES, print_folder

TABLE = Path(__file__).parent.parent.parent / "docs" / "misra.json"
FOUND = re.compile(r"([\w.]+):(\d+):(\d+):misra-c2012-(\d+\.\d+)")


def version() -> str | None:
    """Return the version of cppcheck; None: there is none, or it has no addon for MISRA."""
    if shutil.which("cppcheck") is None:
        return None
    return subprocess.run(["cppcheck", "--version"], capture_output=True, text=True, check=True).stdout.split()[1]


def places(folder: Path, names: Sequence[str] = CORE_SOURCES) -> set[tuple[str, str]]:
    """Return each place and rule of a deviation in these files and their headers.

    Args:
        folder: exported folder.
        names: names of the C files.

    Raises:
        RuntimeError: cppcheck fails, or cannot read a file.
    """
    options = ["--std=c99", "--addon=misra", "--enable=style", "--suppress=missingIncludeSystem", "-q"]
    command = ["cppcheck", *options, "--template={file}:{line}:{column}:{id}", *names]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr
    if done.returncode != 0 or re.search(r"syntaxError|internal|missingInclude\b|preprocessorError", said):
        raise RuntimeError(f"cppcheck ended with {done.returncode}: {said}")
    return {(f"{file}:{line}:{column}", rule) for file, line, column, rule in FOUND.findall(said)}


def core_places() -> set[tuple[str, str]]:
    """Return the deviations of the core as it is exported in either precision."""
    found = set[tuple[str, str]]()
    for precision in ("float64", "float32"):
        with TemporaryDirectory() as folder:
            print_folder(replace(two_mass(), precision=precision), "two_mass", rows=1).write(Path(folder))
            found |= places(Path(folder))
    return found


def counts(found: set[tuple[str, str]]) -> dict[str, int]:
    """Return the number of deviations from each rule, in the order of the rules."""
    number = Counter(rule for _, rule in found)
    return {rule: number[rule] for rule in sorted(number, key=lambda rule: [int(part) for part in rule.split(".")])}


def table() -> dict[str, Any]:
    """Return the table of the manual."""
    return json.loads(TABLE.read_text(encoding="utf-8"))


def of_version(kept: dict[str, Any], checked: str) -> dict[str, int]:
    """Return the numbers of the table for a version of cppcheck."""
    return {rule: row["found"][checked] for rule, row in kept["rules"].items() if checked in row["found"]}


def main() -> None:
    """Write the table of the installed cppcheck next to those of other versions."""
    checked, kept = version(), table() if TABLE.exists() else {"versions": [], "rules": {}}
    assert checked is not None, "there is no cppcheck"
    for row in kept["rules"].values():
        row["found"].pop(checked, None)
    for rule, number in counts(core_places()).items():
        kept["rules"].setdefault(rule, {"category": "", "reason": "", "found": {}})["found"][checked] = number
    kept["versions"] = sorted({*kept["versions"], checked}, key=lambda text: [int(part) for part in text.split(".")])
    order = sorted(kept["rules"], key=lambda rule: [int(part) for part in rule.split(".")])
    kept["rules"] = {rule: kept["rules"][rule] for rule in order if kept["rules"][rule]["found"]}
    TABLE.write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
