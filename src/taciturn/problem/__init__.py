"""Problem files in TOML: reading, checks that name a mistake and its place, and the class of a problem.

A file comes in, and a ``Problem`` goes out: plant, cost, network, and the kind and parameters of a policy. Three checks
follow each other, and an error names the file, the key, the given value and the remedy:

1. ``schema`` checks names and types of all keys. An unknown key is an error, so that a misspelt key is never ignored.
2. The classes of ``taciturn.model`` check shapes and values. A ``Problem`` that is built in Python gets the same check.
3. The design function of the kind declares its parameters (``parameters``). An argument that it ignores is an error.

A problem keeps the tables of its file. ``Problem.changed`` changes single keys of them, reads the changed tables again,
and keeps everything else; ``--set`` and ``--over`` use it. A plant may name a Python function (``read``).

Matrices are also read from files of other programs (``matlab_and_numpy``), and values of keys, and loads of the
simulated plant, from options of the command line (``settings``, ``loads``); ``write`` writes tables as a file.
``without_file`` makes problems of policies and of functions that return one.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Mapping
from copy import copy
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from taciturn._arrays import Array as Array
from taciturn._arrays import instance, quoted
from taciturn._display import Displayed
from taciturn._files import read_text, why_unreadable
from taciturn._modes import pace
from taciturn._plugins import problem_folders
from taciturn._progress import OutOfTime
from taciturn._text import backslash_text
from taciturn.design.catalogue import CATALOGUE, own_kinds
from taciturn.design.kind import AnyPolicy, Kind
from taciturn.errors import PlacementError, ProblemError, TaciturnError
from taciturn.loop import Loop, close
from taciturn.model.controller import AnyController
from taciturn.model.cost import Cost
from taciturn.model.coverage import SIMULATED
from taciturn.model.disturbance import Reference
from taciturn.model.dynamics import Dynamics
from taciturn.model.information import check_network
from taciturn.model.limits import Limits
from taciturn.model.link import IDEAL_LINK
from taciturn.model.names import Names
from taciturn.model.network import Network
from taciturn.model.plant import ContinuousPlant, Plant, set_names
from taciturn.model.plant import Jumps as Jumps
from taciturn.model.policy import Policy
from taciturn.model.transport import delayed_by, transport_of, with_transport
from taciturn.problem.parameters import check_parameters, find_kind, read_policy
from taciturn.problem.read import (
    NAMING,
    UNITS,
    actual_of,
    controller_of,
    cost_of,
    expect_argument,
    functions_of,
    limits_of,
    locate_functions,
    names_of,
    network_of,
    plant_of,
    refuse_functions,
    trajectory_in,
    used_tables,
    with_exosystem,
    without_names,
)
from taciturn.problem.read import read_function as read_function
from taciturn.problem.schema import File, ValidationError, first_mistake, suggest, validate
from taciturn.renewal.without_steps import PolicyWithoutSteps, nodes_of

# tables from which a problem reads each of its attributes; attributes of unchanged tables are not read again
PARTS: dict[str, tuple[str, ...]] = {
    "plant": ("plant", "disturbance", "reference", "names"),
    "actual": ("plant", "disturbance", "reference"),
    "network": ("network", "nodes", "links"),
    "limits": ("limits", "plant", "names"),
    "names": ("names", "plant"),
    **{name: (name,) for name in ("cost", "reference", "controller")},
}
TABLES = frozenset(one.name for one in fields(File)) - {"policy"}  # tables of a file that are replaced as a whole
SHORT, USUAL, LONG = 1e-5, 0.1, 1e3  # movement of a plant, by its state, within a short, a usual and a long period
LARGEST = 2**24  # bytes of a problem file
CHANGED = "the changed problem"  # name of a changed problem in messages


@dataclass(frozen=True, eq=False, repr=False)
class Problem(Displayed):
    """A control problem: a plant, a cost, a network, and a policy kind with its parameters.

    Args:
        plant: the plant for which the policy is designed.
        cost: the cost.
        network: the network, ``Network()`` for ideal links.
        kind: name of the policy kind.
        parameters: parameters of the policy; default none.
        actual: the simulated plant, if it differs from ``plant``.
        reference: the reference to track, or None.
        controller: the controller to keep, or None.
        source: tables of the problem file, needed to change single keys.
        name: name of the problem file, for messages.
        own: the policy kind, if the catalogue does not contain it.
        limits: limits of the states, whose probability of violation is computed, or None.
        names: names of states, inputs and outputs, or None for those of the plant, which has them too.

    Raises:
        ProblemError: if ``network`` is not a Network, the policy kind is unknown, limits or names do not fit the plant,
            or the plant has other names.
    """

    plant: Plant | ContinuousPlant
    cost: Cost
    network: Network
    kind: str
    parameters: Mapping[str, Any] = field(default_factory=lambda: {})
    actual: Plant | ContinuousPlant | None = None
    reference: Reference | None = None
    source: Mapping[str, Any] | None = None
    name: str = ""
    own: Kind | None = None
    controller: AnyController | None = None
    limits: Limits | None = None
    names: Names | None = None

    def __post_init__(self) -> None:
        """Check the network and the policy kind; the parameters are checked by the design."""
        instance("network", self.network, Network)
        instance("own", self.own or self.record, Kind)
        self._share_names()
        for name in ("plant", "actual"):
            stated = getattr(self, name)
            transport = None if stated is None else transport_of(stated, self.network)
            if stated is not None and stated.transport != transport:
                object.__setattr__(self, name, with_transport(stated, transport))
        if self.limits is not None:
            instance("limits", self.limits, Limits)
            self.limits.expect_states(len(self.plant.A))
            if self.names and not self.limits.quantities:
                C = self.plant.C[:0] if self.plant.D is not None else self.plant.C
                told = self.names.quantities(self.limits.outputs, C)
                object.__setattr__(self, "limits", Limits(self.limits.outputs, self.limits.low, self.limits.high, told))

    def _share_names(self) -> None:
        """Give the names of the signals to the plant, or take those of the plant."""
        if self.names is not None:
            named = copy(self.plant)
            set_names(named, self.names)
            if self.plant.names is not None and self.plant.names != named.names:
                raise ProblemError(
                    "names are given, and the plant has other names; expected the names in one of the two: "
                    "names=None, or a plant without names"
                )
            object.__setattr__(self, "plant", named)
        object.__setattr__(self, "names", self.plant.names)

    @property
    def record(self) -> Kind:
        """The record of the problem's policy kind: design function, parameters, and description."""
        return self.own if self.own is not None and self.own.name == self.kind else find_kind(self.kind)

    def summary(self) -> Mapping[str, object]:
        """Return the values to display: policy kind, parameters, plants, cost, network, reference and limits."""
        return {
            "kind": self.kind,
            "parameters": self.parameters,
            "plant": self.plant.short(),
            "actual": None if self.actual is None else self.actual.short(),
            "cost": self.cost.short(),
            "network": self.network.short(),
            "reference": self.reference,
            "controller": self.controller,
            "limits": self.limits,
            "names": self.names,
        }

    def short(self) -> str:
        """Return the policy kind."""
        return self.kind

    def design(self) -> Policy:
        """Design the policy; return it as policy steps of nodes that exchange packets.

        Raises:
            ProblemError: if a parameter is unknown, missing or out of range, the policy does not support the network,
                or it is triggered in continuous time.
        """
        policy = self.designed()
        if isinstance(policy, PolicyWithoutSteps):
            raise ProblemError(policy.why_it_cannot_run)
        return policy

    def designed(self) -> AnyPolicy:
        """Design the policy. Unlike ``design``, this also works for kinds whose policies nodes cannot run.

        Raises:
            ProblemError: if a parameter is unknown, missing or out of range, or the policy would ignore a part of the
                problem: a network, a link, a reference, an initial state or another plant.
        """
        try:
            return self._designed()
        except TaciturnError as error:
            key = "policy." if re.split("[ .]", str(error))[0] in self.record.parameters else ""
            text = f"{error}{self._others()}" if isinstance(error, PlacementError) else str(error)
            if not isinstance(error, OutOfTime) and (found := self._other_period()) is not None:
                key, text = "policy.", found
            raise type(error)(f"{self.name}: {key}{text}" if self.name else text) from None
        except np.linalg.LinAlgError as error:
            raise ProblemError(
                f"a matrix computation for {self.name or 'the problem'} fails ({error}); expected numbers closer to 1: "
                "scale the problem"
            ) from None

    def _other_period(self) -> str | None:
        """Return a sentence if the period is far from the time scale of the plant and a usual one has a design."""
        period, plant = self.parameters.get("period"), self.plant
        if not isinstance(period, float | int) or not isinstance(plant, ContinuousPlant):
            return None
        rate = pace(plant.A)
        moved = period * rate
        if not 0 < moved < np.inf or SHORT <= moved <= LONG:
            return None
        try:
            replace(self, parameters={**self.parameters, "period": USUAL / rate})._designed()
        except TaciturnError:
            return None
        many = f"by {moved:.1g} of its state" if moved < 1 else f"through {moved:.1g} times its fastest time constant"
        longer = "longer" if moved < 1 else "shorter"
        return (
            f"period is {period:g} s, in which the plant moves {many}, so rounding hides its modes; expected a "
            f"{longer} period, such as {USUAL / rate:.1g} s"
        )

    def _expect_own(self, parameters: Mapping[str, object], given: Collection[str]) -> None:
        """Raise a ``ProblemError`` if another kind is given, and a parameter of the present kind is not one of it."""
        kind = parameters.get("kind", self.kind)
        if kind == self.kind or not isinstance(kind, str) or kind not in CATALOGUE:
            return
        known = find_kind(kind).parameters
        for key in (key for key in self.parameters if key in parameters and key not in (*known, *given)):
            raise ProblemError(
                f"in {CHANGED}, policy.kind is {kind!r}, which has no parameter {key}; expected no {key}: remove it "
                f"with --set {key}=none, or with None in Python"
            )

    def _others(self) -> str:
        """Return the other kinds that accept plant, cost, network, reference and controller, as the end of a remedy."""
        found = list[str]()
        for name in (name for name in own_kinds() if name != self.kind and "network" in CATALOGUE[name].tables):
            example = {key: value for key, value in CATALOGUE[name].example.items() if key != "period"}
            period = {key: value for key, value in self.parameters.items() if key == "period"}
            try:
                replace(self, kind=name, parameters={**example, **period}, own=None)._designed()
            except TaciturnError:
                continue
            found.append(name)
        return f", or the kind {' or '.join(found)}" if found else ""

    def _designed(self) -> AnyPolicy:
        SIMULATED.check(self.plant, self.actual, self.cost, self.network, self.reference)
        kind = self.record
        parameters = check_parameters(kind, self.parameters)
        used = used_tables(kind, {"reference": self.reference, "controller": self.controller})
        policy = kind.make(self.plant, self.cost, self.network, {**used, **parameters})
        _expect_packets(policy, self.network)
        if isinstance(policy, Policy):
            check_network(policy, self.network.played())
        else:
            given = {"[plant.actual]": self.actual is not None, "network.payload": self.network.rounded}
            given |= {"[[disturbance]] with a load": bool(self.plant.loads)}
            given |= {f"links.{node}.missing": True for node in self.network.missing}
            policy.refuse(given | {" or ".join(IDEAL_LINK.intervals): self.network.limited})
        return policy

    def close(self, policy: Policy) -> Loop:
        """Close the loop of a policy with the plant that this problem simulates."""
        loop = close(self.actual or self.plant, policy, self.network, self.cost)
        plain = {key: str(value) for key, value in self.parameters.items() if isinstance(value, int | float | str)}
        return replace(loop, limits=self.limits, names=self.names, settings={**plain, "file": Path(self.name).name})

    @property
    def nonlinear(self) -> bool:
        """True if the simulated plant is a nonlinear function, of which A and B are only the linearisation."""
        plant = self.actual or self.plant
        return isinstance(plant, Plant) and plant.function is not None

    def changed(self, values: Mapping[str, object]) -> Problem:
        """Return a copy of the problem with new values of keys: ``[policy]`` keys, or dotted keys such as ``plant.dt``.

        None removes a key, or a table such as ``controller``; a value of a table's name replaces the table.

        Raises:
            ProblemError: if a key does not exist or a value is invalid.
        """
        parameters, tables, touched = dict(self.parameters), _copied(self.source or {}), set[str]()
        instance("values", values, Mapping)
        for name, value in values.items():
            *path, key = str(name).split(".")
            divided = path[1:] if path[:1] == ["policy"] else path  # such as shares.level-1
            if len(divided) == 1 and _holds_numbers(self.record, divided[0]):
                held = {**cast("Mapping[str, object]", parameters.get(divided[0]) or {}), key: value}
                parameters[divided[0]] = {one: number for one, number in held.items() if number is not None}
            elif isinstance(value, Mapping | list | None) and name in (TABLES if value and self.source else tables):
                tables[name] = value
                touched.add(name)
            elif not path or path == ["policy"]:
                parameters[key] = value
            elif path[0] == "policy":
                raise ProblemError(
                    f"{name} is not a key of a problem; expected a key of [policy], such as policy.{path[1]}"
                )
            elif self.source is None:
                raise ProblemError(
                    f"the key {name} cannot be changed in a problem that was not read from a file; expected a key of "
                    "[policy]"
                )
            else:
                table = around = tables
                touched.add(path[0])
                for part in path:
                    around = table
                    found: object = table.setdefault(part, {})
                    if not isinstance(found, dict):
                        got = f"{part} is {quoted(found)}"
                        raise ProblemError(
                            f"{name} is not a key of a problem file: {got}; expected a key such as plant.dt"
                        )
                    table = cast("dict[str, Any]", found)
                table[key] = value
                if value is None:
                    del table[key]
                    if not table and len(path) > 1:  # such as links.level, which a node without a link may not have
                        del around[path[-1]]
        parameters = {key: value for key, value in parameters.items() if value is not None}
        self._expect_own(parameters, {str(name).removeprefix("policy.") for name in values})
        tables = {name: table for name, table in tables.items() if table is not None}
        tables |= {"policy": {"kind": parameters.pop("kind", self.kind), **parameters}}
        if touched:
            naming = ("names", *(f"plant.{key}" for key in (*NAMING, UNITS)))
            named = any(f"{name}.".startswith(f"{key}.") for name in values for key in naming)
            parsed = parse(tables, CHANGED, functions_of(self.plant, self.actual), self.own, named)
            kept = [name for name, read in PARTS.items() if touched.isdisjoint(read)]
            return replace(parsed, **{name: getattr(self, name) for name in kept})
        kind, parameters = read_policy(tables["policy"], CHANGED, self.own)  # plant, cost and network are unchanged
        source = None if self.source is None else tables
        return replace(self, kind=kind, parameters=parameters, source=source, name=CHANGED)


