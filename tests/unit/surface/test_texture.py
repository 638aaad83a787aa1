import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.formats import read_scan
from ladarreg_core.foundations.palette import UNSEEN
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.texture.registered_texture import Label, model_picture, pixel_sigma, texture_scan
from ladarreg_core.surface.visibility.render import render_scan_colors
from ladarreg_core.surface.visibility.visible_points import project_scan

LENSES = [(), (0.12, -0.04, 0.002, -0.001), (-0.25, 0.08, 0.001, 0.0005, -0.01)]


def wall_scan(*, rows=60, columns=80, step=0.005, tilt_rad=0.0, noise_m=0.0):
    geometry = AzimuthElevation(rows, columns, step, step)
    normal = np.array([np.cos(tilt_rad), np.sin(tilt_rad), 0.0])
    ranges = 3.0 / (geometry.rays @ normal) + np.random.default_rng(0).normal(size=geometry.shape) * noise_m
    return Scan(geometry, ranges, np.ones(geometry.shape))


def smooth_photo(camera):
    """A picture that bilinear lookup returns exactly: linear in u and in v, one to a channel."""
    v, u = np.mgrid[: camera.height, : camera.width]
    red, green = u * (250.0 / camera.width), v * (250.0 / camera.height)
    return Photo(np.rint(np.stack([red, green, 0 * red + 77], axis=-1)).astype(np.uint8), camera)


@pytest.mark.slow
@settings(max_examples=25)
@given(
    turn=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
    centre=st.tuples(*[st.floats(-0.8, 0.8)] * 3),
    lens=st.sampled_from(LENSES),
    focal=st.sampled_from([90.0, 300.0, 1300.0]),
)
def test_every_cell_gets_the_color_at_its_own_projection(turn, centre, lens, focal):
    camera = Camera(int(1.1 * focal), int(0.9 * focal), focal, 1.02 * focal, 0.5 * focal, 0.47 * focal, lens)
    pose = Rigid.from_centre(rotation_from_rotvec(turn) @ CAMERA_AXES_FROM_SCANNER, centre)
    scan = wall_scan()
    texture = texture_scan(scan, smooth_photo(camera), pose)
    uv = camera.project(pose @ scan.points.astype(np.float64))
    inside = camera.contains(uv)
    border = ~camera.contains(uv, border=0.01) & camera.contains(uv, border=-0.01)
    np.testing.assert_array_equal((texture.labels == Label.OUT_OF_FRAME) | border, ~inside | border)
    assert (texture.labels[inside & ~border] == Label.SEEN).all()
    assert (texture.image[texture.labels == Label.OUT_OF_FRAME] == UNSEEN).all()
    seen = texture.labels == Label.SEEN
    expected = uv[seen] * (250.0 / camera.width, 250.0 / camera.height)
    error = np.abs(texture.image[seen][:, :2] - expected)
    # Rounding three times costs a level and a half; a reduced copy is flat within its border pixels.
    deep = camera.contains(uv[seen], border=4.0)
    assert error[deep].max(initial=0) <= 1.6
    assert (texture.image[seen][:, 2] == 77).all()


def test_a_photo_much_finer_than_the_scan_is_averaged_and_not_picked_from():
    """Gray noise of one pixel: a cell of 10 pixels must not show single pixels of it."""
    camera = Camera.from_focal(2000, 1500, 2000.0)
    noise = np.random.default_rng(0).integers(0, 256, (1500, 2000, 1)).repeat(3, axis=2).astype(np.uint8)
    texture = texture_scan(wall_scan(), Photo(noise, camera), Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.1, 0, 0)))
    seen = texture.labels == Label.SEEN
    assert seen.sum() > 3000
    assert texture.image[seen].astype(float).std() < 20  # picked single pixels would have 50 to 74


