"""Textures of models as image files: JPEG, or PNG without loss where that is small."""

from __future__ import annotations

from typing import NamedTuple

import cv2

from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.encoded_image import encoded_image
from ladarreg_core.surface.mesh.model_part import TextureTile

JPEG_QUALITY = 92
"""Quality of textures in JPEG, without subsampling of the colours."""
_LARGEST_PNG_PX = 500_000
_PNG_COMPRESSION = 4


class TextureImage(NamedTuple):
    """A texture as the content of an image file."""

    data: bytes
    """The file."""
    media_type: str
    """`image/jpeg` or `image/png`."""
    extension: str
    """`jpg` or `png`."""


def extension_of(tile: TextureTile) -> str:
    """Return `png` for a tile of up to half a megapixel, otherwise `jpg`."""
    return "png" if tile.width * tile.height <= _LARGEST_PNG_PX else "jpg"


def image_of(tile: TextureTile) -> TextureImage:
    """Return a tile as an image of the format of `extension_of`."""
    if extension_of(tile) == "png":  # a small part of a model's file: time matters more than bytes
        return TextureImage(encoded_image(tile.pixels(), ".png"), "image/png", "png")
    return texture_image(tile.pixels(), lossless=False)


def texture_image(pixels: ByteArray, *, lossless: bool) -> TextureImage:
    """Return a texture (h, w, 3) RGB as PNG if it is to be `lossless`, otherwise as JPEG."""
    if lossless:
        extension, media_type, settings = "png", "image/png", [cv2.IMWRITE_PNG_COMPRESSION, _PNG_COMPRESSION]
    else:
        extension, media_type = "jpg", "image/jpeg"
        sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        settings = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, *sampling]
    return TextureImage(encoded_image(pixels, f".{extension}", settings), media_type, extension)
