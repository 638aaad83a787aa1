"""The targets `glb` and `obj`: the textured model at the resolution of the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from weakref import WeakKeyDictionary

from ladarreg_core.errors import ExportError
from ladarreg_core.export.layered_scan import LayeredScan
from ladarreg_core.export.models.glb import PlacedModel, write_layered_glb, write_model_glb
from ladarreg_core.export.models.obj import texture_names, write_materials, write_obj, write_texture
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.foundations.progress import Report
from ladarreg_core.storage.replacement import OFFSET_FILE
from ladarreg_core.surface.mesh.reduced_mesh import MAX_FACES
from ladarreg_core.surface.texture.photo_model import ModelPhoto, PhotoModel, photo_model

_MATERIALS = "model.mtl"
_latest: WeakKeyDictionary[RegisteredScan, tuple[ExportOptions, PhotoModel]] = WeakKeyDictionary()


def model_of(handed: RegisteredScan, options: ExportOptions, report: Report | None = None) -> PhotoModel:
    """Return the textured model of an export; the latest is kept, for the targets that share it.

    Raises:
        ExportError: if it is to be cropped, and no photograph covers any triangle.
    """
    known = _latest.get(handed)
    if known is not None and known[0] == options:
        return known[1]
    handed.compute_colors(report)
    photos = [
        ModelPhoto(one.photo.pixels, one.camera, one.camera_from_scanner, labels)
        for one, labels in zip(handed.photos, handed.photo_labels, strict=True)
    ]
    model = photo_model(
        handed.scan, photos, handed.colors.photo, full=options.full, crop=options.crop == "photo", report=report
    )
    if not model.parts:
        raise ExportError(
            "no photograph covers a triangle of the model, so nothing is left of it when it is cropped; write it whole"
        )
    _latest[handed] = (options, model)
    return model


def glb_files(handed: RegisteredScan, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return `model.glb`, in the world also `offset.json`."""

    def write(path: Path) -> None:
        model = model_of(handed, options, report)
        names = [one.photo.name for one in handed.photos]
        write_model_glb(path, model, frame=handed.frame, names=names, mark=_mark(handed), report=report)

    return [("model.glb", write), *_offset(handed)]


def layered_glb_files(parts: Sequence[LayeredScan], report: Report | None) -> Sequence[FileJob]:
    """Return `model.glb` of several scans with layers as its variants, the first of them the fused colours."""
    first = parts[0].handed
    names = [one.photo.name for one in first.photos]

    def write(path: Path) -> None:
        models = []
        for part in parts:
            photos = [
                ModelPhoto(one.photo.pixels, one.camera, one.camera_from_scanner, labels)
                for one, labels in zip(part.handed.photos, part.handed.photo_labels, strict=True)
            ]
            most = MAX_FACES // len(parts)
            model = photo_model(
                part.handed.scan, photos, part.handed.colors.photo, on_grid=True, most_faces=most, report=report
            )
            models.append(PlacedModel(model, part.handed.frame, part.pictures))
        write_layered_glb(path, models, names=names, fused="Fused", mark=_mark(first), report=report)

    return [("model.glb", write)]


def obj_files(handed: RegisteredScan, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return `model.obj`, `model.mtl` and the textures, in the world also `offset.json`."""
    model = model_of(handed, options, report)
    textures = texture_names(model, [one.id for one in handed.photos])
    mark = _mark(handed)

    def write(path: Path) -> None:
        write_obj(path, model, textures, frame=handed.frame, material_file=_MATERIALS, mark=mark, report=report)

    jobs: list[FileJob] = [
        ("model.obj", write),
        (_MATERIALS, lambda path: write_materials(path, textures, mark=mark)),
    ]
    for name, part in zip(textures, model.parts, strict=True):
        jobs.append((name, lambda path, part=part: write_texture(path, part)))  # type: ignore[misc]
    return [*jobs, *_offset(handed)]


def _mark(handed: RegisteredScan) -> str:
    """Return what the files must say of poses that were not verified, or are coarse."""
    if len(handed.photos) == 1:
        return handed.photos[0].caveat
    return "; ".join(f"{one.id}: {one.caveat}" for one in handed.photos if one.caveat)


def _offset(handed: RegisteredScan) -> list[FileJob]:
    return [] if handed.frame.name == "scanner" else [(OFFSET_FILE, handed.frame.write)]
