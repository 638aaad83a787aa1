"""The facade on the painted room: what comes out, whatever goes in."""

from __future__ import annotations

import json
import os
import pickle
import re
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from ladarreg.messages import assessment_lines, report
from ladarreg.messages import matches as matches_line

import ladarreg_core as lr
from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.export.targets.folder import export_registration
from ladarreg_core.formats import describe
from ladarreg_core.formats.documents.registration_file import read_registration
from ladarreg_core.frames import rotation_from_rotvec
from ladarreg_core.inspection.figures import parameters
from ladarreg_core.picks.measure import matches_from_picks
from ladarreg_core.quality.assessment import assess
from ladarreg_core.registration.register import RegisterOptions, register
from ladarreg_core.results.registration import COARSE_SIGMA_PX
from ladarreg_core.results.verdict_words import COARSE_CAVEAT
from ladarreg_core.surface.ranges import surface_range
from testing.scenes.painted_room import PaintedRoom, painted_room, registered_room


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=3)


@pytest.fixture(scope="module")
def registration() -> lr.Registration:
    return registered_room(seed=3)


def point_picks(room: PaintedRoom, count: int = 40, *, noise_px: float = 0.5, seed: int = 0) -> list[lr.Pick]:
    rng = np.random.default_rng(seed)
    rays = room.scan.rays[rng.integers(30, 270, 400), rng.integers(30, 390, 400)]
    ranges = surface_range(room.scan, rays)
    uv = room.photo.camera.project(room.camera_from_scanner @ (rays * ranges[:, None]))
    good = np.flatnonzero(room.photo.camera.contains(uv, border=5))[:count]
    return [
        lr.Pick(f"p{k}", "point", rays[k][None], uv[k][None] + rng.normal(0, noise_px, (1, 2))) for k in good.tolist()
    ]


def test_auto_finds_the_truth_and_says_how_well(room: PaintedRoom, registration: lr.Registration) -> None:
    assert registration.accepted
    assert registration.evidence == "image"
    assert room.error_px(registration.camera_from_scanner) < 0.4
    assert room.mahalanobis(registration.camera_from_scanner, registration.covariance) < 3
    assert registration.method == "auto"


def test_the_result_is_complete(registration: lr.Registration) -> None:
    count = len(registration.matches)
    assert count > 40
    assert registration.inliers.shape == (count,)
    assert registration.residuals_px.shape == (count, 2)
    assert np.isfinite(registration.residuals_m).all()
    assert registration.covariance.shape == (6, 6)
    assert 0 < registration.chi2_per_dof < 10
    # The table's residuals are the photo's own pixels minus the prediction from the measured range.
    predicted = registration.camera.project(registration.camera_from_scanner @ registration.matches.points)
    np.testing.assert_allclose(registration.residuals_px, registration.matches.uv - predicted)
    names = [step.name for step in registration.steps]
    assert names[:2] == ["photo", "channels"]
    assert names[-6:] == ["finish", "verify", "camera", "evidence", "second minimum", "result"]
    assert registration.options["auto"]["gate"]["fraction"] == 0.5


