"""Reader of the clouds in recordings of robots: ROS 1 bags, ROS 2 bags (SQLite, MCAP) and MCAP of the profile ros2.

The containers and messages are decoded by the optional package `rosbags`. The definition of sensor_msgs/PointCloud2 is
the same in all of them, so that definitions in the file are not needed, and not trusted.
"""

from __future__ import annotations

import bz2
import io
import re
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import DependencyError, FormatError, OptionError, UnderspecifiedError
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.untrusted import PathLike, inside_folder, one_line, reading, require_cells
from ladarreg_core.formats.scans.cloud import most_cells_of
from ladarreg_core.formats.scans.field_cloud import scan_of_fields
from ladarreg_core.formats.scans.scan_request import IntensitySource
from ladarreg_core.progress import Progress, Report
from ladarreg_core.scan import Scan

_ROS1_MAGIC, _MCAP_MAGIC, _SQLITE_MAGIC = b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3\0"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_METADATA_KEY = b"rosbag2_bagfile_information:"
_CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
_MAX_FIELDS = 256
_LARGEST_CHUNK = 1 << 28  # writers make chunks of 1 to some 10 MB
_LARGEST_METADATA = 1 << 20
_MAX_LISTED = 8
_FIXED_FRAMES = ("map", "odom", "world", "earth", "camera_init")  # in which clouds are no longer the scanner's


def sniff_bag(head: bytes) -> bool:
    """Return whether these are the first bytes of a recording, or of the metadata.yaml of one."""
    if head.startswith(_SQLITE_MAGIC):
        return b"topics" in head and b"messages" in head  # the tables' definitions stand in the first page
    return head.startswith((_ROS1_MAGIC, _MCAP_MAGIC)) or head.lstrip().startswith(_METADATA_KEY)


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
    with reading(path) as file, _opened(_storage_of(file)) as recording:
        return _topics(recording)


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
        storage = _storage_of(file)
        budget = ReadBudget.of(storage.stat().st_size, memory_bytes)
        with _opened(storage) as recording:
            chosen = _chosen(_topics(recording), topic)
            read = _Accumulated(budget)
            _report(report, 0)
            for when, raw in recording.clouds(chosen):
                budget.require(2 * len(raw), f"a message of {len(raw):,} bytes")
                if read.first is not None and (seconds is None or when - read.first >= seconds * 1e9):
                    break
                read.add(when, recording.decoded(raw))
        if read.first is None:
            raise FormatError(f"no cloud of the topic {_shown(chosen)} has points; choose another by `topic`")
        _report(report, 1)
        notes = [f"the topic is {_shown(chosen)}, its points are in the frame {_shown(read.frame)}"]
        if read.messages > 1:
            notes.append(
                f"{read.messages} messages over {(read.last - read.first) / 1e9:.3g} s were accumulated: the scanner "
                "is taken to have stood still"
            )
        scan = scan_of_fields(
            {name: np.concatenate(parts) for name, parts in read.columns.items()},
            read.shape,
            name=file.stem,
            intensity=intensity,
            origin=origin,
            zero_is_stated=read.frame.strip("/").lower() not in _FIXED_FRAMES,
            most_cells=most_cells_of(budget, read.points, read.bytes_per_point),
            notes=notes,
        )
        _report(report, 2)
        return scan


@dataclass(slots=True)
class _Accumulated:
    """Points of the messages so far."""

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
            raise FormatError(f"the field {_shown(each.name)} is of the type {each.datatype}; PointField has 1 to 8")
        if int(each.offset) + int(code[1]) * count > step:
            raise FormatError(f"the field {_shown(each.name)} lies beyond the {step} bytes of a point; it is damaged")
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


