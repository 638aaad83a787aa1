"""The registered picture and its labels as PNG, on the scan's grid."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np

from ladarreg_core.arrays import ByteArray
from ladarreg_core.export.atomic_write import write_bytes
from ladarreg_core.surface.texture import Label, RegisteredTexture

LABEL_COLOURS = {
    Label.NO_RETURN: (15, 17, 21),
    Label.SEEN: (76, 195, 138),
    Label.OCCLUDED: (242, 111, 110),
    Label.OUT_OF_FRAME: (73, 88, 120),
    Label.GRAZING: (242, 184, 75),
    Label.UNCERTAIN: (201, 167, 255),
}
"""RGB in which each label is shown."""


def write_registered_png(path: str | Path, texture: RegisteredTexture) -> None:
    """Write the photograph on the scan's grid.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_png(path, texture.image)


def write_png(path: str | Path, picture: ByteArray) -> None:
    """Write a picture (H, W, 3), uint8 RGB, without loss.

    Raises:
        ExportError: if the file cannot be written.
    """
    done, encoded = cv2.imencode(".png", picture[..., ::-1])
    assert done, "an 8-bit picture can always be encoded"
    write_bytes(path, encoded.tobytes())


def write_labels_png(path: str | Path, texture: RegisteredTexture) -> None:
    """Write the labels as an indexed PNG: the pixel values are the codes, the palette makes them legible.

    Raises:
        ExportError: if the file cannot be written.
    """
    from PIL import Image

    palette = np.zeros((256, 3), dtype=np.uint8)
    for label, colour in LABEL_COLOURS.items():
        palette[label] = colour
    image = Image.fromarray(texture.labels)
    image.putpalette(palette.tobytes())
    stream = io.BytesIO()
    # Eight bits per pixel: a reader that ignores palettes then still finds one code a byte.
    image.save(stream, format="PNG", bits=8)
    write_bytes(path, stream.getvalue())
