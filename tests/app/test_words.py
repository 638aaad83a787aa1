"""What a person reads: the verdict in words, the panel's HTML, the bar on a terminal."""

from __future__ import annotations

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.arguments import condensed
from app.exit_codes import ExitCode
from app.step_bar import step_bar
from app.wording import one_line
from ladarreg_core.progress import Progress, Step


@given(st.text())
def test_whatever_a_message_holds_it_is_one_printable_line(text: str) -> None:
    line = one_line(text)
    assert len(line.splitlines()) <= 1
    assert line.isprintable() or not line


@given(st.lists(st.text(st.characters(codec="ascii", exclude_categories=("C",)), min_size=1, max_size=60), max_size=4))
def test_any_box_becomes_one_line(lines: list[str]) -> None:
    box = "\n".join(["╭─ Error ───╮", *(f"│ {line} │" for line in lines), "╰───────────╯"])
    assert len(condensed(box).splitlines()) == 1


def test_exit_codes_are_those_of_the_contract() -> None:
    assert (ExitCode.ACCEPTED, ExitCode.BAD_INPUT, ExitCode.NOT_ACCEPTED, ExitCode.INTERRUPTED) == (0, 2, 3, 130)


@pytest.mark.parametrize("quiet", [True, False])
def test_progress_off_a_terminal_is_plain_lines_or_nothing(quiet: bool) -> None:
    stream = io.StringIO()
    with step_bar(quiet=quiet, stream=stream) as bar:
        bar.step(Step("climb", 0.25, detail={"windows": 240, "map": [1, 2]}))
        bar.progress(Progress(0, 2, "writing model.glb"))
        bar.progress(Progress(1, 2, "writing model.glb"))
    lines = stream.getvalue().splitlines()
    assert len(lines) == (0 if quiet else 2)
    if not quiet:
        assert "climb" in lines[0]
        assert "0.25" in lines[0]
        assert "240" in lines[0]
        assert "\x1b" not in stream.getvalue()


def test_the_bar_on_a_terminal_goes_away() -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    with step_bar(quiet=False, stream=Terminal()) as bar:
        for name in ("read scan", "something new [bold]", "verify"):
            bar.step(Step(name, 0.1))
        bar.progress(Progress(3, 5, "writing"))
        bar.progress(Progress(0, 0, "unknown"))
