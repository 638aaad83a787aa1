"""What is generated from the page's commands: their tables in docs/workbench.md and their types for the page.

    python -m testing.workbench.protocol_text

writes both anew; tests compare them.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from ladarreg.decoding import is_union, types_of
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
_HEAD = """/** The commands of the page and their fields, written by python -m testing.workbench.protocol_text. */

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
    """Return the types of the commands, as TypeScript reads them."""
    lines = ["export interface Commands {"]
    for name, command in sorted(EVERY_COMMAND.items()):
        inner = "; ".join(
            f"{field}{'?' if optional else ''}: {type_text(kind)}" for field, kind, optional in _fields(command)
        )
        lines.append(f"  {name}: {f'{{ {inner} }}' if inner else 'Record<string, never>'};")
    return _HEAD + "\n".join([*lines, "}", ""])


def type_text(kind: Any) -> str:
    """Return a type of Python as TypeScript writes it."""
    if get_origin(kind) is Annotated:
        return type_text(get_args(kind)[0])
    if kind in _SIMPLE:
        return _SIMPLE[kind]
    if get_origin(kind) is Literal:
        return " | ".join(f'"{choice}"' for choice in get_args(kind))
    if is_union(kind):
        return " | ".join(type_text(part) for part in get_args(kind) if part is not UnsetType)
    origin, inner = get_origin(kind), get_args(kind)
    if origin is list:
        item = type_text(inner[0])
        return f"({item})[]" if " " in item else f"{item}[]"
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
