"""What a page's command is: a struct of its fields, decoded once, with who may send it and what it does."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    Protocol,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec
from msgspec import Meta, UnsetType

from ladarreg_core.errors import OptionError
from ladarreg_core.project.edits import finite

if TYPE_CHECKING:
    from ..jobs.registry import JobRegistry
    from ..jobs.runner import JobRunner
    from ..scene import Scene3D
    from ..session.loader import Loader
    from ..session.session import Session
    from .acquisition import Acquisition
    from .batches import Batches
    from .clients import Client, Clients
    from .embedded import EmbeddedPictures
    from .files import Files
    from .queries import Queries
    from .selection import Selection
    from .stations import Stations

Reply = dict[str, Any]
Kind = TypeVar("Kind", bound=msgspec.Struct)
_MAX_QUOTE = 40
_PLACE = re.compile(r" - at `\$\.(\w+)[^`]*`$")
_MISSING = re.compile(r"missing required field `(\w+)`")

PhotoId = Annotated[str, Meta(title="the photograph is no longer in the project; choose another")]
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

    def set_model(self, client: Client, wanted: Mapping[str, Any]) -> None:
        """Change the display of the model for a client."""

    @property
    def scene(self) -> Scene3D | None:
        """The 3-D scene, once it is attached."""

    def list_served(self) -> None:
        """List the served folder again."""

    def tell(self, event: dict[str, Any], to: set[str]) -> None:
        """Send an event to clients by their ids."""

    def tell_others(self, client: Client, text: str) -> None:
        """Show a sentence to all other clients."""


def decoded(kind: type[Kind], fields: Mapping[str, Any]) -> Kind:
    """Return a struct of fields.

    Raises:
        OptionError: if a field is missing, or is not of its type or range.
    """
    try:
        return msgspec.convert(fields, kind)
    except msgspec.ValidationError as error:
        raise OptionError(_fault(kind, fields, str(error))) from None
    except (UnicodeEncodeError, OverflowError, RecursionError):
        raise OptionError("a field contains no text or number that can be read; enter it again") from None


def commands_in(namespace: Mapping[str, Any], kind: Any) -> dict[str, Any]:
    """Return the commands of a kind that a module defines, by name; classes that others extend do not execute."""
    found: list[Any] = [one for one in namespace.values() if isinstance(one, type) and issubclass(one, kind)]
    here = [one for one in found if one.__module__ == namespace["__name__"]]
    return {one.command_name(): one for one in here if one.execute is not kind.execute}


def quoted(value: object) -> str:
    """Return a short quotation of any value for an error message."""
    if isinstance(value, str):
        return repr(value[:_MAX_QUOTE])
    number = finite(value)
    if number is not None and not isinstance(value, bool):
        return f"{number:g}"
    words: dict[type, str] = {type(None): "missing", bool: str(value).lower(), list: "a list", dict: "an object"}
    return words.get(type(value), "not a finite number")


def types_of(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the types of a struct's fields, with their annotations, in the order in which they are stated."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: hints[name] for name in kind.__struct_fields__}


def without_meta(kind: Any) -> tuple[Any, Meta | None]:
    """Return a type without the annotations around it, and these; of an optional type those of what it may be."""
    if get_origin(kind) is Annotated:
        return get_args(kind)[0], get_args(kind)[1]
    for part in get_args(kind) if is_union(kind) else ():
        if get_origin(part) is Annotated:
            return kind, get_args(part)[1]
    return kind, None


def is_union(kind: Any) -> bool:
    """Return whether a type is one of several."""
    return get_origin(kind) is Union or type(kind).__name__ == "UnionType"


def _fault(kind: type[msgspec.Struct], fields: Mapping[str, Any], error: str) -> str:
    """Return what was found and what is needed, in place of the decoder's words."""
    place = _PLACE.search(error) or _MISSING.search(error)
    if place is None:
        return "the command is not an object with fields; reload the page"
    name = place[1]
    bare, meta = without_meta(types_of(kind)[name])
    if meta is not None and meta.title:
        return meta.title
    needed = (meta.description if meta is not None else None) or _needed(bare)
    called = name if issubclass(kind, Command) else f"`{name}`"  # arguments of the core have labels
    return f"{called} is {quoted(fields.get(name))}; it must be {needed}"


def _needed(kind: Any) -> str:
    """Return what a field must be, in words."""
    if get_origin(kind) is Literal:
        choices = [repr(choice) for choice in get_args(kind)]
        return " or ".join([", ".join(choices[:-1]), choices[-1]] if choices[1:] else choices)
    if is_union(kind):
        return " or ".join(_needed(part) for part in get_args(kind) if part not in (type(None), UnsetType))
    bare, _ = without_meta(kind)
    words: dict[Any, str] = {
        str: "a text", bool: "true or false", int: "a whole number", float: "a number", type(None): "null",
    }  # fmt: skip
    return words.get(bare, "a list" if get_origin(bare) in (list, tuple) else "an object")
