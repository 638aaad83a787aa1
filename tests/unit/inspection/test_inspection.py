"""Inspection: pictures of the scan, overlays, predicted counterparts, corners, residuals of picks."""

from __future__ import annotations

import dataclasses
import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError, OptionError, ShapeError
from ladarreg_core.frames import Rigid
from ladarreg_core.inspection.corners import nearest_corner
from ladarreg_core.inspection.figures import figures, parameters, pose_at_scanner
from ladarreg_core.inspection.model_textures import texture_without_z_buffer
from ladarreg_core.inspection.picks import (
    PickMeasurements,
    PickPredictor,
    pick_points,
    pick_residuals,
    probe,
    sample_line,
)
from ladarreg_core.inspection.pictures import (
    Stretch,
    compensated,
    inspection_views,
    photo_over_scan,
    resolution_note,
    scan_over_photo,
    scan_picture,
)
from ladarreg_core.matches import Matches, Pick
from ladarreg_core.picks.measure import matches_from_picks
from ladarreg_core.pose.estimate import solve_pose
from ladarreg_core.pose.result import describe_pose
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation, SphericalGrid
from ladarreg_core.simulate import SimulatedCase
from ladarreg_core.surface.texture.registered_texture import Label, texture_scan
from testing.scenes.simulated import simulated


def the_case() -> SimulatedCase:
    return simulated("desk", seed=3)


def wall(turns: float = 1.0, columns: int = 120) -> Scan:
    """A cylinder of 3 m radius, so many times 60 degrees wide."""
    geometry = AzimuthElevation(40, columns, np.deg2rad(60 * turns) / columns, 0.01)
    return Scan(geometry, np.full((40, columns), 3.0), np.random.default_rng(0).random((40, columns)))


@pytest.mark.slow
@pytest.mark.parametrize("show", ["intensity", "range", "shape", "normals", "edges"])
def test_pictures_have_the_views_size_and_hide_what_has_no_return(show: str) -> None:
    view = inspection_views(the_case().scan)[0].view
    picture = scan_picture(view, show)
    assert picture.shape == (view.camera.height, view.camera.width, 3)
    empty = ~np.isfinite(view.ranges)
    assert len(np.unique(picture[empty].reshape(-1, 3), axis=0)) <= 1
    assert picture[~empty].std() > 10, "there is something to see"


def test_stretch_is_monotone_and_reaches_both_ends() -> None:
    view = inspection_views(wall())[0].view
    for stretch in (Stretch(), Stretch(equalise=True), Stretch(low=0, high=100, gamma=1)):
        gray = scan_picture(view, "raw", stretch)[..., 0].astype(int)
        seen = np.isfinite(view.ranges)
        order = np.argsort(view.intensity[seen])
        assert (np.diff(gray[seen][order]) >= 0).all()
        assert gray[seen].max() == 255


def test_intensity_is_compensated_for_range() -> None:
    """One paint on a floor: the same gray near and far, though a hundredth of the light comes back."""
    geometry = AzimuthElevation(120, 100, 0.004, 0.004, elevation_offset_rad=-0.35)
    ranges = np.clip(-1.5 / np.minimum(geometry.rays[..., 2], -1e-6), 0, 16)
    scan = Scan(geometry, ranges, 100 / ranges**2)
    view = inspection_views(scan)[0].view
    near_and_far = compensated(view)[np.isfinite(view.ranges)]
    assert np.percentile(near_and_far, 95) < 1.1 * np.percentile(near_and_far, 5)


@pytest.mark.parametrize("wrong", [{"low": 50, "high": 50}, {"gamma": 0}, {"low": -1}, {"gamma": float("nan")}])
def test_an_invalid_stretch_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(OptionError):
        Stretch(**wrong)  # type: ignore[arg-type]


def test_an_unknown_rendering_is_refused() -> None:
    view = inspection_views(wall())[0].view
    with pytest.raises(OptionError, match="one of intensity"):
        scan_picture(view, "smell")
    with pytest.raises(ShapeError, match="no colour"):
        scan_picture(view, "color")


