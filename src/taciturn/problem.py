"""Problem files: TOML read and checked with located errors, and the problem they state."""

from __future__ import annotations

import difflib
import inspect
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast, get_type_hints

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from taciturn._arrays import Array, quoted
from taciturn.design.catalogue import CATALOGUE
from taciturn.errors import ProblemError, TaciturnError
from taciturn.loop import Loop, close
from taciturn.model.cost import Cost
from taciturn.model.network import Burst, Network
from taciturn.model.plant import ContinuousPlant, Jumps, Plant
from taciturn.model.policy import Policy

Rows = list[list[float]]
BUILT_IN = Path(__file__).parent / "problems"


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=True)  # strict: 1 is a number, "1" is none


class _Initial(_Table):
    mean: list[float] | None = None
    covariance: Rows | None = None


class _Jumps(_Table):
    rate: float
    covariance: Rows
    distribution: str = "normal"


class _PlantTable(_Table):
    A: Rows
    B: Rows
    C: Rows | None = None
    W: Rows | None = None
    V: Rows | None = None
    dt: float | None = None
    input_limit: list[float] | None = None
    function: str | None = None
    initial: _Initial | None = None
    jumps: _Jumps | None = None


class _NominalPlantTable(_PlantTable):
    actual: _PlantTable | None = None


class _CostTable(_Table):
    Q: Rows
    R: Rows
    N: Rows | None = None
    horizon: int | None = None
    terminal: Rows | None = None
    discount: float | None = None


class _BurstTable(_Table):
    to_bad: float
    to_good: float
    loss_good: float
    loss_bad: float


class _NetworkTable(_Table):
    protocol: str = "ideal"
    actuator_loss: float = 0.0
    sensor_loss: float = 0.0
    delay: int = 0
    actuator_burst: _BurstTable | None = None
    sensor_burst: _BurstTable | None = None


class _ReferenceTable(_Table):
    states: Rows
    inputs: Rows


class _File(_Table):
    plant: _NominalPlantTable
    cost: _CostTable
    network: _NetworkTable | None = None
    reference: _ReferenceTable | None = None
    policy: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Problem:
    """A plant, a cost, a network and the policy asked for.

    Args:
        plant: the plant of the design.
        cost: the cost.
        network: the network.
        kind: key of the policy in the catalogue.
        parameters: its parameters.
        actual: the plant that is simulated, where it differs.
        source: the tables of the file, for changing single keys.
    """

    plant: Plant | ContinuousPlant
    cost: Cost
    network: Network
    kind: str
    parameters: Mapping[str, Any]
    actual: Plant | ContinuousPlant | None = None
    source: Mapping[str, Any] | None = None

    def design(self) -> Policy:
        """Design the policy.

        Raises:
            ProblemError: a parameter is unknown, missing or out of range, or the policy knows no such network.
        """
        parameters = check_parameters(self.kind, self.parameters)
        design = CATALOGUE[self.kind]
        if "network" in inspect.signature(design).parameters:
            return design(self.plant, self.cost, network=self.network, **parameters)
        unused = [key for key in _NetworkTable.model_fields if getattr(self.network, key) != getattr(Network(), key)]
        if unused:
            raise ProblemError(
                f"network.{unused[0]} is given, which {self.kind} does not use; expected ideal links: remove it"
            )
        return design(self.plant, self.cost, **parameters)

    def close(self, policy: Policy) -> Loop:
        """Close the loop with the plant that is simulated."""
        return close(self.actual or self.plant, policy, self.network, self.cost)

    def changed(self, values: Mapping[str, object]) -> Problem:
        """Return the problem with other values: keys of ``[policy]``, or dotted (``plant.dt``, ``cost.R``).

        Raises:
            ProblemError: no such key, or a value that does not fit.
        """
        parameters, tables = dict(self.parameters), _copied(self.source or {})
        for name, value in values.items():
            *path, key = name.split(".")
            if not path or path == ["policy"]:
                parameters[key] = value
            elif self.source is None:
                raise ProblemError(
                    f"{name} cannot be changed in a problem that was not read from a file; expected a key of [policy]"
                )
            else:
                table = tables
                for part in path:
                    found: object = table.setdefault(part, {})
                    if not isinstance(found, dict):
                        raise ProblemError(f"{name} is no key: {part} is {quoted(found)}; expected a key, as plant.dt")
                    table = cast("dict[str, Any]", found)
                table[key] = value
        if self.source is None:
            return replace(self, parameters=parameters)
        tables["policy"] = {"kind": parameters.pop("kind", self.kind), **parameters}
        return parse(tables, "the changed problem")


