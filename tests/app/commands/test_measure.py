"""`ladarreg measure`: of results in the photograph and the scan, into files, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode

import ladarreg_core as lr
from ladarreg_core.simulate.sample import sample_folder

SAMPLE = sample_folder()
ON_SCREEN = ["--at", "560,170", "--at", "640,200"]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of the sample, accepted; its pose is the true one with a covariance."""
    out = tmp_path_factory.mktemp("measure") / "results"
    scan = lr.read_scan(SAMPLE / "scan.npz")
    photo = lr.read_photo(SAMPLE / "photo.png", camera=SAMPLE / "camera.json")
    lr.export_registration(out, lr.register(scan, photo), scan, photo)
    return out


def said(capsys: pytest.CaptureFixture[str], *words: str, code: ExitCode = ExitCode.ACCEPTED) -> str:
    capsys.readouterr()
    found = main(["measure", *words])
    captured = capsys.readouterr()
    assert found == code, captured.err
    return captured.err if code == ExitCode.BAD_INPUT else captured.out


def test_a_distance_in_the_photo_is_that_of_python(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fields = json.loads(said(capsys, str(results), "--kind", "distance", *ON_SCREEN, "--json"))
    (found,) = fields["measurements"]
    scan, result = lr.read_scan(SAMPLE / "scan.npz"), lr.read_registration(results / "registration.json")
    expected = lr.measure("distance", lr.MeasuredPoints.of_photo(scan, result, [[560, 170], [640, 200]]))
    assert found["value"] == pytest.approx(expected.value, rel=1e-9)
    assert found["sigma"] == pytest.approx(expected.sigma, rel=1e-9)
    line = said(capsys, str(results), "--kind", "distance", *ON_SCREEN, "--quiet").splitlines()[0]
    assert line == f"distance  {expected.described}"


def test_a_file_of_points_becomes_a_drawing_and_what_is_refused_says_so(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = tmp_path / "points.csv"
    points.write_text(
        "measurement,kind,u,v,row,column\na,distance,560,170,,\na,,,,350,500\nb,distance,9999,1,,\nb,,5,5,,\n"
    )
    out = tmp_path / "plan.dxf"
    words = [str(results), "--points", str(points), "-o", str(out), "--quiet"]
    lines = said(capsys, *words, code=ExitCode.NOT_ACCEPTED).splitlines()
    assert lines[0].startswith("a ")
    assert " +- " in lines[0]
    assert any(line.startswith("b  refused: photo") and "outside the photograph" in line for line in lines)
    assert out.read_bytes().rstrip().endswith(b"EOF")
    before = out.read_bytes()
    assert "exists" in said(capsys, *words, code=ExitCode.BAD_INPUT)
    assert out.read_bytes() == before


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--kind", "distance"], "points are needed"),
        ([*ON_SCREEN], "--kind"),
        (["--kind", "distance", "--at", "3;4"], "two numbers"),
        (["--kind", "point", "--at", "nan,4"], "two numbers"),
        (["--kind", "distance", *ON_SCREEN, "--sigma-px", "-1"], "sigma"),
        (["--kind", "distance", *ON_SCREEN, "--crs", "EPSG:25832", "-o", "a.csv"], "world"),
        (["--kind", "distance", *ON_SCREEN, "--frame", "world"], "world"),
        (["--kind", "distance", *ON_SCREEN, "-o", "list.xlsx"], "suffix"),
        (["--kind", "distance", "--points", "nowhere.csv"], "nowhere.csv"),
    ],
)
def test_bad_input_is_one_sentence(
    results: Path, words: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (line,) = said(capsys, str(results), "--quiet", *words, code=ExitCode.BAD_INPUT).splitlines()
    assert line.startswith("ladarreg: ")
    assert complaint in line


def test_a_refused_result_is_not_measured_in(results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = lr.read_scan(SAMPLE / "scan.npz")
    noise = np.random.default_rng(0).integers(0, 255, (512, 768, 3)).astype(np.uint8)
    import cv2

    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    photo = lr.read_photo(tmp_path / "noise.png", camera=SAMPLE / "camera.json")
    refused = lr.register(scan, photo)
    assert not refused.accepted
    lr.export_registration(tmp_path / "refused", refused, scan, photo)
    words = [str(tmp_path / "refused"), "--kind", "distance", *ON_SCREEN, "--quiet"]
    assert "refused" in said(capsys, *words, code=ExitCode.BAD_INPUT)
