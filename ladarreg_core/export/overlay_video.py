"""The overlay video of a rig: the returns of each scan, coloured by range, over its photograph, as an animated WebP."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.palette import BACKGROUND, INK, ramp_colors
from ladarreg_core.frames import Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan

MAX_FRAMES = 40
"""Largest number of frames of a video; of more pairs, so many are shown, evenly spread."""
MAX_SIDE_PX = 720
"""Longer side of a frame, px."""
_MAX_POINTS = 30_000
_FRAME_MS = 900
_QUALITY = 80
_SHOWN_SHARE = (2.0, 98.0)  # per cent of the ranges that span the colours
_BAR_PX = 26
_DIMMED = 0.72


@dataclass(frozen=True, slots=True, eq=False)
class OverlayFrame:
    """What one frame shows."""

    scan: Scan
    photo: Photo
    label: str
    """A line below the picture."""


def write_overlay_video(path: Path, frames: Sequence[OverlayFrame], camera_from_scanner: Rigid) -> None:
    """Write the frames of a rig as an animated WebP that repeats endlessly.

    Args:
        path: the file.
        frames: one or more; of more than `MAX_FRAMES` a part is shown.
        camera_from_scanner: the pose of all.

    Raises:
        OptionError: if there are no frames.
    """
    from PIL import Image

    if not frames:
        raise OptionError("the video has no frames; give one or more")
    spread = np.linspace(0, len(frames) - 1, min(len(frames), MAX_FRAMES)).round().astype(int)
    shown = [frames[k] for k in spread]
    ranges = np.concatenate([frame.scan.ranges[frame.scan.valid].ravel()[::7] for frame in shown])
    near, far = (float(value) for value in np.percentile(ranges, _SHOWN_SHARE))
    pictures = [overlay_picture(frame, camera_from_scanner, near_m=near, far_m=far) for frame in shown]
    height, width = (max(picture.shape[k] for picture in pictures) for k in (0, 1))
    first, *others = (Image.fromarray(_padded(picture, height, width)) for picture in pictures)
    first.save(
        path, "WEBP", save_all=True, append_images=others, duration=_FRAME_MS, loop=0, quality=_QUALITY, method=2
    )


def overlay_picture(frame: OverlayFrame, camera_from_scanner: Rigid, *, near_m: float, far_m: float) -> ByteArray:
    """Return a frame (h, w, 3) RGB: the dimmed photograph, the returns that it shows, and a label.

    Args:
        frame: the scan, photograph and label.
        camera_from_scanner: the pose.
        near_m: range at one end of the colours, m.
        far_m: range at the other end, on a logarithmic scale.
    """
    camera = frame.photo.camera
    scale = min(1.0, MAX_SIDE_PX / max(camera.size))
    size = (max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    picture = cv2.resize(frame.photo.pixels, size, interpolation=cv2.INTER_AREA)
    picture = np.ascontiguousarray((picture * _DIMMED).astype(np.uint8))
    points = frame.scan.points[frame.scan.valid].astype(np.float64)
    points = points[:: max(1, len(points) // (4 * _MAX_POINTS))]
    uv = camera.project(camera_from_scanner @ points)
    seen = camera.contains(uv)
    points, uv = points[seen], uv[seen]
    keep = slice(None, None, max(1, -(-len(points) // _MAX_POINTS)))
    points, uv = points[keep], uv[keep]
    ranges = np.linalg.norm(points, axis=-1)
    share = np.log(np.clip(ranges, near_m, far_m) / near_m) / max(np.log(far_m / near_m), 1e-9)
    colors = ramp_colors(1 - share)
    radius = max(1, round(size[0] / 480))
    for k in np.argsort(-ranges, kind="stable"):  # the nearest last
        u, v = (uv[k] + 0.5) * scale - 0.5
        cv2.circle(picture, (round(float(u)), round(float(v))), radius, colors[k].tolist(), -1, cv2.LINE_AA)
    bar = np.full((_BAR_PX, size[0], 3), BACKGROUND, np.uint8)
    text = f"{frame.label}   {near_m:.1f} - {far_m:.0f} m"
    plain = text.encode("ascii", "replace").decode()
    cv2.putText(bar, plain, (8, _BAR_PX - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
    return np.vstack([picture, bar])


def _padded(picture: ByteArray, height: int, width: int) -> ByteArray:
    """Return a picture with a border to the right and below, so that all frames are of one size."""
    below, right = height - picture.shape[0], width - picture.shape[1]
    return np.asarray(cv2.copyMakeBorder(picture, 0, below, 0, right, cv2.BORDER_CONSTANT, value=BACKGROUND))
