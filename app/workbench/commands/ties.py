"""The commands on the ties that are drawn between two photographs, and on the lines that are drawn in several."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, ClassVar

from msgspec import Meta

from ladarreg_core.project import tie_edits
from ladarreg_core.survey.parts import DRAWN_SIGMA_PX

from .command import Context, Positive, Reply, WorkbenchCommand
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
