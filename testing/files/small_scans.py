"""Small scans, and the files they are written to."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation


def make_scan(rows: int = 24, columns: int = 36, *, seed: int = 3) -> Scan:
    """A tilted wall with holes and a patterned intensity, on the two-mirror scanner's grid."""
    generator = np.random.default_rng(seed)
    geometry = AzimuthElevation(rows, columns, 0.012, 0.01, azimuth_offset_rad=0.03)
    row, column = np.mgrid[:rows, :columns]
    counts = (1000 + 9 * column + 5 * row).astype(np.uint16)
    counts[generator.random((rows, columns)) < 0.1] = 0
    ranges = np.where(counts == 0, np.nan, 1.0 + counts * 0.002)
    return Scan(geometry, ranges, (50 + 40 * ((row // 4 + column // 4) % 2) + row).astype(np.float32), name="wall")


def pcd_bytes(
    points: np.ndarray, intensity: np.ndarray | None, *, encoding: str = "binary", width: int | None = None,
    height: int = 1, viewpoint: str = "0 0 0 1 0 0 0", extra: dict[str, np.ndarray] | None = None,
    lead: str = "",
) -> bytes:  # fmt: skip
    """A PCD file of points (N, 3): x, y, z, padding of three bytes, intensity, and extra fields."""
    count = len(points)
    columns: dict[str, np.ndarray] = {axis: points[:, k].astype("<f4") for k, axis in enumerate("xyz")}
    columns["_"] = np.zeros((count, 3), "u1")
    if intensity is not None:
        columns["intensity"] = intensity.astype("<f4")
    columns |= extra or {}
    letters = {"f": "F", "u": "U", "i": "I"}
    header = lead + "\n".join(
        [
            "# .PCD v0.7 - Point Cloud Data file format",
            "VERSION 0.7",
            "FIELDS " + " ".join(columns),
            "SIZE " + " ".join(str(c.dtype.itemsize) for c in columns.values()),
            "TYPE " + " ".join(letters[c.dtype.kind] for c in columns.values()),
            "COUNT " + " ".join(str(c.shape[1] if c.ndim == 2 else 1) for c in columns.values()),
            f"WIDTH {count if width is None else width}",
            f"HEIGHT {height}",
            f"VIEWPOINT {viewpoint}",
            f"POINTS {(count if width is None else width) * height}",
            f"DATA {encoding}",
            "",
        ]
    )
    if encoding == "ascii":
        text = io.StringIO()
        table = np.concatenate([c.reshape(count, -1).astype(np.float64) for c in columns.values()], axis=1)
        np.savetxt(text, table, fmt="%.9g")
        body = text.getvalue().encode()
    elif encoding == "binary":
        record = np.dtype([(f"f{k}", c.dtype, c.shape[1:]) for k, c in enumerate(columns.values())])
        body_array = np.zeros(count, record)
        for k, column in enumerate(columns.values()):
            body_array[f"f{k}"] = column
        body = body_array.tobytes()
    else:
        plain = b"".join(np.ascontiguousarray(c).tobytes() for c in columns.values())
        packed = lzf_compress(plain)
        body = np.array([len(packed), len(plain)], "<u4").tobytes() + packed
    return header.encode() + body


def lzf_compress(data: bytes) -> bytes:
    """A simple LZF encoder: latest position of every three bytes, greedy copies, literals otherwise."""
    out, literals, at = bytearray(), bytearray(), 0
    seen: dict[bytes, int] = {}

    def flush() -> None:
        for k in range(0, len(literals), 32):
            part = literals[k : k + 32]
            out.append(len(part) - 1)
            out.extend(part)
        literals.clear()

    while at < len(data):
        key = data[at : at + 3]
        before = seen.get(key, -1)
        seen[key] = at
        if len(key) == 3 and before >= 0 and at - before <= 8192:
            length = 3
            while length < 264 and at + length < len(data) and data[before + length] == data[at + length]:
                length += 1
            flush()
            distance = at - before - 1
            code = length - 2
            out.append((min(code, 7) << 5) | distance >> 8)
            if code >= 7:
                out.append(code - 7)
            out.append(distance & 255)
            at += length
        else:
            literals.append(data[at])
            at += 1
    flush()
    return bytes(out)


def e57_file(path: Path, fields: dict[str, np.ndarray], *, rotation: Any = None, translation: Any = None) -> Path:
    """An E57 file with one scan, or with several given as a list."""
    import pytest

    pye57 = pytest.importorskip("pye57")
    with pye57.E57(str(path), mode="w") as file:
        for scan in fields if isinstance(fields, list) else [fields]:
            file.write_scan_raw(
                {k: np.ascontiguousarray(v) for k, v in scan.items()},
                name="station",
                rotation=np.array([1.0, 0, 0, 0] if rotation is None else rotation),
                translation=np.array([0.0, 0, 0] if translation is None else translation),
            )
    return path


def e57_fields(scan: Scan, *, grid: bool = True, color: bool = False) -> dict[str, np.ndarray]:
    """The point records of a scan; row 0 of the file is the BOTTOM row and cells without return are left out."""
    keep = scan.valid.ravel()
    points = scan.points.reshape(-1, 3)[keep]
    fields = {
        "cartesianX": points[:, 0].astype("f8"),
        "cartesianY": points[:, 1].astype("f8"),
        "cartesianZ": points[:, 2].astype("f8"),
        "intensity": scan.intensity.ravel()[keep].astype("f4"),
    }
    row, column = np.mgrid[: scan.shape[0], : scan.shape[1]]
    if grid:
        fields["rowIndex"] = (scan.shape[0] - 1 - row).ravel()[keep].astype("u2")
        fields["columnIndex"] = column.ravel()[keep].astype("u2")
    if color:
        for k, name in enumerate(("colorRed", "colorGreen", "colorBlue")):
            fields[name] = ((row * 3 + column * 5 + k * 40) % 256).ravel()[keep].astype("u1")
    return fields


def spinning_cloud(
    latitudes_deg: np.ndarray, columns: int, *, seed: int = 0, stagger: np.ndarray | None = None,
    jitter_deg: float = 0.0, drop: float = 0.1,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """A shuffled cloud of a spinning scanner: points (N, 3), intensity (N,), ring (N,) counted from the lowest."""
    generator = np.random.default_rng(seed)
    ring, column = (a.ravel() for a in np.mgrid[: len(latitudes_deg), :columns])
    shift = np.zeros(len(latitudes_deg)) if stagger is None else stagger
    longitude = np.radians(360 / columns * (column + 0.5 + shift[ring]))
    latitude = np.radians(latitudes_deg[ring] + generator.normal(0, jitter_deg or 1e-9, ring.size))
    distance = generator.uniform(3, 30, ring.size)
    rays = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    points = np.stack(rays, axis=-1) * distance[:, None]
    keep = generator.permutation(ring.size)[: int(ring.size * (1 - drop))]
    return points[keep], generator.uniform(0, 255, keep.size), ring[keep]


def depth_image(folder: Path, **changes: Any) -> Path:
    """A descriptor with its two images: a plane 2 m ahead, seen through a lens with distortion."""
    from PIL import Image

    camera = {"width": 40, "height": 30, "fx": 38.0, "fy": 37.0, "cx": 19.0, "cy": 15.0, "distortion": [0.1, 0, 0, 0]}
    depth = np.full((30, 40), 2000, np.uint16)
    depth[3, 5] = 0
    Image.fromarray(depth).save(folder / "depth.png")
    Image.fromarray((np.mgrid[:30, :40][1] * 500).astype(np.uint16)).save(folder / "ir.png")
    fields: dict[str, Any] = {
        "kind": "depth-image", "depth": "depth.png", "depth_unit_m": 0.001, "depth_is": "z", "intensity": "ir.png",
        "camera": camera,
    }  # fmt: skip
    path = folder / "scan.json"
    path.write_text(json.dumps({k: v for k, v in (fields | changes).items() if v is not None}))
    return path


def picture_e57(path: Path, wall: Scan) -> tuple[Path, Rigid]:
    """A scan with a pose, and a pinhole image with one: E57 cameras look along -Z, Y up."""
    import io

    import pye57
    from PIL import Image
    from pye57 import libe57

    e57_file(path, e57_fields(wall), translation=[5.0, 6.0, 7.0])
    stream = io.BytesIO()
    Image.new("RGB", (64, 48), (10, 200, 30)).save(stream, "JPEG")
    picture = np.frombuffer(stream.getvalue(), np.uint8).copy()
    world_from_image = Rigid.from_rotvec([0.4, -1.2, 0.3], (5.5, 6.25, 7.0))
    w, x, y, z = quaternion_of(world_from_image.rotation)
    with pye57.E57(str(path), mode="w") as file:
        f = file.image_file
        fields = e57_fields(wall)
        file.write_scan_raw(fields, name="s", rotation=np.array([1.0, 0, 0, 0]), translation=np.array([5.0, 6.0, 7.0]))
        node, shape = libe57.StructureNode(f), libe57.StructureNode(f)
        node.set("guid", libe57.StringNode(f, "{1}"))
        node.set("name", libe57.StringNode(f, "../front door"))
        blob = libe57.BlobNode(f, len(picture))
        shape.set("jpegImage", blob)
        for name, value in (("imageWidth", 64), ("imageHeight", 48)):
            shape.set(name, libe57.IntegerNode(f, value))
        for name, number in (("focalLength", 0.01), ("pixelWidth", 1e-4), ("pixelHeight", 2e-4),
                             ("principalPointX", 30.0), ("principalPointY", 25.0)):  # fmt: skip
            shape.set(name, libe57.FloatNode(f, number))
        node.set("pinholeRepresentation", shape)
        pose, rotation, translation = (libe57.StructureNode(f) for _ in range(3))
        for name, number in zip("wxyz", (w, x, y, z), strict=True):
            rotation.set(name, libe57.FloatNode(f, float(number)))
        for name, number in zip("xyz", world_from_image.translation, strict=True):
            translation.set(name, libe57.FloatNode(f, float(number)))
        pose.set("rotation", rotation)
        pose.set("translation", translation)
        node.set("pose", pose)
        file.root["images2D"].append(node)
        blob.write(picture, 0, len(picture))
    return path, world_from_image


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)
