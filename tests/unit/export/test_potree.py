"""The target `potree`: read back by a reader written from Potree's loaders."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera
from ladarreg_core.errors import Cancelled
from ladarreg_core.export.clouds.cloud_part import CloudPart
from ladarreg_core.export.output_frame import FrameName
from ladarreg_core.export.potree import octree
from ladarreg_core.export.potree.octree import NumberedPart, PotreeOctree
from ladarreg_core.export.potree.photographs import oriented_angles_deg, panorama_angles_deg
from ladarreg_core.export.registered_scan import RegisteredScan, RegisteredSurvey
from ladarreg_core.export.targets.pipeline import export_to
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, look_along
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.texture.best_photo import NO_PHOTO, CellColors
from testing.files.potree_reader import Cloud, read_cloud, read_oriented, read_panoramas
from tests.unit.export.camera_cases import CAMERAS, TILTED, WORLD, handed_over, photograph, world_points

AHEAD = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.05, -0.1, 0.02))
"""It looks along the world's X: the middle of Potree's three angles is then a right one."""
UP = Rigid.from_centre(look_along([0.0, 0.0, 1.0]), (0.0, 0.1, 0.0))
POSES = {"tilted": TILTED, "ahead": AHEAD, "up": UP}


def whole_points(handed: RegisteredScan) -> np.ndarray:
    return world_points(handed) + np.array(handed.frame.offset_m)


def exported(tmp_path: Path, handed: RegisteredScan | RegisteredSurvey) -> Path:
    export_to(tmp_path / "out", handed, ["potree"])
    return tmp_path / "out" / "potree"


@pytest.mark.parametrize("frame", ["scanner", "world"])
def test_every_return_is_in_the_cloud_once(tmp_path: Path, frame: FrameName) -> None:
    handed = handed_over(photograph(CAMERAS["4 terms"], "p"), photograph(CAMERAS["0 terms"], "q"), frame=frame)
    cloud = read_cloud(exported(tmp_path, handed) / "pointcloud")
    truth = whole_points(handed)
    assert cloud.metadata["points"] == len(truth) == len(cloud.points)
    middle = truth.mean(axis=0)
    far, which = cKDTree(cloud.points - middle).query(truth - middle)
    assert far.max() < np.sqrt(3) * 0.51e-4, "half a step in each direction"
    assert len(np.unique(which)) == len(truth)
    control = (truth - middle)[:, [1, 0, 2]]
    assert cKDTree(cloud.points - middle).query(control)[0].max() > 0.1, "x and y exchanged"


def test_points_have_the_attributes_of_their_cells(tmp_path: Path) -> None:
    narrow = Camera(60, 45, 150.0, 150.0, 29.0, 22.0)
    handed = handed_over(photograph(narrow, "p"), photograph(narrow, "q", pose=AHEAD))
    records = read_cloud(exported(tmp_path, handed) / "pointcloud").records
    scan, colors = handed.scan, handed.colors
    valid = np.asarray(scan.valid)
    corner = np.array(json.loads((tmp_path / "out/potree/pointcloud/metadata.json").read_text())["offset"])
    stored = np.rint((scan.points[valid].astype(np.float64) - corner) / 1e-4).astype(int)
    order, other = np.lexsort(records["position"].T), np.lexsort(stored.T)
    records = records[order]
    np.testing.assert_array_equal(records["position"], stored[other])
    np.testing.assert_array_equal(records["label"], colors.labels[valid][other])
    shown = colors.photo[valid][other]
    np.testing.assert_array_equal(records["photo_id"], np.where(shown == NO_PHOTO, 0, shown + 1))
    np.testing.assert_array_equal(records["sigma_px"], colors.sigma_px[valid][other])
    seen = shown != NO_PHOTO
    assert 0 < seen.sum() < len(seen)
    # As Potree turns 16 bits into 8.
    np.testing.assert_array_equal(records["rgb"][seen] // 256, colors.image[valid][other][seen])


def dense_part(rows: int = 420, columns: int = 600) -> CloudPart:
    geometry = AzimuthElevation(rows, columns, 0.002, 0.002)
    ranges = (3.0 + 0.2 * np.sin(9 * geometry.rays[..., 1])) / geometry.rays[..., 0]
    scan = Scan(geometry, ranges, np.ones(geometry.shape))
    nothing = np.zeros(geometry.shape)
    photo = np.full(geometry.shape, NO_PHOTO, np.uint16)
    colors = CellColors(
        np.zeros((*geometry.shape, 3), np.uint8), nothing.astype(np.uint8), photo, nothing.astype(np.float32)
    )
    return CloudPart(scan, colors)


def written(folder: Path, part: CloudPart) -> Cloud:
    folder.mkdir()
    made = PotreeOctree([NumberedPart(part, 1)], offset_m=(0, 0, 0), description="")
    made.write_points(folder / "octree.bin")
    made.write_hierarchy(folder / "hierarchy.bin")
    made.write_metadata(folder / "metadata.json")
    return read_cloud(folder)


def test_nodes_have_one_point_a_cell_and_lie_in_their_cubes(tmp_path: Path) -> None:
    cloud = written(tmp_path / "a", dense_part())
    nodes = cloud.root.all
    assert len(nodes) > 20
    slack = 2e-4
    for node in nodes:
        assert (node.points > node.low - slack).all()
        assert (node.points < node.high + slack).all()
        assert len(node.points), "no node is empty"
        if node.children:
            spacing = cloud.metadata["spacing"] / 2 ** (len(node.name) - 1)
            cells = np.floor((node.points - node.low + 1e-5) / spacing).astype(int)
            _, counts = np.unique(cells, axis=0, return_counts=True)
            assert (counts > 1).mean() < 0.01, "but for points on the border of two cells"
        else:
            assert len(node.points) <= 10_000
    coarse = cloud.root.points
    assert np.ptp(coarse, axis=0)[1:] == pytest.approx(np.ptp(cloud.points, axis=0)[1:], rel=0.03)
    assert 0.02 * len(cloud.points) < len(coarse) < 0.2 * len(cloud.points)


def test_parts_give_the_tree_of_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = dense_part()
    whole = written(tmp_path / "whole", part)
    monkeypatch.setattr(octree, "_MAX_PART_POINTS", 20_000)
    parts = written(tmp_path / "parts", part)
    assert {node.name: len(node.points) for node in whole.root.all} == {
        node.name: len(node.points) for node in parts.root.all
    }
    one, other = (cloud.records["position"][np.lexsort(cloud.records["position"].T)] for cloud in (whole, parts))
    np.testing.assert_array_equal(one, other)


def test_a_scan_of_one_place(tmp_path: Path) -> None:
    part = dense_part(4, 6)
    same = replace(part, scan=replace(part.scan, ranges=np.full(part.scan.shape, 1e-6)))
    assert len(written(tmp_path / "same", same).points) == 24


@pytest.mark.parametrize("frame", ["scanner", "world"])
@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("case", ["0 terms", "4 terms", "12 terms"])
def test_photographs_stand_where_they_were_taken(tmp_path: Path, case: str, pose: str, frame: FrameName) -> None:
    handed = handed_over(photograph(CAMERAS[case], "p", pose=POSES[pose]), frame=frame)
    folder = exported(tmp_path, handed) / "photographs" / "1"
    (image,) = read_oriented(folder / "camera.xml", folder / "photographs.txt")
    camera = CAMERAS[case]
    ahead = np.array([[-0.3, -0.2, 1.0], [0.3, 0.2, 1.1], [0.0, 0.1, 2.0], [0.25, -0.15, 1.5]]) * 3
    points = POSES[pose].inverse @ ahead
    if frame == "world":
        points = points @ WORLD.rotation.T + WORLD.translation
    found = image.pixels(points)
    true = camera.project(ahead)
    pixels = cv2.imread(str(image.file))[..., ::-1].astype(np.float32)
    assert pixels.shape[:2] == (image.height, image.width)
    shown = cv2.remap(pixels, found[None].astype(np.float32), None, cv2.INTER_LINEAR)[0]
    stated = shown[:, :2] * max(camera.size) / 250  # red is the column, green the row of the photograph's own pixel
    assert np.abs(stated - true).max() < 0.8, "the rounding of colours is half of that"
    mirrored = cv2.remap(pixels, (found * [-1, 1] + [image.width - 1, 0])[None].astype(np.float32), None, 1)[0]
    assert np.abs(mirrored[:, :2] * max(camera.size) / 250 - true).max() > 5, "the control: left and right exchanged"
    ideal = Camera.from_focal(*camera.size, camera.focal_px)
    np.testing.assert_allclose(found, ideal.project(ahead), atol=1e-4)


def test_a_photograph_without_lens_is_copied(tmp_path: Path) -> None:
    camera = Camera.from_focal(120, 90, 100.0)
    one = photograph(camera, "p")
    file = tmp_path / "p.png"
    cv2.imwrite(str(file), cv2.cvtColor(np.asarray(one.photo.pixels), cv2.COLOR_RGB2BGR))
    folder = exported(tmp_path, handed_over(replace(one, file=file)))
    assert (folder / "photographs/1/p.png").read_bytes() == file.read_bytes()


def test_photographs_of_one_camera_share_its_file_and_marks_are_told(tmp_path: Path) -> None:
    camera, other = CAMERAS["4 terms"], CAMERAS["fisheye"]
    photos = [photograph(camera, "a"), photograph(CAMERAS["0 terms"], "b", given=True), photograph(other, "c")]
    shared = Camera.from_focal(90, 120, 140.0)
    photos += [photograph(shared, "d"), photograph(shared, "e", pose=AHEAD)]
    folder = exported(tmp_path, handed_over(*photos))
    about = json.loads((folder / "photographs.json").read_text(encoding="utf-8"))
    files = {one["id"]: one["file"] for one in about["photographs"]}
    assert files == {
        "a": "photographs/1/a.jpg",
        "b": "photographs/1/b.given-not-verified.jpg",
        "c": "panoramas/c.jpg",
        "d": "photographs/2/d.jpg",
        "e": "photographs/2/e.jpg",
    }
    assert about["cameras"] == ["photographs/1", "photographs/2"]
    assert about["panoramas"] == "panoramas"
    assert all((folder / name).is_file() for name in files.values())
    for text in (
        " ".join(about["poses"]),
        json.loads((folder / "pointcloud/metadata.json").read_text())["description"],
    ):
        assert "given, not verified" in text
    listed = read_oriented(folder / "photographs/2/camera.xml", folder / "photographs/2/photographs.txt")
    assert [image.file.name for image in listed] == ["d.jpg", "e.jpg"]


PANORAMAS: dict[str, CameraModel] = {
    "equirectangular": EquirectangularCamera(1440, 720),
    "window": EquirectangularCamera(800, 400, (-70.0, 40.0, 80.0, -35.0)),
    "fisheye": CAMERAS["fisheye"].scaled(4),
}


@pytest.mark.parametrize("frame", ["scanner", "world"])
@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("case", PANORAMAS)
def test_panoramas_stand_where_they_were_taken(tmp_path: Path, case: str, pose: str, frame: FrameName) -> None:
    camera = PANORAMAS[case]
    handed = handed_over(photograph(camera, "p", pose=POSES[pose]), frame=frame)
    (image,) = read_panoramas(exported(tmp_path, handed) / "panoramas")
    rays = camera.unproject(np.random.default_rng(1).uniform(0.1, 0.9, (60, 2)) * np.array(camera.size))
    points = POSES[pose].inverse @ (rays * 3)
    if frame == "world":
        points = points @ WORLD.rotation.T + WORLD.translation
    shares = image.shares(points)
    pixels = cv2.imread(str(image.file))[..., ::-1].astype(np.float32)

    def stated(shares: np.ndarray) -> np.ndarray:
        at = (shares * [pixels.shape[1], pixels.shape[0]] - 0.5).astype(np.float32)
        return cv2.remap(pixels, at[None], None, cv2.INTER_LINEAR)[0][:, :2] * max(camera.size) / 250

    true = camera.project(rays)
    step = max(camera.size) / 250  # of colours
    assert np.median(np.abs(stated(shares) - true)) < 0.6 * step
    assert np.abs(stated(shares) - true).max() < 3 * step
    assert np.abs(stated(shares * [-1, 1] + [1, 0]) - true).max() > 20 * step, "the control: left and right exchanged"
    if case == "equirectangular":
        own = true + 0.5
        off = shares * camera.size - own
        off[:, 0] -= np.rint(off[:, 0] / camera.width) * camera.width
        assert np.abs(off).max() < 0.01


def test_angles_turn_any_camera_as_it_is() -> None:
    turns = [*Rotation.random(200, random_state=3).as_matrix(), *(pose.rotation for pose in POSES.values())]
    for near in (1e-5, 1e-7, 1e-9):
        turns.append(Rotation.from_rotvec([0, near, 0.3]).as_matrix() @ AHEAD.inverse.rotation)
    for turn in turns:
        oriented = Rotation.from_euler("XYZ", oriented_angles_deg(turn), degrees=True).as_matrix()
        np.testing.assert_allclose(oriented, turn @ np.diag([1, -1, -1]), atol=2e-6)
        course, pitch, roll = panorama_angles_deg(turn)
        sphere = Rotation.from_euler("ZYX", [90 - course, -pitch, roll + 90], degrees=True).as_matrix()
        np.testing.assert_allclose(sphere, turn @ [[0, 0, 1], [0, -1, 0], [1, 0, 0]], atol=2e-6)


def test_a_survey_is_one_cloud_with_all_photographs(tmp_path: Path) -> None:
    one = handed_over(photograph(CAMERAS["0 terms"], "p"), frame="world")
    shifted = replace(one.scan, world_from_scanner=Rigid(WORLD.rotation, WORLD.translation + np.array([0.5, 0, 0])))
    other = replace(
        handed_over(photograph(CAMERAS["0 terms"], "q"), frame="world"), id="other", scan=shifted,
        frame=replace(one.frame, world_from_scanner=shifted.world_from_scanner),
    )  # fmt: skip
    bare = replace(one, id="bare", photos=(), of_survey=True)
    folder = exported(tmp_path, RegisteredSurvey([one, bare, other]))
    records = read_cloud(folder / "pointcloud").records
    assert len(records) == 3 * len(world_points(one))
    assert set(records["photo_id"]) == {0, 1, 2}
    images = read_oriented(folder / "photographs/1/camera.xml", folder / "photographs/1/photographs.txt")
    np.testing.assert_allclose(images[1].place - images[0].place, [0.5, 0, 0], atol=1e-8)


def test_an_export_can_be_cancelled_and_leaves_nothing(tmp_path: Path) -> None:
    def stop(progress: Progress) -> None:
        if "octree" in progress.label:
            raise Cancelled

    with pytest.raises(Cancelled):
        export_to(tmp_path / "out", handed_over(photograph(CAMERAS["0 terms"], "p")), ["potree"], report=stop)
    assert not list(tmp_path.iterdir())
