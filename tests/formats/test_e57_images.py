"""Several scans in an E57 file, and its images: cameras, poses and links, written with the raw nodes of libe57."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera
from ladarreg_core.errors import FormatError, OptionError
from ladarreg_core.formats import describe, extract_images, read_scan
from ladarreg_core.formats.cameras.camera_file import read_camera
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.formats.e57_images import embedded_images
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from testing.files.small_scans import e57_fields, make_scan

FACE_PX = 64
STATIONS = (Rigid.from_rotvec([0, 0, 0.5], (100.0, 200.0, 3.0)), Rigid.from_rotvec([0, 0, -1.1], (104.0, 203.0, 3.5)))
"""Where two scanners stand in the world."""
PANORAMA = Rigid.from_rotvec([0.02, -0.03, 0.8], (100.1, 200.2, 3.3))
"""The pose of a spherical image in the world: X towards its middle, Z up."""


def write_e57(
    path: Path, images: list[dict[str, Any]], *, color_only: bool = False, scans: list[Scan] | None = None
) -> Path:
    """A file of two scans, or of the given ones, with the given images."""
    pye57 = pytest.importorskip("pye57")
    from pye57 import libe57

    with pye57.E57(str(path), mode="w") as file:
        f = file.image_file
        for number, (scan, station) in enumerate(
            zip(scans or [make_scan(20, 30), make_scan(21, 30)], STATIONS, strict=False)
        ):
            fields = e57_fields(scan, color=color_only)
            if color_only:
                del fields["intensity"]
            file.write_scan_raw(
                fields, name=f"station {number}", rotation=quaternion(station), translation=station.translation
            )
        guids = [file.root["data3D"][k]["guid"].value() for k in range(file.scan_count)]
        for number, image in enumerate(images):
            node, shape = libe57.StructureNode(f), libe57.StructureNode(f)
            node.set("guid", libe57.StringNode(f, f"{{image {number}}}"))
            node.set("name", libe57.StringNode(f, image["name"]))
            if "scan" in image:
                node.set("associatedData3DGuid", libe57.StringNode(f, guids[image["scan"]]))
            data = image["data"] if "data" in image else picture(image["width"], image["height"])
            blob = libe57.BlobNode(f, len(data))
            shape.set("jpegImage", blob)
            shape.set("imageWidth", libe57.IntegerNode(f, image["width"]))
            shape.set("imageHeight", libe57.IntegerNode(f, image["height"]))
            for name, value in image.get("numbers", {}).items():
                shape.set(name, libe57.FloatNode(f, float(value)))
            node.set(f"{image['kind']}Representation", shape)
            if "pose" in image:
                pose, rotation, translation = (libe57.StructureNode(f) for _ in range(3))
                for name, value in zip("wxyz", quaternion(image["pose"]), strict=True):
                    rotation.set(name, libe57.FloatNode(f, float(value)))
                for name, value in zip("xyz", image["pose"].translation, strict=True):
                    translation.set(name, libe57.FloatNode(f, float(value)))
                pose.set("rotation", rotation)
                pose.set("translation", translation)
                node.set("pose", pose)
            file.root["images2D"].append(node)
            blob.write(data, 0, len(data))
    return path


def quaternion(pose: Rigid) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(pose.rotation).as_quat(), 1)


def picture(width: int, height: int) -> np.ndarray:
    from PIL import Image

    stream = io.BytesIO()
    Image.new("RGB", (width, height), (120, 80, 30)).save(stream, "JPEG")
    return np.frombuffer(stream.getvalue(), np.uint8).copy()


def cube_faces() -> list[dict[str, Any]]:
    """Six pinhole faces of a cube at the second station, as panoramas are written by several scanners' programs."""
    looks = {"front": (1, 0, 0), "left": (0, 1, 0), "back": (-1, 0, 0), "right": (0, -1, 0), "up": (0, 0, 1),
             "down": (0, 0, -1)}  # fmt: skip
    numbers = {"focalLength": 0.5, "pixelWidth": 1 / FACE_PX, "pixelHeight": 1 / FACE_PX,
               "principalPointX": FACE_PX / 2, "principalPointY": FACE_PX / 2}  # fmt: skip
    faces = []
    for name, forward in looks.items():
        z = -np.array(forward, float)  # E57: the camera looks along -z, y up
        y = np.array([0, 0, 1.0]) if abs(z[2]) < 0.5 else np.array([1.0, 0, 0])
        world_from_face = STATIONS[1] @ Rigid(np.stack([np.cross(y, z), y, z], axis=1), np.zeros(3))
        faces.append({"name": name, "kind": "pinhole", "width": FACE_PX, "height": FACE_PX, "numbers": numbers,
                      "pose": world_from_face, "scan": 1})  # fmt: skip
    return faces


