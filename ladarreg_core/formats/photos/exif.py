"""Facts from EXIF tags: the camera's orientation and its focal length."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

ORIENTATION = 0x0112
_FOCAL_LENGTH = 0x920A
_FOCAL_35MM = 0xA405
_PLANE_X_RESOLUTION = 0xA20E
_PLANE_UNIT = 0xA210
_PIXEL_X_DIMENSION, _PIXEL_Y_DIMENSION = 0xA002, 0xA003
_SENSOR_MM = (2.0, 70.0)
_SAME_SHAPE = 0.01
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_FILM_DIAGONAL_MM = math.hypot(36, 24)
_PLAUSIBLE = (0.2, 40.0)
_DISAGREEMENT = 0.1
_DIGITAL_ZOOM = 0xA404
_DIGITAL_ZOOMS = (1.01, 20.0)
_SENSORS = (4 / 3, 3 / 2)
_SAME_SENSOR = 0.02
_MIN_CROP_OF_PHONES = 3.0  # 35 mm equivalent over focal length; 2.7 is a compact camera's 1-inch sensor


@dataclass(frozen=True, slots=True)
class ExifFocal:
    """A focal length and its origin."""

    focal_px: float
    """Focal length, pixels."""
    source: str
    """Origin, worded for the photo's notes."""


