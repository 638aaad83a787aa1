"""A line scanner that measures no intensity, from its twin to a registration that says what was compared."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from ladarreg.cli import main

from ladarreg_core.acquisition.plan import Axis, Plan, ScannerPlan, UnitPlan
from ladarreg_core.acquisition.runs.connected import connected
from ladarreg_core.acquisition.runs.run_folder import RunFolder, RunWriter
from ladarreg_core.acquisition.simulated.devices import TwinDevices
from ladarreg_core.acquisition.simulated.scip_twin import URG_04LX
from ladarreg_core.acquisition.simulated.world import LINE_MOUNT
from ladarreg_core.formats import read_scan
from ladarreg_core.scan import NO_INTENSITY_NOTE
from testing.devices.simulated_clock import SimulatedClock
from testing.devices.simulated_ports import MemoryPorts, MemoryServer
from testing.workbench.workbench_driver import open_bench

QUICK = replace(URG_04LX, turns_a_minute=2400)


@pytest.mark.slow
def test_a_scanner_without_intensity_goes_through_the_whole_chain(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, out = tmp_path / "run", tmp_path / "panorama"
    clock = SimulatedClock()
    with TwinDevices("office", 1, model=QUICK, serve=partial(MemoryServer, clock=clock)) as twins:
        at = twins.addresses
        plan = Plan(
            UnitPlan(at["flir-ptu"], baud=115_200), ScannerPlan("scip2", at["scip2"]), "sweep",
            pan=Axis(-2, 2, 1), tilt=Axis(0, 0, 0), mount=LINE_MOUNT, settle_s=0.0,
        )  # fmt: skip
        folder = RunWriter.begin(run, plan, resume=False)
        with connected(plan, ports=partial(MemoryPorts, twins.server)) as devices:
            assert devices.line_scanner is not None
            assert not devices.line_scanner.identity.has_intensity
            assert devices.run(plan, folder, lambda event: None).go()
        folder.close()
    with np.load(run / RunFolder.open(run).records[0].file) as piece:
        assert "intensity" not in piece
    assert main(["panorama", str(run), "-o", str(out)]) == 0
    assert NO_INTENSITY_NOTE in capsys.readouterr().out
    assert json.loads((out / "panorama.json").read_text())["notes"] == [NO_INTENSITY_NOTE]
    scan = read_scan(out / "scan.npz")
    assert not scan.has_intensity
    assert NO_INTENSITY_NOTE in scan.notes
    assert np.isfinite(scan.ranges).sum() > 1_500

    cv2.imwrite(str(tmp_path / "photo.png"), np.random.default_rng(1).integers(0, 255, (120, 160, 3)).astype(np.uint8))
    photo = [str(tmp_path / "photo.png"), "--focal-px", "150"]
    assert main(["register", str(out / "scan.npz"), *photo, "-o", str(tmp_path / "registered")]) == 3
    said = "The scan has no intensity, so that only its shape was compared with the photo."
    assert said in capsys.readouterr().out
    assert said in json.loads((tmp_path / "registered" / "registration.json").read_text())["reasons"]

    shown = open_bench(tmp_path / "project", out / "scan.npz")
    try:
        assert shown.eventually(lambda: shown.slice("scan"))["has_intensity"] is False
    finally:
        shown.workbench.close()

    # The control.
    with np.load(out / "scan.npz") as archive:
        arrays = dict(archive)
    arrays["intensity"] = np.where(np.isfinite(scan.ranges), scan.ranges, 0)
    np.savez(tmp_path / "with.npz", **arrays)
    assert NO_INTENSITY_NOTE not in read_scan(tmp_path / "with.npz").notes
