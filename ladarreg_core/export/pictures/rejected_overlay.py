"""The picture of a refused registration: the scan's edges at the rejected guess, watermarked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.export.pictures.images import write_png
from ladarreg_core.export.pictures.layout import fit_size, padded, resized, stacked, text_block
from ladarreg_core.export.pictures.watermark import watermarked
from ladarreg_core.foundations.palette import BAD
from ladarreg_core.inspection.pictures import scan_over_photo
from ladarreg_core.photo import Photo
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan

_WATERMARK = "REFUSED"
_LARGEST_PX, _TEXT = 1600, 16
_MAX_DRAWN_CELLS = 4_000_000
_GUESS = "Refused: the scan's edges (blue) at the rejected guess. This is no registration."
_NO_GUESS = "Refused: no pose was found, so the photograph is shown alone. This is no registration."


def rejected_overlay(scan: Scan, photo: Photo, result: PoseResult) -> NDArray[np.uint8]:
    """Return the photograph with the scan's edges at the best guess, if there is one, and a watermark across it.

    Args:
        scan: the scan.
        photo: the photograph; at most 1600 px of its longer side are drawn.
        result: the refused result.

    Returns:
        (h, w, 3) uint8 RGB, with a caption below.
    """
    camera = result.camera
    largest = min(_LARGEST_PX, max(camera.size))
    width, height = fit_size(camera.width / camera.height, width=largest, height=largest)
    picture = resized(photo.pixels, (width, height))
    if result.has_pose:
        drawn, _ = scan.thinned(_MAX_DRAWN_CELLS)
        edges = scan_over_photo(drawn, camera.resized(width, height), result.camera_from_scanner, "edges")
        alpha = edges[..., 3:].astype(np.float32) / 255
        picture = np.rint(picture * (1 - alpha) + edges[..., :3] * alpha).astype(np.uint8)
    marked = watermarked(picture, _WATERMARK, BAD)
    caption = text_block(_GUESS if result.has_pose else _NO_GUESS, size=_TEXT, color=BAD, width=max(width - 16, 200))
    return stacked([marked, padded(caption, top=6, bottom=8, left=8)])


def write_rejected_overlay(path: str | Path, scan: Scan, photo: Photo, result: PoseResult) -> None:
    """Write the picture returned by `rejected_overlay`.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_png(path, rejected_overlay(scan, photo, result))
