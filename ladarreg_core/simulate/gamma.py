"""The simulated gamma camera: a few hot spots, blurred over tens of pixels, with photon-counting noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.frames import Rigid
from ladarreg_core.simulate.photograph import cast_pixels
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.worlds.world import Viewpoint, World

GAMMA_CAMERA = Camera.from_focal(320, 240, 405.8)
"""Field of view of the thermal camera, behind a coded aperture or a pinhole."""

_SPOTS = (3, 6)
_PEAK_COUNTS = (25.0, 120.0)
_SPREAD_PX = (14.0, 24.0)
_BACKGROUND_COUNTS = 2.0


@dataclass(frozen=True, eq=False)
class GammaImage:
    """Photon counts and the positions of their sources."""

    counts: ByteArray
    """(height, width) uint8 photons."""
    hot_spots_m: NDArray[np.float64]
    """(K, 3) the sources, scanner frame, m."""


def take_gamma_image(
    world: World, caster: RayCaster, camera: Camera, camera_from_scanner: Rigid, *, rng: np.random.Generator
) -> GammaImage:
    """Simulate the photon counts of sources on surfaces that the camera sees.

    Args:
        world: surfaces with the sources.
        caster: its ray caster.
        camera: the true camera.
        camera_from_scanner: its true pose.
        rng: random generator of sources and photons.

    Raises:
        DegenerateGeometryError: if the camera sees nothing of the world.
    """
    grid = cast_pixels(world, caster, camera, camera_from_scanner)
    margin = camera.height // 8
    inner = np.zeros((camera.height, camera.width), np.bool_)
    inner[margin:-margin, margin:-margin] = True
    seen = np.flatnonzero(inner & (grid.centre_faces > 0))
    count = int(rng.integers(_SPOTS[0], _SPOTS[1] + 1))
    if len(seen) < count:
        raise DegenerateGeometryError("the gamma camera sees nothing of the room; take another seed or set")
    at = rng.choice(seen, count, replace=False)
    hit = Viewpoint(world, camera_from_scanner.centre).meet(
        grid.centre_faces.ravel()[at], grid.centre_rays.reshape(-1, 3)[at]
    )
    spots = np.stack(hit.points, axis=-1).astype(np.float64)
    rate = np.full(inner.shape, _BACKGROUND_COUNTS)
    v, u = np.mgrid[: camera.height, : camera.width]
    sigma_px = float(rng.uniform(*_SPREAD_PX))  # blur of the aperture, the same for all
    for centre in camera.project(camera_from_scanner @ spots):
        squared = (u - centre[0]) ** 2 + (v - centre[1]) ** 2
        rate += float(rng.uniform(*_PEAK_COUNTS)) * np.exp(-squared / (2 * sigma_px**2))
    return GammaImage(np.minimum(rng.poisson(rate), 255).astype(np.uint8), spots)
