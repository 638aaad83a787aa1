"""A rough pose, given as a matrix or by the 3-D view, from which the registration starts."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from ladarreg.scene.cameras_layer import viser_pose
from ladarreg.scene.viewer_pose import viewer_pose

from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.workbench_driver import WorkbenchDriver, sample_bench


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkbenchDriver]:
    found = sample_bench(tmp_path_factory.mktemp("rough") / "project")
    yield found
    found.workbench.close()


@pytest.mark.slow
def test_a_rough_pose_is_refined_to_the_true_one(bench: WorkbenchDriver) -> None:
    truth = read_pose(sample_folder() / "truth.json")
    turned = rotation_from_rotvec(np.radians([3.0, -4.0, 2.0])) @ truth.rotation
    rough = Rigid.from_centre(turned, truth.centre + np.array([0.1, -0.1, 0.05]))
    bench.do("refine", photo="p1", camera_from_scanner=rough.matrix.tolist())
    assert bench.workbench.runner.job is not None
    assert bench.workbench.runner.job.label == "Refine the rough pose"
    bench.workbench.runner.wait(240)
    (stage,) = bench.slice("poses:p1")["stages"]
    assert (stage["stage"], stage["accepted"]) == ("auto", True)
    entry = bench.workbench.session.document.photos[0].pose
    assert entry is not None
    found = Rigid.from_matrix(np.array(entry.camera_from_scanner))
    assert np.degrees(found.angle_to(truth)) < 0.15
    assert found.distance_to(truth) < 0.02


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        ([[1, 0, 0, 0]] * 4, "4 rows of a rigid transform"),
        ("here", "must be a list"),
        ([[1, 0, 0, 1e9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "from the scanner"),
    ],
)
def test_what_is_no_pose_is_refused(bench: WorkbenchDriver, pose: object, said: str) -> None:
    assert said in bench.refused("refine", photo="p1", camera_from_scanner=pose)


def test_without_a_3d_view_a_pose_is_needed(bench: WorkbenchDriver) -> None:
    assert "3-D view is not open" in bench.refused("refine", photo="p1")


def test_the_camera_of_a_viewer_is_that_of_a_frustum_in_the_scene() -> None:
    pose = Rigid.from_rotvec([0.3, -1.2, 0.8], [0.5, -0.2, 1.5])
    found = viewer_pose(SimpleNamespace(**viser_pose(pose)))  # type: ignore[arg-type]
    assert found is not None
    np.testing.assert_allclose(found.matrix, pose.matrix, atol=1e-9)


def test_a_viewer_that_has_not_reported_its_camera_has_no_pose() -> None:
    class Unknown:
        @property
        def wxyz(self) -> None:
            raise AssertionError

    assert viewer_pose(Unknown()) is None  # type: ignore[arg-type]
