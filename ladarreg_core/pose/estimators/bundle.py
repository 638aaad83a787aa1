"""Errors-in-variables cost of a pose, minimised by Levenberg-Marquardt with the ranges eliminated.

Each match has an exact ray d, a noisy range r and a noisy pixel u. With the true range rho as an additional unknown,
the cost is the sum of

    s = min_rho |u - pi(rho d)|^2 / sigma_u^2 + (r - rho)^2 / sigma_r^2

which is chi-squared with two degrees of freedom per match. The ranges form a diagonal block, whose Schur complement
leaves a 6 x 6 system for any number of matches. Several states are processed at once (leading axis B); matches are the
last axis, because for a few hundred matches the run time is dominated by NumPy's call overhead.

Source: Triggs et al., Bundle adjustment: a modern synthesis (1999), 6.1; increments of the pose are those of
`PoseResult.covariance`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import sin, sqrt

import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.frames import Rigid, skew
from ladarreg_core.pose.estimators.measurements import Measurements

UNSEEN = 1e30
"""Cost s of a match behind the camera: finite, so that sums stay finite."""
_EYE = np.eye(6)
_GENERATORS = np.stack([skew(axis) for axis in np.eye(3)]).reshape(3, 9)
_MIN_DAMPING, _MAX_DAMPING = 1e-9, 1e9

CostFunction = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Costs (B,) from s (B, N), with their derivatives by s: the weights (B, N)."""


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """B poses, each with its own N ranges."""

    rotations: FloatArray
    """(B, 3, 3) camera_from_scanner."""
    centres: FloatArray
    """(B, 3) camera centres, scanner frame, m."""
    rho: FloatArray
    """(B, N) adjusted ranges, m."""

    @staticmethod
    def of(poses: Sequence[Rigid], measured: Measurements) -> States:
        """Return the states of poses, with the ranges as measured."""
        return States(
            np.stack([pose.rotation for pose in poses]),
            np.stack([pose.centre for pose in poses]),
            np.tile(measured.ranges, (len(poses), 1)),
        )

    def pose(self, index: int = 0) -> Rigid:
        """Return one pose."""
        return Rigid.from_centre(self.rotations[index], self.centres[index])

    def subset(self, starts: BoolArray | IntArray) -> States:
        """Return some of the states."""
        return States(self.rotations[starts], self.centres[starts], self.rho[starts])

    def joined(self, others: States) -> States:
        """Return these states, then the others."""
        return States(
            np.concatenate([self.rotations, others.rotations]),
            np.concatenate([self.centres, others.centres]),
            np.concatenate([self.rho, others.rho]),
        )

    def with_ranges_of(self, measured: Measurements) -> States:
        """Return the same poses with the ranges of other matches, as measured."""
        return States(self.rotations, self.centres, np.tile(measured.ranges, (len(self.centres), 1)))


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Residuals of N matches in B states, not normalised by sigma."""

    s: FloatArray
    """(B, N) cost of each match; `UNSEEN` behind the camera."""
    rotated: FloatArray
    """(B, 3, N) rays in camera axes, or in those of `fronts`."""
    xy: FloatArray
    """(B, 2, N) predicted tangents; this and all following are 0 behind the camera."""
    inverse_z: FloatArray
    """(B, 1, N) 1/m."""
    e: FloatArray
    """(B, 2, N) observed minus predicted tangents."""
    range_error: FloatArray
    """(B, N) measured minus adjusted, m."""
    all_seen: bool
    """True if every match is in front of the camera in every state."""


def residuals(measured: Measurements, states: States) -> Residuals:
    """Return the residuals of every match in every state."""
    R = states.rotations
    rotated = R @ measured.rays
    p = rotated * states.rho[:, None]
    p -= R @ states.centres[:, :, None]
    if measured.fronts is not None:
        rotated, p = (np.einsum("nij,bjn->bin", measured.fronts, each) for each in (rotated, p))
    z = p[:, 2:]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse_z = 1 / z
        xy = p[:, :2] * inverse_z
        e = measured.xy - xy
        error = measured.ranges - states.rho
        weighted = measured.information * e
        if measured.correlated:
            weighted += measured.cross_information * e[:, ::-1]
        weighted *= e
        s = weighted[:, 0] + weighted[:, 1]
        s += measured.range_information * error * error
        all_seen = bool(z.min(initial=1.0) > 0 and s.max(initial=0.0) < UNSEEN)
    if not all_seen:
        unseen = ~((z[:, 0] > 0) & (s < UNSEEN))
        s[unseen] = UNSEEN
        error[unseen] = 0.0
        for values in (xy, inverse_z, e):
            values.swapaxes(1, 2)[unseen] = 0.0
    return Residuals(s, rotated, xy, inverse_z, e, error, all_seen)


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """Derivatives of the residuals in B states, for the normal equations."""

    j_pose: FloatArray
    """(B, 6, 2, N) d xy / d (w, c)."""
    j: FloatArray
    """(B, 2, N) d xy / d rho, 1/m."""
    m: FloatArray
    """(B, 2, N) M j, with M the information of xy."""
    h: FloatArray
    """(B, N) diagonal block of the ranges: j M j + 1/sigma_r^2."""


def linearise(measured: Measurements, states: States, seen: Residuals) -> Linearised:
    """Return the derivatives of every match in every state."""
    R, xy, inverse_z = states.rotations, seen.xy, seen.inverse_z
    B, _, N = xy.shape
    J = np.empty((B, 6, 2, N))
    J[:, 2, 1] = xy[:, 0]  # d p = w x p
    np.negative(xy[:, 1], out=J[:, 2, 0])
    np.multiply(J[:, 2, :1], xy, out=J[:, 0])
    np.multiply(J[:, 2, 1:], xy, out=J[:, 1])
    J[:, 0, 1] -= 1
    J[:, 1, 0] += 1
    if measured.fronts is None:
        np.multiply(xy[:, None], R[:, 2, :, None, None], out=J[:, 3:])  # d p = -R c
        J[:, 3:] -= R[:, :2].swapaxes(1, 2)[..., None]
    else:
        J[:, :3] = np.einsum("bkin,nka->bain", J[:, :3], measured.fronts)  # d p = F w x F p
        turned = np.einsum("nij,bja->bian", measured.fronts, R)
        J[:, 3:] = xy[:, None] * turned[:, 2, :, None] - turned[:, :2].swapaxes(1, 2)
    J[:, 3:] *= inverse_z[:, None]
    j = (seen.rotated[:, :2] - xy * seen.rotated[:, 2:]) * inverse_z
    m = measured.information * j
    if measured.correlated:
        m += measured.cross_information * j[:, ::-1]
    by_pixel = j * m
    h = by_pixel[:, 0] + by_pixel[:, 1]
    h += measured.range_information
    return Linearised(J, j, m, h)


@dataclass(slots=True, eq=False)
class Evaluation:
    """The residuals of all matches at one pose, and their derivatives, which are computed when first needed."""

    measured: Measurements
    """The matches."""
    state: States
    """The pose (B = 1)."""
    seen: Residuals
    """The residuals."""
    _lin: Linearised | None = None

    @property
    def lin(self) -> Linearised:
        """The derivatives of the residuals."""
        if self._lin is None:
            self._lin = linearise(self.measured, self.state, self.seen)
        return self._lin

    @property
    def s(self) -> FloatArray:
        """(N,) cost of each match."""
        return np.asarray(self.seen.s[0])

    def information(self, members: BoolArray) -> FloatArray:
        """Return the Fisher information (6, 6) of (w, c) from the members (N,), with the ranges marginalised."""
        weights = members.astype(np.float64)[None]
        return np.asarray(normal_equations(self.measured, self.seen, self.lin, weights)[0][0])


def normal_equations(
    measured: Measurements, seen: Residuals, lin: Linearised, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return H (B, 6, 6) and g (B, 6) of the poses, with the ranges eliminated.

    Args:
        measured: the matches.
        seen: their residuals.
        lin: their derivatives.
        weights: (B, N) multiply the information; matches behind the camera do not count.
    """
    B, _, _, N = lin.j_pose.shape
    if not seen.all_seen:
        weights = weights * (seen.s < UNSEEN)
    weights = weights[:, None]
    # information of a pixel with its range marginalised: M - M j j^T M / h
    share = lin.m * (weights / lin.h[:, None])
    diagonal = weights * measured.information
    diagonal -= lin.m * share
    cross = lin.m[:, :1] * share[:, 1:]
    if measured.correlated:
        cross -= weights * measured.cross_information
    J = lin.j_pose
    K = diagonal[:, None] * J
    K -= cross[:, None] * J[:, :, ::-1]
    # residual at the measured range: e' = e - j (r - rho)
    e = seen.e - lin.j * seen.range_error[:, None]
    flat = K.reshape(B, 6, 2 * N)
    H = flat @ J.reshape(B, 6, 2 * N).swapaxes(1, 2)
    g = flat @ e.reshape(B, 2 * N, 1)
    H += H.swapaxes(1, 2).copy()
    H *= 0.5
    return H, g[..., 0]


