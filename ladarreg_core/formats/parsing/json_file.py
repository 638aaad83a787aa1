"""Strict reading and writing of small JSON files; errors name the field."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NoReturn

from ladarreg_core.errors import ExportError, FormatError
from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, shown_name
from ladarreg_core.storage.checksums import CHECKSUM_FIELD

LARGEST_BYTES = 8_000_000
"""Size limit; cameras, poses, matches, descriptors and results are smaller."""
_LOOKED_AT = 512  # bytes
_NOT_TEXT = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f]")
_WHAT = "\0"  # placeholder in a reason for the expected content
_parsed: ContextVar[dict[Path, dict[str, Any] | str] | None] = ContextVar("parsed", default=None)


@contextmanager
def parsed_once() -> Iterator[None]:
    """Cache parsed JSON files until the block ends, so that recognising and reading a file parse it only once.

    Blocks may be nested; the outermost one owns the cache. Cached objects must not be modified.
    """
    if _parsed.get() is not None:
        yield
        return
    token = _parsed.set({})
    try:
        yield
    finally:
        _parsed.reset(token)


def begins_with_brace(file: Path) -> bool:
    """Return whether a text file begins like a JSON object."""
    with open(file, "rb") as stream:
        return looks_like_json(stream.read(_LOOKED_AT))


def looks_like_json(head: bytes) -> bool:
    """Return whether the first bytes of a file are a brace and text; a number may begin with the byte of a brace."""
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip(b" \r\n\t")
    return start.startswith(b"{") and not _NOT_TEXT.search(head[:_LOOKED_AT])


def read_json_object(path: Path, what: str) -> dict[str, Any]:
    """Return the object in a JSON file.

    Args:
        path: an existing file.
        what: expected content, for error messages.

    Raises:
        FormatError: if it is too large, is not JSON, contains NaN or infinity, or is not an object.
    """
    known = _parsed.get()
    found = None if known is None else known.get(path)
    if found is None:
        found = _parse(path)
        if known is not None:
            known[path] = found
    if isinstance(found, str):
        raise FormatError(found.replace(_WHAT, what))
    return found


def _parse(path: Path) -> dict[str, Any] | str:
    """Return the object in a JSON file, or a sentence that says why there is none."""
    size = path.stat().st_size
    if size > LARGEST_BYTES:
        return f"it has {size:,} bytes; {_WHAT} has at most {LARGEST_BYTES:,}: give the right file"
    try:
        twice: list[str] = []
        value = json.loads(
            path.read_text(encoding="utf-8-sig"),
            parse_constant=_no_constant,
            object_pairs_hook=lambda pairs: _object(pairs, twice),
        )
    except FormatError as error:
        return str(error)
    except UnicodeDecodeError:
        return f"it is not UTF-8 text; {_WHAT} is JSON"
    except RecursionError:
        return f"its JSON is nested too deeply for {_WHAT}; give the right file"
    except json.JSONDecodeError as error:
        return f"it is not valid JSON ({error.msg}, line {error.lineno}); {_WHAT} is JSON"
    except ValueError as error:  # integers of thousands of digits
        return f"its JSON cannot be used ({one_line(error, 80)})"
    if not isinstance(value, dict):
        return f"its JSON is a {type(value).__name__}; {_WHAT} is an object in braces"
    if twice and CHECKSUM_FIELD in value:  # readers would disagree on what its checksum is of
        return f"its JSON states {one_line(twice[0], 40)!r} twice; give the file as it was written"
    return value


def _object(pairs: Sequence[tuple[str, Any]], twice: list[str]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice.append(next(name for name in names if names.count(name) > 1))
    return found


def _no_constant(name: str) -> NoReturn:
    raise FormatError(f"its JSON contains {name}; numbers must be finite")


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
    """Return a field that must be a finite number.

    Raises:
        FormatError: if it is missing (and has no default) or not a finite number.
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
    """Return a field that must be an integer of at least `least`.

    Raises:
        FormatError: if it is missing (and has no default) or not such an integer.
    """
    value = number(fields, name, default)
    if value != int(value) or value < least or value >= 2**53:
        raise FormatError(f"the field {name!r} is {value:g}; it must be a whole number of at least {least}")
    return int(value)


def choice(fields: Mapping[str, Any], name: str, allowed: tuple[str, ...], default: str | None = None) -> str:
    """Return a field that must be one of a few words.

    Raises:
        FormatError: if it is missing (and has no default) or has another value.
    """
    value = fields.get(name, default)
    if value not in allowed:
        found = "missing" if value is None else one_line(repr(value), 60)
        raise FormatError(f"the field {name!r} is {found}; it must be one of {', '.join(allowed)}")
    return str(value)
