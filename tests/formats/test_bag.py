"""Recordings of robots, written by rosbags: three containers, one scan."""

from __future__ import annotations

import contextlib
import importlib.util
import sqlite3
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.errors import DependencyError, FormatError, OptionError, UnderspecifiedError
from ladarreg_core.formats import describe, read_scan, recognise
from ladarreg_core.formats.recordings import recording
from ladarreg_core.scan import NO_INTENSITY_NOTE, Scan
from testing.files.recordings import CLOUD, cloud, write_recording
from testing.files.small_scans import make_scan

needs_rosbags = pytest.mark.skipif(importlib.util.find_spec("rosbags") is None, reason="rosbags is not installed")
CONTAINERS = ("bag", "db3", "mcap")


def seed_files(folder: Path) -> list[Path]:
    """Write a small recording in each container; `tests/abuse` reads damaged copies of them."""
    if importlib.util.find_spec("rosbags") is None:
        return []
    wall = make_scan()
    return [record(folder / kind, kind, {"/points": [(0, organised(wall))]}) for kind in CONTAINERS]


def columns_of(scan: Scan) -> dict[str, np.ndarray]:
    points = scan.points.reshape(-1, 3).astype(np.float32)
    columns = {axis: points[:, k] for k, axis in enumerate("xyz")}
    return columns | {"intensity": scan.intensity.ravel().astype(np.float32)}


def organised(scan: Scan, **options: Any) -> dict[str, Any]:
    return {"columns": columns_of(scan), "shape": scan.shape, **options}


def record(
    folder: Path, kind: str, topics: dict[str, Sequence[tuple[int, dict[str, Any]]]], *, compressed: str = ""
) -> Path:
    """Write clouds (time in ns, arguments of `cloud`) on topics; return the file that contains them."""
    made = {topic: (CLOUD, [(when, cloud(**about)) for when, about in messages]) for topic, messages in topics.items()}
    return write_recording(folder, kind, made, compressed=compressed)


def assert_is_wall(scan: Scan, wall: Scan) -> None:
    np.testing.assert_array_equal(scan.valid, wall.valid)
    np.testing.assert_allclose(scan.points[scan.valid], wall.points[wall.valid], atol=2e-6)
    np.testing.assert_array_equal(scan.intensity, wall.intensity)


@needs_rosbags
@pytest.mark.parametrize(
    ("kind", "compressed"),
    [("bag", ""), ("bag", "bz2"), ("bag", "lz4"), ("db3", ""), ("mcap", ""), ("mcap", "storage")],
)
def test_an_organised_cloud_keeps_its_grid(tmp_path: Path, wall: Scan, kind: str, compressed: str) -> None:
    about = organised(wall, row_padding=5)
    file = record(tmp_path / "a", kind, {"/points": [(7, about)]}, compressed=compressed)
    assert recognise(file).name == "ROS bag"
    scan = read_scan(file)
    assert_is_wall(scan, wall)
    assert scan.notes == ("the topic is /points, its points are in the frame lidar",)
    if kind != "bag":
        assert_is_wall(read_scan(file.with_name("metadata.yaml")), wall)


@needs_rosbags
def test_the_check_notices_a_mirrored_cloud(tmp_path: Path, wall: Scan) -> None:
    columns = columns_of(wall)
    columns["y"] = -columns["y"]
    file = record(tmp_path / "a", "mcap", {"/points": [(7, {"columns": columns, "shape": wall.shape})]})
    with pytest.raises(AssertionError):
        assert_is_wall(read_scan(file), wall)


@needs_rosbags
@pytest.mark.parametrize("big", [False, True])
def test_both_byte_orders_give_the_same_colors(tmp_path: Path, wall: Scan, big: bool) -> None:
    packed = (np.arange(wall.valid.size) * 7919 % 2**24).astype(np.uint32)
    columns = columns_of(wall) | {"rgb": packed.view(np.float32)}
    file = record(tmp_path / "a", "db3", {"/p": [(0, {"columns": columns, "shape": wall.shape, "big": big})]})
    scan = read_scan(file)
    assert_is_wall(scan, wall)
    assert scan.color is not None
    rgb = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], axis=-1).reshape(*wall.shape, 3)
    np.testing.assert_array_equal(scan.color[scan.valid], rgb[wall.valid])


@needs_rosbags
@pytest.mark.parametrize("kind", CONTAINERS)
def test_seconds_accumulate_and_empty_clouds_are_skipped(tmp_path: Path, make: Any, kind: str) -> None:
    points, intensity, ring = make.spinning(np.arange(-8, 8, 1.5), 200)
    columns = {axis: points[:, k].astype(np.float32) for k, axis in enumerate("xyz")}
    columns |= {"intensity": intensity.astype(np.float32), "ring": ring.astype(np.uint16)}

    def part(chosen: Any) -> dict[str, Any]:
        taken = {name: values[chosen] for name, values in columns.items()}
        return {"columns": taken, "shape": (1, len(taken["x"]))}

    every = np.arange(len(points))
    halves = [(5, part(every[:0])), (10, part(every[::2])), (10 + 10**8, part(every[1::2])), (10 + 10**9, part(every))]
    file = record(tmp_path / "a", kind, {"/points": halves})
    one, both = read_scan(file), read_scan(file, seconds=1.0)
    assert both.shape[0] == one.shape[0] == 11, "a row per ring"
    assert one.valid.sum() == len(every[::2])
    assert both.valid.sum() == len(points)
    assert any("2 messages over 0.1 s" in note and "stood still" in note for note in both.notes)
    assert not any("accumulated" in note for note in one.notes)


