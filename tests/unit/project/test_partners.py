"""The station that a photograph is matched with: what was done beside each is kept, known poses are carried over."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from ladarreg_core.errors import FormatError, OptionError
from ladarreg_core.frames import Rigid, rotation_about, rotvec_from_rotation
from ladarreg_core.project import edits
from ladarreg_core.project.carried import carried_pose
from ladarreg_core.project.document import Adjusted, AdjustedScanEntry, Document, PhotoEntry
from ladarreg_core.project.inverse import ChangedSinceError, restored
from ladarreg_core.project.results import pose_entry, pose_of, registration_of
from ladarreg_core.project.source import Source
from ladarreg_core.project.station_edits import (
    may_choose_partner,
    seen_from_scan,
    with_partner,
    with_station_shown,
    with_stations,
    without_station,
)
from ladarreg_core.project.storage.codec import arrays_of, decode_document, encode
from testing.scenes.documents import a_document, a_pick, a_result

PLACES = Rigid.identity(), Rigid(rotation_about("z", 0.7), np.array([3.0, -1.0, 0.2]))
"""Where the scanners of the project's scan and of its station stand."""


def surveyed(stage: str = "survey", picks: int = 3) -> Document:
    """Return a document with a photograph beside its scan, posed, and a station with a known place."""
    document = a_document(picks)
    document = with_stations(document, [Source(path="other.npz", name="other.npz", size=1)])
    pose = msgspec.structs.replace(pose_entry("robust", a_result()), stage=stage, accepted=True, evidence="image")
    document = edits.edited_photo(document, "p1", lambda photo: edits.with_pose(photo, pose))
    assert document.scan is not None
    sources = document.scan, document.stations[0].source
    scans = tuple(
        AdjustedScanEntry(source=source, world_from_scanner=tuple(map(tuple, place.matrix.tolist())))
        for source, place in zip(sources, PLACES, strict=True)
    )
    return msgspec.structs.replace(document, adjusted=Adjusted(scans=scans, photos={}))


def photo_of(document: Document) -> PhotoEntry:
    return document.photos[0]


def camera_in_world(photo: PhotoEntry, place: Rigid) -> Rigid:
    assert photo.pose is not None
    return pose_of(photo.pose) @ place.inverse


def test_what_was_done_beside_each_scan_returns_with_it() -> None:
    before = surveyed("auto")
    there = with_partner(before, "p1", "s1", given=True)
    photo = photo_of(there)
    assert (photo.station, photo.station_given, photo.picks, photo.poses) == ("s1", True, (), ())
    assert there.beside(photo).scan == there.stations[0].source
    stated = Rigid.from_matrix(np.array(photo.stated_pose))
    was = photo_of(before).pose
    assert was is not None
    assert stated.distance_to(pose_of(was) @ PLACES[1]) < 1e-12
    drawn = edits.edited_photo(there, "p1", lambda p: edits.with_picks(p, [a_pick(7)])[0])
    back = with_partner(drawn, "p1", "", given=True)
    same = ("picks", "poses", "shown_stage", "numbered", "stated_pose")
    assert [getattr(photo_of(back), name) for name in same] == [getattr(photo_of(before), name) for name in same]
    again = with_partner(back, "p1", "s1", given=True)
    assert photo_of(again).picks == photo_of(drawn).picks
    assert photo_of(again).elsewhere[0].picks == photo_of(before).picks


def test_a_pose_of_an_adjustment_stays_where_it_is_in_the_world() -> None:
    before = surveyed(picks=0)
    assert may_choose_partner(photo_of(before))
    there = with_partner(before, "p1", "s1", given=False)
    photo = photo_of(there)
    assert photo.pose is not None
    assert photo.pose.accepted
    assert photo.pose.name == photo_of(before).poses[0].name, "it is the same pose"
    world = camera_in_world(photo_of(before), PLACES[0])
    assert camera_in_world(photo, PLACES[1]).distance_to(world) < 1e-12
    seen = seen_from_scan(there, photo)
    assert (seen.station, seen.picks) == ("", ())
    assert camera_in_world(seen, PLACES[0]).distance_to(world) < 1e-12
    assert seen.pose is not None
    assert len(registration_of(seen.pose).matches) == 0, "they lie on the other scan"


def test_a_photograph_that_was_worked_on_or_given_a_station_keeps_it() -> None:
    assert not may_choose_partner(photo_of(surveyed(picks=3)))
    assert not may_choose_partner(photo_of(surveyed("auto", picks=0)))
    assert not may_choose_partner(photo_of(with_partner(surveyed(picks=0), "p1", "", given=True)))
    held = edits.with_part(surveyed(picks=0), ["p1"], "held")
    assert not may_choose_partner(photo_of(held))
    with pytest.raises(OptionError, match="held in its pose"):
        with_partner(held, "p1", "s1", given=True)
    with pytest.raises(OptionError, match="no longer in the project"):
        with_partner(held, "p1", "s9", given=True)


