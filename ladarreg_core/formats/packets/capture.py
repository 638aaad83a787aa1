"""UDP datagrams of a network recording: pcap and pcapng, Ethernet with VLAN tags, IPv4 with fragments put together;
written as pcap."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

from ladarreg_core.errors import FormatError

_PCAP_MAGIC = {0xA1B2C3D4: 1e-6, 0xA1B23C4D: 1e-9}
_SECTION, _INTERFACE, _PACKET, _SIMPLE_PACKET, _OLD_PACKET = 0x0A0D0D0A, 1, 6, 3, 2
_BYTE_ORDER = b"\x1a\x2b\x3c\x4d"
_LARGEST_PACKET = 1 << 18
_LARGEST_BLOCK = 1 << 20
_MAX_INTERFACES = 256
_MAX_PENDING = 256
_LARGEST_DATAGRAM = 1 << 16
_MAX_FRAGMENTS = 256
_VLAN_TYPES = (0x8100, 0x88A8, 0x9100)
_IPV4_TYPE, _IPV6_TYPE = 0x0800, 0x86DD
_UDP = 17
# Bytes before the network packet, by the link type of the recording: Ethernet, Linux "any" in two versions.
_ETHERNET, _NULL, _RAW, _LOOP, _LINUX, _LINUX_2 = 1, 0, (12, 14, 101, 228), 108, 113, 276


@dataclass(frozen=True, slots=True)
class Datagram:
    """One UDP datagram."""

    source: bytes
    """IPv4 address of the sender, 4 bytes."""
    port: int
    """Port that it was sent to."""
    payload: bytes
    """Content."""


@dataclass(slots=True)
class _Pending:
    """The fragments of a datagram that have arrived."""

    pieces: dict[int, bytes] = field(default_factory=dict)
    size: int | None = None

    def joined(self) -> bytes | None:
        """Return the whole, or None while something is missing."""
        if self.size is None:
            return None
        at, parts = 0, []
        while at < self.size:
            piece = self.pieces.get(at)
            if not piece:
                return None
            parts.append(piece)
            at += len(piece)
        return b"".join(parts)


def sniff_capture(head: bytes) -> bool:
    """Return whether these are the first bytes of a pcap or pcapng file."""
    if head[:4] == _SECTION.to_bytes(4, "big"):
        return head[8:12] in (_BYTE_ORDER, _BYTE_ORDER[::-1])
    return any(int.from_bytes(head[:4], order) in _PCAP_MAGIC for order in ("little", "big"))


def datagrams(stream: BinaryIO) -> Iterator[Datagram]:
    """Yield the UDP datagrams of a recording in its order.

    Datagrams of which a fragment is missing, packets cut short by the recorder and everything that is not UDP over IPv4
    are skipped. Memory is bounded, whatever the sizes that the file claims. A recording that ends within a packet ends
    with the packet before it, as recorders that were stopped leave it.

    Args:
        stream: the file, at its start.

    Raises:
        FormatError: if it is damaged or of an unknown link type.
    """
    pending: dict[bytes, _Pending] = {}
    for link, packet in _packets(stream):
        network = _network_packet(link, packet)
        if network is None:
            continue
        whole = _transport(network, pending)
        if whole is not None and len(whole[1]) >= 8:
            source, body = whole
            length = int.from_bytes(body[4:6], "big")
            if 8 <= length <= len(body):
                yield Datagram(source, int.from_bytes(body[2:4], "big"), body[8:length])


def write_datagrams(stream: BinaryIO, received: Iterable[tuple[float, Datagram]]) -> None:
    """Write datagrams with the times at which they came, s since 1970, as a pcap recording of IPv4 packets.

    The sender's port is not known and stands as that of the receiver; the checksums are left out, as recorders do
    where the network card computes them.
    """
    stream.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, _LARGEST_PACKET, _RAW[2]))
    for time_s, datagram in received:
        size = 28 + len(datagram.payload)
        ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, size, 0, 0, 64, _UDP, 0, datagram.source, bytes(4))
        udp = struct.pack(">HHHH", datagram.port, datagram.port, size - 20, 0)
        seconds, part = divmod(round(time_s * 1e6), 1_000_000)
        stream.write(struct.pack("<IIII", seconds, part, size, size) + ip + udp + datagram.payload)


def _packets(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield the link type and the bytes of each packet."""
    magic = stream.read(4)
    if magic == _SECTION.to_bytes(4, "big"):
        yield from _pcapng_packets(stream)
        return
    order = "<" if int.from_bytes(magic, "little") in _PCAP_MAGIC else ">"
    header = stream.read(20)
    if len(header) < 20:
        raise FormatError("the recording ends within its header; it is truncated: record or copy it again")
    link = struct.unpack(f"{order}HHiIII", header)[5] & 0xFFFF
    while len(record := stream.read(16)) == 16:
        _, _, kept, sent = struct.unpack(f"{order}IIII", record)
        if kept > _LARGEST_PACKET:
            raise FormatError(
                f"the recording claims a packet of {kept:,} bytes; it is damaged: record or copy it again"
            )
        packet = stream.read(kept)
        if len(packet) == kept == sent:
            yield link, packet


