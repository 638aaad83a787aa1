"""Documents of a project: what is written is read again, and what is not within bounds is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError, FormatError, LadarregError, OptionError
from ladarreg_core.matches import Matches, Pick, unit_rays
from ladarreg_core.project import edits
from ladarreg_core.project.document import CameraGiven, Document, PhotoEntry, Survey
from ladarreg_core.project.results import pose_entry, registration_of, solved_on
from ladarreg_core.project.settings import Settings
from ladarreg_core.project.source import Source
from ladarreg_core.project.staleness import changed_since, rests_on, stale
from ladarreg_core.project.station_edits import is_stale, place_of, with_stations
from ladarreg_core.project.storage.codec import decode_document, encode
from ladarreg_core.project.storage.delta import check_readable
from ladarreg_core.project.stored_arrays import StoredArrays
from testing.scenes.documents import SOURCE, a_document, a_pick, a_result, with_an_answer


def reading(document: Document) -> Document:
    arrays = {pose.arrays.name: pose.arrays for photo in document.photos for pose in photo.poses}
    return decode_document(encode(document), arrays.__getitem__)


def test_what_is_written_is_read_again() -> None:
    document = with_an_answer(a_document())
    assert reading(document) == document


def test_a_result_is_read_back_completely() -> None:
    result = a_result()
    back = registration_of(pose_entry("robust", result))
    assert back.camera_from_scanner.matrix == pytest.approx(result.camera_from_scanner.matrix, abs=0)
    for name in ("inliers", "residuals_px", "residuals_m", "stereo_depth_error_m", "covariance"):
        np.testing.assert_array_equal(getattr(back, name), getattr(result, name))
    for name in ("rays", "ranges", "uv", "weights", "directions", "across"):
        np.testing.assert_array_equal(getattr(back.matches, name), getattr(result.matches, name))
    assert back.matches.pick_ids == result.matches.pick_ids
    assert (back.accepted, back.evidence, back.reasons) == (result.accepted, result.evidence, result.reasons)
    assert back.camera == result.camera


@pytest.mark.parametrize("damage", [b"", b"{", b"[]", b'{"version": 1, "photos": 3}', b'{"version": 99}', b"\xff\xfe"])
def test_damaged_documents_are_refused_in_one_line(damage: bytes) -> None:
    with pytest.raises(FormatError) as caught:
        decode_document(damage, lambda name: StoredArrays(b""))
    assert "\n" not in str(caught.value)


def test_picks_of_a_hostile_document_are_checked() -> None:
    fields = json.loads(encode(a_document()))
    fields["photos"][0]["picks"][0]["scan"] = [[0, 0, 0]]
    with pytest.raises(LadarregError, match="length zero"):
        decode_document(json.dumps(fields).encode(), lambda name: StoredArrays(b""))


def test_numbers_and_ids_are_never_used_twice() -> None:
    photo = a_document(3).photos[0]
    photo = edits.without_picks(photo, {photo.picks[-1].id})
    photo, ids = edits.with_picks(photo, [a_pick(9, "line")])
    assert [pick.number for pick in photo.picks] == [1, 2, 4]
    assert ids == ("4",)
    document = a_document()
    document = edits.without_photo(document, document.photos[0].id)
    assert edits.with_photo(document, SOURCE)[1] == "p2"


def test_another_scan_removes_the_picks_of_the_old_one() -> None:
    document = edits.with_scan(with_an_answer(a_document()), Source(path="other.npz", name="other.npz", size=1))
    assert document.photos[0].picks == ()
    assert document.photos[0].poses == ()


def test_another_camera_removes_poses_and_keeps_picks() -> None:
    photo = edits.with_camera(with_an_answer(a_document()).photos[0], CameraGiven(focal_px=500))
    assert photo.poses == ()
    assert len(photo.picks) == 3


@pytest.mark.parametrize(
    "values",
    [
        {"t1": "high"},
        {"t1": -1.0},
        {"nonsense": 1},
        {"lines": "no"},
        {"seed": -1},
        {"corners": True},
        {"step_m": 0},
    ],
)
def test_invalid_settings_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        Settings().changed(values)


@pytest.mark.parametrize("values", [{"intrinsics": "x" * 3000}, {"no such setting " * 200: 1}])
def test_an_invalid_setting_of_any_length_is_refused_in_one_short_sentence(values: dict[str, object]) -> None:
    with pytest.raises(OptionError) as found:
        Settings().changed(values)
    assert len(str(found.value)) < 300


def test_settings_reach_the_options() -> None:
    found = Settings().changed({"t1": 0.3, "residual": "stereo", "reject_sigma": 3.0, "seed": 4, "intrinsics": "focal"})
    options = found.register_options
    assert options.thesis.matching.t1 == 0.3
    assert options.thesis.residual == "stereo"
    assert options.thesis.pose.simplex.reject_sigma == 3.0
    assert (options.seed, options.auto.intrinsics, options.pose.intrinsics) == (4, "focal", "focal")
    assert options.thesis.pose.intrinsics == "fixed"


@pytest.mark.parametrize("rows", [None, "ab", [], [[1, 2]], [[1, 2, float("nan")]], [[1, 2, True]], [[1, 2, 3]] * 3])
def test_coordinates_are_checked(rows: object) -> None:
    with pytest.raises(OptionError):
        edits.rows(rows, 3)


@pytest.mark.parametrize(
    ("vector", "ray"),
    [
        ([1e308, 0, 0], [1, 0, 0]),
        ([1e308, -1e308, 0], [0.5**0.5, -(0.5**0.5), 0]),
        ([5e-324, 0, 0], [1, 0, 0]),
        ([3e-200, 4e-200, 0], [0.6, 0.8, 0]),
        ([1e308, 1e-308, 0], [1, 0, 0]),
    ],
)
def test_a_ray_of_any_length_is_a_direction_and_is_read_again(vector: list[float], ray: list[float]) -> None:
    pick = Pick("1", "point", np.array([vector]), np.array([[1.0, 2.0]]))
    np.testing.assert_allclose(pick.scan, [ray], atol=1e-15)
    document = edits.edited_photo(a_document(), "p1", lambda p: edits.with_picks(p, [pick])[0])
    moved = edits.edited_photo(document, "p1", lambda p: edits.changed_pick(p, "4", {"scan": edits.rays([vector])}))
    assert reading(document) == document
    assert reading(moved) == moved


def test_usual_rays_are_normalised_to_the_same_digits_as_by_their_norm() -> None:
    vectors = np.random.default_rng(0).normal(size=(1000, 3)) * 10 ** np.random.default_rng(1).uniform(-3, 3, (1000, 1))
    plain = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    np.testing.assert_array_equal(unit_rays(vectors), plain)


@pytest.mark.parametrize(
    ("check", "value", "says"),
    [
        (edits.rays, [[10**400, 0, 0]], "list of 3 finite numbers"),
        (edits.rays, [[0, 0, 0]], "zero length"),
        (edits.rays, [[1, 0, 0], [-1, 0, 1e-3]], "150 degrees"),
        (edits.pixels, [[1000001, 0]], "1,000,000 px"),
        (edits.pixels, [[-1e308, 0]], "1,000,000 px"),
        (edits.pixels, [[10**400, 0]], "list of 2 finite numbers"),
        (edits.weight, 1e-7, "from 0.000001 to 1,000,000"),
        (edits.weight, 10**400, "not a number"),
        (edits.weight, True, "not a number"),
    ],
)
def test_values_out_of_range_are_refused(check: Callable[[object], object], value: object, says: str) -> None:
    with pytest.raises(OptionError, match=says):
        check(value)


@pytest.mark.parametrize(("field", "value"), [("photo", [[2e6, 0]]), ("weight", 1e7)])
def test_picks_of_a_file_are_within_the_same_bounds(field: str, value: object) -> None:
    pick = replace(a_pick(1), **{field: value})
    with pytest.raises(OptionError):
        edits.with_picks(a_document().photos[0], [pick])


def test_edits_that_cannot_be_read_again_are_refused() -> None:
    document = a_document()
    check_readable(document, with_an_answer(document))
    for name in ("\ud800", "a\udcffb"):
        with pytest.raises(FormatError, match="nothing was changed"):
            check_readable(document, named(document, name))
    blank = msgspec.structs.replace(with_an_answer(document).photos[0].poses[0], sigma_px=float("nan"))
    with pytest.raises(FormatError, match="nothing was changed"):
        check_readable(document, edits.edited_photo(document, "p1", lambda p: edits.with_pose(p, blank)))


def test_results_that_are_not_finite_are_refused() -> None:
    for field in ("covariance", "sigma_px"):
        answer = replace(a_result(), **{field: getattr(a_result(), field) * np.nan})
        with pytest.raises(DegenerateGeometryError, match="do not determine the pose"):
            pose_entry("robust", answer)


def named(document: Document, name: str) -> Document:
    return msgspec.structs.replace(document, name=name)


def test_a_damaged_stored_result_is_reported() -> None:
    entry = msgspec.structs.replace(pose_entry("robust", a_result()), arrays=StoredArrays(b"no arrays"))
    with pytest.raises(FormatError, match="solve again"):
        registration_of(entry)


def test_nothing_is_pickled() -> None:
    evil = StoredArrays(b"\x80\x04]\x94.")
    with pytest.raises(FormatError):
        evil.arrays()


def test_a_photo_without_matches_keeps_its_result() -> None:
    empty = Matches.none()
    from ladarreg_core.pose.result import describe_pose

    result = describe_pose(
        a_result().camera_from_scanner, empty, np.zeros(0, np.bool_), Camera.from_focal(9, 9, 9),
        sigma_px=1, sigma_range_m=0.01, covariance=np.eye(6),
    )  # fmt: skip
    assert len(registration_of(pose_entry("carried", result)).matches) == 0
    photo = edits.with_pose(PhotoEntry(id="p1", source=SOURCE), pose_entry("carried", result))
    assert photo.pose is not None


def test_a_pose_knows_the_picks_that_it_was_solved_on() -> None:
    document = a_document(4)
    photo = edits.switched(document.photos[0], {"2": False})
    entry = pose_entry("robust", a_result(), picks=photo.picks)
    photo = edits.with_pose(photo, entry)
    assert [pick.id for pick in solved_on(entry) or ()] == ["1", "3", "4"]
    assert stale(photo, entry, solved_on(entry), 1) == ""
    moved = edits.changed_pick(photo, "1", {"photo": [[5, 5]]})
    moved = edits.switched(moved, {"2": True, "3": False})
    assert changed_since(moved, solved_on(entry)) == {"1", "2", "3"}
    assert stale(moved, entry, solved_on(entry), 1) == "3 matches changed since: solve again"
    found = msgspec.structs.replace(entry, stage="auto")
    assert stale(moved, found, solved_on(entry), 1) == "", "it was found in the images"
    assert stale(moved, found, solved_on(entry), 2) == "solved on fewer clouds: register again"
    said = stale(moved, entry, solved_on(entry), 2)
    assert said == "solved on fewer clouds, 3 matches changed since: solve again"
    stated = rests_on(moved, entry, solved_on(entry), 2)
    assert stated is not None
    assert stated["sentence"] == (
        "The pose rests on 3 matches in matches.json. It is the last solved state: the scan had 1 cloud then, and has "
        "2 clouds now. 3 matches of the project changed afterwards, and matches.json contains them as they were when "
        "the pose was solved."
    )


def test_a_station_that_gets_further_clouds_stays_where_it_stands() -> None:
    first, second, third = (msgspec.structs.replace(SOURCE, path=f"{name}.pcd", name=f"{name}.pcd") for name in "abc")
    document = with_stations(edits.with_scan(Document(), first), [second])
    fields = {"stations": [{"world_from_scanner": np.eye(4).tolist()}] * 2}
    document = msgspec.structs.replace(document, survey=Survey(scans=(first, second), fields=fields))
    assert not is_stale(document)
    grown = edits.with_more_clouds(document, ["d.pcd"], ["sweep 4.pcd"])
    assert grown.scan is not None
    assert (grown.clouds, grown.scan.names) == (2, ("a.pcd", "sweep 4.pcd"))
    assert is_stale(grown)
    place = place_of(grown, grown.stations[0])
    assert place is not None
    assert np.allclose(place.matrix, np.eye(4))
    with pytest.raises(OptionError, match=r"d\.pcd is in the project already"):
        with_stations(grown, [msgspec.structs.replace(third, path="d.pcd", name="d.pcd")])
    with pytest.raises(OptionError, match=r"b\.pcd is a station"):
        edits.with_more_clouds(grown, ["b.pcd"])
    assert edits.with_scan(grown, msgspec.structs.replace(third, more=("b.pcd",))).stations == ()


def test_a_pose_of_an_older_version_counts_as_current() -> None:
    entry = pose_entry("robust", a_result())
    photo = edits.with_pose(a_document(2).photos[0], entry)
    assert solved_on(entry) is None
    assert stale(edits.without_picks(photo, {"1"}), entry, solved_on(entry), 1) == ""
