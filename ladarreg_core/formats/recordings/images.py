"""Pictures and cameras in the messages of a recording.

Source: ROS, `sensor_msgs/Image`, `sensor_msgs/CompressedImage`, `sensor_msgs/CameraInfo` and `image_encodings.hpp`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import CameraError, FormatError
from ladarreg_core.formats.cameras.calibration import cameras_of_calibration
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.formats.recordings.recording import CAMERA_TYPES, Recording, shown

_STATE_CAMERA = "state the camera: a camera file (`camera`), or its focal length (`focal_px`)"
_PLAIN = {"mono8": 1, "8uc1": 1, "rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4, "8uc4": 4, "mono16": 1}
_PACKED = {
    "yuv422": cv2.COLOR_YUV2RGB_UYVY, "uyvy": cv2.COLOR_YUV2RGB_UYVY, "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUYV,
    "yuyv": cv2.COLOR_YUV2RGB_YUYV,
}  # fmt: skip
_MOSAIC = {
    "bayer_rggb": cv2.COLOR_BayerRGGB2RGB, "bayer_bggr": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg": cv2.COLOR_BayerGBRG2RGB, "bayer_grbg": cv2.COLOR_BayerGRBG2RGB,
}  # fmt: skip
_BLUE_FIRST = ("bgr8", "bgra8", "8uc3", "8uc4")
_LARGEST_SIDE = 1 << 16
_CAMERA_INFO = "camera_info"


def write_picture(message: Any, folder: Path, name: str) -> Path:
    """Write the picture of an Image or CompressedImage into a folder, unchanged, as a file that `read_photo` reads.

    Args:
        message: the decoded message.
        folder: an existing folder.
        name: of the file.

    Raises:
        FormatError: if its encoding is not one of a picture, or its data are incomplete.
    """
    file = folder / name
    if not hasattr(message, "encoding"):
        data = np.ascontiguousarray(message.data, dtype=np.uint8).tobytes()
        if not data:
            raise FormatError("a compressed picture is empty; record the topic again")
        file.write_bytes(data)
        return file
    pixels = pixels_of(message)
    done, encoded = cv2.imencode(".png" if pixels.dtype == np.uint16 else ".bmp", pixels[..., ::-1])
    assert done, "both kinds can be encoded"
    file.write_bytes(encoded.tobytes())
    return file


def pixels_of(message: Any) -> NDArray[Any]:
    """Return the pixels (H, W, 3) RGB of an uncompressed Image, uint8 or uint16.

    Raises:
        FormatError: as `write_picture`.
    """
    encoding = str(message.encoding).strip().lower()
    mosaic = _MOSAIC.get(encoding.rstrip("0123456789"))
    wide = encoding == "mono16" or (mosaic is not None and encoding.endswith("16"))
    channels = 1 if mosaic is not None else 2 if encoding in _PACKED else _PLAIN.get(encoding)
    if channels is None:
        raise FormatError(
            f"its pictures are encoded as {shown(message.encoding)}; gray, RGB, Bayer patterns and YUV 4:2:2 are read: "
            "choose the topic of a camera's pictures, or convert them"
        )
    height, width, step = int(message.height), int(message.width), int(message.step)
    size = 2 if wide else 1
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    row = width * channels * size
    if not (1 <= width <= _LARGEST_SIDE and 1 <= height <= _LARGEST_SIDE) or step < row or step * height > data.size:
        raise FormatError(
            f"a picture claims {width:,} x {height:,} pixels in rows of {step:,} bytes, but its data are "
            f"{data.size:,} bytes; it is damaged"
        )
    rows = data[: step * height].reshape(height, step)[:, :row]
    values: NDArray[Any] = np.ascontiguousarray(rows)
    if wide:
        values = values.view(np.dtype(">u2" if message.is_bigendian else "<u2")).astype(np.uint16)
    values = values.reshape(height, width, channels)
    if mosaic is not None:
        return np.asarray(cv2.cvtColor(values, mosaic))
    if encoding in _PACKED:
        if width % 2:
            raise FormatError(f"a YUV 4:2:2 picture is {width} pixels wide, an odd number; it is damaged")
        return np.asarray(cv2.cvtColor(values, _PACKED[encoding]))
    values = np.repeat(values, 3, axis=-1) if channels == 1 else values[..., :3]
    return np.ascontiguousarray(values[..., ::-1] if encoding in _BLUE_FIRST else values)


def camera_topic(recording: Recording, image_topic: str, image_topics: Sequence[str]) -> str | None:
    """Return the topic with the intrinsics of the pictures on another topic; None if there is none.

    By convention it is `camera_info` in the same namespace. A recording with a single camera may name it otherwise.

    Args:
        recording: the recording.
        image_topic: topic of the pictures.
        image_topics: all topics with pictures.
    """
    infos = recording.topics(CAMERA_TYPES)
    parts = image_topic.strip("/").split("/")
    for length in range(len(parts) - 1, -1, -1):
        wanted = "/".join([*parts[:length], _CAMERA_INFO])
        found = next((name for name in infos if name.strip("/") == wanted), None)
        if found is not None:
            return found
    return next(iter(infos)) if len(infos) == len(image_topics) == 1 else None


def recorded_camera(recording: Recording, image_topic: str, image_topics: Sequence[str]) -> tuple[CameraModel, str]:
    """Return the camera of the pictures on a topic, as their CameraInfo states it, and a note.

    Args:
        recording: the recording.
        image_topic: topic of the pictures; of rectified ones (`image_rect`) the projection matrix is taken.
        image_topics: all topics with pictures.

    Raises:
        CameraError: if there is none, it is empty, or its model is not read: with what to state instead.
    """
    topic = camera_topic(recording, image_topic, image_topics)
    if topic is None:
        infos = recording.topics(CAMERA_TYPES)
        has = f"has only {', '.join(map(shown, infos))}" if infos else "has no camera_info"
        raise CameraError(f"the recording {has}, none of which is of {shown(image_topic)}; {_STATE_CAMERA}")
    first = next(recording.messages(topic, CAMERA_TYPES), None)
    if first is None:
        raise CameraError(f"{shown(topic)} has no messages; {_STATE_CAMERA}")
    info = recording.decoded(first[1].raw, first[0])
    try:
        camera = camera_of_info(info, rectified="rect" in _last_part(image_topic))
    except (CameraError, FormatError) as error:
        raise CameraError(f"{shown(topic)}: {error}; {_STATE_CAMERA}") from error
    return camera, f"the camera is that of {shown(topic)}"


def camera_of_info(info: Any, *, rectified: bool = False) -> CameraModel:
    """Return the camera of a CameraInfo.

    Args:
        info: the decoded message.
        rectified: whether the pictures were rectified with it, so that they have no distortion.

    Raises:
        CameraError: if it is not filled in, or its model is not read.
        FormatError: if its fields do not fit each other.
    """
    K, D, P = (_numbers(info, name) for name in "KDP")
    if not any(K):
        raise CameraError("the camera was not calibrated: its matrix K is zero")
    model = str(info.distortion_model) or "plumb_bob"
    if rectified:
        K, D, model = [*P[:3], *P[4:7], *P[8:11]] if any(P) else K, [], "plumb_bob"
    camera = cameras_of_calibration({
        "image_width": int(info.width), "image_height": int(info.height), "camera_matrix": K,
        "distortion_model": model, "distortion_coefficients": D,
    })[0].camera  # fmt: skip
    roi = info.roi
    lens = camera.as_focal
    if int(roi.width) and int(roi.height) and lens is not None:
        cx, cy = lens.cx - int(roi.x_offset), lens.cy - int(roi.y_offset)
        camera = replace(lens, width=int(roi.width), height=int(roi.height), cx=cx, cy=cy)
    across, down = max(1, int(info.binning_x)), max(1, int(info.binning_y))
    return camera if across == down == 1 else camera.resized(camera.width // across, camera.height // down)


def _numbers(info: Any, name: str) -> list[float]:
    """Return a matrix of a CameraInfo: ROS 1 has its name in capitals, ROS 2 in small letters."""
    values = getattr(info, name, None)
    if values is None:
        values = getattr(info, name.lower())
    found = [float(value) for value in values]
    if not np.isfinite(found).all():
        raise FormatError(f"its {name} has numbers that are not finite ({one_line(found, 60)})")
    return found


def _last_part(topic: str) -> str:
    """Return the last part of a topic's name that is not the name of a transport."""
    return topic.strip("/").removesuffix("/compressed").split("/")[-1]
