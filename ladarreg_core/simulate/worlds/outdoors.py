"""Places outdoors, different for every seed: buildings, poles, cars, trees and people up to 120 m away, under the sun.

The scanner stands at the origin, `EYE_M` above the ground; x points along the street.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from ladarreg_core.simulate.worlds import furniture as make
from ladarreg_core.simulate.worlds.furniture import Workshop
from ladarreg_core.simulate.worlds.materials import InkMixer
from ladarreg_core.simulate.worlds.textures import Printer
from ladarreg_core.simulate.worlds.world import Placement, Texture, World, WorldBuilder

EYE_M = 1.8
"""Height of the scanner above the ground."""

_FACADE_PITCH_M, _GROUND_PITCH_M, _SKY_PITCH_M = 0.03, 0.08, 4.0
_SUN_M, _SKY_M, _SKY_TOP_M = 500.0, 900.0, 700.0
_GROUND_M = 160.0
_STOREY_M = 3.1
_LEAVES = 240  # of a tree
_FACES_SUN = 0.6  # `take_photograph`: a light has its full strength at this share of the focus


def build_outdoors(scene: str, *, layout: np.random.Generator, people: Sequence[Placement] = ()) -> World:
    """Return the world of a place; in half of the places laser albedo and visible colour are unrelated.

    Args:
        scene: a name in `OUTDOORS`.
        layout: random generator of the whole place.
        people: where further people stand; the rest of the place does not depend on them.
    """
    inks = InkMixer(layout, independent=bool(layout.random() < 0.5))
    shop = Workshop(WorldBuilder(), Printer(layout, inks))
    _sky(shop)
    OUTDOORS[scene](shop)
    bearing, height = _u(layout, -2.6, 2.6), _u(layout, 0.45, 1.1)
    for at in people:
        make.person(shop, at, height_m=1.75)
    sun = np.array([np.cos(bearing) * np.cos(height), np.sin(bearing) * np.cos(height), np.sin(height)])
    return shop.builder.finish(focus_m=_SUN_M / _FACES_SUN, lights=[_SUN_M * sun])


def _street(shop: Workshop) -> None:
    rng = shop.rng
    along = _u(rng, -0.2, 0.2)
    middle = Placement(0.0, _u(rng, -3.0, 3.0), -EYE_M, along)
    _ground(shop)
    road = _u(rng, 6.0, 9.0)
    _road(shop, middle, road)
    for side in (-1, 1):
        edge = road / 2 + _u(rng, 2.5, 6.0)
        shop.builder.box(
            middle.on(0, side * (road / 2 + edge) / 2, 0),
            (2 * _GROUND_M, edge - road / 2, 0.13),
            shop.printer.plain(shop.printer.inks.muted()),
        )
        x = _u(rng, -70.0, -55.0)
        while x < 100.0:
            width, deep = _u(rng, 8.0, 20.0), _u(rng, 8.0, 14.0)
            face = side * (edge + _u(rng, 0.0, 3.0) + deep / 2)
            if rng.random() < 0.85:
                at = middle.on(x + width / 2, face, 0, side * np.pi / 2 + _u(rng, -0.04, 0.04))
                _building(shop, at, width, deep, storeys=int(rng.integers(1, 6)))
            x += width + (0.0 if rng.random() < 0.5 else _u(rng, 1.0, 7.0))
        x = _u(rng, -45.0, -38.0)
        while x < 70.0:
            here = middle.on(x, side * (road / 2 + _u(rng, 0.5, 1.2)), 0.13)
            kind = rng.random()
            if kind < 0.35:
                _tree(shop, here)
            elif kind < 0.6:
                _lamp_post(shop, here)
            elif kind < 0.75:
                _sign(shop, here)
            elif abs(x) > 6.0:
                make.person(shop, here.on(0, side * _u(rng, 0.5, 2), 0, _u(rng, 0, 6)), height_m=_u(rng, 1.55, 1.9))
            x += _u(rng, 4.0, 12.0)
        x = _u(rng, -40.0, -35.0)
        while x < 60.0:
            if rng.random() < 0.6 and abs(x) > 5.5:
                facing = 0.0 if side < 0 else np.pi
                _car(shop, middle.on(x, side * (road / 2 - 1.1), 0, facing + _u(rng, -0.04, 0.04)))
            x += _u(rng, 5.5, 11.0)
    _building(shop, middle.on(_u(rng, 104.0, 115.0), 0, 0), 40.0, 10.0, storeys=int(rng.integers(3, 8)))


def _courtyard(shop: Workshop) -> None:
    rng = shop.rng
    _ground(shop)
    bearing, first = 0.0, _u(rng, 0.0, 6.0)
    while bearing < 6.0:
        distance = _u(rng, 14.0, 60.0)
        width = min(_u(rng, 0.4, 0.8) * distance, 30.0)
        angle = first + bearing
        at = Placement(distance * np.cos(angle), distance * np.sin(angle), -EYE_M, angle + _u(rng, -0.5, 0.5))
        _building(shop, at.on(6.0, 0, 0), width, _u(rng, 8.0, 12.0), storeys=int(rng.integers(1, 5)))
        bearing += width / distance + _u(rng, 0.0, 0.25)
    kinds: tuple[Callable[[Workshop, Placement], None], ...] = (_tree, _lamp_post, _sign, _car, _bench, _bush)
    for _ in range(60):
        angle, distance = _u(rng, 0.0, 2 * np.pi), _u(rng, 5.0, 30.0)
        at = Placement(distance * np.cos(angle), distance * np.sin(angle), -EYE_M, _u(rng, 0.0, 6.0))
        kinds[int(rng.integers(len(kinds)))](shop, at)
    for _ in range(4):
        angle, distance = _u(rng, 0.0, 2 * np.pi), _u(rng, 5.0, 18.0)
        at = Placement(distance * np.cos(angle), distance * np.sin(angle), -EYE_M, _u(rng, 0.0, 6.0))
        make.person(shop, at, height_m=_u(rng, 1.55, 1.9))


OUTDOORS: dict[str, Callable[[Workshop], None]] = {"street": _street, "courtyard": _courtyard}
"""The places by name."""


# -- sky and ground --------------------------------------------------------------------------------------------


def _sky(shop: Workshop) -> None:
    """Add a glowing sky with clouds, which returns nothing to a laser."""
    rng = shop.rng
    width, height = round(2 * np.pi * _SKY_M / _SKY_PITCH_M), round(_SKY_TOP_M / _SKY_PITCH_M)
    soft = rng.standard_normal((9, 18), dtype=np.float32), rng.standard_normal((24, 60), dtype=np.float32)
    cover = sum(
        cv2.resize(f, (width, height), interpolation=cv2.INTER_CUBIC) * s for f, s in zip(soft, (1, 0.5), strict=True)
    )
    white = np.clip(cover - _u(rng, -0.3, 0.8), 0, 1)[..., None]
    blue = np.array([120.0, 165.0, 225.0])
    picture = np.zeros((height, width, 4), np.uint8)
    picture[..., :3] = np.rint(blue + (np.array([245.0, 246.0, 250.0]) - blue) * white)
    texture = Texture(picture, glow=0.9)
    low = -30.0
    profile = [(0.0, _SKY_M), (_SKY_TOP_M, _SKY_M), (_SKY_TOP_M, 1.0)]
    shop.builder.lathe((0, 0, low), (0, 0, low + _SKY_TOP_M), profile, texture, front=(1.0, 0.0, 0.0))


def _ground(shop: Workshop) -> None:
    p = shop.printer
    grass = p.grain(np.full((1200, 1200, 4), p.inks.of((96, 112, 66)), np.uint8), 0.12, cells=24)
    shop.paper(Placement(0, 0, -EYE_M - 0.01), 2 * _GROUND_M, 2 * _GROUND_M, Texture(grass))


def _road(shop: Workshop, at: Placement, width_m: float) -> None:
    p, rng = shop.printer, shop.rng
    length = 2 * _GROUND_M
    asphalt = p.grain(p.sheet(width_m, length, p.inks.of((70, 70, 74)), pitch_m=_GROUND_PITCH_M), 0.07)
    h, w = asphalt.shape[:2]
    paint = p.inks.of((225, 225, 220))
    dash, gap = (round(_u(rng, *span) / _GROUND_PITCH_M) for span in ((2.5, 5.0), (3.0, 8.0)))
    for top in range(0, h, dash + gap):
        asphalt[top : top + dash, w // 2 - 1 : w // 2 + 1] = paint
    asphalt[:, 3:5] = asphalt[:, w - 5 : w - 3] = paint
    if rng.random() < 0.7:  # a zebra crossing ahead
        top = h // 2 - round(_u(rng, 8.0, 20.0) / _GROUND_PITCH_M)
        for left in range(4, w - 6, 12):
            asphalt[top : top + 40, left : left + 6] = paint
    shop.paper(at.on(0, 0, 0.005), width_m, length, Texture(asphalt))


# -- buildings -------------------------------------------------------------------------------------------------


def _building(shop: Workshop, at: Placement, width_m: float, depth_m: float, *, storeys: int) -> None:
    """Add a house, its front towards the placement's -x: windows with frames, perhaps balconies, a door and a roof."""
    rng, p, b = shop.rng, shop.printer, shop.builder
    height = storeys * _STOREY_M + 0.6
    paint = (p.inks.bright, p.inks.muted, p.inks.muted, p.inks.vivid)[int(rng.integers(4))]()
    glass, frame = p.inks.of((52, 62, 74)), p.plain(p.inks.bright())
    trim = p.plain(p.inks.muted())
    columns = max(1, round(width_m / _u(rng, 2.4, 4.2)))
    wide, tall = _u(rng, 0.9, 1.5), _u(rng, 1.2, 1.8)
    balconies = rng.random() < 0.4
    front = p.grain(p.sheet(width_m, height, paint, pitch_m=_FACADE_PITCH_M), 0.05)
    if rng.random() < 0.5:  # courses of brick or panels
        course, darker = round(_u(rng, 0.3, 1.2) / _FACADE_PITCH_M), tuple(int(0.8 * v) for v in paint)
        front[::course] = darker
    for floor in range(storeys):
        for column in range(columns):
            y = ((column + 0.5) / columns - 0.5) * width_m
            z = floor * _STOREY_M + 1.1
            left, top = (width_m / 2 - y - wide / 2), height - z - tall
            x0, y0 = round(left / _FACADE_PITCH_M), round(top / _FACADE_PITCH_M)
            x1, y1 = x0 + round(wide / _FACADE_PITCH_M), y0 + round(tall / _FACADE_PITCH_M)
            front[max(y0, 0) : y1, max(x0, 0) : x1] = glass
            if rng.random() < 0.3:  # a blind
                front[max(y0, 0) : round(y0 + (y1 - y0) * _u(rng, 0.2, 0.8)), max(x0, 0) : x1] = p.inks.bright()
            here = at.on(-depth_m / 2, y, z)
            b.box(here.on(-0.06, 0, -0.1), (0.12, wide + 0.2, 0.1), frame)
            b.box(here.on(-0.04, 0, tall), (0.08, wide + 0.2, 0.12), frame)
            if balconies and floor and column % 2 == 0:
                b.box(here.on(-0.6, 0, -1.1), (1.2, wide + 1.0, 0.15), trim)
                b.box(here.on(-1.17, 0, -0.95), (0.06, wide + 1.0, 1.0), trim)
    b.box(at, (depth_m, width_m, height), p.plain(paint), front=Texture(front))
    b.box(at.on(-depth_m / 2 - 0.03, _u(rng, -0.4, 0.4) * width_m, 0), (0.06, 1.2, 2.2), p.plain(p.inks.dark()))
    b.box(at.on(0, 0, height), (depth_m + _u(rng, 0.3, 1.2), width_m + 0.5, 0.3), p.plain(p.inks.dark()))
    if rng.random() < 0.6:
        b.box(at.on(0, 0, height + 0.3), (depth_m * 0.5, width_m * 0.96, _u(rng, 1.0, 2.5)), p.plain(p.inks.muted()))
    for _ in range(int(rng.integers(0, 3))):
        b.box(at.on(_u(rng, -2, 2), _u(rng, -0.4, 0.4) * width_m, height), (0.7, 0.9, _u(rng, 1.2, 3.0)), trim)


