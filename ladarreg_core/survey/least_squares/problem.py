"""The least-squares problem of a survey: bodies with poses, cameras, ties, and what is known between them.

Scanners and photographs are bodies: each has a pose `body_from_world` with the unknowns (w, c) of this project:
R_true = exp([w]x) R, c = the shift of its centre in the world, m. A camera has the unknowns of `INTRINSICS` if it is
estimated. A tie is a point of the world, seen in two photographs or more, and on the laser's surface where
there is one; or a straight line, seen in three, or in two and by the laser.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.camera.uncertainty import INTRINSICS, pose_jacobian
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.frames import Rigid, rotvec_from_rotation, skew

Matrix = FloatArray
WORLD = -1
"""In place of the index of a body: the world."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraUnknowns:
    """A camera that photographs share.

    Its values are those of the pixels as stored, the principal point from their middle, so that one camera serves
    photographs that were turned upright.
    """

    base: CameraModel
    """The camera of upright pixels with all that is not estimated, such as further terms of distortion."""
    values: Matrix
    """(4,) `INTRINSICS`; (0,) of a camera that is taken as it is."""
    prior: Matrix
    """(4,) likewise, before anything is adjusted."""
    covariance: Matrix
    """(4, 4) of the prior."""

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.values)


@dataclass(frozen=True, slots=True, eq=False)
class PhotoView:
    """How a body that is a photograph sees."""

    camera: int
    """Index of its camera."""
    turn: Matrix
    """(4, 4) from the values of the camera to those of the upright pixels."""
    middle: Matrix
    """(4,) what is then added: the middle of the upright pixels, for the principal point."""
    base: CameraModel
    """The camera of its pixels, before it is adjusted."""

    def camera_at(self, values: Matrix) -> CameraModel:
        """Return the camera of the photograph's pixels for values (4,) or (0,)."""
        pinhole = self.base.as_pinhole
        if not len(values) or pinhole is None:
            return self.base
        focal, k1, cx, cy = self.turn @ values + self.middle
        ratio = focal / pinhole.focal_px
        terms = (k1, *(pinhole.distortion[1:] or (0.0, 0.0, 0.0)))
        return replace(pinhole, fx=pinhole.fx * ratio, fy=pinhole.fy * ratio, cx=cx, cy=cy, distortion=terms)


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """What is known of the pose of one body relative to another, given the camera.

    The pose for values K of the camera is `pose`, moved by `by_camera` (K - `camera_values`); `covariance` is that of
    the pose for a known camera.
    """

    body: int
    """Index of the body."""
    base: int
    """Index of the other body, or `WORLD`."""
    pose: Rigid
    """body from base."""
    covariance: Matrix
    """(6, 6) of (w, c): w about the axes of the body, c in the frame of the base."""
    by_camera: Matrix | None = None
    """(6, 4)."""
    camera_values: Matrix | None = None
    """(4,), as of `CameraUnknowns`."""
    name: str = ""
    """What it came from, for users."""


RIG = "its rig"
"""Name of a relative pose that comes from a rig."""


