"""Export of the textured model as Wavefront OBJ, with its materials and textures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.export.output_frame import OutputFrame
from ladarreg_core.export.pictures.texture_image import extension_of, image_of
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.storage.atomic_write import write_bytes, write_chunks
from ladarreg_core.surface.mesh.model_part import ModelPart
from ladarreg_core.surface.texture.photo_model import PhotoModel

_LINES_AT_ONCE = 50_000


def write_obj(
    path: str | Path,
    model: PhotoModel,
    textures: Sequence[str],
    *,
    frame: OutputFrame,
    material_file: str,
    mark: str = "",
    report: Report | None = None,
) -> None:
    """Write the triangles of a model, in metres, one group and material a part.

    Args:
        path: the file.
        model: the model.
        textures: names of the parts' textures, as `write_texture` writes them; their stems name the materials.
        frame: the frame of the vertices; an offset stands in a comment.
        material_file: name of the file of `write_materials`.
        mark: what the file must say of a pose that was not verified.
        report: receives the progress; may raise `Cancelled`.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_chunks(path, _pieces(model, textures, frame, material_file, mark, report))


def write_materials(path: str | Path, textures: Sequence[str], *, mark: str = "") -> None:
    """Write the materials of a model (MTL): unlit, each with its texture.

    Raises:
        ExportError: if the file cannot be written.
    """
    lines = _header("materials of the model", mark)
    for name in textures:
        lines += [
            f"newmtl {Path(name).stem}",
            "Ka 1 1 1",
            "Kd 1 1 1",
            "Ks 0 0 0",
            "d 1",
            "illum 0",
            f"map_Kd {name}",
            "",
        ]
    write_bytes(path, "\n".join([*lines, ""]).encode("ascii"))


def write_texture(path: str | Path, part: ModelPart) -> None:
    """Write the texture of a part to the file of `texture_names`.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_bytes(path, image_of(part.tile).data)


def texture_names(model: PhotoModel, ids: Sequence[str]) -> list[str]:
    """Return the file names of the parts' textures, ASCII, from ids of the photographs."""
    names, counts = [], dict[str, int]()
    for part in model.parts:
        stem = "laser" if part.photo is None else f"photo-{ids[part.photo]}"
        counts[stem] = counts.get(stem, 0) + 1
        names.append(f"{stem}-{counts[stem]:02d}.{extension_of(part.tile)}")
    return names


def _header(what: str, mark: str) -> list[str]:
    return [f"# ladarreg: {what}", *([f"# pose: {mark}"] if mark else [])]


def _pieces(
    model: PhotoModel, textures: Sequence[str], frame: OutputFrame, material_file: str, mark: str, report: Report | None
) -> Iterator[bytes]:
    lines = _header(frame.sentence, mark)
    if any(frame.offset_m):
        lines.append("# offset_m " + " ".join(f"{value:.0f}" for value in frame.offset_m))
    yield "\n".join([*lines, f"mtllib {material_file}", ""]).encode("ascii")
    total, done, first = 3 * model.vertices + model.faces, 0, 1
    rotation = frame.world_from_scanner.rotation
    for part, name in zip(model.parts, textures, strict=True):
        yield f"g {Path(name).stem}\nusemtl {Path(name).stem}\n".encode("ascii")
        uv = part.uv.astype(np.float64)
        blocks: list[tuple[str, NDArray[Any]]] = [
            ("v %.5f %.5f %.5f\n", frame.place(part.vertices)),
            ("vt %.7f %.7f\n", np.stack([uv[:, 0], 1 - uv[:, 1]], axis=-1)),
            ("vn %.4f %.4f %.4f\n", part.normals.astype(np.float64) @ rotation.T),
            ("f %d/%d/%d %d/%d/%d %d/%d/%d\n", np.repeat(part.faces.astype(np.int64) + first, 3, axis=1)),
        ]
        for line, values in blocks:
            for start in range(0, len(values), _LINES_AT_ONCE):
                some = values[start : start + _LINES_AT_ONCE]
                if report is not None:
                    report(Progress(done, total, "model.obj"))
                yield (line * len(some) % tuple(some.ravel().tolist())).encode("ascii")
                done += len(some)
        first += len(part.vertices)
