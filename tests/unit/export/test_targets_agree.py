"""All targets of one export, read back by independent readers: one set of points, poses and pixels in the survey."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ladarreg_core.camera import Camera
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.export.targets.pipeline import export_to
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from testing.files.gltf_checks import Glb
from testing.scenes.small_registration import sample_scan
from tests.unit.export.camera_cases import photograph

LENS = (0.1, -0.02, 0.003, 0.001)
TRUE_CAMERAS: dict[str, tuple[tuple[float, float, float, float], tuple[float, ...], tuple[int, int]]] = {
    "left": ((100.0, 101.0, 59.0, 45.0), LENS, (120, 90)),
    "right": ((95.0, 96.0, 44.0, 71.0), (0.0,) * 4, (90, 140)),
}
WORLD = Rigid(rotation_from_rotvec((0.3, -0.2, 1.2)), np.array([431_234.567, 5_412_345.678, 412.3]))
POSES = {
    "left": Rigid.from_centre(rotation_from_rotvec((0.05, -0.1, 0.2)) @ CAMERA_AXES_FROM_SCANNER, (0.1, 0.3, 0.05)),
    "right": Rigid.from_centre(CAMERA_AXES_FROM_SCANNER @ rotation_from_rotvec((0, 0, -0.2)), (0.0, -0.4, -0.1)),
}
TARGETS = ("colmap", "nerfstudio", "e57", "ros", "laz", "ply", "opencv", "kalibr", "glb", "obj", "tiles")
OPENGL = np.diag([1.0, -1.0, -1.0])
Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
SINGLE_M, LASER_M, TURN = 2e-5, 1e-4, 1e-9


@dataclass(frozen=True)
class View:
    """A camera as a file states it: a point of the survey is at pixel K, D of rotation @ (point - centre)."""

    rotation: np.ndarray
    centre: np.ndarray
    K: tuple[float, float, float, float]
    D: tuple[float, ...]

    def pixels(self, points: np.ndarray) -> np.ndarray:
        fx, fy, cx, cy = self.K
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        seen = (points - self.centre) @ self.rotation.T
        return cv2.projectPoints(seen, np.zeros(3), np.zeros(3), K, np.array(self.D))[0][:, 0]


@dataclass(frozen=True)
class Read:
    """What a reader found: points in the survey (m), their colours, cameras."""

    points: np.ndarray | None = None
    colors: np.ndarray | None = None
    views: dict[str, View] | None = None


def _homogeneous(matrix: Any, points: np.ndarray) -> np.ndarray:
    return points @ np.asarray(matrix)[:3, :3].T + np.asarray(matrix)[:3, 3]


def _view(matrix: np.ndarray, offset: np.ndarray, K: Any, D: Any) -> View:
    """Return the view of a camera_from_world, less an offset."""
    turn = matrix[:3, :3]
    return View(turn, offset - turn.T @ matrix[:3, 3], tuple(K), tuple(D))


def _offset(folder: Path) -> np.ndarray:
    return np.array(json.loads((folder / "offset.json").read_text())["offset_m"])


def read_colmap(folder: Path) -> Read:
    import pycolmap

    offset, model = _offset(folder), pycolmap.Reconstruction(str(folder / "sparse/0"))
    views = {}
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        fx, fy, cx, cy, *lens = camera.params
        pose = image.cam_from_world()
        matrix = np.eye(4)
        matrix[:3] = pose.matrix()
        views[image.name.split(".")[0]] = _view(matrix, offset, (fx, fy, cx - 0.5, cy - 0.5), lens or (0.0,) * 4)
    points = list(model.points3D.values())
    return Read(np.array([p.xyz for p in points]) + offset, np.array([p.color for p in points]), views)


def read_nerfstudio(folder: Path) -> Read:
    document, offset = json.loads((folder / "transforms.json").read_text()), _offset(folder)
    cloud = trimesh.load(folder / document["ply_file_path"])
    views = {}
    for frame in document["frames"]:
        matrix = np.array(frame["transform_matrix"])
        views[Path(frame["file_path"]).name.split(".")[0]] = View(
            OPENGL @ matrix[:3, :3].T,
            matrix[:3, 3] + offset,
            (frame["fl_x"], frame["fl_y"], frame["cx"] - 0.5, frame["cy"] - 0.5),
            tuple(frame[key] for key in ("k1", "k2", "p1", "p2")),
        )
        assert frame["k3"] == 0
    return Read(np.asarray(cloud.vertices) + offset, np.asarray(cloud.colors)[:, :3], views)


def read_e57(folder: Path) -> Read:
    import pye57

    file = pye57.E57(str(next(folder.glob("*.e57"))))
    raw = file.read_scan_raw(0, ignore_unsupported_fields=True)  # isColorInvalid
    header = file.get_header(0)
    cartesian = np.stack([raw[f"cartesian{axis}"] for axis in "XYZ"], axis=-1)
    w, x, y, z = header.rotation
    points = Rotation.from_quat([x, y, z, w]).apply(cartesian) + header.translation
    colors = np.stack([raw[f"color{name}"] for name in ("Red", "Green", "Blue")], axis=-1)
    views = {}
    images = file.image_file.root()["images2D"]
    for index in range(images.childCount()):
        node = images[index]
        if not node.isDefined("pinholeRepresentation"):
            continue
        pinhole, pose = node["pinholeRepresentation"], node["pose"]
        focal = pinhole["focalLength"].value()
        quaternion = [pose["rotation"][key].value() for key in "xyzw"]
        views["left" if "left" in node["name"].value() else "right"] = View(
            OPENGL @ Rotation.from_quat(quaternion).as_matrix().T,
            np.array([pose["translation"][key].value() for key in "xyz"]),
            (
                focal / pinhole["pixelWidth"].value(),
                focal / pinhole["pixelHeight"].value(),
                pinhole["principalPointX"].value() - 0.5,
                pinhole["principalPointY"].value() - 0.5,
            ),
            (),
        )
    file.close()
    return Read(points, colors, views)


def read_ros(folder: Path) -> Read:
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.typesys import Stores, get_typestore

    store, reader = get_typestore(Stores.ROS2_HUMBLE), McapReader(folder / "scan.mcap")
    reader.open()
    found = {c.topic: store.deserialize_cdr(raw, c.msgtype) for c, _, raw in reader.messages(reader.connections)}
    reader.close()
    note = (folder / "scanner.transform.yaml").read_text().split("; add ")[1]
    offset = np.array([float(word.rstrip(".")) for word in note.split()[:3]])
    frames: dict[str, np.ndarray] = {}
    for each in next(value for topic, value in found.items() if topic == "/tf_static").transforms:
        q, t = each.transform.rotation, each.transform.translation
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        matrix[:3, 3] = t.x, t.y, t.z
        frames[each.child_frame_id] = matrix
    cloud = found["/scan/points"]
    at = {field.name: field.offset for field in cloud.fields}
    rows = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_step)
    xyz = np.stack([rows[:, at[k] : at[k] + 4].copy().view("<f4")[:, 0] for k in "xyz"], axis=-1)
    packed = rows[:, at["rgb"] : at["rgb"] + 3]
    assert cloud.header.frame_id == "scanner"
    views = {}
    for name in TRUE_CAMERAS:
        info = found[f"/{name}/camera_info"]
        pose = np.linalg.inv(frames["scanner"] @ frames[f"{name}_optical_frame"])
        views[name] = _view(pose, offset, np.asarray(info.k)[[0, 4, 2, 5]], info.d)
    return Read(_homogeneous(frames["scanner"], xyz.astype(float)) + offset, packed[:, ::-1], views)


def read_laz(folder: Path) -> Read:
    data = laspy.read(next(folder.glob("*.laz")))
    colors = np.stack([data.red, data.green, data.blue], axis=-1) // 257
    return Read(data.xyz, np.where(np.asarray(data["photo_id"])[:, None] > 0, colors, 0))


def read_ply(folder: Path) -> Read:
    cloud = trimesh.load(folder / "cloud.ply")
    return Read(np.asarray(cloud.vertices) + _offset(folder), np.asarray(cloud.colors)[:, :3])


def read_opencv(folder: Path) -> Read:
    views = {}
    for name in TRUE_CAMERAS:
        file = cv2.FileStorage(str(folder / f"{name}.yaml"), cv2.FILE_STORAGE_READ)
        get = {key: file.getNode(key).mat() for key in ("K", "D", "rvec", "tvec", "world_offset_m")}
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = cv2.Rodrigues(get["rvec"])[0], get["tvec"].ravel()
        K = get["K"]
        views[name] = _view(
            matrix, get["world_offset_m"].ravel(), (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), get["D"].ravel()
        )
    return Read(views=views)


def read_kalibr(folder: Path) -> Read:
    """Return the rig; its first camera stands where it truly is, since the chain has no world."""
    chain = yaml.safe_load((folder / "camchain.yaml").read_text())
    pose, views = (POSES["left"] @ WORLD.inverse).matrix, {}
    pose[:3, 3] = 0  # the world's origin is the first camera: the numbers stay small
    centre = (WORLD @ POSES["left"].centre[None])[0]
    for name, camera in zip(TRUE_CAMERAS, chain.values(), strict=True):
        pose = np.array(camera.get("T_cn_cnm1", np.eye(4))) @ pose
        views[name] = _view(pose, centre, camera["intrinsics"], camera["distortion_coeffs"])
    return Read(views=views)


def read_glb(folder: Path) -> Read:
    """Return the corners as trimesh places them in glTF's axes (y up), turned to z up."""
    scene = trimesh.load(folder / "model.glb")
    offset = np.array(Glb((folder / "model.glb").read_bytes()).document["nodes"][0]["extras"]["offset_m"])
    corners = [
        _homogeneous(scene.graph[name][0], scene.geometry[scene.graph[name][1]].vertices)
        for name in scene.graph.nodes_geometry
    ]
    return Read(np.concatenate(corners) @ Z_UP_FROM_Y_UP.T + offset)


