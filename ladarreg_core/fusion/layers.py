"""Layers of a model: quantities of its cells with units and legends, on one scale for all its scans."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import OptionError
from ladarreg_core.export.layered_scan import LayerPicture, LayerValues
from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray
from ladarreg_core.foundations.palette import UNKNOWN, UNSEEN, Color, distinct_colors, paint, ramp_colors
from ladarreg_core.fusion.fused_model import FusedModel
from ladarreg_core.inspection.model_textures import Legend, ModelTexture
from ladarreg_core.surface.texture.best_photo import NO_PHOTO
from ladarreg_core.surface.texture.registered_texture import (
    RegisteredTexture,
    intensity_levels,
    intensity_rows,
    model_picture,
)

_SHARE_SHOWN = (1.0, 99.0)  # per cent
_RAMP = 17
_SAMPLED = 200_000
_FREEZING_K = 273.15
_MAX_IN_LEGEND = 24
_LONGEST_NAME = 20
_FIELDS_OF_POINTS = frozenset({
    "x", "y", "z", "red", "green", "blue", "nir", "label", "returns", "flags", "classification", "user_data",
    "scan_angle", "point_source_id", "gps_time", "intensity", "position", "rgb", "rgba", "normal", "indices",
})  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Quantity:
    """What the values of a sensor's pixels are.

    Raises:
        OptionError: if the name is not one of a field.
    """

    name: str
    """ASCII letters, digits and underscores, as in names of fields: `temperature`, `gamma`."""
    unit: str
    """`K`, `counts/s`; empty: a number."""

    def __post_init__(self) -> None:
        if not (self.name.isascii() and self.name.isidentifier() and len(self.name) <= _LONGEST_NAME):
            raise OptionError(
                f"the quantity is called {self.name!r:.60}; give a name of at most {_LONGEST_NAME} ASCII letters, "
                "digits and underscores, as files of points name their fields"
            )


TEMPERATURE = Quantity("temperature", "K")
"""What thermal photographs measure: apparent temperature, kelvin kept."""


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """A quantity, or colours, of all cells of a model."""

    name: str
    """Unique in the model; also the name of its field in files of points."""
    title: str
    """For people, with the unit."""
    unit: str
    """Unit of the values; empty of colours and numbers."""
    values: tuple[NDArray[np.generic], ...] | None
    """For each scan (H, W); NaN, or 0 of whole numbers, where there is none. None: colours only."""
    legend: Legend
    """What the colours of the pictures mean."""
    draw: Callable[[int], ByteArray]
    """Returns the picture (H, W, 3) uint8 RGB of a scan, by its index."""

    def texture(self, scan: int = 0) -> ModelTexture:
        """Return the picture of a scan with the legend."""
        return ModelTexture(self.draw(scan), self.legend)


def model_layers(
    models: Sequence[FusedModel], ids: Sequence[str] = (), quantities: Mapping[int, Quantity] | None = None
) -> list[Layer]:
    """Return the layers of a model: fused, intensity, visibility, sigma, resolution, photo id, quantities, photographs.

    Args:
        models: the scans of the model, coloured by the same photographs.
        ids: names of the photographs; missing ones have their files' names.
        quantities: what the values of photographs are, by the photographs' indices; thermal ones need none.

    Raises:
        OptionError: if photographs with one quantity's name have different units, or the name is that of a layer.
    """
    views = models[0].views
    names = [ids[k] if k < len(ids) else view.photo.name for k, view in enumerate(views)]
    layers = [
        Layer(
            "fused", "Fused colour of all photographs", "", None, _unseen_legend("Fused colour"),
            lambda k: model_picture(models[k].scan, models[k].colors.texture),
        ),
        _intensity(models),
        _count(models),
        _map(
            "sigma_px", "Standard deviation of the place in the photograph, px", "px",
            [one.colors.sigma_px for one in models], from_zero=True,
        ),
        _map(
            "resolution_mm", "Size of the photograph's pixels on the surface, mm", "mm",
            [one.resolution_mm for one in models],
        ),
        _photo_ids(models, names),
    ]  # fmt: skip
    found = {k: TEMPERATURE for k, view in enumerate(views) if view.photo.temperature_k is not None}
    found |= dict(quantities or {})
    for quantity in {one.name: one for one in found.values()}.values():
        users = [k for k, one in found.items() if one.name == quantity.name]
        if any(found[k].unit != quantity.unit for k in users):
            raise OptionError(f"{quantity.name} is given in different units; give all its photographs the same one")
        values = [_combined(one, users) for one in models]
        field = _field(quantity)
        if field in _FIELDS_OF_POINTS or any(field == layer.name for layer in layers):
            raise OptionError(f"files of points have a field {field} already; give the quantity another name")
        title = f"{quantity.name.replace('_', ' ').capitalize()}{f', {quantity.unit}' if quantity.unit else ''}"
        layers.append(_map(field, title, quantity.unit, values, kelvin=quantity.unit == "K"))
    for k, name in enumerate(names):
        layers.append(_photograph(models, k, name))
    return layers


def layer_values(layers: Sequence[Layer], scan: int) -> dict[str, LayerValues]:
    """Return what files of points get beside their own fields: the layers with values that these do not have."""
    own = {"intensity", "photo_id", "sigma_px"}
    return {
        one.name: LayerValues(one.values[scan], one.title)
        for one in layers
        if one.values is not None and one.name not in own
    }


def layer_pictures(layers: Sequence[Layer], scan: int) -> dict[str, LayerPicture]:
    """Return the layers as pictures for a textured model, by their titles; without the fused one, its own texture."""
    return {
        one.title: LayerPicture(lambda one=one: one.draw(scan), one.values is not None and one.name != "intensity")  # type: ignore[misc]
        for one in layers
        if one.name != "fused"
    }


def _field(quantity: Quantity) -> str:
    """Return the name of a quantity's field: letters, digits and underscores, with a unit that fits."""
    unit, name = quantity.unit.lower(), quantity.name.lower()
    return f"{name}_{unit}" if unit.isascii() and unit.isalnum() and len(unit) <= _LONGEST_NAME // 2 else name


