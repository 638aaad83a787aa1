"""The simulated terrestrial scanner: one ray per cell, all around, without the cone below the tripod."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.scanner.grids import SphericalGrid
from ladarreg_core.simulate.ladar import echoes
from ladarreg_core.simulate.ray_cast import RayCaster, in_strips
from ladarreg_core.simulate.world import Viewpoint, World

_LOWEST_RAD = float(np.radians(-60.0))  # the tripod hides what is below
_SIGMA_M = 0.002  # at an amplitude of .3
_RESOLUTION_M = 0.0005
_LEAST_AMPLITUDE = 0.006
_FULL_TURN_RAD = 2 * np.pi


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
    grid: SphericalGrid,
    *,
    rng: np.random.Generator,
    speckle: float = 0.06,
    report: Callable[[float], None] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Scan a world from the scanner's own origin.

    Args:
        world: the scanned world.
        caster: its ray caster.
        grid: the directions.
        rng: random generator of the noise.
        speckle: relative standard deviation of the amplitude.
        report: receives the share done, 0..1.

    Returns:
        Ranges, m, NaN without a return, and raw intensity, both (H, W) float32.
    """
    viewpoint = Viewpoint(world, np.zeros(3))
    amplitude, ranges = np.zeros(grid.shape, np.float32), np.zeros(grid.shape, np.float32)
    columns = np.arange(grid.columns)

    def strip(part: slice) -> None:
        row, column = np.meshgrid(np.arange(part.start, part.stop), columns, indexing="ij")
        rays = grid.ray_at(np.stack([row, column], axis=-1)).reshape(-1, 3).astype(np.float32)
        triangle = caster.first_hit(np.zeros(3), rays)
        faces = np.where(triangle < 0, 0, np.take(world.face_of_triangle, triangle)).astype(np.int32)
        a, r = echoes(viewpoint, faces, rays)
        amplitude[part], ranges[part] = a.reshape(row.shape), r.reshape(row.shape)

    in_strips(grid.rows, strip, report)
    looks = 1 / speckle**2
    # Noise is drawn for the whole grid: it must not depend on the strips.
    measured = amplitude * (rng.standard_gamma(looks, grid.shape, dtype=np.float32) / np.float32(looks))
    with np.errstate(divide="ignore"):
        sigma_m = np.minimum(_SIGMA_M / np.sqrt(amplitude / np.float32(0.3)), np.float32(0.05))
    ranges += rng.standard_normal(grid.shape, dtype=np.float32) * sigma_m
    ranges = np.rint(ranges / np.float32(_RESOLUTION_M)) * np.float32(_RESOLUTION_M)
    ranges[(amplitude < _LEAST_AMPLITUDE) | (ranges <= 0)] = np.nan
    return ranges, measured
