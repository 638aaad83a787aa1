"""What is kept on disk of photographs and stations: not made again, unless their files change."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ladarreg.session.loader import STATION_POINTS, Loader

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


def refuse() -> Any:
    raise AssertionError("it is made again")


def test_small_pictures_are_made_once(folder: ProjectFolder, tmp_path: Path) -> None:
    path = tmp_path / "photo.png"
    path.write_bytes(b"a photograph")
    entry = PhotoEntry(id="p1", source=source(path))
    picture = {"data": np.arange(9, dtype=np.uint8), "media_type": "image/webp"}
    assert Loader(folder).small_photo(entry, lambda: picture) is picture
    known: dict[str, Any] = Loader(folder).small_photo(entry, refuse)
    assert known["media_type"] == picture["media_type"]
    np.testing.assert_array_equal(known["data"], picture["data"])
    os.utime(path, ns=(1, 1))
    with pytest.raises(AssertionError, match="made again"):
        Loader(folder).small_photo(entry, refuse)
    with pytest.raises(AssertionError, match="made again"):
        Loader(folder).small_photo(PhotoEntry(id="p2", source=entry.source, camera=CameraGiven(focal_px=3)), refuse)


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
