"""Roll of the photo against the view: detection, rotated descriptors, rolled views."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.errors import LadarregError, OptionError, ShapeError
from ladarreg_core.frames import Rigid, ThesisParameters, look_along
from ladarreg_core.matching.features.channels import normalised_channels, raw_channels
from ladarreg_core.matching.features.corners import CornerOptions, find_corners
from ladarreg_core.matching.features.descriptors import describe
from ladarreg_core.matching.images.photo_levels import photo_levels, working_camera
from ladarreg_core.matching.images.scan_levels import scan_levels
from ladarreg_core.matching.images.views import rolled_view
from ladarreg_core.matching.search.roll import Roll, describe_rotated, detect_roll, rotate_pixels
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import perspective_view
from testing.scenes.painted_room import PaintedRoom, painted_room
from testing.scenes.simulated import simulated

CORNERS = CornerOptions(count=400)
NO_CORNERS = np.zeros((0, 2))


@dataclass(frozen=True)
class Picture:
    gray: np.ndarray
    corners: np.ndarray

    @staticmethod
    def of(gray: np.ndarray, usable: np.ndarray | None = None) -> Picture:
        return Picture(gray, find_corners(gray, CORNERS, usable=usable).uv)


def sides(scan: Scan, photo: Photo) -> tuple[Picture, Picture]:
    working = working_camera(scan, photo.camera)
    levels = scan_levels(scan, perspective_view(scan, working))
    seen = photo_levels(photo, working)
    return Picture.of(levels.gray_planes[0], np.isfinite(levels.ranges)), Picture.of(seen.gray, seen.usable[0])


def roll_of(scan: Picture, photo: Picture) -> Roll | None:
    return detect_roll(scan.gray, scan.corners, photo.gray, photo.corners)


def off_deg(roll: Roll, expected_deg: float) -> float:
    return abs((np.degrees(roll.angle_rad) - expected_deg + 180) % 360 - 180)


def quarter_turned(photo: Photo, quarters: int) -> Photo:
    """Return the photo of a camera rolled clockwise by a number of quarter turns."""
    pixels = np.ascontiguousarray(np.rot90(photo.pixels, quarters))
    return Photo(pixels, Camera.from_focal(pixels.shape[1], pixels.shape[0], photo.camera.focal_px))


def rolled(gray: np.ndarray, angle_deg: float) -> np.ndarray:
    """Return the image of a camera rolled clockwise: the content rotates counter-clockwise."""
    height, width = gray.shape
    counter_clockwise = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle_deg, 1)
    return cv2.warpAffine(gray, counter_clockwise, (width, height), borderMode=cv2.BORDER_REFLECT)


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=11)


@pytest.mark.slow
@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_roll_by_quarter_turns_is_detected(room: PaintedRoom, quarters: int) -> None:
    roll = roll_of(*sides(room.scan, quarter_turned(room.photo, quarters)))
    if quarters == 0:
        assert roll is None
    else:
        assert roll is not None
        assert off_deg(roll, 90 * quarters) < 6
        assert roll.matches > roll.upright_matches


@settings(max_examples=8)
@given(angle_deg=st.floats(-180, 180), seed=st.integers(0, 9))
def test_roll_is_detected_with_its_sign(angle_deg: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    patches = cv2.resize(rng.uniform(0, 255, (45, 60)).astype(np.float32), (360, 270), interpolation=cv2.INTER_CUBIC)
    laser = 0.6 * patches + rng.normal(0, 6, patches.shape)
    roll = roll_of(Picture.of(laser.astype(np.float32)), Picture.of(rolled(patches, angle_deg)))
    if abs(angle_deg) <= 7:
        assert roll is None
    elif abs(angle_deg) >= 23:
        assert roll is not None
    if roll is not None:
        assert off_deg(roll, angle_deg) < 5
        assert ("counter-clockwise" in roll.summary()) == (roll.angle_rad < 0)


@pytest.mark.slow
def test_roll_of_a_simulated_camera_is_detected() -> None:
    pytest.importorskip("embreex")
    case = simulated("people", set_name="rotated", seed=4)
    gamma = np.degrees(ThesisParameters.from_pose(case.camera_from_scanner).gamma)
    scan, photo = sides(case.scan, case.photo)
    roll = roll_of(scan, photo)
    assert roll is not None
    assert off_deg(roll, gamma) < 8
    # After rotating the photo back, no roll is detected.
    assert roll_of(scan, Picture.of(rolled(photo.gray, -gamma))) is None


def test_a_mirrored_photo_gives_no_roll(room: PaintedRoom) -> None:
    scan, photo = sides(room.scan, room.photo)
    for mirrored in (photo.gray[::-1], photo.gray[:, ::-1]):
        assert roll_of(scan, Picture.of(np.ascontiguousarray(mirrored))) is None


def test_equal_inputs_give_equal_rolls(room: PaintedRoom) -> None:
    scan, photo = sides(room.scan, quarter_turned(room.photo, 1))
    one, other = roll_of(scan, photo), roll_of(scan, photo)
    assert one is not None
    assert one == other


@pytest.mark.parametrize("count", [0, 1, 3])
@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (30, 40)])
def test_too_few_corners_or_pixels_give_no_roll(count: int, shape: tuple[int, int]) -> None:
    picture = Picture(np.zeros(shape, np.float32), np.zeros((count, 2)))
    assert roll_of(picture, picture) is None
    assert roll_of(picture, Picture(picture.gray, NO_CORNERS)) is None


GRAY = np.zeros((20, 30), np.float32)


@pytest.mark.parametrize(
    ("gray", "uv", "options", "error"),
    [
        (np.zeros((20, 30, 3)), NO_CORNERS, {}, ShapeError),
        (np.zeros((0, 30)), NO_CORNERS, {}, ShapeError),
        (np.full((20, 30), np.nan), NO_CORNERS, {}, ShapeError),
        (GRAY, np.zeros((3, 3)), {}, ShapeError),
        (GRAY, [[np.nan, 1.0]], {}, ShapeError),
        (GRAY, "corners", {}, ShapeError),
        (GRAY, NO_CORNERS, {"window_px": 8}, OptionError),
        (GRAY, NO_CORNERS, {"margin": -1.0}, OptionError),
        (GRAY, NO_CORNERS, {"margin": np.nan}, OptionError),
    ],
)
def test_invalid_input_raises_a_one_line_error(
    gray: np.ndarray, uv: np.ndarray, options: dict[str, float], error: type[LadarregError]
) -> None:
    for sides_given in ((gray, uv, GRAY, NO_CORNERS), (GRAY, NO_CORNERS, gray, uv)):
        with pytest.raises(error) as caught:
            detect_roll(*sides_given, **options)
        assert "\n" not in str(caught.value)


def test_the_summary_states_the_direction_of_rotation() -> None:
    words = Roll(angle_rad=np.pi / 2, matches=40, upright_matches=4).summary()
    assert "90 deg clockwise" in words
    assert "Rotate the photo clockwise" in words
    assert "counter" not in words
    assert words.replace("clockwise", "counter-clockwise") == Roll(-np.pi / 2, 40, 4).summary()


def channels_of(picture: np.ndarray) -> np.ndarray:
    return normalised_channels(raw_channels([picture.astype(np.float32)]))


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    rng = np.random.default_rng(4)
    return np.kron(rng.uniform(0, 255, (20, 20)), np.ones((9, 9)))[:171, :171]


POINTS = np.array([[60.0, 70.0], [85.0, 85.0], [110.0, 64.0], [90.0, 115.0]])


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_descriptors_of_a_rotated_image_are_equal(picture: np.ndarray, quarters: int) -> None:
    upright = describe(channels_of(picture), POINTS)
    turned_picture = np.ascontiguousarray(np.rot90(picture, -quarters))  # clockwise
    middle = (picture.shape[0] - 1) / 2
    angle = quarters * np.pi / 2
    corners = rotate_pixels(POINTS - middle, angle) + middle
    turned = describe_rotated(channels_of(turned_picture), corners, angle)
    np.testing.assert_allclose(turned, upright, atol=0.02)


@pytest.mark.parametrize("degrees", [-50, -20, 20, 35])
def test_descriptors_of_an_image_rotated_by_any_angle_agree(picture: np.ndarray, degrees: int) -> None:
    middle, angle = (picture.shape[0] - 1) / 2, np.deg2rad(degrees)
    smooth = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 1.5)
    # OpenCV's angles are counter-clockwise.
    turned_picture = cv2.warpAffine(smooth, cv2.getRotationMatrix2D((middle, middle), -degrees, 1), smooth.shape[::-1])
    at = POINTS - 2 * (POINTS - middle) / 3
    upright = describe(channels_of(smooth), at)
    corners = rotate_pixels(at - middle, angle) + middle
    rotated, unrotated = (describe_rotated(channels_of(turned_picture), corners, a) for a in (angle, -angle))
    assert (upright * rotated).sum(axis=1).min() > 0.9
    assert (upright * unrotated).sum(axis=1).max() < 0.6


@settings(max_examples=20)
@given(angle_deg=st.floats(-360, 360), turns=st.integers(-2, 2))
def test_descriptors_are_periodic(angle_deg: float, turns: int) -> None:
    rng = np.random.default_rng(0)
    channels = rng.uniform(0, 1, (60, 60, 5)).astype(np.float32)
    angle = np.deg2rad(angle_deg)
    once = describe_rotated(channels, POINTS / 3, angle, spacing_px=2.0)
    again = describe_rotated(channels, POINTS / 3, angle + 2 * np.pi * turns, spacing_px=2.0)
    # A sample may be rounded to the neighbouring pixel; nearly all are equal.
    assert (np.abs(once - again) < 1e-3).mean() > 0.97


@given(roll_deg=st.floats(-179, 179), azimuth=st.floats(-3, 3), elevation=st.floats(-1, 1))
def test_a_rolled_view_has_the_roll_of_the_camera(roll_deg: float, azimuth: float, elevation: float) -> None:
    forward = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    upright = Rigid(look_along(forward), np.zeros(3))
    view = rolled_view(upright, np.deg2rad(roll_deg))
    np.testing.assert_allclose(view.rotation[2], forward, atol=1e-9)
    assert np.degrees(ThesisParameters.from_pose(view).gamma) == pytest.approx(roll_deg, abs=1e-6)
