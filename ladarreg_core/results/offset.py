"""The offset between two cameras on one mount."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.foundations.validation import require_number
from ladarreg_core.frames import Rigid

STATED_OFFSET_SIGMA_RAD = float(np.radians(0.2))
"""Standard deviation assumed for the rotation of an offset if none is given."""
STATED_OFFSET_SIGMA_M = 0.005
"""Standard deviation assumed for the translation of an offset if none is given."""


@dataclass(frozen=True, slots=True)
class Offset:
    """Pose of a second camera relative to the first one on the same mount, with its uncertainty.

    Raises:
        OptionError: if a standard deviation is negative or not finite.
    """

    camera_b_from_camera_a: Rigid
    """From a calibration of the mount."""
    sigma_angle_rad: float = STATED_OFFSET_SIGMA_RAD
    """Standard deviation of its rotation about each axis."""
    sigma_position_m: float = STATED_OFFSET_SIGMA_M
    """Standard deviation of the position of camera b in the frame of camera a, along each axis."""

    def __post_init__(self) -> None:
        for name in ("sigma_angle_rad", "sigma_position_m"):
            require_number(getattr(self, name), f"the offset's {name}", least=0)
