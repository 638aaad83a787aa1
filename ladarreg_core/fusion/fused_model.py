"""The colours of a scan from all its photographs together."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.foundations.arrays import ByteArray, FloatArray
from ladarreg_core.foundations.palette import UNSEEN
from ladarreg_core.foundations.progress import Progress, Report, part_of
from ladarreg_core.fusion.exposure import Gains, solve_gains
from ladarreg_core.fusion.moved import find_moved
from ladarreg_core.fusion.samples import OtherSurface, PhotoSample, sample_photos
from ladarreg_core.fusion.seams import blended, chosen_photos
from ladarreg_core.fusion.vignetting import solve_vignetting, without_vignetting
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.best_photo import NO_PHOTO, CellColors, PosedPhoto
from ladarreg_core.surface.texture.registered_texture import Label

_SAMPLED = 0.7  # share of the whole


@dataclass(frozen=True, slots=True, eq=False)
class FusedModel:
    """A scan coloured by photographs; arrays are on its grid and read-only."""

    scan: Scan
    """The scan."""
    views: tuple[PosedPhoto, ...]
    """The photographs, without vignetting if that was asked for."""
    colors: CellColors
    """Colours, labels, the index of the photograph that colours each cell, and the standard deviation of its place in
    that photograph, px."""
    gains: Gains
    """Gains of the photographs."""
    seen_by: NDArray[np.uint16]
    """(H, W) how many photographs show the cell, without what moved."""
    resolution_mm: NDArray[np.float32]
    """(H, W) side of a pixel of the cell's photograph on the surface, mm; NaN where none shows it."""
    samples: tuple[PhotoSample, ...]
    """What each photograph shows; `samples[k].moved` are the cells where it shows things that moved."""
    coloring: tuple[int, ...]
    """Indices of the photographs that colour: all, or without the thermal ones if there are others."""
    vignetting: NDArray[np.float64]
    """(K, 2) a and b by which each photograph was darkened towards its corners, exp(a r^2 + b r^4) with r = 1 there,
    which is undone; 0 where it was not asked for."""

    @property
    def image(self) -> ByteArray:
        """(H, W, 3) uint8 RGB."""
        return self.colors.image

    @property
    def photo(self) -> NDArray[np.uint16]:
        """(H, W) uint16: index of the photograph that colours the cell; `NO_PHOTO` where none does."""
        return self.colors.photo

    @property
    def labels(self) -> ByteArray:
        """(H, W) uint8, codes of `Label`, in that photograph."""
        return self.colors.labels

    @property
    def shares(self) -> NDArray[np.float64]:
        """(K,) share of the returns that each photograph colours."""
        count = np.bincount(self.photo[self.scan.valid], minlength=NO_PHOTO + 1)
        return np.asarray(count[: len(self.views)] / max(1, int(self.scan.valid.sum())))

    def photo_labels(self, k: int) -> NDArray[np.uint8]:
        """Return the labels (H, W) of a photograph; what moved is labelled as occluded, since it hides the surface."""
        found = np.full(self.scan.shape, Label.OUT_OF_FRAME, np.uint8)
        sample = self.samples[k]
        found[sample.here] = np.where(sample.moved, np.uint8(Label.OCCLUDED), sample.labels)
        found[~self.scan.valid] = Label.NO_RETURN
        return found

    def developed(self, k: int) -> Photo:
        """Return a photograph with the exposure and the white balance of the model."""
        photo = self.views[k].photo
        pixels = self.gains.developed(k, photo.pixels)
        return photo if pixels is photo.pixels else replace(photo, pixels=pixels)


def fuse(
    scan: Scan | RegisteredScan,
    photos: Sequence[PosedPhoto] = (),
    *,
    values: Sequence[FloatArray | None] = (),
    others: Sequence[OtherSurface] = (),
    vignetting: bool = False,
    report: Report | None = None,
) -> FusedModel:
    """Colour a scan by one photograph or many, each cell by the one that shows it best.

    Exposure and white balance of the photographs are equalised over what they show together. Where at least three see
    a cell, things that moved are voted out. Regions of cells have one photograph, chosen by its resolution on the
    surface, the incidence, the distance from depth edges and the uncertainty of its pose; colours are mixed only within
    two cells of a seam.

    Args:
        scan: the scan; or a scan with its registered photographs, of which those are used that were accepted.
        photos: the photographs with their poses, for a scan alone.
        values: for each photograph an image (h, w) float32 of values of its pixels, such as counts, or None. Those of
            thermal photographs are their temperatures, K.
        others: surfaces of other stations, which hide cells from cameras, too.
        vignetting: estimate the vignetting of each lens from overlaps of its photographs, and correct it.
        report: receives the progress; may raise `Cancelled`.

    Raises:
        OptionError: if photographs are given twice, or none is accepted.
        ShapeError: if there is no photograph or too many, or a camera or values are not of a photograph's size.
    """
    views = list(photos)
    if isinstance(scan, RegisteredScan):
        if views:
            raise OptionError("a registered scan has its photographs; give no others, or the scan itself")
        views = [view for view, one in zip(scan.views, scan.photos, strict=True) if one.registration.accepted]
        if not views:
            raise OptionError(
                "no photograph is accepted, and a pose that was given is not verified; register a photograph first"
            )
        scan = scan.scan
    return fuse_stations([Station(scan, views, others)], values=values, vignetting=vignetting, report=report)[0]