def load(path: str | Path) -> Problem:
    """Read a problem file, or a built-in problem by its name.

    Args:
        path: a TOML file, or a name such as ``"two-mass"``.

    Returns:
        The problem.

    Raises:
        ProblemError: no such file, not TOML, a key that is unknown or missing, data that do not fit.

    Example:
        >>> load("two-mass").kind
        'lqg'
    """
    file = Path(path)
    built_in = dict(sorted((found.stem, found) for found in BUILT_IN.glob("*.toml")))
    try:
        if not file.is_file():
            file = built_in.get(str(path), file)
        text = file.read_text(encoding="utf-8-sig")  # a byte-order mark is no mistake
        tables = tomllib.loads(text)
    except FileNotFoundError:
        raise ProblemError(
            f"there is no file {str(path)!r}; expected a problem file, or one of the built-in problems "
            f"{', '.join(built_in)}{_suggest(str(path), list(built_in))}"
        ) from None
    except UnicodeDecodeError as error:
        raise ProblemError(f"{str(path)!r} is not a text in UTF-8 ({error.reason}); expected a TOML file") from None
    except OSError as error:
        raise ProblemError(f"{str(path)!r} cannot be read ({error.strerror}); expected a TOML file") from None
    except RecursionError:
        raise ProblemError(f"{path} is not valid TOML: it is nested too deeply; expected tables of matrices") from None
    except ValueError as error:  # tomllib's own, and whole numbers beyond what Python reads
        raise ProblemError(f"{path} is not valid TOML: {error}; expected the format of docs/problem-file") from None
    return parse(tables, str(path))


def parse(tables: Mapping[str, Any], name: str) -> Problem:
    """Return the problem that the tables of a file state.

    Args:
        tables: as read from TOML.
        name: of the file, for messages.

    Raises:
        ProblemError: a key is unknown or missing, or data do not fit.
    """
    try:
        file = _File.model_validate(tables)
    except ValidationError as error:
        raise ProblemError(f"{name}: {_first_mistake(error, _File)}") from None
    kind = file.policy.get("kind")
    if not isinstance(kind, str) or kind not in CATALOGUE:
        got = f"is {quoted(kind)}" if "kind" in file.policy else "is missing"
        near = _suggest(kind, list(CATALOGUE)) if isinstance(kind, str) else ""
        raise ProblemError(f"{name}: policy.kind {got}; expected one of {', '.join(CATALOGUE)}{near}")
    parameters = {key: value for key, value in file.policy.items() if key != "kind"}
    try:
        check_parameters(kind, parameters)
        if file.reference is not None:
            raise ProblemError(f"[reference] is given, which {kind} does not use; expected no reference: remove it")
        cost = Cost(**{key: value for key, value in file.cost.model_dump().items() if value is not None})
        plant = _plant(file.plant)
        actual = None if file.plant.actual is None else _actual(file.plant.actual, file.plant.dt, plant)
        return Problem(plant, cost, _network(file.network), kind, parameters, actual, _copied(tables))
    except TaciturnError as error:
        raise type(error)(f"{name}: {error}") from None


