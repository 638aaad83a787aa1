"""Export of the textured model as binary glTF 2.0."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ExportError
from ladarreg_core.export.layered_scan import LayerPicture
from ladarreg_core.export.models.glb_content import GlbContent
from ladarreg_core.export.models.viser_colors import VISER_BASE_COLOR, texture_for_viewer
from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.export.pictures.texture_image import TextureImage, image_of, texture_image
from ladarreg_core.foundations.arrays import ByteArray, read_only
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.storage.atomic_write import write_chunks
from ladarreg_core.surface.mesh.grid_mesh import Mesh
from ladarreg_core.surface.texture.photo_model import PhotoModel

# glTF is Y up, and viewers start by looking along -Z: the scanner's X goes there, its Y to -X, its Z to Y.
_GLTF_FROM_SCANNER_XYZW = [-0.5, 0.5, 0.5, 0.5]
_GLTF_FROM_WORLD_XYZW = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # X stays, Y goes to -Z, Z goes to Y
SCANNER_FRAME = OutputFrame()
_LONGEST_LAYER_PX = 4096
_ROOT_NAME = "scanner frame: X forward, Y left, Z up, metres"
_NO_SURFACE = "the scan has no surface: no three neighbouring cells are connected; no model is written"


@dataclass(frozen=True, slots=True, eq=False)
class PlacedModel:
    """The textured model of one scan among several in one file, with pictures of its grid."""

    model: PhotoModel
    """The model; with `grid_uv` if there are pictures."""
    frame: OutputFrame = SCANNER_FRAME
    """The frame of the file, as seen from this scanner."""
    pictures: Mapping[str, LayerPicture] = field(default_factory=dict)
    """Layers, by the names of their variants, the same for all models of a file."""


def write_model_glb(
    path: str | Path,
    model: PhotoModel,
    *,
    frame: OutputFrame = SCANNER_FRAME,
    names: Sequence[str] = (),
    mark: str = "",
    report: Report | None = None,
) -> None:
    """Write a model as GLB: one mesh in metres, a primitive with an unlit material for every part, with normals.

    Vertices are in the scanner frame (X forward, Y left, Z up), or in the world's less the offset that the extras of
    the root node state; that node rotates them into glTF's frame, which is Y up.

    Args:
        path: the file.
        model: the model.
        frame: the frame of the vertices.
        names: names of the photographs, for the materials.
        mark: what the file must say of a pose that was not verified, in the extras of `asset` and of the root node.
        report: receives the progress; may raise `Cancelled`.

    Raises:
        ExportError: if the model has no triangles, would exceed 4 GB, or the file cannot be written.
    """
    write_layered_glb(path, [PlacedModel(model, frame)], names=names, mark=mark, report=report)


def write_layered_glb(
    path: str | Path,
    models: Sequence[PlacedModel],
    *,
    names: Sequence[str] = (),
    fused: str = "Photographs",
    mark: str = "",
    report: Report | None = None,
) -> None:
    """Write models of several scans as one GLB, with layers as the variants of its materials.

    The materials of a viewer without KHR_materials_variants, and of the first variant, are the photographs; those of
    the other variants are pictures of the scans' grids, by the second texture coordinates. Other arguments are those of
    `write_model_glb`.

    Args:
        path: the file.
        models: the models, in one frame.
        names: of the photographs.
        fused: name of the first variant.
        mark: as there.
        report: as there.

    Raises:
        ExportError: as `write_model_glb`.
    """
    count = sum(len(one.model.parts) for one in models)
    if not count:
        raise ExportError(_NO_SURFACE)

    def say(done: int, what: str) -> None:
        if report is not None:
            report(Progress(done, 2 * count, what))

    content = GlbContent()
    primitives: list[dict[str, Any]] = []
    for one in models:
        layers = [content.material(name, _layer_image(picture), second_uv=True)
                  for name, picture in one.pictures.items() if one.model.parts]  # fmt: skip
        rotation = one.frame.world_from_scanner.rotation
        for part in one.model.parts:
            say(len(primitives), "model: textures")
            vertices = one.frame.place(part.vertices)
            normals = part.normals
            if one.frame.name != "scanner":
                normals = _unit(part.normals.astype(np.float64) @ rotation.T)
            name = "laser intensity" if part.photo is None else _name_of(names, part.photo)
            material = content.material(name, image_of(part.tile))
            primitives.append(content.primitive(
                vertices, part.uv, part.faces, material, normals=normals,
                second_uv=part.grid_uv if layers else None, variants=[material, *layers] if layers else (),
            ))  # fmt: skip
    frame, pictures = models[0].frame, models[0].pictures
    node: dict[str, Any] = {"name": _ROOT_NAME, "rotation": _GLTF_FROM_SCANNER_XYZW, "extras": frame.as_dict()}
    if frame.name == "world":
        node |= {"name": frame.sentence, "rotation": _GLTF_FROM_WORLD_XYZW}
    if mark:
        node["extras"]["pose"] = mark
    extras = {"texture_error_px": round(max(one.model.uv_error_px for one in models), 3)}
    if tolerance_m := max(one.model.tolerance_m for one in models):
        extras["reduced_to_error_m"] = tolerance_m
    variants = [fused, *pictures] if pictures else []
    chunks = content.chunks(node, primitives, extras=extras, mark=mark, variants=variants)

    def reported() -> Iterator[bytes | memoryview]:
        written, whole = 0, max(content.size, 1)
        for chunk in chunks:
            say(count + int(count * min(written / whole, 1)), "model: writing")
            yield chunk
            written += len(chunk)

    write_chunks(path, reported())


def _layer_image(picture: LayerPicture) -> TextureImage:
    """Return a layer as an image file; a map keeps its colours, a picture of photographs is JPEG."""
    pixels = picture.draw()
    longest = max(pixels.shape[:2])
    if longest > _LONGEST_LAYER_PX:
        size = [max(1, round(n * _LONGEST_LAYER_PX / longest)) for n in pixels.shape[1::-1]]
        way = cv2.INTER_NEAREST if picture.is_map else cv2.INTER_AREA
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=way), np.uint8)
    return texture_image(pixels, lossless=picture.is_map)


def glb_bytes(mesh: Mesh, picture: ByteArray, *, for_viser: bool = False) -> bytes:
    """Return a mesh with a picture on the scan's grid as GLB.

    Args:
        mesh: the mesh.
        picture: texture over the whole scan grid, (h, w, 3) uint8 RGB of any size.
        for_viser: target viser's scene, which uses the scanner frame and tone mapping: no root rotation, and a texture
            that has the true colours after tone mapping.

    Raises:
        ShapeError: if the texture is not an RGB image.
        ExportError: if the mesh has no faces.
    """
    if not len(mesh.faces):
        raise ExportError(_NO_SURFACE)
    pixels = read_only(picture, np.uint8, (None, None, 3), "the model's texture")
    content = GlbContent()
    shown = texture_for_viewer(pixels) if for_viser else pixels
    material = content.material(
        "photo on scan", texture_image(shown, lossless=True), base=VISER_BASE_COLOR if for_viser else 1.0
    )
    primitive = content.primitive(mesh.vertices, mesh.uv, mesh.faces, material)
    node: dict[str, Any] = {"name": _ROOT_NAME}
    if not for_viser:
        node["rotation"] = _GLTF_FROM_SCANNER_XYZW
    return b"".join(content.chunks(node, [primitive]))


def _name_of(names: Sequence[str], photo: int) -> str:
    return names[photo] if photo < len(names) else f"photograph {photo + 1}"


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))
