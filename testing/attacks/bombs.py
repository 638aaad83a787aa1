"""Small files that claim, or expand to, very large scans and images; measurement of the cost of reading them."""

from __future__ import annotations

import io
import json
import math
import re
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_ZEROS = bytes(1 << 20)
_E57_PAGE, _E57_PAGE_DATA = 1024, 1020


def camera_fields(width: int, height: int) -> dict[str, float]:
    """Return a pinhole camera of a given size."""
    return {"width": width, "height": height, "fx": width, "fy": width, "cx": width / 2, "cy": height / 2}


def e57_of_constants(path: Path, *, points: int, grid: bool = False, padding: int = 0) -> Path:
    """Write an E57 whose fields all have a single possible value, so that its points take no bits."""
    from pye57 import libe57

    names = ["cartesianX", "cartesianY", "cartesianZ", "intensity", *(["rowIndex", "columnIndex"] if grid else [])]
    file = libe57.ImageFile(str(path), "w")
    root = file.root()
    root.set("formatName", libe57.StringNode(file, "ASTM E57 3D Imaging Data File"))
    root.set("guid", libe57.StringNode(file, "{00000000-0000-0000-0000-000000000000}"))
    root.set("versionMajor", libe57.IntegerNode(file, 1))
    root.set("versionMinor", libe57.IntegerNode(file, 0))
    scans = libe57.VectorNode(file, True)
    root.set("data3D", scans)
    scan = libe57.StructureNode(file)
    scan.set("guid", libe57.StringNode(file, "{00000000-0000-0000-0000-000000000001}"))
    scans.append(scan)
    prototype = libe57.StructureNode(file)
    for name in names:
        prototype.set(name, libe57.IntegerNode(file, 0, 0, 1))
    records = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
    scan.set("points", records)
    buffers = libe57.VectorSourceDestBuffer()
    columns = [np.zeros(10, "q") for _ in names]
    for name, column in zip(names, columns, strict=True):
        buffers.append(libe57.SourceDestBuffer(file, name, column, 10, True, True))
    writer = records.writer(buffers)
    writer.write(10)
    writer.close()
    file.close()

    def grown(xml: bytes) -> bytes:
        xml = xml.replace(b'recordCount="10"', b'recordCount="%d"' % points)
        xml = xml.replace(b'minimum="0" maximum="1"/>', b'minimum="1" maximum="1">1</>')
        for name in names:
            xml = re.sub(rb"(<%b .*)</>" % name.encode(), rb"\1</%b>" % name.encode(), xml)
        return xml.replace(b"<data3D", b'<note type="String"><![CDATA[' + b"." * padding + b"]]></note>\n<data3D")

    return e57_with_xml(path, grown)


def e57_with_xml(path: Path, change: Callable[[bytes], bytes]) -> Path:
    """Replace the XML of an E57 file, with the checksums of its pages."""
    pages = np.frombuffer(path.read_bytes(), np.uint8).reshape(-1, _E57_PAGE)
    data = pages[:, :_E57_PAGE_DATA].tobytes()
    xml_at, xml_length = struct.unpack_from("<QQ", data, 24)
    start = xml_at // _E57_PAGE * _E57_PAGE_DATA + xml_at % _E57_PAGE
    xml = change(data[start : start + xml_length])
    data = data[:start] + xml
    data += b"\0" * (-len(data) % _E57_PAGE_DATA)
    count = len(data) // _E57_PAGE_DATA
    data = data[:16] + struct.pack("<QQQ", count * _E57_PAGE, xml_at, len(xml)) + data[40:]
    parts = [data[k : k + _E57_PAGE_DATA] for k in range(0, len(data), _E57_PAGE_DATA)]
    path.write_bytes(b"".join(part + struct.pack(">I", _crc32c(part)) for part in parts))
    return path


def e57_of_many_elements(path: Path, *, children: int) -> Path:
    """Write an E57 whose XML has one element with very many children."""
    flood = b"".join(b'<a%d type="Integer"/>' % k for k in range(children))
    return e57_with_xml(e57_of_constants(path, points=10), lambda xml: xml.replace(b"<data3D", flood + b"<data3D"))


def e57_of_one_picture(path: Path, *, times: int, length: int) -> Path:
    """Write an E57 that lists the same bytes as an image many times."""
    blob = b'<jpegImage type="Blob" fileOffset="48" length="%d"/>' % length
    shape = b'<visualReferenceRepresentation type="Structure">' + blob + b"</visualReferenceRepresentation>"
    entries = (b'<vectorChild type="Structure">' + shape + b"</vectorChild>") * times
    images = b'<images2D type="Vector">' + entries + b"</images2D>"
    return e57_with_xml(e57_of_constants(path, points=10), lambda xml: xml.replace(b"<data3D", images + b"<data3D"))


