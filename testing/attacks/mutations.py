"""Deterministically damaged copies of files; checksums of containers are recomputed, so that the damage passes them."""

from __future__ import annotations

import io
import random
import re
import zipfile
import zlib
from collections.abc import Callable

LARGEST = 1_000_000
"""Size limit of a damaged copy."""
Damage = Callable[[bytes, random.Random], bytes]

_HEADER_BYTES = 1024
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_NUMBERS_PUT = (
    b"0", b"-1", b"1", b"2", b"65535", b"65536", b"99999999", b"2147483647", b"4294967296", b"9223372036854775807",
    b"1e308", b"-1e308", b"1e999", b"1e-308", b"1e-5", b"nan", b"NaN", b"inf", b"", b"9" * 400, b"true", b"null",
    b'"7"', b"[]", b"{}",
)  # fmt: skip
_WHOLE_PUT = (
    0, 1, 2, 127, 128, 255, 256, 32767, 65535, 10**5, 10**7, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1,
)  # fmt: skip
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_E57_SIGNATURE, _E57_PAGE, _E57_SUM = b"ASTM-E57", 1024, 4


def mutated(data: bytes, *, seed: str) -> bytes:
    """Return a damaged copy; the same seed gives the same damage.

    Most copies of ZIP archives (NPZ), PNG pictures and E57 files are damaged inside and closed again with right
    checksums; the others are damaged as they are.
    """
    rng = random.Random(seed)
    inside = next((damage for sign, damage in _CONTAINERS if data.startswith(sign)), None)
    if inside is not None and rng.random() < 0.75:
        try:
            return inside(data, rng)[:LARGEST]
        except (ValueError, zlib.error, zipfile.BadZipFile):  # the seed is not a valid container
            pass
    return _damaged(data, rng)[:LARGEST]


def _damaged(data: bytes, rng: random.Random) -> bytes:
    """Return bytes after one to four changes."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        data = rng.choice(_DAMAGES)(data, rng)
    return data


def _place(data: bytes, rng: random.Random) -> int:
    """Return a position to damage; every second one is in the header."""
    most = min(len(data), _HEADER_BYTES) if rng.random() < 0.5 else len(data)
    return rng.randrange(max(most, 1))


def _flip_bit(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data or b"\0")
    changed[_place(data, rng)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _set_run(data: bytes, rng: random.Random) -> bytes:
    at, length = _place(data, rng), rng.choice((1, 2, 8, 64))
    put = rng.choice((b"\0" * length, b"\xff" * length, rng.randbytes(length)))
    return data[:at] + put + data[at + length :]


def _set_whole_number(data: bytes, rng: random.Random) -> bytes:
    at, width = _place(data, rng), rng.choice((1, 2, 4, 8))
    value = rng.choice(_WHOLE_PUT) & ((1 << 8 * width) - 1)
    return data[:at] + value.to_bytes(width, rng.choice(("little", "big"))) + data[at + width :]


def _remove(data: bytes, rng: random.Random) -> bytes:
    at = _place(data, rng)
    return data[:at] + data[at + rng.choice((1, 4, 100, 2000)) :]


def _truncate(data: bytes, rng: random.Random) -> bytes:
    return data[: _place(data, rng)]


def _insert(data: bytes, rng: random.Random) -> bytes:
    at = _place(data, rng)
    return data[:at] + rng.randbytes(rng.choice((1, 4, 300))) + data[at:]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    """Repeat a piece, up to many thousand times: long lines, deep nesting, long lists."""
    at, length = _place(data, rng), rng.choice((1, 1, 8, 60, 500))
    piece = data[at : at + length]
    times = min(rng.choice((1, 3, 100, 20_000)), LARGEST // max(length, 1))
    return data[:at] + piece * times + data[at:]


def _move(data: bytes, rng: random.Random) -> bytes:
    at, to, length = _place(data, rng), _place(data, rng), rng.choice((4, 50, 1000))
    piece = data[at : at + length]
    rest = data[:at] + data[at + length :]
    return rest[:to] + piece + rest[to:]


def _replace_number(data: bytes, rng: random.Random) -> bytes:
    """Replace a number in the text by a hostile one."""
    found = list(_NUMBER.finditer(data[: 1 << 16]))
    if not found:
        return _set_whole_number(data, rng)
    number, put = rng.choice(found), rng.choice(_NUMBERS_PUT)
    return data[: number.start()] + put + data[number.end() :]


def _remove_line(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    del lines[rng.randrange(len(lines))]
    return b"\n".join(lines)


_DAMAGES: tuple[Damage, ...] = (
    _flip_bit, _set_run, _set_whole_number, _set_whole_number, _remove, _truncate, _insert, _repeat, _move,
    _replace_number, _replace_number, _remove_line,
)  # fmt: skip


def _zip_inside(data: bytes, rng: random.Random) -> bytes:
    """Damage a member of a ZIP archive, or its name."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(sorted(members))
    if rng.random() < 0.1:
        members[name[: rng.randrange(len(name))] + "x"] = members.pop(name)
    else:
        members[name] = _damaged(members[name], rng)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, content in members.items():
            # With the time of writing, the same damage would not be the same file.
            archive.writestr(zipfile.ZipInfo(member), content, zipfile.ZIP_DEFLATED)
    return packed.getvalue()


