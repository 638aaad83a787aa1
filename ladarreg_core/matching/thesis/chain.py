"""The thesis's chain: Figure 2.13 finds correspondences, Figure 2.18 the pose, and each helps the other once.

    perspective view -> corners -> correlation -> disparity culling -> linear pose
        -> search constrained by it -> culling -> linear pose -> lines between matches
        -> simplex -> outliers rejected by their depth error -> simplex, until the matches stay the same

Lines drawn by hand take the place of everything before the second linear pose (thesis 2.3.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError, OptionError, ShapeError
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches, Pick
from ladarreg_core.matching.aligner import Aligner
from ladarreg_core.matching.pyramid import photo_levels, scan_levels, working_camera
from ladarreg_core.matching.thesis.matcher import FoundMatches, ThesisMatchOptions, ThesisSearch
from ladarreg_core.matching.verification import GateOptions
from ladarreg_core.matching.views import viewing_directions
from ladarreg_core.photo import Photo
from ladarreg_core.picks.measure import SAMPLES_PER_LINE, matches_from_picks
from ladarreg_core.pose.acceptance import LEAST_INLIERS, distinct
from ladarreg_core.pose.estimate import STATED_SIGMA_PX, Method, PoseOptions, solve_pose
from ladarreg_core.pose.thesis.stereo_simplex import Residual
from ladarreg_core.progress import StepLog, StepReport
from ladarreg_core.quality.stereo_limits import stereo_cautions
from ladarreg_core.results import PoseResult, Stage, StageName
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import perspective_view

FirstPose = Literal["linear", "robust", "linear_only"]
_CREDIBLE_SHARE = 0.5
_LEAST_AGREEING = 7
_MOST_LOG10_CHANCE = -3.0
_LOWER_MARGINS = (1.0, 0.6, 0.3)
_MANY_PARTNERS = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class ThesisOptions:
    """The thesis's thresholds, and which of its estimators walk."""

    matching: ThesisMatchOptions = field(default_factory=ThesisMatchOptions)
    """Corners, correlation, culling, the second search and the lines between matches."""
    first_pose: FirstPose = "linear"
    """What constrains the second search: the thesis's `linear` pose, in whose place the robust one steps where it is
    refused or fewer than half of its own matches agree with it; always the `robust` one; or the `linear_only`."""
    residual: Residual = "epipolar"
    """What the simplex minimises: `stereo` is Eq 2.21 to the letter, `epipolar` the same geometry without its poles."""
    pose: PoseOptions = field(default_factory=PoseOptions)
    """Noise, seed, and how the simplex walks and rejects; the method is set by the stage."""
    gate: GateOptions = field(default_factory=GateOptions)
    """What a pose must show on the pictures to be accepted."""

    def __post_init__(self) -> None:
        parts = (("matching", ThesisMatchOptions), ("pose", PoseOptions), ("gate", GateOptions))
        for name, wanted in parts:
            if not isinstance(getattr(self, name), wanted):
                raise OptionError(f"{name} is {getattr(self, name)!r}; give {wanted.__name__}")
        for name, value, kind in (("first_pose", self.first_pose, FirstPose), ("residual", self.residual, Residual)):
            if value not in get_args(kind):
                raise OptionError(f"{name} is {value!r}; it must be one of {', '.join(get_args(kind))}")


