"""The focal length, the lens and the principal point, estimated together with the pose.

The cost is that of `bundle`, which compares tangents of the ideal picture. A change of an intrinsic theta leaves the
predicted tangents alone and moves the OBSERVED ones by -D^-1 d uv / d theta, with D = d uv / d xy; so theta adds the
column D^-1 d uv / d theta to the derivatives of the pose. It is taken at the PREDICTED tangents: D, the measure of the
residuals, changes with theta too, and only so is the gradient that of pixels (at the observed ones the sum of squares
itself would pull at f). After a step the camera is made anew and the lens undone again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.bundle import (
    UNSEEN,
    Cost,
    Linearised,
    Measurements,
    Residuals,
    States,
    Weigh,
    linearise,
    moved,
    residuals,
)
from ladarreg_core.pose.covariance import guarded_inverse
from ladarreg_core.pose.gnc import geman_mcclure

Intrinsics = Literal["fixed", "focal", "focal_k1", "focal_k1_centre"]
"""What is estimated beside the pose: nothing; one scale of fx and fy; k1 too; the principal point too."""
Noise = Callable[[Rigid, Camera, BoolArray], tuple[float, float]]
"""From a pose, its camera and inliers (M,) to the noise that they show, (sigma_px, sigma_range_m)."""

PARAMETERS: Mapping[Intrinsics, tuple[str, ...]] = {
    "fixed": (),
    "focal": ("focal_px",),
    "focal_k1": ("focal_px", "k1"),
    "focal_k1_centre": ("focal_px", "k1", "cx", "cy"),
}
"""The names of what is estimated, in the order of the covariance."""
MOST_SIGMA_OF_FOCAL = 0.02
"""Relative standard deviation beyond which the matches do not determine the focal length."""

_CLOSING = (9.0, 3.0, 1.0)  # of the gate: a wrong camera puts true matches beyond it
_CLOSING_STEPS, _CLOSING_SIGMA = 4, 0.3
_STEPS, _GATE_ROUNDS, _NOISE_ROUNDS = 12, 6, 3
_SETTLED_SIGMA = 1e-2
_SETTLED_NOISE = 1.1
_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e9
_MOST_STEP = np.array([1.0, 0.3, 0.5])  # of rotation (rad), log f and k1: beyond, the linearisation means nothing
_MOST_FOCAL_FACTOR = 10.0
_LEAST_INFORMATION = 1e-12
_LEAST_DOF = 2


@dataclass(frozen=True, slots=True, eq=False)
class IntrinsicsFit:
    """A pose and a camera fitted to the same matches."""

    intrinsics: Intrinsics
    """What was estimated beside the pose."""
    pose: Rigid
    """camera_from_scanner."""
    camera: Camera
    """With the intrinsics estimated."""
    covariance: FloatArray
    """(6 + K, 6 + K) of (w, c) as in `PoseResult`, then of `PARAMETERS` (px, 1, px, px); the ranges marginalised."""
    s: FloatArray
    """(M,) the cost of each match, with this noise."""
    inliers: BoolArray
    """(M,) s within the gate."""
    settled: bool
    """Whether it came to rest."""
    sigma_px: float
    """Pixel noise used."""
    sigma_range_m: float
    """Range noise used, m."""
    dof: int
    """Degrees of freedom that the inliers leave."""

    @property
    def sigmas(self) -> dict[str, float]:
        """The standard deviation of each intrinsic that was estimated, by name."""
        values = np.sqrt(np.diag(self.covariance)[6:]).tolist()
        return dict(zip(PARAMETERS[self.intrinsics], values, strict=True))

    @property
    def values(self) -> dict[str, float]:
        """Each intrinsic that was estimated, by name."""
        return {name: intrinsic(self.camera, name) for name in PARAMETERS[self.intrinsics]}

    @property
    def chi2_per_dof(self) -> float:
        """Over the inliers; NaN where they leave no freedom."""
        return float(self.s[self.inliers].sum() / self.dof) if self.dof > 0 else float("nan")

    @property
    def determined(self) -> bool:
        """Whether the matches determine the focal length: to 2 %, by the scatter that they show."""
        if self.intrinsics == "fixed":
            return True
        scatter = max(1.0, self.chi2_per_dof) if self.dof >= _LEAST_DOF else np.inf
        relative = self.sigmas["focal_px"] / self.camera.focal_px * np.sqrt(scatter)
        return bool(relative <= MOST_SIGMA_OF_FOCAL)


def estimate_intrinsics(
    matches: Matches,
    camera: Camera,
    pose: Rigid,
    intrinsics: Intrinsics,
    *,
    sigma_px: float,
    sigma_range_m: float,
    gate_chi2: float = 9.21,
    noise: Noise | None = None,
) -> IntrinsicsFit:
    """Estimate intrinsics together with the pose, from a pose that the matches already agree on.

    A camera without distortion gets (k1, 0, 0, 0); the other terms of a lens stay as they are.

    Args:
        matches: M matches, mismatches among them.
        camera: where the intrinsics start.
        pose: camera_from_scanner, where the pose starts; which matches agree is found anew.
        intrinsics: what to estimate.
        sigma_px: pixel noise, px.
        sigma_range_m: range noise, m.
        gate_chi2: largest s of an inlier.
        noise: what noise the fit shows, where it is not known; None: as stated.

    Returns:
        The fit. Where the matches do not determine an intrinsic its sigma is huge but finite, and where no better
        camera is found it is the given one.
    """
    count = len(PARAMETERS[intrinsics])
    for _ in range(_NOISE_ROUNDS if noise else 1):
        descent = Descent.start(matches, camera, pose, count, sigma_px=sigma_px, sigma_range_m=sigma_range_m)
        settled, inliers = _close(descent, gate_chi2)
        camera, pose = descent.camera, descent.state.pose()
        if noise is None or np.count_nonzero(inliers) * 2 < 6 + count + _LEAST_DOF:
            break
        before, (sigma_px, sigma_range_m) = (sigma_px, sigma_range_m), noise(pose, camera, inliers)
        change = max(before[0] / sigma_px, sigma_px / before[0], before[1] / sigma_range_m, sigma_range_m / before[1])
        if change < _SETTLED_NOISE:
            sigma_px, sigma_range_m = before  # s and covariance were computed with it
            break
    else:
        if noise is not None:
            sigma_px, sigma_range_m = before
    return IntrinsicsFit(
        intrinsics, pose, camera, _covariance(descent, inliers), descent.seen.s[0], inliers, settled,
        sigma_px, sigma_range_m, int(matches.dimensions[inliers].sum()) - 6 - count,
    )  # fmt: skip


def _close(descent: Descent, gate: float) -> tuple[bool, BoolArray]:
    """Descend robustly while the gate closes, then plainly until the inliers stay the same."""
    for factor in _CLOSING:
        weigh, cost = geman_mcclure(factor * gate)
        descent.run(weigh, cost, steps=_CLOSING_STEPS, tolerance_sigma=_CLOSING_SIGMA)
    settled, inliers = False, descent.seen.s[0] <= gate
    for _ in range(_GATE_ROUNDS):
        if np.count_nonzero(inliers) < 4:
            break
        settled = descent.least_squares(inliers)
        before, inliers = inliers, descent.seen.s[0] <= gate
        if (before == inliers).all():
            break
    return settled, inliers


@dataclass(slots=True, eq=False)
class Descent:
    """Levenberg-Marquardt on one pose and its camera; `bundle.Descent` with the camera free."""

    matches: Matches
    """What is fitted."""
    noise: tuple[float, float]
    """sigma_px and sigma_range_m."""
    count: int
    """How many of (log f, k1, cx, cy) are free."""
    first: Camera
    """The camera at the start."""
    camera: Camera
    """Where the descent stands."""
    measured: Measurements
    """The matches through that camera."""
    state: States
    """Where the descent stands, B = 1."""
    seen: Residuals
    """The residuals there."""
    damping: float = 1e-4
    """Relative to the diagonal."""

    @staticmethod
    def start(
        matches: Matches, camera: Camera, pose: Rigid, count: int, *, sigma_px: float, sigma_range_m: float
    ) -> Descent:
        """Return the descent before its first step."""
        measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_range_m)
        state = States.of([pose], measured)
        seen = residuals(measured, state)
        state = moved(measured, state, seen, linearise(measured, state, seen), None)
        seen = residuals(measured, state)
        return Descent(matches, (sigma_px, sigma_range_m), count, camera, camera, measured, state, seen)

    def least_squares(
        self, members: BoolArray, *, steps: int = _STEPS, tolerance_sigma: float = _SETTLED_SIGMA
    ) -> bool:
        """Descend the plain sum of s over the members (M,); return whether it came to rest."""
        counts = members.astype(np.float64)
        return self.run(
            lambda s: np.broadcast_to(counts, s.shape),
            lambda s: np.asarray(s @ counts),
            steps=steps,
            tolerance_sigma=tolerance_sigma,
        )

    def run(self, weigh: Weigh, cost: Cost, *, steps: int, tolerance_sigma: float) -> bool:
        """Descend a cost until a step is shorter than so many of its standard deviations; return whether it was."""
        return any(self._step(weigh, cost) < tolerance_sigma for _ in range(steps))

    def normal_equations(self, weights: FloatArray) -> tuple[FloatArray, FloatArray, Linearised, FloatArray]:
        """Return H (6 + K, 6 + K), g (6 + K,), the pose's derivatives and the intrinsics' (K, 2, M).

        Args:
            weights: (1, M) multiply the information; matches that are unseen count for nothing.

        Source: `bundle.normal_equations`, with columns for the camera.
        """
        measured, seen = self.measured, self.seen
        lin = linearise(measured, self.state, seen)
        columns = intrinsic_columns(self.camera, seen.xy[0], self.count)
        J = np.concatenate([lin.j_pose[0], columns])
        m, h, j = lin.m[0], lin.h[0], lin.j[0]
        weights = weights[0] * (seen.s[0] < UNSEEN)
        share = m / h
        K = weights * (measured.information - m * share) * J
        K += weights * (measured.cross_information - m[:1] * share[1:]) * J[:, ::-1]
        e = seen.e[0] - j * seen.range_error[0]
        flat = K.reshape(len(J), -1)
        H = flat @ J.reshape(len(J), -1).T
        return (H + H.T) / 2, flat @ e.ravel(), lin, columns

    def _step(self, weigh: Weigh, cost: Cost) -> float:
        """Take one step, and return its length in its own standard deviations; infinite where it was refused."""
        H, g, lin, columns = self.normal_equations(weigh(self.seen.s))
        step = _solve_damped(H, g, self.damping)
        length = float(np.sqrt(max(float(step @ H @ step), 0.0)))
        before = float(cost(self.seen.s)[0])
        there = self._at(step, lin, columns)
        if there is None or not float(cost(there[3].s)[0]) <= before:
            self.damping = min(self.damping * 10, _MOST_DAMPING)
            return 0.0 if length < 1e-3 else np.inf
        self.damping = max(self.damping / 10, _LEAST_DAMPING)
        self.camera, self.measured, self.state, self.seen = there
        return length

    def _at(
        self, step: FloatArray, lin: Linearised, columns: FloatArray
    ) -> tuple[Camera, Measurements, States, Residuals] | None:
        """Return where a step leads; None where no camera is."""
        camera = _changed(self.camera, step[6:])
        if camera is None or not _sensible(camera, self.first):
            return None
        sigma_px, sigma_range_m = self.noise
        measured = self.measured
        if self.count:
            measured = Measurements.of(self.matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_range_m)
            if (np.isnan(measured.xy) & ~np.isnan(self.measured.xy)).any():
                return None
        foreseen = replace(self.seen, e=self.seen.e - np.tensordot(step[6:], columns, axes=1))
        state = moved(self.measured, self.state, foreseen, lin, step[None, :6])
        return camera, measured, state, residuals(measured, state)


def foreseen_gains(descent: Descent, members: BoolArray, counts: Sequence[int]) -> list[float]:
    """Return how surely more intrinsics would bring the members' cost down, as normal deviates.

    One Gauss-Newton step of the enlarged system, beyond what the same step of the present one brings, is compared with
    the scatter that it leaves, so that it does not matter whether the noise was stated rightly.

    Args:
        descent: a pose and its camera, with what is free so far.
        members: (M,) the matches that count.
        counts: how many of (log f, k1, cx, cy) to free, in rising order.

    Source: Rao, Large sample tests of statistical hypotheses (1948); the deviate of F is Paulson's (1942).
    """
    H, g, _, _ = replace(descent, count=counts[-1]).normal_equations(members[None].astype(np.float64))
    numbers, s = int(descent.matches.dimensions[members].sum()), float(descent.seen.s[0, members].sum())
    free = 6 + descent.count
    before, found = _drop(H[:free, :free], g[:free]), []
    for count in counts:
        more, dof = count - descent.count, numbers - 6 - count
        if dof < _LEAST_DOF:
            found.append(0.0)
            continue
        after = _drop(H[: 6 + count, : 6 + count], g[: 6 + count])
        F = max(after - before, 0.0) / more / max(max(s - after, 0.0) / dof, 1e-9)
        a, b, root = 2 / (9 * more), 2 / (9 * dof), np.cbrt(F)
        found.append(float(((1 - b) * root - (1 - a)) / np.sqrt(b * root * root + a)))
    return found


def _drop(H: FloatArray, g: FloatArray) -> float:
    """Return g^T H^-1 g without the directions that H does not know."""
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    known = values > _LEAST_INFORMATION
    along = vectors.T[known] @ (g / scale)
    return float((along * along / values[known]).sum())


def intrinsic_columns(camera: Camera, xy: FloatArray, count: int) -> FloatArray:
    """Return d xy / d (log f, k1, cx, cy), the first `count` of them, as if the predicted tangents moved.

    Args:
        camera: intrinsics.
        xy: (2, N) predicted tangents.
        count: K.

    Returns:
        (K, 2, N); 0 where the lens sees nothing.
    """
    if not count:
        return np.zeros((0, *xy.shape))
    ideal = np.column_stack([*xy, np.ones(xy.shape[1])])
    _, d_uv = camera.project_with_jacobian(ideal)
    by_theta = camera.intrinsics_jacobian(xy.T)[..., :count]
    (a, b), (c, d) = np.moveaxis(d_uv[..., :2], 0, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = a * d - b * c
        u, v = by_theta[:, 0].T, by_theta[:, 1].T  # (K, N)
        columns = np.stack([d * u - b * v, a * v - c * u], axis=1) / determinant
    return np.where(np.isfinite(columns), columns, 0.0)


def intrinsic(camera: Camera, name: str) -> float:
    """Return one of a camera's intrinsics by its name in `PARAMETERS`."""
    if name == "k1":
        return camera.distortion[0] if camera.distortion else 0.0
    return float(getattr(camera, name))


