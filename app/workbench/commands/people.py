"""The commands by which people see each other at work: pointers in the pictures, and following another's view."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar

from msgspec import Meta

from ladarreg_core.project import edits

from .command import Context, Pixel, Reply, Side, ViewIndex, WorkbenchCommand

if TYPE_CHECKING:
    from ...slices.events import PictureEvent
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

    def of_picture(self, context: Context, client: Client) -> PictureEvent:
        """Return the client and the picture, of the scan with the station that it is of."""
        shown = context.selection.photo_of(client)
        station = shown.station if shown is not None and self.side == "scan" else ""
        return {"client": client.id, "side": self.side, "view": self.view, "photo": self.photo, "station": station}


def _place(at: list[float] | None) -> list[float] | None:
    return None if at is None else list(edits.pixels([at])[0])


class Point(PictureCommand, frozen=True):
    """shows this client's pointer to the others; null: none"""

    looks: ClassVar[bool] = True
    uv: Pixel | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Show it."""
        others = {other.id for other in context.clients.present} - {client.id}
        uv = _place(self.uv)
        if others:
            context.publish_event({"event": "cursor", **self.of_picture(context, client), "uv": uv}, to=others)
        return {}


class ShowView(PictureCommand, frozen=True, kw_only=True):
    """shows this client's part of a picture to those who follow; the zoom is relative to the whole picture"""

    looks: ClassVar[bool] = True
    zoom: Annotated[float, Meta(ge=1e-6, le=1e6, title=_ZOOM)]
    centre: Pixel | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Show it."""
        followers = {other.id for other in context.clients.present if other.follows == client.id} - {client.id}
        centre = _place(self.centre)
        if followers:
            picture = self.of_picture(context, client)
            context.publish_event({"event": "view", **picture, "centre": centre, "zoom": self.zoom}, to=followers)
        return {}
