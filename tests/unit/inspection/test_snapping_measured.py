"""Snapping on simulated rooms, whose true edges are known; `benchmarks.page.snapping` measures all four."""

from __future__ import annotations

import pytest

from benchmarks.page.snapping import MAX_ALONG_PX, MAX_SHARE, far_lines, measure, panes_of
from benchmarks.page.snapping_lines import drawn_scene

LINES = 12


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["desk", pytest.param("people", marks=pytest.mark.long)])
def test_drawn_lines_get_nearer_to_the_true_edges(scene: str) -> None:
    pytest.importorskip("embreex", reason="the simulator needs embreex")
    room = drawn_scene(scene, 400, lines=LINES)
    for noise, most in MAX_SHARE.items():
        found = measure([room], scene, noise)
        assert found.ends >= 40
        assert found.share <= most
        assert found.worst_along_px < MAX_ALONG_PX
    far, snaps = far_lines(room), panes_of(room)
    assert sum(map(len, far.values())) > 0
    assert all(snaps[pane][1](line) is None for pane, lines in far.items() for line in lines)
