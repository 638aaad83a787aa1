"""Drives a workbench on a small simulated case, without page and 3-D scene, for the tests of this folder."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ladarreg.gateway.protocol import Visitor
from ladarreg.workbench.given_files import Reading
from ladarreg.workbench.launch import open_workbench
from ladarreg.workbench.state.clients import Client
from ladarreg.workbench.workbench import Workbench

from ladarreg_core.simulate.sample import sample_folder
from testing.scenes.kept import kept_folder


@dataclass
class WorkbenchDriver:
    """A workbench, one client, and all messages that it received."""

    workbench: Workbench
    client: Client
    received: list[dict[str, Any]] = field(default_factory=list)

    def ask(self, do: str, **fields: Any) -> dict[str, Any]:
        """Send a command as a page does, through JSON, and return the reply."""
        message = json.loads(json.dumps({"id": 1, "do": do, **fields}))
        reply = self.workbench.answer(self.client, message)
        assert reply["reply"] == 1
        assert not {"slices", "changes", "version", "event"} & set(reply), (
            "fields of the messages that a reply may share"
        )
        return json.loads(json.dumps(reply, allow_nan=False))

    def do(self, do: str, **fields: Any) -> dict[str, Any]:
        """Send a command that must succeed."""
        reply = self.ask(do, **fields)
        assert reply["ok"], reply
        return reply

    def refused(self, do: str, **fields: Any) -> str:
        """Send a command that must be refused, and return the error."""
        reply = self.ask(do, **fields)
        assert not reply["ok"], reply
        sentence = reply["error"]
        assert sentence.endswith("."), sentence
        assert "\n" not in sentence
        return str(sentence)

    def job(self, name: str, photo: str = "p1", **controls: Any) -> Any:
        """Run a job to its end."""
        self.do("run", photo=photo, job=name)
        for action, value in controls.items():
            self.do("job_control", action=action, value=value)
        self.workbench.runner.wait(240)
        return self.workbench.runner.job

    def slice(self, name: str) -> Any:
        """Return the present value of a slice, through JSON."""
        return json.loads(json.dumps(self.workbench.slices(self.client).get(name), allow_nan=False))

    def eventually(self, true: Callable[[], Any], seconds: float = 60) -> Any:
        """Wait until a condition is true."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if found := true():
                return found
            time.sleep(0.05)
        raise AssertionError("the condition never became true")


def open_bench(home: Path, *inputs: Path, camera: Path | None = None, **options: Any) -> WorkbenchDriver:
    """Open a workbench whose project lies in `home`; it solves by itself only with `solve_automatically`."""
    workbench = open_workbench(
        inputs, project=home, reading=Reading(camera=camera), **{"solve_automatically": False, **options}
    )
    bench = WorkbenchDriver(workbench, workbench.join(Visitor("test")))
    workbench.subscribe(bench.received.append, bench.client)
    return bench


def sample_bench(home: Path, **options: Any) -> WorkbenchDriver:
    """Open a workbench on the embedded sample."""
    folder = sample_folder()
    return open_bench(home, folder / "scan.npz", next(folder.glob("photo.*")), camera=folder / "camera.json", **options)


def kept_bench(name: str, home: Path, prepare: Callable[[WorkbenchDriver], object], **options: Any) -> WorkbenchDriver:
    """Open a copy, in `home`, of the sample's project as `prepare` leaves it, which is made once in a run.

    Args:
        name: of what was prepared, different for different projects.
        home: the folder of the copy, which does not exist yet.
        prepare: is given the workbench on the sample.
        options: as for `open_bench`.
    """

    def fill(folder: Path) -> None:
        bench = sample_bench(folder)
        prepare(bench)
        bench.workbench.close()

    return open_bench(shutil.copytree(kept_folder(name, fill), home), **options)


def registered(bench: WorkbenchDriver) -> None:
    """Register the photograph automatically."""
    job = bench.job("auto")
    assert job.state == "done", job.message
