"""The colours of a scan from several photographs: the best one colours each cell."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import ByteArray, FloatArray, IntArray, read_only
from ladarreg_core.foundations.palette import UNSEEN
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.frames import Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import grid_edges
from ladarreg_core.surface.remap import look_up
from ladarreg_core.surface.texture.registered_texture import (
    COLORED,
    Label,
    RegisteredTexture,
    TexturedPart,
    textured_parts,
)
from ladarreg_core.surface.uncertainty import pixel_sigma
from ladarreg_core.surface.visibility.visible_points import Occluder, ScanProjection

NO_PHOTO = np.iinfo(np.uint16).max
"""The photograph of cells and points that no photograph shows."""
_RANK: dict[int, int] = {Label.SEEN: 3, Label.GRAZING: 2, Label.UNCERTAIN: 1}
_COLORING = "colouring the scan"
_STEPS_PER_OCTAVE = 2  # finer differences of resolution count less than the uncertainty of the pose
_POINTS_AT_ONCE = 500_000
_TOLERANCE_RELATIVE = 0.002
_TOLERANCE_SIGMAS = 4.0
_COARSE_CELL_PX = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class PosedPhoto:
    """A photograph with the pose and the camera by which it is drawn."""

    photo: Photo
    """The photograph."""
    camera_from_scanner: Rigid
    """Its pose."""
    camera: CameraModel
    """Its intrinsics, given or estimated."""
    covariance: FloatArray | CameraUncertainty | None = None
    """(6, 6) of the pose as `PoseResult.covariance`, or of pose and camera; None: not known."""

    def reduced(self, factor: int) -> PosedPhoto:
        """Return the photograph with its sides divided by a whole number, so that many fit in memory together.

        Pixels and temperatures are means; the uncertainty of the intrinsics is left out.
        """
        photo = self.photo
        width, height = size = tuple(max(1, side // factor) for side in photo.camera.size)
        kelvin = photo.temperature_k
        if kelvin is not None:
            kelvin = np.asarray(cv2.resize(kelvin, size, interpolation=cv2.INTER_AREA), np.float32)
        small = Photo(
            np.asarray(cv2.resize(photo.pixels, size, interpolation=cv2.INTER_AREA), np.uint8),
            photo.camera.resized(width, height),
            name=photo.name,
            temperature_k=kelvin,
        )
        of_both = self.covariance
        of_pose = of_both.covariance[:6, :6] if isinstance(of_both, CameraUncertainty) else of_both
        return PosedPhoto(small, self.camera_from_scanner, self.camera.resized(width, height), of_pose)


@dataclass(frozen=True, slots=True, eq=False)
class CellColors:
    """The colours of a scan's cells, and where they come from; read-only."""

    image: ByteArray
    """(H, W, 3) uint8 RGB; cells that no photograph shows have a uniform colour."""
    labels: ByteArray
    """(H, W) uint8, codes of `Label`, in the photograph that colours the cell; the mildest reason where none does."""
    photo: NDArray[np.uint16]
    """(H, W) uint16: index of the photograph; `NO_PHOTO` where none shows the cell."""
    sigma_px: NDArray[np.float32]
    """(H, W) float32: standard deviation of the cell's position in that photograph, px; NaN where it is not known."""

    def __post_init__(self) -> None:
        image = read_only(self.image, np.uint8, (None, None, 3), "the image")
        shape = image.shape[:2]
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "labels", read_only(self.labels, np.uint8, shape, "the labels"))
        object.__setattr__(self, "photo", read_only(self.photo, np.uint16, shape, "the photographs"))
        object.__setattr__(self, "sigma_px", read_only(self.sigma_px, np.float32, shape, "the uncertainty"))

    @property
    def texture(self) -> RegisteredTexture:
        """The same as one texture, as of a single photograph."""
        return RegisteredTexture(self.image, self.labels)


@dataclass(frozen=True, slots=True, eq=False)
class PointColors:
    """The colours of points; the fields are those of `CellColours`, with (N,) for (H, W)."""

    color: NDArray[np.uint8]
    """(N, 3) uint8 RGB."""
    labels: NDArray[np.uint8]
    """(N,) uint8."""
    photo: NDArray[np.uint16]
    """(N,) uint16."""
    sigma_px: NDArray[np.float32]
    """(N,) float32."""


