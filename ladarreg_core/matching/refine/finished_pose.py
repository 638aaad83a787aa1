"""A finished pose with its camera, as stated or estimated with it, and what is known of both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.camera.uncertainty import INTRINSICS, CameraUncertainty
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.refine.aligner import Aligner
from ladarreg_core.matching.refine.covariance import RegionEvidence
from ladarreg_core.matching.verify.agreement import Agreement
from ladarreg_core.matching.verify.verification import Verification

_DETERMINED_SHARE = 0.5  # most standard deviation, relative to the prior, of what the images determine


@dataclass(frozen=True, slots=True, eq=False)
class FinishedPose:
    """A finished pose with its camera, verified on the photo undistorted with that camera."""

    aligner: Aligner
    """The aligner of that camera."""
    camera: Camera
    """The photo's own camera, as stated or estimated."""
    camera_from_scanner: Rigid
    """The pose."""
    verification: Verification
    """The verdict."""
    fine: Agreement
    """Agreement at level 0."""
    regions: RegionEvidence | None
    """Covariance of pose and intrinsics."""
    free: int = 0
    """Number of (log f, k1, centre x, centre y) estimated."""
    camera_fits: bool | None = None
    """Whether a few further steps with a free camera confirm the stated one; None: not tried."""
    prior: Mapping[str, float] | None = None
    """Standard deviations of an assumed camera before, by name, of those that were not freed; None: no prior."""
    contradiction: str = ""
    """What the regions say against a calibrated camera; empty: nothing."""

    def covariance(self) -> FloatArray | None:
        """Return (6 + K, 6 + K) of (w, c) and the estimated intrinsics (log f, 1, px, px); None: too few regions."""
        if self.regions is None:
            return None
        to_px = np.ones(6 + self.free)
        to_px[8:] = [self.camera.fx, self.camera.fy][: max(0, self.free - 2)]
        return self.regions.joint_covariance(self.aligner.common_variance) * np.outer(to_px, to_px)

    @property
    def camera_sigmas(self) -> dict[str, float]:
        """Standard deviations of the estimated intrinsics, by name."""
        covariance = self.covariance()
        if not self.free or covariance is None:
            return {}
        sigma = np.sqrt(np.diag(covariance)[6:]) * ([self.camera.focal_px, 1.0, 1.0, 1.0][: self.free])
        return dict(zip(INTRINSICS, sigma.tolist(), strict=False))

    def camera_uncertainty(self, stated: Camera) -> CameraUncertainty | None:
        """Return the joint uncertainty of pose and estimated camera; None if the camera was not estimated."""
        covariance = self.covariance()
        if not self.free or covariance is None:
            return None
        covariance[6] *= self.camera.focal_px
        covariance[:, 6] *= self.camera.focal_px
        names = INTRINSICS[: self.free]
        prior = dict(self.prior or {})
        values = dict(zip(INTRINSICS, (stated.focal_px, k1_of(stated), stated.cx, stated.cy), strict=True))
        found = dict(
            zip(INTRINSICS, (self.camera.focal_px, k1_of(self.camera), self.camera.cx, self.camera.cy), strict=True)
        )
        sigmas = dict(zip(names, np.sqrt(np.diag(covariance)[6:]).tolist(), strict=True))
        off: dict[str, float] = {}
        off_sigma: dict[str, float] = {}
        for name in ("cx", "cy"):
            if name in names:
                share, off_sigma_px = share_of_images(sigmas[name], prior.get(name, np.inf))
                off[name], off_sigma[name] = (found[name] - values[name]) / share, off_sigma_px
        freed = () if self.prior is None else tuple(name for name in names if name not in prior)
        stated_values = {name: values[name] for name in names}
        return CameraUncertainty(names, covariance, stated_values, prior, freed, off, off_sigma)

    def summary(self, given: Camera) -> tuple[str, ...]:
        """Return a sentence for each intrinsic that the images determine, with its stated value."""
        sentences = []
        for name, sigma in self.camera_sigmas.items():
            known = (self.prior or {}).get(name, np.inf)
            if name in ("cx", "cy") or sigma > _DETERMINED_SHARE * known:
                continue
            if name == "k1":
                sentences.append(
                    f"Lens distortion k1 was estimated: {k1_of(self.camera):.3f} +- {sigma:.3f} instead of "
                    f"{k1_of(given):.3f}."
                )
            else:
                sentences.append(
                    f"The focal length was estimated: {self.camera.focal_px:.1f} +- {sigma:.1f} px instead of "
                    f"{given.focal_px:.1f} px."
                )
        return tuple(sentences)


def share_of_images(after: float, before: float) -> tuple[float, float]:
    """Return the share of an estimate that comes from the images, and its standard deviation from these alone."""
    share = 1.0 if np.isinf(before) else max(1 - (after / before) ** 2, 1e-3)
    return share, after / float(np.sqrt(share))


def k1_of(camera: Camera) -> float:
    """Return the first radial distortion coefficient; 0 for a camera without distortion."""
    return camera.distortion[0] if camera.distortion else 0.0
