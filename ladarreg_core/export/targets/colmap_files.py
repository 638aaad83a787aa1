"""COLMAP's cameras, images and points3D, binary and text.

Pixels: COLMAP counts the centre of the first pixel as (.5, .5); the numbers here are COLMAP's.

Source: COLMAP's documentation, "Output format" and "Camera models".
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.storage.atomic_write import write_chunks

_NUMBERS = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6, "EQUIRECTANGULAR": 17}
_OPENCV_TERMS, _FULL_TERMS = 4, 8
_LINES_AT_ONCE = 4096
_POINT2D = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])


@dataclass(frozen=True, slots=True, eq=False)
class ColmapImage:
    """A photograph with its camera and the points that it shows."""

    name: str
    """Its path below the folder of pictures."""
    camera: CameraModel
    """Its camera, one that `colmap_parameters` knows."""
    camera_from_world: Rigid
    """Its pose."""
    observed: NDArray[np.int64]
    """(N,) indices of points, ascending."""
    uv: FloatArray
    """(N, 2) their pixels, ladarreg's: (0, 0) is the centre of the first one."""


@dataclass(frozen=True, slots=True, eq=False)
class ColmapModel:
    """A reconstruction; images, cameras and points are numbered from 1 in their order."""

    images: Sequence[ColmapImage]
    """The photographs."""
    points: FloatArray
    """(P, 3) float64, m."""
    colors: NDArray[np.uint8]
    """(P, 3) RGB."""
    errors_px: FloatArray
    """(P,)."""
    words: Sequence[str]
    """Sentences for the comments of the text files."""


def joined(models: Sequence[ColmapModel]) -> ColmapModel:
    """Return reconstructions in the same world as one."""
    images, first = [], 0
    for model in models:
        images += [replace(one, observed=one.observed + first) for one in model.images]
        first += len(model.points)
    return ColmapModel(
        images,
        np.concatenate([np.empty((0, 3)), *(one.points for one in models)]),
        np.concatenate([np.empty((0, 3), np.uint8), *(one.colors for one in models)]),
        np.concatenate([np.empty(0), *(one.errors_px for one in models)]),
        [line for one in models for line in one.words],
    )


def colmap_parameters(camera: CameraModel) -> tuple[str, list[float]] | None:
    """Return COLMAP's model and parameters of a camera; None if it has no model that is the same."""
    panorama, lens = camera.as_panorama, camera.as_focal
    if panorama is not None and not panorama.window:
        return "EQUIRECTANGULAR", [float(panorama.width), float(panorama.height)]
    if lens is None:
        return None
    matrix = [lens.fx, lens.fy, lens.cx + 0.5, lens.cy + 0.5]
    terms = list(lens.distortion)
    if camera.as_pinhole is None:
        return "OPENCV_FISHEYE", [*matrix, *(terms or [0.0] * _OPENCV_TERMS)]
    if not terms:
        return "PINHOLE", matrix
    if any(terms[_FULL_TERMS:]):
        return None
    if any(terms[_OPENCV_TERMS:]):
        return "FULL_OPENCV", [*matrix, *(terms + [0.0] * _FULL_TERMS)[:_FULL_TERMS]]
    return "OPENCV", [*matrix, *terms[:_OPENCV_TERMS]]


