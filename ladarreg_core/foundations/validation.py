"""Checks of arguments and options: each raises an error that says what was found and what is needed."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np

from ladarreg_core.errors import LadarregError, OptionError

LARGEST_INT = 2**31 - 1
"""Upper bound of seeds and counts: what every file format and random generator takes."""

_T = TypeVar("_T")
_LONGEST_VALUE = 80  # characters of a refused value that are shown
_FIRST_GROUPED = 10_000  # from here on, thousands are separated


def require_choice(
    value: object, choices: Iterable[object], name: str, *, error: type[LadarregError] = OptionError
) -> None:
    """Raise `error` unless a value is one of the choices.

    Args:
        value: the value given.
        choices: the values allowed, e.g. `get_args` of a literal type.
        name: the subject of the sentence, e.g. 'the method'.
        error: the exception type.
    """
    known = tuple(choices)
    if not any(type(value) is type(choice) and value == choice for choice in known):
        raise error(f"{name} is {_shown(value)}; it must be one of {', '.join(map(str, known))}")


def require_int(
    value: Any,
    name: str,
    *,
    least: int,
    most: int | None = None,
    unit: str = "",
    error: type[LadarregError] = OptionError,
) -> int:
    """Return a whole number as an int; raise `error` if it is none (True and False are none) or out of bounds.

    Args:
        value: the value given.
        name: the subject of the sentence.
        least: smallest value allowed.
        most: largest value allowed; None: any.
        unit: what is counted, e.g. 'pixels'.
        error: the exception type.
    """
    if is_int(value) and least <= value and (most is None or value <= most):
        return int(value)
    counted = f"a whole number of {unit}" if unit else "a whole number"
    if most is not None:
        extent = f" from {_grouped(least)} to {_grouped(most)}"
    else:
        extent = f", at least {_grouped(least)}" if unit else f" of at least {_grouped(least)}"
    raise error(f"{name} is {_shown(value)}; it must be {counted}{extent}")


def require_number(
    value: Any,
    name: str,
    *,
    least: float = -math.inf,
    most: float = math.inf,
    unit: str = "",
    error: type[LadarregError] = OptionError,
) -> float:
    """Return a finite number as a float; raise `error` if it is none or out of bounds.

    Args:
        value: the value given.
        name: the subject of the sentence.
        least: smallest value allowed.
        most: largest value allowed.
        unit: what is measured, e.g. 'metres'.
        error: the exception type.
    """
    if is_number(value) and least <= value <= most:
        return float(value)
    of_unit = f" of {unit}" if unit else ""
    if math.isinf(least) and math.isinf(most):
        raise error(f"{name} is {_shown(value)}; it must be a finite number{of_unit}")
    if math.isinf(most):
        extent = f", at least {least:g}" if unit else f" of at least {least:g}"
    elif math.isinf(least):
        extent = f", at most {most:g}"
    else:
        extent = f" from {least:g} to {most:g}"
    raise error(f"{name} is {_shown(value)}; it must be a number{of_unit}{extent}")


def require_positive(
    value: Any,
    name: str,
    *,
    most: float = math.inf,
    unit: str = "",
    error: type[LadarregError] = OptionError,
) -> float:
    """Return a finite number above 0, at most `most`, as a float; raise `error` for anything else."""
    if is_number(value) and 0 < value <= most:
        return float(value)
    of_unit = f" of {unit}" if unit else ""
    extent = "" if math.isinf(most) else f", at most {most:g}"
    raise error(f"{name} is {_shown(value)}; it must be a positive number{of_unit}{extent}")


def require_type(value: object, kind: type[_T], name: str, *, error: type[LadarregError] = OptionError) -> _T:
    """Return a value of a type; raise `error` if it is of another one."""
    if isinstance(value, kind):
        return value
    raise error(f"{name} is {_with_article(type(value).__name__)}; give {_with_article(kind.__name__)}")


def is_int(value: Any) -> bool:
    """Return whether a value is a whole number of Python's or NumPy's, and not a truth value."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Return whether a value is a finite real number of Python's or NumPy's, and not a truth value."""
    if isinstance(value, np.integer | np.floating):
        return bool(np.isfinite(value))
    # Python compares exactly: a whole number too large for a float counts as infinite.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _shown(value: object) -> str:
    text = str(value) if isinstance(value, np.generic) else repr(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."


def _grouped(number: int) -> str:
    return f"{number:,}" if abs(number) >= _FIRST_GROUPED else str(number)


def _with_article(noun: str) -> str:
    return f"{'an' if noun[:1].lower() in set('aeiou') else 'a'} {noun}"
