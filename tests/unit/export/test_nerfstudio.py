"""The target `nerfstudio`: a reader written from its published conventions finds the laser's points and their depth.

The scene is exact: flat walls and boxes, met by rays in closed form, and a scan without noise.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import trimesh

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera, FisheyeCamera
from ladarreg_core.errors import Cancelled
from ladarreg_core.export.output_frame import FrameName, OutputFrame
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.export.targets.nerfstudio import nerfstudio_files
from ladarreg_core.export.targets.pipeline import export_to
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.formats.cameras.camera_file import read_cameras, read_stated_pose
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import Rigid, look_along, rotation_from_rotvec
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from testing.scenes.painted_room import shoot
from tests.unit.export.camera_cases import WORLD, photograph, world_points

PINHOLE = (240, 180, 260.0, 262.0, 121.0, 88.0)
CAMERAS: dict[str, CameraModel] = {
    "0 terms": Camera(*PINHOLE),
    "5 terms": Camera(*PINHOLE, (-0.12, 0.03, 0.002, -0.001, 0.004)),
    "8 terms": Camera(*PINHOLE, (0.1, -0.02, 0.003, 0.001, 0.004, 0.02, -0.003, 0.001)),
    "12 terms": Camera(*PINHOLE, (0.05, -0.02, 0, 0, 0, 0.02, 0, 0, 0.01, -0.003, 0.008, 0.002)),
    "fisheye": FisheyeCamera(200, 150, 155.0, 156.0, 101.0, 73.0, (0.02, -0.01, 0.003, -0.0004)),
    "equirectangular": EquirectangularCamera(960, 480),
    "window": EquirectangularCamera(210, 160, (-40.0, 35.0, 44.0, -28.0)),
    "seam": EquirectangularCamera(960, 480),
}
CENTRE = np.array([0.15, 0.35, 0.1])
POSE = Rigid.from_centre(rotation_from_rotvec((0.03, -0.02, 0.05)) @ look_along([3.5, -0.4, -0.3]), CENTRE)
BACKWARD = Rigid.from_centre(rotation_from_rotvec((0, np.pi - 0.05, 0)) @ POSE.rotation, CENTRE)
_FLIPS = {"y": np.diag([1, -1, 1, 1.0]), "z": np.diag([1, 1, -1, 1.0])}


@cache
def exact_scan() -> Scan:
    geometry = AzimuthElevation(150, 190, np.deg2rad(0.25), np.deg2rad(0.25))
    ranges, *_ = shoot(np.zeros(3), geometry.rays.reshape(-1, 3))
    ranges = np.where(np.isfinite(ranges), ranges, np.nan).reshape(geometry.shape)
    ranges[30:33, 40:50] = np.nan
    return Scan(geometry, ranges, np.ones(geometry.shape), world_from_scanner=WORLD)


def pose_of(case: str) -> Rigid:
    return BACKWARD if case == "seam" else POSE


def handed_over(*cases: str, frame: FrameName = "scanner", given: bool = False) -> RegisteredScan:
    photos = [
        photograph(CAMERAS[case], f"p{k}", pose=pose_of(case), given=given and k == 0) for k, case in enumerate(cases)
    ]
    return RegisteredScan(exact_scan(), photos, frame=OutputFrame.of(exact_scan(), frame))


def projected(model: str, frame: dict[str, Any], points: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return pixels (N, 2), where (.5, .5) is the centre of the first one, z and distance of points of the world."""
    x, y, z = ((points - matrix[:3, 3]) @ matrix[:3, :3]).T
    y, z = -y, -z  # from OpenGL's axes to those in which distortion is written
    distance = np.sqrt(x * x + y * y + z * z)
    if model == "EQUIRECTANGULAR":
        xd, yd = np.arctan2(x, z) / np.pi, np.arcsin(y / distance) / np.pi
    elif model == "OPENCV_FISHEYE":
        radius = np.hypot(x, y)
        angle = np.arctan2(radius, z)
        bent = angle * (1 + sum(frame[f"k{n}"] * angle ** (2 * n) for n in (1, 2, 3, 4)))
        xd, yd = x / radius * bent, y / radius * bent
    else:
        x, y = x / z, y / z
        s = x * x + y * y
        radial = 1 + s * (frame["k1"] + s * (frame["k2"] + s * frame["k3"]))
        p1, p2 = frame["p1"], frame["p2"]
        xd = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x)
        yd = y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y
    uv = np.stack([frame["fl_x"] * xd + frame["cx"], frame["fl_y"] * yd + frame["cy"]], axis=-1)
    return uv, z, distance