@dataclass(frozen=True, slots=True, eq=False)
class Ties:
    """N observations of P points in photographs, and K on the surfaces of scans."""

    points: Matrix
    """(P, 3) world, m."""
    point: IntArray
    """(N,) index of the point of each observation."""
    photo: IntArray
    """(N,) index of the body."""
    uv: Matrix
    """(N, 2) photo pixels."""
    on_point: IntArray
    """(K,) index of the point of each place on a surface."""
    scan: IntArray
    """(K,) index of the body."""
    xyz: Matrix
    """(K, 3) scanner frame, m."""
    normal: Matrix
    """(K, 3) unit normals there."""
    sigma_m: Matrix
    """(K,) standard deviation across the surface, m."""
    stated_px: Matrix
    """(N,) standard deviation of each observation where it is stated, px; NaN: the noise that all residuals show."""
    drawn: IntArray
    """(P,) number of the tie that was drawn by hand, of a track the first one; -1: it was found."""

    @staticmethod
    def none() -> Ties:
        """Return no ties."""
        empty, indices = np.zeros((0, 3)), np.zeros(0, np.int64)
        return Ties(
            empty, indices, indices, np.zeros((0, 2)), indices, indices, empty, empty, np.zeros(0), np.zeros(0), indices
        )


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """N observations of L straight lines in photographs, and K of their places on the surfaces of scans.

    A line is two points, which move across it only: four unknowns, two for each point, along the axes of `across`.

    Source: the minimal local form of Bartoli and Sturm 2005, 'Structure-from-motion using lines'; with two points, it
    is as well determined as they are far apart.
    """

    points: Matrix
    """(L, 2, 3) two points of each line, where its drawn ends are; world, m."""
    line: IntArray
    """(N,) index of the line of each observation."""
    photo: IntArray
    """(N,) index of the body."""
    uv: Matrix
    """(N, 2, 2) the drawn ends, photo pixels; in each photograph any two places of the line."""
    sigma_px: Matrix
    """(N,) standard deviation of these, px."""
    on_line: IntArray
    """(K,) index of the line of each place on a surface."""
    at: Matrix
    """(K,) which of its points lies there: 0 is the first, 1 the second, and so on along the line."""
    scan: IntArray
    """(K,) index of the body."""
    xyz: Matrix
    """(K, 3) scanner frame, m."""
    normal: Matrix
    """(K, 3) unit normals there; of a line that was drawn in a scan, two directions across it for each end."""
    sigma_m: Matrix
    """(K,) standard deviation along these, m."""
    drawn: IntArray
    """(L,) number of the line that was drawn by hand."""

    @staticmethod
    def none() -> Lines:
        """Return no lines."""
        empty, indices, numbers = np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0)
        return Lines(
            np.zeros((0, 2, 3)), indices, indices, np.zeros((0, 2, 2)), numbers, indices, numbers, indices, empty,
            empty, numbers, indices,
        )  # fmt: skip

    @property
    def across(self) -> Matrix:
        """(L, 3, 2) two axes across each line."""
        along = self.points[:, 1] - self.points[:, 0]
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        helper = np.eye(3)[np.abs(along).argmin(axis=1)]
        first = np.cross(along, helper)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        return np.stack([first, np.cross(along, first)], axis=2)

    def moved(self, step: Matrix) -> Lines:
        """Return the lines after a step (L, 4): of the first point, then of the second, across the line."""
        by = np.einsum("lij,lpj->lpi", self.across, step.reshape(-1, 2, 2))
        return replace(self, points=self.points + by)


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """All unknowns with their values, and all that is known."""

    poses: tuple[Rigid, ...]
    """`body_from_world` of each body."""
    fixed: BoolArray
    """(B,) which bodies do not move."""
    views: tuple[PhotoView | None, ...]
    """How each body sees; None: it is a scanner."""
    cameras: tuple[CameraUnknowns, ...]
    relative: tuple[RelativePose, ...]
    ties: Ties
    lines: Lines = field(default_factory=Lines.none)

    @property
    def columns(self) -> tuple[IntArray, IntArray, int]:
        """First column of each body (-1: fixed) and of each camera (-1: not estimated), and their number."""
        of_body = np.full(len(self.poses), -1, np.int64)
        of_body[~self.fixed] = 6 * np.arange(int((~self.fixed).sum()))
        at = 6 * int((~self.fixed).sum())
        of_camera = np.full(len(self.cameras), -1, np.int64)
        for k, camera in enumerate(self.cameras):
            if camera.size:
                of_camera[k], at = at, at + camera.size
        return of_body, of_camera, at

    def moved(self, step: Matrix, points: Matrix, lines: Matrix | None = None) -> Problem:
        """Return the problem at other values: `step` (Y,) of bodies and cameras, `points` (P, 3), `lines` (L, 4)."""
        of_body, of_camera, _ = self.columns
        poses = tuple(
            pose if at < 0 else moved_pose(pose, step[at : at + 6])
            for pose, at in zip(self.poses, of_body, strict=True)
        )
        cameras = tuple(
            one if at < 0 else replace(one, values=one.values + step[at : at + one.size])
            for one, at in zip(self.cameras, of_camera, strict=True)
        )
        return replace(
            self, poses=poses, cameras=cameras, ties=replace(self.ties, points=self.ties.points + points),
            lines=self.lines if lines is None else self.lines.moved(lines),
        )  # fmt: skip

    def camera_of(self, body: int) -> CameraModel:
        """Return the camera of a photograph at the present values."""
        view = self.views[body]
        assert view is not None, "a scanner has no camera"
        return view.camera_at(self.cameras[view.camera].values)


def moved_pose(pose: Rigid, step: FloatArray) -> Rigid:
    """Return a pose after a step (6,) of (w, c)."""
    return Rigid.from_centre(Rigid.from_rotvec(step[:3]).rotation @ pose.rotation, pose.centre + step[3:])


def pose_difference(first: Rigid, second: Rigid) -> Matrix:
    """Return the (w, c) (6,) that leads from the second pose to the first: the step of `moved_pose`."""
    turn = rotvec_from_rotation(first.rotation @ second.rotation.T)
    return np.concatenate([turn, first.centre - second.centre])


