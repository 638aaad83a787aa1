"""Opens the workbench on what the command line names: a project, files to begin one with, or the last project."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.process_resources import keep_what_is_loaded
from app.session import Session, now
from app.workroom import Workroom
from ladarreg_core.errors import LadarregError, OptionError

if TYPE_CHECKING:
    import viser

    from app.gateway.options import GatewayOptions
    from app.viser_lock import ViserAddress
    from app.workbench import Workbench

_PROJECT = "project.json"
_LAST = "last.json"
_VISER_OPENS_S = 60.0


def open_workbench(
    inputs: Sequence[Path],
    *,
    project: Path | None = None,
    folder: Path | None = None,
    upload_bytes: int = 2 << 30,
    name: str = "",
    camera: Path | None = None,
) -> Workbench:
    """Open a workbench; whoever opens it closes it.

    Args:
        inputs: a project's folder, or a scan and photographs; nothing: the last project, or an empty one.
        project: where to keep the project; None: among the user's own data.
        folder: whose files are offered in the page.
        upload_bytes: the largest upload.
        name: of the project that scan and photographs begin; empty: the scan's.
        camera: a camera file for the photographs that are new.

    Raises:
        LadarregError: if a file cannot be opened, or another program has the project open.
    """
    from app.workbench import Workbench
    from ladarreg_core.project.document import Document
    from ladarreg_core.project.folder import ProjectFolder
    from ladarreg_core.project.history import History

    given = [Path(os.path.abspath(path)) for path in inputs]
    for path in given:
        if not path.exists():
            raise OptionError(f"{path}: there is no such file; give a project's folder, or a scan and photographs")
    old = given[0] if len(given) == 1 and (given[0] / _PROJECT).is_file() else None
    if old is None and len(given) == 1 and given[0].is_dir():
        raise OptionError(f"{given[0]} is no project: it has no {_PROJECT}; give the folder of a project, or a scan")
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
        session = Session(kept, history)
        workbench = Workbench(session, Workroom(kept), upload_bytes=upload_bytes, served=folder)
    except BaseException:
        kept.close()
        raise
    try:
        _add(workbench, files, camera)
    except BaseException:
        workbench.close()
        raise
    _remember(kept.path)
    workbench.said_at_start = said
    return workbench


def serve_and_close(workbench: Workbench, *, token: str, options: GatewayOptions, browser: bool) -> None:
    """Serve a workbench until Ctrl-C, and close it.

    The page and the pictures come first: viser takes a good part of a second to load, and is asked for last.

    Args:
        workbench: what to serve.
        token: what opens the page.
        options: where to listen.
        browser: whether to open a browser, too.

    Raises:
        OptionError: if there is no such address, no free port, or no such certificate.
        DependencyError: if this version of viser cannot be locked.
    """
    from app.gateway.serving import serve_until_interrupted

    where: Future[ViserAddress] = Future()
    opened: list[viser.ViserServer] = []

    def open_viser() -> None:
        from app.viser_server import open_locked_server

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
            then=open_viser,
        )
    finally:
        if not where.done():  # whoever waits for the 3-D view need wait no longer
            where.set_exception(ConnectionError("the workbench was closed"))
        workbench.close()
        for server in opened:
            from app.viser_server import close_server

            close_server(server)


def _add(workbench: Workbench, files: Sequence[Path], camera: Path | None) -> None:
    """Open what is not in the project yet."""
    if not files:
        return
    document, place = workbench.session.document, workbench.session.folder
    scan, *photos = files
    if document.scan is None or place.source_path(document.scan.path) != scan:
        workbench.files.open(scan, scan.name, "scan", None, "")
    there = {place.source_path(photo.source.path) for photo in workbench.session.document.photos}
    for photo in photos:
        if photo not in there:
            made = workbench.files.open(photo, photo.name, "photo", None, "")
            if camera is not None:
                workbench.files.open(camera, camera.name, "camera", made, "")


def _attach(workbench: Workbench, server: viser.ViserServer) -> None:
    from app.stage3d import Stage3D

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


def _place_of(scan: Path, name: str) -> Path:
    """Return where the project of a scan is kept: the same for the same file, so that work on it is found again."""
    mark = hashlib.sha256(os.fsencode(scan)).hexdigest()[:8]
    words = "".join(c if c.isalnum() or c in "-_" else "-" for c in name or scan.stem)[:40]
    return data_folder() / "projects" / f"{words}-{mark}"


def _last_project() -> Path:
    """Return the project that was open last, or the place of an empty one."""
    try:
        last = Path(json.loads((data_folder() / _LAST).read_text(encoding="utf-8"))["project"])
        if (last / _PROJECT).is_file():
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
