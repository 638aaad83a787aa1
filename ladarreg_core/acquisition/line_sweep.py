"""Sweeps of a line scanner on a pan/tilt unit: the lines of one pass, and their points in the world."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.pan_tilt import rays_of_line, turned_by_unit

_RAMP_SHARE = 0.03  # of a pass, at either end, in which a unit may still change its speed
_MIN_SPAN_RAD = 0.05
_MIN_CRUISE = 10


@dataclass(frozen=True, slots=True, eq=False)
class UnitTrack:
    """Positions of the unit that were read while it moved.

    A reading is stamped when it arrives, on the scanner's clock: it was true one latency earlier.
    """

    time_s: FloatArray
    """(K,) rising."""
    pan_rad: FloatArray
    """(K,) positive to the left."""
    tilt_rad: FloatArray
    """(K,) positive upward."""

    def __post_init__(self) -> None:
        count = len(self.time_s)
        if not (count >= 2 and len(self.pan_rad) == len(self.tilt_rad) == count):
            raise ShapeError(
                f"the unit's track has {count} times, {len(self.pan_rad)} pan and {len(self.tilt_rad)} tilt angles; it "
                "needs at least two of each, and equally many"
            )
        if not (np.diff(self.time_s) > 0).all():
            raise ShapeError("the times of the unit's track do not rise; sort the readings, and keep one for each time")

    def steadied(self) -> UnitTrack:
        """Return the track with the jitter of its stamps removed where the unit cruises at a constant speed.

        Between the ramps a straight line through all readings says when the unit passed each angle, much better than
        one stamp. Nothing is changed if the readings do not lie on a line but for jitter.
        """
        span = float(self.pan_rad[-1] - self.pan_rad[0])
        gone = (np.asarray(self.pan_rad) - self.pan_rad[0]) / span if abs(span) > _MIN_SPAN_RAD else np.zeros(0)
        cruise = np.flatnonzero((gone > _RAMP_SHARE) & (gone < 1 - _RAMP_SHARE))
        if len(cruise) < _MIN_CRUISE:
            return self
        pan, time = np.asarray(self.pan_rad)[cruise], np.asarray(self.time_s)[cruise]
        use = np.ones(len(cruise), np.bool_)
        for _ in range(4):  # a few readings that were held up do not count
            line = np.polyfit(pan[use], time[use], 1)
            late = time - np.polyval(line, pan)
            use = np.abs(late) <= 4 * max(1.4826 * float(np.median(np.abs(late))), 1e-9)
        bent = np.polyfit(pan[use], late[use], 2)
        middle, ends = np.polyval(bent, (pan[0] + pan[-1]) / 2), np.polyval(bent, pan[[0, -1]])
        if use.mean() < 0.8 or np.abs(ends - middle).max() > 3 * late[use].std() / np.sqrt(use.sum()) * 3:
            return self
        times = np.asarray(self.time_s, np.float64).copy()
        times[cruise] = np.polyval(line, pan)
        keep = np.maximum.accumulate(times) <= times
        keep[1:] &= np.diff(np.maximum.accumulate(times)) > 0
        return UnitTrack(times[keep], np.asarray(self.pan_rad)[keep], np.asarray(self.tilt_rad)[keep])

    def position(self, time_s: FloatArray, *, latency_s: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Return pan and tilt (...,), rad, at times (...,), linear between readings and constant beyond both ends."""
        late = np.asarray(time_s) + latency_s
        return np.interp(late, self.time_s, self.pan_rad), np.interp(late, self.time_s, self.tilt_rad)

    def rate(self, time_s: FloatArray, *, latency_s: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Return the speeds of pan and tilt (...,), rad/s, between the readings around times (...,)."""
        steps = np.diff(self.time_s)
        at = np.searchsorted(self.time_s, np.asarray(time_s) + latency_s, side="right") - 1
        inside = (at >= 0) & (at < len(steps))
        at = np.clip(at, 0, len(steps) - 1)
        pan, tilt = (np.where(inside, (np.diff(angle) / steps)[at], 0.0) for angle in (self.pan_rad, self.tilt_rad))
        return pan, tilt


@dataclass(frozen=True, eq=False)
class LineSweep:
    """The lines of one pass of a sweep, in the order in which they were measured.

    Either the unit stood still for each line, at `pan_rad` and `tilt_rad`, or it moved along `track` and each ray has a
    time of its own.
    """

    ranges_m: NDArray[np.float32]
    """(L, N) m; NaN = no return."""
    intensity: NDArray[np.float32] | None
    """(L, N) in the unit of the sensor; None if the scanner has none."""
    angles_rad: FloatArray
    """(N,) angle of each ray in the scanner's plane, 0 ahead, positive to the left."""
    pan_rad: FloatArray
    """(L,) of each line; of its middle for a unit that moves."""
    tilt_rad: FloatArray
    """(L,)."""
    ray_time_s: FloatArray | None = None
    """(L, N) for a unit that moves, on the scanner's clock."""
    track: UnitTrack | None = None
    """Where it was."""

    def __post_init__(self) -> None:
        lines, rays = self.ranges_m.shape
        if len(self.angles_rad) != rays or len(self.pan_rad) != lines or len(self.tilt_rad) != lines:
            raise ShapeError(
                f"the sweep has {lines} lines of {rays} ranges, {len(self.angles_rad)} angles, {len(self.pan_rad)} pan "
                f"and {len(self.tilt_rad)} tilt angles; each ray needs an angle and each line a position"
            )
        if self.intensity is not None and self.intensity.shape != self.ranges_m.shape:
            raise ShapeError(
                f"the sweep has ranges {self.ranges_m.shape} and intensities {self.intensity.shape}; they must agree"
            )
        if (self.ray_time_s is None) != (self.track is None):
            raise ShapeError("a sweep of a moving unit needs both the unit's track and the time of each ray")

    @staticmethod
    def moving(
        ranges_m: FloatArray, intensity: FloatArray | None, angles_rad: FloatArray, *, time_s: FloatArray,
        sweep_s: float, track: UnitTrack, latency_s: float = 0.0,
    ) -> LineSweep:  # fmt: skip
        """Return the sweep of a unit that moves.

        Args:
            ranges_m: (L, N) m; NaN = no return.
            intensity: (L, N) or None.
            angles_rad: (N,) in the order in which the rays are measured.
            time_s: (L,) scanner's clock at each line's first ray.
            sweep_s: time from a line's first ray to its last.
            track: the unit's readings on the same clock; their jitter is removed, see `UnitTrack.steadied`.
            latency_s: for the positions of the lines' middles.
        """
        count = np.shape(ranges_m)[1]
        track = track.steadied()
        times = np.asarray(time_s, np.float64)[:, None] + np.linspace(0.0, sweep_s, count)
        pan, tilt = track.position(times.mean(axis=1), latency_s=latency_s)
        light = None if intensity is None else np.asarray(intensity, np.float32)
        return LineSweep(
            np.asarray(ranges_m, np.float32), light, np.asarray(angles_rad, np.float64), pan, tilt, times, track
        )

    def positions(
        self, lines: slice | IntArray = slice(None), *, latency_s: float = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Return pan and tilt, rad, of some lines: (L, 1) at rest, (L, N) of each ray in motion."""
        if self.track is None or self.ray_time_s is None:
            return np.asarray(self.pan_rad)[lines, None], np.asarray(self.tilt_rad)[lines, None]
        return self.track.position(self.ray_time_s[lines], latency_s=latency_s)

    def points_in_world(
        self, unit_from_scanner: Rigid, lines: slice | IntArray = slice(None), *, latency_s: float = 0.0
    ) -> NDArray[np.float64]:
        """Return the points (L, N, 3), m, of some lines, seen from where the axes cross; NaN = no return.

        Source: thesis 2.2.3, corrected: rotations are composed, with the scanner's lever arm.
        """
        local = self.rays * self.ranges_m[lines, :, None].astype(np.float64)
        return turned_by_unit(unit_from_scanner @ local, *self.positions(lines, latency_s=latency_s))

    @cached_property
    def rays(self) -> NDArray[np.float64]:
        """(N, 3) unit rays in the scanner's frame."""
        return rays_of_line(self.angles_rad)
