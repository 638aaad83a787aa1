"""Simulated rooms: all of the standard set register, and no photograph of another room does."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.simulate import SimulatedCase, simulate_case

SCENES = ("boxes", "desk", "office", "people")


@cache
def case(scene: str, seed: int) -> SimulatedCase:
    return simulate_case(scene, seed=seed)


def displacement_px(made: SimulatedCase, pose: lr.Rigid) -> float:
    points = made.scan.points[made.scan.valid][::29].astype(float)
    true = made.photo.camera.project(made.camera_from_scanner @ points)
    seen = made.photo.camera.contains(true)
    return float(np.median(np.hypot(*(true - made.photo.camera.project(pose @ points))[seen].T)))


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("seed", [101, 202])
def test_the_standard_set(scene: str, seed: int) -> None:
    made = case(scene, seed)
    result = lr.register(made.scan, made.photo)
    assert result.accepted, result.reasons
    assert displacement_px(made, result.camera_from_scanner) < 0.6


@pytest.mark.parametrize("seed", [101, 202])
@pytest.mark.parametrize("scene", SCENES)
def test_photographs_of_other_rooms_are_refused(scene: str, seed: int) -> None:
    other = SCENES[(SCENES.index(scene) + 1) % len(SCENES)]
    result = lr.register(case(scene, seed).scan, case(other, seed).photo)
    assert not result.accepted
    assert result.evidence == "none"
    assert result.reasons