def test_the_labels_of_a_panel_before_a_wall():
    geometry = AzimuthElevation(80, 100, 0.005, 0.005)
    rays = geometry.rays
    ranges = 4.0 / rays[..., 0]
    panel = np.s_[30:50, 40:60]
    ranges[panel] = (2.5 / rays[..., 0])[panel]
    ranges[5:9, 5:9] = np.nan
    scan = Scan(geometry, ranges, np.random.default_rng(0).random(geometry.shape))
    camera = Camera.from_focal(500, 400, 500.0)
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.0, -0.5, 0.0))
    texture = texture_scan(scan, smooth_photo(camera), pose, background=(1, 2, 3))
    labels = texture.labels
    assert (labels[5:9, 5:9] == Label.NO_RETURN).all()
    assert (labels[32:48, 42:58] == Label.SEEN).all()
    ring = np.zeros(geometry.shape, dtype=bool)
    ring[30:50, 40:60] = True
    ring[31:49, 41:59] = False
    assert (labels[ring] == Label.UNCERTAIN).all()
    assert (labels[29, 45:55] != Label.SEEN).all()
    # Seen from the right the panel hides wall on its left: half a metre aside, 1.5 m behind at 4 m.
    shadow = 0.5 * 1.5 / 2.5 / 4.0 / 0.005
    assert (labels[34:46, int(41 - shadow + 2) : 39] == Label.OCCLUDED).all()
    assert (labels[34:46, 10 : int(39 - shadow - 2)] == Label.SEEN).all()
    assert (texture.image[~texture.colored] == (1, 2, 3)).all()
    np.testing.assert_array_equal(texture.colored, np.isin(labels, (1, 4, 5)))

    shown = model_picture(scan, texture)
    np.testing.assert_array_equal(shown[texture.colored], texture.image[texture.colored])
    gray = shown[~texture.colored].astype(int)
    assert (np.ptp(gray, axis=1) == 0).all()
    assert 15 < gray.min() < gray.max() < 130


@pytest.mark.parametrize("noise_m", [0.0, 0.002])
def test_grazing_is_beyond_80_degrees_from_the_camera(noise_m):
    """The wall faces the scanner; only the camera sees it at a slant, the more so the further it looks."""
    scan = wall_scan(step=0.01, rows=30, columns=110, noise_m=noise_m)
    centre = np.array([2.75, -1.7, 0.0])  # 25 cm before the wall, at its right end
    left = rotation_from_rotvec((0, 1.2, 0)) @ CAMERA_AXES_FROM_SCANNER
    camera = Camera.from_focal(900, 600, 300.0)
    texture = texture_scan(scan, smooth_photo(camera), Rigid.from_centre(left, centre))
    cosine = 0.25 / np.linalg.norm(scan.points - centre, axis=-1)
    inside = texture.labels != Label.OUT_OF_FRAME
    limit = np.cos(np.deg2rad(80))
    slack = 0.01 + 60 * noise_m
    assert (texture.labels[inside & (cosine < limit - slack)] == Label.GRAZING).all()
    assert (texture.labels[inside & (cosine > limit + slack)] == Label.SEEN).all()
    assert np.count_nonzero(texture.labels == Label.GRAZING) > 100


@given(
    w_rad=st.tuples(*[st.floats(1e-5, 3e-3)] * 3),
    c_m=st.tuples(*[st.floats(1e-5, 2e-2)] * 3),
    mix=st.integers(0, 99),
    lens=st.sampled_from(LENSES),
)
def test_pixel_sigma_is_what_the_covariance_does_to_projections(w_rad, c_m, mix, lens):
    rng = np.random.default_rng(mix)
    A = np.diag([*w_rad, *c_m]) @ np.linalg.qr(rng.normal(size=(6, 6)))[0]
    covariance = A @ A.T
    camera = Camera(640, 480, 500.0, 510.0, 320.0, 240.0, lens)
    pose = Rigid.from_centre(rotation_from_rotvec((0.1, -0.2, 0.3)) @ CAMERA_AXES_FROM_SCANNER, (0.3, 0.2, -0.1))
    points = np.array([[4.0, 0.5, 0.3], [2.0, -0.3, 0.4]])

    def moved(change):
        R = rotation_from_rotvec(change[:3]) @ pose.rotation
        return camera.project(Rigid.from_centre(R, pose.centre + change[3:]) @ points)

    step = 1e-6
    J = np.stack([(moved(step * e) - moved(-step * e)) / (2 * step) for e in np.eye(6)], axis=-1)
    expected = [np.sqrt(np.linalg.eigvalsh(j @ covariance @ j.T)[-1]) for j in J]
    np.testing.assert_allclose(pixel_sigma(pose @ points, camera, pose.rotation, covariance), expected, rtol=1e-5)