def read_obj(folder: Path) -> Read:
    lines = (folder / "model.obj").read_text(encoding="utf-8").splitlines()
    stated = next(line.split()[2:] for line in lines if line.startswith("# offset_m"))
    corners = [line.split()[1:4] for line in lines if line.startswith("v ")]
    return Read(np.array(corners, float) + np.array(stated, float))


def read_tiles(folder: Path) -> Read:
    root = json.loads((folder / "tileset.json").read_text())["root"]
    transform, points = np.array(root["transform"]).reshape(4, 4).T, []
    stack = [root]
    while stack:
        tile = stack.pop()
        stack += tile.get("children", [])
        glb = Glb((folder / tile["content"]["uri"]).read_bytes())
        (node,) = glb.document["nodes"]
        turn = Z_UP_FROM_Y_UP @ Rotation.from_quat(node["rotation"]).as_matrix()
        for primitive in glb.document["meshes"][0]["primitives"]:
            own = glb.accessor(primitive["attributes"]["POSITION"]).astype(float) + node.get("translation", 0)
            points.append(_homogeneous(transform, own @ turn.T))
    return Read(np.concatenate(points))


READERS: dict[str, Callable[[Path], Read]] = {name: globals()[f"read_{name}"] for name in TARGETS}


@pytest.fixture(scope="module")
def handed() -> RegisteredScan:
    scan = replace(sample_scan(), world_from_scanner=WORLD)
    photos = [
        photograph(Camera(*size, *K, LENS if name == "left" else ()), name, pose=POSES[name], given=name == "right")
        for name, (K, _, size) in TRUE_CAMERAS.items()
    ]
    return RegisteredScan(scan, photos, frame=OutputFrame.of(scan, "world"))


