"""Synthetic photographs of a scan from another position, in another light and with other inks, with exactly known pose.

They show the surface of the scan, so that no scene has to be modelled. What a laser does not measure, the brightness of
an ink to a camera and the position of the lamps, is drawn at random for every photograph.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray
from ladarreg_core.frames import Rigid, look_along, rotation_from_rotvec
from ladarreg_core.matching.images.support import carries_intensity, is_coarse, open_cells
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.surface.spikes import fill_from_nearest
from ladarreg_core.surface.visibility.render import render_scan_colors

_AMBIENT = (0.35, 0.6)
_KNOTS = 5
_NOISE = (1.0, 4.0)  # of 255
_NORMAL_BLUR = 3.0
_LATERAL = (0.06, 0.25)  # of the median range
_OTHER_AXES = 0.04
_TILT_RAD = np.deg2rad(2.0)
FARTHEST_REACH_M = 5.0
"""Range by which baselines grow no further: cameras stand beside a scanner outdoors as they do indoors."""
_SAME_SURFACE = 0.04
_FACING_UP = 0.7
_MIN_SURFACE = 12  # cells
_SKY = (0.75, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticPhoto:
    """A synthetic photograph with its true pose."""

    photo: Photo
    """The photograph."""
    camera_from_scanner: Rigid
    """True pose."""
    covered: float
    """Share of the photo that shows the scan, 0 to 1."""


def random_pose(scan: Scan, camera: Camera, rng: np.random.Generator) -> Rigid:
    """Draw a pose beside the scanner that looks at a part of the scan.

    Args:
        scan: the scan.
        camera: its field of view decides how far off the middle of the scan it may look.
        rng: random generator.
    """
    median = float(np.nanmedian(scan.ranges))
    reach = min(median, FARTHEST_REACH_M)
    aim, scatter = scan.mean_direction, scan.sampled_directions
    if float(np.median(scatter @ aim)) < np.cos(
        camera.width / 2 / camera.fx
    ):  # a scan wider than the photo: look at any part of it
        aim = scatter[rng.integers(len(scatter))]
    axes = look_along(aim)  # rows: right, down, forward
    aside = rng.choice([-1.0, 1.0]) * rng.uniform(*_LATERAL)
    centre = reach * (np.array([aside, *rng.uniform(-_OTHER_AXES, _OTHER_AXES, 2)]) @ axes)
    towards = median * aim - centre
    tilt = rotation_from_rotvec(rng.uniform(-_TILT_RAD, _TILT_RAD, 3))
    return Rigid.from_centre(tilt @ look_along(towards / np.linalg.norm(towards)), centre)


def render_photo(scan: Scan, camera: Camera, pose: Rigid, rng: np.random.Generator) -> SyntheticPhoto:
    """Render a synthetic photograph of a scan.

    Args:
        scan: the scan; its colour is used where it has one, else its intensity.
        camera: the camera.
        pose: `camera_from_scanner`.
        rng: random generator of light, inks and noise.
    """
    rgb, covered = render_scan_colors(scan, camera, pose, picture=_relit(scan, rng), supersample=2)
    known = covered
    if is_coarse(scan, camera):
        rgb, known = _with_sky(rgb, covered, scan, camera, pose, rng)
    filled = _fill_holes(rgb, known)
    noise = rng.normal(size=filled.shape).astype(np.float32) * rng.uniform(*_NOISE)
    pixels = np.clip(np.rint(filled + noise * np.sqrt(np.maximum(filled, 1) / 128)), 0, 255).astype(np.uint8)
    return SyntheticPhoto(
        Photo(pixels, camera, name="synthetic photo of the scan", calibrated=True), pose, float(covered.mean())
    )


def unrelated_photo(photo: Photo, number: int) -> Photo:
    """Return a photo of a scene that the scan does not show: mirrored, or cut into tiles in another order.

    Args:
        photo: a photograph.
        number: selects mirroring (even) or one of the orders (odd).
    """
    pixels: NDArray[Any] = np.asarray(photo.pixels)
    if number % 2 == 0:
        pixels = pixels[:, ::-1]
    else:
        parts = [p for row in np.array_split(pixels, 3) for p in np.array_split(row, 4, axis=1)]
        order = np.random.default_rng(number).permutation(len(parts))
        height, width = (min(p.shape[axis] for p in parts) for axis in (0, 1))
        rows = [np.hstack([parts[k][:height, :width] for k in order[4 * r : 4 * r + 4]]) for r in range(3)]
        pixels = cv2.resize(np.vstack(rows), photo.camera.size, interpolation=cv2.INTER_LINEAR)
    return Photo(np.ascontiguousarray(pixels), photo.camera, name="unrelated photo", calibrated=True)


def _relit(scan: Scan, rng: np.random.Generator) -> ByteArray:
    """Return the picture (H, W, 3) of the scan in another light and with other inks."""
    ink = _ink(scan, rng)
    shade = _shade(scan, rng)
    relit = np.empty((*scan.shape, 3), dtype=np.float32)
    for c in range(3):
        relit[..., c] = 255 * _tone(ink[..., c] / 255, rng) * shade
    return np.clip(np.rint(relit), 0, 255).astype(np.uint8)


def _ink(scan: Scan, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return (H, W, 3) float32, 0 to 255: the colour of the scan, its intensity compensated for range, or inks drawn
    for its surfaces if it has neither."""
    if scan.color is not None:
        return np.asarray(scan.color, dtype=np.float32)
    if not carries_intensity(scan):
        return _inks_of_surfaces(scan, rng)
    signal = np.maximum(scan.intensity, 0).astype(np.float32)
    if scan.intensity_is == "raw":
        median = float(np.nanmedian(scan.ranges))
        ratio = np.nan_to_num(scan.ranges / median, nan=1.0)
        signal = signal * np.clip(ratio, 0.4, 4.0) ** 2
    signal = np.sqrt(signal)
    low, high = np.percentile(signal[scan.valid], (1, 99.5))
    gray = np.clip((signal - low) * (255 / max(float(high - low), 1e-9)), 0, 255)
    return np.repeat(gray[..., None].astype(np.float32), 3, axis=2)


