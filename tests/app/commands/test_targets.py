"""`ladarreg targets`: a scanner placed by spheres, the statement, and what is refused."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode

import ladarreg_core as lr
from ladarreg_core.simulate.stations import with_spheres

RADIUS = 0.0725
WORLD = np.array([[4.0, 1.0, 0.5], [4.5, -1.2, 0.2], [3.5, 0.2, -0.5], [5.0, 2.0, -0.2], [4.2, -2.2, 0.7]])
POSE = lr.Rigid.from_rotvec([0.02, -0.01, 0.15], [0.3, -0.4, 0.1])


def write(folder: Path, *, moved: bool = False, header: str = "name,row,column,x,y,z") -> list[str]:
    """Write a scan with spheres and their coordinates; return the command on them."""
    azimuth, elevation = np.radians(np.arange(40, -40, -0.15)), np.radians(np.arange(16, -16, -0.15))
    cosines = np.cos(elevation)[:, None] * np.cos(azimuth)
    ranges = 6.0 / cosines + np.random.default_rng(1).normal(0, 0.002, cosines.shape)
    own = POSE.inverse @ WORLD
    scan = with_spheres(
        lr.Scan.from_grid(ranges=ranges, azimuth_rad=azimuth, elevation_rad=elevation), own, RADIUS, noise_m=0.002
    )
    np.savez(folder / "hall.npz", xyz=scan.points, intensity=np.full(scan.shape, 100.0))
    lines = [header]
    for k, (center, (x, y, z)) in enumerate(zip(own, WORLD, strict=True)):
        row, column = np.unravel_index(np.argmax(scan.rays @ (center / np.linalg.norm(center))), scan.shape)
        lines.append(f"S{k},{row},{column},{x + 0.03 * (moved and k == 2)},{y},{z}")
    (folder / "spheres.csv").write_text("\n".join(lines))
    return ["targets", str(folder / "hall.npz"), str(folder / "spheres.csv"), "-o", str(folder / "out"), "--quiet"]


def test_the_statement_says_where_the_scanner_stood(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*write(tmp_path), "--radius", str(RADIUS)]
    assert main(words) == ExitCode.ACCEPTED
    assert "Target   S4:" in capsys.readouterr().out
    document = json.loads((tmp_path / "out" / "targets.json").read_text())
    found = lr.Rigid.from_matrix(np.array(document["world_from_scanner"]))
    assert np.linalg.norm(found.translation - POSE.translation) < 0.006
    assert np.array(document["covariance"]).shape == (6, 6)
    with (tmp_path / "out" / "targets.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == [f"S{k}" for k in range(5)]
    assert all(row["used"] == "1" and float(row["length_mm"]) < 5 for row in rows)
    assert main(words) == ExitCode.BAD_INPUT
    assert "--force" in capsys.readouterr().err


def test_spheres_need_not_be_picked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*write(tmp_path), "--radius", str(RADIUS), "--json"]
    assert main(words) == ExitCode.ACCEPTED
    picked = json.loads(capsys.readouterr().out)
    lines = [line.split(",") for line in (tmp_path / "spheres.csv").read_text().splitlines()]
    (tmp_path / "spheres.csv").write_text("\n".join(",".join([name, *place]) for name, _, _, *place in lines))
    assert main([*words, "--force"]) == ExitCode.ACCEPTED
    found = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in found["targets"]] == [f"S{k}" for k in range(5)]
    assert np.allclose(found["world_from_scanner"], picked["world_from_scanner"], atol=1e-4)
    half = [",".join(line) for line in lines[:3]] + [f"{name},,,{','.join(place)}" for name, _, _, *place in lines[3:]]
    (tmp_path / "spheres.csv").write_text("\n".join(half))
    assert main([*words, "--force"]) == ExitCode.BAD_INPUT
    assert "S2 has row empty" in capsys.readouterr().out
    lines[1][3], lines[2][4], lines[3][5] = "9", "7", "3"  # the control: elsewhere, nothing fits
    (tmp_path / "spheres.csv").write_text("\n".join(",".join([name, *place]) for name, _, _, *place in lines[:4]))
    assert main([*words, "--force"]) == ExitCode.BAD_INPUT
    assert "no three of them are as far from each other" in capsys.readouterr().out


def test_a_moved_sphere_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*write(tmp_path, moved=True), "--radius", str(RADIUS), "--json"]) == ExitCode.ACCEPTED
    document = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in document["targets"] if not one["used"]] == ["S2"]


@pytest.mark.parametrize(
    ("edit", "more", "complaint"),
    [
        (lambda text: text, [], "--radius"),
        (lambda text: text.replace("S1,", "S0,"), ["--radius", "0.0725"], "2 targets are called S0"),
        (lambda text: text.replace("row,", "line,"), ["--radius", "0.0725"], "row and column if they were picked"),
        (lambda text: text.replace("4.0,1.0,0.5", "4.0,,0.5"), ["--radius", "0.0725"], "S0 has y empty"),
        (lambda text: text.splitlines()[0], ["--radius", "0.0725"], "no targets"),
        (lambda text: text, ["--radius", "0.4"], "S0"),
        (lambda text: text, ["--radius", "0.0725", "--sigma", "-1"], "sigma"),
    ],
)
def test_bad_input_is_refused_in_a_sentence(
    tmp_path: Path, edit: object, more: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = write(tmp_path)
    file = tmp_path / "spheres.csv"
    file.write_text(edit(file.read_text()))  # type: ignore[operator]
    assert main([*words, *more]) == ExitCode.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert complaint in line
    assert not (tmp_path / "out").exists()
