"""The records of an E57's compressed vectors: their fields, and their values decoded strip by strip.

A compressed vector is a section of packets. Each data packet has a piece of one stream of bytes per field; the pieces
of a field, put together, are its values one after the other: floating-point numbers of 32 or 64 bits, or whole numbers
less their minimum, packed without gaps in as many bits as their bounds need, the least significant bit first. A field
whose bounds are equal takes no bits. Strips of the file are read in its order, and every stream keeps only what is not
decoded yet.

Source: ASTM E2807-11, 9 (binary sections), 10.3 (bit packing).
"""

from __future__ import annotations

import struct
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.e57.pages import E57Pages
from ladarreg_core.formats.e57.tree import E57Node
from ladarreg_core.formats.parsing.untrusted import one_line

Buffers = Mapping[str, NDArray[Any]]
"""Arrays of equal length by the path of their field."""

_SECTION = struct.Struct("<B7xQQQ")  # kind, length, data offset, index offset
_RECORDS_SECTION = 1
_INDEX, _DATA, _EMPTY = 0, 1, 2
_LARGEST_PACKET = 1 << 16
_DATA_HEADER_BYTES = 6
_STRIP_BYTES = 4 << 20
_MAX_AHEAD_BYTES = 256 << 20
_LOWEST, _HIGHEST = -(2**63), 2**63 - 1
_STRING_BITS = 8  # at least


@dataclass(frozen=True, slots=True)
class E57Field:
    """One field of records."""

    name: str
    """Its path in the prototype, with the prefix of an extension."""
    bits: float
    """Bits of one value; 0 for a constant."""
    stored: str = ""
    """`single`, `double`, `integer` or `scaled`; empty for other types."""
    minimum: int = 0
    """Smallest of whole numbers, before they are scaled."""
    maximum: int = 0
    """Largest of them."""
    scale: float = 1.0
    """Value of a scaled whole number n: `n * scale + offset`."""
    offset: float = 0.0
    """See `scale`."""


def fields_of(vector: E57Node) -> tuple[E57Field, ...]:
    """Return the fields of a compressed vector, in the order of their streams.

    Raises:
        FormatError: if the bounds of one are no bounds.
    """
    prototype = vector.child("prototype")
    return () if prototype is None else tuple(_leaves(prototype, ""))


def _leaves(node: E57Node, path: str) -> Iterator[E57Field]:
    for child in node.children:
        name = f"{path}{child.name}"
        if child.kind in ("Structure", "Vector"):
            yield from _leaves(child, f"{name}/")
        else:
            yield _field(child, name)


def _field(node: E57Node, name: str) -> E57Field:
    if node.kind == "Float":
        single = node.attributes.get("precision") == "single"
        return E57Field(name, 32 if single else 64, "single" if single else "double")
    if node.kind not in ("Integer", "ScaledInteger"):
        return E57Field(name, _STRING_BITS)
    low, high = node.whole("minimum", _LOWEST), node.whole("maximum", _HIGHEST)
    if low > high:
        raise FormatError(
            f"the E57's {one_line(name, 40)} has bounds of {low:,} to {high:,}; it is damaged: export it again"
        )
    bits = (high - low).bit_length()
    if node.kind == "Integer":
        return E57Field(name, bits, "integer", low, high)
    return E57Field(name, bits, "scaled", low, high, node.real("scale", 1.0), node.real("offset", 0.0))


