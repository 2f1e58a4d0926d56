"""Validation of tables from a file against annotated types, by pydantic-core (its import is faster than pydantic's)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, Union, cast, get_args, get_origin, get_type_hints

from pydantic_core import SchemaValidator, core_schema
from pydantic_core import ValidationError as ValidationError

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

    Args:
        hint: a dataclass, a number type, text, a literal, a list, a mapping, or a union of them.
        value: the value.

    Raises:
        ValidationError: the value does not have the type.
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
    if is_dataclass(hint):
        hints, build = get_type_hints(hint), cast("Callable[..., object]", hint)
        keys = {
            field.name: core_schema.typed_dict_field(_schema(hints[field.name]), required=field.default is MISSING)
            for field in fields(hint)
        }
        table = core_schema.typed_dict_schema(keys, extra_behavior="forbid", strict=True)
        return core_schema.no_info_after_validator_function(lambda found: build(**found), table)
    return _SIMPLE[hint]
