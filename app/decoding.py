"""Decoding of what a page sends into structs; errors state what was found and what a field must be."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta, UnsetType

from ladarreg_core.errors import OptionError
from ladarreg_core.project.edits import finite

Kind = TypeVar("Kind", bound=msgspec.Struct)
_MAX_QUOTE = 40
_PLACE = re.compile(r" - at `\$\.(\w+)[^`]*`$")
_MISSING = re.compile(r"missing required field `(\w+)`")


def decoded(kind: type[Kind], fields: Mapping[str, Any], *, arguments: bool = False) -> Kind:
    """Return a struct of fields; with `arguments` errors name them as arguments of the core, which have labels.

    Raises:
        OptionError: if a field is missing, or is not of its type or range.
    """
    try:
        return msgspec.convert(fields, kind)
    except msgspec.ValidationError as error:
        raise OptionError(_fault(kind, fields, str(error), arguments), field=_field_of(str(error))) from None
    except (UnicodeEncodeError, OverflowError, RecursionError):
        raise OptionError("a field contains no text or number that can be read; enter it again") from None


def quoted(value: object) -> str:
    """Return a short quotation of any value for an error message."""
    if isinstance(value, str):
        return repr(value[:_MAX_QUOTE])
    number = finite(value)
    if number is not None and not isinstance(value, bool):
        return f"{number:g}"
    words: dict[type, str] = {type(None): "missing", bool: str(value).lower(), list: "a list", dict: "an object"}
    return words.get(type(value), "not a finite number")


def types_of(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the types of a struct's fields, with their annotations, in the order in which they are stated."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: hints[name] for name in kind.__struct_fields__}


def without_meta(kind: Any) -> tuple[Any, Meta | None]:
    """Return a type without the annotations around it, and these; of an optional type those of what it may be."""
    if get_origin(kind) is Annotated:
        return get_args(kind)[0], get_args(kind)[1]
    for part in get_args(kind) if is_union(kind) else ():
        if get_origin(part) is Annotated:
            return kind, get_args(part)[1]
    return kind, None


def is_union(kind: Any) -> bool:
    """Return whether a type is one of several."""
    return get_origin(kind) is Union or type(kind).__name__ == "UnionType"


def _fault(kind: type[msgspec.Struct], fields: Mapping[str, Any], error: str, arguments: bool) -> str:
    """Return what was found and what is needed, in place of the decoder's words."""
    name = _field_of(error)
    if not name:
        return "the command is not an object with fields; reload the page"
    bare, meta = without_meta(types_of(kind)[name])
    if meta is not None and meta.title:
        return meta.title
    needed = (meta.description if meta is not None else None) or _needed(bare)
    called = f"`{name}`" if arguments else name
    return f"{called} is {quoted(fields.get(name))}; it must be {needed}"


def _field_of(error: str) -> str:
    """Return the name of the field that the decoder refuses; empty if it is none."""
    place = _PLACE.search(error) or _MISSING.search(error)
    return place[1] if place else ""


def _needed(kind: Any) -> str:
    """Return what a field must be, in words."""
    if get_origin(kind) is Literal:
        choices = [repr(choice) for choice in get_args(kind)]
        return " or ".join([", ".join(choices[:-1]), choices[-1]] if choices[1:] else choices)
    if is_union(kind):
        return " or ".join(_needed(part) for part in get_args(kind) if part not in (type(None), UnsetType))
    bare, _ = without_meta(kind)
    words: dict[Any, str] = {
        str: "a text", bool: "true or false", int: "a whole number", float: "a number", type(None): "null",
    }  # fmt: skip
    return words.get(bare, "a list" if get_origin(bare) in (list, tuple) else "an object")
