"""What a line measures that was drawn as people draw: its ends' ranges, their spread, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ladarreg_core.picks.lines import line_on_scan
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation

SIGMA_M = 0.015
STEP_RAD = np.deg2rad(0.11)
GEOMETRY = AzimuthElevation(200, 300, STEP_RAD, STEP_RAD)
ROW, COLUMN = np.arange(200)[:, None], np.arange(300)[None, :]
Ends = Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]


def plane(depth_m: float, normal: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> np.ndarray:
    """Ranges (H, W) of a plane."""
    return depth_m / (GEOMETRY.rays @ (np.array(normal) / np.linalg.norm(normal)))


def cylinder(radius_m: float) -> np.ndarray:
    """Ranges (H, W) of an upright cylinder whose surface is 3 m ahead."""
    x, y = GEOMETRY.rays[..., 0], GEOMETRY.rays[..., 1]
    middle, squared = 3 + radius_m, x * x + y * y
    with np.errstate(invalid="ignore"):
        return (x * middle - np.sqrt((x * middle) ** 2 - squared * (middle**2 - radius_m**2))) / squared


def outcomes(true: np.ndarray, ends_of: Ends, wanted: np.ndarray, *, seeds: int) -> tuple[np.ndarray, int]:
    """The errors (N, 2) of the ends' ranges in their own sigmas, and how many lines were refused.

    Args:
        true: (H, W) ranges; NaN: no return.
        ends_of: the drawn ends, in cells.
        wanted: (H, W) ranges of the surface that is meant, everywhere.
        seeds: how many.
    """
    errors, refused = [], 0
    meant = Scan(GEOMETRY, wanted, np.ones(GEOMETRY.shape))
    for seed in range(seeds):
        rng = np.random.default_rng([seed, 5])
        scan = Scan(GEOMETRY, true + SIGMA_M * rng.normal(size=true.shape), np.ones(true.shape))
        rays = GEOMETRY.ray_at(np.array(ends_of(rng)))
        edge, exact = line_on_scan(scan, rays), line_on_scan(meant, rays)
        if edge is None:
            refused += 1
            continue
        assert exact is not None
        errors.append((edge.ranges - exact.ranges) * np.sqrt(edge.range_weights) / SIGMA_M)
    return np.array(errors).reshape(-1, 2), refused


def upright(offset_cells: float = 0.0, spread_cells: float = 0.0) -> Ends:
    """Lines drawn down the middle of the picture."""
    return lambda rng: tuple(
        np.array([row, 149.5 + offset_cells + spread_cells * rng.normal()]) for row in (30.0, 170.0)
    )  # type: ignore[return-value]


def anywhere(length_cells: float) -> Ends:
    """Lines of a length, of every direction."""

    def ends(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        a, angle = rng.uniform(95, 105, 2), rng.uniform(0, 2 * np.pi)
        return a, a + length_cells * np.array([np.cos(angle), np.sin(angle)])

    return ends


@pytest.mark.slow
@pytest.mark.parametrize(("length_cells", "slope"), [(1, 0.8), (3, 0.0), (6, 0.8), (15, 0.0), (80, 0.8)])
def test_the_ends_scatter_as_they_say(length_cells: float, slope: float) -> None:
    wall = plane(4.0, (1.0, slope, 0.0))
    errors, refused = outcomes(wall, anywhere(length_cells), wall, seeds=60)
    assert refused <= 2
    assert 0.8 < np.sqrt(np.mean(errors**2)) < 1.25


@pytest.mark.parametrize("behind", [4.5, np.nan], ids=["a wall behind", "nothing behind"])
@pytest.mark.parametrize("offset_cells", [-1.0, 0.3, 1.0])
def test_an_outline_belongs_to_the_nearer_surface(offset_cells: float, behind: float) -> None:
    near = plane(3.0)
    scene = np.where(COLUMN < 150, near, plane(4.5) if behind == 4.5 else np.nan)
    errors, refused = outcomes(scene, upright(offset_cells), near, seeds=12)
    assert refused == 0
    # Cells that both surfaces share make the reported uncertainty larger than the noise, never smaller.
    assert 0.3 < np.sqrt(np.mean(errors**2)) < 1.1
    assert abs(errors.mean()) < 4 * 1.1 / np.sqrt(errors.size)


@pytest.mark.slow
def test_outlines_drawn_by_an_unsteady_hand_are_hardly_ever_the_background() -> None:
    scene = np.where(COLUMN < 150, plane(3.0), plane(4.5))
    errors, refused = outcomes(scene, upright(spread_cells=0.6), plane(3.0), seeds=40)
    assert refused <= 3
    assert np.mean(np.abs(errors).max(axis=1) > 4) <= 0.05


HOLED = {
    "a hole": np.where((ROW >= 80) & (ROW < 140), np.nan, plane(3.0)),
    "an end in a hole": np.where(ROW >= 120, np.nan, plane(3.0)),
    "a step": np.where(ROW >= 110, plane(4.0), plane(3.0)),
    "a post in front": np.where((ROW >= 70) & (ROW < 110), plane(1.5), plane(3.0)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HOLED)
def test_a_line_reaches_over_what_interrupts_it(name: str) -> None:
    errors, refused = outcomes(HOLED[name], upright(spread_cells=1.0), plane(3.0), seeds=25)
    assert refused == 0
    assert 0.6 < np.sqrt(np.mean(errors**2)) < 1.25


@pytest.mark.parametrize("radius_m", [0.3, 1.0, 3.0])
def test_a_line_round_a_pipe_is_no_straight_edge_and_one_along_it_is(radius_m: float) -> None:
    surface = cylinder(radius_m)
    half = min(120.0, np.arcsin(0.6 * radius_m / (3 + radius_m)) / STEP_RAD)
    _, refused = outcomes(
        surface, lambda rng: (np.array([100.0, 150 - half]), np.array([103.0, 150 + half])), surface, seeds=5
    )
    assert refused == 5
    errors, refused = outcomes(surface, upright(spread_cells=0.5), surface, seeds=30)
    assert refused <= 1
    assert 0.75 < np.sqrt(np.mean(errors**2)) < 1.25


def test_nothing_is_made_of_scattered_ranges_or_of_none() -> None:
    rng = np.random.default_rng(1)
    wild = Scan(GEOMETRY, rng.uniform(1, 8, GEOMETRY.shape), np.ones(GEOMETRY.shape))
    empty = plane(3.0)
    empty[20:180] = np.nan
    hole = Scan(GEOMETRY, empty, np.ones(GEOMETRY.shape))
    for scan in (wild, hole):
        for seed in range(10):
            ends = np.array(anywhere(60)(np.random.default_rng(seed)))
            assert line_on_scan(scan, GEOMETRY.ray_at(ends)) is None


def test_both_ways_of_drawing_are_the_same_edge() -> None:
    rng = np.random.default_rng(2)
    scan = Scan(
        GEOMETRY, plane(3.0, (1, 0.5, 0.2)) + SIGMA_M * rng.normal(size=GEOMETRY.shape), np.ones(GEOMETRY.shape)
    )
    for seed in range(10):
        rays = GEOMETRY.ray_at(np.array(anywhere(70)(np.random.default_rng(seed))))
        one, other = line_on_scan(scan, rays), line_on_scan(scan, rays[::-1])
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(one.ranges, other.ranges[::-1], rtol=1e-9)
        np.testing.assert_allclose(one.range_weights, other.range_weights[::-1], rtol=1e-6)
