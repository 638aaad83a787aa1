"""Driving simulated devices as a page does: connect, jog, run, pause, stop, take over, open what was scanned."""

from __future__ import annotations

import copy
import io
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ladarreg.gateway.protocol import Visitor
from ladarreg.workbench.acquisition.watchable import Watchable
from PIL import Image

from ladarreg_core.acquisition.composition import panorama
from ladarreg_core.foundations.progress import Report
from testing.workbench.workbench_driver import WorkbenchDriver, open_bench

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkbenchDriver]:
    home = tmp_path_factory.mktemp("acquisition")
    (home / "watched").mkdir()
    found = open_bench(home / "project", watchable=Watchable((home / "watched",), (3,), (2369,)))
    yield found
    found.workbench.close()


@pytest.fixture(autouse=True)
def disconnected(bench: WorkbenchDriver) -> Iterator[None]:
    """Each test begins without devices, whatever has become of the one before."""
    yield
    if state(bench) != "off":
        bench.do("acquire_take_over")
        disconnect(bench)


def disconnect(bench: WorkbenchDriver) -> None:
    bench.do("acquire_disconnect")
    bench.eventually(lambda: state(bench) == "off")


def state(bench: WorkbenchDriver) -> str:
    return str(bench.slice("acquisition")["state"])


def ready(bench: WorkbenchDriver) -> bool:
    """Return whether the devices wait for a command; fails with what was said if they cannot be reached."""
    now = bench.slice("acquisition")
    assert now["state"] not in ("off", "fault"), now["said"]
    return bool(now["state"] == "ready")


def kept(bench: WorkbenchDriver) -> int:
    """Return the number of pieces that a run has kept; fails with what was said if it waits for somebody."""
    now = bench.slice("acquisition")
    assert now["state"] not in ("off", "fault"), now["said"]
    return int(now["done"])


def plan_of(bench: WorkbenchDriver, **changes: Any) -> dict[str, Any]:
    plan = copy.deepcopy(bench.do("acquire_ports")["example"])
    for part in ("unit", "scanner"):  # devices of their own: other tests leave the unit where it was
        plan[part]["port"] = plan[part]["port"].replace("seed=1", "seed=11")
    return {**plan, "pan_deg": [-6, 6, 2], "settle_s": 0, **changes}


def test_a_plan_is_kept_as_it_is_edited_and_its_faults_are_said_with_their_fields(bench: WorkbenchDriver) -> None:
    assert bench.do("acquire_ports")["draft"] is None
    wrong = plan_of(bench, mode="mosaic", tilt_deg=[0, 10], camera={"folder": "no-such-folder"}, color="red")
    wrong["mount"] = {"xyz_m": [0, 0, 99], "rpy_deg": [0, 0, 0]}
    wrong["scanner"] = {"kind": "folder", "folder": "twin:scanner?seed=11", "fov_deg": [55]}
    bench.do("acquire_keep", plan=wrong)
    assert bench.do("acquire_ports")["draft"] == wrong
    found = bench.do("acquire_check", plan=wrong)
    assert found["forecast"] is None
    fields = {fault["field"] for fault in found["faults"]}
    assert fields == {"", "tilt_deg", "mount.xyz_m", "scanner.fov_deg", "camera.folder"}
    assert "100,000" in bench.refused("acquire_keep", plan={"long": "x" * 100_000})
    assert bench.do("acquire_ports")["draft"] == wrong


def watched(bench: WorkbenchDriver) -> Path:
    """Return the folder that the workbench was started with."""
    return Path(bench.workbench.session.folder.path).parent / "watched"


def test_plans_name_only_folders_and_devices_of_the_command_line(bench: WorkbenchDriver, tmp_path: Path) -> None:
    there = watched(bench)
    (there / "camera").mkdir()
    (tmp_path / "link").symlink_to("/etc", target_is_directory=True)
    (there / "away").symlink_to("/etc", target_is_directory=True)
    said = set()
    for folder in (
        tmp_path,
        tmp_path / "absent",
        "/etc",
        f"{there}/../absent",
        there / "away",
        tmp_path / "link",
        "~",
        "\0",
    ):
        plan = plan_of(bench, camera={"folder": str(folder)})
        (fault,) = bench.do("acquire_check", plan=plan)["faults"]
        assert fault["field"] == "camera.folder"
        said.add(fault["said"])
        said.add(bench.refused("acquire_connect", plan=plan).removeprefix("The plan has a fault: "))
        scanner = {"kind": "folder", "folder": str(folder)}
        faults = bench.do("acquire_check", plan=plan_of(bench, mode="mosaic", scanner=scanner))["faults"]
        assert "scanner.folder" in {fault["field"] for fault in faults}
    assert len(said) <= 2, "whether a folder exists is not answered"
    (fault,) = bench.do("acquire_check", plan=plan_of(bench, camera={"device": 0}))["faults"]
    assert "--video-device" in fault["said"]
    packets = {"kind": "packets", "udp_port": 2368, "sensor_file": "/etc/passwd"}
    faults = bench.do("acquire_check", plan=plan_of(bench, mode="mosaic", scanner=packets))["faults"]
    assert {fault["field"] for fault in faults} >= {"scanner.udp_port", "scanner.sensor_file"}
    assert any("--udp-port" in fault["said"] for fault in faults)
    for scanner in ({"kind": "packets", "udp_port": 2369}, {"kind": "packets", "host": "twin:velodyne?seed=1"}):
        faults = bench.do("acquire_check", plan=plan_of(bench, mode="mosaic", scanner=scanner))["faults"]
        assert not [fault for fault in faults if fault["field"].startswith("scanner")]
    for camera in ({"folder": str(there)}, {"folder": str(there / "camera")}, {"device": 3}):
        assert bench.do("acquire_check", plan=plan_of(bench, camera=camera))["faults"] == []
    (fault,) = bench.do("acquire_check", plan=plan_of(bench, camera={"folder": str(there / "absent")}))["faults"]
    assert "does not exist" in fault["said"]
    bench.do("acquire_connect", plan=plan_of(bench))
    bench.eventually(lambda: ready(bench))
    assert "--watch" in bench.refused("acquire_start", plan=plan_of(bench, camera={"folder": "/etc"}))


