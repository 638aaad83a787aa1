"""Every control is whole, in reach and large enough, at all usual widths and in both themes."""

from __future__ import annotations

import os

import pytest

from testing.workbench.audits import layout_faults
from testing.workbench.operator import Operator

WIDTHS = {390: 844, 768: 1024, 1024: 768, 1280: 800, 1440: 900, 1920: 1080}
STEPS = ("Acquire", "Stations", "Match", "Solve", "Judge", "Export")


def faults_at(operator: Operator, width: int, name: str) -> list[str]:
    operator.page.set_viewport_size({"width": width, "height": WIDTHS[width]})
    operator.page.wait_for_timeout(150) if os.environ.get("LADARREG_SHOTS") else None
    operator.shot(f"{width}-{name}")
    return [f"{width}, {name}: {fault}" for fault in layout_faults(operator.page)]


@pytest.mark.slow
@pytest.mark.parametrize("theme", ["dark", "light"])
def test_every_step_fits(onlooker: Operator, theme: str) -> None:
    onlooker.page.evaluate("theme => { document.documentElement.dataset.theme = theme; }", theme)
    found = []
    for step in STEPS:
        onlooker.step(step)
        for width in WIDTHS:
            found += faults_at(onlooker, width, f"{step.lower()}-{theme}")
    assert not found, "\n".join(found)
