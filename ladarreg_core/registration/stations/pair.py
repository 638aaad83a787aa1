"""Two scans registered to each other, from nothing or from a rough pose, with a verdict on the outcome."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.alignment.adjustment import RangeView, adjust, off_planes, planes_of
from ladarreg_core.acquisition.alignment.voxel_planes import VOXELS_M
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.foundations.formatting import format_angle, format_length
from ladarreg_core.frames import Rigid, describe_direction, skew
from ladarreg_core.registration.stations.evidence import Print, Seen, compared_print, seen
from ladarreg_core.registration.stations.icp import Target, aligned
from ladarreg_core.registration.stations.results import PairEvidence, PairVerdict, StatedPose, StationPair
from ladarreg_core.registration.stations.search import Hypothesis, View, apart, differ, search
from ladarreg_core.registration.stations.sight import range_picture
from ladarreg_core.registration.stations.surfels import surfels_of
from ladarreg_core.registration.stations.uncertainty import polish
from ladarreg_core.scan import Scan

_HYPOTHESES = 24  # placements of the search that are aligned
_ALIGNED_POINTS = 1500
_GATES = ((0.06, 4.0), (0.02, 2.0))  # m and deg
_HELD_OUT = 4  # of so many blocks of the room one
_FIXED = 1e10  # information of a pose that does not move, 1/rad^2 and 1/m^2
_HOPELESS = 4  # times worse than the limit: not worth a refinement
_WORTH_A_SECOND_LOOK = 10  # times worse: different rooms mostly are by more
_NEAR_M = 1.0  # what lies farther from a rough pose is no refinement of it
_NEAR_RAD = 0.12
_SAME_M, _SAME_RAD = 0.02, 0.005  # up to which two placements are one
_AROUND = np.array([[x, y, 0.0] for x in (-0.6, 0.0, 0.6) for y in (-0.6, 0.0, 0.6) if (x, y) != (0, 0)])  # m
_SPACING_OF_A_ROOM_M = 0.06
_SPARSE_VOXELS_M = (1.0, 0.5, 0.25)  # of a room's spacing; twice as large in halls
_NOISE_SHARE = 0.8  # of the spacing of the surfels, as the tolerance of what is seen


@dataclass(frozen=True, slots=True, kw_only=True)
class PairOptions:
    """The thresholds of the verdict."""

    least_overlap: float = 0.25
    """Smallest share of the surfaces that both stations measured."""
    most_contradicted: float = 0.015
    """Largest share of the surfaces in plain view of the other station that it saw through."""
    least_held_out: int = 4
    """Smallest number of held-out planes."""
    most_held_out_ratio: float = 1.5
    """Largest ratio of the scans' distance from held-out planes to their own noise."""
    alternative_contradicted: float = 0.03
    """Another placement counts as long as no more than this, beyond what is contradicted of the best, is."""
    alternative_overlap: float = 0.5
    """Another placement counts from this share of the best one's overlap."""
    most_sigma_mm: float = 5.0
    """Beyond it a direction counts as not determined."""
    most_sigma_deg: float = 0.1
    """Beyond it a rotation counts as not determined."""
    print_margin: float = 0.08
    """Where both scans show print, it must correlate by this much more than by chance."""


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """A scan as pairs use it, computed once."""

    view: View
    target: Target


def prepare(scan: Scan) -> Prepared:
    """Return what pairs need of a scan."""
    surfels = surfels_of(scan)
    return Prepared(View(surfels, range_picture(scan)), Target.of(surfels))


