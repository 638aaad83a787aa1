"""Calibration of the mount: where a line scanner sits on its pan/tilt unit, from surfaces that a sweep sees twice.

Surfaces are seen twice by the two halves of a line that passes the zenith, by sweeps at several tilts, and by passes in
both directions. The planes are unknowns, too, and are eliminated; each has three, so that only the disagreement of
several views of it says anything about the mount. What no disagreement shows is found by the information matrix: it
keeps its value.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.frames import Rigid, rotation_about, rotvec_from_rotation
from ladarreg_core.progress import Progress
from ladarreg_core.range_alignment.voxel_planes import (
    LEAST_ACROSS,
    LEAST_POINTS,
    SMALL_LEAST_POINTS,
    SMALL_VOXELS_M,
    VOXELS_M,
    SharedPlanes,
    plane_moments,
    shared_planes,
)
from ladarreg_core.scanner.pan_tilt import turned_by_unit

Parameter = Literal["x", "y", "z", "roll", "pitch", "yaw", "latency"]
MOUNT: tuple[Parameter, ...] = ("x", "y", "z", "roll", "pitch", "yaw")

_MOST_POINTS = 1_500_000
_ENOUGH_POINTS = 250_000  # while the mount is far off
_GATES = ((0.25, 15.0), (0.25, 15.0), (0.15, 12.0), (0.1, 10.0), (0.06, 8.0), (0.03, 6.0), (0.015, 5.0))
"""Distance (m) and angle (deg) within which two views' patches are one plane, in turn."""
_TRIMMED_GATES = 2  # the last ones, where most planes are right
_NOISE_GATE = 3.0  # two patches of a plane are at most so many times the noise apart
_MOST_STEPS = 5  # with the last gates; planes come and go without end
_FINISHED = 0.15  # standard deviations of the result; planes that come and go move it by more than rounding does
_HUBER = 3.0
_UNDETERMINED = 0.003  # m, and rad at one metre: a wider uncertainty is no measurement of a mount
_UNDETERMINED_BY_FURNITURE = 0.7  # of the noise of a range: patches that are not what they seem measure as much
_CERTAIN_M = 1e-6
_LONGEST_STEP = 0.04  # m, and rad at one metre
_LOOSE = 2.5e-4  # m, and rad at one metre: from here on furniture is asked, too
_MUCH_TIGHTER = 1.5
_HELD_RAD = float(np.radians(0.5))
"""What a rotation that is not determined is thought to be off by."""
_FEW_PLANES = 2.0  # planes whose word is worth nothing: what fewer show, others cannot check
_PRIOR_POINTS = 10
_HELD_OUT = 4  # one block of the room in four
_LEAST_PLANES = 12
_SEEN_TWICE = (
    "sweep a line of more than 180 deg over a whole turn with the tilt at about -45 deg, or sweep at several tilts"
)
_MAD = 1.4826
_DISAGREE = 0.02  # share of the planes whose views disagree so much by chance
_TRIMMINGS = 8
_LEAST_SHARE = 1e-6
_MEDIAN_CHI2 = 0.85  # the median of chi^2 / dof with about four degrees of freedom


