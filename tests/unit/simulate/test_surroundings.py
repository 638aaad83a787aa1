"""Rooms that are furnished on all sides, and scanners of other geometries in them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")

from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, rotation_about
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.simulate import simulate_case
from ladarreg_core.simulate.ladar import Ladar, scan_world
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.terrestrial import RangeNoise, dome_grid, scan_around
from ladarreg_core.simulate.worlds.scenes import SCENES, build_scene
from ladarreg_core.simulate.worlds.surroundings import SURROUNDINGS
from ladarreg_core.simulate.worlds.world import World

STEP_RAD = np.radians(1.5)
SIDES = 8
QUIET = RangeNoise(sigma_m=0.0, resolution_m=1e-5, speckle=1e-4)


@cache
def room(scene: str, seed: int, *, all_around: bool = True) -> World:
    return build_scene(scene, layout=np.random.default_rng(seed), all_around=all_around)


def bodies_on_each_side(world: World) -> list[int]:
    """Return how many bodies are seen in each of eight equal sectors, and up to 30 degrees from the horizon."""
    longitude = (np.arange(480) + 0.5) * 2 * np.pi / 480
    latitude = np.radians(np.linspace(-30, 30, 81))[:, None]
    rays = np.stack(
        np.broadcast_arrays(
            np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)
        ),
        -1,
    )
    hit = RayCaster(world.triangles).first_hit(np.zeros(3), rays.reshape(-1, 3))
    bodies = world.body_of_face[world.face_of_triangle[hit]].reshape(81, 480)
    return [len(np.unique(part)) for part in np.split(bodies, SIDES, axis=1)]


def share_that_differs(ranges: FloatArray, image: FloatArray) -> float:
    return float(np.nanmean(np.abs(image - ranges) > 0.05))


@pytest.mark.parametrize(
    "scene",
    [pytest.param(scene, marks=[pytest.mark.long] * (scene in SCENES and scene != "people")) for scene in SURROUNDINGS],
)
@pytest.mark.slow
def test_a_room_is_closed_roomy_and_furnished_and_printed_on_every_side(scene: str) -> None:
    world, grid = room(scene, 2), dome_grid(STEP_RAD)
    ranges, intensity = scan_around(world, RayCaster(world.triangles), grid, rng=np.random.default_rng(0), noise=QUIET)
    assert np.isfinite(ranges).mean() > 0.95  # all but windows and black paint
    assert np.nanmin(ranges) > 0.7
    assert np.nanstd(intensity * ranges**2) > 0.3
    least = min(bodies_on_each_side(world))
    assert least >= (8 if scene in SCENES else 2)
    # Neither a turn about the vertical nor a reflection gives the same ranges again.
    quarter = grid.columns // 4
    turned = [np.roll(image, k * quarter, axis=1) for image in (ranges, ranges[:, ::-1]) for k in range(4)][1:]
    alike = min(share_that_differs(ranges, image) for image in turned)
    assert alike > {"corridor": 0.002, "hall": 0.05}.get(scene, 0.2)


def test_a_corridor_is_nearly_the_same_when_turned_by_half() -> None:
    world, grid = room("corridor", 2), dome_grid(STEP_RAD)
    ranges, _ = scan_around(world, RayCaster(world.triangles), grid, rng=np.random.default_rng(0), noise=QUIET)
    turned = np.roll(ranges, grid.columns // 2, axis=1)
    mirrored = turned[:, ::-1]
    assert 0.002 < min(share_that_differs(ranges, turned), share_that_differs(ranges, mirrored)) < 0.1


@pytest.mark.slow
def test_rooms_differ_by_seed_and_old_ones_are_furnished_ahead_only() -> None:
    assert not np.array_equal(room("plain", 3).triangles, room("plain", 2).triangles)
    assert min(bodies_on_each_side(room("desk", 2, all_around=False))) < 8


def test_a_scanner_of_another_geometry_elsewhere_measures_the_same_room() -> None:
    world = room("plain", 2)
    caster, pose = RayCaster(world.triangles), Rigid(rotation_about("z", 0.8), np.array([0.3, -0.2, 0.1]))
    small = Ladar(
        geometry=AzimuthElevation(80, 120, 0.008, 0.016),
        r0_m=0.5,
        dr_m=0.003,
        sigma_m=0.0,
        read_noise=0.0,
        speckle=1e-3,
    )
    images = scan_world(world, caster, rng=np.random.default_rng(0), ladar=small, world_from_scanner=pose)
    assert images.counts.shape == (80, 120)
    ranges = small.r0_m + images.counts * small.dr_m
    true, _ = scan_around(
        world, caster, small.geometry, rng=np.random.default_rng(0), noise=QUIET, world_from_scanner=pose
    )
    assert np.nanpercentile(np.abs(ranges - true), 80) < 0.003

    def floor_of(scan: FloatArray, at: Rigid) -> float:
        points = at @ (small.geometry.rays * scan[..., None])
        return float(np.nanmin(points[..., 2]))

    ahead, _ = scan_around(world, caster, small.geometry, rng=np.random.default_rng(0), noise=QUIET)
    assert floor_of(true, pose) == pytest.approx(floor_of(ahead, Rigid.identity()), abs=1e-3)


@pytest.mark.slow
def test_a_case_is_simulated_with_a_scanner_of_ones_own() -> None:
    ladar = Ladar(geometry=AzimuthElevation(40, 60, 0.01, 0.01), dr_m=0.002)
    case = simulate_case("boxes", seed=1, ladar=ladar)
    assert case.scan.shape == case.counts.shape == (40, 60)
    assert case.scan.geometry == ladar.geometry
    with pytest.raises(OptionError, match="dr_m"):
        Ladar(dr_m=0.0)
