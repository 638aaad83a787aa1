"""Estimation of focal length, lens distortion and principal point together with the pose.

The cost is that of `bundle`, which compares tangents in the undistorted image. A change of an intrinsic theta leaves
the predicted tangents unchanged and moves the OBSERVED ones by -D^-1 d uv / d theta, with D = d uv / d xy. It therefore
adds the column D^-1 d uv / d theta to the derivatives of the pose. The column is evaluated at the PREDICTED tangents:
D, the metric of the residuals, also depends on theta, and only there is the gradient that of pixel residuals (at the
observed tangents the sum of squares would itself bias f). After each step the camera is updated and the distortion
removed again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import sqrt

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimators.bundle import (
    UNSEEN,
    CostFunction,
    Evaluation,
    Linearised,
    Residuals,
    States,
    apply_step,
    linearise,
    residuals,
)
from ladarreg_core.pose.estimators.covariance import guarded_inverse
from ladarreg_core.pose.estimators.gnc import geman_mcclure
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.pose.estimators.unknown_intrinsics import (
    PARAMETERS,
    Intrinsics,
    intrinsic,
    intrinsic_columns,
    is_plausible,
    updated,
    values_of,
)

Noise = Callable[[Rigid, Camera, BoolArray], tuple[float, float]]
"""Estimator of the noise (sigma_px, sigma_range_m) from a pose, its camera and inliers (M,)."""

MAX_SIGMA_OF_FOCAL = 0.02
"""Largest relative standard deviation of a focal length that counts as determined."""

_SCALES = (9.0, 3.0, 1.0)  # of the robust cost, relative to the gate: a wrong camera puts correct matches beyond it
_SCALE_STEPS, _SCALE_SIGMA = 4, 0.3
_STEPS, _GATE_ROUNDS, _NOISE_ROUNDS = 12, 6, 3
_SETTLED_SIGMA = 1e-2
_SETTLED_NOISE = 1.1
_MIN_DAMPING, _MAX_DAMPING = 1e-9, 1e9
_MAX_STEP = np.array([1.0, 0.3, 0.5])  # of rotation (rad), log f and k1: the linearisation is invalid beyond
_MIN_INFORMATION = 1e-12
_MIN_DOF = 2


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """Prior on intrinsics: each counts as one measurement of its stated value."""

    free: tuple[int, ...]
    """The K free intrinsics, as indices of (log f, k1, cx, cy)."""
    mean: FloatArray
    """(K,) stated values."""
    information: FloatArray
    """(K,) inverse variances; 0: no prior."""

    @staticmethod
    def of(stated: Camera, sigmas: Mapping[str, float], without_prior: Sequence[str] = ()) -> Anchor:
        """Return the prior of a stated camera.

        Args:
            stated: the mean.
            sigmas: standard deviations of intrinsics with a prior, by name; px, 1, px, px.
            without_prior: names of further free intrinsics, or of those whose prior is to be dropped.
        """
        names = PARAMETERS["focal_k1_centre"]
        free = tuple(k for k, name in enumerate(names) if name in sigmas or name in without_prior)
        own = {name: sigma / stated.focal_px if name == "focal_px" else sigma for name, sigma in sigmas.items()}
        information = [0.0 if names[k] in without_prior else 1 / own[names[k]] ** 2 for k in free]
        return Anchor(free, values_of(stated)[list(free)], np.array(information))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free intrinsics."""
        return tuple(PARAMETERS["focal_k1_centre"][k] for k in self.free)

    def off(self, camera: Camera) -> FloatArray:
        """Return how far the stated values lie from those of a camera, (K,)."""
        return np.asarray(self.mean - values_of(camera)[list(self.free)])

    def cost(self, camera: Camera) -> float:
        """Return the share of the prior in the cost."""
        off = self.off(camera)
        return float(self.information @ (off * off))


