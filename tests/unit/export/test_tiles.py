"""The target `tiles`: read back from its bytes, checked against the specification of 3D Tiles 1.1."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ladarreg_core.camera import Camera, EquirectangularCamera
from ladarreg_core.errors import Cancelled
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.export.targets.model import model_of
from ladarreg_core.export.targets.pipeline import export_to
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from testing.files.gltf_checks import Glb
from testing.scenes.small_registration import sample_registration

WORLD = Rigid(rotation_from_rotvec((0.02, 0.01, 1.2)), np.array([431_234.567, 5_412_345.678, 412.3]))
Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # what viewers of 3D tiles apply to glTF
LARGEST_BYTES = 6_000_000
CAMERAS = (
    Camera(2600, 1700, 1900.0, 1890.0, 1290.0, 860.0, (0.05, -0.02, 0.001, 0.001)),
    Camera(300, 400, 330.0, 330.0, 149.5, 199.5),
)
POSES = (
    Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.1, -0.3, 0.05)),
    Rigid.from_centre(CAMERA_AXES_FROM_SCANNER @ rotation_from_rotvec((0, 0, -0.5)), (0.0, 0.3, 0.0)),
)


def uneven_room() -> Scan:
    """Return a box in front of a wall with waves, which a reduced mesh cannot draw with few triangles, and a hole."""
    geometry = AzimuthElevation(180, 260, 0.006, 0.006)
    rays = geometry.rays
    ranges = (4.0 + 0.05 * np.sin(30 * rays[..., 1]) * np.sin(30 * rays[..., 2])) / rays[..., 0]
    ranges[60:130, 100:180] = 2.5 / rays[60:130, 100:180, 0]
    ranges[10:20, 30:60] = np.nan
    return Scan(geometry, ranges, np.random.default_rng(1).random(geometry.shape) * 900 + 100)


def gradient(width: int, height: int) -> np.ndarray:
    """Return a picture whose colours state the place: red from left to right, green from top to bottom."""
    v, u = np.mgrid[:height, :width].astype(np.float32)
    return np.rint(np.stack([u / width * 250, v / height * 250, 128 + 0 * u], axis=-1)).astype(np.uint8)


def photograph(
    camera: Any, pose: Rigid, name: str, *, pixels: np.ndarray | None = None, **changes: Any
) -> RegisteredPhoto:
    result = replace(sample_registration(), camera=camera, camera_from_scanner=pose, **changes)
    shown = gradient(*camera.size) if pixels is None else pixels
    return RegisteredPhoto(name, Photo(shown, camera, name=f"Größe {name}.jpg"), result)


@pytest.fixture(scope="module")
def handed() -> RegisteredScan:
    scan = replace(uneven_room(), world_from_scanner=WORLD)
    photos = (
        photograph(CAMERAS[0], POSES[0], "large"),
        photograph(CAMERAS[1], POSES[1], "small", accepted=False, evidence="given"),
    )
    return RegisteredScan(scan, photos, frame=OutputFrame.of(scan, "world"))


@pytest.fixture(scope="module")
def folder(handed: RegisteredScan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("tiles") / "out"
    export_to(out, handed, ["tiles"])
    return out / "tiles"


@pytest.fixture(scope="module")
def tileset(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "tileset.json").read_text(encoding="utf-8"))


class Drawn:
    """A GLB as a viewer of 3D tiles draws it: in the axes of its tile."""

    def __init__(self, data: bytes) -> None:
        self.glb = Glb(data)
        document = self.glb.document
        (node,) = document["nodes"]
        turn = Z_UP_FROM_Y_UP @ Rotation.from_quat(node["rotation"]).as_matrix()
        self.parts = []
        for primitive in document["meshes"][0]["primitives"]:
            attributes = primitive["attributes"]
            points = self.glb.accessor(attributes["POSITION"]).astype(np.float64)
            name = document["materials"][primitive["material"]]["name"]
            faces = self.glb.accessor(primitive["indices"]).reshape(-1, 3)
            uv = self.glb.accessor(attributes["TEXCOORD_0"])
            self.parts.append((name, points @ turn.T, faces, uv, self.glb.image(primitive["material"])))
        self.points = np.concatenate([part[1] for part in self.parts])
        self.unturned = self.points @ Z_UP_FROM_Y_UP

    @property
    def triangles(self) -> np.ndarray:
        return np.concatenate([points[faces] for _, points, faces, _, _ in self.parts])

    @property
    def area(self) -> float:
        return area_of(self.triangles)


def area_of(triangles: np.ndarray) -> float:
    a, b, c = np.moveaxis(triangles, 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.fixture(scope="module")
def drawn(folder: Path) -> dict[str, Drawn]:
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.glb"))
    return {name: Drawn((folder / name).read_bytes()) for name in names}


def all_tiles(tile: dict[str, Any], above: tuple[dict[str, Any], ...] = ()) -> Iterator[tuple[dict[str, Any], Any]]:
    """Yield every tile with those above it."""
    yield tile, above
    for child in tile.get("children", ()):
        yield from all_tiles(child, (*above, tile))


def contains(box: list[float], points: np.ndarray) -> bool:
    """Return whether points lie in an oriented box: its centre, then its three half axes."""
    centre, axes = np.array(box[:3]), np.array(box[3:]).reshape(3, 3)
    share = (points - centre) @ axes.T / np.square(axes).sum(axis=1)
    return bool(np.abs(share).max() <= 1 + 1e-12)


def corners(box: list[float]) -> np.ndarray:
    centre, axes = np.array(box[:3]), np.array(box[3:]).reshape(3, 3)
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    return centre + signs @ axes


def check_tile(tile: dict[str, Any], folder: Path, *, root: bool) -> None:
    """Check the rules of the schemas of tiles, bounding volumes and contents."""
    assert set(tile) <= {"boundingVolume", "geometricError", "content", "children", "transform", "refine"}
    assert set(tile["boundingVolume"]) == {"box"}
    box = tile["boundingVolume"]["box"]
    assert len(box) == 12
    assert all(isinstance(value, float | int) and np.isfinite(value) for value in box)
    assert np.linalg.det(np.array(box[3:]).reshape(3, 3)) > 0
    assert isinstance(tile["geometricError"], float | int)
    assert tile["geometricError"] >= 0
    assert set(tile["content"]) == {"uri"}
    assert (folder / tile["content"]["uri"]).is_file()
    assert ("refine" in tile) == root
    assert "children" not in tile or tile["children"]
    if "transform" in tile:
        assert root
        assert len(tile["transform"]) == 16
        assert tile["transform"][3::4] == [0, 0, 0, 1]  # affine, column by column


def test_the_tileset_follows_the_schema(tileset: dict[str, Any], folder: Path) -> None:
    assert set(tileset) == {"asset", "geometricError", "root"}
    assert set(tileset["asset"]) == {"version", "extras"}
    assert tileset["asset"]["version"] == "1.1"
    assert tileset["root"]["refine"] == "REPLACE"
    assert tileset["geometricError"] > tileset["root"]["geometricError"]
    for tile, above in all_tiles(tileset["root"]):
        check_tile(tile, folder, root=not above)
        if above:
            assert tile["geometricError"] <= above[-1]["geometricError"] / 2
        if not tile.get("children"):
            assert tile["geometricError"] == 0
    used = [tile["content"]["uri"] for tile, _ in all_tiles(tileset["root"])]
    there = {path.relative_to(folder).as_posix() for path in folder.rglob("*.glb")}
    assert len(used) == len(set(used)) > 8
    assert set(used) == there
    assert max(len(above) for _, above in all_tiles(tileset["root"])) >= 1
    assert max(path.stat().st_size for path in folder.rglob("*.glb")) < LARGEST_BYTES


def test_boxes_contain_their_points_and_their_children(tileset: dict[str, Any], drawn: dict[str, Drawn]) -> None:
    for tile, above in all_tiles(tileset["root"]):
        box, points = tile["boundingVolume"]["box"], drawn[tile["content"]["uri"]].points
        for outer in (tile, *above):
            assert contains(outer["boundingVolume"]["box"], points)
        for outer in above:
            inside = corners(box) * (1 - 1e-12)
            assert contains(outer["boundingVolume"]["box"], inside)
        if not tile.get("children"):  # controls: a smaller box, and glTF's axes taken for the tile's
            smaller = [*box[:3], *(0.9 * value for value in box[3:])]
            assert not contains(smaller, points)
    root = tileset["root"]
    assert not contains(root["boundingVolume"]["box"], drawn[root["content"]["uri"]].unturned)


def test_every_level_covers_the_model(handed: RegisteredScan, tileset: dict[str, Any], drawn: dict[str, Drawn]) -> None:
    model = model_of(handed, ExportOptions())
    whole = sum(area_of(part.vertices[part.faces].astype(np.float64)) for part in model.parts)
    leaves = [tile for tile, _ in all_tiles(tileset["root"]) if not tile.get("children")]
    assert sum(len(drawn[tile["content"]["uri"]].triangles) for tile in leaves) == model.faces
    deepest = max(len(above) for _, above in all_tiles(tileset["root"]))
    for depth in range(deepest + 1):
        shown = [
            drawn[tile["content"]["uri"]]
            for tile, above in all_tiles(tileset["root"])
            if len(above) == depth or (len(above) < depth and not tile.get("children"))
        ]
        least = 0.9 if depth < deepest else 1 - 1e-6
        assert least <= sum(each.area for each in shown) / whole <= 1.05
    own = cKDTree(np.concatenate([part.vertices for part in model.parts]))
    for tile, _ in all_tiles(tileset["root"]):
        if not tile.get("children"):
            continue
        coarse = drawn[tile["content"]["uri"]]
        below = [one for one, above in all_tiles(tile) if not one.get("children") and above]
        fine = np.concatenate([drawn[one["content"]["uri"]].points for one in below])
        distance, _ = cKDTree(coarse.points).query(fine)
        assert np.quantile(distance, 0.99) <= tile["geometricError"]
        assert len(coarse.triangles) < sum(len(drawn[one["content"]["uri"]].triangles) for one in below)
        np.testing.assert_allclose(own.query(coarse.points)[0], 0, atol=1e-6)
        # Control: a quarter of the error is exceeded, so it is of the right size.
        assert np.quantile(distance, 0.99) > tile["geometricError"] / 4


def test_the_texture_of_every_tile_is_the_photograph_at_its_points(
    handed: RegisteredScan, drawn: dict[str, Drawn]
) -> None:
    seen = {one.photo.name: 0 for one in handed.photos}
    for tile in drawn.values():
        for name, points, _, uv, image in tile.parts:
            if name == "laser intensity":
                continue
            one = next(one for one in handed.photos if one.photo.name == name)
            width, height = one.camera.size
            pixels = one.camera.project(one.camera_from_scanner @ points)
            expected = (pixels + 0.5) / (width, height) * 250
            at = uv * image.shape[1::-1] - 0.5

            def error(at: np.ndarray, image: np.ndarray = image, expected: np.ndarray = expected) -> float:
                found = cv2.remap(
                    image.astype(np.float32),
                    *at.astype(np.float32).T.reshape(2, -1, 1),
                    cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REPLICATE,
                )
                return float(np.quantile(np.abs(found[:, 0, :2] - expected).max(axis=1), 0.9))

            assert error(at) < 4.0
            if min(image.shape[:2]) > 100 and len(points) > 100:  # control: upside down
                assert error(np.stack([at[:, 0], image.shape[0] - 1 - at[:, 1]], axis=-1)) > 10
                seen[name] += 1
    assert all(seen.values())


def test_the_transform_leads_to_the_survey_in_double_precision(
    handed: RegisteredScan, tileset: dict[str, Any], drawn: dict[str, Drawn]
) -> None:
    root = tileset["root"]
    matrix = np.array(root["transform"]).reshape(4, 4).T
    np.testing.assert_array_equal(matrix, WORLD.matrix)
    points = drawn[root["content"]["uri"]].points
    ours = cKDTree(handed.scan.points[handed.scan.valid])
    assert np.quantile(ours.query(points)[0], 0.9) < 0.05
    world = points @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.abs(world - (points @ WORLD.rotation.T + WORLD.translation)).max() < 1e-8
    assert "nothing is subtracted" in tileset["asset"]["extras"]["frame_is"]


def test_given_poses_are_marked_in_every_file(tileset: dict[str, Any], drawn: dict[str, Drawn]) -> None:
    assert "given, not verified" in tileset["asset"]["extras"]["poses"][0]
    assert all("given, not verified" in tile.glb.document["asset"]["extras"]["pose"] for tile in drawn.values())


def test_a_panorama_in_the_scanners_frame(tmp_path: Path) -> None:
    scan = uneven_room()
    one = photograph(EquirectangularCamera(1600, 800), POSES[0], "round")
    export_to(tmp_path / "out", RegisteredScan(scan, (one,)), ["tiles"])
    document = json.loads((tmp_path / "out" / "tiles" / "tileset.json").read_text(encoding="utf-8"))
    assert "transform" not in document["root"]
    assert "poses" not in document["asset"]["extras"]
    for tile, _ in all_tiles(document["root"]):
        data = (tmp_path / "out" / "tiles" / tile["content"]["uri"]).read_bytes()
        assert contains(tile["boundingVolume"]["box"], Drawn(data).points)


def test_a_cancelled_export_leaves_nothing(handed: RegisteredScan, tmp_path: Path) -> None:
    def cancel(progress: Progress) -> None:
        if progress.label.endswith("1/3.glb"):
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        export_to(tmp_path / "out", handed, ["tiles"], report=cancel)
    assert not list(tmp_path.iterdir())
