"""Parser for the subset of YAML that camera calibrations use: nested mappings, lists, numbers and strings.

Tags (`!!opencv-matrix`), directives and comments are skipped; anchors, block scalars and the rest of YAML are refused.
Parsing takes linear time.
"""

from __future__ import annotations

import re
from typing import Any

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.untrusted import one_line

_NOT_FIRST_IN_A_KEY = "\"'[]{},#&*!|>%@`-"
_DEEPEST = 20
_LONGEST_LINE = 100_000
_Line = tuple[int, str]


def parse_yaml(text: str) -> dict[str, Any]:
    """Parse a YAML mapping; numbers become int or float, everything else a string.

    Raises:
        FormatError: if it is not a mapping, or uses YAML outside this subset.
    """
    lines = _logical_lines(text)
    if not lines:
        raise FormatError("it is empty; a camera file is JSON or YAML with a camera matrix")
    value, rest = _block(lines, 0, 0)
    if rest != len(lines):
        raise FormatError(f"the line {one_line(lines[rest][1], 60)!r} is indented differently from its neighbours")
    if not isinstance(value, dict):
        raise FormatError("it is not a mapping of names to values; a camera file is JSON or YAML with a camera matrix")
    return value


def _logical_lines(text: str) -> list[_Line]:
    """Return (indent, content) of each line, with lists in brackets that run over several lines joined."""
    raw = text.splitlines()
    longest = max(map(len, raw), default=0)
    if longest > _LONGEST_LINE:
        raise FormatError(f"it has a line of {longest:,} characters; a camera file's have at most {_LONGEST_LINE:,}")
    lines: list[_Line] = []
    pending: list[str] = []
    indent = depth = 0
    for row in raw:
        content = _without_comment(row).rstrip()
        bare = content.strip()
        if bare == "..." or (bare == "---" and lines):
            break  # another YAML document follows
        if not pending and (not bare or bare == "---" or bare.startswith("%")):
            continue
        if not pending:
            indent = len(content) - len(content.lstrip(" "))
            if "\t" in content[: indent + 1]:
                raise FormatError("it is indented with tabs; YAML is indented with spaces")
        pending.append(bare)
        depth += sum(map(content.count, "[{")) - sum(map(content.count, "]}"))
        if depth <= 0:
            lines.append((indent, " ".join(pending)))
            pending, depth = [], 0
    if pending:
        raise FormatError("a bracket is never closed; the file is truncated")
    return lines


def _without_comment(line: str) -> str:
    quote = ""
    for at, c in enumerate(line):
        if quote:
            quote = "" if c == quote else quote
        elif c in "\"'":
            quote = c
        elif c == "#" and (at == 0 or line[at - 1].isspace()):
            return line[:at]
    return line


def _block(lines: list[_Line], at: int, depth: int) -> tuple[Any, int]:
    """Parse the mapping or list that starts at a line; return it and the line after it."""
    if depth > _DEEPEST:
        raise FormatError("its YAML is nested too deeply for a camera file")
    indent, content = lines[at]
    if content == "-" or content.startswith("- "):
        items: list[Any] = []
        while at < len(lines) and lines[at][0] == indent and (lines[at][1] + " ").startswith("- "):
            items.append(_scalar_or_flow(lines[at][1][1:].strip()))
            at += 1
        return items, at
    mapping: dict[str, Any] = {}
    while at < len(lines) and lines[at][0] == indent:
        pair = _key_and_value(lines[at][1])
        if pair is None:
            # It is not quoted: any text file may have been named as a camera.
            raise FormatError("a line of it is not of the form 'name: value'; give JSON or simple YAML")
        key, inline = pair[0], _without_tag(pair[1])
        at += 1
        if inline:
            mapping[key] = _scalar_or_flow(inline)
        elif at < len(lines) and (lines[at][0] > indent or (lines[at][0] == indent and lines[at][1].startswith("- "))):
            mapping[key], at = _block(lines, at, depth + 1)
        else:
            mapping[key] = None
    return mapping, at


def _key_and_value(line: str) -> tuple[str, str] | None:
    """Return the name and the text after its colon, or None where the line is not of the form `name: value`."""
    quote = line[:1]
    if quote in ("'", '"'):
        key, closed, rest = line[1:].partition(quote)
        before, colon, value = rest.partition(":")
        if not closed or before.strip():
            return None
    else:
        key, colon, value = line.partition(":")
        key = key.rstrip()
        if not key or key[0] in _NOT_FIRST_IN_A_KEY or "#" in key:
            return None
    if not colon or (value and not value[0].isspace()):
        return None
    return key, value.strip()


def _without_tag(text: str) -> str:
    text = text.strip()
    return re.sub(r"^!\S*\s*", "", text)


def _scalar_or_flow(text: str) -> Any:
    text = _without_tag(text)
    if text[:1] in ("|", ">", "&", "*"):
        raise FormatError(
            "one of its values uses an unsupported YAML feature (anchor, alias, block of text); give JSON"
        )
    if text[:1] not in ("[", "{"):
        return _scalar(text)
    tokens = [token for token in re.split(r"([\[\]{},])", text) if token.strip()]
    value, at = _flow(tokens, 0, 0)
    if at != len(tokens):
        raise FormatError("something follows a list on its line; nothing may")
    return value


def _flow(tokens: list[str], at: int, depth: int) -> tuple[Any, int]:
    """Parse the list or mapping in brackets that starts at a token; return it and the token after it."""
    if depth > _DEEPEST:
        raise FormatError("its YAML is nested too deeply for a camera file")
    is_list = tokens[at] == "["
    close = "]" if is_list else "}"
    items: list[Any] = []
    pairs: dict[str, Any] = {}
    at += 1
    while at < len(tokens) and tokens[at] != close:
        token, key = tokens[at].strip(), ""
        if not is_list:
            key, colon, token = (part.strip() for part in token.partition(":"))
            if not colon:
                raise FormatError(f"in braces there is {one_line(tokens[at], 40)!r} instead of 'name: value'")
        if token in ("[", "{"):
            value, at = _flow(tokens, at, depth + 1)
        elif not is_list and not token and at + 1 < len(tokens) and tokens[at + 1] in ("[", "{"):
            value, at = _flow(tokens, at + 1, depth + 1)
        else:
            value, at = _scalar(token), at + 1
        if is_list:
            items.append(value)
        else:
            pairs[key.strip("\"'")] = value
        if at < len(tokens) and tokens[at] == ",":
            at += 1
        elif at < len(tokens) and tokens[at] != close:
            raise FormatError(f"in a list there is {one_line(tokens[at], 40)!r} without a comma before it")
    if at >= len(tokens):
        raise FormatError("a bracket is never closed; the file is truncated")
    return (items if is_list else pairs), at + 1


def _scalar(text: str) -> Any:
    if len(text) >= 2 and text[0] == text[-1] and text[0] in "\"'":
        return text[1:-1]
    if text in ("", "~", "null"):
        return None
    try:
        return int(text) if re.fullmatch(r"[+-]?\d{1,18}", text) else float(text)
    except ValueError:
        return text
