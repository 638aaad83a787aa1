"""One picture laid over the other by a pose."""

from __future__ import annotations

from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import View
from ladarreg_core.surface.render import render_scan_colors
from ladarreg_core.surface.texture import RegisteredTexture, intensity_picture

OverlayShow = Literal["intensity", "edges", "range"]
_EDGE_COLOUR = (92, 200, 255)
_STRONG = 150.0
_WIDEST_PX = 2048


def scan_over_photo(scan: Scan, camera: Camera, camera_from_scanner: Rigid, show: str) -> NDArray[np.uint8]:
    """Return the scan as the photo's camera sees it, (h, w, 4) uint8 RGBA; alpha 0 where it sees no surface.

    Args:
        scan: the scan.
        camera: the photo's camera; pictures wider than 2048 px are made smaller.
        camera_from_scanner: its pose.
        show: `intensity`, `edges` of the intensity and of the surface, or `range`.

    Raises:
        OptionError: if there is no such overlay.
    """
    if show not in get_args(OverlayShow):
        raise OptionError(f"the overlay is {show!r}; it must be one of {', '.join(get_args(OverlayShow))}")
    if camera.width > _WIDEST_PX:
        camera = camera.resized(_WIDEST_PX, max(1, round(camera.height * _WIDEST_PX / camera.width)))
    picture = _range_picture(scan) if show == "range" else intensity_picture(scan)
    colour, covered = render_scan_colors(scan, camera, camera_from_scanner, picture=picture, supersample=1)
    if show != "edges":
        return _with_alpha(colour, np.where(covered, 255, 0))
    depth, _ = render_scan_colors(scan, camera, camera_from_scanner, picture=_range_picture(scan), supersample=1)
    strength = np.maximum(_magnitude(colour[..., 0]), _magnitude(depth[..., 0]))
    edge = np.zeros_like(colour)
    edge[:] = _EDGE_COLOUR
    inside = cv2.erode(covered.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return _with_alpha(edge, np.where(inside, np.clip(255 * strength / _STRONG, 0, 255), 0))


def photo_over_scan(view: View, texture: RegisteredTexture) -> NDArray[np.uint8]:
    """Return the photo as the scanner sees it, in a view, (h, w, 4) uint8 RGBA; alpha 0 where it has no colour."""
    planes = [view.resample(texture.image[..., k].astype(np.float32)) for k in range(3)]
    known = view.resample(texture.coloured.astype(np.float32))
    colour = np.rint(np.stack(planes, axis=-1)).astype(np.uint8)
    return _with_alpha(colour, np.where(view.inside, 255 * known, 0))


def _range_picture(scan: Scan) -> NDArray[np.uint8]:
    inverse = np.where(scan.valid, 1 / np.where(scan.valid, scan.ranges, 1), 0)
    low, high = np.percentile(inverse[scan.valid], (1, 99))
    level = np.rint(255 * np.clip((inverse - low) / max(high - low, 1e-12), 0, 1)).astype(np.uint8)
    return np.repeat(level[..., None], 3, axis=-1)


def _magnitude(plane: NDArray[np.uint8]) -> NDArray[np.float32]:
    values = plane.astype(np.float32)
    return np.hypot(cv2.Sobel(values, cv2.CV_32F, 1, 0), cv2.Sobel(values, cv2.CV_32F, 0, 1))


def _with_alpha(colour: NDArray[np.uint8], alpha: NDArray[np.generic]) -> NDArray[np.uint8]:
    return np.dstack([colour, np.rint(alpha).astype(np.uint8)])
