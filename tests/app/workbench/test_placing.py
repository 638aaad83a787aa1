"""A camera placed by hand: moved and turned as its operator sees it, with a preview of what it would see."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.errors import OptionError
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.frames import Rigid
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.workbench_driver import WorkbenchDriver, sample_bench


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkbenchDriver]:
    found = sample_bench(tmp_path_factory.mktemp("placed") / "project")
    yield found
    found.workbench.close()


def placed(bench: WorkbenchDriver, **how: object) -> Rigid:
    return Rigid.from_matrix(bench.do("place_camera", photo="p1", **how)["camera_from_scanner"])


def test_it_moves_and_turns_as_its_operator_sees_it(bench: WorkbenchDriver) -> None:
    before = placed(bench, start="scanner")
    given = before.matrix.tolist()
    moved = placed(bench, camera_from_scanner=given, shift_m=[0.2, -0.1, 0.5])
    np.testing.assert_allclose(before.rotation @ (moved.centre - before.centre), [0.2, -0.1, 0.5], atol=1e-9)
    np.testing.assert_allclose(moved.rotation, before.rotation, atol=1e-12)
    sine, cosine = math.sin(math.radians(5)), math.cos(math.radians(5))
    for turn, axis, direction in (
        ([5, 0, 0], 2, [0, -sine, cosine]),  # it looks up: y is down
        ([0, 5, 0], 2, [sine, 0, cosine]),
        ([0, 0, 5], 0, [cosine, sine, 0]),  # clockwise: its right side goes down
    ):
        turned = placed(bench, camera_from_scanner=given, turn_deg=turn)
        np.testing.assert_allclose(turned.centre, before.centre, atol=1e-9)
        np.testing.assert_allclose(before.rotation @ turned.rotation[axis], direction, atol=1e-9)
    assert bench.do("place_camera", photo="p1")["camera_from_scanner"] is None
    assert bench.slice("history")["entries"][-1]["label"].startswith("Camera"), "placing is no step of the history"


def test_what_cannot_be_placed_is_refused(bench: WorkbenchDriver) -> None:
    assert "No pose is shown" in bench.refused("place_camera", photo="p1", start="pose")
    assert "3-D view is not open" in bench.refused("place_camera", photo="p1", start="view")
    assert "three lengths" in bench.refused("place_camera", photo="p1", start="scanner", shift_m=[1, 2])
    assert "three angles" in bench.refused("place_camera", photo="p1", start="scanner", turn_deg=["up", 0, 0])
    far = [[1, 0, 0, 1e9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert "from the scanner" in bench.refused("place_camera", photo="p1", camera_from_scanner=far)


def preview(bench: WorkbenchDriver, pose: str) -> np.ndarray:
    picture = bench.workbench.images.picture("overlay/p1", {"pose": pose})
    return np.asarray(Image.open(io.BytesIO(picture.data)))


def numbers(pose: Rigid) -> str:
    return ",".join(f"{value:.7f}" for value in pose.matrix[:3].reshape(-1))


def test_the_preview_shows_what_the_camera_would_see(bench: WorkbenchDriver) -> None:
    """From the true pose the scan lies over the photograph; farther to the right it lies farther to the left."""
    truth = read_pose(sample_folder() / "truth.json")
    here = preview(bench, numbers(truth))
    photo = bench.slice("photos")[0]
    assert here.shape == (photo["height"], photo["width"], 4)
    seen = here[..., 3] > 0
    assert seen.mean() > 0.5
    moved = placed(bench, camera_from_scanner=truth.matrix.tolist(), turn_deg=[0, 4, 0])
    there = preview(bench, numbers(moved))
    shift = round(photo["camera"]["fx"] * math.tan(math.radians(4)))
    both = seen[:, shift:] & (there[:, :-shift, 3] > 0)
    apart = np.abs(here[:, shift:, 0].astype(float) - there[:, :-shift, 0])[both]
    stay = np.abs(here[..., 0].astype(float) - there[..., 0])[seen & (there[..., 3] > 0)]
    assert apart.mean() < 0.6 * stay.mean()


@pytest.mark.parametrize("pose", ["", "1,2,3", ",".join(["nan"] * 12), ",".join(["1"] * 12), "a" * 40])
def test_a_preview_from_no_pose_is_refused(bench: WorkbenchDriver, pose: str) -> None:
    with pytest.raises(OptionError, match="pose"):
        preview(bench, pose)
