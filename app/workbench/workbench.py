"""The workbench behind the page: puts session, workroom, jobs and the 3-D stage together, and tells all pages."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.project import edits
from ladarreg_core.project.edits import MOST_PHOTOS, the_photo

from ..jobs.inputs import Bench
from ..jobs.registry import JobTable
from ..jobs.runner import Job, JobRunner
from ..process_resources import return_memory_soon
from ..scene.model_view import ModelChoice
from ..session.cache import EachOnce
from ..session.loader import Workroom
from ..session.session import RETRY_S, Change, Session
from .commands import answer
from .files import Files
from .images import Pictures
from .pose_state import judged_slice, line_shown, poses_slice
from .publisher import Teller
from .scene_sync import StageLink
from .state import (
    entry_shown,
    history_slice,
    job_slice,
    photo_slice,
    pick_shown,
    project_slice,
    scan_slice,
)

if TYPE_CHECKING:
    from ladarreg_core.inspection.picks import PickPredictor
    from ladarreg_core.project.document import CameraGiven, PhotoEntry
    from ladarreg_core.project.history import History
    from ladarreg_core.results import PoseResult

    from ..gateway.protocol import Picture
    from ..scene import Stage3D

log = logging.getLogger(__name__)
Message = dict[str, Any]
_MOST_PEOPLE = 64


@dataclass(slots=True, eq=False)
class Person:
    """One open page."""

    name: str
    address: str


@dataclass(frozen=True, slots=True)
class Limits:
    """What the workbench takes."""

    upload_bytes: int


class Workbench:
    """Thread-safe; the gateway calls it, and it tells the gateway."""

    def __init__(self, session: Session, room: Workroom, *, upload_bytes: int, served: Path | None = None) -> None:
        self.session = session
        self.room = room
        self.limits = Limits(upload_bytes)
        self.said_at_start = ""
        self._told_unsaved = False
        self._lock = threading.RLock()
        self._people: list[Person] = []
        self._joined = 0
        self._shown = _worked_on(session.history)
        self.stage = StageLink(self)
        self.model = ModelChoice()
        self.files = Files(self, served)
        self.runner = JobRunner(self._job_changed)
        self.jobs = JobTable(Bench(session, room), self.runner, self.stage.watch_simplex, self.tell_event)
        self.pictures = Pictures(session, room)
        self._picks_shown, self._entries_shown = EachOnce(pick_shown), EachOnce(entry_shown)
        self.teller = Teller(self._quick_slices, self._slow_slices, self._assess)
        self._off = session.subscribe(self._changed)
        self._show_what_there_is()

    # what the gateway asks for

    def subscribe(self, listener: Callable[[Message], None]) -> Callable[[], None]:
        """Have a listener told every message to all pages; return what ends that."""
        return self.teller.subscribe(listener)

    def slices(self, person: Person) -> dict[str, Any]:
        """Return all slices for a page that has just come."""
        found = self.teller.all_slices()
        return {**found, "people": {**found.get("people", {}), "you": person.name}}

    def join(self, address: str) -> Person:
        """Let somebody in.

        Raises:
            OptionError: if there are too many.
        """
        with self._lock:
            if len(self._people) >= _MOST_PEOPLE:
                raise OptionError(
                    f"{_MOST_PEOPLE} pages are open, which is the most: close one, and this one comes up."
                )
            self._joined += 1
            person = Person(f"Operator {self._joined}", address)
            self._people.append(person)
        self.teller.tell()
        return person

    def leave(self, person: Person) -> None:
        """See somebody off."""
        with self._lock:
            if person in self._people:
                self._people.remove(person)
        self.teller.tell()

    def answer(self, person: Person, message: Mapping[str, Any]) -> dict[str, Any]:
        """Do what a page asks for; never raises."""
        found = answer(self, person, message)
        return found | {"saved": False} if self.session.unsaved else found

    def picture(self, path: str, query: Mapping[str, str]) -> Picture:
        """Return a picture.

        Raises:
            LadarregError: if there is none.
        """
        return self.pictures.picture(path, query)

    def upload_room(self) -> Path:
        """Return the folder that uploads are written to."""
        return self.session.folder.inputs

    def take_upload(self, path: Path, name: str, what: str, photo: str | None, client: Person | None) -> str:
        """Take a file that has arrived.

        Raises:
            LadarregError: if it is not what it is said to be; it is gone then.
        """
        return self.files.take(path, name, what, photo, client.name if client else "")

    def export_file(self, photo: str) -> tuple[Path, str] | None:
        """Return the last zip of a photograph and the name to save it by."""
        return self.jobs.export_file(photo)

    def close(self) -> None:
        """End all work; whatever was committed is on the disk.

        Raises:
            UnsavedError: if something is not; it says where it is, if anywhere.
        """
        self._off()
        self.runner.close()
        self.teller.close()
        self.stage.close()
        self.session.close()

    # what commands ask for

    def judged(self, photo_id: str) -> dict[str, Any]:
        """Return what the shown pose says of a photograph's picks."""
        document = self.session.document
        entry = the_photo(document, photo_id)
        scan = self.room.scan(document)
        if scan is None:
            raise OptionError("there is no scan; open one")
        return judged_slice(self.room, scan, self.room.photo(entry), entry)

    def partners(self, entry: PhotoEntry) -> PickPredictor:
        """Return where the shown pose puts picks.

        Raises:
            OptionError: if there is no pose.
        """
        scan = self.room.scan(self.session.document)
        if scan is None or entry.pose is None:
            raise OptionError("there is no pose yet, so that nothing can be predicted; solve first")
        return self.room.partners(scan, entry.pose)

    def corner_near(self, side: object, view: int, photo: object, at: Sequence[float]) -> list[float] | None:
        """Return the corner next to a pixel of one side, (u, v)."""
        from ladarreg_core.inspection.corners import gray_of_photo, gray_of_view, nearest_corner

        if side == "scan":
            views = self.room.views(self.session.document)
            if not 0 <= view < len(views):
                return None
            gray = self.room.kept("picture", ("gray", id(views[view])), lambda: gray_of_view(views[view].view))
        else:
            seen = self.room.photo_to_look_at(the_photo(self.session.document, photo))
            gray = self.room.kept("picture", ("gray", id(seen)), lambda: (seen, gray_of_photo(seen)))[1]
        found = nearest_corner(gray, at)
        return None if found is None else found.tolist()

    def sampled(self, ends: Any) -> dict[str, Any]:
        """Return the samples of a line on the scan."""
        scan = self.room.scan(self.session.document)
        if scan is None or len(ends) != 2:
            raise OptionError("a line on a scan has two ends")
        return line_shown(self.room, scan, ends)

    def probed(self, ray: Sequence[float]) -> dict[str, Any]:
        """Return what the scan measured along a ray."""
        from ladarreg_core.inspection.picks import probe

        scan = self.room.scan(self.session.document)
        if scan is None:
            raise OptionError("there is no scan; open one")
        found = probe(scan, ray)
        return {"range_m": found.range_m, "intensity": found.intensity, "cell": found.cell}

    def check_camera(self, entry: PhotoEntry, camera: CameraGiven) -> None:
        """Refuse a camera that does not fit its photograph.

        Raises:
            LadarregError: why.
        """
        import msgspec

        trial = msgspec.structs.replace(entry, camera=camera)
        self.room.try_photo(trial)
        self.room.photo(trial)

    def open_served(self, path: str, what: str, photo: str | None, person: Person) -> str:
        """Open a file of the served folder."""
        return self.files.open_served(path, what, photo, person.name)

    def list_served(self) -> None:
        """Look again which files are served."""
        self.files.look_again()
        self.teller.tell()

    def show_photo(self, photo_id: str) -> None:
        """Have everybody look at a photograph."""
        self._shown = photo_id
        self.teller.tell()
        self.stage.refresh()

    @property
    def shown(self) -> PhotoEntry | None:
        """The photograph that all look at."""
        document = self.session.document
        found = document.photo(self._shown or "")
        return found or (document.photos[0] if document.photos else None)

    def start_over(self, photo_id: str) -> None:
        """Take away all that was drawn and found on a photograph; undo brings it back."""
        self.session.commit("Start over", lambda d: edits.edited_photo(d, photo_id, edits.without_work), author="")

    def set_model(self, wanted: Mapping[str, Any]) -> None:
        """Change what the 3-D scene shows.

        Raises:
            OptionError: if it cannot.
        """
        with self._lock:
            self.model = self.model.changed(wanted)
        self.stage.set_model(self.model)
        self.teller.tell()

    def highlight(self, pick_id: str | None) -> None:
        """Highlight a match in the 3-D scene."""
        self.stage.highlight(pick_id)

    def rename_person(self, person: Person, name: str) -> None:
        """Call somebody by another name."""
        with self._lock:
            taken = {other.name for other in self._people if other is not person}
            person.name = name if name not in taken else f"{name} ({sum(n.startswith(name) for n in taken) + 1})"
        self.teller.tell()

    def run(self, job: str, photo: object, person: Person) -> str:
        """Begin a job and return its id."""
        return self.jobs.run(job, photo, person.name)

    def run_export(self, folder: Path, photo: object, person: Person, *, force: bool) -> str:
        """Begin to export into a folder."""
        return self.jobs.run_export(folder, photo, person.name, force=force)

    def attach_stage(self, stage: Stage3D) -> None:
        """Draw into a 3-D stage from now on."""
        self.stage.attach(stage)

    def tell_event(self, event: Message) -> None:
        """Tell all pages something that passes by."""
        self.teller.tell_event(event)

    def notice(self, text: str, *, level: str = "info") -> None:
        """Tell all pages a sentence."""
        self.tell_event({"event": "notice", "level": level, "text": text})

    def log_fault(self, error: Exception) -> None:
        """Keep what should not have happened for the log."""
        log.error("a command failed", exc_info=error)

    # what is told

    def _quick_slices(self) -> dict[str, Any]:
        session, room = self.session, self.room
        document = session.document
        shown = self.shown
        scan = room.kept("picture", ("scan slice", document.scan), lambda: scan_slice(room, document))
        with self._lock:
            names = [person.name for person in self._people]
        found: dict[str, Any] = {
            "project": {**project_slice(session), "opened": self._opened(scan)},
            "history": history_slice(session.history, self._entries_shown),
            "scan": scan,
            "photos": [photo_slice(room, entry) for entry in document.photos],
            "shown": shown.id if shown else None,
            "settings": self.teller.once(document.settings, lambda: _settings(document.settings)),
            "job": job_slice(self.runner.job),
            "served": self.files.served_slice(),
            "people": {"count": len(names), "names": names},
            "limits": {"upload_bytes": self.limits.upload_bytes, "photos": MOST_PHOTOS},
            "model": self.model.slice(self._shown_answer()),
        }
        for entry in document.photos:
            found[f"picks:{entry.id}"] = self._picks_shown.of(entry.id, entry.picks)
            found[f"poses:{entry.id}"] = self._poses_shown(entry)
            found[f"corners:{entry.id}"] = self.jobs.corners(entry.id)
            found[f"self_test:{entry.id}"] = self.jobs.self_test(entry.id)
        return found

    def _opened(self, scan: Mapping[str, Any] | None) -> str:
        """Return what a page says when it comes."""
        trouble = None if scan is None else scan.get("error")
        if not trouble:
            return self.said_at_start
        return f"{self.said_at_start} The scan cannot be shown: {trouble}.".strip()

    def _shown_answer(self) -> PoseResult | None:
        shown = self.shown
        if shown is None or shown.pose is None:
            return None
        try:
            return self.room.answer(shown.pose)
        except LadarregError:  # its arrays are damaged, which its stage says in its verdict
            return None

    def _slow_slices(self) -> dict[str, Any]:
        """Return what takes more than a moment to compute."""
        document, room = self.session.document, self.room
        found: dict[str, Any] = {}
        try:
            scan = room.scan(document)
        except LadarregError:
            return found
        if scan is None:
            return found
        for entry in document.photos:
            try:
                photo = room.photo(entry)
            except LadarregError:
                photo = None
            key = (id(scan), entry.picks, id(entry.pose), id(photo))
            found[f"judged:{entry.id}"] = self.teller.once(key, partial(judged_slice, room, scan, photo, entry))
        return found

    def _poses_shown(self, entry: PhotoEntry) -> dict[str, Any]:
        assessed = ",".join(str(number) for number, pose in enumerate(entry.poses) if self.room.assessed(pose))
        key = (entry.shown_stage, assessed, *entry.poses)
        return self.teller.once(key, partial(poses_slice, self.room, entry))

    def _assess(self) -> None:
        """Look into the shown answers that nobody has looked into yet."""
        document = self.session.document
        for entry in document.photos:
            pose = entry.pose
            if pose is None or self.room.assessed(pose) is not None:
                continue
            with suppress(LadarregError):  # what cannot be read is told where it stands
                scan = self.room.scan(document)
                if scan is not None:
                    self.room.assessment(scan, pose)
                    self.teller.tell()

    def _changed(self, change: Change) -> None:
        unsaved = self.session.unsaved
        if bool(unsaved) != self._told_unsaved:
            self._told_unsaved = bool(unsaved)
            if unsaved:
                self.notice(
                    f"The project cannot be saved: {unsaved}. It is tried again every {RETRY_S:.0f} s.", level="bad"
                )
            else:
                self.notice("Everything is saved again.")
        if change.document.scan != change.before.scan:
            self.pictures.draw_ahead()
        self.teller.tell(slow=True)
        self.stage.refresh()
        return_memory_soon()

    def _job_changed(self, job: Job) -> None:
        self.teller.tell()
        self.stage.job_changed(job)
        if not job.runs:
            return_memory_soon()
        if job.state == "failed":
            self.notice(f"{job.label}: {job.said}", level="bad")

    def _show_what_there_is(self) -> None:
        """Load the scan before anybody asks for it."""
        try:
            self.room.views(self.session.document)
        except LadarregError as error:
            log.info("the scan cannot be shown: %s", error)
        self.pictures.draw_ahead()
        self.teller.tell(slow=True)


def _worked_on(history: History) -> str | None:
    """Return the photograph that the newest step changed: there the work goes on after a restart."""
    steps = history.entries[: history.at + 1]
    for before, after in zip(reversed(steps[:-1]), reversed(steps[1:]), strict=True):
        known = {photo.id: photo for photo in before.document.photos}
        for photo in after.document.photos:
            if photo.id not in known or photo != known[photo.id]:
                return photo.id
    return None


def _settings(settings: Any) -> dict[str, Any]:
    from .settings_form import settings_shown

    return settings_shown(settings)
