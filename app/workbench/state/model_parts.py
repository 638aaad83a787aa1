"""The parts of the 3-D model that the page fetches: meshes and textures, in three levels of detail."""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

import numpy as np

from ladarreg_core.errors import LadarregError, OptionError, ShapeError
from ladarreg_core.foundations.palette import as_css
from ladarreg_core.inspection.coarse_scan import CoarseScan
from ladarreg_core.inspection.model_textures import (
    ModelTexture,
    model_texture,
    registered_texture,
    small_picture,
    texture_choices,
    usable_texture,
)
from ladarreg_core.inspection.scene_geometry import picture_sheet
from ladarreg_core.inspection.viewpoints import typical_range

from ...gateway.protocol import Picture
from ...scene.model_view import DETAILS, LAYERS
from ...session.loader import Loader
from ...session.session import Session

if TYPE_CHECKING:
    from ladarreg_core.foundations.arrays import ByteArray
    from ladarreg_core.fusion.fused_model import FusedModel
    from ladarreg_core.inspection.model_textures import Legend
    from ladarreg_core.photo import Photo
    from ladarreg_core.project.document import Document, PhotoEntry, PoseEntry
    from ladarreg_core.results.registration import PoseResult
    from ladarreg_core.scan import Scan
    from ladarreg_core.surface.mesh.grid_block import GridBlock
    from ladarreg_core.surface.mesh.grid_mesh import Mesh
    from ladarreg_core.surface.texture.best_photo import PosedPhoto, ShownPart
    from ladarreg_core.surface.texture.registered_texture import RegisteredTexture

    from ...session.photo_header import PhotoHeader
    from ...slices.project import ModelOfPhoto, Sheet, TextureOption


NO_PHOTO = "none"
"""Stands for the id of a photograph where there is none."""
LEGEND_HEADER = "x-legend"
_OF_CODES = ("label", "photo_id")
"""Textures whose colours are codes, which a lossy format would blur."""
_NEED_VISIBILITY = ("resolution", "label")
_SHEET_DECIMALS = 4
"""Of the corners of a photograph's sheet, m."""
_LOSSY_QUALITY = 84
_PHOTO_QUALITY = 90
MAX_VERTICES = 400_000
"""Most vertices that a page shows of the model at once."""
BLOCK_VERTICES = 37_500
"""Most vertices of a block of the mesh; the page shows at most four, so that there are 400,000 with the dense mesh."""
_MAX_COLORED_CELLS = 100_000_000
"""Most cells, counted once for each photograph, that are coloured by all photographs together."""
_MAX_PHOTO_BYTES, _BYTES_PER_PIXEL = 700_000_000, 3
"""Photographs that are fused to a layer are in memory together, at most so many bytes; else each is reduced."""
_LONGEST_BLOCK = 20
_FACES_PER_VERTEX = 4  # of a photo layer; a surface has two before it is divided


class Detail(NamedTuple):
    """A level of detail."""

    vertices: int
    """Largest number of vertices of the mesh."""
    texture_px: int
    """Longer side of the texture."""
    photo_px: int
    """Longer side of the photograph that is drawn over the texture; 0: none is drawn."""


LEVELS = dict(
    zip(DETAILS, (Detail(12_000, 768, 0), Detail(60_000, 2048, 4096), Detail(250_000, 8192, 8192)), strict=True)
)


class _Seen(NamedTuple):
    """A photograph with an accepted pose."""

    pose: PoseEntry
    entry: PhotoEntry
    result: PoseResult
    header: PhotoHeader


