from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.matching.images.kept_channels import forget_last_view, recall_view
from ladarreg_core.matching.images.pair import PairLevels
from ladarreg_core.matching.images.views import viewing_directions
from testing.scenes.painted_room import PaintedRoom, painted_room


@pytest.fixture(scope="module")
def case() -> PaintedRoom:
    return painted_room(seed=2)


def kept_of(scan: lr.Scan, photo: lr.Photo, *, coarse: bool = False) -> object:
    pair = PairLevels(scan, photo)
    direction = viewing_directions(scan, pair.working)[0]
    return recall_view(None, scan, pair.working, direction, "both", coarse=coarse, harmonics=pair.harmonics)


def test_a_second_photo_on_a_scan_gets_the_same_result_from_what_was_kept(case: PaintedRoom) -> None:
    forget_last_view()
    first = lr.register(case.scan, case.photo)
    assert kept_of(case.scan, case.photo) is not None
    second = lr.register(case.scan, case.photo)
    assert first.accepted
    np.testing.assert_array_equal(second.camera_from_scanner.matrix, first.camera_from_scanner.matrix)
    np.testing.assert_array_equal(second.covariance, first.covariance)
    assert [step.detail for step in second.steps] == [step.detail for step in first.steps]


def test_only_the_same_scan_and_camera_get_what_was_kept(case: PaintedRoom) -> None:
    lr.register(case.scan, case.photo)
    camera = case.photo.camera
    longer = replace(case.photo, camera=replace(camera, fx=camera.fx + 1, fy=camera.fy + 1))
    assert kept_of(case.scan, longer) is None
    assert kept_of(case.scan, case.photo, coarse=True) is None
    assert kept_of(replace(case.scan), case.photo) is None
    assert kept_of(case.scan, case.photo) is not None


@pytest.mark.slow
def test_what_was_kept_does_not_hold_the_scan(case: PaintedRoom) -> None:
    scan, photo = replace(case.scan), case.photo
    lr.register(scan, photo)
    alive = weakref.ref(scan)
    del scan
    gc.collect()
    assert alive() is None
