"""Contact sheet of a comparison: the result of each stage, an enlarged detail, and its matches, in one image."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.export.comparison.table import (
    NOTHING,
    Difference,
    cautions_of,
    check_comparison,
    comparison_table,
    default_of,
    differences,
    rms_px,
    title_of,
    verdict_of,
)
from ladarreg_core.export.pictures.detail import (
    DETAIL_ASPECT,
    Window,
    detail_window,
    edge_lines,
    seen_window,
    whole_window,
)
from ladarreg_core.export.pictures.images import write_png
from ladarreg_core.export.pictures.layout import (
    beside,
    boxed,
    chip,
    fit_size,
    framed,
    legible,
    padded,
    placed,
    resized,
    shortened,
    stacked,
    text_block,
    wrapped,
)
from ladarreg_core.export.pictures.match_panels import best_enlargement, match_panel
from ladarreg_core.export.pictures.panels import BADGES, marked, scan_panel, window_aspect, window_size, with_edges
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.palette import (
    ACCENT,
    BACKGROUND,
    BAD,
    DIM,
    INK,
    LINE,
    OK,
    PANEL,
    WARN,
    WARN_GROUND,
    Color,
)
from ladarreg_core.matches import count_picks
from ladarreg_core.photo import Photo
from ladarreg_core.registration.comparison import Column, Comparison
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.registered_texture import RegisteredTexture, intensity_picture, model_picture

SHEET_WIDTH = 2560
"""Width of the sheet, pixels."""
_MARGIN, _GAP, _PAD = 44, 20, 16
_BIG, _HEAD, _BODY, _SMALL = 40, 27, 21, 19
_TABLE_ROW = 30
_ROW_NAME_WIDTH, _HEAD_WIDTH = 186, 150
_TALLEST = 560
_TABLE_WIDTH, _WIDEST_TABLE = 940, 1500
_UNSEEN = 0.22
_REASON_LINES = 4


def write_contact_sheet(path: str | Path, comparison: Comparison, scan: Scan, photo: Photo) -> None:
    """Write the contact sheet as PNG.

    Raises:
        ExportError: if the file cannot be written.
        ShapeError: as `contact_sheet`.
    """
    write_png(path, contact_sheet(comparison, scan, photo))


def contact_sheet(comparison: Comparison, scan: Scan, photo: Photo) -> NDArray[np.uint8]:
    """Return the comparison as one image.

    At the top: the scan's intensity, the photograph and the table. Below, one column per stage: the photograph on the
    scan's grid with its verdict, an enlarged detail with the scan's intensity edges, and the matches on the photograph.

    Args:
        comparison: the columns.
        scan: the scan that they share.
        photo: the photograph that they share.

    Returns:
        (H, `SHEET_WIDTH`, 3) uint8 RGB.

    Raises:
        ShapeError: if there is no column, or an image is not on the scan's grid.

    Source: thesis Figure 2.22 and Tables 3.2-3.5.
    """
    check_comparison(comparison, scan)
    textures = [column.texture for column in comparison.columns if column.texture is not None]
    tile = seen_window(scan, textures)
    reference = _reference(comparison)
    detail = None if reference is None else detail_window(scan, reference, textures)
    inner = SHEET_WIDTH - 2 * _MARGIN
    bands = [_header(comparison, scan, photo, inner), _top(comparison, scan, photo, tile, detail, inner)]
    shown = [_shown(column, scan) for column in comparison.columns]
    bands.append(_cards(comparison, shown, scan, tile, inner))
    if detail is not None:
        bands += [
            _caption("Enlarged detail", [_note("thin lines: edges of the scan's intensity")], inner),
            _details(comparison, shown, scan, detail, inner),
        ]
    results = [column.stage.result for column in comparison.columns]
    enlargement = best_enlargement(results, _column_width(comparison, inner))
    bands += [
        _caption(
            "Matches on the photograph", [] if results == [None] * len(results) else _match_legend(enlargement), inner
        ),
        _matches(comparison, photo, enlargement, inner),
    ]
    sheet = stacked([padded(band, bottom=_GAP) for band in bands])
    return padded(
        sheet, top=_MARGIN - 8, bottom=_MARGIN - _GAP, left=_MARGIN, right=SHEET_WIDTH - _MARGIN - sheet.shape[1]
    )


def _reference(comparison: Comparison) -> RegisteredTexture | None:
    """Return the texture that determines the detail: the default's, else the last one."""
    default = default_of(comparison)
    if default is not None and default.texture is not None:
        return default.texture
    return next((c.texture for c in reversed(comparison.columns) if c.texture is not None), None)


