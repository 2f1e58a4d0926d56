"""Exceptions of the library. Each message states what is wrong, the given value, the expected value and a remedy."""

from __future__ import annotations


class TaciturnError(ValueError):
    """Base class of the library's exceptions. Their messages are written for users."""


class ProblemError(TaciturnError):
    """Raised for data that are malformed, contradict each other, or violate a condition of the theory."""


class PlacementError(ProblemError):
    """Raised if a policy kind does not support the given nodes or links. Another policy kind may support them."""


class InformationError(TaciturnError):
    """Raised for a policy in which a node would have to use a signal that is not available to it."""


class UnstableError(TaciturnError):
    """Raised for a closed loop that diverges, or for a plant that no gain stabilises."""
