"""What a page's command is: a struct of its fields, decoded once, with who may send it and what it does."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Protocol

import msgspec
from msgspec import Meta

from ...decoding import decoded

if TYPE_CHECKING:
    from ...jobs.registry import JobRegistry
    from ...jobs.runner import JobRunner
    from ...scene import Scene3D
    from ...session.loader import Loader
    from ...session.session import Session
    from ...slices.events import Event
    from ..acquisition.driving import Acquisition
    from ..files.batches import Batches
    from ..files.embedded import EmbeddedPictures
    from ..files.opening import Files
    from ..state.clients import Client, Clients
    from ..state.measured import Measured
    from ..state.partners import Partners
    from ..state.queries import Queries
    from ..state.selection import Selection
    from ..state.smoothing import Smoothing
    from ..state.stations import Stations

Reply = dict[str, Any]

PhotoId = Annotated[str, Meta(title="the photograph is no longer in the project; choose another")]
PhotoIds = Annotated[list[str], Meta(max_length=10_000, title="the photographs are a list of names")]
StationId = Annotated[str, Meta(title="the station is no longer in the project; choose another")]
Rays = Annotated[list[list[float]], Meta(title="a coordinate of the scan is a ray, three numbers; a line has two")]
Pixels = Annotated[list[list[float]], Meta(title="a coordinate of a picture is two numbers; a line has two of them")]
Ray = Annotated[list[float], Meta(title="a coordinate of the scan is a ray [x, y, z], three numbers")]
Pixel = Annotated[list[float], Meta(title="a coordinate of a picture is [u, v], two numbers")]
Picks = Annotated[list[str], Meta(min_length=1, title="no matches are selected; select some")]
FileIds = Annotated[list[str], Meta(title="no files are given; drop some")]
Side = Annotated[Literal["scan", "photo"], Meta(title="the side is 'scan' or 'photo'")]
ViewIndex = Annotated[int, Meta(ge=0, lt=1000, title="the view is the number of one of the scan's views")]
StepNumber = Annotated[int, Meta(ge=0, lt=2**53, title="a step of the history is a number of 0 or more")]
Positive = Annotated[float, Meta(ge=1e-9, le=1e9, description="a positive number, at most 1e9")]
Plan = Annotated[dict[str, Any], Meta(title="the plan is an object")]


def snake_case(name: str) -> str:
    """Return a class's name as the name of a command."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


class Command(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag=snake_case):
    """A command of a page; its docstring is its row in docs/workbench.md."""

    looks: ClassVar[bool] = False
    """Whether a page that may only look may send it."""
    urgent: ClassVar[bool] = False
    """Whether it waits neither for earlier ones of its page nor for a thread."""
    replies: ClassVar[str] = ""
    """The fields of its reply, for the documentation."""

    @classmethod
    def command_name(cls) -> str:
        """Return its name in messages."""
        return str(cls.__struct_config__.tag)

    @classmethod
    def decode(cls, message: Mapping[str, Any]) -> Any:
        """Return the command of a message; fields that it does not have are ignored.

        Raises:
            OptionError: if a field is missing, or is not of its type or range.
        """
        fields = {name: message[name] for name in cls.__struct_fields__ if name in message}
        return decoded(cls, {"do": cls.command_name(), **fields})


class WorkbenchCommand(Command, frozen=True):
    """A command on the open project."""

    def execute(self, context: Context, client: Client) -> Reply:
        """Execute it and return the fields of the reply; raises `LadarregError`."""
        raise NotImplementedError


class Context(Protocol):
    """The parts of the workbench that commands use."""

    session: Session
    loader: Loader
    selection: Selection
    clients: Clients
    queries: Queries
    files: Files
    batches: Batches
    embedded: EmbeddedPictures
    runner: JobRunner
    jobs: JobRegistry
    acquisition: Acquisition
    stations: Stations
    measured: Measured
    smoothing: Smoothing
    partners: Partners

    def set_model(self, client: Client, wanted: Mapping[str, Any]) -> None:
        """Change the display of the model for a client."""

    def show_smoothing(self) -> None:
        """Show previews of smoothed ranges as they are now."""

    @property
    def scene(self) -> Scene3D | None:
        """The 3-D scene, once it is attached."""

    def list_served(self) -> None:
        """List the served folder again."""

    def publish_event(self, event: Event, *, to: set[str] | None = None) -> None:
        """Send an event to all clients, or to some by their ids."""

    def notify_others(self, client: Client, text: str) -> None:
        """Show a sentence to all other clients."""


def commands_in(namespace: Mapping[str, Any], kind: Any) -> dict[str, Any]:
    """Return the commands of a kind that a module defines, by name; classes that others extend do not execute."""
    found: list[Any] = [one for one in namespace.values() if isinstance(one, type) and issubclass(one, kind)]
    here = [one for one in found if one.__module__ == namespace["__name__"]]
    return {one.command_name(): one for one in here if one.execute is not kind.execute}
