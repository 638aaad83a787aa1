"""Clouds without intensity: they are read, and the scan says that its shape is compared alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.errors import FormatError, UnderspecifiedError
from ladarreg_core.formats.registry import read_scan
from ladarreg_core.scan import NO_INTENSITY_NOTE, Scan
from testing.files.small_scans import e57_fields, e57_file, pcd_bytes
from tests.formats.test_ply import ply_bytes


def points_of(wall: Scan) -> np.ndarray:
    return wall.points[wall.valid].astype(np.float64)


def as_pcd(folder: Path, wall: Scan) -> Path:
    path = folder / "a.pcd"
    path.write_bytes(pcd_bytes(points_of(wall), None))
    return path


def as_ply(folder: Path, wall: Scan) -> Path:
    path = folder / "a.ply"
    path.write_bytes(ply_bytes({axis: points_of(wall)[:, k] for k, axis in enumerate("xyz")}))
    return path


def as_text(folder: Path, wall: Scan, head: str = "x,y,z") -> Path:
    path = folder / "a.csv"
    np.savetxt(path, points_of(wall), fmt="%.6f", delimiter=",", header=head, comments="")
    return path


def as_pts(folder: Path, wall: Scan) -> Path:
    path = folder / "a.pts"
    points = points_of(wall)
    np.savetxt(path, points, fmt="%.6f", header=str(len(points)), comments="")
    return path


def as_ptx(folder: Path, wall: Scan) -> Path:
    rows, columns = wall.shape
    pose = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    ordered = np.nan_to_num(wall.points[::-1, ::-1].transpose(1, 0, 2).reshape(-1, 3))
    path = folder / "a.ptx"
    path.write_text(f"{columns}\n{rows}\n{pose}" + "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in ordered))
    return path


def as_las(folder: Path, wall: Scan) -> Path:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [1e-4] * 3
    data = laspy.LasData(header)
    data.x, data.y, data.z = points_of(wall).T
    data.write(folder / "a.las")
    return folder / "a.las"


def as_e57(folder: Path, wall: Scan, *, grid: bool) -> Path:
    fields = e57_fields(wall, grid=grid)
    del fields["intensity"]
    return e57_file(folder / "a.e57", fields)


WRITERS: dict[str, Callable[[Path, Scan], Path]] = {
    "pcd": as_pcd,
    "ply": as_ply,
    "csv": as_text,
    "pts": as_pts,
    "ptx": as_ptx,
    "las": as_las,
    "e57, gridded": lambda folder, wall: as_e57(folder, wall, grid=True),
    "e57, a cloud": lambda folder, wall: as_e57(folder, wall, grid=False),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", WRITERS)
def test_a_cloud_without_intensity_is_read_and_says_so(kind: str, tmp_path: Path, wall: Scan) -> None:
    scan = read_scan(WRITERS[kind](tmp_path, wall))
    assert not scan.has_intensity
    assert scan.notes.count(NO_INTENSITY_NOTE) == 1
    assert np.count_nonzero(scan.valid) > 0.95 * np.count_nonzero(wall.valid)


@pytest.mark.parametrize("kind", ["pcd", "ply", "csv", "ptx", "e57, gridded"])
def test_no_luminance_is_taken_of_colors_that_are_not_there(kind: str, tmp_path: Path, wall: Scan) -> None:
    with pytest.raises(FormatError, match=r"neither intensity nor colours.*leave out `intensity='luma'`"):
        read_scan(WRITERS[kind](tmp_path, wall), intensity="luma")


def test_a_column_that_may_be_the_intensity_is_to_be_named(tmp_path: Path, wall: Scan) -> None:
    path = as_text(tmp_path, wall)
    path.write_text("x,y,z,value\n" + "".join(f"{x},{y},{z},{k % 7}\n" for k, (x, y, z) in enumerate(points_of(wall))))
    with pytest.raises(UnderspecifiedError, match="none of which is called an intensity: name the column"):
        read_scan(path)
    assert not read_scan(path, columns=("x", "y", "z", "-")).has_intensity
    assert read_scan(path, columns=("x", "y", "z", "intensity")).has_intensity


def test_an_intensity_that_is_the_same_everywhere_is_said(tmp_path: Path, wall: Scan) -> None:
    points = points_of(wall)
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd_bytes(points, np.full(len(points), 5.0)))
    assert "the intensity is 5 everywhere: only the scan's shape can be compared with a photo" in read_scan(path).notes


@pytest.mark.long
def test_a_registration_from_such_a_file_compares_the_shape(tmp_path: Path) -> None:
    pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
    from ladarreg_core.simulate.outdoor_case import simulate_outdoors

    case = simulate_outdoors("courtyard", lidar="petals", seed=102)
    path = tmp_path / "frames.pcd"
    path.write_bytes(pcd_bytes(case.cloud.points, None))
    result = lr.register(lr.read_scan(path), case.photo)
    assert result.accepted, result.reasons
    assert any("only its shape was compared" in reason for reason in result.reasons), result.reasons
