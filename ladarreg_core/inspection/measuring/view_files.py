"""Rectified views as files: PNG with a world file, GeoTIFF, their errors, the frame, and sections as DXF."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ladarreg_core.errors import OptionError
from ladarreg_core.export.dxf import DxfEntity, write_dxf
from ladarreg_core.export.json import software_document, write_result
from ladarreg_core.export.targets.folder import FileJob, write_folder
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.progress import Report
from ladarreg_core.frames import Rigid
from ladarreg_core.inspection.measuring.rectified import RectifiedView
from ladarreg_core.storage.atomic_write import write_bytes

VIEW_FILE = "view.json"
"""The file that describes a view; it is written first."""
_MODEL_PIXEL_SCALE, _MODEL_TIEPOINT, _GEO_KEYS = 33550, 33922, 34735
_MODEL_TYPE, _RASTER_TYPE, _PROJECTED_CRS = 1024, 1025, 3072
_PROJECTED, _PIXEL_IS_AREA = 1, 1


def write_view(
    folder: str | Path,
    view: RectifiedView,
    *,
    lines: Sequence[FloatArray] = (),
    world_from_scanner: Rigid | None = None,
    crs: str | None = None,
    marks: Sequence[str] = (),
    inputs: Sequence[str | Path] = (),
    force: bool = False,
    report: Report | None = None,
) -> None:
    """Write a view into a new folder: `view.json`, `view.png` with `view.pgw`, `view.tif`, `sigma.tif`, `relief.tif`.

    Args:
        folder: output folder.
        view: the view.
        lines: polylines (N, 3) of a section, scanner frame, m; written as `section.dxf` if there are any.
        world_from_scanner: the frame that `view.json` and the drawing are in; None: the scanner's.
        crs: the reference system of the flat coordinates, such as EPSG:25832, which the TIFFs then state; only of a
            level plane whose axes are those of the world.
        marks: what must be said of the poses, stated in `view.json`.
        inputs: the folders of the results, which must not be replaced.
        force: replace an earlier view.
        report: receives the progress.

    Raises:
        OptionError: if a reference system is stated of another plane, or is no EPSG code.
        ExportError: if the folder exists and must not be replaced, or cannot be written.

    Source: OGC 19-008r4, GeoTIFF 1.1, for the tags; ESRI's world file, whose origin is the first pixel's centre, where
        that of the GeoTIFF is its outer corner.
    """
    code = None if crs is None else _epsg(crs)
    if code is not None and not _is_map(view, world_from_scanner):
        raise OptionError("a reference system is that of a plan in the world; of other views state none")
    world = world_from_scanner or Rigid.identity()
    jobs: list[FileJob] = [
        (VIEW_FILE, lambda path: write_result(path, _document(view, world_from_scanner, crs, marks, len(lines)))),
        ("view.png", lambda path: _write_png(path, view)),
        ("view.pgw", lambda path: write_bytes(path, _world_file(view).encode())),
        ("view.tif", lambda path: _write_tiff(path, view, _with_alpha(view), code)),
        ("sigma.tif", lambda path: _write_tiff(path, view, view.sigma_m, code)),
        ("relief.tif", lambda path: _write_tiff(path, view, view.relief_m, code)),
    ]
    if lines:
        drawn = [
            DxfEntity(world @ line[: len(line) - _closes(line)], "section", closed=_closes(line)) for line in lines
        ]
        frame = "scanner" if world_from_scanner is None else "world"
        jobs.append(("section.dxf", lambda path: write_dxf(path, drawn, comment=f"frame: {frame}")))
    write_folder(
        folder, lambda: jobs, inputs=inputs, more_names=[name for name, _ in jobs], force=force, together=True,
        report=report,
    )  # fmt: skip


def _closes(line: FloatArray) -> bool:
    return len(line) > 2 and bool((line[0] == line[-1]).all())


def _epsg(crs: str) -> int:
    authority, _, code = crs.partition(":")
    if authority.upper() != "EPSG" or not code.isdecimal() or not 1024 <= int(code) <= 32766:
        raise OptionError(f"the reference system is {crs[:40]!r}; give the code of a projected one, such as EPSG:25832")
    return int(code)


def _is_map(view: RectifiedView, world: Rigid | None) -> bool:
    """Return whether flat coordinates are X and Y of the world."""
    if world is None or view.surface.kind != "plane":
        return False
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    placed = world @ view.surface.raised(flat)
    return bool(np.abs(placed[:, :2] - flat[:, :2]).max() < 1e-6)


def _with_alpha(view: RectifiedView) -> np.ndarray[Any, Any]:
    return np.concatenate([view.image, np.where(view.known, 255, 0).astype(np.uint8)[..., None]], axis=-1)


def _write_png(path: Path, view: RectifiedView) -> None:
    encoded = cv2.imencode(".png", cv2.cvtColor(_with_alpha(view), cv2.COLOR_RGBA2BGRA))[1]
    write_bytes(path, encoded.tobytes())


def _world_file(view: RectifiedView) -> str:
    step = view.mm_per_pixel / 1000
    return "".join(f"{value:.9f}\n" for value in (step, 0.0, 0.0, -step, view.left_m, view.top_m))


def _write_tiff(path: Path, view: RectifiedView, values: np.ndarray[Any, Any], code: int | None) -> None:
    import io

    import tifffile

    step = view.mm_per_pixel / 1000
    corner = (view.left_m - step / 2, view.top_m + step / 2)
    keys = [(_RASTER_TYPE, _PIXEL_IS_AREA)]
    if code is not None:
        keys = [(_MODEL_TYPE, _PROJECTED), *keys, (_PROJECTED_CRS, code)]
    directory = [1, 1, 1, len(keys), *(number for key, value in keys for number in (key, 0, 1, value))]
    color = values.ndim == 3
    stream = io.BytesIO()
    tifffile.imwrite(
        stream, values, photometric="rgb" if color else "minisblack", compression="zlib", metadata=None,
        predictor=color, extrasamples=["unassalpha"] if color else None, software="ladarreg",
        extratags=[
            (_MODEL_PIXEL_SCALE, "d", 3, (step, step, 0.0), True),
            (_MODEL_TIEPOINT, "d", 6, (0.0, 0.0, 0.0, *corner, 0.0), True),
            (_GEO_KEYS, "H", len(directory), tuple(directory), True),
        ],
    )  # fmt: skip
    write_bytes(path, stream.getvalue())


def _document(
    view: RectifiedView, world: Rigid | None, crs: str | None, marks: Sequence[str], lines: int
) -> dict[str, Any]:
    height, width = view.known.shape
    sigma = view.sigma_m[np.isfinite(view.sigma_m)]
    step = view.mm_per_pixel / 1000
    return {
        "version": 1,
        "kind": "rectified view",
        "software": software_document(),
        "surface": view.surface.as_fields(),
        "surface_is": "in the scanner's frame, m; right and up are those of the picture",
        "world_from_scanner": None if world is None else world.matrix.tolist(),
        "crs": crs,
        "width": width,
        "height": height,
        "mm_per_pixel": view.mm_per_pixel,
        "first_pixel_centre_m": [view.left_m, view.top_m],
        "first_pixel_centre_is": "flat coordinates of the centre of the first pixel: right and up from the origin, m",
        "extent_m": [view.left_m - step / 2, view.top_m + step / 2 - height * step,
                     view.left_m - step / 2 + width * step, view.top_m + step / 2],
        "extent_is": "left, bottom, right and top of the picture's outer edge, flat coordinates",
        "photos": list(view.photos),
        "shown": float(view.known.mean()),
        "sigma_m": {"median": float(np.median(sigma)), "largest": float(sigma.max())} if len(sigma) else None,
        "sigma_is": "root mean square error of the place of what a pixel shows, in the view",
        "section_lines": lines,
        "marks": list(marks),
    }  # fmt: skip
