"""Exceptions of the library; each message states the problem, the value, the expectation and a remedy."""

from __future__ import annotations


class TaciturnError(ValueError):
    """Base class of the library's exceptions, whose messages are written for users."""


class ProblemError(TaciturnError):
    """Raised for data that are malformed, inconsistent, or outside the range that the theory requires."""


class PlacementError(ProblemError):
    """Raised for nodes or links that a policy kind does not support, but another kind may."""


class InformationError(TaciturnError):
    """Raised for a policy in which a node uses a signal that is not available to it."""


class UnstableError(TaciturnError):
    """Raised for a loop that diverges, or a plant without a stabilising gain."""