def _changed(camera: Camera, step: FloatArray) -> Camera | None:
    """Return the camera after a step (K,) of (log f, k1, cx, cy); None where that is no camera."""
    if not len(step):
        return camera
    log_f, k1, cx, cy = map(float, np.pad(step, (0, 4 - len(step))))
    factor = float(np.exp(log_f))
    first, *others = camera.distortion or (0.0,) * 4
    try:
        return replace(
            camera,
            fx=camera.fx * factor,
            fy=camera.fy * factor,
            cx=camera.cx + cx,
            cy=camera.cy + cy,
            distortion=(first + k1, *others),
        )
    except CameraError:
        return None


def _sensible(camera: Camera, first: Camera) -> bool:
    """Return whether a camera may have taken the picture: its lens does not fold inside, where the first did not."""
    if not 1 / _MOST_FOCAL_FACTOR <= camera.focal_px / first.focal_px <= _MOST_FOCAL_FACTOR:
        return False
    if not camera.contains([camera.cx, camera.cy]) and first.contains([first.cx, first.cy]):
        return False
    if camera.distortion == first.distortion and not camera.distortion:
        return True
    w, h = camera.width - 1.0, camera.height - 1.0
    border = np.array([[u, v] for u in (0.0, w / 2, w) for v in (0.0, h / 2, h)])
    lost = np.isnan(camera.unproject(border)).any(axis=1)
    return not lost.any() or not (lost & ~np.isnan(first.unproject(border)).any(axis=1)).any()


