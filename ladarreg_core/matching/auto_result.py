"""The result of the automatic method, and which of several poses it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from ladarreg_core.camera import Camera
from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.images.blocks import BlockMatches
from ladarreg_core.matching.refine.covariance import WindowEvidence
from ladarreg_core.matching.verify.verification import Verification

ADVICE = "Draw a few matches by hand, or give an initial pose."
"""What to do about a photograph that is not accepted."""


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

    @property
    def accepted(self) -> bool:
        """Whether the pose is verified."""
        return self.verification is not None and self.verification.accepted

    @property
    def fraction(self) -> float:
        """Fraction of the regions that agree; -1 without a verdict."""
        return -1.0 if self.verification is None else self.verification.fraction

    def refused(self, reason: str) -> AutoResult:
        """Return a verified result as refused."""
        assert self.verification is not None, "only verified poses are refused for another reason"
        reasons = (reason, ADVICE)
        return replace(self, verification=replace(self.verification, accepted=False, reasons=reasons), reasons=reasons)


class Unverified:
    """The best pose of a search that verified none: one that was finished and refused, else one not worth finishing.

    Args:
        initial: the initial pose of the search.
    """

    def __init__(self, initial: Rigid | None) -> None:
        self._initial = initial
        self._refused: AutoResult | None = None
        self._unfinished: tuple[Rigid, Verification] | None = None

    def add_refused(self, result: AutoResult) -> None:
        """Add a finished pose that was refused."""
        if self._refused is None or result.fraction > self._refused.fraction:
            self._refused = result

    def add_unfinished(self, pose: Rigid, coarse: Verification) -> None:
        """Add a pose with which too few regions agree to finish it.

        Args:
            pose: `camera_from_scanner`.
            coarse: its preliminary verdict.
        """
        if self._unfinished is None or coarse.fraction > self._unfinished[1].fraction:
            self._unfinished = pose, coarse

    @property
    def result(self) -> AutoResult:
        """The refused result."""
        if self._refused is not None:
            return self._refused
        if self._unfinished is None:
            reason = "No initial pose was found: too few features of the scan match features of the photo."
            return AutoResult(self._initial, None, None, (reason, ADVICE))
        pose, verdict = self._unfinished
        reason = f"At the best candidate pose only {verdict.fraction:.0%} of the image regions agree."
        return AutoResult(pose, verdict, None, (reason, ADVICE))
