"""`ladarreg panorama --calibrate-mount` on a run: the panorama lies on the room, and the file says what is known."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import main

from ladarreg_core.acquisition.mount_fields import mount_as_fields
from ladarreg_core.formats import read_scan
from ladarreg_core.frames import Rigid
from testing.scenes.box_room import MOUNT, off_surface, stop_and_go

PANS_DEG = np.arange(-180.0, 180.0, 5.0)
LINE = np.radians(np.arange(-135.0, 135.1, 1.5))
PLANNED = Rigid.from_rotvec(np.radians([-0.4, 0.3, -0.2]), [0, 0, 0]) @ Rigid(
    MOUNT.rotation, MOUNT.translation - [0.02, -0.005, 0.03]
)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    (folder / "pieces").mkdir(parents=True)
    records = []
    for tilt in (-20.0, 20.0):
        sweep = stop_and_go(np.radians(PANS_DEG), np.radians(tilt), angles_rad=LINE, sigma_m=0.003, seed=int(tilt) + 50)
        for line, pan in enumerate(PANS_DEG):
            index = len(records)
            name = f"pieces/{index:03}.npz"
            np.savez(
                folder / name, ranges=sweep.ranges_m[line : line + 1], intensity=np.ones((1, len(LINE)), np.float32),
                angles_rad=LINE, pan_rad=np.radians(pan), tilt_rad=np.radians(tilt),
            )  # fmt: skip
            sha256 = hashlib.sha256((folder / name).read_bytes()).hexdigest()
            records.append({"index": index, "file": name, "sha256": sha256, "asked_deg": [pan, tilt],
                            "read_deg": [pan, tilt], "time": 0.0, "pass": 0})  # fmt: skip
    (folder / "run.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    plan = {"version": 1, "mode": "sweep", "pan_deg": [-180, 175, 5], "tilt_deg": [-20, 20, 40],
            "unit": {"kind": "flir-ptu", "port": "x"}, "scanner": {"kind": "scip2", "port": "y"},
            "mount": mount_as_fields(PLANNED)}  # fmt: skip
    (folder / "plan.json").write_text(json.dumps(plan))
    return folder


@pytest.mark.slow
def test_the_calibrated_panorama_lies_on_the_room(run: Path, tmp_path: Path) -> None:
    off = {}
    for name, options in (("planned", []), ("calibrated", ["--calibrate-mount"])):
        assert main(["panorama", str(run), "-o", str(tmp_path / name), "--quiet", *options]) == 0
        scan = read_scan(tmp_path / name / "scan.npz")
        off[name] = float(np.median(off_surface(scan.points[scan.valid])))
    assert off["calibrated"] < 0.003 < 0.008 < off["planned"]
    fields = json.loads((tmp_path / "calibrated" / "panorama.json").read_text())
    calibration = fields["mount"]["calibration"]
    assert calibration["accepted"]
    assert calibration["not_determined"] == []
    assert 0 < calibration["sigma"]["x_m"] < 1e-3
    assert calibration["held_out_after_m"] < calibration["held_out_before_m"]
    np.testing.assert_allclose(fields["mount"]["xyz_m"], MOUNT.translation, atol=3e-3)
