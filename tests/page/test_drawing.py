"""Drawing and moving matches in the two image panes by mouse and by keyboard, sub-pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.page.two_panes import (
    PHOTO,
    PHOTO_LINE,
    SCAN_LINE,
    VIEW,
    asked,
    drag,
    pixels,
    place,
    rays,
    settled,
    wait_for_picks,
    wait_for_snap,
)

if TYPE_CHECKING:
    from playwright.sync_api import Page


@pytest.mark.slow
@pytest.mark.parametrize("how", ["drag", "clicks"])
@pytest.mark.parametrize("first", ["scan", "photo"])
def test_a_line_drawn_in_both_panes_is_one_match_at_the_mouses_own_pixels(panes: Page, first: str, how: str) -> None:
    lines = {"scan": SCAN_LINE, "photo": PHOTO_LINE}
    for side in (first, "photo" if first == "scan" else "scan"):
        assert asked(panes, "add_pick") == []
        if how == "drag":
            drag(panes, side, *lines[side])
        else:
            for end in lines[side]:
                panes.mouse.click(*place(panes, side, end))
    (pick,) = wait_for_picks(panes, 1)
    assert len(asked(panes, "add_pick")) == 1
    assert pick["kind"] == "line"
    np.testing.assert_allclose(pick["photo"], PHOTO_LINE, atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(pick["scan"], axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(pixels(pick["scan"]), SCAN_LINE, atol=0.01)


@pytest.mark.slow
def test_points_snap_only_to_a_corner_that_is_near_on_the_screen(panes: Page) -> None:
    panes.evaluate("view.set({ snap: true, tool: 'point' })")
    near, far = [101.2, 79.5], [110.0, 90.0]  # the nearest corners stand at (100, 80), and 10 px away
    for side, uv in (("scan", near), ("photo", far)):
        panes.mouse.move(*place(panes, side, uv))
        panes.mouse.down()
        panes.mouse.move(*place(panes, side, (uv[0], uv[1] + 0.1)))
        wait_for_snap(panes, [uv[0], uv[1] + 0.1])
        panes.mouse.up()
    (pick,) = wait_for_picks(panes, 1)
    np.testing.assert_allclose(pixels(pick["scan"]), [[100, 80]], atol=1e-6)
    np.testing.assert_allclose(pick["photo"], [[110.0, 90.1]], atol=0.01)


def draw_beside_the_edge(page: Page, side: str, *, held: str = "") -> None:
    """Draw a line beside the edge at v = 100; a key may be pressed before the release."""
    a, b = [60.0, 101.5], [160.0, 98.5]
    page.mouse.move(*place(page, side, a))
    page.mouse.down()
    page.mouse.move(*place(page, side, [110, 100]))
    page.mouse.move(*place(page, side, b))
    wait_for_snap(page, b)
    if held:
        page.keyboard.down(held)
    page.mouse.up()
    if held:
        page.keyboard.up(held)


@pytest.mark.slow
def test_a_line_snaps_across_the_edge_under_it_and_shift_suspends_it(panes: Page) -> None:
    panes.evaluate("view.set({ snap: true })")
    draw_beside_the_edge(panes, "scan")
    draw_beside_the_edge(panes, "photo", held="Shift")
    (pick,) = wait_for_picks(panes, 1)
    np.testing.assert_allclose(pixels(pick["scan"]), [[60, 100], [160, 100]], atol=0.01)
    np.testing.assert_allclose(pick["photo"], [[60, 101.5], [160, 98.5]], atol=0.01)


@pytest.mark.slow
def test_escape_drops_the_open_line_and_a_refusal_keeps_it(panes: Page) -> None:
    drag(panes, "scan", *SCAN_LINE)
    panes.keyboard.press("Escape")
    drag(panes, "photo", *PHOTO_LINE)
    assert asked(panes, "add_pick") == []
    panes.evaluate("refused.add('add_pick')")
    drag(panes, "scan", *SCAN_LINE)
    panes.wait_for_function("notices.length === 1")
    assert "refused" in panes.evaluate("notices[0]")
    panes.evaluate("refused.clear()")
    drag(panes, "scan", [80.0, 60.0], [200.0, 220.0])
    (pick,) = wait_for_picks(panes, 1)
    np.testing.assert_allclose(pick["photo"], PHOTO_LINE, atol=0.01)  # the first side was not lost
    np.testing.assert_allclose(pixels(pick["scan"]), [[80, 60], [200, 220]], atol=0.01)


@pytest.mark.slow
def test_under_a_pose_the_predicted_partner_is_taken_by_enter_or_by_its_tick(panes: Page) -> None:
    pose = {"shown": "linear", "stages": [{"stage": "linear", "parameters": []}]}
    panes.evaluate("(poses) => store.take({ slices: { 'poses:p1': poses } })", pose)
    lines, shift = np.array([[[60.0, 60.0], [200.0, 150.0]], [[60.0, 120.0], [200.0, 190.0]]]), np.array([10, -5])
    for count, accept, line in ((1, "key", lines[0]), (2, "tick", lines[1])):
        drag(panes, "scan", *line)
        panes.wait_for_function("(n) => asked.filter(([what]) => what === 'predict').length === n", arg=count)
        panes.wait_for_function("document.querySelector('#photo-pane .pane-partner').textContent.includes('Enter')")
        if accept == "key":
            panes.keyboard.press("Enter")
        else:
            panes.mouse.click(*place(panes, "photo", line.mean(axis=0) + shift))
        pick = wait_for_picks(panes, count)[-1]
        np.testing.assert_allclose(pick["photo"], line + shift, atol=0.01)


@pytest.mark.slow
def test_a_selected_end_is_nudged_dragged_switched_off_and_removed(panes: Page) -> None:
    match = {"id": "m1", "number": 1, "kind": "line", "scan": rays(SCAN_LINE).tolist(), "photo": PHOTO_LINE, "on": True}
    panes.evaluate("(pick) => store.take({ slices: { 'picks:p1': [pick] } })", match)
    panes.keyboard.press("v")
    panes.mouse.click(*place(panes, "photo", PHOTO_LINE[1]))
    for key in ("ArrowRight", "ArrowRight", "Shift+ArrowUp"):
        panes.keyboard.press(key)
    # moves are sent one at a time, of several in quick succession the newest: when it is stored, none is left
    panes.wait_for_function("(v) => Math.abs(store.picksOf()[0].photo[1][1] - v) < 1e-6", arg=PHOTO_LINE[1][1] - 1)
    settled(panes)
    moved = np.array(panes.evaluate("store.picksOf()[0].photo")) - PHOTO_LINE
    np.testing.assert_allclose(moved, [[0, 0], [0.2, -1.0]], atol=1e-9)
    before = len(asked(panes, "set_pick"))
    drag(panes, "scan", SCAN_LINE[0], [150.5, 90.25])
    panes.wait_for_function("(n) => asked.filter(([what]) => what === 'set_pick').length > n", arg=before)
    assert len(asked(panes, "set_pick")) == before + 1  # one edit a drag
    dragged = pixels(panes.evaluate("store.picksOf()[0].scan"))
    np.testing.assert_allclose(dragged, [[150.5, 90.25], SCAN_LINE[1]], atol=0.01)
    panes.keyboard.press("Space")
    panes.wait_for_function("store.picksOf()[0].on === false")
    panes.keyboard.press("Delete")
    wait_for_picks(panes, 0)


@pytest.mark.slow
def test_a_line_can_be_drawn_without_a_mouse(panes: Page) -> None:
    panes.locator("#scan-pane .pane-body").focus()
    moves = (["ArrowRight"] * 2 + ["Shift+ArrowDown"] * 3, ["Shift+ArrowLeft"] * 5 + ["Control+ArrowUp"] * 5)
    for _ in ("scan", "photo"):
        for keys in moves:
            for key in keys:
                panes.keyboard.press(key)
            panes.keyboard.press("Enter")
    (pick,) = wait_for_picks(panes, 1)
    for drawn, size in ((pixels(pick["scan"]), VIEW), (np.array(pick["photo"]), PHOTO)):
        np.testing.assert_allclose(drawn - (np.array(size) - 1) / 2, [[2, 30], [-48, 29.5]], atol=1e-6)


@pytest.mark.slow
def test_the_line_tool_drags_an_end_of_the_selected_line_and_draws_a_new_one_elsewhere(panes: Page) -> None:
    match = {"id": "m1", "number": 1, "kind": "line", "scan": rays(SCAN_LINE).tolist(), "photo": PHOTO_LINE, "on": True}
    panes.evaluate("(pick) => { store.take({ slices: { 'picks:p1': [pick] } }); view.set({ snap: false }); }", match)
    drag(panes, "photo", PHOTO_LINE[1], [200.5, 90.25])  # not selected: a new line begins at its end
    assert asked(panes, "set_pick") == []
    panes.keyboard.press("Escape")
    panes.evaluate("view.set({ selected: new Set(['m1']) })")
    drag(panes, "photo", PHOTO_LINE[1], [200.5, 90.25])
    panes.wait_for_function("asked.some(([what]) => what === 'set_pick')")
    np.testing.assert_allclose(panes.evaluate("store.picksOf()[0].photo"), [PHOTO_LINE[0], [200.5, 90.25]], atol=0.01)
    drag(panes, "photo", [30.5, 150.5], [120.25, 170.75])
    drag(panes, "scan", [30.5, 200.5], [220.25, 240.75])
    second = wait_for_picks(panes, 2)[1]
    np.testing.assert_allclose(second["photo"], [[30.5, 150.5], [120.25, 170.75]], atol=0.01)
