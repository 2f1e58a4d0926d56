"""A problem that is not whole yet: each part checked against those before it, and at last written down."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from taciturn._arrays import Array, ArrayLike
from taciturn.design.lossy_lqg import refuse_what_is_not_covered
from taciturn.design.prediction import refuse_what_is_not_predicted
from taciturn.errors import ProblemError
from taciturn.model.cost import Cost
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.problem import parse
from taciturn.problem.matrices import square_matrix
from taciturn.problem.written import problem_text

COST = ("Q", "R", "N")
PREDICTED, LOSSY = ("consistent", "integral"), "lossy-lqg"


@dataclass
class Draft:
    """Matrices of a plant and a cost, and a network, as far as they are known.

    Args:
        dt: seconds per step; 0 of a plant that is continuous in time.
        plant: A, B, C, V, W, in the order in which they are kept.
        cost: Q, R, N.
        network: keys of ``[network]``.

    Example:
        >>> draft = Draft(dt=0.1)
        >>> for key, value in {"A": [[1.0]], "B": [[1.0]], "W": 0.1, "Q": 1.0, "R": 1.0}.items():
        ...     draft.keep(key, value)
        >>> "theta = 0.1" in draft.write({"kind": "lqg", "theta": 0.1}, "walk.toml")
        True
    """

    dt: float = 0.0
    plant: dict[str, Array] = field(default_factory=lambda: {})
    cost: dict[str, Array] = field(default_factory=lambda: {})
    network: dict[str, Any] = field(default_factory=lambda: {})

    @property
    def continuous(self) -> bool:
        """Whether the plant is continuous in time."""
        return self.dt == 0

    def keep(self, key: str, value: ArrayLike) -> None:
        """Keep a matrix, if what is known can have it; a weight or covariance may be one number or a diagonal.

        Args:
            key: A, B, C, V, W, Q, R or N; A and B come first.
            value: the matrix.

        Raises:
            ProblemError: it does not fit.
        """
        sizes = {} if "B" not in self.plant else self._sizes()
        fitting = square_matrix(key, value, sizes[key]) if key in sizes else np.asarray(value)
        if key in COST:
            self._cost({**self.cost, key: fitting})
            self.cost[key] = fitting
        else:
            self._plant({**self.plant, key: fitting})
            self.plant[key] = fitting

    def measure_all(self) -> None:
        """Say that every state is measured, with noise that is still to be kept."""
        self.plant["C"] = np.eye(len(self.plant["A"]))

    def drop(self, key: str) -> None:
        """Take a matrix of the plant out."""
        self.plant.pop(key, None)

    def made_plant(self) -> Plant | ContinuousPlant:
        """Return the plant as far as it is known; without noise where that is not known."""
        return self._plant(self.plant)

    def made_cost(self) -> Cost:
        """Return the cost as far as it is known; inputs cost u'u where that is not known."""
        return self._cost(self.cost)

    def fits(self, kind: str) -> bool:
        """Tell whether a policy kind is for a plant and a cost as these, as far as that can be told at once."""
        try:
            self.expect_fit(kind)
        except ProblemError:
            return False
        return True

    def expect_fit(self, kind: str) -> None:
        """Refuse a policy kind that is not for a plant and a cost as these, as far as that can be told at once.

        Raises:
            ProblemError: the kind predicts in continuous time, or reckons with lost packets, where that cannot be.
        """
        if kind in PREDICTED:
            refuse_what_is_not_predicted(kind, self.made_plant(), self.made_cost())
        if kind == LOSSY:
            refuse_what_is_not_covered(self.made_plant(), self.made_cost())

    def write(self, policy: Mapping[str, Any], name: str) -> str:
        """Return the text of a problem file, once it is read back and its policy is designed.

        Args:
            policy: keys of ``[policy]``.
            name: of the file.

        Raises:
            ProblemError: the policy is not for this problem, or a parameter is out of range.
            UnstableError: no stabilising gain.
        """
        step = {} if self.continuous else {"dt": self.dt}
        tables: dict[str, Any] = {"plant": {**step, **self.plant}, "cost": self.cost, "policy": policy}
        if self.network:
            tables["network"] = self.network
        text = problem_text(tables, name)
        parse(tomllib.loads(text), name).designed()
        return text

    def _sizes(self) -> dict[str, int]:
        """Return rows and columns of the matrices that are square."""
        states, inputs = self.plant["B"].shape
        return {"W": states, "Q": states, "R": inputs, "V": len(self.plant["C"]) if "C" in self.plant else states}

    def _plant(self, known: Mapping[str, Array]) -> Plant | ContinuousPlant:
        A, C, V = known["A"], known.get("C"), known.get("V")
        B, W = known.get("B", np.eye(len(A))), known.get("W", np.zeros((len(A), len(A))))
        if self.continuous:
            return ContinuousPlant(A, B, W, C=C, V=V)
        return Plant(A, B, W, C, V, self.dt)

    def _cost(self, known: Mapping[str, Array]) -> Cost:
        return Cost(known["Q"], known.get("R", np.eye(self.plant["B"].shape[1])), known.get("N"))
