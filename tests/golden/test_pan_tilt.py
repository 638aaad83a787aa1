"""Spherical coordinates and pan/tilt: the thesis's equations where they hold, and its errors where they do not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.scanner.pan_tilt import (
    azimuth_elevation_from_spherical,
    pan_tilt_pose,
    rays_from_spherical,
    rays_of_line,
    spherical_from_azimuth_elevation,
    spherical_from_points,
    turned_by_unit,
)

ANGLES = st.floats(-1.4, 1.4)


def ray(azimuth: float, elevation: float) -> np.ndarray:
    """Thesis Eq 2.1 at r = 1."""
    return np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth), np.cos(azimuth) * np.sin(elevation)])


@given(ANGLES, ANGLES)
def test_all_ways_to_the_sphere_agree(azimuth: float, elevation: float) -> None:
    theta, phi = spherical_from_azimuth_elevation(azimuth, elevation)
    np.testing.assert_allclose(rays_from_spherical(theta, phi), ray(azimuth, elevation), atol=1e-12)
    r, theta_2, phi_2 = spherical_from_points(3.7 * ray(azimuth, elevation))
    np.testing.assert_allclose([r, theta_2, phi_2], [3.7, theta, phi], atol=1e-7)
    np.testing.assert_allclose(azimuth_elevation_from_spherical(theta, phi), (azimuth, elevation), atol=1e-7)


def test_the_sign_of_the_azimuth_survives() -> None:
    theta, phi = spherical_from_azimuth_elevation(np.deg2rad(-20), np.deg2rad(10))
    azimuth, _ = azimuth_elevation_from_spherical(theta, phi)
    assert np.rad2deg(azimuth) == pytest.approx(-20)
    # Eq 2.8 as printed
    tangent = np.tan(theta) ** 2
    printed = np.arccos(np.sqrt((np.cos(phi) ** 2 * tangent + 1) / (tangent + 1)))
    assert np.rad2deg(printed) == pytest.approx(20)


@pytest.mark.parametrize(("pan", "elevation", "azimuth", "error_deg"), [(30, 20, 10, 4.6), (90, 20, 20, 25.6)])
def test_adding_pan_to_the_azimuth_is_wrong_by_what_was_measured(
    pan: float, elevation: float, azimuth: float, error_deg: float
) -> None:
    local = ray(np.deg2rad(azimuth), np.deg2rad(elevation))
    exact = pan_tilt_pose(np.deg2rad(pan), 0.0) @ local
    added = ray(np.deg2rad(azimuth + pan), np.deg2rad(elevation))
    assert np.rad2deg(np.arccos(exact @ added)) == pytest.approx(error_deg, abs=0.05)
    # Pan adds to the longitude, exactly.
    assert spherical_from_points(exact)[1] == pytest.approx(spherical_from_points(local)[1] + np.deg2rad(pan))


@given(ANGLES, st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
def test_tilt_adds_to_the_elevation(azimuth: float, elevation: float, tilt: float) -> None:
    turned = pan_tilt_pose(0.0, tilt) @ ray(azimuth, elevation)
    np.testing.assert_allclose(turned, ray(azimuth, elevation + tilt), atol=1e-12)


def test_the_mount_turns_with_the_unit() -> None:
    pose = pan_tilt_pose(np.pi / 2, 0.0, unit_from_scanner=Rigid(np.eye(3), np.array([0.2, 0.0, 0.1])))
    np.testing.assert_allclose(pose @ np.zeros(3), [0.0, 0.2, 0.1], atol=1e-15)


@given(st.floats(-3, 3), st.floats(-0.8, 0.6), st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-1, 1)] * 3))
def test_many_positions_at_once_are_those_one_by_one(
    pan: float, tilt: float, turn: tuple[float, float, float], lever: tuple[float, float, float]
) -> None:
    mount = Rigid.from_rotvec(turn, lever)
    points = np.array([[2.0, 1.0, -0.5], [0.0, 0.0, 0.0], [-3.0, 0.2, 4.0]])
    pans, tilts = pan + np.array([0.0, 0.5, -1.0]), tilt + np.array([0.0, -0.1, 0.2])
    wanted = [pan_tilt_pose(a, b, unit_from_scanner=mount) @ p for a, b, p in zip(pans, tilts, points, strict=True)]
    np.testing.assert_allclose(turned_by_unit(mount @ points, pans, tilts), wanted, atol=1e-12)
    np.testing.assert_allclose(
        turned_by_unit(mount @ points, pan, tilt),
        pan_tilt_pose(pan, tilt, unit_from_scanner=mount) @ points,
        atol=1e-12,
    )


def test_an_upright_line_scans_from_the_zenith_over_ahead_to_the_nadir() -> None:
    # Rx(90 deg): what was left in the scanner's plane is up in the unit's frame.
    upright = Rigid.from_rotvec([np.pi / 2, 0, 0])
    rays = turned_by_unit(upright @ rays_of_line([np.pi / 2, 0.0, -np.pi / 2, np.pi]), np.pi / 2, 0.0)
    np.testing.assert_allclose(rays, [[0, 0, 1], [0, 1, 0], [0, 0, -1], [0, -1, 0]], atol=1e-15)


def test_the_thesis_form_of_the_columns_is_half_a_step_off() -> None:
    step = 0.01
    plain = AzimuthElevation(11, 21, step, step)
    thesis = AzimuthElevation(11, 21, step, step, azimuth_offset_rad=step / 2, elevation_offset_rad=step / 2)
    row, column = 3, 5
    azimuth, elevation = (21 / 2 - column) * step, (11 / 2 - row) * step
    np.testing.assert_allclose(thesis.rays[row, column], ray(azimuth, elevation), atol=1e-12)
    np.testing.assert_allclose(plain.rays[5, 10], [1, 0, 0], atol=1e-12)