def relative_residual(
    known: RelativePose, poses: Sequence[Rigid], camera_values: Matrix | None
) -> tuple[Matrix, Matrix, Matrix]:
    """Return the residual (6,) of a relative pose, present minus known, and its derivatives (6, 6).

    Args:
        known: the relative pose.
        poses: of all bodies.
        camera_values: of the body's camera; None: it has none.

    Returns:
        residual (w, c), and its derivatives by the body's (w, c) and by the base's.
    """
    body = poses[known.body]
    base = Rigid.identity() if known.base == WORLD else poses[known.base]
    R = body.rotation @ base.rotation.T
    centre = base.rotation @ (body.centre - base.centre)
    turn = rotvec_from_rotation(R @ known.pose.rotation.T)
    residual = np.concatenate([turn, centre - known.pose.centre])
    inverse = _left_jacobian_inverse(turn)
    by_body, by_base = np.zeros((6, 6)), np.zeros((6, 6))
    by_body[:3, :3], by_base[:3, :3] = inverse, -inverse @ R
    by_body[3:, 3:], by_base[3:, 3:] = base.rotation, -base.rotation
    by_base[3:, :3] = -skew(centre)
    if known.by_camera is not None and known.camera_values is not None and camera_values is not None:
        residual = residual - known.by_camera @ (camera_values - known.camera_values)
    return residual, by_body, by_base


def tie_residuals(problem: Problem) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return the residuals of the observations in photographs, observed minus predicted, and the derivatives.

    Returns:
        residual (N, 2) px; derivatives of the *prediction* by the pose (N, 2, 6), the camera (N, 2, 4) and the point
        (N, 2, 3). NaN behind a camera.
    """
    ties, count = problem.ties, len(problem.ties.photo)
    residual, by_pose = np.empty((count, 2)), np.empty((count, 2, 6))
    by_camera, by_point = np.zeros((count, 2, len(INTRINSICS))), np.empty((count, 2, 3))
    for body in np.unique(ties.photo).tolist():
        rows = np.flatnonzero(ties.photo == body)
        uv, J, of_camera = projected(problem, body, ties.points[ties.point[rows]])
        residual[rows] = problem.camera_of(body).difference(ties.uv[rows], uv)
        by_pose[rows], by_point[rows] = J, -J[..., 3:]  # a point moves against the camera's centre
        if of_camera.shape[2]:
            by_camera[rows] = of_camera
    return residual, by_pose, by_camera, by_point


def projected(problem: Problem, body: int, points: FloatArray) -> tuple[Matrix, Matrix, Matrix]:
    """Return where a photograph shows points (N, 3) of the world, and the derivatives.

    Returns:
        uv (N, 2) px; derivatives by the pose (N, 2, 6), and by its camera (N, 2, 4), or (N, 2, 0) of one that is not
        estimated. NaN behind the camera.
    """
    camera, view, pose = problem.camera_of(body), problem.views[body], problem.poses[body]
    uv, J = pose_jacobian(pose, points, camera)
    assert view is not None
    if not problem.cameras[view.camera].size:
        return uv, J, np.zeros((len(points), 2, 0))
    pinhole = camera.as_pinhole
    assert pinhole is not None, "only the intrinsics of pinholes are estimated"
    p = pose @ points
    with np.errstate(invalid="ignore", divide="ignore"):
        of_upright = pinhole.intrinsics_jacobian(p[:, :2] / p[:, 2:])
    of_upright[..., 0] /= pinhole.focal_px
    return uv, J, np.asarray(of_upright @ view.turn)


def surface_residuals(problem: Problem) -> tuple[Matrix, Matrix, Matrix]:
    """Return how far points lie before the surfaces of scans, and the derivatives.

    Returns:
        distance (K,) m; derivatives by the scanner's (w, c), (K, 6), and by the point, (K, 3).
    """
    ties = problem.ties
    return surface_distances(problem, ties.scan, ties.points[ties.on_point], ties.xyz, ties.normal)


def surface_distances(
    problem: Problem, scan: IntArray, points: Matrix, xyz: Matrix, normal: Matrix
) -> tuple[Matrix, Matrix, Matrix]:
    """Return how far points (K, 3) of the world lie before places of the surfaces of scans, see `surface_residuals`.

    Args:
        problem: the problem.
        scan: (K,) index of the scanner's body.
        points: the points.
        xyz: (K, 3) the places, scanner frame.
        normal: (K, 3) unit normals there.
    """
    rotations = np.array([pose.rotation for pose in problem.poses])[scan]
    centres = np.array([pose.centre for pose in problem.poses])[scan]
    there = np.einsum("kij,kj->ki", rotations, points - centres)
    distance = np.einsum("ki,ki->k", normal, there - xyz)
    by_point = np.einsum("ki,kij->kj", normal, rotations)
    by_turn = np.cross(there, normal)  # n . (w x y) = w . (y x n)
    return distance, np.concatenate([by_turn, -by_point], axis=1), by_point


def _left_jacobian_inverse(turn: Matrix) -> Matrix:
    angle = float(np.linalg.norm(turn))
    W = skew(turn)
    if angle < 1e-6:
        return np.eye(3) - W / 2
    factor = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    return np.asarray(np.eye(3) - W / 2 + factor * W @ W)
