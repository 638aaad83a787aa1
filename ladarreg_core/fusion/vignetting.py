"""Vignetting: how a lens darkens its photographs towards their corners, solved from what they show together.

A photograph's light is that of the surface, over its gain g, times V(r) = exp(a r^2 + b r^4), where r is the distance
from the middle of the picture, 1 at its corners. Of a cell that two photographs show, the logarithm of the ratio of
their light is log V(r_1) - log V(r_2) + log g_2 - log g_1: linear in what is sought, and free of what the surface looks
like. Photographs of one lens, which have the same size and nearly the same focal length, share a and b. Source:
Goldman, Vignette and exposure calibration and compensation (2010), with a polynomial of log V in place of that of V.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.linear_light import encoded_light, linear_light
from ladarreg_core.fusion.exposure import sampled_light
from ladarreg_core.fusion.samples import PhotoSample
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.best_photo import PosedPhoto

_POWERS = (2, 4)
_SAME_LENS = 0.05  # of the focal length
_PRIOR = 0.5  # standard deviation of a and b: a corner at 60 % is common
_MAX_OF_PAIR, _MIN_OF_PAIR = 3000, 40
_ALIKE_CELLS = 50.0  # cells that err together
_ROUNDS, _CAUCHY = 10, 2.0
_MIN_SPREAD = 0.02  # of the logarithm of a ratio
_GAIN_PRIOR = 2.0
_ROWS_AT_ONCE = 256
_CODES = np.arange(256)


def solve_vignetting(
    samples: Sequence[Sequence[PhotoSample]],
    colors: Sequence[int],
    scans: Sequence[Scan],
    views: Sequence[Sequence[PosedPhoto]],
) -> NDArray[np.float64]:
    """Return a and b of each photograph.

    Args:
        samples: of all photographs, on each scan.
        colors: the indices of those that are solved.
        scans: the scans.
        views: of all photographs, relative to each scan.

    Returns:
        (K, 2) float64; 0 of all others, of panoramas, and of lenses whose photographs share nothing.
    """
    found = np.zeros((len(views[0]), len(_POWERS)))
    lenses = _lenses([views[0][k].camera for k in colors])
    if len(colors) < 2 or max(lenses) < 0:
        return found
    lights, radii = [], []
    sampled = sampled_light(samples, colors, [scan.shape for scan in scans])
    for scan, some, (log_light, stride) in zip(scans, views, sampled, strict=True):
        points = scan.points[::stride, ::stride].reshape(-1, 3).astype(np.float64)
        lights.append(log_light.mean(axis=-1, dtype=np.float64))  # all colours alike
        radii.append([_radius(some[k], points) for k in colors])
    solution = _solved(np.concatenate(lights, axis=1), np.concatenate(radii, axis=1), np.array(lenses))
    for k, lens in zip(colors, lenses, strict=True):
        if lens >= 0:
            found[k] = solution[lens]
    return found


def without_vignetting(photo: Photo, powers: FloatArray) -> Photo:
    """Return a photograph as bright at its corners as in its middle.

    Args:
        photo: the photograph.
        powers: (2,) a and b.
    """
    if not np.any(powers):
        return photo
    height, width = photo.pixels.shape[:2]
    table = linear_light(_CODES).astype(np.float32)
    across = np.square(np.arange(width) - (width - 1) / 2)
    half = (width**2 + height**2) / 4
    pixels = np.empty_like(photo.pixels)
    for top in range(0, height, _ROWS_AT_ONCE):
        rows = np.arange(top, min(top + _ROWS_AT_ONCE, height))
        squared = (np.square(rows - (height - 1) / 2)[:, None] + across) / half
        factor = np.exp(-(powers[0] * squared + powers[1] * squared**2))
        pixels[rows] = encoded_light(table[photo.pixels[rows]] * factor[..., None])
    return replace(photo, pixels=pixels)


def _lenses(cameras: Sequence[CameraModel]) -> list[int]:
    """Return the number of the lens of each photograph; -1 of a panorama, which has no corners."""
    known: list[tuple[tuple[int, int], float]] = []
    found = []
    for camera in cameras:
        if camera.as_focal is None:
            found.append(-1)
            continue
        focal_px = camera.focal_px
        same = (k for k, (size, f) in enumerate(known) if size == camera.size and abs(focal_px / f - 1) < _SAME_LENS)
        number = next(same, len(known))
        if number == len(known):
            known.append((camera.size, focal_px))
        found.append(number)
    return found


def _radius(view: PosedPhoto, points: FloatArray) -> NDArray[np.float64]:
    """Return how far from the middle of a photograph points (N, 3) are, 1 at the corners; NaN behind it."""
    size = np.array(view.camera.size, np.float64)
    uv = view.camera.project(view.camera_from_scanner @ points)
    return np.asarray(np.linalg.norm(uv - (size - 1) / 2, axis=1) / np.linalg.norm(size / 2))


def _solved(light: FloatArray, radius: FloatArray, lenses: NDArray[np.int_]) -> NDArray[np.float64]:
    """Return a and b of each lens, by robust least squares over pairs of photographs, with the gains as unknowns."""
    count, lens_count = len(light), int(lenses.max()) + 1
    unknowns = count + len(_POWERS) * lens_count
    basis = np.stack([radius**power for power in _POWERS], axis=-1)
    rng = np.random.default_rng(0)
    pairs = []
    known = np.isfinite(light) & np.isfinite(radius)
    for i in range(count):
        for j in range(i + 1, count):
            both = np.flatnonzero(known[i] & known[j])
            if len(both) < _MIN_OF_PAIR:
                continue
            some = rng.permutation(both)[:_MAX_OF_PAIR]
            rows = np.zeros((len(some), unknowns))
            rows[:, i], rows[:, j] = -1, 1
            for k, sign in ((i, 1), (j, -1)):
                if lenses[k] >= 0:
                    first = count + len(_POWERS) * lenses[k]
                    rows[:, first : first + len(_POWERS)] += sign * basis[k, some]
            columns = np.flatnonzero(np.any(rows, axis=0))
            weight = min(1.0, len(both) / _ALIKE_CELLS / len(some))
            pairs.append((columns, rows[:, columns], light[i, some] - light[j, some], weight))
    solution: NDArray[np.float64] = np.zeros(unknowns)
    prior = np.concatenate([np.full(count, _GAIN_PRIOR), np.full(unknowns - count, _PRIOR)])
    for _ in range(_ROUNDS if pairs else 0):
        normal, right = np.diag(prior**-2.0), np.zeros(unknowns)
        for columns, rows, ratio, weight in pairs:
            residual = ratio - rows @ solution[columns]
            spread = max(_MIN_SPREAD, 1.4826 * float(np.median(np.abs(residual - np.median(residual)))))
            robust = weight / spread**2 / (1 + np.square(residual / (_CAUCHY * spread)))
            normal[np.ix_(columns, columns)] += rows.T @ (robust[:, None] * rows)
            right[columns] += rows.T @ (robust * ratio)
        solution[:] = np.linalg.solve(normal, right)
    return solution[count:].reshape(lens_count, len(_POWERS))