def test_a_narrow_scan_has_one_view_and_a_wide_one_several_that_cover_it() -> None:
    assert len(inspection_views(wall())) == 1
    scan = wall(2.8, 420)
    views = inspection_views(scan)
    assert len(views) > 1
    labels = [named.label for named in views if named.label]
    assert 1 < len(set(labels)) == len(labels)
    rays = scan.rays[scan.valid]
    seen = np.zeros(len(rays), np.bool_)
    for named in views[: len(labels)]:
        seen |= named.view.camera.contains(named.view.project(rays))
    assert seen.all()


@pytest.mark.parametrize("lowest_deg", [-89, -60, -20])
def test_all_around_every_direction_is_near_the_middle_of_a_view(lowest_deg: float) -> None:
    step = np.deg2rad(2.0)
    rows = round((89 - lowest_deg) / 2)
    geometry = SphericalGrid(rows, 180, step, step, 0.0, np.deg2rad(89.0))
    scan = Scan(geometry, np.full((rows, 180), 3.0), np.ones((rows, 180)))
    views = inspection_views(scan)
    axes = np.array([named.view_from_scanner.rotation[2] for named in views])
    labelled = np.array([bool(named.label) for named in views])
    assert labelled[: labelled.sum()].all()  # those in between are behind
    farthest = [
        np.rad2deg(np.arccos(np.clip((scan.rays @ some.T).max(axis=-1).min(), -1, 1)))
        for some in (axes, axes[labelled])
    ]
    assert farthest[0] < 32
    assert farthest[1] > 40
    for named in views:  # upright
        assert abs(named.view_from_scanner.rotation[0, 2]) < 1e-6


@pytest.mark.parametrize("turned_deg", [0, 100, 250])
def test_views_all_around_begin_where_most_is_to_be_seen_and_go_on_to_the_right(turned_deg: float) -> None:
    step = np.deg2rad(2.0)
    geometry = SphericalGrid(40, 180, step, step, 0.0, 20 * step)
    ranges = np.full((40, 180), 3.0)
    azimuth = np.arctan2(geometry.rays[..., 1], geometry.rays[..., 0])
    empty = np.cos(azimuth - np.deg2rad(turned_deg)) < 0.2
    ranges[empty] = np.where(geometry.rays[empty][:, 2] < -0.3, 3.0, np.nan)  # only the floor is seen there
    views = [named.view for named in inspection_views(Scan(geometry, ranges, np.ones((40, 180)))) if named.label]
    ahead = [np.degrees(np.arctan2(*view.view_from_scanner.rotation[2, 1::-1])) for view in views]
    assert abs((ahead[0] - turned_deg + 180) % 360 - 180) < 60
    assert all(0 < (a - b) % 360 < 120 for a, b in itertools.pairwise(ahead))


@pytest.mark.parametrize("turned_deg", [0, 70])
def test_views_of_a_sector_begin_in_its_middle(turned_deg: float) -> None:
    step = np.deg2rad(1.0)
    geometry = SphericalGrid(40, 150, step, step, np.deg2rad(turned_deg + 75), 20 * step)
    scan = Scan(geometry, np.full((40, 150), 3.0), np.ones((40, 150)))
    views = inspection_views(scan)
    assert len(views) > 1
    away = [np.degrees(np.arccos(view.view_from_scanner.rotation[2] @ scan.mean_direction)) for view in views]
    assert away[0] < 35
    assert away[0] == pytest.approx(min(deg for deg, view in zip(away, views, strict=True) if view.label))