def test_one_processor_core_gives_the_same_answer(
    room: PaintedRoom, registration: lr.Registration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    alone = register(replace(room.scan), room.photo)  # a copy, of which nothing was kept
    np.testing.assert_array_equal(alone.camera_from_scanner.matrix, registration.camera_from_scanner.matrix)
    np.testing.assert_array_equal(alone.covariance, registration.covariance)
    np.testing.assert_array_equal(alone.matches.uv, registration.matches.uv)
    assert [(step.name, step.detail) for step in alone.steps] == [(s.name, s.detail) for s in registration.steps]


def test_one_thread_gives_the_same_answer(
    room: PaintedRoom, registration: lr.Registration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threading.Thread, "start", lambda _: pytest.fail("a thread was begun"))
    alone = register(replace(room.scan), room.photo, threads=1)  # a copy, of which nothing was kept
    np.testing.assert_array_equal(alone.camera_from_scanner.matrix, registration.camera_from_scanner.matrix)
    np.testing.assert_array_equal(alone.covariance, registration.covariance)
    np.testing.assert_array_equal(alone.matches.uv, registration.matches.uv)
    assert alone.options == registration.options
    assert [(step.name, step.detail) for step in alone.steps] == [(s.name, s.detail) for s in registration.steps]


def test_one_thread_ends_with_the_registration(room: PaintedRoom) -> None:
    threads: list[int] = []

    def stop(_: lr.Step) -> None:
        threads.append(cv2.getNumThreads())
        raise lr.Cancelled

    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        for asked in (1, None):
            with pytest.raises(lr.Cancelled):
                register(room.scan, room.photo, report=stop, threads=asked)
            assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)
    assert threads == [1, 2]
    wrong: list[Any] = [0, 2, True, "1"]
    for number in wrong:
        with pytest.raises(OptionError, match="threads"):
            register(room.scan, room.photo, threads=number)


@pytest.mark.parametrize("after", ["channels", "climb", "verify", "evidence"])
def test_a_cancelled_registration_leaves_no_thread_behind(room: PaintedRoom, after: str) -> None:
    def report(step: lr.Step) -> None:
        if step.name == after:
            raise lr.Cancelled

    before = threading.active_count()
    with pytest.raises(lr.Cancelled):
        register(replace(room.scan), room.photo, report=report)
    assert threading.active_count() == before


def test_every_step_is_reported_as_it_ends(room: PaintedRoom) -> None:
    seen: list[lr.Step] = []

    def report(step: lr.Step) -> None:
        seen.append(step)
        if step.name == "hypothesis":
            raise lr.Cancelled

    with pytest.raises(lr.Cancelled):
        register(room.scan, room.photo, report=report)
    assert [step.name for step in seen] == ["photo", "channels", "hypothesis"]
    assert seen[-1].matches is not None
    assert seen[-1].pose is not None


_FINGERPRINT = """
import pickle, sys, cv2
cv2.setNumThreads(int(sys.argv[1]))
from ladarreg_core.registration.register import register
scan, photo = pickle.load(open(sys.argv[2], "rb"))
print(register(scan, photo).camera_from_scanner.matrix.tobytes().hex())
"""


@pytest.mark.slow
def test_the_answer_does_not_depend_on_threads(
    room: PaintedRoom, registration: lr.Registration, tmp_path: Path
) -> None:
    inputs = tmp_path / "inputs.pickle"
    inputs.write_bytes(pickle.dumps((replace(room.scan), room.photo)))
    here = registration.camera_from_scanner.matrix.tobytes().hex()
    for threads in ("1", "2"):
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads, "PYTHONHASHSEED": "7"}
        environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
        words = [sys.executable, "-c", _FINGERPRINT, threads, str(inputs)]
        run = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
        assert run.stdout.strip() == here


@pytest.mark.slow
def test_a_distorted_photo_is_matched_as_well() -> None:
    room = painted_room(seed=5, distortion=(-0.25, 0.08, 0.001, -0.0005))
    result = register(room.scan, room.photo)
    assert result.accepted, result.reasons
    assert room.error_px(result.camera_from_scanner) < 0.5


@pytest.mark.slow
def test_the_same_place_is_no_failure() -> None:
    room = painted_room(seed=6, baseline_m=0.0)
    result = register(room.scan, room.photo)
    assert result.accepted, result.reasons
    assert room.error_px(result.camera_from_scanner) < 0.4


