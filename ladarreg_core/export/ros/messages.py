"""Messages of ROS 2, encoded as CDR: a cloud, a compressed image, the calibration of a camera and transforms.

Source: OMG, the Common Data Representation (little endian, version 1), and the definitions of `sensor_msgs`,
`geometry_msgs`, `std_msgs` and `tf2_msgs`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ladarreg_core.export.ros.mcap import TopicMessage
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, rotvec_from_rotation

CLOUD_RECORD = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("rgb", "<u4")])
"""A point of a cloud. `rgb` is 0x00RRGGBB; its field is declared as a float of the same bits, as PCL does."""
_FLOAT32 = 7  # sensor_msgs/PointField
_FOREVER = "    sec: 9223372036\n    nsec: 854775807\n"
# Keeps the last message, reliable, transient local: who subscribes later still gets it while the player runs.
_LATCHED = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"
    f"  deadline:\n{_FOREVER}  lifespan:\n{_FOREVER}  liveliness: 1\n  liveliness_lease_duration:\n{_FOREVER}"
    "  avoid_ros_namespace_conventions: false"
)

_HEADER = ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id")
_TIME = ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec")


def _definition(own: str, *contained: tuple[str, str]) -> str:
    return "".join([own, *(f"\n{'=' * 80}\nMSG: {name}\n{fields}" for name, fields in contained)]) + "\n"


_CLOUD = _definition(
    "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n"
    "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense",
    _HEADER,
    _TIME,
    (
        "sensor_msgs/PointField",
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\nuint8 FLOAT32=7\n"
        "uint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count",
    ),
)
_IMAGE = _definition("std_msgs/Header header\nstring format\nuint8[] data", _HEADER, _TIME)
_CALIBRATION = _definition(
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
    "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi",
    _HEADER,
    _TIME,
    (
        "sensor_msgs/RegionOfInterest",
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify",
    ),
)
_TRANSFORMS = _definition(
    "geometry_msgs/TransformStamped[] transforms",
    (
        "geometry_msgs/TransformStamped",
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform",
    ),
    _HEADER,
    _TIME,
    ("geometry_msgs/Transform", "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation"),
    ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z"),
    ("geometry_msgs/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class StaticTransform:
    """A fixed transform between two frames."""

    parent: str
    """The frame that the child is placed in."""
    child: str
    """The frame that is placed."""
    parent_from_child: Rigid
    """The pose of the child in the parent: it maps points of the child's frame into the parent's."""

    @property
    def xyz(self) -> list[float]:
        """The child's origin in the parent's frame, m."""
        return [float(value) for value in self.parent_from_child.translation]

    @property
    def xyzw(self) -> list[float]:
        """The unit quaternion in the order of ROS: x, y, z, w, with w not negative."""
        rotvec = rotvec_from_rotation(self.parent_from_child.rotation)
        angle = float(np.linalg.norm(rotvec))
        share = np.sin(angle / 2) / angle if angle > 1e-12 else 0.5
        q = np.append(rotvec * share, np.cos(angle / 2))
        return [float(value) for value in q / np.linalg.norm(q)]

    @property
    def rpy(self) -> list[float]:
        """Roll, pitch and yaw of URDF, rad: about the fixed axes x, then y, then z; R = Rz(yaw) Ry(pitch) Rx(roll)."""
        R = self.parent_from_child.rotation
        # Where the pitch is 90 degrees, as of an upright photograph, only roll and yaw together are determined: what is
        # left of the rotation after the yaw gives the roll that belongs to it.
        yaw = np.arctan2(R[1, 0], R[0, 0]) if np.hypot(R[0, 0], R[1, 0]) > 1e-9 else 0.0
        c, s = np.cos(yaw), np.sin(yaw)
        left = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ R
        return [
            float(np.arctan2(-left[1, 2], left[1, 1])),
            float(np.arctan2(-left[2, 0], left[0, 0])),
            float(yaw),
        ]


def cloud_message(
    topic: str, frame: str, time_ns: int, count: int, records: Iterable[bytes | memoryview]
) -> TopicMessage:
    """Return a `sensor_msgs/PointCloud2` of `count` points, whose bytes (`CLOUD_RECORD`) are given in pieces."""
    step = CLOUD_RECORD.itemsize
    names = CLOUD_RECORD.names or ()
    start = _Cdr().header(frame, time_ns).put("I", 1, count).put("I", len(names))
    for place, name in enumerate(names):  # all of four bytes
        start.text(name).put("I", 4 * place).put("B", _FLOAT32).put("I", 1)
    start.put("B", 0).put("I", step, step * count, step * count)
    before = bytes(start.data)

    def data() -> Iterable[bytes | memoryview]:
        yield before
        yield from records
        yield b"\1"  # is_dense: there is a return for every point

    size = len(before) + step * count + 1
    return _message(topic, "sensor_msgs/msg/PointCloud2", _CLOUD, data(), size)


def image_message(topic: str, frame: str, time_ns: int, form: str, encoded: bytes) -> TopicMessage:
    """Return a `sensor_msgs/CompressedImage` of an encoded image and its format (`jpeg`, `png`)."""
    start = _Cdr().header(frame, time_ns).text(form).put("I", len(encoded))
    before = bytes(start.data)
    return _message(topic, "sensor_msgs/msg/CompressedImage", _IMAGE, [before, encoded], len(before) + len(encoded))


def camera_info_message(
    topic: str, frame: str, time_ns: int, size: tuple[int, int], model: str, d: Sequence[float], k: FloatArray
) -> TopicMessage:
    """Return a `sensor_msgs/CameraInfo`; R is the identity and P is K with a fourth column of zeros.

    Args:
        topic: the topic.
        frame: the camera's optical frame.
        time_ns: the instant.
        size: (width, height), px.
        model: `plumb_bob`, `rational_polynomial` or `equidistant`.
        d: the distortion.
        k: (3, 3) camera matrix.
    """
    p = np.hstack([k, np.zeros((3, 1))])
    width, height = size
    cdr = _Cdr().header(frame, time_ns).put("I", height, width).text(model).put("I", len(d)).put("d", *d)
    cdr.put("d", *k.ravel(), *np.eye(3).ravel(), *p.ravel()).put("I", 0, 0, 0, 0, 0, 0).put("B", 0)
    return _message(topic, "sensor_msgs/msg/CameraInfo", _CALIBRATION, [bytes(cdr.data)], len(cdr.data))


def transforms_message(time_ns: int, transforms: Sequence[StaticTransform]) -> TopicMessage:
    """Return the `tf2_msgs/TFMessage` of static transforms."""
    cdr = _Cdr().put("I", len(transforms))
    for each in transforms:
        cdr.header(each.parent, time_ns).text(each.child).put("d", *each.xyz, *each.xyzw)
    return _message("/tf_static", "tf2_msgs/msg/TFMessage", _TRANSFORMS, [bytes(cdr.data)], len(cdr.data))


def _message(topic: str, kind: str, definition: str, data: Iterable[bytes | memoryview], size: int) -> TopicMessage:
    metadata = {"offered_qos_profiles": _LATCHED}
    return TopicMessage(topic=topic, type=kind, definition=definition, size=size, data=data, metadata=metadata)


class _Cdr:
    """A message under construction; numbers are aligned to their size, counted from the end of the first four bytes."""

    def __init__(self) -> None:
        self.data = bytearray(b"\0\1\0\0")  # little endian

    def put(self, kind: str, *values: float) -> _Cdr:
        """Append numbers of one type, a letter of `struct`."""
        if values:
            self.data += b"\0" * (-(len(self.data) - 4) % struct.calcsize(f"<{kind}"))
            self.data += struct.pack(f"<{len(values)}{kind}", *values)
        return self

    def text(self, value: str) -> _Cdr:
        """Append a string; its length counts the zero at its end."""
        data = value.encode("utf-8") + b"\0"
        self.put("I", len(data))
        self.data += data
        return self

    def header(self, frame: str, time_ns: int) -> _Cdr:
        """Append a `std_msgs/Header`."""
        seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
        return self.put("i", seconds).put("I", nanoseconds).text(frame)
