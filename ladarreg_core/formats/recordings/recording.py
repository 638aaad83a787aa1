"""Recordings of robots: ROS 1 bags, ROS 2 bags (SQLite, MCAP) and MCAP of the profile ros2, as topics and messages.

The containers and messages are decoded by the optional package `rosbags`. The definitions of the messages that are read
are the same in all of them, so that definitions in the file are not needed, and not trusted.
"""

from __future__ import annotations

import bz2
import io
import re
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ladarreg_core.errors import DependencyError, FormatError, OptionError, UnderspecifiedError
from ladarreg_core.formats.parsing.untrusted import inside_folder, one_line, reading

CLOUD_TYPES = ("sensor_msgs/msg/PointCloud2",)
"""Types of messages with clouds."""
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
"""Types of messages with pictures."""
CAMERA_TYPES = ("sensor_msgs/msg/CameraInfo",)
"""Types of messages with intrinsics."""
METADATA_FILE = "metadata.yaml"
"""Name of the file that describes the folder of a ROS 2 bag."""

_ROS1_MAGIC, _MCAP_MAGIC, _SQLITE_MAGIC = b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3\0"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_METADATA_KEY = b"rosbag2_bagfile_information:"
_LARGEST_CHUNK = 1 << 28  # writers make chunks of 1 to some 10 MB
_LARGEST_METADATA = 1 << 20
_MAX_LISTED = 8


def sniff_recording(head: bytes) -> bool:
    """Return whether these are the first bytes of a recording, or of the metadata.yaml of one."""
    if head.startswith(_SQLITE_MAGIC):
        return b"topics" in head and b"messages" in head  # the tables' definitions stand in the first page
    return head.startswith((_ROS1_MAGIC, _MCAP_MAGIC)) or head.lstrip().startswith(_METADATA_KEY)


@dataclass(frozen=True, slots=True)
class Message:
    """A message that is not decoded yet."""

    recorded_ns: int
    """When it was recorded, ns."""
    stamp_ns: int
    """The time in its header, ns; 0 if that was left empty."""
    raw: bytes
    """Its bytes."""


@dataclass(frozen=True, slots=True)
class Recording:
    """An open recording."""

    reader: Any
    _decode: Callable[[bytes, str], Any]
    is_ros1: bool

    def topics(self, types: tuple[str, ...]) -> dict[str, int]:
        """Return the topics with messages of some types, by name, with the number of their messages."""
        counts: dict[str, int] = {}
        for each in self.reader.connections:
            if each.msgtype in types:
                counts[each.topic] = counts.get(each.topic, 0) + each.msgcount
        return {name: counts[name] for name in sorted(counts)}

    @property
    def types(self) -> tuple[str, ...]:
        """The types of all messages, sorted."""
        return tuple(sorted({str(each.msgtype) for each in self.reader.connections}))

    def messages(self, topic: str, types: tuple[str, ...]) -> Iterator[tuple[str, Message]]:
        """Yield the type and each message with a header of a topic, in the order in which they were recorded.

        Raises:
            FormatError: if they are encoded or compressed in a way that is not read.
        """
        listed = [each for each in self.reader.connections if each.topic == topic and each.msgtype in types]
        for each in listed:
            encoding = getattr(each.ext, "serialization_format", "cdr")
            if encoding != "cdr":
                raise FormatError(f"its messages are encoded as {shown(encoding)}; cdr is read: convert the recording")
        for connection, when, raw in self.reader.messages(listed):
            if raw[:4] == _ZSTD_MAGIC:
                raise FormatError(
                    "its messages are compressed one by one, which is not read; rewrite it without compression by "
                    "`ros2 bag convert`"
                )
            yield str(connection.msgtype), Message(int(when), self._stamp_ns(raw), raw)

    def decoded(self, raw: bytes, kind: str) -> Any:
        """Return the fields of a message of a type."""
        return self._decode(raw, kind)

    def _stamp_ns(self, raw: bytes) -> int:
        """Return the time in the header that a message begins with, ns."""
        if len(raw) < 12:
            return 0
        order = "<" if self.is_ros1 or raw[1] & 1 else ">"
        seconds, nanoseconds = struct.unpack_from(f"{order}II", raw, 4)  # behind a sequence number, or the encoding
        return int(seconds) * 1_000_000_000 + int(nanoseconds)


def chosen_topic(listed: dict[str, int], asked: str | None, *, what: str, option: str) -> str:
    """Return the topic that is asked for, or the only one.

    Args:
        listed: topics with what is wanted, one or more.
        asked: a name, with or without the slash at its beginning; None: the only one.
        what: what they contain, in the plural.
        option: name of the option by which one is chosen.

    Raises:
        OptionError: if there is no such topic.
        UnderspecifiedError: if there are several, and none is asked for.
    """
    names = ", ".join(shown(name) for name in list(listed)[:_MAX_LISTED])
    if asked is not None:
        found = next((name for name in listed if name.strip("/") == asked.strip("/")), None)
        if found is None:
            raise OptionError(f"there is no topic {shown(asked)} with {what}; there is {names}")
        return found
    if len(listed) > 1:
        raise UnderspecifiedError(f"{what} are recorded on several topics ({names}); choose one by `{option}`")
    return next(iter(listed))


@contextmanager
def opened_recording(file: Path) -> Iterator[Recording]:
    """Open the storage of a recording, as `storage_of` returns it.

    Raises:
        FormatError: if it is damaged or was not closed.
        DependencyError: if rosbags is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise DependencyError(
            "recordings of robots are read by an optional package: pip install ladarreg[ros]"
        ) from None
    with open(file, "rb") as stream:
        head = stream.read(4096)
    reader: Any
    bounded: Any = _BoundedFile(file)  # sizes in the file are not to be trusted
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
            _require_end(file)
            reader = storage_mcap.McapReader(bounded)
        else:
            from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

            reader = Sqlite3Reader(file)
        reader.open()
        decode = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr
    try:
        yield Recording(reader, decode, is_ros1=head.startswith(_ROS1_MAGIC))
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


def storage_of(file: Path) -> Path:
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
        raise FormatError(f"{shown(names[0])} is compressed as a whole, which is not read; unpack it by `zstd -d`")
    if not head.startswith((_MCAP_MAGIC, _SQLITE_MAGIC)):
        raise FormatError(f"{shown(names[0])} is neither SQLite nor MCAP; convert it by `ros2 bag convert`")
    return storage


def _require_profile(head: bytes) -> None:
    """Refuse an MCAP file that was not recorded by ROS 2."""
    length = struct.unpack_from("<I", head.ljust(32, b"\0"), 17)[0]
    profile = head[21 : 21 + min(length, 64)].decode("utf-8", "replace")
    if profile != "ros2":
        found = f"of the profile {shown(profile)}" if profile else "without a profile"
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


def shown(name: object) -> str:
    """Return a name in a file for a message."""
    return one_line(name, 60) or "(no name)"
