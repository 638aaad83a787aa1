"""Detection of camera roll about the optical axis from the corners of both images, before a pose is known.

Correlation windows and descriptors tolerate about 15 degrees of roll. Beyond that hardly any correct match is found
(thesis 3.4, Figure 3.20), and the result cannot be distinguished from the few matches of a difficult pair. Therefore
the photo's descriptors are computed for a set of rotations: at the correct one the matches agree on one displacement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import FloatArray, read_only
from ladarreg_core.foundations.parallel import side_by_side
from ladarreg_core.matching.features.channels import normalised_channels, raw_channels
from ladarreg_core.matching.features.correlation import check_window, unique_matches
from ladarreg_core.matching.features.descriptors import descriptors_of

ANGLES = 24
"""Number of rotations tried, evenly spaced."""
_STEP_RAD = 2 * np.pi / ANGLES
_MARGIN = 0.02
_MAX_CORNERS = 500
_APART_PX = 3
_SPACING_PX, _WINDOW_PX = 6.0, 15
_SAME_DISPLACEMENT_PX = 40.0  # parallax spreads the displacements of one scene
_MIN_MATCHES = 10
_MAX_POSED, _MIN_INLIERS = 3, 8
_MIN_PEAK_RATIO = 1.5
_TOLERATED_RAD = 1.5 * _STEP_RAD
_Pairs = tuple[NDArray[np.float64], NDArray[np.float64]]
Inliers = Callable[[NDArray[np.float64], NDArray[np.float64]], int]
"""Counts the inliers of the best pose among matches given as pixels (K, 2) of the view and of the photo."""
_SIDE = 7


@dataclass(frozen=True, slots=True)
class Roll:
    """Roll of the camera relative to the scan's view, estimated from corners."""

    angle_rad: float
    """gamma of the thesis's parameters, rad: positive if the camera was rolled clockwise, seen from behind it. The
    content of the photo is then rotated counter-clockwise. Accurate to a few degrees; to 15 if few matches agree."""
    matches: int
    """Matches that agree on one displacement between the images at this roll."""
    upright_matches: int
    """The same number without roll."""

    def summary(self) -> str:
        """Return the finding and the advice, for an operator."""
        degrees = abs(np.degrees(self.angle_rad))
        way = "clockwise" if self.angle_rad > 0 else "counter-clockwise"
        return (
            f"The camera appears to have been rolled by about {degrees:.0f} deg {way}: {self.matches} matches agree at "
            f"that roll, {self.upright_matches} without it. Correlation does not work at such a roll. "
            f"Rotate the photo {way} by that angle, or pick the matches by hand."
        )


@dataclass(frozen=True, slots=True, eq=False)
class RollMatches:
    """A roll with the matches found at it."""

    roll: Roll
    """The roll."""
    scan_uv: NDArray[np.float64]
    """(K, 2) pixels of the view."""
    photo_uv: NDArray[np.float64]
    """(K, 2) pixels of the unrotated photo."""


def detect_roll(
    scan_gray: ArrayLike,
    scan_uv: ArrayLike,
    photo_gray: ArrayLike,
    photo_uv: ArrayLike,
    *,
    window_px: int = _WINDOW_PX,
    margin: float = _MARGIN,
) -> Roll | None:
    """Return the roll of the camera relative to the scan's view, if it is too large for correlation.

    Args:
        scan_gray: (H, W) gray levels of the view.
        scan_uv: (N, 2) its corners, pixels, strongest first.
        photo_gray: (h, w) gray levels of the photo, at the same focal length.
        photo_uv: (M, 2) its corners, pixels, strongest first.
        window_px: side of the correlation windows, odd; the descriptors scale with it.
        margin: C1 - C2 must exceed it. It is much smaller than for matches used for a pose, because here wrong matches
            are recognised by their displacement.

    Returns:
        the roll; None if it is small or if no angle has clearly more matches than the others.

    Raises:
        ShapeError: if an image is not (H, W) and finite, or corners are not (N, 2) and finite.
        OptionError: if the window or the margin is out of range.

    Source: thesis 3.4, Figure 3.20, for the failure that this detects.
    """
    check_window(window_px)
    sides = ((scan_gray, scan_uv, "scan"), (photo_gray, photo_uv, "photo"))
    (scan, scan_at), (photo, photo_at) = (_channels_and_corners(*side) for side in sides)
    spacing = _SPACING_PX * window_px / _WINDOW_PX
    found = roll_between(scan, scan_at, photo, photo_at, margin=margin, spacing_px=spacing)
    return None if found is None or abs(found.roll.angle_rad) < _TOLERATED_RAD else found.roll


