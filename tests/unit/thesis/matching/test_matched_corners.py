"""Corner matches that a pose can rest on: those of T1 where they agree, guided ones where too few do."""

from __future__ import annotations

import json

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.simulate.sample import sample_folder
from ladarreg_core.thesis.matching.chain import matched_corners, thesis_search
from ladarreg_core.thesis.matching.matcher import ThesisMatchOptions
from testing.scenes.painted_room import painted_room

RIGHT_PX = 4.0


def test_matches_of_t1_are_kept_where_a_pose_agrees_with_them() -> None:
    room = painted_room(seed=4)
    search = thesis_search(room.scan, room.photo)
    found = matched_corners(search, room.photo.pinhole)
    assert found.predicted_uv is None
    assert found.scan_uv.tolist() == search.unconstrained().scan_uv.tolist()


@pytest.mark.slow
def test_guided_matches_where_laser_and_camera_see_other_brightnesses() -> None:
    """In the embedded sample, T1 leaves eight matches, half of them wrong."""
    folder = sample_folder()
    scan, photo = lr.read_scan(folder / "scan.npz"), lr.read_photo(folder / "photo.png", camera=folder / "camera.json")
    truth = lr.Rigid.from_matrix(json.loads((folder / "truth.json").read_text())["camera_from_scanner"])
    search = thesis_search(scan, photo)
    steps: list[str] = []
    found = matched_corners(search, photo.pinhole, report=lambda step: steps.append(step.name))

    error = np.hypot(*(photo.camera.project(truth @ found.matches.points) - found.matches.uv).T)
    assert len(found) >= 20
    assert np.mean(error <= RIGHT_PX) >= 0.7
    assert found.predicted_uv is not None
    assert steps[0] == "unconstrained search"
    assert "constrained search" in steps


def test_without_any_pose_the_matches_of_t1_are_returned() -> None:
    room, other = painted_room(seed=4), painted_room(seed=9)
    search = thesis_search(room.scan, other.photo, ThesisMatchOptions(t1=0.5))
    found = matched_corners(search, other.photo.pinhole)
    assert found.scan_uv.tolist() == search.unconstrained().scan_uv.tolist()
