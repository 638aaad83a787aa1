"""The facade: registers a photograph with a scan by one of three methods."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from ladarreg_core.errors import DegenerateGeometryError, OptionError, ShapeError
from ladarreg_core.foundations.arrays import read_only
from ladarreg_core.foundations.parallel import one_thread
from ladarreg_core.foundations.validation import (
    LARGEST_INT,
    require_choice,
    require_int,
    require_positive,
    require_type,
)
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches, Pick, count_picks, picks_of_arrays
from ladarreg_core.matching.auto_options import AutoOptions
from ladarreg_core.matching.from_images import no_pose, pose_from_images, with_shape_alone_said
from ladarreg_core.matching.image_check import Proposal, check_against_images, refined_pose, with_image_check
from ladarreg_core.matching.images.kept_channels import Channels
from ladarreg_core.photo import Photo
from ladarreg_core.picks.lengths import with_lengths_checked
from ladarreg_core.picks.measure import (
    SAMPLES_PER_LINE,
    LineUse,
    check_line_use,
    check_samples,
    matches_from_picks,
)
from ladarreg_core.pose.assumed_camera import with_assumed_camera
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.multistart import confirm
from ladarreg_core.quality.pose_conventions import other_convention
from ladarreg_core.results.registration import PoseResult, Registration
from ladarreg_core.results.steps import StepLog, StepReport
from ladarreg_core.scan import Scan
from ladarreg_core.thesis.matching.chain import ThesisOptions, ThesisResult, thesis_stages

_LOSSES_SHOWN = 3
_DISTINCT_SIGMA = 3.0  # of focal lengths that the images tell apart
_SHOWN_BY_BLOCKS = 0.37  # of an offset of the principal point; the pose has absorbed the rest of what blocks can show
_KAPPA_ROUNDS = 2  # positions of samples along a line in the photo depend on the pose, and converge at once

_NO_PICKS = "the method 'manual' has no picks; give points or lines, or use the method 'auto'"

RegistrationMethod = Literal["auto", "thesis", "manual"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisterOptions:
    """Options of a registration; saved with its result.

    Those that are changed most: `seed`; `auto=AutoOptions(reach="near_start")`, to search only near `initial`;
    `pose=PoseOptions(sigma_px=..., sigma_range_m=...)`, the noise of given matches where it is known; `lines`.
    """

    seed: int = 0
    """Random seed; equal seeds give equal results, whatever the number of threads."""
    auto: AutoOptions = field(default_factory=AutoOptions)
    """Options of the method `auto`."""
    pose: PoseOptions = field(default_factory=PoseOptions)
    """Options of the estimator for given matches."""
    thesis: ThesisOptions = field(default_factory=ThesisOptions)
    """Options of the method `thesis`."""
    lines: LineUse = "ends"
    """Use of lines drawn by hand in `manual`; `thesis` samples them at equal intervals."""
    samples_per_line: int = SAMPLES_PER_LINE
    """Number of samples along a line drawn by hand, if it is sampled."""
    proposal: Proposal = "refined"
    """Which pose `manual` proposes, if the images verify one: `refined`, theirs, unless it contradicts the matches;
    `drawn`, that of the matches as they are; `images`, theirs in any case."""
    match_tolerance_m: float | None = None
    """Largest difference allowed between the lengths that came with matches and the scan's own ranges, m; None: three
    standard deviations of the range, and 5 cm at least."""

    @property
    def seeded_thesis(self) -> ThesisOptions:
        """`thesis` with the seed of this registration."""
        return replace(self.thesis, pose=replace(self.thesis.pose, seed=self.seed))

    def __post_init__(self) -> None:
        require_int(self.seed, "the seed", least=0, most=LARGEST_INT)
        check_samples(self.samples_per_line)
        check_line_use(self.lines)
        require_choice(self.proposal, get_args(Proposal), "the proposal")
        if self.match_tolerance_m is not None:
            require_positive(self.match_tolerance_m, "match_tolerance_m")


def register(
    scan: Scan,
    photo: Photo,
    *,
    method: str = "auto",
    picks: Sequence[Pick] | None = None,
    uv: ArrayLike | None = None,
    rays: ArrayLike | None = None,
    points: ArrayLike | None = None,
    cells: ArrayLike | None = None,
    initial: Rigid | None = None,
    options: RegisterOptions | None = None,
    report: StepReport | None = None,
    channels: Channels | None = None,
    threads: int | None = None,
) -> Registration:
    """Estimate the camera pose of a photograph relative to a scan, with its uncertainty and a verdict.

    Args:
        scan: the laser scan.
        photo: the photograph with its camera.
        method: `auto` matches the images; `thesis` does so by the chain of the thesis; `manual` solves `picks`. With
            picks, `auto` becomes `manual`, and `thesis` solves them by its own estimators: picks take precedence over
            automatic matching.
        picks: corresponding points and lines.
        uv: instead of picks, the photo pixels (M, 2) of point matches from elsewhere, with one of the next three. They
            may contain wrong ones.
        rays: (M, 3) their directions in the scanner frame.
        points: (M, 3) their points in the scanner frame, m; their lengths are compared with the scan's ranges.
        cells: (M, 2) their fractional (row, column) in the scan's grid, e.g. in its intensity image.
        initial: a starting pose, `camera_from_scanner`, tried before all others.
        options: seed, methods and thresholds.
        report: receives every finished `Step`; may raise `Cancelled`.
        channels: keeps the channels of scan and photograph that `auto` makes, and those of earlier calls that it was
            given to; the result is the same, bit for bit.
        threads: 1: everything is done in the calling thread, e.g. where many pairs are registered in processes of
            their own; OpenCV has one pool for the whole process, which has one thread meanwhile. None: two, where there
            are two processor cores. The result is the same, bit for bit.

    Returns:
        The registration. A refused pose is a result, too, with `accepted` False and `reasons`; it is then only the best
        candidate and must not be shown as registered.

    Raises:
        OptionError: if the method is unknown, `manual` has no picks, `threads` is another number, or an argument is of
            a wrong type.
        ShapeError: if the arrays of matches do not match, or lie outside the scan.
        DegenerateGeometryError: if the picks do not determine a pose.
    """
    o = RegisterOptions() if options is None else options
    if uv is not None or not rays is points is cells is None:
        picks = _picks_of(scan, picks, uv, rays, points, cells)
    _check_types(scan, photo, picks, initial, o)
    if channels is not None:
        require_type(channels, Channels, "'channels'")
    require_choice(method, get_args(RegistrationMethod), "the method")
    if method == "manual" and not picks:
        raise OptionError(_NO_PICKS)
    if threads is not None:
        require_int(threads, "the number of threads", least=1, most=1)
    steps = StepLog(report)
    # With several threads BLAS sums in another order, and the last digits of a pose would depend on the machine.
    with threadpool_limits(limits=1, user_api="blas"), nullcontext() if threads is None else one_thread():
        found = _register(scan, photo, steps, method, picks, initial, o, channels)
    doubt = None if initial is None or found.accepted else other_convention(scan, photo.camera, initial)
    return found if doubt is None else replace(found, reasons=(*found.reasons, doubt))


@dataclass(frozen=True, kw_only=True, eq=False)
class MatchesRegistered:
    """What matches lead to: the pose as they were drawn, and the one that the images verify."""

    drawn: Registration
    """The pose of the matches as they are, with the verdict of the images on it."""
    refined: Registration | None
    """The pose that the images verify; None if they verify none."""

    @property
    def contradicted(self) -> bool:
        """Whether the images verify a pose that the matches exclude.

        Matches that would not be accepted by themselves do not know their own pose well enough to exclude another one,
        if most of them agree with that.
        """
        found = self.drawn.diagnostics
        if self.refined is None or found["verification"]["outcome"] != "contradicted":
            return False
        agree, total = count_picks(self.refined.matches, self.refined.inliers)
        return bool(found["statistics"]["accepted"]) or 2 * agree < total

    def proposed(self, proposal: Proposal = "refined") -> Registration:
        """Return the pose to propose; see `RegisterOptions.proposal`."""
        if self.refined is None or proposal == "drawn" or (proposal == "refined" and self.contradicted):
            return self.drawn
        return self.refined


def register_matches(
    scan: Scan,
    photo: Photo,
    picks: Sequence[Pick],
    *,
    initial: Rigid | None = None,
    options: RegisterOptions | None = None,
    report: StepReport | None = None,
) -> MatchesRegistered:
    """Solve matches and refine the pose against the images; `register` returns the one of both that is proposed.

    Args:
        scan: the laser scan.
        photo: the photograph with its camera.
        picks: corresponding points and lines.
        initial: a starting pose, `camera_from_scanner`, tried before all others.
        options: seed, methods and thresholds.
        report: receives every finished `Step`; may raise `Cancelled`.

    Raises:
        LadarregError: as `register`.
    """
    o = RegisterOptions() if options is None else options
    _check_types(scan, photo, picks, initial, o)
    if not picks:
        raise OptionError(_NO_PICKS)
    with threadpool_limits(limits=1, user_api="blas"):
        return _registered_matches(scan, photo, StepLog(report), picks, initial, o, None)


def _picks_of(
    scan: Scan,
    picks: Sequence[Pick] | None,
    uv: ArrayLike | None,
    rays: ArrayLike | None,
    points: ArrayLike | None,
    cells: ArrayLike | None,
) -> list[Pick]:
    """Return the matches given as arrays as picks."""
    sides = [name for name, side in (("rays", rays), ("points", points), ("cells", cells)) if side is not None]
    if picks is not None or uv is None or len(sides) != 1:
        raise OptionError(
            "matches are given incompletely or twice; give either picks, or uv with one of rays, points and cells"
        )
    if cells is not None:
        rays = require_type(scan, Scan, "'scan'").geometry.ray_at(read_only(cells, np.float64, (None, 2), "the cells"))
        outside = ~np.isfinite(rays).all(axis=1)
        if outside.any():
            raise ShapeError(f"{int(outside.sum())} of the cells lie outside the scan's grid of {scan.shape}")
    return picks_of_arrays(uv, rays=rays, points=points)


def _check_types(scan: object, photo: object, picks: object, initial: object, options: object) -> None:
    """Refuse arguments of wrong types before any work, e.g. a path instead of a scan or a matrix instead of a pose."""
    require_type(scan, Scan, "'scan'")
    require_type(photo, Photo, "'photo'")
    require_type(options, RegisterOptions, "'options'")
    if initial is not None:
        require_type(initial, Rigid, "'initial'")
    if picks is not None:
        if not isinstance(picks, Sequence) or isinstance(picks, str):
            raise OptionError(f"'picks' is a {type(picks).__name__}; give a list of Pick")
        for pick in picks:
            require_type(pick, Pick, "an element of 'picks'")


def _register(
    scan: Scan,
    photo: Photo,
    steps: StepLog,
    method: str,
    picks: Sequence[Pick] | None,
    initial: Rigid | None,
    options: RegisterOptions,
    channels: Channels | None,
) -> Registration:
    if method == "thesis":
        chain = thesis_stages(
            scan, photo, steps,
            picks=picks, initial=initial, options=options.seeded_thesis, samples_per_line=options.samples_per_line,
        )  # fmt: skip
        result = with_shape_alone_said(_thesis_result(chain, scan, photo), scan)
        if photo.assumed:
            result = with_assumed_camera(result, options.thesis.pose.camera_prior)
        result = with_lengths_checked(result, scan, picks or (), tolerance_m=options.match_tolerance_m)
        return _registration(result, scan, "thesis", steps, options)
    if picks:
        return _registered_matches(scan, photo, steps, picks, initial, options, channels).proposed(options.proposal)
    auto = replace(options.auto, seed=options.seed)
    result = pose_from_images(
        scan, photo, steps, initial=initial, options=auto, prior=options.pose.camera_prior, channels=channels
    )
    return _registration(result, scan, "auto", steps, options)


def _registered_matches(
    scan: Scan,
    photo: Photo,
    steps: StepLog,
    picks: Sequence[Pick],
    initial: Rigid | None,
    options: RegisterOptions,
    channels: Channels | None,
) -> MatchesRegistered:
    result = _manual_result(scan, photo, steps, picks, initial, options)
    result = with_lengths_checked(result, scan, picks, tolerance_m=options.match_tolerance_m)
    check = check_against_images(
        scan, photo, result, steps, seed=options.seed, prior=options.pose.camera_prior, channels=channels
    )
    refined = refined_pose(result, check)
    return MatchesRegistered(
        drawn=_registration(with_image_check(result, check), scan, "manual", steps, options),
        refined=None if refined is None else _registration(refined, scan, "manual", steps, options),
    )


def _manual_result(
    scan: Scan, photo: Photo, steps: StepLog, picks: Sequence[Pick], initial: Rigid | None, options: RegisterOptions
) -> PoseResult:
    def matched(pose: Rigid | None) -> tuple[Matches, tuple[str, ...]]:
        return matches_from_picks(
            scan, picks, camera=photo.camera, lines=options.lines, samples_per_line=options.samples_per_line, pose=pose
        )

    with steps.step("matches") as note:
        matches, losses = matched(initial)
        note.update(picks=len(picks), matches=len(matches), left_out=list(losses))
        steps.matches = matches
    with steps.step("pose") as note:
        # the test from many starting poses below contains the quick search for a second pose
        how = replace(options.pose, seed=options.seed, check_ambiguity=False)
        try:
            # a given starting pose was not fitted to these matches, so they can be used to test it
            result = solve_pose(
                matches, photo.camera, replace(how, keep_better_start=True), initial=initial, assumed=photo.assumed
            )
            for _ in range(_KAPPA_ROUNDS if options.lines == "kappa" else 0):
                matches, losses = matched(result.camera_from_scanner)
                result = solve_pose(
                    matches, photo.camera, how, initial=result.camera_from_scanner, assumed=photo.assumed
                )
        except DegenerateGeometryError as error:
            raise _with_losses(str(error), losses) from None
        note.update(inliers=int(result.inliers.sum()), matches=len(matches))
        steps.matches, steps.pose = matches, result.camera_from_scanner
    result = _confirmed(result, steps, how, photo)
    return replace(result, reasons=(*result.reasons, *losses))


def _confirmed(result: PoseResult, steps: StepLog, how: PoseOptions, photo: Photo) -> PoseResult:
    """Return the result checked from many starting poses; if one of them leads to a better pose, solve from there."""
    with steps.step("starts") as note:
        confirmed = confirm(result, how)
        if confirmed.better is not None:
            again = solve_pose(result.matches, photo.camera, how, initial=confirmed.better, assumed=photo.assumed)
            confirmed = confirm(again, how)
        note.update(verdict=confirmed.verdict)
        steps.matches, steps.pose = confirmed.result.matches, confirmed.result.camera_from_scanner
    return confirmed.result


def _with_losses(text: str, losses: Sequence[str]) -> DegenerateGeometryError:
    """Return an error that also lists which picks were left out before."""
    more = f" (and {len(losses) - _LOSSES_SHOWN} more)" if len(losses) > _LOSSES_SHOWN else ""
    return DegenerateGeometryError(
        " ".join([text.rstrip(".") + ("." if losses else ""), *losses[:_LOSSES_SHOWN]]) + more
    )


def _thesis_result(found: ThesisResult, scan: Scan, photo: Photo) -> PoseResult:
    """Return the result of the last stage, with the warnings given before solving."""
    result = found.answer
    if result is None:
        if found.drawn:
            raise _with_losses(found.stages[-1].note, found.losses)
        notes = tuple(dict.fromkeys(stage.note for stage in found.stages))
        return replace(no_pose(scan, photo), reasons=(*notes, *found.cautions))
    return replace(result, reasons=(*result.reasons, *found.fallback_note, *found.cautions, *found.losses))


def _registration(
    result: PoseResult, scan: Scan, method: str, steps: StepLog, options: RegisterOptions
) -> Registration:
    fields = {name: getattr(result, name) for name in PoseResult.__dataclass_fields__}
    fields["world_from_scanner"] = scan.world_from_scanner
    return Registration(**fields, method=method, steps=steps.steps, options=asdict(options), seed=options.seed)