def roll_between(
    scan_channels: FloatArray,
    scan_uv: NDArray[np.float64],
    photo_channels: FloatArray,
    photo_uv: NDArray[np.float64],
    *,
    margin: float = _MARGIN,
    spacing_px: float = _SPACING_PX,
    inliers: Inliers | None = None,
) -> RollMatches | None:
    """Return the roll that the matches of rotated descriptors agree on.

    Args:
        scan_channels: (H, W, C) normalised channels of the view.
        scan_uv: (N, 2) its corners, pixels, strongest first.
        photo_channels: (h, w, C) those of the photo, at the same focal length.
        photo_uv: (M, 2) its corners, pixels, strongest first.
        margin: C1 - C2 must exceed it.
        spacing_px: distance between the samples of a descriptor.
        inliers: counts the inliers of a pose; None: matches are counted by displacement only. In a deep scene the
            displacements differ, so that no roll has clearly more of them, while a pose explains all matches.

    Returns:
        the roll, at least half a step of 15 degrees; None if no roll fits best, or no angle is distinct.
    """
    scan_at, photo_at = _apart(scan_uv), _apart(photo_uv)
    described = describe_rotated(scan_channels, scan_at, 0.0, spacing_px=spacing_px)

    def matches_at(angle: float, margin: float) -> _Pairs:
        score = described @ describe_rotated(photo_channels, photo_at, angle, spacing_px=spacing_px).T
        first, second, _ = unique_matches(score, margin=margin)
        return scan_at[first], photo_at[second]

    angles = np.arange(ANGLES) * _STEP_RAD

    def counted(angle: float) -> tuple[_Pairs, int]:
        pairs = matches_at(angle, margin)
        return pairs, _agreeing(*pairs, angle)

    matched, counts = zip(*side_by_side(counted, angles), strict=True)
    best = int(np.argmax(counts))
    agreeing, pairs, between = counts[best], matched[best], _peak(*(counts[k] for k in _within_a_step(best)))
    others = [counts[k] for k in set(range(ANGLES)).difference(_within_a_step(best))]
    if agreeing < max(_MIN_MATCHES, _MIN_PEAK_RATIO * max(others)):
        if inliers is None:
            return None
        likely = [int(k) for k in np.argsort(counts, kind="stable")[::-1][:_MAX_POSED]]
        found = {k: matches_at(angles[k], 0.0) for k in likely}
        explained = {k: inliers(*found[k]) for k in likely}
        best = max(likely, key=lambda k: explained[k])
        agreeing, pairs = explained[best], found[best]
        if agreeing < _MIN_INLIERS:
            return None
        # A roll between two steps has poses at both, of which chance decides the better.
        before, _, after = (n if (n := explained.get(k, 0)) >= _MIN_INLIERS else 0 for k in _within_a_step(best))
        between = (after - before) / (before + agreeing + after)
    if best == 0:
        return None
    # The photo's descriptors were rotated clockwise onto the scan's: the camera was rolled the other way.
    clockwise = _STEP_RAD * (best + between)
    angle = (np.pi - clockwise) % (2 * np.pi) - np.pi
    roll = Roll(angle_rad=float(angle), matches=agreeing, upright_matches=counts[0])
    return RollMatches(roll, *pairs)


