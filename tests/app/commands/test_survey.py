"""A survey from a folder to results: the commands, what they write, and what happens when they are stopped."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ladarreg.cli import main

import ladarreg_core as lr
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.simulate.sample import sample_survey_folder
from testing.scenes.shared_places import shared_places
from testing.scenes.survey_set import SurveySet, simulate_survey, write_survey_set

pytest.importorskip("embreex")
pytestmark = pytest.mark.timeout(1200)  # a survey takes minutes of a busy machine


def _small() -> SurveySet:
    return simulate_survey("office", seed=3, photos=5, close_ups=1, size=0.6, step_deg=0.3)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("survey") / "job"
    folder.mkdir()
    write_survey_set(folder, _small())
    return folder


@pytest.fixture(scope="module")
def adjusted(job: Path) -> tuple[int, Path]:
    out = job.parent / "out"
    assert main(["survey", str(job), "-o", str(job / "survey.json"), "--quiet"]) == 0
    return main(["adjust", str(job / "survey.json"), "-o", str(out), "--quiet"]), out


def _document(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "adjustment.json").read_text(encoding="utf-8"))
    return found


@pytest.mark.long
@pytest.mark.slow
def test_photographs_of_the_room_are_accepted_where_they_were_taken(adjusted: tuple[int, Path]) -> None:
    code, out = adjusted
    truth, document = _small(), _document(out)
    assert code == 3  # one is of another room
    errors = []
    for one in truth.photos:
        stated = document["photos"][Path(one.name).stem]
        if one.camera_from_world is None:
            assert not stated["accepted"]
            assert stated["reasons"]
            continue
        if not stated["accepted"]:
            assert one.scale > 1, (one.name, stated["reasons"])
            continue
        pose, true = Rigid.from_matrix(stated["camera_from_world"]), truth.in_first(one.camera_from_world)
        turn = rotvec_from_rotation(true.rotation @ pose.rotation.T)
        off = np.concatenate([turn, true.centre - pose.centre])
        errors.append(float(np.sqrt(off @ np.linalg.solve(np.array(stated["covariance"]), off) / 6)))
        assert pose.distance_to(true) < 0.06, one.name
    assert len(errors) >= 5
    assert max(errors) < 4
    for k, camera in enumerate(document["cameras"].values()):
        assert abs(camera["camera"]["fx"] / truth.cameras[k].fx - 1) < 0.006  # stated 1 to 3 % wrong


@pytest.mark.long
@pytest.mark.slow
def test_what_is_written_can_be_used_by_the_other_commands(
    adjusted: tuple[int, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, out = adjusted
    assert main(["check", str(out)]) == 0
    assert main(["info", str(out)]) == 0
    assert "accepted" in capsys.readouterr().out
    accepted = [name for name, one in _document(out)["photos"].items() if one["accepted"]]
    for name in accepted:
        assert (out / "photos" / name / "registration.json").is_file()
        assert (out / "photos" / name / "model.glb").is_file()
    assert not (out / ".cache").exists()
    page = (out / "report.html").read_text(encoding="utf-8")
    for words in ("<svg", "Map", *accepted, "times enlarged", "elsewhere_1"):
        assert words in page
    joint = np.load(out / "covariance.npz")
    assert joint["covariance"].shape == (6 * len(joint["id"]),) * 2
    assert np.linalg.eigvalsh(joint["covariance"]).min() > -1e-12
    assert set(joint["id"][joint["kind"] == "photo"]) == set(accepted)


@pytest.mark.long
@pytest.mark.slow
def test_the_scans_of_a_survey_are_exported_together(adjusted: tuple[int, Path], tmp_path: Path) -> None:
    _, out = adjusted
    document = _document(out)
    accepted = {name: one for name, one in document["photos"].items() if one["accepted"]}
    assert len({one["folder"] for one in accepted.values()}) == len(accepted)
    assert main(["export", str(out), "--to", "colmap,e57,ply", "-o", str(tmp_path / "all"), "--quiet"]) == 0
    lines = (tmp_path / "all/colmap/sparse/0/images.txt").read_text(encoding="utf-8").splitlines()
    shown = [line.split() for line in lines if line.split()[-1:] and line.split()[-1].endswith(".jpg")]
    assert {Path(words[-1]).stem for words in shown} == set(accepted)
    for words in shown:  # COLMAP's poses are those of the adjustment
        stated = np.array(accepted[Path(words[-1]).stem]["camera_from_world"])
        assert np.allclose([float(word) for word in words[5:8]], stated[:3, 3], atol=1e-9)
    for station in document["scans"]:
        scan = lr.read_scan(tmp_path / "all/e57/survey.e57", scan_index=list(document["scans"]).index(station))
        assert scan.world_from_scanner is not None
        stated = document["scans"][station]["world_from_scanner"]
        assert np.allclose(scan.world_from_scanner.matrix, stated, atol=1e-9)
        assert any((tmp_path / f"all/ply/{station}").glob("*.ply"))


@pytest.mark.long
@pytest.mark.slow
def test_a_pose_of_the_survey_is_right_and_a_moved_one_is_wrong(adjusted: tuple[int, Path], tmp_path: Path) -> None:
    _, out = adjusted
    job = out.parent / "job"
    name = next(
        name for name, one in _document(out)["photos"].items() if one["accepted"] and one["evidence"] == "image"
    )
    written = out / "photos" / name / "registration.json"
    registration = lr.read_registration(written)
    stated = json.loads(written.read_text(encoding="utf-8"))["inputs"]
    scan = next(str(job / one["name"]) for one in stated if one["name"].endswith(".npz"))
    photo = str(job / f"{name}.jpg")
    (tmp_path / "camera.json").write_text(json.dumps(registration.camera.as_fields()))
    shared = ["audit", scan, photo, "--camera", str(tmp_path / "camera.json"), "--quiet", "--json", "--pose"]
    assert main([*shared, str(written)]) == 0
    pose = registration.camera_from_scanner
    turned = Rigid.from_rotvec([0.0, 0.03, 0.0]).rotation @ pose.rotation
    moved = Rigid.from_centre(turned, pose.centre + np.array([0.15, 0.0, 0.0]))
    (tmp_path / "pose.json").write_text(json.dumps({"camera_from_scanner": moved.matrix.tolist()}))
    assert main([*shared, str(tmp_path / "pose.json")]) == 3


@pytest.mark.long
@pytest.mark.slow
def test_a_killed_survey_goes_on_and_ends_as_if_nothing_had_happened(adjusted: tuple[int, Path]) -> None:
    _, out = adjusted
    again = out.parent / "again"
    words = [sys.executable, "-m", "ladarreg", "adjust", str(out.parent / "job/survey.json"), "-o", str(again)]
    process = subprocess.Popen([*words, "--quiet"], start_new_session=True)
    cache = again / ".cache"
    deadline = time.monotonic() + 600
    while process.poll() is None and not (cache.is_dir() and len(list(cache.iterdir())) > 14):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    before = {path.name for path in cache.iterdir() if path.suffix == ".entry"}
    assert before
    assert main(["adjust", str(out.parent / "job/survey.json"), "-o", str(again), "--processes", "1", "--quiet"]) == 3
    assert (again / "adjustment.json").read_bytes() == (out / "adjustment.json").read_bytes()


@pytest.mark.long
@pytest.mark.slow
def test_the_poses_of_an_adjustment_are_right_against_its_own_files(
    adjusted: tuple[int, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    _, out = adjusted
    capsys.readouterr()
    code = main(["audit", str(out.parent / "job/survey.json"), "--pose", str(out), "--quiet", "--json"])
    said = json.loads(capsys.readouterr().out)
    accepted = [name for name, one in _document(out)["photos"].items() if one["accepted"]]
    assert sorted(said["photos"]) == sorted(accepted)
    assert {one["outcome"] for one in said["photos"].values()} <= {"right", "undecidable"}
    assert sum(one["outcome"] == "right" for one in said["photos"].values()) >= len(accepted) - 1
    assert set(said["left_out"]) == set(_document(out)["photos"]) - set(accepted)
    assert code == 4


@pytest.mark.slow
def test_an_audit_says_what_it_needs(job: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = str(job / "station1.npz")
    assert main(["audit", scan, "--quiet"]) == 2
    assert "is no survey; give the photo and --pose" in capsys.readouterr().err
    assert main(["audit", scan, str(job / "IMG_0001.jpg"), "--quiet"]) == 2
    assert "no pose is given that could be judged" in capsys.readouterr().err
    assert main(["audit", str(job), "--quiet"]) == 2
    assert "no pose of a photograph of this survey is stated" in capsys.readouterr().err


@pytest.mark.slow
def test_faults_of_a_survey_are_listed_and_nothing_is_done(
    job: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fields = {
        "version": 1, "scans": [{"id": "a", "path": "no.npz"}, {"id": "a", "path": str(job / "station1.npz")}],
        "cameras": [], "photos": [{"id": "p", "path": str(job / "IMG_0001.jpg"), "camera": "c"}],
    }  # fmt: skip
    (tmp_path / "survey.json").write_text(json.dumps(fields))
    assert main(["adjust", str(tmp_path / "survey.json"), "-o", str(tmp_path / "out"), "--quiet"]) == 2
    text = capsys.readouterr().err
    for words in ("no.npz", "2 scans have the id 'a'", "'c'", "3 faults", "nothing was done"):
        assert words in text
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_photographs_without_a_camera_are_listed_before_any_work(
    job: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from PIL import Image

    for name in ("one.png", "two.png"):
        Image.fromarray(np.full((40, 60, 3), 99, np.uint8)).save(tmp_path / name)
    os.symlink(job / "station1.npz", tmp_path / "station1.npz")
    assert main(["adjust", str(tmp_path), "-o", str(tmp_path / "out"), "--quiet"]) == 2
    text = capsys.readouterr().err
    assert "one.png" in text
    assert "two.png" in text
    assert "focal length" in text


@pytest.mark.slow
def test_an_existing_survey_file_is_kept(job: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "survey.json"
    target.write_text("mine")
    assert main(["survey", str(job), "-o", str(target), "--quiet"]) == 2
    assert target.read_text() == "mine"
    assert "--force" in capsys.readouterr().err
    assert main(["survey", str(job), "-o", str(target), "--force", "--quiet"]) == 0
    survey = lr.Survey.from_file(target)
    assert len(survey.scans) == 2
    assert len(survey.cameras) == 2


@pytest.mark.long
@pytest.mark.slow
def test_an_adjusted_survey_becomes_one_model(adjusted: tuple[int, Path], tmp_path: Path) -> None:
    _, out = adjusted
    assert main(["model", str(out), "--to", "ply", "-o", str(tmp_path / "model"), "--quiet"]) == 0
    found = json.loads((tmp_path / "model" / "model.json").read_text(encoding="utf-8"))
    stated = _document(out)["photos"]
    assert {one["id"] for one in found["photos"]} == {name for name, one in stated.items() if one["accepted"]}
    assert {one["name"] for one in found["left_out"]} == {name for name, one in stated.items() if not one["accepted"]}
    assert found["frame"]["frame"] == ("world" if len(found["scans"]) > 1 else "scanner")
    assert found["colored"] > 0.1
    assert all(one["gain_sigma"] is None or max(one["gain_sigma"]) < 0.1 for one in found["photos"])


@pytest.mark.long
@pytest.mark.slow
def test_the_worked_example_of_the_documentation(tmp_path: Path) -> None:
    """The commands of `docs/surveys.md` on the survey that the package contains."""
    job, out = tmp_path / "job", tmp_path / "results"
    shutil.copytree(sample_survey_folder(), job)
    truth = json.loads((job / "truth.json").read_text(encoding="utf-8"))
    assert main(["survey", str(job), "-o", str(job / "survey.json"), "--quiet"]) == 0
    assert main(["adjust", str(job / "survey.json"), "-o", str(out), "--quiet"]) == 3
    document = _document(out)
    for name, matrix in truth["camera_from_world"].items():
        one = document["photos"][name]
        assert one["accepted"] == (matrix is not None), (name, one["reasons"])
        if matrix is not None:
            pose, true = Rigid.from_matrix(one["camera_from_world"]), Rigid.from_matrix(matrix)
            off = np.concatenate([rotvec_from_rotation(true.rotation @ pose.rotation.T), true.centre - pose.centre])
            assert np.sqrt(off @ np.linalg.solve(np.array(one["covariance"]), off) / 6) < 4, name
            assert pose.distance_to(true) < 0.05, name
    assert document["photos"]["close_01"]["evidence"] == "ties"
    for camera, focal in zip(document["cameras"].values(), truth["focal_px"], strict=True):
        assert abs(camera["camera"]["fx"] - focal) < 4 * camera["sigmas"]["focal_px"]


@pytest.mark.slow
def test_ties_that_were_drawn_are_part_of_the_adjustment_and_a_wrong_one_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    job, out, pair = tmp_path / "job", tmp_path / "results", shared_places()
    job.mkdir()
    for name in ("station1.npz", *(f"{one}.jpg" for one in pair.names)):
        shutil.copy(sample_survey_folder() / name, job / name)
    assert main(["survey", str(job), "-o", str(job / "survey.json"), "--quiet"]) == 0
    fields = json.loads((job / "survey.json").read_text(encoding="utf-8"))
    places = pair.uv[:: len(pair.uv) // 8] + np.random.default_rng(1).normal(0, 0.5, (2,))
    ties = [{"id": f"t{k}", "photos": list(pair.names), "uv": uv} for k, uv in enumerate(places.tolist())]
    (u, v), (s, t) = places[0].tolist()
    wrong = {"id": "wrong", "photos": list(pair.names), "uv": [[u, v], [s + 18.0, t - 14.0]], "sigma_px": 0.5}
    fields["ties"] = [*ties, wrong]
    (job / "survey.json").write_text(json.dumps(fields), encoding="utf-8")
    assert main(["adjust", str(job / "survey.json"), "-o", str(out), "--quiet"]) == 0
    verdicts = {one["id"]: one for one in _document(out)["ties"]}
    assert [name for name, one in verdicts.items() if one["agrees"]] == [one["id"] for one in ties]
    assert verdicts["wrong"]["residual_px"] > 5
    assert f"Tie      wrong of {' and '.join(pair.names)}: Left out" in capsys.readouterr().out
    assert "wrong" in (out / "report.html").read_text(encoding="utf-8")
