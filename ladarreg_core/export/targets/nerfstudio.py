"""The target `nerfstudio`: photographs, poses, depth maps and an initial cloud for splatting and radiance fields.

Camera axes are OpenGL's (x right, y up, looking along -z), poses camera-to-world; pixels count from (.5, .5) at the
centre of the first one, so principal points are ours + .5. nerfstudio takes one camera model for all frames of a file,
so photographs of other models stand in a file of their own.

Source: nerfstudio's documentation, "Data conventions"; its `nerfstudio_dataparser` for the names of the fields, and its
`cameras` for what `fl_x`, `fl_y`, `cx` and `cy` of a panorama are.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.camera.equirectangular import FULL_WINDOW
from ladarreg_core.errors import ExportError
from ladarreg_core.export.json import write_document
from ladarreg_core.export.photo_files import WrittenPhoto, on_one_line
from ladarreg_core.export.registered_scan import Registered, RegisteredPhoto
from ladarreg_core.export.targets.colmap import model_files
from ladarreg_core.export.targets.colmap_files import colmap_parameters
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.reconstruction import Reconstruction
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.storage.atomic_write import cannot_write, write_chunks
from ladarreg_core.storage.replacement import OFFSET_FILE
from ladarreg_core.surface.visibility.depth_map import depth_map

_MODELS = {"pinhole": "OPENCV", "fisheye": "OPENCV_FISHEYE", "equirectangular": "EQUIRECTANGULAR"}
_TERMS = 5
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_STEPS_M = (1.0, 2.0, 5.0)
_FINEST_STEP_M = 0.001  # nerfstudio's default
_MAX_STEPS = 65_535
_ROWS_AT_ONCE = 256
_BESIDE_PICTURE_PX = 64
_CLOUD = "sparse_pc.ply"
_VERTEX = np.dtype([(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")])


def nerfstudio_files(handed: Registered, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return pictures, depth maps, masks, `transforms.json`, the initial cloud and a reconstruction for COLMAP."""
    del options
    written = [WrittenPhoto(one, _camera(one.camera), report=report) for one in handed.photos]
    maps = _DepthMaps(handed, written, report)
    jobs: list[FileJob] = []
    for index, each in enumerate(written):
        jobs.append((f"images/{each.name}", each.write))
        jobs += maps.files(index)
    for name, group in _groups(written).items():
        jobs.append((name, _transforms_writer(handed, group, maps)))
    cloud = Reconstruction(handed, written, report)
    jobs.append((_CLOUD, lambda path: write_chunks(path, _cloud(handed, cloud))))
    known = [each for each in written if colmap_parameters(each.camera) is not None]
    if known:
        jobs += model_files(
            "colmap/sparse/0", cloud if len(known) == len(written) else Reconstruction(handed, known, report)
        )
    if handed.frame.name == "world":
        jobs.append((OFFSET_FILE, handed.frame.write))
    return jobs


def _camera(camera: CameraModel) -> CameraModel:
    """Return the camera of the written picture: without its lens where nerfstudio has none like it."""
    pinhole = camera.as_pinhole
    if pinhole is not None and any(pinhole.distortion[_TERMS:]):
        return pinhole.without_distortion()
    return camera


def _groups(written: Sequence[WrittenPhoto]) -> dict[str, list[WrittenPhoto]]:
    """Return the photographs of every camera model by the file that lists them; `transforms.json` has the most."""
    models = [model for model, _ in Counter(each.camera.model for each in written).most_common()]
    return {
        f"transforms{f'_{model}' if k else ''}.json": [each for each in written if each.camera.model == model]
        for k, model in enumerate(models)
    }


def _transforms_writer(handed: Registered, group: Sequence[WrittenPhoto], maps: _DepthMaps) -> Any:
    def write(path: Path) -> None:
        write_document(path, _transforms(handed, group, maps.step_m))

    return write


def _transforms(handed: Registered, group: Sequence[WrittenPhoto], step_m: float) -> dict[str, Any]:
    depth_is = (
        "z, along the camera's axis" if group[0].camera.model == "pinhole" else "distance from the camera's centre"
    )
    return {
        "camera_model": _MODELS[group[0].camera.model],
        "ply_file_path": _CLOUD,
        "depth_unit_scale_factor": step_m,
        "ladarreg": {
            "world_is": handed.frame.sentence,
            "offset_m": list(handed.frame.offset_m),
            "transform_matrix_is": "world from camera; camera: x right, y up, looking along -z; metres",
            "pixels_are": "(0.5, 0.5) is the centre of the first pixel",
            "depth_is": f"{depth_is}; PNG: steps of depth_unit_scale_factor m, 0 = none; NPZ: m, float32, 0 = none",
            "masks_are": "255 where the laser has a depth, 0 elsewhere; remove mask_path to use all of the photographs",
            "marks": list(handed.marks),
        },
        "frames": [_frame(handed, each) for each in group],
    }


def _frame(handed: Registered, written: WrittenPhoto) -> dict[str, Any]:
    one = written.one
    pose = handed.written_from_camera(one).matrix @ _OPENCV_FROM_OPENGL
    return {
        "file_path": f"images/{written.name}",
        "photograph": on_one_line(one.photo.name),
        "pose_is": one.registration.standing,
        "is_undistorted": written.is_undistorted,
        "camera_model": _MODELS[written.camera.model],
        "w": written.camera.width,
        "h": written.camera.height,
        **_intrinsics(written.camera),
        "transform_matrix": pose.tolist(),
        "depth_file_path": f"depth/{one.id}.png",
        "depth_npz_path": f"depth/{one.id}.npz",
        "mask_path": f"masks/{one.id}.png",
    }


