"""The commands by which people see each other at work: pointers in the pictures, and following another's view."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from ladarreg_core.errors import OptionError
from ladarreg_core.project import edits

from .clients import Client, Clients

Fields = Mapping[str, Any]
Reply = dict[str, Any]
_SIDES = ("scan", "photo")
_MAX_VIEWS = 1000


class People(Protocol):
    """The parts of the workbench that these commands use."""

    clients: Clients

    def tell(self, event: Reply, to: set[str]) -> None:
        """Send an event to clients by their ids."""


def follow(context: People, client: Client, fields: Fields) -> Reply:
    """Follow another client's view, or nobody's."""
    context.clients.follow(client, fields.get("client"))
    return {}


def point(context: People, client: Client, fields: Fields) -> Reply:
    """Show the client's pointer to the others; without a position it disappears."""
    others = {other.id for other in context.clients.present} - {client.id}
    if others:
        context.tell({"event": "cursor", "client": client.id, **_position(fields, "uv")}, others)
    return {}


def show_view(context: People, client: Client, fields: Fields) -> Reply:
    """Show the client's part of a picture to those who follow."""
    followers = {other.id for other in context.clients.present if other.follows == client.id} - {client.id}
    zoom = edits.finite(fields.get("zoom"))
    if zoom is None or not 1e-6 <= zoom <= 1e6:
        raise OptionError("the zoom must be a positive number, relative to the whole picture")
    if followers:
        context.tell({"event": "view", "client": client.id, "zoom": zoom, **_position(fields, "centre")}, followers)
    return {}


PEOPLE_COMMANDS = (follow, point, show_view)


def _position(fields: Fields, name: str) -> Reply:
    side, view, photo = fields.get("side"), fields.get("view", 0), fields.get("photo")
    if side not in _SIDES:
        raise OptionError("the side is 'scan' or 'photo'")
    if isinstance(view, bool) or not isinstance(view, int) or not 0 <= view < _MAX_VIEWS:
        raise OptionError("the view is the number of one of the scan's views")
    at = fields.get(name)
    uv = None if at is None else list(edits.pixels([at])[0])
    return {"side": side, "view": view, "photo": photo if isinstance(photo, str) else None, name: uv}
