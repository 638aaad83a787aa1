"""Ranges smoothed at the workbench: seen before they are applied, one step, undone exactly, kept and exported."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from ladarreg.gateway.protocol import Visitor

import ladarreg_core as lr
from ladarreg_core.errors import ShapeError
from ladarreg_core.simulate.sample import sample_folder
from testing.scenes.spiked_scan import SpikedScan, spiked_sample
from testing.workbench.workbench_driver import WorkbenchDriver, open_bench

PHOTO = {"photo": "p1"}


@pytest.fixture(scope="module")
def spiked(tmp_path_factory: pytest.TempPathFactory) -> SpikedScan:
    return spiked_sample(tmp_path_factory.mktemp("spiked") / "scan.npz")


@pytest.fixture(scope="module")
def solved(spiked: SpikedScan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with the matches drawn and an accepted pose."""
    home = tmp_path_factory.mktemp("solved") / "project"
    folder = sample_folder()
    bench = open_bench(home, spiked.file, next(folder.glob("photo.*")), camera=folder / "camera.json")
    for match in spiked.matches:
        bench.do("add_pick", **PHOTO, **match)
    assert "Accepted" in bench.job("solve").message
    bench.workbench.close()
    return home


@pytest.fixture
def bench(solved: Path, tmp_path: Path) -> Iterator[WorkbenchDriver]:
    found = open_bench(shutil.copytree(solved, tmp_path / "project"))
    yield found
    found.workbench.close()


def ranges_of(bench: WorkbenchDriver) -> np.ndarray:
    scan = bench.workbench.loader.scan(bench.workbench.session.document)
    assert scan is not None
    return np.array(scan.ranges)


def previewed(bench: WorkbenchDriver, **options: Any) -> dict[str, Any]:
    bench.do("preview_smoothing", **PHOTO, **options)
    found: dict[str, Any] = bench.slice("smoothing")["preview"]
    return found


def cell_of(one: dict[str, Any]) -> tuple[int, int]:
    row, column = map(int, one["id"].split("."))
    return row, column


@pytest.mark.slow
def test_a_preview_lists_what_would_be_replaced_and_changes_nothing(bench: WorkbenchDriver, spiked: SpikedScan) -> None:
    before, document = ranges_of(bench), bench.workbench.session.document
    preview = previewed(bench)
    assert preview["show"] == "difference"
    assert preview["stale"] == preview["nothing"] == ""
    listed = preview["ranges"]
    assert len(listed) >= 15
    assert 1 <= sum(one["edge"] for one in listed) <= 5
    nearer = 0
    for one in listed:
        cell = cell_of(one)
        assert spiked.spiked[cell]
        assert one["before_m"] == pytest.approx(before[cell], abs=1e-4)
        nearer += abs(one["after_m"] - spiked.truth[cell]) < abs(before[cell] - spiked.truth[cell])
        assert abs(one["after_m"] - spiked.truth[cell]) < 5 * one["sigma_m"] + 0.02
    assert nearer >= 0.9 * len(listed)
    assert bench.workbench.session.document is document
    bench.do("discard_smoothing")
    assert bench.slice("smoothing") == {"station": "", "replaced": 0, "sentence": "", "preview": None}
    assert np.array_equal(ranges_of(bench), before, equal_nan=True)
    assert bench.workbench.session.document is document


@pytest.mark.slow
def test_applied_ranges_are_nearer_to_the_truth_and_no_edge_is_changed(
    bench: WorkbenchDriver, spiked: SpikedScan
) -> None:
    before, preview = ranges_of(bench), previewed(bench)
    bench.do("apply_smoothing", **PHOTO, rev=preview["rev"])
    after = ranges_of(bench)
    changed = np.argwhere((after != before) & np.isfinite(before))
    spikes = {cell_of(one) for one in preview["ranges"] if not one["edge"]}
    assert {tuple(cell) for cell in changed.tolist()} == spikes
    error, former = (np.abs(ranges - spiked.truth) for ranges in (after, before))
    assert (error[tuple(changed.T)] < former[tuple(changed.T)]).mean() >= 0.9
    assert np.array_equal(after[spiked.edges], before[spiked.edges], equal_nan=True)
    assert bench.slice("smoothing")["replaced"] == len(spikes)
    assert bench.slice("smoothing")["preview"] is None
    assert bench.slice("history")["entries"][-1]["label"] == f"Smooth {len(spikes)} ranges"
    assert bench.slice("photos")[0]["state"] == "accepted"  # the pose that they rest on


