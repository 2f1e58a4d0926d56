"""What identifies problems, in a process of its own: nothing that is signed may depend on the order of a hash."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

HASH_SEEDS = (0, 1, 2, 3)


def agree(files: Sequence[Path]) -> list[str]:
    """Return the files whose fingerprint or record depends on the seed of hashes, with what was found."""
    if not files:
        return []
    answers = []
    for seed in HASH_SEEDS:
        given = os.environ | {"PYTHONHASHSEED": str(seed)}
        done = subprocess.run([sys.executable, __file__, *map(str, files)], env=given, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        answers.append(done.stdout.splitlines())
    rows = list(zip(files, *answers, strict=True))
    return [f"{file}: {set(found)}" for file, *found in rows if len(set(found)) > 1]


def main() -> None:
    """Print a line for each file."""
    sys.path.insert(0, str(Path(__file__).parent.parent))
    from everything.checks import summary_of

    import taciturn
    from taciturn.study.record import fingerprint

    for file in sys.argv[1:]:
        problem = taciturn.load(file)
        print(summary_of(problem), fingerprint(problem))


if __name__ == "__main__":
    main()
