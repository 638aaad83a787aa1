"""The workbench behind the page: composes session, loader, jobs and 3-D scene, and publishes their state."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import LadarregError
from ladarreg_core.project import edits
from ladarreg_core.project.edits import MAX_PHOTOS
from ladarreg_core.project.history import NOBODY

from ..argument_names import reading_slice
from ..jobs.export import Ending
from ..jobs.inputs import Workspace
from ..jobs.registry import JobRegistry
from ..jobs.runner import Job, JobRunner
from ..process_resources import return_memory_soon
from ..scene.person import ANYBODY, Person
from ..session.cache import IdentityCache, ListCache
from ..session.loader import Loader
from ..session.session import RETRY_S, Change, Session
from .acquisition.driving import Acquisition
from .acquisition.watchable import SIMULATED_ONLY, Watchable
from .commands.registry import URGENT, answer
from .files.batches import ANY, Batches
from .files.embedded import EmbeddedPictures
from .files.opening import Files
from .state.clients import Client, Clients
from .state.images import Images
from .state.measured import Measured, measurement_entry
from .state.model_parts import ModelParts
from .state.partners import Partners
from .state.photo_slices import PhotoSlices
from .state.pose_state import judged_slice
from .state.publisher import Publisher
from .state.queries import Queries
from .state.recent import project_id
from .state.scene_sync import SceneSync
from .state.selection import Selection
from .state.settings_form import settings_slice
from .state.slices import (
    formats_slice,
    history_entry,
    history_slice,
    job_slice,
    progress_slice,
    project_slice,
    scan_slice,
)
from .state.smoothing import Smoothing
from .state.stations import Stations
from .state.survey import drawn_lines_slice, drawn_ties_slice

if TYPE_CHECKING:
    from ladarreg_core.project.document import Document, PhotoEntry

    from ..gateway.protocol import Picture, Visitor
    from ..scene import Scene3D
    from ..scene.model_view import ModelChoice
    from ..slices.events import Event, NoticeEvent, NoticeLevel
    from ..slices.every import OwnSlices, QuickSlices, Scan, SlowOfPhoto, SlowSlices
    from ..slices.project import Model, ModelOfPhoto

log = logging.getLogger(__name__)
Message = Mapping[str, Any]
_ANNOUNCED = ("solve", "verify")
"""Jobs whose result is also announced: the verdict may be out of sight."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the workbench."""

    upload_bytes: int
    """The largest upload."""


