"""Agisoft's XML: calibrations, and documents with the calibrations of several sensors and the cameras' names.

cx and cy are offsets from the picture's centre, which counts from the picture's corner: (.5, .5) is the centre of the
first pixel. P1 and P2 are OpenCV's p2 and p1. K4 (r^8) and B2 (skew) have no term in OpenCV and are refitted; B1 is the
difference of the focal lengths.

Source: Agisoft Metashape user manual, appendix "Camera models".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import CameraError, FormatError
from ladarreg_core.formats.cameras.camera_in_file import (
    FileCamera,
    equirectangular_camera,
    lens_camera,
    naming,
    refuse_model,
)
from ladarreg_core.formats.cameras.fields import notes_on_unused
from ladarreg_core.formats.cameras.refit import refitted
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.formats.parsing.xml_file import read_xml

_LARGEST_BYTES = 16_000_000
_TERMS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
_NOT_TERMS = ("projection", "width", "height", "resolution", "date", "covariance", "params")
_FISHEYES = ("fisheye", "equidistant_fisheye", "equisolid_fisheye")


def sniff_agisoft(head: bytes, file: Path) -> bool:
    """Return whether a file begins like a calibration or a document of Agisoft."""
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    return (
        start.startswith(b"<")
        and any(word in head for word in (b"<calibration>", b"<calibration ", b"<chunk", b"<sensors"))
        and b"<opencv_storage" not in head
    )


def read_agisoft(path: Path) -> tuple[FileCamera, ...]:
    """Return the cameras of a calibration or a document.

    Raises:
        FormatError: if it is damaged or contains no calibration.
        CameraError: if a model is not read, or OpenCV's terms cannot express it within .01 px.
    """
    root = read_xml(path, _LARGEST_BYTES, "a file of Agisoft")
    if root.tag == "calibration":
        return (_camera_of(root, "", (), None),)
    pictures: dict[str, list[str]] = {}
    for node in root.iter("camera"):
        label = node.get("label")
        if label and node.get("sensor_id") is not None:
            pictures.setdefault(str(node.get("sensor_id")), []).append(label)
    found = []
    refused: list[CameraError] = []
    for sensor in root.iter("sensor"):
        calibrations = sensor.findall("calibration")
        adjusted = [node for node in calibrations if node.get("class") == "adjusted"] or calibrations
        kind = sensor.get("type") or "frame"
        if not adjusted and kind != "spherical":
            continue
        number = str(sensor.get("id"))
        name = one_line(sensor.get("label") or f"sensor {number}", 80)
        try:
            taken = tuple(pictures.get(number, ()))
            found.append(_camera_of(adjusted[0] if adjusted else sensor, name, taken, sensor))
        except CameraError as error:  # the other sensors can be used
            refused.append(error)
    if not found and refused:
        raise refused[0]
    if not found:
        raise FormatError("it contains no calibration; export the cameras or the calibration from Metashape again")
    return tuple(found)


def _camera_of(node: Element, name: str, pictures: tuple[str, ...], sensor: Element | None) -> FileCamera:
    with naming(name):
        kind = node.get("type") or node.findtext("projection") or (sensor.get("type") if sensor is not None else None)
        width, height = _size(node, sensor)
        camera, notes = _camera_and_notes((kind or "frame").strip(), _values(node), width, height)
        others = {child.tag: _number_or_text(child) for child in node if child.tag not in (*_TERMS, *_NOT_TERMS)}
        return FileCamera(camera=camera, name=name, pictures=pictures, notes=(*notes, *notes_on_unused(others)))


def _size(node: Element, sensor: Element | None) -> tuple[int, int]:
    where = next(
        (found for each in (node, sensor) if each is not None and (found := each.find("resolution")) is not None), None
    )
    texts = (
        (where.get("width"), where.get("height"))
        if where is not None
        else (node.findtext("width"), node.findtext("height"))
    )
    try:
        width, height = (int(text or "") for text in texts)
    except ValueError:
        raise FormatError("the size of the pictures (width and height) is missing; export the file again") from None
    return width, height


def _values(node: Element) -> dict[str, float]:
    if node.find("fx") is not None:
        raise CameraError(
            "it has fx and fy, as PhotoScan before version 1.2 wrote it, with other conventions; open the project in a "
            "newer version and export it again"
        )
    values = dict.fromkeys(_TERMS, 0.0)
    for name in _TERMS:
        text = node.findtext(name)
        if text is None:
            continue
        try:
            values[name] = float(text)
        except ValueError:
            raise FormatError(f"<{name}> is {one_line(text, 30)!r}; it must be a number") from None
        if not math.isfinite(values[name]):
            raise FormatError(f"<{name}> is {one_line(text, 30)}; it must be finite")
    return values


def _number_or_text(node: Element) -> float | str:
    text = (node.text or "").strip()
    try:
        return float(text)
    except ValueError:
        return text


def _camera_and_notes(
    kind: str, v: Mapping[str, float], width: int, height: int
) -> tuple[CameraModel, tuple[str, ...]]:
    if kind == "spherical":
        if width != 2 * height:
            raise CameraError(f"its panorama is {width} x {height} pixels; a full one is twice as wide as high")
        return equirectangular_camera(width, height), ()
    if kind != "frame" and kind not in _FISHEYES:
        refuse_model(kind, "export the photographs undistorted")
    if not v["f"] > 0:
        raise FormatError("the focal length <f> is missing or not positive; export the calibration again")
    matrix = (v["f"] + v["b1"], v["f"], width / 2 + v["cx"] - 0.5, height / 2 + v["cy"] - 0.5)
    odd = [name for name in ("k4", "b2", "p3", "p4") if v[name] and (kind == "frame" or name != "k4")]
    if kind == "frame" and not odd:
        terms = (v["k1"], v["k2"], v["p2"], v["p1"], v["k3"])
        return lens_camera("pinhole", width, height, matrix, terms), ()
    if kind != "frame":
        odd += [name for name in ("p1", "p2") if v[name]]
        if kind != "equisolid_fisheye" and not odd:
            return lens_camera("fisheye", width, height, matrix, (v["k1"], v["k2"], v["k3"], v["k4"])), ()
    if kind == "equisolid_fisheye":
        odd.append("an equisolid fisheye")
    what = ", ".join(name.upper() if name in _TERMS else name for name in odd)
    camera, note = refitted(
        lambda points: _project(kind, v, width, height, points),
        "pinhole" if kind == "frame" else "fisheye", width, height, matrix, what,
    )  # fmt: skip
    return camera, (note,)


def _project(
    kind: str, v: Mapping[str, float], width: int, height: int, points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the pixels (N, 2), in ladarreg's convention, that the manual's equations give."""
    if kind == "frame":
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    else:
        r = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(r, points[:, 2])
        mapped = 2 * np.sin(theta / 2) if kind == "equisolid_fisheye" else theta
        scale = np.where(r > 1e-12, mapped / np.where(r > 1e-12, r, 1.0), 1.0)
        x, y = points[:, 0] * scale, points[:, 1] * scale
    s = x * x + y * y
    radial = 1 + s * (v["k1"] + s * (v["k2"] + s * (v["k3"] + s * v["k4"])))
    higher = 1 + s * (v["p3"] + s * v["p4"])
    xd = x * radial + (v["p1"] * (s + 2 * x * x) + 2 * v["p2"] * x * y) * higher
    yd = y * radial + (v["p2"] * (s + 2 * y * y) + 2 * v["p1"] * x * y) * higher
    u = width / 2 + v["cx"] + xd * (v["f"] + v["b1"]) + yd * v["b2"] - 0.5
    return np.stack([u, height / 2 + v["cy"] + yd * v["f"] - 0.5], axis=-1)