def read_records(
    pages: E57Pages, vector: E57Node, targets: Buffers, what: str, *, scaled: bool
) -> Generator[int, None, None]:
    """Read the records of a compressed vector into arrays again and again; yields how many were read.

    Args:
        pages: bytes of the file.
        vector: the compressed vector.
        targets: an array for each field that is wanted, all (n,), of any numeric type: values are converted as by a
            cast, scaled ones to whole numbers by rounding.
        what: has the records, for the error message.
        scaled: scale scaled whole numbers; otherwise they stay as they are stored.

    Raises:
        FormatError: if there are fewer records than the vector claims, a field that is wanted is not a number, a page
            or packet is damaged, or the fields of a record are more than 256 MB apart.
    """
    count, done = vector.whole("recordCount"), 0
    size = min((len(target) for target in targets.values()), default=0)
    if count <= 0 or size == 0:
        return
    fields = fields_of(vector)
    streams = [_Stream(field, number) for number, field in enumerate(fields) if field.name in targets]
    filled = [stream for stream in streams if stream.field.bits]
    packets = _packets(pages, vector, what) if filled else iter(())
    most_bytes = _MAX_AHEAD_BYTES + size * sum(stream.field.bits for stream in filled) / 8
    while done < count:
        some = min(size, count - done)
        while any(stream.ready < some for stream in filled) and (packet := next(packets, None)) is not None:
            if sum(stream.append(packet) for stream in filled) > most_bytes:
                raise FormatError(
                    f"the fields of one record of {what} are stored too far apart in the E57; it is damaged, or export "
                    "it again from another program"
                )
        some = min([some, *(stream.ready for stream in filled)])
        if some == 0:
            raise FormatError(f"{what} ends after {done:,} of {count:,} points; it is truncated")
        for stream in streams:
            stream.take(some, targets[stream.field.name][:some], scaled=scaled)
        yield some
        done += some


@dataclass(frozen=True, slots=True)
class _Packet:
    """The pieces of streams in one data packet."""

    data: memoryview
    """Its bytes from the first piece on."""
    ends: tuple[int, ...]
    """Where each piece ends."""

    def piece(self, number: int) -> memoryview:
        return self.data[self.ends[number - 1] if number else 0 : self.ends[number]]


def _packets(pages: E57Pages, vector: E57Node, what: str) -> Iterator[_Packet]:
    """Yield the data packets of a compressed vector, in the file's order."""
    start = pages.logical(vector.whole("fileOffset"), what)
    kind, length, data_at, _ = _SECTION.unpack(pages.read(start, _SECTION.size, what).tobytes())
    if kind != _RECORDS_SECTION:
        raise FormatError(f"{what} is not where the XML of the E57 puts it; it is damaged: export it again")
    at, end = pages.logical(data_at, what), min(start + length, pages.logical_bytes)
    strip, strip_at = memoryview(b""), at
    while at < end:
        here = at - strip_at
        if here + _LARGEST_PACKET > len(strip) and strip_at + len(strip) < end:
            # A packet may cross the end of the strip.
            strip = pages.read(at, min(_STRIP_BYTES, end - at), what).data
            strip_at, here = at, 0
        if len(strip) - here < _DATA_HEADER_BYTES:
            return
        kind, _, less_one, streams = struct.unpack_from("<BBHH", strip, here)
        size = less_one + 1
        if kind not in (_INDEX, _DATA, _EMPTY) or size % 4 or size > len(strip) - here:
            raise _bad_packet(at, what)
        if kind == _DATA:
            yield _data_packet(strip[here : here + size], streams, at, what)
        at += size


def _data_packet(packet: memoryview, streams: int, at: int, what: str) -> _Packet:
    head = _DATA_HEADER_BYTES + 2 * streams
    if not streams or head > len(packet):
        raise _bad_packet(at, what)
    ends = tuple(np.cumsum(struct.unpack_from(f"<{streams}H", packet, _DATA_HEADER_BYTES)).tolist())
    if head + ends[-1] > len(packet):
        raise _bad_packet(at, what)
    return _Packet(packet[head:], ends)


def _bad_packet(at: int, what: str) -> FormatError:
    return FormatError(f"{what} has an invalid packet at byte {at:,} of the E57's content; it is damaged: export again")


