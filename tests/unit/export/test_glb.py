import json
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.errors import ExportError, ShapeError
from ladarreg_core.export.glb import glb_bytes, write_glb
from ladarreg_core.export.viser_colors import VISER_BASE_COLOUR, shown_colours, texture_for_viewer
from ladarreg_core.surface.mesh import Mesh, scan_mesh


def parts(data):
    magic, version, total, json_size, json_kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, total, json_kind) == (b"glTF", 2, len(data), b"JSON")
    document = json.loads(data[20 : 20 + json_size], parse_constant=lambda word: pytest.fail(word))
    size, kind = struct.unpack_from("<I4s", data, 20 + json_size)
    assert (kind, 28 + json_size + size) == (b"BIN\0", total)
    assert json_size % 4 == 0
    assert size % 4 == 0
    return document, data[28 + json_size :]


@settings(max_examples=20)
@given(step=st.integers(1, 6), for_viser=st.booleans())
def test_the_file_keeps_the_rules_of_gltf(scan, step, for_viser):
    mesh = scan_mesh(scan, step=step)
    document, body = parts(glb_bytes(mesh, np.zeros((3, 5, 3), np.uint8), for_viser=for_viser))
    assert document["buffers"] == [{"byteLength": len(body)}]
    end = 0
    for view in document["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] >= end
        end = view["byteOffset"] + view["byteLength"]
    assert end <= len(body)
    position, uv, index = document["accessors"]
    sizes = {"VEC3": 12, "VEC2": 8, "SCALAR": 4}
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteLength"] == accessor["count"] * sizes[accessor["type"]]
    assert position["count"] == uv["count"] == len(mesh.vertices)
    offset = document["bufferViews"][0]["byteOffset"]
    vertices = np.frombuffer(body, "<f4", position["count"] * 3, offset).reshape(-1, 3)
    np.testing.assert_array_equal(vertices, mesh.vertices)
    np.testing.assert_array_equal(np.float32(position["min"]), vertices.min(axis=0))
    np.testing.assert_array_equal(np.float32(position["max"]), vertices.max(axis=0))
    faces = np.frombuffer(body, "<u4", index["count"], document["bufferViews"][2]["byteOffset"])
    np.testing.assert_array_equal(faces.reshape(-1, 3), mesh.faces)
    material = document["materials"][0]
    assert "KHR_materials_unlit" in material["extensions"]
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    factor = material["pbrMetallicRoughness"]["baseColorFactor"]
    assert factor == ([VISER_BASE_COLOUR] * 3 + [1.0] if for_viser else [1.0] * 4)


def test_another_reader_finds_vertices_uv_and_texture(tmp_path, scan, texture):
    trimesh = pytest.importorskip("trimesh")
    mesh = scan_mesh(scan)
    write_glb(tmp_path / "model.glb", mesh, texture.image)
    scene = trimesh.load(tmp_path / "model.glb")
    (read,) = scene.geometry.values()
    np.testing.assert_array_equal(read.vertices.astype(np.float32), mesh.vertices)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    uv = mesh.uv
    np.testing.assert_allclose(read.visual.uv, np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1), atol=1e-6)
    picture = np.asarray(read.visual.material.baseColorTexture.convert("RGB"))
    np.testing.assert_array_equal(picture, texture.image)
    # One root node rotates the scanner frame: its forward axis is the viewers' direction, its up is their up.
    (node,) = scene.graph.nodes_geometry
    turn = scene.graph[node][0][:3, :3]
    np.testing.assert_allclose(turn @ np.eye(3), np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]]), atol=1e-6)


def test_for_viser_the_root_is_the_scanner_frame(scan, texture):
    document, _ = parts(glb_bytes(scan_mesh(scan), texture.image, for_viser=True))
    assert not {"rotation", "matrix", "scale", "translation"} & document["nodes"][0].keys()


def test_a_texture_too_large_is_reduced(scan):
    trimesh = pytest.importorskip("trimesh")
    import io

    data = glb_bytes(scan_mesh(scan, step=4), np.full((6, 20_000, 3), 90, np.uint8))
    (read,) = trimesh.load(io.BytesIO(data), file_type="glb").geometry.values()
    assert read.visual.material.baseColorTexture.size == (8192, 2)


def test_an_empty_model_is_refused_with_a_reason():
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2)), (4, 4))
    with pytest.raises(ExportError, match="no surface"):
        glb_bytes(empty, np.zeros((4, 4, 3), np.uint8))
    one = Mesh(np.eye(3), np.array([[0, 1, 2]]), np.array([[0, 0], [0, 1], [1, 0]]), (2, 2))
    with pytest.raises(ShapeError, match="texture"):
        glb_bytes(one, np.zeros((4, 4), np.uint8))


def test_every_gray_is_shown_to_within_2_levels():
    gray = np.arange(256)[:, None].repeat(3, axis=1)
    shown = shown_colours(texture_for_viewer(gray)).astype(int)
    assert np.abs(shown - gray).max() <= 2


@given(st.tuples(*[st.integers(0, 255)] * 3))
def test_a_colour_is_shown_to_within_3_levels_wherever_the_curve_can_make_it(rgb):
    texture = texture_for_viewer(np.array([rgb]))
    error = np.abs(shown_colours(texture).astype(int) - rgb)
    inside = ((texture > 0) & (texture < 255)).all()
    # Where a channel of the texture is saturated, the colour is at or beyond the limit of the displayable range.
    assert error.max() <= 3 or not inside


def test_muted_colours_can_be_displayed():
    """Muted colours, of at most half saturation and up to 90 % bright."""
    rng = np.random.default_rng(0)
    value, saturation = rng.uniform(10, 230, 4000), rng.uniform(0, 0.5, 4000)
    weights = rng.random((4000, 3))
    weights = (weights - weights.min(1, keepdims=True)) / np.ptp(weights, axis=1, keepdims=True)
    rgb = np.rint(value[:, None] * (1 - saturation[:, None] * weights)).astype(np.uint8)
    error = np.abs(shown_colours(texture_for_viewer(rgb)).astype(int) - rgb).max(axis=1)
    assert np.quantile(error, 0.98) <= 2


def test_the_forward_curve_is_the_viewers():
    """Measured in a browser: an unlit sRGB 128 shows as 141 when nothing is done about it."""
    assert shown_colours(np.array([128, 128, 128]), base_colour=1.0).tolist() == [141, 141, 141]
