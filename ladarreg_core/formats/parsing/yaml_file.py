"""YAML of calibrations: mappings, lists, numbers and strings, from PyYAML's events.

Only events are taken from the library, so that a file constructs nothing but these four. Tags (`!!opencv-matrix`) are
skipped; anchors and aliases, which make small files huge, are refused. Parsing takes linear time.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.untrusted import one_line

_DEEPEST = 20
_LONGEST_LINE = 100_000
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_NONE = ("", "~", "null", "Null", "NULL")


def parse_yaml(text: str) -> dict[str, Any]:
    """Return the mapping in the first document of a text; numbers become int or float, everything else a string.

    Raises:
        FormatError: if it is not a mapping, is nested too deeply, is damaged, or uses anchors.
    """
    import yaml  # only where a camera is YAML: loading it takes as long as reading a small file

    longest = max(map(len, text.splitlines()), default=0)
    if longest > _LONGEST_LINE:
        raise FormatError(f"it has a line of {longest:,} characters; a camera file's have at most {_LONGEST_LINE:,}")
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        value = _document(yaml, iter(yaml.parse(_without_directives(text), Loader=loader)))
    except yaml.YAMLError as error:
        raise FormatError(_reason(text, error)) from None
    if value is None:
        raise FormatError("it is empty; a camera file is JSON or YAML with a camera matrix")
    if not isinstance(value, dict):
        # It is not quoted: any text file may have been named as a camera.
        raise FormatError(
            "its lines are not of the form 'name: value'; a camera file is JSON or YAML with a camera matrix"
        )
    return value


def _without_directives(text: str) -> str:
    """Return a text with its first directives blanked: OpenCV writes `%YAML:1.0`, which is not one of YAML's."""
    lines = text.splitlines()
    for at, line in enumerate(lines):
        if line.startswith("%"):
            lines[at] = ""
        elif line.strip() and not line.lstrip().startswith("#"):
            break
    return "\n".join(lines) + "\n"


def _document(yaml: Any, events: Iterator[Any]) -> Any:
    """Return the value of the first document; None if there is none."""
    holders: list[Any] = []  # the lists and mappings that are open
    keys: list[str | None] = []  # for each of them, the key that waits for its value
    for event in events:
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise FormatError("it uses an anchor or alias (& or *), which is not read; write the values out")
        if isinstance(event, yaml.ScalarEvent):
            value = event.value if event.style else _scalar(event.value)  # quoted: a string
            if holders and isinstance(holders[-1], dict) and keys[-1] is None:
                keys[-1] = _new_key(event.value, holders[-1])
                continue
        elif isinstance(event, yaml.SequenceStartEvent | yaml.MappingStartEvent):
            if len(holders) == _DEEPEST:
                raise FormatError("its YAML is nested too deeply for a camera file")
            if holders and isinstance(holders[-1], dict) and keys[-1] is None:
                raise FormatError("a name in it is a list or a mapping; names must be words")
            holders.append({} if isinstance(event, yaml.MappingStartEvent) else [])
            keys.append(None)
            continue
        elif isinstance(event, yaml.SequenceEndEvent | yaml.MappingEndEvent):
            value = holders.pop()
            keys.pop()
        else:
            continue
        if not holders:
            return value
        if isinstance(holders[-1], dict):
            holders[-1][keys[-1]] = value
            keys[-1] = None
        else:
            holders[-1].append(value)
    return None


def _new_key(key: str, mapping: dict[str, Any]) -> str:
    if key in mapping:
        raise FormatError(f"it states {one_line(key, 40)!r} twice; keep one of them")
    return key


def _reason(text: str, error: Any) -> str:
    """Return what is wrong with a text; the parser's own words would quote it."""
    mark = getattr(error, "problem_mark", None)
    at = f", line {mark.line + 1}" if mark is not None else ""
    lines = text.splitlines()
    if mark is not None and mark.line < len(lines) and re.match(r"\s*\t", lines[mark.line]):
        return f"it is indented with tabs{at}; YAML is indented with spaces"
    if mark is not None and mark.line >= len(lines):
        return "a bracket or a quotation is never closed; the file is truncated"
    if not re.search(r":(\s|$)", text, re.MULTILINE):
        return "its lines are not of the form 'name: value'; give JSON or YAML with a camera matrix"
    return f"it is not valid YAML{at}; lines have the form 'name: value', and neighbouring lines the same indentation"


def _scalar(text: str) -> Any:
    if text in _NONE:
        return None
    if _NUMBER.fullmatch(text):
        return int(text) if text.lstrip("+-").isdigit() and len(text) < 19 else float(text)
    return text
