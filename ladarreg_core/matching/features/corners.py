"""The thesis's corner detector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.foundations.validation import require_choice

MaximaOf = Literal["every_pixel", "thresholded"]
_LARGEST_REACH_PX = 1000


@dataclass(frozen=True, slots=True)
class CornerOptions:
    """Options of corner detection.

    Raises:
        OptionError: if a value is out of range.
    """

    count: int | None = 800
    """Maximum number of corners, the largest w first; None: all above the thresholds."""
    w_min: float = 0.0
    """Minimum w: strength of the weaker gradient direction, squared gray levels."""
    q_min: float = 0.5
    """Minimum q: roundness, 1 if all directions are equally strong, 0 on a straight edge."""
    pre_blur_px: float = 0.0
    """Gaussian sigma of the blur before the gradients; 0: none, as in the thesis."""
    non_maximum_px: int = 1
    """Radius of non-maximum suppression of w, pixels."""
    sub_pixel: bool = False
    """Whether corners are moved to the peak of a parabola through w."""
    border_px: int = 8
    """Minimum distance from the border of the image."""
    maxima_of: MaximaOf = "every_pixel"
    """Pixels that take part in non-maximum suppression: `every_pixel`, or only those above the thresholds.

    `thresholded` is the order of the thesis (w* first, then its relative maxima): it also finds corners on the slope of
    a stronger edge, slightly displaced.
    """

    def __post_init__(self) -> None:
        whole: list[tuple[str, int | None, int]] = [
            ("count", self.count, 1),
            ("non_maximum_px", self.non_maximum_px, 1),
            ("border_px", self.border_px, 0),
        ]
        for name, value, least in whole:
            if name == "count" and value is None:
                continue
            sound = isinstance(value, int | np.integer) and not isinstance(value, bool)
            if not sound or not least <= int(value or 0) <= (2**31 if name == "count" else _LARGEST_REACH_PX):
                raise OptionError(f"the corners' {name} is {value!r}; it must be a whole number of at least {least}")
        if not (_is_number(self.w_min) and self.w_min >= 0):
            raise OptionError(f"the corners' w_min is {self.w_min!r}; it must be a number of at least 0")
        if not (_is_number(self.q_min) and 0 <= self.q_min < 1):
            raise OptionError(f"the corners' q_min is {self.q_min!r}; it must be at least 0 and below 1")
        if not (_is_number(self.pre_blur_px) and 0 <= self.pre_blur_px <= _LARGEST_REACH_PX):
            raise OptionError(f"the corners' pre_blur_px is {self.pre_blur_px!r}; it must be a number of at least 0")
        require_choice(self.maxima_of, get_args(MaximaOf), "the corners' maxima_of")


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """Corners of one image, strongest first."""

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
        w and q, (H, W) float32; both 0 where the image is uniform.

    Source: thesis 2.3.2, steps 1-3 (after Foerstner).
    """
    f = np.ascontiguousarray(image, dtype=np.float32)
    fh, fv = cv2.Sobel(f, cv2.CV_32F, 1, 0), cv2.Sobel(f, cv2.CV_32F, 0, 1)
    n_vv, n_vh, n_hh = (cv2.boxFilter(p, cv2.CV_32F, (5, 5), normalize=False) for p in (fv * fv, fv * fh, fh * fh))
    det = np.maximum(n_vv * n_hh - n_vh * n_vh, 0)
    trace = n_vv + n_hh
    floor = np.float32(1e-6) * max(float(trace.max(initial=0.0)), 1e-12)  # rounding noise of a uniform image
    trace[trace <= floor] = np.inf
    w = 2 * det / trace
    return w, 2 * w / trace


def find_corners(
    image: FloatArray, options: CornerOptions | None = None, *, usable: BoolArray | None = None
) -> Corners:
    """Find corners.

    Args:
        image: (H, W), gray levels.
        options: thresholds and count.
        usable: (H, W) bool, mask of pixels at which corners may lie; None: all.

    Returns:
        corners, strongest first; none in a uniform image.

    Raises:
        ShapeError: if the image is not (H, W) or not finite, or `usable` has another shape.

    Source: thesis 2.3.2, steps 1-5.
    """
    o = options or CornerOptions()
    if np.ndim(image) != 2 or 0 in np.shape(image):
        raise ShapeError(f"the image has the shape {np.shape(image)}; corner detection needs a gray image (H, W)")
    if usable is not None and np.shape(usable) != np.shape(image):
        raise ShapeError(
            f"the mask of usable pixels has the shape {np.shape(usable)}; it must be that of the image, "
            f"{np.shape(image)}"
        )
    gray = np.ascontiguousarray(image, dtype=np.float32)
    if not np.isfinite(gray).all():
        raise ShapeError("the gray image contains NaN or infinity; fill these pixels before corner detection")
    if o.pre_blur_px > 0:
        gray = np.asarray(cv2.GaussianBlur(gray, (0, 0), o.pre_blur_px), dtype=np.float32)
    w, q = corner_maps(gray)
    side = 2 * o.non_maximum_px + 1
    strong = (w > o.w_min) & (q > o.q_min)
    competitors = w if o.maxima_of == "every_pixel" else np.where(strong, w, np.float32(0))
    peak = (w >= cv2.dilate(competitors, np.ones((side, side), np.uint8))) & strong
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


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and bool(np.isfinite(value))


def _parabola(before: FloatArray, at: FloatArray, after: FloatArray) -> FloatArray:
    """Return the peak of the parabola through three neighbours, within half a pixel of the central one."""
    curvature = before - 2 * at + after
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.where(curvature < 0, 0.5 * (before - after) / curvature, 0.0)
    return np.clip(offset, -0.5, 0.5)
