"""A problem under construction: each part is checked against the earlier parts, and the result is written as TOML."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from taciturn._arrays import Array, ArrayLike
from taciturn._display import Displayed
from taciturn.design.kind import Kind
from taciturn.errors import ProblemError
from taciturn.model.cost import Cost
from taciturn.model.pid import PID
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.problem import parse
from taciturn.problem.matrices import parse_matrix, square_matrix
from taciturn.problem.written import problem_text

COST = ("Q", "R", "N")
BY_CONTROLLER = {"weights": "as the controller"}


@dataclass(repr=False)
class Draft(Displayed):
    """A partly specified problem: the known matrices of a plant and a cost, a network and a controller.

    Args:
        dt: seconds per step; 0 for a continuous-time plant.
        plant: matrices A, B, E, C, D, V, W by name, in the order in which they were stored.
        cost: matrices Q, R, N by name.
        network: values of the keys of ``[network]``.
        controller: values of the keys of ``[controller]``.

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
    controller: dict[str, Any] = field(default_factory=lambda: {})

    @property
    def continuous(self) -> bool:
        """True if the plant is continuous in time."""
        return self.dt == 0

    @property
    def counts(self) -> tuple[int, int]:
        """The numbers of inputs and outputs of the plant."""
        plant = self.made_plant()
        return plant.inputs, len(plant.C)

    def keep(self, key: str, value: ArrayLike) -> None:
        """Store a matrix if it fits the known parts; a weight or covariance may be one number or a diagonal.

        Args:
            key: name of the matrix: A, B, E, C, D, V, W, Q, R or N; A and B must be stored first.
            value: the matrix.

        Raises:
            ProblemError: if the matrix does not fit the known parts.
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
        """Set C to the identity, so that every state is measured; the measurement noise is stored separately."""
        self.plant["C"] = np.eye(len(self.plant["A"]))

    def drop(self, key: str) -> None:
        """Remove a matrix of the plant."""
        self.plant.pop(key, None)

    def made_plant(self) -> Plant | ContinuousPlant:
        """Return the plant as far as it is known; unknown noise is zero."""
        return self._plant(self.plant)

    def made_cost(self) -> Cost:
        """Return the cost as far as it is known; an unknown weight R is the identity."""
        return self._cost(self.cost)

    def keep_pid(self, text: str) -> None:
        """Store a PID controller from the text of its gains, ``kp``, ``kp ki`` or ``kp ki kd filter``.

        Raises:
            ProblemError: if the text contains something else, the gains are invalid, or the plant has several inputs or
                outputs.
        """
        inputs, outputs = self.counts
        if (inputs, outputs) != (1, 1):
            raise ProblemError(
                f"the plant has {inputs} inputs and {outputs} outputs; expected one of each, or [controller] in the "
                "file with one PID controller per input"
            )
        gains = parse_matrix("the controller", text.replace(",", " ")).ravel().tolist()
        if len(gains) not in (1, 2, 4):
            raise ProblemError(
                f"the controller has {len(gains)} numbers; expected kp, or kp ki, or kp ki kd and the filter's time "
                "constant"
            )
        self.controller["pid"] = dict(zip(("kp", "ki", "kd", "filter"), gains, strict=False))
        PID(**self.controller["pid"])

    def fits(self, kind: Kind) -> bool:
        """Return whether a policy kind accepts this plant and cost, according to a quick check."""
        try:
            self.expect_fit(kind)
        except ProblemError:
            return False
        return True

    def expect_fit(self, kind: Kind) -> None:
        """Reject a policy kind that does not accept this plant and cost, according to a quick check.

        Raises:
            ProblemError: if the check of the kind refuses the plant or the cost.
        """
        if self.controller and not kind.keeps_controller:
            raise ProblemError(f"{kind.name} keeps no controller; expected another kind, such as excess")
        if kind.check is not None:
            kind.check(self.made_plant(), self.made_cost())

    def write(self, policy: Mapping[str, Any], name: str) -> str:
        """Return the text of a problem file, after reading it back and designing its policy as a check.

        Args:
            policy: values of the keys of ``[policy]``.
            name: name of the file.

        Raises:
            ProblemError: if the policy does not support this problem, or a parameter is out of range.
            UnstableError: if no stabilising gain exists.
        """
        step = {} if self.continuous else {"dt": self.dt}
        tables: dict[str, Any] = {"plant": {**step, **self.plant}, "cost": self.cost or BY_CONTROLLER, "policy": policy}
        if self.network:
            tables["network"] = self.network
        if self.controller:
            tables["controller"] = self.controller
        text = problem_text(tables, name)
        parse(tomllib.loads(text), name).designed()
        return text

    def _sizes(self) -> dict[str, int]:
        """Return the number of rows of each square matrix by name."""
        states, inputs = self.plant["B"].shape
        return {"W": states, "Q": states, "R": inputs, "V": len(self.plant["C"]) if "C" in self.plant else states}

    def _plant(self, known: Mapping[str, Array]) -> Plant | ContinuousPlant:
        A, C, V, D, E = known["A"], *(known.get(name) for name in "CVDE")
        B, W = known.get("B", np.eye(len(A))), known.get("W", np.zeros((len(A), len(A))))
        if self.continuous:
            return ContinuousPlant(A, B, W, C=C, V=V, D=D, E=E)
        return Plant(A, B, W, C, V, self.dt, D=D, E=E)

    def _cost(self, known: Mapping[str, Array]) -> Cost:
        if not known and self.controller:  # weights by the controller's loop: here only outputs and inputs
            C = self.made_plant().C
            return Cost(C.T @ C, np.eye(self.plant["B"].shape[1]))
        return Cost(known["Q"], known.get("R", np.eye(self.plant["B"].shape[1])), known.get("N"))
