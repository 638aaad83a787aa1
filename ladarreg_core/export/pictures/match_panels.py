"""Panels of the contact sheet with the matches of a pose, drawn on the photograph."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.export.pictures.layout import resized
from ladarreg_core.foundations.palette import BACKGROUND, BAD, OK, Color
from ladarreg_core.photo import Photo
from ladarreg_core.results.registration import PoseResult

_ENLARGEMENTS = (50, 20, 10, 5, 2, 1)
_TARGET_LINE_PX = 14.0
_LONGEST_LINE_PX = 60.0
_MANY_MATCHES = 250
_DIMMED, _GRAYED = 0.5, 0.65
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates


def best_enlargement(results: Sequence[PoseResult | None], width: int) -> int:
    """Return the factor by which residuals are enlarged to be visible on photographs `width` pixels wide.

    It is the same for all results, so that the panels are comparable.
    """
    medians = []
    for result in results:
        if result is not None:
            length = np.hypot(*result.residuals_px[result.inliers].T) * (width / result.camera.width)
            length = length[np.isfinite(length)]
            medians += [float(np.median(length))] if len(length) else []
    # The geometric mean: neither the worst nor the best result alone sets the scale.
    typical = float(np.exp(np.mean(np.log(np.maximum(medians, 1e-6))))) if medians else 0.0
    return next((times for times in _ENLARGEMENTS if times * typical <= _TARGET_LINE_PX), 1)


def match_panel(
    photo: Photo, result: PoseResult | None, size: tuple[int, int], *, enlargement: int = 1
) -> NDArray[np.uint8]:
    """Return the photograph, dimmed, with a dot at each match and its residual as a line.

    Args:
        photo: the photograph.
        result: the matches with their residuals; None: no dots.
        size: (width, height) of the panel, pixels.
        enlargement: factor by which the residuals are enlarged; very long ones are shortened.

    Returns:
        (height, width, 3) uint8 RGB; inliers are green, outliers red and below them.
    """
    panel = _dimmed(resized(photo.pixels, size))
    if result is None:
        return panel
    scale = np.array(size) / photo.camera.size
    # The image borders coincide, so pixel centres shift.
    at = (result.matches.uv + 0.5) * scale - 0.5
    step = -result.residuals_px * scale * enlargement
    length = np.hypot(*step.T)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        step = np.where(length > _LONGEST_LINE_PX, step * (_LONGEST_LINE_PX / length), step)
    radius = 4.0 if len(at) <= _MANY_MATCHES else 2.6
    near = np.isfinite(at).all(axis=-1) & (np.abs(at) < 4 * max(size)).all(axis=-1)
    for chosen, color in ((~result.inliers, BAD), (result.inliers, OK)):
        for k in np.flatnonzero(chosen & near):
            _draw(panel, at[k], at[k] + step[k], radius, color)
    return panel


def _draw(
    panel: NDArray[np.uint8], start: NDArray[np.float64], end: NDArray[np.float64], radius: float, color: Color
) -> None:
    here = _fixed(start)
    if np.isfinite(end).all():
        cv2.line(panel, here, _fixed(end), BACKGROUND, 4, cv2.LINE_AA, _SHIFT)
        cv2.line(panel, here, _fixed(end), color, 2, cv2.LINE_AA, _SHIFT)
    cv2.circle(panel, here, round((radius + 1.3) * 2**_SHIFT), BACKGROUND, -1, cv2.LINE_AA, _SHIFT)
    cv2.circle(panel, here, round(radius * 2**_SHIFT), color, -1, cv2.LINE_AA, _SHIFT)


def _fixed(point: NDArray[np.float64]) -> tuple[int, int]:
    return round(float(point[0]) * 2**_SHIFT), round(float(point[1]) * 2**_SHIFT)


def _dimmed(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a darker and grayer copy of an image, against which drawings stand out."""
    gray = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), dtype=np.float32)[..., None]
    mixed = _GRAYED * gray + (1 - _GRAYED) * picture.astype(np.float32)
    return np.asarray(np.rint(mixed * _DIMMED), dtype=np.uint8)
