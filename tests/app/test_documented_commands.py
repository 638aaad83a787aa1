"""Every command that README.md and docs/ show is one that the program takes, with all its options."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest
from ladarreg.arguments import parse
from ladarreg.cli import COMMANDS

from ladarreg_core.errors import OptionError

CHECKOUT = Path(__file__).parents[2]
PAGES = [CHECKOUT / "README.md", *sorted((CHECKOUT / "docs").glob("*.md"))]
_BLOCK_LINE = re.compile(
    r"^(?: {4}| {8})?(?:[A-Z_]+=\S+ )?(?:\.?\S*[/\\])?ladarreg ((?:\w|--version).*)$", re.MULTILINE
)
_INLINE = re.compile(r"`ladarreg ([^`]+)`")


def documented_commands(text: str) -> list[str]:
    """Return what follows `ladarreg` in the code blocks and in the code within the sentences of a page."""
    blocks = "\n".join(re.findall(r"^```\w*\n(.*?)^```$", text, re.MULTILINE | re.DOTALL))
    indented = "\n".join(re.findall(r"^(?: {4}.*\n?)+", text, re.MULTILINE))
    joined = re.sub(r" \\\n\s*", " ", f"{blocks}\n{indented}")
    return [*_BLOCK_LINE.findall(joined), *(" ".join(words.split()) for words in _INLINE.findall(text))]


def refusal(line: str) -> str:
    """Return why the program does not take a command, '' if it does; a command alone is a name, not a call."""
    words = ["1" if word == "N" else word for word in shlex.split(line, comments=True)]
    if words == ["--version", "--verbose"]:
        return ""
    if words[0] in ("--help", "--version", "help"):
        return "" if len(words) == 1 or words[1] in {*COMMANDS, "COMMAND"} else f"no command {words[1]}"
    if words[0] not in COMMANDS:
        return f"no command {words[0]}"
    if len(words) == 1:
        return ""
    arguments = importlib.import_module(f"ladarreg.commands.{words[0].replace('-', '_')}").Arguments
    try:
        parse(arguments, words[1:], prog=f"ladarreg {words[0]}", description="")
    except OptionError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_the_commands_of_the_page_are_taken(page: Path) -> None:
    commands = documented_commands(page.read_text(encoding="utf-8"))
    wrong = {line: why for line in commands if (why := refusal(line))}
    assert not wrong


def test_the_commands_are_found_and_wrong_ones_refused() -> None:
    found = documented_commands(PAGES[0].read_text(encoding="utf-8"))
    assert "serve scan.e57 photo.jpg" in found
    assert "register scan.e57 photo.jpg --camera camera.json -o results" in found
    assert refusal("register scan.e57 photo.jpg --camra camera.json -o results")
    assert refusal("regster scan.e57 photo.jpg -o results")
