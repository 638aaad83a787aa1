"""The thesis's thresholds as flags, and the options that they make."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from .inputs import InputArguments

if TYPE_CHECKING:
    from ladarreg_core.registration import RegisterOptions


@dataclass(frozen=True, kw_only=True)
class ThresholdArguments(InputArguments):
    """What is read, and the thesis's thresholds; a flag that is not given leaves the default."""

    t1: Annotated[float | None, tyro.conf.arg(metavar="C")] = None
    """Thesis: the best correlation must beat the second best by this (.2)."""
    t2_px: Annotated[float | None, tyro.conf.arg(metavar="PX")] = None
    """Thesis: largest deviation of a disparity from the median (20)."""
    culling: Literal["two-sided", "one-sided"] | None = None
    """Thesis: cull by either side, or by its Step 5 to the letter."""
    first_pose: Literal["linear", "robust", "linear-only"] | None = None
    """Thesis: what constrains the second search."""
    residual: Literal["epipolar", "stereo"] | None = None
    """Thesis: what the simplex minimises; stereo is its Eq 2.21."""
    reject_depth_m: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Thesis: a match with a larger stereo depth error is an outlier; else from the data."""
    samples_per_line: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Thesis: points along each line drawn by hand (9)."""
    intrinsics: Literal["auto", "fixed", "focal", "focal-k1", "focal-k1-centre"] | None = None
    """What of the camera is estimated too; auto: what the picture, or matches held out of the fit, ask for."""


_OF_THESIS = ("t1", "t2_px", "culling", "first_pose", "residual", "reject_depth_m")


def check_method(arguments: ThresholdArguments, method: str) -> None:
    """Refuse a threshold of the thesis where another method would not look at it.

    Raises:
        OptionError: naming the flag.
    """
    from ladarreg_core.errors import OptionError

    given = [f"--{name.replace('_', '-')}" for name in _OF_THESIS if getattr(arguments, name) is not None]
    if given and method != "thesis":
        raise OptionError(f"{', '.join(given)} means something to --method thesis only; the method is {method}")
    if arguments.intrinsics is not None and method == "thesis":
        raise OptionError("--intrinsics means nothing to --method thesis, which takes its camera as calibrated")
    if arguments.intrinsics == "focal-k1-centre" and arguments.matches is None:
        raise OptionError("--intrinsics focal-k1-centre needs drawn matches (--matches)")


def register_options(arguments: ThresholdArguments) -> RegisterOptions:
    """Return the options of a registration."""
    from dataclasses import replace

    from ladarreg_core.matching.thesis.chain import ThesisOptions
    from ladarreg_core.registration import RegisterOptions

    default = ThesisOptions()
    side = _name(arguments.culling)
    thesis = replace(
        default,
        matching=replace(default.matching, **_given(t1=arguments.t1, t2_px=arguments.t2_px, culling=side)),
        pose=replace(
            default.pose, simplex=replace(default.pose.simplex, **_given(reject_depth_m=arguments.reject_depth_m))
        ),
        **_given(first_pose=_name(arguments.first_pose), residual=arguments.residual),
    )
    free = _name(arguments.intrinsics)
    options = RegisterOptions()
    pose = replace(options.pose, **_given(intrinsics=free))
    auto = options.auto if free == "focal_k1_centre" else replace(options.auto, **_given(intrinsics=free))
    return RegisterOptions(
        seed=arguments.seed, thesis=thesis, pose=pose, auto=auto, **_given(samples_per_line=arguments.samples_per_line)
    )


def _given(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _name(flag: str | None) -> str | None:
    return flag.replace("-", "_") if flag else None
