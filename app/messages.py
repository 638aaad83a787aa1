"""Texts of the command line and the workbench: verdicts, reports and tables."""

from __future__ import annotations

import math
import textwrap
import unicodedata
from typing import TYPE_CHECKING

from .argument_names import as_fields, as_flags

if TYPE_CHECKING:
    from ladarreg_core.export.comparison.table import Table
    from ladarreg_core.quality.assessment import Assessment
    from ladarreg_core.quality.findings import Finding
    from ladarreg_core.registration.comparison import Comparison
    from ladarreg_core.registration.self_test.report import SelfTest
    from ladarreg_core.results.registration import PoseResult, Registration
    from ladarreg_core.scan import Scan

_HEAD_WIDTH = 16
_MAX_SENTENCE = 600
_MAX_FINDINGS = 4
_MAX_LENGTHS = 40
_IN_REASONS = {"matches", "inliers", "residuals", "lengths"}
"""Findings that the reasons of a refusal already state."""
_IN_CAUTIONS = {"matches", "spread", "relief", "baseline", "disparity"}
"""Findings that the cautions of the thesis's methods already state."""
_CAUSES = {"spread", "depth", "relief"}
"""Findings that cause the finding `conditioning`."""


def one_line(text: str) -> str:
    """Return the text on one line for the terminal: arguments as options, control characters (of names) escaped."""
    words = " ".join(as_flags(text).split())
    return "".join(c if unicodedata.category(c)[0] != "C" else c.encode("unicode_escape").decode() for c in words)


def sentence(text: str) -> str:
    """Return a text for the page with a full stop and, unless it begins with a file's name, a capital letter."""
    words = " ".join(as_fields(text).split())
    if len(words) > _MAX_SENTENCE:
        words = f"{words[:_MAX_SENTENCE]}..."
    begin, _, _ = words.partition(" ")
    is_name = "." in begin.strip(".:;,") or "/" in begin or "_" in begin
    return (words if is_name else f"{words[:1].upper()}{words[1:]}") + ("" if words.endswith((".", "!", "?")) else ".")


def internal_error(error: BaseException, *, go_on: str) -> str:
    """Return what the page says of a fault of the program itself: what to keep, to report and to do, `go_on`."""
    return (
        f"Internal error ({type(error).__name__}), a fault of this program: {go_on}; if it comes again, save the "
        "project and report what you did, with what the terminal of the workbench says."
    )


def verdict(result: PoseResult) -> str:
    """Return whether a pose is accepted, and on what evidence."""
    from ladarreg_core.results.verdict_words import verdict_words

    return verdict_words(result.accepted, result.evidence, result.diagnostics, coarse=result.is_coarse)


def position(result: PoseResult) -> str:
    """Return the camera position relative to the scanner, with its standard deviation."""
    from ladarreg_core.foundations.formatting import format_length

    sigma = format_length(result.sigma_position_m) if math.isfinite(result.sigma_position_m) else "unknown"
    return f"{result.thesis_parameters.describe_position()} (sigma {sigma})"


def orientation(result: PoseResult) -> str:
    """Return the camera orientation relative to the scanner, with its standard deviation."""
    return f"{result.thesis_parameters.describe_orientation()} (sigma {sigma_angle(result)})"


def sigma_angle(result: PoseResult) -> str:
    """Return the standard deviation of the orientation, in degrees."""
    return f"{math.degrees(result.sigma_angle_rad):.3f} deg" if math.isfinite(result.sigma_angle_rad) else "unknown"


def matches(result: PoseResult) -> str:
    """Return the number of inliers and their residual."""
    from ladarreg_core.matches import count_picks

    if not len(result.matches):
        return "no matches"
    inliers, count = count_picks(result.matches, result.inliers)
    text = f"{inliers} of {count} matches agree"
    if result.inliers.any():
        squares = (result.residuals_px[result.inliers] ** 2).sum(axis=-1)
        text += f", {float(squares.mean()) ** 0.5:.2f} px rms"
    return text


def report(result: PoseResult) -> str:
    """Return the verdict with its reasons and, if accepted, the pose; several lines."""
    lines = [verdict(result), *(f"  {one_line(reason)}" for reason in result.reasons)]
    if result.is_shown:
        lines += [
            f"Camera   {position(result)}",
            f"Rotation {orientation(result)}",
            *([] if result.in_world is None else [f"World    {result.in_world}"]),
            *([f"Matches  {matches(result)}"] if result.accepted else []),
        ]
    return "\n".join(lines)


def length_lines(result: PoseResult) -> list[str]:
    """Return the lengths that came with matches beside the scan's ranges as a table; empty without lengths."""
    listed = (result.diagnostics.get("lengths") or {}).get("matches") or []
    if not listed:
        return []
    from ladarreg_core.export.comparison.table import Table

    rows = [
        (
            one_line(one["name"]) + (" (end)" if one["end"] else ""),
            f"{one['length_m']:.3f}",
            "-" if one["scan_range_m"] is None else f"{one['scan_range_m']:.3f}",
            "-" if one["difference_m"] is None else f"{one['difference_m']:+.3f}",
            f"{one['tolerance_m']:.3f}",
            "beyond" if one["beyond"] else "" if one["state"] == "compared" else one["state"],
        )
        for one in listed[:_MAX_LENGTHS]
    ]
    lines = ["Lengths of the matches and the scan's own ranges, m:"]
    lines += aligned(Table(heads=("length", "scan", "difference", "tolerance", ""), rows=tuple(rows))).splitlines()
    if len(listed) > _MAX_LENGTHS:
        lines.append(f"and {len(listed) - _MAX_LENGTHS} more in registration.json")
    return [line.rstrip() for line in lines]


