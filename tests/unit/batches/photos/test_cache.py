"""The content cache: bounded, whole or absent, and never trusted."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.batches.photos.cache import ContentCache
from ladarreg_core.errors import OptionError
from testing.scenes.small_registration import sample_scan


def entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


def test_what_is_kept_comes_back_and_its_key_depends_on_all_that_it_was_made_of(tmp_path: Path) -> None:
    cache, scan = ContentCache(tmp_path / "deep" / "cache"), sample_scan()
    key = ContentCache.key(kind="scan", files=["a"], options={"scan_index": 0})
    assert cache.get(key) is None
    assert key not in cache
    cache.put(key, scan)
    assert key in cache
    found = ContentCache(cache.folder).get(key)
    np.testing.assert_array_equal(found.ranges, scan.ranges)
    assert found.geometry == scan.geometry
    assert key != ContentCache.key(kind="scan", files=["a"], options={"scan_index": 1})
    assert key == ContentCache.key(options={"scan_index": 0}, files=["a"], kind="scan")


def _cut(data: bytes) -> bytes:
    return data[:-3]


def _flipped(data: bytes) -> bytes:
    return data[:-9] + bytes([data[-9] ^ 1]) + data[-8:]


@pytest.mark.parametrize(
    "damage", [_cut, _flipped, lambda data: b"", lambda data: data + b"x", lambda data: b"\0" * 99]
)
def test_a_damaged_entry_is_absent_and_replaced(tmp_path: Path, damage: Any) -> None:
    cache, key = ContentCache(tmp_path), ContentCache.key(kind="test")
    cache.put(key, {"values": np.arange(50.0)})
    (path,) = entries(tmp_path)
    path.write_bytes(damage(path.read_bytes()))
    assert cache.get(key) is None
    assert key not in cache
    cache.put(key, {"values": np.arange(50.0)})
    np.testing.assert_array_equal(cache.get(key)["values"], np.arange(50.0))


def test_the_entries_that_were_not_used_for_longest_give_way(tmp_path: Path) -> None:
    cache = ContentCache(tmp_path, most_bytes=2500)
    keys = [ContentCache.key(number=number) for number in range(3)]
    for number, key in enumerate(keys[:2]):
        cache.put(key, np.full(125, number, np.float64))
        os.utime(tmp_path / f"{key}.entry", (number, number))
    assert cache.get(keys[0]) is not None  # which uses it
    cache.put(keys[2], np.zeros(125))
    assert [key in cache for key in keys] == [True, False, True]
    cache.put(ContentCache.key(number=3), np.zeros(1000))
    assert len(entries(tmp_path)) == 2, "an entry beyond the bound is not kept, and drives out nothing"
    assert sum(path.stat().st_size for path in entries(tmp_path)) <= 2500


def test_what_killed_programs_left_is_removed_and_other_files_stay(tmp_path: Path) -> None:
    key = ContentCache.key(kind="test")
    left, others = tmp_path / f".{key}.999999999-0123abcd.part", tmp_path / "notes.txt"
    working = tmp_path / f".{key}.{os.getpid()}-0123abcd.part"
    for path in (left, others, working):
        path.write_bytes(b"x" * 5000)
    ContentCache(tmp_path, most_bytes=2000).put(key, np.zeros(125))
    assert not left.exists()
    assert others.exists()
    assert working.exists()


def test_nothing_is_kept_where_nothing_can_be_written(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"")
    cache = ContentCache(file / "cache")
    cache.put(ContentCache.key(kind="test"), np.zeros(3))
    assert cache.get(ContentCache.key(kind="test")) is None


def test_a_negative_bound_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="cache"):
        ContentCache(tmp_path, most_bytes=-1)
