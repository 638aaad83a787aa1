"""The scripts of docs/examples run on simulated files, and print what is true."""

from __future__ import annotations

import re
import runpy
import shutil
from pathlib import Path
from types import SimpleNamespace

import laspy
import nbclient
import nbformat
import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.simulate import write_case
from testing.scenes.simulated import simulated

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "examples"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    folder = tmp_path_factory.mktemp("examples") / "case"
    case = simulated("boxes", seed=3)
    write_case(case, folder)
    names = {"scan": "scan.npz", "photo": "photo.png", "camera": "camera.json", "truth": "truth.json"}
    return SimpleNamespace(case=case, folder=folder, **{key: str(folder / name) for key, name in names.items()})


def run(name: str, *words: object) -> int:
    code = runpy.run_path(str(FOLDER / f"{name}.py"))["main"]([str(word) for word in words])
    assert isinstance(code, int)
    return code


def test_every_script_is_run_here() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    names = {path.stem for path in FOLDER.glob("*.py")}
    assert len(names) == 5
    assert {name for name in names if f'run("{name}"' in here or f'"{name}",' in here} == names


@pytest.mark.slow
def test_a_folder_of_photographs(files: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    shutil.copy(files.photo, photos / "Bild äöü 1.png")
    (photos / "notes.txt").write_text("no picture")
    assert run("photo_folder", files.scan, photos, "-o", tmp_path / "out", "--camera", files.camera) == 0
    said = capsys.readouterr().out
    assert "Registration(accepted by the images" in said
    assert (tmp_path / "out" / "Bild äöü 1" / "registered.png").is_file()
    assert list((tmp_path / "out" / "together" / "ply").glob("*.ply"))


@pytest.mark.slow
def test_matches_of_ones_own(files: SimpleNamespace, tmp_path: Path) -> None:
    out = tmp_path / "r.json"
    assert run("own_matcher", files.scan, files.photo, "--camera", files.camera, "--json", out) == 0
    result = lr.Registration.from_json(out.read_text(encoding="utf-8"))
    assert result.evidence == "image"
    assert result.camera_from_scanner.distance_to(files.case.camera_from_scanner) < 0.01


@pytest.mark.long
def test_a_las_file_is_colored(files: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    case = files.case
    away = np.array([100.0, 200.0, 10.0])
    points = case.scan.thinned_points(3).reshape(-1, 3).astype(np.float64)
    points = points[np.isfinite(points[:, 0])]
    cloud = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    cloud.header.offsets, cloud.header.scales = away, [1e-4] * 3
    cloud.x, cloud.y, cloud.z = (points + away).T
    cloud.intensity = np.arange(len(points)) % 60000
    cloud.write(tmp_path / "cloud.las")
    words = (tmp_path / "cloud.las", files.photo, "-o", tmp_path / "out", "--camera", files.camera)
    assert run("colour_las", *words, "--pose", files.truth, "--origin", *away) == 0
    assert "given, not verified" in capsys.readouterr().out
    (file,) = (tmp_path / "out" / "laz").glob("*.la[sz]")
    with laspy.open(file) as opened:
        made = opened.read()
    np.testing.assert_array_equal(made.intensity, cloud.intensity)
    seen = made.label == lr.Label.SEEN
    assert seen.mean() > 0.3
    rgb = np.stack([made.red, made.green, made.blue], axis=1)[seen] / 257
    at = case.photo.camera.project(case.camera_from_scanner @ (made.xyz[seen] - away))
    u, v = np.rint(at).astype(int).clip(0, np.array(case.photo.camera.size) - 1).T

    def off(columns: np.ndarray) -> float:
        return float(np.median(np.abs(rgb - case.photo.pixels[v, columns])))

    assert off(u) < 8
    assert off(case.photo.camera.width - 1 - u) > 15, "the control: a mirrored photograph"


@pytest.mark.slow
def test_coordinates_of_clicked_pixels(files: SimpleNamespace, capsys: pytest.CaptureFixture[str]) -> None:
    case = files.case
    words = (files.scan, files.photo, "--camera", files.camera)
    clicks = [word for pixel in ("200.5,200", "384,256.5", "500,300", "600,400", "9999,4") for word in ("--at", pixel)]
    assert run("clicked_points", *words, *clicks) == 0
    said = capsys.readouterr().out
    rows = [[float(number) for number in re.findall(r"-?[\d.]+", row)] for row in said.splitlines() if row[-2:] == "mm"]
    assert len(rows) >= 3
    for u, v, x, y, z, sigma in rows:
        uv = case.photo.camera.project(case.camera_from_scanner @ np.array([x, y, z]))
        assert np.hypot(*(uv - (u, v))) < 1
        assert 0.1 < sigma < 50
    assert "no surface" in said


@pytest.mark.slow
def test_compared_with_solvepnp(files: SimpleNamespace, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    case, rng = files.case, np.random.default_rng(0)
    labels = lr.texture_scan(case.scan, case.photo, case.camera_from_scanner).labels
    cells = rng.permutation(np.argwhere(labels == lr.Label.SEEN))[:60]
    uv = case.photo.camera.project(case.camera_from_scanner @ case.scan.points[tuple(cells.T)].astype(np.float64))
    uv += rng.normal(0, 0.5, uv.shape)
    uv[::6] += 40
    rows = "\n".join(f"{r},{c},{u:.3f},{v:.3f}" for (r, c), (u, v) in zip(cells, uv, strict=True))
    (tmp_path / "matches.csv").write_text(f"row,column,u,v\n{rows}\n")
    words = (files.scan, files.photo, tmp_path / "matches.csv", "--camera", files.camera, "--truth", files.truth)
    assert run("compare_solvepnp", *words) == 0
    said = capsys.readouterr().out
    off = {name: float(mm) for name, mm in re.findall(r"(ladarreg|solvePnP): ([\d.]+) mm", said)}
    assert off["ladarreg"] < 20
    assert off["solvePnP"] < 20


@pytest.mark.long
def test_the_notebook_runs_and_shows_pictures_verdict_and_progress() -> None:
    book = nbformat.read(FOLDER / "notebook.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in book.cells), "outputs are not kept in the repository"
    nbclient.NotebookClient(book, timeout=300, kernel_name="python3").execute()
    shown = [output for cell in book.cells for output in cell.get("outputs", ())]
    html = [output.data["text/html"] for output in shown if "text/html" in output.get("data", {})]
    assert [any(word in one for one in html) for word in ("Scan office", "Photo office", "Accepted: verified")] == [
        True
    ] * 3
    assert sum("image/png" in output.get("data", {}) for output in shown) == 1, "one figure, shown once"
    text = "".join(output.get("text", "") for output in shown)
    assert re.search(r"[1-9]\d% of the returns have a colour", text)