class ModelParts:
    """Makes the parts of the model once; they depend on scan, photograph and pose, not on who looks at them."""

    def __init__(self, session: Session, loader: Loader) -> None:
        self._session, self._loader = session, loader

    def part(self, name: str, query: Mapping[str, str]) -> Picture:
        """Return a part.

        Args:
            name: `mesh`, `texture`, `layer` or `photo`.
            query: `detail`, or of a mesh `block`; of all but a mesh `photo`; of a texture `kind` and `z_buffer`; see
                docs/workbench.md.

        Raises:
            LadarregError: if there is no such part, or it needs an accepted pose.
        """
        document = self._loader.seen_from_scan(self._session.document)
        scan = self._loader.scan(document)
        if scan is None:
            raise OptionError("there is no scan; open one")
        detail = query.get("detail", DETAILS[1])
        if detail not in LEVELS:
            raise OptionError(f"there is no detail {detail[:20]!r}; it is one of {', '.join(LEVELS)}")
        if name == "mesh" and "block" in query:
            block = _block_of(query["block"])
            return self._loader.cached("model", ("mesh", document.scan, block), lambda: _block_part(scan, block))
        if name == "mesh":
            return self._loader.cached(
                "model", ("mesh", document.scan, detail), lambda: _mesh_part(scan, LEVELS[detail].vertices)
            )
        if name == "texture":
            return self._texture_part(document, scan, query, LEVELS[detail].texture_px)
        if name in ("layer", "photo"):
            return self._photo_part(document, scan, name, query, LEVELS[detail])
        raise OptionError(f"the model has no part {name[:20]!r}")

    def slice(self, document: Document, entry: PhotoEntry | None) -> ModelOfPhoto:
        """Return the slice `textures`: the kinds of texture, and a text that changes with scan, photograph or pose."""
        document = self._loader.seen_from_scan(document)
        entry = None if entry is None else document.photo(entry.id)
        result = self._result(entry)
        made_of: list[object] = [document.scan]
        for one in [*([] if entry is None else [entry]), *_accepted(document)]:
            pose = one.pose
            made_of += [one.source, one.camera]
            made_of += [] if pose is None else [pose.camera_from_scanner, pose.camera, pose.covariance, pose.accepted]
        choices: list[TextureOption] = [
            {"value": choice.kind, "label": choice.label, "usable": choice.usable, "said": choice.description}
            for choice in texture_choices(_accepted_only(result))
        ]
        others = [one for one in _accepted(document) if one is not entry]
        if others and choices[0]["value"] == "colour":
            choices[0]["usable"] = True
            choices[0]["said"] = "each place in the colours of the photograph that shows it best"
        choices += self._layer_choices(document)
        rev = hashlib.sha256(repr(made_of).encode()).hexdigest()[:12]
        accepted = result if result is not None and result.accepted else None
        sheet = None if accepted is None or entry is None else self._sheet(document, entry, accepted)
        return {"rev": rev, "accepted": accepted is not None, "choices": choices, "sheet": sheet}

    def _sheet(self, document: Document, entry: PhotoEntry, result: PoseResult) -> Sheet | None:
        """Return the sheet that shows the photograph to who looks from its camera; None without a scan."""
        try:
            scan = self._loader.scan(document)
        except LadarregError:  # its file has gone, which the slice `scan` states
            return None
        if scan is None:
            return None

        def made() -> Sheet:
            distance = typical_range(scan)
            net = picture_sheet(result.camera, result.camera_from_scanner, distance_m=distance)
            corners = net.round(_SHEET_DECIMALS).reshape(-1, 3)
            return {
                "photo": entry.id,
                "centre": result.camera_from_scanner.centre.tolist(),
                "distance": distance,
                "columns": net.shape[1],
                "corners": [corner if np.isfinite(corner).all() else None for corner in corners.tolist()],
            }

        assert entry.pose is not None, "it has a result"
        key = (document.scan, entry.id, entry.pose.camera_from_scanner, repr(entry.pose.camera))
        return self._loader.cached("sheet", key, made)

    def _layer_choices(self, document: Document) -> list[TextureOption]:
        """Return the textures made of all accepted photographs, as entries of `choices`."""
        results = {entry.id: self._result(entry) for entry in _accepted(document)}
        accepted = [
            entry for entry in _accepted(document)
            if (result := results[entry.id]) is not None and _accepted_only(result) is result
        ]  # fmt: skip
        lacks = dict.fromkeys(LAYERS, "" if accepted else "needs an accepted photograph; register one")
        if not any(self._is_thermal(entry) for entry in accepted):
            lacks["temperature_k"] = "needs an accepted thermal photograph"
        return [
            {"value": name, "label": label, "usable": not lacks[name], "said": lacks[name] or said}
            for name, (label, said) in LAYERS.items()
        ]

    def _is_thermal(self, entry: PhotoEntry) -> bool:
        try:
            return self._loader.header(entry).is_thermal
        except LadarregError:  # its file has gone, which the slice `photos` states
            return False

    def _result(self, entry: PhotoEntry | None) -> PoseResult | None:
        if entry is None or entry.pose is None:
            return None
        try:
            return self._loader.registration(entry.pose)
        except LadarregError:  # its matches are missing, which the verdict of its stage states
            return None

    def _texture_part(self, document: Document, scan: Scan, query: Mapping[str, str], longest_px: int) -> Picture:
        name = query.get("photo", NO_PHOTO)
        entry = None if name == NO_PHOTO else document.photo(name)
        if entry is None and name != NO_PHOTO:
            raise OptionError("there is no such photograph")
        result, kind, z_buffer = self._result(entry), query.get("kind", "intensity"), query.get("z_buffer") != "0"
        others = entry is not None and any(one is not entry for one in _accepted(document))
        if kind in LAYERS:
            return self._layer_of_all(document, scan, kind, longest_px)
        if kind == "colour" and z_buffer and others:
            return self._colors_of_all(document, scan, longest_px)
        if usable_texture(kind, _accepted_only(result)) != kind:
            raise OptionError(f"the texture {kind!r} needs an accepted pose")
        of_scan = kind in ("intensity", "range")
        pose = None if of_scan or entry is None else entry.pose
        photo = None if of_scan or entry is None else self._loader.photo(entry)
        key = (kind, z_buffer or kind != "colour", longest_px, document.scan, id(pose), id(photo))
        make = partial(self._make_texture, document, scan, kind, photo, None if of_scan else result, z_buffer=z_buffer)
        return self._loader.cached(
            "model", key, lambda: ((pose, photo), _picture_of(make(), longest_px, lossless=kind in _OF_CODES))
        )[1]

    def _layer_of_all(self, document: Document, scan: Scan, kind: str, longest_px: int) -> Picture:
        """Return a layer of the model that all accepted photographs are fused to."""
        from ladarreg_core.fusion.fused_model import fuse
        from ladarreg_core.fusion.layers import model_layers

        seen_by = self._seen_by(document, kind)
        total = sum(_BYTES_PER_PIXEL * one.header.width * one.header.height for one in seen_by)
        factor = max(1, math.ceil(math.sqrt(total / _MAX_PHOTO_BYTES)))
        shown = CoarseScan.of(scan, longest_px, most_cells=_MAX_COLORED_CELLS / len(seen_by))
        key = (document.scan, shown.stride, factor, *(_key_of(one) for one in seen_by))

        def make() -> tuple[object, Picture]:
            def fused() -> tuple[object, FusedModel]:
                views = [self._posed(one) if factor == 1 else self._posed(one).reduced(factor) for one in seen_by]
                return seen_by, fuse(shown.scan, views)

            model = self._loader.cached("fused", (id(scan), key), fused)[1]
            every = model_layers([model], [one.entry.source.name for one in seen_by])
            layer = next((one for one in every if one.name == kind), None)
            if layer is None:
                raise OptionError(f"the texture {kind!r} needs a thermal photograph with an accepted pose")
            return seen_by, _picture_of(layer.texture(), longest_px, lossless=kind in _OF_CODES, shown=shown)

        return self._loader.cached("model", ("layer of all", kind, longest_px, key), make)[1]

    def _colors_of_all(self, document: Document, scan: Scan, longest_px: int) -> Picture:
        """Return the colours of all accepted photographs: of each place, from the one that shows it best."""
        from ladarreg_core.surface.texture.best_photo import best_of

        seen_by = self._seen_by(document, "colour")
        shown = CoarseScan.of(scan, longest_px, most_cells=_MAX_COLORED_CELLS / len(seen_by))
        key = (document.scan, shown.stride, *(_key_of(one) for one in seen_by))

        def make() -> tuple[object, Picture]:
            found = best_of(shown.scan, (self._shown_by(one, document, shown) for one in seen_by)).texture
            texture = model_texture(shown.scan, "colour", result=seen_by[0].result, registered=found)
            return seen_by, _picture_of(texture, longest_px, lossless=False, shown=shown)

        return self._loader.cached("model", ("colors of all", longest_px, key), make)[1]

    def _shown_by(self, one: _Seen, document: Document, shown: CoarseScan) -> Sequence[ShownPart]:
        """Return what a photograph shows of the scan; it is kept, so that with one more only that one is projected."""
        from ladarreg_core.surface.texture.best_photo import shown_parts

        def made() -> tuple[object, list[ShownPart]]:
            return one, [part.compact() for part in shown_parts(shown.scan, self._posed(one))]

        try:
            return self._loader.cached("shown by", (document.scan, shown.stride, _key_of(one)), made)[1]
        except LadarregError:  # its file has gone just now
            return ()

    def _posed(self, one: _Seen) -> PosedPhoto:
        from ladarreg_core.surface.texture.best_photo import PosedPhoto

        result = one.result
        return PosedPhoto(
            self._loader.photo(one.entry), result.camera_from_scanner, result.camera, result.joint_covariance
        )

    def _seen_by(self, document: Document, kind: str) -> list[_Seen]:
        """Return the accepted photographs whose files are there.

        Raises:
            OptionError: if there is none.
        """
        seen_by: list[_Seen] = []
        for entry in _accepted(document):
            result = self._result(entry)
            if entry.pose is None or result is None or _accepted_only(result) is not result:
                continue
            if not self._loader.is_there(entry):  # which the slice `photos` states
                continue
            try:
                seen_by.append(_Seen(entry.pose, entry, result, self._loader.header(entry)))
            except LadarregError:  # likewise
                continue
        if not seen_by:
            raise OptionError(f"the texture {kind!r} needs an accepted pose")
        return seen_by

    def _photo_part(
        self, document: Document, scan: Scan, name: str, query: Mapping[str, str], level: Detail
    ) -> Picture:
        entry = document.photo(query.get("photo", NO_PHOTO))
        result = _accepted_only(self._result(entry))
        if entry is None or result is None or not result.accepted:
            raise OptionError("the photograph is drawn on the model only with an accepted pose")
        if not level.photo_px:
            raise OptionError("the photograph is not drawn on the coarse model")
        pose, photo = entry.pose, self._loader.photo(entry)
        if name == "photo":
            return self._loader.cached(
                "model", ("photo", level.photo_px, id(photo)), lambda: (photo, _photo_picture(photo, level.photo_px))
            )[1]

        def layer() -> tuple[object, Picture]:
            labels = self._registered(document, scan, photo, result).labels
            return (pose, photo), _layer_part(scan, photo, result, labels, level)

        return self._loader.cached("model", ("layer", level.vertices, document.scan, id(pose), id(photo)), layer)[1]

    def _make_texture(
        self, document: Document, scan: Scan, kind: str, photo: Photo | None, result: PoseResult | None, *,
        z_buffer: bool,
    ) -> ModelTexture:  # fmt: skip
        registered = None
        if photo is not None and result is not None and (kind in _NEED_VISIBILITY or (kind == "colour" and z_buffer)):
            registered = self._registered(document, scan, photo, result)
        return model_texture(scan, kind, photo=photo, result=result, z_buffer=z_buffer, registered=registered)

    def _registered(self, document: Document, scan: Scan, photo: Photo, result: PoseResult) -> RegisteredTexture:
        key = ("registered", document.scan, id(result), id(photo))
        return self._loader.cached("model", key, lambda: ((result, photo), registered_texture(scan, photo, result)))[1]


