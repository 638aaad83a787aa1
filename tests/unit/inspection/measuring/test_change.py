"""Change between scans: what was moved is found, and what was not is significant once in twenty."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.inspection.measuring.change_files import write_change
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation

GRID = AzimuthElevation(110, 150, 0.008, 0.008)
COVARIANCE = np.diag([3e-4, 3e-4, 3e-4, 2e-3, 2e-3, 2e-3]) ** 2
AFTER = Rigid(rotation_from_rotvec((0, 0, 0.1)), np.array([0.1, -0.3, 0.05]))
LENGTHS = {"spacing_m": 0.3, "radius_m": 0.15}


def scanned(pose: Rigid, rng: np.random.Generator, *, panel_m: float = 0.0, noise_m: float = 0.002) -> Scan:
    """A wall at X = 3 and a floor at Z = -1, of which a part of the wall, 1 m wide, stands out."""
    rays = GRID.rays.astype(float) @ pose.rotation.T
    origin = pose.translation
    with np.errstate(divide="ignore"):
        wall, floor = (3 - origin[0]) / rays[..., 0], (-1 - origin[2]) / np.minimum(rays[..., 2], -1e-9)
        front = (3 - panel_m - origin[0]) / rays[..., 0]
    at = origin + front[..., None] * rays
    wall = np.where((np.abs(at[..., 1]) < 0.5) & (np.abs(at[..., 2]) < 0.5), front, wall)
    ranges = np.minimum(wall, floor) + rng.normal(0, noise_m, GRID.shape)
    return Scan(GRID, ranges, np.full(GRID.shape, 100.0))


@pytest.mark.long
def test_where_nothing_has_changed_one_point_in_twenty_is_significant() -> None:
    rng = np.random.default_rng(4)
    shares, controls = [], []
    for _ in range(60):
        off = rng.multivariate_normal(np.zeros(6), COVARIANCE)
        pose = Rigid(rotation_from_rotvec(-off[:3]) @ AFTER.rotation, AFTER.translation - off[3:])
        before, after = scanned(Rigid.identity(), rng), scanned(AFTER, rng)
        found = lr.change(before, after, before_from_after=pose, covariance=COVARIANCE, **LENGTHS)
        shares.append(found.as_fields()["significant_share"])
        if len(controls) < 10:
            control = lr.change(before, after, before_from_after=pose, **LENGTHS)
            controls.append(control.as_fields()["significant_share"])
    # the points of a pair share its error of the pose, so that shares differ from pair to pair
    assert abs(np.mean(shares) - 0.05) < 3 * np.std(shares) / np.sqrt(len(shares)) + 0.005
    assert np.mean(controls) > 0.2


def test_a_part_that_stands_out_is_found_with_its_height() -> None:
    rng = np.random.default_rng(0)
    before, after = scanned(Rigid.identity(), rng), scanned(AFTER, rng, panel_m=0.03)
    for one, other, pose, height in ((before, after, AFTER, 0.03), (after, before, AFTER.inverse, -0.03)):
        found = lr.change(one, other, before_from_after=pose, covariance=COVARIANCE / 9, **LENGTHS)
        at = found.points if one is before else AFTER @ found.points
        inside = (np.abs(at[:, 1:]) < 0.3).all(axis=1) & (at[:, 0] > 2.5) & found.known
        assert inside.sum() >= 3
        np.testing.assert_allclose(found.distance_m[inside], height, atol=0.004)
        assert found.significant[inside].all()
        away = (np.abs(at[:, 1]) > 0.8) & found.known
        assert found.significant[away].mean() < 0.4


def test_a_comparison_is_written_and_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    before, after = scanned(Rigid.identity(), rng), scanned(AFTER, rng, panel_m=0.03)
    found = lr.change(before, after, before_from_after=AFTER, **LENGTHS)
    write_change(tmp_path / "out", found, before, before_from_after=AFTER)
    document = json.loads((tmp_path / "out" / "change.json").read_text(encoding="utf-8"))
    assert document["significant"] == found.significant.sum()
    head, _, body = (tmp_path / "out" / "change.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property")]
    kinds = [line.split()[1] for line in head.decode().splitlines() if line.startswith("property")]
    dtype = list(zip(names, [{"float": "<f4", "uchar": "u1"}[kind] for kind in kinds], strict=True))
    rows = np.frombuffer(body, dtype=dtype)
    np.testing.assert_allclose(rows["distance"], found.distance_m, rtol=1e-6)
    np.testing.assert_array_equal(rows["significant"] > 0, found.significant)
    assert (tmp_path / "out" / "change.png").stat().st_size > 1000


def test_poses_that_do_not_fit_are_refused() -> None:
    rng = np.random.default_rng(0)
    scan = scanned(Rigid.identity(), rng)
    placed = lr.Scan(scan.geometry, scan.ranges, scan.intensity, world_from_scanner=Rigid.identity())
    with pytest.raises(lr.LadarregError, match="only one of both"):
        lr.change(scan, placed, **LENGTHS)
    with pytest.raises(lr.LadarregError, match="share no surface"):
        lr.change(scan, scan, before_from_after=Rigid.from_rotvec((0, 0, 0), (50, 0, 0)), **LENGTHS)
    with pytest.raises(lr.LadarregError, match="radius_m"):
        lr.change(scan, scan, radius_m=0)
    with pytest.raises(lr.LadarregError, match="covariance"):
        lr.change(scan, scan, covariance=-np.eye(6))
