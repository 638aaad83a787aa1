"""The target `colmap`: pycolmap reads it, and projects the laser's points to the pixels where ladarreg does."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from ladarreg_core.camera import Camera
from ladarreg_core.errors import Cancelled, ExportError
from ladarreg_core.export.output_frame import FrameName
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.export.targets import reconstruction
from ladarreg_core.export.targets.pipeline import export_to
from ladarreg_core.formats.cameras.camera_file import read_cameras, read_stated_pose
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import Rigid
from testing.scenes.small_registration import POSE
from tests.unit.export.camera_cases import CAMERAS, TILTED, WORLD, handed_over, photograph, scanner_points, world_points

MODELS = {
    "0 terms": "PINHOLE",
    "4 terms": "OPENCV",
    "5 terms": "FULL_OPENCV",
    "8 terms": "FULL_OPENCV",
    "12 terms": "PINHOLE",
    "fisheye": "OPENCV_FISHEYE",
    "equirectangular": "EQUIRECTANGULAR",
}


def one_form(folder: Path, ending: str, to: Path) -> pycolmap.Reconstruction:
    """Return what pycolmap reads of the binary, or of the text files alone."""
    to.mkdir()
    for path in folder.glob(f"*{ending}"):
        shutil.copy(path, to)
    return pycolmap.Reconstruction(to)


def largest(error: np.ndarray) -> float:
    return float(np.hypot(*error.T).max())


@pytest.mark.parametrize(
    ("case", "frame"), [*((case, "scanner") for case in MODELS), ("5 terms", "world"), ("fisheye", "world")]
)
def test_pycolmap_projects_the_points_where_they_are(tmp_path: Path, case: str, frame: FrameName) -> None:
    handed = handed_over(photograph(CAMERAS[case], "a"), photograph(CAMERAS["0 terms"], "b", pose=POSE), frame=frame)
    export_to(tmp_path / "out", handed, ["colmap"])
    folder = tmp_path / "out" / "colmap"
    camera = CAMERAS[case]
    if isinstance(camera, Camera) and case == "12 terms":
        camera = camera.without_distortion()
    points, written = scanner_points(handed), world_points(handed)
    ours = camera.project(TILTED @ points)
    seen = camera.contains(ours)
    for ending in (".bin", ".txt"):
        found = one_form(folder / "sparse" / "0", ending, tmp_path / ending[1:])
        image = found.find_image_with_name("a.png")
        assert image.camera.model.name == MODELS[case]
        assert (image.camera.width, image.camera.height) == camera.size
        pose = image.cam_from_world().matrix()

        def error(matrix: np.ndarray, shift: float, of: pycolmap.Camera = image.camera) -> float:
            """Return the largest distance of pycolmap's pixels from ours, of the points in the photograph."""
            uv = of.img_from_cam(written @ matrix[:, :3].T + matrix[:, 3]) - shift
            assert seen.sum() > 200
            return largest(np.nan_to_num(uv[seen], nan=1e9) - ours[seen])

        assert error(pose, 0.5) < 1e-6
        assert error(pose, 0.0) > 0.4
        assert error(np.column_stack([pose[:, :3].T, pose[:, 3]]), 0.5) > 5

        # Its points are the laser's, and their tracks lead to pixels where pycolmap sees them.
        assert found.num_points3D() > 300
        xyz = np.array([point.xyz for point in found.points3D.values()])
        nearest = np.abs(xyz[:, None] - written).sum(axis=-1).min(axis=1)
        assert nearest.max() < 1e-9
        assert max(point.track.length() for point in found.points3D.values()) == 2
        assert min(point.track.length() for point in found.points3D.values()) >= 1
        for each in found.images.values():
            for index, observed in enumerate(each.points2D[:50]):
                point = found.points3D[observed.point3D_id]
                uv = each.project_point(point.xyz)
                assert uv is not None
                assert np.abs(uv - observed.xy).max() < 1e-6
                assert (each.image_id, index) in [(e.image_id, e.point2D_idx) for e in point.track.elements]

    # The colours are those of the pixels, in the pictures of which the cameras are.
    pictures = {name: cv2.imread(str(folder / "images" / name))[..., ::-1] for name in ("a.png", "b.png")}
    assert pictures["a.png"].shape[1::-1] == camera.size
    single = [point for point in found.points3D.values() if point.track.length() == 1]
    off = []
    for point in single or found.points3D.values():
        seen_in = found.images[point.track.elements[0].image_id]
        u, v = np.rint(seen_in.points2D[point.track.elements[0].point2D_idx].xy - 0.5).astype(int)
        off.append(np.abs(pictures[seen_in.name][v, u].astype(int) - point.color).max())
    if single:
        assert np.median(off) <= 4
    offset = folder / "offset.json"
    assert offset.exists() == (frame == "world")
    if frame == "world":
        centre = found.find_image_with_name("a.png").projection_center() + json.loads(offset.read_text())["offset_m"]
        assert np.abs(centre - (WORLD @ TILTED.centre)).max() < 1e-6