def test_no_page_has_this_computer_run_a_command(bench: WorkbenchDriver, tmp_path: Path) -> None:
    folder = str(watched(bench))
    shots = {"kind": "folder", "folder": folder, "trigger": {"command": ["touch", str(tmp_path / "run")]}}
    plan = plan_of(bench, mode="mosaic", scanner=shots)
    assert "run it by `ladarreg acquire`" in bench.refused("acquire_connect", plan=plan)
    camera = {"folder": folder, "trigger": {"command": ["touch", str(tmp_path / "run")]}}
    assert "run it by `ladarreg acquire`" in bench.refused("acquire_connect", plan=plan_of(bench, camera=camera))
    camera["trigger"] = {"port": "/dev/tty-absent"}
    assert "has no port /dev/tty-absent" in bench.refused("acquire_connect", plan=plan_of(bench, camera=camera))
    assert state(bench) == "off"


def test_what_an_operator_does(bench: WorkbenchDriver) -> None:
    plan = plan_of(bench)
    assert bench.do("acquire_check", plan=plan)["forecast"]["pieces"] == 7
    (fault,) = bench.do("acquire_check", plan={**plan, "pan_deg": [0, 1, 5]})["faults"]
    assert fault["field"] == "pan_deg"
    assert "beyond its end" in fault["said"]
    assert "no devices are connected" in bench.refused("acquire_jog", pan_deg=1, tilt_deg=0).lower()
    bench.do("acquire_connect", plan=plan)
    bench.eventually(lambda: ready(bench))
    found = bench.slice("acquisition")
    assert "FLIR" in found["devices"]["unit"]
    assert found["devices"]["has_intensity"]
    (fault,) = bench.do("acquire_check", plan={**plan, "tilt_deg": [0, 40, 20]})["faults"]
    assert fault["field"] == "tilt_deg"
    assert "limits are -46.54 to 30.99" in fault["said"]

    bench.do("acquire_jog", pan_deg=3, tilt_deg=-2)
    assert "busy" in bench.refused("acquire_start", plan=plan)
    bench.eventually(lambda: ready(bench))
    assert bench.slice("acquisition")["at_deg"] == pytest.approx([3, -2], abs=0.02)
    assert "too far to move at once" in bench.refused("acquire_jog", pan_deg=31, tilt_deg=0)
    bench.do("acquire_jog", pan_deg=0, tilt_deg=25)
    bench.eventually(lambda: ready(bench))
    assert "beyond the unit's limits" in bench.refused("acquire_jog", pan_deg=0, tilt_deg=10)

    bench.do("acquire_start", plan=plan)
    bench.eventually(lambda: kept(bench) >= 2)
    bench.do("acquire_pause")
    bench.eventually(lambda: state(bench) == "paused")
    before = kept(bench)
    time.sleep(0.3)
    assert kept(bench) == before
    bench.do("acquire_resume")
    bench.eventually(lambda: bench.slice("acquisition")["complete"])
    picture = bench.workbench.picture("acquisition", {})
    pixels = np.asarray(Image.open(io.BytesIO(picture.data)))
    assert pixels.shape == (360, 720)
    assert np.count_nonzero(pixels) > 1000
    bench.eventually(lambda: ready(bench))
    bench.do("acquire_open")
    assert bench.slice("scan")["name"] == "run-001.npz"
    disconnect(bench)