def _png_inside(data: bytes, rng: random.Random) -> bytes:
    """Damage a chunk of a PNG image; every second time the pixel stream."""
    chunks, at = [], len(_PNG_SIGNATURE)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    k = rng.randrange(len(chunks))
    kind, content = chunks[k]
    if kind == b"IDAT" and rng.random() < 0.5:
        content = zlib.compress(_damaged(zlib.decompress(content), rng))
    else:
        content = _damaged(content, rng)
    chunks[k] = (kind, content)
    out = bytearray(_PNG_SIGNATURE)
    for kind, content in chunks:
        out += len(content).to_bytes(4, "big") + kind + content + zlib.crc32(kind + content).to_bytes(4, "big")
    return bytes(out)


def _e57_inside(data: bytes, rng: random.Random) -> bytes:
    """Damage an E57 file below the checksums of its pages; most often its XML, whose length is corrected."""
    plain = b"".join(data[k : k + _E57_PAGE - _E57_SUM] for k in range(0, len(data), _E57_PAGE))
    at = int.from_bytes(plain[24:32], "little")
    at -= _E57_SUM * (at // _E57_PAGE)  # position of the XML without the checksums before it
    length = int.from_bytes(plain[32:40], "little")
    if not 48 <= at < len(plain):
        raise ValueError("the XML does not lie in the file")
    if rng.random() < 0.7:
        xml = _damaged(plain[at : at + length], rng)[: LARGEST // 2]
        header = plain[:32] + len(xml).to_bytes(8, "little") + plain[40:48]
        changed = header + plain[48:at] + xml
    else:
        changed = _damaged(plain[:at], rng)[:at].ljust(at, b"\0") + plain[at:]
    payload = _E57_PAGE - _E57_SUM
    count = -(-len(changed) // payload)
    if rng.random() < 0.9:
        changed = changed[:16] + (count * _E57_PAGE).to_bytes(8, "little") + changed[24:]
    changed = changed.ljust(count * payload, b"\0")
    pages = [changed[k * payload : (k + 1) * payload] for k in range(count)]
    return b"".join(page + _castagnoli(page).to_bytes(_E57_SUM, "big") for page in pages)


def _castagnoli_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = (value >> 1) ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return tuple(table)


_CASTAGNOLI = _castagnoli_table()


def _castagnoli(data: bytes) -> int:
    """Return the CRC-32C of bytes."""
    value = 0xFFFFFFFF
    for byte in data:
        value = (value >> 8) ^ _CASTAGNOLI[(value ^ byte) & 255]
    return value ^ 0xFFFFFFFF


_CONTAINERS: tuple[tuple[bytes, Damage], ...] = (
    (b"PK\x03\x04", _zip_inside), (_PNG_SIGNATURE, _png_inside), (_E57_SIGNATURE, _e57_inside),
)  # fmt: skip