@pytest.mark.parametrize("picture", ["flat", "black", "noise", "other room"])
def test_what_does_not_match_is_not_accepted(room: PaintedRoom, picture: str) -> None:
    shape = room.photo.pixels.shape
    pixels = {
        "flat": np.full(shape, 128, np.uint8),
        "black": np.zeros(shape, np.uint8),
        "noise": np.random.default_rng(1).integers(0, 256, shape).astype(np.uint8),
        "other room": painted_room(seed=2).photo.pixels,
    }[picture]
    result = register(room.scan, lr.Photo(pixels, room.photo.camera))
    assert not result.accepted
    assert result.evidence == "none"
    assert result.reasons
    assert all(reason.endswith(".") for reason in result.reasons)
    if picture == "flat":  # there is not even a guess, so no number of it is shown
        assert not result.is_determined
        assert parameters(result) == ()
        assessment = assess(room.scan, result)
        assert assessment.findings is assessment.uncertainty is assessment.advice is None
        shown = "\n".join([report(result), *assessment_lines(assessment, result), matches_line(result)])
        assert not re.search(r"\d", shown), shown


def test_a_first_guess_is_tried_first(room: PaintedRoom) -> None:
    truth = room.camera_from_scanner
    near = lr.Rigid(rotation_from_rotvec([0.01, -0.01, 0.01]) @ truth.rotation, truth.translation)
    result = register(room.scan, room.photo, initial=near)
    assert result.accepted
    starts = [step.detail["start"] for step in result.steps if step.name == "climb"]
    assert starts[0] == "the given pose"
    # A useless guess costs nothing but time.
    lost = lr.Rigid(np.diag([-1.0, -1.0, 1.0]) @ truth.rotation, np.array([0.0, 0.0, 50.0]))
    result = register(room.scan, room.photo, initial=lost)
    assert result.accepted
    assert room.error_px(result.camera_from_scanner) < 0.4


def test_points_put_down_by_hand_are_solved_and_refined_against_the_image(room: PaintedRoom) -> None:
    picks = point_picks(room)
    result = register(room.scan, room.photo, picks=picks)
    assert result.method == "manual"
    assert result.accepted, result.reasons
    assert result.evidence == "image"
    drawn = register(room.scan, room.photo, picks=picks, options=RegisterOptions(proposal="drawn"))
    assert drawn.evidence == "image"
    assert drawn.diagnostics["statistics"]["evidence"] == "statistics"
    assert result.diagnostics["drawn"]["camera_from_scanner"] == drawn.camera_from_scanner.matrix.tolist()
    assert 0 < drawn.camera_from_scanner.distance_to(result.camera_from_scanner) < 3 * drawn.sigma_position_m
    assert room.error_px(result.camera_from_scanner) < 0.6
    assert result.matches.pick_ids[0].startswith("p")


def test_mismatched_points_are_rejected_one_by_one(room: PaintedRoom) -> None:
    picks = point_picks(room)
    wrong = {
        k: lr.Pick(picks[k].id, "point", picks[k].scan, picks[k].photo + np.array([[60.0, -40.0]])) for k in (3, 11, 20)
    }
    result = register(room.scan, room.photo, picks=[wrong.get(k, pick) for k, pick in enumerate(picks)])
    assert result.accepted, result.reasons
    outliers = {result.matches.pick_ids[k] for k in np.flatnonzero(~result.inliers)}
    assert {wrong[k].id for k in wrong} <= outliers


def test_random_points_are_not_accepted(room: PaintedRoom) -> None:
    rng = np.random.default_rng(0)
    picks = [
        lr.Pick(pick.id, "point", pick.scan, rng.uniform(0, 1, (1, 2)) * room.photo.camera.size)
        for pick in point_picks(room)
    ]
    try:
        result = register(room.scan, room.photo, picks=picks)
    except DegenerateGeometryError:
        return
    assert not result.accepted
    assert result.evidence == "none"


