"""Settings of a project, and the core options derived from them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from ladarreg_core.camera.uncertainty import DEFAULT_CAMERA_PRIOR, CameraPrior
from ladarreg_core.matching.features.corners import CornerOptions
from ladarreg_core.picks.measure import SAMPLES_PER_LINE
from ladarreg_core.pose.options import PoseOptions
from ladarreg_core.thesis.estimators.stereo_simplex import SimplexOptions
from ladarreg_core.thesis.matching.matcher import ThesisMatchOptions

if TYPE_CHECKING:
    from ladarreg_core.registration.register import RegisterOptions

_MATCHING = ThesisMatchOptions()
_SIMPLEX = SimplexOptions()


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """Settings that an operator can change; they are named like the core options that they set."""

    corners: int = _MATCHING.scan_corners.count or 0
    """Number of corners detected in each image."""
    window_px: int = _MATCHING.window_px
    """Side of the correlated windows, px."""
    t1: float = _MATCHING.t1
    """Least difference C1 - C2 of the best and second-best correlation."""
    mutual: bool = _MATCHING.mutual
    """Whether a match must be the best one of both corners (mutual best match)."""
    depth_edges: Literal["foreground", "left_out"] = _MATCHING.depth_edges
    """Treatment of corners at depth edges."""
    t2_px: float = _MATCHING.t2_px
    """Largest deviation of a disparity from the median, px."""
    culling: Literal["one_sided", "two_sided"] = _MATCHING.culling
    """Filter of disparities; one-sided is exactly Step 5 of the thesis."""
    search_px: float = _MATCHING.search_px
    """Half the side of the search area of guided matching, px."""
    constrained_t1: float = _MATCHING.constrained_t1
    """T1 of guided matching."""
    lines: Literal["ends", "equal", "kappa"] = "ends"
    """Constraint derived from a drawn line."""
    samples_per_line: int = SAMPLES_PER_LINE
    """Number of points at which a drawn line is sampled."""
    residual: Literal["stereo", "epipolar"] = "epipolar"
    """Residual that the simplex minimises: Eq 2.21, or the same geometry without its poles."""
    start_from: Literal["shown", "linear", "robust", "scanner"] = "linear"
    """Starting pose of the simplex."""
    step_m: float | None = None
    """Side of the initial simplex along T, m; None: a tenth of the depth."""
    step_rad: float = _SIMPLEX.step_rad
    """Side of the initial simplex along the angles, rad."""
    reject_sigma: float = _SIMPLEX.reject_sigma
    """Outlier threshold, in robust standard deviations."""
    restarts: int = _SIMPLEX.restarts
    """Largest number of restarts from other starting poses."""
    intrinsics: Literal["auto", "fixed", "focal", "focal_k1"] = "auto"
    """Intrinsics that are estimated together with the pose."""
    focal_sigma_percent: float = 100 * DEFAULT_CAMERA_PRIOR.focal
    """Standard deviation of the focal length of a camera that is not calibrated, %."""
    centre_sigma_percent: float = 100 * DEFAULT_CAMERA_PRIOR.centre_of_width
    """Standard deviation of the principal point of a camera that is not calibrated, % of the photo's width."""
    k1_sigma: float = DEFAULT_CAMERA_PRIOR.k1
    """Standard deviation of its distortion coefficient k1."""
    sigma_px: float | None = None
    """Pixel noise, px; None: estimated from the data."""
    sigma_range_m: float | None = None
    """Range noise, m; None: estimated from the data."""
    match_tolerance_m: float | None = None
    """Largest difference of a match's own length from the scan's range, m; None: by the range noise, 5 cm at least."""
    seed: int = 0
    """Random seed."""
    solve_automatically: bool = True
    """Whether the workbench solves and verifies after edits of the matches."""
    solve_up_to: int = 200
    """Largest number of enabled matches that are solved after edits."""

    @property
    def match_options(self) -> ThesisMatchOptions:
        """Options of the thesis's matching."""
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
        """Options of the simplex."""
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
        """Options of the robust estimator."""
        return PoseOptions(
            sigma_px=self.sigma_px,
            sigma_range_m=self.sigma_range_m,
            intrinsics=self.intrinsics,
            camera_prior=CameraPrior(
                centre_of_width=self.centre_sigma_percent / 100,
                k1=self.k1_sigma,
                focal=self.focal_sigma_percent / 100,
            ),
            simplex=self.simplex_options,
            seed=self.seed,
        )

    @property
    def register_options(self) -> RegisterOptions:
        """Options of a complete registration.

        Raises:
            OptionError: if a value is invalid.
        """
        # Imported late: opening a project needs none of these.
        from ladarreg_core.matching.auto_options import AutoOptions
        from ladarreg_core.registration.register import RegisterOptions
        from ladarreg_core.thesis.matching.chain import ThesisOptions

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
            match_tolerance_m=self.match_tolerance_m,
        )

    def changed(self, values: dict[str, Any]) -> Settings:
        """Return the settings with other values, validated like the core options.

        Raises:
            OptionError: if there is no such setting, or a value is invalid.
        """
        from ladarreg_core.errors import OptionError
        from ladarreg_core.formats.parsing.untrusted import one_line  # values are of any length

        unknown = sorted(set(values) - set(self.__struct_fields__))
        if unknown:
            raise OptionError(one_line(f"there is no setting {', '.join(map(repr, unknown))}"))
        try:
            found = msgspec.convert({**msgspec.to_builtins(self), **values}, Settings)
        except msgspec.ValidationError as error:
            raise OptionError(one_line(f"the setting is invalid: {error}")) from None
        _ = found.register_options  # validates
        return found
