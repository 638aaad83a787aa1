"""The settings form: label, help, bounds and choices of each setting."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args, get_type_hints

from ladarreg_core.errors import OptionError
from ladarreg_core.project.edits import finite

if TYPE_CHECKING:
    from ladarreg_core.project.settings import Settings

    from ...slices.choices import SettingOf
    from ...slices.project import Setting


@dataclass(frozen=True, slots=True)
class Field:
    """A setting's field in the form."""

    label: str
    of: SettingOf
    help: str
    least: float | None = None
    most: float | None = None
    step: float | None = None
    unit: str = ""


FIELDS: dict[str, Field] = {
    "corners": Field("Corners", "corners", "Number of corners to detect in each image.", 50, 4000, 50),
    "window_px": Field("Window", "match", "Side of the correlation window.", 5, 41, 2, "px"),
    "t1": Field("T1", "match", "Minimum lead of the best correlation over the second best.", 0, 1, 0.01),
    "mutual": Field("Mutual best match", "match", "Keep a match only if each corner is the other's best match."),
    "depth_edges": Field("At depth edges", "corners", "Treatment of corners at the edge of a surface."),
    "t2_px": Field("T2", "cull", "Maximum deviation of a disparity from the median.", 1, 500, 1, "px"),
    "culling": Field("Filter", "cull", "One-sided: exactly Step 5 of the thesis."),
    "search_px": Field(
        "Search radius", "constrained", "Half the side of the search window around the prediction.", 2, 200, 1, "px"
    ),
    "constrained_t1": Field("T1", "constrained", "T1 of guided matching, with fewer candidates.", 0, 1, 0.01),
    "lines": Field("Line constraint", "lines", "Ends: with the ranges of the whole line. Equal, kappa: samples."),
    "samples_per_line": Field("Samples", "lines", "Sample points per line.", 2, 200, 1),
    "residual": Field("Residual", "simplex", "Stereo: Eq 2.21 of the thesis. Epipolar: without its singularities."),
    "start_from": Field("Starting pose", "simplex", "Starting pose of the simplex."),
    "step_m": Field(
        "Side, T", "simplex", "Side of the initial simplex; empty: a tenth of the depth.", 0.001, 10, 0.01, "m"
    ),
    "step_rad": Field("Side, angles", "simplex", "Side of the initial simplex.", 0.001, 1, 0.01, "rad"),
    "restarts": Field("Restarts", "simplex", "Restarts from other poses if the convergence is doubtful.", 0, 10, 1),
    "reject_sigma": Field("Outlier threshold", "reject", "In robust standard deviations.", 0.5, 10, 0.1, "sigma"),
    "intrinsics": Field("Camera", "robust", "Camera parameters to estimate."),
    "focal_sigma_percent": Field(
        "Focal length", "robust", "Not calibrated: standard deviation; 0: exact.", 0, 20, 0.1, "%"
    ),
    "centre_sigma_percent": Field(
        "Principal point",
        "robust",
        "Not calibrated: standard deviation about the middle; 0: exact.",
        0,
        20,
        0.1,
        "% of width",
    ),
    "k1_sigma": Field("Distortion k1", "robust", "Not calibrated: standard deviation about 0; 0: exact.", 0, 1, 0.01),
    "sigma_px": Field("Pixel noise", "robust", "Empty: estimated from the data.", 0.01, 50, 0.05, "px"),
    "sigma_range_m": Field("Range noise", "robust", "Empty: estimated from the data.", 0.0001, 1, 0.001, "m"),
    "match_tolerance_m": Field(
        "Lengths of targets",
        "robust",
        "Largest difference from the scan's range; empty: 3 sigma, 5 cm at least.",
        0.001,
        100,
        0.01,
        "m",
    ),
    "solve_automatically": Field(
        "Solve after edits", "all", "Solve and verify by itself as soon as drawn matches pause to change."
    ),
    "solve_up_to": Field("Solve up to", "all", "More matches are solved only when asked.", 4, 5000, 50, "matches"),
    "seed": Field("Random seed", "all", "Equal seeds give equal results.", 0, 2**31 - 1, 1),
}
CHOICES = {
    "foreground": "foreground",
    "left_out": "excluded",
    "one_sided": "one-sided",
    "two_sided": "two-sided",
    "ends": "line ends",
    "equal": "equal samples",
    "kappa": "kappa samples",
    "stereo": "stereo (Eq 2.21)",
    "epipolar": "epipolar (px)",
    "shown": "shown pose",
    "linear": "linear pose",
    "robust": "robust pose",
    "scanner": "scanner position",
    "auto": "automatic",
    "fixed": "fixed",
    "focal": "focal length",
    "focal_k1": "focal length and k1",
}


def check_bounds(values: Mapping[str, Any]) -> None:
    """Refuse numbers outside the bounds of a setting.

    Raises:
        OptionError: naming the setting and its bounds.
    """
    for name, value in values.items():
        field = FIELDS.get(name)
        if field is None or field.least is None or field.most is None or isinstance(value, bool):
            continue  # values that are not numbers are checked against the setting's type
        if isinstance(value, int | float) and not field.least <= value <= field.most:
            number = finite(value)
            found = "too large" if number is None else f"{number:g}"
            unit = f" {field.unit}" if field.unit else ""
            raise OptionError(f"{field.label} is {found}; it must be from {field.least:g} to {field.most:g}{unit}")


def settings_slice(settings: Settings) -> dict[str, Setting]:
    """Return the slice `settings`: every setting with its value and its field."""
    hints = get_type_hints(type(settings))
    found: dict[str, Setting] = {}
    for name, field in FIELDS.items():
        value = getattr(settings, name)
        choices = [c for c in get_args(hints[name]) if isinstance(c, str)]
        kind: Literal["number", "choice", "switch"]
        kind = "switch" if isinstance(value, bool) else "choice" if choices else "number"
        found[name] = {
            "value": value,
            "label": field.label,
            "kind": kind,
            "least": field.least,
            "most": field.most,
            "step": field.step,
            "whole": hints[name] is int,
            "empty": type(None) in get_args(hints[name]),
            "choices": [{"value": c, "label": CHOICES.get(c, c)} for c in choices],
            "unit": field.unit,
            "step_of": field.of,
            "said": field.help,
        }
    return found
