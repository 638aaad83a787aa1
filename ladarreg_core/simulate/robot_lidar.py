"""Lidars of robots and cars: petals that never repeat, and spinning lines, with the noise of their beams."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.validation import require_choice
from ladarreg_core.frames import Rigid
from ladarreg_core.simulate.ladar import echoes, turned
from ladarreg_core.simulate.ray_cast import RayCaster, in_strips
from ladarreg_core.simulate.worlds.world import Viewpoint, World

LidarName = Literal["petals", "narrow", "64 lines", "128 lines", "40 lines", "dome"]
"""The lidars that are simulated."""

_STRIP_RAYS = 65_536
_REFERENCE_M = 2.5  # range at which a simulated echo has its albedo as amplitude
_FULL_SCALE = 255
_FULL_REFLECTIVITY = 0.9
_DOME_DEG = np.linspace(-30.0, 60.0, 43)  # elevations of the lines
_CAR_DEG = np.concatenate(
    [[-25.0, -19.0, -14.0, -11.0, -9.0, -8.0, -7.0], np.linspace(-6.0, 2.0, 25), np.arange(3.0, 11.0)]
)


@dataclass(frozen=True, slots=True)
class BeamNoise:
    """What a lidar's beam adds to the truth."""

    sigma_m: float = 0.02
    """Standard deviation of a range."""
    footprint_rad: float = float(np.radians(0.06))
    """Standard deviation of the direction that is met about the direction that is reported."""
    farthest_m: float = 120.0
    """Range at which a surface of `least_reflectivity` is just seen."""
    least_reflectivity: float = 0.08
    speckle: float = 0.08
    """Relative standard deviation of the reflectivity."""


BEAM_NOISE = BeamNoise()
"""That of a lidar of a robot."""


@dataclass(frozen=True, eq=False)
class LidarPoints:
    """Returns of a lidar, in its own frame."""

    points: NDArray[np.float64]
    """(N, 3) m."""
    intensity: NDArray[np.float32]
    """(N,) reflectivity, 0 to 255; all 0 if the lidar reports none."""
    rays: int
    """Rays that were sent."""


def lidar_rays(lidar: str, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the unit rays (N, 3) of a lidar in the order in which it sends them; the seed turns and spaces them.

    `petals` fills a cone of 70 degrees about the X axis and `narrow` one of 38. Lines go all around: 64 and 128 of
    them are unevenly spaced for half of the seeds, densest at the horizon; 40 are those of a car's lidar, a third of a
    degree apart at the horizon and up to five elsewhere; those of a dome are even, ten times as far apart as the
    returns along them.

    Args:
        lidar: of `LidarName`.
        rng: random generator.

    Raises:
        OptionError: if there is no such lidar.
    """
    require_choice(lidar, get_args(LidarName), "the lidar")
    if lidar in ("petals", "narrow"):
        return _petals(*((70.4, 300_000) if lidar == "petals" else (38.4, 200_000)), rng)
    if lidar == "dome":
        return _turn(_DOME_DEG, 1800, rng)
    if lidar == "40 lines":
        return _turn(_CAR_DEG + rng.uniform(-1, 1), 1800, rng)
    return _lines(int(lidar.split()[0]), rng)


def _petals(cone_deg: float, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the rosette of two prisms that turn against each other at incommensurable speeds."""
    t = np.arange(count) / 100_000.0  # s
    first, second = 2 * np.pi * (7294 / 60) * t, -2 * np.pi * (4664.0 + rng.uniform(-20, 20)) / 60 * t
    start = rng.uniform(0, 2 * np.pi, 2)
    bend = np.exp(1j * (first + start[0])) + np.exp(1j * (second + start[1]))
    polar, around = np.abs(bend) / 2 * np.radians(cone_deg / 2), np.angle(bend)
    return np.stack([np.cos(polar), np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around)], axis=-1)


def _lines(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    place = np.linspace(-1, 1, count)
    if rng.random() < 0.5:
        place = 0.35 * place + 0.65 * place**3
    return _turn(rng.uniform(-6, 0) + 22.0 * place, 2048, rng)


def _turn(elevation_deg: FloatArray, columns: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the rays of one turn, column by column, of lines that are sorted upwards."""
    elevation = np.radians(elevation_deg)[::-1]
    azimuth = np.pi - 2 * np.pi * (np.arange(columns) + rng.uniform(0, 1)) / columns
    across = azimuth[:, None] + 0 * elevation
    up = np.broadcast_to(elevation, across.shape)
    return np.stack([np.cos(up) * np.cos(across), np.cos(up) * np.sin(across), np.sin(up)], axis=-1).reshape(-1, 3)


def scan_points(
    world: World,
    caster: RayCaster,
    rays: FloatArray,
    *,
    rng: np.random.Generator,
    noise: BeamNoise = BEAM_NOISE,
    with_intensity: bool = True,
    world_from_scanner: Rigid | None = None,
) -> LidarPoints:
    """Send rays into a world.

    Args:
        world: the world.
        caster: its ray caster.
        rays: (N, 3) unit, scanner frame.
        rng: random generator of the noise.
        noise: the noise.
        with_intensity: whether the lidar reports reflectivities.
        world_from_scanner: where it stands; None: at the world's origin, its axes along the world's.
    """
    origin = np.zeros(3) if world_from_scanner is None else world_from_scanner.translation
    met: FloatArray = rays + rng.standard_normal(rays.shape) * noise.footprint_rad
    met /= np.sqrt(np.einsum("ij,ij->i", met, met))[:, None]
    if world_from_scanner is not None:
        met = turned(met, world_from_scanner.rotation)
    directions = met.astype(np.float32)
    viewpoint = Viewpoint(world, origin)
    amplitude, ranges = np.zeros(len(rays), np.float32), np.zeros(len(rays), np.float32)

    def strip(part: slice) -> None:
        triangle = caster.first_hit(origin, directions[part])
        faces = np.where(triangle < 0, 0, np.take(world.face_of_triangle, triangle)).astype(np.int32)
        amplitude[part], ranges[part] = echoes(viewpoint, faces, directions[part])

    in_strips(len(rays), strip, step=_STRIP_RAYS)
    reflectivity = amplitude * (ranges / np.float32(_REFERENCE_M)) ** 2
    seen = (ranges > 0) & (reflectivity > noise.least_reflectivity * (ranges / noise.farthest_m) ** 2)
    seen &= ranges <= noise.farthest_m
    noisy = ranges + rng.standard_normal(len(rays)) * noise.sigma_m
    gain = 1 + rng.standard_normal(len(rays)) * noise.speckle
    seen &= noisy > 0.3
    strength = np.clip(np.rint(reflectivity * gain * (_FULL_SCALE / _FULL_REFLECTIVITY)), 0, _FULL_SCALE)[seen]
    points = np.asarray(rays, np.float64)[seen] * noisy[seen, None]
    intensity = (strength if with_intensity else np.zeros(len(strength))).astype(np.float32)
    return LidarPoints(points, intensity, len(rays))
