"""Recognise a photo that is turned about its optical axis, from either picture's corners, before a pose is known.

Correlation windows and descriptors bear some 15 degrees of roll. Beyond that hardly any correct match is found (thesis
3.4, Figure 3.20), and what is found looks no different from the few matches of a difficult pair. So the photo's
descriptors are turned too: at the right angle the matches agree on where the one picture lies in the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.arrays import FloatArray, read_only
from ladarreg_core.errors import ShapeError
from ladarreg_core.features.channels import ORIENTATIONS, normalised_channels, raw_channels
from ladarreg_core.features.correlation import check_window, unique_matches
from ladarreg_core.features.descriptors import unit_rows

ANGLES = 24
"""So many turns are tried, evenly spaced."""
_STEP_RAD = 2 * np.pi / ANGLES
_MARGIN = 0.02
_MAX_CORNERS = 500
_APART_PX = 3
_SPACING_PX, _WINDOW_PX = 6.0, 15
_ALIKE_PX = 40.0  # parallax spreads the displacements of one scene
_MIN_MATCHES = 10
_MAX_POSED, _MIN_INLIERS = 3, 8
_MIN_PEAK_RATIO = 1.5
_TOLERATED_RAD = 1.5 * _STEP_RAD
_Pairs = tuple[NDArray[np.float64], NDArray[np.float64]]
Inliers = Callable[[NDArray[np.float64], NDArray[np.float64]], int]
"""How many of the matches, pixels (K, 2) of the view and of the photo, one pose explains."""
_SIDE = 7
_BIN_RAD = np.pi / ORIENTATIONS


@dataclass(frozen=True, slots=True)
class Roll:
    """A roll of the photo against the scan's view that its corners speak for."""

    angle_rad: float
    """gamma of the thesis's parameters, rad: positive where the camera was rolled clockwise, seen from behind it. What
    the photo shows is then turned counter-clockwise. Known to some degrees; within 15 where few matches agree."""
    matches: int
    """Matches that agree on one displacement between the pictures at this turn."""
    upright_matches: int
    """The same with the photo as it is."""

    def summary(self) -> str:
        """Return the finding with what to do, as a sentence for an operator."""
        degrees = abs(np.degrees(self.angle_rad))
        way = "clockwise" if self.angle_rad > 0 else "counter-clockwise"
        return (
            f"The camera seems to have been rolled by about {degrees:.0f} deg {way} ({self.matches} matches agree on "
            f"it, {self.upright_matches} on the photo as it is), and windows that are not turned hardly correlate. "
            f"Turn the photo {way} by as much, so that it stands upright, or pick the matches by hand."
        )


@dataclass(frozen=True, slots=True, eq=False)
class RollMatches:
    """A roll with the matches that were found at it."""

    turn: Roll
    """The roll."""
    scan_uv: NDArray[np.float64]
    """(K, 2) pixels of the view."""
    photo_uv: NDArray[np.float64]
    """(K, 2) pixels of the photo as it is."""


def detect_roll(
    scan_gray: ArrayLike,
    scan_uv: ArrayLike,
    photo_gray: ArrayLike,
    photo_uv: ArrayLike,
    *,
    window_px: int = _WINDOW_PX,
    margin: float = _MARGIN,
) -> Roll | None:
    """Return by how much the photo seems rolled against the scan's view.

    Args:
        scan_gray: (H, W) gray levels of the view.
        scan_uv: (N, 2) its corners, pixels, the strongest first.
        photo_gray: (h, w) gray levels of the photo, at the same focal length.
        photo_uv: (M, 2) its corners, pixels, the strongest first.
        window_px: side of the windows that the corners are else compared by, odd; the descriptors grow with it.
        margin: C1 - C2 must exceed it. Far less than for matches that a pose is to be solved from: which of them are
            right is told by their agreement.

    Returns:
        the turn; None where the photo as it is fits as well, or no angle stands out from the others.

    Raises:
        ShapeError: if a picture is not (H, W) and finite, or corners are not (N, 2) and finite.
        OptionError: if there is no such window or margin.

    Source: thesis 3.4, Figure 3.20, where this is what fails.
    """
    check_window(window_px)
    sides = ((scan_gray, scan_uv, "scan"), (photo_gray, photo_uv, "photo"))
    (scan, scan_at), (photo, photo_at) = (_channels_and_corners(*side) for side in sides)
    spacing = _SPACING_PX * window_px / _WINDOW_PX
    found = roll_between(scan, scan_at, photo, photo_at, margin=margin, spacing_px=spacing)
    return None if found is None or abs(found.turn.angle_rad) < _TOLERATED_RAD else found.turn


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
    """Return the roll that the matches of turned descriptors agree on.

    Args:
        scan_channels: (H, W, 8) normalised channels of the view.
        scan_uv: (N, 2) its corners, pixels, the strongest first.
        photo_channels: (h, w, 8) those of the photo, at the same focal length.
        photo_uv: (M, 2) its corners, pixels, the strongest first.
        margin: C1 - C2 must exceed it.
        spacing_px: between a descriptor's samples.
        inliers: how many matches one pose explains, where that can be asked. Displacements of a deep scene differ, so
            that no roll stands out by them; a pose explains them all.

    Returns:
        the roll, of half a step of 15 degrees or more; None where upright fits best, or no angle stands out.
    """
    scan_at, photo_at = _apart(scan_uv), _apart(photo_uv)
    described = describe_rotated(scan_channels, scan_at, 0.0, spacing_px=spacing_px)

    def matches_at(angle: float, margin: float) -> _Pairs:
        score = described @ describe_rotated(photo_channels, photo_at, angle, spacing_px=spacing_px).T
        first, second, _ = unique_matches(score, margin=margin)
        return scan_at[first], photo_at[second]

    angles = np.arange(ANGLES) * _STEP_RAD
    matched = [matches_at(angle, margin) for angle in angles]
    counts = [_agreeing(*pairs, angle) for pairs, angle in zip(matched, angles, strict=True)]
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
        agreeing, pairs, between = explained[best], found[best], 0.0
        if agreeing < _MIN_INLIERS:
            return None
    if best == 0:
        return None
    # The photo's descriptors were turned clockwise to where the scan's are: the camera was turned the other way.
    clockwise = _STEP_RAD * (best + between)
    angle = (np.pi - clockwise) % (2 * np.pi) - np.pi
    turn = Roll(angle_rad=float(angle), matches=agreeing, upright_matches=counts[0])
    return RollMatches(turn, *pairs)


