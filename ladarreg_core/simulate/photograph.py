"""The simulated colour camera: shadows of point lights, highlights, a lens, noise and a tone curve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import ByteArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.simulate.ray_cast import RayCaster, SampleGrid, differs_from_neighbours, in_strips
from ladarreg_core.simulate.worlds.materials import GAMMA
from ladarreg_core.simulate.worlds.world import Surface, Viewpoint, World

SUPERSAMPLES = np.array([[-0.25, -0.25], [-0.25, 0.25], [0.25, -0.25], [0.25, 0.25]])
"""Sample offsets within a pixel: v, u, px."""

_BLUR_PX = 0.6
_SHOT_NOISE = 0.012  # of full scale, at full scale
_READ_NOISE = 0.002
_SHADOW_STRIP = 32768  # rays
_FULL_AT = 0.93  # exposure of the brightest percent of the picture
_LINEAR = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)


@dataclass(frozen=True)
class Lighting:
    """Lighting of a scene."""

    ambient: float = 0.30
    """Ambient light."""
    strength: tuple[float, ...] = (0.55, 0.45)
    """Strength of each point light, at the distance of the scene; further lights are off."""
    tints: tuple[tuple[float, float, float], ...] = ((1.0, 0.96, 0.88), (0.92, 0.97, 1.0))
    """RGB of each light."""


def take_photograph(
    world: World,
    caster: RayCaster,
    camera: CameraModel,
    camera_from_scanner: Rigid,
    *,
    lighting: Lighting,
    rng: np.random.Generator,
    noise: float = 1.0,
    report: Callable[[float], None] | None = None,
) -> ByteArray:
    """Take a colour photograph of a world.

    Args:
        world: the photographed world.
        caster: its ray caster.
        camera: the true camera.
        camera_from_scanner: its true pose.
        lighting: the lighting.
        rng: random generator of the noise.
        noise: factor on the pixel noise.
        report: receives the share done, 0..1.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    grid = cast_pixels(world, caster, camera, camera_from_scanner)
    viewpoint = Viewpoint(world, camera_from_scanner.centre)
    lamps = [np.asarray(world.lights[i]) for i in range(len(lighting.strength))]
    lit = [_lit_samples(world, caster, viewpoint, grid, lamp) for lamp in lamps]
    linear = np.zeros((camera.height, camera.width, 3), np.float32)

    def strip(part: slice) -> None:
        shape = (part.stop - part.start, camera.width, 3)
        for k in range(len(SUPERSAMPLES)):
            directions = grid.directions(k, part).reshape(-1, 3)
            hit = viewpoint.meet(grid.faces(k, part).ravel(), directions)
            light = [lit[i][k][part].ravel() for i in range(len(lamps))]
            linear[part] += _shade(hit, directions, lamps, light, lighting, world.focus_m).reshape(shape)
        linear[part] /= len(SUPERSAMPLES)

    in_strips(camera.height, strip, report)
    return _develop(linear, rng, noise)


def cast_pixels(world: World, caster: RayCaster, camera: CameraModel, camera_from_scanner: Rigid) -> SampleGrid:
    """Return the face that each sample of each pixel of a camera hits.

    Args:
        world: the world.
        caster: its ray caster.
        camera: the true camera with its lens.
        camera_from_scanner: its true pose.
    """
    R = camera_from_scanner.rotation

    def rays_at(step: FloatArray, rows: slice) -> FloatArray:
        v, u = np.mgrid[rows, : camera.width].astype(np.float64)
        rays_camera = camera.unproject(np.stack([u + step[1], v + step[0]], axis=-1))
        x, y, z = np.moveaxis(np.nan_to_num(rays_camera), -1, 0)  # a pixel without a ray meets nothing and stays black
        rays = np.empty((*u.shape, 3))
        for i in range(3):
            # Written out, since the last bit of a matrix product may depend on the number of threads.
            rays[..., i] = R[0, i] * x + R[1, i] * y + R[2, i] * z
        return rays

    centre = camera_from_scanner.centre
    return SampleGrid.cast(world, caster, centre, (camera.height, camera.width), rays_at, SUPERSAMPLES)


