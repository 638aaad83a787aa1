from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.frames import Rigid, look_along, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.estimators.bundle import States, information_matrix
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.quality.next_match import part_of_photo, suggest_matches
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.ranges import surface_range
from ladarreg_core.surface.visibility.visible_points import project_scan
from testing.scenes.painted_room import shoot

SIGMA_PX, SIGMA_M = 1.0, 0.01
OPTIONS = PoseOptions(sigma_px=SIGMA_PX, sigma_range_m=SIGMA_M, gate_chi2=1e4)


@dataclass(frozen=True)
class Room:
    """The painted room without its paint."""

    scan: Scan
    camera: Camera
    camera_from_scanner: Rigid
    rays: np.ndarray
    """(N, 3) points that can be picked."""
    uv: np.ndarray
    """(N, 2) their pixels."""

    def error_px(self, pose: Rigid) -> float:
        """Median displacement in the photo."""
        points = (self.rays * surface_range(self.scan, self.rays)[:, None])[::3]
        return float(np.median(np.linalg.norm(self.camera.project(pose @ points) - self.uv[::3], axis=1)))


@lru_cache(maxsize=2)
def shared_room(seed: int) -> Room:
    geometry = AzimuthElevation(300, 420, np.deg2rad(0.11), np.deg2rad(0.11))
    ranges, box, _ = shoot(np.zeros(3), geometry.rays.reshape(-1, 3))
    ranges = np.where(box >= 0, ranges, np.nan).reshape(geometry.shape)
    scan = Scan(geometry, ranges, np.ones(geometry.shape))
    camera = Camera(480, 340, 520.0, 520.0, 239.5, 169.5, (0.1, -0.03, 0.001, 0.0) if seed else ())
    centre = np.array([0.05, 0.4 - 0.8 * seed, 0.08])
    pose = Rigid.from_centre(look_along(np.array([3.5, 0.0, -0.2]) - centre), centre)
    seen = project_scan(scan, camera, pose)
    rays = scan.rays[seen.visible & ~seen.grazing][::17]
    reach = surface_range(scan, rays)
    rays, reach = rays[np.isfinite(reach)], reach[np.isfinite(reach)]
    return Room(scan, camera, pose, rays, camera.project(pose @ (rays * reach[:, None])))


def measured(room, rays, rng):
    ranges = surface_range(room.scan, rays)
    uv = room.camera.project(room.camera_from_scanner @ (rays * ranges[:, None]))
    return Matches(rays, ranges + rng.normal(size=len(rays)) * SIGMA_M, uv + rng.normal(size=uv.shape) * SIGMA_PX)


def joined(a, b):
    return Matches(*(np.concatenate([getattr(m, name) for m in (a, b)]) for name in ("rays", "ranges", "uv")))


