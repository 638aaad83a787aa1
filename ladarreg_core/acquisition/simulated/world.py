"""The bench: a simulated room with a pan/tilt unit, and what the instruments on the unit measure from where it stands.

The twins of the devices share one bench: the unit's twin publishes how it moves, and the others measure along that
motion. The room's frame is the simulator's; the world is that of the unit: its origin where the axes cross, X ahead at
pan 0, Z along the pan axis.
"""

from __future__ import annotations

import threading
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import ByteArray, FloatArray
from ladarreg_core.foundations.validation import require_choice, require_int
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_about
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import ScanGeometry
from ladarreg_core.scanner.pan_tilt import pan_tilt_pose, rays_of_line, turned_by_unit
from ladarreg_core.simulate.ladar import turned
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.terrestrial import RANGE_NOISE, RangeNoise, echoes_along, scan_around
from ladarreg_core.simulate.worlds.scenes import build_scene
from ladarreg_core.simulate.worlds.surroundings import SURROUNDINGS
from ladarreg_core.simulate.worlds.world import World

Angles = tuple[FloatArray, FloatArray]
"""Pan and tilt (N,), rad."""
Motion = Callable[[FloatArray], Angles]
"""Pan and tilt (N,), rad, of the unit at times (N,), s of the bench's clock."""
NoiseKey = Sequence[int]
"""Whole numbers that name a measurement; equal keys draw equal noise."""

LINE_MOUNT = Rigid(rotation_about("x", np.pi / 2), np.array([0.06, 0.0, 0.08]))
"""`unit_from_scanner` of a line scanner as it was meant to be mounted: stood upright, its left side up."""
FRAME_MOUNT = Rigid(np.eye(3), np.array([0.05, 0.0, 0.10]))
"""`unit_from_scanner` of a scanner with a field of view as it was meant to be mounted: axes along the unit's."""
CAMERA_MOUNT = Rigid(CAMERA_AXES_FROM_SCANNER.T, np.array([0.08, 0.07, 0.05]))
"""`unit_from_camera`: beside the scanner, looking ahead."""

_MOUNT_OFF_M, _MOUNT_OFF_RAD = 0.02, float(np.radians(0.4))
_NOISES = {name: zlib.crc32(name.encode()) for name in ("line", "frame", "photograph", "mount")}
_REMEMBERED_MOTIONS = 64
_LIT = Lighting()


def mounted(seed: int, nominal: Rigid = LINE_MOUNT) -> Rigid:
    """Return a true mount: the nominal one, each coordinate off by up to 20 mm and each angle by up to .4 deg.

    The angles turn the scanner about its own centre, in the axes of the unit.

    Args:
        seed: every seed gives another one.
        nominal: `unit_from_scanner` as it was meant.
    """
    rng = np.random.default_rng([_NOISES["mount"], seed])
    off = Rigid.from_rotvec(rng.uniform(-1, 1, 3) * _MOUNT_OFF_RAD)
    moved = nominal.translation + rng.uniform(-1, 1, 3) * _MOUNT_OFF_M
    return Rigid(off.rotation @ nominal.rotation, moved)


@dataclass(frozen=True, slots=True)
class _Published:
    from_s: float
    rest_s: float
    motion: Motion


@lru_cache(maxsize=2)
def _room(scene: str, seed: int) -> tuple[World, RayCaster]:
    layout = np.random.default_rng([zlib.crc32(f"{scene}/bench".encode()), seed])
    world = build_scene(scene, layout=layout, all_around=True)
    return world, RayCaster(world.triangles)