def _pcapng_packets(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    order = "<"
    links: list[int] = []
    kind_bytes = _SECTION.to_bytes(4, "big")
    while len(kind_bytes) == 4:
        size_bytes = stream.read(4)
        is_section = int.from_bytes(kind_bytes, "little") == _SECTION
        if is_section:  # its byte order follows its size
            mark = stream.read(4)
            if mark not in (_BYTE_ORDER, _BYTE_ORDER[::-1]):
                raise FormatError("the recording has a section of unknown byte order; it is damaged")
            order, links = ("<" if mark == _BYTE_ORDER[::-1] else ">"), []
        if len(size_bytes) < 4:
            return
        kind, size = struct.unpack(f"{order}II", kind_bytes + size_bytes)
        if not 12 <= size <= _LARGEST_BLOCK or size % 4:
            raise FormatError(f"the recording claims a block of {size:,} bytes; it is damaged: record or copy it again")
        body = stream.read(size - 8 - 4 * is_section)
        if len(body) < size - 8 - 4 * is_section:
            return
        body = body[:-4]
        if kind == _INTERFACE and len(body) >= 8 and len(links) < _MAX_INTERFACES:
            links.append(struct.unpack(f"{order}H", body[:2])[0])
        elif kind in (_PACKET, _OLD_PACKET) and len(body) >= 20:
            index = struct.unpack(f"{order}I" if kind == _PACKET else f"{order}H", body[: 4 if kind == _PACKET else 2])[
                0
            ]
            kept, sent = struct.unpack(f"{order}II", body[12:20])
            if kept == sent and kept <= len(body) - 20 and index < len(links):
                yield links[index], body[20 : 20 + kept]
        elif kind == _SIMPLE_PACKET and len(body) >= 4 and links:
            sent = struct.unpack(f"{order}I", body[:4])[0]
            if sent <= len(body) - 4:
                yield links[0], body[4 : 4 + sent]
        kind_bytes = stream.read(4)


def _network_packet(link: int, packet: bytes) -> bytes | None:
    """Return the IPv4 packet inside a packet of the link; None where there is none."""
    if link == _ETHERNET:
        at = 12
        while int.from_bytes(packet[at : at + 2], "big") in _VLAN_TYPES:
            at += 4
        kind, start = int.from_bytes(packet[at : at + 2], "big"), at + 2
    elif link in (_NULL, _LOOP):  # the family's number, in either byte order
        kind, start = (_IPV4_TYPE if 2 in (packet[0:1] + packet[3:4]) else 0), 4
    elif link in _RAW:
        kind, start = _IPV4_TYPE, 0
    elif link == _LINUX:
        kind, start = int.from_bytes(packet[14:16], "big"), 16
        if kind in _VLAN_TYPES:
            kind, start = int.from_bytes(packet[18:20], "big"), 20
    elif link == _LINUX_2:
        kind, start = int.from_bytes(packet[0:2], "big"), 20
    else:
        raise FormatError(f"the recording is of the link type {link}, which is not read; record Ethernet frames")
    return packet[start:] if kind == _IPV4_TYPE and packet[start : start + 1] >= b"\x45" else None


def _transport(packet: bytes, pending: dict[bytes, _Pending]) -> tuple[bytes, bytes] | None:
    """Return the sender and the UDP datagram with its header, once all of its fragments have arrived."""
    if len(packet) < 20 or packet[0] >> 4 != 4 or packet[9] != _UDP:
        return None
    header, total = 4 * (packet[0] & 15), int.from_bytes(packet[2:4], "big")
    if total == 0:  # recorded before the network card cut it into pieces
        total = len(packet)
    if not 20 <= header <= total <= len(packet):
        return None
    flags = int.from_bytes(packet[6:8], "big")
    at, more = 8 * (flags & 0x1FFF), bool(flags & 0x2000)
    source, body = packet[12:16], packet[header:total]
    if at == 0 and not more:
        return source, body
    key = packet[12:20] + packet[4:6]
    joint = pending.setdefault(key, _Pending())
    if at + len(body) > _LARGEST_DATAGRAM or len(joint.pieces) >= _MAX_FRAGMENTS:
        del pending[key]
        return None
    joint.pieces[at] = body
    if not more:
        joint.size = at + len(body)
    whole = joint.joined()
    if whole is not None:
        del pending[key]
        return source, whole
    if len(pending) > _MAX_PENDING:  # the oldest has lost a fragment
        del pending[next(iter(pending))]
    return None
