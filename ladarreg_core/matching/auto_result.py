"""The result of the automatic method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ladarreg_core.camera import Camera
from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.images.blocks import BlockMatches
from ladarreg_core.matching.refine.covariance import WindowEvidence
from ladarreg_core.matching.verify.verification import Verification


@dataclass(frozen=True, slots=True, eq=False)
class AutoResult:
    """The best pose found, with its verdict and uncertainty."""

    camera_from_scanner: Rigid | None
    """The pose; None if no candidate was found."""
    verification: Verification | None
    """The verdict; None if no candidate was good enough to verify."""
    evidence: WindowEvidence | None
    """Uncertainty of the pose."""
    reasons: tuple[str, ...]
    """The verdict in sentences."""
    blocks: BlockMatches | None = None
    """Sub-pixel point matches at the pose."""
    camera: Camera | None = None
    """The camera estimated with the pose; None: as stated."""
    camera_sigmas: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of the estimated intrinsics, as in `PoseResult`."""
    camera_uncertainty: CameraUncertainty | None = None
    """Joint uncertainty of the pose and the estimated intrinsics."""
