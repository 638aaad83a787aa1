"""Pieces of a mosaic refined against each other: as exact as their surfaces allow, and never worse."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.acquisition.devices import PanTilt
from ladarreg_core.frames import Rigid
from ladarreg_core.range_alignment.adjustment import off_planes, planes_of
from ladarreg_core.range_alignment.piece_refinement import Refinement, _views, refine_pieces
from ladarreg_core.scanner.grids import AzimuthElevation
from tests.mosaic_pieces import MOUNT, mosaic

FINE = AzimuthElevation(160, 220, np.radians(0.25), np.radians(0.25))
PANS, TILTS = (-66.0, -22.0, 22.0, 66.0), (-14.0, 14.0)
POSITIONS = [PanTilt(*np.radians([pan, tilt])) for tilt in TILTS for pan in PANS]
OFF_RAD = float(np.radians(0.1))


@pytest.fixture(scope="module")
def refined() -> tuple[Refinement, list[Rigid], list[Rigid]]:
    pieces, truth = mosaic(PANS, TILTS, geometry=FINE, sigma_m=0.002, off_rad=OFF_RAD)
    return refine_pieces(pieces, POSITIONS, mount=MOUNT), [one.world_from_scanner for one in pieces], truth


def errors_deg(poses: list[Rigid], truth: list[Rigid]) -> list[float]:
    """Return the angles between poses and the truth but for what turns all of them alike."""
    together = sum((true.rotation @ pose.rotation.T for pose, true in zip(poses, truth, strict=True)), np.zeros((3, 3)))
    u, _, vt = np.linalg.svd(together)
    turn = Rigid(u @ vt, np.zeros(3))
    return [float(np.degrees((turn @ pose).angle_to(true))) for pose, true in zip(poses, truth, strict=True)]


def test_pieces_come_ten_times_closer_to_the_truth(refined: tuple[Refinement, list[Rigid], list[Rigid]]) -> None:
    found, before, truth = refined
    after = [piece.world_from_scanner for piece in found.pieces]
    assert found.accepted
    assert {piece.state for piece in found.pieces} == {"refined"}
    assert max(errors_deg(before, truth)) > 0.08
    assert max(errors_deg(after, truth)) < 0.015
    assert max(one.distance_to(true) for one, true in zip(after, truth, strict=True)) < 0.002
    assert found.held_out_after_m < 0.7 * found.held_out_before_m


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
