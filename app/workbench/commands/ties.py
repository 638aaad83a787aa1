"""The commands on the ties that are drawn between two photographs, and on the lines that are drawn in several."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, ClassVar

from msgspec import Meta
from msgspec.structs import replace

from ladarreg_core.errors import OptionError
from ladarreg_core.project import tie_edits
from ladarreg_core.project.drawn import ScanLineEntry
from ladarreg_core.project.edits import rays
from ladarreg_core.project.station_edits import partner_of
from ladarreg_core.survey.parts import DRAWN_SIGMA_PX

from .command import Context, PhotoId, Positive, Rays, Reply, StationId, WorkbenchCommand
from .matches import step_reply

if TYPE_CHECKING:
    from ladarreg_core.project.document import Document

    from ..state.clients import Client

TiePhotos = Annotated[list[str], Meta(min_length=2, max_length=2, title="a tie is of two photographs; choose two")]
TiePixels = Annotated[
    list[list[float]],
    Meta(min_length=2, max_length=2, title="a tie has a pixel [u, v] in each of its two photographs; draw both"),
]
LineEnds = Annotated[
    list[list[float]],
    Meta(min_length=2, max_length=2, title="a line has two ends in a photograph, each a pixel [u, v]; draw both"),
]
Sigma = Annotated[float, Meta(ge=0, le=0.2, description="a number of radians, from 0 to 0.2")]
LineIds = Annotated[list[str], Meta(min_length=1, title="no lines are selected; select some")]
TieIds = Annotated[list[str], Meta(min_length=1, title="no ties are selected; select some")]


class AddTie(WorkbenchCommand, frozen=True):
    """keeps a place that two photographs show, at a pixel `uv` in each, known to `sigma_px`, 1 unless it is said"""

    replies: ClassVar[str] = "tie"
    photos: TiePhotos
    uv: TiePixels
    sigma_px: Positive = DRAWN_SIGMA_PX

    def execute(self, context: Context, client: Client) -> Reply:
        """Keep it."""
        made = ""

        def edit(document: Document) -> Document:
            nonlocal made
            found, entry = tie_edits.with_tie(document, self.photos, self.uv, self.sigma_px)
            made = entry.id
            return found

        number = context.session.commit("Draw a tie", edit, author=client.author)
        return {"tie": made, **step_reply(number)}


class RemoveTies(WorkbenchCommand, frozen=True):
    """removes ties that were drawn"""

    ties: TieIds

    def execute(self, context: Context, client: Client) -> Reply:
        """Remove them."""
        wanted = frozenset(self.ties)
        ids = [entry.id for entry in context.session.document.ties if entry.id in wanted]
        label = "Remove a tie" if len(ids) == 1 else f"Remove {len(ids)} ties"
        change = partial(tie_edits.without_ties, ids=ids)
        return step_reply(context.session.commit(label, change, author=client.author))


class DrawLine(WorkbenchCommand, frozen=True):
    """keeps both ends `uv` of a straight edge in a photograph; of `line`, if that is drawn in a further one or again"""

    replies: ClassVar[str] = "line"
    photo: str
    uv: LineEnds
    line: str | None = None
    sigma_px: Positive = DRAWN_SIGMA_PX

    def execute(self, context: Context, client: Client) -> Reply:
        """Keep it."""
        made = self.line

        def edit(document: Document) -> Document:
            nonlocal made
            if self.line is not None:
                return tie_edits.with_line_in(document, self.line, self.photo, self.uv)
            found, entry = tie_edits.with_line(document, [self.photo], [self.uv], self.sigma_px)
            made = entry.id
            return found

        label = "Draw a line" if self.line is None else f"Draw line {self.line.removeprefix('l')} further"
        number = context.session.commit(label, edit, author=client.author)
        return {"line": made, **step_reply(number)}


class DrawLineInScan(WorkbenchCommand, frozen=True):
    """keeps both ends of a straight edge in the scan of a station (empty: the project's), `scan` with two rays: of
    `line`, if that is drawn already, in place of what a scan showed of it; `sigma_rad` as in `measure`; `notes` say
    what is doubtful
    """

    replies: ClassVar[str] = "line, notes"
    scan: Rays
    station: StationId = ""
    line: str | None = None
    sigma_rad: Sigma = 0.0
    sigma_px: Positive = DRAWN_SIGMA_PX

    def execute(self, context: Context, client: Client) -> Reply:
        """Measure it in the scan, and keep it."""
        from ladarreg_core.inspection.measuring.scan_line import line_in_scan

        ends = rays(self.scan)
        if len(ends) != 2:
            raise OptionError("a line has two ends in a scan, each a ray [x, y, z]; draw both")
        if self.line is not None:
            tie_edits.require_line(context.session.document, self.line)
        source = partner_of(context.session.document, self.station)
        scan = None if source is None else context.loader.scan(replace(context.session.document, scan=source))
        if source is None or scan is None:
            raise OptionError("there is no scan to draw a line in; open one")
        found = line_in_scan(scan, ends, sigma_rad=self.sigma_rad)
        first, second = ((x, y, z) for x, y, z in found.xyz.tolist())
        entry = ScanLineEntry(source=source, xyz=(first, second), sigma_m=found.sigma_m)
        made = ""

        def edit(document: Document) -> Document:
            nonlocal made
            changed, drawn = tie_edits.with_line_in_scan(document, self.line, entry, self.sigma_px)
            made = drawn.id
            return changed

        label = "Draw a line in a scan" if self.line is None else f"Draw line {self.line.removeprefix('l')} in a scan"
        number = context.session.commit(label, edit, author=client.author)
        return {"line": made, "notes": list(found.notes), **step_reply(number)}


class ScanOf(WorkbenchCommand, frozen=True):
    """the scan of a station (empty: the project's), as in the slice `scan`, null without one: to draw lines in"""

    looks: ClassVar[bool] = True
    replies: ClassVar[str] = "scan"
    station: StationId = ""

    def execute(self, context: Context, client: Client) -> Reply:
        """Return it."""
        return {"scan": context.queries.scan_of(self.station)}


class EraseLine(WorkbenchCommand, frozen=True):
    """removes what a photograph, or without one the scan, shows of a line, which goes with the last of them"""

    line: str
    photo: PhotoId | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Remove it there."""
        label = f"Erase line {self.line.removeprefix('l')} in {'a scan' if self.photo is None else 'a photograph'}"
        change = partial(tie_edits.without_line_in, line=self.line, photo=self.photo)
        return step_reply(context.session.commit(label, change, author=client.author))


class LineEndsAsTies(WorkbenchCommand, frozen=True):
    """keeps the ends of a line that two photographs show as two ties, in place of the line: both show the same ends"""

    line: str

    def execute(self, context: Context, client: Client) -> Reply:
        """Keep them."""
        label = f"Ends of line {self.line.removeprefix('l')} as ties"
        change = partial(tie_edits.with_line_as_ties, line=self.line)
        return step_reply(context.session.commit(label, change, author=client.author))


class RemoveLines(WorkbenchCommand, frozen=True):
    """removes lines that were drawn"""

    lines: LineIds

    def execute(self, context: Context, client: Client) -> Reply:
        """Remove them."""
        wanted = frozenset(self.lines)
        ids = [entry.id for entry in context.session.document.lines if entry.id in wanted]
        label = "Remove a line" if len(ids) == 1 else f"Remove {len(ids)} lines"
        change = partial(tie_edits.without_lines, ids=ids)
        return step_reply(context.session.commit(label, change, author=client.author))
