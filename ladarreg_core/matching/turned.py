"""Recognise a photo that is turned about its optical axis before a pose is looked for.

Correlation windows bear some 15 degrees of roll. Beyond that hardly any correct match is found (thesis 3.4, Figure
3.20), and what is found looks no different from the few matches of a difficult pair. So the photo's windows are turned
too: at the right angle the matches agree on where the one picture lies in the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.arrays import FloatArray, read_only
from ladarreg_core.errors import ShapeError
from ladarreg_core.features.descriptors import unit_rows
from ladarreg_core.lookup import look_up
from ladarreg_core.matching.correlation import check_window, edge_picture, unique_matches

ANGLES = 24
"""So many turns are tried, evenly spaced."""
_STEP_RAD = 2 * np.pi / ANGLES
_MARGIN = 0.02
_MOST_CORNERS = 500
_APART_PX = 3
_BLUR_PX, _SPACING_PX = 1.0, 2.0  # a turned window shares no fine detail, and a larger one tells more
_ALIKE_PX = 40.0  # parallax spreads the displacements of one scene
_LEAST_MATCHES = 10
_STANDS_OUT = 1.5


@dataclass(frozen=True, slots=True)
class Turn:
    """A roll of the photo against the scan's view that its corners speak for."""

    angle_rad: float
    """gamma of the thesis's parameters, rad: positive where the camera was rolled clockwise, seen from behind it. What
    the photo shows is then turned counter-clockwise. Known to some degrees; within 15 where few matches agree."""
    matches: int
    """Matches that agree on one displacement between the pictures at this turn."""
    upright_matches: int
    """The same with the photo as it is."""

    def in_words(self) -> str:
        """Return the finding with what to do, as a sentence for an operator."""
        degrees = abs(np.degrees(self.angle_rad))
        way = "clockwise" if self.angle_rad > 0 else "counter-clockwise"
        return (
            f"The camera seems to have been rolled by about {degrees:.0f} deg {way} ({self.matches} matches agree on "
            f"it, {self.upright_matches} on the photo as it is), and windows that are not turned hardly correlate. "
            f"Turn the photo {way} by as much, so that it stands upright, or pick the matches by hand."
        )


def seems_turned(
    scan_gray: ArrayLike,
    scan_uv: ArrayLike,
    photo_gray: ArrayLike,
    photo_uv: ArrayLike,
    *,
    window_px: int = 15,
    margin: float = _MARGIN,
) -> Turn | None:
    """Return by how much the photo seems rolled against the scan's view.

    Args:
        scan_gray: (H, W) gray levels of the view.
        scan_uv: (N, 2) its corners, pixels, the strongest first.
        photo_gray: (h, w) gray levels of the photo, at the same focal length.
        photo_uv: (M, 2) its corners, pixels, the strongest first.
        window_px: side of the compared windows in samples, which lie two pixels apart; odd.
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
    scan, photo = _Side.of(scan_gray, scan_uv, "scan"), _Side.of(photo_gray, photo_uv, "photo")
    scan_rows = scan.rows(0.0, window_px)
    counts: list[int] = []
    for angle in np.arange(ANGLES) * _STEP_RAD:
        score = scan_rows @ photo.rows(angle, window_px).T / 2
        first, second, _ = unique_matches(score, margin=margin)
        counts.append(_agreeing(scan.uv[first], photo.uv[second], angle))
    best = int(np.argmax(counts))
    others = [counts[k] for k in set(range(ANGLES)).difference(_within_a_step(best))]
    if best in _within_a_step(0) or counts[best] < max(_LEAST_MATCHES, _STANDS_OUT * max(others)):
        return None
    # The photo's windows were turned clockwise to where the scan's are: the camera was turned the other way.
    clockwise = _STEP_RAD * (best + _peak(*(counts[k] for k in _within_a_step(best))))
    angle = (np.pi - clockwise) % (2 * np.pi) - np.pi
    return Turn(angle_rad=float(angle), matches=counts[best], upright_matches=counts[0])


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """One picture's responses and its corners."""

    responses: tuple[FloatArray, FloatArray]
    """Gray level and edge, (H, W) float32."""
    uv: NDArray[np.float64]
    """(N, 2) pixels, apart from each other."""

    @staticmethod
    def of(gray: ArrayLike, uv: ArrayLike, name: str) -> _Side:
        picture = read_only(gray, np.float32, (None, None), f"the {name}'s gray picture")
        corners = read_only(uv, np.float64, (None, 2), f"the {name}'s corners")
        if not picture.size or not (np.isfinite(picture).all() and np.isfinite(corners).all()):
            raise ShapeError(
                f"the {name}'s gray picture or corners are empty or hold NaN or infinity; give finite ones"
            )
        smooth = np.asarray(cv2.GaussianBlur(picture, (0, 0), _BLUR_PX), dtype=np.float32)
        return _Side((smooth, edge_picture(smooth)), _apart(corners))

    def rows(self, angle: float, side: int) -> FloatArray:
        """Return the normalised windows (N, 2 side^2) of both responses, turned by an angle, rad, clockwise."""
        reach = (np.arange(side) - side // 2) * _SPACING_PX
        dv, du = np.meshgrid(reach, reach, indexing="ij")
        offsets = np.stack([du.ravel(), dv.ravel()], axis=-1) @ _rotation(angle).T
        u, v = (self.uv[:, k, None] + offsets[:, k] for k in (0, 1))
        if not len(u):
            return np.zeros((0, 2 * side * side), np.float32)
        u, v = u.astype(np.float32), v.astype(np.float32)
        return np.hstack([unit_rows(look_up(response, u, v)) for response in self.responses])


def _apart(uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the first corners of those that crowd: a crowd's corners are each other's rivals."""
    kept: list[int] = []
    for k, corner in enumerate(uv):
        if len(kept) == _MOST_CORNERS:
            break
        if not (np.abs(uv[kept] - corner).max(axis=1, initial=0) <= _APART_PX).any():
            kept.append(k)
    return uv[kept]


def _agreeing(scan_uv: NDArray[np.float64], photo_uv: NDArray[np.float64], angle: float) -> int:
    """Return how many matches have displacements that are alike, the scan's picture turned by the angle."""
    if not len(scan_uv):
        return 0
    displacement = photo_uv - scan_uv @ _rotation(angle).T
    between = displacement[:, None] - displacement[None]
    return int((np.hypot(between[..., 0], between[..., 1]) <= _ALIKE_PX).sum(axis=1).max())


def _peak(before: int, at: int, after: int) -> float:
    """Return where between -.5 and .5 steps the parabola through three counts has its peak.

    Parallax does not disturb it as it does the turn that the matches' positions would tell.
    """
    curvature = 2 * at - before - after
    return 0.5 * (after - before) / curvature if curvature > 0 else 0.0


def _rotation(angle: float) -> NDArray[np.float64]:
    """Return the rotation (2, 2) of pixels (u right, v down) by an angle, rad, clockwise on the screen."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _within_a_step(k: int) -> tuple[int, int, int]:
    return (k - 1) % ANGLES, k, (k + 1) % ANGLES
