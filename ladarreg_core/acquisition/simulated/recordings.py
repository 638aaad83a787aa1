"""Sweeps and mosaics as runs would record them, with the truth, made without devices in between."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.line_sweep import LineSweep, UnitTrack
from ladarreg_core.acquisition.simulated.world import Bench
from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation, ScanGeometry
from ladarreg_core.scanner.pan_tilt import rays_of_line, turned_by_unit
from ladarreg_core.simulate.terrestrial import RANGE_NOISE, RangeNoise

LINE_ANGLES_RAD = np.radians(np.linspace(-135.0, 135.0, 1081))
"""Rays of a line scanner with a field of view of 270 deg."""
LINE_ANGLES_RAD.flags.writeable = False
UNIT_STEP_RAD = float(np.radians(46.2857 / 3600))
"""Finest step of a pan/tilt unit with a reduction of 4:1 in half steps."""
FRAME = AzimuthElevation(rows=700, columns=1000, d_azimuth_rad=np.radians(0.055), d_elevation_rad=np.radians(0.055))
"""Rays of a scanner with a field of view of 55 x 38.5 deg."""

_STREAMS = {"sweep": 1, "mosaic": 2}


@dataclass(frozen=True, slots=True, kw_only=True)
class Continuous:
    """How a unit turns while lines are measured, and how its position is read meanwhile."""

    speed_rad_s: float = float(np.radians(10.0))
    """Speed of the pan axis."""
    acceleration_rad_s2: float = float(np.radians(60.0))
    """From rest to speed and back."""
    latency_s: float = 0.040
    """A reading is stamped so long after it was true."""
    jitter_s: float = 0.005
    """Standard deviation of the latency, drawn for each reading."""
    reading_s: float = 0.050
    """Time between readings."""
    line_s: float = 0.025
    """Time between the starts of lines."""
    sweep_s: float = 0.01875
    """Time from a line's first ray to its last."""

    def __post_init__(self) -> None:
        for name in ("speed_rad_s", "acceleration_rad_s2", "reading_s", "line_s", "sweep_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise OptionError(f"`{name}` is {value}; it must be positive")
        if not (self.sweep_s <= self.line_s and self.latency_s >= 0 and self.jitter_s >= 0):
            raise OptionError("a line must end before the next one begins, and latency and jitter may not be negative")


@dataclass(frozen=True, eq=False)
class SimulatedSweep:
    """Lines as a run records them, and the truth."""

    sweeps: tuple[LineSweep, ...]
    """One a pass."""
    bench: Bench
    """Room and true mount (`bench.mount`, `unit_from_scanner`)."""
    true_ranges_m: tuple[NDArray[np.float32], ...]
    """(L, N) a pass: without noise; 0 where a ray meets nothing."""
    true_positions: tuple[tuple[FloatArray, FloatArray], ...]
    """Pan and tilt of each ray, (L, N) each, rad, a pass."""
    latency_s: float
    """Mean latency of the readings; 0 for a unit that stood still."""

    def true_points(self, number: int) -> NDArray[np.float64]:
        """Return the true points (L, N, 3), m, of a pass in the world; NaN where `ranges_m` is."""
        sweep, (pan, tilt) = self.sweeps[number], self.true_positions[number]
        ranges = np.where(np.isfinite(sweep.ranges_m), self.true_ranges_m[number], np.nan).astype(np.float64)
        local = rays_of_line(sweep.angles_rad) * ranges[..., None]
        return turned_by_unit(self.bench.mount @ local, pan, tilt)


def simulate_sweep(
    scene: str = "office",
    seed: int = 0,
    *,
    pans_rad: Sequence[float] | FloatArray | None = None,
    tilts_rad: Sequence[float] = (0.0,),
    passes: int = 1,
    continuous: Continuous | None = None,
    mount: Rigid | None = None,
    angles_rad: FloatArray = LINE_ANGLES_RAD,
    origin: Rigid | None = None,
    noise: RangeNoise = RANGE_NOISE,
    unit_step_rad: float = UNIT_STEP_RAD,
    bench: Bench | None = None,
    report: Callable[[float], None] | None = None,
) -> SimulatedSweep:
    """Record sweeps of a line scanner on a pan/tilt unit.

    Random, by `seed`: the room, the mount unless it is given, the noise of ranges and intensities; of a unit that moves
    also the latency of each reading, the phase of the readings and the time between the start of the movement and that
    of the first line. Angles read back are exact but for the unit's step: a unit at rest stands on a step, one that
    moves is read to the nearest.

    Args:
        scene: a name in `SURROUNDINGS`.
        seed: not negative.
        pans_rad: one line at each, positive to the left; of a unit that moves only the first and the last count.
            None: 360 lines over 180 deg.
        tilts_rad: one sweep at each.
        passes: sweeps at each tilt, in alternating directions.
        continuous: how the unit turns; None: it rests for each line.
        mount: true `unit_from_scanner`; None: one by the seed, see `mounted`.
        angles_rad: (N,) rays of a line, in the order in which they are measured.
        origin: `room_from_world`, where the unit stands; its angles are about its own vertical.
        noise: of ranges and intensities.
        unit_step_rad: resolution of the unit.
        bench: the bench to record at, instead of one of `scene`, `seed`, `mount`, `origin` and `noise`; to record
            several times in one room.
        report: receives the share done, 0..1.
    """
    b = bench or Bench(scene, seed, mount=mount, room_from_world=origin, noise=noise)
    pans = np.linspace(-np.pi / 2, np.pi / 2, 360, endpoint=False) if pans_rad is None else np.asarray(pans_rad)
    if len(pans) < 2 or passes < 1 or not len(tilts_rad):
        raise OptionError("a sweep needs at least two pan angles, one tilt angle and one pass")
    rng = np.random.default_rng([_STREAMS["sweep"], b.seed])
    sweeps, truths, positions = [], [], []
    for number in range(len(tilts_rad) * passes):
        tilt = _stepped(tilts_rad[number // passes], unit_step_rad)
        ordered = pans if number % passes % 2 == 0 else pans[::-1]
        if continuous is None:
            at = np.broadcast_to(_stepped(ordered, unit_step_rad)[:, None], (len(pans), len(angles_rad)))
            track = times = None
        else:
            times, at, track = _turning(
                float(ordered[0]), float(ordered[-1]), tilt, len(angles_rad), continuous, unit_step_rad, rng
            )
        tilts = np.full(at.shape, tilt)
        ranges, intensity, true = (np.empty(at.shape, np.float32) for _ in range(3))
        for k in range(len(at)):
            here = (at[k], tilts[k])
            true[k] = b.true_line(here, angles_rad)
            ranges[k], intensity[k] = b.scan_line(here, angles_rad, noise_key=(number, k))
            if report:
                report((number + (k + 1) / len(at)) / (len(tilts_rad) * passes))
        if track is None:
            sweep = LineSweep(ranges, intensity, np.asarray(angles_rad), at[:, 0], tilts[:, 0])
        else:
            assert times is not None
            assert continuous is not None
            sweep = LineSweep.moving(
                ranges, intensity, np.asarray(angles_rad), time_s=times, sweep_s=continuous.sweep_s, track=track
            )
        sweeps.append(sweep)
        truths.append(true)
        positions.append((at, tilts))
    return SimulatedSweep(
        tuple(sweeps), b, tuple(truths), tuple(positions), 0.0 if continuous is None else continuous.latency_s
    )


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedPiece:
    """A piece of a mosaic as a run records it, and the truth."""

    scan: Scan
    """In the scanner's own frame."""
    read: PanTilt
    """Position as read from the unit."""
    world_from_scanner: Rigid
    """True pose; the world is that of the unit's true axes."""


@dataclass(frozen=True, eq=False)
class SimulatedMosaic:
    """Pieces as a run records them, and the truth."""

    pieces: tuple[SimulatedPiece, ...]
    """Row by row from the lowest, each row from the right to the left."""
    bench: Bench
    """Room and true mount (`bench.frame_mount`, `unit_from_scanner`)."""


def simulate_mosaic(
    scene: str = "office",
    seed: int = 0,
    *,
    columns: int = 4,
    rows: int = 3,
    overlap: float = 0.15,
    pans_rad: Sequence[float] | None = None,
    tilts_rad: Sequence[float] | None = None,
    geometry: ScanGeometry = FRAME,
    angle_error_rad: float = float(np.radians(0.1)),
    mount: Rigid | None = None,
    origin: Rigid | None = None,
    noise: RangeNoise = RANGE_NOISE,
    bench: Bench | None = None,
    report: Callable[[float], None] | None = None,
) -> SimulatedMosaic:
    """Record a mosaic of a scanner with a field of view of its own on a pan/tilt unit.

    Random, by `seed`: the room, the mount unless it is given, the error of each piece's pan and of its tilt as read,
    and the noise of ranges and intensities.

    Args:
        scene: a name in `SURROUNDINGS`.
        seed: not negative.
        columns: pieces side by side, centred ahead.
        rows: pieces one above the other, centred on the horizon.
        overlap: share of a piece that its neighbour covers too, at the horizon.
        pans_rad: pan of each column, instead of `columns` and `overlap`.
        tilts_rad: tilt of each row, instead of `rows` and `overlap`.
        geometry: rays of the scanner.
        angle_error_rad: standard deviation of the angles as read about the true ones.
        mount: true `unit_from_scanner`; None: one by the seed, see `mounted`.
        origin: `room_from_world`, where the unit stands.
        noise: of ranges and intensities.
        bench: the bench to record at, instead of one of `scene`, `seed`, `mount`, `origin` and `noise`.
        report: receives the share done, 0..1.
    """
    b = bench or Bench(scene, seed, frame_mount=mount, room_from_world=origin, noise=noise)
    if not (columns >= 1 and rows >= 1 and 0 <= overlap < 1):
        raise OptionError("a mosaic needs at least one piece, and an overlap from 0 to less than 1")
    height, width = geometry.shape
    d_tilt, d_pan = geometry.step_rad
    pans = _centred(columns, width * d_pan * (1 - overlap)) if pans_rad is None else np.asarray(pans_rad)
    tilts = _centred(rows, height * d_tilt * (1 - overlap)) if tilts_rad is None else np.asarray(tilts_rad)
    rng = np.random.default_rng([_STREAMS["mosaic"], b.seed])
    pieces: list[SimulatedPiece] = []
    for tilt in tilts:
        for pan in pans:
            number = len(pieces)
            read = PanTilt(float(pan), float(tilt))
            off = rng.standard_normal(2) * angle_error_rad
            true = PanTilt(float(pan + off[0]), float(tilt + off[1]))
            scan = b.scan_frame(true, geometry, noise_key=(number,), name=f"{number:03d}")
            pieces.append(SimulatedPiece(scan, read, b.frame_pose(true)))
            if report:
                report(len(pieces) / (len(pans) * len(tilts)))
    return SimulatedMosaic(tuple(pieces), b)


def _centred(count: int, step: float) -> FloatArray:
    return (np.arange(count) - (count - 1) / 2) * step


def _stepped(angles: float | FloatArray, step: float) -> FloatArray:
    return np.asarray(np.rint(np.asarray(angles) / step) * step)


def _turning(
    first: float,
    last: float,
    tilt: float | FloatArray,
    rays: int,
    how: Continuous,
    step: float,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray, UnitTrack]:
    """Return start times of lines (L,), pan of each ray (L, N), and the readings, of a movement that starts at 0 s."""
    way = abs(last - first)
    ramp = min(how.speed_rad_s / how.acceleration_rad_s2, float(np.sqrt(way / how.acceleration_rad_s2)))
    top = ramp * how.acceleration_rad_s2
    whole = way / top + ramp

    def pan_at(times: FloatArray) -> FloatArray:
        t = np.clip(times, 0, whole)
        start, end = np.minimum(t, ramp), np.maximum(t - (whole - ramp), 0)
        gone = how.acceleration_rad_s2 * (start**2 - end**2) / 2 + top * np.maximum(t - ramp, 0)
        return np.asarray(first + np.sign(last - first) * gone)

    times = float(rng.uniform(0, how.line_s)) + np.arange(int(whole / how.line_s)) * how.line_s
    pan = pan_at(times[:, None] + np.linspace(0, how.sweep_s, rays))
    read = np.arange(-2 * how.reading_s, whole + 2 * how.reading_s, how.reading_s) + rng.uniform(0, how.reading_s)
    late = np.maximum(how.latency_s + how.jitter_s * rng.standard_normal(len(read)), 0)
    stamped = read + late
    order = np.argsort(stamped, kind="stable")
    order = order[np.concatenate([[True], np.diff(stamped[order]) > 0])]
    track = UnitTrack(
        stamped[order], _stepped(pan_at(read), step)[order], np.full(len(order), float(tilt), dtype=np.float64)
    )
    return times, pan, track
