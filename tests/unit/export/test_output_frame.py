"""Clouds and models in the world: no millimetre is lost, and a stranger's reader finds what was subtracted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.errors import OptionError
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.export.targets.folder import export_registration
from ladarreg_core.frames import Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.photo_model import ModelPhoto, photo_model
from ladarreg_core.surface.texture.registered_texture import texture_scan
from testing.scenes.small_registration import POSE, sample_registration

trimesh = pytest.importorskip("trimesh")
UTM = Rigid.from_rotvec([0.3, -0.2, 2.1], (500_123.4567, 5_412_345.6789, 102.3456))
Y_UP_FROM_Z_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


def exact(points: np.ndarray) -> np.ndarray:
    """Return points in the world, computed in extended precision."""
    rotation, translation = UTM.rotation.astype(np.longdouble), UTM.translation.astype(np.longdouble)
    return points.astype(np.longdouble) @ rotation.T + translation


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, scan: Scan, photo: Photo) -> Path:
    folder = tmp_path_factory.mktemp("export") / "out"
    in_world = replace(scan, world_from_scanner=UTM)
    export_registration(folder, sample_registration(), in_world, photo, frame="world")
    return folder


def test_no_millimetre_of_utm_coordinates_is_lost(written: Path, scan: Scan, photo: Photo) -> None:
    stated = json.loads((written / "offset.json").read_text(encoding="utf-8"))
    offset = np.array(stated["offset_m"])
    assert offset.tolist() == [500_100, 5_412_300, 100]
    assert stated["frame"] == "world"
    np.testing.assert_array_equal(np.array(stated["world_from_scanner"])[:3, 3], UTM.translation)
    models = json.loads((written / "registration.json").read_text(encoding="utf-8"))["models"]
    assert models == {"frame": "world", "offset_m": offset.tolist()}

    cloud = trimesh.load(written / "cloud.ply")
    truth = exact(scan.points[scan.valid])
    np.testing.assert_allclose(cloud.vertices + offset, truth.astype(float), rtol=0, atol=1e-4)
    header = (written / "cloud.ply").read_bytes().split(b"end_header", 1)[0].decode("ascii")
    assert "comment offset_m 500100 5412300 100\n" in header

    scene = trimesh.load(written / "model.glb")
    transform, _ = scene.graph[scene.graph.nodes_geometry[0]]
    np.testing.assert_allclose(transform[:3, :3], Y_UP_FROM_Z_UP, atol=1e-7)  # trimesh applies it where it draws
    texture = texture_scan(scan, photo, POSE)
    model = photo_model(scan, [ModelPhoto(photo.pixels, photo.camera, POSE, texture.labels)])
    for part, read in zip(model.parts, scene.geometry.values(), strict=True):
        there = exact(part.vertices).astype(float)
        np.testing.assert_allclose(np.asarray(read.vertices, float) + offset, there, rtol=0, atol=1e-4)
        np.testing.assert_allclose(read.vertex_normals, part.normals @ UTM.rotation.T, atol=1e-6)
    (node,) = glb_document(written / "model.glb")["nodes"]
    assert node["extras"] == {"frame": "world", "offset_m": offset.tolist()}

    # Control: single precision without an offset loses centimetres, and so does a forgotten offset.
    careless = truth.astype(np.float32).astype(float)
    assert np.abs(careless - truth.astype(float)).max() > 0.01
    assert np.abs(cloud.vertices - truth.astype(float)).max() > 1000


def glb_document(path: Path) -> Any:
    data = path.read_bytes()
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


def test_the_scanners_frame_is_the_default_and_has_no_offset(tmp_path: Path, scan: Scan, photo: Photo) -> None:
    export_registration(tmp_path / "out", sample_registration(), replace(scan, world_from_scanner=UTM), photo)
    assert not (tmp_path / "out" / "offset.json").exists()
    cloud = trimesh.load(tmp_path / "out" / "cloud.ply")
    np.testing.assert_array_equal(cloud.vertices.astype(np.float32), scan.points[scan.valid])


def test_a_frame_that_is_not_known_is_refused(tmp_path: Path, scan: Scan, photo: Photo) -> None:
    with pytest.raises(OptionError, match="needs the scanner's pose"):
        export_registration(tmp_path / "out", sample_registration(), scan, photo, frame="world")
    assert not (tmp_path / "out").exists()
    with pytest.raises(OptionError, match="scanner, world"):
        OutputFrame.of(scan, "moon")


def test_small_coordinates_keep_their_origin(scan: Scan) -> None:
    near = Rigid.from_rotvec([0, 0, 1], (12.0, -990.0, 3.0))
    frame = OutputFrame.of(replace(scan, world_from_scanner=near), "world")
    assert frame.offset_m == (0, 0, 0)
    points = scan.points[scan.valid]
    np.testing.assert_allclose(frame.place(points), near @ points.astype(float), atol=1e-12)


def test_results_in_the_world_can_be_replaced(written: Path, scan: Scan, photo: Photo, tmp_path: Path) -> None:
    for frame in ("world", "scanner"):
        export_registration(
            tmp_path / "out",
            sample_registration(),
            replace(scan, world_from_scanner=UTM),
            photo,
            frame=frame,
            force=True,
        )  # type: ignore[call-overload]
    assert not (tmp_path / "out" / "offset.json").exists()
