"""Caches bounded by number and by bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ladarreg.gateway.protocol import Picture
from ladarreg.session.cache import BoundedCache, GroupedCache, ListCache, array_bytes, rough_bytes
from ladarreg.session.loader import Loader

from ladarreg_core.camera import Camera
from ladarreg_core.photo import Photo
from ladarreg_core.project.storage.folder import ProjectFolder
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation


def _photo(height: int, width: int) -> Photo:
    return Photo(np.zeros((height, width, 3), np.uint8), Camera.from_focal(width, height, width))


def test_the_least_recently_used_value_is_dropped_first() -> None:
    cache: BoundedCache[bytes] = BoundedCache(3, 100, len)
    for name in "abc":
        cache.put(name, name.encode() * 30)
    assert cache.get("a") == b"a" * 30
    cache.put("d", b"d" * 30)
    assert ["b" in cache, "a" in cache, len(cache), cache.bytes] == [False, True, 3, 90]
    cache.put("e", b"e" * 60)  # replaces two
    assert [name for name in "abcde" if name in cache] == ["d", "e"]
    cache.put("f", b"f" * 1000)  # exceeds the limit alone, but is the newest
    assert [name for name in "abcdef" if name in cache] == ["f"]


def test_the_total_size_follows_what_is_replaced_and_dropped() -> None:
    cache: BoundedCache[bytes] = BoundedCache(100, 1000, len)
    rng = np.random.default_rng(0)
    for _ in range(500):
        cache.put(str(rng.integers(20)), bytes(rng.integers(200)))
        if rng.random() < 0.1:
            cache.drop_oldest()
        assert cache.bytes == sum(len(cache.get(str(name)) or b"") for name in range(20))
    cache.clear()
    assert cache.bytes == 0


def test_growing_values_are_measured_again() -> None:
    cache: BoundedCache[bytearray] = BoundedCache(10, 100, len, values_grow=True)
    first = bytearray(10)
    cache.put("first", first)
    first.extend(bytes(200))
    cache.put("second", bytearray(10))
    assert "first" not in cache


def test_bytes_of_arrays_are_counted_once() -> None:
    scan = Scan(AzimuthElevation(20, 30, 0.01, 0.01), np.full((20, 30), 2.0), np.ones((20, 30)))
    before = array_bytes(scan)
    assert before >= scan.ranges.nbytes + scan.intensity.nbytes
    grown = scan.rays.nbytes + scan.points.nbytes
    assert array_bytes(scan) == before + grown
    values = np.zeros((100, 100))
    assert array_bytes({"a": values, "b": [values, values[:50]], "of": scan}) == values.nbytes
    assert array_bytes((scan, Picture(b"x" * 500, "image/png", "tag"))) == 500


def test_a_rough_size_grows_with_a_slice() -> None:
    pick = {"id": "p1", "scan": [[1.0, 2.0, 3.0]], "photo": [[5.0, 6.0]]}
    one, many = rough_bytes({"picks": [pick]}), rough_bytes({"picks": [dict(pick) for _ in range(1000)]})
    assert 300 * one < many < 2000 * one


@pytest.mark.slow
def test_large_photographs_stay_within_the_memory_limit(tmp_path: Path) -> None:
    loader = Loader(ProjectFolder(tmp_path / "project"))
    for k in range(8):
        loader.cached("photo", k, lambda: _photo(6000, 8000))  # 144 MB each
        shelf: Any = loader._cache["photo"]
        assert shelf.bytes <= 600_000_000
    assert len(shelf) == 4


def test_a_scan_that_is_dropped_takes_along_what_was_derived_from_it_alone(tmp_path: Path) -> None:
    loader = Loader(ProjectFolder(tmp_path / "project"))
    scans = [loader.cached("scan", f"station {number}", lambda: np.zeros(3)) for number in range(3)]
    for number, scan in enumerate(scans):
        loader.cached("measured", (id(scan), 7), lambda: "of a scan")
        loader.cached("view", (f"station {number}", 0), lambda: "of a scan's file")
        loader.cached("model", ("mesh", f"station {number}"), lambda: "of what is read again")

    def kept(group: str, *keys: object) -> list[bool]:
        return [key in loader._cache[group] for key in keys]

    of_scans = [(id(scan), 7) for scan in scans]
    of_files = [(f"station {number}", 0) for number in range(3)]
    assert kept("measured", *of_scans) == kept("view", *of_files) == [True, True, True]
    loader.cached("scan", "station 1", lambda: "was used since")
    loader.cached("scan", "one too many", lambda: "another scan")
    assert kept("measured", *of_scans) == kept("view", *of_files) == [False, True, True]
    assert kept("model", ("mesh", "station 0")) == [True]


def test_the_number_of_cached_lists_is_bounded() -> None:
    made: list[int] = []
    each: ListCache[int, int] = ListCache(lambda thing: made.append(thing) or thing)  # type: ignore[func-returns-value]
    things = (1, 2, 3)
    for photo in range(5000):
        each.get(photo, things)
    assert len(each._lists) <= 4096
    made.clear()
    assert each.get(999, things) == [1, 2, 3]
    assert made == []


def test_all_groups_together_stay_within_the_budget() -> None:
    """Whatever is asked for, and in whichever order: the least recently used values go first, of any group."""
    cache = GroupedCache({"a": (50, 10_000), "b": (500, 10_000), "scan": (1, 1)}, max_bytes=5_000, uncounted=("scan",))
    cache.get("scan", 0, lambda: np.zeros(100_000, np.uint8))
    for k in range(40):
        cache.get("ab"[k % 2], k, lambda: np.zeros(1_000, np.uint8))
        cache.get("a", 0, lambda: np.zeros(1_000, np.uint8))  # in use all the time
        assert cache.bytes <= 5_000
    assert [0 in cache["a"], 37 in cache["b"], 39 in cache["b"], 2 in cache["a"]] == [True, True, True, False]
    assert len(cache["scan"]) == 1
    cache.get("b", "large", lambda: np.zeros(9_000, np.uint8))
    assert cache.bytes == 9_000, "the newest stays, and alone"


def test_no_client_outgrows_the_budget_by_looking_around(tmp_path: Path) -> None:
    from ladarreg.session.loader import DEFAULT_CACHE_BYTES

    limit = 4_000_000
    assert limit < DEFAULT_CACHE_BYTES
    loader = Loader(ProjectFolder(tmp_path / "project"), cache_bytes=limit)
    rng = np.random.default_rng(0)
    for k in range(300):
        kind = ("picture", "view", "model", "photo")[rng.integers(4)]
        size = int(rng.integers(10_000, 900_000))
        loader.cached(kind, k, lambda size=size: (None, np.zeros(size, np.uint8)))  # type: ignore[misc]
        assert loader.cached_bytes <= limit
