"""What is generated for the page: tables of its commands in docs/workbench.md, and the types of all that it sends and
receives.

    python -m testing.workbench.protocol_text

writes both anew; tests compare them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, get_args, get_origin, get_type_hints, is_typeddict

from ladarreg.decoding import is_union, types_of
from ladarreg.slices.events import Event
from ladarreg.slices.every import OfPhoto, Slices
from ladarreg.workbench.commands.command import Command
from ladarreg.workbench.commands.registry import EVERY_COMMAND
from msgspec import NODEFAULT, UnsetType
from msgspec.structs import fields as struct_fields

CHECKOUT = Path(__file__).parents[2]
PAGE = CHECKOUT / "docs" / "workbench.md"
DECLARATIONS = CHECKOUT / "static" / "js" / "protocol.d.ts"
_ROW = re.compile(r"^\| `(\w+)` \|.*$", re.MULTILINE)
_SIMPLE = {str: "string", bool: "boolean", int: "number", float: "number", type(None): "null", Any: "unknown"}
ANY_SETTING = "[NAME: string]"
"""How TypeScript writes that any name is a field."""
_HEAD = """/**
 * The commands of the page, the slices and the events that it receives, by their names; written by
 * python -m testing.workbench.protocol_text.
 */

"""


def row_of(command: type[Command]) -> str:
    """Return a command's row in the documentation."""
    words = ", ".join(f"{name}{'?' if optional else ''}{_choices(kind)}" for name, kind, optional in _fields(command))
    replies = f"-> `{command.replies.replace('|', chr(92) + '|')}`" if command.replies else ""
    words = words.replace(ANY_SETTING, "NAME: value, ..")
    cell = " ".join(part for part in (f"`{words}`" if words else "", replies) if part)
    effect = " ".join((command.__doc__ or "").split()).replace("|", "\\|")
    return f"| `{command.command_name()}` | {cell} | {effect} |"


def with_rows(text: str) -> str:
    """Return the documentation with the present row of each command that it has."""
    return _ROW.sub(lambda found: _present(found[0], found[1]), text)


def _present(row: str, name: str) -> str:
    return row_of(EVERY_COMMAND[name]) if name in EVERY_COMMAND else row


def declarations() -> str:
    """Return the types of the commands, slices and events, as TypeScript reads them."""
    shared, of_photo = (sorted(get_type_hints(kind).items()) for kind in (Slices, OfPhoto))
    slices = [
        *(f"{name}: {type_text(kind)};" for name, kind in shared),
        *(f"[name: `{name}:${{string}}`]: {type_text(kind)};" for name, kind in of_photo),
    ]
    events = {name: kind for kind in get_args(Event) for name in get_args(get_type_hints(kind)["event"])}
    tables = {"Slices": slices, "Events": [f"{name}: {kind.__name__};" for name, kind in sorted(events.items())]}
    parts = [_commands(), *(_alias(name, lines) for name, lines in tables.items())]
    named = _named([*get_type_hints(Slices).values(), *get_type_hints(OfPhoto).values(), *events.values()])
    missing = _missing_fields(named)
    parts += [_alias(one.__name__, [*_lines(one), *missing.get(one.__name__, ())]) for one in named]
    return _HEAD + "\n".join(parts)


def _alias(name: str, lines: Iterable[str]) -> str:
    return "\n".join([f"export type {name} = {{", *(f"  {line}" for line in lines), "};", ""])


def _lines(kind: Any) -> list[str]:
    return [
        f"{name}{'?' if get_origin(field) is NotRequired else ''}: {type_text(field)};"
        for name, field in get_type_hints(kind, include_extras=True).items()
    ]


def _named(kinds: Iterable[Any]) -> list[Any]:
    """Return the dictionaries with named fields among types and all that they consist of, by name.

    Raises:
        TypeError: if two have the same name.
    """
    found: dict[str, Any] = {}

    def visit(kind: Any) -> None:
        if not is_typeddict(kind):
            for part in get_args(kind) if get_origin(kind) is not Literal else ():
                visit(part)
        elif found.setdefault(kind.__name__, kind) is not kind:
            raise TypeError(f"two types have the name {kind.__name__}; the page needs another for one of them")
        elif kind not in seen:
            seen.add(kind)
            for part in get_type_hints(kind, include_extras=True).values():
                visit(part)

    seen: set[Any] = set()
    for kind in kinds:
        visit(kind)
    return [found[name] for name in sorted(found)]


def _missing_fields(named: Iterable[Any]) -> dict[str, list[str]]:
    """Return the fields that each lacks beside what may stand in its place: they tell the page which one it is."""
    found: dict[str, list[str]] = {}

    def visit(kind: Any) -> None:
        parts = get_args(kind) if get_origin(kind) is not Literal else ()
        choices = [part for part in parts if is_typeddict(part)] if is_union(kind) else []
        every = {name: None for one in choices for name in get_type_hints(one)}
        for one in choices:
            lacking = [f"{name}?: undefined;" for name in every if name not in get_type_hints(one)]
            if lacking:
                found[one.__name__] = lacking
        for part in parts:
            visit(part)

    for kind in [*named, Slices, OfPhoto]:
        for part in get_type_hints(kind).values():
            visit(part)
    return found


def _commands() -> str:
    """Return the types of the commands."""
    lines = ["export interface Commands {"]
    for name, command in sorted(EVERY_COMMAND.items()):
        inner = "; ".join(
            f"{field}{'?' if optional else ''}: {type_text(kind)}" for field, kind, optional in _fields(command)
        )
        lines.append(f"  {name}: {f'{{ {inner} }}' if inner else 'Record<string, never>'};")
    return "\n".join([*lines, "}", ""])


def type_text(kind: Any) -> str:
    """Return a type of Python as TypeScript writes it."""
    if get_origin(kind) in (Annotated, NotRequired):
        return type_text(get_args(kind)[0])
    if is_typeddict(kind):
        return str(kind.__name__)
    if kind in _SIMPLE:
        return _SIMPLE[kind]
    if get_origin(kind) is Literal:
        return " | ".join(f'"{choice}"' for choice in get_args(kind))
    if is_union(kind):
        return " | ".join(type_text(part) for part in get_args(kind) if part is not UnsetType)
    origin, inner = get_origin(kind), get_args(kind)
    if origin is list:
        item = type_text(inner[0])
        return f"({item})[]" if " | " in item and not item.endswith("]") else f"{item}[]"
    if origin is tuple:
        return f"[{', '.join(map(type_text, inner))}]"
    if origin is dict:
        return f"Record<{type_text(inner[0])}, {type_text(inner[1])}>"
    raise TypeError(f"{kind} has no counterpart; add it to type_text")


def _fields(command: type[Command]) -> list[tuple[str, Any, bool]]:
    """Return the names, types and whether a field may be missing."""
    if command.command_name() == "set_settings":  # the settings are fields of the message themselves
        return [(ANY_SETTING, Any, False)]
    kinds = types_of(command)
    return [
        (one.name, kinds[one.name], one.default is not NODEFAULT or one.default_factory is not NODEFAULT)
        for one in struct_fields(command)
    ]


def _choices(kind: Any) -> str:
    text = type_text(kind)
    return f": {text}".replace("|", "\\|") if '"' in text or ("null" in text and " | " not in text) else ""


def main() -> None:
    """Write both files anew."""
    PAGE.write_text(with_rows(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    DECLARATIONS.write_text(declarations(), encoding="utf-8")


if __name__ == "__main__":
    main()
