"""E57 files of several kinds, written with the raw nodes of libe57, and readers of their raw values."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.scan import Scan

libe57 = pytest.importorskip("pye57").libe57
COLORS = ("colorRed", "colorGreen", "colorBlue")
NORMALS = "http://www.libe57.org/E57_NOR_surface_normals.txt"
POSE = {"w": 0.8, "x": 0.0, "y": 0.0, "z": 0.6, "t": (456_789.123, 5_432_100.456, 321.5)}
"""Where the scanner stands in a survey."""


class Writer:
    """A file that is written field by field."""

    def __init__(self, path: Path) -> None:
        self.file = libe57.ImageFile(str(path), "w")
        f, root = self.file, self.file.root()
        f.extensionsAdd("", libe57.E57_V1_0_URI)
        f.extensionsAdd("nor", NORMALS)
        self.set(root, formatName="ASTM E57 3D Imaging Data File", guid="{the file}", versionMajor=1, versionMinor=0)
        self.set(root, e57LibraryVersion="another program", coordinateMetadata="EPSG:25832")
        for name in ("data3D", "images2D"):
            root.set(name, libe57.VectorNode(f, True))

    def set(self, node: Any, **values: Any) -> Any:
        """Add children by name; dictionaries become structures."""
        for name, value in values.items():
            if isinstance(value, dict):
                made = self.set(libe57.StructureNode(self.file), **value)
            elif isinstance(value, str):
                made = libe57.StringNode(self.file, value)
            elif isinstance(value, int):
                made = libe57.IntegerNode(self.file, value)
            else:
                made = libe57.FloatNode(self.file, value) if isinstance(value, float) else value
            node.set(name, made)
        return node

    def pose(self) -> dict[str, Any]:
        """The pose above as nodes."""
        x, y, z = POSE["t"]
        return {"rotation": {k: POSE[k] for k in "wxyz"}, "translation": {"x": x, "y": y, "z": z}}

    def integer(self, low: int, high: int) -> Any:
        """A field of whole numbers."""
        return libe57.IntegerNode(self.file, low, low, high)

    def scaled(self, low: int, high: int, scale: float, offset: float = 0.0) -> Any:
        """A field of scaled whole numbers."""
        return libe57.ScaledIntegerNode(self.file, low, low, high, scale, offset)

    def real(self, *, single: bool = False) -> Any:
        """A field of floating-point numbers."""
        return libe57.FloatNode(self.file, 0.0, libe57.E57_SINGLE if single else libe57.E57_DOUBLE)

    def records(self, node: Any, name: str, fields: dict[str, tuple[Any, np.ndarray]], attach: Any = None) -> None:
        """Add a compressed vector of fields (node, raw values) to a structure, which is then attached."""
        prototype = libe57.StructureNode(self.file)
        for field, (kind, _) in fields.items():
            prototype.set(field, kind)
        vector = libe57.CompressedVectorNode(self.file, prototype, libe57.VectorNode(self.file, True))
        node.set(name, vector)
        if attach is not None:
            attach()
        buffers = libe57.VectorSourceDestBuffer()
        arrays = [np.ascontiguousarray(values) for _, values in fields.values()]
        for field, values in zip(fields, arrays, strict=True):
            buffers.append(libe57.SourceDestBuffer(self.file, field, values, max(1, len(values)), True, False))
        writer = vector.writer(buffers)
        if len(arrays[0]):
            writer.write(len(arrays[0]))
        writer.close()

    def scan(self, fields: dict[str, tuple[Any, np.ndarray]], **more: Any) -> None:
        """Append a scan."""
        node = self.set(libe57.StructureNode(self.file), **more)
        self.records(node, "points", fields, lambda: self.file.root()["data3D"].append(node))

    def image(self, name: str) -> None:
        """Append a picture without a pose."""
        stream = io.BytesIO()
        Image.new("RGB", (16, 12), (200, 30, 60)).save(stream, "JPEG")
        data = np.frombuffer(stream.getvalue(), np.uint8).copy()
        blob = libe57.BlobNode(self.file, len(data))
        shape = {"jpegImage": blob, "imageWidth": 16, "imageHeight": 12}
        node = self.set(
            libe57.StructureNode(self.file), guid="{the image}", name=name, visualReferenceRepresentation=shape
        )
        self.file.root()["images2D"].append(node)
        blob.write(data, 0, len(data))

    def close(self) -> None:
        """Finish the file."""
        self.file.close()


def _cells(scan: Scan) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points in double precision, intensity, rows and columns of the returns."""
    row, column = np.nonzero(scan.valid)
    points = scan.geometry.ray_at(np.stack([row, column], axis=-1)) * scan.ranges[row, column, None].astype(np.float64)
    return points, scan.intensity[row, column], row, column