def _key_of(one: _Seen) -> tuple[object, ...]:
    """Return what identifies the picture of a photograph and its pose."""
    return id(one.pose), one.entry.source, one.entry.camera


def _accepted(document: Document) -> list[PhotoEntry]:
    """Return the photographs whose poses are accepted, in their order."""
    return [entry for entry in document.photos if entry.pose is not None and entry.pose.accepted]


def _accepted_only(result: PoseResult | None) -> PoseResult | None:
    """Return a result that the model may show; a given pose would need its mark there, and counts as refused."""
    return result if result is None or not result.mark else replace(result, evidence="none")


def legend_entries(legend: Legend) -> dict[str, Any]:
    """Return a legend with its colours as CSS."""
    return {
        **asdict(legend),
        "entries": [{"colour": as_css(color), "label": label} for color, label in legend.entries],
        "ramp": [as_css(color) for color in legend.ramp],
    }


def _mesh_part(scan: Scan, most_vertices: int) -> Picture:
    from ladarreg_core.export.models.packed_mesh import packed_mesh

    return _packed(packed_mesh(surface_or_facets(scan, most_vertices)))


def _block_of(text: str) -> GridBlock:
    from ladarreg_core.surface.mesh.grid_block import GridBlock

    try:
        level, row, column = (int(number) for number in text[:_LONGEST_BLOCK].split("."))
    except ValueError:
        raise OptionError(f"a block of the mesh is LEVEL.ROW.COLUMN, not {text[:_LONGEST_BLOCK]!r}") from None
    return GridBlock(level, row, column)


