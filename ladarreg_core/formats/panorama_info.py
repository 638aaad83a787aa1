"""The contents of a `panorama.json` in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def panorama_lines(fields: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the contents of a `panorama.json` in words: pairs of a name and a text."""
    counts, mount, pieces = fields["counts"], fields["mount"], fields["pieces"]
    cells = counts["rows"] * counts["columns"]
    xyz = ", ".join(f"{1000 * value:.1f}" for value in mount["xyz_m"])
    rpy = ", ".join(f"{value:.3f}" for value in mount["rpy_deg"])
    what = "sweeps" if fields["mode"] == "sweep" else "mosaic"
    lines = [
        (
            "panorama",
            f"{counts['rows']} x {counts['columns']} cells, {100 * counts['returns'] / cells:.0f} % with returns",
        ),
        (
            "made of",
            f"{len(pieces)} pieces ({what})" + (f", {len(fields['missing'])} missing" if fields["missing"] else ""),
        ),
        ("mount", f"{xyz} mm, roll pitch yaw {rpy} deg ({mount['from']})"),
    ]
    if counts.get("overlapping"):
        share = 100 * counts.get("disagreeing", 0) / counts["overlapping"]
        lines.append(("overlap", f"{counts['overlapping']:,} cells, in {share:.1f} % of them the pieces disagree"))
    if counts.get("folded"):
        lines.append(("dropped", f"{counts['folded']:,} returns behind a nearer surface"))
    return lines
