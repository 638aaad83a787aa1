"""The desk: the one project that is open, what the gateway serves, and the change to another project."""

from __future__ import annotations

import logging
import os
import re
import secrets
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from ladarreg_core.batches.jobs.run_folder import JOBS_RUN
from ladarreg_core.batches.photos.folder import is_batch_folder
from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.project.storage.duplicate import duplicate_project
from ladarreg_core.project.storage.folder import ProjectFolder, is_project
from ladarreg_core.storage.atomic_write import files_below

from ..argument_names import as_fields
from ..gateway.protocol import Picture, Visitor
from ..gateway.uploads import remove_partial_uploads
from ..jobs.export import Ending
from ..session.session import Change, now
from .batch_jobs import BatchJobs, register_unsolved
from .commands.command import Reply
from .commands.projects import PROJECT_COMMANDS
from .commands.registry import answer_command, reply_to
from .given_files import Reading
from .sample import SAMPLE_NAME, register_sample, sample_files
from .state.clients import Client
from .state.recent import RecentProjects, project_id
from .state.thumbnail import draw_thumbnail

if TYPE_CHECKING:
    from .state.clients import Clients
    from .workbench import Limits, Workbench

log = logging.getLogger(__name__)
Message = Mapping[str, Any]
_REPLY_IS_SENT_S = 0.2
_CALLS_END_S = 60.0
_OTHER_PROJECT = "another project was opened meanwhile, so nothing was changed: reload the page"


class OpenWorkbench(Protocol):
    """Opens a workbench, as `launch.open_workbench`."""

    def __call__(
        self,
        inputs: Sequence[Path],
        *,
        project: Path | None = None,
        name: str = "",
        reading: Reading | None = None,
        clients: Clients | None = None,
    ) -> Workbench:
        """Open it."""


