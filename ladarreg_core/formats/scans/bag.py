"""Reader of the clouds in recordings of robots: one scan of a cloud, or of several of a scanner that stood still."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.untrusted import PathLike, one_line, reading, require_cells
from ladarreg_core.formats.recordings.images import camera_topic
from ladarreg_core.formats.recordings.recording import (
    CLOUD_TYPES,
    IMAGE_TYPES,
    Recording,
    chosen_topic,
    opened_recording,
    shown,
    storage_of,
)
from ladarreg_core.formats.scans.cloud import most_cells_of
from ladarreg_core.formats.scans.field_cloud import scan_of_fields
from ladarreg_core.formats.scans.scan_request import IntensitySource
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.scan import Scan

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
_MAX_FIELDS = 256
_FIXED_FRAMES = ("map", "odom", "world", "earth", "camera_init")
"""Names of frames in which clouds are no longer the scanner's."""


@dataclass(frozen=True, slots=True)
class PictureTopic:
    """A topic with pictures."""

    name: str
    """Its name."""
    messages: int
    """How many pictures it has."""
    camera: str | None
    """Topic with the intrinsics of its camera; None: there is none."""


@dataclass(frozen=True, slots=True)
class BagTopic:
    """A topic with clouds."""

    name: str
    messages: int


def bag_topics(path: PathLike) -> tuple[BagTopic, ...]:
    """Return the topics with clouds of a recording, by name.

    Raises:
        FormatError: if there are none, or it cannot be read.
        DependencyError: if rosbags is not installed.
    """
    with reading(path) as file, opened_recording(storage_of(file)) as recording:
        return tuple(BagTopic(name, count) for name, count in _topics(recording).items())


def picture_topics(path: PathLike) -> tuple[PictureTopic, ...]:
    """Return the topics with pictures of a recording, by name.

    Raises:
        FormatError: if it cannot be read.
        DependencyError: if rosbags is not installed.
    """
    with reading(path) as file, opened_recording(storage_of(file)) as recording:
        found = recording.topics(IMAGE_TYPES)
        return tuple(
            PictureTopic(name, count, camera_topic(recording, name, list(found))) for name, count in found.items()
        )


def read_bag(
    path: PathLike,
    *,
    topic: str | None = None,
    seconds: float | None = None,
    origin: tuple[float, float, float] | None = None,
    intensity: IntensitySource = "auto",
    memory_bytes: int | None = None,
    report: Report | None = None,
) -> Scan:
    """Read the clouds of a recording as one scan.

    Args:
        path: a ROS 1 bag (.bag), or the storage (.db3, .mcap of the profile ros2) or metadata.yaml of a ROS 2 bag.
        topic: topic of the clouds; None: the only one.
        seconds: duration from the first cloud over which clouds are accumulated, the scanner standing still; None: the
            first cloud that has points.
        origin: where the scanner stood, (3,) m in the coordinates of the points.
        intensity: `luma` takes the luminance of the colours.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.
        report: receives the progress.

    Returns:
        The scan, in the coordinates of the points moved to the scanner. A single organised cloud keeps its grid if its
        directions confirm it; any other cloud is gridded.

    Raises:
        FormatError: if it is damaged or of another kind, or has no cloud; `UnderspecifiedError` if several topics have.
        DependencyError: if rosbags is not installed.
    """
    with reading(path) as file:
        storage = storage_of(file)
        budget = ReadBudget.of(storage.stat().st_size, memory_bytes)
        with opened_recording(storage) as recording:
            chosen = chosen_topic(_topics(recording), topic, what="clouds", option="topic")
            read = AccumulatedClouds(budget)
            _report(report, 0)
            for kind, message in recording.messages(chosen, CLOUD_TYPES):
                when, raw = message.recorded_ns, message.raw
                budget.require(2 * len(raw), f"a message of {len(raw):,} bytes")
                if read.first is not None and (seconds is None or when - read.first >= seconds * 1e9):
                    break
                read.add(when, recording.decoded(raw, kind))
        if read.first is None:
            raise FormatError(f"no cloud of the topic {shown(chosen)} has points; choose another by `topic`")
        _report(report, 1)
        scan = read.scan(file.stem, chosen, intensity=intensity, origin=origin)
        _report(report, 2)
        return scan


