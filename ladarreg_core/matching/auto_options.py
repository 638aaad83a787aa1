"""Options of the automatic method."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from ladarreg_core.camera.uncertainty import CALIBRATED_CAMERA_PRIOR, CameraPrior
from ladarreg_core.foundations.validation import require_choice
from ladarreg_core.matching.images.scan_levels import ChannelSet
from ladarreg_core.matching.refine.self_calibration import FreeCamera, check_free_camera
from ladarreg_core.matching.verify.verification import GateOptions

Reach = Literal["everywhere", "near_start"]


@dataclass(frozen=True, slots=True)
class AutoOptions:
    """Options of the automatic method."""

    seed: int = 0
    """Random seed; equal seeds give equal results."""
    good_fraction: float = 0.6
    """A candidate with at least this fraction of agreeing regions ends the search, if it is verified."""
    least_fraction: float = 0.35
    """A candidate with a smaller fraction of agreeing regions is not finished."""
    gate: GateOptions = field(default_factory=GateOptions)
    """Thresholds of image verification."""
    intrinsics: FreeCamera = "auto"
    """Intrinsics that may be estimated with the pose."""
    calibrated_prior: CameraPrior = CALIBRATED_CAMERA_PRIOR
    """Standard deviations of a calibrated camera whose file states none; those of an assumed one are
    `PoseOptions.camera_prior`."""
    channel_set: ChannelSet = "both"
    """Channels of the scan that the photo is compared with."""
    reach: Reach = "everywhere"
    """Extent of the search; `near_start` needs an initial pose and takes a fraction of the time."""

    def __post_init__(self) -> None:
        check_free_camera(self.intrinsics)
        require_choice(self.reach, get_args(Reach), "the reach")
