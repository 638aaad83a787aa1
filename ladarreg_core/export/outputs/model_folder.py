"""One coloured model of many photographs and sensors, in a folder: textured mesh, cloud, layers and provenance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.export.json import input_document, software_document, write_result
from ladarreg_core.export.layered_scan import LayeredScan
from ladarreg_core.export.outputs.model_sources import ModelSources
from ladarreg_core.export.pictures.images import layer_picture, write_png
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.export.targets.e57 import layered_e57_files
from ladarreg_core.export.targets.folder import FileJob, write_folder
from ladarreg_core.export.targets.laz import layered_laz_files
from ladarreg_core.export.targets.model import layered_glb_files
from ladarreg_core.export.targets.ply import layered_ply_files
from ladarreg_core.export.targets.potree import layered_potree_files
from ladarreg_core.export.targets.tiles import layered_tiles_files
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.progress import Report, part_of
from ladarreg_core.fusion.fused_model import FusedModel, Station, fuse_stations
from ladarreg_core.fusion.layers import Layer, Quantity, layer_pictures, layer_values, model_layers
from ladarreg_core.fusion.stations import doubled_cells, other_surfaces, relative_pose, without_cells
from ladarreg_core.storage.replacement import MODEL_FILE, OFFSET_FILE
from ladarreg_core.surface.texture.best_photo import PosedPhoto
from ladarreg_core.surface.texture.registered_texture import Label

_FUSED = 0.5  # share of the whole
_SAME_SHAPE = 0.01
_KINDS: Mapping[str, Callable[[Sequence[LayeredScan], Report | None], Sequence[FileJob]]] = {
    "glb": layered_glb_files,
    "laz": layered_laz_files,
    "ply": layered_ply_files,
    "e57": layered_e57_files,
    "potree": layered_potree_files,
    "tiles": layered_tiles_files,
}
MODEL_FORMATS = tuple(_KINDS)
"""Files of a model that may be asked for; layers are always written as pictures, too."""
USUAL_FORMATS = ("glb", "laz", "ply")
"""Those that are written unless others are asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoValues:
    """What the pixels of a sensor that looks as a photograph does are."""

    photo: str
    """Id of the photograph."""
    quantity: Quantity
    """The quantity and its unit."""
    values: FloatArray
    """(h, w) float32, of the photograph's field of view, in its own number of pixels."""
    is_photo: bool
    """Whether the photograph itself is a picture of them, and so colours nothing."""
    file: Path | None = None
    """The file that they were read from."""


@dataclass(frozen=True, slots=True, eq=False)
class WrittenModel:
    """A model as it was written."""

    models: tuple[FusedModel, ...]
    """Its scans."""
    layers: tuple[Layer, ...]
    """Its layers."""
    document: Mapping[str, Any]
    """The contents of `model.json`, without its checksum."""


def write_model(
    folder: str | Path,
    sources: ModelSources,
    *,
    formats: Sequence[str] = USUAL_FORMATS,
    values: Sequence[PhotoValues] = (),
    vignetting: bool = False,
    force: bool = False,
    report: Report | None = None,
) -> WrittenModel:
    """Fuse the photographs of sources and write the model into a new folder.

    The folder has `model.glb`, `cloud.laz` with `legend.json`, `cloud.ply`, `layers/` with a picture of each layer, and
    `model.json`; in the world also `offset.json`.

    Args:
        folder: output folder.
        sources: scans and photographs.
        formats: of `MODEL_FORMATS`.
        values: values of sensors.
        vignetting: estimate and correct vignetting, see `fuse`.
        force: replace an earlier model.
        report: receives the progress; may raise `Cancelled`, and nothing is left then.

    Raises:
        OptionError: if a format or a photograph is unknown.
        ShapeError: if values are not of their photograph's field of view.
        ExportError: if the folder must not be replaced or cannot be written.
    """
    check_formats(formats)
    written: list[WrittenModel] = []

    def jobs() -> Sequence[FileJob]:
        found = _fused(sources, values, vignetting, part_of(report, 0.0, _FUSED))
        files, layers, document = _files(sources, found, values, formats, part_of(report, _FUSED, 1.0))
        written.append(WrittenModel(tuple(found.models), tuple(layers), document))
        return files

    inputs = _inputs(sources, values)
    write_folder(folder, jobs, inputs=inputs, force=force, report=part_of(report, _FUSED, 1.0))
    return written[0]


def check_formats(formats: Sequence[str]) -> None:
    """Refuse formats that are none of a model, to be called before long work.

    Raises:
        OptionError: if one is unknown.
    """
    for name in formats:
        if name not in _KINDS:
            raise OptionError(f"{name!r:.60} is no format of a model; use one or several of {', '.join(_KINDS)}")


@dataclass(frozen=True, slots=True, eq=False)
class _Fused:
    models: list[FusedModel]
    scans: list[RegisteredScan]
    """Of the models, with all photographs, in the exposure of the model."""
    cut: list[int]
    """Returns of each scan of the sources that another one has finer."""
    quantities: dict[int, Quantity]


