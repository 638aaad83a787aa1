"""The thesis's equations as printed and their errors, each with the number that shows it.

Source: thesis 2.2.1, 2.4.1, 2.4.2 and 3.1; the corrections are those of `ladarreg_core.thesis.estimators.stereo`
and `ladarreg_core.frames`.
"""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_about
from ladarreg_core.matches import Matches
from ladarreg_core.thesis.estimators.linear import linear_pose
from ladarreg_core.thesis.estimators.stereo import (
    STEREO_AXES_FROM_SCANNER,
    StereoPairs,
    equal_baseline,
    equal_baselines_rotation,
    rectify,
    rotate_coordinates,
    stereo_depth,
)
from testing.scenes.apple import APPLE_TRUTH, apple_points

LENS = Camera.from_focal(512, 512, 256.0)


def printed_rectification(xc, yc, *, alpha, beta, gamma):
    """Return the two fractions of Eq 2.13 as printed, lambda = 1."""
    sa, ca, sb, cb, sg, cg = (f(a) for a in (alpha, beta, gamma) for f in (np.sin, np.cos))
    below = xc * (ca * sb * sg + sa * cg) + yc * (ca * sb * cg - sa * sg) - ca * cb
    x = (xc * (sb * sa * sg - ca * cg) + yc * (sb * sa * cg + ca * sg) - sa * cb) / below
    y = (xc * cb * sg + yc * cb * cg + sb) / below
    return x, y


def apple_matches(reading: str = "A") -> Matches:
    """Return noise-free matches of the apple."""
    points = apple_points(reading)
    ranges = np.linalg.norm(points, axis=1)
    return Matches(points / ranges[:, None], ranges, LENS.project(APPLE_TRUTH.pose @ points))


def test_the_printed_y_of_2_13_has_the_opposite_sign():
    x, y = printed_rectification(np.array([0.1]), np.array([0.2]), alpha=0.0, beta=0.0, gamma=0.0)
    assert (x[0], y[0]) == pytest.approx((0.1, -0.2))  # no rotation at all
    rng = np.random.default_rng(0)
    for _ in range(50):
        xc, yc = rng.uniform(-0.5, 0.5, (2, 8))
        angles = dict(zip(("alpha", "beta", "gamma"), rng.uniform(-0.6, 0.6, 3), strict=True))
        Q = rotation_about("y", -angles["alpha"]) @ rotation_about("x", angles["beta"])
        v = Q @ rotation_about("z", angles["gamma"]) @ np.vstack([-xc, -yc, np.ones(8)])
        exact = -v[:2] / v[2]
        assert np.abs(np.stack(rectify(xc, yc, **angles)) - exact).max() < 6e-14
        x, y = printed_rectification(xc, yc, **angles)
        assert np.abs(x - exact[0]).max() < 6e-14
        assert np.abs(y + exact[1]).max() < 6e-14


def test_2_13_scales_with_lambda():
    rng = np.random.default_rng(1)
    xc, yc = rng.uniform(-0.5, 0.5, (2, 8))
    angles = {"alpha": 0.3, "beta": -0.2, "gamma": 0.4}
    scaled = rectify(256 * xc, 256 * yc, **angles, focal=256.0)
    assert np.stack(scaled) == pytest.approx(256 * np.stack(rectify(xc, yc, **angles)), rel=1e-13)


def test_the_t_of_2_10_and_that_of_2_18_are_different_vectors():
    Q = rotation_about("y", -APPLE_TRUTH.alpha) @ rotation_about("x", APPLE_TRUTH.beta)
    Q = Q @ rotation_about("z", APPLE_TRUTH.gamma)
    centre = np.array([APPLE_TRUTH.Tx, APPLE_TRUTH.Ty, APPLE_TRUTH.Tz])
    assert -Q.T @ centre == pytest.approx([-5.52, -1.44, 0.64], abs=5e-3)
    pairs = StereoPairs.of(apple_matches(), LENS)
    right = np.array([*centre, APPLE_TRUTH.alpha, APPLE_TRUTH.beta, APPLE_TRUTH.gamma])
    mixed = np.array([*(-Q.T @ centre), *right[3:]])
    assert np.abs(pairs.depths(right) / pairs.depth - 1).max() < 1e-12
    assert np.median(np.abs(pairs.depths(mixed) / pairs.depth - 1)) > 0.3


