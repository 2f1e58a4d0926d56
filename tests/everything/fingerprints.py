"""What identifies problems, in a process of its own: nothing that is signed may depend on the order of a hash."""

from __future__ import annotations

import os
import subprocess
import sys
from ast import literal_eval
from collections.abc import Sequence
from pathlib import Path

HASH_SEEDS = (0, 1, 2, 3)


def differing(files: Sequence[Path]) -> dict[int, str]:
    """Return what depends on the seed of hashes in the files that have such a thing, by their place in the list."""
    if not files:
        return {}
    answers = []
    for seed in HASH_SEEDS:
        given = os.environ | {"PYTHONHASHSEED": str(seed)}
        done = subprocess.run([sys.executable, __file__, *map(str, files)], env=given, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        answers.append(done.stdout.splitlines())
    found: dict[int, str] = {}
    for i, rows in enumerate(zip(*answers, strict=True)):
        if len(set(rows)) > 1:
            first, *others = map(literal_eval, rows)
            names = [name for name in first if any(other.get(name) != first[name] for other in others)]
            found[i] = f"depends on the seed of hashes: {', '.join(names) or 'its keys'}"
    return found


def main() -> None:
    """Print a line for each file."""
    sys.path.insert(0, str(Path(__file__).parent.parent))
    from signed import signed

    import taciturn
    from taciturn.errors import TaciturnError

    for file in sys.argv[1:]:
        try:
            print(signed(taciturn.load(file)))
        except TaciturnError as error:  # of a problem that is made smaller
            print({"refused": str(error)})


if __name__ == "__main__":
    main()
