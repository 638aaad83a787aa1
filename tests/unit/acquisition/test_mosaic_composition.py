"""Mosaics: the composed surface is the room's, around the full turn and over the pole, from one piece a cell."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.acquisition.alignment.mosaic_piece import PlacedPiece
from ladarreg_core.acquisition.composition.mosaic_composition import compose_mosaic
from ladarreg_core.errors import Cancelled, ShapeError
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation, SphericalGrid
from ladarreg_core.scanner.pan_tilt import pan_tilt_pose
from testing.scenes.box_room import distances, off_surface
from testing.scenes.mosaic_pieces import MOUNT, STEP_RAD, mosaic, piece_scan, placed

COARSE = AzimuthElevation(37, 51, np.radians(1.0), np.radians(1.0))


@pytest.mark.slow
@pytest.mark.parametrize(
    "mount",
    [pytest.param(Rigid.identity(), id="central", marks=pytest.mark.long), pytest.param(MOUNT, id="on a lever arm")],
)
def test_a_mosaic_of_the_whole_room_lies_on_its_surfaces(mount: Rigid) -> None:
    pieces, _ = mosaic(range(-180, 180, 40), (-28, 0, 28, 58, 80), mount=mount, geometry=COARSE)
    made = compose_mosaic(pieces)
    grid = made.scan.geometry
    assert isinstance(grid, SphericalGrid)
    assert grid.columns == 360
    assert made.scan.valid[0].all(), "the zenith is a hole"
    assert made.scan.valid[:130].mean() > 0.999
    true = distances(np.zeros(3), made.scan.rays)
    wrong = np.abs(made.scan.ranges - true)[made.scan.valid]
    assert np.quantile(wrong, 0.97) < 0.004
    assert np.median(wrong) < 2e-4
    points = made.scan.points[made.scan.valid]
    assert np.quantile(off_surface(points), 0.999) < 0.03
    light = 300 + made.scan.points @ np.array([1.0, 10.0, 100.0], np.float32)
    assert np.quantile(np.abs(made.scan.intensity - light)[made.scan.valid], 0.98) < 0.6
    # Both sides of the seam belong together as any two columns do.
    seam, others = (np.nanmedian(np.abs(np.diff(made.scan.ranges[:, [a, b]], axis=1))) for a, b in ((0, -1), (90, 91)))
    assert seam < 3 * others + 0.02


def test_every_cell_is_from_one_piece_and_is_counted() -> None:
    pieces, _ = mosaic((-20, 0, 20), (-10, 10), geometry=COARSE)
    made = compose_mosaic(pieces)
    assert ((made.piece_of_cell >= 0) == made.scan.valid).all()
    for number, counts in enumerate(made.pieces):
        assert counts.shown == (made.piece_of_cell == number).sum()
    assert {*np.unique(made.piece_of_cell)} <= {-1, *range(6)}
    assert made.overlapping > 0


def test_two_surfaces_are_never_averaged() -> None:
    near, far = (
        Scan(COARSE, np.full(COARSE.shape, metres, np.float32), np.full(COARSE.shape, light, np.float32))
        for metres, light in ((2.0, 10.0), (3.0, 90.0))
    )
    left, right = (pan_tilt_pose(np.radians(pan), 0.0) for pan in (10, -10))
    made = compose_mosaic([placed(near, left), placed(far, right)])
    values = made.scan.ranges[made.scan.valid]
    assert (np.isclose(values, 2.0, atol=1e-5) | np.isclose(values, 3.0, atol=1e-5)).all()
    assert {*np.unique(np.round(made.scan.intensity[made.scan.valid], 3))} == {10.0, 90.0}
    assert made.disagreeing > 0


def test_what_most_pieces_agree_on_wins() -> None:
    wall = Scan(COARSE, np.full(COARSE.shape, 3.0, np.float32), np.ones(COARSE.shape, np.float32))
    somebody = Scan(COARSE, np.full(COARSE.shape, 1.0, np.float32), np.ones(COARSE.shape, np.float32))
    ahead, beside = pan_tilt_pose(0.0, 0.0), pan_tilt_pose(np.radians(15), 0.0)
    made = compose_mosaic([placed(somebody, ahead), placed(wall, beside), placed(wall, ahead)])
    middle = made.scan.ranges[15:20, 25:45]
    assert np.isclose(middle, 3.0, atol=1e-4).all()


def test_holes_stay_holes_and_keep_their_direction() -> None:
    scan = piece_scan(Rigid.identity(), COARSE)
    ranges = scan.ranges.copy()
    ranges[10:20, 20:30] = np.nan
    made = compose_mosaic([placed(Scan(COARSE, ranges, scan.intensity), Rigid.identity())])
    ray = COARSE.ray_at([15, 25])
    row, column = np.rint(made.scan.geometry.cell_of(ray)).astype(int)
    assert np.isnan(made.scan.ranges[row, column])
    assert np.isfinite(made.scan.rays).all()


def test_a_surface_hidden_by_a_nearer_one_is_dropped_and_counted() -> None:
    arm = Rigid(np.eye(3), np.array([0.0, 0.5, 0.0]))
    pieces, _ = mosaic((-30, 0, 30), (0,), mount=arm, geometry=COARSE)
    made = compose_mosaic(pieces)
    assert made.folded > 20
    true = distances(np.zeros(3), made.scan.rays)
    beyond = (made.scan.ranges - true)[made.scan.valid] > 0.3
    assert beyond.mean() < 0.01


def test_pieces_are_read_again_when_the_memory_for_them_is_used_up(monkeypatch: pytest.MonkeyPatch) -> None:
    pieces, _ = mosaic((-40, 0, 40), (0,), geometry=COARSE)
    whole = compose_mosaic(pieces)
    monkeypatch.setattr("ladarreg_core.acquisition.composition.mosaic_composition._CACHE_BYTES", 1)
    monkeypatch.setattr("ladarreg_core.acquisition.composition.mosaic_composition._TILE", (16, 40))
    small = compose_mosaic(pieces)
    np.testing.assert_array_equal(small.scan.ranges, whole.scan.ranges)
    np.testing.assert_array_equal(small.piece_of_cell, whole.piece_of_cell)


def test_it_can_be_cancelled_and_refuses_nothing_at_all() -> None:
    def stop(_: object) -> None:
        raise Cancelled

    pieces, _ = mosaic((0,), (0,), geometry=COARSE)
    with pytest.raises(Cancelled):
        compose_mosaic(pieces, report=stop)
    with pytest.raises(ShapeError, match="no piece"):
        compose_mosaic([])
    assert STEP_RAD > 0


def test_a_piece_is_looked_up_only_where_it_may_show_something() -> None:
    read = []

    def load(number: int, scan: Scan) -> Scan:
        read.append(number)
        return scan

    pieces, _ = mosaic((-60, 60), (0,), geometry=COARSE)
    counted = [
        PlacedPiece(lambda k=k, one=one: load(k, one.load()), one.world_from_scanner, one.name)  # type: ignore[misc]
        for k, one in enumerate(pieces)
    ]
    compose_mosaic(counted)
    assert read.count(0) == read.count(1) == 2, "each is read once for its extent and once for its surface"
