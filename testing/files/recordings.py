"""Recordings of robots, written by rosbags: clouds, pictures and cameras on topics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ladarreg_core.camera import CameraModel

CLOUD, INFO = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/CameraInfo"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
Builder = Callable[[Any], Any]
"""Makes a message of a type store."""
Topics = Mapping[str, tuple[str, Sequence[tuple[int, Builder]]]]
"""By the name of a topic: the type of its messages, and when, ns, each is recorded."""
_CODES = {"f4": 7, "f8": 8, "u1": 2, "u2": 4, "u4": 6}
_MODELS = {0: "plumb_bob", 4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}


def write_recording(folder: Path, kind: str, topics: Topics, *, compressed: str = "") -> Path:
    """Write messages into a new folder; return the file that contains them.

    Args:
        folder: to be made.
        kind: bag, db3 or mcap.
        topics: the messages.
        compressed: the format in a ROS 1 bag (bz2, lz4), the mode in a ROS 2 bag (file, message, storage).
    """
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    folder.mkdir(parents=True)
    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    writer: Any
    if kind == "bag":
        writer = rosbag1.Writer(folder / "recording.bag")
        if compressed:
            writer.set_compression(rosbag1.Writer.CompressionFormat[compressed.upper()])
    else:
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(folder / "recording", version=9, storage_plugin=plugin)
        if compressed:
            writer.set_compression(rosbag2.CompressionMode[compressed.upper()], rosbag2.CompressionFormat.ZSTD)
    with writer:
        for topic, (msgtype, messages) in topics.items():
            connection = writer.add_connection(topic, msgtype, typestore=store)
            for when, build in messages:
                made = build(store)
                data = store.serialize_ros1(made, msgtype) if kind == "bag" else store.serialize_cdr(made, msgtype)
                writer.write(connection, when, data)
    return folder / "recording.bag" if kind == "bag" else folder / "recording" / f"recording.{kind}"


def header(store: Any, stamp_ns: int, frame: str) -> Any:
    """Return a message's header."""
    kind = store.types["std_msgs/msg/Header"]
    time = store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    sequence = {"seq": 0} if "seq" in kind.__dataclass_fields__ else {}
    return kind(**sequence, stamp=time, frame_id=frame)


def cloud(
    columns: Mapping[str, np.ndarray], shape: tuple[int, int], *, stamp_ns: int = 1_000_000_002, big: bool = False,
    row_padding: int = 0, frame: str = "lidar",
) -> Builder:  # fmt: skip
    """Return a PointCloud2 whose points have three bytes of padding behind x, y, z."""
    names, formats, offsets, at = [], [], [], 0
    for name, values in columns.items():
        code = values.dtype.str[1:]
        names.append(name)
        formats.append((">" if big else "<") + code)
        offsets.append(at)
        at += values.dtype.itemsize + (3 if name == "z" else 0)
    records = np.zeros(shape, np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": at}))
    for name, values in columns.items():
        records[name] = values.reshape(shape)
    rows = np.frombuffer(records.tobytes(), np.uint8).reshape(shape[0], -1)
    rows = np.pad(rows, ((0, 0), (0, row_padding)))

    def build(store: Any) -> Any:
        field = store.types["sensor_msgs/msg/PointField"]
        return store.types[CLOUD](
            header=header(store, stamp_ns, frame), height=shape[0], width=shape[1],
            fields=[
                field(name=name, offset=offset, datatype=_CODES[code[1:]], count=1)
                for name, offset, code in zip(names, offsets, formats, strict=True)
            ],
            is_bigendian=big, point_step=at, row_step=rows.shape[1], data=rows.ravel(), is_dense=False,
        )  # fmt: skip

    return build


def point_cloud(points: np.ndarray, intensity: np.ndarray, *, stamp_ns: int, frame: str = "lidar") -> Builder:
    """Return a PointCloud2 of unordered points (N, 3), m, with their intensity (N,)."""
    columns = {axis: points[:, k].astype(np.float32) for k, axis in enumerate("xyz")}
    columns["intensity"] = intensity.astype(np.float32)
    return cloud(columns, (1, len(points)), stamp_ns=stamp_ns, frame=frame)


def image(pixels: np.ndarray, *, stamp_ns: int, encoding: str = "rgb8", padding: int = 0) -> Builder:
    """Return an Image of pixels (H, W) or (H, W, C), as they are encoded, with rows padded by so many bytes."""
    height, width = pixels.shape[:2]
    rows = np.pad(np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1), ((0, 0), (0, padding)))

    def build(store: Any) -> Any:
        return store.types[IMAGE](
            header=header(store, stamp_ns, "camera"), height=height, width=width, encoding=encoding, is_bigendian=0,
            step=rows.shape[1], data=rows.ravel(),
        )  # fmt: skip

    return build


def compressed_image(pixels: np.ndarray, *, stamp_ns: int, suffix: str = ".jpg") -> Builder:
    """Return a CompressedImage of pixels (H, W, 3) RGB, as JPEG or PNG."""
    data = cv2.imencode(suffix, pixels[..., ::-1])[1].ravel()

    def build(store: Any) -> Any:
        return store.types[COMPRESSED](header=header(store, stamp_ns, "camera"), format=f"rgb8; {suffix}", data=data)

    return build


def camera_info(camera: CameraModel, *, stamp_ns: int = 1, model: str = "", **changed: Any) -> Builder:
    """Return the CameraInfo of a pinhole or fisheye; fields can be changed by their name in ROS 2."""
    fields = camera.as_fields()
    terms = np.array(fields["distortion"], dtype=np.float64)
    fx, fy, cx, cy = (fields[name] for name in ("fx", "fy", "cx", "cy"))
    matrix = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
    projection = np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0])
    named = model or ("equidistant" if camera.model == "fisheye" else _MODELS[len(terms)])
    about: dict[str, Any] = {
        "height": camera.height, "width": camera.width, "distortion_model": named, "d": terms, "k": matrix,
        "r": np.eye(3).ravel(), "p": projection, "binning_x": 0, "binning_y": 0,
    } | changed  # fmt: skip

    def build(store: Any) -> Any:
        kind = store.types[INFO]
        region = store.types["sensor_msgs/msg/RegionOfInterest"]
        roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False} | about.get("roi", {})
        capital = "K" in kind.__dataclass_fields__
        given = {(name.upper() if capital and name in "dkrp" else name): value for name, value in about.items()}
        return kind(**{**given, "header": header(store, stamp_ns, "camera"), "roi": region(**roi)})

    return build
