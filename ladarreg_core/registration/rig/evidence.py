"""What pairs of a rig say of a pose: each at the pose that the others determine, and beside swapped photographs."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.verify.agreement import Agreement
from ladarreg_core.matching.wrong_poses import chance_of_gain
from ladarreg_core.registration.rig.joint import JointPairs
from ladarreg_core.registration.rig.options import FINE_NEAR_PX, MIN_PAIRS, NEAR_PX, RigOptions
from ladarreg_core.registration.rig.results import PairEvidence, PairOutcome, RigPair

ADVICE = "Add pairs of other places with near objects, accumulate longer, or give a rough initial pose."
"""What to do about a rig that is not accepted."""
_MIN_EXCHANGED = 3  # photographs of other places, mirror images included: fewer have no scatter
_MIN_BLOCKS = 8  # of a mean; refinement needs as many
_MIN_WINDOWS = 12  # regions of a pair that can be compared, else it is undecided
_MIN_SHARE = 0.2
"""Least share of the regions of a held-out pair that agree; of pairs with swapped photographs, .11 at most did."""
_OF_SWAPPED = 1.5
"""The same, relative to the largest share with the photographs of other pairs. Photographs that agree better than that
with the scan of another pair show the same place: these pairs count as one."""
_FEW_FALSE_ALARM = 0.05  # most probability that fewer than `RigOptions.few` regions agree by chance
_MIN_MOVED = 4  # blocks of things that moved: a person 6 m away


class Jury:
    """The pairs of a rig as judges of one pose.

    Photographs of other pairs, and the mirror images of all, are compared with each scan at the pose: their agreement
    is that of chance in these very places, unless both show the same place.

    Args:
        joint: the pairs in their views.
        pairs: the same, by their names.
        pose: `camera_from_scanner`.
        unfit: pairs that cannot be compared, with the reason.
        alone: whether each pair was accepted by itself.
        options: the thresholds.
    """

    def __init__(
        self,
        joint: JointPairs,
        pairs: Sequence[RigPair],
        pose: Rigid,
        *,
        unfit: Mapping[int, str],
        alone: Sequence[bool],
        options: RigOptions,
    ) -> None:
        self._joint = joint
        self._pairs = pairs
        self._unfit = unfit
        self._alone = alone
        self._options = options
        count = len(pairs)
        self._shares, self._chances = np.zeros((2, count, count))
        self._gains, self._variances = np.zeros((2, count, 2 * count))  # of photographs, then of their mirror images
        for scan in range(count):
            for photo in range(count):
                maps = self._agreement(pose, scan, photo)
                self._shares[scan, photo], self._chances[scan, photo] = _shares(maps)
                self._gains[scan, photo], self._variances[scan, photo] = _gain(maps)
                mirrored = self._agreement(pose, scan, photo, mirrored=True)
                self._gains[scan, count + photo], self._variances[scan, count + photo] = _gain(mirrored)

    def same_place(self, index: int) -> set[int]:
        """Return the other pairs that show the same place as one: their photographs agree with its scan, or its own
        photograph with their scans, about as well as what belongs together."""
        return {other for other in range(len(self._pairs)) if other != index
                and (self._is_same(index, other) or self._is_same(other, index))}  # fmt: skip

    def fitting(self) -> list[int]:
        """Return the pairs that agree with the pose; the best two if there are fewer."""
        own = np.diag(self._shares)
        found = [index for index, share in enumerate(own) if share >= _MIN_SHARE]
        return found if len(found) >= MIN_PAIRS else sorted(np.argsort(-own, kind="stable")[:MIN_PAIRS].tolist())

    def judged(self, index: int, pose: Rigid, *, on_others: bool) -> PairEvidence:
        """Return what a pair says of a pose.

        Args:
            index: the pair.
            pose: that of the other pairs.
            on_others: whether other places determine that pose; without any, the pair is undecided.
        """
        o, name, alone = self._options, self._pairs[index].name, self._alone[index]
        coarse = None if index in self._unfit else self._joint.agreement_at(pose, index, 1)
        fine = None if index in self._unfit else self._joint.agreement_at(pose, index, 0)
        if coarse is None or fine is None or coarse.windows < _MIN_WINDOWS:
            compared = 0 if coarse is None else coarse.windows
            why = self._unfit.get(index) or f"only {compared} regions of {name} can be compared with its photo there"
            return PairEvidence(name, "undecided", compared, 0, 0.0, 1.0, 1.0, 0.0, alone, why)
        others = [k for k in range(len(self._pairs)) if k != index and k not in self.same_place(index)]
        swapped = float(self._shares[index, others].max(initial=0.0))
        chance = float(self._chances[index, others].mean()) if others else 0.0
        agreeing = int(coarse.agreeing(NEAR_PX).sum())
        share = agreeing / coarse.windows
        alarm = coarse.false_alarm(NEAR_PX, least_chance=max(o.least_chance, chance))
        exchanged = self._exchange_alarm(index, others, coarse)
        fine_share = float(fine.agreeing(FINE_NEAR_PX).mean()) if fine.windows else 0.0
        least = max(_MIN_SHARE, _OF_SWAPPED * swapped)
        sentence = (
            f"{agreeing} of {coarse.windows} regions of {name} agree at the pose of the other pairs ({share:.0%})"
        )
        outcome: PairOutcome = "agrees"
        if share < least:
            outcome = "disagrees"
            sentence += f"; at least {min(least, 1):.0%} must: {self._suspicion(index)}"
        elif not on_others:
            outcome, sentence = "undecided", f"{name} shows the same place as the other pairs, which count as one"
        elif agreeing < o.few and alarm > _FEW_FALSE_ALARM:
            outcome = "undecided"
            sentence += f", which may be chance (probability {alarm:.2g})"
        return PairEvidence(
            name, outcome, coarse.windows, agreeing, fine_share, alarm, exchanged, swapped, alone, sentence
        )

    def judged_by_moved(self, index: int, pose: Rigid) -> PairEvidence:
        """Return what a pair says of a pose where all others show the same place: by the things that moved alone.

        A false agreement of the place would be found in all of its pictures; but what stands somewhere else in each of
        them was fitted in none of the others.

        Args:
            index: the pair.
            pose: that of the other pairs.
        """
        o, name, whole = self._options, self._pairs[index].name, self.judged(index, pose, on_others=False)
        others = sorted(self.same_place(index))
        if whole.outcome != "undecided" or whole.windows < _MIN_WINDOWS or not others:
            return whole
        masks = self._joint.moved(pose, index, others)

        def maps(level: int, photo: int, *, mirrored: bool = False) -> Agreement | None:
            return self._joint.agreement_of(pose, index, level, masks[level], photo=photo, mirrored=mirrored)

        coarse, fine = maps(1, index), maps(0, index)
        count = 0 if coarse is None else len(coarse.block_maps)
        if coarse is None or fine is None or count < _MIN_MOVED:
            return replace(whole, sentence=f"{whole.sentence}, and too little moved between them")
        exchanged = [maps(1, k) for k in others] + [maps(1, k, mirrored=True) for k in (index, *others)]
        shares = [_block_share(each) for each in exchanged]
        share, agreeing = _block_share(coarse), coarse.agreeing_blocks(NEAR_PX)
        swapped = max(shares[: len(others)])
        alarm = coarse.false_alarm(NEAR_PX, least_chance=max(o.least_chance, float(np.mean(shares))))
        gains, variances = np.array([_gain(each, _MIN_MOVED) for each in exchanged]).T
        known = np.isfinite(gains)
        exchange_alarm = 1.0
        if known.sum() >= _MIN_EXCHANGED:
            exchange_alarm = chance_of_gain(
                _gain(coarse, _MIN_MOVED)[0], gains[known], least_variance=float(variances[known].mean())
            )  # fmt: skip
        least = max(_MIN_SHARE, _OF_SWAPPED * swapped)
        sentence = (
            f"{agreeing} of {count} regions of what moved in {name} agree at the pose of the other pairs ({share:.0%})"
        )
        outcome: PairOutcome = "agrees"
        if share < least or (agreeing < o.few and min(alarm, exchange_alarm) > _FEW_FALSE_ALARM):
            outcome = "undecided"
            sentence += ", which may be chance"
        fine_blocks = max(len(fine.block_maps), 1)
        return PairEvidence(
            name, outcome, count, agreeing, fine.agreeing_blocks(FINE_NEAR_PX) / fine_blocks, alarm, exchange_alarm,
            swapped, self._alone[index], sentence,
        )  # fmt: skip

    def _exchange_alarm(self, index: int, others: Sequence[int], own: Agreement) -> float:
        """Return the probability that a photograph of another place correlates as well with a scan as its own does.

        Mirror images of all photographs are of other places, too: with the same horizon, verticals and texture.
        """
        count = len(self._pairs)
        others = [*others, *range(count, 2 * count)]
        gain, _ = _gain(own)
        known = np.isfinite(self._gains[index, others])
        if known.sum() < _MIN_EXCHANGED or not np.isfinite(gain):
            return 1.0
        gains, variances = self._gains[index, others][known], self._variances[index, others][known]
        return chance_of_gain(gain, gains, least_variance=float(variances.mean()))

    def _is_same(self, scan: int, photo: int) -> bool:
        share, own = self._shares[scan, photo], self._shares[scan, scan]
        return bool(share >= _MIN_SHARE and share * _OF_SWAPPED >= own >= _MIN_SHARE)

    def _suspicion(self, index: int) -> str:
        """Return why a pair may disagree."""
        shares = self._shares[index].copy()
        shares[index] = 0.0
        best = int(np.argmax(shares))
        if shares[best] >= _MIN_SHARE:
            return f"the photo of {self._pairs[best].name} agrees with its scan, so that photos may be swapped"
        return "its scan and photo do not belong together, or the camera was moved"

    def _agreement(self, pose: Rigid, scan: int, photo: int, *, mirrored: bool = False) -> Agreement | None:
        """Return the agreement of a scan with a photograph, or its mirror image, at the pose; None if they cannot be
        compared."""
        if scan in self._unfit or self._pairs[scan].photo.camera != self._pairs[photo].photo.camera:
            return None
        if scan == photo and not mirrored:
            return self._joint.agreement_at(pose, scan, 1)
        return self._joint.swapped_agreement(pose, scan, photo, mirrored=mirrored)


def _shares(maps: Agreement | None) -> tuple[float, float]:
    """Return the shares of regions and of single blocks that agree; 0 without any."""
    if maps is None or not maps.windows:
        return 0.0, 0.0
    return float(maps.agreeing(NEAR_PX).mean()), _block_share(maps)


def _block_share(maps: Agreement | None) -> float:
    """Return the share of single blocks that agree; 0 without any."""
    return 0.0 if maps is None else maps.agreeing_blocks(NEAR_PX) / max(len(maps.block_maps), 1)


def _gain(maps: Agreement | None, least: int = _MIN_BLOCKS) -> tuple[float, float]:
    """Return the mean gain of the blocks, and its variance; NaN for few."""
    if maps is None or len(maps.block_maps) < least:
        return np.nan, np.nan
    gains = maps.gains()
    return float(gains.mean()), float(gains.var(ddof=1) / len(gains))


def held_out(
    joint: JointPairs, jury: Jury, pose: Rigid, members: Sequence[int], count: int
) -> tuple[list[PairEvidence], list[Rigid]]:
    """Return the evidence of each pair at the pose of the other places, and the poses without each member.

    Args:
        joint: the pairs in their views.
        jury: the same as judges.
        pose: solved from the members.
        members: indices of the pairs that it was solved from.
        count: number of pairs.
    """
    evidence, without = [], []
    for index in range(count):
        others = [member for member in members if member != index and member not in jury.same_place(index)]
        where, elsewhere = pose, bool(others)
        if not others:
            others = [member for member in members if member != index]
        if index in members and others:
            where = joint.finish(joint.refine(pose, others, (1,)) or pose, others)
            without.append(where)
        evidence.append(jury.judged(index, where, on_others=True) if elsewhere else jury.judged_by_moved(index, where))
    return evidence, without


def joint_alarm(evidence: Collection[PairEvidence], options: RigOptions) -> float:
    """Return the probability that the pairs agree so well by chance, without the pair that agrees best.

    A pose may have been proposed by one pair and be fitted to its images; what the others say of it is evidence. Pairs
    that could not be judged say nothing. The number of regions that agree, and their correlation beside photographs of
    other places, are two measures, of which the more telling one counts; that there are two is paid for.

    Source: Fisher's method of combining probabilities; Bonferroni (1936).
    """
    judged = [one for one in evidence if one.outcome != "undecided"]
    measures = ([one.false_alarm for one in judged], [one.exchange_alarm for one in judged])
    return min(1.0, len(measures) * min(_combined(sorted(each)[1:]) for each in measures))


def _combined(others: Sequence[float]) -> float:
    """Return the probability of independent ones together; 1 without any."""
    if not others:
        return 1.0
    half = -float(np.sum(np.log(np.maximum(others, 1e-300))))
    if half <= 0:
        return 1.0
    terms = np.cumsum([0.0, *(np.log(half) - np.log(np.arange(1, len(others))))])
    return min(1.0, float(np.exp(np.logaddexp.reduce(terms) - half)))


def reasons_against(
    evidence: Sequence[PairEvidence], alarm: float, covariance: FloatArray, options: RigOptions, *, has_rival: bool
) -> tuple[str, ...]:
    """Return what speaks against accepting a pose; empty if nothing does."""
    agreeing = [one for one in evidence if one.outcome == "agrees"]
    disagreeing = [one for one in evidence if one.outcome == "disagrees"]
    windows = sum(one.windows for one in agreeing)
    fine = sum(one.fine_fraction * one.windows for one in agreeing) / max(windows, 1)
    if len(agreeing) < MIN_PAIRS or len(agreeing) <= len(disagreeing):
        reason = (
            f"{len(agreeing)} of {len(evidence)} pairs agree on one pose, and {len(disagreeing)} disagree; at least "
            f"{MIN_PAIRS}, and more than disagree, must."
        )
    elif alarm > options.false_alarm:
        reason = (
            f"The pairs that were held out agree too weakly: the probability of that by chance is {alarm:.1g}; at most "
            f"{options.false_alarm:.0g} is needed."
        )
    elif fine < options.fine_fraction:
        reason = f"At full resolution only {fine:.0%} of the regions agree; at least {options.fine_fraction:.0%} must."
    elif has_rival:
        reason = "Another pose explains the pairs as well."
    elif not np.isfinite(covariance).all():
        reason = "Too few regions of the pairs can be compared to say how well the pose is known."
    else:
        return ()
    return reason, ADVICE
