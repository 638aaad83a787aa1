"""Influence of each match: the shift of the pose if it were removed.

At the least-squares pose the gradient g of all matches is zero. With A and g_A the share of some of them in the
normal equations H and g, removing these moves the pose by one Gauss-Newton step

    d = -(H - A)^-1 g_A

which is exact for a linear problem and correct to first order for this one. Nothing is solved again.

Source: Cook, Detection of influential observation in linear regression (1977); the system is that of `bundle`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera.uncertainty import pose_jacobian
from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.arrays import FloatArray, IntArray, read_only
from ladarreg_core.foundations.formatting import format_length
from ladarreg_core.pose.estimators.bundle import UNSEEN, States, adjust_ranges, least_squares, linearise, residuals
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.pose.preconditions import MIN_MATCHES
from ladarreg_core.results.registration import PoseResult

INFLUENTIAL_COOK = 0.5
"""Cook's distance from which a match should be checked."""
_MAX_PROBES = 64
_MIN_DETERMINANT = 1e-10
_MAX_STEP_RAD = 1.0
_STEPS = 8
_CHUNK = 128


@dataclass(frozen=True, slots=True, eq=False)
class Influence:
    """Shift of the pose when a match is removed; the samples of one line are removed together.

    0 for outliers, which do not count anyway. Infinite where the remaining matches would not determine a pose.
    """

    position_m: FloatArray
    """(M,) shift of the camera centre, m."""
    angle_rad: FloatArray
    """(M,) rotation, rad."""
    pixels: FloatArray
    """(M,) median shift of the matches in the photo, px."""
    cook: FloatArray
    """(M,) Cook's distance: the squared shift in the pose's own standard deviations, over its 6 parameters."""
    pick_ids: tuple[str, ...]
    """(M,) the pick that each match was derived from."""

    def __post_init__(self) -> None:
        for name in ("position_m", "angle_rad", "pixels", "cook"):
            array = read_only(getattr(self, name), np.float64, (len(self.pick_ids),), f"the influence's {name}")
            object.__setattr__(self, name, array)

    @property
    def most_influential(self) -> int:
        """The index of the most influential match, by Cook's distance."""
        return int(np.argmax(self.cook))

    def summary(self) -> str:
        """Return a sentence on the most influential match."""
        k = self.most_influential
        name = self.pick_ids[k]
        if not np.isfinite(self.cook[k]):
            return f"The pose depends on match {name}: without it the others do not determine a pose. Add matches."
        shift = f"the camera by {format_length(float(self.position_m[k]))} and {np.degrees(self.angle_rad[k]):.2g} deg"
        where = f"{self.pixels[k]:.2g} px in the photo"
        if self.cook[k] >= INFLUENTIAL_COOK:
            return f"Removing match {name} shifts {shift} ({where}): check it."
        return f"No match is very influential: removing match {name}, the most influential, shifts {shift} ({where})."


