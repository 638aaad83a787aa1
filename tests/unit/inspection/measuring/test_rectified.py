"""Rectified views against painted walls and pipes whose every mark is known."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

import ladarreg_core as lr
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.frames import Rigid, look_along, rotation_from_rotvec
from ladarreg_core.inspection.measuring.rectified import NO_PHOTO, RectifiedView
from ladarreg_core.inspection.measuring.section import simplified
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation, SphericalGrid

WALL = lr.Plane.facing((3.0, 0.2, 0.1), rotation_from_rotvec((0, 0.1, 0.5)) @ np.array([-1.0, 0, 0]))
POSE = Rigid.from_centre(look_along(WALL.origin - (0.2, -0.7, 0.2)), (0.2, -0.7, 0.2))
CAMERA = lr.Camera(640, 500, 570.0, 573.0, 313.0, 246.0, (-0.15, 0.03, 0.001, -0.001))
GRID = AzimuthElevation(200, 260, 0.004, 0.004)
SPACING, DOT = 0.2, 0.04  # m
COVARIANCE = np.diag([1e-6, 2e-6, 1e-6, 9e-6, 9e-6, 9e-6])
MM = 4.0


def dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Gray values of a wall with dark dots on a square grid, (...,) of flat coordinates, m."""
    away = np.hypot(a - SPACING * np.rint(a / SPACING), b - SPACING * np.rint(b / SPACING))
    return np.asarray(230 - 200 * np.clip((DOT - away) / 0.004 + 0.5, 0, 1))


