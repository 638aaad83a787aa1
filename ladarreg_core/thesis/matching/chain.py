"""The processing chain of the thesis: correspondences by Figure 2.13, the pose by Figure 2.18.

    perspective view -> corners -> correlation -> disparity filter -> linear pose
        -> guided matching -> filter -> linear pose -> lines between matches
        -> simplex -> rejection of outliers by depth error -> simplex, until the inliers no longer change

Lines drawn by hand replace everything before the second linear pose (thesis 2.3.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError, OptionError, ShapeError
from ladarreg_core.foundations.validation import require_choice
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches, Pick
from ladarreg_core.matching.images.photo_levels import photo_levels, working_camera
from ladarreg_core.matching.images.scan_levels import scan_levels
from ladarreg_core.matching.images.views import viewing_directions
from ladarreg_core.matching.refine.aligner import Aligner
from ladarreg_core.matching.verify.verification import GateOptions
from ladarreg_core.photo import Photo
from ladarreg_core.picks.measure import SAMPLES_PER_LINE, matches_from_picks
from ladarreg_core.pose.acceptance import count_distinct
from ladarreg_core.pose.estimate import STATED_SIGMA_PX, Method, PoseOptions, solve_pose
from ladarreg_core.quality.stereo_limits import stereo_cautions
from ladarreg_core.results.registration import PoseResult, Stage, StageName
from ladarreg_core.results.steps import StepLog, StepReport
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import perspective_view
from ladarreg_core.thesis.estimators.stereo_simplex import Residual
from ladarreg_core.thesis.matching.matcher import FoundMatches, ThesisMatchOptions, ThesisSearch

FirstPose = Literal["linear", "robust", "linear_only"]
_CREDIBLE_FRACTION = 0.5
_MIN_AGREEING = 7
_MAX_LOG10_CHANCE = -3.0
_LOWER_MARGINS = (1.0, 0.6, 0.3)
_ENOUGH_PARTNERS = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class ThesisOptions:
    """Options of the method `thesis`."""

    matching: ThesisMatchOptions = field(default_factory=ThesisMatchOptions)
    """Corners, correlation, filters, guided matching and lines between matches."""
    first_pose: FirstPose = "linear"
    """Pose for guided matching: `linear` (the thesis's, replaced by the robust pose if it is refused or fewer than half
    of its matches are inliers), always `robust`, or `linear_only`."""
    residual: Residual = "epipolar"
    """Objective of the simplex: `stereo` is Eq 2.21 literally, `epipolar` the same geometry without singularities."""
    pose: PoseOptions = field(default_factory=PoseOptions)
    """Noise, seed, and options of the simplex and of outlier rejection; the method is set by the stage."""
    gate: GateOptions = field(default_factory=GateOptions)
    """Thresholds of image verification."""

    def __post_init__(self) -> None:
        parts = (("matching", ThesisMatchOptions), ("pose", PoseOptions), ("gate", GateOptions))
        for name, expected in parts:
            if not isinstance(getattr(self, name), expected):
                raise OptionError(f"{name} is {getattr(self, name)!r}; it must be a {expected.__name__}")
        for name, value, kind in (("first_pose", self.first_pose, FirstPose), ("residual", self.residual, Residual)):
            require_choice(value, get_args(kind), f"{name}")


@dataclass(frozen=True, slots=True, eq=False)
class ThesisResult:
    """Results of all stages, accepted by image verification, or by match statistics if the matches were drawn."""

    stages: tuple[Stage, ...]
    """`linear`, `constrained_linear`, `simplex`, `simplex_outliers_removed`, in this order."""
    cautions: tuple[str, ...] = ()
    """Limits of the configuration that were predicted before the simplex ran (thesis 3.4), in sentences."""
    drawn: bool = False
    """Whether the matches were drawn by hand."""
    losses: tuple[str, ...] = ()
    """Drawn matches that had to be left out, in sentences."""

    @property
    def last(self) -> PoseResult | None:
        """The result of the last stage that has one."""
        return next((stage.result for stage in reversed(self.stages) if stage.result is not None), None)

    @property
    def answer(self) -> PoseResult | None:
        """The last accepted result; without any, the last result."""
        accepted = (s.result for s in reversed(self.stages) if s.result is not None and s.result.accepted)
        return next(accepted, self.last)

    @property
    def fallback_note(self) -> tuple[str, ...]:
        """A sentence stating the stage of the result, if later stages were not accepted."""
        if self.answer is self.last:
            return ()
        name = next(stage.name for stage in self.stages if stage.result is self.answer)
        return (f"This is the result of the stage '{name.replace('_', ' ')}'; later stages were not accepted.",)


def thesis_stages(
    scan: Scan,
    photo: Photo,
    steps: StepLog,
    *,
    picks: Sequence[Pick] | None = None,
    initial: Rigid | None = None,
    options: ThesisOptions | None = None,
    samples_per_line: int = SAMPLES_PER_LINE,
) -> ThesisResult:
    """Register by the chain of the thesis, from the images or from picks.

    Args:
        scan: the scan.
        photo: the photograph.
        steps: receives every step.
        picks: points and lines drawn by hand; None: matches are found in the images.
        initial: an initial pose; it replaces the linear pose in guided matching or as the start of the simplex.
        options: thresholds.
        samples_per_line: points along every drawn line.
    """
    o = options or ThesisOptions()
    if not picks:
        return register_thesis(scan, photo, steps, initial=initial, options=o)
    with steps.step("matches") as note:
        matches, losses = matches_from_picks(
            scan, picks, camera=photo.camera, lines="equal", samples_per_line=samples_per_line
        )
        note.update(picks=len(picks), matches=len(matches), left_out=list(losses))
        steps.matches = matches
    found = solve_thesis(matches, photo.pinhole, steps, initial=initial, options=o)
    return replace(found, losses=losses, drawn=True)


def register_thesis(
    scan: Scan, photo: Photo, steps: StepLog, *, initial: Rigid | None = None, options: ThesisOptions | None = None
) -> ThesisResult:
    """Register by the chain of the thesis, from the images.

    Args:
        scan: the scan.
        photo: the photograph.
        steps: receives every step.
        initial: an initial pose; it replaces the linear pose in guided matching.
        options: thresholds.

    Source: thesis 2.3.2 and 2.4, Figures 2.13 and 2.18.
    """
    o = options or ThesisOptions()
    search = _search(scan, photo, steps, initial, o)
    solver = _Solver(photo.pinhole, steps, o)

    with steps.step("unconstrained search") as note:
        found = search.unconstrained()
        note.update(corners=[len(search.scan_uv), len(search.photo_uv)], matches=len(found))
        steps.matches = found.matches
    found = _filtered(search, found, steps)
    linear = solver.stage("linear", found.matches)
    first = initial or solver.first_pose(linear, found.matches, search)
    if first is None:
        rest = _not_reached("constrained_linear", "There is no pose for guided matching.")
        return ThesisResult((linear, *rest), _predicted_cautions(found.matches, None, search, photo.pinhole, o))

    with steps.step("constrained search") as note:
        found = search.constrained(first)
        note.update(matches=len(found))
        steps.matches, steps.pose = found.matches, first
    found = _filtered(search, found, steps)
    constrained = solver.stage("constrained_linear", found.matches)
    with steps.step("lines between matches") as note:
        second = constrained.result
        pose = second.camera_from_scanner if second is not None and _credible(second) else first
        corners, found = found, search.densified(found, pose)
        note.update(matches=len(found))
        steps.matches = found.matches

    guess = linear.result
    doubted = guess is not None and pose is guess.camera_from_scanner and not _credible(guess)
    cautions = _predicted_cautions(corners.matches, None if doubted else pose, search, photo.pinhole, o)
    simplex, removed = solver.simplex(found.matches, pose)
    with steps.step("verify") as note:
        aligner = Aligner(search.scan, search.photo, gate=o.gate, seed=o.pose.seed)
        stages = tuple(_verified(stage, aligner) for stage in (linear, constrained, simplex, removed))
        result = ThesisResult(stages, cautions)
        if result.last is not None:
            steps.pose = result.last.camera_from_scanner
            note.update(result.last.diagnostics.get("verification", {}))
    return result


def _verified(stage: Stage, aligner: Aligner) -> Stage:
    """Return the stage with the verdict of image verification: automatic matches can be consistent and all wrong."""
    result = stage.result
    if result is None:
        return stage
    if result.diagnostics.get("collapsed"):
        return stage  # a collapsed solution is not accepted even if the image agrees: parallax did not determine it
    accepted, figures = False, dict[str, Any]()
    reasons: tuple[str, ...] = ("The scan has too little structure for a comparison with the photo.",)
    if aligner.usable:
        verdict = aligner.verify(result.camera_from_scanner)[0]
        accepted, reasons, figures = verdict.accepted, verdict.reasons, verdict.as_dict()
    verified = replace(
        result,
        accepted=accepted,
        evidence="image" if accepted else "none",
        reasons=reasons,
        diagnostics={**result.diagnostics, "verification": figures},
    )
    return replace(stage, result=verified)


def solve_thesis(
    matches: Matches,
    camera: Camera,
    steps: StepLog,
    *,
    initial: Rigid | None = None,
    options: ThesisOptions | None = None,
) -> ThesisResult:
    """Solve given matches by the estimators of the thesis: linear, simplex, simplex with outliers removed.

    Args:
        matches: M matches, for example of lines drawn by hand.
        camera: the photo's camera.
        steps: receives every step.
        initial: an initial pose; the simplex starts from it, and the linear pose is only reported.
        options: thresholds.

    Raises:
        LadarregError: as `solve_pose`, if the matches do not determine a pose.

    Source: thesis 2.3.1 and 2.4, Figure 2.18.
    """
    o = options or ThesisOptions()
    solver = _Solver(camera, steps, o)
    linear = solver.stage("linear", matches)
    credible = linear.result is not None and _credible(linear.result)
    start = initial or (linear.result.camera_from_scanner if linear.result and credible else None)
    cautions = _predicted_cautions(matches, start, None, camera, o)
    simplex, removed = solver.simplex(matches, start)
    drawn = Stage(name="constrained_linear", result=None, note="Not used with drawn matches.")
    return ThesisResult((linear, drawn, simplex, removed), cautions)


@dataclass(frozen=True, slots=True, eq=False)
class _Solver:
    """Solves the matches of each stage, and records why a stage has no result."""

    camera: Camera
    steps: StepLog
    options: ThesisOptions

    def stage(self, name: StageName, matches: Matches, *, method: Method = "linear") -> Stage:
        """Return the result of an estimator that needs no initial pose."""
        with self.steps.step(_STEP_NAMES[name]) as note:
            stage = self.solved(name, matches, method)
            self._record(stage, note)
        return stage

    def first_pose(self, linear: Stage, filtered: Matches, search: ThesisSearch) -> Rigid | None:
        """Return the pose for guided matching, or None if none is reliable.

        Beyond the thesis: the robust pose needs no filter and tolerates mismatches, so that T1 can be lowered. Of
        several robust poses the one with most guided matches is taken.
        """
        choice, result = self.options.first_pose, linear.result
        if result is not None and (choice == "linear_only" or (choice == "linear" and _credible(result))):
            return result.camera_from_scanner
        if choice == "linear_only":
            return None
        with self.steps.step("robust first pose") as note:
            best: tuple[int, float, Stage] | None = None
            for share in (None, *_LOWER_MARGINS):
                margin = (share or 1.0) * self.options.matching.t1
                found = filtered if share is None else search.unconstrained(t1=margin).matches
                stage = self.solved("linear", found, "robust")
                if stage.result is None or not _beyond_chance(stage.result):
                    continue
                partners = len(search.filtered(search.constrained(stage.result.camera_from_scanner)))
                if best is None or partners > best[0]:
                    best = (partners, margin, stage)
                if partners >= _ENOUGH_PARTNERS:
                    break
            if best is None:
                note["said"] = "No pose has more inliers than expected by chance."
                return None
            partners, margin, stage = best
            self._record(stage, note)
            del note["stage"]  # an auxiliary pose, not a stage of the thesis
            note.update(t1=round(margin, 4), partners=partners)
        assert stage.result is not None
        return stage.result.camera_from_scanner

    def simplex(self, matches: Matches, start: Rigid | None) -> tuple[Stage, Stage]:
        """Return the results of the simplex on all matches and with outliers removed."""
        o = self.options
        method: Method = "stereo_simplex" if o.residual == "stereo" else "epipolar_simplex"
        whole = replace(o.pose.simplex, reject_rounds=0)
        with self.steps.step("simplex") as note:
            first = self.solved("simplex", matches, method, start, replace(o.pose, simplex=whole))
            self._record(first, note)
        if first.result is None:
            return first, Stage(name="simplex_outliers_removed", result=None, note=first.note)
        with self.steps.step("outliers removed") as note:
            again = first.result.camera_from_scanner
            second = self.solved("simplex_outliers_removed", matches, method, again, o.pose)
            self._record(second, note)
        return first, second

    def solved(
        self,
        name: StageName,
        matches: Matches,
        method: Method,
        start: Rigid | None = None,
        options: PoseOptions | None = None,
    ) -> Stage:
        # the thesis uses a calibrated camera
        how = replace(options or self.options.pose, method=method, intrinsics="fixed")
        try:
            result = solve_pose(matches, self.camera, how, initial=start)
        except (DegenerateGeometryError, ShapeError) as error:
            return Stage(name=name, result=None, note=_sentence(str(error)))
        return Stage(name=name, result=result, note=_sentence(_summary(result)))

    def _record(self, stage: Stage, note: dict[str, Any]) -> None:
        note.update(stage=stage.name, said=stage.note)
        if stage.result is not None:
            note.update(matches=len(stage.result.matches), inliers=int(stage.result.inliers.sum()))
            self.steps.matches, self.steps.pose = stage.result.matches, stage.result.camera_from_scanner


_STEP_NAMES: dict[StageName, str] = {"linear": "linear", "constrained_linear": "constrained linear"}


def _search(scan: Scan, photo: Photo, steps: StepLog, initial: Rigid | None, options: ThesisOptions) -> ThesisSearch:
    """Return the search in the view with most matches; only a wide scan has several views."""
    working = working_camera(scan, photo.pinhole)
    with steps.step("photo") as note:
        photo_side = photo_levels(photo, working)
        note.update(width=working.width, height=working.height, focal_px=round(working.fx, 3))
    best: tuple[int, ThesisSearch] | None = None
    for number, turn in enumerate(viewing_directions(scan, working, initial=initial)):
        with steps.step("corners") as note:
            view = perspective_view(scan, working, view_from_scanner=turn)
            search = ThesisSearch(scan_levels(scan, view), photo_side, options.matching)
            count = len(search.filtered(search.unconstrained()))
            note.update(view=number, scan=len(search.scan_uv), photo=len(search.photo_uv), matches=count)
        if initial is not None or best is None or count > best[0]:
            best = (count, search)
        if initial is not None:
            break  # the first view is the one that the given pose sees
    assert best is not None, "there is always a viewing direction"
    return best[1]


def _filtered(search: ThesisSearch, found: FoundMatches, steps: StepLog) -> FoundMatches:
    with steps.step("disparity culling") as note:
        kept = search.filtered(found)
        note.update(matches=len(kept), culled=len(found) - len(kept))
        steps.matches = kept.matches
    return kept


def _predicted_cautions(
    matches: Matches, pose: Rigid | None, search: ThesisSearch | None, camera: Camera, options: ThesisOptions
) -> tuple[str, ...]:
    """Return the predicted limits of thesis 3.4, in sentences."""
    view = search.scan.view.view_from_scanner if search is not None else None
    sigma = options.pose.sigma_px or STATED_SIGMA_PX
    found = stereo_cautions(matches, camera, pose=pose, sigma_px=sigma, view_from_scanner=view)
    few = len(matches) < options.pose.acceptance.least_inliers()
    turn = search.detect_roll() if search is not None and few else None
    return found if turn is None else (*found, turn.summary())


def _credible(result: PoseResult) -> bool:
    return float(result.inliers.mean()) >= _CREDIBLE_FRACTION


def _beyond_chance(result: PoseResult) -> bool:
    """Return whether a pose has more inliers than mismatches would give by chance."""
    agreeing = result.matches.subset(result.inliers)
    different = count_distinct(agreeing.points, agreeing.uv)  # several scan corners may match one corner of the photo
    return different >= _MIN_AGREEING and result.diagnostics["log10_chance"] <= _MAX_LOG10_CHANCE


def _not_reached(first: StageName, why: str) -> tuple[Stage, ...]:
    names: tuple[StageName, ...] = ("linear", "constrained_linear", "simplex", "simplex_outliers_removed")
    return tuple(Stage(name=name, result=None, note=why) for name in names[names.index(first) :])


def _summary(result: PoseResult) -> str:
    kept, count = int(result.inliers.sum()), len(result.matches)
    if result.diagnostics.get("collapsed"):
        return result.reasons[0]
    few = result.diagnostics.get("stopped") == "too few left"
    stopped = "; rejection stopped, because the threshold would have left too few" if few else ""
    return f"{kept} of {count} matches are inliers{stopped}"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def thesis_search(
    scan: Scan,
    photo: Photo,
    options: ThesisMatchOptions | None = None,
    *,
    initial: Rigid | None = None,
    report: StepReport | None = None,
) -> ThesisSearch:
    """Return the thesis's matcher of a pair, to be run step by step.

    Args:
        scan: the scan.
        photo: the photograph.
        options: thresholds.
        initial: an initial pose; matching then uses the view that it sees.
        report: receives the preparatory steps; may raise `Cancelled`.
    """
    return _search(scan, photo, StepLog(report), initial, ThesisOptions(matching=options or ThesisMatchOptions()))


def matched_corners(
    search: ThesisSearch, camera: Camera, options: ThesisOptions | None = None, *, report: StepReport | None = None
) -> FoundMatches:
    """Return corner matches that a pose can rest on.

    Those of T1 are returned if a robust pose agrees with most of them, and with more than chance would give. Few agree
    where the laser and the camera see other brightnesses; a rough pose then comes from the best of lower T1, and guided
    matching and its filter give the matches, with their `predicted_uv`. Without any such pose those of T1 are returned.

    Args:
        search: the matcher of the pair.
        camera: the photo's camera, without distortion.
        options: thresholds; those of matching are the search's own.
        report: receives the steps; may raise `Cancelled`.

    Source: thesis 2.3.2; the robust first pose is beyond it.
    """
    o = replace(options or ThesisOptions(), matching=search.options, first_pose="robust")
    steps = StepLog(report)
    solver = _Solver(camera, steps, o)
    with steps.step("unconstrained search") as note:
        found = search.unconstrained()
        note.update(corners=[len(search.scan_uv), len(search.photo_uv)], matches=len(found))
        steps.matches = found.matches
    tried = solver.solved("linear", found.matches, "robust").result
    if tried is not None and _credible(tried) and _beyond_chance(tried):
        return found
    filtered = _filtered(search, found, steps)
    first = solver.first_pose(Stage(name="linear", result=None), filtered.matches, search)
    if first is None:
        return found
    with steps.step("constrained search") as note:
        guided = search.constrained(first)
        note.update(matches=len(guided))
        steps.matches, steps.pose = guided.matches, first
    return _filtered(search, guided, steps)
