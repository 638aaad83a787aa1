"""docs/tutorial.md: its commands run in order, and print what it quotes."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from ladarreg.cli import main

_COMMAND = re.compile(r"^ {4}ladarreg (.+)\n(?:\n```\n((?:.*\n)+?)```\n)?", re.MULTILINE)
_FIGURE = re.compile(r"\d+(?:\.\d+)?(?:e[-+]\d+)?")
_IN_THE_BROWSER = ("serve", "demo")
_LEFT_OUT = "Took "  # depends on the machine alone


def _commands(page: str) -> Iterator[tuple[list[str], str]]:
    """Yield the words of each command of a page, and what the page quotes below it."""
    for line, quoted in _COMMAND.findall(page):
        yield shlex.split(line), quoted


def _agree(quoted: str, printed: str) -> bool:
    """Return whether texts have the same words, and figures that differ no more than between machines: 15 percent."""
    if _FIGURE.sub("#", quoted).split() != _FIGURE.sub("#", printed).split():
        return False
    pairs = zip(_FIGURE.findall(quoted), _FIGURE.findall(printed), strict=True)
    return all(
        float(ours) == pytest.approx(float(theirs), rel=0.15, abs=2 * _last_place(ours)) for ours, theirs in pairs
    )


def _last_place(figure: str) -> float:
    return 10.0 ** -len(figure.partition(".")[2]) if figure.isdecimal() or "." in figure else 0.0


@pytest.mark.long
def test_the_tutorial_runs_and_prints_what_it_quotes(
    tmp_path: Path, checkout: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (checkout / "docs" / "tutorial.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    ran = []
    for words, quoted in _commands(page):
        if words[0] in _IN_THE_BROWSER:
            continue
        assert main(words) == 0, words
        printed = "".join(line for line in capsys.readouterr().out.splitlines(keepends=True) if _LEFT_OUT not in line)
        assert quoted, f"the page quotes nothing below {words}; printed was\n{printed}"
        assert _agree(quoted, printed), f"{words} printed\n{printed}"
        ran.append(words[0])
    assert ran == ["simulate", "info", "info", "register", "export"]
    named = {*re.findall(r"`((?:results|handover)/[\w./-]*)`", page)}
    assert len(named) >= 2
    assert not [name for name in named if not (tmp_path / name).exists()]


def test_other_words_and_other_figures_do_not_agree() -> None:
    quoted = "Camera   0.90 m left, 0.07 m up (sigma 5.2 mm)\n"
    assert _agree(quoted, "Camera  0.91 m left, 0.06 m up (sigma 5.3 mm)\n")
    assert not _agree(quoted, quoted.replace("up", "down"))
    assert not _agree(quoted, quoted.replace("0.90", "0.70"))
    assert not _agree(quoted, quoted.replace("0.07", "0.10"))
    assert not _agree(quoted, quoted + "Took 1 s\n")
