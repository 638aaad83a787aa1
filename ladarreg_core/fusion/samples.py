"""What each photograph shows of the cells of a scan, kept for the rectangle of cells that it may show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.best_photo import PosedPhoto, cell_sigma, pixel_density
from ladarreg_core.surface.texture.registered_texture import (
    COLORED,
    Label,
    cell_values,
    textured_parts,
)
from ladarreg_core.surface.visibility.visible_points import Occluder

_EDGE_CELLS = 6.0  # from a depth edge, or the border of the picture, within which a photograph counts less
_NEAREST = 0.15
_OF_LABEL = {Label.SEEN: 0.0, Label.GRAZING: -4.0, Label.UNCERTAIN: -7.0}  # log2: a rank that resolution rarely turns
_TOWARD_CAMERA, _TOWARD_CAMERA_M = 0.005, 0.02  # a surface that another station measured, too, hides nothing of itself
_POINTS_AT_ONCE = 1_000_000


@dataclass(slots=True, eq=False)
class PhotoSample:
    """A photograph on the cells of a rectangle of the scan, outside of which it shows none."""

    rows: slice
    columns: slice
    color: NDArray[np.uint8]
    """(h, w, 3) RGB, as taken."""
    labels: NDArray[np.uint8]
    """(h, w), codes of `Label`."""
    density: NDArray[np.float16]
    """(h, w) binary logarithm of pixels per m^2 of the surface."""
    sigma_px: NDArray[np.float16]
    """(h, w) standard deviation of the place in the photograph; NaN where it is not known."""
    merit: NDArray[np.float16]
    """(h, w) binary logarithm of the weight; -inf where it shows nothing."""
    moved: BoolArray
    """(h, w): it shows something that the other photographs do not."""
    values: NDArray[np.float32] | None = None
    """(h, w) of a sensor with a unit; NaN where it shows nothing."""

    @property
    def here(self) -> tuple[slice, slice]:
        """Rows and columns."""
        return self.rows, self.columns

    @property
    def colored(self) -> BoolArray:
        """(h, w): the cells that it shows."""
        return colored_cells(self.labels)

    @property
    def usable(self) -> BoolArray:
        """(h, w): the cells that it shows, without what moved."""
        return self.colored & ~self.moved


@dataclass(frozen=True, slots=True, eq=False)
class OtherSurface:
    """The surface of another station, which may hide cells of this one from a camera."""

    scan: Scan
    """That station's scan."""
    other_from_scanner: Rigid
    """Maps points of this scanner to that one."""


def colored_cells(labels: ByteArray) -> BoolArray:
    """Return the cells (h, w) whose label says that a photograph shows them."""
    table = np.zeros(256, np.bool_)
    table[list(COLORED)] = True
    return table[labels]


def sample_photos(
    scan: Scan,
    views: Sequence[PosedPhoto],
    *,
    values: Sequence[FloatArray | None] = (),
    others: Sequence[OtherSurface] = (),
    report: Report | None = None,
) -> list[PhotoSample]:
    """Return what each photograph shows of a scan's cells.

    The weight of a photograph in a cell is its pixels per area of the surface, which falls with distance and incidence,
    divided by 1 + sigma^2 with the uncertainty of its place in pixels. It falls toward depth edges and the border of
    the picture.

    Args:
        scan: the scan.
        views: the photographs.
        values: for each photograph an image (h, w) float32 of values of its pixels, or None.
        others: surfaces of other stations.
        report: receives the progress, in photographs.

    Raises:
        ShapeError: if a camera or the values are not of the photograph's size.
    """
    found = []
    for index, view in enumerate(views):
        if report is not None:
            report(Progress(index, len(views), f"sampling {view.photo.name}"))
        image = values[index] if index < len(values) else None
        if image is not None and image.shape != view.photo.pixels.shape[:2]:
            raise ShapeError(
                f"the values have {image.shape[1]} x {image.shape[0]} pixels, {view.photo.name} has "
                f"{view.photo.camera.width} x {view.photo.camera.height}; give values of the photograph's pixels"
            )
        found.append(_sample(scan, view, image, others))
    return found