class Workbench:
    """The application behind the gateway; safe for several threads.

    Args:
        session: the session, which the workbench closes.
        loader: its loader.
        upload_bytes: the largest upload.
        served: a folder whose files clients may open; None: none.
        watchable: what plans of acquisitions may watch, beside that folder.
        clients: the clients of the workbench that this one replaces; None: it is the first.
        solve_automatically: whether matches are solved after edits, where the project's settings want it.
    """

    def __init__(
        self,
        session: Session,
        loader: Loader,
        *,
        upload_bytes: int,
        served: Path | None = None,
        watchable: Watchable = SIMULATED_ONLY,
        clients: Clients | None = None,
        solve_automatically: bool = True,
    ) -> None:
        self.session = session
        self.loader = loader
        self.limits = Limits(upload_bytes)
        self.urgent_commands = URGENT
        self.opening_message = ""
        self.opening_remarks: list[str] = []
        self._reported_unsaved = False
        self.is_scratch = False
        self.clients = clients or Clients(self._publish)
        self.selection = Selection(session, self._selection_changed, self.clients.leader_of)
        self.queries = Queries(session, loader)
        workspace = Workspace(session, loader)
        self.runner = JobRunner(self._job_changed)
        self.stations = Stations(workspace, self.runner)
        self.measured = Measured(session, loader, partial(self._photos_looked_at, False))
        self.smoothing = Smoothing(session, loader)
        self.partners = Partners(session, loader, self._photos_looked_at, self._publish)
        self.scene_sync = SceneSync(session, loader, self._people, self.stations.shown, self.measured.shown)
        self.files = Files(session, loader, self.queries, self.selection, served)
        self.batches = Batches(session, loader, self.files, self.selection, self._publish)
        self.embedded = EmbeddedPictures(session, loader, self.selection)
        watch = self.scene_sync.watch_simplex
        self.jobs = JobRegistry(
            workspace, self.runner, watch, self.publish_event, self._publish if solve_automatically else None
        )
        self.acquisition = Acquisition(
            session.folder.path, self._publish, self._open_panorama, self._is_present, lambda: self.scene,
            watchable.beside(served),
        )  # fmt: skip
        self.images = Images(session, loader)
        self.model_parts = ModelParts(session, loader)
        self._history_entries = ListCache(history_entry)
        self._measurement_entries = ListCache(measurement_entry)
        self._slices = IdentityCache()
        self._photo_slices = PhotoSlices(loader, self.jobs)
        self.publisher = Publisher(self._quick_slices, self._slow_slices, self._assess)
        self._unsubscribe = session.subscribe(self._document_changed)
        self._preload()

    @property
    def project_id(self) -> str:
        """Id of the project for pages."""
        return project_id(self.session.folder.path)

    @property
    def is_empty(self) -> bool:
        """Whether nothing is open in the project, and nothing waits to be opened."""
        document = self.session.document
        return document.scan is None and not document.photos and not self.batches.slice()

    def take_over(self) -> None:
        """Publish changes of the clients from now on, in place of the workbench that this one replaces."""
        self.clients.listen(self._publish)

    # for the gateway

    def subscribe(self, listener: Callable[[Message], None], client: Client) -> Callable[[], None]:
        """Send every message for a client to a listener; return a function that ends the subscription."""
        return self.publisher.subscribe(listener, client.id, partial(self._own_slices, client))

    def slices(self, client: Client) -> dict[str, Any]:
        """Return all slices for a client that has just connected."""
        return {**self.publisher.all_slices(), **self._own_slices(client)}

    def join(self, visitor: Visitor) -> Client:
        """Connect a client.

        Raises:
            OptionError: if there are too many.
        """
        client = self.clients.join(visitor)
        self.scene_sync.refresh()
        self.partners.refresh()
        return client

    def leave(self, client: Client) -> None:
        """Disconnect a client."""
        self.clients.leave(client)
        self.acquisition.left(client)

    def answer(self, client: Client, message: Mapping[str, Any]) -> dict[str, Any]:
        """Execute a page's command and return the reply; never raises."""
        reply = answer(self, client, message)
        return reply | {"saved": False} if self.session.unsaved else reply

    def picture(self, path: str, query: Mapping[str, str]) -> Picture:
        """Return an image.

        Raises:
            LadarregError: if there is no such image.
        """
        kind, _, name = path.strip("/").partition("/")
        if kind == "acquisition":
            return self.acquisition.picture()
        return self.model_parts.part(name, query) if kind == "model" else self.images.picture(path, query)

    def first_pictures(self) -> Mapping[str, str]:
        """Return the URL of the picture that each pane shows first; those not known yet are omitted."""
        return self.images.first_pictures(self.selection.photo)

    def upload_folder(self) -> Path:
        """Return the folder for uploads."""
        return self.session.folder.inputs

    def take_upload(self, path: Path, name: str, what: str, photo: str | None, client: Client | None) -> str:
        """Open an uploaded file.

        Raises:
            LadarregError: if it is not of the stated kind; it is deleted then.
        """
        if what == ANY:
            return self.batches.take(path, name)
        return self.files.take(path, name, what, photo, client)

    def export_file(self, name: str, ending: Ending = "zip") -> tuple[Path, str] | None:
        """Return the last zip or report of that name, and its download name; None before there is one."""
        return self.jobs.exports.file(name, ending)

    def close(self) -> None:
        """End all work; commits are on the disk already.

        Raises:
            UnsavedError: if some are not; it names the folder that the project was saved to instead, if any.
        """
        self.acquisition.close()
        self._unsubscribe()
        self.jobs.close()
        self.runner.close()
        self.partners.close()
        self.publisher.close()
        self.scene_sync.close()
        self.session.close()

    # for commands, the 3-D scene and the command line

    def set_model(self, client: Client, wanted: Mapping[str, Any]) -> None:
        """Change the display of the model for a client.

        Raises:
            OptionError: if there is no such choice.
        """
        client.model = client.model.changed(wanted)
        self._selection_changed()

    @property
    def scene(self) -> Scene3D | None:
        """The 3-D scene, once it is attached."""
        return self.scene_sync.scene

    def show_smoothing(self) -> None:
        """Show previews of smoothed ranges as they are now."""
        self._selection_changed()

    def list_served(self) -> None:
        """List the served folder again."""
        self.files.list_served()
        self._publish()

    def start_over(self, photo_id: str) -> None:
        """Remove all matches and poses of a photograph; this can be undone."""
        self.session.commit("Start over", lambda d: edits.edited_photo(d, photo_id, edits.without_work), author=NOBODY)

    def attach_scene(self, scene: Scene3D) -> None:
        """Update a 3-D scene from now on."""
        self.scene_sync.attach(scene)

    def publish_event(self, event: Event, *, to: set[str] | None = None) -> None:
        """Send an event to all clients, or to some by their ids."""
        self.publisher.publish_event(event, to=to)

    def notify_others(self, client: Client, text: str) -> None:
        """Show a sentence to all other clients."""
        others = {other.id for other in self.clients.present} - {client.id}
        self.publish_event({"event": "notice", "level": "info", "text": text}, to=others)

    def publish_notice(self, text: str, *, level: NoticeLevel = "info", photo: str = "") -> None:
        """Show a sentence to all clients; one on a photograph leaves when its matches or its pose change."""
        event: NoticeEvent = {"event": "notice", "level": level, "text": text}
        if photo:
            event["photo"] = photo
        self.publish_event(event)

    # state

    def _publish(self) -> None:
        self.publisher.publish()

    def _quick_slices(self) -> dict[str, Any]:
        session, loader = self.session, self.loader
        document = session.document
        found: QuickSlices = {
            "history": history_slice(session.history, self._history_entries),
            "scan": self._scan_slice(),
            "settings": self._slices.get(document.settings, lambda: settings_slice(document.settings)),
            "job": job_slice(self.runner.job, self.runner.waiting),
            "served": self.files.served_slice(),
            "waiting": self.batches.slice(),
            "formats": formats_slice(),
            "reading": reading_slice(),
            "embedded": self.embedded.slice(),
            "acquisition": self.acquisition.slice(),
            "stations": self.stations.slice(),
            "measurements": self._measurement_entries.get("", document.measurements),
            "drawn_ties": self._slices.get(
                ("drawn ties", document.ties, document.adjusted), partial(drawn_ties_slice, document)
            ),
            "drawn_lines": self._slices.get(
                ("drawn lines", document.lines, document.adjusted, document.scan, document.stations),
                partial(drawn_lines_slice, document),
            ),
            "progress": progress_slice(loader, document, None, exported={}),
            "limits": {"upload_bytes": self.limits.upload_bytes, "photos": MAX_PHOTOS},
        }
        return {**found, **self._photo_slices.all(document, self._photos_looked_at(False))}

    def _own_slices(self, client: Client) -> dict[str, Any]:
        """Return the slices that differ between the clients."""
        shown = self.selection.photo_of(client)
        alone, opened = self.clients.is_alone(client), self._opening_message()
        start = self.is_scratch and self.is_empty
        document = self.session.document
        parts = self._slices.get(self._shown_parts(shown), partial(self.model_parts.slice, document, shown))
        choice = client.model  # another thread may replace it
        found: OwnSlices = {
            "project": project_slice(self.session, client.author, alone=alone, start=start, opened=opened),
            "shown": shown.id if shown else None,
            "partner": self.partners.slice(shown),
            "beside": self._scan_slice(shown) if shown and shown.station else None,
            "smoothing": self.smoothing.slice(client, shown.station if shown else ""),
            "people": self.clients.slice(client, self._photo_id_of),
            "model": self._slices.get(("own model", choice, parts), partial(_model_slice, choice, parts)),
        }
        return {**found}

    def _open_panorama(self, path: Path, client: Client) -> None:
        self.files.open(path, f"{path.parent.name}.npz", "scan", None, client)

    def _is_present(self, client_id: str) -> bool:
        return any(client.id == client_id for client in self.clients.present)

    def _photos_looked_at(self, by_editors: bool) -> set[str]:
        people = [client for client in self.clients.present if not (by_editors and client.read_only)]
        return {photo for client in people if (photo := self._photo_id_of(client)) is not None}

    def _photo_id_of(self, client: Client) -> str | None:
        entry = self.selection.photo_of(client)
        return entry.id if entry else None

    def _opening_message(self) -> str:
        scan = self._scan_slice()
        error = None if scan is None else scan.get("error")
        if not error:
            return self.opening_message
        return f"{self.opening_message} The scan cannot be shown: {error}.".strip()

    def _shown_parts(self, shown: PhotoEntry | None) -> tuple[object, ...]:
        document = self.session.document
        own = () if shown is None else (shown.id, shown.source, shown.camera)
        placed = document.stations, document.survey, document.adjusted
        return ("model", document.scan, *placed, *own, self._photo_slices.poses(document))

    def _people(self) -> dict[str, Person]:
        """Return what every client looks at in the 3-D scene."""
        people = {ANYBODY: Person(entry.id if (entry := self.selection.photo) else None)}
        for client in self.clients.present:
            entry = self.selection.photo_of(client)
            people[client.id] = Person(
                entry.id if entry else None, client.model, smoothing=self.smoothing.shown(client)
            )
        return people

    def _scan_slice(self, shown: PhotoEntry | None = None) -> Scan | None:
        """Return the slice of the scan beside a photograph; None: of the project's."""
        document, loader = self.session.document.beside(shown), self.loader
        return loader.cached("picture", ("scan slice", document.scan), lambda: scan_slice(loader, document))

    def _slow_slices(self) -> dict[str, Any]:
        document, loader = self.session.document, self.loader
        shared: SlowSlices = {"measured": self.measured.slice()}
        found: dict[str, Any] = {**shared}
        for entry in self._by_station(document):
            source = document.beside(entry).scan
            if source is None:
                continue
            try:
                readable = loader.header(entry).camera is not None
            except LadarregError:
                readable = False
            sigmas = document.settings.reject_sigma
            key = (source, entry.picks, entry.pose, entry.source, entry.camera, readable, sigmas)
            make = partial(judged_slice, loader, document, entry, readable=readable, sigmas=sigmas)
            with suppress(LadarregError):  # the slice `scan` or `partner` states it
                of_photo: SlowOfPhoto = {"judged": self._slices.get(key, make)}
                found[f"judged:{entry.id}"] = of_photo["judged"]
        return found

    def _by_station(self, document: Document) -> list[PhotoEntry]:
        """Return the photographs that take work on a scan: beside the project's all, beside others those looked at."""
        seen = self._photos_looked_at(False)
        here = [entry for entry in document.photos if not entry.station]
        there = [entry for entry in document.photos if entry.station and entry.id in seen]
        return [*here, *sorted(there, key=lambda entry: entry.station)]

    def _assess(self) -> None:
        """Assess the shown poses that are not assessed yet, once edits pause."""
        return_memory_soon()
        document = self.session.document
        for entry in self._by_station(document):
            pose = entry.pose
            if pose is None or self.loader.known_assessment(pose) is not None:
                continue
            with suppress(LadarregError):  # the slices `scan` and `poses` state the error
                scan = self.loader.scan(document.beside(entry))
                if scan is not None:
                    self.loader.assessment(scan, pose)
                    self._publish()

    # changes

    def _document_changed(self, change: Change) -> None:
        unsaved = self.session.unsaved
        if bool(unsaved) != self._reported_unsaved:
            self._reported_unsaved = bool(unsaved)
            if unsaved:
                self.publish_notice(
                    f"The project cannot be saved: {unsaved}. Saving is retried every {RETRY_S:.0f} s.", level="bad"
                )
            else:
                self.publish_notice("Everything is saved again.")
        if change.document.scan != change.before.scan:
            self.images.prerender()
        self.publisher.publish(slow=True)
        self.scene_sync.refresh()
        self.partners.refresh()

    def _selection_changed(self) -> None:
        document = self.session.document
        self.publisher.publish(slow=bool(document.measurements) or any(photo.station for photo in document.photos))
        self.scene_sync.refresh()
        self.partners.refresh()

    def _job_changed(self, job: Job) -> None:
        self._publish()
        if job is not self.runner.job:  # it waits, or will never begin
            return
        self.scene_sync.job_changed(job)
        if not job.runs:
            return_memory_soon()
        if job.state == "done" and job.kind in _ANNOUNCED:
            entry = self.session.document.photo(job.photo)
            accepted = entry is not None and entry.pose is not None and entry.pose.accepted
            self.publish_notice(job.message, level="info" if accepted else "warn", photo=job.photo)
        if job.state == "failed":
            self.publish_notice(f"{job.label}: {job.message}", level="bad", photo=job.photo)

    def _preload(self) -> None:
        """Load the scan, and read what is listed of the photographs, before the first client connects."""
        self.loader.preload_headers(self.session.document.photos)
        try:
            self.loader.views(self.session.document)
        except LadarregError as error:
            log.info("the scan cannot be shown: %s", error)
        self.images.prerender()
        self.publisher.publish(slow=True)


def _model_slice(choice: ModelChoice, parts: ModelOfPhoto) -> Model:
    return {**choice.slice(), **parts}
