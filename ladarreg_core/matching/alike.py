"""Verified poses side by side: one place seen in several views of the scan, or places that look alike."""

from __future__ import annotations

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan

_SAMPLES = 10_000
_SAME_START_PX = 40.0  # the basin of a climb
_SAME_PLACE_PX = 8.0


class Places:
    """The poses at which a photo was verified, and which of them are the same.

    Args:
        scan: the scan.
        camera: the photo's camera.
    """

    def __init__(self, scan: Scan, camera: Camera) -> None:
        stride = max(1, int(np.sqrt(scan.ranges.size / _SAMPLES)))
        points = scan.points[::stride, ::stride].reshape(-1, 3).astype(np.float64)
        self._points = points[np.isfinite(points).all(axis=-1)]
        self._camera = camera
        self._poses: list[Rigid] = []

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, pose: Rigid) -> None:
        """Keep a verified pose."""
        self._poses.append(pose)

    def leads_to_one(self, start: Rigid) -> bool:
        """Return whether a climb from here would only end at a pose that is kept already."""
        return any(self._apart_px(pose, start) < _SAME_START_PX for pose in self._poses)

    def other_than(self, pose: Rigid) -> Rigid | None:
        """Return a kept pose that puts the photo elsewhere; None where all are this place."""
        return next((other for other in self._poses if self._apart_px(other, pose) > _SAME_PLACE_PX), None)

    def apart(self, first: Rigid, second: Rigid) -> bool:
        """Return whether two poses put the photo at different places."""
        return self._apart_px(first, second) > _SAME_PLACE_PX

    def _apart_px(self, first: Rigid, second: Rigid) -> float:
        """Return the median distance in the photo of what the first pose sees; infinite where the second sees none."""
        uv = self._camera.project(first @ self._points)
        seen = self._camera.contains(uv)
        if not seen.any():
            return float("inf")
        off = np.hypot(*(self._camera.project(second @ self._points[seen]) - uv[seen]).T)
        return float(np.median(np.where(np.isfinite(off), off, np.inf)))


def alike_in_words(first: Rigid, second: Rigid) -> str:
    """Return what is to be said where a photo is verified at two places."""
    apart, turned = first.distance_to(second), float(np.degrees(first.angle_to(second)))
    return (
        f"Two places in the scan look alike to this photo: both poses agree with the pictures, and they are "
        f"{apart:.2f} m and {turned:.1f} deg apart."
    )
