"""The target `ros`: rosbags and mcap read it, and the conventions of ROS lead from its points to its pixels."""

from __future__ import annotations

import shlex
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from ladarreg_core.camera import Camera, EquirectangularCamera, FisheyeCamera
from ladarreg_core.errors import Cancelled, ExportError
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.export.targets.pipeline import export_to
from ladarreg_core.formats import read_scan
from ladarreg_core.formats.cameras.camera_file import read_camera
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.registered_texture import Label
from testing.scenes.small_registration import POSE, sample_registration, sample_scan

PINHOLE = (120, 90, 100.0, 101.0, 59.0, 45.0)
TURNED = Rigid.from_centre(  # an upright photograph: the pitch of URDF is 90 degrees
    rotation_from_rotvec((0, 0, np.pi / 2)) @ CAMERA_AXES_FROM_SCANNER @ rotation_from_rotvec((0, 0, 0.2)),
    (0.1, 0.3, 0),
)
TILTED = Rigid(rotation_from_rotvec((0.05, -0.1, 0.4)) @ POSE.rotation, POSE.translation + 0.1)
LEVEL = Rigid(POSE.rotation @ rotation_from_rotvec((0, 0, 0.1)), POSE.translation)
CASES = {
    "no lens": (Camera(*PINHOLE), LEVEL),
    "5 terms": (Camera(*PINHOLE, (0.1, -0.02, 0.003, 0.001, 0.004)), TILTED),
    "8 terms": (Camera(*PINHOLE, (0.1, -0.02, 0.003, 0.001, 0.004, 0.02, -0.003, 0.001)), TURNED),
    "12 terms": (Camera(*PINHOLE, (0.1, -0.02, 0, 0, 0, 0.02, 0, 0, 0.01, -0.003, 0.008, 0.002)), TILTED),
    "fisheye": (FisheyeCamera(160, 100, 60.0, 61.0, 80.0, 49.0, (0.02, -0.01, 0.003, -0.0004)), TILTED),
}
WORLD = Rigid(rotation_from_rotvec((0.02, 0.01, 1.2)), np.array([431_234.567, 5_412_345.678, 412.3]))


def registered(camera: Any, pose: Rigid, name: str, *, given: bool = False) -> RegisteredPhoto:
    """Return a photograph whose colours are its pixels' positions: red 2 u, green 2 v."""
    width, height = camera.size
    v, u = np.mgrid[:height, :width]
    factor = 250 / max(width, height)
    pixels = np.rint(np.stack([factor * u, factor * v, 128 + 0 * u], axis=-1)).astype(np.uint8)
    result = replace(sample_registration(), camera=camera, camera_from_scanner=pose)
    if given:
        result = replace(result, accepted=False, evidence="given")
    return RegisteredPhoto(name, Photo(pixels, camera, name=f"Größe {name} \n.jpg"), result)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[RegisteredScan, Path]]:
    """Every case alone, so that its colours are those of its photograph."""
    result = {}
    for name, (camera, pose) in CASES.items():
        given = name == "no lens"
        one = registered(camera, pose, "7-a b.c", given=given)
        scan = sample_scan()
        frame = OutputFrame()
        if name == "fisheye":
            scan = replace(scan, world_from_scanner=WORLD)
        if name == "8 terms":
            scan = replace(scan, world_from_scanner=WORLD)
            frame = OutputFrame.of(scan, "world")
        handed = RegisteredScan(scan, (one,), frame=frame)
        out = tmp_path_factory.mktemp("ros") / "out"
        export_to(out, handed, ["ros"])
        result[name] = (handed, out / "ros")
    return result


def messages(path: Path) -> dict[str, Any]:
    """Return the messages of a recording by their topics, as rosbags reads them."""
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    reader: Any = McapReader(path)
    reader.open()
    try:
        listed = reader.messages(reader.connections)
        return {each.topic: store.deserialize_cdr(raw, each.msgtype) for each, _, raw in listed}
    finally:
        reader.close()


