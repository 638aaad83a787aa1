"""The data that the rest passes around: read-only, checked once, and honest about what is missing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ladarreg_core.camera import Camera
from ladarreg_core.errors import LadarregError, OptionError, ShapeError
from ladarreg_core.foundations.arrays import read_only
from ladarreg_core.frames import Rigid, ThesisParameters, rotation_from_rotvec
from ladarreg_core.matches import Matches, Pick
from ladarreg_core.photo import Photo
from ladarreg_core.results.registration import PoseResult, Registration
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation

GEOMETRY = AzimuthElevation(4, 6, 0.01, 0.01)
NUMBERS = hnp.arrays(np.float64, (4, 6), elements=st.floats(allow_nan=True, allow_infinity=True, width=32))


@given(ranges=NUMBERS, intensity=NUMBERS)
def test_whatever_a_file_holds_a_scan_is_finite_where_it_is_valid(ranges: np.ndarray, intensity: np.ndarray) -> None:
    usable = np.isfinite(ranges) & (ranges > 0) & np.isfinite(intensity)
    if not usable.any():
        with pytest.raises(ShapeError, match="no returns"):
            Scan(GEOMETRY, ranges, intensity)
        return
    scan = Scan(GEOMETRY, ranges, intensity)
    np.testing.assert_array_equal(scan.valid, usable)
    np.testing.assert_array_equal(scan.ranges[usable], ranges[usable].astype(np.float32))
    assert np.isnan(scan.ranges[~usable]).all()
    assert np.isfinite(scan.intensity).all()
    assert np.isfinite(scan.mean_direction).all()


def test_points_are_rays_times_range() -> None:
    scan = Scan(GEOMETRY, np.full((4, 6), 3.0), np.ones((4, 6)))
    np.testing.assert_allclose(np.linalg.norm(scan.points, axis=-1), 3.0, rtol=1e-6)
    np.testing.assert_allclose(scan.points / 3, GEOMETRY.rays, atol=1e-6)
    assert (scan.ranges.dtype, scan.intensity.dtype, scan.points.dtype) == (np.float32,) * 3


def test_data_is_read_only_and_the_caller_keeps_his() -> None:
    ranges, intensity = np.full((4, 6), 3.0, np.float32), np.ones((4, 6), np.float32)
    scan = Scan(GEOMETRY, ranges, intensity)
    ranges[0, 0] = 9
    assert scan.ranges[0, 0] == 3
    for array in (scan.ranges, scan.intensity, scan.valid, scan.points, scan.rays):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1


@pytest.mark.parametrize(
    "make",
    [
        lambda: Scan(GEOMETRY, np.ones((4, 5)), np.ones((4, 6))),
        lambda: Scan(GEOMETRY, np.ones((4, 6)), np.ones((6, 4))),
        lambda: Scan(GEOMETRY, np.ones((4, 6)), np.ones((4, 6)), color=np.zeros((4, 6), np.uint8)),
        lambda: Scan(GEOMETRY, np.zeros((4, 6)), np.ones((4, 6))),
        lambda: Scan(GEOMETRY, np.full((4, 6), np.nan), np.ones((4, 6))),
        lambda: Scan(GEOMETRY, np.full((4, 6), -1.0), np.ones((4, 6))),
        lambda: Scan(GEOMETRY, np.array([["near"] * 6] * 4), np.ones((4, 6))),
        lambda: Scan(AzimuthElevation(1, 1, 0.01, 0.01), np.ones((1, 1)), np.ones((1, 1))),
        lambda: Scan(AzimuthElevation(1, 9, 0.01, 0.01), np.ones((1, 9)), np.ones((1, 9))),
        lambda: Photo(np.zeros((5, 7), np.uint8), Camera.from_focal(7, 5, 9)),
        lambda: Photo(np.zeros((5, 7, 3), np.uint8), Camera.from_focal(5, 7, 9)),
        lambda: Photo(np.zeros((5, 7, 4), np.uint8), Camera.from_focal(7, 5, 9)),
        lambda: Pick("1", "point", [[1, 0, 0], [0, 1, 0]], [[1, 2]]),  # type: ignore[arg-type]
        lambda: Pick("1", "line", [[1, 0, 0]], [[1, 2]]),  # type: ignore[arg-type]
        lambda: Pick("1", "circle", [[1, 0, 0]], [[1, 2]]),  # type: ignore[arg-type]
        lambda: Pick("1", "point", [[0, 0, 0]], [[1, 2]]),  # type: ignore[arg-type]
        lambda: Pick("1", "point", [[1, 0, np.nan]], [[1, 2]]),  # type: ignore[arg-type]
        lambda: Pick("1", "point", [[1, 0, 0]], [[1, np.inf]]),  # type: ignore[arg-type]
        lambda: Pick("1", "point", [[1, 0, 0]], [[1, 2]], weight=0.0),  # type: ignore[arg-type]
        lambda: Pick("1", "point", [[1, 0, 0]], [[1, 2]], weight=float("nan")),  # type: ignore[arg-type]
        lambda: Matches(np.ones((3, 3)), np.ones(2), np.ones((3, 2))),
        lambda: Matches(np.ones((3, 3)), np.ones(3), np.ones((3, 3))),
        lambda: Matches(np.ones((3, 3)), np.ones(3), np.ones((3, 2)), pick_ids=("1",)),
        lambda: Matches(np.ones((3, 3)), np.ones(3), np.ones((3, 2)), weights=np.ones(4)),
        lambda: read_only([[1, 2], [3]], np.float64, (None, None), "the table"),
    ],
)
def test_data_that_disagrees_is_refused_in_one_line(make: object) -> None:
    with pytest.raises(ShapeError) as caught:
        make()  # type: ignore[operator]
    assert "\n" not in str(caught.value)


def test_an_unknown_kind_of_intensity_is_refused() -> None:
    with pytest.raises(OptionError, match="raw"):
        Scan(GEOMETRY, np.ones((4, 6)), np.ones((4, 6)), intensity_is="bright")  # type: ignore[arg-type]


def test_a_pick_makes_its_rays_unit() -> None:
    line = Pick("a", "line", [[2, 0, 0], [0, 3, 4]], [[1, 2], [3, 4]])  # type: ignore[arg-type]
    np.testing.assert_allclose(line.scan, [[1, 0, 0], [0, 0.6, 0.8]])


@given(st.lists(st.booleans(), min_size=5, max_size=5))
def test_a_subset_keeps_rows_together(keep: list[bool]) -> None:
    matches = Matches(
        np.eye(5, 3) + np.array([0, 0, 1]), np.arange(1, 6), np.arange(10).reshape(5, 2),
        pick_ids=("a", "b", "c", "d", "e"), fractions=np.linspace(0, 1, 5), weights=np.arange(1, 6) / 5,
    )  # fmt: skip
    part = matches.subset(keep)
    index = np.flatnonzero(keep)
    assert part.pick_ids == tuple("abcde"[k] for k in index)
    for name in ("rays", "ranges", "uv", "fractions", "weights", "points"):
        np.testing.assert_array_equal(getattr(part, name), getattr(matches, name)[index])
    np.testing.assert_array_equal(matches.subset(index).uv, part.uv)


def test_matches_without_ids_are_numbered_from_one() -> None:
    assert Matches(np.ones((2, 3)), np.ones(2), np.ones((2, 2))).pick_ids == ("1", "2")
    assert len(Matches(np.ones((2, 3)), np.ones(2), np.ones((2, 2))).subset([])) == 0


def test_a_result_tells_its_spread_and_the_thesis_numbers() -> None:
    result = registration(Rigid.from_rotvec([0.1, 0.2, 0.3], [1, 2, 3]), np.diag([1e-6, 4e-6, 4e-6, 1e-4, 4e-4, 4e-4]))
    assert result.sigma_angle_rad == pytest.approx(3e-3)
    assert result.sigma_position_m == pytest.approx(3e-2)
    assert result.thesis_parameters.pose.angle_to(result.camera_from_scanner) < 1e-9
    assert isinstance(result, PoseResult)
    assert (result.accepted, result.evidence) == (False, "none")


def test_sigmas_of_the_thesis_parameters_are_the_spread_of_the_poses() -> None:
    """Poses drawn by the covariance scatter as reported; alpha's sigma is larger where the camera looks down."""
    truth = ThesisParameters(0.4, 0.1, -0.2, 0.2, 0.6, 0.1)
    A = np.random.default_rng(5).normal(size=(6, 6)) * np.array([[1, 1, 1, 3, 3, 3]]).T * 1e-3
    sigmas = registration(truth.pose, A @ A.T).thesis_sigmas
    drawn = [
        ThesisParameters.from_pose(
            Rigid.from_centre(rotation_from_rotvec(d[:3]) @ truth.pose.rotation, truth.pose.centre + d[3:])
        )
        for d in np.random.default_rng(6).normal(size=(4000, 6)) @ A.T
    ]
    for name in ("Tx", "Ty", "Tz", "alpha", "beta", "gamma"):
        spread = np.std([getattr(p, name) for p in drawn])
        assert getattr(sigmas, name) == pytest.approx(spread, rel=0.05), name


def registration(pose: Rigid, covariance: np.ndarray) -> Registration:
    return Registration(
        camera_from_scanner=pose,
        camera=Camera.from_focal(8, 6, 9),
        matches=Matches(np.ones((1, 3)), np.ones(1), np.ones((1, 2))),
        inliers=np.array([True]),
        residuals_px=np.zeros((1, 2)),
        residuals_m=np.zeros(1),
        stereo_depth_error_m=np.zeros(1),
        covariance=covariance,
        chi2_per_dof=1.0,
        sigma_px=1.0,
        sigma_range_m=0.015,
        method="auto",
    )


def test_every_error_is_a_ladarreg_error_except_cancelling() -> None:
    from ladarreg_core import errors

    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, Exception)]
    assert {kind.__name__ for kind in kinds if not issubclass(kind, LadarregError)} == {"Cancelled"}
