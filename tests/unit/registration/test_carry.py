"""A pose carried over to a second camera of the mount: where it ends, and how far from there it may be."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import ladarreg_core as lr
from ladarreg_core.errors import FormatError, LadarregError, OptionError
from ladarreg_core.export.json import registration_document
from ladarreg_core.formats.documents.registration_file import read_offset, read_registration
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.registration.carry import carry_over
from ladarreg_core.results.offset import Offset
from ladarreg_core.results.registration import Registration
from tests.properties.strategies import poses

CAMERA = lr.Camera.from_focal(60, 40, 70.0)
PHOTO = lr.Photo(np.zeros((40, 60, 3), np.uint8), CAMERA)
COVARIANCE = np.diag([2e-3, 1e-3, 3e-3, 0.01, 0.02, 0.005]) ** 2


def registered(pose: Rigid, *, accepted: bool = True, covariance: np.ndarray = COVARIANCE) -> Registration:
    return Registration(
        camera_from_scanner=pose,
        camera=CAMERA,
        matches=Matches.none(),
        inliers=np.zeros(0, np.bool_),
        residuals_px=np.zeros((0, 2)),
        residuals_m=np.zeros(0),
        stereo_depth_error_m=np.zeros(0),
        covariance=covariance,
        chi2_per_dof=1.0,
        sigma_px=1.0,
        sigma_range_m=0.015,
        accepted=accepted,
        evidence="image" if accepted else "none",
        reasons=("80 of 100 regions of the picture agree with the scan (80%).",),
        method="auto",
        seed=3,
    )


@given(poses(reach_m=3.0), poses(reach_m=3.0))
def test_there_and_back_is_where_it_began(pose: Rigid, between: Rigid) -> None:
    there = carry_over(registered(pose), Offset(between), PHOTO)
    assert np.allclose(there.camera_from_scanner.matrix, (between @ pose).matrix)
    back = carry_over(there, Offset(between.inverse), PHOTO)
    assert np.allclose(back.camera_from_scanner.matrix, pose.matrix, atol=1e-9)


@given(poses(reach_m=3.0), poses(reach_m=3.0))
def test_an_exact_offset_loses_nothing(pose: Rigid, between: Rigid) -> None:
    """With no uncertainty of its own an offset only moves the covariance to the other camera, and back."""
    there = carry_over(registered(pose), Offset(between, 0.0, 0.0), PHOTO)
    back = carry_over(there, Offset(between.inverse, 0.0, 0.0), PHOTO)
    assert np.allclose(back.covariance, COVARIANCE, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_the_covariance_is_what_many_mounts_show(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = Rigid.from_centre(rotation_from_rotvec(rng.normal(0, 1, 3)), rng.normal(0, 1, 3))
    between = Rigid.from_centre(rotation_from_rotvec(rng.normal(0, 1, 3)), rng.normal(0, 0.5, 3))
    offset = Offset(between, 0.004, 0.01)
    predicted = carry_over(registered(pose), offset, PHOTO).covariance
    count, carried = 4000, between @ pose
    a = rng.multivariate_normal(np.zeros(6), COVARIANCE, count)
    o = rng.normal(0, [0.004] * 3 + [0.01] * 3, (count, 6))
    turned_a = Rotation.from_rotvec(a[:, :3]) * Rotation.from_matrix(pose.rotation)
    turned = Rotation.from_rotvec(o[:, :3]) * Rotation.from_matrix(between.rotation) * turned_a
    turns = (turned * Rotation.from_matrix(carried.rotation).inv()).as_rotvec()
    centres = pose.centre + a[:, 3:] + turned_a.inv().apply(between.centre + o[:, 3:])
    found = np.concatenate([turns, centres - carried.centre], axis=1)
    whitened = np.linalg.solve(np.linalg.cholesky(predicted), found.T)
    # Of whitened noise each variance scatters by sqrt(2 / n), each covariance by sqrt(1 / n).
    assert np.abs(np.cov(whitened) - np.eye(6)).max() < 5 * np.sqrt(2 / count)


def test_it_says_what_it_is() -> None:
    result = carry_over(registered(Rigid.identity()), Rigid.identity(), PHOTO)
    assert (result.accepted, result.evidence, result.method, result.seed) == (True, "statistics", "carried", 3)
    assert "same mount" in result.reasons[0]
    assert "0.2 deg and 5 mm" in result.reasons[1]
    assert any("80 of 100 regions" in reason for reason in result.reasons)
    assert result.camera is PHOTO.camera


def test_nothing_is_carried_over_from_what_is_not_accepted() -> None:
    result = carry_over(registered(Rigid.identity(), accepted=False), Rigid.identity(), PHOTO)
    assert (result.accepted, result.evidence) == (False, "none")
    assert "not accepted" in result.reasons[0]


@pytest.mark.parametrize("sigmas", [(-1e-3, 0.0), (0.0, float("nan")), (float("inf"), 0.0)])
def test_an_offset_has_honest_sigmas(sigmas: tuple[float, float]) -> None:
    with pytest.raises(OptionError):
        Offset(Rigid.identity(), *sigmas)


@given(poses(reach_m=3.0), st.booleans())
def test_a_registration_is_read_as_it_was_written(pose: Rigid, accepted: bool) -> None:
    import tempfile

    original = registered(pose, accepted=accepted)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "registration.json"
        path.write_text(json.dumps(registration_document(original)))
        again = read_registration(path)
    assert np.allclose(again.camera_from_scanner.matrix, pose.matrix, atol=1e-12)
    assert np.allclose(again.covariance, original.covariance, rtol=1e-12)
    assert (again.accepted, again.evidence, again.method) == (accepted, original.evidence, "auto")
    assert again.reasons == original.reasons
    assert again.camera == CAMERA


SPOILT: dict[str, Callable[[dict[str, Any]], object]] = {
    "no pose": lambda d: d.pop("camera_from_scanner"),
    "no camera": lambda d: d.pop("camera"),
    "a verdict in words": lambda d: d.update(accepted="yes"),
    "no covariance": lambda d: d.pop("covariance"),
    "a short covariance": lambda d: d["covariance"].pop(),
    "a lopsided covariance": lambda d: d["covariance"][0].__setitem__(1, 1.0),
    "a negative variance": lambda d: d["covariance"][2].__setitem__(2, -1.0),
    "words in it": lambda d: d["covariance"][0].__setitem__(0, "x"),
    "odd evidence": lambda d: d.update(evidence="hearsay"),
    "reasons of numbers": lambda d: d.update(reasons=[1]),
}


@pytest.mark.parametrize("how", sorted(SPOILT))
def test_a_spoilt_registration_is_one_line(how: str, tmp_path: Path) -> None:
    document = registration_document(registered(Rigid.identity()))
    SPOILT[how](document)
    path = tmp_path / "registration.json"
    path.write_text(json.dumps(document))
    with pytest.raises(LadarregError) as caught:
        read_registration(path)
    assert "registration.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_offset_file(tmp_path: Path) -> None:
    between = Rigid.from_centre(rotation_from_rotvec(np.array([0.1, 0.0, 0.2])), (0.1, 0.0, 0.0))
    path = tmp_path / "offset.json"
    path.write_text(json.dumps({"camera_from_scanner": between.matrix.tolist()}))
    assert read_offset(path).sigma_position_m == 0.005
    path.write_text(json.dumps({"camera_b_from_camera_a": between.matrix.tolist(), "sigma_angle_rad": 0.01}))
    read = read_offset(path)
    assert np.allclose(read.camera_b_from_camera_a.matrix, between.matrix)
    assert read.sigma_angle_rad == 0.01
    path.write_text(json.dumps({"camera_b_from_camera_a": between.matrix.tolist(), "sigma_angle_rad": -1}))
    with pytest.raises(OptionError, match=r"offset\.json"):
        read_offset(path)
    path.write_text(json.dumps({"sigma_angle_rad": 1}))
    with pytest.raises(FormatError, match="camera_from_scanner"):
        read_offset(path)


def test_the_first_cameras_doubt_is_not_forgotten() -> None:
    sure, doubtful = (
        carry_over(replace(registered(Rigid.identity()), covariance=k * COVARIANCE), Rigid.identity(), PHOTO)
        for k in (1.0, 100.0)
    )
    assert doubtful.sigma_angle_rad > 3 * sure.sigma_angle_rad
