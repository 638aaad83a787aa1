"""The stages of the thesis and the default method side by side, as in its Figure 2.22 and Tables 3.2-3.5."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from threadpoolctl import threadpool_limits

from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Pick
from ladarreg_core.photo import Photo
from ladarreg_core.picks.lengths import with_lengths_checked
from ladarreg_core.registration.register import RegisterOptions, register
from ladarreg_core.results.registration import Stage
from ladarreg_core.results.steps import StepLog, StepReport
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.registered_texture import RegisteredTexture, texture_scan
from ladarreg_core.thesis.matching.chain import thesis_stages


@dataclass(frozen=True, kw_only=True, eq=False)
class Column:
    """The result of one estimator with the image that it registers."""

    stage: Stage
    """Pose, matches and residuals, or why there are none."""
    texture: RegisteredTexture | None
    """The photograph on the scan's grid by this pose; None without a pose."""
    seconds: float
    """Wall time of the estimator."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """All columns, in the thesis's order, the default last."""

    columns: tuple[Column, ...]
    """`linear`, `constrained_linear`, `simplex`, `simplex_outliers_removed`, `default`."""
    cautions: tuple[str, ...] = ()
    """Warnings given before solving (thesis 3.4), as sentences."""
    seed: int = 0
    """The seed used."""


def compare(
    scan: Scan,
    photo: Photo,
    *,
    picks: Sequence[Pick] | None = None,
    initial: Rigid | None = None,
    options: RegisterOptions | None = None,
    report: StepReport | None = None,
) -> Comparison:
    """Register by every stage of the thesis and by the default method, on the same inputs.

    Args:
        scan: the scan.
        photo: the photograph.
        picks: points and lines drawn by hand; all estimators then use these.
        initial: a starting pose, `camera_from_scanner`, for all estimators.
        options: as for `register`.
        report: receives every finished step of all estimators; may raise `Cancelled`.

    Returns:
        Five columns; one without a pose says why.

    Raises:
        LadarregError: as `register`.

    Source: thesis Figure 2.22, Tables 3.2-3.5.
    """
    o = options or RegisterOptions()
    steps = StepLog(report)
    default = register(scan, photo, method="auto", picks=picks, initial=initial, options=o, report=report)
    with threadpool_limits(limits=1, user_api="blas"):
        found = thesis_stages(
            scan, photo, steps,
            picks=picks, initial=initial, options=o.seeded_thesis, samples_per_line=o.samples_per_line,
        )  # fmt: skip
    spent = {step.detail["stage"]: step.seconds for step in steps.steps if "stage" in step.detail}
    known = default.method == "manual" or default.diagnostics.get("verification") is not None
    last = Stage(
        name="default",
        result=default if known else None,
        note="" if known else " ".join(default.reasons),
    )
    stages = [_checked(scan, stage, picks or (), o) for stage in found.stages]
    columns = [_column(scan, photo, stage, spent.get(stage.name, 0.0)) for stage in stages]
    columns.append(_column(scan, photo, last, sum(step.seconds for step in default.steps)))
    return Comparison(columns=tuple(columns), cautions=(*found.cautions, *found.losses), seed=o.seed)


def _checked(scan: Scan, stage: Stage, picks: Sequence[Pick], options: RegisterOptions) -> Stage:
    if stage.result is None:
        return stage
    result = with_lengths_checked(stage.result, scan, picks, tolerance_m=options.match_tolerance_m)
    return replace(stage, result=result)


def _column(scan: Scan, photo: Photo, stage: Stage, seconds: float) -> Column:
    result, texture = stage.result, None
    if result is not None:
        stage = replace(stage, result=replace(result, world_from_scanner=scan.world_from_scanner))
        texture = texture_scan(
            scan, photo, result.camera_from_scanner, camera=result.camera, covariance=result.joint_covariance
        )
    return Column(stage=stage, texture=texture, seconds=seconds)
