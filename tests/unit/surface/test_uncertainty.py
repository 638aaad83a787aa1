import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.camera.uncertainty import pose_jacobian
from ladarreg_core.errors import CameraError, OptionError, ShapeError
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation, SphericalGrid
from ladarreg_core.surface.uncertainty import picture_sigma, pixel_sigma

LENSES = [(), (0.12, -0.04, 0.002, -0.001), (-0.45, 0.12, 0.001, 0.0005, -0.01)]


def room(*, rows=40, columns=60, step=0.02, seed=0):
    """A scan of rough walls all around the middle of the field, wider than any photo, with holes."""
    rng = np.random.default_rng(seed)
    geometry = AzimuthElevation(rows, columns, step, step)
    ranges = rng.uniform(1.5, 6.0, geometry.shape)
    ranges[rng.random(geometry.shape) < 0.1] = np.nan
    return Scan(geometry, ranges, np.ones(geometry.shape))


def some_covariance(seed, *, rad=1e-3, m=5e-3):
    rng = np.random.default_rng(seed)
    A = np.diag([rad] * 3 + [m] * 3) @ rng.normal(size=(6, 6))
    return A @ A.T


def by_definition(scan, cells, camera, pose, covariance, *, sigma_range_m=0.0):
    """Both measures of some cells, (N, 2), from J S J^T with the pose's own Jacobian; range noise by differences."""
    points, rays = scan.points.reshape(-1, 3)[cells].astype(float), scan.rays.reshape(-1, 3)[cells]
    uv, J = pose_jacobian(pose, points, camera)
    J[np.isnan(uv[:, 0])] = np.nan
    S = J @ covariance @ J.swapaxes(1, 2)
    forward, back = (camera.project(pose @ (points + way * rays)) for way in (1e-5, -1e-5))
    along = (forward - back) / 2e-5 * sigma_range_m
    S = S + along[:, :, None] * along[:, None]
    known = np.isfinite(S).all(axis=(1, 2))
    result = np.full((len(S), 2), np.nan)
    result[known] = np.sqrt(np.column_stack([np.linalg.eigvalsh(S[known])[:, 1], np.trace(S[known], axis1=1, axis2=2)]))
    return result


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 999),
    turn=st.tuples(*[st.floats(-0.4, 0.4)] * 3),
    centre=st.tuples(*[st.floats(-2.5, 2.5)] * 3),
    lens=st.sampled_from(LENSES),
    sigma_range_m=st.sampled_from([0.0, 0.02]),
    rows=st.sampled_from([40, 230]),  # a net over the lens serves the larger one
)
def test_the_map_is_the_covariance_carried_through_the_poses_jacobian(seed, turn, centre, lens, sigma_range_m, rows):
    scan = room(rows=rows, columns=rows * 5 // 4 + 3, step=0.9 / rows, seed=seed)
    camera = Camera(640, 480, 500.0, 520.0, 310.0, 245.0, lens)
    pose = Rigid.from_centre(rotation_from_rotvec(turn) @ CAMERA_AXES_FROM_SCANNER, centre)
    covariance = some_covariance(seed)
    cells = np.random.default_rng(seed).permutation(scan.ranges.size)[:2000]
    expected = by_definition(scan, cells, camera, pose, covariance, sigma_range_m=sigma_range_m)
    depth = (pose @ scan.points.reshape(-1, 3)[cells].astype(float))[:, 2]
    # At the camera itself float32 points are no measure, nor exactly where the lens ends.
    x, y = ((pose @ scan.points.reshape(-1, 3)[cells].astype(float))[:, k] / depth for k in range(2))
    radius = np.hypot(x, y)
    known = np.isfinite(expected[:, 0])
    end = radius[known].max(initial=0)
    clear = ~(np.abs(depth) < 0.02) & ~(np.abs(radius - end) < 1e-3 * end)
    for k, measure in enumerate(("longer_axis", "total")):
        found = picture_sigma(scan, camera, pose, covariance, sigma_range_m=sigma_range_m, measure=measure)
        assert found.shape == scan.shape
        assert found.dtype == np.float32
        off = np.abs(found.ravel()[cells][clear] / expected[clear, k] - 1)
        assert (np.isnan(found.ravel()[cells][clear]) == np.isnan(expected[clear, k])).all()
        assert np.nanmax(off, initial=0) < 1e-2  # a lens's net is coarse where the lens ends
        assert np.nanmedian([*off, 0.0]) < 5e-4
    assert np.isnan(found[~scan.valid]).all()
    assert np.isnan(found.ravel()[cells][depth < 0]).all()


def test_the_map_is_the_scatter_of_pictures_registered_by_random_poses():
    rng = np.random.default_rng(5)
    scan, camera = room(), Camera.from_focal(640, 480, 500.0)
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (-0.5, 0.4, 0.1))
    covariance = some_covariance(8)
    points = scan.points[scan.valid].astype(float)
    pictures = []
    for change in rng.multivariate_normal(np.zeros(6), covariance, 1500):
        R = rotation_from_rotvec(change[:3]) @ pose.rotation
        pictures.append(camera.project(Rigid.from_centre(R, pose.centre + change[3:]) @ points))
    scatter = np.sqrt(np.var(pictures, axis=0).sum(axis=-1))
    found = picture_sigma(scan, camera, pose, covariance, measure="total")[scan.valid]
    assert np.abs(found / scatter - 1).max() < 0.1
    longer = picture_sigma(scan, camera, pose, covariance)[scan.valid]
    assert (longer <= found).all()
    assert (longer >= found / np.sqrt(2) * 0.9999).all()


