from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera, FisheyeCamera
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.texture.registered_texture import intensity_picture
from ladarreg_core.surface.visibility.render import render_scan_colors, render_scan_picture
from testing.scenes.simulated import simulated

LENSES = [(), (0.12, -0.04, 0.002, -0.001), (-0.25, 0.08, 0.001, 0.0005, -0.01)]


def wall_scan(color_of_yz, *, rows=160, columns=200, step=0.004, lean=0.3):
    """A plane X = 3 + lean Y whose colour is a function of (Y, Z)."""
    geometry = AzimuthElevation(rows, columns, step, step)
    rays = geometry.rays
    ranges = 3.0 / (rays[..., 0] - lean * rays[..., 1])
    points = rays * ranges[..., None]
    value = np.clip(color_of_yz(points[..., 1], points[..., 2]), 0, 255)
    color = np.repeat(np.rint(value)[..., None], 3, axis=-1).astype(np.uint8)
    return Scan(geometry, ranges, np.ones(geometry.shape), color=color)


@settings(max_examples=6, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-0.06, 0.06)] * 3),
    centre=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    offset=st.tuples(*[st.floats(-20, 20)] * 2),
    lens=st.sampled_from(LENSES),
)
def test_a_rendered_pattern_lies_where_the_camera_projects_it(turn, centre, offset, lens):
    """The picture equals the pattern at the pixel's own ray, to what .05 px of shift would change."""
    camera = Camera(240, 200, 300.0, 310.0, 119.5 + offset[0], 99.5 + offset[1], lens)
    pose = Rigid.from_centre(rotation_from_rotvec(turn) @ CAMERA_AXES_FROM_SCANNER, centre)

    def pattern(y, z):
        return 127.5 + 80 * np.sin(9 * y) + 40 * np.cos(11 * z)

    rgb, mask = render_scan_colors(wall_scan(pattern), camera, pose)
    v, u = np.nonzero(mask)
    rays = camera.unproject(np.stack([u, v], axis=-1).astype(float)) @ pose.rotation
    depth = (3.0 - pose.centre[0] + 0.3 * pose.centre[1]) / (rays[:, 0] - 0.3 * rays[:, 1])
    points = pose.centre + rays * depth[:, None]
    expected = pattern(points[:, 1], points[:, 2])
    error = rgb[v, u, 0] - expected
    # Fit the shift that explains the error; what remains is quantisation of the colours.
    gradient = np.stack([720 * np.cos(9 * points[:, 1]), -440 * np.sin(11 * points[:, 2])], axis=-1) * (3.0 / 300)
    inner = mask[v, u] & (u > 2) & (v > 2) & (u < 237) & (v < 197)
    shift, *_ = np.linalg.lstsq(gradient[inner], error[inner], rcond=None)
    assert inner.sum() > 5000
    assert np.abs(shift).max() < 0.03
    assert np.quantile(np.abs(error[inner]), 0.99) < 2.0


def test_a_border_between_two_colors_lies_at_its_sub_pixel():
    """The mean of each row across a black and white border gives its position, which is known."""
    scan = wall_scan(lambda y, z: 255.0 * (y > 0.0), columns=400, step=0.002, lean=0.0)
    camera = Camera(200, 40, 500.0, 500.0, 99.5, 19.5)
    first = np.argmax(scan.points[80, :, 1] <= 0)  # colours change half way between two cells
    border_y = scan.points[80, first - 1 : first + 1, 1].mean()
    for shift in (0.0, 0.013, 0.21):
        pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.5, shift, 0.0))
        rgb, mask = render_scan_colors(scan, camera, pose)
        assert mask.all()
        bright = rgb[..., 0].sum(axis=1) / 255  # white is left, Y > 0
        u_border = 99.5 - 500 * (border_y - shift) / 2.5
        assert np.abs(bright - (u_border + 0.5)).max() < 0.05


def test_nothing_is_drawn_behind_the_camera_or_where_the_scan_ends():
    scan = wall_scan(lambda y, z: 0 * y + 200)
    camera = Camera.from_focal(64, 48, 60)
    behind = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (4.5, 0, 0))
    rgb, mask = render_scan_colors(scan, camera, behind, background=(10, 20, 30))
    assert not mask.any()
    assert (rgb == (10, 20, 30)).all()
    rgb, mask = render_scan_colors(scan, camera, Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0, 0, 0)))
    assert 0 < mask.sum() < mask.size
    assert (rgb[~mask].min(), rgb[24, 32, 0]) == (128, 200)


def test_hostile_input_is_named():
    scan = wall_scan(lambda y, z: 0 * y)
    bare = Scan(scan.geometry, scan.ranges, scan.intensity)
    camera = Camera.from_focal(64, 48, 60)
    with pytest.raises(ShapeError, match="no colour"):
        render_scan_colors(bare, camera, Rigid.identity())
    with pytest.raises(ShapeError, match="image"):
        render_scan_colors(bare, camera, Rigid.identity(), picture=np.zeros((3, 3, 3), np.uint8))
    with pytest.raises(OptionError, match="supersample"):
        render_scan_colors(scan, camera, Rigid.identity(), supersample=0)


@pytest.mark.slow
@pytest.mark.parametrize("distortion", [(), (-0.2, 0.05, 0.0, 0.0)])
def test_a_picture_to_be_looked_at_is_nearly_the_exact_one(distortion: tuple[float, ...]) -> None:
    case = simulated("boxes")
    camera = replace(case.true_camera, distortion=distortion)
    gray = intensity_picture(case.scan)
    inverse = np.nan_to_num(255 / (1 + case.scan.ranges)).astype(np.uint8)
    picture = np.stack([gray[..., 0], inverse, gray[..., 0]], axis=-1)
    exact, covered = render_scan_colors(case.scan, camera, case.camera_from_scanner, picture=picture, supersample=1)
    drawn, seen = render_scan_picture(case.scan, camera, case.camera_from_scanner, picture)
    assert (seen != covered).mean() < 0.03
    off = np.abs(drawn.astype(int) - exact)[seen & covered]
    assert np.median(off) <= 2  # interpolated between four cells instead of three
    assert np.percentile(off[:, 1], 98) <= 2  # no view through gaps of the mesh, no spikes
    assert (drawn[~seen] == 128).all()


def test_a_wide_camera_is_drawn_exactly() -> None:
    scan, camera = wall_scan(lambda y, z: 90 + 0 * y), FisheyeCamera(60, 60, 20, 20, 29.5, 29.5)
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.1, 0, 0))
    exact = render_scan_colors(scan, camera, pose, supersample=1)
    drawn = render_scan_picture(scan, camera, pose, np.full((*scan.shape, 3), 90, np.uint8))
    for mine, theirs in zip(drawn, exact, strict=True):
        np.testing.assert_array_equal(mine, theirs)
