"""The thesis matcher: unconstrained and guided matching, filters, and the input of the solvers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.features.corners import CornerOptions
from ladarreg_core.matching.images.photo_levels import photo_levels, working_camera
from ladarreg_core.matching.images.scan_levels import scan_levels
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.simulate import SCENES, SimulatedCase
from ladarreg_core.surface.perspective import perspective_view
from ladarreg_core.thesis.matching.matcher import FoundMatches, ThesisMatchOptions, ThesisSearch
from testing.scenes.painted_room import PaintedRoom, painted_room
from testing.scenes.simulated import simulated

MANY = CornerOptions(count=1500)
OPTIONS = ThesisMatchOptions(scan_corners=MANY, photo_corners=MANY, depth_edges="left_out", t1=0.2, t2_px=20)
RIGHT_PX = 3.0


def thesis_search(scan: Scan, photo: Photo, options: ThesisMatchOptions = OPTIONS) -> ThesisSearch:
    working = working_camera(scan, photo.camera)
    view = perspective_view(scan, working)
    return ThesisSearch(scan_levels(scan, view), photo_levels(photo, working), options)


def right(found: FoundMatches, case: PaintedRoom | SimulatedCase) -> np.ndarray:
    """Return a mask (K,) of the matches within 3 px of the true pixel, in the photo's own pixels."""
    true = case.photo.camera.project(case.camera_from_scanner @ found.matches.points)
    return np.asarray(np.hypot(*(true - found.matches.uv).T) <= RIGHT_PX)


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=4, distortion=(-0.12, 0.03, 0, 0))


@pytest.fixture(scope="module")
def search(room: PaintedRoom) -> ThesisSearch:
    return thesis_search(room.scan, room.photo)


@pytest.mark.long
def test_few_matches_nearly_all_correct() -> None:
    """At T1 = .2 and T2 = 20 px, the values of the thesis; one case of each scene."""
    ratios = []
    for seed, scene in enumerate(SCENES):
        case = simulated(scene, seed=40 + seed)
        here = thesis_search(case.scan, case.photo)
        ratios.append(right(here.filtered(here.unconstrained()), case).mean())
    assert np.median(ratios) >= 0.9


@pytest.mark.slow
def test_guided_matching_finds_many_more_matches(room: PaintedRoom, search: ThesisSearch) -> None:
    first = search.filtered(search.unconstrained())
    assert right(first, room).mean() >= 0.9
    second = search.filtered(search.constrained(room.camera_from_scanner))
    assert len(second) > 2 * len(first)
    assert right(second, room).mean() > 0.8
    turn = rotation_from_rotvec([0.002, -0.006, 0.0])  # some three pixels
    near = Rigid.from_centre(turn @ room.camera_from_scanner.rotation, room.camera_from_scanner.centre)
    again = search.filtered(search.constrained(near))
    assert len(again) > 0.6 * len(second)
    assert right(again, room).mean() > 0.75


@pytest.mark.slow
def test_filters_only_remove_matches(room: PaintedRoom, search: ThesisSearch) -> None:
    for found in (search.unconstrained(), search.constrained(room.camera_from_scanner)):
        kept = search.filtered(found)
        assert set(kept.matches.pick_ids) <= set(found.matches.pick_ids)
        assert right(kept, room).mean() >= right(found, room).mean()
    literal = ThesisSearch(search.scan, search.photo, replace(OPTIONS, culling="one_sided"))
    two_sided, one_sided = (set(s.filtered(s.unconstrained()).matches.pick_ids) for s in (search, literal))
    assert two_sided <= one_sided


@pytest.mark.slow
def test_guided_matches_may_be_culled_by_disparity_as_the_first_ones(room: PaintedRoom, search: ThesisSearch) -> None:
    by_disparity = ThesisSearch(search.scan, search.photo, replace(OPTIONS, second_culling="disparity"))
    first = search.unconstrained()
    assert by_disparity.filtered(first).matches.pick_ids == search.filtered(first).matches.pick_ids
    guided = search.constrained(room.camera_from_scanner)
    by_prediction, literal = (one.filtered(guided) for one in (search, by_disparity))
    assert literal.matches.pick_ids != by_prediction.matches.pick_ids
    assert len(literal.matches) > 100
    # the displacement from the prediction is known to be small: it culls more sharply than T2
    assert right(by_prediction, room).mean() > right(literal, room).mean()