@dataclass(frozen=True, slots=True, eq=False)
class ThesisResult:
    """What each stage answered, judged by the pictures, or by the matches' statistics where they were drawn."""

    stages: tuple[Stage, ...]
    """`linear`, `constrained_linear`, `simplex`, `simplex_outliers_removed`, in this order."""
    cautions: tuple[str, ...] = ()
    """What was foreseen before the simplex walked (thesis 3.4), in sentences."""
    drawn: bool = False
    """Whether the matches were drawn by hand."""
    losses: tuple[str, ...] = ()
    """What of the drawn matches had to be left out, in sentences."""

    @property
    def last(self) -> PoseResult | None:
        """The answer of the last stage that had one."""
        return next((stage.result for stage in reversed(self.stages) if stage.result is not None), None)

    @property
    def answer(self) -> PoseResult | None:
        """The last answer that is accepted; without any, the last one."""
        accepted = (s.result for s in reversed(self.stages) if s.result is not None and s.result.accepted)
        return next(accepted, self.last)

    @property
    def left_behind(self) -> tuple[str, ...]:
        """A sentence where a later stage moved away from the answer and lost its acceptance."""
        if self.answer is self.last:
            return ()
        name = next(stage.name for stage in self.stages if stage.result is self.answer)
        return (f"This is the answer of the stage '{name.replace('_', ' ')}': those after it were not accepted.",)


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
    """Find the photo's pose as the thesis does, from the pictures or from lines drawn by hand.

    Args:
        scan: the scan.
        photo: the photograph.
        steps: receives every step.
        picks: points and lines drawn by hand; None: the pictures are searched.
        initial: a rough pose; it constrains the second search, or starts the simplex, in place of the linear one.
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
    found = solve_thesis(matches, photo.camera, steps, initial=initial, options=o)
    return replace(found, losses=losses, drawn=True)


def register_thesis(
    scan: Scan, photo: Photo, steps: StepLog, *, initial: Rigid | None = None, options: ThesisOptions | None = None
) -> ThesisResult:
    """Find the photo's pose as the thesis does.

    Args:
        scan: the scan.
        photo: the photograph.
        steps: receives every step.
        initial: a rough pose; it then constrains the second search in place of the linear one.
        options: thresholds.

    Source: thesis 2.3.2 and 2.4, Figures 2.13 and 2.18.
    """
    o = options or ThesisOptions()
    search = _search(scan, photo, steps, initial, o)
    solver = _Solver(photo.camera, steps, o)

    with steps.step("unconstrained search") as note:
        found = search.unconstrained()
        note.update(corners=[len(search.scan_uv), len(search.photo_uv)], matches=len(found))
        steps.matches = found.matches
    found = _culled(search, found, steps)
    linear = solver.stage("linear", found.matches)
    first = initial or solver.first_pose(linear, found.matches, search)
    if first is None:
        rest = _not_reached("constrained_linear", "There is no pose that could constrain the second search.")
        return ThesisResult((linear, *rest), _foreseen(found.matches, None, search, photo.camera, o))

    with steps.step("constrained search") as note:
        found = search.constrained(first)
        note.update(matches=len(found))
        steps.matches, steps.pose = found.matches, first
    found = _culled(search, found, steps)
    constrained = solver.stage("constrained_linear", found.matches)
    with steps.step("lines between matches") as note:
        second = constrained.result
        pose = second.camera_from_scanner if second is not None and _credible(second) else first
        corners, found = found, search.densified(found, pose)
        note.update(matches=len(found))
        steps.matches = found.matches

    guess = linear.result
    doubted = guess is not None and pose is guess.camera_from_scanner and not _credible(guess)
    cautions = _foreseen(corners.matches, None if doubted else pose, search, photo.camera, o)
    simplex, removed = solver.simplex(found.matches, pose)
    with steps.step("verify") as note:
        aligner = Aligner(search.scan, search.photo, gate=o.gate, seed=o.pose.seed)
        stages = tuple(_judged(stage, aligner) for stage in (linear, constrained, simplex, removed))
        result = ThesisResult(stages, cautions)
        if result.last is not None:
            steps.pose = result.last.camera_from_scanner
            note.update(result.last.diagnostics.get("verification", {}))
    return result


def _judged(stage: Stage, aligner: Aligner) -> Stage:
    """Return the stage with the verdict of the pictures: matches found by machine can agree and all be wrong."""
    result = stage.result
    if result is None:
        return stage
    if result.diagnostics.get("collapsed"):
        return stage  # whatever the pictures say of the place, this was not found by its parallax
    accepted, told = False, dict[str, Any]()
    reasons: tuple[str, ...] = ("The scan has too little that could be compared with the photo.",)
    if aligner.usable:
        verdict = aligner.judge(result.camera_from_scanner)[0]
        accepted, reasons, told = verdict.accepted, verdict.reasons, verdict.as_dict()
    judged = replace(
        result,
        accepted=accepted,
        evidence="image" if accepted else "none",
        reasons=reasons,
        diagnostics={**result.diagnostics, "verification": told},
    )
    return replace(stage, result=judged)


def solve_thesis(
    matches: Matches,
    camera: Camera,
    steps: StepLog,
    *,
    initial: Rigid | None = None,
    options: ThesisOptions | None = None,
) -> ThesisResult:
    """Find the pose of given matches by the thesis's estimators: linear, simplex, outliers rejected.

    Args:
        matches: M matches, as of lines drawn by hand.
        camera: the photo's camera.
        steps: receives every step.
        initial: a first guess; the linear pose is then only told, and the simplex starts from this.
        options: thresholds.

    Raises:
        LadarregError: as `solve_pose`, where the matches cannot determine any pose.

    Source: thesis 2.3.1 and 2.4, Figure 2.18.
    """
    o = options or ThesisOptions()
    solver = _Solver(camera, steps, o)
    linear = solver.stage("linear", matches)
    credible = linear.result is not None and _credible(linear.result)
    start = initial or (linear.result.camera_from_scanner if linear.result and credible else None)
    cautions = _foreseen(matches, start, None, camera, o)
    simplex, removed = solver.simplex(matches, start)
    drawn = Stage(name="constrained_linear", result=None, note="Drawn matches are not searched again.")
    return ThesisResult((linear, drawn, simplex, removed), cautions)


@dataclass(frozen=True, slots=True, eq=False)
class _Solver:
    """Solves the matches of a stage, and keeps why a stage has no answer."""

    camera: Camera
    steps: StepLog
    options: ThesisOptions

    def stage(self, name: StageName, matches: Matches, *, method: Method = "linear") -> Stage:
        """Return the answer of an estimator that needs no start."""
        with self.steps.step(_STEP_NAMES[name]) as note:
            stage = self._solved(name, matches, method)
            self._tell(stage, note)
        return stage

    def first_pose(self, linear: Stage, culled: Matches, search: ThesisSearch) -> Rigid | None:
        """Return what constrains the second search; None where nothing can be relied on.

        Beyond the thesis: a robust pose needs no culling and bears mismatches, so that T1 may be lowered for it. Of
        several that one is taken by which most corners find a partner.
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
                found = culled if share is None else search.unconstrained(t1=margin).matches
                stage = self._solved("linear", found, "robust")
                if stage.result is None or not _beyond_chance(stage.result):
                    continue
                partners = len(search.culled(search.constrained(stage.result.camera_from_scanner)))
                if best is None or partners > best[0]:
                    best = (partners, margin, stage)
                if partners >= _MANY_PARTNERS:
                    break
            if best is None:
                note["said"] = "No pose agrees with more matches than chance would."
                return None
            partners, margin, stage = best
            self._tell(stage, note)
            del note["stage"]  # it serves the next stage and is no stage of the thesis
            note.update(t1=round(margin, 4), partners=partners)
        assert stage.result is not None
        return stage.result.camera_from_scanner

    def simplex(self, matches: Matches, start: Rigid | None) -> tuple[Stage, Stage]:
        """Return the simplex's answers from all matches and from those that it keeps."""
        o = self.options
        method: Method = "stereo_simplex" if o.residual == "stereo" else "epipolar_simplex"
        whole = replace(o.pose.simplex, reject_rounds=0)
        with self.steps.step("simplex") as note:
            first = self._solved("simplex", matches, method, start, replace(o.pose, simplex=whole))
            self._tell(first, note)
        if first.result is None:
            return first, Stage(name="simplex_outliers_removed", result=None, note=first.note)
        with self.steps.step("outliers removed") as note:
            again = first.result.camera_from_scanner
            second = self._solved("simplex_outliers_removed", matches, method, again, o.pose)
            self._tell(second, note)
        return first, second

    def _solved(
        self,
        name: StageName,
        matches: Matches,
        method: Method,
        start: Rigid | None = None,
        options: PoseOptions | None = None,
    ) -> Stage:
        # the thesis has its camera calibrated
        how = replace(options or self.options.pose, method=method, intrinsics="fixed")
        try:
            result = solve_pose(matches, self.camera, how, initial=start)
        except (DegenerateGeometryError, ShapeError) as error:
            return Stage(name=name, result=None, note=_sentence(str(error)))
        return Stage(name=name, result=result, note=_sentence(_words(result)))

    def _tell(self, stage: Stage, note: dict[str, Any]) -> None:
        note.update(stage=stage.name, said=stage.note)
        if stage.result is not None:
            note.update(matches=len(stage.result.matches), inliers=int(stage.result.inliers.sum()))
            self.steps.matches, self.steps.pose = stage.result.matches, stage.result.camera_from_scanner


