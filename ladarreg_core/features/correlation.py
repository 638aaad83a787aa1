"""Matching every corner of one picture with every corner of the other by one matrix product."""

from __future__ import annotations

from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import FloatArray
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.features.descriptors import unit_rows

Response = Literal["gray", "edge"]
RESPONSES: tuple[Response, ...] = ("gray", "edge")
"""The thesis's two: gray levels and the edge detector's response."""
_WINDOW_PX = 15
_LARGEST_WINDOW_PX = 101
_TIE = 1e-6  # equal windows' scores differ by rounding alone


def edge_picture(gray: FloatArray) -> FloatArray:
    """Return the magnitude of the Sobel gradient (H, W) float32: the thesis's edge detector response."""
    picture = np.ascontiguousarray(gray, dtype=np.float32)
    gx, gy = (np.asarray(cv2.Sobel(picture, cv2.CV_32F, *order), dtype=np.float32) for order in ((1, 0), (0, 1)))
    return np.sqrt(gx * gx + gy * gy)


def windows_at(image: FloatArray, uv: FloatArray, *, side_px: int = _WINDOW_PX) -> FloatArray:
    """Return the windows (N, side^2) around pixels (N, 2), normalised: their products are correlation coefficients.

    Raises:
        OptionError: if the side is not an odd number of 3 to 101 pixels.
    """
    check_window(side_px)
    half = side_px // 2
    padded = cv2.copyMakeBorder(image, half, half, half, half, cv2.BORDER_REFLECT)
    view = np.lib.stride_tricks.sliding_window_view(padded, (side_px, side_px))
    u = np.clip(np.rint(uv[:, 0]).astype(np.intp), 0, image.shape[1] - 1)
    v = np.clip(np.rint(uv[:, 1]).astype(np.intp), 0, image.shape[0] - 1)
    return unit_rows(view[v, u].reshape(len(uv), side_px * side_px))


def check_window(side_px: int) -> None:
    """Raise an OptionError if a correlation window cannot have this side."""
    whole = isinstance(side_px, int | np.integer) and not isinstance(side_px, bool)
    if not whole or side_px % 2 == 0 or not 3 <= side_px <= _LARGEST_WINDOW_PX:
        raise OptionError(
            f"the correlation window is {side_px!r} pixels wide; it must be an odd number of 3 to {_LARGEST_WINDOW_PX}"
        )


def correlation_rows(
    gray: FloatArray, uv: FloatArray, *, side_px: int = _WINDOW_PX, responses: tuple[Response, ...] = RESPONSES
) -> FloatArray:
    """Return what each corner is compared by: its normalised windows in each response, side by side.

    Args:
        gray: (H, W) gray levels.
        uv: (N, 2) pixels.
        side_px: of the windows, odd.
        responses: which of gray level and edge.

    Returns:
        (N, len(responses) * side_px^2) float32: the product of two rows is the sum of their correlation coefficients.

    Raises:
        OptionError: if there is no such window or response.
        ShapeError: if the pixels are not (N, 2) or not finite.
    """
    if not responses or any(response not in get_args(Response) for response in responses):
        raise OptionError(f"corners are compared by {responses!r}; it must be one or both of {', '.join(RESPONSES)}")
    if np.ndim(uv) != 2 or np.shape(uv)[1] != 2 or not np.isfinite(uv).all():
        raise ShapeError(f"corners are finite pixels (N, 2); the array given has the shape {np.shape(uv)}")
    levels = np.ascontiguousarray(gray, dtype=np.float32)
    pictures = [levels if response == "gray" else edge_picture(levels) for response in responses]
    return np.hstack([windows_at(picture, uv, side_px=side_px) for picture in pictures])


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
        side_px: of the windows, odd.
        responses: which of gray level and edge; both as in the thesis.

    Raises:
        OptionError: if there is no such window or response.
        ShapeError: if the pixels are not (N, 2) or not finite.

    Source: thesis 2.3.2, m_ij.
    """
    scan = correlation_rows(scan_gray, scan_uv, side_px=side_px, responses=responses)
    photo = correlation_rows(photo_gray, photo_uv, side_px=side_px, responses=responses)
    return np.asarray(scan @ photo.T / len(responses))


def unique_matches(
    score: FloatArray, *, margin: float, mutual: bool = True, rival_floor: float | None = None
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Return the pairs whose best score beats the second best by more than `margin`; equal bests never do.

    Args:
        score: (N, M) of each scan feature with each photo feature; -inf: no candidate.
        margin: T1 of the thesis: C1 - C2 must exceed it.
        mutual: whether the scan feature must also be the best of the photo feature.
        rival_floor: C2 counts as at least so much, also where there is only one candidate. None: every feature needs
            a rival to be told from.

    Returns:
        indices (K,) into the scan's and the photo's features, and their scores (K,).

    Raises:
        OptionError: if the margin is not a number of at least 0.

    Source: thesis 2.3.2, C1 - C2 > T1.
    """
    if not (np.isfinite(margin) and margin >= 0):
        raise OptionError(f"the margin T1 is {margin!r}; it must be a number of at least 0")
    if score.shape[0] < 1 or score.shape[1] < (2 if rival_floor is None else 1):
        none = np.zeros(0, np.intp)
        return none, none, np.zeros(0)
    best = score.argmax(axis=1)
    rows = np.arange(len(score))
    first = score[rows, best]
    second = np.partition(score, -2, axis=1)[:, -2] if score.shape[1] > 1 else np.full(len(score), -np.inf)
    if rival_floor is not None:
        second = np.maximum(second, rival_floor)
    keep = np.isfinite(first) & np.isfinite(second)
    keep[keep] = first[keep] - second[keep] > max(margin, _TIE)
    if mutual:
        keep &= score.argmax(axis=0)[best] == rows
    chosen = np.flatnonzero(keep)
    return chosen, best[chosen], first[chosen]
