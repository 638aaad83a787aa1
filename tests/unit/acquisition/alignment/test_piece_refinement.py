"""Pieces of a mosaic refined against each other: as exact as their surfaces allow, and never worse."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import ArrayLike

from ladarreg_core.acquisition.alignment.adjustment import off_planes, planes_of
from ladarreg_core.acquisition.alignment.piece_refinement import _views, refine_pieces
from ladarreg_core.acquisition.alignment.refined_pieces import Refinement
from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.grids import AzimuthElevation, TabulatedGrid
from ladarreg_core.scanner.pan_tilt import pan_tilt_pose
from ladarreg_core.scanner.ray_table import RayTableInverse
from testing.scenes.mosaic_pieces import MOUNT, mosaic, piece_scan, placed

FINE = AzimuthElevation(160, 220, np.radians(0.25), np.radians(0.25))
PANS, TILTS = (-66.0, -22.0, 22.0, 66.0), (-14.0, 14.0)
POSITIONS = [PanTilt(*np.radians([pan, tilt])) for tilt in TILTS for pan in PANS]
OFF_RAD = float(np.radians(0.1))


TOLD: list[Progress] = []


@pytest.fixture(scope="module")
def refined() -> tuple[Refinement, list[Rigid], list[Rigid]]:
    pieces, truth = mosaic(PANS, TILTS, geometry=FINE, sigma_m=0.002, off_rad=OFF_RAD)
    found = refine_pieces(pieces, POSITIONS, mount=MOUNT, report=TOLD.append)
    return found, [one.world_from_scanner for one in pieces], truth


@pytest.mark.slow
def test_the_progress_is_that_of_the_whole(refined: tuple[Refinement, list[Rigid], list[Rigid]]) -> None:
    shares = [one.done / one.total for one in TOLD]
    assert all(before <= after for before, after in pairwise(shares))
    assert shares[0] == 0
    assert max(np.diff([*shares, 1.0])) < 0.25
    assert {"reading the pieces", "finding what pieces share", "aligning the pieces"} <= {one.label for one in TOLD}


@pytest.mark.long
def test_cells_of_rays_in_tables_are_rarely_sought(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes as long as all the rest; scans in which each cell has a ray of its own were refined for minutes."""
    pieces, truth = mosaic(PANS, TILTS, geometry=FINE, sigma_m=0.002, off_rad=OFF_RAD)
    sought: list[int] = []
    seek = RayTableInverse.cell_of

    def cell_of(inverse: RayTableInverse, directions: ArrayLike) -> FloatArray:
        sought.append(np.asarray(directions).size // 3)
        return seek(inverse, directions)

    monkeypatch.setattr(RayTableInverse, "cell_of", cell_of)
    scans = [replace(scan, geometry=TabulatedGrid(scan.geometry.rays)) for scan in (piece.load() for piece in pieces)]
    tables = [replace(piece, load=lambda scan=scan: scan) for piece, scan in zip(pieces, scans, strict=True)]
    found = refine_pieces(tables, POSITIONS, mount=MOUNT)
    assert found.accepted
    assert max(errors_deg([one.world_from_scanner for one in found.pieces], truth)) < 0.015
    links = len(PANS) * len(TILTS) * (len(PANS) * len(TILTS) - 1)
    assert len(sought) < 10 * links, "of each at every step they were more than a hundred times as many"
    assert sum(sought) < 40 * len(tables) * FINE.rows * FINE.columns


def errors_deg(poses: list[Rigid], truth: list[Rigid]) -> list[float]:
    """Return the angles between poses and the truth but for what turns all of them alike."""
    together = sum((true.rotation @ pose.rotation.T for pose, true in zip(poses, truth, strict=True)), np.zeros((3, 3)))
    u, _, vt = np.linalg.svd(together)
    turn = Rigid(u @ vt, np.zeros(3))
    return [float(np.degrees((turn @ pose).angle_to(true))) for pose, true in zip(poses, truth, strict=True)]


@pytest.mark.slow
def test_pieces_come_ten_times_closer_to_the_truth(refined: tuple[Refinement, list[Rigid], list[Rigid]]) -> None:
    found, before, truth = refined
    after = [piece.world_from_scanner for piece in found.pieces]
    assert found.accepted
    assert {piece.state for piece in found.pieces} == {"refined"}
    assert max(errors_deg(before, truth)) > 0.08
    assert max(errors_deg(after, truth)) < 0.015
    assert max(one.distance_to(true) for one, true in zip(after, truth, strict=True)) < 0.002
    assert found.held_out_after_m < 0.7 * found.held_out_before_m


@pytest.mark.slow
def test_walls_are_single_afterwards_and_the_control_is_seen_to_be_double(
    refined: tuple[Refinement, list[Rigid], list[Rigid]],
) -> None:
    found, before, _ = refined
    pieces, _ = mosaic(PANS, TILTS, geometry=FINE, sigma_m=0.002, off_rad=OFF_RAD)
    views, _ = _views(pieces, POSITIONS, exact=False, report=None)
    after = [piece.world_from_scanner for piece in found.pieces]
    planes, owner = planes_of(views, after, apart_m=0.1, angle_rad=0.09)
    noise = np.std(off_planes(views, after, planes, owner, within_views=True))
    assert np.std(off_planes(views, after, planes, owner)) < 1.05 * noise
    assert np.std(off_planes(views, before, planes, owner)) > 1.3 * noise


def test_pieces_without_overlap_stay_where_the_unit_says() -> None:
    pieces, _ = mosaic((-66, 66), (0,), geometry=FINE, sigma_m=0.002, off_rad=OFF_RAD)
    found = refine_pieces(pieces, [PanTilt(np.radians(pan), 0.0) for pan in (-66, 66)], mount=MOUNT)
    assert not found.accepted
    assert [piece.state for piece in found.pieces] == ["no overlap"] * 2
    assert "do not overlap" in found.reasons[0]
    for piece, one in zip(pieces, found.pieces, strict=True):
        assert one.world_from_scanner is piece.world_from_scanner


@pytest.mark.long
def test_a_piece_that_was_knocked_is_found_and_said() -> None:
    pieces, truth = mosaic(PANS, TILTS, geometry=FINE, sigma_m=0.002, off_rad=OFF_RAD)
    elsewhere = truth[5] @ Rigid.from_rotvec([0.004, 0, 0], [0.0, 0.006, 0.002])
    pieces[5] = replace(pieces[5], load=lambda: piece_scan(elsewhere, FINE, sigma_m=0.002, seed=5))
    found = refine_pieces(pieces, POSITIONS, mount=MOUNT)
    assert [k for k, piece in enumerate(found.pieces) if piece.knocked] == [5]
    assert any("piece 5 does not lie where" in reason for reason in found.reasons)
    assert np.linalg.norm(found.pieces[5].shift_scanner_mm) == pytest.approx(6.3, abs=1.5)
    others = [piece for piece in found.pieces if not piece.knocked]
    assert max(np.linalg.norm(piece.shift_scanner_mm) for piece in others) < 2


def run_of_six(blow: Rigid, first: int, mount: Rigid = MOUNT) -> tuple[Refinement, list[Rigid]]:
    """Return six pieces refined with a mount as given, the scanner moved before one of them; the truth."""
    at = [one for one in POSITIONS if one.pan_rad < 1]
    truth = [pan_tilt_pose(one.pan_rad, one.tilt_rad, unit_from_scanner=MOUNT) for one in at]
    truth = [pose @ blow if k >= first else pose for k, pose in enumerate(truth)]
    off = OFF_RAD * np.random.default_rng(3).standard_normal((6, 2))
    said = [PanTilt(one.pan_rad + pan, one.tilt_rad + tilt) for one, (pan, tilt) in zip(at, off, strict=True)]
    pieces = [
        placed(
            piece_scan(pose, FINE, sigma_m=0.002, seed=k),
            pan_tilt_pose(one.pan_rad, one.tilt_rad, unit_from_scanner=mount),
        )
        for k, (one, pose) in enumerate(zip(said, truth, strict=True))
    ]
    return refine_pieces(pieces, said, mount=mount), truth


@pytest.mark.long
def test_a_blow_between_two_pieces_is_found_and_said() -> None:
    found, truth = run_of_six(Rigid.from_rotvec([0.004, 0, 0.003], [0.004, 0.006, 0.002]), 3)
    assert "between pieces 2 and 3 the scanner was moved on its unit" in found.reasons[0]
    assert [piece.knocked for piece in found.pieces] == [False] * 3 + [True] * 3
    apart = [one.world_from_scanner.distance_to(true) for one, true in zip(found.pieces, truth, strict=True)]
    assert max(apart) < 0.004  # little shows a shift upward


@pytest.mark.slow
def test_a_wrong_mount_is_said_and_nothing_refined_with_it() -> None:
    found, _ = run_of_six(Rigid.identity(), 6, MOUNT @ Rigid.from_rotvec([0, 0, 0], [0.013, 0.0176, 0]))
    assert not found.accepted
    assert {piece.state for piece in found.pieces} == {"kept"}
    assert "the mount to be off by about" in found.reasons[0]
    assert "`calibrate_mount`" in found.reasons[0]


def lamp(points: FloatArray) -> FloatArray:
    """A blank room with a short lamp on its ceiling."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.where((z > 1.4) & (np.abs(x - 0.85) < 0.06) & (np.abs(y - 0.05) < 0.14), 900.0, 300.0)


@pytest.mark.parametrize("lit", [True, False])
@pytest.mark.slow
def test_a_blank_ceiling_is_held_by_a_lamp_and_without_one_by_the_unit(lit: bool) -> None:
    at = [PanTilt(np.radians(pan), np.radians(60.0)) for pan in (-20.0, 20.0)]
    truth = [pan_tilt_pose(one.pan_rad, one.tilt_rad, unit_from_scanner=MOUNT) for one in at]
    noise = np.random.default_rng(4)

    def light(points: FloatArray) -> FloatArray:
        bright = lamp(points) if lit else np.full(points.shape[:-1], 300.0)
        return bright * (1 + 0.02 * noise.standard_normal(bright.shape))

    said, pieces = [], []
    for k, (one, pose) in enumerate(zip(at, truth, strict=True)):
        off = PanTilt(one.pan_rad + np.radians(0.35 - 0.7 * k), one.tilt_rad + np.radians(0.2 * k))
        scan = piece_scan(pose, FINE, sigma_m=0.002, seed=k, light=light)
        said.append(off)
        pieces.append(placed(scan, pan_tilt_pose(off.pan_rad, off.tilt_rad, unit_from_scanner=MOUNT)))
    found = refine_pieces(pieces, said, mount=MOUNT)
    relative = [one.world_from_scanner for one in found.pieces]
    off_deg = (relative[0].inverse @ relative[1]).angle_to(truth[0].inverse @ truth[1])
    if lit:
        assert np.degrees(off_deg) < 0.06  # a fourth of a cell, of .7 deg before
        assert {piece.state for piece in found.pieces} == {"refined"}
        assert all(piece.weak == ("pan",) for piece in found.pieces)
        assert any("held weakly in pan" in reason for reason in found.reasons)
        assert 0.5 * np.degrees(off_deg) / 3 < max(piece.sigma_deg[0] for piece in found.pieces) < 0.1
    else:
        assert {piece.state for piece in found.pieces} <= {"not determined", "kept"}
        for one, start in zip(found.pieces, pieces, strict=True):
            assert one.world_from_scanner.angle_to(start.world_from_scanner) == 0
