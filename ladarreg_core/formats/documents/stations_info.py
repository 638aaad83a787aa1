"""The contents of a `stations.json` in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ladarreg_core.errors import FormatError, LadarregError
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.frames import Rigid

VERSION = 1
"""Version of `stations.json` that is written and read."""


def stated_poses(fields: Mapping[str, Any]) -> dict[str, Rigid]:
    """Return the `world_from_scanner` that a `stations.json` states for each file of a scan.

    Raises:
        FormatError: if it is of another version, or damaged.
    """
    version, listed = fields.get("version"), fields.get("stations")
    if isinstance(version, bool) or version != VERSION:
        raise FormatError(
            f"it is of version {one_line(repr(version), 30)}, and version {VERSION} is read; register the stations "
            "again"
        )
    if fields.get("kind") != "stations" or not isinstance(listed, list):
        raise FormatError("it does not describe stations; give the folder of `register-scans`")
    poses: dict[str, Rigid] = {}
    for number, one in enumerate(listed):
        if not isinstance(one, dict):
            raise FormatError(f"station {number} is no object; register the stations again")
        scan, pose = one.get("scan"), one.get("world_from_scanner")
        if scan is None and pose is None:
            continue
        if not isinstance(scan, str) or scan in poses:
            raise FormatError(f"station {number} has a pose and names no scan of its own; register the stations again")
        try:
            poses[scan] = Rigid.from_matrix([] if pose is None else pose)
        except (LadarregError, TypeError, ValueError):
            raise FormatError(f"the pose of {one_line(scan, 60)} is damaged; register the stations again") from None
    if not poses:
        raise FormatError("it names no scans; register the stations again")
    return poses


def station_lines(fields: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the contents of a `stations.json` in words: pairs of a name and a text.

    Raises:
        FormatError: if they are damaged.
    """
    stated_poses(fields)
    try:
        names = [one_line(one["name"], 60) for one in fields["stations"]]
        lines = []
        for one, name in zip(fields["stations"], names, strict=True):
            text = {"fixed": "fixed", "out": "left out"}.get(one["state"])
            if text is None:
                where = ", ".join(f"{float(row[3]):.3f}" for row in one["world_from_scanner"][:3])
                known = {"kept": "as its file states", "stated": "as its file states, not verified"}.get(one["state"])
                if known is None:
                    known = f"sigma {max(one['sigma_mm']):.2g} mm, {max(one['sigma_deg']):.2g} deg"
                text = f"at {where} m, {known}"
            lines.append(("station", f"{name}: {text}"))
        for pair in fields["pairs"]:
            both = f"{names[pair['second']]} to {names[pair['first']]}"
            lines.append(
                ("pair", f"{both}: {one_line(pair['verdict'], 20)}. {one_line(' '.join(pair['reasons']), 600)}")
            )
        for loop in fields["loops"]:
            around = " - ".join(names[index] for index in loop["stations"])
            lines.append(("loop", f"{around}: {loop['error_mm']:.2f} mm, {loop['error_deg']:.4f} deg"))
        lines += [("note", one_line(reason, 600)) for reason in fields["reasons"]]
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise FormatError(f"it is damaged ({one_line(error, 60)}); give an unmodified file") from None
    return lines