def influence(result: PoseResult) -> Influence:
    """Compute the shift of the pose when each of its matches is removed.

    Only the inliers count. A pose that was not found by least squares (`linear`, a simplex) is first refined to the
    least-squares pose of the same inliers.

    Args:
        result: a pose with its matches, their noise and inliers.

    Raises:
        DegenerateGeometryError: if fewer than 4 inliers lie in front of the camera, or they do not determine a pose.
    """
    matches = result.matches
    measured = Measurements.of(matches, result.camera, sigma_px=result.sigma_px, sigma_range_m=result.sigma_range_m)
    state = States.of([result.camera_from_scanner], measured)
    members = np.flatnonzero(result.inliers & (residuals(measured, state).s[0] < UNSEEN))
    if len(members) < MIN_MATCHES:
        raise DegenerateGeometryError(
            f"{len(members)} matches agree with the pose; influence needs at least {MIN_MATCHES}: "
            "add or correct matches"
        )
    measured = measured.subset(members)
    state, _ = adjust_ranges(measured, state.with_ranges_of(measured), rounds=1)
    state, _, _ = least_squares(measured, state, steps=_STEPS, tolerance_sigma=1e-3)

    J, K, e = _reduced_system(measured, state)
    H = K @ J.T
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    H = (H + H.T) / 2 / np.outer(scale, scale)
    if not np.linalg.eigvalsh(H)[0] > _MIN_DETERMINANT:
        raise DegenerateGeometryError("the matches do not determine a pose; add matches off their line or plane")
    # In coordinates where H is the identity, the determinant is the share of the information that remains.
    whiten = np.linalg.inv(np.linalg.cholesky(H)) / scale
    J, K = ((whiten @ part).reshape(6, 2, -1).transpose(2, 0, 1) for part in (J, K))  # (n, 6, 2)
    group, first, order = _groups([matches.pick_ids[k] for k in members.tolist()])
    without = np.eye(6) - np.add.reduceat((K @ J.swapaxes(1, 2))[order], first)
    gradient = np.add.reduceat((K @ e.T[..., None])[order, :, 0], first)
    with np.errstate(all="ignore"):
        determined = np.linalg.det(without) > _MIN_DETERMINANT
        without[~determined] = np.eye(6)
        step = -np.linalg.solve(without, gradient[..., None])[..., 0]  # whitened
        shift = step @ whiten
        cook = (step * step).sum(axis=1) / 6
        angle = np.linalg.norm(shift[:, :3], axis=1)
        position = np.linalg.norm(shift[:, 3:], axis=1)
        pixels = _median_shift_px(result, state, measured, shift)
    determined &= angle <= _MAX_STEP_RAD  # beyond a radian the linearisation is meaningless

    def per_match(values: FloatArray) -> FloatArray:
        full = np.zeros(len(matches))
        full[members] = np.where(determined, values, np.inf)[group]
        return full

    return Influence(per_match(position), per_match(angle), per_match(pixels), per_match(cook), matches.pick_ids)


def _groups(ids: list[str]) -> tuple[IntArray, IntArray, IntArray]:
    """Return the pick index of each match (n,), the start of each pick in a sorted order, and that order of the
    matches."""
    number: dict[str, int] = {}
    group = np.array([number.setdefault(name, len(number)) for name in ids], dtype=np.intp)
    order = np.argsort(group, kind="stable")
    return group, np.flatnonzero(np.diff(group[order], prepend=-1)), order


def _reduced_system(measured: Measurements, state: States) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return derivatives J and J times information, (6, 2 n) each, and residuals (2, n), with the ranges eliminated.

    Source: `bundle.normal_equations`, which sums over the matches.
    """
    seen = residuals(measured, state)
    lin = linearise(measured, state, seen)
    J, j, m = lin.j_pose[0], lin.j[0], lin.m[0]  # (6, 2, n), (2, n), (2, n)
    share = m / lin.h[0]
    diagonal = measured.information - m * share
    cross = measured.cross_information - m[:1] * share[1:]
    K = diagonal * J + cross * J[:, ::-1]
    e = seen.e[0] - j * seen.range_error[0]
    return J.reshape(6, -1), K.reshape(6, -1), e


def _median_shift_px(result: PoseResult, state: States, measured: Measurements, shifts: FloatArray) -> FloatArray:
    """Return the median shift (G,) of the matches in the photo, px, under each pose shift (G, 6), to first order."""
    probes = np.unique(np.linspace(0, len(measured) - 1, min(len(measured), _MAX_PROBES)).round().astype(np.intp))
    points = (measured.rays[:, probes] * state.rho[0, probes]).T
    _, J = pose_jacobian(state.pose(), points, result.camera)
    J = J[np.isfinite(J).all(axis=(1, 2))]
    if not len(J):
        return np.zeros(len(shifts))
    squared = np.empty(len(shifts))
    for first in range(0, len(shifts), _CHUNK):
        some = shifts[first : first + _CHUNK]
        du, dv = some @ J[:, 0].T, some @ J[:, 1].T
        squared[first : first + _CHUNK] = np.median(du * du + dv * dv, axis=1)
    return np.sqrt(squared)
