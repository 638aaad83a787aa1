"""Types of the events that pages receive (docs/workbench.md)."""

from __future__ import annotations

from typing import Literal, NotRequired, TypedDict

from .photographs import Numbers

NoticeLevel = Literal["info", "warn", "bad"]


class SimplexEvent(TypedDict):
    """An iteration of the simplex."""

    event: Literal["simplex"]
    photo: str
    iteration: int
    move: str
    parameters: Numbers
    camera_from_scanner: list[Numbers]
    cost: float
    inliers: int
    matches: int
    residual: str
    round: int
    predicted: dict[str, list[Numbers | None]]
    last: bool


class HoverEvent(TypedDict):
    """A client has clicked on a match in its 3-D view."""

    event: Literal["hover"]
    client: str
    photo: str | None
    pick: str


class PictureEvent(TypedDict):
    """What another person does in a picture."""

    client: str
    side: Literal["scan", "photo"]
    view: int
    photo: str | None
    station: str


class CursorEvent(PictureEvent):
    """Another person's pointer."""

    event: Literal["cursor"]
    uv: Numbers | None


class ViewEvent(PictureEvent):
    """The part of a picture that the person sees whom this client follows."""

    event: Literal["view"]
    centre: Numbers | None
    zoom: float


class FlownEvent(TypedDict):
    """This client has clicked on a camera in its 3-D view."""

    event: Literal["flown"]
    photo: str


class PlacementEvent(TypedDict):
    """This client has dragged the camera that it places by hand."""

    event: Literal["placement"]
    photo: str
    camera_from_scanner: list[Numbers]


class NoticeEvent(TypedDict):
    """A sentence for people."""

    event: Literal["notice"]
    level: NoticeLevel
    text: str
    photo: NotRequired[str]


class ProjectEvent(TypedDict):
    """Another project was opened."""

    event: Literal["project"]
    id: str
    name: str
    by: str


class ExportReadyEvent(TypedDict):
    """A zip or a report is written."""

    event: Literal["export_ready"]
    targets: list[str]
    name: str
    url: str


Event = (
    SimplexEvent | HoverEvent | CursorEvent | ViewEvent | FlownEvent | PlacementEvent | NoticeEvent | ProjectEvent
    | ExportReadyEvent
)  # fmt: skip
"""Any of them."""
