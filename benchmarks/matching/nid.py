"""Normalised information distance of two images: their dependence under any mapping of gray levels.

A score for comparison, for images that share neither gray levels nor edges. Its optimum is broad and biased by shading,
so it can only give an initial pose: on accepted cases it doubled the error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, read_only
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.surface.remap import look_up

BINS = 16
_MIN_POINTS = 200
_MAX_EVALUATIONS = 400


def rank_bins(values: ArrayLike, *, bins: int = BINS) -> NDArray[np.intp]:
    """Return the bin (N,) of each value, with equally many values in each bin: only the order of the values matters.

    Args:
        values: (N,) finite numbers; equal values share a bin.
        bins: number of bins.

    Raises:
        ShapeError: if the values are not a finite vector.
        OptionError: if there are fewer than two bins.
    """
    if isinstance(bins, bool) or not isinstance(bins, int) or bins < 2:
        raise OptionError(f"the number of bins is {bins!r}; it must be a whole number of at least 2")
    given = read_only(values, np.float64, (None,), "the values")
    if not np.isfinite(given).all():
        raise ShapeError("the values contain NaN or infinity; give finite values")
    if not len(given):
        return np.zeros(0, np.intp)
    ordered = np.sort(given)
    rank = np.searchsorted(ordered, given, side="left") + np.searchsorted(ordered, given, side="right")
    return np.asarray(np.minimum(rank * bins // (2 * len(given)), bins - 1), dtype=np.intp)


def nid(first: ArrayLike, second: ArrayLike, *, bins: int = BINS) -> float:
    """Return the normalised information distance of paired values: 0 if each determines the other, 1 if independent.

    Args:
        first: (N,) values of one image.
        second: (N,) values of the other at the same pixels.
        bins: number of bins of each.

    Returns:
        (H(A, B) - I(A; B)) / H(A, B) of the rank-equalised values; 1 if one of them is constant.

    Raises:
        ShapeError: if they are not two finite vectors of equal length.
        OptionError: if there are fewer than two bins.

    Source: Li et al. 2004; Pascoe et al. 2015 for registration.
    """
    a, b = rank_bins(first, bins=bins), rank_bins(second, bins=bins)
    if len(a) != len(b):
        raise ShapeError(f"there are {len(a)} values of one image and {len(b)} of the other; give pairs")
    joint = np.bincount(a * bins + b, minlength=bins * bins).reshape(bins, bins) / max(len(a), 1)
    own_a, own_b, both = (_entropy(p) for p in (joint.sum(axis=1), joint.sum(axis=0), joint.ravel()))
    if min(own_a, own_b) <= 0:
        return 1.0
    return float(np.clip((2 * both - own_a - own_b) / both, 0.0, 1.0))


def _entropy(probabilities: NDArray[np.float64]) -> float:
    p = probabilities[probabilities > 0]
    return float(-(p * np.log(p)).sum())


@dataclass(frozen=True, slots=True, eq=False)
class NidPair:
    """Scan points with one value each, and the gray image that they are compared with."""

    points: FloatArray
    """(N, 3) m, scanner frame."""
    values: FloatArray
    """(N,) measured values, such as intensities."""
    gray: FloatArray
    """(H, W) the photo."""
    camera: Camera
    """The photo's camera."""

    def __post_init__(self) -> None:
        points = read_only(self.points, np.float64, (None, 3), "the points")
        values = read_only(self.values, np.float64, (len(points),), "the points' values")
        if not (np.isfinite(points).all() and np.isfinite(values).all()):
            raise ShapeError("the points or their values contain NaN or infinity; leave out cells without a return")
        gray = read_only(self.gray, np.float32, (self.camera.height, self.camera.width), "the gray image")
        for name, value in (("points", points), ("values", values), ("gray", gray)):
            object.__setattr__(self, name, value)

    def score(self, camera_from_scanner: Rigid, *, visible: BoolArray | None = None) -> float:
        """Return the distance at a pose over the points inside the image; 1 if there are fewer than 200.

        Args:
            camera_from_scanner: the pose.
            visible: (N,) bool, points that are not occluded; None: all.
        """
        uv = self.camera.project(camera_from_scanner @ self.points)
        inside = self.camera.contains(uv, border=1)
        if visible is not None:
            inside &= visible
        if np.count_nonzero(inside) < _MIN_POINTS:
            return 1.0
        u, v = (uv[inside, k].astype(np.float32) for k in (0, 1))
        return nid(self.values[inside], look_up(self.gray, u[:, None], v[:, None])[:, 0])

    def refine(
        self, start: Rigid, *, visible: BoolArray | None = None, step_rad: float = 0.01, step_m: float = 0.04
    ) -> tuple[Rigid, float]:
        """Return the pose of least distance found by a simplex, and its distance, which is at most that of the start.

        Args:
            start: initial `camera_from_scanner`.
            visible: as in `score`; not updated.
            step_rad: size of the initial simplex in rotation.
            step_m: size of the initial simplex in camera position.

        Raises:
            OptionError: if a step is not positive.
        """
        if not (0 < step_rad < np.pi and 0 < step_m < np.inf):
            raise OptionError(f"the steps are {step_rad:g} rad and {step_m:g} m; both must be positive")
        scale = np.array([step_rad] * 3 + [step_m] * 3)

        def pose(x: NDArray[np.float64]) -> Rigid:
            change = x * scale
            return Rigid.from_centre(rotation_from_rotvec(change[:3]) @ start.rotation, start.centre + change[3:])

        first = np.vstack([np.zeros(6), np.eye(6)])
        found = minimize(
            lambda x: self.score(pose(x), visible=visible),
            np.zeros(6),
            method="Nelder-Mead",
            options={"initial_simplex": first, "maxfev": _MAX_EVALUATIONS, "xatol": 1e-2, "fatol": 1e-6},
        )
        best, here = float(found.fun), self.score(start, visible=visible)
        return (pose(found.x), best) if best < here else (start, here)