_STEP_NAMES: dict[StageName, str] = {"linear": "linear", "constrained_linear": "constrained linear"}


def _search(scan: Scan, photo: Photo, steps: StepLog, initial: Rigid | None, options: ThesisOptions) -> ThesisSearch:
    """Return the search in the view in which most corners match: one view is enough, but for wide scans."""
    working = working_camera(scan, photo.camera)
    with steps.step("photo") as note:
        photo_side = photo_levels(photo, working)
        note.update(width=working.width, height=working.height, focal_px=round(working.fx, 3))
    best: tuple[int, ThesisSearch] | None = None
    for number, turn in enumerate(viewing_directions(scan, working, initial=initial)):
        with steps.step("corners") as note:
            view = perspective_view(scan, working, view_from_scanner=turn)
            search = ThesisSearch(scan_levels(scan, view), photo_side, options.matching)
            count = len(search.culled(search.unconstrained()))
            note.update(view=number, scan=len(search.scan_uv), photo=len(search.photo_uv), matches=count)
        if initial is not None or best is None or count > best[0]:
            best = (count, search)
        if initial is not None:
            break  # the first view is what the given pose sees
    assert best is not None, "there is always a direction to look in"
    return best[1]


def _culled(search: ThesisSearch, found: FoundMatches, steps: StepLog) -> FoundMatches:
    with steps.step("disparity culling") as note:
        kept = search.culled(found)
        note.update(matches=len(kept), culled=len(found) - len(kept))
        steps.matches = kept.matches
    return kept


