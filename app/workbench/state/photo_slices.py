"""The slices on each photograph, made again only where what they rest on has changed."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from ...session.cache import IdentityCache, ListCache
from ...session.loader import Loader
from .pose_state import poses_slice, stage_state
from .slices import outline_slice, photo_slice, pick_entry, progress_slice
from .survey import survey_slice, ties_slice

if TYPE_CHECKING:
    from ladarreg_core.export.output_frame import FrameName
    from ladarreg_core.project.document import Document, PhotoEntry, PoseEntry

    from ...jobs.registry import JobRegistry
    from ...slices.every import AskedOfPhoto, KeptOfPhoto
    from ...slices.photographs import Outline, Photo, Poses, Stage
    from ...slices.several import Survey


@dataclass(frozen=True, slots=True)
class _Known:
    """The slices of a photograph, and what they rest on."""

    entry: PhotoEntry
    is_seen: bool
    rests_on: tuple[object, ...]
    listed: Photo
    """Its entry of the slice `photos`."""
    slices: dict[str, Any]
    in_survey: tuple[object, ...]
    """What its row of the slice `survey` rests on; the same object as long as it is the same."""


class PhotoSlices:
    """Makes the slices on photographs; of those that an edit does not touch, they are the same objects as before.

    With eighty photographs, nearly all are the same from one edit to the next: comparing what they rest on, by
    identity, is all that they may cost then.

    Args:
        loader: reads what the document refers to.
        jobs: knows exports, corners, self-tests and audits.
    """

    def __init__(self, loader: Loader, jobs: JobRegistry) -> None:
        self._loader, self._jobs = loader, jobs
        self._pick_entries = ListCache(pick_entry)
        self._slices = IdentityCache()
        self._known: dict[str, _Known] = {}
        self._all_rest_on: tuple[object, ...] = ()
        self._poses_of: tuple[Sequence[PhotoEntry], tuple[PoseEntry | None, ...]] = (), ()

    def all(self, document: Document, looked_at: Collection[str]) -> dict[str, Any]:
        """Return the slices `photos` and `survey`, and those of each photograph.

        Args:
            document: the document.
            looked_at: ids of the photographs that clients see.
        """
        seen = {"", *(entry.station for entry in document.photos if entry.id in looked_at)}
        listed: list[Photo] = []
        found: dict[str, Any] = {"photos": listed}
        all_rest_on = (
            document.scan, document.stations, document.adjusted, self._jobs.exports.record,
            str(self._loader.assessment_changes),
        )  # fmt: skip
        is_same = _same(self._all_rest_on, all_rest_on)
        before, self._known = self._known, {}
        parts = []
        for entry in document.photos:
            is_seen, known = entry.station in seen, before.get(entry.id)
            if known is None or not is_same or known.entry is not entry or known.is_seen != is_seen:
                known = self._of(document, entry, is_seen=is_seen, before=known)
            if "error" not in known.listed:  # a file that has gone may come back
                self._known[entry.id] = known
            parts.append(known.in_survey)
            listed.append(known.listed)
            found.update(known.slices)
            asked: AskedOfPhoto = {
                "solving": self._jobs.solving(entry.id), "corners": self._jobs.corners(entry.id),
                "self_test": self._jobs.self_test(entry.id), "audit": self._jobs.audited(entry),
            }  # fmt: skip
            found.update(_named(asked, entry))
        found["survey"] = self._survey(document, parts)
        self._all_rest_on = all_rest_on  # of before: what changed meanwhile is compared the next time
        return found

    def poses(self, document: Document) -> Sequence[PoseEntry | None]:
        """Return the shown poses of all photographs, as the same object as long as they are the same."""
        photos, found = self._poses_of
        if photos is not document.photos:
            now = tuple(entry.pose for entry in document.photos)
            found = found if _same(found, now) else now
            self._poses_of = document.photos, found
        return found

    def _of(
        self,
        document: Document,
        entry: PhotoEntry,
        *,
        is_seen: bool,
        before: _Known | None,
    ) -> _Known:
        """Return a photograph's slices; those of before, where all that they rest on is the same."""
        exported = self._jobs.exports.exported(entry)
        rests_on = (
            entry, document.scan, document.stations, document.adjusted, is_seen, str(exported),
            *(self._loader.known_assessment(pose) for pose in entry.poses),
        )  # fmt: skip
        if before is not None and _same(before.rests_on, rests_on):
            return before
        listed = photo_slice(self._loader, document, entry)
        stale = listed.get("stale") if "error" not in listed else self._is_stale(document, entry)
        in_survey: tuple[object, ...] = entry.source, entry.part, entry.pose, entry.camera_held, str(bool(stale))
        if before is not None and _same(before.in_survey, in_survey):
            in_survey = before.in_survey
        made = self._made(document, entry, exported, is_seen=is_seen)
        return _Known(entry, is_seen, rests_on, listed, _named(made, entry), in_survey)

    def _made(
        self, document: Document, entry: PhotoEntry, exported: dict[str, FrameName], *, is_seen: bool
    ) -> KeptOfPhoto:
        return {
            "picks": self._pick_entries.get(entry.id, entry.picks),
            "poses": self._poses(document, entry),
            "progress": progress_slice(self._loader, document, entry, exported=exported),
            "outline": self._outline(document, entry) if is_seen else None,
            "ties": self._slices.get(
                ("ties", document.adjusted, entry.id, entry.pose), partial(ties_slice, document, entry)
            ),
        }

    def _outline(self, document: Document, entry: PhotoEntry) -> Outline | None:
        key = ("outline", document.beside(entry).scan, entry.source, entry.camera, entry.pose)
        return self._slices.get(key, partial(outline_slice, self._loader, document, entry))

    def _poses(self, document: Document, entry: PhotoEntry) -> Poses:
        stages = tuple(pose.stage for pose in entry.poses)

        def stage_of(pose: PoseEntry) -> Stage:
            assessed = self._loader.known_assessment(pose) is not None
            stale = self._loader.stale(document, entry, pose)
            key = ("stage", str(assessed), stale, ",".join(stages), pose)
            return self._slices.get(key, partial(stage_state, self._loader, pose, stale=stale, stages=stages))

        assessed = ",".join(str(k) for k, pose in enumerate(entry.poses) if self._loader.known_assessment(pose))
        beside = document.beside(entry)
        key = (beside.clouds, beside.ranges, entry.shown_stage, assessed, entry.picks, *entry.poses)
        return self._slices.get(key, partial(poses_slice, entry, stage_of))

    def _survey(self, document: Document, parts: Sequence[tuple[object, ...]]) -> Survey | None:
        if document.adjusted is None:
            return None
        stale = {entry.id: part[-1] == str(True) for entry, part in zip(document.photos, parts, strict=True)}
        places = document.adjusted, document.scan, document.stations, document.ties, document.lines
        return self._slices.get(
            ("survey", *places, *parts), partial(survey_slice, document, lambda entry: stale[entry.id])
        )

    def _is_stale(self, document: Document, entry: PhotoEntry) -> bool:
        return entry.pose is not None and bool(self._loader.stale(document, entry, entry.pose))


def _named(slices: Mapping[str, object], entry: PhotoEntry) -> dict[str, Any]:
    """Return the slices of a photograph by their names in the protocol."""
    return {f"{name}:{entry.id}": value for name, value in slices.items()}


def _same(one: tuple[object, ...], other: tuple[object, ...]) -> bool:
    return len(one) == len(other) and all(
        a is b or (isinstance(a, str) and a == b) for a, b in zip(one, other, strict=True)
    )