def _inks_of_surfaces(scan: Scan, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return a random ink for every surface: connected cells of about one range that face up, or to the side, alike."""
    ranges, up = np.nan_to_num(scan.ranges), np.abs(_normals(scan)[..., 2]) > _FACING_UP
    picture = np.empty((*scan.shape, 3), dtype=np.float32)
    picture[:] = rng.uniform(0, 255, 3)
    low, high = (cv2.erode(ranges, np.ones((3, 3))), cv2.dilate(ranges, np.ones((3, 3))))
    smooth = (low > 0) & (high - low < _SAME_SURFACE * ranges)
    for facing in (up, ~up):
        count, label, figures, _ = cv2.connectedComponentsWithStats((smooth & facing).astype(np.uint8), connectivity=4)
        inks = rng.uniform(0, 255, (count, 3)).astype(np.float32)
        large = figures[:, cv2.CC_STAT_AREA] >= _MIN_SURFACE
        large[0] = False
        picture[large[label]] = inks[label[large[label]]]
    inked = smooth[..., None] & np.ones(3, np.bool_)
    nearest = [fill_from_nearest(np.ascontiguousarray(picture[..., c]), inked[..., c]) for c in range(3)]
    return np.stack(nearest, axis=-1)


def _with_sky(
    rgb: ByteArray, covered: BoolArray, scan: Scan, camera: Camera, pose: Rigid, rng: np.random.Generator
) -> tuple[ByteArray, BoolArray]:
    """Return the picture with a sky where the scan looked and nothing returned, and where the picture is known."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.unproject(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)) @ pose.rotation
    cell = scan.geometry.cell_of(rays)
    inside = np.isfinite(cell).all(axis=-1) & (cell >= 0).all(axis=-1) & (cell <= np.array(scan.shape) - 1).all(axis=-1)
    sky = np.zeros(len(rays), np.bool_)
    row, column = np.rint(cell[inside]).astype(np.intp).T
    sky[inside] = open_cells(scan)[row, column]
    sky = sky.reshape(covered.shape) & ~covered
    shown = rgb.copy()
    shown[sky] = np.rint(255 * rng.uniform(*_SKY, 3)).astype(np.uint8)
    return shown, np.asarray(covered | sky)


def _tone(values: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Map values 0 to 1 by a random tone curve, which may fall as well as rise: inks differ by wavelength."""
    steps = rng.uniform(-0.35, 1.0, _KNOTS - 1)
    knots = np.concatenate([[0.0], np.cumsum(steps)])
    knots = 0.08 + 0.84 * (knots - knots.min()) / max(float(np.ptp(knots)), 1e-6)
    return np.asarray(np.interp(values, np.linspace(0, 1, _KNOTS), knots), dtype=np.float32)


def _shade(scan: Scan, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the brightness (H, W) of each cell under a lamp at a random position, 0 to about 1."""
    points = np.nan_to_num(np.asarray(scan.points, dtype=np.float32))
    normals = _normals(scan)
    facing = np.where((normals * points).sum(axis=2, keepdims=True) > 0, -1.0, 1.0)
    lamp = rng.normal(size=3) * float(np.nanmedian(scan.ranges)) * 0.7
    to_lamp = lamp.astype(np.float32) - points
    to_lamp /= np.maximum(np.linalg.norm(to_lamp, axis=2, keepdims=True), 1e-6)
    ambient = float(rng.uniform(*_AMBIENT))
    lit = np.maximum((facing * normals * to_lamp).sum(axis=2), 0)
    return np.asarray(ambient + (1 - ambient) * lit, dtype=np.float32)


def _normals(scan: Scan) -> NDArray[np.float32]:
    """Return the smoothed unit normals (H, W, 3) of the cells, of either sign; 0 where there is none."""
    points = np.nan_to_num(np.asarray(scan.points, dtype=np.float32))
    right, down = (cv2.Sobel(points, cv2.CV_32F, dx, 1 - dx, ksize=3) for dx in (1, 0))
    normals = cv2.GaussianBlur(np.cross(right, down), (0, 0), _NORMAL_BLUR)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    return np.asarray(np.divide(normals, length, out=np.zeros_like(normals), where=length > 0), dtype=np.float32)


def _fill_holes(rgb: ByteArray, covered: BoolArray) -> NDArray[np.float32]:
    """Fill what the scan did not see from its surroundings; return (H, W, 3) float32.

    A constant colour there would draw the outline of the scan's holes into the photograph.
    """
    values, weight = rgb.astype(np.float32) * covered[..., None], covered.astype(np.float32)
    return _pull_push(values, weight)


def _pull_push(values: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return weighted values with their gaps filled from an image of half the size, recursively."""
    height, width = weight.shape
    known = values / np.maximum(weight, 1e-6)[..., None]
    if min(height, width) <= 2:
        total = max(float(weight.sum()), 1e-6)
        mean = values.reshape(-1, 3).sum(axis=0) / total
        return np.where((weight > 0)[..., None], known, mean).astype(np.float32)
    half = (max(1, width // 2), max(1, height // 2))
    half_values, half_weight = (cv2.resize(plane, half, interpolation=cv2.INTER_AREA) for plane in (values, weight))
    smaller = _pull_push(np.asarray(half_values, dtype=np.float32), np.asarray(half_weight, dtype=np.float32))
    coarse = cv2.resize(smaller, (width, height), interpolation=cv2.INTER_LINEAR)
    share = np.clip(weight, 0, 1)[..., None]
    return np.asarray(known * share + coarse * (1 - share), dtype=np.float32)
