"""The mount of a camera on a pan/tilt unit, from the photographs that it took there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.errors import ShapeError
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.registration.rig.unit_camera import UnitCamera, register_unit_camera
from ladarreg_core.scanner.pan_tilt import pan_tilt_pose
from testing.scenes.unit_camera import UnitCameraCase, simulate_unit_camera

pytest.importorskip("embreex")


@pytest.fixture(scope="module")
def case() -> UnitCameraCase:
    return simulate_unit_camera(8101)


@pytest.fixture(scope="module")
def found(case: UnitCameraCase) -> UnitCamera:
    return register_unit_camera(case.panorama, case.photos, case.units, is_scanner_mount_known=True)


def distance(found: UnitCamera, true: Rigid) -> float:
    """The Mahalanobis distance of the error, / sqrt 6."""
    assert found.unit_from_camera is not None
    pose = found.unit_from_camera.inverse
    turn = rotvec_from_rotation(true.inverse.rotation @ pose.rotation.T)
    error = np.concatenate([turn, true.inverse.centre - pose.centre])
    return float(np.sqrt(error @ np.linalg.solve(found.covariance, error) / 6))


@pytest.mark.slow
def test_the_mount_is_found_without_knowing_it(case: UnitCameraCase, found: UnitCamera) -> None:
    assert found.accepted, found.reasons
    assert distance(found, case.mount) < 2
    assert found.sigma_position_m < 0.04
    for unit, photo in zip(case.units, found.photos, strict=True):
        assert photo.outcome == "agrees"
        predicted, true = found.camera_from_world(unit), (unit @ case.mount).inverse
        assert predicted.distance_to(true) < 0.05
    told = found.as_dict()
    assert np.allclose(told["mount"], found.unit_from_camera.matrix if found.unit_from_camera else 0)
    assert told["said"].startswith("verified: 4 of 4 photographs agree")


@pytest.mark.slow
def test_a_photograph_of_another_stop_is_named_and_does_not_count(case: UnitCameraCase) -> None:
    units = [*case.units[:3], pan_tilt_pose(np.radians(40.0), np.radians(20.0))]  # 20 deg of tilt that the unit had not
    found = register_unit_camera(case.panorama, case.photos, units, initial=case.mount, is_scanner_mount_known=True)
    assert found.accepted
    assert [one.outcome for one in found.photos] == ["agrees", "agrees", "agrees", "disagrees"]
    assert np.degrees(found.photos[3].off_rad) == pytest.approx(20, abs=1)
    assert distance(found, case.mount) < 2


@pytest.mark.slow
def test_a_scanner_whose_mount_was_only_stated_makes_the_camera_uncertain(case: UnitCameraCase) -> None:
    two = register_unit_camera(case.panorama, case.photos[:2], case.units[:2], initial=case.mount)
    known = register_unit_camera(
        case.panorama, case.photos[:2], case.units[:2], initial=case.mount, is_scanner_mount_known=True
    )
    np.testing.assert_allclose(np.sqrt(np.diag(two.covariance - known.covariance))[3:], 0.012, rtol=1e-6)


@pytest.mark.slow
def test_one_position_alone_is_not_accepted(case: UnitCameraCase) -> None:
    found = register_unit_camera(case.panorama, case.photos[:1], case.units[:1], initial=case.mount)
    assert not found.accepted
    assert "one position" in found.reasons[0]
    assert found.unit_from_camera is not None


@pytest.mark.long
def test_photographs_of_another_room_give_no_mount() -> None:
    case = simulate_unit_camera(8102, photographs_of=8602)
    found = register_unit_camera(case.panorama, case.photos, case.units)
    assert not found.accepted
    with pytest.raises(ShapeError, match="no mount"):
        replace(found, unit_from_camera=None).camera_from_world(Rigid.identity())


@pytest.mark.slow
def test_each_photograph_needs_a_position(case: UnitCameraCase) -> None:
    with pytest.raises(ShapeError, match="4 photographs and 1 positions"):
        register_unit_camera(case.panorama, case.photos, case.units[:1])
