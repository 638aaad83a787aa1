"""Rooms that are furnished and printed on all sides, different for every seed: for scanners that turn.

The scanner stands at the origin, off the middle of the room, and no two walls are alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from ladarreg_core.simulate.worlds import furniture as make
from ladarreg_core.simulate.worlds.furniture import Workshop
from ladarreg_core.simulate.worlds.world import Placement, Texture, World

_CORNER_M = 0.95  # of each wall's ends, kept free for what stands in the corners
_BAY_M = 2.4  # between the doors of a corridor
_COLUMN_M, _AISLE_M = 6.0, 4.5  # between the columns of a hall, and the width that is free along its middle


@dataclass(frozen=True)
class _Wall:
    """A wall: the placement of the middle of its foot, its front towards the room, and its width."""

    at: Placement
    width_m: float


@dataclass(frozen=True)
class _Room:
    """A rectangular room around the scanner, m."""

    ahead: float
    behind: float
    left: float
    right: float
    floor_z: float
    height: float

    @property
    def walls(self) -> tuple[_Wall, _Wall, _Wall, _Wall]:
        """The walls ahead, to the left, behind and to the right."""
        x, y = (self.ahead - self.behind) / 2, (self.left - self.right) / 2
        deep, wide, z = self.ahead + self.behind, self.left + self.right, self.floor_z
        return (
            _Wall(Placement(self.ahead, y, z, 0.0), wide),
            _Wall(Placement(x, self.left, z, np.pi / 2), deep),
            _Wall(Placement(-self.behind, y, z, np.pi), wide),
            _Wall(Placement(x, -self.right, z, -np.pi / 2), deep),
        )


# -- shell -----------------------------------------------------------------------------------------------------


def _shell(shop: Workshop, room: _Room, *, bare: bool = False) -> None:
    """Add floor, ceiling, walls and skirting boards."""
    b, p = shop.builder, shop.printer
    deep, wide, top = room.ahead + room.behind, room.left + room.right, room.floor_z + room.height
    board = p.plain(p.inks.wood()[1])
    for wall in room.walls:
        texture = p.plain(p.inks.bright()) if bare else p.wall(wall.width_m, room.height)
        shop.panel(wall.at, wall.width_m, room.height, texture)
        b.box(wall.at.on(-0.01, 0, 0), (0.02, wall.width_m, 0.09), board)
    ground = p.plain(p.inks.muted()) if bare else p.floor(wide, deep)
    b.quad((room.ahead, room.left, room.floor_z), (0, -wide, 0), (-deep, 0, 0), ground)
    b.quad((-room.behind, room.left, top), (0, -wide, 0), (deep, 0, 0), p.plain(p.inks.bright()))


def _ceiling(shop: Workshop, room: _Room) -> None:
    """Add a beam, a duct and lamps under the ceiling."""
    rng, p, b = shop.rng, shop.printer, shop.builder
    top = room.floor_z + room.height
    deep, wide = room.ahead + room.behind, room.left + room.right
    x, y = (room.ahead - room.behind) / 2, (room.left - room.right) / 2
    h = _u(rng, 0.12, 0.25)
    b.box(
        Placement(_u(rng, -0.6, 0.6) * room.behind, y, top - h),
        (_u(rng, 0.12, 0.25), wide, h),
        p.plain(p.inks.wood()[0]),
    )
    duct = _u(rng, 0.6, 0.85) * (room.left if rng.random() < 0.5 else -room.right)
    steel, r = p.plain(p.inks.muted(), metal=0.3), _u(rng, 0.08, 0.16)
    shop.limb((x - deep / 2 + r, duct, top - r - 0.04), (x + deep / 2 - r, duct, top - r - 0.04), (r, r), steel)
    for _ in range(int(rng.integers(3, 6))):
        at = Placement(
            _u(rng, -0.8, 0.8) * room.behind, _u(rng, -0.8, 0.8) * room.right, top - 0.09, _u(rng, 0.0, np.pi)
        )
        shade = p.plain(p.inks.bright(), glow=0.4)
        b.box(at, (0.16, _u(rng, 0.6, 1.3), 0.07), p.plain(p.inks.bright()), bottom=shade)


# -- on and along the walls ------------------------------------------------------------------------------------


def _hang(shop: Workshop, wall: _Wall, *, doors: float = 0.15) -> None:
    """Hang posters, boards, windows and doors on a wall."""
    rng, p = shop.rng, shop.printer
    count = max(2, round(wall.width_m / _u(rng, 0.95, 1.3)))
    slot = wall.width_m / count
    for k in range(count):
        y = (k + 0.5) * slot - wall.width_m / 2 + _u(rng, -0.06, 0.06)
        kind = rng.random()
        if kind < doors:
            w, h, z, texture = 0.85, 2.05, 0.0, p.door(0.85, 2.05)
        elif kind < doors + 0.15:
            w, h, z = slot * 0.8, _u(rng, 0.8, 1.2), _u(rng, 0.95, 1.3)
            texture = p.window(w, h)
        elif kind < doors + 0.3:
            w, h, z = slot * 0.8, _u(rng, 0.5, 0.8), _u(rng, 1.2, 1.5)
            texture = p.pinboard(w, h)
        elif kind < 0.92:
            w, h, z = slot * _u(rng, 0.5, 0.8), _u(rng, 0.6, 1.0), _u(rng, 1.15, 1.6)
            texture = p.poster(w, h)
        else:
            continue
        _sheet(shop, wall.at.on(0, y, z), w, h, texture)


def _sheet(shop: Workshop, at: Placement, width_m: float, height_m: float, texture: Texture) -> None:
    """Fix a sheet of 5 to 20 mm on a wall: its edge casts a thin shadow, unlike paint."""
    thick, p = _u(shop.rng, 0.005, 0.02), shop.printer
    shop.builder.box(at.on(-thick / 2, 0, 0), (thick, width_m, height_m), p.plain(p.inks.muted()), front=texture)


Maker = Callable[[Workshop, Placement, float], None]
"""Furnishes a stretch of wall: the placement of the middle of its foot, and its width, m."""


def _bookcase(shop: Workshop, foot: Placement, width_m: float) -> None:
    make.bookcase(shop, foot.on(-0.33, 0, 0), width_m=width_m * 0.95, height_m=_u(shop.rng, 1.3, 2.3))


def _cabinet(shop: Workshop, foot: Placement, width_m: float) -> None:
    top = make.cabinet(shop, foot.on(-0.24, 0, 0), width_m=width_m * 0.85, height_m=_u(shop.rng, 0.7, 1.3))
    make.clutter(shop, top, width_m=width_m * 0.8, depth_m=0.35, count=3)


def _workplace(shop: Workshop, foot: Placement, width_m: float) -> None:
    rng = shop.rng
    top = make.desk(shop, foot.on(-0.44, 0, 0, _u(rng, -0.05, 0.05)), width_m=width_m * 0.95)
    make.monitor(shop, top.on(0.16, _u(rng, -0.2, 0.2), 0, _u(rng, -0.3, 0.3)))
    make.keyboard(shop, top.on(-0.2, _u(rng, -0.1, 0.1), 0, _u(rng, -0.2, 0.2)))
    make.clutter(shop, top, width_m=width_m * 0.95, depth_m=0.7, count=4)
    if rng.random() < 0.5:
        make.lamp(shop, top.on(0.12, float(rng.choice([-1.0, 1.0])) * (width_m / 2 - 0.22), 0))


def _cartons(shop: Workshop, foot: Placement, width_m: float) -> None:
    rng = shop.rng
    y = -width_m / 2
    while y < width_m / 2 - 0.3:
        w = _u(rng, 0.35, 0.7)
        make.stack(shop, foot.on(-0.4, y + w / 2, 0), w, _u(rng, 0.5, 1.9))
        y += w + _u(rng, 0.0, 0.1)


def _drums(shop: Workshop, foot: Placement, width_m: float) -> None:
    rng = shop.rng
    for y in np.linspace(-0.4, 0.4, int(rng.integers(1, 4))) * width_m:
        make.bin_or_drum(shop, foot.on(-0.4, float(y), 0), _u(rng, 0.14, 0.26), _u(rng, 0.4, 1.0))


def _shelf(shop: Workshop, foot: Placement, width_m: float) -> None:
    """Put up a board with books, above something low."""
    rng, p = shop.rng, shop.printer
    board = foot.on(-0.14, 0, _u(rng, 1.4, 1.75))
    shop.builder.box(board, (0.26, width_m * 0.9, 0.025), p.wood(width_m * 0.9, 0.26))
    make.books(shop, board.on(-0.12, 0.15 * width_m, 0.025), width_m * 0.5, tallest_m=0.3)
    make.ornament(shop, board.on(0, -0.28 * width_m, 0.025), 0.3 * width_m, 0.28)
    make.bin_or_drum(shop, foot.on(-0.3, _u(rng, -0.3, 0.3) * width_m, 0), 0.16, _u(rng, 0.3, 0.6))


def _someone(shop: Workshop, foot: Placement, width_m: float) -> None:
    rng = shop.rng
    turn = _u(rng, -0.8, 0.8)
    make.person(shop, foot.on(-0.5, _u(rng, -0.2, 0.2) * width_m, 0, turn), height_m=_u(rng, 1.5, 1.92))


def _nothing(shop: Workshop, foot: Placement, width_m: float) -> None:
    """Leave a gap."""


def _line(shop: Workshop, wall: _Wall, kinds: Mapping[Maker, float]) -> None:
    """Furnish a wall from one corner to the other, by weights."""
    rng = shop.rng
    makers, weights = list(kinds), np.array(list(kinds.values()))
    y = -wall.width_m / 2 + _CORNER_M
    while (left := wall.width_m / 2 - _CORNER_M - y) > 0.6:
        width = min(_u(rng, 0.9, 1.5), left)
        makers[int(rng.choice(len(makers), p=weights / weights.sum()))](shop, wall.at.on(0, y + width / 2, 0), width)
        y += width + _u(rng, 0.05, 0.3)


def _corners(shop: Workshop, room: _Room) -> None:
    """Put something into most corners."""
    for x, y in (
        (room.ahead, room.left),
        (-room.behind, room.left),
        (-room.behind, -room.right),
        (room.ahead, -room.right),
    ):
        at = Placement(x - 0.42 * np.sign(x), y - 0.42 * np.sign(y), room.floor_z, float(np.arctan2(y, x)))
        _one_of(shop, at, share=0.8)


def _amid(shop: Workshop, room: _Room, count: int, *, people: float = 0.0) -> None:
    """Put furniture around the scanner, between it and the walls, in every direction but one."""
    rng = shop.rng
    first = _u(rng, 0, 2 * np.pi)
    for k in range(count):
        bearing = first + 2 * np.pi * (k + _u(rng, -0.2, 0.2)) / (count + 1)
        away = _u(rng, 1.7, 2.2)
        facing = bearing + _u(rng, -0.5, 0.5)
        at = Placement(float(away * np.cos(bearing)), float(away * np.sin(bearing)), room.floor_z, facing)
        kind = rng.random()
        if kind < people:
            make.person(shop, at, height_m=_u(rng, 1.55, 1.9))
        elif kind < people + 0.3 * (1 - people):
            top = make.desk(shop, at, width_m=_u(rng, 0.9, 1.3), depth_m=0.6)
            make.monitor(shop, top.on(0.12, _u(rng, -0.15, 0.15), 0, _u(rng, -0.4, 0.4)))
            make.clutter(shop, top, width_m=0.9, depth_m=0.55, count=4)
        else:
            _one_of(shop, at)


def _one_of(shop: Workshop, at: Placement, *, share: float = 1.0) -> None:
    rng = shop.rng
    if rng.random() > share:
        return
    kind = int(rng.integers(4))
    if kind == 0:
        make.plant(shop, at, _u(rng, 0.7, 1.3))
    elif kind == 1:
        make.stack(shop, at, _u(rng, 0.35, 0.6), _u(rng, 0.5, 1.3))
    elif kind == 2:
        make.chair(shop, Placement(at.x, at.y, at.z, _u(rng, 0, 6)))
    else:
        make.bin_or_drum(shop, at, _u(rng, 0.15, 0.24), _u(rng, 0.4, 0.8))


# -- the rooms -------------------------------------------------------------------------------------------------


def _furnished(kinds: Mapping[Maker, float], *, amid: int, people: float = 0.0) -> Callable[[Workshop], World]:
    def build(shop: Workshop) -> World:
        rng = shop.rng
        room = _Room(
            ahead=_u(rng, 3.7, 4.8),
            behind=_u(rng, 3.0, 3.8),
            left=_u(rng, 3.3, 4.2),
            right=_u(rng, 2.8, 3.4),
            floor_z=-_u(rng, 1.2, 1.5),
            height=_u(rng, 2.6, 3.0),
        )
        _shell(shop, room)
        _ceiling(shop, room)
        for wall in room.walls:
            _hang(shop, wall)
            _line(shop, wall, kinds)
        _corners(shop, room)
        _amid(shop, room, amid, people=people)
        return _finish(shop, room)

    return build


def _plain(shop: Workshop) -> World:
    """A bare room: large even surfaces, few things and little print, yet unlike in every direction."""
    rng, p, b = shop.rng, shop.printer, shop.builder
    room = _Room(
        ahead=_u(rng, 3.6, 5.0),
        behind=_u(rng, 2.4, 3.2),
        left=_u(rng, 3.2, 4.2),
        right=_u(rng, 2.0, 2.8),
        floor_z=-_u(rng, 1.2, 1.5),
        height=_u(rng, 2.6, 3.0),
    )
    _shell(shop, room, bare=True)
    _ceiling(shop, room)
    kinds: tuple[Maker, ...] = (_cabinet, _cartons, _workplace, _bookcase)
    paint = p.plain(p.inks.bright())
    for wall, kind in zip(room.walls, rng.permutation(len(kinds)), strict=True):
        middle = float(_u(rng, 0.1, 0.25) * wall.width_m * rng.choice([-1.0, 1.0]))
        side = float(np.sign(middle))
        _sheet(shop, wall.at.on(0, middle, 0), 0.85, 2.05, p.door(0.85, 2.05))
        kinds[kind](shop, wall.at.on(0, middle - side * _u(rng, 1.3, 1.6), 0), _u(rng, 0.8, 1.2))
        if wall.at.yaw_rad == np.pi:  # a boxed-in corner
            b.box(wall.at.on(-0.15, side * (wall.width_m / 2 - 0.3), 0), (0.3, 0.6, room.height), paint)
    b.box(Placement(_u(rng, 1.8, 2.4), _u(rng, 1.4, 2.2), room.floor_z), (0.3, 0.3, room.height), paint)  # a pillar
    return _finish(shop, room)


def _corridor(shop: Workshop) -> World:
    """A corridor whose bays look alike, ahead and behind, left and right: only a few notices and bins differ."""
    rng, p = shop.rng, shop.printer
    half, width = _u(rng, 5.0, 6.0), _u(rng, 1.9, 2.4)
    left = width * _u(rng, 0.42, 0.5)
    room = _Room(half, half, left, width - left, -_u(rng, 1.2, 1.5), _u(rng, 2.5, 2.8))
    _shell(shop, room)
    door, lamp = p.door(0.85, 2.05), p.plain(p.inks.bright(), glow=0.4)
    bays = np.arange(-2, 3) * _BAY_M
    for wall in room.walls:
        for y in bays[np.abs(bays) < wall.width_m / 2 - 0.5]:
            _sheet(shop, wall.at.on(0, float(y), 0), 0.85, 2.05, door)
            if rng.random() < 0.4:
                w, h = _u(rng, 0.4, 0.8), _u(rng, 0.4, 0.8)
                _sheet(shop, wall.at.on(0, float(y) + _BAY_M / 2, _u(rng, 1.2, 1.5)), w, h, p.poster(w, h))
    for x in bays:
        at = Placement(float(x) + _BAY_M / 2, 0, room.floor_z + room.height - 0.09)
        shop.builder.box(at, (0.16, 1.0, 0.07), p.plain(p.inks.bright()), bottom=lamp)
    for x in _BAY_M * (rng.permutation(np.array([-1.5, -0.5, 0.5, 1.5]))[:2] + 0.12):
        side = float(rng.choice([room.left - 0.25, 0.25 - room.right]))
        make.bin_or_drum(shop, Placement(float(x), side, room.floor_z), 0.16, _u(rng, 0.4, 0.7))
    return _finish(shop, room)


def _hall(shop: Workshop) -> World:
    """A hall of a plant, some 30 x 18 x 7 m: columns, beams and machines beside an aisle along its middle."""
    rng, p, b = shop.rng, shop.printer, shop.builder
    room = _Room(_u(rng, 14, 16), _u(rng, 13, 15), _u(rng, 8, 10), _u(rng, 8, 10), -1.6, _u(rng, 6.5, 7.5))
    _shell(shop, room)
    for wall in room.walls:
        _hang(shop, wall)
    steel = p.plain(p.inks.muted(), metal=0.3)
    top, wide, y = room.floor_z + room.height, room.left + room.right, (room.left - room.right) / 2
    for x in _COLUMN_M * np.arange(-2, 3):
        for side in (room.left - 0.4, 0.4 - room.right):
            b.box(Placement(float(x), side, room.floor_z), (0.3, 0.3, room.height), steel)
        b.box(Placement(float(x), y, top - 0.6), (0.25, wide, 0.5), steel)
    for _ in range(14):
        away = _u(rng, _AISLE_M / 2 + 1.0, min(room.left, room.right) - 1.5) * float(rng.choice([-1.0, 1.0]))
        at = Placement(_u(rng, -12, 13), away, room.floor_z, _u(rng, 0, np.pi))
        if rng.random() < 0.5:
            make.stack(shop, at, _u(rng, 0.8, 1.6), _u(rng, 0.8, 2.4))
        else:
            b.box(at, (_u(rng, 0.8, 2.5), _u(rng, 0.8, 2.0), _u(rng, 0.8, 2.5)), p.plain(p.inks.muted()))
    return _finish(shop, room)


def _finish(shop: Workshop, room: _Room) -> World:
    rng = shop.rng
    if shop.heated:
        make.heating(shop, depth_m=room.ahead, floor_z=room.floor_z, half_width_m=min(room.left, room.right, 2.8))
    top = room.floor_z + room.height - 0.3
    lights = [
        (_u(rng, 0.2, 0.4) * room.ahead, _u(rng, 0.2, 0.5) * room.left, top - _u(rng, 0, 0.2)),
        (-_u(rng, 0.2, 0.4) * room.behind, -_u(rng, 0.2, 0.5) * room.right, top - _u(rng, 0, 0.2)),
    ]
    return shop.builder.finish(focus_m=4.5, lights=lights)


def _u(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(low, high))


SURROUNDINGS: dict[str, Callable[[Workshop], World]] = {
    "boxes": _furnished({_cartons: 5, _drums: 1.5, _cabinet: 1, _nothing: 1}, amid=5),
    "desk": _furnished({_workplace: 3, _shelf: 2, _bookcase: 1, _cabinet: 1.5, _nothing: 1}, amid=3),
    "office": _furnished({_bookcase: 3, _cabinet: 2, _workplace: 3, _cartons: 1, _shelf: 1, _nothing: 0.7}, amid=4),
    "people": _furnished({_someone: 2.5, _bookcase: 2, _workplace: 1.5, _cabinet: 1, _nothing: 1}, amid=4, people=0.6),
    "plain": _plain,
    "corridor": _corridor,
    "hall": _hall,
}
"""The rooms by name; `plain` and `corridor` are the hardest."""