def test_where_the_pose_is_uncertain_by_more_than_2_px_the_label_says_so():
    scan = wall_scan(tilt_rad=0.5)
    camera = Camera.from_focal(640, 480, 600.0)
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0, 0, 0))
    photo = smooth_photo(camera)
    shift = np.zeros((6, 6))
    shift[4, 4] = 0.0114**2  # sideways: over 2 px nearer than 3.42 m
    labels = texture_scan(scan, photo, pose, covariance=shift).labels
    near = 600 * 0.0114 / scan.points[..., 0] > 2
    assert 0.2 < near.mean() < 0.8
    np.testing.assert_array_equal(labels == Label.UNCERTAIN, near)
    assert (texture_scan(scan, photo, pose, covariance=shift * 0.1).labels == Label.SEEN).all()
    assert (texture_scan(scan, photo, pose, covariance=shift * np.nan).labels == Label.UNCERTAIN).all()


def test_the_uncertainty_is_that_of_each_cell_under_any_lens():
    """Also in the corners of a lens so strong that some pixels have no ray."""
    scan = wall_scan(step=0.012, tilt_rad=0.4)
    pose = Rigid.from_centre(rotation_from_rotvec((0.1, 0.1, 0)) @ CAMERA_AXES_FROM_SCANNER, (0.2, 0.1, 0.1))
    covariance = np.diag([1e-6, 2e-6, 4e-6, 2e-5, 1e-5, 4e-5])
    covariance[0, 4] = covariance[4, 0] = -2e-6
    for lens in (*LENSES, (-0.5, 0.1)):
        camera = Camera(700, 500, 450.0, 450.0, 340.0, 255.0, (*lens, 0.0, 0.0) if len(lens) == 2 else lens)
        points_camera = pose @ scan.points.astype(np.float64)
        inside = camera.contains(camera.project(points_camera))
        usual = np.median(pixel_sigma(points_camera[inside], camera, pose.rotation, covariance))
        covariance *= (2 / usual) ** 2
        labels = texture_scan(scan, smooth_photo(camera), pose, covariance=covariance).labels
        sigma = pixel_sigma(points_camera, camera, pose.rotation, covariance)
        inside = labels != Label.OUT_OF_FRAME
        assert (labels[inside & (sigma > 2.01)] == Label.UNCERTAIN).all()
        assert (labels[inside & (sigma < 1.99)] == Label.SEEN).all()
        assert 0.2 < np.mean(sigma[inside] > 2.01) < 0.8


def test_a_photo_that_sees_nothing_colors_nothing():
    scan = wall_scan()
    camera = Camera.from_focal(64, 48, 60.0)
    away = rotation_from_rotvec((0, np.pi, 0)) @ CAMERA_AXES_FROM_SCANNER
    texture = texture_scan(scan, smooth_photo(camera), Rigid.from_centre(away, (0, 0, 0)), covariance=np.eye(6))
    assert (texture.labels == Label.OUT_OF_FRAME).all()
    assert (texture.image == UNSEEN).all()


