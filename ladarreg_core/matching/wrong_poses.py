"""What a pair shows at poses that are wrong: the null distribution of its verdict, measured on the pair itself.

The thresholds of `GateOptions` are those of any pair, so that they ask for many regions. How well a photo of this kind
agrees with a scan of this kind by chance is measured instead: the camera is turned away from the candidate, farther
than refinement leads back, and the photo is exchanged for its mirror image, which has the same horizon, verticals and
texture but belongs to no place. Refinement then does there what it did for the candidate.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.parallel import side_by_side
from ladarreg_core.frames import Rigid, rotation_about
from ladarreg_core.matching.images.photo_levels import PhotoLevels
from ladarreg_core.matching.refine.aligner import Aligner
from ladarreg_core.matching.verify.agreement import Agreement
from ladarreg_core.matching.verify.verification import Verification, beside_wrong_poses, rests_on_number

TURNED, MIRRORED = 12, 12
"""Number of wrong poses in the photo and in its mirror image."""
_NEAREST_TURN, _FARTHEST_TURN = 0.10, 0.20  # image shift, as a share of the photo's width
_MIRRORED_REACH, _MIRRORED_TILT = 0.30, 0.02  # the horizon stays where it is: as likely a false agreement as there is
_SAME_PX = 20.0  # working pixels; an end nearer to the candidate says nothing about wrong poses
_MIN_BLOCKS = 8
_MIN_POSES = 16
_SAMPLES = 500
_SAME_VIEW_RAD = np.radians(6.0)  # within it, wrong poses of one candidate are those of another: a tenth of the photo


@dataclass(frozen=True, slots=True, eq=False)
class WrongPoses:
    """Gains (K,) of correlation at refined wrong poses of a pair; see `correlation_gain`."""

    gains: FloatArray
    """(K,)."""
    ends: tuple[Rigid | None, ...] = ()
    """Where these are, K of them; None: in the mirror image."""
    about: Rigid | None = None
    """The pose they were turned away from."""

    @property
    def enough(self) -> bool:
        """Whether there are enough of them to measure a distribution."""
        return len(self.gains) >= _MIN_POSES

    @property
    def highest(self) -> float:
        """The highest gain, at least 0; 0 without poses."""
        return max(0.0, float(self.gains.max(initial=0.0)))

    def false_alarm(self, gain: float, *, tried: int) -> float:
        """Return a bound on the probability that the best of some wrong poses gains so much; 1 if it is not measured.

        The bound on the best of several is the sum of their probabilities.

        Args:
            gain: of the pose to be judged.
            tried: number of poses of which it is the best.

        Source: Bonferroni (1936).
        """
        if not self.enough:
            return 1.0
        return min(1.0, max(1, tried) * chance_of_gain(gain, self.gains))


def chance_of_gain(gain: float, others: FloatArray, *, least_variance: float = 0.0) -> float:
    """Return the probability that a further wrong pose or photo has as high a gain, given those of some.

    A gain is the mean over many blocks, so that it is nearly normal: a further one exceeds the mean of K others by
    their standard deviation times Student's t.

    Args:
        gain: the gain to be judged.
        others: (K,) of wrong poses or photos, at least two.
        least_variance: least variance of the others, since a few may be alike by chance.

    Source: Geisser, Predictive inference (1993), for the prediction of a further observation.
    """
    from scipy.special import stdtr

    count = len(others)
    spread = float(np.sqrt(max(float(others.var(ddof=1)), least_variance) * (1 + 1 / count)))
    return float(stdtr(count - 1, -(gain - others.mean()) / spread)) if spread > 0 else 1.0


def wrong_poses_decide(verdict: Verification, aligner: Aligner) -> bool:
    """Return whether wrong poses decide on a finished pose: its scan is coarse, and it lacks agreeing regions alone."""
    return aligner.scan.coarse and aligner.gate.own_false_alarm > 0 and rests_on_number(verdict, aligner.gate)


def verdict_beside_wrong_poses(
    verdict: Verification,
    fine: Agreement,
    aligner: Aligner,
    pose: Rigid,
    *,
    tried: int,
    known: WrongPoses | None = None,
) -> tuple[Verification, WrongPoses]:
    """Return the verdict on a finished pose on which wrong poses decide, and these.

    Args:
        verdict: of `verify`.
        fine: agreement at level 0.
        aligner: the pair that the pose was found with.
        pose: `camera_from_scanner`.
        tried: number of poses of which it is the best.
        known: wrong poses of the pair, of an earlier candidate; used if it looked about where this one does.
    """
    if known is None or known.about is None or known.about.angle_to(pose) > _SAME_VIEW_RAD:
        known = wrong_poses(aligner, pose)
    apart = [end is None or _apart_px(aligner, pose, end) >= _SAME_PX for end in known.ends]
    wrong, gain = WrongPoses(known.gains[apart]), correlation_gain(fine)
    if not (wrong.enough and gain > 0):
        return verdict, known
    judged = beside_wrong_poses(
        verdict,
        false_alarm=wrong.false_alarm(gain, tried=tried),
        highest=wrong.highest / gain,
        count=len(wrong.gains),
        options=aligner.gate,
    )
    return judged, known


def correlation_gain(fine: Agreement) -> float:
    """Return the mean gain of the blocks; 0 without any.

    Args:
        fine: agreement at level 0. Wrong poses that follow an outline or the horizon agree at the coarser level.
    """
    return float(fine.gains().mean()) if len(fine.block_maps) else 0.0


def wrong_poses(aligner: Aligner, pose: Rigid) -> WrongPoses:
    """Return what the pair shows at wrong poses around a finished one, using two threads.

    Args:
        aligner: the pair that the pose was found with.
        pose: `camera_from_scanner`, finished.
    """
    mirror = Aligner(aligner.scan, mirrored_photo(aligner.photo), gate=aligner.gate, seed=aligner.seed)
    for side in (aligner, mirror):  # before two threads ask for it
        side.prepare_to_verify(pose)
        _ = side.fine_points, side.fine_target, [target.squares for target in side.targets.values()]
    starts = [(aligner, start) for start in _turned(aligner, pose)]
    starts += [(mirror, start) for start in _turned_level(mirror, pose)]
    found = [one for one in side_by_side(partial(_gain_from, pose=pose, own=aligner), starts) if one is not None]
    return WrongPoses(np.array([gain for gain, _ in found]), tuple(end for _, end in found), pose)


def mirrored_photo(photo: PhotoLevels) -> PhotoLevels:
    """Return the levels of a photo's mirror image, left and right exchanged, as its mirrored camera would see it."""
    return replace(
        photo,
        cameras=tuple(replace(camera, cx=camera.width - 1 - camera.cx) for camera in photo.cameras),
        planes=tuple([np.ascontiguousarray(plane[:, ::-1]) for plane in planes] for planes in photo.planes),
        usable=tuple(np.ascontiguousarray(mask[:, ::-1]) for mask in photo.usable),
    )


