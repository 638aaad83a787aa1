"""The simulated LADAR: five sub-rays per cell, superposed as in an amplitude-modulated scanner."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.simulate.ray_cast import RayCaster, SampleGrid, in_strips
from ladarreg_core.simulate.worlds.world import Surface, Viewpoint, World

GEOMETRY = AzimuthElevation(rows=700, columns=1000, d_azimuth_rad=np.radians(0.055), d_elevation_rad=np.radians(0.055))
R0_M = 1.0
DR_M = 0.0022
_FULL_COUNT = 4095
MODULATION_M = (_FULL_COUNT + 1) * DR_M
"""Ambiguity interval of the phase, m."""

_SUB_RAYS = np.array(
    [[0.0, 0.0], [-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]]
)  # in units of the divergence: row, column
_SUB_WEIGHTS = np.array([2.0, 1.0, 1.0, 1.0, 1.0]) / 6
_REFERENCE_M = 2.5
_DROPOUT = 0.006
_DROPOUT_RANDOM = 0.4  # share of drop-outs that still report a random range
_INTENSITY_PER_AMPLITUDE = 2048


@dataclass(frozen=True, slots=True, kw_only=True)
class Ladar:
    """An amplitude-modulated scanner: its rays, its range counter and its noise."""

    geometry: AzimuthElevation = GEOMETRY
    """Rows, columns and angular steps; the field of view is their product."""
    r0_m: float = R0_M
    """Range at count 0."""
    dr_m: float = DR_M
    """Range of a count; 4096 of them are the ambiguity interval."""
    divergence_rad: float = float(np.radians(0.03))
    """Width of the beam."""
    sigma_m: float = 0.003
    """Standard deviation of a range, at an amplitude of .3; it grows as the amplitude's square root falls."""
    read_noise: float = 0.003
    """Standard deviation of the amplitude in the dark."""
    speckle: float = 0.06
    """Relative standard deviation of the amplitude."""

    def __post_init__(self) -> None:
        for name in ("dr_m", "speckle"):
            if not (math.isfinite(value := getattr(self, name)) and value > 0):
                raise OptionError(f"the scanner's `{name}` is {value}; it must be positive")
        for name in ("r0_m", "divergence_rad", "sigma_m", "read_noise"):
            if not (math.isfinite(value := getattr(self, name)) and value >= 0):
                raise OptionError(f"the scanner's `{name}` is {value}; it may not be negative")

    @property
    def modulation_m(self) -> float:
        """Ambiguity interval of the phase, m."""
        return (_FULL_COUNT + 1) * self.dr_m


LADAR = Ladar()
"""The scanner of the thesis, as far as it is described."""


@dataclass(frozen=True, eq=False)
class LadarImages:
    """Contents of the two registers of the instrument."""

    counts: NDArray[np.uint16]
    """(H, W): range = r0 + count dr; 0 = no return."""
    intensity: NDArray[np.uint16]
    """(H, W): 12 bits, falls with the squared range."""


def scan_world(
    world: World,
    caster: RayCaster,
    *,
    rng: np.random.Generator,
    ladar: Ladar = LADAR,
    world_from_scanner: Rigid | None = None,
    report: Callable[[float], None] | None = None,
) -> LadarImages:
    """Scan a world.

    Args:
        world: the scanned world.
        caster: its ray caster.
        rng: random generator of the noise.
        ladar: the scanner.
        world_from_scanner: where it stands; None: at the world's origin, its axes along the world's.
        report: receives the share done, 0..1.

    Returns:
        Counts and intensity on the scanner's geometry.

    Source: thesis 2.2.1; the amplitude-modulated scanner of chapter 2.2.
    """
    geometry = ladar.geometry
    rows, columns = geometry.shape
    origin = np.zeros(3) if world_from_scanner is None else world_from_scanner.translation
    steps = _SUB_RAYS * (ladar.divergence_rad / np.array(geometry.step_rad))

    def rays_at(step: FloatArray, part: slice) -> FloatArray:
        rays = _rays_at(geometry, step, part)
        return rays if world_from_scanner is None else turned(rays, world_from_scanner.rotation)

    grid = SampleGrid.cast(world, caster, origin, geometry.shape, rays_at, steps)
    viewpoint = Viewpoint(world, origin)
    amplitude = np.zeros(geometry.shape, np.float32)
    phase = np.zeros(geometry.shape, np.float32)

    def strip(part: slice) -> None:
        real = np.zeros((part.stop - part.start, columns), np.float32)
        imaginary = np.zeros_like(real)
        for k, weight in enumerate(_SUB_WEIGHTS.astype(np.float32)):
            a, r = echoes(viewpoint, grid.faces(k, part).ravel(), grid.directions(k, part).reshape(-1, 3))
            phase_rad = (r - np.float32(ladar.r0_m)) * np.float32(2 * np.pi / ladar.modulation_m)
            real += (weight * a * np.cos(phase_rad)).reshape(real.shape)
            imaginary += (weight * a * np.sin(phase_rad)).reshape(real.shape)
        amplitude[part] = np.hypot(real, imaginary)
        phase[part] = np.arctan2(imaginary, real)

    in_strips(rows, strip, report)
    return _digitise(amplitude, phase, rng, ladar)