@dataclass(frozen=True, slots=True, eq=False)
class Station:
    """A scan with the poses of photographs relative to it."""

    scan: Scan
    """The scan."""
    views: Sequence[PosedPhoto]
    """The photographs, in the same order for all stations."""
    others: Sequence[OtherSurface] = ()
    """Surfaces of the other stations."""


def fuse_stations(
    stations: Sequence[Station],
    *,
    values: Sequence[FloatArray | None] = (),
    colorless: Collection[int] = (),
    vignetting: bool = False,
    report: Report | None = None,
) -> list[FusedModel]:
    """Colour the scans of several stations by the same photographs, with the same gains; see `fuse`.

    Args:
        stations: the scans.
        values: as of `fuse`.
        colorless: indices of photographs that are pictures of their values and colour nothing, as thermal ones.
        vignetting: as of `fuse`.
        report: as of `fuse`.

    Raises:
        ShapeError: as `fuse`.
    """
    views = stations[0].views
    if not 0 < len(views) < NO_PHOTO:
        raise ShapeError(f"there are {len(views)} photographs; give 1 to {NO_PHOTO - 1}")
    images = [view.photo.temperature_k for view in views]
    for k, given in enumerate(values):
        images[k] = images[k] if given is None else given
    passes = 2 if vignetting else 1
    samples = _sampled(stations, images, part_of(report, 0, _SAMPLED / passes))
    colored = [k for k, view in enumerate(views) if view.photo.temperature_k is None and k not in colorless]
    coloring = colored or list(range(len(views)))

    def say(done: float, what: str) -> None:
        if report is not None:
            report(Progress(round(100 * (_SAMPLED + (1 - _SAMPLED) * done)), 100, f"fusing: {what}"))

    darkened = np.zeros((len(views), 2))
    if vignetting:
        darkened = solve_vignetting(samples, colored, [one.scan for one in stations], [one.views for one in stations])
        bright = [without_vignetting(view.photo, powers) for view, powers in zip(views, darkened, strict=True)]
        stations = [
            replace(one, views=[replace(view, photo=photo) for view, photo in zip(one.views, bright, strict=True)])
            for one in stations
        ]
        samples = _sampled(stations, images, part_of(report, _SAMPLED / passes, _SAMPLED))
    say(0, "exposure")
    shapes = [one.scan.shape for one in stations]
    gains = solve_gains(samples, colored, shapes)
    say(0.1, "moved things")
    for one, some in zip(stations, samples, strict=True):
        find_moved(some, colored, one.scan.shape, gains)
    if any(sample.moved.any() for some in samples for sample in some):
        gains = solve_gains(samples, colored, shapes)  # what moved had shifted the medians
    models = []
    for n, (one, some) in enumerate(zip(stations, samples, strict=True)):
        say(0.5 + 0.5 * n / len(stations), "seams")
        photo = chosen_photos(some, coloring, one.scan.shape)
        photo[~one.scan.valid] = NO_PHOTO
        say(0.5 + 0.5 * (n + 0.5) / len(stations), "colours")
        colors = blended(some, coloring, photo, gains, UNSEEN)
        models.append(_model(one, some, coloring, gains, darkened, photo, colors))
    return models


def _sampled(
    stations: Sequence[Station], values: Sequence[FloatArray | None], report: Report | None
) -> list[list[PhotoSample]]:
    found = []
    for n, one in enumerate(stations):
        part = part_of(report, n / len(stations), (n + 1) / len(stations))
        found.append(sample_photos(one.scan, one.views, values=values, others=one.others, report=part))
    return found


def _model(
    station: Station, samples: Sequence[PhotoSample], coloring: Sequence[int], gains: Gains,
    darkened: NDArray[np.float64], photo: NDArray[np.uint16], image: NDArray[np.uint8],
) -> FusedModel:  # fmt: skip
    scan, shape = station.scan, station.scan.shape
    labels = np.full(shape, Label.OUT_OF_FRAME, np.uint8)
    sigma = np.full(shape, np.nan, np.float32)
    resolution = np.full(shape, np.nan, np.float32)
    seen_by = np.zeros(shape, np.uint16)
    for k in coloring:
        sample = samples[k]
        here, own = sample.here, photo[sample.here] == k
        seen_by[here] += sample.usable
        hidden = (sample.labels == Label.OCCLUDED) & (photo[here] == NO_PHOTO)
        labels[here] = np.where(own | hidden, sample.labels, labels[here])
        sigma[here][own] = sample.sigma_px[own]
        resolution[here][own] = 1000 * np.exp2(-sample.density[own].astype(np.float32) / 2)
    labels[~scan.valid] = Label.NO_RETURN
    for array in (image, labels, photo, sigma, seen_by, resolution):
        array.flags.writeable = False
    colors = CellColors(image, labels, photo, sigma)
    views = tuple(station.views)
    return FusedModel(scan, views, colors, gains, seen_by, resolution, tuple(samples), tuple(coloring), darkened)
