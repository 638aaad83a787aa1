"""Filters of corner matches, and guided matching near the pixels predicted by a pose.

Guided matching considers only photo corners near the prediction of a scan corner. An approximate pose is wrong by more
than a small search window, but displaces neighbouring predictions by the same amount. Therefore a large window can be
searched first, whose matches recentre the predictions around them.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, read_only
from ladarreg_core.foundations.validation import require_choice
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.features.correlation import unique_matches

FilterSide = Literal["two_sided", "one_sided"]
_MIN_T2_PX, _MAX_T2_PX = 1e-3, 1e6


def disparities(scan_uv: ArrayLike, photo_uv: ArrayLike) -> NDArray[np.float64]:
    """Return the disparities d (K,), pixels: the distance between the two pixels of each match.

    Args:
        scan_uv: (K, 2) pixels from the view's principal point.
        photo_uv: (K, 2) pixels from the photo's principal point, at the same focal length.

    Raises:
        ShapeError: if the arrays disagree.

    Source: thesis 2.3.2, disparity culling, Step 2.
    """
    scan = read_only(scan_uv, np.float64, (None, 2), "the matches' scan pixels")
    photo = read_only(photo_uv, np.float64, (len(scan), 2), "the matches' photo pixels")
    return np.asarray(np.hypot(scan[:, 0] - photo[:, 0], scan[:, 1] - photo[:, 1]))


def within_disparity(disparity: FloatArray, *, t2_px: float = 20.0, side: FilterSide = "two_sided") -> BoolArray:
    """Return a mask (K,) of the matches whose disparity is within T2 of the median.

    Args:
        disparity: (K,) pixels; values that are not finite are removed and not counted in the median.
        t2_px: T2.
        side: `two_sided` removes |d - median| > T2; `one_sided` is Step 5 literally, d - median > T2, which keeps every
            match of too small a disparity.

    Raises:
        ShapeError: if the disparities are not (K,).
        OptionError: if T2 or the side is invalid.

    Source: thesis 2.3.2, disparity culling, Steps 3-5.
    """
    check_filter(t2_px, side)
    d = read_only(disparity, np.float64, (None,), "the disparities")
    known = np.isfinite(d)
    if not known.any():
        return np.zeros(len(d), np.bool_)
    off = np.where(known, d, 0) - np.median(d[known])
    return np.asarray(known & ((np.abs(off) if side == "two_sided" else off) <= t2_px))


def check_filter(t2_px: float, side: str) -> None:
    """Raise an OptionError if T2 is not positive or the side is unknown."""
    number = isinstance(t2_px, int | float | np.number) and not isinstance(t2_px, bool)
    if not (number and _MIN_T2_PX <= t2_px <= _MAX_T2_PX):
        raise OptionError(
            f"the disparity threshold T2 is {t2_px!r}; it must be a number of pixels from {_MIN_T2_PX:g} to "
            f"{_MAX_T2_PX:g}"
        )
    require_choice(side, get_args(FilterSide), "the option culling")


def predicted_pixels(points_scanner: FloatArray, camera: Camera, pose: Rigid, *, border_px: float = 0.0) -> FloatArray:
    """Return the predicted pixels (N, 2) of scan points in the photo.

    Args:
        points_scanner: (N, 3), scanner frame, m.
        camera: the photo's working camera.
        pose: `camera_from_scanner`.
        border_px: width of the margin outside the image in which predictions are kept.

    Returns:
        uv (N, 2); NaN behind the camera, outside the image and for points that are not finite.

    Source: thesis 2.3.2, Step 7.
    """
    points = np.asarray(points_scanner, dtype=np.float64)
    uv = camera.project(pose @ np.where(np.isfinite(points), points, np.nan))
    return np.where(camera.contains(uv, border=-border_px)[..., None], uv, np.nan)


def candidates_near(predicted_uv: FloatArray, photo_uv: FloatArray, *, search_px: float) -> BoolArray:
    """Return a mask (N, M) of the photo corners (M, 2) in the search window around each prediction (N, 2).

    Args:
        predicted_uv: (N, 2) pixels; NaN: no candidates.
        photo_uv: (M, 2) pixels.
        search_px: half the side of the square window.
    """
    near = np.ones((len(predicted_uv), len(photo_uv)), np.bool_)
    with np.errstate(invalid="ignore"):
        for axis in (0, 1):
            near &= np.abs(photo_uv[None, :, axis] - predicted_uv[:, None, axis]) <= search_px
    return near


def recentred(
    predicted_uv: FloatArray, found_uv: FloatArray, displacement: FloatArray, *, neighbours: int = 9
) -> FloatArray:
    """Return the predictions (N, 2), each displaced by the median displacement of the nearest matches.

    Args:
        predicted_uv: (N, 2) pixels; NaN stays NaN.
        found_uv: (K, 2) predictions of the matches, pixels.
        displacement: (K, 2) displacement of each match from its prediction, pixels.
        neighbours: number of nearest matches used; with fewer matches the predictions are returned unchanged.
    """
    if len(found_uv) < neighbours:
        return predicted_uv
    moved = predicted_uv.copy()
    known = np.flatnonzero(np.isfinite(predicted_uv).all(axis=-1))
    squared = ((predicted_uv[known, None] - found_uv[None]) ** 2).sum(axis=-1)
    nearest = np.argsort(squared, axis=1, kind="stable")[:, :neighbours]
    moved[known] += np.median(displacement[nearest], axis=1)
    return moved


def consistent_displacements(displacement: FloatArray, *, most_px: float) -> BoolArray:
    """Return a mask (K,) of the displacements (K, 2) from the predictions within `most_px` of their median vector.

    The predictions include parallax, so the displacements are due to the error of the pose and nearly constant over the
    image. Their direction is used as well, unlike that of the disparities of unconstrained matching.
    """
    if not len(displacement):
        return np.zeros(0, np.bool_)
    off = displacement - np.median(displacement, axis=0)
    return np.asarray(np.hypot(off[:, 0], off[:, 1]) <= most_px)


def matches_near(
    score: FloatArray, near: BoolArray, *, margin: float, least_score: float, mutual: bool
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Return the unique matches among the candidates near their predictions.

    C2 is at least `least_score`, also for a single candidate, which has no second best.

    Args:
        score: (N, M) m of all pairs.
        near: (N, M) bool, the candidates.
        margin: T1 of guided matching.
        least_score: lower limit of C2.
        mutual: whether the pair must also be the best one of the photo corner (mutual best match).

    Returns:
        indices (K,) into the scan's and the photo's corners, and their scores (K,).

    Source: thesis 2.3.2, Step 7.
    """
    rows = np.flatnonzero(near.any(axis=1))
    among = np.where(near[rows], score[rows], -np.inf)
    first, second, value = unique_matches(among, margin=margin, mutual=mutual, c2_floor=least_score)
    return rows[first], second, value
