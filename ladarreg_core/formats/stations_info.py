"""The contents of a `stations.json` in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.untrusted import one_line


def station_lines(fields: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the contents of a `stations.json` in words: pairs of a name and a text.

    Raises:
        FormatError: if they are damaged.
    """
    try:
        names = [one_line(one["name"], 60) for one in fields["stations"]]
        lines = []
        for one, name in zip(fields["stations"], names, strict=True):
            text = {"fixed": "fixed", "out": "left out"}.get(one["state"])
            if text is None:
                where = ", ".join(f"{float(row[3]):.3f}" for row in one["world_from_scanner"][:3])
                mm, deg = max(one["sigma_mm"]), max(one["sigma_deg"])
                text = f"at {where} m, sigma {mm:.2g} mm, {deg:.2g} deg"
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