def _column_width(comparison: Comparison, inner: int) -> int:
    count = max(len(comparison.columns), 3)
    return (inner - _GAP * (count - 1)) // count


# --- top -------------------------------------------------------------------------------------------------------------


def _header(comparison: Comparison, scan: Scan, photo: Photo, inner: int) -> NDArray[np.uint8]:
    rows, columns = scan.shape
    sizes = f"scan {columns} x {rows} cells   ·   photograph {photo.camera.width} x {photo.camera.height} px"
    title = text_block("Registration, stage by stage", size=_BIG, weight=0.8)
    facts = text_block(sizes, size=_BODY, color=DIM)
    names = shortened(f"{scan.name}  ·  {photo.name}", size=_BODY, width=inner - title.shape[1] - facts.shape[1] - 120)
    left = beside([title, padded(text_block(names, size=_BODY, color=DIM), top=20, left=28)])
    facts = padded(facts, top=20)
    blocks = [beside([left, placed(facts, width=inner - left.shape[1], height=left.shape[0], align="right", at_top=1)])]
    for caution in cautions_of(comparison):
        words = text_block(caution, size=_BODY, width=inner - 2 * _PAD, lines=2, color=WARN, ground=WARN_GROUND)
        blocks.append(boxed(words, pad=(8, _PAD), ground=WARN_GROUND, line=LINE, under=BACKGROUND, radius=8))
    return stacked(blocks, gap=10)


