"""The simulated thermal camera: bodies of one temperature each, reflections, lens blur and sensor drift."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.simulate.photograph import SUPERSAMPLES, cast_pixels
from ladarreg_core.simulate.ray_cast import RayCaster, in_strips
from ladarreg_core.simulate.worlds.world import Viewpoint, World

THERMAL_CAMERA = Camera.from_focal(320, 240, 405.8)
"""Field of view of the colour camera on a small microbolometer."""

_AIR_K, _AIR_SPREAD_K = 294.15, 2.0
_BODY_SD_K, _BODY_LIMIT_K = 0.35, 0.9  # objects warmed by the sun, carried in, or on a cold floor
_LAPSE_K_PER_M = (0.2, 0.7)  # warm air rises
_FACING_K = (0.2, 0.5)  # a surface warms towards what it faces: the ceiling's lamps, a heated wall
_CEILING_K = 3.0  # temperature over the air that a mirror facing straight up shows
_BLUR_PX = 1.0
_NETD_K = 0.05
_DRIFT_K = 0.12  # of the sensor between calibrations, smooth across the picture


def take_thermal_image(
    world: World,
    caster: RayCaster,
    camera: Camera,
    camera_from_scanner: Rigid,
    *,
    rng: np.random.Generator,
    noise: float = 1.0,
    report: Callable[[float], None] | None = None,
) -> NDArray[np.float32]:
    """Take a thermal image of a world; prints are invisible in it.

    Args:
        world: the photographed world.
        caster: its ray caster.
        camera: the true camera.
        camera_from_scanner: its true pose.
        rng: random generator of temperatures, drift and noise.
        noise: factor on pixel noise and drift.
        report: receives the share done, 0..1.

    Returns:
        (height, width) float32 apparent temperature, K, in the linear approximation of small differences.

    Source: radiance = emissivity x own + (1 - emissivity) x reflected; the emissivity of dielectrics falls towards
    grazing incidence as Fresnel's reflection rises (Schlick 1994).
    """
    air_k = _AIR_K + float(rng.uniform(-1, 1)) * _AIR_SPREAD_K
    lapse, facing = (float(rng.uniform(*span)) for span in (_LAPSE_K_PER_M, _FACING_K))
    bearing = float(rng.uniform(0, 2 * np.pi))
    spread = rng.standard_normal(int(world.body_of_face.max()) + 1) * _BODY_SD_K
    own_k = (np.clip(spread, -_BODY_LIMIT_K, _BODY_LIMIT_K)[world.body_of_face] + world.heat[0]).astype(np.float32)
    emissivity = world.heat[1]
    wx, wy = np.float32(np.cos(bearing)), np.float32(np.sin(bearing))

    grid = cast_pixels(world, caster, camera, camera_from_scanner)
    viewpoint = Viewpoint(world, camera_from_scanner.centre)
    total = np.zeros((camera.height, camera.width), np.float32)

    def strip(part: slice) -> None:
        for k in range(len(SUPERSAMPLES)):
            faces, rays = grid.faces(k, part).ravel(), grid.directions(k, part).reshape(-1, 3)
            hit = viewpoint.meet(faces, rays)
            nx, ny, nz = hit.normals
            body = np.take(own_k, faces) + np.float32(lapse) * hit.points[2]
            body += np.float32(facing) * (nz + wx * nx + wy * ny)
            mirrored = rays[:, 2] + 2 * hit.cosine * nz  # the height of the reflected ray
            grazing = (1 - np.minimum(hit.cosine, np.float32(1))) ** 5
            e = np.take(emissivity, faces) * (1 - grazing)
            apparent = e * body + (1 - e) * np.float32(_CEILING_K) * mirrored
            total[part] += np.where(faces > 0, apparent, np.float32(0)).reshape(-1, camera.width)
        total[part] /= len(SUPERSAMPLES)

    in_strips(camera.height, strip, report)
    sharp = cv2.GaussianBlur(total, (0, 0), _BLUR_PX)
    slow = cv2.resize(rng.standard_normal((3, 4), dtype=np.float32), camera.size, interpolation=cv2.INTER_CUBIC)
    fast = rng.standard_normal(sharp.shape, dtype=np.float32)
    drift: FloatArray = np.float32(noise) * (np.float32(_DRIFT_K) * slow + np.float32(_NETD_K) * fast)
    return np.asarray(sharp + drift + np.float32(air_k), dtype=np.float32)