def describe_rotated(
    channels: FloatArray, uv: NDArray[np.float64], angle_rad: float, *, spacing_px: float = 6.0
) -> FloatArray:
    """Return the descriptors that pixels would have in the image rotated back by an angle.

    Both the sample positions and the orientation channels are rotated by the angle.

    Args:
        channels: (H, W, C) normalised channels.
        uv: (N, 2) pixels; samples outside the image take the value of its border.
        angle_rad: clockwise rotation of the image on the screen (u right, v down).
        spacing_px: distance between the 7 x 7 samples.

    Returns:
        (N, 49 C) float32, unit length; equal to `describe` at an angle of 0.
    """
    height, width = channels.shape[:2]
    reach = (np.arange(_SIDE) - _SIDE // 2) * spacing_px
    dv, du = np.meshgrid(reach, reach, indexing="ij")
    offsets = rotate_pixels(np.stack([du.ravel(), dv.ravel()], axis=-1), angle_rad)
    u = np.clip(np.rint(uv[:, 0, None] + offsets[:, 0]).astype(np.intp), 0, width - 1)
    v = np.clip(np.rint(uv[:, 1, None] + offsets[:, 1]).astype(np.intp), 0, height - 1)
    samples = channels.reshape(-1, channels.shape[-1]).take(v * width + u, axis=0)
    samples = samples @ _rotation_of_channels(channels.shape[-1], angle_rad)
    return descriptors_of(samples.reshape(len(uv), _SIDE * _SIDE, channels.shape[-1]))


def _rotation_of_channels(count: int, angle_rad: float) -> FloatArray:
    """Return the matrix (C, C) that rotates rows of channels back: harmonic k turns by 2 k times the angle."""
    matrix = np.eye(count, dtype=np.float32)
    for first in range(1, count, 2):
        turn = (first + 1) * angle_rad
        c, s = np.cos(turn), np.sin(turn)
        matrix[first : first + 2, first : first + 2] = [[c, -s], [s, c]]
    return matrix


def rotate_pixels(uv: NDArray[np.float64], angle_rad: float) -> NDArray[np.float64]:
    """Return pixel vectors (N, 2) (u right, v down) rotated clockwise on the screen by an angle, rad."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.asarray(uv @ np.array([[c, -s], [s, c]]).T)


def _channels_and_corners(gray: ArrayLike, uv: ArrayLike, name: str) -> tuple[FloatArray, NDArray[np.float64]]:
    image = read_only(gray, np.float32, (None, None), f"the {name}'s gray image")
    corners = read_only(uv, np.float64, (None, 2), f"the {name}'s corners")
    if not image.size or not (np.isfinite(image).all() and np.isfinite(corners).all()):
        raise ShapeError(f"the {name}'s gray image or corners are empty or contain NaN or infinity; give finite values")
    return normalised_channels(raw_channels([image])), corners


def _apart(uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the corners without those close to a stronger one, since neighbours compete in unique matching."""
    u, v = uv.T
    near = (np.abs(u[:, None] - u) <= _APART_PX) & (np.abs(v[:, None] - v) <= _APART_PX)
    kept = ~np.tril(near, -1).any(axis=1)
    for k in np.flatnonzero(~kept):  # a corner close only to dropped corners is kept
        kept[k] = not (near[k, :k] & kept[:k]).any()
    return uv[np.flatnonzero(kept)[:_MAX_CORNERS]]


def _agreeing(scan_uv: NDArray[np.float64], photo_uv: NDArray[np.float64], angle: float) -> int:
    """Return the largest number of matches with similar displacements, the view being rotated by the angle."""
    if not len(scan_uv):
        return 0
    displacement = photo_uv - rotate_pixels(scan_uv, angle)
    between = displacement[:, None] - displacement[None]
    return int((np.hypot(between[..., 0], between[..., 1]) <= _SAME_DISPLACEMENT_PX).sum(axis=1).max())


def _peak(before: int, at: int, after: int) -> float:
    """Return the peak of the parabola through three counts, between -.5 and .5 steps.

    Unlike a rotation fitted to the positions of the matches, it is not biased by parallax.
    """
    curvature = 2 * at - before - after
    return 0.5 * (after - before) / curvature if curvature > 0 else 0.0


def _within_a_step(k: int) -> tuple[int, int, int]:
    return (k - 1) % ANGLES, k, (k + 1) % ANGLES
