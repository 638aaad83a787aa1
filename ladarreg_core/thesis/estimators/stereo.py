"""The thesis's stereo depths, equation by equation, and a fast evaluation of their sum of squares.

LADAR and colour camera are rectified to two parallel cameras, whose x and y disparities give one depth each. Frame and
symbols are the thesis's: x left, y up, z forward, x = -lambda X / Z; (Tx, Ty, Tz) is the centre of the colour camera in
the LADAR frame, and Q = Ry(-alpha) Rx(beta) Rz(gamma) rotates camera axes into LADAR axes. Corrections of printed
equations are noted in place.

Source: thesis 2.4.2, Eq 2.11-2.21.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, hypot, sin
from struct import Struct

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, ThesisParameters, look_along
from ladarreg_core.matches import Matches

STEREO_AXES_FROM_SCANNER = np.diag([-1.0, -1.0, 1.0]) @ CAMERA_AXES_FROM_SCANNER
"""From scanner axes (X forward, Y left, Z up) to the thesis's (x left, y up, z forward)."""
STEREO_AXES_FROM_SCANNER.flags.writeable = False

_WELL_IN_FRONT = np.cos(np.deg2rad(60.0))
_MIN_COSINE = 0.05  # closer to 90 degrees off the axis, depth does not determine range
_MIN_MEAN = 1e-3

POLE = 1e-140
"""Added to denominators: negligible beside any disparity, and avoids division by exactly 0."""
_STEREO_ROWS = Struct("20d 48x 3d 8x 48x 3d 8x")  # doubles, separated by zero bytes

_Coordinates = tuple[FloatArray, FloatArray]


def rectify(
    xc: FloatArray, yc: FloatArray, *, alpha: float, beta: float, gamma: float, focal: float = 1.0
) -> _Coordinates:
    """Return the coordinates in the colour image, rectified to the orientation of the LADAR.

    Args:
        xc: (N,) in the colour image.
        yc: (N,) likewise.
        alpha: pan, rad.
        beta: tilt, rad.
        gamma: roll, rad.
        focal: lambda, in the unit of the coordinates.

    Returns:
        x'c and y'c, (N,) each.

    Source: thesis Eq 2.13; its printed y'c has the opposite sign (without rotation it would be -yc).
    """
    sin_a, cos_a, sin_b, cos_b, sin_g, cos_g = sin(alpha), cos(alpha), sin(beta), cos(beta), sin(gamma), cos(gamma)
    across = xc * (sin_b * sin_a * sin_g - cos_a * cos_g) + yc * (sin_b * sin_a * cos_g + cos_a * sin_g)
    up = xc * cos_b * sin_g + yc * cos_b * cos_g + focal * sin_b
    along = xc * (cos_a * sin_b * sin_g + sin_a * cos_g) + yc * (cos_a * sin_b * cos_g - sin_a * sin_g)
    along = along - focal * cos_a * cos_b
    return focal * (across - focal * sin_a * cos_b) / along, -focal * up / along


def equal_baselines_rotation(Tx: float, Ty: float) -> FloatArray:
    """Return the rotation (2, 2) by omega1 = 45 deg - atan2(Ty, Tx) about the optical axis, which makes bx = by.

    Source: thesis Eq 2.15; the text says "rotated by -omega1", the matrix rotates by +omega1 and is correct.
    """
    return np.asarray(np.array([[Tx + Ty, Ty - Tx], [Tx - Ty, Tx + Ty]]) / np.sqrt(2 * (Tx * Tx + Ty * Ty)))


def equal_baseline(Tx: float, Ty: float) -> float:
    """Return bx = by, the baselines along x and y after that rotation. Source: thesis Eq 2.14."""
    return float(np.sqrt((Tx * Tx + Ty * Ty) / 2))


def rotate_coordinates(x: FloatArray, y: FloatArray, rotation: FloatArray) -> _Coordinates:
    """Return image coordinates (N,) rotated about the optical axis. Source: thesis Eq 2.15, 2.16."""
    return rotation[0, 0] * x + rotation[0, 1] * y, rotation[1, 0] * x + rotation[1, 1] * y


