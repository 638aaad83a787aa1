"""Assessment of a registration: every part is computed, or missing with a reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.quality.assessment import assess
from ladarreg_core.quality.influence import influence
from ladarreg_core.quality.next_match import suggest_matches
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.surface.uncertainty import pixel_sigma
from tests.unit.quality.test_next_match import clustered


@pytest.mark.parametrize("seed", [2, 3])  # with a lens and without
def test_the_assessment_agrees_with_its_parts(seed: int) -> None:
    room, _, _, result, _ = clustered(seed, count=14)
    found = assess(room.scan, result)
    assert found.absent == {}
    assert found.findings is not None
    assert {finding.name for finding in found.findings if finding.level == "poor"} >= {"spread"}
    assert found.influence is not None
    np.testing.assert_array_equal(found.influence.cook, influence(result).cook)
    assert found.advice is not None
    assert [place.cell for place in found.advice] == [place.cell for place in suggest_matches(room.scan, result)]

    seen = found.uncertainty
    assert seen is not None
    pose, camera = result.camera_from_scanner, result.camera
    points = pose @ np.nan_to_num(room.scan.points.astype(np.float64), nan=1.0)
    expected = pixel_sigma(points, camera, pose.rotation, result.covariance)
    with np.errstate(invalid="ignore"):
        inside = room.scan.valid & camera.contains(camera.project(points))
        beyond = camera.contains(camera.project(points), border=0.01)
    assert (np.isfinite(seen.sigma_px) == inside)[beyond == inside].all()
    both = inside & np.isfinite(seen.sigma_px)
    np.testing.assert_allclose(seen.sigma_px[both], expected[both], rtol=1e-3)
    assert seen.median_px == pytest.approx(np.median(expected[inside]), rel=1e-3)
    assert (expected[inside] <= seen.p95_px).mean() == pytest.approx(0.95, abs=2e-3)
    assert seen.worst_px == pytest.approx(expected[inside].max(), rel=1e-3)
    at = camera.project(pose @ room.scan.points[seen.worst_cell].astype(float))
    np.testing.assert_allclose(seen.worst_uv, at, atol=1e-2)


def test_a_range_spike_is_not_the_worst_cell() -> None:
    room, _, _, result, _ = clustered(2, count=14)
    clean = assess(room.scan, result).uncertainty
    ranges = np.array(room.scan.ranges)
    ranges[150, 210] = 1.0  # so near that it looks many times as uncertain
    spiked = assess(replace(room.scan, ranges=ranges), result).uncertainty
    assert clean is not None
    assert spiked is not None
    assert spiked.sigma_px[150, 210] > 1.2 * clean.worst_px
    assert spiked.worst_px == pytest.approx(clean.worst_px, rel=1e-6)


def test_a_part_that_cannot_be_computed_has_a_reason() -> None:
    room, _, matches, good, _ = clustered(2, count=14)
    away = Rigid(rotation_from_rotvec([0, np.pi, 0]) @ good.camera_from_scanner.rotation, np.zeros(3))
    none = Matches.none()
    nothing = {
        "matches": none, "inliers": np.zeros(0, bool), "residuals_px": np.zeros((0, 2)), "residuals_m": np.zeros(0),
        "stereo_depth_error_m": np.zeros(0),
    }  # fmt: skip
    count = len(matches)
    cases: list[tuple[PoseResult, set[str]]] = [
        (replace(good, accepted=False, **nothing), {"influence", "uncertainty", "advice"}),  # type: ignore[arg-type]
        (replace(good, accepted=False, inliers=np.zeros(count, bool)), {"influence", "uncertainty", "advice"}),
        (replace(good, inliers=np.arange(count) < 3), {"influence"}),
        (replace(good, covariance=np.full((6, 6), np.nan)), {"uncertainty", "advice"}),
        (replace(good, covariance=-np.eye(6)), {"uncertainty", "advice"}),
        (replace(good, camera_from_scanner=away), {"influence", "uncertainty", "advice"}),
    ]
    for result, absent in cases:
        found = assess(room.scan, result)
        assert set(found.absent) == absent
        for name in ("findings", "influence", "uncertainty", "advice"):
            assert (getattr(found, name) is None) == (name in absent)
        assert all(reason and "\n" not in reason for reason in found.absent.values())
        assert isinstance(found.match_to_check, str)


def test_a_carried_pose_has_no_findings_for_lack_of_matches() -> None:
    room, *_, result, _ = clustered(0)
    none = np.zeros(0)
    carried = replace(
        result, accepted=True, matches=Matches(np.zeros((0, 3)), none, np.zeros((0, 2))),
        inliers=none.astype(bool), residuals_px=np.zeros((0, 2)), residuals_m=none, stereo_depth_error_m=none,
    )  # fmt: skip
    assessment = assess(room.scan, carried)
    assert assessment.findings is None
    assert "carried over" in assessment.absent["findings"]
    assert assessment.uncertainty is not None


def test_a_large_scan_is_assessed_tile_by_tile_as_in_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    room, _, _, result, _ = clustered(2, count=14)
    ranges = np.array(room.scan.ranges)
    ranges[150, 210] = 1.0
    scan = replace(room.scan, ranges=ranges)
    whole = assess(scan, result).uncertainty
    monkeypatch.setattr("ladarreg_core.quality.assessment.LARGEST_WHOLE_SCAN", 1000)
    tiled = assess(scan, result).uncertainty
    assert whole is not None
    assert tiled is not None
    np.testing.assert_array_equal(np.isfinite(tiled.sigma_px), np.isfinite(whole.sigma_px))
    np.testing.assert_allclose(tiled.sigma_px, whole.sigma_px, rtol=1e-3)
    assert tiled.worst_cell == whole.worst_cell
    assert (tiled.median_px, tiled.p95_px) == pytest.approx((whole.median_px, whole.p95_px), rel=1e-3)
