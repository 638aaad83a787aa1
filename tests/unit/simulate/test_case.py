"""Whole cases: reproducible by seed, different between seeds, and refused for invalid arguments."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ladarreg_core.camera import Camera, camera_from_model_fields
from ladarreg_core.errors import Cancelled, DependencyError, ExportError, OptionError
from ladarreg_core.formats.scans.npz import read_npz
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, ThesisParameters
from ladarreg_core.simulate import SCENES, SETS, SimulatedCase, sample, simulate_case, write_case
from ladarreg_core.simulate.case import CAMERA, _pose
from ladarreg_core.simulate.ladar import GEOMETRY, LadarImages
from ladarreg_core.simulate.sample import SAMPLE_FILES, sample_folder
from ladarreg_core.simulate.worlds.materials import InkMixer
from ladarreg_core.simulate.worlds.scenes import build_scene
from testing.scenes.kept import kept
from testing.scenes.simulated import COMMON_SEED, simulated


def digest(case: SimulatedCase) -> str:
    parts = (case.counts, case.intensity, case.photo.pixels, case.camera_from_scanner.matrix)
    return hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()


@kept
def told_case(scene: str) -> tuple[SimulatedCase, tuple[Progress, ...]]:
    """Return a case, and the progress that was reported."""
    pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
    told: list[Progress] = []
    case = simulate_case(scene, report=told.append)
    return case, tuple(told)


def case_of(scene: str) -> SimulatedCase:
    if scene == "boxes":
        return told_case(scene)[0]
    pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
    return simulated(scene, seed=sample.SEED if scene == sample.SCENE else COMMON_SEED)


@pytest.mark.parametrize(
    "scene", [pytest.param(scene, marks=[pytest.mark.long] * (scene != "boxes")) for scene in sorted(SCENES)]
)
@pytest.mark.slow
def test_a_case_has_enough_to_register(scene: str) -> None:
    case = case_of(scene)
    assert case.scan.shape == (700, 1000)
    assert case.scan.valid.mean() > 0.9
    assert 1.2 < np.nanpercentile(case.scan.ranges, 2) < np.nanpercentile(case.scan.ranges, 98) < 7.5
    assert (case.intensity == 4095).mean() < 0.1
    pixels = case.photo.pixels
    assert 60 < pixels.mean() < 190
    assert pixels.std() > 30
    assert ((pixels == 255).all(axis=-1)).mean() < 0.02
    # Much of what was scanned is in the picture, and much of the picture was scanned.
    uv = case.photo.camera.project(case.camera_from_scanner @ case.scan.points[::4, ::4].reshape(-1, 3))
    inside = case.photo.camera.contains(uv)
    assert inside.mean() > 0.3
    tiles = {tuple(tile) for tile in (uv[inside] // 64).astype(int)}
    assert len(tiles) > 0.6 * (768 // 64) * (512 // 64)


def edge_strength(image: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    dy, dx = np.gradient(cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5))
    return np.hypot(dx, dy)


@pytest.mark.slow
def test_scan_and_photograph_show_the_same_thing_at_the_true_pose() -> None:
    """Dark print on light ground agrees best, over all shifts, at no shift."""
    case = case_of("boxes")
    albedo = case.intensity * np.nan_to_num(case.scan.ranges / 2.5) ** 2
    edges = edge_strength(albedo)[::2, ::2]
    photo_edges = edge_strength(case.photo.pixels.mean(axis=-1))
    uv = case.photo.camera.project(case.camera_from_scanner @ case.scan.points[::2, ::2])
    use = case.photo.camera.contains(uv, border=10)
    weight = np.minimum(edges[use], np.percentile(edges[use], 95))
    weight -= weight.mean()
    column, row = np.rint(uv[use]).astype(int).T
    shifts = itertools.product(range(-3, 4), repeat=2)
    scores = {(du, dv): float(weight @ photo_edges[row + dv, column + du]) for du, dv in shifts}
    assert max(scores, key=lambda shift: scores[shift]) == (0, 0)


@pytest.mark.slow
def test_the_same_arguments_give_the_same_bytes_whatever_the_threads_and_hashes() -> None:
    child = (
        "import hashlib, os, cv2, numpy as np\n"
        "cv2.setNumThreads(1); os.cpu_count = lambda: 1\n"
        "from ladarreg_core.simulate import simulate_case\n"
        "c = simulate_case('boxes')\n"
        "parts = (c.counts, c.intensity, c.photo.pixels, c.camera_from_scanner.matrix)\n"
        "print(hashlib.sha256(b''.join(np.ascontiguousarray(p).tobytes() for p in parts)).hexdigest())\n"
    )
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    env = {**os.environ, **threads, "PYTHONHASHSEED": "77"}
    root = Path(__file__).resolve().parents[3]
    out = subprocess.run([sys.executable, "-c", child], env=env, cwd=root, capture_output=True, text=True, check=True)
    assert out.stdout.strip() == digest(case_of("boxes"))


@pytest.mark.slow
def test_every_seed_is_another_room_and_another_pose() -> None:
    worlds = [build_scene("people", layout=np.random.default_rng(seed)) for seed in range(2)]
    assert len({world.triangles.tobytes() for world in worlds}) == 2
    assert len({world.texels.tobytes() for world in worlds}) == 2
    poses = {_pose(SETS["standard"], s, 3.5, np.random.default_rng(s)).matrix.tobytes() for s in range(20)}
    assert len(poses) == 20


@pytest.mark.parametrize("set_name", sorted(SETS))
def test_poses_stay_within_their_set(set_name: str) -> None:
    case_set = SETS[set_name]
    for seed in range(100):
        p = ThesisParameters.from_pose(_pose(case_set, seed, 3.5, np.random.default_rng(seed)))
        low, high = case_set.baseline_m
        assert low - 1e-9 <= abs(p.Tx) <= high + 1e-9
        assert max(abs(p.Ty), abs(p.Tz)) <= case_set.other_axes_m + 1e-9
        # A camera on the left looks to the right, where the scene is.
        assert p.alpha * p.Tx >= 0 or abs(np.degrees(p.alpha)) < 2.5
        assert abs(np.degrees(p.alpha)) <= case_set.toe_in_limit_deg + 1e-6
        assert abs(np.degrees(p.beta)) <= case_set.tilt_deg + 1e-6
        turned = [abs((np.degrees(p.gamma) - roll + 180) % 360 - 180) for roll in case_set.rolls_deg]
        assert min(turned) <= case_set.tilt_deg + 1e-6
    if set_name == "identical":
        assert np.allclose(p.pose.matrix, Rigid(CAMERA_AXES_FROM_SCANNER, np.zeros(3)).matrix)


@pytest.mark.parametrize("set_name", ["standard", "hard"])
def test_a_laser_sees_other_colors_than_the_eye(set_name: str) -> None:
    well = InkMixer(np.random.default_rng(0), independent=set_name == "hard")
    red = np.array([well.of((255, 40, 40))[3] for _ in range(2000)]) / 255
    black = np.array([well.of((20, 20, 20))[3] for _ in range(2000)]) / 255
    white = np.array([well.of((250, 250, 250))[3] for _ in range(2000)]) / 255
    if set_name == "hard":
        assert abs(red.mean() - 0.45) + abs(black.mean() - 0.45) + abs(white.mean() - 0.45) < 0.05
    else:
        assert (black < 0.2).mean() == pytest.approx(0.7, abs=0.04)
        assert red.mean() > 0.65
        assert white.min() > 0.55


@pytest.mark.slow
def test_the_stated_camera_may_be_wrong_on_purpose(monkeypatch: pytest.MonkeyPatch) -> None:
    straight = case_of("boxes")
    assert straight.photo.camera == straight.true_camera == CAMERA
    used: list[Camera] = []

    def photograph(_world: Any, _caster: Any, camera: Camera, *_: Any, **__: Any) -> NDArray[np.uint8]:
        used.append(camera)
        return straight.photo.pixels

    images = LadarImages(straight.counts, straight.intensity)
    monkeypatch.setattr("ladarreg_core.simulate.case.scan_world", lambda *_, **__: images)
    monkeypatch.setattr("ladarreg_core.simulate.case.take_photograph", photograph)
    case = simulate_case("boxes", k1=-0.15, k1_error=0.15, focal_error=0.05)
    assert [case.true_camera] == used == [Camera(768, 512, 974, 974, 383.5, 255.5, (-0.15, 0, 0, 0))]
    assert case.photo.camera == Camera(768, 512, 974 * 1.05, 974 * 1.05, 383.5, 255.5)
    assert np.array_equal(case.camera_from_scanner.matrix, straight.camera_from_scanner.matrix)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"scene": "garden"}, "boxes, desk, office, people"),
        ({"scene": ""}, "boxes"),
        ({"set_name": "tropical"}, "standard, hard, wide, rotated, identical"),
        ({"seed": -1}, "at least 0"),
        ({"seed": True}, "whole number"),
        ({"seed": 1.5}, "whole number"),
        ({"seed": "3"}, "whole number"),
        ({"k1": float("nan")}, "k1"),
        ({"focal_error": -1.0}, "focal error"),
    ],
)
def test_invalid_arguments_are_refused_in_one_line(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(OptionError, match=says) as caught:
        simulate_case(**{"scene": "boxes", **arguments})
    assert "\n" not in str(caught.value)


def test_a_missing_ray_caster_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    with pytest.raises(DependencyError, match="pip install embreex"):
        simulate_case("desk")


@pytest.mark.slow
def test_progress_runs_to_the_end_and_can_be_cancelled() -> None:
    _, told = told_case("boxes")
    done = [step.done for step in told]
    assert done == sorted(done)
    assert (done[0], done[-1], told[-1].total) == (0, 100, 100)
    assert len({step.label for step in told}) == 3

    def stop(progress: Progress) -> None:
        if progress.done > 15:
            raise Cancelled

    with pytest.raises(Cancelled):
        simulate_case("boxes", report=stop)


def test_a_written_case_reads_back_as_it_was(tmp_path: Path) -> None:
    case = case_of("boxes")
    write_case(case, tmp_path / "new")
    assert {path.name for path in (tmp_path / "new").iterdir()} == set(SAMPLE_FILES)
    scan = read_npz(tmp_path / "new" / "scan.npz")
    assert np.array_equal(scan.ranges, case.scan.ranges, equal_nan=True)
    assert np.array_equal(scan.intensity, case.scan.intensity)
    assert scan.geometry == GEOMETRY
    assert scan.intensity_is == "raw"
    assert np.array_equal(cv2.imread(str(tmp_path / "new" / "photo.png"))[..., ::-1], case.photo.pixels)
    camera = json.loads((tmp_path / "new" / "camera.json").read_text())
    assert camera_from_model_fields(camera) == case.photo.camera
    truth = json.loads((tmp_path / "new" / "truth.json").read_text())
    assert np.array_equal(truth["camera_from_scanner"], case.camera_from_scanner.matrix)


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ExportError, match="cannot be written") as caught:
        write_case(case_of("boxes"), tmp_path / "file" / "out")
    assert "\n" not in str(caught.value)


def test_the_embedded_sample_is_complete_and_small() -> None:
    folder = sample_folder()
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 3_000_000


@pytest.mark.slow
def test_the_command_reproduces_the_embedded_sample() -> None:
    folder, case = sample_folder(), case_of(sample.SCENE)
    truth = Rigid.from_matrix(json.loads((folder / "truth.json").read_text())["camera_from_scanner"])
    assert np.allclose(truth.matrix, case.camera_from_scanner.matrix, atol=1e-9)
    # Another processor may round a last bit the other way.
    assert np.mean(read_npz(folder / "scan.npz").ranges == case.scan.ranges) > 0.95
    assert np.mean(cv2.imread(str(folder / "photo.png"))[..., ::-1] == case.photo.pixels) > 0.95