def stereo_depth(color: FloatArray, laser: FloatArray, *, baseline: float, Tz: float, focal: float = 1.0) -> FloatArray:
    """Return the depth (N,) from the disparity along one axis, x (Eq 2.19) or y (Eq 2.20).

    Args:
        colour: (N,) the rectified, rotated colour coordinate.
        laser: (N,) the rotated LADAR coordinate.
        baseline: bx or by, m.
        Tz: forward offset of the colour camera, m.
        focal: lambda.

    Returns:
        Zs, m: infinite without disparity; NaN without baseline as well.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((focal * baseline + Tz * color) / (color - laser))


def stereo_depths(
    parameters: ThesisParameters, laser: FloatArray, color: FloatArray, *, focal: float = 1.0
) -> _Coordinates:
    """Return both stereo depths of every match: rectify, rotate to equal baselines, divide by the disparities.

    Args:
        parameters: the pose.
        laser: (2, N) xl, yl.
        colour: (2, N) xc, yc.
        focal: lambda.

    Returns:
        Zxs and Zys, (N,) m each.

    Source: thesis Eq 2.13-2.20.
    """
    p = parameters
    x, y = rectify(color[0], color[1], alpha=p.alpha, beta=p.beta, gamma=p.gamma, focal=focal)
    if not hypot(p.Tx, p.Ty) > 0:
        return np.full_like(x, np.nan), np.full_like(x, np.nan)
    rotation, baseline = equal_baselines_rotation(p.Tx, p.Ty), equal_baseline(p.Tx, p.Ty)
    (xl, yl), (xc, yc) = rotate_coordinates(laser[0], laser[1], rotation), rotate_coordinates(x, y, rotation)
    return (
        stereo_depth(xc, xl, baseline=baseline, Tz=p.Tz, focal=focal),
        stereo_depth(yc, yl, baseline=baseline, Tz=p.Tz, focal=focal),
    )


def stereo_frame(rays_scanner: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) from scanner axes to axes whose X is the direction of depth for rays (N, 3).

    It is the identity if every ray lies within 60 degrees of the scanner's X. Otherwise X is the mean ray, so that
    matches to the side of the scanner have depths too.
    """
    if len(rays_scanner) == 0 or (rays_scanner[:, 0] >= _WELL_IN_FRONT).all():
        return np.eye(3)
    mean = rays_scanner.mean(axis=0)
    if not np.linalg.norm(mean) > _MIN_MEAN:  # rays all around: no preferred direction
        return np.eye(3)
    return np.asarray(CAMERA_AXES_FROM_SCANNER.T @ look_along(mean))


def pose_of(x: FloatArray, frame_from_scanner: FloatArray) -> Rigid:
    """Return `camera_from_scanner` of Tx, Ty, Tz (m), alpha, beta, gamma (rad) in a `stereo_frame` (3, 3)."""
    return ThesisParameters(*map(float, x)).pose @ Rigid(frame_from_scanner, np.zeros(3))


@dataclass(frozen=True, slots=True, eq=False)
class StereoPairs:
    """Matches in the coordinates of the thesis's two images, both with lambda = 1 and without lens distortion."""

    frame_from_scanner: FloatArray
    """(3, 3) rotation to the axes along whose X depth is measured; see `stereo_frame`."""
    laser: FloatArray
    """(2, M) xl, yl."""
    color: FloatArray
    """(2, M) xc, yc."""
    depth: FloatArray
    """(M,) Zl, m."""
    weights: FloatArray
    """(M,) multiply squared residuals."""
    usable: BoolArray
    """(M,) bool: in front of the scanner and within the field of the lens; other coordinates are meaningless."""

    @staticmethod
    def of(matches: Matches, camera: CameraModel, *, frame_from_scanner: ArrayLike | None = None) -> StereoPairs:
        """Return the pairs of matches.

        Args:
            matches: M matches.
            camera: the photo's camera, whose distortion is removed.
            frame_from_scanner: (3, 3), None: `stereo_frame` of the matches.
        """
        frame = stereo_frame(matches.rays) if frame_from_scanner is None else np.asarray(frame_from_scanner)
        points = STEREO_AXES_FROM_SCANNER @ frame @ matches.points.T
        with np.errstate(divide="ignore", invalid="ignore"):
            pinhole = camera.as_pinhole
            if pinhole is not None and not pinhole.distortion:
                color = (matches.uv.T - [[pinhole.cx], [pinhole.cy]]) / [[pinhole.fx], [pinhole.fy]]
            else:
                sight = camera.unproject(matches.uv).T
                # wide cameras also see beside and behind them
                color = np.where(sight[2] > 0, sight[:2] / sight[2], np.nan)
            laser = -points[:2] / points[2]  # both negated: camera to stereo axes
            usable = (points[2] > _MIN_COSINE * matches.ranges) & np.isfinite(color).all(axis=0)
        return StereoPairs(frame, laser, color, points[2], matches.weights, usable)

    def __len__(self) -> int:
        return len(self.depth)

    def subset(self, keep: BoolArray) -> StereoPairs:
        """Return the pairs of a mask (M,)."""
        return StereoPairs(
            self.frame_from_scanner,
            self.laser[:, keep],
            self.color[:, keep],
            self.depth[keep],
            self.weights[keep],
            self.usable[keep],
        )

    def pose(self, x: FloatArray) -> Rigid:
        """Return `camera_from_scanner` of Tx, Ty, Tz (m), alpha, beta, gamma (rad) in this frame."""
        return pose_of(x, self.frame_from_scanner)

    def parameters(self, camera_from_scanner: Rigid) -> FloatArray:
        """Return Tx, Ty, Tz (m), alpha, beta, gamma (rad) in this frame, (6,)."""
        ahead = bool((self.frame_from_scanner == np.eye(3)).all())  # as mostly: the frame is the scanner's
        turned = camera_from_scanner if ahead else camera_from_scanner @ Rigid(self.frame_from_scanner.T, np.zeros(3))
        p = ThesisParameters.from_pose(turned)
        return np.array([p.Tx, p.Ty, p.Tz, p.alpha, p.beta, p.gamma])

    def ahead(self, camera_from_scanner: Rigid) -> BoolArray:
        """Return which colour pixels (M,) point forward along the frame's X after derotation."""
        forward = camera_from_scanner.rotation @ self.frame_from_scanner[0]
        return np.asarray(forward @ np.vstack([self.color, np.ones(len(self))]) > 0)

    def depths(self, x: FloatArray) -> FloatArray:
        """Return Zxs and Zys (2, M) at the parameters (6,); see `stereo_depths`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack(stereo_depths(ThesisParameters(*map(float, x)), self.laser, self.color))

    def depth_errors(self, x: FloatArray) -> FloatArray:
        """Return sqrt((Zl - Zxs)^2 + (Zl - Zys)^2), (M,) m, the thesis's rejection criterion; infinite if undefined."""
        with np.errstate(invalid="ignore", over="ignore"):
            squared = ((self.depth - self.depths(x)) ** 2).sum(axis=0)
        return np.where(self.usable & np.isfinite(squared), np.sqrt(np.where(squared >= 0, squared, 0)), np.inf)


