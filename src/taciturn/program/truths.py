"""Truth values in a program: their combination, selections by them, and the label that a trigger selects."""

from __future__ import annotations

from collections.abc import Sequence

from taciturn.program.ir import Builder, Truth


class Truths:
    """Operations on truth values; a truth value that is known before the program runs is a ``bool``.

    Args:
        builder: collects the operations.
    """

    def __init__(self, builder: Builder) -> None:
        """Store the builder."""
        self.builder = builder

    def choose(self, truth: Truth, yes: int, no: int) -> int:
        """Return the number ``yes`` if the truth value is true, and ``no`` otherwise."""
        if isinstance(truth, bool):
            return yes if truth else no
        return self.builder.choose(truth, yes, no)

    def as_number(self, truth: Truth) -> int:
        """Return a truth value as a number: 1 for true and 0 for false."""
        return self.choose(truth, self.builder.constant(1.0), self.builder.constant(0.0))

    def least(self, values: Sequence[int], allowed: Sequence[Truth]) -> list[Truth]:
        """Return for each value but the last whether it is the first of the least allowed values."""
        # label i is chosen if V_i ≤ V_j for every later j, and no earlier label is chosen. For an earlier label that is
        # not chosen there is a later one with a smaller value, so by induction the chosen value is the minimum.
        truths: list[Truth] = []
        for i, value in enumerate(values[:-1]):
            truth = allowed[i]
            for other, possible in zip(values[i + 1 :], allowed[i + 1 :], strict=True):
                below = self.builder.emit("less_equal", value, other)
                truth = self.both(truth, self.either(below, self.negated(possible)))
            for earlier in truths:
                truth = self.both(truth, self.negated(earlier))
            truths.append(truth)
        return truths

    def first_within(self, values: Sequence[int], limit: float, allowed: Sequence[Truth]) -> list[Truth]:
        """Return for each value but the last whether it is the first allowed value that is at most the limit.

        If there is none, it is the last allowed value.
        """
        within = [self.builder.emit("less_equal", value, self.builder.constant(limit)) for value in values[:-1]]
        truths: list[Truth] = []
        for i, low in enumerate(within):
            last: Truth = True  # no later label is allowed
            for possible in allowed[i + 1 :]:
                last = self.both(last, self.negated(possible))
            truth = self.both(allowed[i], self.either(low, last))
            for earlier in truths:
                truth = self.both(truth, self.negated(earlier))
            truths.append(truth)
        return truths

    def both(self, one: Truth, other: Truth) -> Truth:
        """Return whether both are true."""
        if isinstance(one, bool):
            return other if one else False
        if isinstance(other, bool):
            return one if other else False
        return self.builder.emit("and", one, other)

    def either(self, one: Truth, other: Truth) -> Truth:
        """Return whether one of the two is true."""
        if isinstance(one, bool):
            return True if one else other
        if isinstance(other, bool):
            return True if other else one
        return self.negated(self.both(self.negated(one), self.negated(other)))

    def negated(self, truth: Truth) -> Truth:
        """Return whether a truth value is false."""
        if isinstance(truth, bool):
            return not truth
        op = self.builder.ops[truth]
        return op.arguments[0] if op.name == "not" else self.builder.emit("not", truth)