class Desk:
    """What the gateway serves: a workbench that is replaced by another when the project changes.

    Args:
        workbench: the first workbench; the desk closes it.
        open_workbench: opens others.
        data: folder of the user's data.
        anywhere: whether pages may open any project folder of this machine, not only those of the list.
        batch: the batch whose jobs are listed; None: none yet.
        on_open: called with each further workbench before pages see it.
        on_close: called with each workbench that was replaced, once it is closed.
    """

    def __init__(
        self,
        workbench: Workbench,
        *,
        open_workbench: OpenWorkbench,
        data: Path,
        anywhere: bool,
        batch: BatchJobs | None = None,
        on_open: Callable[[Workbench], None] = lambda workbench: None,
        on_close: Callable[[Workbench], None] = lambda workbench: None,
    ) -> None:
        self._workbench = workbench
        self._batch = batch
        self._open, self._data = open_workbench, data
        self._on_open, self._on_close = on_open, on_close
        self._anywhere = anywhere
        self.recent = RecentProjects(data)
        self._changed = threading.Condition()
        self._calls: Counter[int] = Counter()
        self._switching = threading.Lock()
        self._retiring: list[threading.Thread] = []
        self._enter_in_list(workbench)

    @property
    def workbench(self) -> Workbench:
        """The workbench on the open project."""
        return self._workbench

    # for the gateway

    @property
    def limits(self) -> Limits:
        """The limits of the workbench."""
        return self._workbench.limits

    @property
    def urgent_commands(self) -> Collection[str]:
        """The urgent commands of the workbench."""
        return self._workbench.urgent_commands

    def subscribe(self, listener: Callable[[Message], None], client: Client) -> Callable[[], None]:
        """Send every message of the open project for a client to a listener; return what ends this."""
        return self._workbench.subscribe(listener, client)

    def slices(self, client: Client) -> dict[str, Any]:
        """Return all slices for a client that has just connected."""
        with self._call() as workbench:
            return workbench.slices(client)

    def join(self, visitor: Visitor) -> Client:
        """Connect a client; raises `LadarregError` if there are too many."""
        with self._call() as workbench:
            return workbench.join(visitor)

    def leave(self, client: Client) -> None:
        """Disconnect a client."""
        with self._call() as workbench:
            workbench.leave(client)

    def answer(self, client: Client, message: Mapping[str, Any]) -> dict[str, Any]:
        """Execute a page's command and return the reply; never raises."""
        do = message.get("do")
        command = PROJECT_COMMANDS.get(do) if isinstance(do, str) else None
        with self._call() as workbench:
            if message.get("project") not in (None, workbench.project_id):
                return reply_to(message, _refuse_other_project)
            if command is None:
                return workbench.answer(client, message)
        return answer_command(PROJECT_COMMANDS, message, client, lambda found: found.execute(self, client))

    def picture(self, path: str, query: Mapping[str, str]) -> Picture:
        """Return an image of the open project, or the one of another project or a job (`project/ID`)."""
        kind, _, key = path.partition("/")
        if kind in ("project", "job"):
            data = self.recent.picture(key) if kind == "project" else self._batch and self._batch.picture(key)
            if not data:
                raise OptionError(f"there is no picture of this {kind}")
            return Picture(data, "image/jpeg", f"{key}-{len(data)}-{hash(data) & 0xFFFFFFFF:x}")
        with self._call() as workbench:
            return workbench.picture(path, query)

    def first_pictures(self) -> Mapping[str, str]:
        """Return the URL of the picture that each pane shows first; those not known yet are omitted."""
        with self._call() as workbench:
            return workbench.first_pictures()

    def upload_folder(self) -> Path:
        """Return the folder for uploads."""
        return self._workbench.upload_folder()

    def take_upload(self, path: Path, name: str, what: str, photo: str | None, client: Client | None) -> str:
        """Open an uploaded file; raises `LadarregError`, also if another project was opened during the upload."""
        with self._call() as workbench:
            if path.parent != workbench.upload_folder():
                path.unlink(missing_ok=True)
                raise OptionError("another project was opened during the upload; drop the file again")
            return workbench.take_upload(path, name, what, photo, client)

    def export_file(self, name: str, ending: Ending = "zip") -> tuple[Path, str] | None:
        """Return the last zip or report of that name, and its download name; None before there is one."""
        return self._workbench.export_file(name, ending)

    # projects

    def listed(self) -> dict[str, Any]:
        """Return the recent projects for pages."""
        session = self._workbench.session
        projects = self.recent.listed(session.folder.path, session.document.name, with_paths=self._anywhere)
        return {"projects": projects, "anywhere": self._anywhere, "batch": self._batch is not None}

    def find(self, wanted: object) -> Path | None:
        """Return the folder of a project of the list; None if it is not in it."""
        return self.recent.find(wanted)

    def forget(self, wanted: str) -> Reply:
        """Remove a project from the list; its folder stays."""
        self.recent.forget(wanted)
        return {}

    def new(self, name: str, files: Sequence[str], client: Client, *, sure: bool) -> Reply:
        """Begin a project, and open waiting files of the present one in it."""
        old, folder = self._workbench, self._new_folder(name or "project")

        def opened() -> Workbench:
            new = self._open((), project=folder, name=name, clients=old.clients)
            if files:
                given = old.batches.give(files, new.upload_folder())
                reply = new.batches.open([new.batches.take(path, each) for path, each in given], client=client)
                new.opening_message = " ".join(f"{refused['error']}." for refused in reply["refused"])
            return new

        return self._switch(opened, client, sure=sure)

    def open(self, folder: Path, client: Client, *, sure: bool) -> Reply:
        """Open a project."""
        if folder == self._workbench.session.folder.path:
            return {"opened": self._workbench.project_id}
        if not is_project(folder):
            named = folder if self._anywhere else folder.name
            raise OptionError(
                f"{named} is not a project: it has no project.json; give the folder of a project or a batch"
            )
        clients = self._workbench.clients
        return self._switch(lambda: self._open((), project=folder, clients=clients), client, sure=sure)

    def listed_jobs(self, outcome: str | None, words: str) -> Reply:
        """Return the jobs of the batch for pages; arguments as of `BatchJobs.listed`.

        Raises:
            OptionError: if there is no batch.
        """
        return self._require_batch().listed(outcome, words)

    def open_job(self, wanted: str, client: Client, *, sure: bool) -> Reply:
        """Open a job of the batch as a project, which is begun, and its photographs registered, unless there is one."""
        files, project, reading = self._require_batch().opening(wanted)
        if project == self._workbench.session.folder.path:
            return {"opened": self._workbench.project_id}
        clients, is_new = self._workbench.clients, not is_project(project)

        def opened() -> Workbench:
            try:
                return self._open(files, project=project, name=wanted, reading=reading, clients=clients)
            except BaseException:
                if is_new:  # there is no work in it
                    shutil.rmtree(project, ignore_errors=True)
                raise

        reply = self._switch(opened, client, sure=sure)
        if "asks" not in reply:
            register_unsolved(self._workbench)
        return reply

    def _require_batch(self) -> BatchJobs:
        if self._batch is None:
            raise OptionError("no batch is open; start the workbench on its folder: ladarreg serve FOLDER")
        return self._batch

    def open_path(self, text: str, client: Client, *, sure: bool) -> Reply:
        """Open a project by the path of its folder; of a batch, its list.

        Raises:
            OptionError: if it is not a path of this machine, or pages may not open it.
        """
        folder = Path(os.path.abspath(os.path.expanduser(text)))
        known = self.recent.find(project_id(folder)) is not None
        if not (self._anywhere or known or folder.resolve().is_relative_to((self._data / "projects").resolve())):
            raise OptionError("the workbench can be reached from other machines: only projects of the list are opened")
        if self._anywhere and is_batch_folder(folder, JOBS_RUN):
            self._batch = BatchJobs(folder, self._data / "projects")
            return {"batch": folder.name}
        return self.open(folder, client, sure=sure)

    def open_sample(self, client: Client, *, sure: bool) -> Reply:
        """Open the sample, and register it unless there is work on it."""
        scan, photo, camera = sample_files()

        def opened() -> Workbench:
            return self._open(
                (scan, photo), reading=Reading(camera=camera), name=SAMPLE_NAME, clients=self._workbench.clients
            )

        reply = self._switch(opened, client, sure=sure)
        if "asks" not in reply:
            register_sample(self._workbench)
        return reply

    def duplicate(self, wanted: str) -> Reply:
        """Copy a project of the list, under another name."""
        folder = self.recent.find(wanted)
        session = self._workbench.session
        if folder is None:
            raise OptionError("this project is not in the list any more; reload the page")
        if folder == session.folder.path:
            target = self._duplicate(session.folder, session.history)
        else:
            if not is_project(folder):
                raise OptionError(f"the folder of {folder.name} is missing; nothing can be copied")
            kept = ProjectFolder(folder)
            try:
                target = self._duplicate(kept, kept.read())
            finally:
                kept.close()
        picture = self.recent.picture(wanted)
        if picture is not None:
            self.recent.save_picture(target, picture)
        self.recent.remember(target)
        return {"duplicate": project_id(target)}

    def _duplicate(self, folder: ProjectFolder, history: Any) -> Path:
        name = f"{history.document.name} (copy)"
        target = self._new_folder(name)
        duplicate_project(folder, history, target, name=name, when=now())
        return target

    def close(self) -> None:
        """Close the open project; everything is saved.

        Raises:
            UnsavedError: if some edits are not; it names the folder that the project was saved to instead, if any.
        """
        with self._switching:
            self._wait_for_retired()
            _close(self._workbench)

    # the change of the project

    @contextmanager
    def _call(self) -> Iterator[Workbench]:
        """Yield the open workbench, which is not closed before the block has ended."""
        with self._changed:
            workbench = self._workbench
            self._calls[id(workbench)] += 1
        try:
            yield workbench
        finally:
            with self._changed:
                self._calls[id(workbench)] -= 1
                self._changed.notify_all()

    def _switch(self, opened: Callable[[], Workbench], client: Client, *, sure: bool) -> Reply:
        """Open another project in place of the present one, unless that needs a confirmation.

        The other one is opened first: if that fails, nothing has happened.
        """
        if not self._switching.acquire(blocking=False):
            raise OptionError("another project is just being opened; wait a moment")
        try:
            self._wait_for_retired()  # the project to open may be one of them
            old = self._workbench
            if old.session.unsaved:
                raise OptionError(f"this project is not saved ({old.session.unsaved}); free some space first")
            if not sure and (reasons := _reasons_to_ask(old, client)):
                return {"asks": reasons}
            new = opened()
            try:
                remove_partial_uploads(new.upload_folder())
                self._on_open(new)
                self._enter_in_list(new)
            except BaseException:
                new.close()
                raise
            for each in new.clients.present:
                each.photo = None
            with self._changed:
                self._workbench = new
            new.take_over()
            thread = threading.Thread(target=self._retire, args=(old, new, client.name), name="retiring", daemon=True)
            self._retiring.append(thread)
            thread.start()
            return {"opened": new.project_id}
        finally:
            self._switching.release()

    def _wait_for_retired(self) -> None:
        for thread in self._retiring:
            thread.join(_CALLS_END_S)
        self._retiring = [thread for thread in self._retiring if thread.is_alive()]

    def _retire(self, old: Workbench, new: Workbench, by: str) -> None:
        """Send the pages of a project to the one that replaces it, and close it."""
        time.sleep(_REPLY_IS_SENT_S)  # the page that asked gets its reply first
        old.publish_event({"event": "project", "id": new.project_id, "name": new.session.document.name, "by": by})
        with self._changed:
            self._changed.wait_for(lambda: self._calls[id(old)] == 0, _CALLS_END_S)
            del self._calls[id(old)]
        try:
            _close(old)
        except LadarregError as error:  # says where it was saved instead
            new.publish_notice(as_fields(str(error)), level="bad")
        except Exception:
            log.exception("closing a project")
        finally:
            self._on_close(old)

    def _enter_in_list(self, workbench: Workbench) -> None:
        """List a project, with its picture, as soon as there is something in it."""
        drawn: list[object] = []

        def enter() -> None:
            document = workbench.session.document
            shown = (document.scan, document.photos[0].source if document.photos else None)
            if shown == (None, None) and workbench.is_scratch:
                return
            if drawn != [shown]:
                first = not drawn
                drawn[:] = [shown]
                if first:
                    self.recent.remember(workbench.session.folder.path)
                threading.Thread(target=draw, name="thumbnail", daemon=True).start()

        def draw() -> None:
            try:
                picture = draw_thumbnail(workbench.session.document, workbench.loader, workbench.images)
                if picture is not None:
                    self.recent.save_picture(workbench.session.folder.path, picture)
            except Exception:
                log.exception("the picture of the project")

        def changed(change: Change) -> None:
            enter()

        workbench.session.subscribe(changed)
        enter()

    def _new_folder(self, name: str) -> Path:
        words = re.sub(r"[^\w-]+", "-", name).strip("-")[:40] or "project"
        return self._data / "projects" / f"{words}-{secrets.token_hex(4)}"


def _refuse_other_project() -> Reply:
    raise OptionError(_OTHER_PROJECT)


def _reasons_to_ask(workbench: Workbench, client: Client) -> list[str]:
    """Return what the operator should confirm before the project is closed."""
    reasons = []
    job = workbench.runner.job
    if job is not None and job.runs:
        more = len(workbench.runner.waiting)
        also = f", and {more} more {'waits' if more == 1 else 'wait'}" if more else ""
        reasons.append(f"“{job.label}” is running and would be stopped{also}.")
    others = [each.name for each in workbench.clients.present if each is not client]
    if others and not workbench.is_empty:
        names = ", ".join(others[:3]) + (f" and {len(others) - 3} more" if len(others) > 3 else "")
        reasons.append(f"{names} would see the other project as well.")
    return reasons


def _close(workbench: Workbench) -> None:
    """Close a project; the folder of one that was begun by the program itself, and stayed empty, is removed."""
    folder = workbench.session.folder.path
    is_unused = workbench.is_scratch and workbench.is_empty and workbench.session.history.at == 0
    workbench.close()
    with suppress(OSError):  # what cannot be listed may have files
        if is_unused and not any(files_below(folder / "inputs")):
            shutil.rmtree(folder, ignore_errors=True)