def assessment_lines(assessment: Assessment, result: Registration) -> list[str]:
    """Return the main findings and suggestions, a few lines; registration.json has all of them."""
    lines = []
    if result.accepted and assessment.uncertainty is not None:
        lines.append(f"Image    {assessment.uncertainty.summary()}")
    shown = notable_findings(assessment, result)
    for finding in shown[:_MAX_FINDINGS]:
        lines.append(f"{finding.level.capitalize():<8} {one_line(f'{finding.sentence} {finding.what_to_do}')}")
    if len(shown) > _MAX_FINDINGS:
        lines.append(f"         and {len(shown) - _MAX_FINDINGS} more in registration.json")
    if result.method == "manual":
        if assessment.match_to_check:
            lines.append(f"Check    {one_line(assessment.match_to_check)}")
        if assessment.advice and (result.accepted or 2 * int(result.inliers.sum()) >= len(result.matches)):
            lines.append(f"Next     {one_line(assessment.advice[0].summary())}")
    return lines


def notable_findings(assessment: Assessment, result: Registration) -> list[Finding]:
    """Return the findings that a user can act on and that the verdict does not state, the worst first."""
    found = [finding for finding in assessment.findings or () if finding.level != "good"]
    if result.method == "manual":
        known = set() if result.accepted else _IN_REASONS
    elif not result.accepted:
        return []  # findings on a pose that was not found are of no use
    else:  # fair findings on automatic matches call for no action
        known = {finding.name for finding in found if finding.level == "fair"}
        known |= _IN_CAUTIONS if result.method == "thesis" else set()
    found = [finding for finding in found if finding.name not in known]
    if any(finding.name in _CAUSES for finding in found):
        found = [finding for finding in found if finding.name != "conditioning"]
    return sorted(found, key=lambda finding: finding.level != "poor")


def comparison_verdict(comparison: Comparison) -> str:
    """Return the verdict of a comparison, which is that of the default method."""
    from ladarreg_core.export.comparison.table import default_of

    default = default_of(comparison)
    if default is not None and default.stage.result is not None:
        return verdict(default.stage.result)
    note = "" if default is None else one_line(default.stage.note)
    return f"Not accepted: the default method found no pose. {note}".rstrip()


def comparison_report(comparison: Comparison, scan: Scan) -> str:
    """Return the cautions, the table of all stages, and each stage's verdict with its reasons."""
    from ladarreg_core.export.comparison.table import cautions_of, comparison_table, title_of, verdict_of

    lines = [f"Caution  {one_line(caution)}" for caution in cautions_of(comparison)]
    lines += [aligned(comparison_table(comparison, scan)), ""]
    for column in comparison.columns:
        result = column.stage.result
        reasons = [column.stage.note, *(() if result is None else result.reasons)]
        lines.append(f"{title_of(column)}: {verdict_of(column)}")
        lines += [f"  {one_line(reason)}" for reason in reasons if reason]
        if result is not None and result.accepted and result.in_world is not None:
            lines.append(f"  World: {result.in_world}.")
    return "\n".join(lines)


def aligned(table: Table) -> str:
    """Return a table for a terminal: row names left-aligned, cells right-aligned."""
    heads = [textwrap.wrap(head, _HEAD_WIDTH) or [""] for head in table.heads]
    deepest = max(map(len, heads), default=0)
    raised = [[""] * (deepest - len(head)) + head for head in heads]  # heads are aligned at the bottom
    rows = [("", *line) for line in zip(*raised, strict=True)]
    cells = [*rows, *table.rows]
    widths = [max(len(row[k]) for row in cells) for k in range(len(table.heads) + 1)]

    def line(row: tuple[str, ...]) -> str:
        first, *rest = row
        return "  ".join([first.ljust(widths[0]), *(c.rjust(w) for c, w in zip(rest, widths[1:], strict=True))])

    rule = "-" * (sum(widths) + 2 * len(table.heads))
    return "\n".join([*(line(row).rstrip() for row in rows), rule, *(line(row).rstrip() for row in table.rows)])


def self_test_report(found: SelfTest) -> str:
    """Return the expectation, the trials and the advice of a self-test."""
    lines = [found.summary()]
    right, wrong = found.of("right"), found.of("wrong")
    if right:
        missed = sum(not t.accepted for t in right)
        false = sum(t.accepted and not t.right for t in right)
        lines.append(
            f"  {len(right)} photos rendered from the scan, no initial pose: {sum(t.right for t in right)} correct "
            f"(median {found.picture_px:.2g} px), {missed} not accepted, {false} accepted with a wrong pose"
        )
    by_level: dict[float, list[bool]] = {}
    for trial in found.of("start"):
        by_level.setdefault(trial.off_deg, []).append(trial.right)
    levels = [f"{sum(ends)} of {len(ends)} from {level:g} deg" for level, ends in sorted(by_level.items())]
    if levels:
        lines.append(f"  from an inaccurate initial pose: {', '.join(levels)} correct")
    if wrong:
        lines.append(f"  photos of other scenes: {sum(t.accepted for t in wrong)} of {len(wrong)} accepted")
    if found.trials:
        lines.append(f"  {sum(t.seconds for t in found.trials) / len(found.trials):.1f} s each")
    if found.advice():
        lines.append(found.advice())
    lines.append("Real photos, of a scene that may have changed, will not do better than this.")
    return "\n".join(lines)