def _solve_damped(H: FloatArray, g: FloatArray, damping: float) -> FloatArray:
    diagonal = np.diag(H)
    damped = H + np.diag(damping * diagonal + 1e-14 * diagonal.max() + 1e-300)
    try:
        step = np.linalg.solve(damped, g)
    except np.linalg.LinAlgError:
        step = np.linalg.lstsq(damped, g, rcond=None)[0]
    step = np.where(np.isfinite(step), step, 0.0)
    sizes = np.array([np.linalg.norm(step[:3]), *np.abs(step[6:8])])
    return np.asarray(step / max(1.0, float((sizes / _MOST_STEP[: len(sizes)]).max())))


def _covariance(descent: Descent, inliers: BoolArray) -> FloatArray:
    """Return the inverse information of the inliers; what it does not determine gets a huge but finite variance."""
    H, _, _, _ = descent.normal_equations(inliers[None].astype(np.float64))
    scale = np.sqrt(np.maximum(np.diag(H), _LEAST_INFORMATION))
    unit = np.ones(len(H))
    unit[6:7] = descent.camera.focal_px  # from log f to px
    inverse = guarded_inverse(H / np.outer(scale, scale)) * np.outer(unit / scale, unit / scale)
    return np.asarray((inverse + inverse.T) / 2)
