"""The second search: only photo corners near where the pose and the range say that a scan corner must be.

A rough pose is wrong by more than a small window reaches, but it shifts neighbouring predictions alike. So the search
may go on from a large window to a small one: what the large one found moves the predictions around it.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.arrays import BoolArray, FloatArray, read_only
from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError
from ladarreg_core.features.correlation import unique_matches
from ladarreg_core.frames import Rigid

FilterSide = Literal["two_sided", "one_sided"]
_MIN_T2_PX, _MAX_T2_PX = 1e-3, 1e6


def disparities(scan_uv: ArrayLike, photo_uv: ArrayLike) -> NDArray[np.float64]:
    """Return d (K,), pixels: how far each match lies apart in the two pictures.

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
    """Return which matches (K,) survive: those whose disparity is within T2 of the median.

    Args:
        disparity: (K,) pixels; what is not finite never survives and does not count in the median.
        t2_px: T2.
        side: `two_sided` culls |d - median| > T2; `one_sided` is Step 5 to the letter, d - median > T2, which keeps
            every match that moved too little.

    Raises:
        ShapeError: if the disparities are not (K,).
        OptionError: if T2 or the side has no meaning.

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
            f"the culling threshold T2 is {t2_px!r}; it must be a positive number of pixels "
            f"({_MIN_T2_PX:g} to {_MAX_T2_PX:g})"
        )
    if side not in get_args(FilterSide):
        raise OptionError(f"the culling is {side!r}; it must be one of {', '.join(get_args(FilterSide))}")


def predicted_pixels(points_scanner: FloatArray, camera: Camera, pose: Rigid, *, border_px: float = 0.0) -> FloatArray:
    """Return where scan points (N, 3) must lie in the photo, (N, 2) pixels.

    Args:
        points_scanner: (N, 3), scanner frame, m.
        camera: the photo's working camera.
        pose: `camera_from_scanner`.
        border_px: how far outside the picture a prediction still counts.

    Returns:
        uv (N, 2); NaN behind the camera, outside the picture and for points that are not finite.

    Source: thesis 2.3.2, Step 7.
    """
    points = np.asarray(points_scanner, dtype=np.float64)
    uv = camera.project(pose @ np.where(np.isfinite(points), points, np.nan))
    return np.where(camera.contains(uv, border=-border_px)[..., None], uv, np.nan)


def candidates_near(predicted_uv: FloatArray, photo_uv: FloatArray, *, search_px: float) -> BoolArray:
    """Return which photo corners (M, 2) lie in the window around each prediction (N, 2): (N, M) bool.

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
    """Return the predictions (N, 2), each moved by the median displacement of the matches found nearest to it.

    Args:
        predicted_uv: (N, 2) pixels; NaN stays NaN.
        found_uv: (K, 2) the predictions of what was found, pixels.
        displacement: (K, 2) how far from its prediction each was found, pixels.
        neighbours: so many matches are asked; with fewer than that nothing moves.
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
    """Return which displacements (K, 2) from the predictions lie within so many pixels of their median vector.

    The predictions have the parallax in them already, so what is left is the pose's error, which is nearly the same
    all over the picture: direction counts, too, which the disparity of the first search leaves out.
    """
    if not len(displacement):
        return np.zeros(0, np.bool_)
    off = displacement - np.median(displacement, axis=0)
    return np.asarray(np.hypot(off[:, 0], off[:, 1]) <= most_px)


def matches_near(
    score: FloatArray, near: BoolArray, *, margin: float, least_score: float, mutual: bool
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Return the pairs that win among the candidates near their prediction.

    With a single candidate there is no second best: C2 then is `least_score`, and is never taken as less.

    Args:
        score: (N, M) m of all pairs.
        near: (N, M) bool, the candidates.
        margin: T1 of this search.
        least_score: the least that C2 counts as.
        mutual: whether the scan corner must also be the photo corner's best among those that predict it.

    Returns:
        indices (K,) into the scan's and the photo's corners, and their scores (K,).

    Source: thesis 2.3.2, Step 7.
    """
    rows = np.flatnonzero(near.any(axis=1))
    among = np.where(near[rows], score[rows], -np.inf)
    first, second, value = unique_matches(among, margin=margin, mutual=mutual, rival_floor=least_score)
    return rows[first], second, value