@dataclass(frozen=True, slots=True, eq=False)
class ShownPart:
    """What a photograph shows of a rectangle of a scan, and how well."""

    rows: slice
    """Rows of the scan."""
    columns: slice
    """Columns of the scan."""
    image: NDArray[np.uint8]
    """(h, w, 3), as `RegisteredTexture.image`."""
    labels: NDArray[np.uint8]
    """(h, w), as `RegisteredTexture.labels`."""
    merit: NDArray[np.int16]
    """(h, w): how well it shows each cell, from 0; -1 where it has no colour for it."""
    sigma_px: NDArray[np.float32]
    """(h, w): as of `CellColors`."""

    def compact(self) -> ShownPart:
        """Return a copy of the smallest rectangle that contains all cells in the picture."""
        seen = (self.merit >= 0) | (self.labels == Label.OCCLUDED)
        rows_used, columns_used = (_extent(seen.any(axis=1 - axis)) for axis in (0, 1))
        part = rows_used, columns_used
        return ShownPart(
            _shifted(self.rows, rows_used), _shifted(self.columns, columns_used),
            self.image[part].copy(), self.labels[part].copy(), self.merit[part].copy(), self.sigma_px[part].copy(),
        )  # fmt: skip


def shown_parts(scan: Scan, view: PosedPhoto, *, background: tuple[int, int, int] = UNSEEN) -> Iterator[ShownPart]:
    """Yield what a photograph shows of a scan, part by part, so that memory does not grow with the scan.

    Raises:
        ShapeError: if the camera is not of the photo's size.
    """
    for part in textured_parts(
        scan, view.photo, view.camera_from_scanner,
        camera=view.camera, covariance=view.covariance, background=background,
    ):  # fmt: skip
        colored = _table(COLORED)[part.labels]
        sigma = cell_sigma(scan, view, (part.rows, part.columns), colored)
        merit = np.where(colored, _merit(part, view.camera), np.int16(-1))
        yield ShownPart(part.rows, part.columns, part.image, part.labels, merit, sigma)


def best_photo(
    scan: Scan,
    views: Sequence[PosedPhoto],
    *,
    background: tuple[int, int, int] = UNSEEN,
    report: Report | None = None,
) -> CellColors:
    """Colour a scan by the photograph that shows each cell best.

    Cells that are seen come before those at grazing incidence, and these before uncertain ones; then the resolution of
    the photograph on the surface decides in steps of half an octave, then the uncertainty, then the order.

    Args:
        scan: the scan.
        views: the photographs.
        background: RGB of cells that none shows.
        report: receives the progress, in photographs, several times for each one on a large scan.

    Raises:
        ShapeError: if there are more than 65,534 photographs, or a camera is not of its photo's size.
    """
    if len(views) >= NO_PHOTO:
        raise ShapeError(f"there are {len(views)} photographs; give at most {NO_PHOTO - 1}")

    def say(index: int) -> None:
        if report is not None:
            report(Progress(index, len(views), _COLORING))

    def parts_of(index: int, view: PosedPhoto) -> Iterator[ShownPart]:
        say(index)
        for part in shown_parts(scan, view, background=background):
            yield part
            say(index)

    return best_of(scan, (parts_of(index, view) for index, view in enumerate(views)), background=background)


def best_of(
    scan: Scan, shown: Iterable[Iterable[ShownPart]], *, background: tuple[int, int, int] = UNSEEN
) -> CellColors:
    """Colour a scan as `best_photo` does, by what each photograph shows of it.

    Args:
        scan: the scan.
        shown: `shown_parts` of each photograph, taken one after the other.
        background: RGB of cells that none shows.
    """
    shape = scan.shape
    image = np.empty((*shape, 3), np.uint8)
    image[:] = np.array(background, np.uint8)
    labels = np.full(shape, Label.OUT_OF_FRAME, np.uint8)
    photo = np.full(shape, NO_PHOTO, np.uint16)
    sigma_px = np.full(shape, np.nan, np.float32)
    merit = np.full(shape, -1, np.int16)
    for index, parts in enumerate(shown):
        for part in parts:
            here = part.rows, part.columns
            before = merit[here]
            with np.errstate(invalid="ignore"):
                tied = (part.merit == before) & (before >= 0)
                better = (part.merit > before) | (tied & (part.sigma_px < sigma_px[here]))
            merit[here] = np.maximum(part.merit, before)
            hidden = (part.merit < 0) & (photo[here] == NO_PHOTO) & (part.labels == Label.OCCLUDED)
            labels[here] = np.where(better | hidden, part.labels, labels[here])
            for whole, values in ((image, part.image), (sigma_px, part.sigma_px)):
                whole[here][better] = values[better]
            photo[here][better] = index
    labels[~scan.valid] = Label.NO_RETURN
    for array in (image, labels, photo, sigma_px):
        array.flags.writeable = False  # handed over, not copied
    return CellColors(image, labels, photo, sigma_px)


def photo_labels(scan: Scan, view: PosedPhoto) -> ByteArray:
    """Return the labels (H, W) uint8 of one photograph, as by `texture_scan`."""
    labels = np.full(scan.shape, Label.OUT_OF_FRAME, np.uint8)
    for part in textured_parts(
        scan, view.photo, view.camera_from_scanner, camera=view.camera, covariance=view.covariance
    ):
        labels[part.rows, part.columns] = part.labels
    labels[~scan.valid] = Label.NO_RETURN
    labels.flags.writeable = False
    return labels


