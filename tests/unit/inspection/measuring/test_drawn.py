"""How measurements are drawn in pictures, against projections and visibility by hand."""

from __future__ import annotations

from functools import cache
from typing import get_args

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.frames import Rigid
from ladarreg_core.inspection.measuring.drawn import drawn_from_scanner, drawn_in_photo, lines_of, may_be_drawn
from ladarreg_core.inspection.measuring.measurement import KINDS
from ladarreg_core.project.document import MeasurementKind
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.visibility.visible_points import Occluder

CAMERA = lr.Camera.from_focal(600, 400, 500.0)
CENTRE = np.array([0.2, -0.8, 0.1])
"""On the right of the scanner: the screen hides a strip of the wall that the scanner sees."""
POSE = Rigid.from_centre(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), CENTRE)


@cache
def step_scan() -> Scan:
    """A wall at 4 m, before which a screen stands at 2 m on the right, as far as the scanner's axis."""
    geometry = AzimuthElevation(200, 300, 0.004, 0.004)
    rays = geometry.rays
    ranges = np.where(rays[..., 1] < 0, 2.0, 4.0) / rays[..., 0]
    return Scan(geometry, ranges, np.ones(ranges.shape))


@cache
def result() -> PoseResult:
    photo = lr.Photo(np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8), CAMERA)
    return lr.given_pose(step_scan(), photo, POSE, check_images=False)


def pixels(points: object) -> np.ndarray:
    x, y, z = np.moveaxis(np.asarray(points, float) - CENTRE, -1, 0)
    return np.stack([299.5 - 500 * y / x, 199.5 - 500 * z / x], axis=-1)


def measured(kind: MeasurementKind, points: object) -> lr.Measurement:
    return lr.measure(kind, lr.MeasuredPoints.given(np.asarray(points, float), sigma_m=0.001))


def test_kinds_of_a_document_are_those_that_can_be_measured() -> None:
    assert get_args(MeasurementKind) == KINDS


@pytest.mark.parametrize(
    ("kind", "points", "lines"),
    [
        ("point", [[4, 1, 0]], []),
        ("distance", [[4, 1, 0], [4, 2, 0]], [(0, 1)]),
        ("polyline", [[4, 1, 0], [4, 2, 0], [4, 2, 1]], [(0, 1), (1, 2)]),
        ("angle", [[4, 1, 0], [4, 2, 0], [4, 2, 1]], [(0, 1), (1, 2)]),
        ("area", [[4, 1, 0], [4, 2, 0], [4, 2, 1]], [(0, 1), (1, 2), (2, 0)]),
    ],
)
def test_lines_join_the_points(kind: MeasurementKind, points: list[list[float]], lines: list[tuple[int, int]]) -> None:
    wanted = np.array([[points[a], points[b]] for a, b in lines], float).reshape(-1, 2, 3)
    np.testing.assert_allclose(lines_of(measured(kind, points)), wanted)


def test_a_height_falls_onto_its_plane() -> None:
    down, *around = lines_of(measured("height", [[3, 0.5, 0.7], [2, 0, 0], [4, 0, 0], [4, 2, 0], [2, 2, 0]]))
    np.testing.assert_allclose(down, [[3, 0.5, 0.7], [3, 0.5, 0]], atol=1e-9)
    assert len(around) == 4


def test_the_scanner_sees_directions() -> None:
    points = np.array([[4.0, 1, 0], [4, 2, 0.5]])
    drawn = drawn_from_scanner(measured("distance", points))
    np.testing.assert_allclose(drawn.ends, points / np.linalg.norm(points, axis=1, keepdims=True))
    (line,) = drawn.lines
    np.testing.assert_allclose(line[[0, -1]], drawn.ends)
    np.testing.assert_allclose(np.linalg.norm(line, axis=1), 1)


def test_a_photograph_shows_what_is_not_hidden_in_it() -> None:
    on_screen, behind, free = [2.0, -0.5, 0.1], [4.0, 0.02, 0.1], [4.0, 1.2, -0.2]
    # the ray from the camera to `behind` passes x = 2 at y = -0.4, where the screen stands
    occluder = Occluder(step_scan(), CAMERA, POSE)
    drawn = drawn_in_photo(measured("polyline", [on_screen, behind, free]), result(), occluder)
    wanted = pixels([on_screen, behind, free])
    np.testing.assert_allclose(drawn.ends[[0, 2]], wanted[[0, 2]])
    assert np.isnan(drawn.ends[1]).all()
    assert np.isfinite(drawn.lines).all(), "each line has an end that is seen"
    drawn = drawn_in_photo(measured("distance", [behind, [4.0, 0.05, 0.2]]), result(), occluder)
    assert np.isnan(drawn.lines).all()
    drawn = drawn_in_photo(measured("distance", [behind, [4.0, 0.05, 0.2]]), result(), occluder, seen=[True, False])
    np.testing.assert_allclose(drawn.ends[0], wanted[1])
    assert np.isfinite(drawn.lines).all()


def test_what_is_outside_of_the_photograph_is_not_drawn() -> None:
    inside, outside, in_the_back = [4.0, -1.0, 0.0], [4.0, 3.5, 0.0], [-4.0, -1.0, 0.0]
    for away in (outside, in_the_back):
        drawn = drawn_in_photo(measured("distance", [inside, away]), result())
        assert np.isnan(drawn.ends[1]).all()
        (line,) = drawn.lines
        known = np.isfinite(line[:, 0])
        assert 1 <= known.sum() < len(line)
        assert known[0]
        assert ((line[known] >= -0.5) & (line[known] <= [599.5, 399.5])).all()
    assert not may_be_drawn(measured("distance", [outside, in_the_back]), result())
    assert may_be_drawn(measured("distance", [outside, inside]), result())


def test_around_the_seam_of_a_panorama_a_line_is_not_drawn_across_the_picture() -> None:
    camera = lr.EquirectangularCamera(800, 400)
    photo = lr.Photo(np.zeros((camera.height, camera.width, 3), np.uint8), camera)
    found = lr.given_pose(step_scan(), photo, POSE, check_images=False)
    drawn = drawn_in_photo(measured("distance", [[-4.0, -2.6, 0.0], [-4.0, -0.6, 0.0]]), found)
    assert np.isfinite(drawn.ends).all()
    steps = np.diff(drawn.lines[0], axis=0)
    assert np.isnan(steps).any()
    assert np.abs(steps[np.isfinite(steps)]).max() < 400