def test_a_pose_that_hardly_anything_determines_keeps_its_digits():
    """Turning and shifting that cancel at 4 m: the rest of the picture depends on a small difference of huge terms."""
    geometry = AzimuthElevation(20, 20, 0.01, 0.01)
    scan = Scan(geometry, 4 / geometry.rays[..., 0], np.ones(geometry.shape))
    camera = Camera.from_focal(640, 480, 500.0)
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0, 0, 0))
    direction = np.array([0, 0.25, 0, 0, 1.0, 0]) * 300
    covariance = np.outer(direction, direction) + np.diag([1e-6] * 6)
    expected = by_definition(scan, np.arange(400), camera, pose, covariance)[:, 0]
    np.testing.assert_allclose(picture_sigma(scan, camera, pose, covariance).ravel(), expected, rtol=1e-4)


def test_all_around_a_panorama_what_lies_behind_the_camera_has_no_uncertainty():
    geometry = SphericalGrid(60, 180, np.deg2rad(2), np.deg2rad(2), 0.0, np.deg2rad(59))
    scan = Scan(geometry, np.full(geometry.shape, 3.0), np.ones(geometry.shape))
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.2, 0, 0))
    for lens in LENSES:
        camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, lens)
        found = picture_sigma(scan, camera, pose, np.eye(6) * 1e-6)
        uv = camera.project(pose @ scan.points)
        assert 0.05 < np.isfinite(found).mean() < 0.5
        assert np.mean(np.isfinite(found) != np.isfinite(uv[..., 0])) < 1e-3
    nothing = picture_sigma(scan, camera, pose, np.zeros((6, 6)))
    assert np.nanmax(nothing) == 0
    precise = scan.points.astype(np.float64) - pose.centre
    there = pixel_sigma(precise @ pose.rotation.T, camera, pose.rotation, np.eye(6) * 1e-6)
    np.testing.assert_allclose(found, there, rtol=1e-3)


def test_hostile_arguments_are_named():
    scan, camera, pose = room(), Camera.from_focal(64, 48, 60.0), Rigid.identity()
    good, odd = np.eye(6), np.eye(6)
    odd[0, 1] = 0.5
    for bad in (np.eye(5), good * np.nan, -good, odd, np.ones((6, 6)) - 2 * good, "covariance"):
        with pytest.raises(ShapeError, match="covariance"):
            picture_sigma(scan, camera, pose, bad)
    for option in ({"sigma_range_m": -1.0}, {"sigma_range_m": np.nan}, {"sigma_range_m": "1"}, {"measure": "mean"}):
        with pytest.raises(OptionError):
            picture_sigma(scan, camera, pose, good, **option)
    with pytest.raises(CameraError):
        picture_sigma(scan, None, pose, good)