def _crc32c(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc = _CRC32C[(crc ^ byte) & 255] ^ crc >> 8
    return crc ^ 0xFFFFFFFF


def _crc32c_table() -> list[int]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return table


_CRC32C = _crc32c_table()


def blank_png(path: Path, width: int, height: int, *, bits: int = 8, colors: int = 1) -> Path:
    """Write a PNG of one colour: about a thousandth of the size of its pixels."""
    row = 1 + (width * bits * colors + 7) // 8
    packer = zlib.compressobj(9)
    body = bytearray()
    left = row * height
    while left:
        part = min(left, len(_ZEROS))
        body += packer.compress(_ZEROS[:part])
        left -= part
    body += packer.flush()
    header = struct.pack(">IIBBBBB", width, height, bits, 2 if colors == 3 else 0, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", bytes(body)), (b"IEND", b""))
    framed = (struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(framed))
    return path


def jpeg_of_many_passes(path: Path, *, side: int, passes: int) -> Path:
    """Write a progressive JPEG that refines a gray image many times, in passes of a few bytes each."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.new("L", (side, side), 90).save(buffer, "JPEG", progressive=True, optimize=True)
    data = buffer.getvalue()
    last = data.rindex(b"\xff\xda")
    table = data.rfind(b"\xff\xc4", 0, last)
    repeated = data[table if table > 0 else last : -2]
    path.write_bytes(data[:-2] + repeated * passes + data[-2:])
    return path


def npz_of_zeros(path: Path, shapes: Mapping[str, tuple[tuple[int, ...], str]], **scalars: float) -> Path:
    """Write an NPZ of arrays of zeros, by name (shape, NumPy type), and of scalars."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, (shape, code) in shapes.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                header = {"descr": code, "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(stream, header)  # type: ignore[arg-type]
                left = math.prod(shape) * np.dtype(code).itemsize
                while left:
                    part = min(left, len(_ZEROS))
                    stream.write(_ZEROS[:part])
                    left -= part
        for name, value in scalars.items():
            with archive.open(f"{name}.npy", "w") as stream:
                np.lib.format.write_array(stream, np.array(value))
    return path


def counts_npz(path: Path, rows: int, columns: int) -> Path:
    """Write an NPZ scan in the counts form that is all zeros."""
    shapes = {"intensity": ((rows, columns), "|u1"), "counts": ((rows, columns), "|u1")}
    return npz_of_zeros(path, shapes, r0_m=1.0, dr_m=0.01, d_azimuth_rad=1e-5, d_elevation_rad=1e-5)


def xyz_npz(path: Path, rows: int, columns: int) -> Path:
    """Write an NPZ scan in the xyz form that is all zeros."""
    return npz_of_zeros(path, {"intensity": ((rows, columns), "|u1"), "xyz": ((rows, columns, 3), "|i1")})


def npz_of_long_header(path: Path, *, header_bytes: int) -> Path:
    """Write an NPZ whose first array has a header of a given length."""
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive,
        archive.open("intensity.npy", "w", force_zip64=True) as stream,
    ):
        stream.write(b"\x93NUMPY\x02\x00" + struct.pack("<I", header_bytes))
        left = header_bytes
        while left:
            part = min(left, len(_ZEROS))
            stream.write(_ZEROS[:part])
            left -= part
    return path


def compressed_pcd(path: Path, *, width: int, height: int) -> Path:
    """Write a PCD cloud whose compressed body is one long repetition: 3 bytes expand to 264."""
    count = width * height
    size = 16 * count
    # A first value of 1.0 as a float, then copies from 4 bytes back.
    body = bytearray(b"\x03" + struct.pack("<f", 1.0))
    left = size - 4
    body += (bytes([7 << 5, 255, 3])) * (left // 264)
    left %= 264
    for _ in range(left):
        body += b"\x00\x00"
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\n"
        f"COUNT 1 1 1 1\nWIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\n"
        "DATA binary_compressed\n"
    )
    path.write_bytes(header.encode() + struct.pack("<II", len(body), size) + body)
    return path


def depth_image(folder: Path, width: int, height: int) -> Path:
    """Write a descriptor of a depth image, with two blank images."""
    folder.mkdir(exist_ok=True)
    blank_png(folder / "depth.png", width, height, bits=16)
    blank_png(folder / "intensity.png", width, height)
    fields = {
        "kind": "depth-image",
        "depth": "depth.png",
        "depth_unit_m": 0.001,
        "depth_is": "z",
        "intensity": "intensity.png",
        "camera": {**camera_fields(width, height), "distortion": [0.1, -0.05, 0.001, 0.001, 0.01, 0.1, 0.01, 0.001]},
    }
    (folder / "scan.json").write_text(json.dumps(fields))
    return folder / "scan.json"


def long_camera_yaml(path: Path, *, size: int) -> Path:
    """Write a camera file of one long line without a colon."""
    path.write_bytes(b"camera_matrix" + b" " * size + b"x")
    return path


def matches_json(path: Path, *, count: int) -> Path:
    """Write a matches file with a given number of points."""
    entry = '{"scan": [1.0, 0.01, 0.02], "photo": [10.25, 20.5]}'
    path.write_text('{"version": 1, "scan_coordinates": "ray", "matches": [' + ",\n".join([entry] * count) + "]}")
    return path


def matches_csv(path: Path, *, count: int) -> Path:
    """Write a CSV matches file with a given number of points."""
    path.write_text("x,y,z,u,v\n" + "1.0,0.01,0.02,10.25,20.5\n" * count)
    return path


@dataclass(frozen=True, slots=True)
class Cost:
    """Cost of reading a file in a separate process."""

    seconds: float
    """Processor time."""
    peak_bytes: int
    """Peak memory in addition to that of the idle process."""
    outcome: str
    """The error's text, or `read`."""


READERS = {
    "scan": "read_scan(path)",
    "photo": "read_photo(path, focal_px=20000)",
    "describe": "describe(path)",
    "camera": "read_camera(path)",
    "matches": "read_matches(path, wall())",
    "extract": "extract_images(path, path + '.images')",
}
_PROGRAM = """
import json, os, resource, sys
import numpy as np
import cv2, scipy.spatial, PIL.Image
from ladarreg_core.errors import LadarregError
from ladarreg_core.formats import describe, extract_images, read_photo, read_scan
from ladarreg_core.formats.cameras.camera_file import read_camera
from ladarreg_core.formats.documents.matches_file import read_matches
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation

def wall():
    return Scan(AzimuthElevation(24, 36, .012, .01), np.full((24, 36), 3.0), np.ones((24, 36)))

def status(name):
    try:
        lines = open("/proc/self/status").read().splitlines()
        return next(int(line.split()[1]) << 10 for line in lines if line.startswith(name))
    except OSError:
        largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return largest if sys.platform == "darwin" else largest << 10

def seconds():
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime

def measure(code, path):
    before, started = status("VmRSS"), seconds()
    try:
        eval(code, {**globals(), "path": path})
        outcome = "read"
    except LadarregError as error:
        outcome = f"{type(error).__name__}: {error}"
    print(json.dumps([seconds() - started, status("VmHWM") - before, outcome]), flush=True)

PIL.Image.init()
jobs, most_bytes, most_seconds = json.loads(sys.argv[1])
for code, path in jobs:
    child = os.fork()
    if child == 0:
        if sys.platform == "linux":
            resource.setrlimit(resource.RLIMIT_AS, (most_bytes, most_bytes))
        resource.setrlimit(resource.RLIMIT_CPU, (most_seconds, most_seconds))
        try:
            measure(code, path)
        finally:
            os._exit(0)
    ended = os.waitpid(child, 0)[1]
    if ended != 0:
        print(json.dumps([1e9, 1e18, f"the process ended with {ended}"]), flush=True)
"""


def costs_of(jobs: Sequence[tuple[str, Path]], *, most_bytes: int = 12 << 30, most_seconds: int = 120) -> list[Cost]:
    """Read files, each in a separate process, and return the cost; not on Windows.

    Args:
        jobs: (one of `READERS`, the file).
        most_bytes: where each process's address space ends.
        most_seconds: where its processor time ends.
    """
    words = json.dumps([[(READERS[reader], str(path)) for reader, path in jobs], most_bytes, most_seconds])
    done = subprocess.run([sys.executable, "-c", _PROGRAM, words], capture_output=True, text=True, check=True)
    costs = [Cost(*json.loads(line)) for line in done.stdout.splitlines()]
    assert len(costs) == len(jobs), done.stderr
    return costs


def cost_of(reader: str, path: Path) -> Cost:
    """Read one file in a separate process, and return the cost."""
    return costs_of([(reader, path)])[0]