def _block_part(scan: Scan, block: GridBlock) -> Picture:
    """Return the surface of a block; without data if it has none."""
    from ladarreg_core.export.models.packed_mesh import packed_mesh
    from ladarreg_core.surface.mesh.grid_block import block_mesh

    try:
        mesh = block_mesh(scan, block, max_vertices=BLOCK_VERTICES)
    except ShapeError:  # no returns at all
        return _packed(b"")
    return _packed(packed_mesh(mesh) if len(mesh.faces) else b"")


def _layer_part(scan: Scan, photo: Photo, result: PoseResult, labels: ByteArray, level: Detail) -> Picture:
    """Return the mesh that the photograph is drawn on; without data if it would show no more than the texture does."""
    from ladarreg_core.export.models.packed_mesh import packed_mesh
    from ladarreg_core.surface.texture.photo_layer import photo_layer, shows_more_detail
    from ladarreg_core.surface.texture.photo_model import ModelPhoto

    if not shows_more_detail(scan, result.camera, photo_px=level.photo_px, texture_px=level.texture_px):
        return _packed(b"")
    seen_by = ModelPhoto(photo.pixels, result.camera, result.camera_from_scanner, labels)
    vertices = level.vertices
    while True:
        mesh = surface_or_facets(scan, vertices)
        layer = photo_layer(scan, mesh, seen_by, shown_px=level.photo_px, most_faces=_FACES_PER_VERTEX * vertices)
        if len(layer.vertices) <= MAX_VERTICES - level.vertices or vertices <= LEVELS[DETAILS[0]].vertices:
            break
        vertices //= 2  # a photograph of all that surrounds it is seen by the whole surface
    return _packed(packed_mesh(layer) if len(layer.faces) else b"")