@pytest.mark.slow
def test_undo_and_redo_are_exact(bench: WorkbenchDriver) -> None:
    before, document = ranges_of(bench), bench.workbench.session.document
    bench.do("apply_smoothing", **PHOTO, rev=previewed(bench)["rev"], edges=True)
    after, smoothed = ranges_of(bench), bench.workbench.session.document
    bench.do("undo")
    assert bench.workbench.session.document == document
    assert np.array_equal(ranges_of(bench), before, equal_nan=True)
    bench.do("redo")
    assert bench.workbench.session.document == smoothed
    assert np.array_equal(ranges_of(bench), after, equal_nan=True)


@pytest.mark.slow
def test_it_is_kept_with_the_project(solved: Path, tmp_path: Path) -> None:
    bench = open_bench(shutil.copytree(solved, tmp_path / "project"))
    bench.do("apply_smoothing", **PHOTO, rev=previewed(bench)["rev"])
    after, document = ranges_of(bench), bench.workbench.session.document
    bench.workbench.close()
    again = open_bench(tmp_path / "project")
    try:
        assert again.workbench.session.document == document
        assert np.array_equal(ranges_of(again), after, equal_nan=True)
        again.do("restore_ranges")
        assert again.slice("smoothing")["replaced"] == 0
        assert "other ranges" in again.slice("photos")[0]["stale"]
        assert "nothing to restore" in again.refused("restore_ranges")
    finally:
        again.workbench.close()


@pytest.mark.slow
def test_nothing_is_applied_that_was_not_seen(bench: WorkbenchDriver) -> None:
    former = previewed(bench)
    assert "preview" in bench.refused("apply_smoothing", **PHOTO, rev="another")
    bench.do("switch_picks", **PHOTO, picks=[bench.slice("picks:p1")[-1]["id"]], on=False)
    assert bench.slice("smoothing")["preview"]["stale"]
    assert bench.slice("smoothing")["preview"]["ranges"] == []
    assert "out of date" in bench.refused("apply_smoothing", **PHOTO, rev=former["rev"])
    bench.job("solve")
    assert bench.slice("smoothing")["preview"]["stale"]
    assert "preview" in bench.refused("apply_smoothing", **PHOTO, rev=former["rev"])
    assert not previewed(bench)["stale"]
    bench.do("apply_smoothing", **PHOTO, rev=bench.slice("smoothing")["preview"]["rev"])
    assert "preview" in bench.refused("apply_smoothing", **PHOTO, rev=former["rev"])  # its ranges are replaced by now


@pytest.mark.slow
def test_without_an_accepted_pose_nothing_is_previewed(bench: WorkbenchDriver) -> None:
    bench.workbench.start_over("p1")
    assert "accepted pose" in bench.refused("preview_smoothing", **PHOTO)
    assert "'before'" in bench.refused("preview_smoothing", **PHOTO, show="all")


@pytest.mark.slow
def test_results_on_the_former_ranges_are_out_of_date(bench: WorkbenchDriver) -> None:
    stages = {one["stage"]: one["stale"] for one in bench.slice("poses:p1")["stages"]}
    assert set(stages.values()) == {""}
    bench.do("apply_smoothing", **PHOTO, rev=previewed(bench)["rev"])
    shown = bench.slice("poses:p1")["shown"]
    after = {one["stage"]: one["stale"] for one in bench.slice("poses:p1")["stages"]}
    assert after.pop(shown) == ""
    assert after
    assert all("other ranges" in why for why in after.values())
    assert "out of date" not in bench.slice("smoothing")["sentence"]
    bench.job("solve")
    assert bench.slice("photos")[0]["stale"] == ""
    assert "has changed since" in bench.slice("smoothing")["sentence"]


