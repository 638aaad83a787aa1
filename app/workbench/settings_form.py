"""The settings in an operator's words, with what the page needs to draw a control for each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args, get_type_hints

from ladarreg_core.errors import OptionError
from ladarreg_core.project.edits import finite

if TYPE_CHECKING:
    from ladarreg_core.project.settings import Settings

Part = Literal["corners", "match", "cull", "constrained", "lines", "simplex", "reject", "robust", "all"]


@dataclass(frozen=True, slots=True)
class Shown:
    """How one setting is shown."""

    label: str
    of: Part
    said: str
    least: float | None = None
    most: float | None = None
    step: float | None = None
    unit: str = ""


SHOWN: dict[str, Shown] = {
    "corners": Shown("Corners", "corners", "How many corners are looked for in each picture.", 50, 4000, 50),
    "window_px": Shown("Window", "match", "Side of the neighbourhoods that are compared.", 5, 41, 2, "px"),
    "t1": Shown("T1", "match", "The best correlation must beat the second best by this.", 0, 1, 0.01),
    "mutual": Shown("Mutual", "match", "A corner must also be the best of its partner."),
    "depth_edges": Shown("At depth edges", "corners", "What becomes of corners where a surface ends."),
    "t2_px": Shown("T2", "cull", "Largest deviation of a disparity from the median.", 1, 500, 1, "px"),
    "culling": Shown("Culling", "cull", "One-sided is Step 5 of the thesis to the letter."),
    "search_px": Shown("Search", "constrained", "Half the side of the window around the prediction.", 2, 200, 1, "px"),
    "constrained_t1": Shown("T1 there", "constrained", "T1 of the second search, where rivals are few.", 0, 1, 0.01),
    "lines": Shown("Lines count by", "lines", "Ends: with the ranges of the whole line. Equal, kappa: sampled."),
    "samples_per_line": Shown("Samples", "lines", "Points along a line where it is sampled.", 2, 200, 1),
    "residual": Shown("Residual", "simplex", "Stereo is Eq 2.21 of the thesis; epipolar has none of its poles."),
    "start_from": Shown("Start from", "simplex", "Where the simplex begins."),
    "step_m": Shown("Side, T", "simplex", "Of the first simplex; empty: a tenth of the depth.", 0.001, 10, 0.01, "m"),
    "step_rad": Shown("Side, angles", "simplex", "Of the first simplex.", 0.001, 1, 0.01, "rad"),
    "restarts": Shown("Restarts", "simplex", "Starts elsewhere where a descent ends in doubt.", 0, 10, 1),
    "reject_sigma": Shown("Reject beyond", "reject", "Robust standard deviations.", 0.5, 10, 0.1, "sigma"),
    "intrinsics": Shown("Camera", "robust", "What of the camera is estimated too."),
    "sigma_px": Shown("Pixel noise", "robust", "Empty: from the data.", 0.01, 50, 0.05, "px"),
    "sigma_range_m": Shown("Range noise", "robust", "Empty: from the data.", 0.0001, 1, 0.001, "m"),
    "seed": Shown("Seed", "all", "Of every draw; the same seed, the same answer.", 0, 2**31 - 1, 1),
}
WORDS = {
    "foreground": "take the foreground",
    "left_out": "leave them out",
    "one_sided": "one-sided",
    "two_sided": "two-sided",
    "ends": "their ends",
    "equal": "equal samples",
    "kappa": "kappa samples",
    "stereo": "stereo (Eq 2.21)",
    "epipolar": "repaired (px)",
    "shown": "the shown pose",
    "linear": "the linear pose",
    "robust": "the robust pose",
    "scanner": "the scanner's place",
    "auto": "what the data ask for",
    "fixed": "taken as given",
    "focal": "focal length free",
    "focal_k1": "focal length and k1 free",
}


def check_bounds(values: Mapping[str, Any]) -> None:
    """Refuse numbers beyond what the page says of a setting.

    Raises:
        OptionError: naming the setting and its bounds.
    """
    for name, value in values.items():
        shown = SHOWN.get(name)
        if shown is None or shown.least is None or shown.most is None or isinstance(value, bool):
            continue  # what is no number is checked with the setting's type
        if isinstance(value, int | float) and not shown.least <= value <= shown.most:
            number = finite(value)
            found = "too large" if number is None else f"{number:g}"
            unit = f" {shown.unit}" if shown.unit else ""
            raise OptionError(f"{shown.label} is {found}; it must be from {shown.least:g} to {shown.most:g}{unit}")


def settings_shown(settings: Settings) -> dict[str, dict[str, Any]]:
    """Return every setting with its value and how to draw it."""
    hints = get_type_hints(type(settings))
    found = {}
    for name, shown in SHOWN.items():
        value = getattr(settings, name)
        choices = [c for c in get_args(hints[name]) if isinstance(c, str)]
        kind = "switch" if isinstance(value, bool) else "choice" if choices else "number"
        found[name] = {
            "value": value,
            "label": shown.label,
            "kind": kind,
            "least": shown.least,
            "most": shown.most,
            "step": shown.step,
            "whole": hints[name] is int,
            "empty": type(None) in get_args(hints[name]),
            "choices": [{"value": c, "label": WORDS.get(c, c)} for c in choices],
            "unit": shown.unit,
            "step_of": shown.of,
            "said": shown.said,
        }
    return found