def _rays_at(geometry: AzimuthElevation, step: FloatArray, rows: slice) -> FloatArray:
    """Return the unit rays (h, W, 3) of some rows, offset by a step (row, column) in cells."""
    row = np.arange(rows.start, rows.stop) + step[0]
    column = np.arange(geometry.columns) + step[1]
    # Azimuth and elevation separate, so one row and one column of cells determine all rays.
    across = geometry.ray_at(np.stack([np.full(len(column), (geometry.rows - 1) / 2), column], axis=-1))
    down = geometry.ray_at(np.stack([row, np.full(len(row), (geometry.columns - 1) / 2)], axis=-1))
    rays = np.empty((len(row), len(column), 3))
    rays[..., 0] = down[:, None, 0] * across[:, 0]
    rays[..., 1] = across[:, 1]
    rays[..., 2] = down[:, None, 2] * across[:, 0]
    return rays


def turned(vectors: FloatArray, R: FloatArray) -> FloatArray:
    """Return vectors (..., 3) turned by a rotation (3, 3), equal to the last bit whatever the number of threads."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.stack([R[i, 0] * x + R[i, 1] * y + R[i, 2] * z for i in range(3)], axis=-1)


def echoes(
    viewpoint: Viewpoint, faces: NDArray[np.int32], directions: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return amplitude and range (N,) of individual rays."""
    return echoes_of(viewpoint.meet(faces, directions))


def echoes_of(hit: Surface) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return amplitude and range (N,) of rays by the surface points that they hit."""
    metal, gloss, _ = hit.finish
    c = hit.cosine
    albedo = hit.texel[:, 3].astype(np.float32) / np.float32(255)
    c2 = c * c
    c4 = c2 * c2
    c6 = c4 * c2
    c12 = c6 * c6
    c48 = (c12 * c12) ** 2
    mirror = (np.float32(0.8) * metal + np.float32(0.3) * gloss) * (c48 * c12) + np.float32(0.15) * metal * c6
    with np.errstate(divide="ignore"):
        near = np.where(hit.range_m > 0, (np.float32(_REFERENCE_M) / hit.range_m) ** 2, np.float32(0))
    return (albedo * (1 - metal) * c + mirror) * near, hit.range_m


def _digitise(
    amplitude: NDArray[np.float32], phase: NDArray[np.float32], rng: np.random.Generator, ladar: Ladar
) -> LadarImages:
    shape = amplitude.shape
    looks = 1 / ladar.speckle**2
    with np.errstate(divide="ignore"):
        sigma_m = np.float32(ladar.sigma_m) / np.sqrt(amplitude / np.float32(0.3))
    noise_m = rng.standard_normal(shape, dtype=np.float32) * np.minimum(sigma_m, np.float32(1))
    range_m = np.mod(phase, np.float32(2 * np.pi)) * np.float32(ladar.modulation_m / (2 * np.pi)) + noise_m
    measured = amplitude * (rng.standard_gamma(looks, shape, dtype=np.float32) / np.float32(looks))
    measured += rng.standard_normal(shape, dtype=np.float32) * np.float32(ladar.read_noise)
    counts = np.clip(np.rint(range_m / np.float32(ladar.dr_m)), 1, _FULL_COUNT).astype(np.uint16)
    # The noise-free signal decides on a drop-out; otherwise dark paper would flicker.
    lost = amplitude < _DROPOUT
    random_range = lost & (rng.random(shape, dtype=np.float32) < _DROPOUT_RANDOM)
    counts[lost] = 0
    counts[random_range] = rng.integers(1, _FULL_COUNT + 1, int(random_range.sum())).astype(np.uint16)
    intensity = np.clip(np.rint(measured * _INTENSITY_PER_AMPLITUDE), 0, _FULL_COUNT).astype(np.uint16)
    return LadarImages(counts, intensity)