@dataclass(frozen=True, slots=True)
class _Recording:
    """An open recording."""

    reader: Any
    decoded: Callable[[bytes], Any]
    """Decodes the bytes of a PointCloud2."""

    def clouds(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yield the time, ns, and the bytes of each message of a topic, by time."""
        listed = [each for each in self.reader.connections if each.topic == topic and each.msgtype == _CLOUD_TYPE]
        for each in listed:
            encoding = getattr(each.ext, "serialization_format", "cdr")
            if encoding != "cdr":
                raise FormatError(f"its messages are encoded as {_shown(encoding)}; cdr is read: convert the recording")
        for _, when, raw in self.reader.messages(listed):
            if raw[:4] == _ZSTD_MAGIC:
                raise FormatError(
                    "its messages are compressed one by one, which is not read; rewrite it without compression by "
                    "`ros2 bag convert`"
                )
            yield when, raw


@contextmanager
def _opened(storage: Path) -> Iterator[_Recording]:
    """Open the storage of a recording."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise DependencyError(
            "recordings of robots are read by an optional package: pip install ladarreg[ros]"
        ) from None
    with open(storage, "rb") as stream:
        head = stream.read(4096)
    reader: Any
    bounded: Any = _BoundedFile(storage)  # sizes in the file are not to be trusted
    if head.startswith(_ROS1_MAGIC):
        from rosbags.rosbag1 import Reader, ReaderError
        from rosbags.rosbag1.reader import decompressors

        reader = Reader(bounded)
        try:
            reader.open()
        except ReaderError as error:
            if "not indexed" in str(error):
                raise FormatError("the bag was not closed and has no index; repair it by `rosbag reindex`") from None
            raise
        store = get_typestore(Stores.ROS1_NOETIC)
        limited = {decompressors["bz2"]: _expand_bz2, decompressors["lz4"]: _expand_lz4}
        for at, chunk in reader.chunks.items():
            reader.chunks[at] = chunk._replace(decompressor=limited.get(chunk.decompressor, chunk.decompressor))
        decode = store.deserialize_ros1
    else:
        if head.startswith(_MCAP_MAGIC):
            from rosbags.rosbag2 import storage_mcap

            _require_profile(head)
            # Its own functions expand whatever they are given, to any size.
            storage_mcap.DECOMPRESSORS.update(lz4=_expand_lz4, zstd=_expand_zstd)
            _require_end(storage)
            reader = storage_mcap.McapReader(bounded)
        else:
            from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

            reader = Sqlite3Reader(storage)
        reader.open()
        decode = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr
    try:
        yield _Recording(reader, lambda raw: decode(raw, _CLOUD_TYPE))
    finally:
        reader.close()


class _BoundedFile:
    """The part of a path that rosbags uses; its stream allocates no more than the file holds."""

    def __init__(self, file: Path) -> None:
        self._file = file

    def __str__(self) -> str:
        return self._file.name

    def exists(self) -> bool:
        return self._file.exists()

    def open(self, mode: str = "rb") -> io.BufferedReader:
        assert mode == "rb"
        return _BoundedStream(io.FileIO(self._file, "rb"), self._file.stat().st_size)


class _BoundedStream(io.BufferedReader):
    def __init__(self, raw: io.RawIOBase, size: int) -> None:
        super().__init__(raw)
        self._size = size

    def read(self, size: int | None = -1, /) -> bytes:
        left = max(0, self._size - self.tell())
        return super().read(left if size is None or size < 0 else min(size, left))


def _storage_of(file: Path) -> Path:
    """Return the file that holds the messages: the file itself, or the one that a metadata.yaml names."""
    with open(file, "rb") as stream:
        head = stream.read(_LARGEST_METADATA)
    if not head.lstrip().startswith(_METADATA_KEY):
        return file
    text = head.decode("utf-8", "replace")
    listed = re.search(r"^\s*relative_file_paths:\s*\n((?:\s*-[^\n]*\n)+)", text, re.MULTILINE)
    names = [line.strip().lstrip("-").strip().strip("\"'") for line in listed[1].splitlines()] if listed else []
    if len(names) != 1:
        raise FormatError(f"the recording consists of {len(names)} files; give one of them (.db3, .mcap)")
    storage = inside_folder(file.parent, names[0], "the recording's file")
    with reading(storage), open(storage, "rb") as stream:
        head = stream.read(4096)
    if head.startswith(_ZSTD_MAGIC):
        raise FormatError(f"{_shown(names[0])} is compressed as a whole, which is not read; unpack it by `zstd -d`")
    if not head.startswith((_MCAP_MAGIC, _SQLITE_MAGIC)):
        raise FormatError(f"{_shown(names[0])} is neither SQLite nor MCAP; convert it by `ros2 bag convert`")
    return storage


