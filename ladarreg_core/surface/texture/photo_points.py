"""The laser's point under each pixel of a registered photograph, and how far it can be off.

A pixel's ray meets a triangle of the scan's surface. Triangles do not span depth edges, so no point lies between two
surfaces. `surface_errors` says what moves the point; the ranges of the triangle's three corners are averaged by their
weights w, so that its range has the standard deviation sigma_range |w|. `sigma` is the root of the trace of the
covariance: the root mean square of the error's length.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.camera import Camera, CameraModel, cube_faces
from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.errors import ExportError, OptionError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray, read_only
from ladarreg_core.foundations.validation import require_choice, require_number, require_type
from ladarreg_core.frames import Rigid
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import Mesh, scan_mesh
from ladarreg_core.surface.mesh.normals import cell_normals
from ladarreg_core.surface.uncertainty import SurfaceErrors, away_from_zero, pixel_sigma, surface_errors
from ladarreg_core.surface.visibility.rasterise import covering_pinhole, rasterise_values

Frame = Literal["scanner", "world"]
_MAX_CELLS = 4_000_000  # larger scans are thinned
_ROWS_AT_ONCE = 64
_DIGITS = 1024  # of a triangle's number, drawn as three colours
_PAIRS_AT_ONCE = 1_000_000
_RIM = 1e-9
_TILE_PX = 16
_BENT = np.float32(0.25)  # of a triangle's extent in the photograph, beyond its corners
_AROUND = 8  # pixels on a circle where another surface is looked for
_REACH_SIGMAS, _REACH_CELLS = 2.5, 1.0
_MIN_REACH_PX, _MAX_REACH_PX = 1.0, 40.0
_STEEPEST = 5.7  # tan 80 deg
_NOISE_SIGMAS = 4.0
_MAX_EXTENDED = 0.05  # of the distance, between a triangle and the pixel beside it


class PhotoPoints(NamedTuple):
    """Points of the laser under pixels of a photograph."""

    xyz: NDArray[np.floating]
    """(H, W, 3), or (N, 3) of chosen pixels, m; NaN where the laser saw no surface. float32 in the frame of the
    scanner, float64 in the world."""
    sigma: NDArray[np.float32]
    """(H, W) or (N,) standard deviation of the point, m: root mean square length of its error; NaN where there is no
    point, or the uncertainty of the pose is not known because it was given."""


class PhotoPointsWithNormals(NamedTuple):
    """Points of the laser under pixels of a photograph, and the directions of the surface there."""

    xyz: NDArray[np.floating]
    """As in `PhotoPoints`."""
    sigma: NDArray[np.float32]
    """As in `PhotoPoints`."""
    normals: NDArray[np.float32]
    """(H, W, 3) or (N, 3) unit normals toward the scanner, in the frame of the points; NaN where there is no point."""


@overload
def xyz_of_photo(
    scan: Scan,
    registration: PoseResult,
    *,
    at: ArrayLike | None = None,
    frame: Frame = "scanner",
    sigma_range_m: float | None = None,
    sigma_uv_px: float = 0.0,
    normals: Literal[False] = False,
) -> PhotoPoints: ...
@overload
def xyz_of_photo(
    scan: Scan,
    registration: PoseResult,
    *,
    at: ArrayLike | None = None,
    frame: Frame = "scanner",
    sigma_range_m: float | None = None,
    sigma_uv_px: float = 0.0,
    normals: Literal[True],
) -> PhotoPointsWithNormals: ...
def xyz_of_photo(
    scan: Scan,
    registration: PoseResult,
    *,
    at: ArrayLike | None = None,
    frame: Frame = "scanner",
    sigma_range_m: float | None = None,
    sigma_uv_px: float = 0.0,
    normals: bool = False,
) -> PhotoPoints | PhotoPointsWithNormals:
    """Return the laser's point under each pixel of a registered photograph, or under chosen pixels, with its sigma.

    Args:
        scan: the scan.
        registration: the result for the photograph, accepted or given; its camera may be of any model.
        at: (N, 2) pixels (u, v), also between pixel centres; None: all of the photograph.
        frame: `scanner`, or `world` if the scan states where it stands.
        sigma_range_m: noise of a range, m; None: that of the registration.
        sigma_uv_px: standard deviation of the pixels along each axis, e.g. of clicks.
        normals: return the surface's normals, too.

    Returns:
        Points and standard deviations, and normals if they are asked for: of the scan's surface, averaged over a window
        that suits its noise and between the corners of a triangle, without the uncertainty of the pose. Points are not
        interpolated across depth edges; where two surfaces follow each other within a pixel it may be either.

    Raises:
        ExportError: if the pose was refused.
        OptionError: if the frame is unknown or there is no world, a standard deviation is negative, or `normals` is not
            a truth value.
        ShapeError: if `at` is not (N, 2).
    """
    require_type(scan, Scan, "'scan'")
    require_type(registration, PoseResult, "'registration'")
    require_choice(frame, get_args(Frame), "the frame")
    require_number(sigma_uv_px, "sigma_uv_px", least=0)
    require_type(normals, bool, "'normals'")
    noise = registration.sigma_range_m if sigma_range_m is None else sigma_range_m
    require_number(noise, "sigma_range_m", least=0)
    _require_shown(registration)
    world = scan.world_from_scanner
    if frame == "world" and world is None:
        raise OptionError("the frame is 'world', but the scan does not state where it stands; use 'scanner'")
    chosen = None if at is None else read_only(at, np.float64, (None, 2), "the pixels")
    if scan.ranges.size > _MAX_CELLS:
        scan, _ = scan.thinned(_MAX_CELLS)
    surface = _Surface.of(scan, registration, noise, sigma_uv_px)
    camera = registration.camera
    dtype: type[np.floating[Any]] = np.float64 if frame == "world" else np.float32
    if chosen is not None:
        inside = np.asarray(camera.contains(chosen, border=-0.5))
        rays = np.where(inside[:, None], camera.unproject(chosen), np.nan)
        found = surface.points_on(surface.first_hit(rays, chosen), rays, chosen)
        placed = _placed(*found, world if frame == "world" else None, dtype)
        return placed if normals else PhotoPoints(*placed[:2])
    shape = (camera.height, camera.width)
    xyz, sigmas = np.empty((*shape, 3), dtype), np.empty(shape, np.float32)
    directions = np.empty((*shape, 3), np.float32) if normals else None
    for rows, triangles, rays, uv in surface.rendered():
        found = surface.points_on(triangles, rays, uv)
        placed = _placed(*found, world if frame == "world" else None, dtype)
        xyz[rows], sigmas[rows] = placed.xyz.reshape(xyz[rows].shape), placed.sigma.reshape(sigmas[rows].shape)
        if directions is not None:
            directions[rows] = placed.normals.reshape(directions[rows].shape)
    return PhotoPoints(xyz, sigmas) if directions is None else PhotoPointsWithNormals(xyz, sigmas, directions)


def _placed(
    points: FloatArray, sigma: FloatArray, normals: FloatArray, world: Rigid | None, dtype: type[np.floating[Any]]
) -> PhotoPointsWithNormals:
    if world is not None:
        points, normals = world @ points, normals @ world.rotation.T
    return PhotoPointsWithNormals(
        np.asarray(points, dtype=dtype), np.asarray(sigma, dtype=np.float32), np.asarray(normals, dtype=np.float32)
    )


class PhotoPointErrors(NamedTuple):
    """Points of the laser under N pixels of a photograph with what moves them, for sums over several points."""

    xyz: NDArray[np.float64]
    """(N, 3) scanner frame, m; NaN where the laser saw no surface."""
    errors: SurfaceErrors
    """NaN where there is no point."""
    spread: NDArray[np.float64]
    """(N,) standard deviation of a point's range, over that of one cell's."""
    cosine: NDArray[np.float64]
    """(N,) of the angle at which the pixel's ray meets the surface; negative from the scanner's side."""
    at_edge: BoolArray
    """(N,) bool: within its uncertainty, or a cell, the pixel shows another surface, or none."""


def photo_point_errors(
    scan: Scan, registration: PoseResult, at: ArrayLike, *, sigma_uv_px: float = 0.0
) -> PhotoPointErrors:
    """Return the laser's points under some pixels with their errors one by one, see `xyz_of_photo`.

    Args:
        scan: the scan.
        registration: the result for the photograph.
        at: (N, 2) pixels (u, v).
        sigma_uv_px: standard deviation of the pixels along each axis; only `at_edge` depends on it.

    Raises:
        ExportError: if the pose was refused.
        OptionError: if the standard deviation is negative.
        ShapeError: if `at` is not (N, 2).
    """
    require_number(sigma_uv_px, "sigma_uv_px", least=0)
    _require_shown(registration)
    uv = read_only(at, np.float64, (None, 2), "the pixels")
    if scan.ranges.size > _MAX_CELLS:
        scan, _ = scan.thinned(_MAX_CELLS)
    surface = _Surface.of(scan, registration, registration.sigma_range_m, sigma_uv_px)
    found = surface.seen(uv)
    count, known = len(uv), surface.covariance
    xyz, normals, spread = np.full((count, 3), np.nan), np.full((count, 3), np.nan), np.full(count, np.nan)
    xyz[found.rows], normals[found.rows], spread[found.rows] = found.points, found.normals, found.spread
    errors = surface_errors(surface.camera, surface.pose, known, points=xyz, normals=normals, uv=uv)
    at_edge = np.zeros(count, np.bool_)
    at_edge[found.rows] = surface.is_at_edge(uv[found.rows], found.points, max(scan.geometry.step_rad))
    cosine = (normals * (surface.camera.unproject(uv) @ surface.pose.rotation)).sum(axis=1)
    return PhotoPointErrors(xyz, errors, spread, cosine, at_edge)


def _require_shown(registration: PoseResult) -> None:
    if not registration.is_shown:
        raise ExportError(
            "the pose was refused, so its photograph has no coordinates; accept another pose, or give one"
        )


class _Met(NamedTuple):
    """Rays that met triangles."""

    rows: IntArray
    """(K,) numbers of the rays that did."""
    points: FloatArray
    """(K, 3), scanner frame, m."""
    normals: FloatArray
    """(K, 3) unit."""
    spread: FloatArray
    """(K,) as of `PhotoPointErrors`."""


@dataclass(frozen=True, slots=True, eq=False)
class _Surface:
    """The triangles of a scan that a camera may see, and what is uncertain about them."""

    camera: CameraModel
    pose: Rigid
    vertices: NDArray[np.float64]
    """(V, 3), scanner frame."""
    in_camera: NDArray[np.float64]
    """(V, 3), camera frame."""
    uv: FloatArray
    """(V, 2), photo pixels; NaN outside the camera's domain."""
    normals: NDArray[np.float32]
    """(V, 3), scanner frame."""
    faces: IntArray
    """(F, 3)."""
    covariance: FloatArray | CameraUncertainty | None
    """As `PoseResult.joint_covariance`."""
    sigma_range_m: float
    sigma_uv_px: float

    @staticmethod
    def of(scan: Scan, registration: PoseResult, sigma_range_m: float, sigma_uv_px: float) -> _Surface:
        pose, camera = registration.camera_from_scanner, registration.camera
        mesh: Mesh = scan_mesh(scan)
        vertices = mesh.vertices.astype(np.float64)
        in_camera = np.asarray(pose @ vertices, dtype=np.float64)
        uv = camera.project(in_camera)
        return _Surface(
            camera, pose, vertices, in_camera, uv, cell_normals(scan, mesh.cells),
            _faces_near(mesh.faces, uv, camera),
            registration.joint_covariance, sigma_range_m, sigma_uv_px,
        )  # fmt: skip

    def rendered(self) -> Iterator[tuple[slice, IntArray, FloatArray, FloatArray]]:
        """Yield bands of rows: the triangle of each pixel (-1: none), the pixels' rays (N, 3) and positions (N, 2)."""
        camera = self.camera
        pinhole = camera.as_pinhole
        if pinhole is not None:
            ideal = covering_pinhole(pinhole)
            views = [(ideal, np.eye(3), _numbers_drawn(self.in_camera, self.faces, ideal))]
        else:
            views = [
                (one.camera, one.face_from_camera,
                 _numbers_drawn(self.in_camera @ one.face_from_camera.T, self.faces, one.camera))
                for one in cube_faces(camera)
            ]  # fmt: skip
        for first in range(0, camera.height, _ROWS_AT_ONCE):
            rows = slice(first, min(first + _ROWS_AT_ONCE, camera.height))
            v, u = np.mgrid[rows, : camera.width]
            uv = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
            rays = camera.unproject(uv)
            found = np.full(len(uv), -1, np.int64)
            for view, turn, drawn in views:
                turned = rays @ turn.T
                with np.errstate(invalid="ignore", divide="ignore"):
                    here = (turned[:, 2] > 0) & (found < 0)
                    if len(views) > 1:
                        here &= turned[:, 2] >= np.abs(turned[:, :2]).max(axis=1)
                    at = turned[:, :2] / turned[:, 2:] * (view.fx, view.fy) + (view.cx, view.cy)
                column, row = np.rint(np.where(here[:, None] & np.isfinite(at), at, -1)).clip(-1, 2**31).astype(int).T
                inside = here & (column >= 0) & (row >= 0) & (column < view.width) & (row < view.height)
                found[inside] = drawn[row[inside], column[inside]]
            yield rows, found, rays, uv

    def first_hit(self, rays: FloatArray, at: FloatArray) -> IntArray:
        """Return the nearest triangle that each ray (N, 3), camera frame, of pixels (N, 2) meets; -1: none."""
        from scipy.spatial import cKDTree

        found = np.full(len(rays), -1, np.int64)
        known = np.flatnonzero(np.isfinite(rays).all(axis=1))
        if not len(known) or not len(self.faces):
            return found
        beside = self._faces_beside(at[known])
        corners = self.in_camera[self.faces[beside]]
        with np.errstate(invalid="ignore", divide="ignore"):
            corners = corners / np.linalg.norm(corners, axis=-1, keepdims=True)
            centre = corners.mean(axis=1)
            centre /= np.linalg.norm(centre, axis=-1, keepdims=True)
            reach = np.linalg.norm(corners - centre[:, None], axis=-1).max(axis=1) * 1.01
        usable = np.isfinite(reach)
        nearest = np.full(len(reach), np.inf)
        nearest[usable], _ = cKDTree(rays[known]).query(
            centre[usable], distance_upper_bound=float(reach[usable].max(initial=0)) + 1e-12
        )
        near = np.flatnonzero(nearest <= reach)
        candidates, centre, reach = beside[near], centre[near], reach[near]
        # One tree for all rays: a search by every ray over every triangle took most of the time of many pixels.
        tree = cKDTree(rays[known])
        counts = np.asarray(tree.query_ball_point(centre, reach, return_length=True))
        best = np.full(len(rays), np.inf)
        parts = np.flatnonzero(np.diff(np.cumsum(counts) // _PAIRS_AT_ONCE)) + 1
        for some in np.split(np.arange(len(candidates)), parts):
            hits = tree.query_ball_point(centre[some], reach[some])
            face = np.repeat(candidates[some], [len(one) for one in hits])
            ray = known[np.array([k for one in hits for k in one], dtype=np.int64)]
            weights, depth = _met(self.in_camera[self.faces[face]], rays[ray])
            meets = (weights >= -_RIM).all(axis=1) & (depth > 0) & (depth <= best[ray])
            ray, face, depth = ray[meets], face[meets], depth[meets]
            order = np.argsort(-depth, kind="stable")  # the last write, of the nearest, remains
            found[ray[order]], best[ray[order]] = face[order], depth[order]
        return found

    def _faces_beside(self, at: FloatArray) -> IntArray:
        """Return the numbers of the triangles that pixels (N, 2) may lie in, and of others: all, of a wide camera.

        A lens bends the sides of triangles, so that more is searched than the box around their corners.
        """
        if self.camera.as_pinhole is None:
            return np.arange(len(self.faces))
        shape = self.camera.height // _TILE_PX + 2, self.camera.width // _TILE_PX + 2
        column, row = (np.rint(at).astype(np.intp) // _TILE_PX).T + 1
        asked = np.zeros((shape[0] + 2, shape[1] + 2), np.int64)
        asked[row + 1, column + 1] = 1
        before = asked.cumsum(axis=0).cumsum(axis=1)  # [i, j]: of the tiles before row i and column j
        u, v = np.ascontiguousarray(self.uv.T, dtype=np.float32)
        with np.errstate(invalid="ignore"):
            low_u, high_u = _extremes(u, self.faces)
            low_v, high_v = _extremes(v, self.faces)
            more = _BENT * np.maximum(high_u - low_u, high_v - low_v) + np.float32(_TILE_PX)
            unknown = ~np.isfinite(more)
            first_j, last_j = (_tiles(side, shape[1]) for side in (low_u - more, high_u + more))
            first_i, last_i = (_tiles(side, shape[0]) for side in (low_v - more, high_v + more))
        count = before[last_i + 1, last_j + 1] - before[first_i, last_j + 1]
        count += before[first_i, first_j] - before[last_i + 1, first_j]
        return np.flatnonzero((count > 0) | unknown)

    def seen(self, uv: FloatArray) -> _Met:
        """Return where the rays of pixels (N, 2) meet the surface first."""
        inside = np.asarray(self.camera.contains(uv, border=-0.5))
        rays = np.where(inside[:, None], self.camera.unproject(uv), np.nan)
        return self.met(self.first_hit(rays, uv), rays)

    def is_at_edge(self, uv: FloatArray, points: FloatArray, step_rad: float) -> BoolArray:
        """Return (N,) whether pixels (N, 2) may show another surface than that of their points (N, 3).

        Around each, as far as its uncertainty and a cell of the scan reach, the surface is looked for: it is another
        one if there is none, or if it lies farther along the ray than a surface seen at 80 degrees could.
        """
        camera, pose, count = self.camera, self.pose, len(uv)
        if not count:
            return np.zeros(0, np.bool_)
        in_camera = pose @ points
        distance = np.linalg.norm(points - pose.centre, axis=1)
        cell_px = camera.focal_px * step_rad * np.linalg.norm(points, axis=1) / distance
        sigma = np.full(count, self.sigma_uv_px)
        if self.covariance is not None:
            sigma = np.hypot(sigma, np.nan_to_num(pixel_sigma(in_camera, camera, pose.rotation, self.covariance)))
        reach = np.clip(_REACH_SIGMAS * sigma + _REACH_CELLS * cell_px, _MIN_REACH_PX, _MAX_REACH_PX)
        angle = np.arange(_AROUND) * (2 * np.pi / _AROUND)
        circle = np.concatenate([share * np.stack([np.cos(angle), np.sin(angle)], axis=1) for share in (0.5, 1.0)])
        around = (uv[:, None] + reach[:, None, None] * circle).reshape(-1, 2)
        found = self.seen(around)
        away = np.full(len(around), np.inf)
        away[found.rows] = np.linalg.norm(found.points - pose.centre, axis=1)
        away[~np.asarray(camera.contains(around, border=-0.5))] = np.nan  # nothing is known beside the photograph
        aside = np.tile(np.repeat([0.5, 1.0], _AROUND), (count, 1)) * reach[:, None] / camera.focal_px
        allowed = _STEEPEST * distance[:, None] * aside + _NOISE_SIGMAS * self.sigma_range_m
        return np.asarray((np.abs(away.reshape(count, -1) - distance[:, None]) > allowed).any(axis=1))

    def points_on(
        self, triangles: IntArray, rays: FloatArray, uv: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return points (N, 3), scanner frame, their sigma (N,) and normals (N, 3) of rays (N, 3) on triangles.

        They are NaN where there is none.
        """
        points, sigma, normals = np.full((len(rays), 3), np.nan), np.full(len(rays), np.nan), np.full_like(rays, np.nan)
        found = self.met(triangles, rays)
        hit = found.rows
        points[hit], normals[hit] = found.points, found.normals
        if self.covariance is None or not len(hit):
            return points, sigma, normals
        errors = surface_errors(
            self.camera, self.pose, self.covariance, points=found.points, normals=found.normals, uv=uv[hit]
        )
        assert errors.by_pose is not None
        by_range = errors.by_range * (self.sigma_range_m * found.spread)[:, None]
        sigma[hit] = np.sqrt(
            (errors.by_pose**2).sum(axis=(1, 2))
            + self.sigma_uv_px**2 * (errors.by_pixel**2).sum(axis=(1, 2))
            + (by_range**2).sum(axis=1)
        )
        return points, sigma, normals

    def met(self, triangles: IntArray, rays: FloatArray) -> _Met:
        """Return where rays (N, 3), camera frame, meet the triangles (N,) of the same number; -1: none."""
        hit = np.flatnonzero(triangles >= 0)
        corners = self.faces[triangles[hit]]
        R, d_camera = self.pose.rotation, rays[hit]
        d = d_camera @ R
        weights, depth = _met(self.in_camera[corners], d_camera)
        inner = weights.clip(0, 1)
        inner /= inner.sum(axis=1, keepdims=True)
        normal = (self.normals[corners] * inner[..., None]).sum(axis=1)
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        cosine = away_from_zero((normal * d).sum(axis=1))
        # A pixel's centre may lie beside the triangle that was drawn there: the smoothed surface is extended to it.
        beside = np.asarray(~(weights >= -_RIM).all(axis=1))
        border = (self.vertices[corners] * inner[..., None]).sum(axis=1) - self.pose.centre
        extended = (border * normal).sum(axis=1) / cosine
        depth, weights = np.where(beside, extended, depth), np.where(beside[:, None], inner, weights)
        with np.errstate(invalid="ignore"):
            far = np.abs(depth - np.linalg.norm(border, axis=1))
            close = np.flatnonzero((depth > 0) & (far <= _MAX_EXTENDED * depth))
        found = self.pose.centre + depth[close, None] * d[close]
        return _Met(hit[close], found, normal[close], np.linalg.norm(weights[close], axis=1))


def _met(corners: FloatArray, rays: FloatArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where rays (N, 3) from zero meet the planes of triangles (N, 3, 3): weights (N, 3) and distances (N,)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        parts = np.stack(
            [(np.cross(p, q) * rays).sum(axis=1) for p, q in ((b, c), (c, a), (a, b))], axis=1
        )  # proportional to the weights
        weights = parts / parts.sum(axis=1, keepdims=True)
        depth = ((weights[..., None] * corners).sum(axis=1) * rays).sum(axis=1)
    return weights, depth


def _extremes(values: FloatArray, faces: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the smallest and the largest of values (V,) at the corners of triangles (F, 3); NaN if one is unknown."""
    a, b, c = (values.take(faces[:, k]) for k in range(3))
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def _tiles(pixels: FloatArray, count: int) -> IntArray:
    """Return the tiles of pixels along an axis, from 0 before the photograph to `count` - 1 beyond it."""
    tiles = np.nan_to_num(np.floor(pixels / np.float32(_TILE_PX)) + 1, nan=0.0).clip(0, count - 1)
    return np.asarray(tiles, dtype=np.intp)


def _faces_near(faces: IntArray, uv: FloatArray, camera: CameraModel) -> IntArray:
    """Return the triangles with a corner, pixels (V, 2), in the photograph or near it."""
    border = -0.1 * max(camera.size)
    with np.errstate(invalid="ignore"):
        inside = camera.contains(uv, border=border)
    return faces[np.asarray(inside)[faces].any(axis=1)]


def _numbers_drawn(in_view: FloatArray, faces: IntArray, camera: Camera) -> NDArray[np.int32]:
    """Return the number of the nearest triangle at each pixel of an ideal camera, (H, W); -1: none."""
    numbers = np.arange(len(faces))
    digits = np.stack([numbers % _DIGITS, numbers // _DIGITS % _DIGITS, numbers // _DIGITS**2], axis=-1)
    values = np.repeat(((digits + 0.5) / _DIGITS).astype(np.float32), 3, axis=0)
    corners = np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3)
    depth, drawn = rasterise_values(in_view[faces.reshape(-1)], corners, values, camera)
    found = np.floor(drawn * _DIGITS).astype(np.int32)
    number = found[..., 0] + _DIGITS * (found[..., 1] + _DIGITS * found[..., 2])
    return np.where(np.isfinite(depth) & (number < len(faces)), number, -1)
