"""One model from many photographs: gains, moved things, seams and provenance against a room that is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.errors import Cancelled, OptionError, ShapeError
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.frames import Rigid
from ladarreg_core.fusion.fused_model import FusedModel, fuse
from ladarreg_core.fusion.samples import OtherSurface
from ladarreg_core.photo import thermal_photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import SphericalGrid
from ladarreg_core.surface.texture.best_photo import NO_PHOTO, best_photo
from ladarreg_core.surface.texture.registered_texture import Label, texture_scan
from testing.scenes.color_room import photo_of, registered, scan_of
from testing.scenes.kept import kept
from testing.scenes.photo_tour import PhotoTour, light_error, photo_tour

SMALL = {"cells": (150, 210), "size": (240, 168)}


def tour(seed: int = 0, *, photos: int = 9, moved: int = 0) -> PhotoTour:
    return photo_tour(seed, photos=photos, moved=moved, **SMALL)  # type: ignore[arg-type]


@kept
def fused(seed: int = 0, photos: int = 9, moved: int = 0) -> FusedModel:
    one = tour(seed, photos=photos, moved=moved)
    return fuse(one.scan, one.views)


@pytest.mark.slow
@pytest.mark.parametrize("powers", [(0.0, 0.0), (-0.35, -0.3), (-0.1, -0.6)])
def test_dark_corners_are_found_from_what_photographs_share_and_undone(powers: tuple[float, float]) -> None:
    one = photo_tour(3, photos=9, vignetting=powers, **SMALL)  # type: ignore[arg-type]
    model, as_it_is = fuse(one.scan, one.views, vignetting=True), fuse(one.scan, one.views)
    at = np.array([[0.25, 0.25**2], [0.5, 0.25], [1.0, 1.0]])  # r^2 and r^4
    np.testing.assert_allclose(np.exp(model.vignetting @ at.T), np.tile(np.exp(at @ powers), (9, 1)), rtol=0.02)
    assert not as_it_is.vignetting.any()
    cells = (model.labels == Label.SEEN) & np.isfinite(one.truth[..., 0])
    error = light_error(model.image, one.truth, cells)
    if any(powers):
        assert error < 0.4 * light_error(as_it_is.image, one.truth, cells)
        bright = model.developed(0).pixels.astype(float).mean(axis=-1)
        dark = as_it_is.developed(0).pixels.astype(float).mean(axis=-1)
        ratio = bright / np.maximum(dark, 1)
        assert ratio[:6, :6].mean() > 1.1 * ratio[80:88, 116:124].mean(), "the photograph itself is brighter there"
    else:
        assert error < 1.05 * light_error(as_it_is.image, one.truth, cells)
    np.testing.assert_allclose(model.gains.gains, one.gains, rtol=0.02)


def test_a_photograph_that_shares_nothing_keeps_its_corners() -> None:
    one = tour()
    alone = fuse(one.scan, one.views[:1], vignetting=True)
    assert not alone.vignetting.any()
    assert alone.views[0].photo.pixels is one.views[0].photo.pixels


def last_writer(model: FusedModel) -> tuple[np.ndarray, np.ndarray]:
    """The photograph and the colour of each cell if later photographs overwrite earlier ones."""
    photo = np.full(model.scan.shape, NO_PHOTO, np.uint16)
    image = np.zeros((*model.scan.shape, 3), np.uint8)
    for k, sample in enumerate(model.samples):
        photo[sample.here][sample.colored] = k
        image[sample.here][sample.colored] = sample.color[sample.colored]
    return photo, image


def test_one_photograph_gives_its_texture() -> None:
    one = tour()
    view = one.views[0]
    model = fuse(one.scan, [view])
    alone = texture_scan(one.scan, view.photo, view.camera_from_scanner, covariance=view.covariance)
    np.testing.assert_array_equal(model.image, alone.image)
    np.testing.assert_array_equal(model.labels, alone.labels)
    assert (model.photo[alone.colored] == 0).all()
    assert (model.photo[~alone.colored] == NO_PHOTO).all()
    assert model.gains.gains.tolist() == [[1, 1, 1]]
    assert model.developed(0) is view.photo


@pytest.mark.parametrize("seed", range(3))
def test_gains_are_recovered(seed: int) -> None:
    one, model = tour(seed), fused(seed)
    error = np.log(model.gains.gains / one.gains)
    assert np.abs(error).max() < 0.03, "of exposures that differ by 20 % and white balances that differ by 10 %"
    assert np.abs(np.log(model.gains.gains).mean(axis=0)).max() < 1e-6
    assert model.gains.sigma.max() < 0.02


def test_photographs_that_share_nothing_keep_their_exposures() -> None:
    scan, camera = scan_of(), Camera.from_focal(160, 120, 200.0)
    ahead, behind = (
        registered(photo_of(camera, pose), pose, name=name)
        for name, pose in (("a", registered(photo_of(camera)).camera_from_scanner),
                           ("b", registered(photo_of(camera)).camera_from_scanner @ Rigid.from_rotvec([0, 0, np.pi])))
    )  # fmt: skip
    model = fuse(RegisteredScan(scan, [ahead, behind]))
    assert model.gains.gains.tolist() == [[1, 1, 1], [1, 1, 1]]
    assert np.isinf(model.gains.sigma).all()
    assert model.shares.min() > 0.02


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_moved_things_are_voted_out(seed: int) -> None:
    one, model = tour(seed, photos=14, moved=4), fused(seed, 14, 4)
    seen, ghosts = np.zeros(model.scan.shape, int), np.zeros(model.scan.shape, int)
    for k, sample in enumerate(model.samples):
        alone = np.full(model.scan.shape, NO_PHOTO, np.uint16)
        alone[sample.here][sample.labels == Label.SEEN] = k
        seen += alone == k
        ghosts += one.shows_moved(alone)
    decided = (seen >= 3) & (2 * ghosts < seen)
    last, _ = last_writer(model)
    single = best_photo(one.scan, one.views).photo
    found = [int((one.shows_moved(photo) & decided).sum()) for photo in (last, single, model.photo)]
    assert min(found[:2]) > 500, "there is something to vote out"
    assert found[2] <= 0.1 * found[0], found
    assert found[2] <= 0.3 * found[1], found
    assert one.shows_moved(model.photo).sum() < one.shows_moved(last).sum()


def test_nothing_is_voted_out_by_less_than_three() -> None:
    model = fused(0, 2, 4)
    assert not any(sample.moved.any() for sample in model.samples)


@pytest.mark.parametrize("seed", range(2))
def test_colors_are_nearer_to_the_truth_than_those_of_single_photographs(seed: int) -> None:
    one, model = tour(seed), fused(seed)
    cells = (model.photo != NO_PHOTO) & (model.labels == Label.SEEN) & np.isfinite(one.truth[..., 0])
    single = best_photo(one.scan, one.views)
    _, last = last_writer(model)
    errors = [light_error(image, one.truth, cells) for image in (model.image, single.image, last)]
    assert errors[0] < 2.5, "codes"
    assert errors[0] < 0.5 * min(errors[1:]), errors


def test_regions_are_coherent_and_provenance_is_that_of_the_cell() -> None:
    one, model = tour(), fused()
    single = best_photo(one.scan, one.views)

    def borders(photo: np.ndarray) -> int:
        return int((photo[:, 1:] != photo[:, :-1]).sum() + (photo[1:] != photo[:-1]).sum())

    assert borders(model.photo) < 0.8 * borders(single.photo)
    for k, sample in enumerate(model.samples):
        own = model.photo[sample.here] == k
        assert sample.colored[own].all()
        np.testing.assert_array_equal(model.labels[sample.here][own], sample.labels[own])
        assert np.isfinite(model.colors.sigma_px[sample.here][own]).all()
    shown = model.photo != NO_PHOTO
    assert (model.seen_by[shown & (model.labels == Label.SEEN)] >= 1).mean() > 0.99
    assert np.isfinite(model.resolution_mm[shown]).all()
    assert np.isnan(model.resolution_mm[~shown]).all()
    assert model.shares.sum() == pytest.approx(shown[one.scan.valid].mean())


def test_away_from_seams_a_cell_has_the_very_color_of_its_photograph() -> None:
    one, model = tour(), fused()
    from scipy.ndimage import minimum_filter

    for k, sample in enumerate(model.samples):
        own = model.photo == k
        inner = minimum_filter(own, size=7)[sample.here]
        if inner.any():
            expected = model.gains.table(k)
            codes = np.stack([expected[:, c][sample.color[inner][:, c]] for c in range(3)], axis=-1)
            np.testing.assert_allclose(model.image[sample.here][inner], np.clip(codes, 0, 255), atol=0.51)
    assert one.scan is model.scan


def test_the_order_of_the_photographs_changes_next_to_nothing() -> None:
    one, model = tour(), fused()
    back = fuse(one.scan, one.views[::-1])
    np.testing.assert_allclose(back.gains.gains[::-1], model.gains.gains, rtol=1e-6)
    assert (np.abs(back.image.astype(int) - model.image).max(axis=-1) <= 2).mean() > 0.99


def test_only_accepted_photographs_color() -> None:
    scan, camera = scan_of(), Camera.from_focal(160, 120, 120.0)
    accepted, given = registered(photo_of(camera), name="one"), registered(photo_of(camera), name="two", given=True)
    model = fuse(RegisteredScan(scan, [given, accepted]))
    assert len(model.views) == 1
    with pytest.raises(OptionError, match="no photograph is accepted"):
        fuse(RegisteredScan(scan, [given]))


def test_another_station_hides_cells_from_a_camera() -> None:
    one = tour()
    camera_at = one.views[0].camera_from_scanner.centre
    cloud = np.where(one.scan.valid[..., None], one.scan.points, np.nan)
    middle = np.nanmedian(cloud.reshape(-1, 3), axis=0)
    # For a station at the camera, something stands on the way to the middle of the scene.
    grid = SphericalGrid(180, 360, np.radians(1), np.radians(1), -np.pi, np.pi / 2)
    toward = (middle - camera_at) / np.linalg.norm(middle - camera_at)
    near = grid.rays @ toward > np.cos(np.radians(6))
    other = Scan(grid, np.where(near, 0.5, np.nan), np.ones(grid.shape))
    hidden = fuse(one.scan, one.views[:1], others=[OtherSurface(other, Rigid(np.eye(3), -camera_at))])
    free = fuse(one.scan, one.views[:1])
    gone = (free.photo == 0) & (hidden.photo == NO_PHOTO)
    assert gone.sum() > 200
    assert (hidden.labels[gone] == Label.OCCLUDED).mean() > 0.9
    rays = (cloud - camera_at)[gone]
    cosine = rays @ toward / np.linalg.norm(rays, axis=-1)
    assert cosine.min() > np.cos(np.radians(12))
    rays = (cloud - camera_at)[free.photo == 0]
    behind = rays @ toward / np.linalg.norm(rays, axis=-1) > np.cos(np.radians(5))
    assert behind.sum() > 200
    assert (hidden.photo[free.photo == 0][behind] == NO_PHOTO).mean() > 0.98


def test_thermal_photographs_do_not_color_beside_others() -> None:
    one = tour()
    view = one.views[0]
    kelvin = np.full(view.photo.pixels.shape[:2], 295.0, np.float32)
    kelvin[:, : kelvin.shape[1] // 2] = 310
    warm = replace(view, photo=thermal_photo(kelvin, view.camera))
    model = fuse(one.scan, [warm, *one.views[1:3]])
    assert model.coloring == (1, 2)
    assert 0 not in model.photo
    values = model.samples[0].values
    assert values is not None
    known = values[model.samples[0].colored]
    assert 294.9 < known.min() < 296
    assert 309 < known.max() < 310.1
    only = fuse(one.scan, [warm])
    assert (only.photo == 0).any()


def test_values_must_be_of_the_photograph() -> None:
    one = tour()
    with pytest.raises(ShapeError, match="values have 3 x 2 pixels"):
        fuse(one.scan, one.views[:1], values=[np.zeros((2, 3), np.float32)])
    with pytest.raises(ShapeError, match="0 photographs"):
        fuse(one.scan, [])


def test_progress_rises_and_can_stop() -> None:
    one, seen = tour(), []

    def stop(progress: Progress) -> None:
        seen.append(progress)
        if progress.label == "fusing: seams":
            raise Cancelled

    with pytest.raises(Cancelled):
        fuse(one.scan, one.views[:3], report=stop)
    shares = [one.done / one.total for one in seen]
    assert shares == sorted(shares)
    assert shares[-1] > 0.7
