"""Pictures of a registration as arrays, and as a figure of Matplotlib, for notebooks and scripts."""

from __future__ import annotations

from typing import TYPE_CHECKING, get_args

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import OptionError
from ladarreg_core.export.pictures.layout import fit_size, resized
from ladarreg_core.export.pictures.rejected_overlay import rejected_overlay
from ladarreg_core.export.pictures.watermark import watermarked
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.palette import OK, WARN, Color
from ladarreg_core.foundations.validation import require_choice
from ladarreg_core.inspection.model_textures import registered_texture
from ladarreg_core.inspection.pictures import OverlayShow, scan_over_photo
from ladarreg_core.photo import Photo
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.results.verdict_words import verdict_words
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.registered_texture import intensity_picture, model_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LARGEST_PX = 2048
_FIGURE_INCHES = (11.0, 7.5)


def scan_picture(scan: Scan) -> NDArray[np.uint8]:
    """Return the intensity of a scan on its grid, (H, W, 3) uint8 RGB; of one without intensity, its shape."""
    return np.asarray(intensity_picture(scan), np.uint8)


def overlay(result: PoseResult, scan: Scan, photo: Photo, *, show: OverlayShow = "edges") -> NDArray[np.uint8]:
    """Return the photograph with what the scan predicts at the pose.

    Args:
        result: the registration; across that of a refused one, and of a given one, the picture says so.
        scan: the scan.
        photo: the photograph; at most 2048 px of its longer side are drawn.
        show: `edges` of intensity and surface, `intensity`, or `range` as colours.

    Returns:
        (h, w, 3) uint8 RGB.

    Raises:
        OptionError: if there is no such overlay.
    """
    require_choice(show, get_args(OverlayShow), "the overlay")
    if not result.is_shown:
        return rejected_overlay(scan, photo, result)
    camera = result.camera
    longest = min(_LARGEST_PX, max(camera.size))
    width, height = fit_size(camera.width / camera.height, width=longest, height=longest)
    picture = resized(photo.pixels, (width, height))
    drawn = scan_over_photo(scan, camera.resized(width, height), result.camera_from_scanner, show)
    alpha = drawn[..., 3:].astype(np.float32) / 255
    picture = np.rint(picture * (1 - alpha) + drawn[..., :3] * alpha).astype(np.uint8)
    return _marked(picture, result)


def registered(result: PoseResult, scan: Scan, photo: Photo) -> NDArray[np.uint8]:
    """Return the photograph on the scan's grid: its colour where the camera saw a cell, dimmed intensity elsewhere.

    Args:
        result: an accepted registration, or a pose that was given, which the picture then says.
        scan: the scan.
        photo: the photograph.

    Returns:
        (H, W, 3) uint8 RGB. `texture_scan` returns the same with labels and uncertainty.

    Raises:
        OptionError: if the registration was refused.
    """
    if not result.is_shown:
        raise OptionError(
            "the registration was refused, so there is no registered picture; its guess is shown by views.overlay"
        )
    texture = registered_texture(scan, photo, result)
    return _marked(np.asarray(model_picture(scan, texture), np.uint8), result)


def figure(result: PoseResult, scan: Scan, photo: Photo) -> Figure:
    """Return a figure of a registration: scan, residuals on the photograph, overlay, and the registered picture.

    Args:
        result: the registration.
        scan: the scan.
        photo: the photograph.

    Raises:
        OptionError: if Matplotlib is not installed.
    """
    try:
        from matplotlib import pyplot as plt
    except ImportError:
        raise OptionError(
            "a figure is drawn by Matplotlib, which is not installed; install it, or use the arrays that "
            "views.overlay and views.registered return"
        ) from None
    drawn, axes = plt.subplots(2, 2, figsize=_FIGURE_INCHES, layout="constrained")
    plt.close(drawn)  # a notebook shows what is returned, and would show an open figure a second time
    words = verdict_words(result.accepted, result.evidence, result.diagnostics, coarse=result.is_coarse)
    drawn.suptitle(words)
    _shown(axes[0, 0], scan_picture(scan), "scan, intensity" if scan.has_intensity else "scan, shape")
    _residuals(axes[0, 1], result, photo)
    _shown(axes[1, 0], overlay(result, scan, photo), "edges of the scan on the photograph")
    if result.is_shown:
        _shown(axes[1, 1], registered(result, scan, photo), "photograph on the scan's grid")
    else:
        axes[1, 1].set_axis_off()
    return drawn


def _shown(axes: Axes, picture: ByteArray, title: str) -> None:
    axes.imshow(picture)
    axes.set_title(title)
    axes.set_axis_off()


def _residuals(axes: Axes, result: PoseResult, photo: Photo) -> None:
    """Draw where the matches are observed, and from where the pose predicts them, enlarged."""
    _shown(axes, photo.pixels // 2 + 96, "no matches")
    uv, off, good = result.matches.uv, result.residuals_px, result.inliers
    if not good.any():
        return
    typical = float(np.nanmedian(np.linalg.norm(off[good], axis=1)))
    enlarged = 0.03 * max(result.camera.size) / max(typical, 1e-3)
    for chosen, color in ((good, OK), (~good, WARN)):
        off_shown = np.clip(off[chosen] * enlarged, -4 * enlarged * typical, 4 * enlarged * typical)
        ink = _of_matplotlib(color)
        axes.quiver(*uv[chosen].T, *off_shown.T, angles="xy", scale_units="xy", scale=1, color=ink, width=0.003)
    axes.set_title(f"residuals, median {typical:.2g} px, enlarged {enlarged:.0f} times")


def _of_matplotlib(color: Color) -> tuple[float, float, float]:
    red, green, blue = color
    return red / 255, green / 255, blue / 255


def _marked(picture: NDArray[np.uint8], result: PoseResult) -> NDArray[np.uint8]:
    return watermarked(picture, result.mark, WARN) if result.mark else picture