def _fused(sources: ModelSources, values: Sequence[PhotoValues], vignetting: bool, report: Report | None) -> _Fused:
    owners = [(n, one) for n, handed in enumerate(sources.scans) for one in handed.photos]
    ids = [one.id for _, one in owners]
    images, quantities, colorless = _values_of(owners, ids, values)
    scans = [handed.scan for handed in sources.scans]
    views = [view for handed in sources.scans for view in handed.views]
    stations = []
    for n, handed in enumerate(sources.scans):
        relative = [
            view if owner == n else relative_pose(view, _between(sources.scans[owner], handed))
            for view, (owner, _) in zip(views, owners, strict=True)
        ]
        stations.append(Station(handed.scan, relative, other_surfaces(scans, n) if len(scans) > 1 else ()))
    models = fuse_stations(stations, values=images, colorless=colorless, vignetting=vignetting, report=report)
    developed = [models[0].developed(k) for k in range(len(views))]
    doubled = doubled_cells(scans) if len(scans) > 1 else [np.zeros(scan.shape, np.bool_) for scan in scans]
    kept: list[FusedModel] = []
    registered: list[RegisteredScan] = []
    for handed, model, cells in zip(sources.scans, models, doubled, strict=True):
        part = without_cells(model, cells)
        if part is None:
            continue
        photos = [
            _registered(one, view, photo, handed)
            for (_, one), view, photo in zip(owners, part.views, developed, strict=True)
        ]
        colored = replace(handed, scan=part.scan, photos=photos)
        colored.use_colors(part.colors, [_colored_labels(part, k) for k in range(len(photos))])
        kept.append(part)
        registered.append(colored)
    return _Fused(kept, registered, [int(cells.sum()) for cells in doubled], quantities)


def _between(of: RegisteredScan, to: RegisteredScan) -> Any:
    assert of.scan.world_from_scanner is not None
    assert to.scan.world_from_scanner is not None
    return of.scan.world_from_scanner.inverse @ to.scan.world_from_scanner


def _registered(one: RegisteredPhoto, view: PosedPhoto, photo: Any, handed: RegisteredScan) -> RegisteredPhoto:
    """Return a photograph in the exposure of the model, with its pose relative to a scan."""
    uncertainty, covariance = None, view.covariance
    if isinstance(covariance, CameraUncertainty):
        uncertainty, covariance = covariance, covariance.covariance[:6, :6]
    found = replace(
        one.registration, camera_from_scanner=view.camera_from_scanner,
        covariance=one.registration.covariance if covariance is None else covariance,
        camera_uncertainty=uncertainty, world_from_scanner=handed.scan.world_from_scanner,
    )  # fmt: skip
    return replace(one, photo=photo, registration=found)


def _colored_labels(model: FusedModel, k: int) -> NDArray[np.uint8]:
    """Return the labels of a photograph as a texture; one that colours nothing is out of frame everywhere."""
    if k in model.coloring:
        return model.photo_labels(k)
    return np.where(model.scan.valid, np.uint8(Label.OUT_OF_FRAME), np.uint8(Label.NO_RETURN))


def _values_of(
    owners: Sequence[tuple[int, RegisteredPhoto]], ids: Sequence[str], values: Sequence[PhotoValues]
) -> tuple[list[FloatArray | None], dict[int, Quantity], set[int]]:
    """Return the values of photographs in their numbers of pixels, what they are, and which colour nothing."""
    images: list[FloatArray | None] = [None] * len(ids)
    quantities: dict[int, Quantity] = {}
    colorless: set[int] = set()
    for one in values:
        # By its id, or its file's name.
        found = [k for k, (_, photo) in enumerate(owners) if one.photo in _names(photo)]
        if len(found) != 1:
            raise OptionError(f"{len(found)} photos are called {one.photo!r:.60}; there are {', '.join(ids)}")
        k = found[0]
        if k in quantities:
            raise OptionError(f"the values of {ids[k]} are given twice; give each photo one quantity")
        images[k], quantities[k] = _resampled(one, owners[k][1].photo.pixels.shape[:2]), one.quantity
        if one.is_photo:
            colorless.add(k)
    return images, quantities, colorless


def _names(photo: RegisteredPhoto) -> set[str]:
    return {photo.id, photo.photo.name, *([photo.file.name] if photo.file is not None else [])}


def _resampled(one: PhotoValues, shape: tuple[int, ...]) -> FloatArray:
    """Return values in the number of pixels (h, w) of their photograph."""
    height, width = shape
    rows, columns = one.values.shape
    if abs(rows * width / (columns * height) - 1) > _SAME_SHAPE:
        raise ShapeError(
            f"the values of {one.photo} have {columns} x {rows} pixels, the photo {width} x {height}: they do not have "
            "its proportions; give values of its whole field of view"
        )
    if (rows, columns) == (height, width):
        return one.values
    way = cv2.INTER_AREA if rows > height else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(np.asarray(one.values), (width, height), interpolation=way), np.float32)