def register_pair(
    first: Prepared,
    second: Prepared,
    *,
    indices: tuple[int, int] = (0, 1),
    rough: Rigid | None = None,
    options: PairOptions | None = None,
    seed: int = 0,
) -> StationPair:
    """Register two scans that stand upright.

    Args:
        first: the scan whose frame is used.
        second: the scan that is placed in it.
        indices: of both, for the result.
        rough: `first_from_second` as it is known from elsewhere, to half a metre and some degrees; only what is
            within a metre of it is then compared, and returned as a guess. None: searched for everywhere.
        options: the thresholds.
        seed: of the samples.
    """
    o = options or PairOptions()
    start = "search" if rough is None else "poses in the files"
    least = min(len(first.view.surfels.points), len(second.view.surfels.points))
    if least < _ALIGNED_POINTS // 5:
        return _nothing(indices, start, "one of the scans has too few even surfaces to be compared")
    ranked = _ranked(first, second, rough, seed)
    worst = _WORTH_A_SECOND_LOOK * o.most_contradicted
    if rough is None and ranked and o.most_contradicted < ranked[0][1].contradicted <= worst:
        ranked = _best_first([*ranked, *_ranked(first, second, None, seed, by_free_space=True)], o)
    if not ranked:
        return _nothing(indices, start, "no placement brings surfaces of both scans together")
    best = ranked[0][0]
    looked = ranked[0][1]
    if looked.contradicted > _HOPELESS * o.most_contradicted or looked.agreeing < o.least_overlap / _HOPELESS:
        return _hopeless(indices, start, ranked, o)
    views, voxels = _range_views(first, second, best), voxels_of([first, second])
    tolerance = _tolerance(first, second)
    most = 4 * first.view.surfels.spacing_m
    checked = adjust(views, gates=_GATES, use_blocks=_used, voxels_m=voxels).poses[1]
    if differ(checked, best, most, 0.1):
        checked = best
    count, ratio = _held_out(views, checked, voxels)
    done = polish(views, [Rigid.identity(), checked], fixed=0, voxels_m=voxels)
    pose = done.poses[1]
    if differ(pose, best, most, 0.1) or done.planes == 0:
        pose = best
    looked = seen(first.view, second.view, checked, tolerance_m=tolerance)
    printed = compared_print(first.view.surfels, second.view.surfels, pose)
    other = _alternative(ranked, looked, o, lambda other: _is_settled(first, second, other, pose, voxels, o))
    covariance = about_centre(done.covariance[6:, 6:], pose)
    lost = _not_determined(covariance, o)
    runner = ranked[1][1] if len(ranked) > 1 else None
    if other is not None:
        runner = other[1]
    evidence = PairEvidence(
        looked.agreeing, looked.contradicted, done.planes, count, ratio,
        0.0 if runner is None else runner.agreeing, 1.0 if runner is None else runner.contradicted,
        printed.correlation, printed.by_chance,
    )  # fmt: skip
    verdict, reasons = _verdict(evidence, printed, None if other is None else other[0], pose, lost, o)
    return StationPair(
        *indices, verdict, reasons, pose, covariance, evidence, start, lost, None if other is None else other[0]
    )


def check_pair(
    first: Prepared,
    second: Prepared,
    pose: Rigid,
    *,
    indices: tuple[int, int] = (0, 1),
    options: PairOptions | None = None,
) -> StationPair:
    """Return the verdict on two scans where they are stated to stand, without moving them.

    Args:
        first: the scan whose frame is used.
        second: the scan that stands in it.
        pose: `first_from_second`, kept to the last digit.
        indices: of both, for the result.
        options: the thresholds.
    """
    o = options or PairOptions()
    looked = seen(first.view, second.view, pose, tolerance_m=_tolerance(first, second))
    count, ratio = _held_out(_range_views(first, second, pose), pose, voxels_of([first, second]))
    printed = compared_print(first.view.surfels, second.view.surfels, pose)
    evidence = PairEvidence(
        looked.agreeing, looked.contradicted, shared_planes=0, held_out_planes=count, held_out_ratio=ratio,
        runner_up_overlap=0.0, runner_up_contradicted=1.0, print_correlation=printed.correlation,
        print_by_chance=printed.by_chance,
    )  # fmt: skip
    verdict, reasons = _verdict(evidence, printed, None, pose, (), o)
    unknown = np.full((6, 6), np.inf)
    return StationPair(*indices, verdict, reasons, pose, unknown, evidence, "poses in the files, kept")


def stated_pose(first: Prepared, second: Prepared, pose: Rigid) -> StatedPose:
    """Return how well two scans agree at a stated pose `first_from_second`."""
    looked = seen(first.view, second.view, pose, tolerance_m=_tolerance(first, second))
    return StatedPose(pose, looked.agreeing, looked.contradicted)


def _range_views(first: Prepared, second: Prepared, pose: Rigid) -> list[RangeView]:
    """Return two scans for the adjustment of the second to the first, which is held."""
    return [
        RangeView(first.view.surfels.returns, Rigid.identity(), _FIXED * np.eye(6)),
        RangeView(second.view.surfels.returns, pose, np.zeros((6, 6))),
    ]


def about_centre(covariance: FloatArray, pose: Rigid) -> NDArray[np.float64]:
    """Return the covariance of (w, c), the scanner's centre, by that of (w, t) about the origin."""
    J = np.eye(6)
    J[3:, :3] = -skew(pose.translation)
    return np.asarray(J @ covariance @ J.T)


def voxels_of(scans: Sequence[Prepared]) -> tuple[float, ...]:
    """Return the sides of the voxels in which scans show planes: where surfaces are far away, points are sparse."""
    spacing = max(one.view.surfels.spacing_m for one in scans)
    larger = 2.0 ** round(np.log2(max(spacing / _SPACING_OF_A_ROOM_M, 1.0)))
    return VOXELS_M if larger == 1 else tuple(larger * side for side in _SPARSE_VOXELS_M)