@pytest.mark.long
def test_runs_are_found_again_and_go_on_by_their_own_plan(tmp_path: Path) -> None:
    first = open_bench(tmp_path / "project")
    plan = plan_of(first, camera={"folder": "twin:camera?seed=11"}, pan_deg=[-20, 20, 20])
    try:
        first.do("acquire_connect", plan=plan)
        first.eventually(lambda: ready(first))
        first.do("acquire_start", plan=plan)
        first.eventually(lambda: kept(first) >= 1)
        first.do("acquire_stop")
        first.eventually(lambda: ready(first))
    finally:
        first.workbench.close()
    again = open_bench(tmp_path / "project")
    try:
        (run,) = again.slice("acquisition")["runs"]
        assert run["name"] == "run-001"
        assert 1 <= run["done"] < run["total"] == 3
        assert run["photos"] == run["done"]
        assert "not been finished" in again.refused("acquire_open", run="run-001")
        assert "no such name" in again.refused("acquire_photos", run="../run-001")
        again.do("acquire_connect", plan=plan)
        again.eventually(lambda: ready(again))
        again.do("acquire_start", resume="run-001")
        again.eventually(lambda: again.slice("acquisition")["complete"])
        again.eventually(lambda: ready(again))
        (run,) = again.slice("acquisition")["runs"]
        assert run == {"name": "run-001", "done": 3, "total": 3, "complete": True, "photos": 3}
        assert again.do("acquire_photos", run="run-001")["photos"] == 3
        assert [photo["name"][:14] for photo in again.slice("photos")] == [
            "run-001 pan -2",
            "run-001 pan 0 ",
            "run-001 pan 20",
        ]
        again.do("acquire_open", run="run-001")
        assert again.slice("scan")["name"] == "run-001.npz"
    finally:
        again.workbench.close()


def test_stopping_is_for_everybody_and_a_run_goes_on_where_it_was(bench: WorkbenchDriver) -> None:
    plan = plan_of(bench, pan_deg=[-60, 60, 20])
    other = bench.workbench.join(Visitor("test"))

    def ask(do: str, **fields: Any) -> dict[str, Any]:
        return bench.workbench.answer(other, {"id": 1, "do": do, **fields})

    bench.do("acquire_connect", plan=plan)
    bench.eventually(lambda: ready(bench))
    bench.do("acquire_start", plan=plan)
    bench.eventually(lambda: kept(bench) >= 1)
    assert "drives the devices; take over first" in ask("acquire_pause")["error"]
    assert ask("acquire_stop")["ok"]
    bench.eventually(lambda: ready(bench))
    found = bench.slice("acquisition")
    assert not found["complete"]
    assert found["said"] == f"Stopped: {found['done']} of 7 pieces are kept."
    assert ask("acquire_take_over")["ok"]
    assert "take over first" in bench.refused("acquire_start", plan=plan, resume=found["run"])
    assert ask("acquire_start", plan=plan, resume=found["run"])["ok"]
    bench.workbench.leave(other)  # a run goes on
    bench.eventually(lambda: bench.slice("acquisition")["complete"])
    bench.eventually(lambda: ready(bench))
    bench.do("acquire_disconnect")


def test_stopping_while_devices_are_connected_leaves_none(bench: WorkbenchDriver) -> None:
    bench.do("acquire_connect", plan=plan_of(bench))
    bench.do("acquire_stop")
    bench.eventually(lambda: state(bench) == "off")
    assert bench.slice("acquisition")["said"] == "Stopped while connecting: connect again."
    assert bench.slice("acquisition")["driver"] is None


def test_composing_that_was_stopped_is_done_when_the_run_goes_on(
    bench: WorkbenchDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    composed = []

    def stopped_at_first(folder: Path, *, report: Report) -> panorama.Panorama:
        composed.append(folder)
        if len(composed) == 1:
            assert "being composed" in bench.slice("acquisition")["said"]
            bench.do("acquire_stop")
        return compose(folder, report=report)

    compose = panorama.compose
    monkeypatch.setattr(panorama, "compose", stopped_at_first)
    plan = plan_of(bench, pan_deg=[-4, 4, 4])
    bench.do("acquire_connect", plan=plan)
    bench.eventually(lambda: ready(bench))
    bench.do("acquire_start", plan=plan)
    bench.eventually(lambda: composed and ready(bench))
    found = bench.slice("acquisition")
    assert (found["done"], found["total"], found["complete"]) == (3, 3, False)
    assert "all pieces are kept" in found["said"]
    bench.do("acquire_start", plan=plan, resume=found["run"])
    bench.eventually(lambda: bench.slice("acquisition")["complete"])


def test_a_port_that_the_server_does_not_have_is_refused(bench: WorkbenchDriver, tmp_path: Path) -> None:
    plan = plan_of(bench)
    plan["unit"]["port"] = "socket://10.0.0.1:22"
    assert "has no port socket://10.0.0.1:22" in bench.refused("acquire_connect", plan=plan)
    plan["unit"]["port"] = "twin:nothing?seed=1"
    bench.do("acquire_connect", plan=plan)
    bench.eventually(lambda: state(bench) == "off")
    assert "no simulated device 'nothing'" in bench.slice("acquisition")["said"]
