"""Opens the workbench on a project, on files to start a project with, or on the start page, and serves it."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import secrets
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ladarreg_core.errors import LadarregError, OptionError

from ..exit_codes import ExitCode
from ..process_resources import freeze_loaded_objects
from ..session.isolated_readers import READERS
from ..session.loader import DEFAULT_CACHE_BYTES, Loader
from ..session.session import Session, now
from ..stop_signals import StopSignals, exit_now, print_error
from .acquisition.watchable import SIMULATED_ONLY, Watchable
from .given_files import Reading, add_files, add_survey, survey_given

if TYPE_CHECKING:
    import viser

    from ladarreg_core.frames import Rigid
    from ladarreg_core.project.storage.folder import ProjectFolder

    from ..gateway.options import GatewayOptions
    from ..gateway.tokens import Tokens
    from ..gateway.viser_backend import ViserAddress
    from .batch_jobs import BatchJobs
    from .state.clients import Clients
    from .workbench import Workbench

log = logging.getLogger(__name__)
_SCRATCH, _MAX_SCRATCH = "untitled", 50
_VISER_OPENS_S = 60.0
_SAVED_WITHIN_S = 10.0


def open_workbench(
    inputs: Sequence[Path],
    *,
    project: Path | None = None,
    folder: Path | None = None,
    watchable: Watchable = SIMULATED_ONLY,
    upload_bytes: int = 2 << 30,
    cache_bytes: int = DEFAULT_CACHE_BYTES,
    name: str = "",
    reading: Reading | None = None,
    clients: Clients | None = None,
    solve_automatically: bool = True,
    check: Callable[[], None] = lambda: None,
) -> Workbench:
    """Open a workbench; the caller closes it.

    Args:
        inputs: a project folder, a survey, or a scan and photographs; empty: an empty project, whose page is the start
            page.
        project: folder of the project; None: a folder in the user's data.
        folder: folder whose files clients may open.
        watchable: what plans of acquisitions may watch, beside that folder.
        upload_bytes: the largest upload.
        cache_bytes: the largest size of what is kept for reuse, besides the scan.
        name: name of a project that is started with a scan and photographs; empty: that of the scan.
        reading: what is known about the scan and the photographs, beyond their files; None: nothing.
        clients: the clients of the workbench that this one replaces; None: it is the first.
        solve_automatically: whether matches are solved after edits, where the project's settings want it.
        check: called between files; may raise `Cancelled`.

    Raises:
        LadarregError: if a file cannot be opened, or another program has the project open.
        Cancelled: if `check` raised it; the files opened before are saved.
    """
    from ladarreg_core.project.document import Document
    from ladarreg_core.project.history import History
    from ladarreg_core.project.storage.folder import ProjectFolder, is_project
    from ladarreg_core.project.storage.leftovers import remove_leftovers

    from .workbench import Workbench

    said = reading or Reading()
    given = [Path(os.path.abspath(path)) for path in inputs]
    for path in given:
        if not path.exists():
            raise OptionError(f"{path}: no such file; give a project folder, or a scan and photographs")
    old = given[0] if len(given) == 1 and is_project(given[0]) else None
    survey = survey_given(given[0]) if old is None and len(given) == 1 else None
    if old is None and survey is None and len(given) == 1 and given[0].is_dir():
        raise OptionError(_no_project(given[0]))
    files = [] if old else given
    if not files and not said.is_empty:
        raise OptionError("the options of scans and photographs need them: give SCAN PHOTO with the options")
    is_scratch = project is None and not given
    where = project or old or (_project_folder(files[0], name) if files else None)
    kept = ProjectFolder(where) if where else _scratch_folder()
    try:
        if kept.begun:
            history = kept.read()
            when = history.present.when[:16].replace("T", " ")
            message = "" if is_scratch else f"Reopened {history.document.name}, last edited at {when}."
        else:
            history = History.begun(Document(name=name or "untitled"), label="Begin", author="", when=now())
            kept.begin(history)
            message = ""
        remove_leftovers(kept.path)
        session = Session(kept, history, elsewhere=_fallback_folders(kept.path))
        workbench = Workbench(
            session,
            Loader(kept, cache_bytes=cache_bytes),
            upload_bytes=upload_bytes,
            served=folder,
            watchable=watchable,
            clients=clients,
            solve_automatically=solve_automatically,
        )
        workbench.is_scratch = is_scratch
    except BaseException:
        kept.close()
        raise
    try:
        check()
        if survey is None:
            workbench.opening_remarks = add_files(workbench, files, said, check)
        else:
            add_survey(workbench, survey, said, check)
    except BaseException:
        workbench.close()
        raise
    workbench.opening_message = " ".join([message, *(f"{one}." for one in workbench.opening_remarks)]).strip()
    return workbench


def _no_project(folder: Path) -> str:
    """Return why a folder cannot be opened, and what can be."""
    from ladarreg_core.foundations.shell_command import shell_command
    from ladarreg_core.storage.replacement import RIG_FILE

    rig = folder / RIG_FILE
    try:
        fields = json.loads(rig.read_text(encoding="utf-8"))
        names = ", ".join(str(pair["name"]) for pair in fields["pairs"])
        start = ["--initial", str(rig)] if fields["accepted"] else []
    except (OSError, ValueError, KeyError, TypeError):
        return (
            f"{folder} is not a project: it has no project.json, and not both a scan and photos; give a project "
            "folder, a folder with scans and photos, or a scan"
        )
    return (
        f"{folder} is the result of a rig, on the pairs {names}; open one of them by its own files: "
        f"{shell_command(['ladarreg', 'serve', 'SCAN', 'PHOTO', '--camera', 'FILE', *start])}"
    )


@dataclass(frozen=True, slots=True)
class TokenChoice:
    """Which access tokens to use: by default those that are kept for the port."""

    chosen: str | None = None
    """The operator's own token for editing."""
    renew: bool = False
    """Replace the kept tokens."""


