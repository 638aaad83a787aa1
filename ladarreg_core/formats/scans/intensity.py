"""Intensity of a scan's points: the names under which files keep it, and the luminance of the colours in its stead."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import FormatError, UnderspecifiedError
from ladarreg_core.formats.parsing.untrusted import as_float32, one_line
from ladarreg_core.formats.scans.scan_request import IntensitySource
from ladarreg_core.foundations.arrays import ByteArray, FloatArray
from ladarreg_core.scan import LUMA_NOTE, NO_INTENSITY_NOTE, luma

INTENSITY_NAMES = (
    "intensity", "intensities", "i", "reflectivity", "reflectance", "remission", "amplitude", "signal", "refl", "inten",
    "scan_intensity", "laser_intensity", "intensity_value", "greyscale", "grayscale",
)  # fmt: skip
"""Names of the intensity, in the order in which they are preferred; see `plain_name`."""
COLOR_NAMES = (
    ("red", "r", "diffuse_red", "rf", "red_255"),
    ("green", "g", "diffuse_green", "gf", "green_255"),
    ("blue", "b", "diffuse_blue", "bf", "blue_255"),
)
"""Names of the three colour channels."""


def plain_name(name: str) -> str:
    """Return a field's name in lower case, without quotes, a unit in brackets, and CloudCompare's prefix `scalar_`."""
    plain = name.strip().strip("\"'").strip().lower()
    for bracket in "[(":
        plain = plain.partition(bracket)[0].strip()
    return plain.removeprefix("scalar_").replace(" ", "_")


def intensity_name(names: Iterable[str]) -> str | None:
    """Return the name of the field that is the intensity; None without one."""
    return field_named(names, INTENSITY_NAMES)


def color_names(names: Iterable[str]) -> tuple[str, str, str] | None:
    """Return the names of the fields that are red, green and blue; None unless there are all three."""
    listed = list(names)
    red, green, blue = (field_named(listed, candidates) for candidates in COLOR_NAMES)
    return (red, green, blue) if red is not None and green is not None and blue is not None else None


def field_named(names: Iterable[str], candidates: Sequence[str]) -> str | None:
    """Return the field with the first of the candidate names that is there; None without one."""
    plain: dict[str, str] = {}
    for name in names:
        plain.setdefault(plain_name(name), name)
    return next((plain[candidate] for candidate in candidates if candidate in plain), None)


def require_intensity(
    source: IntensitySource, *, has_intensity: bool, has_color: bool, what: str = "the points", fields: str = ""
) -> None:
    """Refuse a cloud without the quantity that is asked for as its intensity, before its points are read.

    A cloud without intensity and without colours is no error: its shape is compared alone.

    Args:
        source: `auto`: the laser's intensity; `luma`: the luminance of the colours.
        has_intensity: whether the file has an intensity.
        has_color: whether it has colours.
        what: subject of the error, e.g. the name of the scan.
        fields: what the points have, for the error.

    Raises:
        FormatError: saying what is missing and what to do; `UnderspecifiedError` if there are colours to take.
    """
    found = f" ({one_line(fields, 60)})" if fields else ""
    if source == "luma" and not has_color:
        raise FormatError(
            f"{what} have no colours{found}, so that there is no luminance to take as the intensity; leave out "
            "`intensity='luma'`"
            if has_intensity
            else f"{what} have neither intensity nor colours{found}, so that there is no luminance to take as the "
            "intensity; leave out `intensity='luma'` to compare their shape alone, or export them with intensity"
        )
    if source == "auto" and not has_intensity and has_color:
        raise UnderspecifiedError(
            f"{what} have colours but no intensity, which is needed for matching: export with intensity, or take the "
            "luminance of the colours (`intensity='luma'`)"
        )


def chosen_intensity(
    source: IntensitySource, intensity: ArrayLike | None, color: ByteArray | None, shape: tuple[int, ...]
) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Return the intensity that is asked for, and what the operator should know of it.

    Args:
        source: as `require_intensity`, whose conditions hold.
        intensity: of that shape, the laser's; None without one.
        color: (..., 3) uint8 RGB; None without one.
        shape: of the points, (N,) or (H, W).

    Returns:
        The intensity, 0 everywhere if there is none, and notes.
    """
    if source == "luma":
        assert color is not None, "require_intensity has refused it"
        return luma(color), (LUMA_NOTE,)
    if intensity is None:
        return np.zeros(shape, np.float32), (NO_INTENSITY_NOTE,)
    strength = as_float32(intensity)
    known = strength[np.isfinite(strength)]
    if not known.size or known.min() == known.max():
        same = f"the intensity is {known.flat[0]:g} everywhere" if known.size else "the intensity is not known anywhere"
        if color is None:
            return strength, (f"{same}: only the scan's shape can be compared with a photo",)
        return strength, (
            f"{same}, which nothing can be matched by; `intensity='luma'` takes the luminance of the colours",
        )
    return strength, ()


def colors_as_bytes(channels: Sequence[NDArray[Any]]) -> ByteArray:
    """Return RGB (N, 3) of three channels (N,) of any type: 0 to 255, or 16 bits, or fractions from 0 to 1."""
    largest = max((float(np.nanmax(c, initial=0)) for c in channels if np.isfinite(c).any()), default=0.0)
    whole = all(np.issubdtype(c.dtype, np.integer) or bool((c == np.floor(c)).all()) for c in channels)
    scale = 255.0 if not whole and largest <= 1 else 1 / 257 if 255 < largest <= 65535 else 1.0
    rgb = np.empty((len(channels[0]), 3), np.uint8)
    for k, channel in enumerate(channels):
        if channel.dtype == np.uint8:
            rgb[:, k] = channel
        else:
            scaled = np.nan_to_num(np.asarray(channel, np.float64), posinf=0, neginf=0) * scale
            rgb[:, k] = np.clip(scaled, 0, 255).round()
    return rgb


def as_points(columns: Sequence[NDArray[Any]]) -> FloatArray:
    """Return (N, 3) float64 of three coordinate columns."""
    return np.stack([np.asarray(column, dtype=np.float64) for column in columns], axis=-1)
