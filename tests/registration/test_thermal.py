"""Thermal images of simulated rooms: registered to two of their own pixels and labelled coarse, or refused."""

from __future__ import annotations

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.simulate import SimulatedCase
from testing.scenes.simulated import simulated

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def office() -> SimulatedCase:
    return simulated("office", set_name="thermal", seed=101)


def test_a_thermal_image_is_registered_and_labelled_coarse(office: SimulatedCase) -> None:
    result = lr.register(office.scan, office.photo)
    assert result.accepted, result.reasons
    points = office.scan.points[office.scan.valid][::29].astype(float)
    true = office.true_camera.project(office.camera_from_scanner @ points)
    off = (true - office.true_camera.project(result.camera_from_scanner @ points))[office.true_camera.contains(true)]
    assert np.median(np.hypot(*off.T)) <= 2
    assert result.diagnostics["verification"]["label"] == "coarse"


def test_a_thermal_image_of_another_room_is_refused(office: SimulatedCase) -> None:
    other = simulated("boxes", set_name="thermal", seed=101)
    result = lr.register(office.scan, other.photo)
    assert not result.accepted
    assert result.evidence == "none"
    expected = ("Not even coarsely", "No initial pose was found", "At the best candidate pose")
    assert any(reason.startswith(expected) for reason in result.reasons), result.reasons
