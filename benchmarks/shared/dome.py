"""Makes a dome scan of a simulated room as a terrestrial scanner would write it, with a photograph and the truth.

Run it as `python -m benchmarks.shared.dome FOLDER --cells 28`. The folder then contains `scan.e57` (one structured
scan: Cartesian coordinates in single precision, intensity, colour, row and column indices, points without return marked
invalid), `photo.png`, `camera.json` and `truth.json`. Columns are cast and written in strips, so that memory does not
grow with the scan. The file is written by pye57's raw nodes and not by the project's own code.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.formats.cameras.camera_file import write_camera
from ladarreg_core.formats.documents.pose_file import POSE_FIELD
from ladarreg_core.formats.parsing.json_file import write_json
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import ThesisParameters
from ladarreg_core.simulate.case import case_world
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.worlds.world import Viewpoint, World

SCENE = "office"
CAMERA = Camera.from_focal(2400, 1600, 1700.0)
POSE = ThesisParameters(
    Tx=0.55, Ty=0.08, Tz=0.1, alpha=np.radians(8.0), beta=np.radians(1.5), gamma=np.radians(-1.0)
).pose
TRANSLATION_M = (512_000.0, 5_410_000.0, 312.0)
"""The scanner's position in the file, as in a surveyor's grid."""
_TOP_DEG, _LOW_DEG = 89.0, -61.0
_STRIP_CELLS = 250_000
_SIGMA_M = 0.001
_SPECKLE = 0.08
_DARK = 0.004
_FULL = 2048.0

Columns = dict[str, NDArray[Any]]


def dome_shape(cells: float) -> tuple[int, int]:
    """Return (rows, columns), one row for two columns: 3750 x 7500 for 28 million cells."""
    rows = round(float(np.sqrt(cells / 2)) / 50) * 50
    return rows, 2 * rows


def make_dome(folder: Path, shape: tuple[int, int], *, seed: int = 0) -> None:
    """Write the scan, the photograph, its camera and the true pose into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    world = case_world(SCENE, seed=seed)
    caster = RayCaster(world.triangles)
    _write_e57(folder / "scan.e57", shape, _strips(world, caster, shape, np.random.default_rng(seed)))
    pixels = take_photograph(
        world, caster, CAMERA, POSE, lighting=Lighting(), rng=np.random.default_rng([seed, 1]), noise=1.0
    )
    cv2.imwrite(str(folder / "photo.png"), pixels[..., ::-1])
    write_camera(folder / "camera.json", CAMERA)
    write_json(folder / "truth.json", {POSE_FIELD: POSE.matrix.tolist(), "made_by": "benchmarks.shared.dome"})


def _directions(shape: tuple[int, int], columns: slice) -> NDArray[np.float32]:
    """Return unit rays (columns, rows, 3): column by column, each from the top, turning to the right."""
    latitude = np.radians(np.linspace(_TOP_DEG, _LOW_DEG, shape[0]))
    longitude = np.pi - (np.arange(columns.start, columns.stop) + 0.5) * (2 * np.pi / shape[1])
    rays = np.empty((len(longitude), shape[0], 3), np.float32)
    rays[..., 0] = np.cos(longitude)[:, None] * np.cos(latitude)
    rays[..., 1] = np.sin(longitude)[:, None] * np.cos(latitude)
    rays[..., 2] = np.sin(latitude)
    return rays