@dataclass(frozen=True, slots=True)
class MountCalibration:
    """A mount with its uncertainty, or the reason why the one given stays."""

    unit_from_scanner: Rigid
    """The mount to use: calibrated if `accepted`, else the one given."""
    latency_s: float
    """Latency of the unit's readings to use."""
    accepted: bool
    """The calibrated mount describes surfaces that it was not fitted to better than the one given."""
    parameters: tuple[Parameter, ...]
    """Names of the unknowns: shift and rotation along and about the axes of the unit at `tilt_rad` (ahead, left, and
    the pan axis), and the latency if there is one."""
    determined: tuple[bool, ...]
    """(P,) whether the sweeps show each parameter; those they do not show keep the values given."""
    covariance: NDArray[np.float64]
    """(P, P), m and rad (and s), of the shift d and the rotation w with true point = exp([w]x) estimated point + d in
    these axes; infinite on the diagonal, and zero beside it, where a parameter is not determined."""
    tilt_rad: float
    """Mean tilt of the sweeps: at this tilt the axes of the parameters are level."""
    sigma_range_m: float
    """Noise of the ranges as the planes show it; NaN without planes."""
    held_out_before_m: float
    """RMS distance of points from planes that were not fitted to, with the mount given; NaN without planes."""
    held_out_after_m: float
    """The same with the calibrated mount."""
    planes: int
    """Planes that were seen twice."""
    points: int
    """Points on them."""
    reasons: tuple[str, ...] = field(default=())
    """Sentences for the operator: what is not determined, and why a calibration was not accepted."""

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(P,) standard deviations; infinite where a parameter is not determined."""
        return np.sqrt(np.diag(self.covariance))

    def as_fields(self) -> dict[str, Any]:
        """Return the calibration as written to `panorama.json`: null for what is not determined or was not measured."""

        def number(value: float) -> float | None:
            return float(value) if np.isfinite(value) else None

        units = [1.0] * 3 + [float(np.degrees(1.0))] * 3 + [1.0]
        unit_names = ["m"] * 3 + ["deg"] * 3 + ["s"]
        sigma = {
            f"{name}_{unit}": number(value * factor)
            for name, value, factor, unit in zip(self.parameters, self.sigma, units, unit_names, strict=False)
        }
        return {
            "accepted": self.accepted, "reasons": list(self.reasons),
            "not_determined": [n for n, seen in zip(self.parameters, self.determined, strict=True) if not seen],
            "sigma": sigma, "axes_tilt_deg": float(np.degrees(self.tilt_rad)), "parameters": list(self.parameters),
            "covariance": [[number(value) for value in row] for row in self.covariance], "latency_s": self.latency_s,
            "planes": self.planes, "points": self.points, "sigma_range_m": number(self.sigma_range_m),
            "held_out_before_m": number(self.held_out_before_m), "held_out_after_m": number(self.held_out_after_m),
        }  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Returns:
    """The returns that are used, flat."""

    local: NDArray[np.float64]
    """(N, 3) m, scanner frame."""
    view: IntArray
    """(N,)."""
    pan: NDArray[np.float64]
    tilt: NDArray[np.float64]
    pan_rate: NDArray[np.float64]
    tilt_rate: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """The normal equations with the planes eliminated, in scaled units."""

    information: NDArray[np.float64]
    """(P, P) for a range noise of one metre."""
    gradient: NDArray[np.float64]
    """(P,)."""
    scores: NDArray[np.float64]
    """(K, P) gradient of each plane."""
    shares: NDArray[np.float64]
    """(K, P, P) information of each plane."""
    sigma_m: float
    """Noise of the ranges."""
    points: int
    """Points that count."""
    weakest_m: float
    """Largest standard deviation of what counts as determined, m, and rad at one metre."""


def calibrate_mount(
    sweeps: Sequence[LineSweep],
    unit_from_scanner: Rigid,
    *,
    latency_s: float = 0.0,
    report: Callable[[Progress], None] | None = None,
) -> MountCalibration:
    """Calibrate the mount, and the latency of the unit's readings if the unit moved, by surfaces that are seen twice.

    Args:
        sweeps: all passes of a run.
        unit_from_scanner: the mount as planned or measured, right within about 50 mm and a degree.
        latency_s: first guess.
        report: receives the progress; may raise `Cancelled`.

    Returns:
        The calibration; never a mount that describes held-out surfaces worse than the one given.

    Source: the mount is the constant of thesis 2.2.3; planes are eliminated as by Schur complement in bundle
    adjustment, their scores give a covariance that holds if the residuals of one plane are correlated.
    """
    scale = _scale(sweeps)
    start = _State(unit_from_scanner, latency_s)
    tilt = float(np.mean(np.concatenate([sweep.tilt_rad for sweep in sweeps])))
    level = rotation_about("y", -tilt)  # rows: ahead, left and the pan axis, in the unit's frame at that tilt

    def progress(done: int, label: str) -> None:
        if report:
            report(Progress(done, 4, label))

    progress(0, "finding surfaces that are seen twice")
    fitted, planes, _ = _fit(sweeps, start, start, scale, level, keep=lambda found: found.block % _HELD_OUT != 0)
    if planes < _LEAST_PLANES:
        why = f"{planes} surfaces are seen twice, and {_LEAST_PLANES} are needed; {_SEEN_TWICE}"
        return _kept(start, scale, tilt, planes, why)
    progress(1, "checking the mount on other surfaces")
    before, after = _held_out(sweeps, start, fitted)
    if not after < before:
        why = (
            f"the calibrated mount leaves {1000 * after:.2f} mm on surfaces that it was not fitted to, "
            f"the one given {1000 * before:.2f} mm"
        )
        return _kept(start, scale, tilt, planes, why, before, after)
    progress(2, "calibrating the mount")
    final, planes, solved = _fit(sweeps, fitted, start, scale, level, keep=None, gates=_GATES[-1:])
    assert solved is not None
    covariance, determined = _covariance(solved[0], scale)
    if not determined.all() or _worst(covariance, scale) > _LOOSE:
        small = _fit(
            sweeps, final, start, scale, level, keep=None, gates=_GATES[-1:], voxels_m=SMALL_VOXELS_M,
            least_points=SMALL_LEAST_POINTS,
        )  # fmt: skip
        assert small[2] is not None
        tighter = _covariance(small[2][0], scale)
        more = int(tighter[1].sum()) > int(determined.sum())
        no_less = bool((tighter[1] | ~determined).all())
        if more or (no_less and _LOOSE < _worst(covariance, scale) > _MUCH_TIGHTER * _worst(tighter[0], scale)):
            final, planes, solved = small
            covariance, determined = tighter
    assert solved is not None
    system, points = solved
    names = MOUNT if len(scale) == 6 else (*MOUNT, "latency")
    hidden = [name for name, seen in zip(names, determined, strict=True) if not seen]
    reasons = (_undetermined(hidden),) if hidden else ()
    progress(4, "mount calibrated")
    return MountCalibration(
        final.mount, final.latency_s, True, names, tuple(map(bool, determined)), covariance,
        tilt, system.sigma_m, before, after, planes, points, reasons,
    )  # fmt: skip


def _worst(covariance: FloatArray, scale: FloatArray) -> float:
    """Return the largest standard deviation of a determined parameter, m, and rad at one metre."""
    sigma = np.sqrt(np.diag(covariance)) / scale
    return float(sigma[np.isfinite(sigma)].max(initial=0.0))


@dataclass(frozen=True, slots=True)
class _State:
    mount: Rigid
    latency_s: float

    def moved(self, step: FloatArray, level: FloatArray) -> _State:
        """Return the state moved by a step (P,) whose axes are the rows of `level`, in those of the unit."""
        turn = Rigid.from_rotvec(level.T @ step[3:6], level.T @ step[:3])
        return _State(turn @ self.mount, self.latency_s + (float(step[6]) if len(step) > 6 else 0.0))

    def since(self, start: _State, level: FloatArray, unknowns: int) -> NDArray[np.float64]:
        """Return the step (P,) that leads here from another state."""
        turn = self.mount @ start.mount.inverse
        step = np.concatenate([level @ turn.translation, level @ rotvec_from_rotation(turn.rotation)])
        return np.append(step, self.latency_s - start.latency_s)[:unknowns]


def _undetermined(names: list[Parameter]) -> str:
    words = {
        "x": "the shift ahead (x)", "y": "the shift to the left (y)", "z": "the height along the pan axis (z)",
        "roll": "the roll", "pitch": "the pitch", "yaw": "the yaw about the pan axis", "latency": "the latency",
    }  # fmt: skip
    listed = [words[name] for name in names]
    if len(listed) == 1:
        what = f"{listed[0]} is not determined by these sweeps and keeps its value"
    else:
        what = f"{', '.join(listed[:-1])} and {listed[-1]} are not determined by these sweeps and keep their values"
    return f"{what}; {_what_helps(names)}"


def _what_helps(names: list[Parameter]) -> str:
    if "latency" in names:
        return "sweep in both directions"
    if set(names) <= {"z", "yaw"}:
        return "they only move the whole cloud; sweeps at several tilts show them"
    return "set the tilt to about -45 deg, or sweep at several tilts, one of them about -45 deg"


def _kept(
    start: _State,
    scale: FloatArray,
    tilt_rad: float,
    planes: int,
    why: str,
    before: float = np.nan,
    after: float = np.nan,
) -> MountCalibration:
    names = MOUNT if len(scale) == 6 else (*MOUNT, "latency")
    nothing = np.diag(np.full(len(names), np.inf))
    return MountCalibration(
        start.mount, start.latency_s, False, names, (False,) * len(names), nothing, tilt_rad, np.nan, before, after,
        planes, 0, (f"the mount given is kept: {why}",),
    )  # fmt: skip


def _scale(sweeps: Sequence[LineSweep]) -> NDArray[np.float64]:
    """Return what one metre of movement at one metre's distance is in each unknown: m, rad, and s."""
    rates = [0.0]
    for sweep in sweeps:
        if sweep.track is not None and sweep.ray_time_s is not None:
            rates.append(float(np.median(np.hypot(*sweep.track.rate(sweep.ray_time_s)))))
    return np.append(np.ones(6), 1 / max(rates)) if max(rates) > 0 else np.ones(6)