class Bench:
    """A room, a clock and a pan/tilt unit; every instrument on the unit measures from its true position.

    The noise of a measurement depends on the seed and on its `noise_key` alone, never on the time: a run that was
    interrupted and resumed measures the same. Safe to use from several threads.

    Args:
        scene: a name in `SURROUNDINGS`.
        seed: of room, mounts and noise.
        mount: true `unit_from_scanner` of the line scanner; None: `LINE_MOUNT` with an error by the seed.
        frame_mount: true `unit_from_scanner` of the scanner with a field of view; None: `FRAME_MOUNT` with an error.
        camera_mount: true `unit_from_camera`.
        room_from_world: where the unit stands in the room; None: where the simulator's own scanner would.
        noise: of both scanners.
        clock: seconds, rising; None: seconds since the bench was made.

    Raises:
        OptionError: if the scene does not exist or the seed is out of range.
        DependencyError: if `embreex` is not installed.
    """

    def __init__(
        self,
        scene: str = "office",
        seed: int = 0,
        *,
        mount: Rigid | None = None,
        frame_mount: Rigid | None = None,
        camera_mount: Rigid = CAMERA_MOUNT,
        room_from_world: Rigid | None = None,
        noise: RangeNoise = RANGE_NOISE,
        clock: Callable[[], float] | None = None,
    ) -> None:
        require_choice(scene, tuple(SURROUNDINGS), "the scene")
        require_int(seed, "the seed", least=0)
        self.scene, self.seed, self.noise = scene, seed, noise
        self.mount = mounted(seed) if mount is None else mount
        self.frame_mount = mounted(seed, FRAME_MOUNT) if frame_mount is None else frame_mount
        self.camera_mount = camera_mount
        self.room_from_world = Rigid.identity() if room_from_world is None else room_from_world
        self.room, self._caster = _room(scene, seed)
        begun = time.monotonic()
        self.clock = clock or (lambda: time.monotonic() - begun)
        """Seconds, rising; replaced by whoever publishes motions on another clock, before the first one."""
        self._publishing = threading.Lock()
        self._count, self._arrives = 0, False
        self._motions: tuple[_Published, ...] = (_Published(-np.inf, -np.inf, _at_zero),)

    # -- clock and motion --------------------------------------------------------------------------------------

    def now(self) -> float:
        """Return the time on the bench's clock, s."""
        return self.clock()

    def publish_motion(self, motion: Motion, *, from_s: float, rest_s: float, arrives: bool = True) -> None:
        """Tell how the unit moves from now on, until another motion is published.

        A unit that is halted, stuck or sent elsewhere publishes another motion. Times before `from_s` keep the motion
        that was published for them.

        Args:
            motion: pan and tilt at times from `from_s` on; constant from `rest_s` on.
            from_s: when it begins, on the bench's clock.
            rest_s: when the unit is at rest.
            arrives: whether it comes to rest where it was sent; False for a unit that was halted.
        """
        with self._publishing:
            kept = [m for m in self._motions if m.from_s < from_s][-_REMEMBERED_MOTIONS:]
            self._motions = (*kept, _Published(from_s, rest_s, motion))
            self._count, self._arrives = self._count + 1, arrives

    def place_unit(self, at: PanTilt) -> None:
        """Put the unit somewhere at rest, now."""

        def rest(times: FloatArray) -> Angles:
            return np.full(len(times), at.pan_rad), np.full(len(times), at.tilt_rad)

        now = self.now()
        self.publish_motion(rest, from_s=now, rest_s=now)

    def arrival(self) -> tuple[int, float] | None:
        """Return the number of the latest motion and when it comes to rest where it was sent; None if it does not."""
        with self._publishing:
            return (self._count, self._motions[-1].rest_s) if self._arrives else None

    @property
    def moving(self) -> bool:
        """Whether the unit moves now."""
        return self.rest_s > self.now()

    @property
    def rest_s(self) -> float:
        """When the unit comes, or came, to rest, on the bench's clock."""
        return self._motions[-1].rest_s

    def angles_at(self, times_s: ArrayLike) -> Angles:
        """Return the unit's true pan and tilt (N,), rad, at times (N,) on the bench's clock."""
        times = np.atleast_1d(np.asarray(times_s, dtype=np.float64))
        motions = self._motions
        starts = np.array([m.from_s for m in motions])
        which = np.maximum(np.searchsorted(starts, times, side="right") - 1, 0)
        pan, tilt = np.empty_like(times), np.empty_like(times)
        for k in np.unique(which):
            here = which == k
            pan[here], tilt[here] = motions[k].motion(times[here])
        return pan, tilt

    def pose_at(self, time_s: float) -> PanTilt:
        """Return the unit's true position at a time on the bench's clock."""
        pan, tilt = self.angles_at(time_s)
        return PanTilt(float(pan[0]), float(tilt[0]))

    # -- measurements ------------------------------------------------------------------------------------------

    def scan_line(
        self, at: PanTilt | Angles, angles_rad: ArrayLike, *, noise_key: NoiseKey
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Measure a line with the line scanner.

        Args:
            at: where the unit stands, or pan and tilt (N,) of each ray if it moves: `angles_at(times of the rays)`.
            angles_rad: (N,) angle of each ray in the scanner's plane, 0 ahead, positive to the left.
            noise_key: names the measurement.

        Returns:
            Ranges, m, NaN without a return, and intensity, which falls with the squared range and is 1 for white paper
            at 2.5 m; (N,) each.
        """
        amplitude, ranges = self._true_line(at, angles_rad)
        return self.noise.measured(amplitude, ranges, self._rng("line", noise_key))

    def true_line(self, at: PanTilt | Angles, angles_rad: ArrayLike) -> NDArray[np.float32]:
        """Return the true ranges (N,), m, that `scan_line` measures; 0 where a ray meets nothing."""
        return self._true_line(at, angles_rad)[1]

    def scan_frame(
        self,
        at: PanTilt,
        geometry: ScanGeometry,
        *,
        noise_key: NoiseKey,
        name: str = "",
        report: Callable[[float], None] | None = None,
    ) -> Scan:
        """Measure a frame with the scanner that has a field of view of its own.

        Args:
            at: where the unit stands.
            geometry: the scanner's rays.
            noise_key: names the measurement.
            name: of the scan.
            report: receives the share done, 0..1.

        Returns:
            The scan in the scanner's own frame.
        """
        ranges, intensity = scan_around(
            self.room,
            self._caster,
            geometry,
            rng=self._rng("frame", noise_key),
            noise=self.noise,
            world_from_scanner=self.room_from_world @ self.frame_pose(at),
            report=report,
        )
        return Scan(geometry=geometry, ranges=ranges, intensity=intensity, name=name)

    def scan_beams(
        self, at: PanTilt, origins: FloatArray, beams: FloatArray, *, noise_key: NoiseKey
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Measure along beams that do not all start at one point, with a scanner that sits where that of frames does.

        Args:
            at: where the unit stands.
            origins: (N, 3) where each starts, m, in the scanner's frame.
            beams: (N, 3) directions, unit vectors, in the scanner's frame.
            noise_key: names the measurement.

        Returns:
            Ranges (N,), m, NaN without a return, and intensity (N,), as `scan_line`.
        """
        pose = self.room_from_world @ self.frame_pose(at)
        amplitude, ranges = echoes_along(
            self.room, self._caster, turned(origins, pose.rotation) + pose.translation, turned(beams, pose.rotation)
        )
        return self.noise.measured(amplitude, ranges, self._rng("frame", noise_key))

    def photograph(
        self, at: PanTilt, camera: CameraModel, *, noise_key: NoiseKey, report: Callable[[float], None] | None = None
    ) -> ByteArray:
        """Return a photograph, (height, width, 3) uint8 RGB, by the camera on the unit."""
        return take_photograph(
            self.room,
            self._caster,
            camera,
            (self.room_from_world @ self.camera_pose(at)).inverse,
            lighting=_LIT,
            rng=self._rng("photograph", noise_key),
            report=report,
        )

    # -- truth -------------------------------------------------------------------------------------------------

    def line_pose(self, at: PanTilt) -> Rigid:
        """Return the true `world_from_scanner` of the line scanner."""
        return pan_tilt_pose(at.pan_rad, at.tilt_rad, unit_from_scanner=self.mount)

    def frame_pose(self, at: PanTilt) -> Rigid:
        """Return the true `world_from_scanner` of the scanner with a field of view."""
        return pan_tilt_pose(at.pan_rad, at.tilt_rad, unit_from_scanner=self.frame_mount)

    def camera_pose(self, at: PanTilt) -> Rigid:
        """Return the true `world_from_camera`."""
        return pan_tilt_pose(at.pan_rad, at.tilt_rad, unit_from_scanner=self.camera_mount)

    def _true_line(
        self, at: PanTilt | Angles, angles_rad: ArrayLike
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        pan, tilt = (at.pan_rad, at.tilt_rad) if isinstance(at, PanTilt) else at
        rays = turned(rays_of_line(angles_rad), self.mount.rotation)
        in_world = turned_by_unit(rays, pan, tilt)
        origins = turned_by_unit(np.broadcast_to(self.mount.translation, rays.shape), pan, tilt)
        room = self.room_from_world
        return echoes_along(
            self.room,
            self._caster,
            turned(origins, room.rotation) + room.translation,
            turned(in_world, room.rotation),
        )

    def _rng(self, kind: str, key: NoiseKey) -> np.random.Generator:
        return np.random.default_rng([_NOISES[kind], self.seed, *(int(k) & 0xFFFF_FFFF for k in key)])


def _at_zero(times: FloatArray) -> Angles:
    return np.zeros(len(times)), np.zeros(len(times))
