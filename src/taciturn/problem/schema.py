"""The tables of a problem file, and error messages that suggest a correction of mistakes in them.

A table is described by classes, whose fields are its keys (``keys_of``): classes of the model, such as ``LinkLaw`` of
``[links.NAME]``, and small classes of this file for keys that state an argument in another way, such as variances for
the weights of a cost. The table is read as arguments by name, from which ``read`` makes the objects, so that a value
out of range is reported after all mistakes of types. So a new key is one field of a class of the model, and its
argument.

A file, ``[network]``, and a law of losses, which a package of another author may define, are made directly.

A matrix is a list of rows (``Rows``). A number is a vector or matrix with one entry, and a list of numbers in
place of a matrix is left to the class of the model, whose message knows the sizes and shows the form.

Types are checked by pydantic-core, whose import is faster than that of pydantic, and strictly: numbers given as text,
true given as a number, and unknown keys are mistakes. ``first_mistake`` makes one clause of the first of them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from inspect import Parameter, signature
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    TypeAlias,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from pydantic_core import SchemaValidator, core_schema
from pydantic_core import ValidationError as ValidationError

from taciturn._arrays import FORM, quoted
from taciturn._display import Displayed
from taciturn.model.controller import PID, ContinuousController, Controller
from taciturn.model.cost import Cost
from taciturn.model.disturbance import Reference
from taciturn.model.key import Rows
from taciturn.model.limits import Limits
from taciturn.model.link import LinkLaw
from taciturn.model.names import Names
from taciturn.model.network import NodeRole
from taciturn.model.noise import Noise
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.signals import ExternalDisturbance, RandomSteps, SetPoint

_SIMPLE = {
    Any: core_schema.any_schema(),
    bool: core_schema.bool_schema(strict=True),
    float: core_schema.float_schema(strict=True),
    int: core_schema.int_schema(strict=True),
    str: core_schema.str_schema(strict=True),
}


def validate(hint: Any, value: object) -> Any:
    """Check that a value has the annotated type. A table is converted to an instance of its dataclass.

    Numbers given as text, and unknown keys of a table, are not accepted.
    """
    return _validator(hint).validate_python(value)


@cache
def _validator(hint: Any) -> SchemaValidator:
    return SchemaValidator(_schema(hint))


def _schema(hint: Any) -> core_schema.CoreSchema:
    origin, parts = get_origin(hint), get_args(hint)
    if hint in _ARRAYS:
        return _array_schema(hint)
    if origin is Literal:
        return core_schema.literal_schema(list(parts))
    if origin in (Union, UnionType):
        given = [part for part in parts if part is not NoneType]
        kinds = [_list_schema(part) if float in given and part in _ARRAYS else _schema(part) for part in given]
        joined = kinds[0] if len(kinds) == 1 else core_schema.union_schema([*kinds])
        return core_schema.nullable_schema(joined) if NoneType in parts else joined
    if origin is list:
        return _list_schema(hint)
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


_ARRAYS = (Rows, list[float], list[float | list[float]])  # types of matrices and vectors


def _array_schema(hint: Any) -> core_schema.CoreSchema:
    """Return the schema of a matrix, whose rows the model checks, or of a vector; a number is the only entry."""
    number = core_schema.float_schema(strict=True)
    if hint != Rows:
        alone = core_schema.no_info_after_validator_function(lambda entry: [entry], number)
        return _by_form(alone, _list_schema(hint), _list_schema(hint))
    row = _by_form(number, core_schema.list_schema(number, strict=True), number)
    other = core_schema.custom_error_schema(
        core_schema.list_schema(), "matrix", custom_error_message=f"expected a list of rows, such as {FORM}"
    )
    return _by_form(number, core_schema.list_schema(row, strict=True), other)


def _by_form(
    number: core_schema.CoreSchema, several: core_schema.CoreSchema, other: core_schema.CoreSchema
) -> core_schema.CoreSchema:
    """Return the schema of a number, a list, or another value, so that a mistake names what was meant."""

    def form(value: object) -> str:
        return "several" if isinstance(value, list) else "number" if isinstance(value, int | float) else "other"

    return core_schema.tagged_union_schema({"number": number, "several": several, "other": other}, form)


def _list_schema(hint: Any) -> core_schema.CoreSchema:
    return core_schema.list_schema(_schema(get_args(hint)[0]), strict=True)


class Key(NamedTuple):
    """A key of a table: type, argument, note on its meaning, and whether it is required."""

    kind: Any
    required: bool
    argument: str
    note: str


@cache
def keys_of(table: Any) -> dict[str, Key]:
    """Return the keys of a table, by name, from the fields of the classes that describe the table."""
    found, first = dict[str, Key](), tuple[str, ...]()
    for model in get_args(table)[1:] if get_origin(table) is Annotated else (table,):
        arguments, hints = signature(model).parameters, dict[str, Any]()
        if any("kind" not in one.metadata for one in fields(model)):  # its evaluation takes most of the time
            hints = get_type_hints(model, include_extras=True)
        first = getattr(model, "ORDER", first)
        for one in fields(model):
            kind = one.metadata["kind"] if "kind" in one.metadata else hints[one.name]
            if kind is not None:
                needed = arguments[one.name].default is Parameter.empty and NoneType not in get_args(kind)
                name = one.metadata.get("name") or one.name
                found.setdefault(name, Key(kind, needed, one.name, one.metadata.get("note", "")))
    return dict(sorted(found.items(), key=lambda item: (*first, item[0]).index(item[0])))


def _is_table(hint: Any) -> bool:
    return is_dataclass(hint) or get_origin(hint) is Annotated


def _given(keys: Mapping[str, object], arguments: Mapping[str, str]) -> dict[str, object]:
    """Return the arguments that a table states; None, in a table of Python, is as an omitted key."""
    return {arguments[name]: value for name, value in keys.items() if value is not None}


@dataclass(frozen=True, kw_only=True, repr=False)
class InitialKeys(Displayed):
    """Keys of the table ``[plant.initial]``: mean and covariance of the initial state."""

    mean: list[float] | None = None
    covariance: Rows | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class OtherPlantKeys(Displayed):
    """Keys of ``[plant]`` and ``[plant.actual]`` that are no attributes of the plant's class, such as ``initial``."""

    ORDER: ClassVar = (*"ABCDWVE", "dt", "input_limit", "input_rate", "function", "initial", "jumps")  # in messages
    E: Rows | None = field(default=None, metadata={"note": "matrix of {moved}"})
    noise: Annotated[dict[str, Any], Noise] | None = field(
        default=None, metadata={"note": "in place of W and V: standard deviations of noise at the inputs and outputs"}
    )
    initial: Annotated[dict[str, Any], InitialKeys] | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class UnitKeys(Displayed):
    """Keys of the table ``units`` of ``[plant]``: the units of states, inputs and outputs."""

    states: list[str] | None = None
    inputs: list[str] | None = None
    outputs: list[str] | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class SignalKeys(Displayed):
    """Keys of ``[plant]`` for the names and units of its signals, which the simulated plant has too."""

    state_names: list[str] | None = None
    input_names: list[str] | None = None
    output_names: list[str] | None = None
    units: Annotated[dict[str, Any], UnitKeys] | None = None


