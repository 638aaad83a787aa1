"""The match table follows its one array of columns: head, cells, sorting and grid."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from testing.workbench.pages import two_frames

if TYPE_CHECKING:
    from playwright.sync_api import Page

PICKS = [
    {"id": f"m{number}", "number": number, "kind": kind, "origin": "manual", "on": on, "weight": weight,
     "scan": [[1, 0, 0]], "photo": [[5, 5]]}
    for number, kind, on, weight in ((1, "line", True, 1), (2, "point", False, 2.5), (3, "line", True, 0.25))
]  # fmt: skip
RESIDUALS = {
    "m1": {"px": 0.5, "mm": 3.2, "depth_m": -0.3, "influence": 0.01, "inlier": True},
    "m3": {"px": 7.25, "mm": 41.0, "depth_m": 0.1, "influence": 0.2, "inlier": False},
}
SLICES = {
    "shown": "p1",
    "picks:p1": PICKS,
    "judged:p1": {"by_pick": RESIDUALS, "lines": {"m1": {"used": 6, "sampled": 13}, "m3": {"used": 5, "sampled": 5}}},
}
MOUNTED = """async ([slices, extra]) => {
  const { COLUMNS } = await import('/js/panels/matches/match_columns.js');
  if (extra) COLUMNS.splice(3, 0, { ...extra, value: (row) => -row.number, text: (row) => `no. ${row.number}` });
  const { store } = await import('/js/net/store.js');
  const { mountMatchTable } = await import('/js/panels/matches/match_table.js');
  document.body.append(mountMatchTable());
  store.take({ slices });
  window.columns = COLUMNS.map(({ id }) => id);
}"""


@pytest.fixture
def table(page: Page, modules: str) -> Page:
    """A page with the style of the table, and nothing in it yet."""
    page.goto(f"{modules}/blank.html")
    for sheet in ("tokens.css", "css/base.css", "css/table.css"):
        page.add_style_tag(url=f"{modules}/{sheet}")
    page.add_style_tag(content=".match-grid { height: 200px } .icon { width: 12px; height: 12px }")
    return page


def mount(page: Page, extra: Any = None) -> None:
    """Mount the table with three matches, and optionally one more column."""
    page.evaluate(MOUNTED, [SLICES, extra])
    page.locator(".row-line[data-pick]").nth(2).wait_for()


def numbers(page: Page) -> list[int]:
    """Return the matches in the order of the table, whatever the order of their elements."""
    two_frames(page)
    rows = page.evaluate("""[...document.querySelectorAll('.row-line[data-pick]')]
        .map((row) => [row.getBoundingClientRect().top, Number(row.dataset.pick.slice(1))])""")
    return [number for _, number in sorted(rows)]


def test_each_cell_stands_below_its_head_at_every_width(table: Page) -> None:
    mount(table)
    for width, fewer in ((900, 0), (520, 1), (400, 3)):
        table.set_viewport_size({"width": width, "height": 400})
        lines = table.evaluate("""[...document.querySelectorAll('.row-line')].map((line) => [...line.children]
            .map((cell) => cell.getBoundingClientRect()).filter(({ width }) => width > 0).map(({ left }) => left))""")
        assert len(lines) == 4
        assert all(line == lines[0] for line in lines)
        assert len(lines[0]) == len(table.evaluate("columns")) - fewer
        tops = table.evaluate("[...document.querySelectorAll('.heads > *')].map((cell) => cell.offsetTop)")
        assert max(tops) - min(tops) < 10, "a head has wrapped into a second line"


@pytest.mark.slow
def test_every_column_sorts_by_its_value_and_rows_without_one_come_last(table: Page) -> None:
    mount(table)
    expected = {  # the order after the first click and after the second
        "on": ([2, 1, 3], [1, 3, 2]),
        "number": ([1, 2, 3], [3, 2, 1]),
        "kind": ([1, 3, 2], [2, 1, 3]),
        "origin": ([1, 2, 3], [1, 2, 3]),
        "samples": ([1, 3, 2], [3, 1, 2]),
        "px": ([3, 1, 2], [1, 3, 2]),
        "mm": ([3, 1, 2], [1, 3, 2]),
        "depth_m": ([1, 3, 2], [3, 1, 2]),
        "influence": ([3, 1, 2], [1, 3, 2]),
        "weight": ([2, 1, 3], [3, 1, 2]),
    }
    assert list(expected) == table.evaluate("columns")
    for name, orders in expected.items():
        for order in orders:
            table.locator(f".heads .col-{name} .sorter").click()
            assert numbers(table) == order, name


@pytest.mark.slow
def test_one_more_entry_is_one_more_column(table: Page) -> None:
    extra = {"id": "extra", "label": "extra", "title": "An extra column", "width": "minmax(4rem, 1fr)", "figures": True}
    mount(table, extra)
    assert table.get_by_role("columnheader").all_inner_texts()[3] == "extra"
    cells = table.locator(".row-line[data-pick='m2'] > *").all_inner_texts()
    assert cells[3] == "no. 2"
    assert len(cells) == len(table.evaluate("columns"))
    for order in ([1, 2, 3], [3, 2, 1]):
        table.get_by_role("button", name="extra").click()
        assert numbers(table) == order


@pytest.mark.slow
def test_cells_show_residuals_and_mark_what_is_disabled_short_of_samples_or_an_outlier(table: Page) -> None:
    mount(table)
    rows = {k: table.locator(f".row-line[data-pick='m{k}']") for k in (1, 2, 3)}
    assert rows[1].locator(".col-samples.warns").inner_text() == "6/13"
    assert rows[3].locator(".col-samples:not(.warns)").inner_text() == "5"
    assert rows[1].locator(".col-depth_m").inner_text() == "\N{MINUS SIGN}0.300"
    assert rows[2].locator(".col-px").inner_text() == "\N{EN DASH}"
    assert rows[2].get_by_role("checkbox").is_checked() is False
    assert rows[2].locator(".mark").text_content() == "disabled"
    assert rows[3].locator(".mark").text_content() == "outlier"
    assert rows[3].locator(".mark .icon-cross").is_visible(), "a sign that fits into the column"
    assert rows[2].get_by_label("Weight of match 2").input_value() == "2.50"
