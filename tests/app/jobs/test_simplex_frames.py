"""What pages receive of the iterations of a simplex."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from ladarreg.jobs.inputs import Workspace
from ladarreg.jobs.simplex import Frame, frame_event

from ladarreg_core.matches import Matches
from ladarreg_core.thesis.estimators.nelder_mead import SimplexStep
from ladarreg_core.thesis.estimators.stereo_simplex import DescentStep
from testing.workbench.workbench_driver import sample_bench


def test_a_match_behind_the_camera_is_nowhere_in_the_photograph(tmp_path: Path) -> None:
    bench = sample_bench(tmp_path / "project")
    inputs = Workspace(bench.workbench.session, bench.workbench.loader).inputs("p1")
    rays = [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]
    matches = Matches(rays, [2.0, 2.0], [[10.0, 10.0], [20.0, 20.0]], ("ahead", "behind"))
    simplex = SimplexStep(1, "start", np.zeros((7, 6)), np.zeros(7), 7)
    step = DescentStep(simplex, 0, 0, "stereo", np.ones(2, bool), np.eye(3))
    event = frame_event(Frame("p1", matches, inputs, step, last=False))
    bench.workbench.close()
    camera = inputs.photo.camera
    middle = (camera.width / 2, camera.height / 2)
    (ahead,), (behind,) = event["predicted"]["ahead"], event["predicted"]["behind"]
    assert ahead is not None
    assert np.linalg.norm(np.subtract(ahead, middle)) < 0.1 * camera.width
    assert behind is None