def _top(
    comparison: Comparison, scan: Scan, photo: Photo, tile: Window, detail: Window | None, inner: int
) -> NDArray[np.uint8]:
    """Return scan, photograph and table in one row; a wide scan is placed above the photograph."""
    aspects = (window_aspect(scan, whole_window(scan)), photo.camera.width / photo.camera.height)
    room = inner - _TABLE_WIDTH - _GAP
    height = min(_TALLEST, (room - _GAP) / sum(aspects))
    abreast = [fit_size(a, width=room, height=max(round(height), 1)) for a in aspects]
    above = [
        fit_size(a, width=room, height=h) for a, h in zip(aspects, (_TALLEST // 2 + 40, _TALLEST // 2), strict=True)
    ]
    wide = _area(above) > _area(abreast)
    sizes = above if wide else abreast
    pictures = (
        scan_panel(scan, sizes[0], ((tile, DIM), (detail, ACCENT))),
        framed(resized(photo.pixels, sizes[1]), LINE),
    )
    blocks = [
        stacked([text_block(name, size=_SMALL, color=DIM), picture], gap=6)
        for name, picture in zip(("Scan, intensity", "Photograph"), pictures, strict=True)
    ]
    left = stacked(blocks, gap=12) if wide else beside(blocks, gap=_GAP)
    table_width = min(inner - left.shape[1] - _GAP, _WIDEST_TABLE)
    table = _table_panel(comparison, scan, table_width)
    return beside(
        [left, placed(table, width=inner - left.shape[1] - _GAP, height=table.shape[0], align="right")], gap=_GAP
    )


def _area(sizes: Sequence[tuple[int, int]]) -> int:
    return sum(width * height for width, height in sizes)


def _table_panel(comparison: Comparison, scan: Scan, full_width: int) -> NDArray[np.uint8]:
    """Return the table of numbers with the default's column emphasised."""
    table = comparison_table(comparison, scan)
    inner = full_width - 2 * _PAD
    width = min((inner - _ROW_NAME_WIDTH) // len(table.heads), 240)
    first = inner - width * len(table.heads)
    heads = [wrapped(head, size=_SMALL, width=min(width - 4, _HEAD_WIDTH), lines=3) for head in table.heads]
    deepest = max(len(head) for head in heads)
    raised = [[""] * (deepest - len(head)) + head for head in heads]  # all heads end on the lowest line
    blocks = [_table_row(("", *line), first, width, (DIM, DIM, INK)) for line in zip(*raised, strict=True)]
    rule = np.full((1, inner, 3), LINE, dtype=np.uint8)
    blocks.append(padded(rule, top=8, bottom=4, ground=PANEL))
    for row in table.rows:
        if row[0] in ("points", "from default, px", "verdict"):
            blocks.append(padded(rule, top=4, bottom=4, ground=PANEL))
        line = _table_row(row, first, width, (DIM, INK, ACCENT))
        blocks.append(placed(line, width=inner, height=_TABLE_ROW, ground=PANEL))
    return boxed(stacked(blocks, ground=PANEL), pad=(_PAD, _PAD), ground=PANEL, line=LINE, under=BACKGROUND, radius=10)


def _table_row(cells: tuple[str, ...], first: int, width: int, colors: tuple[Color, Color, Color]) -> NDArray[np.uint8]:
    """Return a row; `colours` are those of its name, its cells and its last cell."""
    blocks = [text_block(cells[0], size=_SMALL, width=first, color=colors[0], ground=PANEL)]
    for number, cell in enumerate(cells[1:], start=2):
        color = colors[2] if number == len(cells) else colors[1]
        color = BADGES[cell][0] if cell in BADGES else DIM if cell == NOTHING else color
        blocks.append(text_block(cell, size=_SMALL, width=width, color=color, ground=PANEL, align="right"))
    return beside(blocks, ground=PANEL)


# --- one column per stage --------------------------------------------------------------------------------------------


def _cards(
    comparison: Comparison, shown: Sequence[ByteArray], scan: Scan, tile: Window, inner: int
) -> NDArray[np.uint8]:
    width = _column_width(comparison, inner)
    cards = [
        _card(column, apart, picture[tile.cells], window_size(scan, tile, width - 2 * _PAD, _TALLEST), width - 2 * _PAD)
        for column, apart, picture in zip(comparison.columns, differences(comparison, scan), shown, strict=True)
    ]
    height = max(card.shape[0] for card in cards)
    return beside(
        [
            boxed(
                padded(card, bottom=height - card.shape[0], ground=PANEL),
                pad=(_PAD, _PAD),
                ground=PANEL,
                line=LINE,
                under=BACKGROUND,
                radius=10,
            )
            for card in cards
        ],
        gap=_GAP,
    )


def _card(
    column: Column, apart: Difference | None, picture: ByteArray, size: tuple[int, int], width: int
) -> NDArray[np.uint8]:
    verdict = verdict_of(column)
    color, ground = BADGES[verdict]
    badge = chip(verdict, size=_SMALL, color=color, ground=ground, under=PANEL)
    seconds = text_block(_seconds(column.seconds), size=_SMALL, color=DIM, ground=PANEL)
    blocks = [
        text_block(title_of(column), size=_HEAD, width=width, ground=PANEL, weight=0.6),
        beside(
            [badge, placed(seconds, width=width - badge.shape[1], height=badge.shape[0], ground=PANEL, align="right")],
            ground=PANEL,
        ),
        _marked(framed(resized(picture, size), color), verdict, width, ground=PANEL),
    ]
    blocks += [
        text_block(line, size=_BODY, width=width, lines=2, ground=PANEL, color=ink)
        for line, ink in _lines(column, apart)
    ]
    why = _why(column)
    if why:
        blocks.append(text_block(why, size=_SMALL, width=width, lines=_REASON_LINES, color=DIM, ground=PANEL))
    return stacked(blocks, gap=9, ground=PANEL)


def _lines(column: Column, apart: Difference | None) -> list[tuple[str, Color]]:
    result = column.stage.result
    if result is None:
        return []
    lines = [(_inlier_summary(result), INK)]
    if result.is_determined:
        lines += [
            (result.thesis_parameters.describe_position(), INK),
            (result.thesis_parameters.describe_orientation().replace(" deg", "°"), INK),
        ]
    if apart is not None and column.stage.name != "default":
        lines.append((f"{_distance(apart)} from the default", DIM))
    return lines


def _inlier_summary(result: PoseResult) -> str:
    if not len(result.matches):
        return "no matches"
    rms = rms_px(result)
    text = "{} of {} matches agree".format(*count_picks(result.matches, result.inliers))
    return f"{text}, {rms:.2f} px rms" if np.isfinite(rms) else text


def _distance(apart: Difference) -> str:
    mm, px = 1000 * apart.position_m, apart.median_px
    length = f"{mm:.0f} mm" if mm < 1000 else f"{apart.position_m:.2f} m"
    shift = f"{px:.2f} px, " if px < 10 else f"{px:.0f} px, " if np.isfinite(px) else ""
    return f"{shift}{length}, {np.degrees(apart.angle_rad):.2f}°"


def _why(column: Column) -> str:
    result = column.stage.result
    sentences = [column.stage.note, *(() if result is None else result.reasons)]
    return " ".join(legible(sentence) for sentence in sentences if sentence)


def _seconds(seconds: float) -> str:
    return f"{seconds:.2f} s" if seconds < 10 else f"{seconds:.0f} s"


def _details(
    comparison: Comparison, shown: Sequence[ByteArray], scan: Scan, detail: Window, inner: int
) -> NDArray[np.uint8]:
    width = _column_width(comparison, inner)
    size = window_size(scan, detail, width, round(width / DETAIL_ASPECT * 1.2))
    edges = edge_lines(scan, detail, size)
    panels = [
        _marked(framed(with_edges(resized(whole[detail.cells], size), edges), LINE), verdict_of(column), width)
        for column, whole in zip(comparison.columns, shown, strict=True)
    ]
    return beside(panels, gap=_GAP)


def _marked(picture: ByteArray, verdict: str, width: int, *, ground: Color = BACKGROUND) -> NDArray[np.uint8]:
    """Return an image centred in its column, marked unless it is accepted."""
    if verdict == "accepted":
        return placed(picture, width=width, height=picture.shape[0], ground=ground)
    return marked(picture, verdict, BADGES[verdict], width=width, ground=ground)


def _shown(column: Column, scan: Scan) -> ByteArray:
    if column.texture is None:
        return np.asarray(np.rint(intensity_picture(scan) * _UNSEEN), dtype=np.uint8)
    return model_picture(scan, column.texture)


# --- the matches -----------------------------------------------------------------------------------------------------


def _matches(comparison: Comparison, photo: Photo, enlargement: int, inner: int) -> NDArray[np.uint8]:
    width = _column_width(comparison, inner)
    size = fit_size(photo.camera.width / photo.camera.height, width=width, height=_TALLEST)
    panels = []
    for column in comparison.columns:
        panel = framed(match_panel(photo, column.stage.result, size, enlargement=enlargement), LINE)
        verdict = "no pose" if column.stage.result is None else "accepted"
        panels.append(_marked(panel, verdict, width))
    return beside(panels, gap=_GAP)


def _match_legend(enlargement: int) -> list[NDArray[np.uint8]]:
    times = "" if enlargement == 1 else f", enlarged {enlargement} times"
    note = f"lines: residuals{times}"
    return [
        *(beside([_dot(color), _note(words)], gap=8) for words, color in (("inlier", OK), ("outlier", BAD))),
        _note(note),
    ]


def _note(text: str) -> NDArray[np.uint8]:
    return text_block(text, size=_BODY, color=DIM)


def _dot(color: Color) -> NDArray[np.uint8]:
    field = padded(text_block("", size=_BODY, width=12))
    cv2.circle(field, (6 << 4, (field.shape[0] // 2 + 1) << 4), round(5.5 * 16), color, -1, cv2.LINE_AA, 4)
    return field


def _caption(title: str, notes: Sequence[ByteArray], inner: int) -> NDArray[np.uint8]:
    blocks = [text_block(title, size=_HEAD, weight=0.6), *(padded(note, top=8) for note in notes)]
    return padded(beside(blocks, gap=24)[:, :inner], top=8)
