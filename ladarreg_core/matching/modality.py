"""Registration of gray and thermal photos: selects the scan channels that the photo shares, by measurement.

A thermal image shows no albedo, so it may have nothing in common with laser intensity, but the edges of objects appear
in both. The informative channels are not known in advance: each channel set is tried and scored against the pair's own
null distribution.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, get_args

import numpy as np

from ladarreg_core.camera.uncertainty import DEFAULT_CAMERA_PRIOR, CameraPrior
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.matching.auto import compared_pair, register_auto
from ladarreg_core.matching.auto_options import AutoOptions, Reach
from ladarreg_core.matching.auto_result import AutoResult
from ladarreg_core.matching.images.kept_channels import Channels
from ladarreg_core.matching.images.pair import PairLevels
from ladarreg_core.matching.images.scan_levels import ChannelSet
from ladarreg_core.matching.images.support import carries_intensity, is_interpolated
from ladarreg_core.matching.verify.verification import (
    COARSE_GATE,
    Verification,
    gate_for,
)
from ladarreg_core.photo import Photo
from ladarreg_core.results.steps import StepLog
from ladarreg_core.scan import Scan

_CHANNEL_LABELS: dict[ChannelSet, str] = {
    "both": "intensity and geometry together",
    "geometry": "geometry alone",
    "intensity": "intensity alone",
}
_PROMISING_FRACTION, _SHARED_PRINT = 0.3, 0.9
_ROWS_AT_ONCE = 64
_COARSE_VARIANCE = 4.5
"""Variance factor of thermal over colour poses at the same scatter, from simulated images: thermal edges are displaced
from visible ones, in the same direction over the whole image."""


@dataclass(frozen=True, slots=True)
class ModalityVerification(Verification):
    """Verdict with the channel set that it was found with."""

    channel_set: ChannelSet = "both"
    """The channel set."""
    label: str = ""
    """`coarse` if the thresholds were those of thermal images."""

    def as_dict(self) -> dict[str, Any]:
        """Return the statistics, JSON-ready."""
        figures = super(ModalityVerification, self).as_dict()
        return {**figures, "channels": self.channel_set, **({"label": self.label} if self.label else {})}


def is_gray(photo: Photo) -> bool:
    """Return whether a photo has no colour: a thermal image, or three equal channels."""
    if photo.temperature_k is not None:
        return True
    pixels = photo.pixels
    bands = (pixels[top : top + _ROWS_AT_ONCE] for top in range(0, len(pixels), _ROWS_AT_ONCE))
    return all(bool((band == band[..., :1]).all()) for band in bands)  # a colour photo differs in its first rows


def register_by_modality(
    scan: Scan,
    photo: Photo,
    steps: StepLog,
    *,
    initial: Rigid | None = None,
    options: AutoOptions | None = None,
    prior: CameraPrior = DEFAULT_CAMERA_PRIOR,
    channels: Channels | None = None,
) -> AutoResult:
    """Find the pose of a photo from the images alone, with the scan channels that agree best with it.

    A colour photo is compared with intensity and geometry together, as in `register_auto`. If a gray photo is refused
    that way, geometry alone and intensity alone are tried with the same thresholds. A thermal image is tried with every
    channel set and verified with `COARSE_GATE`. Of the channel sets that pass, the one that agrees best at full
    resolution is used, because its edges coincide best with those of the photo. A scan whose intensity shows nothing
    is compared by geometry alone. A coarse scan with intensity is compared in the usual way, too, near the pose found.

    Args:
        scan: the scan.
        photo: the photograph.
        steps: receives every step.
        initial: an initial pose, tried first.
        options: thresholds and seed; thermal images have their own thresholds.
        prior: what is known of an assumed camera.
        channels: those that are kept for further registrations; None: only those of the scan's last view are.
    """
    o = options or AutoOptions()
    shape_alone = not carries_intensity(scan)
    pair = compared_pair(scan, photo, channels)
    coarse = pair.coarse
    interpolated = coarse and is_interpolated(scan, photo.pinhole)
    if shape_alone:
        o = replace(o, channel_set="geometry")
    if shape_alone and o.intrinsics == "auto" and (coarse or photo.calibrated):
        o = replace(o, intrinsics="fixed")  # outlines do not determine the lens
    if not is_gray(photo):
        tried = _gated(o, coarse=coarse, interpolated=interpolated)
        result = register_auto(pair, photo, steps, initial=initial, options=tried, prior=prior, channels=channels)
        if shape_alone or interpolated or not (isinstance(pair, PairLevels) and coarse):
            return result
        return _more_precise(result, pair.as_dense(), photo, steps, o, prior, channels)
    thermal = photo.temperature_k is not None
    if thermal:
        # A few blurred regions determine a pose, but not the lens as well.
        o = replace(o, gate=COARSE_GATE, intrinsics="fixed" if o.intrinsics == "auto" else o.intrinsics)
    found: dict[ChannelSet, AutoResult] = {}
    start = initial
    for channel_set in ("geometry",) if shape_alone else get_args(ChannelSet):
        if len(found) == 2 and not any(map(_is_promising, found.values())):
            break  # in no test did intensity alone find a pose when neither the sum nor geometry came near one
        # a pose found with one channel set need only be refined with the others
        reach: Reach = o.reach if start is initial else "near_start"
        tried = replace(o, channel_set=channel_set, reach=reach)
        tried = _gated(tried, coarse=coarse and not thermal, interpolated=interpolated)
        result = register_auto(pair, photo, steps, initial=start, options=tried, prior=prior, channels=channels)
        if result.accepted and not thermal:
            found[channel_set] = result
            break
        if _is_promising(result) and not any(other.accepted for other in found.values()):
            start = result.camera_from_scanner
        found[channel_set] = result
    best = max(found, key=lambda name: _score(found[name]))
    with steps.step("modality") as note:
        note.update(
            channels=best,
            accepted=[name for name, result in found.items() if result.accepted],
            scores={name: result.verification.as_dict() for name, result in found.items() if result.verification},
        )
        steps.pose = found[best].camera_from_scanner
    others = [result for name, result in found.items() if name != best and result.accepted]
    answer = _with_disagreement(found[best], others)
    if thermal:
        answer = _scaled_covariance(answer, _COARSE_VARIANCE)
    return _labelled(answer, best, thermal=thermal)


def _gated(options: AutoOptions, *, coarse: bool, interpolated: bool) -> AutoOptions:
    """Return the options with the thresholds for a coarse or an interpolated scan, if it is."""
    shape_alone = options.channel_set == "geometry"
    gate = gate_for(options.gate, coarse=coarse, shape_alone=shape_alone, interpolated=interpolated)
    return replace(options, gate=gate)


def _more_precise(
    result: AutoResult,
    as_dense: PairLevels,
    photo: Photo,
    steps: StepLog,
    options: AutoOptions,
    prior: CameraPrior,
    channels: Channels | None,
) -> AutoResult:
    """Return a coarse scan's result, or that of the usual comparison near it if nearly all regions agree there.

    Outlines are known to a cell, print more finely; where they agree in some regions only, outlines are more precise.
    """
    if not _is_promising(result):
        return result
    usual = replace(options, reach="near_start")
    start = result.camera_from_scanner
    other = register_auto(as_dense, photo, steps, initial=start, options=usual, prior=prior, channels=channels)
    return other if other.accepted and other.fraction >= _SHARED_PRINT else result


def _is_promising(result: AutoResult) -> bool:
    return result.fraction >= _PROMISING_FRACTION


def _with_disagreement(result: AutoResult, others: list[AutoResult]) -> AutoResult:
    """Return the result with the differences to the poses of other channel sets added to its covariance.

    Each channel set of a blurred image has a bias of its own, which the scatter of its windows does not show.
    """
    pose, evidence = result.camera_from_scanner, result.evidence
    if pose is None or evidence is None:
        return result
    covariance = np.array(evidence.covariance)
    for other in (r.camera_from_scanner for r in others):
        assert other is not None, "an accepted result has a pose"
        turn = rotvec_from_rotation(other.rotation @ pose.rotation.T)
        apart = np.concatenate([turn, other.centre - pose.centre])
        covariance += np.outer(apart, apart) / len(others)
    return replace(result, evidence=replace(evidence, covariance=covariance))


def _scaled_covariance(result: AutoResult, factor: float) -> AutoResult:
    evidence = result.evidence
    if evidence is None:
        return result
    return replace(result, evidence=replace(evidence, covariance=factor * evidence.covariance))


def _score(result: AutoResult) -> tuple[bool, float, float]:
    """Return the sort key of a result: accepted, agreement at full resolution, contrast."""
    verdict = result.verification
    return (False, 0.0, 0.0) if verdict is None else (verdict.accepted, verdict.fine_fraction or 0.0, verdict.contrast)


def _labelled(result: AutoResult, channel_set: ChannelSet, *, thermal: bool) -> AutoResult:
    """Return the result with the channel set and the label `coarse` in its verdict and reasons."""
    verdict = result.verification
    if verdict is None:
        return result
    label = "coarse" if thermal else ""
    figures = {f.name: getattr(verdict, f.name) for f in fields(Verification)}
    reasons = result.reasons
    if thermal:
        kind = "Coarse" if verdict.accepted else "Not even coarsely registered"
        reasons = (*reasons, f"{kind}: thermal image, compared with the scan's {_CHANNEL_LABELS[channel_set]}.")
    elif channel_set != "both":
        reasons = (*reasons, f"The photo was compared with the scan's {_CHANNEL_LABELS[channel_set]}.")
    return replace(
        result,
        verification=ModalityVerification(**figures, channel_set=channel_set, label=label),
        reasons=reasons,
    )