def panorama(**numbers: float) -> dict[str, Any]:
    return {"name": "sphere", "kind": "spherical", "width": 360, "height": 180, "numbers": numbers, "pose": PANORAMA}


def test_the_faces_of_a_cube_meet_at_their_borders(tmp_path: Path) -> None:
    path = write_e57(tmp_path / "a.e57", cube_faces())
    images = {image.name.removesuffix(".jpg"): image for image in embedded_images(path, 1)}
    assert all(image.is_usable for image in images.values())

    def border(name: str, u: float, v: float) -> np.ndarray:
        """The direction of a place in a face, in the scanner's frame."""
        found = images[name]
        assert found.camera is not None
        assert found.camera_from_scanner is not None
        return found.camera_from_scanner.rotation.T @ found.camera.unproject(np.array([u, v]))

    first, last, middle = -0.5, FACE_PX - 0.5, FACE_PX / 2 - 0.5
    np.testing.assert_allclose(border("front", middle, middle), [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(border("front", first, middle), border("left", last, middle), atol=1e-9)
    np.testing.assert_allclose(border("front", last, middle), border("right", first, middle), atol=1e-9)
    np.testing.assert_allclose(border("front", middle, first), np.array([1, 0, 1]) / np.sqrt(2), atol=1e-9)
    np.testing.assert_allclose(border("up", middle, first), border("front", middle, first), atol=1e-9)
    gap = np.abs(border("up", middle, first - 0.5) - border("front", middle, first - 0.5)).max()
    assert gap > 0.01, "half a pixel off, the faces would overlap"


@pytest.mark.parametrize("numbers", [{}, {"pixelWidth": 0.0174532925, "pixelHeight": 0.0174532925}])
def test_a_spherical_image_is_a_panorama_with_its_middle_along_x(tmp_path: Path, numbers: dict[str, float]) -> None:
    path = write_e57(tmp_path / "a.e57", [panorama(**numbers)])
    (image,) = embedded_images(path, 0)
    camera, pose = image.camera, image.camera_from_scanner
    assert isinstance(camera, EquirectangularCamera)
    assert camera.is_full_turn
    assert image.is_usable
    assert pose is not None

    def seen_at(x: float, y: float, z: float) -> np.ndarray:
        in_world = PANORAMA @ np.array([x, y, z])
        return np.asarray(camera.project(pose @ (STATIONS[0].inverse @ in_world)))

    np.testing.assert_allclose(seen_at(3, 0, 0), [179.5, 89.5], atol=1e-4)
    np.testing.assert_allclose(seen_at(0, 2, 0), [89.5, 89.5], atol=1e-4)  # to the left: a quarter turn
    np.testing.assert_allclose(seen_at(1, 0, 1), [179.5, 44.5], atol=1e-4)  # up


def test_a_part_of_the_sphere_has_a_window(tmp_path: Path) -> None:
    step = np.radians(0.25)
    path = write_e57(tmp_path / "a.e57", [panorama(pixelWidth=step, pixelHeight=step)])
    (image,) = embedded_images(path)
    assert isinstance(image.camera, EquirectangularCamera)
    assert image.camera.window == pytest.approx((-45, 22.5, 45, -22.5))
    too_wide = write_e57(tmp_path / "b.e57", [panorama(pixelWidth=0.05, pixelHeight=0.05)])
    assert not embedded_images(too_wide)[0].is_usable


def test_poses_are_relative_to_the_chosen_scan(tmp_path: Path) -> None:
    images = [cube_faces()[0], panorama(), {"name": "note", "kind": "visualReference", "width": 8, "height": 6}]
    path = write_e57(tmp_path / "a.e57", images)
    for index, station in enumerate(STATIONS):
        face, sphere, note = extract_images(path, tmp_path / str(index), scan_index=index)
        assert face.pose is not None
        assert face.camera is not None
        assert sphere.pose is not None
        assert (note.pose, note.camera) == (None, None)
        ahead = station.inverse @ (STATIONS[1] @ np.array([5.0, 0, 0]))  # what the face looks at
        camera: CameraModel = read_camera(face.camera)
        assert isinstance(camera, Camera)
        np.testing.assert_allclose(camera.project(read_pose(face.pose) @ ahead), [31.5, 31.5], atol=1e-6)
    with pytest.raises(OptionError, match="no scan 2"):
        extract_images(path, tmp_path / "2", scan_index=2)


def test_the_scans_of_a_file_are_listed_from_its_header(tmp_path: Path) -> None:
    path = write_e57(tmp_path / "a.e57", [*cube_faces()[:1], panorama()])
    found = describe(path)
    assert found.returns is None, "no point is read"
    first, second = found.scans
    assert first.startswith("station 0 (`scan_index=0`): ")
    assert "grid 20 x 30, intensity, stands at 100.000, 200.000, 3.000 m" in first
    assert second.startswith("station 1 (`scan_index=1`): ")
    assert "of scan station 1" in found.images[0]
    assert "of scan" not in found.images[1]
    assert describe(path, scan_index=1).size == "21 rows x 30 columns"
    pose = read_scan(path, scan_index=1).world_from_scanner
    assert pose is not None
    np.testing.assert_allclose(pose.matrix, STATIONS[1].matrix, atol=1e-12)
    with pytest.raises(OptionError, match="no scan 2"):
        describe(path, scan_index=2)


def test_colors_alone_are_refused_or_taken_by_their_luminance(tmp_path: Path) -> None:
    path = write_e57(tmp_path / "a.e57", [], color_only=True)
    with pytest.raises(FormatError, match=r"colours but no intensity.*`intensity='luma'`"):
        read_scan(path)
    scan = read_scan(path, intensity="luma")
    assert scan.color is not None
    expected = scan.color[scan.valid] @ [0.2126, 0.7152, 0.0722]
    np.testing.assert_allclose(scan.intensity[scan.valid], expected, atol=1e-3)
    assert any("Rec. 709" in note for note in scan.notes)


def test_a_damaged_image_does_not_keep_the_others_from_being_extracted(real_data: Path, tmp_path: Path) -> None:
    """Another writer's fixture, whose pinhole and cylindrical images are zeros."""
    found = extract_images(real_data / "e57_fixtures" / "tiny_pc_and_images.e57", tmp_path)
    assert [image.picture.name for image in found] == ["00_visual.jpg", "01_spherical.png"]
    assert len(found.damaged) == 2
    assert "'pinhole' is not the PNG that the E57 declares" in found.damaged[0]
    assert found[1].camera is not None
    assert read_camera(found[1].camera).as_fields()["window"] == pytest.approx([-90, 90, 90, -90], abs=0.1)
    empty = write_e57(tmp_path / "a.e57", [{**panorama(), "data": np.zeros(900, np.uint8)}])
    with pytest.raises(FormatError, match="is not the JPEG that the E57 declares"):
        extract_images(empty, tmp_path / "none")
