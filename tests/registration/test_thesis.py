"""The whole chain of the thesis on simulated scenes: results, reasons and limits."""

from __future__ import annotations

import re

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.frames import rotation_about
from ladarreg_core.registration.comparison import compare
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.results.steps import StepLog
from ladarreg_core.simulate import SimulatedCase
from ladarreg_core.thesis.matching.chain import ThesisOptions, solve_thesis
from testing.scenes.painted_room import PaintedRoom, painted_room
from testing.scenes.simulated import simulated

STAGES = ["linear", "constrained_linear", "simplex", "simplex_outliers_removed"]


def shift_px(case: SimulatedCase, first: lr.Rigid, second: lr.Rigid) -> float:
    """Median displacement in the photo of what it sees of the scan."""
    points = case.scan.points[case.scan.valid][::29].astype(float)
    camera = case.photo.camera
    one, other = camera.project(first @ points), camera.project(second @ points)
    return float(np.nanmedian(np.hypot(*(one - other)[camera.contains(one)].T)))


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=3)


@pytest.fixture(scope="module")
def case() -> SimulatedCase:
    return simulated("boxes", seed=41)


@pytest.fixture(scope="module")
def default(case: SimulatedCase) -> lr.Registration:
    return lr.register(case.scan, case.photo)


@pytest.mark.slow
def test_the_chain_registers_a_pair(case: SimulatedCase) -> None:
    result = lr.register(case.scan, case.photo, method="thesis")
    assert result.accepted, result.reasons
    assert result.evidence == "image"
    assert shift_px(case, case.camera_from_scanner, result.camera_from_scanner) < 1.0
    names = [step.name for step in result.steps]
    in_order = ["photo", "corners", "unconstrained search", "disparity culling", "linear"]
    assert names[:5] == in_order
    assert names[-5:] == ["constrained linear", "lines between matches", "simplex", "outliers removed", "verify"]
    assert result.options["thesis"]["matching"]["t1"] == 0.2
    lines = [name for name in result.matches.pick_ids if name.startswith("l")]
    assert len(lines) > 100
    assert 0 < result.inliers.mean() < 1


@pytest.mark.parametrize("residual", ["epipolar", "stereo"])
@pytest.mark.slow
def test_from_good_matches_the_chain_ends_where_the_default_does(
    case: SimulatedCase, default: lr.Registration, residual: str
) -> None:
    good = default.matches.subset(default.inliers)
    found = solve_thesis(good, case.photo.camera, StepLog(), options=ThesisOptions(residual=residual))
    assert found.last is not None
    assert shift_px(case, default.camera_from_scanner, found.last.camera_from_scanner) < 0.1


@pytest.mark.slow
def test_all_stages_are_compared(room: PaintedRoom) -> None:
    seen: list[str] = []
    compared = compare(room.scan, room.photo, report=lambda step: seen.append(step.name))
    assert [column.stage.name for column in compared.columns] == [*STAGES, "default"]
    last = compared.columns[-1].stage.result
    assert last is not None
    assert last.accepted
    assert room.error_px(last.camera_from_scanner) < 0.4
    for column in compared.columns:
        assert (column.texture is None) == (column.stage.result is None)
        assert column.stage.result is not None or column.stage.note
        if column.texture is not None:
            assert column.texture.image.shape[:2] == room.scan.shape
    assert "simplex" in seen
    assert "climb" in seen


def drawn_lines(room: PaintedRoom, count: int = 10, *, seed: int = 1) -> list[lr.Pick]:
    """Return lines as an operator would draw them: each on one face, with end errors of half a pixel."""
    rng = np.random.default_rng(seed)
    camera, picks = room.photo.camera, []
    points = room.scan.points.astype(float)
    while len(picks) < count:
        row, column = rng.integers(20, 280), rng.integers(20, 400)
        down, right = rng.integers(-40, 41, 2)
        cells = np.linspace([row, column], [row + down, column + right], 9).round().astype(int)
        if np.abs([down, right]).max() < 25 or (cells < 3).any() or (cells >= np.array(room.scan.shape) - 3).any():
            continue
        along = points[cells[:, 0], cells[:, 1]]
        bend = np.cross(along - along[0], along[-1] - along[0]) / np.linalg.norm(along[-1] - along[0])
        if not np.linalg.norm(bend, axis=1).max() < 0.02:
            continue
        uv = camera.project(room.camera_from_scanner @ along[[0, -1]])
        if not camera.contains(uv, border=3).all():
            continue
        rays = along[[0, -1]] / np.linalg.norm(along[[0, -1]], axis=1)[:, None]
        picks.append(lr.Pick(str(len(picks) + 1), "line", rays, uv + rng.normal(0, 0.5, (2, 2))))
    return picks


@pytest.mark.parametrize("residual", ["epipolar", "stereo"])
def test_drawn_lines_are_solved_by_the_thesis_estimators(room: PaintedRoom, residual: str) -> None:
    options = RegisterOptions(thesis=ThesisOptions(residual=residual), samples_per_line=15)
    result = lr.register(room.scan, room.photo, method="thesis", picks=drawn_lines(room, 14), options=options)
    assert result.method == "thesis"
    assert room.error_px(result.camera_from_scanner) < 4.0
    assert "unconstrained search" not in [step.name for step in result.steps]
    assert len(result.matches) > 14 * 10
    assert set(result.matches.pick_ids) <= {str(k + 1) for k in range(14)}