def _gain_from(start: tuple[Aligner, Rigid], *, pose: Rigid, own: Aligner) -> tuple[float, Rigid | None] | None:
    """Return the gain where refinement from a start ends, and that pose, None if in the mirror image; None if it
    fails, or leads back to the candidate."""
    aligner, first = start
    candidate = aligner.refine(first)
    if candidate is None:
        return None
    end = aligner.finish(candidate.camera_from_scanner)
    if aligner is own and _apart_px(aligner, pose, end) < _SAME_PX:
        return None
    fine = aligner.agreement_at(end, 0)
    if len(fine.block_maps) < _MIN_BLOCKS:
        return None
    return correlation_gain(fine), end if aligner is own else None


def _apart_px(aligner: Aligner, first: Rigid, second: Rigid) -> float:
    camera, points = aligner.photo.cameras[0], aligner.verification_points.points
    points = points[:: max(1, len(points) // _SAMPLES)].astype(np.float64)
    off = np.hypot(*(camera.project(first @ points) - camera.project(second @ points)).T)
    known = np.isfinite(off)
    return float(np.median(off[known])) if known.any() else np.inf


def _turned(aligner: Aligner, pose: Rigid) -> Iterator[Rigid]:
    """Yield poses whose image is shifted in all directions, farther than refinement leads back."""
    for k, angle in enumerate((np.arange(TURNED) + 0.5) * (2 * np.pi / TURNED)):
        share = _NEAREST_TURN + (_FARTHEST_TURN - _NEAREST_TURN) * (7 * k % TURNED) / TURNED
        yield _shifted(aligner, pose, share * np.cos(angle), share * np.sin(angle))


def _turned_level(aligner: Aligner, pose: Rigid) -> Iterator[Rigid]:
    """Yield poses whose image is shifted along the photo's rows."""
    for k, along in enumerate((np.arange(MIRRORED) + 0.5) * (2 / MIRRORED) - 1):
        yield _shifted(aligner, pose, _MIRRORED_REACH * along, _MIRRORED_TILT * (k % 3 - 1))


def _shifted(aligner: Aligner, pose: Rigid, right: float, down: float) -> Rigid:
    """Return a pose turned so that its image is shifted by shares of the photo's width."""
    camera = aligner.photo.cameras[0]
    turn = rotation_about("y", np.arctan2(right * camera.width, camera.fx)) @ rotation_about(
        "x", -np.arctan2(down * camera.width, camera.fx)
    )
    return Rigid(turn, np.zeros(3)) @ pose
