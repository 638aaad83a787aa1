"""PNG files on the scan's grid: the registered photograph, its labels and its uncertainty, with their legends."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.export.pictures.layout import beside, padded, stacked, text_block
from ladarreg_core.export.pictures.watermark import watermarked
from ladarreg_core.foundations.arrays import ByteArray, FloatArray, read_only
from ladarreg_core.foundations.encoded_image import encoded_image
from ladarreg_core.foundations.palette import (
    BACKGROUND,
    DIM,
    INK,
    UNKNOWN,
    VISIBILITY,
    WARN,
    Color,
    paint,
    ramp_colors,
    scale_end,
)
from ladarreg_core.foundations.validation import require_positive
from ladarreg_core.inspection.model_textures import Legend, visibility_texture
from ladarreg_core.storage.atomic_write import write_bytes
from ladarreg_core.surface.texture.registered_texture import Label, RegisteredTexture

_MAX_PX = 1e9
_BAR_WIDTHS, _BAR_HEIGHT, _MARGIN, _TEXT = (200, 480), 14, 12, 13
_TICKS = 4
_NO_PIECE = 255


def write_registered_png(path: str | Path, texture: RegisteredTexture, *, mark: str = "") -> None:
    """Write the photograph on the scan's grid; a mark, of a pose that was not verified, is a watermark across it.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_png(path, watermarked(texture.image, mark, WARN) if mark else texture.image)


def write_png(path: str | Path, picture: ByteArray) -> None:
    """Write an image (H, W, 3), uint8 RGB, losslessly.

    Raises:
        ExportError: if the file cannot be written.
    """
    write_bytes(path, encoded_image(picture, ".png"))


