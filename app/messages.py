"""A registration in an operator's words."""

from __future__ import annotations

import textwrap
import unicodedata
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ladarreg_core.comparison import Comparison
    from ladarreg_core.export.comparison_table import Table
    from ladarreg_core.quality.assessment import Assessment
    from ladarreg_core.quality.findings import Finding
    from ladarreg_core.results import PoseResult, Registration
    from ladarreg_core.scan import Scan
    from ladarreg_core.self_test.report import SelfTest

EVIDENCE = {
    "image": "verified on the picture itself",
    "statistics": "by the statistics of its matches",
    "none": "no evidence",
}
_HEAD_WIDTH = 16
_MOST_FINDINGS = 4
_IN_THE_VERDICT = {"matches", "inliers", "residuals"}
_IN_THE_CAUTIONS = {"matches", "spread", "relief", "baseline", "disparity"}
_CAUSES = {"spread", "depth", "relief"}
"""Whose consequence the finding `conditioning` is."""


def one_line(text: str) -> str:
    """Return the text on one line, with control characters (of file names, say) made visible."""
    words = " ".join(text.split())
    return "".join(c if unicodedata.category(c)[0] != "C" else c.encode("unicode_escape").decode() for c in words)


def verdict(result: PoseResult) -> str:
    """Return accepted or not, and by which evidence."""
    if result.accepted:
        return f"Accepted, {EVIDENCE[result.evidence]}."
    return "Not accepted: the evidence is not enough to call this registered."


def position(result: PoseResult) -> str:
    """Return where the camera stood, seen from the scanner, with its standard deviation."""
    return f"{result.thesis_parameters.in_words()} (sigma {1000 * result.sigma_position_m:.1f} mm)"


def turn(result: PoseResult) -> str:
    """Return how the camera was turned against the scanner's X, with its standard deviation."""
    return f"{result.thesis_parameters.turn_in_words()} (sigma {sigma_angle(result)})"


def sigma_angle(result: PoseResult) -> str:
    """Return the standard deviation of the turn, in degrees."""
    return f"{57.29577951308232 * result.sigma_angle_rad:.3f} deg"


def matches(result: PoseResult) -> str:
    """Return how many matches hold, and how well."""
    inliers = int(result.inliers.sum())
    text = f"{inliers} of {len(result.matches)} hold"
    if inliers:
        squares = (result.residuals_px[result.inliers] ** 2).sum(axis=-1)
        text += f", {float(squares.mean()) ** 0.5:.2f} px rms"
    return text


def report(result: PoseResult) -> str:
    """Return the whole verdict, several lines."""
    lines = [verdict(result), *(f"  {one_line(reason)}" for reason in result.reasons)]
    if result.accepted:
        lines += [
            f"Camera   {position(result)}",
            f"Turned   {turn(result)}",
            f"Matches  {matches(result)}",
        ]
    return "\n".join(lines)


def assessed(assessment: Assessment, result: Registration) -> list[str]:
    """Return what an operator should know or do beside the verdict, a few lines: all of it is in registration.json."""
    lines = []
    if result.accepted and assessment.uncertainty is not None:
        lines.append(f"Picture  {assessment.uncertainty.summary()}")
    shown = worth_telling(assessment, result)
    for finding in shown[:_MOST_FINDINGS]:
        lines.append(f"{finding.level.capitalize():<8} {one_line(f'{finding.sentence} {finding.what_to_do}')}")
    if len(shown) > _MOST_FINDINGS:
        lines.append(f"         and {len(shown) - _MOST_FINDINGS} more in registration.json")
    if result.method == "manual":
        if assessment.match_to_check:
            lines.append(f"Check    {one_line(assessment.match_to_check)}")
        if assessment.advice and (result.accepted or 2 * int(result.inliers.sum()) >= len(result.matches)):
            lines.append(f"Next     {one_line(assessment.advice[0].summary())}")
    return lines


