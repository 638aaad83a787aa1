"""The verdict on a pose in words, and when its numbers are worth showing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray

Evidence = Literal["image", "ties", "rig", "statistics", "given", "none"]
GIVEN_MARK = "given, not verified"
"""The mark of a pose that was given, not solved."""
COARSE_CAVEAT = "accepted, coarse"
"""What files say of an accepted pose that is coarse."""
MATCHES_ONLY_CAVEAT = "accepted on matches only"
"""What files say of a pose that was accepted on its matches, where the images could not judge it."""

_MAX_ANGLE_RAD = float(np.radians(10.0))
_MAX_POSITION_OF_RANGE = 0.5
_USUAL_RANGE_M = 10.0

VERDICTS: dict[str, str] = {
    "image": "Accepted: verified against the image.",
    "statistics": "Accepted on matches only: the images could not judge it.",
    "ties": "Accepted: verified by ties with other photographs.",
    "rig": "Accepted: held by its rig to a verified photograph.",
    "given": "Given, not verified: this pose was applied, not solved.",
    "none": "Accepted without evidence.",
}
"""The verdict on a pose that is shown, by its evidence."""
_NOT_COMPARED = "Accepted on matches only: not compared with the images."
"""The verdict on a pose that rests on its matches, where nobody asked the images."""


def verdict_words(accepted: bool, evidence: str, diagnostics: Mapping[str, Any], *, coarse: bool = False) -> str:
    """Return whether a pose is accepted, and on what evidence, as a sentence; the arguments are a result's."""
    if accepted or evidence == "given":
        words = VERDICTS.get(evidence, VERDICTS["none"])
        if evidence == "statistics" and not (diagnostics.get("verification") or {}).get("outcome"):
            words = _NOT_COMPARED  # a single step of a chain, or a solver by itself
        return words.replace("Accepted", "Accepted, coarse", 1) if coarse else words
    if (diagnostics.get("lengths") or {}).get("refusal"):
        return "Not accepted: lengths of the matches disagree with the scan."
    contradicted = (diagnostics.get("verification") or {}).get("outcome") == "contradicted"
    return (
        "Not accepted: contradicted by the images." if contradicted else "Not accepted: the evidence is insufficient."
    )


def is_determined(sigma_angle_rad: float, sigma_position_m: float, ranges_m: FloatArray) -> bool:
    """Return whether standard deviations are small enough for the numbers of a pose to be worth showing.

    Args:
        sigma_angle_rad: of the camera orientation, rad.
        sigma_position_m: of the camera position, m.
        ranges_m: (M,) ranges of the matches, m; the position is compared with their median.
    """
    reach = float(np.median(ranges_m)) if len(ranges_m) else _USUAL_RANGE_M
    return sigma_angle_rad <= _MAX_ANGLE_RAD and sigma_position_m <= _MAX_POSITION_OF_RANGE * reach
