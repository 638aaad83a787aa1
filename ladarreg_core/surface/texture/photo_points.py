"""The laser's point under each pixel of a registered photograph, and how far it can be off.

A pixel's ray meets a triangle of the scan's surface. Triangles do not span depth edges, so no point lies between two
surfaces. The point X = C + s d, on a surface with the unit normal n, is off by

    dX = (I - d n^T / (n . d)) (c + s dd) + d (n . l) / (n . d) dr

where c is the error of the camera's centre, dd that of the ray's direction d, from the camera's rotation, its uncertain
intrinsics and the pixel itself, and dr the error of the range there along the laser's ray l. The ranges of the three
corners are averaged by their weights in the triangle, w, so that dr has the standard deviation sigma_range |w|. `sigma`
is the root of the trace of the covariance of dX: the root mean square of its length.
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
from ladarreg_core.foundations.arrays import FloatArray, IntArray, read_only
from ladarreg_core.foundations.validation import require_choice, require_number, require_type
from ladarreg_core.frames import Rigid
from ladarreg_core.results import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import Mesh, scan_mesh
from ladarreg_core.surface.mesh.normals import cell_normals
from ladarreg_core.surface.uncertainty import covariance_factor
from ladarreg_core.surface.visibility.rasterise import covering_pinhole, rasterise_values

Frame = Literal["scanner", "world"]
_MAX_CELLS = 4_000_000  # larger scans are thinned
_ROWS_AT_ONCE = 64
_DIGITS = 1024  # of a triangle's number, drawn as three colours
_MIN_COSINE = 0.02
_PAIRS_AT_ONCE = 1_000_000
_RIM = 1e-9
_TILE_PX = 16
_BENT = np.float32(0.25)  # of a triangle's extent in the photograph, beyond its corners
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
    if not registration.is_shown:
        raise ExportError(
            "the pose was refused, so its photograph has no coordinates; accept another pose, or give one"
        )
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
    factor: NDArray[np.float64] | None
    """Root of the covariance of pose and intrinsics; None: not known."""
    joint: CameraUncertainty | None
    sigma_range_m: float
    sigma_uv_px: float

    @staticmethod
    def of(scan: Scan, registration: PoseResult, sigma_range_m: float, sigma_uv_px: float) -> _Surface:
        pose, camera = registration.camera_from_scanner, registration.camera
        mesh: Mesh = scan_mesh(scan)
        vertices = mesh.vertices.astype(np.float64)
        known = registration.joint_covariance
        in_camera = np.asarray(pose @ vertices, dtype=np.float64)
        uv = camera.project(in_camera)
        return _Surface(
            camera, pose, vertices, in_camera, uv, cell_normals(scan, mesh.cells),
            _faces_near(mesh.faces, uv, camera),
            None if known is None else covariance_factor(known),
            known if isinstance(known, CameraUncertainty) and camera.as_pinhole is not None else None,
            sigma_range_m, sigma_uv_px,
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

    def points_on(
        self, triangles: IntArray, rays: FloatArray, uv: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return points (N, 3), scanner frame, their sigma (N,) and normals (N, 3) of rays (N, 3) on triangles.

        They are NaN where there is none.
        """
        points, sigma, normals = np.full((len(rays), 3), np.nan), np.full(len(rays), np.nan), np.full_like(rays, np.nan)
        hit = np.flatnonzero(triangles >= 0)
        if not len(hit):
            return points, sigma, normals
        corners = self.faces[triangles[hit]]
        R, d_camera = self.pose.rotation, rays[hit]
        d = d_camera @ R
        weights, depth = _met(self.in_camera[corners], d_camera)
        inner = weights.clip(0, 1)
        inner /= inner.sum(axis=1, keepdims=True)
        normal = (self.normals[corners] * inner[..., None]).sum(axis=1)
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        cosine = (normal * d).sum(axis=1)
        cosine = np.where(np.abs(cosine) < _MIN_COSINE, np.where(cosine > 0, 1, -1) * _MIN_COSINE, cosine)
        # A pixel's centre may lie beside the triangle that was drawn there: the smoothed surface is extended to it.
        beside = np.asarray(~(weights >= -_RIM).all(axis=1))
        border = (self.vertices[corners] * inner[..., None]).sum(axis=1) - self.pose.centre
        extended = (border * normal).sum(axis=1) / cosine
        depth, weights = np.where(beside, extended, depth), np.where(beside[:, None], inner, weights)
        with np.errstate(invalid="ignore"):
            far = np.abs(depth - np.linalg.norm(border, axis=1))
            close = np.flatnonzero((depth > 0) & (far <= _MAX_EXTENDED * depth))
        hit, d, d_camera = hit[close], d[close], d_camera[close]
        weights, depth, normal, cosine = weights[close], depth[close], normal[close], cosine[close]
        found = self.pose.centre + depth[:, None] * d
        points[hit], normals[hit] = found, normal
        if self.factor is None:
            return points, sigma, normals
        turned = (
            np.cross(d_camera[:, None], self.factor[:3].T[None]) @ R
        )  # (N, P, 3): d_camera x w, in the scanner's axes
        moved = self.factor[3:6].T[None] + depth[:, None, None] * turned
        by_pixel = self._direction_by_pixel(uv[hit], d_camera)
        if self.joint is not None:
            xy = d_camera[:, :2] / d_camera[:, 2:]
            by_lens = self.joint.jacobian(self.camera, xy) @ self.factor[6:]  # type: ignore[arg-type]
            moved = moved - depth[:, None, None] * np.einsum("nik,nkp->npi", by_pixel, by_lens)
        if self.sigma_uv_px:
            moved = np.concatenate(
                [moved, depth[:, None, None] * self.sigma_uv_px * np.moveaxis(by_pixel, 1, 2)], axis=1
            )
        along = (moved * normal[:, None]).sum(axis=-1) / cosine[:, None]
        error = moved - along[..., None] * d[:, None]
        laser = found / np.linalg.norm(found, axis=1, keepdims=True)
        by_range = (normal * laser).sum(axis=1) / cosine * self.sigma_range_m * np.linalg.norm(weights, axis=1)
        sigma[hit] = np.sqrt((error * error).sum(axis=(1, 2)) + by_range**2)
        return points, sigma, normals

    def _direction_by_pixel(self, uv: FloatArray, d_camera: FloatArray) -> NDArray[np.float64]:
        """Return the derivative of the rays' directions by the pixel (N, 3, 2), scanner axes, 1/px."""
        columns = []
        for step in np.eye(2) * 0.5:
            ahead, behind = self.camera.unproject(uv + step), self.camera.unproject(uv - step)
            one_side = np.where(np.isfinite(ahead), ahead - d_camera, d_camera - behind) * 2
            columns.append(np.where(np.isfinite(ahead - behind), ahead - behind, one_side) @ self.pose.rotation)
        return np.stack(columns, axis=-1)


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