@pytest.mark.parametrize("case", ["4 terms", "8 terms", "12 terms", "fisheye"])
def test_the_undistorted_pictures_show_what_the_points_are(tmp_path: Path, case: str) -> None:
    handed = handed_over(photograph(CAMERAS[case], "a"))
    export_to(tmp_path / "out", handed, ["colmap"])
    folder = tmp_path / "out" / "colmap" / "undistorted"
    found = pycolmap.Reconstruction(folder / "sparse")
    image = found.find_image_with_name("a.png")
    assert image.camera.model.name == "PINHOLE"
    shown = cv2.imread(str(folder / "images" / "a.png"))[..., ::-1].astype(np.float32)
    assert shown.shape[1::-1] == (image.camera.width, image.camera.height)
    points = np.array([point.xyz for point in found.points3D.values()])
    true = CAMERAS[case].project(TILTED @ points)  # red and green of the photograph state its pixels
    factor = 250 / max(CAMERAS[case].size)

    def error(shift: float) -> float:
        uv = image.camera.img_from_cam(TILTED @ points) - 0.5 + shift
        drawn = cv2.remap(shown, *uv.astype(np.float32).T.reshape(2, -1, 1), cv2.INTER_LINEAR)[:, 0, :2] / factor
        return float(np.median(np.abs(drawn - true).max(axis=1)))

    assert error(0.0) < 0.4  # a level is half a pixel
    assert error(2.0) > 1
    plain = handed_over(photograph(CAMERAS["0 terms"], "a"))
    export_to(tmp_path / "plain", plain, ["colmap"])
    assert not (tmp_path / "plain" / "colmap" / "undistorted").exists()


def test_ladarreg_reads_its_own_export(tmp_path: Path) -> None:
    cases = ["0 terms", "4 terms", "8 terms", "fisheye", "equirectangular"]
    handed = handed_over(*(photograph(CAMERAS[case], f"p{k}") for k, case in enumerate(cases)), frame="world")
    export_to(tmp_path / "out", handed, ["colmap"])
    for name in ("cameras.bin", "cameras.txt"):
        file = tmp_path / "out" / "colmap" / "sparse" / "0" / name
        for each, case in zip(read_cameras(file), cases, strict=True):
            ours, read = CAMERAS[case].as_fields(), each.camera.as_fields()
            assert ours.keys() == read.keys()
            assert all(np.allclose(ours[key], read[key]) for key in ours if key != "model")
        pose = read_stated_pose(file, "p1.png")
        assert pose is not None
        true = handed.written_from_camera(handed.photos[1]).inverse
        assert pose.distance_to(true) < 1e-8
        assert pose.angle_to(true) < 1e-9


