"""Channel selection for gray and thermal images of the painted room."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.frames import rotvec_from_rotation
from ladarreg_core.matching.images.scan_levels import ChannelSet
from ladarreg_core.matching.modality import is_gray
from ladarreg_core.matching.verify.verification import COARSE_GATE
from ladarreg_core.photo import thermal_photo
from testing.scenes.painted_room import PaintedRoom, painted_room


def gray_of(room: PaintedRoom) -> np.ndarray:
    return np.asarray(room.photo.pixels.astype(np.float32).mean(axis=-1))


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=5)


@pytest.fixture(scope="module")
def warm(room: PaintedRoom) -> lr.Registration:
    """The painted room as a thermal image, in which each paint has its own temperature."""
    kelvin = 292 + 0.02 * gray_of(room)
    return lr.register(room.scan, thermal_photo(kelvin, room.photo.camera))


@pytest.mark.slow
def test_a_thermal_image_is_registered_and_labelled_coarse(room: PaintedRoom, warm: lr.Registration) -> None:
    assert warm.accepted, warm.reasons
    assert room.error_px(warm.camera_from_scanner) < 1
    assert warm.diagnostics["verification"]["label"] == "coarse"
    assert any(reason.startswith("Coarse:") for reason in warm.reasons)


@pytest.mark.slow
def test_channels_are_selected_by_score_and_reported(warm: lr.Registration) -> None:
    chosen = [step.detail for step in warm.steps if step.name == "modality"]
    assert len(chosen) == 1
    name = chosen[0]["channels"]
    assert name in chosen[0]["accepted"]
    assert name in get_args(ChannelSet)
    assert warm.diagnostics["verification"]["channels"] == name
    scores = {k: chosen[0]["scores"][k]["fine_fraction"] for k in chosen[0]["accepted"]}
    assert scores[name] == max(scores.values())
    # Paint without relief: geometry alone cannot be what fits best.
    assert name != "geometry"


@pytest.mark.slow
def test_the_covariance_covers_the_disagreement_of_channels(warm: lr.Registration) -> None:
    """The finished poses of the accepted channel sets lie within the stated covariance."""
    ends = {}
    for step in warm.steps:
        if step.name == "evidence" and step.pose is not None:
            ends[len(ends)] = step.pose
    for pose in ends.values():
        d = np.concatenate(
            [
                rotvec_from_rotation(pose.rotation @ warm.camera_from_scanner.rotation.T),
                pose.centre - warm.camera_from_scanner.centre,
            ]
        )
        if np.linalg.norm(d[3:]) < 0.05:  # only accepted poses; a refused candidate may lie anywhere
            assert d @ np.linalg.solve(warm.covariance, d) <= len(ends)


@pytest.mark.slow
def test_a_thermal_image_of_another_room_is_refused(room: PaintedRoom) -> None:
    other = painted_room(seed=6)
    mirrored = gray_of(other)[::-1, ::-1]
    result = lr.register(room.scan, thermal_photo(292 + 0.02 * mirrored, other.photo.camera))
    assert not result.accepted
    assert result.evidence == "none"
    assert result.reasons


def test_a_gray_photo_verified_with_both_channels_needs_no_further_set(room: PaintedRoom) -> None:
    pixels = np.repeat(gray_of(room).astype(np.uint8)[..., None], 3, axis=-1)
    photo = lr.Photo(pixels, room.photo.camera)
    assert is_gray(photo)
    assert not is_gray(room.photo)
    result = lr.register(room.scan, photo)
    assert result.accepted, result.reasons
    assert [step.detail["channels"] for step in result.steps if step.name == "modality"] == ["both"]
    assert "label" not in result.diagnostics["verification"]
    assert room.error_px(result.camera_from_scanner) < 0.6


def test_a_uniform_temperature_is_refused(room: PaintedRoom) -> None:
    camera = room.photo.camera
    result = lr.register(room.scan, thermal_photo(np.full((camera.height, camera.width), 293.0), camera))
    assert not result.accepted
    assert any("uniform" in reason for reason in result.reasons)


def test_thermal_thresholds_require_at_least_half_of_the_regions() -> None:
    assert COARSE_GATE.fraction >= 0.5
    assert COARSE_GATE.many >= 35
    assert COARSE_GATE.fine_fraction >= 0.3
