"""Calibration of the mount: where a line scanner sits on its pan/tilt unit, from surfaces that a sweep sees twice.

Surfaces are seen twice by the two halves of a line that passes the zenith, by sweeps at several tilts, and by passes in
both directions. The planes are unknowns, too, and are eliminated; each has three, so that only the disagreement of
several views of it says anything about the mount. What no disagreement shows is found by the information matrix: it
keeps its value.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.alignment.mount_equations import (
    MountEquations,
    Returns,
    covariance_of,
    equations_of,
    step_of,
)
from ladarreg_core.acquisition.alignment.mount_result import MOUNT, MountCalibration, undetermined_reason
from ladarreg_core.acquisition.alignment.voxel_planes import (
    MIN_POINTS,
    SMALL_LEAST_POINTS,
    SMALL_VOXELS_M,
    VOXELS_M,
    SharedPlanes,
    plane_moments,
    shared_planes,
)
from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import Rigid, rotation_about, rotvec_from_rotation
from ladarreg_core.scanner.pan_tilt import turned_by_unit

_MAX_POINTS = 1_500_000
_ENOUGH_POINTS = 250_000  # while the mount is far off
_GATES = ((0.25, 15.0), (0.25, 15.0), (0.15, 12.0), (0.1, 10.0), (0.06, 8.0), (0.03, 6.0), (0.015, 5.0))
"""Distance (m) and angle (deg) within which two views' patches are one plane, in turn."""
_TRIMMED_GATES = 2  # the last ones, where most planes are right
_NOISE_GATE = 3.0  # two patches of a plane are at most so many times the noise apart
_MAX_STEPS = 5  # with the last gates; planes come and go without end
_FINISHED = 0.15  # standard deviations of the result; planes that come and go move it by more than rounding does
_UNDETERMINED_BY_FURNITURE = 0.7  # of the noise of a range: patches that are not what they seem measure as much
_LOOSE = 2.5e-4  # m, and rad at one metre: from here on furniture is asked, too
_MUCH_TIGHTER = 1.5
_HELD_OUT = 4  # one block of the room in four
_MIN_PLANES = 12
_SEEN_TWICE = (
    "sweep a line of more than 180 deg over a whole turn with the tilt at about -45 deg, or sweep at several tilts"
)


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
    if planes < _MIN_PLANES:
        why = f"{planes} surfaces are seen twice, and {_MIN_PLANES} are needed; {_SEEN_TWICE}"
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
    covariance, determined = covariance_of(solved[0], scale)
    if not determined.all() or _worst(covariance, scale) > _LOOSE:
        small = _fit(
            sweeps, final, start, scale, level, keep=None, gates=_GATES[-1:], voxels_m=SMALL_VOXELS_M,
            least_points=SMALL_LEAST_POINTS,
        )  # fmt: skip
        assert small[2] is not None
        tighter = covariance_of(small[2][0], scale)
        more = int(tighter[1].sum()) > int(determined.sum())
        no_less = bool((tighter[1] | ~determined).all())
        if more or (no_less and _LOOSE < _worst(covariance, scale) > _MUCH_TIGHTER * _worst(tighter[0], scale)):
            final, planes, solved = small
            covariance, determined = tighter
    assert solved is not None
    system, points = solved
    names = MOUNT if len(scale) == 6 else (*MOUNT, "latency")
    hidden = [name for name, seen in zip(names, determined, strict=True) if not seen]
    reasons = (undetermined_reason(hidden),) if hidden else ()
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


def _returns(sweeps: Sequence[LineSweep], state: _State, most: int = _MAX_POINTS) -> Returns:
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
    return Returns(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _in_world(returns: Returns, state: _State) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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
    least_points: int = MIN_POINTS,
) -> tuple[_State, int, tuple[MountEquations, int] | None]:
    """Minimise the distances of points from the planes that they share, matching the planes again after each step."""
    count = 0
    solved = None
    for number in range(len(gates) - 1 + _MAX_STEPS):
        apart, angle = gates[min(number, len(gates) - 1)]
        apart = max(apart, _NOISE_GATE * solved[0].sigma_m) if solved else apart
        trimmed = number >= len(gates) - _TRIMMED_GATES
        returns = _returns(sweeps, state, _MAX_POINTS if trimmed else _ENOUGH_POINTS)
        world, rays = _in_world(returns, state)
        found = shared_planes(
            world, rays, returns.view, farthest_apart_m=apart, largest_angle_rad=np.radians(angle), voxels_m=voxels_m,
            least_points=least_points,
        )  # fmt: skip
        found = found if keep is None else found.select(keep(found))
        count = found.count
        if count < _MIN_PLANES:
            return state, count, None
        weakest = np.inf if least_points == MIN_POINTS else _UNDETERMINED_BY_FURNITURE
        system = equations_of(returns, world, rays, found, scale, level, trimmed=trimmed, weakest=weakest)
        solved = system, system.points
        step = step_of(system, state.since(start, level, len(scale)) / scale)
        state = state.moved(step * scale, level)
        if number + 1 >= len(gates) and step @ system.information @ step < (_FINISHED * system.sigma_m) ** 2:
            break
    return state, count, solved


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