# -- what stands about -----------------------------------------------------------------------------------------


def _tree(shop: Workshop, at: Placement) -> None:
    """Add a tree: a trunk and a crown of leaves with gaps, which neither sensor sees as a closed surface."""
    rng, p = shop.rng, shop.printer
    trunk, reach = _u(rng, 1.8, 3.5), _u(rng, 1.2, 2.6)
    wood = p.plain(p.inks.of((88, 70, 52)))
    shop.limb(at.points([0, 0, 0]), at.points([0, 0, trunk + reach]), (_u(rng, 0.1, 0.22), 0.05), wood)
    greens = [p.plain(p.inks.of((30 + k * 12, 70 + k * 20, 26 + k * 9))) for k in range(4)]
    _foliage(shop, at.points([0, 0, trunk + reach]), (reach, reach, 1.2 * reach), greens, _LEAVES)


def _bush(shop: Workshop, at: Placement) -> None:
    rng, p = shop.rng, shop.printer
    greens = [p.plain(p.inks.of((36 + k * 12, 80 + k * 16, 30 + k * 9))) for k in range(3)]
    reach = _u(rng, 0.4, 0.9)
    _foliage(shop, at.points([0, 0, reach]), (reach, _u(rng, 0.5, 1.8), reach), greens, _LEAVES // 3)


def _foliage(
    shop: Workshop, centre: np.ndarray, radii: tuple[float, float, float], greens: list[Texture], count: int
) -> None:
    rng = shop.rng
    for _ in range(count):
        place = rng.standard_normal(3)
        place *= rng.uniform(0.35, 1.0) / np.linalg.norm(place)
        right, down = rng.standard_normal((2, 3))
        right /= np.linalg.norm(right)
        down = np.cross(right, down)
        down /= np.linalg.norm(down)
        size = rng.uniform(0.18, 0.5) * min(1.0, min(radii))
        corner = centre + place * np.array(radii) - (right + down) * size / 2
        shop.builder.quad(corner, right * size, down * size, greens[int(rng.integers(len(greens)))])


def _lamp_post(shop: Workshop, at: Placement) -> None:
    rng, p = shop.rng, shop.printer
    height, steel = _u(rng, 4.0, 8.0), p.plain(p.inks.muted())
    radius = _u(rng, 0.06, 0.11)
    shop.cylinder(at, radius, height, steel, top_radius_m=0.7 * radius)
    arm = _u(rng, 0.4, 1.6)
    shop.limb(at.points([0, 0, height]), at.points([0, arm, height + 0.1]), (0.04, 0.04), steel)
    shop.builder.box(at.on(0, arm, height), (0.25, 0.6, 0.12), p.plain(p.inks.bright()))


def _sign(shop: Workshop, at: Placement) -> None:
    rng, p = shop.rng, shop.printer
    shop.cylinder(at, 0.04, 2.9, p.plain(p.inks.muted()))
    w, h = _u(rng, 0.5, 1.2), _u(rng, 0.5, 0.9)
    here = at.on(-0.06, 0, 2.9 - h, _u(rng, -0.6, 0.6))
    shop.builder.box(here, (0.02, w, h), p.plain(p.inks.muted()), front=p.poster(w, h))


def _car(shop: Workshop, at: Placement) -> None:
    """Add a car along the placement's x."""
    rng, p, b = shop.rng, shop.printer, shop.builder
    paint, glass = p.plain(p.inks.any(), gloss=0.25), p.plain(p.inks.of((40, 46, 54)), gloss=0.2)
    long, wide, tall = _u(rng, 3.9, 4.9), _u(rng, 1.65, 1.9), _u(rng, 0.65, 0.85)
    b.box(at.on(0, 0, 0.28), (long, wide, tall), paint)
    cabin = _u(rng, 0.45, 0.6)
    b.box(at.on(_u(rng, -0.1, 0.4), 0, 0.28 + tall), (0.55 * long, wide - 0.25, cabin), glass, top=paint)
    tyre = p.plain(p.inks.dark())
    for x in (-0.32 * long, 0.32 * long):
        for side in (-1, 1):
            hub = at.points([x, side * (wide / 2 - 0.12), 0.32])
            rim = at.points([x, side * (wide / 2 + 0.02), 0.32])
            b.lathe(hub, rim, [(0.0, 0.32), (0.14, 0.32), (0.14, 0.01)], tyre, sectors=16, front=(0.0, 0.0, 1.0))


def _bench(shop: Workshop, at: Placement) -> None:
    rng, p, b = shop.rng, shop.printer, shop.builder
    wood, width = p.plain(p.inks.wood()[0]), _u(rng, 1.4, 2.2)
    b.box(at.on(0, 0, 0.42), (0.5, width, 0.06), wood)
    b.box(at.on(0.24, 0, 0.55), (0.05, width, 0.4), wood)
    for side in (-1, 1):
        b.box(at.on(0, side * (width / 2 - 0.15), 0), (0.45, 0.08, 0.42), p.plain(p.inks.dark()))


def _u(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(low, high))
