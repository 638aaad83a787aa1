"""Places outdoors and the lidars of robots in them."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")

from ladarreg_core.errors import OptionError
from ladarreg_core.simulate.outdoor_case import OutdoorCase, simulate_outdoors
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.robot_lidar import BEAM_NOISE, BeamNoise, LidarName, lidar_rays, scan_points
from ladarreg_core.simulate.worlds.outdoors import EYE_M, build_outdoors
from testing.scenes.simulated import outdoors


def case(scene: str, lidar: LidarName, seed: int = 4) -> OutdoorCase:
    return outdoors(scene, lidar=lidar, seed=seed)


def angles_deg(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    return np.degrees(np.arccos(rays[:, 0])), np.degrees(np.arcsin(rays[:, 2]))


@pytest.mark.slow
@pytest.mark.parametrize(("lidar", "widest"), [("petals", 35.3), ("narrow", 19.3)])
def test_petals_fill_a_cone_and_come_back_nowhere(lidar: str, widest: float) -> None:
    rays = lidar_rays(lidar, np.random.default_rng(0))
    assert np.linalg.norm(rays, axis=1) == pytest.approx(1)
    polar, _ = angles_deg(rays)
    assert 0.95 * widest < polar.max() < widest
    early, late = (
        np.unique(np.rint(np.degrees(np.arctan2(part[:, 1:], part[:, :1])) / 0.2), axis=0)
        for part in (rays[: len(rays) // 8], rays)
    )
    assert len(late) > 1.5 * len(early), "a pattern that repeats fills no more directions with time"


def test_lines_are_lines_and_half_of_the_seeds_space_them_unevenly() -> None:
    uneven = []
    for seed in range(20):
        _, up = angles_deg(lidar_rays("64 lines", np.random.default_rng(seed)))
        lines = np.unique(up.round(4))
        assert len(lines) == 64
        steps = np.diff(lines)
        uneven.append(steps.max() > 1.5 * steps.min())
    assert 4 <= sum(uneven) <= 16  # of 20 fair draws, all but 1 in 400 times; the seeds are fixed


@pytest.mark.long
def test_the_photo_shows_what_the_lidar_meets() -> None:
    """The points are where the true pose sees their surfaces: the ground is flat, `EYE_M` below."""
    from_above = case("courtyard", "128 lines").cloud.points
    flat = from_above[(from_above[:, 2] < -EYE_M + 0.1) & (np.hypot(*from_above[:, :2].T) < 20)]
    assert len(flat) > 10_000
    assert float(np.median(flat[:, 2])) == pytest.approx(-EYE_M - 0.007, abs=0.01)
    c = case("street", "petals")
    uv = c.true_camera.project(c.camera_from_scanner @ c.cloud.points)
    inside = c.true_camera.contains(uv)
    assert inside.mean() > 0.6
    pixels = c.photo.pixels[tuple(np.rint(uv[inside]).astype(int).T[::-1])].astype(float)
    sky = (pixels[:, 2] > 200) & (pixels[:, 2] > pixels[:, 0] + 40)
    assert sky.mean() < 0.02, "hardly any return lies in front of the sky"


@pytest.mark.long
def test_ranges_end_and_have_the_stated_noise() -> None:
    far = np.linalg.norm(case("street", "128 lines").cloud.points, axis=1)
    assert 90 < far.max() <= BEAM_NOISE.farthest_m + 0.1
    world = build_outdoors("courtyard", layout=np.random.default_rng(3))
    caster, rays = RayCaster(world.triangles), lidar_rays("narrow", np.random.default_rng(1))[::7]
    exact = BeamNoise(sigma_m=0.0, footprint_rad=0.0, speckle=0.0)
    noisy = BeamNoise(sigma_m=0.05, footprint_rad=0.0, speckle=0.0)
    one, other = (scan_points(world, caster, rays, rng=np.random.default_rng(2), noise=n) for n in (exact, noisy))
    off = np.linalg.norm(other.points, axis=1) - np.linalg.norm(one.points, axis=1)
    assert float(off.std()) == pytest.approx(0.05, rel=0.05)


@pytest.mark.slow
def test_petals_report_no_intensity_and_lines_do() -> None:
    assert not case("street", "petals").scan.has_intensity
    assert case("street", "128 lines").scan.has_intensity
    assert any("128 rings" in note for note in case("street", "128 lines").scan.notes)


@pytest.mark.long
def test_a_case_is_reproducible_and_another_seed_another_place() -> None:
    first, again = case("courtyard", "128 lines"), simulate_outdoors("courtyard", lidar="128 lines", seed=4)
    assert (first.cloud.points == again.cloud.points).all()
    assert (first.photo.pixels == again.photo.pixels).all()
    other = case("courtyard", "128 lines", 5)
    assert (first.photo.pixels != other.photo.pixels).mean() > 0.5


def test_unknown_places_and_lidars_are_refused() -> None:
    with pytest.raises(OptionError, match="the scene"):
        simulate_outdoors("moon", lidar="petals")
    with pytest.raises(OptionError, match="the lidar"):
        simulate_outdoors("street", lidar="sonar")  # type: ignore[arg-type]
