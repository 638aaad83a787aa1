"""A surveyor's case from end to end: a scan with its pose in the world, and named targets with coordinates."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode

import ladarreg_core as lr
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.simulate.sample import sample_folder
from ladarreg_core.surface.ranges import surface_range
from testing.workbench.workbench_driver import WorkbenchDriver, open_bench

UTM = Rigid.from_rotvec([0.004, -0.003, 2.1], (500_123.4567, 5_412_345.6789, 102.3456))
CAMERA, PHOTO = sample_folder() / "camera.json", sample_folder() / "photo.png"


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scan.npz in the world, and the targets in the world, in the scanner's frame, and 10 % too far."""
    folder = tmp_path_factory.mktemp("survey")
    scan = replace(lr.read_scan(sample_folder() / "scan.npz"), world_from_scanner=UTM)
    write_npz_xyz(folder / "scan.npz", scan)
    rng = np.random.default_rng(4)
    height, width = scan.shape
    cells = rng.uniform((5, 5), (height - 6, width - 6), (1500, 2))
    rays = scan.geometry.ray_at(cells)
    points = rays * surface_range(scan, rays)[:, None]
    camera = lr.read_photo(PHOTO, camera=CAMERA).camera
    uv = camera.project(truth() @ points) + rng.normal(0, 0.5, (len(points), 2))
    with np.errstate(invalid="ignore"):
        good = np.flatnonzero(np.isfinite(uv).all(axis=1) & camera.contains(uv))[:30]
    points, uv = points[good], uv[good]
    for name, frame, there in (
        ("world", "world", UTM @ points), ("scanner", "scanner", points), ("far", "scanner", 1.1 * points)
    ):  # fmt: skip
        rows = [
            f"T{k + 1},{frame}," + ",".join(f"{v:.5f}" for v in (*p, *at))
            for k, (p, at) in enumerate(zip(there, uv, strict=True))
        ]
        (folder / f"{name}.csv").write_text("\n".join(["name,frame,x,y,z,u,v", *rows]), encoding="utf-8")
    return folder


def truth() -> Rigid:
    return read_pose(sample_folder() / "truth.json")


def register(survey: Path, out: Path, *more: str, command: str = "register") -> int:
    scan, photo = str(survey / "scan.npz"), str(PHOTO)
    return main([command, scan, photo, "--camera", str(CAMERA), "-o", str(out), *more])


def expected_centre() -> FloatArray:
    return UTM @ truth().centre


