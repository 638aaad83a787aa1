"""`ladarreg register --rig`: a simulated rig in three places, its verdict, its files, and rigs that are no rig."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode
from ladarreg.workbench.given_files import Reading
from ladarreg.workbench.launch import open_workbench

import ladarreg_core as lr
from ladarreg_core.errors import OptionError
from ladarreg_core.export.photo_files import write_png_picture
from ladarreg_core.formats.cameras.camera_file import read_camera
from ladarreg_core.formats.documents.pose_file import read_pose, write_pose
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.simulate.outdoor_case import OutdoorCase, simulate_rig
from ladarreg_core.storage.manifest import visible_files
from testing.files.recordings import CLOUD, IMAGE, INFO, camera_info, image, point_cloud, write_recording
from testing.files.small_scans import pcd_bytes

PAIRS = 3
RIGHT_PX = 2.0


@dataclass(frozen=True)
class Rig:
    folder: Path
    cases: list[OutdoorCase]
    truth: Rigid


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """Clouds, photographs, camera, table and a rough pose in a folder."""
    pytest.importorskip("embreex")
    folder = tmp_path_factory.mktemp("rig")
    cases = simulate_rig("64 lines", pairs=PAIRS, seed=1)
    truth = cases[0].camera_from_scanner
    rows = ["scan,photo,name"]
    for number, case in enumerate(cases):
        (folder / f"{number}.pcd").write_bytes(pcd_bytes(case.cloud.points, case.cloud.intensity))
        write_png_picture(folder / f"{number}.png", case.photo.pixels)
        rows.append(f"{number}.pcd,{number}.png,place {number}")
    (folder / "pairs.csv").write_text("\n".join(rows))
    (folder / "camera.json").write_text(json.dumps(cases[0].true_camera.as_fields()))
    turn = rotation_from_rotvec(np.radians([1.0, -2.0, 1.0]))
    write_pose(
        folder / "rough.json", Rigid.from_centre(turn @ truth.rotation, truth.centre + np.array([0.1, -0.1, 0.1]))
    )
    return Rig(folder, cases, truth)


@pytest.fixture(scope="module")
def registered(rig: Rig) -> Path:
    """The folder of its registration."""
    assert main(["register", *arguments(rig, "out"), "--quiet"]) == ExitCode.ACCEPTED
    return rig.folder / "out"


def arguments(rig: Rig, out: str, table: str = "pairs.csv") -> list[str]:
    files = {"--rig": table, "--camera": "camera.json", "--initial": "rough.json", "-o": out}
    return [word for flag, name in files.items() for word in (flag, str(rig.folder / name))]


def off_px(rig: Rig, pose: Rigid) -> float:
    case = rig.cases[0]
    points = case.scan.points[case.scan.valid][::50].astype(float)
    true = case.true_camera.project(rig.truth @ points)
    seen = case.true_camera.contains(true)
    return float(np.median(np.linalg.norm(true[seen] - case.true_camera.project(pose @ points[seen]), axis=1)))


@pytest.mark.slow
def test_the_pose_is_right_and_every_pair_vouches_for_it(rig: Rig, registered: Path) -> None:
    fields = json.loads((registered / "rig.json").read_text())
    pose = read_pose(registered / "rig.json")
    assert off_px(rig, pose) < RIGHT_PX < off_px(rig, read_pose(rig.folder / "rough.json"))
    apart = np.append(np.degrees(pose.angle_to(rig.truth)), 1e3 * pose.distance_to(rig.truth))
    assert (apart < 5 * np.array([max(fields["sigma_deg"]), max(fields["sigma_mm"])])).all()
    assert fields["used"] == ["place 0", "place 1", "place 2"]
    assert fields["false_alarm"] < 1e-6
    assert all(pair["fraction"] > 2 * pair["swapped_fraction"] for pair in fields["pairs"])
    assert len(fields["inputs"]) == 3 + 2 * PAIRS
    assert sorted(fields["files"]) == visible_files(registered)


@pytest.mark.slow
def test_ros_and_kalibr_say_the_same_pose(registered: Path) -> None:
    pose = read_pose(registered / "rig.json")
    transform = yaml.safe_load((registered / "camera.transform.yaml").read_text())
    assert (transform["header"]["frame_id"], transform["child_frame_id"]) == ("scanner", "camera_optical_frame")
    x, y, z, w = (transform["transform"]["rotation"][key] for key in "xyzw")
    rotation = np.eye(3) + 2 * w * cross(x, y, z) + 2 * cross(x, y, z) @ cross(x, y, z)
    np.testing.assert_allclose(rotation, pose.rotation.T, atol=1e-12)
    np.testing.assert_allclose([transform["transform"]["translation"][key] for key in "xyz"], pose.centre, atol=1e-12)
    compile((registered / "static_transforms.launch.py").read_text(), "launch", "exec")
    chain = yaml.safe_load((registered / "camchain-lidar.yaml").read_text())
    np.testing.assert_allclose(chain["cam0"]["T_cam_lidar"], pose.matrix, atol=1e-12)
    camera = read_camera(registered / "camchain-lidar.yaml")
    assert camera.as_fields()["fx"] == 649.0


def cross(x: float, y: float, z: float) -> np.ndarray:
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def test_the_folder_is_described_and_replaced_by_force_only(
    rig: Rig, registered: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", str(registered / "rig.json")]) == ExitCode.ACCEPTED
    assert "held out" in capsys.readouterr().out
    assert main(["register", *arguments(rig, "out")]) == ExitCode.BAD_INPUT
    assert "--force" in capsys.readouterr().err


@pytest.mark.long
def test_a_recording_gives_the_same_rig(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rosbags")
    clouds, images, info = [], [], [(0, camera_info(rig.cases[0].true_camera))]
    for number, case in enumerate(rig.cases):
        stamp = (100 + number) * 10**9
        clouds.append((stamp, point_cloud(case.cloud.points, case.cloud.intensity, stamp_ns=stamp)))
        images.append((stamp, image(case.photo.pixels, stamp_ns=stamp + 10**7)))
    topics = {"/points": (CLOUD, clouds), "/front/image_raw": (IMAGE, images), "/front/camera_info": (INFO, info)}
    file = write_recording(rig.folder / "recorded", "mcap", topics)
    out, initial = rig.folder / "recorded_out", str(rig.folder / "rough.json")
    words = ["register", "--rig", str(file), "--cloud", "/points", "--image", "/front/image_raw", "--initial", initial]
    assert main([*words, "-o", str(out)]) == ExitCode.ACCEPTED
    said = capsys.readouterr().out
    assert "3 clouds of /points and pictures of /front/image_raw are pairs" in said
    assert "the camera is that of /front/camera_info" in said
    assert off_px(rig, read_pose(out / "rig.json")) < RIGHT_PX
    fields = json.loads((out / "rig.json").read_text())
    assert fields["used"] == ["front 0.00 s", "front 1.00 s", "front 2.00 s"]
    assert main([*words[:3], "--image", "/none", "-o", str(rig.folder / "y")]) == ExitCode.BAD_INPUT
    assert "there is /front/image_raw" in capsys.readouterr().err


@pytest.mark.long
def test_swapped_photos_are_refused_and_named(rig: Rig) -> None:
    photos = [case.photo for case in rig.cases]
    photos[0], photos[1] = photos[1], photos[0]
    pairs = [
        lr.RigPair(f"place {number}", case.scan, photo)
        for number, (case, photo) in enumerate(zip(rig.cases, photos, strict=True))
    ]
    few = lr.RigOptions(candidates_per_pair=1, refined=2)
    result = lr.register_rig(pairs, initial=rig.truth, options=few)
    assert not result.accepted
    assert {"place 0", "place 1"} <= {*result.refused}
    assert "the photo of place 1 agrees with its scan" in result.pairs[0].sentence


@pytest.mark.long
def test_pairs_of_one_place_count_as_one(rig: Rig) -> None:
    """A false agreement in one place would be found in every picture of it."""
    pairs = [lr.RigPair(name, rig.cases[1].scan, rig.cases[1].photo) for name in ("first", "second")]
    result = lr.register_rig(pairs, initial=rig.truth, options=lr.RigOptions(candidates_per_pair=1, refined=1))
    assert not result.accepted
    assert [pair.outcome for pair in result.pairs] == ["undecided", "undecided"]
    assert "the same place" in result.pairs[0].sentence


@pytest.mark.slow
def test_the_workbench_says_how_a_pair_of_a_rig_is_opened(registered: Path, rig: Rig, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="is the result of a rig, on the pairs place 0, place 1") as refused:
        open_workbench([registered])
    assert f"--initial {registered / 'rig.json'}" in str(refused.value)
    given = Reading(camera=rig.folder / "camera.json", initial=registered / "rig.json")
    workbench = open_workbench([rig.folder / "0.pcd", rig.folder / "0.png"], project=tmp_path / "p", reading=given)
    stated = workbench.session.document.photos[0].stated_pose
    workbench.close()
    pose = json.loads((registered / "rig.json").read_text())["camera_from_scanner"]
    assert stated is not None
    assert np.allclose(stated, pose, atol=1e-9)


def test_a_rig_of_one_pair_and_wrong_arguments_are_refused(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    (rig.folder / "one.csv").write_text("scan,photo\n0.pcd,0.png\n")
    assert main(["register", *arguments(rig, "one", "one.csv")]) == ExitCode.BAD_INPUT
    assert "it needs at least 2" in capsys.readouterr().err
    assert not (rig.folder / "one").exists()
    assert main(["register", "0.pcd", *arguments(rig, "one")]) == ExitCode.BAD_INPUT
    assert main(["register", "--rig", str(rig.folder / "none.csv"), "-o", str(rig.folder / "x")]) == ExitCode.BAD_INPUT
    pair = lr.RigPair("a", rig.cases[0].scan, rig.cases[0].photo)
    for wrong in ([pair], [pair, "b"], None):
        with pytest.raises(OptionError):
            lr.register_rig(wrong)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="initial"):
        lr.register_rig([pair, pair], initial=np.eye(4))  # type: ignore[arg-type]