PlantKeys: TypeAlias = Annotated[dict[str, Any], Plant, ContinuousPlant, OtherPlantKeys, SignalKeys]


@dataclass(frozen=True, kw_only=True, repr=False)
class ActualKeys(Displayed):
    """The key ``actual`` of ``[plant]``, which states the simulated plant if it is not the design plant."""

    actual: PlantKeys | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class OtherCostKeys(Displayed):
    """Keys of ``[cost]`` that can replace the weights Q and R."""

    output_variance: list[float] | None = None
    input_variance: list[float] | None = None
    weights: Literal["as the controller"] | None = field(
        default=None,
        metadata={"note": "equal weight for the present variances of outputs and inputs; or Q and R"},
    )


@dataclass(frozen=True, kw_only=True, repr=False)
class OtherReferenceKeys(Displayed):
    """Keys of ``[reference]`` for set-points that change, and for integral action."""

    steps: Annotated[dict[str, Any], RandomSteps] | None = None
    file: str | None = None
    range: list[list[float]] | None = None
    ramp: list[float] | None = None
    integral_action: list[str] | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class OtherDisturbanceKeys(Displayed):
    """Keys of ``[[disturbance]]`` that state a load in another way."""

    file: str | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class OtherLinkKeys(Displayed):
    """The key ``missing`` of ``[links.NAME]``, which is no property of a link, but of the samples of its node."""

    missing: float | dict[str, Any] | None = None