def test_views_have_no_more_pixels_than_the_scan_resolves() -> None:
    usual = wall()
    assert resolution_note(usual, inspection_views(usual)) is None
    rng = np.random.default_rng(0)
    seen = 0
    for _ in range(60):
        rows, columns = rng.integers(2, 60, 2).tolist()
        steps = (np.minimum(10 ** rng.uniform(-7, -1, 2), 3.0 / np.array([rows, columns]))).tolist()
        geometry = SphericalGrid(rows, columns, steps[1], steps[0], float(rng.uniform(-3, 3)), steps[0] * rows / 2)
        scan = Scan(geometry, np.full((rows, columns), 3.0), np.ones((rows, columns)))
        try:
            views = inspection_views(scan)
        except DegenerateGeometryError:
            continue
        seen += 1
        for named in views:
            width, height = named.view.camera.size
            assert width * height <= max(16 * rows * columns, 9)
            assert scan_picture(named.view, "intensity").shape == (height, width, 3)
    assert seen > 10
    note = resolution_note(fine := wall_of_unlike_steps(), inspection_views(fine))
    assert note is not None
    assert "one pixel per" in note


def wall_of_unlike_steps() -> Scan:
    geometry = AzimuthElevation(600, 30, 0.02, 5e-4)
    return Scan(geometry, np.full((600, 30), 3.0), np.ones((600, 30)))


# overlays