def test_lines_without_returns_are_reported(room: PaintedRoom) -> None:
    up = np.array([[0.6, 0.0, 0.8], [0.6, 0.1, 0.8]])
    sky = lr.Pick("sky", "line", up / np.linalg.norm(up, axis=1)[:, None], np.array([[5.0, 5.0], [9.0, 5.0]]))
    result = lr.register(room.scan, room.photo, method="thesis", picks=[*drawn_lines(room), sky])
    assert any("sky" in reason and "without a return" in reason for reason in result.reasons)
    assert "sky" not in result.matches.pick_ids


def test_too_few_drawn_matches_are_an_error(room: PaintedRoom) -> None:
    points = [lr.Pick(p.id, "point", p.scan[:1], p.photo[:1]) for p in drawn_lines(room, 3)]
    with pytest.raises(lr.LadarregError, match="matches"):
        lr.register(room.scan, room.photo, method="thesis", picks=points)


def turned_photo(case: SimulatedCase) -> lr.Photo:
    """Return the photo of a camera held upside down."""
    camera = case.photo.camera
    return lr.Photo(np.ascontiguousarray(case.photo.pixels[::-1, ::-1]), camera)


@pytest.mark.slow
def test_a_large_roll_is_detected_and_reported(case: SimulatedCase) -> None:
    result = lr.register(case.scan, turned_photo(case), method="thesis")
    assert not result.accepted
    said = [re.search(r"rolled by (?:about )?(\d+) deg", reason) for reason in result.reasons]
    assert any(found and abs(int(found[1]) - 180) <= 5 for found in said), result.reasons


@pytest.mark.slow
def test_a_vanishing_baseline_is_detected_and_reported() -> None:
    case = simulated("boxes", set_name="identical", seed=41)
    literal = RegisterOptions(thesis=ThesisOptions(residual="stereo"))
    result = lr.register(case.scan, case.photo, method="thesis", options=literal)
    assert any("nearly at the same position" in reason for reason in result.reasons), result.reasons
    if result.accepted:
        assert shift_px(case, case.camera_from_scanner, result.camera_from_scanner) < 2


@pytest.mark.parametrize("picture", ["flat", "noise"])
def test_a_photo_without_matches_is_refused(room: PaintedRoom, picture: str) -> None:
    shape = room.photo.pixels.shape
    pixels = {
        "flat": np.full(shape, 128, np.uint8),
        "noise": np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8),
    }[picture]
    result = lr.register(room.scan, lr.Photo(pixels, room.photo.camera), method="thesis")
    assert not result.accepted
    assert result.evidence == "none"
    assert result.reasons


@pytest.mark.slow
def test_an_initial_pose_guides_the_matching(case: SimulatedCase) -> None:
    truth = case.camera_from_scanner
    rough = lr.Rigid.from_centre(rotation_about("y", np.deg2rad(1.0)) @ truth.rotation, truth.centre + 0.03)
    result = lr.register(case.scan, case.photo, method="thesis", initial=rough)
    assert "robust first pose" not in [step.name for step in result.steps]
    assert result.accepted, result.reasons
    assert shift_px(case, truth, result.camera_from_scanner) < 1.0


@pytest.mark.slow
def test_equal_inputs_give_equal_results(room: PaintedRoom) -> None:
    one, other = (lr.register(room.scan, room.photo, method="thesis", options=RegisterOptions(seed=3)) for _ in "ab")
    assert one.camera_from_scanner.matrix.tobytes() == other.camera_from_scanner.matrix.tobytes()
    assert one.matches.pick_ids == other.matches.pick_ids


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (lambda: ThesisOptions(first_pose="best"), "linear"),
        (lambda: ThesisOptions(residual="disparity"), "epipolar"),
    ],
)
def test_invalid_options_are_refused(options, words: str) -> None:
    with pytest.raises(lr.LadarregError, match=words):
        options()


def test_collinear_lines_are_never_accepted(room: PaintedRoom) -> None:
    """Segments of one straight line: the camera can rotate about it without a change of the residuals."""
    points = room.scan.points.astype(float)[150, 40:400:40]
    uv = room.photo.camera.project(room.camera_from_scanner @ points)
    uv = uv[0] + np.linspace(0, 1, len(uv))[:, None] * (uv[-1] - uv[0])
    rays = points / np.linalg.norm(points, axis=1)[:, None]
    picks = [lr.Pick(str(k), "line", rays[k : k + 2], uv[k : k + 2]) for k in range(len(points) - 1)]
    for method in ("manual", "thesis"):
        try:
            result = lr.register(room.scan, room.photo, method=method, picks=picks)
        except lr.LadarregError:
            continue
        assert not result.accepted


@pytest.mark.parametrize("method", ["manual", "thesis"])
def test_the_error_states_why_drawn_matches_are_missing(room: PaintedRoom, method: str) -> None:
    away = [lr.Pick(p.id, "line", p.scan, p.photo + 5000) for p in drawn_lines(room, 5)]
    with pytest.raises(lr.LadarregError, match="outside the photo"):
        lr.register(room.scan, room.photo, method=method, picks=away)
    same = [lr.Pick(p.id, "line", p.scan[[0, 0]], p.photo[[0, 0]]) for p in drawn_lines(room, 5)]
    with pytest.raises(lr.LadarregError, match="length zero"):
        lr.register(room.scan, room.photo, method=method, picks=same)


@pytest.mark.parametrize("count", [0, 1, 1001, "9"])
def test_an_invalid_number_of_samples_is_refused(count: object) -> None:
    with pytest.raises(lr.LadarregError, match="whole number from 2 to 1000"):
        RegisterOptions(samples_per_line=count)  # type: ignore[arg-type]