PIDKeys: TypeAlias = Annotated[dict[str, Any], PID]


@dataclass(frozen=True, kw_only=True, repr=False)
class OtherControllerKeys(Displayed):
    """Keys of ``[controller]`` that state a PID controller or a file instead of matrices, and the sign of the
    feedback.
    """

    pid: PIDKeys | list[PIDKeys] | None = field(
        default=None, metadata={"note": "gains; ki per second, kd and the filter's time constant in seconds"}
    )
    file: str | None = None
    sign: Literal["negative", "positive"] = "negative"


NominalPlantKeys: TypeAlias = Annotated[dict[str, Any], Plant, ContinuousPlant, OtherPlantKeys, SignalKeys, ActualKeys]
CostKeys: TypeAlias = Annotated[dict[str, Any], Cost, OtherCostKeys]
NodeKeys: TypeAlias = Annotated[dict[str, Any], NodeRole]
LinkKeys: TypeAlias = Annotated[dict[str, Any], LinkLaw, OtherLinkKeys]
ReferenceKeys: TypeAlias = Annotated[dict[str, Any], Reference, SetPoint, OtherReferenceKeys]
EntryKeys: TypeAlias = Annotated[dict[str, Any], ExternalDisturbance, OtherDisturbanceKeys]
ControllerKeys: TypeAlias = Annotated[dict[str, Any], OtherControllerKeys, Controller, ContinuousController]
LimitsKeys: TypeAlias = Annotated[dict[str, Any], Limits]
NamesKeys: TypeAlias = Annotated[dict[str, Any], Names]


@dataclass(frozen=True, kw_only=True, repr=False)
class NetworkTable(Displayed):
    """Keys of the table ``[network]``."""

    protocol: str = "ideal"
    actuator_loss: float = 0.0
    sensor_loss: float = 0.0
    delay: int = 0
    actuator_delay: Any = None  # checked by the link, with all its forms
    sensor_delay: Any = None
    actuator_buffer: Any = None
    sensor_buffer: Any = None
    actuator_acknowledgement_delay: int = 0
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
class File(Displayed):
    """The tables of a complete problem file."""

    plant: NominalPlantKeys
    cost: CostKeys
    network: NetworkTable | None = None
    nodes: dict[str, NodeKeys] | None = None
    links: dict[str, LinkKeys] | None = None
    reference: ReferenceKeys | None = None
    disturbance: list[EntryKeys] | None = None
    controller: ControllerKeys | None = None
    limits: LimitsKeys | None = None
    names: NamesKeys | None = None
    policy: dict[str, Any]


def first_mistake(error: ValidationError, root: type, within: Sequence[str] = ()) -> str:
    """Describe the first mistake in a table: where it is, what is wrong, and a correction.

    ``within`` are the keys that lead to the table of the class ``root``.
    """
    mistakes = sorted(error.errors(), key=lambda mistake: mistake["type"] != "extra_forbidden")
    first, place = mistakes[0], _place(root, mistakes[0]["loc"])
    extra = first["type"] == "extra_forbidden"
    place = [*place, first["loc"][-1]] if extra else place
    whole = [*within, *place]
    where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in whole).removeprefix(".")
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


ALTERNATIVES = ("float", "int", "str", "bool", "dict[str,any]")  # pydantic's names of types, of which a value has one


def _place(root: type, location: Sequence[str | int]) -> list[str | int]:
    """Return the keys and indices of a location without the names that pydantic gives to alternative types."""
    kept = list[str | int]()
    table: Any = root
    for part in location:
        keys = keys_of(table) if _is_table(table) else {}
        if isinstance(part, int):
            kept.append(part)
        elif get_origin(table) is dict and part not in ALTERNATIVES:
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
    """Write a question that suggests the most similar of several names. It is empty if none is similar."""
    import difflib  # which only a mistake needs

    lowered = {name.lower(): name for name in names}
    short = "".join(f"{re.escape(letter)}.*" for letter in word.lower()) if len(word) > 2 else "$"
    near = [name for name in lowered if re.match(short, name)]
    near = near if len(near) == 1 else difflib.get_close_matches(word.lower(), lowered, n=1, cutoff=similarity)
    return f". Did you mean {lowered[near[0]]!r}?" if near else ""


def ours(message: str) -> str:
    """Translate a message of pydantic: "Input should be a valid integer" becomes "expected a whole number"."""
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
