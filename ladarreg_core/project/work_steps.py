"""How far the work on a photograph is: which steps are done, derived from the document alone, and what is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from ladarreg_core.project.document import Document, PhotoEntry, PickEntry
from ladarreg_core.results.registration import STAGE_LABELS
from ladarreg_core.results.verdict_words import verdict_words

StepName = Literal["match", "solve", "judge", "export"]
MIN_POINTS = 4
"""Fewest points of a pose; a line counts as its two ends."""
_PLACED = ("registered", "kept")
"""States of a station that has a verified place beside the fixed one."""
_SOLVE = "Solve from the matches, or register automatically."
_DRAW = "draw a line along an edge in one picture, then along the same edge in the other"
_NO_COLORS = "Only registration data can be exported: nothing is coloured by a pose that is not accepted."


@dataclass(frozen=True, slots=True)
class WorkStep:
    """One step of the work."""

    name: StepName
    """Its name."""
    done: bool
    """Whether it has its tick."""
    status: str
    """Where it stands, as a sentence."""
    missing: str
    """What has to be done, as a sentence; empty: nothing."""


def missing_matches(picks: Sequence[PickEntry]) -> str:
    """Return what a pose needs besides the enabled matches, as a sentence; empty if nothing."""
    enabled = [pick for pick in picks if pick.on]
    lacking = MIN_POINTS - sum(2 if pick.kind == "line" else 1 for pick in enabled)
    if lacking <= 0:
        return ""
    if picks and not enabled:
        if len(picks) == 1:
            return "The only match is disabled: enable it in the table."
        return f"All {len(picks)} matches are disabled: enable some in the table."
    return f"A pose needs {counted(-(-lacking // 2), 'more line')}, or {counted(lacking, 'more point')}."


def counted(count: int, one: str, many: str = "") -> str:
    """Return `1 match`, `3 matches`."""
    return f"{count} {one if count == 1 else many or one + 's'}"


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of the work on a photograph."""

    steps: tuple[WorkStep, ...]
    """Match, solve, judge and export."""
    needed: str
    """What a pose needs besides the enabled matches, as a sentence; empty if nothing."""
    next_action: str
    """What a new user does next, as a sentence."""


def progress_of(
    document: Document,
    entry: PhotoEntry | None,
    *,
    missing_camera: bool = False,
    stale: str = "",
    exported: bool = False,
) -> Progress:
    """Return the progress of the work on a photograph; None: there is none yet. The arguments are of `work_steps`."""
    if entry is None:
        files = "Open a photograph first." if document.scan else "Open a scan and a photograph first."
        names: tuple[tuple[StepName, str], ...] = (
            ("match", "No matches yet."), ("solve", "Not solved yet."), ("judge", "No pose yet."),
            ("export", "Not exported yet."),
        )  # fmt: skip
        steps = tuple(WorkStep(name, False, status, files) for name, status in names)
        return Progress(steps, files, files)
    steps = work_steps(document, entry, missing_camera=missing_camera, stale=stale, exported=exported)
    files = _missing_files(document, entry, missing_camera=missing_camera)
    return Progress(steps, missing_matches(entry.picks), files or _next_action(entry, steps))


def _next_action(entry: PhotoEntry, steps: Sequence[WorkStep]) -> str:
    match, solve, judge, _ = steps
    if not entry.poses and not entry.picks:
        return f"Click Register automatically; or {_DRAW}."
    if solve.done:
        return "Accepted: check the model, then export."
    if not entry.picks:
        return f"Not accepted: {_DRAW}; three or four such matches, far apart, help most."
    return match.missing or (judge.missing if entry.poses else solve.missing)


def work_steps(
    document: Document, entry: PhotoEntry, *, missing_camera: bool, stale: str, exported: bool
) -> tuple[WorkStep, ...]:
    """Return the steps of a photograph.

    Args:
        document: the project.
        entry: the photograph.
        missing_camera: whether its focal length is not known.
        stale: why its shown pose is out of date; empty: it is not.
        exported: whether its shown pose was exported.
    """
    files = _missing_files(document, entry, missing_camera=missing_camera)
    needed = missing_matches(entry.picks)
    enabled = sum(pick.on for pick in entry.picks)
    pose, outdated = entry.pose, f"{stale}." if stale else ""
    good = pose is not None and pose.accepted and not stale
    shown = "" if pose is None else f"Shown: {STAGE_LABELS[pose.stage]}."
    judged = _verdict(entry, stale)
    unsolved = files or (f"{needed} Or register automatically." if needed else _SOLVE)
    return (
        WorkStep(
            "match", not needed, f"{counted(enabled, 'match', 'matches')} enabled." if enabled else "No matches yet.",
            files if entry.poses else files or needed,
        ),
        WorkStep("solve", good, shown or "Not solved yet.", outdated if entry.poses else unsolved),
        WorkStep("judge", good, judged, outdated or _to_judge(entry)),
        WorkStep(
            "export", exported and not stale, "Exported." if exported else "Not exported yet.",
            outdated or ("Solve first." if pose is None else "" if pose.accepted else _NO_COLORS),
        ),
    )  # fmt: skip


def _missing_files(document: Document, entry: PhotoEntry, *, missing_camera: bool) -> str:
    if document.scan is None:
        return "Open a scan first."
    return f"Enter the focal length of {entry.source.name}: the file does not contain it." if missing_camera else ""


def _verdict(entry: PhotoEntry, stale: str) -> str:
    pose = entry.pose
    if pose is None:
        return "No pose yet."
    if stale:
        return "The verdict is out of date."
    return verdict_words(pose.accepted, pose.evidence, pose.diagnostics)


def _to_judge(entry: PhotoEntry) -> str:
    if entry.pose is None:
        return "Solve first."
    return "" if entry.pose.accepted else "The shown pose is not accepted: see the reasons and suggestions."


def stations_step(states: Sequence[str], *, current: bool) -> tuple[bool, str, str]:
    """Return whether all stations are registered to each other, and what is so and missing, as sentences.

    Args:
        states: of each station, the one that is shown first: `fixed`, `registered`, `kept`, or another one.
        current: whether they were registered as they are now.
    """
    every = counted(len(states), "station")
    if not current:
        return False, f"{every}.", "Register them to each other."
    others = sum(state in _PLACED for state in states)
    placed = others + 1 if others else 0  # the fixed one is registered only to another one
    if placed == len(states):
        return True, f"{every} registered.", ""
    return (
        False,
        f"{placed} of {every} registered." if placed else f"None of {every} registered.",
        "See why the others are not registered; give them a rough place, or scan from a station in between.",
    )
