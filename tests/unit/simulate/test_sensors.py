"""The two instruments, on worlds whose image is known analytically."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, ThesisParameters

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")

from ladarreg_core.simulate import ladar, photograph
from ladarreg_core.simulate.ray_cast import RayCaster, SampleGrid, differs_from_neighbours
from ladarreg_core.simulate.worlds.scenes import build_scene
from ladarreg_core.simulate.worlds.world import Placement, Texture, Viewpoint, World, WorldBuilder

DARK = photograph.Lighting(ambient=1.0, strength=(), tints=())


def sheet(value: int, laser: int | None = None) -> Texture:
    return Texture(np.full((8, 8, 4), (value, value, value, value if laser is None else laser), np.uint8))


def wall(builder: WorldBuilder, x_m: float, texture: Texture, *, y_m: tuple[float, float] = (-6, 6)) -> None:
    right, left = y_m
    builder.quad((x_m, left, 5), (0, right - left, 0), (0, 0, -10), texture)


def finished(builder: WorldBuilder) -> tuple[World, RayCaster]:
    world = builder.finish(focus_m=4.0, lights=[(0, 0, 2), (1, 1, 2)])
    return world, RayCaster(world.triangles)


def dotted_wall() -> tuple[World, RayCaster, NDArray[np.float64]]:
    """A bright wall with dark dots, and the dots' exact centres."""
    builder = WorldBuilder()
    wall(builder, 5.0, sheet(200))
    picture = np.full((1200, 1800, 4), 200, np.uint8)
    y, x = np.mgrid[:1200, :1800]
    centres = []
    for cy, cx in itertools.product((151.3, 600.8, 1040.1), (202.6, 611.0, 1190.4, 1600.9)):
        dot = (y - cy) ** 2 + (x - cx) ** 2 < 22**2
        picture[dot] = 20
        centres.append([(x[dot].mean() + 0.5) / 1800, (y[dot].mean() + 0.5) / 1200])
    top_left, right, down = np.array([3.9, 1.5, 1.0]), np.array([0.4, -3.0, 0.1]), np.array([-0.1, 0.0, -2.0])
    builder.quad(top_left, right, down, Texture(picture))
    fraction = np.array(centres)
    world, caster = finished(builder)
    return world, caster, top_left + fraction[:, :1] * right + fraction[:, 1:] * down


