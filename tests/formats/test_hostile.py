"""Files that are missing, truncated, random or mislabelled: a one-line error, quickly, for every format."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.errors import FormatError, LadarregError, OptionError
from ladarreg_core.formats import FORMATS, describe, extract_images, read_photo, read_scan, recognise
from ladarreg_core.formats.cameras.camera_file import read_camera
from ladarreg_core.formats.documents.matches_file import read_matches
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.scan import Scan

Reader = Callable[[Path], Any]
LONGEST = 300


def photo_of(path: Path) -> Any:
    return read_photo(path, focal_px=50)


def assert_one_line(error: BaseException) -> None:
    text = str(error)
    assert isinstance(error, LadarregError)
    assert text.isprintable(), repr(text)
    assert 20 < len(text) <= LONGEST, text


def refusals(read: Reader, path: Path, contents: list[bytes]) -> int:
    """Number of refused contents; any exception other than `LadarregError` fails the test."""
    count = 0
    for content in contents:
        path.write_bytes(content)
        try:
            read(path)
        except LadarregError as error:
            assert_one_line(error)
            count += 1
    return count


@pytest.fixture(scope="module")
def good_files(tmp_path_factory: pytest.TempPathFactory, make: Any, wall: Scan) -> dict[str, tuple[Path, Reader]]:
    from PIL import Image

    folder = tmp_path_factory.mktemp("good")
    points, intensity = wall.points.reshape(-1, 3), wall.intensity.ravel()
    write_npz_xyz(folder / "scan.npz", wall)
    for encoding in ("ascii", "binary", "binary_compressed"):
        (folder / f"{encoding}.pcd").write_bytes(make.pcd(points, intensity, encoding=encoding))
    make.e57(folder / "scan.e57", make.e57_fields(wall))
    make.depth_image(folder)
    image = Image.fromarray(np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8))
    for name in ("a.jpg", "a.png", "a.tif", "a.webp"):
        image.save(folder / name)
    scans = ["scan.npz", "ascii.pcd", "binary.pcd", "binary_compressed.pcd", "scan.e57", "scan.json"]
    readers: dict[str, Reader] = dict.fromkeys(scans, read_scan) | dict.fromkeys(["a.jpg", "a.png"], photo_of)
    return {name: (folder / name, reader) for name, reader in readers.items()}


@pytest.mark.slow
def test_truncated_at_fifty_lengths(good_files: dict[str, tuple[Path, Reader]]) -> None:
    for name, (path, read) in good_files.items():
        read(path)
        data = path.read_bytes()
        lengths = np.random.default_rng(1).integers(0, len(data) - 1, 50)
        target = path.with_name(f"cut_{name}")
        assert refusals(read, target, [data[:length] for length in lengths]) == 50, name


@pytest.mark.slow
def test_bytes_changed_at_random(good_files: dict[str, tuple[Path, Reader]]) -> None:
    generator = np.random.default_rng(2)
    for name, (path, read) in good_files.items():
        data = path.read_bytes()
        contents = []
        for _ in range(30):
            changed = bytearray(data)
            for at in generator.integers(0, min(len(data), 600), 3):
                changed[at] = generator.integers(0, 256)
            contents.append(bytes(changed))
        assert refusals(read, path.with_name(f"bad_{name}"), contents) > 0, name
        refusals(describe, path.with_name(f"bad_{name}"), contents)


def test_random_bytes_after_any_beginning(
    tmp_path: Path, good_files: dict[str, tuple[Path, Reader]], wall: Scan
) -> None:
    noise = np.random.default_rng(3).bytes(5000)
    heads = [path.read_bytes()[:length] for path, _ in good_files.values() for length in (4, 48)]
    contents = [noise, b"\0" * 5000, b"{", b"[" * 5000, b'{"kind":' * 20_000, *(head + noise for head in heads)]
    readers: tuple[Reader, ...] = (
        read_scan, photo_of, describe, read_camera, read_pose, lambda path: read_matches(path, wall),
        lambda path: extract_images(path, tmp_path / "out"),
    )  # fmt: skip
    for read in readers:
        assert refusals(read, tmp_path / "noise.bin", contents) == len(contents)
    assert not (tmp_path / "out").exists()


def test_paths_that_are_not_files_are_refused(tmp_path: Path, wall: Scan) -> None:
    (tmp_path / "empty.npz").touch()
    os.mkfifo(tmp_path / "pipe.npz")
    paths = {
        "no such file": tmp_path / "gone.npz",
        "folder": tmp_path,
        "is empty": tmp_path / "empty.npz",
        "pipe": tmp_path / "pipe.npz",
        "no such file (": tmp_path / "empty.npz" / "inside.npz",
        "cannot be opened": tmp_path / ("long" * 100),
        "cannot": tmp_path / "null\0byte",
    }
    for word, path in paths.items():
        for read in (read_scan, photo_of, describe, read_camera, read_pose, lambda p: read_matches(p, wall)):
            with pytest.raises(FormatError) as caught:
                read(path)
            assert_one_line(caught.value)
            assert word in str(caught.value)


def test_odd_names_do_not_break_the_line(tmp_path: Path) -> None:
    for name in ("new\nline.npz", "bell\a.npz", "x" * 250, "\u202egnp.npz", os.fsdecode(b"\xff\xfe.npz")):
        path = tmp_path / name
        path.write_bytes(b"PK\x03\x04 nothing")
        with pytest.raises(FormatError) as caught:
            read_scan(path)
        assert_one_line(caught.value)


def test_formats_are_recognised_by_content_alone(
    tmp_path: Path, good_files: dict[str, tuple[Path, Reader]], wall: Scan
) -> None:
    for name, (path, read) in good_files.items():
        target = path.with_name(f"{name}.something")
        target.write_bytes(path.read_bytes())
        read(target)
    assert {recognise(path).kind for path, _ in good_files.values()} == {"scan", "photo"}
    assert len({f.name for f in FORMATS}) == len(FORMATS)


def test_the_wrong_kind_of_file_is_named(good_files: dict[str, tuple[Path, Reader]], tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="it is a photo"):
        read_scan(good_files["a.png"][0])
    (tmp_path / "a.glb").write_bytes(b"glTF" + bytes(20))
    with pytest.raises(FormatError, match=r"GLB model.*E57, .*NPZ, .*PCD"):
        read_scan(tmp_path / "a.glb")
    with pytest.raises(OptionError, match="contains one scan"):
        read_scan(good_files["scan.npz"][0], scan_index=1)


def test_what_is_described_agrees_with_what_is_read(good_files: dict[str, tuple[Path, Reader]]) -> None:
    for name, (path, _) in good_files.items():
        info = describe(path)
        assert (info.bytes, info.file) == (path.stat().st_size, name)
        if info.kind == "scan":
            scan = read_scan(path)
            assert info.returns == scan.valid.sum()
            assert info.range_m == (np.nanmin(scan.ranges), np.nanmax(scan.ranges))
            assert info.size == f"{scan.shape[0]} rows x {scan.shape[1]} columns"
        else:
            assert info.size == "80 x 60 pixels"


def test_claims_of_200_million_cells_cost_no_memory(tmp_path: Path, make: Any, wall: Scan) -> None:
    points, intensity = wall.points.reshape(-1, 3), wall.intensity.ravel()
    header = make.pcd(points, intensity)
    for count in (99_000_000, 200_000_000):
        text = header.replace(b"WIDTH 864", b"WIDTH %d" % count).replace(b"POINTS 864", b"POINTS %d" % count)
        (tmp_path / f"{count}.pcd").write_bytes(text)
    code = (
        "import resource, sys, pathlib\n"
        "from ladarreg_core.formats import read_scan\n"
        "from ladarreg_core.errors import FormatError\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "for path in pathlib.Path(sys.argv[1]).glob('*.pcd'):\n"
        "    try: read_scan(path)\n"
        "    except FormatError: continue\n"
        "    sys.exit('not refused')\n"
        "grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before\n"
        "sys.exit(0 if grown < 200_000 else f'{grown} KB')\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
