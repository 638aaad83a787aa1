"""Two cameras on one mount: where the second sits, seen from the first, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid

STATED_OFFSET_SIGMA_RAD = float(np.radians(0.2))
"""How well a mount's turn is taken to be known where nobody says."""
STATED_OFFSET_SIGMA_M = 0.005
"""How well a mount's shift is taken to be known where nobody says."""


@dataclass(frozen=True, slots=True)
class Offset:
    """Where a second camera sits on the mount of a first, and how well that is known.

    Raises:
        OptionError: if a standard deviation is negative or not finite.
    """

    camera_b_from_camera_a: Rigid
    """From the calibration of the mount."""
    sigma_angle_rad: float = STATED_OFFSET_SIGMA_RAD
    """Standard deviation of its turn, about each axis."""
    sigma_position_m: float = STATED_OFFSET_SIGMA_M
    """Standard deviation of camera b's place in camera a's frame, along each axis."""

    def __post_init__(self) -> None:
        for name in ("sigma_angle_rad", "sigma_position_m"):
            value = getattr(self, name)
            if not np.isfinite(value) or value < 0:
                raise OptionError(f"the offset's {name} is {value:g}; it must be a finite number that is not negative")