def write_labels_png(path: str | Path, texture: RegisteredTexture, *, mark: str = "") -> None:
    """Write the labels as an indexed PNG: pixel values are the codes, the palette gives them colours.

    A text chunk names the codes, another one the mark of a pose that was not verified.

    Raises:
        ExportError: if the file cannot be written.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    palette = np.zeros((256, 3), dtype=np.uint8)
    palette[: len(VISIBILITY)] = VISIBILITY
    image = Image.fromarray(texture.labels)
    image.putpalette(palette.tobytes())
    stream, notes = io.BytesIO(), PngInfo()
    if mark:
        notes.add_text("Pose", mark)
    notes.add_text("Legend", ", ".join(f"{label.value} {label.name.lower().replace('_', ' ')}" for label in Label))
    # Eight bits per pixel, so that readers that ignore palettes find one code per byte.
    image.save(stream, format="PNG", bits=8, pnginfo=notes)
    write_bytes(path, stream.getvalue())


def write_provenance_png(path: str | Path, piece_of_cell: NDArray[np.integer[Any]], colors: ByteArray) -> None:
    """Write which piece each cell of a panorama is from.

    Up to 255 pieces make an indexed PNG: pixel values are the numbers of the pieces, 255 is no return, and the palette
    gives them their colours. More make an RGB image of the colours, with black for no return.

    Args:
        path: output file.
        piece_of_cell: (H, W) number of the piece; negative = no return.
        colours: (N, 3) uint8 RGB of the pieces.

    Raises:
        ExportError: if the file cannot be written.
    """
    from PIL import Image

    none = np.zeros((1, 3), np.uint8)
    if len(colors) > _NO_PIECE:
        # A negative number counts from the end.
        write_png(path, np.concatenate([colors, none])[np.maximum(piece_of_cell, -1)])
        return
    palette = np.zeros((_NO_PIECE + 1, 3), np.uint8)
    palette[: len(colors)] = colors
    image = Image.fromarray(np.where(piece_of_cell < 0, _NO_PIECE, piece_of_cell).astype(np.uint8))
    image.putpalette(palette.tobytes())
    stream = io.BytesIO()
    image.save(stream, format="PNG", bits=8)
    write_bytes(path, stream.getvalue())


def visibility_picture(texture: RegisteredTexture) -> NDArray[np.uint8]:
    """Return the visibility classes in their colours, above a legend of those that occur.

    Returns:
        (H + legend, at least W, 3) uint8 RGB; the scan's cells are its upper left H x W pixels.
    """
    drawn = visibility_texture(texture.labels)
    return stacked([drawn.image, legend_strip(drawn.legend, room=texture.labels.shape[1])])


def write_visibility_png(path: str | Path, texture: RegisteredTexture, *, mark: str = "") -> None:
    """Write the image returned by `visibility_picture`, below it the mark of a pose that was not verified.

    Raises:
        ExportError: if the file cannot be written.
    """
    picture = visibility_picture(texture)
    if mark:
        picture = stacked(
            [picture, padded(text_block(f"pose: {mark}", size=_TEXT, color=WARN), left=_MARGIN, bottom=_MARGIN)]
        )
    write_png(path, picture)


def legend_strip(legend: Legend, *, room: int) -> NDArray[np.uint8]:
    """Return the single colours of a legend with their meanings, in as many columns as fit `room` pixels."""
    entries = [
        beside([_swatch(color), text_block(words, size=_TEXT, color=INK)], gap=8) for color, words in legend.entries
    ]
    widest = max((entry.shape[1] for entry in entries), default=1) + _MARGIN
    columns = max(1, (room - _MARGIN) // widest)
    rows = [entries[k : k + columns] for k in range(0, len(entries), columns)]
    lines = [beside([padded(one, right=widest - one.shape[1]) for one in row]) for row in rows]
    if legend.title:
        lines.insert(0, text_block(legend.title, size=_TEXT, color=DIM))
    return padded(stacked(lines, gap=4), top=_MARGIN, bottom=_MARGIN, left=_MARGIN)


def _swatch(color: Color) -> NDArray[np.uint8]:
    field = np.array(text_block("", size=_TEXT, width=_TEXT))
    field[3 : 3 + _TEXT] = color
    return field


def uncertainty_picture(sigma_px: FloatArray, *, most_px: float | None = None) -> NDArray[np.uint8]:
    """Return the uncertainty as colours from dark blue to yellow, above a scale bar in pixels.

    Args:
        sigma_px: (H, W) standard deviation as returned by `picture_sigma`, px; NaN where undefined.
        most_px: value of the brightest colour, px, also used for larger values. None: a round number that 98 % of
            the cells do not exceed.

    Returns:
        (H + scale, at least W, 3) uint8 RGB; the scan's cells are its upper left H x W pixels, gray where NaN.

    Raises:
        ShapeError: if it is not an (H, W) grid of cells.
        OptionError: if `most_px` is not a positive number.
    """
    sigma = read_only(sigma_px, np.float32, (None, None), "the uncertainty")
    if not sigma.size:
        raise ShapeError("the uncertainty has no cells; it must have the size of the scan")
    if most_px is not None:
        require_positive(most_px, "most_px", most=_MAX_PX, unit="pixels")
    most = scale_end(sigma) if most_px is None else float(most_px)
    with np.errstate(invalid="ignore"):
        level = np.clip(np.nan_to_num(sigma / np.float32(most), nan=0.0, posinf=1.0, neginf=0.0), 0, 1)
        exceeded = bool((sigma > most).any())
    picture = np.array(ramp_colors(level))
    unknown = np.isnan(sigma)
    paint(picture, unknown, UNKNOWN)
    parts = [picture, _scale(most, exceeded="+" if exceeded else "", room=picture.shape[1])]
    if unknown.any():
        key = Legend("", ((UNKNOWN, "no data: no return, or outside the photograph"),))
        parts.append(legend_strip(key, room=picture.shape[1]))
    return stacked(parts)


def write_uncertainty_png(path: str | Path, sigma_px: FloatArray, *, most_px: float | None = None) -> None:
    """Write the image returned by `uncertainty_picture` for the same arguments.

    Raises:
        ExportError: if the file cannot be written.
        LadarregError: as `uncertainty_picture`.
    """
    write_png(path, uncertainty_picture(sigma_px, most_px=most_px))


def _scale(most: float, *, exceeded: str, room: int) -> NDArray[np.uint8]:
    """Return the scale bar with its numbers, if possible `room` pixels wide."""
    width = int(np.clip(room - 2 * _MARGIN, *_BAR_WIDTHS))
    bar = np.array(ramp_colors(np.tile(np.linspace(0, 1, width), (_BAR_HEIGHT, 1))))
    field = 56
    full = np.full((round(_TEXT * 1.36), width + field, 3), BACKGROUND, dtype=np.uint8)
    for tick in range(_TICKS + 1):
        at = round(tick * (width - 1) / _TICKS)
        label = f"{tick * most / _TICKS:.4g}{exceeded if tick == _TICKS else ''}"
        number = text_block(label, size=_TEXT, width=field, align="centre", color=INK)
        # Neighbouring fields may overlap on a narrow bar; the lighter pixel wins, so that no number is clipped.
        part = full[:, at : at + field]
        np.maximum(part, number[:, : part.shape[1]], out=part)
        bar[-4:, min(at, width - 1)] = INK
    title = text_block("standard deviation of the registered image, pixels", size=_TEXT, color=DIM)
    return stacked(
        [
            padded(bar, top=_MARGIN, left=field // 2, bottom=4),
            full,
            padded(title, left=field // 2, bottom=_MARGIN, right=_MARGIN),
        ]
    )


def layer_picture(image: ByteArray, legend: Legend, *, longest_px: int = 2400) -> NDArray[np.uint8]:
    """Return a layer of the grid above its legend: single colours, and the scale with its ends.

    Args:
        image: (H, W, 3) uint8 RGB.
        legend: what the colours mean.
        longest_px: every n-th row and column of a larger picture is shown.
    """
    stride = max(1, int(np.ceil(max(image.shape[:2]) / longest_px)))
    shown = image[::stride, ::stride]
    room = max(shown.shape[1], 320)
    parts = [shown, legend_strip(legend, room=room)]
    if legend.ramp:
        width = int(np.clip(room - 2 * _MARGIN, *_BAR_WIDTHS))
        at = np.linspace(0, len(legend.ramp) - 1, width)
        knots = np.array(legend.ramp, np.float64)
        line = np.stack([np.interp(at, np.arange(len(knots)), knots[:, k]) for k in range(3)], axis=-1)
        bar = np.repeat(np.rint(line).astype(np.uint8)[None], _BAR_HEIGHT, axis=0)
        least = text_block(legend.least, size=_TEXT, width=width // 2, color=INK)
        most = text_block(legend.most, size=_TEXT, width=width - width // 2, align="right", color=INK)
        parts.append(padded(stacked([bar, beside([least, most])], gap=4), left=_MARGIN, bottom=_MARGIN))
    return stacked(parts)
