"""The errors this library raises on purpose; each message says what, got, expected and remedy."""

from __future__ import annotations


class TaciturnError(ValueError):
    """A request that cannot be met; its text is one clear sentence fit for a user."""


class ProblemError(TaciturnError):
    """The data of a problem are malformed, inconsistent, or outside the range the theory needs."""


class InformationError(TaciturnError):
    """A node of a policy uses something it cannot know."""


class UnstableError(TaciturnError):
    """A loop diverges, or no stabilising gain exists."""
