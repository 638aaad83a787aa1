"""`ladarreg devices` and `ladarreg acquire` with simulated devices, as a newcomer calls them."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from ladarreg.cli import main

from ladarreg_core.formats import read_scan
from testing.workbench.processes import restore_stop_signals

pytestmark = pytest.mark.slow


def shortened(path: Path) -> Path:
    """Write the example of a plan, with few stops."""
    assert main(["acquire", str(path), "--example"]) == 0
    plan = json.loads(path.read_text())
    plan |= {"pan_deg": [-10, 10, 2], "settle_s": 0}
    path.write_text(json.dumps(plan))
    return path


def test_plans_are_written_described_and_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = shortened(tmp_path / "plan.json")
    assert main(["acquire", str(plan), "--dry-run"]) == 0
    assert "sweep, 11 stops, 11 pieces, about 11,891 cells" in capsys.readouterr().out
    assert main(["acquire", str(plan), "--example"]) == 2
    assert main(["acquire", str(plan)]) == 2
    assert "give -o FOLDER" in capsys.readouterr().err
    fields = json.loads(plan.read_text())
    plan.write_text(json.dumps({**fields, "pan_deg": [0, 400, 1], "tilt_dge": 1}))
    assert main(["acquire", str(plan), "-o", str(tmp_path / "run")]) == 2
    assert "2 faults: (1)" in capsys.readouterr().err
    plan.write_text(json.dumps({**fields, "tilt_deg": [0, 60, 30]}))
    assert main(["acquire", str(plan), "-o", str(tmp_path / "run")]) == 2
    assert "the unit's limits are -46.54 to 30.99" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="no Ctrl-C to send")
def test_a_run_that_is_interrupted_goes_on_to_a_scan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan, run = shortened(tmp_path / "plan.json"), tmp_path / "run"
    process = subprocess.Popen(
        [sys.executable, "-m", "ladarreg", "acquire", str(plan), "-o", str(run)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True,
        preexec_fn=restore_stop_signals,
    )  # fmt: skip
    until = time.monotonic() + 200
    records = run / "run.jsonl"
    while not (records.is_file() and records.read_bytes().count(b"\n") >= 2) and time.monotonic() < until:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=200)
    assert process.returncode == 130, errors
    assert f"go on with: ladarreg acquire {plan} -o {run} --resume" in out
    assert "Traceback" not in errors
    assert main(["acquire", str(plan), "-o", str(run)]) == 2
    assert "--resume" in capsys.readouterr().err
    assert main(["acquire", str(plan), "-o", str(run), "--resume", "--quiet"]) == 0
    scan = read_scan(run / "scan.npz")
    assert scan.valid.sum() > 5000
    assert json.loads((run / "panorama.json").read_text())["missing"] == []


def test_devices_are_named_for_a_plan(capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(3):  # a busy computer may hold up a simulated device for longer than a real one takes to answer
        if main(["devices", "twin:flir-ptu?seed=1", "twin:scip2?seed=1", "--json"]) == 0:
            break
        capsys.readouterr()
    unit, scanner = json.loads(capsys.readouterr().out)["devices"]
    assert unit["kind"] == "flir-ptu"
    assert scanner["is"]["intensity"] == "yes"
    assert main(["devices", "/dev/tty-absent"]) == 2
    assert "there is no port /dev/tty-absent" in capsys.readouterr().err
    assert main(["devices"]) == 0
