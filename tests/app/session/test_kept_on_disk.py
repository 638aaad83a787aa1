"""What is kept on disk of photographs and stations: not made again, unless their files change."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from ladarreg.session.loader import STATION_POINTS, Loader
from PIL import Image

from ladarreg_core.batches.photos.cache import ContentCache
from ladarreg_core.errors import FormatError
from ladarreg_core.project.document import CameraGiven, PhotoEntry
from ladarreg_core.project.source import Source
from ladarreg_core.project.storage.folder import ProjectFolder
from ladarreg_core.simulate.sample import sample_folder


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ContentCache:
    """The user's cache, in a folder of its own."""
    found = ContentCache(tmp_path / "cache")
    monkeypatch.setattr(ContentCache, "of_user", staticmethod(lambda: found))
    return found


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[ProjectFolder]:
    found = ProjectFolder(tmp_path / "project")
    yield found
    found.close()


def source(path: Path) -> Source:
    return Source(path=str(path), name=path.name, size=path.stat().st_size)


def photograph(path: Path, brightness: int) -> PhotoEntry:
    Image.new("RGB", (60, 40), (brightness,) * 3).save(path)
    return PhotoEntry(id="p1", source=source(path), camera=CameraGiven(focal_px=70))


@pytest.fixture
def unread(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """From its call on, no photograph can be read."""

    def refuse(*_: object, **__: object) -> Any:
        raise AssertionError("it is read again")

    return lambda: monkeypatch.setattr(Loader, "_read_photo", refuse)


def test_small_pictures_are_made_once(folder: ProjectFolder, tmp_path: Path, unread: Callable[[], None]) -> None:
    entry = photograph(tmp_path / "photo.png", 90)
    made = Loader(folder).small_photo(entry)
    assert Image.open(io.BytesIO(made.data)).size == (60, 40)
    unread()
    assert Loader(folder).small_photo(entry) == made
    os.utime(tmp_path / "photo.png", ns=(1, 1))
    with pytest.raises(AssertionError, match="read again"):
        Loader(folder).small_photo(entry)
    with pytest.raises(AssertionError, match="read again"):
        Loader(folder).small_photo(PhotoEntry(id="p2", source=entry.source, camera=CameraGiven(focal_px=30)))


def test_one_reading_gives_header_and_small_picture(
    folder: ProjectFolder, tmp_path: Path, unread: Callable[[], None]
) -> None:
    entries = [photograph(tmp_path / f"{number}.png", 50 * number) for number in range(1, 5)]
    entries.append(msgspec.structs.replace(entries[0], camera=CameraGiven()))
    damaged = tmp_path / "damaged.png"
    damaged.write_bytes(b"no photograph")
    loader = Loader(folder)
    loader.preload_headers([PhotoEntry(id="p9", source=source(damaged)), *entries])
    unread()
    assert [loader.header(entry).width for entry in entries] == [60] * 5
    *known, unknown = (loader.header(entry) for entry in entries)
    assert all(one.camera is not None and one.camera.focal_px == 70 for one in known)
    assert unknown.camera is None
    assert "focal" in unknown.camera_error
    for number, entry in enumerate(entries[:4], 1):
        pixels = np.asarray(Image.open(io.BytesIO(loader.small_photo(entry).data)).convert("L"))
        assert abs(int(np.median(pixels)) - 50 * number) <= 3
    assert Loader(folder).header(entries[0]) == loader.header(entries[0])


@pytest.mark.slow
def test_points_of_a_station_are_kept_until_its_file_changes(folder: ProjectFolder, tmp_path: Path) -> None:
    path = tmp_path / "station.npz"
    shutil.copy(sample_folder() / "scan.npz", path)
    station = source(path)
    points = Loader(folder).station_points(station)
    assert 1000 < len(points) <= STATION_POINTS
    stamp = path.stat().st_mtime_ns
    path.write_bytes(b"-" * path.stat().st_size)
    os.utime(path, ns=(stamp, stamp))  # as if it were the same file still
    np.testing.assert_array_equal(Loader(folder).station_points(station), points)
    os.utime(path, ns=(stamp + 10**9, stamp + 10**9))
    with pytest.raises(FormatError):
        Loader(folder).station_points(station)