def matrix_of(transform: Any, *, order: str = "xyzw") -> np.ndarray:
    """Return the (4, 4) matrix that maps points of the child into the parent."""
    q, t = transform.rotation, transform.translation
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([getattr(q, key) for key in order]).as_matrix()
    matrix[:3, 3] = t.x, t.y, t.z
    return matrix


def projected(info: Any, points: np.ndarray) -> np.ndarray:
    """Return pixels (N, 2) of points (N, 3) of an optical frame, by the equations of sensor_msgs and OpenCV."""
    d, K = np.asarray(info.d), np.asarray(info.k).reshape(3, 3)
    if info.distortion_model == "equidistant":
        radius = np.hypot(points[:, 0], points[:, 1])
        angle = np.arctan2(radius, points[:, 2])
        bent = angle * (1 + sum(k * angle ** (2 * n) for n, k in enumerate(d, 1)))
        x, y = points[:, 0] / radius * bent, points[:, 1] / radius * bent
    else:
        assert info.distortion_model == {5: "plumb_bob", 8: "rational_polynomial"}[len(d)]
        k1, k2, p1, p2, k3, k4, k5, k6 = (*d, 0, 0, 0)[:8]
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        s = x * x + y * y
        radial = (1 + k1 * s + k2 * s**2 + k3 * s**3) / (1 + k4 * s + k5 * s**2 + k6 * s**3)
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x),
            y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
        )
    return np.stack([K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]], axis=-1)