def _packed(data: bytes) -> Picture:
    return Picture(data, "application/octet-stream", hashlib.sha256(data).hexdigest()[:16])


def _photo_picture(photo: Photo, longest_px: int) -> Picture:
    from PIL import Image

    buffer = io.BytesIO()
    pixels = small_picture(photo.pixels, longest_px)
    Image.fromarray(pixels).save(buffer, "WEBP", quality=_PHOTO_QUALITY, method=2)
    data = buffer.getvalue()
    return Picture(data, "image/webp", hashlib.sha256(data).hexdigest()[:16])


def surface_or_facets(scan: Scan, most_vertices: int) -> Mesh:
    """Return the surface of a scan; if it has none, its points as small triangles."""
    from ladarreg_core.surface.mesh.facets import point_facets
    from ladarreg_core.surface.mesh.grid_mesh import scan_mesh

    mesh = scan_mesh(scan, max_vertices=most_vertices, closed=True)
    return mesh if len(mesh.faces) else point_facets(scan, max_vertices=most_vertices)


def _picture_of(texture: ModelTexture, longest_px: int, *, lossless: bool, shown: CoarseScan | None = None) -> Picture:
    """Return a texture as a picture of the scan's whole grid; its cells are those of `shown`, or of the whole grid."""
    from PIL import Image

    buffer = io.BytesIO()
    fitted = small_picture if shown is None else shown.picture
    image = Image.fromarray(fitted(texture.image, longest_px, codes=lossless))
    image.save(buffer, "WEBP", lossless=lossless, quality=_LOSSY_QUALITY, method=3)
    data = buffer.getvalue()
    header = quote(json.dumps(legend_entries(texture.legend), separators=(",", ":")))
    return Picture(data, "image/webp", hashlib.sha256(data).hexdigest()[:16], {LEGEND_HEADER: header})