@pytest.mark.slow
def test_targets_in_the_world_give_a_camera_in_the_world(
    survey: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    initial = tmp_path / "initial.json"
    initial.write_text(json.dumps({"camera_from_world": (truth() @ UTM.inverse).matrix.tolist()}), encoding="utf-8")
    out = tmp_path / "out"
    code = register(survey, out, "--matches", str(survey / "world.csv"), "--initial", str(initial), "--frame", "world")
    said = capsys.readouterr().out
    assert code == ExitCode.ACCEPTED, said
    document = json.loads((out / "registration.json").read_text(encoding="utf-8"))
    assert np.linalg.norm(np.array(document["camera_centre_world"]) - expected_centre()) < 0.05
    x, y, z = (f"{axis} {value:.3f}" for axis, value in zip("XYZ", document["camera_centre_world"], strict=True))
    assert f"World    {x}, {y}, {z} m; the camera looks" in said
    assert "Lengths of the matches" in said
    assert (out / "offset.json").is_file()
    report = (out / "report.html").read_text(encoding="utf-8")
    assert f"{x}, {y}, {z} m" in report
    assert "camera_from_world" in report
    assert main(["info", str(survey / "scan.npz")]) == ExitCode.ACCEPTED
    assert "X 500123.457, Y 5412345.679, Z 102.346 m" in capsys.readouterr().out


@pytest.mark.long
def test_targets_ten_per_cent_too_far_are_refused(
    survey: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert register(survey, out, "--matches", str(survey / "far.csv")) == ExitCode.NOT_ACCEPTED
    said = capsys.readouterr().out
    assert "1.10 x the scan's: unit or scale?" in said
    assert "beyond" in said
    assert said.startswith("Not accepted: lengths of the matches disagree with the scan.")
    report = (out / "report.html").read_text(encoding="utf-8")
    assert "lengths of the matches disagree" in report
    assert all(f">T{k}<" in report for k in range(1, 31))
    assert not (out / "cloud.ply").exists()


@pytest.mark.long
def test_compare_states_the_world_for_every_stage(survey: Path, tmp_path: Path) -> None:
    register(survey, tmp_path / "out", "--matches", str(survey / "world.csv"), "--quiet", command="compare")
    document = json.loads((tmp_path / "out" / "comparison.json").read_text(encoding="utf-8"))
    centres = [column["camera_centre_world"] for column in document["columns"] if column["camera_from_scanner"]]
    assert len(centres) >= 3
    assert all(np.linalg.norm(np.array(centre) - expected_centre()) < 2 for centre in centres)


@pytest.mark.slow
def test_what_needs_the_world_is_refused_without_it(
    tmp_path: Path, survey: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = tmp_path / "plain"
    plain.mkdir()
    (plain / "scan.npz").write_bytes((sample_folder() / "scan.npz").read_bytes())
    initial = tmp_path / "initial.json"
    initial.write_text(json.dumps({"camera_from_world": truth().matrix.tolist()}), encoding="utf-8")
    for more in (("--frame", "world"), ("--matches", str(survey / "world.csv")), ("--initial", str(initial))):
        assert register(plain, tmp_path / "out", *more) == ExitCode.BAD_INPUT
        error = capsys.readouterr().err.strip().splitlines()[-1]
        assert "world" in error
        assert not (tmp_path / "out").exists()


def lengths_of(bench: WorkbenchDriver, count: int) -> list[dict[str, Any]]:
    """Return the lengths of the matches once there are that many; they are compared in the background."""
    bench.eventually(lambda: len((bench.slice("judged:p1") or {"lengths": ()})["lengths"]) == count)
    return list(bench.slice("judged:p1")["lengths"].values())


@pytest.mark.long
def test_the_workbench_keeps_names_lengths_and_the_world(survey: Path, tmp_path: Path) -> None:
    home = tmp_path / "project"
    bench = open_bench(home, survey / "scan.npz", PHOTO, camera=CAMERA)
    assert bench.slice("scan")["world"]["position"] == "X 500123.457, Y 5412345.679, Z 102.346 m"
    upload = bench.workbench.upload_folder() / "t.csv"
    upload.write_bytes((survey / "world.csv").read_bytes())
    bench.workbench.take_upload(upload, "t.csv", "matches", "p1", bench.client)
    picks = bench.slice("picks:p1")
    assert [pick["name"] for pick in picks[:3]] == ["T1", "T2", "T3"]
    assert bench.job("robust").state == "done"
    stage, *_ = bench.slice("poses:p1")["stages"]
    assert stage["accepted"], stage
    assert stage["in_world"].startswith("X 5001")
    assert not any(length["beyond"] for length in lengths_of(bench, 30))
    assert "must be 'scanner' or 'world'" in bench.refused("run", photo="p1", job="export", frame="moon")
    bench.do("run", photo="p1", job="export", frame="world")
    bench.workbench.runner.wait(120)
    path, _ = bench.workbench.export_file("p1") or (Path(), "")
    with zipfile.ZipFile(path) as file:
        assert "offset.json" in file.namelist()
        matches = json.loads(file.read("matches.json"))
        result = json.loads(file.read("registration.json"))
    assert (matches["version"], matches["scan_coordinates"], matches["matches"][0]["name"]) == (2, "point", "T1")
    assert np.linalg.norm(np.array(result["camera_centre_world"]) - expected_centre()) < 0.05

    moved = picks[0]["scan"][0]
    bench.do("set_pick", photo="p1", pick=picks[0]["id"], scan=[[moved[0], moved[1] + 0.001, moved[2]]])
    lengths_of(bench, 29)  # where it is now, nobody has measured
    bench.workbench.close()
    again = open_bench(home)
    try:
        lengths_of(again, 29)
        assert again.slice("picks:p1")[0]["name"] == "T1"
        assert again.slice("poses:p1")["stages"][0]["in_world"] == stage["in_world"]
        again.do("undo")
        lengths_of(again, 30)
        far = again.workbench.upload_folder() / "far.csv"
        far.write_bytes((survey / "far.csv").read_bytes())
        again.do("remove_picks", photo="p1", picks=[pick["id"] for pick in again.slice("picks:p1")])
        again.workbench.take_upload(far, "far.csv", "matches", "p1", again.client)
        for job in ("solve", "linear"):
            assert again.job(job).state == "done"
            shown = next(
                s
                for s in again.slice("poses:p1")["stages"]
                if s["stage"] == ("linear" if job == "linear" else "robust")
            )
            assert not shown["accepted"]
            assert "unit or scale?" in shown["reasons"][0]
        again.eventually(lambda: all(length["beyond"] for length in lengths_of(again, 30)))
    finally:
        again.workbench.close()
