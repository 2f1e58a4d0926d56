"""The record of a policy kind: its design function, and all that the library and its pages say about the kind."""

from __future__ import annotations

import hashlib
import inspect
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_type_hints

from taciturn._arrays import quoted
from taciturn._display import Displayed
from taciturn.errors import ProblemError, TaciturnError

if TYPE_CHECKING:
    from taciturn.model.cost import Cost
    from taciturn.model.plant import ContinuousPlant, Plant
    from taciturn.model.policy import Policy
    from taciturn.renewal.policy import EventPolicy, OptimalPolicy

AnyPolicy: TypeAlias = "Policy | EventPolicy | OptimalPolicy"
Setting: TypeAlias = float | int | str
PlantClass = Literal["discrete", "continuous", "outputs", "jumps"]
CostClass = Literal["average", "horizon", "discount"]
FollowedClass = Literal["constant", "changing"]
REPAIR = "; expected a policy of this kind, or a ProblemError: repair or remove the package"
ANY_PLANT: tuple[PlantClass, ...] = ("discrete", "continuous", "outputs", "jumps")


@dataclass(frozen=True, repr=False)
class TradeoffParameter(Displayed):
    """The main parameter of a policy kind, by which the cost of the policy is traded against its send rate.

    Args:
        name: key of ``[policy]``; if several of the kind's parameters are given, the first is varied.
        link: the link whose rate the parameter changes; default the only link that the policy decides.
        least: lower limit, which an integer parameter may equal and a real parameter must exceed.
        whole: whether the parameter is an integer.
        falls: whether the rate decreases when the parameter increases.
        continuous: whether it applies to continuous-time plants (True), discrete-time plants (False) or both (None).
        cycles: whether the parameter may also be a list of integers; the exact costs select the best list.
    """

    name: str
    link: str | None = None
    least: float = 0.0
    whole: bool = False
    falls: bool = True
    continuous: bool | None = None
    cycles: bool = False


