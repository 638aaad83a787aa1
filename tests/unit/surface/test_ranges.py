"""A range's quality against its error: half the quality is twice the variance, on scans with known truth."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation, range_from_counts
from ladarreg_core.surface.ranges import range_quality, surface_range

STEP_RAD = np.deg2rad(0.11)
GEOMETRY = AzimuthElevation(150, 240, STEP_RAD, STEP_RAD)


def normalised_variances(error: np.ndarray, quality: np.ndarray, bins: int) -> np.ndarray:
    """The mean of error^2 times quality in bins of equal number, over that of all."""
    order = np.argsort(quality)
    parts = np.array([np.mean(error[k] ** 2 * quality[k]) for k in np.array_split(order, bins)])
    return np.asarray(parts / parts.mean())


@pytest.mark.parametrize("noise_m", [0.003, 0.015])
@pytest.mark.parametrize("kind", ["raw", "range_normalised"])
def test_the_variance_goes_with_the_missing_light(noise_m: float, kind: str) -> None:
    rng = np.random.default_rng(3)
    light = 10 ** rng.uniform(-1.0, 0.5, GEOMETRY.shape)
    light /= np.median(light)
    true = 4 / GEOMETRY.rays[..., 0]
    scan = Scan(
        GEOMETRY,
        true + rng.normal(size=true.shape) * noise_m / np.sqrt(light),
        light if kind == "raw" else light * true**2,
        intensity_is=kind,  # type: ignore[arg-type]
    )
    quality = range_quality(scan, GEOMETRY.rays.reshape(-1, 3))
    parts = normalised_variances((scan.ranges - true).ravel(), quality, 6)
    assert parts.min() > 0.75
    assert parts.max() < 1.35
    assert quality.max() / quality.min() > 15


@pytest.mark.parametrize("slope", [0.0, 1.0, 3.0, 8.0])
def test_rays_beside_their_cells_are_as_far_off_as_the_slope_makes_them(slope: float) -> None:
    rng = np.random.default_rng(5)
    noise_m = 0.005
    normal = np.array([1.0, slope, 0.0]) / np.hypot(1, slope)
    with np.errstate(divide="ignore"):
        true = np.where(GEOMETRY.rays @ normal > 0.02, 1.5 / (GEOMETRY.rays @ normal), np.nan)
    true = np.where(true < 8, true, np.nan)
    scan = Scan(GEOMETRY, true + rng.normal(size=true.shape) * noise_m, np.ones(true.shape))
    cells = rng.integers([3, 3], [147, 237], (4000, 2)).astype(float)
    meant = GEOMETRY.ray_at(cells)
    met = surface_range(scan, GEOMETRY.ray_at(cells + 0.3 * rng.normal(size=cells.shape)))
    exact = 1.5 / (meant @ normal)
    known = np.isfinite(met)
    told = noise_m / np.sqrt(range_quality(scan, meant))[known]
    error = (met - exact)[known]
    assert np.count_nonzero(known) > 1000
    # interpolation averages a cell's noise, down to two thirds, and a slope is what neighbours agree on at least
    assert 0.6 < np.sqrt(np.mean((error / told) ** 2)) < 1.4


def test_what_is_near_an_edge_or_a_hole_is_worth_less() -> None:
    true = np.where(np.arange(240) < 120, 3.0, 4.0) * np.ones(GEOMETRY.shape)
    true[50:60, 30:40] = np.nan
    scan = Scan(GEOMETRY, true, np.ones(GEOMETRY.shape))
    here = GEOMETRY.ray_at(np.array([[100.0, 119.0], [100.0, 118.0], [48.0, 35.0], [100.0, 60.0], [20.0, 200.0]]))
    np.testing.assert_allclose(range_quality(scan, here), [0.25, 0.25, 0.25, 1, 1])


def test_no_light_no_noise_and_rays_outside_give_numbers_all_the_same() -> None:
    flat = Scan(GEOMETRY, np.full(GEOMETRY.shape, 3.0), np.zeros(GEOMETRY.shape))
    lonely = np.full(GEOMETRY.shape, np.nan)
    lonely[70, 100] = 2.0
    rays = np.concatenate([GEOMETRY.rays[::50, ::60].reshape(-1, 3), [[-1.0, 0, 0], [0, 0, 1.0]]])
    for scan in (flat, Scan(GEOMETRY, lonely, np.ones(GEOMETRY.shape))):
        quality = range_quality(scan, rays)
        assert np.isfinite(quality).all()
        assert (quality > 0).all()
        assert (quality <= 4).all()


def test_the_simulated_scanner_errs_as_its_ranges_are_rated() -> None:
    pytest.importorskip("embreex")
    from ladarreg_core.simulate.ladar import DR_M, GEOMETRY, R0_M, scan_world
    from ladarreg_core.simulate.ray_cast import RayCaster
    from ladarreg_core.simulate.worlds.scenes import build_scene
    from ladarreg_core.simulate.worlds.world import Viewpoint

    layout, noise = (np.random.default_rng([zlib.crc32(b"quality"), k]) for k in (0, 1))
    world = build_scene("desk", layout=layout, independent_inks=False)
    caster = RayCaster(world.triangles)
    images = scan_world(world, caster, rng=noise)
    scan = Scan(GEOMETRY, range_from_counts(images.counts, R0_M, DR_M), images.intensity.astype(float))
    rays = GEOMETRY.ray_at(np.random.default_rng(2).uniform([2, 2], np.array(scan.shape) - 3, (20_000, 2)))
    triangles = caster.first_hit(np.zeros(3), rays)
    rays, triangles = rays[triangles >= 0], triangles[triangles >= 0]
    met = Viewpoint(world, np.zeros(3)).meet(world.face_of_triangle[triangles], rays.astype(np.float32))
    error = surface_range(scan, rays) - met.range_m
    known = np.abs(error) < 0.04  # what was mixed from two surfaces is a mismatch, and no noise
    error, quality = error[known], range_quality(scan, rays[known])
    parts = normalised_variances(error, quality, 6)
    assert parts.min() > 0.6
    assert parts.max() < 1.6
    rms = np.sqrt([np.mean(e**2) for e in np.array_split(error[np.argsort(quality)], 6)])
    assert rms[0] > 2 * rms[-1]  # the worst sixth and the best
    assert (np.diff(rms) < 0.1 * rms[0]).all()