def test_the_back_substitution_of_tz_needs_minus_lambda():
    points = STEREO_AXES_FROM_SCANNER @ apple_matches().points.T
    Q = rotation_about("y", -APPLE_TRUTH.alpha) @ rotation_about("x", APPLE_TRUTH.beta)
    R = (Q @ rotation_about("z", APPLE_TRUTH.gamma)).T
    T = -R @ [APPLE_TRUTH.Tx, APPLE_TRUTH.Ty, APPLE_TRUTH.Tz]
    in_camera = R @ points + T[:, None]
    xc = -in_camera[0] / in_camera[2]
    by_sign = [np.mean(sign * (R[0] @ points + T[0]) / xc - R[2] @ points) for sign in (-1, 1)]
    assert by_sign[0] == pytest.approx(0.643, abs=5e-4)
    assert by_sign[1] == pytest.approx(-9.59, abs=0.1)
    m = apple_matches()
    found = linear_pose(m.points, (m.uv - [LENS.cx, LENS.cy]) / LENS.fx)
    assert found.translation[2] == pytest.approx(0.643, abs=5e-4)


def test_the_matrix_of_2_15_turns_by_plus_omega1():
    Tx, Ty = 5.0, 2.0
    D, omega1 = np.hypot(Tx, Ty), np.pi / 4 - np.arctan2(Ty, Tx)
    turn = equal_baselines_rotation(Tx, Ty)
    assert turn == pytest.approx(rotation_about("z", omega1)[:2, :2])
    assert turn @ [Tx, Ty] == pytest.approx([D / np.sqrt(2)] * 2)
    assert equal_baseline(Tx, Ty) == pytest.approx(D / np.sqrt(2))
    other = rotation_about("z", -omega1)[:2, :2] @ [Tx, Ty]  # the text's words
    assert abs(other[0] - other[1]) > 1


def test_y_up_on_one_side_is_a_left_handed_map():
    # 2.2.1 has xl = -lambda tan(az) / cos(el), yl = +lambda tan(el); 2.17 has the inverted pinhole in both.
    azimuth, elevation = np.array([0.2, -0.1, 0.15]), np.array([0.1, 0.2, -0.15])
    rays = np.column_stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth), np.cos(azimuth) * np.sin(elevation)]
    )  # fmt: skip
    printed = np.stack([-np.tan(azimuth) / np.cos(elevation), np.tan(elevation)])
    stereo = StereoPairs.of(Matches(rays, np.full(3, 5.0), np.full((3, 2), 255.5)), LENS).laser
    mapping = np.linalg.lstsq(stereo.T, printed.T, rcond=None)[0]
    assert mapping == pytest.approx(np.diag([1.0, -1.0]), abs=1e-12)
    assert np.linalg.det(mapping) == pytest.approx(-1)

    pairs = StereoPairs.of(apple_matches(), LENS)
    T = APPLE_TRUTH
    x, y = rectify(pairs.color[0], pairs.color[1], alpha=T.alpha, beta=T.beta, gamma=T.gamma)
    turn, baseline = equal_baselines_rotation(T.Tx, T.Ty), equal_baseline(T.Tx, T.Ty)
    for sign, exact in ((1, True), (-1, False)):
        laser = rotate_coordinates(pairs.laser[0], sign * pairs.laser[1], turn)
        error = stereo_depth(rotate_coordinates(x, y, turn)[0], laser[0], baseline=baseline, Tz=T.Tz) / pairs.depth - 1
        assert (np.abs(error).max() < 1e-12) == exact


def test_a_radius_of_one_and_a_range_of_two_to_eight_are_two_apples():
    spans = {reading: np.linalg.norm(apple_points(reading), axis=1) for reading in ("A", "B")}
    assert (spans["A"].min(), spans["A"].max()) == pytest.approx((4, 6), abs=0.05)
    assert (spans["B"].min(), spans["B"].max()) == pytest.approx((2, 8), abs=0.1)


def test_with_these_2_21_is_exact():
    m = apple_matches("B")
    pairs = StereoPairs.of(m, LENS)
    x = pairs.parameters(APPLE_TRUTH.pose)
    assert x == pytest.approx([5, 2, 2, *np.deg2rad([25, 10, 5])])
    assert np.abs(pairs.depths(x) / pairs.depth - 1).max() < 1e-13
    assert isinstance(pairs.pose(x), Rigid)
    assert pairs.pose(x).matrix == pytest.approx(APPLE_TRUTH.pose.matrix, abs=1e-14)
    assert np.diag([-1.0, -1.0, 1.0]) @ CAMERA_AXES_FROM_SCANNER == pytest.approx(STEREO_AXES_FROM_SCANNER)