def write_cameras(path: Path, model: ColmapModel) -> None:
    """Write `cameras.bin` or `cameras.txt`, as the path's extension says.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_chunks(path, _cameras_text(model) if path.suffix == ".txt" else _cameras_binary(model))


def write_images(path: Path, model: ColmapModel) -> None:
    """Write `images.bin` or `images.txt`; errors as `write_cameras`."""
    write_chunks(path, _images_text(model) if path.suffix == ".txt" else _images_binary(model))


def write_points(path: Path, model: ColmapModel) -> None:
    """Write `points3D.bin` or `points3D.txt`; errors as `write_cameras`."""
    write_chunks(path, _points_text(model) if path.suffix == ".txt" else _points_binary(model))


def _listed(model: ColmapModel) -> Iterator[tuple[int, CameraModel, str, list[float]]]:
    for number, image in enumerate(model.images, 1):
        found = colmap_parameters(image.camera)
        assert found is not None, "other cameras are refused or undistorted before"
        yield number, image.camera, *found


def _cameras_binary(model: ColmapModel) -> Iterator[bytes]:
    yield struct.pack("<Q", len(model.images))
    for number, camera, name, parameters in _listed(model):
        yield struct.pack("<iiQQ", number, _NUMBERS[name], *camera.size)
        yield struct.pack(f"<{len(parameters)}d", *parameters)


def _cameras_text(model: ColmapModel) -> Iterator[bytes]:
    lines = [
        "# Camera list with one line of data per camera:",
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
        *(f"# {line}" for line in model.words),
        f"# Number of cameras: {len(model.images)}",
    ]
    for number, camera, name, parameters in _listed(model):
        lines.append(f"{number} {name} {camera.width} {camera.height} {_numbers(parameters)}")
    yield _lines(lines)


def _images_binary(model: ColmapModel) -> Iterator[bytes]:
    yield struct.pack("<Q", len(model.images))
    for number, image in enumerate(model.images, 1):
        yield struct.pack("<I7dI", number, *_pose(image.camera_from_world), number)
        yield image.name.encode("utf-8") + b"\0"
        records = np.empty(len(image.observed), _POINT2D)
        records["x"], records["y"], records["point"] = *(image.uv + 0.5).T, image.observed + 1
        yield struct.pack("<Q", len(records)) + records.tobytes()


def _images_text(model: ColmapModel) -> Iterator[bytes]:
    count = sum(len(image.observed) for image in model.images)
    yield _lines(
        [
            "# Image list with two lines of data per image:",
            "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
            "#   POINTS2D[] as (X, Y, POINT3D_ID)",
            *(f"# {line}" for line in model.words),
            f"# Number of images: {len(model.images)}, mean observations per image: {count / len(model.images):.1f}",
        ]
    )
    for number, image in enumerate(model.images, 1):
        yield _lines([f"{number} {_numbers(_pose(image.camera_from_world))} {number} {image.name}"])
        observations = zip((image.uv + 0.5).tolist(), (image.observed + 1).tolist(), strict=True)
        yield _lines([" ".join(f"{u!r} {v!r} {point}" for (u, v), point in observations)])


def _points_binary(model: ColmapModel) -> Iterator[bytes]:
    yield struct.pack("<Q", len(model.points))
    tracks, starts = _tracks(model)
    track_bytes = tracks.astype("<u4").tobytes()
    for first, rows in _rows(model):
        pieces = []
        for number, (xyz, rgb, error) in enumerate(rows, first + 1):
            begin, end = int(starts[number - 1]), int(starts[number])
            pieces.append(struct.pack("<Q3d3BdQ", number, *xyz, *rgb, error, end - begin))
            pieces.append(track_bytes[8 * begin : 8 * end])
        yield b"".join(pieces)


def _points_text(model: ColmapModel) -> Iterator[bytes]:
    tracks, starts = _tracks(model)
    mean = len(tracks) / max(1, len(model.points))
    yield _lines(
        [
            "# 3D point list with one line of data per point:",
            "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
            *(f"# {line}" for line in model.words),
            f"# Number of points: {len(model.points)}, mean track length: {mean:.2f}",
        ]
    )
    for first, rows in _rows(model):
        lines = []
        for number, (xyz, (red, green, blue), error) in enumerate(rows, first + 1):
            seen = " ".join(map(str, tracks[starts[number - 1] : starts[number]].ravel().tolist()))
            lines.append(f"{number} {_numbers(xyz)} {red} {green} {blue} {error!r} {seen}")
        yield _lines(lines)


def _rows(model: ColmapModel) -> Iterator[tuple[int, list[tuple[list[float], list[int], float]]]]:
    """Yield some points at a time: the index of the first, and their coordinates, colours and errors."""
    for first in range(0, len(model.points), _LINES_AT_ONCE):
        part = slice(first, first + _LINES_AT_ONCE)
        values = (model.points[part].tolist(), model.colors[part].tolist(), model.errors_px[part].tolist())
        yield first, list(zip(*values, strict=True))


def _tracks(model: ColmapModel) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return (image number, index of the observation) (T, 2), by points, and where each point's begin (P + 1,)."""
    point = np.concatenate([image.observed for image in model.images])
    number = np.repeat(np.arange(1, len(model.images) + 1), [len(image.observed) for image in model.images])
    index = np.concatenate([np.arange(len(image.observed)) for image in model.images])
    order = np.argsort(point, kind="stable")
    starts = np.searchsorted(point[order], np.arange(len(model.points) + 1))
    return np.stack([number, index], axis=-1)[order], starts


def _pose(camera_from_world: Rigid) -> tuple[float, ...]:
    """Return the quaternion w x y z and the translation."""
    w, x, y, z = camera_from_world.quaternion_wxyz.tolist()
    return (w, x, y, z, *camera_from_world.translation.tolist())


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _lines(lines: Sequence[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode("utf-8") if lines else b""