@pytest.mark.slow
def test_matches_are_in_the_photos_own_distorted_pixels(room: PaintedRoom, search: ThesisSearch) -> None:
    found = search.unconstrained()
    own = search.photo.source.project(search.photo.cameras[0].unproject(found.photo_uv))
    np.testing.assert_allclose(found.matches.uv, own)
    assert np.abs(found.matches.uv - found.photo_uv).max() > 0.5  # the lens is distorted
    assert search.photo.source.contains(found.matches.uv, border=-0.5).all()
    np.testing.assert_allclose(search.scan.view.project(found.matches.points), found.scan_uv, atol=1e-6)
    cells = np.rint(found.scan_uv).astype(int)
    np.testing.assert_allclose(found.matches.ranges, search.scan.ranges[cells[:, 1], cells[:, 0]], rtol=1e-6)


def test_a_corner_has_the_same_id_in_both_searches(room: PaintedRoom, search: ThesisSearch) -> None:
    names: dict[str, tuple[float, ...]] = {}
    for found in (search.unconstrained(), search.constrained(room.camera_from_scanner)):
        assert len(set(found.matches.pick_ids)) == len(found)
        for name, uv in zip(found.matches.pick_ids, map(tuple, found.scan_uv), strict=True):
            assert name.startswith("c")
            assert names.setdefault(name, uv) == uv


def test_densification_multiplies_the_matches(room: PaintedRoom, search: ThesisSearch) -> None:
    found = search.filtered(search.constrained(room.camera_from_scanner))
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


def test_equal_inputs_give_equal_matches(room: PaintedRoom, search: ThesisSearch) -> None:
    again = thesis_search(room.scan, room.photo)
    for one, other in (
        (search.unconstrained(), again.unconstrained()),
        (search.constrained(room.camera_from_scanner), again.constrained(room.camera_from_scanner)),
    ):
        np.testing.assert_array_equal(one.matches.uv, other.matches.uv)
        assert one.matches.pick_ids == other.matches.pick_ids


def test_corners_at_depth_edges_can_be_left_out(room: PaintedRoom, search: ThesisSearch) -> None:
    both = {
        where: thesis_search(room.scan, room.photo, replace(OPTIONS, depth_edges=where))
        for where in ("foreground", "left_out")
    }
    at_edge = {}
    for where, here in both.items():
        u, v = np.rint(here.scan_uv).astype(int).T
        assert np.isfinite(here.scan.ranges[v, u]).all()
        at_edge[where] = int(here.scan.edge[v, u].sum())
    assert at_edge["left_out"] == 0 < at_edge["foreground"]


def test_images_without_corners_give_no_matches_and_no_error(room: PaintedRoom) -> None:
    flat = Photo(np.full_like(room.photo.pixels, 90), room.photo.camera)
    dull = Scan(room.scan.geometry, room.scan.ranges, np.ones(room.scan.shape), intensity_is="range_normalised")
    for scan, photo in ((room.scan, flat), (dull, room.photo), (dull, flat)):
        here = thesis_search(scan, photo)
        for found in (here.unconstrained(), here.constrained(room.camera_from_scanner)):
            culled = here.filtered(found)
            assert len(found.matches) == len(culled.matches) == 0
            assert len(here.densified(culled, room.camera_from_scanner)) == 0


def test_a_pose_facing_away_gives_no_matches(room: PaintedRoom, search: ThesisSearch) -> None:
    away = Rigid(rotation_from_rotvec([0, np.pi, 0]) @ room.camera_from_scanner.rotation, np.zeros(3))
    found = search.constrained(away)
    assert len(found) == len(search.filtered(found)) == 0


@pytest.mark.parametrize(
    "name", ["window_px", "t1", "t2_px", "culling", "search_px", "constrained_t1", "least_score", "depth_edges"]
)
@pytest.mark.parametrize("value", [-1, float("nan"), "x"])
def test_invalid_options_raise_a_one_line_error(name: str, value: object) -> None:
    with pytest.raises(OptionError) as caught:
        ThesisMatchOptions(**{name: value})  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
