"""A walk through the states of stations: every word and figure on the page is that of the project."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from ladarreg_core.formats import read_scan
from ladarreg_core.formats.scans.npz import write_npz_xyz
from testing.workbench.walk import Walk

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
MIN_STATES = 14


@pytest.mark.long
@pytest.mark.timeout(900)
def test_a_walk_through_stations(walk: Walk, tmp_path: Path) -> None:
    from testing.scenes.station_scans import write_station_scans

    (first, second), photo, camera = write_station_scans(tmp_path)
    walk.files(first, photo, camera)
    walk.page.keyboard.press("Escape")
    walk.page.get_by_role("tab", name="Survey").click()
    walk.state("one scan")
    walk.station(second)
    walk.state("a second station")
    (_, other) = walk.stations()
    walk.do("place_station", station=other, place={"x": 1.5, "y": 0.7, "z": 0.1, "yaw_deg": -28.0})
    walk.state("a rough place")
    walk.do("place_station", station=other, place=None)
    walk.state("which is forgotten")
    walk.ended(walk.do("register_stations"))
    walk.state("registered to each other")
    walk.job("auto")
    solved = ("match", "solve", "judge")
    walk.state("the photograph is registered at the first", "verified", ticks=solved)
    walk.ended(walk.do("check_at_stations"))
    walk.state("and checked at the second", "verified", ticks=solved)
    walk.job("cull")  # there are no corner matches to filter
    walk.state("a step that fails changes nothing", "verified", ticks=solved)
    walk.do("show_station", station=other)
    walk.state("the second is shown: the photograph has no pose there")
    walk.job("auto")
    walk.state("it is registered there, too", "verified", ticks=solved)
    walk.do("show_station", station=walk.stations()[1])
    walk.state("the first is shown again", "verified", ticks=solved)
    for station, at in (("", "first"), (walk.stations()[1], "second")):
        at_all = ({"kind": "point", "places": [{"ray": [1.0, y / 20, -0.1]}], "station": station} for y in range(20))
        walk.do("add_measurement", **next(one for one in at_all if not walk.do("measure", **one)["refusal"]))
        walk.state(f"a point is measured at the {at}", "verified", ticks=solved)
    walk.do("remove_station", station=walk.stations()[1])
    walk.state("the second is removed", "verified", ticks=solved)
    walk.do("undo")
    walk.state("and is back", "verified", ticks=solved)
    again = tmp_path / "again.npz"
    scan = read_scan(second)
    write_npz_xyz(again, replace(scan, intensity=0.9 * scan.intensity))
    walk.station(again)
    walk.state("a third station, not registered yet", "verified", ticks=solved)
    walk.reopen()
    walk.state("reopened", "verified", ticks=solved)
    walk.finish(MIN_STATES)