@dataclass(frozen=True, eq=False, repr=False)
class Kind(Displayed):
    """A policy kind. The parameters of the kind are the keyword-only arguments of its design function.

    The docstring of the design function describes the kind, its parameters (``Args``) and its sources (``Source``).

    Args:
        name: name of the kind in problem files: small letters, digits and hyphens.
        design: function of a plant, a cost and the parameters that returns the policy.
        goal: purpose of the kind, in one phrase.
        tuning: the parameters that trade cost for rate.
        example: values of the parameters for the example of the kind.
        built_in: built-in problem of the example.
        nodes: nodes of the policy: S, C and A are sensor, controller and actuator; a plus joins nodes at the same site.
        plants: properties that the plant may have: ``"discrete"`` or ``"continuous"`` time, ``"outputs"`` with noise
            instead of a measured state, and ``"jumps"``.
        costs: the costs that the design supports: an ``"average"``, a finite ``"horizon"``, a ``"discount"``.
        follows: the set-points of a plant that the design supports: ``"constant"`` ones, which include disturbances,
            and ``"changing"`` ones, at random times or by a timetable. A given controller states its own.
        proved: the proved result, in Markdown.
        relative_to: the control whose cost the bound refers to, in Markdown.
        refused: further conditions under which the design refuses a problem, in Markdown.
        data: data of the policy beyond the matrices, in Markdown.
        order: order of the operations within a step, in Markdown.
        usual: suggested values by parameter. ``taciturn new`` suggests them for the parameters that it asks for, and
            writes those of optional parameters without a question.
        asked: optional parameters that ``taciturn new`` asks for, since the design needs one of several parameters.
        offered: position among the goals that ``taciturn new`` lists; None if the kind is not listed there.
        requires: the condition on plant and cost as a phrase, for messages.
        check: function that raises a ``ProblemError`` if the kind does not support a plant and a cost.
        several_nodes: whether the design takes networks of several sensors or actuators.
        joint_links: whether the controller decides on sets of links to several actuators; then the design is that of
            one actuator, and ``taciturn.model.joint`` derives the decision on sets.
        ideal_links: whether the design takes a network, but refuses links that drop or delay packets.
        shares: the parameter that divides a threshold among several links, if there is one.
        for_dropouts: whether ``taciturn new`` offers the kind for links that drop packets.
        keeps_controller: whether the argument ``controller`` of the design is a controller that the user has.

    Raises:
        ProblemError: if the name has other characters.
    """

    name: str
    design: Callable[..., AnyPolicy]
    goal: str
    tuning: tuple[TradeoffParameter, ...] = ()
    example: Mapping[str, Any] = field(default_factory=lambda: {})
    built_in: str = "two-mass"
    nodes: str = "S+C, A"
    plants: tuple[PlantClass, ...] = ANY_PLANT
    costs: tuple[CostClass, ...] = ("average",)
    follows: tuple[FollowedClass, ...] = ("constant", "changing")
    proved: str = "no bound"
    relative_to: str = "—"
    refused: str = ""
    data: str = "—"
    order: str = "—"
    usual: Mapping[str, Setting] = field(default_factory=lambda: {})
    asked: tuple[str, ...] = ()
    offered: int | None = None
    requires: str = ""
    check: Callable[[Plant | ContinuousPlant, Cost], object] | None = None
    keeps_controller: bool = False
    for_dropouts: bool = False
    several_nodes: bool = False
    joint_links: bool = False
    ideal_links: bool = False
    shares: str | None = None

    def __post_init__(self) -> None:
        """Check the name."""
        if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", self.name):
            raise ProblemError(
                f"the name of the policy kind is {self.name!r}; expected small letters and digits, with hyphens "
                "between words"
            )

    def summary(self) -> Mapping[str, object]:
        """Return the name, the goal and the parameters of the kind."""
        return {"name": self.name, "goal": self.goal, "parameters": tuple(self.parameters)}

    def short(self) -> str:
        """Return the name of the kind."""
        return self.name

    @cached_property
    def arguments(self) -> Mapping[str, inspect.Parameter]:
        """All arguments of the design function by name."""
        return inspect.signature(self.design).parameters

    @cached_property
    def parameters(self) -> Mapping[str, inspect.Parameter]:
        """The parameters of the kind: the keyword-only arguments except those that files state in other tables."""
        given = self.arguments.items()
        return {name: one for name, one in given if one.kind is one.KEYWORD_ONLY and name not in self.tables}

    @cached_property
    def tables(self) -> tuple[str, ...]:
        """The arguments that files state in tables of their own: network, reference, and a controller to keep."""
        names = ("network", "reference", *(("controller",) if self.keeps_controller else ()))
        return tuple(name for name in names if name in self.arguments)

    @property
    def identity(self) -> str:
        """The place of the design function, and outside of this package a digest of its code, for stored results."""
        return self._place if self.in_house else f"{self._place} {code_digest(self.design.__module__)}"

    @property
    def remedy(self) -> str:
        """The remedy in the message that the kind has no tuning parameter."""
        return "another policy kind, such as lqg"

    @cached_property
    def hints(self) -> Mapping[str, Any]:
        """The types of the arguments of the design function by name."""
        return get_type_hints(self.design)

    def make(self, plant: Plant | ContinuousPlant, cost: Cost, given: Mapping[str, Any]) -> AnyPolicy:
        """Return the policy for a plant, a cost and further arguments of the design function.

        Raises:
            ProblemError: the record does not list the class of the plant or of the cost, or the design function of
                another package fails or returns no policy of this kind.
        """
        design = f"the design function {self._place} of the policy kind {self.name}"
        unlisted = None if self.in_house else self._unlisted(plant, cost)  # the designs of this package check
        try:
            policy = self.design(plant, cost, **given)
        except TaciturnError:
            raise
        except Exception as error:
            if unlisted is None and self.in_house:
                raise
            raise ProblemError(unlisted or f"{design} fails ({type(error).__name__}: {error})" + REPAIR) from error
        if unlisted is not None:
            raise ProblemError(unlisted)
        if getattr(policy, "kind", None) != self.name:
            raise ProblemError(f"{design} returns {quoted(policy)}" + REPAIR)
        return policy

    @property
    def in_house(self) -> bool:
        """True if the design function belongs to this package."""
        return self.design.__module__.startswith("taciturn.")

    @property
    def _place(self) -> str:
        return f"{self.design.__module__}:{self.design.__qualname__}"

    def _unlisted(self, plant: Plant | ContinuousPlant, cost: Cost) -> str | None:
        """Return a sentence if the record does not list a class of the plant or of the cost, else None."""
        continuous = not hasattr(plant, "dt")
        classes: dict[str, tuple[bool, str]] = {
            "discrete": (not continuous, "the plant is in discrete time"),
            "continuous": (continuous, "the plant is in continuous time"),
            "outputs": (not plant.full_state, "the plant has outputs with noise (plant.C)"),
            "jumps": (getattr(plant, "jumps", None) is not None, "the plant has jumps (plant.jumps)"),
            "average": (not cost.mission, "the cost is an average"),
            "horizon": (cost.horizon is not None, "the cost has a horizon (cost.horizon)"),
            "discount": (cost.discount < 1, "the cost is discounted (cost.discount)"),
        }
        for name, (has, what) in classes.items():
            if has and name not in (*self.plants, *self.costs):
                return f"{what}, which {self.name} does not support; expected another problem, or another policy kind"
        return None

    @property
    def about(self) -> str:
        """The first sentence of the docstring of the design function, as a phrase."""
        return self._text.partition("\n")[0].removeprefix("Design ").rstrip(".:")

    @cached_property
    def notes(self) -> Mapping[str, str]:
        """The description of each argument, from the docstring of the design function."""
        section = re.search(r"\nArgs:\n(.*?)\n\n", self._text, re.DOTALL)
        text = section[1] + "\n" if section else ""
        found = re.findall(r"^    (\w+): (.*?)(?=^    \w+:|\Z)", text, re.M | re.S)
        return {name: " ".join(note.replace("`", "").split()).rstrip(".") for name, note in found}

    @property
    def sources(self) -> tuple[str, ...]:
        """The keys of ``docs/sources.bib`` in the docstring of the design function."""
        found = re.search(r"Source:\s*(.+)", self._text)
        return tuple(re.split(r"[,;]\s*", found[1].strip())) if found else ()

    @property
    def _text(self) -> str:
        return inspect.getdoc(self.design) or ""


@cache
def code_digest(module: str) -> str:
    """Return a digest of the Python files of the package that contains a module, or of its own file."""
    top = sys.modules[module.partition(".")[0]]
    paths = [Path(folder) for folder in getattr(top, "__path__", [])]
    files = [file for path in paths for file in sorted(path.rglob("*.py"))] or [Path(top.__file__ or "")]
    read = hashlib.sha256()
    for file in files:
        read.update(file.read_bytes() if file.is_file() else b"")
    return read.hexdigest()
