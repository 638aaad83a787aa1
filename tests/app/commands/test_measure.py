"""`ladarreg measure` and `rectify`: of results in the photograph and the scan, into files, and what they refuse."""

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


@pytest.mark.slow
def test_a_distance_in_the_photo_is_that_of_python(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fields = json.loads(said(capsys, str(results), "--kind", "distance", *ON_SCREEN, "--json"))
    (found,) = fields["measurements"]
    scan, result = lr.read_scan(SAMPLE / "scan.npz"), lr.read_registration(results / "registration.json")
    expected = lr.measure("distance", lr.MeasuredPoints.of_photo(scan, result, [[560, 170], [640, 200]]))
    assert found["value"] == pytest.approx(expected.value, rel=1e-9)
    assert found["sigma"] == pytest.approx(expected.sigma, rel=1e-9)
    line = said(capsys, str(results), "--kind", "distance", *ON_SCREEN, "--quiet").splitlines()[0]
    assert line == f"distance  {expected.described}"


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_wall_and_a_plan_are_rectified(results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "rectify",
        str(results),
        "--at",
        "560,170",
        "--mm-per-pixel",
        "10",
        "-o",
        str(tmp_path / "wall"),
        "--quiet",
    ]
    assert main(words) == ExitCode.ACCEPTED
    assert " mm in the median" in capsys.readouterr().out
    document = json.loads((tmp_path / "wall" / "view.json").read_text(encoding="utf-8"))
    assert document["surface"]["kind"] == "plane"
    assert document["shown"] > 0.05
    assert main(words) == ExitCode.BAD_INPUT
    assert "--force" in capsys.readouterr().err
    assert main([*words, "--force"]) == ExitCode.ACCEPTED
    plan = ["rectify", str(results), "--height", "0.1", "--mm-per-pixel", "20", "-o", str(tmp_path / "plan"), "--quiet"]
    assert main(plan) == ExitCode.ACCEPTED
    assert (tmp_path / "plan" / "section.dxf").is_file()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ([], "--height"),
        (["--at", "560,170", "--at", "5,5"], "2 times"),
        (["--at", "560,170", "--height", "1"], "one of both"),
        (["--at", "9999,170"], "outside the photograph"),
        (["--at", "560,170", "--surface", "pipe"], "pipe"),
        (["--height", "50"], "no surface"),
        (["--height", "nan"], "height"),
        (["--at", "560,170", "--mm-per-pixel", "0"], "positive"),
        (["--height", "0.1", "--frame", "world"], "world"),
        (["--height", "0.1", "--mm-per-pixel", "20", "--crs", "EPSG:25832"], "plan in the world"),
    ],
)
def test_bad_surfaces_are_refused_in_a_sentence(
    results: Path, tmp_path: Path, words: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["rectify", str(results), "-o", str(out), "--quiet", *words]) == ExitCode.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert complaint in line
    assert not out.exists()