def batch_given(inputs: Sequence[Path]) -> BatchJobs | None:
    """Return the batch whose folder is given in place of files; None: something else is.

    Raises:
        FormatError: if it does not record its list.
    """
    from ladarreg_core.batches.jobs.run_folder import JOBS_RUN
    from ladarreg_core.batches.photos.folder import is_batch_folder

    from .batch_jobs import BatchJobs

    if len(inputs) != 1 or not is_batch_folder(inputs[0], JOBS_RUN):
        return None
    return BatchJobs(Path(os.path.abspath(inputs[0])), data_folder() / "projects")


def serve_and_close(
    workbench: Workbench,
    *,
    batch: BatchJobs | None = None,
    tokens: TokenChoice,
    options: GatewayOptions,
    browser: bool,
    stop: StopSignals,
    folder: Path | None = None,
    watchable: Watchable = SIMULATED_ONLY,
) -> None:
    """Serve a workbench until a stop signal, and close it.

    The page and its images are served first: viser takes most of a second to load.

    Args:
        workbench: the workbench.
        batch: whose jobs the start page lists; None: it lists projects only.
        tokens: which access tokens to use.
        options: where to listen.
        browser: whether to open a browser.
        folder: folder whose files clients may open; None: none.
        watchable: what plans of acquisitions may watch, beside that folder.
        stop: the stop signals; a second, later one ends the process as soon as everything is saved.

    Raises:
        OptionError: if there is no such address, no free port, or no such certificate.
        DependencyError: if this version of viser cannot be locked.
        UnsavedError: if there are edits that the project's disk did not take.
    """
    from ..gateway.server import serve_until_interrupted
    from .desk import Desk

    for sentence in (*workbench.session.folder.remarks, *workbench.opening_remarks):
        print(f"ladarreg: {sentence}", file=sys.stderr)
    scenes = _SceneServers()
    desk = Desk(
        workbench,
        open_workbench=partial(
            open_workbench,
            folder=folder,
            watchable=watchable,
            upload_bytes=workbench.limits.upload_bytes,
            cache_bytes=workbench.loader.cache_bytes,
        ),
        data=data_folder(),
        anywhere=options.on_loopback and not options.behind_proxy,
        batch=batch,
        on_open=scenes.open_soon,
        on_close=scenes.close_of,
    )
    stop.on_second_request(lambda: _save_and_exit(desk.workbench.session))

    def tokens_for(port: int) -> Tokens:
        from ..gateway.tokens import kept_tokens

        folder = data_folder() / "tokens"
        where: int | str | None = port if options.port else None
        if options.socket is not None:
            where = f"socket-{hashlib.sha256(os.fsencode(os.path.abspath(options.socket))).hexdigest()[:16]}"
        found = kept_tokens(folder, where, chosen=tokens.chosen, renew=tokens.renew)
        workbench.clients.read_only_token = found.look
        return found

    def open_viser() -> None:
        scenes.open(workbench)
        freeze_loaded_objects()

    try:
        serve_until_interrupted(
            desk, scenes.address, tokens=tokens_for, options=options, browser=browser, stop=stop, then=open_viser
        )
    finally:
        scenes.refuse()
        READERS.close()
        try:
            desk.close()
        finally:
            scenes.close()


