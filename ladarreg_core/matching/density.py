"""How densely a scan samples what a photo shows, and whether that is enough to compare the two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan

NEEDED_POINTS = 25_000
"""Returns in a whole picture from which the method works: it compares at the scan's resolution, not the photo's."""
_SAMPLES = 200_000
_TILES = (16, 10)


@dataclass(frozen=True, slots=True)
class Density:
    """How a photo would be sampled by a scan."""

    points: int
    """Returns within the picture, occluded ones included."""
    photo_px_per_point: float
    """Photo pixels to a return, where there are any returns near."""
    needed_px_per_point: float
    """As many at the most let the method work."""

    @property
    def too_sparse(self) -> bool:
        """Whether too few returns lie in the picture for any pose to be told."""
        return self.photo_px_per_point > self.needed_px_per_point

    def in_words(self) -> str:
        """Return what is to be said of a scan that is too sparse."""
        return (
            f"The scan is too sparse for this photo: 1 point per {self.photo_px_per_point:.0f} photo pixels "
            f"({self.points:,} points in its view), and it needs about 1 per {self.needed_px_per_point:.0f}; scan more "
            "finely, or add up several scans."
        )


def density_in(scan: Scan, camera: Camera, poses: Sequence[Rigid]) -> Density | None:
    """Return how densely a photo is sampled at the densest of some poses, or None where it sees no return at any.

    Args:
        scan: the scan.
        camera: the photo's own camera.
        poses: `camera_from_scanner`, rough ones: views from the scanner's own place are enough.
    """
    stride = max(1, round(float(np.sqrt(scan.ranges.size / _SAMPLES))))
    points = scan.points[::stride, ::stride].reshape(-1, 3).astype(np.float64)
    points = points[np.isfinite(points).all(axis=-1)]
    densest: Density | None = None
    area = camera.width * camera.height
    for pose in poses:
        uv = camera.project(pose @ points)
        uv = uv[camera.contains(uv)]
        count = len(uv) * stride**2
        if not count or (densest is not None and count <= densest.points):
            continue
        tiles = np.array(_TILES)
        column, row = np.minimum(np.floor((uv + 0.5) * tiles / camera.size).astype(np.intp), tiles - 1).T
        seen = np.bincount(row * _TILES[0] + column, minlength=_TILES[0] * _TILES[1])
        covered = np.count_nonzero(seen) / len(seen)
        densest = Density(count, covered * area / count, area / NEEDED_POINTS)
    return densest
