"""New E57 files of scans that were read from other formats: every return, with its colour and its layers.

Layers are fields of the points in a namespace of our own, which programs that do not know it pass over. Fields of whole
numbers are 0 where there is nothing, those of floating-point numbers NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ladarreg_core.export.e57.colors import COLORS, INVALID, Gray, add_color_fields, color_limits
from ladarreg_core.export.e57.nodes import (
    LAYERS,
    NOTE,
    declare_note,
    layer_field,
    new_guid,
    note_of,
    number_nodes,
    plain,
    pose_node,
    software_name,
    time_node,
)
from ladarreg_core.export.e57.tree import library, record_buffers, record_writer
from ladarreg_core.export.layered_scan import LayerValues
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.best_photo import NO_PHOTO, CellColors
from ladarreg_core.surface.texture.registered_texture import Label

_CELLS_AT_ONCE = 131_072


def write_new_scan(file: Any, handed: RegisteredScan, report: Callable[[int], None]) -> str:
    """Write the tree of a file and a scan's returns into it.

    Args:
        file: the new file.
        handed: the scan, and the photographs that colour it.
        report: receives the numbers of points; may raise `Cancelled`.

    Returns:
        the GUID of the scan.
    """
    data3d = start_tree(file, note_of(handed))
    return append_scan(file, data3d, handed.scan, note_of(handed), report, colors=handed.colors)


def start_tree(file: Any, note: str) -> Any:
    """Write the tree of a new file, without any scan, and return the vector that scans are appended to."""
    e57 = library()
    file.extensionsAdd("", e57.E57_V1_0_URI)
    declare_note(file)
    root = file.root()
    root.set("formatName", e57.StringNode(file, "ASTM E57 3D Imaging Data File"))
    root.set("guid", e57.StringNode(file, new_guid()))
    root.set("versionMajor", e57.IntegerNode(file, e57.E57_FORMAT_MAJOR))
    root.set("versionMinor", e57.IntegerNode(file, e57.E57_FORMAT_MINOR))
    root.set("e57LibraryVersion", e57.StringNode(file, software_name()))
    root.set("coordinateMetadata", e57.StringNode(file, ""))
    root.set("creationDateTime", time_node(file))
    root.set(NOTE, e57.StringNode(file, note))
    data3d, images = e57.VectorNode(file, True), e57.VectorNode(file, True)
    root.set("data3D", data3d)
    root.set("images2D", images)
    return data3d


def append_scan(
    file: Any,
    data3d: Any,
    scan: Scan,
    note: str,
    report: Callable[[int], None],
    *,
    colors: CellColors | None = None,
    values: Mapping[str, LayerValues] | None = None,
) -> str:
    """Append a scan with its pose and every return to a new file.

    Args:
        file: the file.
        data3d: what `start_tree` returned.
        scan: the scan.
        note: its description.
        report: receives the numbers of points; may raise `Cancelled`.
        colors: of its cells by photographs; None: there are none.
        values: layers of its cells by their names, beside those of the colours; None: there are none.

    Returns:
        the GUID of the scan.
    """
    e57, guid = library(), new_guid()
    node = e57.StructureNode(file)
    node.set("guid", e57.StringNode(file, guid))
    node.set("name", e57.StringNode(file, plain(scan.name)))
    node.set("description", e57.StringNode(file, note))
    if scan.world_from_scanner is not None:
        node.set("pose", pose_node(file, scan.world_from_scanner))
    height, width = scan.shape
    limits = _limits(scan, report)
    node.set("cartesianBounds", number_nodes(file, limits["cartesian"]))
    node.set("intensityLimits", number_nodes(file, limits["intensity"]))
    bounds: dict[str, float] = {
        "rowMinimum": 0,
        "rowMaximum": height - 1,
        "columnMinimum": 0,
        "columnMaximum": width - 1,
    }
    bounds |= {"returnMinimum": 0, "returnMaximum": 0}
    node.set("indexBounds", number_nodes(file, bounds))
    node.set("colorLimits", color_limits(file))
    prototype = e57.StructureNode(file)
    for name in ("cartesianX", "cartesianY", "cartesianZ", "intensity"):
        prototype.set(name, e57.FloatNode(file, 0.0, e57.E57_SINGLE))
    prototype.set("rowIndex", e57.IntegerNode(file, 0, 0, height - 1))
    prototype.set("columnIndex", e57.IntegerNode(file, 0, 0, width - 1))
    if scan.color is None:
        add_color_fields(prototype, file)
    else:
        for name in COLORS:
            prototype.set(name, e57.IntegerNode(file, 0, 0, 255))
    layers = {**_layers_of(colors), **(values or {})}
    if layers:
        said = e57.StructureNode(file)
        for name, layer in layers.items():
            whole = np.issubdtype(layer.values.dtype, np.integer)
            most = int(np.iinfo(layer.values.dtype).max) if whole else 0
            kind = e57.IntegerNode(file, 0, 0, most) if whole else e57.FloatNode(file, 0.0, e57.E57_SINGLE)
            prototype.set(layer_field(name), kind)
            said.set(layer_field(name), e57.StringNode(file, plain(layer.meaning)))
        node.set(LAYERS, said)
    points = e57.CompressedVectorNode(file, prototype, e57.VectorNode(file, True))
    node.set("points", points)
    data3d.append(node)
    _write_cells(file, points, prototype, scan, colors, layers, report)
    return guid


def _layers_of(colors: CellColors | None) -> dict[str, LayerValues]:
    """Return what the colours of cells rest on, as layers; none without colours."""
    if colors is None:
        return {}
    photo = np.where(colors.photo == NO_PHOTO, 0, colors.photo + np.uint16(1)).astype(np.uint16)
    classes = ", ".join(f"{int(label)} {label.name.lower().replace('_', ' ')}" for label in Label)
    return {
        "photo_id": LayerValues(
            photo, "photograph that colours the point, from 1 as the description lists them; 0: none"
        ),
        "label": LayerValues(colors.labels, f"visibility class: {classes}"),
        "sigma_px": LayerValues(colors.sigma_px, "standard deviation of the place in that photograph, px"),
    }


def _write_cells(
    file: Any,
    points: Any,
    prototype: Any,
    scan: Scan,
    colors: CellColors | None,
    layers: Mapping[str, LayerValues],
    report: Callable[[int], None],
) -> None:
    gray = Gray(scan)
    rows_at_once = max(1, _CELLS_AT_ONCE // scan.shape[1])
    buffers = record_buffers(prototype, rows_at_once * scan.shape[1])
    with record_writer(file, points, buffers) as write:
        for first in range(0, scan.shape[0], rows_at_once):
            rows = slice(first, min(first + rows_at_once, scan.shape[0]))
            valid = scan.valid[rows]
            row, column = np.nonzero(valid)
            count = len(row)
            if not count:
                continue
            here = scan.points_at(rows, slice(None))[valid]
            shown, rgb = np.zeros(count, np.bool_), np.zeros((count, 3), np.uint8)
            if colors is not None:
                shown, rgb = (colors.photo[rows] != NO_PHOTO)[valid], colors.image[rows][valid]
            intensity = scan.intensity[rows][valid]
            if scan.color is not None:
                rgb = np.where(shown[:, None], rgb, scan.color[rows][valid])
            else:
                rgb = np.where(shown[:, None], rgb, gray.levels(intensity)[:, None])
                buffers[INVALID][:count] = ~shown
            for k, name in enumerate(("cartesianX", "cartesianY", "cartesianZ")):
                buffers[name][:count] = here[:, k]
            for k, name in enumerate(COLORS):
                buffers[name][:count] = rgb[:, k]
            buffers["intensity"][:count] = intensity
            for name, layer in layers.items():
                buffers[layer_field(name)][:count] = layer.values[rows][valid]
            buffers["rowIndex"][:count], buffers["columnIndex"][:count] = row + first, column
            write(count)
            report(count)


def _limits(scan: Scan, report: Callable[[int], None]) -> dict[str, dict[str, float]]:
    """Return the bounds of a scan's returns and of their intensity."""
    low, high = np.full(4, np.inf), np.full(4, -np.inf)
    step = max(1, _CELLS_AT_ONCE // scan.shape[1])
    for first in range(0, scan.shape[0], step):
        report(0)
        rows = slice(first, first + step)
        valid = scan.valid[rows]
        if valid.any():
            values = np.column_stack([scan.points_at(rows, slice(None))[valid], scan.intensity[rows][valid]])
            low, high = np.minimum(low, values.min(axis=0)), np.maximum(high, values.max(axis=0))
    cartesian: dict[str, float] = {}
    for k, axis in enumerate("xyz"):
        cartesian |= {f"{axis}Minimum": float(low[k]), f"{axis}Maximum": float(high[k])}
    return {
        "cartesian": cartesian,
        "intensity": {"intensityMinimum": float(low[3]), "intensityMaximum": float(high[3])},
    }
