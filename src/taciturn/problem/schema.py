"""The tables of a problem file, and error messages with remedies for mistakes in them.

A table is described by a class, whose fields are its keys (``keys_of``). Three kinds of tables:

* A class of the model is the schema of its own table, such as ``LinkLaw`` of ``[links.NAME]``. The table is read as the
  arguments of the class, which ``read`` makes, so that a value out of range is reported after all mistakes of types.
* A table that states an object in several ways has a class here: weights or variances for a cost, gains, matrices or a
  file for a controller, and a plant with its noise, initial state and function.
* A law of losses, which a package of another author may define, is made directly.

Types are checked by pydantic-core, whose import is faster than that of pydantic, and strictly: numbers given as text,
true given as a number, and unknown keys are mistakes. ``first_mistake`` makes one clause of the first of them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from inspect import signature
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias, Union, cast, get_args, get_origin, get_type_hints

from pydantic_core import SchemaValidator, core_schema
from pydantic_core import ValidationError as ValidationError

from taciturn._arrays import quoted
from taciturn._display import Displayed
from taciturn.model.controller import PID
from taciturn.model.disturbance import Disturbance
from taciturn.model.key import Rows
from taciturn.model.limits import Limits
from taciturn.model.link import LinkLaw
from taciturn.model.network import NodeRole
from taciturn.model.operating_point import OperatingPoint
from taciturn.model.plant import Jumps
from taciturn.model.signals import ExternalDisturbance, RandomSteps

_SIMPLE = {
    Any: core_schema.any_schema(),
    bool: core_schema.bool_schema(strict=True),
    float: core_schema.float_schema(strict=True),
    int: core_schema.int_schema(strict=True),
    str: core_schema.str_schema(strict=True),
}


def validate(hint: Any, value: object) -> Any:
    """Return a value that has an annotated type; a table (mapping) becomes an instance of a dataclass.

    Numbers given as text, and unknown keys of a table, are not accepted.
    """
    return _validator(hint).validate_python(value)


@cache
def _validator(hint: Any) -> SchemaValidator:
    return SchemaValidator(_schema(hint))


def _schema(hint: Any) -> core_schema.CoreSchema:
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Literal:
        return core_schema.literal_schema(list(parts))
    if origin in (Union, UnionType):
        kinds = [_schema(part) for part in parts if part is not NoneType]
        joined = kinds[0] if len(kinds) == 1 else core_schema.union_schema([*kinds])
        return core_schema.nullable_schema(joined) if NoneType in parts else joined
    if origin is list:
        return core_schema.list_schema(_schema(parts[0]), strict=True)
    if origin is Sequence:
        return core_schema.list_schema(_schema(parts[0]))
    if origin is dict:
        return core_schema.dict_schema(_schema(parts[0]), _schema(parts[1]), strict=True)
    if _is_table(hint):
        keys = {
            name: core_schema.typed_dict_field(_schema(one.kind), required=one.required)
            for name, one in keys_of(hint).items()
        }
        table = core_schema.typed_dict_schema(keys, extra_behavior="forbid", strict=True)
        if not is_dataclass(hint):
            arguments = {name: one.argument for name, one in keys_of(hint).items()}
            return core_schema.no_info_after_validator_function(lambda found: _given(found, arguments), table)
        build = cast("Callable[..., object]", hint)
        return core_schema.no_info_after_validator_function(lambda found: build(**found), table)
    return _SIMPLE[hint]


class Key(NamedTuple):
    """A key of a table: its type, whether it must be given, and the argument of the class that it states."""

    kind: Any
    required: bool
    argument: str


@cache
def keys_of(table: Any) -> dict[str, Key]:
    """Return the keys of a table by name: the fields of a dataclass, except those that state no key."""
    model = get_args(table)[1] if get_origin(table) is Annotated else table
    hints, arguments = get_type_hints(model, include_extras=True), signature(model).parameters
    found = dict[str, Key]()
    for one in fields(model):
        kind = one.metadata.get("kind", hints[one.name])
        needed = arguments[one.name].default is arguments[one.name].empty and NoneType not in get_args(kind)
        found |= {} if kind is None else {one.metadata.get("name", one.name): Key(kind, needed, one.name)}
    return found


def _is_table(hint: Any) -> bool:
    return is_dataclass(hint) or get_origin(hint) is Annotated


def _given(keys: Mapping[str, object], arguments: Mapping[str, str]) -> dict[str, object]:
    """Return the arguments that a table states; None, in a table of Python, is as an omitted key."""
    return {arguments[name]: value for name, value in keys.items() if value is not None}


# tables whose keys are fields of a model class: read as its arguments, which the class checks when it is made
StepsKeys: TypeAlias = Annotated[dict[str, Any], RandomSteps]
EntryKeys: TypeAlias = Annotated[dict[str, Any], ExternalDisturbance]
JumpsKeys: TypeAlias = Annotated[dict[str, Any], Jumps]
DisturbanceKeys: TypeAlias = Annotated[dict[str, Any], Disturbance]
OperatingPointKeys: TypeAlias = Annotated[dict[str, Any], OperatingPoint]
NodeKeys: TypeAlias = Annotated[dict[str, Any], NodeRole]
LinkKeys: TypeAlias = Annotated[dict[str, Any], LinkLaw]
LimitsKeys: TypeAlias = Annotated[dict[str, Any], Limits]
PIDKeys: TypeAlias = Annotated[dict[str, Any], PID]
NO_DELAY = ("delay", "buffer")  # keys of a link that have a message of their own


@dataclass(frozen=True, kw_only=True, repr=False)
class InitialTable(Displayed):
    """The keys of the table ``[plant.initial]``."""

    mean: list[float] | None = None
    covariance: Rows | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class PlantTable(Displayed):
    """The keys of the table ``[plant.actual]``, all of which ``[plant]`` also has."""

    A: Rows
    B: Rows
    C: Rows | None = None
    D: Rows | None = None
    W: Rows | None = None
    V: Rows | None = None
    E: Rows | None = None
    dt: float | None = None
    input_limit: list[float | list[float]] | None = None
    input_rate: list[float] | None = None
    function: str | None = None
    initial: InitialTable | None = None
    jumps: JumpsKeys | None = None
    operating_point: OperatingPointKeys | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class NominalPlantTable(PlantTable):
    """The keys of the table ``[plant]``."""

    actual: PlantTable | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class CostTable(Displayed):
    """The keys of the table ``[cost]``."""

    Q: Rows | None = None
    R: Rows | None = None
    N: Rows | None = None
    output_variance: list[float] | None = None
    input_variance: list[float] | None = None
    weights: Literal["as the controller"] | None = None
    horizon: int | None = None
    terminal: Rows | None = None
    discount: float | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class NetworkTable(Displayed):
    """The keys of the table ``[network]``."""

    protocol: str = "ideal"
    actuator_loss: float = 0.0
    sensor_loss: float = 0.0
    delay: int = 0
    actuator_burst: dict[str, Any] | None = None
    sensor_burst: dict[str, Any] | None = None
    payload: str = "float64"
    actuator_range: float | list[float] | None = None
    sensor_range: float | list[float] | None = None
    actuator_energy: float | None = None
    sensor_energy: float | None = None
    actuator_battery: float | None = None
    sensor_battery: float | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class ReferenceTable(Displayed):
    """The keys of the table ``[reference]``: a trajectory (states, inputs), or what outputs are to follow."""

    states: Rows | None = None
    inputs: Rows | None = None
    outputs: Rows | None = None
    value: list[float] | None = None
    steps: StepsKeys | None = None
    file: str | None = None
    integral_action: list[str] | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class ControllerTable(Displayed):
    """The keys of the table ``[controller]``."""

    pid: PIDKeys | list[PIDKeys] | None = None
    file: str | None = None
    A: Rows | None = None
    B: Rows | None = None
    C: Rows | None = None
    D: Rows | None = None
    E: Rows | None = None
    method: Literal["tustin", "zoh"] | None = None
    sign: Literal["negative", "positive"] = "negative"
    setpoint: list[float] | None = None
    disturbance: DisturbanceKeys | Literal["none"] | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class File(Displayed):
    """The tables of a complete problem file."""

    plant: NominalPlantTable
    cost: CostTable
    network: NetworkTable | None = None
    nodes: dict[str, NodeKeys] | None = None
    links: dict[str, LinkKeys] | None = None
    reference: ReferenceTable | None = None
    disturbance: list[EntryKeys] | None = None
    controller: ControllerTable | None = None
    limits: LimitsKeys | None = None
    policy: dict[str, Any]


def first_mistake(error: ValidationError, root: type, within: Sequence[str] = ()) -> str:
    """Return the first mistake as one clause: its location, the mistake, and a suggested correction.

    ``within`` are the keys that lead to the table of the class ``root``.
    """
    mistakes = sorted(error.errors(), key=lambda mistake: mistake["type"] != "extra_forbidden")
    first, place = mistakes[0], _place(root, mistakes[0]["loc"])
    extra = first["type"] == "extra_forbidden"
    place = [*place, first["loc"][-1]] if extra else place
    whole = [*within, *place]
    where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in whole).removeprefix(".")
    if extra and place[0] == "links" and place[-1] in NO_DELAY:
        return f"{where} is given, but links model no delay yet; expected no {place[-1]}: remove it"
    if extra:
        names = _keys_at(root, [part for part in place[:-1] if isinstance(part, str)])
        return f"{where} is not a known key; expected one of {', '.join(names)}{suggest(str(place[-1]), names)}"
    if first["type"] == "missing":
        kind = "the table" if len(whole) == 1 else "the key"
        shown = f"[{where}]" if len(whole) == 1 else where
        return f"{kind} {shown} is missing; expected {_required(whole)}"
    if first["type"] == "list_type" and isinstance(first["input"], dict):
        return f"[{where}] is a single table; expected [[{where}]] for each"
    same = [mistake for mistake in mistakes if _place(root, mistake["loc"]) == place]
    texts = dict.fromkeys(ours(mistake["msg"]).removeprefix("expected ") for mistake in same)
    expected = f"expected {' or '.join(texts)}" if len(same) > 1 else ours(first["msg"])
    return f"{where} is {quoted(first['input'])}; {expected}"


def _place(root: type, location: Sequence[str | int]) -> list[str | int]:
    """Return the keys and indices of a location without the names that pydantic gives to alternative types."""
    kept = list[str | int]()
    table: Any = root
    for part in location:
        keys = keys_of(table) if _is_table(table) else {}
        if isinstance(part, int):
            kept.append(part)
        elif get_origin(table) is dict:
            kept.append(part)
            table = get_args(table)[1]
        elif part in keys:
            kept.append(part)
            table = _table_of(keys[part].kind)
    return kept


def _table_of(hint: Any) -> Any:
    """Return a table, or the mapping of tables, in a list or in a type that may have alternatives."""
    if _is_table(hint) or get_origin(hint) is dict:
        return hint
    found = (_table_of(kind) for kind in get_args(hint))
    return next((kind for kind in found if kind is not object), object)


def _keys_at(root: type, path: Sequence[str]) -> list[str]:
    table: Any = root
    for part in path:
        table = get_args(table)[1] if get_origin(table) is dict else _table_of(keys_of(table)[part].kind)
    return list(keys_of(table))


def _required(path: Sequence[str | int]) -> str:
    if len(path) == 1:
        return "a file with the tables [plant], [cost] and [policy]"
    table = ".".join(part for part in path[:-1] if isinstance(part, str))
    return f"it in each [[{table}]]" if isinstance(path[-2], int) else f"it in [{table}]"


def suggest(word: str, names: Sequence[str], similarity: float = 0.5) -> str:
    """Return a question that suggests the name that a word abbreviates, or the most similar one; empty if none is."""
    import difflib  # which only a mistake needs

    lowered = {name.lower(): name for name in names}
    short = "".join(f"{re.escape(letter)}.*" for letter in word.lower()) if len(word) > 2 else "$"
    near = [name for name in lowered if re.match(short, name)]
    near = near if len(near) == 1 else difflib.get_close_matches(word.lower(), lowered, n=1, cutoff=similarity)
    return f". Did you mean {lowered[near[0]]!r}?" if near else ""


def ours(message: str) -> str:
    """Rewrite the end of a message of pydantic: "Input should be a valid integer" becomes "expected a whole number"."""
    message = message.split(" or instance of ")[0]
    for theirs, ours in _WORDS:
        message = message.replace(theirs, ours)
    return message


_WORDS = (
    ("Input should be a valid integer", "expected a whole number"),
    ("Input should be a valid dictionary", "expected a table"),
    ("Input should be a valid list", "expected a list"),
    ("Input should be a valid", "expected a"),
    ("Input should be", "expected"),
)
