"""Files that are added to the project: uploads, and files of a served folder."""

from __future__ import annotations

import filecmp
import os
import stat
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import msgspec

from ladarreg_core.errors import OptionError
from ladarreg_core.project import edits
from ladarreg_core.project.document import CameraGiven, Document, PhotoEntry
from ladarreg_core.project.history import NOBODY, Author
from ladarreg_core.project.source import Source
from ladarreg_core.project.station_edits import scans_of, with_stations

from ...session.isolated_readers import READERS
from ...session.loader import Loader
from ...session.session import Session
from ..state.clients import Client
from ..state.queries import Queries
from ..state.selection import Selection
from .reading import with_reading

if TYPE_CHECKING:
    from ladarreg_core.formats.file_info import FileKind

    from ...slices.project import Served, ServedFile

What = Literal["scan", "photo", "camera", "matches", "station"]
HowScans = Literal["replace", "frames", "stations"]
"""What becomes of scans that are opened in a project: one scan in place of its scan, accumulated if they are several;
frames of the same standpoint as its scan, accumulated with it; or further stations."""
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
        self._listed: list[ServedFile] = []
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

    def served_file(self, path: str) -> Path:
        """Return a file of the served folder.

        Raises:
            OptionError: if there is none, or clients may not open it.
        """
        if self._served is None:
            raise OptionError("no folder is served; restart with --folder, or upload the file")
        offered = self._offered(self._served / path)
        if offered is None:  # files that are not listed must not be read: errors of the readers quote contents
            raise OptionError("there is no such file in the served folder; refresh the list")
        return offered[0]

    def asks_how(self, names: Sequence[str]) -> dict[str, Any] | None:
        """Return the question what becomes of scans: none if it is the first one of the project, and alone."""
        if len(names) < 2 and self._session.document.scan is None:
            return None
        return {"asks": "scan", "scan": names[0], "scans": list(names)}

    def open(
        self,
        path: Path,
        name: str,
        what: str,
        photo: str | None,
        client: Client | None,
        reading: Mapping[str, Any] | None = None,
    ) -> str:
        """Add a file to the project; return `scan`, `stations` or the id of its photograph.

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
        if what in ("scan", "station"):
            return self.open_scans([(path, name)], "replace" if what == "scan" else "stations", client, reading)
        source = self._source(path, name)
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

    def open_scans(
        self,
        files: Sequence[tuple[Path, str]],
        how: HowScans,
        client: Client | None,
        reading: Mapping[str, Any] | None = None,
    ) -> str:
        """Open scans in one step of the history; return `scan` or `stations`.

        Args:
            files: the files with their names for display, the first one first; one or more.
            how: what becomes of them; without a scan in the project the first one is opened, and the others are
                accumulated with it or added as its stations.
            client: who opens them.
            reading: options of `read_scan`; frames of the project's scan are read as it was.

        Raises:
            LadarregError: if one cannot be read, is part of the project already, or is a frame that was plainly taken
                from elsewhere; nothing is changed then.
        """
        if how == "stations":
            return self._stations(files, client, reading or {})
        if how == "frames" and self._session.document.scan is not None:
            return self._accumulate(files, client)
        (path, name), *others = _distinct(files, [])
        more = tuple(self._source(*other).path for other in others)
        source = with_reading(self._source(path, name), reading or {})
        source = msgspec.structs.replace(source, more=more, more_names=tuple(other for _, other in others))
        return self._scan(source, client)

    def _source(self, path: Path, name: str) -> Source:
        if not _is_unicode(name) or not _is_unicode(str(path)):
            raise OptionError("the name of the file or of its folder is not valid Unicode; rename it")
        try:
            size = path.stat().st_size
        except OSError as error:
            raise OptionError(f"the file cannot be read: {error.strerror or error}; choose another") from None
        return Source(path=self._session.folder.relative(path), name=name, size=size)

    def _scan(self, source: Source, client: Client | None) -> str:
        session = self._session
        self._loader.preload_scan(source)  # before the commit: a scan without views would keep all clients from joining
        session.commit(f"Open scan {_counted(source)}", partial(_with_scan, scan=source), author=_author(client))
        return "scan"

    def _accumulate(self, files: Sequence[tuple[Path, str]], client: Client | None) -> str:
        """Accumulate frames of its standpoint with the project's scan; matches, photographs and poses stay."""
        document, folder = self._session.document, self._session.folder
        assert document.scan is not None, "checked before"
        there = list(zip(folder.source_files(document.scan), document.scan.names, strict=True))
        new = _distinct(files, there)
        if not new:
            every = "is" if len(files) == 1 else "and all others are"
            raise OptionError(f"{files[0][1]} {every} part of the scan already; add frames that are not")
        paths, names = [self._source(*file).path for file in new], [name for _, name in new]
        grown = edits.with_more_clouds(document, paths, names).scan
        assert grown is not None, "otherwise refused"
        self._loader.preload_scan(grown)
        label = f"Add frame {names[0]}" if len(names) == 1 else f"Add {len(names)} frames"
        self._session.commit(label, lambda d: edits.with_more_clouds(d, paths, names), author=_author(client))
        return "scan"

    def _stations(self, files: Sequence[tuple[Path, str]], client: Client | None, reading: Mapping[str, Any]) -> str:
        """Add all scans of files as further stations; in a project without a scan the first one becomes its scan."""
        from ladarreg_core.formats import survey_file

        sources: list[Source] = []
        for path, name in files:
            source = with_reading(self._source(path, name), reading)
            count = len(READERS.run(survey_file, path).scans) or 1
            sources += [source] if count == 1 else [msgspec.structs.replace(source, index=k) for k in range(count)]
        before = self._session.document
        there = scans_of(before)

        def edit(document: Document) -> Document:
            if document.scan is not None:
                return with_stations(document, sources)
            document = _with_scan(document, sources[0])
            return with_stations(document, sources[1:]) if sources[1:] else document

        after = edit(before)  # refuses before anything is read
        if before.scan is None:
            self._loader.preload_scan(sources[0])
        for each in after.stations:
            if each.source not in there:
                self._loader.station_points(each.source)
        count = len(sources)
        of = f" of {files[0][1]}" if len(files) == 1 else ""
        label = f"Add station {files[0][1]}" if count == 1 else f"Add {count} stations{of}"
        self._session.commit(label, edit, author=_author(client))
        return "stations"

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
        scan = self._loader.scan(self._session.document.beside(entry))
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
            photos = [*document.photos, *(photo for station in document.stations for photo in station.photos)]
            sources = [*scans_of(document), *(s for p in photos for s in (p.source, p.camera.file))]
            if any(source is not None and name in source.paths for source in sources):
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
        found: list[ServedFile] = []
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

    def _offered(self, path: Path) -> tuple[Path, FileKind] | None:
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

    def served_slice(self) -> Served | None:
        """Return the served files; None where no folder is served."""
        return None if self._served is None else {"label": self._served.name, "files": self._listed}


def _with_scan(document: Document, scan: Source) -> Document:
    """Return the document with another scan, which names a project that has no name."""
    found = edits.with_scan(document, scan)
    return found if document.name != "untitled" else msgspec.structs.replace(found, name=Path(scan.name).stem)


def _counted(source: Source) -> str:
    others = len(source.more)
    return source.name if not others else f"{source.name} and {others} more"


def _distinct(files: Sequence[tuple[Path, str]], there: Sequence[tuple[Path, str]]) -> list[tuple[Path, str]]:
    """Return the files whose content is not that of another of them, or of one that is there.

    A cloud that is uploaded twice would count twice in the scan.
    """
    found: list[tuple[Path, str]] = []
    for path, name in files:
        if not any(_same_content(path, other) for other, _ in (*there, *found)):
            found.append((path, name))
    return found


def _same_content(one: Path, two: Path) -> bool:
    try:
        with one.open("rb") as file:
            is_descriptor = file.read(1) == b"{"  # what it describes is in the images beside it
        return one == two if is_descriptor else filecmp.cmp(one, two, shallow=False)  # sizes are compared first
    except OSError:
        return one == two


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
