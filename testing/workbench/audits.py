"""Audits of the whole page: contrast, use without a mouse, layout, and the rules of axe-core."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Page

_CONTRAST = (Path(__file__).parent / "contrast.js").read_text(encoding="utf-8")
_LAYOUT = (Path(__file__).parent / "layout_faults.js").read_text(encoding="utf-8")
_FOCUSED = """() => {
  const at = document.activeElement;
  const [style, after] = [getComputedStyle(at), getComputedStyle(at, "::after")];
  at.reached = true;
  return {
    name: at === document.body ? "" : `${at.localName}.${at.className}`,
    ring: (style.outlineStyle !== "none" && parseFloat(style.outlineWidth) > 0) || style.boxShadow !== "none" ||
      (parseFloat(after.borderTopWidth) > 0 && after.borderTopColor !== "rgba(0, 0, 0, 0)"),
    picture: at.matches(".pane-body"),
  };
}"""
_MISSED = """() => [...document.querySelectorAll("button, input, select, a[href], [tabindex]")]
  .filter((each) => each.checkVisibility({ visibilityProperty: true }) && !each.disabled)
  .filter((each) => each.tabIndex >= 0 && !each.reached)
  .map((each) => `${each.localName}.${each.className}`)"""
_MAX_CONTROLS = 200


def hard_to_read(page: Page) -> list[str]:
    """Return what is visible now with too little contrast, with its contrast and its selector."""
    found = page.evaluate(_CONTRAST)
    assert found["seen"] > 5, "hardly anything was visible"
    return list(found["bad"])


def lost_without_a_mouse(page: Page) -> tuple[set[str], list[str]]:
    """Step through the page by Tab; return what does not show the focus, and what is never reached."""
    unseen = set()
    for _ in range(_MAX_CONTROLS):
        page.keyboard.press("Tab")
        at = page.evaluate(_FOCUSED)
        if not at["name"]:
            break
        if not at["ring"]:
            unseen.add(at["name"])
        if at["picture"]:
            page.keyboard.press("Escape")  # after which Tab leaves the pictures
    return unseen, page.evaluate(_MISSED)


def serious_findings(page: Page) -> list[str]:
    """Return what axe-core calls serious or critical, with the rule and the element."""
    from axe_playwright_python.sync_playwright import Axe

    # the 3-D view is viser's own page, and empty in tests; axe would wait for it
    found = Axe().run(page, context={"exclude": [["iframe"]]})
    return [
        f"{rule['id']}: {' '.join(map(str, node['target']))}: {node['html'][:160]}"
        for rule in found.response["violations"]
        if rule["impact"] in ("serious", "critical")
        for node in rule["nodes"]
    ]


def layout_faults(page: Page) -> list[str]:
    """Return which controls are clipped, covered, outside of the window, or too small; 40 px are needed for fingers."""
    least = 40 if page.evaluate("matchMedia('(max-width: 600px)').matches") else 24
    found = page.evaluate(_LAYOUT, least)
    assert found["count"] > 0, "no control was visible"
    return list(found["found"])