def check_parameters(kind: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a policy kind, checked against its design function.

    Raises:
        ProblemError: a parameter is unknown, missing, or of the wrong type.
    """
    if kind not in CATALOGUE:
        near = _suggest(str(kind), list(CATALOGUE))
        raise ProblemError(f"policy.kind is {kind!r}; expected one of {', '.join(CATALOGUE)}{near}")
    design = CATALOGUE[kind]
    known = {
        key: value
        for key, value in inspect.signature(design).parameters.items()
        if value.kind is value.KEYWORD_ONLY and key != "network"
    }
    hints = get_type_hints(design)
    for key in parameters:
        if key not in known:
            expected = f"one of {', '.join(known)}" if known else "no parameters"
            raise ProblemError(
                f"policy.{key} is not a parameter of {kind}; expected {expected}{_suggest(key, list(known))}"
            )
    for key, parameter in known.items():
        if parameter.default is parameter.empty and key not in parameters:
            raise ProblemError(f"policy.{key} is missing; {kind} expects it")
    checked: dict[str, Any] = {}
    for key, value in parameters.items():
        try:
            checked[key] = TypeAdapter(hints[key]).validate_python(value, strict=True)
        except ValidationError as error:
            raise ProblemError(f"policy.{key} is {quoted(value)}; {_lower(error.errors()[0]['msg'])}") from None
    return checked


def _plant(table: _PlantTable) -> Plant | ContinuousPlant:
    if table.function is not None:
        raise ProblemError(
            "plant.function is given, and nonlinear plants are not supported yet; expected A and B alone"
        )
    initial = table.initial or _Initial()
    if table.dt is None:
        jumps = None if table.jumps is None else _jumps(table.jumps)
        return ContinuousPlant(
            table.A, table.B, table.W, jumps, table.C, table.V, initial.mean, initial.covariance, table.input_limit
        )
    if table.jumps is not None:
        raise ProblemError(
            "plant.jumps is given with plant.dt; expected jumps only with a continuous-time plant: remove dt"
        )
    if table.W is None:
        raise ProblemError("plant.W is missing; expected the process-noise covariance per step (zeros for none)")
    return Plant(
        table.A, table.B, table.W, table.C, table.V, table.dt, initial.mean, initial.covariance, table.input_limit
    )


def _actual(table: _PlantTable, dt: float | None, design: Plant | ContinuousPlant) -> Plant | ContinuousPlant:
    """Return the plant that is simulated; it must have the time base and the sizes of the plant of the design."""
    try:
        plant = _plant(table)
    except ProblemError as error:
        raise ProblemError(f"[plant.actual]: {error}") from None
    if table.dt != dt:
        got, expected = ("missing" if step is None else f"{step:g} s" for step in (table.dt, dt))
        raise ProblemError(f"plant.actual.dt is {got}, and plant.dt is {expected}; expected the same time base in both")
    for name, axis in (("A", 0), ("B", 1), ("C", 0)):
        got, expected = getattr(plant, name).shape[axis], getattr(design, name).shape[axis]
        if got != expected:
            size = {"A": "states", "B": "inputs", "C": "outputs"}[name]
            raise ProblemError(f"[plant.actual] has {got} {size}; expected {expected}, as [plant]")
    return plant


def _jumps(table: _Jumps) -> Jumps:
    return Jumps(table.rate, cast("Array", table.covariance), cast("Any", table.distribution))


def _network(table: _NetworkTable | None) -> Network:
    if table is None:
        return Network()
    return Network(
        cast("Any", table.protocol),
        table.actuator_loss,
        table.sensor_loss,
        table.delay,
        _burst("actuator", table.actuator_burst),
        _burst("sensor", table.sensor_burst),
    )


def _burst(link: str, table: _BurstTable | None) -> Burst | None:
    try:
        return None if table is None else Burst(**table.model_dump())
    except ProblemError as error:
        raise ProblemError(f"network.{link}_burst: {error}") from None


def _first_mistake(error: ValidationError, root: type[BaseModel]) -> str:
    """Say the first mistake in one clause: where, what, and what was perhaps meant."""
    mistakes = sorted(error.errors(), key=lambda mistake: mistake["type"] != "extra_forbidden")
    first = mistakes[0]
    where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).removeprefix(".")
    if first["type"] == "extra_forbidden":
        names = _keys_at(root, [str(part) for part in first["loc"][:-1]])
        return f"{where} is not a known key; expected one of {', '.join(names)}{_suggest(str(first['loc'][-1]), names)}"
    if first["type"] == "missing":
        kind = "the table" if len(first["loc"]) == 1 else "the key"
        shown = f"[{where}]" if len(first["loc"]) == 1 else where
        return f"{kind} {shown} is missing; expected {_required(root, [str(part) for part in first['loc']])}"
    return f"{where} is {quoted(first['input'])}; {_lower(first['msg'])}"


def _keys_at(root: type[BaseModel], path: Sequence[str]) -> list[str]:
    model = root
    for part in path:
        annotations = str(model.model_fields[part].annotation)
        model = next(m for m in _MODELS if m.__name__ in annotations.replace("|", " ").replace("'", " ").split(".")[-1])
    return list(model.model_fields)


def _required(root: type[BaseModel], path: Sequence[str]) -> str:
    return "a file with the tables [plant], [cost] and [policy]" if len(path) == 1 else f"it in [{'.'.join(path[:-1])}]"


def _suggest(word: str, names: Sequence[str]) -> str:
    lowered = {name.lower(): name for name in names}
    near = difflib.get_close_matches(word.lower(), lowered, n=1, cutoff=0.5)
    return f". Did you mean {lowered[near[0]]!r}?" if near else ""


def _lower(message: str) -> str:
    """Turn a sentence of pydantic into the end of ours: Input should be … → expected …."""
    message = message.split(" or instance of ")[0]
    for theirs, ours in _WORDS:
        message = message.replace(theirs, ours)
    return message


def _copied(tables: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: _copied(cast("Mapping[str, Any]", value)) if isinstance(value, Mapping) else value
        for key, value in tables.items()
    }


_WORDS = (
    ("Input should be a valid integer", "expected a whole number"),
    ("Input should be a valid dictionary", "expected a table"),
    ("Input should be a valid list", "expected a list"),
    ("Input should be a valid", "expected a"),
    ("Input should be", "expected"),
)
_MODELS: tuple[type[BaseModel], ...] = (
    _File, _NominalPlantTable, _PlantTable, _Initial, _Jumps, _CostTable, _NetworkTable, _BurstTable, _ReferenceTable,
)  # fmt: skip
