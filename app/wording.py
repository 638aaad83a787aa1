"""A registration in an operator's words."""

from __future__ import annotations

import unicodedata
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ladarreg_core.results import PoseResult

EVIDENCE = {
    "image": "verified on the picture itself",
    "statistics": "by the statistics of its matches",
    "none": "no evidence",
}


def one_line(text: str) -> str:
    """Return the text on one line, with control characters (of file names, say) made visible."""
    words = " ".join(text.split())
    return "".join(c if unicodedata.category(c)[0] != "C" else c.encode("unicode_escape").decode() for c in words)


def verdict(result: PoseResult) -> str:
    """Return accepted or not, and by which evidence."""
    if result.accepted:
        return f"Accepted, {EVIDENCE[result.evidence]}."
    return "Not accepted: the evidence is not enough to call this registered."


def position(result: PoseResult) -> str:
    """Return where the camera stood, seen from the scanner, with its standard deviation."""
    return f"{result.thesis_parameters.in_words()} (sigma {1000 * result.sigma_position_m:.1f} mm)"


def turn(result: PoseResult) -> str:
    """Return how the camera was turned against the scanner's X, with its standard deviation."""
    return f"{result.thesis_parameters.turn_in_words()} (sigma {sigma_angle(result)})"


def sigma_angle(result: PoseResult) -> str:
    """Return the standard deviation of the turn, in degrees."""
    return f"{57.29577951308232 * result.sigma_angle_rad:.3f} deg"


def matches(result: PoseResult) -> str:
    """Return how many matches hold, and how well."""
    inliers = int(result.inliers.sum())
    text = f"{inliers} of {len(result.matches)} hold"
    if inliers:
        squares = (result.residuals_px[result.inliers] ** 2).sum(axis=-1)
        text += f", {float(squares.mean()) ** 0.5:.2f} px rms"
    return text


def report(result: PoseResult) -> str:
    """Return the whole verdict, several lines."""
    lines = [verdict(result), *(f"  {one_line(reason)}" for reason in result.reasons)]
    if result.accepted:
        lines += [
            f"Camera   {position(result)}",
            f"Turned   {turn(result)}",
            f"Matches  {matches(result)}",
        ]
    return "\n".join(lines)
