"""Hard places for stations: such as look alike (equal bays, equal rooms, half turns), and rooms joined by a doorway."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.worlds import furniture as make
from ladarreg_core.simulate.worlds.furniture import Workshop
from ladarreg_core.simulate.worlds.materials import InkMixer
from ladarreg_core.simulate.worlds.textures import Printer
from ladarreg_core.simulate.worlds.world import Placement, World, WorldBuilder

Room = tuple[World, RayCaster]
_BAY_M = 2.4
_HALF_M = 14.0


def alike_corridor(seed: int) -> Room:
    """Return a corridor of 28 m with equal bays on both sides: doors, and pillars between them."""
    shop = _workshop(seed)
    rng, p, b = shop.rng, shop.printer, shop.builder
    wide, high, floor = rng.uniform(1.9, 2.6), rng.uniform(2.5, 2.9), -rng.uniform(1.2, 1.5)
    _shell(shop, _HALF_M, wide / 2, floor, high)
    door, paint = p.plain(p.inks.wood()[0]), p.plain(p.inks.bright())
    sunk, pillar = rng.uniform(0.03, 0.1), rng.uniform(0.1, 0.25)
    for x in np.arange(-5, 6) * _BAY_M:
        for side in (-1.0, 1.0):
            at = float(side * (wide / 2 - sunk / 2))
            b.box(Placement(float(x), at, floor), (0.9, sunk, 2.05), door)
            at = float(side * (wide / 2 - pillar / 2))
            b.box(Placement(float(x) + _BAY_M / 2, at, floor), (pillar, pillar, high), paint)
    return _done(shop)


def equal_rooms(seed: int) -> tuple[Room, Room]:
    """Return two rooms with the same walls and the same furniture along them, in which different things stand."""
    return _one_of_equal(seed, 1), _one_of_equal(seed, 2)


def symmetric_room(seed: int) -> Room:
    """Return a room that is the same when it is turned by half a turn."""
    shop = _workshop(seed)
    rng, p, b = shop.rng, shop.printer, shop.builder
    deep, wide, high = rng.uniform(3.0, 4.5), rng.uniform(2.2, 3.4), rng.uniform(2.5, 2.9)
    floor = -rng.uniform(1.2, 1.5)
    _shell(shop, deep, wide, floor, high)
    wood, paint = p.plain(p.inks.wood()[0]), p.plain(p.inks.bright())
    x, y, turn = rng.uniform(0.5, deep - 1.0), wide - 0.3, rng.uniform(0, 0.4)
    for sign in (1.0, -1.0):
        b.box(Placement(float(sign * x), float(sign * y), floor, 0.0), (1.2, 0.5, 1.4), wood)
        b.box(Placement(float(sign * (deep - 0.7)), float(-sign * 0.8), floor, float(turn)), (0.6, 0.9, 0.75), paint)
    return _done(shop)


def rooms_with_doorway(seed: int) -> Room:
    """Return two rooms on either side of X = 0 with a doorway around the X axis, through which each sees the other."""
    shop = _workshop(seed)
    rng, p, b = shop.rng, shop.printer, shop.builder
    high, floor, tall = rng.uniform(2.5, 2.9), -rng.uniform(1.2, 1.5), 2.05
    deep, wide, aside = rng.uniform(4.0, 6.0, 2), rng.uniform(3.6, 5.5, 2), rng.uniform(-0.5, 0.5, 2)
    thick, gap = rng.uniform(0.1, 0.25), rng.uniform(0.9, 1.4)
    paint, ground = p.plain(p.inks.bright()), p.plain(p.inks.muted())
    for sign, length, width, middle in zip((-1.0, 1.0), deep, wide, aside, strict=True):
        near, far = sign * thick / 2, sign * (thick / 2 + length)
        low, top, half = min(near, far), max(near, far), (near + far) / 2
        shop.panel(Placement(far, middle, floor, 0.0 if sign > 0 else np.pi), width, high, paint)
        for side in (-1.0, 1.0):
            shop.panel(Placement(half, middle + side * width / 2, floor, side * np.pi / 2), length, high, paint)
        b.quad((top, middle + width / 2, floor), (0, -width, 0), (low - top, 0, 0), ground)
        b.quad((low, middle + width / 2, floor + high), (0, -width, 0), (top - low, 0, 0), paint)
        at = Placement(far - sign * 0.3, middle + rng.uniform(-0.5, 0.5), floor, 0.0 if sign > 0 else np.pi)
        make.bookcase(shop, at, width_m=1.4, height_m=1.9)
        make.desk(shop, Placement(half, middle - width / 2 + 0.5, floor, -np.pi / 2), width_m=1.5)
        for _ in range(3):
            away, across = rng.uniform(0.8, length - 0.6), rng.choice([-1, 1]) * rng.uniform(0.9, width / 2 - 0.4)
            make.stack(shop, Placement(near + sign * away, middle + across, floor, float(rng.uniform(0, 6))), 0.4, 0.9)
    reach = float(np.max(np.abs(aside) + wide / 2)) - gap / 2
    for side in (-1.0, 1.0):
        b.box(Placement(0.0, side * (gap / 2 + reach / 2), floor), (thick, reach, high), paint)
    b.box(Placement(0.0, 0.0, floor + tall), (thick, gap, high - tall), paint)
    b.box(Placement(0.0, 0.0, floor - 0.02), (thick, gap, 0.02), ground)
    return _done(shop)


def _one_of_equal(seed: int, which: int) -> Room:
    shop = _workshop(seed)
    rng = shop.rng
    deep, wide, high = rng.uniform(3.2, 4.2), rng.uniform(2.6, 3.4), rng.uniform(2.5, 2.9)
    floor = -rng.uniform(1.2, 1.5)
    _shell(shop, deep, wide, floor, high)
    for x, y, yaw, width in (
        (deep - 0.3, 0.4, 0.0, 1.8), (-0.6, wide - 0.3, np.pi / 2, 1.4), (-deep + 0.3, -0.7, np.pi, 1.2),
    ):  # fmt: skip
        make.bookcase(shop, Placement(float(x), float(y), floor, float(yaw)), width_m=width, height_m=1.9)
    make.desk(shop, Placement(0.8, float(-wide + 0.5), floor, -np.pi / 2), width_m=1.5)
    # From here on the rooms differ: what people brought.
    own = np.random.default_rng([seed, which, 7])
    other = replace(shop, printer=Printer(own, InkMixer(own)))
    for k in range(5):
        bearing, away = 2 * np.pi * (k + own.uniform(-0.3, 0.3)) / 5, own.uniform(1.6, 2.2)
        at = Placement(float(away * np.cos(bearing)), float(away * np.sin(bearing)), floor, float(own.uniform(0, 6)))
        (make.chair, lambda s, a: make.stack(s, a, 0.4, 0.9), lambda s, a: make.bin_or_drum(s, a, 0.2, 0.7))[
            int(own.integers(3))
        ](other, at)
    return _done(shop)


def _workshop(seed: int) -> Workshop:
    layout = np.random.default_rng([20_119, seed])
    return Workshop(WorldBuilder(), Printer(layout, InkMixer(layout)))


def _shell(shop: Workshop, deep: float, wide: float, floor: float, high: float) -> None:
    """Add walls, floor and ceiling of a room of 2 deep by 2 wide around the origin."""
    b, p = shop.builder, shop.printer
    paint = p.plain(p.inks.bright())
    for at, width in (
        (Placement(deep, 0.0, floor, 0.0), 2 * wide), (Placement(0.0, wide, floor, np.pi / 2), 2 * deep),
        (Placement(-deep, 0.0, floor, np.pi), 2 * wide), (Placement(0.0, -wide, floor, -np.pi / 2), 2 * deep),
    ):  # fmt: skip
        shop.panel(at, width, high, paint)
    b.quad((deep, wide, floor), (0, -2 * wide, 0), (-2 * deep, 0, 0), p.plain(p.inks.muted()))
    b.quad((-deep, wide, floor + high), (0, -2 * wide, 0), (2 * deep, 0, 0), p.plain(p.inks.bright()))


def _done(shop: Workshop) -> Room:
    world = shop.builder.finish(focus_m=4.5, lights=[(0.5, 0.4, 1.0)])
    return world, RayCaster(world.triangles)
