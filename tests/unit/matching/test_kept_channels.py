"""Channels that are kept: the same results, of data that were read again, too, and from plain arrays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.matching.images import kept_channels, photo_levels, scan_levels
from ladarreg_core.matching.images.kept_channels import forget_last_view, photo_key, view_key
from ladarreg_core.matching.images.pair import PairLevels
from ladarreg_core.matching.images.views import viewing_directions
from testing.scenes.painted_room import PaintedRoom, painted_room


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=2)


@pytest.fixture(autouse=True)
def _nothing_kept_elsewhere() -> Iterator[None]:
    forget_last_view()
    yield
    forget_last_view()


@pytest.fixture(scope="module")
def alone(room: PaintedRoom) -> lr.Registration:
    forget_last_view()
    return lr.register(room.scan, room.photo)


def again(room: PaintedRoom) -> tuple[lr.Scan, lr.Photo]:
    """Return the data as if they had been read again."""
    scan, photo = room.scan, room.photo
    return (
        replace(scan, ranges=scan.ranges.copy(), intensity=scan.intensity.copy()),
        replace(photo, pixels=photo.pixels.copy()),
    )


def assert_same(one: lr.Registration, other: lr.Registration) -> None:
    assert one.accepted
    np.testing.assert_array_equal(one.camera_from_scanner.matrix, other.camera_from_scanner.matrix)
    np.testing.assert_array_equal(one.covariance, other.covariance)
    np.testing.assert_array_equal(one.matches.uv, other.matches.uv)
    assert [(step.name, step.detail) for step in one.steps] == [(step.name, step.detail) for step in other.steps]


def make_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        pytest.fail("channels were made again")

    monkeypatch.setattr(photo_levels, "normalised_channels", fail)
    monkeypatch.setattr(kept_channels, "photo_levels", fail)


def filled(room: PaintedRoom) -> lr.Channels:
    channels = lr.Channels()
    lr.register(room.scan, room.photo, channels=channels)
    forget_last_view()
    return channels


@pytest.mark.slow
def test_the_first_registration_with_them_is_as_without(room: PaintedRoom, alone: lr.Registration) -> None:
    assert_same(lr.register(room.scan, room.photo, channels=lr.Channels()), alone)


@pytest.mark.slow
def test_a_second_one_is_the_same_and_makes_none(
    room: PaintedRoom, alone: lr.Registration, monkeypatch: pytest.MonkeyPatch
) -> None:
    channels = filled(room)
    assert len(channels) == 2
    make_none(monkeypatch)
    assert_same(lr.register(room.scan, room.photo, channels=channels), alone)
    forget_last_view()
    assert_same(lr.register(*again(room), channels=channels), alone)
    assert len(channels) == 2


@pytest.mark.slow
def test_they_go_through_plain_arrays_without_loss(
    room: PaintedRoom, alone: lr.Registration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    channels = filled(room)
    loaded = lr.Channels()
    for key in channels.keys:
        assert len(key) == 64
        held: dict[str, Any] = channels.arrays(key)
        np.savez(tmp_path / key, **held)
        with np.load(tmp_path / f"{key}.npz", allow_pickle=False) as file:
            loaded.add(key, dict(file))
    monkeypatch.setattr(kept_channels, "photo_levels", lambda *_, **__: pytest.fail("made again"))
    monkeypatch.setattr(scan_levels, "add_channels", lambda *_: pytest.fail("made again"))
    assert_same(lr.register(*again(room), channels=loaded), alone)
    assert set(loaded.keys) == set(channels.keys)
    for key in channels.keys:
        mine, theirs = channels.arrays(key), loaded.arrays(key)
        assert set(mine) == set(theirs)
        for name, array in mine.items():
            np.testing.assert_array_equal(array, theirs[name], strict=True)


def test_a_principal_point_beside_the_middle_survives_plain_arrays(room: PaintedRoom) -> None:
    """The view of a scan is centred, whatever the photograph's camera."""
    camera = replace(room.photo.pinhole, cx=room.photo.pinhole.cx + 3, cy=room.photo.pinhole.cy - 5)
    photo = replace(room.photo, camera=camera)
    alone, channels, loaded = lr.register(room.scan, photo), lr.Channels(), lr.Channels()
    forget_last_view()
    lr.register(room.scan, photo, channels=channels)
    for key in channels.keys:
        loaded.add(key, channels.arrays(key))
    assert_same(lr.register(*again(room)[:1], photo, channels=loaded), alone)