def _require_profile(head: bytes) -> None:
    """Refuse an MCAP file that was not recorded by ROS 2."""
    length = struct.unpack_from("<I", head.ljust(32, b"\0"), 17)[0]
    profile = head[21 : 21 + min(length, 64)].decode("utf-8", "replace")
    if profile != "ros2":
        found = f"of the profile {_shown(profile)}" if profile else "without a profile"
        raise FormatError(
            f"it is MCAP {found}; the profile ros2 is read: record it by `ros2 bag record -s mcap`, or export the "
            "clouds as PCD"
        )


def _require_end(storage: Path) -> None:
    """Refuse an MCAP file that was not closed."""
    with open(storage, "rb") as stream:
        stream.seek(max(0, storage.stat().st_size - len(_MCAP_MAGIC)))
        if stream.read() != _MCAP_MAGIC:
            raise FormatError("the recording was not closed, or is truncated: repair it by `mcap recover`")


def _topics(recording: _Recording) -> tuple[BagTopic, ...]:
    counts: dict[str, int] = {}
    for each in recording.reader.connections:
        if each.msgtype == _CLOUD_TYPE:
            counts[each.topic] = counts.get(each.topic, 0) + each.msgcount
    if not counts:
        types = sorted({str(each.msgtype) for each in recording.reader.connections})
        has = f"only {one_line(', '.join(types), 100)}" if types else "no messages"
        raise FormatError(
            f"it has {has}; clouds are read from sensor_msgs/PointCloud2: replay it through the scanner's driver and "
            "record its clouds"
        )
    return tuple(BagTopic(name, counts[name]) for name in sorted(counts))


def _chosen(topics: tuple[BagTopic, ...], asked: str | None) -> str:
    """Return the topic that is asked for, or the only one."""
    listed = ", ".join(_shown(each.name) for each in topics[:_MAX_LISTED])
    if asked is not None:
        found = next((each.name for each in topics if each.name.strip("/") == asked.strip("/")), None)
        if found is None:
            raise OptionError(f"there is no topic {_shown(asked)} with clouds; there is {listed}")
        return found
    if len(topics) > 1:
        raise UnderspecifiedError(f"clouds are recorded on several topics ({listed}); choose one by `topic`")
    return topics[0].name


def _expand_bz2(data: bytes) -> bytes:
    return _within_limit(bz2.BZ2Decompressor().decompress(data, _LARGEST_CHUNK + 1))


def _expand_lz4(data: bytes, size: int | None = None) -> bytes:
    """Expand LZ4 data of a size, bytes, that is claimed, if it is."""
    from lz4.frame import LZ4FrameDecompressor

    most = min(_LARGEST_CHUNK if size is None else size, _LARGEST_CHUNK)
    return _within_limit(bytes(LZ4FrameDecompressor().decompress(data, max_length=most + 1)))


def _expand_zstd(data: bytes, size: int) -> bytes:
    """Expand Zstandard data of a size, bytes, that is claimed."""
    from backports.zstd import ZstdDecompressor

    return _within_limit(bytes(ZstdDecompressor().decompress(data, max_length=min(size, _LARGEST_CHUNK) + 1)))


def _within_limit(data: bytes) -> bytes:
    if len(data) > _LARGEST_CHUNK:
        raise FormatError(f"a compressed chunk expands to more than {_LARGEST_CHUNK >> 20} MB; store it uncompressed")
    return data


def _shown(name: object) -> str:
    return one_line(name, 60) or "(no name)"


def _report(report: Report | None, done: int) -> None:
    if report is not None:
        report(Progress(done, 2, "reading the recording"))
