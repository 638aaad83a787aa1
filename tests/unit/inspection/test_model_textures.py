"""Textures of the model agree with their legends."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.palette import UNKNOWN, VISIBILITY
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid
from ladarreg_core.inspection.model_textures import (
    model_texture,
    picture_without_z_buffer,
    small_picture,
    texture_choices,
    uniform_picture,
    usable_texture,
)
from ladarreg_core.inspection.surface_fields import (
    depth_error_field,
    residual_field,
    resolution_field,
    without_pepper,
)
from ladarreg_core.matches import Matches
from ladarreg_core.photo import Photo
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.texture.registered_texture import Label, texture_scan
from testing.scenes.painted_room import PaintedRoom, painted_room

KINDS = ("colour", "intensity", "range", "residual", "depth_error", "uncertainty", "resolution", "label")


def result_of(room: PaintedRoom, *, accepted: bool = True, residual_px: float = 0.5, count: int = 40) -> PoseResult:
    rng = np.random.default_rng(1)
    cells = np.flatnonzero(room.scan.valid)
    chosen = rng.choice(cells, count, replace=False)
    rays, ranges = room.scan.rays.reshape(-1, 3)[chosen], room.scan.ranges.reshape(-1)[chosen]
    return PoseResult(
        camera_from_scanner=room.camera_from_scanner,
        camera=room.photo.camera,
        matches=Matches(rays, ranges, rng.uniform(0, 300, (count, 2))),
        inliers=np.ones(count, bool),
        residuals_px=np.tile([residual_px, 0.0], (count, 1)),
        residuals_m=np.zeros(count),
        stereo_depth_error_m=np.zeros(count),
        covariance=np.diag([1e-7] * 3 + [1e-6] * 3),
        chi2_per_dof=1.0,
        sigma_px=0.5,
        sigma_range_m=0.01,
        accepted=accepted,
        evidence="statistics" if accepted else "none",
    )


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(3)


@pytest.fixture(scope="module")
def result(room: PaintedRoom) -> PoseResult:
    return result_of(room)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_covers_the_grid_and_has_a_legend(kind: str, room: PaintedRoom, result: PoseResult) -> None:
    texture = model_texture(room.scan, kind, photo=room.photo, result=result)
    assert texture.image.shape == (*room.scan.shape, 3)
    assert not texture.image.flags.writeable
    assert texture.legend.title
    assert texture.legend.ramp or texture.legend.entries
    assert not texture.legend.ramp or (texture.legend.least and texture.legend.most)


def test_labels_have_exactly_their_colors_and_the_legend_names_those_present(
    room: PaintedRoom, result: PoseResult
) -> None:
    registered = texture_scan(
        room.scan, room.photo, room.camera_from_scanner, camera=result.camera, covariance=np.asarray(result.covariance)
    )
    texture = model_texture(room.scan, "label", photo=room.photo, result=result)
    for label, color in zip(Label, VISIBILITY, strict=True):
        assert (texture.image[registered.labels == label] == color).all()
    present = {VISIBILITY[code] for code in np.unique(registered.labels) if code != Label.NO_RETURN}
    assert {color for color, _ in texture.legend.entries} == present
    assert {VISIBILITY[Label.OCCLUDED], VISIBILITY[Label.SEEN]} <= present


def test_without_the_z_buffer_occluded_cells_take_the_photo(room: PaintedRoom, result: PoseResult) -> None:
    """With the z-buffer they have none: thesis Figure 2.23."""
    camera, pose = room.photo.camera, room.camera_from_scanner
    labels = texture_scan(room.scan, room.photo, pose).labels
    hidden = labels == Label.OCCLUDED
    assert hidden.sum() > 500
    through = picture_without_z_buffer(room.scan, room.photo, result)
    uv = camera.project(pose @ room.scan.points)[hidden].astype(np.float32)
    smooth = cv2.remap(room.photo.pixels, uv[None, :, 0], uv[None, :, 1], cv2.INTER_LINEAR)[0]
    assert np.abs(through[hidden].astype(int) - smooth).max() <= 1
    solid = model_texture(room.scan, "colour", photo=room.photo, result=result).image
    seen = labels == Label.SEEN
    shadows = cv2.morphologyEx(hidden.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)) > 0
    assert shadows.sum() > 500
    assert np.ptp(solid[shadows], axis=-1).max() == 0, "what is hidden is gray, but for single cells"
    assert np.median(np.abs(through[seen].astype(int) - solid[seen])) <= 2
    outside = labels == Label.OUT_OF_FRAME
    np.testing.assert_array_equal(through[outside], solid[outside])


def test_nothing_behind_the_camera_is_colored(room: PaintedRoom, result: PoseResult) -> None:
    behind = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, [100.0, 0.0, 0.0])
    picture = picture_without_z_buffer(room.scan, room.photo, dataclasses.replace(result, camera_from_scanner=behind))
    assert np.ptp(picture, axis=-1).max() == 0


@settings(max_examples=20)
@given(st.lists(st.floats(0.25, 90.0, width=32), min_size=12, max_size=12))
def test_a_farther_cell_is_never_darker(metres: list[float]) -> None:
    """Viridis grows lighter monotonically."""
    ranges = np.array(metres, np.float32).reshape(3, 4)
    image = model_texture(Scan(AzimuthElevation(3, 4, 0.1, 0.1), ranges, np.ones((3, 4))), "range").image
    light = (image.astype(float) @ [0.2126, 0.7152, 0.0722]).ravel()
    assert (np.diff(light[np.argsort(ranges.ravel())]) >= -1.0).all()


@pytest.mark.parametrize("level", [0.01, 0.5, 7.0])
def test_equal_residuals_give_an_even_field(level: float, room: PaintedRoom) -> None:
    field = residual_field(room.scan, result_of(room, residual_px=level))
    known = np.isfinite(field)
    assert known.mean() > 0.5
    np.testing.assert_allclose(field[known], level, rtol=1e-4)


def test_the_field_follows_the_nearest_matches_and_ends_far_from_all(result: PoseResult) -> None:
    good, bad = np.array([[10, 10], [14, 13]]), np.array([[10, 290], [13, 285]])
    geometry = AzimuthElevation(30, 300, 0.002, 0.002)
    scan = Scan(geometry, np.full((30, 300), 3.0), np.ones((30, 300)))
    rays = geometry.ray_at(np.vstack([good, bad]).astype(float))
    four = dataclasses.replace(
        result,
        matches=Matches(rays, np.full(4, 3.0), np.zeros((4, 2))),
        inliers=np.ones(4, bool),
        residuals_px=np.array([[0.1, 0], [0, 0.1], [3.0, 0], [0, 3.0]]),
        stereo_depth_error_m=np.zeros(4),
    )
    field = residual_field(scan, four)
    assert field[10, 10] < 0.8 < 2.0 < field[10, 290]
    outlier = dataclasses.replace(four, inliers=np.array([True, True, False, False]))
    assert np.nanmax(residual_field(scan, outlier)) == pytest.approx(0.1, rel=1e-3)
    assert np.isnan(residual_field(scan, outlier)[10, 290])
    none = dataclasses.replace(four, inliers=np.zeros(4, bool))
    assert np.isnan(residual_field(scan, none)).all()
    picture = model_texture(scan, "residual", result=outlier)
    assert tuple(picture.image[10, 290]) == UNKNOWN


def test_a_less_certain_pose_is_never_darker(room: PaintedRoom, result: PoseResult) -> None:
    """Each scale ends at its own round number, so textures are compared by their values."""
    tight = model_texture(room.scan, "uncertainty", result=result)
    loose = dataclasses.replace(result, covariance=result.covariance * 100)
    ends = [float(t.legend.most.split()[0]) for t in (tight, model_texture(room.scan, "uncertainty", result=loose))]
    assert ends[1] == pytest.approx(10 * ends[0], rel=0.5)


def test_depth_errors_keep_their_sign_and_have_a_symmetric_scale(room: PaintedRoom, result: PoseResult) -> None:
    left = result.matches.rays[:, 1] > 0
    error = np.where(left, -0.02, 0.01)
    signed = dataclasses.replace(result, stereo_depth_error_m=np.where(np.arange(len(error)) == 0, np.nan, error))
    field = depth_error_field(room.scan, signed)
    known = np.isfinite(field)
    assert known.any()
    assert np.nanmin(field) == pytest.approx(-0.02, rel=0.05)
    assert np.nanmax(field) == pytest.approx(0.01, rel=0.05)
    texture = model_texture(room.scan, "depth_error", result=signed)
    assert texture.legend.least.startswith("-20 ")
    assert texture.legend.most.startswith("+20 ")
    assert len(texture.legend.ramp) % 2 == 1, "zero has a colour of its own"
    colors = texture.image.astype(int)
    assert (colors[field < -0.015] @ [1, 0, -1] < 0).all(), "negative is blue"
    assert (colors[field > 0.008] @ [1, 0, -1] > 0).all(), "positive is red"
    assert (colors[~known] == UNKNOWN).all()


def test_depth_errors_need_a_baseline(result: PoseResult) -> None:
    at_the_scanner = dataclasses.replace(result, stereo_depth_error_m=np.full(len(result.matches), np.nan))
    (choice,) = [c for c in texture_choices(at_the_scanner) if c.kind == "depth_error"]
    assert not choice.usable
    assert "beside the scanner" in choice.description


def test_the_resolution_is_that_of_a_wall_seen_straight_and_slantwise() -> None:
    camera = Camera.from_focal(200, 200, 400.0)
    geometry = AzimuthElevation(60, 80, 0.004, 0.004)
    for normal, across in (((1, 0, 0), 1.0), ((1, 1, 0), np.cos(np.pi / 4))):
        unit = np.array(normal) / np.linalg.norm(normal)
        ranges = 4.0 * unit[0] / (geometry.rays @ unit)
        scan = Scan(geometry, ranges, np.ones(geometry.shape))
        pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (1.0, 0.0, 0.0))
        result = PoseResult(
            camera_from_scanner=pose, camera=camera, matches=Matches.none(), inliers=np.zeros(0, bool),
            residuals_px=np.zeros((0, 2)), residuals_m=np.zeros(0), stereo_depth_error_m=np.zeros(0),
            covariance=np.eye(6), chi2_per_dof=1.0, sigma_px=1.0, sigma_range_m=0.01, accepted=True,
        )  # fmt: skip
        seen = np.zeros(geometry.shape, bool)
        seen[20:40, 30:50] = True
        field = resolution_field(scan, result, seen)
        assert (np.isfinite(field) == seen).all()
        centre = field[29:31, 39:41].mean()
        assert centre == pytest.approx(1000 * 3.0 / 400 / np.sqrt(across), rel=0.01)


def test_single_unseen_cells_take_the_color_around_them_and_shadows_stay() -> None:
    picture = np.full((40, 40, 3), (200, 100, 50), np.uint8)
    known = np.ones((40, 40), bool)
    known[5, 5] = known[20, 7] = known[20, 8] = False
    known[10:20, 20:30] = False  # a shadow
    known[30, 30] = False
    picture[~known] = 30
    fillable = ~known
    fillable[30, 30] = False  # outside the photograph, say
    filled = without_pepper(picture, known, fillable)
    for row, column in ((5, 5), (20, 7), (20, 8)):
        np.testing.assert_array_equal(filled[row, column], (200, 100, 50))
    assert (filled[10:20, 20:30] == 30).all()
    assert (filled[30, 30] == 30).all()
    assert (filled[known] == picture[known]).all()
    np.testing.assert_array_equal(without_pepper(picture, np.ones_like(known), fillable), picture)


def test_a_legend_is_ready_for_the_page(room: PaintedRoom, result: PoseResult) -> None:
    fields = model_texture(room.scan, "uncertainty", result=result).legend.as_fields()
    assert fields["title"] == "Standard deviation of the photo position, px"
    assert fields["entries"] == [{"colour": "#3e444f", "label": "no data"}]
    assert fields["ramp"][0] == "#440154"
    assert fields["least"] == "0"


def test_a_pose_that_is_not_accepted_colors_nothing(room: PaintedRoom, result: PoseResult) -> None:
    refused = result_of(room, accepted=False)
    for kind in set(KINDS) - {"intensity", "range"}:
        assert usable_texture(kind, None) == usable_texture(kind, refused) == "intensity"
        assert usable_texture(kind, result) == kind
        with pytest.raises(OptionError, match="accepted"):
            model_texture(room.scan, kind, photo=room.photo, result=refused)
    assert [c.kind for c in texture_choices(None)] == list(KINDS)
    assert {c.kind for c in texture_choices(refused) if c.usable} == {"intensity", "range"}
    assert all(c.usable for c in texture_choices(result))


def test_invalid_arguments_are_refused(room: PaintedRoom, result: PoseResult) -> None:
    with pytest.raises(OptionError, match="one of colour"):
        model_texture(room.scan, "glitter")
    with pytest.raises(OptionError, match="photograph"):
        model_texture(room.scan, "colour", result=result)
    other = Photo(np.zeros((10, 10, 3), np.uint8), Camera.from_focal(10, 10, 20.0))
    with pytest.raises(ShapeError, match="camera of this size"):
        picture_without_z_buffer(room.scan, other, result)
    small = texture_scan(room.scan, room.photo, room.camera_from_scanner)
    cut = dataclasses.replace(small, image=small.image[:9], labels=small.labels[:9])
    with pytest.raises(ShapeError, match="cells"):
        model_texture(room.scan, "colour", photo=room.photo, result=result, registered=cut)


def test_small_pictures_keep_their_shape_and_mean() -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (300, 900, 3)).astype(np.uint8)
    small = small_picture(picture, 300)
    assert small.shape == (100, 300, 3)
    assert abs(float(small.mean()) - float(picture.mean())) < 1
    assert small_picture(picture, 5000).shape == picture.shape
    assert (uniform_picture((1, 2, 3)) == [1, 2, 3]).all()


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_a_scan_without_intensity_shows_its_shape(lean: float, tilt: float) -> None:
    """The cosine of the incidence angle on a plane is known."""
    geometry = AzimuthElevation(30, 40, 0.004, 0.004)
    normal = np.array([1.0, lean, tilt])
    scan = Scan(geometry, 3.0 / (geometry.rays @ normal), np.ones((30, 40)))
    texture = model_texture(scan, "intensity")
    assert "no intensity" in texture.legend.title
    cosine = (geometry.rays @ normal) / np.linalg.norm(normal)
    expected = 18 + 227 * cosine
    assert np.abs(texture.image[1:-1, 1:-1, 0] - expected[1:-1, 1:-1]).max() < 2
