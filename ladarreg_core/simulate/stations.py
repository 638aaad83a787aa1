"""Scans of one room from several upright stations, with their true poses."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.validation import require_choice, require_int
from ladarreg_core.frames import Rigid, rotation_about
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.terrestrial import RANGE_NOISE, RangeNoise, dome_grid, scan_around
from ladarreg_core.simulate.worlds.scenes import build_scene
from ladarreg_core.simulate.worlds.surroundings import SURROUNDINGS
from ladarreg_core.simulate.worlds.world import World

_BEAM_RAD = float(np.radians(0.02))


def upright_pose(position_m: FloatArray, yaw_rad: float, lean_rad: tuple[float, float] = (0.0, 0.0)) -> Rigid:
    """Return where a scanner stands: its position (3,), its yaw, and how it leans about its X and Y axes."""
    lean = Rigid.from_rotvec([*lean_rad, 0.0])
    return Rigid(rotation_about("z", yaw_rad) @ lean.rotation, np.asarray(position_m, np.float64))


@lru_cache(maxsize=2)
def station_room(scene: str, seed: int) -> tuple[World, RayCaster]:
    """Return a room that is furnished on all sides.

    Args:
        scene: a name in `SURROUNDINGS`.
        seed: every seed gives another room.

    Raises:
        OptionError: if the scene does not exist or the seed is negative.
        DependencyError: if `embreex` is not installed.
    """
    require_choice(scene, tuple(SURROUNDINGS), "the scene")
    require_int(seed, "the seed", least=0)
    layout = np.random.default_rng([zlib.crc32(f"{scene}/stations".encode()), seed])
    world = build_scene(scene, layout=layout, all_around=True)
    return world, RayCaster(world.triangles)


def scan_stations(
    room: tuple[World, RayCaster],
    poses: Sequence[Rigid],
    *,
    seed: int,
    step_deg: float = 0.35,
    width_deg: float = 360.0,
    noise: RangeNoise = RANGE_NOISE,
    mixed: bool = True,
) -> list[Scan]:
    """Return the scans of stations, without their poses.

    Args:
        room: the world and its caster.
        poses: `world_from_scanner` of each station.
        seed: of the noise.
        step_deg: angle between neighbouring rays.
        width_deg: extent in longitude, centred on each scanner's X axis.
        noise: of the ranges, which falls with the amplitude and so grows with incidence and distance.
        mixed: the beam has a width: at edges a range is between those of the two surfaces.
    """
    world, caster = room
    grid = dome_grid(np.radians(step_deg), width_rad=np.radians(width_deg))
    scans = []
    for k, pose in enumerate(poses):
        rng = np.random.default_rng([zlib.crc32(b"station noise"), seed, k])
        ranges, intensity = scan_around(world, caster, grid, rng=rng, noise=noise, world_from_scanner=pose)
        if mixed:
            beside = Rigid(pose.rotation @ rotation_about("z", _BEAM_RAD), pose.translation)
            other, _ = scan_around(world, caster, grid, rng=rng, noise=noise, world_from_scanner=beside)
            apart = np.abs(other - ranges) > 0.03 * ranges
            share = rng.uniform(0, 1, ranges.shape).astype(np.float32)
            ranges = np.where(apart, share * ranges + (1 - share) * other, ranges).astype(np.float32)
        scans.append(Scan(geometry=grid, ranges=ranges, intensity=intensity, name=f"station {k + 1}"))
    return scans


def with_spheres(
    scan: Scan, centers: FloatArray, radius_m: float, *, noise_m: float, mixed: bool = True, seed: int = 0
) -> Scan:
    """Return a scan with survey spheres in front of what it saw.

    Args:
        scan: the scan.
        centers: (N, 3) in the scanner's frame, m.
        radius_m: radius of all of them, m.
        noise_m: standard deviation of the ranges on the spheres, m.
        mixed: whether the ranges of cells that the rim crosses are between the sphere's and those behind it.
        seed: random seed.
    """
    rng = np.random.default_rng(seed)
    rays, ranges = scan.rays.astype(np.float64), scan.ranges.astype(np.float64)
    half = float(max(scan.geometry.step_rad)) / 2
    for center in np.asarray(centers, np.float64):
        along = rays @ center
        apart = np.linalg.norm(rays * along[..., None] - center, axis=-1)
        hit = (apart < radius_m) & (along > 0)
        front = along - np.sqrt(np.where(hit, radius_m**2 - apart**2, 0.0))
        hit &= ~(front > ranges)
        share = np.clip((radius_m - apart) / (2 * half * along.clip(1e-9)), 0.0, 1.0) if mixed else 1.0
        seen = front + rng.normal(0, noise_m, ranges.shape)
        behind = np.where(np.isfinite(ranges), ranges, seen)
        ranges = np.where(hit, share * seen + (1 - share) * behind, ranges)
    return replace(scan, ranges=ranges.astype(np.float32))


def with_plates(
    scan: Scan, centers: FloatArray, facing: FloatArray, side_m: float, *, noise_m: float, light_noise: float = 0.04,
    beam_rad: float = 5e-4, seed: int = 0,
) -> Scan:  # fmt: skip
    """Return a scan with flat survey targets in front of what it saw: four quadrants, of intensity .1 and .9.

    Args:
        scan: the scan.
        centers: (N, 3) in the scanner's frame, m.
        facing: (N, 3) rotation vectors, rad, that turn each from facing the scanner along -X with level edges.
        side_m: side of the four quadrants together, m.
        noise_m: standard deviation of the ranges on the plates, m.
        light_noise: standard deviation of the intensities.
        beam_rad: diameter of the beam, rad, at two standard deviations.
        seed: random seed.
    """
    rng = np.random.default_rng(seed)
    rays, ranges = scan.rays.astype(np.float64), scan.ranges.astype(np.float64)
    light = scan.intensity.astype(np.float64)
    spread = rng.normal(0, beam_rad / 4, (16, 3))
    spread = np.concatenate([spread, -spread])  # so that the beam is not off its axis
    for center, turn in zip(np.asarray(centers, np.float64), np.asarray(facing, np.float64), strict=True):
        axes = Rigid.from_rotvec(turn).rotation.T
        normal, across = -axes[0], axes[1:]

        def on_plate(d: FloatArray, normal: FloatArray = normal, center: FloatArray = center) -> FloatArray:
            slope = d @ normal
            return np.where(slope > 1e-6, (center @ normal) / np.where(slope > 1e-6, slope, 1.0), np.inf)

        reach = on_plate(rays) if center @ normal > 0 else on_plate(rays, -normal)
        with np.errstate(invalid="ignore"):
            at = (rays * reach[..., None] - center) @ across.T
        hit = np.isfinite(reach) & (np.abs(at) < side_m / 2).all(axis=-1) & ~(reach > ranges)
        d, brightness = rays[hit], np.zeros(int(hit.sum()))
        toward = normal if center @ normal > 0 else -normal
        for off in spread:
            beam = d + off
            place = (beam * ((center @ toward) / (beam @ toward))[:, None] - center) @ across.T
            brightness += np.where(place[:, 0] * place[:, 1] > 0, 0.9, 0.1) / len(spread)
        ranges[hit] = reach[hit] + rng.normal(0, noise_m, len(d))
        light[hit] = brightness + rng.normal(0, light_noise, len(d))
    return replace(scan, ranges=ranges.astype(np.float32), intensity=light.astype(np.float32))
