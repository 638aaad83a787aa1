"""Normalised correlation of all corners of one image with all corners of the other, and unique matches."""

from __future__ import annotations

from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.matching.features.descriptors import unit_rows

Response = Literal["gray", "edge"]
RESPONSES: tuple[Response, ...] = ("gray", "edge")
"""Both responses of the thesis: gray levels and the edge detector's output."""
_WINDOW_PX = 15
_LARGEST_WINDOW_PX = 101
_TIE = 1e-6  # equal windows' scores differ by rounding alone


def edge_image(gray: FloatArray) -> FloatArray:
    """Return the magnitude of the Sobel gradient (H, W) float32: the thesis's edge detector response."""
    image = np.ascontiguousarray(gray, dtype=np.float32)
    gx, gy = (np.asarray(cv2.Sobel(image, cv2.CV_32F, *order), dtype=np.float32) for order in ((1, 0), (0, 1)))
    return np.sqrt(gx * gx + gy * gy)


def windows_at(image: FloatArray, uv: FloatArray, *, side_px: int = _WINDOW_PX) -> FloatArray:
    """Return the normalised windows (N, side^2) around pixels (N, 2), whose products are correlation coefficients.

    Raises:
        OptionError: if the side is not an odd number from 3 to 101.
    """
    check_window(side_px)
    half = side_px // 2
    padded = cv2.copyMakeBorder(image, half, half, half, half, cv2.BORDER_REFLECT)
    view = np.lib.stride_tricks.sliding_window_view(padded, (side_px, side_px))
    u = np.clip(np.rint(uv[:, 0]).astype(np.intp), 0, image.shape[1] - 1)
    v = np.clip(np.rint(uv[:, 1]).astype(np.intp), 0, image.shape[0] - 1)
    return unit_rows(view[v, u].reshape(len(uv), side_px * side_px))


def check_window(side_px: int) -> None:
    """Raise an OptionError if the side of a correlation window is out of range."""
    whole = isinstance(side_px, int | np.integer) and not isinstance(side_px, bool)
    if not whole or side_px % 2 == 0 or not 3 <= side_px <= _LARGEST_WINDOW_PX:
        raise OptionError(
            f"the correlation window is {side_px!r} pixels wide; it must be an odd number from 3 to "
            f"{_LARGEST_WINDOW_PX}"
        )


def correlation_rows(
    gray: FloatArray, uv: FloatArray, *, side_px: int = _WINDOW_PX, responses: tuple[Response, ...] = RESPONSES
) -> FloatArray:
    """Return the normalised windows of each corner in each response, concatenated.

    Args:
        gray: (H, W) gray levels.
        uv: (N, 2) pixels.
        side_px: side of the windows, odd.
        responses: gray level, edge, or both.

    Returns:
        (N, len(responses) * side_px^2) float32: the product of two rows is the sum of their correlation coefficients.

    Raises:
        OptionError: if the side or a response is invalid.
        ShapeError: if the pixels are not (N, 2) or not finite.
    """
    if not responses or any(response not in get_args(Response) for response in responses):
        raise OptionError(f"the responses are {responses!r}; they must be one or both of {', '.join(RESPONSES)}")
    if np.ndim(uv) != 2 or np.shape(uv)[1] != 2 or not np.isfinite(uv).all():
        raise ShapeError(f"the corners have the shape {np.shape(uv)}; they must be finite pixels (N, 2)")
    levels = np.ascontiguousarray(gray, dtype=np.float32)
    images = [levels if response == "gray" else edge_image(levels) for response in responses]
    return np.hstack([windows_at(image, uv, side_px=side_px) for image in images])


def correlation_product(
    scan_gray: FloatArray,
    scan_uv: FloatArray,
    photo_gray: FloatArray,
    photo_uv: FloatArray,
    *,
    side_px: int = _WINDOW_PX,
    responses: tuple[Response, ...] = RESPONSES,
) -> FloatArray:
    """Return m (N, M): the mean of gray-level and edge correlation of each scan corner with each photo corner.

    Args:
        scan_gray: (H, W) gray levels.
        scan_uv: (N, 2) pixels.
        photo_gray: (H, W) gray levels.
        photo_uv: (M, 2) pixels.
        side_px: side of the windows, odd.
        responses: gray level, edge, or both as in the thesis.

    Raises:
        OptionError: if the side or a response is invalid.
        ShapeError: if the pixels are not (N, 2) or not finite.

    Source: thesis 2.3.2, m_ij.
    """
    scan = correlation_rows(scan_gray, scan_uv, side_px=side_px, responses=responses)
    photo = correlation_rows(photo_gray, photo_uv, side_px=side_px, responses=responses)
    return np.asarray(scan @ photo.T / len(responses))


def unique_matches(
    score: FloatArray, *, margin: float, mutual: bool = True, c2_floor: float | None = None
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Return the pairs whose best score exceeds the second best by more than `margin`; ties are never returned.

    Args:
        score: (N, M) of each scan feature with each photo feature; -inf: no candidate.
        margin: T1 of the thesis: C1 - C2 must exceed it.
        mutual: whether the pair must also be the best one of the photo feature (mutual best match).
        c2_floor: lower limit of C2, also used with a single candidate. None: a feature with a single candidate is
            not matched.

    Returns:
        indices (K,) into the scan's and the photo's features, and their scores (K,).

    Raises:
        OptionError: if the margin is not a number of at least 0.

    Source: thesis 2.3.2, C1 - C2 > T1.
    """
    if not (np.isfinite(margin) and margin >= 0):
        raise OptionError(f"the margin T1 is {margin!r}; it must be a number of at least 0")
    if score.shape[0] < 1 or score.shape[1] < (2 if c2_floor is None else 1):
        none = np.zeros(0, np.intp)
        return none, none, np.zeros(0)
    best = score.argmax(axis=1)
    rows = np.arange(len(score))
    first = score[rows, best]
    others = np.array(score)
    others[rows, best] = -np.inf
    second = others.max(axis=1)
    if c2_floor is not None:
        second = np.maximum(second, c2_floor)
    keep = np.isfinite(first) & np.isfinite(second)
    keep[keep] = first[keep] - second[keep] > max(margin, _TIE)
    if mutual:
        keep &= score.argmax(axis=0)[best] == rows
    chosen = np.flatnonzero(keep)
    return chosen, best[chosen], first[chosen]
