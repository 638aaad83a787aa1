"""Spherical coordinates, and poses of a scanner on a pan/tilt unit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.frames import Rigid, rotation_about


def spherical_from_points(points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return range, longitude and polar angle of points or rays.

    Args:
        points: (..., 3), X forward, Y left, Z up.

    Returns:
        r (...,) in the points' unit; theta_s (...,) rad, positive to the left; phi_s (...,) rad from +Z, 0 to pi; NaN
        angles at the origin.

    Source: thesis 2.2.3, Eq 2.6 and 2.7.
    """
    p = np.asarray(points, dtype=np.float64)
    r = np.linalg.norm(p, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        phi = np.arccos(np.clip(p[..., 2] / r, -1, 1))
    return r, np.where(r > 0, np.arctan2(p[..., 1], p[..., 0]), np.nan), phi


def rays_from_spherical(theta_s: ArrayLike, phi_s: ArrayLike) -> NDArray[np.float64]:
    """Return the unit rays (..., 3) of longitudes and polar angles (rad)."""
    theta, phi = np.broadcast_arrays(np.asarray(theta_s, np.float64), np.asarray(phi_s, np.float64))
    return np.stack([np.sin(phi) * np.cos(theta), np.sin(phi) * np.sin(theta), np.cos(phi)], axis=-1)


def spherical_from_azimuth_elevation(
    azimuth: ArrayLike, elevation: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return longitude and polar angle (rad) of a two-mirror scanner's angles (rad).

    Source: thesis Eq 2.6, 2.7.
    """
    az, el = np.asarray(azimuth, np.float64), np.asarray(elevation, np.float64)
    theta = np.arctan2(np.sin(az), np.cos(az) * np.cos(el))
    return theta, np.arccos(np.clip(np.cos(az) * np.sin(el), -1, 1))


def azimuth_elevation_from_spherical(
    theta_s: ArrayLike, phi_s: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a two-mirror scanner's azimuth and elevation (rad) of longitudes and polar angles (rad).

    The thesis takes the azimuth by arccos, which loses its sign; it is asin(sin theta_s sin phi_s).

    Source: thesis Eq 2.8 (corrected), 2.9.
    """
    theta, phi = np.asarray(theta_s, np.float64), np.asarray(phi_s, np.float64)
    azimuth = np.arcsin(np.clip(np.sin(theta) * np.sin(phi), -1, 1))
    return azimuth, np.arctan2(np.cos(phi), np.sin(phi) * np.cos(theta))


def pan_tilt_pose(pan_rad: float, tilt_rad: float, *, unit_from_scanner: Rigid | None = None) -> Rigid:
    """Return `world_from_scanner` of a scanner on a pan/tilt unit.

    The world's origin is where the pan and tilt axes cross, Z is the pan axis, X is ahead at pan 0. The thesis adds the
    encoder angles to azimuth and elevation, which is off by 25 degrees at a pan of 90: pan adds to the longitude only,
    so the rotations are composed, and Eq 2.6 to 2.9 are applied to the rays that result.

    Args:
        pan_rad: positive to the left.
        tilt_rad: positive upward.
        unit_from_scanner: how the scanner is mounted on the part of the unit that pans and tilts; None: its centre
            where the axes cross, its axes along theirs.

    Source: thesis 2.2.3, corrected.
    """
    world_from_unit = Rigid(rotation_about("z", pan_rad) @ rotation_about("y", -tilt_rad), np.zeros(3))
    return world_from_unit if unit_from_scanner is None else world_from_unit @ unit_from_scanner


def turned_by_unit(vectors: ArrayLike, pan_rad: ArrayLike, tilt_rad: ArrayLike) -> NDArray[np.float64]:
    """Return vectors of the unit's moving frame in the world, each at a position of its own: Rz(pan) Ry(-tilt) v.

    Points turn like directions, since the axes cross at the origin of both frames.

    Args:
        vectors: (..., 3) in the frame that pans and tilts, of any unit.
        pan_rad: (...,) or scalar, positive to the left; broadcast against the vectors.
        tilt_rad: (...,) or scalar, positive upward.

    Returns:
        (..., 3), as `pan_tilt_pose` would map them one by one; NaN where a vector or an angle is NaN.

    Source: thesis 2.2.3, corrected.
    """
    v = np.asarray(vectors, dtype=np.float64)
    pan, tilt = np.asarray(pan_rad, dtype=np.float64), np.asarray(tilt_rad, dtype=np.float64)
    ahead = np.cos(tilt) * v[..., 0] - np.sin(tilt) * v[..., 2]
    up = np.sin(tilt) * v[..., 0] + np.cos(tilt) * v[..., 2]
    c, s = np.cos(pan), np.sin(pan)
    x, y, up = np.broadcast_arrays(c * ahead - s * v[..., 1], s * ahead + c * v[..., 1], up)
    return np.stack([x, y, up], axis=-1)


def rays_of_line(angles_rad: ArrayLike) -> NDArray[np.float64]:
    """Return the unit rays (..., 3) of a line scanner: angles (rad) in its X-Y plane, 0 ahead, positive to the left."""
    angle = np.asarray(angles_rad, dtype=np.float64)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
