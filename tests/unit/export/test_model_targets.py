"""The textured model as trimesh reads it: seen from the camera it is the photograph."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera, FisheyeCamera
from ladarreg_core.errors import Cancelled, ExportError
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.export.targets.pipeline import export_to
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.photo import Photo
from ladarreg_core.surface.remap import look_up
from testing.files.gltf_checks import Glb
from testing.scenes.painted_room import PaintedRoom, painted_room, paintings
from testing.scenes.small_registration import sample_registration

UTM = Rigid.from_rotvec([0.01, -0.02, 2.1], (500_123.4567, 5_412_345.6789, 102.3456))
GIVEN = "given, not verified"


@cache
def room() -> PaintedRoom:
    return painted_room(3)


def photo_of(camera: CameraModel, name: str, seed: int) -> Photo:
    """A photograph full of detail: what is on it does not matter, only where."""
    picture = paintings(seed)
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    tiled = look_up(picture, np.mod(3 * u, 1023), np.mod(3 * v, 1023))
    return Photo(np.rint(255 * np.clip(tiled, 0, 1)).astype(np.uint8), camera, name)


def registered(photo: Photo, pose: Rigid, *, given: bool = False) -> Any:
    found = replace(sample_registration(), camera_from_scanner=pose, camera=photo.camera)
    return replace(found, accepted=False, evidence="given") if given else found


@cache
def handed(*, world: bool = False, given: bool = False) -> RegisteredScan:
    """A pinhole of 5 terms and a fisheye from elsewhere, of other sizes, the first large enough for JPEG."""
    scene = room()
    scan = replace(scene.scan, world_from_scanner=UTM)
    lens = Camera(1500, 1100, 1250.0, 1255.0, 740.0, 553.0, (-0.2, 0.05, 0.001, 0.0, 0.0))
    aside = Rigid.from_centre(look_along(np.array([1.0, -0.35, 0.0])), [0.1, 0.9, 0.2])
    one = photo_of(lens, "fa\u00e7ade nord 1.jpg", 5)
    two = photo_of(FisheyeCamera(600, 600, 300.0, 300.0, 299.5, 299.5, (0.01, 0.0, 0.0, 0.0)), "two.png", 6)
    return RegisteredScan(
        scan,
        (
            RegisteredPhoto("facade-nord-1", one, registered(one, scene.camera_from_scanner)),
            RegisteredPhoto("two", two, registered(two, aside, given=given)),
        ),
        frame=OutputFrame.of(scan, "world" if world else "scanner"),
    )


def sampled(meshes: dict[str, Any], shift: float, *, flip: bool) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield the material, points within the triangles of trimesh's meshes, and their textures' colours."""
    rng = np.random.default_rng(0)
    for mesh in meshes.values():
        picture = np.asarray(
            (
                mesh.visual.material.baseColorTexture
                if hasattr(mesh.visual.material, "baseColorTexture")
                else mesh.visual.material.image
            ).convert("RGB")
        )
        weights = rng.dirichlet([1, 1, 1], len(mesh.faces))[..., None]
        points = (mesh.vertices[mesh.faces] * weights).sum(axis=1)
        uv = (np.asarray(mesh.visual.uv)[mesh.faces] * weights).sum(axis=1)
        height, width = picture.shape[:2]
        u, v = uv[:, 0] * width - 0.5 + shift, (uv[:, 1] if flip else 1 - uv[:, 1]) * height - 0.5 + shift
        color = look_up(picture, u[:, None].astype(np.float32), v[:, None].astype(np.float32))[:, 0]
        yield mesh.visual.material.name, points, color


def errors_db(meshes: dict[str, Any], of: RegisteredScan, *, shift: float = 0.0, flip: bool = False) -> list[float]:
    """Return the peak signal to noise ratio, dB, of each photograph in the model, against its pixels where the camera
    projects the model's points.
    """
    squares: dict[int, list[np.ndarray]] = {0: [], 1: []}
    back = of.frame.world_from_scanner.inverse
    for name, points, color in sampled(meshes, shift, flip=flip):
        if "laser" in name:
            continue
        index = next(k for k, one in enumerate(of.photos) if one.id in name or one.photo.name in name)
        one = of.photos[index]
        in_scanner = back @ (points + np.array(of.frame.offset_m))
        uv = one.camera.project(one.camera_from_scanner @ in_scanner).astype(np.float32)
        true = look_up(one.photo.pixels, uv[:, :1].copy(), uv[:, 1:].copy())[:, 0]
        squares[index].append(np.square(color.astype(float) - true).ravel())
    assert all(sum(map(len, found)) > 3000 for found in squares.values())
    return [float(20 * np.log10(255 / np.sqrt(np.concatenate(found).mean()))) for found in squares.values()]