def clustered(seed, *, count=8):
    """Eight matches in a quarter of the pickable points, and their pose."""
    room = shared_room(seed % 2)
    rays, uv = room.rays, room.uv
    rng = np.random.default_rng([seed, 77])
    camera = room.camera
    near = np.argsort(np.linalg.norm(uv - uv[rng.integers(len(uv))], axis=1))[: len(uv) // 4]
    matches = measured(room, rays[rng.permutation(near)[:count]], rng)
    return room, rays, matches, solve_pose(matches, camera, OPTIONS, initial=room.camera_from_scanner), rng


@pytest.mark.slow
def test_a_suggested_match_helps_more_than_a_random_one():
    before, advised, anywhere = [], [], []
    for seed in range(30):
        room, rays, matches, result, rng = clustered(seed)
        best = suggest_matches(room.scan, result, count=1)[0]
        for errors, ray in ((advised, best.ray), (anywhere, rays[rng.integers(len(rays))])):
            more = joined(matches, measured(room, ray[None], rng))
            errors.append(room.error_px(solve_pose(more, result.camera, OPTIONS, initial=result.camera_from_scanner)
                                        .camera_from_scanner))  # fmt: skip
        before.append(room.error_px(result.camera_from_scanner))
    assert np.median(advised) < np.median(anywhere)
    assert np.mean(np.square(advised)) < 0.7 * np.mean(np.square(anywhere))
    assert np.median(advised) < 0.75 * np.median(before)


def log_det(room, matches, pose):
    weighed = Measurements.of(matches, room.camera, sigma_px=SIGMA_PX, sigma_range_m=SIGMA_M)
    return np.linalg.slogdet(information_matrix(weighed, States.of([pose], weighed))[0])[1]


@pytest.mark.parametrize("seed", [1, 2])
def test_the_gain_is_that_of_the_estimators_information_and_the_largest(seed):
    room, rays, matches, result, rng = clustered(seed)
    places = suggest_matches(room.scan, result, count=3)
    assert len(places) == 3
    pose = result.camera_from_scanner

    def with_exact(at, base):
        """The base with a match of no residual along a ray."""
        ranges = surface_range(room.scan, at[None])
        uv = result.camera.project(pose @ (at * ranges[0]))
        return joined(base, Matches(at[None], ranges, uv[None]))

    now, base = log_det(room, matches, pose), matches
    for place in places:
        base = with_exact(place.ray, base)
        after = log_det(room, base, pose)
        # The result's information is taken where the ranges were adjusted, this one where they were measured.
        assert place.gain == pytest.approx(after - now, rel=0.02)
        now = after
    uv = result.camera.project(pose @ (rays * surface_range(room.scan, rays)[:, None]))
    inside = result.camera.contains(uv, border=12.0)
    others = [log_det(room, with_exact(ray, matches), pose) for ray in rng.permutation(rays[inside])[:60]]
    assert max(others) - log_det(room, matches, pose) <= places[0].gain * 1.05


def test_suggestions_lie_apart_on_surfaces_that_the_photo_sees():
    room, _, _, result, _ = clustered(3)
    camera, scan = result.camera, room.scan
    places = suggest_matches(scan, result, count=6, apart=0.2)
    assert [p.gain for p in places] == sorted((p.gain for p in places), reverse=True)
    uv = np.array([p.uv for p in places])
    away = np.linalg.norm(uv[:, None] - uv, axis=-1)[np.triu_indices(len(uv), 1)]
    assert (away > 0.2 * np.hypot(*camera.size)).all()
    visible = project_scan(scan, camera, result.camera_from_scanner).visible
    for place in places:
        assert visible[place.cell]
        np.testing.assert_allclose(scan.rays[place.cell], place.ray, atol=1e-12)
        point = place.ray * surface_range(scan, place.ray[None])[0]
        np.testing.assert_allclose(camera.project(result.camera_from_scanner @ point), place.uv, atol=1e-6)
        assert place.local_px[1] < place.local_px[0]
        assert place.median_px[1] < place.median_px[0]
    again = suggest_matches(scan, result, count=6, apart=0.2)
    assert [p.cell for p in again] == [p.cell for p in places]
    words = places[0].summary()
    assert words.startswith(f"A match near {places[0].where} of the photo")
    assert "halve the uncertainty there" in words


def test_only_pickable_cells_are_suggested():
    room, _, _, result, _ = clustered(4)
    mask = np.zeros(room.scan.shape, dtype=np.bool_)
    assert suggest_matches(room.scan, result, pickable=mask) == ()
    free = suggest_matches(room.scan, result, count=1)[0]
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]]
    mask |= np.hypot(rows - free.cell[0], columns - free.cell[1]) > 60
    found = suggest_matches(room.scan, result, pickable=mask)
    assert found
    assert all(mask[place.cell] for place in found)


def test_a_photo_of_something_else_gets_no_suggestion():
    room, _, _, result, _ = clustered(4)
    away = Rigid(rotation_from_rotvec((0, np.pi, 0)) @ result.camera_from_scanner.rotation, np.zeros(3))
    assert suggest_matches(room.scan, replace(result, camera_from_scanner=away)) == ()


def test_the_part_of_the_photo_is_named_as_an_operator_would():
    camera = Camera.from_focal(900, 600, 800.0)
    at = {(10, 10): "the upper left", (450, 300): "the middle", (880, 300): "the right", (450, 590): "the bottom",
          (450, 5): "the top", (880, 590): "the lower right", (10, 300): "the left"}  # fmt: skip
    assert {uv: part_of_photo(np.array(uv), camera) for uv in at} == at


def test_hostile_arguments_are_named():
    room, _, _, result, _ = clustered(4)
    for bad in ({"count": 0}, {"count": 1.5}, {"count": True}, {"apart": -0.1}, {"apart": np.nan}, {"apart": "1"}):
        with pytest.raises(OptionError, match=next(iter(bad))):
            suggest_matches(room.scan, result, **bad)
    with pytest.raises(ShapeError, match="mask"):
        suggest_matches(room.scan, result, pickable=np.ones((3, 3), dtype=np.bool_))
    with pytest.raises(ShapeError, match="covariance"):
        suggest_matches(room.scan, replace(result, covariance=np.full((6, 6), np.nan)))
    undetermined = replace(result, covariance=np.diag([1e13] * 6))
    assert all(np.isfinite([p.gain, *p.local_px, *p.median_px]).all() for p in suggest_matches(room.scan, undetermined))
    exact = suggest_matches(room.scan, replace(result, covariance=np.zeros((6, 6))))
    assert all(p.gain == pytest.approx(0, abs=1e-9) and p.summary() for p in exact)
