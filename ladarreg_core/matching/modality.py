"""The ladder of modalities: which of the scan's channels a photograph that is not in colour shares, by measurement.

A thermal picture shows no albedo, so laser intensity may have nothing in common with it; edges of bodies are edges of
both. What carries information is not foretold: each channel set is tried and scored against the pair's own null.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, get_args

import numpy as np

from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.matching.auto import AutoOptions, AutoResult, Reach, register_auto
from ladarreg_core.matching.pictures import Pictures
from ladarreg_core.matching.pyramid import ChannelSet
from ladarreg_core.matching.verification import GateOptions, Verification
from ladarreg_core.photo import Photo
from ladarreg_core.progress import StepLog
from ladarreg_core.scan import Scan

COARSE_GATE = GateOptions(
    contrast=2.1, many=35, few=35, few_contrast=2.1, few_fraction=0.5, fine_fraction=0.30, false_alarm=0.0
)
"""What a thermal pose must show: in fewer regions than one in colour, for the picture is small; it is called coarse."""

_SHOWN_AS: dict[ChannelSet, str] = {
    "both": "intensity and geometry together",
    "geometry": "geometry alone",
    "intensity": "intensity alone",
}
_WORTH_A_START = 0.3
_COARSE_VARIANCE = 4.5
"""A thermal pose's variance over that of the same scatter in colour, on simulated pictures: the edges of what is warm
lie beside those of what is seen, and alike all over the picture."""


@dataclass(frozen=True, slots=True)
class LadderVerification(Verification):
    """A verdict that tells which of the scan's channels it was found by."""

    channel_set: ChannelSet = "both"
    """The channels."""
    label: str = ""
    """`coarse` where the gate was that of thermal pictures."""

    def as_dict(self) -> dict[str, Any]:
        """Return the figures, JSON-ready."""
        figures = super(LadderVerification, self).as_dict()
        return {**figures, "channels": self.channel_set, **({"label": self.label} if self.label else {})}


def is_gray(photo: Photo) -> bool:
    """Return whether a photo has no colour: a thermal picture, or one of three equal channels."""
    pixels = photo.pixels
    return photo.temperature_k is not None or bool((pixels == pixels[..., :1]).all())


def register_by_modality(
    scan: Scan, photo: Photo, steps: StepLog, *, initial: Rigid | None = None, options: AutoOptions | None = None
) -> AutoResult:
    """Find the photo's pose from the pictures alone, by the channels of the scan that it shares most with.

    A colour photo is compared with intensity and geometry together, as `register_auto` does. A gray one that is
    refused so is tried with geometry and with intensity alone, before the same gate. A thermal picture is tried with
    each and judged by `COARSE_GATE`. Which sets carry information is told by the gate, with the pair's own null; of
    those that pass, the one counts that agrees best at full resolution, for its edges lie where the photo's do.

    Args:
        scan: the scan.
        photo: the photograph.
        steps: receives every step.
        initial: a rough pose to try first.
        options: thresholds and seed; a thermal picture has its own gate.
    """
    o = options or AutoOptions()
    if not is_gray(photo):
        return register_auto(scan, photo, steps, initial=initial, options=o)
    thermal = photo.temperature_k is not None
    if thermal:
        # A few soft regions fix a pose, and no lens besides.
        o = replace(o, gate=COARSE_GATE, intrinsics="fixed" if o.intrinsics == "auto" else o.intrinsics)
    found: dict[ChannelSet, AutoResult] = {}
    pictures = Pictures(scan, photo)
    start = initial
    for channel_set in get_args(ChannelSet):
        if len(found) == 2 and not any(map(_leads_somewhere, found.values())):
            break  # intensity alone has never found what neither the sum nor geometry had an inkling of
        # what one set of channels has found need only be looked at by the others
        reach: Reach = o.reach if start is initial else "near_start"
        found[channel_set] = register_auto(
            scan,
            photo,
            steps,
            initial=start,
            options=replace(o, channel_set=channel_set, reach=reach),
            pictures=pictures,
        )
        if _accepted(found[channel_set]) and not thermal:
            break
        if _leads_somewhere(found[channel_set]) and not any(
            _accepted(r) for name, r in found.items() if name != channel_set
        ):
            start = found[channel_set].camera_from_scanner
    best = max(found, key=lambda name: _score(found[name]))
    with steps.step("modality") as note:
        note.update(
            channels=best,
            accepted=[name for name, result in found.items() if _accepted(result)],
            scores={name: result.verification.as_dict() for name, result in found.items() if result.verification},
        )
        steps.pose = found[best].camera_from_scanner
    others = [result for name, result in found.items() if name != best and _accepted(result)]
    answer = _with_disagreement(found[best], others)
    return _labelled(_widened(answer, _COARSE_VARIANCE) if thermal else answer, best, thermal=thermal)


def _accepted(result: AutoResult) -> bool:
    return result.verification is not None and result.verification.accepted


def _leads_somewhere(result: AutoResult) -> bool:
    return result.verification is not None and result.verification.fraction >= _WORTH_A_START


def _with_disagreement(result: AutoResult, others: list[AutoResult]) -> AutoResult:
    """Return the result with what the other channels' poses differ by counted into its covariance.

    The channels of a soft picture are each biased in their own way, of which their windows' scatter knows nothing.
    """
    pose, evidence = result.camera_from_scanner, result.evidence
    if pose is None or evidence is None:
        return result
    covariance = np.array(evidence.covariance)
    for other in (r.camera_from_scanner for r in others):
        assert other is not None, "what was accepted has a pose"
        turn = rotvec_from_rotation(other.rotation @ pose.rotation.T)
        apart = np.concatenate([turn, other.centre - pose.centre])
        covariance += np.outer(apart, apart) / len(others)
    return replace(result, evidence=replace(evidence, covariance=covariance))


def _widened(result: AutoResult, factor: float) -> AutoResult:
    evidence = result.evidence
    if evidence is None:
        return result
    return replace(result, evidence=replace(evidence, covariance=factor * evidence.covariance))


def _score(result: AutoResult) -> tuple[bool, float, float]:
    """Return whether a result passes, then its agreement at full resolution, then how it stands out from its null."""
    verdict = result.verification
    return (False, 0.0, 0.0) if verdict is None else (verdict.accepted, verdict.fine_fraction or 0.0, verdict.contrast)


def _labelled(result: AutoResult, channel_set: ChannelSet, *, thermal: bool) -> AutoResult:
    """Return the result with the channels, and whether it is coarse, in its verdict and reasons."""
    verdict = result.verification
    if verdict is None:
        return result
    label = "coarse" if thermal else ""
    figures = {f.name: getattr(verdict, f.name) for f in fields(Verification)}
    reasons = result.reasons
    if thermal:
        kind = "Coarse" if verdict.accepted else "Not even coarsely registered"
        reasons = (*reasons, f"{kind}: a thermal picture, compared with the scan's {_SHOWN_AS[channel_set]}.")
    elif channel_set != "both":
        reasons = (*reasons, f"The photo was compared with the scan's {_SHOWN_AS[channel_set]}.")
    return replace(
        result,
        verification=LadderVerification(**figures, channel_set=channel_set, label=label),
        reasons=reasons,
    )
