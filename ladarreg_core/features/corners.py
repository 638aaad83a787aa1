"""The thesis's corner detector."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.errors import OptionError, ShapeError


@dataclass(frozen=True, slots=True)
class CornerOptions:
    """How corners are found."""

    count: int | None = 800
    """Keep the best so many by w; None: all above the thresholds."""
    w_min: float = 0.0
    """Least w: strength of the weaker gradient direction, squared gray levels."""
    q_min: float = 0.5
    """Least q: roundness, 1 where all directions are equally strong, 0 on a straight edge."""
    pre_blur_px: float = 0.0
    """Gaussian sigma before the gradients; 0: none, as in the thesis."""
    non_maximum_px: int = 1
    """A corner is the largest w within so many pixels each way."""
    sub_pixel: bool = False
    """Move each to the peak of a parabola through w."""
    border_px: int = 8
    """No corner nearer to the picture's border."""


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """Corners of one picture, strongest first."""

    uv: NDArray[np.float64]
    """(N, 2) pixels."""
    w: FloatArray
    """(N,) strength."""
    q: FloatArray
    """(N,) roundness."""

    def __len__(self) -> int:
        return len(self.uv)


def corner_maps(image: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return w = 2 det N / trace N and q = 4 det N / trace^2 N of the 5 x 5 sums N of Sobel products.

    Args:
        image: (H, W), gray levels.

    Returns:
        w and q, (H, W) float32; both 0 where the picture is flat.

    Source: thesis 2.3.2, steps 1-3 (after Foerstner).
    """
    f = np.ascontiguousarray(image, dtype=np.float32)
    fh, fv = cv2.Sobel(f, cv2.CV_32F, 1, 0), cv2.Sobel(f, cv2.CV_32F, 0, 1)
    n_vv, n_vh, n_hh = (cv2.boxFilter(p, cv2.CV_32F, (5, 5), normalize=False) for p in (fv * fv, fv * fh, fh * fh))
    det = np.maximum(n_vv * n_hh - n_vh * n_vh, 0)
    trace = n_vv + n_hh
    floor = np.float32(1e-6) * max(float(trace.max(initial=0.0)), 1e-12)  # rounding noise of a flat picture
    safe = np.where(trace > floor, trace, np.float32(1))
    flat = trace <= floor
    return np.where(flat, 0, 2 * det / safe), np.where(flat, 0, 4 * det / safe**2)


def find_corners(
    image: FloatArray, options: CornerOptions | None = None, *, usable: BoolArray | None = None
) -> Corners:
    """Find corners.

    Args:
        image: (H, W), gray levels.
        options: thresholds and count.
        usable: (H, W) bool, where corners may lie; None: everywhere.

    Returns:
        corners, strongest first; none in a flat picture.

    Raises:
        ShapeError: if the image is not (H, W).
        OptionError: if a threshold has no meaning.

    Source: thesis 2.3.2, steps 1-5.
    """
    o = options or CornerOptions()
    if o.non_maximum_px < 1 or (o.count is not None and o.count < 1) or not 0 <= o.q_min < 1:
        raise OptionError(f"corner options {o} have no meaning: non_maximum_px and count from 1 on, q_min in [0, 1)")
    if image.ndim != 2:
        raise ShapeError(f"corners are found in a gray picture (H, W); this one has the shape {image.shape}")
    gray = np.ascontiguousarray(image, dtype=np.float32)
    if o.pre_blur_px > 0:
        gray = np.asarray(cv2.GaussianBlur(gray, (0, 0), o.pre_blur_px), dtype=np.float32)
    w, q = corner_maps(gray)
    side = 2 * o.non_maximum_px + 1
    peak = (w >= cv2.dilate(w, np.ones((side, side), np.uint8))) & (w > max(o.w_min, 0.0)) & (q > o.q_min)
    border = max(o.border_px, 1)
    peak[:border] = peak[-border:] = False
    peak[:, :border] = peak[:, -border:] = False
    if usable is not None:
        peak &= usable
    v, u = np.nonzero(peak)
    order = np.argsort(-w[v, u], kind="stable")[: o.count]
    v, u = v[order], u[order]
    uv = np.stack([u, v], axis=-1).astype(np.float64)
    if o.sub_pixel and len(uv):
        uv += np.stack([_parabola(w[v, u - 1], w[v, u], w[v, u + 1]), _parabola(w[v - 1, u], w[v, u], w[v + 1, u])], -1)
    return Corners(uv, w[v, u], q[v, u])


def _parabola(before: FloatArray, at: FloatArray, after: FloatArray) -> FloatArray:
    """Return where the parabola through three neighbours peaks, within half a pixel of the middle one."""
    curvature = before - 2 * at + after
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.where(curvature < 0, 0.5 * (before - after) / curvature, 0.0)
    return np.clip(offset, -0.5, 0.5)
