"""Simulated cases of a robot's lidar outdoors: a cloud without a grid, a photograph from beside it, the true pose."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.validation import require_choice, require_int
from ladarreg_core.frames import Rigid, ThesisParameters
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.robot_lidar import LidarName, LidarPoints, lidar_rays, scan_points
from ladarreg_core.simulate.worlds.outdoors import OUTDOORS, build_outdoors

OUTDOOR_CAMERA = Camera.from_focal(960, 640, 649.0)
"""A wide lens: 73 degrees across."""

_LIT = Lighting(ambient=0.38, strength=(1.0,), tints=((1.0, 0.97, 0.9),))
_SIDEWAYS_M, _UPWARD_M, _ALONG_M = 0.4, 0.3, 0.3
_PAN_DEG, _TILT_DEG = 8.0, 2.0
_SILENT = ("petals",)  # lidars that report no intensity


@dataclass(frozen=True, eq=False)
class OutdoorCase:
    """A cloud and a photograph, with the true pose and camera."""

    scan: Scan
    photo: Photo
    camera_from_scanner: Rigid
    """True pose."""
    true_camera: Camera
    cloud: LidarPoints
    """The returns before they were gridded."""


def simulate_outdoors(
    scene: str, *, lidar: LidarName, seed: int = 0, camera_from_scanner: Rigid | None = None
) -> OutdoorCase:
    """Simulate a robot's lidar and camera outdoors; equal arguments give equal bytes.

    Args:
        scene: a name in `OUTDOORS`: street or courtyard.
        lidar: petals and narrow (accumulated, petals without intensity), or lines of one turn (64, 128, 40, dome).
        seed: not negative; every seed gives another place and pose.
        camera_from_scanner: the pose instead of the seed's, as of a camera that is mounted on the lidar.

    Raises:
        OptionError: if the scene or lidar does not exist or the seed is out of range.
        DependencyError: if `embreex` is not installed.
    """
    require_choice(scene, tuple(OUTDOORS), "the scene")
    require_int(seed, "the seed", least=0)
    layout, pose_rng, scan_rng, photo_rng = _streams(scene, lidar, seed)
    rays = lidar_rays(lidar, scan_rng)
    world = build_outdoors(scene, layout=layout)
    caster = RayCaster(world.triangles)
    cloud = scan_points(world, caster, rays, rng=scan_rng, with_intensity=lidar not in _SILENT)
    truth = _pose(pose_rng) if camera_from_scanner is None else camera_from_scanner
    pixels = take_photograph(world, caster, OUTDOOR_CAMERA, truth, lighting=_LIT, rng=photo_rng)
    name = f"{scene}-{lidar}-{seed}"
    return OutdoorCase(
        Scan.from_points(cloud.points, cloud.intensity, name=name),
        Photo(pixels=pixels, camera=OUTDOOR_CAMERA, name=name),
        truth,
        OUTDOOR_CAMERA,
        cloud,
    )


def simulate_rig(lidar: LidarName, *, pairs: int, seed: int = 0) -> list[OutdoorCase]:
    """Simulate a rig of a lidar and a camera in so many places, streets and courtyards by turns, all with one pose.

    Args:
        lidar: as `simulate_outdoors`.
        pairs: number of places.
        seed: not negative; every seed gives another rig and other places.

    Raises:
        OptionError: if the lidar does not exist or the seed is out of range.
        DependencyError: if `embreex` is not installed.
    """
    require_int(seed, "the seed", least=0)
    truth = _pose(np.random.default_rng([zlib.crc32(f"rig/{lidar}".encode()), seed]))
    scenes = sorted(OUTDOORS)
    return [
        simulate_outdoors(
            scenes[k % len(scenes)], lidar=lidar, seed=1_000_000 + 100 * seed + k, camera_from_scanner=truth
        )
        for k in range(pairs)
    ]


def outdoor_triangles(scene: str, *, lidar: LidarName, seed: int = 0) -> FloatArray:
    """Return the triangles (T, 3, 3), m, of the place of a case; arguments as of `simulate_outdoors`."""
    return build_outdoors(scene, layout=_streams(scene, lidar, seed)[0]).triangles


def _streams(scene: str, lidar: LidarName, seed: int) -> list[np.random.Generator]:
    sequence = np.random.SeedSequence([zlib.crc32(f"{scene}/{lidar}".encode()), seed])
    return [np.random.default_rng(each) for each in sequence.spawn(4)]


def _pose(rng: np.random.Generator) -> Rigid:
    """Return a pose beside the lidar that looks about where it looks."""
    side, up, along = (float(rng.uniform(-1, 1) * most) for most in (_SIDEWAYS_M, _UPWARD_M, _ALONG_M))
    pan, tilt, roll = (float(np.radians(rng.uniform(-1, 1) * most)) for most in (_PAN_DEG, _TILT_DEG, _TILT_DEG))
    return ThesisParameters(Tx=side, Ty=up, Tz=along, alpha=pan, beta=tilt, gamma=roll).pose
