"""The mount of a scanner on its pan/tilt unit, and of the unit itself, as plans and panoramas state them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

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
LEAN_IS = (
    "(3, 3) of w, rad: true = exp([w]x) stated, about the axes of scan.npz, from base_sigma_deg; the yaw of the "
    "base is no measurement, and defines which direction is ahead"
)
"""Explanation of the covariance of a panorama's level, written next to it."""
_BASES = {"upright": (0.0, 0.0, 0.0), "hanging": (180.0, 0.0, 0.0)}
_BASE_NEEDS = "'upright', 'hanging', or roll, pitch and yaw in degrees within 360"
_MAX_DEG = 360.0
_MAX_SIGMA_DEG = 45.0
_SIGMA_NEEDS = "the standard deviation of roll and pitch in degrees, up to 45, or one of each"


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


def base_sigma_from_value(value: object) -> tuple[float, float]:
    """Return the standard deviations of roll and pitch of a base, deg, of a number or two.

    Raises:
        FormatError: if it is anything else.
    """
    two: list[Any] = [value, value] if is_number(value) else list(value) if isinstance(value, list | tuple) else []
    if not (len(two) == 2 and all(map(is_number, two)) and min(two) >= 0 and max(two) <= _MAX_SIGMA_DEG):
        raise FormatError(f"the sigma of the base is {one_line(repr(value), 60)}; it must be {_SIGMA_NEEDS}")
    return float(two[0]), float(two[1])


def base_sigma_of_text(text: str) -> tuple[float, float]:
    """Return the standard deviations of roll and pitch of a base, deg, of a number, or of two with a comma.

    Raises:
        OptionError: if it is neither.
    """
    try:
        parts = [float(part) for part in text.split(",")]
        return base_sigma_from_value(parts[0] if len(parts) == 1 else parts)
    except (FormatError, ValueError):
        raise OptionError(f"the sigma of the base is {one_line(text, 60)!r}; it must be {_SIGMA_NEEDS}") from None


def lean_covariance(level_from_unit: Rigid, sigma_deg: tuple[float, float]) -> NDArray[np.float64]:
    """Return the covariance (3, 3) of the w, rad, by which a base that an inclinometer measured is wrong.

    The true `level_from_unit` is exp([w]x) times that stated. The roll turns about the unit's forward axis as the pitch
    and the yaw leave it, the pitch about the left axis as the yaw leaves it. The yaw is none of its measurements.

    Args:
        level_from_unit: the base as stated.
        sigma_deg: standard deviations of roll and pitch.
    """
    _, pitch, yaw = np.radians(_roll_pitch_yaw(level_from_unit))
    turned = rotation_about("z", yaw)
    axes = np.column_stack([turned @ rotation_about("y", pitch) @ [1, 0, 0], turned @ [0, 1, 0]])
    axes = axes * np.radians(sigma_deg)
    return np.asarray(axes @ axes.T, np.float64)


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
