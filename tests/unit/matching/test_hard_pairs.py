"""Regression tests: pairs that were once registered wrongly, each with its seed."""

from __future__ import annotations

import numpy as np
import pytest

import ladarreg_core as lr
from testing.scenes.simulated import simulated

pytestmark = pytest.mark.slow


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 10, 19, 28, 31])
def test_a_room_with_the_same_bricks_is_refused(seed: int) -> None:
    """Both rooms have a wall of the same bricks; a shift by one brick agrees nearly as well, and nothing else does.

    Each seed draws other points to compare, as the rounding of another processor does.
    """
    scan = simulated("office", seed=909).scan
    photo = simulated("people", set_name="hard", seed=910).photo
    result = lr.register(scan, photo, options=lr.RegisterOptions(seed=seed))
    assert not result.accepted
    assert result.reasons


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_roll_is_detected_although_displacements_differ(seed: int) -> None:
    """Poses are found at two neighbouring rolls, of which chance decides the better."""
    case = simulated("office", set_name="rotated", seed=900)
    result = lr.register(case.scan, case.photo, options=lr.RegisterOptions(seed=seed))
    assert result.accepted
    assert np.degrees(result.camera_from_scanner.angle_to(case.camera_from_scanner)) < 0.2


def test_k1_is_estimated_although_the_preview_confirms_the_stated_camera() -> None:
    case = simulated("boxes", seed=902, k1=-0.15, k1_error=0.15)
    result = lr.register(case.scan, case.photo)
    assert result.accepted
    assert result.camera.distortion[0] == pytest.approx(-0.15, abs=0.03)
