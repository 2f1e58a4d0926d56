"""The quadratic cost x'Qx + u'Ru + 2x'Nu, which a design minimises and by which policies are compared.

It is an average over infinite time, a total over a horizon of steps with a weight of the final state, or a discounted
sum. The matrix [[Q, N], [N', R]] must be positive semidefinite, so that no input gains by growing; R alone may be
singular if every input moves states that have a cost, which the regulator checks. Weights may follow from variances
that count equally (``Cost.of_variances``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, cast

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, count, frozen, number, semidefinite, set_fields
from taciturn._display import Displayed
from taciturn._text import number_of
from taciturn.errors import ProblemError
from taciturn.model.key import Rows, stated_as

LONGEST = 100_000  # largest number of steps of a finite horizon


@dataclass(frozen=True, eq=False, repr=False)
class Cost(Displayed):
    """The cost x'Qx + u'Ru + 2x'Nu, per step (discrete plant) or per second (continuous plant).

    Args:
        Q: state weight, (n, n), positive semidefinite.
        R: input weight, (m, m), positive semidefinite; may be zero if every input moves states that have a cost.
        N: cross weight, (n, m); default 0. [[Q, N], [N', R]] must be positive semidefinite.
        horizon: number of steps of a finite horizon; if omitted, the cost is an infinite-horizon average.
        terminal: weight of the final state, (n, n), only with ``horizon``; default Q.
        discount: discount factor per step in (0, 1]; below 1 the cost is the discounted sum.

    Raises:
        ProblemError: if a weight has the wrong shape or is indefinite, ``terminal`` is given without ``horizon``,
            ``discount`` is given with ``horizon``, or the horizon is above 100,000.

    Example:
        >>> Cost(Q=[[1.0]], R=[[2.0]]).N
        array([[0.]])
    """

    Q: Array = field(metadata=stated_as(Rows | None, note="weight of the state"))
    R: Array = field(metadata=stated_as(Rows | None, note="weight of the input"))
    N: Array = field(metadata=stated_as(Rows | None, note="cross weight"))
    horizon: int | None = field(
        metadata=stated_as(int | None, note="steps of a finite-horizon run; without this key the cost is an average")
    )
    terminal: Array | None = field(metadata=stated_as(Rows | None))
    discount: float = field(metadata=stated_as(float | None))

    def __init__(
        self,
        Q: ArrayLike,
        R: ArrayLike,
        N: ArrayLike | None = None,
        horizon: int | None = None,
        terminal: ArrayLike | None = None,
        discount: float = 1.0,
    ) -> None:
        """Validate and store the arguments."""
        n = array("Q", Q, (None, None), "(states, states)").shape[0]
        m = array("R", R, (None, None), "(inputs, inputs)").shape[0]
        Q = semidefinite("Q", Q, n, "(states, states)")
        R = semidefinite("R", R, m, "(inputs, inputs)")
        N = frozen(np.zeros((n, m))) if N is None else array("N", N, (n, m), "(states, inputs)")
        if N.any():
            semidefinite("[[Q, N], [N', R]]", np.block([[Q, N], [N.T, R]]), n + m)
        if terminal is not None and horizon is None:
            raise ProblemError(
                "terminal is given without horizon; expected both horizon and terminal, or neither of them"
            )
        discount = number("discount", discount, 0.0, 1.0, closed=True)
        if discount == 0:
            raise ProblemError("discount is 0; expected 0 < discount ≤ 1")
        if discount < 1 and horizon is not None:
            raise ProblemError("discount and horizon are both given; expected one of them")
        if horizon is not None:
            horizon = count("horizon", horizon)
            if horizon > LONGEST:
                raise ProblemError(
                    f"horizon is {horizon} steps; expected at most {LONGEST}, since every step has its own gains: use "
                    "an average or discounted cost for longer runs"
                )
            terminal = Q if terminal is None else semidefinite("terminal", terminal, n, "(states, states)")
        set_fields(self, {"Q": Q, "R": R, "N": N, "horizon": horizon, "terminal": terminal, "discount": discount})

    @classmethod
    def of_variances(
        cls, C: ArrayLike, output_variance: ArrayLike, input_variance: ArrayLike, D: ArrayLike | None = None
    ) -> Cost:
        """Return the cost that weights each output of y = C x and each input by its inverse variance (Bryson's rule).

        With a direct feedthrough D, y = C x + D u are the outputs after the input has changed.

        Args:
            C: output matrix of the plant, (p, n).
            output_variance: variance of each output that counts as much as the others, (p,).
            input_variance: variance of each input that counts as much, (m,).
            D: direct feedthrough of the plant, (p, m); default 0.

        Raises:
            ProblemError: a variance is not positive, or their number is not that of the outputs.

        Source: bryson1975

        Example:
            >>> Cost.of_variances([[1.0, 0.0]], [0.01], [4.0]).Q.tolist()
            [[100.0, 0.0], [0.0, 0.0]]
        """
        C = array("C", C, (None, None), "(outputs, states)")
        outputs = array("output_variance", output_variance, (len(C),), "(outputs,)")
        inputs = array("input_variance", input_variance, (None,), "(inputs,)")
        for name, values in (("output_variance", outputs), ("input_variance", inputs)):
            if (values <= 0).any():
                raise ProblemError(f"{name} contains {values.min():g}; expected positive variances")
        Q, R = C.T @ (C / outputs[:, None]), np.diag(1 / inputs)
        if D is None:
            return cls(Q, R)
        D = array("D", D, (len(C), len(inputs)), "(outputs, inputs)")
        return cls(Q, R + D.T @ (D / outputs[:, None]), C.T @ (D / outputs[:, None]))

    def summary(self) -> Mapping[str, str | Array | None]:
        """Return the type of the cost and its weights by name."""
        N = self.N if self.N.any() else None
        return {"kind": self.short(), "Q": self.Q, "R": self.R, "N": N, "terminal": self.terminal}

    def short(self) -> str:
        """Describe whether the cost is an average, a total over a horizon or a discounted sum, and of which form."""
        kind = "an average"
        if self.horizon is not None:
            kind = f"a finite-horizon run of {number_of(self.horizon, 'step')}"
        elif self.discount < 1:
            kind = f"a discounted sum, factor {self.discount:g} per step"
        cross = " + 2x'Nu" if self.N.any() else ""
        return f"{kind} of x'Qx + u'Ru{cross}"

    @property
    def mission(self) -> bool:
        """True if the cost is a total over a horizon or a discounted sum. False if it is a long-run average."""
        return self.horizon is not None or self.discount < 1

    def same_as(self, other: Cost) -> bool:
        """Return whether the other cost has the same weights, horizon and discount."""
        names = {one.name for one in (*fields(self), *fields(other))}
        return all(np.array_equal(*(cast("Any", getattr(one, name, None)) for one in (self, other))) for name in names)