def _files(
    sources: ModelSources, found: _Fused, values: Sequence[PhotoValues], formats: Sequence[str], report: Report | None
) -> tuple[list[FileJob], list[Layer], dict[str, Any]]:
    ids = [one.id for one in found.scans[0].photos]
    layers = model_layers(found.models, ids, found.quantities)
    parts = [
        LayeredScan(handed, layer_values(layers, k), layer_pictures(layers, k)) for k, handed in enumerate(found.scans)
    ]
    pictures = _pictures(layers, found)
    written = [job for name in dict.fromkeys(formats) for job in _KINDS[name](parts, report)]
    frame = parts[0].handed.frame
    if frame.name == "world":
        written.append((OFFSET_FILE, frame.write))
    names = [MODEL_FILE, *(name for name, _ in (*written, *pictures))]
    document = _document(sources, found, layers, values, names)
    return [(MODEL_FILE, lambda path: write_result(path, document)), *written, *pictures], layers, document


def _pictures(layers: Sequence[Layer], found: _Fused) -> list[FileJob]:
    """Return the pictures of the layers, of several scans in a folder for each."""
    jobs: list[FileJob] = []
    for k, handed in enumerate(found.scans):
        place = f"layers/{handed.id}/" if len(found.scans) > 1 else "layers/"
        for layer in layers:

            def write(path: Path, layer: Layer = layer, k: int = k) -> None:
                write_png(path, layer_picture(layer.draw(k), layer.legend))

            jobs.append((f"{place}{layer.name}.png", write))
    return jobs


def _document(
    sources: ModelSources, found: _Fused, layers: Sequence[Layer], values: Sequence[PhotoValues], names: Sequence[str]
) -> dict[str, Any]:
    first, frame = found.models[0], found.scans[0].frame
    returns = np.array([int(model.scan.valid.sum()) for model in found.models])
    share = sum(model.shares * count for model, count in zip(found.models, returns, strict=True)) / returns.sum()
    moved = [sum(int(model.samples[k].moved.sum()) for model in found.models) for k in range(len(first.views))]
    seen = [sum(int(model.samples[k].colored.sum()) for model in found.models) for k in range(len(first.views))]
    return {
        "version": 1,
        "kind": "model",
        "frame": frame.as_dict(),
        "frame_is": frame.sentence,
        "scans": [
            {
                "name": handed.scan.name,
                "world_from_scanner": None
                if handed.scan.world_from_scanner is None
                else handed.scan.world_from_scanner.matrix,
                "returns": int(handed.scan.valid.sum()),
                "cut": cut,
                "used": bool(int(handed.scan.valid.sum()) > cut),
            }
            for handed, cut in zip(sources.scans, found.cut, strict=True)
        ],
        "cut_is": "returns on a surface that another scan has in finer steps; they are left out",
        "photos": [
            {
                "photo_id": k + 1,
                "id": one.id,
                "name": one.photo.name,
                "evidence": one.registration.evidence,
                "standing": one.registration.standing,
                "colors": k in first.coloring,
                "gain": first.gains.gains[k],
                "gain_sigma": first.gains.sigma[k] if np.isfinite(first.gains.sigma[k]).all() else None,
                "vignetting": first.vignetting[k] if first.vignetting[k].any() else None,
                "share": float(share[k]),
                "moved": moved[k] / max(seen[k], 1),
                "quantity": None
                if k not in found.quantities
                else {"name": found.quantities[k].name, "unit": found.quantities[k].unit},
            }
            for k, one in enumerate(found.scans[0].photos)
        ],
        "photo_id_is": "0: no photograph shows the cell",
        "gain_is": "factors on linear light (red, green, blue), of geometric mean 1; gain_sigma: their relative "
        "standard deviation; null: it shares nothing with the others, and keeps its exposure",
        "vignetting_is": "[a, b] by which the photograph was darkened, which is undone: light exp(a r^2 + b r^4) at r "
        "from its middle, 1 at its corners; null: not asked for, or not found",
        "share_is": "of the returns of all scans that the photograph colours",
        "moved_is": "share of what the photograph shows that is not what the others show there",
        "colored": float(share.sum()),
        "left_out": [{"name": name, "why": why} for name, why in sources.left_out],
        "labels": {str(label.value): label.name.lower() for label in Label},
        "layers": [
            {"name": one.name, "title": one.title, "unit": one.unit or None, "legend": one.legend.as_fields()}
            for one in layers
        ],
        "files": list(names),
        "inputs": [input_document(path) for path in _inputs(sources, values)],
        "software": software_document(),
    }


def _inputs(sources: ModelSources, values: Sequence[PhotoValues]) -> list[Path]:
    listed: list[Path | None] = []
    for handed in sources.scans:
        listed += [handed.scan_file, *handed.scan_options.get("more", ())]
        for one in handed.photos:
            listed += [one.file, one.camera_file]
    listed += [one.file for one in values]
    return list(dict.fromkeys(path for path in listed if path is not None))
