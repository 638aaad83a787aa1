"""Surveys in a national grid: solved about an origin nearby, with results in the grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import SphericalGrid
from ladarreg_core.survey.local_world import adjustment_from, local_origin, scan_about, survey_about
from ladarreg_core.survey.parts import PosePrior

GRID = Rigid.from_rotvec([0.0, 0.0, 0.7], [500_123.25, 5_400_456.5, 120.1])


def _survey(world: Rigid | None) -> lr.Survey:
    geometry = SphericalGrid(6, 8, 0.02, 0.02, 0.0, 0.1)
    scan = Scan(geometry, np.full((6, 8), 3.0, np.float32), np.ones((6, 8), np.float32), world_from_scanner=world)
    camera = Camera.from_focal(40, 30, 50.0)
    return lr.Survey.of([scan], [Photo(np.zeros((30, 40, 3), np.uint8), camera)])


def test_the_origin_is_near_where_a_scanner_is_stated_to_stand() -> None:
    for world, origin in ((None, [0, 0, 0]), (Rigid(np.eye(3), np.array([900.0, 0, 0])), [0, 0, 0]),
                          (GRID, [500_123, 5_400_456, 120])):  # fmt: skip
        survey = _survey(world)
        assert local_origin(survey.scans, [one.source for one in survey.scans]).tolist() == origin
    far, near = _survey(GRID), _survey(Rigid.identity())
    given = (near.scans[0], replace(far.scans[0], id="b", fixed=True))
    assert local_origin(given, [one.source for one in given])[0] == 500_123, "what is fixed defines the world"


def test_what_is_known_beforehand_is_moved_to_the_origin() -> None:
    survey, origin = _survey(GRID), np.round(GRID.translation)
    pose = Rigid.from_rotvec([0.1, -0.2, 0.3], [0.0, 0.0, 1.0]) @ GRID.inverse
    prior = PosePrior(pose=pose, covariance=np.eye(6))
    survey = replace(
        survey,
        scans=(replace(survey.scans[0], world_from_scanner=GRID),),
        photos=(replace(survey.photos[0], initial=pose, prior=prior),),
    )
    local = survey_about(survey, origin)
    (scan,), (photo,) = local.scans, local.photos
    assert scan.world_from_scanner is not None
    assert photo.initial is not None
    assert photo.prior is not None
    np.testing.assert_allclose(scan.world_from_scanner.translation, GRID.translation - origin, atol=1e-9)
    np.testing.assert_allclose((photo.initial @ scan.world_from_scanner).matrix, (pose @ GRID).matrix, atol=1e-8)
    np.testing.assert_allclose(photo.prior.pose.centre, pose.centre - origin, atol=1e-8)
    moved = scan_about(survey.scans[0].source, origin)
    np.testing.assert_allclose(moved.world_from_scanner.matrix, scan.world_from_scanner.matrix)
    assert survey_about(survey, np.zeros(3)) is survey


@pytest.mark.long
def test_an_adjustment_is_the_same_wherever_its_world_begins() -> None:
    case = lr.simulate_case("office", seed=2)
    found = []
    for world in (Rigid.identity(), GRID):
        scan = replace(case.scan, world_from_scanner=world)
        found.append(lr.adjust(lr.Survey.of([scan], [replace(case.photo, name="photo")]), processes=1))
    (near,), (far,) = (list(one.photos.values()) for one in found)
    assert near.camera_from_world is not None
    assert far.camera_from_world is not None
    assert (far.camera_from_world @ GRID).distance_to(near.camera_from_world) < 1e-4
    np.testing.assert_allclose(far.sigma_position_m, near.sigma_position_m, rtol=0.02)
    (station,) = found[1].scans.values()
    assert station.world_from_scanner is not None
    np.testing.assert_allclose(station.world_from_scanner.matrix, GRID.matrix, atol=1e-9)
    assert adjustment_from(found[0], np.zeros(3)) is found[0]
