"""The thresholds and choices that an operator may set, and the core's options that they make."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from ladarreg_core.features.corners import CornerOptions
from ladarreg_core.matching.thesis.matcher import ThesisMatchOptions
from ladarreg_core.picks.measure import SAMPLES_PER_LINE
from ladarreg_core.pose.options import PoseOptions
from ladarreg_core.pose.thesis.stereo_simplex import SimplexOptions

if TYPE_CHECKING:
    from ladarreg_core.registration import RegisterOptions

_MATCHING = ThesisMatchOptions()
_SIMPLEX = SimplexOptions()


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """What the options of the core start from; a name means what it means there."""

    corners: int = _MATCHING.scan_corners.count or 0
    """Corners looked for in each picture."""
    window_px: int = _MATCHING.window_px
    """Side of the correlated neighbourhoods."""
    t1: float = _MATCHING.t1
    """C1 - C2 must exceed it."""
    mutual: bool = _MATCHING.mutual
    """Whether a corner must be the best of its partner, too."""
    depth_edges: Literal["foreground", "left_out"] = _MATCHING.depth_edges
    """What becomes of corners at depth edges."""
    t2_px: float = _MATCHING.t2_px
    """Largest deviation of a disparity from the median."""
    culling: Literal["one_sided", "two_sided"] = _MATCHING.culling
    """One-sided is the thesis's Step 5 to the letter."""
    search_px: float = _MATCHING.search_px
    """Half the side of the window of the second search."""
    constrained_t1: float = _MATCHING.constrained_t1
    """T1 of the second search."""
    lines: Literal["ends", "equal", "kappa"] = "ends"
    """What of a drawn line is used."""
    samples_per_line: int = SAMPLES_PER_LINE
    """Points along a drawn line where it is sampled."""
    residual: Literal["stereo", "epipolar"] = "epipolar"
    """What the simplex minimises: Eq 2.21, or the same geometry without its poles."""
    start_from: Literal["shown", "linear", "robust", "scanner"] = "linear"
    """Where the simplex starts."""
    step_m: float | None = None
    """Side of the start simplex along T, m; None: a tenth of the depth."""
    step_rad: float = _SIMPLEX.step_rad
    """Side of the start simplex along the angles, rad."""
    reject_sigma: float = _SIMPLEX.reject_sigma
    """Outliers lie beyond so many robust standard deviations."""
    restarts: int = _SIMPLEX.restarts
    """Starts elsewhere, at most."""
    intrinsics: Literal["auto", "fixed", "focal", "focal_k1"] = "auto"
    """What of the camera may be estimated too."""
    sigma_px: float | None = None
    """Pixel noise; None: from the data."""
    sigma_range_m: float | None = None
    """Range noise, m; None: from the data."""
    seed: int = 0
    """Of every draw."""

    @property
    def match_options(self) -> ThesisMatchOptions:
        """Those of the thesis's matching."""
        corners = CornerOptions(count=self.corners or None)
        return replace(
            _MATCHING,
            scan_corners=corners,
            photo_corners=corners,
            window_px=self.window_px,
            t1=self.t1,
            mutual=self.mutual,
            depth_edges=self.depth_edges,
            t2_px=self.t2_px,
            culling=self.culling,
            search_px=self.search_px,
            constrained_t1=self.constrained_t1,
        )

    @property
    def simplex_options(self) -> SimplexOptions:
        """Those of the simplex."""
        return replace(
            _SIMPLEX,
            residual=self.residual,
            step_m=self.step_m,
            step_rad=self.step_rad,
            reject_sigma=self.reject_sigma,
            restarts=self.restarts,
        )

    @property
    def pose_options(self) -> PoseOptions:
        """Those of the robust estimator."""
        return PoseOptions(
            sigma_px=self.sigma_px,
            sigma_range_m=self.sigma_range_m,
            intrinsics=self.intrinsics,
            simplex=self.simplex_options,
            seed=self.seed,
        )

    @property
    def register_options(self) -> RegisterOptions:
        """Those of a whole registration.

        Raises:
            OptionError: if a value has no meaning.
        """
        # What only opens a project waits for none of these.
        from ladarreg_core.matching.auto import AutoOptions
        from ladarreg_core.matching.thesis.chain import ThesisOptions
        from ladarreg_core.registration import RegisterOptions

        pose = self.pose_options
        return RegisterOptions(
            seed=self.seed,
            auto=AutoOptions(seed=self.seed, intrinsics=self.intrinsics),
            pose=pose,
            thesis=ThesisOptions(
                matching=self.match_options, residual=self.residual, pose=replace(pose, intrinsics="fixed")
            ),
            lines=self.lines,
            samples_per_line=self.samples_per_line,
        )

    def changed(self, values: dict[str, Any]) -> Settings:
        """Return the settings with other values, checked as the core checks its options.

        Raises:
            OptionError: if there is no such setting, or a value has no meaning.
        """
        from ladarreg_core.errors import OptionError

        unknown = sorted(set(values) - set(self.__struct_fields__))
        if unknown:
            raise OptionError(f"there is no setting {', '.join(map(repr, unknown))}")
        try:
            found = msgspec.convert({**msgspec.to_builtins(self), **values}, Settings)
        except msgspec.ValidationError as error:
            raise OptionError(f"the setting has no meaning: {error}") from None
        _ = found.register_options  # they check themselves
        return found
