"""Problems without a problem file: made from a policy, or from a function that returns a policy.

A policy is studied on the plant, the cost and the network that it was designed for. Its policy kind is a record that
returns the given policy; the parameters of the kind are those of the function.

A process that starts other processes passes such a problem to them, since there is no file that they could read.
"""

from __future__ import annotations

import inspect
import os
import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias, cast

from taciturn._arrays import quoted
from taciturn.design.kind import AnyPolicy, Kind, TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.model.cost import Cost
from taciturn.model.packets import fingerprint
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy, own_problem
from taciturn.problem import Problem

Studied: TypeAlias = Problem | Policy | Callable[..., Policy]


def as_problem(name: str, value: object) -> Problem:
    """Make a problem from a policy, or from a function that returns a policy; return a given problem unchanged.

    The first parameter of a function is its tuning parameter. Its values are positive, and integers if it is
    annotated as ``int``. The rate must fall as it increases. A parameter without a default is 1 in the policy that
    determines plant, cost and network.
    """
    if isinstance(value, Problem):
        return value
    if isinstance(value, Policy):
        return _problem(value, _Given(value), "the given policy", {})
    if not callable(value):
        raise ProblemError(
            f"{name} is {quoted(value)}; expected a Problem (taciturn.load reads one from a file), a Policy, or a "
            "function that returns a Policy"
        )
    function = cast("Callable[..., Policy]", value)
    given = list(inspect.signature(function).parameters.values())
    defaults = {one.name: one.default for one in given if one.default is not one.empty}
    base = function(**{one.name: defaults.get(one.name, 1) for one in given})
    if not isinstance(cast("object", base), Policy):
        raise ProblemError(
            f"{name} is a function that returns {quoted(base)}; expected a function that returns a Policy"
        )
    tuning = tuple(_tuning(one) for one in given[:1])
    return _problem(base, function, "the given function", defaults, tuning)


def _tuning(one: inspect.Parameter) -> TradeoffParameter:
    whole = one.annotation in (int, "int")
    return TradeoffParameter(one.name, least=float(whole), whole=whole)


def _problem(
    base: Policy,
    function: Callable[..., Policy],
    goal: str,
    parameters: Mapping[str, Any],
    tuning: tuple[TradeoffParameter, ...] = (),
) -> Problem:
    kind = BareKind(base.kind, function, goal, tuning, base=base, several_nodes=True)
    plant, cost, network = own_problem(base)
    return Problem(plant, cost, network, kind.name, parameters, own=kind)


@dataclass(frozen=True)
class _Given:
    """A function without parameters that returns a policy; it can be pickled."""

    policy: Policy

    def __call__(self) -> Policy:
        """Return the policy."""
        return self.policy


@dataclass(frozen=True, eq=False, repr=False)
class BareKind(Kind):
    """Kind of a policy for which no problem is given. Its design function is the user's, with the parameters only."""

    base: Policy | None = None  # the policy that determines plant, cost and network

    @cached_property
    def arguments(self) -> Mapping[str, inspect.Parameter]:
        """The parameters of the user's function, and the argument ``network``, which the function does not receive."""
        keyword = inspect.Parameter.KEYWORD_ONLY
        own = [one.replace(kind=keyword) for one in inspect.signature(self.design).parameters.values()]
        return {one.name: one for one in (*own, inspect.Parameter("network", keyword))}

    @property
    def in_house(self) -> bool:
        """False, because policy or function are the user's."""
        return False

    @property
    def identity(self) -> str:
        """Text that identifies the policy in stored results: its kind and its fingerprint."""
        assert self.base is not None
        return f"{self.name} {fingerprint(self.base, self.base.network):016x}"

    @property
    def remedy(self) -> str:
        """The remedy in an error message if a policy has no tuning parameter."""
        return "a function that returns the policy for a parameter"

    @cached_property
    def hints(self) -> Mapping[str, Any]:
        """Types of the parameters. Empty, because the user's function checks its arguments itself."""
        return {}

    def call(self, plant: Plant | ContinuousPlant, cost: Cost, given: Mapping[str, Any]) -> AnyPolicy:
        """Call the user's function with the given parameters; return its policy."""
        return self.design(**{name: value for name, value in given.items() if name != "network"})


PASSED = "TACITURN_PASSED_PROBLEM"  # environment variable of the started processes: the file with the problem


def pass_problem(problem: Problem, folder: Path) -> dict[str, str]:
    """Write a problem to a private folder. Return the environment variable that names it to a child process."""
    path = folder / "problem.pickle"
    path.write_bytes(pickle.dumps(problem))
    return {PASSED: str(path)}


def passed_problem(file: str) -> Problem | None:
    """Read the problem that the parent process has written to ``file``. Return None if it has not written this file.

    Reading a pickle executes code, so a file is read only if the environment of this process names it.
    """
    if os.environ.get(PASSED) != file:
        return None
    found: Problem = pickle.loads(Path(file).read_bytes())
    return found