def _foreseen(
    matches: Matches, pose: Rigid | None, search: ThesisSearch | None, camera: Camera, options: ThesisOptions
) -> tuple[str, ...]:
    """Return the cautions of thesis 3.4."""
    view = search.scan.view.view_from_scanner if search is not None else None
    sigma = options.pose.sigma_px or STATED_SIGMA_PX
    found = stereo_cautions(matches, camera, pose=pose, sigma_px=sigma, view_from_scanner=view)
    turn = search.seems_turned() if search is not None and len(matches) < LEAST_INLIERS else None
    return found if turn is None else (*found, turn.in_words())


def _credible(result: PoseResult) -> bool:
    return float(result.inliers.mean()) >= _CREDIBLE_SHARE


def _beyond_chance(result: PoseResult) -> bool:
    """Return whether more matches agree than mismatches would by chance."""
    agreeing = result.matches.subset(result.inliers)
    different = distinct(agreeing.points, agreeing.uv)  # several scan corners may have matched one corner of the photo
    return different >= _LEAST_AGREEING and result.diagnostics["log10_chance"] <= _MOST_LOG10_CHANCE


def _not_reached(first: StageName, why: str) -> tuple[Stage, ...]:
    names: tuple[StageName, ...] = ("linear", "constrained_linear", "simplex", "simplex_outliers_removed")
    return tuple(Stage(name=name, result=None, note=why) for name in names[names.index(first) :])


def _words(result: PoseResult) -> str:
    kept, count = int(result.inliers.sum()), len(result.matches)
    if result.diagnostics.get("collapsed"):
        return result.reasons[0]
    stopped = ", and the threshold would leave too few" if result.diagnostics.get("stopped") == "too few left" else ""
    return f"{kept} of {count} matches count{stopped}"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def search_of(
    scan: Scan,
    photo: Photo,
    options: ThesisMatchOptions | None = None,
    *,
    initial: Rigid | None = None,
    report: StepReport | None = None,
) -> ThesisSearch:
    """Return the thesis's search for a pair, to be gone through step by step.

    Args:
        scan: the scan.
        photo: the photograph.
        options: thresholds.
        initial: a rough pose; the search is then made in the view of what it sees.
        report: receives the steps that lead to it; may raise `Cancelled`.
    """
    return _search(scan, photo, StepLog(report), initial, ThesisOptions(matching=options or ThesisMatchOptions()))
