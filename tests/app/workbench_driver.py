"""A workbench on a small simulated case, without page and without 3-D scene, for the tests of this folder."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ladarreg.workbench.launch import open_workbench
from ladarreg.workbench.workbench import Person, Workbench

from ladarreg_core.simulate.sample import sample_folder


@dataclass
class Bench:
    """A workbench, one person at it, and everything that was told."""

    workbench: Workbench
    person: Person
    told: list[dict[str, Any]] = field(default_factory=list)

    def ask(self, do: str, **fields: Any) -> dict[str, Any]:
        """Ask as a page does, through JSON, and return the reply."""
        message = json.loads(json.dumps({"id": 1, "do": do, **fields}))
        reply = self.workbench.answer(self.person, message)
        assert reply["reply"] == 1
        return json.loads(json.dumps(reply, allow_nan=False))

    def do(self, do: str, **fields: Any) -> dict[str, Any]:
        """Ask for what must succeed."""
        reply = self.ask(do, **fields)
        assert reply["ok"], reply
        return reply

    def refused(self, do: str, **fields: Any) -> str:
        """Ask for what must be refused, and return the sentence."""
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
        """Return a slice as a page has it now, through JSON."""
        return json.loads(json.dumps(self.workbench.slices(self.person).get(name), allow_nan=False))

    def eventually(self, true: Callable[[], Any], seconds: float = 60) -> Any:
        """Wait until something holds."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if found := true():
                return found
            time.sleep(0.05)
        raise AssertionError("it never came true")


def open_bench(home: Path, *inputs: Path, camera: Path | None = None, **options: Any) -> Bench:
    """Open a workbench whose project lies in `home`."""
    workbench = open_workbench(inputs, project=home, camera=camera, **options)
    bench = Bench(workbench, workbench.join("test"))
    workbench.subscribe(bench.told.append)
    return bench


def sample_bench(home: Path, **options: Any) -> Bench:
    """Open a workbench on the embedded sample."""
    folder = sample_folder()
    return open_bench(home, folder / "scan.npz", next(folder.glob("photo.*")), camera=folder / "camera.json", **options)