def test_hostile_input_is_named():
    scan, camera = wall_scan(), Camera.from_focal(64, 48, 60.0)
    photo, pose = smooth_photo(camera), Rigid.identity()
    with pytest.raises(ShapeError, match="64 x 48"):
        texture_scan(scan, photo, pose, camera=Camera.from_focal(32, 24, 30.0))
    with pytest.raises(ShapeError, match="covariance"):
        texture_scan(scan, photo, pose, covariance=np.eye(3))
    for background in ((1, 2), (0, 0, 256), (0.5, 0, 0), "red"):
        with pytest.raises(OptionError, match="background"):
            texture_scan(scan, photo, pose, background=background)
    other = texture_scan(wall_scan(rows=10), photo, pose)
    with pytest.raises(ShapeError, match="agree"):
        model_picture(scan, other)


def test_nothing_shines_through_the_machines_of_a_real_scan(real_data):
    """`pump`, its own colours photographed from elsewhere, texture it again: what is labelled seen has its own colour.

    Its columns lie up to four photo pixels apart, which a buffer of points would leak through.
    """
    path = real_data / "pump" / "pumpAVisualReferenceImage.e57"
    if not path.is_file():
        pytest.skip("no pump scan")
    scan = read_scan(path)
    camera = Camera.from_focal(900, 1000, 700.0)
    target = np.nanmedian(scan.points.reshape(-1, 3), axis=0)
    for centre in ((-0.3, 0.5, 0.3), (0.4, -0.2, -0.3)):
        forward = (target - centre) / np.linalg.norm(target - centre)
        right = np.cross(forward, (0, 0, 1)) / np.linalg.norm(np.cross(forward, (0, 0, 1)))
        pose = Rigid.from_centre(np.stack([right, np.cross(forward, right), forward]), centre)
        rgb, covered = render_scan_colors(scan, camera, pose)
        texture = texture_scan(scan, Photo(rgb, camera), pose)
        seen = texture.labels == Label.SEEN
        uv = np.rint(camera.project(pose @ scan.points[seen])).astype(int)
        # Beside a hole the photograph shows its background, as any would.
        inner = cv2.erode(covered.astype(np.uint8), np.ones((5, 5), np.uint8))[uv[:, 1], uv[:, 0]] > 0
        error = np.abs(texture.image[seen].astype(int) - scan.color[seen]).max(axis=-1)[inner]
        assert np.count_nonzero(seen) > 0.5 * np.count_nonzero(scan.valid)
        assert np.count_nonzero(texture.labels == Label.OCCLUDED) > 0.02 * np.count_nonzero(scan.valid)
        assert np.quantile(error, 0.5) <= 2
        assert np.mean(error > 40) < 0.005


def test_cells_that_only_noise_hides_keep_the_color_and_are_uncertain() -> None:
    geometry = AzimuthElevation(120, 160, 0.004, 0.004)
    ranges = 4.0 / geometry.rays[..., 0]
    ranges[80:116:6, 10:150:7] *= 1.03  # single ranges that are too long
    ranges[30:70, 60:90] = 3.0 / geometry.rays[30:70, 60:90, 0]  # a box with a real shadow
    scan = Scan(geometry, ranges, np.ones(geometry.shape))
    camera = Camera(300, 300, 400.0, 400.0, 149.5, 149.5)
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0, 1.0, 0))
    photo = Photo(np.full((300, 300, 3), (200, 100, 50), np.uint8), camera)
    hidden = project_scan(scan, camera, pose).occluded
    found = texture_scan(scan, photo, pose)
    shadow = np.zeros(scan.shape, bool)
    shadow[34:66, 92:106] = True
    lone = hidden & (found.labels == Label.UNCERTAIN)
    assert hidden[shadow].mean() > 0.5, "there is a shadow"
    assert (found.labels[shadow & hidden] == Label.OCCLUDED).mean() > 0.95, "which stays"
    assert lone.sum() > 50
    assert (found.image[lone] == (200, 100, 50)).all()
