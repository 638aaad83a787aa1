"""The target `opencv`: one calibration with its pose a photograph, as `cv2.FileStorage` reads it.

Pixels count from (0, 0) at the centre of the first one, as in ladarreg. `R`, `rvec` and `tvec` map points of the world
into the camera's frame (x right, y down, z forward), so that `cv2.projectPoints(points, rvec, tvec, K, D)`, or
`cv2.fisheye.projectPoints` for a fisheye, gives pixels of the photograph.

Source: OpenCV, `cv::FileStorage`, `cv::projectPoints` and `cv::fisheye`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from ladarreg_core.export.photo_files import shown_names, text_writer, words_of
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.progress import Report
from ladarreg_core.frames import rotvec_from_rotation


def opencv_refusal(handed: RegisteredScan, options: ExportOptions) -> str | None:
    """Return a sentence if a camera is equirectangular."""
    del options
    found = [one for one in handed.photos if one.camera.as_panorama is not None]
    if not found:
        return None
    return (
        f"{shown_names(found)} is equirectangular, and OpenCV describes perspective and fisheye cameras only; leave it "
        "out, export it to colmap or nerfstudio, or cut perspective views out of it"
    )


def opencv_files(handed: RegisteredScan, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return `ID.yaml` of every photograph."""
    del options, report
    return [(f"{one.id}.yaml", text_writer(_calibration(handed, one))) for one in handed.photos]


def _calibration(handed: RegisteredScan, one: RegisteredPhoto) -> str:
    fields = one.camera.as_fields()
    is_fisheye = one.camera.model == "fisheye"
    terms = fields["distortion"] or [0.0] * (4 if is_fisheye else 5)
    pose = handed.written_from_camera(one).inverse
    matrix = np.array([[fields["fx"], 0, fields["cx"]], [0, fields["fy"], fields["cy"]], [0, 0, 1.0]])
    project = "cv2.fisheye.projectPoints" if is_fisheye else "cv2.projectPoints"
    words = [
        *words_of(handed, one),
        "K in pixels, (0, 0) is the centre of the first one; D in OpenCV's order"
        + (", k1 k2 k3 k4 of cv2.fisheye" if is_fisheye else ""),
        "R, rvec, tvec: camera_from_world; p_camera = R p_world + tvec; camera: x right, y down, z forward; metres",
        f"Pixels of points of the world: {project}, with rvec, tvec, K and D",
    ]
    lines = ["%YAML:1.0", "---", *(f"# {line}" for line in words)]
    lines += [
        f"photograph: {_quoted(one.photo.name)}",
        f"image_width: {one.camera.width}",
        f"image_height: {one.camera.height}",
        f"camera_model: {_quoted(one.camera.model)}",
        f"fisheye_model: {int(is_fisheye)}",
        *_matrix("K", matrix),
        *_matrix("D", np.array(terms)[:, None] if is_fisheye else np.array(terms)[None]),
        *_matrix("rvec", rotvec_from_rotation(pose.rotation)[:, None]),
        *_matrix("tvec", pose.translation[:, None]),
        *_matrix("R", pose.rotation),
        f"world: {_quoted(handed.frame.sentence)}",
        *_matrix("world_offset_m", np.array(handed.frame.offset_m)[:, None]),
        f"pose_is: {_quoted(one.registration.standing)}",
    ]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return json.dumps("".join(letter if letter.isprintable() else " " for letter in text), ensure_ascii=False)


def _matrix(name: str, values: FloatArray) -> list[str]:
    numbers = ", ".join(_real(value) for value in np.asarray(values, dtype=np.float64).ravel())
    rows, columns = np.shape(values)
    return [
        f"{name}: !!opencv-matrix",
        f"   rows: {rows}",
        f"   cols: {columns}",
        "   dt: d",
        f"   data: [ {numbers} ]",
    ]


def _real(value: float) -> str:
    """Return a number with a point, without which OpenCV takes it for an integer."""
    text = repr(float(value) + 0.0)
    mantissa, mark, exponent = text.partition("e")
    return (mantissa if "." in mantissa else f"{mantissa}.") + mark + exponent