@dataclass(slots=True)
class AccumulatedClouds:
    """Points of the messages of a topic so far."""

    budget: ReadBudget
    columns: dict[str, list[NDArray[Any]]] = field(default_factory=dict)
    shape: tuple[int, int] = (0, 0)
    points: int = 0
    messages: int = 0
    bytes_per_point: float = 0.0
    frame: str = ""
    first: int | None = None
    last: int = 0

    def add(self, when: int, cloud: Any) -> None:
        """Append the points of a PointCloud2 that was recorded at a time, ns; an empty one is skipped."""
        height, width = int(cloud.height), int(cloud.width)
        if height * width == 0:
            return
        require_cells(height, width)
        records = _records(cloud, height, width)
        # A point is held as a field of the message and in the concatenated column.
        self.bytes_per_point = max(self.bytes_per_point, 3.0 * records.dtype.itemsize)
        points = self.points + height * width
        most_cells_of(self.budget, points, self.bytes_per_point)
        scalars = [name for name in records.dtype.names or () if not records.dtype[name].shape]
        frame = str(cloud.header.frame_id)
        if self.first is None:
            self.first, self.shape, self.frame = when, (height, width), frame
            self.columns = {name: [] for name in scalars}
        else:
            if set(scalars) != set(self.columns) or frame != self.frame:
                raise FormatError(
                    "the fields or the frame of its clouds change within the duration; read a single message (leave "
                    "out `seconds`), or record each scanner on its own topic"
                )
            self.shape = (1, points)
        for name in self.columns:
            column = records[name]
            self.columns[name].append(column.astype(column.dtype.newbyteorder("=")).ravel())
        self.points, self.last = points, when
        self.messages += 1

    def scan(
        self, name: str, topic: str, *, intensity: IntensitySource, origin: tuple[float, float, float] | None
    ) -> Scan:
        """Return the scan of the points, of which there are some.

        Args:
            name: of the scan.
            topic: that the messages are of.
            intensity: `luma` takes the luminance of the colours.
            origin: where the scanner stood, (3,) m in the coordinates of the points.
        """
        assert self.first is not None, "there are points"
        notes = [f"the topic is {shown(topic)}, its points are in the frame {shown(self.frame)}"]
        if self.messages > 1:
            notes.append(
                f"{self.messages} messages over {(self.last - self.first) / 1e9:.3g} s were accumulated: the scanner "
                "is taken to have stood still"
            )
        return scan_of_fields(
            {name: np.concatenate(parts) for name, parts in self.columns.items()},
            self.shape,
            name=name,
            intensity=intensity,
            origin=origin,
            zero_is_stated=not self.is_in_fixed_frame,
            most_cells=most_cells_of(self.budget, self.points, self.bytes_per_point),
            notes=notes,
        )

    @property
    def is_in_fixed_frame(self) -> bool:
        """Whether the frame of the points is known not to be the scanner's."""
        return self.frame.strip("/").lower() in _FIXED_FRAMES


def _records(cloud: Any, height: int, width: int) -> NDArray[Any]:
    """Return the points of a message as records (height, width), after checking that its data contain them."""
    step, data = int(cloud.point_step), np.ascontiguousarray(cloud.data, dtype=np.uint8)
    row_step = int(cloud.row_step) if height > 1 else width * step  # of a single row it is often left at zero
    order = ">" if cloud.is_bigendian else "<"
    if not 1 <= len(cloud.fields) <= _MAX_FIELDS:
        raise FormatError(f"a cloud has {len(cloud.fields)} fields; it must have 1 to {_MAX_FIELDS}")
    names: list[str] = []
    formats: list[Any] = []
    offsets: list[int] = []
    for each in cloud.fields:
        code, count = _NUMBERS.get(int(each.datatype)), max(1, int(each.count))  # some writers leave the count at zero
        if code is None:
            raise FormatError(f"the field {shown(each.name)} is of the type {each.datatype}; PointField has 1 to 8")
        if int(each.offset) + int(code[1]) * count > step:
            raise FormatError(f"the field {shown(each.name)} lies beyond the {step} bytes of a point; it is damaged")
        names.append(each.name if each.name and each.name not in names else f"_{len(names)}")
        formats.append(f"{order}{code}" if count == 1 else (f"{order}{code}", (count,)))
        offsets.append(int(each.offset))
    if row_step < width * step or (height - 1) * row_step + width * step > data.size:
        raise FormatError(
            f"a cloud claims {width:,} x {height:,} points of {step} bytes, but its data are {data.size:,} bytes; it "
            "is damaged"
        )
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    return np.ndarray((height, width), dtype, buffer=data.data, strides=(row_step, step))


def _topics(recording: Recording) -> dict[str, int]:
    found = recording.topics(CLOUD_TYPES)
    if not found:
        types = recording.types
        has = f"only {one_line(', '.join(types), 100)}" if types else "no messages"
        raise FormatError(
            f"it has {has}; clouds are read from sensor_msgs/PointCloud2: replay it through the scanner's driver and "
            "record its clouds"
        )
    return found


def _report(report: Report | None, done: int) -> None:
    if report is not None:
        report(Progress(done, 2, "reading the recording"))
