"""Pose hypotheses, cheapest first: corners matched by descriptors or by correlation, then RANSAC."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.features.corners import CornerOptions, find_corners
from ladarreg_core.matching.features.correlation import correlation_product, unique_matches
from ladarreg_core.matching.features.descriptors import describe
from ladarreg_core.matching.images.photo_levels import PhotoLevels
from ladarreg_core.matching.images.scan_levels import ScanLevels
from ladarreg_core.pose.estimators.ransac import ransac_pose

_RANSAC_PX = 5.0
_RANSAC_ITERATIONS = 800
_DESCRIPTOR_CORNERS = CornerOptions(count=1000, q_min=0.3, pre_blur_px=1.0, non_maximum_px=2, sub_pixel=True)
_DESCRIPTOR_MARGIN = 0.02
_NCC_CORNERS = CornerOptions(count=800, q_min=0.5, non_maximum_px=1)
_NCC_MARGIN = 0.02
_FIRST_INLIERS, _LATER_INLIERS = 12, 8


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A pose hypothesis with its matches."""

    source: str
    """The kind of matches it was found from."""
    camera_from_scanner: Rigid
    """The pose."""
    inliers: int
    """Number of inliers."""
    points: FloatArray
    """(M, 3) scan points of all matches, scanner frame, m."""
    uv: FloatArray
    """(M, 2) working pixels of all matches."""
    supported: BoolArray
    """(M,) bool: the inliers."""


def hypotheses(scan: ScanLevels, photo: PhotoLevels, *, seed: int) -> Iterator[Hypothesis | str]:
    """Yield hypotheses as they are found; a string reports an attempt that gave none.

    Args:
        scan: the scan's levels.
        photo: the photo's levels.
        seed: random seed of RANSAC.
    """
    described = _DescriptorMatcher(scan, photo)
    attempts: list[tuple[str, Callable[[], tuple[FloatArray, FloatArray]]]] = [
        ("descriptors of intensity", lambda: described.matches("intensity", lambda: scan.intensity_channels[0])),
        ("descriptors of intensity and geometry", lambda: described.matches("both", lambda: scan.channels[0])),
        ("gray and edge correlation", lambda: _correlation_matches(scan, photo)),
    ]
    needed = _FIRST_INLIERS
    for k, (source, find) in enumerate(attempts):
        scan_uv, photo_uv = find()
        found = _solve(scan, photo, scan_uv, photo_uv, source=source, needed=needed, seed=seed + k)
        yield found if found is not None else f"{source}: {len(scan_uv)} matches, no pose with {needed} inliers"
        needed = _LATER_INLIERS


class _DescriptorMatcher:
    """Matches corners by descriptors; the corners and the photo's descriptors are shared by both attempts."""

    def __init__(self, scan: ScanLevels, photo: PhotoLevels) -> None:
        self._scan = scan
        self._scan_uv, self._photo_uv = descriptor_corners(scan, photo)
        self._photo = describe(photo.channels[0], self._photo_uv)

    def matches(self, name: str, channels: Callable[[], FloatArray]) -> tuple[FloatArray, FloatArray]:
        described = self._scan.once(("descriptors", name), lambda: describe(channels(), self._scan_uv))
        score = described @ self._photo.T
        first, second, _ = unique_matches(score, margin=_DESCRIPTOR_MARGIN)
        return self._scan_uv[first], self._photo_uv[second]


def descriptor_corners(scan: ScanLevels, photo: PhotoLevels) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners that are described: pixels (N, 2) of the view and (M, 2) of the photo."""
    return view_corners(scan), photo_corners(photo)


def view_corners(scan: ScanLevels) -> NDArray[np.float64]:
    """Return the corners of a view that are described, pixels (N, 2)."""

    def found() -> NDArray[np.float64]:
        usable = np.isfinite(scan.ranges)
        if scan.structured is not None:
            usable &= scan.structured
        return find_corners(scan.gray_planes[0], _DESCRIPTOR_CORNERS, usable=usable).uv

    return scan.once("corners", found)


def photo_corners(photo: PhotoLevels) -> NDArray[np.float64]:
    """Return the corners of a photo that are described, pixels (M, 2)."""
    return find_corners(photo.gray, _DESCRIPTOR_CORNERS, usable=photo.usable[0]).uv


def points_at(scan: ScanLevels, uv: FloatArray) -> FloatArray:
    """Return the scan points (N, 3), scanner frame, m, at pixels (N, 2) of the view; NaN without a return."""
    pixel = np.rint(uv).astype(np.intp)
    return np.asarray(scan.view.rays_at(uv) * scan.ranges[pixel[:, 1], pixel[:, 0], None])


def count_inliers(scan: ScanLevels, photo: PhotoLevels, scan_uv: FloatArray, photo_uv: FloatArray, *, seed: int) -> int:
    """Return the number of RANSAC inliers among matches given as pixels (K, 2) of the view and of the photo."""
    found = _solve(scan, photo, scan_uv, photo_uv, source="", needed=_LATER_INLIERS, seed=seed)
    return 0 if found is None else found.inliers


def _correlation_matches(scan: ScanLevels, photo: PhotoLevels) -> tuple[FloatArray, FloatArray]:
    scan_gray = scan.gray_planes[0]
    scan_uv = find_corners(scan_gray, _NCC_CORNERS, usable=np.isfinite(scan.ranges)).uv
    photo_uv = find_corners(photo.gray, _NCC_CORNERS, usable=photo.usable[0]).uv
    first, second, _ = unique_matches(correlation_product(scan_gray, scan_uv, photo.gray, photo_uv), margin=_NCC_MARGIN)
    return scan_uv[first], photo_uv[second]


def _solve(
    scan: ScanLevels,
    photo: PhotoLevels,
    scan_uv: FloatArray,
    photo_uv: FloatArray,
    *,
    source: str,
    needed: int,
    seed: int,
) -> Hypothesis | None:
    if len(scan_uv) < needed:
        return None
    points = points_at(scan, scan_uv)
    known = np.isfinite(points).all(axis=-1)
    points = points[known]
    result = ransac_pose(
        points, photo_uv[known], photo.cameras[0], threshold_px=_RANSAC_PX, iterations=_RANSAC_ITERATIONS, seed=seed
    )
    if result is None or np.count_nonzero(result.inliers) < needed:
        return None
    return Hypothesis(
        source,
        result.camera_from_scanner,
        int(np.count_nonzero(result.inliers)),
        points,
        photo_uv[known],
        result.inliers,
    )