def _sample(scan: Scan, view: PosedPhoto, image: FloatArray | None, others: Sequence[OtherSurface]) -> PhotoSample:
    kept = []
    hiding = [_Hiding(one, view) for one in others]
    for part in textured_parts(
        scan, view.photo, view.camera_from_scanner, camera=view.camera, covariance=view.covariance
    ):
        here = part.rows, part.columns
        labels = part.labels
        for one in hiding:
            one.mark(labels, scan, here)
        colored = colored_cells(labels)
        sigma = cell_sigma(scan, view, here, colored)
        sampled = None
        if image is not None:
            sampled = cell_values(
                image, part.projection, scan.ranges[here], scan.geometry.step_rad, view.camera, (np.nan,)
            )
            sampled = np.where(colored, sampled, np.float32(np.nan))
        inside = _box(labels != Label.OUT_OF_FRAME)
        if inside is not None:
            kept.append((here, inside, part, sigma, sampled, pixel_density(part.projection, view.camera)))
    rows, columns = _around([(here, inside) for here, inside, *_ in kept])
    shape = rows.stop - rows.start, columns.stop - columns.start
    whole = PhotoSample(
        rows, columns, np.zeros((*shape, 3), np.uint8), np.full(shape, Label.OUT_OF_FRAME, np.uint8),
        np.zeros(shape, np.float16), np.full(shape, np.nan, np.float16), np.full(shape, -np.inf, np.float16),
        np.zeros(shape, np.bool_), None if image is None else np.full(shape, np.nan, np.float32),
    )  # fmt: skip
    for here, inside, part, sigma, sampled, density in kept:
        top, left = here[0].start - rows.start, here[1].start - columns.start
        there = tuple(slice(a + b.start, a + b.stop) for a, b in zip((top, left), inside, strict=True))
        for target, source in (
            (whole.color, part.image), (whole.labels, part.labels), (whole.density, density), (whole.sigma_px, sigma),
            (whole.values, sampled),
        ):  # fmt: skip
            if target is not None and source is not None:
                target[there] = source[inside]
    whole.labels[~scan.valid[rows, columns]] = Label.NO_RETURN
    whole.merit[:] = _merit(whole)
    return whole


class _Hiding:
    """Marks cells that the surface of another station hides from a camera."""

    def __init__(self, other: OtherSurface, view: PosedPhoto) -> None:
        scanner_from_other = other.other_from_scanner.inverse
        self._occluder = Occluder(other.scan, view.camera, view.camera_from_scanner @ scanner_from_other)
        self._move, self._centre = other.other_from_scanner, view.camera_from_scanner.centre

    def mark(self, labels: NDArray[np.uint8], scan: Scan, here: tuple[slice, slice]) -> None:
        """Change the labels (h, w) of the cells in rows and columns `here`."""
        shown = colored_cells(labels)
        flat = np.flatnonzero(shown)
        points = scan.points_at(*here).reshape(-1, 3)
        hidden = np.zeros(labels.shape, np.uint8)
        for first in range(0, len(flat), _POINTS_AT_ONCE):
            some = flat[first : first + _POINTS_AT_ONCE]
            there = points.take(some, axis=0).astype(np.float64)
            away = self._centre - there
            distance = np.linalg.norm(away, axis=1, keepdims=True)
            step = np.minimum(_TOWARD_CAMERA + _TOWARD_CAMERA_M / np.maximum(distance, 1e-9), 1.0)
            hidden.reshape(-1)[some] = self._occluder.hides(self._move @ (there + step * away))
        # Single cells are noise; what is not shown anyhow may belong to a region that is hidden.
        square = np.ones((3, 3), np.uint8)
        core = np.asarray(cv2.morphologyEx(hidden | (~shown).view(np.uint8), cv2.MORPH_OPEN, square), np.uint8)
        labels[cv2.dilate(core & hidden, square).astype(np.bool_) & shown] = Label.OCCLUDED


def _box(cells: BoolArray) -> tuple[slice, slice] | None:
    """Return rows and columns of the box around cells (h, w); None if there are none."""
    rows, columns = (np.flatnonzero(cells.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return None
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _around(parts: Sequence[tuple[tuple[slice, slice], tuple[slice, slice]]]) -> tuple[slice, slice]:
    """Return rows and columns of the box around boxes within rectangles; one cell if there are none."""
    if not parts:
        return slice(0, 1), slice(0, 1)
    ends = []
    for k in range(2):
        low = min(here[k].start + inside[k].start for here, inside in parts)
        high = max(here[k].start + inside[k].stop for here, inside in parts)
        ends.append(slice(low, high))
    return ends[0], ends[1]


def _merit(sample: PhotoSample) -> NDArray[np.float32]:
    """Return the binary logarithm of the weight (h, w) of a photograph."""
    labels = sample.labels
    of_label = np.full(256, -np.inf, np.float32)
    for label, value in _OF_LABEL.items():
        of_label[label] = value
    clear = np.pad((labels == Label.SEEN).view(np.uint8), 1)  # the border of the picture is an edge, too
    away = cv2.distanceTransform(clear, cv2.DIST_L2, 3)[1:-1, 1:-1]
    near = np.log2(np.clip(away / np.float32(_EDGE_CELLS), _NEAREST, 1))
    sigma = np.nan_to_num(sample.sigma_px.astype(np.float32), nan=0.0, posinf=1e3)
    doubt = np.log2(1 + np.square(sigma))
    return np.asarray(sample.density.astype(np.float32) + of_label[labels] + near - doubt, dtype=np.float32)