class _Stream:
    """The values of one field that were read and not decoded yet."""

    def __init__(self, field: E57Field, number: int) -> None:
        self.field, self._number = field, number
        self._bits = int(field.bits)
        self._data = bytearray()
        self._first_bit = 0
        if not field.stored:
            raise FormatError(f"the field {one_line(field.name, 40)} of the E57 is not a number; leave it out")

    @property
    def ready(self) -> int:
        """Number of complete values."""
        return (8 * len(self._data) - self._first_bit) // self._bits

    def append(self, packet: _Packet) -> int:
        """Add the field's piece of a packet, if there is one; return how many bytes are not decoded yet."""
        if self._number < len(packet.ends):
            self._data += packet.piece(self._number)
        return len(self._data)

    def take(self, count: int, target: NDArray[Any], *, scaled: bool) -> None:
        """Decode values (count,) into an array of that length."""
        self._decode(count, target, scaled=scaled)  # on return no view prevents the bytes from being removed
        end = self._first_bit + count * self._bits
        del self._data[: end >> 3]
        self._first_bit = end & 7

    def _decode(self, count: int, target: NDArray[Any], *, scaled: bool) -> None:
        field = self.field
        if field.stored in ("single", "double"):
            _store_real(np.frombuffer(self._data, "<f4" if field.stored == "single" else "<f8", count), target, field)
            return
        whole = self._whole(count)
        if scaled and field.stored == "scaled":
            value = (whole if field.minimum == 0 else _sum(whole, field.minimum)).astype(np.float64)
            with np.errstate(over="ignore", invalid="ignore"):
                value *= field.scale
                value += field.offset
            _store_real(np.floor(value + 0.5) if target.dtype.kind in "iu" else value, target, field)
        elif field.minimum == 0:
            np.copyto(target, whole, casting="unsafe")
        elif target.dtype == np.int64:
            _sum(whole, field.minimum, out=target)
        else:
            np.copyto(target, _sum(whole, field.minimum), casting="unsafe")

    def _whole(self, count: int) -> NDArray[np.unsignedinteger[Any]]:
        """Return values (count,) less their minimum."""
        bits = self._bits
        if bits == 0:
            return np.zeros(count, np.uint8)
        if bits in (8, 16, 32, 64):
            return np.frombuffer(self._data, f"<u{bits // 8}", count)
        used = (self._first_bit + count * bits + 7) >> 3
        return unpacked(memoryview(self._data)[:used], self._first_bit, bits, count)


def unpacked(data: memoryview, first_bit: int, bits: int, count: int) -> NDArray[np.unsignedinteger[Any]]:
    """Return whole numbers (count,) that are packed without gaps, the least significant bit first.

    Args:
        data: bytes that contain them.
        first_bit: where the first one begins, 0 to 7.
        bits: of each, 1 to 64.
        count: their number.
    """
    groups = -(-count // 8)  # of eight values, which take as many bytes as a value has bits
    padded = bytearray(groups * bits + 17)
    padded[: len(data)] = data
    smallest = next(code for size, code in ((8, "u1"), (16, "u2"), (32, "u4"), (64, "u8")) if bits <= size)
    found = np.empty((groups, 8), smallest)
    word = 4 if bits <= 25 else 8
    mask = np.array((1 << bits) - 1, f"<u{word}")
    for k in range(8):
        at, shift = divmod(first_bit + k * bits, 8)
        words = np.ndarray((groups,), f"<u{word}", padded, at, (bits,))
        values = words >> np.array(shift, words.dtype) if shift else words
        if shift + bits > 8 * word:
            rest = np.ndarray((groups,), np.uint8, padded, at + word, (bits,)).astype(words.dtype)
            values = values | rest << np.array(8 * word - shift, words.dtype)
        found[:, k] = values & mask
    return found.ravel()[:count]


def _sum(whole: NDArray[Any], minimum: int, out: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
    """Return whole numbers plus their minimum, which wrap around as libe57's do where a file exceeds its bounds."""
    signed = whole.view(np.int64) if whole.dtype.itemsize == 8 else whole
    total: NDArray[np.int64] = np.add(signed, np.int64(minimum), out=out, dtype=np.int64, casting="unsafe")
    return total


def _store_real(values: NDArray[Any], target: NDArray[Any], field: E57Field) -> None:
    if target.dtype.kind in "iu" and not (np.abs(values) < 2.0**63).all():
        raise FormatError(
            f"the E57's {one_line(field.name, 40)} has values that are not whole numbers of 64 bits; it is damaged"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        np.copyto(target, values, casting="unsafe")