@dataclass(frozen=True, slots=True, eq=False)
class IntrinsicsFit:
    """A pose and a camera fitted to the same matches."""

    intrinsics: Intrinsics
    """The intrinsics that were estimated."""
    pose: Rigid
    """camera_from_scanner."""
    camera: Camera
    """The camera with the estimated intrinsics."""
    covariance: FloatArray
    """(6 + K, 6 + K) of (w, c) as in `PoseResult`, then of `PARAMETERS` (px, 1, px, px); ranges marginalised."""
    s: FloatArray
    """(M,) cost of each match, with this noise."""
    inliers: BoolArray
    """(M,) bool: s within the gate."""
    settled: bool
    """True if the optimisation converged."""
    sigma_px: float
    """Pixel noise used, px."""
    sigma_range_m: float
    """Range noise used, m."""
    dof: int
    """Degrees of freedom of the inliers' residuals."""
    anchor: Anchor | None = None
    """The prior on the intrinsics, which then determines which are free."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free intrinsics, in the order of the covariance."""
        return PARAMETERS[self.intrinsics] if self.anchor is None else self.anchor.names

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviation of each free intrinsic, by name."""
        values = np.sqrt(np.diag(self.covariance)[6:]).tolist()
        return dict(zip(self.names, values, strict=True))

    @property
    def values(self) -> dict[str, float]:
        """Value of each estimated intrinsic, by name."""
        return {name: intrinsic(self.camera, name) for name in PARAMETERS[self.intrinsics]}

    @property
    def chi2_per_dof(self) -> float:
        """Chi^2/dof of the inliers; NaN without degrees of freedom."""
        return float(self.s[self.inliers].sum() / self.dof) if self.dof > 0 else float("nan")

    @property
    def determined(self) -> bool:
        """True if the matches determine the focal length to 2 %, given the scatter of their residuals."""
        if self.intrinsics == "fixed":
            return True
        scatter = max(1.0, self.chi2_per_dof) if self.dof >= _MIN_DOF else np.inf
        relative = self.sigmas["focal_px"] / self.camera.focal_px * np.sqrt(scatter)
        return bool(relative <= MAX_SIGMA_OF_FOCAL)


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
    anchor: Anchor | None = None,
) -> IntrinsicsFit:
    """Estimate intrinsics together with the pose, starting from a pose fitted with the given camera.

    A camera without distortion gets (k1, 0, 0, 0); further distortion terms stay unchanged.

    Args:
        matches: M matches, which may contain outliers.
        camera: initial intrinsics.
        pose: initial camera_from_scanner; the inliers are selected again.
        intrinsics: the intrinsics to estimate.
        sigma_px: pixel noise, px.
        sigma_range_m: range noise, m.
        gate_chi2: largest cost s of an inlier.
        noise: estimator of the noise if it is not stated; None: the noise is as given.
        anchor: a prior on the intrinsics; it then determines which are free.

    Returns:
        The fit. Undetermined intrinsics have a sigma that is huge but finite; if no better camera is found, the camera
        is the given one.
    """
    count = len(PARAMETERS[intrinsics]) if anchor is None else len(anchor.free)
    measured = 0 if anchor is None else int(np.count_nonzero(anchor.information))
    for _ in range(_NOISE_ROUNDS if noise else 1):
        descent = Descent.start(
            matches, camera, pose, count, sigma_px=sigma_px, sigma_range_m=sigma_range_m, anchor=anchor
        )
        settled, inliers = _fit_robustly(descent, gate_chi2)
        camera, pose = descent.camera, descent.state.pose()
        if noise is None or np.count_nonzero(inliers) * 2 < 6 + count + _MIN_DOF:
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
        intrinsics, pose, camera, _covariance(descent, inliers), descent.residuals.s[0], inliers, settled,
        sigma_px, sigma_range_m, int(matches.dimensions[inliers].sum()) - 6 - count + measured, anchor,
    )  # fmt: skip


def _fit_robustly(descent: Descent, gate: float) -> tuple[bool, BoolArray]:
    """Minimise a robust cost of shrinking scale, then the sum of s until the inliers are stable."""
    for factor in _SCALES:
        descent.run(geman_mcclure(factor * gate), steps=_SCALE_STEPS, tolerance_sigma=_SCALE_SIGMA)
    settled, inliers = False, descent.residuals.s[0] <= gate
    for _ in range(_GATE_ROUNDS):
        if np.count_nonzero(inliers) < 4:
            break
        settled = descent.least_squares(inliers)
        before, inliers = inliers, descent.residuals.s[0] <= gate
        if (before == inliers).all():
            break
    return settled, inliers


@dataclass(slots=True, eq=False)
class Descent:
    """Levenberg-Marquardt on one pose and its camera; `bundle.Descent` with free intrinsics."""

    matches: Matches
    """The matches."""
    noise: tuple[float, float]
    """sigma_px and sigma_range_m."""
    count: int
    """Number of free intrinsics among (log f, k1, cx, cy)."""
    first: Camera
    """The initial camera."""
    camera: Camera
    """The current camera."""
    measured: Measurements
    """The matches, undistorted with the current camera."""
    state: States
    """The current pose, B = 1."""
    residuals: Residuals
    """The current residuals."""
    damping: float = 1e-4
    """Damping relative to the diagonal of H."""
    anchor: Anchor | None = None
    """A prior on the intrinsics, which then says which are free."""
    lin: Linearised | None = None
    """The derivatives by the pose, if known."""

    @staticmethod
    def start(
        matches: Matches,
        camera: Camera,
        pose: Rigid,
        count: int,
        *,
        sigma_px: float,
        sigma_range_m: float,
        anchor: Anchor | None = None,
    ) -> Descent:
        """Return the descent before its first step."""
        measured = Measurements.of(matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_range_m)
        state = States.of([pose], measured)
        seen = residuals(measured, state)
        state = apply_step(measured, state, seen, linearise(measured, state, seen), None)
        seen = residuals(measured, state)
        return Descent(matches, (sigma_px, sigma_range_m), count, camera, camera, measured, state, seen, anchor=anchor)

    @staticmethod
    def at(evaluation: Evaluation, matches: Matches, camera: Camera, noise: tuple[float, float]) -> Descent:
        """Return the descent at a pose whose residuals are known, without free intrinsics."""
        at = evaluation
        return Descent(matches, noise, 0, camera, camera, at.measured, at.state, at.seen, lin=at.lin)

    def least_squares(
        self, members: BoolArray, *, steps: int = _STEPS, tolerance_sigma: float = _SETTLED_SIGMA
    ) -> bool:
        """Minimise the sum of s over the members (M,); return whether it converged."""
        counts = members.astype(np.float64)
        return self.run(lambda s: (counts[None], s @ counts), steps=steps, tolerance_sigma=tolerance_sigma)

    def run(self, cost: CostFunction, *, steps: int, tolerance_sigma: float) -> bool:
        """Minimise a cost until a step is shorter than `tolerance_sigma` standard deviations; return whether it was."""
        return any(self._step(cost) < tolerance_sigma for _ in range(steps))

    def normal_equations(self, weights: FloatArray) -> tuple[FloatArray, FloatArray, Linearised, FloatArray]:
        """Return H (6 + K, 6 + K), g (6 + K,), the derivatives by the pose, and those by the intrinsics (K, 2, M).

        Args:
            weights: (1, M) multiply the information; matches behind the camera do not count.

        Source: `bundle.normal_equations`, with columns for the camera.
        """
        measured, seen = self.measured, self.residuals
        lin = linearise(measured, self.state, seen) if self.lin is None else self.lin
        columns = intrinsic_columns(self.camera, seen.xy[0], 4 if self.anchor else self.count)
        if self.anchor:
            columns = columns[list(self.anchor.free)]
        J = np.concatenate([lin.j_pose[0], columns])
        m, h, j = lin.m[0], lin.h[0], lin.j[0]
        weights = weights[0] * (seen.s[0] < UNSEEN)
        share = m / h
        K = weights * (measured.information - m * share) * J
        K += weights * (measured.cross_information - m[:1] * share[1:]) * J[:, ::-1]
        e = seen.e[0] - j * seen.range_error[0]
        flat = K.reshape(len(J), -1)
        H, g = flat @ J.reshape(len(J), -1).T, flat @ e.ravel()
        if self.anchor:
            H[range(6, len(H)), range(6, len(H))] += self.anchor.information
            g[6:] += self.anchor.information * self.anchor.off(self.camera)
        return (H + H.T) / 2, g, lin, columns

    def _step(self, cost: CostFunction) -> float:
        """Take one step and return its length in standard deviations; infinite if it was rejected."""
        weights, costs = cost(self.residuals.s)
        H, g, lin, columns = self.normal_equations(weights)
        free = self.anchor.free if self.anchor else range(self.count)
        step = _solve_damped(H, g, self.damping, free)
        length = float(np.sqrt(max(float(step @ H @ step), 0.0)))
        before = float(costs[0]) + (self.anchor.cost(self.camera) if self.anchor else 0.0)
        there = self._after(step, lin, columns)
        after = 0.0 if there is None or self.anchor is None else self.anchor.cost(there[0])
        if there is None or not float(cost(there[3].s)[1][0]) + after <= before:
            self.damping = min(self.damping * 10, _MAX_DAMPING)
            return 0.0 if length < 1e-3 else np.inf
        self.damping = max(self.damping / 10, _MIN_DAMPING)
        self.camera, self.measured, self.state, self.residuals = there
        self.lin = None
        return length

    def _after(
        self, step: FloatArray, lin: Linearised, columns: FloatArray
    ) -> tuple[Camera, Measurements, States, Residuals] | None:
        """Return the camera, measurements, state and residuals after a step; None if the camera is invalid."""
        of_camera = step[6:]
        if self.anchor:
            of_camera = np.zeros(4)
            of_camera[list(self.anchor.free)] = step[6:]
        camera = updated(self.camera, of_camera)
        if camera is None or not is_plausible(camera, self.first):
            return None
        sigma_px, sigma_range_m = self.noise
        measured = self.measured
        if self.count:
            measured = Measurements.of(self.matches, camera, sigma_px=sigma_px, sigma_range_m=sigma_range_m)
            if (np.isnan(measured.xy) & ~np.isnan(self.measured.xy)).any():
                return None
        predicted = replace(self.residuals, e=self.residuals.e - np.tensordot(step[6:], columns, axes=1))
        state = apply_step(self.measured, self.state, predicted, lin, step[None, :6])
        return camera, measured, state, residuals(measured, state)


def predicted_gains(descent: Descent, members: BoolArray, counts: Sequence[int]) -> list[float]:
    """Return the significance of the predicted gain from freeing more intrinsics, as normal deviates (a score test).

    The decrease of the cost by one Gauss-Newton step of the enlarged system, in excess of that of the current system,
    is compared with the remaining scatter. The result does therefore not depend on the stated noise.

    Args:
        descent: a pose and its camera, with the intrinsics that are free so far.
        members: (M,) the matches that count.
        counts: numbers of free intrinsics among (log f, k1, cx, cy), in ascending order.

    Source: Rao, Large sample tests of statistical hypotheses (1948); the deviate of F is Paulson's (1942).
    """
    H, g, _, _ = replace(descent, count=counts[-1]).normal_equations(members[None].astype(np.float64))
    numbers, s = int(descent.matches.dimensions[members].sum()), float(descent.residuals.s[0, members].sum())
    free = 6 + descent.count
    before, *decreases = _predicted_decreases(H, g, [free, *(6 + count for count in counts)])
    found = []
    for count, after in zip(counts, decreases, strict=True):
        more, dof = count - descent.count, numbers - 6 - count
        if dof < _MIN_DOF:
            found.append(0.0)
            continue
        F = max(after - before, 0.0) / more / max(max(s - after, 0.0) / dof, 1e-9)
        a, b, root = 2 / (9 * more), 2 / (9 * dof), F ** (1 / 3)
        found.append(((1 - b) * root - (1 - a)) / sqrt(b * root * root + a))
    return found


def _predicted_decreases(H: FloatArray, g: FloatArray, sizes: Sequence[int]) -> list[float]:
    """Return g^T H^-1 g of the leading parts of a system, ignoring directions that H does not determine."""
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    scaled, right = H / np.outer(scale, scale), g / scale
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(scaled))
    except np.linalg.LinAlgError:
        inverse = np.full_like(H, np.inf)
    # 1 / trace(H^-1) is a lower bound of the eigenvalues, also of those of the leading parts
    if (inverse * inverse).sum() < 1 / _MIN_INFORMATION:
        along = inverse @ right  # triangular: each part has its own
        return [float(along[:size] @ along[:size]) for size in sizes]
    found = []
    for size in sizes:
        values, vectors = np.linalg.eigh(scaled[:size, :size])
        known = values > _MIN_INFORMATION
        along = vectors.T[known] @ right[:size]
        found.append(float((along * along / values[known]).sum()))
    return found


def _solve_damped(H: FloatArray, g: FloatArray, damping: float, free: Sequence[int]) -> FloatArray:
    diagonal = np.diag(H)
    damped = H + np.diag(damping * diagonal + 1e-14 * diagonal.max() + 1e-300)
    try:
        step = np.linalg.solve(damped, g)
    except np.linalg.LinAlgError:
        step = np.linalg.lstsq(damped, g, rcond=None)[0]
    step = np.where(np.isfinite(step), step, 0.0)
    limited = [k for k, index in enumerate(free) if index < len(_MAX_STEP) - 1]
    sizes = np.array([np.linalg.norm(step[:3]), *np.abs(step[6:][limited])])
    most = _MAX_STEP[[0, *(free[k] + 1 for k in limited)]]
    return np.asarray(step / max(1.0, float((sizes / most).max())))


def _covariance(descent: Descent, inliers: BoolArray) -> FloatArray:
    """Return the covariance of pose and intrinsics from the inliers; huge but finite if undetermined."""
    H, _, _, _ = descent.normal_equations(inliers[None].astype(np.float64))
    scale = np.sqrt(np.maximum(np.diag(H), _MIN_INFORMATION))
    unit = np.ones(len(H))
    if descent.anchor is None or 0 in descent.anchor.free:
        unit[6:7] = descent.camera.focal_px  # from log f to px
    inverse = guarded_inverse(H / np.outer(scale, scale)) * np.outer(unit / scale, unit / scale)
    return np.asarray((inverse + inverse.T) / 2)