def _lit_samples(
    world: World,
    caster: RayCaster,
    viewpoint: Viewpoint,
    grid: SampleGrid,
    lamp: NDArray[np.float64],
) -> list[NDArray[np.bool_]]:
    """Return the pixels (H, W) lit by a lamp, for each supersample; supersamples are cast only along edges and
    shadows."""
    shape = grid.centre_faces.shape

    def reached(faces: NDArray[np.int32], rays: NDArray[np.float32]) -> NDArray[np.bool_]:
        starts = np.empty((len(faces), 3), np.float32)
        facing = np.empty(len(faces), np.bool_)

        def strip(part: slice) -> None:
            starts[part], facing[part] = viewpoint.towards_lamp(faces[part], rays[part], lamp)

        in_strips(len(faces), strip, step=_SHADOW_STRIP)
        out = np.zeros(len(faces), np.bool_)
        where = np.flatnonzero(facing)
        out[where] = caster.sees(starts[where], lamp)
        return out

    centre = reached(grid.centre_faces.ravel(), grid.centre_rays.reshape(-1, 3)).reshape(shape)
    again = np.flatnonzero(grid.mixed | differs_from_neighbours(centre))
    every = slice(0, shape[0])
    out = []
    for k in range(len(SUPERSAMPLES)):
        sample = centre.copy()
        faces, rays = grid.faces(k, every).reshape(-1)[again], grid.directions(k, every).reshape(-1, 3)[again]
        sample.reshape(-1)[again] = reached(faces, rays)
        out.append(sample)
    return out


def _shade(
    hit: Surface,
    directions: NDArray[np.float32],
    lamps: list[NDArray[np.float64]],
    lit: list[NDArray[np.bool_]],
    lighting: Lighting,
    focus_m: float,
) -> NDArray[np.float32]:
    """Return linear colours (N, 3). Source: Blinn 1977 for the highlights."""
    metal, gloss, glow = hit.finish
    albedo = _LINEAR[hit.texel[:, :3]]
    nx, ny, nz = hit.normals
    # Surfaces that face up see the ceiling, those that face down the floor.
    base = np.float32(lighting.ambient) * (np.float32(0.85) + np.float32(0.25) * nz) + glow
    light = np.repeat(base[:, None], 3, axis=1)
    shine = np.zeros_like(light)
    for lamp, reached, strength, tint in zip(lamps, lit, lighting.strength, lighting.tints, strict=False):
        lx, ly, lz = (np.float32(lamp[i]) - hit.points[i] for i in range(3))
        squared = lx * lx + ly * ly + lz * lz + np.float32(1e-6)
        inverse = 1 / np.sqrt(squared)
        facing = np.maximum((nx * lx + ny * ly + nz * lz) * inverse, 0)
        reach = np.minimum(np.float32((0.6 * focus_m) ** 2) / squared, np.float32(2.0)) * np.float32(strength) * reached
        hx, hy, hz = (a * inverse - directions[:, i] for i, a in enumerate((lx, ly, lz)))
        half = np.maximum((nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz + np.float32(1e-6)), 0)
        h4 = (half * half) ** 2
        h16 = (h4 * h4) ** 2
        highlight = h16 * h16 * h16 * (np.float32(0.6) * gloss + metal) * reach
        color = np.asarray(tint, dtype=np.float32)
        light += (facing * reach)[:, None] * color
        shine += highlight[:, None] * color
    return np.asarray(albedo * light * (1 - np.float32(0.5) * metal[:, None]) + shine * np.float32(0.5), np.float32)


def _develop(linear: NDArray[np.float32], rng: np.random.Generator, noise: float) -> ByteArray:
    """Return the developed picture (H, W, 3) of an exposed sensor."""
    bright = float(np.percentile(linear.max(axis=-1), 99.0))
    blurred = cv2.GaussianBlur(linear * np.float32(_FULL_AT / max(bright, 1e-6)), (0, 0), _BLUR_PX)
    sigma = np.sqrt(np.maximum(blurred, 0) * np.float32(_SHOT_NOISE**2) + np.float32(_READ_NOISE**2))
    exposed = blurred + rng.standard_normal(blurred.shape, dtype=np.float32) * sigma * np.float32(noise)
    return np.asarray(np.rint(255 * np.clip(exposed, 0, 1) ** np.float32(1 / GAMMA)), dtype=np.uint8)
