"""The pictures of a report, drawn as the contact sheet draws them, and maps with their legends."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from ladarreg_core.export.pictures.detail import (
    DETAIL_ASPECT,
    Window,
    detail_window,
    edge_lines,
    seen_window,
    whole_window,
)
from ladarreg_core.export.pictures.layout import fit_size, framed, resized
from ladarreg_core.export.pictures.match_panels import best_enlargement, match_panel
from ladarreg_core.export.pictures.panels import BADGES, contrasted, marked, scan_panel, window_size, with_edges
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.markup import Html, map_uri, photograph_uri, tag
from ladarreg_core.foundations.palette import ACCENT, BACKGROUND, DIM, LINE, as_css, paint
from ladarreg_core.inspection.model_textures import (
    Legend,
    TextureKind,
    model_texture,
    registered_texture,
    texture_choices,
    visibility_legend,
)
from ladarreg_core.inspection.pictures import scan_over_photo
from ladarreg_core.photo import Photo
from ladarreg_core.results.registration import Registration
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.registered_texture import Label, RegisteredTexture, intensity_picture

_WIDE, _HALF, _TALLEST = 1280, 760, 760
_MAP_WIDTH = 480  # of the half page, less its margins
_MAPS: tuple[TextureKind, ...] = ("uncertainty", "label", "residual", "depth_error", "resolution")
_PER_CENT_LABELS = (Label.SEEN, Label.OCCLUDED, Label.OUT_OF_FRAME, Label.GRAZING, Label.UNCERTAIN)


class ReportPictures:
    """The pictures of one registration, as data URIs.

    Args:
        scan: the scan.
        photo: the photograph.
        result: its pose; `accepted` if it may be shown.
        texture: the photograph on the scan's grid, if already computed.
        mark: words on every picture that rests on the pose; None: the pose is accepted and current.
    """

    def __init__(
        self, scan: Scan, photo: Photo, result: Registration, *, texture: RegisteredTexture | None, mark: str | None
    ) -> None:
        self._scan, self._photo, self._result, self._mark = scan, photo, result, mark
        self._given_texture = texture

    @cached_property
    def _texture(self) -> RegisteredTexture:
        if self._given_texture is not None:
            return self._given_texture
        return registered_texture(self._scan, self._photo, self._result)

    @cached_property
    def _colored(self) -> ByteArray:
        """The texture of the coloured model, as the workbench shows it."""
        return model_texture(
            self._scan, "colour", photo=self._photo, result=self._result, registered=self._texture
        ).image

    @cached_property
    def _tile(self) -> Window:
        return seen_window(self._scan, [self._texture])

    @cached_property
    def _detail(self) -> Window | None:
        return detail_window(self._scan, self._texture, [self._texture])

    def scan(self) -> str:
        """Return the whole scan's intensity, with the windows of the other pictures outlined."""
        size = window_size(self._scan, whole_window(self._scan), _HALF, _TALLEST)
        return photograph_uri(scan_panel(self._scan, size, ((self._tile, DIM), (self._detail, ACCENT))))

    def photograph(self) -> str:
        """Return the photograph."""
        return photograph_uri(framed(resized(self._photo.pixels, self._photo_size(_HALF)), LINE))

    def registered(self) -> str:
        """Return the photograph on the scan's grid, where it is seen."""
        size = window_size(self._scan, self._tile, _HALF, _TALLEST)
        picture = self._colored[self._tile.cells]
        return self._with_mark(framed(resized(picture, size), LINE))

    def detail(self) -> tuple[str, str] | None:
        """Return the enlarged detail before and after; None if no cell has the photograph's colour."""
        window = self._detail
        if window is None:
            return None
        size = window_size(self._scan, window, _HALF, round(_HALF / DETAIL_ASPECT * 1.2))
        edges = edge_lines(self._scan, window, size)
        before = resized(contrasted(intensity_picture(self._scan)[window.cells]), size)
        after = with_edges(resized(self._colored[window.cells], size), edges)
        return photograph_uri(framed(before, LINE)), self._with_mark(framed(after, LINE))

    def overlay(self) -> str:
        """Return the photograph with the edges of the scan at the pose."""
        width, height = self._photo_size(_WIDE)
        camera = self._result.camera.resized(width, height)
        edges = scan_over_photo(self._scan, camera, self._result.camera_from_scanner, "edges").astype(np.float32)
        alpha = edges[..., 3:] / 255
        picture = resized(self._photo.pixels, (width, height)) * (1 - alpha) + edges[..., :3] * alpha
        return self._with_mark(framed(np.rint(picture).astype(np.uint8), LINE))

    def matches(self) -> tuple[str, int]:
        """Return the matches with their residuals on the photograph, and how many times these are enlarged."""
        size = self._photo_size(_WIDE)
        enlargement = best_enlargement([self._result], size[0])
        return self._with_mark(
            framed(match_panel(self._photo, self._result, size, enlargement=enlargement), LINE)
        ), enlargement

    def maps(self) -> list[tuple[str, Legend, dict[str, str], str]]:
        """Return the maps on the scan's grid: picture, legend, the share of cells by legend entry, and a caption."""
        usable = {choice.kind: choice for choice in texture_choices(self._result) if choice.usable}
        # Quantities that change slowly are computed at the size they are shown at.
        stride = max(1, self._tile.width // _MAP_WIDTH)
        every = slice(None, None, stride)
        scan = self._scan.window(every, every) if stride > 1 else self._scan
        coarse = RegisteredTexture(self._texture.image[every, every], self._texture.labels[every, every])
        shown = tuple(slice(part.start // stride, -(-part.stop // stride)) for part in self._tile.cells)
        size = window_size(self._scan, self._tile, max(_MAP_WIDTH, shown[1].stop - shown[1].start), _TALLEST)
        whole = bool(self._scan.valid[self._tile.cells].all())
        found: list[tuple[str, Legend, dict[str, str], str]] = []
        for kind in _MAPS:
            if kind not in usable:
                continue
            texture = model_texture(scan, kind, photo=self._photo, result=self._result, registered=coarse)
            legend, shares = texture.legend, {}
            if kind == "label":  # few cells of a class may all be left out
                legend = visibility_legend(self._texture.labels)
                shares = self._shares(legend)
            picture = np.array(texture.image[shown])
            paint(picture, ~scan.valid[shown], BACKGROUND)
            if not whole:
                legend = replace(legend, entries=(*legend.entries, (BACKGROUND, "no return")))
            words = usable[kind].description
            found.append((map_uri(_nearest(picture, size)), legend, shares, f"{usable[kind].label}: {words}."))
        return found

    def _shares(self, legend: Legend) -> dict[str, str]:
        """Return the share of the scan's returns in each visibility class, by the words of the legend."""
        counts = np.bincount(self._texture.labels[self._scan.valid], minlength=len(Label))
        present = [label for label in _PER_CENT_LABELS if counts[label]]
        total = max(int(counts.sum()), 1)
        return {
            words: f"{100 * counts[label] / total:.1f} %"
            for label, (_, words) in zip(present, legend.entries, strict=False)
        }

    def _photo_size(self, width: int) -> tuple[int, int]:
        camera = self._photo.camera
        return fit_size(camera.width / camera.height, width=min(width, max(camera.width, _HALF)), height=_WIDE)

    def _with_mark(self, picture: ByteArray) -> str:
        if self._mark is None:
            return photograph_uri(picture)
        return photograph_uri(marked(picture, self._mark, BADGES["not accepted"], width=picture.shape[1]))


def legend_html(legend: Legend, shares: dict[str, str]) -> Html:
    """Return a legend: its title, a scale with both ends, and single colours with their meanings and shares."""
    parts = [tag("p", tag("strong", legend.title))]
    if legend.ramp:
        count = len(legend.ramp)
        bars = [tag("rect", x=k * 10, y=0, width=10.5, height=10, fill=as_css(c)) for k, c in enumerate(legend.ramp)]
        scale = tag("svg", *bars, viewBox=f"0 0 {10 * count} 10", preserveAspectRatio="none", class_="ramp",
                    role="img", aria_label=f"from {legend.least} to {legend.most}")  # fmt: skip
        parts.append(tag("div", scale, tag("p", tag("span", legend.least), tag("span", legend.most), class_="ends")))
    keys = [
        tag(
            "span",
            tag("svg", tag("rect", width=12, height=12, fill=as_css(color)), width=12, height=12, aria_hidden="true"),
            f" {words}{f' ({shares[words]})' if words in shares else ''}",
            class_="key",
        )
        for color, words in legend.entries
    ]
    return tag("div", *parts, tag("p", keys, class_="keys") if keys else "", class_="legend")


def _nearest(picture: ByteArray, size: tuple[int, int]) -> ByteArray:
    """Return an image resized without mixing its colours, which are codes."""
    rows = np.arange(size[1]) * picture.shape[0] // size[1]
    columns = np.arange(size[0]) * picture.shape[1] // size[0]
    return np.asarray(picture.take(rows, axis=0).take(columns, axis=1))