def orientation_of(tags: Mapping[int, Any]) -> int:
    """Return the EXIF orientation, 1 to 8; 1 where it is absent or invalid."""
    value = tags.get(ORIENTATION, 1)
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def upright(values: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Return an image (H, W, ...) rotated and mirrored according to its EXIF orientation."""
    if orientation in (2, 3):
        values = values[:, ::-1]
    if orientation in (3, 4):
        values = values[::-1]
    if orientation in (5, 6, 7, 8):
        values = np.swapaxes(values, 0, 1)
        if orientation in (6, 7):
            values = values[:, ::-1]
        if orientation in (7, 8):
            values = values[::-1]
    return np.ascontiguousarray(values)


def focal_from_exif(tags: Mapping[int, Any], raw_width: int, raw_height: int) -> ExifFocal | None:
    """Return the most plausible of `focal_lengths`, or None where the tags do not give any."""
    return next(iter(focal_lengths(tags, raw_width, raw_height)), None)


def focal_lengths(tags: Mapping[int, Any], raw_width: int, raw_height: int) -> tuple[ExifFocal, ...]:
    """Return the focal lengths that the tags admit, the most plausible first; empty where they give none.

    The focal plane's resolution is used where it agrees within 10 % with a 35 mm equivalent (or there is none), since
    the equivalent is rounded. Otherwise the equivalent is converted by a diagonal, along which manufacturers compare
    angles of view: the image's own, if it has the shape of a sensor (4:3 or 3:2). A phone that saves 16:9, 20:9 or 1:1
    keeps the equivalent of its whole sensor, of which the image is a part; what edits such pictures may not. Likewise,
    the equivalent may or may not include a digital zoom.

    Args:
        tags: EXIF tags by number.
        raw_width: image width before any rotation, pixels.
        raw_height: image height before any rotation, pixels.
    """
    plane = _by_focal_plane(tags, raw_width, raw_height)
    film = _number(tags.get(_FOCAL_35MM))
    by_film = _by_equivalent(film, tags, raw_width, raw_height) if film else []
    found = [focal for focal in by_film if _plausible(focal.focal_px, raw_width, raw_height)]
    if plane is not None:
        if not found or any(abs(plane.focal_px / focal.focal_px - 1) <= _DISAGREEMENT for focal in found):
            return (plane,)
        found.append(plane)
    return tuple(found)


def _by_equivalent(film_mm: float, tags: Mapping[int, Any], width: int, height: int) -> list[ExifFocal]:
    own = ExifFocal(
        focal_of_35mm(film_mm, width, height), f"EXIF: {film_mm:g} mm (35 mm equivalent), accurate to a few percent"
    )
    found = [own]
    longer, shorter = max(width, height), min(width, height)
    if all(abs(longer / shorter / shape - 1) > _SAME_SENSOR for shape in _SENSORS):
        sensors = _SENSORS if (focal_mm_of(tags) or 0) * _MIN_CROP_OF_PHONES < film_mm else _SENSORS[::-1]
        whole = []
        for shape in sensors:
            size = (longer, longer / shape) if longer / shorter > shape else (shorter * shape, shorter)
            named = "4:3" if shape == _SENSORS[0] else "3:2"
            whole.append(
                ExifFocal(
                    focal_of_35mm(film_mm, *size),
                    f"EXIF: {film_mm:g} mm (35 mm equivalent) of a whole {named} sensor of which the image is a part",
                )
            )
        found = [*whole, own] if focal_mm_of(tags) else [own, *whole]
    zoom = _number(tags.get(_DIGITAL_ZOOM))
    if zoom is not None and _DIGITAL_ZOOMS[0] < zoom <= _DIGITAL_ZOOMS[1]:
        found += [ExifFocal(f.focal_px * zoom, f"{f.source}, before a digital zoom of {zoom:g}") for f in found]
    return found


def focal_of_35mm(equivalent_mm: float, width: float, height: float) -> float:
    """Return the focal length, pixels, of a 35 mm equivalent, by the image's diagonal.

    Args:
        equivalent_mm: 35 mm equivalent focal length, mm.
        width: image width, pixels; rotated or not makes no difference.
        height: image height, pixels.
    """
    return equivalent_mm / _FILM_DIAGONAL_MM * math.hypot(width, height)


def _by_focal_plane(tags: Mapping[int, Any], raw_width: int, raw_height: int) -> ExifFocal | None:
    focal_mm, resolution = _number(tags.get(_FOCAL_LENGTH)), _number(tags.get(_PLANE_X_RESOLUTION))
    unit_mm = _UNIT_MM.get(tags.get(_PLANE_UNIT, 2))
    if not (focal_mm and resolution and unit_mm):
        return None
    full_width = _number(tags.get(_PIXEL_X_DIMENSION)) or raw_width  # the image may have been resized since
    if not _SENSOR_MM[0] <= full_width * unit_mm / resolution <= _SENSOR_MM[1]:
        return None
    focal = focal_mm * resolution / unit_mm * raw_width / full_width
    if not _plausible(focal, raw_width, raw_height):
        return None
    return ExifFocal(focal, f"EXIF: {focal_mm:g} mm at {resolution / unit_mm:.1f} pixels per mm of the sensor")


def focal_mm_of(tags: Mapping[int, Any]) -> float | None:
    """Return the focal length of the lens, mm; None where EXIF does not state it."""
    return _number(tags.get(_FOCAL_LENGTH))


def edited_since(tags: Mapping[int, Any], raw_width: int, raw_height: int) -> str | None:
    """Return a warning if EXIF states a size of another shape than the image's: it was cropped since it was taken."""
    width, height = _number(tags.get(_PIXEL_X_DIMENSION)), _number(tags.get(_PIXEL_Y_DIMENSION))
    if width is None or height is None:
        return None
    longer, shorter = max(width, height), min(width, height)
    if abs(longer / shorter * min(raw_width, raw_height) / max(raw_width, raw_height) - 1) <= _SAME_SHAPE:
        return None
    return (
        f"EXIF states {width:g} x {height:g} pixels, the image has {raw_width} x {raw_height}: it was cropped, so the "
        "focal length may be wrong; give the original, or `focal_px`"
    )


def _plausible(focal_px: float, width: int, height: int) -> bool:
    low, high = _PLAUSIBLE
    return low * max(width, height) <= focal_px <= high * max(width, height)


def _number(value: Any) -> float | None:
    """Return a positive finite number, or None: EXIF rationals may be 0/0."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def exif_facts(tags: Mapping[int, Any]) -> dict[str, Any]:
    """Return the tags that an operator may want to see: make, model, lens, focal length and orientation."""
    facts: dict[str, Any] = {}
    for name, tag in (("make", 0x010F), ("model", 0x0110), ("lens", 0xA434)):
        if isinstance(tags.get(tag), str) and tags[tag].strip("\0 "):
            facts[name] = tags[tag].strip("\0 ")
    focal, film = _number(tags.get(_FOCAL_LENGTH)), _number(tags.get(_FOCAL_35MM))
    if focal:
        facts["focal_mm"] = focal
    if film:
        facts["focal_35mm_equivalent"] = film
    if orientation_of(tags) != 1:
        facts["orientation"] = orientation_of(tags)
    return facts
