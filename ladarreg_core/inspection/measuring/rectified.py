"""Rectified views: the photographs on a plane or an unrolled pipe, at a stated scale, with an error for each pixel.

The surface of the scan is laid flat and drawn without perspective: each pixel shows what lies above its place, nearest
to the viewer. Where the laser measured nothing, or no photograph shows it, the view has a hole.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray, IntArray
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.foundations.validation import require_number, require_positive, require_type
from ladarreg_core.inspection.measuring.developable import Developable
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import scan_mesh
from ladarreg_core.surface.mesh.normals import cell_normals
from ladarreg_core.surface.ranges import range_noise_m
from ladarreg_core.surface.remap import look_up
from ladarreg_core.surface.texture.best_photo import NO_PHOTO
from ladarreg_core.surface.texture.registered_texture import COLORED, intensity_picture
from ladarreg_core.surface.uncertainty import surface_errors
from ladarreg_core.surface.visibility.rasterise import rasterise_values

MAX_PIXELS = 100_000_000
"""Largest view."""
_POINTS_AT_ONCE = 200_000
_MAX_SIGMAS = 1_000_000  # pixels whose error is computed; of larger views that of one stands for its neighbours
_LARGEST_CELLS = 4_000_000
_FINE, _BLUR = 1.5, 0.4  # pixels of a photograph in one of the view, from which it is blurred; by a sigma of so many
_FARTHEST, _NEAREST = 0.5, 1.0  # of 1 / depth, of the lowest and the highest point that is drawn


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RectifiedView:
    """A view of H x W pixels."""

    surface: Developable
    """What is laid flat."""
    image: ByteArray
    """(H, W, 3) uint8 RGB; black where it is not known."""
    known: BoolArray
    """(H, W) bool: False in holes."""
    relief_m: NDArray[np.float32]
    """(H, W) height of what is shown above the surface, m; NaN where the laser saw nothing."""
    sigma_m: NDArray[np.float32]
    """(H, W) standard deviation of the place of what is shown, in the view: root mean square distance, m; NaN in holes,
    and where a pose was given."""
    photo: NDArray[np.uint16]
    """(H, W) index of the photograph that is shown; `NO_PHOTO` in holes, and of a view of the laser's intensity."""
    photos: tuple[str, ...]
    """Names of the photographs by their indices."""
    left_m: float
    """Flat coordinate of the centres of the first column, m to the right."""
    top_m: float
    """Flat coordinate of the centres of the first row, m up."""
    mm_per_pixel: float
    """Scale."""

    @property
    def described_error(self) -> str:
        """The error of the place of what is shown, in words."""
        sigma = self.sigma_m[np.isfinite(self.sigma_m)]
        if not len(sigma):
            return "not known: the poses were given"
        return f"{1000 * np.median(sigma):.2g} mm in the median, {1000 * sigma.max():.2g} mm at most"

    def flat_of(self, row_column: FloatArray) -> NDArray[np.float64]:
        """Return the flat coordinates (..., 2), right and up, m, of places (..., 2) given by row and column."""
        step = self.mm_per_pixel / 1000
        return np.stack([self.left_m + step * row_column[..., 1], self.top_m - step * row_column[..., 0]], axis=-1)