def _returns(sweeps: Sequence[LineSweep], state: _State, most: int = _MOST_POINTS) -> _Returns:
    """Return every n-th return of all sweeps at their positions, `most` in all."""
    total = sum(int(np.isfinite(sweep.ranges_m).sum()) for sweep in sweeps)
    stride = max(1, int(np.ceil(total / most)))
    parts = []
    for number, sweep in enumerate(sweeps):
        line, ray = (index[::stride] for index in np.nonzero(np.isfinite(sweep.ranges_m)))
        local = sweep.rays[ray] * sweep.ranges_m[line, ray, None].astype(np.float64)
        behind = _behind(sweep, state.mount)[ray]
        if sweep.track is None or sweep.ray_time_s is None:
            pan, tilt = np.asarray(sweep.pan_rad)[line], np.asarray(sweep.tilt_rad)[line]
            rates = np.zeros_like(pan), np.zeros_like(tilt)
        else:
            times = sweep.ray_time_s[line, ray]
            pan, tilt = sweep.track.position(times, latency_s=state.latency_s)
            rates = sweep.track.rate(times, latency_s=state.latency_s)
        parts.append((local, 2 * number + behind, pan, tilt, *rates))
    return _Returns(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _in_world(returns: _Returns, state: _State) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points (N, 3) and their unit rays (N, 3) in the world."""
    rays = returns.local / np.linalg.norm(returns.local, axis=-1, keepdims=True)
    return (
        turned_by_unit(state.mount @ returns.local, returns.pan, returns.tilt),
        turned_by_unit(rays @ state.mount.rotation.T, returns.pan, returns.tilt),
    )


def _behind(sweep: LineSweep, mount: Rigid) -> IntArray:
    """Return (N,) 1 for the rays of a line beyond its highest or lowest point, which another line sees ahead."""
    tilt = float(np.median(sweep.tilt_rad))
    normal = turned_by_unit(mount.rotation[:, 2], 0.0, tilt)
    ahead = np.cross(normal, [0.0, 0.0, 1.0])
    if np.linalg.norm(ahead) < 0.5:  # a line that lies flat has no highest point
        return np.zeros(len(sweep.angles_rad), np.intp)
    if ahead @ turned_by_unit(mount.rotation[:, 0], 0.0, tilt) < 0:
        ahead = -ahead
    return np.asarray(turned_by_unit(sweep.rays @ mount.rotation.T, 0.0, tilt) @ ahead < 0).astype(np.intp)


def _fit(
    sweeps: Sequence[LineSweep],
    state: _State,
    start: _State,
    scale: FloatArray,
    level: FloatArray,
    *,
    keep: Callable[[SharedPlanes], NDArray[np.bool_]] | None,
    gates: Sequence[tuple[float, float]] = _GATES,
    voxels_m: Sequence[float] = VOXELS_M,
    least_points: int = LEAST_POINTS,
) -> tuple[_State, int, tuple[_System, int] | None]:
    """Minimise the distances of points from the planes that they share, matching the planes again after each step."""
    count = 0
    solved = None
    for number in range(len(gates) - 1 + _MOST_STEPS):
        apart, angle = gates[min(number, len(gates) - 1)]
        apart = max(apart, _NOISE_GATE * solved[0].sigma_m) if solved else apart
        trimmed = number >= len(gates) - _TRIMMED_GATES
        returns = _returns(sweeps, state, _MOST_POINTS if trimmed else _ENOUGH_POINTS)
        world, rays = _in_world(returns, state)
        found = shared_planes(
            world, rays, returns.view, farthest_apart_m=apart, largest_angle_rad=np.radians(angle), voxels_m=voxels_m,
            least_points=least_points,
        )  # fmt: skip
        found = found if keep is None else found.select(keep(found))
        count = found.count
        if count < _LEAST_PLANES:
            return state, count, None
        weakest = np.inf if least_points == LEAST_POINTS else _UNDETERMINED_BY_FURNITURE
        system = _system(returns, state, world, rays, found, scale, level, trimmed=trimmed, weakest=weakest)
        solved = system, system.points
        step = _step(system, state.since(start, level, len(scale)) / scale)
        state = state.moved(step * scale, level)
        if number + 1 >= len(gates) and step @ system.information @ step < (_FINISHED * system.sigma_m) ** 2:
            break
    return state, count, solved


def _system(
    returns: _Returns,
    state: _State,
    world: FloatArray,
    rays: FloatArray,
    found: SharedPlanes,
    scale: FloatArray,
    level: FloatArray,
    *,
    trimmed: bool = False,
    weakest: float = np.inf,
) -> _System:
    """Build the normal equations and eliminate the planes' own unknowns: offset and two inclinations each."""
    at, plane, planes = found.point, found.plane, found.count
    normal = found.normals[plane]
    off = world[at] - found.centres[plane]
    residual = (off * normal).sum(-1)
    pan, tilt = returns.pan[at], returns.tilt[at]
    across = (rays[at] * normal).sum(-1)
    spread = np.sqrt(across**2 + LEAST_ACROSS**2)  # noise along the ray, as it acts across the plane
    scaled = residual / spread
    usual = _MAD * float(np.median(np.abs(scaled)))
    # Dark, far and grazing surfaces are noisier: each patch has its own noise, and that of all where it has few points.
    clipped = np.minimum(scaled**2, (_HUBER * usual) ** 2)
    count = np.bincount(found.patch)
    own_noise = np.bincount(found.patch, clipped) + _PRIOR_POINTS * usual**2
    spread = spread * np.sqrt(own_noise / (count + _PRIOR_POINTS))[found.patch] / usual
    weight = np.minimum(1.0, _HUBER * usual / np.maximum(np.abs(residual / spread), 1e-12)) / spread**2

    # The rows are taken where the ray meets the plane: with the noise of the range in them they would be correlated
    # with the residuals.
    across = np.where(across < 0, -1, 1) * np.maximum(np.abs(across), LEAST_ACROSS)
    onto = -(residual / across)[:, None]
    off = off + onto * rays[at]
    met = world[at] + onto * rays[at]
    in_unit = _from_world(normal, pan, tilt)
    q = _from_world(met, pan, tilt)
    J = [in_unit @ level.T, np.cross(q, in_unit) @ level.T]
    if len(scale) > 6:
        by_pan = normal[:, 1] * met[:, 0] - normal[:, 0] * met[:, 1]
        # Tilting up moves a point by (-y) x p in the frame that pans; its normal there is that of the unit, turned up.
        by_tilt = in_unit[:, 2] * q[:, 0] - in_unit[:, 0] * q[:, 2]
        J.append((by_pan * returns.pan_rate[at] + by_tilt * returns.tilt_rate[at])[:, None])
    jacobian = np.concatenate(J, axis=1) * scale
    helper = np.where(np.abs(found.normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(helper, found.normals)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    v = np.cross(found.normals, u)
    own = np.stack([np.ones(len(at)), (off * u[plane]).sum(-1), (off * v[plane]).sum(-1)], axis=-1)

    unknowns = jacobian.shape[1]
    D = _sums(plane, planes, own * weight[:, None], own)
    C = _sums(plane, planes, jacobian * weight[:, None], own)
    h = _sums(plane, planes, own * weight[:, None], residual[:, None])[..., 0]
    explained = np.linalg.solve(D, np.concatenate([C.transpose(0, 2, 1), h[..., None]], axis=-1))
    # What remains of each row when the planes have adapted themselves.
    left = jacobian - np.einsum("ni,nij->nj", own, explained[plane][:, :, :unknowns])
    rest = residual - (own * explained[plane][:, :, unknowns]).sum(-1)
    scores = _sums(plane, planes, left, (weight * rest)[:, None])[..., 0]
    shares = _sums(plane, planes, left * weight[:, None], left)
    squares = np.bincount(plane, weight * rest**2, planes).astype(np.float64)
    count = np.bincount(plane, minlength=planes)
    if trimmed:
        agree = _agreeing(scores, shares, squares, count)
        scores, shares, squares, count = scores[agree], shares[agree], squares[agree], count[agree]
    dof = max(1, int(count.sum()) - 3 * len(count) - unknowns)
    sigma = float(np.sqrt(squares.sum() / dof))
    return _System(
        shares.sum(axis=0),
        scores.sum(axis=0),
        scores,
        shares,
        sigma,
        int(count.sum()),
        min(_UNDETERMINED, weakest * max(sigma, _CERTAIN_M)),
    )


def _agreeing(scores: FloatArray, shares: FloatArray, squares: FloatArray, count: IntArray) -> BoolArray:
    """Return the planes (K,) whose views agree with the others about the mount as well as their noise lets them.

    What remains of a plane's score after the step is chi^2 distributed if all its views saw one surface. A plane of two
    surfaces, each seen by another view, has a score that many good planes do not make up for.
    """
    values, axes = np.linalg.eigh(shares)
    use = values > _LEAST_SHARE * values[:, -1:]
    rank = use.sum(axis=1)
    keep = np.ones(len(scores), np.bool_)
    limit = chi2.isf(_DISAGREE, rank)
    for _ in range(_TRIMMINGS):
        information, unknowns = shares[keep].sum(axis=0), shares.shape[1]
        variance = squares[keep].sum() / max(1, count[keep].sum() - 3 * keep.sum() - unknowns)
        strength, directions = np.linalg.eigh(information)
        along = np.where(strength > variance / _UNDETERMINED**2, 1 / np.maximum(strength, 1e-300), 0.0)
        step = -directions @ (along * (directions.T @ scores[keep].sum(axis=0)))
        left = np.einsum("kij,ki->kj", axes, scores + shares @ step)
        off = np.where(use, left**2 / np.where(use, values, 1.0), 0.0).sum(axis=1) / variance
        usual = max(1.0, float(np.median(off[keep] / rank[keep])) / _MEDIAN_CHI2)
        new = off < limit * usual
        if (new == keep).all():
            break
        keep = new
    return keep


def _sums(plane: IntArray, planes: int, a: FloatArray, b: FloatArray) -> NDArray[np.float64]:
    """Return the sum of a_i b_i^T over each plane, (K, A, B)."""
    out = np.empty((planes, a.shape[1], b.shape[1]))
    for i in range(a.shape[1]):
        for j in range(b.shape[1]):
            out[:, i, j] = np.bincount(plane, a[:, i] * b[:, j], planes)
    return out


def _from_world(vectors: FloatArray, pan: FloatArray, tilt: FloatArray) -> NDArray[np.float64]:
    """Return directions of the world in the frame that pans and tilts: the inverse of `turned_by_unit`."""
    c, s = np.cos(pan), np.sin(pan)
    ahead = c * vectors[:, 0] + s * vectors[:, 1]
    left = c * vectors[:, 1] - s * vectors[:, 0]
    ct, st = np.cos(tilt), np.sin(tilt)
    return np.stack([ct * ahead + st * vectors[:, 2], left, ct * vectors[:, 2] - st * ahead], axis=-1)


def _seen(system: _System) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return eigenvalues and eigenvectors of the information, and which of them the sweeps determine."""
    values, axes = np.linalg.eigh(system.information)
    sigma = max(system.sigma_m, _CERTAIN_M)
    return values, axes, values > (sigma / system.weakest_m) ** 2


def _step(system: _System, since_start: FloatArray) -> NDArray[np.float64]:
    """Return the step of Gauss and Newton in the directions that are determined; others go back to where they began."""
    values, axes, seen = _seen(system)
    along = np.where(seen, -(axes.T @ system.gradient) / np.where(seen, values, 1.0), -(axes.T @ since_start))
    step = axes @ along
    return np.asarray(step * min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), 1e-12)))


def _covariance(system: _System, scale: FloatArray) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the covariance (P, P), and which parameters (P,) are determined.

    Residuals of one plane are correlated where the plane is not quite flat or its ranges are biased. The covariance of
    independent residuals is enlarged by as much as the scores of whole planes scatter more than it predicts; they are
    corrected for the plane's own share in the solution (CR2 of Bell and McCaffrey 2002). What only a few planes show is
    less certain than their noise: nothing says whether they are what they seem.
    """
    values, axes, seen = _seen(system)
    whiten = axes[:, seen] / np.sqrt(values[seen])
    white = system.scores @ whiten
    share, turn = np.linalg.eigh(whiten.T @ system.shares @ whiten)
    corrected = np.einsum("kij,ki->kj", turn, white) / np.sqrt(np.clip(1 - share, 0.05, 1))
    scatter = float((corrected**2).sum() / max(1, int(seen.sum())))
    variance = max(system.sigma_m**2, scatter)
    of_planes = np.einsum("ip,kij,jp->kp", whiten, system.shares, whiten, optimize=True)
    support = 1 / (of_planes**2).sum(axis=0)  # each column adds up to one: as many planes of equal weight
    whiten = whiten * np.sqrt(1 + _FEW_PLANES / support)
    covariance = whiten @ whiten.T * variance * np.outer(scale, scale)
    determined = (axes[:, ~seen] ** 2).sum(axis=1) < 1e-3
    # Rotations do not commute: two that are held, and wrong, turn about the third axis as well.
    for axis in range(3):
        if not determined[3 + (axis + 1) % 3] and not determined[3 + (axis + 2) % 3]:
            covariance[3 + axis, 3 + axis] += (_HELD_RAD**2 / 2) ** 2
    covariance[~determined] = 0
    covariance[:, ~determined] = 0
    covariance[~determined, ~determined] = np.inf
    return covariance, determined


def _held_out(sweeps: Sequence[LineSweep], before: _State, after: _State) -> tuple[float, float]:
    """Return the RMS distance of points from the planes of held-out blocks, with both mounts.

    The planes are those that either mount brings together, so that neither chooses its own examination.
    """
    worlds, memberships = [], []
    for state in (before, after):
        returns = _returns(sweeps, state)
        world, rays = _in_world(returns, state)
        apart, angle = _GATES[0]
        found = shared_planes(world, rays, returns.view, farthest_apart_m=apart, largest_angle_rad=np.radians(angle))
        worlds.append(world)
        memberships.append(found.select(found.block % _HELD_OUT == 0))
    errors = []
    for world in worlds:
        squares, count = 0.0, 0
        for found in memberships:
            if not found.count:
                continue
            residual = _off_planes(world[found.point], found.plane, found.count)
            squares, count = squares + float((residual**2).sum()), count + len(residual)
        errors.append(float(np.sqrt(squares / count)) if count else np.nan)
    return errors[0], errors[1]


def _off_planes(points: FloatArray, plane: IntArray, planes: int) -> NDArray[np.float64]:
    """Return the distances (M,) of points from the planes fitted to them."""

    _, centre, normal, _ = plane_moments(points, plane, planes)
    return np.asarray(((points - centre[plane]) * normal[plane]).sum(-1))
