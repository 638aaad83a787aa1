"""What no caller should give, and still may: one clear error or a plain refusal, never a fault or a wrong pose."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.errors import CameraError, ExportError, FormatError, LadarregError, OptionError, ShapeError
from ladarreg_core.export.targets.folder import check_folder
from ladarreg_core.matching.images.photo_levels import photo_levels, working_camera
from ladarreg_core.picks.measure import matches_from_picks
from ladarreg_core.scanner.grids import AzimuthElevation, TabulatedGrid
from testing.scenes.painted_room import PaintedRoom, painted_room

GEOMETRY = AzimuthElevation(6, 8, 0.01, 0.01)
ONES = np.ones(GEOMETRY.shape)


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=3)


@pytest.mark.parametrize("size", [(1501, 1000), (1000, 1501), (1237, 841), (6000, 4000), (2999, 1001)])
def test_a_photo_of_any_size_is_brought_to_the_working_size(room: PaintedRoom, size: tuple[int, int]) -> None:
    width, height = size
    focal = 1.2 * max(size)
    photo = lr.Photo(np.zeros((height, width, 3), np.uint8), lr.Camera.from_focal(width, height, focal))
    working = working_camera(room.scan, photo.camera)
    levels = photo_levels(photo, working)
    for camera, planes, usable in zip(levels.cameras, levels.planes, levels.usable, strict=True):
        shapes = {plane.shape for plane in planes} | {usable.shape}
        assert shapes == {(camera.height, camera.width)}


def test_a_scan_of_one_single_range_fixes_no_pose(room: PaintedRoom) -> None:
    scan = lr.Scan(room.scan.geometry, np.where(room.scan.valid, 2.5, np.nan), room.scan.intensity)
    result = lr.register(scan, room.photo)
    assert not result.accepted
    assert "same range, 2.5 m" in result.reasons[0]


@pytest.mark.parametrize("scale", [1e-20, 1e9, 1e30])
def test_a_scan_at_a_scale_that_no_laser_measures_is_not_accepted(room: PaintedRoom, scale: float) -> None:
    scan = lr.Scan(room.scan.geometry, room.scan.ranges.astype(np.float64) * scale, room.scan.intensity)
    result = lr.register(scan, room.photo)
    assert not result.accepted
    assert "is implausible" in result.reasons[0]


@pytest.mark.parametrize("value", [1e39, 1e300])
def test_what_float32_cannot_hold_is_no_return_and_no_warning(value: float) -> None:
    large = 3 * ONES
    large[2, 3] = value
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scan in (lr.Scan(GEOMETRY, large, ONES), lr.Scan(GEOMETRY, ONES, large)):
            assert scan.valid.sum() == ONES.size - 1
            assert not scan.valid[2, 3]


def test_rays_that_all_look_the_same_way_are_refused() -> None:
    table = np.tile([1.0, 0.2, 0.1], (9, 9, 1)) * np.linspace(1, 5, 9)[:, None]
    with pytest.raises(ShapeError, match="have the same ray"):
        TabulatedGrid(table)


@pytest.mark.parametrize("focal", [1e-300, 1e-7, 1e13, 1e300])
def test_absurd_focal_lengths_are_refused(focal: float) -> None:
    with pytest.raises(CameraError, match="from 1e-06 to"):
        lr.Camera.from_focal(640, 480, focal)


@pytest.mark.parametrize("value", [300, -5, 0.5, np.nan, np.inf])
def test_pixels_that_bytes_cannot_hold_are_not_wrapped(value: float) -> None:
    with pytest.raises(ShapeError, match="whole numbers from 0 to 255"):
        lr.Photo(np.full((4, 5, 3), value), lr.Camera.from_focal(5, 4, 5))


def test_whole_numbers_of_another_type_are_pixels() -> None:
    photo = lr.Photo(np.full((4, 5, 3), 255.0), lr.Camera.from_focal(5, 4, 5))
    assert (photo.pixels == 255).all()


@pytest.mark.parametrize("path", [None, 0, 3.5, b"scan.npz", ["scan.npz"]])
def test_invalid_paths_are_named_in_the_error(path: Any) -> None:
    for read in (lr.read_scan, lambda p: lr.read_photo(p, focal_px=500)):
        with pytest.raises(FormatError, match="is not a path"):
            read(path)


@pytest.mark.parametrize("focal", ["a", [1, 2], np.nan, 0])
def test_a_focal_length_is_a_positive_number(focal: Any, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"focal_px is .* it must be a positive number"):
        lr.read_photo(tmp_path / "photo.png", focal_px=focal)


NONSENSE: dict[str, Callable[[PaintedRoom], Any]] = {
    "paths": lambda room: lr.register("scan.npz", "photo.png"),  # type: ignore[arg-type]
    "exchanged": lambda room: lr.register(room.photo, room.scan),  # type: ignore[arg-type]
    "a matrix as pose": lambda room: lr.register(room.scan, room.photo, initial=np.eye(4)),  # type: ignore[arg-type]
    "a dict as options": lambda room: lr.register(room.scan, room.photo, options={}),  # type: ignore[arg-type]
    "words as picks": lambda room: lr.register(room.scan, room.photo, picks=["a"]),  # type: ignore[list-item]
    "a word as picks": lambda room: lr.register(room.scan, room.photo, picks="ab"),  # type: ignore[arg-type]
    "a view of nothing": lambda room: lr.perspective_view(None),  # type: ignore[arg-type]
    "a view by a word": lambda room: lr.perspective_view(room.scan, "x"),  # type: ignore[arg-type]
    "a huge view": lambda room: lr.perspective_view(room.scan, lr.Camera.from_focal(100_000, 100_000, 5)),
    "a huge whole view": lambda room: lr.perspective_view(
        room.scan, lr.Camera.from_focal(640, 480, 1e7), whole_scan=True
    ),
    "a photo without camera": lambda room: lr.Photo(np.zeros((4, 5, 3), np.uint8), None),  # type: ignore[arg-type]
    "complex ranges": lambda room: lr.Scan(GEOMETRY, ONES * 1j, ONES),
}


@pytest.mark.parametrize("name", NONSENSE)
def test_arguments_of_another_kind_are_one_clear_line(name: str, room: PaintedRoom) -> None:
    with pytest.raises(LadarregError) as caught:
        NONSENSE[name](room)
    assert "\n" not in str(caught.value)


def test_lost_points_of_many_picks_are_counted_by_pick(room: PaintedRoom) -> None:
    ray, away = room.scan.mean_direction[None], -room.scan.mean_direction[None]
    picks = [lr.Pick(str(k), "point", away if k % 3 else ray, np.array([[5.0, 5.0]])) for k in range(30)]
    matches, notes = matches_from_picks(room.scan, picks)
    assert len(matches) == 10
    assert len(notes) == 20
    assert notes[0].startswith("Match 1: 1 of 1 points")


def test_a_place_under_a_file_is_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(ExportError, match="is not a folder"):
        check_folder(tmp_path / "file" / "deep" / "out")
    check_folder(tmp_path / "new" / "deep" / "out")
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]
