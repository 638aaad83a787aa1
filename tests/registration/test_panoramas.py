"""Photographs of wide cameras, registered through their faces: accepted and right, or refused."""

from __future__ import annotations

import numpy as np
import pytest

import ladarreg_core as lr

pytest.importorskip("embreex")

from ladarreg_core.camera import EquirectangularCamera
from ladarreg_core.simulate.panorama import PanoramaCase, PanoramaOptions
from testing.scenes.simulated import all_around

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def case() -> PanoramaCase:
    # the seam of this panorama runs through the subject
    return all_around("boxes", seed=3, options=PanoramaOptions(width=1024, step_deg=0.3, seam=True))


def test_a_panorama_is_registered_in_its_own_pixels(case: PanoramaCase) -> None:
    result = lr.register(case.scan, case.photo)
    assert result.accepted
    assert result.evidence == "image"
    assert isinstance(result.camera, EquirectangularCamera)
    pose, truth = result.camera_from_scanner, case.camera_from_scanner
    assert np.degrees(pose.angle_to(truth)) < 0.1  # a pixel is .35 deg
    assert pose.distance_to(truth) < 0.006
    assert len(result.matches) > 40
    # the matches were found in faces, but are the panorama's own: the true pose projects their points there
    off = np.linalg.norm(case.photo.camera.difference(case.photo.camera.project(truth @ result.matches.points),
                                                      result.matches.uv), axis=-1)  # fmt: skip
    assert np.median(off) < 0.5
    assert np.ptp(result.matches.uv[:, 0]) > 900  # on both sides of the seam
    blocks = result.blocks
    assert blocks is not None
    place = {name: k for k, name in enumerate(blocks.ids)}
    kept = [k for k, name in enumerate(result.matches.pick_ids) if name in place]
    assert len(kept) > 0.9 * len(result.matches)  # those at the seam have no block
    of_match = [place[result.matches.pick_ids[k]] for k in kept]
    np.testing.assert_array_equal(blocks.agrees[of_match], result.inliers[kept])
    apart = case.photo.camera.difference(blocks.uv[of_match], result.matches.uv[kept])
    assert np.median(np.linalg.norm(apart, axis=-1)) < 1
    assert np.abs(blocks.offset_px).max() < 100


@pytest.mark.long
def test_a_panorama_of_another_room_is_refused(case: PanoramaCase) -> None:
    room = all_around("desk", seed=8, options=PanoramaOptions(width=64, step_deg=0.3))
    result = lr.register(room.scan, case.photo)
    assert not result.accepted
    assert result.evidence == "none"