def describe_rotated(
    channels: FloatArray, uv: NDArray[np.float64], angle_rad: float, *, spacing_px: float = 6.0
) -> FloatArray:
    """Return the descriptors of pixels that a picture turned back by an angle would have.

    What lies d beside a corner in an upright picture lies at d turned by the angle in this one, and an edge's
    orientation there is greater by the angle. Between two orientation channels it is interpolated linearly.

    Args:
        channels: (H, W, 8) normalised channels.
        uv: (N, 2) pixels; samples beyond the picture take its border's value.
        angle_rad: by which the picture is turned clockwise on the screen (u right, v down).
        spacing_px: between the 7 x 7 samples.

    Returns:
        (N, 392) float32, mean removed, unit length; at an angle of 0 those of `describe`.
    """
    height, width = channels.shape[:2]
    reach = (np.arange(_SIDE) - _SIDE // 2) * spacing_px
    dv, du = np.meshgrid(reach, reach, indexing="ij")
    offsets = rotate_pixels(np.stack([du.ravel(), dv.ravel()], axis=-1), angle_rad)
    u = np.clip(np.rint(uv[:, 0, None] + offsets[:, 0]).astype(np.intp), 0, width - 1)
    v = np.clip(np.rint(uv[:, 1, None] + offsets[:, 1]).astype(np.intp), 0, height - 1)
    samples = channels.reshape(-1, ORIENTATIONS).take(v * width + u, axis=0)
    bins = angle_rad / _BIN_RAD
    whole = int(np.floor(bins))
    part = np.float32(bins - whole)
    each = np.eye(ORIENTATIONS, dtype=np.float32)
    samples = samples @ (np.roll(each, whole, axis=0) * (1 - part) + np.roll(each, whole + 1, axis=0) * part)
    return unit_rows(samples.reshape(len(uv), _SIDE * _SIDE * ORIENTATIONS))


def rotate_pixels(uv: NDArray[np.float64], angle_rad: float) -> NDArray[np.float64]:
    """Return vectors (N, 2) of pixels (u right, v down) turned by an angle, rad, clockwise on the screen."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.asarray(uv @ np.array([[c, -s], [s, c]]).T)


def _channels_and_corners(gray: ArrayLike, uv: ArrayLike, name: str) -> tuple[FloatArray, NDArray[np.float64]]:
    picture = read_only(gray, np.float32, (None, None), f"the {name}'s gray picture")
    corners = read_only(uv, np.float64, (None, 2), f"the {name}'s corners")
    if not picture.size or not (np.isfinite(picture).all() and np.isfinite(corners).all()):
        raise ShapeError(f"the {name}'s gray picture or corners are empty or hold NaN or infinity; give finite ones")
    return normalised_channels(raw_channels([picture])), corners


def _apart(uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the first corners of those that crowd: a crowd's corners are each other's rivals."""
    u, v = uv.T
    near = (np.abs(u[:, None] - u) <= _APART_PX) & (np.abs(v[:, None] - v) <= _APART_PX)
    kept = ~np.tril(near, -1).any(axis=1)
    for k in np.flatnonzero(~kept):  # what crowds only corners that are not kept is kept itself
        kept[k] = not (near[k, :k] & kept[:k]).any()
    return uv[np.flatnonzero(kept)[:_MAX_CORNERS]]


def _agreeing(scan_uv: NDArray[np.float64], photo_uv: NDArray[np.float64], angle: float) -> int:
    """Return how many matches have displacements that are alike, the scan's picture turned by the angle."""
    if not len(scan_uv):
        return 0
    displacement = photo_uv - rotate_pixels(scan_uv, angle)
    between = displacement[:, None] - displacement[None]
    return int((np.hypot(between[..., 0], between[..., 1]) <= _ALIKE_PX).sum(axis=1).max())


def _peak(before: int, at: int, after: int) -> float:
    """Return where between -.5 and .5 steps the parabola through three counts has its peak.

    Parallax does not disturb it as it does the turn that the matches' positions would tell.
    """
    curvature = 2 * at - before - after
    return 0.5 * (after - before) / curvature if curvature > 0 else 0.0


def _within_a_step(k: int) -> tuple[int, int, int]:
    return (k - 1) % ANGLES, k, (k + 1) % ANGLES
