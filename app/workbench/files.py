"""Files that are added to the project: uploads, and files of a served folder."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import msgspec

from ladarreg_core.errors import OptionError
from ladarreg_core.project import edits
from ladarreg_core.project.document import CameraGiven, Document, PhotoEntry, Source
from ladarreg_core.project.history import NOBODY, Author

from ..session.loader import Loader
from ..session.session import Session
from .clients import Client
from .queries import Queries
from .reading import with_reading
from .selection import Selection

What = Literal["scan", "photo", "camera", "matches"]
_MAX_SERVED = 2000
_MAX_DEPTH = 4


class Files:
    """Checks files and adds them to the document.

    Args:
        session: the session.
        loader: its loader.
        queries: checks cameras.
        selection: the photograph that each client sees.
        served: a folder whose files clients may open; None: none.
    """

    def __init__(
        self, session: Session, loader: Loader, queries: Queries, selection: Selection, served: Path | None
    ) -> None:
        self._session = session
        self._loader = loader
        self._queries = queries
        self._selection = selection
        self._served = served.resolve() if served else None
        self._listed: list[dict[str, Any]] = []
        self.list_served()

    def take(self, path: Path, name: str, what: str, photo: str | None, client: Client | None) -> str:
        """Open an uploaded file; one that is refused is deleted, unless the project already uses it.

        Raises:
            LadarregError: if it is not of the stated kind.
        """
        try:
            return self.open(path, name, what, photo, client)
        except BaseException:
            if not self.is_in_project(path):
                path.unlink(missing_ok=True)
            raise

    def open_served(
        self, path: str, what: str, photo: str | None, client: Client | None, reading: Mapping[str, Any] | None = None
    ) -> str:
        """Open a file of the served folder; `reading` as for `open`.

        Raises:
            LadarregError: if it does not exist, or is not of the stated kind.
        """
        if self._served is None:
            raise OptionError("no folder is served; restart with --folder, or upload the file")
        offered = self._offered(self._served / path)
        if offered is None:  # files that are not listed must not be read: errors of the readers quote contents
            raise OptionError("there is no such file in the served folder; refresh the list")
        wanted, _ = offered
        return self.open(wanted, wanted.name, what, photo, client, reading)

    def open(
        self,
        path: Path,
        name: str,
        what: str,
        photo: str | None,
        client: Client | None,
        reading: Mapping[str, Any] | None = None,
    ) -> str:
        """Add a file to the project; return `scan` or the id of its photograph.

        Args:
            path: the file.
            name: its name for display.
            what: its kind of content.
            photo: id of the photograph that it belongs to, if any.
            client: who opens it.
            reading: options of `read_scan` for a scan, `temperature_unit` for a photograph, `camera_name` for a camera.

        Raises:
            LadarregError: if it is not of the stated kind, or there is no photograph that it could belong to.
        """
        if what not in get_args(What):
            raise OptionError(f"a file can be opened as {', '.join(get_args(What))}; got {what[:40]!r}")
        if not _is_unicode(name) or not _is_unicode(str(path)):
            raise OptionError("the name of the file or of its folder is not valid Unicode; rename it")
        try:
            size = path.stat().st_size
        except OSError as error:
            raise OptionError(f"the file cannot be read: {error.strerror or error}; choose another") from None
        source = Source(path=self._session.folder.relative(path), name=name, size=size)
        if what == "scan":
            return self._scan(with_reading(source, reading or {}), client)
        if what == "photo":
            unit = (reading or {}).get("temperature_unit")
            return self._photo(msgspec.structs.replace(source, temperature_unit=unit), client)
        entry = self._target_photo(photo, client)
        if what == "camera":
            camera = CameraGiven(file=source, name=(reading or {}).get("camera_name"))
            self._queries.check_camera(entry, camera)
            self._edit(entry, f"Camera file {name}", lambda p: edits.with_camera(p, camera), client)
            return entry.id
        return self._matches(path, name, entry, client)

    def _scan(self, source: Source, client: Client | None) -> str:
        session = self._session
        self._loader.preload_scan(source)  # before the commit: a scan without views would keep all clients from joining
        name = session.document.name

        def edit(document: Document) -> Document:
            found = edits.with_scan(document, source)
            return found if name != "untitled" else msgspec.structs.replace(found, name=Path(source.name).stem)

        session.commit(f"Open scan {source.name}", edit, author=_author(client))
        return "scan"

    def _photo(self, source: Source, client: Client | None) -> str:
        # A photograph without a camera is accepted: the page then requests the focal length.
        self._loader.preload_photo(PhotoEntry(id="trial", source=source))
        made = ""

        def edit(document: Document) -> Document:
            nonlocal made
            document, made = edits.with_photo(document, source)
            return document

        self._session.commit(f"Open photo {source.name}", edit, author=_author(client))
        self._selection.show(client, made)
        return made

    def _matches(self, path: Path, name: str, entry: PhotoEntry, client: Client | None) -> str:
        scan = self._loader.scan(self._session.document)
        if scan is None:
            raise OptionError("matches need a scan; open the scan first")
        picks = [replace(pick, origin="file") for pick in self._loader.read_matches(path, scan)]
        self._edit(entry, f"Read {len(picks)} matches from {name}", lambda p: edits.with_picks(p, picks)[0], client)
        return entry.id

    def is_in_project(self, path: Path) -> bool:
        """Return whether any step of the history refers to a file."""
        session = self._session
        name = session.folder.relative(path)
        for document in {id(entry.document): entry.document for entry in session.history.entries}.values():
            sources = [document.scan, *(s for p in document.photos for s in (p.source, p.camera.file))]
            if any(source is not None and source.path == name for source in sources):
                return True
        return False

    def _target_photo(self, photo: str | None, client: Client | None) -> PhotoEntry:
        if photo:
            return edits.require_photo(self._session.document, photo)
        shown = self._selection.photo_of(client)
        if shown is None:
            raise OptionError("this file belongs to a photograph; open the photograph first")
        return shown

    def _edit(
        self, entry: PhotoEntry, label: str, edit: Callable[[PhotoEntry], PhotoEntry], client: Client | None
    ) -> None:
        self._session.commit(label, lambda d: edits.edited_photo(d, entry.id, edit), author=_author(client))

    def list_served(self) -> None:
        """List the served folder again."""
        if self._served is None:
            return
        found: list[dict[str, Any]] = []
        for folder, below, names in os.walk(self._served):
            here = Path(folder)
            depth = len(here.relative_to(self._served).parts)
            below[:] = sorted(name for name in below if not _is_hidden(here / name)) if depth < _MAX_DEPTH else []
            for name in sorted(names):
                path = here / name
                offered = self._offered(path)
                if offered is None:
                    continue
                target, kind = offered
                try:
                    size = target.stat().st_size
                except OSError:
                    continue
                found.append({"path": path.relative_to(self._served).as_posix(), "size": size, "kind": kind})
            if len(found) > _MAX_SERVED:
                break
        self._listed = found[:_MAX_SERVED]

    def _offered(self, path: Path) -> tuple[Path, str] | None:
        """Return the target of a path below the served folder, and its kind; None if clients may not open it.

        They may open files of a known kind, unless any part of the path, or of the target of a link, is hidden.
        """
        from ladarreg_core.formats import listed_kind

        served = self._served
        if served is None or not _is_unicode(str(path)):
            return None
        try:
            target = path.resolve()
            for way in (path, target):
                steps = way.relative_to(served).parts
                if any(_is_hidden(served.joinpath(*steps[: k + 1])) for k in range(len(steps))):
                    return None
            kind = listed_kind(target) if target.is_file() else None
        except (OSError, ValueError, RuntimeError):  # not a path, outside the folder, or a cycle of links
            return None
        return None if kind is None or kind not in get_args(What) else (target, kind)

    def served_slice(self) -> dict[str, Any] | None:
        """Return the served files; None where no folder is served."""
        return None if self._served is None else {"label": self._served.name, "files": self._listed}


def _author(client: Client | None) -> Author:
    return client.author if client else NOBODY


def _is_hidden(path: Path) -> bool:
    """Return whether a file or folder is hidden by a leading dot, or on Windows by an attribute."""
    if path.name.startswith("."):
        return True
    try:
        return bool(getattr(path.lstat(), "st_file_attributes", 0) & stat.FILE_ATTRIBUTE_HIDDEN)
    except OSError:
        return True


def _is_unicode(name: str) -> bool:
    """Return whether a name is valid Unicode: on some systems file names are arbitrary bytes."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True