@pytest.mark.slow
def test_ranges_of_a_station_are_replaced_where_it_is_shown(
    bench: WorkbenchDriver, spiked: SpikedScan, tmp_path: Path
) -> None:
    """The scan beside the photograph is a station's; the project's scan, of the same place, stays as it is."""
    other = shutil.copyfile(sample_folder() / "scan.npz", tmp_path / "plain.npz")
    bench.workbench.files.open(other, "plain.npz", "station", None, bench.client)
    (plain,) = (one["id"] for one in bench.slice("stations")["stations"] if one["id"])
    bench.do("show_station", station=plain)
    (name,) = (one["id"] for one in bench.slice("stations")["stations"] if one["id"])
    bench.do("set_station", **PHOTO, station=name)
    session, loader = bench.workbench.session, bench.workbench.loader
    assert bench.slice("photos")[0]["state"] == "accepted"

    def ranges() -> list[np.ndarray]:
        document = session.document
        found = (loader.scan(one) for one in (document, document.beside(document.photos[0])))
        return [np.array(scan.ranges) for scan in found if scan is not None]

    before, document = ranges(), session.document
    preview = previewed(bench)
    assert preview["station"] == name
    assert len(preview["ranges"]) >= 15
    assert bench.workbench.smoothing.shown(bench.client) is None, "nobody knows where it stands"
    bench.do("apply_smoothing", **PHOTO, rev=preview["rev"])
    after = ranges()
    np.testing.assert_array_equal(after[0], before[0])
    changed = np.argwhere((after[1] != before[1]) & np.isfinite(before[1]))
    assert {tuple(cell) for cell in changed.tolist()} == {cell_of(one) for one in preview["ranges"] if not one["edge"]}
    state = bench.slice("smoothing")
    assert (state["station"], state["replaced"]) == (name, len(changed))
    assert "of scan.npz were replaced" in state["sentence"]
    assert bench.slice("beside")["id"] != bench.slice("scan")["id"]
    assert bench.slice("photos")[0]["stale"] == ""
    bench.do("undo")
    assert session.document == document
    np.testing.assert_array_equal(ranges()[1], before[1])
    bench.do("redo")
    assert "nothing to restore" in bench.refused("restore_ranges")

    # It is kept with the project, and stated in its results.
    folder = session.folder.path
    bench.workbench.close()
    bench.workbench = open_bench(folder).workbench
    np.testing.assert_array_equal(
        bench.workbench.loader.scan(bench.workbench.session.document.beside(session.document.photos[0])).ranges,
        after[1],
    )
    bench.do("export", targets=["results"], photos=["p1"])
    bench.workbench.runner.wait(240)
    path, _ = bench.workbench.export_file("p1") or (Path(), "")
    with zipfile.ZipFile(path) as archive:
        stated = json.loads(archive.read(next(one for one in archive.namelist() if one.endswith("registration.json"))))
    assert stated["smoothing"]["cells_replaced"] == len(changed)
    bench.do("restore_ranges", station=name)
    assert "other ranges" in bench.slice("photos")[0]["stale"]


@pytest.mark.slow
def test_two_people_preview_on_their_own_and_undo_their_own(bench: WorkbenchDriver) -> None:
    other = WorkbenchDriver(bench.workbench, bench.workbench.join(Visitor("test", tab="other")))
    previewed(bench)
    assert other.slice("smoothing")["preview"] is None
    theirs = previewed(other, show="after")
    assert theirs["show"] == "after"
    before = bench.workbench.session.document
    bench.do("apply_smoothing", **PHOTO, rev=theirs["rev"])
    assert other.slice("smoothing")["preview"]["stale"]
    other.do("rename", name="Office")
    bench.do("undo")
    now = bench.workbench.session.document
    assert (now.scan, now.photos, now.name) == (before.scan, before.photos, "Office")


@pytest.mark.slow
def test_exports_have_the_smoothed_ranges(bench: WorkbenchDriver) -> None:
    bench.do("apply_smoothing", **PHOTO, rev=previewed(bench)["rev"])
    count = bench.slice("smoothing")["replaced"]
    wanted = ranges_of(bench)
    bench.do("export", targets=["results", "e57"], photos=["p1"])
    bench.workbench.runner.wait(240)
    path, _ = bench.workbench.export_file("p1") or (Path(), "")
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        document = json.loads(archive.read(next(name for name in names if name.endswith("registration.json"))))
        e57 = archive.read(next(name for name in names if name.endswith(".e57")))
    assert document["smoothing"]["cells_replaced"] == count
    assert "replaced by stereo" in document["smoothing"]["sentence"]
    copy = path.parent / "again.e57"
    copy.write_bytes(io.BytesIO(e57).getvalue())
    again = lr.read_scan(copy)
    assert np.sort(again.ranges[again.valid]) == pytest.approx(np.sort(wanted[np.isfinite(wanted)]), abs=2e-3)


@pytest.mark.slow
def test_further_clouds_are_measured_again(bench: WorkbenchDriver) -> None:
    from ladarreg_core.project.edits import with_more_clouds

    bench.do("apply_smoothing", **PHOTO, rev=previewed(bench)["rev"])
    document = bench.workbench.session.document
    assert document.scan is not None
    grown = with_more_clouds(document, ["more.npz"])
    assert grown.scan is not None
    assert grown.scan.smoothings == ()


@pytest.mark.slow
def test_a_file_with_fewer_cells_is_refused_with_the_reason(bench: WorkbenchDriver) -> None:
    from ladarreg_core.project.smoothing_edits import with_smoothings

    bench.do("apply_smoothing", **PHOTO, rev=previewed(bench)["rev"])
    source = bench.workbench.session.document.scan
    scan = bench.workbench.loader.scan(bench.workbench.session.document)
    assert source is not None
    assert scan is not None
    (made,) = source.smoothings
    far = msgspec.structs.replace(made, cells=((scan.shape[0], 0, 1.0),))
    with pytest.raises(ShapeError, match="has changed"):
        with_smoothings(scan, msgspec.structs.replace(source, smoothings=(far,)))