def _intrinsics(camera: CameraModel) -> dict[str, float]:
    panorama = camera.as_panorama
    if panorama is not None:
        left, top, right, bottom = panorama.window or FULL_WINDOW
        across, down = camera.width / (right - left), camera.height / (top - bottom)  # pixels per degree
        return {"fl_x": 180 * across, "fl_y": 180 * down, "cx": -left * across, "cy": top * down}
    fields = camera.as_fields()
    terms = fields["distortion"]
    names = ("k1", "k2", "k3", "k4") if camera.model == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
    lens = {name: (terms[k] if k < len(terms) else 0.0) for k, name in enumerate(names)}
    return {"fl_x": fields["fx"], "fl_y": fields["fy"], "cx": fields["cx"] + 0.5, "cy": fields["cy"] + 0.5, **lens}


class _DepthMaps:
    """The depth maps of the photographs; one at a time is kept."""

    def __init__(self, handed: Registered, written: Sequence[WrittenPhoto], report: Report | None) -> None:
        self._handed, self._written, self._report = handed, written, report
        self._index, self._depth = -1, np.empty((0, 0), np.float32)

    def files(self, index: int) -> list[FileJob]:
        """Return the depth map of a photograph as PNG and NPZ, and its mask."""
        photo_id = self._written[index].one.id
        return [
            (f"depth/{photo_id}.png", lambda path: self._write_steps(path, index)),
            (f"depth/{photo_id}.npz", lambda path: self._write_metres(path, index)),
            (f"masks/{photo_id}.png", lambda path: self._write_mask(path, index)),
        ]

    @cached_property
    def step_m(self) -> float:
        """The step of the PNGs: the finest of 1, 2, 5, 10 ... mm with which the farthest point fits 16 bits."""
        farthest = max(self._farthest(each.one) for each in self._written)
        step = _FINEST_STEP_M
        k = 0
        while farthest > step * _MAX_STEPS:
            k += 1
            step = _FINEST_STEP_M * _STEPS_M[k % 3] * 10 ** (k // 3)
        return step

    def _farthest(self, one: RegisteredPhoto) -> float:
        """Return the largest distance of a point in a photograph, or a little beside it, m."""
        scan, farthest = self._handed.scan_of(one).scan, 0.0
        for first in range(0, scan.shape[0], _ROWS_AT_ONCE):
            rows = slice(first, first + _ROWS_AT_ONCE)
            points = one.camera_from_scanner @ scan.points_at(rows, slice(None))[scan.valid[rows]]
            near = one.camera.contains(one.camera.project(points), border=-_BESIDE_PICTURE_PX)
            if near.any():
                farthest = max(farthest, float(np.linalg.norm(points[near], axis=1).max()))
        return farthest

    def _of(self, index: int) -> NDArray[np.float32]:
        """Return the depth map of a photograph, (H, W) float32, m; 0 = none."""
        if index != self._index:
            self._index, self._depth = -1, np.empty((0, 0), np.float32)
            written = self._written[index]

            def go_on() -> None:
                if self._report is not None:
                    self._report(Progress(index, len(self._written), f"depth of {written.name}"))

            scan = self._handed.scan_of(written.one).scan
            depth = depth_map(scan, written.camera, written.one.camera_from_scanner, only_seen=True, report=go_on)
            np.nan_to_num(depth, copy=False, nan=0.0)
            self._index, self._depth = index, depth
        return self._depth

    def _write_steps(self, path: Path, index: int) -> None:
        depth, step = self._of(index), self.step_m
        values = np.empty(depth.shape, np.uint16)
        for first in range(0, len(depth), _ROWS_AT_ONCE):
            steps = np.rint(depth[first : first + _ROWS_AT_ONCE] / np.float32(step))
            values[first : first + _ROWS_AT_ONCE] = np.where(steps <= _MAX_STEPS, steps, 0)
        _write_png(path, values)

    def _write_metres(self, path: Path, index: int) -> None:
        depth = self._of(index)
        try:
            with open(path, "wb") as stream:
                np.savez_compressed(stream, depth=depth)
        except OSError as error:
            raise cannot_write(path, error) from None

    def _write_mask(self, path: Path, index: int) -> None:
        _write_png(path, (self._of(index) > 0).astype(np.uint8) * np.uint8(255))
        if index == len(self._written) - 1:
            self._index, self._depth = -1, np.empty((0, 0), np.float32)


def _write_png(path: Path, values: NDArray[Any]) -> None:
    done, encoded = cv2.imencode(".png", values)
    if not done:
        raise ExportError(
            f"a picture of {values.shape[1]} x {values.shape[0]} pixels cannot be written as PNG; give a smaller one"
        )
    write_chunks(path, (encoded.data,))


def _cloud(handed: Registered, reconstruction: Reconstruction) -> Iterator[bytes]:
    model = reconstruction.model
    words = [f"ladarreg: {handed.frame.sentence}", *model.words]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line.encode('ascii', 'replace').decode()}" for line in words),
        f"element vertex {len(model.points)}",
        *(f"property float {name}" for name in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "end_header\n",
    ]
    yield "\n".join(header).encode("ascii")
    vertices = np.empty(len(model.points), _VERTEX)
    for k, name in enumerate(_VERTEX.names or ()):
        vertices[name] = model.points[:, k] if k < 3 else model.colors[:, k - 3]
    yield vertices.tobytes()