def _combined(model: FusedModel, users: Sequence[int]) -> NDArray[np.float32]:
    """Return the values (H, W) of photographs of one quantity: in each cell that of the one with the most weight."""
    result = np.full(model.scan.shape, np.nan, np.float32)
    best = np.full(model.scan.shape, -np.inf, np.float32)
    for k in users:
        sample = model.samples[k]
        if sample.values is None:
            continue
        merit = sample.merit.astype(np.float32)
        better = (merit > best[sample.here]) & np.isfinite(sample.values)
        best[sample.here][better] = merit[better]
        result[sample.here][better] = sample.values[better]
    result[~model.scan.valid] = np.nan
    return result


def _intensity(models: Sequence[FusedModel]) -> Layer:
    levels = [intensity_levels(one.scan) for one in models]
    low, high = min(level[0] for level in levels), max(level[1] for level in levels)

    def draw(k: int) -> ByteArray:
        gray = intensity_rows(models[k].scan.intensity, (low, high))
        return np.repeat(gray[..., None], 3, axis=-1)

    ramp = tuple((int(v), int(v), int(v)) for v in np.linspace(18, 245, _RAMP))
    legend = Legend("Laser intensity", ramp=ramp, least=f"{low:.4g}", most=f"{high:.4g}")
    return Layer("intensity", "Laser intensity", "", tuple(one.scan.intensity for one in models), legend, draw)


def _count(models: Sequence[FusedModel]) -> Layer:
    most = max(1, *(int(one.seen_by.max()) for one in models))

    def draw(k: int) -> ByteArray:
        seen = models[k].seen_by
        picture = np.array(ramp_colors(seen.astype(np.float32) / np.float32(most)))
        paint(picture, seen == 0, UNKNOWN)
        return picture

    legend = Legend("Photographs that show the surface", ((UNKNOWN, "none"),), _viridis(), least="0", most=str(most))
    title = "Number of photographs that show it"
    return Layer("seen_by", title, "", tuple(one.seen_by for one in models), legend, draw)


