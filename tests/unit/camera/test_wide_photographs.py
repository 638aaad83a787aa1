"""Photographs of fisheye and equirectangular cameras: solved from matches, and sampled on the scan."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera, FisheyeCamera
from ladarreg_core.errors import CameraError
from ladarreg_core.frames import Rigid, rotation_from_rotvec, rotvec_from_rotation
from ladarreg_core.matches import Matches
from ladarreg_core.photo import Photo
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import SphericalGrid
from ladarreg_core.surface.texture.registered_texture import Label, texture_scan
from ladarreg_core.surface.uncertainty import pixel_sigma
from ladarreg_core.surface.visibility.render import render_scan_colors

FISHEYE = FisheyeCamera(1200, 1200, 350, 350, 599.5, 599.5, (0.02, -0.003, 0, 0))  # 190 degrees
PANORAMA = EquirectangularCamera(2048, 1024)
WIDE = [FISHEYE, PANORAMA]
POSE = Rigid.from_centre(rotation_from_rotvec([0.4, 2.9, -0.3]), np.array([0.6, -0.4, 0.2]))


def matches_of(camera: CameraModel, *, count: int, seed: int, sigma_px: float, outliers: int = 0) -> Matches:
    """Return matches all around the camera, across the seam of a panorama as well."""
    rng = np.random.default_rng(seed)
    rays = rng.normal(size=(40 * count, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ranges = rng.uniform(2, 8, len(rays))
    uv = camera.project(POSE @ (rays * ranges[:, None]))
    seen = np.flatnonzero(camera.contains(uv, border=5))[:count]
    uv = uv[seen] + rng.normal(size=(count, 2)) * sigma_px
    uv[:outliers] = rng.uniform(0, 1000, (outliers, 2))
    measured = ranges[seen] + rng.normal(size=count) * 0.002
    return Matches(rays[seen], measured, uv)


@pytest.mark.parametrize("camera", WIDE)
def test_matches_all_around_give_the_pose(camera: CameraModel) -> None:
    matches = matches_of(camera, count=60, seed=4, sigma_px=0.7, outliers=18)
    ahead = (camera.unproject(matches.uv)[18:, 2] > 0).mean()
    assert ahead < 0.97, "some lie beside or behind the camera"
    found = solve_pose(matches, camera)
    assert found.accepted, found.reasons
    assert found.camera == camera
    assert np.degrees(found.camera_from_scanner.angle_to(POSE)) < 0.1
    assert np.linalg.norm(found.camera_from_scanner.centre - POSE.centre) < 0.01
    assert not found.inliers[:18].any()
    assert np.abs(found.residuals_px[found.inliers]).max() < 5


@pytest.mark.slow
@pytest.mark.parametrize("camera", WIDE)
def test_the_spread_of_poses_is_as_predicted(camera: CameraModel) -> None:
    normalised = []
    for seed in range(40):
        matches = matches_of(camera, count=40, seed=seed, sigma_px=1.0)
        found = solve_pose(matches, camera, PoseOptions(sigma_px=1.0, sigma_range_m=0.002))
        w = POSE.rotation @ found.camera_from_scanner.rotation.T
        error = np.concatenate([rotvec_from_rotation(w), POSE.centre - found.camera_from_scanner.centre])
        normalised.append(error @ np.linalg.solve(found.covariance, error) / 6)
    assert 0.75 < np.mean(normalised) < 1.3


def test_residuals_are_the_shorter_way_round() -> None:
    matches = matches_of(PANORAMA, count=60, seed=2, sigma_px=0.5)
    turns = np.random.default_rng(1).integers(-1, 2, len(matches))
    turned = Matches(matches.rays, matches.ranges, matches.uv + turns[:, None] * [PANORAMA.width, 0])
    found, same = solve_pose(turned, PANORAMA), solve_pose(matches, PANORAMA)
    assert np.abs(found.residuals_px).max() < 5
    assert found.camera_from_scanner.angle_to(same.camera_from_scanner) < 1e-9


def test_methods_of_the_thesis_say_that_they_need_a_perspective_photograph() -> None:
    matches = matches_of(PANORAMA, count=20, seed=2, sigma_px=0.5)
    for method in ("linear", "stereo_simplex"):
        with pytest.raises(CameraError, match="perspective"):
            solve_pose(matches, PANORAMA, PoseOptions(method=method))  # type: ignore[arg-type]


def room(*, with_post: bool = True) -> Scan:
    """Return a box scanned from inside, with a post in it, whose colour is that of the direction."""
    geometry = SphericalGrid(181, 360, np.radians(1), np.radians(1), 0.0, np.radians(90))
    rays = np.asarray(geometry.rays)
    with np.errstate(divide="ignore"):
        ranges = np.min(np.array([3.0, 2.5, 1.5]) / np.abs(rays), axis=-1)
        if with_post:
            level = rays[..., :2] / np.linalg.norm(rays[..., :2], axis=-1, keepdims=True)
            along = level @ np.array([np.cos(0.5), np.sin(0.5)]) * 1.2
            off = np.abs(level @ np.array([-np.sin(0.5), np.cos(0.5)]) * 1.2)
            post = (along > 0) & (off < 0.15) & (np.abs(rays[..., 2]) < 0.7)
            ranges = np.where(post, along / np.maximum(np.hypot(*np.moveaxis(rays[..., :2], -1, 0)), 1e-6), ranges)
    color = np.clip(128 + 110 * rays, 0, 255).astype(np.uint8)
    return Scan(geometry, ranges.astype(np.float32), ranges.astype(np.float32), color=color)


@pytest.mark.parametrize("camera", [PANORAMA.scaled(0.5), FISHEYE.scaled(0.5)])
def test_a_photograph_is_sampled_on_the_scan_also_across_the_seam(camera: CameraModel) -> None:
    scan = room()
    pixels, covered = render_scan_colors(scan, camera, POSE)
    photo = Photo(pixels, camera)
    assert covered.mean() > 0.7
    texture = texture_scan(scan, photo, POSE, covariance=np.eye(6) * 1e-10)
    seen = texture.labels == Label.SEEN
    assert seen.mean() > (0.8 if camera.model == "equirectangular" else 0.4)
    assert (texture.labels == Label.OCCLUDED).any(), "what the post hides"
    assert scan.color is not None
    off = np.abs(texture.image.astype(int) - scan.color)[seen]
    assert np.percentile(off, 99) <= 3
    uv = camera.project(POSE @ scan.points)
    at_seam = seen & ((uv[..., 0] < 0) | (uv[..., 0] > camera.width - 1))
    if camera.model == "equirectangular":
        assert at_seam.sum() > 20
        assert np.abs(texture.image.astype(int) - scan.color)[at_seam].max() <= 4


def test_a_wide_pixels_uncertainty_is_that_of_its_shift() -> None:
    covariance = np.diag([1e-6] * 3 + [1e-6] * 3)
    points = np.array([[1.0, 0.2, 2.0], [2.0, 0.5, -1.0]])
    sigma = pixel_sigma(points, PANORAMA, POSE.rotation, covariance)
    rng = np.random.default_rng(0)
    for point, stated in zip(points, sigma, strict=True):
        draws = rng.normal(size=(4000, 6)) * 1e-3
        moved = np.array([rotation_from_rotvec(w) @ point for w in draws[:, :3]]) - draws[:, 3:] @ POSE.rotation.T
        shift = PANORAMA.difference(PANORAMA.project(moved), PANORAMA.project(point))
        longer = np.sqrt(np.linalg.eigvalsh(np.cov(shift.T))[-1])
        assert stated == pytest.approx(longer, rel=0.06)


def test_a_pinhole_through_the_wide_formulas_gives_the_same_pose() -> None:
    """A fisheye whose polynomial is that of a pinhole is solved as well as the pinhole itself."""
    pinhole = Camera.from_focal(1000, 800, 700.0)
    matches = matches_of(pinhole, count=40, seed=3, sigma_px=0.5)
    rays = pinhole.unproject(matches.uv)
    panorama = EquirectangularCamera(4000, 2000)
    there = Matches(matches.rays, matches.ranges, panorama.project(rays))
    a, b = solve_pose(matches, pinhole, PoseOptions(intrinsics="fixed")), solve_pose(there, panorama)
    assert np.degrees(a.camera_from_scanner.angle_to(b.camera_from_scanner)) < 0.05
