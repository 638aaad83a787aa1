"""Checks of the numbers that camera models are made of."""

from __future__ import annotations

from typing import Any

import numpy as np

from ladarreg_core.errors import CameraError

_FOCAL_PX = (1e-6, 1e12)  # squares of others leave the range of floating point


def checked_size(value: Any, name: str) -> int:
    """Return a width or height as a whole number of pixels.

    Raises:
        CameraError: if it is not one, or not at least 1.
    """
    if isinstance(value, bool) or not as_number(value).is_integer() or value < 1:
        raise CameraError(f"camera {name} is {value!r}; it must be a whole number of pixels, at least 1")
    return int(value)


def checked_focal(value: Any, name: str) -> float:
    """Return a focal length, pixels.

    Raises:
        CameraError: if it is not a positive and plausible number.
    """
    number = as_number(value)
    if not _FOCAL_PX[0] <= number <= _FOCAL_PX[1]:
        extent = f" from {_FOCAL_PX[0]:g} to {_FOCAL_PX[1]:g}" if number > 0 else ""
        raise CameraError(f"camera {name} is {value!r}; it must be a positive number of pixels{extent}")
    return number


def checked_centre(value: Any, name: str) -> float:
    """Return a coordinate of the principal point, pixels.

    Raises:
        CameraError: if it is not a finite number.
    """
    number = as_number(value)
    if not np.isfinite(number):
        raise CameraError(f"camera {name} is {value!r}; it must be a finite number of pixels")
    return number


def checked_terms(value: Any, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Return the terms of a distortion; empty if all are zero.

    Raises:
        CameraError: if their count is not one of `counts`, or one is not finite.
    """
    try:
        terms = tuple(as_number(k) for k in value)
    except TypeError:
        terms = (np.nan,)
    if len(terms) not in counts or not np.isfinite(terms).all():
        *most, last = map(str, counts)
        raise CameraError(f"camera distortion is {value!r:.80}; it must be {', '.join(most)} or {last} finite terms")
    return terms if any(terms) else ()


def as_number(value: Any) -> float:
    """Return a value as a float; NaN if it is not a number."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return float("nan")
