"""A simulated rig of a turning lidar and several cameras in several places outdoors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera, FisheyeCamera
from ladarreg_core.frames import Rigid, look_along, rotation_from_rotvec
from ladarreg_core.photo import Photo, TimedPhoto
from ladarreg_core.registration.rig.results import RigPair
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.robot_lidar import LidarName, lidar_rays, scan_points
from ladarreg_core.simulate.worlds.outdoors import EYE_M, OUTDOORS, build_outdoors
from ladarreg_core.simulate.worlds.world import Placement

_LIT = Lighting(ambient=0.38, strength=(1.0,), tints=((1.0, 0.97, 0.9),))
_SEED = 1_000_000  # apart from the places of `simulate_outdoors`


@dataclass(frozen=True, slots=True, eq=False)
class MountedCamera:
    """A camera of the rig."""

    model: CameraModel
    camera_from_scanner: Rigid
    """True pose."""


def mounted(
    model: CameraModel, *, yaw_deg: float, pitch_deg: float, centre: tuple[float, float, float]
) -> MountedCamera:
    """Return a camera that looks so far to the left of the scanner's X axis and above it, from a place, m."""
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    axis = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    return MountedCamera(model, Rigid.from_centre(look_along(axis), np.array(centre)))


def three_cameras() -> dict[str, MountedCamera]:
    """Return two pinholes, ahead and to the right, and a fisheye of 150 degrees that looks ahead."""
    fisheye = FisheyeCamera(800, 640, 300.0, 300.0, 400.0, 319.0, (0.02, -0.004, 0.0, 0.0))
    return {
        "ahead": mounted(Camera.from_focal(960, 640, 649.0), yaw_deg=3, pitch_deg=-2, centre=(0.2, 0.15, -0.1)),
        "right": mounted(Camera.from_focal(640, 480, 448.0), yaw_deg=-38, pitch_deg=1, centre=(0.1, -0.25, -0.12)),
        "wide": mounted(fisheye, yaw_deg=-4, pitch_deg=-3, centre=(0.25, 0.0, 0.2)),
    }


def panorama_camera() -> MountedCamera:
    """Return a panorama above the lidar."""
    return mounted(EquirectangularCamera(1600, 800), yaw_deg=8, pitch_deg=1, centre=(0.0, 0.05, 0.3))


@dataclass(frozen=True, slots=True)
class Motion:
    """How the rig moves at one place."""

    turn_deg_s: float
    ahead_m_s: float

    def world_from_scanner(self, seconds: float) -> Rigid:
        """Return where the scanner is, so long after it was at the world's origin."""
        turn = rotation_from_rotvec(np.radians([0.0, 0.0, self.turn_deg_s * seconds]))
        return Rigid(turn, np.array([self.ahead_m_s * seconds, 0.0, 0.0]))


def moving_rig(
    camera: MountedCamera, motions: Sequence[Motion], *, after_s: Sequence[float], offset_s: float, seed: int
) -> list[RigPair]:
    """Return a pair for each motion, at its own place, with the photographs that are stamped so long after the scan.

    Photographs are stamped `offset_s` later than they are taken.
    """
    found = []
    scenes = sorted(OUTDOORS)
    for place, motion in enumerate(motions):
        layout, scan_rng, photo_rng = (np.random.default_rng([_SEED, seed, place, k]) for k in range(3))
        world = build_outdoors(scenes[place % len(scenes)], layout=layout)
        caster = RayCaster(world.triangles)
        cloud = scan_points(world, caster, lidar_rays("64 lines", scan_rng), rng=scan_rng)
        taken = []
        for after in after_s:
            pose = camera.camera_from_scanner @ motion.world_from_scanner(after - offset_s).inverse
            pixels = take_photograph(world, caster, camera.model, pose, lighting=_LIT, rng=photo_rng)
            taken.append(TimedPhoto(after, Photo(pixels, camera.model, name=f"place {place}", calibrated=True)))
        own = min(taken, key=lambda one: abs(one.after_s))
        scan = Scan.from_points(cloud.points, cloud.intensity, name=f"place {place}")
        found.append(RigPair(scan.name, scan, own.photo, taken=tuple(taken)))
    return found


def standing_rig(camera: MountedCamera, *, moments: int, people: int, seed: int) -> list[RigPair]:
    """Return the pairs of a rig that stands in one place, with so many people who stand elsewhere at every moment."""
    found = []
    places = np.random.default_rng([_SEED, seed, 9])
    for moment in range(moments):
        layout, scan_rng, photo_rng = (np.random.default_rng([_SEED, seed, k + 9 * moment * (k > 0)]) for k in range(3))
        where = [
            Placement(
                float(places.uniform(3.5, 6)), float(places.uniform(-2.2, 2.2)), -EYE_M, float(places.uniform(0, 6))
            )
            for _ in range(people)
        ]
        world = build_outdoors("courtyard", layout=layout, people=where)
        caster = RayCaster(world.triangles)
        cloud = scan_points(world, caster, lidar_rays("64 lines", scan_rng), rng=scan_rng)
        pixels = take_photograph(world, caster, camera.model, camera.camera_from_scanner, lighting=_LIT, rng=photo_rng)
        name = f"moment {moment}"
        photo = Photo(pixels, camera.model, name=name, calibrated=True)
        found.append(RigPair(name, Scan.from_points(cloud.points, cloud.intensity, name=name), photo))
    return found


def camera_rig(
    cameras: Mapping[str, MountedCamera], *, places: int, seed: int, lidar: LidarName = "64 lines"
) -> list[RigPair]:
    """Return the pairs of a rig, place by place; their camera names are those of the cameras, if these are several."""
    found = []
    scenes = sorted(OUTDOORS)
    for place in range(places):
        layout, scan_rng, photo_rng = (np.random.default_rng([_SEED, seed, place, k]) for k in range(3))
        world = build_outdoors(scenes[place % len(scenes)], layout=layout)
        caster = RayCaster(world.triangles)
        cloud = scan_points(world, caster, lidar_rays(lidar, scan_rng), rng=scan_rng)
        scan = Scan.from_points(cloud.points, cloud.intensity, name=f"place {place}")
        for name, camera in cameras.items():
            pixels = take_photograph(
                world, caster, camera.model, camera.camera_from_scanner, lighting=_LIT, rng=photo_rng
            )
            photo = Photo(pixels, camera.model, name=f"{name} {place}", calibrated=True)
            found.append(RigPair(photo.name, replace(scan), photo, name if len(cameras) > 1 else ""))
    return found
