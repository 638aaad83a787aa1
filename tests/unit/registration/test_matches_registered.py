"""Lines drawn by hand and the images: what is verified, what is contradicted, and which pose is proposed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest

import ladarreg_core as lr
from benchmarks.page.snapping_lines import DrawnScene, drawn_scene
from ladarreg_core.errors import OptionError
from ladarreg_core.matches import Pick
from ladarreg_core.registration.register import MatchesRegistered, register_matches

SHELF_PX = 14.0


@cache
def scene() -> DrawnScene:
    return drawn_scene("office", 7, lines=7)


def hand(scatter_px: float, *, wrong: Sequence[int] = (), off_px: float = SHELF_PX) -> list[Pick]:
    """Return the lines of a hand; the wrong ones lie along the other edge of a shelf, in the photograph."""
    drawn, rng = scene(), np.random.default_rng(39)
    picks = []
    for k, (in_scan, in_photo) in enumerate(zip(drawn.scan, drawn.photo, strict=True)):
        along = (in_photo[1] - in_photo[0]) / np.linalg.norm(in_photo[1] - in_photo[0])
        off = off_px * np.array([-along[1], along[0]]) if k in wrong else np.zeros(2)
        rays = drawn.view.rays_at(in_scan + rng.normal(0, scatter_px, (2, 2)))
        picks.append(Pick(str(k + 1), "line", rays, in_photo + off + rng.normal(0, scatter_px, (2, 2))))
    return picks


def registered(picks: list[Pick]) -> MatchesRegistered:
    return register_matches(scene().case.scan, scene().case.photo, picks)


def error_m(result: lr.Registration) -> float:
    return result.camera_from_scanner.distance_to(scene().case.camera_from_scanner)


@pytest.mark.long
def test_a_hand_with_one_line_along_the_wrong_edge_ends_at_the_pose_of_the_images() -> None:
    found = registered(hand(2.0, wrong=[2]))
    result = found.proposed()
    assert (result.accepted, result.evidence) == (True, "image")
    assert result is found.refined
    assert error_m(result) < 0.01 < error_m(found.drawn)
    assert error_m(found.drawn) < 3 * found.drawn.sigma_position_m
    assert found.proposed("drawn") is found.drawn
    assert found.drawn.diagnostics["verification"]["outcome"] != "contradicted"


@pytest.mark.slow
def test_lines_that_agree_on_another_placement_are_contradicted() -> None:
    """All lines are off alike, so they agree with each other, and the matches alone would be accepted."""
    drawn = scene()
    moved = [Pick(pick.id, "line", pick.scan, pick.photo + np.array([30.0, 0.0])) for pick in hand(0.5)]
    found = register_matches(drawn.case.scan, drawn.case.photo, moved)
    assert found.contradicted
    result = found.proposed()
    assert result is found.drawn
    assert (result.accepted, result.evidence) == (False, "none")
    assert "verify another placement" in result.reasons[0]
    assert result.diagnostics["statistics"]["accepted"]
    images = found.proposed("images")
    assert (images.accepted, images.evidence) == (True, "image")
    assert error_m(images) < 0.01
    assert images.diagnostics["drawn"]["outcome"] == "contradicted"


@pytest.mark.slow
def test_where_the_images_show_nothing_the_matches_decide_and_say_so() -> None:
    case, picks = scene().case, hand(0.5)
    blank = lr.Photo(np.full_like(case.photo.pixels, 127), case.photo.camera)
    result = register_matches(case.scan, blank, picks).proposed()
    assert (result.accepted, result.evidence) == (True, "statistics")
    assert result.caveat == "accepted on matches only"
    assert result.standing == "accepted on matches only"
    assert error_m(result) < 4 * result.sigma_position_m


@pytest.mark.slow
@pytest.mark.parametrize("proposal", ["refined", "drawn", "images"])
def test_register_returns_the_proposal_that_was_asked_for(proposal: str) -> None:
    case, picks = scene().case, hand(1.0)
    options = lr.RegisterOptions(proposal=proposal)  # type: ignore[arg-type]
    result = lr.register(case.scan, case.photo, picks=picks, options=options)
    assert ("drawn" in result.diagnostics) == (proposal != "drawn")


def test_an_unknown_proposal_is_refused() -> None:
    with pytest.raises(OptionError, match="refined, drawn, images"):
        lr.RegisterOptions(proposal="best")  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_drawn_pose_that_its_matches_do_not_support_is_not_accepted_though_the_refined_one_is() -> None:
    found = registered(hand(4.0)[:4])
    assert not found.drawn.diagnostics["statistics"]["accepted"]
    if found.refined is not None:
        assert found.proposed() is found.refined
    assert not found.drawn.accepted
