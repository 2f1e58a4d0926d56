"""Words that a shell completes: files, built-in problems, kinds of policy. Found without importing anything heavy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

PROBLEMS = Path(__file__).parent.parent / "problems"
KINDS = (
    "all-time", "periodic", "lqg", "remote-lqg", "lossy-lqg", "integral", "consistent", "excess", "optimal",
    "near-optimal", "absolute", "relative", "mixed", "dynamic", "send-on-delta", "variance", "rollout",
    "self-triggered", "stochastic", "periodic-schedule", "downsampled",
)  # fmt: skip
"""Those of the catalogue, which takes longer to import than a shell may wait; a test compares them."""


def complete_file(incomplete: str) -> list[str]:
    """Return the built-in problems and the TOML files that begin so; a shell goes on with folders where none does."""
    folder = incomplete[: incomplete.rfind("/") + 1]
    try:
        files = sorted(f"{folder}{path.name}" for path in Path(folder or ".").glob("*.toml"))
    except OSError:
        files = []
    names = [*files, *sorted(path.stem for path in PROBLEMS.glob("*.toml"))]
    return [name for name in names if name.startswith(incomplete)]


def complete_from(*words: str) -> Callable[[str], list[str]]:
    """Return what completes one of these words."""

    def complete(incomplete: str) -> list[str]:
        return [word for word in words if word.startswith(incomplete)]

    return complete


complete_kind = complete_from(*KINDS)
