"""Conversion of the tables of a problem file to a plant, a cost, a network and other objects.

``schema`` checks each table by itself. Here, in the order of this file, they become the parts of a problem:

* ``[reference]`` is a trajectory or set-points; set-points and ``[[disturbance]]`` become signals that act on the plant
  (``with_exosystem``), with a timetable from a file, or a disturbance for each output that has integral action.
* ``plant.function`` names a Python function as ``file.py:name``. Reading it executes the file, unless functions are
  refused. Relative paths start at the folder of the problem file.
* ``[plant]`` and ``[plant.actual]`` have the same time base and sizes. The names of signals are those of ``[plant]``,
  or of the older table ``[names]``; a changed plant loses names that do not fit.
* ``[cost]`` states weights, variances (Bryson's rule), or weights by the present loop of ``[controller]``.
* ``[controller]`` states gains, matrices or a file, with the sign of its feedback: u = −(C z + D y) by default.
* ``[limits]`` are of the measured outputs if it states no others.
* ``[nodes]`` and ``[links]`` are the graph of the network. ``[network]`` is a short form of three nodes; it is read as
  their links, and the network remembers its keys for messages.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from inspect import Parameter
from math import isfinite, nan
from pathlib import Path
from typing import Any, cast

import numpy as np

from taciturn._arrays import Array, ArrayLike, array, quoted
from taciturn._files import read_text, why_unreadable
from taciturn._modes import pace
from taciturn._text import backslash_text, number_of
from taciturn.base.given_controller import cost_as_now
from taciturn.design.catalogue import CATALOGUE, own_kinds
from taciturn.design.kind import Kind
from taciturn.errors import ProblemError
from taciturn.lqg.followed import regulator_equations
from taciturn.model.controller import PID, AnyController, ContinuousController, Controller, PIDLoops
from taciturn.model.cost import Cost
from taciturn.model.disturbance import Disturbance, with_target
from taciturn.model.dynamics import Dynamics, dynamics_of
from taciturn.model.key import Rows
from taciturn.model.limits import Limits
from taciturn.model.link import LinkLaw, usual_links
from taciturn.model.losses import USUAL, LossLaw, find_law
from taciturn.model.names import Names, Role
from taciturn.model.network import SHORT, Network, NodeRole
from taciturn.model.noise import Noise
from taciturn.model.operating_point import MovedDynamics, OperatingPoint
from taciturn.model.plant import ContinuousPlant, Inverse, Jumps, Plant
from taciturn.model.saturation import Saturation
from taciturn.model.signals import Changes, ExternalDisturbance, RandomSteps, SetPoint, Timetable, set_point_limits
from taciturn.problem.matlab_and_numpy import read_controller
from taciturn.problem.schema import (
    ControllerKeys,
    CostKeys,
    EntryKeys,
    File,
    LimitsKeys,
    NetworkTable,
    PIDKeys,
    PlantKeys,
    ReferenceKeys,
    ValidationError,
    first_mistake,
    validate,
)

LARGEST_TIMETABLE = 2**24  # bytes of a timetable: more than 500,000 set-points
SLOW = 1e-3  # distance from a mode of a constant, relative to the pace of the plant
SHARE, STEPS = 0.5, 1000.0  # a disturbance of integral action moves by this share of the input noise in so many steps


def trajectory_in(table: ReferenceKeys | None) -> ReferenceKeys | None:
    """Return the table ``[reference]`` if it states a trajectory; None if it states set-points, or is missing."""
    both = ("states", "inputs")
    if table is None or not table.keys() & set(both):
        return None
    for name in (name for name in both if name not in table):
        raise ProblemError(f"the key reference.{name} is missing; expected both reference.states and reference.inputs")
    for name in (name for name in table if name not in both):
        raise ProblemError(
            f"reference.{name} is given with reference.states; expected either a trajectory (states, inputs) or "
            "set-points"
        )
    return table


def with_exosystem(
    plant: Plant | ContinuousPlant, table: PlantKeys, file: File, points: ReferenceKeys | None, network: Network
) -> Plant | ContinuousPlant:
    """Extend the state of a plant by the disturbances and set-points that a problem file states."""
    if points is None and not file.disturbance:
        return plant
    stated: dict[str, Any] = dict(points or {})
    names = ("integral_action", "steps", "file", "range", "ramp")
    nodes, _, _, within, ramp = (stated.pop(name, None) for name in names)
    if nodes == []:
        raise ProblemError(
            "reference.integral_action is empty; expected the names of nodes that measure, or no such key"
        )
    acting = None if nodes is None else _outputs_of(nodes, plant, network)
    if "outputs" not in stated:
        rows = np.arange(len(plant.C)) if acting is None else np.array(acting)
        stated |= {"outputs": plant.C[rows], "D": None if plant.D is None else plant.D[rows]}
    size = len(array("reference.outputs", stated["outputs"], (None, None), "(set-points, states)"))
    limits = set_point_limits(size, within, ramp)
    changes = None if points is None else changes_of(points, limits)
    given = [_disturbance(place, one, table.get("E")) for place, one in enumerate(file.disturbance or ())]
    reads = points is not None and file.controller is not None and not nodes and all(one.hidden for one in given)
    if changes is None and (limits is not None or reads):
        # a given controller reads its set-points, also those that only an operator changes
        changes = RandomSteps(0.0, np.zeros((size, size)), limits)
    target = SetPoint(**stated, changes=changes)
    given += [] if acting is None else _at_inputs(plant, target)
    return with_target(plant, target, given)


def _disturbance(place: int, one: EntryKeys, E: Rows | None) -> ExternalDisturbance:
    """Return the disturbance of a table ``[[disturbance]]``; messages contain its place."""
    try:
        if E is not None:
            moved = Inverse.of(E, np.atleast_2d(E).shape[0]).times("disturbance.enters", np.c_[one["enters"]])
            one = {**one, "enters": moved[:, 0]}
        if (path := one.get("file")) is not None:
            if "steps" in one:
                raise ProblemError("disturbance.steps and disturbance.file are both given; expected only one of them")
            rows = timed_rows("disturbance.file", path, "value")
            one = {**{key: value for key, value in one.items() if key != "file"}, "steps": rows}
        return ExternalDisturbance(**one)
    except ProblemError as error:
        raise ProblemError(str(error).replace("disturbance.", f"disturbance[{place}].")) from None


def changes_of(table: ReferenceKeys, limits: Saturation | None = None) -> Changes | None:
    """Return how the set-points of a table change with time; None if they are constant."""
    if "steps" in table and "file" in table:
        raise ProblemError("reference.steps and reference.file are both given; expected only one of them")
    if "steps" in table:
        return RandomSteps(**table["steps"], limits=limits)
    if "file" not in table:
        return None
    rows = timed_rows("reference.file", table["file"], "set-points")
    return Timetable(rows[:, 0], rows[:, 1:], limits)


def timed_rows(key: str, path: str, noun: str) -> Array:
    """Return the numbers of a file of times, with what is so from each time on."""
    try:
        return _rows(read_text(Path(path), LARGEST_TIMETABLE))
    except (OSError, ValueError) as error:
        raise ProblemError(
            f"{key} {path!r} cannot be read ({why_unreadable(error)}); expected rows of a time and the {noun} from "
            f"then on, separated by commas, without a header{backslash_text(path)}"
        ) from None


def _rows(text: str) -> Array:
    """Return the numbers of a text with commas between columns, (rows, columns)."""
    rows, first = list[list[float]](), 0
    for line, content in enumerate(text.split("\n"), start=1):
        if not (content := content.partition("#")[0].strip()):
            continue
        entries, row = content.split(","), list[float]()
        first = first or line
        if rows and len(entries) != len(rows[0]):
            raise ValueError(
                f"line {line} has {number_of(len(entries), 'column')}, and line {first} has {len(rows[0])}"
            )
        for column, entry in enumerate(entries, start=1):
            try:
                row.append(float(entry.replace("_", "?")))
            except ValueError:
                row.append(nan)
            if not isfinite(row[-1]):
                raise ValueError(
                    f"column {column} of line {line} is {quoted(entry.strip())}, which is not a finite number"
                )
        rows.append(row)
    return np.array(rows).reshape(len(rows), -1) if rows else np.zeros((0, 2))


def _outputs_of(nodes: list[str], plant: Plant | ContinuousPlant, network: Network) -> list[int]:
    """Return the outputs that some nodes measure."""
    measured = dict(network.measurements(len(plant.C)).values())
    for node in (node for node in nodes if node not in measured):
        raise ProblemError(
            f"reference.integral_action names {node!r}; expected nodes that measure: {', '.join(measured)}"
        )
    for node in (node for node in nodes if nodes.count(node) > 1):
        raise ProblemError(f"reference.integral_action names {node!r} twice; expected each node once")
    return [output for node in nodes for output in measured[node]]


def _at_inputs(plant: Plant | ContinuousPlant, target: SetPoint) -> list[ExternalDisturbance]:
    """Return a constant disturbance for each output that has integral action, which enters as the inputs do.

    It enters as the inputs that change this output and no other one, and moves slowly compared with the noise.
    """
    z, n = target.outputs.shape
    weight = np.diag([*np.zeros(n), *np.ones(plant.B.shape[1])])
    moves = np.zeros((z, z)) if plant.continuous else np.eye(z)
    none: Array = np.zeros((n, z))
    _, U = regulator_equations(plant.A, plant.B, moves, none, target.outputs, -np.eye(z), weight, target.D)
    if not U.any(axis=0).all():  # a plant that integrates needs no input at rest: its response near rest decides
        near = SLOW * (pace(plant.A) or 1.0) if plant.continuous else 1.0 + SLOW
        response = target.outputs @ np.linalg.solve(near * np.eye(n) - plant.A, plant.B)
        response += 0.0 if target.D is None else target.D
        U = np.asarray(np.linalg.pinv(response), dtype=np.float64)
    U = U / np.maximum(np.abs(U).max(axis=0), 1e-300)
    inverse = np.asarray(np.linalg.pinv(plant.B @ U), dtype=np.float64)
    seen = np.maximum(np.diag(inverse @ plant.W @ inverse.T), 0.0)
    if not seen.all():
        raise ProblemError(
            "reference.integral_action is given, but some input has no process noise in W, from which the random "
            "changes of the disturbance are computed; expected such noise in W, or a [[disturbance]] with the key "
            "'wander'"
        )
    return [
        ExternalDisturbance(plant.B @ column, SHARE**2 * size / STEPS)  # a random walk: variances add up
        for column, size in zip(U.T, seen.tolist(), strict=True)
    ]


KEY = "function"
LARGEST_CODE = 2**20  # bytes of a Python file


def read_function(named: str, known: Mapping[str, Dynamics]) -> Dynamics:
    """Return the function of a nonlinear plant, named ``file.py:name`` in a problem file; load the file if
    necessary.
    """
    if named in known:
        return known[named]
    path, _, name = named.rpartition(":")
    if not path or not name.isidentifier():
        raise ProblemError(
            f"plant.function is {quoted(named)}; expected 'file.py:name', a Python file and a function in it"
        )
    try:
        text = read_text(Path(path), LARGEST_CODE)
    except (OSError, ValueError) as error:  # ValueError: not UTF-8 text, or a null character in the path
        raise ProblemError(
            f"plant.function names {path!r}, which cannot be read ({why_unreadable(error)}); expected a Python file, "
            f"with a path relative to the folder of the problem file{backslash_text(path)}"
        ) from None
    try:
        return dynamics_of(text, path, name)
    except ProblemError as error:
        raise ProblemError(f"plant.function: {error}") from None


def refuse_functions(tables: Mapping[str, Any], name: str) -> None:
    """Raise an error if the tables of a problem file name a Python function, because to load it is to execute code."""
    for path, table in _tables((), tables):
        if KEY in table:
            raise ProblemError(
                f"in {name}, the key {'.'.join((*path, KEY))} is {quoted(table[KEY])}, which names Python code to "
                "execute, but functions are refused (--no-functions, functions=False); expected a problem without "
                "functions"
            )


def _tables(path: tuple[str, ...], table: Mapping[str, Any]) -> Iterator[tuple[tuple[str, ...], Mapping[str, Any]]]:
    """Yield a table and all tables in it, with their paths."""
    yield path, table
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _tables((*path, key), cast("Mapping[str, Any]", value))


def locate_functions(tables: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Convert relative paths in the tables of a problem file to absolute ones. They are relative to ``folder``."""
    found = dict(tables)
    for key in ("controller", "reference"):
        if isinstance(found.get(key), Mapping):
            found[key] = _located(cast("Mapping[str, Any]", found[key]), folder)
    if isinstance(found.get("disturbance"), list):
        listed = cast("list[Any]", found["disturbance"])
        found["disturbance"] = [
            _located(cast("Mapping[str, Any]", one), folder) if isinstance(one, Mapping) else one for one in listed
        ]
    for key in ("links", "network"):
        if isinstance(found.get(key), Mapping):
            found[key] = _with_delays_located(cast("Mapping[str, Any]", found[key]), folder)
    for key in ("plant", "actual"):  # [plant.actual] is within [plant]
        if isinstance(found.get(key), Mapping):
            found[key] = locate_functions(cast("Mapping[str, Any]", found[key]), folder)
    named = found.get(KEY)
    if isinstance(named, str) and ":" in named:
        path, _, name = named.rpartition(":")
        found[KEY] = f"{(folder / path).absolute()}:{name}"
    return found


