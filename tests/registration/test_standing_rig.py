"""A rig that stands: the place counts as one, and what moves in it is evidence."""

from __future__ import annotations

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from testing.scenes.camera_rig import standing_rig, three_cameras

pytestmark = pytest.mark.timeout(1200)
CAMERAS = three_cameras()
_QUICK = lr.RigOptions(candidates_per_pair=1, refined=1)


@pytest.mark.long
def test_what_moves_before_a_rig_that_stands_is_evidence() -> None:
    """The place counts as one; the people in it stand elsewhere in every picture."""
    pytest.importorskip("embreex")
    camera = CAMERAS["ahead"]
    pairs = standing_rig(camera, moments=5, people=3, seed=8)
    truth = camera.camera_from_scanner
    turn = rotation_from_rotvec(np.radians([1.0, -1.0, 0.5]))
    initial = Rigid.from_centre(turn @ truth.rotation, truth.centre + np.array([0.05, -0.05, 0.05]))
    right = lr.register_rig(pairs, initial=initial, options=_QUICK)
    moved = [pair for pair in right.pairs if pair.outcome == "agrees" and "of what moved" in pair.sentence]
    assert len(moved) >= 2
    assert right.false_alarm < 1e-3
    moved_on = [
        lr.RigPair(pair.name, pair.scan, other.photo) for pair, other in zip(pairs, [*pairs[1:], pairs[0]], strict=True)
    ]
    wrong = lr.register_rig(moved_on, initial=initial, options=_QUICK)
    assert not wrong.accepted
    assert wrong.false_alarm > 0.01
