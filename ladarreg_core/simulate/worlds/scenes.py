"""Four kinds of rooms, different for every seed: furnished ahead of the scanner, or all around it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from ladarreg_core.simulate.worlds import furniture as make
from ladarreg_core.simulate.worlds.furniture import Workshop
from ladarreg_core.simulate.worlds.materials import InkMixer
from ladarreg_core.simulate.worlds.natural import NaturalPrinter
from ladarreg_core.simulate.worlds.surroundings import SURROUNDINGS
from ladarreg_core.simulate.worlds.textures import Printer
from ladarreg_core.simulate.worlds.world import Placement, World, WorldBuilder


def build_scene(
    scene: str,
    *,
    layout: np.random.Generator,
    independent_inks: bool = False,
    heated: bool = False,
    all_around: bool = False,
    natural: bool = False,
) -> World:
    """Return the world of a scene.

    Args:
        scene: a name in `SCENES`, or in `SURROUNDINGS` if it is furnished all around.
        layout: random generator of the whole scene.
        independent_inks: laser albedo and visible colour are unrelated.
        heated: whether heating pipes run along the far wall.
        all_around: furnished and printed on all sides, for scanners that turn; otherwise ahead only.
        natural: textures have the spectrum of natural images: stone, dense print and foliage.
    """
    inks = InkMixer(layout, independent=independent_inks)
    shop = Workshop(WorldBuilder(), (NaturalPrinter if natural else Printer)(layout, inks), heated=heated)
    return SURROUNDINGS[scene](shop) if all_around else SCENES[scene](shop)


def _boxes(shop: Workshop) -> World:
    rng = shop.rng
    floor, depth = -_u(rng, 1.2, 1.5), _u(rng, 4.2, 5.2)
    make.room(shop, floor_z=floor, depth_m=depth, half_width_m=_u(rng, 2.9, 3.4), height_m=_u(rng, 2.7, 3.0))
    _decorate(shop, depth, floor, count=5)
    y = -1.9
    while y < 1.9:
        width = _u(rng, 0.35, 0.75)
        make.stack(shop, Placement(_u(rng, 2.7, depth - 0.7), y + width / 2, floor), width, _u(rng, 0.7, 2.0))
        y += width + _u(rng, 0.0, 0.14)
    for _ in range(4):
        here = Placement(_u(rng, 2.2, 2.7), _u(rng, -1.1, 1.1), floor)
        top = _u(rng, 0.4, 0.75)
        if rng.random() < 0.6:
            make.stack(shop, here, _u(rng, 0.3, 0.5), top)
        else:
            make.bin_or_drum(shop, here, _u(rng, 0.15, 0.24), top)
    return _finish(shop, depth, floor, focus_m=3.4)


def _desk(shop: Workshop) -> World:
    rng, p = shop.rng, shop.printer
    floor, depth = -_u(rng, 1.2, 1.4), _u(rng, 3.5, 4.2)
    make.room(shop, floor_z=floor, depth_m=depth, half_width_m=_u(rng, 2.6, 3.1), height_m=_u(rng, 2.6, 2.9))
    _decorate(shop, depth, floor, count=6)
    width = _u(rng, 1.9, 2.4)
    top = make.desk(
        shop, Placement(depth - 0.9, _u(rng, -0.15, 0.15), floor, _u(rng, -0.12, 0.12)), width_m=width, depth_m=0.9
    )
    screens = int(rng.integers(1, 3))
    for k in range(screens):
        y = (k - (screens - 1) / 2) * 0.72 + _u(rng, -0.06, 0.06)
        make.monitor(shop, top.on(0.18, y, 0, -y * 0.3 + _u(rng, -0.1, 0.1)))
    make.keyboard(shop, top.on(-0.22, _u(rng, -0.1, 0.1), 0, _u(rng, -0.1, 0.1)))
    side = float(rng.choice([-1.0, 1.0]))
    make.lamp(shop, top.on(0.15, side * (width / 2 - 0.2), 0, _u(rng, -0.4, 0.4)))
    make.books(shop, top.on(0.1, -side * (width / 2 - 0.3), 0, _u(rng, -0.1, 0.1)), 0.42, tallest_m=0.28)
    make.plant(shop, top.on(0.28, -side * (width / 2 - 0.62), 0), _u(rng, 0.25, 0.4))
    make.clutter(shop, top.on(-0.08, 0, 0), width_m=width, depth_m=0.8, count=9)
    shelf = Placement(depth - 0.26, _u(rng, -0.9, 0.9), floor + _u(rng, 1.55, 1.7))
    shop.builder.box(shelf, (0.26, 1.3, 0.025), p.wood(1.3, 0.26))
    make.books(shop, shelf.on(-0.12, 0.25, 0.025), 0.75, tallest_m=0.3)
    make.ornament(shop, shelf.on(0, -0.38, 0.025), 0.35, 0.3)
    make.chair(shop, Placement(depth - 1.5, side * _u(rng, 0.3, 0.8), floor, np.pi + _u(rng, -1.2, 1.2)))
    make.cabinet(
        shop, Placement(depth - 0.4, side * -(width / 2 + 0.45), floor), width_m=0.6, height_m=_u(rng, 0.7, 1.2)
    )
    make.bin_or_drum(shop, Placement(depth - 0.6, side * (width / 2 + 0.3), floor), 0.15, 0.36)
    return _finish(shop, depth, floor, focus_m=depth - 0.9)


def _office(shop: Workshop) -> World:
    rng = shop.rng
    floor, depth = -_u(rng, 1.25, 1.55), _u(rng, 4.4, 5.4)
    make.room(shop, floor_z=floor, depth_m=depth, half_width_m=_u(rng, 2.9, 3.4), height_m=_u(rng, 2.6, 2.9))
    _decorate(shop, depth, floor, count=5)
    y = _u(rng, -2.3, -1.9)
    while y < 2.0:
        width, kind = _u(rng, 0.8, 1.4), rng.random()
        middle = y + width / 2
        if kind < 0.6:
            make.bookcase(shop, Placement(depth - 0.32, middle, floor), width_m=width, height_m=_u(rng, 1.5, 2.3))
        elif kind < 0.8:
            top = make.cabinet(
                shop, Placement(depth - 0.25, middle, floor), width_m=width * 0.8, height_m=_u(rng, 0.8, 1.3)
            )
            make.clutter(shop, top, width_m=width * 0.75, depth_m=0.35, count=3)
        y += width + _u(rng, 0.02, 0.25)
    for side in (-1, 1):
        at = Placement(_u(rng, 2.7, 3.3), side * _u(rng, 0.85, 1.15), floor, side * _u(rng, -0.1, 0.35))
        width = _u(rng, 1.1, 1.4)
        top = make.desk(shop, at, width_m=width)
        make.monitor(shop, top.on(0.15, _u(rng, -0.2, 0.2), 0, _u(rng, -0.4, 0.4)))
        make.keyboard(shop, top.on(-0.2, _u(rng, -0.1, 0.1), 0, _u(rng, -0.2, 0.2)))
        make.clutter(shop, top, width_m=width, depth_m=0.7, count=6)
        if rng.random() < 0.5:
            make.lamp(shop, top.on(0.1, side * (width / 2 - 0.15), 0))
    make.chair(shop, Placement(_u(rng, 2.3, 3.4), _u(rng, -0.3, 0.3), floor, _u(rng, 0, 6)))
    for side in (-1, 1):
        here = Placement(_u(rng, 3.6, 4.0), side * _u(rng, 0.2, 0.5), floor)
        choice = int(rng.integers(3))
        if choice == 0:
            make.plant(shop, here, _u(rng, 0.8, 1.3))
        elif choice == 1:
            make.stack(shop, here, _u(rng, 0.35, 0.5), _u(rng, 0.5, 1.1))
        else:
            make.bin_or_drum(shop, here, 0.17, _u(rng, 0.4, 0.6))
    return _finish(shop, depth, floor, focus_m=3.6)


def _people(shop: Workshop) -> World:
    rng = shop.rng
    floor, depth = -_u(rng, 1.3, 1.6), _u(rng, 4.6, 5.6)
    make.room(shop, floor_z=floor, depth_m=depth, half_width_m=_u(rng, 2.9, 3.4), height_m=_u(rng, 2.6, 2.9))
    _decorate(shop, depth, floor, count=5)
    for y in (-1.7, 1.5):
        make.bookcase(
            shop,
            Placement(depth - 0.32, y + _u(rng, -0.2, 0.2), floor),
            width_m=_u(rng, 0.8, 1.3),
            height_m=_u(rng, 1.4, 2.1),
        )
    top = make.desk(shop, Placement(depth - 0.7, _u(rng, -0.3, 0.3), floor), width_m=1.5)
    make.clutter(shop, top, width_m=1.5, depth_m=0.7, count=7)
    count = int(rng.integers(3, 5))
    for k in range(count):
        y = ((k + 0.5) / count - 0.5) * 3.2 + _u(rng, -0.12, 0.12)
        turn = -float(np.arctan2(-y, 3)) * 0.5 + _u(rng, -0.7, 0.7)
        make.person(shop, Placement(_u(rng, 2.7, 3.6), y, floor, turn), height_m=_u(rng, 1.55, 1.9))
    make.chair(shop, Placement(_u(rng, 3.4, 3.9), _u(rng, -0.9, 0.9), floor, _u(rng, 0, 6)))
    make.stack(shop, Placement(_u(rng, 2.6, 3.2), float(rng.choice([-1.9, 1.9])), floor), 0.45, _u(rng, 0.6, 1.1))
    return _finish(shop, depth, floor, focus_m=3.4)


def _decorate(shop: Workshop, depth_m: float, floor_z: float, *, count: int) -> None:
    """Hang posters, boards, a window or a door on the far wall."""
    rng, p = shop.rng, shop.printer
    edges = np.linspace(-2.6, 2.6, count + 1)
    for left, right in pairwise(edges):
        slot = float(right - left)
        middle = float(left + right) / 2 + _u(rng, -0.06, 0.06)
        kind = rng.random()
        if kind < 0.15 and slot > 0.8:
            at, w, h = Placement(depth_m, middle, floor_z), 0.85, 2.05
            texture = p.door(w, h)
        elif kind < 0.35:
            w, h = slot * 0.85, _u(rng, 0.8, 1.2)
            at, texture = Placement(depth_m, middle, floor_z + _u(rng, 0.95, 1.3)), p.window(w, h)
        elif kind < 0.5:
            w, h = slot * 0.85, _u(rng, 0.5, 0.8)
            at, texture = Placement(depth_m, middle, floor_z + _u(rng, 1.2, 1.5)), p.pinboard(w, h)
        else:
            w, h = slot * _u(rng, 0.5, 0.8), _u(rng, 0.6, 1.0)
            at, texture = Placement(depth_m, middle, floor_z + _u(rng, 1.2, 1.6)), p.poster(w, h)
        # A sheet of 5 to 20 mm: its edge casts a thin shadow, unlike paint.
        thick = _u(rng, 0.005, 0.02)
        shop.builder.box(at.on(-thick / 2, 0, 0), (thick, w, h), p.plain(p.inks.muted()), front=texture)


def _finish(shop: Workshop, depth_m: float, floor_z: float, *, focus_m: float) -> World:
    rng = shop.rng
    if shop.heated:
        make.heating(shop, depth_m=depth_m, floor_z=floor_z, half_width_m=2.8)
    ceiling = floor_z + 2.45
    side = float(rng.choice([-1.0, 1.0]))
    lights = [
        (_u(rng, 0.2, 1.2), side * _u(rng, 1.2, 2.2), ceiling - _u(rng, 0, 0.4)),
        (_u(rng, 0.8, depth_m * 0.6), -side * _u(rng, 0.5, 1.8), ceiling - _u(rng, 0, 0.2)),
    ]
    return shop.builder.finish(focus_m=focus_m, lights=lights)


def _u(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(low, high))


SCENES: dict[str, Callable[[Workshop], World]] = {"boxes": _boxes, "desk": _desk, "office": _office, "people": _people}
"""The scenes by name."""