def _tolerance(first: Prepared, second: Prepared) -> float:
    return _NOISE_SHARE * max(first.view.surfels.spacing_m, second.view.surfels.spacing_m)


def _ranked(
    first: Prepared, second: Prepared, rough: Rigid | None, seed: int, *, by_free_space: bool = False
) -> list[tuple[Rigid, Seen]]:
    """Return aligned placements that differ, the best one first, with what is seen of each."""
    surfels = second.view.surfels
    index = np.random.default_rng(seed).permutation(len(surfels.points))[:_ALIGNED_POINTS]
    if rough is None:
        starts = search(first.view, second.view, keep=_HYPOTHESES, by_free_space=by_free_space, seed=seed)
    else:
        around = [Rigid(rough.rotation, rough.translation + shift) for shift in _AROUND]
        starts = [Hypothesis(pose, 0.0) for pose in (rough, *around)]
    tolerance = _tolerance(first, second)
    found = []
    for one in starts:
        pose = aligned(first.target, surfels.points[index], surfels.normals[index], one.first_from_second)
        if rough is not None and np.linalg.norm(pose.translation - rough.translation) > _NEAR_M:
            continue
        looked = seen(first.view, second.view, pose, tolerance_m=tolerance)
        found.append((Hypothesis(pose, _rank(looked)), looked))
    if rough is not None and not found:  # the rough pose itself is the guess then
        return [(rough, seen(first.view, second.view, rough, tolerance_m=tolerance))]
    found.sort(key=lambda one: -one[0].score)
    kept = apart([one for one, _ in found], keep=len(found))
    return [(one.first_from_second, looked) for one, looked in found if any(one is other for other in kept)]


def _best_first(placements: Sequence[tuple[Rigid, Seen]], o: PairOptions) -> list[tuple[Rigid, Seen]]:
    """Return placements that differ, those first that what is seen does not refuse, whatever the others' overlap."""

    def is_refused(looked: Seen) -> bool:
        return looked.contradicted > o.most_contradicted or looked.agreeing < o.least_overlap

    ordered = sorted(placements, key=lambda one: (is_refused(one[1]), -_rank(one[1])))
    kept = apart([Hypothesis(pose, _rank(looked)) for pose, looked in ordered], keep=len(ordered))
    return [(pose, looked) for pose, looked in ordered if any(pose is one.first_from_second for one in kept)]


def _rank(looked: Seen) -> float:
    """Return what placements are ranked by: overlap less five times what is contradicted."""
    against = looked.contradicted / max(1 - looked.contradicted, 1e-9) * looked.agreeing
    return looked.agreeing - 5 * against


def _alternative(
    ranked: Sequence[tuple[Rigid, Seen]], best: Seen, o: PairOptions, is_settled: Callable[[Rigid], bool]
) -> tuple[Rigid, Seen] | None:
    """Return another placement that neither what is seen nor its own fit excludes."""
    for pose, looked in ranked[1:]:
        enough = looked.agreeing >= o.alternative_overlap * best.agreeing
        if enough and looked.contradicted <= best.contradicted + o.alternative_contradicted and is_settled(pose):
            return pose, looked
    return None


def _is_settled(
    first: Prepared, second: Prepared, pose: Rigid, best: Rigid, voxels_m: Sequence[float], o: PairOptions
) -> bool:
    """Return whether a placement is one of its own, and not the best one's that the alignment stopped short of.

    That is asked of placements near the best one only, in which large surfaces still cover each other.
    """
    if differ(pose, best, _NEAR_M, _NEAR_RAD):
        return True
    views = _range_views(first, second, pose)
    there = adjust(views, gates=_GATES, use_blocks=_used, voxels_m=voxels_m).poses[1]
    if not differ(there, best, _SAME_M, _SAME_RAD):
        return False
    count, ratio = _held_out(views, there, voxels_m)
    return count < o.least_held_out or ratio <= o.most_held_out_ratio


def _used(block: IntArray) -> BoolArray:
    return np.asarray(block % _HELD_OUT != 0, np.bool_)


