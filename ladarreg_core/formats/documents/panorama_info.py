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
    lines = [("refused", f"not accepted: {reason}") for reason in fields.get("reasons") or []]
    lines += [
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
    if mount.get("sigma"):
        known = ", ".join(f"{name.replace('_', ' ')} {value:.3g}" for name, value in mount["sigma"].items() if value)
        lines.append(("sigma", f"of the mount: {known}"))
    if mount.get("not_determined"):
        lines.append(("unknown", f"not determined, as given: {', '.join(mount['not_determined'])} of the mount"))
    if mount.get("base"):
        base = mount["base"]
        said = base if isinstance(base, str) else f"roll pitch yaw {', '.join(f'{value:.3f}' for value in base)} deg"
        lines.append(("base", f"{said}; the panorama is level"))
    if mount.get("base_sigma_deg"):
        roll, pitch = mount["base_sigma_deg"]
        lines.append(("level", f"known to {roll:g} deg in roll, {pitch:g} deg in pitch of the unit's base"))
    if fields.get("camera"):
        lines.append(("camera", str(fields["camera"]["said"])))
        lines += [("camera note", str(reason)) for reason in fields["camera"].get("reasons") or []]
    for reason in (mount.get("calibration") or {}).get("reasons") or []:
        lines.append(("mount note", str(reason)))
    checked = fields.get("refinement") or fields.get("calibration")
    if checked:
        change = f"{checked['held_out_before_mm'] or 0:.2f} -> {checked['held_out_after_mm'] or 0:.2f} mm"
        lines.append(("checked", f"{change} on surfaces left out; {'used' if checked['accepted'] else 'not used'}"))
    if fields.get("closure"):
        lines.append(("closure", str(fields["closure"]["said"])))
    lines += [("note", str(note)) for note in fields.get("notes") or []]
    if counts.get("overlapping"):
        share = 100 * counts.get("disagreeing", 0) / counts["overlapping"]
        lines.append(("overlap", f"{counts['overlapping']:,} cells, in {share:.1f} % of them the pieces disagree"))
    if counts.get("folded"):
        lines.append(("dropped", f"{counts['folded']:,} returns behind a nearer surface"))
    return lines
