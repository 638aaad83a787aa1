"""The thesis's correspondences as one piece: the searches, their culling, and what a solver gets of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.errors import OptionError
from ladarreg_core.features.corners import CornerOptions
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.pyramid import photo_levels, scan_levels, working_camera
from ladarreg_core.matching.thesis.matcher import FoundMatches, ThesisMatchOptions, ThesisSearch
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.simulate import SCENES, SimulatedCase, simulate_case
from ladarreg_core.surface.perspective import perspective_view
from tests.scenes.painted_room import PaintedRoom, painted_room

MANY = CornerOptions(count=1500)
OPTIONS = ThesisMatchOptions(scan_corners=MANY, photo_corners=MANY, depth_edges="left_out", t1=0.2, t2_px=20)
RIGHT_PX = 3.0


def search_of(scan: Scan, photo: Photo, options: ThesisMatchOptions = OPTIONS) -> ThesisSearch:
    working = working_camera(scan, photo.camera)
    view = perspective_view(scan, working)
    return ThesisSearch(scan_levels(scan, view), photo_levels(photo, working), options)


def right(found: FoundMatches, case: PaintedRoom | SimulatedCase) -> np.ndarray:
    """Which matches (K,) lie where the truth puts them, in the photo's own pixels."""
    true = case.photo.camera.project(case.camera_from_scanner @ found.matches.points)
    return np.asarray(np.hypot(*(true - found.matches.uv).T) <= RIGHT_PX)


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=4, distortion=(-0.12, 0.03, 0, 0))


@pytest.fixture(scope="module")
def search(room: PaintedRoom) -> ThesisSearch:
    return search_of(room.scan, room.photo)


def test_few_matches_nearly_all_correct() -> None:
    """At T1 = .2 and T2 = 20 px, as the thesis says; one case of each scene."""
    ratios = []
    for seed, scene in enumerate(SCENES):
        case = simulate_case(scene, seed=40 + seed)
        here = search_of(case.scan, case.photo)
        ratios.append(right(here.culled(here.unconstrained()), case).mean())
    assert np.median(ratios) >= 0.9


def test_the_second_search_finds_many_more(room: PaintedRoom, search: ThesisSearch) -> None:
    first = search.culled(search.unconstrained())
    assert right(first, room).mean() >= 0.9
    second = search.culled(search.constrained(room.camera_from_scanner))
    assert len(second) > 2 * len(first)
    assert right(second, room).mean() > 0.8
    turn = rotation_from_rotvec([0.002, -0.006, 0.0])  # some three pixels
    near = Rigid.from_centre(turn @ room.camera_from_scanner.rotation, room.camera_from_scanner.centre)
    again = search.culled(search.constrained(near))
    assert len(again) > 0.6 * len(second)
    assert right(again, room).mean() > 0.75


def test_culling_takes_away_and_adds_nothing(room: PaintedRoom, search: ThesisSearch) -> None:
    for found in (search.unconstrained(), search.constrained(room.camera_from_scanner)):
        kept = search.culled(found)
        assert set(kept.matches.pick_ids) <= set(found.matches.pick_ids)
        assert right(kept, room).mean() >= right(found, room).mean()
    literal = ThesisSearch(search.scan, search.photo, replace(OPTIONS, culling="one_sided"))
    two_sided, one_sided = (set(s.culled(s.unconstrained()).matches.pick_ids) for s in (search, literal))
    assert two_sided <= one_sided


def test_the_photos_side_is_in_its_own_distorted_pixels(room: PaintedRoom, search: ThesisSearch) -> None:
    found = search.unconstrained()
    own = search.photo.source.project(search.photo.cameras[0].unproject(found.photo_uv))
    np.testing.assert_allclose(found.matches.uv, own)
    assert np.abs(found.matches.uv - found.photo_uv).max() > 0.5  # the lens does bend
    assert search.photo.source.contains(found.matches.uv, border=-0.5).all()
    np.testing.assert_allclose(search.scan.view.project(found.matches.points), found.scan_uv, atol=1e-6)
    cells = np.rint(found.scan_uv).astype(int)
    np.testing.assert_allclose(found.matches.ranges, search.scan.ranges[cells[:, 1], cells[:, 0]], rtol=1e-6)