@pytest.fixture(scope="module")
def found(handed: RegisteredScan, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Read]:
    out = tmp_path_factory.mktemp("agree") / "out"
    export_to(out, handed, TARGETS)
    return {name: read(out / name) for name, read in READERS.items()}


@pytest.fixture(scope="module")
def truth(handed: RegisteredScan) -> np.ndarray:
    """The returns in the survey, from the angles and ranges of the scan."""
    scan = handed.scan
    own = scan.geometry.rays.astype(float) * np.asarray(scan.ranges, float)[..., None]
    return own[np.isfinite(own).all(axis=-1)] @ WORLD.rotation.T + WORLD.translation


def true_view(name: str, wrong: str = "") -> View:
    turn = POSES[name].rotation @ WORLD.rotation.T
    K, D, _ = TRUE_CAMERAS[name]
    return View(turn.T if wrong else turn, POSES[name].centre @ WORLD.rotation.T + WORLD.translation, K, D)


def distances(points: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return how far the nearest true return is from every point, m; WORLD's origin is subtracted first."""
    return cKDTree(truth - WORLD.translation).query(points - WORLD.translation)[0]


def distance_to_walls(points: np.ndarray) -> np.ndarray:
    """Return how far points of the survey are from the two walls of the scene, 2.5 and 4 m in front, m."""
    ahead = ((points - WORLD.translation) @ WORLD.rotation)[:, 0]
    return np.minimum(np.abs(ahead - 2.5), np.abs(ahead - 4))


@pytest.mark.parametrize("name", [name for name in TARGETS if name not in ("opencv", "kalibr")])
def test_points(name: str, found: dict[str, Read], truth: np.ndarray) -> None:
    points = found[name].points
    assert points is not None
    limit = LASER_M if name == "laz" else SINGLE_M
    far = distances(points, truth)
    if name in (
        "glb",
        "obj",
        "tiles",
    ):  # triangles are cut where a photograph ends, between returns
        far = np.where(far < limit, far, distance_to_walls(points))
        assert (distances(points, truth) < limit).mean() > 0.8
    assert far.max() < limit
    if name in ("e57", "ros", "laz", "ply"):
        assert len(points) == len(truth)
        assert distances(truth, points).max() < limit, "every return is there"
    control = (points - WORLD.translation) @ WORLD.rotation @ WORLD.rotation + WORLD.translation
    assert distances(control, truth).max() > 0.5, "the transposed rotation of the world"


@pytest.mark.parametrize("name", [name for name in TARGETS if name not in ("laz", "ply", "glb", "obj", "tiles")])
def test_poses_and_pixels(name: str, found: dict[str, Read], truth: np.ndarray) -> None:
    views = found[name].views
    assert views is not None
    assert set(views) == set(TRUE_CAMERAS)
    for photo, view in views.items():
        true = true_view(photo)
        if name == "e57":
            true = replace(true, D=())  # its pictures are undistorted
        np.testing.assert_allclose(view.rotation, true.rotation, atol=TURN)
        np.testing.assert_allclose(view.centre, true.centre, rtol=0, atol=1e-8)
        np.testing.assert_allclose(view.pixels(truth), true.pixels(truth), atol=1e-5)
        wrong = true_view(photo, "transposed")
        assert np.abs(view.pixels(truth) - wrong.pixels(truth)).max() > 10, "the transposed rotation"


@pytest.mark.parametrize("name", ["colmap", "nerfstudio", "e57", "ros", "laz", "ply"])
def test_colors_are_those_of_the_pixels(name: str, found: dict[str, Read]) -> None:
    """A photograph's red is its column and green its row; blue 128 tells them from gray points that none shows."""
    points, stated = found[name].points, found[name].colors
    assert points is not None
    assert stated is not None
    colors = stated.astype(float)
    states, controls = [], []
    for photo, (_, _, size) in TRUE_CAMERAS.items():
        uv = true_view(photo).pixels(points)
        states.append(np.abs(colors[:, :2] * max(size) / 250 - uv).max(axis=1))
        controls.append(np.abs(colors[:, :2] * max(size) / 250 - (uv @ np.array([[0, 1], [1, 0]]))).max(axis=1))
    shown = (colors[:, 2] == 128) & (np.ptp(colors, axis=1) > 0)
    assert shown.sum() > 500
    assert np.min(states, axis=0)[shown].max() < 1.1
    for off in states:
        assert (off[shown] > 3).sum() > 50, "both photographs colour points"
    assert np.min(controls, axis=0)[shown].max() > 5, "columns and rows exchanged"
