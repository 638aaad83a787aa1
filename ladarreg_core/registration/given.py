"""A pose that was given, not solved: what can be said of it, and a result to colour and export with."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from ladarreg_core.foundations.validation import LARGEST_INT, require_int, require_type
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.matching.image_check import ImageCheck, check_against_images
from ladarreg_core.photo import Photo
from ladarreg_core.pose.estimate import STATED_SIGMA_PX, STATED_SIGMA_RANGE_M
from ladarreg_core.pose.result import describe_pose
from ladarreg_core.quality.pose_conventions import other_convention
from ladarreg_core.results.registration import PoseResult, Registration
from ladarreg_core.results.steps import StepLog, StepReport
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.registered_texture import Label, texture_scan

_SAMPLES = 400_000
_NOTHING_IN_PHOTO = "No return of the scan lies in the photograph at this pose, so there is nothing to colour."
_FIELDS = 48  # of the photograph's longer side, for the share of it that the scan covers


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """How much of scan and photograph see each other at a pose; shares from 0 to 1."""

    seen: float
    """Share of the scan's returns that the photograph shows: those whose colour it gives."""
    occluded: float
    """Share of the returns that something in front hides from the camera."""
    in_photo: float
    """Share of the returns inside the photograph's frame, hidden or not."""
    of_photo: float
    """Share of the photograph's area that shows returns of the scan."""

    def summary(self) -> str:
        """Return the figures as a sentence."""
        return (
            f"The photograph shows {_percent(self.seen)} of the scan's returns ({_percent(self.occluded)} are hidden "
            f"from it); the scan covers {_percent(self.of_photo)} of the photograph."
        )


def given_pose(
    scan: Scan,
    photo: Photo,
    pose: Rigid,
    *,
    check_images: bool = True,
    seed: int = 0,
    report: StepReport | None = None,
) -> Registration:
    """Return a result for a pose that is known from elsewhere: evidence `given`, never accepted.

    It can be exported like an accepted one; everything that is written says 'given, not verified'. Its covariance is
    NaN: nothing is known of it.

    Args:
        scan: the laser scan.
        photo: the photograph with its camera.
        pose: `camera_from_scanner`.
        check_images: compare the images at this pose, and state the outcome as the first of the `reasons` and in
            `diagnostics["verification"]`; the verdict stays `given`.
        seed: random seed of that comparison.
        report: receives every finished `Step`; may raise `Cancelled`.

    Raises:
        OptionError: if an argument is of a wrong type.
    """
    _check_arguments(scan, photo, pose, seed)
    steps = StepLog(report)
    with threadpool_limits(limits=1, user_api="blas"):
        with steps.step("coverage") as note:
            found = coverage(scan, photo, pose)
            note.update(seen=round(found.seen, 4), of_photo=round(found.of_photo, 4))
            steps.pose = pose
        result = _given(scan, photo, pose)
        diagnostics: dict[str, Any] = {**result.diagnostics, "coverage": asdict(found)}
        reasons = [
            "This pose was given, not solved, so the verdict stays 'given, not verified' whatever the images say."
        ]
        if found.in_photo == 0:
            reasons.insert(0, _NOTHING_IN_PHOTO)
        elif check_images:
            check = check_against_images(scan, photo, result, steps, seed=seed)
            diagnostics["verification"] = check.as_dict()
            reasons.insert(0, f"Image verification: {check.outcome}. {check.sentence}")
        doubt = other_convention(scan, photo.camera, pose)
        reasons += [*([doubt] if doubt else []), found.summary()]
    fields = {name: getattr(result, name) for name in PoseResult.__dataclass_fields__}
    fields |= {"reasons": tuple(reasons), "diagnostics": diagnostics}
    options = {"check_images": check_images}
    return Registration(**fields, method="given", steps=steps.steps, options=options, seed=seed)


def verify_pose(
    scan: Scan, photo: Photo, pose: Rigid | PoseResult, *, seed: int = 0, report: StepReport | None = None
) -> ImageCheck:
    """Return what the images say of a pose: verified, contradicted, or undecidable, with the figures.

    The laser's intensity, as the photograph's camera would see it, is compared with the photograph. A pose that they
    do not confirm is contradicted only if they confirm another one near it that differs significantly.

    Args:
        scan: the scan.
        photo: the photograph with its camera.
        pose: `camera_from_scanner`, or a result, whose camera and covariance are then used, too; `with_image_check`
            gives that result the verdict that follows.
        seed: random seed.
        report: receives every finished `Step`; may raise `Cancelled`.

    Returns:
        `outcome`, `sentence`, and as `verification` (or `as_dict()`) the figures that were compared with thresholds.

    Raises:
        OptionError: if an argument is of a wrong type.
    """
    solved = pose if isinstance(pose, PoseResult) else None
    where = pose if solved is None else solved.camera_from_scanner
    _check_arguments(scan, photo, where, seed)
    assert isinstance(where, Rigid)
    if coverage(scan, photo, where).in_photo == 0:
        return ImageCheck("undecidable", _NOTHING_IN_PHOTO, None)
    result = _given(scan, photo, where) if solved is None else solved
    return check_against_images(scan, photo, result, StepLog(report), seed=seed)


def _check_arguments(scan: object, photo: object, pose: object, seed: object) -> None:
    require_type(scan, Scan, "'scan'")
    require_type(photo, Photo, "'photo'")
    require_type(pose, Rigid, "'pose'")
    require_int(seed, "the seed", least=0, most=LARGEST_INT)


def _given(scan: Scan, photo: Photo, pose: Rigid) -> PoseResult:
    return replace(
        describe_pose(
            pose, Matches.none(), np.zeros(0, np.bool_), photo.camera,
            sigma_px=STATED_SIGMA_PX, sigma_range_m=STATED_SIGMA_RANGE_M, covariance=np.full((6, 6), np.nan),
        ),
        world_from_scanner=scan.world_from_scanner,
        evidence="given",
    )  # fmt: skip


def coverage(scan: Scan, photo: Photo, pose: Rigid) -> Coverage:
    """Return how much scan and photograph see of each other; large scans are sampled.

    Args:
        scan: the scan.
        photo: the photograph with its camera.
        pose: `camera_from_scanner`.
    """
    sampled, _ = scan.thinned(_SAMPLES)
    labels = texture_scan(sampled, photo, pose).labels
    returns = max(int(sampled.valid.sum()), 1)
    counts = np.bincount(labels[sampled.valid], minlength=len(Label))
    colored = sampled.valid & ~np.isin(labels, (Label.NO_RETURN, Label.OCCLUDED, Label.OUT_OF_FRAME))
    width, height = photo.camera.width, photo.camera.height
    step = max(width, height) / _FIELDS
    fields = np.zeros((max(1, round(height / step)), max(1, round(width / step))), np.bool_)
    if colored.any():
        uv = photo.camera.project(pose @ sampled.points[colored].astype(np.float64))
        uv = uv[photo.camera.contains(uv)]
        at = (uv + 0.5) / (width, height) * fields.shape[::-1]
        columns, rows = np.clip(at.astype(np.intp), 0, np.array(fields.shape[::-1]) - 1).T
        fields[rows, columns] = True
    return Coverage(
        seen=float(colored.sum() / returns),
        occluded=float(counts[Label.OCCLUDED] / returns),
        in_photo=float((returns - counts[Label.OUT_OF_FRAME] - counts[Label.NO_RETURN]) / returns),
        of_photo=float(fields.mean()),
    )


def _percent(share: float) -> str:
    percent = 100 * share
    return f"{percent:.0f} %" if percent >= 1 or percent == 0 else f"{percent:.1g} %"
