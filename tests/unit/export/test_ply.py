import numpy as np
import pytest

from ladarreg_core.errors import ExportError, ShapeError
from ladarreg_core.export.clouds.ply import ply_bytes, write_ply
from ladarreg_core.surface.texture.registered_texture import RegisteredTexture, model_picture


def test_another_reader_finds_every_return(tmp_path, scan, texture):
    trimesh = pytest.importorskip("trimesh")
    write_ply(tmp_path / "cloud.ply", scan, texture)
    cloud = trimesh.load(tmp_path / "cloud.ply")
    valid = scan.valid
    np.testing.assert_array_equal(cloud.vertices.astype(np.float32), scan.points[valid])
    np.testing.assert_array_equal(cloud.colors[:, :3], model_picture(scan, texture)[valid])
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(raw["intensity"].ravel(), scan.intensity[valid])
    np.testing.assert_array_equal(raw["label"].ravel(), texture.labels[valid])


def test_the_header_names_frame_and_unit(scan, texture):
    data = ply_bytes(scan, texture)
    header, body = data.split(b"end_header\n", 1)
    text = header.decode("ascii")
    assert text.startswith("ply\nformat binary_little_endian 1.0\n")
    assert "scanner frame, X forward, Y left, Z up; metres" in text
    assert "2 occluded" in text
    assert len(body) == np.count_nonzero(scan.valid) * (12 + 3 + 4 + 1)


def test_hostile_input_is_named(tmp_path, scan, texture):
    small = RegisteredTexture(texture.image[:5], texture.labels[:5])
    with pytest.raises(ShapeError, match="agree"):
        ply_bytes(scan, small)
    with pytest.raises(ExportError, match="cannot write"):
        write_ply(tmp_path / "absent" / "cloud.ply", scan, texture)