def check_against_photographs(meshes: dict[str, Any], of: RegisteredScan) -> None:
    """JPEG and a third of a pixel leave over 38 dB; the controls, upside down and half a pixel off, do not."""
    true, flipped, shifted = (
        errors_db(meshes, of), errors_db(meshes, of, flip=True), errors_db(meshes, of, shift=0.5)
    )  # fmt: skip
    assert min(true) > 38
    assert max(flipped) < 20
    assert max(shifted) < 30


@pytest.mark.slow
@pytest.mark.parametrize("world", [False, True])
def test_glb_shows_the_photographs_where_the_cameras_see_them(tmp_path: Path, world: bool) -> None:
    of = handed(world=world)
    export_to(tmp_path / "out", of, ["glb"])
    glb = Glb((tmp_path / "out/glb/model.glb").read_bytes())
    assert {image["mimeType"] for image in glb.document["images"]} == {"image/jpeg", "image/png"}
    assert "extras" not in glb.document["asset"]
    meshes = trimesh.load(tmp_path / "out/glb/model.glb").geometry
    check_against_photographs(meshes, of)
    assert (tmp_path / "out/glb/offset.json").exists() == world


@pytest.mark.slow
@pytest.mark.parametrize("world", [False, True])
def test_obj_shows_the_photographs_where_the_cameras_see_them(tmp_path: Path, world: bool) -> None:
    of = handed(world=world)
    export_to(tmp_path / "out", of, ["obj", "glb"])
    folder = tmp_path / "out/obj"
    assert all(path.name.isascii() and " " not in path.name for path in folder.iterdir())
    text = (folder / "model.obj").read_text("ascii")
    assert f"# ladarreg: {of.frame.sentence}" in text
    assert "given" not in text
    meshes = trimesh.load(folder / "model.obj", process=False).geometry
    check_against_photographs(meshes, of)
    other = trimesh.load(tmp_path / "out/glb/model.glb").geometry
    faces = sum(len(mesh.faces) for mesh in meshes.values())
    assert faces == sum(len(mesh.faces) for mesh in other.values())
    mesh = next(iter(meshes.values()))
    outward = (mesh.face_normals * mesh.vertex_normals[mesh.faces[:, 0]]).sum(axis=1)
    assert np.median(outward) > 0.9  # the order of the corners agrees with the normals


def test_a_given_pose_is_marked_in_every_file(tmp_path: Path) -> None:
    export_to(tmp_path / "out", handed(given=True), ["obj", "glb"])
    for name in ("obj/model.obj", "obj/model.mtl"):
        assert f"# pose: two: {GIVEN}\n" in (tmp_path / "out" / name).read_text("ascii")
    document = Glb((tmp_path / "out/glb/model.glb").read_bytes()).document
    assert document["asset"]["extras"]["pose"] == f"two: {GIVEN}"


def test_options_whole_and_cropped(tmp_path: Path) -> None:
    sizes = {}
    for name, options in (
        ("plain", ExportOptions()), ("full", ExportOptions(full=True)), ("crop", ExportOptions(crop="photo")),
    ):  # fmt: skip
        export_to(tmp_path / name, handed(), ["glb"], options=options)
        glb = Glb((tmp_path / name / "glb/model.glb").read_bytes())
        meshes = [one["name"] for one in glb.document["materials"]]
        sizes[name] = sum(
            glb.document["accessors"][p["indices"]]["count"] for p in glb.document["meshes"][0]["primitives"]
        )
        assert ("laser intensity" in meshes) == (name != "crop")
    assert sizes["crop"] < sizes["plain"] < sizes["full"] / 3


def test_a_panorama_and_what_no_photograph_covers(tmp_path: Path) -> None:
    scene = room()
    photo = photo_of(EquirectangularCamera(1600, 800), "dome.jpg", 7)
    behind = Rigid.from_centre(look_along(np.array([-1.0, 0.1, 0.0])), [0.1, 0.2, 0.1])
    of = RegisteredScan(scene.scan, (RegisteredPhoto("dome", photo, registered(photo, behind)),))
    export_to(tmp_path / "out", of, ["glb"])
    Glb((tmp_path / "out/glb/model.glb").read_bytes())
    away = photo_of(Camera.from_focal(300, 200, 400.0), "away.png", 7)
    nothing = RegisteredScan(scene.scan, (RegisteredPhoto("away", away, registered(away, behind)),))
    with pytest.raises(ExportError, match="no photograph covers"):
        export_to(tmp_path / "none", nothing, ["glb"], options=ExportOptions(crop="photo"))
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("target", ["glb", "obj"])
def test_a_cancelled_export_leaves_nothing(tmp_path: Path, target: str) -> None:
    said: list[Progress] = []
    handed().compute_colors()  # they are kept, so that only the first export would report them
    export_to(tmp_path / "out", handed(), [target], report=said.append)
    for stop in range(1, len(said), max(1, len(said) // 6)):
        left = stop

        def cancel(progress: Progress) -> None:
            nonlocal left
            left -= 1
            if not left:
                raise Cancelled("stopped")

        with pytest.raises(Cancelled):
            export_to(tmp_path / "again", handed(), [target], report=cancel)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]