def _map(
    name: str, title: str, unit: str, values: Sequence[FloatArray], *, from_zero: bool = False, kelvin: bool = False
) -> Layer:
    known = np.concatenate([_some(one) for one in values])
    low, high = (float(v) for v in np.percentile(known, _SHARE_SHOWN)) if known.size else (0.0, 1.0)
    low = 0.0 if from_zero else low
    span = max(high - low, 1e-6 * abs(high), 1e-9)

    def draw(k: int) -> ByteArray:
        there = np.isfinite(values[k])
        picture = np.array(ramp_colors((np.where(there, values[k], low) - np.float32(low)) / np.float32(span)))
        paint(picture, ~there, UNKNOWN)
        return picture

    def words(value: float) -> str:
        return f"{value:.2f} K ({value - _FREEZING_K:.2f} deg C)" if kelvin else f"{value:.3g} {unit}".strip()

    legend = Legend(title, ((UNKNOWN, "no data"),), _viridis(), least=words(low), most=words(high))
    return Layer(name, title, unit, tuple(np.asarray(one, np.float32) for one in values), legend, draw)


def _some(values: FloatArray) -> FloatArray:
    """Return known values (N,), of many every n-th."""
    known = values[np.isfinite(values)]
    return known[:: max(1, len(known) // _SAMPLED)]


def _photo_ids(models: Sequence[FusedModel], names: Sequence[str]) -> Layer:
    colors = np.concatenate([distinct_colors(len(names)), np.array([UNKNOWN], np.uint8)])
    coloring = models[0].coloring

    def draw(k: int) -> ByteArray:
        return np.asarray(colors[np.minimum(models[k].photo, len(names))], np.uint8)

    entries: list[tuple[Color, str]] = [
        ((int(colors[k][0]), int(colors[k][1]), int(colors[k][2])), f"{k + 1}: {names[k]}")
        for k in coloring[:_MAX_IN_LEGEND]
    ]
    if len(coloring) > _MAX_IN_LEGEND:
        entries.append((UNKNOWN, f"and {len(coloring) - _MAX_IN_LEGEND} more, see model.json"))
    legend = Legend("Photograph that colours the surface", (*entries, (UNKNOWN, "none")))
    ids = tuple(np.where(one.photo == NO_PHOTO, 0, one.photo + np.uint16(1)).astype(np.uint16) for one in models)
    return Layer("photo_id", "Photograph that colours it", "", ids, legend, draw)


def _photograph(models: Sequence[FusedModel], k: int, name: str) -> Layer:
    def draw(scan: int) -> ByteArray:
        model = models[scan]
        sample = model.samples[k]
        image = np.empty((*model.scan.shape, 3), np.uint8)
        image[:] = np.array(UNSEEN, np.uint8)
        shown: BoolArray = sample.colored
        table = np.clip(np.rint(model.gains.table(k)), 0, 255).astype(np.uint8)
        codes = np.stack([table[:, c][sample.color[..., c]] for c in range(3)], axis=-1)
        image[sample.here][shown] = codes[shown]
        labels = model.photo_labels(k)
        labels[sample.here] = np.where(model.scan.valid[sample.here], sample.labels, labels[sample.here])
        return model_picture(model.scan, RegisteredTexture(image, labels))

    return Layer(f"photo-{name}", f"Photograph {name}", "", None, _unseen_legend(f"Photograph {name}"), draw)


def _unseen_legend(title: str) -> Legend:
    return Legend(title, ((UNKNOWN, "not seen by the camera: laser intensity, dimmed"),))


def _viridis() -> tuple[Color, ...]:
    return tuple((int(r), int(g), int(b)) for r, g, b in ramp_colors(np.linspace(0, 1, _RAMP)))