class PointColorer:
    """Colours points that need not be cells of the scan: those of the file that it was read from.

    A point that lies on the surface of its cell has the cell's photograph, label and uncertainty, and the colour of its
    own place in the photograph. Others (points behind the surface that a cell kept, or between its cells) are projected
    by themselves, and tested against the scan's surface.

    Args:
        scan: the scan.
        views: the photographs.
        cells: the colours of the scan's cells, by the same photographs.
    """

    def __init__(self, scan: Scan, views: Sequence[PosedPhoto], cells: CellColors) -> None:
        if cells.labels.shape != scan.shape:
            raise ShapeError(f"the colours have {cells.labels.shape} cells, the scan {scan.shape}; they must agree")
        self._scan, self._views, self._cells = scan, tuple(views), cells
        self._noise_m = grid_edges(scan).noise_m
        self._inverse_range = np.float32(1) / scan.ranges
        self._occluders: dict[int, Occluder] = {}

    def colors_of(self, points: FloatArray, *, report: Callable[[int], None] | None = None) -> PointColors:
        """Return the colours of points.

        Args:
            points: (N, 3) of the scanner frame, m; those that are not finite have no return.
            report: receives the number of points done, at least every 500,000.
        """
        points = np.asarray(points)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ShapeError(f"the points have the shape {points.shape}; it must be (N, 3)")
        count = len(points)
        found = PointColors(
            np.empty((count, 3), np.uint8),
            np.empty(count, np.uint8),
            np.empty(count, np.uint16),
            np.empty(count, np.float32),
        )
        for part in _slices(count):
            self._color(points[part], found, part)
            if report is not None:
                report(part.stop)
        return found

    def _color(self, points: FloatArray, found: PointColors, part: slice) -> None:
        finite: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=1))
        row, column, on_cell = self._cells_of(points, finite)
        labels = np.where(on_cell, self._cells.labels[row, column], np.uint8(Label.OUT_OF_FRAME))
        photo = np.where(on_cell, self._cells.photo[row, column], np.uint16(NO_PHOTO))
        sigma = np.where(on_cell, self._cells.sigma_px[row, column], np.float32(np.nan))
        color = self._cells.image[row, column]
        color[~on_cell] = UNSEEN
        beside = np.flatnonzero(finite & ~on_cell)
        if len(beside):
            labels[beside], photo[beside], sigma[beside] = self._alone(points[beside])
        for index, view in enumerate(self._views):
            mine = np.flatnonzero(photo == index)
            if len(mine):
                color[mine] = self._sampled(view, points[mine], color[mine], on_cell[mine])
        labels[~finite] = Label.NO_RETURN
        found.color[part], found.labels[part], found.photo[part], found.sigma_px[part] = color, labels, photo, sigma

    def _cells_of(self, points: FloatArray, finite: NDArray[np.bool_]) -> tuple[IntArray, IntArray, NDArray[np.bool_]]:
        """Return row and column of each point's cell, and whether the point lies on its surface."""
        at = self._scan.geometry.cell_of(np.where(finite[:, None], points, [1.0, 0.0, 0.0]))
        nearest = np.rint(np.nan_to_num(at, nan=-1.0))
        height, width = self._scan.shape
        inside = finite & (nearest >= 0).all(axis=-1) & (nearest[:, 0] < height) & (nearest[:, 1] < width)
        row, column = (np.where(inside, nearest[:, k], 0).astype(np.int32) for k in (0, 1))
        length = np.linalg.norm(points, axis=1)
        # Between the centres of cells the inverse range of a plane is linear.
        u, v = (np.ascontiguousarray(np.where(inside, at[:, k], 0)[None], dtype=np.float32) for k in (1, 0))
        between = look_up(self._inverse_range, u, v)[0]
        allowed = _TOLERANCE_RELATIVE * length + _TOLERANCE_SIGMAS * self._noise_m
        with np.errstate(invalid="ignore", divide="ignore"):
            near = np.abs(length - self._scan.ranges[row, column]) <= allowed
            near |= np.abs(length - 1 / between) <= allowed
        return row, column, inside & near

    def _alone(self, points: FloatArray) -> tuple[NDArray[np.uint8], NDArray[np.uint16], NDArray[np.float32]]:
        """Return labels, photographs and uncertainty of points that lie on no cell's surface."""
        labels = np.full(len(points), Label.OUT_OF_FRAME, np.uint8)
        photo = np.full(len(points), NO_PHOTO, np.uint16)
        sigma = np.full(len(points), np.nan, np.float32)
        merit = np.full(len(points), -np.inf)
        for index, view in enumerate(self._views):
            points_camera = view.camera_from_scanner @ np.asarray(points, dtype=np.float64)
            inside = np.flatnonzero(view.camera.contains(view.camera.project(points_camera)))
            if not len(inside):
                continue
            if index not in self._occluders:
                self._occluders[index] = Occluder(self._scan, view.camera, view.camera_from_scanner)
            hidden = self._occluders[index].hides(points[inside])
            labels[inside[hidden & (photo[inside] == NO_PHOTO)]] = Label.OCCLUDED
            shown = inside[~hidden]
            resolution = view.camera.focal_px / np.linalg.norm(points_camera[shown], axis=1)
            better = shown[resolution > merit[shown]]
            merit[shown] = np.maximum(merit[shown], resolution)
            photo[better] = index
            labels[better] = Label.UNCERTAIN  # its surface, and so its incidence, is not known
            sigma[better] = _point_sigma(view, points_camera[better])
        return labels, photo, sigma

    def _sampled(
        self, view: PosedPhoto, points: FloatArray, of_cell: NDArray[np.uint8], on_cell: NDArray[np.bool_]
    ) -> NDArray[np.uint8]:
        """Return the photograph's colours at points; where a cell spans several pixels, their mean: the cell's."""
        uv = view.camera.project(view.camera_from_scanner @ np.asarray(points, dtype=np.float64))
        place = np.nan_to_num(uv, nan=-1.0).astype(np.float32)
        u, v = np.ascontiguousarray(place[None, :, 0]), np.ascontiguousarray(place[None, :, 1])
        own = look_up(view.photo.pixels, u, v)[0]
        distance = np.linalg.norm(points - view.camera_from_scanner.centre, axis=1)
        spacing = np.linalg.norm(points, axis=1) * min(self._scan.geometry.step_rad)
        coarse = on_cell & (spacing * view.camera.focal_px > _COARSE_CELL_PX * np.maximum(distance, 1e-9))
        return np.where(coarse[:, None], of_cell, own)


