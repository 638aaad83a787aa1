"""The help of a command, from the fields of its `Arguments`, and suggestions for misspelt words.

tyro parses the arguments; its own help has one flat list in the order of inheritance, and no examples.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, Field, dataclass, fields
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

_POSITIONAL = get_args(tyro.conf.Positional[int])[1]
_OPTIONS, _RUNNING = (0, "options"), (90, "running")
_RUNNING_FLAGS = ("seed", "force", "quiet", "json", "debug")
_HELP_ROW = ("-h, --help", "Show this help.")
_NARROWEST, _WIDEST, _COLUMN = 50, 110, 26
_LONGEST_CHOICES = 48
_METAVARS = {int: "N", float: "NUMBER", str: "TEXT"}


@dataclass(frozen=True, slots=True)
class Argument:
    """An argument of a command."""

    name: str
    """Name of the field."""
    flags: tuple[str, ...]
    """Its spellings, the short one first; empty: it is positional."""
    value: str
    """What stands for its value; empty: it is a switch."""
    choices: tuple[str, ...]
    """Its values, where these are few."""
    text: str
    """What it is, in sentences."""
    required: bool
    """Whether it must be given."""
    default: str
    """The default, in words; empty: there is none, or the text states it."""
    group: tuple[int, str]
    """Rank and title of the group that it is listed in."""


def arguments_of(kind: type, *, with_texts: bool = True) -> list[Argument]:
    """Return the arguments of a command; `kind` is its dataclass.

    Texts are parsed from the source, which takes longer than all else: arguments without have none.
    """
    hints = get_type_hints(kind, include_extras=True)
    owners, texts = {}, {}
    for owner in reversed(kind.__mro__):
        own = inspect.get_annotations(owner)
        owners.update(dict.fromkeys(own, owner))
        texts.update(_texts(owner) if own and with_texts else {})
    return [_argument(field, hints[field.name], owners[field.name], texts) for field in fields(kind)]


def help_text(kind: type, *, prog: str, summary: str, examples: Sequence[str], width: int | None = None) -> str:
    """Return the help of a command as plain text.

    Args:
        kind: its dataclass.
        prog: how it is called.
        summary: what it does, in a sentence.
        examples: command lines, and lines of explanation that begin with `#`.
        width: columns; None: those of the terminal.
    """
    columns = shutil.get_terminal_size((80, 24)).columns if width is None else width
    wide = max(_NARROWEST, min(columns - 1, _WIDEST))
    found = arguments_of(kind)
    positional = [one for one in found if not one.flags]
    required = [one for one in found if one.flags and one.required]
    words = [*(one.value for one in positional), *(f"{one.flags[0]} {one.value}" for one in required), "[OPTIONS]"]
    lines = [*_wrapped(f"usage: {prog} {' '.join(words)}", wide, hang=7), "", *_wrapped(summary, wide)]
    if positional:
        lines += ["", "arguments:", *_rows([(one.value, _described(one)) for one in positional], wide)]
    for group in sorted({one.group for one in found if one.flags} | {_RUNNING}):
        members = sorted((one for one in found if one.flags and one.group == group), key=lambda one: not one.required)
        if group == _RUNNING:
            members.sort(key=lambda one: _RUNNING_FLAGS.index(one.name))
        rows = [(_spelling(one), _described(one)) for one in members]
        lines += ["", f"{group[1]}:", *_rows(rows + [_HELP_ROW] * (group == _RUNNING), wide)]
    if examples:
        lines += ["", "examples:", *(f"  {example}" for example in examples)]
    return "\n".join(lines)


def examples_of(kind: type) -> tuple[str, ...]:
    """Return the examples in the module of a command."""
    return tuple(getattr(sys.modules[kind.__module__], "EXAMPLES", ()))


def misspelt(kind: type, words: Iterable[str], *, plain: type | None = None) -> str | None:
    """Return a sentence on the first word that is no option of a command; None if all are.

    Args:
        kind: the arguments of the command, or of the variant that the words choose.
        words: the words.
        plain: the arguments of the command itself, whose other options the variant does not take.
    """
    others = set() if plain is None else {flag for one in arguments_of(plain, with_texts=False) for flag in one.flags}
    flags = [flag for one in arguments_of(kind, with_texts=False) for flag in one.flags] + ["--help", "-h"]
    for word in words:
        if word == "--":
            return None
        given = word.split("=", 1)[0]
        if given.startswith("--") and given.replace("_", "-") not in flags:
            if given.replace("_", "-") in others:
                return f"{given} is for one photo and one scan; register that pair by itself"
            return f"{given} is not an option{suggestion(given.replace('_', '-'), flags)}"
    return None


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return `; did you mean X?`; empty if nothing resembles the word."""
    listed = list(known)
    bare = {one.strip("-"): one for one in listed}  # hyphens in front make all options alike
    given = word.lower().strip("-")
    near = difflib.get_close_matches(given, bare, n=1, cutoff=0.6)
    if not near:
        near = [one for one in bare if len(given) > 2 and one.startswith(given)][:1]
    return f"; did you mean {bare[near[0]]}?" if near else ""


