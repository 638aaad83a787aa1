"""`ladarreg apply`: a pose that was given colours and exports, and every file says so."""

from __future__ import annotations

import contextlib
import io
import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode
from PIL import Image

from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.formats import read_photo, read_scan
from ladarreg_core.formats.documents.pose_file import read_pose, write_pose
from ladarreg_core.formats.documents.registration_file import read_result
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.registration.carry import carry_over
from ladarreg_core.registration.given import coverage, given_pose
from ladarreg_core.simulate.sample import sample_folder
from ladarreg_core.storage.manifest import visible_files
from ladarreg_core.surface.texture.registered_texture import texture_scan

MARK = "given, not verified"
SAMPLE = sample_folder()
INPUTS = [str(SAMPLE / "scan.npz"), str(SAMPLE / "photo.png"), "--camera", str(SAMPLE / "camera.json")]


def apply(pose: Path, out: Path, *more: str) -> int:
    return main(["apply", *INPUTS, "--pose", str(pose), "-o", str(out), *more])


@pytest.fixture(scope="module")
def applied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the true pose, given."""
    out, printed = tmp_path_factory.mktemp("applied") / "out", io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert apply(SAMPLE / "truth.json", out, "--json", "--quiet") == ExitCode.ACCEPTED
    document = json.loads(printed.getvalue())
    assert document.pop("output")["folder"] == str(out)
    document.pop("notes")
    assert document == json.loads((out / "registration.json").read_text())
    return out


def glb_json(path: Path) -> dict[str, object]:
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length])  # type: ignore[no-any-return]


@pytest.mark.slow
def test_the_files_of_an_accepted_result_are_written_and_marked(applied: Path) -> None:
    assert {*visible_files(applied)} == {
        "registration.json", "report.html", "registered.png", "labels.png", "visibility.png", "model.glb", "cloud.ply",
    }  # fmt: skip
    fields = json.loads((applied / "registration.json").read_text())
    assert fields["accepted"] is False
    assert (fields["evidence"], fields["mark"], fields["method"]) == ("given", MARK, "given")
    assert fields["covariance"] is None
    assert fields["sigma"]["angle_rad"] is None
    assert fields["rejected_guess"] is None
    truth = read_pose(SAMPLE / "truth.json")
    assert np.allclose(fields["camera_from_scanner"], truth.matrix, atol=1e-12)
    assert [one["name"] for one in fields["inputs"]] == ["scan.npz", "photo.png", "camera.json", "truth.json"]
    assert b"comment pose: " + MARK.encode() in (applied / "cloud.ply").read_bytes()[:2000]
    glb = glb_json(applied / "model.glb")
    assert glb["asset"]["extras"]["pose"] == MARK  # type: ignore[index]
    assert glb["nodes"][0]["extras"]["pose"] == MARK  # type: ignore[index]
    assert Image.open(applied / "labels.png").text["Pose"] == MARK  # type: ignore[attr-defined]
    text = (applied / "report.html").read_text()
    top = text[text.index("<main>") : text.index("Before and after")]
    assert top.count(MARK) >= 2
    assert "Given, not verified: this pose was applied, not solved." in top
    assert "nan" not in text[text.index("<main>") :].split("data:")[0].lower().replace("financ", "")


@pytest.mark.slow
def test_the_registered_picture_bears_a_watermark_and_the_model_does_not_lose_its_colors(applied: Path) -> None:
    scan = read_scan(SAMPLE / "scan.npz")
    photo = read_photo(SAMPLE / "photo.png", camera=SAMPLE / "camera.json")
    clean = texture_scan(scan, photo, read_pose(SAMPLE / "truth.json"))
    shown = np.array(Image.open(applied / "registered.png"))
    assert shown.shape == clean.image.shape
    differs = np.abs(shown.astype(int) - clean.image.astype(int)).max(axis=-1) > 30
    assert 0.02 < differs.mean() < 0.3
    rows, columns = np.nonzero(differs)
    assert np.ptp(columns) > 0.5 * shown.shape[1]
    assert np.ptp(rows) > 0.5 * shown.shape[0]
    assert (np.array(Image.open(applied / "labels.png")) == clean.labels).all()  # no cell is uncertain for the pose


@pytest.mark.slow
def test_what_was_applied_is_read_again_and_handed_over_with_its_mark(
    applied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    registration, _ = read_result(applied / "registration.json")
    assert registration.evidence == "given"
    assert registration.is_shown
    assert not registration.accepted
    assert np.isnan(registration.covariance).all()
    assert registration.joint_covariance is None
    scan = read_scan(SAMPLE / "scan.npz")
    photo = read_photo(SAMPLE / "photo.png", camera=registration.camera)
    handed = RegisteredScan(scan, [RegisteredPhoto("photo", photo, registration)])
    assert handed.marks == (f"photo: {MARK}",)
    capsys.readouterr()
    assert main(["info", str(applied / "registration.json")]) == 0
    shown = capsys.readouterr().out
    assert "Given, not verified" in shown
    assert re.search(r"^sigma pose +unknown$", shown, re.MULTILINE)


def test_a_carried_pose_needs_an_uncertainty_to_propagate(
    applied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_pose(tmp_path / "offset.json", Rigid.identity())
    carry = ("--carry", str(applied / "registration.json"), "--offset", str(tmp_path / "offset.json"))
    assert main(["register", *INPUTS, *carry, "-o", str(tmp_path / "out"), "--quiet"]) == ExitCode.BAD_INPUT
    assert "was given" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("turn", "move", "outcome", "words"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "verified", "Image verification: verified. "),
        ((0.0, np.radians(2.0), 0.0), (0.0, 0.0, 0.0), "contradicted", "check the given pose"),
        ((0.0, np.pi, 0.0), (0.0, 0.0, 0.0), None, "No return of the scan lies in the photograph"),
    ],
    ids=["right", "two degrees off", "looking away"],
)
def test_what_the_images_say_is_information_and_changes_no_verdict(
    turn: tuple[float, ...], move: tuple[float, ...], outcome: str | None, words: str
) -> None:
    scan = read_scan(SAMPLE / "scan.npz")
    photo = read_photo(SAMPLE / "photo.png", camera=SAMPLE / "camera.json")
    truth = read_pose(SAMPLE / "truth.json")
    pose = Rigid.from_centre(rotation_from_rotvec(np.array(turn)) @ truth.rotation, truth.centre + np.array(move))
    result = given_pose(scan, photo, pose)
    assert (result.evidence, result.accepted) == ("given", False)
    assert words in " ".join(result.reasons)
    assert result.diagnostics.get("verification", {}).get("outcome") == outcome
    assert result.camera_from_scanner.angle_to(pose) < 1e-12
    with pytest.raises(DegenerateGeometryError, match="given"):
        carry_over(result, Rigid.identity(), photo)


def test_coverage_of_a_pose_is_that_of_its_labels() -> None:
    scan = read_scan(SAMPLE / "scan.npz")
    photo = read_photo(SAMPLE / "photo.png", camera=SAMPLE / "camera.json")
    found = coverage(scan, photo, read_pose(SAMPLE / "truth.json"))
    labels = texture_scan(scan, photo, read_pose(SAMPLE / "truth.json")).labels[scan.valid]
    assert found.seen == pytest.approx(np.isin(labels, (1, 4, 5)).mean(), abs=0.02)
    assert found.occluded == pytest.approx((labels == 2).mean(), abs=0.02)
    assert 0.8 < found.of_photo <= 1
    away = coverage(scan, photo, Rigid(rotation_from_rotvec(np.array([0, np.pi, 0])), np.zeros(3)) @ read_pose(
        SAMPLE / "truth.json"))  # fmt: skip
    assert (away.seen, away.in_photo, away.of_photo) == (0, 0, 0)


def test_a_bad_pose_is_one_line_and_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "pose.json").write_text('{"camera_from_scanner": null, "rejected_guess": null, "accepted": false}')
    assert apply(tmp_path / "pose.json", tmp_path / "out", "--quiet") == ExitCode.BAD_INPUT
    assert "was refused" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
