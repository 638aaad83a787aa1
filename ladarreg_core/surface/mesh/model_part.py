"""Parts of a textured model: triangles with the rectangle of a picture that they use."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray, IntArray

LARGEST_TILE_PX = 8192
"""Longer side of the largest texture: what nearly every graphics card takes."""
_GUTTER_PX = 2
_MIN_USED = 0.3  # of a texture; one that is used less is divided
_MIN_DIVIDED_PX = 1024


@dataclass(frozen=True, slots=True, eq=False)
class TextureTile:
    """A rectangle of a picture."""

    picture: ByteArray
    """(h, w, 3) uint8 RGB or (h, w) uint8 gray: a photograph, or the laser intensity on the scan's grid."""
    left: int
    """Its first column; may be negative, or `left + width` beyond the picture, in a panorama that wraps."""
    top: int
    """Its first row."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""

    def pixels(self, longest_px: int = LARGEST_TILE_PX) -> NDArray[np.uint8]:
        """Return the pixels (h, w, 3) RGB, reduced to a longer side of at most `longest_px`."""
        columns = np.arange(self.left, self.left + self.width) % self.picture.shape[1]
        wraps = columns[0] + self.width > self.picture.shape[1]
        across = columns if wraps else slice(int(columns[0]), int(columns[0]) + self.width)
        part = np.asarray(self.picture[self.top : self.top + self.height, across])
        if max(self.width, self.height) > longest_px:
            factor = longest_px / max(self.width, self.height)
            size = max(1, round(self.width * factor)), max(1, round(self.height * factor))
            part = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), np.uint8)
        return part if part.ndim == 3 else np.repeat(part[..., None], 3, axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class ModelPart:
    """Triangles with one texture; they face the scanner (counter-clockwise as seen from it)."""

    vertices: FloatArray
    """(N, 3) float32, scanner frame, m."""
    normals: FloatArray
    """(N, 3) float32, unit, toward the scanner."""
    pixels: FloatArray
    """(N, 2) float64: (u, v) in the tile's picture, (0, 0) the centre of its first pixel; u may lie beyond the picture
    in a panorama that wraps."""
    faces: IntArray
    """(F, 3) int32, indices of vertices."""
    photo: int | None
    """Index of the photograph; None: laser intensity."""
    tile: TextureTile
    """The rectangle of the picture that the triangles use."""
    grid_uv: FloatArray | None = None
    """(N, 2) float32: texture coordinates on a picture of the scan's whole grid, as `uv`; None: not known."""

    @property
    def uv(self) -> NDArray[np.float32]:
        """(N, 2) texture coordinates on the tile, u right, v down, (0, 0) its outer top-left corner, as in glTF."""
        corner, size = (self.tile.left, self.tile.top), (self.tile.width, self.tile.height)
        return np.asarray((self.pixels + (0.5 - np.array(corner))) / np.array(size), dtype=np.float32)

    def subset(self, wanted: BoolArray) -> ModelPart:
        """Return the part of some triangles, (F,) bool, with the rectangle of the picture that they use.

        Shared borders keep their exact coordinates, so that parts divided in any way meet without cracks.
        """
        faces = self.faces[wanted]
        used = np.zeros(len(self.vertices), np.bool_)
        used[faces] = True
        index = np.cumsum(used, dtype=np.int32) - np.int32(1)
        pixels = self.pixels[used]
        return replace(
            self,
            vertices=self.vertices[used],
            normals=self.normals[used],
            pixels=pixels,
            faces=index[faces],
            tile=_tile_of(self.tile.picture, pixels),
            grid_uv=None if self.grid_uv is None else self.grid_uv[used],
        )

    def divided(self, largest_px: int = LARGEST_TILE_PX) -> list[ModelPart]:
        """Return parts whose textures are at most `largest_px` long; also a part is divided that uses little of its
        texture, so that less is stored. Triangles larger than that keep a texture of their own, reduced when written.
        """
        done: list[ModelPart] = []
        waiting = [self]
        while waiting:
            part = waiting.pop()
            tile = part.tile
            longest = max(tile.width, tile.height)
            if len(part.faces) > 1 and (longest > largest_px or part._wastes_texture):
                corners = part.pixels[part.faces]
                axis = int(tile.height > tile.width)
                middle = corners[..., axis].mean(axis=1)
                border = (tile.left + tile.width / 2, tile.top + tile.height / 2)[axis]
                before = middle < border
                if not before.all() and before.any():
                    waiting += [part.subset(~before), part.subset(before)]
                    continue
            done.append(part)
        return done

    @property
    def _wastes_texture(self) -> bool:
        if max(self.tile.width, self.tile.height) <= _MIN_DIVIDED_PX:
            return False
        a, b, c = (self.pixels[self.faces[:, k]] for k in range(3))
        areas = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
        return float(areas.sum()) < _MIN_USED * self.tile.width * self.tile.height


def model_part(
    vertices: FloatArray,
    normals: FloatArray,
    pixels: FloatArray,
    faces: IntArray,
    *,
    picture: ByteArray,
    photo: int | None,
    grid_uv: FloatArray | None = None,
) -> ModelPart:
    """Return the part of triangles with their whole rectangle of a picture; the arguments are those of `ModelPart`."""
    return ModelPart(vertices, normals, pixels, faces, photo, _tile_of(picture, pixels), grid_uv)


def _tile_of(picture: ByteArray, pixels: FloatArray) -> TextureTile:
    """Return the rectangle of pixels (N, 2), with a gutter; positions are beyond a picture only where it wraps."""
    height, width = picture.shape[:2]
    low = np.floor(pixels.min(axis=0)).astype(int) - _GUTTER_PX
    high = np.ceil(pixels.max(axis=0)).astype(int) + _GUTTER_PX
    top, bottom = max(int(low[1]), 0), min(int(high[1]), height - 1)
    wraps = pixels[:, 0].min() < -0.5 or pixels[:, 0].max() > width - 0.5
    left, right = int(low[0]), int(high[0])
    if not wraps:
        left, right = max(left, 0), min(right, width - 1)
    return TextureTile(picture, left, top, right - left + 1, bottom - top + 1)
