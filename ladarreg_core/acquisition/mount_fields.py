"""The mount of a scanner on its pan/tilt unit, as plans and panoramas state it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ladarreg_core.errors import FormatError
from ladarreg_core.foundations.validation import is_number
from ladarreg_core.frames import Rigid, rotation_about

MOUNT_IS = (
    "unit_from_scanner: where the scanner is on the part of the unit that pans and tilts; xyz_m from where the axes "
    "cross (X forward, Y left, Z up), rpy_deg roll, pitch, yaw: R = Rz(yaw) Ry(pitch) Rx(roll)"
)
"""Explanation of a mount, written next to it."""


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
    roll, pitch, yaw = np.radians(numbers[1])
    rotation = rotation_about("z", yaw) @ rotation_about("y", pitch) @ rotation_about("x", roll)
    return Rigid(rotation, numbers[0])


def mount_as_fields(unit_from_scanner: Rigid) -> dict[str, list[float]]:
    """Return the fields that `mount_from_fields` reads."""
    R = unit_from_scanner.rotation
    level = float(np.hypot(R[0, 0], R[1, 0]))
    pitch = np.arctan2(-R[2, 0], level)
    if level > 1e-9:
        roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    else:  # pitched by 90 deg: only roll and yaw together are determined
        roll, yaw = np.arctan2(-R[1, 2], R[1, 1]), 0.0
    return {
        "xyz_m": [float(value) for value in unit_from_scanner.translation],
        "rpy_deg": [float(np.degrees(value)) for value in (roll, pitch, yaw)],
    }