def test_without_a_known_place_nothing_is_carried() -> None:
    lost = msgspec.structs.replace(surveyed(picks=0), adjusted=None)
    there = with_partner(lost, "p1", "s1", given=True)
    assert (photo_of(there).poses, photo_of(there).stated_pose) == ((), None)
    assert photo_of(with_partner(there, "p1", "", given=True)).poses == photo_of(lost).poses
    placed = edits.edited_photo(there, "p1", lambda p: edits.with_pose(p, photo_of(lost).poses[0]))
    assert seen_from_scan(placed, photo_of(placed)).pose is None


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [(0.0, 0.0), (0.05, 0.02)])
def test_a_carried_covariance_is_that_of_carried_poses(sigma: tuple[float, float]) -> None:
    pose = photo_of(surveyed()).poses[0]
    spread = np.diag([1e-3, 2e-3, 1.5e-3, 0.02, 0.01, 0.03]) ** 2
    pose = msgspec.structs.replace(pose, covariance=tuple(map(tuple, spread.tolist())))
    place, source = PLACES[1], Source(path="other.npz", name="other.npz", size=1)
    found = carried_pose(pose, place, source, sigma_m=sigma[0], sigma_rad=sigma[1])
    rng, was, mean = np.random.default_rng(4), pose_of(pose), pose_of(found)
    errors = []
    for _ in range(4000):
        w, c = rng.multivariate_normal(np.zeros(6), spread).reshape(2, 3)
        true = Rigid.from_centre(Rigid.from_rotvec(w, np.zeros(3)).rotation @ was.rotation, was.centre + c)
        turn, shift = (rng.normal(0, size / np.sqrt(3), 3) for size in sigma[::-1])
        now = true @ place @ Rigid.from_rotvec(turn, shift)
        errors.append([*rotvec_from_rotation(now.rotation @ mean.rotation.T), *(now.centre - mean.centre)])
    sample = np.cov(np.array(errors).T)
    scale = np.sqrt(np.diag(sample))
    np.testing.assert_allclose(
        np.array(found.covariance) / np.outer(scale, scale), sample / np.outer(scale, scale), atol=0.1
    )


def test_showing_another_scan_keeps_photographs_with_theirs() -> None:
    document = surveyed("auto")
    document, _ = edits.with_photo(document, Source(path="second.png", name="second.png", size=1))
    document = with_partner(document, "p2", "s1", given=True)
    shown = with_station_shown(document, "s1")
    first, second = shown.photos
    assert (first.station, second.station) == ("", "")
    (left,) = first.elsewhere
    assert left.station == shown.stations[0].id
    assert left.picks == document.photos[0].picks
    back = with_station_shown(shown, shown.stations[0].id)
    assert back.photos[0].picks == document.photos[0].picks
    kept = with_partner(shown, "p2", shown.stations[0].id, given=True)
    assert with_station_shown(kept, shown.stations[0].id).photos[1].station == ""


def test_a_removed_station_lets_go_of_its_photographs() -> None:
    document = surveyed("auto")
    gone = without_station(with_partner(document, "p1", "s1", given=True), "s1")
    assert (photo_of(gone).station, photo_of(gone).elsewhere) == ("", ())
    assert photo_of(gone).picks == photo_of(document).picks
    replaced = edits.with_scan(with_partner(document, "p1", "s1", given=True), document.stations[0].source)
    assert (photo_of(replaced).station, replaced.stations) == ("", ())


def test_work_beside_all_scans_is_written_and_read() -> None:
    document = with_partner(surveyed("auto"), "p1", "s1", given=True)
    arrays = arrays_of(document)
    assert photo_of(document).elsewhere[0].poses[0].arrays.name in arrays
    assert decode_document(encode(document), arrays.__getitem__) == document
    fields = msgspec.json.decode(encode(document))
    fields["stations"] = []
    with pytest.raises(FormatError, match="no station 's1'"):
        decode_document(msgspec.json.encode(fields), arrays.__getitem__)


def test_a_step_beside_one_scan_is_not_undone_beside_another() -> None:
    before = surveyed("auto")
    after = edits.edited_photo(before, "p1", lambda p: edits.with_picks(p, [a_pick(8)])[0])
    elsewhere = with_partner(after, "p1", "s1", given=True)
    with pytest.raises(ChangedSinceError) as caught:
        restored(elsewhere, before, after)
    assert caught.value.part[:2] == ("photos", "p1")
    assert photo_of(restored(elsewhere, after, elsewhere)) == photo_of(after), "the change of the station itself"
