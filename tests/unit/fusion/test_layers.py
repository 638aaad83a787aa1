"""Layers of a model: values with units, legends on one scale, and names that files of points can take."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.palette import UNKNOWN, ramp_colors
from ladarreg_core.frames import Rigid
from ladarreg_core.fusion.fused_model import FusedModel, Station, fuse_stations
from ladarreg_core.fusion.layers import Layer, Quantity, layer_pictures, layer_values, model_layers
from ladarreg_core.fusion.stations import doubled_cells, relative_pose, without_cells
from ladarreg_core.photo import thermal_photo
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.best_photo import NO_PHOTO, PosedPhoto
from testing.scenes.color_room import POSE, distances, photo_of, scan_of

CAMERA = Camera.from_focal(160, 120, 130.0)
COVARIANCE = np.diag([1e-7] * 3 + [1e-6] * 3)
KELVIN = np.linspace(290, 310, 160, dtype=np.float32)[None].repeat(120, axis=0)


def models(*values: np.ndarray | None, colorless: tuple[int, ...] = ()) -> list[FusedModel]:
    """A scan with a photograph and a thermal one from the same place."""
    views = [PosedPhoto(photo_of(CAMERA), POSE, CAMERA, COVARIANCE)]
    views.append(replace(views[0], photo=thermal_photo(KELVIN, CAMERA, name="warm")))
    return fuse_stations([Station(scan_of(90, 180), views)], values=values, colorless=colorless)


def named(layers: list[Layer]) -> dict[str, Layer]:
    assert len({one.name for one in layers}) == len(layers)
    return {one.name: one for one in layers}


def test_temperatures_stay_kelvin_and_have_a_legend_with_both_units() -> None:
    (model,) = found = models()
    layer = named(model_layers(found))["temperature_k"]
    assert layer.values is not None
    values = np.asarray(layer.values[0], np.float64)
    uv = CAMERA.project(POSE @ model.scan.points.astype(np.float64))
    there = np.isfinite(values)
    assert there.sum() > 500
    expected = 290 + 20 * uv[there][:, 0] / 159
    assert np.abs(values[there] - expected).max() < 0.3
    assert layer.unit == "K"
    assert "deg C" in layer.legend.least
    assert layer.legend.most.startswith("309")
    picture = layer.texture().image
    assert (picture[~there] == UNKNOWN).all()
    low, high = (float(v) for v in np.percentile(values[there], (1, 99)))
    expected_colors = ramp_colors(np.clip((values[there] - low) / (high - low), 0, 1)).astype(int)
    assert np.abs(picture[there].astype(int) - expected_colors).max() < 6
    assert set(np.unique(model.photo)) == {0, NO_PHOTO}, "the thermal photograph colours nothing"


def test_values_of_a_sensor_become_a_layer_with_its_unit() -> None:
    counts = np.where(np.arange(160) < 80, 5.0, 50.0).astype(np.float32)[None].repeat(120, axis=0)
    found = models(counts)
    layers = named(model_layers(found, ["a", "b"], {0: Quantity("gamma", "counts/s")}))
    layer = layers["gamma"]
    assert layer.title == "Gamma, counts/s"
    assert layer.values is not None
    values = np.asarray(layer.values[0])
    known = values[np.isfinite(values)]
    assert ((known == 5) | (known == 50)).mean() > 0.9
    assert set(layer_values(list(layers.values()), 0)) == {"seen_by", "resolution_mm", "temperature_k", "gamma"}
    pictures = layer_pictures(list(layers.values()), 0)
    assert pictures["Gamma, counts/s"].is_map
    assert not pictures["Photograph a"].is_map
    assert "Fused colour of all photographs" not in pictures
    for name, picture in pictures.items():
        assert picture.draw().shape == (*found[0].scan.shape, 3), name


def test_names_and_units_that_files_cannot_take_are_refused() -> None:
    for name in ("", "a b", "größe", "x" * 40, "1a"):
        with pytest.raises(OptionError, match="the quantity is called"):
            Quantity(name, "K")
    found = models(np.ones((120, 160), np.float32), np.ones((120, 160), np.float32))
    for taken in ("label", "x", "seen_by"):
        with pytest.raises(OptionError, match="already"):
            model_layers(found, (), {0: Quantity(taken, "")})
    with pytest.raises(OptionError, match="different units"):
        model_layers(found, (), {0: Quantity("dose", "uSv/h"), 1: Quantity("dose", "mSv/h")})


def test_of_two_scans_the_finer_one_is_kept_and_scales_are_shared() -> None:
    fine, coarse = scan_of(120, 240), scan_of(60, 120)
    away = Rigid(np.eye(3), np.array([0.3, 0.2, 0.0]))
    fine = replace(fine, world_from_scanner=Rigid.identity())
    ranges = distances(away.translation, coarse.geometry.rays)
    coarse = Scan(coarse.geometry, ranges, np.ones(ranges.shape), world_from_scanner=away)
    cut = doubled_cells([fine, coarse])
    assert cut[0].mean() < 0.05
    assert cut[1].sum() > 0.8 * coarse.valid.sum()
    views = [PosedPhoto(photo_of(CAMERA), POSE, CAMERA, COVARIANCE)]
    both = fuse_stations([Station(fine, views), Station(coarse, [relative_pose(views[0], away)])])
    shown = both[1].photo == 0
    there = coarse.points[shown].astype(np.float64)
    uv = CAMERA.project(POSE @ (away @ there))
    assert CAMERA.contains(uv).all()
    layer = named(model_layers(both))["resolution_mm"]
    assert layer.values is not None
    assert len(layer.values) == 2
    assert layer.draw(1).shape == (*coarse.shape, 3)
    left = without_cells(both[1], cut[1])
    assert left is not None
    assert int(left.scan.valid.sum()) == int(coarse.valid.sum() - cut[1].sum())
    assert without_cells(both[1], coarse.valid) is None
    with pytest.raises(OptionError, match="no pose in the world"):
        doubled_cells([fine, replace(coarse, world_from_scanner=None)])


def test_the_covariance_of_a_pose_turns_with_the_scanner() -> None:
    covariance = np.diag([1.0, 2, 3, 4, 5, 6])
    view = PosedPhoto(photo_of(CAMERA), POSE, CAMERA, covariance)
    turn = Rigid.from_rotvec([0, 0, np.pi / 2])
    moved = relative_pose(view, turn)
    np.testing.assert_allclose(np.diag(np.asarray(moved.covariance)), [1, 2, 3, 5, 4, 6], atol=1e-12)
    point = np.array([1.0, 0.3, 0.2])
    np.testing.assert_allclose(moved.camera_from_scanner @ point, view.camera_from_scanner @ (turn @ point))
