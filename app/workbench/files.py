"""Files that become part of the project: uploads, and those of a served folder."""

from __future__ import annotations

import os
import stat
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import msgspec

from ladarreg_core.errors import OptionError
from ladarreg_core.project import edits
from ladarreg_core.project.document import CameraGiven, Document, PhotoEntry, Source

if TYPE_CHECKING:
    from .workbench import Workbench

What = Literal["scan", "photo", "camera", "matches"]
_MOST_SERVED = 2000
_DEEPEST = 4


class Files:
    """Checks files and makes them sources of the document."""

    def __init__(self, workbench: Workbench, served: Path | None) -> None:
        self._workbench = workbench
        self._served = served.resolve() if served else None
        self._listed: list[dict[str, Any]] = []
        self.look_again()

    def take(self, path: Path, name: str, what: str, photo: str | None, author: str) -> str:
        """Open a file that was uploaded; where it is refused it is removed, but never once it is in the project.

        Raises:
            LadarregError: if it is not what it is said to be.
        """
        try:
            return self.open(path, name, what, photo, author)
        except BaseException:
            if not self._is_of_the_project(path):
                path.unlink(missing_ok=True)
            raise

    def open_served(self, path: str, what: str, photo: str | None, author: str) -> str:
        """Open a file of the served folder.

        Raises:
            LadarregError: if it is not there, or not what it is said to be.
        """
        if self._served is None:
            raise OptionError("no folder is served; start with --folder, or upload the file")
        offered = self._offered(self._served / path)
        if offered is None:  # by the rule of the list: a reader's error quotes what it found
            raise OptionError("there is no such file in the served folder; look again")
        wanted, _ = offered
        return self.open(wanted, wanted.name, what, photo, author)

    def open(self, path: Path, name: str, what: str, photo: str | None, author: str) -> str:
        """Make a file part of the project and return the id of what it became part of.

        Raises:
            LadarregError: if it is not what it is said to be, or there is no photograph that it belongs to.
        """
        if what not in get_args(What):
            raise OptionError(f"a file is opened as {', '.join(get_args(What))}")
        if not _is_text(name) or not _is_text(str(path)):
            raise OptionError("the file's name, or its folder's, is no Unicode text; rename it")
        try:
            size = path.stat().st_size
        except OSError as error:
            raise OptionError(f"the file cannot be read: {error.strerror or error}; choose another") from None
        source = Source(path=self._workbench.session.folder.relative(path), name=name, size=size)
        if what == "scan":
            return self._scan(source, author)
        if what == "photo":
            return self._photo(source, author)
        entry = self._photo_meant(photo)
        if what == "camera":
            camera = CameraGiven(file=source)
            self._workbench.check_camera(entry, camera)
            self._edit(entry, f"Camera file {name}", lambda p: edits.with_camera(p, camera), author)
            return entry.id
        return self._matches(path, name, entry, author)

    def _scan(self, source: Source, author: str) -> str:
        room, session = self._workbench.room, self._workbench.session
        room.try_scan(source)  # before the commit: a scan that cannot be viewed would keep everybody out
        name = session.document.name

        def edit(document: Document) -> Document:
            found = edits.with_scan(document, source)
            return found if name != "untitled" else msgspec.structs.replace(found, name=Path(source.name).stem)

        session.commit(f"Open scan {source.name}", edit, author=author)
        return "scan"

    def _photo(self, source: Source, author: str) -> str:
        # Without a camera it is a picture all the same: the page asks for the focal length.
        self._workbench.room.try_photo(PhotoEntry(id="trial", source=source))
        made = ""

        def edit(document: Document) -> Document:
            nonlocal made
            document, made = edits.with_photo(document, source)
            return document

        self._workbench.session.commit(f"Open photograph {source.name}", edit, author=author)
        self._workbench.show_photo(made)
        return made

    def _matches(self, path: Path, name: str, entry: PhotoEntry, author: str) -> str:
        room = self._workbench.room
        scan = room.scan(self._workbench.session.document)
        if scan is None:
            raise OptionError("matches belong to a scan; open the scan first")
        picks = [replace(pick, origin="file") for pick in room.read_matches(path, scan)]
        self._edit(entry, f"Read {len(picks)} matches of {name}", lambda p: edits.with_picks(p, picks)[0], author)
        return entry.id

    def _is_of_the_project(self, path: Path) -> bool:
        """Return whether any step of the history refers to a file."""
        session = self._workbench.session
        name = session.folder.relative(path)
        for document in {id(entry.document): entry.document for entry in session.history.entries}.values():
            sources = [document.scan, *(s for p in document.photos for s in (p.source, p.camera.file))]
            if any(source is not None and source.path == name for source in sources):
                return True
        return False

    def _photo_meant(self, photo: str | None) -> PhotoEntry:
        if photo:
            return edits.the_photo(self._workbench.session.document, photo)
        shown = self._workbench.shown
        if shown is None:
            raise OptionError("it belongs to a photograph; open the photograph first")
        return shown

    def _edit(self, entry: PhotoEntry, label: str, edit: Any, author: str) -> None:
        self._workbench.session.commit(label, lambda d: edits.edited_photo(d, entry.id, edit), author=author)

    def look_again(self) -> None:
        """List the served folder anew."""
        if self._served is None:
            return
        found: list[dict[str, Any]] = []
        for folder, below, names in os.walk(self._served):
            here = Path(folder)
            depth = len(here.relative_to(self._served).parts)
            below[:] = sorted(name for name in below if not _is_hidden(here / name)) if depth < _DEEPEST else []
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
            if len(found) > _MOST_SERVED:
                break
        self._listed = found[:_MOST_SERVED]

    def _offered(self, path: Path) -> tuple[Path, str] | None:
        """Return the file that a path below the served folder means, and its kind; None where it is not for the page.

        A file is for the page where nothing on the way to it is hidden, by its own name and by that of what a link
        leads to, and where it is of a kind that can be opened.
        """
        from ladarreg_core.formats import listed_kind

        served = self._served
        if served is None or not _is_text(str(path)):
            return None
        try:
            target = path.resolve()
            for way in (path, target):
                steps = way.relative_to(served).parts
                if any(_is_hidden(served.joinpath(*steps[: k + 1])) for k in range(len(steps))):
                    return None
            kind = listed_kind(target) if target.is_file() else None
        except (OSError, ValueError, RuntimeError):  # no path at all, one that leads out of the folder, or in circles
            return None
        return None if kind is None or kind not in get_args(What) else (target, kind)

    def served_slice(self) -> dict[str, Any] | None:
        """Return the served files; None where no folder is served."""
        return None if self._served is None else {"label": self._served.name, "files": self._listed}


def _is_hidden(path: Path) -> bool:
    """Return whether a file or folder is one that its owner does not show: by a dot, or on Windows by an attribute."""
    if path.name.startswith("."):
        return True
    try:
        return bool(getattr(path.lstat(), "st_file_attributes", 0) & stat.FILE_ATTRIBUTE_HIDDEN)
    except OSError:
        return True


def _is_text(name: str) -> bool:
    """Return whether a name can be written and sent: on some systems a file's name is any bytes."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True
