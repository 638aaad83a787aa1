"""The thermal and the gamma camera, on worlds whose radiation is known analytically, and as files."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import ladarreg_core as lr
from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.temperatures import centikelvin
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")

from ladarreg_core.simulate import SimulatedCase, simulate_case
from ladarreg_core.simulate import thermal as thermal_camera
from ladarreg_core.simulate.case import case_files
from ladarreg_core.simulate.gamma import GAMMA_CAMERA, take_gamma_image
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.thermal import THERMAL_CAMERA, take_thermal_image
from ladarreg_core.simulate.worlds.scenes import build_scene
from ladarreg_core.simulate.worlds.world import Texture, WorldBuilder
from testing.scenes.simulated import simulated

AHEAD = Rigid(CAMERA_AXES_FROM_SCANNER, np.zeros(3))


def sheet(value: int = 128, **finish: float) -> Texture:
    rng = np.random.default_rng(value)
    return Texture(rng.integers(0, 256, (8, 8, 4)).astype(np.uint8), **finish)


def image_of(
    *walls: tuple[float, tuple[float, float], Texture], seed: int = 0, noise: float = 1.0
) -> NDArray[np.float32]:
    """Photograph sheets that face the camera: range, right and left end (m), texture."""
    builder = WorldBuilder()
    for x_m, (right, left), texture in walls:
        builder.quad((x_m, left, 9), (0, right - left, 0), (0, 0, -18), texture)
    world = builder.finish(focus_m=4.0, lights=[(0, 0, 2)])
    rng = np.random.default_rng(seed)
    return take_thermal_image(world, RayCaster(world.triangles), THERMAL_CAMERA, AHEAD, rng=rng, noise=noise)


def test_print_is_invisible() -> None:
    """No albedo: the same sheet with another print on it gives the same picture, bit by bit."""
    assert (image_of((4.0, (-9, 9), sheet(1))) == image_of((4.0, (-9, 9), sheet(2)))).all()


def test_a_warmer_body_is_warmer_by_its_emissivity() -> None:
    cold, warm = (image_of((4.0, (-9, 0), sheet()), (4.0, (0, 9), sheet(excess_k=k)), noise=0.0) for k in (0.0, 10.0))
    rise = warm - cold
    row = THERMAL_CAMERA.height // 2
    assert np.abs(rise[row, 8:140] - 10 * sheet().emissivity).max() < 0.15  # the left half; a little less off the axis
    assert np.abs(rise[row, 180:-8]).max() < 1e-3
    # A metal hides its own warmth.
    assert sheet(metal=0.9).emissivity < 0.5 < sheet().emissivity


def test_the_lens_blurs_by_a_pixel() -> None:
    wall = image_of((4.0, (-9, 0), sheet()), (4.0, (0, 9), sheet(excess_k=20.0)), noise=0.0)
    profile = np.diff(wall[THERMAL_CAMERA.height // 2].astype(float))[150:170]
    weight = profile / profile.sum()
    at = np.arange(len(weight))
    spread = np.sqrt(weight @ (at - weight @ at) ** 2)
    # The blur, a pixel's own width by two samples a quarter off, and the difference's half pixel each way.
    assert spread == pytest.approx(np.sqrt(1.0 + 1 / 16 + 1 / 12), abs=0.15)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_noise_is_what_is_stated(seed: int) -> None:
    clean, noisy = (image_of((4.0, (-9, 9), sheet()), seed=seed, noise=noise) for noise in (0.0, 1.0))
    added = (noisy - clean).astype(float)
    fast = added - cv2.GaussianBlur(added, (0, 0), 6)
    # What a blur of 6 px leaves of white noise is 1 - 1/(pi 6^2) + 1/(4 pi 6^2) of its variance.
    expected = 0.05 * np.sqrt(1 - 3 / (4 * np.pi * 36))
    assert fast.std() == pytest.approx(expected, rel=4 / np.sqrt(2 * fast.size) + 0.01)
    assert 0.01 < cv2.GaussianBlur(added, (0, 0), 20).std() < 0.5


@pytest.fixture(scope="module")
def people() -> SimulatedCase:
    return simulated("people", set_name="thermal", seed=4, k1=-0.1, k1_error=0.02, focal_error=0.05)


@pytest.mark.slow
def test_people_are_warm_in_a_room(people: SimulatedCase) -> None:
    kelvin = people.photo.temperature_k
    assert kelvin is not None
    assert kelvin.shape == (240, 320)
    celsius = kelvin - 273.15
    assert 18 < np.median(celsius) < 31  # a picture may be filled with people
    assert 30 < np.percentile(celsius, 99.5) < 45
    assert celsius.min() > 10
    assert people.photo.camera.fx == pytest.approx(1.05 * people.true_camera.fx)
    assert people.photo.camera.distortion[0] == pytest.approx(-0.08)
    assert people.true_camera.distortion[0] == -0.1


@pytest.mark.slow
def test_a_thermal_case_is_read_as_it_was_written(people: SimulatedCase, tmp_path: Path) -> None:
    for name, write in case_files(people):
        write(tmp_path / name)
    photo = lr.read_photo(tmp_path / "photo.png", camera=tmp_path / "camera.json")
    assert photo.temperature_k is not None
    assert people.photo.temperature_k is not None
    assert (centikelvin(photo.temperature_k) == centikelvin(people.photo.temperature_k)).all()
    assert (photo.pixels == people.photo.pixels).all()
    assert any("thermal" in note for note in photo.notes)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["boxes", "people"])
def test_only_pipes_are_new_in_a_heated_room(scene: str) -> None:
    cold, heated = (build_scene(scene, layout=np.random.default_rng(5), heated=hot) for hot in (False, True))
    own = cold.normals.shape[1]
    assert (heated.normals[:, :own] == cold.normals).all()
    assert (heated.heat[:, :own] == cold.heat).all()
    assert (heated.heat[0, own:] > 10).all()
    assert heated.normals.shape[1] > own


def room() -> tuple[object, RayCaster]:
    builder = WorldBuilder()
    builder.quad((4, 9, 9), (0, -18, 0), (0, 0, -18), sheet())
    world = builder.finish(focus_m=4.0, lights=[(0, 0, 2)])
    return world, RayCaster(world.triangles)


@pytest.mark.parametrize("seed", range(4))
def test_gamma_sources_shine_where_the_truth_says(seed: int) -> None:
    world, caster = room()
    image = take_gamma_image(world, caster, GAMMA_CAMERA, AHEAD, rng=np.random.default_rng(seed))  # type: ignore[arg-type]
    assert 3 <= len(image.hot_spots_m) <= 6
    assert np.allclose(image.hot_spots_m[:, 0], 4, atol=1e-5)
    uv = GAMMA_CAMERA.project(AHEAD @ image.hot_spots_m)
    smooth = cv2.GaussianBlur(image.counts.astype(float), (0, 0), 5)
    at = smooth[np.rint(uv[:, 1]).astype(int), np.rint(uv[:, 0]).astype(int)]
    assert (at > 2 + 20).all()  # the faintest source peaks 25 counts above the background
    # No detail finer than tens of pixels: what a blur of 3 px takes away is photons, whose variance is their mean.
    rough = image.counts - cv2.GaussianBlur(image.counts.astype(float), (0, 0), 3)
    expected = smooth.mean() * (1 - 3 / (4 * np.pi * 9))
    assert (rough**2).mean() == pytest.approx(expected, rel=0.05)


def test_a_gamma_camera_that_looks_away_says_so() -> None:
    world, caster = room()
    behind = Rigid(CAMERA_AXES_FROM_SCANNER @ np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    with pytest.raises(DegenerateGeometryError, match="sees nothing"):
        take_gamma_image(world, caster, GAMMA_CAMERA, behind, rng=np.random.default_rng(0))  # type: ignore[arg-type]


@pytest.mark.slow
def test_the_gamma_set_writes_its_sources(tmp_path: Path) -> None:
    case = simulate_case("boxes", set_name="gamma", seed=1)
    for name, write in case_files(case):
        write(tmp_path / name)
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert case.hot_spots_m is not None
    assert np.allclose(truth["hot_spots_m"], case.hot_spots_m)
    photo = lr.read_photo(tmp_path / "photo.png", camera=tmp_path / "camera.json")
    assert (photo.pixels == case.photo.pixels).all()
    assert photo.temperature_k is None
    assert thermal_camera.THERMAL_CAMERA.size == photo.camera.size