def _extent(used: NDArray[np.bool_]) -> slice:
    """Return the part from the first to the last true value; empty if there is none."""
    at = np.flatnonzero(used)
    return slice(int(at[0]), int(at[-1]) + 1) if len(at) else slice(0, 0)


def _shifted(whole: slice, part: slice) -> slice:
    """Return the slice of the whole that is a part of one of its slices."""
    return slice(whole.start + part.start, whole.start + part.stop)


def _slices(count: int) -> Iterator[slice]:
    for first in range(0, count, _POINTS_AT_ONCE):
        yield slice(first, min(first + _POINTS_AT_ONCE, count))


def _table(labels: Sequence[Label]) -> NDArray[np.bool_]:
    table = np.zeros(256, dtype=np.bool_)
    table[list(labels)] = True
    return table


def _merit(part: TexturedPart, camera: CameraModel) -> NDArray[np.int16]:
    """Return how well a photograph shows cells: first by their label, then by its resolution on the surface."""
    rank: NDArray[np.int16] = np.array([_RANK.get(code, 0) for code in range(256)], np.int16)
    with np.errstate(invalid="ignore"):
        steps = np.rint(pixel_density(part.projection, camera) * np.float32(_STEPS_PER_OCTAVE / 2))
    fine = np.clip(np.nan_to_num(steps), -400, 400).astype(np.int16)
    result: NDArray[np.int16] = rank[part.labels] * np.int16(1000) + fine + np.int16(400)
    return result


def pixel_density(projection: ScanProjection, camera: CameraModel) -> NDArray[np.float32]:
    """Return the binary logarithm of a photograph's pixels per m^2 of the surface, (h, w); at least log2 1e-6."""
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = np.float32(camera.focal_px**2) * np.abs(projection.cosine) / projection.depth_m**2
        return np.asarray(np.log2(np.maximum(squared, np.float32(1e-6))), dtype=np.float32)


def cell_sigma(
    scan: Scan, view: PosedPhoto, here: tuple[slice, slice], colored: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return the standard deviation, px, of where a photograph shows cells (h, w) of a rectangle; NaN elsewhere."""
    result = np.full(colored.shape, np.nan, np.float32)
    points = scan.points_at(*here)[colored]
    if len(points):
        result[colored] = _point_sigma(view, view.camera_from_scanner @ points)
    return result


def _point_sigma(view: PosedPhoto, points_camera: FloatArray) -> NDArray[np.float32]:
    covariance = view.covariance
    numbers = covariance.covariance if isinstance(covariance, CameraUncertainty) else covariance
    if covariance is None or numbers is None or not np.isfinite(numbers).all():
        return np.full(len(points_camera), np.nan, np.float32)
    sigma = pixel_sigma(points_camera, view.camera, view.camera_from_scanner.rotation, covariance)
    return np.asarray(sigma, dtype=np.float32)