def in_sight(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return which points nothing of the scene hides from a camera."""
    along = points - centre
    distance = np.linalg.norm(along, axis=1)
    met, *_ = shoot(centre, along / distance[:, None])
    return np.abs(met - distance) < 1e-4


def sampled(depth: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return a depth map between its pixels; NaN where one of the four around has none or is of another surface."""
    column, row = np.floor(at).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < depth.shape[1] - 1) & (row < depth.shape[0] - 1)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    four = np.stack([depth[row + i, column + j] for i in (0, 1) for j in (0, 1)]).astype(float)
    four[four == 0] = np.nan
    with np.errstate(invalid="ignore"):
        flat = inside & (four.max(axis=0) < 1.01 * four.min(axis=0))
    (u, v) = (at - np.stack([column, row], axis=-1)).T
    share = np.stack([(1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u])
    return np.where(flat, 1 / (share / four).sum(axis=0), np.nan)


@pytest.mark.slow
@pytest.mark.parametrize(("case", "frame_name"), [*((case, "scanner") for case in CAMERAS), ("5 terms", "world")])
def test_a_reader_of_the_convention_finds_the_points_and_their_depth(
    tmp_path: Path, case: str, frame_name: FrameName
) -> None:
    handed = handed_over(case, frame=frame_name)
    export_to(tmp_path / "out", handed, ["nerfstudio"])
    folder = tmp_path / "out" / "nerfstudio"
    meta = json.loads((folder / "transforms.json").read_text("utf-8"))
    (frame,) = meta["frames"]
    shown = cv2.imread(str(folder / frame["file_path"]))
    assert shown.shape[:2] == (frame["h"], frame["w"])
    true_camera, pose = CAMERAS[case], pose_of(case)
    if frame["is_undistorted"]:
        assert case in ("8 terms", "12 terms")
        assert isinstance(true_camera, Camera)
        true_camera = true_camera.without_distortion()
    else:
        assert np.array_equal(shown[..., ::-1], handed.photos[0].photo.pixels)
    assert all(len(row) == 4 for row in frame["transform_matrix"])

    points = exact_scan().points[exact_scan().valid].astype(np.float64)
    true = true_camera.project(pose @ points)
    visible = true_camera.contains(true) & in_sight(points, pose.centre)
    assert visible.sum() > 5_000
    matrix = np.array(frame["transform_matrix"])

    def error(matrix: np.ndarray, shift: float) -> float:
        uv, *_ = projected(meta["camera_model"], frame, world_points(handed)[visible], matrix)
        return float(np.hypot(*true_camera.difference(uv - shift, true[visible]).T).max())

    assert error(matrix, 0.5) < 1e-5  # 0.5 is asked for
    assert error(matrix, 0.0) > 0.5
    for flip in _FLIPS.values():
        assert error(matrix @ flip, 0.5) > 5

    # The depth of the points, along the axis or from the centre, in both files.
    uv, z, distance = projected(meta["camera_model"], frame, world_points(handed)[visible], matrix)
    wanted, other = (z, distance) if meta["camera_model"] == "OPENCV" else (distance, z)
    metres = np.load(folder / frame["depth_npz_path"])["depth"]
    steps = cv2.imread(str(folder / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
    mask = cv2.imread(str(folder / frame["mask_path"]), cv2.IMREAD_UNCHANGED)
    assert (metres.dtype, steps.dtype, mask.dtype) == (np.float32, np.uint16, np.uint8)
    assert metres.shape == steps.shape == mask.shape == shown.shape[:2]
    assert np.array_equal(mask, np.where(metres > 0, 255, 0))
    step = meta["depth_unit_scale_factor"]
    assert np.abs(steps * step - metres).max() <= step / 2 * 1.001
    assert step == 0.001

    found = sampled(metres, uv - 0.5)
    there = np.isfinite(found)
    assert there.mean() > 0.8
    relative = np.abs(found / wanted - 1)[there]
    assert np.quantile(relative, 0.99) < 1e-3  # the rest lies on creases
    assert np.quantile(np.abs(found / other - 1)[there], 0.9) > 1e-2
    moved = sampled(metres, uv - 0.5 + [3, 3])
    assert np.nanquantile(np.abs(moved / wanted - 1), 0.99) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("case", ["0 terms", "5 terms", "fisheye", "seam"])
def test_every_pixels_depth_is_that_of_the_surface_at_its_centre(tmp_path: Path, case: str) -> None:
    handed, camera, pose = handed_over(case), CAMERAS[case], pose_of(case)
    export_to(tmp_path / "out", handed, ["nerfstudio"])
    depth = np.load(tmp_path / "out" / "nerfstudio" / "depth" / "p0.npz")["depth"]
    v, u = np.nonzero(depth)
    rays = camera.unproject(np.stack([u, v], axis=-1))
    met, *_ = shoot(pose.centre, rays @ pose.rotation)
    wanted = met * (rays[:, 2] if isinstance(camera, Camera) else 1)
    off = np.abs(depth[v, u] / wanted - 1)
    # At depth edges the scan decides by its cells, the photograph by its pixels; elsewhere they agree.
    assert (off < 1e-3).mean() > 0.97
    assert (off < 0.02).mean() > 0.998
    true = np.zeros(depth.shape)
    true[v, u] = wanted
    smooth = cv2.dilate(true, np.ones((7, 7))) < 1.03 * cv2.erode(true, np.ones((7, 7)))  # no edge, all of them valid
    assert (off[smooth[v, u]] < 1e-3).mean() > 0.999


@pytest.mark.slow
def test_several_models_have_a_file_each_and_colmap_stands_beside(tmp_path: Path) -> None:
    handed = handed_over("0 terms", "fisheye", "5 terms", "window", "12 terms", frame="world", given=True)
    export_to(tmp_path / "out", handed, ["nerfstudio"])
    folder = tmp_path / "out" / "nerfstudio"
    listed = {path.name for path in folder.iterdir()}
    assert listed == {
        "transforms.json", "transforms_fisheye.json", "transforms_equirectangular.json", "images", "depth", "masks",
        "sparse_pc.ply", "colmap", "offset.json",
    }  # fmt: skip
    meta = json.loads((folder / "transforms.json").read_text("utf-8"))
    assert [frame["file_path"] for frame in meta["frames"]] == [
        "images/p0.given-not-verified.png",
        "images/p2.png",
        "images/p4.png",
    ]
    assert [frame["pose_is"] for frame in meta["frames"]][:2] == ["given, not verified", "accepted (image)"]
    assert meta["ladarreg"]["marks"]
    assert meta["ladarreg"]["offset_m"] == json.loads((folder / "offset.json").read_text())["offset_m"]

    # The cloud is the laser's, in the frame of the poses; COLMAP's reconstruction too.
    cloud = trimesh.load(folder / meta["ply_file_path"])
    assert b"p0.given-not-verified.png: Pose: given, not verified" in (folder / "sparse_pc.ply").read_bytes()[:4000]
    written = world_points(handed)
    for point in np.asarray(cloud.vertices)[::997]:
        assert np.abs(written - point).sum(axis=1).min() < 1e-3
    found = pycolmap.Reconstruction(folder / "colmap" / "sparse" / "0")
    assert {image.name for image in found.images.values()} == {
        "p0.given-not-verified.png",
        "p1.png",
        "p2.png",
        "p4.png",
    }
    image = found.find_image_with_name("p2.png")
    matrix = np.array(meta["frames"][1]["transform_matrix"])
    assert np.abs(image.projection_center() - matrix[:3, 3]).max() < 1e-9
    assert np.abs(image.cam_from_world().rotation.matrix().T @ np.diag([1, -1, -1]) - matrix[:3, :3]).max() < 1e-9


@pytest.mark.parametrize("case", ["0 terms", "5 terms", "fisheye", "equirectangular", "window"])
def test_ladarreg_reads_its_own_export(tmp_path: Path, case: str) -> None:
    handed = handed_over(case, frame="world")
    file = tmp_path / "transforms.json"
    dict(nerfstudio_files(handed, ExportOptions(), None))[file.name](file)
    (found,) = read_cameras(file)
    rays = np.random.default_rng(0).normal((0, 0, 2), (0.6, 0.5, 0.1), (50, 3))
    assert found.camera.size == CAMERAS[case].size
    assert np.abs(found.camera.project(rays) - CAMERAS[case].project(rays)).max() < 1e-6
    pose = read_stated_pose(file, "p0.png")
    assert pose is not None
    true = handed.written_from_camera(handed.photos[0]).inverse
    assert pose.distance_to(true) < 1e-8
    assert pose.angle_to(true) < 1e-9


def test_the_step_of_the_depth_grows_with_the_range(tmp_path: Path) -> None:
    far = replace(exact_scan(), ranges=exact_scan().ranges * 30)
    handed = RegisteredScan(far, handed_over("0 terms").photos)
    for name, write in nerfstudio_files(handed, ExportOptions(), None):
        if name == "depth/p0.png" or name.startswith("transforms"):
            write(tmp_path / Path(name).name)
    step = json.loads((tmp_path / "transforms.json").read_text("utf-8"))["depth_unit_scale_factor"]
    assert step == 0.005
    steps = cv2.imread(str(tmp_path / "p0.png"), cv2.IMREAD_UNCHANGED)
    z = (POSE @ far.points[far.valid].astype(np.float64))[:, 2]
    assert 60 < np.median(steps[steps > 0]) * step < z.max()


def test_a_cancelled_export_leaves_nothing(tmp_path: Path) -> None:
    def cancel(progress: Progress) -> None:
        if progress.label.startswith("depth of"):
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        export_to(tmp_path / "out", handed_over("0 terms"), ["nerfstudio"], report=cancel)
    assert not list(tmp_path.iterdir())
