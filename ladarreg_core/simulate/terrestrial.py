"""The simulated terrestrial scanner: one ray per cell, all around, without the cone below the tripod."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.grids import ScanGeometry, SphericalGrid
from ladarreg_core.simulate.ladar import echoes, echoes_of, turned
from ladarreg_core.simulate.ray_cast import RayCaster, in_strips
from ladarreg_core.simulate.worlds.world import Viewpoint, World, meet_from

_LOWEST_RAD = float(np.radians(-60.0))  # the tripod hides what is below
_FULL_TURN_RAD = 2 * np.pi


@dataclass(frozen=True, slots=True)
class RangeNoise:
    """What a range finder adds to the truth."""

    sigma_m: float = 0.002
    """Standard deviation of a range, at an amplitude of .3; it grows as the amplitude's square root falls."""
    most_m: float = 0.05
    """Largest standard deviation."""
    resolution_m: float = 0.0005
    """Step of the range."""
    least_amplitude: float = 0.006
    """Weaker echoes are lost."""
    speckle: float = 0.06
    """Relative standard deviation of the amplitude."""

    def measured(
        self, amplitude: NDArray[np.float32], ranges: NDArray[np.float32], rng: np.random.Generator
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return ranges, NaN without a return, and raw intensities as measured, of true amplitudes and ranges (...)."""
        looks = 1 / self.speckle**2
        measured = amplitude * (rng.standard_gamma(looks, amplitude.shape, dtype=np.float32) / np.float32(looks))
        with np.errstate(divide="ignore"):
            sigma_m = np.minimum(
                np.float32(self.sigma_m) / np.sqrt(amplitude / np.float32(0.3)), np.float32(self.most_m)
            )
        noisy = ranges + rng.standard_normal(amplitude.shape, dtype=np.float32) * sigma_m
        noisy = np.rint(noisy / np.float32(self.resolution_m)) * np.float32(self.resolution_m)
        noisy[(amplitude < self.least_amplitude) | (noisy <= 0)] = np.nan
        return noisy, measured


RANGE_NOISE = RangeNoise()
"""That of a terrestrial scanner."""


def dome_grid(step_rad: float, *, width_rad: float = _FULL_TURN_RAD) -> SphericalGrid:
    """Return the grid of a dome scan: from the zenith to 60 degrees below the horizon.

    Args:
        step_rad: angle between neighbouring rays, rad.
        width_rad: extent in longitude, centred on the scanner's X axis, rad; a full turn by default.
    """
    columns = round(width_rad / step_rad)
    step = width_rad / columns
    top = np.pi / 2 - step / 2
    rows = int((top - _LOWEST_RAD) / step) + 1
    return SphericalGrid(rows, columns, step, step, 0.0, float(top))


def scan_around(
    world: World,
    caster: RayCaster,
    grid: ScanGeometry,
    *,
    rng: np.random.Generator,
    noise: RangeNoise = RANGE_NOISE,
    world_from_scanner: Rigid | None = None,
    report: Callable[[float], None] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Scan a world, one ray a cell.

    Args:
        world: the scanned world.
        caster: its ray caster.
        grid: the directions.
        rng: random generator of the noise.
        noise: the noise.
        world_from_scanner: where the scanner stands; None: at the world's origin, its axes along the world's.
        report: receives the share done, 0..1.

    Returns:
        Ranges, m, NaN without a return, and raw intensity, both (H, W) float32.
    """
    origin = np.zeros(3) if world_from_scanner is None else world_from_scanner.translation
    viewpoint = Viewpoint(world, origin)
    rows, count = grid.shape
    amplitude, ranges = np.zeros(grid.shape, np.float32), np.zeros(grid.shape, np.float32)
    columns = np.arange(count)

    def strip(part: slice) -> None:
        row, column = np.meshgrid(np.arange(part.start, part.stop), columns, indexing="ij")
        rays: FloatArray = grid.ray_at(np.stack([row, column], axis=-1)).reshape(-1, 3)
        if world_from_scanner is not None:
            rays = turned(rays, world_from_scanner.rotation)
        directions = rays.astype(np.float32)
        triangle = caster.first_hit(origin, directions)
        faces = np.where(triangle < 0, 0, np.take(world.face_of_triangle, triangle)).astype(np.int32)
        a, r = echoes(viewpoint, faces, directions)
        amplitude[part], ranges[part] = a.reshape(row.shape), r.reshape(row.shape)

    in_strips(rows, strip, report)
    # Noise is drawn for the whole grid: it must not depend on the strips.
    return noise.measured(amplitude, ranges, rng)


def echoes_along(
    world: World, caster: RayCaster, origins: FloatArray, rays: FloatArray
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return amplitude and range (N,), without noise, of rays (N, 3) that each have an origin (N, 3) of their own, m.

    Ranges are 0 where a ray hits nothing.
    """
    directions = np.asarray(rays, dtype=np.float32)
    triangle = caster.first_hit(origins, directions)
    faces = np.where(triangle < 0, 0, np.take(world.face_of_triangle, triangle)).astype(np.int32)
    return echoes_of(meet_from(world, origins, faces, directions))