@pytest.mark.parametrize("case", CASES)
def test_points_of_the_recording_land_on_its_photograph(
    written: dict[str, tuple[RegisteredScan, Path]], case: str
) -> None:
    handed, folder = written[case]
    found = messages(folder / "scan.mcap")
    cloud, info = found["/scan/points"], found["/photo_7_a_b_c/camera_info"]
    (image,) = (each for topic, each in found.items() if "/image_" in topic)
    shown = cv2.imdecode(np.asarray(image.data), cv2.IMREAD_COLOR)[..., ::-1]
    assert shown.shape[:2] == (info.height, info.width)
    assert [(each.name, each.offset, each.datatype, each.count) for each in cloud.fields] == [
        ("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("intensity", 12, 7, 1), ("rgb", 16, 7, 1),
    ]  # fmt: skip
    assert (cloud.height, cloud.point_step, cloud.row_step) == (1, 20, 20 * cloud.width)
    rows = np.frombuffer(cloud.data, np.float32).reshape(-1, 5)
    points = rows[:, :3].astype(np.float64)
    colors = np.asarray(cloud.data).reshape(-1, 20)[:, 18:15:-1]  # red, green, blue
    scan = handed.scan
    assert np.allclose(points, scan.points[scan.valid], atol=1e-6)
    assert np.allclose(rows[:, 3], scan.intensity[scan.valid])
    transform = next(each for each in found["/tf_static"].transforms if each.header.frame_id == "scanner")
    assert transform.child_frame_id == info.header.frame_id == image.header.frame_id
    assert cloud.header.frame_id == "scanner"

    seen = handed.colors.labels[scan.valid] == Label.SEEN
    assert seen.sum() > 200
    homogeneous = np.column_stack([points, np.ones(len(points))])[seen]

    def error(optical_from_scanner: np.ndarray) -> tuple[float, float]:
        """Return the median distance, levels, of the image's colours from the points', and that of pixels from ours."""
        with np.errstate(all="ignore"):
            uv = projected(info, (homogeneous @ optical_from_scanner.T)[:, :3])
            ours = handed.photos[0].camera.project(handed.photos[0].camera_from_scanner @ points[seen])
            at = np.nan_to_num(uv, nan=-1e6, posinf=-1e6, neginf=-1e6).astype(np.float32)
            drawn = cv2.remap(shown.astype(np.float32), *at.T.reshape(2, -1, 1), cv2.INTER_LINEAR)[:, 0]
            level = np.abs(drawn - colors[seen]).max(axis=1)
            return float(np.median(level)), float(np.nanmax(np.hypot(*(uv - ours).T)))

    pose = matrix_of(transform.transform)
    levels, pixels = error(np.linalg.inv(pose))
    assert levels <= 2.0
    if case == "12 terms":
        assert pixels > 0.3  # the picture is another: without its distortion
    else:
        assert pixels < 1e-3  # of points in single precision
    # Controls: the inverse, and the quaternion read in the order w x y z.
    assert error(pose)[0] > 10
    assert error(np.linalg.inv(matrix_of(transform.transform, order="yzwx")))[0] > 10
    assert np.array_equal(np.asarray(info.p).reshape(3, 4)[:, :3], np.asarray(info.k).reshape(3, 3))
    assert np.array_equal(np.asarray(info.r).reshape(3, 3), np.eye(3))


@pytest.mark.parametrize("case", CASES)
def test_the_text_files_agree_with_the_recording(written: dict[str, tuple[RegisteredScan, Path]], case: str) -> None:
    handed, folder = written[case]
    found = messages(folder / "scan.mcap")
    transform = next(each for each in found["/tf_static"].transforms if each.header.frame_id == "scanner")
    pose = matrix_of(transform.transform)
    text = (folder / "photo_7_a_b_c.transform.yaml").read_text(encoding="utf-8")
    stated = yaml.safe_load(text)["transform"]
    rotation = Rotation.from_quat([stated["rotation"][key] for key in "xyzw"]).as_matrix()
    assert np.allclose(rotation, pose[:3, :3], atol=1e-12)
    command = shlex.split(next(line for line in text.splitlines() if "static_transform_publisher" in line)[1:])
    values = dict(zip(command[4::2], command[5::2], strict=True))
    assert [float(values[f"--{key}"]) for key in ("x", "y", "z")] == pose[:3, 3].tolist()
    assert np.allclose(
        Rotation.from_quat([float(values[f"--q{key}"]) for key in "xyzw"]).as_matrix(), pose[:3, :3], atol=1e-12
    )
    assert (values["--frame-id"], values["--child-frame-id"]) == ("scanner", "photo_7_a_b_c_optical_frame")

    robot = ET.parse(folder / "cameras.urdf").getroot()
    (joint,) = robot.findall("joint")
    origin = joint.find("origin")
    assert origin is not None
    rpy = [float(value) for value in origin.attrib["rpy"].split()]
    assert np.allclose(Rotation.from_euler("xyz", rpy).as_matrix(), pose[:3, :3], atol=1e-9)  # fixed axes
    assert not np.allclose(Rotation.from_euler("XYZ", rpy).as_matrix(), pose[:3, :3], atol=1e-2)  # control
    assert [float(value) for value in origin.attrib["xyz"].split()] == pose[:3, 3].tolist()
    assert {link.attrib["name"] for link in robot.findall("link")} == {"scanner", "photo_7_a_b_c_optical_frame"}

    read = read_camera(folder / "photo_7_a_b_c.camera_info.yaml")
    camera = handed.photos[0].camera
    expected = camera.without_distortion() if case == "12 terms" else camera
    points = np.random.default_rng(1).uniform((-1, -1, 2), (1, 1, 4), (50, 3))
    assert np.allclose(read.project(points), expected.project(points), atol=1e-9)
    assert (case == "12 terms") == (folder / "photo_7_a_b_c.png").exists()

    launch: dict[str, Any] = {}
    source = (folder / "static_transforms.launch.py").read_text(encoding="utf-8")
    nodes = [line for line in source.splitlines() if not line.startswith("from launch")]
    exec("\n".join(nodes), {"LaunchDescription": list, "Node": lambda **given: given}, launch)
    published = launch["generate_launch_description"]()
    assert [each["arguments"] for each in published][-1] == command[4:]
    assert len(published) == len(found["/tf_static"].transforms)
    for path in folder.iterdir():
        if path.suffix in (".yaml", ".py", ".urdf"):
            said = path.read_text(encoding="utf-8")
            assert "Parent: " in said
            assert "Child: " in said
            if path.name != "scanner.transform.yaml":
                assert ("given, not verified" in said) == (case == "no lens")


def test_the_map_carries_coordinates_of_a_survey(written: dict[str, tuple[RegisteredScan, Path]]) -> None:
    for case in ("8 terms", "fisheye"):
        handed, folder = written[case]
        first = messages(folder / "scan.mcap")["/tf_static"].transforms[0]
        assert (first.header.frame_id, first.child_frame_id) == ("map", "scanner")
        offset = np.array([431_200.0, 5_412_300.0, 400.0])
        points = handed.scan.points[handed.scan.valid].astype(np.float64)
        mapped = np.column_stack([points, np.ones(len(points))]) @ matrix_of(first.transform).T
        world = points @ WORLD.rotation.T + WORLD.translation
        assert np.abs(mapped[:, :3] + offset - world).max() < 1e-6
        assert "add 431200 5412300 400" in (folder / "scanner.transform.yaml").read_text()
    assert not (written["5 terms"][1] / "scanner.transform.yaml").exists()


def test_mcap_reads_the_recording_by_its_index_and_the_mark(
    written: dict[str, tuple[RegisteredScan, Path]],
) -> None:
    from mcap.reader import NonSeekingReader, SeekingReader

    handed, folder = written["no lens"]
    with open(folder / "scan.mcap", "rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == len(summary.channels) == 4
        by_index = [(channel.topic, message.data) for _, channel, message in reader.iter_messages()]
        notes = [entry for record in reader.iter_metadata() for entry in record.metadata.values()]
    with open(folder / "scan.mcap", "rb") as file:
        by_scan = [(channel.topic, message.data) for _, channel, message in NonSeekingReader(file).iter_messages()]
    assert sorted(by_index) == sorted(by_scan)
    assert any("given, not verified" in note for note in notes)
    assert any("Parent: scanner" in note for note in notes)
    again = read_scan(folder / "scan.mcap")  # ladarreg's own reader; it grids the cloud anew
    assert np.count_nonzero(again.valid) > 0.95 * np.count_nonzero(handed.scan.valid)


def test_several_photographs_get_names_of_their_own(tmp_path: Path) -> None:
    names = ("a b", "a-b", "map", "9")
    photos = tuple(registered(camera, POSE, name) for name, (camera, _) in zip(names, CASES.values(), strict=False))
    handed = RegisteredScan(sample_scan(), photos)
    export_to(tmp_path / "out", handed, ["ros"])
    found = messages(tmp_path / "out" / "ros" / "scan.mcap")
    assert {topic.split("/")[1] for topic in found} == {"tf_static", "scan", "a_b", "a_b_2", "map_2", "photo_9"}
    children = [each.child_frame_id for each in found["/tf_static"].transforms]
    assert len(set(children)) == 4


def test_a_panorama_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    handed = RegisteredScan(sample_scan(), (registered(EquirectangularCamera(200, 100), POSE, "round"),))
    with pytest.raises(ExportError, match=r"ros cannot be written: .*equirectangular.*leave it out"):
        export_to(tmp_path / "out", handed, ["ros"])
    assert not list(tmp_path.iterdir())


def test_a_cancelled_recording_leaves_nothing(tmp_path: Path) -> None:
    geometry = sample_scan()
    tall = Scan(geometry.geometry, geometry.ranges, geometry.intensity)
    handed = RegisteredScan(tall, (registered(*CASES["5 terms"], "one"),))

    def cancel(progress: Progress) -> None:
        if progress.label == "writing the cloud":
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        export_to(tmp_path / "out", handed, ["ros"], report=cancel)
    assert not list(tmp_path.iterdir())