def rectify(
    source: RegisteredScan | Scan,
    surface: Developable,
    *,
    mm_per_pixel: float,
    below_m: float = 0.5,
    above_m: float = 0.5,
    extent_m: tuple[float, float, float, float] | None = None,
    report: Report | None = None,
) -> RectifiedView:
    """Return the view of a surface at a scale.

    Args:
        source: a scan with its registered photographs, each pixel shown by the one that shows it best; or a scan alone,
            of which the intensity is shown.
        surface: a `Plane` or a `Cylinder`, scanner frame.
        mm_per_pixel: scale.
        below_m: how far behind the surface what is shown may lie, m.
        above_m: how far before it, m.
        extent_m: left, bottom, right and top of the view in flat coordinates; None: all that lies on the surface.
        report: receives the progress.

    Raises:
        DegenerateGeometryError: if nothing of the scan lies there.
        OptionError: if a number is invalid, or the view had more than 100 million pixels.
    """
    scan = source if isinstance(source, Scan) else require_type(source, RegisteredScan, "'source'").scan
    step = require_positive(mm_per_pixel, "mm_per_pixel") / 1000
    require_number(below_m, "below_m", least=0)
    require_number(above_m, "above_m", least=0)
    if below_m + above_m == 0:
        raise OptionError("below_m and above_m are both 0; what is shown needs some room about the surface")
    tell = report or (lambda _: None)
    tell(Progress(0, 4, "laying the surface flat"))
    drawn = _Drawn.of(scan, surface, below_m, above_m)
    left, bottom, right, top = _extent(drawn, extent_m)
    # whole pixels, so that views of one surface fit together
    first = np.floor([left / step, -top / step]).astype(np.int64)
    width, height = (max(1, int(np.ceil(last / step - 0.5)) - int(k) + 1)
                     for last, k in zip((right, -bottom), first, strict=True))  # fmt: skip
    if width * height > MAX_PIXELS:
        coarse = mm_per_pixel * np.sqrt(width * height / MAX_PIXELS)
        raise OptionError(
            f"the view would have {width:,} x {height:,} pixels; at most {MAX_PIXELS:,} are made: take "
            f"{coarse:.2g} mm per pixel, or a part of the surface"
        )
    left, top = float(first[0] * step), float(-first[1] * step)
    tell(Progress(1, 4, "drawing the surface"))
    relief, normals = drawn.rendered(left, top, step, width, height, below_m, above_m)
    seen = np.isfinite(relief)
    if not seen.any():
        raise DegenerateGeometryError("the scan has nothing on this part of the surface; take another extent or depth")
    tell(Progress(2, 4, "colouring the view"))
    rows, columns = np.nonzero(seen)
    flat = np.stack([left + step * columns, top - step * rows, relief[seen].astype(np.float64)], axis=-1)
    image = np.zeros((height, width, 3), np.uint8)
    photo = np.full((height, width), NO_PHOTO, np.uint16)
    points = surface.raised(flat)
    if isinstance(source, Scan):
        image[seen], known = _intensity(scan, points), seen
    else:
        found = source.point_colorer().colors_of(points)
        colored = np.isin(found.labels, [int(label) for label in COLORED]) & (found.photo < len(source.photos))
        for index, one in enumerate(source.photos):
            mine = np.flatnonzero(colored & (found.photo == index))
            if len(mine):
                image[rows[mine], columns[mine]] = _shown(one, points[mine], step)
        photo[rows[colored], columns[colored]] = found.photo[colored]
        known = photo != NO_PHOTO
    tell(Progress(3, 4, "propagating the uncertainty"))
    sigma = _sigmas(source, surface, flat, normals[seen], photo[seen], rows, columns, (height, width))
    sigma[~known] = np.nan
    tell(Progress(4, 4, "the view is made"))
    return RectifiedView(
        surface=surface, image=image, known=known, relief_m=relief, sigma_m=sigma, photo=photo,
        photos=() if isinstance(source, Scan) else tuple(one.photo.name for one in source.photos),
        left_m=left, top_m=top, mm_per_pixel=mm_per_pixel,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """The triangles that lie near a surface, laid flat."""

    flat: NDArray[np.float64]
    """(V, 3) right, up, above."""
    faces: IntArray
    """(F, 3)."""
    normals: NDArray[np.float32]
    """(V, 3), scanner frame."""

    @staticmethod
    def of(scan: Scan, surface: Developable, below_m: float, above_m: float) -> _Drawn:
        if scan.ranges.size > _LARGEST_CELLS:
            scan, _ = scan.thinned(_LARGEST_CELLS)
        mesh = scan_mesh(scan)
        flat = surface.flattened(mesh.vertices.astype(np.float64))
        inside = (flat[:, 2] >= -below_m) & (flat[:, 2] <= above_m)
        faces = mesh.faces[inside[mesh.faces].any(axis=1)]
        # triangles across the seam of a cylinder would be drawn through the whole view
        along = flat[:, 0][faces]
        faces = faces[np.ptp(along, axis=1) < surface.seam_m] if len(faces) else faces
        if not len(faces):
            raise DegenerateGeometryError(
                f"the scan has no surface within {below_m:g} m behind and {above_m:g} m before this one; place it "
                "elsewhere, or allow more"
            )
        used = np.unique(faces)
        number = np.zeros(len(flat), np.int32)
        number[used] = np.arange(len(used))
        return _Drawn(flat[used], number[faces], cell_normals(scan, mesh.cells[used] % np.array(mesh.shape, np.int32)))

    def rendered(
        self, left: float, top: float, step: float, width: int, height: int, below_m: float, above_m: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the relief (H, W), NaN where there is nothing, and the normals (H, W, 3), scanner frame.

        An ideal camera draws it: points are placed along the rays of their pixels, at a depth z with 1 / z linear in
        the height, which such a camera interpolates linearly in its image.
        """
        low, high = -below_m, above_m
        margin = 2 * (high - low)  # triangles reach beyond what is drawn
        inverse = _FARTHEST + (_NEAREST - _FARTHEST) * (self.flat[:, 2] - low + margin) / (high - low + 2 * margin)
        inside = (inverse > _FARTHEST)[self.faces].all(axis=1) & (inverse < _NEAREST)[self.faces].all(axis=1)
        z = 1 / np.clip(inverse, _FARTHEST / 2, _NEAREST * 2)
        u, v = (self.flat[:, 0] - left) / step, (top - self.flat[:, 1]) / step
        camera = Camera(width, height, float(width), float(width), (width - 1) / 2, (height - 1) / 2)
        places = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)
        depth, values = rasterise_values(places, self.faces[inside], self.normals / 2 + np.float32(0.5), camera)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (1 / depth.astype(np.float64) - _FARTHEST) / (_NEAREST - _FARTHEST)
            relief = low - margin + share * (high - low + 2 * margin)
            relief[~np.isfinite(depth) | (relief < low) | (relief > high)] = np.nan
            normals = values * 2 - 1
            normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        return relief.astype(np.float32), normals


def _extent(drawn: _Drawn, given: tuple[float, float, float, float] | None) -> tuple[float, float, float, float]:
    if given is None:
        low, high = drawn.flat[:, :2].min(axis=0), drawn.flat[:, :2].max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])
    left, bottom, right, top = (require_number(value, "a side of extent_m", unit="metres") for value in given)
    if left >= right or bottom >= top:
        raise OptionError("the extent is left, bottom, right and top in metres; right and top must be the larger ones")
    return left, bottom, right, top


def _shown(one: RegisteredPhoto, points: FloatArray, step: float) -> ByteArray:
    """Return the colours (N, 3) of a photograph at points (N, 3), for pixels of a size, m."""
    pose, camera, pixels = one.camera_from_scanner, one.camera, one.photo.pixels
    fine = step * camera.focal_px / float(np.median(np.linalg.norm(points - pose.centre, axis=1)))
    if fine > _FINE:  # a pixel of the view spans several of the photograph
        pixels = np.asarray(cv2.GaussianBlur(pixels, (0, 0), _BLUR * fine), np.uint8)
    place = np.nan_to_num(camera.project(pose @ points), nan=-1.0).astype(np.float32)
    u, v = (np.ascontiguousarray(place[None, :, k]) for k in (0, 1))
    return np.asarray(look_up(pixels, u, v)[0], np.uint8)


def _intensity(scan: Scan, points: FloatArray) -> ByteArray:
    """Return the colours (N, 3) of the laser's intensity at points (N, 3)."""
    picture, at = intensity_picture(scan), scan.geometry.cell_of(points)
    v, u = (np.ascontiguousarray(np.nan_to_num(at[None, :, k], nan=-1.0), dtype=np.float32) for k in (0, 1))
    return np.asarray(look_up(picture, u, v)[0], np.uint8)


def _sigmas(
    source: RegisteredScan | Scan, surface: Developable, flat: FloatArray, normals: FloatArray, photo: IntArray,
    rows: IntArray, columns: IntArray, shape: tuple[int, int],
) -> NDArray[np.float32]:  # fmt: skip
    """Return the standard deviations (H, W) of the places of N pixels; NaN elsewhere."""
    stride = max(1, int(np.ceil(np.sqrt(len(rows) / _MAX_SIGMAS))))
    result = np.full(shape, np.nan, np.float32)
    chosen = np.flatnonzero((rows % stride == 0) & (columns % stride == 0)) if stride > 1 else np.arange(len(rows))
    for first in range(0, len(chosen), _POINTS_AT_ONCE):
        some = chosen[first : first + _POINTS_AT_ONCE]
        points, axes = surface.raised(flat[some]), surface.axes(flat[some])
        found = np.full(len(some), np.nan)
        if isinstance(source, Scan):
            rays = points / np.linalg.norm(points, axis=1, keepdims=True)
            found = range_noise_m(source, rays) * np.linalg.norm(np.einsum("nij,nj->ni", axes, rays), axis=1)
        else:
            for index, one in enumerate(source.photos):
                mine = np.flatnonzero(photo[some] == index)
                if len(mine):
                    found[mine] = _photo_sigma(source.scan, one, points[mine], normals[some][mine], axes[mine])
        result[rows[some], columns[some]] = found
    if stride > 1:
        coarse = result[::stride, ::stride]
        result = np.repeat(np.repeat(coarse, stride, axis=0), stride, axis=1)[: shape[0], : shape[1]].copy()
    return result


def _photo_sigma(
    scan: Scan, one: RegisteredPhoto, points: FloatArray, normals: FloatArray, axes: FloatArray
) -> FloatArray:
    """Return the standard deviations (N,) of what a photograph shows at points (N, 3) along two axes (N, 2, 3)."""
    registration = one.registration
    pose, camera = registration.camera_from_scanner, registration.camera
    uv = camera.project(pose @ points)
    errors = surface_errors(camera, pose, registration.joint_covariance, points=points, normals=normals, uv=uv)
    if errors.by_pose is None:
        return np.full(len(points), np.nan)
    by_range = errors.by_range * range_noise_m(scan, points)[:, None]
    every = np.concatenate([errors.by_pose, by_range[:, None]], axis=1)
    return np.asarray(np.sqrt((np.einsum("npj,nij->npi", every, axes) ** 2).sum(axis=(1, 2))))