def test_the_photographs_file_is_copied_if_everyone_reads_its_pixels(tmp_path: Path) -> None:
    one = photograph(CAMERAS["0 terms"], "a")
    pixels = one.photo.pixels
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels).save(tmp_path / "plain.png", compress_level=1)
    Image.fromarray(np.rot90(pixels)).save(tmp_path / "turned.png", exif=exif)
    Image.fromarray(pixels[..., 0]).save(tmp_path / "other.png")
    Image.fromarray(pixels).save(tmp_path / "lossy.jpg", quality=80)
    for name, copied in (("plain.png", True), ("turned.png", False), ("other.png", False), ("lossy.jpg", False)):
        handed = handed_over(replace(one, file=tmp_path / name))
        export_to(tmp_path / "out", handed, ["colmap"], force=True)
        picture = tmp_path / "out" / "colmap" / "images" / "a.png"
        assert (picture.read_bytes() == (tmp_path / name).read_bytes()) == copied
        with Image.open(picture) as shown:
            assert np.array_equal(np.asarray(shown), pixels)
            assert shown.getexif().get(0x0112, 1) == 1
    lossy = np.asarray(Image.open(tmp_path / "lossy.jpg"))
    handed = handed_over(replace(one, file=tmp_path / "lossy.jpg", photo=replace(one.photo, pixels=lossy)))
    export_to(tmp_path / "out", handed, ["colmap"], force=True)
    copy = tmp_path / "out" / "colmap" / "images" / "a.jpg"
    assert copy.read_bytes() == (tmp_path / "lossy.jpg").read_bytes()
    assert "a.jpg" in (tmp_path / "out" / "colmap" / "sparse" / "0" / "images.txt").read_text("utf-8")


def test_points_are_thinned_evenly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reconstruction, "MAX_POINTS", 120)
    handed = handed_over(photograph(CAMERAS["4 terms"], "a"), photograph(CAMERAS["fisheye"], "b", pose=POSE))
    export_to(tmp_path / "out", handed, ["colmap"])
    found = pycolmap.Reconstruction(tmp_path / "out" / "colmap" / "sparse" / "0")
    assert 60 <= found.num_points3D() <= 120
    uv = np.array([point.xy for point in found.find_image_with_name("a.png").points2D])
    count, *_ = np.histogram2d(*uv.T, bins=(3, 3))
    assert count.min() >= 2
    assert count.max() <= 3 * count.mean()


def test_a_given_pose_is_marked_and_windows_are_refused(tmp_path: Path) -> None:
    given = handed_over(photograph(CAMERAS["0 terms"], "a", given=True))
    export_to(tmp_path / "out", given, ["colmap"])
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        text = (tmp_path / "out" / "colmap" / "sparse" / "0" / name).read_text("utf-8")
        assert "# a.given-not-verified.png: Pose: given, not verified" in text
        assert "# a.given-not-verified.png: Photograph: Größe a .jpg" in text
    found = pycolmap.Reconstruction(tmp_path / "out" / "colmap" / "sparse" / "0")  # binary
    assert [image.name for image in found.images.values()] == ["a.given-not-verified.png"]
    assert (tmp_path / "out" / "colmap" / "images" / "a.given-not-verified.png").is_file()
    with pytest.raises(ExportError, match="is a part of a panorama, and COLMAP's EQUIRECTANGULAR is the whole sphere"):
        export_to(tmp_path / "new", handed_over(photograph(CAMERAS["window"], "a")), ["colmap"])
    assert not (tmp_path / "new").exists()


def test_a_cancelled_export_leaves_nothing(tmp_path: Path) -> None:
    handed: RegisteredScan = handed_over(photograph(CAMERAS["0 terms"], "a"))

    def cancel(progress: Progress) -> None:
        if "reconstruction" in progress.label:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        export_to(tmp_path / "out", handed, ["colmap"], report=cancel)
    assert not list(tmp_path.iterdir())


def test_a_photograph_that_sees_nothing_has_no_points(tmp_path: Path) -> None:
    away = Rigid(np.diag([-1.0, 1.0, -1.0]) @ POSE.rotation, np.zeros(3))
    handed = handed_over(photograph(CAMERAS["0 terms"], "a", pose=away))
    export_to(tmp_path / "out", handed, ["colmap"])
    for ending in (".bin", ".txt"):
        found = one_form(tmp_path / "out" / "colmap" / "sparse" / "0", ending, tmp_path / ending[1:])
        assert (found.num_images(), found.num_points3D()) == (1, 0)
