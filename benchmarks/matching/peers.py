"""Other ways to register a photo automatically: SIFT with RANSAC, and the normalised information distance."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

import ladarreg_core as lr
from benchmarks.matching.nid import NidPair
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import look_along
from ladarreg_core.matching.features.correlation import edge_image
from ladarreg_core.pose.estimate import PoseOptions
from ladarreg_core.pose.estimators.ransac import ransac_pose
from ladarreg_core.simulate import SimulatedCase
from ladarreg_core.surface.ranges import surface_range
from ladarreg_core.thesis.estimators.stereo_simplex import SimplexOptions
from ladarreg_core.thesis.matching.chain import ThesisOptions
from ladarreg_core.thesis.matching.densify import DensifyOptions
from ladarreg_core.thesis.matching.matcher import ThesisMatchOptions

THESIS = {
    "thesis": ThesisOptions(),
    "to the letter": ThesisOptions(
        first_pose="linear_only",
        residual="stereo",
        matching=ThesisMatchOptions(
            first_search_px=15, depth_edges="foreground", densify=DensifyOptions(kappa="equal"), culling="one_sided"
        ),
        pose=PoseOptions(simplex=SimplexOptions(restarts=0)),
    ),
}
"""Forms of the thesis's chain: with the additions, and without."""
_NID_POINTS = 20_000
_MIN_MATCHES = 6


def by_sift(case: SimulatedCase) -> lr.Rigid | None:
    """Match SIFT features of the perspective intensity image and the photo, and solve by RANSAC: the usual method."""
    return _by_sift(case, of_gradients=False)


def by_sift_on_gradients(case: SimulatedCase) -> lr.Rigid | None:
    """Match SIFT features of both gradient magnitudes, which do not depend on the sign of contrast."""
    return _by_sift(case, of_gradients=True)


def by_nid(case: SimulatedCase) -> lr.Rigid:
    """Descend in the normalised information distance of intensity and gray level, from the position of the scanner."""
    valid = case.scan.valid
    points, values = case.scan.points[valid], case.scan.intensity[valid] * case.scan.ranges[valid] ** 2
    every = max(1, len(points) // _NID_POINTS)
    gray = cv2.cvtColor(case.photo.pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    pair = NidPair(points[::every], values[::every], gray, case.photo.camera)
    return pair.refine(lr.Rigid(look_along(case.scan.mean_direction), np.zeros(3)))[0]


def _by_sift(case: SimulatedCase, *, of_gradients: bool) -> lr.Rigid | None:
    view = lr.perspective_view(case.scan, case.photo.camera)
    gray = np.sqrt(np.maximum(view.intensity, 0))
    pictures = [_stretched(gray), cv2.cvtColor(case.photo.pixels, cv2.COLOR_RGB2GRAY)]
    if of_gradients:
        pictures = [_stretched(edge_image(np.asarray(picture, np.float32))) for picture in pictures]
    sift = cv2.SIFT_create()
    (scan_keys, scan_features), (photo_keys, photo_features) = (sift.detectAndCompute(p, None) for p in pictures)
    if scan_features is None or photo_features is None or len(photo_features) < 2:
        return None
    pairs = cv2.BFMatcher().knnMatch(scan_features, photo_features, k=2)
    good = [first for first, second in pairs if first.distance < 0.85 * second.distance]
    if len(good) < _MIN_MATCHES:
        return None
    rays = view.rays_at(np.array([scan_keys[m.queryIdx].pt for m in good]))
    ranges = surface_range(case.scan, rays)
    known = np.isfinite(ranges)
    uv = np.array([photo_keys[m.trainIdx].pt for m in good])
    found = ransac_pose(
        (rays * ranges[:, None])[known], uv[known], case.photo.camera, threshold_px=5, iterations=5000, seed=0
    )
    return found.camera_from_scanner if found else None


def _stretched(picture: FloatArray) -> NDArray[np.uint8]:
    return np.asarray(np.clip(picture * (255 / max(float(np.percentile(picture, 99.5)), 1e-9)), 0, 255), np.uint8)
