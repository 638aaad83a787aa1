"""Synchronises the 3-D scene with the document and with what the clients look at."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from msgspec.structs import replace

from ladarreg_core.errors import LadarregError

from ...session.debounce import Debouncer
from ...session.loader import Loader
from ...session.session import Session
from .pose_state import pick_errors

if TYPE_CHECKING:
    from ladarreg_core.project.document import Document, PhotoEntry
    from ladarreg_core.project.source import Source
    from ladarreg_core.scan import Scan

    from ...jobs.runner import Job
    from ...jobs.simplex import Frame
    from ...scene import (
        CameraShown,
        MeasuredShown,
        Person,
        Picks,
        ScanShown,
        Scene3D,
        Shown,
        StationShown,
        Subject,
        SurveyShown,
    )

log = logging.getLogger(__name__)
_ELLIPSE_SIZE = 0.5  # half an axis of a typical ellipse at most, in depths of a frustum
_MAX_PICTURES, _PICTURE_PX = 24, 192
"""How many frusta of other photographs have pictures, and the longer side of these, px."""


class SceneSync:
    """Updates the scene in a thread of its own; has no effect before a scene is attached.

    Args:
        session: the session.
        loader: its loader.
        people: returns what every client looks at, by its id.
        stations: returns the other stations.
        measured: returns the measurements; None: there are none.
    """

    def __init__(
        self,
        session: Session,
        loader: Loader,
        people: Callable[[], Mapping[str, Person]],
        stations: Callable[[], Sequence[StationShown]] = tuple,
        measured: Callable[[], MeasuredShown | None] = lambda: None,
    ) -> None:
        self._session = session
        self._loader = loader
        self._people = people
        self._stations, self._measured = stations, measured
        self._scene: Scene3D | None = None
        self._debouncer = Debouncer()
        self._scan_shown: ScanShown | None = None
        self._subjects: dict[str, tuple[tuple[object, ...], Subject]] = {}
        self._picks: dict[str, tuple[tuple[object, ...], Picks]] = {}
        self._cameras: dict[str, tuple[tuple[object, ...], CameraShown]] = {}
        self._survey: tuple[tuple[object, ...], SurveyShown | None] = (), None
        self._simplex_runs = False
        self._iterations = 0
        self._last_iteration = 0
        self._thread = threading.Thread(target=self._work, name="scene sync", daemon=True)
        self._thread.start()

    @property
    def scene(self) -> Scene3D | None:
        """The scene, once it is attached."""
        return self._scene

    def attach(self, scene: Scene3D) -> None:
        """Update this scene from now on."""
        self._scene = scene
        self.refresh()

    def refresh(self) -> None:
        """Update the scene soon."""
        self._debouncer.request()

    def watch_simplex(self, frame: Frame) -> None:
        """Show an iteration of the simplex."""
        if self._scene is None or frame.inputs.entry.station:  # the 3-D view is of the project's scan
            return
        from ...scene import SimplexFrame

        if not self._simplex_runs:
            self._simplex_runs, self._iterations, self._last_iteration = True, 0, 0
            self._scene.simplex_started(frame.photo)
        number = frame.step.simplex.iteration
        if number < self._last_iteration:  # another descent has begun
            self._iterations += self._last_iteration
        self._last_iteration = number
        shown = SimplexFrame.of(frame.step, iteration=self._iterations + number)
        if frame.last:
            self._simplex_runs = False
            self._scene.simplex_ended(frame.photo, shown)
        else:
            self._scene.simplex_step(frame.photo, shown)

    def job_changed(self, job: Job) -> None:
        """End a simplex that failed."""
        if self._scene is not None and self._simplex_runs and not job.runs:
            self._simplex_runs = False
            self._scene.simplex_ended(job.photo, None)

    def close(self) -> None:
        """End the thread and close the scene."""
        self._debouncer.close()
        self._thread.join(30)
        if self._scene is not None:
            self._scene.close()

    def _work(self) -> None:
        while self._debouncer.wait():
            try:
                self._update()
            except LadarregError as error:
                log.info("the scene cannot be updated: %s", error)
            except Exception:
                log.exception("the scene cannot be updated")

    def _update(self) -> None:
        scene = self._scene
        if scene is None:
            return
        from ...scene import Shown, Subject

        document, people = self._loader.seen_from_scan(self._session.document), self._people()
        scene.set_people(people)
        scan_shown = self._coarse_scan(document)
        photos: dict[str | None, Shown] = {}
        if scan_shown is not None:
            photos[None] = Shown(Subject(scan_shown))
            for photo_id in {person.photo for person in people.values()}:
                entry = document.photo(photo_id or "")
                if entry is not None:
                    residuals = any(p.model.residuals for p in people.values() if p.photo == photo_id)
                    photos[entry.id] = self._shown(scan_shown, entry, with_residuals=residuals)
        cameras = list(self._cameras_of(document))
        if scan_shown is None:
            scene.show(photos)
        else:
            scene.show(photos, cameras, self._survey_of(document, cameras, scan_shown))
        scene.show_stations(self._stations())
        scene.show_measured(None if scan_shown is None else self._measured())

    def _cameras_of(self, document: Document) -> Iterator[CameraShown]:
        """Yield the cameras of all photographs whose poses are accepted; the pictures of the first ones only."""
        from ladarreg_core.inspection.model_textures import small_picture

        from ...scene import CameraShown

        before, self._cameras = self._cameras, {}
        for entry in document.photos:
            if entry.pose is None or not entry.pose.accepted:
                continue
            key = (entry.pose, entry.source)
            known = before.get(entry.id)
            if known is None or any(a is not b for a, b in zip(known[0], key, strict=True)):
                try:
                    result = self._loader.registration(entry.pose)
                    pictured = len(self._cameras) < _MAX_PICTURES
                    picture = small_picture(self._loader.photo(entry).pixels, _PICTURE_PX) if pictured else None
                except LadarregError:  # a file has gone, which the slice `photos` states
                    continue
                covariance = result.covariance[3:, 3:] if np.isfinite(result.covariance).all() else None
                known = key, CameraShown(entry.id, result.camera, result.camera_from_scanner, picture, covariance)
            self._cameras[entry.id] = known
            yield known[1]

    def _survey_of(
        self, document: Document, cameras: Sequence[CameraShown], scan_shown: ScanShown
    ) -> SurveyShown | None:
        """Return the ties between the cameras and their uncertainties; None before everything was adjusted."""
        from ladarreg_core.inspection.scene_geometry import arrows, error_ellipses

        from ...scene import SurveyShown, residual_colors

        adjusted = document.adjusted
        key = (adjusted, *cameras)
        if len(key) == len(self._survey[0]) and all(a is b for a, b in zip(key, self._survey[0], strict=True)):
            return self._survey[1]
        found = None
        if adjusted is not None:
            centres = {one.photo: one.camera_from_scanner.centre for one in cameras}
            pairs = {
                (min(photo, other), max(photo, other))
                for photo, one in adjusted.photos.items() if photo in centres
                for other in one.partners if other in centres
            }  # fmt: skip
            ties = [
                ((centres[a], centres[b]), max(adjusted.photos[one].median_px or 0.0 for one in (a, b)))
                for a, b in sorted(pairs) if a in adjusted.photos and b in adjusted.photos
            ]  # fmt: skip
            known = {one.photo: one.covariance for one in cameras if one.covariance is not None}
            rings, factor = error_ellipses(
                [centres[photo] for photo in known], list(known.values()),
                size_m=_ELLIPSE_SIZE * scan_shown.frustum_depth_m,
            )  # fmt: skip
            moved = {photo: one.former_centre for photo, one in adjusted.photos.items()
                     if one.former_centre is not None and photo in centres}  # fmt: skip
            moves = arrows(list(moved.values()), [centres[photo] for photo in moved], factor=factor)
            found = SurveyShown(
                np.array([ends for ends, _ in ties]).reshape(-1, 2, 3), residual_colors([px for _, px in ties]), rings,
                moves, factor, rings[:, 0].max(axis=0) if len(rings) else np.zeros(3),
            )  # fmt: skip
        self._survey = key, found
        return found

    def _coarse_scan(self, document: Document) -> ScanShown | None:
        from ...scene import ScanShown

        scan = self._loader.scan(document)
        if scan is None:
            self._scan_shown = None
        elif self._scan_shown is None or self._scan_shown.scan is not scan:
            views = self._loader.views(document)
            axis = views[0].view_from_scanner.rotation[2] if views else scan.mean_direction
            self._scan_shown = ScanShown(scan, axis, _name_of(document.scan))
            self._subjects.clear()
            self._picks.clear()
        return self._scan_shown

    def _shown(self, scan_shown: ScanShown, entry: PhotoEntry, *, with_residuals: bool) -> Shown:
        from ...scene import Shown

        subject = self._subject(scan_shown, entry)
        key = (entry.picks, entry.pose, with_residuals)
        known = self._picks.get(entry.id)
        if known is None or any(a is not b for a, b in zip(known[0], key, strict=True)):
            known = self._picks[entry.id] = key, self._picks_of(scan_shown.scan, subject, entry, with_residuals)
        return Shown(subject, known[1])

    def _subject(self, scan_shown: ScanShown, entry: PhotoEntry) -> Subject:
        from ...scene import Subject

        loader = self._loader
        key = (scan_shown, entry.pose, entry.source, entry.camera)
        known = self._subjects.get(entry.id)
        if known is not None and all(a is b or a == b for a, b in zip(known[0], key, strict=True)):
            return known[1]
        try:
            photo = loader.photo(entry)
        except LadarregError:
            photo = None
        try:
            result = None if entry.pose is None or photo is None else loader.registration(entry.pose)
        except LadarregError:  # its matches are missing, which the verdict of its stage states
            result = None
        subject = Subject(scan_shown, photo, result, entry.source.name)
        self._subjects[entry.id] = key, subject
        return subject

    def _picks_of(self, scan: Scan, subject: Subject, entry: PhotoEntry, with_residuals: bool) -> Picks:
        from ladarreg_core.foundations.palette import MATCHES
        from ladarreg_core.inspection.picks import pick_points

        from ...scene import Picks, residual_colors

        points, ids, on = pick_points(scan, self._loader.picks(entry))
        numbers = {pick.id: pick.number for pick in entry.picks}
        colors = [MATCHES[(numbers[name] - 1) % len(MATCHES)] for name in ids]
        by_residual = None
        if with_residuals and subject.photo is not None:
            errors = pick_errors(self._loader, scan, subject.photo, entry)[0]
            px = [errors[name]["px"] if name in errors else None for name in ids]
            by_residual = residual_colors([float("nan") if value is None else value for value in px])
        return Picks.of(points, colors, on, ids, by_residual=by_residual)


def _name_of(source: Source | None) -> str:
    return "" if source is None else msgspec.json.encode(replace(source, smoothings=())).decode()