def apply_step(
    measured: Measurements, states: States, seen: Residuals, lin: Linearised, step: FloatArray | None
) -> States:
    """Return the states after a step (B, 6) of the poses and the resulting step of the ranges; None: ranges only."""
    e, rotations, centres = seen.e, states.rotations, states.centres
    if step is not None:
        B, _, _, N = lin.j_pose.shape
        e = e - (step[:, None] @ lin.j_pose.reshape(B, 6, 2 * N)).reshape(B, 2, N)
        rotations = rotations_from_rotvecs(step[:, :3]) @ rotations
        centres = centres + step[:, 3:]
    pulled = lin.m * e
    step_rho = measured.range_information * seen.range_error
    step_rho += pulled[:, 0]
    step_rho += pulled[:, 1]
    step_rho /= lin.h
    step_rho += states.rho
    np.maximum(step_rho, measured.least_rho, out=step_rho)
    return States(rotations, centres, np.minimum(step_rho, measured.most_rho, out=step_rho))


def rotations_from_rotvecs(rotvecs: FloatArray) -> FloatArray:
    """Return exp([w]x), (B, 3, 3), of rotation vectors (B, 3). Source: Rodrigues' formula."""
    if len(rotvecs) == 1:  # in numbers of Python's own, at a third of the time
        x, y, z = rotvecs[0].tolist()
        turn = sqrt(x * x + y * y + z * z) + 1e-30
        a, b = sin(turn) / turn, 2 * (sin(turn / 2) / turn) ** 2
        return np.array(
            [
                [
                    [1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
                    [b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x],
                    [b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)],
                ]
            ]
        )
    angle = np.sqrt((rotvecs * rotvecs).sum(axis=1)) + 1e-30
    half = np.sin(angle / 2) / angle
    K = (rotvecs @ _GENERATORS).reshape(-1, 3, 3)
    return np.asarray(
        _EYE[:3, :3] + (np.sin(angle) / angle)[:, None, None] * K + (2 * half * half)[:, None, None] * (K @ K)
    )