class _SceneServers:
    """viser's servers: every project has its own, so that nothing of the former one remains in the 3-D views."""

    def __init__(self) -> None:
        self._address: Future[ViserAddress] = Future()
        self._servers: dict[int, viser.ViserServer] = {}

    def address(self) -> ViserAddress:
        """Return the address of the open project's server; blocks until it is open."""
        return self._address.result(_VISER_OPENS_S)

    def open(self, workbench: Workbench) -> None:
        """Open the server of a project."""
        from ..gateway.viser_backend import open_locked_server

        address = self._address
        server, found = open_locked_server(label="ladarreg")
        self._servers[id(workbench)] = server
        _attach_scene(workbench, server)
        if not address.done():
            address.set_result(found)

    def open_soon(self, workbench: Workbench) -> None:
        """Open the server of another project, in a thread; 3-D views wait for it."""
        self._address = Future()
        threading.Thread(target=self.open, args=(workbench,), name="viser", daemon=True).start()

    def close_of(self, workbench: Workbench) -> None:
        """Close the server of a project that is closed."""
        from ..gateway.viser_backend import close_server

        server = self._servers.pop(id(workbench), None)
        if server is not None:
            close_server(server)

    def refuse(self) -> None:
        """End the requests that wait for a 3-D view."""
        if not self._address.done():
            self._address.set_exception(ConnectionError("the workbench was closed"))

    def close(self) -> None:
        """Close all servers."""
        from ..gateway.viser_backend import close_server

        for server in self._servers.values():
            close_server(server)


def _save_and_exit(session: Session) -> None:
    """Save and exit without waiting for clients and jobs."""
    failures: list[str] = []
    # In a thread: a disk that hangs must not block the exit.
    saving = threading.Thread(target=lambda: failures.append(session.save_now()), name="saving", daemon=True)
    saving.start()
    saving.join(_SAVED_WITHIN_S)
    if not failures or failures[0]:
        reason = (
            failures[0]
            if failures
            else f"the last edits are not saved: the disk did not respond within {_SAVED_WITHIN_S:g} s"
        )
        print_error(f"ladarreg: stopped at once; {reason}")
        exit_now(ExitCode.FAILED)
    print_error("ladarreg: stopped at once; everything is saved")
    exit_now(ExitCode.INTERRUPTED)


def _attach_scene(workbench: Workbench, server: viser.ViserServer) -> None:
    from ..gateway.viser_backend import client_id_of
    from ..scene import Scene3D

    def clicked(person: str, pick_id: str) -> None:
        client = workbench.clients.find(person)
        shown = workbench.selection.photo_of(client)
        photo = shown.id if shown else None
        workbench.publish_event({"event": "hover", "client": person, "photo": photo, "pick": pick_id})

    def dragged(person: str, draft: Rigid) -> None:
        shown = workbench.selection.photo_of(workbench.clients.find(person))
        if shown is not None:
            pose = draft @ workbench.queries.place_beside(shown)  # it was known when the camera was placed
            place = pose.matrix.tolist()
            workbench.publish_event(
                {"event": "placement", "photo": shown.id, "camera_from_scanner": place}, to={person}
            )

    def camera_clicked(person: str, photo: str) -> None:
        client = workbench.clients.find(person)
        if client is not None:
            workbench.selection.show(client, photo)
            workbench.publish_event({"event": "flown", "photo": photo}, to={person})

    person_of = partial(client_id_of, server)
    workbench.attach_scene(Scene3D(server, clicked, person_of=person_of, on_camera=camera_clicked, on_draft=dragged))


def data_folder() -> Path:
    """Return the folder of the user's data."""
    chosen = os.environ.get("LADARREG_HOME")
    if chosen:
        return Path(chosen)
    import platformdirs

    return Path(platformdirs.user_data_dir("ladarreg", appauthor=False))


def _fallback_folders(project: Path) -> tuple[Path, ...]:
    """Return folders to save a project to if its own cannot be written, the most permanent first."""
    import tempfile

    homes = []
    with suppress(RuntimeError, OSError):
        homes.append(Path.home())
    return (data_folder() / "projects", *homes, project.parent, Path(tempfile.gettempdir()))


def _project_folder(scan: Path, name: str) -> Path:
    """Return the project folder of a scan; always the same for the same file, so that earlier work is found."""
    digest = hashlib.sha256(os.fsencode(scan)).hexdigest()[:8]
    words = "".join(c if c.isalnum() or c in "-_" else "-" for c in name or scan.stem)[:40]
    return data_folder() / "projects" / f"{words}-{digest}"


def _scratch_folder() -> ProjectFolder:
    """Return the folder of an empty project that no other program has open."""
    from ladarreg_core.project.storage.folder import ProjectFolder, is_project
    from ladarreg_core.project.summary import read_summary

    place = data_folder() / "projects"
    for number in range(1, _MAX_SCRATCH):
        path = place / (_SCRATCH if number == 1 else f"{_SCRATCH}-{number}")
        try:
            if not is_project(path) or (read_summary(path).is_empty and not any((path / "inputs").iterdir())):
                return ProjectFolder(path)
        except (LadarregError, OSError) as error:  # damaged, or open in another program
            log.debug("%s: %s", path, error)
    return ProjectFolder(place / f"{_SCRATCH}-{secrets.token_hex(4)}")