def stereo_cost(pairs: StereoPairs) -> Callable[[FloatArray], float]:
    """Return Ez of Eq 2.21 as a function of the pose that evaluates some ten thousand times a second.

    With w = (-xc, -yc, 1) the direction of a colour pixel and v = Q w, x'c = -v_x / v_z and y'c = -v_y / v_z.
    Multiplied by v_z, every numerator and denominator of Eq 2.21 is linear in nine terms, xl w, yl w and w, which do
    not depend on the pose. An evaluation is one product of a coefficient matrix with these terms; the rest is NumPy's
    call overhead, hence the preallocated buffers.

    Args:
        pairs: M matches, all usable.

    Returns:
        A function from x = (Tx, Ty, Tz, alpha, beta, gamma) in m and rad to m^2 (times weight); NaN at Tx = Ty = 0,
        where no stereo depth exists. It reuses its buffers and is not thread-safe.

    Source: thesis Eq 2.21, with lambda = 1.
    """
    count = len(pairs)
    sight = np.vstack([-pairs.color, np.ones(count)])
    terms = np.vstack([pairs.laser[0] * sight, pairs.laser[1] * sight, sight, np.ones(count)])
    coefficients, sums, values = np.zeros((4, 10)), np.empty((4, count)), np.empty(2 * count)
    denominators, numerators = sums[:2].reshape(-1), sums[2:].reshape(-1)
    depths, root_weights = np.tile(pairs.depth, 2), np.tile(np.sqrt(pairs.weights), 2)
    weighted = bool((pairs.weights != 1).any())
    pack, buffer, product, squares = _STEREO_ROWS.pack_into, coefficients.data, coefficients.dot, values.dot
    divide, subtract, multiply = np.divide, np.subtract, np.multiply

    def cost(x: FloatArray) -> float:
        Tx, Ty, Tz, alpha, beta, gamma = x.tolist()
        squared = Tx * Tx + Ty * Ty
        if not squared > 0:
            return float("nan")
        sin_a, cos_a, sin_b, cos_b, sin_g, cos_g = sin(alpha), cos(alpha), sin(beta), cos(beta), sin(gamma), cos(gamma)
        # x'c v_z, y'c v_z and v_z, as sums over w
        x0, x1, x2 = sin_a * sin_b * sin_g - cos_a * cos_g, cos_a * sin_g + sin_a * sin_b * cos_g, sin_a * cos_b
        y0, y1, y2 = -cos_b * sin_g, -cos_b * cos_g, sin_b
        z0, z1, z2 = cos_a * sin_b * sin_g + sin_a * cos_g, cos_a * sin_b * cos_g - sin_a * sin_g, cos_a * cos_b
        # x'c (Tx + Ty) + y'c (Ty - Tx), and x'c (Tx - Ty) + y'c (Tx + Ty)
        a, b = Tx + Ty, Ty - Tx
        u0, u1, u2 = a * x0 + b * y0, a * x1 + b * y1, a * x2 + b * y2
        v0, v1, v2 = a * y0 - b * x0, a * y1 - b * x1, a * y2 - b * x2
        az0, az1, az2, bz0, bz1, bz2 = -a * z0, -a * z1, -a * z2, b * z0, b * z1, b * z2
        n0, n1, n2 = squared * z0, squared * z1, squared * z2
        pack(
            buffer, 0,
            az0, az1, az2, -bz0, -bz1, -bz2, u0, u1, u2, POLE,
            bz0, bz1, bz2, az0, az1, az2, v0, v1, v2, POLE,
            n0 + Tz * u0, n1 + Tz * u1, n2 + Tz * u2,
            n0 + Tz * v0, n1 + Tz * v1, n2 + Tz * v2,
        )  # fmt: skip
        product(terms, sums)
        divide(numerators, denominators, values)
        subtract(depths, values, values)
        if weighted:
            multiply(values, root_weights, values)
        return float(squares(values))

    return cost