def _held_out(views: Sequence[RangeView], pose: Rigid, voxels_m: Sequence[float]) -> tuple[int, float]:
    """Return the number of held-out planes, and how much farther both scans are from them than each from its own."""
    poses = [Rigid.identity(), pose]
    found, owner = planes_of(views, poses, apart_m=0.1, angle_rad=float(np.radians(5.0)), voxels_m=voxels_m)
    found = found.select(~_used(found.block))
    if not found.count:
        return 0, float("nan")
    both, own = (np.abs(off_planes(views, poses, found, owner, within_views=within)) for within in (False, True))
    limit = 10 * max(float(np.median(own)), 1e-4)
    rms = [float(np.sqrt(np.mean(np.minimum(off, limit) ** 2))) for off in (both, own)]
    return found.count, rms[0] / max(rms[1], 1e-6)


def _not_determined(covariance: FloatArray, o: PairOptions) -> tuple[str, ...]:
    out = []
    for block, limit, what in (
        (covariance[3:, 3:], o.most_sigma_mm / 1000, "a shift"),
        (covariance[:3, :3], float(np.radians(o.most_sigma_deg)), "a turn"),
    ):
        values, axes = np.linalg.eigh(block)
        for value, axis in zip(values, axes.T, strict=True):
            if not value < limit**2:
                toward = axis if axis[np.argmax(np.abs(axis))] > 0 else -axis
                how = "along" if what == "a shift" else "about"
                out.append(f"{what} {how} the direction {describe_direction(toward)}")
    return tuple(out)


def _against_sight(evidence: PairEvidence, o: PairOptions) -> list[str]:
    """Return what the stations' view of each other's surfaces says against a placement."""
    against = []
    if not evidence.overlap >= o.least_overlap:
        against.append(
            f"Only {evidence.overlap:.1%} of the surfaces were measured from both stations. Put a station in between."
        )
    if not evidence.contradicted <= o.most_contradicted:
        against.append(
            f"{evidence.contradicted:.1%} of what one station shows stands where the other one saw through: "
            "the scans show different places, or much was moved."
        )
    return against


def _verdict(
    evidence: PairEvidence, printed: Print, other: Rigid | None, pose: Rigid, lost: Sequence[str], o: PairOptions
) -> tuple[PairVerdict, tuple[str, ...]]:
    against, unsure = _against_sight(evidence, o), []
    if evidence.held_out_planes < o.least_held_out:
        unsure.append(f"Only {evidence.held_out_planes} surfaces were left to check the alignment by.")
    elif not evidence.held_out_ratio <= o.most_held_out_ratio:
        against.append(
            f"On surfaces that were kept from the alignment the scans are {evidence.held_out_ratio:.1f} times as far "
            "apart as their noise, which is too much for a fit: something was moved, or a scan is distorted."
        )
    if np.isfinite(printed.by_chance) and not printed.correlation >= printed.by_chance + o.print_margin:
        against.append(
            f"The intensities do not show the same print: their correlation is {printed.correlation:.2f}, and "
            f"{printed.by_chance:.2f} by chance."
        )
    if other is not None:
        away = float(np.linalg.norm(other.translation - pose.translation))
        unsure.append(
            f"Another placement, {format_length(away)} and {format_angle(other.angle_to(pose))} away, explains "
            f"the scans as well ({evidence.runner_up_overlap:.0%} of the surfaces agree, "
            f"{evidence.runner_up_contradicted:.1%} are contradicted)."
        )
    if lost:
        unsure.append(f"The surfaces do not determine {'; '.join(lost)}.")
    if against:
        return "refused", (*against, *unsure)
    if unsure:
        return "ambiguous", tuple(unsure)
    return "verified", (
        f"{evidence.overlap:.0%} of the surfaces agree and {evidence.contradicted:.1%} of those in plain view are "
        f"contradicted; {evidence.held_out_planes} held-out surfaces agree within their noise.",
    )


def _hopeless(
    indices: tuple[int, int], start: str, ranked: Sequence[tuple[Rigid, Seen]], o: PairOptions
) -> StationPair:
    """Return a pair that is refused for what the stations see, before anything is refined."""
    pose, looked = ranked[0]
    nan = float("nan")
    runner = ranked[1][1] if len(ranked) > 1 else Seen(0, 0.0, 1.0)
    evidence = PairEvidence(
        looked.agreeing, looked.contradicted, 0, 0, nan, runner.agreeing, runner.contradicted, nan, nan
    )
    return StationPair(
        *indices, "refused", tuple(_against_sight(evidence, o)), pose, np.full((6, 6), np.inf), evidence, start
    )


def _nothing(indices: tuple[int, int], start: str, why: str) -> StationPair:
    nan = float("nan")
    return StationPair(
        *indices, "refused", (f"{why[0].upper()}{why[1:]}.",), Rigid.identity(), np.full((6, 6), np.inf),
        PairEvidence(0.0, nan, 0, 0, nan, 0.0, 1.0, nan, nan), start,
    )  # fmt: skip
