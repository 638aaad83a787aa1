"""The jobs on all photographs of a project: registering each, and solving all of them with all scans together."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import msgspec

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.project.document import Document, PhotoEntry
from ladarreg_core.project.edits import edited_photo, with_pose
from ladarreg_core.project.results import pose_entry
from ladarreg_core.project.station_edits import scans_of, with_partner

from .inputs import Workspace
from .registration import RegistrationJobs
from .runner import JobContext

if TYPE_CHECKING:
    from ladarreg_core.results.registration import Registration
    from ladarreg_core.survey.adjust import Solved
    from ladarreg_core.survey.survey import Survey


_CHANGED = "scans or photographs changed while the job ran, so its result was discarded; run it again"


@dataclass(frozen=True, slots=True)
class _Taking:
    """The photographs that take part, and the names of those that cannot."""

    photos: list[PhotoEntry]
    left_out: list[str]
    taken_out: list[str]

    @property
    def sentence(self) -> str:
        """Which were left out; empty: none."""
        said = []
        if self.left_out:
            said.append(f"Left out, since they have no camera or cannot be read: {', '.join(self.left_out)}.")
        if self.taken_out:
            said.append(f"Taken out by hand: {', '.join(self.taken_out)}.")
        return " ".join(said)


class SurveyJobs:
    """The work of the jobs; each returns a sentence on its result.

    Args:
        workspace: provides the project, and commits the results.
        registration: registers one photograph.
    """

    def __init__(self, workspace: Workspace, registration: RegistrationJobs) -> None:
        self._workspace, self._registration = workspace, registration

    def require_photos(self, chosen: Sequence[str] | None) -> Document:
        """Return the document.

        Raises:
            OptionError: if there is no scan, or none of the chosen photographs.
        """
        document = self._workspace.session.document
        if document.scan is None:
            raise OptionError("there is no scan; open one")
        if not [one for one in document.photos if chosen is None or one.id in chosen]:
            raise OptionError("there is no photograph; open some")
        return document

    def register_all(self, chosen: Sequence[str] | None, context: JobContext) -> str:
        """Register photographs one after the other, those that are not accepted yet, and keep each result as it comes.

        Args:
            chosen: their ids; None: all.
            context: the job.
        """
        document = self.require_photos(chosen)
        taking = self._taking(document, chosen)
        waiting = [
            one for one in taking.photos
            if one.part != "held" and (chosen is not None or not (one.pose and one.pose.accepted))
        ]  # fmt: skip
        accepted, failed = 0, []
        for done, entry in enumerate(waiting):
            context.progress(Progress(done, len(waiting), f"registering {entry.source.name}"))
            try:
                self._registration.auto(self._workspace.inputs(entry.id), context)
            except OptionError:  # it was removed, or changed while the job ran
                failed.append(entry.source.name)
                continue
            now = self._workspace.session.document.photo(entry.id)
            accepted += bool(now and now.pose and now.pose.accepted)
        if not waiting:
            return " ".join(filter(None, ["All photographs are registered already.", taking.sentence]))
        said = f"{accepted} of {len(waiting)} photographs are accepted."
        changed = f"Changed meanwhile: {', '.join(failed)}." if failed else ""
        return " ".join(filter(None, [said, changed, taking.sentence]))

    def adjust(self, chosen: Sequence[str] | None, context: JobContext) -> str:
        """Solve photographs and scans together, and take over the poses that result, in one step of the history.

        Args:
            chosen: ids of the photographs that take part; None: all.
            context: the job.
        """
        from ladarreg_core.batches.photos.cache import ContentCache
        from ladarreg_core.export.outputs.project_survey import survey_of_project, with_names
        from ladarreg_core.survey.adjust import solve_survey
        from ladarreg_core.survey.registrations import photo_registration

        document = self.require_photos(chosen)
        taking = self._taking(document, chosen)
        if not taking.photos:
            raise OptionError(f"no photograph can take part. {taking.sentence}")
        survey = survey_of_project(document, self._workspace.session.folder, {one.id for one in taking.photos})
        options = document.settings.register_options

        def report(progress: Progress) -> None:
            context.progress(replace(progress, label=with_names(progress.label, document)))

        solved = solve_survey(survey, options=options, cache=ContentCache.of_user(), report=report)
        shown = survey.scans[0].id
        if not solved.adjustment.scans[shown].accepted:
            raise OptionError("the scan that is shown has no place among the others; register the stations first")
        numbers = {"": 0} | {station.id: number for number, station in enumerate(document.stations, 1)}
        beside = {one.id: numbers[one.station] for one in taking.photos}
        lost = {
            name for name, number in beside.items()
            if not solved.adjustment.scans[survey.scans[number].id].accepted
        }  # fmt: skip
        found = {
            one.id: photo_registration(survey, solved, k, 0 if one.id in lost else beside[one.id], options)
            for k, one in enumerate(survey.photos)
            if solved.adjustment.photos[one.id].accepted
        }
        self._commit(document, survey, solved, found, context, lost & found.keys())
        return " ".join(filter(None, [_sentence(document, solved), taking.sentence]))

    def _taking(self, document: Document, chosen: Sequence[str] | None) -> _Taking:
        taking = _Taking([], [], [])
        for entry in document.photos:
            if chosen is not None and entry.id not in chosen:
                continue
            if entry.part == "out":
                taking.taken_out.append(entry.source.name)
                continue
            try:
                has_camera = self._workspace.loader.header(entry).camera is not None
            except LadarregError:
                has_camera = False
            if has_camera:
                taking.photos.append(entry)
            else:
                taking.left_out.append(entry.source.name)
        return taking

    def _commit(
        self,
        before: Document,
        survey: Survey,
        solved: Solved,
        found: dict[str, Registration],
        context: JobContext,
        lost: Collection[str],
    ) -> None:
        """Commit the result; photographs beside a scan that is lost, with no place, return to the first one."""
        from ladarreg_core.export.outputs.project_survey import adjusted_entry, with_names

        poses = {}
        for name, one in found.items():
            scan = before if name in lost else before.beside(before.photo(name))
            poses[name] = pose_entry("survey", one, clouds=scan.clouds, ranges=scan.ranges)
        kept = poses | {one.id: one.pose for one in before.photos if one.part == "held" and one.pose is not None}
        adjustment = solved.adjustment
        taken_out = {
            name: tuple(with_names(reason, before) for reason in one.reasons)
            for name, one in adjustment.photos.items()
            if one.moved_others_sigmas is not None
        }

        def edited(photo: PhotoEntry) -> PhotoEntry:
            if photo.part == "held":
                return photo
            if photo.id in poses:
                return with_pose(photo, poses[photo.id])
            if photo.id in taken_out and photo.pose is not None and photo.pose.accepted:
                refused: Any = {"accepted": False, "evidence": "none", "reasons": taken_out[photo.id]}
                return with_pose(photo, msgspec.structs.replace(photo.pose, **refused))
            return photo

        def apply(document: Document) -> Document:
            for one in survey.photos:
                now, was = document.photo(one.id), before.photo(one.id)
                if now is None or was is None or _given(now) != _given(was):
                    raise OptionError(_CHANGED)
            if scans_of(document) != scans_of(before):
                raise OptionError(_CHANGED)
            for one in survey.photos:
                if one.id in lost:
                    document = with_partner(document, one.id, "", given=False)
                document = edited_photo(document, one.id, edited)
            return msgspec.structs.replace(document, adjusted=adjusted_entry(before, adjustment, kept))

        accepted = sum(one.accepted for one in adjustment.photos.values())
        label = f"Adjust: {accepted} of {len(adjustment.photos)} photographs"
        self._workspace.session.commit(label, apply, author=context.job.author)


def _given(photo: PhotoEntry) -> tuple[Any, ...]:
    """Return what the result of a photograph rests on; of one that is held also its pose."""
    held = photo.pose if photo.part == "held" else None
    return photo.source, photo.camera, photo.part, photo.camera_held, photo.station, held


def _sentence(document: Document, solved: Solved) -> str:
    """Return what was accepted, and what was not."""
    adjustment = solved.adjustment
    names = {one.id: one.source.name for one in document.photos}
    refused = [names[name] for name, one in adjustment.photos.items() if not one.accepted]
    said = f"{len(adjustment.photos) - len(refused)} of {len(adjustment.photos)} photographs are accepted"
    shown = ", ".join(refused[:5]) + (f" and {len(refused) - 5} more" if len(refused) > 5 else "")
    return f"{said}; not {shown}." if refused else f"{said}."
