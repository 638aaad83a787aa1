"""The commands that open files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, get_args

from msgspec import Meta

from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.project import edits

from ...argument_names import as_fields
from ..files.opening import HowScans
from ..files.reading import reading_of
from .command import Context, FileIds, Reply, WorkbenchCommand

if TYPE_CHECKING:
    from ..state.clients import Client

How = Annotated[HowScans, Meta(title=f"scans are opened as {', '.join(get_args(HowScans))}; choose one of them")]
Reading = Annotated[dict[str, Any], Meta(title="how the scan is to be read is not a list of options; reload the page")]
_NO_FILE = "give the file to open and its kind"


class ListServed(WorkbenchCommand, frozen=True):
    """lists the served folder again"""

    def execute(self, context: Context, client: Client) -> Reply:
        """List it."""
        context.list_served()
        return {}


class OpenServed(WorkbenchCommand, frozen=True):
    """opens a file of the served folder, `path`, or several scans together, `paths`, which is a step of the history;
    `what` is `scan`, `photo`, `camera`, `matches` or `station`; `reading` and `scan` as for `open_files`
    """

    replies: ClassVar[str] = "opened | asks, scans"
    what: Annotated[str, Meta(title=_NO_FILE)]
    path: Annotated[str, Meta(title=_NO_FILE)] | None = None
    paths: Annotated[list[str], Meta(min_length=1, title=_NO_FILE)] | None = None
    photo: str | None = None
    reading: Reading | None = None
    scan: How | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Open it."""
        named = self.paths or ([] if self.path is None else [self.path])
        if not named:
            raise OptionError(_NO_FILE)
        reading, files = reading_of(self.reading), context.files
        found = [(path, path.name) for path in map(files.served_file, dict.fromkeys(named))]
        if self.what == "scan":
            asked = files.asks_how([name for _, name in found])
            if asked and self.scan is None:
                return asked
            try:
                return {"opened": files.open_scans(found, self.scan or "replace", client, reading)}
            except LadarregError as error:
                if asked is None:
                    raise
                return {**asked, "said": as_fields(str(error))}
        if self.what == "station":
            return {"opened": files.open_scans(found, "stations", client, reading)}
        if len(found) > 1:
            raise OptionError("only scans are opened together; open the others one by one")
        ((path, name),) = found
        return {"opened": files.open(path, name, self.what, self.photo, client, reading)}


class OpenFiles(WorkbenchCommand, frozen=True):
    """opens uploaded files together, and the waiting ones that they complete; `scan`: what becomes of the scans among
    them (see below); cameras and matches belong to `photo`, if given; `reading` states what the file of the scan does
    not
    """

    replies: ClassVar[str] = "opened, refused, waiting, asks?, scan?, scans?, said?"
    files: FileIds
    scan: How | None = None
    photo: str | None = None
    reading: Reading | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Open them."""
        photo = None if self.photo is None else edits.require_photo(context.session.document, self.photo).id
        reading = reading_of(self.reading)
        return context.batches.open(self.files, scans=self.scan, photo=photo, reading=reading, client=client)


class AddEmbedded(WorkbenchCommand, frozen=True):
    """adds pictures of the scan's file as photographs, with the cameras that it states"""

    replies: ClassVar[str] = "photos"
    images: Annotated[list[int], Meta(min_length=1, title="no pictures are chosen; choose some of the scan's")]

    def execute(self, context: Context, client: Client) -> Reply:
        """Add them."""
        return {"photos": context.embedded.add(self.images, client)}


class DiscardFiles(WorkbenchCommand, frozen=True):
    """deletes uploaded files that wait"""

    files: FileIds

    def execute(self, context: Context, client: Client) -> Reply:
        """Delete them."""
        context.batches.discard(self.files)
        return {}
