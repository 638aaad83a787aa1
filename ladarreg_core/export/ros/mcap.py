"""Writer of MCAP files: recorded messages with their type definitions, as ROS 2 and Foxglove read them.

Every topic is one uncompressed chunk with its schema, its channel and one message. A summary with the same schemas and
channels, an index of the chunks and statistics stands at the end, as readers that do not scan a file need it.

It is written here because the writer of the package `mcap` takes each message whole: a cloud would be in memory twice.

Source: the MCAP format specification, version 0.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _CHUNK_INDEX = range(1, 9)
_STATISTICS, _METADATA, _METADATA_INDEX, _SUMMARY_OFFSET, _DATA_END = 0x0B, 0x0C, 0x0D, 0x0E, 0x0F


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicMessage:
    """A message and the topic that it is recorded on."""

    topic: str
    """Its own; two messages may not share one."""
    type: str
    """Name of its type, e.g. `sensor_msgs/msg/CameraInfo`."""
    definition: str
    """Definition of the type and of those that it contains, as `ros2msg`."""
    size: int
    """Bytes of the encoded message."""
    data: Iterable[bytes | memoryview]
    """The encoded message (CDR) in pieces, `size` bytes together; consumed once."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    """Of the channel."""


def mcap_chunks(
    messages: Sequence[TopicMessage], *, time_ns: int, metadata: Mapping[str, Mapping[str, str]]
) -> Iterator[bytes | memoryview]:
    """Yield the bytes of an MCAP file of the profile `ros2`.

    Args:
        messages: the messages, each of a topic of its own.
        time_ns: the instant at which all were recorded.
        metadata: named records of keys and values.
    """
    ids: dict[str, int] = {}
    for each in messages:
        ids.setdefault(each.type, len(ids) + 1)
    definitions = {each.type: each.definition for each in messages}
    schemas = {
        name: _record(_SCHEMA, struct.pack("<H", at) + _text(name) + _text("ros2msg") + _text(definitions[name]))
        for name, at in ids.items()
    }
    channels = [
        _record(
            _CHANNEL,
            struct.pack("<HH", number, ids[each.type]) + _text(each.topic) + _text("cdr") + _map(each.metadata),
        )
        for number, each in enumerate(messages, 1)
    ]
    head = _MAGIC + _record(_HEADER, _text("ros2") + _text("ladarreg"))
    yield head
    position, indices = len(head), []
    for number, each in enumerate(messages, 1):
        start = schemas[each.type] + channels[number - 1]
        message = struct.pack("<BQHIQQ", _MESSAGE, 22 + each.size, number, 0, time_ns, time_ns)
        size = len(start) + len(message) + each.size
        before = struct.pack("<QQQI", time_ns, time_ns, size, 0) + _text("") + struct.pack("<Q", size)
        chunk = struct.pack("<BQ", _CHUNK, len(before) + size) + before
        yield chunk + start + message
        written = 0
        for part in each.data:
            written += len(part)
            yield part
        assert written == each.size, f"the message of {each.topic} has {written} bytes, not {each.size}"
        length = len(chunk) + size
        index = _record(_MESSAGE_INDEX, struct.pack("<HIQQ", number, 16, time_ns, len(start)))
        yield index
        indices.append(
            _record(
                _CHUNK_INDEX,
                struct.pack("<QQQQ", time_ns, time_ns, position, length)
                + struct.pack("<IHQQ", 10, number, position + length, len(index))
                + _text("")
                + struct.pack("<QQ", size, size),
            )
        )
        position += length + len(index)
    named = []
    for name, entries in metadata.items():
        record = _record(_METADATA, _text(name) + _map(entries))
        named.append(_record(_METADATA_INDEX, struct.pack("<QQ", position, len(record)) + _text(name)))
        yield record
        position += len(record)
    end = _record(_DATA_END, struct.pack("<I", 0))
    yield end
    position += len(end)
    counts = b"".join(struct.pack("<HQ", number, 1) for number in range(1, len(messages) + 1))
    statistics = _record(
        _STATISTICS,
        struct.pack("<QHIIII", len(messages), len(schemas), len(channels), 0, len(metadata), len(messages))
        + struct.pack("<QQI", time_ns, time_ns, len(counts))
        + counts,
    )
    yield from _summary(position, [list(schemas.values()), channels, [statistics], indices, named])


def _summary(position: int, groups: Sequence[Sequence[bytes]]) -> Iterator[bytes]:
    """Yield the summary that begins at a position of the file, where each of its groups lies, and the end."""
    start, offsets = position, []
    for group in groups:
        data = b"".join(group)
        if data:
            offsets.append(_record(_SUMMARY_OFFSET, struct.pack("<BQQ", data[0], position, len(data))))
            yield data
            position += len(data)
    yield b"".join(offsets)
    yield _record(_FOOTER, struct.pack("<QQI", start, position, 0)) + _MAGIC


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(value: str) -> bytes:
    data = value.encode("utf-8")
    return struct.pack("<I", len(data)) + data


def _map(entries: Mapping[str, str]) -> bytes:
    data = b"".join(_text(key) + _text(value) for key, value in entries.items())
    return struct.pack("<I", len(data)) + data