def _argument(field: Field[Any], hint: Any, owner: type, texts: dict[str, str]) -> Argument:
    marks = getattr(hint, "__metadata__", ())
    plain = get_args(hint)[0] if marks else hint
    choices = _choices(plain)
    metavar = next((mark.metavar for mark in marks if getattr(mark, "metavar", None)), None)
    aliases = tuple(alias for mark in marks for alias in getattr(mark, "aliases", None) or ())
    is_positional = _POSITIONAL in marks
    flag = f"--{field.name.replace('_', '-')}"
    group = owner.__dict__.get("GROUP", _OPTIONS)
    is_required = field.default is MISSING and field.default_factory is MISSING
    if field.name in _RUNNING_FLAGS:
        group = _RUNNING
    elif is_required:
        group = _OPTIONS
    listed = "{" + ",".join(choices) + "}"
    if len(listed) > _LONGEST_CHOICES:
        listed = "CHOICE"
    value = metavar or (listed if choices else _metavar(plain))
    if is_positional and not metavar:
        value = field.name.upper()
    text = " ".join(texts.get(field.name, "").split())
    return Argument(
        field.name,
        () if is_positional else tuple(sorted((flag, *aliases), key=lambda one: one.startswith("--"))),
        "" if plain is bool else value,
        choices,
        text,
        is_required,
        "" if "default" in text.lower() else _default(field),
        group,
    )


def _choices(plain: Any) -> tuple[str, ...]:
    parts = get_args(plain) if get_origin(plain) in (Union, UnionType) else (plain,)
    return tuple(str(value) for part in parts if get_origin(part) is Literal for value in get_args(part))


def _metavar(plain: Any) -> str:
    parts = [part for part in get_args(plain) or (plain,) if part is not type(None)]
    return _METAVARS.get(parts[0], "VALUE") if parts else "VALUE"


def _default(field: Field[Any]) -> str:
    value = field.default
    if value is MISSING or value is None or value is False or value in ("", ()):
        return ""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _spelling(one: Argument) -> str:
    return f"{', '.join(one.flags)} {one.value}".rstrip()


def _described(one: Argument) -> str:
    parts = [one.text]
    if one.choices and not one.value.startswith("{"):
        parts.append(f"One of {', '.join(one.choices)}.")
    if one.required and one.flags:
        parts.append("(required)")
    elif one.default:
        parts.append(f"(default: {one.default})")
    return " ".join(part for part in parts if part)


def _rows(rows: Sequence[tuple[str, str]], width: int) -> list[str]:
    lines = []
    for name, text in rows:
        wrapped = textwrap.wrap(text, width - _COLUMN, break_long_words=False, break_on_hyphens=False) or [""]
        head = f"  {name}"
        if len(head) > _COLUMN - 2:
            lines += _wrapped(head, width, hang=6)
        else:
            wrapped[0] = f"{head:<{_COLUMN}}{wrapped[0]}"
            lines.append(wrapped.pop(0))
        lines += [f"{'':<{_COLUMN}}{line}" for line in wrapped]
    return [line.rstrip() for line in lines]


def _wrapped(text: str, width: int, *, hang: int = 0) -> list[str]:
    indent = " " * (len(text) - len(text.lstrip()))
    return textwrap.wrap(
        text.lstrip(),
        width,
        initial_indent=indent,
        subsequent_indent=" " * hang,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _texts(owner: type) -> dict[str, str]:
    """Return the strings below the fields of a class, which document them."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(owner))).body[0]
    except (OSError, TypeError, SyntaxError):  # no source, as of a frozen program
        return {}
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for field, text in zip(tree.body, tree.body[1:], strict=False):
        named = isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if named and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            assert isinstance(field, ast.AnnAssign)
            assert isinstance(field.target, ast.Name)
            found[field.target.id] = str(text.value.value)
    return found
