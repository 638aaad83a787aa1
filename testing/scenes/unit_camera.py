"""A swept panorama and photographs by a camera on the same pan/tilt unit, whose mount is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.acquisition.composition.sweep_composition import compose_sweeps
from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.simulated.recordings import simulate_sweep
from ladarreg_core.acquisition.simulated.world import CAMERA_MOUNT, Bench
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.pan_tilt import pan_tilt_pose

CAMERA = Camera(width=640, height=480, fx=576.0, fy=576.0, cx=319.5, cy=239.5)
_POSITIONS_DEG = ((-50.0, 0.0), (-20.0, 5.0), (10.0, -5.0), (40.0, 0.0))
_PANS_RAD = np.radians(np.arange(-90.0, 90.0, 0.5))
_ANGLES_RAD = np.radians(np.arange(-60.0, 60.0, 0.25))
_OFF_RAD, _OFF_M = float(np.radians(2.0)), 0.05


@dataclass(frozen=True)
class UnitCameraCase:
    """What a scanner and a camera on one unit measured."""

    panorama: Scan
    photos: list[Photo]
    units: list[Rigid]
    """`world_from_unit` of each photograph."""
    mount: Rigid
    """The true `unit_from_camera`."""


def simulate_unit_camera(seed: int, *, photographs_of: int | None = None) -> UnitCameraCase:
    """Simulate a room, with a mount of the camera that is off by up to 2 deg and 50 mm along each axis.

    Args:
        seed: of everything.
        photographs_of: seed of another room that the camera photographs; None: the same room.
    """
    rng = np.random.default_rng([seed, 45])
    off = Rigid.from_rotvec(rng.uniform(-1, 1, 3) * _OFF_RAD)
    mount = Rigid(off.rotation @ CAMERA_MOUNT.rotation, CAMERA_MOUNT.translation + rng.uniform(-1, 1, 3) * _OFF_M)
    bench = Bench("office", seed, camera_mount=mount)
    swept = simulate_sweep("office", seed, pans_rad=_PANS_RAD, angles_rad=_ANGLES_RAD, bench=bench)
    panorama = compose_sweeps(swept.sweeps, bench.mount, name="sweep").scan
    seen = bench if photographs_of is None else Bench("office", photographs_of, camera_mount=mount)
    stops = [PanTilt(*np.radians(at)) for at in _POSITIONS_DEG]
    photos = [Photo(seen.photograph(at, CAMERA, noise_key=(k,)), CAMERA) for k, at in enumerate(stops)]
    return UnitCameraCase(panorama, photos, [pan_tilt_pose(at.pan_rad, at.tilt_rad) for at in stops], mount)