def worth_telling(assessment: Assessment, result: Registration) -> list[Finding]:
    """Return the findings that an operator can act on and that the verdict's reasons do not tell, the worst first."""
    found = [finding for finding in assessment.findings or () if finding.level != "good"]
    if result.method == "manual":
        told = set() if result.accepted else _IN_THE_VERDICT
    elif not result.accepted:
        return []  # of a pose that was not found
    else:  # nobody put these matches down
        told = {finding.name for finding in found if finding.level == "fair"}
        told |= _IN_THE_CAUTIONS if result.method == "thesis" else set()
    found = [finding for finding in found if finding.name not in told]
    if any(finding.name in _CAUSES for finding in found):
        found = [finding for finding in found if finding.name != "conditioning"]
    return sorted(found, key=lambda finding: finding.level != "poor")


def comparison_verdict(comparison: Comparison) -> str:
    """Return the default's verdict, which is the comparison's."""
    from ladarreg_core.export.comparison_table import default_of

    default = default_of(comparison)
    if default is not None and default.stage.result is not None:
        return verdict(default.stage.result)
    note = "" if default is None else one_line(default.stage.note)
    return f"Not accepted: the default gave no pose. {note}".rstrip()


def comparison_report(comparison: Comparison, scan: Scan) -> str:
    """Return the table with what was foreseen above it, and why each stage is judged as it is below."""
    from ladarreg_core.export.comparison_table import cautions_of, comparison_table, title_of, verdict_of

    lines = [f"Caution  {one_line(caution)}" for caution in cautions_of(comparison)]
    lines += [aligned(comparison_table(comparison, scan)), ""]
    for column in comparison.columns:
        result = column.stage.result
        reasons = [column.stage.note, *(() if result is None else result.reasons)]
        lines.append(f"{title_of(column)}: {verdict_of(column)}")
        lines += [f"  {one_line(reason)}" for reason in reasons if reason]
    return "\n".join(lines)


def aligned(table: Table) -> str:
    """Return a table for a terminal: names at the left, cells at the right of their columns."""
    heads = [textwrap.wrap(head, _HEAD_WIDTH) or [""] for head in table.heads]
    deepest = max(map(len, heads), default=0)
    raised = [[""] * (deepest - len(head)) + head for head in heads]  # they all end on the lowest line
    rows = [("", *line) for line in zip(*raised, strict=True)]
    cells = [*rows, *table.rows]
    widths = [max(len(row[k]) for row in cells) for k in range(len(table.heads) + 1)]

    def line(row: tuple[str, ...]) -> str:
        first, *rest = row
        return "  ".join([first.ljust(widths[0]), *(c.rjust(w) for c, w in zip(rest, widths[1:], strict=True))])

    rule = "-" * (sum(widths) + 2 * len(table.heads))
    return "\n".join([*(line(row).rstrip() for row in rows), rule, *(line(row).rstrip() for row in table.rows)])


def self_test_report(found: SelfTest) -> str:
    """Return what to expect, what was tried, and what to do."""
    lines = [found.summary()]
    right, wrong = found.of("right"), found.of("wrong")
    if right:
        missed = sum(not t.accepted for t in right)
        astray = sum(t.accepted and not t.right for t in right)
        lines.append(
            f"  {len(right)} photographs made from the scan, without a guess: {sum(t.right for t in right)} right "
            f"(median {found.picture_px:.2g} px), {missed} not accepted, {astray} accepted and wrong"
        )
    by_level: dict[float, list[bool]] = {}
    for trial in found.of("start"):
        by_level.setdefault(trial.off_deg, []).append(trial.right)
    levels = [f"{sum(ends)} of {len(ends)} from {level:g} deg off" for level, ends in sorted(by_level.items())]
    if levels:
        lines.append(f"  looked for near a start that is off: {', '.join(levels)} found")
    if wrong:
        lines.append(f"  pictures of other places: {sum(t.accepted for t in wrong)} of {len(wrong)} accepted")
    if found.trials:
        lines.append(f"  {sum(t.seconds for t in found.trials) / len(found.trials):.1f} s each")
    if found.advice():
        lines.append(found.advice())
    lines.append("Real photographs, of a scene in which things have moved, do no better than this.")
    return "\n".join(lines)
