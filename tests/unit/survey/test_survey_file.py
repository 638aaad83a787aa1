"""`survey.json`: what is written is read, and every fault is told at once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.camera import Camera
from ladarreg_core.errors import ExportError, FormatError, OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.survey.parts import (
    PosePrior,
    RigMember,
    ScanLine,
    SurveyCamera,
    SurveyLine,
    SurveyPhoto,
    SurveyScan,
    SurveyTie,
)
from ladarreg_core.survey.survey import Survey


@pytest.fixture
def files(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    for name in ("hall.npz", "office.npz", "photos/1.jpg", "photos/2.jpg", "camera.json", "matches.json"):
        (tmp_path / name).write_bytes(b"x")
    return tmp_path


def _survey(folder: Path) -> Survey:
    pose = Rigid.from_rotvec([0.1, -0.2, 0.3], [1.0, 2.0, 3.0])
    return Survey(
        scans=(
            SurveyScan(id="hall", source=folder / "hall.npz", index=2, world_from_scanner=pose, fixed=True),
            SurveyScan(id="office", source=folder / "office.npz", options={"intensity": "luma"}),
        ),
        cameras=(
            SurveyCamera(id="phone", options={"focal_px": 800.0}, estimate=("focal_px", "k1")),
            SurveyCamera(id="fixed", source=Camera.from_focal(640, 480, 500.0), estimate="none"),
            SurveyCamera(id="lab", source=folder / "camera.json"),
        ),
        photos=(
            SurveyPhoto(id="one", source=folder / "photos/1.jpg", camera="phone", initial=pose,
                        matches=folder / "matches.json"),
            SurveyPhoto(id="two", source=folder / "photos/2.jpg", camera="fixed",
                        prior=PosePrior(pose=pose, covariance=np.eye(6) * 1e-4),
                        rig=RigMember(id="car", frame="7", sensor="left")),
            SurveyPhoto(id="three", source=folder / "photos/2.jpg", camera="lab",
                        prior=PosePrior(pose=Rigid.from_centre(np.eye(3), [4.0, 5.0, 6.0]),
                                        covariance=np.diag([np.inf] * 3 + [0.01] * 3))),
        ),
        rigs={"car": {"front": None, "left": pose}},
        ties=(
            SurveyTie(id="t1", photos=("one", "two"), uv=((1.5, 2.0), (30.0, 40.25)), sigma_px=0.4),
            SurveyTie(id="t2", photos=("three", "one"), uv=((3.0, 4.0), (5.0, 6.0))),
        ),
        lines=(
            SurveyLine(id="l1", photos=("one", "two", "three"), sigma_px=0.7,
                       uv=(((1.5, 2.0), (30.0, 40.25)), ((3.0, 4.0), (5.0, 60.0)), ((0.0, 9.0), (90.0, 9.0)))),
            SurveyLine(id="l2", photos=("two",), uv=(((1.0, 2.0), (30.0, 40.0)),),
                       in_scan=ScanLine(scan="hall", xyz=((1.0, 2.0, 3.0), (1.0, 2.5, 3.0)), sigma_m=0.004)),
        ),
    )  # fmt: skip


def test_what_is_written_is_read(files: Path) -> None:
    survey = _survey(files)
    survey.to_file(files / "survey.json")
    stated = json.loads((files / "survey.json").read_text())
    assert stated["photos"][0]["path"] == "photos/1.jpg"
    read = Survey.from_file(files / "survey.json")
    assert [one.id for one in read.scans] == ["hall", "office"]
    assert (read.scans[0].index, read.scans[0].fixed, read.scans[1].options) == (2, True, {"intensity": "luma"})
    assert [one.estimate for one in read.cameras] == [("focal_px", "k1"), "none", "auto"]
    assert read.cameras[1].source == Camera.from_focal(640, 480, 500.0)
    assert read.photos[0].initial is not None
    np.testing.assert_allclose(read.photos[0].initial.matrix, survey.photos[0].initial.matrix, atol=1e-12)  # type: ignore[union-attr]
    assert read.photos[1].rig == survey.photos[1].rig
    position = read.photos[2].prior
    assert position is not None
    assert position.is_position
    np.testing.assert_allclose(position.pose.centre, [4, 5, 6])
    np.testing.assert_allclose(np.diag(position.covariance)[3:], 0.01)
    assert list(read.rigs["car"]) == ["front", "left"]
    assert read.ties == survey.ties
    assert read.ties[1].sigma_px == 1.0
    assert read.lines == survey.lines
    read.to_file(files / "again.json")
    assert json.loads((files / "again.json").read_text()) == stated


def test_all_faults_are_told_at_once(files: Path) -> None:
    _survey(files).to_file(files / "survey.json")
    fields = json.loads((files / "survey.json").read_text())
    fields["scans"][0]["path"] = "nowhere.npz"
    fields["scans"][1]["id"] = "hall"
    fields["cameras"][0]["estimate"] = ["focal", "k9"]
    fields["cameras"][1]["camera"]["fx"] = -3
    fields["photos"][0]["camera"] = "unknown"
    fields["photos"][1]["rig"]["sensor"] = "rear"
    fields["photos"][2]["prior"]["sigma_m"] = 0
    fields["photos"][2]["colour"] = "red"
    (files / "survey.json").write_text(json.dumps(fields))
    with pytest.raises(FormatError) as caught:
        Survey.from_file(files / "survey.json")
    text = str(caught.value)
    for words in (
        "nowhere.npz", "2 scans have the id 'hall'", "'k9'", "camera fixed", "'unknown'", "'rear'", "sigma_m",
        "unknown fields colour", "8 faults", "nothing was done",
    ):  # fmt: skip
        assert words in text, (words, text)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"photos": ["one", "nobody"]}, "tie t1 names the photo 'nobody', which is not listed"),
        ({"photos": ["one", "one"]}, "tie t1 names the photo 'one' twice"),
        ({"photos": ["one"]}, "tie t1: its photos must be the ids of two"),
        ({"uv": [[1, 2]]}, "tie t1: its uv must be two pixels"),
        ({"sigma_px": 0}, "tie t1 has the sigma_px 0"),
        ({"sigma_px": "fine"}, "tie t1: its sigma_px is 'fine'"),
        ({"id": "t2"}, "2 ties have the id 't2'"),
        ({"weight": 1}, "unknown fields weight"),
    ],
)
def test_faults_of_ties_are_told(files: Path, changes: dict[str, Any], words: str) -> None:
    _survey(files).to_file(files / "survey.json")
    fields = json.loads((files / "survey.json").read_text())
    fields["ties"][0] |= changes
    (files / "survey.json").write_text(json.dumps(fields))
    with pytest.raises(FormatError, match="1 fault") as caught:
        Survey.from_file(files / "survey.json")
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"photos": ["one", "nobody", "three"]}, "line l1 names the photo 'nobody', which is not listed"),
        ({"photos": ["one", "one", "two"]}, "line l1 must name 2 or more photos, each of them once"),
        ({"photos": ["one"], "uv": [[[1, 2], [30, 4]]]}, "line l1 must name 2 or more photos, each of them once"),
        ({"photos": ["one"]}, "line l1: its uv must be two pixels for each of its photos"),
        ({"photos": "one"}, "line l1: its photos must be a list of ids"),
        ({"uv": [[[1, 2], [3, 4]]] * 3}, "line l1 is shorter than 5 px in one of its photos"),
        ({"sigma_px": 0}, "line l1 has the sigma_px 0"),
        ({"sigma_px": "fine"}, "line l1: its sigma_px is 'fine'"),
        ({"id": "l2"}, "2 lines have the id 'l2'"),
        ({"weight": 1}, "unknown fields weight"),
        ({"scan": {"id": "cellar", "xyz": [[1, 2, 3], [1, 2, 4]]}}, "line l1 names the scan 'cellar'"),
        ({"scan": {"id": "hall", "xyz": [[1, 2, 3]]}}, "line l1: the xyz of its scan must be two places"),
        ({"scan": {"id": "hall", "xyz": [[1, 2, 3], [1, 2, 3]]}}, "line l1 is shorter than 10 mm in its scan"),
        (
            {"scan": {"id": "hall", "xyz": [[1, 2, 3], [1, 2, 4]], "sigma_m": 0}},
            "line l1 has the sigma_m 0 in its scan",
        ),
        ({"scan": {"xyz": [[1, 2, 3], [1, 2, 4]]}}, "line l1: its scan must have an id and xyz"),
    ],
)
def test_faults_of_lines_are_told(files: Path, changes: dict[str, Any], words: str) -> None:
    _survey(files).to_file(files / "survey.json")
    fields = json.loads((files / "survey.json").read_text())
    fields["lines"][0] |= changes
    (files / "survey.json").write_text(json.dumps(fields))
    with pytest.raises(FormatError, match="1 fault") as caught:
        Survey.from_file(files / "survey.json")
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "JSON"),
        ('{"version": 7}', "version 7"),
        ('{"version": 1}', "no scans"),
        ('{"version": 1, "scans": 3, "photos": [1]}', "list of objects"),
        ('{"version": 1, "scans": [{"path": "a"}], "photos": []}', "no id"),
    ],
)
def test_files_that_are_no_surveys_are_refused(tmp_path: Path, content: str, words: str) -> None:
    (tmp_path / "survey.json").write_text(content)
    with pytest.raises(FormatError, match=words):
        Survey.from_file(tmp_path / "survey.json")


@pytest.mark.slow
def test_a_survey_in_memory_has_no_file(tmp_path: Path) -> None:
    case = lr.simulate_case("office", seed=1)
    survey = Survey.of([case.scan], [case.photo, case.photo], cameras=[0, 0])
    assert [one.id for one in survey.photos] == ["office-1", "office-1-2"] or len(
        {one.id for one in survey.photos}
    ) == 2
    assert len(survey.cameras) == 1
    with pytest.raises(ExportError, match="no file"):
        survey.to_file(tmp_path / "survey.json")
    with pytest.raises(OptionError, match="give one for each"):
        Survey.of([case.scan], [case.photo], cameras=[0, 1])


def test_an_empty_folder_is_no_survey(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="no scan"):
        Survey.from_folder(tmp_path)
