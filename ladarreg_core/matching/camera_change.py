"""How the camera differs from the one that a photo was undistorted with: its focal length and its lens's k1."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from ladarreg_core.arrays import FloatArray
from ladarreg_core.camera import Camera

_MOST_LOG_FOCAL, _MOST_K1 = math.log(1.6), 0.5


@dataclass(frozen=True, slots=True)
class CameraChange:
    """A change of (log f, k1), in the ideal picture."""

    log_focal: float = 0.0
    """Of fx and fy alike."""
    k1: float = 0.0
    """Added to the lens's."""

    def after(self, step: FloatArray) -> CameraChange:
        """Return the change after a step (K,) of (log f, k1), within what a camera can be."""
        if not len(step):
            return self
        log_focal, k1 = (*map(float, step), 0.0)[:2]
        return CameraChange(_clipped(self.log_focal + log_focal, _MOST_LOG_FOCAL), _clipped(self.k1 + k1, _MOST_K1))

    def applied(self, camera: Camera) -> Camera:
        """Return a camera with the change; a lens keeps its other terms, and an ideal one gets four."""
        factor = math.exp(self.log_focal)
        first, *others = camera.distortion or (0.0,) * 4
        return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor, distortion=(first + self.k1, *others))


AS_STATED = CameraChange()
"""No change."""


def _clipped(value: float, most: float) -> float:
    return min(max(value, -most), most)