def painted(surface: lr.Plane | lr.Cylinder, pose: Rigid, camera: lr.Camera = CAMERA) -> lr.Photo:
    """The photograph of a dotted surface alone."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.unproject(np.stack([u, v], axis=-1).astype(float)) @ pose.rotation
    flat = surface.flattened(met(surface, pose.centre, rays))
    gray = np.nan_to_num(dots(flat[..., 0], flat[..., 1])).astype(np.uint8)
    return lr.Photo(np.repeat(gray[..., None], 3, axis=-1), camera, name="wall.png")


def met(surface: lr.Plane | lr.Cylinder, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return where rays (..., 3) meet a surface first; NaN: nowhere."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if isinstance(surface, lr.Plane):
            depth = ((surface.origin - origin) @ surface.normal) / (rays @ surface.normal)
        else:
            across = rays - (rays @ surface.axis)[..., None] * surface.axis
            apart = origin - surface.origin
            apart = apart - (apart @ surface.axis) * surface.axis
            a, b, c = (across**2).sum(axis=-1), across @ apart, apart @ apart - surface.radius_m**2
            depth = (-b - np.sqrt(b * b - a * c)) / a
        return np.where((depth > 0)[..., None], origin + depth[..., None] * rays, np.nan)


def scanned(surface: lr.Plane | lr.Cylinder, noise_m: float = 0.002, seed: int = 0) -> Scan:
    ranges = np.linalg.norm(met(surface, np.zeros(3), GRID.rays.astype(float)), axis=-1)
    ranges = ranges + np.random.default_rng(seed).normal(0, noise_m, ranges.shape)
    return Scan(GRID, ranges, np.full(ranges.shape, 100.0))


def registered(scan: Scan, photo: lr.Photo, pose: Rigid, *, accepted: bool = True) -> RegisteredScan:
    found = lr.given_pose(scan, photo, pose, check_images=False)
    if accepted:
        found = replace(found, covariance=COVARIANCE, accepted=True, evidence="image")
    return RegisteredScan(scan, [RegisteredPhoto("wall", photo, found)])


@cache
def wall_view() -> RectifiedView:
    return lr.rectify(registered(scanned(WALL, 0.0005), painted(WALL, POSE), POSE), WALL, mm_per_pixel=MM)


def dots_found(gray: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the centres (N, 2), row and column, of whole dark dots."""
    dark = ((gray < 130) & known).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(dark)
    full = np.pi * (1000 * DOT / MM) ** 2
    whole = [k for k in range(1, count) if abs(stats[k, cv2.CC_STAT_AREA] / full - 1) < 0.06]
    weight = np.where(known, 230.0 - gray, 0)
    centres = []
    for k in whole:
        near = cv2.dilate((labels == k).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        if not known[cv2.dilate(near.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0].all():
            continue  # cut by the border of the view
        rows, columns = np.nonzero(near)
        w = weight[near]
        centres.append([np.average(rows, weights=w), np.average(columns, weights=w)])
    return np.array(centres)


@pytest.mark.slow
def test_a_wall_is_straight_and_to_scale_as_read_back_by_others(tmp_path: Path) -> None:
    lr.write_view(tmp_path / "view", wall_view())
    picture = np.asarray(Image.open(tmp_path / "view" / "view.png"))
    assert picture.shape[2] == 4
    a, d, b, e, c, f = map(float, (tmp_path / "view" / "view.pgw").read_text().split())
    assert (a, d, b, e) == (MM / 1000, 0, 0, -MM / 1000)
    at = dots_found(picture[..., 0].astype(float), picture[..., 3] > 0)
    assert len(at) > 40
    flat = np.stack([c + a * at[:, 1], f + e * at[:, 0]], axis=1)  # the world file's origin: the first pixel's centre
    numbers = np.rint(flat / SPACING)
    off = flat - SPACING * numbers
    assert np.abs(off).max() < 0.3 * MM / 1000
    scale = np.linalg.lstsq(numbers - numbers.mean(axis=0), flat - flat.mean(axis=0), rcond=None)[0] / SPACING
    np.testing.assert_allclose(scale, np.eye(2), atol=5e-4)


@pytest.mark.slow
def test_a_geotiff_has_its_origin_at_the_corner_and_no_reference_system_unless_stated(tmp_path: Path) -> None:
    view = wall_view()
    lr.write_view(tmp_path / "view", view)
    with tifffile.TiffFile(tmp_path / "view" / "view.tif") as tif:
        tags, values = {tag.code: tag.value for tag in tif.pages[0].tags}, tif.asarray()
    assert tags[33550][:2] == (MM / 1000, MM / 1000)
    half = MM / 2000
    np.testing.assert_allclose(tags[33922], (0, 0, 0, view.left_m - half, view.top_m + half, 0), atol=1e-12)
    keys = np.array(tags[34735]).reshape(-1, 4)
    assert dict(zip(keys[1:, 0], keys[1:, 3], strict=True)) == {1025: 1}
    np.testing.assert_array_equal(values[..., 3] > 0, view.known)
    np.testing.assert_array_equal(values[..., :3], view.image)
    sigma = tifffile.imread(tmp_path / "view" / "sigma.tif")
    np.testing.assert_array_equal(np.isnan(sigma), ~view.known)
    with pytest.raises(lr.LadarregError, match="plan in the world"):
        lr.write_view(tmp_path / "other", view, crs="EPSG:25832", world_from_scanner=Rigid.identity())
    assert not (tmp_path / "other").exists()


def test_a_plan_in_the_world_has_its_coordinates_and_reference_system(tmp_path: Path) -> None:
    world = Rigid(rotation_from_rotvec((0, 0, 0.7)), np.array([500_000.0, 5_400_000.0, 300.0]))
    scan = scanned(lr.Plane.facing((2.5, 0, -0.6), (-0.6, 0, 0.8)))
    plan = lr.Plane.level(300.0, world_from_scanner=world)
    view = lr.rectify(scan, plan, mm_per_pixel=10, below_m=3, above_m=3)
    lr.write_view(tmp_path / "plan", view, world_from_scanner=world, crs="EPSG:25832")
    with tifffile.TiffFile(tmp_path / "plan" / "relief.tif") as tif:
        page = tif.pages[0]
        keys = np.array(page.tags[34735].value).reshape(-1, 4)
        corner, relief = page.tags[33922].value[3:5], page.asarray()
    assert dict(zip(keys[1:, 0], keys[1:, 3], strict=True)) == {1024: 1, 1025: 1, 3072: 25832}
    rows, columns = np.nonzero(np.isfinite(relief))
    x, y = corner[0] + 0.01 * (columns + 0.5), corner[1] - 0.01 * (rows + 0.5)
    back = world.inverse @ np.stack([x, y, 300.0 + relief[rows, columns]], axis=1)
    off = (back - (2.5, 0, -0.6)) @ np.array([-0.6, 0, 0.8])
    assert len(off) > 1000
    assert np.sqrt(np.mean(off**2)) < 0.005
    assert (view.photo == NO_PHOTO).all()  # of the laser alone


@pytest.mark.long
def test_the_error_map_is_the_spread_of_what_errors_of_the_pose_do() -> None:
    photo, rng = painted(WALL, POSE), np.random.default_rng(3)
    extent = (-0.45, -0.25, 0.45, 0.25)
    found: list[np.ndarray] = []
    expected = lr.rectify(registered(scanned(WALL), photo, POSE), WALL, mm_per_pixel=MM, extent_m=extent)
    for draw in range(30):
        off = rng.multivariate_normal(np.zeros(6), COVARIANCE)
        pose = Rigid.from_centre(rotation_from_rotvec(-off[:3]) @ POSE.rotation, POSE.centre - off[3:])
        source = registered(scanned(WALL, seed=draw), photo, pose)
        view = lr.rectify(source, WALL, mm_per_pixel=MM, extent_m=extent)
        flat = view.flat_of(dots_found(view.image[..., 0].astype(float), view.known))
        number = np.rint(flat / SPACING)
        middle = (number == 0).all(axis=1)
        assert middle.sum() == 1
        found.append(flat[middle][0])
    spread = np.sqrt(np.var(found, axis=0).sum())
    row, column = np.rint([expected.top_m / (MM / 1000), -expected.left_m / (MM / 1000)]).astype(int)
    stated = expected.sigma_m[row, column]
    assert stated == pytest.approx(spread, rel=0.35)  # of 30 draws


@pytest.mark.slow
def test_holes_stay_open_and_what_stands_before_the_surface_is_left_out() -> None:
    scan = scanned(WALL)
    ranges = scan.ranges.copy()
    ranges[75:105, 110:150] = np.nan
    ranges[45:60, 45:75] = 1.0  # a thing before the wall
    source = registered(replace(scan, ranges=ranges), painted(WALL, POSE), POSE)
    view = lr.rectify(source, WALL, mm_per_pixel=MM, below_m=0.2, above_m=0.2)
    for place in ((90, 130), (52, 60)):
        point = met(WALL, np.zeros(3), GRID.ray_at(np.array([place], float)).astype(float))
        a, b, _ = WALL.flattened(point)[0]
        row, column = int((view.top_m - b) * 1000 / MM), int((a - view.left_m) * 1000 / MM)
        assert not view.known[row - 5 : row + 6, column - 5 : column + 6].any()
        assert np.isnan(view.sigma_m[row, column])
    assert np.nanmax(np.abs(view.relief_m)) < 0.02


def test_a_pipe_is_unrolled() -> None:
    axis = rotation_from_rotvec((0.3, 0.2, 0)) @ np.array([0, 0, 1.0])
    pipe = lr.Cylinder(np.array([2.0, 0.1, 0.0]), axis, 0.25)
    scan = scanned(pipe, noise_m=0.001)
    middle = met(pipe, np.zeros(3), (pipe.origin / np.linalg.norm(pipe.origin))[None])[0]
    fitted = lr.Cylinder.fitted(scan, middle, radius_m=0.3)
    assert fitted.radius_m == pytest.approx(0.25, abs=0.002)
    assert abs(fitted.axis @ axis) > np.cos(np.radians(0.3))
    pose = Rigid.from_centre(look_along(pipe.origin - (0.1, 0.3, 0.0)), (0.1, 0.3, 0.0))
    view = lr.rectify(registered(scan, painted(pipe, pose), pose), pipe, mm_per_pixel=MM)
    at = dots_found(view.image[..., 0].astype(float), view.known)
    flat = view.flat_of(at)
    assert len(flat) > 8
    assert np.abs(flat - SPACING * np.rint(flat / SPACING)).max() < 0.5 * MM / 1000
    with pytest.raises(lr.LadarregError, match="pipe"):
        lr.Cylinder.fitted(scanned(WALL), WALL.origin)


def test_a_plane_is_fitted_to_most_of_what_is_there() -> None:
    scan = scanned(WALL)
    ranges = scan.ranges.copy()
    ranges[90:105, 120:150] -= 0.1
    fitted = lr.Plane.fitted(replace(scan, ranges=ranges), WALL.origin, radius_m=0.4)
    assert abs(fitted.normal @ WALL.normal) > np.cos(np.radians(0.1))
    assert abs((fitted.origin - WALL.origin) @ WALL.normal) < 0.001
    assert fitted.right[2] == pytest.approx(0, abs=1e-12)
    assert fitted.up[2] > 0.9
    assert fitted.normal @ fitted.origin < 0, "it is seen from the scanner"
    with pytest.raises(lr.LadarregError, match="larger radius"):
        lr.Plane.fitted(scan, WALL.origin, radius_m=0.001)
    with pytest.raises(lr.LadarregError, match="on a line"):
        lr.Plane.through([[1, 0, 0], [2, 0, 0], [3, 0, 1e-9]])
    points = WALL.raised(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    np.testing.assert_allclose(lr.Plane.through(points).normal, WALL.normal, atol=1e-12)


def test_flat_coordinates_are_inverted() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)) + np.array([4.0, 0, 0])
    for surface in (WALL, lr.Cylinder(np.array([3.0, 0, 0]), np.array([0.0, 0.6, 0.8]), 0.4)):
        flat = surface.flattened(points)
        np.testing.assert_allclose(surface.raised(flat), points, atol=1e-12)
        steps = np.eye(3)[:2] * 1e-6
        moved = (surface.raised(flat[:, None] + steps) - surface.raised(flat)[:, None]) / 1e-6
        stretch = 1 + flat[:, 2] / surface.radius_m if isinstance(surface, lr.Cylinder) else np.ones(50)
        np.testing.assert_allclose(moved[:, 0] / stretch[:, None], surface.axes(flat)[:, 0], atol=1e-5)
        np.testing.assert_allclose(moved[:, 1], surface.axes(flat)[:, 1], atol=1e-5)


def test_a_given_pose_has_no_error_map_and_bad_numbers_are_refused() -> None:
    source = registered(scanned(WALL), painted(WALL, POSE), POSE, accepted=False)
    view = lr.rectify(source, WALL, mm_per_pixel=10)
    assert view.known.any()
    assert np.isnan(view.sigma_m).all()
    for fields, words in (
        ({"mm_per_pixel": 0}, "positive"),
        ({"mm_per_pixel": 0.001}, "take"),
        ({"mm_per_pixel": 5, "below_m": -1}, "below_m"),
        ({"mm_per_pixel": 5, "below_m": 0, "above_m": 0}, "some room"),
        ({"mm_per_pixel": 5, "extent_m": (1, 0, 0, 1)}, "larger"),
        ({"mm_per_pixel": 5, "extent_m": (50, 50, 51, 51)}, "nothing"),
    ):
        with pytest.raises(lr.LadarregError, match=words):
            lr.rectify(source, WALL, **fields)  # type: ignore[arg-type]
    far = lr.Plane.facing((30.0, 0, 0), (-1, 0, 0))
    with pytest.raises(lr.LadarregError, match="no surface"):
        lr.rectify(source, far, mm_per_pixel=5)


def test_a_section_of_a_room_is_its_outline(tmp_path: Path) -> None:
    grid = SphericalGrid(60, 700, 2 * np.pi / 700, 0.02, 0.0, 0.59)
    rays = grid.rays.astype(float)
    with np.errstate(divide="ignore"):
        ranges = np.min([(np.where(rays[..., k] > 0, high, -low) / np.abs(rays[..., k]))
                         for k, (low, high) in enumerate(((-2.0, 3.0), (-1.5, 2.5)))], axis=0)  # fmt: skip
    scan = Scan(grid, ranges, np.ones(ranges.shape))
    lines = lr.section(scan, lr.Plane.level(0.1))
    length = sum(float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) for line in lines)
    assert length == pytest.approx(2 * (5 + 4), rel=0.02)
    points = np.concatenate(lines)
    np.testing.assert_allclose(points[:, 2], 0.1, atol=1e-6)
    off = np.min(np.abs([points[:, 0] - 3, points[:, 0] + 2, points[:, 1] - 2.5, points[:, 1] + 1.5]), axis=0)
    assert off.max() < 0.03  # between two cells a corner is cut
    assert len(simplified(lines[0], 0.03)) <= 8
    view = lr.rectify(scan, lr.Plane.level(0.1), mm_per_pixel=20, below_m=1, above_m=0)
    lr.write_view(tmp_path / "plan", view, lines=lines)
    text = (tmp_path / "plan" / "section.dxf").read_text(encoding="ascii")
    assert text.count("\nVERTEX\n") == sum(len(line) - bool((line[0] == line[-1]).all()) for line in lines)
    document = json.loads((tmp_path / "plan" / "view.json").read_text())
    assert document["section_lines"] == len(lines)
