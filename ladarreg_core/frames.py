"""Rigid transforms, the coordinate frames, and the thesis's six pose parameters.

| frame | axes |
|---|---|
| scanner | X forward, Y left, Z up |
| camera, view | x right, y down, z forward |
| world | those of the survey, as the scan's file states them; Z up |

A transform is named by both ends: `p_camera = camera_from_scanner @ p_scanner`.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import DegenerateGeometryError, ShapeError
from ladarreg_core.foundations.arrays import FloatArray, read_only

CAMERA_AXES_FROM_SCANNER = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation of a camera that looks along the scanner's X: x_camera = -Y, y_camera = -Z, z_camera = X."""
CAMERA_AXES_FROM_SCANNER.flags.writeable = False

_MAX_DECIMALS = 6
_STEREO_AXES = np.diag([-1.0, -1.0, 1.0])  # the thesis's stereo frame (x = -lambda X/Z) from the OpenCV one
# A product of very many points with a 3 x 3 matrix would be split among threads, which costs many times what it gains
# where cores are shared; in blocks it stays in the processor's cache, with the same result to the bit.
_BLOCK = 8192
_ORTHONORMAL_TOLERANCE = 1e-3
_MIN_FROM_VERTICAL_DEG = 0.005
_EYE = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Rigid:
    """A rotation followed by a translation: `transform @ point = rotation @ point + translation`.

    Raises:
        DegenerateGeometryError: if the rotation is a reflection, not finite, or off orthonormal by more than 1e-3;
            smaller errors (files often have six digits) are removed by projection.
    """

    rotation: FloatArray
    """(3, 3) float64, orthonormal, determinant +1."""
    translation: FloatArray
    """(3,) float64, metres."""

    def __post_init__(self) -> None:
        rotation = read_only(self.rotation, np.float64, (3, 3), "rotation")
        translation = read_only(self.translation, np.float64, (3,), "translation")
        (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()  # numbers of Python's own: poses are made by the hundred
        if not all(map(math.isfinite, (a, b, c, d, e, f, g, h, i, *translation.tolist()))):
            raise DegenerateGeometryError("the transform contains NaN or infinity; it needs 12 finite numbers")
        error = float(np.abs(rotation @ rotation.T - _EYE).max())
        if error > _ORTHONORMAL_TOLERANCE:
            raise DegenerateGeometryError(
                f"the rotation is off orthonormal by {error:.2g}; at most {_ORTHONORMAL_TOLERANCE:g} is allowed"
            )
        if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0:
            raise DegenerateGeometryError("the rotation is a reflection (determinant -1); it must be right-handed")
        if error > 1e-14:
            u, _, vt = np.linalg.svd(rotation)
            rotation = read_only(u @ vt, np.float64, (3, 3), "rotation")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    def __repr__(self) -> str:
        turn = rotvec_from_rotation(self.rotation)
        angle = float(np.linalg.norm(turn))
        axis = "" if angle < 1e-12 else " about ({:.3f}, {:.3f}, {:.3f})".format(*(turn / angle))
        moved = ", ".join(f"{value:.4f}" for value in self.translation)
        return f"Rigid(rotation {np.degrees(angle):.4f} deg{axis}, translation ({moved}) m)"

    @staticmethod
    def identity() -> Rigid:
        """Return the identity transform."""
        return Rigid(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> Rigid:
        """Return the transform of a homogeneous (4, 4) matrix.

        Raises:
            ShapeError: if it is not (4, 4).
            DegenerateGeometryError: if its last row is not 0 0 0 1, or its rotation is invalid.
        """
        m = read_only(matrix, np.float64, (4, 4), "the transform")
        if not np.allclose(m[3], [0, 0, 0, 1], atol=1e-9):
            raise DegenerateGeometryError(f"the transform's last row is {m[3].tolist()}; it must be 0 0 0 1")
        return Rigid(m[:3, :3], m[:3, 3])

    @staticmethod
    def from_rotvec(rotvec: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> Rigid:
        """Return the transform with the rotation exp([rotvec]x) (rad)."""
        return Rigid(rotation_from_rotvec(rotvec), np.asarray(translation, dtype=np.float64))

    @staticmethod
    def from_centre(rotation: ArrayLike, centre: ArrayLike) -> Rigid:
        """Return the transform into a frame whose origin is at `centre` (3,) in the source frame."""
        R = np.asarray(rotation, dtype=np.float64)
        return Rigid(R, -R @ np.asarray(centre, dtype=np.float64))

    @staticmethod
    def from_quaternion_wxyz(quaternion: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> Rigid:
        """Return the transform of a quaternion (w, x, y, z), of any length, and a translation (3,), m.

        Raises:
            DegenerateGeometryError: if the quaternion is zero or not finite.
        """
        q = read_only(quaternion, np.float64, (4,), "the quaternion")
        length = float(np.linalg.norm(q))
        if not (np.isfinite(length) and length > 1e-12):
            raise DegenerateGeometryError("the quaternion is zero or not finite; it needs four numbers, w x y z")
        w, x, y, z = (q / length).tolist()
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        return Rigid(R, np.asarray(translation, dtype=np.float64))

    @staticmethod
    def from_quaternion_xyzw(quaternion: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> Rigid:
        """Return the transform of a quaternion (x, y, z, w), as `from_quaternion_wxyz`."""
        return Rigid.from_quaternion_wxyz(
            np.roll(read_only(quaternion, np.float64, (4,), "the quaternion"), 1), translation
        )

    @staticmethod
    def from_json(text: str) -> Rigid:
        """Return the transform that `to_json` wrote.

        Raises:
            ShapeError: if the text is not such JSON.
            DegenerateGeometryError: if its rotation is invalid.
        """
        try:
            matrix = json.loads(text)["matrix"]
        except (ValueError, KeyError, TypeError):
            raise ShapeError('the text is not a transform; it must be {"matrix": 4 rows of 4 numbers}') from None
        return Rigid.from_matrix(matrix)

    def to_json(self) -> str:
        """Return the transform as JSON, `{"matrix": 4 rows of 4 numbers}`."""
        return json.dumps({"matrix": self.matrix.tolist()})

    @property
    def quaternion_wxyz(self) -> NDArray[np.float64]:
        """The rotation as a unit quaternion (4,), w x y z, with w >= 0; COLMAP, Eigen's constructor and OpenGL use
        this order."""
        R = self.rotation
        # The largest of 4 w^2, 4 x^2, 4 y^2, 4 z^2 is at least 1, so that dividing by its root is safe.
        squares = 1 + np.array([np.trace(R), *(2 * R[k, k] - np.trace(R) for k in range(3))])
        k = int(np.argmax(squares))
        rows = (
            (squares[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]),
            (R[2, 1] - R[1, 2], squares[1], R[1, 0] + R[0, 1], R[0, 2] + R[2, 0]),
            (R[0, 2] - R[2, 0], R[1, 0] + R[0, 1], squares[2], R[2, 1] + R[1, 2]),
            (R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2], squares[3]),
        )
        q = np.array(rows[k])
        q /= np.linalg.norm(q)
        return -q if q[0] < 0 else q

    @property
    def quaternion_xyzw(self) -> NDArray[np.float64]:
        """The same quaternion (4,) as x y z w, the order of ROS and SciPy."""
        return np.roll(self.quaternion_wxyz, -1)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The homogeneous matrix, (4, 4)."""
        m = np.eye(4)
        m[:3, :3] = self.rotation
        m[:3, 3] = self.translation
        return m

    @property
    def inverse(self) -> Rigid:
        """The inverse transform."""
        return Rigid(self.rotation.T, -self.rotation.T @ self.translation)

    @property
    def centre(self) -> NDArray[np.float64]:
        """The origin of the target frame, (3,), in the source frame: the camera's centre in the scanner's frame, m."""
        return np.asarray(-self.rotation.T @ self.translation, dtype=np.float64)

    @overload
    def __matmul__(self, other: Rigid) -> Rigid: ...
    @overload
    def __matmul__(self, other: FloatArray) -> FloatArray: ...
    def __matmul__(self, other: Rigid | FloatArray) -> Rigid | FloatArray:
        """Compose with another transform, or map points (..., 3); points keep their floating-point type."""
        if isinstance(other, Rigid):
            return Rigid(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)
        points = np.asarray(other)
        dtype: Any = points.dtype if points.dtype.kind == "f" else np.float64
        turned, shift = self.rotation.T.astype(dtype), self.translation.astype(dtype)
        if points.ndim != 2 or len(points) <= _BLOCK:
            return np.asarray(points @ turned + shift)
        mapped = np.empty(points.shape, dtype)
        for start in range(0, len(points), _BLOCK):
            block = slice(start, start + _BLOCK)
            np.matmul(points[block], turned, out=mapped[block])
            mapped[block] += shift
        return mapped

    def angle_to(self, other: Rigid) -> float:
        """Return the angle between the two rotations, rad."""
        return float(np.linalg.norm(rotvec_from_rotation(self.rotation @ other.rotation.T)))

    def distance_to(self, other: Rigid) -> float:
        """Return the distance between the two centres, m."""
        return float(np.linalg.norm(self.centre - other.centre))


def rotation_from_rotvec(rotvec: ArrayLike) -> NDArray[np.float64]:
    """Return exp([rotvec]x), (3, 3), of a rotation vector (3,) in rad. Source: Rodrigues' formula."""
    w = np.asarray(rotvec, dtype=np.float64).reshape(3)
    angle = float(np.linalg.norm(w))
    K = skew(w)
    if angle < 1e-4:  # Taylor: the next terms are below 1e-17
        return np.eye(3) + K * (1 - angle**2 / 6) + K @ K * (0.5 - angle**2 / 24)
    return np.asarray(np.eye(3) + K * (np.sin(angle) / angle) + K @ K * ((1 - np.cos(angle)) / angle**2))


def rotvec_from_rotation(rotation: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation vector (3,), rad, of length pi at most, of a rotation matrix (3, 3)."""
    R = np.asarray(rotation, dtype=np.float64)
    axis_sin = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine, cosine = float(np.linalg.norm(axis_sin)), float((np.trace(R) - 1) / 2)
    angle = np.arctan2(sine, cosine)
    if sine > 1e-6:
        return np.asarray(axis_sin * (angle / sine), dtype=np.float64)
    if cosine > 0:
        return axis_sin
    symmetric = (R + np.eye(3)) / 2  # at pi, R + I = 2 axis axis^T
    column = int(np.argmax(np.diag(symmetric)))
    axis = symmetric[:, column] / np.sqrt(symmetric[column, column])
    return np.asarray(axis / np.linalg.norm(axis) * angle, dtype=np.float64)


def wrap_angle(angle_rad: ArrayLike) -> NDArray[np.float64]:
    """Return angles, rad, of any shape, as the equal ones in [-pi, pi)."""
    return np.asarray((np.asarray(angle_rad) + np.pi) % (2 * np.pi) - np.pi)


def look_along(direction: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation (3, 3), view from scanner, of a camera facing along `direction` (3,) without roll."""
    forward = np.asarray(direction, dtype=np.float64)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:  # straight up or down: keep the scanner's right
        right = CAMERA_AXES_FROM_SCANNER[0]
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def skew(vector: ArrayLike) -> NDArray[np.float64]:
    """Return [v]x, (3, 3), with [v]x @ p = v x p."""
    x, y, z = np.asarray(vector, dtype=np.float64).reshape(3)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@dataclass(frozen=True, slots=True)
class RoundedParameter:
    """One of the thesis's six parameters, rounded to its significant decimals."""

    name: str
    """Tx, Ty, Tz, alpha, beta or gamma."""
    unit: str
    """m or deg."""
    value: str
    """The value."""
    sigma: str
    """The standard deviation; `unknown` where there is none."""


@dataclass(frozen=True, slots=True)
class ThesisParameters:
    """Camera position and orientation as the six parameters of the thesis's tables, in its stereo frame.

    In scanner axes (Tx, Ty, Tz) are (Y, Z, X): Tx positive is left, Ty up, Tz forward; alpha > 0 turns right,
    beta > 0 looks down, gamma is roll. Q = Ry(-alpha) Rx(beta) Rz(gamma) rotates camera axes into LADAR axes.

    Source: thesis 2.4.2, Eq 2.13, with the sign of its y'c corrected.
    """

    Tx: float
    """m, left."""
    Ty: float
    """m, up."""
    Tz: float
    """m, forward."""
    alpha: float
    """rad, pan about the vertical."""
    beta: float
    """rad, tilt."""
    gamma: float
    """rad, roll about the optical axis."""

    @staticmethod
    def from_pose(camera_from_scanner: Rigid) -> ThesisParameters:
        """Return the thesis's parameters of a pose."""
        # Into the stereo frame: x = left, y = up, z = forward on both sides.
        Q_cv = CAMERA_AXES_FROM_SCANNER @ camera_from_scanner.rotation.T
        Q = _STEREO_AXES @ Q_cv @ _STEREO_AXES
        T = _STEREO_AXES @ CAMERA_AXES_FROM_SCANNER @ camera_from_scanner.centre
        # Q = Ry(-alpha) Rx(beta) Rz(gamma):  Q[1, 2] = -sin beta,  Q[:, 2] = (-sin a cos b, -sin b, cos a cos b)
        cos_beta = float(np.hypot(Q[0, 2], Q[2, 2]))
        beta = np.arctan2(-Q[1, 2], cos_beta)
        if cos_beta > 1e-9:
            alpha = np.arctan2(-Q[0, 2], Q[2, 2])
            gamma = np.arctan2(Q[1, 0], Q[1, 1])
        else:  # straight up or down: only alpha and gamma together are determined
            alpha, gamma = 0.0, np.arctan2(-Q[0, 1], Q[0, 0])
        return ThesisParameters(float(T[0]), float(T[1]), float(T[2]), float(alpha), float(beta), float(gamma))

    @property
    def pose(self) -> Rigid:
        """The pose of these parameters: `camera_from_scanner`."""
        Q = rotation_about("y", -self.alpha) @ rotation_about("x", self.beta) @ rotation_about("z", self.gamma)
        Q_cv = _STEREO_AXES @ Q @ _STEREO_AXES
        centre = CAMERA_AXES_FROM_SCANNER.T @ _STEREO_AXES @ np.array([self.Tx, self.Ty, self.Tz])
        return Rigid.from_centre(Q_cv.T @ CAMERA_AXES_FROM_SCANNER, centre)

    def rounded(self, sigmas: ThesisParameters) -> tuple[RoundedParameter, ...]:
        """Return the parameters in m and degrees, with two digits of their standard deviations (m, rad)."""
        found = []
        for one in fields(self):
            value, sigma, unit = getattr(self, one.name), getattr(sigmas, one.name), "m"
            if not one.name.startswith("T"):
                value, sigma, unit = math.degrees(value), math.degrees(sigma), "deg"
            decimals = _decimals(sigma)
            sigma_text = f"{sigma:.{decimals}f}" if math.isfinite(sigma) else "unknown"
            found.append(RoundedParameter(one.name, unit, f"{value:.{decimals}f}", sigma_text))
        return tuple(found)

    def describe_position(self) -> str:
        """Return the camera position as text: '0.61 m left, 0.05 m down, 0.12 m forward'."""
        pairs = ((self.Tx, "left", "right"), (self.Ty, "up", "down"), (self.Tz, "forward", "back"))
        return ", ".join(f"{abs(value):.2f} m {plus if value >= 0 else minus}" for value, plus, minus in pairs)

    def describe_orientation(self) -> str:
        """Return the camera orientation as text: '7.31 deg right, 1.20 deg up, rolled 0.94 deg clockwise'.

        Clockwise is as seen from behind the camera.
        """
        pan, tilt, roll = np.degrees([self.alpha, self.beta, self.gamma])
        return (
            f"{abs(pan):.2f} deg {'right' if pan >= 0 else 'left'}, "
            f"{abs(tilt):.2f} deg {'down' if tilt >= 0 else 'up'}, "
            f"rolled {abs(roll):.2f} deg {'clockwise' if roll >= 0 else 'counter-clockwise'}"
        )


def _decimals(sigma: float) -> int:
    """Return how many decimals show two digits of a standard deviation."""
    if not (math.isfinite(sigma) and sigma > 0):
        return 4
    return min(max(1 - math.floor(math.log10(sigma)), 0), _MAX_DECIMALS)


def rotation_about(axis: str, angle_rad: float) -> NDArray[np.float64]:
    """Return the right-handed rotation matrix (3, 3) about one coordinate axis, `x`, `y` or `z`."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    R = np.eye(3)
    R[i, i] = R[j, j] = c
    R[i, j], R[j, i] = -s, s
    return R


def describe_position(point_m: ArrayLike) -> str:
    """Return a position (3,), m, in the world as text, to the millimetre however large its coordinates are."""
    x, y, z = np.asarray(point_m, dtype=np.float64).reshape(3).tolist()
    return f"X {x + 0.0:.3f}, Y {y + 0.0:.3f}, Z {z + 0.0:.3f} m"


def describe_direction(direction: ArrayLike) -> str:
    """Return a direction (3,) in the world as text: '31.20 deg clockwise from the Y axis, 2.10 deg up'.

    Where Y is north, as in the coordinates of most surveys, the first angle is the azimuth. A vertical direction has
    none.
    """
    x, y, z = np.asarray(direction, dtype=np.float64).reshape(3).tolist()
    level = float(np.hypot(x, y))
    pitch = float(np.degrees(np.arctan2(z, level)))
    if 90 - abs(pitch) < _MIN_FROM_VERTICAL_DEG:
        return "straight up" if pitch > 0 else "straight down"
    heading = round(float(np.degrees(np.arctan2(x, y))) % 360, 2) % 360
    return f"{heading:.2f} deg clockwise from the Y axis, {abs(pitch):.2f} deg {'down' if pitch < 0 else 'up'}"


def describe_world(world_from_scanner: Rigid) -> dict[str, str]:
    """Return where a scanner stands in the world, as texts: its position, heading (of its X axis) and tilt."""
    x_axis, z_axis = world_from_scanner.rotation[:, 0], world_from_scanner.rotation[:, 2]
    tilt = float(np.degrees(np.arctan2(np.hypot(z_axis[0], z_axis[1]), z_axis[2])))
    return {
        "position": describe_position(world_from_scanner.translation),
        "heading": f"the scanner's X axis points {describe_direction(x_axis)}",
        "tilt": f"{tilt:.2f} deg from upright",
    }


def principal_extents(points: FloatArray) -> FloatArray:
    """Return the root mean square extents (3,) of points (N, 3) along their principal axes, largest first, m."""
    centred = points - points.mean(axis=0)
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(centred.T @ centred / len(points))[::-1], 0)))