def adjust_ranges(measured: Measurements, states: States, *, rounds: int = 2) -> tuple[States, Residuals]:
    """Adjust the ranges with the poses fixed; return the states and their residuals."""
    seen = residuals(measured, states)
    for _ in range(rounds):
        adjusted = apply_step(measured, states, seen, linearise(measured, states, seen), None)
        after = residuals(measured, adjusted)
        better = after.s <= seen.s
        if better.all():
            states, seen = adjusted, after
        else:  # discard steps that overshoot
            states = States(states.rotations, states.centres, np.where(better, adjusted.rho, states.rho))
            seen = residuals(measured, states)
    return states, seen


@dataclass(slots=True, eq=False)
class Descent:
    """Levenberg-Marquardt on B states at once, one step at a time, with a damping for each state.

    The cost may change between steps, as in graduated non-convexity.
    """

    measured: Measurements
    """The matches."""
    states: States
    """The current states."""
    residuals: Residuals
    """Their residuals."""
    damping: FloatArray
    """(B,) relative to the diagonal of H."""
    step_sigma: FloatArray
    """(B,) length of the last step in standard deviations; infinite after a rejected step."""
    _known: tuple[CostFunction, FloatArray, FloatArray] | None = None
    """The last cost function, with the weights and costs of the current residuals."""

    @staticmethod
    def start(measured: Measurements, states: States, seen: Residuals | None = None) -> Descent:
        """Return the descent before its first step; `seen` are the residuals of the states, if known."""
        B = len(states.centres)
        seen = residuals(measured, states) if seen is None else seen
        return Descent(measured, states, seen, np.full(B, 1e-4), np.full(B, np.inf))

    def step(self, cost: CostFunction) -> None:
        """Take one step of every state; a step that would increase the cost is rejected, and the damping raised."""
        lin = linearise(self.measured, self.states, self.residuals)
        if self._known is not None and self._known[0] is cost:
            _, weights, before = self._known
        else:
            weights, before = cost(self.residuals.s)
        H, g = normal_equations(self.measured, self.residuals, lin, weights)
        step = _solve_damped(H, g, self.damping)
        there = apply_step(self.measured, self.states, self.residuals, lin, step)
        seen = residuals(self.measured, there)
        weights_there, after = cost(seen.s)
        lower = after <= before
        squared = (step[:, None] @ H @ step[:, :, None])[:, 0, 0]
        length = np.sqrt(np.maximum(squared, 0))
        self._known = None
        if lower.all():
            self._known = cost, weights_there, after
            self.step_sigma = length
            self.damping = np.maximum(self.damping / 10, _MIN_DAMPING)
        else:
            self.step_sigma = np.where(lower, length, np.where(length < 1e-3, 0.0, np.inf))
            self.damping = np.where(lower, self.damping / 10, self.damping * 10)
            self.damping = np.minimum(np.maximum(self.damping, _MIN_DAMPING), _MAX_DAMPING)
            _keep(~lower, self.states, there)
            _keep(~lower, self.residuals, seen)
            seen = replace(seen, all_seen=seen.all_seen and self.residuals.all_seen)
        self.states, self.residuals = there, seen


