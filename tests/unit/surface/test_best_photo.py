"""Colours from several photographs, of cells and of points that are no cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.camera import Camera, EquirectangularCamera
from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.texture import registered_texture as texture
from ladarreg_core.surface.texture.best_photo import (
    NO_PHOTO,
    PointColorer,
    PosedPhoto,
    best_of,
    best_photo,
    shown_parts,
)
from ladarreg_core.surface.texture.registered_texture import Label, texture_scan

COVARIANCE = np.diag([1e-8] * 3 + [1e-8] * 3)


def room() -> Scan:
    """A wall at 4 m with a box before it."""
    geometry = AzimuthElevation(90, 120, 0.01, 0.01)
    ranges = 4.0 / geometry.rays[..., 0]
    ranges[35:55, 50:70] = 2.5 / geometry.rays[35:55, 50:70, 0]
    ranges[5:8, 5:9] = np.nan
    return Scan(geometry, ranges, np.ones(geometry.shape))


def view(
    color: tuple[int, int, int], centre: tuple[float, float, float], focal_px: float, size: int = 200
) -> PosedPhoto:
    camera = Camera(size, size, focal_px, focal_px, (size - 1) / 2, (size - 1) / 2)
    pixels = np.broadcast_to(np.array(color, np.uint8), (size, size, 3))
    return PosedPhoto(Photo(pixels, camera), Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, centre), camera, COVARIANCE)


RED, BLUE = (200, 10, 10), (10, 10, 200)


def test_one_photograph_gives_its_texture() -> None:
    scan, one = room(), view(RED, (0.1, 0.3, 0), 300)
    found = best_photo(scan, [one])
    alone = texture_scan(scan, one.photo, one.camera_from_scanner, covariance=COVARIANCE)
    np.testing.assert_array_equal(found.image, alone.image)
    np.testing.assert_array_equal(found.labels, alone.labels)
    np.testing.assert_array_equal(found.photo == 0, alone.colored)
    assert np.isfinite(found.sigma_px[alone.colored]).all()
    assert np.isnan(found.sigma_px[~alone.colored]).all()


def test_the_finer_photograph_colors_what_both_see_and_each_what_it_sees_alone() -> None:
    scan = room()
    coarse, fine = view(RED, (0, 0.5, 0), 100), view(BLUE, (0, -0.5, 0), 400)
    found = best_photo(scan, [coarse, fine])
    seen = [texture_scan(scan, one.photo, one.camera_from_scanner).labels == Label.SEEN for one in (coarse, fine)]
    assert (seen[0] & seen[1]).sum() > 500
    assert (found.photo[seen[0] & seen[1]] == 1).all()
    assert (found.photo[seen[0] & ~seen[1]] == 0).all(), "seen comes before uncertain and hidden"
    assert (found.image[found.photo == 1] == BLUE).all()
    assert found.photo[6, 6] == NO_PHOTO
    assert found.labels[6, 6] == Label.NO_RETURN
    swapped = best_photo(scan, [fine, coarse])
    np.testing.assert_array_equal(swapped.image, found.image)


def test_of_equal_resolutions_the_more_certain_pose_is_used() -> None:
    scan, one = room(), view(RED, (0, 0.1, 0), 200)
    doubtful = PosedPhoto(view(BLUE, (0, 0, 0), 200).photo, one.camera_from_scanner, one.camera, COVARIANCE * 9)
    found = best_photo(scan, [doubtful, one])
    assert set(np.unique(found.photo)) == {1, NO_PHOTO}


def test_cells_that_none_shows_say_whether_they_are_hidden() -> None:
    scan = room()
    left, away = view(RED, (0, 1.2, 0), 150), view(BLUE, (6, 0, 0), 150)
    found = best_photo(scan, [left, away])
    hidden = texture_scan(scan, left.photo, left.camera_from_scanner).labels == Label.OCCLUDED
    assert hidden.sum() > 20
    assert (found.labels[hidden] == Label.OCCLUDED).all()
    assert (found.photo[hidden] == NO_PHOTO).all()


@pytest.mark.parametrize("wide", [False, True])
def test_points_beside_the_cells_have_the_color_of_their_own_place(wide: bool) -> None:
    scan = room()
    size = (800, 400) if wide else (400, 400)
    camera = EquirectangularCamera(*size) if wide else Camera(400, 400, 150.0, 150.0, 199.5, 199.5)
    v, u = np.mgrid[: size[1], : size[0]]
    pixels = np.stack([u % 256, v % 256, (u // 256) * 60], axis=-1).astype(np.uint8)
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0, 0.4, 0))
    one = PosedPhoto(Photo(pixels, camera), pose, camera, COVARIANCE)
    colorer = PointColorer(scan, [one], best_photo(scan, [one]))
    rng = np.random.default_rng(3)
    wall = np.stack([np.full(300, 4.0), rng.uniform(-1.3, -0.8, 300), rng.uniform(-0.8, 0.8, 300)], axis=1)
    beside_box = np.abs(scan.geometry.cell_of(wall)[:, 1] - 60) > 14
    found = colorer.colors_of(wall[beside_box])
    assert (found.labels == Label.SEEN).all()
    uv = camera.project(pose @ wall[beside_box])
    inner = (uv % 256 > 2).all(axis=1) & (uv % 256 < 253).all(axis=1)
    off = np.abs(found.color[:, :2].astype(float) - uv % 256).max(axis=1)[inner]
    assert off.max() <= 0.6, "bilinear, to the rounding"
    shifted = np.abs(found.color[:, :2].astype(float) - (uv + 1.2) % 256).max(axis=1)[inner]
    assert shifted.min() > 0.6, "more than a pixel off would be noticed"
    assert np.isfinite(found.sigma_px).all()


def test_a_point_behind_the_box_is_hidden_and_one_in_free_space_is_shown() -> None:
    scan, one = room(), view(RED, (0, 0.0, 0), 150)
    colorer = PointColorer(scan, [one], best_photo(scan, [one]))
    points = np.array([[3.6, 0.0, 0.0], [2.0, 0.0, 0.0], [np.nan, 0, 0], [-1.0, 0, 0], [3.0, -0.9, 0.4]])
    done: list[int] = []
    found = colorer.colors_of(points, report=done.append)
    assert found.labels.tolist() == [
        Label.OCCLUDED, Label.UNCERTAIN, Label.NO_RETURN, Label.OUT_OF_FRAME, Label.UNCERTAIN,
    ]  # fmt: skip
    assert found.photo.tolist() == [NO_PHOTO, 0, NO_PHOTO, NO_PHOTO, 0]
    assert found.color[1].tolist() == list(RED)
    assert done == [5]


def test_large_scans_are_colored_alike_by_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    scan = room()
    views = [view(RED, (0, 0.5, 0), 100), view(BLUE, (0, -0.5, 0), 300)]
    whole = best_photo(scan, views)
    monkeypatch.setattr(texture, "LARGEST_WHOLE_SCAN", 2000)
    reported: list[Progress] = []
    tiled = best_photo(room(), views, report=reported.append)
    assert [one.done for one in reported] == sorted(one.done for one in reported)
    assert [one.done for one in reported].count(1) >= 2, "before each photograph, and after each of its parts"
    assert (whole.photo == tiled.photo).mean() > 0.995
    assert (whole.labels == tiled.labels).mean() > 0.99


@pytest.mark.parametrize("tiled", [False, True])
def test_what_was_kept_of_each_photograph_colors_as_all_together(tiled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if tiled:
        monkeypatch.setattr(texture, "LARGEST_WHOLE_SCAN", 2000)
    scan = room()
    views = [view(RED, (0, 0.5, 0), 100), view(BLUE, (0, -0.5, 0), 400), view(RED, (6, 0, 0), 150)]
    kept = [[part.compact() for part in shown_parts(scan, one)] for one in views]
    assert sum(part.labels.size for part in kept[1]) < 0.7 * scan.ranges.size, "only what is in the picture"
    assert not any(part.labels.size for part in kept[2])
    found, whole = best_of(scan, kept), best_photo(scan, views)
    for name in ("image", "labels", "photo", "sigma_px"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))


@pytest.mark.parametrize("thermal", [False, True])
def test_a_reduced_photograph_shows_the_same(thermal: bool) -> None:
    scan, one = room(), view(RED, (0.1, 0.3, 0), 300, size=303)
    ramp = np.broadcast_to(np.linspace(0, 255, 303), (303, 303))
    pixels = np.repeat(ramp[..., None], 3, axis=-1).astype(np.uint8)
    photo = Photo(pixels, one.camera, temperature_k=(280 + ramp / 10).astype(np.float32) if thermal else None)
    uncertain = CameraUncertainty(("focal_px",), np.diag([1e-8] * 6 + [4.0]), {"focal_px": 300.0})
    whole = PosedPhoto(photo, one.camera_from_scanner, one.camera, uncertain)
    small = whole.reduced(3)
    assert small.photo.camera.size == small.camera.size == (101, 101)
    assert isinstance(small.covariance, np.ndarray)
    assert small.covariance.shape == (6, 6)
    assert (small.photo.temperature_k is not None) == thermal
    if small.photo.temperature_k is not None:
        np.testing.assert_allclose(small.photo.temperature_k, 280 + small.photo.pixels[..., 0] / 10, atol=0.1)
    found, expected = best_photo(scan, [small]), best_photo(scan, [replace(whole, covariance=COVARIANCE)])
    seen = (found.labels == Label.SEEN) & (expected.labels == Label.SEEN)
    assert seen.sum() > 0.9 * (expected.labels == Label.SEEN).sum()
    assert np.abs(found.image[seen].astype(int) - expected.image[seen]).max() <= 3


def test_without_a_photograph_nothing_is_colored() -> None:
    scan = room()
    found = best_photo(scan, [])
    assert (found.photo == NO_PHOTO).all()
    assert (found.labels == np.where(scan.valid, Label.OUT_OF_FRAME, Label.NO_RETURN)).all()
