"""The textured model of a hand-over, at the resolution of the photographs: one for all targets that write it."""

from __future__ import annotations

from weakref import WeakKeyDictionary

from ladarreg_core.errors import ExportError
from ladarreg_core.export.targets.registered_scan import RegisteredScan
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.progress import Report
from ladarreg_core.surface.photo_model import ModelPhoto, PhotoModel, photo_model

_latest: WeakKeyDictionary[RegisteredScan, tuple[ExportOptions, PhotoModel]] = WeakKeyDictionary()


def model_of(handed: RegisteredScan, options: ExportOptions, report: Report | None = None) -> PhotoModel:
    """Return the textured model of a hand-over; the latest is kept, for the targets that share it.

    Raises:
        ExportError: if it is to be cropped, and no photograph covers any triangle.
    """
    known = _latest.get(handed)
    if known is not None and known[0] == options:
        return known[1]
    handed.compute_colours(report)
    photos = [
        ModelPhoto(one.photo.pixels, one.camera, one.camera_from_scanner, labels)
        for one, labels in zip(handed.photos, handed.photo_labels, strict=True)
    ]
    model = photo_model(
        handed.scan, photos, handed.colours.photo, full=options.full, crop=options.crop == "photo", report=report
    )
    if not model.parts:
        raise ExportError(
            "no photograph covers a triangle of the model, so nothing is left of it when it is cropped; write it whole"
        )
    _latest[handed] = (options, model)
    return model
