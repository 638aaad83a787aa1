"""At least one small valid file of every format, from which mutations are made."""

from __future__ import annotations

import importlib
import importlib.util
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.formats import recognise
from ladarreg_core.formats.cameras.camera_file import read_camera, write_camera
from ladarreg_core.formats.documents.matches_file import write_matches, write_matches_csv
from ladarreg_core.formats.documents.pose_file import write_pose
from ladarreg_core.formats.scans.npz import write_npz_counts, write_npz_xyz
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Pick
from ladarreg_core.simulate.sample import sample_folder
from testing.files.small_scans import depth_image, e57_fields, e57_file, make_scan, picture_e57

REFERENCE_SCAN = "reference-scan.npz"
"""The scan for matches files; it is valid and never damaged."""
_IN_THE_WORLD = Rigid.from_rotvec([0.01, 0.0, 2.1], (5e5, 5.4e6, 100.25))
ROS = """\
# made by a calibrator
image_width: 1280
image_height: 720
camera_name: "front: left"
camera_matrix:
  rows: 3
  cols: 3
  data: [611.8, 0.0, 639.3,
         0.0, 611.9, 365.9,
         0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0.001, 0.002, 0.05]}
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""
_LIST = "seeds.json"
_FORMAT_TESTS = Path(__file__).resolve().parents[2] / "tests" / "formats"


@dataclass(frozen=True, slots=True)
class Seed:
    """A valid file and its use."""

    format: str
    """Format that it is recognised as; the copies are given to its readers."""
    file: Path
    """The file that is read."""
    damaged: Path
    """The file that is damaged: the same one, or one that it refers to."""

    @property
    def name(self) -> str:
        """Name in reports."""
        folder = self.file.parent.name
        return f"{folder}/{self.file.name}" + (f" ({self.damaged.name})" if self.damaged != self.file else "")


def write_seeds(folder: Path) -> list[Seed]:
    """Write the files, each into a separate folder, and a list of them that `seeds_in` reads.

    A new format takes part as soon as its test module, `tests/formats/test_*.py`, has a function `seed_files(folder)`
    that writes valid files into an empty folder and returns their paths.
    """
    wall = make_scan()
    write_npz_xyz(folder / REFERENCE_SCAN, replace(wall, world_from_scanner=_IN_THE_WORLD))
    made = [*_scans(folder, wall), *_pictures(folder), *_texts(folder), *_from_format_tests(folder)]
    seeds = [Seed(recognise(file).name, file, damaged) for file, damaged in made]
    rows = [
        [seed.format, seed.file.relative_to(folder).as_posix(), seed.damaged.relative_to(folder).as_posix()]
        for seed in seeds
    ]
    (folder / _LIST).write_text(json.dumps(rows), encoding="utf-8")
    return seeds


def seeds_in(folder: Path) -> list[Seed]:
    """Return the seeds that were written into a folder."""
    rows = json.loads((folder / _LIST).read_text(encoding="utf-8"))
    return [Seed(kind, folder / file, folder / damaged) for kind, file, damaged in rows]


def _place(folder: Path, name: str) -> Path:
    (folder / name).mkdir()
    return folder / name


def _from_format_tests(folder: Path) -> list[tuple[Path, Path]]:
    """Write the files of the test modules that provide them."""
    made: list[tuple[Path, Path]] = []
    for source in sorted(_FORMAT_TESTS.glob("test_*.py")):
        if "\ndef seed_files(" in source.read_text(encoding="utf-8"):
            module = importlib.import_module(f"tests.formats.{source.stem}")
            made += [(file, file) for file in module.seed_files(_place(folder, source.stem.removeprefix("test_")))]
    return made


def _scans(folder: Path, wall: Any) -> list[tuple[Path, Path]]:
    here = _place(folder, "scans")
    files = [here / "points.npz", here / "counts.npz"]
    write_npz_xyz(files[0], replace(wall, world_from_scanner=_IN_THE_WORLD))
    counts = np.where(wall.valid, np.nan_to_num(wall.ranges) * 500 - 500, 0).astype(np.uint16)
    write_npz_counts(
        files[1], counts=counts, intensity=wall.intensity, geometry=wall.geometry, r0_m=1.0, dr_m=0.002,
    )  # fmt: skip
    if importlib.util.find_spec("pye57") is not None:
        files.append(e57_file(here / "grid.e57", e57_fields(wall, color=True)))
        files.append(e57_file(here / "cloud.e57", e57_fields(wall, grid=False)))
        picture_e57(here / "picture.e57", wall)
        files.append(here / "picture.e57")
    made = [(file, file) for file in files]
    depth = depth_image(_place(folder, "depth"))
    made += [(depth, depth), (depth, depth.with_name("depth.png"))]
    raw = _place(folder, "raw")
    (raw / "scan.raw").write_bytes(counts.astype("<u2").tobytes())
    fields = {
        "kind": "counts", "file": "scan.raw", "rows": wall.shape[0], "columns": wall.shape[1], "dtype": "<u2",
        "r0_m": 1.0, "dr_m": 0.002, "d_azimuth_rad": 0.01, "d_elevation_rad": 0.012, "intensity_file": "scan.raw",
    }  # fmt: skip
    (raw / "scan.json").write_text(json.dumps(fields, indent=1), encoding="utf-8")
    return [*made, (raw / "scan.json", raw / "scan.json"), (raw / "scan.json", raw / "scan.raw")]


def _pictures(folder: Path) -> list[tuple[Path, Path]]:
    from PIL import Image

    here = _place(folder, "pictures")
    rng = np.random.default_rng(0)
    picture = Image.fromarray(rng.integers(0, 256, (30, 40, 3), dtype=np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 6  # orientation
    exif[0x010F] = "a maker"
    exif.get_ifd(0x8769).update({0x920A: 35.0, 0xA405: 50, 0xA20E: 5000.0, 0xA20F: 5000.0, 0xA210: 3})
    picture.save(here / "photo.jpg", exif=exif)
    for name in ("photo.png", "photo.tif", "photo.webp", "photo.bmp"):
        picture.save(here / name)
    picture.save(here / "packed.tif", compression="tiff_deflate")
    Image.fromarray(rng.integers(0, 65536, (30, 40), dtype=np.uint16)).save(here / "deep.png")
    return [(file, file) for file in sorted(here.iterdir()) if _is_read(file)]


def _is_read(file: Path) -> bool:
    from ladarreg_core.errors import FormatError

    try:
        return recognise(file).kind == "photo"
    except FormatError:  # a kind of image that is not supported
        return False


def _texts(folder: Path) -> list[tuple[Path, Path]]:
    here = _place(folder, "texts")
    camera = read_camera(sample_folder() / "camera.json")
    write_camera(here / "camera.json", camera)
    (here / "ros.yaml").write_text(ROS, encoding="utf-8")
    k = camera.matrix
    opencv = (
        "%YAML:1.0\n---\nimage_width: {}\nimage_height: {}\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
    )
    opencv += "   dt: d\n   data: [ {} ]\ndistortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n"
    opencv += "   data: [ .1, -.03, 0., 0., 0. ]\n"
    numbers = ", ".join(f"{value:.6e}" for value in k.ravel())
    (here / "opencv.yml").write_text(opencv.format(camera.width, camera.height, numbers), encoding="utf-8")
    write_pose(here / "pose.json", Rigid.from_rotvec([0.1, -0.2, 0.3], (0.5, 0.25, -1.0)))
    (here / "registration.json").write_text(json.dumps(_registration(camera)), encoding="utf-8")
    points = [Pick(str(k), "point", np.array([[1, 0.01 * k, 0.02]]), np.array([[10.0 * k, 20.5]])) for k in range(6)]
    rays, uv = np.array([[1, 0.1, 0], [1, 0.1, 0.1]]), np.array([[5, 6], [7, 8.25]])
    line = Pick("a line", "line", rays, uv, on=False, weight=2.0)
    write_matches(here / "matches.json", [*points, line])
    write_matches_csv(here / "rays.csv", points)
    named = [replace(pick, lengths_m=np.array([3.0 + k]), name=f"T{k}") for k, pick in enumerate(points)]
    write_matches(here / "points.json", [*named, line])
    write_matches_csv(here / "points.csv", named)
    entries = [{"name": f"T{k}", "scan": [5e5 + 3, 5.4e6 + 0.1 * k, 101.5], "photo": [k, 3]} for k in range(6)]
    world = {"version": 2, "scan_coordinates": "point", "frame": "world", "matches": entries}
    (here / "world.json").write_text(json.dumps(world, indent=1), encoding="utf-8")
    in_world = {"camera_from_world": (Rigid.identity() @ _IN_THE_WORLD.inverse).matrix.tolist()}
    (here / "world-pose.json").write_text(json.dumps(in_world), encoding="utf-8")
    (here / "cells.csv").write_text(
        "row,column,u,v\n" + "".join(f"{k},{2 * k}.5,{k * 7},{k * 5}\n" for k in range(8)), encoding="utf-8"
    )
    return [(file, file) for file in sorted(here.iterdir())]


def _registration(camera: Any) -> dict[str, Any]:
    """Return the fields of an earlier result, as read by `formats.registration_file`."""
    pose = Rigid.from_rotvec([0.1, -0.2, 0.3], (0.5, 0.25, -1.0))
    return {
        "version": 1, "camera_from_scanner": pose.matrix.tolist(),
        "world_from_scanner": _IN_THE_WORLD.matrix.tolist(),
        "camera_from_world": (pose @ _IN_THE_WORLD.inverse).matrix.tolist(), "camera": camera.as_fields(),
        "covariance": (np.eye(6) * 1e-6).tolist(), "sigma": {"pixel_px": 1.0, "range_m": 0.015}, "accepted": True,
        "evidence": "statistics", "reasons": ["enough matches agree"], "method": "manual",
    }  # fmt: skip