def _strips(world: World, caster: RayCaster, shape: tuple[int, int], rng: np.random.Generator) -> Iterator[Columns]:
    viewpoint = Viewpoint(world, np.zeros(3))
    wide = max(1, _STRIP_CELLS // shape[0])
    for first in range(0, shape[1], wide):
        columns = slice(first, min(first + wide, shape[1]))
        rays = _directions(shape, columns).reshape(-1, 3)
        triangles = caster.first_hit(np.zeros(3), rays)
        faces = np.where(triangles < 0, 0, np.take(world.face_of_triangle, triangles)).astype(np.int32)
        hit = viewpoint.meet(faces, rays)
        yield _records(hit.range_m, hit.cosine, hit.texel, rays, columns, shape[0], rng)


def _records(
    distance: FloatArray,
    cosine: FloatArray,
    texel: NDArray[np.uint8],
    rays: NDArray[np.float32],
    columns: slice,
    rows: int,
    rng: np.random.Generator,
) -> Columns:
    count = len(distance)
    light = texel[:, 3].astype(np.float32) / 255 * cosine * (2.5 / np.maximum(distance, 0.3)) ** 2
    measured = light * (1 + _SPECKLE * rng.standard_normal(count, dtype=np.float32))
    lost = (distance <= 0) | (light < _DARK)
    ranges = distance + _SIGMA_M * rng.standard_normal(count, dtype=np.float32)
    points = np.where(lost[:, None], 0, rays * ranges[:, None]).astype(np.float32)
    found: Columns = {f"cartesian{axis}": np.ascontiguousarray(points[:, k]) for k, axis in enumerate("XYZ")}
    found["intensity"] = np.clip(measured * _FULL, 0, 65535).astype(np.float32)
    for k, name in enumerate(("Red", "Green", "Blue")):
        found[f"color{name}"] = np.ascontiguousarray(texel[:, k])
    found["rowIndex"] = np.tile(np.arange(rows, dtype=np.int16), columns.stop - columns.start)
    found["columnIndex"] = np.repeat(np.arange(columns.start, columns.stop, dtype=np.int16), rows)
    found["cartesianInvalidState"] = np.where(lost, np.uint8(2), np.uint8(0))
    return found


def _write_e57(path: Path, shape: tuple[int, int], strips: Iterator[Columns]) -> None:
    from pye57 import libe57

    path.unlink(missing_ok=True)
    file = libe57.ImageFile(str(path), "w")
    root = file.root()
    root.set("formatName", libe57.StringNode(file, "ASTM E57 3D Imaging Data File"))
    root.set("guid", libe57.StringNode(file, "{8d4f0d9c-0001-4b5e-9e57-000000000000}"))
    root.set("versionMajor", libe57.IntegerNode(file, 1))
    root.set("versionMinor", libe57.IntegerNode(file, 0))
    root.set("e57LibraryVersion", libe57.StringNode(file, "pye57"))
    root.set("coordinateMetadata", libe57.StringNode(file, ""))
    scans = libe57.VectorNode(file, True)
    root.set("data3D", scans)
    scan = libe57.StructureNode(file)
    scan.set("guid", libe57.StringNode(file, "{8d4f0d9c-0001-4b5e-9e57-000000000001}"))
    scan.set("name", libe57.StringNode(file, "station 1"))
    _set_group(file, scan, "indexBounds", {
        "rowMinimum": 0, "rowMaximum": shape[0] - 1, "columnMinimum": 0, "columnMaximum": shape[1] - 1,
        "returnMinimum": 0, "returnMaximum": 0,
    })  # fmt: skip
    _set_group(file, scan, "colorLimits", {
        f"color{name}{end}": limit
        for name in ("Red", "Green", "Blue")
        for end, limit in (("Minimum", 0), ("Maximum", 255))
    })  # fmt: skip
    pose = libe57.StructureNode(file)
    scan.set("pose", pose)
    _set_group(file, pose, "rotation", {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0})
    _set_group(file, pose, "translation", dict(zip("xyz", TRANSLATION_M, strict=True)))
    scans.append(scan)
    prototype = libe57.StructureNode(file)
    for axis in "XYZ":
        prototype.set(f"cartesian{axis}", libe57.FloatNode(file, 0.0, libe57.E57_SINGLE, -1e4, 1e4))
    prototype.set("intensity", libe57.FloatNode(file, 0.0, libe57.E57_SINGLE, 0.0, 65535.0))
    for name in ("Red", "Green", "Blue"):
        prototype.set(f"color{name}", libe57.IntegerNode(file, 0, 0, 255))
    prototype.set("rowIndex", libe57.IntegerNode(file, 0, 0, shape[0] - 1))
    prototype.set("columnIndex", libe57.IntegerNode(file, 0, 0, shape[1] - 1))
    prototype.set("cartesianInvalidState", libe57.IntegerNode(file, 0, 0, 2))
    points = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
    scan.set("points", points)
    writer, parts = None, Columns()
    for strip in strips:
        count = len(strip["rowIndex"])
        if writer is None:
            parts = {name: np.zeros(count, values.dtype) for name, values in strip.items()}
            buffers = libe57.VectorSourceDestBuffer()
            for name, part in parts.items():
                buffers.append(libe57.SourceDestBuffer(file, name, part, count, True, True))
            writer = points.writer(buffers)
        for name, values in strip.items():
            parts[name][:count] = values
        writer.write(count)
    assert writer is not None, "a dome has columns"
    writer.close()
    file.close()


def _set_group(file: Any, parent: Any, name: str, numbers: dict[str, float]) -> None:
    from pye57 import libe57

    group = libe57.StructureNode(file)
    parent.set(name, group)
    for key, value in numbers.items():
        node = libe57.IntegerNode(file, value) if isinstance(value, int) else libe57.FloatNode(file, value)
        group.set(key, node)


def main() -> None:
    """Make one dome."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cells", type=float, default=28.0, help="millions of cells")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    shape = dome_shape(1e6 * arguments.cells)
    make_dome(arguments.folder, shape, seed=arguments.seed)
    print(f"{shape[0]} x {shape[1]} cells in {arguments.folder}")


if __name__ == "__main__":
    main()
