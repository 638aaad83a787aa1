"""Measurements and replaced ranges belong to the scan of a station, and stay with it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ladarreg_core.errors import FormatError, OptionError
from ladarreg_core.frames import Rigid, rotation_about
from ladarreg_core.inspection.measuring.measurement import measure
from ladarreg_core.inspection.measuring.measurement_list import NamedMeasurement, in_frame, write_measurements
from ladarreg_core.inspection.measuring.points import MeasuredPoints
from ladarreg_core.project import edits
from ladarreg_core.project.document import Document
from ladarreg_core.project.inverse import ChangedSinceError, restored
from ladarreg_core.project.measurement_edits import place, with_measurement, with_one_list
from ladarreg_core.project.results import pose_entry
from ladarreg_core.project.smoothing_edits import (
    replaced_count,
    smoothing_fault,
    smoothing_sentence,
    with_smoothing,
    without_smoothings,
)
from ladarreg_core.project.source import Source
from ladarreg_core.project.station_edits import (
    partner_of,
    with_partner,
    with_rough_place,
    with_station_shown,
    with_stations,
    without_station,
)
from ladarreg_core.project.storage.codec import arrays_of, decode_document, encode
from ladarreg_core.project.storage.delta import apply_change, change_between
from ladarreg_core.quality.smoothing import Replacements
from testing.scenes.documents import a_document, a_result

RAY = place([1, 0, 0])


def two_stations() -> Document:
    sources = [Source(path=f"{name}.npz", name=f"{name}.npz", size=1) for name in ("hall", "window")]
    return with_stations(a_document(3), sources)


def measured(document: Document, station: str) -> Document:
    return with_measurement(document, "point", [RAY], station)[0]


def of_stations(document: Document) -> dict[str, str]:
    return {each.id: each.station for each in document.measurements}


def test_they_go_with_their_scan() -> None:
    document = measured(measured(measured(two_stations(), ""), "s1"), "s2")
    assert of_stations(document) == {"m1": "", "m2": "s1", "m3": "s2"}
    with pytest.raises(OptionError, match="no longer in the project"):
        measured(document, "s9")
    there = with_station_shown(document, "s1")
    (left,) = {station.id for station in there.stations} - {"s2"}
    assert of_stations(there) == {"m1": left, "m2": "", "m3": "s2"}
    assert of_stations(with_station_shown(there, left))["m1"] == ""
    assert of_stations(without_station(document, "s2")) == {"m1": "", "m2": "s1"}
    other = Source(path="attic.npz", name="attic.npz", size=1)
    assert of_stations(edits.with_scan(document, other)) == {"m2": "s1", "m3": "s2"}


def test_a_project_whose_stations_kept_them_opens_with_one_list() -> None:
    now = measured(measured(two_stations(), ""), "s1")
    fields = json.loads(encode(now))
    former = fields["measurements"].pop()
    del former["station"]
    fields["stations"][0]["measurements"] = [former]
    read = decode_document(json.dumps(fields).encode(), arrays_of(now).__getitem__)
    assert read == now
    former["station"] = "s9"
    fields["measurements"].append(former)
    with pytest.raises(FormatError, match="no station 's9', which a measurement belongs to"):
        decode_document(json.dumps(fields).encode(), arrays_of(now).__getitem__)


def test_a_history_of_an_earlier_version_is_replayed() -> None:
    before = measured(measured(two_stations(), ""), "s1")
    shown = with_station_shown(before, "s1")

    def as_then(document: Document) -> Document:
        """Return a document as earlier versions had it."""
        kept = {one.id: tuple(e for e in document.measurements if e.station == one.id) for one in document.stations}
        stations = tuple(
            msgspec.structs.replace(
                one, measurements=tuple(msgspec.structs.replace(each, station="") for each in kept[one.id])
            )
            for one in document.stations
        )
        own = tuple(each for each in document.measurements if not each.station)
        return msgspec.structs.replace(document, stations=stations, measurements=own)

    for then, after in ((before, shown), (shown, before)):
        change = json.loads(encode(change_between(as_then(then), as_then(after))))
        replayed = apply_change(then, change, arrays_of(after).__getitem__)
        assert of_stations(replayed) == of_stations(after)
        assert not any(station.measurements for station in replayed.stations)
    reordered = {"measurements": {"order": ["m1"]}}
    assert of_stations(apply_change(before, reordered, arrays_of(before).__getitem__)) == of_stations(before)
    assert with_one_list(before) is before


def test_what_two_people_do_at_two_stations_is_undone_apart() -> None:
    before = two_stations()
    mine = with_rough_place(before, "s1", Rigid.identity())
    both = with_rough_place(mine, "s2", Rigid.identity())
    back = restored(both, before, mine)
    assert (back.stations[0].rough, back.stations[1].rough is not None) == (None, True)
    again = with_rough_place(both, "s1", Rigid(rotation_about("z", 1.0), np.zeros(3)))
    with pytest.raises(ChangedSinceError):
        restored(again, before, mine)


def test_a_point_is_less_certain_in_another_frame_and_a_length_is_not() -> None:
    points = MeasuredPoints.given([[3.0, 1.0, 0.5], [4.0, -2.0, 0.0]], sigma_m=0.002)
    there = Rigid(rotation_about("z", 0.7), np.array([5.0, 1.0, 0.3]))
    sigma_m, sigma_rad = 0.006, 0.003
    moved = points.moved(there, sigma_m=sigma_m, sigma_rad=sigma_rad)
    length, former = measure("distance", moved), measure("distance", points)
    assert (length.value, length.sigma) == pytest.approx((former.value, former.sigma), rel=1e-6)
    # by draws of the place
    rng = np.random.default_rng(3)
    draws = 40_000
    turns = rng.normal(size=(draws, 3)) * sigma_rad / np.sqrt(3)
    shifts = rng.normal(size=(draws, 3)) * sigma_m / np.sqrt(3)
    own = rng.normal(size=(draws, 3)) * 0.002
    at = points.xyz[0]
    drawn = (at + np.cross(turns, at) + own) @ there.rotation.T + there.translation + shifts
    found = measure("point", moved.subset([0]))
    np.testing.assert_allclose(found.value, there @ at, atol=1e-12)
    np.testing.assert_allclose(found.sigma, drawn.std(axis=0), rtol=0.03)


def test_a_list_of_several_scans_states_them_and_draws_what_has_a_place(tmp_path: Path) -> None:
    made = measure("distance", MeasuredPoints.given([[3.0, 1.0, 0.5], [4.0, -2.0, 0.0]], sigma_m=0.002))
    one = in_frame(NamedMeasurement("", "distance", made, scan="hall.npz"), None, name="Beam")
    lost = NamedMeasurement("Sill", "distance", made, scan="attic.npz", own_frame=True)
    for suffix in (".csv", ".json", ".geojson", ".dxf"):
        write_measurements(tmp_path / f"list{suffix}", [one, lost])
    head, first, second = (tmp_path / "list.csv").read_text().splitlines()
    assert head.endswith(",flags,scan,frame")
    assert first.endswith(",hall.npz,scanner")
    assert second.endswith(",attic.npz,its own scanner")
    listed = json.loads((tmp_path / "list.json").read_text())["measurements"]
    assert [each["scan"] for each in listed] == ["hall.npz", "attic.npz"]
    assert [each.get("frame") for each in listed] == [None, "its own scanner"]
    features = json.loads((tmp_path / "list.geojson").read_text())["features"]
    assert [each["geometry"] is None for each in features] == [False, True]
    drawing = (tmp_path / "list.dxf").read_text()
    assert "Beam" in drawing
    assert "Sill" not in drawing
    write_measurements(tmp_path / "alone.csv", [replace(one, scan="")])
    assert (tmp_path / "alone.csv").read_text().splitlines()[0].endswith(",flags")


def test_ranges_are_replaced_in_the_scan_beside_the_photograph() -> None:
    document = with_partner(two_stations(), "p1", "s1", given=True)
    pose = msgspec.structs.replace(pose_entry("robust", a_result()), accepted=True, evidence="image")
    document = edits.edited_photo(document, "p1", lambda photo: edits.with_pose(photo, pose))
    found = Replacements(
        np.array([[1, 2], [3, 4]]), np.array([2.0, 3.0]), np.array([2.5, 2.5]), np.full(2, 0.01), np.zeros(2, bool)
    )
    smoothed = with_smoothing(document, "p1", found)
    assert smoothed.scan == document.scan
    assert [replaced_count(partner_of(smoothed, name)) for name in ("", "s1", "s2")] == [0, 2, 0]
    name = document.photos[0].source.name
    assert smoothing_sentence(smoothed, "s1") == f"2 ranges of hall.npz were replaced by stereo with {name}."
    assert smoothing_sentence(smoothed) == ""
    # the photograph may be beside another scan by now: the pose on which the ranges rest is kept beside theirs
    assert smoothing_fault(with_partner(smoothed, "p1", "s2", given=True), "s1") == ""
    without = edits.edited_photo(smoothed, "p1", edits.without_work)
    assert "has changed since" in smoothing_fault(without, "s1")
    assert replaced_count(partner_of(with_station_shown(smoothed, "s1"), "")) == 2
    assert without_smoothings(smoothed, "s1").stations == document.stations
    with pytest.raises(OptionError, match="nothing to restore"):
        without_smoothings(smoothed)
    back = restored(msgspec.structs.replace(smoothed, name="Office"), document, smoothed)
    assert (back.stations, back.photos) == (document.stations, document.photos)