def write_cartesian(path: Path, scan: Scan) -> int:
    """Doubles with times, normals of an extension, groups of lines and invalid points; the second scan of three.

    Returns:
        the index of the scan.
    """
    w = Writer(path)
    points, intensity, row, column = _cells(scan)
    order = np.lexsort((row, column))  # column by column
    points, intensity, row, column = points[order], intensity[order], row[order], column[order]
    state = np.zeros(len(row), "q")
    state[::17] = 2
    fields = {f"cartesian{axis}": (w.real(), points[:, k]) for k, axis in enumerate("XYZ")}
    fields |= {
        "cartesianInvalidState": (w.integer(0, 2), state),
        "intensity": (w.real(single=True), intensity),
        "rowIndex": (w.integer(0, 4095), (scan.shape[0] - 1 - row).astype("q")),  # row 0 at the bottom
        "columnIndex": (w.integer(0, max(511, scan.shape[1] - 1)), column.astype("q")),
        "timeStamp": (w.real(), np.arange(len(row)) * 1e-5),
        "nor:normalX": (w.scaled(-100, 100, 0.01), (row % 201 - 100).astype("q")),
    }
    other = {
        "cartesianX": (w.real(single=True), np.array([1, np.nan, 3], "f4")),
        "intensity": (w.integer(-66, 66), np.array([-66, 0, 66])),
    }
    other |= {f"cartesian{axis}": (w.real(single=True), np.array([1, 2, 3], "f4")) for axis in "YZ"}
    w.scan(
        other, guid="{first}", name="another scan", intensityLimits={"intensityMinimum": -66, "intensityMaximum": 66}
    )
    bounds = {"rowMinimum": 0, "rowMaximum": scan.shape[0] - 1, "columnMinimum": 0, "columnMaximum": scan.shape[1] - 1}
    w.scan(
        fields, guid="{second}", name="Büro 2", description="ein Büro", pose=w.pose(), indexBounds=bounds,
        temperature=21.5, intensityLimits={"intensityMinimum": 0.0, "intensityMaximum": 1.0},
    )  # fmt: skip
    empty = {name: (w.real(), np.zeros(0)) for name in ("cartesianX", "cartesianY", "cartesianZ")}
    w.scan(empty, guid="{third}", name="empty")
    second = w.file.root()["data3D"][1]
    lines = {"startPointIndex": (w.integer(0, 9999), np.arange(5)), "pointCount": (w.integer(0, 99), np.arange(5) * 3)}
    scheme = w.set(libe57.StructureNode(w.file), groupingByLine={"idElementName": "columnIndex"})
    second.set("pointGroupingSchemes", scheme)
    w.records(second["pointGroupingSchemes"]["groupingByLine"], "groups", lines)
    w.image("Übersicht")
    w.close()
    return 1


def write_scaled(path: Path, scan: Scan) -> int:
    """Scaled whole numbers with an offset, and colours of 16 bits."""
    w = Writer(path)
    points, intensity, row, column = _cells(scan)
    raw = np.rint((points - 0.5) / 1e-6).astype("q")
    fields = {f"cartesian{axis}": (w.scaled(-(2**24), 2**24 - 1, 1e-6, 0.5), raw[:, k]) for k, axis in enumerate("XYZ")}
    fields |= {
        "intensity": (w.scaled(0, 32767, 1 / 32767), np.rint(intensity * 32767).astype("q")),
        "rowIndex": (w.integer(5, 5000), row.astype("q") + 5),
        "columnIndex": (w.integer(0, max(511, scan.shape[1] - 1)), (scan.shape[1] - 1 - column).astype("q")),
    }
    for k, name in enumerate(COLORS):
        fields[name] = (w.integer(0, 65535), (row * 257 + column * 131 + k * 9001) % 65536)
    limits = {f"{name}{end}": value for name in COLORS for end, value in (("Minimum", 0), ("Maximum", 65535))}
    bounds = {"rowMinimum": 5, "rowMaximum": scan.shape[0] + 4, "columnMinimum": 0, "columnMaximum": scan.shape[1] - 1}
    w.scan(fields, guid="{scaled}", name="scaled", pose=w.pose(), indexBounds=bounds, colorLimits=limits)
    w.close()
    return 0


