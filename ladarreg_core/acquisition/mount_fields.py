"""The mount of a scanner on its pan/tilt unit, and of the unit itself, as plans and panoramas state them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError, OptionError
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.foundations.validation import is_number
from ladarreg_core.frames import Rigid, rotation_about

MOUNT_IS = (
    "unit_from_scanner: where the scanner is on the part of the unit that pans and tilts; xyz_m from where the axes "
    "cross (X forward, Y left, Z up), rpy_deg roll, pitch, yaw: R = Rz(yaw) Ry(pitch) Rx(roll)"
)
"""Explanation of a mount, written next to it."""
BASE_IS = (
    "level_from_unit: how the unit itself is turned, roll, pitch, yaw in degrees, R = Rz(yaw) Ry(pitch) Rx(roll); "
    "[0, 0, 0] stands upright, [180, 0, 0] hangs"
)
"""Explanation of a base, written next to it."""
_BASES = {"upright": (0.0, 0.0, 0.0), "hanging": (180.0, 0.0, 0.0)}
_BASE_NEEDS = "'upright', 'hanging', or roll, pitch and yaw in degrees within 360"
_MAX_DEG = 360.0


def mount_from_fields(fields: object, what: str = "the mount") -> Rigid:
    """Return `unit_from_scanner` of `{"xyz_m": [x, y, z], "rpy_deg": [roll, pitch, yaw]}`.

    Raises:
        FormatError: if it is anything else.
    """
    if not isinstance(fields, Mapping):
        raise FormatError(f'{what} must be {{"xyz_m": [x, y, z], "rpy_deg": [roll, pitch, yaw]}}')
    numbers = []
    for name in ("xyz_m", "rpy_deg"):
        three = fields.get(name)
        if not (isinstance(three, list | tuple) and len(three) == 3 and all(map(is_number, three))):
            raise FormatError(f"{name} of {what} is missing or not three finite numbers")
        numbers.append(np.array(three, np.float64))
    return Rigid(_rotation(numbers[1]), numbers[0])


def mount_as_fields(unit_from_scanner: Rigid) -> dict[str, list[float]]:
    """Return the fields that `mount_from_fields` reads."""
    return {
        "xyz_m": [float(value) for value in unit_from_scanner.translation],
        "rpy_deg": _roll_pitch_yaw(unit_from_scanner),
    }


def base_from_value(value: object) -> Rigid:
    """Return `level_from_unit`, a rotation: `upright`, `hanging`, or roll, pitch and yaw in degrees.

    An inclinometer on the base measures roll and pitch.

    Raises:
        FormatError: if it is anything else.
    """
    angles = _BASES.get(value) if isinstance(value, str) else value
    three = list(angles) if isinstance(angles, list | tuple) else []
    if not (len(three) == 3 and all(map(is_number, three)) and max(map(abs, three)) <= _MAX_DEG):
        raise FormatError(f"the base is {one_line(repr(value), 60)}; it must be {_BASE_NEEDS}")
    return Rigid(_rotation(np.array(three, np.float64)), np.zeros(3))


def base_of_text(text: str) -> Rigid:
    """Return `level_from_unit` of a word, or of three numbers with commas.

    Raises:
        OptionError: if it is neither.
    """
    parts = text.split(",")
    try:
        return base_from_value([float(part) for part in parts] if len(parts) == 3 else text.strip())
    except (FormatError, ValueError):
        raise OptionError(f"the base is {one_line(text, 60)!r}; it must be {_BASE_NEEDS}") from None


def base_as_value(level_from_unit: Rigid) -> str | list[float]:
    """Return the value that `base_from_value` reads."""
    angles = _roll_pitch_yaw(level_from_unit)
    known = (name for name, of in _BASES.items() if np.array_equal(_rotation(np.array(of)), level_from_unit.rotation))
    return next(known, angles)


def is_upright(level_from_unit: Rigid) -> bool:
    """Return whether a base stands exactly as if none were stated."""
    return bool(np.array_equal(level_from_unit.rotation, np.eye(3)))


def _rotation(angles_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Rz(yaw) Ry(pitch) Rx(roll); that of multiples of half a turn is exact."""
    roll, pitch, yaw = np.radians(angles_deg)
    rotation = rotation_about("z", yaw) @ rotation_about("y", pitch) @ rotation_about("x", roll)
    return np.round(rotation) + 0.0 if not np.any(angles_deg % 180) else rotation


def _roll_pitch_yaw(pose: Rigid) -> list[float]:
    """Return roll, pitch and yaw of a rotation, deg."""
    R = pose.rotation
    level = float(np.hypot(R[0, 0], R[1, 0]))
    pitch = np.arctan2(-R[2, 0], level)
    if level > 1e-9:
        roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    else:  # pitched by 90 deg: only roll and yaw together are determined
        roll, yaw = np.arctan2(-R[1, 2], R[1, 1]), 0.0
    return [float(np.degrees(value)) for value in (roll, pitch, yaw)]
