"""The legend of the model's colours, as HTML for viser's panel."""

from __future__ import annotations

import html

from ladarreg_core.inspection.model_textures import Legend
from ladarreg_core.palette import as_css


def legend_html(legend: Legend, note: str = "") -> str:
    """Return a legend: a note, a title, a colour scale with its ends, and colours with their labels."""
    if not legend.title:
        return ""
    parts = [f"<p>{html.escape(legend.title)}</p>"]
    if note:
        parts.insert(0, f'<p class="lr-said">{html.escape(note)}.</p>')
    if legend.ramp:
        colours = ", ".join(map(as_css, legend.ramp))
        ends = f"<span>{html.escape(legend.least)}</span><span>{html.escape(legend.most)}</span>"
        parts.append(
            f'<div class="lr-ramp" style="background: linear-gradient(to right, {colours})"></div>'
            f'<div class="lr-ends">{ends}</div>'
        )
    for colour, label in legend.entries:
        parts.append(
            f'<div class="lr-entry"><i style="background: {as_css(colour)}"></i><span>{html.escape(label)}</span></div>'
        )
    return f'<div class="lr lr-legend" role="group" aria-label="Legend">{"".join(parts)}</div>'
