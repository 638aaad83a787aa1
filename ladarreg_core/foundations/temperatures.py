"""Thermal images: apparent temperature as stored in files, as displayed and as matched."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import FloatArray

CENTIKELVIN_K = 0.01
"""Step of a 16-bit thermal image, K."""

TemperatureUnit = Literal["K", "C", "none"]
"""Unit of the pixels of a thermal image; `none`: they are no temperatures."""
_FREEZING_K = 273.15
_STEPS_K = (0.01, 0.1, 1.0)
_POSSIBLE_K = (150.0, 3000.0)
_SCALE_K, _GRAY_PER_UNIT = 0.5, 60.0
_PLAUSIBLE_K = (220.0, 620.0)  # the range of uncooled cameras
_MAX_SPREAD_K = 60.0


def thermal_gray(temperature_k: FloatArray) -> NDArray[np.float32]:
    """Return a thermal image as gray levels (H, W) around 0: 60 asinh((T - median) / .5 K).

    Small differences between walls keep their contrast beside people, lamps and pipes.

    Args:
        temperature_k: (H, W) apparent temperature, K.
    """
    median = np.float32(np.median(temperature_k))
    scaled = (np.asarray(temperature_k, dtype=np.float32) - median) / np.float32(_SCALE_K)
    return np.asarray(np.float32(_GRAY_PER_UNIT) * np.arcsinh(scaled), dtype=np.float32)


def centikelvin(temperature_k: FloatArray) -> NDArray[np.uint16]:
    """Return temperatures in the encoding of 16-bit thermal images: steps of .01 K above absolute zero."""
    steps = np.rint(np.asarray(temperature_k, dtype=np.float64) / CENTIKELVIN_K)
    return np.clip(steps, 0, np.iinfo(np.uint16).max).astype(np.uint16)


def kelvin_of(values: NDArray[Any], unit: TemperatureUnit | None = None) -> NDArray[np.float32] | None:
    """Return the values of a decoded image as temperatures (H, W), K; None if it is not a thermal image.

    Without a unit, thermal images are gray, of 16 bits in centikelvin or of floating point in kelvin, and recognised by
    their values alone: all between 220 and 620 K (-53 to 347 C), the middle half within 60 K. A 16-bit photograph has
    darker and brighter pixels, or, if it is hazy, spreads its grays over a wider interval.

    Args:
        values: (H, W) or (H, W, 3), as stored in the file.
        unit: of the pixels, where it is known; whole numbers in K may be in steps of .01 or .1 K.

    Raises:
        ShapeError: if the unit is K or C and the values cannot be temperatures in it.
    """
    if unit is not None:
        return None if unit == "none" else _in_unit(values, unit)
    if values.ndim != 2 or not values.size or values.dtype.kind not in "uf" or values.dtype == np.uint8:
        return None
    step = CENTIKELVIN_K if values.dtype.kind == "u" else 1.0
    low, high = _PLAUSIBLE_K
    kelvin = _filled(values.astype(np.float64)) * step
    if not low <= float(kelvin.min()) <= float(kelvin.max()) <= high:  # false if none is finite
        return None
    quarter, three_quarters = np.percentile(kelvin, (25, 75))
    if three_quarters - quarter > _MAX_SPREAD_K:
        return None
    return kelvin.astype(np.float32)


def _filled(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return numbers with the median in place of NaN and infinity, which stand for pixels without a measurement."""
    known = np.isfinite(numbers)
    return numbers if known.all() or not known.any() else np.where(known, numbers, np.median(numbers[known]))


def _in_unit(values: NDArray[Any], unit: TemperatureUnit) -> NDArray[np.float32]:
    if values.ndim != 2 or not values.size or values.dtype == np.uint8:
        raise ShapeError(
            "the picture has 8 bits or colours, which are no temperatures; export the temperatures as TIFF, "
            "or give none as their unit"
        )
    numbers = _filled(values.astype(np.float64))
    if unit == "C":
        kelvins = [numbers + _FREEZING_K] if values.dtype.kind == "f" else []
    else:
        kelvins = [numbers] if values.dtype.kind == "f" else [numbers * step for step in _STEPS_K]
    low, high = _POSSIBLE_K
    for kelvin in kelvins:
        if low <= float(kelvin.min()) <= float(kelvin.max()) <= high:  # false if none is finite
            return kelvin.astype(np.float32)
    shown = f"{float(numbers.min()):.5g} to {float(numbers.max()):.5g}"
    kind = "whole numbers" if values.dtype.kind in "iu" else "numbers"
    raise ShapeError(
        f"the pixels are {kind} from {shown}, which cannot be temperatures in {unit}; export floating point in K or C, "
        "or give the other unit"
    )


def needs_unit(values: NDArray[Any]) -> bool:
    """Return whether a decoded image may hold temperatures whose unit must be stated: gray, 16 bits or floating point.

    Cameras write deg C, kelvin, tenths or hundredths of either, and NaN for empty pixels; gray levels can look alike.
    Floating point from -1 to 1 is a picture.
    """
    if values.ndim != 2 or not values.size or values.dtype.kind not in "uif" or values.dtype.itemsize < 2:
        return False
    known = values[np.isfinite(values)]
    return bool(known.size) and (values.dtype.kind != "f" or float(np.abs(known).max()) > 1)


def shown_values(values: NDArray[Any]) -> str:
    """Return the least and the largest finite value of an image that has some, for messages."""
    known = values[np.isfinite(values)]
    return f"{float(known.min()):.1f} to {float(known.max()):.1f}"
