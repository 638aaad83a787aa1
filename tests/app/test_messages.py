"""Texts of the command line: verdicts, findings, parser errors, progress."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ladarreg.arguments import condense
from ladarreg.exit_codes import ExitCode
from ladarreg.messages import assessment_lines, one_line
from ladarreg.progress_bar import progress_bar

from ladarreg_core.foundations.progress import Progress
from ladarreg_core.quality.assessment import Assessment
from ladarreg_core.quality.findings import LEVELS, Finding
from ladarreg_core.results.registration import STAGE_LABELS, StageId, StageName
from ladarreg_core.results.steps import Step
from ladarreg_core.results.verdict_words import VERDICTS, Evidence
from testing.scenes.small_registration import sample_registration


@pytest.mark.slow
@given(st.text())
def test_any_text_becomes_one_printable_line(text: str) -> None:
    line = one_line(text)
    assert len(line.splitlines()) <= 1
    assert line.isprintable() or not line


@given(st.lists(st.text(st.characters(codec="ascii", exclude_categories=("C",)), min_size=1, max_size=60), max_size=4))
def test_any_box_becomes_one_line(lines: list[str]) -> None:
    box = "\n".join(["╭─ Error ───╮", *(f"│ {line} │" for line in lines), "╰───────────╯"])
    assert len(condense(box).splitlines()) == 1


def test_every_stage_has_a_label_and_every_evidence_a_verdict() -> None:
    assert set(STAGE_LABELS) == {*get_args(StageId), *get_args(StageName)}
    assert set(VERDICTS) >= set(get_args(Evidence))


def test_exit_codes_are_fixed() -> None:
    assert (ExitCode.ACCEPTED, ExitCode.BAD_INPUT, ExitCode.NOT_ACCEPTED, ExitCode.INTERRUPTED) == (0, 2, 3, 130)


NAMES = ("matches", "inliers", "residuals", "spread", "depth", "relief", "conditioning", "bias", "lens")


@given(
    levels=st.lists(st.sampled_from(LEVELS), min_size=len(NAMES), max_size=len(NAMES)),
    method=st.sampled_from(["manual", "auto", "thesis"]),
    accepted=st.booleans(),
)
def test_findings_are_few_and_the_worst_come_first(levels: list[str], method: str, accepted: bool) -> None:
    found = tuple(
        Finding(name, level, f"{name}\nis so.", "" if level == "good" else "Do it.")  # type: ignore[arg-type]
        for name, level in zip(NAMES, levels, strict=True)
    )
    result = replace(sample_registration(accepted=accepted), method=method)
    lines = assessment_lines(Assessment(found, None, None, None), result)
    assert len(lines) <= 5
    assert all(len(line.splitlines()) == 1 for line in lines)
    heads = [line.split()[0] for line in lines]
    assert "Good" not in heads
    assert heads == sorted(heads, key=["Poor", "Fair", "and"].index)
    shown = {line.split()[1] for line in lines if line.split()[0] != "and"}
    if method != "manual":
        assert not lines or accepted
        assert "Fair" not in heads
    elif accepted and levels[-1] == "poor" and levels.count("poor") < 5:
        assert "lens" in shown
    assert not ("conditioning" in shown and shown & {"spread", "depth", "relief"})


def test_without_assessment_there_are_no_lines() -> None:
    assert assessment_lines(Assessment(None, None, None, None), sample_registration()) == []


@pytest.mark.parametrize("quiet", [True, False])
def test_progress_without_a_terminal_is_plain_lines_or_nothing(quiet: bool) -> None:
    stream = io.StringIO()
    with progress_bar(quiet=quiet, stream=stream) as bar:
        bar.step(Step("climb", 0.25, detail={"windows": 240, "map": [1, 2]}))
        bar.progress(Progress(0, 2, "writing model.glb"))
        bar.progress(Progress(1, 2, "writing model.glb"))
    lines = stream.getvalue().splitlines()
    assert len(lines) == (0 if quiet else 2)
    if not quiet:
        assert lines[0].startswith("Refine candidate ")
        assert "climb" not in lines[0]
        assert "0.25" in lines[0]
        assert "240" in lines[0]
        assert "\x1b" not in stream.getvalue()


def test_the_bar_on_a_terminal_is_removed() -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    with progress_bar(quiet=False, stream=Terminal()) as bar:
        for name in ("Read scan", "something new [bold]", "verify"):
            bar.step(Step(name, 0.1))
        bar.progress(Progress(3, 5, "writing"))
        bar.progress(Progress(0, 0, "unknown"))
