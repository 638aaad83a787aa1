"""The legend of the model's colours, as HTML for viser's panel."""

from __future__ import annotations

import html

from ladarreg_core.inspection.model_textures import Legend

from .colours import as_css


def legend_html(legend: Legend, said: str = "") -> str:
    """Return a legend: a title, a scale with its ends, colours with words, and what is to be said beside it."""
    if not legend.title:
        return ""
    parts = [f"<p>{html.escape(legend.title)}</p>"]
    if said:
        parts.insert(0, f'<p class="lr-said">{html.escape(said)}.</p>')
    if legend.ramp:
        colours = ", ".join(map(as_css, legend.ramp))
        ends = f"<span>{html.escape(legend.least)}</span><span>{html.escape(legend.most)}</span>"
        parts.append(
            f'<div class="lr-ramp" style="background: linear-gradient(to right, {colours})"></div>'
            f'<div class="lr-ends">{ends}</div>'
        )
    for colour, words in legend.entries:
        parts.append(
            f'<div class="lr-entry"><i style="background: {as_css(colour)}"></i><span>{html.escape(words)}</span></div>'
        )
    return f'<div class="lr lr-legend" role="group" aria-label="Legend">{"".join(parts)}</div>'
