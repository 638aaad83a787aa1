"""What is half drawn stays with its photograph, scan and project."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.page.two_panes import PHOTO_LINE, SCAN_LINE, asked, drag, pixels, place, settled, wait_for_picks

if TYPE_CHECKING:
    from playwright.sync_api import Page


SECOND_PHOTO = {"id": "p2", "name": "second.png", "width": 300, "height": 200, "camera": {"fx": 250}}


def show_photo(page: Page, photo: str, *, known: str = "p1 p2") -> None:
    """Show a photograph of those that exist."""
    photos = [SECOND_PHOTO | {"id": name, "name": f"{name}.png"} for name in known.split()]
    page.evaluate("([photos, shown]) => store.take({ slices: { photos, shown } })", [photos, photo])


@pytest.mark.slow
@pytest.mark.parametrize("first", ["scan", "photo"])
def test_an_unfinished_line_stays_with_its_photograph(panes: Page, first: str) -> None:
    lines = {"scan": SCAN_LINE, "photo": PHOTO_LINE}
    second = "photo" if first == "scan" else "scan"
    drag(panes, first, *lines[first])
    show_photo(panes, "p2")
    assert panes.evaluate("notices") == ["The unfinished match stays with p1.png: show that photograph to complete it."]
    drag(panes, second, *lines[second])
    settled(panes)
    assert asked(panes, "add_pick") == [], "it is not matched with another photograph"
    panes.keyboard.press("Escape")
    show_photo(panes, "p1")
    drag(panes, second, *lines[second])
    (pick,) = wait_for_picks(panes, 1)
    assert [sent["photo"] for sent in asked(panes, "add_pick")] == ["p1"]
    np.testing.assert_allclose(pick["photo"], PHOTO_LINE, atol=0.01)
    np.testing.assert_allclose(pixels(pick["scan"]), SCAN_LINE, atol=0.01)


@pytest.mark.slow
def test_a_stroke_ends_when_another_photograph_is_shown(panes: Page) -> None:
    panes.mouse.move(*place(panes, "photo", PHOTO_LINE[0]))
    panes.mouse.down()
    panes.mouse.move(*place(panes, "photo", PHOTO_LINE[1]), steps=3)
    show_photo(panes, "p2")
    panes.mouse.up()
    drag(panes, "scan", *SCAN_LINE)
    settled(panes)
    assert asked(panes, "add_pick") == []
    assert panes.evaluate("notices") == ["The unfinished stroke was discarded: another photograph is shown."]


@pytest.mark.slow
def test_a_drag_of_a_match_ends_when_another_photograph_is_shown(panes: Page) -> None:
    drag(panes, "scan", *SCAN_LINE)
    drag(panes, "photo", *PHOTO_LINE)
    (pick,) = wait_for_picks(panes, 1)
    panes.evaluate("(pick) => store.take({ slices: { 'picks:p2': [pick] } })", pick)  # of the same id
    panes.keyboard.press("v")
    panes.mouse.move(*place(panes, "photo", PHOTO_LINE[1]))
    panes.mouse.down()
    panes.mouse.move(*place(panes, "photo", [200, 100]), steps=3)
    show_photo(panes, "p2")
    assert panes.evaluate("view.get().selected.size") == 0
    panes.mouse.up()
    panes.keyboard.press("Delete")
    settled(panes)
    assert asked(panes, "set_pick") == asked(panes, "remove_picks") == []


@pytest.mark.slow
def test_an_unfinished_line_is_discarded_with_its_photograph_or_scan(panes: Page) -> None:
    drag(panes, "scan", *SCAN_LINE)
    show_photo(panes, "p2", known="p2")
    assert "its photograph was removed" in panes.evaluate("notices.at(-1)")
    drag(panes, "photo", *PHOTO_LINE)
    panes.evaluate("store.take({ slices: { scan: { ...store.get('scan'), id: 's2' } } })")
    drag(panes, "scan", *SCAN_LINE)  # the photograph's side is still there
    panes.wait_for_function("asked.some(([what]) => what === 'add_pick')")
    assert asked(panes, "add_pick")[0]["photo"] == "p2"
    drag(panes, "scan", *SCAN_LINE)
    panes.evaluate("store.take({ slices: { scan: { ...store.get('scan'), id: 's3' } } })")
    assert "another scan was opened" in panes.evaluate("notices.at(-1)")
    drag(panes, "photo", *PHOTO_LINE)
    settled(panes)
    assert len(asked(panes, "add_pick")) == 1


KEPT = """async ([told, late]) => {
  sessionStorage.clear();
  const { Store } = await import('/js/net/store.js');
  const { Picking } = await import('/js/panes/picking.js');
  const { keepUnfinished } = await import('/js/panes/unfinished.js');
  const page = () => {
    const store = new Store();
    const picking = new Picking();
    keepUnfinished(picking, store);
    store.watch(['scan', 'shown'], () => picking.turnTo(store.shown()));
    return { store, picking };
  };
  const ours = { project: { id: 'A' }, scan: { id: 's' }, photos: [{ id: 'p' }], shown: 'p' };
  const others = { project: { id: 'B' }, scan: null, photos: [], shown: null };
  const first = page();
  first.store.take({ slices: ours });
  first.picking.open = { side: 'scan', kind: 'point', ends: [[1, 0, 0]] };
  if (told) first.store.take({ event: 'project', id: 'B', name: 'B', by: 'x' });
  first.store.take({ slices: others });
  first.picking.forgetScan();
  dispatchEvent(new Event('pagehide'));
  const elsewhere = page();
  elsewhere.store.take({ slices: others });
  dispatchEvent(new Event('pagehide'));
  const again = page();
  again.store.take({ slices: late ? { ...ours, scan: null } : ours });
  if (late) {
    const before = again.picking.open;
    dispatchEvent(new Event('pagehide'));
    again.store.take({ slices: { scan: ours.scan } });
    if (before) throw new Error('it was open without its scan');
  }
  return [elsewhere.picking.open, again.picking.open?.ends, sessionStorage.length];
}"""


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("late", [True, False])
def test_an_unfinished_match_waits_for_its_project(blank: Page, told: bool, late: bool) -> None:
    """Also if slices of the other project arrive before the page has started afresh, or the scan after the project."""
    assert blank.evaluate(KEPT, [told, late]) == [None, [[1, 0, 0]], 0]