def test_keys_are_of_all_that_matters(room: PaintedRoom) -> None:
    scan, photo = room.scan, room.photo
    pair = PairLevels(scan, photo)
    working, direction = pair.working, viewing_directions(scan, pair.working)[0]
    pixels, intensity, ranges = photo.pixels.copy(), scan.intensity.copy(), scan.ranges.copy()
    pixels[5, 7, 1] ^= 1
    intensity[3, 4] += 1
    ranges[3, 4] += 0.001
    camera = photo.pinhole
    photos: list[tuple[lr.Photo, Any, int]] = [
        (photo, working, 2),
        (replace(photo, pixels=pixels), working, 2),
        (replace(photo, camera=replace(camera, cx=camera.cx + 1e-9)), working, 2),
        (photo, replace(working, cx=working.cx + 1e-9), 2),
        (photo, working, 4),
    ]
    found = [photo_key(one, how, harmonics=harmonics) for one, how, harmonics in photos]
    turned = lr.Rigid.from_rotvec((0, 0, 1e-9)) @ direction
    geometry: Any = scan.geometry
    grid = replace(geometry, d_azimuth_rad=geometry.d_azimuth_rad * (1 + 1e-9))
    views: list[tuple[lr.Scan, Any, lr.Rigid, Any, bool]] = [
        (scan, working, direction, "both", False),
        (replace(scan, ranges=ranges), working, direction, "both", False),
        (replace(scan, intensity=intensity), working, direction, "both", False),
        (replace(scan, intensity_is="range_normalised"), working, direction, "both", False),
        (replace(scan, geometry=grid), working, direction, "both", False),
        (scan, replace(working, fx=working.fx + 1e-9), direction, "both", False),
        (scan, working, turned, "both", False),
        (scan, working, direction, "geometry", False),
        (scan, working, direction, "both", True),
    ]
    found += [
        view_key(one, how, to, channel_set, coarse=coarse, harmonics=2) for one, how, to, channel_set, coarse in views
    ]
    assert len(set(found)) == len(photos) + len(views)
    other_scan, other_photo = again(room)
    assert photo_key(replace(other_photo, name="other"), working, harmonics=2) == found[0]
    assert view_key(other_scan, working, direction, "both", coarse=False, harmonics=2) == found[len(photos)]


def test_memory_is_bounded(room: PaintedRoom, alone: lr.Registration) -> None:
    nothing = lr.Channels(most_bytes=0)
    assert_same(lr.register(room.scan, room.photo, channels=nothing), alone)
    assert len(nothing) == 0
    channels = filled(room)
    arrays = {key: channels.arrays(key) for key in channels.keys}
    small = lr.Channels(most_bytes=max(sum(array.nbytes for array in entry.values()) for entry in arrays.values()))
    for key, entry in arrays.items():
        small.add(key, entry)
    assert small.keys == channels.keys[1:]


def test_what_is_no_entry_is_refused(room: PaintedRoom) -> None:
    channels = lr.Channels()
    with pytest.raises(ShapeError, match="channels 0"):
        channels.add("0" * 64, {"planes 0.0": np.zeros((2, 2), np.float32)})
    with pytest.raises(ShapeError):
        channels.add("0" * 64, {})
    with pytest.raises(KeyError):
        channels.arrays("0" * 64)
    with pytest.raises(OptionError, match="channels"):
        lr.register(room.scan, room.photo, channels={})  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="memory"):
        lr.Channels(most_bytes=-1)
