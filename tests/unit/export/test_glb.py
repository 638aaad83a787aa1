import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.errors import ExportError, ShapeError
from ladarreg_core.export.models.glb import glb_bytes, write_model_glb
from ladarreg_core.export.models.viser_colors import VISER_BASE_COLOR, shown_colors, texture_for_viewer
from ladarreg_core.photo import Photo
from ladarreg_core.surface.mesh.grid_mesh import Mesh, scan_mesh
from ladarreg_core.surface.texture.photo_model import ModelPhoto, PhotoModel, photo_model
from ladarreg_core.surface.texture.registered_texture import texture_scan
from testing.files.gltf_checks import Glb
from testing.scenes.small_registration import POSE


@settings(max_examples=20)
@given(step=st.integers(1, 6), for_viser=st.booleans())
def test_a_mesh_with_a_picture_keeps_the_rules_of_gltf(scan, step, for_viser):
    mesh = scan_mesh(scan, step=step)
    glb = Glb(glb_bytes(mesh, np.zeros((3, 5, 3), np.uint8), for_viser=for_viser))
    np.testing.assert_array_equal(glb.accessor(0), mesh.vertices)
    np.testing.assert_array_equal(glb.accessor(1), mesh.uv)
    np.testing.assert_array_equal(glb.accessor(2).reshape(-1, 3), mesh.faces)
    material = glb.document["materials"][0]
    assert "KHR_materials_unlit" in material["extensions"]
    assert glb.document["extensionsUsed"] == ["KHR_materials_unlit"]
    factor = material["pbrMetallicRoughness"]["baseColorFactor"]
    assert factor == ([VISER_BASE_COLOR] * 3 + [1.0] if for_viser else [1.0] * 4)
    # In viser's scene the root is the scanner's frame.
    assert ("rotation" in glb.document["nodes"][0]) != for_viser


def model_of(scan, photo, texture):
    return photo_model(scan, [ModelPhoto(photo.pixels, photo.camera, POSE, texture.labels)])


def test_another_reader_finds_vertices_normals_uv_and_textures(tmp_path, scan, photo, texture):
    model = model_of(scan, photo, texture)
    write_model_glb(tmp_path / "model.glb", model, names=["fa\u00e7ade 1.jpg"])
    glb = Glb((tmp_path / "model.glb").read_bytes())
    assert [one["name"] for one in glb.document["materials"]] == ["fa\u00e7ade 1.jpg", "laser intensity"]
    assert glb.document["nodes"][0]["extras"] == {"frame": "scanner", "offset_m": [0.0, 0.0, 0.0]}
    scene = trimesh.load(tmp_path / "model.glb")
    for part, read in zip(model.parts, scene.geometry.values(), strict=True):
        np.testing.assert_array_equal(read.vertices.astype(np.float32), part.vertices)
        np.testing.assert_array_equal(read.faces, part.faces)
        np.testing.assert_allclose(read.vertex_normals, part.normals, atol=1e-6)
        uv = part.uv
        np.testing.assert_allclose(read.visual.uv, np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1), atol=1e-6)
        picture = np.asarray(read.visual.material.baseColorTexture.convert("RGB"))
        np.testing.assert_array_equal(picture, part.tile.pixels())
    # One root node rotates the scanner frame: its forward axis is the viewers' direction, its up is their up.
    for node in scene.graph.nodes_geometry:
        turn = scene.graph[node][0][:3, :3]
        np.testing.assert_allclose(turn @ np.eye(3), np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]]), atol=1e-6)


def test_large_textures_are_jpeg_and_the_file_is_always_the_same(tmp_path, scan, photo):
    camera = photo.camera.resized(1200, 900)
    large = Photo(np.repeat(np.repeat(photo.pixels, 10, axis=0), 10, axis=1), camera)
    model = model_of(scan, large, texture_scan(scan, large, POSE))
    for name in ("one.glb", "two.glb"):
        write_model_glb(tmp_path / name, model)
    glb = Glb((tmp_path / "one.glb").read_bytes())
    assert [image["mimeType"] for image in glb.document["images"]] == ["image/jpeg", "image/png"]
    tile = model.parts[0].tile
    difference = glb.image(0).astype(int) - large.pixels[tile.top :, tile.left :][: tile.height, : tile.width]
    assert np.sqrt(np.mean(np.square(difference))) < 2.5
    assert (tmp_path / "one.glb").read_bytes() == (tmp_path / "two.glb").read_bytes()


def test_a_given_pose_is_marked_and_the_progress_is_told(tmp_path, scan, photo, texture):
    said = []
    write_model_glb(tmp_path / "a.glb", model_of(scan, photo, texture), mark="given, not verified", report=said.append)
    document = Glb((tmp_path / "a.glb").read_bytes()).document
    assert document["asset"]["extras"] == {"pose": "given, not verified"}
    assert document["nodes"][0]["extras"]["pose"] == "given, not verified"
    assert [one.done for one in said] == sorted(one.done for one in said)
    assert max(one.done for one in said) <= said[0].total


def test_an_empty_model_is_refused_with_a_reason(tmp_path):
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2)), (4, 4))
    with pytest.raises(ExportError, match="no surface"):
        glb_bytes(empty, np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(ExportError, match="no surface"):
        write_model_glb(tmp_path / "a.glb", PhotoModel((), 0.0, 0.3))
    one = Mesh(np.eye(3), np.array([[0, 1, 2]]), np.array([[0, 0], [0, 1], [1, 0]]), (2, 2))
    with pytest.raises(ShapeError, match="texture"):
        glb_bytes(one, np.zeros((4, 4), np.uint8))


def test_every_gray_is_shown_to_within_2_levels():
    gray = np.arange(256)[:, None].repeat(3, axis=1)
    shown = shown_colors(texture_for_viewer(gray)).astype(int)
    assert np.abs(shown - gray).max() <= 2


@given(st.tuples(*[st.integers(0, 255)] * 3))
def test_a_color_is_shown_to_within_3_levels_wherever_the_curve_can_make_it(rgb):
    texture = texture_for_viewer(np.array([rgb]))
    error = np.abs(shown_colors(texture).astype(int) - rgb)
    inside = ((texture > 0) & (texture < 255)).all()
    # Where a channel of the texture is saturated, the colour is at or beyond the limit of the displayable range.
    assert error.max() <= 3 or not inside


def test_muted_colors_can_be_displayed():
    """Muted colours, of at most half saturation and up to 90 % bright."""
    rng = np.random.default_rng(0)
    value, saturation = rng.uniform(10, 230, 4000), rng.uniform(0, 0.5, 4000)
    weights = rng.random((4000, 3))
    weights = (weights - weights.min(1, keepdims=True)) / np.ptp(weights, axis=1, keepdims=True)
    rgb = np.rint(value[:, None] * (1 - saturation[:, None] * weights)).astype(np.uint8)
    error = np.abs(shown_colors(texture_for_viewer(rgb)).astype(int) - rgb).max(axis=1)
    assert np.quantile(error, 0.98) <= 2


def test_the_forward_curve_is_the_viewers():
    """Measured in a browser: an unlit sRGB 128 shows as 141 when nothing is done about it."""
    assert shown_colors(np.array([128, 128, 128]), base_color=1.0).tolist() == [141, 141, 141]
