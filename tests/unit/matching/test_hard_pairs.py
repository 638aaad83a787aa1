"""Pairs that once led matching astray, each at the seed where it was found."""

from __future__ import annotations

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.simulate import simulate_case


def test_bricks_of_another_room_are_not_this_room() -> None:
    """Both rooms have a wall of the same bricks; nothing else agrees, and the next brick agrees nearly as well."""
    scan = simulate_case("office", seed=909).scan
    photo = simulate_case("people", set_name="hard", seed=910).photo
    result = lr.register(scan, photo)
    assert not result.accepted
    assert result.reasons


def test_a_roll_is_found_where_displacements_hardly_agree() -> None:
    case = simulate_case("office", set_name="rotated", seed=900)
    result = lr.register(case.scan, case.photo)
    assert result.accepted
    assert np.degrees(result.camera_from_scanner.angle_to(case.camera_from_scanner)) < 0.2


def test_a_lens_is_found_though_two_steps_do_not_doubt_the_stated_one() -> None:
    case = simulate_case("boxes", seed=902, k1=-0.15, k1_error=0.15)
    result = lr.register(case.scan, case.photo)
    assert result.accepted
    assert result.camera.distortion[0] == pytest.approx(-0.15, abs=0.03)
