"""Rigs of several cameras: two pinholes and a fisheye, each with a pose and a verdict of its own."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

import ladarreg_core as lr
from ladarreg_core.errors import FormatError, OptionError
from ladarreg_core.export.outputs.rig_folder import write_rig
from ladarreg_core.formats import describe
from ladarreg_core.formats.documents.pose_file import read_initial_of_rig
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.registration.rig.results import RigResult
from ladarreg_core.storage.manifest import visible_files
from testing.scenes.camera_rig import MountedCamera, camera_rig, panorama_camera, three_cameras
from testing.scenes.small_registration import POSE, sample_photo, sample_scan

pytestmark = pytest.mark.timeout(1200)
PLACES = 5
CAMERAS = three_cameras()
_QUICK = lr.RigOptions(candidates_per_pair=1, refined=1)


def rough(truth: Rigid) -> Rigid:
    """Return a pose some 3 degrees and .17 m off."""
    turn = rotation_from_rotvec(np.radians([2.0, -2.0, 1.0]))
    return Rigid.from_centre(turn @ truth.rotation, truth.centre + np.array([0.1, -0.1, 0.1]))


def assert_right(result: RigResult, camera: MountedCamera) -> None:
    truth, pose = camera.camera_from_scanner, result.camera_from_scanner
    assert result.accepted, result.reasons
    assert pose is not None
    sigma = result.sigmas
    assert np.degrees(pose.angle_to(truth)) < min(0.15, 4 * sigma.angle_deg)
    assert 1e3 * pose.distance_to(truth) < min(60, 4 * sigma.position_mm)


@pytest.fixture(scope="module")
def pairs() -> list[lr.RigPair]:
    pytest.importorskip("embreex")
    return camera_rig(CAMERAS, places=PLACES, seed=3)


@pytest.fixture(scope="module")
def registered(pairs: list[lr.RigPair]) -> RigResult:
    initial = {name: rough(camera.camera_from_scanner) for name, camera in CAMERAS.items()}
    return lr.register_rig(pairs, initial=initial, options=_QUICK)


@pytest.fixture(scope="module")
def folder(registered: RigResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("rig") / "out"
    write_rig(found, registered)
    return found


@pytest.mark.long
def test_every_camera_has_its_own_pose_and_verdict(registered: RigResult) -> None:
    assert registered.accepted
    assert registered.camera_from_scanner is None
    assert list(registered.by_camera) == ["ahead", "right", "wide"]
    for name, camera in CAMERAS.items():
        assert_right(registered.by_camera[name], camera)
        assert len(registered.by_camera[name].pairs) == PLACES
    assert len(registered.pairs) == 3 * PLACES


@pytest.mark.long
def test_the_files_have_all_cameras(registered: RigResult, folder: Path) -> None:
    fields = json.loads((folder / "rig.json").read_text())
    assert sorted(fields["files"]) == visible_files(folder)
    assert fields["camera_from_scanner"] is None
    chain = yaml.safe_load((folder / "camchain-lidar.yaml").read_text())
    poses = [one.camera_from_scanner for one in registered.by_camera.values()]
    for index, (name, pose) in enumerate(zip(CAMERAS, poses, strict=True)):
        assert pose is not None
        np.testing.assert_allclose(lr.read_pose(folder / f"{name}.pose.json").matrix, pose.matrix, atol=1e-12)
        np.testing.assert_allclose(chain[f"cam{index}"]["T_cam_lidar"], pose.matrix, atol=1e-12)
        transform = yaml.safe_load((folder / f"{name}.transform.yaml").read_text())
        assert transform["child_frame_id"] == f"{name}_optical_frame"
        assert f"{name}_optical_frame" in (folder / "static_transforms.launch.py").read_text()
    step = np.array(chain["cam1"]["T_cn_cnm1"]) @ np.array(chain["cam0"]["T_cam_lidar"])
    np.testing.assert_allclose(step, chain["cam1"]["T_cam_lidar"], atol=1e-9)
    assert chain["cam2"]["distortion_model"] == "equidistant"
    initial = read_initial_of_rig(folder / "rig.json")
    assert isinstance(initial, dict)
    assert list(initial) == list(CAMERAS)
    with pytest.raises(FormatError, match=r"several cameras \(ahead, right, wide\); give the file of one of them"):
        lr.read_pose(folder / "rig.json")
    assert "wide: accepted" in describe(folder / "rig.json").contents
    write_rig(folder, registered, force=True)
    assert sorted(fields["files"]) == visible_files(folder)


@pytest.mark.long
def test_a_camera_that_is_refused_leaves_the_others_accepted(pairs: list[lr.RigPair], tmp_path: Path) -> None:
    ahead = [pair for pair in pairs if pair.camera_name == "ahead"]
    right = [pair for pair in pairs if pair.camera_name == "right"]
    mixed = [
        lr.RigPair(pair.name, pair.scan, other.photo, "right")
        for pair, other in zip(right, [*right[1:], right[0]], strict=True)
    ]
    initial = {name: CAMERAS[name].camera_from_scanner for name in ("ahead", "right")}
    result = lr.register_rig([*ahead, *mixed], initial=initial, options=_QUICK)
    assert (result.accepted, result.by_camera["ahead"].accepted, result.by_camera["right"].accepted) == (
        False, True, False,
    )  # fmt: skip
    write_rig(tmp_path / "out", result)
    assert "ahead.pose.json" in visible_files(tmp_path / "out")
    assert not any(name.startswith("right") for name in visible_files(tmp_path / "out"))
    assert list(read_initial_of_rig(tmp_path / "out" / "rig.json")) == ["ahead"]  # type: ignore[arg-type]


@pytest.mark.long
def test_a_panorama_in_a_rig() -> None:
    pytest.importorskip("embreex")
    camera = panorama_camera()
    pairs = camera_rig({"panorama": camera}, places=3, seed=4)
    assert_right(lr.register_rig(pairs, initial=rough(camera.camera_from_scanner), options=_QUICK), camera)


def test_names_and_initial_poses_have_to_fit() -> None:
    scan, photo, truth = sample_scan(), sample_photo(), POSE
    two = [lr.RigPair(f"place {place}", scan, photo, name) for place in (1, 2) for name in ("ahead", "right")]
    with pytest.raises(OptionError, match="one initial pose is given, but the rig has the cameras ahead, right"):
        lr.register_rig(two, initial=truth)
    with pytest.raises(OptionError, match="an initial pose of rear, but the rig has the cameras ahead, right"):
        lr.register_rig(two, initial={"rear": truth})
    with pytest.raises(OptionError, match="the camera right has 1 pairs"):
        lr.register_rig([*[pair for pair in two if pair.camera_name == "ahead"], two[1]])
    odd = [lr.RigPair(pair.name, pair.scan, pair.photo, f"../{pair.camera_name}") for pair in two]
    with pytest.raises(OptionError, match=r"a camera is called .\.\./ahead."):
        lr.register_rig(odd)
