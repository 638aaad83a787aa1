"""The palette against the page's tokens, and its colours against each other."""

from __future__ import annotations

import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from ladarreg_core.foundations import palette
from ladarreg_core.surface.texture.registered_texture import Label

TOKENS = (Path(__file__).resolve().parents[3] / "static" / "tokens.css").read_text(encoding="utf-8")
LOOK = ("background", "panel", "line", "ink", "dim", "accent", "ok", "ok-ground", "warn", "warn-ground", "bad")


def dark_token(name: str) -> str:
    """Return the value of a custom property in the dark theme, which stands first."""
    found = re.search(rf"--lr-{name}: ([^;]+);", TOKENS)
    assert found is not None, name
    return found[1]


def lightness(color: palette.Color) -> float:
    """Return the relative luminance of WCAG, 0 to 1."""
    c = np.array(color) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def contrast(a: palette.Color, b: palette.Color) -> float:
    """Return the contrast ratio of WCAG."""
    low, high = sorted((lightness(a), lightness(b)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("name", [*LOOK, "bad-ground"])
def test_the_look_is_that_of_the_page(name: str) -> None:
    assert palette.as_css(getattr(palette, name.upper().replace("-", "_"))) == dark_token(name)


def test_matches_have_the_colors_of_the_page() -> None:
    assert [palette.as_css(color) for color in palette.MATCHES] == [
        dark_token(f"match-{k + 1}") for k in range(len(palette.MATCHES))
    ]
    assert f"--lr-match-{len(palette.MATCHES) + 1}" not in TOKENS


def test_text_is_legible_on_its_ground() -> None:
    for ink, ground in (("INK", "PANEL"), ("DIM", "PANEL"), ("OK", "OK_GROUND"), ("WARN", "WARN_GROUND")):
        assert contrast(getattr(palette, ink), getattr(palette, ground)) > 4.5
    assert contrast(palette.BAD, palette.BAD_GROUND) > 4.5


def test_every_visibility_class_has_a_color_of_its_own() -> None:
    assert len(palette.VISIBILITY) == len(Label)
    for a, b in combinations(palette.VISIBILITY, 2):
        assert np.linalg.norm(np.subtract(a, b)) > 60
        assert contrast(a, b) > 1.1, "they must differ in gray, too"


def test_the_ramp_gets_lighter() -> None:
    ramp = palette.ramp_colors(np.linspace(-0.5, 1.5, 65))
    assert ramp.shape == (65, 3)
    light = [lightness((int(r), int(g), int(b))) for r, g, b in ramp]
    assert np.all(np.diff(light) >= 0)
    assert light[-1] > 20 * light[0]
    np.testing.assert_array_equal(palette.ramp_colors(np.ones((2, 3)))[1, 2], ramp[-1])


def test_no_levels_have_no_colors() -> None:
    assert palette.ramp_colors(np.empty(0)).shape == (0, 3)
    assert palette.ramp_colors(np.empty((4, 0))).shape == (4, 0, 3)


def test_cells_are_painted_and_the_others_stay() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (9, 7, 3), dtype=np.uint8)
    cells = np.random.default_rng(1).random((9, 7)) < 0.5
    wanted = picture.copy()
    wanted[cells] = palette.ACCENT
    palette.paint(picture, cells, palette.ACCENT)
    np.testing.assert_array_equal(picture, wanted)
    palette.paint(picture, np.zeros((9, 7), np.bool_), palette.BAD)
    np.testing.assert_array_equal(picture, wanted)
    np.testing.assert_array_equal(palette.uniform((2, 3), palette.WARN), np.full((2, 3, 3), palette.WARN))
