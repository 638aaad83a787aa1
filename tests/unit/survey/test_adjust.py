"""Surveys of one photograph or two in memory: the smallest that there are, and those in which nothing fits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import ladarreg_core as lr
from ladarreg_core.camera import Camera
from ladarreg_core.errors import Cancelled, OptionError
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import rotvec_from_rotation
from ladarreg_core.simulate.case import SimulatedCase
from ladarreg_core.survey.parts import SurveyCamera, SurveyPhoto


@pytest.fixture(scope="module")
def case() -> SimulatedCase:
    return lr.simulate_case("office", seed=2)


@pytest.mark.long
def test_one_photograph_on_one_scan_is_registered_as_by_itself(case: SimulatedCase) -> None:
    photo = replace(case.photo, name="photo")
    survey = lr.Survey.of([case.scan], [photo])
    unused = SurveyCamera(id="unused", source=Camera.from_focal(640, 480, 500.0))
    told: list[str] = []
    found = lr.adjust(
        replace(survey, cameras=(*survey.cameras, unused)), processes=1, report=lambda p: told.append(p.label)
    )
    assert found.accepted
    assert list(found.cameras) == ["camera-1"]
    (one,) = found.photos.values()
    truth = case.camera_from_scanner
    assert one.camera_from_world is not None
    turn = rotvec_from_rotation(truth.rotation @ one.camera_from_world.rotation.T)
    off = np.concatenate([turn, truth.centre - one.camera_from_world.centre])
    assert np.sqrt(off @ np.linalg.solve(one.covariance, off) / 6) < 3
    assert one.camera_from_world.distance_to(truth) < 0.02
    assert one.evidence == "image"
    assert 0.05 < one.sigma_px < 3
    assert not one.is_coarse
    assert one.ties == 0
    assert any("features" in label for label in told)
    assert found.document()["photos"][next(iter(found.photos))]["accepted"] is True


@pytest.mark.slow
def test_a_survey_stops_in_the_middle_of_a_registration(case: SimulatedCase) -> None:
    told: list[Progress] = []

    def stop(progress: Progress) -> None:
        registering = bool(told) and told[-1].label.startswith("features") and progress == told[-1]
        told.append(progress)
        if registering:  # it is told again while a worker is busy
            raise Cancelled

    with pytest.raises(Cancelled):
        lr.adjust(lr.Survey.of([case.scan], [replace(case.photo, name="photo")]), processes=1, report=stop)
    assert not any("on scan" in one.label for one in told)


@pytest.mark.long
def test_a_survey_in_which_nothing_fits_says_so(case: SimulatedCase) -> None:
    other = lr.simulate_case("boxes", seed=77)
    blank = replace(case.photo, pixels=np.full_like(case.photo.pixels, 120), name="blank")
    found = lr.adjust(lr.Survey.of([case.scan], [replace(other.photo, name="other"), blank]), processes=1)
    assert not found.accepted
    assert all(not one.accepted and one.reasons for one in found.photos.values())
    assert found.document()["chi2_per_dof"] is None or np.isfinite(found.document()["chi2_per_dof"])


@pytest.mark.slow
def test_a_survey_can_be_cancelled(case: SimulatedCase) -> None:
    def stop(_: lr.Progress) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        lr.adjust(lr.Survey.of([case.scan], [case.photo]), processes=1, report=stop)


def test_wrong_arguments_are_refused(case: SimulatedCase) -> None:
    with pytest.raises(OptionError, match="survey"):
        lr.adjust("folder")  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="processes"):
        lr.adjust(lr.Survey.of([case.scan], [case.photo]), processes=0)


def test_fixed_scans_without_a_pose_are_refused(case: SimulatedCase) -> None:
    from ladarreg_core.survey.parts import SurveyScan
    from ladarreg_core.survey.stations import place_stations

    scans = [case.scan, case.scan]
    given = [SurveyScan(id=name, source=case.scan, fixed=True) for name in ("hall", "office")]
    with pytest.raises(OptionError, match="office are fixed"):
        place_stations(given, scans)


@pytest.mark.parametrize(("exif", "given", "used"), [(1, False, 1), (6, False, 6), (2, False, 1), (6, True, 1)])
def test_the_orientation_of_a_camera_is_that_of_its_pixels(tmp_path: Path, exif: int, given: bool, used: int) -> None:
    from ladarreg_core.survey.inputs import _orientation

    header = Image.Exif()
    header[0x0112] = exif
    Image.fromarray(np.full((40, 60, 3), 99, np.uint8)).save(tmp_path / "photo.jpg", exif=header)
    camera = SurveyCamera(id="c", source=Camera.from_focal(60, 40, 50.0) if given else None)
    assert _orientation(SurveyPhoto(id="p", source=tmp_path / "photo.jpg", camera="c"), camera) == used
