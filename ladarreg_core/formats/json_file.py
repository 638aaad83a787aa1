"""JSON files: strict, small, and with errors that name the field."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from ladarreg_core.errors import ExportError, FormatError
from ladarreg_core.formats.untrusted import PathLike, one_line, shown_name

_LARGEST_BYTES = 64 << 20


def read_json_object(path: Path, what: str) -> dict[str, Any]:
    """Return the object that a JSON file holds.

    Args:
        path: a file that exists.
        what: what it should be, for the error.

    Raises:
        FormatError: if it is too large, no JSON, holds NaN or infinity, or is no object.
    """
    if path.stat().st_size > _LARGEST_BYTES:
        raise FormatError(f"it has {path.stat().st_size:,} bytes, too many for {what}; give the right file")
    try:
        value = json.loads(path.read_text(encoding="utf-8-sig"), parse_constant=_no_constant)
    except UnicodeDecodeError:
        raise FormatError(f"it is no text in UTF-8; {what} is JSON") from None
    except RecursionError:
        raise FormatError(f"its JSON is nested too deeply for {what}; give the right file") from None
    except json.JSONDecodeError as error:
        raise FormatError(f"it is no JSON ({error.msg}, line {error.lineno}); {what} is JSON") from None
    except ValueError as error:  # integers of thousands of digits
        raise FormatError(f"it is no usable JSON ({one_line(error, 80)})") from None
    if not isinstance(value, dict):
        raise FormatError(f"its JSON is a {type(value).__name__}; {what} is an object in braces")
    return value


def _no_constant(name: str) -> NoReturn:
    raise FormatError(f"its JSON holds {name}; numbers must be finite")


def write_json(path: PathLike, value: Mapping[str, Any]) -> None:
    """Write a JSON object, numbers at full precision.

    Raises:
        ExportError: if the file cannot be written.
    """
    text = json.dumps(value, indent=1, allow_nan=False) + "\n"
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ExportError(f"{shown_name(path)} cannot be written: {error.strerror}; check the folder") from error


def number(fields: Mapping[str, Any], name: str, default: float | None = None) -> float:
    """Return a finite number.

    Raises:
        FormatError: if it is missing (and has no default) or something else.
    """
    value = fields.get(name, default)
    if value is None:
        raise FormatError(f"the field {name!r} is missing; it must be a number")
    try:
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    except OverflowError:
        pass
    raise FormatError(f"the field {name!r} is {one_line(repr(value), 60)}; it must be a finite number")


def whole_number(fields: Mapping[str, Any], name: str, default: int | None = None, *, least: int = 0) -> int:
    """Return a whole number of at least `least`.

    Raises:
        FormatError: if it is missing (and has no default) or something else.
    """
    value = number(fields, name, default)
    if value != int(value) or value < least or value >= 2**53:
        raise FormatError(f"the field {name!r} is {value:g}; it must be a whole number of at least {least}")
    return int(value)


def choice(fields: Mapping[str, Any], name: str, allowed: tuple[str, ...], default: str | None = None) -> str:
    """Return one of a few words.

    Raises:
        FormatError: if it is missing (and has no default) or another word.
    """
    value = fields.get(name, default)
    if value not in allowed:
        found = "missing" if value is None else one_line(repr(value), 60)
        raise FormatError(f"the field {name!r} is {found}; it must be one of {', '.join(allowed)}")
    return str(value)
