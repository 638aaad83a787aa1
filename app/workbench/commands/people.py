"""The commands by which people see each other at work: pointers in the pictures, and following another's view."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar

from msgspec import Meta

from ladarreg_core.project import edits

from .command import Context, Pixel, Reply, Side, ViewIndex, WorkbenchCommand

if TYPE_CHECKING:
    from ..state.clients import Client

_ZOOM = "the zoom must be a positive number, relative to the whole picture"


class Follow(WorkbenchCommand, frozen=True):
    """shows this client the photograph that another one sees, and, by events, the part of the pictures; null: nobody's;
    `show_photo` ends it
    """

    looks: ClassVar[bool] = True
    client: Annotated[str, Meta(title="this person is not connected any more; choose another")] | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Follow it."""
        context.clients.follow(client, self.client)
        return {}


class PictureCommand(WorkbenchCommand, frozen=True):
    """A command on a place in a picture."""

    side: Side
    photo: str | None = None
    view: ViewIndex = 0

    def place(self, context: Context, client: Client, name: str, at: list[float] | None) -> Reply:
        """Return the picture, of the scan with the station that it is of, and the place under a name."""
        uv = None if at is None else list(edits.pixels([at])[0])
        shown = context.selection.photo_of(client)
        station = shown.station if shown is not None and self.side == "scan" else ""
        return {"side": self.side, "view": self.view, "photo": self.photo, "station": station, name: uv}


class Point(PictureCommand, frozen=True):
    """shows this client's pointer to the others; null: none"""

    looks: ClassVar[bool] = True
    uv: Pixel | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Show it."""
        others = {other.id for other in context.clients.present} - {client.id}
        if others:
            context.tell({"event": "cursor", "client": client.id, **self.place(context, client, "uv", self.uv)}, others)
        return {}


class ShowView(PictureCommand, frozen=True, kw_only=True):
    """shows this client's part of a picture to those who follow; the zoom is relative to the whole picture"""

    looks: ClassVar[bool] = True
    zoom: Annotated[float, Meta(ge=1e-6, le=1e6, title=_ZOOM)]
    centre: Pixel | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Show it."""
        followers = {other.id for other in context.clients.present if other.follows == client.id} - {client.id}
        place = self.place(context, client, "centre", self.centre)
        if followers:
            context.tell({"event": "view", "client": client.id, "zoom": self.zoom, **place}, followers)
        return {}
