"""The laser's point under each pixel of a photograph, and the spread that is predicted for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.camera import CameraModel
from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.errors import ExportError, OptionError
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.texture import photo_points

GRID = AzimuthElevation(90, 120, 0.008, 0.008)
POSE = lr.Rigid.from_centre(
    lr.Rigid.from_rotvec((0.05, -0.12, 0.08)).rotation @ np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    (0.3, 0.4, -0.1),
)
PLANE, OFFSET = np.array([-0.8, 0.5, 0.33]) / np.linalg.norm([-0.8, 0.5, 0.33]), -3.0
CAMERAS: dict[str, CameraModel] = {
    "plain": lr.Camera.from_focal(160, 120, 150),
    "distorted": lr.Camera(160, 120, 150, 149, 80, 58, (-0.2, 0.05, 0.001, -0.001, 0.01)),
    "fisheye": lr.FisheyeCamera(160, 120, 90, 90, 79, 60, (0.02, -0.004, 0, 0)),
    "panorama": lr.EquirectangularCamera(720, 360),
}


def scan_of(ranges: np.ndarray) -> lr.Scan:
    return lr.Scan(GRID, ranges, np.ones(GRID.shape))


def plane_ranges() -> np.ndarray:
    return np.asarray(OFFSET / (GRID.rays @ PLANE))


def result(camera: CameraModel, pose: lr.Rigid = POSE, **fields: object) -> lr.Registration:
    scan = scan_of(plane_ranges())
    photo = lr.Photo(np.zeros((camera.height, camera.width, 3), np.uint8), camera)
    found = lr.given_pose(scan, photo, pose, check_images=False)
    return replace(found, **{"covariance": 1e-12 * np.eye(6), **fields})  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_points_lie_on_the_surface_under_their_pixels(name: str) -> None:
    camera = CAMERAS[name]
    scan, made = scan_of(plane_ranges()), result(CAMERAS[name])
    xyz, sigma = lr.xyz_of_photo(scan, made)
    known = np.isfinite(xyz[..., 0])
    assert xyz.shape == (camera.height, camera.width, 3)
    assert sigma.shape == known.shape
    assert known.sum() > 1500
    assert (np.isfinite(sigma) == known).all()
    v, u = np.nonzero(known)
    uv = np.stack([u, v], axis=-1)
    off = np.hypot(*(camera.project(POSE @ xyz[known].astype(np.float64)) - uv).T)
    assert off.max() < 2e-3
    assert np.abs(xyz[known] @ PLANE - OFFSET).max() < 2e-4
    at = np.random.default_rng(3).permutation(uv)[:300]
    chosen = lr.xyz_of_photo(scan, made, at=at)
    whole = xyz[at[:, 1], at[:, 0]]
    inside = np.isfinite(chosen.xyz[:, 0])
    assert inside.mean() > 0.97  # the rim of the surface
    np.testing.assert_allclose(chosen.xyz[inside], whole[inside], atol=1e-4)
    # the control: half a pixel beside, it is another point
    beside = lr.xyz_of_photo(scan, made, at=at + 0.5)
    assert np.nanmedian(np.linalg.norm(beside.xyz - whole, axis=1)) > 3e-3


def test_depth_edges_are_not_bridged() -> None:
    ranges = np.full(GRID.shape, 5.0)
    ranges[20:60, 30:70] = 3.0
    xyz = lr.xyz_of_photo(scan_of(ranges), result(CAMERAS["distorted"])).xyz
    distance = np.linalg.norm(xyz[np.isfinite(xyz[..., 0])], axis=1)
    assert (np.minimum(np.abs(distance - 5), np.abs(distance - 3)) < 0.01).all()
    assert (distance < 4).sum() > 500
    assert (distance > 4).sum() > 500
    assert not np.isfinite(xyz[0, 0]).any() or np.isfinite(xyz).all(axis=-1).mean() < 1


def test_the_nearest_surface_is_found_however_the_search_is_divided(monkeypatch: pytest.MonkeyPatch) -> None:
    ranges = np.full(GRID.shape, 5.0)
    ranges[20:60, 30:70] = 3.0
    scan, made = scan_of(ranges), result(CAMERAS["plain"])
    at = np.random.default_rng(5).uniform((0, 0), (159, 119), (400, 2))
    whole = lr.xyz_of_photo(scan, made, at=at)
    monkeypatch.setattr(photo_points, "_PAIRS_AT_ONCE", 20)
    divided = lr.xyz_of_photo(scan, made, at=at)
    single = np.array([lr.xyz_of_photo(scan, made, at=[pixel]).xyz[0] for pixel in at[:20]])
    assert np.isfinite(whole.xyz[:, 0]).sum() > 100
    np.testing.assert_array_equal(divided.xyz, whole.xyz)
    np.testing.assert_array_equal(divided.sigma, whole.sigma)
    np.testing.assert_array_equal(single, whole.xyz[:20])


@pytest.mark.parametrize("name", CAMERAS)
def test_normals_are_those_of_the_surface(name: str) -> None:
    scan, made = scan_of(plane_ranges()), result(CAMERAS[name])
    camera = made.camera
    at = np.random.default_rng(4).uniform((-5, -5), (camera.width + 5, camera.height + 5), (300, 2))
    xyz, sigma, normals = lr.xyz_of_photo(scan, made, at=at, normals=True)
    without = lr.xyz_of_photo(scan, made, at=at)
    np.testing.assert_array_equal(xyz, without.xyz)
    np.testing.assert_array_equal(sigma, without.sigma)
    known = np.isfinite(xyz[:, 0])
    assert known.sum() > 3
    assert normals.dtype == np.float32
    assert (np.isfinite(normals).all(axis=1) == known).all()
    toward = PLANE if OFFSET < 0 else -PLANE
    assert (normals[known] @ toward > 0.999).all()
    np.testing.assert_allclose(np.linalg.norm(normals[known], axis=1), 1, atol=1e-5)
    world = lr.Rigid.from_centre(lr.Rigid.from_rotvec((0.3, 0.2, -0.9)).rotation, (400_000.0, 5_000_000.0, 90.0))
    placed = lr.xyz_of_photo(replace(scan, world_from_scanner=world), made, at=at, normals=True, frame="world")
    np.testing.assert_allclose(placed.normals, normals @ world.rotation.T, atol=1e-6)


def test_normals_of_a_whole_photograph_have_its_shape() -> None:
    scan, made = scan_of(plane_ranges()), result(lr.Camera.from_focal(16, 12, 15))
    xyz, _, normals = lr.xyz_of_photo(scan, made, normals=True)
    assert normals.shape == xyz.shape == (12, 16, 3)
    np.testing.assert_array_equal(np.isfinite(normals), np.isfinite(xyz))
    with pytest.raises(OptionError, match="normals"):
        lr.xyz_of_photo(scan, made, normals="yes")  # type: ignore[call-overload]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plain", "distorted"])
def test_triangles_far_from_the_pixels_are_left_out_without_loss(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ranges = plane_ranges()
    ranges[30:60, 40:80] *= 0.6
    ranges[::7, ::5] = np.nan
    scan, made = scan_of(ranges), result(CAMERAS[name])
    at = np.random.default_rng(6).uniform((0, 0), (159, 119), (60, 2))
    number = photo_points._Surface._faces_beside
    searched: list[int] = []

    def counted(surface: photo_points._Surface, pixels: np.ndarray) -> np.ndarray:
        found = number(surface, pixels)
        searched.append(len(found) * 5 < len(surface.faces))
        return found

    def every(surface: photo_points._Surface, _: np.ndarray) -> np.ndarray:
        return np.arange(len(surface.faces))

    monkeypatch.setattr(photo_points._Surface, "_faces_beside", counted)
    few = [lr.xyz_of_photo(scan, made, at=[pixel]) for pixel in at]
    assert np.mean(searched) > 0.9
    monkeypatch.setattr(photo_points._Surface, "_faces_beside", every)
    whole = lr.xyz_of_photo(scan, made, at=at)
    assert np.isfinite(whole.sigma).sum() > 10
    np.testing.assert_array_equal(np.concatenate([one.xyz for one in few]), whole.xyz)
    np.testing.assert_array_equal(np.concatenate([one.sigma for one in few]), whole.sigma)


@pytest.mark.slow
def test_predicted_and_real_spread_agree() -> None:
    rng = np.random.default_rng(7)
    camera, ranges = CAMERAS["distorted"], plane_ranges()
    draw = rng.normal(size=(6, 6)) * np.array([4e-4] * 3 + [3e-3] * 3)[:, None]
    covariance, noise, click = draw @ draw.T, 0.004, 0.4
    at = rng.uniform(20, 95, (40, 2))
    exact = lr.xyz_of_photo(scan_of(ranges), result(camera), at=at).xyz.astype(np.float64)
    known = np.isfinite(exact[:, 0])
    assert known.sum() > 30
    errors, predicted = [], []
    stated = result(camera, covariance=covariance)
    for _ in range(60):
        change = np.linalg.cholesky(covariance) @ rng.normal(size=6)
        # the estimate is off such that R_true = exp([w]x) R and C_true = C + c
        turned = lr.Rigid.from_rotvec(-change[:3]).rotation @ POSE.rotation
        made = replace(stated, camera_from_scanner=lr.Rigid.from_centre(turned, POSE.centre - change[3:]))
        scan = scan_of(ranges + rng.normal(0, noise, ranges.shape))
        clicked = at + rng.normal(0, click, at.shape)
        found = lr.xyz_of_photo(scan, made, at=clicked, sigma_range_m=noise, sigma_uv_px=click)
        errors.append(np.linalg.norm(found.xyz - exact, axis=1)[known])
        predicted.append(found.sigma[known])
    real = np.sqrt(np.nanmean(np.square(errors), axis=0))
    ratio = real / np.sqrt(np.nanmean(np.square(predicted), axis=0))
    assert 0.9 < np.median(ratio) < 1.1
    assert ratio.min() > 0.75
    assert ratio.max() < 1.3


def test_uncertain_intrinsics_count() -> None:
    camera = lr.Camera.from_focal(160, 120, 150)
    covariance = 1e-14 * np.eye(7)
    covariance[6, 6] = 1.5**2
    joint = CameraUncertainty(("focal_px",), covariance, {"focal_px": 150.0})
    sharp, unsure = result(camera), result(camera, camera_uncertainty=joint)
    at = np.array([[79.5, 59.5], [110.0, 80.0]])
    scan = scan_of(plane_ranges())
    less, more = (lr.xyz_of_photo(scan, made, at=at, sigma_range_m=0).sigma for made in (sharp, unsure))
    zoomed = lr.xyz_of_photo(scan, result(lr.Camera.from_focal(160, 120, 151.5)), at=at).xyz
    moved = np.linalg.norm(zoomed - lr.xyz_of_photo(scan, sharp, at=at).xyz, axis=1)
    np.testing.assert_allclose(more, moved, rtol=0.03, atol=1e-5)
    assert moved[1] > 50 * less[1]


def test_what_is_not_known_is_not_given() -> None:
    scan = scan_of(plane_ranges())
    made = result(CAMERAS["plain"], covariance=np.full((6, 6), np.nan))
    found = lr.xyz_of_photo(scan, made, at=[[80, 60], [-5, 60]])
    assert np.isfinite(found.xyz[0]).all()
    assert np.isnan(found.xyz[1]).all()
    assert np.isnan(found.sigma).all()
    with pytest.raises(ExportError, match="refused"):
        lr.xyz_of_photo(scan, replace(made, evidence="none"))
    with pytest.raises(OptionError, match="world"):
        lr.xyz_of_photo(scan, made, frame="world")
    world = lr.Rigid(lr.Rigid.from_rotvec((0, 0, 1)).rotation, np.array([4e5, 5e6, 100]))
    placed = lr.xyz_of_photo(replace(scan, world_from_scanner=world), made, at=[[80, 60]], frame="world")
    assert placed.xyz.dtype == np.float64
    np.testing.assert_allclose(placed.xyz[0], world @ found.xyz[0].astype(np.float64), atol=1e-6)
