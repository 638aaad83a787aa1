"""Are the calibrations of a whole survey still right? Each pose that is in use, judged by the images of today.

Of many poses that are right, some differ by chance: of 80, four would be called wrong. All are therefore judged
together, so that a survey in which every pose is right is called wrong once in twenty times.

Source: Holm 1979, 'A simple sequentially rejective multiple test procedure'.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.batches.photos.cache import ContentCache
from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.foundations.validation import require_type
from ladarreg_core.frames import Rigid
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.scan import Scan
from ladarreg_core.survey.audit import FALSE_ALARM, Audit, Outcome, audit
from ladarreg_core.survey.inputs import SurveyInputs
from ladarreg_core.survey.survey import Survey

_NEAREST_SCANS = 3
_UNKNOWN_POSE = "Nothing states where it was taken."


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StatedPoses:
    """The calibrations of a survey that are in use."""

    photos: Mapping[str, Rigid]
    """`camera_from_world` by the ids of photographs."""
    scans: Mapping[str, Rigid] = field(default_factory=dict)
    """`world_from_scanner` by the ids of scans; others stand where the survey or their files state."""
    cameras: Mapping[str, CameraModel] = field(default_factory=dict)
    """The cameras that are used with them, by the ids of photographs; of others, those of the survey."""

    @staticmethod
    def of_survey(survey: Survey) -> StatedPoses:
        """Return those that a survey states: `initial`, or else a `prior` with a direction."""
        poses = {one.id: one.prior.pose for one in survey.photos if one.prior is not None and not one.prior.is_position}
        poses |= {one.id: one.initial for one in survey.photos if one.initial is not None}
        return StatedPoses(photos=poses)

    @staticmethod
    def of_adjustment(folder: str | Path) -> StatedPoses:
        """Return those of the results of an earlier `adjust`, with its cameras.

        Raises:
            FormatError: if the folder has none, or they are damaged.
        """
        from ladarreg_core.batches.photos.photo_summary import read_photos_result
        from ladarreg_core.formats import read_registration

        result = read_photos_result(folder)
        photos, cameras = {}, {}
        for name, one in result.photos.items():
            if one.get("accepted") is True:
                photos[name] = Rigid.from_matrix(np.array(one["camera_from_world"], dtype=np.float64))
                cameras[name] = read_registration(result.photo_folder(name) / "registration.json").camera
        scans = {
            name: Rigid.from_matrix(np.array(one["world_from_scanner"], dtype=np.float64))
            for name, one in result.document.get("scans", {}).items() if one.get("world_from_scanner") is not None
        }  # fmt: skip
        return StatedPoses(photos=photos, scans=scans, cameras=cameras)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SurveyAudit:
    """What the images say of the poses of a survey that are in use."""

    photos: Mapping[str, Audit]
    """By the ids of photographs; `wrong` by all p values together, see `p_values`."""
    p_values: Mapping[str, float]
    """Of those that are decided: the probability that any right pose of the survey differs so much."""
    scans: Mapping[str, str]
    """By which scan each was decided; for an undecidable one, the nearest."""
    left_out: Mapping[str, str]
    """Why photographs were not judged."""

    @property
    def outcome(self) -> Outcome:
        """`wrong` if one is; `right` if all are, and none was left out; else `undecidable`."""
        outcomes = {one.outcome for one in self.photos.values()}
        if "wrong" in outcomes:
            return "wrong"
        return "right" if outcomes == {"right"} and not self.left_out else "undecidable"

    @property
    def sentence(self) -> str:
        """The outcome in words."""
        counts = {kind: sum(one.outcome == kind for one in self.photos.values()) for kind in ("right", "wrong")}
        undecided = len(self.photos) - sum(counts.values())
        parts = [f"{counts['right']} of {len(self.photos) + len(self.left_out)} poses are right"]
        parts += [f"{counts['wrong']} wrong"] if counts["wrong"] else []
        parts += [f"{undecided} undecidable"] if undecided else []
        parts += [f"{len(self.left_out)} not judged"] if self.left_out else []
        return f"{', '.join(parts)}."

    def as_fields(self) -> dict[str, Any]:
        """Return the result as JSON-ready fields."""
        return {
            "outcome": self.outcome,
            "sentence": self.sentence,
            "photos": {
                name: {**one.as_fields(), "scan": self.scans[name], "p_value_of_survey": self.p_values.get(name)}
                for name, one in self.photos.items()
            },
            "left_out": dict(self.left_out),
        }


def audit_survey(
    survey: Survey,
    stated: StatedPoses | None = None,
    *,
    options: RegisterOptions | None = None,
    report: Report | None = None,
) -> SurveyAudit:
    """Judge the poses of a survey's photographs that are in use.

    Each photograph is judged by the nearest scanner that verifies anything near its pose, of the three nearest.

    Args:
        survey: the survey, with today's scans and photographs.
        stated: the poses that are used; None: those that the survey states.
        options: seed and thresholds of the registrations.
        report: receives the progress; may raise `Cancelled`.

    Raises:
        OptionError: if no pose is stated, or it is not known where any scanner stood.
        LadarregError: if a file cannot be read.
    """
    require_type(survey, Survey, "'survey'")
    poses = StatedPoses.of_survey(survey) if stated is None else require_type(stated, StatedPoses, "'stated'")
    if not any(one.id in poses.photos for one in survey.photos):
        raise OptionError(
            "no pose of a photograph of this survey is stated; state them as 'initial', or give the results of an "
            "earlier adjustment"
        )
    done, total = 0, 2 * len(survey.photos) + len(survey.scans)

    def tell(text: str) -> None:
        nonlocal done
        done += 1
        if report is not None:
            report(Progress(min(done, total), total, text))

    with ExitStack() as stack:
        cache = ContentCache(stack.enter_context(tempfile.TemporaryDirectory(prefix="ladarreg-")))
        inputs = SurveyInputs(survey, cache)
        headers = inputs.headers(tell)
        scans = [scan for _, scan in inputs.scans(tell)]
        stations = _stations(survey, scans, poses)
        found: dict[str, Audit] = {}
        by: dict[str, str] = {}
        left_out: dict[str, str] = {}
        for one in survey.photos:
            pose = poses.photos.get(one.id)
            if pose is None:
                left_out[one.id] = _UNKNOWN_POSE
                continue
            photo = headers[one.id].files.read()
            for name, scan, station in _nearest(stations, pose):
                try:
                    judged = audit(
                        scan, photo, pose @ station, camera=poses.cameras.get(one.id), options=options,
                    )  # fmt: skip
                except OptionError as error:
                    left_out[one.id] = f"{str(error)[:1].upper()}{str(error)[1:]}."
                    break
                if one.id not in found or judged.outcome != "undecidable":
                    found[one.id], by[one.id] = judged, name
                if judged.outcome != "undecidable":
                    break
            tell(f"judging {one.id}")
    return judged_together(found, scans=by, left_out=left_out)


def judged_together(
    found: Mapping[str, Audit], *, scans: Mapping[str, str] | None = None, left_out: Mapping[str, str] | None = None
) -> SurveyAudit:
    """Return audits of single poses as one of all: as `wrong` stand those that are by the p values of all together."""
    decided = sorted(
        (name for name, one in found.items() if one.outcome != "undecidable"), key=lambda name: found[name].p_value
    )
    p_values: dict[str, float] = {}
    least = 0.0
    for k, name in enumerate(decided):
        least = max(least, min(1.0, found[name].p_value * (len(decided) - k)))
        p_values[name] = least
    photos = {}
    for name, one in found.items():
        if one.outcome == "wrong" and p_values[name] >= FALSE_ALARM:
            one = replace(
                one, outcome="right",
                sentence=f"What the images would change is as much as chance explains among {len(decided)} poses, with "
                f"a probability of {p_values[name]:.2g}.",
            )  # fmt: skip
        photos[name] = one
    by = dict.fromkeys(found, "") if scans is None else dict(scans)
    return SurveyAudit(photos=photos, p_values=p_values, scans=by, left_out=dict(left_out or {}))


def _stations(survey: Survey, scans: list[Scan], poses: StatedPoses) -> list[tuple[str, Scan, Rigid]]:
    """Return the scans whose place in the world is known; a single one defines the world if nothing else does."""
    placed = []
    for one, scan in zip(survey.scans, scans, strict=True):
        pose = poses.scans.get(one.id, scan.world_from_scanner)
        if pose is None and len(scans) == 1:
            pose = Rigid.identity()
        if pose is not None:
            placed.append((one.id, scan, pose))
    if not placed:
        raise OptionError(
            "it is not known where any of the scanners stood; state 'world_from_scanner', or give the results of an "
            "earlier adjustment"
        )
    return placed


def _nearest(stations: list[tuple[str, Scan, Rigid]], pose: Rigid) -> list[tuple[str, Scan, Rigid]]:
    return sorted(stations, key=lambda one: float(np.linalg.norm(one[2].translation - pose.centre)))[:_NEAREST_SCANS]