def _keep(stay: BoolArray, old: States | Residuals, new: States | Residuals) -> None:
    """Restore the old values of the states that stay, in place: the new arrays are not shared yet."""
    for name in new.__slots__:
        if name != "all_seen":
            getattr(new, name)[stay] = getattr(old, name)[stay]


def _solve_damped(H: FloatArray, g: FloatArray, damping: FloatArray) -> FloatArray:
    damped = H.copy()
    diagonal = damped.reshape(len(H), 36)[:, ::7]  # a view
    diagonal += damping[:, None] * diagonal + (1e-14 * diagonal.max(axis=1, keepdims=True) + 1e-300)
    try:
        step = np.linalg.solve(damped, g[..., None])[..., 0]
    except np.linalg.LinAlgError:
        step = np.stack([np.linalg.lstsq(h, v, rcond=None)[0] for h, v in zip(damped, g, strict=True)])
    if np.abs(step).max() < 0.5:  # far from what follows
        return step
    length = np.sqrt((step[:, :3] ** 2).sum(axis=1, keepdims=True))
    if not (length < 1).all():  # beyond a radian the linearisation is invalid
        step = np.where(np.isfinite(step), step, 0.0) / np.maximum(np.where(np.isfinite(length), length, 1.0), 1.0)
    return np.asarray(step)


def least_squares(
    measured: Measurements,
    states: States,
    *,
    members: BoolArray | None = None,
    seen: Residuals | None = None,
    steps: int = 20,
    tolerance_sigma: float = 1e-2,
) -> tuple[States, Residuals, BoolArray]:
    """Minimise the sum of s over the members, without robust weights.

    Args:
        measured: the matches.
        states: the starting poses.
        members: (N,) the matches that count, None: all; the ranges of the others are adjusted as well.
        seen: the residuals of the starting poses, if known.
        steps: maximum number of steps.
        tolerance_sigma: stop when no pose moves by more than this many of its standard deviations.

    Returns:
        The states, their residuals, and which of the states converged (B,).
    """
    descent = Descent.start(measured, states, seen)
    counts = np.ones(len(measured)) if members is None else members.astype(np.float64)
    weights = np.broadcast_to(counts, descent.residuals.s.shape)

    def cost(s: FloatArray) -> tuple[FloatArray, FloatArray]:
        return weights, s @ counts

    for _ in range(steps):
        descent.step(cost)
        if (descent.step_sigma < tolerance_sigma).all():
            break
    return descent.states, descent.residuals, descent.step_sigma < tolerance_sigma


def information_matrix(measured: Measurements, states: States, *, members: BoolArray | None = None) -> FloatArray:
    """Return the Fisher information (B, 6, 6) of (w, c) from the members (N,), with the ranges marginalised."""
    seen = residuals(measured, states)
    weights = np.ones_like(seen.s) if members is None else np.broadcast_to(members.astype(np.float64), seen.s.shape)
    return normal_equations(measured, seen, linearise(measured, states, seen), weights)[0]
