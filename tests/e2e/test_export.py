"""Export in a real browser: what is offered, refused, zipped, and read by programs of others."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.simulate.sample import sample_folder
from ladarreg_core.storage.manifest import MANIFEST_FILE
from testing.scenes.true_matches import true_points
from testing.workbench.audits import hard_to_read
from testing.workbench.operator import Operator, at_work
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser

DESCRIBED = """(box) => box.getAttribute("aria-describedby").split(" ")
  .map((id) => document.getElementById(id).textContent).join(" ")"""
ENABLED_BOXES = "[...document.querySelectorAll('.target-list input')].filter((box) => !box.disabled).length"


@pytest.fixture
def operator(browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest) -> Iterator[Operator]:
    """An operator at the step Export of a photograph that was not solved yet."""
    workbench.open("camera")
    with at_work(browser, workbench.server, request, size=(1280, 720)) as found:
        assert found.socket.ask("set_settings", solve_automatically=False)["ok"]
        found.open()
        found.step("Export")
        yield found


@pytest.mark.long
def test_two_targets_in_a_zip_are_read_by_other_programs(operator: Operator, tmp_path: Path) -> None:
    page = operator.page
    panel = page.get_by_role("region", name="Export", exact=True)
    panel.get_by_text("Cannot be written: photo").first.wait_for()
    assert page.evaluate(ENABLED_BOXES) == 0, "nothing is registered yet, and each target says so"
    assert operator.button("Download zip").is_disabled()
    operator.shot("refused")
    for point in true_points(20):
        assert operator.socket.ask("add_pick", photo="p1", **point)["ok"]
    assert operator.socket.ask("run", photo="p1", job="robust")["ok"]
    page.wait_for_function(f"{ENABLED_BOXES} > 9", timeout=120_000)
    panel.get_by_text("To be exported: photo").wait_for()
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        assert hard_to_read(page) == []
        operator.shot(f"{scheme}-offered")

    opencv, cloud = (panel.get_by_role("checkbox", name=name) for name in ("OpenCV", "LAS / LAZ"))
    opencv.focus()
    page.keyboard.press("Space")
    assert opencv.is_checked()
    assert "for programs that call OpenCV" in opencv.evaluate(DESCRIBED)
    cloud.check()
    panel.get_by_role("checkbox", name="Results").uncheck()
    with page.expect_download(timeout=120_000) as saved:
        operator.button("Download zip").click()
    path = tmp_path / saved.value.suggested_filename
    saved.value.save_as(path)
    assert path.name.endswith("-export.zip")
    operator.shot("exported")

    with zipfile.ZipFile(path) as file:
        assert file.testzip() is None
        names = file.namelist()
        assert json.loads(file.read("export.json"))["files"] == [
            name for name in names if name not in ("export.json", MANIFEST_FILE)
        ]
        check_with_opencv(file.read("opencv/photo.yaml"), tmp_path)
        check_with_laspy(file.read(next(name for name in names if name.endswith(".laz"))))


def check_with_opencv(text: bytes, folder: Path) -> None:
    """OpenCV's own projection of the laser's points is that of the true pose to within the noise of the matches."""
    cv2 = pytest.importorskip("cv2")
    (folder / "photo.yaml").write_bytes(text)
    file = cv2.FileStorage(str(folder / "photo.yaml"), cv2.FILE_STORAGE_READ)
    k, d, rvec, tvec = (file.getNode(name).mat() for name in ("K", "D", "rvec", "tvec"))
    scan, truth, camera = sample_case()
    points = scan.points.reshape(-1, 3)[::997].astype(float)
    points = points[np.isfinite(points).all(axis=1)]
    wanted = camera.project(truth @ points)
    seen = camera.contains(wanted)
    found = cv2.projectPoints(points[seen], rvec, tvec, k, d)[0].reshape(-1, 2)
    assert np.median(np.linalg.norm(found - wanted[seen], axis=1)) < 1.0
    flipped = cv2.projectPoints(points[seen] * (1, -1, 1), rvec, tvec, k, d)[0].reshape(-1, 2)
    assert np.median(np.linalg.norm(flipped - wanted[seen], axis=1)) > 20, "the control: an axis flipped"


def check_with_laspy(data: bytes) -> None:
    """The cloud has every return of the scan, at its place."""
    laspy = pytest.importorskip("laspy")
    cloud = laspy.read(io.BytesIO(data))
    scan, _, _ = sample_case()
    points = scan.points.reshape(-1, 3)[scan.valid.reshape(-1)]
    assert len(cloud.x) == len(points)
    found = np.stack([cloud.x, cloud.y, cloud.z], axis=-1)
    assert np.abs(found - points).max() < 1e-3, "to its stated resolution"
    assert np.abs(found - points[:, [1, 0, 2]]).max() > 1, "the control: axes swapped"


def sample_case() -> tuple[lr.Scan, lr.Rigid, Any]:
    folder = sample_folder()
    camera = lr.read_photo(next(folder.glob("photo.*")), camera=folder / "camera.json").camera
    truth = json.loads((folder / "truth.json").read_text())["camera_from_scanner"]
    return lr.read_scan(folder / "scan.npz"), lr.Rigid.from_matrix(np.array(truth)), camera
