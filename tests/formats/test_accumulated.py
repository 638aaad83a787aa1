"""Clouds of one standpoint read as one scan: what is merged, what is said, and what is refused."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode

import ladarreg_core as lr
from ladarreg_core.errors import FormatError, OptionError, ShapeError
from ladarreg_core.export.outputs.saved_results import read_saved_result
from ladarreg_core.simulate.sample import sample_folder
from testing.files.small_scans import make_scan, pcd_bytes
from testing.scenes.box_room import distances, off_surface
from testing.scenes.true_matches import true_points

SIGMA_M = 0.02
SAMPLE = sample_folder()


def strewn(count: int, seed: int, *, place: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """Points of a room in a cone around X, in no order, as from a place in it, float32."""
    rng = np.random.default_rng(seed)
    angles = np.radians(35) * np.sqrt(rng.random(count)) * np.exp(2j * np.pi * rng.random(count))
    rays = np.stack([np.ones(count), np.tan(angles.real), np.tan(angles.imag)], axis=-1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return (rays * distances(np.array(place, float), rays)[:, None]).astype(np.float32)


def lines(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """One noisy turn of a scanner with 16 lines, and the line of each point."""
    rng = np.random.default_rng(seed)
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(15, -15, 16)), np.linspace(-np.pi, np.pi, 720, endpoint=False), indexing="ij"
    )
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    ranges = distances(np.zeros(3), rays) + SIGMA_M * rng.standard_normal(len(rays))
    return (rays * ranges[:, None]).astype(np.float32), np.repeat(np.arange(16), 720).astype(np.uint16)


def written(path: Path, points: np.ndarray, **options: object) -> Path:
    light = 50 + 10 * np.arange(len(points), dtype=np.float32) % 7
    path.write_bytes(pcd_bytes(points, light, **options))  # type: ignore[arg-type]
    return path


@pytest.mark.slow
def test_a_cloud_in_pieces_gives_the_scan_of_the_whole_cloud(tmp_path: Path) -> None:
    points = strewn(12_000, 1)
    light = np.arange(len(points), dtype=np.float32)
    whole, *pieces = (tmp_path / f"{name}.pcd" for name in ("whole", "a", "b", "c"))
    whole.write_bytes(pcd_bytes(points, light))
    for piece, part in zip(pieces, np.split(np.arange(len(points)), 3), strict=True):
        piece.write_bytes(pcd_bytes(points[part], light[part]))
    one, several = lr.read_scan(whole), lr.read_scan(pieces[0], more=pieces[1:])
    np.testing.assert_array_equal(several.ranges, one.ranges)
    np.testing.assert_array_equal(several.intensity, one.intensity)
    np.testing.assert_array_equal(several.rays, one.rays)
    assert "3 clouds of one standpoint were accumulated, of 4,000, 4,000, 4,000 returns" in " ".join(several.notes)


@pytest.mark.slow
def test_turns_of_a_scanner_with_lines_are_averaged_in_its_own_cells(tmp_path: Path) -> None:
    files = [
        written(tmp_path / f"{k}.pcd", points, extra={"ring": ring})
        for k, (points, ring) in enumerate(lines(seed) for seed in range(9))
    ]
    one, several = lr.read_scan(files[0]), lr.read_scan(files[0], more=files[1:])
    assert several.shape == one.shape
    noise = [np.median(off_surface(scan.points[scan.valid])) for scan in (one, several)]
    assert noise[1] < 0.5 * noise[0]  # a third, but for what lies across edges


@pytest.mark.slow
@pytest.mark.parametrize("place", [(0, 1.2, 0), (-1.4, 0, 0)])
def test_a_cloud_from_elsewhere_is_refused_by_name(tmp_path: Path, place: tuple[float, float, float]) -> None:
    here = [written(tmp_path / f"{k}.pcd", strewn(4000, k)) for k in range(2)]
    there = written(tmp_path / "there.pcd", strewn(4000, 7, place=place))
    with pytest.raises(ShapeError, match=r"there\.pcd was not taken from where 0\.pcd was"):
        lr.read_scan(here[0], more=[here[1], there])


@pytest.mark.slow
def test_what_moved_is_said_and_what_looks_elsewhere_too(tmp_path: Path) -> None:
    first = written(tmp_path / "first.pcd", strewn(4000, 0))
    points = strewn(4000, 1)
    points[points[:, 1] > 0.25 * points[:, 0]] *= 0.5  # somebody stands there
    points = points[np.random.default_rng(2).random(len(points)) < 0.9]
    moved = written(tmp_path / "moved.pcd", points[points[:, 1] < 0.3 * points[:, 0]])
    behind = written(tmp_path / "behind.pcd", strewn(4000, 3) * [-1, 1, 1])
    assert "something moved" in " ".join(lr.read_scan(first, more=[moved], origin=(0, 0, 0)).notes)
    assert "could not be checked" in " ".join(lr.read_scan(first, more=[behind], origin=(0, 0, 0)).notes)


@pytest.mark.slow
def test_other_poses_and_other_options_are_refused(tmp_path: Path) -> None:
    here = written(tmp_path / "here.pcd", strewn(4000, 0), viewpoint="1 0 0 1 0 0 0")
    there = written(tmp_path / "there.pcd", strewn(4000, 1), viewpoint="4 0 0 1 0 0 0")
    with pytest.raises(FormatError, match=r"3\.00 m and 0\.0 degrees"):
        lr.read_scan(here, more=[there])
    with pytest.raises(OptionError, match="give a list of files"):
        lr.read_scan(here, more=str(there))
    with pytest.raises(FormatError, match="memory"):
        lr.read_scan(here, more=[here] * 4, memory_bytes=4_000_000)


def test_gridded_scans_are_accumulated_too(tmp_path: Path) -> None:
    wall = make_scan()
    points = wall.points.reshape(-1, 3)
    files = [written(tmp_path / f"{k}.pcd", points, width=wall.shape[1], height=wall.shape[0]) for k in range(2)]
    scan = lr.read_scan(files[0], more=files[1:])
    found = scan.points[scan.valid]
    assert len(found) == wall.valid.sum()
    nearest = np.linalg.norm(found[:, None] - points[np.isfinite(points[:, 0])][None], axis=-1).min(axis=1)
    assert nearest.max() < 1e-4


@pytest.mark.long
def test_register_takes_several_scans_and_finds_them_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = lr.read_scan(SAMPLE / "scan.npz")
    points, light = scan.points[scan.valid], scan.intensity[scan.valid]
    chosen = np.random.default_rng(5).permutation(len(points))[:40_000]
    for name, part in zip("ab", np.split(chosen, 2), strict=True):
        (tmp_path / f"{name}.pcd").write_bytes(pcd_bytes(points[part], light[part]))
    a, b, out = (str(tmp_path / name) for name in ("a.pcd", "b.pcd", "out"))
    drawn = "\n".join(
        ",".join(map(str, (*match["scan"][0], *match["photo_uv"][0]))) for match in true_points(24, seed=2)
    )
    (tmp_path / "matches.csv").write_text(f"x,y,z,u,v\n{drawn}\n")
    options = ["--camera", str(SAMPLE / "camera.json"), "--matches", str(tmp_path / "matches.csv")]
    camera = [*options, "-o", out, "--json"]
    assert main(["register", a, str(SAMPLE / "photo.png"), b, *camera]) == ExitCode.ACCEPTED
    document = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in document["inputs"]] == [
        "a.pcd", "photo.png", "camera.json", "b.pcd", "matches.csv"
    ]  # fmt: skip
    assert any("2 clouds of one standpoint" in note for note in document["notes"])
    saved = read_saved_result(out)
    again = saved.read_scan(saved.find([tmp_path, SAMPLE])[0])
    np.testing.assert_array_equal(again.ranges, lr.read_scan(a, more=[b]).ranges)

    result = f"{out}/registration.json"
    start = ["register", a, str(SAMPLE / "photo.png"), *options, "--initial", result, "--json"]
    main([*start, "-o", str(tmp_path / "second")])
    document = json.loads(capsys.readouterr().out)
    assert "b.pcd" in [one["name"] for one in document["inputs"]]
    assert any("2 clouds of one standpoint" in note for note in document["notes"])
    apply = ["apply", a, str(SAMPLE / "photo.png"), *options[:2], "--pose", result, "--json", "-o"]
    assert main([*apply, str(tmp_path / "applied")]) == ExitCode.ACCEPTED
    document = json.loads(capsys.readouterr().out)
    assert any("2 clouds of one standpoint" in note for note in document["notes"])
    away = tmp_path / "away"
    away.mkdir()
    (tmp_path / "b.pcd").rename(away / "deeper.pcd")
    (tmp_path / "b.pcd").write_bytes((tmp_path / "a.pcd").read_bytes())  # another content
    main([*apply, str(tmp_path / "alone")])
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert any("registered on 2 accumulated clouds; b.pcd was not found" in note for note in notes)
    assert not any("clouds of one standpoint" in note for note in notes)
    main([*apply, str(tmp_path / "given"), str(away / "deeper.pcd")])
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert any("2 clouds of one standpoint" in note for note in notes)
    assert not any("not found" in note for note in notes)
    (away / "deeper.pcd").rename(tmp_path / "b.pcd")

    few = ["--camera", str(SAMPLE / "camera.json"), "--matches", str(tmp_path / "few.csv")]
    (tmp_path / "few.csv").write_text("\n".join(["x,y,z,u,v", *drawn.splitlines()[:4]]) + "\n")
    refused = ["register", a, b, str(SAMPLE / "photo.png"), *few, "-o", str(tmp_path / "few"), "--json"]
    assert main(refused) == ExitCode.NOT_ACCEPTED
    words = shlex.split(json.loads(capsys.readouterr().out)["open_in_workbench"])
    assert words[:5] == ["ladarreg", "serve", a, b, str(SAMPLE / "photo.png")]

    two = ["register", a, b, str(SAMPLE / "photo.png"), str(SAMPLE / "photo.png"), *camera]
    assert main(two) == ExitCode.BAD_INPUT
    assert "--matches is for one photo" in capsys.readouterr().out
