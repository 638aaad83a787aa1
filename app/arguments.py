"""From words to a command's frozen `Arguments`, by tyro; what it cannot parse is told in one line."""

from __future__ import annotations

import contextlib
import io
import re
import sys
from collections.abc import Sequence
from typing import TypeVar

import tyro

from .exit_codes import ExitCode

T = TypeVar("T")
_ARGUMENT = re.compile(r"((?:-[a-z] [A-Z]+, )?--[a-z-]+|[A-Z]{3,})(?= |$)")
_FRAME = re.compile(r"^[\s│|╭╰╮╯─┌└┐┘+]*(?:-{3,})?|[\s│|╮╯─+]*$")


def parse(kind: type[T], words: Sequence[str], *, prog: str, description: str) -> T:
    """Return the arguments, or leave by `SystemExit`: 0 after help, 2 after one line on stderr."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                kind, args=list(words), prog=prog, description=description, config=(tyro.conf.FlagCreatePairsOff,)
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        print(f"ladarreg: {condensed(said.getvalue())}; see {prog} --help", file=sys.stderr)
        raise SystemExit(int(ExitCode.BAD_INPUT)) from None


def condensed(box: str) -> str:
    """Return the first paragraph inside a box drawn around an error, as one line."""
    title, *lines = (_FRAME.sub("", line) for line in box.splitlines())
    if "Required" in title or any(line.startswith("Missing from") for line in lines):
        names = [match.group(1) for line in lines if (match := _ARGUMENT.match(line))]
        return f"missing {', '.join(dict.fromkeys(names))}"
    paragraph: list[str] = []
    for line in lines:
        if not line and paragraph:
            break
        if line:
            paragraph.append(line)
    return " ".join(paragraph).rstrip(".:") or "the arguments could not be understood"
