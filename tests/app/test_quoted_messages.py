"""The messages that docs/troubleshooting.md quotes, and the buttons that the guides name, are the program's."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[2]
_JOINT = re.compile(r"\"\s*(?:\+\s*)?f?\"")
_BUTTONS = {
    "tutorial.md": ("Register automatically", "Judge", "Export", "No overlay", "Edges", "Camera", "Write report",
                    "Download zip", "Write to folder"),
    "manual.md": ("Match", "Judge", "Solve from matches", "Refine from here", "Display", "Show", "Depth error"),
    "troubleshooting.md": ("Refine from here", "Display", "Coarse mesh", "NOT SAVED"),
}  # fmt: skip


@cache
def sources() -> str:
    """Return the text of the program, with string literals over several lines joined."""
    files = [
        *(path for room in ("app", "ladarreg_core") for path in (CHECKOUT / room).rglob("*.py")),
        *(CHECKOUT / "static").rglob("*.js"),
    ]
    text = "\n".join(path.read_text(encoding="utf-8") for path in files)
    return _JOINT.sub("", text).replace("`", "")


def quoted_messages() -> list[str]:
    page = (CHECKOUT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    return re.findall(r"^\| \*(.+?)\*", page, re.MULTILINE)


def test_the_messages_are_the_programs() -> None:
    messages = quoted_messages()
    assert len(messages) > 12
    assert not [message for message in messages if message not in sources()]
    assert "the image has no focal distance in EXIF" not in sources(), "the control"


@pytest.mark.parametrize("page", _BUTTONS)
def test_the_buttons_are_those_of_the_page(page: str) -> None:
    text = " ".join((CHECKOUT / "docs" / page).read_text(encoding="utf-8").split())
    script = "\n".join(path.read_text(encoding="utf-8") for path in (CHECKOUT / "static").rglob("*.js"))
    script += "\n".join(path.read_text(encoding="utf-8") for path in (CHECKOUT / "app").rglob("*.py"))
    for name in _BUTTONS[page]:
        assert name in text, f"{page} does not name {name!r}"
        assert re.search(rf"[\"']{re.escape(name)}(?:: [\w ]+)?[\"']", script), (
            f"nothing of the page is called {name!r}"
        )