def write_spherical(path: Path, scan: Scan) -> int:
    """Ranges and angles without a grid, in a random order, with floating-point colours some of which are invalid."""
    w = Writer(path)
    points, intensity, row, column = _cells(scan)
    order = np.random.default_rng(1).permutation(len(points))
    x, y, z = points[order].T
    raw = [np.sqrt(x * x + y * y + z * z), np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))]
    fields = {
        "sphericalRange": (w.real(single=True), raw[0].astype("f4")),
        "sphericalAzimuth": (w.scaled(-4_000_000, 4_000_000, 1e-6), np.rint(raw[1] / 1e-6).astype("q")),
        "sphericalElevation": (w.scaled(-4_000_000, 4_000_000, 1e-6), np.rint(raw[2] / 1e-6).astype("q")),
        "sphericalInvalidState": (w.integer(0, 2), (np.arange(len(x)) % 19 == 0).astype("q")),
        "intensity": (w.real(), intensity[order].astype("f8")),
        "isColorInvalid": (w.integer(0, 1), (np.arange(len(x)) % 3 == 0).astype("q")),
    }
    for k, name in enumerate(COLORS):
        fields[name] = (w.real(single=True), ((row[order] * 3 + column[order] + k * 40) % 256 / 255).astype("f4"))
    limits = {f"{name}{end}": value for name in COLORS for end, value in (("Minimum", 0.0), ("Maximum", 1.0))}
    w.scan(fields, guid="{spherical}", name="spherical", colorLimits=limits)
    w.close()
    return 0


def write_without_grid(path: Path, scan: Scan) -> int:
    """Single precision without a grid or limits, and constant colours, which say nothing."""
    w = Writer(path)
    points, intensity, _, _ = _cells(scan)
    fields = {f"cartesian{axis}": (w.real(single=True), points[:, k].astype("f4")) for k, axis in enumerate("XYZ")}
    fields["intensity"] = (w.integer(0, 255), np.rint(intensity * 255).astype("q"))
    fields |= {name: (w.integer(0, 0), np.zeros(len(points), "q")) for name in COLORS}
    w.scan(fields, guid="{plain}", name="plain")
    w.close()
    return 0


KINDS = {
    "cartesian": write_cartesian,
    "scaled": write_scaled,
    "spherical": write_spherical,
    "without a grid": write_without_grid,
}


def raw_values(vector: Any) -> dict[str, np.ndarray]:
    """The values of a compressed vector as they are stored: whole numbers, float32 or float64."""
    prototype, count = libe57.StructureNode(vector.prototype()), vector.childCount()
    values, buffers = {}, libe57.VectorSourceDestBuffer()
    for index in range(prototype.childCount()):
        node = prototype[index]
        code = "q"
        if isinstance(node, libe57.FloatNode):
            code = "f" if node.precision() == libe57.E57_SINGLE else "d"
        values[node.elementName()] = np.zeros(max(1, count), code)
    if count:
        for name, array in values.items():
            buffers.append(libe57.SourceDestBuffer(vector.destImageFile(), name, array, count, True, False))
        reader = vector.reader(buffers)
        assert reader.read() == count
        reader.close()
    return {name: array[:count] for name, array in values.items()}


def differences(old: Any, new: Any, path: str = "") -> list[str]:
    """What of one node another lacks or has otherwise, by its path; values of points by their bits."""
    if type(old) is not type(new):
        return [f"{path}: {type(new).__name__}"]
    if isinstance(old, (libe57.StructureNode, libe57.VectorNode)):
        found = []
        for index in range(old.childCount()):
            name = old[index].elementName()
            if not new.isDefined(name):
                found.append(f"{path}/{name}: missing")
            else:
                found += differences(old[index], new[name], f"{path}/{name}")
        return found
    if isinstance(old, libe57.CompressedVectorNode):
        before, after = raw_values(old), raw_values(new)
        kinds = differences(libe57.StructureNode(old.prototype()), libe57.StructureNode(new.prototype()), path)
        bits = [
            name for name, values in before.items() if name not in after or values.tobytes() != after[name].tobytes()
        ]
        return kinds + [f"{path}/{name}: values" for name in bits]
    if isinstance(old, libe57.BlobNode):
        same = old.read_buffer().tobytes() == new.read_buffer().tobytes()
        return [] if same else [f"{path}: bytes"]
    facts = ("rawValue", "value", "minimum", "maximum", "scale", "offset", "precision")
    return [f"{path}: {name}" for name in facts if hasattr(old, name) and getattr(old, name)() != getattr(new, name)()]