def _located(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Convert a relative path of the key ``file`` of a table to an absolute one."""
    path = table.get("file")
    return {**table, "file": str((folder / path).absolute())} if isinstance(path, str) else dict(table)


FILES = ("histogram", "trace")  # keys of laws of delay that name a file


def _with_delays_located(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Convert the relative paths of files of delays, in [links.NAME] or [network], to absolute ones."""
    found = dict(table)
    for key, value in found.items():
        if key in FILES and isinstance(value, str):
            found[key] = str((folder / value).absolute())
        elif isinstance(value, Mapping):
            found[key] = _with_delays_located(cast("Mapping[str, Any]", value), folder)
        elif isinstance(value, list):  # of the laws of several states
            listed = cast("list[Any]", value)
            tables = [cast("Mapping[str, Any]", one) if isinstance(one, Mapping) else None for one in listed]
            pairs = zip(listed, tables, strict=True)
            found[key] = [one if law is None else _with_delays_located(law, folder) for one, law in pairs]
    return found


def functions_of(*plants: Plant | ContinuousPlant | None) -> dict[str, Dynamics]:
    """Return the functions of plants that were read from files, by name ``file.py:name``."""
    found = [plant.function for plant in plants if isinstance(plant, Plant) and plant.function is not None]
    units = [one.function.dynamics if isinstance(one.function, MovedDynamics) else one for one in found]
    return {f"{one.path}:{one.name}": one for one in units if one.text is not None}


GAINS = ("kp", "ki", "kd")


def expect_argument(kind: Kind, name: str, given: str, expected: str) -> None:
    """Raise ``ProblemError`` if a table is given that the design function of the policy kind does not use."""
    if name not in kind.tables:
        raise ProblemError(f"{given} is given, which the policy kind {kind.name} does not use; expected {expected}")


def used_tables(kind: Kind, stated: Mapping[str, object]) -> dict[str, Any]:
    """Return, as arguments, the tables of a problem file that the design function of a policy kind uses."""
    for name in (name for name, value in stated.items() if value is not None):
        expect_argument(kind, name, f"[{name}]", f"no {name}: remove it")
    used = {key: value for key, value in stated.items() if key in kind.tables}
    needed = [name for name in used if kind.arguments[name].default is Parameter.empty]
    for name in (name for name in needed if used[name] is None):
        raise ProblemError(
            f"the table [{name}] is missing, which the policy kind {kind.name} requires; expected this table in the "
            "file"
        )
    return used


def plant_of(
    table: PlantKeys,
    known: Mapping[str, Dynamics],
    usual: OperatingPoint | None = None,
    names: Names | None = None,
) -> Plant | ContinuousPlant:
    """Make a plant from its table, with names. If the table states no operating point, ``usual`` is used."""
    given: dict[str, Any] = {name: value for name, value in table.items() if name not in APART}
    given |= table.get("initial", {})
    given["names"] = names
    if "noise" in given:
        given["noise"] = Noise(**given["noise"])
    given["operating_point"] = OperatingPoint(**given["operating_point"]) if "operating_point" in given else usual
    if "dt" not in given:
        if "function" in given:
            raise ProblemError(
                "plant.function is given without plant.dt; expected dt, the seconds per step of the function: "
                "taciturn.integrate converts a differential equation into such a function"
            )
        if "jumps" in given:
            given["jumps"] = Jumps(**given["jumps"])
        return ContinuousPlant(**given)
    if "jumps" in given:
        raise ProblemError(
            "plant.jumps is given with plant.dt; expected jumps only with a continuous-time plant: remove dt"
        )
    if "W" not in given and ("noise" not in given or given["noise"].input is None):
        raise ProblemError(
            "plant.W is missing; expected the process-noise covariance per step (zeros for none), or plant.noise.input"
        )
    if "function" in given:
        given["function"] = read_function(given["function"], known)
    return Plant(**given)


# keys of the names of signals
NAMING: Mapping[str, Role] = {"state_names": "states", "input_names": "inputs", "output_names": "outputs"}
UNITS = "units"
APART = ("initial", "actual", *NAMING, UNITS)  # keys of [plant] that are no arguments of the plant


def names_of(file: File) -> Names | None:
    """Return the names and units of signals that a file states: those of [plant], or of the table [names]."""
    table = file.plant
    given = [key for key in (*NAMING, UNITS) if key in table]
    if file.names is not None and given:
        raise ProblemError(
            f"[names] and plant.{given[0]} are both given; expected the names and units of signals only in [plant]: "
            "remove [names]"
        )
    if not given:
        return None if file.names is None else Names(**file.names)
    sizes, units = _sizes(table), cast("dict[Role, list[str]]", table.get(UNITS, {}))
    names: dict[str, list[str]] = {key: table[key] for key in NAMING if key in table}
    roles: dict[str, Role] = {**NAMING, **{f"{UNITS}.{role}": role for role in units}}
    for key, listed in {**names, **{f"{UNITS}.{role}": one for role, one in units.items()}}.items():
        role = roles[key]
        if len(listed) != sizes.get(role, len(listed)):
            raise ProblemError(
                f"plant.{key} has {number_of(len(listed), 'entry')}; expected {number_of(sizes[role], 'entry')}, one "
                f"for each of the {role}"
            )
    return Names.stated(**{NAMING[key]: listed for key, listed in names.items()}, units=units)


def _sizes(table: PlantKeys) -> dict[Role, int]:
    """Return the numbers of signals by the matrices of a table; those that are no matrices, the plant refuses."""
    found: dict[str, Array] = {}
    for name in (name for name in "ABC" if name in table):
        rows = cast("list[object]", table[name] if isinstance(table[name], list) else [[table[name]]])
        columns = {len(cast("list[float]", row)) if isinstance(row, list) else 0 for row in rows}
        if len(columns) == 1 and columns != {0}:
            found[name] = np.zeros((len(rows), columns.pop()))
    outputs = found.get("C" if "C" in table else "A")
    sizes: dict[Role, int] = {} if "A" not in found else {"states": len(found["A"])}
    sizes |= {} if "B" not in found else {"inputs": found["B"].shape[1]}
    return sizes if outputs is None else {**sizes, "outputs": len(outputs)}


def without_names(tables: Mapping[str, Any], plant: Plant | ContinuousPlant) -> dict[str, Any]:
    """Return the tables of a changed file without names and units of signals that the changed plant does not have."""
    sizes: dict[Role, int] = {"states": plant.states, "inputs": plant.inputs, "outputs": len(plant.C)}

    def fitting(listed: Mapping[str, Any]) -> dict[str, Any]:
        roles: dict[str, Role] = {**NAMING, **{role: role for role in NAMING.values()}}
        return {key: value for key, value in listed.items() if key not in roles or len(value) == sizes[roles[key]]}

    found = {**tables, "plant": fitting(tables["plant"])}
    if UNITS in found["plant"]:
        found["plant"][UNITS] = fitting(found["plant"][UNITS])
    return {**found, "names": fitting(tables["names"])} if "names" in tables else found


def actual_of(
    table: PlantKeys, stated: PlantKeys, design: Plant | ContinuousPlant, known: Mapping[str, Dynamics]
) -> Plant | ContinuousPlant:
    """Make the simulated plant; check that its sampling period and numbers of signals are those of the design plant."""
    dt = stated.get("dt")
    for key in (key for key in (*NAMING, UNITS) if key in table and table[key] != stated.get(key)):
        raise ProblemError(
            f"plant.actual.{key} is {quoted(table[key])}, and the signals of [plant] have other names or units; "
            f"expected those of [plant], or no {key} in [plant.actual]"
        )
    try:
        plant = plant_of(table, known, design.operating_point)
    except ProblemError as error:
        raise ProblemError(f"[plant.actual]: {error}") from None
    if table.get("dt") != dt:
        got, expected = ("missing" if step is None else f"{step:g} s" for step in (table.get("dt"), dt))
        raise ProblemError(f"plant.actual.dt is {got}, but plant.dt is {expected}; expected the same time step in both")
    for name, axis in (("A", 0), ("B", 1), ("C", 0)):
        got, expected = getattr(plant, name).shape[axis], getattr(design, name).shape[axis]
        if got != expected:
            size = {"A": "state", "B": "input", "C": "output"}[name]
            raise ProblemError(
                f"[plant.actual] has {number_of(got, size)}; expected {number_of(expected, size)}, as in [plant]"
            )
    return plant


def cost_of(table: CostKeys, plant: Plant | ContinuousPlant, controller: AnyController | None, period: object) -> Cost:
    """Make the cost from its table, which states weights or variances, or derives them from the present loop."""
    stated = dict(table)
    short = [name for name in ("output_variance", "input_variance", "weights") if name in stated]
    if not short:
        for name in (name for name in "QR" if name not in stated):
            raise ProblemError(
                f"the key cost.{name} is missing; expected it in the table [cost], or output_variance and "
                "input_variance"
            )
        return Cost(**stated)
    allowed = {"weights"} if "weights" in stated else {"output_variance", "input_variance"}
    ending = {name: stated.pop(name) for name in ("horizon", "terminal", "discount") if name in stated}
    for name in (name for name in stated if name not in allowed):
        raise ProblemError(f"cost.{short[-1]} and cost.{name} are both given; expected only one of them")
    if "weights" in stated:
        if controller is None:
            raise ProblemError(
                f"cost.weights is {stated['weights']!r} without a controller; expected [controller], or Q and R"
            )
        seconds = float(period) if isinstance(period, int | float) else None
        found = cost_as_now(plant, controller, seconds)
        return Cost(found.Q, found.R, found.N, **ending)
    for name in (name for name in ("output_variance", "input_variance") if name not in stated):
        raise ProblemError(f"the key cost.{name} is missing; expected cost.{name} together with cost.{short[0]}")
    found = Cost.of_variances(plant.C, stated["output_variance"], stated["input_variance"], plant.D)
    return Cost(found.Q, found.R, found.N, **ending)


def controller_of(table: ControllerKeys, plant: Plant | ContinuousPlant, follows: bool) -> AnyController:
    """Make the controller from its table, which states gains, matrices, or a file with matrices.

    ``follows`` states whether the problem has set-points that the controller reads.
    """
    _expect_stated(table, plant)
    for name in (name for name in "FG" if name in table and not follows):
        raise ProblemError(
            f"controller.{name} is given, an effect of set-points, without [reference]; expected set-points in "
            f"[reference], or no controller.{name}"
        )
    disturbance = table.get("disturbance")
    if disturbance is not None:
        disturbance = Disturbance(deviation=0.0) if disturbance == "none" else Disturbance(**disturbance)
    stated: Mapping[str, object] = {name: table[name] for name in "ABCDEFG" if name in table}
    given = [name for name in ("pid", "file") if name in table] + [*stated][:1]
    if len(given) > 1:
        raise ProblemError(f"controller.{given[0]} and controller.{given[1]} are both given; expected only one of them")
    sign = 1.0 if table.get("sign") == "positive" else -1.0
    method, setpoint = table.get("method"), table.get("setpoint")
    if "pid" in table:
        if method is not None:
            raise ProblemError(
                "controller.method is given with pid; expected this key only with the matrices A, B, C and D of a "
                "continuous controller, or with file"
            )
        if setpoint is not None:
            raise ProblemError(
                "controller.setpoint is given with pid; expected the key 'setpoint' inside controller.pid"
            )
        pids = [
            PID(**{key: -sign * value if key in GAINS else value for key, value in one.items()})
            for one in _loops(table)
        ]
        pids[:1] = [replace(one, disturbance=disturbance) for one in pids[:1]]
        return PIDLoops(tuple(pids)) if isinstance(table["pid"], list) else pids[0]
    dt = None
    if "file" in table:
        stated, dt = read_controller(table["file"])
    if not stated:
        raise ProblemError(
            "[controller] describes no controller; expected the key 'pid' or 'file', or the matrices A, B, C and D, "
            "or only D for a static gain"
        )
    missing = [name for name in "ABC" if name not in stated]
    if missing and not stated.keys() <= {"D", "G"}:
        raise ProblemError(
            f"the controller has {', '.join(stated)} but no {', '.join(missing)}; expected A, B, C and D, or only D "
            "for a static gain"
        )
    if missing and method is not None:
        raise ProblemError(
            "controller.method is given with only D, a static gain, which needs no discretisation; expected no "
            "controller.method"
        )
    found = {
        name: array(f"controller.{name}", cast("ArrayLike", value), (None, None), "(rows, columns)")
        for name, value in stated.items()
    }
    m, p = found["D"].shape if "D" in found else (len(found["C"]), found["B"].shape[1])
    A, B, C = (found.get(name, np.zeros(shape)) for name, shape in (("A", (0, 0)), ("B", (0, p)), ("C", (m, 0))))
    D, E = sign * found.get("D", np.zeros((m, p))), found.get("E")
    F, G = found.get("F"), found.get("G")
    if dt == 0 or method is not None:
        if dt:
            raise ProblemError(
                f"controller.method is given, but the controller in {table['file']} is discrete, with steps of {dt:g} "
                "s; expected no method"
            )
        if E is not None:
            raise ProblemError("controller.E is given with a continuous controller; expected a discrete controller")
        return ContinuousController(A, B, sign * C, D, method or "tustin", disturbance, setpoint, F, G)
    return Controller(A, B, sign * C, D, E, dt, disturbance, setpoint, F=F, G=G)


def _loops(table: ControllerKeys) -> list[PIDKeys]:
    """Return the tables of PID controllers: one, or a list of them."""
    found = table.get("pid", [])
    return cast("list[PIDKeys]", found) if isinstance(found, list) else [found]


def limits_of(table: LimitsKeys | None, plant: Plant | ContinuousPlant) -> Limits | None:
    """Make the limits of states from their table. By default, they limit the measured outputs."""
    if table is None:
        return None
    if "outputs" not in table and plant.D is not None:
        raise ProblemError(
            "limits.outputs is missing, but the measured outputs have a direct feedthrough plant.D; expected "
            "limits.outputs, whose rows weight the states"
        )
    return Limits(table.get("outputs", plant.C), table.get("low"), table.get("high"))


def _expect_stated(table: ControllerKeys, plant: Plant | ContinuousPlant) -> None:
    """Raise an error if a set-point is 0 at an operating point, where 0 means the output at this point."""
    p = len(plant.C)
    stated = {one.get("output", 1) - 1: one.get("setpoint") for one in _loops(table)}
    stated |= dict(enumerate(cast("list[float]", table.get("setpoint", []))))
    y = plant.rest_outputs
    for i in (i for i, value in stated.items() if value == 0.0 and 0 <= i < p and y[i] != 0.0):
        raise ProblemError(
            f"the controller has the set-point 0 for output {i + 1}{plant.told('outputs', i)}, but this output is "
            f"{y[i]:g} at plant.operating_point; expected another set-point, or no set-point, which means the "
            "value at the operating point"
        )


def network_of(file: File, kind: Kind, plant: Plant | ContinuousPlant) -> Network:
    """Make the network of a problem file. If no table states it, the links are ideal.

    Losses without ``network.protocol`` are an error unless the policy kind uses them.
    """
    network = _graph_of(file) if file.nodes or file.links else _usual_of(file.network or NetworkTable(), kind)
    if any(law.energy is not None for law in network.links.values()) and isinstance(plant, Plant) and plant.dt is None:
        raise ProblemError("the energy of a packet is given without plant.dt; expected plant.dt, the seconds per step")
    return network if not isinstance(plant, Plant) or plant.dt is None else _in_steps(network, plant.dt)


def _in_steps(network: Network, step: float) -> Network:
    """Return a network whose delays in seconds are those in steps of a discrete plant."""
    links = dict[str, LinkLaw]()
    for name, law in network.links.items():
        try:
            links[name] = law.in_steps(step) if law.timed else law
        except ProblemError as error:
            key, _, rest = str(error).partition(" ")
            raise ProblemError(f"{network.key(name, key)} {rest}") from None
    return replace(network, links=links)


def _usual_of(table: NetworkTable, kind: Kind) -> Network:
    """Return the usual nodes with the links that the table [network] states, by keys such as ``sensor_loss``."""
    laws: dict[str, dict[str, Any]] = {"sensor": {}, "actuator": {}}
    for key, value in vars(table).items():
        link, _, name = key.partition("_")
        if link in laws:
            laws[link][name] = _burst(f"network.{key}", value) if name == "burst" else value
    lost = [key for key in vars(table) if key.endswith(("_loss", "_burst")) and getattr(table, key)]
    if lost and table.protocol == "ideal" and not kind.takes_losses:
        able = [name for name in own_kinds() if CATALOGUE[name].takes_losses]
        raise ProblemError(
            f"network.{lost[0]} is given, which the policy kind {kind.name} does not use; expected ideal links: remove "
            f"this key, or give network.protocol and a policy kind such as {' or '.join(able)}"
        )
    links = usual_links(cast("Any", table.protocol), cast("Any", table.payload), laws)
    return Network(delay=table.delay, links=links, stated=SHORT)


def _graph_of(file: File) -> Network:
    """Return the network of the tables [nodes] and [links]; [network] may still state the delay of computations."""
    table, usual = file.network or NetworkTable(), vars(NetworkTable())
    for key in (key for key, value in vars(table).items() if key != "delay" and value != usual[key]):
        raise ProblemError(
            f"network.{key} is given with [nodes] or [links]; expected the properties of each link in [links.NAME]"
        )
    nodes, links, missing = dict[str, NodeRole](), dict[str, LinkLaw](), dict[str, float | LossLaw]()
    for name, role in (file.nodes or {}).items():
        try:
            nodes[name] = NodeRole(**role)
        except ProblemError as error:
            raise ProblemError(f"nodes.{name}: {error}") from None
    for name, keys in (file.links or {}).items():
        law: dict[str, Any] = {**keys, "burst": _burst(f"links.{name}.burst", keys.get("burst"))}
        samples = law.pop("missing", None)
        if samples is not None:
            bursts = cast("dict[str, Any]", samples) if isinstance(samples, dict) else None
            missing[name] = _burst(f"links.{name}.missing", bursts) or cast("float", samples)
            if len(keys) == 1:  # the node may be at the controller's site, without a link
                continue
        try:
            links[name] = LinkLaw(**law)
        except ProblemError as error:
            raise ProblemError(f"links.{name}.{error}") from None
    return Network(delay=table.delay, nodes=nodes or None, links=links, missing=missing)


def _burst(key: str, table: Mapping[str, Any] | None) -> LossLaw | None:
    """Return the law of losses of a table: its key ``law`` names the class, and the other keys are its parameters."""
    if table is None:
        return None
    name = table.get("law", USUAL)
    if not isinstance(name, str):
        raise ProblemError(f"{key}.law is {quoted(name)}; expected the name of a law in quotes")
    law: type[LossLaw] = LossLaw
    try:
        law = find_law(name)
        return validate(law, {key: value for key, value in table.items() if key != "law"})
    except ValidationError as error:
        own = error.errors()[0].get("ctx", {}).get("error")  # raised by the law itself
        text = first_mistake(error, law, key.split(".")) if own is None else f"{key}: {own}"
    except ProblemError as error:
        text = f"{key}.{error}"
    raise ProblemError(text)
