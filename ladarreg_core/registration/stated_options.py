"""`RegisterOptions` of single values by name, as commands and lists of jobs state them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ladarreg_core.camera.uncertainty import CameraPrior
from ladarreg_core.errors import OptionError
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.thesis.matching.chain import ThesisOptions

THESIS_ONLY = ("t1", "t2_px", "culling", "first_pose", "residual", "reject_depth_m")
"""Values that the method `thesis` alone uses."""
PRIORS = ("focal_sigma_percent", "centre_sigma_percent", "k1_sigma")
"""Values that say how well the camera of a photograph without a camera file is known."""


def options_of(stated: Mapping[str, Any]) -> RegisterOptions:
    """Return the options of a registration.

    Args:
        stated: values by their names: `seed`, `intrinsics`, those of `THESIS_ONLY` and `PRIORS`, `samples_per_line`,
            `match_tolerance_m`, `proposal`; None or absent: the default. Words may have hyphens. Other names are left
            out.

    Raises:
        LadarregError: if a value is invalid.
    """

    def given(*names: str) -> dict[str, Any]:
        found = {name: stated[name] for name in names if stated.get(name) is not None}
        return {name: value.replace("-", "_") if isinstance(value, str) else value for name, value in found.items()}

    default, options = ThesisOptions(), RegisterOptions()
    prior = prior_of(stated)
    simplex = replace(default.pose.simplex, **given("reject_depth_m"))
    thesis = replace(
        default, matching=replace(default.matching, **given("t1", "t2_px", "culling")),
        pose=replace(default.pose, camera_prior=prior, simplex=simplex), **given("first_pose", "residual"),
    )  # fmt: skip
    intrinsics = given("intrinsics")
    of_images = {} if intrinsics.get("intrinsics") == "focal_k1_centre" else intrinsics
    return RegisterOptions(
        thesis=thesis, pose=replace(options.pose, camera_prior=prior, **intrinsics),
        auto=replace(options.auto, **of_images),
        **given("seed", "samples_per_line", "match_tolerance_m", "proposal"),
    )  # fmt: skip


def prior_of(stated: Mapping[str, Any]) -> CameraPrior:
    """Return what is known of a camera before its photograph is registered; arguments as of `options_of`."""
    known = {
        "centre_of_width": _of_percent(stated.get("centre_sigma_percent")),
        "k1": stated.get("k1_sigma"),
        "focal": _of_percent(stated.get("focal_sigma_percent")),
    }
    return CameraPrior(**{name: value for name, value in known.items() if value is not None})


def check_stated(stated: Mapping[str, Any], method: str) -> None:
    """Refuse values that the chosen method, or what is given beside them, does not use.

    Args:
        stated: values by their names, with `camera` and `matches`, the files, among them.
        method: of the registration.

    Raises:
        OptionError: naming the value.
    """

    def is_given(name: str) -> bool:
        return stated.get(name) is not None

    thesis = [f"`{name}`" for name in THESIS_ONLY if is_given(name)]
    if thesis and method != "thesis":
        raise OptionError(f"{', '.join(thesis)} can only be used with `method=thesis`; the method is {method}")
    if is_given("intrinsics") and method == "thesis":
        raise OptionError("`intrinsics` cannot be used with `method=thesis`, which takes the camera as calibrated")
    for name in PRIORS:
        if is_given(name) and is_given("camera"):
            raise OptionError(f"`{name}` cannot be used with `camera`: a camera file is taken as calibrated")
    if is_given("match_tolerance_m") and not is_given("matches"):
        raise OptionError("`match_tolerance_m` needs matches with lengths (`matches`)")
    if stated.get("intrinsics") == "focal-k1-centre" and not is_given("matches"):
        raise OptionError("`intrinsics=focal-k1-centre` needs manual matches (`matches`)")
    if is_given("proposal") and (not is_given("matches") or method == "thesis"):
        raise OptionError("`proposal` needs matches (`matches`), solved by the method manual")


def _of_percent(value: float | None) -> float | None:
    return None if value is None else value / 100