def dark_centroid(image: NDArray[np.float64], near: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Return the (column, row) centroid of the darkness around a place."""
    c, r = (round(float(v)) for v in near)
    part = image[r - reach : r + reach + 1, c - reach : c + reach + 1]
    weight = np.clip(0.9 * np.median(part[0]) - part, 0, None)
    row, column = np.mgrid[r - reach : r + reach + 1, c - reach : c + reach + 1]
    return np.array([(column * weight).sum(), (row * weight).sum()]) / weight.sum()


@pytest.mark.parametrize("k1", [0.0, -0.2])
def test_a_point_is_photographed_where_the_camera_projects_it(k1: float) -> None:
    world, caster, points = dotted_wall()
    camera = Camera(600, 400, 700.0, 690.0, 310.3, 190.8, distortion=(k1, 0, 0, 0))
    pose = ThesisParameters(Tx=0.5, Ty=-0.1, Tz=0.1, alpha=0.1, beta=0.03, gamma=0.2).pose
    pixels = photograph.take_photograph(
        world, caster, camera, pose, lighting=DARK, rng=np.random.default_rng(0), noise=0.0
    )
    linear = (pixels[..., 1] / 255.0) ** 2.2
    uv = camera.project(pose @ points)
    inside = camera.contains(uv, border=14)
    assert inside.sum() >= 8
    found = np.array([dark_centroid(linear, p, 11) for p in uv[inside]])
    assert np.abs(found - uv[inside]).max() < 0.05


@pytest.mark.slow
def test_a_point_is_scanned_in_the_cell_of_its_direction() -> None:
    world, caster, points = dotted_wall()
    images = ladar.scan_world(world, caster, rng=np.random.default_rng(0), ladar=ladar.Ladar(speckle=0.01))
    cells = ladar.GEOMETRY.cell_of(points)
    normal = np.cross([-0.1, 0.0, -2.0], [0.4, -3.0, 0.1])
    cosine = -(ladar.GEOMETRY.rays @ normal) / np.linalg.norm(normal)
    distance = -(points[0] @ normal) / np.linalg.norm(normal) / cosine
    albedo = images.intensity / cosine * distance**2
    found = np.array([dark_centroid(albedo, c[::-1], 12)[::-1] for c in cells])
    # Five sub-rays sample a dot's edge coarsely: single dots scatter, all together must not.
    assert np.abs(found - cells).max() < 0.2
    assert np.abs((found - cells).mean(axis=0)).max() < 0.025
    at = tuple(np.rint(cells).astype(int).T)
    ranges = ladar.R0_M + images.counts[at] * ladar.DR_M
    assert np.abs(ranges - np.linalg.norm(points, axis=-1)).max() < 0.05


def test_amplitude_range_and_noise_follow_the_law() -> None:
    builder = WorldBuilder()
    builder.quad((3.0, 4.0, 5), (2.0, -8.0, 0), (0, 0, -10), sheet(120, 153))
    world, caster = finished(builder)
    images = ladar.scan_world(world, caster, rng=np.random.default_rng(1))
    part = np.s_[300:400, 450:550]
    ray = ladar.GEOMETRY.rays[part]
    normal = np.array([8.0, 2.0, 0]) / np.hypot(8, 2)
    distance = (normal @ [3.0, 4.0, 0]) / (ray @ normal)
    amplitude = 0.6 * (ray @ normal) * (2.5 / distance) ** 2
    ratio = images.intensity[part] / 2048 / amplitude
    assert ratio.mean() == pytest.approx(1, abs=0.005)
    assert ratio.std() == pytest.approx(np.hypot(0.06, 0.003 / amplitude.mean()), rel=0.05)
    error = ladar.R0_M + images.counts[part] * ladar.DR_M - distance
    assert abs(error.mean()) < 2e-4
    expected = np.hypot(0.003 / np.sqrt(amplitude.mean() / 0.3), ladar.DR_M / np.sqrt(12))
    assert error.std() == pytest.approx(expected, rel=0.05)


def test_cells_on_an_edge_report_a_range_in_between() -> None:
    builder = WorldBuilder()
    wall(builder, 5.0, sheet(200))
    wall(builder, 3.0, sheet(200), y_m=(-0.0018, 1))
    world, caster = finished(builder)
    images = ladar.scan_world(world, caster, rng=np.random.default_rng(2))
    ranges = ladar.R0_M + images.counts[345:355] * ladar.DR_M
    edge = ranges[:, 498:502]
    between = (edge > 3.05) & (edge < 4.95)
    assert between.any(axis=1).all()
    assert (between.sum(axis=1) == 1).all()
    assert np.abs(ranges[:, 450:498] - 3).max() < 0.05
    assert np.abs(ranges[:, 503:550] - 5).max() < 0.05


def test_what_is_too_dark_drops_out_to_nothing_or_anything() -> None:
    builder = WorldBuilder()
    wall(builder, 5.0, sheet(60, 4))
    world, caster = finished(builder)
    counts = ladar.scan_world(world, caster, rng=np.random.default_rng(3)).counts
    assert (counts == 0).mean() == pytest.approx(0.6, abs=0.01)
    wild = counts[counts > 0]
    assert wild.min() < 20
    assert wild.max() > 4075


def test_rays_that_leave_the_world_return_nothing() -> None:
    builder = WorldBuilder()
    wall(builder, 5.0, sheet(200), y_m=(0, 6))
    world, caster = finished(builder)
    images = ladar.scan_world(world, caster, rng=np.random.default_rng(4))
    away = ladar.GEOMETRY.rays[..., 1] < -0.01
    assert set(np.unique(images.intensity[away])) <= set(range(40))
    assert (images.counts[away] == 0).mean() > 0.5


def test_a_lamp_throws_a_shadow_where_geometry_says() -> None:
    builder = WorldBuilder()
    wall(builder, 4.0, sheet(128))
    builder.quad((2.0, 0.2, 0.2), (0, -0.4, 0), (0, 0, -0.4), sheet(128))
    world = builder.finish(focus_m=4.0, lights=[(0.0, 1.0, 0.0)])
    camera = Camera.from_focal(600, 400, 500)
    pose = Rigid(CAMERA_AXES_FROM_SCANNER, np.zeros(3))
    pixels = photograph.take_photograph(
        world,
        RayCaster(world.triangles),
        camera,
        pose,
        lighting=photograph.Lighting(ambient=0.1, strength=(1.0,), tints=((1, 1, 1),)),
        rng=np.random.default_rng(0),
        noise=0.0,
    )
    # From the lamp at y = 1 the plate's edges at 2 m land on the wall at y = 1 + 2 (y_edge - 1).
    inside = camera.project(pose @ np.array([[4, -1.3, 0.0], [4, -0.7, 0.0], [4, -1.0, 0.35]]))
    outside = camera.project(pose @ np.array([[4, -1.5, 0.0], [4, -1.0, 0.5], [4, -1.0, -0.5]]))
    dark = [int(pixels[round(v), round(u), 1]) for u, v in inside]
    light = [int(pixels[round(v), round(u), 1]) for u, v in outside]
    assert max(dark) * 1.5 < min(light)


def test_prints_are_not_mirrored_on_any_side() -> None:
    half = np.full((16, 64, 4), 250, np.uint8)
    half[:, :32] = 10  # the left half, as one reads it
    texture = Texture(half)
    for name, yaw in (("front", 0.0), ("left", np.pi / 2), ("right", -np.pi / 2), ("back", np.pi), ("lathe", 0.0)):
        builder = WorldBuilder()
        if name == "lathe":
            builder.lathe((3, 0, -1), (3, 0, 1), [(0, 0.5), (2, 0.5)], texture)
        else:
            builder.box(Placement(3, 0, -1, yaw), (1, 1, 2), sheet(128), **{name: texture})
        world, caster = finished(builder)
        rays = np.array([[3, y, 0.0] for y in (0.3, 0.1, -0.1, -0.3)], dtype=np.float32)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        faces = world.face_of_triangle[caster.first_hit(np.zeros(3), rays)]
        seen = Viewpoint(world, np.zeros(3)).meet(faces, rays).texel[:, 0]
        assert seen.tolist() == [10, 10, 250, 250], name


def test_curved_things_have_the_normals_of_curved_things() -> None:
    builder = WorldBuilder()
    centre, radius = np.array([3.0, 0.2, 0.1]), 0.4
    polar = np.linspace(-np.pi / 2, np.pi / 2, 15)
    profile = [(radius * (1 + np.sin(p)), radius * np.cos(p)) for p in polar]
    up = np.array([0, 0, radius])
    builder.lathe(centre - up, centre + up, profile, sheet(100))
    world, caster = finished(builder)
    rng = np.random.default_rng(5)
    rays = (centre + rng.uniform(-0.25, 0.25, (400, 3))).astype(np.float32)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    hit = Viewpoint(world, np.zeros(3)).meet(world.face_of_triangle[caster.first_hit(np.zeros(3), rays)], rays)
    radial = (np.stack(hit.points, axis=-1) - centre) / radius
    radial /= np.linalg.norm(radial, axis=-1, keepdims=True)
    cosine = np.sum(radial * np.stack(hit.normals, axis=-1), axis=-1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 3


@given(arrays(np.int32, st.tuples(st.integers(2, 7), st.integers(2, 7)), elements=st.integers(0, 2)))
def test_a_mixed_neighbourhood_is_any_difference_within_three_by_three(values: NDArray[np.int32]) -> None:
    h, w = values.shape
    for i, j in np.ndindex(h, w):
        part = values[max(0, i - 1) : i + 2, max(0, j - 1) : j + 2]
        assert differs_from_neighbours(values)[i, j] == (part != values[i, j]).any()


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 2**31))
@pytest.mark.slow
def test_casting_only_where_it_matters_changes_next_to_nothing(seed: int) -> None:
    world = build_scene("desk", layout=np.random.default_rng(seed))
    caster = RayCaster(world.triangles)
    camera = Camera.from_focal(300, 200, 300)
    steps = np.array([[0.0, 0.0], [-0.3, 0.2]])

    def rays_at(step: NDArray[np.float64], rows: slice) -> NDArray[np.float64]:
        v, u = np.mgrid[rows, :300]
        return camera.unproject(np.stack([u + step[1], v + step[0]], axis=-1)) @ CAMERA_AXES_FROM_SCANNER

    grid = SampleGrid.cast(world, caster, np.zeros(3), (200, 300), rays_at, steps)
    every = slice(0, 200)
    truth = world.face_of_triangle[caster.first_hit(np.zeros(3), rays_at(steps[1], every).reshape(-1, 3))]
    assert (grid.faces(1, every).ravel() != truth).mean() < 5e-4
    assert 0.005 < grid.mixed.mean() < 0.5
