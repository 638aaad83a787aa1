"""Opens the workbench on what the command line names: a project, files to begin one with, or the last project."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import LadarregError, OptionError

from ..exit_codes import ExitCode
from ..process_resources import keep_what_is_loaded
from ..session.isolated_readers import READERS
from ..session.loader import Workroom
from ..session.session import Session, now
from ..stop_signals import StopSignals, exit_now, say

if TYPE_CHECKING:
    import viser

    from ..gateway.options import GatewayOptions
    from ..gateway.viser_lock import ViserAddress
    from .workbench import Workbench

_LAST = "last.json"
_VISER_OPENS_S = 60.0
_SAVED_WITHIN_S = 10.0


def open_workbench(
    inputs: Sequence[Path],
    *,
    project: Path | None = None,
    folder: Path | None = None,
    upload_bytes: int = 2 << 30,
    name: str = "",
    camera: Path | None = None,
    check: Callable[[], None] = lambda: None,
) -> Workbench:
    """Open a workbench; whoever opens it closes it.

    Args:
        inputs: a project's folder, or a scan and photographs; nothing: the last project, or an empty one.
        project: where to keep the project; None: among the user's own data.
        folder: whose files are offered in the page.
        upload_bytes: the largest upload.
        name: of the project that scan and photographs begin; empty: the scan's.
        camera: a camera file for the photographs that are new.
        check: called between files; may raise `Cancelled`.

    Raises:
        LadarregError: if a file cannot be opened, or another program has the project open.
        Cancelled: if `check` raised it; what was opened before is saved.
    """
    from ladarreg_core.project.document import Document
    from ladarreg_core.project.folder import ProjectFolder, is_project
    from ladarreg_core.project.history import History
    from ladarreg_core.project.leftovers import remove_leftovers

    from .workbench import Workbench

    given = [Path(os.path.abspath(path)) for path in inputs]
    for path in given:
        if not path.exists():
            raise OptionError(f"{path}: there is no such file; give a project's folder, or a scan and photographs")
    old = given[0] if len(given) == 1 and is_project(given[0]) else None
    if old is None and len(given) == 1 and given[0].is_dir():
        raise OptionError(f"{given[0]} is no project: it has no project.json; give the folder of a project, or a scan")
    files = [] if old else given
    where = project or old or (_place_of(files[0], name) if files else _last_project())
    kept = ProjectFolder(where)
    try:
        if kept.begun:
            history = kept.read()
            when = history.present.when[:16].replace("T", " ")
            said = f"Opened {history.document.name} again, as it was left at {when}."
        else:
            history = History.begun(Document(name=name or "untitled"), label="Begin", author="", when=now())
            kept.begin(history)
            said = ""
        remove_leftovers(kept.path)
        session = Session(kept, history, elsewhere=_other_places(kept.path))
        workbench = Workbench(session, Workroom(kept), upload_bytes=upload_bytes, served=folder)
    except BaseException:
        kept.close()
        raise
    try:
        check()
        _add(workbench, files, camera, check)
    except BaseException:
        workbench.close()
        raise
    _remember(kept.path)
    workbench.said_at_start = said
    return workbench


def serve_and_close(
    workbench: Workbench, *, token: str, options: GatewayOptions, browser: bool, stop: StopSignals
) -> None:
    """Serve a workbench until a signal asks to stop, and close it.

    The page and the pictures come first: viser takes a good part of a second to load, and is asked for last.

    Args:
        workbench: what to serve.
        token: what opens the page.
        options: where to listen.
        browser: whether to open a browser, too.
        stop: receives the signals; one that comes again later ends the process as soon as everything is saved.

    Raises:
        OptionError: if there is no such address, no free port, or no such certificate.
        DependencyError: if this version of viser cannot be locked.
        UnsavedError: if there are edits that the project's disk did not take.
    """
    from ..gateway.serving import serve_until_interrupted

    for sentence in workbench.session.folder.remarks:
        print(f"ladarreg: {sentence}", file=sys.stderr)
    where: Future[ViserAddress] = Future()
    opened: list[viser.ViserServer] = []
    stop.end_at_once_by(lambda: _save_and_exit(workbench.session))

    def open_viser() -> None:
        from ..gateway.viser_backend import open_locked_server

        server, address = open_locked_server(label="ladarreg")
        opened.append(server)
        _attach(workbench, server)
        where.set_result(address)
        keep_what_is_loaded()

    try:
        serve_until_interrupted(
            workbench,
            partial(where.result, _VISER_OPENS_S),
            token=token,
            options=options,
            browser=browser,
            stop=stop,
            then=open_viser,
        )
    finally:
        if not where.done():  # whoever waits for the 3-D view need wait no longer
            where.set_exception(ConnectionError("the workbench was closed"))
        READERS.close()
        try:
            workbench.close()
        finally:
            for server in opened:
                from ..gateway.viser_backend import close_server

                close_server(server)


def _save_and_exit(session: Session) -> None:
    """Save, and end the process without waiting for pages and jobs."""
    lost: list[str] = []
    # Not here: a disk that hangs must not keep the process.
    saving = threading.Thread(target=lambda: lost.append(session.save_now()), name="saving", daemon=True)
    saving.start()
    saving.join(_SAVED_WITHIN_S)
    if not lost or lost[0]:
        reason = lost[0] if lost else f"the last changes are not saved: no disk answered within {_SAVED_WITHIN_S:g} s"
        say(f"ladarreg: ended at once; {reason}")
        exit_now(ExitCode.FAILED)
    say("ladarreg: ended at once; everything is saved")
    exit_now(ExitCode.INTERRUPTED)


def _add(workbench: Workbench, files: Sequence[Path], camera: Path | None, check: Callable[[], None]) -> None:
    """Open what is not in the project yet."""
    if not files:
        return
    document, place = workbench.session.document, workbench.session.folder
    scan, *photos = files
    if document.scan is None or place.source_path(document.scan.path) != scan:
        workbench.files.open(scan, scan.name, "scan", None, "")
    there = {place.source_path(photo.source.path) for photo in workbench.session.document.photos}
    for photo in photos:
        check()
        if photo not in there:
            made = workbench.files.open(photo, photo.name, "photo", None, "")
            if camera is not None:
                workbench.files.open(camera, camera.name, "camera", made, "")


def _attach(workbench: Workbench, server: viser.ViserServer) -> None:
    from ..scene import Stage3D

    class Actions:
        """What the 3-D scene's controls do."""

        def set_model(self, **wanted: Any) -> None:
            workbench.set_model({name: value for name, value in wanted.items() if value is not None})

        def job_control(self, action: str, value: float | None = None) -> None:
            try:
                workbench.runner.control(action, value)
            except LadarregError as error:
                workbench.notice(str(error), level="warn")

        def hover(self, pick_id: str | None) -> None:
            shown = workbench.shown
            workbench.tell_event({"event": "hover", "photo": shown.id if shown else None, "pick": pick_id})

    workbench.attach_stage(Stage3D(server, Actions()))


