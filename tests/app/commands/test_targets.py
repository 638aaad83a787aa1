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


@pytest.mark.slow
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


OTHER = lr.Rigid.from_rotvec([-0.01, 0.02, -0.35], [-0.2, 1.1, 0.0])


def write_two(folder: Path) -> list[str]:
    """Write two scans with the same spheres before walls of their own; return the command on them, without a table."""
    azimuth, elevation = np.radians(np.arange(50, -50, -0.15)), np.radians(np.arange(16, -16, -0.15))
    cosines = np.cos(elevation)[:, None] * np.cos(azimuth)
    for k, (name, pose) in enumerate((("hall", POSE), ("attic", OTHER))):
        ranges = (7.0 + k) / cosines + np.random.default_rng(k).normal(0, 0.002, cosines.shape)
        scan = with_spheres(
            lr.Scan.from_grid(ranges=ranges, azimuth_rad=azimuth, elevation_rad=elevation),
            pose.inverse @ WORLD, RADIUS, noise_m=0.002, seed=k,
        )  # fmt: skip
        np.savez(folder / f"{name}.npz", xyz=scan.points, intensity=np.full(scan.shape, 100.0))
    files = [str(folder / "hall.npz"), str(folder / "attic.npz")]
    return ["targets", *files, "-o", str(folder / "out"), "--quiet", "--radius", str(RADIUS)]


def picks(folder: Path, name: str, pose: lr.Rigid) -> list[str]:
    scan = lr.read_scan(folder / f"{name}.npz")
    lines = []
    for k, center in enumerate(pose.inverse @ WORLD):
        row, column = np.unravel_index(np.argmax(scan.rays @ (center / np.linalg.norm(center))), scan.shape)
        lines.append(f"{name},S{k},{row},{column}")
    return lines


@pytest.mark.slow
def test_two_scans_are_joined_by_what_is_found_in_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = write_two(tmp_path)
    assert main([*words, "--json"]) == ExitCode.ACCEPTED
    document = json.loads(capsys.readouterr().out)
    truth = POSE.inverse @ OTHER
    first, second = (lr.Rigid.from_matrix(one["world_from_scanner"]) for one in document["stations"])
    assert np.allclose(first.matrix, np.eye(4))
    assert second.distance_to(truth) < 0.006
    assert [one["state"] for one in document["stations"]] == ["fixed", "registered"]
    assert {one["name"] for one in document["targets"]["targets"]} == {f"T{k}" for k in range(1, 6)}
    placed = lr.read_scan(tmp_path / "out" / "attic.npz")
    assert placed.world_from_scanner.distance_to(second) < 1e-6
    with (tmp_path / "out" / "targets.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["scan"] for row in rows} == {"hall", "attic"}
    assert all(row["used"] == "1" and float(row["length_mm"]) < 5 for row in rows)
    # the folder is one of stations for all other commands
    assert main(["info", str(tmp_path / "out")]) == ExitCode.ACCEPTED
    assert "attic: at" in capsys.readouterr().out
    export = ["export", str(tmp_path / "out"), "--to", "e57", "-o", str(tmp_path / "handover")]
    assert main(export) == ExitCode.ACCEPTED
    assert main([*words, "--force"]) == ExitCode.ACCEPTED
    assert "Target   attic, T1:" in capsys.readouterr().out


@pytest.mark.slow
def test_coordinates_put_both_scans_into_their_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = write_two(tmp_path)
    surveyed = [f"S{k},{x},{y},{z}" for k, (x, y, z) in enumerate(WORLD)]
    table = tmp_path / "spheres.csv"
    table.write_text("\n".join(["name,x,y,z", *surveyed]))
    assert main([*words[:3], str(table), *words[3:], "--json"]) == ExitCode.ACCEPTED
    document = json.loads(capsys.readouterr().out)
    for one, pose in zip(document["stations"], (POSE, OTHER), strict=True):
        assert lr.Rigid.from_matrix(one["world_from_scanner"]).distance_to(pose) < 0.006
        assert one["state"] == "registered"
    assert {one["name"] for one in document["targets"]["coordinates"]} == {f"S{k}" for k in range(5)}


@pytest.mark.slow
def test_picks_of_several_scans_name_their_scan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = write_two(tmp_path)
    lines = [f"{line},,," for line in picks(tmp_path, "hall", POSE) + picks(tmp_path, "attic", OTHER)]
    x, y, z = WORLD[1]
    lines[1] = lines[1].replace(",,,", f",{x},{y},{z}")
    table = tmp_path / "picks.csv"
    table.write_text("\n".join(["scan,name,row,column,x,y,z", *lines]))
    assert main([*words[:3], str(table), *words[3:]]) == ExitCode.ACCEPTED
    assert "of 1 target in the scans" in capsys.readouterr().out
    table.write_text("\n".join(["scan,name,row,column,x,y,z", *lines]).replace("attic", "cellar"))
    assert main([*words[:3], str(table), *words[3:], "--force"]) == ExitCode.BAD_INPUT
    assert "picked in scan cellar; name the scans in a column scan: hall, attic" in capsys.readouterr().err
    table.write_text("\n".join(["name,row,column", "S0,3,4", "S1,8,9"]))
    assert main([*words[:3], str(table), *words[3:], "--force"]) == ExitCode.BAD_INPUT
    assert "a scan that is not named" in capsys.readouterr().err


def test_several_scans_need_a_size_and_one_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = write_two(tmp_path)
    assert main(words[:-2]) == ExitCode.BAD_INPUT
    assert "--radius" in capsys.readouterr().err
    table = tmp_path / "spheres.csv"
    table.write_text("name,x,y,z\nS0,1,2,3\n")
    assert main([*words[:3], str(table), str(table), *words[3:]]) == ExitCode.BAD_INPUT
    assert "2 files of targets" in capsys.readouterr().err
    table.write_text("scan,name,row,column,x,y,z\na,S0,1,2,1,2,3\nb,S0,1,2,1,2,4\na,S1,1,2,1,,\n")
    assert main([*words[:3], str(table), *words[3:]]) == ExitCode.BAD_INPUT
    assert "S1 has y empty" in (said := capsys.readouterr().err)
    assert "S0 has several coordinates" in said