def test_one_corner_has_one_name_in_both_searches(room: PaintedRoom, search: ThesisSearch) -> None:
    names: dict[str, tuple[float, ...]] = {}
    for found in (search.unconstrained(), search.constrained(room.camera_from_scanner)):
        assert len(set(found.matches.pick_ids)) == len(found)
        for name, uv in zip(found.matches.pick_ids, map(tuple, found.scan_uv), strict=True):
            assert name.startswith("c")
            assert names.setdefault(name, uv) == uv


def test_lines_multiply_the_matches(room: PaintedRoom, search: ThesisSearch) -> None:
    found = search.culled(search.constrained(room.camera_from_scanner))
    dense = search.densified(found, room.camera_from_scanner)
    assert len(dense) > 2 * len(found)
    assert dense.matches.pick_ids[: len(found)] == found.matches.pick_ids
    assert {name[0] for name in dense.matches.pick_ids[len(found) :]} == {"l"}
    assert right(dense, room).mean() > 0.8
    fractions, weights = dense.matches.fractions, dense.matches.weights
    assert fractions is not None
    assert weights is not None
    on_lines = np.array([name[0] == "l" for name in dense.matches.pick_ids])
    assert (fractions[~on_lines] == 0).all()
    assert ((fractions[on_lines] > 0) & (fractions[on_lines] < 1)).all()
    lines = np.array(dense.matches.pick_ids)[on_lines]
    for name in np.unique(lines)[:10]:
        np.testing.assert_allclose((weights[on_lines][lines == name] ** 2).sum(), 1)


def test_the_same_pictures_give_the_same_matches(room: PaintedRoom, search: ThesisSearch) -> None:
    again = search_of(room.scan, room.photo)
    for one, other in (
        (search.unconstrained(), again.unconstrained()),
        (search.constrained(room.camera_from_scanner), again.constrained(room.camera_from_scanner)),
    ):
        np.testing.assert_array_equal(one.matches.uv, other.matches.uv)
        assert one.matches.pick_ids == other.matches.pick_ids


def test_corners_at_depth_edges_are_left_out_on_request(room: PaintedRoom, search: ThesisSearch) -> None:
    both = {
        where: search_of(room.scan, room.photo, replace(OPTIONS, depth_edges=where))
        for where in ("foreground", "left_out")
    }
    at_edge = {}
    for where, here in both.items():
        u, v = np.rint(here.scan_uv).astype(int).T
        assert np.isfinite(here.scan.ranges[v, u]).all()
        at_edge[where] = int(here.scan.edge[v, u].sum())
    assert at_edge["left_out"] == 0 < at_edge["foreground"]


def test_pictures_without_corners_have_no_matches_and_no_fault(room: PaintedRoom) -> None:
    flat = Photo(np.full_like(room.photo.pixels, 90), room.photo.camera)
    dull = Scan(room.scan.geometry, room.scan.ranges, np.ones(room.scan.shape), intensity_is="range_normalised")
    for scan, photo in ((room.scan, flat), (dull, room.photo), (dull, flat)):
        here = search_of(scan, photo)
        for found in (here.unconstrained(), here.constrained(room.camera_from_scanner)):
            culled = here.culled(found)
            assert len(found.matches) == len(culled.matches) == 0
            assert len(here.densified(culled, room.camera_from_scanner)) == 0


def test_a_pose_that_looks_away_finds_nothing(room: PaintedRoom, search: ThesisSearch) -> None:
    away = Rigid(rotation_from_rotvec([0, np.pi, 0]) @ room.camera_from_scanner.rotation, np.zeros(3))
    found = search.constrained(away)
    assert len(found) == len(search.culled(found)) == 0


@pytest.mark.parametrize(
    "name", ["window_px", "t1", "t2_px", "culling", "search_px", "constrained_t1", "least_score", "depth_edges"]
)
@pytest.mark.parametrize("value", [-1, float("nan"), "x"])
def test_options_without_meaning_are_one_clear_line(name: str, value: object) -> None:
    with pytest.raises(OptionError) as caught:
        ThesisMatchOptions(**{name: value})  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
