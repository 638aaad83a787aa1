"""Turned descriptors are those of the turned picture, and a rolled view is what a rolled camera sees."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.features.channels import normalised_channels, raw_channels
from ladarreg_core.features.descriptors import describe
from ladarreg_core.frames import Rigid, ThesisParameters, look_along
from ladarreg_core.matching.roll import describe_rotated, rotate_pixels
from ladarreg_core.matching.views import rolled


def channels_of(picture: np.ndarray) -> np.ndarray:
    return normalised_channels(raw_channels([picture.astype(np.float32)]))


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    rng = np.random.default_rng(4)
    return np.kron(rng.uniform(0, 255, (20, 20)), np.ones((9, 9)))[:171, :171]


CORNERS = np.array([[60.0, 70.0], [85.0, 85.0], [110.0, 64.0], [90.0, 115.0]])


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_a_quarter_turned_picture_has_the_same_descriptors(picture: np.ndarray, quarters: int) -> None:
    upright = describe(channels_of(picture), CORNERS)
    turned_picture = np.ascontiguousarray(np.rot90(picture, -quarters))  # clockwise
    middle = (picture.shape[0] - 1) / 2
    angle = quarters * np.pi / 2
    corners = rotate_pixels(CORNERS - middle, angle) + middle
    turned = describe_rotated(channels_of(turned_picture), corners, angle)
    np.testing.assert_allclose(turned, upright, atol=0.02)


@settings(max_examples=20)
@given(angle_deg=st.floats(-360, 360), turns=st.integers(-2, 2))
def test_a_whole_turn_changes_nothing(angle_deg: float, turns: int) -> None:
    rng = np.random.default_rng(0)
    channels = rng.uniform(0, 1, (60, 60, 8)).astype(np.float32)
    angle = np.deg2rad(angle_deg)
    once = describe_rotated(channels, CORNERS / 3, angle, spacing_px=2.0)
    again = describe_rotated(channels, CORNERS / 3, angle + 2 * np.pi * turns, spacing_px=2.0)
    # A sample may round to the neighbouring pixel: nearly all stay.
    assert (np.abs(once - again) < 1e-3).mean() > 0.97


@given(roll_deg=st.floats(-179, 179), azimuth=st.floats(-3, 3), elevation=st.floats(-1, 1))
def test_a_rolled_view_is_that_of_a_rolled_camera(roll_deg: float, azimuth: float, elevation: float) -> None:
    forward = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    upright = Rigid(look_along(forward), np.zeros(3))
    view = rolled(upright, np.deg2rad(roll_deg))
    np.testing.assert_allclose(view.rotation[2], forward, atol=1e-9)
    assert np.degrees(ThesisParameters.from_pose(view).gamma) == pytest.approx(roll_deg, abs=1e-6)