@needs_rosbags
def test_the_topic_is_chosen(tmp_path: Path, wall: Scan) -> None:
    columns = columns_of(wall)
    near = columns | {axis: columns[axis] / 2 for axis in "xyz"}
    topics = {"/far/points": [(0, organised(wall))], "/near/points": [(1, {"columns": near, "shape": wall.shape})] * 2}
    file = record(tmp_path / "a", "mcap", topics)
    with pytest.raises(UnderspecifiedError, match=r"/far/points, /near/points.*`topic`"):
        read_scan(file)
    with pytest.raises(OptionError, match="no topic /other"):
        read_scan(file, topic="/other")
    assert describe(file).scans == ("/far/points: 1 cloud", "/near/points: 2 clouds")
    assert describe(file, topic="/far/points").returns == int(wall.valid.sum())
    assert_is_wall(read_scan(file, topic="far/points"), wall)
    half = read_scan(file, topic="/near/points")
    np.testing.assert_allclose(half.ranges[half.valid] * 2, wall.ranges[wall.valid], rtol=1e-6)


@needs_rosbags
def test_refusals_say_what_was_found(tmp_path: Path, wall: Scan) -> None:
    columns = columns_of(wall)
    del columns["intensity"]
    file = record(tmp_path / "a", "mcap", {"/points": [(0, {"columns": columns, "shape": wall.shape})]})
    with pytest.raises(FormatError, match="neither intensity nor colours"):
        read_scan(file, intensity="luma")
    assert NO_INTENSITY_NOTE in read_scan(file).notes
    other = tmp_path / "other.mcap"
    other.write_bytes(file.read_bytes().replace(b"\x04\0\0\0ros2", b"\x04\0\0\0ros1", 1))
    with pytest.raises(FormatError, match="MCAP of the profile ros1; the profile ros2 is read"):
        read_scan(other)
    other.write_bytes(file.read_bytes()[:-50])
    with pytest.raises(FormatError, match=r"not closed, or is truncated.*mcap recover"):
        read_scan(other)
    none = record(tmp_path / "none", "db3", {})
    with pytest.raises(FormatError, match="no messages"):
        read_scan(none)
    full = record(tmp_path / "full", "bag", {"/points": [(0, organised(wall))]})
    open_bag = tmp_path / "active.bag"
    start = full.read_bytes().index(b"index_pos=") + len(b"index_pos=")
    open_bag.write_bytes(full.read_bytes()[:start] + bytes(8) + full.read_bytes()[start + 8 :])
    with pytest.raises(FormatError, match="no index; repair it by `rosbag reindex`"):
        read_scan(open_bag)
    with pytest.raises(FormatError, match="would need"):
        read_scan(full, memory_bytes=200_000)


@needs_rosbags
@pytest.mark.parametrize("qos", [False, True])
def test_storage_of_earlier_releases_is_read(tmp_path: Path, wall: Scan, qos: bool) -> None:
    """Before Iron there were no message definitions in the tables, before Foxy no offered_qos_profiles."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_FOXY)
    data = bytes(store.serialize_cdr(cloud(**organised(wall))(store), CLOUD))
    more = ", offered_qos_profiles TEXT NOT NULL" if qos else ""
    with contextlib.closing(sqlite3.connect(tmp_path / "a.db3")) as base, base:
        base.execute(f"CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT{more})")
        base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        base.execute(f"INSERT INTO topics VALUES(1, '/points', ?, 'cdr'{', ?' * qos})", (CLOUD, *[""] * qos))
        base.execute("INSERT INTO messages VALUES(1, 1, 5, ?)", (data,))
    assert_is_wall(read_scan(tmp_path / "a.db3"), wall)


@needs_rosbags
def test_compressed_recordings_are_refused_with_the_way_to_unpack_them(tmp_path: Path, wall: Scan) -> None:
    each = record(tmp_path / "each", "db3", {"/points": [(0, organised(wall))]}, compressed="message")
    with pytest.raises(FormatError, match=r"compressed one by one.*ros2 bag convert"):
        read_scan(each)
    whole = record(tmp_path / "whole", "db3", {"/points": [(0, organised(wall))]}, compressed="file")
    with pytest.raises(FormatError, match="zstd -d"):
        read_scan(whole.with_name("metadata.yaml"))
    with pytest.raises(FormatError, match="zstd -d"):
        read_scan(whole.with_name(whole.name + ".zstd"))


@needs_rosbags
@pytest.mark.parametrize(("kind", "compressed"), [("bag", "bz2"), ("bag", "lz4"), ("mcap", "storage")])
def test_chunks_are_not_expanded_beyond_the_limit(
    tmp_path: Path, wall: Scan, monkeypatch: pytest.MonkeyPatch, kind: str, compressed: str
) -> None:
    file = record(tmp_path / "a", kind, {"/points": [(0, organised(wall))]}, compressed=compressed)
    monkeypatch.setattr(recording, "_LARGEST_CHUNK", 5000)
    with pytest.raises(FormatError, match="a compressed chunk expands to more than"):
        read_scan(file)


def test_without_rosbags_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    file = tmp_path / "a.bag"
    file.write_bytes(b"#ROSBAG V2.0\n" + bytes(5000))
    with pytest.raises(DependencyError, match=r"pip install ladarreg\[ros\]"):
        read_scan(file)
