"""A room of analytic planes and a pillar, and sweeps through it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.line_sweep import LineSweep, UnitTrack
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.pan_tilt import rays_of_line, turned_by_unit

ROOM = np.array([[-1.8, -2.6, -1.3], [3.4, 2.2, 1.5]])
PILLAR = np.array([[1.2, -0.5, -1.3], [1.5, -0.1, 0.6]])
BOARD = np.array([[-1.2, 1.0, 0.7], [0.4, 1.9, 0.8]])
UPRIGHT = Rigid.from_rotvec([np.pi / 2, 0, 0])
MOUNT = Rigid.from_rotvec([0.02, -0.03, 0.015], [0.09, -0.03, 0.06]) @ UPRIGHT
WIDE_LINE = np.radians(np.arange(-135.0, 135.1, 1.5))


def distances(origins: FloatArray, rays: FloatArray) -> NDArray[np.float64]:
    """Return the ranges (...,) at which rays (..., 3) from within the room meet it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        out = np.where(rays > 0, ROOM[1] - origins, ROOM[0] - origins) / rays
        nearest = _along_last(np.fmin, np.where(rays == 0, np.inf, out))
        for box in (PILLAR, BOARD):
            ends = [(side - origins) / rays for side in box]
            enter = _along_last(np.maximum, np.minimum(*ends))
            leave = _along_last(np.minimum, np.maximum(*ends))
            nearest = np.where((enter < leave) & (enter > 0), np.minimum(nearest, enter), nearest)
    return np.asarray(nearest)


def _along_last(of_two: np.ufunc, values: FloatArray) -> NDArray[np.float64]:
    """Return the reduction along the last axis of three; numpy's own is ten times slower along so short an axis."""
    return np.asarray(of_two(of_two(values[..., 0], values[..., 1]), values[..., 2]))


def off_surface(points: FloatArray) -> NDArray[np.float64]:
    """Return how far points (..., 3) are from the nearest surface of the room, m."""
    p = np.asarray(points, dtype=np.float64)
    off = (
        [np.abs(p - ROOM[:, None]).min(axis=(0, -1))] if p.ndim == 2 else [np.abs(p[..., None, :] - ROOM).min((-1, -2))]
    )
    for box in (PILLAR, BOARD):
        outside = np.maximum(np.maximum(box[0] - p, p - box[1]), 0)
        inside = np.minimum(p - box[0], box[1] - p).min(axis=-1)
        off.append(np.where(inside > 0, inside, np.linalg.norm(outside, axis=-1)))
    return np.asarray(np.min(off, axis=0))


def stop_and_go(
    pans_rad: FloatArray, tilt_rad: float = 0.0, *, mount: Rigid = MOUNT, angles_rad: FloatArray = WIDE_LINE,
    sigma_m: float = 0.0, seed: int = 0, lost: float = 0.0,
) -> LineSweep:  # fmt: skip
    """Return a sweep of lines measured at rest."""
    pan = np.asarray(pans_rad)[:, None]
    rng = np.random.default_rng(seed)
    ranges = _measured(pan, np.full_like(pan, tilt_rad), mount, angles_rad, sigma_m, rng, lost)
    tilts = np.full(len(pan), tilt_rad)
    return LineSweep(ranges, np.ones_like(ranges), angles_rad, np.asarray(pans_rad), tilts)


def in_motion(
    first_rad: float, last_rad: float, *, rate_rad_s: float = 0.2, tilt_rad: float = 0.0, mount: Rigid = MOUNT,
    angles_rad: FloatArray = WIDE_LINE, period_s: float = 0.1, latency_s: float = 0.0, jitter_s: float = 0.0,
    sigma_m: float = 0.0, seed: int = 0, lost: float = 0.0,
) -> LineSweep:  # fmt: skip
    """Return a sweep of lines measured while the unit pans at a constant rate."""
    rng = np.random.default_rng(seed)
    seconds = abs(last_rad - first_rad) / rate_rad_s
    starts, sweep_s = np.arange(0.2, seconds - 0.2, period_s), 0.7 * period_s
    times = starts[:, None] + np.linspace(0, sweep_s, len(angles_rad))
    pan = first_rad + np.sign(last_rad - first_rad) * rate_rad_s * times
    ranges = _measured(pan, np.full_like(pan, tilt_rad), mount, angles_rad, sigma_m, rng, lost)
    read_at = np.arange(-0.2, seconds + 0.2, 0.05)
    read = first_rad + np.sign(last_rad - first_rad) * np.clip(rate_rad_s * read_at, 0, abs(last_rad - first_rad))
    stamps = np.sort(read_at + latency_s + jitter_s * rng.standard_normal(len(read_at)))
    track = UnitTrack(stamps, read, np.full(len(read), tilt_rad))
    return LineSweep.moving(
        ranges, np.ones_like(ranges), angles_rad, time_s=starts, sweep_s=sweep_s, track=track, latency_s=latency_s
    )


def _measured(
    pan: FloatArray,
    tilt: FloatArray,
    mount: Rigid,
    angles: FloatArray,
    sigma: float,
    rng: np.random.Generator,
    lost: float,
) -> NDArray[np.float32]:
    rays = turned_by_unit(rays_of_line(angles) @ mount.rotation.T, pan, tilt)
    origins = turned_by_unit(mount.translation, pan, tilt)
    ranges = distances(origins, rays) + sigma * rng.standard_normal(rays.shape[:-1])
    ranges[rng.random(ranges.shape) < lost] = np.nan
    return ranges.astype(np.float32)
