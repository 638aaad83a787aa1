"""The evidence of a rig whose lines are so far apart that no pair is sure by itself."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

import ladarreg_core as lr
from ladarreg_core.frames import Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.registration.rig.evidence import Jury, joint_alarm
from ladarreg_core.registration.rig.joint import JointPairs, PairViews
from ladarreg_core.simulate.outdoor_case import OutdoorCase, simulate_rig

PLACES = 5


@pytest.fixture(scope="module")
def dome() -> list[OutdoorCase]:
    pytest.importorskip("embreex")
    return simulate_rig("dome", pairs=PLACES, seed=1)


def alarm_of(cases: Sequence[OutdoorCase], photos: Sequence[Photo], pose: Rigid) -> float:
    options = lr.RigOptions()
    pairs = [lr.RigPair(str(k), case.scan, photo) for k, (case, photo) in enumerate(zip(cases, photos, strict=True))]
    joint = JointPairs([PairViews(pair, 0) for pair in pairs], pose)
    jury = Jury(joint, pairs, pose, unfit={}, alone=[False] * len(pairs), options=options)
    return joint_alarm([jury.judged(k, pose, on_others=True) for k in range(len(pairs))], options)


@pytest.mark.long
def test_every_further_place_lowers_the_probability_of_chance(dome: list[OutdoorCase]) -> None:
    pose, photos = dome[0].camera_from_scanner, [case.photo for case in dome]
    alarms = [alarm_of(dome[:count], photos[:count], pose) for count in (3, 4, 5)]
    assert alarms[0] > 1e3 * alarms[1] > 1e6 * alarms[2]
    assert alarms[2] < lr.RigOptions().false_alarm


@pytest.mark.long
def test_photos_of_other_places_are_chance(dome: list[OutdoorCase]) -> None:
    photos = [case.photo for case in dome]
    moved_on = [*photos[1:], photos[0]]
    assert alarm_of(dome, moved_on, dome[0].camera_from_scanner) > 0.01
