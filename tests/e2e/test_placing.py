"""A camera is placed by hand, with a preview over the photograph, and the registration starts from there."""

from __future__ import annotations

import pytest

from testing.workbench.operator import Operator
from testing.workbench.pages import wait_for_store


@pytest.mark.slow
def test_a_camera_is_nudged_previewed_and_refined(operator: Operator) -> None:
    page = operator.page
    previews: list[str] = []
    page.on("request", lambda request: previews.append(request.url) if "pose=" in request.url else None)
    page.get_by_role("button", name="Display", exact=True).click()
    page.get_by_role("button", name="Place by hand").click()
    bar = page.get_by_role("region", name="Place the camera")
    bar.wait_for()
    operator.wait(lambda: previews, "a preview of where it starts")
    for name in ("Move left", "Move forward", "Turn right"):
        seen = len(previews)
        bar.get_by_role("button", name=name).click()
        operator.wait(lambda n=seen: len(previews) > n, f"a preview after {name}")
    seen = len(previews)
    bar.press("Shift+ArrowUp")
    operator.wait(lambda: len(previews) > seen, "a preview after a key")
    operator.shot("placed")
    assert operator.slice("poses:p1")["stages"] == [], "placing solves nothing"
    bar.get_by_role("button", name="Refine").click()
    bar.wait_for(state="hidden")
    wait_for_store(page, "store.get('job')?.kind === 'refine' && store.get('job').state === 'done'")
    assert operator.slice("photos")[0]["state"] == "accepted"

    page.get_by_role("button", name="Display", exact=True).click()
    page.get_by_role("button", name="Place by hand").click()
    bar.wait_for()
    bar.press("Escape")
    bar.wait_for(state="hidden")
    assert operator.slice("photos")[0]["state"] == "accepted"