def test_lines_are_sampled_on_both_sides(room: PaintedRoom) -> None:
    wall = [np.array([4.5, y, z]) for y, z in ((-1.5, -0.5), (1.5, 1.2))]
    rays = np.array([p / np.linalg.norm(p) for p in wall])
    uv = room.photo.camera.project(room.camera_from_scanner @ np.array(wall))
    matches, notes = matches_from_picks(room.scan, [lr.Pick("l", "line", rays, uv)], lines="equal")
    assert set(matches.pick_ids) == {"l"}
    assert matches.fractions.min() == 0
    assert matches.fractions.max() == 1
    across = np.cross(matches.points - wall[0], wall[1] - wall[0])
    hidden = np.linalg.norm(across, axis=1) > 0.05  # a box stands before the wall
    assert hidden.sum() + len(notes) < len(matches)
    along, off = uv[1] - uv[0], matches.uv - uv[0]
    on_line = off[:, 0] * along[1] - off[:, 1] * along[0]
    np.testing.assert_allclose(on_line, 0, atol=1e-6)


def test_switched_off_and_rangeless_picks_are_left_out_and_said(room: PaintedRoom) -> None:
    picks = point_picks(room, 6)
    off = lr.Pick("off", "point", picks[0].scan, picks[0].photo, on=False)
    sky = lr.Pick("sky", "point", np.array([[0.6, 0.0, 0.8]]), np.array([[10.0, 10.0]]))
    matches, notes = matches_from_picks(room.scan, [*picks, off, sky])
    assert "off" not in matches.pick_ids
    assert "sky" not in matches.pick_ids
    assert any("sky" in note for note in notes)


def test_surface_ranges_are_exact_on_a_plane(room: PaintedRoom) -> None:
    target = np.array([4.5, 0.31, 1.234])
    ray = target / np.linalg.norm(target)
    measured = surface_range(room.scan, ray[None])[0]
    assert abs(measured - np.linalg.norm(target)) < 0.012  # four noisy cells of 3 mm
    assert np.isnan(surface_range(room.scan, np.array([[-1.0, 0, 0]])))[0]


def test_nonsense_is_refused(room: PaintedRoom) -> None:
    with pytest.raises(OptionError, match="auto, thesis, manual"):
        register(room.scan, room.photo, method="magic")
    with pytest.raises(OptionError, match="no picks"):
        register(room.scan, room.photo, method="manual")
    with pytest.raises(OptionError, match="seed"):
        RegisterOptions(seed=-1)
    with pytest.raises(DegenerateGeometryError):
        register(room.scan, room.photo, picks=point_picks(room, 2))


@pytest.mark.slow
def test_a_pose_known_to_a_few_pixels_is_called_coarse_in_every_file(
    registration: lr.Registration, room: PaintedRoom, tmp_path: Path
) -> None:
    limit_px = COARSE_SIGMA_PX * np.sqrt(np.prod(registration.camera.size) / 1e6)
    known_px = replace(registration, camera_uncertainty=None).median_pixel_sigma(registration.inliers)
    for share, coarse in ((0.95, False), (1.05, True)):
        covariance = registration.covariance * (share * limit_px / known_px) ** 2
        found = replace(registration, covariance=covariance, camera_uncertainty=None)
        assert found.is_coarse == coarse
        assert found.standing == ("accepted, coarse (image)" if coarse else "accepted (image)")
        assert report(found).startswith("Accepted, coarse:" if coarse else "Accepted: verified")
        assert (COARSE_CAVEAT in repr(found)) == coarse
        out = tmp_path / str(coarse)
        export_registration(out, found, room.scan, room.photo)
        assert json.loads((out / "registration.json").read_text())["coarse"] == coarse
        assert read_registration(out / "registration.json").is_coarse == coarse
        for name in ("model.glb", "cloud.ply", "labels.png"):
            assert (COARSE_CAVEAT.encode() in (out / name).read_bytes()) == coarse, name
        assert ("Accepted, coarse: verified" in (out / "report.html").read_text(encoding="utf-8")) == coarse
        assert ("Accepted, coarse" in str(describe(out / "registration.json").verdict)) == coarse
    refused = replace(found, accepted=False, evidence="none")
    assert not refused.is_coarse
    assert refused.standing == "not accepted"
