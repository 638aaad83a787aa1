"""Disparity culling: matches whose displacement is unlike that of the others are mismatches."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.arrays import BoolArray, FloatArray, read_only
from ladarreg_core.errors import OptionError

CullingSide = Literal["two_sided", "one_sided"]
_LEAST_T2_PX, _MOST_T2_PX = 1e-3, 1e6


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


def alike(disparity: FloatArray, *, t2_px: float = 20.0, side: CullingSide = "two_sided") -> BoolArray:
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
    check_culling(t2_px, side)
    d = read_only(disparity, np.float64, (None,), "the disparities")
    known = np.isfinite(d)
    if not known.any():
        return np.zeros(len(d), np.bool_)
    off = np.where(known, d, 0) - np.median(d[known])
    return np.asarray(known & ((np.abs(off) if side == "two_sided" else off) <= t2_px))


def check_culling(t2_px: float, side: str) -> None:
    """Raise an OptionError if T2 is not positive or the side is unknown."""
    number = isinstance(t2_px, int | float | np.number) and not isinstance(t2_px, bool)
    if not (number and _LEAST_T2_PX <= t2_px <= _MOST_T2_PX):
        raise OptionError(
            f"the culling threshold T2 is {t2_px!r}; it must be a positive number of pixels "
            f"({_LEAST_T2_PX:g} to {_MOST_T2_PX:g})"
        )
    if side not in get_args(CullingSide):
        raise OptionError(f"the culling is {side!r}; it must be one of {', '.join(get_args(CullingSide))}")