def _holds_numbers(record: Kind, name: str) -> bool:
    """Return whether a parameter of a kind is a table of numbers by name, of which single entries can be changed."""
    return name in record.parameters and "dict[" in str(record.hints.get(name))


def load(path: str | Path, *, functions: bool = True) -> Problem:
    """Load a problem from a problem file, or a built-in problem by its name.

    Reading a problem with ``plant.function`` executes the Python file that it names.

    Args:
        path: a TOML file, or a name such as ``"two-mass"``.
        functions: whether the problem may name functions; False for files from strangers.

    Returns:
        The problem.

    Raises:
        ProblemError: if the file does not exist or is not TOML, a key is unknown or missing, the data are inconsistent,
            or the file names a function and ``functions`` is False.

    Example:
        >>> load("two-mass-lqg").kind
        'lqg'
    """
    instance("path", path, str, Path)
    file = Path(path)
    try:
        if not file.is_file():
            names = (folder / f"{path}.toml" for folder in problem_folders())
            file = next((found for found in names if found.name == f"{path}.toml" and found.is_file()), file)
        tables = tomllib.loads(read_text(file, LARGEST))
    except FileNotFoundError:
        built_in = sorted(found.stem for folder in problem_folders() for found in folder.glob("*.toml"))
        raise ProblemError(
            f"there is no file {str(path)!r}; expected a problem file, or one of the built-in problems "
            f"{', '.join(built_in)}{suggest(str(path), built_in)}"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ProblemError(
            f"the problem file {str(path)!r} cannot be read ({why_unreadable(error)}); expected a TOML file"
        ) from None
    except RecursionError:
        raise ProblemError(
            f"{path} is not valid TOML: its values are nested too deeply; expected tables whose values are at most "
            "matrices"
        ) from None
    except ValueError as error:  # errors of tomllib, and integers that are too long for Python
        raise ProblemError(
            f"{path} is not valid TOML: {error}; expected the format of docs/problem-file"
            f"{backslash_text('', str(error))}"
        ) from None
    if not functions:
        refuse_functions(tables, str(path))
    return parse(locate_functions(tables, file.parent), str(path))


def parse(
    tables: Mapping[str, Any],
    name: str,
    known: Mapping[str, Dynamics] | None = None,
    own: Kind | None = None,
    named: bool = True,
) -> Problem:
    """Make a problem from the tables of a problem file.

    Unless ``named`` is true, names of signals that the plant does not have are left out: a changed plant may have fewer
    outputs and inputs than the plant of the file.
    """
    try:
        file: File = validate(File, tables)
    except ValidationError as error:
        raise ProblemError(f"{name}: {first_mistake(error, File)}") from None
    kind, parameters = read_policy(file.policy, name, own)
    try:
        record = own if own is not None and own.name == kind else find_kind(kind)
        trajectory = trajectory_in(file.reference)
        stated = {"reference": trajectory, "controller": file.controller}
        for part in (part for part, given in stated.items() if given is not None):
            expect_argument(record, part, f"[{part}]", f"no {part}: remove it")
        names = names_of(file) if named else None
        plant, simulated = plant_of(file.plant, known or {}, names=names), file.plant.get("actual")
        actual = None if simulated is None else actual_of(simulated, file.plant, plant, known or {})
        controller = (
            None if file.controller is None else controller_of(file.controller, plant, file.reference is not None)
        )
        network = network_of(file, record, plant)
        cost = cost_of(file.cost, delayed_by(plant, network), controller, parameters.get("period"))
        points = file.reference if trajectory is None else None
        plant = with_exosystem(plant, file.plant, file, points, network)
        if simulated is not None and actual is not None:
            actual = with_exosystem(actual, simulated, file, points, network)
        reference = None if trajectory is None else Reference(**trajectory)
        source = _copied(tables)
        if not named:
            source = without_names(source, plant)
            names = names_of(validate(File, source))
        limits = limits_of(file.limits, plant)
        return Problem(
            plant, cost, network, kind, parameters, actual, reference, source, name, own, controller, limits, names
        )
    except TaciturnError as error:
        raise type(error)(f"{name}: {error}") from None


def _expect_packets(policy: AnyPolicy, network: Network) -> None:
    """Raise a ``ProblemError`` if an energy is given for a link on which the policy decides on no packet."""
    nodes = nodes_of(policy)
    carrying = ("sensor",) if nodes is None else nodes.scheduled
    for link in (link for link, law in network.links.items() if law.energy is not None and link not in carrying):
        raise ProblemError(
            f"{network.key(link, 'energy')} is given, but the policy {policy.kind} makes no send decisions on the "
            f"{link} link; expected the energy of a packet on the {' and '.join(carrying)} link"
        )


def _copied(tables: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: _copied(cast("Mapping[str, Any]", value)) if isinstance(value, Mapping) else value
        for key, value in tables.items()
    }