def data_folder() -> Path:
    """Return where the user's own projects are kept."""
    chosen = os.environ.get("LADARREG_HOME")
    if chosen:
        return Path(chosen)
    import platformdirs

    return Path(platformdirs.user_data_dir("ladarreg", appauthor=False))


def _other_places(project: Path) -> tuple[Path, ...]:
    """Return where a project may be written whose own folder takes nothing more; what lasts comes first."""
    import tempfile

    homes = []
    with suppress(RuntimeError, OSError):
        homes.append(Path.home())
    return (data_folder() / "projects", *homes, project.parent, Path(tempfile.gettempdir()))


def _place_of(scan: Path, name: str) -> Path:
    """Return where the project of a scan is kept: the same for the same file, so that work on it is found again."""
    mark = hashlib.sha256(os.fsencode(scan)).hexdigest()[:8]
    words = "".join(c if c.isalnum() or c in "-_" else "-" for c in name or scan.stem)[:40]
    return data_folder() / "projects" / f"{words}-{mark}"


def _last_project() -> Path:
    """Return the project that was open last, or the place of an empty one."""
    from ladarreg_core.project.folder import is_project

    try:
        last = Path(json.loads((data_folder() / _LAST).read_text(encoding="utf-8"))["project"])
        if is_project(last):
            return last
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return data_folder() / "projects" / "untitled"


def _remember(project: Path) -> None:
    try:
        folder = data_folder()
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _LAST).write_text(json.dumps({"project": str(project)}), encoding="utf-8")
    except OSError:
        return  # it is only a convenience