@pytest.mark.slow
def test_an_overlay_agrees_with_the_photo() -> None:
    c = the_case()
    overlay = scan_over_photo(c.scan, c.true_camera, c.camera_from_scanner, "intensity")
    assert overlay.shape == (c.true_camera.height, c.true_camera.width, 4)
    covered = overlay[..., 3] > 0
    assert 0.5 < covered.mean() < 1
    inside = cv2.erode(covered.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    photo, drawn = (edges(p) for p in (c.photo.pixels.mean(axis=-1), overlay[..., 0]))
    agree = [np.corrcoef(np.roll(drawn, shift, axis=1)[inside], photo[inside])[0, 1] for shift in (0, -12, 12)]
    assert agree[0] > 0.15
    assert agree[0] > max(agree[1:]) + 0.1


def edges(gray: np.ndarray) -> np.ndarray:
    values = gray.astype(np.float32)
    return np.hypot(cv2.Sobel(values, cv2.CV_32F, 1, 0), cv2.Sobel(values, cv2.CV_32F, 0, 1))


def test_edges_are_transparent_but_for_lines() -> None:
    c = the_case()
    alpha = scan_over_photo(c.scan, c.true_camera, c.camera_from_scanner, "edges")[..., 3]
    assert 0.005 < (alpha > 128).mean() < 0.25
    with pytest.raises(OptionError):
        scan_over_photo(c.scan, c.true_camera, c.camera_from_scanner, "sound")


def test_without_the_z_buffer_occluded_cells_are_colored() -> None:
    c = the_case()
    honest = texture_scan(c.scan, c.photo, c.camera_from_scanner)
    pose = describe_pose(
        c.camera_from_scanner, Matches.none(), np.zeros(0, np.bool_),
        c.true_camera, sigma_px=1, sigma_range_m=0.01, covariance=np.eye(6),
    )  # fmt: skip
    through = texture_without_z_buffer(c.scan, c.photo, pose)
    hidden = honest.labels == Label.OCCLUDED
    assert hidden.sum() > 1000
    assert through.colored[hidden].all()
    assert not honest.colored[hidden].any()
    view = inspection_views(c.scan)[0].view
    alpha = [photo_over_scan(view, texture)[..., 3] for texture in (honest, through)]
    assert (alpha[0] > 0).sum() < (alpha[1] > 0).sum()


# predictor


def test_predicted_counterparts_lead_back_to_their_picks() -> None:
    c = the_case()
    predictor = PickPredictor(c.scan, c.true_camera, c.camera_from_scanner)
    rng = np.random.default_rng(1)
    uv = rng.uniform((5, 5), (c.true_camera.width - 6, c.true_camera.height - 6), (300, 2))
    rays = predictor.on_scan(uv)
    known = np.isfinite(rays[:, 0])
    assert known.mean() > 0.5
    back = predictor.in_photo(rays[known])
    off = np.linalg.norm(back - uv[known], axis=1)
    assert np.nanmedian(off) < 0.1
    assert np.nanpercentile(off, 80) < 1.0, "the rest lies at depth edges"


def test_no_counterpart_is_predicted_without_a_surface() -> None:
    c = the_case()
    predictor = PickPredictor(c.scan, c.true_camera, c.camera_from_scanner)
    assert np.isnan(predictor.on_scan([[-50.0, 10.0], [np.nan, 3.0]])).all()
    assert np.isnan(predictor.in_photo([[-1.0, 0, 0]])).all()


def test_a_probe_reads_the_cell_along_the_ray() -> None:
    scan = the_case().scan
    row, column = np.argwhere(scan.valid)[12345]
    found = probe(scan, scan.rays[row, column])
    assert found.cell == pytest.approx((row, column), abs=0.01)
    assert found.intensity == pytest.approx(float(scan.intensity[row, column]))
    if found.range_m is not None:
        assert found.range_m == pytest.approx(float(scan.ranges[row, column]), rel=0.04)
    assert probe(scan, [-1, 0, 0]).cell is None


def test_a_probe_beside_a_depth_edge_tells_both_surfaces() -> None:
    """A wall behind a board: the board's range is the nearer one, on its side; on the wall alone there is no edge."""
    scan = the_case().scan
    ranges = np.full_like(scan.ranges, 4.0)
    rows, columns = ranges.shape
    ranges[:, columns // 2 :] = 2.5
    scan = dataclasses.replace(scan, ranges=ranges)
    row = rows // 2
    found = probe(scan, scan.rays[row, columns // 2 - 1]).edge
    assert found is not None
    assert (found.near_m, found.far_m) == (2.5, 4.0)
    column = [scan.geometry.cell_of(ray[None])[0][1] for ray in (found.near_ray, found.far_ray)]
    assert column[0] > columns // 2 - 1 > column[1] - 1e-6
    assert probe(scan, scan.rays[row, columns // 4]).edge is None


# snapping


@settings(max_examples=30, deadline=None)
@given(u=st.floats(20, 60), v=st.floats(20, 60), du=st.floats(-4, 4), dv=st.floats(-4, 4))
def test_a_click_beside_a_corner_finds_it(u: float, v: float, du: float, dv: float) -> None:
    fine = 8
    y, x = np.mgrid[: 80 * fine, : 80 * fine]
    board = (((x + 0.5) / fine - 0.5 < u) == ((y + 0.5) / fine - 0.5 < v)).astype(np.float32) * 200 + 20
    gray = board.reshape(80, fine, 80, fine).mean(axis=(1, 3))
    found = nearest_corner(gray, (u + du, v + dv))
    assert found is not None
    assert found == pytest.approx((u, v), abs=0.35)


def test_a_uniform_surface_and_pixels_outside_have_no_corner() -> None:
    assert nearest_corner(np.full((60, 60), 90, np.float32), (30, 30)) is None
    assert nearest_corner(np.zeros((60, 60), np.float32), (-3, 30)) is None
    assert nearest_corner(np.zeros((60, 60), np.float32), (float("nan"), 30)) is None


# residuals picks


def picks_of(c: SimulatedCase, count: int, seed: int, noise_px: float) -> list[Pick]:
    """Picks on points of the scan that the camera sees, with noise."""
    rng = np.random.default_rng(seed)
    label = texture_scan(c.scan, c.photo, c.camera_from_scanner).labels
    cells = np.argwhere(label == Label.SEEN)
    cells = cells[rng.choice(len(cells), count, replace=False)]
    rays = c.scan.rays[cells[:, 0], cells[:, 1]]
    points = rays * c.scan.ranges[cells[:, 0], cells[:, 1], None]
    uv = c.true_camera.project(c.camera_from_scanner @ points) + rng.normal(0, noise_px, (count, 2))
    return [Pick(f"m{k}", "point", ray[None], at[None]) for k, (ray, at) in enumerate(zip(rays, uv, strict=True))]


def test_every_pick_has_residuals_whether_on_or_off() -> None:
    c = the_case()
    picks = picks_of(c, 40, 0, 0.3)
    wrong = Pick("wrong", "point", picks[0].scan, picks[0].photo + 60, on=False)
    measured = PickMeasurements(c.scan, c.photo)
    result = solve_pose(matches_from_picks(c.scan, picks, camera=c.photo.camera)[0], c.photo.camera)
    residuals = pick_residuals(measured, [*picks, wrong], result)
    assert residuals["wrong"].px == pytest.approx(60 * 2**0.5, abs=5)
    assert residuals["wrong"].inlier is None
    inside = [residuals[pick.id] for pick in picks if pick.id in residuals]
    assert len(inside) > 30
    assert np.median([j.px for j in inside]) < 1.5
    assert all(j.photo.shape == (1, 2) for j in inside)
    by_id = {name: k for k, name in enumerate(result.matches.pick_ids)}
    for pick in picks:
        if pick.id in by_id:
            expected = np.linalg.norm(result.residuals_px[by_id[pick.id]])
            assert residuals[pick.id].px == pytest.approx(expected, rel=1e-6, abs=1e-9)
    # a second request returns the same, from the cache
    assert pick_residuals(measured, [*picks, wrong], result)["wrong"].px == residuals["wrong"].px


def test_a_sampled_line_marks_the_samples_with_a_range() -> None:
    geometry = AzimuthElevation(60, 80, 0.01, 0.01)
    ranges = 3 / geometry.rays[..., 0]
    ranges[:, 40:50] = np.nan
    scan = Scan(geometry, ranges, np.ones((60, 80)))
    line = sample_line(scan, geometry.ray_at(np.array([[30.0, 5], [30, 75]])), samples=15)
    cells = geometry.cell_of(line.rays)
    known = np.array(line.known)
    assert not known[(cells[:, 1] > 40) & (cells[:, 1] < 49)].any()
    assert known[(cells[:, 1] < 39) | (cells[:, 1] > 50)].all()
    assert line.used > 0
    assert line.used < line.sampled


def test_pick_points_lie_at_their_measured_ranges() -> None:
    c = the_case()
    picks = picks_of(c, 20, 5, 0)
    points, ids, on = pick_points(c.scan, picks)
    assert points.shape == (20, 3)
    assert ids == [pick.id for pick in picks]
    assert all(on)
    known = np.isfinite(points[:, 0])
    aside = np.cross(points[known], np.concatenate([pick.scan for pick in picks])[known])
    assert np.abs(aside).max() < 1e-9
    assert pick_points(c.scan, [])[0].shape == (0, 3)


def test_parameters_are_rounded_to_their_significant_digits() -> None:
    c = the_case()
    result = solve_pose(matches_from_picks(c.scan, picks_of(c, 60, 2, 0.5), camera=c.photo.camera)[0], c.photo.camera)
    found = {p.name: p for p in parameters(result)}
    assert list(found) == ["Tx", "Ty", "Tz", "alpha", "beta", "gamma"]
    assert float(found["Tx"].value) == pytest.approx(result.thesis_parameters.Tx, abs=float(found["Tx"].sigma))
    for parameter in found.values():
        assert len(parameter.sigma.split(".")[-1]) == len(parameter.value.split(".")[-1])
    count, agree = len(result.matches), int(result.inliers.sum())
    assert (figures(result).matches, figures(result).inliers) == (count, agree)
    ids = tuple(str(k // 2) for k in range(count // 2 * 2)) + ("last",) * (count % 2)
    lines = dataclasses.replace(result, matches=dataclasses.replace(result.matches, pick_ids=ids))
    both = sum(result.inliers[np.array(ids) == name].all() for name in set(ids))
    assert (figures(lines).matches, figures(lines).inliers) == (len(set(ids)), both), "a line counts once"
    assert 0 < figures(result).median_px <= figures(result).rms_px * 1.2
    assert pose_at_scanner(c.scan).centre == pytest.approx(np.zeros(3))


def test_a_photo_that_sees_nothing_of_the_scan_has_an_empty_overlay() -> None:
    camera = Camera.from_focal(64, 48, 60)
    away = Rigid(np.diag([-1.0, 1.0, -1.0]) @ pose_at_scanner(wall()).rotation, np.zeros(3))
    overlay = scan_over_photo(wall(), camera, away, "intensity")
    assert not overlay[..., 3].any()
